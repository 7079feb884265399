"""Depth maps beside a recording: a folder with one file a frame, from a network or any other source.

``*.png`` of 16 bits in steps of a stated unit; ``*.npy``, ``*.npz`` (its one array, or the one named depth),
``*.tiff``, ``*.pfm`` or ``*.exr`` of numbers in the same unit; (h, w) over the field of the frame's picture, of any
size, stretched where its sides have another ratio. 0, and what is not finite, is no depth. What ``dhtorch complete``
wrote is read as it is: its ``complete.json`` says the unit.
"""

from __future__ import annotations

import io
import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dhtorch.data.codecs.exr import read_exr
from dhtorch.data.codecs.npy import read_npz
from dhtorch.data.codecs.pfm import read_pfm
from dhtorch.data.codecs.tiff import read_tiff
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import MAX_PIXELS, FormatError
from dhtorch.data.recording import Recording
from dhtorch.runtime.console import format_count

#: Name of a unit → metres.
_UNIT_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}

_SUFFIXES = (".png", ".npy", ".npz", ".tif", ".tiff", ".pfm", ".exr")

#: By which share the ratio of a map's sides may differ from the picture's before it counts as another.
_MAX_ASPECT_DIFFERENCE = 0.05

#: Array of an archive that is taken where it has several.
_NPZ_KEY = "depth"


@dataclass(frozen=True)
class DepthMaps:
    """The maps of a folder, by position in a recording."""

    files: Sequence[Path | None]  # of every frame
    unit: float  # m
    hw: tuple[int, int]  # of the pictures
    by: str = "number"  # how files were matched to frames: number | order

    @property
    def frames(self) -> list[int]:
        """The frames that have a map."""
        return [i for i, file in enumerate(self.files) if file is not None]

    @property
    def notes(self) -> list[str]:
        """What a reader of the answer has to know of how files were matched."""
        missing, n = len(self.files) - len(self.frames), len(self.files)
        found = [f"{missing} of {n} frames {'has' if missing == 1 else 'have'} no map."] if missing else []
        ordered = ["No file has a frame's number: files were matched in their order."]
        return found + (ordered if self.by == "order" else [])

    @property
    def report(self) -> dict[str, Any]:
        """The same as numbers."""
        return {"missing": len(self.files) - len(self.frames), "matched_by": self.by}

    def __getitem__(self, i: int) -> Tensor | None:
        """(1, h, w) m float32 of frame ``i``, 0 = no depth; None where there is no file.

        Raises:
            FormatError: a damaged file, one of another kind, or one that stands upright where the picture lies.
        """
        file = self.files[i]
        if file is None:
            return None
        array = _READERS[file.suffix.lower()](file)
        _check_shape(file, array.shape, self.hw)
        depth = torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))[None] * self.unit
        return torch.where(depth.isfinite() & (depth > 0), depth, 0.0)


def open_depth_maps(folder: str | Path, recording: Recording, unit: str | float | None = None) -> DepthMaps:
    """The maps of a recording's frames.

    A file belongs to the frame whose number is the last one in its name: all frames must have a file, or all files a
    frame. Where no file has a frame's number, and there are as many files as frames, they are matched in their order,
    by the numbers in their names.

    Args:
        folder: of the files, or one that ``dhtorch complete`` wrote.
        recording: whose frames they are of.
        unit: m, cm, mm, inch, or metres a step; None = what ``complete.json`` says, else mm for PNG and m for all
            others.

    Raises:
        FormatError: no folder, no map, maps of several kinds, two of one number, or files that cannot be matched.
        ValueError: an unknown unit.
    """
    root = Path(folder).expanduser()
    if not root.is_dir():
        raise FormatError(root, "depth", "no folder", f"a folder of files {', '.join(_SUFFIXES)}")
    about = root / "complete.json" if (root / "complete.json").is_file() else root.parent / "complete.json"
    place = root / "depth" if (root / "depth").is_dir() else root
    found = sorted(file for file in place.iterdir() if file.suffix.lower() in _SUFFIXES)
    kinds = Counter(file.suffix.lower() for file in found)
    if len(kinds) != 1:
        what = " and ".join(f"{n} {kind}" for kind, n in sorted(kinds.items())) or "no such file"
        raise FormatError(place, "depth", what, f"one file a frame, all of one kind of {', '.join(_SUFFIXES)}")
    step = _parse_unit(unit)
    if step is None and about.is_file():
        step = files.to_positive(files.read_json(about).get("unit_m"), about, "unit_m")
    if step is None:
        step = _UNIT_METRES["mm"] if set(kinds) == {".png"} else _UNIT_METRES["m"]
    mine, by = _match_files(place, found, recording.number.tolist())
    return DepthMaps(mine, step, recording[0].hw, by)


def _match_files(place: Path, found: Sequence[Path], number: Sequence[int]) -> tuple[list[Path | None], str]:
    """Every frame's file, and whether numbers or order told it."""
    named = [_numbers_in_name(file)[-1:] for file in found]
    frames, told = set(number), {n for numbers in named for n in numbers}
    if told & frames and all(named):
        if frames <= told or told <= frames:
            by_number = _index_by_number(found, [numbers[0] for numbers in named])
            return [by_number.get(k) for k in number], "number"
    elif not told & frames and len(found) == len(number):
        in_order = sorted(found, key=_numbers_in_name)
        return [*in_order], "order"
    said = format_count(len(found), "file")
    if told:
        said += f" numbered {_format_range(told)}, {len(told & frames)} of them with a frame's number"
    raise FormatError(
        place, "depth", said, f"one for each of {format_count(len(number), 'frame')}, numbered {_format_range(frames)}"
    )


def _numbers_in_name(file: Path) -> list[int]:
    """All whole numbers in a file's name, so that 10 comes after 9."""
    return [int(digits) for digits in re.findall(r"\d+", file.stem)]


def _index_by_number(found: Sequence[Path], named: Sequence[int]) -> dict[int, Path]:
    by_number: dict[int, Path] = {}
    for file, n in zip(found, named, strict=True):
        first = by_number.setdefault(n, file)
        if first is not file:
            raise FormatError(file, "name", f"number {n} as {first.name} has", "a number of its own in every name")
    return by_number


def _format_range(numbers: set[int]) -> str:
    return f"{min(numbers)} to {max(numbers)}"


def _check_shape(file: Path, shape: tuple[int, ...], hw: tuple[int, int]) -> None:
    """A map is laid over the whole picture; one that is upright where the picture lies cannot be meant."""
    if 0 in hw:
        return
    ratio, expected = shape[1] / shape[0], hw[1] / hw[0]
    size, picture = f"{shape[1]}x{shape[0]}", f"{hw[1]}x{hw[0]}"
    if (ratio - 1) * (expected - 1) < 0 and abs(ratio / expected - 1) > _MAX_ASPECT_DIFFERENCE:
        raise FormatError(file, "depth", f"a map of {size}", f"one over the field of its picture, {picture}")
    if abs(ratio / expected - 1) > _MAX_ASPECT_DIFFERENCE:
        text = f"{file.parent}: maps of {size} are taken to be stretched over the whole picture, {picture}"
        warnings.warn(text, UserWarning, stacklevel=3)


def _parse_unit(given: str | float | None) -> float | None:
    if given is None:
        return None
    if isinstance(given, str) and given in _UNIT_METRES:
        return _UNIT_METRES[given]
    if isinstance(given, int | float) and not isinstance(given, bool) and given > 0:
        return float(given)
    raise ValueError(f"depth_unit: found {given!r}, expected {', '.join(_UNIT_METRES)}, or metres a step")


def _read_npy_map(file: Path) -> np.ndarray:
    """Numbers (h, w) of a NPY file; never objects, which could run code."""
    try:
        array = np.load(io.BytesIO(files.read_bytes(file)), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise FormatError(file, "depth", f"{type(error).__name__}", "a NPY array of numbers") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise FormatError(file, "depth", "no array of numbers", "a NPY array of numbers")
    return _check_map(array, file)


def _read_npz_map(file: Path) -> np.ndarray:
    """The one array (h, w) of an archive, or that named depth."""
    try:
        with zipfile.ZipFile(io.BytesIO(files.read_bytes(file))) as archive:
            keys = [name.removesuffix(".npy") for name in archive.namelist()]
    except (zipfile.BadZipFile, OSError, ValueError) as error:
        raise FormatError(file, "archive", f"{type(error).__name__}", "a whole .npz archive") from None
    return _check_map(read_npz(file, keys[0] if len(keys) == 1 else _NPZ_KEY), file)


def _read_png_map(file: Path) -> np.ndarray:
    return files.read_depth_png(file, 1.0)


def _check_map(array: np.ndarray, file: Path) -> np.ndarray:
    array = array.squeeze()
    if array.ndim != 2 or not 0 < array.size <= MAX_PIXELS:
        raise FormatError(file, "depth", f"shape {array.shape}", "(height, width)")
    return array


_READERS: dict[str, Callable[[Path], np.ndarray]] = {
    ".png": _read_png_map,
    ".npy": _read_npy_map,
    ".npz": _read_npz_map,
    ".tif": read_tiff,
    ".tiff": read_tiff,
    ".pfm": read_pfm,
    ".exr": read_exr,
}
