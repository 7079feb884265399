"""Videos whose container states what not every player follows: a late start, a turned display."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from dhtorch.data.codecs.video import SYMMETRY_OF_MATRIX
from dhtorch.export import video


def write_video(
    file: Path,
    pictures: Sequence[np.ndarray],
    times: Sequence[float],
    *,
    hide_first: bool = False,
    display: int = 0,
    **options: Any,
) -> None:
    """A film as :func:`dhtorch.export.video.write_video`; with ``hide_first`` the first frame is before time 0.

    ``display``: symmetry of the stored images that the display matrix states.
    """
    video.write_video(file, pictures, times, **options)
    if hide_first:
        hide_first_image(file, times[1] - times[0])
    if display:
        write_display_matrix(file, display)


def write_display_matrix(file: Path, display: int) -> None:
    """Write the display matrix of the only track for a symmetry (:mod:`dhtorch.data.orientation`) of the images."""
    content = bytearray(file.read_bytes())
    at = content.index(b"tkhd") + 44  # version and flags, then 40 bytes in version 0
    a, b, c, d = next(matrix for matrix, k in SYMMETRY_OF_MATRIX.items() if k == display)
    content[at : at + 20] = struct.pack(">5i", *(entry << 16 for entry in (a, b, 0, c, d)))
    file.write_bytes(content)


def hide_first_image(file: Path, step_s: float) -> None:
    """Delay the start of the only edit in the file's edit list by a frame: the first is decoded but not presented."""
    with av.open(str(file)) as container:
        shift = round(Fraction(step_s) / container.streams.video[0].time_base)
    content = bytearray(file.read_bytes())
    at = content.index(b"elst") + 16  # version and flags, count, duration, then the start
    start = int.from_bytes(content[at : at + 4], "big") + shift
    content[at : at + 4] = start.to_bytes(4, "big")
    file.write_bytes(content)
