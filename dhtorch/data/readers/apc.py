"""Reader of the shelf scenes of the Amazon Picking Challenge (MIT-Princeton, the format of apc-vision-toolbox).

``frame-XXXXXX.color.png``, ``frame-XXXXXX.depth.png`` (16-bit codes of 1/10000 m, rotated by 3 bits to the left,
already registered to colour) and ``cam.info.txt``: titles ``# …`` above matrices by rows, among them the K of colour
and one camera-to-world 4×4 of the arm for each frame.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import image_table
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit

#: Depth codes of one metre, and bits by which they are rotated. Source: format definition (the set's toolbox).
_UNITS_PER_METRE = 10000.0
_ROTATED_BITS = 3

_INFO_FILE = "cam.info.txt"
_COLOUR_TITLE = "Color camera intrinsic matrix"
_POSE_PATTERN = re.compile(r"Camera-to-world .* for frame-(\d+)")


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    if not (root / _INFO_FILE).is_file() or not image_table.list_numbered(root, image_table.NAMED_COLOUR_PATTERN):
        return None
    return f"{_INFO_FILE} and frame-XXXXXX.{{color,depth}}.png"


def read(
    root: str | Path,
    *,
    intrinsics: intrinsics_options.IntrinsicsOption | None = None,
    K: Sequence[float] | None = None,
    fov: float | None = None,
    rotated: bool | None = None,
    fps: float | None = None,
) -> list[Recording]:
    """Open one scene.

    Args:
        root: the folder of the scene.
        intrinsics: four numbers as ``K``, or one as ``fov``.
        K: fx, fy, cx, cy of the images. None = that of ``cam.info.txt``.
        fov: horizontal field of view of the images in degrees, for a guessed K.
        rotated: whether the depth codes are rotated by 3 bits. None = as the codes of the first depth map are.
        fps: frame rate, for time stamps; the format has none.

    Returns:
        One recording. Frames without image, depth map or pose are left out and reported.

    Raises:
        FormatError: no frame, a damaged file, or values that are no camera or pose.
    """
    root = Path(root)
    info = root / _INFO_FILE
    matrices = _read_matrices(info)
    poses = {int(m[1]): matrices[title] for title in matrices if (m := _POSE_PATTERN.fullmatch(title))}
    images = image_table.list_numbered(root, image_table.NAMED_COLOUR_PATTERN)
    depths = image_table.list_numbered(root, r"frame-(\d+)\.depth\.png")
    rows, report = image_table.pair_numbered(images, depths, poses)
    if not rows:
        raise FormatError(root, "depth maps", f"{len(depths)} for {len(images)} images", "the images' numbers")
    hw = files.read_image_header(rows[0].image).hw
    stated = (matrices[_COLOUR_TITLE], info, _COLOUR_TITLE) if _COLOUR_TITLE in matrices else None
    camera, guess = image_table.choose_camera(root, hw, stated, intrinsics, K, fov, where=_INFO_FILE)
    bits, plain = image_table.choose_rotated_bits(rows[0].depth, rotated, _ROTATED_BITS, "this format's")
    loader = image_table.ImageTableLoader(
        rows=tuple(rows),
        hw=hw,
        depth_hw=image_table.read_depth_hw(rows[0].depth),
        camera=camera,
        units_per_metre=_UNITS_PER_METRE,
        rotated_bits=bits,
    )
    source = "the challenge's scenes store 1/10000 m, rotated by 3 bits" if bits else None
    return [
        image_table.open_image_table(
            root,
            "apc",
            loader,
            unit=DepthUnit(1 / _UNITS_PER_METRE, source),
            poses_file=info,
            fps=fps,
            report=[*report, *plain, *guess],
        )
    ]


def _read_matrices(info: Path) -> dict[str, np.ndarray]:
    """Matrices (3, 3) or (4, 4) by the title above them; texts that are no matrix are passed over."""
    rows: dict[str, list[list[str]]] = {}
    title = ""
    for line in files.read_lines(info):
        if line.lstrip().startswith("#"):
            title = line.strip(" \t#")
        elif line.strip():
            rows.setdefault(title, []).append(line.split())
    matrices = {}
    for name, words in rows.items():
        n = len(words)
        if n not in (3, 4):
            continue
        try:
            values = [[float(word) for word in row] for row in words]
        except ValueError:
            raise FormatError(info, name, " ".join(words[0]), f"{n} rows of {n} numbers") from None
        matrices[name] = files.to_array(values, (n, n), info, name)
    return matrices
