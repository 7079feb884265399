"""``dhtorch PATH``: a capture -> completed depth maps, one fused map and a viewer page.

Frames are completed as in ``dhtorch complete``, at any time evenly spread over the capture, until the time limit; a
second run continues.
A capture from which nothing can be recovered gives one sentence with the reason and the remedy.
"""

import contextlib
import inspect
import io
import math
import shlex
import shutil
import sys
import time
import webbrowser
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dhtorch import export
from dhtorch.cli import complete
from dhtorch.cli.capture_checks import describe_missing_depth, print_check
from dhtorch.cli.complete import CompletionTask
from dhtorch.cli.gate_messages import describe_gate, suggest_remedy
from dhtorch.cli.inspect import FoundCapture, describe_pictures, find_captures
from dhtorch.codes import words
from dhtorch.data import FORMATS, FormatError, open_all
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.foreign_files import describe_layout
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene
from dhtorch.export import video
from dhtorch.geometry import se3
from dhtorch.integrate.from_maps import FrameMap, fuse_frame_maps
from dhtorch.integrate.mapping import choose_voxel, file_from_world, should_mesh, surface_shape, write_surface
from dhtorch.integrate.recording import chain_poses
from dhtorch.pipeline.method import Method
from dhtorch.records import Pose
from dhtorch.runtime import storage
from dhtorch.runtime.console import Progress, format_count, has_screen
from dhtorch.runtime.output_folder import open_output_folder
from dhtorch.validation.capture_check import MAX_EXPLAINED_LOSS, CaptureCheck, check_capture
from dhtorch.validation.pose_check import MAX_UNEXPLAINED_DISAGREEMENT, PoseCheck
from dhtorch.viz.plots import (
    CompletedView,
    Strip,
    append_cutoff,
    draw_contact_sheet,
    fit_common_depth_axis,
    format_capture_name,
)
from dhtorch.viz.viewer import html, points
from dhtorch.viz.viewer.exhibit import PageOpening

#: Maximum number of frames in the fused map; evenly spread, further frames show the same surfaces.
_MAX_MAPPED_FRAMES = 40

#: Frames tried for a readable one with depth before a recording is skipped.
_MAX_TRIED_FRAMES = 8

#: Values of the ``dhtorch complete`` options that this command does not have.
_COMPLETE_DEFAULTS = {
    "format": "auto",
    "unit": None,
    "arrays": False,
    "budget": False,
    "figures": False,
    "previews": "all",
    "points": False,
    "max_frames": None,
    "every": 1,
}

#: Names of the files.
CONTACT_SHEET, PREVIEW_VIDEO = "overview.png", "preview.mp4"

#: Frames of the contact sheet: beginning, middle and end of the capture.
_SHEET_FRAMES = 3

#: Maximum number of frames of the moving preview, evenly spread. Source: derived: 20 s at the largest rate.
_MAX_VIDEO_FRAMES = 200

#: Frames whose depths determine the scale of the moving preview. Bounds the memory.
_SCALE_FRAMES = 12

#: Frames per second of the moving preview, and the seconds that a short one lasts. Source: chosen for the eye.
_MIN_FPS, _MAX_FPS, _VIDEO_SECONDS = 2, 10, 8


#: Files written beside those of ``dhtorch complete``.
_FURTHER_FILES = (CONTACT_SHEET, PREVIEW_VIDEO, "map.ply", "map.glb", "view.html")

#: Ratio of baseline to depth, and of that ratio to the angle of rotation in rad, below which stated poses have too
#: small a baseline. Source: chosen: a tenth of the advised ratio; above 0.12 to 0.18 of ``tum_fr1_rpy_a``, which turns,
#: and the 0.13 below which ``stages.shared_error.verify_views`` withholds a view.
_MIN_BASELINE_RATIO, _MIN_BASELINE_PER_TURN = 0.01, 0.2

#: Reasons for missing answers listed on the page, the most frequent.
_MAX_LISTED_REASONS = 3

#: Smallest fraction of the pixels of a listed reason.
_MIN_REASON_SHARE = 0.005


class _NothingToRecover(ValueError):
    """Nothing can be recovered from a capture; the message gives the reason and the remedy."""


@dataclass
class _RecoveredFrames:
    """Progress on one recording."""

    task: CompletionTask
    frames: list[int]  # complete frames, in the order of processing
    broken: dict[int, str]  # position of an unreadable frame → error
    left: int  # frames left at the time limit


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """Complete every recording of a capture within the time limit; returns the exit code.

    Args:
        settings: the options of ``conf/recover.yaml``, resolved.
        parts: ``method``, as an object.
        progress: wraps a loop: (items, text, number of items) → items.

    Raises:
        ValueError, OSError: bad options or data, or nothing can be recovered.
        KeyboardInterrupt: Ctrl-C; complete frames are kept.
    """
    if "browser" in settings:
        return _run_demo(settings, parts, progress)
    file_from_world(settings["axes"], (0.0, 1.0, 0.0))  # refuses other axes before the computation
    path = Path(str(settings["path"])).expanduser()
    reader_options = {name: value for name, value in settings["data"].items() if value is not None}
    captures = [
        replace(capture, options=reader_options) for capture in find_recording_captures(path, settings["format"])
    ]
    name = path.stem if path.is_file() else path.resolve().name or "capture"
    out = Path("dhtorch_out", name) if settings["out"] is None else Path(str(settings["out"])).expanduser()
    if path.is_dir() and out.resolve().is_relative_to(path.resolve()):
        expected = "which is never written to; expected another folder (out=DIR)"
        raise ValueError(f"out: {out} is inside the capture, {expected}")
    recordings: list[tuple[Path, Recording]] = []
    refused: list[str] = []  # reasons
    for capture in captures:
        try:
            recordings += [(capture.path, recording) for recording in _open_capture(capture)]
        except (_NothingToRecover, FormatError) as error:
            if len(captures) == 1:
                raise
            refused.append(str(error))
    chosen = recordings[: settings["recordings"]]
    start, n_done = time.monotonic(), 0
    with open_output_folder(out, "out") if len(chosen) > 1 else contextlib.nullcontext():
        for n, (place, recording) in enumerate(chosen):
            minutes = settings["minutes"]
            until = None if minutes is None else start + 60 * minutes * (n + 1) / len(chosen)
            folder = out if len(chosen) == 1 else out / recording.name
            own = {**settings, "path": place}
            try:
                lines = _process_recording(recording, folder, own, parts["method"], until, progress)
            except _NothingToRecover as nothing:
                refused.append(str(nothing))
                continue
            n_done += 1
            print("\n".join(lines), flush=True)
    if n_done == 0:
        raise _NothingToRecover("; ".join(refused[:3]))
    for line in refused:
        print(line)
    if len(chosen) < len(recordings):
        print(f"{len(chosen)} of {len(recordings)} recordings done; recordings=null does all")
    return 0


def _run_demo(settings: Mapping[str, Any], parts: Mapping[str, Any], progress: Progress) -> int:
    """``dhtorch demo``: write the built-in room as a capture and process it as ``dhtorch PATH`` does.

    Six frames take half a minute on a quiet machine. The room is 6 m deep, so that much lies beyond the range of the
    simulated LiDAR; the camera moves as in a slow walk.

    Raises:
        FileExistsError: the folder has other content.
    """
    from dhtorch.export.stray import write_stray  # noqa: PLC0415
    from dhtorch.synthetic.recording import SyntheticRoom  # noqa: PLC0415

    folder = Path(settings["out"]).expanduser()
    capture, out, unfinished = folder / "room", folder / "result", folder / "room.unfinished"
    if not (capture / "odometry.csv").is_file():
        if folder.exists() and (not folder.is_dir() or any(each != unfinished for each in folder.iterdir())):
            raise FileExistsError(f"out: {folder} has other content, expected a new or empty folder")
        shutil.rmtree(unfinished, ignore_errors=True)
        room = SyntheticRoom(n_frames=6, hw=(240, 320), range_limit=2.5, step_m=0.05)
        write_stray(unfinished, list(room))
        unfinished.rename(capture)
    typed = [word for word in settings["typed"] if word.partition("=")[0] not in ("out", "browser")]
    own = {k: v for k, v in settings.items() if k != "browser"} | {"path": str(capture), "out": str(out)}
    run({**own, "typed": [str(capture), f"out={out}", *typed]}, parts, progress=progress)
    address = (out / "view.html").absolute().as_uri()
    print(f"Open {address}")
    if settings["browser"] and sys.stdout.isatty() and has_screen():
        webbrowser.open(address)
    return 0


# --------------------------------------------------------------------------------------------------------------- input


def find_recording_captures(path: Path, format: str = "auto") -> list[FoundCapture]:
    """Captures at a path, or up to two folders below, that are recordings of a moving camera.

    Raises:
        FormatError: no capture.
        _NothingToRecover: only captures of other kinds.
    """
    if format != "auto":
        return [FoundCapture(path, "recording", format, "format= given")]
    captures = find_captures(path)
    recordings = [each for each in captures if each.kind == "recording"]
    if recordings:
        return recordings
    if captures[0].kind == "stacks":
        what = f"focal stacks ({captures[0].format}) of a still camera"
        raise _NothingToRecover(f"{path}: {what}; images from two positions and depth of near surfaces are required")
    raise _NothingToRecover(f"{path}: {describe_pictures(path, captures)}")


def _open_capture(capture: FoundCapture) -> Sequence[Recording]:
    """The recordings of a capture.

    Raises:
        _NothingToRecover: it has depth but no images.
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
        foreign = describe_layout(capture.path, is_read=True)
        lack = f": {foreign.what}, expected {foreign.remedy}" if foreign else f" ({error})"
        raise _NothingToRecover(f"{capture.path}: depth without images, which tracking requires{lack}") from None


def _order_evenly(n: int) -> list[int]:
    """0 … n − 1 ordered so that the first k are spread evenly for every k, first the middle and both ends.

    The rest is the van der Corput sequence: halves, quarters, eighths …, in bit-reversed order, so that no part of the
    capture waits for the others. Source: J. G. van der Corput, Verteilungsfunktionen, 1935.
    """
    bits = max(n - 1, 0).bit_length()
    sequence = (int(f"{k:0{bits}b}"[::-1], 2) * n >> bits for k in range(1 << bits)) if bits else range(n)
    return list(dict.fromkeys([n // 2, 0, n - 1, *sequence] if n else []))


def _find_usable_frame(recording: Recording) -> int:
    """Position of a readable frame with images and depth.

    Raises:
        _NothingToRecover: no such frame, or fewer than two frames.
    """
    if len(recording) < 2:
        remedy = "recovering depth requires a second view from another position"
        raise _NothingToRecover(f"{recording.name}: {format_count(len(recording), 'frame')}; {remedy}")
    causes, n_without_depth = [], 0
    for k in _order_evenly(len(recording))[:_MAX_TRIED_FRAMES]:
        try:
            frame = recording[k]
        except FormatError as error:
            causes.append(str(error))
            continue
        if 0 in frame.hw:
            what = "depth without images, which tracking requires (rgb.mp4, or a folder of images)"
            raise _NothingToRecover(f"{recording.name}: {what}")
        if bool((frame.depth > 0).any()):
            return k
        n_without_depth += 1
    if n_without_depth:
        raise _NothingToRecover(describe_missing_depth(recording, n_without_depth))
    raise _NothingToRecover(f"{recording.name}: no frame can be read: {causes[0]}")


# ---------------------------------------------------------------------------------------------------------- processing


def _process_recording(
    recording: Recording,
    folder: Path,
    settings: Mapping[str, Any],
    method: Method,
    until: float | None,
    progress: Progress,
) -> list[str]:
    """Complete one recording and write all its files -> the printed lines."""
    reader_options = {"path": str(settings["path"]), "format": recording.format}
    reader_options |= {name: value for name, value in settings["data"].items() if value is not None}
    complete_settings = {**settings, **_COMPLETE_DEFAULTS, "out": str(folder), "data": reader_options}
    complete_settings["reader_format"] = settings["format"]
    complete_settings["choices"] = {**settings["choices"], "data": recording.format}
    usable = _find_usable_frame(recording)
    check = check_capture(recording)
    print_check(recording.name, check)
    recording = check.reported
    scene = Scene.of(recording)
    task = complete.make_completion_task(
        scene,
        folder,
        method,
        complete_settings,
        complete.digest_scene_files(scene, complete_settings, folder),
        sized_as=usable,
    )
    order = [i for i in _order_evenly(len(recording)) if i in task.offers and i % settings["every"] == 0]
    order = order[: settings["max_frames"]]
    task = replace(task, frames=order, offers={i: list(offered) for i, offered in task.offers.items()})
    with complete.open_task_folder(task, _FURTHER_FILES):
        recovered = _complete_in_time(task, until, progress)
        if not recovered.frames:
            reason = next(iter(recovered.broken.values()), "the time limit ended before the first frame (minutes=)")
            raise _NothingToRecover(f"{recording.name}: no frame could be completed: {reason}")
        stats = complete.measure_recovery(task, recovered.frames)
        placed = _place_frames(recovered)
        lines = describe_recovery(task, stats, recording[recovered.frames[0]].hw, check)
        lines += describe_placing(check, recording, placed)
        assumed = [f"{check.assumed_unit[:1].upper()}{check.assumed_unit[1:]}."] if check.assumed_unit else []
        opening = build_opening(
            [*assumed, *(f"Warning: {finding}." for finding in check.findings), *lines],
            stats,
            *write_overview(task, recovered.frames),
        )
        written = _write_map(recovered, placed, opening, settings, progress)
        write_moving_preview(task, recovered.frames, progress)
        shown = written[-1] if written else CONTACT_SHEET
        written = ["depth/", "previews/", CONTACT_SHEET, PREVIEW_VIDEO, *written]
        return [*lines, _format_next_step(recovered, shown), f"Wrote {', '.join(written)} in {folder}."]


def _complete_in_time(task: CompletionTask, until: float | None, progress: Progress) -> _RecoveredFrames:
    """Complete the frames in order until the time limit, at least one; unreadable ones are skipped, also as views."""
    recovered = _RecoveredFrames(task, [], {}, 0)
    todo = [i for i in task.frames if task.missing(i)]
    recovered.frames = [i for i in task.frames if not task.missing(i)]
    n_before = len(recovered.frames)

    def in_time() -> Iterator[int]:
        for n, i in enumerate(todo):
            if until is not None and time.monotonic() > until and len(recovered.frames) > n_before:
                recovered.left = len(todo) - n
                return
            yield i

    left = "" if until is None else f" (at most {max(0.0, until - time.monotonic()) / 60:.1f} min)"
    with complete.close_on_exit(task):
        for i in progress(in_time(), f"{task.scene.name}: frames{left}", len(todo)):
            if _try_frame(recovered, i) and len(recovered.frames) == 1:
                write_overview(task, recovered.frames)
    return recovered


def _try_frame(recovered: _RecoveredFrames, i: int) -> bool:
    """Complete frame ``i`` -> success; unreadable source views are removed and the frame is tried again."""
    task = recovered.task
    while i not in recovered.broken:
        try:
            complete.complete_frame(task, i)
        except FormatError:
            candidates: Any = task.offers.get(i, ())
            broken: dict[int, str] = {}
            for k in (i, *candidates):
                try:
                    task.recording[k]
                except FormatError as error:
                    broken[k] = str(error)
            if not broken:
                raise
            recovered.broken.update(broken)
            for source_views in task.offers.values():
                source_views[:] = [k for k in source_views if k not in broken]  # type: ignore[index]
        else:
            recovered.frames.append(i)
            return True
    return False


def _place_frames(recovered: _RecoveredFrames) -> Recording:
    """The recording with poses that join its frames: its own, else the motions that near returns gave, chained.

    Frames that no motion links to the first completed one have no finite pose.
    """
    task = recovered.task
    if task.recording.poses is not None:
        return task.recording
    position = {int(number): i for i, number in enumerate(task.recording.number)}
    links: dict[int, list[tuple[int, Pose]]] = {i: [] for i in range(len(task.recording))}
    for i in recovered.frames:
        for number, matrix in task.done[task.name(i)].get("motions", {}).items():
            T_view_from_frame = se3.from_matrix(torch.tensor(matrix, dtype=torch.float64)[None])
            links[i].append((position[int(number)], se3.invert(T_view_from_frame)))
            links[position[int(number)]].append((i, T_view_from_frame))
    first = recovered.frames[0]
    placed = chain_poses(first, se3.identity(1, torch.zeros((), dtype=torch.float64)), links)
    n = len(task.recording)
    R = torch.full((n, 3, 3), torch.nan, dtype=torch.float64)
    t = torch.full((n, 3), torch.nan, dtype=torch.float64)
    for k, pose in placed.items():
        R[k], t[k] = pose.R[0], pose.t[0]
    return replace(task.recording, poses=Pose(R, t))


def _write_map(
    recovered: _RecoveredFrames,
    placed: Recording,
    opening: PageOpening,
    settings: Mapping[str, Any],
    progress: Progress,
) -> list[str]:
    """Write the fused map (PLY, GLB) and the viewer page; returns the file names."""
    task = recovered.task
    voxel = choose_voxel(task.recording, recovered.frames) if settings["voxel"] is None else settings["voxel"]

    def read(k: int) -> FrameMap:
        maps, source = complete.read_completed_maps(task, k)
        depth, sigma = (torch.from_numpy(np.ascontiguousarray(maps[x])).float() for x in ("depth", "sigma"))
        return FrameMap(depth, sigma, torch.from_numpy(np.ascontiguousarray(source)))

    frames = recovered.frames[:_MAX_MAPPED_FRAMES]
    surface, up = fuse_frame_maps(
        placed, frames, read, voxel=voxel, meshed=should_mesh(settings["mesh"]), progress=progress
    )
    if not len(surface.xyz):
        return []
    world = "world" if task.recording.poses is not None else "camera"
    ply = task.folder / "map.ply"
    turn = file_from_world(settings["axes"], up)
    write_surface(ply, surface, f"{task.scene.name}'s {world}", up, turn)
    export.write_glb(task.folder / "map.glb", [surface_shape("map", surface, turn, voxel)], up=(0.0, 1.0, 0.0))
    html.write_viewer_page(
        task.folder / "view.html",
        replace(points.read_ply_exhibit(ply), name=format_capture_name(task.scene.name), opening=opening),
    )
    return ["map.ply", "map.glb", "view.html"]


# ------------------------------------------------------------------------------------------------------------ images


def write_overview(task: CompletionTask, frames: Sequence[int]) -> tuple[bytes, str]:
    """Write the contact sheet of evenly spread complete frames -> its PNG and a caption."""
    shown = _pick_evenly(sorted(frames), _SHEET_FRAMES)
    views = [_read_view(task, i) for i in shown]
    out = io.BytesIO()
    name, cutoff = format_capture_name(task.scene.name), task.settings["cutoff"]
    title = append_cutoff(f"{name}, {format_count(len(frames), 'frame')} completed", cutoff)
    draw_contact_sheet(out, views, title=title)
    storage.replace_file(task.folder / CONTACT_SHEET, out.getvalue())
    numbers = ", ".join(str(task.done[task.name(i)]["frame"]) for i in shown)
    place = append_cutoff(f"{name}, frame{'s' * (len(shown) > 1)} {numbers}", cutoff)
    panels = "picture, sensor depth and completed depth on one scale in metres, and sigma / depth"
    return out.getvalue(), f"{place}: {panels}."


def write_moving_preview(task: CompletionTask, frames: Sequence[int], progress: Progress) -> None:
    """Write the moving preview of complete frames, in their order in the capture: picture, sensor, completed."""
    shown = _pick_evenly(sorted(frames), _MAX_VIDEO_FRAMES)
    scale_views = [_read_view(task, i) for i in _pick_evenly(shown, _SCALE_FRAMES)]
    hw = np.asarray(scale_views[0].depth).shape
    title = append_cutoff(format_capture_name(task.scene.name), task.settings["cutoff"])
    strip = Strip(title, (hw[0], hw[1]), fit_common_depth_axis(scale_views))
    fps = min(_MAX_FPS, max(_MIN_FPS, round(len(shown) / _VIDEO_SECONDS)))
    loop = progress(shown, f"{task.scene.name}: preview", len(shown))
    images = (strip.render(_read_view(task, i)) for i in loop)
    video.write_preview_video(task.folder / PREVIEW_VIDEO, strip.picture_hw, images, fps)


def _read_view(task: CompletionTask, i: int) -> CompletedView:
    maps, source = complete.read_completed_maps(task, i)
    picture = np.atleast_3d(complete.resize_picture(task.recording[i], source.shape)).transpose(2, 0, 1)
    return CompletedView(f"Frame {task.done[task.name(i)]['frame']}", picture, maps["depth"], maps["sigma"], source)


def _pick_evenly(frames: Sequence[int], n: int) -> list[int]:
    """``n`` of the frames at most, each from the middle of its part of them."""
    n = min(n, len(frames))
    return [frames[int((k + 0.5) * len(frames) / n)] for k in range(n)]


# ------------------------------------------------------------------------------------------------------------ summary


def _format_next_step(recovered: _RecoveredFrames, shown: str) -> str:
    """The printed next step; ``shown`` is the file to open."""
    task, n = recovered.task, len(recovered.broken)
    settings = task.settings
    cause = next(iter(recovered.broken.values()), "")
    broken = f"\n{format_count(n, 'frame')} of {task.scene.name} could not be read ({cause})." if n else ""
    if recovered.left:  # the command as typed, without its time limit
        typed = [word for word in settings["typed"] if not word.startswith("minutes=")]
        left = f"{recovered.left} of {format_count(len(task.frames), 'frame')} left at the time limit"
        command = shlex.join(["dhtorch", *typed, "--minutes", "null"])
        return f"Next: open {shown}; {left}, to complete them: {command}{broken}"
    # The command that measures the error: the same reader options, a cutoff beyond which half of the returns lie
    reader = {name: value for name, value in settings["data"].items() if name not in ("path", "format")}
    if settings["reader_format"] != "auto":
        reader["format"] = settings["reader_format"]
    words = []  # values as written on the command line
    for name, value in reader.items():
        if value is not None:
            text = f"[{','.join(map(str, value))}]" if isinstance(value, list) else str(value)
            words.append(f"data.{name}={text.lower() if isinstance(value, bool) else text}")
    cutoff = 2.0  # m, where no completed frame has a return
    median = complete.measure_median_return(task, recovered.frames)
    if median is not None:  # rounded up to two digits
        step = 10.0 ** (math.floor(math.log10(median)) - 1)
        cutoff = math.ceil(median / step - 1e-9) * step
    command = shlex.join(["dhtorch", "run", str(settings["path"]), *words, "--cutoff", f"{cutoff:g}"])
    return f"Next: open {shown}; to measure the error on your capture: {command}{broken}"


def describe_recovery(
    task: CompletionTask, stats: complete.RecoveryStats, hw: tuple[int, int], check: CaptureCheck
) -> list[str]:
    """Printed sentences: the capture (images (h, w)), and what was recovered, else what its check shows."""
    recording, (h, w) = task.recording, hw
    kind = f"{task.scene.name}: a {recording.format} capture, {format_count(len(recording), 'frame')} of {w}x{h}"
    filled = f"{stats.pixels['filled']:,.0f}" if stats.fractions["filled"] else ""
    guess = intrinsics_options.find_guess_report(recording.report)
    sensor = f"{kind}; the sensor has depth at {stats.fractions['sensor']:.0%} of the pixels"
    sensor += f"; its {guess}." if guess else "."
    if stats.error is None:
        blamed = bool(check.findings) and stats.fractions["no_answer"] > _MIN_REASON_SHARE
        reason = str(check.findings[0]) if blamed else _explain_silence(stats, check.poses)
        also = f" Filled {filled} pixels per frame by interpolation." if filled else ""
        return [sensor, f"Nothing was recovered: {reason}.{also}"]
    amount = f"Recovered {stats.pixels['recovered']:,.0f} pixels per frame from other views, at {stats.near:.1f} m to"
    amount += f" {stats.far:.1f} m, median sigma {stats.error:.1%} of the depth"
    amount += f"; filled {filled} by interpolation" if filled else ""
    return [sensor, f"{amount} ({format_count(stats.frames, 'frame')})."]


def describe_placing(check: CaptureCheck, recording: Recording, placed: Recording) -> list[str]:
    """Sentence on how the map is joined where the capture's poses are not used; none where they are."""
    if recording.poses is not None or placed.poses is None:
        return []
    n = int(placed.poses.t.isfinite().all(-1).sum())
    why = "the stated poses are refuted" if check.poses_refuted else "the capture has no poses"
    return [f"The map is joined by the motion that near returns give ({format_count(n, 'frame')}): {why}."]


def build_opening(sentences: Sequence[str], stats: complete.RecoveryStats, picture: bytes, caption: str) -> PageOpening:
    """The opening of the page; ``picture`` is the PNG of the contact sheet."""
    shown = {"Recovered pixels per frame": f"{stats.pixels['recovered']:,.0f}"}
    if stats.error is not None:
        shown["Recovered, median sigma / depth"] = f"{stats.error:.1%}"
    for kind, fraction in stats.fractions.items():
        shown[f"{words(kind).capitalize()}, fraction of the pixels"] = f"{fraction:.1%}"
    listed = [
        f"{describe_gate(name)} ({share:.1%} of the pixels)"
        for name, share in stats.reasons
        if share >= _MIN_REASON_SHARE
    ]
    reason_lines = (
        [f"Most frequent reasons for no answer: {'; '.join(listed[:_MAX_LISTED_REASONS])}."] if listed else []
    )
    return PageOpening(shown, [*sentences, *reason_lines], picture, caption)


def _explain_silence(stats: complete.RecoveryStats, poses: PoseCheck | None) -> str:
    """Most frequent reason for missing answers that has a remedy."""
    for name, share in stats.reasons:
        if share > 0.01 and (remedy := suggest_remedy(name)) is not None:
            if name == "no_baseline" and stats.motion is not None:
                return _explain_no_baseline(stats.motion, poses)
            return remedy
    return "the sensor has depth almost everywhere; cutoff=2.0 hides far returns to show what other views recover"


def _explain_no_baseline(motion: complete.StatedMotion, poses: PoseCheck | None) -> str:
    """Why near returns show no translation although poses are stated: what these and the check of the capture show."""
    ratio = motion.baseline / motion.depth
    moved = f"the stated poses move by {motion.baseline:.2g} m between views, {ratio:.1%} of the median depth"
    if ratio < max(_MIN_BASELINE_RATIO, _MIN_BASELINE_PER_TURN * motion.turn):
        turned = f"and turn by {math.degrees(motion.turn):.0f} degrees"
        return f"{moved}, {turned}; moving sideways by a tenth of the distance would help"
    unexplained = f"{moved}, which the near returns do not show; more texture, and returns nearby, would help"
    if poses is None:
        return unexplained
    if poses.surfaces.stated > MAX_UNEXPLAINED_DISAGREEMENT:
        disagreement = f"{poses.surfaces.stated:.1%} of the depth"
        return f"{moved}, but poses and depth disagree by {disagreement}: one of them is wrong or noisy"
    if poses.tracks is None:
        return f"{moved}, but too few near returns were tracked; slower motion, more light and texture would help"
    if poses.tracks.stated > MAX_EXPLAINED_LOSS:
        loss = f"near returns miss their tracks: mean loss {poses.tracks.stated:.2f} of 1"
        return f"{moved}, but depth and images do not fit each other ({loss}); see K, and whether one was resized"
    return unexplained
