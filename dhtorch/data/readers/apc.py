"""Reader of the shelf scenes of the Amazon Picking Challenge (MIT-Princeton, the format of apc-vision-toolbox).

``frame-XXXXXX.color.png``, ``frame-XXXXXX.depth.png`` (16-bit codes of 1/10000 m, rotated by 3 bits to the left,
already registered to colour) and ``cam.info.txt``: titles ``# …`` above matrices by rows, among them the K of colour
and one camera-to-world 4×4 of the arm for each frame.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import image_table
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit

#: Depth codes of one metre. Source: format definition (the set's toolbox).
_UNITS_PER_METRE = 10000.0

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
    # matrices (3, 3) or (4, 4) by the title above them; texts that are no matrix are passed over
    rows_of: dict[str, list[list[str]]] = {}
    title, matrices, poses = "", {}, {}
    for line in files.read_lines(info):
        if line.lstrip().startswith("#"):
            title = line.strip(" \t#")
        elif line.strip():
            rows_of.setdefault(title, []).append(line.split())
    for title, words in rows_of.items():
        n = len(words)
        if n not in (3, 4):
            continue
        try:
            values = [[float(word) for word in row] for row in words]
        except ValueError:
            raise FormatError(info, title, " ".join(words[0]), f"{n} rows of {n} numbers") from None
        matrices[title] = files.to_array(values, (n, n), info, title)
        if match := _POSE_PATTERN.fullmatch(title):
            poses[int(match[1])] = matrices[title]
    images = image_table.list_numbered(root, image_table.NAMED_COLOUR_PATTERN)
    depths = image_table.list_numbered(root, r"frame-(\d+)\.depth\.png")
    rows, report = image_table.pair_numbered(root, images, depths, poses)
    bits, plain = image_table.choose_rotated_bits(rows[0].depth, rotated, "this format's")
    source = "the challenge's scenes store 1/10000 m, rotated by 3 bits" if bits else None
    return [
        image_table.open_image_table(
            root,
            "apc",
            rows,
            (intrinsics, K, fov),
            stated=(matrices[_COLOUR_TITLE], info, _COLOUR_TITLE, None) if _COLOUR_TITLE in matrices else None,
            where=_INFO_FILE,
            units_per_metre=_UNITS_PER_METRE,
            unit=DepthUnit(1 / _UNITS_PER_METRE, source),
            poses_file=info,
            rotated_bits=bits,
            fps=fps,
            report=[*report, *plain],
        )
    ]
