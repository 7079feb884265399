"""Rejection of pairs in which near things move on their own; a still scene keeps its answers."""

import pytest
import torch
from support.view_estimates import random_estimates

from dhtorch.codes import Gate, Hole, PoseCode
from dhtorch.experiments.baselines.frozen import AUTO_2
from dhtorch.geometry.free_space import free_space_violations
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline.presets import MAP
from dhtorch.pytree import collate, stack
from dhtorch.records import Pose, PoseFit, Samples
from dhtorch.stages.fuse import fuse_consistent
from dhtorch.synthetic.stress import open_stress

#: Samples on a grid of 40 × 30 pixels: 10 of a cell of the module's own grid lie side by side.
W, H = 40, 30
N = W * H


def scene(returns, depth=2.0, hole=Hole.TRACKABLE_NO_LIDAR):
    """Samples of which those in ``returns`` (H, W) bool have a depth, and the pose that all of them hold."""
    v, u = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    uv = torch.stack([u, v], -1).reshape(1, N, 2).float()
    given = returns.reshape(1, N)
    near = torch.where(given, torch.as_tensor(depth).expand(H, W).reshape(1, N), 0.0)
    xyz = torch.where(given[..., None], torch.ones(1, N, 3) * near[..., None], torch.nan)
    one, code = torch.ones(1, N), torch.zeros(1, N, dtype=torch.int32)
    holes = torch.where(given, Hole.NONE, hole).to(torch.int32)
    samples = Samples(uv, near, 0.01 * one, xyz, one, code, one, holes)
    fit = PoseFit(
        Pose(torch.eye(3)[None], torch.ones(1, 3)),
        torch.eye(6)[None],
        given,
        given.sum(-1),
        torch.ones(1),
        0.3 * torch.ones(1),
        100 * torch.ones(1),
        torch.tensor([PoseCode.OK], dtype=torch.int32),
    )
    return samples, fit


def left(columns):
    """Returns in the first so many columns."""
    return (torch.arange(W) < columns).expand(H, W)


def share(samples, fit, depth, sigma=0.01):
    return float(reach(samples, fit, depth, sigma)[0])


def reach(samples, fit, depth, sigma=0.01, asked=None):
    one = torch.ones_like(samples.depth)
    asked = (samples.hole == Hole.TRACKABLE_NO_LIDAR) if asked is None else asked
    return free_space_violations(samples.uv, samples.depth, fit.inlier, asked, depth * one, sigma * one)


def test_answers_where_the_sensor_would_have_seen_them_are_counted():
    samples, fit = scene(left(20))
    assert share(samples, fit, 1.5) == 1.0 and share(samples, fit, 2.5) == 0.0
    third = torch.where(torch.arange(N) % W >= 30, 1.5, 3.0)[None]
    assert share(samples, fit, third) == pytest.approx(0.5, abs=0.05)


def test_two_sigmas_of_doubt_are_given():
    samples, fit = scene(left(20))
    assert share(samples, fit, 1.9, sigma=0.04) == 1.0
    assert share(samples, fit, 1.9, sigma=0.06) == 0.0


def test_half_of_the_returns_say_how_far_the_sensor_sees():
    depth = torch.where(torch.arange(W) < 9, 1.0, 3.0)
    samples, fit = scene(left(20), depth)
    assert share(samples, fit, 2.0) == 1.0, "most returns lie at 3 m"
    samples, fit = scene(left(15), depth)
    assert share(samples, fit, 2.0) == 0.0, "most lie at 1 m"
    few = fit.replace(inlier=fit.inlier & (torch.arange(N)[None] % W >= 9))
    assert share(samples, few, 2.0) == 1.0, "those that hold the pose lie at 3 m"


def test_holes_between_returns_and_a_sparse_sensor_say_nothing():
    v, u = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    samples, fit = scene((u + v) % 5 > 0)
    assert share(samples, fit, 1.5) == 0.0, "every cell has returns"
    few = fit.replace(inlier=fit.inlier & (torch.arange(N) % 8 == 0))
    assert share(samples, few, 1.5) == 0.0, "also where few hold the pose"
    samples, fit = scene(left(20) & ((u + 2 * v) % 5 == 0))
    assert share(samples, fit, 1.5) == 0.0, "a sensor that leaves four of five out where it sees"


def test_few_answers_or_none_say_nothing():
    samples, fit = scene(left(20))
    fit = fit.replace(inlier=fit.inlier & (torch.arange(N) < 9))
    some = (torch.arange(N) % W == 35) & (torch.arange(N) < 9 * W)
    assert float(reach(samples, fit, 1.5, asked=some[None])[0]) == 0.0
    more = (torch.arange(N) % W == 35) & (torch.arange(N) < 10 * W)
    assert float(reach(samples, fit, 1.5, asked=more[None])[0]) == 1.0
    nobody = fit.replace(inlier=torch.zeros_like(fit.inlier))
    assert share(samples, nobody, 1.5) == 0.0


def test_where_most_of_what_is_known_holds_the_pose_it_is_no_body_of_its_own():
    samples, fit = scene(left(21))
    assert share(samples, fit, 1.5) == 0.0
    assert share(samples, fit.replace(inlier=fit.inlier & (torch.arange(N) % 2 == 0)), 1.5) == 1.0


def test_each_pair_is_checked_alone():
    a, b = scene(left(20)), scene(left(20), 1.0)
    samples, fit = collate([a[0], b[0]]), collate([a[1], b[1]])
    both = reach(samples, fit, 1.5)
    assert both.tolist() == [share(*a, 1.5), share(*b, 1.5)] == [1.0, 0.0]


def test_a_pair_is_checked_by_the_noise_of_its_far_tracks_and_by_holes_without_a_reason():
    """Noise counts in rays; a dark, bright or blank hole is no measure of the sensor's range."""
    (room,) = open_stress(["lateral"], n_frames=7)
    view = [range_split(room.recording[k], room.near) for k in (0, 6)]
    trace = {}
    method = MAP.replace(n=512)
    method(*view, trace=trace)
    ideal, fit, samples = trace["tracks_ideal"], trace["fit"], trace["samples"]
    cameras = view[0].camera, view[1].camera
    f = float(cameras[1].f.amin())

    def ask(fit=fit, samples=samples, **options):
        return method.triangulate(samples, ideal, fit, *cameras, **options).gate[0]

    plain = ask()
    assert (plain == 0).sum() > 50 and torch.equal(ask(max_far_noise=0.0025, max_in_reach=0.2), plain)
    for noise, limit, silent in ((1.0, 0.9 / f, True), (1.0, 1.1 / f, False)):
        noisy = fit.replace(sigma_px=torch.full((1,), noise))
        before, after = ask(noisy), ask(noisy, max_far_noise=limit)
        expected = torch.where(before == 0, Gate.CONTRADICTED, before) if silent else before
        assert torch.equal(after, expected)
    wide = cameras[0].replace(f=cameras[0].f / 4)  # whose pixels say nothing of those that tracks end in
    gate = method.triangulate(samples, ideal, noisy, wide, cameras[1], max_far_noise=1.1 / f).gate
    assert not (gate == Gate.CONTRADICTED).any()
    beyond = torch.where(samples.usable, 50.0, 0.0)
    far_off = samples.replace(depth=beyond)
    fit = fit.replace(inlier=fit.inlier & (torch.arange(512) % 16 == 0))  # less than what is asked
    assert (ask(fit, far_off, max_in_reach=0.2) == Gate.CONTRADICTED).any(), "all answers lie within 50 m"
    dark = far_off.replace(hole=torch.where(samples.usable, 0, Hole.TOO_DARK).to(torch.int32))
    assert not (ask(fit, dark, max_in_reach=0.2) == Gate.CONTRADICTED).any()


def test_a_reference_with_more_contradicted_than_answering_views_has_no_answer():
    views = random_estimates(spread=0.5, N=60)
    code = Gate.CONTRADICTED

    def against(n):
        gate = views.gate.clone()
        gate[:n] = torch.where(gate[:n] == 0, code, gate[:n])
        nan = torch.where(gate == 0, views.depth, torch.nan)
        return fuse_consistent(
            views.replace(gate=gate, depth=nan, sigma=torch.where(gate == 0, views.sigma, torch.nan))
        )

    assert len(views.gate) == 4
    assert against(1).keep.any() and against(2).keep.any()
    found = against(3)
    assert not found.keep.any() and (found.gate == code).any()
    assert found.depth.isnan().all()


@pytest.mark.slow
@pytest.mark.parametrize(("stress", "answers"), [("convoy_slow", False), ("held_object", False), ("lateral", True)])
def test_rooms_in_which_near_things_move_have_no_answer(stress, answers):
    """Also where the moving body covers half of the near points."""
    (room,) = open_stress([stress], n_frames=9)
    view = [range_split(room.recording[k], room.near) for k in (0, 3, 6, 8)]
    method = AUTO_2.replace(n=1536, views=2)  # without the stages that refuse some of these for other reasons
    found = method(view[0], stack(view[1:]))
    assert bool(found.keep.any()) == answers
    if not answers:
        assert (found.gate == Gate.CONTRADICTED).any()
        blind = method.replace(triangulate={"max_far_noise": None, "max_in_reach": None})
        assert blind(view[0], stack(view[1:])).keep.any(), "nothing else silences it"
