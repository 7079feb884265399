"""Helpers of the test writers: a frame's pixels, depth codes and matrices, PNG encoding, saving of files."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame, Pose

#: Upwards in the world of ARKit, which the captures of phones have.
ARKIT_UP = (0.0, 1.0, 0.0)


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


def encode_unfiltered_png(picture: np.ndarray) -> bytes:
    """(H, W, 1 or 3) uint8 or (H, W) uint16 → bytes of a PNG with unfiltered rows."""
    h, w = picture.shape[:2]
    bits = 8 * picture.dtype.itemsize
    colour = 2 if picture.ndim == 3 and picture.shape[2] == 3 else 0
    rows = picture.astype(picture.dtype.newbyteorder(">"), order="C").reshape(h, -1).view(np.uint8)
    raw = np.concatenate((np.zeros((h, 1), np.uint8), rows), 1).tobytes()
    chunks = (b"IHDR" + struct.pack(">IIBBBBB", w, h, bits, colour, 0, 0, 0), b"IDAT" + zlib.compress(raw, 1), b"IEND")
    framed = (struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(framed)


def rotation_to_xyzw(R: np.ndarray) -> np.ndarray:
    """Rotation → quaternion x y z w: dominant eigenvector of a symmetric 4×4 matrix, exact to rounding at any angle."""
    d, s = R - R.T, R + R.T
    Q = np.empty((4, 4))
    Q[:3, :3] = s - np.trace(R) * np.eye(3)
    Q[:3, 3] = Q[3, :3] = [d[2, 1], d[0, 2], d[1, 0]]
    Q[3, 3] = np.trace(R)
    return np.linalg.eigh(Q)[1][:, -1]


def turn_world(frame: Frame, up: Sequence[float]) -> Frame:
    """The frame in a world turned so that its −y, upwards in the built-in scenes, becomes ``up``."""
    if frame.T_world_from_cam is None:
        return frame
    turn = Pose(se3.turn_between((0.0, -1.0, 0.0), up)[None], torch.zeros(1, 3, dtype=torch.float64))
    return frame.replace(T_world_from_cam=se3.compose(turn, frame.T_world_from_cam.to(torch.float64)))


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


def K_matrix(camera: Camera) -> np.ndarray:
    """Intrinsic matrix (3, 3) float64 of a camera."""
    return cameras.to_matrix(camera)[0].double().numpy()


def format_row(values: Any) -> str:
    """Numbers → one line of text with all digits of float64."""
    return " ".join(f"{float(x):.17g}" for x in values)


def format_rows(matrix: np.ndarray) -> str:
    """Matrix → text, one row per line."""
    return "".join(format_row(row) + "\n" for row in matrix)


def save_file(file: Path, content: bytes | str) -> None:
    """Write a file and create its folder."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content.encode() if isinstance(content, str) else content)
