"""Image pyramids ready for window searches: padded levels with their gradients beside them.

Alphabet: ``image`` (B, C, H, W); ``level`` (B, 3, H_l + 2 pad, W_l + 2 pad), whose planes are the gradient along x, the
gradient along y and the grey value. Pixel i of a level lies at pixel 2 i of the level below it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry.lookup import luma, windows
from dhtorch.geometry.shapes import check

#: Padding beyond half a window: how far from a pixel of the image (or of ``MARGIN`` around it) a search may look.
REACH = 8

#: How far outside the image the middle of a window may lie, px of the level.
MARGIN = 4

#: Rows whose gradients are computed at once.
BAND = 64

#: Planes of a level.
GRAD_X, GRAD_Y, GREY = 0, 1, 2


class Pyramid(NamedTuple):
    """Padded levels of a batch of images, finest first. A plain pytree: it may be kept, moved and compiled."""

    levels: tuple[Tensor, ...]  # each (B, 3, H_l + 2 pad, W_l + 2 pad)
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
        slack = MARGIN if level else 0
        return torch.full_like(high, -0.5) * 0.5**level - slack, high * 0.5**level + slack

    def corner(self, level: int, x: Tensor) -> Tensor:
        """The pixel (2, M) left of and above ``x`` (2, M), on a level or in the margin around it."""
        H, W = self.hw(level)
        return torch.minimum(x.detach().floor().clamp_min(-MARGIN), x.new_tensor([[W - 1], [H - 1]]) + MARGIN)

    def locate(self, level: int, x: Tensor, batch: Tensor, before: int, planes: tuple[int, ...]):
        """Where windows begin that reach ``before`` pixels left of and above floor(x), and the fraction of x.

        ``x`` (2, M) px of the level, ``batch`` (M,); returns flat indices (P, M), one row per plane, and (2, M).
        """
        rows, width = self.levels[level].shape[-2:]
        whole = self.corner(level, x)
        u, v = whole.long() + (self.pad - before)
        plane = 3 * batch + torch.tensor(planes, device=x.device)[:, None]
        return (plane * rows + v) * width + u, x - whole

    def read(self, level: int, first: Tensor, size: int, fraction: Tensor | None = None) -> Tensor:
        """Windows (P, M, size²) that begin at ``first`` (P, M), or (bilinear) ``fraction`` (2, M) right and below."""
        if fraction is None:
            return windows(self.levels[level], first, size).flatten(-2)
        # Between columns by shifting the window as one long row, which runs at full speed; what the shift carries over
        # a row's end lands in the last column, which is left out.
        side = size + 1
        w = windows(self.levels[level], first, side).flatten(-2)
        w = torch.lerp(w[..., :-1], w[..., 1:], fraction[0][:, None]).unfold(-1, size, side)
        return torch.lerp(w[..., :-1, :], w[..., 1:, :], fraction[1][:, None, None]).flatten(-2)

    def windows(self, level: int, x: Tensor, batch: Tensor, size: int, planes=(GRAD_X, GRAD_Y, GREY)) -> Tensor:
        """Windows (P, M, size²) around ``x`` (2, M), between pixels."""
        first, fraction = self.locate(level, x, batch, size // 2, planes)
        return self.read(level, first, size, fraction)


def build_pyramid(
    image: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    levels: int = 4,
    window: int = 21,
) -> Pyramid:
    """Grey pyramid with gradients, padded for searches with windows of ``window`` pixels.

    Each level is the one below, smoothed by the binomial filter (1 4 6 4 1) / 16 and taken at even pixels; gradients
    are Scharr's, per pixel. Outside the image the grey value is mirrored about the border pixel and the gradient is
    zero (a mirrored gradient would hold a window back at the border). As in ``cv2.buildOpticalFlowPyramid``, a level
    that would be no larger than the window is not made.

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
    pad = window // 2 + REACH
    smallest = max(window, pad)
    if min(sizes["H"], sizes["W"]) <= smallest:
        raise ValueError(f"build_pyramid: image of {sizes['H']}x{sizes['W']} pixels is too small for window {window}")
    grey = luma(image, dim=1)
    grey = grey.to(torch.promote_types(grey.dtype, torch.float32))
    chain: list[Tensor] = []
    while len(chain) < levels and min(grey.shape[-2:]) > smallest:
        chain.append(_with_gradients(grey, pad))
        grey = _half(chain[-1][:, GREY:], pad)
    return Pyramid(tuple(chain), pad)


def _half(padded: Tensor, pad: int) -> Tensor:
    """Half-size image of a padded one (B, 1, rows, width), as ``cv2.pyrDown`` (kornia's samples at other places).

    Rows first, because their slices are contiguous; then even and odd columns are taken apart once.
    """
    h, w = ((size - 2 * pad + 1) // 2 for size in padded.shape[-2:])
    rows = [padded[..., pad + k : pad + k + 2 * h - 1 : 2, pad - 2 : pad + 2 * w + 1] for k in (-2, -1, 0, 1, 2)]
    smooth = _binomial(*rows)
    even, odd = smooth[..., ::2].contiguous(), smooth[..., 1::2].contiguous()
    return _binomial(even[..., :w], odd[..., :w], even[..., 1 : w + 1], odd[..., 1:], even[..., 2:])


def _binomial(a: Tensor, b: Tensor, c: Tensor, d: Tensor, e: Tensor) -> Tensor:
    return torch.add(torch.add(a + e, b + d, alpha=4), c, alpha=6) * (1 / 16)


def _with_gradients(grey: Tensor, pad: int) -> Tensor:
    """A level (B, 3, rows, width) from its pixels (B, 1, h, w): Scharr's filter (3 10 3) x (-1 0 1) / 32 beside them.

    Written into one new buffer, a band of rows at a time: fresh memory costs more than the arithmetic.
    """
    B, _, h, w = grey.shape
    level = grey.new_empty(B, 3, h + 2 * pad, w + 2 * pad)
    gradients, padded, columns = level[:, :GREY], level[:, GREY:], slice(pad, pad + w)
    padded[..., pad : pad + h, columns] = grey
    padded[..., pad : pad + h, :pad] = grey[..., 1 : pad + 1].flip(-1)
    padded[..., pad : pad + h, pad + w :] = grey[..., w - pad - 1 : w - 1].flip(-1)
    padded[..., :pad, :] = padded[..., pad + 1 : 2 * pad + 1, :].flip(-2)
    padded[..., pad + h :, :] = padded[..., h - 1 : pad + h - 1, :].flip(-2)
    for border in (
        gradients[..., :pad, :],
        gradients[..., pad + h :, :],
        gradients[..., :pad],
        gradients[..., pad + w :],
    ):
        border.zero_()
    for top in range(pad, pad + h, BAND):
        bottom = min(top + BAND, pad + h)
        above, here, below = (padded[..., top + k : bottom + k, pad - 1 : pad + w + 1] for k in (-1, 0, 1))
        across = torch.add(here * (10 / 32), above + below, alpha=3 / 32)
        slope = below - above
        down = torch.add(slope[..., 1:-1] * (10 / 32), slope[..., :-2] + slope[..., 2:], alpha=3 / 32)
        level[:, GRAD_X : GRAD_X + 1, top:bottom, columns] = across[..., 2:] - across[..., :-2]
        level[:, GRAD_Y : GRAD_Y + 1, top:bottom, columns] = down
    return level
