"""Where to look next if holes were a shortage of samples: at the largest cluster of them.

Samples are foveated, so that what is near and what is large cannot be counted in samples. Two samples are neighbours
if one is among the few nearest of the other, and every sample stands for the patch of picture it alone covers.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dhtorch.geometry.checks import check
from dhtorch.pytree import Record, record


@record
class Cluster(Record):
    """The largest connected set of holes among the samples of each view."""

    member: Tensor  # (B, N) bool; none where there is no hole
    gaze: Tensor  # (B, 2) px: the member nearest to the cluster's middle; NaN where there is no hole
    area_px: Tensor  # (B,) patch of picture that the members stand for
    n: Tensor  # (B,) int64 members


def largest_cluster(
    uv: Tensor,  # (B, N, 2) px
    hole: Tensor,  # (B, N) bool
    *,
    neighbours: int = 6,
) -> Cluster:
    """The connected cluster of holes that covers most of the picture, and the place in it to look at.

    Holes are connected where one is among the nearest ``neighbours`` samples of the other. Labels spread by taking the
    smallest among neighbours and jumping to the label of the label; the number of rounds is fixed and suffices for any
    set of samples in general position (twice the logarithm of N, checked against a search that follows every edge,
    ``oracle`` of ``tests/experiments/test_hole_attention.py``).

    Args:
        uv: the samples, holes and others.
        hole: which of them are holes.
        neighbours: how many samples around one count as next to it.

    Returns:
        Cluster. The gaze is a member, not the mean: the middle of a ring is no part of it. Of clusters equally large
        the one with the first sample wins.

    Raises:
        ValueError: wrong shapes, fewer than one neighbour, or no more samples than neighbours.

    Gradient: none.
    Source: paper, "What Does Not Work", attention-to-holes resampling; the connectivity is ours.
    """
    sizes = check("largest_cluster", uv=(uv, "B N 2"), hole=(hole, "B N"))
    N = sizes["N"]
    if not 1 <= neighbours < N:
        raise ValueError(
            f"largest_cluster: found {N} samples, expected more than neighbours = {neighbours}, at least 1"
        )
    with torch.no_grad():
        near = torch.cdist(uv, uv, compute_mode="donot_use_mm_for_euclid_dist").topk(neighbours + 1, -1, largest=False)
        area = math.pi * near.values[..., -1].square() / (neighbours + 1)  # (B, N) px² that each stands for
        label = _label_clusters(near.indices, hole)
        covered = torch.zeros_like(area).scatter_add(1, label, torch.where(hole, area, 0.0))
        largest = covered.argmax(-1, keepdim=True)
        member = hole & (label == largest)
        weight = torch.where(member, area, 0.0)[..., None]
        middle = (uv * weight).sum(1) / weight.sum(1).clamp_min(1e-12)
        off = (uv - middle[:, None]).square().sum(-1)
        nearest = torch.where(member, off, torch.inf).argmin(-1)
        gaze = uv.gather(1, nearest[:, None, None].expand(-1, 1, 2))[:, 0]
        some = member.any(-1)
    return Cluster(
        member=member,
        gaze=torch.where(some[:, None], gaze, torch.nan),
        area_px=torch.where(some, covered.gather(1, largest)[:, 0], 0.0),
        n=member.sum(-1),
    )


def _label_clusters(nearest: Tensor, hole: Tensor) -> Tensor:
    """Labels (B, N): the smallest index of a hole's cluster; that of a sample that is no hole is its own."""
    B, N, K = nearest.shape
    own = torch.arange(N, device=hole.device).expand(B, N)
    start = own[..., None].expand(B, N, K).flatten(1)
    end = nearest.flatten(1)
    joined = hole.gather(1, start) & hole.gather(1, end)
    end = torch.where(joined, end, start)
    label = own
    for _ in range(2 * max(N, 2).bit_length()):
        first, second = label.gather(1, start), label.gather(1, end)
        least = torch.minimum(first, second)
        # Both ends of an edge, and the roots they hang on, take the smaller label.
        for place in (start, end, first, second):
            label = label.scatter_reduce(1, place, least, "amin")
        label = label.gather(1, label)
    return label
