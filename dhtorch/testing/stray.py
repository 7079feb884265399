"""Test writer of Stray Scanner captures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from dhtorch.data.orientation import apply_symmetry
from dhtorch.records import Frame
from dhtorch.testing.mp4 import write_video
from dhtorch.testing.parts import (
    ARKIT_UP,
    K_matrix,
    encode_depth_codes,
    encode_unfiltered_png,
    frame_time_s,
    frame_to_hwc,
    pose_matrix,
    rotation_to_xyzw,
    save_file,
    turn_world,
)

_ODOMETRY_HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw"


def write_stray(
    root: Path,
    frames: Sequence[Frame],
    *,
    codec: str = "libx264",
    video: bool = True,
    first_picture: Literal["shown", "hidden", "lost"] = "shown",
    per_frame: bool = False,
    depth_format: Literal["png", "npy"] = "png",
    confidence_channels: int = 1,
    start: int = 0,
    pictures: Sequence[int] | None = None,
    film_times: Sequence[float] | None = None,
    film_turn: int = 0,
    display: int = 0,
) -> None:
    """Write ``rgb.mp4``, ``depth/``, ``confidence/`` (if any), ``odometry.csv`` and ``camera_matrix.csv``.

    Args:
        root: folder of the capture.
        frames: depth may have its own resolution; the image's sides must be even. Their world has y down, as the
            built-in scenes; it is written with y up, as the app does.
        codec: of the video; the app writes HEVC, ``libx265``.
        video: whether to write it.
        first_picture: ``hidden`` by an edit list, before time 0; or ``lost``.
        per_frame: write K in every row, as newer versions of the app; the distortion centre's columns stay empty.
        depth_format: ``npy`` as in the oldest versions.
        confidence_channels: 3 as written by some converters.
        start: number of the first frame.
        pictures: places of the frames that the video has; None = all.
        film_times: s, the video's own time stamps of these; None = those of the rows.
        film_turn: symmetry applied to the pictures alone, see :mod:`dhtorch.data.orientation`: a video turned upright.
        display: symmetry that the video's display matrix states.
    """
    times = [frame_time_s(frame) for frame in frames]
    lines = [_ODOMETRY_HEADER + (", fx, fy, cx, cy, distortion_center_x, distortion_center_y" if per_frame else "")]
    for i, frame in enumerate(frames, start):
        code = encode_depth_codes(frame.depth, 1000)
        if depth_format == "png":
            save_file(root / "depth" / f"{i:06d}.png", encode_unfiltered_png(code))
        else:
            (root / "depth").mkdir(parents=True, exist_ok=True)
            np.save(root / "depth" / f"{i:06d}.npy", code)
        if frame.conf is not None:
            conf = frame.conf[0].numpy()
            save_file(
                root / "confidence" / f"{i:06d}.png", encode_unfiltered_png(np.stack([conf] * confidence_channels, -1))
            )
        c2w = pose_matrix(turn_world(frame, ARKIT_UP))
        K = K_matrix(frame.camera)
        cells = [*c2w[:3, 3], *rotation_to_xyzw(c2w[:3, :3])]
        cells += [K[0, 0], K[1, 1], K[0, 2], K[1, 2]] if per_frame else []
        text = ", ".join(f"{float(cell):.17g}" for cell in cells)
        lines.append(f"{frame_time_s(frame):.9f}, {i:06d}, {text}" + (", , " if per_frame else ""))
    save_file(root / "odometry.csv", "\n".join(lines) + "\n")
    K = K_matrix(frames[-1].camera)
    save_file(root / "camera_matrix.csv", "\n".join(", ".join(f"{x!r}" for x in row) for row in K.tolist()))
    if video:
        kept = range(len(frames)) if pictures is None else list(pictures)
        kept = kept[1:] if first_picture == "lost" else kept
        stamps = [times[i] for i in kept] if film_times is None else film_times
        images = [_turn(frame_to_hwc(frames[i]), film_turn) for i in kept]
        hide_first = first_picture == "hidden"
        write_video(root / "rgb.mp4", images, stamps, codec=codec, hide_first=hide_first, display=display)


def _turn(picture: np.ndarray, symmetry: int) -> np.ndarray:
    """Picture (H, W, C) under a symmetry."""
    turned = apply_symmetry(torch.from_numpy(picture).movedim(-1, 0), symmetry)
    return np.ascontiguousarray(turned.movedim(0, -1).numpy())
