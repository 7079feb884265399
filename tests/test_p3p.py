"""The minimal solver, the sampling and the small least-squares pieces beneath the pose stage."""

import pytest
import torch

from dhtorch.geometry import covariance, ransac, se3
from dhtorch.geometry.least_squares import (
    Normal,
    gauss_newton_step,
    linearise,
    minimise,
    normal_equations,
    robust,
    solve_spd,
)
from dhtorch.geometry.p3p import p3p
from dhtorch.geometry.se3 import Pose


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def triples(n, seed=0, planar=False):
    """Random triples in front of a camera: rays, world points and the true pose."""
    g = torch.Generator().manual_seed(seed)
    Y = torch.rand(n, 3, 3, generator=g, dtype=torch.float64) * torch.tensor([2.0, 2.0, 4.0]) - torch.tensor(
        [1, 1, -0.3]
    )
    depth = Y[..., 2:].clone()
    if planar:
        depth[:] = 2.0
    Y = torch.cat((Y[..., :2], torch.ones_like(depth)), -1) * depth
    T = se3.exp(torch.randn(n, 6, generator=g, dtype=torch.float64))
    return Y / depth, se3.apply(se3.invert(T), Y), T


def miss(found, T):
    """Distance of the nearest valid solution to the truth, and all reprojections of the valid ones."""
    R, t, valid = found
    error = (R.double() - T.R[:, None]).abs().amax((-1, -2)) + (t.double() - T.t[:, None]).abs().amax(-1)
    return torch.where(valid, error, torch.inf).amin(-1)


@pytest.mark.parametrize("planar", [False, True])
def test_the_true_pose_is_among_the_solutions(planar):
    rays, xyz, T = triples(20000, planar=planar)
    side = xyz[:, [1, 2, 2]] - xyz[:, [0, 0, 1]]
    height = torch.linalg.cross(side[:, 0], side[:, 1]).norm(dim=-1) / side.norm(dim=-1).amax(-1) ** 2
    rays, xyz, T = rays[height > 2e-3], xyz[height > 2e-3], T[height > 2e-3]  # flatter ones count as collinear
    error = miss(p3p(rays, xyz), T)
    assert (error > 1e-6).double().mean() < 2e-4
    assert error.median() < 1e-12
    single = miss(p3p(rays.float(), xyz.float()), T)
    assert (single > 1e-3).double().mean() < 2e-3


def test_every_valid_solution_reprojects_and_is_a_rotation():
    rays, xyz, _ = triples(5000)
    R, t, valid = p3p(rays, xyz)
    Y = torch.einsum("nkij,npj->nkpi", R, xyz) + t[:, :, None]
    error = (Y[..., :2] / Y[..., 2:] - rays[:, None, :, :2]).abs().amax((-1, -2))
    assert error[valid].max() < 1e-8 and (Y[valid][..., 2] > 0).all()
    eye = torch.eye(3, dtype=R.dtype)
    assert (R @ R.transpose(-1, -2) - eye).abs().max() < 1e-12
    assert (torch.linalg.det(R) > 0).all()


def test_it_finds_what_poselib_finds():
    poselib = pytest.importorskip("poselib")
    rays, xyz, _ = triples(200, seed=3)
    R, t, valid = p3p(rays, xyz)
    unit = rays / rays.norm(dim=-1, keepdim=True)
    for k in range(len(rays)):
        theirs = poselib.p3p(list(unit[k].numpy()), list(xyz[k].numpy()))
        for pose in theirs:
            error = (R[k] - torch.tensor(pose.R)).abs().amax((-1, -2)) + (t[k] - torch.tensor(pose.t)).abs().amax(-1)
            assert torch.where(valid[k], error, torch.inf).min() < 1e-5


@pytest.mark.parametrize(
    "Y",
    [
        [[0.0, 1.0, 2.0], [0.8660254037844386, -0.5, 2.0], [-0.8660254037844386, -0.5, 2.0]],  # equilateral, on axis
        [[0.0, 0.0, 2.0], [1.0, 0.0, 2.0], [0.0, 1.0, 2.0]],  # isosceles, right angle on the axis
        [[-1.0, -1.0, 2.0], [1.0, -1.0, 2.0], [-1.0, 1.0, 2.0]],  # three corners of a square
        [[-1.0, 0.0, 2.0], [1.0, 0.0, 2.0], [0.0, 1.0, 3.0]],
    ],
)
def test_symmetric_triangles(Y):
    Y = torch.tensor([Y], dtype=torch.float64)
    eye = se3.identity(1, Y)
    assert miss(p3p(Y / Y[..., 2:], Y), eye).item() < 1e-6


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_triples_are_masked_and_finite(dtype):
    line = [[0.0, 0.0, 1.0], [0.1, 0.1, 2.0], [0.2, 0.2, 3.0]]
    same = [[0.1, 0.2, 1.0]] * 3
    pair = [[0.1, 0.2, 1.0], [0.1, 0.2, 1.0], [0.5, 0.0, 2.0]]
    one_ray = [[0.1, 0.1, 1.0], [0.2, 0.2, 2.0], [0.5, 0.0, 2.0]]
    xyz = torch.tensor([line, same, pair, one_ray, line], dtype=dtype)
    rays = xyz / xyz[..., 2:]
    rays[4] = torch.nan
    R, t, valid = p3p(rays, xyz)
    assert not valid.any()
    assert R.isfinite().all() and t.isfinite().all() and R.dtype == dtype


@pytest.mark.parametrize("hypotheses", [1, 37, 200])
def test_p3p_does_not_depend_on_company(hypotheses):
    rays, xyz, _ = triples(8 * hypotheses)
    rays, xyz = (x.view(8, hypotheses, 3, 3).float() for x in (rays, xyz))
    together = p3p(rays, xyz)
    for b in range(8):
        for x, y in zip(p3p(rays[b : b + 1].clone(), xyz[b : b + 1].clone()), together, strict=True):
            assert torch.equal(x[0], y[b])


def test_triples_are_distinct_and_uniform():
    g = torch.Generator().manual_seed(0)
    draws = torch.rand(3, 60000, 3, generator=g)
    draws[0, 0] = 1 - 2.0**-24
    found = ransac.distinct_triples(draws, torch.tensor([3, 5, 500]))
    for row, count in zip(found, (3, 5, 500), strict=True):
        assert row.min() >= 0 and row.max() == count - 1
        assert ((row[:, 0] != row[:, 1]) & (row[:, 0] != row[:, 2]) & (row[:, 1] != row[:, 2])).all()
    ordered = found[1][:, 0] * 25 + found[1][:, 1] * 5 + found[1][:, 2]
    shares = torch.bincount(ordered, minlength=125).double()
    assert (shares > 0).sum() == 60  # 5 · 4 · 3 ordered triples
    assert ((shares[shares > 0] / 60000 * 60 - 1).abs() < 0.15).all()
    few = ransac.distinct_triples(draws[:, :10], torch.tensor([0, 1, 2]))
    assert few.min() >= 0 and (few.amax((1, 2)) <= torch.tensor([0, 0, 1])).all()


def test_usable_points_come_first():
    usable = torch.tensor([[0, 1, 0, 1, 1, 0], [0, 0, 0, 0, 0, 0], [1, 1, 1, 1, 1, 1]], dtype=torch.bool)
    index, count = ransac.usable_first(usable, 4)
    assert count.tolist() == [3, 0, 4]
    assert index[0, :3].tolist() == [1, 3, 4]
    assert index[2].tolist() == [0, 1, 3, 4]
    with pytest.raises(ValueError, match="no points"):
        ransac.usable_first(usable[:, :0], 4)


def test_lines_are_told_from_planes():
    g = torch.Generator().manual_seed(0)
    along = torch.rand(40, generator=g)
    line = torch.stack((along, 2 * along, 1 + along))
    plane = torch.stack((along, torch.rand(40, generator=g), torch.ones(40)))
    xyz = torch.stack((line, plane, line, torch.ones(3, 40)))
    xyz[2, :, 7] += torch.tensor([0.3, 0.0, 0.0])
    used = torch.ones(4, 40, dtype=torch.bool)
    assert ransac.collinear(xyz, used).tolist() == [True, False, False, True]
    used[2, 7] = False
    assert ransac.collinear(xyz, used).tolist() == [True, False, True, True]


def problem(batch=3, n=32, dtype=torch.float64, noise=0.0):
    g = torch.Generator().manual_seed(1)
    xyz = torch.rand(batch, 3, n, generator=g, dtype=dtype) * 2 - 1
    xyz[:, 2] += 3
    f = 300 + 50 * torch.rand(batch, 2, generator=g, dtype=dtype)
    c = 100 + 50 * torch.rand(batch, 2, generator=g, dtype=dtype)
    T = se3.exp(0.1 * torch.randn(batch, 6, generator=g, dtype=dtype))
    rows, _ = linearise(T, f, c, xyz, torch.zeros(batch, 2, n, dtype=dtype))
    uv = rows[:, 6] + noise * torch.randn(batch, 2, n, generator=g, dtype=dtype)
    return T, f, c, xyz, uv


def test_jacobian_against_autograd():
    T, f, c, xyz, uv = problem(batch=1, n=5)
    rows, depth = linearise(T, f, c, xyz, uv + 3)

    def residual(xi):
        return linearise(se3.retract(T, xi), f, c, xyz, uv + 3)[0][:, 6]

    J = torch.autograd.functional.jacobian(residual, torch.zeros(1, 6, dtype=torch.float64))
    torch.testing.assert_close(rows[0, :6], J[0, :, :, 0].movedim(-1, 0))
    torch.testing.assert_close(rows[0, 6], torch.full((2, 5), -3.0, dtype=torch.float64))
    torch.testing.assert_close(depth, se3.apply(T, xyz.transpose(1, 2))[..., 2])


def test_one_step_passes_gradcheck_through_the_normal_equations():
    T, f, c, xyz, uv = problem(batch=2, n=6, noise=0.5)
    weight = torch.rand(2, 6, dtype=torch.float64)

    def step(f, c, xyz, uv, weight):
        rows, _ = linearise(T, f, c, xyz, uv)
        moved, _ = gauss_newton_step(T, *normal_equations(rows, weight))
        return moved.R, moved.t

    inputs = tuple(x.clone().requires_grad_() for x in (f, c, xyz, uv, weight))
    assert torch.autograd.gradcheck(step, inputs)


def test_solve_flags_singular_matrices_and_keeps_gradients_finite():
    g = torch.Generator().manual_seed(0)
    A = torch.randn(4, 6, 8, generator=g, dtype=torch.float64)
    H = A @ A.transpose(1, 2)
    H[1] = H[1, :, :1] * H[1, :1]  # rank one
    H[2] = 0
    H[3, 0, 0] = torch.nan
    H.requires_grad_()
    b = torch.randn(4, 6, 1, generator=g, dtype=torch.float64, requires_grad=True)
    x, ok = solve_spd(H, b)
    assert ok.tolist() == [True, False, False, False]
    torch.testing.assert_close(x[0], torch.linalg.solve(H[0], b[0]))
    assert (x[1:] == 0).all()
    x.sum().backward()
    assert H.grad.isfinite().all() and b.grad.isfinite().all()
    good = H.detach()[:1].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda M, v: solve_spd(M + M.transpose(1, 2), v)[0], (good, b[:1]))


@pytest.mark.parametrize("kernel", [None, "huber", "cauchy", "geman_mcclure"])
def test_kernels_are_squares_at_zero_and_their_weight_is_the_slope(kernel):
    square = torch.tensor([0.0, 1e-8, 0.5, 3.9, 4.1, 100.0], dtype=torch.float64, requires_grad=True)
    rho, weight = robust(square, kernel, 2.0)
    (slope,) = torch.autograd.grad(rho.sum(), square)
    torch.testing.assert_close(slope, weight)
    assert weight[0] == 1 and rho[0] == 0 and abs(rho[1].item() / 1e-8 - 1) < 1e-6
    assert kernel is None or weight[-1] < 0.3
    with pytest.raises(ValueError, match="kernel"):
        robust(square, "tukey", 1.0)


def test_minimise_descends_and_returns_to_the_optimum():
    T, f, c, xyz, uv = problem(noise=0.0)

    def evaluate(T):
        rows, _ = linearise(T, f, c, xyz, uv)
        one = torch.ones_like(rows[:, 0, 0])
        return Normal((rows[:, 6] ** 2).sum((1, 2)), *normal_equations(rows, one))

    start = se3.retract(T, torch.full((3, 6), 0.1, dtype=torch.float64))
    best, cost = minimise(evaluate, start, 8)
    assert (cost < 1e-12).all()
    torch.testing.assert_close(best.R, T.R)
    unchanged, cost = minimise(evaluate, Pose(T.R * torch.nan, T.t), 3)
    assert unchanged.R.isnan().all() and cost.isnan().all()


def test_covariance_of_the_normal_equations():
    T, f, c, xyz, uv = problem(batch=2, n=48, noise=0.0)
    rows, _ = linearise(T, f, c, xyz, uv)
    H, _ = normal_equations(rows, torch.ones_like(rows[:, 0, 0]))
    H[1, 0], H[1, :, 0] = 0, 0
    sigma = torch.tensor([0.5, 0.5], dtype=torch.float64)
    cov, ok = covariance.from_normal(H, sigma)
    assert ok.tolist() == [True, False] and (cov[1] == 0).all()
    torch.testing.assert_close(cov[0], 0.25 * torch.linalg.inv(H[0]))
    x = torch.randn(2, 6, dtype=torch.float64)
    torch.testing.assert_close(covariance.mahalanobis(x, cov)[0], (x[0] @ torch.linalg.inv(cov[0]) @ x[0]).sqrt())
    assert covariance.mahalanobis(x, cov)[1] == 0
