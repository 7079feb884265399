"""Reader of depth maps for a recording's frames: a folder with one file per frame, from a network or another source.

Formats: 16-bit ``*.png`` in steps of a unit; ``*.npy``, ``*.npz`` (its only array, or the one named depth), ``*.tiff``,
``*.pfm`` or ``*.exr`` with numbers in that unit. A map (h, w) covers the field of view of its frame's image at any size
and is stretched where the aspect ratios differ. 0 and non-finite values are no depth. Output of ``dhtorch complete`` is
read directly: the unit comes from its ``complete.json``.
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

#: Relative difference between the aspect ratios of a map and its image up to which they count as equal.
_MAX_ASPECT_DIFFERENCE = 0.05

#: Name of the depth array in an archive with several arrays.
_NPZ_KEY = "depth"


@dataclass(frozen=True)
class DepthMaps:
    """Depth maps of a folder, indexed by position in the recording."""

    files: Sequence[Path | None]  # of every frame
    unit: float  # m
    hw: tuple[int, int]  # of the images
    by: str = "number"  # how files were matched to frames: number | order

    @property
    def frames(self) -> list[int]:
        """Positions of the frames with a map."""
        return [i for i, file in enumerate(self.files) if file is not None]

    @property
    def notes(self) -> list[str]:
        """Remarks for the user on how files were matched: missing maps, matching by order."""
        missing, n = len(self.files) - len(self.frames), len(self.files)
        gaps = [f"{missing} of {n} frames {'has' if missing == 1 else 'have'} no map."] if missing else []
        ordered = ["No file has a frame's number: files were matched in their order."]
        return gaps + (ordered if self.by == "order" else [])

    @property
    def report(self) -> dict[str, Any]:
        """How files were matched, as a record: number of missing maps, matched by number or order."""
        return {"missing": len(self.files) - len(self.frames), "matched_by": self.by}

    def __getitem__(self, i: int) -> Tensor | None:
        """(1, h, w) m float32 of frame ``i``, 0 = no depth; None where there is no file.

        Raises:
            FormatError: a damaged file, one of another format, or a portrait map of a landscape image (or vice versa).
        """
        file = self.files[i]
        if file is None:
            return None
        array = _READERS[file.suffix.lower()](file)
        _check_shape(file, array.shape, self.hw)
        depth = torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))[None] * self.unit
        return torch.where(depth.isfinite() & (depth > 0), depth, 0.0)


def open_depth_maps(folder: str | Path, recording: Recording, unit: str | float | None = None) -> DepthMaps:
    """Open a folder of depth maps and match its files to the frames of a recording.

    A file belongs to the frame whose number is the last one in the file's name: every frame must have a file, or every
    file a frame. Where no file has a frame's number, and there are as many files as frames, they are matched in order,
    sorted by the numbers in their names.

    Args:
        folder: of the files, or the output folder of ``dhtorch complete``.
        recording: with the frames of the maps.
        unit: m, cm, mm, inch, or metres per step; None = the unit in ``complete.json``, else mm for PNG and m for all
            others.

    Raises:
        FormatError: no folder, no map, maps of several formats, two of one number, or files that cannot be matched.
        ValueError: an unknown unit.
    """
    root = Path(folder).expanduser()
    if not root.is_dir():
        raise FormatError(root, "depth", "no folder", f"a folder of files {', '.join(_SUFFIXES)}")
    metadata_file = root / "complete.json" if (root / "complete.json").is_file() else root.parent / "complete.json"
    depth_folder = root / "depth" if (root / "depth").is_dir() else root
    map_files = sorted(file for file in depth_folder.iterdir() if file.suffix.lower() in _SUFFIXES)
    kinds = Counter(file.suffix.lower() for file in map_files)
    if len(kinds) != 1:
        listing = " and ".join(f"{n} {kind}" for kind, n in sorted(kinds.items())) or "no such file"
        raise FormatError(
            depth_folder, "depth", listing, f"one file a frame, all of one kind of {', '.join(_SUFFIXES)}"
        )
    unit_m = _parse_unit(unit)
    if unit_m is None and metadata_file.is_file():
        unit_m = files.to_positive(files.read_json(metadata_file).get("unit_m"), metadata_file, "unit_m")
    if unit_m is None:
        unit_m = _UNIT_METRES["mm"] if set(kinds) == {".png"} else _UNIT_METRES["m"]
    matched, matched_by = _match_files(depth_folder, map_files, recording.number.tolist())
    return DepthMaps(matched, unit_m, recording[0].hw, matched_by)


def _match_files(folder: Path, map_files: Sequence[Path], frames: Sequence[int]) -> tuple[list[Path | None], str]:
    """The file of every frame (None = no map), and whether they were matched by ``"number"`` or ``"order"``."""
    numbers_of = [_numbers_in_name(file)[-1:] for file in map_files]
    frame_numbers, file_numbers = set(frames), {n for numbers in numbers_of for n in numbers}
    if file_numbers & frame_numbers and all(numbers_of):
        if frame_numbers <= file_numbers or file_numbers <= frame_numbers:
            by_number = _index_by_number(map_files, [numbers[0] for numbers in numbers_of])
            return [by_number.get(k) for k in frames], "number"
    elif not file_numbers & frame_numbers and len(map_files) == len(frames):
        in_order = sorted(map_files, key=_numbers_in_name)
        return [*in_order], "order"
    description = format_count(len(map_files), "file")
    if file_numbers:
        n_shared = len(file_numbers & frame_numbers)
        description += f" numbered {_format_range(file_numbers)}, {n_shared} of them with a frame's number"
    raise FormatError(
        folder,
        "depth",
        description,
        f"one for each of {format_count(len(frames), 'frame')}, numbered {_format_range(frame_numbers)}",
    )


def _numbers_in_name(file: Path) -> list[int]:
    """All integers in a file's name, as a key for natural order (10 after 9)."""
    return [int(digits) for digits in re.findall(r"\d+", file.stem)]


def _index_by_number(map_files: Sequence[Path], numbers: Sequence[int]) -> dict[int, Path]:
    by_number: dict[int, Path] = {}
    for file, n in zip(map_files, numbers, strict=True):
        first = by_number.setdefault(n, file)
        if first is not file:
            raise FormatError(file, "name", f"number {n} as {first.name} has", "a number of its own in every name")
    return by_number


def _format_range(numbers: set[int]) -> str:
    return f"{min(numbers)} to {max(numbers)}"


def _check_shape(file: Path, shape: tuple[int, ...], hw: tuple[int, int]) -> None:
    """Refuse a portrait map of a landscape image (or vice versa); warn where aspect ratios differ otherwise."""
    if 0 in hw:
        return
    ratio, expected = shape[1] / shape[0], hw[1] / hw[0]
    size, picture = f"{shape[1]}x{shape[0]}", f"{hw[1]}x{hw[0]}"
    if (ratio - 1) * (expected - 1) < 0 and abs(ratio / expected - 1) > _MAX_ASPECT_DIFFERENCE:
        raise FormatError(file, "depth", f"a map of {size}", f"one over the field of view of its image, {picture}")
    if abs(ratio / expected - 1) > _MAX_ASPECT_DIFFERENCE:
        text = f"{file.parent}: maps of {size} are stretched over the whole image, {picture}"
        warnings.warn(text, UserWarning, stacklevel=3)


def _parse_unit(unit: str | float | None) -> float | None:
    if unit is None:
        return None
    if isinstance(unit, str) and unit in _UNIT_METRES:
        return _UNIT_METRES[unit]
    if isinstance(unit, int | float) and not isinstance(unit, bool) and unit > 0:
        return float(unit)
    raise ValueError(f"depth_unit: found {unit!r}, expected {', '.join(_UNIT_METRES)}, or metres per step")


def _read_npy_map(file: Path) -> np.ndarray:
    """NPY file → numbers (h, w); object arrays are refused, since unpickling can run code."""
    try:
        array = np.load(io.BytesIO(files.read_bytes(file)), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise FormatError(file, "depth", f"{type(error).__name__}", "a NPY array of numbers") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise FormatError(file, "depth", "no array of numbers", "a NPY array of numbers")
    return _check_map(array, file)


def _read_npz_map(file: Path) -> np.ndarray:
    """NPZ file → its only array (h, w), or the one named depth."""
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
