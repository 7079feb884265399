"""One motion from many measurements of it: the mean of poses with covariances, on SE(3), robust to wrong ones.

Alphabet: V measurements ``T_v`` with covariances ``C_v`` of their left perturbations; ``xi_v`` = log(T_v · T⁻¹) of the
mean T; ``d_v²`` = xi_vᵀ C_v⁻¹ xi_v.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry import covariance, se3
from dhtorch.geometry.checks import check
from dhtorch.geometry.least_squares import select_batch, solve_spd
from dhtorch.geometry.se3 import Pose

#: Measurements each of which may be the start; more are thinned evenly.
MAX_STARTS = 32

#: Steps to the mean, each reweighed.
REWEIGHTING_STEPS = 12


class AveragePose(NamedTuple):
    """The motion that most of V measurements share."""

    T: Pose  # (B,); NaN where there is none
    cov: Tensor  # (B, 6, 6) of the left perturbation; NaN where there is none
    agree: Tensor  # (B, V) bool: the measurement is no further from the mean than its covariance allows
    scale: Tensor  # (B,) factor on the stated standard deviations that explains how far the agreeing ones scatter
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
    """The information-weighted mean of V measurements of one motion, and whether they contradict each other.

    The start is the measurement with the least median distance to the others. From there reweighted least squares: each
    measurement counts by its inverse covariance and by a Geman-McClure weight of d, which bends where the scatter says.
    Stated covariances that are too small show as scatter: the mean's covariance is that of weighted least squares,
    times ``scale``² where that exceeds 1. Errors that all measurements share (a sensor's scale) do not show, and no
    number of measurements takes them away.

    Args:
        T, cov, valid: the measurements; those that are not valid are not read.
        bend: d at which a measurement begins to count less, in standard deviations times ``scale``.
        max_deviation: d beyond which it does not agree, in stated standard deviations times ``scale``.
        min_agree: share of the valid measurements that must agree: fewer, and there is no one motion.
        at_least: valid measurements without which there is none.

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
        safe = torch.where(valid.flatten()[:, None, None], cov.double().flatten(0, 1), eye)
        information, known = solve_spd(safe, eye)
        valid = valid & known.view(B, V)
        information = information.view(B, V, 6, 6)
        mean = _start(flat, information, valid)
        for _ in range(REWEIGHTING_STEPS):
            xi, square = _off(flat, mean, information)
            limit = (bend * _scale(square, valid)[:, None]) ** 2
            weight = torch.where(valid, (1 + square / limit) ** -2, 0.0)
            H, g = (
                (weight[..., None, None] * information).sum(1),
                weight[..., None] * (information @ xi[..., None])[..., 0],
            )
            step, moved = solve_spd(H, g.sum(1)[..., None])
            mean = select_batch(moved, se3.retract(mean, step[..., 0]), mean)
        xi, square = _off(flat, mean, information)
        scale = _scale(square, valid)
        agree = valid & (square < (max_deviation * scale[:, None]) ** 2)
        agree = agree & (square < (max_deviation * bend) ** 2)  # a scale that explains everything explains nothing
        n = agree.sum(-1)
        ok = (n >= at_least) & (n >= min_agree * valid.sum(-1))
        total = torch.where(agree, square, 0.0).sum(-1)
        scale = torch.maximum(scale, (total / (6 * (n - 1)).clamp_min(1)).sqrt())
        summed, known = covariance.covariance_from_normal(
            torch.where(agree[..., None, None], information, 0.0).sum(1), scale
        )
        ok = ok & known

    def answer(x: Tensor) -> Tensor:
        return torch.where(ok.view(-1, *[1] * (x.ndim - 1)), x, torch.nan).to(dtype)

    return AveragePose(Pose(answer(mean.R), answer(mean.t)), answer(summed), agree, answer(scale), ok)


#: Median of the squared length of six independent standard normal numbers.
_MEDIAN = 5.3481


def _off(flat: Pose, mean: Pose, information: Tensor) -> tuple[Tensor, Tensor]:
    """xi (B, V, 6) from the means to the measurements, and d² (B, V)."""
    B, V = information.shape[:2]
    away = se3.invert(mean).map(lambda x: x.repeat_interleave(V, 0))
    xi = se3.log(se3.compose(flat, away)).view(B, V, 6)
    return xi, (xi * (information @ xi[..., None])[..., 0]).sum(-1)


def _start(flat: Pose, information: Tensor, valid: Tensor) -> Pose:
    """Of each row the measurement whose distances to the others have the least median."""
    B, V = valid.shape
    few = min(V, MAX_STARTS)
    offered = [k * (V - 1) // max(few - 1, 1) for k in range(few)]
    every = flat.map(lambda x: x.unflatten(0, (B, V)))
    cost = []
    for v in offered:
        middle = covariance.masked_median(_off(flat, every[:, v], information)[1], valid)[:, 0]
        cost.append(torch.where(valid[:, v], middle, torch.inf))
    best = torch.tensor(offered, device=valid.device)[torch.stack(cost).argmin(0)]
    return every[torch.arange(B, device=best.device), best]


def _scale(square: Tensor, valid: Tensor) -> Tensor:
    """Factor (B,) on the stated standard deviations that explains the median of d², at least 1."""
    return (covariance.masked_median(square, valid)[:, 0] / _MEDIAN).sqrt().clamp_min(1.0)
