"""Reader of scenes of the BOP benchmark: ``rgb/`` or ``gray/``, ``depth/`` and ``scene_camera.json``.

``scene_camera.json`` maps the image's number to ``cam_K`` (3×3 by rows), ``depth_scale`` (code × depth_scale = mm) and,
in many sets, ``cam_R_w2c`` (3×3 by rows) and ``cam_t_w2c`` (mm), the world in the camera's axes x right, y down,
z forward. Scenes of several sensors have ``scene_camera_SENSOR.json``, ``rgb_SENSOR/`` and ``depth_SENSOR/``: one
recording each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data import convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import image_table
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit
from dhtorch.records import Camera

_IMAGE_KINDS = ("rgb", "gray")
_TABLE_STEM = "scene_camera"
_MM_PER_M = 1000

#: Files of the format beside the images that hold neither cameras nor poses of the camera: objects and their masks.
UNUSED_FILES = ("scene_gt*.json", "scene_gt_info*.json", "scene_gt_coco*.json")


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    for sensor, folder in _list_sensors(root).items():
        return f"{folder.name}/, depth{sensor}/ and {_TABLE_STEM}{sensor}.json"
    return None


def read(
    root: str | Path,
    *,
    intrinsics: intrinsics_options.IntrinsicsOption | None = None,
    K: Sequence[float] | None = None,
    fov: float | None = None,
    fps: float | None = None,
) -> list[Recording]:
    """Open one scene.

    Args:
        root: the folder of the scene.
        intrinsics: four numbers as ``K``, or one as ``fov``.
        K: fx, fy, cx, cy of the images, in place of ``cam_K``.
        fov: horizontal field of view of the images in degrees, in place of ``cam_K``.
        fps: frame rate, for time stamps; the format has none.

    Returns:
        One recording for each sensor. Images without depth map or entry are left out and reported.

    Raises:
        FormatError: no image, no depth map, a damaged file, or values that are no camera or pose.
    """
    root = Path(root)
    sensors = _list_sensors(root)
    if not sensors:
        raise FormatError(root, "files", "none", "rgb/ or gray/ with scene_camera.json")
    return [_read_sensor(root, sensor, folder, (intrinsics, K, fov), fps) for sensor, folder in sensors.items()]


def _list_sensors(root: Path) -> dict[str, Path]:
    """Suffix of ``scene_camera.json`` (empty, or ``_SENSOR`` of each sensor) → the folder of its images."""
    tables = sorted(root.glob(f"{_TABLE_STEM}*.json")) if root.is_dir() else []
    sensors = [table.stem.removeprefix(_TABLE_STEM) for table in tables]
    folders = [[root / f"{kind}{sensor}" for kind in _IMAGE_KINDS] for sensor in sensors]
    found = [next((folder for folder in places if folder.is_dir()), None) for places in folders]
    return {sensor: folder for sensor, folder in zip(sensors, found, strict=True) if folder is not None}


def _read_sensor(
    root: Path,
    sensor: str,
    folder: Path,
    options: tuple[intrinsics_options.IntrinsicsOption | None, Sequence[float] | None, float | None],
    fps: float | None,
) -> Recording:
    table = root / f"{_TABLE_STEM}{sensor}.json"
    entries: dict[int, dict[str, Any]] = {}
    for key, entry in files.read_json(table).items():
        if not key.isdigit() or not isinstance(entry, dict):
            raise FormatError(table, f"entry {key}", entry, "an object, by the number of its image")
        entries[int(key)] = entry
    images = image_table.list_numbered(folder, r"(\d+)\.(?:png|jpg|jpeg)")
    depths = image_table.list_numbered(root / f"depth{sensor}", r"(\d+)\.png")
    poses = {number: pose for number, entry in entries.items() if (pose := _parse_pose(entry, table)) is not None}
    if not images.keys() & depths.keys() & entries.keys():
        count = f"{len(images)} images, {len(depths)} depth maps and {len(entries)} entries of {table.name}"
        raise FormatError(root, "frames", count, f"images with the numbers of {folder.name}/, depth{sensor}/ and table")
    rows, report = image_table.pair_numbered(root, images, depths, poses)
    report += files.format_left_out([row.number for row in rows if row.number not in entries], "no camera")
    rows = [row for row in rows if row.number in entries]
    scales = [files.to_positive(entries[row.number].get("depth_scale"), table, "depth_scale") for row in rows]
    stated = [files.to_array(entries[row.number].get("cam_K"), (9,), table, "cam_K").reshape(3, 3) for row in rows]
    cameras: dict[bytes, Camera] = {}  # equal matrices share one camera
    if all(option is None for option in options):
        hw = files.read_image_header(rows[0].image).hw
        cameras = {K.tobytes(): convert.to_camera(K, hw, table, "cam_K") for K in stated}
    if len(set(scales)) > 1:
        report.append(f"{table.name}: depth_scale differs from frame to frame: each frame is read by its own")
    return image_table.open_image_table(
        root,
        "bop",
        [
            replace(row, camera=cameras.get(K.tobytes()), units_per_metre=_MM_PER_M / scale)
            for row, K, scale in zip(rows, stated, scales, strict=True)
        ],
        options,
        stated=(stated[0], table, "cam_K", None),
        where=table.name,
        units_per_metre=_MM_PER_M / scales[0],
        unit=DepthUnit(scales[0] / _MM_PER_M, f"{table.name}: depth_scale"),
        poses_file=table,
        fps=fps,
        report=report,
        name=root.resolve().name + (f"/{sensor.removeprefix('_')}" if sensor else ""),
    )


def _parse_pose(entry: dict[str, Any], table: Path) -> np.ndarray | None:
    """Camera-to-world (4, 4) of an entry; None where it has none."""
    if "cam_R_w2c" not in entry and "cam_t_w2c" not in entry:
        return None
    R = files.to_array(entry.get("cam_R_w2c"), (9,), table, "cam_R_w2c").reshape(3, 3)
    c2w = np.eye(4)
    c2w[:3, :3] = R.T
    c2w[:3, 3] = -R.T @ (files.to_array(entry.get("cam_t_w2c"), (3,), table, "cam_t_w2c") / _MM_PER_M)
    return c2w
