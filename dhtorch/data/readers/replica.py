"""Reader of rendered Replica scenes as NICE-SLAM and iMAP use them.

- NICE-SLAM: ``results/frameXXXXXX.jpg``, ``results/depthXXXXXX.png``, ``traj.txt`` (one camera-to-world 4×4 by rows in
  each line) and ``cam_params.json`` in the scene's folder or the one above: ``w``, ``h``, ``fx``, ``fy``, ``cx``,
  ``cy``, ``scale`` (depth codes of one metre), alone or below ``camera``.
- iMAP: ``rgb/rgb_X.png``, ``depth/depth_X.png`` and ``traj_w_c.txt``, without intrinsics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dhtorch.data import convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import image_table
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit

_PARAMETERS_FILE = "cam_params.json"


@dataclass(frozen=True)
class _Layout:
    """Folders, file names and trajectory of one of the two layouts, and its usual unit of depth."""

    images: str
    image_pattern: str
    depths: str
    depth_pattern: str
    trajectory: str
    units_per_metre: float


_LAYOUTS = (
    _Layout("results", r"frame(\d+)\.(?:jpg|jpeg|png)", "results", r"depth(\d+)\.png", "traj.txt", 6553.5),
    _Layout("rgb", r"rgb_(\d+)\.(?:jpg|jpeg|png)", "depth", r"depth_(\d+)\.png", "traj_w_c.txt", 1000.0),
)


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    layout = _find_layout(root)
    if layout is None:
        return None
    return " and ".join(part for part in (f"{layout.images}/", layout.trajectory) if (root / part).exists())


def read(
    root: str | Path,
    *,
    intrinsics: intrinsics_options.IntrinsicsOption | None = None,
    K: Sequence[float] | None = None,
    fov: float | None = None,
    fps: float | None = None,
) -> list[Recording]:
    """Open one scene.

    Args:
        root: the folder of the scene.
        intrinsics: four numbers as ``K``, or one as ``fov``.
        K: fx, fy, cx, cy of the images. None = ``cam_params.json``.
        fov: horizontal field of view of the images in degrees, for a guessed K; 90 in the renders of iMAP.
        fps: frame rate, for time stamps; the format has none.

    Returns:
        One recording. The unit of depth is that of ``cam_params.json``; without one, the usual unit of the layout is
        assumed: 1/6553.5 m (NICE-SLAM) or 1/1000 m (iMAP).

    Raises:
        FormatError: no frame, no intrinsics, a damaged file, or values that are no camera or pose.
    """
    root = Path(root)
    layout = _find_layout(root)
    if layout is None:
        raise FormatError(root, "files", "none", "results/frame*.jpg and results/depth*.png")
    images = image_table.list_numbered(root / layout.images, layout.image_pattern)
    depths = image_table.list_numbered(root / layout.depths, layout.depth_pattern)
    trajectory = root / layout.trajectory
    poses, report = _read_trajectory(trajectory, sorted(images))
    rows, left_out = image_table.pair_numbered(root, images, depths, poses)
    units, source, stated = layout.units_per_metre, None, None
    file = next((f for f in (root / _PARAMETERS_FILE, root.parent / _PARAMETERS_FILE) if f.is_file()), None)
    if file is not None:
        document = files.read_json(file)
        parameters = document.get("camera", document)
        if not isinstance(parameters, dict):
            raise FormatError(file, "camera", parameters, "an object with w, h, fx, fy, cx, cy and scale")
        if "fx" in parameters:
            names = [parameters.get(name) for name in ("fx", "fy", "cx", "cy")]
            matrix, hw = convert.make_K(*files.to_array(names, (4,), file, "fx, fy, cx, cy")), None
            if "w" in parameters and "h" in parameters:
                w, h = files.to_array([parameters["w"], parameters["h"]], (2,), file, "w, h").astype(int).tolist()
                hw = (h, w)
            stated = (matrix, file, "fx, fy, cx, cy", hw)
        if "scale" in parameters:
            units, source = files.to_positive(parameters["scale"], file, "scale"), f"{file.name}: scale"
    return [
        image_table.open_image_table(
            root,
            "replica",
            rows,
            (intrinsics, K, fov),
            stated=stated,
            where=_PARAMETERS_FILE,
            units_per_metre=units,
            unit=DepthUnit(1 / units, source),
            poses_file=trajectory,
            fps=fps,
            report=[*report, *left_out],
        )
    ]


def _find_layout(root: Path) -> _Layout | None:
    """The layout of which ``root`` has an image and a depth map; the second one only with its trajectory."""
    for layout in _LAYOUTS:
        if layout.images != layout.depths and not (root / layout.trajectory).is_file():
            continue
        if image_table.list_numbered(root / layout.images, layout.image_pattern) and (
            image_table.list_numbered(root / layout.depths, layout.depth_pattern)
        ):
            return layout
    return None


def _read_trajectory(file: Path, numbers: Sequence[int]) -> tuple[dict[int, np.ndarray], list[str]]:
    """Poses by frame number, and the report: line k is the pose of frame number k, or of the k-th image."""
    if not file.is_file():
        return {}, []
    rows = files.read_table(file, 16).reshape(-1, 4, 4)
    if len(rows) == len(numbers):
        return dict(zip(numbers, rows, strict=True)), []
    if numbers[-1] >= len(rows):
        raise FormatError(file, "lines", len(rows), f"{len(numbers)}, one for each image (the last is {numbers[-1]})")
    note = f"{file.name}: {len(rows)} poses for {len(numbers)} images: matched by the images' numbers"
    return {number: rows[number] for number in numbers}, [note]
