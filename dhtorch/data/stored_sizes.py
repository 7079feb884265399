"""Sizes of stored pictures and depth maps, what their files state of their orientation, and the check of both.

Symmetries are those of :mod:`dhtorch.data.orientation`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from dhtorch.runtime.safe_open import FormatError

#: EXIF orientation → symmetry that turns the stored picture upright.
EXIF_SYMMETRIES: Final = {1: 0, 2: 4, 3: 2, 4: 6, 5: 7, 6: 1, 7: 5, 8: 3}

#: What is expected of depth, in error messages.
SAME_ORIENTATION: Final = "depth and pictures in one orientation"

#: Relative difference of aspect ratios up to which they count as equal.
_MAX_ASPECT_DIFFERENCE = 0.05


@dataclass(frozen=True)
class StoredSizes:
    """Sizes of stored pictures and depth maps, and how the file states that pictures are to be turned for display."""

    hw: tuple[int, int]  # of the stored pictures
    depth_hw: tuple[int, int] | None  # of the stored depth maps over the same field; None = no depth, or one with own K
    display: int = 0  # symmetry that the files state; 0 = none
    source: str = ""  # what states it: "EXIF orientation 6"

    @classmethod
    def of_images(cls, hw: tuple[int, int], depth_hw: tuple[int, int] | None, exif: int) -> "StoredSizes":
        """Sizes of an image folder, and the EXIF orientation of its first picture."""
        return cls(hw, depth_hw, EXIF_SYMMETRIES[exif], f"EXIF orientation {exif}")


def describe_mismatch(depth_hw: tuple[int, int], hw: tuple[int, int]) -> str | None:
    """Text on a portrait map beside a landscape picture (or vice versa); None where both lie alike or one is square."""
    if 0 in (*depth_hw, *hw):
        return None
    ratio, expected = depth_hw[1] / depth_hw[0], hw[1] / hw[0]
    if (ratio - 1) * (expected - 1) >= 0 or abs(ratio / expected - 1) <= _MAX_ASPECT_DIFFERENCE:
        return None
    names = ("portrait", "landscape") if ratio < 1 else ("landscape", "portrait")
    size, picture = f"{depth_hw[1]}x{depth_hw[0]}", f"{hw[1]}x{hw[0]}"
    return f"depth {size} ({names[0]}) beside pictures {picture} ({names[1]})"


def check_orientation(file: Path | str, depth_hw: tuple[int, int], hw: tuple[int, int]) -> None:
    """Refuse a portrait map of a landscape picture (or vice versa).

    Raises:
        FormatError: its orientation differs from that of the picture.
    """
    if mismatch := describe_mismatch(depth_hw, hw):
        raise FormatError(file, "orientation", mismatch, SAME_ORIENTATION)
