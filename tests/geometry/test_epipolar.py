"""Two-view geometry against OpenCV, kornia, autograd, plain vector formulas and random draws."""

import cv2
import numpy as np
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


def test_exact_points_are_those_of_opencv_and_kornia():
    uv_0, uv_1, xyz = scene()
    found = triangulated(uv_0, uv_1)
    close(found.depth, xyz[..., 2])
    close(found.depth_1, se3.apply(MOTIONS, xyz)[..., 2])
    assert found.residual_px.max() < 1e-9
    first = torch.eye(3, 4, dtype=torch.float64).expand(2, 3, 4)
    P_0 = cam.to_matrix(CAMERA_0) @ first
    P_1 = cam.to_matrix(CAMERA_1) @ se3.to_matrix(MOTIONS)[:, :3]
    close(found.depth, triangulate_points(P_0, P_1, uv_0, uv_1)[..., 2], rtol=1e-7)
    for b in range(2):
        X = cv2.triangulatePoints(*(m[b].numpy() for m in (P_0, P_1, uv_0.mT, uv_1.mT)))
        close(found.depth[b], torch.from_numpy(X[2] / X[3]), rtol=1e-7)


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


def test_negative_depths_are_found_as_such():
    uv_0, _, xyz = scene()
    found = triangulated(uv_0, pixels(-xyz))
    close(found.depth, -xyz[..., 2])
    close(found.depth_1, se3.apply(MOTIONS, -xyz)[..., 2])


def test_a_tiny_baseline_still_gives_the_depth():
    T = Pose(MOTIONS.R, MOTIONS.t * 1e-3)
    uv_0, uv_1, xyz = scene(T=T)
    close(triangulated(uv_0, uv_1, T).depth, xyz[..., 2], rtol=1e-7)


def test_without_a_baseline_depth_is_zero_and_gradients_are_finite():
    T = Pose(MOTIONS.R, torch.zeros_like(MOTIONS.t))
    uv_0, uv_1, _ = scene(T=T)
    uv_1.requires_grad_()
    found = triangulated(uv_0, uv_1, T)
    assert not found.depth.any() and not found.depth_1.any() and not found.parallax.any()
    assert all(x.isfinite().all() for x in found)
    sum(x.sum() for x in found[:5]).backward()
    assert uv_1.grad.isfinite().all()


def test_parallel_rays_meet_at_depth_zero():
    camera, aside = Camera(double([128.0, 128.0]), double([0.0, 0.0])), double([0.5, 0.25, 0.125])
    T = Pose(torch.eye(3, dtype=torch.float64)[None], aside)
    uv = double([[16.0, 32.0], [-64.0, 8.0]])
    assert not epipolar.triangulate(uv, uv, camera, camera, T).depth.any()


@pytest.mark.parametrize("points", [1, 7, 8, 9, 24, 1 << 15])
def test_depths_in_pieces_are_those_of_triangulate(points, monkeypatch):
    monkeypatch.setattr(epipolar, "MAX_CHUNK_TRIANGULATED", points)
    for n in (0, 1, 12):
        uv_0, uv_1, _ = scene(n, noise_px=1.0)
        found = epipolar.triangulate_depth(uv_0, uv_1, CAMERA_0, CAMERA_1, MOTIONS)
        assert torch.equal(found, triangulated(uv_0, uv_1).depth)


def test_depth_differentiates_to_everything_it_is_made_of():
    uv_0, uv_1, _ = scene(3, noise_px=1.0)

    def call(uv_0, uv_1, f_0, c_0, f_1, c_1, R, t):
        return epipolar.triangulate(uv_0, uv_1, Camera(f_0, c_0), Camera(f_1, c_1), Pose(R, t))[:4]

    inputs = (uv_0, uv_1, CAMERA_0.f, CAMERA_0.c, CAMERA_1.f, CAMERA_1.c, MOTIONS.R, MOTIONS.t)
    assert torch.autograd.gradcheck(call, tuple(x.clone().requires_grad_() for x in inputs), fast_mode=True)


# ------------------------------------------------------------------------------------------------ what goes with it


def test_parallax_is_the_angle_at_the_point_between_the_two_centres():
    uv_0, uv_1, _ = scene(noise_px=1.0)
    found = triangulated(uv_0, uv_1)
    X = points(uv_0, found.depth)
    centre_1 = -torch.einsum("bji,bj->bi", MOTIONS.R, MOTIONS.t)  # of camera 1, in camera 0
    a, b = X, X - centre_1[:, None]
    cosine = (a * b).sum(-1) / (a.norm(dim=-1) * b.norm(dim=-1))
    close(found.parallax, cosine.acos())
    beside = Pose(torch.eye(3, dtype=torch.float64)[None], double([-1.0, 0.0, 0.0]))  # camera 1 stands 1 m to the right
    camera = Camera(double([100.0, 100.0]), double([0.0, 0.0]))
    right = epipolar.triangulate(double([[0.0, 0.0]]), double([[-100.0, 0.0]]), camera, camera, beside)
    close(right.depth, double([1.0]))
    close(right.parallax, double([np.pi / 4]))


def test_slope_and_jacobian_are_those_of_the_pixel():
    uv_0, uv_1, _ = scene(noise_px=1.0)
    found = triangulated(uv_0, uv_1)

    def seen(depth):
        return pixels(points(uv_0, depth))

    def moved(xi):
        return pixels(points(uv_0, found.depth), se3.retract(MOTIONS, xi))

    close(found.slope, torch.func.jvp(seen, (found.depth,), (torch.ones_like(found.depth),))[1])
    full = torch.func.jacrev(moved)(torch.zeros(2, 6, dtype=torch.float64))  # (B, N, 2, B, 6)
    close(found.J_pose, torch.stack([full[b, :, :, b] for b in range(2)]))


def test_point_jacobians_against_autograd():
    xyz = double([[0.3, -0.2, 2.0], [1.0, 0.5, 4.0], [-0.4, 0.7, -1.5]]).expand(2, 3, 3)
    J_point, J_pose = epipolar.point_jacobians(CAMERA_1, xyz)
    assert J_point.shape == (2, 3, 2, 3) and J_pose.shape == (2, 3, 2, 6)
    still = Pose(torch.eye(3, dtype=torch.float64).expand(2, 3, 3), torch.zeros(2, 3, dtype=torch.float64))
    by_point = torch.func.jacrev(lambda x: pixels(x, still))(xyz)
    by_pose = torch.func.jacrev(lambda xi: pixels(xyz, se3.retract(still, xi)))(torch.zeros(2, 6, dtype=torch.float64))
    for b in range(2):
        for i in range(3):
            close(J_point[b, i], by_point[b, i, :, b, i])
            close(J_pose[b, i], by_pose[b, i, :, b])


def test_jacobians_keep_away_from_zero_depth():
    at = lambda z: epipolar.point_jacobians(CAMERA_1[:1], double([[0.3, -0.2, z]]))[0]  # noqa: E731
    assert torch.equal(at(0.0), at(1e-9)) and torch.equal(at(-5e-10), at(1e-9))
    close(at(-2e-9)[..., 0, 0], CAMERA_1.f[:1, :1] / -2e-9, atol=0)


# ------------------------------------------------------------------------------------------------ points of others


def test_the_description_of_found_points_is_that_of_the_triangulation():
    uv_0, uv_1, _ = scene(noise_px=1.0)
    ours = triangulated(uv_0, uv_1)
    for a, b in zip(described(points(uv_0, ours.depth), uv_0, uv_1), ours, strict=True):
        close(a, b)


@pytest.mark.parametrize(("miss_0", "miss_1"), [(3.0, 0.0), (0.0, 3.0), (2.0, 3.0), (3.0, 2.0)])
def test_the_residual_of_a_described_point_is_the_larger_of_both_views(miss_0, miss_1):
    uv_0, uv_1, xyz = scene()
    aside = double(0.6, -0.8)
    found = described(xyz, uv_0 + miss_0 * aside, uv_1 - miss_1 * aside)
    close(found.residual_px, torch.full((2, 12), 3.0, dtype=torch.float64))
    close(found.depth, xyz[..., 2])


def test_a_described_point_speaks_for_itself_not_for_its_pixels():
    """Angle, slope and Jacobian are those at the point, wherever it was measured."""
    uv_0, uv_1, xyz = scene()
    straight, askew = described(xyz, uv_0, uv_1), described(xyz, uv_0 + 5, uv_1 - 3)
    for name in ("depth", "depth_1", "parallax", "slope", "J_pose"):
        close(getattr(askew, name), getattr(straight, name))


def test_a_described_point_in_the_plane_of_the_camera_stays_finite():
    uv_0, uv_1, xyz = scene(2)
    xyz[..., 2] = double(0.0, -5e-10)
    found = described(xyz, uv_0, uv_1)
    assert all(x.isfinite().all() for x in found)
    x = xyz / 1e-9
    close(found.slope[:, 0], _slope(x[:, 0], xyz[:, 0]), rtol=1e-6)


def _slope(x, X):
    """d pixel / d depth along the ray x where the point is X."""
    a, Y = (MOTIONS.R @ x[..., None])[..., 0], (MOTIONS.R @ (0 * X)[..., None])[..., 0] + MOTIONS.t
    return CAMERA_1.f * (a[:, :2] * Y[:, 2:] - Y[:, :2] * a[:, 2:]) / Y[:, 2:] ** 2


def test_lenses_of_the_cameras_play_no_part():
    """Pixels are ideal: a lens left in the camera is not applied again."""
    uv_0, uv_1, xyz = scene(noise_px=1.0)
    bent = [c.replace(distortion=double([0.2, 0, 0.01, 0]).expand(2, 4)) for c in (CAMERA_0, CAMERA_1)]
    for fn, first in ((epipolar.triangulate, ()), (epipolar.describe_triangulation, (xyz,))):
        plain = fn(*first, uv_0, uv_1, CAMERA_0, CAMERA_1, MOTIONS)
        for a, b in zip(fn(*first, uv_0, uv_1, *bent, MOTIONS), plain, strict=True):
            assert torch.equal(a, b)


def test_nothing_is_repeated_to_fit():
    """One view's pixels, camera or points for two pairs, or one pixel for many, are mistakes and no broadcasts."""
    uv, xyz, (a, b) = torch.zeros(2, 5, 2), torch.ones(2, 5, 3), (CAMERA_0, CAMERA_1)
    for fn in (epipolar.triangulate, epipolar.triangulate_depth):
        for args in ((uv[:1], uv, a, b), (uv, uv[:, :1], a, b), (uv, uv, a[:1], b), (uv, uv, a, b[:1])):
            with pytest.raises(ValueError, match=f"{fn.__name__}.*expected"):
                fn(*args, MOTIONS)
    for args in ((xyz[:1], uv, uv), (xyz, uv[:, :1], uv), (xyz, uv, uv[:, :1])):
        with pytest.raises(ValueError, match=r"describe.*expected"):
            epipolar.describe_triangulation(*args, a, b, MOTIONS)
    with pytest.raises(ValueError, match=r"point_jacobians.*expected"):
        epipolar.point_jacobians(a[:1], xyz)


# ------------------------------------------------------------------------------------------------ variance


def covariances(*shape, scale, seed):
    """Full ones: no axis is without the others."""
    A = torch.randn(*shape, shape[-1] + 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return scale**2 * A @ A.mT


def test_variance_is_the_first_order_one_of_autograd():
    """Depth as a function of the pixel of view 1 and of the pose, both with correlated errors."""
    uv_0, uv_1, _ = scene()
    cov_uv, cov_pose = covariances(2, 12, 2, scale=0.5, seed=1), covariances(2, 6, scale=1e-3, seed=2)
    own, shared = epipolar.depth_variance(triangulated(uv_0, uv_1), cov_uv, cov_pose)
    by_pixel = torch.func.grad(lambda uv: triangulated(uv_0, uv).depth.sum())(uv_1)
    by_pose = torch.func.jacrev(lambda xi: triangulated(uv_0, uv_1, se3.retract(MOTIONS, xi)).depth)(
        torch.zeros(2, 6, dtype=torch.float64)
    )
    for b in range(2):
        close(own[b], torch.einsum("ni,nij,nj->n", by_pixel[b], cov_uv[b], by_pixel[b]), rtol=1e-7)
        close(shared[b], torch.einsum("ni,ij,nj->n", by_pose[b, :, b], cov_pose[b], by_pose[b, :, b]), rtol=1e-7)


def test_variance_is_the_spread_over_random_errors():
    uv_0, uv_1, _ = scene(4)
    cov_uv, cov_pose = covariances(2, 4, 2, scale=0.2, seed=1), covariances(2, 6, scale=5e-4, seed=2)
    own, shared = epipolar.depth_variance(triangulated(uv_0, uv_1), cov_uv, cov_pose)
    draws, g = 4000, torch.Generator().manual_seed(3)
    white = torch.randn(draws, 2, 4, 2, generator=g, dtype=torch.float64)
    shifts = torch.einsum("bnij,dbnj->dbni", torch.linalg.cholesky(cov_uv), white)
    turns = torch.einsum(
        "bij,dbj->dbi",
        torch.linalg.cholesky(cov_pose),
        torch.randn(draws, 2, 6, generator=g, dtype=torch.float64),
    )
    by_track = torch.func.vmap(lambda s: triangulated(uv_0, uv_1 + s).depth)(shifts)
    by_pose = torch.func.vmap(lambda xi: triangulated(uv_0, uv_1, se3.retract(MOTIONS, xi)).depth)(turns)
    by_both = torch.func.vmap(lambda s, xi: triangulated(uv_0, uv_1 + s, se3.retract(MOTIONS, xi)).depth)(shifts, turns)
    for depth, variance in ((by_track, own), (by_pose, shared), (by_both, own + shared)):
        torch.testing.assert_close(depth.var(0), variance, rtol=0.1, atol=0)


def test_variance_takes_as_many_columns_as_the_covariance_has():
    uv_0, uv_1, _ = scene()
    found, cov = triangulated(uv_0, uv_1), covariances(2, 6, scale=1e-3, seed=2)
    alone = torch.zeros_like(cov)
    alone[:, 3:, 3:] = cov[:, 3:, 3:]
    zero = torch.zeros(2, 12, 2, 2, dtype=torch.float64)
    moved = found._replace(J_pose=found.J_pose[..., 3:])
    close(epipolar.depth_variance(moved, zero, cov[:, 3:, 3:])[1], epipolar.depth_variance(found, zero, alone)[1])


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


def test_a_pose_covariance_that_lost_its_sign_to_rounding_adds_nothing():
    found = triangulated(*scene()[:2])
    zero, minus = torch.zeros(2, 12, 2, 2, dtype=torch.float64), -1e-12 * torch.eye(6, dtype=torch.float64)
    own, shared = epipolar.depth_variance(found, zero, minus.expand(2, 6, 6))
    assert not own.any() and not shared.any()
