"""Closed forms of 2×2 and 3×3 matrices: determinants, inverses, eigenvalues and products with batch-independent sums.

Alphabet: a 2×2 matrix is its *entries* ((a, b), (c, d)), four tensors of one shape, so that each operation is
contiguous over points and the caller chooses their memory layout; a symmetric one is ((a, b), (b, c)). *Matrices* are
(…, m, n), *planes* (m, n, …), components first and points last.

Products are sums of products, not calls of ``matmul``: their rounding does not depend on the number of matrices
(:mod:`dhtorch.geometry.determinism`). The order of every sum is part of the definition.
"""

import torch
from torch import Tensor


def determinant_2x2(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """Entries -> determinant a d − b c. Gradient: to all."""
    return a * d - b * c


def adjugate_2x2(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Entries -> entries ((d, −b), (−c, a)) of the adjugate: the inverse times the determinant. Gradient: to all."""
    return d, -b, -c, a


def inverse_2x2(a: Tensor, b: Tensor, c: Tensor, d: Tensor, *, least: float) -> Tensor:
    """Entries -> entries (4, …) of the inverse; a determinant of magnitude ≤ ``least``, or NaN, counts as ``least``.

    Gradient: to all; finite where the determinant counts as ``least``.
    """
    det = determinant_2x2(a, b, c, d)
    det = torch.where(det.abs() > least, det, torch.full_like(det, least))
    return torch.stack(adjugate_2x2(a, b, c, d)) / det


def eigenvalues_2x2(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Entries of ((a, b), (b, c)) -> the smaller and the larger eigenvalue.

    Gradient: to all; where both are equal that of their mean.
    """
    half, middle = (a - c) / 2, (a + c) / 2
    square = half * half + b * b
    is_distinct = square > 0
    split = torch.where(is_distinct, torch.where(is_distinct, square, torch.ones_like(square)).sqrt(), square)
    return middle - split, middle + split


def quadratic_form(x: Tensor, y: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Vector and symmetric matrix -> (x, y) ((a, b), (b, c)) (x, y)ᵀ. Gradient: to all."""
    return x * x * a + 2 * x * y * b + y * y * c


def upper_triangle(S: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Symmetric matrices (…, 2, 2) -> entries a, b, c; the lower left is not read. Gradient: to ``S``."""
    return S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]


def small_matmul(A: Tensor, B: Tensor) -> Tensor:
    """Matrices (…, m, k) and (…, k, n) -> products (…, m, n). Gradient: to both."""
    return (A[..., :, :, None] * B[..., None, :, :]).sum(-2)


def matmul_planes(A: Tensor, B: Tensor) -> Tensor:
    """Planes (m, k, …) and (k, n, …) -> products (m, n, …). Gradient: to both."""
    return (A[:, :, None] * B[None]).sum(1)


def rotate_planes(
    R: Tensor,  # (B, m, 3)
    x: Tensor,  # (B, 3, N)
) -> Tensor:
    """Matrices (B, m, 3) and vectors in planes (B, 3, N) -> R x (B, m, N).

    :func:`dhtorch.geometry.se3.rotate` is the same for points (B, N, 3).

    Gradient: to both.
    """
    first, second, third = x[:, None].unbind(2)
    R = R[..., None]
    return R[:, :, 0] * first + R[:, :, 1] * second + R[:, :, 2] * third


def cofactor_planes(A: Tensor) -> Tensor:
    """Planes (3, 3, …) -> cofactor matrices: row i is the cross product of the two rows that follow it cyclically.

    Gradient: to ``A``.
    """
    return torch.linalg.cross(A.roll(-1, 0), A.roll(-2, 0), dim=1)


def solve_cholesky(b: Tensor, L: Tensor) -> Tensor:
    """Solution x (B, n, k) of L Lᵀ x = b for lower triangles L (B, n, n). Gradient: to b and L."""
    if L.is_cpu:
        return torch.cholesky_solve(b, L)
    y = torch.linalg.solve_triangular(L, b, upper=False)  # of a batch, cholesky_solve lets the host wait for a device
    return torch.linalg.solve_triangular(L.mT, y, upper=True)
