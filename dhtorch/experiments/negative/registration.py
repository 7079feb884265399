"""Iterative closest point registration of two sparse point sets, with inlier ratio and conditioning.

Alphabet: ``x`` points of set 0 and ``Y = R x + t`` in frame 1; ``q`` the point of set 1 nearest to Y and ``m`` the
normal there. Point to point drives Y − q to zero, point to plane only its part along m. ``xi`` is the left
perturbation of the pose, as in :mod:`dhtorch.geometry.least_squares`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.geometry import se3
from dhtorch.geometry.checks import check
from dhtorch.geometry.least_squares import gauss_newton_step, select_batch
from dhtorch.geometry.linalg import small_matmul
from dhtorch.geometry.se3 import Pose
from dhtorch.pytree import Record, record

#: Smallest number of matches for a valid registration; three fix a rigid motion.
_MIN_MATCHES = 6


@record
class IcpRegistration(Record):
    """Relative pose of two point sets, with matches, residual and conditioning."""

    T_1_from_0: Pose
    matched: Tensor  # (B, N) bool: points of set 0 with a point of set 1 within reach, at the final pose
    inlier_share: Tensor  # (B,) fraction of the points of set 0 that are matched; 0 without any
    rms_m: Tensor  # (B,) RMS distance of the matched points (along the normal for planes); NaN without any
    condition: Tensor  # (B,) smallest over largest eigenvalue of the normal matrix, lengths in units of the set's size
    ok: Tensor  # (B,) bool: enough matches, which constrain all six degrees of freedom


def register_icp(
    xyz_0: Tensor,  # (B, N, 3) m in frame 0, NaN = no point
    xyz_1: Tensor,  # (B, M, 3) m in frame 1, NaN = no point
    T_init: Pose,  # (B) 1 from 0
    *,
    normals_1: Tensor | None = None,  # (B, M, 3) unit, NaN = no plane there
    reach_m: float = 0.25,
    shrink: float = 0.9,
    least_reach_m: float = 0.1,
    keep: float = 0.8,
    iterations: int = 30,
) -> IcpRegistration:
    """Register set 0 to set 1 by trimmed ICP from an initial pose: points, initial pose -> registration.

    Every iteration matches each point with its nearest, keeps the best matches and takes one Gauss–Newton step, which
    for points is the closed-form alignment up to second order in the rotation. The match distance shrinks from step to
    step: a distant start converges, and regions without overlap do not bias the end.

    Args:
        xyz_0, xyz_1: the sets; their numbers of points may differ.
        T_init: initial pose: a device's pose, or the identity.
        normals_1: for point-to-plane ICP; None = point to point.
        reach_m: largest match distance at the start.
        shrink: factor on the match distance from step to step.
        least_reach_m: lower bound of the match distance; matches within it count for ``inlier_share`` and ``rms_m``.
        keep: fraction of the matches kept in a step, the nearest ones (trimmed ICP).
        iterations: number of steps; there is no early stop.

    Returns:
        Registration. Where not ok, the pose is the initial one.

    Raises:
        ValueError: wrong shapes or options, or an empty set (N = 0 or M = 0).

    Gradient: none; matches are discrete.
    Cost: iterations × N × M distances.
    Source: P. Besl, N. McKay 1992 (points); Y. Chen, G. Medioni 1991 (planes); D. Chetverikov et al. 2002 (trimming).
    """
    sizes = check("register_icp", xyz_0=(xyz_0, "B N 3"), xyz_1=(xyz_1, "B M 3"), R=(T_init.R, "B 3 3"))
    check("register_icp", xyz_1=(xyz_1, "B M 3"), normals_1=(normals_1, "B M 3"))
    if not (sizes["N"] and sizes["M"]):
        raise ValueError(f"register_icp: sets have {sizes['N']} and {sizes['M']} points, expected at least one each")
    if not (0 < keep <= 1 and 0 < shrink <= 1 and 0 < least_reach_m <= reach_m and iterations > 0):
        options = f"keep={keep}, shrink={shrink}, least_reach_m={least_reach_m}, reach_m={reach_m}"
        raise ValueError(
            f"register_icp: found {options}, expected keep and shrink in (0, 1], 0 < least_reach_m <= reach_m, and at"
            " least one iteration"
        )
    with torch.no_grad():
        sets = _PointSets(xyz_0, xyz_1, normals_1)
        start = Pose(T_init.R.double(), T_init.t.double())
        finite = start.R.isfinite().all(-1).all(-1) & start.t.isfinite().all(-1)
        T = select_batch(finite, start, se3.identity(len(start.t), start.t))
        reach = reach_m
        for _ in range(iterations):
            H, g, _, _ = sets.linearise(T, reach, keep)
            T, _ = gauss_newton_step(T, H, g)
            reach = max(reach * shrink, least_reach_m)
        H, _, matched, square = sets.linearise(T, least_reach_m, 1.0)
    n = matched.sum(-1)
    condition = sets.condition(T, H)
    ok = finite & (n >= _MIN_MATCHES) & (condition > 1e-9)
    rms = torch.where(n > 0, (torch.where(matched, square, 0.0).sum(-1) / n.clamp_min(1)).sqrt(), torch.nan)
    share = n / sets.valid_0.sum(-1).clamp_min(1)
    pose = select_batch(ok, T, start).to(xyz_0.dtype)
    share, rms, condition = (v.to(xyz_0.dtype) for v in (share, rms, condition))
    return IcpRegistration(pose, matched, share, rms, condition, ok)


def estimate_normals(
    xyz: Tensor,  # (B, M, 3) m, NaN = no point
    *,
    neighbours: int = 8,
    max_bend: float = 0.1,
) -> Tensor:
    """Unit normals (B, M, 3), towards the camera, of planes fitted to each point and its nearest neighbours.

    Args:
        xyz: points in a camera's frame.
        neighbours: number of nearest points in the fit.
        max_bend: largest fraction of the neighbourhood's variance off the plane; NaN above it.

    Raises:
        ValueError: wrong shapes, fewer points than neighbours, or fewer than three neighbours.

    Gradient: none.
    """
    sizes = check("estimate_normals", xyz=(xyz, "B M 3"))
    if not 3 <= neighbours < sizes["M"]:
        raise ValueError(
            f"estimate_normals: found {sizes['M']} points, {neighbours} neighbours, expected 3 or more of more"
        )
    with torch.no_grad():
        valid = xyz.isfinite().all(-1)
        x = _move_invalid_away(xyz, valid, 1e6)
        nearest = torch.cdist(x, x, compute_mode="donot_use_mm_for_euclid_dist").topk(neighbours + 1, -1, largest=False)
        group = x.gather(1, nearest.indices.flatten(1)[..., None].expand(-1, -1, 3)).view(*nearest.indices.shape, 3)
        deviation = (group - group.mean(-2, keepdim=True)).double()
        covariance = (deviation[..., :, None] * deviation[..., None, :]).mean(-3)
        has_neighbours = valid & (nearest.values[..., -1] < 1e5)
        eye = torch.eye(3, dtype=covariance.dtype, device=covariance.device)
        values, vectors = torch.linalg.eigh(torch.where(has_neighbours[..., None, None], covariance, eye))
        normal = vectors[..., 0]
        normal = torch.where(((normal * x).sum(-1) > 0)[..., None], -normal, normal).to(xyz.dtype)
        flat = has_neighbours & (values[..., 0] <= max_bend * values.sum(-1)) & (values[..., 1] > 2 * values[..., 0])
    return torch.where(flat[..., None], normal, torch.nan)


class _PointSets:
    """Two point sets with invalid points replaced; sums are in float64."""

    def __init__(self, xyz_0: Tensor, xyz_1: Tensor, normals_1: Tensor | None) -> None:
        self.valid_0, valid_1 = xyz_0.isfinite().all(-1), xyz_1.isfinite().all(-1)
        if normals_1 is not None:
            valid_1 = valid_1 & normals_1.isfinite().all(-1)
        self.x = torch.where(self.valid_0[..., None], xyz_0, 0.0).double()
        self.q = _move_invalid_away(xyz_1, valid_1, 1e6)
        self.normals = None if normals_1 is None else torch.where(valid_1[..., None], normals_1, 0.0)
        weight = self.valid_0[..., None].double()
        count = weight.sum(1).clamp_min(1)
        deviation = (self.x - (self.x * weight).sum(1, keepdim=True) / count[:, None]) * weight
        self.size = ((deviation * deviation).sum((1, 2)) / count[:, 0]).sqrt().clamp_min(1e-9)  # (B,) m
        self.centre = (self.x * weight).sum(1) / count

    def linearise(self, T: Pose, reach: float, keep: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Normal equations H (B, 6, 6), g (B, 6) of the kept matches, their mask and squared residuals (B, N)."""
        Y = se3.apply(T, self.x)
        distance, index = torch.cdist(Y.to(self.q.dtype), self.q, compute_mode="donot_use_mm_for_euclid_dist").min(-1)
        matched = self.valid_0 & (distance < reach)
        if keep < 1:
            ranked = torch.where(matched, distance, torch.inf).sort(-1).values
            last = (keep * matched.sum(-1, keepdim=True)).ceil().long().sub(1).clamp_min(0)
            matched = matched & (distance <= ranked.gather(-1, last))
        r = Y - _gather_rows(self.q, index).double()  # (B, N, 3)
        J = torch.cat((-se3.hat(Y), torch.eye(3, dtype=Y.dtype, device=Y.device).expand(*Y.shape, 3)), -1)
        if self.normals is not None:
            m = _gather_rows(self.normals, index).double()
            r = (m * r).sum(-1, keepdim=True)
            J = (m[..., None] * J).sum(-2, keepdim=True)
        w = matched.double()[..., None, None]
        Jw = J * w
        H = (Jw[..., :, None] * J[..., None, :]).sum((1, 2))
        g = (Jw * r[..., None]).sum((1, 2))
        return H, g, matched, (r * r).sum(-1)

    def condition(self, T: Pose, H: Tensor) -> Tensor:
        """Reciprocal condition number (B,) of H, rotations about the set's centre scaled by its size; 0 if singular.

        About the centre the motion of a point is ω × (Y − c) + u, so that the translation in H is u − ω × c.
        """
        eye = torch.eye(3, dtype=H.dtype, device=H.device).expand(len(H), 3, 3)
        c = se3.apply(T, self.centre[:, None])[:, 0]
        size = self.size[:, None, None]
        A = torch.cat((torch.cat((eye / size, 0 * eye), -1), torch.cat((se3.hat(c) / size, eye), -1)), -2)
        values = torch.linalg.eigvalsh(small_matmul(A.mT, small_matmul(H, A)))
        return (values[:, 0].clamp_min(0) / values[:, -1].clamp_min(1e-300)).clamp(0, 1)


def _gather_rows(values: Tensor, index: Tensor) -> Tensor:
    """Rows (B, N, 3) of values (B, M, 3) at an index (B, N)."""
    return values.gather(1, index[..., None].expand(-1, -1, 3))


def _move_invalid_away(xyz: Tensor, valid: Tensor, far: float) -> Tensor:
    """Points with invalid ones moved to a coordinate ``far`` from all others."""
    return torch.where(valid[..., None], xyz, far)
