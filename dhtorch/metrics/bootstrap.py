"""Bootstrap intervals of a statistic over scenes: scenes are resampled, never points.

Points of one scene share its truth, its camera and its poses; treated as independent they would give an interval many
times too narrow.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

#: Statistics that combine the values of scenes (draws, n), by name; the geometric mean is for ratios.
_STATISTICS: dict[str, Callable[[Tensor], Tensor]] = {
    "median": lambda x: x.sort(-1).values[:, [(x.shape[-1] - 1) // 2, x.shape[-1] // 2]].sum(-1) / 2,
    "mean": lambda x: x.mean(-1),
    "geometric_mean": lambda x: x.log().mean(-1).exp(),
}


class Interval(NamedTuple):
    """A statistic over scenes with its interval; None where undefined."""

    value: float | None
    low: float | None
    high: float | None
    n: int  # number of scenes in which the value is defined

    def entry(self, unit: str = "1") -> dict[str, Any]:
        """The interval as an entry of a result's summary: ``{value, low, high, n, unit}``."""
        return {**self._asdict(), "unit": unit}


def without_interval(value: float | None, n: int, unit: str = "1") -> dict[str, Any]:
    """Summary entry of a value over n scenes without an interval."""
    return Interval(value, None, None, n).entry(unit)


def interval_over_scenes(
    values: Sequence[float | None],
    *,
    statistic: str = "median",
    level: float = 0.95,
    draws: int = 2000,
    seed: int = 0,
) -> Interval:
    """Median, mean or geometric mean over scenes with its percentile bootstrap interval.

    Args:
        values: one number a scene; None and non-finite ones are undefined and left out.
        statistic: ``median``, ``mean`` or ``geometric_mean`` (of positive numbers).
        level: probability content of the interval.
        draws: resamples.
        seed: of the resamples; the same seed gives the same interval.

    Returns:
        Interval. One scene has a value but no interval.

    Raises:
        ValueError: another statistic, or a level outside (0, 1).

    Source: B. Efron, "Bootstrap methods: another look at the jackknife", 1979.
    """
    if statistic not in _STATISTICS:
        raise ValueError(f"bootstrap.statistic: found {statistic!r}, expected one of {', '.join(_STATISTICS)}")
    defined = torch.tensor([v for v in values if v is not None and math.isfinite(v)], dtype=torch.float64)
    reduce = _STATISTICS[statistic]
    return interval_of_statistic(
        lambda index: reduce(defined[index]), defined.numel(), level=level, draws=draws, seed=seed
    )


def interval_of_statistic(
    number: Callable[[Tensor], Tensor],
    n: int,
    *,
    level: float = 0.95,
    draws: int = 2000,
    seed: int = 0,
) -> Interval:
    """Value of any statistic of n scenes, with its percentile bootstrap interval.

    Args:
        number: the statistic: indices of scenes (draws, n), each row one resample → its value for each row (draws,),
            NaN where undefined.
        n: number of scenes.
        level, draws, seed: as for :func:`interval_over_scenes`.

    Returns:
        Interval; draws in which the statistic is undefined are left out of it.

    Raises:
        ValueError: a level outside (0, 1).
    """
    if not 0 < level < 1:
        raise ValueError(f"bootstrap.level: found {level}, expected a number between 0 and 1")
    value = float(number(torch.arange(n)[None])[0]) if n else math.nan
    if not math.isfinite(value):
        return Interval(None, None, None, n)
    if n == 1:
        return Interval(value, None, None, 1)
    resampled = number(resample_scenes(n, draws, seed=seed)).double()
    edges = torch.tensor([(1 - level) / 2, (1 + level) / 2], dtype=torch.float64)
    low, high = torch.nanquantile(resampled, edges).tolist()
    return Interval(value, low, high, n)


def resample_scenes(n: int, draws: int, *, seed: int = 0) -> Tensor:
    """Indices (draws, n) of scenes drawn with replacement, for statistics other than a mean or median of values."""
    return torch.randint(n, (draws, n), generator=torch.Generator().manual_seed(seed))
