"""References to the messages of a robot's recording, and bounded decompression of the chunks that hold them."""

from __future__ import annotations

import bz2
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

from dhtorch.data.io.decode import FormatError, import_optional
from dhtorch.runtime.safe_open import MAX_FILE_BYTES, check_memory, read_version

#: Bytes of a message that indexing reads: header, size and encoding of a picture.
HEAD_BYTES: Final = 1024
#: Largest window of a zstd stream in bytes: the format recommends 8 MiB, writers use up to 128.
_MAX_ZSTD_WINDOW: Final = 1 << 27
_MESSAGE_BYTES: Final = 300  # memory of a reference and its stamp
_CHUNKS_KEPT: Final = 2  # decompressed chunks kept in a process: a picture and a depth map often share one


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


def make_topic(name: str, type_name: str, coding: str) -> Topic:
    """A topic whose type is written alike for ROS 1 and 2."""
    return Topic(name, type_name.replace("/msg/", "/"), coding)


def check_message_count(file: Path, count: int) -> None:
    """Raise FormatError for more messages than the memory limit allows."""
    check_memory(file, "messages", _MESSAGE_BYTES * count, f"{count} messages")


def decompress_chunk(data: bytes, compression: str, size: int, file: Path) -> bytes:
    """Content of a chunk of ``size`` bytes; more is never unpacked.

    Raises:
        FormatError: an unknown compression, damaged data, or another size.
        ImportError: the decoder is not installed.
    """
    if not 0 <= size <= MAX_FILE_BYTES:
        raise FormatError(file, "chunk size", f"{size} bytes", f"at most {MAX_FILE_BYTES}")
    check_memory(file, "chunk", size, f"{size} bytes", requested=len(data))
    if compression not in _DECOMPRESSORS:
        raise FormatError(file, "compression", compression, f"none, {', '.join(_DECOMPRESSORS)}")
    decompress = _DECOMPRESSORS[compression]
    try:
        content = decompress(data, size)
    except (FormatError, ImportError):
        raise
    except Exception as error:  # libraries raise errors of their own
        raise FormatError(file, "chunk", error or type(error).__name__, f"{compression} data") from None
    if len(content) != size:
        raise FormatError(file, "chunk", f"{len(content)} bytes", f"{size} bytes of {compression} data")
    return content


def cached_chunk(file: Path, offset: int, load: Callable[[], bytes]) -> bytes:
    """Content of the chunk at ``offset``, kept for the messages beside it."""
    key = (file, offset, read_version(file))
    if key not in _chunks:
        while len(_chunks) >= _CHUNKS_KEPT:
            _chunks.popitem(last=False)
        _chunks[key] = load()
    _chunks.move_to_end(key)
    return _chunks[key]


_chunks: OrderedDict[tuple[Path, int, tuple[int, ...]], bytes] = OrderedDict()


def _unpack_zstd(data: bytes, size: int) -> bytes:
    decompressor = import_optional("zstandard", extra="robot").ZstdDecompressor(max_window_size=_MAX_ZSTD_WINDOW)
    with decompressor.stream_reader(data) as stream:
        content: bytes = stream.read(size + 1)
        return content


def _unpack_lz4(data: bytes, size: int) -> bytes:
    content: bytes = import_optional("lz4.frame", extra="robot").LZ4FrameDecompressor().decompress(data, size + 1)
    return content


def _unpack_bz2(data: bytes, size: int) -> bytes:
    return bz2.BZ2Decompressor().decompress(data, size + 1)


_DECOMPRESSORS: Final[dict[str, Callable[[bytes, int], bytes]]] = {
    "zstd": _unpack_zstd,
    "lz4": _unpack_lz4,
    "bz2": _unpack_bz2,
}
