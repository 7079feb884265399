"""``dhtorch PATH``: a capture of one's own, from its files to completed maps, one map and a page to look at.

Frames are made as ``dhtorch complete`` makes them, coarse to fine until the time is over, so that the first picture is
there soon and the same command does more. What cannot work is said in one sentence with what would help.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dhtorch import export
from dhtorch.cli import complete, recover_page
from dhtorch.cli import completed_folder as completed
from dhtorch.cli.complete import Progress
from dhtorch.cli.completed_folder import CompletionTask
from dhtorch.cli.inspect import FoundCapture, classify_images, find_captures
from dhtorch.codes import Source
from dhtorch.data import FORMATS, FormatError, open_all
from dhtorch.data.io import decode as files
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene
from dhtorch.integrate.from_maps import FrameMap, fuse_frame_maps
from dhtorch.integrate.mapping import choose_voxel, should_mesh, write_surface
from dhtorch.pipeline.method import Method
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count
from dhtorch.viz.viewer import html, points
from dhtorch.viz.viewer.exhibit import PageOpening

#: Folder of what is made, where no other is said.
_DEFAULT_FOLDER = Path("dhtorch_out")

#: Frames of which the map is made at most: coarse to fine, they see the same.
_MAX_MAPPED_FRAMES = 40

#: Frames that are looked at before a recording is given up.
_MAX_TRIED_FRAMES = 8

#: Options of ``dhtorch complete`` that are not asked for here.
_COMPLETE_DEFAULTS = {
    "format": "auto",
    "unit": None,
    "arrays": False,
    "figures": False,
    "points": False,
    "most": None,
    "every": 1,
}


class NothingToRecover(ValueError):
    """A capture of which nothing can be recovered; the message says why and what would help."""


@dataclass
class RecoveredFrames:
    """What became of one recording."""

    task: CompletionTask
    frames: list[int]  # whole ones, coarse to fine
    broken: dict[int, str]  # frames that could not be read
    left: int  # frames for which there was no time


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """Make all that the time allows of every recording of a capture; returns the exit code.

    Args:
        settings: the options of ``conf/recover.yaml``, resolved.
        parts: ``method``, as an object.
        progress: wraps a loop: (items, text, number of items) → items.

    Raises:
        ValueError, OSError: bad options or data, or a capture of which nothing can be recovered.
        KeyboardInterrupt: Ctrl-C; whole frames stay.
    """
    if settings["threads"] is not None:
        torch.set_num_threads(settings["threads"])
        files.set_opencv_threads(settings["threads"])
    path = Path(str(settings["path"])).expanduser()
    reading = {name: value for name, value in settings["data"].items() if value is not None}
    found = [replace(capture, options=reading) for capture in _find_recording_captures(path, settings["format"])]
    out = _resolve_folder(path, settings["out"])
    recordings, refused = _open_captures(found)
    chosen = recordings[: settings["recordings"]]
    began, made = time.monotonic(), 0
    for n, recording in enumerate(chosen):
        minutes = settings["minutes"]
        until = None if minutes is None else began + 60 * minutes * (n + 1) / len(chosen)
        folder = out if len(chosen) == 1 else out / recording.name
        try:
            said = _process_recording(recording, folder, settings, parts["method"], until, progress)
        except NothingToRecover as nothing:
            refused.append(str(nothing))
            continue
        made += 1
        print("\n".join(said), flush=True)
    if made == 0:
        raise NothingToRecover("; ".join(refused[:3]))
    for line in refused:
        print(line)
    if len(chosen) < len(recordings):
        print(f"{len(chosen)} of {len(recordings)} recordings; recordings=null takes all")
    return 0


# -------------------------------------------------------------------------------------------------------- what is there


def _find_recording_captures(path: Path, format: str = "auto") -> list[FoundCapture]:
    """The captures at a path, or up to two folders below, that hold pictures of a moving camera.

    Raises:
        FormatError: there is no capture.
        NothingToDo: captures of other kinds.
    """
    if format != "auto":
        return [FoundCapture(path, "recording", format, "as told")]
    found = find_captures(path)
    recordings = [each for each in found if each.kind == "recording"]
    if recordings:
        return recordings
    if found[0].kind == "stacks":
        what = f"focal stacks ({found[0].format}) of a still camera"
        raise NothingToRecover(f"{path}: {what}; pictures from two places are needed, and depth of what is near")
    pictures, depths = classify_images(found[0].path)
    if len(depths) == 1:
        raise NothingToRecover(
            f"{path}: one frame; a second view from another place is needed for what the sensor lacks"
        )
    if depths:
        what = (
            f"{format_count(len(pictures), 'picture')} and {format_count(len(depths), 'depth map')} of no known format"
        )
        raise NothingToRecover(f"{path}: {what}; a layout of docs/data.md is needed, as rgb/ beside depth/")
    what = f"{format_count(len(pictures), 'picture')} without depth"
    raise NothingToRecover(
        f"{path}: {what}; a sensor's depth of what is near is needed, it gives the metre (docs/data.md)"
    )


def _open_captures(found: Sequence[FoundCapture]) -> tuple[list[Recording], list[str]]:
    """The recordings of several captures, and in a sentence each why others cannot be opened.

    Raises:
        NothingToDo, FormatError: the only capture cannot.
    """
    recordings: list[Recording] = []
    refused: list[str] = []
    for capture in found:
        try:
            recordings += _open_capture(capture)
        except (NothingToRecover, FormatError) as error:
            if len(found) == 1:
                raise
            refused.append(str(error))
    return recordings, refused


def _open_capture(capture: FoundCapture) -> Sequence[Recording]:
    """The recordings of a capture.

    Raises:
        NothingToDo: it has depth and no pictures.
        FormatError: it cannot be read.
    """
    try:
        return open_all(capture.path, capture.format, **capture.options)
    except FormatError as error:
        known = inspect.signature(FORMATS[capture.format].read).parameters
        if "images" not in known:
            raise
        try:
            open_all(capture.path, capture.format, images=False)
        except FormatError:
            raise error from None
        raise NothingToRecover(
            f"{capture.path}: depth only, nothing to track: it needs the pictures ({error})"
        ) from None


def coarse_to_fine(n: int) -> list[int]:
    """0 … n − 1 in an order of which every beginning is spread evenly: the middle first, then that of each half, …"""
    order, spans = [], [(0, n)]
    while spans:
        order += [(a + b) // 2 for a, b in spans if b > a]
        spans = [half for a, b in spans if b > a for half in ((a, (a + b) // 2), ((a + b) // 2 + 1, b))]
    return order


def _resolve_folder(path: Path, out: Any) -> Path:
    """The folder of what is made.

    Raises:
        ValueError: it lies in the capture.
    """
    name = path.resolve().name or "capture"
    folder = _DEFAULT_FOLDER / (path.stem if path.is_file() else name) if out is None else Path(str(out)).expanduser()
    if path.is_dir() and folder.resolve().is_relative_to(path.resolve()):
        raise ValueError(
            f"out: {folder} lies in the capture, which is never written to; expected another place (out=DIR)"
        )
    return folder


def _find_usable_frame(recording: Recording) -> int:
    """A frame that can be read, of a recording of which something may be recovered.

    Raises:
        NothingToDo: why nothing can, and what would help.
    """
    if len(recording) < 2:
        help = "a second view from another place is needed for what the sensor lacks"
        raise NothingToRecover(f"{recording.name}: {format_count(len(recording), 'frame')}; {help}")
    causes, blank = [], 0
    for k in coarse_to_fine(len(recording))[:_MAX_TRIED_FRAMES]:
        try:
            frame = recording[k]
        except FormatError as error:
            causes.append(str(error))
            continue
        if 0 in frame.hw:
            what = "depth only, nothing to track: it needs its pictures (rgb.mp4, or a folder of them)"
            raise NothingToRecover(f"{recording.name}: {what}")
        if bool((frame.depth > 0).any()):
            return k
        blank += 1
    if blank:
        what = f"{format_count(len(recording), 'frame')}, of {blank} looked at none has depth"
        raise NothingToRecover(
            f"{recording.name}: {what}; a sensor's depth of what is near is needed, it gives the metre"
        )
    raise NothingToRecover(f"{recording.name}: no frame can be read: {causes[0]}")


# --------------------------------------------------------------------------------------------------------- what is made


def _process_recording(
    recording: Recording,
    folder: Path,
    settings: Mapping[str, Any],
    method: Method,
    until: float | None,
    progress: Progress,
) -> list[str]:
    """Everything of one recording; what to say of it."""
    read = {"path": str(settings["path"]), "format": recording.format}
    read |= {name: value for name, value in settings["data"].items() if value is not None}
    own = {**_COMPLETE_DEFAULTS, **settings, "out": str(folder), "data": read}
    own["choices"] = {**settings["choices"], "data": recording.format}
    scene = Scene.of(recording)
    first = _find_usable_frame(recording)
    task = complete.make_completion_task(
        scene, folder, method, own, completed.digest_scene_files(scene, own, folder), sized_as=first
    )
    order = [i for i in coarse_to_fine(len(recording)) if i in task.offers]
    task = replace(task, frames=order, offers={i: list(offered) for i, offered in task.offers.items()})
    completed.resume_folder(task)
    made = _complete_in_time(task, until, progress)
    if not made.frames:
        reason = next(iter(made.broken.values()), "no time for a single frame (minutes=)")
        raise NothingToRecover(f"{recording.name}: no frame could be completed: {reason}")
    rows = [task.done[task.name(i)] for i in made.frames]
    best = max(zip(rows, made.frames, strict=True), key=lambda each: each[0]["pixels"].get("swept", 0))[1]
    found = recover_page.measure_recovery(task, made.frames)
    said = recover_page.describe_recovery(task, found, recording[made.frames[0]].hw)
    opening = recover_page.build_opening(
        said, found, _write_overview(task, best), completed.format_frame_title(task, best)
    )
    written = ["depth/", "overview.png", *_write_map(made, opening, settings, progress)]
    return [*said, _format_next_step(made, written[-1]), f"Wrote {', '.join(written)} in {folder}."]


def _complete_in_time(task: CompletionTask, until: float | None, progress: Progress) -> RecoveredFrames:
    """Frames in their order until the time is over; one that cannot be read is left out, and not offered again."""
    made = RecoveredFrames(task, [], {}, 0)
    todo = [i for i in task.frames if task.missing(i)]
    made.frames = [i for i in task.frames if not task.missing(i)]
    first = not made.frames

    def in_time() -> Iterator[int]:
        for n, i in enumerate(todo):
            if until is not None and time.monotonic() > until and made.frames:
                made.left = len(todo) - n
                return
            yield i

    with complete.close_on_exit(task):
        for i in progress(in_time(), f"{task.scene.name}: frames", len(todo)):
            if _try_frame(made, i) and first:
                _write_overview(task, i)
                first = False
    return made


def _try_frame(made: RecoveredFrames, i: int) -> bool:
    """Make a frame; where a file cannot be read, without the frame that it belongs to."""
    task = made.task
    while i not in made.broken:
        try:
            complete.complete_frame(task, i)
        except FormatError:
            offered: Any = task.offers.get(i, ())
            broken = {k: error for k in (i, *offered) if (error := _read_error(task.recording, k))}
            if not broken:
                raise
            made.broken.update(broken)
            for others in task.offers.values():
                others[:] = [k for k in others if k not in broken]  # type: ignore[index]
        else:
            made.frames.append(i)
            return True
    return False


def _read_error(recording: Recording, k: int) -> str:
    try:
        recording[k]
    except FormatError as error:
        return str(error)
    return ""


def _write_overview(task: CompletionTask, i: int) -> bytes:
    """Write the picture that shows most: what the camera saw, the sensor, the completed map."""
    picture = complete.render_completed(task, i, task.recording[i], *completed.read_completed_maps(task, i))
    storage.replace_file(task.folder / "overview.png", picture)
    return picture


def _write_map(
    made: RecoveredFrames, opening: PageOpening, settings: Mapping[str, Any], progress: Progress
) -> list[str]:
    """The map of all frames, and the page, which begins with the numbers; the names of what was written."""
    task = made.task
    voxel = choose_voxel(task.recording, made.frames) if settings["voxel"] is None else settings["voxel"]

    def read(k: int) -> FrameMap:
        maps, source = completed.read_completed_maps(task, k)
        depth, sigma = (torch.from_numpy(np.ascontiguousarray(maps[x])).float() for x in ("depth", "sigma"))
        return FrameMap(depth, sigma, torch.from_numpy(np.ascontiguousarray(source)))

    frames = made.frames[:_MAX_MAPPED_FRAMES]
    surface, up = fuse_frame_maps(
        task.recording, frames, read, voxel=voxel, meshed=should_mesh(settings["mesh"]), progress=progress
    )
    if not len(surface.xyz):
        return []
    world = "world" if task.recording.poses is not None else "camera"
    ply = task.folder / "map.ply"
    write_surface(ply, surface, f"{task.scene.name}'s {world}", up)
    values = {"sigma": surface.sigma, "source": surface.source}
    shape = export.Shape("map", surface.xyz, surface.features[:, :3], surface.normal, surface.face, values=values)
    export.write_glb(task.folder / "map.glb", [shape], up=up)
    html.write_viewer_page(
        task.folder / "view.html", replace(points.read_ply_exhibit(ply), name=task.scene.name, opening=opening)
    )
    return ["map.ply", "map.glb", "view.html"]


# ------------------------------------------------------------------------------------------------------ what is said


def _format_next_step(made: RecoveredFrames, shown: str) -> str:
    """What to do with what is there; ``shown`` is the file to open."""
    n, name = len(made.broken), made.task.scene.name
    cause = next(iter(made.broken.values()), "")
    broken = f" {format_count(n, 'frame')} of {name} could not be read ({cause})." if n else ""
    if made.left:
        more = f"the same command does more of the {format_count(made.left, 'frame')} left (minutes=null: all)"
        return f"Next: open {shown}; {more}.{broken}"
    read = {name: value for name, value in made.task.settings["data"].items() if value is not None}
    also = "".join(f" data.{name}={_format_value(value)}" for name, value in read.items())
    path, cutoff = made.task.settings["path"], _median_sensor_depth(made)
    judged = f"dhtorch run data=auto data.root={path}{also} holdout.cutoff={cutoff:.2g}"
    return f"Next: open {shown}; {judged} says how good it is on yours.{broken}"


def _format_value(value: Any) -> str:
    """A value as it is typed."""
    listed = isinstance(value, list)
    return f"[{','.join(map(str, value))}]" if listed else str(value).lower() if isinstance(value, bool) else str(value)


def _median_sensor_depth(made: RecoveredFrames) -> float:
    """Median depth of the returns of the first frame, m: what is hidden beyond it tells how good the rest is."""
    maps, source = completed.read_completed_maps(made.task, made.frames[0])
    near = maps["depth"][(source == Source.SENSOR) & (maps["depth"] > 0)]
    return float(np.median(near)) if len(near) else 2.0
