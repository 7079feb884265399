"""Two-view geometry of one point: pixels, cameras and pose → closed-form depth and its variance.

Alphabet: view 0 is the reference view and its pixel ``uv_0`` is exact; ``x`` = viewing ray of view 0 with z = 1; the
point is X = depth · x in camera 0 and Y = R X + t in camera 1; ``uv_1`` is its measured pixel. Everything is ideal
pinhole; the two cameras may differ. Coordinates are separate (B, N) planes: each operation is contiguous, and rounding
cannot depend on the batch.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.camera import Camera
from dhtorch.geometry.checks import shaped
from dhtorch.geometry.determinism import chunk_size, pad_elementwise
from dhtorch.geometry.linalg import quadratic_form, upper_triangle
from dhtorch.geometry.se3 import Pose
from dhtorch.ops.dispatch import operator, run_kernel

#: Limits the points of all pairs that :func:`triangulate_depth` processes at once, a count: torch does not split so few
#: over threads.
MAX_CHUNK_TRIANGULATED = 1 << 15


#: Least squared slope of a pixel by its depth, px²/m²: below it depth does not move the pixel.
MIN_SQUARED_SLOPE = 1e-18


_SHAPES = "uv_0: B N 2, uv_1: B N 2, camera_0.f: B 2, camera_1.f: B 2, T_1_from_0.R: B 3 3, T_1_from_0.t: B 3"


class TwoView(NamedTuple):
    """Triangulation of B × N points: finite everywhere, meaningful where both depths are positive."""

    depth: Tensor  # (B, N) m, z in camera 0
    depth_1: Tensor  # (B, N) m, z in camera 1
    parallax: Tensor  # (B, N) rad, angle at the point between the rays to the two centres
    residual_px: Tensor  # (B, N) distance of uv_1 from the point's image in view 1
    slope: Tensor  # (B, N, 2) px/m, d(pixel in view 1) / d(depth): the epipolar direction times the sensitivity
    J_pose: Tensor  # (B, N, 2, 6) d(pixel in view 1) / d(left perturbation of T_1_from_0)


@shaped(_SHAPES)
def triangulate(
    uv_0: Tensor,  # (B, N, 2) ideal px
    uv_1: Tensor,  # (B, N, 2) ideal px
    camera_0: Camera,
    camera_1: Camera,
    T_1_from_0: Pose,
) -> TwoView:
    """One-sided optimal triangulation of pixels: uv_0 is exact, uv_1 is moved onto its epipolar line.

    ``uv_1`` moves perpendicularly (in pixels) onto the epipolar line of ``uv_0``, which is the maximum-likelihood
    correction for isotropic noise in view 1; the two rays then meet, and depth is a quotient of lengths along the line.

    Returns:
        :class:`TwoView`. Without a baseline, or where the rays are exactly parallel, depth is 0 and the rest finite
        but meaningless.

    kornia's ``triangulate_points`` lets both pixels move; ``sampson_epipolar_distance`` would be that distance for two
    noisy pixels.

    Gradient: to pixels, both cameras and the pose; smooth except at the epipole.
    Checked against ``cv2.triangulatePoints`` and ``kornia.geometry.epipolar.triangulate_points``
    (``tests/geometry/test_epipolar.py``).
    Source: R. Hartley, A. Zisserman, "Multiple View Geometry", section 12.3, with one noise-free view.
    """
    return _triangulate(uv_0, uv_1, camera_0.f, camera_0.c, camera_1.f, camera_1.c, T_1_from_0.R, T_1_from_0.t)


#: What the kernel reads: pixels (B, N, 2), f and c (B, 2) px of both cameras, the pose.
_TRIANGULATE_DTYPES = dict.fromkeys(("uv_0", "uv_1", "f_0", "c_0", "f_1", "c_1", "R", "t"), torch.float32)


@operator(
    kernel=lambda uv_0, *others: run_kernel(
        "triangulate",
        (uv_0, *others),
        TwoView._make(
            (*uv_0.new_empty(4, *uv_0.shape[:2]), uv_0.new_empty(uv_0.shape), uv_0.new_empty(*uv_0.shape, 6))
        ),
    ),
    dtypes=_TRIANGULATE_DTYPES,
    any_layout=tuple(_TRIANGULATE_DTYPES),
)
def _triangulate(*tensors: Tensor) -> TwoView:
    """:func:`triangulate` of pixels, intrinsics and a pose."""
    uv_0, uv_1, f_0, c_0, f_1, c_1, R, t = tensors
    camera_1, T = Camera(f_1, c_1), Pose(R, t)
    direction = _rotated_rays(uv_0, Camera(f_0, c_0), T)
    depth = _triangulated_depth(direction, uv_1, camera_1, T)
    return _two_view(depth, torch.stack(direction, -1), uv_1, camera_1, T)


@shaped(_SHAPES)
def triangulate_depth(
    uv_0: Tensor,  # (B, N, 2) ideal px
    uv_1: Tensor,  # (B, N, 2) ideal px
    camera_0: Camera,
    camera_1: Camera,
    T_1_from_0: Pose,
) -> Tensor:
    """Depth (B, N) of :func:`triangulate` alone, for many points: m, z in camera 0.

    Processes the points in chunks that stay in cache.

    Raises:
        ValueError: wrong shapes.

    Gradient: as :func:`triangulate`.
    """
    step = max(chunk_size(MAX_CHUNK_TRIANGULATED, uv_0) // max(uv_0.shape[0], 1), 1)
    chunks = (
        [(uv_0, uv_1)] if torch.compiler.is_compiling() else zip(uv_0.split(step, 1), uv_1.split(step, 1), strict=True)
    )
    depths = [_triangulated_depth(_rotated_rays(a, camera_0, T_1_from_0), b, camera_1, T_1_from_0) for a, b in chunks]
    return torch.cat(depths, 1)


def _rotated_rays(uv_0: Tensor, camera_0: Camera, T_1_from_0: Pose) -> tuple[Tensor, Tensor, Tensor]:
    """The reference view's rays rotated into camera 1, R x, as three planes (B, N)."""
    (u, v), (cx, cy) = uv_0.unbind(-1), camera_0.c.split(1, 1)
    x, y = u - cx, v - cy
    R = torch.cat((T_1_from_0.R[..., :2] / camera_0.f[:, None], T_1_from_0.R[..., 2:]), -1)[..., None]
    a0, a1, a2 = (x * R[:, k, 0] + y * R[:, k, 1] + R[:, k, 2] for k in range(3))
    return a0, a1, a2


def _triangulated_depth(
    direction: tuple[Tensor, Tensor, Tensor], uv_1: Tensor, camera_1: Camera, T_1_from_0: Pose
) -> Tensor:
    """Depth (B, N) where the reference view's rays meet the rays of ``uv_1`` moved onto the epipolar lines."""
    (a0, a1, a2), (t0, t1, t2) = direction, T_1_from_0.t.split(1, 1)
    u, v = uv_1.unbind(-1)
    (fx, fy), (cx, cy) = camera_1.f.split(1, 1), camera_1.c.split(1, 1)
    y0, y1 = (u - cx) / fx, (v - cy) / fy
    # (a − a₃ y) depth = t₃ y − t on the first two rows, for y on the epipolar line. Its direction is g = t₃ a − a₃ t;
    # along it the perpendicular projection in pixels does not move a point.
    stretch = fy / fx
    g0, g1 = t2 * a0 - t0 * a2, (t2 * a1 - t1 * a2) * (stretch * stretch)
    near = g0 * (t2 * y0 - t0) + g1 * (t2 * y1 - t1)
    far = g0 * (a0 - a2 * y0) + g1 * (a1 - a2 * y1)
    return near * far / (far * far).clamp_min(1e-20)


@shaped(f"xyz_0: B N 3, {_SHAPES}")
def describe_triangulation(
    xyz_0: Tensor,  # (B, N, 3) m in camera 0
    uv_0: Tensor,
    uv_1: Tensor,
    camera_0: Camera,
    camera_1: Camera,
    T_1_from_0: Pose,
) -> TwoView:
    """:class:`TwoView` of points from another triangulation; the residual is the larger of the two views."""
    z = xyz_0[..., 2]
    x = xyz_0 / torch.where(z.abs() < 1e-9, torch.full_like(z, 1e-9), z)[..., None]
    geometry = _two_view(z, se3.rotate(T_1_from_0.R, x), uv_1, camera_1, T_1_from_0)
    residual_0 = _length(uv_0 - cam.project(cam.ideal(camera_0), xyz_0))
    return geometry._replace(residual_px=torch.maximum(geometry.residual_px, residual_0))


def _two_view(depth: Tensor, direction: Tensor, uv_1: Tensor, camera_1: Camera, T_1_from_0: Pose) -> TwoView:
    """:class:`TwoView` at ``depth``; ``direction`` (B, N, 3) = R x, the reference view's ray rotated into camera 1."""
    t = T_1_from_0.t[:, None]
    Y = depth[..., None] * direction + t
    residual = uv_1 - cam.project(cam.ideal(camera_1), Y)
    J_point, J_pose = point_jacobians(camera_1, Y)
    slope = (J_point * direction[..., None, :]).unbind(-1)
    (y0, y1, y2), (d0, d1, d2) = Y.unbind(-1), (Y - t).unbind(-1)
    cross = torch.stack((y1 * d2 - y2 * d1, y2 * d0 - y0 * d2, y0 * d1 - y1 * d0), -1)
    return TwoView(
        depth,
        Y[..., 2],
        pad_elementwise(torch.atan2, _length(cross), y0 * d0 + y1 * d1 + y2 * d2),
        _length(residual),
        slope[0] + slope[1] + slope[2],
        J_pose,
    )


@shaped("camera.f: B 2, xyz: B N 3")
def point_jacobians(
    camera: Camera,
    xyz: Tensor,  # (B, N, 3) m in that camera
) -> tuple[Tensor, Tensor]:
    """d(pixel) / d(point) (B, N, 2, 3) and d(pixel) / d(left pose perturbation) (B, N, 2, 6), ideal pinhole.

    |z| is kept away from zero, where kornia's ``dx_project_points_z1`` has no finite gradient. Checked against
    ``torch.func.jacrev`` (``tests/geometry/test_epipolar.py``).
    """
    x, y, z = xyz.unbind(-1)
    inv_z = 1 / torch.where(z.abs() < 1e-9, torch.full_like(z, 1e-9), z)
    zero = torch.zeros_like(z)
    fx, fy = camera.f[:, None, 0] * inv_z, camera.f[:, None, 1] * inv_z
    gx, gy = -fx * x * inv_z, -fy * y * inv_z
    J_point = torch.stack((fx, zero, gx, zero, fy, gy), -1).unflatten(-1, (2, 3))
    J_rotation = torch.stack((gx * y, fx * z - gx * x, -fx * y, gy * y - fy * z, -gy * x, fy * x), -1)
    return J_point, torch.cat((J_rotation.unflatten(-1, (2, 3)), J_point), -1)


def depth_variance(
    geometry: TwoView,
    cov_uv_1: Tensor,  # (B, N, 2, 2) px²
    cov_pose: Tensor,  # (B, k, k), k columns of J_pose
) -> tuple[Tensor, Tensor]:
    """First-order variance of depth (B, N) m²: the point's own part (its track), and the part shared through the pose.

    Along the epipolar direction d the depth obeys |slope| · dz = d · (δuv_1 − J_pose δξ), hence both parts.

    Gradient: to covariances and geometry. Infinite where depth does not move the pixel.
    """
    return _depth_variance(geometry.slope, geometry.J_pose, cov_uv_1, cov_pose)


_VARIANCE_DTYPES = dict.fromkeys(("slope", "J_pose", "cov_uv_1", "cov_pose"), torch.float32)


@operator(
    kernel=lambda slope, *others: run_kernel(
        "depth_variance", (slope, *others), slope.new_empty(2, *slope.shape[:2]).unbind(), MIN_SQUARED_SLOPE
    ),
    dtypes=_VARIANCE_DTYPES,
    any_layout=tuple(_VARIANCE_DTYPES),
)
def _depth_variance(slope: Tensor, J_pose: Tensor, cov_uv_1: Tensor, cov_pose: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`depth_variance` of fields of a :class:`TwoView`."""
    slope2 = (slope * slope).sum(-1)
    defined = slope2 > MIN_SQUARED_SLOPE
    gain = slope / torch.where(defined, slope2, torch.ones_like(slope2))[..., None]  # d(depth) / d(uv_1), m/px
    g0, g1 = gain.unbind(-1)
    own = quadratic_form(g0, g1, *upper_triangle(cov_uv_1))
    row = g0[..., None] * J_pose[..., 0, :] + g1[..., None] * J_pose[..., 1, :]  # (B, N, k)
    cov_rows = sum(row[..., k, None] * cov_pose[:, None, k] for k in range(cov_pose.shape[-1]))
    shared = (cov_rows * row).sum(-1)
    infinite = torch.full_like(own, torch.inf)
    return torch.where(defined, own, infinite), torch.where(defined, shared.clamp_min(0), infinite)


def _length(v: Tensor) -> Tensor:
    """Euclidean length over the last axis with a finite gradient at zero."""
    square = (v * v).sum(-1)
    positive = square > 0
    return torch.where(positive, torch.where(positive, square, torch.ones_like(square)).sqrt(), square)
