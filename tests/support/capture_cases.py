"""Rows of captures: written with known frames, edited, and read as the frames or refused with one sentence."""

import json
import pickle
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pyarrow import parquet

from dhtorch import data
from dhtorch.data.codecs import pickles
from dhtorch.data.recording import Recording
from dhtorch.records import Frame
from support.box_scene import off_wall, own_camera, turned_back, walk, world_points
from support.writers import parts

DELETE = object()  # in place of a file or of an entry of a JSON document

Edit = tuple[str, Any]


def edit_files(root: Path, edits: Sequence[Edit]) -> None:
    """Edit files in turn; a name is a path below ``root`` or a pattern of existing ones.

    The change is DELETE; the new content (text, bytes, codes or an image as array); another name (a ``Path``); pairs
    (old text, new text); entries that are put into a JSON document, at any depth; or a function of the text (of the table or value, for Parquet and ``.npy``).
    """
    for name, change in edits:
        for file in sorted(root.glob(name)) or [root / name]:
            if change is DELETE:
                file.unlink()
            elif isinstance(change, Path):
                (root / change).parent.mkdir(parents=True, exist_ok=True)
                file.rename(root / change)
            elif isinstance(change, str | bytes):
                parts.save_file(file, change)
            elif isinstance(change, np.ndarray):
                parts.save_file(file, parts.encode_unfiltered_png(change))
            elif isinstance(change, Mapping):
                file.write_text(json.dumps(merge(json.loads(file.read_text()), change)))
            elif callable(change) and file.suffix == ".parquet":
                parquet.write_table(change(parquet.read_table(file)), file, row_group_size=3)
            elif callable(change) and file.suffix == ".npy":
                np.save(file, change(pickles.read_npy(file)), allow_pickle=True)
            elif callable(change):
                file.write_text(change(file.read_text()))
            else:
                text = file.read_text()
                for old, new in change:
                    assert old in text, f"{name}: no {old!r}"
                    text = text.replace(old, new)
                file.write_text(text)


def merge(document: Any, change: Any) -> Any:
    """The JSON document with the entries of ``change`` (by key, or by number in a list), DELETE left out."""
    if not isinstance(change, Mapping) or not isinstance(document, dict | list):
        return change
    entries = dict(enumerate(document)) if isinstance(document, list) else dict(document)
    for key in list(entries) if "*" in change else ():
        entries[key] = merge(entries[key], change["*"])
    for key, value in change.items():
        if value is DELETE:
            entries.pop(key)
        elif key != "*":
            entries[key] = merge(entries.get(key), value)
    return list(entries.values()) if isinstance(document, list) else entries


@dataclass
class Case:
    """A capture of ``frames``, its edits, options of the reader, and what is read: facts, or an error as a pattern."""

    name: str
    write: Callable[..., Any]
    frames: int | Callable[[], list[Frame]]
    edits: Sequence[Edit] = ()
    expect: Mapping[str, Any] = field(default_factory=dict)
    error: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    written: Mapping[str, Any] = field(default_factory=dict)
    path: str = "."  # what is opened, below the folder
    which: int | None = None  # of several recordings; None = there must be one
    up: Sequence[float] = (0.0, -1.0, 0.0)  # upwards in the written world


#: Facts of a recording by name.
FACTS: Mapping[str, Callable[[Recording], Any]] = {
    "format": lambda r: r.format,
    "name": lambda r: r.name.partition("/")[2],
    "title": lambda r: r.name,
    "start": lambda r: r.poses.t[0].tolist(),
    "number": lambda r: r.number.tolist(),
    "report": lambda r: r.report,
    "posed": lambda r: r.poses is not None,
    "unit": lambda r: None if r.depth_unit is None else (r.depth_unit.metres, r.depth_unit.source),
    "times": lambda r: None if r.times is None else r.times.tolist(),
    "rate": lambda r: r.rate_hz,
    "episode": lambda r: r.episode,
    "step": lambda r: r.depth_unit and r.depth_unit.metres,
    "axes": lambda r: r.pose_axes,
    "camera": lambda r: r.camera_name,
    "f": lambda r: r[0].camera.f[0].tolist(),
    "c": lambda r: r[0].camera.c[0].tolist(),
    "last c": lambda r: r[-1].camera.c[0].tolist(),
    "second": lambda r: r.poses.t[1].tolist(),
    "last f": lambda r: r[-1].camera.f[0].tolist(),
    "lens": lambda r: None if r[0].camera.distortion is None else r[0].camera.distortion[0].tolist(),
    "first term": lambda r: None if r[0].camera.distortion is None else float(r[0].camera.distortion[0, 0]),
    "depth f": lambda r: None if r[0].depth_camera is None else r[0].depth_camera.f[0].tolist(),
    "depth hw": lambda r: tuple(r[0].depth.shape[1:]),
    "median": lambda r: float(torch.cat([f.depth[f.depth > 0] for f in r]).median()),
    "medians": lambda r: [float(f.depth[f.depth > 0].median()) for f in r],
    "end": lambda r: float(r.poses.t[-1, 2]),
    "all f": lambda r: [float(f.camera.f[0, 0]) for f in r],
    "times of": lambda r: [round(float(t), 6) for t in r.times],
    "conf": lambda r: r[0].conf is not None,
    "truth": lambda r: hasattr(r, "truth"),
    "hw": lambda r: r[0].hw,
    "first values": lambda r: r[0].image[0, 0, 0, :7].tolist(),
    "returns": lambda r: int((r[0].depth > 0).sum()),
    "empty": lambda r: [not f.depth.any() for f in r],
}


def check_case(case: Case, tmp_path: Path) -> None:
    """Write, edit, read, compare.

    Facts are those of :data:`FACTS`, compared with ``==`` (lines of a report as patterns where they are a list); and
    ``same``: (numbers of the written frames, step of depth in m, factor of depth, whether images are lossless), whose
    cameras, poses, depth and images the recording has, images of JPEGs and films nearly.
    """
    frames = walk(case.frames) if isinstance(case.frames, int) else case.frames()
    root = tmp_path / "capture"
    root.mkdir()
    case.write(root, frames, **case.written)
    edit_files(root, case.edits)
    if case.error is not None:
        with pytest.raises(ValueError, match=case.error) as caught:
            for recording in data.open_all(root / case.path, **case.options):
                list(recording)
        assert "\n" not in str(caught.value)
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        recordings = data.open_all(root / case.path, **case.options)
    assert case.which is not None or len(recordings) == 1
    recording = pickle.loads(pickle.dumps(recordings[case.which or 0]))
    for fact, want in case.expect.items():
        if fact == "same":
            check_frames(recording, [frames[i] for i in want[0]], *want[1:], up=case.up)
            continue
        got = FACTS[fact](recording)
        if isinstance(want, list) and fact == "report":
            assert len(got) == len(want) and all(map(re.search, want, got)), (fact, got)
        else:
            assert got == want, (fact, got, want)


def check_frames(
    recording: Recording,
    frames: Sequence[Frame],
    step: float,
    factor: float = 1.0,
    exact: bool = False,
    *,
    up: Sequence[float] = (0.0, -1.0, 0.0),
) -> None:
    """The frames of a recording are these; depth times ``factor``, to half a step."""
    assert len(recording) == len(frames)
    for got, want in zip(turned_back(recording, up), frames, strict=True):
        assert got.image.dtype == torch.uint8 and got.depth.dtype == torch.float32
        error = (got.image.float() - want.image.float()).abs()
        assert float(error.max() if exact else error.mean()) <= (0 if exact else 12)
        torch.testing.assert_close(got.depth, factor * want.depth, atol=factor * step / 2 + 1e-6, rtol=0)
        for name in ("f", "c"):
            wanted = getattr(want.camera, name)
            torch.testing.assert_close(getattr(got.camera, name), wanted, atol=0 if exact else 1e-5, rtol=0)
        if got.conf is not None and want.conf is not None:
            assert torch.equal(got.conf, want.conf)
        if got.depth_camera is not None and want.depth_camera is not None:
            torch.testing.assert_close(got.depth_camera.f, want.depth_camera.f)
        if got.T_world_from_cam is not None:
            torch.testing.assert_close(got.T_world_from_cam.R, want.T_world_from_cam.R, atol=1e-12, rtol=0)
            torch.testing.assert_close(got.T_world_from_cam.t, want.T_world_from_cam.t, atol=1e-12, rtol=0)
            if factor == 1:
                shot = got if got.depth.shape[-2:] == got.hw or got.depth_camera is not None else own_camera(got)
                assert float(off_wall(world_points(shot)).max()) < 2 * step + 1e-4
