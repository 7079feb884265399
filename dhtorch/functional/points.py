"""Triangulation, tracking and pose as functions of plain tensors in kornia's conventions, ready to be offered upstream.

Thin: shapes, camera matrices and results are kornia's, the computation is that of :mod:`dhtorch.geometry` and
:mod:`dhtorch.stages`. Pixels are (u, v) with whole numbers at pixel centres, poses map the first frame (or the world)
into the camera, ``x = R X + t``. Wrong shapes raise kornia's ``ShapeError``; points that have no answer are masked,
never dropped. The page docs/upstream.md has scope, reviewers' requests and oracles of each function.
"""

import math
from typing import NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK, KORNIA_CHECK_SHAPE
from torch import Tensor

from dhtorch.geometry import camera as cam
from dhtorch.geometry import epipolar
from dhtorch.geometry.p3p import p3p
from dhtorch.geometry.se3 import Pose
from dhtorch.records import Samples, TrackHint, Tracks
from dhtorch.runtime.numerics import standard_numerics
from dhtorch.stages.pose import pnp_ransac
from dhtorch.stages.track import lucas_kanade


class PointTracks(NamedTuple):
    """Points found in another image."""

    points: Tensor  # (B, N, 2) px; the last position where not valid
    valid: Tensor  # (B, N) bool
    round_trip: Tensor  # (B, N) px, distance between a point and its track there and back
    covariance: Tensor  # (B, N, 2, 2) px² of points


class PnPSolution(NamedTuple):
    """Camera poses."""

    world_to_cam: Tensor  # (*, 3, 4), [I | 0] where not valid
    valid: Tensor  # (*,) bool
    inliers: Tensor  # (*, N) bool
    covariance: Tensor  # (*, 6, 6) of a left perturbation (rotation rad, translation), 0 where not valid


@standard_numerics
def triangulate_points_one_sided(
    points1: Tensor,  # (*, N, 2) px, exact
    points2: Tensor,  # (*, N, 2) px, measured
    K1: Tensor,  # (*, 3, 3) or (3, 3)
    K2: Tensor,  # (*, 3, 3) or (3, 3)
    R: Tensor,  # (*, 3, 3)
    t: Tensor,  # (*, 3, 1)
    *,
    covariance2: Tensor | None = None,  # (*, N, 2, 2) px²
    pose_covariance: Tensor | None = None,  # (*, 6, 6)
) -> tuple[Tensor, Tensor]:
    """Triangulate pixels of two views, those of the first being exact: points (*, N, 3) and covariances (*, N, 3, 3).

    Maximum likelihood for isotropic noise of the second pixel: it moves perpendicularly onto the epipolar line, and
    depth is a quotient in closed form. This is the case of detections or a pixel grid in view 1, tracked into view 2.

    Args:
        points1, points2: corresponding pixels.
        K1, K2: camera matrices without skew.
        R, t: pose of camera 2 relative to camera 1, ``X2 = R X1 + t``.
        covariance2: of ``points2``; None = 1 px² in each direction.
        pose_covariance: of a left perturbation of (R, t), rotation (rad) before translation; None = an exact pose.

    Returns:
        Points in camera 1, in the unit of ``t``, and their first-order covariances, of rank one (along the ray).
        Depth is negative behind the camera; without a baseline it is 0 and the covariance infinite.

    Raises:
        ShapeError: wrong shapes.

    Gradient: to all arguments.

    Example:
        >>> K = torch.tensor([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
        >>> points1, points2 = torch.tensor([[330.0, 250.0]]), torch.tensor([[280.0, 250.0]])  # disparity 50 px
        >>> t = torch.tensor([[-0.2], [0.0], [0.0]])
        >>> X, covariance = triangulate_points_one_sided(points1, points2, K, K, torch.eye(3), t)
        >>> X, covariance[..., 2, 2].sqrt()  # depth² / (f · baseline) for 1 px
        (tensor([[0.0400, 0.0400, 2.0000]]), tensor([0.0400]))
    """
    _check_shapes("* N 2", points1, points2)
    _check_shapes("* 3 3", K1, K2, R)
    _check_shapes("* 3 1", t)
    KORNIA_CHECK(points1.shape == points2.shape, f"points1 {points1.shape} and points2 {points2.shape} differ in shape")
    batch, N = points1.shape[:-2], points1.shape[-2]
    uv_1, uv_2 = _flat(points1, (), 2), _flat(points2, (), 2)
    camera_1, camera_2 = (cam.from_matrix(_flat(K, batch, 2)) for K in (K1, K2))
    geometry = epipolar.triangulate(
        uv_1, uv_2, camera_1, camera_2, Pose(_flat(R, batch, 2), _flat(t, batch, 2)[..., 0])
    )
    eye = torch.eye(2, dtype=uv_1.dtype, device=uv_1.device).expand(*batch, N, 2, 2)
    noise = _flat(eye if covariance2 is None else covariance2, batch, 3)
    pose_noise = R.new_zeros(6, 6) if pose_covariance is None else pose_covariance
    own, shared = epipolar.depth_variance(geometry, noise, _flat(pose_noise, batch, 2))
    ray = cam.rays(camera_1, uv_1)
    variance = (own + shared)[..., None, None]
    defined = (variance < torch.inf) & (geometry.depth != 0)[..., None, None]
    covariance = torch.where(defined, variance, 0.0) * (ray[..., :, None] * ray[..., None, :])
    covariance = torch.where(defined, covariance, torch.inf)
    points3d = ray * geometry.depth[..., None]
    return points3d.reshape(*batch, N, 3), covariance.reshape(*batch, N, 3, 3)


@standard_numerics
def track_points_lk(
    image1: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    image2: Tensor,  # (B, C, H', W')
    points1: Tensor,  # (B, N, 2) px
    initial: Tensor | None = None,  # (B, N, 2) px
    *,
    window_size: int = 21,
    num_levels: int = 4,
    num_iters: int = 30,
    eps: float = 0.01,
    fb_threshold: float | None = 1.0,
) -> PointTracks:
    """Track sparse points by pyramidal Lucas–Kanade, forward and back.

    Inverse composition with Scharr gradients on a pyramid whose levels lie as those of OpenCV. A point that fails on a
    coarse level is searched again on the finer ones.

    Args:
        image1, image2: images of one batch; grey values are BT.601.
        points1: pixels of image 1.
        initial: start of the search in image 2; None = ``points1``.
        window_size: width of a window in px, odd.
        num_levels: pyramid levels, full resolution included; 1 = no pyramid.
        num_iters: most steps per level.
        eps: length of a step in px below which a point has converged.
        fb_threshold: longest round trip in px of a valid track; None = no limit.

    Returns:
        Points with validity, round trip and covariance (residual variance times the inverse of the window's gradient
        matrix). Valid: textured, inside image 2, converging there and back, round trip below its limit. Not valid: the
        last position, which is finite.

    Raises:
        ShapeError: wrong shapes.
        ValueError: an even window, or an image no larger than the window.

    Gradient: of valid points to both images and ``points1``, by one Gauss–Newton step from the detached result (the
    implicit derivative); validity, round trip and covariance are detached.

    Example:
        >>> v, u = torch.meshgrid(torch.arange(80.0), torch.arange(100.0), indexing="ij")
        >>> first, second = (0.5 + 0.2 * (0.4 * (u - d)).sin() + 0.2 * (0.3 * v).cos() for d in (0.0, 1.5))
        >>> tracks = track_points_lk(first[None, None], second[None, None], torch.tensor([[[40.0, 30.0]]]))
        >>> tracks.points.round(decimals=1), tracks.valid
        (tensor([[[41.5000, 30.0000]]]), tensor([[True]]))
    """
    _check_shapes("B C H W", image1, image2)
    _check_shapes("B N 2", points1, points1 if initial is None else initial)
    KORNIA_CHECK(len(image1) == len(image2) == len(points1), "images and points differ in batch size")
    tracks = lucas_kanade(
        image1,
        image2,
        points1,
        hint=TrackHint(start=initial),
        window=window_size,
        levels=num_levels,
        iterations=num_iters,
        epsilon_px=eps,
        max_round_trip_px=torch.inf if fb_threshold is None else fb_threshold,
    )
    return PointTracks(tracks.uv_1, tracks.valid, tracks.error, tracks.cov)


@standard_numerics
def solve_p3p(
    world_points: Tensor,  # (*, 3, 3) point, coordinate
    img_points: Tensor,  # (*, 3, 2) px
    intrinsics: Tensor,  # (*, 3, 3) or (3, 3)
) -> tuple[Tensor, Tensor]:
    """All camera poses that three points allow: world to camera (*, 4, 3, 4) and which of the four exist (*, 4).

    Args:
        world_points: three points for each camera.
        img_points: their pixels.
        intrinsics: camera matrices without skew.

    Returns:
        Up to four poses, [I | 0] where there is none: collinear or coincident points have no solution. A double
        solution appears twice.

    Raises:
        ShapeError: wrong shapes.

    Gradient: none, it is a choice among roots; :func:`solve_pnp_ransac` refines and differentiates.

    Example:
        >>> X = torch.tensor([[0.0, 0.0, 2.0], [1.0, 0.2, 3.0], [-0.3, 1.0, 2.5]])
        >>> uv = X[:, :2] / X[:, 2:]  # seen from the origin, K = I
        >>> poses, valid = solve_p3p(X, uv, torch.eye(3))
        >>> bool((poses[valid] - torch.eye(3, 4)).abs().amax((-1, -2)).min() < 1e-4)
        True
    """
    _check_shapes("* 3 3", world_points, intrinsics)
    _check_shapes("* 3 2", img_points)
    batch = world_points.shape[:-2]
    rays = cam.rays(cam.from_matrix(_flat(intrinsics, batch, 2)), _flat(img_points, batch, 2))
    R, t, valid = p3p(rays, _flat(world_points, (), 2))
    return torch.cat((R, t[..., None]), -1).reshape(*batch, 4, 3, 4), valid.reshape(*batch, 4)


@standard_numerics
def solve_pnp_ransac(
    world_points: Tensor,  # (*, N, 3)
    img_points: Tensor,  # (*, N, 2) px
    intrinsics: Tensor,  # (*, 3, 3) or (3, 3)
    mask: Tensor | None = None,  # (*, N) bool
    *,
    inlier_threshold: float = 3.0,
    num_hypotheses: int = 256,
    min_inliers: int = 8,
    generator: torch.Generator | None = None,
) -> PnPSolution:
    """Camera poses from points with wrong correspondences among them: P3P hypotheses, MSAC, Levenberg–Marquardt.

    Each element of the batch is solved on its own: one without a pose is masked and does not touch the others. Planar
    points are no special case. The pose is differentiable by the implicit function theorem at the optimum.

    Args:
        world_points: points in the world.
        img_points: their pixels.
        intrinsics: camera matrices without skew.
        mask: correspondences to use; None = all.
        inlier_threshold: longest reprojection error of an inlier, px.
        num_hypotheses: triples that are drawn for each element.
        min_inliers: fewest inliers of a pose, at least 4.
        generator: source of the draws, on the CPU; None = torch's.

    Returns:
        World-to-camera poses, their validity, inliers, and covariances from the inliers' residuals (first order).

    Raises:
        ShapeError: wrong shapes.

    Gradient: poses to inlier ``world_points``, ``img_points`` and ``intrinsics``, exact to first order; the rest is
    detached.

    Example:
        >>> draw = torch.Generator().manual_seed(0)
        >>> X = torch.rand(2, 40, 3, generator=draw) + torch.tensor([-0.5, -0.5, 1.0])
        >>> K = torch.tensor([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
        >>> uv = X[..., :2] / X[..., 2:] * 500 + torch.tensor([320.0, 240.0])
        >>> uv[:, :8] += 50.0  # wrong correspondences
        >>> solution = solve_pnp_ransac(X, uv, K, generator=draw)
        >>> solution.valid, solution.inliers.sum(-1)
        (tensor([True, True]), tensor([32, 32]))
        >>> bool((solution.world_to_cam - torch.eye(3, 4)).abs().max() < 1e-4)
        True
    """
    _check_shapes("* N 3", world_points)
    _check_shapes("* N 2", img_points)
    _check_shapes("* 3 3", intrinsics)
    KORNIA_CHECK(
        world_points.shape[:-1] == img_points.shape[:-1],
        f"world_points {world_points.shape} and img_points {img_points.shape} differ in shape",
    )
    batch, N = world_points.shape[:-2], world_points.shape[-2]
    xyz, uv = _flat(world_points, (), 2), _flat(img_points, (), 2)
    used = torch.ones_like(uv[..., 0], dtype=torch.bool) if mask is None else _flat(mask, batch, 1)
    zero = torch.zeros_like(uv[..., 0])
    code = zero.to(torch.int32)
    eye = torch.eye(2, dtype=uv.dtype, device=uv.device).expand(*uv.shape, 2)
    unread = {"depth": zero, "sigma": zero, "confidence": zero, "trackability": zero, "flag": code, "hole": code}
    samples = Samples(uv=uv, xyz=xyz, **unread)
    tracks = Tracks(uv_0=uv, uv_1=uv, error=zero, photometric=zero, cov=eye, valid=used)
    camera = cam.from_matrix(_flat(intrinsics, batch, 2))
    draws = torch.rand(len(xyz), num_hypotheses, 3, generator=generator).to(xyz)
    fit = pnp_ransac(samples, tracks, camera, camera, draws, threshold_px=inlier_threshold, min_inlier=min_inliers)
    pose = torch.cat((fit.T_1_from_0.R, fit.T_1_from_0.t[..., None]), -1)
    ok = fit.ok[:, None, None]
    pose = torch.where(ok, pose, torch.eye(3, 4, dtype=pose.dtype, device=pose.device))
    cov = torch.where(ok, fit.cov, 0.0)
    return PnPSolution(
        pose.reshape(*batch, 3, 4), fit.ok.reshape(batch), fit.inlier.reshape(*batch, N), cov.reshape(*batch, 6, 6)
    )


def _check_shapes(pattern: str, *tensors: Tensor) -> None:
    for x in tensors:
        KORNIA_CHECK_SHAPE(x, pattern.split())


def _flat(x: Tensor, batch: tuple[int, ...], axes: int) -> Tensor:
    """A tensor with one batch axis before its last ``axes``, expanded to ``batch`` where it has none of its own."""
    if x.ndim == axes and batch:
        x = x.expand(*batch, *x.shape)
    return x.reshape(math.prod(x.shape[: x.ndim - axes]), *x.shape[x.ndim - axes :])
