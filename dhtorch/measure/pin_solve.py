"""Robust fit of a small camera motion to tracks, with a covariance that neighbouring tracks do not shrink.

Alphabet: T carries points of the reference into the live camera; xi = (rotation rad, translation m) its left
perturbation. Everything is float64.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry import se3
from dhtorch.geometry.covariance import masked_median
from dhtorch.geometry.least_squares import (
    MIN_DEPTH,
    linearise,
    move_pose,
    normal_equations,
    reprojection_residuals,
    robust_loss,
    solve_spd,
)
from dhtorch.geometry.se3 import Pose

#: Bends of the robust kernel from coarse to fine, px: the first is wider than the scatter of a start from a median
#: flow, the last narrower than any move of interest. Source: chosen on built-in rooms of seeds 40 and 41.
FIT_BENDS_PX = (8.0, 4.0, 2.0, 1.0, 1.0)

#: Steps with the kernel fitted to the residuals, a count. Source: chosen on built-in rooms of seeds 40 and 41: later
#: steps are below 0.001 px.
FINAL_STEPS = 5

#: Limits of the noise of a track, px: below, exact copies of a picture; above, nothing is followed.
#: Source: derived, an eighth of the rounding to whole pixels over sqrt(12); the last of ``FIT_BENDS_PX``.
NOISE_RANGE_PX = (0.036, 1.0)

#: Residual, in standard deviations, at which the kernel bends. Source: chosen on built-in rooms of seeds 40 and 41.
FINAL_BEND = 3.0

#: Length of an inlier's residual, in standard deviations of a coordinate, at most. Source: derived, one in ninety of
#: two Gaussian coordinates lies beyond.
AGREEING_SIGMAS = 3.0

#: Share of the model's covariance that is added to the sandwich, which few groups understate.
#: Source: calibrated on moved cameras in built-in rooms of seeds 40 and 41: .70 of the errors within one sigma.
MODEL_SHARE = 0.65

#: Median length of a residual of two Gaussian coordinates with unit sigma. Source: derived, sqrt(2 log 2).
MEDIAN_RAYLEIGH = 1.1774

#: Median absolute value of a Gaussian with unit sigma. Source: derived, the normal quantile of 3/4.
MEDIAN_NORMAL = 0.6745

#: Steps of the search for a direction of translation, a count. Source: chosen on built-in rooms of seeds 40 and 41.
EPIPOLAR_STEPS = 15

#: Bend of the robust kernel at the first of them, px, half as wide at each further one. Source: derived, twice the
#: first of ``FIT_BENDS_PX``.
EPIPOLAR_BEND_PX = 16.0

#: Damping of these steps, a fraction of the trace. Source: origin not recorded.
EPIPOLAR_DAMPING = 1e-9

#: Least sine between a ray and the translation: nearer ones have no epipolar line. Source: derived, 3 degrees.
MIN_SINE = 0.05


class Sightings(NamedTuple):
    """Points of the reference and where a live picture shows them."""

    xyz: Tensor  # (B, 3, N) m in the reference camera; rays with z = 1 where there is no depth
    uv: Tensor  # (B, 2, N) ideal px in the live picture
    used: Tensor  # (B, N) bool
    f: Tensor  # (B, 2) px, of the live camera
    c: Tensor  # (B, 2) px


class MotionFit(NamedTuple):
    """Result of :func:`fit_motion`."""

    T: Pose  # live from reference
    cov: Tensor  # (B, 6, 6) of the left perturbation
    inlier: Tensor  # (B, N) bool
    noise_px: Tensor  # (B,) standard deviation of a coordinate of an inlier


def fit_motion(seen: Sightings, starts: Pose, group: Tensor, *, overlap: float, rotation_only: bool) -> MotionFit:
    """The motion on which most tracks agree: reweighted least squares from several starts, the best of which is kept.

    Args:
        seen: of one picture, B = 1.
        starts: (S) poses live from reference.
        group: (N,) long, groups of neighbours, whose errors are common.
        overlap: windows over an area, a count at least 1: so many tracks count as one in the model's covariance.
        rotation_only: the translation stays the start's, with zero covariance.

    Returns:
        The fit; ``cov`` is the sandwich over the groups plus a share of the model's own.
    """
    many = Sightings(*(x.expand(len(starts.t), *x.shape[1:]) for x in seen))
    T = starts
    for bend in FIT_BENDS_PX:
        T, _ = _step(many, T, bend, rotation_only)
    best = int(_step(many, T, FIT_BENDS_PX[-1], rotation_only)[1].argmin())
    T = T[best : best + 1]
    for _ in range(FINAL_STEPS):
        r, depth = reprojection_residuals(T, seen.f, seen.c, seen.xyz, seen.uv)
        T, _ = _step(seen, T, FINAL_BEND * _noise(r, seen.used & (depth > MIN_DEPTH))[:, None], rotation_only)
    rows, depth = linearise(T, seen.f, seen.c, seen.xyz, seen.uv)
    usable = seen.used & (depth > MIN_DEPTH)
    noise = _noise(rows[:, 6], usable)
    square = rows[:, 6].square().sum(1)
    inlier = usable & (square < (AGREEING_SIGMAS * noise[:, None]) ** 2)
    _, weight = robust_loss(square / (FINAL_BEND * noise[:, None]) ** 2, "geman_mcclure", 1.0)
    variance = MODEL_SHARE * overlap * noise * noise
    cov = _covariance(rows, torch.where(usable, weight, 0.0), inlier, variance, group, rotation_only)
    return MotionFit(T, cov, inlier, noise)


def _step(seen: Sightings, T: Pose, bend: Tensor | float, rotation_only: bool) -> tuple[Pose, Tensor]:
    """One reweighted Gauss-Newton step, and the sum (B,) of the robust cost before it."""
    rows, depth = linearise(T, seen.f, seen.c, seen.xyz, seen.uv)
    usable = seen.used & (depth > MIN_DEPTH)
    rho, weight = robust_loss(rows[:, 6].square().sum(1) / bend**2, "geman_mcclure", 1.0)
    cost = torch.where(usable, rho, 1.0).sum(-1)
    H, g = normal_equations(rows, torch.where(usable, weight, 0.0))
    return move_pose(T, _solve(H, -g[..., None], rotation_only)[..., 0]), cost


def _solve(H: Tensor, b: Tensor, rotation_only: bool) -> Tensor:
    """H^-1 b (B, 6, k); zero where H is singular, and in the translation where only the rotation is free."""
    if not rotation_only:
        return solve_spd(H, b)[0]
    x, _ = solve_spd(H[:, :3, :3], b[:, :3])
    return torch.cat((x, torch.zeros_like(x)), 1)


def _noise(r: Tensor, usable: Tensor) -> Tensor:
    """Noise (B,) of a coordinate, px, from the median length of the residuals that are no outliers."""
    length = r.square().sum(1).sqrt()
    median = masked_median(length, usable & (length < 3 * FIT_BENDS_PX[-1]))[:, 0]
    return (median / MEDIAN_RAYLEIGH).clamp(*NOISE_RANGE_PX)


def _covariance(
    rows: Tensor, weight: Tensor, inlier: Tensor, variance: Tensor, group: Tensor, rotation_only: bool
) -> Tensor:
    """H^-1 M H^-1 (B, 6, 6): M sums the squared scores of groups and the model's of ``variance`` px²."""
    H, _ = normal_equations(rows, weight)
    scores = (rows[:, :6] * rows[:, 6:]).sum(2) * weight[:, None]  # (B, 6, N)
    n_groups = int(group.max()) + 1
    sums = scores.new_zeros(*scores.shape[:2], n_groups).index_add_(2, group, scores)
    count = scores.new_zeros(len(H), n_groups).index_add_(1, group, inlier.to(H.dtype))
    n, free = (count > 0).sum(-1)[:, None, None], 3 if rotation_only else 6
    meat = sums @ sums.mT * (n / (n - free).clamp_min(1)) + H * variance[:, None, None]
    half = _solve(H, meat, rotation_only)
    return _solve(H, half.mT.contiguous(), rotation_only)


def rotation_from_flow(seen: Sightings, ray_0: Tensor) -> Pose:
    """Start (B): the rotation about two axes that moves the picture by the median flow from rays (B, 3, N), z = 1."""
    ray_1 = (seen.uv - seen.c[..., None]) / seen.f[..., None]
    x, y = (masked_median(ray_1[:, k] - ray_0[:, k], seen.used)[:, 0] for k in range(2))
    has_tracks = seen.used.any(-1)
    turn = torch.stack((torch.where(has_tracks, -y, 0.0), torch.where(has_tracks, x, 0.0)), -1)
    return se3.exp(F.pad(turn, (0, 4)))


def scene_flow(
    T: Pose, cov: Tensor, xyz: Tensor, known: Tensor, camera: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Median length (B,) px of the motion of points (B, 3, N) in the picture, and its standard deviation.

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
    """Mean of J^T J (B, 6, 6) over known points (B, 3, N) seen from the reference: px² per squared unit of a motion."""
    rows, _ = linearise(se3.identity(len(f), f), f, c, xyz, torch.zeros_like(xyz[:, :2]))
    return normal_equations(rows, known.to(f.dtype))[0] / known.sum(-1).clamp_min(1)[:, None, None]


def epipolar_motion(seen: Sightings, T: Pose, noise_px: Tensor) -> tuple[Pose, Tensor, Tensor]:
    """Motion up to scale of tracks without depth, from the distances to epipolar lines.

    Args:
        seen: rays with z = 1 as points.
        T, noise_px: the start, the pure rotation that fits best, and its noise (B,).

    Returns:
        The motion live from reference, |t| = 1, the noise (B,) of the distances, px, and the tracks (B, N) within it.
    """
    x = F.normalize(seen.xyz, dim=1)
    y = torch.cat(((seen.uv - seen.c[..., None]) / seen.f[..., None], torch.ones_like(seen.uv[:, :1])), 1)
    y = F.normalize(y, dim=1)
    narrow, R = FINAL_BEND * noise_px[:, None], T.R
    weight = seen.used.to(x.dtype)
    b = R.mT @ y
    a = torch.linalg.cross(x, b, dim=1)  # s . a = 0 for the direction s of the translation, in reference axes
    s = torch.linalg.eigh((a * weight[:, None]) @ a.mT).eigenvectors[..., 0]  # of the smallest eigenvalue
    distance = torch.zeros_like(weight)
    for k in range(EPIPOLAR_STEPS):
        bend = narrow.clamp_min(EPIPOLAR_BEND_PX / 2**k)
        e = (s[:, None] @ a)[:, 0]
        sine = torch.linalg.cross(s[..., None].expand_as(x), x, dim=1).norm(dim=1).clamp_min(MIN_SINE)
        distance = seen.f.mean(-1)[:, None] * e / sine
        _, robust = robust_loss((distance / bend).square(), "geman_mcclure", 1.0)
        weight = torch.where(seen.used, robust / sine**2, 0.0)
        tangent = torch.linalg.svd(s[:, None]).Vh[:, 1:]  # (B, 2, 3)
        dot = (x * b).sum(1, keepdim=True)
        J = torch.cat((x * (s[:, None] @ b) - s[..., None] * dot, tangent @ a), 1)
        H = (J * weight[:, None]) @ J.mT
        damping = EPIPOLAR_DAMPING * H.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None] + 1e-300
        H = H + damping * torch.eye(5, dtype=x.dtype, device=x.device)
        step = torch.linalg.solve_ex(H, (J * (weight * e)[:, None]).sum(-1))[0]
        R = R @ se3.exp(F.pad(-step[:, :3], (0, 3))).R
        s = F.normalize(s - (step[:, None, 3:] @ tangent)[:, 0], dim=-1)
        b = R.mT @ y
        a = torch.linalg.cross(x, b, dim=1)
    ahead = ((b - x * (x * b).sum(1, keepdim=True)) * s[..., None] * weight[:, None]).sum((1, 2))
    s = torch.where(ahead[:, None] < 0, -s, s)  # points lie in front of both cameras
    inside = seen.used & (distance.abs() < 3 * FIT_BENDS_PX[-1])
    noise = masked_median(distance.abs(), inside)[:, 0] / MEDIAN_NORMAL
    return Pose(R, (R @ s[..., None])[..., 0]), noise, inside & (distance.abs() < AGREEING_SIGMAS * noise[:, None])
