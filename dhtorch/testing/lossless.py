"""Writer of lossless videos, for byte planes and coded depth, where one wrong bit can be half a metre."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data.io.decode import import_optional

_H264 = {"qp": "0", "preset": "ultrafast"}
# No B-frames: with them the muxer fails on videos of two frames, at some sizes always, at others sometimes.
_HEVC = {"preset": "ultrafast", "x265-params": "lossless=1:bframes=0:log-level=none:pools=none:frame-threads=1"}

#: Pixel format → encoder and lossless options.
_LOSSLESS_ENCODERS: dict[str, tuple[str, dict[str, str]]] = {
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
    """Write images as an mp4 in a pixel format of ``_LOSSLESS_ENCODERS``; single-channel ones become the luma.

    ``options`` replace those of the encoder, for a lossy file.
    """
    av = import_optional("av")
    encoder, lossless = _LOSSLESS_ENCODERS[pixels]
    encoder_options = dict(lossless if options is None else options)
    file.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(file), "w", format="mp4") as container:
        stream = container.add_stream(encoder, rate=rate, options=encoder_options)
        stream.pix_fmt = pixels
        stream.height, stream.width = pictures[0].shape[:2]
        stream.codec_context.thread_count = 1
        for i, picture in enumerate(pictures):
            frame = av.VideoFrame(picture.shape[1], picture.shape[0], pixels)
            _fill_planes(frame, picture)
            frame.pts, frame.time_base = i, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _fill_planes(frame: Any, picture: np.ndarray) -> None:
    """Fill the first plane with the image and the colour planes with grey."""
    for k, plane in enumerate(frame.planes):
        rows = np.full(
            (plane.height, plane.line_size // picture.itemsize), 128 << 4 * (picture.itemsize - 1), picture.dtype
        )
        if k == 0:
            flat = picture.reshape(len(picture), -1)
            rows[:, : flat.shape[1]] = flat
        plane.update(rows.tobytes())
