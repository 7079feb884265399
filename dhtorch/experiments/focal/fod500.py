"""FoD500 (Focus on Defocus): five rendered images of a table of objects at different focus distances, with depth.

``<index>…All.tif`` five times and ``<index>…Dpt.exr`` (half floats, metres) for each index of six digits. The text
between index and suffix is not documented in the authors' loaders; files are taken in order of name, near focus first.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dhtorch.data.codecs import exr
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.experiments.focal.stacks import FocalStack, FocalStacks, parse_focus_distances, read_pictures
from dhtorch.runtime.console import format_count

_FOCUS_M = (0.1, 0.15, 0.3, 0.7, 1.5)  # m
_SAMPLE_PATTERN = re.compile(r"(\d{6}).*(All\.tif|Dpt\.exr)")
_FIRST_VALIDATION = 400


def recognise(root: Path) -> str | None:
    """Text of the evidence that ``root`` holds stacks of this format; None without evidence."""
    names = {m[2] for file in root.iterdir() if (m := _SAMPLE_PATTERN.fullmatch(file.name))} if root.is_dir() else set()
    return "files <index>…All.tif" if "All.tif" in names else None


def read(
    root: str | Path,
    *,
    split: str | None = None,
    focus_m: Sequence[float] = _FOCUS_M,
    focal_length_m: float = 2.9e-3,
    f_number: float = 1.0,
    max_depth: float | None = 3.0,
) -> FocalStacks:
    """Open FoD500.

    Args:
        root: the folder with the images (``fs_6``).
        split: ``"train"`` = index below 400, ``"val"`` = the rest. None = both.
        focus_m: focus distances, in the order of the files.
        focal_length_m: of the rendering lens.
        f_number: of the rendering lens. 1.0 is the value of the authors' training (a default of 0.1 elsewhere in
            their code is not used).
        max_depth: depth is clipped to this, as in the authors' code. None = no clipping.

    Returns:
        Stacks, with depth if the folder has any; samples that lack an image or depth are left out and reported.
        The pixel pitch is not published, so there is no camera.

    Raises:
        FormatError: no complete sample, or an invalid option.
    """
    root = Path(root)
    focus = parse_focus_distances(focus_m, root)
    if split not in (None, "train", "val"):
        raise FormatError(root, "option split", split, "train or val")
    if max_depth is not None:
        files.to_positive(max_depth, root, "option max_depth")
    samples = {
        k: v for k, v in _samples(root).items() if split in (None, "val" if int(k) >= _FIRST_VALIDATION else "train")
    }
    has_depth = any(depths for _, depths in samples.values())
    complete = {k: v for k, v in samples.items() if (len(v[0]), len(v[1])) == (len(focus), int(has_depth))}
    if not complete:
        expected = f"{len(focus)} *All.tif and one *Dpt.exr"
        raise FormatError(root, "samples", f"none complete among {len(samples)}", expected)
    load = _StackLoader(
        pictures=tuple(tuple(pictures) for pictures, _ in complete.values()),
        depths=tuple(depths[0] if depths else None for _, depths in complete.values()),
        focus=focus,
        focal_length_m=files.to_positive(focal_length_m, root, "option focal_length_m"),
        f_number=files.to_positive(f_number, root, "option f_number"),
        max_depth=max_depth,
    )
    incomplete = [(k, *v) for k, v in samples.items() if k not in complete]
    report = tuple(
        f"sample {k}: {format_count(len(a), 'picture')} and {format_count(len(b), 'depth map')}: left out"
        for k, a, b in incomplete
    )
    return FocalStacks(root.resolve().name, "fod500", load, tuple(complete), root, report)


@dataclass(frozen=True, eq=False)
class _StackLoader:
    """Index → decoded stack."""

    pictures: tuple[tuple[Path, ...], ...]
    depths: tuple[Path | None, ...]
    focus: Tensor  # (S,)
    focal_length_m: float
    f_number: float
    max_depth: float | None

    def __call__(self, i: int) -> FocalStack:
        images, file = read_pictures(self.pictures[i]), self.depths[i]
        depth = None
        if file is not None:
            metres = exr.read_exr(file, "R", (images.shape[-2], images.shape[-1]))
            metres = np.where(np.isfinite(metres) & (metres > 0), metres, 0)
            depth = torch.from_numpy(metres if self.max_depth is None else metres.clip(max=self.max_depth))[None]
        lens, f_number = torch.tensor([self.focal_length_m]), torch.tensor([self.f_number])
        return FocalStack(images[None], self.focus[None], depth, focal_length_m=lens, f_number=f_number)


def _samples(root: Path) -> dict[str, tuple[list[Path], list[Path]]]:
    """Sample index → files of its images and of its depth maps, in order of name."""
    samples: dict[str, tuple[list[Path], list[Path]]] = {}
    for file in sorted(root.iterdir()) if root.is_dir() else ():
        if match := _SAMPLE_PATTERN.fullmatch(file.name):
            samples.setdefault(match[1], ([], []))[match[2] == "Dpt.exr"].append(file)
    return samples
