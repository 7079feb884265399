"""Reprojection problem of near and far tracks, against ``support/dense_reprojection.py`` (track by track) and autograd."""

from functools import partial

import numpy as np
import pytest
import torch
from support import dense_reprojection as dense
from support.pose_problems import NOISE, pose_depth_problem

from dhtorch.geometry import reprojection_problem
from dhtorch.geometry.least_squares import move_pose
from dhtorch.geometry.reprojection_problem import Unknowns

D = torch.float64


def every(problem, at):
    return [dense.tracks(problem, at, NOISE, b) for b in range(2)]


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
    moved = reprojection_problem.retract_unknowns(at._replace(shutter_rate=None), pose.g)
    assert moved.shutter_rate is None and not torch.equal(moved.T.R, at.T.R)


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


def test_unknowns_move_by_the_tangent_of_the_pose_and_the_change_of_the_rate():
    _, at = pose_depth_problem()
    xi = torch.linspace(-0.1, 0.2, 18, dtype=D).view(2, 9)
    moved, want = reprojection_problem.retract_unknowns(at, xi), move_pose(at.T, xi[:, :6])
    assert torch.equal(moved.T.R, want.R) and torch.equal(moved.T.t, want.t)
    assert torch.equal(moved.shutter_rate, at.shutter_rate + xi[:, 6:])


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
