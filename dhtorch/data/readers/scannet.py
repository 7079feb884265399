"""Reader of exported ScanNet scans: colour, depth, one pose file for each frame, and 4×4 intrinsics.

- folders: ``color/<i>.jpg``, ``depth/<i>.png``, ``pose/<i>.txt`` (camera-to-world 4×4; −inf where tracking was lost),
  ``intrinsic/intrinsic_color.txt`` and ``intrinsic_depth.txt`` (4×4), or the latter in the scan's folder as
  ``intrinsics_color.txt``.
- flat: ``<i>.jpg``, ``<i>.png``, ``<i>.txt`` and ``intrinsic.txt`` (of colour) in one folder.

Depth is in mm, and already aligned to colour by the data set: both cameras have one centre, each has its K, and
``extrinsic_*.txt`` is not applied.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import image_table
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit

#: Depth codes of one metre. Source: format definition (m_depthShift of the scans).
_UNITS_PER_METRE = 1000.0

#: Image size (h, w) for which the scans' K of colour is stated. Source: format definition.
_COLOUR_HW = (968, 1296)

_IMAGE_PATTERN = r"(\d+)\.(?:jpg|jpeg|png)"
_COLOUR_FILES = ("intrinsic_color.txt", "intrinsics_color.txt", "intrinsic.txt")
_DEPTH_FILES = ("intrinsic_depth.txt", "intrinsics_depth.txt", "depth_intrinsic.txt")
_INTRINSICS_FOLDERS = ("intrinsic", "intrinsics", ".")
#: Labels of the scan's mesh.
UNUSED_FILES = ("*.segs.json", "*.aggregation.json")

_EXTRINSICS_FILES = ("extrinsic_color.txt", "extrinsic_depth.txt")


@dataclass(frozen=True)
class _Layout:
    """Folders of colour, depth and poses, and the name patterns of the files in them."""

    colour: str
    depth: str
    pose: str
    colour_pattern: str = _IMAGE_PATTERN
    depth_pattern: str = r"(\d+)\.png"


_LAYOUTS = (
    _Layout("color", "depth", "pose"),
    _Layout(".", ".", ".", r"(\d+)\.jpg"),
)


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    layout = _find_layout(root)
    if layout is None:
        return None
    file = _find_intrinsics(root, _COLOUR_FILES)
    folders = f"{layout.colour}/, {layout.depth}/, {layout.pose}/" if layout.colour != "." else "<i>.jpg, .png and .txt"
    return f"{folders} and {file.name}" if file else folders


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
        K: fx, fy, cx, cy of the images. None = ``intrinsic_color.txt``.
        fov: horizontal field of view of the images in degrees, for a guessed K.
        fps: frame rate, for time stamps; the export has none.

    Returns:
        One recording; ``Frame.depth_camera`` holds the depth's own K. Frames without image, depth map or pose, or with
        a lost pose, are left out and reported.

    Raises:
        FormatError: no frame, no intrinsics, a damaged file, or values that are no camera or pose.
    """
    root = Path(root)
    layout = _find_layout(root)
    if layout is None:
        raise FormatError(root, "files", "none", "color/, depth/ and pose/<i>.txt")
    images = image_table.list_numbered(root / layout.colour, layout.colour_pattern)
    depths = image_table.list_numbered(root / layout.depth, layout.depth_pattern)
    poses = {number: image_table.read_pose(file) for number, file in _list_poses(root, layout).items()}
    rows, report = image_table.pair_numbered(root, images, depths, poses)
    hw, depth_hw = files.read_image_header(rows[0].image).hw, image_table.read_depth_hw(rows[0].depth)
    colour_file, depth_file = _find_intrinsics(root, _COLOUR_FILES), _find_intrinsics(root, _DEPTH_FILES)
    stated = depth_stated = None
    if depth_file is not None:
        depth_stated = (image_table.read_K(depth_file), depth_file, "K", None)
    if colour_file is not None:
        matrix = image_table.read_K(colour_file)
        # Many exports have smaller images beside the K of the original size.
        is_fitting = abs(matrix[0, 2] - (hw[1] - 1) / 2) <= intrinsics_options.MAX_CENTRE_OFFSET * hw[1]
        stated = (matrix, colour_file, "K", None if is_fitting else _COLOUR_HW)
    elif hw == depth_hw:
        stated = depth_stated
    for name in _EXTRINSICS_FILES:
        file = _find_intrinsics(root, (name,))
        if file is not None and not np.allclose(image_table.read_pose(file), np.eye(4), atol=1e-6):
            report.append(f"{name} is not the identity; not applied: ScanNet's depth is already aligned to colour")
    return [
        image_table.open_image_table(
            root,
            "scannet",
            rows,
            (intrinsics, K, fov),
            stated=stated,
            where="intrinsic/intrinsic_color.txt",
            depth_stated=depth_stated,
            units_per_metre=_UNITS_PER_METRE,
            unit=DepthUnit(1 / _UNITS_PER_METRE, "ScanNet stores mm"),
            poses_file=root / layout.pose,
            fps=fps,
            report=report,
        )
    ]


def _find_layout(root: Path) -> _Layout | None:
    """The layout of which ``root`` has an image, a pose file and the intrinsics."""
    if not root.is_dir():
        return None
    for layout in _LAYOUTS:
        if layout.colour == "." and _find_intrinsics(root, _COLOUR_FILES[-1:]) is None:
            continue
        if _list_poses(root, layout) and image_table.list_numbered(root / layout.colour, layout.colour_pattern):
            return layout
    return None


def _list_poses(root: Path, layout: _Layout) -> dict[int, Path]:
    return image_table.list_numbered(root / layout.pose, r"(\d+)\.txt")


def _find_intrinsics(root: Path, names: Sequence[str]) -> Path | None:
    places = (root / folder / name for folder in _INTRINSICS_FOLDERS for name in names)
    return next((place for place in places if place.is_file()), None)
