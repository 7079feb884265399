"""A folder of completed frames: what they share, which of them are whole, and what the files of one say.

A frame is a file in each of ``depth/``, ``sigma/``, ``source/`` and, written last, ``meta/``: one that has it is whole.
``complete.json`` says what all frames of a folder share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.cli.layouts import Layout
from dhtorch.codes import Gate, Source, names
from dhtorch.data.io import decode as data_files
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene
from dhtorch.pipeline.method import Method
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage
from dhtorch.viz.plots import append_cutoff, format_frame

Row = dict[str, Any]

#: Of the files: raised when a reader of older ones would be wrong.
_FORMAT_VERSION = 1

#: Folders of pictures and points, which are made of the files of a frame.
EXTRA_FILES = {"figures": (".png",), "points": (".ply", ".glb")}


@dataclass(frozen=True)
class CompletionTask:
    """One scene, and what is wanted of it."""

    scene: Scene
    folder: Path
    layout: Layout
    method: Method
    settings: Mapping[str, Any]
    frames: Sequence[int]  # positions
    offers: Mapping[int, Sequence[int]]  # position → frames around it among which the method chooses
    shared: Row  # complete.json
    done: dict[str, Row] = field(default_factory=dict)  # name of a whole frame → its meta file

    @property
    def recording(self) -> Recording:
        """Of the scene."""
        return self.scene.recording

    def name(self, i: int) -> str:
        """Of the files of frame ``i``."""
        return self.layout.stem(self.recording, i)

    def extras(self, i: int) -> list[Path]:
        """Figure and points that are wanted of frame ``i``: of all frames, or of the first that has another view."""
        first = next((k for k in self.frames if k in self.offers), self.frames[0])
        kinds = [kind for kind in EXTRA_FILES if self.settings[kind] == "all" or (self.settings[kind] and i == first)]
        return [self.folder / kind / f"{self.name(i)}{end}" for kind in kinds for end in EXTRA_FILES[kind]]

    def missing(self, i: int) -> bool:
        """Whether a file of frame ``i`` is to be made."""
        return self.name(i) not in self.done or not all(path.is_file() for path in self.extras(i))


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
    """What all frames of a scene have in common, and their key: of the options ``keyed``, the modules ``roots``, the
    data's digest and what ``more`` tells one word's files from another's."""
    config = {k: settings[k] for k in keyed} | {"scene": scene.name, "format": layout.name, "unit": layout.unit}
    made = result_files.collect_run_metadata(device="cpu", dtype=settings["dtype"], threads=1, seed=settings["seed"])
    name = settings["choices"]["data"]
    found: Row = storage.to_strict_json(
        {
            "format": _FORMAT_VERSION,
            "scene": scene.name,
            "layout": layout.name,
            "unit_m": layout.unit,
            "sigma_unit_m": layout.sigma_unit,
            "reach_m": layout.reach,
            "version": made["versions"]["dhtorch"],
            "git": made["git"],
            "method": settings["choices"]["method"],
            "calibration": calibration,
            "key": result_files.compute_result_key({**config, "files": _FORMAT_VERSION, **more}, digest, roots=roots),
            "config": result_files.make_portable(config),
            "data": {"name": name, "digest": digest},
            "codes": {"source": names(Source), "gate": names(Gate)},
        }
    )
    return found


def digest_scene_files(scene: Scene, settings: Mapping[str, Any], out: Path) -> str:
    """Of all data files; what is written here may lie beside them."""
    files = {
        **result_files.list_files_below([scene.root]),
        **result_files.list_files_named({k: settings[k] for k in ("data", "method")}),
    }
    place = out.resolve()
    return result_files.compute_data_digest({k: p for k, p in files.items() if not p.resolve().is_relative_to(place)})


def resume_folder(task: CompletionTask) -> None:
    """Note the frames of a folder that are whole; what a killed run left of others is removed.

    Raises:
        FileExistsError: the folder holds something else; the message says what differs.
        NotADirectoryError: it is a file.
    """
    folder, about = task.folder, task.folder / "complete.json"
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(f"out: {folder} is a file, expected a folder, or a place for one")
    storage.remove_unfinished_files(about)
    if not storage.has_files(folder):
        return
    if not about.is_file():
        raise FileExistsError(f"out: {folder} holds other files, expected an empty folder, or one that this word made")
    try:
        there = storage.parse_strict_json(about.read_text(encoding="utf-8"))
        same = there["key"] == task.shared["key"]
        found = "" if same else result_files.describe_difference(there, task.shared)
    except (ValueError, KeyError, TypeError) as error:
        raise FileExistsError(f"{about}: found {error}, expected what dhtorch complete writes") from None
    if not same:
        raise FileExistsError(f"{about}: found other frames ({found}), expected these, or another folder for out")
    task.done.update(read_complete_frames(task))
    for kind in (*task.layout.folders, *EXTRA_FILES):
        for file in (folder / kind).glob("*"):
            if file.stem not in task.done:
                file.unlink()


def read_complete_frames(task: CompletionTask) -> dict[str, Row]:
    """The frames that are whole, by name."""
    metas = sorted((task.folder / "meta").glob("*.json"))
    return {path.stem: row for path in metas if (row := _read_meta(task, path))}


def _read_meta(task: CompletionTask, path: Path) -> Row | None:
    """The meta file of a frame that is whole."""
    if any(not task.layout.file(task.folder, kind, path.stem).is_file() for kind in task.layout.folders):
        return None
    try:
        row: Row = storage.parse_strict_json(path.read_text(encoding="utf-8"))
        return row if row["key"] == task.shared["key"] else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def format_frame_title(task: CompletionTask, i: int) -> str:
    """Scene, frame, those that it was completed from, and the cutoff."""
    row = task.done[task.name(i)]
    return append_cutoff(format_frame(task.scene.name, row["frame"], row.get("views", ())), task.settings["cutoff"])


def read_completed_maps(task: CompletionTask, i: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """``depth`` and ``sigma`` (h, w) in m and the source (h, w) of a whole frame, as its files have them."""
    layout, name = task.layout, task.name(i)
    maps = {
        kind: data_files.read_depth_png(layout.file(task.folder, kind, name), 1 / unit)
        for kind, unit in (("depth", layout.unit), ("sigma", layout.sigma_unit))
    }
    return maps, data_files.read_image(layout.file(task.folder, "source", name))[0]
