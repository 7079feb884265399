"""Check of a zip archive's directory size, from its end record, before the directory is read into memory."""

import struct
from pathlib import Path
from typing import BinaryIO

from dhtorch.data.io.decode import FormatError
from dhtorch.runtime.safe_open import check_memory

_END_RECORD, _ZIP64_LOCATOR, _ZIP64_END = b"PK\x05\x06", b"PK\x06\x07", b"PK\x06\x06"
_END_RECORD_BYTES, _ZIP64_LOCATOR_BYTES, _ZIP64_END_BYTES = 22, 20, 56
_MIN_ENTRY_BYTES = 46  # size of an entry in the directory without its name


def check_zip_directory(stream: BinaryIO, file: Path) -> None:
    """Check the declared directory size against the archive's size, and its entries against the memory limit.

    Raises:
        FormatError: no end record, a directory larger than the archive, or too many entries.
    """
    total = stream.seek(0, 2)
    tail_at = max(0, total - (1 << 16) - _END_RECORD_BYTES)
    stream.seek(tail_at)
    tail = stream.read()
    at = tail.rfind(_END_RECORD)
    if at < 0 or len(tail) - at < _END_RECORD_BYTES:
        raise FormatError(file, "archive", f"{total} bytes without a directory", "a whole zip archive")
    (size,) = struct.unpack_from("<I", tail, at + 12)
    locator_at = tail_at + at - _ZIP64_LOCATOR_BYTES
    stream.seek(max(0, locator_at))
    locator = stream.read(_ZIP64_LOCATOR_BYTES) if locator_at >= 0 else b""
    if locator.startswith(_ZIP64_LOCATOR):
        stream.seek(max(0, locator_at - _ZIP64_END_BYTES))
        record = stream.read(_ZIP64_END_BYTES)
        if len(record) == _ZIP64_END_BYTES and record.startswith(_ZIP64_END):
            (size,) = struct.unpack_from("<Q", record, 40)
    if size > total:
        raise FormatError(file, "directory", f"{size} bytes in an archive of {total}", "a whole zip archive")
    # Memory that Python takes per entry.
    check_memory(
        file,
        "directory",
        size // _MIN_ENTRY_BYTES * 1200,
        f"up to {size // _MIN_ENTRY_BYTES} entries",
    )
