"""Zip archives: what the end of one says about its directory, before anybody reads that into memory."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

from dhtorch.data.io.decode import FormatError
from dhtorch.data.io.safe_open import allow

_END, _LONG_PLACE, _LONG_END = b"PK\x05\x06", b"PK\x06\x07", b"PK\x06\x06"
_END_BYTES, _PLACE_BYTES, _LONG_BYTES = 22, 20, 56
_COMMENT = 1 << 16
_ENTRY = 46  # bytes of an entry without its name
_KEPT = 1200  # bytes that Python takes for one


def check_directory(stream: BinaryIO, file: Path) -> None:
    """Hold the size of an archive's directory against the archive, and its entries against memory.

    Raises:
        FormatError: no end of an archive, a directory that does not fit into it, or more entries than are allowed.
    """
    total = stream.seek(0, 2)
    tail_at = max(0, total - _COMMENT - _END_BYTES)
    stream.seek(tail_at)
    tail = stream.read()
    at = tail.rfind(_END)
    if at < 0 or len(tail) - at < _END_BYTES:
        raise FormatError(file, "archive", f"{total} bytes without a directory", "a whole zip archive")
    (size,) = struct.unpack_from("<I", tail, at + 12)
    place = tail_at + at - _PLACE_BYTES
    stream.seek(max(0, place))
    long = stream.read(_PLACE_BYTES) if place >= 0 else b""
    if long.startswith(_LONG_PLACE):
        stream.seek(max(0, place - _LONG_BYTES))
        record = stream.read(_LONG_BYTES)
        if len(record) == _LONG_BYTES and record.startswith(_LONG_END):
            (size,) = struct.unpack_from("<Q", record, 40)
    if size > total:
        raise FormatError(file, "directory", f"{size} bytes in an archive of {total}", "a whole zip archive")
    allow(file, "directory", size // _ENTRY * _KEPT, f"up to {size // _ENTRY} entries")
