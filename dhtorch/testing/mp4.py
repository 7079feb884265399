"""Writer of H.264 and HEVC videos as phones write them."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

from dhtorch.data.codecs.mp4 import SYMMETRY_OF_MATRIX
from dhtorch.data.io.decode import import_optional

_TICKS_PER_S = 600  # time base: divisible by 24, 25, 30 and 60 Hz


def write_video(
    file: Path,
    pictures: Sequence[np.ndarray],  # each (H, W, 3) uint8, even sizes
    times: Sequence[float],  # s, increasing
    *,
    codec: str = "libx264",
    crf: int = 10,
    key_every: int = 12,
    b_frames: int = 2,
    stored: str = "yuv420p",
    hide_first: bool = False,
    display: int = 0,
) -> None:
    """Write an mp4 with periodic key frames and B-frames (stored out of order), as phones write them.

    ``stored``: pixel format of the file; ``yuv420p10le`` has ten bits. ``hide_first``: an edit list starts the video
    with the second frame, so that the first one is before time 0. ``display``: symmetry of the display matrix, see
    :mod:`dhtorch.data.orientation`; the pictures are stored as they are.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    h, w = pictures[0].shape[:2]
    av = import_optional("av")
    with av.open(str(file), "w", format="mp4") as container:
        stream = container.add_stream(codec, rate=round(1 / (times[1] - times[0])) if len(times) > 1 else 30)
        stream.width, stream.height, stream.pix_fmt = w, h, stored
        stream.codec_context.time_base = Fraction(1, _TICKS_PER_S)
        stream.codec_context.thread_count = 1
        order = f"keyint={key_every}:bframes={b_frames}:log-level=none"
        stream.options = {"crf": str(crf), "g": str(key_every), "bf": str(b_frames)}
        if codec == "libx265":
            stream.options = {"crf": str(crf), "x265-params": f"{order}:pools=none:frame-threads=1"}
        for picture, time in zip(pictures, times, strict=True):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts = round((time - times[0]) * _TICKS_PER_S)
            frame.time_base = Fraction(1, _TICKS_PER_S)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        shift = round(Fraction(times[1] - times[0]) / stream.time_base) if hide_first else 0
    if hide_first:
        _delay_edit(file, shift)
    if display:
        _write_display_matrix(file, display)


def _delay_edit(file: Path, ticks: int) -> None:
    """Delay the start of the only edit in the file's edit list: earlier frames are decoded but not presented."""
    content = bytearray(file.read_bytes())
    at = content.index(b"elst") + 16  # version and flags, count, duration, then the start
    start = int.from_bytes(content[at : at + 4], "big") + ticks
    content[at : at + 4] = start.to_bytes(4, "big")
    file.write_bytes(content)


def _write_display_matrix(file: Path, display: int) -> None:
    """Write the display matrix of the only track for a symmetry of the stored pictures."""
    content = bytearray(file.read_bytes())
    at = content.index(b"tkhd") + 44  # version and flags, then 40 bytes in version 0
    a, b, c, d = next(matrix for matrix, k in SYMMETRY_OF_MATRIX.items() if k == display)
    entries = (a, b, 0, c, d)
    content[at : at + 20] = struct.pack(">5i", *(entry << 16 for entry in entries))
    file.write_bytes(content)
