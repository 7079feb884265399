"""File layouts of ``dhtorch complete``: folders, file names, depth units, and the files a reader needs beside them.

- ``frames``: ``images/`` and ``depth/`` by frame number, ``K.txt``, ``poses.txt``, ``meta.json`` (unit, times, K of
  every frame); steps of 1 mm, of 5 mm where the sensor is a LiDAR of a car. Read by ``frames_dir``.
- ``tum``: ``rgb/`` and ``depth/`` by time stamp, ``groundtruth.txt``, ``calibration.txt``, ``meta.json`` (unit); steps
  of 0.2 mm, so that it ends at 13.1 m.
- ``stray``: ``depth/`` and ``confidence/`` (2 the sensor, 1 swept, 0 no answer) by frame number, the capture's own
  tables and video; steps of 1 mm.
- ``png``: the maps alone, as ``frames``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dhtorch import export
from dhtorch.codes import Source, names
from dhtorch.data.recording import Recording
from dhtorch.export.frames import MAX_DEPTH_CODE, SIGMA_STEPS_PER_DEPTH_STEP
from dhtorch.geometry.camera import from_matrix
from dhtorch.records import Camera
from dhtorch.runtime import storage

#: What the meta file of a frame holds.
Row = Mapping[str, Any]

#: Depth step for sparse long-range sensors, whose range exceeds that of millimetre steps, m.
_SPARSE_DEPTH_STEP_M = 0.005

#: codes.Source → confidence value of a Stray capture.
_STRAY_CONFIDENCE = dict.fromkeys(names(Source), 1) | {Source.NONE: 0, Source.SENSOR: 2}

#: Files of a Stray capture that do not depend on its depth.
_STRAY_FILES = ("odometry.csv", "camera_matrix.csv", "rgb.mp4")

#: Layout → names of the files beside the folders of its frames.
_SIDE_FILES = {
    "frames": ("K.txt", "meta.json", "poses.txt"),
    "tum": ("meta.json", "calibration.txt", "groundtruth.txt"),
    "stray": _STRAY_FILES,
}

#: Kind of file → suffix; ``.png`` otherwise.
_FILE_SUFFIXES = {"meta": ".json", "arrays": ".npz"}


@dataclass(frozen=True)
class Layout:
    """File names, folders and depth step."""

    name: str
    unit: float  # m
    pictures: str | None = None  # folder of the pictures
    stamped: bool = False  # named by time instead of number
    confidence: bool = False
    arrays: bool = False
    budget: bool = False

    @property
    def folders(self) -> list[str]:
        """Folders of a frame's files in the order of writing."""
        optional = {"confidence": self.confidence, "arrays": self.arrays, "budget": self.budget}
        extra = [kind for kind, is_written in optional.items() if is_written]
        return ["depth", "sigma", "source", *([self.pictures] if self.pictures else []), *extra, "meta"]

    @property
    def sigma_unit(self) -> float:
        """Step of sigma, m."""
        return self.unit / SIGMA_STEPS_PER_DEPTH_STEP

    @property
    def reach(self) -> float:
        """Largest depth that fits the 16 bits, m."""
        return self.unit * MAX_DEPTH_CODE

    @property
    def side_files(self) -> tuple[str, ...]:
        """Names of the files that :meth:`close` may write."""
        return _SIDE_FILES.get(self.name, ())

    def stem(self, recording: Recording, i: int) -> str:
        """Stem of the file names of a frame."""
        if self.stamped and recording.times is not None:
            return f"{float(recording.times[i]):.6f}"
        return f"{int(recording.number[i]):06d}"

    def file(self, folder: Path, kind: str, stem: str) -> Path:
        """Path of one file of a frame."""
        return folder / kind / f"{stem}{_FILE_SUFFIXES.get(kind, '.png')}"

    def close(self, folder: Path, recording: Recording, frames: Sequence[int], rows: Sequence[Row]) -> None:
        """Write the camera, pose and time files that make ``frames`` (positions; metadata ``rows``) a recording."""
        poses = None if recording.poses is None else recording.poses[torch.tensor(frames)]
        if self.name == "frames" and poses is not None:
            fps = _frame_rate(recording)
            times = None if fps is not None or recording.times is None else recording.times[list(frames)].tolist()
            export.write_frames_dir_metadata(folder, _read_cameras(rows), poses, unit=self.unit, fps=fps, times=times)
        elif self.name == "tum":
            stamps = [self.stem(recording, i) for i in frames]
            export.write_tum_metadata(folder, _read_cameras(rows[:1]), stamps, poses, unit=self.unit)
        elif self.name == "stray" and recording.root is not None:
            for name in _STRAY_FILES:
                storage.copy_file(recording.root / name, folder / name)


FRAME_LAYOUTS = {
    "frames": Layout("frames", 0.001, pictures="images"),
    "tum": Layout("tum", 0.0002, pictures="rgb", stamped=True),
    "stray": Layout("stray", 0.001, confidence=True),
    "png": Layout("png", 0.001),
}

#: Format of a recording → its own layout; ``frames`` for all others.
_LAYOUT_OF_FORMAT = {"tum": "tum", "stray": "stray"}


def select_layout(
    recording: Recording,
    wanted: str,
    unit: float | None,
    *,
    same: bool,
    arrays: bool = False,
    budget: bool = False,
) -> Layout:
    """The layout for the maps of a recording.

    Args:
        recording: whose frames are completed.
        wanted: a name of ``FRAME_LAYOUTS``, or ``auto``: the recording's own, else ``frames``, else ``png``.
        unit: m, a step of depth. None = the layout's own.
        same: whether the maps have the size of the images.
        arrays: whether NPZ files are written as well.
        budget: whether maps of the largest cause of sigma are.

    Raises:
        ValueError: the layout cannot hold this recording, or its reader takes another unit.
    """
    names = [_LAYOUT_OF_FORMAT.get(recording.format, "frames"), "frames", "png"] if wanted == "auto" else [wanted]
    missing = {name: _find_lack(name, recording, same) for name in names}
    if missing[names[-1]]:
        raise ValueError(f"format={wanted}: {recording.name} {missing[names[-1]]}; use format=auto")
    layout = FRAME_LAYOUTS[next(name for name in names if not missing[name])]
    if layout.name == "stray" and unit not in (None, layout.unit):
        raise ValueError(f"unit: found {unit}, expected {layout.unit} m, the only unit of format=stray")
    if recording.sparse and layout.name in ("frames", "png"):
        layout = replace(layout, unit=_SPARSE_DEPTH_STEP_M)
    return replace(layout, unit=layout.unit if unit is None else unit, arrays=arrays, budget=budget)


def stray_confidence(source: np.ndarray) -> np.ndarray:
    """codes.Source (any shape) -> confidence of a Stray capture, uint8."""
    table = np.zeros(max(_STRAY_CONFIDENCE) + 1, np.uint8)
    table[list(_STRAY_CONFIDENCE)] = list(_STRAY_CONFIDENCE.values())
    return table[source]


def has_varying_camera(rows: Sequence[Row]) -> bool:
    """Whether the intrinsics differ between frames."""
    return any((row["K"], row["distortion"]) != (rows[0]["K"], rows[0]["distortion"]) for row in rows)


def _find_lack(name: str, recording: Recording, same: bool) -> str | None:
    """The reason a recording does not fit a layout, None where it fits."""
    if name == "frames":
        poses = recording.poses
        has_poses = poses is not None and bool(poses.t.isfinite().all() and poses.R.isfinite().all())
        return None if has_poses else "has no pose for every frame"
    if name == "tum" and recording.times is None:
        return "has no time stamps"
    if name == "tum" and not same:
        return "has images larger than its maps (see size=)"
    if name == "stray" and recording.format != "stray":
        return f"is a {recording.format} recording, not a Stray Scanner capture"
    return None


def _read_cameras(rows: Sequence[Row]) -> Camera:
    """Metadata rows -> cameras of their maps."""
    lens = None if rows[0]["distortion"] is None else torch.tensor([row["distortion"] for row in rows])
    return from_matrix(torch.tensor([row["K"] for row in rows]), lens)


def _frame_rate(recording: Recording) -> float | None:
    """Frames per second where frame number / rate equals the time stamps, else None."""
    rate, times = recording.rate_hz, recording.times
    is_regular = rate is not None and times is not None and torch.allclose(recording.number.double() / rate, times)
    return rate if is_regular else None
