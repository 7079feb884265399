"""Codec of LZFSE, Apple's compression, used by Record3D for depth and confidence.

A stream is a sequence of blocks, each starting with its type and unpacked size, terminated by ``bvx$``. The blocks are
checked before decoding, so that truncated streams, or streams of another size, do not reach the decoder.
"""

import struct
from pathlib import Path

from dhtorch.data.io.decode import FormatError, import_optional

_END_OF_STREAM = b"bvx$"


def decompress_lzfse(data: bytes, size: int, file: Path, field: str) -> bytes:
    """LZFSE stream → exactly ``size`` bytes; uncompressed data of that size is returned unchanged.

    Raises:
        FormatError: truncated, damaged, or of another size.
        ImportError: no decoder is installed.
    """
    if len(data) == size and not data.startswith(b"bvx"):
        return data
    declared = lzfse_unpacked_size(data, file, field)
    if declared != size:
        raise FormatError(file, field, f"{declared} bytes when unpacked", f"{size} bytes")
    try:  # into a buffer of fixed size, which no stream enlarges
        raw = bytes(import_optional("imagecodecs").lzfse_decode(data, out=size))
    except (RuntimeError, ValueError, MemoryError) as error:
        raise FormatError(file, field, error or "damaged blocks", "a whole LZFSE stream") from None
    if len(raw) != size:
        raise FormatError(file, field, f"{len(raw)} bytes when unpacked", f"{size} bytes")
    return raw


def lzfse_unpacked_size(data: bytes, file: Path, field: str) -> int:
    """Unpacked size in bytes declared by the blocks of a stream; checks that all blocks lie inside ``data``.

    Raises:
        FormatError: not LZFSE, an unknown block, or the stream ends before its end mark.
    """
    at, size = 0, 0
    while data[at : at + 4] != _END_OF_STREAM:
        try:
            # (unpacked bytes, bytes in the stream) of the block at offset ``at``
            kind, raw = struct.unpack_from("<4sI", data, at)
            if kind == b"bvx-":  # stored
                length = 8 + raw
            elif kind == b"bvxn":  # LZVN
                length = 12 + struct.unpack_from("<I", data, at + 8)[0]
            elif kind == b"bvx2":  # packed tables: 20-bit payload sizes, 32-bit size of the header
                first, second, third = struct.unpack_from("<QQQ", data, at + 8)
                length = (third & 0xFFFFFFFF) + (first >> 20 & 0xFFFFF) + (second >> 40 & 0xFFFFF)
            else:  # bvx1, with uncompressed tables, is specified but not written by encoders
                raise KeyError(kind)
            if length < 8:
                raise KeyError(kind)
        except (struct.error, KeyError):
            problem = f"{data[at : at + 4]!r} at byte {at} of {len(data)}"
            raise FormatError(file, field, problem, "a whole LZFSE block") from None
        at, size = at + length, size + raw
    return size
