"""Files to frames: the only place with file decoding, unit changes and axis changes.

``open(path)`` recognises a capture by its content and returns its :class:`Recording`, a lazy sequence of frames. A
format is one module of ``readers`` with ``recognise(root)`` and ``read(root, *, options)``, and one line in the table
below. Focal stacks show one view without depth of their own: ``dhtorch.experiments.focal`` reads them.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, Final, Protocol, cast

from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io.decode import FormatError
from dhtorch.data.io.safe_open import restrict_links
from dhtorch.data.recording import Recording, Recordings
from dhtorch.data.scene import Scene, SceneLike, Scenes, scenes_of
from dhtorch.runtime import console

# The table of formats: one line for each reader, in the order in which they are asked. FORMATS is made from it.
from dhtorch.data.readers import (  # noqa: F401  # isort: skip
    record3d,  # before tum: its folder, too, holds rgb/ and depth/
    tum,
    driving,
    rectified,
    arkitscenes,
    ca1m,
    rh20t,
    lerobot,
    rlds,
    stray,
    frames_dir,
)

__all__ = [
    "FORMATS",
    "FormatError",
    "Reader",
    "Recording",
    "Recordings",
    "Scene",
    "SceneLike",
    "Scenes",
    "open",
    "open_all",
    "open_capture",
    "open_scenes",
    "recognise",
    "scenes_of",
    "scenes_root",
]


class Reader(Protocol):
    """A format: the two functions of its module."""

    @property
    def recognise(self) -> Callable[[Path], str | None]:
        """What makes a folder or file one of its captures, in words; None if nothing does."""

    @property
    def read(self) -> Callable[..., Sequence[Recording]]:
        """Open the recordings at a path; keyword options of its own."""


#: Name → reader, asked in this order; the first that recognises a folder reads it.
FORMATS: Final[dict[str, Reader]] = {
    name: cast(Reader, module)
    for name, module in list(vars().items())
    if isinstance(module, ModuleType) and module.__name__ == f"{__name__}.readers.{name}"
}

#: The variable that says where a collection of scenes lies.
_SCENES_ROOT_VARIABLE: Final = "DHTORCH_DATA"

_UNSET_INTRINSICS = [
    (name, None) for name in intrinsics_options.INTRINSICS_OPTIONS
]  # as settings that serve all formats have them

_MAX_NAMES_SHOWN = 4  # names of many recordings in a message


def open(root: str | Path, format: str = "auto", *, follow_links: bool = False, **options: object) -> Recording:
    """The one recording at ``root``; see :func:`open_all` for the arguments.

    Raises:
        FormatError: as :func:`open_all`, and where there are several recordings (a car with many cameras).
    """
    found = open_all(root, format, follow_links=follow_links, **options)
    if len(found) > 1:
        names = found.names if isinstance(found, Recordings) else [each.name for each in found]
        shown = ", ".join(names[:_MAX_NAMES_SHOWN]) + (" …" if len(names) > _MAX_NAMES_SHOWN else "")
        raise FormatError(root, "recordings", f"{len(found)} recordings: {shown}", "one (open_all returns them all)")
    return found[0]


def open_all(
    root: str | Path,
    format: str = "auto",
    *,
    follow_links: bool = False,
    **options: object,
) -> Sequence[Recording]:
    """Every recording at ``root``, opened lazily: nothing is decoded before a frame is asked for.

    Args:
        root: a folder (or file) of one of the known formats.
        format: a name of ``FORMATS``, or ``"auto"`` to recognise it by its content.
        follow_links: whether symbolic links inside the capture may lead out of it.
        options: keyword options of the reader, see ``dhtorch.data.<format>.read``. Where its captures may lack a K
            ``intrinsics``, ``K`` and ``fov`` are among them, see :mod:`dhtorch.data.intrinsics`.

    Returns:
        One recording for each camera (and episode), at least one; where there may be tens of thousands each is opened
        when it is asked for.

    Raises:
        FormatError: nothing there, an unknown format, or a file that is not what its format promises.
        ValueError: an option that the reader does not have.
    """
    root = Path(root)
    bounds = None if follow_links else root
    if format == "auto":
        format = recognise(root, follow_links=follow_links)[0]
    elif format not in FORMATS:
        raise FormatError(root, "format", format, f"auto, {', '.join(FORMATS)}")
    elif not root.exists():
        raise FormatError(root, "path", "no such file or folder", f"a {format} capture")
    read = FORMATS[format].read
    known = list(inspect.signature(read).parameters)[1:]
    options = {name: value for name, value in options.items() if (name, value) not in _UNSET_INTRINSICS}
    for option in options:
        if option not in known:
            shown = f"{option!r}{console.suggest_name(option, known)}"
            raise ValueError(f"data: format {format} has no option {shown}, expected one of {', '.join(known)}")
    with restrict_links(bounds):
        found = read(root, **options)
    if isinstance(found, Recordings):
        return replace(found, make=_RestrictedOpener(found.make, bounds))
    return [replace(recording, bounds=bounds) for recording in found]


@dataclass(frozen=True)
class _RestrictedOpener:
    """Opens one of many recordings, no link of which may lead out of the capture."""

    make: Callable[[int], Recording]
    bounds: Path | None

    def __call__(self, i: int) -> Recording:
        with restrict_links(self.bounds):
            return replace(self.make(i), bounds=self.bounds)


def open_capture(
    root: str | Path,
    format: str = "auto",
    *,
    near: float | None = None,
    gap: int | None = None,
    levels: int | None = None,
    room: str | None = None,
    role: str | None = None,
    follow_links: bool = False,
    **options: object,
) -> Scenes:
    """Every recording at ``root`` as a scene, with the same notes, opened lazily.

    Args:
        root, format, follow_links, options: as :func:`open_all`.
        near, gap, levels, room, role: notes of the :class:`Scene`.

    Raises:
        FormatError, ValueError: as :func:`open_all`.
    """
    noted = partial(Scene, near=near, gap=gap, levels=levels, room=room, role=role)
    return Scenes(open_all(root, format, follow_links=follow_links, **options), noted)


def recognise(root: str | Path, *, follow_links: bool = False) -> tuple[str, str]:
    """(format, what makes it one, in words) of a capture.

    Raises:
        FormatError: nothing there, or no format recognises it.
    """
    root = Path(root)
    if not root.exists():
        raise FormatError(root, "path", "no such file or folder", "a capture")
    with restrict_links(None if follow_links else root):
        for name, reader in FORMATS.items():
            if evidence := reader.recognise(root):
                return name, evidence
    listed = (
        sorted(entry.name for entry in root.iterdir())[:6] if root.is_dir() else [f"a {root.suffix or 'plain'} file"]
    )
    expected = f"one of {', '.join(FORMATS)} (dhtorch inspect looks further down)"
    raise FormatError(root, "format", ", ".join(listed) or "an empty folder", expected)


def open_scenes(root: str | Path | None = None, scenes: Sequence[Mapping[str, Any]] = ()) -> list[Scene]:
    """A list of scenes below one folder.

    Args:
        root: folder that the scenes' paths start from. None = the environment variable ``DHTORCH_DATA``.
        scenes: for each scene ``path``, and the arguments of :func:`open_capture` that it needs (``format``, ``near``,
            …).

    Raises:
        FormatError: no folder given and ``DHTORCH_DATA`` unset, no scene, a scene without a path; else as
            :func:`open_capture`.
    """
    root = scenes_root(root)
    if not scenes:
        raise FormatError(root, "scenes", "none", "a list of scenes, each with a path")
    found: list[Scene] = []
    for scene in scenes:
        options = dict(scene) if isinstance(scene, Mapping) else {}
        if "path" not in options:
            raise FormatError(root, "scenes", scene, "entries with a path, as {path:holo_a,near:2.5}")
        found += open_capture(root / str(options.pop("path")), **options)
    return found


def scenes_root(root: str | Path | None) -> Path:
    """The folder that the paths of scenes start from; None = the environment variable ``DHTORCH_DATA``.

    Raises:
        FormatError: none given and the variable unset, or no such folder.
    """
    root = root if root is not None else os.environ.get(_SCENES_ROOT_VARIABLE)
    if not root:
        raise FormatError(_SCENES_ROOT_VARIABLE, "environment variable", "nothing", "the folder that holds the scenes")
    if not Path(root).is_dir():
        raise FormatError(root, "path", "no such folder", f"the folder that holds the scenes ({_SCENES_ROOT_VARIABLE})")
    return Path(root)
