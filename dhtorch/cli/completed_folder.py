"""Folder of completed frames: shared metadata, list of complete frames, reading of their maps.

A frame is a file in each of ``depth/``, ``sigma/``, ``source/`` and, written last, ``meta/``: a frame with a meta file
is complete. ``complete.json`` holds what all frames of a folder share. File layouts:

- ``frames``: ``images/`` and ``depth/`` by frame number, ``K.txt``, ``poses.txt``, ``meta.json`` (unit, times, K of
  every frame); steps of 1 mm, of 5 mm where the sensor is a LiDAR of a car. Read by ``frames_dir``.
- ``tum``: ``rgb/`` and ``depth/`` by time stamp, ``groundtruth.txt``, ``calibration.txt``, ``meta.json`` (unit); steps
  of 0.2 mm, so that it ends at 13.1 m.
- ``stray``: ``depth/`` and ``confidence/`` (2 the sensor, 1 swept, 0 no answer) by frame number, the capture's own
  tables and video; steps of 1 mm.
- ``png``: the maps alone, as ``frames``.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dhtorch import export
from dhtorch.codes import Gate, Source, count_kinds, names
from dhtorch.data.io import decode as data_files
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene
from dhtorch.export.frames import MAX_DEPTH_CODE, SIGMA_STEPS_PER_DEPTH_STEP
from dhtorch.geometry.camera import from_matrix
from dhtorch.metrics.holdout import range_split
from dhtorch.ops import loader
from dhtorch.pipeline.method import Method
from dhtorch.records import Camera, Frame
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage
from dhtorch.runtime.output_folder import is_whole, open_output_folder

Row = dict[str, Any]

#: Version of the file format; increased when older readers would misread the files.
_FORMAT_VERSION = 1

#: Folder of derived files → their suffixes.
EXTRA_FILES = {"figures": (".png",), "previews": (".jpg",), "points": (".ply", ".glb")}


#: Depth step for sparse long-range sensors, whose range exceeds that of millimetre steps, m.
_SPARSE_DEPTH_STEP_M = 0.005

#: codes.Source → confidence value of a Stray capture.
STRAY_CONFIDENCE = dict.fromkeys(names(Source), 1) | {Source.NONE: 0, Source.SENSOR: 2}

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
        extra = [kind for kind in ("confidence", "arrays", "budget") if getattr(self, kind)]
        return ["depth", "sigma", "source", *filter(None, [self.pictures]), *extra, "meta"]

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
            # Frames per second where frame number / rate equals the time stamps
            rate, times = recording.rate_hz, recording.times
            is_regular = (
                rate is not None and times is not None and torch.allclose(recording.number.double() / rate, times)
            )
            timed: dict[str, Any] = (
                {"fps": rate} if is_regular else {"times": None if times is None else times[list(frames)].tolist()}
            )
            export.write_frames_dir_metadata(folder, _read_cameras(rows), poses, unit=self.unit, **timed)
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
    lacks = {name: _find_lack(name, recording, same) for name in names}
    if lacks[names[-1]]:
        raise ValueError(f"format={wanted}: {recording.name} {lacks[names[-1]]}; use format=auto")
    layout = FRAME_LAYOUTS[next(name for name, lack in lacks.items() if not lack)]
    if layout.name == "stray" and unit not in (None, layout.unit):
        raise ValueError(f"unit: found {unit}, expected {layout.unit} m, the only unit of format=stray")
    if recording.sparse and layout.name in ("frames", "png"):
        layout = replace(layout, unit=_SPARSE_DEPTH_STEP_M)
    return replace(layout, unit=layout.unit if unit is None else unit, arrays=arrays, budget=budget)


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


@dataclass(frozen=True)
class CompletionTask:
    """The frames of one scene to be completed, and how they are written."""

    scene: Scene
    folder: Path
    layout: Layout
    method: Method
    settings: Mapping[str, Any]
    frames: Sequence[int]  # positions
    offers: Mapping[int, Sequence[int]]  # position → candidate source views
    shared: Row  # complete.json
    done: dict[str, Row] = field(default_factory=dict)  # name of a complete frame → its meta file

    @property
    def recording(self) -> Recording:
        """The scene's recording."""
        return self.scene.recording

    def load(self, i: int) -> Frame:
        """Frame ``i`` in the chosen dtype and device, returns beyond the cutoff hidden."""
        return load_frame(self.scene, self.settings, i)

    def name(self, i: int) -> str:
        """Stem of the file names of frame ``i``."""
        return self.layout.stem(self.recording, i)

    def extras(self, i: int) -> list[Path]:
        """Requested figure and point files of frame ``i``: of all frames, or of the first one with a source view."""
        first = next((k for k in self.frames if k in self.offers), self.frames[0])
        chosen = {kind: self.settings.get(kind, False) for kind in EXTRA_FILES}
        kinds = [kind for kind, which in chosen.items() if which == "all" or (which and i == first)]
        return [self.folder / kind / f"{self.name(i)}{end}" for kind in kinds for end in EXTRA_FILES[kind]]

    def map_files(self, i: int) -> list[Path]:
        """Files of the maps of frame ``i``."""
        return [self.layout.file(self.folder, kind, self.name(i)) for kind in self.layout.folders]

    def missing(self, i: int) -> bool:
        """Whether a file of frame ``i`` is missing."""
        return self.name(i) not in self.done or not all(map(is_whole, self.extras(i)))


def build_shared_metadata(
    scene: Scene,
    layout: Layout,
    settings: Mapping[str, Any],
    digest: str,
    *,
    keyed: Sequence[str],
    roots: Sequence[str],
    calibration: str | None,
    **more: str,
) -> Row:
    """Metadata shared by all frames of a scene, with their key: a hash of the options ``keyed``, the code of ``roots``
    (modules), the data digest, and ``more`` (which separates the files of different commands)."""
    config = {k: settings[k] for k in keyed} | {"scene": scene.name, "format": layout.name, "unit": layout.unit}
    run_metadata = result_files.collect_run_metadata(
        device="cpu", dtype=settings["dtype"], threads=1, seed=settings["seed"], operators=loader.describe_operators()
    )
    name = settings["choices"]["data"]
    metadata: Row = storage.to_strict_json(
        {
            "format": _FORMAT_VERSION,
            "scene": scene.name,
            "layout": layout.name,
            "unit_m": layout.unit,
            "sigma_unit_m": layout.sigma_unit,
            "reach_m": layout.reach,
            "version": run_metadata["versions"]["dhtorch"],
            "git": run_metadata["git"],
            "operators": run_metadata["operators"],
            "method": settings["choices"]["method"],
            "calibration": calibration,
            "key": result_files.compute_result_key({**config, "files": _FORMAT_VERSION, **more}, digest, roots=roots),
            "config": result_files.make_portable(config),
            "data": {"name": name, "digest": digest, "notes": list(scene.recording.report)},
            "codes": {"source": names(Source), "gate": names(Gate)},
        }
    )
    return metadata


def digest_scene_files(
    scene: Scene, settings: Mapping[str, Any], out: Path, more: Mapping[str, Path | str] | None = None
) -> str:
    """Digest of all data files outside the output folder, and of ``more``, as for ``compute_data_digest``."""
    files: dict[str, Path | str] = {
        **result_files.list_files_below([(scene.root, scene.recording.bounds)]),
        **result_files.list_files_named({k: settings[k] for k in ("data", "method")}),
    }
    output = out.resolve()
    outside = {k: p for k, p in files.items() if isinstance(p, str) or not p.resolve().is_relative_to(output)}
    return result_files.compute_data_digest({**outside, **(more or {})})


@contextlib.contextmanager
def open_task_folder(task: CompletionTask, more: Iterable[str] = ()) -> Iterator[None]:
    """Context in which the output folder of a task is written: its complete frames are registered, and the files of
    incomplete frames, left by a killed run, are removed.

    Args:
        task: whose folder is opened.
        more: names of the files that the command writes beside those of the layout.

    Raises:
        FileExistsError: the folder holds other files, or a link or a foreign file is in the way; the message names it.
        BlockingIOError: another process writes there.
        NotADirectoryError: the path is a file.
    """
    shared_file, extras = task.folder / "complete.json", [kind for kind in EXTRA_FILES if task.settings.get(kind)]
    with open_output_folder(task.folder, "out") as folder:
        result_files.check_same_run(task.folder, shared_file, task.shared, "complete")
        task.done.update(read_complete_frames(task))
        # Of every frame all files that it can have
        ends = [(kind, end) for kind, suffixes in EXTRA_FILES.items() for end in suffixes]
        files = {
            task.name(i): [*task.map_files(i), *(task.folder / kind / f"{task.name(i)}{end}" for kind, end in ends)]
            for i in range(len(task.recording))
        }
        if folder.is_unlisted and shared_file.is_file():  # of an older version, without a manifest, with this key
            folder.adopt([*task.folder.iterdir(), *(path for name in task.done for path in files.get(name, ()))])
        folder.check_folders(task.folder / kind for kind in (*task.layout.folders, *extras))
        folder.check(task.folder / name for name in ("complete.json", *task.layout.side_files, *more))
        for i in task.frames:
            if task.name(i) not in task.done:
                folder.check(task.map_files(i))
            folder.check(path for path in task.extras(i) if not (path.is_file() and folder.lists(path)))
        for path in (path for name in files.keys() - task.done for path in files[name]):
            folder.remove(path)
        yield


def read_complete_frames(task: CompletionTask) -> dict[str, Row]:
    """Name -> meta row of the complete frames."""
    rows: dict[str, Row] = {}
    for path in sorted((task.folder / "meta").glob("*.json")):
        # Left out where a file is missing, invalid or of another key
        if all(is_whole(task.layout.file(task.folder, kind, path.stem)) for kind in task.layout.folders):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                row = storage.parse_strict_json(storage.read_utf8(path))
                if row["key"] == task.shared["key"]:
                    rows[path.stem] = row
    return rows


def load_frame(scene: Scene, settings: Mapping[str, Any], i: int) -> Frame:
    """Frame ``i`` of a scene in the chosen dtype and device, returns beyond the cutoff hidden."""
    frame = scene.recording[i].to(getattr(torch, settings["dtype"])).to(settings["device"])
    if 0 in frame.hw:
        raise ValueError(f"{scene.name}: found frames without images, expected images (data.images=true)")
    return range_split(frame, settings["cutoff"])


def read_completed_maps(task: CompletionTask, i: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Files of a complete frame -> ``depth`` and ``sigma`` (h, w) in m, and ``source`` (h, w)."""
    layout, name = task.layout, task.name(i)
    maps = {
        kind: data_files.read_depth_png(layout.file(task.folder, kind, name), 1 / unit)
        for kind, unit in (("depth", layout.unit), ("sigma", layout.sigma_unit))
    }
    return maps, data_files.read_image(layout.file(task.folder, "source", name))[0]


def count_pixels(row: Row) -> dict[str, int]:
    """Numbers of pixels by kind, see :data:`dhtorch.codes.SOURCES_OF_KIND`, of a meta row."""
    return count_kinds({code: row["pixels"].get(name.lower(), 0) for code, name in names(Source).items()})
