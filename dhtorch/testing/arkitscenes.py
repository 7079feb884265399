"""Writer of ARKitScenes captures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dhtorch.geometry import camera as cameras
from dhtorch.records import Camera, Frame
from dhtorch.testing.parts import (
    K_matrix,
    depth_codes,
    pixels,
    png,
    pose_matrix,
    quaternion,
    seconds,
    text_row,
    write,
)


def write_arkitscenes(
    root: Path,
    assets: Mapping[str, Sequence[Frame]],  # asset → its frames, each at its own times
    *,
    trajectory: Sequence[Frame] | None = None,
) -> None:
    """Assets of one capture: pictures, depth, confidence, intrinsics and ``lowres_wide.traj``.

    ``lowres_wide``, ``vga_wide``, ``wide`` (``color``): image and intrinsics. ``lowres_depth``: depth, its
    intrinsics (``lowres_wide_intrinsics``) and confidence, where the frames have one. ``highres_depth``: depth and its
    intrinsics (``wide_intrinsics``). ``<asset>_intrinsics``: intrinsics alone.

    Args:
        root: the capture's folder; its name is the video id.
        assets: what to write.
        trajectory: frames whose poses the trajectory holds. None = no trajectory, as 24 captures have it.
    """
    for asset, frames in assets.items():
        for frame in frames:
            name = f"{root.name}_{seconds(frame):.3f}"
            if asset.endswith("_depth"):
                write(root / asset / f"{name}.png", png(depth_codes(frame.depth, 1000)))
                of = "lowres_wide" if asset == "lowres_depth" else "wide"
                hw = (frame.depth.shape[-2], frame.depth.shape[-1])
                camera = frame.depth_camera or cameras.resize(frame.camera, frame.hw, hw)
                _pincam(root / f"{of}_intrinsics" / f"{name}.pincam", camera, hw)
                if asset == "lowres_depth" and frame.conf is not None:
                    write(root / "confidence" / f"{name}.png", png(frame.conf[0].numpy()))
                continue
            if not asset.endswith("_intrinsics"):
                write(root / asset / f"{name}.png", png(pixels(frame)))
            folder = asset.removesuffix("_intrinsics") + "_intrinsics"
            _pincam(root / folder / f"{name}.pincam", frame.camera, frame.hw)
    if trajectory is not None:
        rows = [_row(seconds(frame), pose_matrix(frame)) for frame in trajectory]
        write(root / "lowres_wide.traj", "".join(row + "\n" for row in rows))


def _pincam(file: Path, camera: Camera, hw: tuple[int, int]) -> None:
    K = K_matrix(camera)
    write(file, f"{hw[1]} {hw[0]} " + text_row([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]) + "\n")


def _row(time: float, c2w: np.ndarray) -> str:
    """Stamp, rotation vector and translation, world to camera."""
    R = c2w[:3, :3].T
    return text_row([time, *_rotation_vector(R), *(-R @ c2w[:3, 3])])


def _rotation_vector(R: np.ndarray) -> np.ndarray:
    """Axis times angle (3,) of a rotation, by way of its quaternion (exact near 0 and near half a turn)."""
    q = quaternion(R)
    q = -q if q[3] < 0 else q
    length = float(np.linalg.norm(q[:3]))
    return q[:3] * (2 * np.arctan2(length, q[3]) / length if length > 0 else 2.0)
