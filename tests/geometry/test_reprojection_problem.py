"""Reprojection problem of near and far tracks, against ``support/dense_reprojection.py`` (track by track) and autograd."""

from functools import partial

import numpy as np
import pytest
import torch
from support import dense_reprojection as dense
from support.pose_problems import BEHIND, BEYOND, EPIPOLE, FAR, NOISE, UNUSED, N, pose_depth_problem

from dhtorch.geometry import reprojection_problem, se3
from dhtorch.geometry.least_squares import move_pose
from dhtorch.geometry.reprojection_problem import Unknowns

D = torch.float64


def every(problem, at):
    return [dense.tracks(problem, at, NOISE, b) for b in range(2)]


# ------------------------------------------------------------------------------------------------ one track


def test_pixels_are_turned_back_by_their_row():
    problem, at = pose_depth_problem()
    y = problem.ray[:, 1] / problem.ray[:, 2]
    found = reprojection_problem.undo_rolling_shutter(problem.uv, problem.f, problem.c, y, at.shutter_rate)
    for b in range(2):
        for k in range(N):
            ray = np.append(((problem.uv[b, :, k] - problem.c[b]) / problem.f[b]).numpy(), 1.0)
            ray = ray - float(y[b, k]) * np.cross(at.shutter_rate[b], ray)
            wanted = ray[:2] / ray[2] * problem.f[b].numpy() + problem.c[b].numpy()
            np.testing.assert_allclose(found[b, :, k], wanted, rtol=1e-12)
    f = torch.ones(1, 2, dtype=D)
    wild = [[0.0, 0.8], [0.0, 1.0], [0.0, 1.2], [0.0, 0.95]]  # z = 1 - 0.8, 0, -0.2 and 0.05
    edge = reprojection_problem.undo_rolling_shutter(
        torch.tensor([[[1.0] * 4, [0.0] * 4]], dtype=D),
        f,
        0 * f,
        torch.tensor([[-w[1] for w in wild]], dtype=D),
        torch.tensor([[0.0, 1.0, 0.0]], dtype=D),
    )
    assert edge.isfinite().all()
    torch.testing.assert_close(edge[0, 0], torch.tensor([1.8 / 0.2, 2 / 0.1, 2.2 / -0.2, 1.95 / 0.1], dtype=D))


def test_tracks_are_linearised_at_their_inverse_depths():
    problem, at = pose_depth_problem()
    linear = reprojection_problem.linearise_tracks(problem, at)
    for b, tracks in enumerate(every(problem, at)):
        f = problem.f[b].numpy()
        assert linear.front[b].tolist() == [x.front for x in tracks]
        assert [k for k in range(UNUSED) if not tracks[k].front] == [EPIPOLE, BEHIND]
        assert [k for k in range(UNUSED) if tracks[k].v == 0] == [3, BEYOND]
        for k, x in enumerate(tracks):
            if x.front:
                np.testing.assert_allclose(linear.u[b, :6, k], x.J[0, :6] / f[0], rtol=1e-9, atol=1e-12)
                np.testing.assert_allclose(linear.v[b, :6, k], x.J[1, :6] / f[1], rtol=1e-9, atol=1e-12)
                np.testing.assert_allclose([linear.u[b, 6, k], linear.v[b, 6, k]], x.r / f, rtol=1e-7, atol=1e-12)
                np.testing.assert_allclose(linear.slope[b, :, k], x.s / f, rtol=1e-9)
                assert (np.inf if linear.free[b, k] else float(linear.fixed.variance[b, k])) == x.v
    assert all(x.isfinite().all() for x in (linear.u, linear.v, linear.slope))


def test_far_tracks_are_not_believed_without_a_near_one_to_bound_them():
    problem, at = pose_depth_problem()
    alone = problem.replace(near=problem.near & False)
    assert not reprojection_problem.linearise_tracks(alone, at).front[:, list(FAR)].any()


def test_without_baseline_a_pixel_tells_nothing_of_depth_and_counts_in_full():
    problem, at = pose_depth_problem()
    at = at._replace(T=se3.Pose(at.T.R, 0 * at.T.t))
    linear = reprojection_problem.linearise_tracks(problem, at)
    squares = reprojection_problem.squared_residuals(problem, linear, NOISE)
    for b in range(2):
        for k in (*range(8), *FAR):
            r = np.array([linear.u[b, 6, k], linear.v[b, 6, k]]) * problem.f[b].numpy()
            xx, xy, yy = problem.shape[b, :, k].tolist()
            S = float(NOISE[b, k]) * np.array([[xx, xy], [xy, yy]])
            np.testing.assert_allclose(float(squares[b, k]), r @ np.linalg.inv(S) @ r, rtol=1e-9)
    assert reprojection_problem.whitened_residuals(problem, linear, NOISE).isfinite().all()


# ------------------------------------------------------------------------------------------------ all tracks


def test_without_a_turn_the_equations_are_those_of_the_pose_at_a_turn_of_zero():
    problem, at = pose_depth_problem(turn=0.0)
    weight, precision = torch.tensor([0.3, 0.7], dtype=D), torch.tensor([2e3, 5e4], dtype=D)
    normal, cost = reprojection_problem.pose_normal_equations_at(
        problem, NOISE, weight, precision, kernel="cauchy", bend=1.5
    )
    still = at._replace(shutter_rate=torch.zeros_like(at.shutter_rate))
    whole, pose = normal(still), normal(at._replace(shutter_rate=None))
    torch.testing.assert_close(pose.H, whole.H[:, :6, :6], rtol=1e-12, atol=1e-9)
    torch.testing.assert_close(pose.g, whole.g[:, :6], rtol=1e-12, atol=1e-9)
    assert torch.equal(pose.cost, whole.cost)
    for x in (at, still, at._replace(shutter_rate=None)):
        assert torch.equal(cost(x), normal(x).cost)
    moved, ok = reprojection_problem.unknowns_step(at._replace(shutter_rate=None), pose.H, pose.g)
    assert moved.shutter_rate is None and ok.all() and not torch.equal(moved.T.R, at.T.R)


@pytest.mark.parametrize("kernel", [None, "huber", "cauchy", "geman_mcclure"])
def test_normal_equations_are_the_schur_complement_of_one_with_all_inverse_depths(kernel):
    problem, at = pose_depth_problem()
    weight, precision = torch.tensor([0.3, 0.7], dtype=D), torch.tensor([2e3, 5e4], dtype=D)
    cost, H, g = reprojection_problem.pose_normal_equations(
        problem, at, NOISE, weight, precision, kernel=kernel, bend=1.5
    )
    for b, tracks in enumerate(every(problem, at)):
        share = [(x.near + float(weight[b]) * x.far) * dense.weight(x.square, kernel, 1.5)[1] for x in tracks]
        wanted_H, wanted_g = dense.reduced(tracks, share)
        known = np.diag([0.0] * 6 + [float(precision[b])] * 3)
        turn = np.append(np.zeros(6), at.shutter_rate[b].numpy())
        np.testing.assert_allclose(H[b], wanted_H + known, rtol=1e-6, atol=1e-7 * np.abs(wanted_H).max())
        np.testing.assert_allclose(g[b], wanted_g + known @ turn, rtol=1e-6, atol=1e-7 * np.abs(wanted_g).max())
        wanted = dense.cost(tracks, float(weight[b]), kernel, 1.5) + turn @ known @ turn
        np.testing.assert_allclose(float(cost[b]), wanted, rtol=1e-7)


# ------------------------------------------------------------------------------------------------ steps


@pytest.mark.parametrize("step", [reprojection_problem.unknowns_step, reprojection_problem.trial_unknowns_step])
def test_a_step_solves_for_the_pose_and_the_turn(step):
    g = torch.Generator().manual_seed(0)
    A, v = torch.randn(3, 9, 12, generator=g, dtype=D), torch.randn(3, 9, generator=g, dtype=D) * 0.1
    at = Unknowns(se3.exp(torch.randn(3, 6, generator=g, dtype=D)), torch.randn(3, 3, generator=g, dtype=D))
    H = A @ A.mT
    H[1] = 0
    moved, ok = step(at, H, v)
    assert ok.tolist() == [True, False, True]
    xi = -torch.linalg.solve(H[::2], v[::2])
    want = move_pose(at.T[::2], xi[:, :6])
    for x, y in ((moved.T.R, want.R), (moved.T.t, want.t), (moved.shutter_rate, at.shutter_rate[::2] + xi[:, 6:])):
        torch.testing.assert_close(x[::2], y, rtol=1e-9, atol=1e-12)
    if step is reprojection_problem.unknowns_step:
        assert torch.equal(moved.shutter_rate[1], at.shutter_rate[1]) and torch.equal(moved.T.R[1], at.T.R[1])


@pytest.mark.parametrize("turn", [False, True])
def test_a_minimum_without_translation_has_none_and_a_free_one_has_a_lower_cost(turn):
    problem, at = pose_depth_problem()
    at = Unknowns(at.T.replace(t=torch.zeros_like(at.T.t)), at.shutter_rate if turn else None)
    weight, precision = torch.tensor([0.3, 0.7], dtype=D), torch.tensor([2e3, 5e4], dtype=D)
    options = {"kernel": "geman_mcclure", "bend": 2.0}
    solve = partial(reprojection_problem.minimise_tracks, problem, at, NOISE, weight, precision, **options)
    (begin, first), (turned, of_rotation), (free, of_pose) = (
        solve(steps=0),
        solve(steps=5, rotation_only=True),
        solve(steps=5),
    )
    assert begin is at and bool((of_rotation < first).all() and (of_pose < of_rotation).all())
    assert not turned.T.t.any() and free.T.t.any(dim=-1).all() and not torch.equal(turned.T.R, at.T.R)
    normal, cost = reprojection_problem.pose_normal_equations_at(problem, NOISE, weight, precision, **options)
    for found, value in ((at, first), (turned, of_rotation), (free, of_pose)):
        assert torch.equal(cost(found), value) and torch.equal(normal(found).cost, value)
