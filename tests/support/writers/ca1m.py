"""Test writer of CA-1M archives."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dhtorch.export.arrays import (
    K_matrix,
    encode_depth_codes,
    frame_time_s,
    frame_to_hwc,
    pose_matrix,
)
from dhtorch.export.tiff import encode_float_tiff
from dhtorch.records import Frame
from support.writers.parts import encode_unfiltered_png, save_file


def write_ca1m(
    file: Path,
    frames: Sequence[Frame],
    lasers: Sequence[Frame],  # one per frame, with the true depth
    *,
    without: Sequence[tuple[int, str]] = (),
) -> None:
    """Write one WebDataset archive, ``ca1m-<split>-<video id>.tar``.

    Args:
        file: the archive; its name ends in the video id.
        frames: image, LiDAR depth, confidence (levels 0, 1, 2 become 0, ½, 1) and pose.
        lasers: laser depth, of any size.
        without: (frame, member) to leave out, ``(3, "gt/depth.png")``.
    """
    video = file.stem.rsplit("-", 1)[-1]
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=tarfile.USTAR_FORMAT) as archive:

        def add(name: str, content: bytes) -> None:
            info = tarfile.TarInfo(f"{video}/{name}")
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))

        for i, (frame, laser) in enumerate(zip(frames, lasers, strict=True)):
            stamp = round(frame_time_s(frame) * 1e9)
            for what, content in _make_members(frame, laser).items():
                if (i, what) not in without:
                    add(f"{stamp}.{what}", content)
        add("world.gt/instances.json", b"[]")
    save_file(file, out.getvalue())


def _make_members(frame: Frame, laser: Frame) -> dict[str, bytes]:
    """Member name → content, of one frame."""
    members = {
        "wide/image.png": encode_unfiltered_png(frame_to_hwc(frame)),
        "wide/image/K.json": _matrix_json(K_matrix(frame.camera)),
        "wide/depth.png": encode_unfiltered_png(encode_depth_codes(frame.depth, 1000)),
        "wide/depth/K.json": _matrix_json(K_matrix(frame.map_camera)),
        "wide/instances.json": b"[]",
        "wide/T_gravity.json": _matrix_json(np.eye(3)),
        "gt/RT.json": _matrix_json(pose_matrix(frame)),
        "gt/depth.png": encode_unfiltered_png(encode_depth_codes(laser.depth, 1000)),
        "gt/depth/K.json": _matrix_json(K_matrix(laser.map_camera)),
    }
    if frame.conf is not None:
        members["wide/depth/confidence.tiff"] = encode_float_tiff(frame.conf[0].numpy() / np.float32(2))
    return members


def _matrix_json(matrix: np.ndarray) -> bytes:
    return json.dumps(matrix.tolist()).encode()
