"""What lies around every pixel of a map: sums, extremes and means of windows, read from the whole map at once.

Alphabet: maps (B, h, w); a window of *radius* r has (2 r + 1)² pixels. Beyond the border its pixels repeat.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from dhtorch.ops.dispatch import operator

#: Pixels that are worked on at once: few enough to stay in the cache, and to need no fresh memory.
MAX_BAND_PIXELS = 1 << 17


def row_bands(image: Tensor, hw: tuple[int, ...]) -> list[slice]:
    """Rows of maps of size ``hw``, made from pictures (B, ...), to be worked on at once; all of them where a graph or a
    compiler would have to carry each."""
    h, w = hw
    whole = torch.compiler.is_compiling() or (image.requires_grad and torch.is_grad_enabled())
    rows = h if whole else max(MAX_BAND_PIXELS // max(len(image) * w, 1), 1)
    return [slice(top, min(top + rows, h)) for top in range(0, h, rows)]


def window_sum(x: Tensor, radius: int) -> Tensor:
    """Sum (B, h, w) of the (2 radius + 1)² pixels around each, the border's repeated outside. Gradient: to x."""
    for dim in (1, 2):
        n, side = x.shape[dim], 2 * radius + 1
        first, last = (x.narrow(dim, k, 1) for k in (0, n - 1))
        part = torch.cat([first] * radius + [x] + [last] * radius, dim)  # sums of 1, 2, 4, … neighbours
        x, width, begin = part.narrow(dim, 0, n), 1, 1
        while 2 * width <= side:
            length = part.shape[dim] - width
            part = part.narrow(dim, 0, length) + part.narrow(dim, width, length)
            width *= 2
            if side & width:
                x = x + part.narrow(dim, begin, n)
                begin += width
    return x


def window_extreme(x: Tensor, radius: int, pick: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """What ``pick`` chooses of two, torch.maximum or torch.minimum, in the window around each pixel (B, h, w): of two
    windows half as wide, and so on. Gradient: to x."""
    for dim in (1, 2):
        first, last = (x.narrow(dim, k, 1) for k in (0, x.shape[dim] - 1))
        x, width = torch.cat([first] * radius + [x] + [last] * radius, dim), 1
        while width < 2 * radius + 1:
            more = min(width, 2 * radius + 1 - width)
            length = x.shape[dim] - more
            x, width = pick(x.narrow(dim, 0, length), x.narrow(dim, more, length)), width + more
    return x


def window_range(q: Tensor, radius: int) -> Tensor:
    """Largest minus smallest value (B, h, w) of a map in the window around each pixel. Gradient: none."""
    q = q.detach()
    return window_extreme(q, radius, torch.maximum) - window_extreme(q, radius, torch.minimum)


def _smooth_kernel(q: Tensor, tolerance: Tensor, *, radius: int = 4) -> Tensor:
    out = torch.empty_like(q)
    torch.ops.dhtorch.smooth_within_tolerance.default(q, tolerance, out, radius)
    return out


@operator(kernel=_smooth_kernel, dtypes={"q": torch.float32, "tolerance": torch.float32})
def smooth_within_tolerance(q: Tensor, tolerance: Tensor, *, radius: int = 4) -> Tensor:
    """Inverse depths (B, h, w), each the mean of those along its column, then along its row, up to ``radius`` away that
    differ from it by no more than ``tolerance`` (B,) 1/m: planes stay what they are, and so do edges.

    A window cannot see how its pixels scatter about their mean, so what is fitted by windows must be smooth within
    them. Gradient: to q.
    """
    near = tolerance[:, None, None]
    for dim in (1, 2):
        n = q.shape[dim]
        reach = min(radius, n - 1)
        none = torch.full_like(q.narrow(dim, 0, reach), torch.inf)
        wide = torch.cat([none, q, none], dim)
        total, count = q, torch.zeros_like(q, dtype=torch.int16)
        for k in range(1, reach + 1):
            # a plane is kept where both sides are read: k before with k after
            before, after = (wide.narrow(dim, reach + step, n) for step in (-k, k))
            fine = torch.maximum((before - q).abs(), (after - q).abs()) <= near
            total = total + torch.where(fine, before + after, 0.0)
            count = count + fine.to(count.dtype)
        q = total / (1 + 2 * count).to(q)
    return q
