"""LZFSE, Apple's compression: Record3D keeps depth and confidence in it.

A stream is a chain of blocks, each with its kind and its unpacked size in front, closed by ``bvx$``. The chain is
walked before a decoder sees a byte, so a truncated stream, or one that would unpack to another size, never gets there.
"""

from __future__ import annotations

import struct
from pathlib import Path
from types import ModuleType

from dhtorch.data.io.decode import FormatError, import_optional

_END_OF_STREAM = b"bvx$"


def decompress_lzfse(data: bytes, size: int, file: Path, field: str) -> bytes:
    """Exactly ``size`` bytes of an LZFSE stream; a member that is not compressed and has that size is returned as is.

    Raises:
        FormatError: truncated, damaged, or of another size.
        ImportError: no decoder is installed.
    """
    if len(data) == size and not data.startswith(b"bvx"):
        return data
    claimed = lzfse_unpacked_size(data, file, field)
    if claimed != size:
        raise FormatError(file, field, f"{claimed} bytes when unpacked", f"{size} bytes")
    # imagecodecs is told how much room there is; the other two grow their buffer as long as a hostile stream asks.
    decoder = import_optional("imagecodecs", "liblzfse", "lzfse")
    try:
        bounded = decoder.__name__ == "imagecodecs"
        raw = bytes(decoder.lzfse_decode(data, out=size) if bounded else decoder.decompress(data))
    except _decoder_errors(decoder) as error:
        raise FormatError(file, field, error or "damaged blocks", "a whole LZFSE stream") from None
    if len(raw) != size:
        raise FormatError(file, field, f"{len(raw)} bytes when unpacked", f"{size} bytes")
    return raw


def lzfse_unpacked_size(data: bytes, file: Path, field: str) -> int:
    """Bytes that the blocks of a stream say they hold; every block and the end mark lie inside ``data``.

    Raises:
        FormatError: no LZFSE, an unknown block, or the stream ends before its end mark.
    """
    at, size = 0, 0
    while data[at : at + 4] != _END_OF_STREAM:
        try:
            raw, length = _parse_block(data, at)
        except (struct.error, KeyError):
            found = f"{data[at : at + 4]!r} at byte {at} of {len(data)}"
            raise FormatError(file, field, found, "a whole LZFSE block") from None
        at, size = at + length, size + raw
    return size


def _parse_block(data: bytes, at: int) -> tuple[int, int]:
    """(unpacked bytes, length in the stream) of the block at a place."""
    kind, raw = struct.unpack_from("<4sI", data, at)
    if kind == b"bvx-":  # stored
        length = 8 + raw
    elif kind == b"bvxn":  # LZVN
        length = 12 + struct.unpack_from("<I", data, at + 8)[0]
    elif kind == b"bvx2":  # packed tables: 20-bit payload sizes, 32-bit size of the header
        first, second, third = struct.unpack_from("<QQQ", data, at + 8)
        length = (third & 0xFFFFFFFF) + (first >> 20 & 0xFFFFF) + (second >> 40 & 0xFFFFF)
    else:  # bvx1, with its tables unpacked, exists on paper: encoders write bvx2
        raise KeyError(kind)
    if length < 8:
        raise KeyError(kind)
    return raw, length


def _decoder_errors(decoder: ModuleType) -> tuple[type[Exception], ...]:
    own = (getattr(decoder, name, ValueError) for name in ("error", "LzfseError"))
    return (RuntimeError, ValueError, MemoryError, *own)
