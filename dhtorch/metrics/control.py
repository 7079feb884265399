"""Score thresholds that keep the error below a target: plug-in and scene-quantile risk control.

*Plug-in* bounds the mean error of the answers on the scenes given, plus one standard error; it has no guarantee for
another scene. *Scene quantile* requires the same of nine scenes in ten, each by itself, instead of their mean.
Both need only scores, answers and truth, so any depth source will do; ``errors.make_points`` joins arrays to a scene.
The unit is the scene: points of one scene share its truth and its poses and are not independent. Pieces of one room
are not exchangeable scenes: join them to one first (``dhtorch.pytree.collate``).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import torch
from torch import Tensor

from dhtorch.metrics.errors import Points
from dhtorch.metrics.risk import cap_error


@dataclass(frozen=True)
class ScoreThreshold:
    """A score threshold, with its risk and coverage on the scenes it was chosen on."""

    threshold: float | None  # answer where score ≥ threshold; None = answer nothing
    target: float
    bound: float | None  # the value compared with the target, at the threshold
    risk: float  # mean over the scenes of the control's risk, at the threshold
    coverage: float  # mean over the scenes of answered / candidates, at the threshold
    n: int  # scenes it was chosen on


def plug_in_threshold(scenes: Sequence[Points], target: float) -> ScoreThreshold:
    """Threshold of the largest coverage at which the mean risk over scenes plus one standard error meets the target.

    The risk of a scene is the mean capped error of its answers, 0 without any. There is no guarantee.

    Args:
        scenes: candidates with scores, one entry a scene; scenes without candidates are ignored.
        target: mean capped error allowed, in (0, 1).

    Returns:
        ScoreThreshold; with fewer than two scenes there is no standard error and no threshold.

    Raises:
        ValueError: a target outside (0, 1).
    """
    thresholds, loss, answered, sizes = _accepted_losses(scenes, target)
    risk = loss / answered.clamp_min(1)
    n = len(risk)
    mean = risk.sum(0) / max(n, 1)
    variance = (risk - mean).square().sum(0) / (n - 1) if n > 1 else torch.full_like(thresholds, torch.inf)
    bound = mean + (variance / max(n, 1)).sqrt()
    return _lowest_feasible(thresholds, bound <= target, bound, risk, answered / sizes, target=target)


def scene_quantile_threshold(
    scenes: Sequence[Points], target: float, *, share: float = 0.9, few: int = 0
) -> ScoreThreshold:
    """Threshold of the largest coverage at which the fraction ``share`` of the scenes meets the target, each by itself.

    A mean over scenes may meet the target although half of the scenes do not. Here, of n scenes share · (n + 1),
    rounded up, must meet it, so that of n + 1 exchangeable ones the fraction ``share`` does. Where that is more than n,
    all n must, and the bound from their spread as well: mean + t · s · √(1 + 1/n), which the risk of one more scene
    exceeds with probability 1 − share if the risks are normal. With fewer than five scenes
    no spread is estimated, and it is only required that all meet the target.

    Args:
        scenes: candidates with scores, one entry a scene; scenes without candidates are ignored.
        target: mean capped error allowed of the answers of one scene, in (0, 1).
        share: fraction of the scenes that must meet it, in (0, 1].
        few: a scene with fewer answers above a threshold counts as meeting the target.

    Returns:
        ScoreThreshold; its ``bound`` is the fraction of the scenes that meet the target.

    Raises:
        ValueError: a target outside (0, 1), or a share outside (0, 1].
    """
    if not 0 < share <= 1:
        raise ValueError(f"control.share: found {share}, expected a number above 0, at most 1")
    thresholds, loss, answered, sizes = _accepted_losses(scenes, target)
    risk, n = loss / answered.clamp_min(1), len(loss)
    kept = ((risk <= target) | (answered < few)).to(risk.dtype).mean(0)
    needed = math.ceil(share * (n + 1) - 1e-9)
    fits = kept * n >= min(needed, n) - 1e-6
    if needed > n >= 5 and share < 1:
        counted = answered >= max(few, 1)
        n_counted = counted.sum(0)
        freedom = (n_counted - 1).clamp_min(1)
        mean = torch.where(counted, risk, 0.0).sum(0) / n_counted.clamp_min(1)
        variance = torch.where(counted, (risk - mean).square(), 0.0).sum(0) / freedom
        # Student's t by its expansion around the normal quantile (Abramowitz and Stegun 1964, 26.7.5)
        z = NormalDist().inv_cdf(share)
        t = z + (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom.square())
        bound = mean + t * (variance * (1 + 1 / n_counted.clamp_min(1))).sqrt()
        fits = fits & (n_counted > 1) & (bound <= target)
    return _lowest_feasible(thresholds, fits, kept, risk, answered / sizes, target=target)


def _accepted_losses(scenes: Sequence[Points], target: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Distinct scores of all answers, rising (T,): all of them, or 4096 evenly spaced ones if they are more. Of the S
    scenes with candidates the sum of the capped errors of the answers accepted at each (S, T), their number (S, T), and
    the number of candidates (S, 1)."""
    if not 0 < target < 1:
        raise ValueError(f"control.target: found {target}, expected a number between 0 and 1")
    scenes = [s for s in scenes if s.keep.numel()]
    answers = [(scene.score[scene.keep].sort(), cap_error(scene.error[scene.keep])) for scene in scenes]
    thresholds = torch.cat([torch.zeros(0, dtype=torch.float64), *(score for (score, _), _ in answers)]).unique()
    n = thresholds.numel()
    if n > 4096:
        thresholds = thresholds[torch.linspace(0, n - 1, 4096, dtype=torch.float64).round().long()]
        n = 4096
    loss, count = torch.zeros(len(scenes), n, dtype=torch.float64), torch.zeros(len(scenes), n, dtype=torch.int64)
    for k, ((score, order), error) in enumerate(answers):
        total = torch.cat((error.new_zeros(1), error[order].cumsum(0)))
        below = torch.searchsorted(score, thresholds)
        loss[k], count[k] = total[-1] - total[below], score.numel() - below
    sizes = torch.tensor([s.keep.numel() for s in scenes], dtype=torch.float64)[:, None]
    return thresholds, loss.clamp_min(0), count, sizes


def _lowest_feasible(
    thresholds: Tensor, fits: Tensor, bound: Tensor, risk: Tensor, coverage: Tensor, *, target: float
) -> ScoreThreshold:
    """The lowest feasible threshold, which has the largest coverage; its ``threshold`` is None if none is feasible."""
    n = risk.shape[0]
    if not bool(fits.any()):
        return ScoreThreshold(None, target, None, risk=0.0, coverage=0.0, n=n)
    k = int(fits.long().argmax())
    means = float(risk[:, k].mean()), float(coverage[:, k].mean())
    return ScoreThreshold(float(thresholds[k]), target, float(bound[k]), *means, n=n)
