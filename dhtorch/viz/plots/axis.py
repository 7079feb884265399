"""Axis: value -> position in [0, 1], and round tick values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

OptionalNumbers = Sequence[float | None]


@dataclass(frozen=True)
class Axis:
    """Range of values, linear or logarithmic, with its label."""

    low: float
    high: float
    label: str = ""
    log: bool = False
    percent: bool = False

    def place(self, x: float) -> float:
        """Value -> position in [0, 1], clamped."""
        low, high = (math.log(self.low), math.log(self.high)) if self.log else (self.low, self.high)
        at = math.log(max(x, self.low)) if self.log else x
        return min(1.0, max(0.0, (at - low) / (high - low)))

    def ticks(self, most: int = 5) -> list[float]:
        """About ``most`` round values within the range."""
        if self.log and len(self._in_decades(range(1, 10))) > 1:
            sets = (range(1, 10), (1, 2, 3, 5), (1, 2, 5), (1, 3), (1,))
            values = next(
                (t for steps in sets if len(t := self._in_decades(steps)) <= most + 1), self._in_decades((1,))
            )
            return values[:: math.ceil(len(values) / (most + 1))]
        raw_step = (self.high - self.low) / most
        decade = 10.0 ** math.floor(math.log10(raw_step))
        step = next(decade * s for s in (1, 2, 5, 10) if decade * s >= raw_step * 0.999)
        first = math.ceil(self.low / step - 1e-9)
        return [k * step for k in range(first, math.floor(self.high / step + 1e-9) + 1)]

    def _in_decades(self, steps: Sequence[int]) -> list[float]:
        """Multiples ``steps`` of the powers of ten, within the range."""
        decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        values = (s * 10.0**d for d in decades for s in steps)
        return [t for t in values if self.low * 0.999 <= t <= self.high * 1.001]

    def write(self, tick: float) -> str:
        """Tick value -> text."""
        return f"{100 * tick:.4g}" if self.percent else f"{tick:.4g}"


def fit_axis(values: OptionalNumbers, label: str, *, log: bool = False, percent: bool = False, **ends: float) -> Axis:
    """Axis that contains all values; ``low`` and ``high`` fix an end, ``floor`` and ``cap`` bound it."""
    finite = [v for v in values if v is not None and (not log or v > 0)]
    low, high = (min(finite), max(finite)) if finite else (0.1 if log else 0.0, 1.0)
    low, high = max(low, ends.get("floor", low)), min(high, ends.get("cap", high))
    pad = 1.15 if log else 0.06 * (high - low)
    low, high = (low / pad, high * pad) if log else (low - pad, high + pad)
    low, high = ends.get("low", low), ends.get("high", high)
    if not high > low or (log and high < 1.5 * low):
        low, high = (low / 1.5, low * 2) if log else (low - 0.5, low + 0.5)
    return Axis(low, high, label, log, percent)
