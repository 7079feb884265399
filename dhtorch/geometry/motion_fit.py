"""Robust fit of a small camera motion to tracks, with a covariance that neighbouring tracks do not shrink.

Alphabet: T carries points of the reference into the other ("live") camera; xi = (rotation rad, translation m) its left
perturbation. Everything is float64.

Without depth the motion is known up to scale, by distances to epipolar lines: ``x``, ``y`` unit rays (B, 3, N) of view
0 and view 1; ``b`` = Rᵀ y; ``s`` unit direction (B, 3) of the translation in axes of view 0, for which s · (x × b) = 0.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry import se3
from dhtorch.geometry.checks import shaped
from dhtorch.geometry.covariance import grouped_covariance, masked_median
from dhtorch.geometry.least_squares import (
    MIN_DEPTH,
    linearise,
    move_pose,
    normal_equations,
    reprojection_residuals,
    robust_loss,
    solve_spd,
)
from dhtorch.geometry.reprojection_problem import MEDIAN_1D, MEDIAN_2D
from dhtorch.geometry.se3 import Pose

#: Bends of the robust kernel from coarse to fine, px: the first is wider than the scatter of a start from a median
#: flow, the last narrower than any move of interest. Source: chosen on built-in rooms of seeds 40 and 41.
FIT_BENDS_PX = (8.0, 4.0, 2.0, 1.0, 1.0)

#: Residual, in standard deviations, at which the kernel bends. Source: chosen on built-in rooms of seeds 40 and 41.
FINAL_BEND = 3.0


class Sightings(NamedTuple):
    """Points of a reference view and where another image shows them."""

    xyz: Tensor  # (B, 3, N) m in the reference camera; rays with z = 1 where there is no depth
    uv: Tensor  # (B, 2, N) ideal px in the image
    used: Tensor  # (B, N) bool
    f: Tensor  # (B, 2) px, of the image's camera
    c: Tensor  # (B, 2) px

    @property
    def plane(self) -> Tensor:
        """(B, 2, N) the pixels on the plane z = 1."""
        return (self.uv - self.c[..., None]) / self.f[..., None]


class MotionFit(NamedTuple):
    """Result of :func:`fit_motion`."""

    T: Pose  # live from reference
    log_zoom: Tensor  # (B,) logarithm of the focal length over the stated one; 0 where it is not free
    cov: Tensor  # (B, 7, 7) of the left perturbation and log_zoom, zero for what is not free
    inlier: Tensor  # (B, N) bool
    noise_px: Tensor  # (B,) standard deviation of a coordinate of an inlier


def fit_motion(
    seen: Sightings, starts: Pose, group: Tensor, *, overlap: float, rotation_only: bool, zoom: bool = False
) -> MotionFit:
    """The motion on which most tracks agree: reweighted least squares from several starts, the best of which is kept.

    Args:
        seen: of one image, B = 1.
        starts: (S) poses live from reference.
        group: (N,) long, groups of neighbours, whose errors are common.
        overlap: windows over an area, a count at least 1: so many tracks count as one in the model's covariance.
        rotation_only: the translation stays the start's, with zero covariance.
        zoom: the focal length is also fitted, from the stated one.

    Returns:
        The fit; ``cov`` is the sandwich over the groups plus a share of the model's own.
    """
    free = [0, 1, 2, *([] if rotation_only else [3, 4, 5]), *([6] if zoom else [])]
    many = Sightings(*(x.expand(len(starts.t), *x.shape[1:]) for x in seen))
    T, log_zoom = starts, torch.zeros_like(starts.t[:, 0])
    for bend in FIT_BENDS_PX:
        T, log_zoom, _ = _step(many, T, log_zoom, bend, free)
    best = int(_step(many, T, log_zoom, FIT_BENDS_PX[-1], free)[2].argmin())
    T, log_zoom = T[best : best + 1], log_zoom[best : best + 1]
    # Steps with the kernel fitted to the residuals, a count. Source: chosen on built-in rooms of seeds 40 and 41:
    # later steps are below 0.001 px.
    for _ in range(5):
        rows, depth = _linearise(seen, T, log_zoom)
        T, log_zoom, _ = _step(
            seen, T, log_zoom, FINAL_BEND * _noise(rows[:, -1], seen.used & (depth > MIN_DEPTH))[:, None], free
        )
    rows, depth = _linearise(seen, T, log_zoom)
    usable = seen.used & (depth > MIN_DEPTH)
    noise = _noise(rows[:, -1], usable)
    square = rows[:, -1].square().sum(1)
    # Length of an inlier's residual, in standard deviations of a coordinate, at most. Source: derived, one in ninety
    # of two Gaussian coordinates lies beyond.
    inlier = usable & (square < (3.0 * noise[:, None]) ** 2)
    _, weight = robust_loss(square / (FINAL_BEND * noise[:, None]) ** 2, "geman_mcclure", 1.0)
    # Share of the model's covariance that is added to the sandwich, which few groups understate. Source: chosen on
    # moved cameras in built-in rooms of seeds 40 and 41: .70 of the errors within one sigma.
    rows, sigma = rows[:, [*free, 7]], noise * (0.65 * overlap) ** 0.5
    cov = rows.new_zeros(len(rows), 7, 7)
    cov[:, torch.tensor(free)[:, None], free] = grouped_covariance(
        rows, torch.where(usable, weight, 0.0), inlier, group, sigma
    )
    return MotionFit(T, log_zoom, cov, inlier, noise)


def _linearise(seen: Sightings, T: Pose, log_zoom: Tensor) -> tuple[Tensor, Tensor]:
    """Rows (B, 8, 2, N) of :func:`linearise` with the column of log_zoom before the residual, and depths (B, N)."""
    rows, depth = linearise(T, seen.f * log_zoom.exp()[:, None], seen.c, seen.xyz, seen.uv)
    zoom = rows[:, 6:] + (seen.uv - seen.c[..., None])[:, None]
    return torch.cat((rows[:, :6], zoom, rows[:, 6:]), 1), depth


def _step(
    seen: Sightings, T: Pose, log_zoom: Tensor, bend: Tensor | float, free: list[int]
) -> tuple[Pose, Tensor, Tensor]:
    """One reweighted Gauss-Newton step of what is free, and the sum (B,) of the robust cost before it."""
    rows, depth = _linearise(seen, T, log_zoom)
    usable = seen.used & (depth > MIN_DEPTH)
    rho, weight = robust_loss(rows[:, -1].square().sum(1) / bend**2, "geman_mcclure", 1.0)
    cost = torch.where(usable, rho, 1.0).sum(-1)
    H, g = normal_equations(rows[:, [*free, 7]], torch.where(usable, weight, 0.0))
    xi = rows.new_zeros(len(rows), 7)
    xi[:, free] = solve_spd(H, -g[..., None])[0][..., 0]
    return move_pose(T, xi[:, :6]), log_zoom + xi[:, 6], cost


def _noise(r: Tensor, usable: Tensor) -> Tensor:
    """Noise (B,) of a coordinate, px, from the median length of the residuals that are no outliers."""
    length = r.square().sum(1).sqrt()
    median = masked_median(length, usable & (length < 3 * FIT_BENDS_PX[-1]))[:, 0]
    # Limits of the noise of a track, px: below, exact copies of an image; above, nothing is followed. Source:
    # derived, an eighth of the rounding to whole pixels over sqrt(12); the last of ``FIT_BENDS_PX``.
    return (median / MEDIAN_2D).clamp(0.036, 1.0)


def rotation_from_flow(seen: Sightings, ray_0: Tensor) -> Pose:
    """Start (B): the rotation about two axes that moves the image by the median flow from rays (B, 3, N), z = 1."""
    x, y = (masked_median(seen.plane[:, k] - ray_0[:, k], seen.used)[:, 0] for k in range(2))
    has_tracks = seen.used.any(-1)
    turn = torch.stack((torch.where(has_tracks, -y, 0.0), torch.where(has_tracks, x, 0.0)), -1)
    return se3.exp(F.pad(turn, (0, 4)))


def scene_flow(
    T: Pose, cov: Tensor, xyz: Tensor, known: Tensor, camera: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Median length (B,) px of the motion of points (B, 3, N) in the image, and its standard deviation.

    ``camera``: focal lengths and principal points, (B, 2) px; ``known`` (B, N): the points that count.
    """
    f, c = camera
    still = se3.identity(len(f), f)
    uv_0, _ = reprojection_residuals(still, f, c, xyz, torch.zeros_like(xyz[:, :2]))
    rows, depth = linearise(T, f, c, xyz, uv_0)
    usable = known & (depth > MIN_DEPTH)
    J = rows[:, :6].permute(0, 3, 2, 1)  # (B, N, 2, 6)
    variance = 0.5 * ((J @ cov[:, None]) * J).sum((-2, -1))
    return masked_median(rows[:, 6].square().sum(1).sqrt(), usable)[:, 0], masked_median(variance, usable)[:, 0].sqrt()


def mean_flow_form(xyz: Tensor, known: Tensor, f: Tensor, c: Tensor) -> Tensor:
    """Mean of J^T J (B, 7, 7) over known points (B, 3, N) seen from the reference: px² per squared unit of a motion and
    of the logarithm of the focal length."""
    here = Sightings(xyz, torch.zeros_like(xyz[:, :2]), known, f, c)
    rows, _ = _linearise(here, se3.identity(len(f), f), torch.zeros_like(f[:, 0]))
    return normal_equations(rows, known.to(f.dtype))[0] / known.sum(-1).clamp_min(1)[:, None, None]


class _EpipolarMotion(NamedTuple):
    """Result of :func:`fit_epipolar_motion`."""

    T: Pose  # view 1 from view 0, |t| = 1
    noise_px: Tensor  # (B,) standard deviation of the distances to the epipolar lines
    inlier: Tensor  # (B, N) bool


@shaped("x: B 3 N, y: B 3 N, used: B N, R: B 3 3")
def fit_epipolar_motion(
    x: Tensor,  # (B, 3, N) rays of view 0, any length
    y: Tensor,  # (B, 3, N) rays of view 1, any length
    used: Tensor,  # (B, N) bool
    R: Tensor,  # (B, 3, 3) start, e.g. the pure rotation that fits best
    f_px: Tensor,  # (B,) focal length that turns angles into px
    bend_px: Tensor,  # (B,) bend of the robust kernel at the end
) -> _EpipolarMotion:
    """Rotation and direction of translation that minimise robust distances to epipolar lines, in float64.

    The first direction is that of least squares under the start's rotation; steps on five unknowns follow while the
    kernel narrows. The sign is that which puts most points in front of both cameras.

    Raises:
        ValueError: wrong shapes.

    Gradient: none.
    """
    x, y = F.normalize(x, dim=1), F.normalize(y, dim=1)
    weight = used.to(x.dtype)
    b = R.mT @ y
    a = torch.linalg.cross(x, b, dim=1)
    s = torch.linalg.eigh((a * weight[:, None]) @ a.mT).eigenvectors[..., 0]  # of the smallest eigenvalue
    distance = torch.zeros_like(weight)
    # Steps of the search for a direction of translation, a count. Source: chosen on built-in rooms of seeds 40 and
    # 41.
    for k in range(15):
        # Bend of the robust kernel at the first of them, px, half as wide at each further one. Source: chosen on
        # built-in rooms of seeds 40 and 41.
        bend = bend_px[:, None].clamp_min(16.0 / 2**k)
        e = (s[:, None] @ a)[:, 0]
        # Least sine between a ray and the translation: nearer ones have no epipolar line. Source: derived, 3 degrees.
        sine = torch.linalg.cross(s[..., None].expand_as(x), x, dim=1).norm(dim=1).clamp_min(0.05)
        distance = f_px[:, None] * e / sine
        _, robust = robust_loss((distance / bend).square(), "geman_mcclure", 1.0)
        weight = torch.where(used, robust / sine**2, 0.0)
        R, s = _epipolar_step(x, b, a, s, weight, R=R)
        b = R.mT @ y
        a = torch.linalg.cross(x, b, dim=1)
    ahead = ((b - x * (x * b).sum(1, keepdim=True)) * s[..., None] * weight[:, None]).sum((1, 2))
    s = torch.where(ahead[:, None] < 0, -s, s)  # points lie in front of both cameras
    # Largest distance of an inlier, px. Source: derived, three times the last bend of a fit with depth.
    inside = used & (distance.abs() < 3.0)
    noise = masked_median(distance.abs(), inside)[:, 0] / MEDIAN_1D
    # Length of an inlier's distance, in standard deviations. Source: derived, one in 370 Gaussian numbers lies
    # beyond.
    inlier = inside & (distance.abs() < 3.0 * noise[:, None])
    return _EpipolarMotion(Pose(R, (R @ s[..., None])[..., 0]), noise, inlier)


def _epipolar_step(x: Tensor, b: Tensor, a: Tensor, s: Tensor, weight: Tensor, *, R: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation and direction after a Gauss-Newton step on s · (x × b), a = x × b."""
    tangent = torch.linalg.svd(s[:, None]).Vh[:, 1:]  # (B, 2, 3)
    dot = (x * b).sum(1, keepdim=True)
    J = torch.cat((x * (s[:, None] @ b) - s[..., None] * dot, tangent @ a), 1)
    H = (J * weight[:, None]) @ J.mT
    # Damping of these steps, a fraction of the trace.
    damping = 1e-9 * H.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None] + 1e-300
    H = H + damping * torch.eye(5, dtype=x.dtype, device=x.device)
    step = torch.linalg.solve_ex(H, (J * (weight * (s[:, None] @ a)[:, 0])[:, None]).sum(-1))[0]
    R = R @ se3.exp(F.pad(-step[:, :3], (0, 3))).R
    return R, F.normalize(s - (step[:, None, 3:] @ tangent)[:, 0], dim=-1)
