"""Reader of Open3D's image folders, also of Redwood's scans and of Open3D's recorders.

``color/`` (or ``rgb/``, ``image/``), ``depth/`` (16 bits), an intrinsics file ``*.json`` (``width``, ``height`` and
``intrinsic_matrix`` by columns) and a trajectory: blocks of three integers ``i i k`` and a 4×4, the camera-to-world
matrix of frame i, in ``trajectory.log``, ``scene/trajectory.log`` or ``odometry.log``. Blocks of two different
numbers ``i j k`` hold the motion between two frames, no pose of a frame.

Images and depth maps have the same names, or are paired by ``rgbd.match`` or by the time stamps in their names.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import image_table
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit

_IMAGE_FOLDERS = ("color", "rgb", "image")
_PAIR_TABLES = ("rgbd.match",)
_MATRIX_FIELD = "intrinsic_matrix"

#: Names of trajectories, the preferred one first: optimised poses before those of odometry.
_TRAJECTORY_NAMES = ("trajectory.log", "scene/trajectory.log", "odometry.log", "trajectory.txt")
_TRAJECTORY_PATTERNS = ("*traj*.log", "*traj*.txt", "*.log")

#: Depth codes of one metre where nothing states another: Open3D's default. Source: convention of the layout.
_UNITS_PER_METRE = 1000.0

#: Lines of one block of a trajectory: three integers and four rows. Source: format definition.
_BLOCK_LINES = 5

#: Largest number of bytes of a file that is searched for an intrinsic matrix at recognition; the files hold under 1 kB.
#: Source: chosen.
_MAX_INTRINSICS_BYTES = 100_000


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
    table = next((root / name for name in _PAIR_TABLES if (root / name).is_file()), None)
    pairs = image_table.pair_folders(root, images, depths, table)
    if not pairs.rows:
        raise FormatError(root, "depth maps", f"{len(depths)} for {len(images)} images", "one for each image")
    rows, report, poses_file = _add_poses(root, pairs.rows, len(images), trajectory)
    hw = files.read_image_header(rows[0].image).hw
    file = _find_intrinsics(root)
    document = {} if file is None else files.read_json(file)
    stated, scaled = _parse_camera(document, hw, file)
    camera, guess = image_table.choose_camera(root, hw, stated, intrinsics, K, fov, where="camera_intrinsic.json")
    units, source = _UNITS_PER_METRE, None
    if units_per_metre is not None:
        units, source = files.to_positive(units_per_metre, root, "option units_per_metre"), "option units_per_metre"
    elif file is not None and "depth_scale" in document:
        units, source = files.to_positive(document["depth_scale"], file, "depth_scale"), f"{file.name}: depth_scale"
    loader = image_table.ImageTableLoader(
        rows=rows,
        hw=hw,
        depth_hw=image_table.read_depth_hw(rows[0].depth),
        camera=camera,
        units_per_metre=units,
    )
    return [
        image_table.open_image_table(
            root,
            "open3d",
            loader,
            unit=DepthUnit(1 / units, source),
            poses_file=poses_file,
            fps=fps,
            report=[*pairs.report, *report, *scaled, *guess],
        )
    ]


def _find_image_folder(root: Path) -> Path | None:
    return next((root / name for name in _IMAGE_FOLDERS if image_table.list_images(root / name)), None)


def _find_intrinsics(root: Path) -> Path | None:
    """The first JSON file of the folder with an intrinsic matrix; None where there is none."""
    for file in sorted(root.glob("*.json")):
        if not file.is_file() or file.stat().st_size > _MAX_INTRINSICS_BYTES:
            continue
        try:
            if _MATRIX_FIELD in files.read_json(file):
                return file
        except FormatError:
            continue
    return None


def _parse_camera(
    document: dict[str, Any], hw: tuple[int, int], file: Path | None
) -> tuple[tuple[np.ndarray, Path, str] | None, tuple[str, ...]]:
    if file is None:
        return None, ()
    values = files.to_array(document.get(_MATRIX_FIELD), (9,), file, _MATRIX_FIELD)
    matrix, report = values.reshape(3, 3).T, tuple[str, ...]()
    if not matrix[:2, 2].any() and matrix[2, :2].any():  # by rows, unlike the format: the centre stands in the last row
        matrix, report = matrix.T, (f"{file.name}: {_MATRIX_FIELD} is by rows, the format has columns: read by rows",)
    size = [document.get(name) for name in ("height", "width")]
    if all(isinstance(side, int) and side > 0 for side in size):
        matrix, scaled = image_table.fit_K(matrix, (size[0], size[1]), hw, file)  # type: ignore[arg-type]
        report = (*report, *scaled)
    return (matrix, file, _MATRIX_FIELD), report


# ------------------------------------------------------------------------------------------------------ trajectories


@dataclass(frozen=True)
class _Trajectory:
    """Blocks of a trajectory file: the integers (n, 3) and the matrices (n, 4, 4)."""

    file: Path
    ids: np.ndarray
    matrices: np.ndarray

    @property
    def holds_pairs(self) -> bool:
        """Whether blocks relate two frames, so that the matrices are motions between frames."""
        return bool((self.ids[:, 0] != self.ids[:, 1]).any())


def _list_trajectories(root: Path) -> list[Path]:
    """Files of the folder whose first lines are a block of a trajectory, the preferred one first."""
    named = [root / name for name in _TRAJECTORY_NAMES]
    matched = [file for pattern in _TRAJECTORY_PATTERNS for file in sorted(root.glob(pattern))]
    unique = dict.fromkeys(file for file in (*named, *matched) if file.is_file())
    return [file for file in unique if _starts_with_block(file)]


def _starts_with_block(file: Path) -> bool:
    try:
        rows = [words for _, words in files.read_rows(file)[:_BLOCK_LINES]]
    except FormatError:
        return False
    is_head = bool(rows) and len(rows[0]) == 3 and all(word.lstrip("-").isdigit() for word in rows[0])
    return is_head and [len(row) for row in rows] == [3, 4, 4, 4, 4]


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
    root: Path, rows: tuple[image_table.ImageRow, ...], n_images: int, option: str | None
) -> tuple[tuple[image_table.ImageRow, ...], list[str], Path | None]:
    """Rows with their poses, the report, and the file of the poses (None = no poses)."""
    if option is not None:
        trajectories = [_read_trajectory(root / option)]
    else:
        trajectories = [_read_trajectory(file) for file in _list_trajectories(root)]
    pairs = [t for t in trajectories if t.holds_pairs]
    report = [f"{t.file.name}: motions between two frames, not poses of frames: not used" for t in pairs]
    usable = [t for t in trajectories if not t.holds_pairs]
    if not usable:
        return rows, report, None
    chosen = max(usable, key=lambda t: min(len(t.ids), n_images))  # the first of those with most frames
    poses = _poses_by_place(chosen, n_images)
    report += [_compare(chosen, other, root) for other in usable if other is not chosen]
    return tuple(replace(row, c2w=poses.get(row.number)) for row in rows), report, chosen.file


def _poses_by_place(trajectory: _Trajectory, n_images: int) -> dict[int, np.ndarray]:
    """Poses by the place of the image: in the order of the blocks where there is one for each image, else by number.

    The third integer of a block is the frame's number, counted from 1.
    """
    if len(trajectory.ids) == n_images:
        return dict(enumerate(trajectory.matrices))
    places = trajectory.ids[:, 2] - 1
    if len(np.unique(places)) != len(places) or places.min() < 0 or places.max() >= n_images:
        expected = f"{n_images}, one for each image, or the images' numbers (from 1) in each block"
        raise FormatError(trajectory.file, "poses", len(trajectory.ids), expected)
    return dict(zip(places.tolist(), trajectory.matrices, strict=True))


def _compare(chosen: _Trajectory, other: _Trajectory, root: Path) -> str:
    """Report line on a second trajectory: whether it states the same motion as the one that is read."""
    names = [t.file.relative_to(root).as_posix() for t in (chosen, other)]
    text = f"poses are those of {names[0]}; {names[1]} (data.trajectory={names[1]})"
    if len(chosen.ids) != len(other.ids):
        return f"{text} has {len(other.ids)} poses for {len(chosen.ids)}"
    a, b = (_motion_from_first(t.matrices) for t in (chosen, other))
    difference = float(np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=-1).max())
    return f"{text} differs by at most {difference:.3g} m over the motion from the first frame"


def _motion_from_first(matrices: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.inv(matrices[0]) @ matrices
    except np.linalg.LinAlgError:
        return np.full_like(matrices, np.nan)
