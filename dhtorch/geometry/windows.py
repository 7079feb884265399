"""Window filters: maps (B, h, w) -> sums, extremes, ranges and edge-preserving means of the window of every pixel.

Alphabet: maps (B, h, w); a window of *radius* r has (2 r + 1)² pixels. Beyond the border its pixels repeat.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from dhtorch.ops.dispatch import operator, run_kernel

#: Largest number of pixels that are processed at once: few enough to stay in the cache and to need no fresh memory.
#: Source: derived, fits the L2/L3 cache.
MAX_BAND_PIXELS = 1 << 17


def row_bands(image: Tensor, hw: tuple[int, ...]) -> list[slice]:
    """Image (B, ...) and map size -> slices of rows to process at once; a single one under a gradient or a compiler,
    where each would add to the graph."""
    h, w = hw
    whole = torch.compiler.is_compiling() or (image.requires_grad and torch.is_grad_enabled())
    rows = h if whole else max(MAX_BAND_PIXELS // max(len(image) * w, 1), 1)
    return [slice(top, min(top + rows, h)) for top in range(0, h, rows)]


def window_sum(x: Tensor, radius: int) -> Tensor:
    """Map (B, h, w) -> sums of the (2 radius + 1)² pixels around each, the border repeated outside. Gradient: to x."""
    for dim in (1, 2):
        n, side = x.shape[dim], 2 * radius + 1
        first, last = (x.narrow(dim, k, 1) for k in (0, n - 1))
        partial = torch.cat([first] * radius + [x] + [last] * radius, dim)  # sums of 1, 2, 4, … neighbours
        x, width, start = partial.narrow(dim, 0, n), 1, 1
        while 2 * width <= side:
            length = partial.shape[dim] - width
            partial = partial.narrow(dim, 0, length) + partial.narrow(dim, width, length)
            width *= 2
            if side & width:
                x = x + partial.narrow(dim, start, n)
                start += width
    return x


def window_extreme(x: Tensor, radius: int, pick: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Map (B, h, w) -> extreme of the window around each pixel; ``pick`` is torch.maximum or torch.minimum.

    Computed from two windows half as wide, recursively. Gradient: to x."""
    for dim in (1, 2):
        first, last = (x.narrow(dim, k, 1) for k in (0, x.shape[dim] - 1))
        x, width = torch.cat([first] * radius + [x] + [last] * radius, dim), 1
        while width < 2 * radius + 1:
            shift = min(width, 2 * radius + 1 - width)
            length = x.shape[dim] - shift
            x, width = pick(x.narrow(dim, 0, length), x.narrow(dim, shift, length)), width + shift
    return x


def window_range(q: Tensor, radius: int) -> Tensor:
    """Map (B, h, w) -> largest minus smallest value in the window around each pixel. Gradient: none."""
    q = q.detach()
    return window_extreme(q, radius, torch.maximum) - window_extreme(q, radius, torch.minimum)


@operator(
    kernel=lambda q, tolerance, radius=4: run_kernel(
        "smooth_within_tolerance", (q, tolerance), torch.empty_like(q), radius
    ),
    dtypes={"q": torch.float32, "tolerance": torch.float32},
)
def smooth_within_tolerance(q: Tensor, tolerance: Tensor, *, radius: int = 4) -> Tensor:
    """Inverse depths q (B, h, w) -> smoothed along columns, then rows, over values within ``tolerance`` (B,) 1/m.

    Each value becomes the mean of those up to ``radius`` away that differ by no more than the tolerance: planes and
    edges are preserved. A fit of windows is blind to the scatter of inverse depth within a window, so the map must be
    smooth there. Gradient: to q.
    """
    limit = tolerance[:, None, None]
    for dim in (1, 2):
        n = q.shape[dim]
        reach = min(radius, n - 1)
        border = torch.full_like(q.narrow(dim, 0, reach), torch.inf)
        padded = torch.cat([border, q, border], dim)
        total, count = q, torch.zeros_like(q, dtype=torch.int16)
        for k in range(1, reach + 1):
            # planes are preserved because both sides are used together: k before and k after
            before, after = (padded.narrow(dim, reach + step, n) for step in (-k, k))
            is_close = torch.maximum((before - q).abs(), (after - q).abs()) <= limit
            total = total + torch.where(is_close, before + after, 0.0)
            count = count + is_close.to(count.dtype)
        q = total / (1 + 2 * count).to(q)
    return q
