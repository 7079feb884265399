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
    thresholds, loss, answered, sizes = _accepted_losses(scenes, target)
    risk, n = loss / sizes, len(loss)
    needed = scenes_needed(target, confidence=confidence)
    # The loss does not rise with the threshold, nor do its bounds: every threshold above a feasible one is feasible.
    if confidence is None:
        bound = (risk.sum(0) + 1) / (n + 1)
        fits = bound <= target
    else:
        bound = torch.full_like(thresholds, 1 - confidence)
        # The largest mean loss whose p-value is small enough, up to rounding and never above.
        low, high = 0.0, target
        for _ in range(60):
            middle = (low + high) / 2
            small = _hoeffding_bentkus_p_value(middle, n, target) <= 1 - confidence
            low, high = (middle, high) if small else (low, middle)
        possible = _hoeffding_bentkus_p_value(0.0, n, target) <= 1 - confidence
        fits = possible & (risk.sum(0) / max(n, 1) <= low)
    fits = fits & (n >= needed)
    return _lowest_feasible(
        thresholds, fits, bound, risk, answered / sizes, target=target, needed=needed, confidence=confidence
    )


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
    if mean >= target:
        return 1.0
    divergence = (1 - mean) * math.log((1 - mean) / (1 - target))
    divergence += mean * math.log(mean / target) if mean > 0 else 0.0
    # P(X ≤ k) of a binomial, summed from logarithms
    k = math.ceil(n * mean - 1e-9)
    whole, log, log_1 = math.lgamma(n + 1), math.log(target), math.log1p(-target)
    terms = (whole - math.lgamma(i + 1) - math.lgamma(n - i + 1) + i * log + (n - i) * log_1 for i in range(k + 1))
    tail = 1.0 if k >= n else min(1.0, math.fsum(math.exp(t) for t in terms))
    return min(1.0, math.exp(-n * divergence), math.e * tail)


def _accepted_losses(scenes: Sequence[Points], target: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Distinct scores of all answers, rising (T,): all of them, or 4096 evenly spaced ones if they are more. Of the S
    scenes with candidates the sum of the capped errors of the answers accepted at each (S, T), their number (S, T), and
    the number of candidates (S, 1)."""
    _check_probability("target", target)
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


def _check_probability(name: str, value: float) -> None:
    if not 0 < value < 1:
        raise ValueError(f"control.{name}: found {value}, expected a number between 0 and 1")
