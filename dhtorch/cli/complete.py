"""``dhtorch complete``: every frame of a recording with a depth for every pixel that the sensor or the views tell.

A frame is a file in each of ``depth/``, ``sigma/``, ``source/`` and, written last, ``meta/``: one that has it is whole.
``complete.json`` says what all frames of a folder share, and the folder is a recording again, in the capture's own
format where that can hold what was found. Only whole frames count: the same command makes those that are missing.
"""

from __future__ import annotations

import contextlib
import io
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from dhtorch import export
from dhtorch.cli import completed_folder as completed
from dhtorch.cli.completed_folder import EXTRA_FILES, CompletionTask, Row
from dhtorch.cli.layouts import FRAME_LAYOUTS, has_varying_camera, select_layout, stray_confidence
from dhtorch.codes import Gate, Source, names, words
from dhtorch.data.io import decode as data_files
from dhtorch.data.pairs import by_choice
from dhtorch.data.scene import Scene, scenes_of
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import dense
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.spec import Trace
from dhtorch.pipeline.view_report import report_selection, with_view_selection
from dhtorch.pytree import stack
from dhtorch.records import DepthMap, Frame
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count
from dhtorch.viz.plots import draw_completed

Progress = Callable[[Iterable[Any], str, int], Iterable[Any]]

#: Name of the calibration that travels with the package.
_DEFAULT_CALIBRATION_NAME = "dense"

#: Options that decide what the files of a frame hold, beside format and unit as they came out.
_KEY_OPTIONS = ("data", "method", "seed", "dtype", "cutoff", "steps", "past", *dense.DENSE_OPTIONS, "arrays")

#: Numbers and what they must lie between, the upper end among it.
_OPTION_RANGES = {
    "unit": (1e-6, 0.1),
    "cutoff": (0, math.inf),
    "min_correlation": (-1, 1),
    "max_sigma_rel": (0, math.inf),
}

#: Source in a meta file → in words.
_SOURCE_LABELS = {"sensor": "sensor", "swept": "swept", "none": "silent"}

#: Of which frames there are figures and points: of none, the first, or all.
_EXTRAS_CHOICES = (False, True, "all")

#: Modules that decide what is found beside those that the settings name.
_CODE_ROOTS = ("dhtorch.pipeline.dense", "dhtorch.pipeline.view_report", "dhtorch.data.pairs", "dhtorch.export.frames")


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """``dhtorch complete``: write the frames of ``out`` that are not there yet; a folder for each of several scenes.

    Args:
        settings: the options of ``conf/complete.yaml``, resolved, with ``choices``.
        parts: ``data`` and ``method``, as objects.
        progress: wraps a loop: (items, text, number of items) → items.

    Returns:
        Exit code 0.

    Raises:
        ValueError, OSError, ImportError: bad options or data, a folder that holds something else.
        KeyboardInterrupt: Ctrl-C; whole frames stay.
    """
    _check_options(settings)
    if settings["threads"] is not None:
        torch.set_num_threads(settings["threads"])
        data_files.set_opencv_threads(settings["threads"])
    scenes = scenes_of(parts["data"])
    out = Path(str(settings["out"])).expanduser()
    found: dict[Path, str] = {}
    digests: dict[Path | None, str] = {}
    for scene in scenes:
        folder = out if len(scenes) == 1 else out / scene.name
        if folder in found:
            raise ValueError(f"data: found two scenes named {scene.name}, expected one (data.camera=KEY, or one root)")
        if scene.root not in digests:
            digests[scene.root] = completed.digest_scene_files(scene, settings, out)
        task = make_completion_task(scene, folder, parts["method"], settings, digests[scene.root])
        completed.resume_folder(task)
        before = sum(task.name(i) in task.done for i in task.frames)
        _complete_missing(task, progress)
        found[folder] = _format_summary(task, before)
    print("\n".join([*found.values(), "wrote", *(f"  {folder}" for folder in found)]))
    return 0


def make_completion_task(
    scene: Scene, folder: Path, method: Method, settings: Mapping[str, Any], digest: str, *, sized_as: int = 0
) -> CompletionTask:
    """What is wanted of a scene, whose pictures are as large as that of frame ``sized_as``."""
    frames = range(0, len(scene.recording), settings["every"])[: settings["most"]]
    hw = scene.recording[sized_as].hw
    if 0 in hw:
        raise ValueError(f"{scene.name}: found frames without pictures, expected pictures (data.images=true)")
    same = dense.map_hw(hw, settings["size"]) == hw
    asked = {"unit": settings["unit"], "arrays": settings["arrays"], "same": same}
    layout = select_layout(scene.recording, settings["format"], **asked)
    pairs = [] if len(scene.recording) < 2 else by_choice(scene, settings["steps"], stride=1, past=settings["past"])
    return CompletionTask(
        scene=scene,
        folder=folder,
        layout=layout,
        method=method,
        settings=settings,
        frames=frames,
        offers={pair.reference: pair.candidates for pair in pairs},
        shared=completed.build_shared_metadata(
            scene,
            layout,
            settings,
            digest,
            keyed=_KEY_OPTIONS,
            roots=_CODE_ROOTS,
            calibration=_default_calibration_name(),
        ),
    )


def _default_calibration_name() -> str | None:
    return None if dense.default_calibration() is None else _DEFAULT_CALIBRATION_NAME


# ------------------------------------------------------------------------------------------------------ what is made


def _complete_missing(task: CompletionTask, progress: Progress) -> None:
    """Make what is missing, frame by frame; the folder is a recording at every end but a kill."""
    todo = [i for i in task.frames if task.missing(i)]
    with close_on_exit(task):
        for i in progress(todo, f"{task.scene.name}: frames", len(todo)):
            complete_frame(task, i)


def complete_frame(task: CompletionTask, i: int) -> None:
    """Make what is missing of frame ``i``."""
    if task.name(i) not in task.done:
        write_frame(task, i, *_compute_map(task, i))
    _write_extras(task, i)


@contextlib.contextmanager
def close_on_exit(task: CompletionTask) -> Iterator[None]:
    """While frames are made: the folder is a recording however this ends, but for a kill.

    Raises:
        KeyboardInterrupt: Ctrl-C, with what stays.
    """
    try:
        try:
            yield
        finally:
            _close_folder(task)
    except KeyboardInterrupt:
        n = sum(task.name(i) in task.done for i in task.frames)
        stay = f"{n} of {format_count(len(task.frames), 'frame')} in {task.folder} are whole and stay"
        raise KeyboardInterrupt(f"{stay}; the same command does the rest") from None


def _close_folder(task: CompletionTask) -> None:
    """Note what is whole now, and make a recording of it."""
    task.done.update(completed.read_complete_frames(task))
    known = [i for i in range(len(task.recording)) if task.name(i) in task.done]
    if known:
        task.layout.close(task.folder, task.recording, known, [task.done[task.name(i)] for i in known])


def _compute_map(task: CompletionTask, i: int) -> tuple[Frame, DepthMap, Row]:
    """The map of one frame, on the CPU, and which views were asked for it."""
    s, offered = task.settings, task.offers.get(i, ())
    reference = _load_frame(task, i)
    if not offered:
        found = dense.sensor_depth_map(reference, method=task.method, size=s["size"])
        return reference, found.to("cpu"), {"views": [], "n_offered": 0}
    others = stack([_load_frame(task, k) for k in offered])
    options: dict[str, Any] = {k: s[k] for k in (*dense.DENSE_OPTIONS, "seed")}
    options |= {
        "method": with_view_selection(task.method),
        "calibration": dense.default_calibration(),
        "hint": task.scene.hint,
    }
    trace: Trace = {}
    with torch.no_grad():
        found = dense.complete_depth(reference, others, **options, trace=trace)
    choice = report_selection(i, offered, trace)
    number = task.recording.number
    return reference, found.to("cpu"), {"views": [int(number[k]) for k in choice.views], **choice.row()["why"]}


def _load_frame(task: CompletionTask, i: int) -> Frame:
    """A frame as the method may see it."""
    s = task.settings
    frame = task.recording[i].to(getattr(torch, s["dtype"])).to(s["device"])
    return range_split(frame, s["cutoff"])


def write_frame(task: CompletionTask, i: int, reference: Frame, found: DepthMap, asked: Row) -> None:
    """The files of one frame; the one that makes it whole comes last."""
    name, layout, one = task.name(i), task.layout, found[0]
    steps = export.quantise_depth(one.depth, one.sigma, one.source, layout.unit)
    pictures = {"depth": steps.depth, "sigma": steps.sigma, "source": steps.source}
    if layout.pictures:
        pictures[layout.pictures] = _resize_picture(reference, steps.depth.shape)
    if layout.confidence:
        pictures["confidence"] = stray_confidence(steps.source)
    if not (about := task.folder / "complete.json").is_file():
        storage.write_json(about, task.shared)
    for kind, pixels in pictures.items():
        storage.replace_file(layout.file(task.folder, kind, name), export.encode_png(pixels))
    if layout.arrays:
        storage.replace_file(layout.file(task.folder, "arrays", name), _encode_arrays(one))
    row = storage.to_strict_json(_describe_frame(task, i, reference, steps) | asked | _count_pixels(steps, one))
    storage.write_json(layout.file(task.folder, "meta", name), row)
    task.done[name] = row


def _describe_frame(task: CompletionTask, i: int, reference: Frame, steps: export.QuantisedDepth) -> Row:
    """What a reader of one frame has to know."""
    camera = cameras.resize(reference.camera, reference.hw, steps.depth.shape).to("cpu")
    poses = task.recording.poses
    same = ("key", "version", "method", "calibration", "unit_m", "sigma_unit_m")
    return {
        **{k: task.shared[k] for k in same},
        "cutoff_m": task.settings["cutoff"],
        "frame": int(task.recording.number[i]),
        "time": None if reference.time is None else float(reference.time[0]),
        "hw": list(steps.depth.shape),
        "K": cameras.to_matrix(camera)[0],
        "distortion": None if camera.distortion is None else camera.distortion[0],
        "T_world_from_cam": None if poses is None else se3.to_matrix(poses[i : i + 1])[0],
    }


def _count_pixels(steps: export.QuantisedDepth, one: DepthMap) -> Row:
    """Pixels by source, and the shares of all pixels that are silent, by reason."""
    kinds = {code: name.lower() for code, name in names(Source).items() if name.lower() in _SOURCE_LABELS}
    pixels = {name: int((steps.source == code).sum()) for code, name in kinds.items()}
    if anchored := int((steps.source == Source.ALIGNED).sum()):
        pixels["anchored"] = anchored
    gates = {name.lower(): float((one.gate == code).double().mean()) for code, name in names(Gate).items()}
    silent = {name: share for name, share in gates.items() if share and name != "answer"}
    return {"pixels": pixels, "silent": {**silent, "unfit": float(steps.unfit.mean())}}


def _resize_picture(frame: Frame, hw: tuple[int, ...]) -> np.ndarray:
    """The picture at the size of the map, (h, w, 3) or (h, w) uint8; each pixel the mean of what it covers."""
    image = frame.image[0].cpu()
    if image.is_floating_point():
        image = (image.clamp(0, 1) * 255).round().to(torch.uint8)
    if image.shape[-2:] != hw:
        image = F.interpolate(image[None].float(), hw, mode="area")[0].round().to(torch.uint8)
    return image[0].numpy() if len(image) == 1 else image.permute(1, 2, 0).numpy()


def _encode_arrays(one: DepthMap) -> bytes:
    """The map as it was found, as NPZ."""
    out = io.BytesIO()
    codes = {k: getattr(one, k).to(torch.uint8).numpy() for k in ("source", "gate")}
    np.savez_compressed(out, **{k: getattr(one, k).numpy() for k in ("depth", "sigma", "score")}, **codes)
    return out.getvalue()


# ------------------------------------------------------------------------------------------------- what is shown of it


def _write_extras(task: CompletionTask, i: int) -> None:
    """Figure and points of a frame, as its files have it."""
    wanted = [path for path in task.extras(i) if not path.is_file()]
    if not wanted:
        return
    maps, source = completed.read_completed_maps(task, i)
    frame = task.recording[i]
    picture = _resize_picture(frame, source.shape)
    for path in wanted:
        if path.suffix == ".png":
            storage.replace_file(path, render_completed(task, i, frame, maps, source))
        else:
            _write_points(path, frame, picture, **maps, source=source)


def render_completed(
    task: CompletionTask, i: int, frame: Frame, maps: Mapping[str, np.ndarray], source: np.ndarray
) -> bytes:
    """The figure of a whole frame, PNG; ``maps`` and ``source`` as of :func:`maps_of`."""
    out = io.BytesIO()
    draw_completed(out, frame.image[0], **maps, source=source, title=completed.format_frame_title(task, i))
    return out.getvalue()


def _write_points(
    path: Path, frame: Frame, picture: np.ndarray, *, depth: np.ndarray, sigma: np.ndarray, source: np.ndarray
) -> None:
    """A frame in its camera's axes: points as PLY, a mesh of what lies on one surface as GLB."""
    hw = depth.shape[0], depth.shape[1]
    z = torch.from_numpy(np.where(depth > 0, depth, np.nan)).reshape(1, -1)
    xyz = cameras.unproject(frame.camera, dense.map_pixel_centres(frame, hw)[None], z)[0]
    rgb = np.broadcast_to(picture if picture.ndim == 3 else picture[..., None], (*hw, 3)).reshape(-1, 3)
    if path.suffix == ".ply":
        export.write_ply(path, xyz, rgb, sigma=sigma.reshape(-1), source=source.reshape(-1))
    else:
        export.write_glb(path, [export.Shape("view", xyz, rgb, face=export.mesh_depth_map(depth))])


def _format_summary(task: CompletionTask, before: int) -> str:
    """One scene in words."""
    rows = [task.done[task.name(i)] for i in task.frames]
    pixels: Counter[str] = Counter()
    silent: Counter[str] = Counter()
    for row in rows:
        pixels.update(row["pixels"])
        silent.update({k: share / len(rows) for k, share in row["silent"].items()})
    sensor, swept, none = (f"{kind} {pixels[k] / pixels.total():.1%}" for k, kind in _SOURCE_LABELS.items())
    unfit = silent.pop("unfit")
    reasons = ", ".join(f"{words(name.upper())} {share:.1%}" for name, share in silent.most_common())
    layout, (h, w) = task.layout, rows[0]["hw"]
    lines = [
        f"{task.scene.name}: {format_count(len(rows), 'frame')}{f' ({before} left untouched)' * (before > 0)}"
        f" of {w}x{h}: {sensor}, {swept}, {none}{f' ({reasons})' * bool(reasons)}",
        f"  steps of {1e3 * layout.unit:g} mm reach {layout.reach:.1f} m"
        + (f": {unfit:.2%} of the pixels do not fit and are silent (unit=, arrays=true)" if unfit else ""),
    ]
    if layout.name == "png" != task.settings["format"]:
        lines.append("  maps alone, no recording: not every frame has a pose")
    if layout.pictures and has_varying_camera(rows):
        lines.append("  the camera changes: K beside the maps is that of the first frame, meta/ has each frame's own")
    return "\n".join(lines)


def _check_options(settings: Mapping[str, Any]) -> None:
    """Options that would only fail after minutes."""
    for name in ("most", "every"):
        value = settings[name]
        if not (isinstance(value, int) and value >= 1) and not (name == "most" and value is None):
            raise ValueError(f"{name}: found {value!r}, expected a whole number of at least 1")
    words_of = {
        "format": ("auto", *FRAME_LAYOUTS),
        "dtype": ("float32", "float64"),
        **dict.fromkeys(EXTRA_FILES, _EXTRAS_CHOICES),
    }
    for name, known in words_of.items():
        if settings[name] not in known:
            shown = ", ".join(str(word).lower() for word in known)
            raise ValueError(f"{name}: found {settings[name]!r}, expected one of {shown}")
    for name, (low, high) in _OPTION_RANGES.items():
        value = settings[name]
        if value is not None and not (isinstance(value, int | float) and low < value <= high):
            raise ValueError(f"{name}: found {value!r}, expected a number above {low:g}, at most {high:g}")
    try:
        torch.empty(0, device=settings["device"])
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device: found {settings['device']!r}, expected one that torch can use here") from error
