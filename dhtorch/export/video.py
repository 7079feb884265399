"""Writer of lossless videos: images (h, w, 3) -> mp4 (H.264, RGB) that decodes to the same bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Final

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
