"""Reader of ARKitScenes: an iPad's colour, LiDAR depth, confidence and poses, and depth rendered from a laser scan.

A capture is a folder of *assets*, each a folder of files ``<video id>_<seconds>.png`` with its own time stamps:
``lowres_wide``, ``vga_wide`` and ``wide`` (also called ``color``) are one camera at three sizes, ``lowres_depth`` and
``confidence`` the LiDAR, ``highres_depth`` the laser scan; ``<asset>_intrinsics`` holds ``.pincam`` lines
``width height fx fy cx cy``. ``lowres_wide.traj`` has ``seconds rx ry rz tx ty tz``, *world-to-camera*, at a sixth of
the frame rate. The world's z axis points up; images are stored in the sensor's orientation, often sideways.

The three downloads of one capture (``raw``, ``3dod``, ``upsampling``) complement each other: assets missing in ``root``
are taken from the same capture's folder in the other two, where these lie beside each other as downloaded.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dhtorch.data import convert
from dhtorch.data.clocks import interpolate_poses, nearest_stamps
from dhtorch.data.io import decode as files
from dhtorch.data.laser import resample_laser_depth
from dhtorch.data.recording import MeasuredRecording, Recording
from dhtorch.data.units import DepthUnit
from dhtorch.geometry.camera import resize
from dhtorch.records import Camera, Frame
from dhtorch.runtime.console import format_count

#: Colour assets and their folder names, in order of preference.
_COLOUR_ASSETS = {"lowres_wide": ("lowres_wide",), "vga_wide": ("vga_wide",), "wide": ("wide", "color")}

_SUBSETS, _SPLITS = ("raw", "3dod", "upsampling"), ("Training", "Validation")
_STAMP_PATTERN = re.compile(r"[^/]*_(\d{1,10}(?:\.\d{1,9})?)\.(png|pincam)")
_UNITS_PER_METRE = 1000.0

#: Largest difference in s of stamps of one instant: file names have milliseconds.
_SAME_INSTANT_S = 0.0011


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    assets = [name for names in _COLOUR_ASSETS.values() for name in names] + ["lowres_depth", "highres_depth"]
    present = [name for name in assets if any((place / name).is_dir() for place in _asset_folders(root)[:2])]
    distinctive = {"lowres_wide", "vga_wide", "lowres_depth", "highres_depth"}
    return f"ARKitScenes assets {', '.join(present)}" if len(present) > 1 and distinctive & {*present} else None


def read(
    root: str | Path,
    *,
    image: str | None = None,
    poses: bool = True,
    interpolate: bool = True,
    upright: bool = True,
    truth: bool = True,
    max_difference: float = 0.010,
    max_pose_difference: float = 0.005,
    max_pose_gap: float = 0.15,
    max_truth_gap: float = 0.080,
    max_disagreement: float = 0.05,
) -> list[Recording]:
    """Open one capture.

    The depth is ``lowres_depth`` with its confidence. Values are never reused from an earlier frame: images without
    depth close in time are left out and reported.

    Args:
        root: the capture's folder, named by its video id, or its ``<video id>_frames``.
        image: ``lowres_wide`` | ``vga_wide`` | ``wide``. None = the first of these that exists.
        poses: read the trajectory and leave out images that it does not cover. False keeps every image with depth.
            Captures without a trajectory (some have none) also keep every image, which is reported.
        interpolate: interpolate poses for images between two poses: position linear, rotation along the shortest arc.
            False keeps only images with a pose of their own.
        upright: rotate image, depth, confidence, intrinsics and pose by quarter turns so that the sky is on top, as
            determined from the poses (the table's ``sky_direction`` is unreliable and not read); without poses nothing
            is rotated.
        truth: use ``highres_depth`` as true depth, where available; the recording then has ``truth(i)``.
        max_difference: s, from image to depth, and to borrowed intrinsics. A little more than half a period at 60 Hz.
        max_pose_difference: s, from an image to its own pose.
        max_pose_gap: s, between two poses to interpolate in. Poses come at about 10 Hz: one lost pose is a gap.
        max_truth_gap: s, from image to laser depth.
        max_disagreement: median relative difference of laser and LiDAR over their common pixels beyond which a laser
            depth map is rejected. This limit is our choice: the paper reports only the values of its accepted maps.

    Returns:
        One recording at the stamps of the images, with ``truth(i)`` where there is laser depth. Captures may
        lack intrinsics of ``wide`` (unconfirmed): then those of another size of the same camera, nearest in time, are
        used, scaled exactly, which is reported.

    Raises:
        FormatError: a missing asset, no associated files, or a damaged file.
    """
    root = Path(root)
    limits = {"max_difference": max_difference, "max_pose_difference": max_pose_difference}
    limits |= {"max_pose_gap": max_pose_gap, "max_truth_gap": max_truth_gap, "max_disagreement": max_disagreement}
    for option, limit in limits.items():
        files.to_positive(limit, root, f"option {option}")
    places = _asset_folders(root)
    name, pictures = _choose_pictures(root, places, image)
    links, report = _match_assets(root, places, name, pictures.times, max_difference)
    has = {what: link.at >= 0 for what, link in links.items()}
    trajectory = _find_folder(places, "lowres_wide.traj") if poses else None
    if poses and trajectory is None:
        report.append("no lowres_wide.traj: frames have no pose and are not rotated")
    c2w = np.eye(4)[None]
    if trajectory is not None:
        gap = max_pose_gap if interpolate else 0.0
        c2w, has["a pose"] = _read_poses(trajectory, pictures.times, max_pose_difference, gap)
    if (lost := _count_lost_pictures(pictures.times, links["depth"])) > 0:
        report.append(f"{format_count(lost, 'depth map')} without a picture: left out")
    kept = _select_complete(root, name, has, report)
    turns, c2w = 0, c2w[kept] if trajectory else c2w
    if upright and trajectory:
        turns = _count_quarter_turns(c2w, report)
    chosen = {what: tuple(link.stamped.files[j] for j in link.at[kept]) for what, link in links.items()}
    load = _Load(
        images=tuple(pictures.files[i] for i in kept),
        pincams=chosen.get("intrinsics") or chosen["borrowed intrinsics"],
        borrowed="intrinsics" not in chosen,
        depths=chosen["depth"],
        depth_pincams=chosen.get("intrinsics of the depth"),
        confs=chosen.get("confidence"),
        turns=turns,
    )
    times = pictures.times[kept]
    fields: dict[str, Any] = {"name": _video_id(root), "format": "arkitscenes", "root": root, "load": load}
    fields |= {"number": torch.from_numpy(kept), "times": torch.from_numpy(times)}
    fields |= {"rate_hz": float(1 / np.median(np.diff(times))) if len(times) > 1 else None}
    fields |= {"depth_unit": DepthUnit(1 / _UNITS_PER_METRE, "ARKitScenes stores mm")}
    if trajectory:
        fields["poses"] = convert.to_poses(convert.rot90_pose(c2w, turns), trajectory)
    laser = _list_asset_files(places, ("highres_depth",), "png") if truth else None
    if laser is None:
        return [Recording(**fields, report=tuple(report))]
    depths, pincams = _match_laser(places, laser, times, max_truth_gap)
    load_truth = partial(_load_truth, load=load, depths=depths, pincams=pincams, max_disagreement=max_disagreement)
    if (n_without := depths.count(None)) > 0:
        missing = format_count(n_without, "frame")
        report.append(f"{missing} without laser depth within {max_truth_gap} s: no ground truth")
    return [MeasuredRecording(**fields, load_truth=load_truth, report=tuple(report))]


# ---------------------------------------------------------------------------------------------------------- one frame


@dataclass(frozen=True, eq=False)
class _Load:
    """Position → frame."""

    images: tuple[Path, ...]
    pincams: tuple[Path, ...]
    borrowed: bool  # the pincams are those of another size of the same camera
    depths: tuple[Path, ...]
    depth_pincams: tuple[Path, ...] | None  # None = the camera of the image, scaled
    confs: tuple[Path, ...] | None
    turns: int

    def __call__(self, i: int) -> Frame:
        hw, camera = self.view(i)
        image = torch.from_numpy(files.read_image(self.images[i], hw))
        depth, depth_camera = self.sensor(i)
        depth_hw = (depth.shape[0], depth.shape[1])
        conf = None
        if self.confs is not None:
            level = files.read_image(self.confs[i], depth_hw)
            if level.shape[0] != 1 or level.max() > 2:
                problem = f"{level.shape[0]} channels up to {level.max()}"
                raise files.FormatError(self.confs[i], "confidence", problem, "1 channel of 0, 1 or 2")
            conf = torch.from_numpy(level[0])
        return Frame(
            image=convert.rot90_image(image, self.turns)[None],
            depth=convert.rot90_image(depth, self.turns)[None],
            camera=convert.rot90_camera(camera, hw, self.turns),
            depth_camera=depth_camera and convert.rot90_camera(depth_camera, depth_hw, self.turns),
            conf=None if conf is None else convert.rot90_image(conf, self.turns)[None],
        )

    def view(self, i: int) -> tuple[tuple[int, int], Camera]:
        """Size and camera of image ``i`` as stored."""
        hw, camera = _read_pincam(self.pincams[i])
        if not self.borrowed:
            return hw, camera
        own = files.read_image_header(self.images[i]).hw
        return own, resize(camera, hw, own)

    def sensor(self, i: int) -> tuple[Tensor, Camera | None]:
        """LiDAR depth of frame ``i`` as stored, and its camera."""
        hw, camera = (None, None) if self.depth_pincams is None else _read_pincam(self.depth_pincams[i])
        return torch.from_numpy(files.read_depth_png(self.depths[i], _UNITS_PER_METRE, hw)), camera


def _load_truth(
    i: int,
    *,
    load: _Load,
    depths: tuple[Path | None, ...],
    pincams: tuple[Path | None, ...],  # None = the camera of the image, scaled
    max_disagreement: float,
) -> tuple[Tensor, float]:
    """Position → laser depth at the pixels of the image, and its disagreement with the LiDAR."""
    (hw, camera), file, pincam = load.view(i), depths[i], pincams[i]
    depth, disagreement = torch.zeros(hw), float("nan")
    if file is not None:
        laser_hw, laser_camera = (None, None) if pincam is None else _read_pincam(pincam)
        laser = torch.from_numpy(files.read_depth_png(file, _UNITS_PER_METRE, laser_hw))
        sensor, sensor_camera = load.sensor(i)
        laser_camera = laser_camera or resize(camera, hw, (laser.shape[0], laser.shape[1]))
        sensor_camera = sensor_camera or resize(camera, hw, (sensor.shape[0], sensor.shape[1]))
        depth, disagreement = resample_laser_depth(
            laser, laser_camera, sensor, sensor_camera, camera, hw, max_disagreement
        )
    return convert.rot90_image(depth, load.turns), disagreement


def _read_pincam(file: Path) -> tuple[tuple[int, int], Camera]:
    """(h, w) of the images that the intrinsics refer to, and the camera."""
    rows = files.read_table(file, 6)
    w, h, fx, fy, cx, cy = files.to_array(rows[0] if len(rows) == 1 else None, (6,), file, "intrinsics").tolist()
    files.refuse_if(
        min(w, h) < 1 or w * h > files.MAX_PIXELS or w % 1 or h % 1,
        file,
        "width and height",
        f"{w:g} {h:g}",
        "the size of an image",
    )
    hw = (int(h), int(w))
    return hw, convert.to_camera(convert.make_K(fx, fy, cx, cy), hw, file, "intrinsics")


# --------------------------------------------------------------------------------------------- files and time stamps


class _AssetFiles(NamedTuple):
    """Files of one asset with their time stamps."""

    times: np.ndarray  # (n,) s, strictly increasing
    files: tuple[Path, ...]


class _AssetMatch(NamedTuple):
    """For each image the matching file of another asset."""

    stamped: _AssetFiles
    at: np.ndarray  # index of the file, −1 = none


def _video_id(root: Path) -> str:
    return root.resolve().name.removesuffix("_frames")


def _asset_folders(root: Path) -> list[Path]:
    """Folders that may contain assets of the capture: its own two, then those of the other downloads."""
    frames, resolved = f"{_video_id(root)}_frames", root.resolve()
    capture = resolved.parent if resolved.name == frames and resolved.parent.name == _video_id(root) else resolved
    places, split = [root, root / frames], capture.parent
    if split.name in _SPLITS and split.parent.name in _SUBSETS:
        others = [split.parent.parent / subset / split.name / capture.name for subset in _SUBSETS]
        places += [place for other in others if other != capture for place in (other, other / frames)]
    return places


def _find_folder(places: Sequence[Path], *names: str) -> Path | None:
    """The first existing path ``place / name``, by order of ``places``; None if there is none."""
    return next((place / name for place in places for name in names if (place / name).exists()), None)


def _list_asset_files(places: Sequence[Path], names: Sequence[str], suffix: str) -> _AssetFiles | None:
    """Files of an asset sorted by the time stamp in their names (alphabetically, 100.0 comes before 99.9)."""
    folder = _find_folder(places, *names)
    by_stamp: dict[float, Path] = {}
    for entry in sorted(folder.iterdir()) if folder is not None and folder.is_dir() else ():
        if (match := _STAMP_PATTERN.fullmatch(entry.name)) and match[2] == suffix:
            by_stamp.setdefault(float(match[1]), entry)
    times = sorted(by_stamp)
    return _AssetFiles(np.array(times), tuple(by_stamp[t] for t in times)) if times else None


def _choose_pictures(root: Path, places: Sequence[Path], image: str | None) -> tuple[str, _AssetFiles]:
    files.refuse_if(
        image not in (None, *_COLOUR_ASSETS), root, "option image", image, f"one of {', '.join(_COLOUR_ASSETS)}"
    )
    for name in (image,) if image else _COLOUR_ASSETS:
        if (pictures := _list_asset_files(places, _COLOUR_ASSETS[name], "png")) is not None:
            return name, pictures
    raise files.FormatError(root, image or "images", "none", "<video id>_<seconds>.png in a folder of that name")


def _match_assets(
    root: Path, places: Sequence[Path], name: str, times: np.ndarray, max_difference: float
) -> tuple[dict[str, _AssetMatch], list[str]]:
    """Name for the report → matches of each image with the files of another asset, and the report."""
    report = []
    depths = _list_asset_files(places, ("lowres_depth",), "png")
    if depths is None:
        raise files.FormatError(root, "lowres_depth", "none", "<video id>_<seconds>.png in a folder of that name")
    depth = nearest_stamps(times, depths.times, max_difference)
    links = {"depth": _AssetMatch(depths, depth)}
    if (confs := _list_asset_files(places, ("confidence",), "png")) is None:
        report.append("no confidence: all returns are weighted equally")
    else:
        links["confidence"] = _AssetMatch(
            confs, np.where(depth < 0, -1, nearest_stamps(depths.times[depth], confs.times, _SAME_INSTANT_S))
        )
    own = _list_asset_files(places, [f"{folder}_intrinsics" for folder in _COLOUR_ASSETS[name]], "pincam")
    lowres = _list_asset_files(places, ("lowres_wide_intrinsics",), "pincam")
    pincams = own or _list_asset_files(places, ("vga_wide_intrinsics",), "pincam") or lowres
    if pincams is None:
        raise files.FormatError(
            root, f"{name}_intrinsics", "none, also of no other size", "<video id>_<seconds>.pincam"
        )
    if own is not None:
        links["intrinsics"] = _AssetMatch(own, nearest_stamps(times, own.times, _SAME_INSTANT_S))
    else:
        report.append(f"no {name}_intrinsics: {pincams.files[0].parent.name}, scaled")
        links["borrowed intrinsics"] = _AssetMatch(pincams, nearest_stamps(times, pincams.times, max_difference))
    if lowres is not None and name != "lowres_wide":
        links["intrinsics of the depth"] = _AssetMatch(lowres, nearest_stamps(times, lowres.times, max_difference))
    return links, report


def _count_lost_pictures(times: np.ndarray, depth: _AssetMatch) -> int:
    """Unmatched depth maps where pictures are missing: in gaps of their times that are longer than their usual step.

    Pictures at a lower rate than depth leave depth maps unmatched everywhere, which is no loss.
    """
    if len(times) < 3:
        return 0
    unmatched = np.delete(depth.stamped.times, depth.at[depth.at >= 0])
    gaps, after = np.diff(times), np.searchsorted(times, unmatched)
    inside = (after > 0) & (after < len(times))
    # A gap of one and a half median steps: a picture is missing.
    return int((gaps[after[inside] - 1] > 1.5 * np.median(gaps)).sum())


def _select_complete(root: Path, name: str, has: dict[str, np.ndarray], report: list[str]) -> np.ndarray:
    """Indices of the images with all matches; the report counts the images without each."""
    keep = np.ones_like(has["depth"])
    for what, mask in has.items():
        if (lost := int((keep & ~mask).sum())) > 0:
            report.append(f"{format_count(lost, 'image')} without {what}: left out")
        keep &= mask
    files.refuse_if(
        not keep.any(), root, f"frames of {name}", "; ".join(report), "images with depth, intrinsics and pose"
    )
    return np.flatnonzero(keep)


def _match_laser(
    places: Sequence[Path], laser: _AssetFiles, times: np.ndarray, max_gap: float
) -> tuple[tuple[Path | None, ...], tuple[Path | None, ...]]:
    """Laser depth and its intrinsics for each time, None where there are none."""
    at = nearest_stamps(times, laser.times, max_gap)
    depths = tuple(laser.files[j] if j >= 0 else None for j in at)
    pincams: tuple[Path | None, ...] = (None,) * len(at)
    if (wide := _list_asset_files(places, ("wide_intrinsics", "color_intrinsics"), "pincam")) is not None:
        own = nearest_stamps(laser.times[at], wide.times, _SAME_INSTANT_S)
        pincams = tuple(wide.files[k] if j >= 0 and k >= 0 else None for j, k in zip(at, own, strict=True))
    return depths, pincams


def _read_poses(file: Path, times: np.ndarray, max_difference: float, max_gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Camera-to-world matrices (n, 4, 4) at ``times``, and the mask (n,) of covered times."""
    rows = files.read_table(file, 7)
    rows = rows[np.isfinite(rows).all(-1)]
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    files.refuse_if(len(rows) == 0, file, "poses", "no usable row", "rows of stamp, rotation vector and translation")
    q = convert.to_quaternions(rows[:, 1:4])
    R = convert.to_c2w(q, rows[:, 4:], file, "rotation")[:, :3, :3]  # world to camera
    centre = -np.einsum("nji,nj->ni", R, rows[:, 4:])
    inverse = q * [-1, -1, -1, 1]
    # Stamps that are rounded to milliseconds differ by up to half of one.
    limits = {"same": 0.00051, "max_difference": max_difference, "max_gap": max_gap}
    q_at, t_at, covered = interpolate_poses(times, rows[:, 0], inverse, centre, **limits)
    return convert.to_c2w(q_at, t_at, file, "rotation"), covered


def _count_quarter_turns(c2w: np.ndarray, report: list[str]) -> int:
    """Number of clockwise quarter turns that put the sky on top, from the mean gravity over the frames."""
    x, y, _ = c2w[:, 2, :3].mean(0)  # the world's up direction in camera axes
    # The mean gravity direction's projection onto the image plane is too short to show a side.
    if max(abs(x), abs(y)) < 0.1:
        report.append("the camera looks straight up or down: images are not rotated")
        return 0
    if abs(x) > abs(y):
        return 1 if x < 0 else 3
    return 0 if y < 0 else 2
