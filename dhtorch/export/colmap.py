"""Writer of COLMAP's text model: cameras.txt, images.txt and points3D.txt, and of times.txt, an addition.

In COLMAP the centre of the first pixel is (0.5, 0.5), here (0, 0): half a pixel is added to all written coordinates.
COLMAP's poses map world to camera.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.export.arrays import check_rows, colour_to_uint8, rotation_to_wxyz
from dhtorch.geometry import se3
from dhtorch.records import Camera, Pose
from dhtorch.runtime import storage


@dataclass(frozen=True)
class ColmapImage:
    """An image with its camera and pose (batch size 1)."""

    name: str  # of the image file
    camera: Camera
    hw: tuple[int, int]
    T_world_from_cam: Pose
    time: float | None = None  # s


def write_colmap(
    folder: str | Path,
    shots: Sequence[ColmapImage],
    xyz: Any,  # (P, 3) m in the world
    *,
    rgb: Any,  # (P, 3) uint8, or float in [0, 1]
    error: Any,  # (P,) px, mean reprojection error; -1 = unknown
    seen_by: Any,  # (P, V) indices of shots, -1 = none
    uv: Any,  # (P, V, 2) px in those shots, distorted
) -> None:
    """Write a model in metres: cameras, images with their observations, and points with their tracks.

    COLMAP has no times: those of the images that have one go to ``times.txt`` (IMAGE_ID, s), which COLMAP ignores.

    Equal cameras are written once. Cameras without distortion become PINHOLE, those with up to four coefficients
    OPENCV, others FULL_OPENCV. Non-finite points and observations are left out; a point without observations is written
    with an empty track. All ids in the files count from 1, in the order of the arguments.

    Raises:
        ValueError: wrong shapes, or an observation in a shot that does not exist.
    """
    points = check_rows("write_colmap", "xyz", xyz, None, 3).astype(np.float64)
    P = len(points)
    colours = colour_to_uint8(check_rows("write_colmap", "rgb", rgb, P, 3))
    errors = check_rows("write_colmap", "error", error, P, None)
    seen = np.asarray(check_rows("write_colmap", "seen_by", seen_by, P, np.shape(seen_by)[-1]), np.int64)
    pixels = np.asarray(uv.detach().cpu() if hasattr(uv, "detach") else uv, np.float64)
    if pixels.shape != (*seen.shape, 2):
        raise ValueError(f"write_colmap: uv has shape {pixels.shape}, expected {(*seen.shape, 2)}")
    if seen.size and seen.max() >= len(shots):
        raise ValueError(f"write_colmap: seen_by names shot {seen.max()}, expected at most {len(shots) - 1}")
    observations: list[list[str]] = [[] for _ in shots]
    lines = []
    for number, p in enumerate(np.nonzero(np.isfinite(points).all(1))[0], start=1):
        track = []
        for shot, (u, v) in zip(seen[p], pixels[p], strict=True):
            if shot >= 0 and math.isfinite(u + v):
                track += [str(shot + 1), str(len(observations[shot]))]
                observations[shot].append(f"{_format_number(u + 0.5)} {_format_number(v + 0.5)} {number}")
        point = " ".join(
            [str(number), *map(_format_number, points[p]), *map(str, colours[p]), _format_number(errors[p])]
        )
        lines.append(" ".join([point, *track]))
    cameras = [_camera_parameters(shot) for shot in shots]
    distinct = list(dict.fromkeys(cameras))
    image_lines = []
    for k, shot in enumerate(shots):
        T = se3.invert(shot.T_world_from_cam.map(lambda v: v.double()))  # world → camera
        pose = " ".join(map(_format_number, [*rotation_to_wxyz(T.R[0]), *T.t[0].tolist()]))
        image_lines.append(f"{k + 1} {pose} {distinct.index(cameras[k]) + 1} {shot.name}")
        image_lines.append(" ".join(observations[k]))
    files = {
        "cameras.txt": [
            "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
            *(f"{k + 1} {c}" for k, c in enumerate(distinct)),
        ],
        "images.txt": [
            "# metres",
            "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; POINTS2D[] as X, Y, POINT3D_ID",
        ],
        "points3D.txt": ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)", *lines],
    }
    files["images.txt"] += image_lines
    stamps = [f"{k + 1} {shot.time!r}" for k, shot in enumerate(shots) if shot.time is not None]
    files["times.txt"] = ["# IMAGE_ID, TIME (s)", *stamps]
    for name, text in files.items():
        storage.replace_file(Path(folder) / name, ("\n".join(text) + "\n").encode("utf-8"))


def _camera_parameters(shot: ColmapImage) -> str:
    """COLMAP's line of a camera: model, size and parameters."""
    (fx, fy), (cx, cy) = shot.camera.f[0].tolist(), shot.camera.c[0].tolist()
    distortion = [] if shot.camera.distortion is None else shot.camera.distortion[0].tolist()
    model, length = (
        ("PINHOLE", 0) if not any(distortion) else ("OPENCV", 4) if not any(distortion[4:]) else ("FULL_OPENCV", 8)
    )
    numbers = [fx, fy, cx + 0.5, cy + 0.5, *(distortion + [0.0] * 8)[:length]]
    return " ".join([model, str(shot.hw[1]), str(shot.hw[0]), *map(_format_number, numbers)])


def _format_number(value: float) -> str:
    return f"{float(value):.10g}"
