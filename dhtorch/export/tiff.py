"""Writer of float32 TIFF: depth maps in metres, lossless, as images in tables."""

import struct
import zlib

import numpy as np


def encode_float_tiff(picture: np.ndarray, *, deflate: bool = False) -> bytes:
    """Numbers (h, w) → bytes of a float32 TIFF with one strip, little-endian; lossless.

    Args:
        picture: (h, w).
        deflate: compress the strip. Equal numbers give equal bytes.
    """
    h, w = picture.shape
    body = picture.astype("<f4").tobytes()
    # Level of deflate: higher ones take longer and gain little.
    body = zlib.compress(body, 6) if deflate else body
    compression = 8 if deflate else 1
    tags = [(256, w), (257, h), (258, 32), (259, compression), (262, 1), (273, 8), (277, 1), (278, h)]
    tags += [(279, len(body)), (339, 3)]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return struct.pack("<2sHI", b"II", 42, 8 + len(body)) + body + struct.pack("<H", len(tags)) + entries + bytes(4)
