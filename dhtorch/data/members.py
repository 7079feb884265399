"""Members of a capture: files of a folder, or entries of a zip archive read in place.

Nothing is unpacked to disk. A member stores the position of its bytes: it is picklable, workers open archives of any
length at no cost, and its size is known before its bytes are read.
"""

import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

from dhtorch.data.codecs.zips import check_zip_directory
from dhtorch.data.io.decode import FormatError, read_bytes, refuse_if
from dhtorch.runtime.safe_open import MAX_FILE_BYTES, open_regular

_MAX_MEMBERS = 2_000_000
_LOCAL_HEADER_BYTES = 30  # bytes before the name


@dataclass(frozen=True, slots=True)
class Member:
    """One file of a capture."""

    path: Path  # for an archive: the archive's path / the entry's name

    def read(self) -> bytes:
        """All bytes; at least one, at most ``MAX_FILE_BYTES``.

        Raises:
            FormatError: missing, unreadable, empty, too large, or damaged.
        """
        return read_bytes(self.path)

    def ends(self, count: int) -> tuple[bytes, bytes] | None:
        """First and last ``count`` bytes without reading the rest; None if impossible, empty if unreadable."""
        try:
            with open_regular(self.path) as stream:
                first = stream.read(count)
                stream.seek(-min(count, stream.seek(0, 2)), 2)
                return first, stream.read(count)
        except (OSError, FormatError):
            return b"", b""


@dataclass(frozen=True, slots=True)
class _ZipMember(Member):
    """One entry of a zip archive."""

    archive: Path
    offset: int  # of the entry's local header
    packed: int  # bytes in the archive
    size: int  # bytes when unpacked
    method: int
    crc: int

    def read(self) -> bytes:
        """As :meth:`Member.read`; decompression stops at the size in the archive's directory."""
        refuse_if(
            not 0 < self.size <= MAX_FILE_BYTES or self.packed > MAX_FILE_BYTES,
            self.path,
            "file size",
            f"{self.size} bytes",
            f"1 to {MAX_FILE_BYTES} bytes",
        )
        refuse_if(
            self.method not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED),
            self.path,
            "compression",
            "encryption or a rare method",
            "none or deflate",
        )
        (data,) = self._stored((0, self.packed))
        if self.method == zipfile.ZIP_DEFLATED:
            try:
                data = zlib.decompressobj(-zlib.MAX_WBITS).decompress(data, self.size + 1)
            except zlib.error as error:
                raise FormatError(self.path, "data", error, "a deflated member") from None
        if len(data) != self.size or zlib.crc32(data) != self.crc:
            problem = f"{len(data)} bytes with checksum {zlib.crc32(data):08x}"
            raise FormatError(self.path, "data", problem, f"{self.size} bytes with checksum {self.crc:08x}")
        return data

    def ends(self, count: int) -> tuple[bytes, bytes] | None:
        """As :meth:`Member.ends`; None for a compressed entry."""
        if self.method != zipfile.ZIP_STORED:
            return None
        count = min(count, self.size)
        try:
            first, last = self._stored((0, count), (self.packed - count, count))
            return first, last
        except FormatError:
            return b"", b""

    def _stored(self, *spans: tuple[int, int]) -> list[bytes]:
        """Stored bytes of spans (start, count), relative to the entry's data, which follows its local header."""
        parts: list[bytes] = []
        try:
            with open_regular(self.archive) as stream:
                stream.seek(self.offset)
                signature, name, extra = struct.unpack("<4s22xHH", stream.read(_LOCAL_HEADER_BYTES))
                begin = self.offset + _LOCAL_HEADER_BYTES + name + extra
                for start, count in spans:
                    stream.seek(begin + start)
                    parts.append(stream.read(count))
        except (OSError, ValueError, struct.error) as error:
            raise FormatError(self.path, "entry", error, "a zip entry") from None
        short = [(len(data), count) for data, (_, count) in zip(parts, spans, strict=True) if len(data) != count]
        if short or signature != b"PK\x03\x04":
            n_read, n_expected = short[0] if short else (self.packed, self.packed)
            raise FormatError(
                self.path, "entry", f"{n_read} bytes behind {signature!r}", f"{n_expected} bytes of a zip entry"
            )
        return parts


def list_folder_members(root: Path) -> dict[str, Member]:
    """Name → member for the files of a folder and of its direct subfolders."""
    subfolders = [entry for entry in root.iterdir() if entry.is_dir()]
    files = [entry for folder in (root, *subfolders) for entry in folder.iterdir() if not entry.is_dir()]
    return {file.relative_to(root).as_posix(): Member(file) for file in files}


def list_zip_members(archive: Path) -> dict[str, Member]:
    """Name → member for the files of a zip archive; of entries with the same name the last.

    Raises:
        FormatError: not a zip archive, or more than ``_MAX_MEMBERS`` entries.
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
    refuse_if(len(entries) > _MAX_MEMBERS, archive, "archive", f"{len(entries)} entries", f"at most {_MAX_MEMBERS}")
    members: dict[str, Member] = {}
    for entry in (each for each in entries if not each.is_dir()):
        method = -1 if entry.flag_bits & 0x1 else entry.compress_type  # bit 0: encrypted
        packed = entry.file_size if method == zipfile.ZIP_STORED else entry.compress_size
        path = Path(f"{archive}/{entry.filename}")  # an absolute name must not hide the archive's
        sizes = packed, entry.file_size
        members[entry.filename] = _ZipMember(path, archive, entry.header_offset, *sizes, method, entry.CRC)
    return members
