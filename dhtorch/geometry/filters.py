"""Filters of whole pictures, as sums of shifted copies: every pixel is rounded alike, whatever the batch.

Alphabet: ``x`` (B, C, H, W); ``taps`` weights along one axis, odd in number. Beyond the border its pixels repeat.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry.shapes import check


def separable(x: Tensor, down: Sequence[float], across: Sequence[float]) -> Tensor:
    """Correlation of (B, C, H, W) with ``down`` along the rows' axis and ``across`` along the columns'.

    Raises:
        ValueError: wrong shape, or an even number of taps.

    Gradient: to ``x``.
    """
    sizes = check("separable", x=(x, "B C H W"))
    if len(down) % 2 == 0 or len(across) % 2 == 0:
        raise ValueError(f"separable: {len(down)} and {len(across)} taps, expected odd numbers")
    i, k = len(down) // 2, len(across) // 2
    padded = F.pad(x, (k, k, i, i), mode="replicate")
    rows = _sum([padded[..., t : t + sizes["H"], :] for t in range(len(down))], down)
    return _sum([rows[..., t : t + sizes["W"]] for t in range(len(across))], across)


def gaussian_taps(sigma_px: float, derivative: bool = False) -> list[float]:
    """Weights of a sampled Gaussian of sum 1, or of its derivative, which answers 1 to a slope of 1; sigma 0 is [1]."""
    if not sigma_px >= 0 or (derivative and sigma_px == 0):
        raise ValueError(f"gaussian_taps: sigma_px is {sigma_px}, expected a positive number")
    reach = math.ceil(4 * sigma_px)
    place = range(-reach, reach + 1)
    weight = [math.exp(-0.5 * (p / sigma_px) ** 2) for p in place] if reach else [1.0]
    if not derivative:
        total = sum(weight)
        return [w / total for w in weight]
    slope = [p * w for p, w in zip(place, weight, strict=True)]
    answer = sum([p * v for p, v in zip(place, slope, strict=True)])
    return [v / answer for v in slope]


def gaussian(x: Tensor, sigma_px: float) -> Tensor:
    """Pictures (B, C, H, W) blurred by a Gaussian. Gradient: to ``x``."""
    taps = gaussian_taps(sigma_px)
    return separable(x, taps, taps)


def box(x: Tensor, radius: int) -> Tensor:
    """Mean over squares of ``2 radius + 1`` pixels, (B, C, H, W). Gradient: to ``x``."""
    side = 2 * radius + 1
    return separable(x, [1 / side] * side, [1 / side] * side)


def _sum(parts: Sequence[Tensor], taps: Sequence[float]) -> Tensor:
    total = parts[0] * taps[0]
    for part, weight in zip(parts[1:], taps[1:], strict=True):
        total = total + part * weight
    return total
