"""Depth maps beside a recording: a folder with one file a frame, from a network or any other source.

``*.png`` of 16 bits in steps of a stated unit; ``*.npy``, ``*.npz`` (its one array, or the one named depth),
``*.tiff``, ``*.pfm`` or ``*.exr`` of numbers in the same unit; (h, w) over the field of the frame's picture, of any
size. 0, and what is not finite, is no depth. What ``dhtorch complete`` wrote is read as it is: its ``complete.json``
says the unit.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dhtorch.data import files
from dhtorch.data.codecs.exr import read_exr
from dhtorch.data.codecs.npy import read_npz
from dhtorch.data.codecs.pfm import read_pfm
from dhtorch.data.codecs.tiff import read_tiff
from dhtorch.data.files import MAX_PIXELS, FormatError
from dhtorch.data.recording import Recording

#: Name of a unit → metres.
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}

_ENDINGS = (".png", ".npy", ".npz", ".tif", ".tiff", ".pfm", ".exr")

#: Array of an archive that is taken where it has several.
_KEY = "depth"


@dataclass(frozen=True)
class DepthMaps:
    """The maps of a folder, by position in a recording."""

    files: Sequence[Path | None]  # of every frame
    unit: float  # m

    def __getitem__(self, i: int) -> Tensor | None:
        """(1, h, w) m float32 of frame ``i``, 0 = no depth; None where there is no file.

        Raises:
            FormatError: a damaged file, or one of another kind.
        """
        file = self.files[i]
        if file is None:
            return None
        array = _READERS[file.suffix.lower()](file)
        depth = torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))[None] * self.unit
        return torch.where(depth.isfinite() & (depth > 0), depth, 0.0)


def open_maps(folder: str | Path, recording: Recording, unit: str | float | None = None) -> DepthMaps:
    """The maps of a recording's frames.

    A file belongs to the frame whose number its name ends in; where a name has none, files and frames are matched in
    their order, and there must be as many.

    Args:
        folder: of the files, or one that ``dhtorch complete`` wrote.
        recording: whose frames they are of.
        unit: m, cm, mm, inch, or metres a step; None = what ``complete.json`` says, else mm for PNG and m for all
            others.

    Raises:
        FormatError: no folder, no map, both kinds, or files that cannot be matched.
        ValueError: an unknown unit.
    """
    root = Path(folder).expanduser()
    if not root.is_dir():
        raise FormatError(root, "depth", "no folder", f"a folder of files {', '.join(_ENDINGS)}")
    about = root / "complete.json" if (root / "complete.json").is_file() else root.parent / "complete.json"
    place = root / "depth" if (root / "depth").is_dir() else root
    found = sorted(file for file in place.iterdir() if file.suffix.lower() in _ENDINGS)
    kinds = {file.suffix.lower() for file in found}
    if len(kinds) != 1:
        what = "both kinds" if kinds else "no such file"
        raise FormatError(place, "depth", what, f"one kind of file a frame of {', '.join(_ENDINGS)}")
    step = _unit(unit)
    if step is None and about.is_file():
        step = files.to_positive(files.read_json(about).get("unit_m"), about, "unit_m")
    if step is None:
        step = UNITS["mm"] if kinds == {".png"} else UNITS["m"]
    return DepthMaps(_matched(place, found, recording), step)


def _matched(place: Path, found: Sequence[Path], recording: Recording) -> list[Path | None]:
    number = recording.number.tolist()
    named = [re.search(r"(\d+)\D*$", file.stem) for file in found]
    by_number = {int(match.group(1)): file for match, file in zip(named, found, strict=True) if match}
    if len(by_number) == len(found) and set(by_number) & set(number):
        return [by_number.get(k) for k in number]
    if len(found) == len(number):
        return list(found)
    raise FormatError(place, "depth", f"{len(found)} files of other names", f"one for each of {len(number)} frames")


def _unit(given: str | float | None) -> float | None:
    if given is None:
        return None
    if isinstance(given, str) and given in UNITS:
        return UNITS[given]
    if isinstance(given, int | float) and not isinstance(given, bool) and given > 0:
        return float(given)
    raise ValueError(f"depth_unit: found {given!r}, expected {', '.join(UNITS)}, or metres a step")


def _npy(file: Path) -> np.ndarray:
    """Numbers (h, w) of a NPY file; never objects, which could run code."""
    try:
        array = np.load(io.BytesIO(files.read_bytes(file)), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise FormatError(file, "depth", f"{type(error).__name__}", "a NPY array of numbers") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise FormatError(file, "depth", "no array of numbers", "a NPY array of numbers")
    return _flat(array, file)


def _npz(file: Path) -> np.ndarray:
    """The one array (h, w) of an archive, or that named depth."""
    try:
        with zipfile.ZipFile(io.BytesIO(files.read_bytes(file))) as archive:
            keys = [name.removesuffix(".npy") for name in archive.namelist()]
    except (zipfile.BadZipFile, OSError, ValueError) as error:
        raise FormatError(file, "archive", f"{type(error).__name__}", "a whole .npz archive") from None
    return _flat(read_npz(file, keys[0] if len(keys) == 1 else _KEY), file)


def _png(file: Path) -> np.ndarray:
    return files.read_depth_png(file, 1.0)


def _flat(array: np.ndarray, file: Path) -> np.ndarray:
    array = array.squeeze()
    if array.ndim != 2 or not 0 < array.size <= MAX_PIXELS:
        raise FormatError(file, "depth", f"shape {array.shape}", "(height, width)")
    return array


_READERS: dict[str, Callable[[Path], np.ndarray]] = {
    ".png": _png,
    ".npy": _npy,
    ".npz": _npz,
    ".tif": read_tiff,
    ".tiff": read_tiff,
    ".pfm": read_pfm,
    ".exr": read_exr,
}
