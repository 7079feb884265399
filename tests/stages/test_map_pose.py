"""``map_pose``: accuracy with far tracks, covariance, which tracks and shutter rates are accepted."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from support import dense_reprojection as dense
from support.pose_problems import map_pose_inputs

from dhtorch.codes import Gate, PoseCode
from dhtorch.geometry import camera as cam
from dhtorch.geometry import covariance, map_estimate, se3
from dhtorch.records import Pose
from dhtorch.stages.pose import map_pose
from dhtorch.stages.triangulate import two_view

D = torch.float64


def errors(fit, T):
    """Rotation (rad) and translation (m) errors as one tangent vector (B, 6)."""
    delta = se3.compose(Pose(fit.T_1_from_0.R.to(D), fit.T_1_from_0.t.to(D)), se3.invert(T))
    R = delta.R
    omega = 0.5 * torch.stack((R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]), -1)
    return torch.cat((omega, delta.t), -1)


def nees(fit, T):
    return covariance.mahalanobis(errors(fit, T), fit.cov.to(D)) ** 2 / 6


def put(args, **changes):
    """Arguments of ``map_pose`` with fields of the tracks (or ``xyz``) replaced."""
    samples, tracks, *rest = args
    if "xyz" in changes:
        samples = samples.replace(xyz=changes.pop("xyz"))
    return samples, tracks.replace(**changes), *rest


# -------------------------------------------------------------------------------------------------- accuracy


@pytest.mark.parametrize("planar", [False, True])
def test_exact_tracks_give_the_exact_pose(planar):
    args, T, _, _ = map_pose_inputs(4, 12, 30, noise=0.0, depth=0.0, planar=planar)
    fit = map_pose(*args)
    assert (fit.code == PoseCode.OK).all() and fit.inlier[:, :12].all() and not fit.inlier[:, 12:].any()
    assert errors(fit, T).abs().max() < 1e-8 and fit.shutter.shutter_rate.abs().max() < 1e-8


@pytest.mark.parametrize(("trials", "band"), [(80, 0.25), pytest.param(500, 0.05, marks=pytest.mark.slow)])
def test_covariance_is_that_of_the_errors(trials, band):
    """Trials with the assumed noise: the mean of the normalised squared error lies in the band of chi² / 6."""
    args, T, _, _ = map_pose_inputs(trials, 60, 140)
    fit = map_pose(*args, shutter_sigma=0.0, isotropic=0.0)
    assert (fit.code == PoseCode.OK).all()
    assert abs(nees(fit, T).mean() - 1) < band  # 1.96 of its deviations are 1.96 sqrt(2 / (6 trials))
    assert abs(fit.sigma_px.mean() / (0.3 * 2.5**0.5) - 1) < 0.05  # the shapes' median mean variance is 2.5


# ------------------------------------------------------------------------------------------------------- options


def newton_step(args, fit, o, isotropic):
    """Of one pair: how far the written-out problem (``support/dense_reprojection.py``) would still go from the answer, in its deviations."""
    problem = dense.problem_of(args, isotropic)
    at = dense.unknowns(fit.T_1_from_0.R, fit.T_1_from_0.t, fit.shutter.shutter_rate)
    tracks = dense.tracks(problem, at, map_estimate.estimate_noise_variance(problem, at))
    weights = [dense.weight(x.square, o.kernel, o.bend)[1] * (x.near + o.far_weight * x.far) for x in tracks]
    H, g = dense.reduced(tracks, weights)
    known = np.diag([0.0] * 6 + [o.shutter_sigma**-2 if fit.shutter.shutter_rate.abs().amax() > 1e-9 else 1e18] * 3)
    step = np.linalg.solve(H + known, g + known @ np.append(np.zeros(6), at.shutter_rate[0].numpy()))
    return np.abs(step[:6] / np.sqrt(np.diag(np.linalg.inv(H + known)))[:6]).max()


@pytest.mark.parametrize(
    ("isotropic", "options"),
    [
        (0.1, {}),
        (1.0, {}),
        (0.1, {"far_weight": 1.0}),
        (0.1, {"bend": 0.7}),
        (0.1, {"kernel": "huber", "bend": 0.7}),
        (0.1, {"kernel": None}),
        (0.1, {"shutter_sigma": 0.002, "shutter_gain": -1.0}),
    ],
)
def test_the_answer_is_the_optimum_of_the_problem_that_its_options_describe(isotropic, options):
    """And not the optimum of the default's, so every option reaches the problem."""
    args, *_ = map_pose_inputs(1, 20, 40, depth=0.01 if "bend" in options else 0.03, turn=0.002, seed=2)
    base = map_estimate.FitOptions(max_rise=10.0, near_steps=8, steps=16, shutter_sigma=0.0, translation_gain=-9.0)
    o = replace(base, **options)
    fit = map_pose(*args, isotropic=isotropic, **asdict(o))
    assert fit.code.tolist() == [PoseCode.OK] and (fit.shutter.shutter_rate.abs().amax() > 1e-5) == (
        o.shutter_sigma > 0
    )
    assert newton_step(args, fit, o, isotropic) < 0.1
    if options or isotropic != 0.1:
        plain = map_pose(*args, **asdict(base))
        assert newton_step(args, plain, o, isotropic) > 0.2 or o.shutter_sigma > 0


def test_the_fields_of_a_pose_fit_follow_from_its_tracks():
    """Inliers, their rms, the noise and the significance of the translation, from numpy, one track at a time."""
    args, *_ = map_pose_inputs(2, 24, 40, turn=0.004, seed=3)
    _samples, tracks, _camera_0, _camera_1, _ = args
    wrong = tracks.uv_1.clone()
    wrong[:, 2, 0] += 2.0
    wrong[:, 5, 1] -= 5.0
    args = put(args, uv_1=wrong)
    for limit in (1.5, 3.0):
        fit = map_pose(*args, threshold_px=limit)
        assert fit.ok.all() and fit.shutter.shutter_rate.abs().amax(-1).min() > 1e-4
        problem = dense.problem_of(args, 0.1)
        at = dense.unknowns(fit.T_1_from_0.R, fit.T_1_from_0.t, fit.shutter.shutter_rate)
        for b in range(2):
            error = np.array([np.linalg.norm(x.r) for x in dense.tracks(problem, at, problem.inverse, b) if x.near])
            assert fit.inlier[b, :24].tolist() == (error < limit).tolist() and not fit.inlier[b, 24:].any()
            assert int(fit.n_inlier[b]) == (error < limit).sum() and not fit.inlier[b, 5]
            np.testing.assert_allclose(float(fit.rms_px[b]), np.sqrt((error[error < limit] ** 2).mean()), rtol=1e-6)
            t, cov = fit.T_1_from_0.t[b].numpy(), fit.cov[b, 3:, 3:].numpy()
            np.testing.assert_allclose(float(fit.t_snr[b]), np.sqrt(t @ np.linalg.inv(cov) @ t), rtol=1e-7)
            noise = map_estimate.estimate_noise_variance(problem, at)[b]
            np.testing.assert_allclose(float(fit.sigma_px[b]) ** 2, float(noise[30]), rtol=0.2)
        assert torch.equal(fit.cov, fit.shutter.cov[:, :6, :6])
    args = put(args, uv_1=tracks.uv_1, valid=tracks.valid & (torch.arange(64) < 24))
    alone = map_pose(*args, translation_gain=-9.0)  # without far tracks their noise is that of the near ones
    at = dense.unknowns(alone.T_1_from_0.R, alone.T_1_from_0.t, alone.shutter.shutter_rate)
    noise = map_estimate.estimate_noise_variance(dense.problem_of(args, 0.1), at)[:, 0]
    assert alone.ok.all()
    torch.testing.assert_close(alone.sigma_px**2, noise, rtol=0.2, atol=0)


# ------------------------------------------------------------------------------------------------ what is believed


def test_rows_that_turn_are_found_and_undone():
    args, T, b, z = map_pose_inputs(12, 80, 160, turn=0.01)
    loose, rigid = map_pose(*args), map_pose(*args, shutter_sigma=0.0)
    assert loose.ok.all()
    assert (loose.shutter.shutter_rate - b).norm(dim=-1).median() < 0.1 * b.norm(dim=-1).median()
    assert errors(loose, T)[:, :3].norm(dim=-1).median() < 0.5 * errors(rigid, T)[:, :3].norm(dim=-1).median()
    far = torch.arange(240) >= 80
    error = []
    for fit in (loose, rigid):
        estimate = two_view(*args[:2], fit, *args[2:4])
        error.append((estimate.depth / z - 1).abs()[estimate.keep & far].median())
    assert error[0] < 0.7 * error[1]
    still = map_pose(*map_pose_inputs(16, 80, 160)[0])
    assert (
        still.shutter.shutter_rate.abs() < 1e-9
    ).double().mean() > 0.9  # 2 % of the cost is not taken away by chance


def test_far_tracks_that_contradict_are_left_out():
    """The far scene turns on its own: the pose is that of the near tracks, and the fit reports it."""
    args, T, _, _ = map_pose_inputs(4, 80, 400, baseline=0.3, noise=0.1, depth=0.002)
    camera_1, uv_1 = args[3], args[1].uv_1
    ray = cam.rays(camera_1, uv_1)
    turned = ray + torch.linalg.cross(torch.tensor([0.002, 0.004, 0.003], dtype=D).expand_as(ray), ray)
    far = (torch.arange(480) >= 80)[:, None]
    moved = put(args, uv_1=torch.where(far, cam.project(camera_1, turned), uv_1))
    fit, believed, near = (
        map_pose(*moved, shutter_sigma=0.0, far_weight=weight, max_rise=rise)
        for weight, rise in ((1.0, 0.1), (1.0, 1e9), (1e-9, 0.1))
    )
    assert (fit.code == PoseCode.KEPT_PNP).all() and (believed.code == PoseCode.OK).all()
    torch.testing.assert_close(fit.T_1_from_0.t, near.T_1_from_0.t, rtol=0, atol=1e-4)
    assert errors(fit, T)[:, 3:].norm(dim=-1).median() < 0.2 * errors(believed, T)[:, 3:].norm(dim=-1).median()


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_pure_rotation_gives_no_depth(noise):
    args, _, _, _ = map_pose_inputs(8, 80, 160, baseline=0.0, noise=noise)
    fit = map_pose(*args)
    assert (fit.code == PoseCode.NO_BASELINE).all() and not fit.ok.any() and fit.T_1_from_0.t.isnan().all()
    estimate = two_view(*args[:2], fit, *args[2:4])
    assert (estimate.gate == Gate.NO_BASELINE).all()
    if noise:
        assert (map_pose(*args, translation_gain=-1e9).code != PoseCode.NO_BASELINE).all()


def test_without_a_start_there_is_no_pose():
    args, _, _, _ = map_pose_inputs(3, 30, 60)
    valid = args[1].valid.clone()
    valid[0, 3:30], valid[1, :] = False, False
    fit = map_pose(*put(args, valid=valid))
    assert fit.code.tolist() == [PoseCode.TOO_FEW, PoseCode.TOO_FEW, PoseCode.OK]
    for x in (
        fit.T_1_from_0.R,
        fit.T_1_from_0.t,
        fit.cov,
        fit.sigma_px,
        fit.t_snr,
        fit.shutter.shutter_rate,
        fit.shutter.cov,
    ):
        assert x[:2].isnan().all() and x[2].isfinite().all()
    assert not fit.inlier[:2].any()


def test_near_tracks_that_say_nothing_of_their_depth_leave_the_pose_undetermined():
    """Without a standard deviation they are no near tracks, and far ones alone have no scale."""
    args, *_ = map_pose_inputs(3, 30, 60)
    sigma = args[0].sigma.clone()
    sigma[0], sigma[1] = torch.nan, 0.0
    fit = map_pose(args[0].replace(sigma=sigma), *args[1:])
    assert fit.code.tolist() == [PoseCode.DEGENERATE, PoseCode.DEGENERATE, PoseCode.OK]
    assert fit.T_1_from_0.t[:2].isnan().all() and not fit.inlier[:2].any()
    line = args[0].xyz.clone()
    line[0, :30] = line[0, :1] + torch.linspace(0, 1, 30, dtype=D)[:, None] * torch.tensor([0.3, 0.1, 0.4], dtype=D)
    on_line = put(args, xyz=line, uv_1=args[1].uv_1)
    assert map_pose(*on_line).code[0] in (PoseCode.DEGENERATE, PoseCode.TOO_FEW)


@pytest.mark.parametrize("seed", range(3))
def test_returns_from_far_away_do_not_hide_a_baseline(seed):
    """A pose that is fixed by the near returns alone is fixed with all returns, too."""
    (samples, *others), _, _, z = map_pose_inputs(1, 60, 300, noise=0.4, baseline=0.025, rotation=0.0, seed=seed)
    cut = map_pose(samples, *others)
    known = torch.where(samples.depth > 0, samples.depth, z)
    ray = cam.rays(others[1], samples.uv)
    everything = samples.replace(depth=known, xyz=torch.where(samples.xyz.isfinite(), samples.xyz, ray * z[..., None]))
    whole = map_pose(everything, *others)
    assert cut.ok.all() and whole.ok.all()
