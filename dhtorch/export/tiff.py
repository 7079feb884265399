"""Maps of float32 as TIFF: what keeps metres as metres, and 0 as 0, in tables of pictures."""

from __future__ import annotations

import struct
import zlib

import numpy as np

#: Of deflate: more costs time and gains little.
_DEFLATE_LEVEL = 6


def encode_float_tiff(picture: np.ndarray, *, deflate: bool = False) -> bytes:
    """TIFF of (h, w) numbers as float32: one strip, little-endian; without loss in either case.

    Args:
        picture: (h, w).
        deflate: pack the strip. The same numbers give the same bytes.
    """
    h, w = picture.shape
    body = picture.astype("<f4").tobytes()
    body = zlib.compress(body, _DEFLATE_LEVEL) if deflate else body
    packing = 8 if deflate else 1
    tags = [(256, w), (257, h), (258, 32), (259, packing), (262, 1), (273, 8), (277, 1), (278, h)]
    tags += [(279, len(body)), (339, 3)]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return struct.pack("<2sHI", b"II", 42, 8 + len(body)) + body + struct.pack("<H", len(tags)) + entries + bytes(4)
