"""Metric references on the pixels of a depth map: near returns, far answers and other maps.

Alphabet: ``x`` value of the map at a reference, ``depth`` of the reference, m, ``var`` variance of its logarithm.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.alignment.options import DEFAULT_ALIGNMENT_OPTIONS, AlignmentOptions
from dhtorch.codes import Source
from dhtorch.geometry.checks import check
from dhtorch.geometry.patches import sample_nearest
from dhtorch.records import DepthMap, Estimate, Samples

#: Blocks (rows, columns) of the picture within which errors of references are correlated.
#: Source: chosen on data=shared_scenes, align_study.json.
ERROR_BLOCKS: Final = (6, 8)


class MetricReferences(NamedTuple):
    """References in metres on pixels of the map; (B, N) each."""

    share: Tensor  # (B, N, 2) place, as fractions of width and height
    x: Tensor  # value of the map there
    within: Tensor  # standard deviation of the map within the pixel
    depth: Tensor  # m
    var: Tensor  # of log depth, the independent part
    shared: Tensor  # standard deviation of log depth that all far references share
    near: Tensor  # bool
    used: Tensor  # bool

    @property
    def block(self) -> Tensor:
        """Index (B, N) int64 of the block of the picture; near and far references of one part have two."""
        rows, columns = ERROR_BLOCKS
        cell = (self.share * self.share.new_tensor([columns, rows])).floor().long()
        column, row = cell[..., 0].clamp(0, columns - 1), cell[..., 1].clamp(0, rows - 1)
        return 2 * (row * columns + column) + self.near.long()

    @property
    def of_block(self) -> Tensor:
        """Block membership of references (B, N, blocks): 1 in its block, else 0."""
        return F.one_hot(self.block, 2 * ERROR_BLOCKS[0] * ERROR_BLOCKS[1]).to(self.x)

    def weight(self, used: Tensor, options: AlignmentOptions = DEFAULT_ALIGNMENT_OPTIONS) -> Tensor:
        """Weight (B, N) of each of the ``used`` references (B, N) among correlated ones of its block, else 0."""
        count = self.x.new_zeros(len(used), 2 * ERROR_BLOCKS[0] * ERROR_BLOCKS[1])
        count = count.scatter_add(1, self.block, used.to(count)).gather(1, self.block)
        return used / (1 + options.block_correlation * (count - 1).clamp_min(0))


def collect_references(
    x: Tensor,  # (B, h, w)
    sources: Sequence[Samples | Estimate | DepthMap],
    hw: tuple[int, int],
    options: AlignmentOptions = DEFAULT_ALIGNMENT_OPTIONS,
) -> MetricReferences:
    """Map and reference sources -> all references on the pixels of the map; those on a missing value are not used.

    Args:
        x: the map, NaN where it has no value.
        sources: near returns (usable ``Samples``), far answers (``Estimate``), maps (``DepthMap``).
        hw: height and width of the picture in whose pixels samples and estimates are.
        options: errors of references beyond the stated ones, and their largest number.

    Gradient: to map, depth and sigma. Raises ValueError for wrong shapes.
    """
    parts = [
        _from_map(source, options) if isinstance(source, DepthMap) else _from_points(source, hw) for source in sources
    ]
    per_source = []
    for share, depth, sigma, sigma_shared, near, keep in parts:
        check("collect_references", depth_map=(x, "B h w"), references=(share, "B N 2"))
        n = depth.shape[1]
        pick = torch.linspace(0, n - 1, min(n, options.max_references_per_source), device=x.device).round().long()
        columns = tuple(part[:, pick] for part in (depth, sigma, sigma_shared, near, keep))
        per_source.append(_place_on_map(x, share[:, pick], columns, options))
    return MetricReferences(*(torch.cat(parts, 1) for parts in zip(*per_source, strict=True)))


def _from_map(source: DepthMap, options: AlignmentOptions) -> tuple[Tensor, ...]:
    """Place, depth, sigma, shared sigma, near, keep of every pixel of a map, (B, N) each."""
    depth, sigma = source.depth.double(), source.sigma.double()
    rows, columns = (torch.arange(n, device=depth.device).double() for n in depth.shape[-2:])
    v, u = torch.meshgrid((rows + 0.5) / len(rows), (columns + 0.5) / len(columns), indexing="ij")
    share = torch.stack([u, v], -1).flatten(0, 1).expand(len(depth), -1, -1)
    depth, sigma, keep, near = (p.flatten(1) for p in (depth, sigma, source.keep, source.source == Source.SENSOR))
    return share, depth, sigma, options.map_shared_ratio**0.5 * sigma, near, keep


def _from_points(source: Samples | Estimate, hw: tuple[int, int]) -> tuple[Tensor, ...]:
    """Place, depth, sigma, shared sigma, near, keep of samples or estimates, (B, N) each."""
    depth, sigma = source.depth.double(), source.sigma.double()
    share = (source.uv.double() + 0.5) / source.uv.new_tensor([hw[1], hw[0]]).double()
    if isinstance(source, Samples):
        return share, depth, sigma, torch.zeros_like(sigma), torch.ones_like(source.usable), source.usable
    return share, depth, sigma, source.sigma_shared.double(), torch.zeros_like(source.keep), source.keep


def _place_on_map(x: Tensor, share: Tensor, columns: tuple[Tensor, ...], options: AlignmentOptions) -> MetricReferences:
    """References at places (B, N, 2) with the values of the map there and their variances."""
    depth, sigma, sigma_shared, near, keep = columns
    value, inside = sample_at_references(x, share)
    use = keep & inside & value.isfinite() & depth.isfinite() & (depth > 0) & sigma.isfinite() & (sigma >= 0)
    z = torch.where(use, depth, 1.0)
    rel, shared = (torch.where(use & (s >= 0), s / z, 0.0) for s in (sigma, sigma_shared))
    shared = torch.where(near, 0.0, shared)
    var = (
        (rel.square() - shared.square()).clamp_min(0)
        + options.min_return_error**2
        + torch.where(near, 0.0, options.far_own_error**2)
    )
    shared = torch.where(near, 0.0, (shared.square() + options.far_shared_error**2).sqrt())
    share = torch.where(use[..., None], share, 0.5)
    x_at = torch.where(use, value, 1.0)
    within = torch.where(use, sample_at_references(local_spread(x), share)[0], 0.0)
    return MetricReferences(share=share, x=x_at, within=within, depth=z, var=var, shared=shared, near=near, used=use)


def local_spread(x: Tensor) -> Tensor:
    """Standard deviation (B, h, w) of a map within each of its pixels.

    A return and the value of the map lie somewhere in their pixels, uniformly up to the next pixel on either side. A
    step to a missing value (NaN) counts as none.

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
