"""Test writer of ARKitScenes captures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dhtorch.export.arrays import (
    K_matrix,
    encode_depth_codes,
    frame_time_s,
    frame_to_hwc,
    pose_matrix,
    rotation_to_xyzw,
)
from dhtorch.records import Camera, Frame
from support.writers.parts import encode_unfiltered_png, format_row, save_file


def write_arkitscenes(
    root: Path,
    assets: Mapping[str, Sequence[Frame]],  # asset → its frames, each with its own times
    *,
    trajectory: Sequence[Frame] | None = None,
) -> None:
    """Write assets of one capture: images, depth, confidence, intrinsics and ``lowres_wide.traj``.

    ``lowres_wide``, ``vga_wide``, ``wide`` (``color``): image and intrinsics. ``lowres_depth``: depth, its
    intrinsics (``lowres_wide_intrinsics``) and confidence, where the frames have one. ``highres_depth``: depth and its
    intrinsics (``wide_intrinsics``). ``<asset>_intrinsics``: only intrinsics.

    Args:
        root: the capture's folder; its name is the video id.
        assets: what to write.
        trajectory: frames with the poses of the trajectory, in a world with z up. None = no trajectory, as for 24
            captures.
    """
    for asset, frames in assets.items():
        for frame in frames:
            name = f"{root.name}_{frame_time_s(frame):.3f}"
            if asset.endswith("_depth"):
                save_file(root / asset / f"{name}.png", encode_unfiltered_png(encode_depth_codes(frame.depth, 1000)))
                colour_asset = "lowres_wide" if asset == "lowres_depth" else "wide"
                hw = (frame.depth.shape[-2], frame.depth.shape[-1])
                _write_pincam(root / f"{colour_asset}_intrinsics" / f"{name}.pincam", frame.map_camera, hw)
                if asset == "lowres_depth" and frame.conf is not None:
                    save_file(root / "confidence" / f"{name}.png", encode_unfiltered_png(frame.conf[0].numpy()))
                continue
            if not asset.endswith("_intrinsics"):
                save_file(root / asset / f"{name}.png", encode_unfiltered_png(frame_to_hwc(frame)))
            folder = asset.removesuffix("_intrinsics") + "_intrinsics"
            _write_pincam(root / folder / f"{name}.pincam", frame.camera, frame.hw)
    if trajectory is not None:
        rows = [_trajectory_row(frame_time_s(frame), pose_matrix(frame)) for frame in trajectory]
        save_file(root / "lowres_wide.traj", "".join(row + "\n" for row in rows))


def _write_pincam(file: Path, camera: Camera, hw: tuple[int, int]) -> None:
    K = K_matrix(camera)
    save_file(file, f"{hw[1]} {hw[0]} " + format_row([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]) + "\n")


def _trajectory_row(time: float, c2w: np.ndarray) -> str:
    """Line with stamp, rotation vector and translation, world to camera."""
    R = c2w[:3, :3].T
    return format_row([time, *_rotation_vector(R), *(-R @ c2w[:3, 3])])


def _rotation_vector(R: np.ndarray) -> np.ndarray:
    """Rotation → axis · angle (3,), via its quaternion (exact near 0 and near 180°)."""
    q = rotation_to_xyzw(R)
    q = -q if q[3] < 0 else q
    length = float(np.linalg.norm(q[:3]))
    return q[:3] * (2 * np.arctan2(length, q[3]) / length if length > 0 else 2.0)
