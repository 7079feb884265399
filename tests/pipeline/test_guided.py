"""A method with a guide: priors predict where tracks begin, and what no track answers is searched for."""

import math
from functools import cache

import pytest
import torch
from support.rooms import room

from dhtorch.codes import Gate, Hole
from dhtorch.geometry import se3
from dhtorch.metrics import errors, holdout
from dhtorch.pipeline.presets import AUTO
from dhtorch.pytree import collate, stack
from dhtorch.records import Pose
from dhtorch.stages.pose_prior import make_prior

HW = (120, 160)
NEAR_M = 2.2
PLAIN = AUTO.replace(guide=None, n=512)
GUIDED = AUTO.replace(n=512)


@cache
def orbit(*degrees, pivot_m=2.2):
    """Frames of a camera turned about a point in front of it, the first not turned, and the poses T_k_from_0."""
    first = room(n_frames=2, hw=HW, lidar="exact").true_poses.map(lambda x: x[:1])
    turns = [torch.tensor([[0, math.radians(d), 0, 0, 0, 0]], dtype=torch.float64) for d in degrees]
    pivot = torch.tensor([[0, 0, pivot_m]], dtype=torch.float64)
    moved = [Pose(R, pivot - (R @ pivot[..., None])[..., 0]) for R in (se3.exp(turn).R for turn in turns)]
    world = collate([first, *(se3.compose(first, T) for T in moved)])
    made = room(n_frames=len(world.t), hw=HW, lidar="exact", true_poses=world, supersample=2)
    return [collate([made[k]]) for k in range(len(world.t))], [se3.invert(T).to(torch.float32) for T in moved]


def measured(method, whole, others, **options):
    """Errors of the answers beyond the near limit, and the trace."""
    trace = {}
    estimate = method(holdout.range_split(whole, NEAR_M), others, trace=trace, **options)
    truth = holdout.select_candidates(trace["samples"], holdout.sample_truth(whole, trace["samples"].uv), NEAR_M)
    return errors.measure_errors(errors.points_from_estimate(estimate, truth)), trace


@pytest.mark.slow
@pytest.mark.parametrize("refine", [False, True])
def test_a_turn_that_no_track_follows_is_answered_rightly_with_a_prior(refine):
    (whole, other), (T,) = orbit(35)
    plain, _ = measured(PLAIN, whole, other, fit=make_prior(T, refine=refine))
    guided, _ = measured(GUIDED, whole, other, fit=make_prior(T, refine=refine))
    assert plain["coverage"] == 0
    assert guided["coverage"] > 0.3
    assert guided["median_rel"] < 0.02
    assert guided["wrong_share"] < 0.1


@pytest.mark.slow
def test_a_wrong_prior_does_not_lower_coverage():
    (whole, other), (T,) = orbit(15)
    without, _ = measured(GUIDED, whole, other)
    late = Pose(se3.exp(torch.tensor([[0.0, 0.4, 0.0, 0.0, 0.0, 0.0]])).R, T.t)
    lost, scaled = T.map(lambda x: x * torch.nan), T.replace(t=1000 * T.t)
    for wrong, refine in ((se3.invert(T), False), (scaled, True), (late, False), (late, True), (lost, False)):
        found, trace = measured(GUIDED, whole, other, fit=make_prior(wrong, refine=refine))
        assert found["coverage"] >= without["coverage"] > 0.5
        assert found["median_rel"] < 0.02
        assert trace["fit"].ok.all()


@pytest.mark.slow
def test_of_many_views_those_are_selected_that_a_prior_shows_from_a_similar_side():
    (whole, *others), poses = orbit(90, 15, -60, -15)
    views, prior = stack(others), stack([make_prior(T) for T in poses])
    _, trace = measured(GUIDED.replace(views=2), whole, views, fit=prior)
    assert trace["choice"].index[:, 0].tolist() == [1, 3]


def test_near_returns_on_a_part_that_moves_with_the_camera_do_not_enter_the_pose():
    (whole, other), (T,) = orbit(12)
    pads = torch.rand(1, 3, 120, 45, generator=torch.Generator().manual_seed(1))
    pads = torch.nn.functional.avg_pool2d(pads, 3, 1, 1)

    def carried(frame):
        image, depth = frame.image.clone(), frame.depth.clone()
        image = image.float() / 255 if image.dtype == torch.uint8 else image
        image[..., :45], depth[..., :45] = pads, 0.5
        return frame.replace(image=image, depth=depth)

    whole, other = carried(whole), carried(other)
    _, trace = measured(GUIDED, whole, other)
    static = (trace["samples"].uv[..., 0] < 38).expand(1, -1) & trace["samples"].usable
    assert static.sum() > 20
    assert not (trace["fit"].inlier & static).any()
    off = se3.log(se3.compose(trace["fit"].T_1_from_0.to(torch.float64), se3.invert(T.to(torch.float64))))
    assert trace["fit"].ok.all()
    assert off.abs().max() < 0.03


def test_a_match_has_the_gradient_of_a_trackers_last_step():
    (whole, other), (T,) = orbit(35)
    image = other.image.float() / 255 if other.image.dtype == torch.uint8 else other.image
    image = image.clone().requires_grad_()
    trace = {}
    reference = holdout.range_split(whole, NEAR_M)
    estimate = GUIDED(reference, other.replace(image=image), fit=make_prior(T), trace=trace)
    answered = estimate.keep & (trace["samples"].hole == Hole.TRACKABLE_NO_LIDAR)
    assert answered.any()
    (gradient,) = torch.autograd.grad(estimate.depth[answered].sum(), image)
    assert gradient.isfinite().all()
    assert gradient.abs().sum() > 0


@pytest.mark.slow
def test_a_prior_lifts_no_limit_of_a_method_without_a_guide():
    """Nor of the frozen methods: near returns that contradict far tracks stay contradicted."""
    (whole, other), (T,) = orbit(6)
    strict = {"triangulate": {"max_far_noise": 1e-9}}
    prior, seen = make_prior(T), holdout.range_split(whole, NEAR_M)
    assert PLAIN(seen, other, fit=prior).keep.any()
    refused = PLAIN(seen, other, fit=prior, **strict)
    assert not refused.keep.any() and (refused.gate == Gate.CONTRADICTED).any()
    assert GUIDED(seen, other, fit=prior, **strict).keep.any(), "the guide's poses agree with the prior"


def test_only_unique_matches_that_correlate_become_tracks():
    (whole, other), (T,) = orbit(35)

    def coverage(**changes):
        def guide(*arguments, **options):
            found = AUTO.guide(*arguments, **options)
            return found.replace(**{name: torch.full_like(getattr(found, name), x) for name, x in changes.items()})

        return measured(GUIDED.replace(guide=guide), whole, other, fit=make_prior(T))[0]["coverage"]

    assert coverage(unique=False) < coverage(ncc=0.69) < coverage(ncc=0.7)
