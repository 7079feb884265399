"""ICP with known motion: dense clouds against a brute-force search, sparse sets, and sets that cannot be registered."""

import math

import pytest
import torch

from dhtorch.experiments.negative.icp import estimate_normals, register_icp
from dhtorch.geometry import se3
from dhtorch.records import Pose

pytestmark = pytest.mark.slow  # long; shorter experiments of the same protocols run by default


def surface(n, seed=0, noise=0.0):
    """Points (1, n, 3) of a bumpy surface in front of a camera, drawn at random."""
    generator = torch.Generator().manual_seed(seed)
    xy = 2 * torch.rand(n, 2, generator=generator, dtype=torch.float64) - 1
    x, y = xy.unbind(-1)
    z = 2.5 + 0.3 * (2.1 * x).sin() * (1.7 * y + 0.4).cos() + 0.25 * (3.1 * y + x).sin() + 0.15 * x
    noise = noise * torch.randn(n, 3, generator=generator, dtype=torch.float64)
    return torch.stack((x, y, z), -1)[None] + noise


def off(found, true):
    """Angle (degrees) and distance (m) between two motions."""
    return math.degrees(float(se3.rotation_angle(found.R @ true.R.mT)[0])), float((found.t - true.t).norm())


def oracle(x, q, T, iterations, reach):
    """The textbook: nearest by brute force, closed-form alignment by SVD of what lies within reach."""
    for _ in range(iterations):
        Y = x @ T.R[0].T + T.t[0]
        distance, index = (Y[:, None] - q[None]).norm(dim=-1).min(-1)
        a, b = x[distance < reach], q[index[distance < reach]]
        U, _, Vt = torch.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
        D = torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(Vt.T @ U.T))]).double())
        R = Vt.T @ D @ U.T
        T = Pose(R[None], (b.mean(0) - R @ a.mean(0))[None])
    return T


TRUE = se3.exp(torch.tensor([[0.03, -0.05, 0.02, 0.06, -0.04, 0.05]]).double())
START = se3.identity(1, torch.zeros(1).double())


def test_points_agree_with_the_textbook_on_dense_clouds():
    q, x = surface(1200, 1), se3.apply(se3.invert(TRUE), surface(600, 2))
    found = register_icp(x, q, START, reach_m=0.2, least_reach_m=0.2, keep=1.0, iterations=40)
    expected = oracle(x[0], q[0], START, 40, 0.2)
    angle, distance = off(found.T_1_from_0, expected)
    assert angle < 0.01 and distance < 2e-4, "the same fixed point"
    angle, distance = off(found.T_1_from_0, TRUE)
    assert angle < 1 and distance < 0.02


def test_planes_forgive_other_samples_of_the_same_surface():
    q, x = surface(1200, 1, 0.002), se3.apply(se3.invert(TRUE), surface(700, 2, 0.002))
    point, plane = (register_icp(x, q, START, normals_1=m) for m in (None, estimate_normals(q)))
    worse, better = off(point.T_1_from_0, TRUE), off(plane.T_1_from_0, TRUE)
    assert better[1] < 0.004 and better[0] < 0.2
    assert worse[1] > 2 * better[1] and float(point.rms_m) > 2 * float(plane.rms_m), "nearest is not the same point"


def test_trimming_survives_what_the_other_view_does_not_show():
    q = surface(900)
    x = se3.apply(se3.invert(TRUE), q)
    x[:, :150, 2] += 0.15  # something stands in front
    kept, all_of_them = (register_icp(x, q, START, keep=k, least_reach_m=0.25) for k in (0.8, 1.0))
    assert off(kept.T_1_from_0, TRUE)[1] < 0.005 < off(all_of_them.T_1_from_0, TRUE)[1]


def test_normals_of_a_known_plane_face_the_camera():
    true = torch.tensor([0.3, -0.2, -1.0]).double()
    true = true / true.norm()
    q = surface(500)
    q[..., 2] = 2.5 - (true[0] * q[..., 0] + true[1] * q[..., 1]) / true[2]
    q[:, 7] = torch.nan
    found = estimate_normals(q)
    assert bool(found[:, 7].isnan().all()) and bool((found[:, 8:] @ true > 0.99999).all())
    cloud = torch.rand(1, 500, 3, generator=torch.Generator().manual_seed(0)) + 1
    assert float(estimate_normals(cloud).isnan().any(-1).float().mean()) > 0.5, "no plane in a fog"


def test_what_cannot_be_registered_is_flagged():
    q = surface(50)
    nothing = torch.full((1, 40, 3), torch.nan).double()
    start = se3.exp(torch.tensor([[0.1, 0, 0, 0.2, 0, 0]]).double())
    for x, y, T in ((nothing, q, start), (q, nothing, start), (q, q + 10, start), (q[:, :4], q, START)):
        found = register_icp(x, y, T)
        assert not bool(found.ok) and torch.equal(found.T_1_from_0.t, T.t)
        assert bool(found.inlier_share.isfinite()) and bool(found.condition.isfinite())
    flat = surface(600)
    flat[..., 2] = 2.0
    wall, bumpy = (register_icp(x, x, START, normals_1=estimate_normals(x)) for x in (flat, surface(600)))
    assert not bool(wall.ok) and float(wall.condition) < 1e-9, "a wall leaves three directions open"
    assert float(bumpy.condition) > 1e-4
    lost = Pose(START.R * torch.nan, START.t)
    assert not bool(register_icp(q, q, lost).ok)
