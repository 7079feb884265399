"""Risk–coverage evaluation of a score: error of the accepted answers as more of them are accepted.

Answers are taken in the order of falling score; the *risk* at k is the mean loss of the first k, where the loss is the
relative error, at most 1. Answers of equal score are indistinguishable, so each counts as the mean of its group: the
curve is then the expectation over all orders of the tied answers and does not depend on their order in the list.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from dhtorch.geometry.checks import check
from dhtorch.metrics.errors import MetricValues, Points


def risk_curve(
    loss: Tensor,  # (n,)
    score: Tensor,  # (n,)
) -> Tensor:
    """Risk (n,) of the surest 1, 2, … n answers: running mean of the loss by falling score, ties by their mean.

    Any numbers that order the answers are a score; infinities are allowed. Computed in float64.

    Raises:
        ValueError: unequal lengths.
    """
    return _running_sum(loss, score) / _running_count(loss)


def risk_coverage(pooled: Points, *, oracle: bool = False) -> tuple[Tensor, Tensor]:
    """Coverage (fraction of the candidates) and risk (n,) as the answers are accepted by falling score.

    Args:
        pooled: candidates of a pair or scene.
        oracle: by rising error instead, the best possible order.
    """
    answered = pooled.answered()
    loss = cap_error(answered.error)
    return _running_count(loss) / max(pooled.keep.numel(), 1), risk_curve(loss, -loss if oracle else answered.score)


def measure_risk(pooled: Points, *, min_points: int = 10) -> MetricValues:
    """Risk metrics of a pair or scene: how well its score orders the answers by error.

    Returns:
        ``aurc``: mean of the risk over the answered candidates. ``aurc_excess``: the same minus that of the
        best possible order. ``aurc_full``: over all candidates, unanswered ones last with loss 1. ``augrc``: mean over
        the answered candidates of their running *sum* of loss over their number (an early error is not counted over
        and over). ``coverage_at_5``, ``_10``, ``_20``: largest fraction of the candidates, at least ``min_points``,
        that a threshold on the score can accept at a risk of at most 5, 10, 20 %; 0 if there is none.
        ``monotonicity``: fraction of the nine steps between the tenths of the answers over which the risk does not
        fall. ``largest_fall``: the most that the risk falls from one of these tenths to a later one, 0 for a curve that
        never falls. None where undefined (no candidate; for all but ``aurc_full`` and the coverages also no answer; for
        the last two fewer than ten).

    Source: J. Traub et al., "Overcoming common flaws in the evaluation of selective classification systems", 2024
    (AUGRC); Y. Geifman, G. Uziel, R. El-Yaniv, "Bias-reduced uncertainty estimation", 2019 (excess AURC); A. Shah et
    al., "Selective regression under fairness criteria", 2022 (a risk that should fall whenever less is answered; the
    two numbers for how nearly it does are ours).
    """
    n = pooled.keep.numel()
    answered = pooled.answered()
    loss, score = cap_error(answered.error), answered.score
    risk = risk_curve(loss, score)
    has_answers = bool(risk.numel())
    last = torch.where(pooled.keep, pooled.score, -torch.inf)
    full = risk_curve(torch.where(pooled.keep, cap_error(pooled.error), 1.0), last)
    numbers: MetricValues = {
        "aurc": _mean(risk),
        "aurc_excess": _mean(risk - risk_curve(loss, -loss)),
        "aurc_full": _mean(full),
        "augrc": _mean(_running_sum(loss, score) / max(loss.numel(), 1)),
    }
    # By falling score: a threshold can lie after an answer where the next score is smaller.
    ordered = score.sort(descending=True).values
    cuts = torch.cat((ordered[1:] < ordered[:-1], ordered.new_ones(min(1, ordered.numel()), dtype=torch.bool)))
    for percent in (5, 10, 20):
        fits = cuts & (risk <= percent / 100) & (_running_count(loss) >= min_points)
        n_accepted = int(torch.where(fits, _running_count(loss), 0).max()) if has_answers else 0
        numbers[f"coverage_at_{percent}"] = n_accepted / n if n else None
    numbers |= {"monotonicity": None, "largest_fall": None}
    if len(risk) >= 10:
        tenths = risk[torch.tensor([len(risk) * k // 10 - 1 for k in range(1, 11)], device=risk.device)]
        numbers["monotonicity"] = float((tenths.diff() >= -1e-12).double().mean())
        numbers["largest_fall"] = float((tenths.cummax(0).values - tenths).max())
    return numbers


def ause(pooled: Points) -> float | None:
    """Area between the sparsification curves of the score and of the true errors, over that of a random order.

    The curve is the mean capped error of the remaining answers when the worst-scored 0, 1, … 95 % are removed; with a
    random order it is constant. 0 is a perfect order, 1 no better than chance; None where undefined.

    Source: E. Ilg et al., "Uncertainty estimates and multi-hypotheses networks for optical flow", 2018.
    """
    answered = pooled.answered()
    loss = cap_error(answered.error)
    n = answered.keep.numel()
    if not n:
        return None
    rank = torch.tensor([max(round(n * (100 - k) / 100), 1) - 1 for k in range(96)], device=loss.device)
    best = risk_curve(loss, -loss)[rank].mean()
    chance = loss.mean() - best
    return float((risk_curve(loss, answered.score)[rank].mean() - best) / chance) if float(chance) > 0 else None


def realised_risk(pooled: Points, threshold: float | None) -> float | None:
    """Mean capped error of the answers that score at least ``threshold`` (None = no answers); None without any."""
    accepted = pooled.keep & (pooled.score >= (torch.inf if threshold is None else threshold))
    return _mean(cap_error(pooled.error[accepted]))


def keep_surest(pooled: Points, n: int) -> Points:
    """The same candidates with only the ``n`` highest-scoring answers kept, to compare methods at equal coverage.

    Where the cut falls among answers of equal score, the kept ones are spread evenly over the group's errors: their
    median and mean are those of the group, whatever the order of the list.
    """
    answered = pooled.keep.nonzero()[:, 0]
    if n >= answered.numel():
        return pooled
    keep = torch.zeros_like(pooled.keep)
    if n > 0:
        score = pooled.score[answered]
        limit = score.sort(descending=True).values[n - 1]
        keep[answered[score > limit]] = True
        tied = answered[score == limit]
        tied = tied[pooled.error[tied].argsort(stable=True)]
        n_tied = n - int(keep.sum())
        keep[tied[(torch.arange(n_tied, device=tied.device) * 2 + 1) * tied.numel() // (2 * n_tied)]] = True
    return pooled.replace(
        keep=keep,
        depth=torch.where(keep, pooled.depth, torch.nan),
        sigma=torch.where(keep, pooled.sigma, torch.nan),
        residual_px=torch.where(keep, pooled.residual_px, torch.nan),
        score=torch.where(keep, pooled.score, 0.0),
    )


def find_knee(coverage: Sequence[float], risk: Sequence[float]) -> int | None:
    """Index of the knee of a risk–coverage curve: the point farthest below the chord between its two ends.

    Both axes are scaled to the ends of the coverage and to the range of the risk, so that the knee does not depend on
    units. Below the knee the risk hardly falls as less is answered. None: fewer than three points, or no point is below
    the chord by more than a hundredth of the range of the risk, as of a straight line.

    Source: V. Satopaa et al., "Finding a 'kneedle' in a haystack", 2011 (largest distance to the chord of the
    normalised curve).
    """
    ends = sorted(range(len(coverage)), key=lambda k: coverage[k])
    if len(ends) < 3:
        return None
    first, last = ends[0], ends[-1]
    width, height = coverage[last] - coverage[first], max(risk) - min(risk)
    if not (width > 0 and height > 0):
        return None
    slope = (risk[last] - risk[first]) / width
    below = [risk[first] + slope * (c - coverage[first]) - r for c, r in zip(coverage, risk, strict=True)]
    deepest = max(range(len(below)), key=below.__getitem__)
    return deepest if below[deepest] > 0.01 * height else None


def cap_error(error: Tensor) -> Tensor:
    """Loss of a relative error: the error itself, at most 1; 1 where it is NaN."""
    return error.nan_to_num(nan=1.0).clamp(max=1.0)


def _running_sum(loss: Tensor, score: Tensor) -> Tensor:
    check("risk_curve", loss=(loss, "n"), score=(score, "n"))
    order = score.argsort(descending=True, stable=True)
    _, group, size = score[order].unique_consecutive(return_inverse=True, return_counts=True)
    total = torch.zeros(size.numel(), dtype=torch.float64, device=loss.device)
    total = total.index_add(0, group, loss[order].double())
    return (total / size)[group].cumsum(0)


def _running_count(loss: Tensor) -> Tensor:
    return torch.arange(1, loss.numel() + 1, dtype=torch.float64, device=loss.device)


def _mean(x: Tensor) -> float | None:
    return float(x.mean()) if x.numel() else None
