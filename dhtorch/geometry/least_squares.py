"""Nonlinear least squares over rigid motions: residuals with Jacobians, robust weights, solvers and damped steps.

Alphabet: ``x`` points of frame a and ``Y = R x + t`` in the camera; ``r`` residual = projected − measured, px; ``xi``
the left perturbation ``T ← exp(xi) T`` = (rotation rad, translation m); ``H xi = −g`` the normal equations with
H = Σ w Jᵀ J and g = Σ w Jᵀ r. Points are *planes* (B, 3, N) and (B, 2, N), components first, so that each operation
is contiguous over points.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual
from torch.utils import _pytree as pytree

from dhtorch.geometry.checks import all_known, check, shaped
from dhtorch.geometry.linalg import small_matmul, solve_cholesky
from dhtorch.geometry.se3 import Pose
from dhtorch.ops.dispatch import operator, run_kernel

#: Limits the depth of a point in front of a camera from below, m.
MIN_DEPTH = 1e-6

#: Limits the pivots of a Cholesky factor with unit diagonal from below, without unit: singular where smaller.
MIN_PIVOT = 1e-6

#: Initial damping of :func:`minimise`, a factor on the diagonal without unit.
INITIAL_DAMPING = 1e-4

#: Step of the finite differences in :func:`implicit_step`, rad or m, in float64.
DERIVATIVE_STEP = 1e-7

#: A pose, or another tree of unknowns with a leading batch dimension.
S = TypeVar("S")


class NormalEquations(NamedTuple):
    """A cost and its normal equations at one set of unknowns per batch element."""

    cost: Tensor  # (B,)
    H: Tensor  # (B, n, n); n = 6 for a pose
    g: Tensor  # (B, n)


@shaped("T.R: B 3 3, f: B 2, c: B 2, xyz: B 3 N, uv: B 2 N")
def linearise(
    T: Pose,
    f: Tensor,  # (B, 2) px
    c: Tensor,  # (B, 2) px
    xyz: Tensor,  # (B, 3, N) m, planes
    uv: Tensor,  # (B, 2, N) ideal px, planes
) -> tuple[Tensor, Tensor]:
    """Reprojection residuals and their analytic Jacobian for a left perturbation of the pose.

    Returns:
        rows (B, 7, 2, N): six columns of the Jacobian, then the residual (px), each for u and v; and the depth (B, N)
        of the points in the camera. Points not in front get finite rows without meaning: give them weight zero.

    Raises:
        ValueError: wrong shapes.

    Gradient: to pose, f, c, xyz and uv. The Jacobian is checked against ``torch.func.jacrev``
    (``tests/geometry/test_least_squares.py``).
    """
    plane, w, z = _project_to_plane(T, xyz)
    f = f[..., None]
    minus, square = -plane, plane * plane
    (a, b) = plane.unbind(1)
    (na, nb) = minus.unbind(1)
    (aw, bw) = (minus * w).unbind(1)
    aa, bb = square.unbind(1)
    ra, rb = (plane - (uv - c[..., None]) / f).unbind(1)
    w = w[:, 0]
    zero = torch.zeros_like(a)
    columns = (na * b, -1 - bb, 1 + aa, a * b, nb, a, w, zero, zero, w, aw, bw, ra, rb)  # u and v alternate
    return torch.stack(columns, 1).unflatten(1, (7, 2)) * f[:, None], z


@shaped("T.R: B 3 3, f: B 2, c: B 2, xyz: B 3 N, uv: B 2 N")
def reprojection_residuals(
    T: Pose,
    f: Tensor,  # (B, 2) px
    c: Tensor,  # (B, 2) px
    xyz: Tensor,  # (B, 3, N) m, planes
    uv: Tensor,  # (B, 2, N) ideal px, planes
) -> tuple[Tensor, Tensor]:
    """The residuals (B, 2, N) px and the depth (B, N) of :func:`linearise`, the same bits, without the Jacobian.

    Gradient: to pose, f, c, xyz and uv. Raises ValueError for wrong shapes.
    """
    plane, _, z = _project_to_plane(T, xyz)
    f = f[..., None]
    return (plane - (uv - c[..., None]) / f) * f, z


def _project_to_plane(T: Pose, xyz: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Projections at z = 1 (B, 2, N), inverse depths (B, 1, N), finite for points behind, and depths z (B, N)."""
    Y = torch.baddbmm(T.t[..., None], T.R, xyz)
    z = Y[:, 2:]
    w = z.clamp_min(MIN_DEPTH).reciprocal()
    return Y[:, :2] * w, w, z[:, 0]


def robust_loss(square: Tensor, kernel: str | None, scale: float) -> tuple[Tensor, Tensor]:
    """Cost and weight of squared residuals under a robust kernel, the weights of iteratively reweighted least squares.

    Args:
        square: squared residuals of any shape, ≥ 0.
        kernel: None (plain squares), ``"huber"``, ``"cauchy"`` or ``"geman_mcclure"``.
        scale: the residual at which the kernel bends, in the residual's unit.

    Returns:
        ``rho`` with rho ≈ square for small residuals, and ``weight`` = d rho / d square, 1 at zero.

    Raises:
        ValueError: an unknown kernel.

    Gradient: to ``square``, finite at zero.
    """
    if kernel is None:
        return square, torch.ones_like(square)
    k2 = scale * scale
    if kernel == "huber":
        outside = square > k2
        size = torch.where(outside, square, torch.full_like(square, k2)).sqrt()
        return torch.where(outside, 2 * scale * size - k2, square), scale / size
    if kernel == "cauchy":
        bend = 1 + square / k2
        return k2 * bend.log(), bend.reciprocal()
    if kernel == "geman_mcclure":
        bend = 1 + square / k2
        return square / bend, (bend * bend).reciprocal()
    raise ValueError(f"robust_loss: kernel is {kernel!r}, expected None, 'huber', 'cauchy' or 'geman_mcclure'")


def robust_weight_slope(square: Tensor, kernel: str | None, scale: float) -> Tensor:
    """Derivative d weight / d square of :func:`robust_loss`, ≤ 0.

    Raises:
        ValueError: an unknown kernel.

    Gradient: to ``square``.
    """
    _, weight = robust_loss(square, kernel, scale)
    if kernel is None:
        return torch.zeros_like(square)
    k2 = scale * scale
    if kernel == "huber":
        outside = square > k2
        return torch.where(outside, -0.5 * weight / torch.where(outside, square, torch.ones_like(square)), 0.0)
    if kernel == "cauchy":
        return -weight * weight / k2
    return -2 / k2 * weight / (1 + square / k2)


def normal_equations(
    rows: Tensor,  # (B, n + 1, 2, N), of linearise; N a multiple of PRODUCT_LANES, or rounding depends on the batch
    weight: Tensor,  # (B, N) ≥ 0, one per point
    *,
    block: int | None = None,
) -> tuple[Tensor, Tensor]:
    """H = Σ w Jᵀ J (B, n, n) and g = Σ w Jᵀ r (B, n), for n unknowns: six of a pose, or more.

    Args:
        rows, weight: of the points.
        block: points summed at a time; all by default. On some processors the rounding of a matrix product depends on
            its length: where N is a multiple of ``block``, empty points behind the last change no bit.

    Gradient: to rows and weights. Raises ValueError for wrong shapes.
    """
    N = check("normal_equations", rows=(rows, "B n 2 N"), weight=(weight, "B N"))["N"]
    weighted = rows[:, :-1] * weight[:, None, None]
    (first, last), *blocks = zip(*(_in_blocks(x, block or N) for x in (weighted, rows)), strict=True)
    sums = torch.bmm(first, last.transpose(1, 2))  # Σ w J (J, r)ᵀ (B, n, n + 1)
    for left, right in blocks:
        sums = torch.baddbmm(sums, left, right.transpose(1, 2))
    return sums[..., :-1], sums[..., -1]


def _in_blocks(x: Tensor, block: int) -> tuple[Tensor, ...]:
    """Rows (B, n, 2, N) as matrices (B, n, 2 · block) of ``block`` points each, zeros behind the last."""
    N = x.shape[-1]
    if block >= N:
        return (x.flatten(2),)
    x = F.pad(x, (0, -N % block)) if N % block else x
    return x.unflatten(-1, (-1, block)).permute(3, 0, 1, 2, 4).flatten(3).unbind(0)  # one copy for all


@shaped("H: B n n, b: B n k")
def solve_spd(
    H: Tensor,  # (B, n, n) symmetric
    b: Tensor,  # (B, n, k)
) -> tuple[Tensor, Tensor]:
    """Solve H x = b for positive definite H, in float64 and back; a singular H is flagged, not raised.

    The matrix is scaled to a unit diagonal, factored without a graph, and the solution refined once by its own
    residual. The refinement carries the gradient, so no factorisation is ever differentiated.

    Returns:
        x (B, n, k), zero where not ok, and ``ok`` (B,).

    Raises:
        ValueError: wrong shapes.

    Gradient: exact to H and b, first order only; zero where not ok.
    """
    x, ok = _solve(H.double(), b.double())
    return x.to(b.dtype), ok


@operator(
    kernel=lambda H, b: run_kernel(
        "solve_spd", (H, b), (b.new_empty(b.shape), H.new_empty(len(H), dtype=torch.bool)), MIN_PIVOT
    ),
    dtypes={"H": torch.float64, "b": torch.float64},
    any_layout=("H", "b"),
)
def _solve(H: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`solve_spd` in float64."""
    n = H.shape[-1]
    A, rhs = H, b
    if n % 2:
        # The rounding of LAPACK depends on memory alignment: padded to a multiple of 4, a batch is aligned alike.
        padding = -n % 4
        A, rhs = F.pad(A, (0, padding, 0, padding)), F.pad(rhs, (0, 0, 0, padding))
        A = A + torch.diag(F.pad(A.new_zeros(n), (0, padding), value=1.0))
    eye = torch.eye(A.shape[-1], dtype=A.dtype, device=A.device)
    diagonal = A.detach().diagonal(dim1=-2, dim2=-1)
    s = diagonal.masked_fill(~(diagonal > 0), 1.0).rsqrt()[..., None]
    A, rhs = A * (s * s.transpose(1, 2)), rhs * s
    with torch.no_grad():
        L, info = torch.linalg.cholesky_ex(A)
        pivot = L.diagonal(dim1=-2, dim2=-1).amin(-1)  # NaN for a NaN matrix, hence not above the limit
        ok = (info == 0) & (pivot > MIN_PIVOT) & (rhs * 0 == 0).flatten(1).all(1)
        singular = ~ok[:, None, None]
    if not all_known(ok):
        L, A = torch.where(singular, eye, L), torch.where(singular, eye, A)
        rhs = rhs.masked_fill(singular, 0.0)
    start = solve_cholesky(rhs.detach(), L)
    x = start + solve_cholesky(rhs - small_matmul(A, start), L)
    return (x * s)[:, :n], ok


def implicit_step(equations: Callable[[Tensor], Tensor], g: Tensor) -> Tensor:
    """Zero displacement (B, n) of an optimum that carries the gradient of the optimum's position.

    The implicit function theorem with the whole derivative of the equations: what Gauss–Newton leaves out (residuals
    times their curvature, changing weights) is a fifth of the derivative of a pose from real tracks.

    Args:
        equations: g (B, n) after a displacement (B, n) of the unknowns; called without a graph.
        g: their value (B, n) at the optimum, with the graph of all its inputs.

    Gradient: to what g depends on, first order; zero where the equations are singular or g has no graph.
    Raises ValueError for wrong shapes.
    """
    n = check("implicit_step", g=(g, "B n"))["n"]
    if not has_graph(g):
        return torch.zeros_like(g)
    with torch.no_grad():
        steps = DERIVATIVE_STEP * torch.eye(n, dtype=g.dtype, device=g.device)[:, None].expand(n, *g.shape)
        slope = (torch.stack([equations(step) for step in steps], -1) - g.detach()[..., None]) / DERIVATIVE_STEP
        inverse, info = torch.linalg.inv_ex(slope)
        regular = (info == 0) & inverse.isfinite().flatten(1).all(1)
        inverse = torch.where(regular[:, None, None], inverse, 0.0)
    return -(inverse * (g - g.detach())[:, None]).sum(-1)


def has_graph(x: Tensor) -> bool:
    """Whether ``x`` takes part in backward or forward differentiation. Gradient: none."""
    return x.requires_grad or unpack_dual(x).tangent is not None


@shaped("T.R: B 3 3, xi: B 6")
def move_pose(
    T: Pose,
    xi: Tensor,  # (B, 6)
) -> Pose:
    """The pose displaced by a tangent vector, to second order in the rotation and without transcendental functions.

    The rotation is Cayley's map, which agrees with exp to second order.

    Gradient: to T and xi. Raises ValueError for wrong shapes.
    """
    half, t = (0.5 * xi).split(3, 1)
    half = half[..., None]
    M = torch.cat((T.R, T.t[..., None]), -1)
    once = torch.linalg.cross(half, M, dim=1)
    twice = torch.linalg.cross(half, once, dim=1)
    M = M + (once + twice) * (2 / (1 + (half * half).sum(1, keepdim=True)))
    return Pose(M[..., :3], M[..., 3] + (t + t))


def minimise(
    evaluate: Callable[[S], NormalEquations],
    T: S,
    steps: int,
    *,
    move: Callable[[S, Tensor], S],
    cost: Callable[[S], Tensor] | None = None,
    damping: float = INITIAL_DAMPING,
) -> tuple[S, Tensor]:
    """Levenberg–Marquardt with a fixed number of steps; each batch element accepts or rejects its own.

    Args:
        evaluate: cost and normal equations at a pose; masks and weights may be recomputed there.
        T: start; a pose, or another record of unknowns.
        steps: number of proposals.
        move: ``(T, xi) -> T``, unknowns displaced by a tangent vector (B, n), such as :func:`move_pose`.
        cost: the cost (B,) of ``evaluate`` alone, for the last proposal, after which no step follows.
        damping: initial factor of the diagonal; ×0.1 after an accepted step, ×10 after a rejected one.

    The damped system is solved in float64 by elimination and not refined: proposals are compared by their costs. Where
    it has no solution, or NaN, the proposal is NaN, and its cost is below no other.

    Returns:
        The best pose evaluated and its cost (B,); the cost never rises above the start's.

    Gradient: not intended; take :func:`implicit_step` from the detached result.
    """
    best = evaluate(T)
    eye = torch.eye(best.H.shape[-1], dtype=best.H.dtype, device=best.H.device)
    factor = torch.full_like(best.cost, damping)
    for k in range(steps):
        with torch.no_grad():
            H = best.H * (1 + factor[:, None, None] * eye)
            xi, info = torch.linalg.solve_ex(H.double(), -best.g.double())
            proposal, ok = move(T, xi.to(best.g.dtype)), info == 0
        if k == steps - 1:
            last_cost = evaluate(proposal).cost if cost is None else cost(proposal)
            accepted = ok & (last_cost < best.cost)
            if all_known(accepted):
                return proposal, last_cost
            return select_batch(accepted, proposal, T), torch.where(accepted, last_cost, best.cost)
        trial = evaluate(proposal)
        accepted = ok & (trial.cost < best.cost)
        if all_known(accepted):
            T, best = proposal, trial
            factor = factor * 0.1
            continue
        T = select_batch(accepted, proposal, T)
        best = NormalEquations(*(_where(accepted, a, b) for a, b in zip(trial, best, strict=True)))
        factor = torch.where(accepted, factor * 0.1, factor * 10)
    return T, best.cost


def select_batch(mask: Tensor, new: S, old: S) -> S:
    """Batch elements of ``new`` where ``mask`` (B,) holds, of ``old`` elsewhere; trees of tensors (B, …) or None.

    Gradient: to the chosen ones.
    """

    def select(new: Any, old: Any) -> Any:
        if isinstance(new, Pose):  # a leaf of the tree: avoids another traversal in every step
            return Pose(_where(mask, new.R, old.R), _where(mask, new.t, old.t))
        return None if new is None else _where(mask, new, old)

    return pytree.tree_map(select, new, old, is_leaf=lambda x: isinstance(x, Pose))


def _where(mask: Tensor, a: Tensor, b: Tensor) -> Tensor:
    return torch.where(mask.view(-1, *[1] * (a.ndim - 1)), a, b)
