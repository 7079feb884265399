"""Robust mean of poses with covariances on SE(3): V measurements of one motion → pose, covariance, inliers.

Alphabet: V measurements ``T_v`` with covariances ``C_v`` of their left perturbations; ``xi_v`` = log(T_v · T⁻¹) of the
mean T; ``d_v²`` = xi_vᵀ C_v⁻¹ xi_v.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry import covariance, se3
from dhtorch.geometry.checks import check
from dhtorch.geometry.least_squares import select_batch, solve_spd
from dhtorch.geometry.se3 import Pose

#: Limits the measurements tried as start, a count; more are thinned evenly.
MAX_STARTS = 32


class AveragePose(NamedTuple):
    """Mean of V measurements of a motion, its covariance and the measurements that agree with it."""

    T: Pose  # (B,); NaN where there is none
    cov: Tensor  # (B, 6, 6) of the left perturbation; NaN where there is none
    agree: Tensor  # (B, V) bool: the measurement is no further from the mean than its covariance allows
    scale: Tensor  # (B,) factor on the stated standard deviations that explains the scatter of the agreeing ones
    ok: Tensor  # (B,) bool: enough measurements, and most agree


def average_poses(
    T: Pose,  # (B, V, …)
    cov: Tensor,  # (B, V, 6, 6)
    valid: Tensor,  # (B, V) bool
    *,
    bend: float = 3.0,
    max_deviation: float = 6.0,
    min_agree: float = 0.6,
    at_least: int = 2,
) -> AveragePose:
    """Information-weighted mean of V measurements of one motion, and whether most of them agree.

    The start is the measurement with the least median distance to the others. From there reweighted least squares: each
    measurement is weighted by its inverse covariance and by a Geman-McClure weight of d, whose bend follows the
    scatter. Stated covariances that are too small appear as scatter: the mean's covariance is that of weighted least
    squares, times ``scale``² where that exceeds 1. Errors common to all measurements (a sensor's scale) do not appear,
    and no number of measurements removes them.

    Args:
        T, cov, valid: the measurements; those that are not valid are not read.
        bend: d from which the weight of a measurement decreases, in standard deviations times ``scale``.
        max_deviation: d beyond which it does not agree, in stated standard deviations times ``scale``.
        min_agree: fraction of the valid measurements that must agree; with fewer there is no mean.
        at_least: least number of agreeing measurements.

    Raises:
        ValueError: wrong shapes, or no measurement (V = 0).

    Gradient: none; a calibration.
    Cost: quadratic in at most :data:`MAX_STARTS` measurements, linear in the others. Float64 inside.
    Source: T. Barfoot, P. Furgale, "Associating uncertainty with three-dimensional poses for use in estimation
    problems", 2014; the scale is R. Birge's ratio.
    """
    V = check("average_poses", t=(T.t, "B V 3"), R=(T.R, "B V 3 3"), cov=(cov, "B V 6 6"), valid=(valid, "B V"))["V"]
    if V == 0:
        raise ValueError("average_poses: found no measurement, expected at least one")
    with torch.no_grad():
        B, dtype = len(valid), T.t.dtype
        valid = valid & T.R.isfinite().all((-1, -2)) & T.t.isfinite().all(-1) & cov.isfinite().all((-1, -2))
        flat = Pose(T.R.double().flatten(0, 1), T.t.double().flatten(0, 1))
        flat = select_batch(valid.flatten(), flat, se3.identity(B * V, flat.t))
        eye = torch.eye(6, dtype=torch.float64, device=cov.device).expand(B * V, 6, 6)
        safe_cov = torch.where(valid.flatten()[:, None, None], cov.double().flatten(0, 1), eye)
        information, regular = solve_spd(safe_cov, eye)
        valid = valid & regular.view(B, V)
        information = information.view(B, V, 6, 6)
        mean = _start_pose(flat, information, valid)
        # Limits the steps of reweighted least squares, a count.
        for _ in range(12):
            xi, square = _deviations(flat, mean, information)
            limit = (bend * _scale(square, valid)[:, None]) ** 2
            weight = torch.where(valid, (1 + square / limit) ** -2, 0.0)
            H, g = (
                (weight[..., None, None] * information).sum(1),
                weight[..., None] * (information @ xi[..., None])[..., 0],
            )
            xi_step, solved = solve_spd(H, g.sum(1)[..., None])
            mean = select_batch(solved, se3.retract(mean, xi_step[..., 0]), mean)
        xi, square = _deviations(flat, mean, information)
        scale = _scale(square, valid)
        agree = valid & (square < (max_deviation * scale[:, None]) ** 2)
        agree = agree & (square < (max_deviation * bend) ** 2)  # limits the scale itself
        n = agree.sum(-1)
        ok = (n >= at_least) & (n >= min_agree * valid.sum(-1))
        total = torch.where(agree, square, 0.0).sum(-1)
        scale = torch.maximum(scale, (total / (6 * (n - 1)).clamp_min(1)).sqrt())
        mean_cov, regular = covariance.covariance_from_normal(
            torch.where(agree[..., None, None], information, 0.0).sum(1), scale
        )
        ok = ok & regular

    def answer(x: Tensor) -> Tensor:
        return torch.where(ok.view(-1, *[1] * (x.ndim - 1)), x, torch.nan).to(dtype)

    return AveragePose(Pose(answer(mean.R), answer(mean.t)), answer(mean_cov), agree, answer(scale), ok)


def _deviations(flat: Pose, mean: Pose, information: Tensor) -> tuple[Tensor, Tensor]:
    """xi (B, V, 6) from the means to the measurements, and d² (B, V)."""
    B, V = information.shape[:2]
    inverse_mean = se3.invert(mean).map(lambda x: x.repeat_interleave(V, 0))
    xi = se3.log(se3.compose(flat, inverse_mean)).view(B, V, 6)
    return xi, (xi * (information @ xi[..., None])[..., 0]).sum(-1)


def _start_pose(flat: Pose, information: Tensor, valid: Tensor) -> Pose:
    """Measurement (B,) with the least median distance to the others."""
    B, V = valid.shape
    n_starts = min(V, MAX_STARTS)
    starts = [k * (V - 1) // max(n_starts - 1, 1) for k in range(n_starts)]
    poses = flat.map(lambda x: x.unflatten(0, (B, V)))
    cost = []
    for v in starts:
        median = covariance.masked_median(_deviations(flat, poses[:, v], information)[1], valid)[:, 0]
        cost.append(torch.where(valid[:, v], median, torch.inf))
    best = torch.tensor(starts, device=valid.device)[torch.stack(cost).argmin(0)]
    return poses[torch.arange(B, device=best.device), best]


def _scale(square: Tensor, valid: Tensor) -> Tensor:
    """Factor (B,) on the stated standard deviations that explains the median of d², at least 1."""
    # Median of the squared length of six independent standard normal numbers, without unit. Source: derived, median
    # of the chi² distribution with 6 degrees of freedom.
    return (covariance.masked_median(square, valid)[:, 0] / 5.3481).sqrt().clamp_min(1.0)
