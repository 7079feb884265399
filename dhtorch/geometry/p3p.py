"""Perspective from three points: three rays and three points → up to four camera poses.

Alphabet: point i of a triple has world coordinates ``X_i``, unit ray ``j_i`` and range ``d_i``; ``Y_i = d_i j_i``
is the point in the camera. Pair k joins point k and the next one in the circle 0 → 1 → 2 → 0: ``m_k`` is the cosine
between their rays, ``a_k`` their squared distance. Tensors inside this file are *planes*: component axes first, triples
last, so that each operation is contiguous over triples; few operations on many planes, because for the
hypotheses of one pair an operation costs more than what it computes.
"""

import torch
from torch import Tensor
from torch.linalg import cross

from dhtorch.geometry.checks import shaped
from dhtorch.geometry.linalg import cofactor_planes

#: Limits the flatness of a triple: height over longest side below which it is collinear, without unit.
MIN_HEIGHT_RATIO = 1e-3

#: Limits the cosine of the angle between two rays, which is at least about a microradian.
MAX_RAY_COSINE = 1 - 1e-12


@shaped("rays: * 3 3, xyz: * 3 3")
def p3p(
    rays: Tensor,  # (*, 3, 3) point, coordinate: viewing rays of any length
    xyz: Tensor,  # (*, 3, 3) point, coordinate: the points, m
) -> tuple[Tensor, Tensor, Tensor]:
    """All poses under which three points lie on three rays: R (*, 4, 3, 3), t (*, 4, 3) and valid (*, 4).

    The law of cosines gives one quadric cone in the ranges (d_0, d_1, d_2) per pair of points; eliminating the scale
    leaves two cones. Some member of their pencil splits into two planes, found from one real root of a cubic; each
    plane meets another cone in two lines, hence four solutions, all from homogeneous quadratics that stay regular for
    symmetric triangles. A Newton step on the law of cosines restores lost digits. Planar scenes are no special
    case for three points.

    Args:
        rays: (*, 3, 3) viewing rays in the camera, of any length; the second last axis counts the points.
        xyz: (*, 3, 3) the points in the world, m.

    Returns:
        R (*, 4, 3, 3) and t (*, 4, 3) with ``Y = R X + t``, and ``valid`` (*, 4): a real solution with all points in
        front. Collinear or coincident points, or rays, give none. Where not valid R is the identity and t is 0;
        a double solution appears twice.

    Raises:
        ValueError: wrong shapes.

    Gradient: none (choosing among roots); refine the pose instead. Ranges are solved in float64.
    Source: the pencil of conics of M. Persson, K. Nordberg, "Lambda Twist" (ECCV 2018), with another way to find the
    degenerate member; its planes as in J. Richter-Gebert, "Perspectives on Projective Geometry" (2011). Checked
    against synthetic truth and ``poselib.p3p`` (``tests/functional/test_points.py``).

    Example:
        >>> import torch
        >>> from dhtorch.geometry.p3p import p3p
        >>> xyz = torch.tensor([[[0.0, 0.0, 2.0], [1.0, 0.2, 3.0], [-0.3, 1.0, 2.5]]])  # (B, point, coordinate) m
        >>> seen = xyz + torch.tensor([0.1, 0.0, -0.2])  # from a displaced camera
        >>> R, t, valid = p3p(seen / seen[..., 2:], xyz)
        >>> R.shape, t.shape, valid.shape  # four solutions each, not all valid
        (torch.Size([1, 4, 3, 3]), torch.Size([1, 4, 3]), torch.Size([1, 4]))
        >>> right = valid & ((t - torch.tensor([0.1, 0.0, -0.2])).norm(dim=-1) < 1e-4)
        >>> int(right.sum()), bool(torch.allclose(R[right], torch.eye(3), atol=1e-4))
        (1, True)
    """
    if rays.shape != xyz.shape:
        raise ValueError(f"p3p: rays have shape {tuple(rays.shape)}, xyz {tuple(xyz.shape)}, expected equal shapes")
    R, t, valid = p3p_of_planes(*(x.movedim((-2, -1), (0, 1)) for x in (rays, xyz)))
    # (row, column, root, *) → (*, root, row, column)
    return R.movedim((2, 0, 1), (-3, -2, -1)), t.movedim((1, 0), (-2, -1)), valid.movedim(0, -1)


def p3p_of_planes(
    rays: Tensor,  # (3, 3, *) point, coordinate
    xyz: Tensor,  # (3, 3, *) point, coordinate: m
) -> tuple[Tensor, Tensor, Tensor]:
    """:func:`p3p` of planes: R (3, 3, 4, *), t (3, 4, *) and valid (4, *), rows first, the root before the triples.

    Gradient: none.
    """
    with torch.no_grad():
        j, X = (x.to(torch.float64, memory_format=torch.contiguous_format) for x in (rays, xyz))
        j = j / (j * j).sum(1, keepdim=True).sqrt()  # (point, coordinate, *)
        side = X.roll(-1, 0) - X
        m = (j * j.roll(-1, 0)).sum(1)
        a = (side * side).sum(1)
        longest = a.amax(0)
        a = a / longest
        total = a.sum(0)
        squared_area = total * total - 2 * (a * a).sum(0)  # (4 × area)², by Heron's formula
        regular = (squared_area > 4 * MIN_HEIGHT_RATIO**2) & (m.amax(0) < MAX_RAY_COSINE) & (longest < torch.inf)
        d, step = _polish(_ranges(m, a), m, a)
        # Newton's method squares the error: a short step means convergence.
        valid = regular & (step < 1e-3) & (d.amin(0) > 1e-9)
        Y = (d * longest.sqrt())[:, None] * j[:, :, None]  # (point, coordinate, root, *)
        # Rotation (3, 3, 4, *) and translation (3, 4, *) that carry the last triangle onto the first four
        P = torch.cat((Y, X[:, :, None]), 2).to(xyz.dtype)
        e = P[1] - P[0]
        e = e / (e * e).sum(0).sqrt()
        n = cross(e, P[2] - P[0], dim=0)
        n = n / (n * n).sum(0).sqrt()
        axes = torch.stack((e, n, cross(n, e, dim=0)))
        R = (axes[:, :, None, :4] * axes[:, None, :, 4:]).sum(0)
        t = P[0, :, :4] - (R * P[0, :, 4:]).sum(1)
        eye = torch.eye(3, dtype=R.dtype, device=R.device).view(3, 3, *[1] * valid.ndim)
        return torch.where(valid, R, eye), t.masked_fill(~valid, 0.0), valid


def _ranges(m: Tensor, a: Tensor) -> Tensor:
    """Ranges (3, 4, *) of the four intersections of the two cones, scaled to satisfy the sum of the three equations."""
    cones = _degenerate_conics(m, a)
    gamma = _outer_root(cones)
    first, second = (cones * (gamma * gamma + 1).rsqrt()).unbind(2)
    split, other = gamma * first + second, first - gamma * second  # det(split) = 0
    # Planes g and h: split = g hᵀ + h gᵀ, and its cofactors are −p pᵀ with p = g × h, where the planes meet.
    minors = cofactor_planes(split)
    smallest, index = minors.diagonal(dim1=0, dim2=1).min(-1)
    p = _row(minors, index) * (-smallest).clamp_min(1e-300).rsqrt()
    eye = torch.eye(3, dtype=p.dtype, device=p.device).view(3, 3, *[1] * (p.ndim - 1))
    product = split + cross(p[:, None], eye, dim=0)  # = 2 h gᵀ
    product = torch.stack((product, product.transpose(0, 1)), 2)  # (row, column, plane, *)
    plane = _row(product, (product * product).sum(1).max(0).indices)  # (3, plane, *)
    d = _null_directions(other, p, cross(plane, p[:, None], dim=0))
    size = (d * (d - m[:, None] * d.roll(-1, 0))).sum(0)
    return d * (0.5 * a.sum(0) / size).sqrt().copysign(d.sum(0))


def _degenerate_conics(m: Tensor, a: Tensor) -> Tensor:
    """Symmetric matrices (3, 3, 2, *) of a_1 × (equation 0) − a_0 × (equation 1), and of the same with 2 for 0."""
    p = a[::2]
    yz = (p * m[1]).unbind(0)
    mixed = (-a[1] * m[::2]).unbind(0)
    yy = (a[1] - p).unbind(0)
    zz = (-p).unbind(0)
    xx, zero = a[1], torch.zeros_like(a[1])
    first = (xx, mixed[0], zero, mixed[0], yy[0], yz[0], zero, yz[0], zz[0])
    second = (xx, zero, mixed[1], zero, zz[1], yz[1], mixed[1], yz[1], yy[1])
    return torch.stack([x for entry in zip(first, second, strict=True) for x in entry]).unflatten(0, (3, 3, 2))


def _row(A: Tensor, index: Tensor) -> Tensor:
    """Rows (3, …) of matrices (row, column, …) by their number (…)."""
    return A.gather(0, index.expand(1, *A.shape[1:]))[0]


def _outer_root(cones: Tensor) -> Tensor:
    """γ with det(γ first + second) = 0: the real root farthest from the other two, which is the best conditioned.

    A vanishing leading coefficient sends that root to infinity; it is limited to about 1e12 times the others' scale.
    It uses only functions that torch rounds alike at every position of a tensor; sinh and pow are not among them.
    """
    k = (
        (cofactor_planes(cones)[:, :, :, None] * cones[:, :, None]).sum(0).sum(0).flatten(0, 1)
    )  # 3 det, 3 mixed terms and back: γ³, γ², γ, 1
    tiny = 1e-12 * k.abs().amax(0) + 1e-300
    _, third, c, last = (k / (k[0] + tiny.copysign(k[0]))).unbind(0)  # γ³ + 3 third γ² + 3 c γ + last = 0
    square = third * third
    p, q = c - square, 0.5 * last + third * (square - 1.5 * c)  # t³ + 3 p t + 2 q = 0, γ = t − third
    s = (p.abs() + 1e-18 * square + 1e-80).sqrt()
    h = q.abs() / (s * s * s)
    sign = p.sign()
    w = ((h + (h * h + sign).clamp_min(0).sqrt()).log() / 3).exp()
    one_real = w - sign / w
    three_real = 2 * (h.clamp(max=1).acos() / 3).cos()
    size = s * torch.where((p <= 0) & (h < 1), three_real, one_real)
    return -third - size.copysign(q)


def _null_directions(A: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """The vectors x = α u + β v with xᵀ A x = 0: A (3, 3, *), u (3, *) and v (3, 2, *) → (3, 4, *), of any length.

    A negative discriminant counts as zero; whether the solution exists follows from substitution into the equations.
    """
    Au, u = (A * u).sum(1), u[:, None]
    uu = (Au[:, None] * u).sum(0)
    uv = (Au[:, None] * v).sum(0)
    vv = ((A[:, :, None] * v).sum(1) * v).sum(0)
    s = uv + (uv * uv - uu * vv).clamp_min(0).sqrt().copysign(uv)
    first, second = vv * u - s * v, uu * v - s * u  # α : β twice, each free of cancellation
    return torch.cat((first, second), 1)


def _polish(d: Tensor, m: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
    """A Newton step on d_k² + d_{k+1}² − 2 d_k d_{k+1} m_k = a_k; ranges (3, 4, *), the longest of the steps (4, *)."""
    m, next_d = m[:, None], d.roll(-1, 0)
    x, y = d - next_d * m, next_d - d * m
    r = d * x + next_d * y - a[:, None]
    # Row k of half the Jacobian has x_k in column k and y_k in the next: Cramer's rule for this circle.
    rows = torch.stack((x, r, y), 1)
    x1, r1, y1 = rows.roll(-1, 0).unbind(1)
    x2, r2, _ = rows.roll(-2, 0).unbind(1)
    det = 2 * (x[0] * x[1] * x[2] + y[0] * y[1] * y[2])
    step = x2 * (r * x1 - r1 * y) + r2 * (y * y1)
    step = step * (det / (det * det + 1e-20))  # none where two solutions coincide
    return d - step, step.abs().amax(0)
