"""Reader of Record3D's RGBD mp4: depth as hue in the left half of every image, colour in the right half.

A pixel's hue (full saturation, full value) runs once round the circle from the nearest to the furthest depth, 0 to 3 m
unless the file has another range. Both ends are red and cannot be distinguished, so they are dropped, and so are pixels
next to a depth discontinuity: there the codec has blended two hues into a third one. Intrinsics are stored as JSON near
the end of the file, behind the images, or in a ``metadata.json`` beside it; they refer to one half. There is no
confidence and no pose.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data.codecs import video
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.recording import Recording
from dhtorch.records import Camera, Frame
from dhtorch.runtime import safe_open as doors

_METADATA_START = b'{"intrinsicMatrix"'
_TAIL_BYTES = 1 << 20  # bytes at the end of the file that are searched for the intrinsics
_DEFAULT_RANGE_M = (0.0, 3.0)  # m
_KEPT_RANGE_RATIO = (0.1 / 3, 2.8 / 3)  # of the range, as kept by the app's own viewer


def recognise(file: Path) -> str | None:
    """The content by which ``file`` is recognised as an RGBD mp4, as text; None if it is not."""
    if file.suffix.lower() != ".mp4":
        return None
    if _METADATA_START in _read_tail(file):
        return "an mp4 with an intrinsicMatrix at its end"
    side_car = file.parent / "metadata.json"
    if side_car.is_file() and _METADATA_START.strip(b'{"') in files.read_bytes(side_car, doors.MAX_TEXT_BYTES):
        return "an mp4 beside a metadata.json with an intrinsicMatrix"
    return None


def read(file: Path, *, depth_range: Sequence[float] | None = None, max_step: float = 0.05) -> list[Recording]:
    """Open one video; see :func:`dhtorch.data.readers.record3d.read`."""
    meta, source = _read_metadata(file)
    header = video.read_video_header(file)
    hw = (header.hw[0], header.hw[1] // 2)
    K = files.to_array(meta.get("intrinsicMatrix", meta.get("K")), (9,), source, "intrinsicMatrix").reshape(3, 3).T
    limits = depth_range if depth_range is not None else meta.get("rangeOfEncodedDepth", _DEFAULT_RANGE_M)
    near, far = files.to_array(limits, (2,), source, "rangeOfEncodedDepth")
    if not 0 <= near < far <= 1e4 or header.hw[1] % 2:
        problem = f"{near} to {far} m in an image {header.hw[1]} px wide"
        raise FormatError(source, "rangeOfEncodedDepth", problem, "two increasing depths, two halves")
    camera = convert.to_camera(K, hw, source, "intrinsicMatrix")
    load = partial(
        _load_frame,
        file=file,
        hw=header.hw,
        camera=camera,
        near=float(near),
        far=float(far),
        max_step=files.to_positive(max_step, file, "option max_step"),
    )
    number = torch.arange(header.n)
    stamps, remarks = video.read_video_times(file), list[str]()
    times = None if header.rate_hz is None else number.double() / header.rate_hz
    if len(stamps) == header.n:  # from the first frame on, s
        times = torch.from_numpy(stamps - stamps[0])
    else:
        remarks = [f"the file has {len(stamps)} of {header.n} frames: times are those of the nominal rate"]
    return [
        Recording(
            name=file.stem,
            format="record3d",
            load=load,
            number=number,
            root=file,
            times=times,
            rate_hz=header.rate_hz,
            report=("no poses in this layout", *remarks),
        )
    ]


def _load_frame(
    i: int,
    *,
    file: Path,
    hw: tuple[int, int],  # of the whole image, both halves
    camera: Camera,
    near: float,  # m
    far: float,
    max_step: float,
) -> Frame:
    """Position → frame."""
    # Nearest: interpolating the half-size colour planes would blend hues.
    picture = video.read_video_frame(file, i, hw, nearest=True)
    half = hw[1] // 2
    image = np.ascontiguousarray(picture[:, half:].transpose(2, 0, 1))
    depth = decode_hue_depth(picture[:, :half], near, far, max_step)
    return Frame(torch.from_numpy(image)[None], torch.from_numpy(depth)[None], camera)


def decode_hue_depth(
    rgb: np.ndarray,  # (h, w, 3) uint8
    near: float,  # m, of hue 0
    far: float,  # m, of hue 1
    max_step: float,  # m
) -> np.ndarray:
    """Hues → depth (h, w) m float32; 0 near both ends of the range, beside a discontinuity and without hue."""
    x = rgb.astype(np.float32)
    r, g, b = x[..., 0], x[..., 1], x[..., 2]
    top, chroma = x.max(-1), np.ptp(x, -1)
    c = np.maximum(chroma, 1)
    sixth = np.where(top == r, (g - b) / c % 6, np.where(top == g, (b - r) / c + 2, (r - g) / c + 4))
    hue = sixth / 6
    depth = near + hue * (far - near)
    # of the maximum: coded pixels are saturated, grey has no hue
    usable = (hue >= _KEPT_RANGE_RATIO[0]) & (hue < _KEPT_RANGE_RATIO[1]) & (chroma >= 255 * 0.25)
    jump = np.maximum(_window_extreme(depth, np.maximum) - depth, depth - _window_extreme(depth, np.minimum)) > max_step
    return np.where(usable & ~jump, depth, 0).astype(np.float32)


def _window_extreme(x: np.ndarray, extreme: np.ufunc) -> np.ndarray:
    """Largest or smallest value (``np.maximum``, ``np.minimum``) in the 3×3 window of every pixel."""
    x = np.pad(x, 1, mode="edge")
    x = extreme(extreme(x[:-2], x[1:-1]), x[2:])
    return np.asarray(extreme(extreme(x[:, :-2], x[:, 1:-1]), x[:, 2:]))


def _read_metadata(file: Path) -> tuple[dict[str, Any], Path]:
    """The JSON object with the intrinsics, and the file that contains it."""
    tail = _read_tail(file)
    at = tail.rfind(_METADATA_START)
    if at < 0:
        side_car = file.parent / "metadata.json"
        files.refuse_if(
            not side_car.is_file(), file, "intrinsicMatrix", "neither in the file nor in a metadata.json", "one of them"
        )
        return files.read_json(side_car), side_car
    try:  # other bytes follow
        return json.JSONDecoder().raw_decode(tail[at:].decode("utf-8", errors="replace"))[0], file
    except (ValueError, RecursionError) as error:
        raise FormatError(file, "intrinsicMatrix", error, "a JSON object") from None


def _read_tail(file: Path) -> bytes:
    try:
        with doors.open_regular(file) as stream:
            stream.seek(-min(_TAIL_BYTES, stream.seek(0, 2)), 2)
            return stream.read()
    except OSError as error:
        raise FormatError(file, "file", error, "a readable file") from None
