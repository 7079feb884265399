"""Reader of Open3D's image folders, also of Redwood's scans and of Open3D's recorders.

``color/`` (or ``rgb/``, ``image/``), ``depth/`` (16 bits), an intrinsics file ``*.json`` (``width``, ``height`` and
``intrinsic_matrix`` by columns) and a trajectory: blocks of three integers ``i i k`` and a 4×4, the camera-to-world
matrix of frame i, in ``trajectory.log``, ``scene/trajectory.log`` or ``odometry.log``. Blocks of two different
numbers ``i j k`` hold the motion between two frames, no pose of a frame.

Images and depth maps have the same names, or are paired by ``rgbd.match`` or by the time stamps in their names.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import image_table
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit

_IMAGE_FOLDERS = ("color", "rgb", "image")
_MATRIX_FIELD = "intrinsic_matrix"

#: Names of trajectories, the preferred one first: optimised poses before those of odometry.
_TRAJECTORY_NAMES = ("trajectory.log", "scene/trajectory.log", "odometry.log", "trajectory.txt")
_TRAJECTORY_PATTERNS = ("*traj*.log", "*traj*.txt", "*.log")

#: Depth codes of one metre where nothing states another: Open3D's default. Source: convention of the layout.
_UNITS_PER_METRE = 1000.0

#: Lines of one block of a trajectory: three integers and four rows. Source: format definition.
_BLOCK_LINES = 5


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    folder = _find_image_folder(root)
    if folder is None or not image_table.list_images(root / "depth"):
        return None
    intrinsics_file, trajectories = _find_intrinsics(root), _list_trajectories(root)
    if intrinsics_file is None and not trajectories:
        return None
    parts = [f"{folder.name}/", "depth/"]
    parts += [] if intrinsics_file is None else [intrinsics_file.name]
    parts += [file.relative_to(root).as_posix() for file in trajectories[:1]]
    return f"{', '.join(parts[:-1])} and {parts[-1]}"


def read(
    root: str | Path,
    *,
    intrinsics: intrinsics_options.IntrinsicsOption | None = None,
    K: Sequence[float] | None = None,
    fov: float | None = None,
    units_per_metre: float | None = None,
    trajectory: str | None = None,
    fps: float | None = None,
) -> list[Recording]:
    """Open one folder.

    Args:
        root: the folder.
        intrinsics: four numbers as ``K``, or one as ``fov``.
        K: fx, fy, cx, cy of the images. None = ``intrinsic_matrix`` of the intrinsics file.
        fov: horizontal field of view of the images in degrees, for a guessed K.
        units_per_metre: of the depth codes. None = ``depth_scale`` of the intrinsics file, else 1000 is assumed.
        trajectory: name of the file with the poses. None = ``trajectory.log``, ``scene/trajectory.log``,
            ``odometry.log``, the first of these with a pose of each frame.
        fps: frame rate, for time stamps; the layout has none.

    Returns:
        One recording. Images without depth map or pose are left out and reported.

    Raises:
        FormatError: no frame, no intrinsics, files that cannot be paired, a damaged file, or values that are no camera
            or pose.
    """
    root = Path(root)
    folder = _find_image_folder(root)
    if folder is None:
        raise FormatError(root, "frames", "no image", "images in color/, rgb/ or image/")
    images, depths = image_table.list_images(folder), image_table.list_images(root / "depth")
    table = root / "rgbd.match"
    rows, left_out = image_table.pair_folders(root, images, depths, table if table.is_file() else None)
    rows, report, poses_file = _add_poses(root, rows, len(images), trajectory)
    file = _find_intrinsics(root)
    document = {} if file is None else files.read_json(file)
    stated = None
    if file is not None:
        matrix = files.to_array(document.get(_MATRIX_FIELD), (9,), file, _MATRIX_FIELD).reshape(3, 3).T
        if not matrix[:2, 2].any() and matrix[2, :2].any():  # unlike the format: the centre stands in the last row
            matrix = matrix.T
            report = [*report, f"{file.name}: {_MATRIX_FIELD} is by rows, the format has columns: read by rows"]
        h, w = (document.get(name) for name in ("height", "width"))
        hw = (h, w) if isinstance(h, int) and isinstance(w, int) and min(h, w) > 0 else None
        stated = (matrix, file, _MATRIX_FIELD, hw)
    units, source = _UNITS_PER_METRE, None
    if units_per_metre is not None:
        units, source = files.to_positive(units_per_metre, root, "option units_per_metre"), "option units_per_metre"
    elif file is not None and "depth_scale" in document:
        units, source = files.to_positive(document["depth_scale"], file, "depth_scale"), f"{file.name}: depth_scale"
    return [
        image_table.open_image_table(
            root,
            "open3d",
            rows,
            (intrinsics, K, fov),
            stated=stated,
            where="camera_intrinsic.json",
            units_per_metre=units,
            unit=DepthUnit(1 / units, source),
            poses_file=poses_file,
            fps=fps,
            report=[*left_out, *report],
        )
    ]


def _find_image_folder(root: Path) -> Path | None:
    return next((root / name for name in _IMAGE_FOLDERS if image_table.list_images(root / name)), None)


def _find_intrinsics(root: Path) -> Path | None:
    """The first JSON file of the folder with an intrinsic matrix; None where there is none."""
    for file in sorted(root.glob("*.json")):
        with contextlib.suppress(FormatError):
            # Files with an intrinsic matrix hold under 1 kB; large ones are not searched at recognition.
            if file.is_file() and file.stat().st_size <= 100_000 and _MATRIX_FIELD in files.read_json(file):
                return file
    return None


# ------------------------------------------------------------------------------------------------------ trajectories


class _Trajectory(NamedTuple):
    """Blocks of a trajectory file: the integers (n, 3) and the matrices (n, 4, 4)."""

    file: Path
    ids: np.ndarray
    matrices: np.ndarray


def _list_trajectories(root: Path) -> list[Path]:
    """Files of the folder whose first lines are a block of a trajectory, the preferred one first."""
    named = [root / name for name in _TRAJECTORY_NAMES]
    matched = [file for pattern in _TRAJECTORY_PATTERNS for file in sorted(root.glob(pattern))]
    starting = []
    for file in dict.fromkeys(file for file in (*named, *matched) if file.is_file()):
        with contextlib.suppress(FormatError):
            rows = [words for _, words in files.read_rows(file)[:_BLOCK_LINES]]
            is_block = [len(row) for row in rows] == [3, 4, 4, 4, 4]
            if is_block and all(word.lstrip("-").isdigit() for word in rows[0]):
                starting.append(file)
    return starting


def _read_trajectory(file: Path) -> _Trajectory:
    rows = files.read_rows(file)
    if len(rows) % _BLOCK_LINES:
        raise FormatError(file, "lines", len(rows), f"blocks of {_BLOCK_LINES}: three integers and a 4x4 matrix")
    ids, matrices = [], []
    for k in range(0, len(rows), _BLOCK_LINES):
        line, head = rows[k]
        block = [words for _, words in rows[k + 1 : k + _BLOCK_LINES]]
        try:
            ids.append([int(word) for word in head])
            matrices.append([[float(word) for word in words] for words in block])
        except ValueError:
            raise FormatError(file, f"line {line}", " ".join(head), "three integers and a 4x4 matrix") from None
        if len(head) != 3 or any(len(words) != 4 for words in block):
            raise FormatError(file, f"line {line}", " ".join(head), "three integers and a 4x4 matrix")
    return _Trajectory(file, np.array(ids), np.array(matrices))


def _add_poses(
    root: Path, rows: list[image_table.ImageRow], n_images: int, option: str | None
) -> tuple[list[image_table.ImageRow], list[str], Path | None]:
    """Rows with their poses, the report, and the file of the poses (None = no poses).

    Poses belong to the images in the order of the blocks where there is one for each image, else by the third integer
    of a block, the frame's number counted from 1.
    """
    chosen_files = _list_trajectories(root) if option is None else [root / option]
    trajectories = [_read_trajectory(file) for file in chosen_files]
    usable = [t for t in trajectories if not (t.ids[:, 0] != t.ids[:, 1]).any()]
    report = [
        f"{t.file.name}: motions between two frames, not poses of frames: not used"
        for t in trajectories
        if (t.ids[:, 0] != t.ids[:, 1]).any()
    ]
    if not usable:
        return rows, report, None
    chosen = max(usable, key=lambda t: min(len(t.ids), n_images))  # the first of those with most frames
    places = np.arange(n_images) if len(chosen.ids) == n_images else chosen.ids[:, 2] - 1
    if len(np.unique(places)) != len(places) or places.min() < 0 or places.max() >= n_images:
        expected = f"{n_images}, one for each image, or the images' numbers (from 1) in each block"
        raise FormatError(chosen.file, "poses", len(chosen.ids), expected)
    poses = dict(zip(places.tolist(), chosen.matrices, strict=True))
    report += [_compare(chosen, other, root) for other in usable if other is not chosen]
    return [replace(row, c2w=poses.get(row.number)) for row in rows], report, chosen.file


def _compare(chosen: _Trajectory, other: _Trajectory, root: Path) -> str:
    """Report line on a second trajectory: whether it states the same motion as the one that is read."""
    names = [t.file.relative_to(root).as_posix() for t in (chosen, other)]
    text = f"poses are those of {names[0]}; {names[1]} (data.trajectory={names[1]})"
    if len(chosen.ids) != len(other.ids):
        return f"{text} has {len(other.ids)} poses for {len(chosen.ids)}"
    try:
        a, b = (np.linalg.inv(t.matrices[0]) @ t.matrices for t in (chosen, other))
        difference = float(np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=-1).max())
    except np.linalg.LinAlgError:
        difference = math.nan
    return f"{text} differs by at most {difference:.3g} m over the motion from the first frame"
