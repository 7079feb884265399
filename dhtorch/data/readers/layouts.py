"""Layouts of image folders, one row of a table each: how a layout is recognised by content, and where its parts are.

A row (:class:`Layout`) names the function that finds the layout and the one that lists its parts (images, depth maps,
K, poses, unit of depth); :mod:`dhtorch.data.readers.image_folders` does the rest. Poses are camera-to-world with our
axes unless said otherwise. Every layout has the options ``intrinsics`` (as ``K`` or ``fov``), ``K`` (fx, fy, cx, cy
of the images, in place of the stated one), ``fov`` (horizontal field of view of the images in degrees, for a guessed
K) and ``fps`` (frame rate, for time stamps: none of them has any), beside own ones. Frames without image, depth map
or pose, or with a lost pose, are left out and reported.

- *bop*: the BOP benchmark: ``rgb/`` or ``gray/``, ``depth/`` and ``scene_camera.json``, which maps the image's number
  to ``cam_K`` (3×3 by rows), ``depth_scale`` (code × depth_scale = mm) and, in many sets, ``cam_R_w2c`` (3×3 by rows)
  and ``cam_t_w2c`` (mm), the world in the camera's axes x right, y down, z forward. Scenes of several sensors have
  ``scene_camera_SENSOR.json``, ``rgb_SENSOR/`` and ``depth_SENSOR/``: one recording each.
- *replica*: Rendered Replica scenes: NICE-SLAM has ``results/frameXXXXXX.jpg``, ``results/depthXXXXXX.png``,
  ``traj.txt`` (one 4×4 by rows in each line) and ``cam_params.json`` in the scene's folder or the one above: ``w``,
  ``h``, ``fx``, ``fy``, ``cx``, ``cy``, ``scale`` (depth codes of one metre; 6553.5 is assumed without it), alone or
  below ``camera``. iMAP has ``rgb/rgb_X.png``, ``depth/depth_X.png`` and ``traj_w_c.txt``, without intrinsics (its
  renders have a fov of 90 degrees), in millimetres.
- *scannet*: Exported ScanNet scans: folders ``color/<i>.jpg``, ``depth/<i>.png``, ``pose/<i>.txt`` (4×4; −inf where
  tracking was lost), ``intrinsic/intrinsic_color.txt`` and ``intrinsic_depth.txt`` (4×4), or the latter in the scan's
  folder as ``intrinsics_color.txt``; flat: ``<i>.jpg``, ``<i>.png``, ``<i>.txt`` and ``intrinsic.txt`` (of colour) in
  one folder. Depth is in mm, and already aligned to colour by the data set: both cameras have one centre, each has
  its K, and ``extrinsic_*.txt`` is not applied.
- *sens_folder*: SensReader's layout (3RScan, ScanNet and BundleFusion scans): ``_info.txt`` (or ``info.txt``) holds
  lines ``name = value``: sizes of colour and depth, ``m_depthShift`` (depth codes of one metre) and both intrinsics
  as 4×4 by rows. ``frame-XXXXXX.color.jpg``, ``.depth.pgm`` (or ``.png``) and ``.pose.txt`` (4×4; −inf where tracking
  was lost) lie beside it or in ``sequence/``.
- *apc*: Shelf scenes of the Amazon Picking Challenge (MIT-Princeton, the format of apc-vision-toolbox):
  ``frame-XXXXXX.color.png``, ``frame-XXXXXX.depth.png`` (16-bit codes of 1/10000 m, rotated by 3 bits to the left,
  already registered to colour) and ``cam.info.txt``: titles ``# …`` above matrices by rows, among them the K of
  colour and one camera-to-world 4×4 of the arm for each frame.
- *open3d*: Open3D's image folders, also of Redwood's scans and of Open3D's recorders: ``color/`` (or ``rgb/``,
  ``image/``), ``depth/`` (16 bits), an intrinsics file ``*.json`` (``width``, ``height`` and ``intrinsic_matrix`` by
  columns) and a trajectory: blocks of three integers ``i i k`` and a 4×4, the camera-to-world matrix of frame i, in
  ``trajectory.log``, ``scene/trajectory.log`` or ``odometry.log``. Blocks of two different numbers ``i j k`` hold the
  motion between two frames, no pose of a frame. Images and depth maps have the same names, or are paired by
  ``rgbd.match`` or by the time stamps in their names.
- *sun3d*: SUN3D sequences and SUN RGB-D images: ``image/``, ``depth/`` (16-bit codes in mm, rotated by 3 bits to the
  left), ``intrinsics.txt`` (3×3) and ``extrinsics/<date>.txt`` (3×4 camera-to-world matrices of all images, one below
  the other; the latest date is the current one). Names are ``<number>-<time stamp in µs>``; each image has the depth
  map nearest in time. A SUN RGB-D folder holds one image, and its extrinsics hold a tilt, which is no pose.

Own options: ``rotated`` (apc, sun3d: whether the depth codes are rotated by 3 bits; None = as those of the first depth
map are), ``units_per_metre`` (open3d: of the depth codes; None = ``depth_scale`` of the intrinsics file, else 1000 is
assumed) and ``trajectory`` (open3d: file with the poses; None = the first by name that has a pose of each frame).
"""

import contextlib
import inspect
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data import convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io import decode as files
from dhtorch.data.readers.image_folders import (
    NAMED_COLOUR_PATTERN,
    FolderParts,
    FrameFiles,
    StatedK,
    choose_rotated_bits,
    choose_units,
    first_file,
    first_image_folder,
    list_images,
    list_numbered,
    open_numbered,
    pair_folders,
    pair_numbered,
    read_depth_type,
    read_K,
    read_pose,
)
from dhtorch.data.recording import Recording


@dataclass(frozen=True)
class Layout:
    """One layout: a reader of one or more recordings."""

    format: str
    find: Callable[[Path], tuple[str, Any] | None]  # → evidence as text (empty = none), and the parts; None = no parts
    list_parts: Callable[..., list[FolderParts]]  # (folder, what was found, own options) → parts of each recording
    expected: str = ""  # parts that are missing where none are found
    UNUSED_FILES: tuple[str, ...] = ()  # hold neither cameras nor poses of the camera, nor units

    def recognise(self, root: Path) -> str | None:
        """The files by which ``root`` is recognised as this format, as text; None if it is not."""
        found = self.find(root)
        return None if found is None else found[0] or None

    @property
    def read(self) -> Callable[..., list[Recording]]:
        """The function that opens a folder; its options are the common ones and those of the layout."""

        def read(
            root: str | Path,
            *,
            intrinsics: intrinsics_options.IntrinsicsOption | None = None,
            K: Sequence[float] | None = None,
            fov: float | None = None,
            fps: float | None = None,
            **own: Any,
        ) -> list[Recording]:
            root = Path(root)
            found = self.find(root)
            if found is None:
                raise files.FormatError(root, "files", "none", self.expected)
            parts = self.list_parts(root, found[1], **own)
            return [open_numbered(root, self.format, each, (intrinsics, K, fov), fps) for each in parts]

        *common, _ = inspect.signature(read).parameters.values()
        own_options = inspect.signature(self.list_parts).parameters.values()
        own = [each for each in own_options if each.kind is inspect.Parameter.KEYWORD_ONLY]
        read.__signature__ = inspect.Signature([*common, *own])  # type: ignore[attr-defined]
        return read


# ----------------------------------------------------------------------------------------------------------------- bop


def _find_bop(root: Path) -> tuple[str, Any] | None:
    """Suffix of ``scene_camera.json`` (empty, or ``_SENSOR`` of each sensor) → the folder of its images."""
    tables = sorted(root.glob("scene_camera*.json")) if root.is_dir() else []
    suffixes = [table.stem.removeprefix("scene_camera") for table in tables]
    folders = {(sensor, root / f"{kind}{sensor}") for sensor in suffixes for kind in ("gray", "rgb")}
    sensors = {sensor: folder for sensor, folder in sorted(folders) if folder.is_dir()}  # rgb before gray
    evidence = [f"{folder.name}/, depth{sensor}/ and scene_camera{sensor}.json" for sensor, folder in sensors.items()]
    return (evidence[0], sensors) if sensors else None


def _list_sensor(root: Path, sensor: str, folder: Path) -> FolderParts:
    table = root / f"scene_camera{sensor}.json"
    entries: dict[int, dict[str, Any]] = {}
    for key, entry in files.read_json(table).items():
        is_entry = key.isdigit() and isinstance(entry, dict)
        files.refuse_if(not is_entry, table, f"entry {key}", entry, "an object, by the number of its image")
        entries[int(key)] = entry
    images = list_numbered(folder, r"(\d+)\.(?:png|jpg|jpeg)")
    depths = list_numbered(root / f"depth{sensor}", r"(\d+)\.png")
    poses = {}
    for number, entry in entries.items():
        if "cam_R_w2c" in entry or "cam_t_w2c" in entry:
            R = files.to_array(entry.get("cam_R_w2c"), (9,), table, "cam_R_w2c").reshape(3, 3)
            poses[number] = np.eye(4)
            poses[number][:3, :3] = R.T
            poses[number][:3, 3] = -R.T @ (files.to_array(entry.get("cam_t_w2c"), (3,), table, "cam_t_w2c") / 1000)
    count = f"{len(images)} images, {len(depths)} depth maps and {len(entries)} entries of {table.name}"
    expected = f"images with the numbers of {folder.name}/, depth{sensor}/ and table"
    files.refuse_if(not images.keys() & depths.keys() & entries.keys(), root, "frames", count, expected)
    rows, report = pair_numbered(root, images, depths, poses)
    report += files.format_left_out([row.number for row in rows if row.number not in entries], "no camera")
    rows = [row for row in rows if row.number in entries]
    scales = [files.to_positive(entries[row.number].get("depth_scale"), table, "depth_scale") for row in rows]
    K = [files.to_array(entries[row.number].get("cam_K"), (9,), table, "cam_K").reshape(3, 3) for row in rows]
    if len(set(scales)) > 1:
        report.append(f"{table.name}: depth_scale differs from frame to frame: each frame is read by its own")
    return FolderParts(
        [replace(row, K=k, units_per_metre=1000 / scale) for row, k, scale in zip(rows, K, scales, strict=True)],
        K=(K[0], table, "cam_K", None),
        K_file=table.name,
        units_per_metre=1000 / scales[0],
        unit_source=f"{table.name}: depth_scale",
        poses_file=table,
        report=report,
        name=root.resolve().name + (f"/{sensor.removeprefix('_')}" if sensor else ""),
    )


# ------------------------------------------------------------------------------------------------------------- replica

#: Folder and pattern of the images, of the depth maps, trajectory, and usual depth codes of one metre.
_REPLICA = (
    ("results", r"frame(\d+)\.(?:jpg|jpeg|png)", "results", r"depth(\d+)\.png", "traj.txt", 6553.5),
    ("rgb", r"rgb_(\d+)\.(?:jpg|jpeg|png)", "depth", r"depth_(\d+)\.png", "traj_w_c.txt", 1000.0),
)


def _find_replica(root: Path) -> tuple[str, Any] | None:
    for folder, image, depth_folder, depth, trajectory, units in _REPLICA:
        images, depths = list_numbered(root / folder, image), list_numbered(root / depth_folder, depth)
        has_poses = (root / trajectory).is_file()
        if images and depths and (has_poses or folder == depth_folder):
            parts = [part for part in (f"{folder}/", trajectory) if (root / part).exists()]
            return " and ".join(parts), (images, depths, root / trajectory, units)
    return None


def _list_replica(root: Path, place: tuple[dict[int, Path], dict[int, Path], Path, float]) -> list[FolderParts]:
    images, depths, trajectory, units = place
    numbers, poses, report = sorted(images), {}, []
    if trajectory.is_file():
        lines = files.read_table(trajectory, 16).reshape(-1, 4, 4)
        poses = dict(zip(numbers, lines, strict=False))  # line k is the pose of the k-th image, or of frame number k
        if len(lines) != len(numbers):
            expected = f"{len(numbers)}, one for each image (the last is {numbers[-1]})"
            files.refuse_if(numbers[-1] >= len(lines), trajectory, "lines", len(lines), expected)
            poses = {number: lines[number] for number in numbers}
            note = f"{len(lines)} poses for {len(numbers)} images: matched by the images' numbers"
            report = [f"{trajectory.name}: {note}"]
    rows, left_out = pair_numbered(root, images, depths, poses)
    source, stated = None, None
    file = first_file(root / "cam_params.json", root.parent / "cam_params.json")
    if file is not None:
        document = files.read_json(file)
        camera = document.get("camera", document)
        files.refuse_if(
            not isinstance(camera, dict), file, "camera", camera, "an object with w, h, fx, fy, cx, cy and scale"
        )
        if "fx" in camera:
            values = files.to_array(
                [camera.get(name) for name in ("fx", "fy", "cx", "cy")], (4,), file, "fx, fy, cx, cy"
            )
            hw = None
            if "w" in camera and "h" in camera:
                w, h = files.to_array([camera["w"], camera["h"]], (2,), file, "w, h").astype(int).tolist()
                hw = (h, w)
            stated = (convert.make_K(*values), file, "fx, fy, cx, cy", hw)
        if "scale" in camera:
            units, source = files.to_positive(camera["scale"], file, "scale"), f"{file.name}: scale"
    return [FolderParts(rows, stated, "cam_params.json", units, source, trajectory, [*report, *left_out])]


# ------------------------------------------------------------------------------------------------------------- scannet

_SCANNET_K = ("intrinsic_color.txt", "intrinsics_color.txt", "intrinsic.txt")
_SCANNET_DEPTH_K = ("intrinsic_depth.txt", "intrinsics_depth.txt", "depth_intrinsic.txt")


def _find_scannet_file(root: Path, *names: str) -> Path | None:
    return first_file(*(root / folder / name for folder in ("intrinsic", "intrinsics", ".") for name in names))


def _find_scannet(root: Path) -> tuple[str, Any] | None:
    file = _find_scannet_file(root, *_SCANNET_K)
    for colour, depth, pose, suffixes in (("color", "depth", "pose", "jpg|jpeg|png"), (".", ".", ".", "jpg")):
        images = list_numbered(root / colour, rf"(\d+)\.(?:{suffixes})")
        poses = list_numbered(root / pose, r"(\d+)\.txt") if images else {}
        if poses and (colour != "." or _find_scannet_file(root, _SCANNET_K[-1])):
            folders = "<i>.jpg, .png and .txt" if colour == "." else f"{colour}/, {depth}/, {pose}/"
            return f"{folders} and {file.name}" if file else folders, (images, root / depth, poses, root / pose)
    return None


def _list_scannet(root: Path, place: tuple[dict[int, Path], Path, dict[int, Path], Path]) -> list[FolderParts]:
    images, depth, pose_files, pose_folder = place
    poses = {number: read_pose(file) for number, file in pose_files.items()}
    rows, report = pair_numbered(root, images, list_numbered(depth, r"(\d+)\.png"), poses)
    hw, (depth_hw, _) = files.read_image_header(rows[0].image).hw, read_depth_type(rows[0].depth)
    file, depth_file = _find_scannet_file(root, *_SCANNET_K), _find_scannet_file(root, *_SCANNET_DEPTH_K)
    depth_K = None if depth_file is None else (read_K(depth_file), depth_file, "K", None)
    stated: StatedK | None = depth_K if hw == depth_hw else None
    if file is not None:
        K = read_K(file)
        # Many exports have smaller images beside the K of the original size, 1296×968. Source: format definition.
        is_fitting = abs(K[0, 2] - (hw[1] - 1) / 2) <= intrinsics_options.MAX_CENTRE_OFFSET * hw[1]
        stated = (K, file, "K", None if is_fitting else (968, 1296))
    for name in ("extrinsic_color.txt", "extrinsic_depth.txt"):
        extrinsics = _find_scannet_file(root, name)
        if extrinsics is not None and not np.allclose(read_pose(extrinsics), np.eye(4), atol=1e-6):
            report.append(f"{name} is not the identity; not applied: ScanNet's depth is already aligned to colour")
    return [
        FolderParts(
            rows, stated, "intrinsic/intrinsic_color.txt", 1000.0, "ScanNet stores mm", pose_folder, report, depth_K
        )
    ]


# --------------------------------------------------------------------------------------------------------- sens_folder


def _find_sens(root: Path) -> tuple[str, Any] | None:
    for folder in (root, root / "sequence", root / "frames"):
        info = first_file(*(place / name for place in (folder, root) for name in ("_info.txt", "info.txt")))
        if info is not None and (images := list_numbered(folder, NAMED_COLOUR_PATTERN)):
            return f"{info.relative_to(root)} and frame-XXXXXX.{{color,depth,pose}} files", (info, folder, images)
    return None


def _list_sens(root: Path, place: tuple[Path, Path, dict[int, Path]]) -> list[FolderParts]:
    info, folder, images = place
    lines = [line.partition("=") for line in files.read_lines(info)]
    fields = {name.strip(): value.strip() for name, mark, value in lines if mark}
    depths = list_numbered(folder, r"frame-(\d+)\.depth\.(?:pgm|png)")
    pose_files = list_numbered(folder, r"frame-(\d+)\.pose\.txt")
    rows, report = pair_numbered(root, images, depths, {number: read_pose(file) for number, file in pose_files.items()})
    units, source = 1000.0, None
    if "m_depthShift" in fields:
        units = files.to_positive(fields["m_depthShift"], info, "m_depthShift")
        source = f"{info.name}: m_depthShift"
    apart = []
    for name in ("m_calibrationColorExtrinsic", "m_calibrationDepthExtrinsic"):
        if name in fields and not np.allclose(_parse_info_matrix(fields, info, name), np.eye(4), atol=1e-6):
            apart.append(name)
    if apart:
        report.append(f"{info.name}: {', '.join(apart)} not the identity; not applied: one centre is assumed")
    K, depth_K = (_parse_info_K(fields, kind, info) for kind in ("Color", "Depth"))
    return [FolderParts(rows, K, info.name, units, source, folder, report, depth_K)]


def _parse_info_matrix(fields: dict[str, str], info: Path, field: str) -> np.ndarray:
    return files.to_array(fields[field].split(), (16,), info, field).reshape(4, 4)


def _parse_info_K(fields: dict[str, str], kind: str, info: Path) -> StatedK | None:
    """K of ``kind`` Color or Depth with the size it is stated for; None where there is none."""
    field = f"m_calibration{kind}Intrinsic"
    if field not in fields:
        return None
    size = [fields.get(f"m_{kind.lower()}{side}", "") for side in ("Height", "Width")]
    hw = (int(size[0]), int(size[1])) if all(text.isdigit() for text in size) else None
    return _parse_info_matrix(fields, info, field)[:3, :3], info, field, hw


# ----------------------------------------------------------------------------------------------------------------- apc


def _find_apc(root: Path) -> tuple[str, Any] | None:
    info, images = root / "cam.info.txt", list_numbered(root, NAMED_COLOUR_PATTERN)
    is_apc = info.is_file() and images
    return f"{info.name} and frame-XXXXXX.{{color,depth}}.png" if is_apc else "", (info, images)


def _list_apc(
    root: Path,
    place: tuple[Path, dict[int, Path]],
    *,
    rotated: bool | None = None,  # whether the codes are rotated by 3 bits; None = as those of the first depth map are
) -> list[FolderParts]:
    info, images = place
    # matrices (3, 3) or (4, 4) by the title above them; texts that are no matrix are passed over
    title, rows_of = "", dict[str, list[list[str]]]()
    for line in files.read_lines(info):
        if line.lstrip().startswith("#"):
            title = line.strip(" \t#")
        elif line.strip():
            rows_of.setdefault(title, []).append(line.split())
    matrices, poses = {}, {}
    for title, words in rows_of.items():
        if len(words) not in (3, 4):
            continue
        matrices[title] = files.to_array(words, (len(words), len(words)), info, title)
        if match := re.fullmatch(r"Camera-to-world .* for frame-(\d+)", title):
            poses[int(match[1])] = matrices[title]
    rows, report = pair_numbered(root, images, list_numbered(root, r"frame-(\d+)\.depth\.png"), poses)
    bits, plain = choose_rotated_bits(rows[0].depth, rotated, "this format's")
    source = "the challenge's scenes store 1/10000 m, rotated by 3 bits" if bits else None
    colour = "Color camera intrinsic matrix"
    K = (matrices[colour], info, colour, None) if colour in matrices else None
    return [FolderParts(rows, K, info.name, 10000.0, source, info, [*report, *plain], rotated_bits=bits)]


# -------------------------------------------------------------------------------------------------------------- open3d


def _find_open3d(root: Path) -> tuple[str, Any] | None:
    folder = first_image_folder(root, ("color", "rgb", "image"))
    if folder is None:
        return None
    intrinsics_file = None
    for file in sorted(root.glob("*.json"), reverse=True):
        with contextlib.suppress(files.FormatError):
            # Files with an intrinsic matrix hold under 1 kB; large ones are not searched at recognition.
            if file.is_file() and file.stat().st_size <= 100_000 and "intrinsic_matrix" in files.read_json(file):
                intrinsics_file = file
    # Names of trajectories, the preferred one first: optimised poses before those of odometry.
    named = ("trajectory.log", "scene/trajectory.log", "odometry.log", "trajectory.txt")
    matched = [file for pattern in ("*traj*.log", "*traj*.txt", "*.log") for file in sorted(root.glob(pattern))]
    trajectories = []
    for file in dict.fromkeys(file for file in (*(root / name for name in named), *matched) if file.is_file()):
        with contextlib.suppress(files.FormatError):
            rows = [words for _, words in files.read_rows(file)[:5]]
            is_block = [len(row) for row in rows] == [3, 4, 4, 4, 4]
            if is_block and all(word.lstrip("-").isdigit() for word in rows[0]):
                trajectories.append(file)
    parts = [] if intrinsics_file is None else [intrinsics_file.name]
    parts += [file.relative_to(root).as_posix() for file in trajectories[:1]]
    is_open3d = parts and list_images(root / "depth")
    evidence = f"{', '.join([f'{folder.name}/', 'depth/', *parts[:-1]])} and {parts[-1]}" if is_open3d else ""
    return evidence, (folder, intrinsics_file, trajectories)


def _list_open3d(
    root: Path,
    place: tuple[Path, Path | None, list[Path]],
    *,
    units_per_metre: float | None = None,  # None = ``depth_scale`` of the intrinsics file, else 1000 is assumed
    trajectory: str | None = None,  # file with the poses; None = the first by name with a pose of each frame
) -> list[FolderParts]:
    folder, file, trajectories = place
    images, table = list_images(folder), root / "rgbd.match"
    rows, report = pair_folders(root, images, list_images(root / "depth"), table if table.is_file() else None)
    pose_files = trajectories if trajectory is None else [root / trajectory]
    rows, notes, poses_file = _add_logged_poses(root, rows, len(images), pose_files)
    report += notes
    document, stated = {} if file is None else files.read_json(file), None
    if file is not None:
        field = "intrinsic_matrix"
        matrix = files.to_array(document.get(field), (9,), file, field).reshape(3, 3).T
        if not matrix[:2, 2].any() and matrix[2, :2].any():  # unlike the format: the centre stands in the last row
            matrix = matrix.T
            report.append(f"{file.name}: {field} is by rows, the format has columns: read by rows")
        h, w = (document.get(name) for name in ("height", "width"))
        hw = (h, w) if isinstance(h, int) and isinstance(w, int) and min(h, w) > 0 else None
        stated = (matrix, file, field, hw)
    units, source = choose_units(root, units_per_metre, document, file, 1000.0)  # Open3D's default
    return [FolderParts(rows, stated, "camera_intrinsic.json", units, source, poses_file, report)]


def _read_log(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Integers (n, 3) and matrices (n, 4, 4) of the blocks of a trajectory."""
    rows = files.read_rows(file)
    blocks = "blocks of 5: three integers and a 4x4 matrix"
    files.refuse_if(len(rows) % 5, file, "lines", len(rows), blocks)
    ids, matrices = [], []
    for k in range(0, len(rows), 5):
        (line, head), *block = rows[k : k + 5]
        expected = "three integers and a 4x4 matrix"
        try:
            ids.append([int(word) for word in head])
            matrices.append([[float(word) for word in words] for _, words in block])
        except ValueError:
            raise files.FormatError(file, f"line {line}", " ".join(head), expected) from None
        is_other = len(head) != 3 or any(len(words) != 4 for _, words in block)
        files.refuse_if(is_other, file, f"line {line}", " ".join(head), expected)
    return np.array(ids), np.array(matrices)


def _add_logged_poses(
    root: Path, rows: list[FrameFiles], n_images: int, pose_files: Sequence[Path]
) -> tuple[list[FrameFiles], list[str], Path | None]:
    """Rows with their poses, the report, and the file of the poses (None = no poses).

    Poses belong to the images in the order of the blocks where there is one for each image, else by the third integer
    of a block, the frame's number counted from 1.
    """
    logs = {file: _read_log(file) for file in pose_files}
    usable = [file for file, (ids, _) in logs.items() if not (ids[:, 0] != ids[:, 1]).any()]
    report = [
        f"{file.name}: motions between two frames, not poses of frames: not used" for file in logs if file not in usable
    ]
    if not usable:
        return rows, report, None
    chosen = max(usable, key=lambda file: min(len(logs[file][0]), n_images))  # the first of those with most frames
    ids, matrices = logs[chosen]
    places = np.arange(n_images) if len(ids) == n_images else ids[:, 2] - 1
    expected = f"{n_images}, one for each image, or the images' numbers (from 1) in each block"
    is_other = len(np.unique(places)) != len(places) or places.min() < 0 or places.max() >= n_images
    files.refuse_if(is_other, chosen, "poses", len(ids), expected)
    poses = dict(zip(places.tolist(), matrices, strict=True))
    for file in usable:
        if file is chosen:
            continue
        # whether a second trajectory states the same motion as the one that is read
        names = [each.relative_to(root).as_posix() for each in (chosen, file)]
        text = f"poses are those of {names[0]}; {names[1]} (data.trajectory={names[1]})"
        if len(ids) != len(logs[file][0]):
            report.append(f"{text} has {len(logs[file][0])} poses for {len(ids)}")
            continue
        try:
            a, b = (np.linalg.inv(each[0]) @ each for each in (matrices, logs[file][1]))
            difference = float(np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=-1).max())
        except np.linalg.LinAlgError:
            difference = math.nan
        report.append(f"{text} differs by at most {difference:.3g} m over the motion from the first frame")
    return [replace(row, c2w=poses.get(row.number)) for row in rows], report, chosen


# --------------------------------------------------------------------------------------------------------------- sun3d


def _find_sun3d(root: Path) -> tuple[str, Any] | None:
    file, images, depths = root / "intrinsics.txt", list_images(root / "image"), list_images(root / "depth")
    is_sun3d = file.is_file() and images and depths
    return f"image/, depth/ and {file.name}" if is_sun3d else "", (file, images, depths)


def _list_sun3d(
    root: Path,
    place: tuple[Path, dict[str, Path], dict[str, Path]],
    *,
    rotated: bool | None = None,  # whether the codes are rotated by 3 bits; None = as those of the first depth map are
) -> list[FolderParts]:
    file, images, depths = place
    rows, report = pair_folders(root, images, depths, None)
    tables = sorted((root / "extrinsics").glob("*.txt"))
    if tables and len(images) == 1:
        tables, report = [], [*report, "extrinsics/ holds the tilt of one image, no pose: not read"]
    if tables:
        lines = files.read_table(tables[-1], 4)
        expected = f"{3 * len(images)}, three for each of {len(images)} images"
        files.refuse_if(len(lines) != 3 * len(images), tables[-1], "lines", len(lines), expected)
        matrices = np.tile(np.eye(4), (len(images), 1, 1))
        matrices[:, :3] = lines.reshape(-1, 3, 4)
        rows = [replace(row, c2w=matrices[row.number]) for row in rows]
    bits, plain = choose_rotated_bits(rows[0].depth, rotated, "SUN3D's")
    source = "SUN3D stores mm, rotated by 3 bits" if bits else None
    poses_file = tables[-1] if tables else None
    K = (read_K(file), file, "K", None) if file.is_file() else None
    return [FolderParts(rows, K, file.name, 1000.0, source, poses_file, [*report, *plain], rotated_bits=bits)]


#: The layouts by name, in the order in which they are tried. SUN3D's extrinsics are read, or named with the reason.
LAYOUTS = {
    layout.format: layout
    for layout in (
        Layout(
            "bop",
            _find_bop,
            lambda root, sensors: [_list_sensor(root, sensor, folder) for sensor, folder in sensors.items()],
            "rgb/ or gray/ with scene_camera.json",
            ("scene_gt*.json", "scene_gt_info*.json", "scene_gt_coco*.json"),
        ),
        Layout("replica", _find_replica, _list_replica, "results/frame*.jpg and results/depth*.png"),
        Layout(
            "scannet",
            _find_scannet,
            _list_scannet,
            "color/, depth/ and pose/<i>.txt",
            ("*.segs.json", "*.aggregation.json"),
        ),
        Layout(
            "sens_folder",
            _find_sens,
            _list_sens,
            "_info.txt and frame-XXXXXX.color.jpg",
            ("semseg*.json", "*.segs.json", "*.aggregation.json"),
        ),
        Layout("apc", _find_apc, _list_apc),
        Layout("open3d", _find_open3d, _list_open3d, "images in color/, rgb/ or image/"),
        Layout("sun3d", _find_sun3d, _list_sun3d, UNUSED_FILES=("extrinsics", "annotation*", "scene.txt")),
    )
}
