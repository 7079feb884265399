"""Check of the captures that a command reads, before it uses them: printed notes and warnings, refuted poses removed.

All commands call it on the recordings of their data, so that one capture gives one set of findings everywhere. The
lines become the recordings' report, which the commands write into their files.
"""

import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from dhtorch.data.foreign_files import NEEDS_DEPTH, describe_layout
from dhtorch.data.io.decode import FormatError
from dhtorch.data.recording import Recording, Recordings
from dhtorch.data.scene import Scene, Scenes
from dhtorch.runtime.console import format_count, get_verbosity
from dhtorch.validation.capture_check import CaptureCheck, check_capture

#: Recordings of one data set that are checked: episodes of a set are written by one program. Limits the time at the
#: start of a command to some seconds.
_MAX_CHECKED_RECORDINGS = 12

#: Frames of a recording that are examined for depth. Limits the time.
_MAX_EXAMINED_FRAMES = 4


def require_depth(scenes: Sequence[Scene], *, remedy: str | None = None) -> None:
    """Raise an error if no recording of a command from disk has depth; print those of several that have none.

    Args:
        scenes: of the command.
        remedy: appended to the error's message.

    Raises:
        ValueError: none of the examined recordings has depth.
    """
    missing: list[str] = []
    n_examined = min(len(scenes), _MAX_CHECKED_RECORDINGS)
    for k in range(n_examined):
        recording = scenes[k].recording
        if recording.root is None or (n := _count_without_depth(recording)) is None:
            if isinstance(scenes, Scenes):
                return  # opened lazily: the first with depth is enough
            continue
        missing.append(describe_missing_depth(recording, n))
    if missing and len(missing) == n_examined:
        more = f" ({n_examined} recordings examined)" if n_examined > 1 else ""
        raise ValueError("; ".join(filter(None, (f"{missing[0]}{more}", remedy))))
    for line in missing:
        warnings.warn(line, stacklevel=2)


def describe_missing_depth(recording: Recording, n: int) -> str:
    """The message on a recording of whose ``n`` examined frames none has depth."""
    what = f"{format_count(len(recording), 'frame')}, none of the {n} examined has depth"
    lacking = None if recording.root is None else describe_layout(recording.root, is_read=True)
    lack = f" ({lacking.what}, expected {lacking.remedy})" if lacking else ""
    return f"{recording.name}: {what}; {NEEDS_DEPTH}{lack}"


def _count_without_depth(recording: Recording) -> int | None:
    """Number of examined frames if none has depth; None where one has, or where no frame can be read."""
    n, step = 0, max(1, len(recording) // _MAX_EXAMINED_FRAMES)
    for k in range(0, len(recording), step):
        try:
            frame = recording[k]
        except FormatError:
            continue
        if bool((frame.depth > 0).any()):
            return None
        n += 1
    return n or None


def check_data(data: Any) -> Any:
    """Scenes of a command -> the same scenes with checked recordings; other data are returned as they are.

    Of a lazily opened set only the first recording is checked: its assumed unit and findings enter the report of all
    recordings, and where its poses are refuted, those of all recordings are removed.
    """
    if isinstance(data, Scenes) and not isinstance(data.recordings, Recordings):
        return check_data(list(data))
    if isinstance(data, Recordings | Scenes):
        scenes = data if isinstance(data, Scenes) else Scenes(data)
        first = scenes[0]
        examined = check_scene(first).recording
        added = tuple(line for line in examined.report if line not in first.recording.report)
        is_refuted = first.recording.poses is not None and examined.poses is None
        return replace(scenes, annotate=partial(_annotate_as_first, scenes.annotate, added, is_refuted))
    if isinstance(data, Scene | Recording):
        return check_scene(Scene.of(data))
    if isinstance(data, Sequence) and all(isinstance(each, Scene | Recording) for each in data):
        all_scenes = [Scene.of(each) for each in data]
        checked = [check_scene(each) for each in all_scenes[:_MAX_CHECKED_RECORDINGS]]
        return [*checked, *all_scenes[_MAX_CHECKED_RECORDINGS:]]
    return data


def check_scene(scene: Scene) -> Scene:
    """A scene with its recording checked; findings are printed. Recordings that are not from disk are left alone."""
    if scene.recording.root is None:
        return scene
    check = check_capture(scene.recording)
    print_check(scene.name, check)
    return replace(scene, recording=check.reported)


def print_check(name: str, check: CaptureCheck) -> None:
    """Print what was assumed and the reader's report to stderr, and the findings as warnings."""
    for line in (*([check.assumed_unit] if check.assumed_unit else []), *check.recording.report):
        if get_verbosity() != "quiet":
            print(f"{name}: {line}", file=sys.stderr)
    for finding in check.findings:
        warnings.warn(f"{name}: {finding}", stacklevel=2)


def _annotate_as_first(
    annotate: Callable[[Recording], Scene], added: Sequence[str], is_refuted: bool, recording: Recording
) -> Scene:
    """Recording → scene with the lines, and without the poses, that the check of the set's first recording gave."""
    scene = annotate(recording)
    poses, report = None if is_refuted else scene.recording.poses, (*scene.recording.report, *added)
    return replace(scene, recording=replace(scene.recording, poses=poses, report=report))
