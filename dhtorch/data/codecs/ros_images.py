"""Codec of the pixels of ROS pictures: colour, depth, compressed depth, and the lens models of their calibration."""

import struct
from pathlib import Path
from typing import Any, Final

import numpy as np

from dhtorch.data.io.decode import MAX_PIXELS, FormatError, convert_colour, decode_depth_png, to_metres

#: Encoding of depth → type of its pixels.
DEPTH_ENCODINGS: Final = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
#: Encoding of colour → stored channels.
COLOUR_CHANNELS: Final = {
    "rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "8UC4": 4, "mono8": 1, "8UC1": 1,
    "yuv422": 2, "uyvy": 2, "yuv422_yuy2": 2, "yuyv": 2,
    "bayer_rggb8": 1, "bayer_bggr8": 1, "bayer_gbrg8": 1, "bayer_grbg8": 1,
}  # fmt: skip

#: Encoding → name of OpenCV's conversion to RGB; it names a Bayer pattern by its second row.
_CONVERSIONS: Final = {
    "bgr8": "BGR2RGB", "8UC3": "BGR2RGB", "rgba8": "RGBA2RGB",
    "bgra8": "BGRA2RGB", "8UC4": "BGRA2RGB",
    "yuv422": "YUV2RGB_UYVY", "uyvy": "YUV2RGB_UYVY",
    "yuv422_yuy2": "YUV2RGB_YUY2", "yuyv": "YUV2RGB_YUY2",
    "bayer_rggb8": "BayerBG2RGB", "bayer_bggr8": "BayerRG2RGB",
    "bayer_gbrg8": "BayerGR2RGB", "bayer_grbg8": "BayerGB2RGB",
}  # fmt: skip

_PNG_SIGNATURE: Final = b"\x89PNG"
_DEPTH_HEADER: Final = struct.Struct("<iff")  # format, a and b of depth = a / (code - b)
#: Lens models whose coefficients are OpenCV's.
_OPENCV_MODELS: Final = ("plumb_bob", "rational_polynomial", "brown_conrady", "modified_brown_conrady")
_GRID: Final = 41  # points along each side of the image at which an inverse lens model is inverted
_MAX_INVERSION_PX: Final = 0.1  # px, largest error of an inverted model


def decode_colour(image: Any, file: Path) -> np.ndarray:
    """Image (C, H, W) uint8, RGB or grey, of a message.

    Raises:
        FormatError: an unknown encoding, or fewer bytes than pixels.
    """
    if image.encoding not in COLOUR_CHANNELS:
        raise FormatError(file, "encoding", image.encoding, ", ".join(COLOUR_CHANNELS))
    pixels = _rows(image, np.dtype(np.uint8), COLOUR_CHANNELS[image.encoding], file)
    if image.encoding in _CONVERSIONS:
        pixels = convert_colour(pixels, _CONVERSIONS[image.encoding], file)
    return pixels.transpose(2, 0, 1).copy()


def decode_depth(image: Any, metres: float, file: Path) -> np.ndarray:
    """Depth (h, w) float32 in m; 0 = no return.

    Args:
        image: of an encoding of ``DEPTH_ENCODINGS``.
        metres: of a code of whole numbers; other numbers are metres times this.
        file: names the picture in errors.

    Raises:
        FormatError: an unknown encoding, or fewer bytes than pixels.
    """
    if image.encoding not in DEPTH_ENCODINGS:
        raise FormatError(file, "encoding", image.encoding, ", ".join(DEPTH_ENCODINGS))
    kind = np.dtype((">" if image.is_bigendian else "<") + DEPTH_ENCODINGS[image.encoding])
    pixels = _rows(image, kind, 1, file)[..., 0]
    if kind.kind == "u":
        return to_metres(pixels, 1 / metres)
    return _clean(pixels.astype(np.float32) * np.float32(metres))


def strip_depth_header(data: bytes, is_depth: bool) -> bytes:
    """PNG of compressed depth, which stands behind a header of twelve bytes; other data is unchanged."""
    at = _DEPTH_HEADER.size
    return data[at:] if is_depth and data[at : at + 4] == _PNG_SIGNATURE else data


def decode_compressed_depth(data: bytes, encoding: str, metres: float, hw: tuple[int, int], file: Path) -> np.ndarray:
    """As :func:`decode_depth`, of a ``CompressedImage``: PNG of codes, or of inverse depth for 32FC1.

    Raises:
        FormatError: another compression, such as RVL, or a damaged PNG.
    """
    png = strip_depth_header(data, is_depth=True)
    if not png.startswith(_PNG_SIGNATURE):
        raise FormatError(file, "compressed depth", encoding or repr(data[:4]), "PNG (compressedDepth png)")
    if encoding.partition(";")[0].strip() != "32FC1":
        return decode_depth_png(png, file, 1 / metres, hw)
    if len(png) == len(data):
        raise FormatError(file, "compressed depth", "32FC1 without its header", "twelve bytes before the PNG")
    _, a, b = _DEPTH_HEADER.unpack(data[: _DEPTH_HEADER.size])
    code = decode_depth_png(png, file, 1.0, hw, (0,))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = np.where(code > 0, np.float32(a) / (code - np.float32(b)), np.float32(0))
    return _clean(depth.astype(np.float32) * np.float32(metres))


def to_opencv_distortion(info: Any, file: Path) -> list[float] | None:
    """Coefficients in OpenCV's order; None for a lens without distortion.

    Raises:
        FormatError: a model that is not OpenCV's, such as a fisheye.
    """
    D = np.asarray(info.d).tolist()
    if not any(D):
        return None
    model = info.distortion_model.strip().lower().replace(" ", "_")
    if model == "inverse_brown_conrady":
        # Coefficients of the lens whose *inverse* has the stated ones, by least squares over the image
        if len(D) < 5:
            raise FormatError(file, "D", f"{len(D)} numbers", "5: k1 k2 p1 p2 k3")
        u, v = np.meshgrid(np.linspace(0, info.width - 1, _GRID), np.linspace(0, info.height - 1, _GRID))
        x, y = (u - info.k[2]) / info.k[0], (v - info.k[5]) / info.k[4]
        distorted = np.stack((x, y), -1).reshape(-1, 2)
        ideal = distorted + np.tensordot(_brown_conrady_terms(distorted), np.array(D[:5]), 1)
        terms, target = _brown_conrady_terms(ideal).reshape(-1, 5), (distorted - ideal).reshape(-1)
        coefficients = np.linalg.lstsq(terms, target, rcond=None)[0]
        error = np.abs(terms @ coefficients - target).max() * info.k[0]
        if not error <= _MAX_INVERSION_PX:
            raise FormatError(file, "D", f"a lens inverted to {error:.2g} px", f"at most {_MAX_INVERSION_PX} px")
        return [float(c) for c in coefficients]
    if model not in _OPENCV_MODELS or len(D) < 4:
        expected = f"{', '.join(_OPENCV_MODELS)}, or pictures rectified beforehand"
        raise FormatError(file, "distortion_model", f"{info.distortion_model} of {len(D)} numbers", expected)
    return D[: 8 if len(D) >= 8 else min(len(D), 5)]


def _brown_conrady_terms(xy: np.ndarray) -> np.ndarray:
    """Derivatives (n, 2, 5) of the shift of points (n, 2) by k1 k2 p1 p2 k3."""
    x, y = xy.T
    r2 = x * x + y * y
    along = (x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3)
    down = (y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3)
    return np.stack((np.stack(along, -1), np.stack(down, -1)), 1)


def _rows(image: Any, kind: np.dtype, channels: int, file: Path) -> np.ndarray:
    """Pixels (h, w, channels) without the padding of the rows."""
    h, w = image.height, image.width
    used = w * kind.itemsize * channels
    if not 0 < h * w <= MAX_PIXELS or image.step < used:
        problem = f"{w}x{h} pixels in rows of {image.step} bytes"
        raise FormatError(file, "size, step", problem, f"1 to {MAX_PIXELS} pixels, {used} bytes or more in a row")
    if len(image.data) < (h - 1) * image.step + used:
        raise FormatError(file, "data", f"{len(image.data)} bytes", f"{h} rows of {image.step} bytes")
    data = np.asarray(image.data)
    rows = np.lib.stride_tricks.as_strided(data, (h, used), (image.step, 1))
    return np.ascontiguousarray(rows).view(kind).reshape(h, w, channels)


def _clean(depth: np.ndarray) -> np.ndarray:
    """Depth with 0 for values that are not finite or not positive."""
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
