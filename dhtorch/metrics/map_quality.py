"""Quality of a dense map as a picture: artefacts that need no truth, and wrong answers beside true depth steps."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.codes import is_estimated
from dhtorch.geometry.components import small_components
from dhtorch.metrics.errors import GROSS_ERROR_REL
from dhtorch.records import DepthMap

#: Pixels of a component of answers below which it is a speck, and of silence below which it is a pinhole, px.
#: Source: chosen on maps of 640 x 480, as the least patch that is seen as one.
SPECK_PX = 30


class Artefacts(NamedTuple):
    """Pixels of a map that are artefacts, (B, h, w) bool each. A pixel may be a speck and a line."""

    speck: Tensor  # swept, in a component of fewer than SPECK_PX answered pixels
    line: Tensor  # swept, in no 2 × 2 block of answered pixels: a line one pixel wide
    pinhole: Tensor  # unanswered, in a component of fewer than SPECK_PX unanswered pixels inside the map


def find_artefacts(depth_map: DepthMap) -> Artefacts:
    """The artefacts of maps (B, h, w).

    Answered are pixels with a return and swept ones (filled ones included); components are connected by the four
    neighbours. A return is no artefact; a pinhole amid returns is one, a gap that reaches the border of the map is not.
    """
    answered = depth_map.keep
    swept = answered & is_estimated(depth_map.source)
    blocks = answered[:, 1:, 1:] & answered[:, 1:, :-1] & answered[:, :-1, 1:] & answered[:, :-1, :-1]
    padded = F.pad(blocks, (1, 1, 1, 1))
    in_block = padded[:, 1:, 1:] | padded[:, 1:, :-1] | padded[:, :-1, 1:] | padded[:, :-1, :-1]
    unanswered = F.pad(~answered, (SPECK_PX,) * 4, value=True)  # what reaches the border is not small
    pinhole = small_components(unanswered, SPECK_PX)[:, SPECK_PX:-SPECK_PX, SPECK_PX:-SPECK_PX]
    return Artefacts(swept & small_components(answered, SPECK_PX), swept & ~in_block, pinhole)


def artefact_counts(depth_map: DepthMap) -> tuple[int, int]:
    """Numbers of pixels of the maps that are an artefact of any kind, and that are swept."""
    speck, line, pinhole = find_artefacts(depth_map)
    return int((speck | line | pinhole).sum()), int((depth_map.keep & is_estimated(depth_map.source)).sum())


def near_depth_step(depth: Tensor, ratio: float = 1.15, radius: int = 6) -> Tensor:
    """Pixels (B, h, w) bool of a true depth map (B, h, w) m, 0 = none, within ``radius`` px of a depth step.

    A step lies in a window of 3 × 3 pixels whose farthest depth exceeds ``ratio`` times its nearest one; pixels without
    depth do not count. By default the ratio is three times the spread that the truth test allows (5 %), and the radius
    that of the matched window and two pixels around it.
    """
    far = F.max_pool2d(depth[:, None], 3, 1, 1)
    inverse = torch.where(depth > 0, 1 / depth.clamp_min(torch.finfo(depth.dtype).tiny), 0.0)
    step = far * F.max_pool2d(inverse[:, None], 3, 1, 1) > ratio
    return F.max_pool2d(step.to(depth), 2 * radius + 1, 1, radius)[:, 0] > 0


def step_counts(depth_map: DepthMap, depth: Tensor, counts: Tensor | None = None) -> tuple[int, int]:
    """Numbers of swept pixels beside a true depth step that are wrong, and of all with truth there.

    Args:
        depth_map: maps (B, h, w).
        depth: (B, h, w) m, true depth of their pixels, 0 = none.
        counts: (B, h, w) bool, pixels that are evaluated; None = all.
    """
    beside = depth_map.keep & is_estimated(depth_map.source) & (depth > 0) & near_depth_step(depth)
    if counts is not None:
        beside &= counts
    wrong = beside & ((depth_map.depth - depth).abs() > GROSS_ERROR_REL * depth)
    return int(wrong.sum()), int(beside.sum())
