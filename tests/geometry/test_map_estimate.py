"""Most probable pose: noise, choice of tracks and covariance, against ``support/dense_reprojection.py`` and scipy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from support import dense_reprojection as dense
from support.pose_problems import map_pose_inputs

from dhtorch.geometry import se3
from dhtorch.geometry.map_estimate import FitOptions, MapSolution, estimate_map_pose, pose_covariance
from dhtorch.geometry.reprojection_problem import (
    MAX_NOISE_PX,
    MIN_NOISE_PX,
    estimate_noise_variance,
)

D = torch.float64


def problem(batch=1, near=12, far=20, isotropic=0.2, seed=0, **options):
    """A pose problem with one plane per field, and its true unknowns."""
    args, T, turn, _ = map_pose_inputs(batch, near, far, seed=seed, **options)
    return dense.problem_of(args, isotropic), dense.unknowns(T.R, T.t, turn)


# ------------------------------------------------------------------------------------------------ noise


@pytest.mark.parametrize(
    ("near_px", "far_px", "want"),
    [
        (0.4, 1.2, (0.4, 1.2)),
        (1.2, 0.4, (1.2, 0.4)),
        (0.004, 0.4, (MIN_NOISE_PX, 0.4)),
        (9.0, 30.0, (MAX_NOISE_PX,) * 2),
    ],
)
def test_the_noise_is_that_of_near_and_of_far_residuals_within_its_limits(near_px, far_px, want):
    """Unused tracks and those behind the camera do not count; without far tracks their noise is the near ones'."""
    tracks, at = problem(1, 1500, 1500, noise=0.0, depth=0.0, isotropic=1.0)
    noise = torch.randn(1, 2, 3000, generator=torch.Generator().manual_seed(0), dtype=D)
    tracks = tracks.replace(uv=tracks.uv + noise * torch.where(tracks.far, far_px, near_px)[:, None])
    tracks.near[0, :700], tracks.far[0, -700:], tracks.uv[:, :, :700] = False, False, 0.0
    tracks.ray[:, :, 700:800] *= -1
    found = estimate_noise_variance(tracks, at).sqrt()
    for kind, sigma in ((tracks.near, want[0]), (tracks.far, want[1])):
        assert found[kind].unique().numel() == 1 and float(found[kind][0]) == pytest.approx(sigma, rel=0.08)
    one = estimate_noise_variance(tracks, at, rounds=1).sqrt()
    assert float((one - found).abs().max()) == pytest.approx(0, abs=0.1 * max(want))
    alone = estimate_noise_variance(tracks.replace(far=tracks.far & False), at).sqrt()
    torch.testing.assert_close(alone, found[:, 800:801].expand_as(alone))


# ------------------------------------------------------------------------------------------------ covariance


def plain_covariance(problem, solution, o, b):
    """A⁻¹ M A⁻¹ with a column for every inverse depth, eliminated from both."""
    tracks = dense.tracks(problem, solution.at, solution.noise, b)
    bread, meat = [0.0] * len(tracks), [0.0] * len(tracks)
    for kind, omega, size in (("near", 1.0, 2), ("far", float(solution.far_weight[b]), 1)):
        used = [k for k, x in enumerate(tracks) if getattr(x, kind) and x.front]
        square = np.array([tracks[k].square for k in used])
        w, bend = (np.array([dense.weight(s, o.kernel, o.bend)[i] for s in square]) for i in (1, 2))
        rise = w + bend * square * 2 / size  # of psi = w r, mean over directions
        n = len(used)
        spent = size * n / max(size * n - 6, 1)
        few = 1 + 6 / (size * n) * rise.var() / max(rise.mean() ** 2, 0.01)
        slope = max(rise.mean() / w.mean(), 0.1) / few
        scatter = (w**2 * square).sum() / size / (w**2).sum() * spent**2
        for k, x in zip(used, w, strict=True):
            bread[k], meat[k] = omega * x * slope, omega**2 * x**2 * scatter
    A, M = dense.reduced(tracks, bread)[0], dense.reduced(tracks, meat)[0]
    known = np.diag([0.0] * 6 + [o.shutter_sigma**-2 if o.shutter_sigma else 1e18] * 3)
    inverse = np.linalg.inv(A + known)
    return inverse @ (M + known) @ inverse


@pytest.mark.parametrize(
    "o",
    [
        FitOptions(far_weight=0.1),
        FitOptions(far_weight=0.7, kernel="huber", bend=1.0, shutter_sigma=1e-3),
        FitOptions(far_weight=1.0, kernel="cauchy", bend=1.5, shutter_sigma=0.0),
        FitOptions(far_weight=0.3, kernel=None, shutter_sigma=0.1),
        FitOptions(far_weight=0.3, kernel="geman_mcclure", bend=0.3),  # all residuals beyond the bend
    ],
)
def test_the_covariance_is_the_sandwich_of_an_m_estimator(o):
    tracks, at = problem(2, 9, 16, noise=0.5, turn=0.003, seed=3)
    tracks.near[0, 2], tracks.far[1, -3] = False, False
    tracks.uv[:, :, 11] += 30.0  # a mistrack
    tracks.ray[0, :, 4] *= -1  # behind the camera
    noise = torch.where(tracks.far, 0.5, 0.3).to(D) * torch.tensor([[1.0], [1.7]], dtype=D)
    far = torch.tensor([o.far_weight, 0.25 * o.far_weight], dtype=D)
    solution = MapSolution(at, noise, far, torch.full((2,), 7.0, dtype=D), torch.ones(2) > 0)
    cov, ok = pose_covariance(tracks, solution, o)
    assert ok.all() and torch.equal(cov, cov.mT)
    for b in range(2):
        wanted = plain_covariance(tracks, solution, o, b)
        scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
        np.testing.assert_allclose(cov[b].numpy() / scale, wanted / scale, rtol=0, atol=1e-6)


def test_a_pose_that_is_not_determined_has_no_covariance():
    tracks, at = problem(2, 9, 16)
    tracks.near[1], tracks.far[1] = False, False
    tracks.near[1, 0] = True
    noise = torch.full_like(tracks.inverse, 0.1)
    one = torch.ones(2, dtype=D)
    cov, ok = pose_covariance(tracks, MapSolution(at, noise, one, one, one > 0), FitOptions())
    assert ok.tolist() == [True, False] and cov[0].any() and not cov[1].any()


# ------------------------------------------------------------------------------------------------ choices

#: Enough steps that what is compared are optima.
LONG = {"near_steps": 12, "steps": 12}


def costs(problem, at, noise, o, far_weight, only_near=False, b=0):
    tracks = dense.tracks(problem, at, noise, b)
    if only_near:
        tracks = [x for x in tracks if x.near]
    return dense.cost(tracks, far_weight, o.kernel, o.bend)


def contradiction():
    """Few tracks, whose far ones have turned on their own: the near cost rises by some tens of per cent."""
    tracks, at = problem(1, 12, 60, noise=0.3, depth=0.003, baseline=0.3, seed=4)
    shift = torch.tensor([[[3.3], [2.1]]], dtype=D) * tracks.far[:, None]
    return tracks.replace(uv=tracks.uv + shift), at


def test_far_tracks_are_believed_up_to_the_rise_of_the_near_cost_that_is_allowed():
    tracks, at = contradiction()
    o = FitOptions(far_weight=0.5, shutter_sigma=0.0, **LONG)
    near, both = (estimate_map_pose(tracks, at.T, replace(o, max_rise=x)) for x in (-9.0, 1e9))
    assert float(near.far_weight) == 0 and float(both.far_weight) == 0.5
    noise = estimate_noise_variance(tracks, both.at)
    before, after = (costs(tracks, x.at, noise, o, 0.5, only_near=True) for x in (near, both))
    rise = (after - 1.0) / before - 1
    assert 0.1 < rise < 3, "a case that depends on the option, and on one unit of slack"
    for share, believed in ((0.97, False), (1.03, True)):
        found = estimate_map_pose(tracks, at.T, replace(o, max_rise=share * rise))
        wanted = both if believed else near
        assert float(found.far_weight) == float(wanted.far_weight)
        torch.testing.assert_close(found.at.T.t, wanted.at.T.t, rtol=0, atol=1e-12)


def test_a_turn_is_believed_from_the_share_of_the_cost_that_is_asked():
    tracks, at = problem(1, 30, 40, noise=0.3, depth=0.003, turn=0.002, seed=6)
    o = FitOptions(far_weight=0.5, max_rise=1e9, shutter_sigma=0.003, translation_gain=-1e9, **LONG)
    rigid, turned = (estimate_map_pose(tracks, at.T, replace(o, shutter_gain=x)) for x in (1e9, -1e9))
    assert float(rigid.shutter_precision) > 1e12 and rigid.at.shutter_rate.abs().max() < 1e-9
    assert float(turned.shutter_precision) == pytest.approx(0.003**-2) and turned.at.shutter_rate.abs().max() > 1e-4
    noise = estimate_noise_variance(tracks, rigid.at)
    held = float((turned.at.shutter_rate**2).sum()) / 0.003**2
    before, after = costs(tracks, rigid.at, noise, o, 0.5), costs(tracks, turned.at, noise, o, 0.5) + held
    gain = (before - after - 1.0) / before
    assert 0.05 < gain < 0.9
    for share, believed in ((0.97, True), (1.03, False)):
        found = estimate_map_pose(tracks, at.T, replace(o, shutter_gain=share * gain))
        torch.testing.assert_close(
            found.at.shutter_rate, (turned if believed else rigid).at.shutter_rate, rtol=0, atol=1e-9
        )


def test_a_translation_is_believed_from_the_share_that_no_rotation_takes_away():
    """The best pure rotation by scipy, from the written-out cost."""
    tracks, at = problem(1, 14, 30, noise=0.5, depth=0.003, baseline=0.004, seed=8)
    o = FitOptions(far_weight=0.5, max_rise=1e9, shutter_sigma=0.0, **LONG)
    solution = estimate_map_pose(tracks, at.T, o)
    noise = estimate_noise_variance(tracks, solution.at)
    ray, uv, xx_xy_yy = (getattr(tracks, k)[0].numpy() for k in ("ray", "uv", "shape"))
    W = np.linalg.inv(xx_xy_yy[[0, 1, 1, 2]].T.reshape(-1, 2, 2) * noise[0].numpy()[:, None, None])

    def rotated(w):
        Y = (se3.exp(torch.tensor([[*w, 0.0, 0.0, 0.0]], dtype=D)).R @ solution.at.T.R)[0].numpy() @ ray
        r = tracks.f[0].numpy()[:, None] * Y[:2] / Y[2] + tracks.c[0].numpy()[:, None] - uv
        square = np.einsum("in,nij,jn->n", r, W, r)
        return (square / (1 + square / 4) * np.where(tracks.far[0], 0.5, 1.0)).sum()

    found = minimize(rotated, np.zeros(3), method="BFGS", options={"gtol": 1e-3})
    gain = (found.fun - costs(tracks, solution.at, noise, o, 0.5) - 1.0) / found.fun
    assert 0.05 < gain < 0.9
    for share, believed in ((0.98, True), (1.02, False)):
        again = estimate_map_pose(tracks, at.T, replace(o, translation_gain=share * gain))
        assert bool(again.translates) is believed
