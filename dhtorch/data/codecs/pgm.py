"""Codec of 16-bit portable grey maps (PGM), used for depth by some tools: text header, big-endian codes."""

import re
from pathlib import Path

import numpy as np

from dhtorch.data.io.decode import MAX_PIXELS, FormatError, read_bytes

_HEADER_PATTERN = re.compile(
    rb"P5\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s"
)


def read_pgm(file: Path, hw: tuple[int, int] | None = None) -> np.ndarray:
    """Codes (h, w) uint16 of a binary grey map.

    Raises:
        FormatError: missing or truncated file, not 16 bits, another size than ``hw``.
    """
    data = read_bytes(file)
    head = _HEADER_PATTERN.match(data[:1024])
    if head is None:
        raise FormatError(file, "header", repr(data[:16]), "P5, width, height and largest code")
    w, h, max_code = map(int, head.groups())
    if not 255 < max_code < 65536:
        raise FormatError(file, "largest code", max_code, "256 to 65535")
    if hw is not None and (h, w) != tuple(hw):
        raise FormatError(file, "size", f"{w}x{h}", f"{hw[1]}x{hw[0]}")
    if not 0 < h * w <= MAX_PIXELS or len(data) - head.end() != 2 * h * w:
        raise FormatError(file, "data", f"{len(data) - head.end()} bytes", f"2 for each of {w}x{h} pixels")
    return np.frombuffer(data, ">u2", h * w, head.end()).reshape(h, w).astype(np.uint16)
