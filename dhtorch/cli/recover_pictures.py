"""Contact sheet and moving preview of the completed frames of ``dhtorch PATH``."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence

import numpy as np

from dhtorch.cli import completed_folder as completed
from dhtorch.cli.complete import Progress, resize_picture
from dhtorch.cli.completed_folder import CompletionTask
from dhtorch.export import video
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count
from dhtorch.viz.plots import (
    CompletedView,
    Strip,
    append_cutoff,
    draw_contact_sheet,
    fit_common_depth_axis,
    format_capture_name,
)

#: Names of the files.
CONTACT_SHEET, PREVIEW_VIDEO = "overview.png", "preview.mp4"

#: Frames of the contact sheet: beginning, middle and end of the capture.
_SHEET_FRAMES = 3

#: Maximum number of frames of the moving preview, evenly spread. Source: derived: 20 s at the largest rate.
_MAX_VIDEO_FRAMES = 200

#: Frames whose depths determine the scale of the moving preview. Source: origin not recorded; bounds the memory.
_SCALE_FRAMES = 12

#: Frames per second of the moving preview, and the seconds that a short one lasts. Source: chosen for the eye.
_MIN_FPS, _MAX_FPS, _VIDEO_SECONDS = 2, 10, 8


def write_overview(task: CompletionTask, frames: Sequence[int]) -> tuple[bytes, str]:
    """Write the contact sheet of evenly spread complete frames -> its PNG and a caption."""
    shown = _pick_evenly(sorted(frames), _SHEET_FRAMES)
    views = [_read_view(task, i) for i in shown]
    out = io.BytesIO()
    name = format_capture_name(task.scene.name)
    draw_contact_sheet(out, views, title=_add_cutoff(task, f"{name}, {format_count(len(frames), 'frame')} completed"))
    storage.replace_file(task.folder / CONTACT_SHEET, out.getvalue())
    panels = "picture, sensor depth and completed depth on one scale in metres, and sigma / depth"
    numbers = ", ".join(str(task.done[task.name(i)]["frame"]) for i in shown)
    place = _add_cutoff(task, f"{name}, frame{'s' * (len(shown) > 1)} {numbers}")
    return out.getvalue(), f"{place}: {panels}."


def write_moving_preview(task: CompletionTask, frames: Sequence[int], progress: Progress) -> None:
    """Write the moving preview of complete frames, in their order in the capture: picture, sensor, completed."""
    shown = _pick_evenly(sorted(frames), _MAX_VIDEO_FRAMES)
    scale_views = [_read_view(task, i) for i in _pick_evenly(shown, _SCALE_FRAMES)]
    hw = np.asarray(scale_views[0].depth).shape
    title = _add_cutoff(task, format_capture_name(task.scene.name))
    strip = Strip(title, (hw[0], hw[1]), fit_common_depth_axis(scale_views))
    fps = min(_MAX_FPS, max(_MIN_FPS, round(len(shown) / _VIDEO_SECONDS)))

    def render() -> Iterator[np.ndarray]:
        for i in progress(shown, f"{task.scene.name}: preview", len(shown)):
            yield strip.render(_read_view(task, i))

    video.write_preview_video(task.folder / PREVIEW_VIDEO, strip.picture_hw, render(), fps)


def _read_view(task: CompletionTask, i: int) -> CompletedView:
    maps, source = completed.read_completed_maps(task, i)
    picture = np.atleast_3d(resize_picture(task.recording[i], source.shape)).transpose(2, 0, 1)
    return CompletedView(f"Frame {task.done[task.name(i)]['frame']}", picture, maps["depth"], maps["sigma"], source)


def _add_cutoff(task: CompletionTask, text: str) -> str:
    return append_cutoff(text, task.settings["cutoff"])


def _pick_evenly(frames: Sequence[int], n: int) -> list[int]:
    """``n`` of the frames at most, each from the middle of its part of them."""
    n = min(n, len(frames))
    return [frames[int((k + 0.5) * len(frames) / n)] for k in range(n)]
