"""Codec of single-layer OpenEXR images: depth maps in metres, focal stacks.

The header is parsed here, so that the size is known without decoding and is checked before it reaches the decoder. Only
single-part scan-line files, as cameras write them.
"""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dhtorch.data.io.decode import MAX_PIXELS, FormatError, import_optional, read_bytes

_MAGIC = b"\x76\x2f\x31\x01"
_TILED, _DEEP, _MULTIPART = 0x200, 0x800, 0x1000  # bits of the version field
_LINES_PER_CHUNK = {
    0: 1,
    1: 1,
    2: 1,
    3: 16,
    4: 32,
    5: 16,
    6: 32,
    7: 32,
    8: 32,
    9: 256,
}  # compression → scan lines in a chunk


class ExrHeader(NamedTuple):
    """Size, channels and chunk table of an EXR file."""

    hw: tuple[int, int]
    channels: tuple[str, ...]  # as stored, by name
    start: int  # offset of the table of chunks
    chunks: int


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
    name = _select_channel(header, channel, file)
    _check_chunks(header, data, file)
    library = import_optional("OpenEXR")
    try:
        with library.File(io.BytesIO(data), separate_channels=True, num_threads=0) as picture:
            pixels = np.array(picture.channels()[name].pixels)
    except (RuntimeError, ValueError, KeyError, TypeError, MemoryError, OSError) as error:
        raise FormatError(file, "data", error, "decodable scan lines") from None
    if pixels.shape != header.hw:
        raise FormatError(file, f"channel {name}", f"shape {pixels.shape}", f"{header.hw}, not sub-sampled")
    return pixels.astype(np.float32)


def read_exr_header(file: Path) -> ExrHeader:
    """Size and channels of an EXR file without decoding it.

    Raises:
        FormatError: missing, truncated or unknown file, several parts, tiles, or more than ``MAX_PIXELS`` pixels.
    """
    return decode_exr_header(read_bytes(file), file)


def decode_exr_header(data: bytes, file: Path) -> ExrHeader:
    """As :func:`read_exr_header`, of bytes in memory; ``file`` names them in errors."""
    if not data.startswith(_MAGIC) or len(data) < 8:
        raise FormatError(file, "content", f"{data[:4]!r}", "an OpenEXR image")
    version = struct.unpack_from("<I", data, 4)[0]
    if version & 0xFF != 2 or version & (_TILED | _DEEP | _MULTIPART):
        raise FormatError(file, "version", f"{version:#x}", "2, one part of scan lines")
    attributes, start = _parse_attributes(data, file)
    try:
        x0, y0, x1, y1 = struct.unpack("<4i", attributes["dataWindow"])
        per_chunk = _LINES_PER_CHUNK[attributes["compression"][0]]
        channels = _parse_channels(attributes["channels"])
    except (KeyError, IndexError, struct.error, ValueError) as error:
        raise FormatError(file, "header", error, "channels, compression and dataWindow") from None
    h, w = y1 - y0 + 1, x1 - x0 + 1
    if h < 1 or w < 1 or h * w * max(len(channels), 1) > MAX_PIXELS:
        problem = f"{w}x{h} with {len(channels)} channels"
        raise FormatError(file, "dataWindow", problem, f"1 to {MAX_PIXELS} values")
    return ExrHeader((h, w), channels, start, -(-h // per_chunk))


def _parse_attributes(data: bytes, file: Path) -> tuple[dict[str, bytes], int]:
    """(name → value of the header's attributes, offset of the header's end)."""
    attributes: dict[str, bytes] = {}
    at = 8
    while at < len(data) and data[at]:
        try:
            name_end = data.index(b"\0", at, at + 256)
            kind_end = data.index(b"\0", name_end + 1, name_end + 257)
            size = struct.unpack_from("<I", data, kind_end + 1)[0]
        except (ValueError, struct.error):
            raise FormatError(file, "header", f"damage at byte {at}", "attributes") from None
        end = kind_end + 5 + size
        if end > len(data):
            raise FormatError(file, "header", f"an attribute of {size} bytes at byte {at}", f"{len(data)} in all")
        attributes[data[at:name_end].decode("latin-1")] = data[kind_end + 5 : end]
        at = end
    return attributes, at + 1


def _parse_channels(value: bytes) -> tuple[str, ...]:
    names, at = [], 0
    while value[at]:
        end = value.index(b"\0", at)
        names.append(value[at:end].decode("latin-1"))
        at = end + 17  # type, linear, reserved, sampling
    return tuple(names)


def _check_chunks(header: ExrHeader, data: bytes, file: Path) -> None:
    """Check that every chunk of the table lies inside the file, which fails for truncated images."""
    end = header.start + 8 * header.chunks
    if end > len(data):
        raise FormatError(file, "data", f"{len(data)} bytes", f"a table of {header.chunks} chunks and the chunks")
    offsets = struct.unpack_from(f"<{header.chunks}Q", data, header.start)
    for i, offset in enumerate(offsets):
        inside = end <= offset <= len(data) - 8
        if not inside or offset + 8 + struct.unpack_from("<I", data, offset + 4)[0] > len(data):
            raise FormatError(file, f"chunk {i}", f"bytes beyond the {len(data)} of the file", "a whole image")


def _select_channel(header: ExrHeader, channel: str | None, file: Path) -> str:
    candidates = [channel] if channel else ["R", "Y", "Z", "V", "depth", *header.channels[: len(header.channels) == 1]]
    for name in candidates:
        if name in header.channels:
            return name
    available = ", ".join(header.channels) or "none"
    raise FormatError(file, "channels", available, channel or "one of R, Y, Z, V, depth, or a single one")
