"""Test writer of Stray Scanner captures as versions of the app, converters and damaged films have them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from dhtorch.data.orientation import apply_symmetry
from dhtorch.export import stray
from dhtorch.export.arrays import K_matrix, encode_depth_codes, frame_time_s, frame_to_hwc
from dhtorch.records import Frame
from support.writers.parts import encode_unfiltered_png
from support.writers.video import hide_first_image, write_display_matrix


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
    """Write a capture as :func:`dhtorch.export.stray.write_stray`, and what differs.

    Args:
        root: folder of the capture.
        frames: its frames.
        codec: of the video.
        video: whether to write it.
        first_picture: ``hidden`` by an edit list, before time 0; or ``lost``.
        per_frame: write K in every row, as newer versions of the app; the distortion centre's columns stay empty.
        depth_format: ``npy`` as in the oldest versions.
        confidence_channels: 3 as written by some converters.
        start: number of the first frame.
        pictures: places of the frames that the video has; None = all.
        film_times: s, the video's own time stamps of these; None = those of the rows.
        film_turn: symmetry applied to the images alone, see :mod:`dhtorch.data.orientation`: a video turned upright.
        display: symmetry that the video's display matrix states.
    """
    kept = list(range(len(frames)) if pictures is None else pictures)[first_picture == "lost" :] if video else []
    times = [frame_time_s(frames[i]) for i in kept] if film_times is None else film_times
    images = [apply_symmetry(torch.from_numpy(frame_to_hwc(frames[i])).movedim(-1, 0), film_turn) for i in kept]
    film = [(np.ascontiguousarray(x.movedim(0, -1).numpy()), t) for x, t in zip(images, times, strict=False)]
    stray.write_stray(root, frames, codec=codec, film=film)
    rows = root / "odometry.csv"
    header, *lines = rows.read_text().splitlines()
    if per_frame:
        header += ", fx, fy, cx, cy, distortion_center_x, distortion_center_y"
    for i, frame in reversed(list(enumerate(frames))):
        K, name = K_matrix(frame.camera), f"{i + start:06d}"
        lines[i] = lines[i].replace(f", {i:06d}, ", f", {name}, ")
        if per_frame:
            lines[i] += f", {K[0, 0]:.17g}, {K[1, 1]:.17g}, {K[0, 2]:.17g}, {K[1, 2]:.17g}, , "
        code = encode_depth_codes(frame.depth, 1000)
        (root / "depth" / f"{i:06d}.png").unlink()
        if depth_format == "npy":
            np.save(root / "depth" / f"{name}.npy", code)
        else:
            (root / "depth" / f"{name}.png").write_bytes(encode_unfiltered_png(code))
        if frame.conf is not None:
            conf = np.stack([frame.conf[0].numpy()] * confidence_channels, -1)
            (root / "confidence" / f"{i:06d}.png").unlink()
            (root / "confidence" / f"{name}.png").write_bytes(encode_unfiltered_png(conf))
    rows.write_text("\n".join([header, *lines]) + "\n")
    if first_picture == "hidden":
        hide_first_image(root / "rgb.mp4", times[1] - times[0])
    if display:
        write_display_matrix(root / "rgb.mp4", display)
