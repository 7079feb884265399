"""Image pyramids that are ready for window searches: padded levels with their gradients beside them.

Alphabet: ``image`` (B, C, H, W); ``level`` (B, 3, H_l + 2 pad, W_l + 2 pad), its planes are the grey value, the gradient
along x and the gradient along y. Pixel i of a level lies at pixel 2 i of the level below it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry.lookup import luma
from dhtorch.geometry.shapes import check

#: Farthest a search window is looked up away from the pixel it started at, on one map of one level.
REACH = 4


class Pyramid(NamedTuple):
    """Padded levels of a batch of images, finest first; a plain pytree, so it may be kept, compiled and moved."""

    levels: tuple[Tensor, ...]  # each (B, 3, H_l + 2 pad, W_l + 2 pad): grey, grad x, grad y
    pad: int

    def hw(self, level: int = 0) -> tuple[int, int]:
        """(height, width) of a level without its padding."""
        H, W = self.levels[level].shape[-2:]
        return H - 2 * self.pad, W - 2 * self.pad


def build_pyramid(
    image: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    levels: int = 4,
    window: int = 21,
) -> Pyramid:
    """Grey pyramid with gradients, padded for searches with windows of ``window`` pixels.

    Each level is the one below, smoothed by the binomial filter (1 4 6 4 1) / 16 and sampled at even pixels; gradients
    are Scharr's, per pixel. Outside the image the grey value is mirrored about the border pixel, the gradient is zero
    (a mirrored gradient would pull a window back inside). As ``cv2.buildOpticalFlowPyramid`` does, it stops early,
    before a level would be no larger than the window.

    Returns:
        At most ``levels`` levels (the full resolution counts), in the image's dtype, float32 for uint8 images.

    Raises:
        ValueError: not an image batch, ``levels`` < 1, an even or too small window, or an image no larger than it.

    Gradient: none; the search that reads a pyramid has none either (see ``stages.track.refine``).
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
    with torch.no_grad():
        chain = [_padded(luma(image, dim=1)[:, 0], pad)]
        while len(chain) < levels:
            half = _half(chain[-1], pad)
            if min(half.shape[-2:]) <= smallest:
                break
            chain.append(_padded(half, pad))
        return Pyramid(tuple(_add_gradients(level, pad) for level in chain), pad)


def _padded(grey: Tensor, pad: int) -> Tensor:
    """A level whose first plane is ``grey`` (B, H, W), mirrored about its border pixels; the other planes are zero."""
    B, H, W = grey.shape
    level = grey.new_zeros(B, 3, H + 2 * pad, W + 2 * pad)
    plane = level[:, 0]
    plane[:, pad : pad + H, pad : pad + W] = grey
    plane[:, :pad] = plane[:, pad + 1 : 2 * pad + 1].flip(-2)
    plane[:, pad + H :] = plane[:, H - 1 : H - 1 + pad].flip(-2)
    plane[..., :pad] = plane[..., pad + 1 : 2 * pad + 1].flip(-1)
    plane[..., pad + W :] = plane[..., W - 1 : W - 1 + pad].flip(-1)
    return level


def _half(level: Tensor, pad: int) -> Tensor:
    """The image of a padded level at half size: ``cv2.pyrDown`` (kornia's ``pyrdown`` resamples at other places).

    Rows first, because their slices are contiguous; then even and odd columns are taken apart once.
    """
    H, W = level.shape[-2] - 2 * pad, level.shape[-1] - 2 * pad
    h, w = (H + 1) // 2, (W + 1) // 2
    plane = level[:, 0, :, pad - 2 : pad + 2 * w + 1]
    rows = [plane[:, pad + k : pad + k + 2 * h - 1 : 2] for k in (-2, -1, 0, 1, 2)]
    smooth = (rows[1] + rows[3]).mul_(4).add_(rows[0]).add_(rows[4]).add_(rows[2], alpha=6)
    even, odd = smooth[..., ::2].contiguous(), smooth[..., 1::2].contiguous()
    smooth = (odd[..., :w] + odd[..., 1 : w + 1]).mul_(4).add_(even[..., :w]).add_(even[..., 2 : w + 2])
    return smooth.add_(even[..., 1 : w + 1], alpha=6).mul_(1 / 256)


def _add_gradients(level: Tensor, pad: int) -> Tensor:
    """Fill the gradient planes inside the image by Scharr's filter (3 10 3) x (-1 0 1) / 32."""
    H, W = level.shape[-2] - 2 * pad, level.shape[-1] - 2 * pad
    grey, grad_x, grad_y = (level[:, k, pad - 1 : pad + H + 1, pad - 1 : pad + W + 1] for k in range(3))
    smooth = (grey[:, :-2] + grey[:, 2:]).mul_(3 / 32).add_(grey[:, 1:-1], alpha=10 / 32)
    torch.sub(smooth[..., 2:], smooth[..., :-2], out=grad_x[:, 1:-1, 1:-1])
    slope = grey[:, 2:] - grey[:, :-2]
    smooth = (slope[..., :-2] + slope[..., 2:]).mul_(3 / 32)
    torch.add(smooth, slope[..., 1:-1], alpha=10 / 32, out=grad_y[:, 1:-1, 1:-1])
    return level
