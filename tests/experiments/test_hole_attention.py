"""Hole attention: clusters of holes at known places, and the gaze that moves onto them."""

import pytest
import torch

from dhtorch.experiments.negative.hole_attention import largest_cluster
from dhtorch.stages.sample import spiral

HW = (120, 160)


def lattice(side=20):
    """(1, side², 2) pixels of a slightly shaken square lattice, 5 px apart, row by row."""
    v, u = torch.meshgrid(torch.arange(float(side)), torch.arange(float(side)), indexing="ij")
    shake = torch.rand(side, side, 2, generator=torch.Generator().manual_seed(0)) - 0.5
    return (5 * torch.stack((u, v), -1) + 0.2 * shake).view(1, -1, 2)


def inside(uv, low, high):
    return ((uv >= torch.tensor(low)) & (uv <= torch.tensor(high))).all(-1)


def snake(side=20):
    """Full rows, joined at alternating ends."""
    ends = {1: [side - 1], 3: [0]}
    return torch.tensor([[k in ends.get(y % 4, range(side)) for y in range(side) for k in range(side)]])


UV, SPIRAL = lattice(), spiral(HW, 800)[None]
SMALL, LARGE = inside(UV, [0.0, 0.0], [22.0, 22.0]), inside(UV, [48.0, 38.0], [92.0, 72.0])
RING = inside(UV, [20.0, 20.0], [81.0, 81.0]) & ~inside(UV, [33.0, 33.0], [68.0, 68.0])
MIDDLE, CORNER = inside(SPIRAL, [70.0, 50.0], [90.0, 70.0]), inside(SPIRAL, [100.0, 75.0], [160.0, 120.0])


@pytest.mark.parametrize(
    ("uv", "hole", "member", "options"),
    [
        (UV, SMALL | LARGE, LARGE, {}),
        (SPIRAL, MIDDLE | CORNER, CORNER, {}),  # the larger in the image, of fewer samples
        (UV, RING, RING, {}),  # the gaze is a hole also where the middle is none
        (UV, snake(), snake(), {"neighbours": 4}),
        (lattice(4), torch.arange(16)[None] == 5, torch.arange(16)[None] == 5, {}),
    ],
)
def test_the_largest_cluster_and_a_gaze_in_it(uv, hole, member, options):
    found = largest_cluster(uv, hole, **options)
    assert torch.equal(found.member, member) and int(found.n) == int(member.sum())
    assert bool(member[0, int((uv[0] - found.gaze[0]).norm(dim=-1).argmin())])
    if member is LARGE:
        assert float((found.gaze - torch.tensor([70.0, 55.0])).norm()) < 5
        assert float(found.area_px) == pytest.approx(25 * int(LARGE.sum()), rel=0.3)


def test_no_hole_has_no_gaze():
    assert int(MIDDLE.sum()) > int(CORNER.sum()) > 30
    nothing = largest_cluster(lattice(4), torch.zeros(1, 16, dtype=torch.bool))
    assert not bool(nothing.member.any()) and bool(nothing.gaze.isnan().all()) and float(nothing.area_px) == 0


def components(uv, hole, neighbours):
    """Clusters of one view as sets of samples, by scipy."""
    near = (uv[:, None] - uv[None]).norm(dim=-1).topk(neighbours + 1, largest=False).indices
    edges = torch.zeros(len(uv), len(uv), dtype=torch.bool).scatter(1, near, True) & hole[:, None] & hole[None]
    csgraph = pytest.importorskip("scipy.sparse.csgraph")
    label = csgraph.connected_components(edges.numpy(), directed=False)[1]
    return [{int(k) for k in hole.nonzero()[:, 0] if label[k] == x} for x in {*label[hole.numpy()]}]


@pytest.mark.parametrize("seed", range(4))
def test_clusters_are_those_of_a_search_along_every_edge(seed):
    generator = torch.Generator().manual_seed(seed)
    uv = torch.rand(3, 500, 2, generator=generator) * 100
    hole = torch.rand(3, 500, generator=generator) < (0.25, 0.4, 0.55, 0.8)[seed]
    found = largest_cluster(uv, hole, neighbours=4)
    for b in range(3):
        member = {int(k) for k in found.member[b].nonzero()}
        assert member in components(uv[b], hole[b], 4)
