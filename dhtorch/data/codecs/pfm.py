"""Codec of portable float maps (PFM): three lines of text, then float32 values, last row first."""

import math
from pathlib import Path

import numpy as np

from dhtorch.data.io.decode import MAX_PIXELS, FormatError, read_bytes


def read_pfm(file: Path, hw: tuple[int, int] | None = None) -> np.ndarray:
    """One-channel portable float map (h, w) float32, first row on top (the file stores the last row first).

    Raises:
        FormatError: missing or truncated file, colour map, scale 0 or not finite, another size than ``hw``.
    """
    data = read_bytes(file)
    head = data[:128].split(b"\n", 3)
    if len(head) < 4 or head[0].strip() != b"Pf":
        raise FormatError(file, "header", repr(data[:16]), "'Pf', width and height, scale on three lines")
    try:
        w, h = (int(x) for x in head[1].split())
        scale = float(head[2])
    except ValueError:
        raise FormatError(file, "header", repr(b" ".join(head[1:3])), "width, height and scale") from None
    if scale == 0 or not math.isfinite(scale):
        raise FormatError(file, "scale", scale, "a number below 0 (little endian) or above (big endian)")
    size = (h, w)
    if hw is not None and size != tuple(hw):
        raise FormatError(file, "size", f"{w}x{h}", f"{hw[1]}x{hw[0]}")
    start = sum(len(line) + 1 for line in head[:3])
    if min(h, w) < 1 or h * w > MAX_PIXELS or len(data) - start != 4 * h * w:
        raise FormatError(file, "data", f"{len(data) - start} bytes", f"4 for each of {w}x{h} pixels")
    order = "<f4" if scale < 0 else ">f4"
    return np.frombuffer(data, order, h * w, start).reshape(h, w)[::-1].astype(np.float32)
