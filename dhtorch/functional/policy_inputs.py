"""Depth as what policies without a depth input take: an image of three channels, or points.

A geometry image has one byte per channel and pixel, and (0, 0, 0) where there is no depth:

======== =========================================== =======================================================
channel  code                                        decoded
======== =========================================== =======================================================
0, red   255 · :data:`NEAREST_M` / depth, in 1…255   depth = 255 · :data:`NEAREST_M` / code
1, green 1 + 254 · log(ratio / low) / log(1 / low)   sigma = depth · low^(1 − (code − 1) / 254); code 0: 0
2, blue  32 · source                                 source = code / 32, rounded
======== =========================================== =======================================================

with ratio = sigma / depth and low = :data:`LOWEST_RATIO`; codes are rounded to the nearest whole number. Depths below
``NEAREST_M`` or above 255 · ``NEAREST_M``, and ratios outside ``[low, 1]``, get the first or the last code. Rounding
changes depth by at most the share depth / (510 · ``NEAREST_M``), to first order (0.8 % at 1 m, 3.1 % at 4 m), and sigma
by 1.4 % more.
"""

import math
from typing import Final, NamedTuple

import torch
from torch import Tensor

from dhtorch.codes import Source
from dhtorch.geometry import camera as cam
from dhtorch.geometry.checks import shaped
from dhtorch.runtime.numerics import standard_numerics

#: m, depth of the last code of channel 0; the first is 255 times as far, 63.75 m. Source: derived: half a code is 0.8 %
#: at 1 m, 1 / (510 · 0.25).
NEAREST_M: Final = 0.25

#: Lowest sigma / depth that channel 1 tells apart; the highest is 1. Source: derived: 254 steps over three decades have
#: the ratio 1.028, half of one is 1.4 %, less than sigma itself is known to.
LOWEST_RATIO: Final = 1e-3

#: Distance of the codes of two sources in channel 2. Source: derived: the largest power of two at which the codes of
#: :class:`dhtorch.codes.Source` (0 to 5) fit in a byte; an error of the codec below 16 does not change a source.
SOURCE_STEP: Final = 32

#: Largest code of a byte.
_LAST: Final = 255

#: Multipliers of row and column in the order of pixels, of 2³². Source: derived: 2³² / p and 2³² / p² with p³ = p + 1,
#: the additive sequence of low discrepancy in two dimensions.
_ROW_STEP, _COLUMN_STEP = 3242174889, 2447445414


class GeometryImage(NamedTuple):
    """Maps of a geometry image; 0 where there is no depth."""

    depth: Tensor  # (*, H, W) m
    sigma: Tensor  # (*, H, W) m; also 0 where it was unknown
    source: Tensor  # (*, H, W) int32, codes.Source


@standard_numerics
@shaped("depth: * H W, sigma: * H W, source: * H W")
def geometry_image(
    depth: Tensor,  # (*, H, W) m; 0 or not finite = none
    sigma: Tensor,  # (*, H, W) m; 0 or not finite = unknown
    source: Tensor,  # (*, H, W) codes.Source; 0 = none
) -> Tensor:
    """Encode inverse depth, relative sigma and source as an image: (*, 3, H, W) uint8.

    Args:
        depth, sigma, source: maps as ``ExtendDepth(dense=True)`` adds them.

    Returns:
        Image; its codes are in the documentation of this module.

    Raises:
        ValueError: wrong shapes.

    Gradient: none, the image is of whole numbers.

    Example:
        >>> depth, sigma = torch.tensor([[0.5, 2.0, 0.0]]), torch.tensor([[0.005, 0.1, 0.0]])
        >>> geometry_image(depth, sigma, torch.tensor([[1, 3, 0]]))[:, 0].tolist()
        [[128, 32, 0], [86, 145, 0], [32, 96, 0]]
    """
    valid = torch.isfinite(depth) & (depth > 0) & (source != Source.NONE)
    z = torch.where(valid, depth.to(torch.promote_types(depth.dtype, torch.float32)), 1.0)
    red = torch.round(_LAST * NEAREST_M / z).clamp(1, _LAST)
    known = valid & torch.isfinite(sigma) & (sigma > 0)
    ratio = torch.where(known, sigma / z, 1.0).clamp(LOWEST_RATIO, 1)
    green = torch.round(1 + (_LAST - 1) * (1 - torch.log(ratio) / math.log(LOWEST_RATIO)))
    blue = torch.clamp(source * SOURCE_STEP, 0, _LAST).to(red.dtype)
    codes = (torch.where(valid, red, 0.0), torch.where(known, green, 0.0), torch.where(valid, blue, 0.0))
    return torch.stack(codes, -3).to(torch.uint8)


@standard_numerics
@shaped("image: * 3 H W")
def decode_geometry_image(
    image: Tensor,  # (*, 3, H, W) uint8, or floating point in [0, 1]
) -> GeometryImage:
    """Decode a geometry image: depth, sigma and source, within half a code of what was encoded.

    Args:
        image: image of :func:`geometry_image`; loaders that divide by 255 are undone exactly.

    Returns:
        Maps in float32 (the dtype of a floating-point image). Whether a pixel has a depth is by channel 2 alone.

    Raises:
        ValueError: wrong shape.

    Gradient: none.

    Example:
        >>> depth, sigma = torch.tensor([[0.5, 2.0, 0.0]]), torch.tensor([[0.005, 0.1, 0.0]])
        >>> maps = decode_geometry_image(geometry_image(depth, sigma, torch.tensor([[1, 3, 0]])))
        >>> maps.depth, maps.source.tolist()
        (tensor([[0.4980, 1.9922, 0.0000]]), [[1, 3, 0]])
    """
    codes = torch.round(image * _LAST) if image.is_floating_point() else image.to(torch.float32)
    red, green, blue = codes.unbind(-3)
    source = torch.round(blue / SOURCE_STEP).to(torch.int32)
    valid = source != Source.NONE
    depth = torch.where(valid, _LAST * NEAREST_M / red.clamp(min=1), 0.0)
    ratio = LOWEST_RATIO ** (1 - (green - 1) / (_LAST - 1))
    return GeometryImage(depth, torch.where(green > 0, depth * ratio, 0.0), source)


@standard_numerics
@shaped("depth: * H W, K: * 3 3, distortion: * k")
def point_cloud(
    depth: Tensor,  # (*, H, W) m; 0 or not finite = none
    K: Tensor,  # (*, 3, 3) or (3, 3) px, of the map
    *,
    n: int = 1024,
    distortion: Tensor | None = None,  # (*, k) or (k,)
) -> Tensor:
    """Points of ``n`` pixels of a depth map in the camera's axes (x right, y down, z forward): (*, n, 3) m.

    The pixels are those with a depth that come first in a fixed order that covers the image evenly; no random number
    is drawn, and the first points of a larger ``n`` are those of a smaller one. Where fewer than ``n`` pixels have a
    depth, their points repeat in the same order; without any depth all points are 0.

    Args:
        depth: map.
        K: camera matrix of the map, without skew; whole numbers are pixel centres.
        n: number of points.
        distortion: lens in OpenCV's order; None = none.

    Raises:
        ValueError: wrong shapes, or ``n`` below 1.

    Gradient: to depth, K and distortion.

    Example:
        >>> depth = torch.tensor([[2.0, 0.0], [0.0, 4.0]])
        >>> point_cloud(depth, torch.tensor([[2.0, 0.0, 0.5], [0.0, 2.0, 0.5], [0.0, 0.0, 1.0]]), n=3)
        tensor([[-0.5000, -0.5000,  2.0000],
                [ 1.0000,  1.0000,  4.0000],
                [-0.5000, -0.5000,  2.0000]])
    """
    if n < 1:
        raise ValueError(f"point_cloud: n: found {n}, expected at least 1")
    batch, (h, w) = depth.shape[:-2], depth.shape[-2:]
    flat = depth.reshape(-1, h * w)
    # Pixels in an order whose first ones cover the image evenly.
    v = torch.arange(h, device=depth.device)[:, None]
    u = torch.arange(w, device=depth.device)
    order = ((v * _ROW_STEP + u * _COLUMN_STEP) % 2**32).reshape(-1).argsort(stable=True)
    valid = (torch.isfinite(flat) & (flat > 0))[:, order]
    count = valid.sum(1, keepdim=True)
    first = order[torch.argsort((~valid).to(torch.uint8), dim=1, stable=True)]  # pixels with a depth, in order, first
    index = first.gather(1, torch.arange(n, device=depth.device) % count.clamp(min=1))
    z = torch.where(count > 0, flat.gather(1, index), 0.0)
    uv = torch.stack((index % w, index // w), -1).to(depth.dtype)
    flat_K = K.to(depth).expand(*batch, 3, 3).reshape(-1, 3, 3)
    lens = None if distortion is None else distortion.to(depth).expand(*batch, -1).reshape(-1, distortion.shape[-1])
    return cam.unproject(cam.from_matrix(flat_K, lens), uv, z).reshape(*batch, n, 3)
