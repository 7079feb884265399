"""Reader of scenes of the BOP benchmark: ``rgb/`` or ``gray/``, ``depth/`` and ``scene_camera.json``.

``scene_camera.json`` maps the image's number to ``cam_K`` (3×3 by rows), ``depth_scale`` (code × depth_scale = mm) and,
in many sets, ``cam_R_w2c`` (3×3 by rows) and ``cam_t_w2c`` (mm), the world in the camera's axes x right, y down,
z forward. Scenes of several sensors have ``scene_camera_SENSOR.json``, ``rgb_SENSOR/`` and ``depth_SENSOR/``: one
recording each.
"""

from __future__ import annotations

from collections.abc import Sequence
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
    sensors = [sensor for sensor in _list_sensors(root) if _find_images(root, sensor) is not None]
    if not sensors:
        return None
    images = _find_images(root, sensors[0])
    return f"{images.name if images else ''}/, depth{sensors[0]}/ and {_TABLE_STEM}{sensors[0]}.json"


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
    sensors = [sensor for sensor in _list_sensors(root) if _find_images(root, sensor) is not None]
    if not sensors:
        raise FormatError(root, "files", "none", "rgb/ or gray/ with scene_camera.json")
    return [_read_sensor(root, sensor, intrinsics, K, fov, fps) for sensor in sensors]


def _list_sensors(root: Path) -> list[str]:
    """Suffixes of ``scene_camera.json``: one empty, or ``_SENSOR`` of each sensor."""
    tables = sorted(root.glob(f"{_TABLE_STEM}*.json")) if root.is_dir() else []
    return [table.stem.removeprefix(_TABLE_STEM) for table in tables]


def _find_images(root: Path, sensor: str) -> Path | None:
    return next((root / f"{kind}{sensor}" for kind in _IMAGE_KINDS if (root / f"{kind}{sensor}").is_dir()), None)


def _read_sensor(
    root: Path,
    sensor: str,
    intrinsics: intrinsics_options.IntrinsicsOption | None,
    K: Sequence[float] | None,
    fov: float | None,
    fps: float | None,
) -> Recording:
    table, folder = root / f"{_TABLE_STEM}{sensor}.json", _find_images(root, sensor) or root
    entries = _read_entries(table)
    images = image_table.list_numbered(folder, r"(\d+)\.(?:png|jpg|jpeg)")
    depths = image_table.list_numbered(root / f"depth{sensor}", r"(\d+)\.png")
    poses = {number: pose for number, entry in entries.items() if (pose := _parse_pose(entry, table)) is not None}
    rows, report = image_table.pair_numbered(images, depths, poses)
    report += files.format_left_out([row.number for row in rows if row.number not in entries], "no camera")
    rows = [row for row in rows if row.number in entries]
    if not rows:
        count = f"{len(images)} images, {len(depths)} depth maps and {len(entries)} entries of {table.name}"
        raise FormatError(root, "frames", count, f"images with the numbers of {folder.name}/, depth{sensor}/ and table")
    hw, depth_hw = files.read_image_header(rows[0].image).hw, image_table.read_depth_hw(rows[0].depth)
    scales = {row.number: _parse_scale(entries[row.number], table) for row in rows}
    stated = {row.number: _parse_K(entries[row.number], table) for row in rows}
    first = rows[0].number
    camera, guess = image_table.choose_camera(
        root, hw, (stated[first], table, "cam_K"), intrinsics, K, fov, where=table.name
    )
    is_optional = any(option is not None for option in (intrinsics, K, fov))
    cameras = dict.fromkeys(stated, camera) if is_optional else _make_cameras(stated, hw, table)
    loader = image_table.ImageTableLoader(
        rows=tuple(
            image_table.ImageRow(
                row.number, row.image, row.depth, row.c2w, cameras[row.number], _MM_PER_M / scales[row.number]
            )
            for row in rows
        ),
        hw=hw,
        depth_hw=depth_hw,
        camera=camera,
        units_per_metre=_MM_PER_M / scales[first],
    )
    unit = DepthUnit(scales[first] / _MM_PER_M, f"{table.name}: depth_scale")
    if len(set(scales.values())) > 1:
        report.append(f"{table.name}: depth_scale differs from frame to frame: each frame is read by its own")
    name = root.resolve().name + (f"/{sensor.removeprefix('_')}" if sensor else "")
    return image_table.open_image_table(
        root,
        "bop",
        loader,
        unit=unit,
        poses_file=table,
        fps=fps,
        report=[*report, *guess],
        name=name,
    )


def _read_entries(table: Path) -> dict[int, dict[str, Any]]:
    entries = {}
    for key, entry in files.read_json(table).items():
        if not key.isdigit() or not isinstance(entry, dict):
            raise FormatError(table, f"entry {key}", entry, "an object, by the number of its image")
        entries[int(key)] = entry
    return entries


def _parse_scale(entry: dict[str, Any], table: Path) -> float:
    return files.to_positive(entry.get("depth_scale"), table, "depth_scale")


def _parse_K(entry: dict[str, Any], table: Path) -> np.ndarray:
    return files.to_array(entry.get("cam_K"), (9,), table, "cam_K").reshape(3, 3)


def _make_cameras(stated: dict[int, np.ndarray], hw: tuple[int, int], table: Path) -> dict[int, Camera]:
    """Cameras by frame; equal matrices share one camera."""
    by_value: dict[bytes, Camera] = {}
    for matrix in stated.values():
        if matrix.tobytes() not in by_value:
            by_value[matrix.tobytes()] = convert.to_camera(matrix, hw, table, "cam_K")
    return {number: by_value[matrix.tobytes()] for number, matrix in stated.items()}


def _parse_pose(entry: dict[str, Any], table: Path) -> np.ndarray | None:
    """Camera-to-world (4, 4) of an entry; None where it has none."""
    if "cam_R_w2c" not in entry and "cam_t_w2c" not in entry:
        return None
    R = files.to_array(entry.get("cam_R_w2c"), (9,), table, "cam_R_w2c").reshape(3, 3)
    c2w = np.eye(4)
    c2w[:3, :3] = R.T
    c2w[:3, 3] = -R.T @ (files.to_array(entry.get("cam_t_w2c"), (3,), table, "cam_t_w2c") / _MM_PER_M)
    return c2w
