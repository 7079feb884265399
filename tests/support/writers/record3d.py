"""Test writers of Record3D's three layouts.

The frames' world has y down, as the built-in scenes; it is written with y up, as ARKit has it.
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data.io.decode import import_optional
from dhtorch.export.arrays import (
    K_matrix,
    frame_time_s,
    frame_to_hwc,
    pose_matrix,
    rotation_to_xyzw,
)
from dhtorch.export.stray import ARKIT_UP, turn_world
from dhtorch.geometry import camera as cameras
from dhtorch.records import Frame
from support.writers.parts import encode_jpeg, save_file
from support.writers.video import write_video

_NO_POSE = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]


def write_r3d(
    file: Path,
    frames: Sequence[Frame],
    *,
    fps: float = 60.0,
    declared_hw: tuple[int, int] | None = None,
    depth_size: bool = True,
    per_frame: bool = True,
    compression: int = zipfile.ZIP_STORED,
) -> None:
    """Write an ``.r3d`` archive: ``metadata``, ``rgbd/<i>.jpg``, ``.depth``, and ``.conf`` (if any).

    Args:
        file: the archive.
        frames: depth may have its own resolution. Without poses the metadata is that of the front camera.
        fps: nominal rate.
        declared_hw: image size in the metadata and of K; None = the images'.
        depth_size: write ``dw`` and ``dh``, which old files lack.
        per_frame: write the intrinsics of every frame, which old files lack.
        compression: of the archive's entries.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    meta = _make_metadata(frames, fps, declared_hw)
    if not depth_size:
        del meta["dw"], meta["dh"]
    if not per_frame:
        del meta["perFrameIntrinsicCoeffs"]
    pack = import_optional("lzfse", "liblzfse").compress
    with zipfile.ZipFile(file, "w", compression) as archive:
        archive.writestr("metadata", json.dumps(meta))
        archive.writestr("icon", encode_jpeg(frame_to_hwc(frames[0])[:16, :16], 95))
        for i, frame in enumerate(frames):
            archive.writestr(f"rgbd/{i}.jpg", encode_jpeg(frame_to_hwc(frame), 95))
            archive.writestr(f"rgbd/{i}.depth", pack(frame.depth[0].numpy().astype("<f4").tobytes()))
            if frame.conf is not None:
                archive.writestr(f"rgbd/{i}.conf", pack(frame.conf[0].numpy().astype(np.uint8).tobytes()))


def write_record3d_exr(
    root: Path,
    frames: Sequence[Frame],
    *,
    fps: float = 60.0,
    channel: str = "R",
    dtype: np.typing.DTypeLike = np.float16,
) -> None:
    """Write the EXR + RGB export: ``EXR_RGBD/`` with ``metadata.json``, ``rgb/<i>.jpg`` and ``depth/<i>.exr``."""
    exr = import_optional("OpenEXR")
    folder = root / "EXR_RGBD"
    for i, frame in enumerate(frames):
        save_file(folder / "rgb" / f"{i}.jpg", encode_jpeg(frame_to_hwc(frame), 95))
        header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
        picture = io.BytesIO()
        # The library ignores strides: arrays must be contiguous.
        exr.File(header, {channel: np.ascontiguousarray(frame.depth[0].numpy(), dtype)}).write(picture)
        save_file(folder / "depth" / f"{i}.exr", picture.getvalue())
    meta = _make_metadata(frames, fps, None)
    del meta["perFrameIntrinsicCoeffs"]
    save_file(folder / "metadata.json", json.dumps(meta))


def write_record3d_mp4(
    file: Path,
    frames: Sequence[Frame],  # depth as large as the image, no poses needed
    *,
    fps: float = 30.0,
    depth_range: tuple[float, float] | None = None,
    crf: int = 4,
    stored: str = "yuv420p",
    times: Sequence[float] | None = None,
) -> None:
    """Write the RGBD mp4: hue and colour side by side, intrinsics as JSON behind the video.

    ``depth_range``: m, written to the file; None = 0 to 3 m, not written, as in older files. ``times``: s, stamps of
    the frames; None = at ``fps``.
    """
    near, far = depth_range or (0.0, 3.0)
    pictures = [
        np.concatenate((_hue_to_rgb((f.depth[0].numpy() - near) / (far - near)), frame_to_hwc(f)), 1) for f in frames
    ]
    stamps = [i / fps for i in range(len(frames))] if times is None else times
    write_video(file, pictures, stamps, crf=crf, stored=stored)
    meta: dict[str, Any] = {"intrinsicMatrix": K_matrix(frames[0].camera).T.ravel().tolist()}
    if depth_range is not None:
        meta["rangeOfEncodedDepth"] = list(depth_range)
    text = json.dumps(meta, separators=(",", ":")).encode()
    with file.open("ab") as stream:  # as a separate box, so that the file remains an mp4
        stream.write(struct.pack(">I4s", 8 + len(text) + 1, b"free") + text + b"\0")


def _make_metadata(frames: Sequence[Frame], fps: float, declared_hw: tuple[int, int] | None) -> dict[str, Any]:
    hw = declared_hw or frames[0].hw
    intrinsics = [cameras.resize(f.camera, f.hw, hw) if declared_hw else f.camera for f in frames]
    return {
        "w": hw[1],
        "h": hw[0],
        "dw": frames[0].depth.shape[-1],
        "dh": frames[0].depth.shape[-2],
        "fps": fps,
        "K": K_matrix(intrinsics[0]).T.ravel().tolist(),
        "perFrameIntrinsicCoeffs": [[*camera.f[0].tolist(), *camera.c[0].tolist()] for camera in intrinsics],
        "frameTimestamps": [frame_time_s(f) - frame_time_s(frames[0]) for f in frames],
        "poses": [_arkit_pose(f) for f in frames],
        "initPose": _NO_POSE,
    }


def _arkit_pose(frame: Frame) -> list[float]:
    """Quaternion and position of the camera in ARKit's axes."""
    if frame.T_world_from_cam is None:
        return _NO_POSE
    c2w = pose_matrix(turn_world(frame, ARKIT_UP)) @ np.diag([1.0, -1.0, -1.0, 1.0])
    return [*map(float, rotation_to_xyzw(c2w[:3, :3])), *map(float, c2w[:3, 3])]


def _hue_to_rgb(hue: np.ndarray) -> np.ndarray:
    """Hue (h, w) in [0, 1] → colour (h, w, 3) uint8 of full saturation and value."""
    distance = np.abs((hue[..., None] * 6 - [3.0, 2.0, 4.0] + 3) % 6 - 3)
    value = np.stack((distance[..., 0] - 1, 2 - distance[..., 1], 2 - distance[..., 2]), -1)
    return (value.clip(0, 1) * 255).round().astype(np.uint8)
