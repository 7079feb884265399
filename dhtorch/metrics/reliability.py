"""Reliability of a score as a probability: claimed against realised fraction of good answers.

An answer is *good* if its relative error is below 10 %. Every scene has the same weight, however many answers it has.
"""

from collections.abc import Iterator, Mapping, Sequence

import torch
from torch import Tensor

from dhtorch.geometry.checks import check
from dhtorch.metrics.bootstrap import Interval, interval_of_statistic
from dhtorch.metrics.errors import GOOD_ERROR_REL, MetricValues, Points
from dhtorch.pytree import Record, record


@record
class ReliabilityDiagram(Record):
    """A reliability diagram, bin by bin; an empty bin has weight 0 and NaN for the rest."""

    claimed: Tensor  # (bins,) mean claimed probability
    realised: Tensor  # (bins,) fraction of good answers
    weight: Tensor  # (bins,) fraction of the total weight

    @property
    def ece(self) -> float | None:
        """Expected calibration error: mean gap between claimed and realised, by weight; None without answers."""
        if not bool((self.weight > 0).any()):
            return None
        return float((self.weight * (self.claimed - self.realised).abs()).nansum())


def reliability_diagram(
    claimed: Tensor,  # (n,) in [0, 1]
    good: Tensor,  # (n,) bool
    weight: Tensor | None = None,  # (n,) ≥ 0
    *,
    bins: int = 10,
    equal_mass: bool = False,
) -> ReliabilityDiagram:
    """Reliability diagram: mean claimed probability and realised fraction of good answers, in bins.

    Args:
        claimed: probability of a good answer; values outside [0, 1] are clipped.
        good: whether the answer was good.
        weight: of each answer; None = equal.
        bins: number of bins.
        equal_mass: bins of equal weight instead of equal width; equal claims always share a bin.

    Raises:
        ValueError: unequal lengths, or fewer than one bin.

    Source: C. Guo et al., "On calibration of modern neural networks", 2017.
    """
    check("reliability", claimed=(claimed, "n"), good=(good, "n"), weight=(weight, "n"))
    if bins < 1:
        raise ValueError(f"reliability: found bins={bins}, expected at least 1")
    claimed = claimed.double().clamp(0, 1)
    weight = torch.ones_like(claimed) if weight is None else weight.double()
    position = claimed
    if equal_mass:  # fraction of the weight below each claim, plus half the weight of its equals
        order = claimed.argsort(stable=True)
        _, group, size = claimed[order].unique_consecutive(return_inverse=True, return_counts=True)
        mass = torch.zeros(size.numel()).to(claimed).index_add(0, group, weight[order])
        middle = (mass.cumsum(0) - mass / 2) / mass.sum().clamp_min(torch.finfo(mass.dtype).tiny)
        position = torch.zeros_like(claimed).index_copy(0, order, middle[group])
    index = (position * bins).long().clamp(max=bins - 1)

    def total(x: Tensor) -> Tensor:
        return torch.zeros(bins, dtype=torch.float64, device=claimed.device).index_add(0, index, x)

    mass = total(weight)
    return ReliabilityDiagram(
        claimed=total(weight * claimed) / mass,
        realised=total(weight * good.double()) / mass,
        weight=mass / mass.sum().clamp_min(torch.finfo(torch.float64).tiny),
    )


def excess_ece(scene: Points, *, bins: int = 10, draws: int = 200, seed: int = 0) -> float | None:
    """Expected calibration error of one scene in excess of that by chance; None without answers.

    The calibration error over ``bins`` of equal mass, minus its mean over ``draws`` draws in which every answer is good
    with exactly its claimed probability, and at least 0: the error of few answers scatters.

    Args:
        scene: candidates whose score is a probability of a good answer.
    """
    answered = scene.answered()
    if not len(answered.score):
        return None
    claimed = answered.score.double().clamp(0, 1)
    ece = reliability_diagram(claimed, answered.error < GOOD_ERROR_REL, bins=bins, equal_mass=True).ece
    g = torch.Generator().manual_seed(seed)
    expected = 0.0
    for _ in range(draws):
        good = torch.rand(len(claimed), generator=g, dtype=torch.float64) < claimed
        expected += (reliability_diagram(claimed, good, bins=bins, equal_mass=True).ece or 0.0) / draws
    return max(0.0, (ece or 0.0) - expected)


def pool_answers(scenes: Sequence[Points]) -> tuple[Tensor, Tensor, Tensor]:
    """Claimed probability, good and weight (n,) of the answers of several scenes, each scene of total weight 1."""
    answers = [scene.answered() for scene in scenes]
    if not answers:
        empty = torch.zeros(0, dtype=torch.float64)
        return empty, empty.bool(), empty
    return (
        torch.cat([a.score for a in answers]),
        torch.cat([a.error < GOOD_ERROR_REL for a in answers]),
        torch.cat([torch.full_like(a.score, 1 / max(a.score.numel(), 1)) for a in answers]),
    )


def measure_reliability(scenes: Sequence[Points], *, bins: int = 10) -> MetricValues:
    """``ece`` (bins of equal width) and ``ece_equal_mass`` of one or several scenes; None without answers."""
    pooled = pool_answers(scenes)
    return {
        "ece": reliability_diagram(*pooled, bins=bins).ece,
        "ece_equal_mass": reliability_diagram(*pooled, bins=bins, equal_mass=True).ece,
    }


def ece_interval(scenes: Sequence[Points], *, bins: int = 10, draws: int = 2000, seed: int = 0) -> Interval:
    """``ece`` (bins of equal width) with its interval over scenes; scenes without answers are ignored."""
    tables = [reliability_diagram(*pool_answers([s]), bins=bins) for s in scenes if bool(s.keep.any())]
    if not tables:
        return Interval(None, None, None, 0)
    gaps = torch.stack([(t.weight * (t.claimed - t.realised)).nan_to_num() for t in tables])

    def ece(index: Tensor) -> Tensor:
        return gaps[index].mean(1).abs().sum(-1)

    return interval_of_statistic(ece, len(tables), draws=draws, seed=seed)


def leave_one_room_out(
    scenes: Mapping[str, Points], rooms: Mapping[str, str] | None = None
) -> Iterator[tuple[dict[str, Points], dict[str, Points]]]:
    """Folds (scenes of the other rooms, scenes of this room), each by name: fit on the first, test on the second.

    Pieces of one room share walls, light and camera, so a fit on one of them must not be tested on another.

    Args:
        scenes: by name.
        rooms: scene → room; a scene without an entry is a room of its own.
    """
    room = {name: (rooms or {}).get(name, name) for name in scenes}
    for left_out in dict.fromkeys(room.values()):
        others = {name: s for name, s in scenes.items() if room[name] != left_out}
        yield others, {name: s for name, s in scenes.items() if room[name] == left_out}
