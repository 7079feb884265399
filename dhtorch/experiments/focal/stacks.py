"""Focal stacks: images of one view at several focus distances, as records and lazy sequences, and their file input."""

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
from dhtorch.pytree import Record, record
from dhtorch.records import Camera
from dhtorch.runtime.console import format_count
from dhtorch.runtime.safe_open import restrict_links

#: Largest size of the decoded images of one stack, bytes; guards against folders that are no focal stack.
_MAX_STACK_BYTES = 2_000_000_000


@record
class FocalStack(Record):
    """Images of one view at different focus distances, in the order of the data set, with optional truth and optics."""

    images: Tensor  # (B, S, C, H, W) C 1 or 3; float in [0, 1] or uint8
    focus_m: Tensor | None = None  # (B, S) m, focus distance; None = unknown
    depth: Tensor | None = None  # (B, H, W) m, ground truth, 0 = none at this pixel; None = no ground truth
    camera: Camera | None = None
    focal_length_m: Tensor | None = None  # (B,) m, of the lens
    f_number: Tensor | None = None  # (B,) focal length over the diameter of the aperture

    @property
    def hw(self) -> tuple[int, int]:
        """(height, width) of the images."""
        return self.images.shape[-2], self.images.shape[-1]


@dataclass(frozen=True, eq=False)
class FocalStacks(Sequence[FocalStack]):
    """Lazy, picklable sequence of focal stacks (B = 1): a stack is decoded when it is indexed.

    Raises:
        ValueError: no stack, or the number of scenes differs from the number of stacks.
    """

    name: str  # of the collection, for tables and figures
    format: str  # name of the reader
    load: Callable[[int], FocalStack]  # picklable; index → stack
    names: tuple[str, ...]  # of the stacks
    root: Path | None = None  # folder or file that was opened
    report: tuple[str, ...] = ()  # what the reader left out, and why
    scenes: tuple[str, ...] | None = None  # scene of each stack; None = every stack is a scene of its own
    bounds: Path | None = None  # symbolic links may not lead out of it; None = no restriction

    def __post_init__(self) -> None:
        if not self.names:
            raise ValueError(f"stacks {self.name}: found none, expected at least one")
        if self.scenes is not None and len(self.scenes) != len(self.names):
            counts = f"{format_count(len(self.scenes), 'scene')} of {format_count(len(self.names), 'stack')}"
            raise ValueError(f"stacks {self.name}: found {counts}, expected one for each")

    def by_scene(self) -> dict[str, list[int]]:
        """Scene → indices of its stacks. Statistics resample scenes, not single stacks."""
        indices: dict[str, list[int]] = {}
        for i, scene in enumerate(self.names if self.scenes is None else self.scenes):
            indices.setdefault(scene, []).append(i)
        return indices

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
    """Read image files (PNG, JPEG, TIFF) of one size: (S, C, H, W) uint8, or float in [0, 1] for 16-bit files.

    Raises:
        FormatError: missing or damaged file, images of different size or type, or too large a stack.
    """
    first = _read_picture(sources[0])
    total = len(sources) * first.numel() * first.element_size()
    if total > _MAX_STACK_BYTES:
        raise FormatError(sources[0].parent, "pictures", f"{total} bytes", f"at most {_MAX_STACK_BYTES}")
    images = [first]
    for file in sources[1:]:
        image = _read_picture(file)
        if image.shape != first.shape or image.dtype != first.dtype:
            actual, expected = (f"{x.shape[2]}x{x.shape[1]}, {len(x)} channels, {x.dtype}" for x in (image, first))
            raise FormatError(file, "picture", actual, f"{expected}, as {sources[0].name}")
        images.append(image)
    return torch.stack(images)


def _read_picture(file: Path) -> Tensor:
    """Read one image file: (C, H, W) uint8 or float in [0, 1]; an alpha channel of a TIFF is dropped."""
    if file.suffix.lower() not in (".tif", ".tiff"):
        return torch.from_numpy(files.read_image(file))
    picture = tiff.read_tiff(file, samples=(1, 3, 4))
    picture = picture[None] if picture.ndim == 2 else np.ascontiguousarray(picture[..., :3].transpose(2, 0, 1))
    if picture.dtype not in (np.uint8, np.uint16):
        raise FormatError(file, "samples", picture.dtype, "8 or 16 bits")
    return torch.from_numpy(picture if picture.dtype == np.uint8 else picture.astype(np.float32) / 65535)


def parse_focus_distances(values: Sequence[float], root: Path, count: int | None = None) -> Tensor:
    """Focus distances (S,) m from the option ``focus_m``.

    Raises:
        FormatError: not positive numbers, or not ``count`` of them.
    """
    n = len(values) if count is None else count
    array = files.to_array(list(values), (n,), root, "option focus_m")
    if not (array > 0).all():
        raise FormatError(root, "option focus_m", array.tolist(), "positive distances")
    return torch.from_numpy(array.astype(np.float32))
