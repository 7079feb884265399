"""Sampling, ranking and its limits, against loops and counts of every case."""

import itertools

import numpy as np
import pytest
import torch

from dhtorch.geometry import ransac, se3
from dhtorch.geometry.least_squares import MIN_DEPTH
from dhtorch.geometry.p3p import p3p

D = torch.float64

# ------------------------------------------------------------------------------------------------ slots and triples


@pytest.mark.parametrize("size", [1, 4, 7])
def test_slots_are_counted_up_or_thinned_evenly(size):
    counts = [0, 1, 3, 4, 5, 7, 13, 700]
    found = ransac.evenly_spaced_slots(torch.tensor(counts), size)
    for row, count in zip(found.tolist(), counts, strict=True):
        wanted = [min(i, max(count - 1, 0)) if count <= size else i * count // size for i in range(size)]
        assert row == wanted


def test_usable_points_come_first_and_are_thinned_evenly():
    usable = (
        torch.tensor(
            [[0, 1, 0, 1, 1, 0], [0, 0, 0, 0, 0, 0], [1, 1, 1, 1, 1, 1], [0, 1, 1, 1, 1, 1], [0, 0, 0, 0, 0, 1]]
        )
        > 0
    )
    index, count = ransac.usable_first(usable, 4)
    assert count.tolist() == [3, 0, 4, 4, 1] and index[4].tolist() == [5, 5, 5, 5]
    assert index.tolist()[:3:2] == [[1, 3, 4, 4], [0, 1, 3, 4]] and index[3].tolist() == [1, 2, 3, 4]
    assert (index[1] < 6).all()
    with pytest.raises(ValueError, match="no points"):
        ransac.usable_first(usable[:, :0], 4)


@pytest.mark.parametrize("count", [3, 4, 6])
def test_each_cell_of_the_draws_gives_another_triple_and_all_are_there(count):
    cells = [[(i + 0.5) / (count - k) for i in range(count - k)] for k in range(3)]
    draws = torch.tensor(list(itertools.product(*cells)), dtype=D)[None]
    found = [tuple(x) for x in ransac.distinct_triples(draws, torch.tensor([count]))[0].tolist()]
    assert sorted(found) == list(itertools.permutations(range(count), 3))


def test_triples_stay_in_range_at_both_ends_and_where_there_are_too_few():
    draws = torch.tensor([[[0.0, 0.0, 0.0], [1 - 2.0**-24] * 3]]).expand(5, 2, 3)
    found = ransac.distinct_triples(draws, torch.tensor([0, 1, 2, 3, 500]))
    assert found[3:].tolist() == [[[0, 1, 2], [2, 1, 0]], [[0, 1, 2], [499, 498, 497]]]
    assert found.amin() == 0 and (found.amax((1, 2)) <= torch.tensor([0, 0, 1, 2, 499])).all()
    ones = ransac.distinct_triples(torch.ones(1, 1, 3), torch.tensor([7]))  # a draw that was rounded up
    assert ones.tolist() == [[[6, 5, 4]]]


# ------------------------------------------------------------------------------------------------ cost


def scenes(batch, n, seed=0, noise=1.0):
    """Points (B, 5, M), intrinsics, true poses."""
    g = torch.Generator().manual_seed(seed)
    rand = lambda *s: torch.rand(*s, generator=g, dtype=D)  # noqa: E731
    f, c = 400 + 80 * rand(batch, 2), 300 + 20 * rand(batch, 2)
    T = se3.exp(0.1 * torch.randn(batch, 6, generator=g, dtype=D))
    Y = torch.stack((2 * rand(batch, n) - 1, 2 * rand(batch, n) - 1, 1 + 2 * rand(batch, n)), -1)
    uv = Y[..., :2] / Y[..., 2:] * f[:, None] + c[:, None] + noise * torch.randn(batch, n, 2, generator=g, dtype=D)
    return torch.cat((se3.apply(se3.invert(T), Y), uv), -1).mT, f, c, T


def truncated(R, t, point, f, c, limit):
    """The plain cost of one point."""
    x, y, z = R @ point[:3] + t
    z = max(z, MIN_DEPTH)
    return min((f[0] * x / z + c[0] - point[3]) ** 2 + (f[1] * y / z + c[1] - point[4]) ** 2, limit)


@pytest.mark.parametrize(("batch", "n", "poses"), [(3, 11, 4), (3, 400, 30)])  # the second is done pair by pair
def test_costs_are_truncated_squares_summed_over_points(batch, n, poses):
    points, f, c, T = scenes(batch, n)
    around = [se3.retract(T, 0.01 * k * torch.ones(batch, 6, dtype=D)) for k in range(poses - 1)]
    behind = se3.compose(se3.exp(torch.tensor([[0, 3.14, 0, 0, 0, 0]], dtype=D).expand(batch, 6)), T)
    stacked = [torch.stack([torch.cat((q.R, q.t[..., None]), -1) for q in (*around, behind)], -1)]  # (B, 3, 4, K)
    lens = torch.cat((f, torch.ones(batch, 1, dtype=D)), 1)[:, :, None, None]
    flat = (stacked[0] * lens).transpose(1, 2).flatten(2)
    limits = torch.rand(batch, n, generator=torch.Generator().manual_seed(5), dtype=D) * 400
    limits[:, ::5] = 0
    uv, one = points[:, 3:] - c[..., None], torch.ones_like(points[:, :1])
    cost = ransac.msac_cost(flat, torch.cat((uv, points[:, :3], one), 1), limits)
    picked = range(poses) if n < 100 else (0, poses - 1)
    for b in range(batch):
        for k in picked:
            R, t = (stacked[0][b, ..., k].numpy()[:, s] for s in (slice(0, 3), 3))
            args = f[b].numpy(), c[b].numpy()
            wanted = sum(truncated(R, t, points[b, :, m].numpy(), *args, float(limits[b, m])) for m in range(n))
            np.testing.assert_allclose(float(cost[b, k]), wanted, rtol=1e-9)
    np.testing.assert_allclose(cost[:, -1], limits.sum(-1), rtol=1e-12)  # everything lies behind the last pose


# ------------------------------------------------------------------------------------------------ search


def every_cost(points, count, f, c, draws, threshold):
    """All solutions of all triples of one pair and their plain costs, no shortlist, no preview."""
    seen = points[:, :count].numpy()
    triples = ransac.distinct_triples(draws[None], torch.tensor([count]))[0]
    found = []
    for triple in triples:
        xyz, uv = points[:3, triple].mT, points[3:, triple].mT
        rays = torch.cat(((uv - c) / f, torch.ones(3, 1, dtype=D)), -1)
        for R, t, valid in zip(*p3p(rays, xyz), strict=True):
            if valid:
                total = sum(truncated(R.numpy(), t.numpy(), p, f.numpy(), c.numpy(), threshold**2) for p in seen.T)
                found.append((total, R, t))
    return sorted(found, key=lambda x: x[0])


def test_the_best_of_all_solutions_are_found_with_their_costs():
    """Half of the slots hold points that are not to be used."""
    points, f, c, _ = scenes(2, 24, noise=2.0)
    points[0, 3:, 15:], count = 0, torch.tensor([15, 24])
    draws = torch.rand(2, 9, 3, generator=torch.Generator().manual_seed(3), dtype=D)
    pose, cost = ransac.search_hypotheses(
        points, count, f, c, draws, threshold_px=5.0, keep=3, preview=24, shortlist=36
    )
    for b in range(2):
        best = every_cost(points[b], int(count[b]), f[b], c[b], draws[b], 5.0)[:3]
        np.testing.assert_allclose(cost[b], [x[0] for x in best], rtol=1e-9)
        assert cost[b, 0] < cost[b, 2] < int(count[b]) * 25
        for k in range(3):
            torch.testing.assert_close(pose.R[b, k], best[k][1])
            torch.testing.assert_close(pose.t[b, k], best[k][2])


def test_a_preview_of_few_points_chooses_who_is_scored_on_all():
    """The first half of the points moved one way, the second another: who sees only one of them is misled."""
    points, f, c, T = scenes(1, 48, noise=0.0)  # the last eight slots are not used
    other = se3.retract(T, torch.tensor([[0.0, 0.0, 0.0, 0.2, 0.0, 0.0]], dtype=D))
    Y = se3.apply(other, points[:, :3].mT)
    moved = (Y[..., :2] / Y[..., 2:] * f[:, None] + c[:, None]).mT
    some = torch.arange(48) % 8 == 0  # what a preview of five sees
    points[:, 3:] = torch.where(some, moved, points[:, 3:])
    triple = lambda a, b, c: [(a + 0.5) / 40, (b - 0.5) / 39, (c - 1.5) / 38]  # noqa: E731
    draws = torch.tensor([[triple(1, 11, 25), triple(0, 8, 24)]], dtype=D)
    found = {}
    for preview in (5, 48):
        pose, cost = ransac.search_hypotheses(
            points, torch.tensor([40]), f, c, draws, threshold_px=2.0, keep=1, preview=preview, shortlist=1
        )
        found[preview] = pose.t[0, 0], float(cost)
    torch.testing.assert_close(found[5][0], other.t[0])
    torch.testing.assert_close(found[48][0], T.t[0])
    assert found[5][1] == pytest.approx(35 * 4, rel=1e-6) and found[48][1] == pytest.approx(5 * 4, rel=1e-6)


def test_where_no_triple_has_a_solution_the_cost_is_infinite_and_the_pose_finite():
    points, f, c, _ = scenes(2, 12)
    points[0, :3] = torch.ones(3, 1, dtype=D) * torch.arange(12)
    draws = torch.rand(2, 6, 3, generator=torch.Generator().manual_seed(0), dtype=D)
    pose, cost = ransac.search_hypotheses(points, torch.tensor([12, 12]), f, c, draws, threshold_px=3.0)
    assert cost.shape == (2, 2) and cost[0].isinf().all() and cost[1, 0].isfinite()
    assert pose.R.isfinite().all() and pose.t.isfinite().all()
    with pytest.raises(ValueError, match="at least 5 solutions"):
        ransac.search_hypotheses(points, torch.tensor([12, 12]), f, c, draws[:, :1], threshold_px=3.0, keep=5)


# ------------------------------------------------------------------------------------------------ lines


def cross(across, along=1.0):
    """Four points: two along x, two across, about a centre away from the origin."""
    x = torch.zeros(1, 3, 6, dtype=D)
    x[0, 0, :2], x[0, 1, 2:4] = torch.tensor([-along, along], dtype=D), torch.tensor([-across, across], dtype=D)
    turn = se3.exp(torch.tensor([[0.3, -0.2, 0.5, 0.2, 0.1, 2.0]], dtype=D))
    return turn.R @ x + turn.t[..., None]


def test_a_line_is_a_thousand_times_as_long_as_wide():
    used = torch.tensor([[1, 1, 1, 1, 0, 0]]) > 0
    assert [bool(ransac.is_collinear(cross(s), used)) for s in (0.0, 0.9e-3, 1.1e-3, 0.5)] == [True, True, False, False]
    assert [bool(ransac.is_collinear(cross(0.3, s), used)) for s in (0.25e-3, 0.4e-3)] == [True, False]
    three = torch.cat((cross(0.3), cross(0.0), cross(0.0)[..., [2, 3, 4, 5, 0, 1]]))
    assert ransac.is_collinear(three, torch.cat((used, used, used[:, [2, 3, 4, 5, 0, 1]]))).tolist() == [
        False,
        True,
        True,
    ]
    assert ransac.is_collinear(cross(0.5), torch.zeros(1, 6, dtype=torch.bool)).item()
    assert ransac.is_collinear(cross(0.5), torch.tensor([[1, 0, 0, 0, 0, 0]]) > 0).item()
    unused = cross(0.0)
    unused[0, :, 4] = torch.tensor([0.5, 0.5, 3.0])
    assert ransac.is_collinear(unused, used).item() and not ransac.is_collinear(unused, torch.ones_like(used)).item()


def test_points_a_hundred_times_as_far_as_the_median_one_are_not_looked_at():
    """A far one beside a square would stretch it into a line; beside a line it would make a plane of it."""
    used = torch.ones(1, 6, dtype=torch.bool)
    xyz = torch.tensor([[[-1.0, 1, 0, 0, 1, 0], [0, 0, -1, 1, 1, 0], [2, 2, 2, 2, 2, 0]]], dtype=D)
    line = torch.tensor([[[-1.0, 1, 0, 0.5, 0.2, 0], [0, 0, 0, 0, 0, 0], [2, 2, 2, 2, 2, 0]]], dtype=D)
    for reach, looked_at in ((199.0, True), (201.0, False)):
        xyz[0, 2, 5] = reach
        line[0, :2, 5] = torch.tensor([0.0, reach], dtype=D)
        assert not ransac.is_collinear(xyz, used).item()
        assert ransac.is_collinear(line, used).item() is not looked_at
    xyz[0, 2, 5] = 1e10
    assert not ransac.is_collinear(xyz, used).item()
    assert not ransac.is_collinear(xyz.float(), used).item()
