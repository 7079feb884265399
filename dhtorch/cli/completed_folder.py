"""Folder of completed frames: shared metadata, list of complete frames, reading of their maps.

A frame is a file in each of ``depth/``, ``sigma/``, ``source/`` and, written last, ``meta/``: a frame with a meta file
is complete. ``complete.json`` holds what all frames of a folder share.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.cli.layouts import Layout
from dhtorch.codes import Gate, Source, count_kinds, names
from dhtorch.data.io import decode as data_files
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene
from dhtorch.ops import loader
from dhtorch.pipeline.method import Method
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage
from dhtorch.runtime.output_folder import OutputFolder, is_whole, open_output_folder
from dhtorch.viz.plots import append_cutoff, format_frame

Row = dict[str, Any]

#: Version of the file format; increased when older readers would misread the files.
_FORMAT_VERSION = 1

#: Folder of derived files → their suffixes.
EXTRA_FILES = {"figures": (".png",), "previews": (".jpg",), "points": (".ply", ".glb")}


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

    def name(self, i: int) -> str:
        """Stem of the file names of frame ``i``."""
        return self.layout.stem(self.recording, i)

    def extras(self, i: int) -> list[Path]:
        """Requested figure and point files of frame ``i``: of all frames, or of the first one with a source view."""
        first = next((k for k in self.frames if k in self.offers), self.frames[0])
        chosen = {kind: self.settings.get(kind, False) for kind in EXTRA_FILES}
        kinds = [kind for kind, which in chosen.items() if which == "all" or (which and i == first)]
        return [self.folder / kind / f"{self.name(i)}{end}" for kind in kinds for end in EXTRA_FILES[kind]]

    def files(self, i: int) -> list[Path]:
        """All files that a frame ``i`` can have."""
        extras = [self.folder / kind / f"{self.name(i)}{end}" for kind, ends in EXTRA_FILES.items() for end in ends]
        return [*self.map_files(i), *extras]

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
    with open_output_folder(task.folder, "out") as folder:
        _read_shared_file(task)
        task.done.update(read_complete_frames(task))
        if folder.is_unlisted:
            _adopt_older_version(task, folder)
        _check_files(task, folder, more)
        for i in range(len(task.recording)):
            for path in task.files(i) if task.name(i) not in task.done else ():
                folder.remove(path)
        yield


def _read_shared_file(task: CompletionTask) -> None:
    """Check that the folder is empty, or was written with the same settings from the same data."""
    folder, shared_file = task.folder, task.folder / "complete.json"
    if not storage.has_files(folder):
        return
    if not shared_file.is_file():
        raise FileExistsError(
            f"out: {folder} holds other files, expected an empty folder, or one that this command wrote"
        )
    result_files.check_same_run(shared_file, task.shared, "complete")


def _adopt_older_version(task: CompletionTask, folder: OutputFolder) -> None:
    """Enter the files of a folder without a manifest whose ``complete.json`` has the key of this run: those of complete
    frames, and those beside the frames' folders."""
    complete = [i for i in range(len(task.recording)) if task.name(i) in task.done]
    beside = list(task.folder.iterdir()) if (task.folder / "complete.json").is_file() else []
    folder.adopt([*beside, *(path for i in complete for path in task.files(i))])


def _check_files(task: CompletionTask, folder: OutputFolder, more: Iterable[str]) -> None:
    """Raise FileExistsError for a link or a foreign file where the command writes."""
    extras = [kind for kind in EXTRA_FILES if task.settings.get(kind)]
    folder.check_folders(task.folder / kind for kind in (*task.layout.folders, *extras))
    folder.check(task.folder / name for name in ("complete.json", *task.layout.side_files, *more))
    for i in task.frames:
        if task.name(i) not in task.done:
            folder.check(task.map_files(i))
        folder.check(path for path in task.extras(i) if not (path.is_file() and folder.lists(path)))


def read_complete_frames(task: CompletionTask) -> dict[str, Row]:
    """Name -> meta row of the complete frames."""
    metas = sorted((task.folder / "meta").glob("*.json"))
    return {path.stem: row for path in metas if (row := _read_meta(task, path))}


def _read_meta(task: CompletionTask, path: Path) -> Row | None:
    """The meta row of a frame, None where a file is missing, invalid or of another key."""
    if not all(is_whole(task.layout.file(task.folder, kind, path.stem)) for kind in task.layout.folders):
        return None
    try:
        row: Row = storage.parse_strict_json(storage.read_utf8(path))
        return row if row["key"] == task.shared["key"] else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def format_frame_title(task: CompletionTask, i: int) -> str:
    """Figure title: capture, frame, cutoff."""
    return append_cutoff(format_frame(task.scene.name, task.done[task.name(i)]["frame"]), task.settings["cutoff"])


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
