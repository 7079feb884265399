"""Helpers of the writers: tensors and frames -> numpy arrays, colours -> uint8, and selection of finite points."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame


def to_numpy(x: Any) -> np.ndarray:
    """Tensor (detached and moved to the CPU) or any array-like → numpy array."""
    return x.detach().cpu().numpy() if hasattr(x, "detach") else np.asarray(x)


def check_rows(where: str, name: str, x: Any, n: int | None, width: int | None) -> np.ndarray:
    """``x`` as (n, width), or (n,) where ``width`` is None.

    Raises:
        ValueError: another shape.
    """
    values = to_numpy(x)
    shape = (len(values) if n is None and values.ndim else n, *([] if width is None else [width]))
    if values.shape != shape:
        expected = ", ".join("P" if s is None else str(s) for s in (n, *([] if width is None else [width])))
        raise ValueError(f"{where}: {name} has shape {values.shape}, expected ({expected})")
    return values


def colour_to_uint8(rgb: np.ndarray) -> np.ndarray:
    """Colours → uint8: uint8 is unchanged, floats in [0, 1] are clipped and rounded; NaN is black."""
    if rgb.dtype == np.uint8:
        return rgb
    return np.round(255 * np.clip(np.nan_to_num(rgb.astype(np.float64)), 0, 1)).astype(np.uint8)


def select_finite(xyz: np.ndarray, face: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
    """(mask (P,) of finite points, triangles of finite points, renumbered among these).

    Raises:
        ValueError: a triangle with a corner that does not exist.
    """
    finite = np.isfinite(xyz).all(1)
    if face is None:
        return finite, None
    if face.size and not (face.min() >= 0 and face.max() < len(xyz)):
        raise ValueError(f"export: face names points {face.min()} to {face.max()}, expected 0 to {len(xyz) - 1}")
    renumbered = np.cumsum(finite) - 1
    return finite, renumbered[face[finite[face].all(1)]] if face.size else face.reshape(0, 3)


def rotation_to_wxyz(
    R: Tensor,  # (3, 3)
) -> list[float]:
    """Rotation → quaternion w, x, y, z (kornia's order), w >= 0."""
    from kornia.geometry.conversions import rotation_matrix_to_quaternion  # noqa: PLC0415

    q = rotation_matrix_to_quaternion(R[None])[0]
    return (-q if q[0] < 0 else q).tolist()


def rotation_to_xyzw(R: np.ndarray) -> np.ndarray:
    """Rotation → quaternion x y z w: dominant eigenvector of a symmetric 4×4 matrix, exact to rounding at any angle."""
    d, s = R - R.T, R + R.T
    Q = np.empty((4, 4))
    Q[:3, :3] = s - np.trace(R) * np.eye(3)
    Q[:3, 3] = Q[3, :3] = [d[2, 1], d[0, 2], d[1, 0]]
    Q[3, 3] = np.trace(R)
    return np.linalg.eigh(Q)[1][:, -1]


def frame_to_hwc(frame: Frame) -> np.ndarray:
    """Image of a frame (H, W, C) uint8."""
    image = frame.image[0]
    if image.dtype != torch.uint8:
        image = (image.clamp(0, 1) * 255).round().to(torch.uint8)
    return image.permute(1, 2, 0).numpy()


def encode_depth_codes(depth: Tensor, units_per_metre: float) -> np.ndarray:
    """Depth (1, h, w) m → codes (h, w) uint16, C-contiguous."""
    codes = (depth[0].double() * units_per_metre).round().clamp(0, 65534)
    return np.ascontiguousarray(codes.numpy(), np.uint16)


def K_matrix(camera: Camera) -> np.ndarray:
    """Intrinsic matrix (3, 3) float64 of a camera."""
    return cameras.to_matrix(camera)[0].double().numpy()


def pose_matrix(frame: Frame) -> np.ndarray:
    """Camera-to-world (4, 4) float64 of a frame."""
    if frame.T_world_from_cam is None:
        raise ValueError("writers: found a frame without T_world_from_cam, expected a pose to write")
    return se3.to_matrix(frame.T_world_from_cam)[0].double().numpy()


def frame_time_s(frame: Frame) -> float:
    """Time stamp of a frame in s."""
    if frame.time is None:
        raise ValueError("writers: found a frame without time, expected a stamp to write")
    return float(frame.time[0])
