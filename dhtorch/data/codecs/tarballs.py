"""Codec of tar archives read in place: offset and bytes of every member; nothing is unpacked to disk.

The index is made in one pass over the headers; a damaged header, or a member that ends beyond the archive, raises
``FormatError``. Supported are old, ustar, GNU (long names) and pax (path, size) headers, uncompressed; members other
than regular files (folders, links, devices) are skipped.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from dhtorch.data.io.decode import FormatError
from dhtorch.runtime.safe_open import MAX_FILE_BYTES, open_regular, unreadable_error

_BLOCK_BYTES = 512
_MAX_NAME_BYTES = 1_000_000  # of a long name or a pax header
_FILES, _PAX, _LONG_NAME, _SPARSE = b"0\x007", b"x", b"L", b"S"
_KINDS_WITHOUT_DATA = b"123456"  # links, devices, folders: their declared size is ignored


class _TarMember(NamedTuple):
    """A regular file in an archive."""

    name: str
    offset: int  # of its first byte in the archive
    size: int


def iter_tar_members(file: Path) -> Iterator[_TarMember]:
    """The regular files of an archive, in stored order.

    Raises:
        FormatError: missing file, a damaged header, or an archive that ends too early.
    """
    try:
        with open_regular(file) as stream:
            yield from _iter_headers(file, stream.fileno())
    except OSError as error:
        raise unreadable_error(file, error) from None


def read_tar_member(file: Path, offset: int, size: int, limit: int = MAX_FILE_BYTES) -> bytes:
    """The bytes of a member.

    Raises:
        FormatError: unreadable or truncated archive, or more bytes than ``limit``.
    """
    if size > limit:
        raise FormatError(file, f"member at byte {offset}", f"{size} bytes", f"at most {limit} bytes")
    try:
        with open_regular(file) as stream:
            data = os.pread(stream.fileno(), size, offset)
    except OSError as error:
        raise unreadable_error(file, error) from None
    if len(data) != size:
        raise FormatError(file, f"member at byte {offset}", f"{len(data)} bytes", f"{size} bytes")
    return data


def _iter_headers(file: Path, stream: int) -> Iterator[_TarMember]:
    total, at = os.fstat(stream).st_size, 0
    special: dict[str, str] = {}  # path and size of the next member, from an extra header
    while at + _BLOCK_BYTES <= total:
        header = os.pread(stream, _BLOCK_BYTES, at)
        if not header.strip(b"\0"):
            return
        stored = _parse_number(header[148:156])
        if stored != sum(header[:148]) + 8 * 32 + sum(header[156:]):
            raise FormatError(file, f"header at byte {at}", "a wrong checksum", "a tar header, not compressed")
        size = _parse_number(header[124:136])
        if size is None or size < 0:
            raise FormatError(file, f"header at byte {at}", f"size {header[124:136]!r}", "a number of bytes")
        name, kind = _decode_text(header[:100]), header[156:157]
        folder = _decode_text(header[345:500]) if header[257:263] == b"ustar\0" else ""
        name = f"{folder}/{name}" if folder else name
        if (text := special.get("size")) is not None:
            if not (text.isascii() and text.isdecimal() and len(text) <= 18):
                raise FormatError(file, f"header at byte {at}", f"size {text}", "a number of bytes")
            size = int(text)
        size = 0 if kind in _KINDS_WITHOUT_DATA else size
        data, at = at + _BLOCK_BYTES, at + _BLOCK_BYTES + (size + _BLOCK_BYTES - 1) // _BLOCK_BYTES * _BLOCK_BYTES
        if data + size > total:
            raise FormatError(file, special.get("path", name), f"{total - data} of {size} bytes", "a whole archive")
        if kind in _LONG_NAME + _PAX:
            if size > _MAX_NAME_BYTES:
                raise FormatError(file, f"header at byte {data}", f"{size} bytes", f"at most {_MAX_NAME_BYTES} bytes")
            content = os.pread(stream, size, data)
            special |= _parse_pax(content) if kind == _PAX else {"path": _decode_text(content)}
            continue
        if kind in _FILES:
            yield _TarMember(special.get("path", name), data, size)
        elif kind == _SPARSE:
            raise FormatError(file, name, "a sparse member", "plain files")
        special = {}
    if at == 0:
        raise FormatError(file, "content", f"{total} bytes", "a tar archive")


def _parse_number(field: bytes) -> int | None:
    """Octal digits, or GNU's big-endian number with the top bit set → number; None if it is neither."""
    if field[0] & 0x80:
        return int.from_bytes(bytes([field[0] & 0x7F]) + field[1:], "big") if field[0] == 0x80 else None
    digits = field.strip(b" \0")
    return int(digits or b"0", 8) if all(48 <= c < 56 for c in digits) else None


def _decode_text(field: bytes) -> str:
    return field.split(b"\0", 1)[0].decode("utf-8", "replace")


def _parse_pax(text: bytes) -> dict[str, str]:
    """``length key=value`` lines → path and size, as far as present; a damaged line ends the list."""
    entries, at = {}, 0
    while (space := text.find(b" ", at, at + 12)) > at and text[at:space].isdigit():
        end = at + int(text[at:space])
        if not space < end <= len(text):
            break
        key, _, value = text[space + 1 : end - 1].partition(b"=")
        if key in (b"path", b"size"):
            entries[key.decode()] = value.decode("utf-8", "replace")
        at = end
    return entries
