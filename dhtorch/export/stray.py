"""Writer of Stray Scanner captures: a phone's film, depth in mm, confidence and poses."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from dhtorch.export import arrays
from dhtorch.export.frames import encode_png
from dhtorch.export.video import write_video
from dhtorch.geometry import se3
from dhtorch.records import Frame, Pose

#: Upwards in the world of ARKit, which the captures of phones have.
ARKIT_UP = (0.0, 1.0, 0.0)


def turn_world(frame: Frame, up: Sequence[float]) -> Frame:
    """The frame in a world turned so that its −y, upwards in the built-in scenes, becomes ``up``."""
    if frame.T_world_from_cam is None:
        return frame
    turn = Pose(se3.turn_between((0.0, -1.0, 0.0), up)[None], torch.zeros(1, 3, dtype=torch.float64))
    return frame.replace(T_world_from_cam=se3.compose(turn, frame.T_world_from_cam.to(torch.float64)))


def write_stray(
    root: Path,
    frames: Sequence[Frame],
    *,
    codec: str = "libx264",
    film: Sequence[tuple[np.ndarray, float]] | None = None,
) -> None:
    """Write ``rgb.mp4``, ``depth/``, ``confidence/`` (if any), ``odometry.csv`` and ``camera_matrix.csv``.

    Args:
        root: folder of the capture.
        frames: B = 1; depth may have its own resolution; the image's sides must be even. Their world has y down, as the
            built-in scenes; it is written with y up, as the app does.
        codec: of the video; the app writes HEVC, ``libx265``.
        film: images (h, w, 3) uint8 of the video and their times in s; None = those of the frames, empty = no video.
    """
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for folder in ("depth", "confidence"):
        if folder == "depth" or any(frame.conf is not None for frame in frames):
            (root / folder).mkdir(parents=True, exist_ok=True)
    for i, frame in enumerate(frames):
        depth = arrays.encode_depth_codes(frame.depth, 1000)
        (root / "depth" / f"{i:06d}.png").write_bytes(encode_png(depth))
        if frame.conf is not None:
            (root / "confidence" / f"{i:06d}.png").write_bytes(encode_png(frame.conf[0].numpy()))
        c2w = arrays.pose_matrix(turn_world(frame, ARKIT_UP))
        numbers = [*c2w[:3, 3], *arrays.rotation_to_xyzw(c2w[:3, :3])]
        cells = ", ".join(f"{float(number):.17g}" for number in numbers)
        lines.append(f"{arrays.frame_time_s(frame):.9f}, {i:06d}, {cells}")
    (root / "odometry.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    rows = [", ".join(f"{x!r}" for x in row) for row in arrays.K_matrix(frames[-1].camera).tolist()]
    (root / "camera_matrix.csv").write_text("\n".join(rows), encoding="utf-8")
    if film is None:
        film = [(arrays.frame_to_hwc(frame), arrays.frame_time_s(frame)) for frame in frames]
    if film:
        write_video(root / "rgb.mp4", *zip(*film, strict=True), codec=codec)
