"""Codec of robots' recordings: the messages of MCAP files, ROS 1 bags (version 2.0) and ROS 2 bags in SQLite.

The records of MCAP and ROS 1 are read in order, so that a file that was not closed is read up to its last whole record,
which needs no index at its end and which the library rosbags refuses. Only the first bytes of each message are read,
and chunks are unpacked one at a time, to their stated size at most.

A database is opened for reading alone and as immutable: nothing is written beside it, and no journal is read. Only
plain tables are read; a view or a virtual table, whose definition would be executed, is refused.
"""

import bz2
import io
import sqlite3
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple
from urllib.parse import quote

from dhtorch.data.io.decode import FormatError, import_optional
from dhtorch.runtime.safe_open import MAX_FILE_BYTES, check_memory, open_regular, read_version

_MCAP: Final = b"\x89MCAP0\r\n"
_SQLITE: Final = b"SQLite format 3\0"
#: First bytes of a file → what it is.
BAG_SIGNATURES: Final = {
    _MCAP: "an MCAP file",
    b"#ROSBAG V2.0\n": "a ROS 1 bag",
    _SQLITE: "a ROS 2 bag in SQLite",
}
#: Bytes of a message that indexing reads: header, size and encoding of an image.
HEAD_BYTES: Final = 1024

#: Kinds of records by their codes.
_MCAP_KINDS: Final = {2: "end", 3: "schema", 4: "channel", 5: "message", 6: "chunk", 15: "end"}
_ROS_1_KINDS: Final = {2: "message", 5: "chunk", 7: "channel"}
_MESSAGE_HEADER: Final = struct.Struct("<HIQQ")  # of MCAP: channel, sequence, times of recording and of publication
_MAX_HEADER_BYTES: Final = 1 << 20  # of a schema, channel or header of a record; definitions take some kilobytes
_DATABASE_ROW: Final = -2  # chunk of a message in a database
_COLUMNS: Final = {"topics": {"id", "name", "type", "serialization_format"}, "messages": {"id", "topic_id", "data"}}
_MAX_TOPICS: Final = 100_000  # of a database


class Topic(NamedTuple):
    """A stream of messages of one type."""

    name: str
    type: str  # as package/Type, without the /msg/ of ROS 2
    coding: str  # of its messages: cdr, ros1, or another one, which is not decoded


class MessagePlace(NamedTuple):
    """Place of a message's bytes."""

    file: Path
    chunk: int  # offset of the compressed chunk; −1 = none, −2 = row of a database
    start: int  # offset in the chunk, else in the file; number of the row
    length: int


class IndexedMessage(NamedTuple):
    """A message as listed by an index."""

    topic: Topic
    time_ns: int  # when it was recorded
    place: MessagePlace
    head: bytes  # its first bytes


def read_signature(file: Path) -> bytes:
    """The signature of a bag with which a file begins; empty where it has none or cannot be read."""
    try:
        with open_regular(file) as stream:
            head = stream.read(16)
    except (FormatError, OSError):
        return b""
    return next((signature for signature in BAG_SIGNATURES if head.startswith(signature)), b"")


def iter_messages(file: Path) -> Iterator[IndexedMessage]:
    """The messages of a file in its order; nothing beyond a truncated record.

    Raises:
        FormatError: no bag, or damaged records.
    """
    signature = read_signature(file)
    if signature == _SQLITE:
        with _open_database(file) as database:
            query = "SELECT id, name, type, serialization_format FROM topics LIMIT ?"
            rows = database.execute(query, (_MAX_TOPICS + 1,)).fetchall()
            if len(rows) > _MAX_TOPICS:
                raise FormatError(file, "topics", f"more than {_MAX_TOPICS}", "fewer")
            if not all(isinstance(word, str) for row in rows for word in row[1:]):
                raise FormatError(file, "topics", "a name that is no text", "texts")
            topics = {number: _make_topic(*words) for number, *words in rows}
            columns = "id, topic_id, timestamp, length(data), substr(data, 1, ?)"
            for row in database.execute(f"SELECT {columns} FROM messages ORDER BY id", (HEAD_BYTES,)):
                number, topic, stamp, length, head = row
                if topic not in topics or not isinstance(head, bytes) or not isinstance(stamp, int):
                    raise FormatError(file, f"message {number}", f"topic {topic}", "a blob of a declared topic")
                yield IndexedMessage(topics[topic], stamp, MessagePlace(file, _DATABASE_ROW, number, length), head)
        return
    if not signature:
        raise FormatError(file, "content", "no signature of a bag", f"{', '.join(BAG_SIGNATURES.values())}")
    with open_regular(file) as stream:
        records = _Records(file, is_mcap=signature == _MCAP)
        yield from records.iter_messages(stream, len(signature), stream.seek(0, 2))


def read_message(place: MessagePlace) -> bytes:
    """All bytes of a message.

    Raises:
        FormatError: missing, too long, or a damaged file.
    """
    if place.chunk == _DATABASE_ROW:
        with _open_database(place.file) as database:
            query = "SELECT data FROM messages WHERE id = ? AND length(data) <= ?"
            row = database.execute(query, (place.start, MAX_FILE_BYTES)).fetchone()
        if row is None or not isinstance(row[0], bytes):
            expected = f"a blob of at most {MAX_FILE_BYTES} bytes"
            raise FormatError(place.file, f"message {place.start}", "nothing", expected)
        return row[0]
    if not 0 <= place.length <= MAX_FILE_BYTES:
        raise FormatError(place.file, "message", f"{place.length} bytes", f"at most {MAX_FILE_BYTES}")
    if place.chunk >= 0:
        content = _read_chunk(place.file, read_version(place.file), place.chunk)
        return content[place.start : place.start + place.length]
    with open_regular(place.file) as stream:
        stream.seek(place.start)
        return stream.read(place.length)


# ---------------------------------------------------------------------------------------------------- MCAP and ROS 1


class _Record(NamedTuple):
    kind: str
    begin: int  # offset of the record
    start: int  # offset of its data
    length: int
    header: dict[str, bytes]  # of ROS 1


class _Records:
    """Records of a file, and the declarations met so far."""

    def __init__(self, file: Path, *, is_mcap: bool) -> None:
        self.file, self.is_mcap = file, is_mcap
        self.schemas: dict[int, str] = {}
        self.topics: dict[int, Topic] = {}

    def iter_messages(
        self, stream: BinaryIO, start: int, end: int, chunk: int | None = None
    ) -> Iterator[IndexedMessage]:
        """Messages of the records between two offsets; ``chunk``: where they are in one, its offset if compressed."""
        for record in self._iter_records(stream, start, end):
            if record.kind == "end":
                return
            try:
                if record.kind == "chunk" and chunk is None:
                    compression, _, start, length = self._parse_chunk(stream, record)
                    inner: tuple[BinaryIO, int, int, int] = stream, start, start + length, -1
                    if compression:
                        content = _read_chunk(self.file, read_version(self.file), record.begin)
                        inner = io.BytesIO(content), 0, len(content), record.begin
                    yield from self.iter_messages(*inner)
                elif record.kind == "message":
                    yield self._parse_message(stream, record, -1 if chunk is None else chunk)
                elif record.kind in ("schema", "channel"):
                    self._parse_declaration(stream, record)
            except (struct.error, UnicodeDecodeError, KeyError) as error:
                raise FormatError(self.file, f"record at {record.start}", error, "a record of a bag") from None

    def _iter_records(self, stream: BinaryIO, at: int, end: int) -> Iterator[_Record]:
        """Whole records between two offsets: code and length of MCAP, header and length of ROS 1, then data."""
        while at + (9 if self.is_mcap else 8) <= end:
            stream.seek(at)
            header: dict[str, bytes] = {}
            if self.is_mcap:
                code, length = struct.unpack("<BQ", stream.read(9))
                start = at + 9
            else:
                count = int.from_bytes(stream.read(4), "little")
                start = at + 8 + count
                if start > end:
                    return
                if count > _MAX_HEADER_BYTES:
                    problem = f"a header of {count} bytes"
                    raise FormatError(self.file, f"record at {at}", problem, f"at most {_MAX_HEADER_BYTES}")
                header = self._parse_fields(stream.read(count))
                code, length = (header.get("op") or b"\0")[0], int.from_bytes(stream.read(4), "little")
            if start + length > end:
                return
            yield _Record((_MCAP_KINDS if self.is_mcap else _ROS_1_KINDS).get(code, ""), at, start, length, header)
            at = start + length

    def _parse_chunk(self, stream: BinaryIO, record: _Record) -> tuple[str, int, int, int]:
        """(compression, size when unpacked, offset of the content, its stored length)."""
        if not self.is_mcap:
            compression = record.header["compression"].decode("ascii", "replace").replace("none", "")
            return compression, struct.unpack("<I", record.header["size"])[0], record.start, record.length
        stream.seek(record.start)
        *_, size, _, count = struct.unpack("<QQQII", stream.read(32))  # first and last time, size, checksum
        compression = stream.read(min(count, 16)).decode("ascii", "replace")
        (length,) = struct.unpack("<Q", stream.read(8))
        if stream.tell() + length > record.start + record.length:
            raise FormatError(self.file, "chunk", f"{length} bytes in a record of {record.length}", "a whole chunk")
        return compression, size, stream.tell(), length

    def _parse_message(self, stream: BinaryIO, record: _Record, chunk: int) -> IndexedMessage:
        stream.seek(record.start)
        if self.is_mcap:
            number, _, time_ns, _ = _MESSAGE_HEADER.unpack(stream.read(_MESSAGE_HEADER.size))
        else:
            (number,) = struct.unpack("<I", record.header["conn"])
            seconds, nanoseconds = struct.unpack("<II", record.header["time"])
            time_ns = seconds * 10**9 + nanoseconds
        if number not in self.topics:
            raise FormatError(self.file, "channel", number, f"one of {len(self.topics)} declared channels")
        start = stream.tell()
        place = MessagePlace(self.file, chunk, start, record.start + record.length - start)
        return IndexedMessage(self.topics[number], time_ns, place, stream.read(min(place.length, HEAD_BYTES)))

    def _parse_declaration(self, stream: BinaryIO, record: _Record) -> None:
        stream.seek(record.start)
        content = io.BytesIO(stream.read(min(record.length, _MAX_HEADER_BYTES)))
        if not self.is_mcap:
            (number,) = struct.unpack("<I", record.header["conn"])
            kind = self._parse_fields(content.getvalue())["type"].decode("utf-8")
            self.topics[number] = _make_topic(record.header["topic"].decode("utf-8"), kind, "ros1")
            return
        (number,) = struct.unpack("<H", content.read(2))
        if record.kind == "schema":
            self.schemas[number] = _read_text(content)
            return
        (schema,) = struct.unpack("<H", content.read(2))
        name, coding = _read_text(content), _read_text(content)
        self.topics[number] = _make_topic(name, self.schemas.get(schema, ""), coding)

    def _parse_fields(self, data: bytes) -> dict[str, bytes]:
        """Fields ``name=value`` of ROS 1, each after its length."""
        fields: dict[str, bytes] = {}
        at = 0
        while at + 4 <= len(data):
            count = int.from_bytes(data[at : at + 4], "little")
            name, sign, value = data[at + 4 : at + 4 + count].partition(b"=")
            if not sign:
                raise FormatError(self.file, "record", repr(name[:20]), "a field name=value")
            fields[name.decode("utf-8", "replace")] = value
            at += 4 + count
        return fields


def _read_text(content: BinaryIO) -> str:
    (count,) = struct.unpack("<I", content.read(4))
    return content.read(min(count, _MAX_HEADER_BYTES)).decode("utf-8")


def _make_topic(name: str, type_name: str, coding: str) -> Topic:
    """A topic whose type is written alike for ROS 1 and 2."""
    return Topic(name, type_name.replace("/msg/", "/"), coding)


@lru_cache(maxsize=2)  # an image and a depth map often share a chunk
def _read_chunk(file: Path, version: tuple[int, ...], begin: int) -> bytes:
    """Unpacked content of the chunk whose record begins at an offset of the file of that version."""
    with open_regular(file) as stream:
        records = _Records(file, is_mcap=read_signature(file) == _MCAP)
        record = next(records._iter_records(stream, begin, stream.seek(0, 2)), None)
        if record is None:
            raise FormatError(file, "chunk", "nothing", f"a chunk at {begin}")
        compression, size, start, length = records._parse_chunk(stream, record)
        stream.seek(start)
        return decompress_chunk(stream.read(min(length, MAX_FILE_BYTES)), compression, size, file)


def decompress_chunk(data: bytes, compression: str, size: int, file: Path) -> bytes:
    """Content of a chunk of ``size`` bytes; more is never unpacked.

    Raises:
        FormatError: an unknown compression, damaged data, or another size.
    """
    if not 0 <= size <= MAX_FILE_BYTES:
        raise FormatError(file, "chunk size", f"{size} bytes", f"at most {MAX_FILE_BYTES}")
    check_memory(file, "chunk", size, f"{size} bytes", requested=len(data))
    if compression not in _DECOMPRESSORS:
        raise FormatError(file, "compression", compression, f"none, {', '.join(_DECOMPRESSORS)}")
    decompressor = _DECOMPRESSORS[compression]()
    try:
        content: bytes = decompressor.decompress(data, size + 1)
    except Exception as error:  # libraries raise errors of their own
        raise FormatError(file, "chunk", error or type(error).__name__, f"{compression} data") from None
    if len(content) != size:
        raise FormatError(file, "chunk", f"{len(content)} bytes", f"{size} bytes of {compression} data")
    return content


def _open_zstd() -> Any:
    zstd = import_optional("compression.zstd", "backports.zstd")
    # Windows of up to 128 MiB: the format recommends 8, writers use more.
    return zstd.ZstdDecompressor(options={zstd.DecompressionParameter.window_log_max: 27})


_DECOMPRESSORS: Final[dict[str, Callable[[], Any]]] = {
    "zstd": _open_zstd,
    "lz4": lambda: import_optional("lz4.frame").LZ4FrameDecompressor(),
    "bz2": bz2.BZ2Decompressor,
}


# ------------------------------------------------------------------------------------------------------------ SQLite


@contextmanager
def _open_database(file: Path) -> Iterator[sqlite3.Connection]:
    if read_signature(file) != _SQLITE:
        raise FormatError(file, "content", "no signature", "an SQLite database")
    address = f"file:{quote(str(file.resolve()))}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(address, uri=True)) as database:
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_FILE_BYTES)
            database.execute("PRAGMA trusted_schema = OFF")
            database.execute("PRAGMA mmap_size = 0")
            # Opening a capture may take 20 s.
            end = time.monotonic() + 15.0
            database.set_progress_handler(lambda: int(time.monotonic() > end), 100_000)  # steps between looks
            for table, expected in _COLUMNS.items():
                row = database.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)).fetchone()
                kind = "nothing" if row is None else str(row[0])
                if row is None or kind != "table" or not str(row[1]).upper().startswith("CREATE TABLE"):
                    raise FormatError(file, table, kind, "a plain table, as in a ROS 2 bag")
                columns = {each[1]: each[6] for each in database.execute(f"PRAGMA table_xinfo({table})")}
                if expected - {name for name, hidden in columns.items() if not hidden}:
                    names = ", ".join(map(str, columns))
                    raise FormatError(file, f"{table} columns", names, ", ".join(sorted(expected)))
            yield database
    except (sqlite3.Error, OverflowError, UnicodeDecodeError, MemoryError) as error:
        raise FormatError(file, "database", error or type(error).__name__, "a whole SQLite database") from None
