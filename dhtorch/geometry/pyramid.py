"""Image pyramids: images -> padded grey levels with gradients, for window searches.

Alphabet: ``image`` (B, C, H, W); ``level`` (B, P, H_l + 2 pad, W_l + 2 pad), whose planes are the grey value and, for
the source of a search, its gradients along x and y. Pixel i of a level lies at pixel
2 i of the level below it.
"""

from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry import filters
from dhtorch.geometry.checks import check, constant
from dhtorch.geometry.patches import extract_windows
from dhtorch.geometry.windows import row_bands
from dhtorch.ops.dispatch import operator

#: Padding of a level beyond half a window, px: the largest distance of a search from a pixel of the image or of the
#: ``OUTSIDE_MARGIN_PX`` around it.
SEARCH_PADDING_PX = 8

#: Largest distance of the centre of a window from the image, px of the level.
OUTSIDE_MARGIN_PX = 4

#: Index of a level's plane of grey values. Source: derived, the order in ``build_pyramid``.
GREY_PLANE = 0

#: Index of a level's plane of gradients along x. Source: derived, the order in ``build_pyramid``.
GRAD_X_PLANE = 1

#: Index of a level's plane of gradients along y. Source: derived, the order in ``build_pyramid``.
GRAD_Y_PLANE = 2


class Pyramid(NamedTuple):
    """Padded levels of a batch of images, finest first. A plain pytree: it may be stored, moved to a device and
    compiled."""

    levels: tuple[Tensor, ...]  # each (B, 3 or 1, H_l + 2 pad, W_l + 2 pad)
    pad: int

    def hw(self, level: int = 0) -> tuple[int, int]:
        """(height, width) of a level without its padding."""
        rows, width = self.levels[level].shape[-2:]
        return rows - 2 * self.pad, width - 2 * self.pad

    def bounds(self, level: int = 0) -> tuple[Tensor, Tensor]:
        """Lowest and highest position (2, 1) of a point on a level: the area of its pixels, on coarse levels with
        margin.

        A point that overshoots the border on a coarse level may return; on the finest level it is lost.
        """
        H, W = self.hw()
        high = constant(self.levels[0], [[W - 0.5], [H - 0.5]])
        margin = OUTSIDE_MARGIN_PX if level else 0
        return torch.full_like(high, -0.5) * 0.5**level - margin, high * 0.5**level + margin

    def corner(self, level: int, x: Tensor) -> Tensor:
        """Points ``x`` (2, M) -> the pixels (2, M) left of and above them, on a level or in the margin around it."""
        H, W = self.hw(level)
        last = constant(x, [[W - 1 + OUTSIDE_MARGIN_PX], [H - 1 + OUTSIDE_MARGIN_PX]])
        return torch.clamp(x.detach().floor(), torch.full_like(last, -OUTSIDE_MARGIN_PX), last)

    def locate(
        self, level: int, x: Tensor, batch: Tensor, before: int, planes: tuple[int, ...]
    ) -> tuple[Tensor, Tensor]:
        """First pixels of windows that extend ``before`` pixels left of and above floor(x), and the fractions of x.

        ``x`` (2, M) px of the level, ``batch`` (M,); returns flat indices (P, M), one row per plane, and (2, M).
        """
        count, rows, width = self.levels[level].shape[1:]
        corner = self.corner(level, x)
        u, v = corner.long()
        first = constant(batch, planes)[:, None] * (rows * width) + (self.pad - before) * (width + 1)
        return torch.add(first, batch, alpha=count * rows * width) + torch.add(u, v, alpha=width), x - corner

    def read(self, level: int, first: Tensor, size: int, fraction: Tensor | None = None) -> Tensor:
        """Windows (P, M, size²) from pixel ``first`` (P, M) on, or bilinear, ``fraction`` (2, M) to the right and
        below."""
        if fraction is None:
            return extract_windows(self.levels[level], first, size).flatten(-2)
        # Interpolation between columns shifts the window as one long row, which is fast; values that the shift moves
        # across a row's end are in the last column, which is dropped.
        side = size + 1
        w = extract_windows(self.levels[level], first, side).flatten(-2)
        w = torch.lerp(w[..., :-1], w[..., 1:], fraction[0][:, None]).unfold(-1, size, side)
        return torch.lerp(w[..., :-1, :], w[..., 1:, :], fraction[1][:, None, None]).flatten(-2)

    def windows(
        self,
        level: int,
        x: Tensor,
        batch: Tensor,
        size: int,
        planes: tuple[int, ...] = (GRAD_X_PLANE, GRAD_Y_PLANE, GREY_PLANE),
    ) -> Tensor:
        """Windows (P, M, size²) around ``x`` (2, M), interpolated between pixels."""
        first, fraction = self.locate(level, x, batch, size // 2, planes)
        return self.read(level, first, size, fraction)


class PyramidCache:
    """Pyramids of a batch of images, each built at first use: for a reference view that is tracked into many views.

    Carries no graph. ``pyramids[i:j]`` are those of images i to j - 1.
    """

    def __init__(self, image: Tensor) -> None:
        self.image = image  # (B, C, H, W), see build_pyramid
        self._pyramids: dict[tuple[int, int], Pyramid] = {}
        self._parts: dict[tuple[int, int], PyramidCache] = {}
        self._cached: dict[Hashable, Any] = {}

    def __call__(self, levels: int, window: int) -> Pyramid:
        """``build_pyramid(image, levels, window)``, built once."""
        if (levels, window) not in self._pyramids:
            with torch.no_grad():
                self._pyramids[levels, window] = build_pyramid(self.image, levels, window)
        return self._pyramids[levels, window]

    def once(self, key: Hashable, make: Callable[[Tensor], Any]) -> Any:
        """``make(image)``, computed once per ``key``: for other data that a tracker derives from its reference view."""
        if key not in self._cached:
            with torch.no_grad():
                self._cached[key] = make(self.image)
        return self._cached[key]

    def __getitem__(self, part: slice) -> "PyramidCache":
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
    """Images -> grey pyramid with gradients, padded for searches with windows of ``window`` pixels.

    Each level is the one below, smoothed by the binomial filter (1 4 6 4 1) / 16 and sampled at even pixels; gradients
    are Scharr's, per pixel. Outside the image the grey value is mirrored about the border pixel and the gradient is
    zero (a mirrored gradient would keep a window inside the border). As in ``cv2.buildOpticalFlowPyramid``
    (``tests/geometry/test_pyramid.py``), a level that would be no larger than the window is left out.

    Args:
        gradients: without them the pyramid takes a third of the memory and can only be the target of a search.

    Returns:
        1 to ``levels`` levels (full resolution included) in the image's dtype, float32 for narrower ones.

    Raises:
        ValueError: not an image batch, ``levels`` < 1, a window that is even or < 3, or an image no larger than it.

    Gradient: to the image.
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


@operator(
    kernel=lambda below, level, *, pad, finest: torch.ops.dhtorch.pyramid_level.default(
        below, level, pad, not finest, below.dtype == torch.uint8
    ),
    dtypes={"below": (torch.uint8, torch.float32), "level": torch.float32},
)
def _fill_level(below: Tensor, level: Tensor, *, pad: int, finest: bool) -> None:
    """Fill a padded ``level`` from the level ``below`` it, or the ``finest`` from the images themselves."""
    grey = level[:, GREY_PLANE : GREY_PLANE + 1]
    inside = grey[..., pad:-pad, pad:-pad]
    for part in row_bands(below, inside.shape[-2:]):
        inside[..., part, :] = filters.grayscale(below[..., part, :]) if finest else _downscale(below, pad, part)
    # Fill the padding of (B, 1, rows, width) with the image mirrored about its border pixels
    middle = grey[..., pad:-pad, :]
    middle[..., :pad] = middle[..., pad + 1 : 2 * pad + 1].flip(-1)
    middle[..., -pad:] = middle[..., -2 * pad - 1 : -pad - 1].flip(-1)
    grey[..., :pad, :] = grey[..., pad + 1 : 2 * pad + 1, :].flip(-2)
    grey[..., -pad:, :] = grey[..., -2 * pad - 1 : -pad - 1, :].flip(-2)
    if level.shape[1] > 1:
        _add_gradients(level, pad, below)


def _downscale(level: Tensor, pad: int, part: slice) -> Tensor:
    """Padded level -> rows ``part`` of its half-size image, as ``cv2.pyrDown`` (``tests/geometry/test_pyramid.py``).

    kornia's ``pyrdown`` samples at other positions. Rows first, because their slices are contiguous; then even and odd
    columns are separated once.
    """
    w = (level.shape[-1] - 2 * pad + 1) // 2
    top, bottom = (pad + 2 * row for row in (part.start, part.stop))
    rows = [
        level[:, GREY_PLANE : GREY_PLANE + 1, top + k : bottom + k : 2, pad - 2 : pad + 2 * w + 1]
        for k in (-2, -1, 0, 1, 2)
    ]
    smooth = _binomial_5(*rows)
    even = smooth[..., ::2].contiguous()
    odd = smooth[..., 1::2].contiguous()
    return _binomial_5(even[..., :w], odd[..., :w], even[..., 1 : w + 1], odd[..., 1:], even[..., 2:])


def _binomial_5(a: Tensor, b: Tensor, c: Tensor, d: Tensor, e: Tensor) -> Tensor:
    return torch.add(torch.add(a + e, b + d, alpha=4), c, alpha=6) * (1 / 16)


def _add_gradients(level: Tensor, pad: int, below: Tensor) -> None:
    """Fill the gradient planes: Scharr's filter (3 10 3) x (-1 0 1) / 32, which kornia lacks; 0 outside the image."""
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
