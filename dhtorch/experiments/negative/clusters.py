"""Largest connected cluster of holes among the samples of a view, and a gaze point in it.

Samples are foveated, so distance and area cannot be counted in samples: two samples are neighbours if one is among the
nearest few of the other, and every sample is weighted by the image area that it covers.
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

    member: Tensor  # (B, N) bool; all False without a hole
    gaze: Tensor  # (B, 2) px: the member nearest to the cluster's centroid; NaN without a hole
    area_px: Tensor  # (B,) image area of the members
    n: Tensor  # (B,) int64 number of members


def largest_cluster(
    uv: Tensor,  # (B, N, 2) px
    hole: Tensor,  # (B, N) bool
    *,
    neighbours: int = 6,
) -> Cluster:
    """Connected cluster of holes with the largest image area, and a gaze point in it.

    Holes are connected if one is among the nearest ``neighbours`` samples of the other. Labels propagate by the minimum
    over neighbours and pointer jumping; the fixed number of rounds (twice the logarithm of N) suffices for samples in
    general position, which is tested against a search along every edge (``oracle`` of
    ``tests/experiments/test_hole_attention.py``).

    Args:
        uv: all samples, holes and others.
        hole: which of them are holes.
        neighbours: number of nearest samples that count as neighbours.

    Returns:
        Cluster. The gaze is a member rather than the centroid, which may lie outside, as for a ring. Ties go to the
        cluster with the first sample.

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
        nearest_samples = torch.cdist(uv, uv, compute_mode="donot_use_mm_for_euclid_dist").topk(
            neighbours + 1, -1, largest=False
        )
        area = math.pi * nearest_samples.values[..., -1].square() / (neighbours + 1)  # (B, N) px² of each sample
        label = _label_clusters(nearest_samples.indices, hole)
        covered = torch.zeros_like(area).scatter_add(1, label, torch.where(hole, area, 0.0))
        largest = covered.argmax(-1, keepdim=True)
        member = hole & (label == largest)
        weight = torch.where(member, area, 0.0)[..., None]
        centroid = (uv * weight).sum(1) / weight.sum(1).clamp_min(1e-12)
        squared_distance = (uv - centroid[:, None]).square().sum(-1)
        nearest = torch.where(member, squared_distance, torch.inf).argmin(-1)
        gaze = uv.gather(1, nearest[:, None, None].expand(-1, 1, 2))[:, 0]
        has_hole = member.any(-1)
    return Cluster(
        member=member,
        gaze=torch.where(has_hole[:, None], gaze, torch.nan),
        area_px=torch.where(has_hole, covered.gather(1, largest)[:, 0], 0.0),
        n=member.sum(-1),
    )


def _label_clusters(nearest: Tensor, hole: Tensor) -> Tensor:
    """Cluster labels (B, N): smallest index of the cluster for a hole, own index for other samples."""
    B, N, K = nearest.shape
    indices = torch.arange(N, device=hole.device).expand(B, N)
    start = indices[..., None].expand(B, N, K).flatten(1)
    end = nearest.flatten(1)
    connected = hole.gather(1, start) & hole.gather(1, end)
    end = torch.where(connected, end, start)
    label = indices
    for _ in range(2 * max(N, 2).bit_length()):
        first, second = label.gather(1, start), label.gather(1, end)
        least = torch.minimum(first, second)
        # Both ends of an edge and their roots take the smaller label.
        for index in (start, end, first, second):
            label = label.scatter_reduce(1, index, least, "amin")
        label = label.gather(1, label)
    return label
