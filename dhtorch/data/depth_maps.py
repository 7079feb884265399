"""Reader of depth maps for a recording's frames: a folder of files, or one file with the maps of a whole clip.

Formats: 16-bit ``*.png`` in steps of a unit; ``*.npy``, ``*.npz`` (its only array, or the one named depth),
``*.tiff``, ``*.pfm`` or ``*.exr`` with numbers in that unit. A map (h, w), (1, h, w) or (h, w, 1) covers the field of
view of its frame's image at any size and is stretched where the aspect ratios differ. A folder with one ``.npy`` or
``.npz`` of shape (N, h, w) has N maps, one per frame. What stands for no return, :mod:`dhtorch.geometry.no_depth`
says. Output of ``dhtorch complete`` is read directly: the unit comes from its ``complete.json``.
"""

import re
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dhtorch.data.codecs.exr import read_exr
from dhtorch.data.codecs.npy import list_npz_members, read_npz, read_real_npy
from dhtorch.data.codecs.pfm import read_pfm
from dhtorch.data.codecs.tiff import read_tiff
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import MAX_PIXELS, FormatError
from dhtorch.data.plausibility import plausibility_findings
from dhtorch.data.recording import Recording
from dhtorch.data.stored_sizes import check_orientation
from dhtorch.data.units import UNIT_METRES, DepthUnit, parse_unit
from dhtorch.geometry.no_depth import clear_no_depth
from dhtorch.runtime.console import format_count
from dhtorch.runtime.safe_open import check_link, read_version, restrict_links

_SUFFIXES = (".png", ".npy", ".npz", ".tif", ".tiff", ".pfm", ".exr")

#: Suffixes of files that may hold the maps of a whole clip.
_CLIP_SUFFIXES = (".npy", ".npz")

#: Relative difference between the aspect ratios of a map and its image up to which they count as equal.
_MAX_ASPECT_DIFFERENCE = 0.05

#: Names of the depth array in an archive with several arrays.
_NPZ_KEYS = ("depth", "depths", "depth_map", "depth_maps")

#: End of the names of validity masks beside depth maps, as in DIODE; they are left out.
_MASK_PATTERN = re.compile(r"(?:^|[_.-])(?:valid[_.-]?)?mask$", re.IGNORECASE)

#: Largest depth of a map, m; beyond are numbers of another unit or kind. Source: derived, beyond any sight in a picture
#: of rooms, streets or landscapes that these maps show.
_MAX_DEPTH_M = 10_000.0

#: Maps whose values are examined for plausibility, evenly spaced.
_N_EXAMINED_MAPS = 3


@dataclass(frozen=True)
class DepthMaps:
    """Depth maps of a folder, indexed by position in the recording."""

    files: Sequence[Path | None]  # of every frame
    unit: DepthUnit
    hw: tuple[int, int]  # of the images
    by: str = "number"  # how files were matched to frames: number | order | clip
    clip_index: Sequence[int] = ()  # of every frame's map in a file of a whole clip; empty = one file per map
    warnings: Sequence[str] = ()  # on how files were matched
    left_out: Sequence[str] = ()  # remarks on files that are no maps
    bounds: Path | None = None  # symbolic links must not point outside it; None = no restriction

    @property
    def frames(self) -> list[int]:
        """Positions of the frames with a map."""
        return [i for i, file in enumerate(self.files) if file is not None]

    @cached_property
    def doubts(self) -> list[str]:
        """Warnings that the values of a few maps are no depth in the unit; of maps that are meant as metric depth."""
        frames = self.frames
        examined = sorted({frames[k * (len(frames) - 1) // (_N_EXAMINED_MAPS - 1)] for k in range(_N_EXAMINED_MAPS)})
        findings = plausibility_findings((m[0] for i in examined if (m := self[i]) is not None), self.unit)
        return [f"warning: maps: {text} ({remedy.removeprefix('data.')})" for _, text, remedy in findings]

    @property
    def notes(self) -> list[str]:
        """Remarks for the user: unit, how files were matched, missing maps; warnings first."""
        missing, n = len(self.files) - len(self.frames), len(self.files)
        gaps = [f"{missing} of {n} frames {'has' if missing == 1 else 'have'} no map."] if missing else []
        ordered = ["No file has a frame's number: files were matched in their order."] if self.by == "order" else []
        warned = [f"warning: {text}" for text in self.warnings]
        return [*warned, *gaps, *ordered, *self.left_out, f"maps: {self.unit}"]

    @property
    def report(self) -> dict[str, Any]:
        """How files were matched, as a record: number of missing maps, matched by number or order, unit, warnings."""
        return {
            "missing": len(self.files) - len(self.frames),
            "matched_by": self.by,
            "depth_unit": str(self.unit),
            "depth_unit_m": self.unit.metres,
            "warnings": [*self.warnings],
        }

    def __getitem__(self, i: int) -> Tensor | None:
        """(1, h, w) m float32 of frame ``i``, 0 = no depth; None where there is no file.

        Raises:
            FormatError: a damaged file, one of another format, a depth beyond 10 km, or a portrait map of a landscape
                image (or vice versa).
        """
        file = self.files[i]
        if file is None:
            return None
        with restrict_links(self.bounds):
            array = _open_clip(file)[self.clip_index[i]] if self.clip_index else _READERS[file.suffix.lower()](file)
        _check_shape(file, array.shape, self.hw)
        stored = torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))[None]
        depth = clear_no_depth(stored if self.unit.metres == 1 else stored * self.unit.metres, self.unit.metres)
        files.refuse_if(
            (largest := float(depth.max())) > _MAX_DEPTH_M,
            file,
            "depth",
            f"{largest:.4g} m",
            f"at most {_MAX_DEPTH_M:g} m; see depth_unit",
        )
        return depth


def open_depth_maps(folder: str | Path, recording: Recording, unit: str | float | None = None) -> DepthMaps:
    """Open a folder of depth maps and match its files to the frames of a recording.

    A file belongs to the frame whose number is in its name, the last one by which all names differ: every frame must
    have a file, or every file a frame. Where no file has a frame's number, and there are as many files as frames, they
    are matched in order, sorted by the numbers in their names. A single file with N maps needs N frames, or frames that
    are all numbered below N. Masks (``*_mask.npy``) are left out. Links may lead out of the folder only where those of
    the recording may.

    Args:
        folder: of the files, or the output folder of ``dhtorch complete``.
        recording: with the frames of the maps.
        unit: m, cm, mm, inch, 1/5000, or metres per step; None = the unit in ``complete.json``, else mm for PNG and m
            for all others, which is reported as an assumption.

    Raises:
        FormatError: no folder, no map, maps of several formats, two of one number, files that cannot be matched, or a
            link that leads out of the folder.
        ValueError: an unknown unit.
    """
    root = Path(folder).expanduser()
    files.refuse_if(not root.is_dir(), root, "depth", "no folder", f"a folder of files {', '.join(_SUFFIXES)}")
    bounds = None if recording.root is not None and recording.bounds is None else root
    with restrict_links(bounds):
        return replace(_open_folder(root, recording, unit), bounds=bounds)


def _open_folder(root: Path, recording: Recording, unit: str | float | None) -> DepthMaps:
    """As :func:`open_depth_maps`, of an existing folder."""
    metadata_file = root / "complete.json"
    files.refuse_if(
        unit is None and root.name == "depth" and (root.parent / "complete.json").is_file(),
        root,
        "depth",
        "a part of a folder of dhtorch complete",
        f"{root.parent}, or depth_unit",
    )
    depth_folder = root / "depth" if (root / "depth").is_dir() else root
    candidates = sorted(file for file in depth_folder.iterdir() if file.suffix.lower() in _SUFFIXES)
    for file in candidates:
        check_link(file)
    masks = [file for file in candidates if _MASK_PATTERN.search(file.stem)]
    map_files = [file for file in candidates if file not in masks]
    kinds = Counter(file.suffix.lower() for file in map_files)
    if len(kinds) != 1:
        listing = " and ".join(f"{n} {kind}" for kind, n in sorted(kinds.items())) or "no such file"
        raise FormatError(
            depth_folder, "depth", listing, f"one file a frame, all of one kind of {', '.join(_SUFFIXES)}"
        )
    depth_unit = _find_unit(unit, metadata_file, next(iter(kinds)))
    left_out = [f"{format_count(len(masks), 'mask')} left out, such as {masks[0].name}."] if masks else []
    numbers, hw = recording.number.tolist(), recording[0].hw
    if len(map_files) == 1 and map_files[0].suffix.lower() in _CLIP_SUFFIXES:
        clip = _open_clip(map_files[0])
        if len(clip) > 1:
            matched: list[Path | None] = [map_files[0]] * len(numbers)
            n_maps = len(clip)
            if n_maps != len(numbers) and max(numbers) >= n_maps:
                expected = f"one for each of {_describe_frames(numbers)}"
                raise FormatError(map_files[0], "depth", f"a file that holds {n_maps} maps", expected)
            # The place among as many frames, else the number.
            indices = [*range(n_maps)] if n_maps == len(numbers) else [*numbers]
            return DepthMaps(matched, depth_unit, hw, "clip", indices, left_out=left_out)
    matched, matched_by, remarks = _match_files(depth_folder, map_files, numbers)
    return DepthMaps(matched, depth_unit, hw, matched_by, warnings=remarks, left_out=left_out)


def _find_unit(unit: str | float | None, metadata_file: Path, suffix: str) -> DepthUnit:
    """Unit of the maps: the option's, that of ``complete.json``, or the convention of the suffix, an assumption."""
    if unit is not None:
        return DepthUnit(parse_unit(unit), "option depth_unit")
    if metadata_file.is_file():
        stated = files.to_positive(files.read_json(metadata_file).get("unit_m"), metadata_file, "unit_m")
        return DepthUnit(stated, "complete.json: unit_m")
    return DepthUnit(UNIT_METRES["mm" if suffix == ".png" else "m"])


def _match_files(
    folder: Path, map_files: Sequence[Path], frames: Sequence[int]
) -> tuple[list[Path | None], str, list[str]]:
    """The file of every frame (None = no map), whether they were matched by ``"number"`` or ``"order"``, warnings."""
    # Number of every file, None without one: the last number by which all names differ, else the last in its
    # name
    rows = [_numbers_in_name(file) for file in map_files]
    patterns = {re.sub(r"\d+", "0", file.stem) for file in map_files}
    columns = list(zip(*rows, strict=True)) if len(patterns) == 1 else []
    distinct = [column for column in columns if len(set(column)) == len(map_files)]
    numbers_of = [*distinct[-1]] if distinct else [row[-1] if row else None for row in rows]
    frame_numbers, file_numbers = set(frames), {n for n in numbers_of if n is not None}
    description = format_count(len(map_files), "map")
    if file_numbers:
        description += f" numbered {_format_range(file_numbers)}"
    if file_numbers & frame_numbers and None not in numbers_of:
        if frame_numbers <= file_numbers or file_numbers <= frame_numbers:
            by_number: dict[int | None, Path] = {}
            for file, n in zip(map_files, numbers_of, strict=True):
                first_file = by_number.setdefault(n, file)
                if first_file is not file:
                    problem = f"number {n} as {first_file.name} has"
                    raise FormatError(file, "name", problem, "a number of its own in every name")
            remarks = []
            if min(file_numbers) == min(frame_numbers) + 1:
                first = min(file_numbers)
                remarks.append(
                    f"{description} for {_describe_frames(frames)}: matched by number, the map {first} to the frame "
                    f"{first}; if they are numbered from 1, rename them"
                )
            return [by_number.get(k) for k in frames], "number", remarks
    elif not file_numbers & frame_numbers and len(map_files) == len(frames):
        in_order = sorted(map_files, key=_numbers_in_name)
        return [*in_order], "order", []
    if file_numbers:
        description += f", {len(file_numbers & frame_numbers)} of them with a frame's number"
    raise FormatError(folder, "depth", description, f"one for each of {_describe_frames(frames)}")


def _describe_frames(frames: Sequence[int]) -> str:
    return f"{format_count(len(frames), 'frame')} numbered {_format_range(set(frames))}"


def _numbers_in_name(file: Path) -> list[int]:
    """All integers in a file's name, as a key for natural order (10 after 9)."""
    return [int(digits) for digits in re.findall(r"\d+", file.stem)]


def _format_range(numbers: set[int]) -> str:
    return f"{min(numbers)} to {max(numbers)}"


def _check_shape(file: Path, shape: tuple[int, ...], hw: tuple[int, int]) -> None:
    """Refuse a portrait map of a landscape image (or vice versa); warn where aspect ratios differ otherwise."""
    if 0 in hw:
        return
    check_orientation(file, (shape[0], shape[1]), hw)
    ratio, expected = shape[1] / shape[0], hw[1] / hw[0]
    size, picture = f"{shape[1]}x{shape[0]}", f"{hw[1]}x{hw[0]}"
    if abs(ratio / expected - 1) > _MAX_ASPECT_DIFFERENCE:
        text = f"{file.parent}: maps of {size} are stretched over the whole image, {picture}"
        warnings.warn(text, UserWarning, stacklevel=3)


def _read_npz_depth(file: Path) -> np.ndarray:
    """NPZ file → its only array, or the one named depth."""
    keys = [name.removesuffix(".npy") for name in list_npz_members(file)]
    named = [key for key in _NPZ_KEYS if key in keys]
    return read_npz(file, keys[0] if len(keys) == 1 else named[0] if named else _NPZ_KEYS[0])


def _read_map(file: Path) -> np.ndarray:
    """NPY or NPZ file → one map (h, w)."""
    array = _ARRAY_READERS[file.suffix.lower()](file).squeeze()
    files.refuse_if(
        array.ndim != 2 or not 0 < array.size <= MAX_PIXELS, file, "depth", f"shape {array.shape}", "(height, width)"
    )
    return array


def _open_clip(file: Path) -> np.ndarray:
    """NPY or NPZ file → its maps (N, h, w); N = 1 where it holds one map, or none. The last file stays in memory."""
    return _read_clip(file, read_version(file))


@lru_cache(maxsize=1)
def _read_clip(file: Path, _version: tuple[int, ...]) -> np.ndarray:
    array = _ARRAY_READERS[file.suffix.lower()](file)
    for axis in (-1, 1):
        if array.ndim == 4 and array.shape[axis] == 1:
            array = array.squeeze(axis)
    files.refuse_if(array.size == 0, file, "depth", f"shape {array.shape}", "(height, width) or (maps, height, width)")
    is_one = array.ndim != 3 or 1 in (array.shape[0], array.shape[-1])
    return array[None] if is_one else array


_ARRAY_READERS: dict[str, Callable[[Path], np.ndarray]] = {
    ".npy": lambda file: read_real_npy(file, "depth"),  # no object arrays, since unpickling can run code
    ".npz": _read_npz_depth,
}

_READERS: dict[str, Callable[[Path], np.ndarray]] = {
    ".png": lambda file: files.read_depth_png(file, 1.0),
    ".npy": _read_map,
    ".npz": _read_map,
    ".tif": read_tiff,
    ".tiff": read_tiff,
    ".pfm": read_pfm,
    ".exr": read_exr,
}
