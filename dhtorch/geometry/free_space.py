"""Answers that lie where the sensor would have seen something: a sign that the near returns move on their own.

A pose that is locked to a car ahead or to an object in the hand is exact for it and wrong for all the rest. Where the
body goes along with the camera, in part, no epipolar line tells; but what is answered comes too close, into the reach
of a sensor that saw nothing there.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.geometry.checks import check
from dhtorch.geometry.covariance import masked_median

#: Samples in a cell of the picture, about.
SAMPLES_PER_CELL = 10

#: Least share of returns among the samples around a return for a sensor whose silence says something, and least number
#: of answers that such silence is asked of.
MIN_RETURN_RATIO, MIN_FREE_SPACE_ANSWERS = 0.6, 10


def free_space_violations(
    uv: Tensor,  # (B, N, 2) px
    sensed: Tensor,  # (B, N) m, 0 = no return
    held: Tensor,  # (B, N) bool
    asked: Tensor,  # (B, N) bool
    depth: Tensor,  # (B, N) m
    sigma: Tensor,  # (B, N) m
) -> Tensor:
    """Share (B,) of the answers that lie, by two sigmas, closer than half of the returns, where the sensor is silent.

    Args:
        uv: samples.
        sensed: what the sensor says there.
        held: returns that hold the pose; half of them say how far the sensor surely sees.
        asked: answers whose silent sensor has no other reason. Of these only such count as lie in cells of the picture
            without any return: small holes between returns are nothing unusual.
        depth, sigma: of the answers.

    Returns:
        0 where fewer than :data:`MIN_FREE_SPACE_ANSWERS` are asked, for a sensor that is sparse also where it sees, and
        where more returns hold the pose than answers are asked: what moves on its own is then most of what is known,
        and a sensor that sees far has its holes for other reasons.

    Raises:
        ValueError: wrong shapes.

    Gradient: none.
    """
    check("free_space_violations", uv=(uv, "B N 2"), sensed=(sensed, "B N"), held=(held, "B N"), asked=(asked, "B N"))
    check("free_space_violations", uv=(uv, "B N 2"), depth=(depth, "B N"), sigma=(sigma, "B N"))
    given = sensed > 0
    held = held & given
    around = _share_around(uv, given)
    dense = torch.where(given, around, 0).sum(-1) >= MIN_RETURN_RATIO * given.sum(-1).clamp_min(1)
    few_held = held.sum(-1) <= asked.sum(-1)
    asked = asked & (around == 0)
    close = asked & (depth.detach() + 2 * sigma.detach() < masked_median(sensed.detach(), held))
    n = asked.sum(-1)
    share = close.sum(-1) / n.clamp_min(1).to(depth.dtype)
    told = dense & held.any(-1) & (n >= MIN_FREE_SPACE_ANSWERS) & few_held
    return torch.where(told, share, torch.zeros_like(share))


def _share_around(uv: Tensor, given: Tensor) -> Tensor:
    """(B, N) share of the samples in each sample's cell that have a return; cells divide the samples' extent."""
    N = uv.shape[1]
    rows = max(1, round((0.75 * N / SAMPLES_PER_CELL) ** 0.5))
    columns = max(1, round(N / SAMPLES_PER_CELL / rows))
    low, high = uv.detach().amin(1, keepdim=True), uv.detach().amax(1, keepdim=True)
    place = (uv.detach() - low) / (high - low).clamp_min(1e-6) * uv.new_tensor([columns, rows])
    column, row = place.long().unbind(-1)
    cell = column.clamp_max(columns - 1) + columns * row.clamp_max(rows - 1)
    one = torch.ones_like(uv[..., 0])
    none = one.new_zeros(len(one), columns * rows)
    in_cell, returns = (none.scatter_add(1, cell, x) for x in (one, torch.where(given, one, 0)))  # whole numbers: exact
    return returns.gather(1, cell) / in_cell.gather(1, cell)
