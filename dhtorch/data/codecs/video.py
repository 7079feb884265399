"""Codec of videos: frames of a file by number or time, at constant memory.

Frame ``i`` is the ``i``-th in *presentation order*, whatever the order in the file. It is located by a table of
presentation times, made by reading the packets once without decoding; a frame that cannot be decoded is therefore an
error and does not shift its successors. Sequential reading decodes every frame once, random access starts at the
previous key frame.

A few decoders per process stay open, cached by file name: callers hold only paths and are picklable, and a forked
worker opens its own decoders.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dhtorch.data.codecs.mp4 import MP4_FIRST_BOXES, check_sample_count, read_display_symmetry
from dhtorch.data.io.decode import FormatError, import_optional
from dhtorch.runtime.safe_open import open_regular, read_version

_MAX_VIDEO_PIXELS = 36_000_000  # pixels, 8K; a decoder holds up to 17 frames
_MAX_FRAMES = 10_000_000
_MAX_OPEN_DECODERS = 8  # decoders in a process
_MAX_FAILED_PACKETS = 100  # consecutive undecodable packets after which decoding stops
_MAX_DECODE_AHEAD_FRAMES = 60  # frames up to which decoding on is cheaper than seeking a key frame


class VideoHeader(NamedTuple):
    """Size, number of frames, rate and codec of a video."""

    hw: tuple[int, int]  # as stored: a rotation tag is not applied
    n: int  # frames in the index; a truncated file has fewer
    rate_hz: float | None
    codec: str
    pixels: str  # format of the stored pixels, such as yuv420p
    display: int = 0  # symmetry of the display matrix (an mp4's), see dhtorch.data.orientation; it is not applied


def read_video_header(file: Path, *, all_frames: bool = False, track: int = 0) -> VideoHeader:
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
        return _extract_luma(frame)
    try:
        interpolation = "POINT" if nearest else "BICUBIC"
        return np.asarray(frame.to_ndarray(format=pixels, interpolation=interpolation, **decoder.one_thread))
    except decoder.errors as error:
        raise FormatError(file, f"frame {i}", error, f"pixels that convert to {pixels}") from None


def _extract_luma(frame: Any) -> np.ndarray:
    plane, is_16bit = frame.planes[0], frame.format.components[0].bits > 8
    rows = np.frombuffer(plane, "<u2" if is_16bit else np.uint8).reshape(-1, plane.line_size // (2 if is_16bit else 1))
    return rows[: frame.height, : frame.width].copy()


def close_videos() -> None:
    """Close the decoders of this process."""
    for decoder in _open_decoders.values():
        decoder.container.close()
    _open_decoders.clear()


def _check_container(file: Path, track: int) -> tuple[str, int]:
    """FFmpeg's names of a container format, from its first bytes, and display symmetry; checks an mp4's samples."""
    with open_regular(file) as stream:
        head = stream.read(16)
        if head[4:8] in MP4_FIRST_BOXES:
            check_sample_count(stream, file)
            return "mov,mp4,m4a,3gp,3g2,mj2", read_display_symmetry(stream, track)
    if head.startswith(b"\x1a\x45\xdf\xa3"):
        return "matroska,webm", 0
    if head.startswith(b"RIFF") and head[8:12] == b"AVI ":
        return "avi", 0
    raise FormatError(file, "content", repr(head[:12]), "a video file: mp4, mov, mkv, webm or avi")


def _index_entries(stream: Any) -> Any:
    """The index entries of a stream (PyAV ≥ 17), else empty: then packets are read instead, more slowly."""
    return getattr(stream, "index_entries", ())


class _Decoder:
    """One open video, its table of frames and its current position."""

    def __init__(self, file: Path, all_frames: bool, track: int) -> None:
        self.file = file
        self.track = track
        self.pts: np.ndarray | None = None
        self.keys = np.empty((0, 2), np.int64)  # presentation and decoding stamp of the key frames
        self.frames: Iterator[Any] = iter(())
        self.next = -1  # number of the next decoded frame; −1 = unknown
        av = import_optional("av")
        # PyAV before 17 converts with one thread and has no such option.
        self.one_thread = {"threads": 1} if int(av.__version__.partition(".")[0]) >= 17 else {}
        self.errors: tuple[type[Exception], ...] = (av.FFmpegError, ValueError, MemoryError, OverflowError, EOFError)
        if not file.exists():
            raise FormatError(file, "file", "no such file", "a video")
        container_format, self.display = _check_container(file, track)
        # No playlists, no network: the format is fixed and no other file may be opened.
        limits = {
            "max_pixels": str(_MAX_VIDEO_PIXELS),
            "protocol_whitelist": "file",
            "format_whitelist": container_format,
        }
        edits = {"advanced_editlist": "0"} if all_frames else {}
        try:
            self.container = av.open(
                str(file), format=container_format.split(",")[0], options=limits, container_options=edits
            )
        except self.errors as error:
            raise FormatError(file, "content", error, "a video file") from None
        try:
            self.header = self._start()
        except self.errors as error:
            self.container.close()
            raise error if isinstance(error, FormatError) else FormatError(file, "header", error, "a video") from None

    def _start(self) -> VideoHeader:
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
        index = _index_entries(self.stream)
        visible = [entry for entry in index if not entry.is_discard]
        n = len(visible) if len(index) >= self.stream.frames > 0 else len(self.table())
        if not 0 < n <= _MAX_FRAMES or self.stream.time_base is None:
            raise FormatError(self.file, "frames", n, f"1 to {_MAX_FRAMES}, with a time base")
        rate = self.stream.average_rate
        pixels = context.pix_fmt or "unknown"
        return VideoHeader((h, w), n, float(rate) if rate else None, context.name, pixels, self.display)

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
            if not 0 <= self.next <= i <= self.next + _MAX_DECODE_AHEAD_FRAMES:
                self._seek(int(pts[i]))
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

    def _seek(self, pts: int) -> None:
        """Seek the last key frame presented at or before ``pts``; not one decoded earlier but presented later."""
        before = int(np.searchsorted(self.keys[:, 0], pts, "right")) - 1
        start = int(self.keys[before, 1]) if before >= 0 else int(self.table()[0])
        self.container.seek(start, stream=self.stream, backward=True)
        self.frames = self._decoded()

    def _decoded(self) -> Iterator[Any]:
        """Decoded frames from the current position on; undecodable packets are skipped."""
        failed = 0
        for packet in self.container.demux(self.stream):
            try:
                frames = packet.decode()
            except self.errors:
                failed += 1
                if failed > _MAX_FAILED_PACKETS:
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
        while len(_open_decoders) >= _MAX_OPEN_DECODERS:
            _open_decoders.popitem(last=False)[1].container.close()
        _open_decoders[key] = _Decoder(file, all_frames, track)
    _open_decoders.move_to_end(key)
    return _open_decoders[key]


def _abandon_inherited_decoders() -> None:
    """Drop the parent's decoders after a fork: file positions are shared and the decoders' threads do not exist."""
    _inherited_decoders.extend(_open_decoders.values())  # kept alive, because freeing would wait for those threads
    _open_decoders.clear()


os.register_at_fork(after_in_child=_abandon_inherited_decoders)
