"""Helpers of the test writers: PNG encoding that shares no code with the decoders, rows of numbers, saving of files."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np


def encode_unfiltered_png(picture: np.ndarray) -> bytes:
    """(H, W, 1 or 3) uint8 or (H, W) uint16 → bytes of a PNG with unfiltered rows."""
    h, w = picture.shape[:2]
    bits = 8 * picture.dtype.itemsize
    colour = 2 if picture.ndim == 3 and picture.shape[2] == 3 else 0
    rows = picture.astype(picture.dtype.newbyteorder(">"), order="C").reshape(h, -1).view(np.uint8)
    raw = np.concatenate((np.zeros((h, 1), np.uint8), rows), 1).tobytes()
    chunks = (b"IHDR" + struct.pack(">IIBBBBB", w, h, bits, colour, 0, 0, 0), b"IDAT" + zlib.compress(raw, 1), b"IEND")
    framed = (struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(framed)


def format_row(values: Any) -> str:
    """Numbers → one line of text with all digits of float64."""
    return " ".join(f"{float(x):.17g}" for x in values)


def format_rows(matrix: np.ndarray) -> str:
    """Matrix → text, one row per line."""
    return "".join(format_row(row) + "\n" for row in matrix)


def save_file(file: Path, content: bytes | str) -> None:
    """Write a file and create its folder."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content.encode() if isinstance(content, str) else content)
