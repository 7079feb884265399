"""Files to frames: the only place with file decoding, unit changes and axis changes.

``open(path)`` recognises a capture by its content and returns its :class:`Recording`, a lazy sequence of frames; for
focal stacks, which show one view without depth of their own, it returns :class:`Stacks`. A format is one module with
``recognise(root)`` and ``read(root, *, options)``, and one line in the table below or in ``STACK_FORMATS``.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from dhtorch.data import arkitscenes, ca1m, driving, frames_dir, lerobot, record3d, rectified, rh20t, stray, tum
from dhtorch.data.files import FormatError
from dhtorch.data.focal_stacks import STACK_FORMATS, open_stacks
from dhtorch.data.recording import Recording, Recordings
from dhtorch.data.stacks import Stacks

__all__ = [
    "FORMATS",
    "STACK_FORMATS",
    "FormatError",
    "Recording",
    "Recordings",
    "Stacks",
    "open",
    "open_all",
    "open_scenes",
    "open_stacks",
    "recognise",
]

#: Name → reader, asked in this order; the first that recognises a folder reads it.
FORMATS: Final[dict[str, ModuleType]] = {
    "record3d": record3d,  # before tum: its folder, too, holds rgb/ and depth/
    "tum": tum,
    "driving": driving,
    "rectified": rectified,
    "arkitscenes": arkitscenes,
    "ca1m": ca1m,
    "rh20t": rh20t,
    "lerobot": lerobot,
    "stray": stray,
    "frames_dir": frames_dir,
}

#: The variable that says where a collection of scenes lies.
ROOT_VARIABLE: Final = "DHTORCH_DATA"

_SHOWN = 4  # names of many recordings in a message


def open(root: str | Path, format: str = "auto", **options: Any) -> Recording | Stacks:
    """The one recording at ``root``, or its focal stacks; see :func:`open_all` for the arguments.

    Raises:
        FormatError: as :func:`open_all`, and where there are several recordings (a car with many cameras).
    """
    found = open_all(root, format, **options)
    if len(found) > 1:
        names = found.names if isinstance(found, Recordings) else [each.name for each in found]
        shown = ", ".join(names[:_SHOWN]) + (" …" if len(names) > _SHOWN else "")
        raise FormatError(root, "recordings", f"{len(found)} recordings: {shown}", "one (open_all returns them all)")
    return found[0]


def open_all(
    root: str | Path,
    format: str = "auto",
    *,
    near: float | None = None,
    gap: int | None = None,
    levels: int | None = None,
    room: str | None = None,
    role: str | None = None,
    **options: Any,
) -> Sequence[Recording] | Sequence[Stacks]:
    """Every recording at ``root``, opened lazily: nothing is decoded before a frame is asked for.

    Args:
        root: a folder (or file) of one of the known formats.
        format: a name of ``FORMATS`` or ``STACK_FORMATS``, or ``"auto"`` to recognise it by its content.
        near: m, cutoff for a range split; kept in the recording.
        gap: frame step with a usable baseline; kept in the recording.
        levels: pyramid levels for the motion in this scene; kept in the recording.
        room: name shared by the recordings of one place; kept in the recording.
        role: ``"rotation"`` for a scene without baseline; kept in the recording.
        options: keyword options of the reader, see ``dhtorch.data.<format>.read``.

    Returns:
        One recording for each camera (and episode), at least one; where there may be tens of thousands each is opened
        when it is asked for. For focal stacks: the one collection of them.

    Raises:
        FormatError: nothing there, an unknown format, or a file that is not what its format promises.
        ValueError: an option that the reader does not have.
    """
    root = Path(root)
    if format == "auto":
        format = recognise(root)[0]
    elif format not in FORMATS and format not in STACK_FORMATS:
        raise FormatError(root, "format", format, f"auto, {', '.join((*FORMATS, *STACK_FORMATS))}")
    elif not root.exists():
        raise FormatError(root, "path", "no such file or folder", f"a {format} capture")
    facts = {"near": near, "gap": gap, "levels": levels, "room": room, "role": role}
    kept = {name: value for name, value in facts.items() if value is not None}
    if format in STACK_FORMATS:
        if kept:
            raise ValueError(f"data: {', '.join(kept)} given for {root}, which holds focal stacks ({format})")
        return [open_stacks(root, format, **options)]
    read = FORMATS[format].read
    known = list(inspect.signature(read).parameters)[1:]
    for option in options:
        if option not in known:
            raise ValueError(f"data: format {format} has no option {option!r}, expected one of {', '.join(known)}")
    found = read(root, **options)
    if isinstance(found, Recordings):
        return found.replaced(kept)
    return [replace(recording, **kept) for recording in found]


def recognise(root: str | Path) -> tuple[str, str]:
    """(format, what makes it one, in words) of a capture: a recording wins over focal stacks.

    Raises:
        FormatError: nothing there, or no format recognises it.
    """
    root = Path(root)
    if not root.exists():
        raise FormatError(root, "path", "no such file or folder", "a capture")
    for name, reader in (FORMATS | STACK_FORMATS).items():
        if evidence := reader.recognise(root):
            return name, evidence
    inside = (
        sorted(entry.name for entry in root.iterdir())[:6] if root.is_dir() else [f"a {root.suffix or 'plain'} file"]
    )
    expected = f"one of {', '.join((*FORMATS, *STACK_FORMATS))} (dhtorch inspect looks further down)"
    raise FormatError(root, "format", ", ".join(inside) or "an empty folder", expected)


def open_scenes(root: str | Path | None = None, scenes: Sequence[Mapping[str, Any]] = ()) -> list[Recording | Stacks]:
    """Recordings of a list of scenes below one folder.

    Args:
        root: folder that the scenes' paths start from. None = the environment variable ``DHTORCH_DATA``.
        scenes: for each scene ``path``, and the arguments of :func:`open_all` that it needs (``format``, ``near``, …).

    Raises:
        FormatError: no folder given and ``DHTORCH_DATA`` unset, no scene, a scene without a path; else as
            :func:`open_all`.
    """
    root = root if root is not None else os.environ.get(ROOT_VARIABLE)
    if not root:
        raise FormatError(ROOT_VARIABLE, "environment variable", "nothing", "the folder that holds the scenes")
    if not Path(root).is_dir():
        raise FormatError(root, "path", "no such folder", f"the folder that holds the scenes ({ROOT_VARIABLE})")
    if not scenes:
        raise FormatError(root, "scenes", "none", "a list of scenes, each with a path")
    recordings: list[Recording | Stacks] = []
    for scene in scenes:
        options = dict(scene)
        if "path" not in options:
            raise FormatError(root, "scenes", options, "an entry with a path")
        recordings += open_all(Path(root) / str(options.pop("path")), **options)
    return recordings
