"""Scenes with ground truth -> a calibration of scores and sigmas."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from dhtorch.metrics.calibration import Calibration, SigmaModel
from dhtorch.metrics.control import ScoreThreshold, plug_in_threshold
from dhtorch.metrics.errors import Points
from dhtorch.metrics.monotone import fit_isotonic, fit_platt
from dhtorch.metrics.reliability import pool_answers
from dhtorch.metrics.risk import cap_error


def fit_calibration(
    scenes: Sequence[Points],
    *,
    min_share: float = 0.02,
    targets: Sequence[int] = (5, 10, 20),
    choose: Callable[[Sequence[Points], float], ScoreThreshold] = plug_in_threshold,
    provenance: Mapping[str, Any] | None = None,
) -> Calibration:
    """Fit a calibration of scores and sigmas on scenes with ground truth; every scene has the same weight.

    Args:
        scenes: candidates with answers, scores and, where stated, sigmas; any depth source.
        min_share: least fraction of the weight in a step of a table.
        targets: mean errors, in per cent, for which thresholds are chosen.
        choose: the risk control that chooses them, such as :func:`dhtorch.metrics.control.scene_quantile_threshold`.
        provenance: origin of the scenes, as JSON values; ``n_scenes`` and ``n_answers`` are added. A saved file
            needs ``method`` and ``scenes``.

    Raises:
        ValueError: no answer in any scene.
    """
    score, good, weight = pool_answers(scenes)
    if not score.numel():
        raise ValueError("fit_calibration: found no answer in any scene, expected at least one")
    loss = cap_error(torch.cat([s.answered().error for s in scenes]))
    ends = (0.0, 1.0) if bool(((score >= 0) & (score <= 1)).all()) else None
    note = {**(provenance or {}), "n_scenes": sum(bool(s.keep.any()) for s in scenes), "n_answers": score.numel()}
    return Calibration(
        probability=fit_isotonic(score, good.double(), weight, min_share=min_share, ends=ends),
        expected_error=fit_isotonic(score, loss, weight, rising=False, min_share=min_share, ends=ends),
        sigmoid=fit_platt(score, good, weight),
        sigma=fit_sigma_model(scenes),
        thresholds={percent: choose(scenes, percent / 100).threshold for percent in targets},
        provenance=note,
    )


def fit_sigma_model(scenes: Sequence[Points]) -> SigmaModel | None:
    """Sigma correction after which 68 % of the answers lie within one sigma and at least 91 % within two.

    Scenes have the same weight. For every floor the scale follows from the 68 %; of all these pairs the one with the
    largest likelihood of the errors is taken (Student's t with three degrees of freedom, robust to gross errors). If
    fewer than 91 % then lie within two sigmas, scale and floor are widened until they do.

    Returns:
        SigmaModel; None if no sigma is stated.
    """
    errors, sigmas, weights = [], [], []
    for scene in scenes:
        answered = scene.answered()
        stated = answered.sigma.isfinite() & (answered.sigma > 0)
        error = ((answered.depth - answered.true_depth).abs() / answered.depth)[stated]
        errors.append(error)
        sigmas.append((answered.sigma / answered.depth)[stated])
        weights.append(torch.full_like(error, 1 / max(error.numel(), 1)))
    if not sum(e.numel() for e in errors):
        return None
    error, sigma, weight = torch.cat(errors), torch.cat(sigmas), torch.cat(weights)
    best, lowest_cost = SigmaModel(1.0, 0.0), math.inf
    for floor in (0.0, *(1e-4 * 10 ** (k / 10) for k in range(31))):
        within_one = _quantile((error.square() - floor * floor) / sigma.square(), weight, 0.6826894921370859)
        scale = within_one.clamp_min(0).sqrt()
        model = SigmaModel(float(scale), floor)
        spread = model(sigma, torch.ones_like(sigma)).clamp_min(torch.finfo(sigma.dtype).tiny)
        cost = float((weight * (2 * torch.log1p((error / spread).square() / 3) + spread.log())).sum())
        best, lowest_cost = (model, cost) if cost < lowest_cost else (best, lowest_cost)
    spread = best(sigma, torch.ones_like(sigma)).clamp_min(torch.finfo(sigma.dtype).tiny)
    # Less than the 95 % of a normal variable within two sigmas, because errors have heavier tails and a few gross ones
    # would widen every sigma; slightly above 90 %, to hold 90 % in other rooms.
    wider = max(1.0, float(_quantile(error / spread, weight, 0.91)) / 2)
    return SigmaModel(best.scale * wider, best.floor * wider)


def _quantile(x: Tensor, weight: Tensor, share: float) -> Tensor:
    """Weighted quantile: the smallest value with at least the fraction ``share`` of the weight at or below it."""
    order = x.argsort()
    below = weight[order].cumsum(0) / weight.sum()
    k = torch.searchsorted(below, torch.tensor(share, dtype=below.dtype, device=below.device))
    return x[order][k.clamp(max=x.numel() - 1)]
