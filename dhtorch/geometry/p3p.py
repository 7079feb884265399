"""Perspective from three points: every camera pose that sees three known points along three known rays.

Alphabet: point i of a triple has world coordinates ``X_i``, unit ray ``j_i`` and range ``d_i``; ``Y_i = d_i j_i``
is the point in the camera. ``m_ik = j_i · j_k`` and ``a_ik = |X_i − X_k|²``. Tensors inside this file are *planes*:
component axes first, triples last, so that each operation is contiguous over triples.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.linalg import cross

from dhtorch.geometry.shapes import check

#: Triples flatter than this (height over longest side) count as collinear.
MIN_HEIGHT = 1e-3


def p3p(
    rays: Tensor,  # (*, 3, 3) point, coordinate: viewing rays of any length
    xyz: Tensor,  # (*, 3, 3) point, coordinate: the points, m
) -> tuple[Tensor, Tensor, Tensor]:
    """All poses under which three points lie on three rays.

    The law of cosines gives one quadric cone in the ranges (d_1, d_2, d_3) per pair of points; eliminating the scale
    leaves two cones. Some member of their pencil splits into two planes, found from one real root of a cubic; each
    plane meets another cone in two lines, hence four solutions, all from homogeneous quadratics that stay regular for
    symmetric triangles. A Newton step on the law of cosines restores digits lost on the way. Planar scenes are
    nothing special to three points.

    Returns:
        R (*, 4, 3, 3) and t (*, 4, 3) with ``Y = R X + t``, and ``valid`` (*, 4): a real solution with all points in
        front. Collinear or coincident points, or rays, give none. Where not valid R and t are finite but meaningless;
        a double solution appears twice.

    Raises:
        ValueError: wrong shapes.

    Gradient: none (choosing among roots); refine the pose instead. Ranges are solved in float64.
    Source: the pencil of conics of M. Persson, K. Nordberg, "Lambda Twist" (ECCV 2018), with another way to split the
    degenerate member. Checked against synthetic truth and PoseLib.
    """
    check("p3p", rays=(rays, "* 3 3"), xyz=(xyz, "* 3 3"))
    if rays.shape != xyz.shape:
        raise ValueError(f"p3p: rays have shape {tuple(rays.shape)}, xyz {tuple(xyz.shape)}, expected equal shapes")
    with torch.no_grad():
        j = rays.double().movedim((-2, -1), (0, 1)).contiguous()  # (point, coordinate, *)
        X = xyz.double().movedim((-2, -1), (0, 1)).contiguous()
        j, X, sound = _sound(j, X)
        m = torch.stack(((j[0] * j[1]).sum(0), (j[0] * j[2]).sum(0), (j[1] * j[2]).sum(0)))
        sides = torch.stack((X[0] - X[1], X[0] - X[2], X[1] - X[2]))
        a = (sides * sides).sum(1)
        scale = a.amax(0)
        a = a / scale
        d, step = _polish(_ranges(m, a), m, a)
        # Newton's method squares the error: a short step has arrived.
        valid = sound & (step < 1e-3) & (d.amin(0) > 1e-9)
        d = d.masked_fill(~valid, 1.0) * scale.sqrt()
        R, t = _align(j.to(xyz.dtype), X.to(xyz.dtype), d.to(xyz.dtype))
    # (row, column, root, *) → (*, root, row, column)
    return R.movedim((2, 0, 1), (-3, -2, -1)), t.movedim((1, 0), (-2, -1)), valid.movedim(0, -1)


def _sound(j: Tensor, X: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Unit rays and points with a harmless triple in place of degenerate ones, and the mask (*) of the others."""
    j = j / (j * j).sum(1, keepdim=True).sqrt()
    e, h = X[1] - X[0], X[2] - X[0]
    ee, eh, hh = (e * e).sum(0), (e * h).sum(0), (h * h).sum(0)
    longest = torch.maximum(torch.maximum(ee, hh), ee + hh - 2 * eh)
    far = 1 - 1e-12  # cosine of the smallest angle between two rays, a microradian
    apart = ((j[0] * j[1]).sum(0) < far) & ((j[0] * j[2]).sum(0) < far) & ((j[1] * j[2]).sum(0) < far)
    sound = apart & (ee * hh - eh * eh > (MIN_HEIGHT * longest) ** 2) & longest.isfinite()
    spare = torch.eye(3, dtype=X.dtype, device=X.device).view(3, 3, *[1] * sound.ndim)
    return torch.where(sound, j, spare), torch.where(sound, X, spare), sound


def _ranges(m: Tensor, a: Tensor) -> Tensor:
    """Ranges (3, 4, *) of the four intersections of the two cones, scaled to satisfy the sum of the three equations."""
    D1, D2 = _cones(m, a)
    gamma = _outer_root(*_pencil(m, a))
    far = gamma.abs() > 1
    weight = torch.where(far, 1 / gamma, gamma)
    split = torch.where(far, D1 * weight + D2, D1 + D2 * weight)  # det(split) = 0
    other = torch.where(far, D1, D2)
    # The null vector is the steepest column of the adjugate; both planes contain it.
    columns = (cross(split[1], split[2], dim=0), cross(split[2], split[0], dim=0), cross(split[0], split[1], dim=0))
    size = [(x * x).sum(0) for x in columns]
    p = torch.where(size[0] >= size[1], columns[0], columns[1])
    p = torch.where(torch.maximum(size[0], size[1]) >= size[2], p, columns[2])
    p = p / (p * p).sum(0).sqrt()
    u, v = _complement(p)
    w = _null_directions(split, u, v)  # (3, 2, *) one direction per plane
    d = _null_directions(other[:, :, None], p[:, None], w).flatten(1, 2)  # (3, root, plane, *) → (3, 4, *)
    d = d * d.sum(0).sign()
    m, a = m[:, None], a[:, None]
    total = 2 * ((d * d).sum(0) - d[0] * d[1] * m[0] - d[0] * d[2] * m[1] - d[1] * d[2] * m[2])
    return d * (a.sum(0) / total).sqrt()


def _cones(m: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
    """Symmetric (3, 3, *) matrices of a_23 × (equation 12) − a_12 × (equation 23), and of the same with 13 for 12."""
    (m0, m1, m2), (a0, a1, a2) = m.unbind(0), a.unbind(0)
    zero = torch.zeros_like(m0)
    xy, xz, yz1, yz2 = -a2 * m0, -a2 * m1, a0 * m2, a1 * m2
    first = (a2, xy, zero, xy, a2 - a0, yz1, zero, yz1, -a0)
    second = (a2, zero, xz, zero, -a1, yz2, xz, yz2, a2 - a1)
    return torch.stack(first).unflatten(0, (3, 3)), torch.stack(second).unflatten(0, (3, 3))


def _pencil(m: Tensor, a: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Coefficients, cubic first, of det(D1 + γ D2) / a_23 as a polynomial in γ."""
    (s0, s1, s2), (a0, a1, a2) = (1 - m * m).unbind(0), a.unbind(0)
    volume = 2 * a2 * (1 - m[0] * m[1] * m[2])
    k3 = a1 * (a1 * s2 - a2 * s1)
    k2 = a1 * s2 * (a1 + 2 * a0) + a2 * s1 * (a2 - a0) - a1 * volume
    k1 = a0 * s2 * (a0 + 2 * a1) + a2 * s0 * (a2 - a1) - a0 * volume
    k0 = a0 * (a0 * s2 - a2 * s0)
    return k3, k2, k1, k0


def _outer_root(k3: Tensor, k2: Tensor, k1: Tensor, k0: Tensor) -> Tensor:
    """The real root of a cubic that lies farthest from the other two, hence the best conditioned one.

    A vanishing leading coefficient sends that root to infinity; it is held at about 1e10 times the others' scale.
    It is made of functions that torch rounds alike wherever an element stands; sinh and pow are not among them.
    """
    tiny = 1e-10 * torch.maximum(k2.abs(), torch.maximum(k1.abs(), k0.abs())) + 1e-300
    k3 = torch.where(k3.abs() < tiny, tiny, k3)
    third, k1, k0 = k2 / (3 * k3), k1 / k3, k0 / k3
    p, q = k1 / 3 - third * third, k0 / 2 + third * (third * third - k1 / 2)  # t³ + 3 p t + 2 q = 0, γ = t − third
    s = p.abs().sqrt() + 1e-9 * third.abs() + 1e-40
    h = q.abs() / (s * s * s)
    sign = p.sign()
    w = ((h + (h * h + sign).clamp_min(0).sqrt()).log() / 3).exp()
    one_real = w - sign / w
    three_real = 2 * (h.clamp(max=1).acos() / 3).cos()
    size = s * torch.where((p <= 0) & (h < 1), three_real, one_real)
    t = -size.copysign(q)
    for _ in range(2):
        slope = 3 * (t * t + p)
        t = t - (t * (t * t + 3 * p) + 2 * q) / slope.masked_fill(slope == 0, torch.inf)
    return t - third


def _complement(p: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors (3, *) that complete unit vectors p to a right-handed frame, without a branch.

    Source: T. Duff et al., "Building an Orthonormal Basis, Revisited" (JCGT 2017).
    """
    x, y, z = p.unbind(0)
    s = torch.ones_like(z).copysign(z)
    a = -1 / (s + z)
    b = x * y * a
    return torch.stack((1 + s * x * x * a, s * b, -s * x)), torch.stack((b, s + y * y * a, -y))


def _null_directions(A: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """The two unit vectors α u + β v with xᵀ A x = 0: A (3, 3, …), u and v (3, …) → (3, 2, …).

    A negative discriminant counts as zero; whether the solution exists shows when it is put back into the equations.
    """
    Au = (A * u).sum(1)
    uu, uv, vv = (Au * u).sum(0), (Au * v).sum(0), ((A * v).sum(1) * v).sum(0)
    root = (uv * uv - uu * vv).clamp_min(0).sqrt()
    s = uv + root.copysign(uv)
    alpha, beta = torch.stack((-s, vv)), torch.stack((uu.expand_as(s), -s))  # α : β, each free of cancellation
    x = alpha * u[:, None] + beta * v[:, None]
    return x / (x * x).sum(0).sqrt()


def _polish(d: Tensor, m: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
    """A Newton step on d_i² + d_k² − 2 d_i d_k m_ik = a_ik; ranges (3, 4, *) and the longest of the steps (4, *)."""
    (m0, m1, m2), (a0, a1, a2) = m[:, None].unbind(0), a[:, None].unbind(0)
    x, y, z = d.unbind(0)
    xy, xz, yz = x - y * m0, x - z * m1, y - z * m2
    yx, zx, zy = y - x * m0, z - x * m1, z - y * m2
    # Half the Jacobian has the rows (xy, yx, 0), (xz, 0, zx), (0, yz, zy).
    r0, r1, r2 = x * xy + y * yx - a0, x * xz + z * zx - a1, y * yz + z * zy - a2
    p, q = zx * yz, yx * xz
    det = -2 * (xy * p + q * zy)
    step_x = r2 * (yx * zx) - r0 * p - r1 * (yx * zy)
    step_y = r1 * (xy * zy) - r2 * (xy * zx) - r0 * (xz * zy)
    step_z = r0 * (xz * yz) - r1 * (xy * yz) - r2 * q
    step = torch.stack((step_x, step_y, step_z)) / det.masked_fill(det.abs() < 1e-30, torch.inf)
    return d - step, step.abs().amax(0)


def _align(j: Tensor, X: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation (3, 3, 4, *) and translation (3, 4, *) that carry the triangle X onto Y = d j."""
    Y = d[:, None] * j[:, :, None]  # (point, coordinate, root, *)
    y0, y1, y2 = _frame(Y)
    x0, x1, x2 = _frame(X)
    R = y0[:, None] * x0[:, None] + y1[:, None] * x1[:, None] + y2[:, None] * x2[:, None]
    turned = y0 * (x0 * X[0]).sum(0) + y1 * (x1 * X[0]).sum(0) + y2 * (x2 * X[0]).sum(0)
    return R, Y[0] - turned


def _frame(P: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Orthonormal axes (coordinate, …) of triangles (point, coordinate, …)."""
    e0 = P[1] - P[0]
    e0 = e0 / (e0 * e0).sum(0).sqrt()
    e2 = cross(e0, P[2] - P[0], dim=0)
    e2 = e2 / (e2 * e2).sum(0).sqrt()
    return e0, cross(e2, e0, dim=0), e2
