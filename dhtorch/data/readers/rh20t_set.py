"""Reader of RH20T sets: one recording per scene, from the camera on the robot's hand."""

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from dhtorch.data.io import decode as files
from dhtorch.data.readers import rh20t
from dhtorch.data.readers.rh20t_robot import ROBOT_ARMS
from dhtorch.data.recording import Recording, Recordings

_SCENE_PATTERN = re.compile(r"task_\d+_user_\d+_scene_\d+_cfg_0*([1-7])")


def open_set(
    root: str | Path,
    *,
    camera: str = "hand",
    depth_root: str | None = None,
    limit: int | None = None,
    max_difference: float = 0.02,
    max_gap: float = 0.5,
    outlier: float = 0.0,
) -> Recordings:
    """Open the robot scenes below a folder, each on access.

    A scene is a folder named ``task_…_user_…_scene_…_cfg_…`` in ``root`` or one level below (``RH20T_cfg1``, …).
    Left out: demonstrations by a person (``_human``), scenes without a calibration, scenes without the requested
    camera.

    Args:
        root: folder of the set.
        camera: ``hand`` = the scene's first camera on the hand, or a serial number.
        depth_root: the parallel tree of depth videos; None = ``root``.
        limit: number of scenes to open, the first by name; None = all.
        max_difference, max_gap, outlier: as :func:`dhtorch.data.readers.rh20t.read`.

    Returns:
        Recordings named ``<scene>/<serial>``.

    Raises:
        FormatError: no such folder, or no scene in it.
    """
    base = Path(root)
    files.refuse_if(not base.is_dir(), base, "path", "no such folder", "a folder of RH20T scenes")
    scenes = list(_list_scenes(base, camera))[:limit]
    if not scenes:
        expected = f"task_…_cfg_… folders with a calibration and the camera {camera!r}"
        raise files.FormatError(base, "scenes", "none", expected)
    options = {"max_difference": max_difference, "max_gap": max_gap, "outlier": outlier}
    names = [f"{folder.name}/{serial}" for folder, serial in scenes]
    depth = None if depth_root is None else Path(depth_root)
    return Recordings(names, partial(_open_scene, root=base, scenes=tuple(scenes), depth_root=depth, options=options))


def _open_scene(
    i: int,
    *,
    root: Path,
    scenes: tuple[tuple[Path, str], ...],  # folder of the scene, serial of the camera
    depth_root: Path | None,
    options: dict[str, Any],
) -> Recording:
    """Position → recording."""
    scene, serial = scenes[i]
    depth = None if depth_root is None else str(depth_root / scene.relative_to(root))
    return rh20t.read(scene, serials=[serial], depth_root=depth, **options)[0]


def _list_scenes(root: Path, camera: str) -> Iterator[tuple[Path, str]]:
    """(folder, serial of the camera) of each calibrated robot scene that has the camera."""
    folders = sorted({f for pattern in ("task_*", "*/task_*") for f in root.glob(pattern)}, key=lambda f: f.name)
    for folder in folders:
        match = _SCENE_PATTERN.fullmatch(folder.name)
        if match is None or not (folder / "metadata.json").is_file():
            continue
        serials = ROBOT_ARMS[int(match[1])].in_hand if camera == "hand" else (camera,)
        serial = next((s for s in serials if (folder / f"cam_{s}" / "color.mp4").is_file()), None)
        calibrated = files.read_json(folder / "metadata.json").get("calib", -1) not in (-1, "-1")
        if serial is not None and calibrated:
            yield folder, serial
