"""Test writers of exports with a camera for every image: nerfstudio's ``transforms.json``, Polycam, COLMAP."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.export.arrays import (
    K_matrix,
    encode_depth_codes,
    frame_time_s,
    frame_to_hwc,
    pose_matrix,
    rotation_to_xyzw,
)
from dhtorch.records import Frame
from support.writers.parts import encode_unfiltered_png, format_row, save_file, save_rgbd

#: Change of camera axes from OpenCV (y down, z forward) to OpenGL (y up, z backward).
_FLIP_Y_AND_Z = np.diag([1.0, -1.0, -1.0, 1.0])

#: Names of the distortion coefficients in nerfstudio, in OpenCV's order.
_LENS_NAMES = ("k1", "k2", "p1", "p2", "k3")

#: Code of Polycam's confidence by level: low, medium, high. Source: its description.
_POLYCAM_CONFIDENCE = np.array([0, 127, 255], np.uint8)

#: Time stamps in Polycam's file names for one second. Source: its description (microseconds).
_POLYCAM_STAMPS_PER_S = 1e6


def write_nerfstudio(
    root: Path,
    frames: Sequence[Frame],
    *,
    unit_key: str | None = "depth_unit_scale_factor",
    unit_m: float = 1e-3,
    depth_key: str = "depth_file_path",
    suffix: str = ".png",
    times: bool = True,
    shared_K: bool = False,
    applied: np.ndarray | None = None,
    scale: float = 1.0,
) -> None:
    """Write ``transforms.json``, ``images/`` and ``depth/``.

    Args:
        root: an empty folder.
        frames: of one camera, B = 1.
        unit_key: field that states metres of one depth code, ``integer_depth_scale`` for NeRFCapture; None = none.
        unit_m: metres of one depth code.
        depth_key: field of the depth file, ``depth_path`` for NeRFCapture.
        suffix: of ``file_path``; NeRFCapture omits it.
        times: write ``timestamp``, as NeRFCapture does.
        shared_K: write the first frame's intrinsics once, for all frames.
        applied: 4×4 rigid motion of the world that a converter applied (``applied_transform``).
        scale: of the world that a converter applied then (``applied_scale``).
    """
    about: dict[str, Any] = {"camera_model": "OPENCV", "frames": []}
    about |= {} if unit_key is None else {unit_key: unit_m}
    about |= {} if applied is None else {"applied_transform": applied[:3].tolist()}
    about |= {} if scale == 1 else {"applied_scale": scale}
    about |= _nerfstudio_camera(frames[0]) if shared_K else {}
    for i, frame in enumerate(frames):
        name = f"frame_{i + 1:05d}"
        c2w = (np.eye(4) if applied is None else applied) @ pose_matrix(frame) @ _FLIP_Y_AND_Z
        c2w[:3, 3] *= scale
        entry = {"file_path": f"./images/{name}{suffix}", depth_key: f"./depth/{name}.png"}
        entry |= {"transform_matrix": c2w.tolist()} | ({} if shared_K else _nerfstudio_camera(frame))
        about["frames"].append(entry | ({"timestamp": frame_time_s(frame)} if times else {}))
        save_rgbd(root, frame, f"images/{name}.png", f"depth/{name}.png", 1 / unit_m)
    save_file(root / "transforms.json", json.dumps(about))


def _nerfstudio_camera(frame: Frame) -> dict[str, float]:
    """Intrinsics with the centre of the first pixel at (0.5, 0.5)."""
    K, distortion = K_matrix(frame.camera), frame.camera.distortion
    lens = [] if distortion is None else distortion[0].tolist()
    values = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
    values |= {"w": frame.hw[1], "h": frame.hw[0], **dict(zip(_LENS_NAMES, lens, strict=False))}
    return {name: float(value) for name, value in values.items()}


def write_polycam(root: Path, frames: Sequence[Frame], *, corrected: bool = True) -> None:
    """Write a raw export below ``keyframes/``: images, cameras, depth in mm, confidence.

    ``corrected``: write images and cameras also as ``corrected_images/`` and ``corrected_cameras/``; the originals then
    have poses that are off by 1 m.
    """
    folder = root / "keyframes"
    for frame in frames:
        stem = str(round(frame_time_s(frame) * _POLYCAM_STAMPS_PER_S))
        K = K_matrix(frame.camera)
        c2w = pose_matrix(frame) @ _FLIP_Y_AND_Z
        picture = encode_unfiltered_png(frame_to_hwc(frame))
        camera = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "blur_score": 100.0}
        camera |= {"width": frame.hw[1], "height": frame.hw[0]}
        for prefix in ("", "corrected_") if corrected else ("",):
            offset = 1.0 if corrected and not prefix else 0.0
            pose = {f"t_{i}{j}": float(c2w[i, j]) + offset * (j == 3) for i in range(3) for j in range(4)}
            save_file(folder / f"{prefix}images" / f"{stem}.png", picture)
            save_file(folder / f"{prefix}cameras" / f"{stem}.json", json.dumps({**camera, **pose}))
        depth = encode_depth_codes(frame.depth, 1000)
        levels = np.where(depth > 0, 2, 0) if frame.conf is None else frame.conf[0].numpy()
        save_file(folder / "depth" / f"{stem}.png", encode_unfiltered_png(depth))
        save_file(folder / "confidence" / f"{stem}.png", encode_unfiltered_png(_POLYCAM_CONFIDENCE[levels]))
    save_file(root / "mesh_info.json", json.dumps({"alignmentTransform": np.eye(4).ravel().tolist()}))


def write_colmap_capture(
    root: Path, frames: Sequence[Frame], *, folder: str = "sparse/0", model: str = "OPENCV", is_metric: bool = True
) -> None:
    """Write a COLMAP text model below ``folder``, ``images/`` and ``depth/`` in mm.

    ``is_metric``: state metres and write ``times.txt``, as dhtorch does; COLMAP itself has neither. ``model``: PINHOLE,
    SIMPLE_RADIAL (of the first coefficient) or OPENCV.
    """
    cameras, images, times = [], [], []
    for i, frame in enumerate(frames, start=1):
        K, distortion, name = K_matrix(frame.camera), frame.camera.distortion, f"{i:04d}.png"
        lens = np.zeros(4) if distortion is None else distortion[0, :4].double().numpy()
        f, c = [K[0, 0], K[1, 1]], [K[0, 2] + 0.5, K[1, 2] + 0.5]
        values = {"PINHOLE": [*f, *c], "SIMPLE_RADIAL": [f[0], *c, lens[0]], "OPENCV": [*f, *c, *lens]}[model]
        cameras.append(f"{i} {model} {frame.hw[1]} {frame.hw[0]} {format_row(values)}")
        w2c = np.linalg.inv(pose_matrix(frame))
        x, y, z, w = rotation_to_xyzw(w2c[:3, :3])
        images += [f"{i} {format_row([w, x, y, z, *w2c[:3, 3]])} {i} {name}", "12.5 7.25 -1" if i % 2 else ""]
        times.append(f"{i} {format_row([frame_time_s(frame)])}")
        save_rgbd(root, frame, f"images/{name}", f"depth/{name}", 1000)
    head = ["# Image list with two lines of data per image", *(["# metres"] if is_metric else [])]
    texts = {"cameras": ["# Camera list", *cameras], "images": [*head, *images], "points3D": ["# 3D point list"]}
    for kind, lines in (texts | ({"times": times} if is_metric else {})).items():
        save_file(root / folder / f"{kind}.txt", "\n".join(lines) + "\n")
