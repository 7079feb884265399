"""``dhtorch complete``: every frame of a recording with depth and sigma from the sensor or from other views.

A frame is a file in each of ``depth/``, ``sigma/``, ``source/`` and, written last, ``meta/``: a frame with a meta file
is complete. ``complete.json`` holds what all frames of a folder share, and the folder is a recording again, in the
capture's own format where that can hold the maps. A second run of the command makes only the missing frames. Layouts:

- ``frames``: ``images/`` and ``depth/`` by frame number, ``K.txt``, ``poses.txt``, ``meta.json`` (unit, times, K of
  every frame); steps of 1 mm, of 5 mm where the sensor is a LiDAR of a car. Read by ``frames_dir``.
- ``tum``: ``rgb/`` and ``depth/`` by time stamp, ``groundtruth.txt``, ``calibration.txt``, ``meta.json`` (unit); steps
  of 0.2 mm, so that it ends at 13.1 m.
- ``stray``: ``depth/`` and ``confidence/`` (2 the sensor, 1 swept, 0 no answer) by frame number, the capture's own
  tables and video; steps of 1 mm.
- ``png``: the maps alone, as ``frames``.
"""

import contextlib
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from dhtorch import export
from dhtorch.cli.option_checks import validate_choices
from dhtorch.codes import SOURCES_OF_KIND, Gate, Source, count_kinds, is_estimated, is_recovered, names, words
from dhtorch.data.io import decode as data_files
from dhtorch.data.pairs import by_choice
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene, scenes_of
from dhtorch.export.frames import MAX_DEPTH_CODE, SIGMA_STEPS_PER_DEPTH_STEP
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.metrics.holdout import range_split
from dhtorch.ops import loader
from dhtorch.pipeline import dense
from dhtorch.pipeline.completion import complete_depth, default_calibration
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import with_sensor
from dhtorch.pipeline.spec import Trace
from dhtorch.pipeline.view_report import report_selection, with_view_selection
from dhtorch.pytree import stack
from dhtorch.records import Camera, DepthMap, Frame
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage
from dhtorch.runtime.console import Progress, format_count
from dhtorch.runtime.output_folder import is_whole, open_output_folder
from dhtorch.viz.plots import append_cutoff, draw_completed, format_frame

Row = dict[str, Any]

#: Options that determine the content of a frame's files, beside the resolved format and unit; they enter the key.
_KEY_OPTIONS = ("data", "method", "seed", "dtype", "cutoff", "steps", "past", *dense.DENSE_OPTIONS, "arrays")
#: Further ones, which enter it only where they are set.
_SET_KEY_OPTIONS = ("budget", "sensor")

#: Pixels per inch of the figures of ``previews/``, about 1000 px wide. Source: chosen for an eighth of a figure's size.
_PREVIEW_DPI = 100.0

#: Sources whose number of pixels is in every meta file; that of others is left out where it is 0.
_COUNTED_SOURCES = ("none", "sensor", "swept")

#: Modules that determine the result, beside those that the settings name.
_CODE_ROOTS = (
    "dhtorch.pipeline.completion",
    "dhtorch.pipeline.view_report",
    "dhtorch.data.pairs",
    "dhtorch.export.frames",
)

#: Maximum number of frames read for depth range and stated error; further frames show the same surfaces.
_MAX_MEASURED_FRAMES = 40

#: Frames whose returns determine the median return. They bound the time of the summary.
_RETURN_FRAMES = 8

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
    return cameras.from_matrix(torch.tensor([row["K"] for row in rows]), lens)


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
        task.done.update(_read_complete_frames(task))
        # Of every frame all files that it can have
        ends = [(kind, end) for kind, suffixes in EXTRA_FILES.items() for end in suffixes]
        files = {
            task.name(i): [*task.map_files(i), *(task.folder / kind / f"{task.name(i)}{end}" for kind, end in ends)]
            for i in range(len(task.recording))
        }
        if folder.is_unlisted and shared_file.is_file():  # of an older version, without a manifest, with this key
            folder.adopt([*task.folder.iterdir(), *(path for name in task.done for path in files.get(name, ()))])
        folder.check_folders(task.folder / kind for kind in (*task.layout.folders, *extras))
        folder.check(task.folder / name for name in ("complete.json", *_SIDE_FILES.get(task.layout.name, ()), *more))
        for i in task.frames:
            if task.name(i) not in task.done:
                folder.check(task.map_files(i))
            folder.check(path for path in task.extras(i) if not (path.is_file() and folder.lists(path)))
        for path in (path for name in files.keys() - task.done for path in files[name]):
            folder.remove(path)
        yield


def _read_complete_frames(task: CompletionTask) -> dict[str, Row]:
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


# -------------------------------------------------------------------------------------------------------------- command


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """``dhtorch complete``: write the missing frames of ``out``; several scenes get one folder each.

    Args:
        settings: the options of ``conf/complete.yaml``, resolved, with ``choices``.
        parts: ``data`` and ``method``, as objects.
        progress: wraps a loop: (items, text, number of items) → items.

    Returns:
        Exit code 0.

    Raises:
        ValueError, OSError, ImportError: bad options or data, or an output folder with other files.
        KeyboardInterrupt: Ctrl-C; complete frames are kept.
    """
    validate_choices(settings, {"format": ("auto", *FRAME_LAYOUTS)})
    if settings["unit"] is not None and not 1e-6 < settings["unit"] <= 0.1:
        raise ValueError(f"unit: found {settings['unit']!r}, expected a number above 1e-06, at most 0.1")
    scenes = scenes_of(parts["data"])
    out = Path(str(settings["out"])).expanduser()
    with open_output_folder(out, "out") if len(scenes) > 1 else contextlib.nullcontext():
        summaries = _complete_scenes(scenes, out, settings, parts["method"], progress)
    print("\n".join([*summaries.values(), "wrote", *(f"  {folder}" for folder in summaries)]))
    return 0


def _complete_scenes(
    scenes: Sequence[Scene], out: Path, settings: Mapping[str, Any], method: Method, progress: Progress
) -> dict[Path, str]:
    """Complete the scenes one by one -> output folder and summary of each."""
    summaries: dict[Path, str] = {}
    digests: dict[Path | None, str] = {}
    for scene in scenes:
        folder = out if len(scenes) == 1 else out / scene.name
        if folder in summaries:
            raise ValueError(f"data: found two scenes named {scene.name}, expected one (data.camera=KEY, or one root)")
        if scene.root not in digests:
            digests[scene.root] = digest_scene_files(scene, settings, out)
        task = make_completion_task(scene, folder, method, settings, digests[scene.root])
        with open_task_folder(task):
            n_untouched = sum(task.name(i) in task.done for i in task.frames)
            # The folder is a readable recording afterwards, unless the process is killed
            todo = [i for i in task.frames if task.missing(i)]
            with close_on_exit(task):
                for i in progress(todo, f"{scene.name}: frames", len(todo)):
                    complete_frame(task, i)
        # Printed summary of one scene
        rows = [task.done[task.name(i)] for i in task.frames]
        stats = measure_recovery(task, task.frames)
        reasons = dict(stats.reasons)
        unfit = reasons.pop("unfit")
        why = ", ".join(f"{words(name.upper())} {share:.1%}" for name, share in reasons.items())
        counts = {kind: f"{words(kind)} {fraction:.1%}" for kind, fraction in stats.fractions.items()}
        counts["recovered"] += f" (median sigma {stats.error:.1%} of the depth)" if stats.error is not None else ""
        layout, (h, w) = task.layout, rows[0]["hw"]
        untouched = f" ({n_untouched} left untouched)" if n_untouched else ""
        shown = f"{', '.join(counts.values())}{f' ({why})' if why else ''}"
        lines = [
            f"{scene.name}: {format_count(len(rows), 'frame')}{untouched} of {w}x{h}: {shown}",
            f"  depth in steps of {1e3 * layout.unit:g} mm, up to {layout.reach:.1f} m"
            + (f": {unfit:.2%} of the pixels are beyond it and left empty (see unit=, arrays=true)" if unfit else ""),
        ]
        if layout.name == "png" != task.settings["format"]:
            lines.append("  maps only, not a recording: some frames have no pose")
        if layout.pictures and any((r["K"], r["distortion"]) != (rows[0]["K"], rows[0]["distortion"]) for r in rows):
            lines.append("  the intrinsics change: K.txt has those of the first frame, meta/ those of every frame")
        summaries[folder] = "\n".join(lines)
    return summaries


def make_completion_task(
    scene: Scene, folder: Path, method: Method, settings: Mapping[str, Any], digest: str, *, sized_as: int = 0
) -> CompletionTask:
    """The completion task of a scene; the image size is that of frame ``sized_as``."""
    frames = range(0, len(scene.recording), settings["every"])[: settings["max_frames"]]
    hw = scene.recording[sized_as].hw
    if 0 in hw:
        raise ValueError(f"{scene.name}: found frames without images, expected images (data.images=true)")
    is_same_size = dense.map_hw(hw, settings["size"]) == hw
    layout_options = {"unit": settings["unit"], "arrays": settings["arrays"], "same": is_same_size}
    layout_options["budget"] = bool(settings.get("budget"))
    layout = select_layout(scene.recording, settings["format"], **layout_options)
    pairs = [] if len(scene.recording) < 2 else by_choice(scene, settings["steps"], stride=1, past=settings["past"])
    return CompletionTask(
        scene=scene,
        folder=folder,
        layout=layout,
        method=with_sensor(method, settings.get("sensor")),
        settings=settings,
        frames=frames,
        offers={pair.reference: pair.candidates for pair in pairs},
        shared=build_shared_metadata(
            scene,
            layout,
            settings,
            digest,
            keyed=(*_KEY_OPTIONS, *(name for name in _SET_KEY_OPTIONS if settings.get(name))),
            roots=_CODE_ROOTS,
            calibration="fused",
        ),
    )


# ------------------------------------------------------------------------------------------------------------- frames


def complete_frame(task: CompletionTask, i: int) -> None:
    """Write the missing files of frame ``i``; figures and points are made from its written maps."""
    if task.name(i) not in task.done:
        write_frame(task, i, *_compute_map(task, i))
    missing = [path for path in task.extras(i) if not is_whole(path)]
    if not missing:
        return
    maps, source = read_completed_maps(task, i)
    frame = task.recording[i]
    picture = resize_picture(frame, source.shape)
    for path in missing:
        if path.suffix in (".png", ".jpg"):  # a figure, or its preview from the small image
            image: Any = frame.image[0]
            options: dict[str, Any] = {}
            if path.suffix == ".jpg":
                image, options = np.atleast_3d(picture).transpose(2, 0, 1), {"dpi": _PREVIEW_DPI, "kind": "jpg"}
            title = format_frame(task.scene.name, task.done[task.name(i)]["frame"])
            options["title"] = append_cutoff(title, task.settings["cutoff"])
            out = io.BytesIO()
            draw_completed(out, image, maps["depth"], maps["sigma"], source, **options)
            storage.replace_file(path, out.getvalue())
        else:
            # In camera axes: points as PLY, or a mesh (edges across depth steps left out) as GLB
            depth, hw = maps["depth"], (source.shape[0], source.shape[1])
            z = torch.from_numpy(np.where(depth > 0, depth, np.nan)).reshape(1, -1)
            xyz = cameras.unproject(frame.camera, dense.map_pixel_centres(frame, hw)[None], z)[0]
            rgb = np.broadcast_to(picture if picture.ndim == 3 else picture[..., None], (*hw, 3)).reshape(-1, 3)
            if path.suffix == ".ply":
                export.write_ply(path, xyz, rgb, sigma=maps["sigma"].reshape(-1), source=source.reshape(-1))
            else:
                export.write_glb(path, [export.Shape("view", xyz, rgb, face=export.mesh_depth_map(depth))])


@contextlib.contextmanager
def close_on_exit(task: CompletionTask) -> Iterator[None]:
    """Context in which frames are written: on exit, also by an exception, the folder is closed as a recording.

    Raises:
        KeyboardInterrupt: Ctrl-C; the message gives the number of complete frames.
    """
    try:
        try:
            yield
        finally:
            # Register the complete frames and write the files that make the folder a recording
            task.done.update(_read_complete_frames(task))
            complete = [i for i in range(len(task.recording)) if task.name(i) in task.done]
            if complete:
                task.layout.close(task.folder, task.recording, complete, [task.done[task.name(i)] for i in complete])
    except KeyboardInterrupt:
        n = sum(task.name(i) in task.done for i in task.frames)
        stay = f"{n} of {format_count(len(task.frames), 'frame')} in {task.folder} are complete and kept"
        raise KeyboardInterrupt(f"{stay}; run the same command again for the rest") from None


def _compute_map(task: CompletionTask, i: int) -> tuple[Frame, DepthMap, Row]:
    """Complete frame ``i`` -> the reference frame, its depth map (CPU), and a row with the selected views."""
    settings, offered = task.settings, task.offers.get(i, ())
    reference = task.load(i)
    if not offered:
        completed_map = dense.sensor_depth_map(reference, method=task.method, size=settings["size"])
        return reference, completed_map.to("cpu"), {"views": [], "n_offered": 0}
    source_views = stack([task.load(k) for k in offered])
    options: dict[str, Any] = {k: settings[k] for k in (*dense.DENSE_OPTIONS, "seed")}
    options |= {
        "method": with_view_selection(task.method),
        "calibration": default_calibration(),
        "hint": task.scene.hint,
    }
    trace: Trace = {}
    with torch.no_grad():
        completed_map = complete_depth(reference, source_views, **options, trace=trace)
    choice = report_selection(i, offered, trace)
    views = [int(task.recording.number[k]) for k in choice.views]
    row: Row = {"views": views, **choice.row()["why"]}
    if task.recording.poses is None:
        fits = [each["fit"] for each in trace.get("views", ())] or [trace["fit"]]
        solved = [(number, fit) for number, fit in zip(views, fits, strict=False) if bool(fit.ok[0])]
        row["motions"] = {str(number): se3.to_matrix(fit.T_1_from_0.to("cpu"))[0] for number, fit in solved}
    return reference, completed_map.to("cpu"), row


def write_frame(task: CompletionTask, i: int, reference: Frame, depth_maps: DepthMap, views_row: Row) -> None:
    """Write the files of one frame; the meta file, which marks it complete, comes last."""
    name, layout, depth_map = task.name(i), task.layout, depth_maps[0]
    steps = export.quantise_depth(depth_map.depth, depth_map.sigma, depth_map.source, layout.unit)
    pictures = {"depth": steps.depth, "sigma": steps.sigma, "source": steps.source}
    if layout.pictures:
        pictures[layout.pictures] = resize_picture(reference, steps.depth.shape)
    if layout.confidence:
        table = np.zeros(max(STRAY_CONFIDENCE) + 1, np.uint8)
        table[list(STRAY_CONFIDENCE)] = list(STRAY_CONFIDENCE.values())
        pictures["confidence"] = table[steps.source]
    shares: Row = {}
    if layout.budget:
        # The largest cause of every pixel's sigma; of estimated pixels the mean fraction of each cause in sigma²
        pictures["budget"] = depth_map.budget.dominating.to(torch.uint8).numpy()
        shares["sigma_shares"] = depth_map.budget.shares(depth_map.keep & is_estimated(depth_map.source))
    if not (shared_file := task.folder / "complete.json").is_file():
        storage.write_json(shared_file, task.shared)
    for kind, pixels in pictures.items():
        storage.replace_file(layout.file(task.folder, kind, name), export.encode_png(pixels))
    if layout.arrays:
        out = io.BytesIO()  # unquantised
        codes = {k: getattr(depth_map, k).to(torch.uint8).numpy() for k in ("source", "gate")}
        np.savez_compressed(out, **{k: getattr(depth_map, k).numpy() for k in ("depth", "sigma", "score")}, **codes)
        storage.replace_file(layout.file(task.folder, "arrays", name), out.getvalue())
    # Pixel counts by source, and fractions of all pixels without an answer, by reason
    counts = {name.lower(): int((steps.source == code).sum()) for code, name in names(Source).items()}
    gates = {name.lower(): float((depth_map.gate == code).double().mean()) for code, name in names(Gate).items()}
    no_answer = {name: share for name, share in gates.items() if share and name != "answer"}
    # Metadata of one frame: units, camera, pose, time, size
    camera = cameras.resize(reference.camera, reference.hw, steps.depth.shape).to("cpu")
    poses = task.recording.poses
    shared_keys = ("key", "version", "method", "calibration", "unit_m", "sigma_unit_m")
    row = storage.to_strict_json(
        {
            **{k: task.shared[k] for k in shared_keys},
            "cutoff_m": task.settings["cutoff"],
            "frame": int(task.recording.number[i]),
            "time": None if reference.time is None else float(reference.time[0]),
            "hw": list(steps.depth.shape),
            "K": cameras.to_matrix(camera)[0],
            "distortion": None if camera.distortion is None else camera.distortion[0],
            "T_world_from_cam": None if poses is None else se3.to_matrix(poses[i : i + 1])[0],
        }
        | views_row
        | {"pixels": {name: n for name, n in counts.items() if n or name in _COUNTED_SOURCES}}
        | {"no_answer": {**no_answer, "unfit": float(steps.unfit.mean())}}
        | shares
    )
    storage.write_json(layout.file(task.folder, "meta", name), row)
    task.done[name] = row


def resize_picture(frame: Frame, hw: tuple[int, ...]) -> np.ndarray:
    """Frame image -> (h, w, 3) or (h, w) uint8 at the map's size, by area averaging."""
    image = frame.image[0].cpu()
    if image.is_floating_point():
        image = (image.clamp(0, 1) * 255).round().to(torch.uint8)
    if image.shape[-2:] != hw:
        image = F.interpolate(image[None].float(), hw, mode="area")[0].round().to(torch.uint8)
    return image[0].numpy() if len(image) == 1 else image.permute(1, 2, 0).numpy()


# ----------------------------------------------------------------------------------------------------------- statistics


class StatedMotion(NamedTuple):
    """Motion of the stated poses from completed frames to their farthest source views, medians over frames."""

    baseline: float  # m
    turn: float  # rad
    depth: float  # m, median return


@dataclass(frozen=True)
class RecoveryStats:
    """Statistics of the completed frames of one recording; fractions are of all their pixels."""

    frames: int
    fractions: Mapping[str, float]  # by kind, see codes.SOURCES_OF_KIND
    pixels: Mapping[str, float]  # per frame, by kind
    reasons: tuple[tuple[str, float], ...]  # gate names and fractions of all pixels, the largest first
    near: float | None = None  # m; 2 % and 98 % percentile of recovered depth; None = nothing recovered
    far: float | None = None
    error: float | None = None  # median stated sigma / depth of the recovered pixels
    motion: StatedMotion | None = None  # where nothing was recovered and poses are stated


def measure_recovery(task: CompletionTask, frames: Sequence[int]) -> RecoveryStats:
    """Statistics of complete frames."""
    rows = [task.done[task.name(i)] for i in frames]
    counts = [count_pixels(row) for row in rows]
    fractions = {kind: float(np.mean([n[kind] / sum(n.values()) for n in counts])) for kind in SOURCES_OF_KIND}
    pixels = {kind: sum(n[kind] for n in counts) / len(counts) for kind in SOURCES_OF_KIND}
    average: dict[str, float] = {}  # fraction of unanswered pixels by reason
    for row in rows:
        for name, share in row["no_answer"].items():
            average[name] = average.get(name, 0.0) + share / len(rows)
    reasons = tuple(sorted(average.items(), key=lambda item: -item[1]))
    stats = RecoveryStats(len(rows), fractions, pixels, reasons)
    depths, ratios = [], []
    for i in frames[:_MAX_MEASURED_FRAMES]:
        maps, source = read_completed_maps(task, i)
        recovered = is_recovered(source) & (maps["depth"] > 0)
        depths.append(maps["depth"][recovered])
        ratios.append(maps["sigma"][recovered] / maps["depth"][recovered])
    depth = np.concatenate(depths)
    if not len(depth):
        return replace(stats, motion=_measure_stated_motion(task, frames))
    near, far = np.percentile(depth, (2, 98)).tolist()
    return replace(stats, near=near, far=far, error=float(np.median(np.concatenate(ratios))))


def measure_median_return(task: CompletionTask, frames: Sequence[int]) -> float | None:
    """Median over some frames of the median sensor depth, m; None where no completed frame has a return."""
    medians = []
    for i in frames[:_RETURN_FRAMES]:
        maps, source = read_completed_maps(task, i)
        returns = maps["depth"][(source == Source.SENSOR) & (maps["depth"] > 0)]
        medians += [float(np.median(returns))] if len(returns) else []
    return float(np.median(medians)) if medians else None


def _measure_stated_motion(task: CompletionTask, frames: Sequence[int]) -> StatedMotion | None:
    """Motion of the stated poses between completed frames and their source views; None without poses or returns."""
    poses, depth = task.recording.poses, measure_median_return(task, frames)
    if poses is None or depth is None:
        return None
    position = {int(number): k for k, number in enumerate(task.recording.number)}
    motions = []
    for i in frames:
        views = [position[number] for number in task.done[task.name(i)]["views"]]
        if views:
            baselines = (poses.t[views] - poses.t[i]).norm(dim=-1)
            turns = se3.rotation_angle(poses.R[views].mT @ poses.R[i])
            motions.append((float(baselines[k := int(baselines.argmax())]), float(turns[k])))
    if not motions:
        return None
    baseline, turn = np.median(motions, 0).tolist()
    return StatedMotion(baseline, turn, depth)
