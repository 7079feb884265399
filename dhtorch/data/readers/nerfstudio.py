"""Reader of nerfstudio data: ``transforms.json`` beside images, depth maps and poses; also of its relatives.

nerfstudio's converters (``ns-process-data`` of Polycam, Record3D and others), Spectacular AI, NeRFCapture and
Instant-NGP write ``transforms.json``: for every entry of ``frames`` the image (``file_path``, at times without a
suffix), its camera-to-world pose with OpenGL axes (``transform_matrix``) and a depth map (``depth_file_path`` or
``depth_path``); intrinsics for all frames or in each; at times ``timestamp`` in s. ``applied_transform`` and
``applied_scale`` were applied to the poses by the converter and are undone here, so that poses are those of the
capture, in metres if the capture's were. The centre of the first pixel is (0.5, 0.5) in the file and (0, 0) here.
``orientation_override`` and ``ply_file_path`` only concern training. Images of different folders are different cameras,
each a recording.

The unit of depth is ``depth_unit_scale_factor`` or ``integer_depth_scale``, metres of one step of the depth images
(NeRFCapture: its range in m / 65535). Where neither is present, nerfstudio assumes millimetres.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from dhtorch.data import convert
from dhtorch.data.io import decode as files
from dhtorch.data.readers.image_folders import FrameFiles, format_names_left_out, open_posed
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit

#: Files of the format that are not read: splits for training, what a converter printed, the sparse point cloud, and the
#: statistics of ``dhtorch enrich``.
UNUSED_FILES = ("transforms_*.json", "dataparser_transforms.json", "*_filelist.txt", "sparse_pc*", "report.json")

_FILE_NAME = "transforms.json"

#: Camera models with OpenCV's lens: pinhole, radial and tangential terms. Source: nerfstudio's CAMERA_MODEL_TO_TYPE.
_PERSPECTIVE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")

#: Distortion coefficients in OpenCV's order; ``k4`` multiplies r⁸ in nerfstudio, which OpenCV's model has not.
_LENS_NAMES = ("k1", "k2", "p1", "p2", "k3")

#: Names of the depth file of a frame → names of its unit, in the order in which they apply.
_DEPTH_KEYS = ("depth_file_path", "depth_path")
_DEPTH_FOLDERS = ("depth", "depths", "depth_images")
_UNIT_KEYS = ("depth_unit_scale_factor", "integer_depth_scale")

#: Name of the map of origins that ``dhtorch enrich`` adds.
_ORIGIN_KEY = "dhtorch_source_file_path"


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    file = find_transforms(root)
    return None if file is None else file.name


def read(root: str | Path, *, recovered: bool = False) -> list[Recording]:
    """Open a folder with ``transforms.json``, or a ``transforms*.json``, as one recording for each folder of images.

    Args:
        root: the folder, or the file.
        recovered: read also the depths that ``dhtorch enrich`` recovered, as if they were returns of the sensor.

    Returns:
        Recordings named after the folder, followed by that of the images where there are several. Images that are
        missing or have no finite pose are left out and reported; those without depth map have empty depth.

    Raises:
        FormatError: no or a damaged ``transforms.json``, a camera model that is not perspective, a file outside the
            folder, or values that are no camera or pose.
    """
    root = Path(root)
    file = find_transforms(root) or root / _FILE_NAME
    meta = files.read_json(file)
    folder = file.parent
    undo, report = _parse_applied(meta, file)
    rows: dict[PurePosixPath, list[FrameFiles]] = {}
    missing: list[Path] = []
    for k, entry in enumerate(files.get_entry(meta, "frames", list, file)):
        files.refuse_if(not isinstance(entry, dict), file, f"frames.{k}", type(entry).__name__, "an object")
        image = resolve_image(folder, entry, file, k)
        if not image.is_file():
            missing.append(image)
            continue
        row = _parse_row(meta, entry, image, undo, file, k)
        row = replace(row, origin=None) if recovered else row
        rows.setdefault(PurePosixPath(image.parent.relative_to(folder)), []).append(row)
    report += format_names_left_out(missing, "no such image")
    if any("colmap_im_id" in entry for entry in meta["frames"]):
        report.append("poses were estimated by COLMAP (colmap_im_id): their scale is not metric unless it was aligned")
    if any(row.origin is not None for images in rows.values() for row in images):
        report.append("depths that dhtorch enrich recovered are left out (data.recovered=true reads them)")
    if not any(key in entry for entry in meta["frames"] for key in _DEPTH_KEYS):
        report += [
            f"{name}/ is not read: {file.name} names no depth maps ({_DEPTH_KEYS[0]} of each frame)"
            for name in _DEPTH_FOLDERS
            if (folder / name).is_dir()
        ]
    files.refuse_if(not rows, file, "frames", "; ".join(report) or "none", "at least one image")
    stating = next((name for name in _UNIT_KEYS if meta.get(name) is not None), None)
    unit = None
    if stating is not None:
        unit = DepthUnit(files.to_positive(meta[stating], file, stating), f"{file.name}: {stating}")
    name = folder.resolve().name
    return [
        open_posed(
            root,
            "nerfstudio",
            images,
            unit=unit,
            report=report,
            name=name if len(rows) == 1 else f"{name}/{parent}",
            pose_axes="gl",
        )
        for parent, images in rows.items()
    ]


def find_transforms(root: Path) -> Path | None:
    """The file with the transforms: in the folder, or the path itself; None where there is none."""
    if root.is_file():
        return root if root.suffix == ".json" and root.name.startswith("transforms") else None
    file = root / _FILE_NAME
    return file if file.is_file() else None


def resolve_image(folder: Path, entry: Mapping[str, Any], file: Path, k: int) -> Path:
    """Path of an image; a name without suffix gets that of the file that exists."""
    image = _resolve(folder, files.get_entry(entry, "file_path", str, file), file, f"frames.{k}.file_path")
    if image.is_file() or image.suffix in files.IMAGE_SUFFIXES:
        return image
    named = (image.with_name(image.name + suffix) for suffix in files.IMAGE_SUFFIXES)
    return next((candidate for candidate in named if candidate.is_file()), image)


def _resolve(folder: Path, name: str, file: Path, field: str) -> Path:
    return files.resolve_inside(folder, name.replace("\\", "/"), file, field)


def _parse_row(
    meta: Mapping[str, Any], entry: Mapping[str, Any], image: Path, undo: np.ndarray, file: Path, k: int
) -> FrameFiles:
    K, hw, distortion = parse_lens({**meta, **entry}, image, file, k)
    depth_name = next((entry[key] for key in _DEPTH_KEYS if isinstance(entry.get(key), str)), None)
    depth = None if depth_name is None else _resolve(file.parent, depth_name, file, f"frames.{k}.depth_file_path")
    time, origin = entry.get("timestamp"), entry.get(_ORIGIN_KEY)
    return FrameFiles(
        number=-1,
        image=image,
        depth=depth if depth is not None and depth.is_file() else None,
        K=K,
        source=file,
        c2w=_parse_pose(entry, undo, file, k),
        distortion=distortion,
        hw=hw,
        origin=_resolve(file.parent, origin, file, f"frames.{k}.{_ORIGIN_KEY}") if isinstance(origin, str) else None,
        time=float(time) if isinstance(time, int | float) and not isinstance(time, bool) else None,
    )


def parse_lens(
    values: Mapping[str, Any], image: Path, file: Path, k: int
) -> tuple[np.ndarray, tuple[int, int], tuple[float, ...] | None]:
    """Entries of the file and of frame ``k`` → K with pixel centres at integers, (height, width) that it refers to, and
    distortion.

    Raises:
        FormatError: a camera model without OpenCV's distortion, or values that are no camera.
    """
    model = values.get("camera_model", _PERSPECTIVE_MODELS[0])
    if model not in _PERSPECTIVE_MODELS or values.get("is_fisheye") is True:
        actual = "is_fisheye" if model in _PERSPECTIVE_MODELS else model
        expected = f"{', '.join(_PERSPECTIVE_MODELS)} (undistort other lenses first)"
        raise files.FormatError(file, f"frames.{k}.camera_model", actual, expected)
    lens = tuple(_number(values, name, file, k, 0.0) for name in _LENS_NAMES)
    files.refuse_if(
        k4 := _number(values, "k4", file, k, 0.0),
        file,
        f"frames.{k}.k4",
        k4,
        "0 (OpenCV's model has no term in r⁸; undistort the images)",
    )
    hw = None
    if "w" in values and "h" in values:  # the size that K refers to
        h, w = (files.to_positive(values[name], file, f"frames.{k}.{name}") for name in "hw")
        hw = round(h), round(w)
    hw = hw or files.read_image_header(image).hw
    # K with pixel centres at integers, from focal lengths or Instant-NGP's angles
    focal = {axis: _parse_focal(values, axis, size, file, k) for axis, size in (("x", hw[1]), ("y", hw[0]))}
    fx = focal["x"] if focal["x"] is not None else focal["y"]
    if fx is None:
        raise files.FormatError(
            file, f"frames.{k}", "neither fl_x nor camera_angle_x", "the focal length of the images"
        )
    fy = fx if focal["y"] is None else focal["y"]
    cx, cy = (_number(values, f"c{axis}", file, k, n / 2) for axis, n in (("x", hw[1]), ("y", hw[0])))
    return convert.make_K(fx, fy, cx - 0.5, cy - 0.5), hw, lens if any(lens) else None


def _parse_focal(values: Mapping[str, Any], axis: str, size: int, file: Path, k: int) -> float | None:
    if f"fl_{axis}" in values:
        return files.to_positive(values[f"fl_{axis}"], file, f"frames.{k}.fl_{axis}")
    name = f"camera_angle_{axis}"
    if name not in values:
        return None
    angle = _number(values, name, file, k, 0.0)
    files.refuse_if(not 0 < angle < math.pi, file, f"frames.{k}.{name}", angle, "an angle in radians, 0 to pi")
    return size / 2 / math.tan(angle / 2)


def _parse_pose(entry: Mapping[str, Any], undo: np.ndarray, file: Path, k: int) -> np.ndarray | None:
    """Camera to world with OpenCV axes, in the world of the capture; None = the entry has no pose."""
    if "transform_matrix" not in entry:
        return None
    matrix = entry["transform_matrix"]
    rows = matrix if isinstance(matrix, list) else [matrix]
    cells = [cell for row in rows for cell in (row if isinstance(row, list) else [row])]
    if any(cell is None or (isinstance(cell, float) and not math.isfinite(cell)) for cell in cells):
        return np.full((4, 4), np.nan)
    c2w = parse_matrix(entry["transform_matrix"], file, f"frames.{k}.transform_matrix")
    scale = np.linalg.norm(undo[:3, 0])
    c2w = undo @ c2w
    c2w[:3, :3] /= scale
    return convert.cv_from_gl(c2w[None])[0]


def parse_matrix(value: Any, file: Path, field: str) -> np.ndarray:
    """3×4 or 4×4 numbers → (4, 4)."""
    n_rows = len(value) if isinstance(value, list) else 0
    files.refuse_if(n_rows not in (3, 4), file, field, f"{n_rows} rows", "3 or 4 rows of 4 numbers")
    matrix = files.to_array(value, (n_rows, 4), file, field)
    return matrix if n_rows == 4 else np.vstack((matrix, [0.0, 0.0, 0.0, 1.0]))


def _parse_applied(meta: Mapping[str, Any], file: Path) -> tuple[np.ndarray, list[str]]:
    """(4×4 from the file's world to the capture's, report): the inverse of what a converter applied to the poses."""
    report = []
    applied = np.eye(4)
    if meta.get("applied_transform") is not None:
        applied = parse_matrix(meta["applied_transform"], file, "applied_transform")
        R = applied[:3, :3]
        # Six printed digits leave an error of rounding.
        files.refuse_if(
            np.abs(R @ R.T - np.eye(3)).max() > 1e-4 or np.linalg.det(R) < 0,
            file,
            "applied_transform",
            R.tolist(),
            "a rotation and a translation",
        )
    scale = files.to_positive(meta.get("applied_scale", 1.0), file, "applied_scale")
    if scale != 1:
        report.append(f"poses are stored times {scale:.6g} (applied_scale): undone")
    return np.linalg.inv(np.diag([scale, scale, scale, 1.0]) @ applied), report


def _number(values: Mapping[str, Any], name: str, file: Path, k: int, default: float) -> float:
    return float(files.to_array(values.get(name, default), (), file, f"frames.{k}.{name}"))
