"""Hole attention: clusters of holes at known places, and the gaze that moves onto them."""

import pytest
import torch
from support.paper_protocol_runs import configured_method, small_room
from support.rooms import Changed

from dhtorch.experiments.negative import hole_attention as experiment
from dhtorch.experiments.negative.hole_attention import largest_cluster
from dhtorch.experiments.protocol import Settings
from dhtorch.stages.sample import spiral

HW = (120, 160)


def lattice(side=20):
    """(1, side², 2) pixels of a slightly shaken square lattice, 5 px apart, row by row."""
    v, u = torch.meshgrid(torch.arange(float(side)), torch.arange(float(side)), indexing="ij")
    shake = torch.rand(side, side, 2, generator=torch.Generator().manual_seed(0)) - 0.5
    return (5 * torch.stack((u, v), -1) + 0.2 * shake).view(1, -1, 2)


def drawn(*lines):
    """Holes (1, N) at the places of the lattice that are marked x."""
    return torch.tensor([[c == "x" for line in lines for c in line]])


def inside(uv, low, high):
    return ((uv >= torch.tensor(low)) & (uv <= torch.tensor(high))).all(-1)


def oracle(uv, hole, neighbours):
    """Clusters of one view by following every edge."""
    distance = (uv[:, None] - uv[None]).norm(dim=-1)
    near = distance.topk(neighbours + 1, largest=False).indices.tolist()
    edges = {i: set() for i in range(len(uv))}
    for i, others in enumerate(near):
        for j in others:
            if bool(hole[i]) and bool(hole[j]):
                edges[i].add(j)
                edges[j].add(i)
    seen, clusters = set(), []
    for i in range(len(uv)):
        if bool(hole[i]) and i not in seen:
            todo, cluster = [i], set()
            while todo:
                k = todo.pop()
                if k not in cluster:
                    cluster.add(k)
                    todo += edges[k]
            seen |= cluster
            clusters.append(cluster)
    return clusters


def test_the_larger_of_two_known_clusters_is_found():
    uv = lattice()
    small, large = inside(uv, [0.0, 0.0], [22.0, 22.0]), inside(uv, [48.0, 38.0], [92.0, 72.0])
    found = largest_cluster(uv, small | large)
    assert torch.equal(found.member, large) and int(found.n) == int(large.sum())
    assert float((found.gaze - torch.tensor([70.0, 55.0])).norm()) < 5
    assert float(found.area_px) == pytest.approx(25 * int(large.sum()), rel=0.3)


def test_size_is_counted_in_picture_not_in_samples():
    uv = spiral(HW, 800)[None]
    middle = inside(uv, [70.0, 50.0], [90.0, 70.0])
    corner = inside(uv, [100.0, 75.0], [160.0, 120.0])
    assert int(middle.sum()) > int(corner.sum()) > 30
    assert torch.equal(largest_cluster(uv, middle | corner).member, corner)


def test_a_gaze_is_a_hole_also_where_the_middle_is_none():
    uv = lattice()
    ring = inside(uv, [20.0, 20.0], [81.0, 81.0]) & ~inside(uv, [33.0, 33.0], [68.0, 68.0])
    found = largest_cluster(uv, ring)
    at = int((uv[0] - found.gaze[0]).norm(dim=-1).argmin())
    assert bool(ring[0, at]) and torch.equal(found.member, ring)


def test_a_long_snake_is_one_cluster():
    side, holes = 20, []
    for y in range(side):  # full rows, joined at alternating ends
        end = {1: side - 1, 3: 0}.get(y % 4)
        holes.append("x" * side if end is None else "".join("x" if k == end else "." for k in range(side)))
    snake = drawn(*holes)
    found = largest_cluster(lattice(side), snake, neighbours=4)
    assert torch.equal(found.member, snake)


@pytest.mark.parametrize("seed", range(4))
def test_clusters_are_those_of_a_search_along_every_edge(seed):
    generator = torch.Generator().manual_seed(seed)
    uv = torch.rand(3, 500, 2, generator=generator) * 100
    hole = torch.rand(3, 500, generator=generator) < (0.25, 0.4, 0.55, 0.8)[seed]
    found = largest_cluster(uv, hole, neighbours=4)
    for b in range(3):
        member = {int(k) for k in found.member[b].nonzero()}
        assert member in oracle(uv[b], hole[b], 4)


def test_no_hole_and_too_few_samples():
    uv = lattice(4)
    nothing = largest_cluster(uv, drawn("....", "....", "....", "...."))
    assert not bool(nothing.member.any()) and bool(nothing.gaze.isnan().all()) and float(nothing.area_px) == 0
    one = largest_cluster(uv, drawn("....", ".x..", "....", "...."))
    assert int(one.n) == 1 and torch.equal(one.gaze, uv[:, 5])


def asked(*recordings, base=None, **options):
    return experiment.run(list(recordings), {"paper": base or configured_method()}, None, Settings(), **options)


def shown(outcome):
    return {v: next(iter(outcome.scenes(v, "sensor").values())) for v in experiment.VARIANTS}


def punched(frame):
    """Exact depth except for one region of known place and size."""
    depth = frame.depth.clone()
    depth[:, 96:, 128:] = 0
    return frame.replace(depth=depth)


def test_a_known_region_without_returns_is_looked_at_in_vain():
    outcome = asked(Changed(small_room(lidar="exact"), punched), stride=2)
    found = shown(outcome)
    assert found["even"]["hole_rate"] == pytest.approx(0.25, abs=0.02), "a quarter of the picture"
    assert found["attention"]["hole_rate"] > 0.5 > found["centre"]["hole_rate"]
    assert found["attention"]["rise"] == pytest.approx(
        found["attention"]["hole_rate"] - found["centre"]["hole_rate"], abs=1e-9
    )
    assert found["attention"]["cluster_returns"] < 0.05 and found["centre"]["cluster_returns"] == 0
    assert found["centre"]["cluster_share"] > 0.98
    assert found["attention"]["gaze_way_px"] == pytest.approx(80, abs=15)
    assert outcome.verdict == "supported" and "0.67, 0.78" in outcome.why


def test_classes_and_routes_are_shares_of_the_holes():
    outcome = asked(small_room(), stride=3)
    for row in outcome.rows:
        assert sum(row["hole_share"].values()) == pytest.approx(1)
        assert sum(row["route_share"].values()) == pytest.approx(1)
    assert {"attention.route_share.triangulate", "centre.hole_share.too_dark"} <= set(outcome.summary)


def test_a_scene_without_holes_and_a_sampler_without_a_gaze():
    full = asked(small_room(lidar="exact", hw=(96, 128)), stride=5)
    assert full.verdict == "undecided" and shown(full)["attention"]["note"] == "nothing to estimate"
