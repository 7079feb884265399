"""Codec of single-layer OpenEXR images by OpenEXR: depth maps in metres, focal stacks.

The header is read first, so that the size is checked before pixels are decoded. Only single-part scan-line files, as
cameras write them.
"""

import contextlib
import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dhtorch.data.io.decode import MAX_PIXELS, FormatError, import_optional, read_bytes


class _ExrHeader(NamedTuple):
    """Size and channels of an EXR file."""

    hw: tuple[int, int]
    channels: tuple[str, ...]  # as stored, by name


def read_exr(file: Path, channel: str | None = None, hw: tuple[int, int] | None = None) -> np.ndarray:
    """One channel (h, w) float32, of half, float or integer pixels; NaN and infinity may occur.

    Args:
        file: the image.
        channel: its name. None = R, else Y, Z, V, depth, else the only channel.
        hw: required size.

    Raises:
        FormatError: missing, truncated or unknown file, another size than ``hw``, or no such channel.
        ImportError: no decoder is installed.
    """
    return decode_exr(read_bytes(file), file, channel, hw)


def decode_exr(data: bytes, file: Path, channel: str | None = None, hw: tuple[int, int] | None = None) -> np.ndarray:
    """As :func:`read_exr`, of bytes in memory; ``file`` names them in errors."""
    header = decode_exr_header(data, file)
    if hw is not None and header.hw != tuple(hw):
        raise FormatError(file, "size", f"{header.hw[1]}x{header.hw[0]}", f"{hw[1]}x{hw[0]}")
    candidates = [channel] if channel else ["R", "Y", "Z", "V", "depth", *header.channels[: len(header.channels) == 1]]
    name = next((name for name in candidates if name in header.channels), None)
    if name is None:
        available = ", ".join(header.channels) or "none"
        raise FormatError(file, "channels", available, channel or "one of R, Y, Z, V, depth, or a single one")
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # OpenEXR prints there what is damaged, and has no part then
            image = _open(data)
        pixels = np.array(image.channels()[name].pixels) if image.parts else None
    except (RuntimeError, ValueError, KeyError, TypeError, MemoryError, OSError) as error:
        raise FormatError(file, "data", error, "decodable scan lines") from None
    if pixels is None:
        raise FormatError(file, "data", f"scan lines missing or damaged in {len(data)} bytes", "a whole image")
    if pixels.shape != header.hw:
        raise FormatError(file, f"channel {name}", f"shape {pixels.shape}", f"{header.hw}, not sub-sampled")
    return pixels.astype(np.float32)


def decode_exr_header(data: bytes, file: Path) -> _ExrHeader:
    """Size and channels of an EXR file in memory without decoding it; ``file`` names it in errors.

    Raises:
        FormatError: truncated or unknown file, several parts, tiles, or more than ``MAX_PIXELS`` pixels.
    """
    if not data.startswith(b"\x76\x2f\x31\x01"):
        raise FormatError(file, "content", f"{data[:4]!r}", "an OpenEXR image")
    try:
        image = _open(data, header_only=True)
        header, n_parts = image.header(), len(image.parts)
        (x0, y0), (x1, y1) = (corner.tolist() for corner in header["dataWindow"])
        channels, kind = tuple(each.name for each in header["channels"]), header["type"].name
    except (RuntimeError, ValueError, KeyError, IndexError, TypeError, MemoryError, OSError) as error:
        raise FormatError(file, "header", error, "channels and dataWindow") from None
    if n_parts != 1 or kind != "scanlineimage":
        raise FormatError(file, "parts", f"{n_parts} of type {kind}", "one part of scan lines")
    h, w = y1 - y0 + 1, x1 - x0 + 1
    if h < 1 or w < 1 or h * w * max(len(channels), 1) > MAX_PIXELS:
        raise FormatError(file, "dataWindow", f"{w}x{h} with {len(channels)} channels", f"1 to {MAX_PIXELS} values")
    return _ExrHeader((h, w), channels)


def _open(data: bytes, *, header_only: bool = False) -> Any:
    library = import_optional("OpenEXR")
    return library.File(io.BytesIO(data), separate_channels=True, header_only=header_only, num_threads=0)
