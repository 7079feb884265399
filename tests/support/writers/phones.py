"""Test writers of captures by phones: Stray Scanner, ARKitScenes, CA-1M and Record3D.

The frames' world has y down, as the built-in scenes; Record3D's is written with y up, as ARKit has it.
"""

import io
import json
import struct
import tarfile
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from dhtorch.data.io.decode import import_optional
from dhtorch.data.orientation import apply_symmetry
from dhtorch.export import stray
from dhtorch.export.arrays import (
    K_matrix,
    encode_depth_codes,
    frame_time_s,
    frame_to_hwc,
    pose_matrix,
    rotation_to_xyzw,
)
from dhtorch.export.stray import ARKIT_UP, turn_world
from dhtorch.export.tiff import encode_float_tiff
from dhtorch.geometry import camera as cameras
from dhtorch.records import Camera, Frame
from support.writers.parts import (
    encode_jpeg,
    encode_unfiltered_png,
    format_row,
    hide_first_image,
    save_file,
    write_display_matrix,
    write_video,
)

# ------------------------------------------------------------------------------------------------------------- stray


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


# ------------------------------------------------------------------------------------------------------- arkitscenes


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


# -------------------------------------------------------------------------------------------------------------- ca1m


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


# ---------------------------------------------------------------------------------------------------------- record3d

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
