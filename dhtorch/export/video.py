"""Writers of videos: lossless mp4 (H.264, RGB) that decodes to the same bytes, and small previews for players."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
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
#: (0 lossless … 51) and a fast preset. Source: chosen on holo_a, where colour maps stay free of visible blocks.
_PREVIEW_ENCODERS: Final = ("libx264", "mpeg4")
_PREVIEW_OPTIONS: Final = {"crf": "20", "preset": "veryfast"}

#: Largest denominator of a frame rate. Source: rates of NTSC, such as 30000 / 1001.
_MAX_RATE_DENOMINATOR: Final = 1001


@contextmanager
def open_lossless_video(path: Path, hw: tuple[int, int], fps: float) -> Iterator[AppendFrame]:
    """Open an mp4 -> function that appends an image (h, w, 3) uint8 at a time in s; the file appears at the end.

    Times are rounded to whole frames of ``fps``; one that does not come after the last is put a frame after it.

    Raises:
        ImportError: PyAV is not installed.
    """
    import av  # noqa: PLC0415

    rate = Fraction(fps).limit_denominator(_MAX_RATE_DENOMINATOR)
    with storage.write_atomically(path) as sink, av.open(sink, "w", format="mp4") as container:
        stream = container.add_stream(_ENCODER, rate=rate, options=dict(_OPTIONS))
        stream.height, stream.width = hw
        stream.pix_fmt = "rgb24"
        stream.codec_context.thread_count = 1  # the bytes of the file do not depend on the machine
        last = -1

        def append(picture: np.ndarray, time: float) -> None:
            nonlocal last
            last = max(last + 1, round(time * rate))
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.pts, frame.time_base = last, 1 / rate
            container.mux(stream.encode(frame))

        yield append
        container.mux(stream.encode())


def write_preview_video(path: Path, hw: tuple[int, int], pictures: Iterable[np.ndarray], fps: int) -> Path:
    """Write pictures (h, w, 3) uint8, h and w even, as an mp4 that browsers and phones play."""
    import av  # noqa: PLC0415

    encoder = next((name for name in _PREVIEW_ENCODERS[:-1] if name in av.codecs_available), _PREVIEW_ENCODERS[-1])
    options = dict(_PREVIEW_OPTIONS) if encoder == _PREVIEW_ENCODERS[0] else {}
    with storage.write_atomically(path) as sink, av.open(sink, "w", format="mp4") as container:
        stream: Any = container.add_stream(encoder, rate=fps, options=options)
        stream.height, stream.width = hw
        stream.pix_fmt = "yuv420p"
        stream.codec_context.thread_count = 1  # the bytes of the file do not depend on the machine
        for k, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.pts, frame.time_base = k, Fraction(1, fps)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path
