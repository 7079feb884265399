"""Rejection of pairs in which near things move on their own; a still scene keeps its answers."""

import pytest
import torch
from support.view_estimates import random_estimates

from dhtorch.codes import Gate, Hole, PoseCode
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline.presets import AUTO, MAP
from dhtorch.pytree import collate, stack
from dhtorch.records import Pose, PoseFit, Samples
from dhtorch.stages.fuse import fuse_consistent
from dhtorch.stages.triangulate import free_space_violations
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


def reach(samples, fit, depth, sigma=0.01, counted=None):
    one = torch.ones_like(samples.depth)
    counted = (samples.hole == Hole.TRACKABLE_NO_LIDAR) if counted is None else counted
    return free_space_violations(samples.uv, samples.depth, fit.inlier, counted, depth * one, sigma * one)


PIXEL, COLUMN = torch.arange(N)[None], torch.arange(N)[None] % W
V, U = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
STEP = torch.where(torch.arange(W) < 9, 1.0, 3.0)


@pytest.mark.parametrize(
    ("returns", "near", "holds", "depth", "options", "expected"),
    [
        # answers where the sensor would have seen them are counted, with two sigmas of doubt
        (left(20), 2.0, True, 1.5, {}, 1.0),
        (left(20), 2.0, True, 2.5, {}, 0.0),
        (left(20), 2.0, True, torch.where(COLUMN >= 30, 1.5, 3.0), {}, 0.5),
        (left(20), 2.0, True, 1.9, {"sigma": 0.04}, 1.0),
        (left(20), 2.0, True, 1.9, {"sigma": 0.06}, 0.0),
        # half of the returns that hold the pose say how far the sensor sees
        (left(20), STEP, True, 2.0, {}, 1.0),
        (left(15), STEP, True, 2.0, {}, 0.0),
        (left(15), STEP, COLUMN >= 9, 2.0, {}, 1.0),
        # holes between returns say nothing, nor does a sensor that leaves four of five out where it sees
        ((U + V) % 5 > 0, 2.0, True, 1.5, {}, 0.0),
        ((U + V) % 5 > 0, 2.0, PIXEL % 8 == 0, 1.5, {}, 0.0),
        (left(20) & ((U + 2 * V) % 5 == 0), 2.0, True, 1.5, {}, 0.0),
        # nor do few answers, or none
        (left(20), 2.0, PIXEL < 9, 1.5, {"counted": (COLUMN == 35) & (PIXEL < 9 * W)}, 0.0),
        (left(20), 2.0, PIXEL < 9, 1.5, {"counted": (COLUMN == 35) & (PIXEL < 10 * W)}, 1.0),
        (left(20), 2.0, PIXEL < 0, 1.5, {}, 0.0),
        # where most of what is known holds the pose it is no body of its own
        (left(21), 2.0, True, 1.5, {}, 0.0),
        (left(21), 2.0, PIXEL % 2 == 0, 1.5, {}, 1.0),
    ],
)
def test_answers_in_free_space(returns, near, holds, depth, options, expected):
    samples, fit = scene(returns, near)
    fit = fit.replace(inlier=fit.inlier & holds)
    found = reach(samples, fit, depth, **options)
    assert float(found) == pytest.approx(expected, abs=0.05)
    other, other_fit = scene(left(20), 1.0)  # a pair is checked alone
    both = collate([samples, other]), collate([fit, other_fit])
    asked = {k: torch.cat((v, v)) if isinstance(v, torch.Tensor) else v for k, v in options.items()}
    assert reach(*both, depth, **asked)[0] == found[0]


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
    found = AUTO(view[0], stack(view[1:]), n=1536)
    assert bool(found.keep.any()) == answers and (answers or (found.gate == Gate.CONTRADICTED).any())
