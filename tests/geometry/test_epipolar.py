"""Two-view geometry against OpenCV, kornia, autograd, plain vector formulas and random draws."""

import cv2
import pytest
import torch
from kornia.geometry.epipolar import triangulate_points

from dhtorch.geometry import camera as cam
from dhtorch.geometry import epipolar, se3
from dhtorch.geometry.camera import Camera
from dhtorch.geometry.se3 import Pose


def double(*values):
    return torch.tensor(values, dtype=torch.float64)


CAMERA_0 = Camera(double([500.0, 620.0], [480.0, 450.0]), double([320.0, 240.0], [300.0, 250.0]))
CAMERA_1 = Camera(double([300.0, 420.0], [510.0, 400.0]), double([250.0, 260.0], [330.0, 210.0]))
MOTIONS = se3.exp(double([0.05, -0.12, 0.03, 0.3, -0.15, 0.1], [-0.02, 0.08, 0.1, -0.25, 0.1, 0.2]))


def scene(n=12, noise_px=0.0, seed=0, T=MOTIONS):
    """Points (2, n, 3) in camera 0 and their pixels in two different cameras with oblong pixels, noise in view 1."""
    g = torch.Generator().manual_seed(seed)
    uniform = torch.rand(2, n, 3, generator=g, dtype=torch.float64)
    depth = 2 + 4 * uniform[..., 2]
    uv_0 = uniform[..., :2] * double(560.0, 400.0) + 40
    x = torch.cat(((uv_0 - CAMERA_0.c[:, None]) / CAMERA_0.f[:, None], torch.ones(2, n, 1, dtype=torch.float64)), -1)
    xyz = x * depth[..., None]
    uv_1 = pixels(xyz, T)
    return uv_0, uv_1 + noise_px * torch.randn(2, n, 2, generator=g, dtype=torch.float64), xyz


def pixels(xyz, T=MOTIONS, camera=CAMERA_1):
    """Where points of camera 0 are seen in the other view."""
    Y = torch.einsum("bij,bnj->bni", T.R, xyz) + T.t[:, None]
    return Y[..., :2] / Y[..., 2:] * camera.f[:, None] + camera.c[:, None]


def points(uv_0, depth):
    x = torch.cat(((uv_0 - CAMERA_0.c[:, None]) / CAMERA_0.f[:, None], torch.ones_like(depth)[..., None]), -1)
    return x * depth[..., None]


def triangulated(uv_0, uv_1, T=MOTIONS):
    return epipolar.triangulate(uv_0, uv_1, CAMERA_0, CAMERA_1, T)


def described(xyz, uv_0, uv_1, T=MOTIONS):
    return epipolar.describe_triangulation(xyz, uv_0, uv_1, CAMERA_0, CAMERA_1, T)


def close(a, b, rtol=1e-9, atol=1e-9):
    torch.testing.assert_close(a, b, rtol=rtol, atol=atol)


# ------------------------------------------------------------------------------------------------ depth


@pytest.mark.parametrize(("sign", "baseline"), [(1, 1.0), (-1, 1.0), (1, 1e-3)])
def test_exact_points_are_those_of_opencv_and_kornia(sign, baseline):
    """In front, behind, and of a tiny baseline; lenses left in the cameras play no part, for pixels are ideal."""
    T = Pose(MOTIONS.R, MOTIONS.t * baseline)
    uv_0, _, xyz = scene(T=T)
    uv_1 = pixels(sign * xyz, T)
    bent = [c.replace(distortion=double([0.2, 0, 0.01, 0]).expand(2, 4)) for c in (CAMERA_0, CAMERA_1)]
    found = epipolar.triangulate(uv_0, uv_1, *bent, T)
    close(found.depth, sign * xyz[..., 2], rtol=1e-7)
    close(found.depth_1, se3.apply(T, sign * xyz)[..., 2], rtol=1e-7)
    assert found.residual_px.max() < 1e-9
    P_0 = cam.to_matrix(CAMERA_0) @ torch.eye(3, 4, dtype=torch.float64)
    P_1 = cam.to_matrix(CAMERA_1) @ se3.to_matrix(T)[:, :3]
    close(found.depth, triangulate_points(P_0, P_1, uv_0, uv_1)[..., 2], rtol=1e-6)
    for b in range(2):
        X = cv2.triangulatePoints(*(m[b].numpy() for m in (P_0, P_1, uv_0.mT, uv_1.mT)))
        close(found.depth[b], torch.from_numpy(X[2] / X[3]), rtol=1e-6)


def test_the_depth_brings_the_point_nearest_to_its_measured_pixel():
    """Least squares along the reference view's ray by Newton's method from the truth, in pixels that are not square."""
    uv_0, uv_1, xyz = scene(noise_px=3.0)
    found = triangulated(uv_0, uv_1)

    def cost(depth):
        return (pixels(points(uv_0, depth)) - uv_1).square().sum()

    depth = xyz[..., 2]
    for _ in range(30):
        slope = torch.func.grad(cost)(depth)
        curve = torch.func.grad(lambda z: torch.func.grad(cost)(z).sum())(depth)  # points do not touch one another
        depth = depth - slope / curve
    close(found.depth, depth)
    close(found.residual_px, (pixels(points(uv_0, depth)) - uv_1).norm(dim=-1))
    assert found.residual_px.median() > 1


def test_without_a_baseline_or_an_angle_depth_is_zero_and_gradients_are_finite():
    T = Pose(MOTIONS.R, torch.zeros_like(MOTIONS.t))
    uv_0, uv_1, _ = scene(T=T)
    uv_1.requires_grad_()
    found = triangulated(uv_0, uv_1, T)
    assert not found.depth.any() and not found.depth_1.any() and not found.parallax.any()
    assert all(x.isfinite().all() for x in found)
    sum(x.sum() for x in found[:5]).backward()
    assert uv_1.grad.isfinite().all()
    camera, aside = Camera(double([128.0, 128.0]), double([0.0, 0.0])), double([0.5, 0.25, 0.125])
    uv = double([[16.0, 32.0], [-64.0, 8.0]])
    straight = Pose(torch.eye(3, dtype=torch.float64)[None], aside)
    assert not epipolar.triangulate(uv, uv, camera, camera, straight).depth.any()


# ------------------------------------------------------------------------------------------------ what goes with it


def test_parallax_is_the_angle_at_the_point_between_the_two_centres():
    uv_0, uv_1, _ = scene(noise_px=1.0)
    found = triangulated(uv_0, uv_1)
    X = points(uv_0, found.depth)
    centre_1 = -torch.einsum("bji,bj->bi", MOTIONS.R, MOTIONS.t)  # of camera 1, in camera 0
    a, b = X, X - centre_1[:, None]
    cosine = (a * b).sum(-1) / (a.norm(dim=-1) * b.norm(dim=-1))
    close(found.parallax, cosine.acos())


def test_slopes_and_jacobians_are_those_of_the_pixel():
    uv_0, uv_1, _ = scene(noise_px=1.0)
    found = triangulated(uv_0, uv_1)
    X = points(uv_0, found.depth)
    slope = torch.func.jvp(lambda z: pixels(points(uv_0, z)), (found.depth,), (torch.ones_like(found.depth),))[1]
    close(found.slope, slope)
    J_point, J_pose = epipolar.point_jacobians(CAMERA_1, se3.apply(MOTIONS, X))
    by_pose = torch.func.jacrev(lambda xi: pixels(X, se3.retract(MOTIONS, xi)))(torch.zeros(2, 6, dtype=torch.float64))
    by_point = torch.func.jacrev(pixels)(X)  # (B, N, 2, B, N, 3)
    for b in range(2):
        close(found.J_pose[b], by_pose[b, :, :, b])
        close(J_pose[b], by_pose[b, :, :, b])
        for n in range(12):
            close(J_point[b, n] @ MOTIONS.R[b], by_point[b, n, :, b, n])
    at = lambda z: epipolar.point_jacobians(CAMERA_1[:1], double([[0.3, -0.2, z]]))[0]  # noqa: E731
    assert torch.equal(at(0.0), at(1e-9)) and torch.equal(at(-5e-10), at(1e-9))
    close(at(-2e-9)[..., 0, 0], CAMERA_1.f[:1, :1] / -2e-9, atol=0)


# ------------------------------------------------------------------------------------------------ points of others


@pytest.mark.parametrize(("miss_0", "miss_1"), [(0.0, 0.0), (3.0, 0.0), (0.0, 3.0), (2.0, 3.0), (3.0, 2.0)])
def test_a_described_point_has_the_larger_residual_of_both_views_and_the_angles_at_its_place(miss_0, miss_1):
    uv_0, uv_1, xyz = scene()
    ours, aside = triangulated(uv_0, uv_1), double(0.6, -0.8)
    found = described(xyz, uv_0 + miss_0 * aside, uv_1 - miss_1 * aside)
    close(found.residual_px, torch.full((2, 12), max(miss_0, miss_1), dtype=torch.float64))
    for name in ("depth", "depth_1", "parallax", "slope", "J_pose"):
        close(getattr(found, name), getattr(ours, name), rtol=1e-7)
    xyz[..., :2, 2] = double(0.0, -5e-10)
    near_plane = described(xyz, uv_0, uv_1)
    assert all(x.isfinite().all() for x in near_plane)
    a = (MOTIONS.R @ (xyz[:, 0] / 1e-9)[..., None])[..., 0]
    slope = CAMERA_1.f * (a[:, :2] * MOTIONS.t[:, 2:] - MOTIONS.t[:, :2] * a[:, 2:]) / MOTIONS.t[:, 2:] ** 2
    close(near_plane.slope[:, 0], slope, rtol=1e-6)


# ------------------------------------------------------------------------------------------------ variance


def covariances(*shape, scale, seed):
    """Full ones: no axis is without the others."""
    A = torch.randn(*shape, shape[-1] + 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return scale**2 * A @ A.mT


def test_variance_is_the_first_order_one_of_autograd():
    """Depth as a function of the pixel of view 1 and of the pose, both with correlated errors."""
    uv_0, uv_1, _ = scene()
    cov_uv, cov_pose = covariances(2, 12, 2, scale=0.5, seed=1), covariances(2, 6, scale=1e-3, seed=2)
    geometry = triangulated(uv_0, uv_1)
    own, shared = epipolar.depth_variance(geometry, cov_uv, cov_pose)
    by_pixel = torch.func.grad(lambda uv: triangulated(uv_0, uv).depth.sum())(uv_1)
    by_pose = torch.func.jacrev(lambda xi: triangulated(uv_0, uv_1, se3.retract(MOTIONS, xi)).depth)(
        torch.zeros(2, 6, dtype=torch.float64)
    )
    moved = geometry._replace(J_pose=geometry.J_pose[..., 3:])  # as many columns as the covariance has
    fewer = epipolar.depth_variance(moved, 0 * cov_uv, cov_pose[:, 3:, 3:])[1]
    for b in range(2):
        close(own[b], torch.einsum("ni,nij,nj->n", by_pixel[b], cov_uv[b], by_pixel[b]), rtol=1e-7)
        J = by_pose[b, :, b]
        close(shared[b], torch.einsum("ni,ij,nj->n", J, cov_pose[b], J), rtol=1e-7)
        close(fewer[b], torch.einsum("ni,ij,nj->n", J[:, 3:], cov_pose[b, 3:, 3:], J[:, 3:]), rtol=1e-7)


def test_variance_is_infinite_only_where_depth_does_not_move_the_pixel():
    uv_0, uv_1, _ = scene(3)
    slope = double([0.0, 0.0], [0.0, 5e-10], [0.0, 2e-9]).expand(2, 3, 2).clone().requires_grad_()
    found = triangulated(uv_0, uv_1)._replace(slope=slope)
    cov = torch.eye(2, dtype=torch.float64).expand(2, 3, 2, 2)
    own, shared = epipolar.depth_variance(found, cov, torch.eye(6, dtype=torch.float64).expand(2, 6, 6))
    for variance in (own, shared):
        assert variance.isinf().tolist() == [[True, True, False]] * 2
    close(own[:, 2], torch.full((2,), 0.25e18, dtype=torch.float64))
    (own[:, 2] + shared[:, 2]).sum().backward()
    assert slope.grad.isfinite().all()
    lost = -1e-12 * torch.eye(6, dtype=torch.float64).expand(2, 6, 6)  # a covariance that rounding made negative
    assert not epipolar.depth_variance(triangulated(uv_0, uv_1), cov, lost)[1].any()
