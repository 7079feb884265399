"""Errors that the points of a view share: rotation against parallax, disagreement of views, views without a motion."""

import math

import pytest
import torch
from support.view_estimates import rand, random_estimates

from dhtorch.codes import Gate, PoseCode
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


def parallax_of(points, degrees):
    """Views whose samples of one kind (near or far) have another parallax than that of their estimates."""
    samples, tracks, fits, estimates = views(turn=0.1, parallax=0.005, n_near=30)
    chosen = samples.usable if points == "near" else ~samples.usable
    return samples, tracks, fits, estimates.replace(parallax_deg=torch.where(chosen, degrees, estimates.parallax_deg))


def unsure(own, shared):
    samples, tracks, fits, estimates = views(factors=(1.0, 1.0, 1.3))
    sigmas = {"sigma": own * estimates.depth} | ({} if shared is None else {"sigma_shared": shared * estimates.depth})
    return samples, tracks, fits, estimates.replace(**sigmas)


def silenced(motion=(5.0, 10.0, 15.0), **gates):
    samples, tracks, fits, estimates = views(motion=motion)
    for name, gate in gates.items():
        estimates = silence(estimates, int(name[-1]), gate)
    return samples, tracks, fits, estimates


SCALES = {"min_disagreement": 0.12, "turn_share": 0.0}
LOST, REFUTING = Gate.NO_TRACK, {**OFF, "max_refuted": 1.0}
ENOUGH = N - MIN_SHARED_POINTS


@pytest.mark.parametrize(
    ("given", "options", "gate"),
    [
        # a parallax below an eighth of the turn is no baseline; points without a return decide
        *((views(turn=turn, parallax=0.12 * turn), {}, Gate.NO_BASELINE) for turn in (0.02, 0.3)),
        *((views(turn=turn, parallax=0.14 * turn), {}, None) for turn in (0.02, 0.3)),
        (parallax_of("near", 20.0), {}, Gate.NO_BASELINE),
        (parallax_of("far", 20.0), {}, None),
        # views with different scales contradict each other, unless they state as much
        (views(factors=(1.0, 1.1, 0.99)), {**SCALES, "max_disagreement": 0.1}, None),
        (views(factors=(1.0, 1.0, 1.3)), SCALES, Gate.CONTRADICTED),
        (views(factors=(1.0, 1.0, 1.3)), {**SCALES, "max_disagreement": 12.0}, None),
        (unsure(0.31, 0.3), SCALES, None),
        (unsure(0.1, None), SCALES, Gate.CONTRADICTED),  # errors of single points average out
        (views(factors=(1.0, 1.0, 2.0), n_near=ENOUGH), {}, Gate.CONTRADICTED),
        (views(factors=(1.0, 1.0, 2.0), n_near=ENOUGH + 1), {}, None),  # few points do not decide
        # views without a motion refute others that move less
        *(
            row
            for still in (Gate.NO_BASELINE, Gate.CONTRADICTED)
            for row in (
                (silenced(view_1=still, view_2=still), {}, Gate.CONTRADICTED),
                (silenced(view_2=still), {}, None),  # two answer, one does not
                (silenced(view_0=still, view_1=still), {}, None),  # these need not show a motion
                (silenced(view_1=still, view_2=LOST), {}, Gate.CONTRADICTED),
                (silenced(view_1=still, view_2=LOST), {"max_refuted": 1.5}, None),
            )
        ),
        (silenced(view_1=LOST, view_2=LOST), {}, None),
        # a misaligned view of half its motion refutes a single answering view
        (silenced((2.0, 9.0, 15.0), view_0=Gate.NO_POSE, view_1=Gate.MISALIGNED), REFUTING, Gate.CONTRADICTED),
        (silenced((2.0, 7.0, 15.0), view_0=Gate.NO_POSE, view_1=Gate.MISALIGNED), REFUTING, None),
        (silenced((2.0, 9.0, 15.0), view_1=Gate.MISALIGNED), REFUTING, None),
    ],
)
def test_views_that_are_silenced_and_views_that_are_not(given, options, gate):
    verified, before = verify_views(*given, **options), given[3].keep
    assert torch.equal(verified.keep, before if gate is None else torch.zeros_like(before))
    assert gate is None or (verified.gate[before] == gate).all()
    assert verified.depth[~verified.keep].isnan().all() and not verified.score[~verified.keep].any()


def test_each_view_and_each_reference_view_is_verified_alone():
    samples, tracks, fits, estimates = views()
    parallax, depth = estimates.parallax_deg.clone(), estimates.depth.clone()
    parallax[2, 1] = math.degrees(0.001)
    verified = verify_views(samples, tracks, fits, estimates.replace(parallax_deg=parallax))
    assert verified.keep.any(-1).tolist() == [[True, True], [True, True], [True, False]]
    depth[1, 0] *= 1.5
    verified = verify_views(samples, tracks, fits, estimates.replace(depth=depth))
    assert verified.keep.any(-1).any(0).tolist() == [False, True]


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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stress", "gate", "positions"),
    [
        ("rotation_hand_20", Gate.NO_BASELINE, (8, 5, 6, 9, 10, 11)),
        ("convoy_uneven", Gate.CONTRADICTED, (6, 1, 3, 8, 11)),
    ],
)
def test_turned_cameras_and_convoys_have_no_answer(stress, gate, positions):
    (room,) = open_stress([stress], n_frames=12, hw=(168, 224))
    reference, *others = (room.recording[k] for k in positions)
    verified = AUTO(range_split(reference, room.near), others, n=512)
    assert not verified.keep.any() and (verified.gate == gate).any()
