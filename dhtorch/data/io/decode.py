"""Decoding of images, tables, text and JSON: file bytes -> numpy arrays or Python values.

Lengths and headers are checked *before* decoding. Any defect of a file raises :class:`FormatError`: one line with the
file, the field, what was found and what was expected. Files are opened by :mod:`dhtorch.runtime.safe_open`.

Alphabet: ``hw`` (height, width); depth and disparity maps are (h, w) float32.
"""

import importlib
import json
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import cv2
import numpy as np

from dhtorch.geometry.no_depth import NO_DEPTH_CODES
from dhtorch.runtime.safe_open import MAX_TEXT_BYTES, FormatError, check_memory, read_bytes

#: Largest number of pixels of an image, above that of all supported cameras; larger headers are damaged or hostile.
MAX_PIXELS = 64_000_000
#: Suffixes of images, tried where a format may leave out theirs.
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")

#: The same for a JSON document: per object, list, string and entry, counted by their characters.
_JSON_BYTES = {"{": 240, "[": 64, '"': 32, ",": 40}

#: Segment of a JPEG that holds EXIF; tag of the orientation and type of its value, a 16-bit number; longest block read.
_JPEG_APP1 = 0xE1
_EXIF_ORIENTATION = 0x0112
_EXIF_SHORT = 3

_LINE_ENDS = "\n\r\v\f\x1c\x1d\x1e\x85\u2028\u2029"

#: Largest expansion of deflate: 1032 bytes from one.
MAX_DEFLATE_RATIO = 1032


class _ImageHeader(NamedTuple):
    """Size, channels, bit depth and EXIF orientation of an image file."""

    hw: tuple[int, int]  # as stored
    channels: int
    bits: int  # per channel
    kind: str  # "png" or "jpeg"
    orientation: int = 1  # EXIF's, 1 to 8: how the stored pixels are to be turned for display; 1 = not at all


def import_optional(*libraries: str, extra: str | None = None) -> ModuleType:
    """Import the first installed one of ``libraries``, which only some formats need.

    Raises:
        ImportError: none is installed; the message names what installs one: an extra, or without ``extra`` the package.
    """
    for library in libraries:
        try:
            return importlib.import_module(library)
        except ImportError:
            continue
    names = " or ".join(libraries)
    wanted = libraries[0].partition(".")[0] if extra is None else f"'dhtorch[{extra}]'"
    raise ImportError(f"this format needs {names}, which is not installed: pip install {wanted}")


def refuse_if(condition: object, file: str | Path, field: str, value: object, expected: object) -> None:
    """Raise :class:`FormatError` with the other arguments where ``condition`` is true."""
    if condition:
        raise FormatError(file, field, value, expected)


def set_opencv_threads(threads: int) -> None:
    """Set OpenCV's number of threads in this process; torch has its own; data-loader workers use one of each."""
    cv2.setNumThreads(threads)


# ---------------------------------------------------------------------------------------------------------- images


def read_image(file: Path, hw: tuple[int, int] | None = None, orientation: int | None = None) -> np.ndarray:
    """Image (C, H, W) uint8, RGB or grey, as stored: an orientation tag is not applied.

    Whether it must be, :func:`dhtorch.data.orientation.orient_recording` decides for a whole recording; ``orientation``
    is then the tag of its first picture, None = any.

    Raises:
        FormatError: missing, truncated or unknown file; not 8 bits; another size than ``hw`` or tag.
    """
    return decode_image(read_bytes(file), file, hw, orientation)


def decode_image(
    data: bytes, file: Path, hw: tuple[int, int] | None = None, orientation: int | None = None
) -> np.ndarray:
    """As :func:`read_image`, of bytes in memory; ``file`` names them in errors."""
    header = _check_header(file, data, hw)
    if orientation not in (None, header.orientation):
        raise FormatError(file, "EXIF orientation", header.orientation, f"{orientation}, as the first picture has")
    if header.bits != 8:
        raise FormatError(file, "bits per channel", header.bits, 8)
    flag = cv2.IMREAD_GRAYSCALE if header.channels == 1 else cv2.IMREAD_COLOR
    image = _decode_with_opencv(file, data, flag | cv2.IMREAD_IGNORE_ORIENTATION, header.hw)
    if image.ndim == 2:
        return image[None]
    return np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB).transpose(2, 0, 1))


def convert_colour(pixels: np.ndarray, conversion: str, file: Path) -> np.ndarray:
    """Pixels (h, w, C) uint8 after OpenCV's colour conversion of that name, as ``BGR2RGB``; ``file`` is for errors.

    Raises:
        FormatError: pixels that the conversion does not accept.
    """
    try:
        return np.asarray(cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{conversion}")))
    except cv2.error as error:
        raise FormatError(file, "data", error.err, f"pixels for {conversion}") from None


def read_depth_png(
    file: Path,
    units_per_metre: float,
    hw: tuple[int, int] | None = None,
    invalid: Sequence[int] = NO_DEPTH_CODES,
) -> np.ndarray:
    """Depth (h, w) in m from a 16-bit one-channel PNG; 0 where the code is one of ``invalid`` (0 always is).

    Raises:
        FormatError: missing, truncated or unknown file; not one channel of 16 bits; another size than ``hw``.
    """
    return decode_depth_png(read_bytes(file), file, units_per_metre, hw, invalid)


def decode_depth_png(
    data: bytes,
    file: Path,
    units_per_metre: float,
    hw: tuple[int, int] | None = None,
    invalid: Sequence[int] = NO_DEPTH_CODES,
) -> np.ndarray:
    """As :func:`read_depth_png`, of bytes in memory; ``file`` names them in errors."""
    header = _check_header(file, data, hw)
    if (header.kind, header.channels, header.bits) != ("png", 1, 16):
        problem = f"{header.kind} with {header.channels} channels of {header.bits} bits"
        raise FormatError(file, "depth", problem, "png with 1 channel of 16 bits")
    code = _decode_with_opencv(file, data, cv2.IMREAD_UNCHANGED, header.hw)
    return to_metres(code, units_per_metre, invalid)


def to_metres(code: np.ndarray, units_per_metre: float, invalid: Sequence[int] = NO_DEPTH_CODES) -> np.ndarray:
    """Depth float32 in m of codes of any shape; 0 where the code is one of ``invalid``."""
    depth = code.astype(np.float32) / np.float32(units_per_metre)
    for value in invalid:
        depth[code == value] = 0
    return depth


def read_image_header(file: Path) -> _ImageHeader:
    """Size and type of a PNG or JPEG file without decoding it.

    Raises:
        FormatError: missing, truncated or unknown file, or more than ``MAX_PIXELS`` pixels.
    """
    return decode_image_header(read_bytes(file), file)


def _check_header(file: Path, data: bytes, hw: tuple[int, int] | None) -> _ImageHeader:
    header = decode_image_header(data, file)
    if hw is not None and header.hw != tuple(hw):
        turned = ", another orientation" if header.hw == (hw[1], hw[0]) else ""
        raise FormatError(file, "size", f"{_format_size(header.hw)}{turned}", _format_size(hw))
    is_whole = _is_whole_png(data) if header.kind == "png" else data.rfind(b"\xff\xd9") > data.rfind(b"\xff\xda")
    if not is_whole:
        raise FormatError(
            file, "data", f"a truncated or damaged {header.kind} file of {len(data)} bytes", "a whole file"
        )
    scans = data.count(b"\xff\xda") if header.kind == "jpeg" else 1
    # Limits of a progressive JPEG: number of scans, and pixels summed over all scans.
    if scans > 1000 or (scans > 1 and scans * header.hw[0] * header.hw[1] > 20 * MAX_PIXELS):
        raise FormatError(
            file, "scans", f"{scans} scans of {_format_size(header.hw)} pixels", "an image with fewer scans"
        )
    return header


def decode_image_header(data: bytes, file: Path) -> _ImageHeader:
    """As :func:`read_image_header`, of bytes in memory; ``file`` names them in errors."""
    if data.startswith(b"\x89PNG\r\n\x1a\n") and len(data) >= 33 and data[12:16] == b"IHDR":
        w, h, bits, colour = struct.unpack(">IIBB", data[16:26])
        channels = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}.get(colour, 0)
        header = _ImageHeader((h, w), channels, 8 if colour == 3 else bits, "png", _png_orientation(data))
    elif data.startswith(b"\xff\xd8"):
        header = _parse_jpeg_header(file, data)
    else:
        raise FormatError(file, "content", f"{data[:8]!r}", "a PNG or JPEG image")
    if not 0 < header.hw[0] * header.hw[1] <= MAX_PIXELS:
        raise FormatError(file, "size", _format_size(header.hw), f"1 to {MAX_PIXELS} pixels")
    # Largest number of pixels per byte of a JPEG: a block of pixels from one bit.
    if header.hw[0] * header.hw[1] > len(data) * (8 * 1024 if header.kind == "jpeg" else 8 * MAX_DEFLATE_RATIO):
        raise FormatError(
            file, "size", f"{_format_size(header.hw)} in {len(data)} bytes", "enough bytes for its pixels"
        )
    return header


def _parse_jpeg_header(file: Path, data: bytes) -> _ImageHeader:
    at, orientation = 2, 1
    while at + 9 < len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            bits, h, w, channels = struct.unpack(">BHHB", data[at + 4 : at + 10])
            return _ImageHeader((h, w), channels, bits, "jpeg", orientation)
        if marker == _JPEG_APP1 and data[at + 4 : at + 10] == b"Exif\0\0":
            orientation = _parse_exif_orientation(data[at + 10 : at + 2 + length])
        at += 1 if marker == 0xFF else 2 + length
    raise FormatError(file, "content", f"a JPEG of {len(data)} bytes without a frame header", "a whole JPEG image")


def _png_orientation(data: bytes) -> int:
    """Orientation of the ``eXIf`` chunk; 1 where there is none."""
    at = 8
    while at + 12 <= len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        if kind == b"eXIf":
            return _parse_exif_orientation(data[at + 8 : at + 8 + min(length, 65_536)])
        at += 12 + length
    return 1


def _parse_exif_orientation(exif: bytes) -> int:
    """Orientation, 1 to 8, of an EXIF block (a TIFF file of tags); 1 where it has none or is damaged."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(exif[:4])
    if order is None or len(exif) < 8:
        return 1
    (start,) = struct.unpack(f"{order}I", exif[4:8])
    if start + 2 > len(exif):
        return 1
    (count,) = struct.unpack(f"{order}H", exif[start : start + 2])
    for at in range(start + 2, min(start + 2 + 12 * count, len(exif) - 11), 12):
        tag, kind, _, value = struct.unpack(f"{order}HHIH", exif[at : at + 10])
        if (tag, kind) == (_EXIF_ORIENTATION, _EXIF_SHORT):
            return value if 1 <= value <= 8 else 1
    return 1


def _is_whole_png(data: bytes) -> bool:
    """Whether all chunks have a valid length and checksum up to the final IEND."""
    at = 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        end = at + 12 + length
        if end > len(data) or zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at = end
    return False


def _decode_with_opencv(file: Path, data: bytes, flags: int, hw: tuple[int, int]) -> np.ndarray:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise FormatError(file, "data", error.err, "a decodable image") from None
    if image is None or image.shape[:2] != tuple(hw):
        raise FormatError(file, "data", "undecodable pixels", f"an image of {_format_size(hw)}")
    return image


def read_live_camera(index: int) -> Iterator[np.ndarray]:
    """Pictures (3, H, W) uint8, RGB, of OpenCV's camera ``index`` until it gives no more.

    Raises:
        FormatError: no such camera.
    """
    capture = cv2.VideoCapture(index)
    try:
        if not capture.isOpened():
            raise FormatError(Path(str(index)), "camera", "none that opens", "the number of a camera of OpenCV")
        while True:
            ok, picture = capture.read()
            if not ok:
                return
            yield np.ascontiguousarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB).transpose(2, 0, 1))
    finally:
        capture.release()


# ------------------------------------------------------------------------------------------------------------ text


def read_table(file: Path, columns: int | None = None) -> np.ndarray:
    """Numbers (rows, columns) float64 of a white-space separated table; ``#`` starts a comment. NaN may occur.

    Raises:
        FormatError: missing file, a word that is not a number, or a row of another length.
    """
    rows = read_rows(file)
    width = columns or (len(rows[0][1]) if rows else 0)
    values = np.empty((len(rows), width))
    for i, (line, words) in enumerate(rows):
        if len(words) != width:
            raise FormatError(file, f"line {line}", f"{len(words)} columns", f"{width} numbers")
        try:
            values[i] = [float(word) for word in words]
        except ValueError:
            raise FormatError(file, f"line {line}", " ".join(words), f"{width} numbers") from None
    return values


def read_rows(file: Path) -> list[tuple[int, list[str]]]:
    """(line number, words) of the lines of a text file, without blank lines and ``#`` comments."""
    lines = enumerate(read_lines(file), 1)
    return [(i, line.split()) for i, line in lines if line.strip() and not line.lstrip().startswith("#")]


def read_lines(file: Path) -> list[str]:
    """The lines of a text file, after checking the memory of its lines and words.

    Raises:
        FormatError: no such text, or more lines and words than the memory limit allows.
    """
    text = read_text(file)
    lines, words = (sum(map(text.count, marks)) for marks in (_LINE_ENDS, " ,\t"))
    # Upper bounds of the memory of Python objects in bytes: per line and per word of a table.
    check_memory(file, "text", 250 * lines + 64 * words, f"{lines} lines with {words} gaps between words")
    return text.splitlines()


def read_json(file: Path) -> dict[str, Any]:
    """Read a JSON file with an object at the top level.

    Raises:
        FormatError: missing file, not JSON, or another value at the top level.
    """
    value = decode_json(read_text(file), file)
    if not isinstance(value, dict):
        raise FormatError(file, "JSON", type(value).__name__, "an object")
    return value


def decode_json(text: str | bytes, file: Path) -> Any:
    """Text → any JSON value; ``file`` names it in errors.

    Raises:
        FormatError: not JSON, or more values than the memory limit allows.
    """
    raw = text.encode("utf-8", "replace") if isinstance(text, str) else text
    counts = {mark: raw.count(mark.encode()) for mark in _JSON_BYTES}
    check_memory(file, "JSON", sum(_JSON_BYTES[mark] * n for mark, n in counts.items()), f"{counts[',']} entries")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:  # ValueError: also bytes that are not text
        raise FormatError(file, "JSON", error, "a JSON document") from None


def get_entry(value: Any, path: str, kind: type | tuple[type, ...], file: Path) -> Any:
    """The entry ``"a.b.c"`` of nested JSON objects, of type ``kind``.

    Raises:
        FormatError: missing or of another type.
    """
    for part in path.split("."):
        if not isinstance(value, dict) or part not in value:
            raise FormatError(file, path, "nothing", _kind_name(kind))
        value = value[part]
    if not isinstance(value, kind) or isinstance(value, bool):
        raise FormatError(file, path, repr(value), _kind_name(kind))
    return value


def to_array(value: Any, shape: tuple[int, ...], file: Path, field: str) -> np.ndarray:
    """JSON lists, options or a table → finite float64 array of ``shape``.

    Raises:
        FormatError: not numbers, another shape, or not finite.
    """
    expected = f"{'x'.join(map(str, shape))} finite numbers" if shape else "a finite number"
    if value is None:
        raise FormatError(file, field, "nothing", expected)
    if isinstance(value, np.ndarray) and value.shape != shape:  # before conversion enlarges it eightfold
        raise FormatError(file, field, f"an array of shape {value.shape}", expected)
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise FormatError(file, field, repr(value), expected) from None
    if array.shape != shape or not np.isfinite(array).all():
        # Numbers shown in an error message.
        actual = array.tolist() if array.size <= 64 else f"numbers of shape {array.shape}"
        raise FormatError(file, field, actual, expected)
    return array


def to_positive(value: object, file: Path, field: str) -> float:
    """A positive number in the plausible range of scales, 1e-6 to 1e6.

    Raises:
        FormatError: anything else.
    """
    number = float(to_array(value, (), file, field))
    if not 1e-6 <= number <= 1e6:
        raise FormatError(file, field, number, "a positive number, 1e-6 to 1e6")
    return number


def read_text(file: Path) -> str:
    """The UTF-8 text of a file of at most ``MAX_TEXT_BYTES``."""
    try:
        data = read_bytes(file, MAX_TEXT_BYTES)
        check_memory(file, "text", len(data) * (2 if data.isascii() else 5), f"{len(data)} bytes")
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError(file, "text", error.reason, "UTF-8") from None


def resolve_inside(root: Path, name: str, file: Path, field: str) -> Path:
    """The path ``root / name``, checked to lie below ``root``.

    Raises:
        FormatError: an absolute name, or one with ``..``.
    """
    if not name or "\x00" in name or len(name) > 1000 or Path(name).is_absolute() or ".." in Path(name).parts:
        raise FormatError(file, field, name, "a file inside the capture")
    return root / name


def natural_sort_key(name: Path | str) -> tuple[object, ...]:
    """Sort key for natural order (1, 2, 10), with or without leading zeros."""
    parts = re.split(r"(\d+)", str(name))
    # Digits of a number in a file's name that are used.
    return tuple((not part.isdecimal(), int(part[:300]) if part.isdecimal() else part) for part in parts)


def format_left_out(names: Sequence[int | str], why: str) -> list[str]:
    """Report line on frames that were left out and the reason ``why``; empty list for no frame."""
    if not names:
        return []
    shown = ", ".join(map(str, names[:6])) + (" …" if len(names) > 6 else "")
    return [f"frame {shown}: {why}: left out" if len(names) == 1 else f"{len(names)} frames ({shown}): {why}: left out"]


def _kind_name(kind: type | tuple[type, ...]) -> str:
    kinds = kind if isinstance(kind, tuple) else (kind,)
    names: dict[type, str] = {dict: "an object", list: "a list", str: "a text"}
    return " or ".join(dict.fromkeys(names.get(k, "a number") for k in kinds))


def _format_size(hw: tuple[int, int]) -> str:
    return f"{hw[1]}x{hw[0]}"
