"""Whether the near returns hold the scene's motion, or that of things which move on their own.

A pose that is locked to a car ahead or to an object in the hand is exact for it and wrong for all the rest. The rest
says so in two ways: far tracks miss their epipolar lines by more than tracks do, and answers come to lie where the
sensor, which saw nothing there, would have seen something.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dhtorch.codes import Hole
from dhtorch.geometry.covariance import median
from dhtorch.geometry.shapes import check
from dhtorch.records import Camera, PoseFit, Samples

#: Samples in a cell of the picture, about.
IN_CELL = 10

#: Least share of returns among the samples around a return for a sensor whose silence says something, and least number
#: of answers that such silence is asked of.
DENSE, FEW = 0.6, 10


def misses_lines(fit: PoseFit, camera_1: Camera, *, max_far_noise: float) -> Tensor:
    """Whether far tracks miss their epipolar lines by more than tracks do: (B,) bool.

    Args:
        fit: with ``sigma_px``, the spread of the far tracks' residuals.
        camera_1: of the other view, ideal.
        max_far_noise: of a ray with z = 1; in pixels that times the focal length.

    Raises:
        ValueError: wrong shapes.

    Gradient: none; a choice.
    """
    check("misses_lines", sigma_px=(fit.sigma_px, "B"), f=(camera_1.f, "B 2"))
    return fit.ok & (fit.sigma_px > max_far_noise * camera_1.f.amin(-1))


def within_reach(
    samples: Samples,
    fit: PoseFit,
    depth: Tensor,  # (B, N) m
    sigma: Tensor,  # (B, N) m
    answered: Tensor,  # (B, N) bool
) -> Tensor:
    """Share (B,) of the answers that lie, by two sigmas, closer than half of the returns, where the sensor is silent.

    Asked are answers without a return that have nothing against one (bright, textured, no highlight), in cells of the
    picture without any return: small holes between returns are nothing unusual. 0 where fewer than :data:`FEW` are
    asked, and for a sensor that is sparse also where it sees.

    Raises:
        ValueError: wrong shapes.

    Gradient: none.
    """
    check("within_reach", uv=(samples.uv, "B N 2"), depth=(depth, "B N"), sigma=(sigma, "B N"))
    check("within_reach", answered=(answered, "B N"), inlier=(fit.inlier, "B N"))
    given = samples.usable
    cell = _cells(samples.uv)
    one = torch.ones_like(samples.uv[..., 0])
    none = one.new_zeros(len(one), math.prod(_grid(one.shape[1])))
    in_cell, returns = (none.scatter_add(1, cell, x) for x in (one, torch.where(given, one, 0)))  # whole numbers: exact
    around = returns.gather(1, cell) / in_cell.gather(1, cell)
    dense = torch.where(given, around, 0).sum(-1) >= DENSE * given.sum(-1).clamp_min(1)
    held = fit.inlier & given
    reach = median(torch.where(held, samples.depth, 0), held)
    asked = answered & (samples.hole == Hole.TRACKABLE_NO_LIDAR) & (around == 0)
    close = asked & (depth + 2 * sigma < reach)
    n = asked.sum(-1)
    share = close.sum(-1) / n.clamp_min(1).to(depth.dtype)
    return torch.where(dense & held.any(-1) & (n >= FEW), share, torch.zeros_like(share))


def _grid(N: int) -> tuple[int, int]:
    """Columns and rows of cells for so many samples."""
    rows = max(1, round((0.75 * N / IN_CELL) ** 0.5))
    return max(1, round(N / IN_CELL / rows)), rows


def _cells(uv: Tensor) -> Tensor:
    """(B, N) int64, the cell that each sample lies in, by the samples' extent."""
    columns, rows = _grid(uv.shape[1])
    low, high = uv.amin(1, keepdim=True), uv.amax(1, keepdim=True)
    place = (uv - low) / (high - low).clamp_min(1e-6) * uv.new_tensor([columns, rows])
    column, row = place.long().unbind(-1)
    return column.clamp_max(columns - 1) + columns * row.clamp_max(rows - 1)
