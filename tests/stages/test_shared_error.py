"""Errors that the points of a view share: rotation against parallax, disagreement of views, views without a motion."""

import math

import pytest
import torch
from support.view_estimates import rand, random_estimates

from dhtorch.codes import Gate, PoseCode
from dhtorch.experiments.baselines.frozen import AUTO_2
from dhtorch.geometry import se3
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline.presets import AUTO
from dhtorch.records import PoseFit, Samples, Tracks
from dhtorch.stages.shared_error import MIN_SHARED_POINTS, MIN_TURN, verify_views
from dhtorch.synthetic.stress import open_stress

V, B, N = 3, 2, 40
OFF = {"min_ratio": None, "turn_share": 0.0, "max_disagreement": None, "max_refuted": None}


def views(turn=0.1, parallax=0.05, factors=(1.0, 1.0, 1.0), motion=(5.0, 10.0, 15.0), n_near=10):
    """Samples, tracks, fits and estimates of views that turn by ``turn`` rad with that parallax (rad, of all points),
    whose depths are off by these factors; the first ``n_near`` samples have a return."""
    z = rand(B, N, seed=1, low=2, high=6)
    factors = torch.tensor(factors, dtype=torch.float64)[:, None, None]
    one, code = torch.ones(B, N, dtype=torch.float64), torch.zeros(B, N, dtype=torch.int32)
    near = (torch.arange(N) < n_near).expand(B, N)
    depth = torch.where(near, z, 0.0)
    samples = Samples(
        uv=rand(B, N, 2, seed=2, high=300),
        depth=depth,
        sigma=0.01 * depth,
        xyz=torch.where(near[..., None], depth[..., None].expand(B, N, 3), torch.nan),
        confidence=one,
        flag=code,
        trackability=one,
        hole=code,
    )
    assert torch.equal(samples.usable, near)
    shift = torch.tensor(motion, dtype=torch.float64)[:, None, None, None] * torch.tensor([0.6, 0.8])
    uv_0 = samples.uv.expand(V, B, N, 2)
    wide, zero = torch.ones(V, B, N, dtype=torch.float64), torch.zeros(V, B, N, dtype=torch.float64)
    cov = torch.eye(2, dtype=torch.float64).expand(V, B, N, 2, 2)
    tracks = Tracks(uv_0, uv_0 + shift, error=zero, photometric=zero, cov=cov, valid=wide > 0)
    xi = torch.zeros(V * B, 6, dtype=torch.float64)
    xi[:, 1] = turn
    pose = se3.exp(xi).map(lambda x: x.unflatten(0, (V, B)))
    flat = torch.ones(V, B, dtype=torch.float64)
    fits = PoseFit(
        pose,
        cov=torch.eye(6, dtype=torch.float64).expand(V, B, 6, 6),
        inlier=near.expand(V, B, N),
        n_inlier=near.sum(-1).expand(V, B),
        rms_px=flat,
        sigma_px=flat,
        t_snr=100 * flat,
        code=torch.full((V, B), PoseCode.OK, dtype=torch.int32),
    )
    estimates = random_estimates(V, B, N, unanswered=0.0).replace(
        depth=torch.where(near, z, z * factors),
        sigma=0.04 * z * wide,
        sigma_shared=0.02 * z * wide,
        parallax_deg=math.degrees(parallax) * wide,
    )
    return samples, tracks, fits, estimates


def silence(estimates, k, gate):
    """The estimates with view k unanswered."""
    gone = {name: getattr(estimates, name).clone() for name in ("depth", "sigma", "sigma_shared", "gate", "score")}
    for name in ("depth", "sigma", "sigma_shared"):
        gone[name][k] = torch.nan
    gone["gate"][k], gone["score"][k] = gate, 0.0
    return estimates.replace(**gone)


def test_without_limits_nothing_changes():
    given = views(parallax=1e-4, factors=(1.0, 2.0, 4.0))
    verified = verify_views(*given, **OFF)
    for name in ("depth", "sigma", "sigma_shared", "gate", "score"):
        assert torch.equal(getattr(verified, name), getattr(given[3], name))


@pytest.mark.parametrize("turn", [0.02, 0.3])
@pytest.mark.parametrize(("ratio", "answers"), [(0.12, False), (0.14, True)])
def test_a_parallax_of_an_eighth_of_the_turn_is_no_baseline(turn, ratio, answers):
    verified = verify_views(*views(turn=turn, parallax=ratio * turn))
    assert bool(verified.keep.all()) == bool(verified.keep.any()) == answers
    assert answers or ((verified.gate == Gate.NO_BASELINE).all() and verified.depth.isnan().all())


def test_the_parallax_of_points_without_a_return_decides():
    samples, tracks, fits, estimates = views(turn=0.1, parallax=0.005, n_near=30)
    near = torch.where(samples.usable, 20.0, estimates.parallax_deg)
    assert not verify_views(samples, tracks, fits, estimates.replace(parallax_deg=near)).keep.any()
    far = torch.where(samples.usable, estimates.parallax_deg, 20.0)
    assert verify_views(samples, tracks, fits, estimates.replace(parallax_deg=far)).keep.all()


def test_a_view_that_turns_too_much_takes_no_other_with_it():
    samples, tracks, fits, estimates = views()
    parallax = estimates.parallax_deg.clone()
    parallax[2, 1] = math.degrees(0.001)
    verified = verify_views(samples, tracks, fits, estimates.replace(parallax_deg=parallax))
    assert verified.keep.any(-1).tolist() == [[True, True], [True, True], [True, False]]


def test_the_error_of_direction_is_a_share_of_the_turn():
    """An error of direction e at a point with parallax p changes its depth by e / p."""
    turn, parallax, share = 0.2, 0.05, 0.01
    given = views(turn=turn, parallax=parallax)
    verified = verify_views(*given, **OFF | {"turn_share": share})
    added = share * turn / parallax
    depth = given[3].depth
    assert torch.allclose(verified.sigma, (given[3].sigma ** 2 + (added * depth) ** 2).sqrt())
    assert torch.allclose(verified.sigma_shared, (given[3].sigma_shared ** 2 + (added * depth) ** 2).sqrt())
    assert torch.allclose(verified.parts.lens, given[3].kept_parts.lens + (added * depth) ** 2)
    still = verify_views(*views(turn=0.0, parallax=parallax), **OFF | {"turn_share": share})
    assert torch.allclose(still.sigma, given[3].sigma, rtol=(share * MIN_TURN / parallax / 0.04) ** 2 + 1e-12)


def test_views_with_different_scales_contradict_each_other():
    limits = {"min_disagreement": 0.12, "turn_share": 0.0}
    assert verify_views(*views(factors=(1.0, 1.1, 0.99)), **limits, max_disagreement=0.1).keep.all(), "below the least"
    wrong = verify_views(*views(factors=(1.0, 1.0, 1.3)), **limits)
    assert not wrong.keep.any() and (wrong.gate == Gate.CONTRADICTED).all()
    assert verify_views(*views(factors=(1.0, 1.0, 1.3)), **limits, max_disagreement=12.0).keep.all()
    samples, tracks, fits, estimates = views(factors=(1.0, 1.0, 1.3))
    unsure = estimates.replace(sigma=0.31 * estimates.depth, sigma_shared=0.3 * estimates.depth)
    assert verify_views(samples, tracks, fits, unsure, **limits).keep.all(), "the views state as much"
    alone = estimates.replace(sigma=0.1 * estimates.depth)
    assert not verify_views(samples, tracks, fits, alone, **limits).keep.any(), "errors of single points average out"


def test_returns_and_few_points_do_not_decide_on_a_disagreement():
    n = N - MIN_SHARED_POINTS
    assert not verify_views(*views(factors=(1.0, 1.0, 2.0), n_near=n)).keep.any()
    assert verify_views(*views(factors=(1.0, 1.0, 2.0), n_near=n + 1)).keep.all()


def test_each_reference_view_is_verified_alone():
    samples, tracks, fits, estimates = views()
    depth = estimates.depth.clone()
    depth[1, 0] *= 1.5
    verified = verify_views(samples, tracks, fits, estimates.replace(depth=depth))
    assert verified.keep.any(-1).any(0).tolist() == [False, True]


@pytest.mark.parametrize("gate", [Gate.NO_BASELINE, Gate.CONTRADICTED])
def test_views_without_a_motion_refute_others_that_move_less(gate):
    samples, tracks, fits, estimates = views(motion=(5.0, 10.0, 15.0))
    two = silence(silence(estimates, 1, gate), 2, gate)
    verified = verify_views(samples, tracks, fits, two)
    assert not verified.keep.any() and (verified.gate[0] == Gate.CONTRADICTED).all()
    assert verify_views(samples, tracks, fits, silence(estimates, 2, gate)).keep.any(), "two answer, one does not"
    nearer = silence(silence(estimates, 0, gate), 1, gate)
    assert verify_views(samples, tracks, fits, nearer).keep.any(), "these need not show a motion"
    lost = silence(silence(estimates, 1, Gate.NO_TRACK), 2, Gate.NO_TRACK)
    assert verify_views(samples, tracks, fits, lost).keep.any()
    tie = silence(silence(estimates, 1, gate), 2, Gate.NO_TRACK)
    assert not verify_views(samples, tracks, fits, tie).keep.any()
    assert verify_views(samples, tracks, fits, tie, max_refuted=1.5).keep.any()


@pytest.mark.parametrize(("motion", "refuted"), [((2.0, 9.0, 15.0), True), ((2.0, 7.0, 15.0), False)])
def test_a_misaligned_view_of_half_its_motion_refutes_a_single_answering_view(motion, refuted):
    samples, tracks, fits, estimates = views(motion=motion)
    estimates = silence(silence(estimates, 0, Gate.NO_POSE), 1, Gate.MISALIGNED)
    options = {**OFF, "max_refuted": 1.0}
    assert bool(verify_views(samples, tracks, fits, estimates, **options).keep.any()) != refuted
    two = silence(views(motion=motion)[3], 1, Gate.MISALIGNED)
    assert verify_views(samples, tracks, fits, two, **options).keep.any()


def test_gradients_stay_finite_beside_unanswered_points_and_views():
    samples, tracks, fits, estimates = views()
    estimates = silence(estimates, 1, Gate.NO_POSE)
    parallax = estimates.parallax_deg.clone().requires_grad_()
    R = fits.T_1_from_0.R.clone()
    R[1] = torch.nan
    code = fits.code.clone()
    code[1] = PoseCode.TOO_FEW
    fits = fits.replace(T_1_from_0=fits.T_1_from_0.replace(R=R), code=code)
    verified = verify_views(samples, tracks, fits, estimates.replace(parallax_deg=parallax))
    verified.sigma[verified.keep].sum().backward()
    assert parallax.grad.isfinite().all() and (parallax.grad[0] < 0).all() and (parallax.grad[1] == 0).all()


def test_gradients_stay_finite_without_a_turn():
    samples, tracks, fits, estimates = views(turn=0.0)
    shared = torch.zeros_like(estimates.sigma_shared).requires_grad_()
    verified = verify_views(samples, tracks, fits, estimates.replace(sigma_shared=shared))
    assert verified.keep.all()
    verified.sigma_shared.sum().backward()
    assert shared.grad.isfinite().all()


def test_wrong_shapes_are_refused():
    samples, tracks, fits, estimates = views()
    with pytest.raises(ValueError, match="verify_views"):
        verify_views(samples, tracks, fits, estimates[0])
    with pytest.raises(ValueError, match="verify_views"):
        verify_views(samples, tracks[:1], fits, estimates)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stress", "gate", "positions"),
    [
        ("rotation_hand_20", Gate.NO_BASELINE, (8, 5, 6, 9, 10, 11)),
        ("convoy_uneven", Gate.CONTRADICTED, (6, 1, 3, 8, 11)),
    ],
)
def test_turned_cameras_and_convoys_have_no_answer(stress, gate, positions):
    """The release before answers here."""
    (room,) = open_stress([stress], n_frames=12, hw=(168, 224))
    reference, *others = (room.recording[k] for k in positions)
    reference = range_split(reference, room.near)
    verified, before = (method(reference, others, n=512) for method in (AUTO, AUTO_2))
    assert not verified.keep.any() and (verified.gate == gate).any()
    hole = ~AUTO_2.replace(n=512).sample_depth(reference).usable
    assert (before.keep & hole).sum() > 0.02 * hole.sum()
