"""Codec of videos by PyAV: frames of a file by number or time, at constant memory; tracks and attachments of Matroska.

Frame ``i`` is the ``i``-th in *presentation order*, whatever the order in the file. It is located by a table of
presentation times, made by reading the packets once without decoding; a frame that cannot be decoded is therefore an
error and does not shift its successors. Sequential reading decodes every frame once, random access starts at the
previous key frame.

A few decoders per process stay open, cached by file name: callers hold only paths and are picklable, and a forked
worker opens its own decoders.

The samples that an mp4 declares are counted before FFmpeg allocates memory for them: some tables are short for any
number of samples, all of one size, runs of one duration, fragments of defaults.
"""

import os
import struct
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np

from dhtorch.data.io.decode import FormatError, import_optional
from dhtorch.runtime.safe_open import MAX_TEXT_BYTES, check_memory, open_regular, read_version

_MAX_VIDEO_PIXELS = 36_000_000  # pixels, 8K; a decoder holds up to 17 frames
_MAX_FRAMES = 10_000_000

#: Types of the first box of an mp4.
_MP4_FIRST_BOXES: Final = (b"ftyp", b"styp", b"moov", b"moof", b"mdat", b"wide", b"free", b"skip", b"uuid", b"pnot")
_CONTAINER_BOXES: Final = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"moof", b"traf", b"edts", b"mvex")
#: Box -> offset in it of a number of samples.
_COUNT_AT: Final = {b"stsz": 8, b"stz2": 8, b"trun": 4}
_RUN_LENGTH_BOXES: Final = (b"stts", b"ctts")  # tables of (count, value)
_MAX_DEPTH, _MAX_BOXES = 12, 200_000  # of an mp4
#: (a, b, c, d) of a track's matrix, x' = a x + c y and y' = b x + d y in an image with y down -> symmetry of
#: :mod:`dhtorch.data.orientation`.
SYMMETRY_OF_MATRIX: Final = {
    (1, 0, 0, 1): 0,
    (0, 1, -1, 0): 1,
    (-1, 0, 0, -1): 2,
    (0, -1, 1, 0): 3,
    (-1, 0, 0, 1): 4,
    (0, -1, -1, 0): 5,
    (1, 0, 0, -1): 6,
    (0, 1, 1, 0): 7,
}


class _VideoTrack(NamedTuple):
    """A video track as its container describes it."""

    name: str
    codec: str  # FFmpeg's name
    fourcc: str  # code of the codec, such as b16g; empty where the container has none
    hw: tuple[int, int]


def list_video_tracks(file: Path) -> list[_VideoTrack]:
    """The video tracks of a file in the order of its header; decodes no frame.

    Raises:
        FormatError: no video file, or a damaged header.
    """
    with _opened(file) as (container, errors):
        try:
            contexts = [(stream.metadata.get("title", ""), stream.codec_context) for stream in container.streams.video]
            return [
                _VideoTrack(name, context.name, context.codec_tag.strip("\0"), (context.height, context.width))
                for name, context in contexts
                if context is not None
            ]
        except errors as error:
            raise FormatError(file, "tracks", error, "a video file") from None


def read_attachment(file: Path, name: str) -> bytes | None:
    """Content of the attached file called ``name``; None where there is none.

    Raises:
        FormatError: no video file, or more than ``MAX_TEXT_BYTES``.
        ImportError: PyAV before 16 does not give the content.
    """
    with _opened(file) as (container, _):
        for stream in container.streams:
            if stream.type == "attachment" and stream.metadata.get("filename") == name:
                if not hasattr(stream, "data"):
                    raise ImportError(f"{file}: the attachment {name} needs PyAV 16: pip install 'av>=16'")
                content = bytes(stream.data or b"")
                if len(content) > MAX_TEXT_BYTES:
                    raise FormatError(file, name, f"{len(content)} bytes", f"at most {MAX_TEXT_BYTES}")
                return content
    return None


class _VideoHeader(NamedTuple):
    """Size, number of frames, rate and codec of a video."""

    hw: tuple[int, int]  # as stored: a rotation tag is not applied
    n: int  # frames in the index; a truncated file has fewer
    rate_hz: float | None
    codec: str
    pixels: str  # format of the stored pixels, such as yuv420p
    display: int = 0  # symmetry of the display matrix (an mp4's), see dhtorch.data.orientation; it is not applied


def read_video_header(file: Path, *, all_frames: bool = False, track: int = 0) -> _VideoHeader:
    """Size, number of frames and rate of a video; decodes no frame.

    Args:
        file: the video.
        all_frames: count also frames that an edit list hides, such as one stamped before time 0.
        track: number of the video track, where a file has several.

    Raises:
        FormatError: missing file, unknown format, no video stream, or a size beyond the limit.
        ImportError: no decoder is installed.
    """
    return _get_decoder(file, all_frames, track).header


def read_video_times(file: Path, *, all_frames: bool = False, track: int = 0) -> np.ndarray:
    """Presentation times (n,) in s of all frames, increasing. Reads all packets once, decodes none.

    Raises:
        FormatError: as :func:`read_video_header`, or packets without time stamps.
    """
    decoder = _get_decoder(file, all_frames, track)
    return decoder.table() * float(decoder.stream.time_base)


def read_video_frame(
    file: Path,
    i: int,
    hw: tuple[int, int] | None = None,
    *,
    pixels: str = "rgb24",
    nearest: bool = False,
    all_frames: bool = False,
    track: int = 0,
) -> np.ndarray:
    """Frame ``i`` as stored (a rotation tag is not applied), in the array layout of the pixel format.

    Args:
        file: the video.
        i: index in presentation order, from 0.
        hw: required size.
        pixels: ``rgb24`` gives (h, w, 3) uint8, ``gray`` (h, w) uint8, ``gray16le`` and ``gray12le`` (h, w) uint16.
            ``luma`` gives the first plane as stored, (h, w) uint8 or uint16, without range conversion: coded numbers.
        nearest: repeat colour samples stored at lower resolution instead of interpolating them.
        all_frames: count also frames that an edit list hides.
        track: number of the video track, where a file has several.

    Raises:
        FormatError: as :func:`read_video_header`, another size than ``hw``, or a missing or undecodable frame.
    """
    decoder = _get_decoder(file, all_frames, track)
    frame = decoder.frame(i)
    expected_hw = tuple(hw) if hw is not None else decoder.header.hw
    if (frame.height, frame.width) != expected_hw:
        raise FormatError(
            file, f"frame {i} size", f"{frame.width}x{frame.height}", f"{expected_hw[1]}x{expected_hw[0]}"
        )
    if pixels == "luma":
        plane, kind = frame.planes[0], np.dtype("<u2" if frame.format.components[0].bits > 8 else "u1")
        rows = np.frombuffer(plane, kind).reshape(-1, plane.line_size // kind.itemsize)  # rows may be padded
        return rows[: frame.height, : frame.width].copy()
    try:
        interpolation = "POINT" if nearest else "BICUBIC"
        return np.asarray(frame.to_ndarray(format=pixels, interpolation=interpolation, **decoder.one_thread))
    except decoder.errors as error:
        raise FormatError(file, f"frame {i}", error, f"pixels that convert to {pixels}") from None


def close_videos() -> None:
    """Close the decoders of this process."""
    for decoder in _open_decoders.values():
        decoder.container.close()
    _open_decoders.clear()


def _open_container(file: Path, *, all_frames: bool, track: int) -> tuple[Any, int, tuple[type[Exception], ...]]:
    """(container, display symmetry, FFmpeg's errors) of a file whose first bytes are those of a video."""
    av = import_optional("av")
    errors = (av.FFmpegError, ValueError, MemoryError, OverflowError, EOFError)
    display = 0
    with open_regular(file) as stream:
        head = stream.read(16)
        if head[4:8] in _MP4_FIRST_BOXES:
            formats, display = "mov,mp4,m4a,3gp,3g2,mj2", _inspect_mp4(stream, file, track)
        elif head.startswith(b"\x1a\x45\xdf\xa3"):  # identifier of an EBML header
            formats = "matroska,webm"
        elif head.startswith(b"RIFF") and head[8:12] == b"AVI ":
            formats = "avi"
        else:
            raise FormatError(file, "content", repr(head[:12]), "a video file: mp4, mov, mkv, webm or avi")
    # No playlists, no network: the format is fixed and no other file may be opened.
    limits = {"max_pixels": str(_MAX_VIDEO_PIXELS), "protocol_whitelist": "file", "format_whitelist": formats}
    edits = {"advanced_editlist": "0"} if all_frames else {}
    try:
        container = av.open(str(file), format=formats.partition(",")[0], options=limits, container_options=edits)
    except errors as error:
        raise FormatError(file, "content", error, "a video file") from None
    return container, display, errors


@contextmanager
def _opened(file: Path) -> Iterator[tuple[Any, tuple[type[Exception], ...]]]:
    container, _, errors = _open_container(file, all_frames=False, track=0)
    with container:
        yield container, errors


def _inspect_mp4(stream: BinaryIO, file: Path, track: int) -> int:
    """Symmetry of the display matrix of a video track, 0 where it is no quarter turn, after a check of all samples.

    Raises:
        FormatError: more samples than bytes, or than the memory limit allows, or too many boxes.
    """
    total, n_samples, symmetry = stream.seek(0, 2), 0, 0
    symmetries: list[int] = []  # of the video tracks
    for number, (kind, start, end) in enumerate(_iter_boxes(stream, 0, total, 0)):
        if number > _MAX_BOXES:
            raise FormatError(file, "boxes", f"more than {_MAX_BOXES}", "a file with fewer")
        stream.seek(start)
        declared = 0
        if kind == b"trak":
            symmetry = 0
        elif kind == b"tkhd":
            stream.seek(start + (52 if stream.read(1) == b"\1" else 40))  # by its version
            a, b, _, c, d = (entry / 65536 for entry in struct.unpack(">5i", stream.read(20).ljust(20, b"\0")))
            symmetry = SYMMETRY_OF_MATRIX.get((a, b, c, d), 0)
        elif kind == b"hdlr":
            symmetries += [symmetry] if stream.read(12)[8:] == b"vide" else []
        elif kind in _COUNT_AT:
            declared = int.from_bytes(stream.read(_COUNT_AT[kind] + 4)[_COUNT_AT[kind] :], "big")
            n_samples += declared
        elif kind in _RUN_LENGTH_BOXES:
            if end - start > MAX_TEXT_BYTES:
                raise FormatError(file, kind.decode(), f"{end - start} bytes", f"at most {MAX_TEXT_BYTES}")
            table = stream.read(end - start)[8:]
            declared = sum(n for n, _ in struct.iter_unpack(">II", table[: len(table) // 8 * 8]))
        if declared > total:
            raise FormatError(file, kind.decode(), f"{declared} samples in {total} bytes", "at most one per byte")
        most = max(n_samples, declared)
        # Memory of a decoder and of our table per sample.
        check_memory(file, "samples", 200 * most, f"{most} samples")
    return symmetries[track] if track < len(symmetries) else 0


def _iter_boxes(stream: BinaryIO, at: int, stop: int, depth: int) -> Iterator[tuple[bytes, int, int]]:
    """(type, start and end of the content) of the boxes of an mp4, depth first; a damaged box ends its container."""
    while at + 8 <= stop:
        stream.seek(at)
        size, kind = struct.unpack(">I4s", stream.read(8))
        start = at + 8
        if size == 1:
            size, start = int.from_bytes(stream.read(8).ljust(8, b"\0"), "big"), start + 8
        end = stop if size == 0 else at + size
        if end < start:
            return
        yield kind, start, min(end, stop)
        if kind in _CONTAINER_BOXES and depth < _MAX_DEPTH:
            yield from _iter_boxes(stream, start, min(end, stop), depth + 1)
        at = end


class _Decoder:
    """One open video, its table of frames and its current position."""

    def __init__(self, file: Path, all_frames: bool, track: int) -> None:
        self.file = file
        self.track = track
        self.pts: np.ndarray | None = None
        self.keys = np.empty((0, 2), np.int64)  # presentation and decoding stamp of the key frames
        self.frames: Iterator[Any] = iter(())
        self.next = -1  # number of the next decoded frame; −1 = unknown
        # PyAV before 17 converts with one thread and has no such option.
        self.one_thread = {"threads": 1} if int(import_optional("av").__version__.partition(".")[0]) >= 17 else {}
        self.container, self.display, self.errors = _open_container(file, all_frames=all_frames, track=track)
        try:
            streams = self.container.streams.video
            if len(streams) <= self.track:
                raise FormatError(self.file, "streams", f"{len(streams)} of video", f"at least {self.track + 1}")
            self.stream = streams[self.track]
            context = self.stream.codec_context
            if context is None:
                raise FormatError(self.file, "codec", "an unknown one", "a codec with a decoder")
            context.thread_count = 1  # a data loader has its own workers
            h, w = context.height, context.width
            if not 0 < h * w <= _MAX_VIDEO_PIXELS:
                raise FormatError(self.file, "size", f"{w}x{h}", f"1 to {_MAX_VIDEO_PIXELS} pixels")
            index = getattr(self.stream, "index_entries", ())
            visible = [entry for entry in index if not entry.is_discard]
            n = len(visible) if len(index) >= self.stream.frames > 0 else len(self.table())
            if not 0 < n <= _MAX_FRAMES or self.stream.time_base is None:
                raise FormatError(self.file, "frames", n, f"1 to {_MAX_FRAMES}, with a time base")
            rate = self.stream.average_rate
            pixels = context.pix_fmt or "unknown"
            self.header = _VideoHeader((h, w), n, float(rate) if rate else None, context.name, pixels, self.display)
        except self.errors as error:
            self.container.close()
            raise error if isinstance(error, FormatError) else FormatError(file, "header", error, "a video") from None

    def table(self) -> np.ndarray:
        """(n,) int64 presentation stamps in time-base units, increasing; fills ``keys`` on the way."""
        if self.pts is None:
            try:
                self.container.seek(0, stream=self.stream)
                packets = [
                    (p.pts, p.dts if p.dts is not None else p.pts, p.is_keyframe, p.is_discard)
                    for p in self.container.demux(self.stream)
                    if p.size and p.pts is not None
                ]
            except self.errors as error:
                raise FormatError(self.file, "packets", error, "a whole video") from None
            visible = [pts for pts, _, _, hidden in packets if not hidden]
            keys = sorted((pts, dts) for pts, dts, key, _ in packets if key)
            self.pts, self.keys = np.unique(np.array(visible, np.int64)), np.array(keys, np.int64).reshape(-1, 2)
            self.next = -1
        return self.pts

    def frame(self, i: int) -> Any:
        """The decoded frame of number ``i``."""
        pts = self.table()
        if not 0 <= i < len(pts):
            raise FormatError(self.file, f"frame {i}", f"{len(pts)} frames", f"{self.header.n} frames")
        try:
            # Frames up to which decoding on is cheaper than seeking a key frame.
            if not 0 <= self.next <= i <= self.next + 60:
                # The last key frame presented at or before it, not one decoded earlier but presented later.
                before = int(np.searchsorted(self.keys[:, 0], pts[i], "right")) - 1
                start = int(self.keys[before, 1]) if before >= 0 else int(pts[0])
                self.container.seek(start, stream=self.stream, backward=True)
                self.frames = self._decoded()
            for frame in self.frames:
                if frame.pts is None or frame.pts < pts[i]:
                    continue
                self.next = i + 1
                if frame.pts == pts[i] and not frame.is_corrupt:
                    return frame
                break
        except self.errors as error:
            self.next = -1
            raise FormatError(self.file, f"frame {i}", error, "a decodable frame") from None
        self.next = -1
        raise FormatError(self.file, f"frame {i}", "nothing", "a decodable frame")

    def _decoded(self) -> Iterator[Any]:
        """Decoded frames from the current position on; undecodable packets are skipped."""
        failed = 0
        for packet in self.container.demux(self.stream):
            try:
                frames = packet.decode()
            except self.errors:
                failed += 1
                # Consecutive undecodable packets after which decoding stops.
                if failed > 100:
                    raise
                continue
            failed = 0
            yield from frames


_open_decoders: OrderedDict[tuple[Path, bool, int, tuple[int, ...]], _Decoder] = OrderedDict()
_inherited_decoders: list[_Decoder] = []


def _get_decoder(file: Path, all_frames: bool, track: int) -> _Decoder:
    """A cached decoder of this process, opened if needed."""
    key = (file, all_frames, track, read_version(file))
    if key not in _open_decoders:
        # Decoders in a process.
        while len(_open_decoders) >= 8:
            _open_decoders.popitem(last=False)[1].container.close()
        _open_decoders[key] = _Decoder(file, all_frames, track)
    _open_decoders.move_to_end(key)
    return _open_decoders[key]


def _abandon_inherited_decoders() -> None:
    """Drop the parent's decoders after a fork: file positions are shared and the decoders' threads do not exist."""
    _inherited_decoders.extend(_open_decoders.values())  # kept alive, because freeing would wait for those threads
    _open_decoders.clear()


os.register_at_fork(after_in_child=_abandon_inherited_decoders)
