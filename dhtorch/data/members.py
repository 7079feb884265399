"""The members of a capture: files of a folder, or entries of a zip archive read in place.

Nothing is ever unpacked to disk. A member remembers where its bytes lie, so it pickles, an archive of any length costs
nothing to open in a worker, and a member's size is known before its bytes are read.
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from dhtorch.data.codecs.zips import check_zip_directory
from dhtorch.data.io.decode import MAX_FILE_BYTES, FormatError, read_bytes
from dhtorch.data.io.safe_open import open_regular

_MAX_MEMBERS = 2_000_000
_LOCAL_HEADER_BYTES = 30  # bytes before the name


@dataclass(frozen=True, slots=True)
class Member:
    """One file of a capture."""

    path: Path  # for an archive: the archive's path, then the name inside

    def read(self) -> bytes:
        """All bytes; at least one, at most ``MAX_FILE_BYTES``.

        Raises:
            FormatError: missing, unreadable, empty, too large, or damaged.
        """
        return read_bytes(self.path)

    def ends(self, count: int) -> tuple[bytes, bytes] | None:
        """First and last ``count`` bytes without reading the rest; None where that is not possible."""
        try:
            with open_regular(self.path) as stream:
                first = stream.read(count)
                stream.seek(-min(count, stream.seek(0, 2)), 2)
                return first, stream.read(count)
        except (OSError, FormatError):
            return b"", b""


@dataclass(frozen=True, slots=True)
class ZipMember(Member):
    """One entry of a zip archive."""

    archive: Path
    offset: int  # of the entry's own header
    packed: int  # bytes in the archive
    size: int  # bytes when unpacked
    method: int
    crc: int

    def read(self) -> bytes:
        """As :meth:`Member.read`; a bomb stops at the size that the archive's directory names."""
        if not 0 < self.size <= MAX_FILE_BYTES or self.packed > MAX_FILE_BYTES:
            raise FormatError(self.path, "file size", f"{self.size} bytes", f"1 to {MAX_FILE_BYTES} bytes")
        if self.method not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FormatError(self.path, "compression", "encryption or a rare method", "none or deflate")
        (data,) = self._stored((0, self.packed))
        if self.method == zipfile.ZIP_DEFLATED:
            try:
                data = zlib.decompressobj(-zlib.MAX_WBITS).decompress(data, self.size + 1)
            except zlib.error as error:
                raise FormatError(self.path, "data", error, "a deflated member") from None
        if len(data) != self.size or zlib.crc32(data) != self.crc:
            found = f"{len(data)} bytes with check sum {zlib.crc32(data):08x}"
            raise FormatError(self.path, "data", found, f"{self.size} bytes with check sum {self.crc:08x}")
        return data

    def ends(self, count: int) -> tuple[bytes, bytes] | None:
        """As :meth:`Member.ends`; None for a compressed one."""
        if self.method != zipfile.ZIP_STORED:
            return None
        count = min(count, self.size)
        try:
            first, last = self._stored((0, count), (self.packed - count, count))
            return first, last
        except FormatError:
            return b"", b""

    def _stored(self, *spans: tuple[int, int]) -> list[bytes]:
        """(start, count) bytes as they lie in the archive; the entry's header says how far behind it they begin."""
        try:
            with open_regular(self.archive) as stream:
                stream.seek(self.offset)
                mark, name, extra = struct.unpack("<4s22xHH", stream.read(_LOCAL_HEADER_BYTES))
                begin = self.offset + _LOCAL_HEADER_BYTES + name + extra
                found = [_read_at(stream, begin + start, count) for start, count in spans]
        except (OSError, ValueError, struct.error) as error:
            raise FormatError(self.path, "entry", error, "a zip entry") from None
        short = [(len(data), count) for data, (_, count) in zip(found, spans, strict=True) if len(data) != count]
        if short or mark != b"PK\x03\x04":
            have, want = short[0] if short else (self.packed, self.packed)
            raise FormatError(self.path, "entry", f"{have} bytes behind {mark!r}", f"{want} bytes of a zip entry")
        return found


def _read_at(stream: BinaryIO, start: int, count: int) -> bytes:
    """Up to ``count`` bytes."""
    stream.seek(start)
    return stream.read(count)


def list_folder_members(root: Path) -> dict[str, Member]:
    """Name → member of the files of a folder and of its folders, one level down."""
    inside = [entry for entry in root.iterdir() if entry.is_dir()]
    files = [entry for folder in (root, *inside) for entry in folder.iterdir() if not entry.is_dir()]
    return {file.relative_to(root).as_posix(): Member(file) for file in files}


def list_zip_members(archive: Path) -> dict[str, Member]:
    """Name → member of the files of a zip archive. A name that occurs twice means the last one.

    Raises:
        FormatError: no zip archive, or more than ``_MAX_MEMBERS`` entries.
    """
    try:
        with open_regular(archive) as stream:
            check_zip_directory(stream, archive)
            with zipfile.ZipFile(stream) as directory:
                entries = directory.infolist()
    except FormatError:
        raise
    except (zipfile.BadZipFile, struct.error, ValueError, RuntimeError, EOFError, OSError) as error:
        raise FormatError(archive, "archive", error, "a whole zip archive") from None
    if len(entries) > _MAX_MEMBERS:
        raise FormatError(archive, "archive", f"{len(entries)} entries", f"at most {_MAX_MEMBERS}")
    return {entry.filename: _make_zip_member(archive, entry) for entry in entries if not entry.is_dir()}


def get_member(members: Mapping[str, Member], name: str, root: Path) -> Member:
    """The member of that name.

    Raises:
        FormatError: there is none.
    """
    if name not in members:
        raise FormatError(root, name, f"no such file among {len(members)}", "a file of that name")
    return members[name]


def _make_zip_member(archive: Path, entry: zipfile.ZipInfo) -> ZipMember:
    method = -1 if entry.flag_bits & 0x1 else entry.compress_type  # bit 0: encrypted
    packed = entry.file_size if method == zipfile.ZIP_STORED else entry.compress_size
    path = Path(f"{archive}/{entry.filename}")  # an absolute name must not hide the archive's
    return ZipMember(path, archive, entry.header_offset, packed, entry.file_size, method, entry.CRC)
