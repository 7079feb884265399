"""Pinhole camera with OpenCV's lens distortion: intrinsics, projection, rays, (un)distortion.

Alphabet: ``uv`` (…, 2) pixels, ``xyz`` (…, 3) metres in camera axes (x right, y down, z forward), ``xy`` (…, 2) ideal
image-plane coordinates (z = 1), ``f``, ``c`` focal lengths and principal point in pixels.

Pixel convention of the whole project: *integer coordinates are pixel centres*; the top-left pixel's centre is
(0, 0) and the image spans [-0.5, W - 0.5] × [-0.5, H - 0.5].
"""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from dhtorch.geometry import se3
from dhtorch.geometry.checks import all_known, constant, shaped
from dhtorch.geometry.linalg import inverse_2x2
from dhtorch.geometry.se3 import Pose
from dhtorch.ops.dispatch import operator, run_kernel
from dhtorch.pytree import Record, record

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera
    from kornia.sensors.camera import CameraModelBase

#: Numbers of coefficients that a distortion may have: k1 k2 p1 p2 [k3 [k4 k5 k6]].
#: Source: OpenCV calibrateCamera, distortion models without thin prism and tilt.
COEFFICIENTS = (4, 5, 8)

#: Limits the Newton steps of :func:`undistort`, a count.
NEWTON_STEPS = 12

#: Limits the distance between a pixel and the distorted image of its ideal pixel, px: converged below, at any focal
#: length.
MAX_RETURN_ERROR_PX = 0.01

#: Limits the magnitude of a lens's Jacobian determinant from below, without unit.
MIN_DETERMINANT = 1e-12

#: Those of the kernels, in their order: steps, square of a step after which a point stops, px, determinant.
#: Source: derived, the constants above and the rounding of single precision.
NEWTON_LIMITS = (NEWTON_STEPS, torch.finfo(torch.float32).eps, MAX_RETURN_ERROR_PX, MIN_DETERMINANT)


@record
class Camera(Record):
    """Intrinsics of a batch of cameras."""

    f: Tensor  # (B, 2) px
    c: Tensor  # (B, 2) px
    distortion: Tensor | None = None  # (B, k) k1 k2 p1 p2 [k3 [k4 k5 k6]], OpenCV's order; None = ideal pinhole
    readout: Tensor | None = None  # (B,) s from first to last row (rolling shutter); None = global shutter

    @classmethod
    def from_kornia(cls, camera: "PinholeCamera | CameraModelBase", distortion: Tensor | None = None) -> "Camera":
        """The intrinsics of a camera of kornia; the pose of a ``PinholeCamera`` is ``Pose.from_kornia``.

        Numbers are used unchanged: kornia leaves the position of pixel centres to the caller; here they are at whole
        numbers. Skew is dropped.

        Args:
            camera: ``kornia.geometry.camera.PinholeCamera``, or of ``kornia.sensors.camera`` a ``PinholeModel`` or
                ``BrownConradyModel`` (also within a ``CameraModel``); without a batch dimension B is 1.
            distortion: (B, k) of a ``PinholeCamera`` or ``PinholeModel``, which store none.

        Raises:
            TypeError: another camera (fisheye, orthographic), or a distortion beside a camera's own.

        Gradient: to the intrinsics and the distortion.
        """
        from kornia.geometry.camera import PinholeCamera  # noqa: PLC0415  (imported where it is used: 0.2 s)
        from kornia.sensors.camera import BrownConradyModel, PinholeModel  # noqa: PLC0415

        if isinstance(camera, PinholeCamera):
            return from_matrix(camera.intrinsics[:, :3, :3], distortion)
        model = getattr(camera, "_model", camera)  # what a CameraModel delegates to
        if not isinstance(model, PinholeModel | BrownConradyModel) or (
            distortion is not None and isinstance(model, BrownConradyModel)
        ):
            actual = f"{type(model).__name__}{'' if distortion is None else ' with another distortion'}"
            raise TypeError(
                f"Camera.from_kornia: found {actual}, expected a PinholeCamera, PinholeModel or BrownConradyModel"
            )
        params = model.params.reshape(-1, model.params.shape[-1])
        return cls(params[:, :2], params[:, 2:4], params[:, 4:] if isinstance(model, BrownConradyModel) else distortion)

    def to_kornia(self, hw: tuple[int, int], T_cam_from_world: Pose | None = None) -> "PinholeCamera":
        """As a ``kornia.geometry.camera.PinholeCamera`` of images of size ``hw``; distortion is dropped.

        Its extrinsics map points of the world into the camera; None = the world is the camera's frame.

        Gradient: to the intrinsics and the pose.
        """
        from kornia.geometry.camera import PinholeCamera  # noqa: PLC0415  (imported where it is used: 0.2 s)

        eye = torch.eye(4, dtype=self.f.dtype, device=self.f.device).expand(len(self.f), 4, 4)
        K = torch.cat((torch.cat((to_matrix(self), eye[:, :3, 3:]), -1), eye[:, 3:]), 1)
        extrinsics = eye if T_cam_from_world is None else se3.to_matrix(T_cam_from_world)
        return PinholeCamera(K, extrinsics, *(self.f.new_full((len(self.f),), float(side)) for side in hw))


@shaped("K: B 3 3, distortion: B k", "camera.from_matrix")
def from_matrix(K: Tensor, distortion: Tensor | None = None, readout: Tensor | None = None) -> Camera:
    """Camera of an intrinsic matrix (B, 3, 3) without skew."""
    return Camera(K.diagonal(dim1=1, dim2=2)[:, :2].contiguous(), K[:, :2, 2], distortion, readout)


def to_matrix(camera: Camera) -> Tensor:
    """Intrinsic matrix (B, 3, 3) of a camera."""
    zero, one = torch.zeros_like(camera.f[:, 0]), torch.ones_like(camera.f[:, 0])
    rows = (camera.f[:, 0], zero, camera.c[:, 0], zero, camera.f[:, 1], camera.c[:, 1], zero, zero, one)
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def ideal(camera: Camera) -> Camera:
    """The same camera without its distortion: the camera of undistorted pixels."""
    return camera.replace(distortion=None)


def resize(camera: Camera, hw: tuple[int, int], new_hw: tuple[int, int]) -> Camera:
    """Camera of the image resampled from ``hw`` to ``new_hw`` (height, width); exact: c' = (c + ½) s − ½.

    kornia's ``PinholeCamera.scale`` multiplies c alone, which puts the centre of the first pixel at its corner.
    """
    s = torch.as_tensor([new_hw[1] / hw[1], new_hw[0] / hw[0]]).to(camera.f)
    return camera.replace(f=camera.f * s, c=resize_pixels(camera.c, hw, new_hw))


def resize_pixels(uv: Tensor, hw: tuple[int, int], new_hw: tuple[int, int]) -> Tensor:
    """Pixels (…, 2) of an image in the image resampled from ``hw`` to ``new_hw``. Gradient: to uv."""
    s = torch.as_tensor([new_hw[1] / hw[1], new_hw[0] / hw[0]]).to(uv)
    return (uv + 0.5) * s - 0.5


@shaped("camera.f: B 2, A: B 3 3", "camera.warp")
def warp(camera: Camera, A: Tensor) -> tuple[Camera, Tensor]:
    """Camera of the image whose pixel ``u`` moved to ``A u``, and what its axes did, for affine A (B, 3, 3) px.

    Flips, crops, resizes and rotations turn the camera about its optical axis, or mirror it: A K = K' Q with K' of
    positive focal lengths and Q (B, 3, 3) = diag(q, 1), whose q is orthogonal. A point X of the camera's axes is Q X in
    the new ones, its z-depth the same. A shear has no such camera: its q is not orthogonal, for the caller to see.

    Gradient: to the intrinsics and A.
    """
    linear = A[:, :2, :2] * camera.f[:, None]
    f = torch.linalg.vector_norm(linear, dim=-1)
    q = linear / f[..., None]
    c = (A[:, :2, :2] * camera.c[:, None]).sum(-1) + A[:, :2, 2]
    distortion = camera.distortion
    if distortion is not None:  # p2, p1 is a vector of the image plane, the other coefficients multiply the radius
        p2, p1 = (q * distortion[:, None, [3, 2]]).sum(-1).unbind(-1)
        distortion = torch.cat((distortion[:, :2], torch.stack((p1, p2), -1), distortion[:, 4:]), -1)
    Q = torch.nn.functional.pad(q, (0, 1, 0, 1))
    Q = Q + torch.diag(constant(Q, [0.0, 0.0, 1.0]))
    return camera.replace(f=f, c=c, distortion=distortion), Q


@shaped("camera.f: B 2, xyz: B N 3", "camera.project")
def project(
    camera: Camera,
    xyz: Tensor,  # (B, N, 3) m
) -> Tensor:
    """Pixels (B, N, 2) of points; the sign of z is left to the caller, |z| is kept away from zero.

    kornia's ``project_points`` multiplies by 1 / z and rounds differently; the distortion is kornia's.

    Gradient: to points, intrinsics and distortion. Checked against ``cv2.projectPoints`` and
    ``kornia.geometry.camera.PinholeCamera`` (``tests/geometry/test_camera.py``).
    """
    z = xyz[..., 2:]
    z = torch.where(z.abs() < 1e-9, torch.full_like(z, 1e-9), z)
    return _to_pixels(camera, xyz[..., :2] / z)


@shaped("camera.f: B 2, uv: B N 2, depth: B N", "camera.unproject")
def unproject(
    camera: Camera,
    uv: Tensor,  # (B, N, 2) px
    depth: Tensor,  # (B, N) m, z-depth
) -> Tensor:
    """Points (B, N, 3) at z-depth ``depth`` seen at (distorted) pixels ``uv``.

    By kornia's ``unproject_points``; a lens is undone before.
    """
    from kornia.geometry.camera import unproject_points  # noqa: PLC0415  (imported where it is used: 0.2 s)

    return unproject_points(undistort(camera, uv), depth[..., None], to_matrix(camera))


@shaped("camera.f: B 2, uv: B N 2", "camera.rays")
def rays(camera: Camera, uv: Tensor) -> Tensor:
    """Viewing rays (B, N, 3) with z = 1 through (distorted) pixels ``uv`` (B, N, 2).

    By kornia's ``unproject_points`` at depth 1; a lens is undone before.
    """
    check_lens(camera)
    return _rays(uv, camera.f, camera.c, camera.distortion)


#: What the kernels of this module read: pixels (B, N, 2), f and c (B, 2), distortion (B, k).
_LENS_DTYPES = dict.fromkeys(("uv", "f", "c", "distortion"), torch.float32)


@operator(
    kernel=lambda uv, f, c, distortion: run_kernel(
        "rays",
        (uv, f, c, uv.new_empty(0, 0) if distortion is None else distortion),
        uv.new_empty(*uv.shape[:2], 3),
        *NEWTON_LIMITS,
    ),
    dtypes=_LENS_DTYPES,
    any_layout=tuple(_LENS_DTYPES),
)
def _rays(uv: Tensor, f: Tensor, c: Tensor, distortion: Tensor | None) -> Tensor:
    """:func:`rays` of a camera's intrinsics."""
    return unproject(Camera(f, c, distortion), uv, torch.ones_like(uv[..., 0]))


@shaped("camera.f: B 2, uv: B N 2", "camera.ray_heights")
def ray_heights(camera: Camera, uv: Tensor) -> Tensor:
    """The y (B, N) of the :func:`rays` through ideal pixels ``uv`` (B, N, 2). Gradient: to uv and intrinsics."""
    return (uv[..., 1] - camera.c[:, 1:]) / camera.f[:, 1:]


@shaped("camera.f: B 2, uv: B N 2", "camera.distort")
def distort(camera: Camera, uv: Tensor) -> Tensor:
    """Pixels of the distorted image at ideal pixels (B, N, 2), by kornia. The inverse of :func:`undistort`."""
    if camera.distortion is None:
        return uv
    return _to_pixels(camera, _normalised(camera, uv))


@shaped("camera.f: B 2, uv: B N 2", "camera.undistort")
def undistort(camera: Camera, uv: Tensor, *, iterations: int = NEWTON_STEPS) -> Tensor:
    """Ideal pixels (B, N, 2) of pixels of the distorted image.

    Newton's method on the distortion model, from the pixel itself. A pixel for which it does not converge (outside
    the model's invertible field) becomes NaN. kornia's ``undistort_points`` is ten times as fast, but takes fixed-point
    steps: with a wide lens most pixels have not converged after its five, many not after forty, without any sign of it.

    Gradient: one Newton step from the detached solution, which is the implicit derivative, to ``uv``, intrinsics and
    distortion. Checked against ``cv2.undistortPoints`` and ``kornia.geometry.calibration.undistort_points``
    (``tests/geometry/test_camera.py``).
    """
    if camera.distortion is None:
        return uv
    check_lens(camera)
    return _undistort(uv, camera.f, camera.c, camera.distortion, iterations=iterations)


@operator(
    kernel=lambda uv, *lens, iterations: run_kernel(
        "undistort", (uv, *lens), uv.new_empty(uv.shape), iterations, *NEWTON_LIMITS[1:]
    ),
    dtypes=_LENS_DTYPES,
    any_layout=tuple(_LENS_DTYPES),
)
def _undistort(uv: Tensor, f: Tensor, c: Tensor, distortion: Tensor, *, iterations: int) -> Tensor:
    """:func:`undistort` of pixels of a camera with a lens."""
    target = _planes((uv - c[:, None]) / f[:, None])
    with torch.no_grad():
        xy = _solve_undistortion(distortion, target.detach(), iterations)
        residual = (_distort(distortion, xy)[0] - target).abs().amax(0)
        converged = residual * f.amax(-1)[:, None] < MAX_RETURN_ERROR_PX
        detached = torch.where(converged, xy, 0.0)
    xy = detached + _newton_step(distortion, detached, torch.where(converged, target, 0.0))
    uv = xy.movedim(0, -1) * f[:, None] + c[:, None]
    return torch.where(converged[..., None], uv, torch.nan)


@shaped("camera.f: B 2, depth_camera.f: B 2, uv: B N 2", "camera.depth_pixels")
def depth_pixels(
    camera: Camera,
    hw: tuple[int, int],
    depth_camera: Camera | None,
    depth_hw: tuple[int, int],
    uv: Tensor,  # (B, N, 2) px of the image
) -> Tensor:
    """Depth-map pixels (B, N, 2) of image pixels, for a map taken from the same pose.

    With ``depth_camera`` the pixel follows from the viewing ray; without one the map covers the same field as the image
    of size ``hw`` and the exact scaling rule of :func:`resize` applies.
    """
    if depth_camera is not None:
        return _to_pixels(depth_camera, _normalised(camera, undistort(camera, uv)))
    if depth_hw == hw:
        return uv
    return resize_pixels(uv, hw, depth_hw)


@shaped("camera.f: B 2, uv_ideal: B N 2", "camera.undistort_jacobian")
def undistort_jacobian(camera: Camera, uv_ideal: Tensor) -> Tensor:
    """d(ideal pixel) / d(distorted pixel), (B, N, 2, 2), at ideal pixels (B, N, 2), to transport covariances."""
    if camera.distortion is None:
        eye = torch.eye(2, dtype=uv_ideal.dtype, device=uv_ideal.device)
        return eye.expand(*uv_ideal.shape, 2)
    check_lens(camera)
    return _undistort_jacobian(uv_ideal, camera.f, camera.c, camera.distortion)


@operator(
    kernel=lambda uv, *lens: run_kernel("undistort_jacobian", (uv, *lens), uv.new_empty(*uv.shape, 2), MIN_DETERMINANT),
    dtypes=_LENS_DTYPES,
    any_layout=tuple(_LENS_DTYPES),
)
def _undistort_jacobian(uv: Tensor, f: Tensor, c: Tensor, distortion: Tensor) -> Tensor:
    """:func:`undistort_jacobian` of a camera with a lens."""
    f = f[:, None]
    a, b, d = _distort(distortion, _planes((uv - c[:, None]) / f))[1]
    inverse = inverse_2x2(a, b, b, d, least=MIN_DETERMINANT).movedim(0, -1).unflatten(-1, (2, 2))
    return f[..., :, None] * inverse / f[..., None, :]


def _normalised(camera: Camera, uv: Tensor) -> Tensor:
    return (uv - camera.c[:, None]) / camera.f[:, None]


def _to_pixels(camera: Camera, xy: Tensor) -> Tensor:
    """Pixels of the distorted image at ideal image-plane coordinates."""
    if camera.distortion is not None:
        # Distorted image-plane coordinates (B, N, 2) of ideal ones, by kornia
        from kornia.geometry.calibration import distort_points  # noqa: PLC0415

        _check_coefficient_count(camera.distortion)
        identity = torch.eye(3, dtype=xy.dtype, device=xy.device)
        xy = distort_points(xy, identity, camera.distortion)
    return xy * camera.f[:, None] + camera.c[:, None]


def _planes(xy: Tensor) -> Tensor:
    """(B, N, 2) as (2, B, N), each coordinate in a row."""
    return xy.movedim(-1, 0).contiguous()


def _solve_undistortion(distortion: Tensor, target: Tensor, iterations: int) -> Tensor:
    """Ideal planes (2, B, N) whose distortion is ``target``, by Newton's method.

    A point stops after a step whose square is below rounding, as the remaining error is then: so that its result does
    not depend on the iterations of others in its batch.
    """
    xy, moving = target, torch.ones_like(target[0], dtype=torch.bool)
    for _ in range(iterations):
        step = _newton_step(distortion, xy, target)
        xy = torch.where(moving, xy + step, xy)
        moving = moving & ((step * step).sum(0) > torch.finfo(xy.dtype).eps)
        if all_known(~moving):
            break
    return xy


def _newton_step(distortion: Tensor, xy: Tensor, target: Tensor) -> Tensor:
    """Newton step (2, B, N) to be added to the planes ``xy``."""
    value, (a, b, c) = _distort(distortion, xy)
    residual = target - value
    a, b, _, c = inverse_2x2(*(x.detach() for x in (a, b, b, c)), least=MIN_DETERMINANT)
    return torch.stack((a * residual[0] + b * residual[1], b * residual[0] + c * residual[1]))


def _distort(distortion: Tensor, xy: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
    """Brown's rational model: distorted planes (2, B, N) of ideal planes x, and the entries of its Jacobian (B, N).

    The value is s x + r² q with q = (p₂, p₁) and s = radial(r²) + 2 q·x; a, b, c are the entries of the Jacobian
    s I + 2 (radial' x xᵀ + x qᵀ + q xᵀ).
    """
    count = _check_coefficient_count(distortion)
    k1, k2, p1, p2, k3, k4, k5, k6 = torch.nn.functional.pad(distortion, (0, 8 - count))[:, None].unbind(-1)
    x, y = xy
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + r2 * (3 * k3))  # d radial / d r²
    if count > 5:
        denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = radial / denominator
        slope = (slope - radial * (k4 + r2 * (2 * k5 + r2 * (3 * k6)))) / denominator
    s = radial + 2 * (p1 * y + p2 * x)
    value = torch.stack((x * s + p2 * r2, y * s + p1 * r2))
    along = slope * x
    a, c = s + 2 * x * (along + 2 * p2), s + 2 * y * (slope * y + 2 * p1)
    return value, (a, 2 * (y * (along + p2) + x * p1), c)


def check_lens(*cameras: Camera) -> None:
    """Raise ValueError for a lens with other numbers of coefficients than :data:`COEFFICIENTS`. Gradient: none."""
    for camera in cameras:
        if camera.distortion is not None:
            _check_coefficient_count(camera.distortion)


def _check_coefficient_count(distortion: Tensor) -> int:
    count = distortion.shape[-1]
    if count not in COEFFICIENTS:  # more would be OpenCV's thin prism and tilted sensor
        raise ValueError(f"camera: distortion has {count} coefficients, expected one of {COEFFICIENTS}")
    return count
