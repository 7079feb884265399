"""Stage 6 alone, on made-up geometry: every gate at its limit, every option, and sigma recomputed term by term."""

import math

import numpy as np
import pytest
import torch

from dhtorch.codes import Gate, PoseCode
from dhtorch.geometry import camera as cam
from dhtorch.geometry import epipolar, reprojection_problem, se3
from dhtorch.records import Camera, Pose, PoseFit, Samples, Shutter, Tracks
from dhtorch.stages.triangulate import two_view

B, N = 3, 9


def rand(*shape, seed):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def spd(*shape, seed):
    """Random covariances (…, n, n) with correlations."""
    half = rand(*shape, shape[-1], seed=seed) - 0.5
    return half @ half.mT + 0.05 * torch.eye(shape[-1], dtype=torch.float64)


def camera(f, c):
    return Camera(torch.tensor([f]).repeat(B, 1).double(), torch.tensor([c]).repeat(B, 1).double())


CAMERA_0, CAMERA_1 = camera((500.0, 540.0), (320.0, 240.0)), camera((420.0, 390.0), (300.0, 260.0))
MOTION = torch.tensor([[0.06, -0.09, 0.04, 0.25, -0.08, 0.05]]).double().repeat(B, 1)


def stage(seed=0, noise_px=0.6):
    """(samples, tracks, fit) of points with everything that an option may read, and their depth; pairs differ."""
    uv_0 = rand(B, N, 2, seed=seed) * torch.tensor([600.0, 440.0]) + 20
    depth = 2 + 3 * rand(B, N, seed=seed + 1)
    T = se3.exp(MOTION * torch.tensor([[1.0], [1.2], [-0.8]]))
    uv_1 = cam.project(CAMERA_1, se3.apply(T, cam.unproject(CAMERA_0, uv_0, depth)))
    uv_1 = uv_1 + noise_px * (2 * rand(B, N, 2, seed=seed + 2) - 1)
    zero = torch.zeros(B, N, dtype=torch.float64)
    flag = zero.to(torch.int32)
    samples = Samples(
        uv=uv_0 + 0.25,  # of the distorted picture: handed on, not computed with
        depth=1 + rand(B, N, seed=seed + 3),
        sigma=0.02 + 0.05 * rand(B, N, seed=seed + 4),
        xyz=torch.zeros(B, N, 3, dtype=torch.float64),
        confidence=zero,
        flag=flag,
        trackability=0.001 + 0.02 * rand(B, N, seed=seed + 5),
        hole=flag,
    )
    tracks = Tracks(
        uv_0=uv_0,
        uv_1=uv_1,
        error=0.5 * rand(B, N, seed=seed + 6),
        photometric=0.1 * rand(B, N, seed=seed + 7),
        cov=0.3 * spd(B, N, 2, seed=seed + 8),
        valid=zero == 0,
    )
    fit = PoseFit(
        T_1_from_0=T,
        cov=1e-5 * spd(B, 6, seed=seed + 9),
        inlier=rand(B, N, seed=seed + 10) < 0.5,
        n_inlier=torch.full((B,), 7),
        rms_px=torch.full((B,), 9.0).double(),
        sigma_px=torch.tensor([0.4, 0.7, 1.1]).double(),
        t_snr=torch.tensor([20.0, 50.0, 90.0]).double(),
        code=torch.tensor([PoseCode.OK, PoseCode.KEPT_PNP, PoseCode.OK], dtype=torch.int32),
    )
    return samples, tracks, fit, depth


OPEN = {"min_parallax_deg": None, "max_residual_px": None}


def ask(samples, tracks, fit, **options):
    return two_view(samples, tracks, fit, CAMERA_0, CAMERA_1, **{**OPEN, **options})


def lower_median(values):
    return sorted(values)[(len(values) - 1) // 2]


def plain_sigmas(
    samples,
    tracks,
    fit,
    *,
    fitted_noise=False,
    isotropic=0.1,
    mismatch_px=None,
    residual_px=None,
    round_trip_px=None,
    sigma_scale=1.0,
    sensor_share=0.0,
):
    """Own and shared standard deviation (B, N) by loops: gradients of the pixel by autograd, sums by numpy."""
    found = epipolar.triangulate(tracks.uv_0, tracks.uv_1, CAMERA_0, CAMERA_1, fit.T_1_from_0)
    own, shared = np.zeros((B, N)), np.zeros((B, N))
    for b in range(B):
        one = slice(b, b + 1)
        T, z = fit.T_1_from_0[one], found.depth[one]

        def pixel(depth, xi, one=one, T=T):
            moved = se3.retract(T, xi[None])
            return cam.project(CAMERA_1[one], se3.apply(moved, cam.unproject(CAMERA_0[one], tracks.uv_0[one], depth)))

        at = torch.zeros(6, dtype=torch.float64)
        by_pose = torch.autograd.functional.jacobian(lambda xi, z=z, pixel=pixel: pixel(z, xi)[0], at).numpy()
        by_depth = torch.autograd.functional.jacobian(lambda z, at=at, pixel=pixel: pixel(z, at)[0].sum(0), z)
        miss = (tracks.uv_1[one] - pixel(z, at))[0].norm(dim=-1).numpy()
        size = lower_median([float(tracks.cov[b, k].trace() / 2) for k in range(N)])
        held = [float(samples.sigma[b, k] / samples.depth[b, k]) for k in range(N) if fit.inlier[b, k]]
        for k in range(N):
            slope, J = by_depth[:, 0, k].numpy(), by_pose[k]
            cov = tracks.cov[b, k].numpy()
            if fitted_noise:
                cov = ((1 - isotropic) * cov / size + isotropic * np.eye(2)) * float(fit.sigma_px[b]) ** 2
            gain = slope / (slope @ slope)
            doubt = 1.0
            if mismatch_px is not None:
                doubt += (float(tracks.photometric[b, k]) / math.sqrt(samples.trackability[b, k]) / mismatch_px) ** 2
            if residual_px is not None:
                doubt += (miss[k] / residual_px) ** 2
            if round_trip_px is not None:
                doubt += (float(tracks.error[b, k]) / round_trip_px) ** 2
            own[b, k] = gain @ cov @ gain * sigma_scale**2 * doubt
            shared[b, k] = (gain @ J) @ fit.cov[b].numpy() @ (gain @ J) * sigma_scale**2
            if held:
                shared[b, k] += (sensor_share * lower_median(held) * float(z[0, k])) ** 2
    return np.sqrt(own + shared), np.sqrt(shared)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"fitted_noise": True},
        {"fitted_noise": True, "isotropic": 0.6},
        {"mismatch_px": 0.7},
        {"residual_px": 0.3},
        {"round_trip_px": 0.2},
        {"sigma_scale": 1.7},
        {"sensor_share": 0.6},
        {"fitted_noise": True, "mismatch_px": 2.0, "residual_px": 0.5, "round_trip_px": 0.4}
        | {"sensor_share": 1.0, "sigma_scale": 0.8},
    ],
)
def test_sigma_is_the_sum_of_its_terms(options):
    samples, tracks, fit, _ = stage()
    estimate = ask(samples, tracks, fit, **options)
    whole, shared = plain_sigmas(samples, tracks, fit, **options)
    assert estimate.keep.all()
    np.testing.assert_allclose(estimate.sigma.numpy(), whole, rtol=1e-7)
    np.testing.assert_allclose(estimate.sigma_shared.numpy(), shared, rtol=1e-7)


def test_the_noise_of_the_sensor_is_that_of_the_returns_that_hold_the_pose():
    """An even number has the lower of the middle two; one without a return and a pair without inliers add nothing."""
    samples, tracks, fit, _ = stage()
    plain = ask(samples, tracks, fit)
    inlier = torch.zeros(B, N, dtype=torch.bool)
    inlier[0, :4], inlier[1, :3] = True, True
    relative = torch.full((B, N), 0.5).double()
    relative[0, :4], relative[1, :2] = torch.tensor([0.04, 0.01, 0.02, 0.03]), torch.tensor([0.03, 0.05])
    depth = samples.depth.clone()
    depth[1, 2] = 0
    sigma = torch.where(depth > 0, relative * depth, 7.0).requires_grad_()
    sensed = samples.replace(depth=depth, sigma=sigma)
    found = ask(sensed, tracks, fit.replace(inlier=inlier), sensor_share=0.5)
    added = (found.sigma_shared**2 - plain.sigma_shared**2).clamp_min(0).sqrt() / plain.depth
    expected = torch.tensor([[0.5 * 0.02], [0.5 * 0.03], [0.0]]).double().expand(B, N)
    torch.testing.assert_close(added.detach(), expected, atol=1e-9, rtol=1e-9)
    found.sigma.sum().backward()
    assert sigma.grad.isfinite().all() and (sigma.grad > 0).sum(1).tolist() == [1, 1, 0], "to the median alone"


def test_a_rolling_shutter_counts_with_all_correlations_of_rotation_translation_and_turn():
    """Against the gradient of depth by autograd, for exact points and a shutter whose turn is found to be zero."""
    samples, tracks, fit, depth = stage(noise_px=0.0)
    cov = 1e-5 * spd(B, 9, seed=20)
    none = torch.zeros(B, 3, dtype=torch.float64)
    rolling = fit.replace(shutter=Shutter(none, cov))
    estimate = ask(samples, tracks, rolling)
    y = (tracks.uv_0[..., 1] - CAMERA_0.c[:, 1:]) / CAMERA_0.f[:, 1:]
    own = ask(samples, tracks, fit)
    own = own.sigma**2 - own.sigma_shared**2
    for b in range(B):
        one = slice(b, b + 1)

        def depths(unknown, one=one):
            pose, turn = unknown[None, :6], unknown[None, 6:]
            lens = CAMERA_1[one]
            uv_1 = reprojection_problem.undo_rolling_shutter(tracks.uv_1[one].mT, lens.f, lens.c, y[one], turn).mT
            T = se3.retract(fit.T_1_from_0[one], pose)
            return epipolar.triangulate(tracks.uv_0[one], uv_1, CAMERA_0[one], lens, T).depth[0]

        J = torch.autograd.functional.jacobian(depths, torch.zeros(9, dtype=torch.float64))
        shared = ((J @ cov[b]) * J).sum(-1)
        torch.testing.assert_close(estimate.sigma_shared[b], shared.sqrt(), rtol=1e-6, atol=0)
        torch.testing.assert_close(estimate.sigma[b], (own[b] + shared).sqrt(), rtol=1e-6, atol=0)
    torch.testing.assert_close(estimate.depth, depth)


# ---------------------------------------------------------------------------------------------------- gates


def told(**values):
    """A solver that answers what the test says: all gates pass but for what is named, each by point."""

    def solver(uv_0, *_):
        like = torch.ones_like(uv_0[..., 0])
        fields = {"depth": 4 * like, "depth_1": 3 * like, "parallax": like, "residual_px": 0.5 * like}
        fields |= {k: torch.as_tensor(v).to(like).expand_as(like) for k, v in values.items()}
        slope = torch.stack((10 * like, 0 * like), -1)
        return epipolar.TwoView(**fields, slope=slope, J_pose=torch.zeros(*like.shape, 2, 6, dtype=like.dtype))

    return solver


def flat(n, batch=1, cov=1.0):
    """(samples, tracks, fit) of n points that pass every gate, with variance 0.01 m² of cov 1."""
    samples, tracks, fit, _ = stage()
    grow = lambda r: r.map(lambda x: x[:1, :1].expand(batch, n, *x.shape[2:]).clone())  # noqa: E731
    samples, tracks = grow(samples), grow(tracks)
    tracks = tracks.replace(cov=cov * torch.eye(2).double().expand(batch, n, 2, 2), photometric=0 * tracks.error)
    samples = samples.replace(trackability=0 * samples.trackability + 1)
    fit = fit.map(lambda x: x[:1].expand(batch, *x.shape[1:]).clone())
    return samples, tracks, fit.replace(inlier=torch.zeros(batch, n, dtype=torch.bool))


def gates(samples, tracks, fit, **options):
    batch = tracks.uv_0.shape[0]
    two = [c.map(lambda x: x[:1].expand(batch, -1)) for c in (CAMERA_0, CAMERA_1)]
    return two_view(samples, tracks, fit, *two, **options).gate


POINT_GATES = [Gate.NO_TRACK, Gate.BEHIND, Gate.PARALLAX, Gate.RESIDUAL, Gate.INCONSISTENT, Gate.UNCERTAIN, Gate.ANSWER]


def test_of_several_reasons_the_first_in_the_order_asked_is_named():
    """Point k fails gate k and all after it; the pairs have no baseline and no pose, no pose, a weak one, a sound one."""
    n = len(POINT_GATES)
    samples, tracks, fit = flat(n, batch=4)
    k = torch.arange(n)
    tracks = tracks.replace(
        valid=(k > 0).expand(4, n),
        photometric=torch.where(k <= 4, 9.0, 0.0).double().expand(4, n),
        cov=torch.where(k <= 5, 1e4, 1.0)[:, None, None] * tracks.cov,
    )
    code = [PoseCode.NO_BASELINE, PoseCode.TOO_FEW, PoseCode.OK, PoseCode.OK]
    fit = fit.replace(code=torch.tensor(code, dtype=torch.int32), t_snr=torch.tensor([1.0, 1.0, 1.0, 99.0]).double())
    solver = told(
        depth=torch.where(k <= 1, -4.0, 4.0),
        parallax=torch.where(k <= 2, 1e-4, 1.0),
        residual_px=torch.where(k <= 3, 9.0, 0.5),
    )
    found = gates(samples, tracks, fit, solver=solver, min_t_snr=30.0, max_mismatch_px=1.0, max_sigma_rel=0.2)
    for row, all_points in zip(found, (Gate.NO_BASELINE, Gate.NO_POSE, Gate.NO_BASELINE, None), strict=True):
        expected = POINT_GATES if all_points is None else [Gate.NO_TRACK] + [all_points] * (n - 1)
        assert row.tolist() == expected


def test_a_point_behind_the_other_camera_alone_is_not_answered():
    """View 1 looks back at the anchor: what the reference view sees far ahead is in front of both, what is near is not."""
    samples, tracks, fit = flat(2)
    T = Pose(torch.diag(torch.tensor([-1.0, 1.0, -1.0]))[None].double(), torch.tensor([[0.4, 0.0, 3.0]]).double())
    one = [c[:1] for c in (CAMERA_0, CAMERA_1)]
    uv_0 = torch.tensor([[[330.0, 250.0], [330.0, 250.0]]]).double()
    depth = torch.tensor([[2.0, 5.0]]).double()
    uv_1 = cam.project(one[1], se3.apply(T, cam.unproject(one[0], uv_0, depth)))
    estimate = two_view(samples, tracks.replace(uv_0=uv_0, uv_1=uv_1), fit.replace(T_1_from_0=T), *one, **OPEN)
    assert estimate.gate.tolist() == [[Gate.ANSWER, Gate.BEHIND]]
    torch.testing.assert_close(estimate.depth[0, 0], depth[0, 0])


def photometric(*values):
    return {"photometric": torch.tensor([values]).double()}


NARROW = [0.25 * math.pi / 180, 0.5 * math.pi / 180, 0.75 * math.pi / 180]
PX = torch.tensor([[0.0, 4.9, 5.1, torch.inf]]).double()
COV = {"cov": torch.diag_embed(torch.stack((PX, PX), -1) ** 2)}  # ten pixels a metre: sigma is a tenth of it
BAD, WEAK, FLAT = Gate.INCONSISTENT, Gate.PARALLAX, Gate.RESIDUAL


@pytest.mark.parametrize(
    ("solved", "tracked", "options", "expected"),
    [
        # a point lies in front of both cameras
        ({"depth": [4, 0.1, 4, 4, -4, 0, 4.0], "depth_1": [3, 3, 0.1, -3, 3, 3, 0.0]}, {}, {}, [0] * 3 + [Gate.BEHIND] * 4),
        # parallax is stated in degrees and lies above the limit, 0.3 by default
        ({"parallax": NARROW}, {}, {}, [WEAK, 0, 0]),
        ({"parallax": NARROW}, {}, {"min_parallax_deg": float(torch.tensor(NARROW[1]).double().rad2deg())}, [WEAK, WEAK, 0]),
        ({"parallax": [0.0, 1e-9, 0.1]}, {}, {"min_parallax_deg": 0.0}, [WEAK, 0, 0]),
        ({"parallax": [0.0, 1e-9, 0.1]}, {}, {"min_parallax_deg": None}, [0, 0, 0]),
        # a residual that reaches the limit, 3 px by default, is too large
        ({"residual_px": [2.75, 2.9999, 3.0, 1e9]}, {}, {}, [0, 0, FLAT, FLAT]),
        ({"residual_px": [2.75, 2.9999, 3.0, 1e9]}, {}, {"max_residual_px": 2.75}, [FLAT] * 4),
        ({"residual_px": [2.75, 2.9999, 3.0, 1e9]}, {}, {"max_residual_px": None}, [0] * 4),
        # a mismatch is the grey difference over the root of the texture; without any it is divided by 1e-4
        ({}, photometric(0.5, 0.51, 2.0, 1e-3, torch.nan), {"max_mismatch_px": 1.0}, [0, BAD, 0, BAD, BAD]),
        ({}, photometric(0.5, 0.51, 2.0, 1e-3, torch.nan), {"max_mismatch_px": 9.99}, [0, 0, 0, BAD, BAD]),
        ({}, photometric(0.5, 0.51, 2.0, 1e-3, torch.nan), {"max_mismatch_px": 10.01}, [0, 0, 0, 0, BAD]),
        ({}, photometric(0.5, 0.51, 2.0, 1e-3, torch.nan), {}, [0] * 5),
        # sigma relative to depth passes at the limit
        ({"depth": [5.0] * 4}, COV, {"max_sigma_rel": 0.1}, [0, 0, Gate.UNCERTAIN, Gate.UNCERTAIN]),
        ({"depth": [5.0] * 4}, COV, {"max_sigma_rel": 0.0}, [0] + [Gate.UNCERTAIN] * 3),
    ],
)  # fmt: skip
def test_gates_at_their_limits(solved, tracked, options, expected):
    samples, tracks, fit = flat(len(expected))
    texture = torch.tensor([[0.25, 0.25, 4.0, 0.0, 0.25, 1.0, 1.0]]).double()[:, : len(expected)]
    solved = told(**{k: torch.tensor(v).double() for k, v in solved.items()})
    found = gates(samples.replace(trackability=texture), tracks.replace(**tracked), fit, solver=solved, **options)
    assert found.tolist() == [expected]


def test_a_translation_at_the_limit_is_significant_and_the_poses_part_of_sigma_counts():
    samples, tracks, fit = flat(2, batch=4)
    weak = fit.replace(t_snr=torch.tensor([29.999, 30.0, torch.nan, torch.inf]).double())
    expected = [Gate.NO_BASELINE, 0, Gate.NO_BASELINE, 0]
    assert gates(samples, tracks, weak, solver=told(), min_t_snr=30.0)[:, 0].tolist() == expected
    assert gates(samples, tracks, weak, solver=told())[:, 1].tolist() == [0] * 4
    vague = fit.replace(cov=1e-2 * torch.eye(6).double().expand(4, 6, 6))
    assert (gates(samples, tracks, vague, max_sigma_rel=0.005) == Gate.UNCERTAIN).all()


# ---------------------------------------------------------------------------------------------------- silence


def test_a_place_that_is_no_number_is_no_track_in_whatever_coordinate():
    samples, tracks, fit = flat(6)
    uv_0, uv_1 = tracks.uv_0.clone(), tracks.uv_1.clone()
    uv_0[0, 0, 0], uv_0[0, 1, 1], uv_1[0, 2, 0], uv_1[0, 3, 1] = torch.nan, torch.inf, -torch.inf, torch.nan
    valid = tracks.valid.clone()
    valid[0, 4] = False
    cov = tracks.cov.clone()
    cov[0, :5] = torch.nan
    leaves = [x.requires_grad_() for x in (uv_0, uv_1, cov)]
    grey = torch.where(torch.arange(6) < 5, torch.nan, 0.1).double()[None]
    lost = tracks.replace(uv_0=uv_0, uv_1=uv_1, cov=cov, valid=valid, photometric=grey)
    one = [c[:1] for c in (CAMERA_0, CAMERA_1)]
    found = two_view(samples, lost, fit, *one, **OPEN, mismatch_px=1.0, max_mismatch_px=5.0, fitted_noise=True)
    assert found.gate.tolist() == [[Gate.NO_TRACK] * 5 + [Gate.ANSWER]]
    assert found.n_views.tolist() == [[1] * 5 + [2]] and found.n_views.dtype == torch.int32
    assert (found.parallax_deg[0, :5] == 0).all() and (found.residual_px[0, :5] == 0).all()
    assert found.parallax_deg[0, 5] > 1
    for silent in (found.depth, found.sigma, found.sigma_shared):
        assert silent[0, :5].isnan().all() and silent[0, 5].isfinite()
    (found.sigma[0, 5] + found.depth[0, 5]).backward()
    assert all(x.grad.isfinite().all() for x in leaves)


def test_what_is_silent_by_a_gate_still_says_how_it_was_seen():
    samples, tracks, fit, _ = stage()
    code = torch.tensor([PoseCode.OK, PoseCode.DEGENERATE, PoseCode.KEPT_PNP], dtype=torch.int32)
    nan = fit.T_1_from_0.map(
        lambda x: torch.where((code == PoseCode.DEGENERATE).view(-1, *[1] * (x.dim() - 1)), torch.nan, x)
    )
    lost = fit.replace(T_1_from_0=nan, code=code, cov=torch.where(code[:, None, None] == 2, torch.nan, fit.cov))
    strict = ask(samples, tracks, lost, max_residual_px=0.0)
    geometry = epipolar.triangulate(tracks.uv_0, tracks.uv_1, CAMERA_0, CAMERA_1, fit.T_1_from_0)
    assert (strict.gate[[0, 2]] == Gate.RESIDUAL).all() and (strict.gate[1] == Gate.NO_POSE).all()
    assert torch.equal(strict.uv, samples.uv)
    torch.testing.assert_close(strict.parallax_deg[[0, 2]], geometry.parallax[[0, 2]].rad2deg())
    torch.testing.assert_close(strict.residual_px[[0, 2]], geometry.residual_px[[0, 2]])
    assert (strict.parallax_deg[1] == 0).all() and (strict.residual_px[1] == 0).all()
    assert strict.n_views.tolist() == [[2] * N, [1] * N, [2] * N]
    assert (strict.score == 0).all() and strict.depth.isnan().all()
    assert (ask(samples, tracks, lost).score.sum(1) == torch.tensor([N, 0, N])).all()


def test_gradients_of_a_sigma_of_zero_are_finite():
    samples, tracks, fit, _ = stage()
    cov = (0 * tracks.cov).requires_grad_()
    estimate = ask(samples, tracks.replace(cov=cov), fit.replace(cov=0 * fit.cov))
    assert (estimate.sigma == 0).all() and (estimate.sigma_shared == 0).all()
    (estimate.sigma + estimate.sigma_shared).sum().backward()
    assert (cov.grad == 0).all()


def test_points_without_a_track_do_not_set_the_scale_of_the_noise():
    samples, tracks, fit, _ = stage()
    valid = torch.arange(N) < N - 4
    cov = torch.where(valid[:, None, None], tracks.cov, 1e6 * tracks.cov)
    some = ask(samples, tracks.replace(cov=cov, valid=valid.expand(B, N)), fit, fitted_noise=True)
    first = lambda r: r.map(lambda x: x[:, : N - 4])  # noqa: E731
    alone = ask(first(samples), first(tracks), fit.replace(inlier=fit.inlier[:, : N - 4]), fitted_noise=True)
    torch.testing.assert_close(some.sigma[:, : N - 4], alone.sigma)
