"""Writers of videos: lossless mp4 that decodes to the same bytes, small previews for players, films as phones write."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np

from dhtorch.runtime import storage

#: Encoder and its options: no quantisation and no colour conversion; every second frame is a key frame, as in LeRobot's
#: videos, so that a random frame is decoded fast; no B-frames, as the muxer fails on short videos with them.
_ENCODER: Final = "libx264rgb"
_OPTIONS: Final = {"qp": "0", "preset": "veryfast", "g": "2", "bf": "0"}

#: Appends an image at a time in s.
AppendFrame = Callable[[np.ndarray, float], None]

#: Codec and pixel format of the files, by FFmpeg's names.
LOSSLESS_CODEC, LOSSLESS_PIXELS = "h264", "gbrp"

#: Encoders of previews, the first that PyAV's FFmpeg has, and options of the first: constant quality
#: (0 lossless … 51) and a fast preset. Source: chosen on holo_a, where colour maps stay free of visible blocks. Without
#: mbtree, whose look at coming frames reads beside images of a width that 16 does not divide: other bytes in every run.
_PREVIEW_ENCODERS: Final = ("libx264", "mpeg4")
_PREVIEW_OPTIONS: Final = {"crf": "20", "preset": "veryfast", "x264-params": "mbtree=0"}


@contextmanager
def _open_film(
    sink: Any,  # a path or an open file
    encoder: str,
    rate: Fraction,
    hw: tuple[int, int],
    pixels: str,
    options: Mapping[str, str],
    *,
    time_base: Fraction | None = None,  # s; None = a frame
) -> Iterator[Callable[[Any, int], None]]:
    """Open an mp4 of one video -> function that encodes a frame of PyAV at a time in units of the time base."""
    import av  # noqa: PLC0415

    with av.open(sink, "w", format="mp4") as container:
        stream: Any = container.add_stream(encoder, rate=rate, options=dict(options))
        stream.height, stream.width = hw
        stream.pix_fmt = pixels
        stream.codec_context.thread_count = 1  # the bytes of the file do not depend on the machine
        if time_base is not None:
            stream.codec_context.time_base = time_base

        def encode(frame: Any, place: int) -> None:
            frame.pts, frame.time_base = place, time_base or 1 / rate
            container.mux(stream.encode(frame))

        yield encode
        container.mux(stream.encode())


@contextmanager
def open_lossless_video(path: Path, hw: tuple[int, int], fps: float) -> Iterator[AppendFrame]:
    """Open an mp4 -> function that appends an image (h, w, 3) uint8 at a time in s; the file appears at the end.

    Times are rounded to whole frames of ``fps``; one that does not come after the last is put a frame after it.

    Raises:
        ImportError: PyAV is not installed.
    """
    import av  # noqa: PLC0415

    # Largest denominator of a frame rate. Source: rates of NTSC, such as 30000 / 1001.
    rate, last = Fraction(fps).limit_denominator(1001), -1
    with storage.write_atomically(path) as sink, _open_film(sink, _ENCODER, rate, hw, "rgb24", _OPTIONS) as encode:

        def append(picture: np.ndarray, time: float) -> None:
            nonlocal last
            last = max(last + 1, round(time * rate))
            encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24"), last)

        yield append


def write_preview_video(path: Path, hw: tuple[int, int], pictures: Iterable[np.ndarray], fps: int) -> Path:
    """Write pictures (h, w, 3) uint8, h and w even, as an mp4 that browsers and phones play."""
    import av  # noqa: PLC0415

    encoder = next((name for name in _PREVIEW_ENCODERS[:-1] if name in av.codecs_available), _PREVIEW_ENCODERS[-1])
    options = _PREVIEW_OPTIONS if encoder == _PREVIEW_ENCODERS[0] else {}
    rate = Fraction(fps)
    with storage.write_atomically(path) as sink, _open_film(sink, encoder, rate, hw, "yuv420p", options) as encode:
        for k, picture in enumerate(pictures):
            encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24"), k)
    return path


_H264: Final = {"qp": "0", "preset": "ultrafast"}
# No B-frames: with them the muxer fails on videos of two frames, at some sizes always, at others sometimes.
_HEVC: Final = {
    "preset": "ultrafast", "x265-params": "lossless=1:bframes=0:log-level=none:pools=none:frame-threads=1"
}  # fmt: skip

#: Pixel format → encoder and lossless options.
_LOSSLESS_ENCODERS: Final[dict[str, tuple[str, dict[str, str]]]] = {
    "rgb24": ("libx264rgb", _H264),
    "yuv420p": ("libx264", _H264),
    "yuvj420p": ("libx264", _H264),
    "gray12le": ("libx265", _HEVC),
    "yuv420p12le": ("libx265", _HEVC),
}


def write_lossless(
    file: Path,
    pictures: Sequence[np.ndarray],  # (h, w, 3) or (h, w) uint8, or (h, w) uint16 of 12 bits; even sizes
    pixels: str,
    *,
    rate: Fraction = Fraction(30),
    options: Mapping[str, str] | None = None,
) -> None:
    """Write byte planes or coded depth as an mp4 in a pixel format of ``_LOSSLESS_ENCODERS``, bit by bit.

    Images of one channel become the luma beside grey colour planes. ``options`` replace those of the encoder, for a
    lossy file.
    """
    import av  # noqa: PLC0415

    encoder, lossless = _LOSSLESS_ENCODERS[pixels]
    file.parent.mkdir(parents=True, exist_ok=True)
    h, w = pictures[0].shape[:2]
    with _open_film(str(file), encoder, rate, (h, w), pixels, lossless if options is None else options) as encode:
        for i, picture in enumerate(pictures):
            frame = av.VideoFrame(picture.shape[1], picture.shape[0], pixels)
            grey = 128 << 4 * (picture.itemsize - 1)
            for k, plane in enumerate(frame.planes):
                rows = np.full((plane.height, plane.line_size // picture.itemsize), grey, picture.dtype)
                if k == 0:
                    flat = picture.reshape(len(picture), -1)
                    rows[:, : flat.shape[1]] = flat
                plane.update(rows.tobytes())
            encode(frame, i)


def write_video(
    file: Path,
    pictures: Sequence[np.ndarray],  # each (H, W, 3) uint8, even sizes
    times: Sequence[float],  # s, increasing
    *,
    codec: str = "libx264",
    crf: int = 10,
    key_every: int = 12,
    b_frames: int = 2,
    stored: str = "yuv420p",
) -> None:
    """Write an mp4 with periodic key frames and B-frames (stored out of order), as phones write them.

    ``codec``: ``libx264`` or ``libx265``. ``stored``: pixel format of the file; ``yuv420p10le`` has ten bits.
    """
    import av  # noqa: PLC0415

    file.parent.mkdir(parents=True, exist_ok=True)
    rate = round(1 / (times[1] - times[0])) if len(times) > 1 else 30
    options = {"crf": str(crf), "g": str(key_every), "bf": str(b_frames)}
    if codec == "libx265":
        order = f"keyint={key_every}:bframes={b_frames}:log-level=none:pools=none:frame-threads=1"
        options = {"crf": str(crf), "x265-params": order}
    h, w = pictures[0].shape[:2]
    ticks = Fraction(1, 600)  # s; divisible by 24, 25, 30 and 60 Hz
    with _open_film(str(file), codec, Fraction(rate), (h, w), stored, options, time_base=ticks) as encode:
        for picture, time in zip(pictures, times, strict=True):
            encode(av.VideoFrame.from_ndarray(picture, format="rgb24"), round((time - times[0]) / ticks))
