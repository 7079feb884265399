"""A plain folder of pictures of one view as a focal stack, in the order of the numbers in their names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from dhtorch.data.codecs import tiff as codec_tiff
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.experiments.focal.stacks import FocalStack, FocalStacks, parse_focus_distances, read_pictures

_MAX_CHECKED_IMAGES = 16  # pictures of a folder, to tell whether they are of one kind
_DEPTH_FOLDERS = ("depth", "depths", "depth_maps")
_IMAGE_PATTERN = re.compile(r"[^.].*\.(png|jpe?g|tiff?)", re.IGNORECASE)


def recognise(root: Path) -> str | None:
    """What makes ``root`` a focal stack of this format, in words; None if nothing does."""
    if any((root / name).is_dir() for name in _DEPTH_FOLDERS):
        return None  # a camera that measures depth, whatever its pictures are called
    pictures = sorted(_image_files(root), key=files.natural_sort_key)
    some = pictures[:: max(1, len(pictures) // _MAX_CHECKED_IMAGES)]
    kinds = {_image_kind(file) for file in (*some, *pictures[-1:])}
    if len(pictures) < 2 or None in kinds or len(kinds) != 1:
        return None
    return f"{len(pictures)} pictures of one size"


def read(root: str | Path, *, focus_m: Sequence[float] | None = None) -> FocalStacks:
    """Open a folder of pictures (PNG, JPEG, TIFF) as one focal stack.

    Args:
        root: the folder.
        focus_m: the distances in focus, in the order of the pictures. None = not known.

    Raises:
        FormatError: less than two pictures, or another number of distances.
    """
    root = Path(root)
    pictures = tuple(sorted(_image_files(root), key=files.natural_sort_key))
    if len(pictures) < 2:
        raise FormatError(root, "pictures", len(pictures), "at least two, at different focus")
    focus = None if focus_m is None else parse_focus_distances(focus_m, root, len(pictures))
    name = root.resolve().name
    return FocalStacks(name, "images", _StackLoader(pictures, focus), (name,), root)


@dataclass(frozen=True, eq=False)
class _StackLoader:
    """0 → the stack."""

    pictures: tuple[Path, ...]
    focus: Tensor | None

    def __call__(self, i: int) -> FocalStack:
        return FocalStack(read_pictures(self.pictures)[None], None if self.focus is None else self.focus[None])


def _image_files(root: Path) -> list[Path]:
    return [file for file in root.iterdir() if _IMAGE_PATTERN.fullmatch(file.name)] if root.is_dir() else []


def _image_kind(file: Path) -> tuple[object, ...] | None:
    """Size, channels and bits of a picture; None of one that is damaged or of a kind that is not read."""
    try:
        if file.suffix.lower() in (".tif", ".tiff"):
            return tuple(codec_tiff.read_tiff_header(file))
        header = files.read_image_header(file)
        return header[:3] if header.bits == 8 else None
    except FormatError:
        return None
