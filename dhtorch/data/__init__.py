"""Readers: capture files -> recordings of frames; all file decoding and conversion of units and axes is done here.

``open(path)`` recognises a capture by its content and returns its :class:`Recording`, a lazy sequence of frames. A
format is one module with ``recognise(root)`` and ``read(root, *, options)``, one import and one line in the table
below. Focal stacks have one view and no depth of their own: they are read by ``dhtorch.experiments.focal``.
"""

import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol

from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.corrections import Corrections
from dhtorch.data.foreign_files import PHONE_EXPORTS, describe_foreign_file, describe_foreign_folder
from dhtorch.data.io.decode import FormatError, refuse_if
from dhtorch.data.readers import (
    arkitscenes,
    azure_kinect,
    ca1m,
    colmap,
    driving,
    frames_dir,
    lerobot,
    nerfstudio,
    polycam,
    record3d,
    rectified,
    rh20t,
    rlds,
    rosbag,
    simulator_hdf5,
    stray,
    tum,
)
from dhtorch.data.readers.layouts import LAYOUTS
from dhtorch.data.recording import Recording, Recordings
from dhtorch.data.scene import Scene, SceneLike, Scenes, scenes_of
from dhtorch.data.unread import report_unread
from dhtorch.runtime import console
from dhtorch.runtime.numerics import standard_numerics
from dhtorch.runtime.safe_open import check_file_or_folder, record_opened_files, restrict_links

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
    """Interface of a format's module: two functions.

    It may list names of files in ``UNUSED_FILES`` (glob patterns) that :mod:`dhtorch.data.unread` does not report.
    """

    @property
    def recognise(self) -> Callable[[Path], str | None]:
        """Path → the files by which it is recognised as a capture of this format, as text; None if it is not."""

    @property
    def read(self) -> Callable[..., Sequence[Recording]]:
        """Path and the format's keyword options → the recordings at that path."""


#: Name → reader, tried in this order; the first that recognises a path reads it.
FORMATS: Final[dict[str, Reader]] = {
    "record3d": record3d,  # before tum: its folder holds rgb/ and depth/, too
    "polycam": polycam,
    "nerfstudio": nerfstudio,
    **LAYOUTS,  # the image folders with a file that states their meaning: before those of names alone
    "tum": tum,
    "driving": driving,
    "rectified": rectified,
    "arkitscenes": arkitscenes,
    "ca1m": ca1m,
    "rh20t": rh20t,
    "lerobot": lerobot,
    "rlds": rlds,
    "stray": stray,
    "rosbag": rosbag,
    "azure_kinect": azure_kinect,
    "simulator_hdf5": simulator_hdf5,
    "colmap": colmap,
    "frames_dir": frames_dir,
}

#: Environment variable with the folder of a collection of scenes.
_SCENES_ROOT_VARIABLE: Final = "DHTORCH_DATA"

#: Unset intrinsics options: passed by settings for all formats, ignored by readers without these options.
_UNSET_INTRINSICS = [(name, None) for name in intrinsics_options.INTRINSICS_OPTIONS]

#: Names of folders with the images of a recording.
_IMAGE_FOLDERS: Final = ("images", "image", "rgb", "color", "colour")

_MAX_NAMES_SHOWN = 4  # names of recordings in a message


@standard_numerics
def open(root: str | Path, format: str = "auto", *, follow_links: bool = False, **options: object) -> Recording:
    """Open the only recording at ``root``; see :func:`open_all` for the arguments.

    Raises:
        FormatError: as :func:`open_all`, or several recordings (a car with many cameras).
    """
    recordings = open_all(root, format, follow_links=follow_links, **options)
    if len(recordings) > 1:
        names = recordings.names if isinstance(recordings, Recordings) else [recording.name for recording in recordings]
        shown = ", ".join(names[:_MAX_NAMES_SHOWN]) + (" …" if len(names) > _MAX_NAMES_SHOWN else "")
        raise FormatError(
            root, "recordings", f"{len(recordings)} recordings: {shown}", "one (open_all returns them all)"
        )
    return recordings[0]


@standard_numerics
def open_all(
    root: str | Path,
    format: str = "auto",
    *,
    follow_links: bool = False,
    **options: object,
) -> Sequence[Recording]:
    """Open every recording at ``root``, lazily: a frame is decoded on access.

    Args:
        root: a folder (or file) of one of the formats in ``FORMATS``.
        format: a name of ``FORMATS``, or ``"auto"`` to recognise it by its content.
        follow_links: whether symbolic links inside the capture may point outside it.
        options: ``depth_unit``, ``pose_convention``, ``depth_lag`` and ``depth_turn`` of
            :class:`dhtorch.data.corrections.Corrections`, and keyword options of the format's ``read`` in
            :mod:`dhtorch.data.readers`. For formats without a stored K they include ``intrinsics``, ``K`` and ``fov``,
            see :mod:`dhtorch.data.intrinsics`.

    Returns:
        One recording for each camera (and episode), at least one; formats with up to tens of thousands of recordings
        open each on access.

    Raises:
        FormatError: no such path, an unknown format, or a file that does not conform to its format.
        ValueError: an option that the reader does not have.
    """
    root = Path(root)
    bounds = None if follow_links else root
    if format == "auto":
        format = recognise(root, follow_links=follow_links)[0]
    elif format not in FORMATS:
        raise FormatError(root, "format", format, f"auto, {', '.join(FORMATS)}")
    else:
        check_file_or_folder(root, f"a {format} capture")
    corrections = Corrections.from_options(options)
    options = {name: value for name, value in options.items() if name not in Corrections.names()}
    read = FORMATS[format].read
    reader_options = list(inspect.signature(read).parameters)[1:]
    options = {name: value for name, value in options.items() if (name, value) not in _UNSET_INTRINSICS}
    for option in options:
        if option not in reader_options:
            shown = f"{option!r}{console.suggest_name(option, reader_options)}"
            raise ValueError(
                f"data: format {format} has no option {shown}, expected one of {', '.join(reader_options)}"
            )
    unused = getattr(FORMATS[format], "UNUSED_FILES", ())
    with restrict_links(bounds), record_opened_files() as opened:
        try:
            recordings = read(root, **options)
        except intrinsics_options.MissingIntrinsicsError as error:
            raise error.with_remarks(report_unread(root, opened, unused)) from None
    if isinstance(recordings, Recordings):
        return replace(recordings, make=_RestrictedOpener(recordings.make, bounds, corrections))
    unread = report_unread(root, opened, unused)
    reports = [(*recording.report, *unread) for recording in recordings]
    return [
        corrections.apply(replace(recording, bounds=bounds, report=report))
        for recording, report in zip(recordings, reports, strict=True)
    ]


@dataclass(frozen=True)
class _RestrictedOpener:
    """Open one of many recordings with symbolic links restricted to the capture."""

    make: Callable[[int], Recording]
    bounds: Path | None
    corrections: Corrections

    def __call__(self, i: int) -> Recording:
        with restrict_links(self.bounds):
            return self.corrections.apply(replace(self.make(i), bounds=self.bounds))


@standard_numerics
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
    """Every recording at ``root`` as a scene with the same notes, opened lazily.

    Args:
        root, format, follow_links, options: as :func:`open_all`.
        near, gap, levels, room, role: notes of the :class:`Scene`.

    Raises:
        FormatError, ValueError: as :func:`open_all`.
    """
    make_scene = partial(Scene, near=near, gap=gap, levels=levels, room=room, role=role)
    return Scenes(open_all(root, format, follow_links=follow_links, **options), make_scene)


def recognise(root: str | Path, *, follow_links: bool = False) -> tuple[str, str]:
    """Path → (format, the files by which it is recognised, as text).

    Raises:
        FormatError: no such path, or a format that no reader recognises.
    """
    root = Path(root)
    check_file_or_folder(root, "a capture")
    with restrict_links(None if follow_links else root):
        for name, reader in FORMATS.items():
            if evidence := reader.recognise(root):
                return name, evidence
    foreign = describe_foreign_file(root) if root.is_file() else describe_foreign_folder(root)
    listing = sorted(entry.name for entry in root.iterdir()) if root.is_dir() else []
    content = ", ".join(listing[:6]) if root.is_dir() else f"a {root.suffix or 'plain'} file"
    if any(name in listing for name in _IMAGE_FOLDERS) and not any("depth" in name.lower() for name in listing):
        content += " (no depth)"
    expected = f"{PHONE_EXPORTS}; or one of the {len(FORMATS)} formats of docs/data.md"
    remedy = foreign.remedy if foreign else None
    raise FormatError(root, "format", foreign.what if foreign else content or "an empty folder", remedy or expected)


def open_scenes(root: str | Path | None = None, scenes: Sequence[Mapping[str, Any]] = ()) -> list[Scene]:
    """Open a list of scenes below one folder.

    Args:
        root: folder to which the scenes' paths are relative. None = the environment variable ``DHTORCH_DATA``.
        scenes: for each scene ``path`` and arguments of :func:`open_capture` (``format``, ``near``, …).

    Raises:
        FormatError: neither ``root`` nor ``DHTORCH_DATA`` set, no scene, a scene without a path; else as
            :func:`open_capture`.
    """
    root = scenes_root(root)
    refuse_if(not scenes, root, "scenes", "none", "a list of scenes, each with a path")
    opened: list[Scene] = []
    for scene in scenes:
        options = dict(scene) if isinstance(scene, Mapping) else {}
        refuse_if("path" not in options, root, "scenes", scene, "entries with a path, as {path:holo_a,near:2.5}")
        opened += open_capture(root / str(options.pop("path")), **options)
    return opened


def scenes_root(root: str | Path | None) -> Path:
    """The folder to which scenes' paths are relative: ``root``, else the environment variable ``DHTORCH_DATA``.

    Raises:
        FormatError: neither is set, or no such folder.
    """
    root = root if root is not None else os.environ.get(_SCENES_ROOT_VARIABLE)
    if not root:
        raise FormatError(_SCENES_ROOT_VARIABLE, "environment variable", "nothing", "the folder that holds the scenes")
    refuse_if(
        not Path(root).is_dir(),
        root,
        "path",
        "no such folder",
        f"the folder that holds the scenes ({_SCENES_ROOT_VARIABLE})",
    )
    return Path(root)
