"""Reader of scans in the layout of SensReader: 3RScan, ScanNet and BundleFusion scans.

``_info.txt`` (or ``info.txt``) holds lines ``name = value``: sizes of colour and depth, ``m_depthShift`` (depth codes
of one metre) and both intrinsics as 4×4 by rows. ``frame-XXXXXX.color.jpg``, ``.depth.pgm`` (or ``.png``) and
``.pose.txt`` (camera-to-world 4×4; −inf where tracking was lost) lie beside it or in ``sequence/``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dhtorch.data import convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import image_table
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit

_INFO_FILES = ("_info.txt", "info.txt")
_FRAME_FOLDERS = (".", "sequence", "frames")
_DEPTH_PATTERN = r"frame-(\d+)\.depth\.(?:pgm|png)"
_POSE_PATTERN = r"frame-(\d+)\.pose\.txt"
_SHIFT_FIELD = "m_depthShift"

#: Labels of the data sets' meshes.
UNUSED_FILES = ("semseg*.json", "*.segs.json", "*.aggregation.json")


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    if (place := _find_scan(root)) is None:
        return None
    return f"{place[0].relative_to(root)} and frame-XXXXXX.{{color,depth,pose}} files"


def read(
    root: str | Path,
    *,
    intrinsics: intrinsics_options.IntrinsicsOption | None = None,
    K: Sequence[float] | None = None,
    fov: float | None = None,
    fps: float | None = None,
) -> list[Recording]:
    """Open one scan.

    Args:
        root: the folder of the scan.
        intrinsics: four numbers as ``K``, or one as ``fov``.
        K: fx, fy, cx, cy of the images. None = ``m_calibrationColorIntrinsic``.
        fov: horizontal field of view of the images in degrees, for a guessed K.
        fps: frame rate, for time stamps; the layout has none.

    Returns:
        One recording; ``Frame.depth_camera`` holds the depth's own K. Frames without image, depth map or pose, or with
        a lost pose, are left out and reported.

    Raises:
        FormatError: no frame, a damaged file, or values that are no camera or pose.
    """
    root = Path(root)
    place = _find_scan(root)
    if place is None:
        raise FormatError(root, "files", "none", "_info.txt and frame-XXXXXX.color.jpg")
    info, folder = place
    fields = _read_fields(info)
    images = image_table.list_numbered(folder, image_table.NAMED_COLOUR_PATTERN)
    depths = image_table.list_numbered(folder, _DEPTH_PATTERN)
    poses = {
        number: image_table.read_pose(file) for number, file in image_table.list_numbered(folder, _POSE_PATTERN).items()
    }
    rows, report = image_table.pair_numbered(images, depths, poses)
    if not rows:
        raise FormatError(root, "depth maps", f"{len(depths)} for {len(images)} images", "the images' numbers")
    hw, depth_hw = files.read_image_header(rows[0].image).hw, image_table.read_depth_hw(rows[0].depth)
    colour_K, colour_scaled = _parse_K(fields, "Color", hw, info)
    depth_K, depth_scaled = _parse_K(fields, "Depth", depth_hw, info)
    stated = None if colour_K is None else (colour_K, info, "m_calibrationColorIntrinsic")
    camera, guess = image_table.choose_camera(root, hw, stated, intrinsics, K, fov, where=info.name)
    depth_camera = None
    if depth_K is not None:
        depth_camera = convert.to_camera(depth_K, depth_hw, info, "m_calibrationDepthIntrinsic")
    units, source = 1000.0, None
    if _SHIFT_FIELD in fields:
        units = files.to_positive(_parse_number(fields[_SHIFT_FIELD], info), info, _SHIFT_FIELD)
        source = f"{info.name}: {_SHIFT_FIELD}"
    report += [*_report_extrinsics(fields, info), *colour_scaled, *depth_scaled, *guess]
    loader = image_table.ImageTableLoader(
        rows=tuple(rows),
        hw=hw,
        depth_hw=depth_hw,
        camera=camera,
        depth_camera=depth_camera,
        units_per_metre=units,
    )
    return [
        image_table.open_image_table(
            root,
            "sens_folder",
            loader,
            unit=DepthUnit(1 / units, source),
            poses_file=folder,
            fps=fps,
            report=report,
        )
    ]


def _find_scan(root: Path) -> tuple[Path, Path] | None:
    """(the table of the scan, the folder of its frames); None where there is no scan."""
    for part in _FRAME_FOLDERS:
        folder = root / part
        info = next(
            (place / name for place in (folder, root) for name in _INFO_FILES if (place / name).is_file()), None
        )
        if info is not None and image_table.list_numbered(folder, image_table.NAMED_COLOUR_PATTERN):
            return info, folder
    return None


def _read_fields(info: Path) -> dict[str, str]:
    """Values of the lines ``name = value``, as text."""
    parts = [line.partition("=") for line in files.read_lines(info)]
    return {name.strip(): value.strip() for name, mark, value in parts if mark}


def _parse_number(text: str, info: Path) -> float:
    try:
        return float(text)
    except ValueError:
        raise FormatError(info, _SHIFT_FIELD, text, "a number") from None


def _parse_matrix(text: str, info: Path, field: str) -> np.ndarray:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        raise FormatError(info, field, text, "16 numbers (4x4 by rows)") from None
    return files.to_array(values, (16,), info, field).reshape(4, 4)


def _parse_K(
    fields: dict[str, str], kind: str, hw: tuple[int, int], info: Path
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """K (3, 3) of ``kind`` Color or Depth for images of size ``hw``, None where there is none; report of scaling."""
    field = f"m_calibration{kind}Intrinsic"
    if field not in fields:
        return None, ()
    matrix = _parse_matrix(fields[field], info, field)[:3, :3]
    size = [fields.get(f"m_{kind.lower()}{side}", "") for side in ("Height", "Width")]
    if not all(text.isdigit() for text in size):
        return matrix, ()
    return image_table.fit_K(matrix, (int(size[0]), int(size[1])), hw, info)


def _report_extrinsics(fields: dict[str, str], info: Path) -> list[str]:
    names = [f"m_calibration{kind}Extrinsic" for kind in ("Color", "Depth")]
    applied = [name for name in names if name in fields]
    apart = [name for name in applied if not np.allclose(_parse_matrix(fields[name], info, name), np.eye(4), atol=1e-6)]
    return [f"{info.name}: {', '.join(apart)} not the identity; not applied: one centre is assumed"] if apart else []
