"""The minimal solver, against truth, the roots of Grunert's quartic and PoseLib."""

import numpy as np
import pytest
import torch
from numpy.polynomial import Polynomial

from dhtorch.geometry import se3
from dhtorch.geometry.p3p import p3p


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
    """Distance of the nearest valid solution to the truth."""
    R, t, valid = found
    error = (R.double() - T.R[:, None]).abs().amax((-1, -2)) + (t.double() - T.t[:, None]).abs().amax(-1)
    return torch.where(valid, error, torch.inf).amin(-1)


@pytest.mark.parametrize("planar", [False, True])
def test_the_true_pose_is_among_the_solutions(planar):
    rays, xyz, T = triples(10000, planar=planar)
    side = xyz[:, [1, 2, 2]] - xyz[:, [0, 0, 1]]
    height = torch.linalg.cross(side[:, 0], side[:, 1]).norm(dim=-1) / side.norm(dim=-1).amax(-1) ** 2
    rays, xyz, T = rays[height > 2e-3], xyz[height > 2e-3], T[height > 2e-3]  # flatter ones count as collinear
    error = miss(p3p(rays, xyz), T)
    assert (error > 1e-6).double().mean() < 2e-4
    assert error.median() < 1e-12
    single = miss(p3p(rays.float(), xyz.float()), T)
    assert (single > 1e-3).double().mean() < 2e-3


def all_ranges(rays, xyz):
    """Every set of positive ranges, by brute force: y = d_2 / d_0 is a quotient of polynomials of x = d_1 / d_0."""
    j = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    m01, m12, m20 = j[0] @ j[1], j[1] @ j[2], j[2] @ j[0]
    a01, a12, a20 = ((xyz[0] - xyz[1]) ** 2).sum(), ((xyz[1] - xyz[2]) ** 2).sum(), ((xyz[2] - xyz[0]) ** 2).sum()
    q = Polynomial([1, -2 * m01, 1])  # a01 = d_0² q(x), and likewise for the other two sides
    N, Q = Polynomial([1, 0, -1]) + q * ((a12 - a20) / a01), Polynomial([2 * m20, -2 * m12])  # y = N / Q
    found = []
    for x in (N * N - 2 * m20 * N * Q + (1 - q * (a20 / a01)) * Q * Q).roots():
        y = N(x) / Q(x)
        if abs(x.imag) < 1e-9 and x.real > 0 and y.real > 0:
            found.append(np.sqrt(a01 / q(x.real)) * np.array([1, x.real, y.real]))
    return sorted(found, key=lambda d: d[0])


def test_all_roots_are_found_and_none_is_made_up():
    """Ranges from the origin of every valid pose, against the quartic's: up to four per triple."""
    rays, xyz, _ = triples(300, seed=5)
    R, t, valid = p3p(rays, xyz)
    ranges = (torch.einsum("nkij,npj->nkpi", R, xyz) + t[:, :, None]).norm(dim=-1).numpy()
    numbers, agree = [], 0
    for k in range(len(rays)):
        wanted = np.array(all_ranges(rays[k].numpy(), xyz[k].numpy())).reshape(-1, 3)
        found = np.array(sorted(ranges[k][valid[k].numpy()], key=lambda d: d[0])).reshape(-1, 3)
        numbers.append(len(wanted))
        agree += len(found) == len(wanted) and np.allclose(found, wanted, rtol=1e-5)
    assert agree >= 299  # two roots that nearly coincide may be told apart by one and not by the other
    assert numbers.count(4) > 10 and numbers.count(2) > 50


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


def test_triangles_flatter_than_a_thousandth_and_rays_closer_than_a_microradian_have_no_solution():
    shape = torch.tensor([[[-0.5, 0.1, 2.0], [0.5, 0.1, 2.5], [0.1, 0.0, 2.2]]], dtype=torch.float64)
    along = shape[:, 1] - shape[:, 0]
    up = torch.linalg.cross(along, torch.tensor([[0.0, 0.3, 1.0]], dtype=torch.float64))
    foot = shape[:, 0] + 0.4 * along
    answers = []
    for height in (0.9e-3, 1.1e-3, -0.9e-3, -1.1e-3):
        shape[:, 2] = foot + height * along.norm() * up / up.norm()
        R, t, valid = p3p(shape / shape[..., 2:], shape)
        answers.append(bool(valid.any()))
        assert valid.any() or (torch.equal(R, torch.eye(3, dtype=R.dtype).expand_as(R)) and not t.any())
    assert answers == [False, True, False, True]
    answers = []
    for angle in (1.3e-6, 1.6e-6):  # the cosine of a small angle is 1 - angle² / 2
        Y = torch.tensor([[[0.0, 0.0, 2.0], [3 * angle, 0.0, 3.0], [0.3, 0.7, 2.0]]], dtype=torch.float64)
        answers.append(bool(p3p(Y / Y[..., 2:], Y)[2].any()))
    assert answers == [False, True]


def test_shapes_must_be_equal():
    with pytest.raises(ValueError, match="equal shapes"):
        p3p(torch.ones(2, 3, 3), torch.ones(1, 3, 3))
    with pytest.raises(ValueError, match="rays"):
        p3p(torch.ones(2, 3), torch.ones(2, 3))
