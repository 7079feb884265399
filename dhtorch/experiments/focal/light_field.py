"""Refocusing: a focal stack out of a light field, the many small pictures behind one main lens.

A point at disparity d (px from one picture to the next) stands d further up and left in each next picture. Shifting
every picture back by that much and taking the mean puts this point, and everything at its depth, into focus; all else
blurs as behind a lens as wide as the whole array.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

_LOBES = 3  # of the windowed sinc that interpolates


def refocus(
    light_field: Tensor,  # (U, V, H, W, C) uint8: rows and columns of pictures
    disparity: Tensor,  # (S,) px between neighbours
) -> Tensor:
    """Images (S, C, H, W) uint8, focused at each disparity.

    Shifts are fractions of a pixel; a three-lobed Lanczos kernel keeps the sharpness the same for all of them (linear
    interpolation would make focus depend on the fraction). Rows and columns are shifted apart, each as one convolution
    that sums over the pictures. The border is repeated.
    """
    u, v, h, w, channels = light_field.shape
    across, down = _kernels(v, disparity), _kernels(u, disparity)  # (S, V, K), (S, U, K)
    sides, ends = (across.shape[-1] // 2,) * 2 + (0, 0), (0, 0) + (down.shape[-1] // 2,) * 2
    total = torch.zeros(channels, len(disparity), h, w)
    for i in range(u):
        for c in range(channels):
            pictures = pad(light_field[i, ..., c][None].float(), sides, mode="replicate")  # (1, V, H, W+)
            row = conv2d(pictures, across[:, :, None])  # (1, S, H, W)
            row = pad(row, ends, mode="replicate")
            total[c] += conv2d(row, down[:, i][:, None, :, None], groups=len(disparity))[0]
    return (total.transpose(0, 1) / (u * v)).round().clamp(0, 255).to(torch.uint8)


def _kernels(n: int, disparity: Tensor) -> Tensor:
    """(S, n, K) weights that read each of n pictures where the centre's pixel went, K odd."""
    shift = ((n - 1) / 2 - torch.arange(n, dtype=torch.float64)) * disparity.double()[:, None]
    reach = math.ceil(float(shift.abs().max())) + _LOBES
    x = torch.arange(-reach, reach + 1, dtype=torch.float64) - shift[..., None]
    weight = torch.where(x.abs() < _LOBES, torch.sinc(x) * torch.sinc(x / _LOBES), torch.zeros_like(x))
    return (weight / weight.sum(-1, keepdim=True)).float()
