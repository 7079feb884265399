"""Reader of DGP driving scenes: a car with several cameras and a LiDAR; one recording per camera.

``scene_*.json`` lists *samples* (instants), each with its data: an image per camera and one LiDAR sweep, every one with
its own sensor-to-world pose (quaternion and translation) and stamp; ``calibration/<key>.json`` has the intrinsics by
sensor name; ``point_cloud/…npz`` holds the points in the LiDAR's own frame, one row each.

The depth map of an image is the sweep of its instant, transformed to the world by the sweep's pose and into the camera
by the image's: sparse, z-buffered, nothing filled in. Objects that moved between the two stamps are displaced by that
motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data.codecs import npy
from dhtorch.data.io import decode as files
from dhtorch.data.recording import Recording
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame, Pose

#: Side-car of dhtorch, of which this layout needs nothing.
UNUSED_FILES = ("meta.json",)


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    if (root / "calibration").is_dir() and any(root.glob("scene_*.json")):
        return "scene_*.json and calibration/"
    return None


def read(
    root: str | Path,
    *,
    cameras: Sequence[str] | None = None,
    crop_bottom: float = 0.0,
    hide_px: int = 8,
) -> list[Recording]:
    """Open a scene folder, one recording for each camera with images on disk.

    Args:
        root: the folder of the scene.
        cameras: names of the cameras to open. None = all that have images on disk; the others are reported.
        crop_bottom: fraction of the image height to cut off at the bottom, from image and depth (the car's bonnet moves
            with the camera and would be evidence for no motion). K does not change.
        hide_px: a return is occluded by one more than 10 % nearer within this many pixels: the LiDAR is mounted
            elsewhere and sees behind objects. 0 = only by one in the same pixel. Larger values also thin out the far
            road, whose depth grows by 10 % within few rows.

    Raises:
        FormatError: a missing or damaged file, no image, an unknown camera, or values that are no camera or pose.
    """
    root = Path(root)
    files.refuse_if(
        not 0 <= crop_bottom < 1, root, "option crop_bottom", crop_bottom, "a fraction of the height, 0 to less than 1"
    )
    scenes = sorted(root.glob("scene_*.json")) if root.is_dir() else []
    files.refuse_if(len(scenes) != 1, root, "scene_*.json", f"{len(scenes)} such files", "exactly one")
    shots = _read_shots(scenes[0])
    present = sorted({name for name, list_ in shots.items() if any((root / s.image).is_file() for s in list_)})
    unknown = sorted(set(cameras or ()) - set(present))
    files.refuse_if(
        unknown or not present, root, "cameras", ", ".join(unknown or ["no image"]), f"images of {', '.join(shots)}"
    )
    report = [f"{name}: no image on disk: left out" for name in shots if name not in present]
    options = {"crop_bottom": crop_bottom, "hide_px": hide_px}
    return [_make_recording(scenes[0], name, shots[name], report, **options) for name in cameras or present]


@dataclass(frozen=True, eq=False)
class _Shot:
    """One image with the LiDAR sweep of its instant, from the scene file."""

    number: int
    stamp: float  # s
    image: str
    sweep: str
    fields: tuple[str, ...]  # meaning of the columns of the sweep
    c2w: np.ndarray  # (4, 4) of the image
    lidar_to_world: np.ndarray  # (4, 4) of the sweep
    calibration: str
    hw: tuple[int, int]


def _load_frame(
    i: int,
    *,
    root: Path,
    shots: tuple[_Shot, ...],
    T_world_from_lidar: Pose,
    T_world_from_cam: Pose,
    cameras: tuple[Camera, ...],
    crop_bottom: float,
    hide_px: int,
) -> Frame:
    """Position → frame."""
    shot, camera = shots[i], cameras[i]
    image = torch.from_numpy(files.read_image(root / shot.image, shot.hw))
    T = se3.relative(T_world_from_lidar[i : i + 1], T_world_from_cam[i : i + 1])
    file, fields = root / shot.sweep, shot.fields
    data = npy.read_npz(file, "data")
    files.refuse_if(
        not {"X", "Y", "Z"} <= set(fields) or data.ndim != 2 or data.shape[1] != len(fields),
        file,
        "data",
        f"shape {data.shape}",
        f"points with columns {', '.join(fields)}",
    )
    points = np.ascontiguousarray(data[:, [fields.index(axis) for axis in "XYZ"]], dtype=np.float64)
    xyz = se3.apply(T, torch.from_numpy(points)[None])
    depth = convert.splat_depth(xyz[0], camera, shot.hw, hide_px)
    rows = shot.hw[0] - round(crop_bottom * shot.hw[0])
    return Frame(image[None, :, :rows].contiguous(), depth[None, :rows].contiguous(), camera)


def _make_recording(scene: Path, name: str, shots: list[_Shot], report: list[str], **options: Any) -> Recording:
    root = scene.parent
    complete = [s for s in shots if (root / s.image).is_file() and (root / s.sweep).is_file()]
    files.refuse_if(not complete, root, name, "no instant with image and sweep on disk", "at least one")
    report = report + [
        f"{name}: instant {s.number} lacks its image or its sweep: left out" for s in shots if s not in complete
    ]
    poses, lidar = (
        convert.to_poses(np.stack([getattr(s, key) for s in complete]), scene, f"{name} {key}")
        for key in ("c2w", "lidar_to_world")
    )
    cameras = tuple(_read_camera(root / "calibration" / f"{s.calibration}.json", name, s.hw) for s in complete)
    times = torch.tensor([s.stamp for s in complete], dtype=torch.float64)
    return Recording(
        name=f"{root.resolve().name}/{name}",
        format="driving",
        load=partial(
            _load_frame,
            root=root,
            shots=tuple(complete),
            T_world_from_lidar=lidar,
            T_world_from_cam=poses,
            cameras=cameras,
            **options,
        ),
        number=torch.tensor([s.number for s in complete]),
        root=root,
        times=times,
        poses=poses,
        rate_hz=float(1 / times.diff().median()) if len(complete) > 1 else None,
        sparse=True,
        report=tuple(report),
        camera_name=name,
    )


def _read_shots(scene: Path) -> dict[str, list[_Shot]]:
    """Camera name → its shots in the order of the samples."""
    top = files.read_json(scene)
    data = {files.get_entry(d, "key", str, scene): d for d in files.get_entry(top, "data", list, scene)}
    shots: dict[str, list[_Shot]] = {}
    for number, sample in enumerate(files.get_entry(top, "samples", list, scene)):
        calibration = files.get_entry(sample, "calibration_key", str, scene)
        keys = [key for key in files.get_entry(sample, "datum_keys", list, scene) if isinstance(key, str)]
        members = [data[key] for key in keys if key in data]
        kinds = [files.get_entry(d, "datum", dict, scene) for d in members]
        sweeps = [k["point_cloud"] for k in kinds if "point_cloud" in k]
        files.refuse_if(len(sweeps) != 1, scene, f"samples.{number}", f"{len(sweeps)} LiDAR sweeps", "one")
        for member, kind in zip(members, kinds, strict=True):
            if "image" in kind:
                name = files.get_entry(member, "id.name", str, scene)
                image = kind["image"]
                sweep = sweeps[0]
                stamp = files.get_entry(member, "id.timestamp", str, scene)
                try:
                    seconds = datetime.fromisoformat(stamp).timestamp()
                except (ValueError, OverflowError):
                    raise files.FormatError(scene, "id.timestamp", stamp, "an ISO 8601 time") from None
                shot = _Shot(
                    number=number,
                    stamp=seconds,
                    image=_check_relative_path(files.get_entry(image, "filename", str, scene), scene),
                    sweep=_check_relative_path(files.get_entry(sweep, "filename", str, scene), scene),
                    fields=tuple(map(str, files.get_entry(sweep, "point_format", list, scene))),
                    c2w=_parse_pose(image, scene),
                    lidar_to_world=_parse_pose(sweep, scene),
                    calibration=_check_relative_path(calibration, scene),
                    hw=(files.get_entry(image, "height", int, scene), files.get_entry(image, "width", int, scene)),
                )
                of_camera = shots.setdefault(name, [])
                files.refuse_if(
                    of_camera and of_camera[-1].number == number,
                    scene,
                    f"samples.{number}",
                    f"two images of {name}",
                    "one of each camera",
                )
                of_camera.append(shot)
    files.refuse_if(not shots, scene, "samples", "no image", "instants with camera images")
    return shots


def _parse_pose(datum: dict[str, Any], scene: Path) -> np.ndarray:
    rotation, translation = (
        files.get_entry(datum, f"pose.{part}", dict, scene) for part in ("rotation", "translation")
    )
    q = files.to_array([rotation.get(k) for k in ("qx", "qy", "qz", "qw")], (4,), scene, "pose.rotation")
    t = files.to_array([translation.get(k) for k in "xyz"], (3,), scene, "pose.translation")
    return convert.to_c2w(q[None], t[None], scene, "pose.rotation")[0]


def _read_camera(file: Path, name: str, hw: tuple[int, int]) -> Camera:
    calibration = files.read_json(file)
    names, intrinsics = (files.get_entry(calibration, key, list, file) for key in ("names", "intrinsics"))
    files.refuse_if(
        name not in names or len(names) != len(intrinsics),
        file,
        "names",
        ", ".join(map(str, names)),
        f"{name} among as many names as intrinsics",
    )
    entry = intrinsics[names.index(name)]
    fx, fy, cx, cy, skew = (files.get_entry(entry, key, (int, float), file) for key in ("fx", "fy", "cx", "cy", "skew"))
    return convert.to_camera([[fx, skew, cx], [0, fy, cy], [0, 0, 1]], hw, file, f"{name} intrinsics")


def _check_relative_path(name: str, scene: Path) -> str:
    """``name``, checked to be a relative path inside the scene's folder."""
    files.refuse_if(
        not name or Path(name).is_absolute() or ".." in Path(name).parts,
        scene,
        "filename",
        name,
        "a file inside the scene's folder",
    )
    return name
