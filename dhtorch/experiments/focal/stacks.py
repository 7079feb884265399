"""Focal stacks: one view, photographed at several focus distances. Not RGB-D, so not a recording."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dhtorch.data.codecs import tiff
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.io.safe_open import restrict_links
from dhtorch.pytree import Record, record
from dhtorch.records import Camera
from dhtorch.runtime.console import format_count

#: A folder of a thousand photographs is no focal stack.
_MAX_STACK_BYTES = 2_000_000_000


@record
class FocalStack(Record):
    """Pictures of one view that differ in focus, in the order of the data set."""

    images: Tensor  # (B, S, C, H, W) C 1 or 3; float in [0, 1] or uint8
    focus_m: Tensor | None = None  # (B, S) m, distance in focus; None = not known
    depth: Tensor | None = None  # (B, H, W) m, truth, 0 = none at this pixel; None = no truth at all
    camera: Camera | None = None
    focal_length_m: Tensor | None = None  # (B,) m, of the lens
    f_number: Tensor | None = None  # (B,) focal length over the diameter of the aperture

    @property
    def hw(self) -> tuple[int, int]:
        """(height, width) of the images."""
        return self.images.shape[-2], self.images.shape[-1]


@dataclass(frozen=True, eq=False)
class FocalStacks(Sequence[FocalStack]):
    """A lazy sequence of focal stacks (B = 1): nothing is decoded before a stack is asked for, and it pickles.

    Raises:
        ValueError: no stack, or not one scene for each.
    """

    name: str  # of the collection, for tables and figures
    format: str  # the reader that made it
    load: Callable[[int], FocalStack]  # picklable; position → stack
    names: tuple[str, ...]  # one for each stack
    root: Path | None = None  # folder or file that was opened
    report: tuple[str, ...] = ()  # what was left out, and why
    scenes: tuple[str, ...] | None = None  # the scene that each stack shows; None = each its own
    bounds: Path | None = None  # no link below it may lead out of it; None = links are followed

    def __post_init__(self) -> None:
        if not self.names:
            raise ValueError(f"stacks {self.name}: found none, expected at least one")
        if self.scenes is not None and len(self.scenes) != len(self.names):
            found = f"{format_count(len(self.scenes), 'scene')} of {format_count(len(self.names), 'stack')}"
            raise ValueError(f"stacks {self.name}: found {found}, expected one for each")

    def by_scene(self) -> dict[str, list[int]]:
        """Scene → positions of its stacks. What is said of many scenes resamples these, never stacks of one room."""
        found: dict[str, list[int]] = {}
        for i, scene in enumerate(self.names if self.scenes is None else self.scenes):
            found.setdefault(scene, []).append(i)
        return found

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> FocalStack:  # type: ignore[override]  # one at a time: slices would decode
        i, n = operator.index(index), len(self)
        if not -n <= i < n:
            raise IndexError(f"stacks {self.name}: stack {i} of {n}")
        with restrict_links(self.bounds):
            return self.load(i % n)

    def __repr__(self) -> str:
        return f"Stacks({self.name!r}, {self.format}, {len(self)} stacks)"


def read_pictures(sources: Sequence[Path]) -> Tensor:
    """(S, C, H, W) of picture files (PNG, JPEG, TIFF) of one size: uint8, or float in [0, 1] of 16 bits.

    Raises:
        FormatError: missing or damaged file, pictures of different size or kind, or too many to hold.
    """
    first = _read_picture(sources[0])
    total = len(sources) * first.numel() * first.element_size()
    if total > _MAX_STACK_BYTES:
        raise FormatError(sources[0].parent, "pictures", f"{total} bytes", f"at most {_MAX_STACK_BYTES}")
    images = [first]
    for file in sources[1:]:
        image = _read_picture(file)
        if image.shape != first.shape or image.dtype != first.dtype:
            found, expected = (f"{x.shape[2]}x{x.shape[1]}, {len(x)} channels, {x.dtype}" for x in (image, first))
            raise FormatError(file, "picture", found, f"{expected}, as {sources[0].name}")
        images.append(image)
    return torch.stack(images)


def _read_picture(file: Path) -> Tensor:
    """(C, H, W); an alpha channel of a TIFF is dropped."""
    if file.suffix.lower() not in (".tif", ".tiff"):
        return torch.from_numpy(files.read_image(file))
    picture = tiff.read_tiff(file, samples=(1, 3, 4))
    picture = picture[None] if picture.ndim == 2 else np.ascontiguousarray(picture[..., :3].transpose(2, 0, 1))
    if picture.dtype not in (np.uint8, np.uint16):
        raise FormatError(file, "samples", picture.dtype, "8 or 16 bits")
    return torch.from_numpy(picture if picture.dtype == np.uint8 else picture.astype(np.float32) / 65535)


def parse_focus_distances(values: Sequence[float], root: Path, count: int | None = None) -> Tensor:
    """(S,) m, of an option ``focus_m``.

    Raises:
        FormatError: not positive numbers, or not ``count`` of them.
    """
    n = len(values) if count is None else count
    array = files.to_array(list(values), (n,), root, "option focus_m")
    if not (array > 0).all():
        raise FormatError(root, "option focus_m", array.tolist(), "positive distances")
    return torch.from_numpy(array.astype(np.float32))
