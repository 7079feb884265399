"""Residuals, kernels, normal equations, solves and steps, against loops, autograd, scipy and matrices written out."""

import numpy as np
import pytest
import torch
from scipy.special import huber

from dhtorch.geometry import least_squares, se3
from dhtorch.geometry.least_squares import (
    MIN_DEPTH,
    MIN_PIVOT,
    NormalEquations,
    linearise,
    minimise,
    move_pose,
    normal_equations,
    reprojection_residuals,
    robust_loss,
    robust_weight_slope,
    solve_spd,
)
from dhtorch.geometry.se3 import Pose

D = torch.float64
KERNELS = [None, "huber", "cauchy", "geman_mcclure"]


def drawn(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=D)


def scene(batch=2, n=7, off=3.0, seed=1):
    """A pose, two unlike focal lengths, points in front and where they were seen, ``off`` px beside it."""
    T = se3.exp(0.2 * drawn(batch, 6, seed=seed))
    f, c = 300 + 50 * drawn(batch, 2, seed=seed + 1), 100 + 20 * drawn(batch, 2, seed=seed + 2)
    xyz = drawn(batch, 3, n, seed=seed + 3) * 0.5 + torch.tensor([0.0, 0.0, 3.0], dtype=D)[:, None]
    return T, f, c, xyz, seen(T, f, c, xyz) + off * drawn(batch, 2, n, seed=seed + 4)


def seen(T, f, c, xyz):
    Y = T.R @ xyz + T.t[..., None]
    return f[..., None] * Y[:, :2] / Y[:, 2:] + c[..., None]


# ------------------------------------------------------------------------------------------------ linearise


def test_the_residual_is_projected_minus_measured_and_its_jacobian_that_of_a_left_perturbation():
    """The last points lie behind the camera or nearly in its plane: finite rows and their depth."""
    T, f, c, xyz, uv = scene()
    xyz[:, 2, 4:] = torch.tensor([-2.0, 0.0, 0.5 * MIN_DEPTH], dtype=D)
    xyz[:, :, 4:] = T.R.mT @ (xyz[:, :, 4:] - T.t[..., None])  # in the camera's axes
    rows, depth = linearise(T, f, c, xyz, uv)
    residual, z = reprojection_residuals(T, f, c, xyz, uv)
    assert torch.equal(residual, rows[:, 6]) and torch.equal(z, depth) and rows.isfinite().all()
    torch.testing.assert_close(depth, (T.R @ xyz + T.t[..., None])[:, 2])
    J = torch.func.jacrev(lambda xi: seen(se3.retract(T, xi), f, c, xyz))(torch.zeros(2, 6, dtype=D))
    for b in range(2):
        torch.testing.assert_close(rows[b, :6, :, :4], J[b, :, :4, b].movedim(-1, 0))
    torch.testing.assert_close(residual[..., :4], (seen(T, f, c, xyz) - uv)[..., :4])
    Y = (T.R @ xyz + T.t[..., None])[:, :2, 4:]
    torch.testing.assert_close(residual[..., 4:], f[..., None] * Y / MIN_DEPTH + c[..., None] - uv[..., 4:])


# ------------------------------------------------------------------------------------------------ kernels


def plain_rho(square, kernel, k):
    r = np.sqrt(square)
    return {
        None: square,
        "huber": 2 * huber(k, r),
        "cauchy": k * k * np.log1p(square / (k * k)),
        "geman_mcclure": k * k * square / (k * k + square),
    }[kernel]


@pytest.mark.parametrize("scale", [0.5, 2.0])
@pytest.mark.parametrize("kernel", KERNELS)
def test_cost_weight_and_slope_are_a_formula_its_derivative_and_its_second(kernel, scale):
    r = torch.tensor([0.0, 1e-4, 0.3, 0.499, 0.501, 1.9, 1.999, 2.001, 3.0, 20.0], dtype=D)
    square = (r * r).requires_grad_()
    rho, weight = robust_loss(square, kernel, scale)
    np.testing.assert_allclose(rho.detach(), plain_rho(square.detach().numpy(), kernel, scale), rtol=1e-12, atol=1e-15)
    torch.testing.assert_close(torch.autograd.grad(rho.sum(), square, retain_graph=True)[0], weight)
    assert weight[0] == 1
    slope = torch.autograd.grad(weight.sum(), square)[0] if weight.requires_grad else torch.zeros_like(square)
    assert slope.isfinite().all()
    torch.testing.assert_close(robust_weight_slope(square, kernel, scale), slope, rtol=1e-12, atol=1e-15)
    for function in (robust_loss, robust_weight_slope):
        with pytest.raises(ValueError, match="kernel is 'tukey'"):
            function(square, "tukey", scale)


# ------------------------------------------------------------------------------------------------ normal equations


@pytest.mark.parametrize("block", [None, 1, 4, 9, 16])
def test_normal_equations_are_weighted_sums_over_points(block):
    rows, weight = drawn(2, 4, 2, 9), drawn(2, 9, seed=1).abs()
    H, g = normal_equations(rows, weight, block=block)
    for b in range(2):
        wanted_H, wanted_g = np.zeros((3, 3)), np.zeros(3)
        for n in range(9):
            for k in range(2):
                J, r, w = rows[b, :3, k, n].numpy(), float(rows[b, 3, k, n]), float(weight[b, n])
                wanted_H, wanted_g = wanted_H + w * np.outer(J, J), wanted_g + w * J * r
        np.testing.assert_allclose(H[b], wanted_H, rtol=1e-12)
        np.testing.assert_allclose(g[b], wanted_g, rtol=1e-12)


def test_empty_points_behind_the_last_block_change_no_bit():
    rows, weight = drawn(3, 7, 2, 64).float(), drawn(3, 64, seed=1).float().abs()
    more = (torch.nn.functional.pad(rows, (0, 192), value=1.0), torch.nn.functional.pad(weight, (0, 192)))
    for x, y in zip(normal_equations(rows, weight, block=64), normal_equations(*more, block=64), strict=True):
        assert torch.equal(x, y)


# ------------------------------------------------------------------------------------------------ solving


def positive(n, batch=2, seed=0):
    A = drawn(batch, n, n + 3, seed=seed)
    return A @ A.mT


@pytest.mark.parametrize("n", [1, 2, 3, 5, 6, 9])
@pytest.mark.parametrize("columns", [1, 4])
@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_systems_of_any_size_and_any_units_are_solved_in_double(n, columns, dtype):
    """Metres beside nanoradians: in double precision a diagonal over 32 orders of magnitude."""
    unit = torch.logspace(-8, 8, n, dtype=D) if dtype == D else torch.ones(n, dtype=D)
    H, b = (unit[:, None] * positive(n) * unit).to(dtype), (unit[:, None] * drawn(2, n, columns, seed=1)).to(dtype)
    x, ok = solve_spd(H, b)
    assert ok.all() and x.dtype == dtype
    want = torch.linalg.solve(H.double() / unit / unit[:, None], b.double() / unit[:, None]) / unit[:, None]
    torch.testing.assert_close(x, want.to(dtype), rtol=1e-9 if dtype == D else 1e-6, atol=0)


def test_only_a_positive_definite_matrix_of_numbers_is_solved():
    """The pivot of [[1, r], [r, 1]] is sqrt(1 - r²)."""

    def pair(r):
        return [[1.0, r], [r, 1.0]]

    good, bad = (float(np.sqrt(1 - (x * MIN_PIVOT) ** 2)) for x in (1.5, 0.7))
    rows = [pair(good), pair(bad), pair(1.0), pair(2.0), pair(torch.nan), [[0.0] * 2] * 2, [[-1.0, 0], [0, 1.0]]]
    H = torch.tensor(rows, dtype=D)
    x, ok = solve_spd(H, torch.ones(7, 2, 1, dtype=D))
    assert ok.tolist() == [True] + [False] * 6 and (x[1:] == 0).all()
    b = torch.tensor([[1.0, 2.0], [torch.inf, 0.0], [0.0, torch.nan]], dtype=D)[..., None]
    x, ok = solve_spd(torch.eye(2, dtype=D).expand(3, 2, 2), b)
    assert ok.tolist() == [True, False, False] and x[..., 0].tolist() == [[1.0, 2.0], [0.0, 0.0], [0.0, 0.0]]


@pytest.mark.parametrize("n", [3, 6])
def test_a_solution_is_differentiated_without_its_factorisation_and_silent_where_there_is_none(n):
    H, b = positive(n), drawn(2, n, 2, seed=1)
    symmetric = lambda M, v: solve_spd(M + M.mT, v)[0]  # noqa: E731
    assert torch.autograd.gradcheck(symmetric, (H.requires_grad_(), b.requires_grad_()))
    spoilt = torch.cat((H.detach(), H.detach()))
    spoilt[0, 0, 0], spoilt[1], spoilt[2] = torch.nan, 0, torch.outer(spoilt[2, 0], spoilt[2, 0])
    spoilt.requires_grad_()
    x, ok = solve_spd(spoilt, b.detach().repeat(2, 1, 1))
    assert ok.tolist() == [False, False, False, True]
    x.sum().backward()
    assert (spoilt.grad[:3] == 0).all() and spoilt.grad[3].isfinite().all() and spoilt.grad[3].any()


# ------------------------------------------------------------------------------------------------ steps


def cayley(T, xi):
    """(1 − ½ W)⁻¹ (1 + ½ W) applied to a pose, then the translation."""
    W, eye = 0.5 * se3.hat(xi[:, :3]), torch.eye(3, dtype=D)
    turn = torch.linalg.inv(eye - W) @ (eye + W)
    return turn @ T.R, (turn @ T.t[..., None])[..., 0] + xi[:, 3:]


def test_a_pose_moves_by_cayleys_map():
    T, xi = se3.exp(drawn(5, 6)), drawn(5, 6, seed=1)
    moved = move_pose(T, xi)
    for x, y in zip((moved.R, moved.t), cayley(T, xi), strict=True):
        torch.testing.assert_close(x, y)
    small = 1e-3 * xi
    exact, near = se3.retract(T, small), move_pose(T, small)
    assert (exact.R - near.R).abs().max() < 3e-9 and (exact.t - near.t).abs().max() < 3e-6


# ------------------------------------------------------------------------------------------------ minimise


def test_damping_follows_success_and_each_element_goes_its_own_way():
    """Costs are read from a script; the unknown is the number of the evaluation that it was proposed for."""
    costs = torch.tensor([[9.0, 8, 7, 6, 5, 4], [9.0, 9, 10, 8, 8.5, 7], [9.0, 1, 2, 3, 4, 5], [9.0, 5, 6, 3, 2, 1]])
    accepted = [[1, 1, 1, 1, 1], [0, 0, 1, 0, 1], [1, 0, 0, 0, 0], [1, 0, 1, 1, 1]]  # equal costs are not better ones
    factors, places = [], []

    def evaluate(x):
        places.append(x)
        equations = 2 * torch.eye(2).expand(4, 2, 2), torch.tensor([1.0, 0.0]).expand(4, 2)
        return NormalEquations(costs[:, len(places) - 1], *equations)

    def move(x, xi):
        assert (xi[:, 1] == 0).all()
        factors.append(-0.5 / xi[:, 0] - 1)
        return torch.full_like(x, len(places))

    x, cost = minimise(evaluate, torch.zeros(4, 1), 5, damping=0.1, move=move)
    assert least_squares.INITIAL_DAMPING == minimise.__kwdefaults__["damping"] == 1e-4
    assert x[:, 0].tolist() == [5, 5, 1, 5] and cost.tolist() == [4, 7, 1, 1]
    wanted = 0.1 * np.cumprod(np.where(np.insert(accepted, 0, 2, axis=1) == 1, 0.1, 10), 1)[:, :-1] / 10
    np.testing.assert_allclose(torch.stack(factors, 1), wanted, rtol=1e-2, atol=1e-6)


def test_minimise_descends_to_the_optimum_and_leaves_what_is_no_number():
    T, f, c, xyz, uv = scene(3, 20, off=0.0)

    def evaluate(T):
        rows, _ = linearise(T, f, c, xyz, uv)
        one = torch.ones_like(rows[:, 0, 0])
        return NormalEquations((rows[:, 6] ** 2).sum((1, 2)), *normal_equations(rows, one))

    start = se3.retract(T, torch.full((3, 6), 0.1, dtype=D))
    best, cost = minimise(evaluate, start, 8, move=move_pose)
    assert (cost < 1e-12).all()
    torch.testing.assert_close(best.R, T.R)
    short = minimise(evaluate, start, 8, move=move_pose, cost=lambda T: evaluate(T).cost)
    assert torch.equal(short[0].t, best.t) and torch.equal(short[1], cost)
    unchanged, cost = minimise(evaluate, Pose(T.R * torch.nan, T.t), 3, move=move_pose)
    assert unchanged.R.isnan().all() and cost.isnan().all()


def test_implicit_is_the_derivative_of_where_equations_end():
    """x with x + x³ = a, both numbers of one element for themselves; singular ones stay where they are."""
    a = torch.tensor([[0.5, 2.0], [1.0, -1.0]], dtype=torch.float64, requires_grad=True)
    root = a.detach().clone()
    for _ in range(50):
        root = root - (root + root**3 - a.detach()) / (1 + 3 * root**2)
    found = root + least_squares.implicit_step(
        lambda xi: (root + xi) + (root + xi) ** 3 - a.detach(), root + root**3 - a
    )
    assert torch.equal(found, root)
    slope = torch.autograd.grad(found.sum(), a)[0]
    torch.testing.assert_close(slope, 1 / (1 + 3 * root**2), rtol=1e-5, atol=0)
    flat = least_squares.implicit_step(lambda xi: 0 * xi, 2 * a)
    assert not flat.any() and not torch.autograd.grad(flat.sum(), a)[0].any()
    assert not least_squares.implicit_step(lambda xi: xi, a.detach()).requires_grad
