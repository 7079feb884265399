"""Codec of TIFF by tifffile: the first image of a file, one sample per pixel (confidence, depth) or several (colour).

tifffile reads the directory; size, type and the position of every strip are compared with the file before it unpacks
them.
"""

import io
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dhtorch.data.io.decode import MAX_DEFLATE_RATIO, MAX_PIXELS, FormatError, import_optional, read_bytes
from dhtorch.runtime.safe_open import check_memory

_COMPRESSIONS = (1, 5, 8, 32773, 32946)  # none, LZW, deflate, PackBits, deflate
_TYPES = ("u1", "u2", "u4", "i1", "i2", "i4", "f2", "f4", "f8")


class _TiffHeader(NamedTuple):
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


def read_tiff_header(file: Path) -> _TiffHeader:
    """Size and type of a TIFF file without decoding it.

    Raises:
        FormatError: missing, truncated or unknown file.
    """
    return decode_tiff_header(read_bytes(file), file)


def decode_tiff_header(data: bytes, file: Path) -> _TiffHeader:
    """As :func:`read_tiff_header`, of bytes in memory; ``file`` names them in errors."""
    with _first_page(data, file) as page:
        return _parse_page(page, file)


def decode_tiff(
    data: bytes, file: Path, hw: tuple[int, int] | None = None, samples: Sequence[int] = (1,)
) -> np.ndarray:
    """As :func:`read_tiff`, of bytes in memory; ``file`` names them in errors."""
    with _first_page(data, file) as page:
        size, count, dtype = _parse_page(page, file)
        shape = size if count == 1 else (*size, count)
        if hw is not None and size != tuple(hw):
            raise FormatError(file, "size", f"{size[1]}x{size[0]}", f"{hw[1]}x{hw[0]}")
        if not 0 < math.prod(shape) <= MAX_PIXELS:
            raise FormatError(file, "size", f"{size[1]}x{size[0]}", f"1 to {MAX_PIXELS} pixels")
        # Palettes, inverted grey and separate colour planes are not written by cameras and renderers.
        layout = int(page.compression), int(page.photometric), int(page.planarconfig)
        if count not in samples or layout[0] not in _COMPRESSIONS or layout[1] not in (1, 2) or layout[2] != 1:
            problem = "{} samples per pixel, compression {}, photometric {}, planes {}".format(count, *layout)
            names = ", ".join(map(str, _COMPRESSIONS))
            expected = f"{' or '.join(map(str, samples))} samples, compression {names}, grey or RGB"
            raise FormatError(file, "layout", problem, expected)
        at, sizes, total = page.dataoffsets, page.databytecounts, math.prod(shape) * dtype.itemsize
        if not at or len(at) != len(sizes) or any(a + n > len(data) for a, n in zip(at, sizes, strict=True)):
            raise FormatError(file, "strips", f"{len(at)} offsets, {len(sizes)} sizes", "all inside the file")
        if layout[0] == 1 and (sum(sizes) < total or (not page.is_tiled and sum(sizes) != total)):
            raise FormatError(file, "strips", f"{sum(sizes)} bytes", f"{total} bytes")
        piece = math.prod(page.chunks) * dtype.itemsize
        requested = total if total <= MAX_DEFLATE_RATIO * len(data) else 0
        check_memory(file, "pixels", max(len(at) * piece, total), f"pieces of {piece} bytes", requested)
        if page.shape != shape:
            raise FormatError(file, "data", f"shape {page.shape}", f"{shape}")
        image = page.asarray(maxworkers=1)
    if image.shape != shape or image.dtype != dtype:
        raise FormatError(file, "data", f"{image.dtype} of {image.shape}", f"{dtype} of {shape}")
    return np.ascontiguousarray(image)


@contextmanager
def _first_page(data: bytes, file: Path) -> Iterator[Any]:
    """tifffile's first page; any of its errors, also of what is done with the page, means damage."""
    library = import_optional("tifffile")
    if data[:4] not in (b"II*\0", b"MM\0*") or len(data) < 8:
        raise FormatError(file, "content", f"{data[:4]!r}", "a TIFF image")
    log = library.logger()
    was_disabled, log.disabled = log.disabled, True  # the error below says what its warnings do
    try:
        with library.TiffFile(io.BytesIO(data)) as tiff:
            yield tiff.pages.first
    except FormatError:
        raise
    except Exception as error:
        raise FormatError(file, "data", f"{type(error).__name__} {error}", "a whole TIFF image") from None
    finally:
        log.disabled = was_disabled


def _parse_page(page: Any, file: Path) -> _TiffHeader:
    bits = page.bitspersample
    kind = np.dtype(page.dtype or "V").newbyteorder("=")
    if kind.str[1:] not in _TYPES or bits != 8 * kind.itemsize:
        expected = "8, 16 or 32 bits integer, 16, 32 or 64 floating"
        raise FormatError(file, "samples", f"{bits} bits of kind {page.sampleformat}", expected)
    return _TiffHeader((page.imagelength, page.imagewidth), page.samplesperpixel, kind)
