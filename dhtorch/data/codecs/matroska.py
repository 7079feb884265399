"""Codec of Matroska (mkv) headers: tracks and attachments, without decoding; needs no video library."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from dhtorch.data.io.decode import FormatError
from dhtorch.runtime.safe_open import MAX_TEXT_BYTES, open_regular

#: First bytes of a Matroska file: the identifier of its EBML header.
MATROSKA_SIGNATURE: Final = b"\x1a\x45\xdf\xa3"

_SEGMENT, _CLUSTER, _TRACKS, _ATTACHMENTS = 0x18538067, 0x1F43B675, 0x1654AE6B, 0x1941A469
_TRACK, _TRACK_TYPE, _TRACK_NAME, _CODEC, _CODEC_PRIVATE = 0xAE, 0x83, 0x536E, 0x86, 0x63A2
_VIDEO, _WIDTH, _HEIGHT, _COLOUR_SPACE = 0xE0, 0xB0, 0xBA, 0x2EB524
_FILE, _FILE_NAME, _FILE_DATA = 0x61A7, 0x466E, 0x465C
_VIDEO_TYPE: Final = 1  # value of a track's type
_MAX_ELEMENTS: Final = 1_000_000  # elements of one level; an hour of clusters of a second are 3600
_MAX_VALUE_BYTES: Final = 4096  # bytes of a name or a number
_FOURCC_AT: Final = slice(16, 20)  # position of the code in a Windows bitmap header


class VideoTrack(NamedTuple):
    """Entry of a video track in the header."""

    name: str
    codec: str  # Matroska's codec, such as V_MJPEG
    fourcc: str  # code of the pixels where the codec is Windows' or none, else empty
    hw: tuple[int, int]


class _Element(NamedTuple):
    id: int
    start: int  # offset of its content
    end: int


def list_video_tracks(file: Path) -> list[VideoTrack]:
    """The video tracks in the order of the header.

    Raises:
        FormatError: no Matroska file, or a damaged header.
    """
    with open_regular(file) as stream:
        return [
            _parse_track(stream, track, file)
            for track in _find_children(stream, file, _TRACKS, _TRACK)
            if _read_number(stream, track, _TRACK_TYPE) == _VIDEO_TYPE
        ]


def read_attachment(file: Path, name: str) -> bytes | None:
    """Content of the attached file called ``name``; None where there is none.

    Raises:
        FormatError: no Matroska file, or more than ``MAX_TEXT_BYTES``.
    """
    with open_regular(file) as stream:
        for attached in _find_children(stream, file, _ATTACHMENTS, _FILE):
            if _read_text(stream, attached, _FILE_NAME) != name:
                continue
            for content in _iter_elements(stream, attached.start, attached.end):
                if content.id == _FILE_DATA:
                    if content.end - content.start > MAX_TEXT_BYTES:
                        size = content.end - content.start
                        raise FormatError(file, name, f"{size} bytes", f"at most {MAX_TEXT_BYTES}")
                    stream.seek(content.start)
                    return stream.read(content.end - content.start)
    return None


def _parse_track(stream: BinaryIO, track: _Element, file: Path) -> VideoTrack:
    video = [e for e in _iter_elements(stream, track.start, track.end) if e.id == _VIDEO]
    if not video:
        raise FormatError(file, "track", "a video track without a size", "width and height")
    codec = _read_text(stream, track, _CODEC)
    private = _read_value(stream, track, _CODEC_PRIVATE) if codec == "V_MS/VFW/FOURCC" else b""
    code = private[_FOURCC_AT] or _read_value(stream, video[0], _COLOUR_SPACE)
    hw = _read_number(stream, video[0], _HEIGHT), _read_number(stream, video[0], _WIDTH)
    return VideoTrack(_read_text(stream, track, _TRACK_NAME), codec, code.decode("ascii", "replace"), hw)


def _find_children(stream: BinaryIO, file: Path, parent: int, child: int) -> Iterator[_Element]:
    """Elements ``child`` of the elements ``parent`` of the first segment."""
    total = stream.seek(0, 2)
    stream.seek(0)
    if stream.read(len(MATROSKA_SIGNATURE)) != MATROSKA_SIGNATURE:
        raise FormatError(file, "content", "no EBML header", "a Matroska file")
    for segment in _iter_elements(stream, 0, total):
        if segment.id == _SEGMENT:
            for element in _iter_elements(stream, segment.start, segment.end):
                if element.id == parent:
                    yield from (e for e in _iter_elements(stream, element.start, element.end) if e.id == child)
            return


def _iter_elements(stream: BinaryIO, start: int, end: int) -> Iterator[_Element]:
    """Elements between two offsets; a damaged one, or a cluster of unknown length, ends them."""
    for _ in range(_MAX_ELEMENTS):
        if start >= end:
            return
        stream.seek(start)
        head = stream.read(12)
        id_length = _vint_length(head, 4)
        size_length = _vint_length(head[id_length:], 8)
        if not id_length or not size_length:
            return
        identifier = int.from_bytes(head[:id_length], "big")
        size = int.from_bytes(head[id_length : id_length + size_length], "big") - (1 << 7 * size_length)
        is_unknown = size == (1 << 7 * size_length) - 1
        if is_unknown and identifier == _CLUSTER:
            return
        content = start + id_length + size_length
        stop = end if is_unknown else content + size
        yield _Element(identifier, content, min(stop, end))
        start = stop


def _vint_length(head: bytes, limit: int) -> int:
    """Bytes of a number of variable length, from the leading zeros of its first byte; 0 where there is none."""
    length = 9 - head[0].bit_length() if head else 0
    return length if 0 < length <= min(limit, len(head)) else 0


def _read_value(stream: BinaryIO, parent: _Element, identifier: int) -> bytes:
    """Content of a child; empty where there is none or it is too long."""
    for element in _iter_elements(stream, parent.start, parent.end):
        if element.id == identifier and element.end - element.start <= _MAX_VALUE_BYTES:
            stream.seek(element.start)
            return stream.read(element.end - element.start)
    return b""


def _read_number(stream: BinaryIO, parent: _Element, identifier: int) -> int:
    return int.from_bytes(_read_value(stream, parent, identifier)[:8], "big")


def _read_text(stream: BinaryIO, parent: _Element, identifier: int) -> str:
    return _read_value(stream, parent, identifier).decode("utf-8", "replace").rstrip("\0")
