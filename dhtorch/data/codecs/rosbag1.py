"""Codec of ROS 1 bags (version 2.0): an index of the messages, and their bytes.

Records are read in order; a bag that was not closed is read up to its last whole record.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from dhtorch.data.codecs.bag_messages import (
    HEAD_BYTES,
    IndexedMessage,
    MessagePlace,
    Topic,
    cached_chunk,
    decompress_chunk,
    make_topic,
)
from dhtorch.data.io.decode import FormatError
from dhtorch.runtime.safe_open import MAX_FILE_BYTES, open_regular

#: First bytes of a bag.
BAG_SIGNATURE: Final = b"#ROSBAG V2.0\n"

_MESSAGE, _CHUNK, _CONNECTION = 0x02, 0x05, 0x07
_MAX_HEADER_BYTES: Final = 1 << 20  # of a record's header or a connection's; definitions take some kilobytes


class _Record(NamedTuple):
    header: dict[str, bytes]
    start: int  # offset of its data
    length: int

    @property
    def code(self) -> int:
        value = self.header.get("op", b"")
        return value[0] if value else -1


def iter_bag_messages(file: Path) -> Iterator[IndexedMessage]:
    """The messages of a bag in its order; nothing beyond a truncated record.

    Raises:
        FormatError: no bag of version 2.0, or damaged records.
        ImportError: the decoder of its chunks is not installed.
    """
    with open_regular(file) as stream:
        head = stream.read(len(BAG_SIGNATURE))
        if head != BAG_SIGNATURE:
            raise FormatError(file, "content", repr(head), "a ROS 1 bag of version 2.0")
        topics: dict[int, Topic] = {}
        for record in _iter_records(stream, len(BAG_SIGNATURE), stream.seek(0, 2), file):
            try:
                if record.code == _CHUNK:
                    yield from _iter_chunk(stream, record, topics, file)
                else:
                    yield from _parse_record(stream, record, topics, file, chunk=-1)
            except (struct.error, UnicodeDecodeError, KeyError) as error:
                raise FormatError(file, f"record at {record.start}", error, "a record of a bag") from None


def read_bag_chunk(file: Path, offset: int) -> bytes:
    """Decompressed records of the chunk whose record starts at ``offset``."""

    def load() -> bytes:
        with open_regular(file) as stream:
            record = next(_iter_records(stream, offset, stream.seek(0, 2), file), None)
            if record is None:
                raise FormatError(file, "chunk", "nothing", f"a chunk at {offset}")
            return _decompress(stream, record, file)

    return cached_chunk(file, offset, load)


def _iter_records(stream: BinaryIO, start: int, end: int, file: Path) -> Iterator[_Record]:
    """Whole records between two offsets."""
    while start + 8 <= end:
        stream.seek(start)
        (count,) = struct.unpack("<I", stream.read(4))
        if start + 8 + count > end:
            return
        if count > _MAX_HEADER_BYTES:
            raise FormatError(file, f"record at {start}", f"a header of {count} bytes", f"at most {_MAX_HEADER_BYTES}")
        header = _parse_fields(stream.read(count), file)
        (length,) = struct.unpack("<I", stream.read(4))
        if start + 8 + count + length > end:
            return
        yield _Record(header, start + 8 + count, length)
        start += 8 + count + length


def _parse_fields(data: bytes, file: Path) -> dict[str, bytes]:
    """Fields ``name=value``, each after its length."""
    fields: dict[str, bytes] = {}
    at = 0
    while at + 4 <= len(data):
        (count,) = struct.unpack_from("<I", data, at)
        name, sign, value = data[at + 4 : at + 4 + count].partition(b"=")
        if not sign:
            raise FormatError(file, "record", repr(name[:20]), "a field name=value")
        fields[name.decode("utf-8", "replace")] = value
        at += 4 + count
    return fields


def _decompress(stream: BinaryIO, record: _Record, file: Path) -> bytes:
    compression = record.header["compression"].decode("ascii", "replace")
    (size,) = struct.unpack("<I", record.header["size"])
    stream.seek(record.start)
    return decompress_chunk(stream.read(min(record.length, MAX_FILE_BYTES)), compression, size, file)


def _iter_chunk(stream: BinaryIO, record: _Record, topics: dict[int, Topic], file: Path) -> Iterator[IndexedMessage]:
    if record.header["compression"] == b"none":
        for inner in _iter_records(stream, record.start, record.start + record.length, file):
            yield from _parse_record(stream, inner, topics, file, chunk=-1)
        return
    offset = record.start - 8 - _header_length(record.header)
    content = cached_chunk(file, offset, lambda: _decompress(stream, record, file))
    inside = io.BytesIO(content)
    for inner in _iter_records(inside, 0, len(content), file):
        yield from _parse_record(inside, inner, topics, file, chunk=offset)


def _header_length(header: dict[str, bytes]) -> int:
    return sum(5 + len(name.encode()) + len(value) for name, value in header.items())


def _parse_record(
    stream: BinaryIO, record: _Record, topics: dict[int, Topic], file: Path, *, chunk: int
) -> Iterator[IndexedMessage]:
    if record.code == _MESSAGE:
        (connection,) = struct.unpack("<I", record.header["conn"])
        seconds, nanoseconds = struct.unpack("<II", record.header["time"])
        if connection not in topics:
            raise FormatError(file, "connection", connection, f"one of {len(topics)} declared connections")
        place = MessagePlace(file, chunk, record.start, record.length)
        stream.seek(record.start)
        head = stream.read(min(record.length, HEAD_BYTES))
        yield IndexedMessage(topics[connection], seconds * 10**9 + nanoseconds, place, head)
    elif record.code == _CONNECTION:
        (connection,) = struct.unpack("<I", record.header["conn"])
        stream.seek(record.start)
        fields = _parse_fields(stream.read(min(record.length, _MAX_HEADER_BYTES)), file)
        name, type_name = record.header["topic"].decode("utf-8"), fields["type"].decode("utf-8")
        topics[connection] = make_topic(name, type_name, "ros1")
