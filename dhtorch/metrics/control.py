"""Score thresholds that keep the error below a target: plug-in, scene-quantile and conformal risk control.

*Plug-in* bounds the mean error of the answers on the scenes given, plus one standard error; it has no guarantee for
another scene. *Scene quantile* requires the same of nine scenes in ten, each by itself, instead of their mean.
*Conformal* has a guarantee: if all scenes, the next one included, are exchangeable, the loss of the next scene meets
the target. Its loss is per candidate, capped error × answered / candidates, because it must not rise when less is
answered. The guarantee requires a minimum number of scenes, stated in ``ScoreThreshold.needed``.

All need only scores, answers and truth, so any depth source will do; ``errors.make_points`` joins arrays to a scene.
The unit is the scene: points of one scene share its truth and its poses and are not independent. Pieces of one room
are not exchangeable scenes: join them to one first (``dhtorch.pytree.collate``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import torch
from torch import Tensor

from dhtorch.metrics.errors import Points
from dhtorch.metrics.risk import cap_error

#: Fewest scenes from which the spread of their risks is estimated.
_MIN_SCENES_FOR_SPREAD = 5

#: Largest number of thresholds tried; of more distinct scores, evenly spaced ones are used.
_MAX_THRESHOLDS = 4096


@dataclass(frozen=True)
class ScoreThreshold:
    """A score threshold, with its risk and coverage on the scenes it was chosen on."""

    threshold: float | None  # answer where score ≥ threshold; None = answer nothing
    target: float
    bound: float | None  # the value compared with the target, at the threshold
    risk: float  # mean over the scenes of the control's risk, at the threshold
    coverage: float  # mean over the scenes of answered / candidates, at the threshold
    n: int  # scenes it was chosen on
    needed: int | None = None  # fewest scenes with which a threshold can meet the target; None = no such limit
    confidence: float | None = None

    @property
    def why(self) -> str:
        """The result as a sentence."""
        if self.needed is not None and self.n < self.needed:
            return f"{self.n} scenes are too few: a target of {self.target:g} takes at least {self.needed}"
        if self.threshold is None:
            return f"no threshold meets {self.target:g} on these {self.n} scenes"
        return f"score ≥ {self.threshold:.4g} answers {self.coverage:.1%} of the candidates"


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
    scenes = _check_scenes(scenes, target)
    answers = [_sort_losses(scene) for scene in scenes]
    thresholds = _candidate_thresholds(answers)
    loss, answered = _accepted_losses(answers, thresholds)
    risk = loss / answered.clamp_min(1)
    coverage = answered / _candidate_counts(scenes)
    n = len(scenes)
    mean = risk.sum(0) / max(n, 1)
    variance = (risk - mean).square().sum(0) / (n - 1) if n > 1 else torch.full_like(thresholds, torch.inf)
    bound = mean + (variance / max(n, 1)).sqrt()
    return _lowest_feasible(thresholds, bound <= target, bound, risk, coverage, target=target)


def scene_quantile_threshold(
    scenes: Sequence[Points], target: float, *, share: float = 0.9, few: int = 0
) -> ScoreThreshold:
    """Threshold of the largest coverage at which the fraction ``share`` of the scenes meets the target, each by itself.

    A mean over scenes may meet the target although half of the scenes do not. Here, of n scenes share · (n + 1),
    rounded up, must meet it, so that of n + 1 exchangeable ones the fraction ``share`` does. Where that is more than n,
    all n must, and the bound from their spread as well: mean + t · s · √(1 + 1/n), which the risk of one more scene
    exceeds with probability 1 − share if the risks are normal. With fewer than :data:`_MIN_SCENES_FOR_SPREAD` scenes
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
    scenes = _check_scenes(scenes, target)
    answers = [_sort_losses(scene) for scene in scenes]
    thresholds = _candidate_thresholds(answers)
    loss, answered = _accepted_losses(answers, thresholds)
    risk = loss / answered.clamp_min(1)
    kept = ((risk <= target) | (answered < few)).to(risk.dtype).mean(0)
    needed = math.ceil(share * (len(scenes) + 1) - 1e-9)
    fits = kept * len(scenes) >= min(needed, len(scenes)) - 1e-6
    if needed > len(scenes) >= _MIN_SCENES_FOR_SPREAD and share < 1:
        fits = fits & (_next_scene_bound(risk, answered >= max(few, 1), share) <= target)
    return _lowest_feasible(thresholds, fits, kept, risk, answered / _candidate_counts(scenes), target=target)


def conformal_threshold(scenes: Sequence[Points], target: float, *, confidence: float | None = None) -> ScoreThreshold:
    """Threshold at which the loss of the next scene meets the target, if scenes are exchangeable.

    The loss of a scene is the sum of the capped errors of its answers over the number of its candidates: between 0
    and 1, and never larger at a higher threshold. In expectation: n / (n + 1) · (mean loss) + 1 / (n + 1) ≤ target.
    With a confidence: the Hoeffding–Bentkus p-value of "the expected loss exceeds the target" is at most
    1 − confidence, here and at every higher threshold.

    Args:
        scenes: candidates with scores, one entry a scene; scenes without candidates are ignored.
        target: loss allowed, in (0, 1).
        confidence: None guarantees E(loss of the next scene) ≤ target, over the scenes here and the next one; a
            number in (0, 1) is the probability with which the expected loss at the threshold is at most the target.

    Returns:
        ScoreThreshold with ``needed`` = 1 / target − 1, or ln(1 − confidence) / ln(1 − target), rounded up; no
        threshold with fewer scenes. Its ``bound`` is the left side of the inequality, or the limit of the p-value.

    Raises:
        ValueError: a target or confidence outside (0, 1).

    Source: A. Angelopoulos et al., "Conformal risk control", 2024; S. Bates et al., "Distribution-free,
    risk-controlling prediction sets", 2021 (with confidence).
    """
    scenes = _check_scenes(scenes, target)
    answers = [_sort_losses(scene) for scene in scenes]
    thresholds = _candidate_thresholds(answers)
    loss, answered = _accepted_losses(answers, thresholds)
    sizes, n = _candidate_counts(scenes), len(scenes)
    risk = loss / sizes
    needed = scenes_needed(target, confidence=confidence)
    # The loss does not rise with the threshold, nor do its bounds: every threshold above a feasible one is feasible.
    if confidence is None:
        bound = (risk.sum(0) + 1) / (n + 1)
        fits = bound <= target
    else:
        bound = torch.full_like(thresholds, 1 - confidence)
        fits = risk.sum(0) / max(n, 1) <= _largest_mean(n, target, 1 - confidence)
    fits = fits & (n >= needed)
    return _lowest_feasible(
        thresholds, fits, bound, risk, answered / sizes, target=target, needed=needed, confidence=confidence
    )


def _next_scene_bound(risk: Tensor, counted: Tensor, share: float) -> Tensor:
    """Risk (thresholds,) that one more scene stays below with probability ``share``, for normal risks.

    Estimated from the ``counted`` (scenes, thresholds); infinite with fewer than two.
    """
    n = counted.sum(0)
    mean = torch.where(counted, risk, 0.0).sum(0) / n.clamp_min(1)
    variance = torch.where(counted, (risk - mean).square(), 0.0).sum(0) / (n - 1).clamp_min(1)
    z = NormalDist().inv_cdf(share)
    freedom = (n - 1).clamp_min(1)
    # Student's t by its expansion around the normal quantile (Abramowitz and Stegun 1964, 26.7.5)
    t = z + (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom.square())
    return torch.where(n > 1, mean + t * (variance * (1 + 1 / n.clamp_min(1))).sqrt(), torch.inf)


def scenes_needed(target: float, *, confidence: float | None = None) -> int:
    """Fewest scenes with which :func:`conformal_threshold` can meet a target, if all are without error.

    Raises:
        ValueError: a target or confidence outside (0, 1).
    """
    _check_probability("target", target)
    if confidence is None:
        return math.ceil(1 / target - 1 - 1e-9)
    _check_probability("confidence", confidence)
    return math.ceil(math.log(1 - confidence) / math.log(1 - target) - 1e-9)


def _hoeffding_bentkus_p_value(mean: float, n: int, target: float) -> float:
    """Hoeffding–Bentkus p-value of "the expected loss exceeds ``target``", from the mean loss of n scenes.

    Losses lie in [0, 1] and are independent.
    """
    if n == 0 or mean >= target:
        return 1.0
    divergence = (1 - mean) * math.log((1 - mean) / (1 - target))
    divergence += mean * math.log(mean / target) if mean > 0 else 0.0
    bentkus = math.e * _binomial_cdf(math.ceil(n * mean - 1e-9), n, target)
    return min(1.0, math.exp(-n * divergence), bentkus)


def _sort_losses(scene: Points) -> tuple[Tensor, Tensor]:
    """Scores of a scene's answers, rising, and the sum of the capped errors of the first 0, 1, … of them."""
    score, order = scene.score[scene.keep].sort()
    loss = cap_error(scene.error[scene.keep])[order]
    return score, torch.cat((loss.new_zeros(1), loss.cumsum(0)))


def _accepted_losses(answers: Sequence[tuple[Tensor, Tensor]], thresholds: Tensor) -> tuple[Tensor, Tensor]:
    """Sum of the capped errors of the accepted answers, and their number: (scenes, thresholds) each."""
    empty = torch.zeros(0, thresholds.numel(), dtype=torch.float64)
    loss, count = [empty], [empty]
    for score, total in answers:
        below = torch.searchsorted(score, thresholds)
        loss.append((total[-1] - total[below])[None])
        count.append((score.numel() - below)[None])
    return torch.cat(loss).clamp_min(0), torch.cat(count)


def _candidate_thresholds(answers: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    """Distinct scores of the answers, rising: all of them, or evenly spaced ones if they are too many."""
    scores = torch.cat([torch.zeros(0, dtype=torch.float64), *(score for score, _ in answers)]).unique()
    if scores.numel() > _MAX_THRESHOLDS:
        scores = scores[torch.linspace(0, scores.numel() - 1, _MAX_THRESHOLDS, dtype=torch.float64).round().long()]
    return scores


def _candidate_counts(scenes: Sequence[Points]) -> Tensor:
    return torch.tensor([s.keep.numel() for s in scenes], dtype=torch.float64)[:, None]


def _lowest_feasible(
    thresholds: Tensor,
    fits: Tensor,
    bound: Tensor,
    risk: Tensor,
    coverage: Tensor,
    *,
    target: float,
    needed: int | None = None,
    confidence: float | None = None,
) -> ScoreThreshold:
    """The lowest feasible threshold, which has the largest coverage; its ``threshold`` is None if none is feasible."""
    n = risk.shape[0]
    infeasible = ScoreThreshold(None, target, None, risk=0.0, coverage=0.0, n=n, needed=needed, confidence=confidence)
    if not bool(fits.any()):
        return infeasible
    k = int(fits.long().argmax())
    return replace(
        infeasible,
        threshold=float(thresholds[k]),
        bound=float(bound[k]),
        risk=float(risk[:, k].mean()),
        coverage=float(coverage[:, k].mean()),
    )


def _check_scenes(scenes: Sequence[Points], target: float) -> list[Points]:
    _check_probability("target", target)
    return [s for s in scenes if s.keep.numel()]


def _check_probability(name: str, value: float) -> None:
    if not 0 < value < 1:
        raise ValueError(f"control.{name}: found {value}, expected a number between 0 and 1")


def _largest_mean(n: int, target: float, level: float) -> float:
    """Largest mean loss whose p-value is at most ``level``, up to rounding and never above; −1 if there is none."""
    if _hoeffding_bentkus_p_value(0.0, n, target) > level:
        return -1.0
    low, high = 0.0, target
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if _hoeffding_bentkus_p_value(middle, n, target) <= level else (low, middle)
    return low


def _binomial_cdf(k: int, n: int, p: float) -> float:
    """P(X ≤ k) of a binomial, summed from logarithms."""
    if k >= n:
        return 1.0
    terms = (
        math.lgamma(n + 1) - math.lgamma(i + 1) - math.lgamma(n - i + 1) + i * math.log(p) + (n - i) * math.log1p(-p)
        for i in range(k + 1)
    )
    return min(1.0, math.fsum(math.exp(t) for t in terms))
