"""Image pyramids ready for window searches: padded levels, with their gradients beside them.

Alphabet: ``image`` (B, C, H, W); ``level`` (B, P, H_l + 2 pad, W_l + 2 pad), whose planes are the grey value and, where
windows are to be searched for and not only searched in, its gradients along x and y. Pixel i of a level lies at pixel
2 i of the level below it.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry import filters
from dhtorch.geometry.checks import check
from dhtorch.geometry.patches import extract_windows
from dhtorch.geometry.windows import row_bands
from dhtorch.ops.dispatch import operator

#: Padding beyond half a window: how far from a pixel of the image (or of ``OUTSIDE_MARGIN_PX`` around it) a search may
#: look.
SEARCH_PADDING_PX = 8

#: How far outside the image the middle of a window may lie, px of the level.
OUTSIDE_MARGIN_PX = 4

#: Planes of a level.
GREY_PLANE, GRAD_X_PLANE, GRAD_Y_PLANE = 0, 1, 2


class Pyramid(NamedTuple):
    """Padded levels of a batch of images, finest first. A plain pytree: it may be kept, moved and compiled."""

    levels: tuple[Tensor, ...]  # each (B, 3 or 1, H_l + 2 pad, W_l + 2 pad)
    pad: int

    def hw(self, level: int = 0) -> tuple[int, int]:
        """(height, width) of a level without its padding."""
        rows, width = self.levels[level].shape[-2:]
        return rows - 2 * self.pad, width - 2 * self.pad

    def bounds(self, level: int = 0) -> tuple[Tensor, Tensor]:
        """Lowest and highest position (2, 1) of a point on a level: its pixels' area, and coarsely the margin as well.

        A coarse step that overshoots the border may come back; on the finest level it is lost.
        """
        H, W = self.hw()
        high = self.levels[0].new_tensor([[W - 0.5], [H - 0.5]])
        slack = OUTSIDE_MARGIN_PX if level else 0
        return torch.full_like(high, -0.5) * 0.5**level - slack, high * 0.5**level + slack

    def corner(self, level: int, x: Tensor) -> Tensor:
        """The pixel (2, M) left of and above ``x`` (2, M), on a level or in the margin around it."""
        return torch.clamp(x.detach().floor(), *_margins(self.hw(level), device=x.device, dtype=x.dtype))

    def locate(self, level: int, x: Tensor, batch: Tensor, before: int, planes: tuple[int, ...]):
        """Where windows begin that reach ``before`` pixels left of and above floor(x), and the fraction of x.

        ``x`` (2, M) px of the level, ``batch`` (M,); returns flat indices (P, M), one row per plane, and (2, M).
        """
        count, rows, width = self.levels[level].shape[1:]
        whole = self.corner(level, x)
        u, v = whole.long()
        first = _first(planes, rows * width, (self.pad - before) * (width + 1), device=x.device)
        return torch.add(first, batch, alpha=count * rows * width) + torch.add(u, v, alpha=width), x - whole

    def read(self, level: int, first: Tensor, size: int, fraction: Tensor | None = None) -> Tensor:
        """Windows (P, M, size²) that begin at ``first`` (P, M), or (bilinear) ``fraction`` (2, M) right and below."""
        if fraction is None:
            return extract_windows(self.levels[level], first, size).flatten(-2)
        # Between columns by shifting the window as one long row, which runs at full speed; what the shift carries over
        # a row's end lands in the last column, which is left out.
        side = size + 1
        w = extract_windows(self.levels[level], first, side).flatten(-2)
        w = torch.lerp(w[..., :-1], w[..., 1:], fraction[0][:, None]).unfold(-1, size, side)
        return torch.lerp(w[..., :-1, :], w[..., 1:, :], fraction[1][:, None, None]).flatten(-2)

    def windows(
        self, level: int, x: Tensor, batch: Tensor, size: int, planes=(GRAD_X_PLANE, GRAD_Y_PLANE, GREY_PLANE)
    ) -> Tensor:
        """Windows (P, M, size²) around ``x`` (2, M), between pixels."""
        first, fraction = self.locate(level, x, batch, size // 2, planes)
        return self.read(level, first, size, fraction)


@lru_cache(maxsize=64)
def _margins(hw: tuple[int, int], *, device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """First and last pixel (2, 1) of an image and the margin around it."""
    H, W = hw
    last = torch.tensor([[W - 1 + OUTSIDE_MARGIN_PX], [H - 1 + OUTSIDE_MARGIN_PX]], device=device, dtype=dtype)
    return torch.full_like(last, -OUTSIDE_MARGIN_PX), last


@lru_cache(maxsize=256)
def _first(planes: tuple[int, ...], size: int, shift: int, *, device: torch.device) -> Tensor:
    """Flat indices (P, 1) of pixel ``shift`` of some planes of ``size`` pixels."""
    return torch.tensor(planes, device=device)[:, None] * size + shift


class PyramidCache:
    """The pyramids of a batch of images, each built when it is first asked for: of a reference view tracked into many
    views.

    Carries no graph. ``pyramids[i:j]`` are those of some of the images.
    """

    def __init__(self, image: Tensor) -> None:
        self.image = image  # (B, C, H, W), as build_pyramid takes it
        self._built: dict[tuple[int, int], Pyramid] = {}
        self._parts: dict[tuple[int, int], PyramidCache] = {}
        self._more: dict[Hashable, Any] = {}

    def __call__(self, levels: int, window: int) -> Pyramid:
        """``build_pyramid(image, levels, window)``, made once."""
        if (levels, window) not in self._built:
            with torch.no_grad():
                self._built[levels, window] = build_pyramid(self.image, levels, window)
        return self._built[levels, window]

    def once(self, key: Hashable, make: Callable[[Tensor], Any]) -> Any:
        """``make(image)``, made once for all who name it by ``key``: what else a tracker knows of its reference
        view."""
        if key not in self._more:
            with torch.no_grad():
                self._more[key] = make(self.image)
        return self._more[key]

    def __getitem__(self, part: slice) -> PyramidCache:
        start, stop, _ = part.indices(len(self.image))
        if (start, stop) not in self._parts:
            self._parts[start, stop] = PyramidCache(self.image[start:stop])
        return self._parts[start, stop]


def build_pyramid(
    image: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    levels: int = 4,
    window: int = 21,
    *,
    gradients: bool = True,
) -> Pyramid:
    """Grey pyramid with gradients, padded for searches with windows of ``window`` pixels.

    Each level is the one below, smoothed by the binomial filter (1 4 6 4 1) / 16 and taken at even pixels; gradients
    are Scharr's, per pixel. Outside the image the grey value is mirrored about the border pixel and the gradient is
    zero (a mirrored gradient would hold a window back at the border). As in ``cv2.buildOpticalFlowPyramid``
    (``tests/docs/test_statements.py``), a level that would be no larger than the window is not made.

    Args:
        gradients: without them the pyramid takes a third of the memory; windows can be searched in it, not for it.

    Returns:
        1 to ``levels`` levels (full resolution included) in the image's dtype, float32 for narrower ones.

    Raises:
        ValueError: not an image batch, ``levels`` < 1, a window that is even or < 3, or an image no larger than it.

    Gradient: to the image.
    Twin: ``levels`` of ``tests/support/reference.py``.
    """
    sizes = check("build_pyramid", image=(image, "B C H W"))
    if sizes["C"] not in (1, 3):
        raise ValueError(f"build_pyramid: image has {sizes['C']} channels, expected 1 or 3")
    if levels < 1 or window < 3 or window % 2 == 0:
        raise ValueError(f"build_pyramid: expected levels >= 1 and an odd window >= 3, found {levels} and {window}")
    pad = window // 2 + SEARCH_PADDING_PX
    smallest = max(window, pad)
    if min(sizes["H"], sizes["W"]) <= smallest:
        raise ValueError(f"build_pyramid: image of {sizes['H']}x{sizes['W']} pixels is too small for window {window}")
    dtype = torch.promote_types(image.dtype, torch.float32)
    chain: list[Tensor] = []
    h, w = image.shape[-2:]
    while len(chain) < levels and min(h, w) > smallest:
        level = image.new_empty(len(image), 3 if gradients else 1, h + 2 * pad, w + 2 * pad, dtype=dtype)
        _fill_level(chain[-1] if chain else image, level, pad=pad, finest=not chain)
        chain.append(level)
        h, w = (h + 1) // 2, (w + 1) // 2
    return Pyramid(tuple(chain), pad)


def _fill_level_kernel(below: Tensor, level: Tensor, *, pad: int, finest: bool) -> None:
    torch.ops.dhtorch.pyramid_level.default(below, level, pad, not finest, below.dtype == torch.uint8)


@operator(kernel=_fill_level_kernel, dtypes={"below": (torch.uint8, torch.float32), "level": torch.float32})
def _fill_level(below: Tensor, level: Tensor, *, pad: int, finest: bool) -> None:
    """Fill a padded ``level`` from the level ``below`` it, or the ``finest`` from the images themselves."""
    grey = level[:, GREY_PLANE : GREY_PLANE + 1]
    inside = grey[..., pad:-pad, pad:-pad]
    for part in row_bands(below, inside.shape[-2:]):
        inside[..., part, :] = filters.grayscale(below[..., part, :]) if finest else _half(below, pad, part)
    _mirror(grey, pad)
    if level.shape[1] > 1:
        _add_gradients(level, pad, below)


def _half(level: Tensor, pad: int, part: slice) -> Tensor:
    """Rows ``part`` of the half-size image of a padded one, as ``cv2.pyrDown`` (``tests/geometry/test_pyramid.py``).

    kornia's ``pyrdown`` samples at other places, and takes four to ten times as long. Rows first, because their slices
    are contiguous; then even and odd columns are taken apart once.
    """
    w = (level.shape[-1] - 2 * pad + 1) // 2
    top, bottom = (pad + 2 * row for row in (part.start, part.stop))
    rows = [
        level[:, GREY_PLANE : GREY_PLANE + 1, top + k : bottom + k : 2, pad - 2 : pad + 2 * w + 1]
        for k in (-2, -1, 0, 1, 2)
    ]
    smooth = _binomial(*rows)
    even = smooth[..., ::2].contiguous()
    odd = smooth[..., 1::2].contiguous()
    return _binomial(even[..., :w], odd[..., :w], even[..., 1 : w + 1], odd[..., 1:], even[..., 2:])


def _binomial(a: Tensor, b: Tensor, c: Tensor, d: Tensor, e: Tensor) -> Tensor:
    return torch.add(torch.add(a + e, b + d, alpha=4), c, alpha=6) * (1 / 16)


def _mirror(grey: Tensor, pad: int) -> None:
    """Fill the padding of (B, 1, rows, width) with the image mirrored about its border pixels."""
    middle = grey[..., pad:-pad, :]
    middle[..., :pad] = middle[..., pad + 1 : 2 * pad + 1].flip(-1)
    middle[..., -pad:] = middle[..., -2 * pad - 1 : -pad - 1].flip(-1)
    grey[..., :pad, :] = grey[..., pad + 1 : 2 * pad + 1, :].flip(-2)
    grey[..., -pad:, :] = grey[..., -2 * pad - 1 : -pad - 1, :].flip(-2)


def _add_gradients(level: Tensor, pad: int, below: Tensor) -> None:
    """Fill the planes beside the grey one: Scharr's filter (3 10 3) x (-1 0 1) / 32, kornia has none; 0 outside."""
    planes, grey = level[:, GRAD_X_PLANE:], level[:, GREY_PLANE : GREY_PLANE + 1]
    for border in (planes[..., :pad, :], planes[..., -pad:, :], planes[..., :pad], planes[..., -pad:]):
        border.zero_()
    rows, width = grey.shape[-2:]
    for part in row_bands(below, (rows - 2 * pad, width)):
        top, bottom = part.start + pad, part.stop + pad
        above, here, under = (grey[..., top + k : bottom + k, pad - 1 : width - pad + 1] for k in (-1, 0, 1))
        across = torch.add(here * (10 / 32), above + under, alpha=3 / 32)
        slope = under - above
        down = torch.add(slope[..., 1:-1] * (10 / 32), slope[..., :-2] + slope[..., 2:], alpha=3 / 32)
        planes[:, :1, top:bottom, pad:-pad] = across[..., 2:] - across[..., :-2]
        planes[:, 1:, top:bottom, pad:-pad] = down
