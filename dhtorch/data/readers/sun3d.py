"""Reader of SUN3D sequences and SUN RGB-D images.

``image/``, ``depth/`` (16-bit codes in mm, rotated by 3 bits to the left), ``intrinsics.txt`` (3×3) and
``extrinsics/<date>.txt`` (3×4 camera-to-world matrices of all images, one below the other; the latest date is the
current one). Names are ``<number>-<time stamp in µs>``; each image has the depth map nearest in time. A SUN RGB-D
folder holds one image, and its extrinsics hold a tilt, which is no pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import image_table
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit

#: Depth codes of one metre. Source: format definition (the data set's toolbox).
_UNITS_PER_METRE = 1000.0

_INTRINSICS_FILE = "intrinsics.txt"

#: Extrinsics are read, or named by the reader with the reason; the others hold labels.
UNUSED_FILES = ("extrinsics", "annotation*", "scene.txt")


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    if not (root / _INTRINSICS_FILE).is_file() or not image_table.list_images(root / "image"):
        return None
    if not image_table.list_images(root / "depth"):
        return None
    return f"image/, depth/ and {_INTRINSICS_FILE}"


def read(
    root: str | Path,
    *,
    intrinsics: intrinsics_options.IntrinsicsOption | None = None,
    K: Sequence[float] | None = None,
    fov: float | None = None,
    rotated: bool | None = None,
    fps: float | None = None,
) -> list[Recording]:
    """Open one sequence.

    Args:
        root: the folder of the sequence.
        intrinsics: four numbers as ``K``, or one as ``fov``.
        K: fx, fy, cx, cy of the images. None = ``intrinsics.txt``.
        fov: horizontal field of view of the images in degrees, for a guessed K.
        rotated: whether the depth codes are rotated by 3 bits. None = as the codes of the first depth map are, which is
            reported where they are not.
        fps: frame rate, for time stamps.

    Returns:
        One recording. Images without depth map or pose are left out and reported.

    Raises:
        FormatError: no frame, files that cannot be paired, a damaged file, or values that are no camera or pose.
    """
    root = Path(root)
    images, depths = image_table.list_images(root / "image"), image_table.list_images(root / "depth")
    rows, report = image_table.pair_folders(root, images, depths, None)
    tables = sorted((root / "extrinsics").glob("*.txt"))
    if tables and len(images) == 1:
        tables, report = [], [*report, "extrinsics/ holds the tilt of one image, no pose: not read"]
    if tables:
        lines = files.read_table(tables[-1], 4)
        if len(lines) != 3 * len(images):
            expected = f"{3 * len(images)}, three for each of {len(images)} images"
            raise FormatError(tables[-1], "lines", len(lines), expected)
        matrices = np.tile(np.eye(4), (len(images), 1, 1))
        matrices[:, :3] = lines.reshape(-1, 3, 4)
        rows = [replace(row, c2w=matrices[row.number]) for row in rows]
    file = root / _INTRINSICS_FILE
    bits, plain = image_table.choose_rotated_bits(rows[0].depth, rotated, "SUN3D's")
    return [
        image_table.open_image_table(
            root,
            "sun3d",
            rows,
            (intrinsics, K, fov),
            stated=(image_table.read_K(file), file, "K", None) if file.is_file() else None,
            where=_INTRINSICS_FILE,
            units_per_metre=_UNITS_PER_METRE,
            unit=DepthUnit(1 / _UNITS_PER_METRE, "SUN3D stores mm, rotated by 3 bits" if bits else None),
            poses_file=tables[-1] if tables else None,
            rotated_bits=bits,
            fps=fps,
            report=[*report, *plain],
        )
    ]
