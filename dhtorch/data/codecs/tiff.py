"""Codec of TIFF: the first image of a file, with one sample per pixel (confidence, depth) or several (colour).

The first directory is parsed here, so that size, type and the position of every strip are compared with the file
before the decoder unpacks the strips.
"""

from __future__ import annotations

import io
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dhtorch.data.io.decode import MAX_DEFLATE_RATIO, MAX_PIXELS, FormatError, import_optional, read_bytes
from dhtorch.runtime.safe_open import check_memory

_TAG_VALUE_BYTES = {
    1: 1,
    2: 1,
    3: 2,
    4: 4,
    5: 8,
    6: 1,
    7: 1,
    8: 2,
    9: 4,
    10: 8,
    11: 4,
    12: 8,
}  # bytes of a tag's value by type
_SAMPLE_KINDS = {1: "u", 2: "i", 3: "f"}  # sample format
_SAMPLE_BITS = {"u": (8, 16, 32), "i": (8, 16, 32), "f": (16, 32, 64)}
_COMPRESSIONS = {1: "none", 5: "LZW", 8: "deflate", 32773: "PackBits", 32946: "deflate"}


class TiffHeader(NamedTuple):
    """Size, samples per pixel and type of the first image."""

    hw: tuple[int, int]
    samples: int  # per pixel
    dtype: np.dtype


def read_tiff(file: Path, hw: tuple[int, int] | None = None, samples: Sequence[int] = (1,)) -> np.ndarray:
    """Numbers (h, w), or (h, w, samples) for several, in the stored type, integer or floating point; may contain NaN.

    Args:
        file: the image.
        hw: required size.
        samples: accepted numbers of samples per pixel.

    Raises:
        FormatError: missing or damaged file, another number of samples, another size than ``hw``.
        ImportError: no decoder is installed.
    """
    return decode_tiff(read_bytes(file), file, hw, samples)


def read_tiff_header(file: Path) -> TiffHeader:
    """Size and type of a TIFF file without decoding it.

    Raises:
        FormatError: missing, truncated or unknown file.
    """
    return decode_tiff_header(read_bytes(file), file)


def decode_tiff_header(data: bytes, file: Path) -> TiffHeader:
    """As :func:`read_tiff_header`, of bytes in memory; ``file`` names them in errors."""
    tags = _read_first_directory(data, file)
    return TiffHeader(
        (_single_tag_value(tags, 257, None, file), _single_tag_value(tags, 256, None, file)),
        _single_tag_value(tags, 277, 1, file),
        _dtype(tags, file),
    )


def decode_tiff(
    data: bytes, file: Path, hw: tuple[int, int] | None = None, samples: Sequence[int] = (1,)
) -> np.ndarray:
    """As :func:`read_tiff`, of bytes in memory; ``file`` names them in errors."""
    tags = _read_first_directory(data, file)
    keys = ((256, None), (257, None), (259, 1), (262, 1), (277, 1), (284, 1))
    values = {key: _single_tag_value(tags, key, default, file) for key, default in keys}
    size, count, dtype = (values[257], values[256]), values[277], _dtype(tags, file)
    shape = size if count == 1 else (*size, count)
    if hw is not None and size != tuple(hw):
        raise FormatError(file, "size", f"{size[1]}x{size[0]}", f"{hw[1]}x{hw[0]}")
    if not 0 < math.prod(shape) <= MAX_PIXELS:
        raise FormatError(file, "size", f"{size[1]}x{size[0]}", f"1 to {MAX_PIXELS} pixels")
    # Palettes, inverted grey and separate colour planes are not written by cameras and renderers.
    if count not in samples or values[259] not in _COMPRESSIONS or values[262] not in (1, 2) or values[284] != 1:
        problem = (
            f"{count} samples per pixel, compression {values[259]}, photometric {values[262]}, planes {values[284]}"
        )
        expected = (
            f"{' or '.join(map(str, samples))} samples, compression {', '.join(map(str, _COMPRESSIONS))}, grey or RGB"
        )
        raise FormatError(file, "layout", problem, expected)
    _check_strips(tags, data, file, math.prod(shape) * dtype.itemsize if values[259] == 1 else None)
    tile = (
        _single_tag_value(tags, 322, size[1], file)
        * _single_tag_value(tags, 323, size[0], file)
        * count
        * dtype.itemsize
    )
    requested = (
        math.prod(shape) * dtype.itemsize if math.prod(shape) * dtype.itemsize <= MAX_DEFLATE_RATIO * len(data) else 0
    )
    check_memory(file, "tile", len(tags.get(324, (0,))) * tile, f"tiles of {tile} bytes", requested)
    library = import_optional("tifffile")
    try:
        with library.TiffFile(io.BytesIO(data)) as tiff:
            page = tiff.pages.first
            if page.shape != shape or page.dtype != dtype:
                raise FormatError(file, "data", f"{page.dtype} of {page.shape}", f"{dtype} of {shape}")
            image = page.asarray(maxworkers=1)
    except FormatError:
        raise
    except Exception as error:  # any error of the decoder means damage
        raise FormatError(file, "data", error or type(error).__name__, "a whole TIFF image") from None
    if image.shape != shape:
        raise FormatError(file, "data", f"shape {image.shape}", f"{shape}")
    return np.ascontiguousarray(image)


def _read_first_directory(data: bytes, file: Path) -> dict[int, tuple[int, ...]]:
    """Tag → its integers (tags of other types are left out)."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(data[:4])
    if order is None or len(data) < 8:
        raise FormatError(file, "content", f"{data[:4]!r}", "a TIFF image")
    tags: dict[int, tuple[int, ...]] = {}
    try:
        (at,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, at)
        for k in range(count):
            tag, kind, n = struct.unpack_from(f"{order}HHI", data, at + 2 + 12 * k)
            if kind not in (1, 3, 4) or n < 1 or n * _TAG_VALUE_BYTES[kind] > len(data):
                continue
            value_at = at + 10 + 12 * k
            if n * _TAG_VALUE_BYTES[kind] > 4:
                (value_at,) = struct.unpack_from(f"{order}I", data, value_at)
            tags[tag] = struct.unpack_from(f"{order}{n}{' BXHI'[kind]}", data, value_at)
    except struct.error:
        raise FormatError(file, "directory", f"one beyond the {len(data)} bytes", "a whole TIFF image") from None
    return tags


def _single_tag_value(tags: dict[int, tuple[int, ...]], tag: int, default: int | None, file: Path) -> int:
    """The value of a tag; if it has one per sample they must be equal."""
    values = set(tags.get(tag, () if default is None else (default,)))
    if len(values) != 1:
        raise FormatError(file, f"tag {tag}", f"{len(values)} different numbers", "one")
    return values.pop()


def _dtype(tags: dict[int, tuple[int, ...]], file: Path) -> np.dtype:
    bits, kind = _single_tag_value(tags, 258, 1, file), _SAMPLE_KINDS.get(_single_tag_value(tags, 339, 1, file), "?")
    if bits not in _SAMPLE_BITS.get(kind, ()):
        expected = "8, 16 or 32 bits integer, 16, 32 or 64 floating"
        raise FormatError(file, "samples", f"{bits} bits of kind {kind}", expected)
    return np.dtype(f"{kind}{bits // 8}")


def _check_strips(tags: dict[int, tuple[int, ...]], data: bytes, file: Path, total: int | None) -> None:
    """Check that every strip (or tile) lies inside the file and, uncompressed, that they have the image's size."""
    tiled = 324 in tags
    at, sizes = tags.get(324 if tiled else 273, ()), tags.get(325 if tiled else 279, ())
    if not at or len(at) != len(sizes) or any(a + n > len(data) for a, n in zip(at, sizes, strict=True)):
        raise FormatError(file, "strips", f"{len(at)} offsets, {len(sizes)} sizes", "all inside the file")
    if total is not None and (sum(sizes) < total or (not tiled and sum(sizes) != total)):
        raise FormatError(file, "strips", f"{sum(sizes)} bytes", f"{total} bytes")
