"""What is known in metres on the pixels of somebody's map: near returns, far answers, other maps.

Alphabet: ``x`` value of the map at a reference, ``depth`` what the reference says, ``var`` the variance of its
    logarithm.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.codes import Source
from dhtorch.geometry.checks import check
from dhtorch.geometry.patches import sample_nearest
from dhtorch.records import DepthMap, Estimate, Samples

#: References of one source that are used at most, evenly spread over its samples or pixels.
MAX_REFERENCES_PER_SOURCE: Final = 512

#: Relative error that every return may have beside what it states.
MIN_RETURN_ERROR: Final = 0.01

#: Relative error that far answers have beside what they state, each alone and all together: matches that slip, and
#: motions that their covariance takes for better than they are.
FAR_OWN_ERROR, FAR_SHARED_ERROR = 0.02, 0.05

#: Share of a far map's variance that all its pixels share (its motion's).
MAP_SHARED_RATIO: Final = 0.5

#: Blocks (rows, columns) of the picture whose references have errors in common, and share of the variance that they
#: have.
ERROR_BLOCKS: Final = (6, 8)
BLOCK_CORRELATION: Final = 0.3


class MetricReferences(NamedTuple):
    """What is known in metres, on pixels of the map; (B, N) each."""

    share: Tensor  # (B, N, 2) place, share of width and height
    x: Tensor  # the map there
    within: Tensor  # standard deviation of the map about the pixel that is read
    depth: Tensor  # m
    var: Tensor  # of log depth, what each has alone
    shared: Tensor  # standard deviation of log depth that all far ones have in common
    near: Tensor  # bool
    used: Tensor  # bool

    @property
    def block(self) -> Tensor:
        """Part (B, N) int64 of the picture; near and far ones of one part are two."""
        rows, columns = ERROR_BLOCKS
        cell = (self.share * self.share.new_tensor([columns, rows])).floor().long()
        column, row = cell[..., 0].clamp(0, columns - 1), cell[..., 1].clamp(0, rows - 1)
        return 2 * (row * columns + column) + self.near.long()

    @property
    def of_block(self) -> Tensor:
        """Which references are in which block (B, N, blocks): 1, else 0."""
        return F.one_hot(self.block, 2 * ERROR_BLOCKS[0] * ERROR_BLOCKS[1]).to(self.x)

    def weight(self, used: Tensor) -> Tensor:
        """How many references each of those ``used`` (B, N) counts as among its block's, 0 of the others."""
        count = self.x.new_zeros(len(used), 2 * ERROR_BLOCKS[0] * ERROR_BLOCKS[1])
        count = count.scatter_add(1, self.block, used.to(count)).gather(1, self.block)
        return used / (1 + BLOCK_CORRELATION * (count - 1).clamp_min(0))


def collect_references(
    x: Tensor,  # (B, h, w)
    given: Sequence[Samples | Estimate | DepthMap],
    hw: tuple[int, int],
) -> MetricReferences:
    """All references on the pixels of a map, NaN where it has no value; those without one are not used.

    Args:
        x: the map.
        given: near returns (usable ``Samples``), far answers (``Estimate``), maps (``DepthMap``).
        hw: height and width of the picture in whose pixels samples and estimates are.

    Gradient: to map, depth and sigma. Raises ValueError for wrong shapes.
    """
    parts = [_of_map(one) if isinstance(one, DepthMap) else _of_points(one, hw) for one in given]
    found = []
    for share, depth, sigma, together, near, keep in parts:
        check("collect_references", depth_map=(x, "B h w"), references=(share, "B N 2"))
        n = depth.shape[1]
        pick = torch.linspace(0, n - 1, min(n, MAX_REFERENCES_PER_SOURCE), device=x.device).round().long()
        found.append(_read(x, share[:, pick], tuple(part[:, pick] for part in (depth, sigma, together, near, keep))))
    return MetricReferences(*(torch.cat(parts, 1) for parts in zip(*found, strict=True)))


def _of_map(one: DepthMap) -> tuple[Tensor, ...]:
    depth, sigma = one.depth.double(), one.sigma.double()
    rows, columns = (torch.arange(n, device=depth.device).double() for n in depth.shape[-2:])
    v, u = torch.meshgrid((rows + 0.5) / len(rows), (columns + 0.5) / len(columns), indexing="ij")
    share = torch.stack([u, v], -1).flatten(0, 1).expand(len(depth), -1, -1)
    depth, sigma, keep, near = (p.flatten(1) for p in (depth, sigma, one.keep, one.source == Source.SENSOR))
    return share, depth, sigma, MAP_SHARED_RATIO**0.5 * sigma, near, keep


def _of_points(one: Samples | Estimate, hw: tuple[int, int]) -> tuple[Tensor, ...]:
    depth, sigma = one.depth.double(), one.sigma.double()
    share = (one.uv.double() + 0.5) / one.uv.new_tensor([hw[1], hw[0]]).double()
    if isinstance(one, Samples):
        return share, depth, sigma, torch.zeros_like(sigma), torch.ones_like(one.usable), one.usable
    return share, depth, sigma, one.sigma_shared.double(), torch.zeros_like(one.keep), one.keep


def _read(x: Tensor, share: Tensor, told: tuple[Tensor, ...]) -> MetricReferences:
    """The map at references, and their variances."""
    depth, sigma, together, near, keep = told
    value, inside = sample_at_references(x, share)
    use = keep & inside & value.isfinite() & depth.isfinite() & (depth > 0) & sigma.isfinite() & (sigma >= 0)
    z = torch.where(use, depth, 1.0)
    rel, common = (torch.where(use & (s >= 0), s / z, 0.0) for s in (sigma, together))
    common = torch.where(near, 0.0, common)
    var = (rel.square() - common.square()).clamp_min(0) + MIN_RETURN_ERROR**2 + torch.where(near, 0.0, FAR_OWN_ERROR**2)
    common = torch.where(near, 0.0, (common.square() + FAR_SHARED_ERROR**2).sqrt())
    share = torch.where(use[..., None], share, 0.5)
    told_x = torch.where(use, value, 1.0)
    within = torch.where(use, sample_at_references(local_spread(x), share)[0], 0.0)
    return MetricReferences(share=share, x=told_x, within=within, depth=z, var=var, shared=common, near=near, used=use)


def local_spread(x: Tensor) -> Tensor:
    """Standard deviation (B, h, w) by which a map differs about each of its pixels: a return and the value of the map
    stand somewhere in theirs, evenly up to the next pixel on either side. A step to no value (NaN) is none.

    Gradient: none.
    """
    total = torch.zeros_like(x.detach())
    for axis, pad in ((-2, (0, 0, 1, 1)), (-1, (1, 1))):
        n = x.shape[axis]
        step = F.pad(x.detach().diff(dim=axis).square().nan_to_num(0.0), pad)
        total = total + 0.5 * (step.narrow(axis, 0, n) + step.narrow(axis, 1, n))
    return (total / 3).sqrt()


def sample_at_references(x: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
    """Values (B, N) of a map (B, h, w) at the pixels nearest to places (B, N, 2), and whether these are inside."""
    h, w = x.shape[-2:]
    return sample_nearest(x, share * share.new_tensor([w, h]) - 0.5)
