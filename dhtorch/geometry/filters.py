"""Filters of whole images: grey values, Gaussian and box blur, separable correlation; rounding independent of batch.

Grey values and Gaussian blur are kornia's; filters of few taps are sums of shifted copies instead of a convolution.

Alphabet: ``x`` (B, C, H, W); ``taps`` weights along one axis, odd in number. Beyond the border its pixels repeat.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry.checks import check, shaped


def grayscale(image: Tensor) -> Tensor:
    """Images (B, C, H, W) -> grey values (B, 1, H, W) in [0, 1]; BT.601.

    C is 1 or 3, the images are float in [0, 1] or uint8. By kornia: bit for bit the values of
    :func:`dhtorch.geometry.patches.luma` in float32 and float64, which is for patches and reads channels along any
    axis. Bytes become float32, divided first.

    Gradient: to the image.
    """
    from kornia.color import rgb_to_grayscale  # noqa: PLC0415  (imported where it is used: 0.2 s)

    image = image.float().div_(255) if image.dtype == torch.uint8 else image
    return image if image.shape[1] == 1 else rgb_to_grayscale(image)


def correlate_separable(x: Tensor, down: Sequence[float], across: Sequence[float]) -> Tensor:
    """Images (B, C, H, W) -> correlation with the taps ``down`` along the height and ``across`` along the width.

    Raises:
        ValueError: wrong shape, or an even number of taps.

    Gradient: to ``x``.
    """
    sizes = check("correlate_separable", x=(x, "B C H W"))
    if len(down) % 2 == 0 or len(across) % 2 == 0:
        raise ValueError(f"correlate_separable: found {len(down)} and {len(across)} taps, expected odd numbers")
    i, k = len(down) // 2, len(across) // 2
    padded = F.pad(x, (k, k, i, i), mode="replicate")
    rows = _weighted_sum([padded[..., t : t + sizes["H"], :] for t in range(len(down))], down)
    return _weighted_sum([rows[..., t : t + sizes["W"]] for t in range(len(across))], across)


def gaussian_taps(sigma_px: float, derivative: bool = False) -> list[float]:
    """Sigma -> taps of a sampled Gaussian of sum 1, or of its derivative, of response 1 to slope 1; sigma 0 is [1]."""
    if not sigma_px >= 0 or (derivative and sigma_px == 0):
        raise ValueError(f"gaussian_taps: sigma_px is {sigma_px}, expected a positive number")
    radius = math.ceil(4 * sigma_px)
    offsets = range(-radius, radius + 1)
    weight = [math.exp(-0.5 * (p / sigma_px) ** 2) for p in offsets] if radius else [1.0]
    if not derivative:
        total = sum(weight)
        return [w / total for w in weight]
    slope = [p * w for p, w in zip(offsets, weight, strict=True)]
    gain = sum([p * v for p, v in zip(offsets, slope, strict=True)])
    return [v / gain for v in slope]


@shaped("x: B C H W")
def gaussian_blur(x: Tensor, sigma_px: float, *, reach_px: int | None = None) -> Tensor:
    """Images (B, C, H, W) -> blurred by a Gaussian up to four sigma, by kornia; unchanged for sigma 0.

    Image by image, because for more pixels kornia uses an implementation that rounds differently.

    Raises:
        ValueError: wrong shape, or a negative sigma.

    Gradient: to ``x``.
    """
    from kornia.filters import gaussian_blur2d  # noqa: PLC0415  (imported where it is used: 0.2 s)

    size = len(gaussian_taps(sigma_px)) if reach_px is None else 2 * reach_px + 1
    if size == 1 or len(x) == 0:
        return x
    blurred = [gaussian_blur2d(picture, size, (sigma_px, sigma_px), border_type="replicate") for picture in x.split(1)]
    return torch.cat(blurred)


def box_mean(x: Tensor, radius: int) -> Tensor:
    """Images (B, C, H, W) -> means over squares of ``2 radius + 1`` pixels. Gradient: to ``x``."""
    side = 2 * radius + 1
    return correlate_separable(x, [1 / side] * side, [1 / side] * side)


def _weighted_sum(parts: Sequence[Tensor], taps: Sequence[float]) -> Tensor:
    total = parts[0] * taps[0]
    for part, weight in zip(parts[1:], taps[1:], strict=True):
        total = total + part * weight
    return total
