"""Reader of scans in the layout of SensReader: 3RScan, ScanNet and BundleFusion scans.

``_info.txt`` (or ``info.txt``) holds lines ``name = value``: sizes of colour and depth, ``m_depthShift`` (depth codes
of one metre) and both intrinsics as 4×4 by rows. ``frame-XXXXXX.color.jpg``, ``.depth.pgm`` (or ``.png``) and
``.pose.txt`` (camera-to-world 4×4; −inf where tracking was lost) lie beside it or in ``sequence/``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import image_table
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit

_INFO_FILES = ("_info.txt", "info.txt")
_FRAME_FOLDERS = (".", "sequence", "frames")
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
    parts = [line.partition("=") for line in files.read_lines(info)]
    fields = {name.strip(): value.strip() for name, mark, value in parts if mark}
    pose_files = image_table.list_numbered(folder, r"frame-(\d+)\.pose\.txt")
    rows, report = image_table.pair_numbered(
        root,
        image_table.list_numbered(folder, image_table.NAMED_COLOUR_PATTERN),
        image_table.list_numbered(folder, r"frame-(\d+)\.depth\.(?:pgm|png)"),
        {number: image_table.read_pose(file) for number, file in pose_files.items()},
    )
    units, source = 1000.0, None
    if _SHIFT_FIELD in fields:
        try:
            units = float(fields[_SHIFT_FIELD])
        except ValueError:
            raise FormatError(info, _SHIFT_FIELD, fields[_SHIFT_FIELD], "a number") from None
        units, source = files.to_positive(units, info, _SHIFT_FIELD), f"{info.name}: {_SHIFT_FIELD}"
    names = [f"m_calibration{kind}Extrinsic" for kind in ("Color", "Depth")]
    matrices = {name: _parse_matrix(fields[name], info, name) for name in names if name in fields}
    apart = [name for name, matrix in matrices.items() if not np.allclose(matrix, np.eye(4), atol=1e-6)]
    if apart:
        report.append(f"{info.name}: {', '.join(apart)} not the identity; not applied: one centre is assumed")
    return [
        image_table.open_image_table(
            root,
            "sens_folder",
            rows,
            (intrinsics, K, fov),
            stated=_parse_K(fields, "Color", info),
            where=info.name,
            depth_stated=_parse_K(fields, "Depth", info),
            units_per_metre=units,
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


def _parse_matrix(text: str, info: Path, field: str) -> np.ndarray:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        raise FormatError(info, field, text, "16 numbers (4x4 by rows)") from None
    return files.to_array(values, (16,), info, field).reshape(4, 4)


def _parse_K(fields: dict[str, str], kind: str, info: Path) -> image_table.StatedK | None:
    """K of ``kind`` Color or Depth with the size it is stated for; None where there is none."""
    field = f"m_calibration{kind}Intrinsic"
    if field not in fields:
        return None
    size = [fields.get(f"m_{kind.lower()}{side}", "") for side in ("Height", "Width")]
    hw = (int(size[0]), int(size[1])) if all(text.isdigit() for text in size) else None
    return _parse_matrix(fields[field], info, field)[:3, :3], info, field, hw
