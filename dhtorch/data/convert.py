"""Conversion of cameras, poses and depth of data sets to metres, x right, y down, z forward, ``T_world_from_cam``.

Alphabet: ``K`` 3×3 intrinsics; ``c2w`` camera-to-world 4×4 (maps camera points into the world); quaternions are
(x, y, z, w); *GL* axes are x right, y up, z backward (ARKit, OpenGL). Functions take numpy arrays and
return records; values that are no camera or rigid motion raise ``FormatError`` with the file they came from.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dhtorch.data.io.decode import FormatError, refuse_if, to_array
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.geometry.patches import round_half_up
from dhtorch.records import Camera, Pose

#: Largest |det − 1| of a stored rotation that is taken as rounding; larger ones are damage.
_MAX_DET_ERROR = 0.01

#: Largest focal length in px, far above that of real cameras; larger numbers overflow in float32.
_MAX_FOCAL_PX = 1e6
#: Largest coordinate in m, the circumference of the Earth.
MAX_COORDINATE_M = 4e7
#: Largest magnitude of a distortion coefficient.
_MAX_DISTORTION_COEFFICIENT = 1e4

_GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])


def to_camera(
    K: object,  # 3×3 numbers
    hw: tuple[int, int],
    file: Path,
    field: str = "K",
    distortion: object = None,  # OpenCV's order; all zero = None
) -> Camera:
    """Intrinsic matrix → camera (B = 1, float32), checked to be plausible for an image of size ``hw``.

    Raises:
        FormatError: not 3×3, not finite, last row not 0 0 1, skewed, focal length not positive, principal point more
            than one image size outside the image, or distortion that is not 4, 5 or 8 finite numbers.
    """
    matrix = to_array(K, (3, 3), file, field)
    f, c, wh = np.array([matrix[0, 0], matrix[1, 1]]), matrix[:2, 2], np.array([hw[1], hw[0]])
    refuse_if(
        not np.array_equal(matrix[2], [0, 0, 1]) or matrix[1, 0] != 0 or abs(matrix[0, 1]) > 1e-6 * abs(f[0]),
        file,
        field,
        matrix.tolist(),
        "fx 0 cx, 0 fy cy, 0 0 1 (no skew)",
    )
    refuse_if(
        not ((f >= 1 / _MAX_FOCAL_PX) & (f <= _MAX_FOCAL_PX)).all(),
        file,
        f"{field} focal length",
        f.tolist(),
        "two positive numbers of pixels",
    )
    refuse_if(
        not ((c > -wh) & (c < 2 * wh)).all(),
        file,
        f"{field} principal point",
        c.tolist(),
        f"a place near the {hw[1]}x{hw[0]} image",
    )
    lens = None
    if distortion is not None:
        count = len(distortion) if isinstance(distortion, (Sequence, np.ndarray)) else -1
        refuse_if(
            count not in (4, 5, 8), file, "distortion", distortion, "4, 5 or 8 numbers k1 k2 p1 p2 [k3 [k4 k5 k6]]"
        )
        coefficients = to_array(distortion, (count,), file, "distortion")
        if np.abs(coefficients).max() > _MAX_DISTORTION_COEFFICIENT:
            expected = f"numbers of at most {_MAX_DISTORTION_COEFFICIENT:g}"
            raise FormatError(file, "distortion", coefficients.tolist(), expected)
        lens = _to_float32(coefficients)[None] if coefficients.any() else None
    return Camera(_to_float32(f)[None], _to_float32(c)[None], lens)


def parse_K_option(values: Sequence[float], root: Path, field: str) -> np.ndarray:
    """fx, fy, cx, cy of an option → K."""
    return make_K(*to_array(values, (4,), root, field))


def to_cameras(values: np.ndarray, hw: tuple[int, int], file: Path, field: str, lens: object) -> Camera:
    """Rows of 4 (fx fy cx cy) or 9 numbers → cameras; a single camera if all rows are equal.

    Raises:
        FormatError: another number of columns, or as :func:`to_camera`.
    """
    flat = values.reshape(len(values), -1).astype(np.float64)
    refuse_if(flat.shape[1] not in (4, 9), file, field, f"{flat.shape[1]} numbers", "4 (fx fy cx cy) or 9")
    if (flat == flat[:1]).all():
        flat = flat[:1]
    cameras_of_rows = [to_camera(make_K(*k) if len(k) == 4 else k.reshape(3, 3), hw, file, field, lens) for k in flat]
    distortion = (
        None
        if cameras_of_rows[0].distortion is None
        else cameras_of_rows[0].distortion.expand(len(cameras_of_rows), -1)
    )
    return Camera(torch.cat([m.f for m in cameras_of_rows]), torch.cat([m.c for m in cameras_of_rows]), distortion)


def parse_poses(values: np.ndarray, file: Path, field: str) -> Pose:
    """Rows of 16 (4×4 by rows) or 7 numbers (x y z qx qy qz qw) → poses.

    Raises:
        FormatError: another number of columns, or as :func:`to_poses` and :func:`to_c2w`.
    """
    flat = values.reshape(len(values), -1).astype(np.float64)
    if flat.shape[1] == 7:
        return to_poses(to_c2w(flat[:, 3:], flat[:, :3], file, field), file, field)
    refuse_if(flat.shape[1] != 16, file, field, f"{flat.shape[1]} numbers", "16 (4x4 by rows) or 7 (x y z qx qy qz qw)")
    return to_poses(flat.reshape(-1, 4, 4), file, field)


def make_K(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """fx, fy, cx, cy → K (3, 3) float64."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)


def resize_K(K: np.ndarray, hw: tuple[int, int], new_hw: tuple[int, int]) -> np.ndarray:
    """K of an image of size ``hw`` for the same image at another size; an integer is the centre of a pixel."""
    s = np.array([new_hw[1] / hw[1], new_hw[0] / hw[0]])
    out = np.array(K, dtype=np.float64)
    out[:2] *= s[:, None]
    out[:2, 2] += (s - 1) / 2
    return out


def to_poses(
    c2w: np.ndarray,  # (n, 4, 4)
    file: Path,
    field: str = "pose",
) -> Pose:
    """Camera-to-world matrices → poses (n, float64) with rotations projected to the nearest true rotation.

    A matrix that is a rotation to float64 rounding is returned unchanged.

    Raises:
        FormatError: not finite, last row not 0 0 0 1, or determinant further than ``_MAX_DET_ERROR`` from 1 (a
            reflection, a scale, or damage).
    """
    if not np.isfinite(c2w).all():
        raise FormatError(
            file, field, f"a non-finite number in matrix {_first_index(~np.isfinite(c2w))}", "finite numbers"
        )
    invalid = np.abs(c2w).max((-1, -2), initial=0) > MAX_COORDINATE_M
    if invalid.any():
        raise FormatError(
            file, f"{field} {_first_index(invalid)}", c2w[invalid][0, :3].tolist(), f"at most {MAX_COORDINATE_M:g} m"
        )
    invalid = np.abs(c2w[:, 3] - [0, 0, 0, 1]).max(-1, initial=0) > 1e-6
    if invalid.any():
        raise FormatError(file, f"{field} {_first_index(invalid)} last row", c2w[invalid][0, 3].tolist(), "0 0 0 1")
    R = c2w[:, :3, :3]
    det = np.linalg.det(R)
    invalid = np.abs(det - 1) > _MAX_DET_ERROR
    if invalid.any():
        raise FormatError(
            file, f"{field} {_first_index(invalid)} determinant", f"{det[invalid][0]:.6g}", "1 (a rotation)"
        )
    orthogonality_error = np.abs(R @ R.swapaxes(-1, -2) - np.eye(3)).max((-1, -2), initial=0)
    invalid = orthogonality_error > 0.1
    if invalid.any():
        raise FormatError(file, f"{field} {_first_index(invalid)}", "axes that are not at right angles", "a rotation")
    u, _, vt = np.linalg.svd(R)
    R = np.where((orthogonality_error > 1e-14)[:, None, None], u @ vt, R)
    return Pose(torch.from_numpy(R), torch.from_numpy(c2w[:, :3, 3].copy()))


def to_c2w(
    quaternion: np.ndarray,  # (n, 4) x y z w, any length
    t: np.ndarray,  # (n, 3)
    file: Path,
    field: str = "quaternion",
) -> np.ndarray:
    """Quaternions and translations → matrices (n, 4, 4), by kornia (whose quaternions start with w).

    Raises:
        FormatError: a quaternion that is zero or not finite.
    """
    from kornia.geometry.conversions import quaternion_to_rotation_matrix  # noqa: PLC0415

    norm = np.linalg.norm(quaternion, axis=-1)
    invalid = ~((norm > 1e-6) & np.isfinite(norm))
    if invalid.any():
        raise FormatError(
            file, f"{field} {_first_index(invalid)}", quaternion[invalid][0].tolist(), "four numbers, not all zero"
        )
    c2w = np.zeros((len(t), 4, 4))
    c2w[:, :3, :3] = quaternion_to_rotation_matrix(torch.from_numpy(quaternion[:, [3, 0, 1, 2]])).numpy()
    c2w[:, :3, 3], c2w[:, 3, 3] = t, 1
    return c2w


def to_quaternions(
    rotation: np.ndarray,  # (n, 3) rad, axis times angle
) -> np.ndarray:
    """Rotation vectors → unit quaternions (n, 4), by kornia."""
    from kornia.geometry.conversions import axis_angle_to_quaternion  # noqa: PLC0415

    return axis_angle_to_quaternion(torch.from_numpy(rotation)).numpy()[:, [1, 2, 3, 0]]


def quaternions_of(
    R: Tensor,  # (n, 3, 3)
) -> Tensor:
    """Rotations → unit quaternions (n, 4), x y z w, by the largest component, by kornia."""
    from kornia.geometry.conversions import rotation_matrix_to_quaternion  # noqa: PLC0415  (0.2 s)

    return rotation_matrix_to_quaternion(R.contiguous())[:, [1, 2, 3, 0]]


def slerp(
    a: np.ndarray,  # (n, 4) unit quaternions
    b: np.ndarray,  # (n, 4)
    share: np.ndarray,  # (n,) fraction of the arc from a to b
) -> np.ndarray:
    """Spherical linear interpolation (n, 4) along the shortest arc from ``a`` to ``b``; both ends bit for bit.

    kornia's ``Quaternion.slerp`` rounds them.
    """
    dot = (a * b).sum(-1)
    b = np.where(dot < 0, -1.0, 1.0)[:, None] * b  # q and −q are one rotation
    angle = np.arctan2(np.linalg.norm(b - a, axis=-1), np.linalg.norm(b + a, axis=-1)) * 2
    scale = np.sinc(angle / np.pi)  # sin(angle) / angle, no division by zero where the two coincide
    weight_a = (1 - share) * np.sinc((1 - share) * angle / np.pi) / scale
    weight_b = share * np.sinc(share * angle / np.pi) / scale
    return weight_a[:, None] * a + weight_b[:, None] * b


def rot90_camera(camera: Camera, hw: tuple[int, int], turns: int) -> Camera:
    """Camera of an image of size ``hw`` rotated by ``turns`` quarter turns clockwise; see :func:`rot90_pose`."""
    for _ in range(turns % 4):
        c = torch.stack((hw[0] - 1 - camera.c[:, 1], camera.c[:, 0]), -1)
        distortion = camera.distortion
        if distortion is not None:  # the tangential coefficients rotate with the axes
            distortion = torch.cat((distortion[:, :2], distortion[:, 3:4], -distortion[:, 2:3], distortion[:, 4:]), -1)
        camera, hw = camera.replace(f=camera.f.flip(-1), c=c, distortion=distortion), (hw[1], hw[0])
    return camera


def rot90_pose(
    c2w: np.ndarray,  # (n, 4, 4)
    turns: int,
) -> np.ndarray:
    """Camera-to-world of an image rotated by ``turns`` quarter turns clockwise: only the camera rolls."""
    quarter = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return c2w @ np.linalg.matrix_power(quarter, turns % 4)


def rot90_image(x: Tensor, turns: int) -> Tensor:
    """Image (…, H, W) rotated by ``turns`` quarter turns clockwise."""
    return torch.rot90(x, -turns % 4, (-2, -1)).contiguous()


def resample_depth(
    depth: Tensor,  # (h, w) m, 0 = no return
    depth_camera: Camera,  # B = 1, no distortion
    camera: Camera,  # B = 1, no distortion, same centre and axes
    hw: tuple[int, int],
) -> Tensor:
    """Depth (H, W) at the pixel centres of ``camera``, by the nearest pixel, not interpolated; 0 outside the map."""
    if camera.distortion is not None or depth_camera.distortion is not None:
        raise ValueError("resample_depth: found a camera with distortion, expected cameras without distortion")

    def nearest_pixels(axis: int, count: int, size: int) -> tuple[Tensor, Tensor]:
        ray = (torch.arange(count, dtype=torch.float64) - camera.c[0, axis]) / camera.f[0, axis]
        at = round_half_up(ray * depth_camera.f[0, axis] + depth_camera.c[0, axis])
        return at.clamp(0, size - 1).long(), (at >= 0) & (at <= size - 1)

    (v, inside_v), (u, inside_u) = nearest_pixels(1, hw[0], depth.shape[0]), nearest_pixels(0, hw[1], depth.shape[1])
    sampled = depth.index_select(0, v).index_select(1, u)
    return torch.where(inside_v[:, None] & inside_u, sampled, torch.zeros_like(sampled))


def cv_from_gl(
    c2w: np.ndarray,  # (n, 4, 4) pose of a camera with GL axes
) -> np.ndarray:
    """The same poses with OpenCV camera axes: the camera's y and z are negated, the world is unchanged."""
    return c2w @ _GL_FROM_CV


def splat_depth(
    xyz_cam: Tensor,  # (M, 3) m, any point may be non-finite or behind the camera
    camera: Camera,  # B = 1
    hw: tuple[int, int],
    hide_px: int = 0,
) -> Tensor:
    """Points → depth map (H, W): nearest pixel, nearest point (z-buffer), no filling of holes.

    ``hide_px``: a point is also occluded by one more than 10 % nearer within this many pixels. Needed for sparse points
    seen from another centre than the camera's: the background otherwise appears in the gaps between the foreground's
    returns.
    """
    h, w = hw
    uv = round_half_up(cameras.project(camera, xyz_cam[None].to(camera.f.dtype))[0])
    z = xyz_cam[:, 2]
    u, v = uv.unbind(-1)
    inside = (u >= 0) & (v >= 0) & (u <= w - 1) & (v <= h - 1) & (z > 0) & torch.isfinite(z)
    index = torch.where(inside, v * w + u, h * w).long()  # points outside share one place after the last pixel
    far = torch.full((h * w + 1,), torch.inf)
    depth = far.scatter_reduce(0, index, z.to(far.dtype), "amin")[:-1].view(h, w)
    if hide_px > 0:
        # Minimum within ``reach`` rows and columns (square window), by doubling the window along each axis
        minimum = torch.nn.functional.pad(depth, (hide_px,) * 4, value=torch.inf)
        for dim in (0, 1):
            width = 1
            while width < 2 * hide_px + 1:
                step = min(width, 2 * hide_px + 1 - width)
                count = minimum.shape[dim] - step
                minimum = torch.minimum(minimum.narrow(dim, 0, count), minimum.narrow(dim, step, count))
                width += step
        depth = torch.where(depth > 1.1 * minimum, torch.inf, depth)
    return torch.where(torch.isfinite(depth), depth, torch.zeros_like(depth))


def register_depth(
    depth: Tensor,  # (h, w) m, 0 = no return
    depth_camera: Camera,  # B = 1
    camera: Camera,  # B = 1
    hw: tuple[int, int],
    T_cam_from_depth: Pose | None = None,  # None = same centre and axes
) -> Tensor:
    """Depth map → depth map over the field of view of an image of size ``hw``.

    Its size is that of :func:`size_of_registered_depth`. Forward warp with a z-buffer; holes are not filled.
    """
    v, u = torch.meshgrid(*(torch.arange(n, dtype=depth_camera.f.dtype) for n in depth.shape), indexing="ij")
    uv = torch.stack((u, v), -1).view(1, -1, 2)
    xyz = cameras.unproject(depth_camera, uv, torch.where(depth > 0, depth, torch.nan).view(1, -1))
    if T_cam_from_depth is not None:
        xyz = se3.apply(T_cam_from_depth, xyz)
    size = size_of_registered_depth(depth_camera, camera, hw)
    return splat_depth(xyz[0], cameras.resize(camera, hw, size), size)


def size_of_registered_depth(depth_camera: Camera, camera: Camera, hw: tuple[int, int]) -> tuple[int, int]:
    """Size at which depth is registered to an image of size ``hw``: the image's, or less where depth is coarser.

    At the image's own size a coarser map would leave gaps between its samples.
    """
    scale = min(1.0, float((depth_camera.f / camera.f).min()))
    return max(1, round(hw[0] * scale)), max(1, round(hw[1] * scale))


def _to_float32(x: np.ndarray) -> Tensor:
    return torch.from_numpy(x.astype(np.float32))


def _first_index(mask: np.ndarray) -> int:
    return int(np.argwhere(mask)[0, 0])
