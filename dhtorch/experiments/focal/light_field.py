"""Refocusing: a focal stack from a light field, the array of sub-aperture images of one main lens.

A point of disparity d (px between neighbouring sub-apertures) moves up and left by d from one image to the next.
Shifting every image back accordingly and averaging brings all points of this depth into focus; others are blurred as by
a lens with the aperture of the whole array.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

_LOBES = 3  # of the windowed sinc that interpolates


def refocus(
    light_field: Tensor,  # (U, V, H, W, C) uint8: rows and columns of sub-aperture images
    disparity: Tensor,  # (S,) px between neighbours
) -> Tensor:
    """Refocus a light field: images (S, C, H, W) uint8, one focused at each disparity.

    Shifts are sub-pixel; a three-lobed Lanczos kernel gives all of them the same sharpness (with linear interpolation
    it would depend on the fraction). Rows and columns are shifted separately, each by one convolution that sums over
    the sub-apertures. The border is repeated.
    """
    u, v, h, w, channels = light_field.shape
    row_kernels, column_kernels = _kernels(v, disparity), _kernels(u, disparity)  # (S, V, K), (S, U, K)
    pad_x, pad_y = (row_kernels.shape[-1] // 2,) * 2 + (0, 0), (0, 0) + (column_kernels.shape[-1] // 2,) * 2
    total = torch.zeros(channels, len(disparity), h, w)
    for i in range(u):
        for c in range(channels):
            pictures = pad(light_field[i, ..., c][None].float(), pad_x, mode="replicate")  # (1, V, H, W+)
            row = conv2d(pictures, row_kernels[:, :, None])  # (1, S, H, W)
            row = pad(row, pad_y, mode="replicate")
            total[c] += conv2d(row, column_kernels[:, i][:, None, :, None], groups=len(disparity))[0]
    return (total.transpose(0, 1) / (u * v)).round().clamp(0, 255).to(torch.uint8)


def _kernels(n: int, disparity: Tensor) -> Tensor:
    """Lanczos weights (S, n, K), K odd, that shift each of n sub-aperture images onto the central one."""
    shift = ((n - 1) / 2 - torch.arange(n, dtype=torch.float64)) * disparity.double()[:, None]
    reach = math.ceil(float(shift.abs().max())) + _LOBES
    x = torch.arange(-reach, reach + 1, dtype=torch.float64) - shift[..., None]
    weight = torch.where(x.abs() < _LOBES, torch.sinc(x) * torch.sinc(x / _LOBES), torch.zeros_like(x))
    return (weight / weight.sum(-1, keepdim=True)).float()
