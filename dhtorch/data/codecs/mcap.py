"""Codec of MCAP files: an index of the messages of a robot's recording, and their bytes.

The records are read in order, so that a file that was not closed is read up to its last whole record; the index at its
end is not needed. Chunks are decompressed one at a time.
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

#: First and last bytes of a file.
MCAP_SIGNATURE: Final = b"\x89MCAP0\r\n"

_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
_MESSAGE_HEADER: Final = struct.Struct("<HIQQ")  # channel, sequence, times of recording and of publication
_CHUNK_HEADER: Final = struct.Struct("<QQQI")  # first and last time, size, checksum
_MAX_TEXT_BYTES: Final = 1 << 20  # bytes of a schema or channel; schemas hold definitions of some kilobytes


class _Record(NamedTuple):
    code: int
    start: int  # offset of its content
    length: int


class _Names(NamedTuple):
    """Declarations met so far."""

    schemas: dict[int, str]
    topics: dict[int, Topic]


def iter_mcap_messages(file: Path) -> Iterator[IndexedMessage]:
    """The messages of a file in its order; nothing beyond a truncated record.

    Raises:
        FormatError: no MCAP file, or damaged records.
        ImportError: the decoder of its chunks is not installed.
    """
    with open_regular(file) as stream:
        if stream.read(len(MCAP_SIGNATURE)) != MCAP_SIGNATURE:
            raise FormatError(file, "content", "no MCAP signature", "an MCAP file")
        names = _Names({}, {})
        for record in _iter_records(stream, len(MCAP_SIGNATURE), stream.seek(0, 2)):
            if record.code in (_FOOTER, _DATA_END):
                return
            try:
                if record.code == _CHUNK:
                    yield from _iter_chunk(stream, record, names, file)
                else:
                    yield from _parse_record(stream, record, names, file, chunk=-1)
            except (struct.error, UnicodeDecodeError) as error:
                raise FormatError(file, f"record at {record.start}", error, "an MCAP record") from None


def read_mcap_chunk(file: Path, offset: int) -> bytes:
    """Decompressed records of the chunk whose content starts at ``offset``."""

    def load() -> bytes:
        with open_regular(file) as stream:
            size, compression, start, length = _parse_chunk_header(stream, offset)
            stream.seek(start)
            return decompress_chunk(stream.read(min(length, MAX_FILE_BYTES)), compression, size, file)

    return cached_chunk(file, offset, load)


def _iter_records(stream: BinaryIO, start: int, end: int) -> Iterator[_Record]:
    """Whole records between two offsets."""
    while start + 9 <= end:
        stream.seek(start)
        code, length = struct.unpack("<BQ", stream.read(9))
        start += 9
        if start + length > end:
            return
        yield _Record(code, start, length)
        start += length


def _iter_chunk(stream: BinaryIO, record: _Record, names: _Names, file: Path) -> Iterator[IndexedMessage]:
    _, compression, start, length = _parse_chunk_header(stream, record.start)
    if start + length > record.start + record.length:
        raise FormatError(file, "chunk", f"{length} bytes in a record of {record.length}", "a whole chunk")
    if not compression:
        for inner in _iter_records(stream, start, start + length):
            yield from _parse_record(stream, inner, names, file, chunk=-1)
        return
    content = read_mcap_chunk(file, record.start)
    inside = io.BytesIO(content)
    for inner in _iter_records(inside, 0, len(content)):
        yield from _parse_record(inside, inner, names, file, chunk=record.start)


def _parse_chunk_header(stream: BinaryIO, offset: int) -> tuple[int, str, int, int]:
    """(size when decompressed, compression, offset of the records, their stored length)."""
    stream.seek(offset)
    *_, size, _ = _CHUNK_HEADER.unpack(stream.read(_CHUNK_HEADER.size))
    (count,) = struct.unpack("<I", stream.read(4))
    compression = stream.read(min(count, 16)).decode("ascii", "replace")
    (length,) = struct.unpack("<Q", stream.read(8))
    return size, compression, stream.tell(), length


def _parse_record(
    stream: BinaryIO, record: _Record, names: _Names, file: Path, *, chunk: int
) -> Iterator[IndexedMessage]:
    stream.seek(record.start)
    if record.code == _MESSAGE:
        channel, _, time, _ = _MESSAGE_HEADER.unpack(stream.read(_MESSAGE_HEADER.size))
        if channel not in names.topics:
            raise FormatError(file, "channel", channel, f"one of {len(names.topics)} declared channels")
        length = record.length - _MESSAGE_HEADER.size
        place = MessagePlace(file, chunk, record.start + _MESSAGE_HEADER.size, length)
        yield IndexedMessage(names.topics[channel], time, place, stream.read(min(length, HEAD_BYTES)))
    elif record.code in (_SCHEMA, _CHANNEL):
        content = io.BytesIO(stream.read(min(record.length, _MAX_TEXT_BYTES)))
        (number,) = struct.unpack("<H", content.read(2))
        if record.code == _SCHEMA:
            names.schemas[number] = _read_text(content)
            return
        (schema,) = struct.unpack("<H", content.read(2))
        name, coding = _read_text(content), _read_text(content)
        names.topics[number] = make_topic(name, names.schemas.get(schema, ""), coding)


def _read_text(content: BinaryIO) -> str:
    (count,) = struct.unpack("<I", content.read(4))
    return content.read(min(count, _MAX_TEXT_BYTES)).decode("utf-8")
