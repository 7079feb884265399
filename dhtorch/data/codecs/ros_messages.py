"""Codec of ROS messages: pictures, camera calibrations and transforms, of ROS 1 and of ROS 2 (CDR).

Definitions are fixed here and never taken from a file. The lengths of strings and arrays are compared with the bytes
of the message before they are read.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from dhtorch.data.io.decode import FormatError

_ZSTD_SIGNATURE: Final = b"\x28\xb5\x2f\xfd"
_PLAIN_CDR: Final = (0, 1)  # representations of ROS 2: big- and little-endian
_CDR_HEADER_BYTES: Final = 4


class Header(NamedTuple):
    """Stamp and coordinate frame of a message."""

    stamp_ns: int
    frame: str


class ImageHead(NamedTuple):
    """Header, size and encoding of a picture."""

    header: Header
    hw: tuple[int, int] | None  # None for a compressed picture
    encoding: str  # of the pixels, or the format of a compressed picture


class RawImage(NamedTuple):
    """A picture as stored."""

    hw: tuple[int, int]
    encoding: str
    is_big_endian: bool
    step: int  # bytes of a row
    data: memoryview


class CameraInfo(NamedTuple):
    """Calibration of a camera."""

    header: Header
    hw: tuple[int, int]  # of the calibrated image
    model: str  # of the distortion
    D: tuple[float, ...]
    K: np.ndarray  # (3, 3) of the image as taken
    P: np.ndarray  # (3, 4) of the rectified image
    binning: tuple[int, int]  # pixels joined along x and y; 0 = 1
    offset: tuple[int, int]  # x, y of the region of interest
    roi_hw: tuple[int, int]  # of the region of interest; 0 = whole


class Transform(NamedTuple):
    """Pose of a child frame in its parent's."""

    stamp_ns: int
    parent: str
    child: str
    t: tuple[float, ...]  # m
    q: tuple[float, ...]  # x y z w


def parse_header(data: bytes, coding: str, file: Path) -> Header:
    """Header of a message that begins with one; ``data`` may be its beginning."""
    return _Cursor(data, coding, file).header()


def parse_image_head(data: bytes, coding: str, file: Path, *, compressed: bool) -> ImageHead:
    """Header, size and encoding of ``sensor_msgs/Image`` or ``CompressedImage`` from its beginning."""
    cursor = _Cursor(data, coding, file)
    header = cursor.header()
    if compressed:
        return ImageHead(header, None, cursor.text())
    h, w = cursor.integer(), cursor.integer()
    return ImageHead(header, (h, w), cursor.text())


def parse_image(data: bytes, coding: str, file: Path) -> RawImage:
    """``sensor_msgs/Image``."""
    cursor = _Cursor(data, coding, file)
    cursor.header()
    h, w = cursor.integer(), cursor.integer()
    encoding = cursor.text()
    is_big_endian = bool(cursor.integer("B"))
    return RawImage((h, w), encoding, is_big_endian, cursor.integer(), cursor.octets())


def parse_compressed_image(data: bytes, coding: str, file: Path) -> tuple[str, memoryview]:
    """``sensor_msgs/CompressedImage`` → (format, data)."""
    cursor = _Cursor(data, coding, file)
    cursor.header()
    return cursor.text(), cursor.octets()


def parse_camera_info(data: bytes, coding: str, file: Path) -> CameraInfo:
    """``sensor_msgs/CameraInfo``."""
    cursor = _Cursor(data, coding, file)
    header = cursor.header()
    h, w = cursor.integer(), cursor.integer()
    model = cursor.text()
    D = cursor.floats(cursor.count(8))
    K = np.array(cursor.floats(9)).reshape(3, 3)
    cursor.floats(9)  # rectifying rotation
    P = np.array(cursor.floats(12)).reshape(3, 4)
    bx, by, x, y, roi_h, roi_w = (cursor.integer() for _ in range(6))
    return CameraInfo(header, (h, w), model, D, K, P, (bx, by), (x, y), (roi_h, roi_w))


def parse_transforms(data: bytes, coding: str, file: Path) -> list[Transform]:
    """``tf2_msgs/TFMessage``."""
    cursor = _Cursor(data, coding, file)
    transforms = []
    for _ in range(cursor.count(60)):
        stamp, parent = cursor.header()
        child = cursor.text()
        transforms.append(Transform(stamp, parent, child, cursor.floats(3), cursor.floats(4)))
    return transforms


def parse_odometry(data: bytes, coding: str, file: Path) -> Transform:
    """``nav_msgs/Odometry`` without covariances and velocities."""
    cursor = _Cursor(data, coding, file)
    stamp, parent = cursor.header()
    child = cursor.text()
    return Transform(stamp, parent, child, cursor.floats(3), cursor.floats(4))


def parse_plain_transform(data: bytes, coding: str, file: Path) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """``geometry_msgs/Transform`` → translation, quaternion x y z w."""
    cursor = _Cursor(data, coding, file)
    return cursor.floats(3), cursor.floats(4)


def parse_float(data: bytes, coding: str, file: Path) -> float:
    """``std_msgs/Float32``."""
    return float(_Cursor(data, coding, file).number("f"))


class _Cursor:
    """Position in a serialised message."""

    def __init__(self, data: bytes, coding: str, file: Path) -> None:
        self.view, self.file, self.at = memoryview(data), file, 0
        self.is_cdr = coding == "cdr"
        self.order = "<"
        if not self.is_cdr:
            return
        if data.startswith(_ZSTD_SIGNATURE):
            raise FormatError(file, "message", "messages compressed one by one", "a bag after `ros2 bag convert`")
        if len(data) < _CDR_HEADER_BYTES or data[0] or data[1] not in _PLAIN_CDR:
            raise FormatError(file, "message", repr(bytes(data[:4])), "plain CDR")
        self.order = "<" if data[1] == 1 else ">"
        self.view = self.view[_CDR_HEADER_BYTES:]

    def number(self, kind: str) -> float:
        """A number of a ``struct`` type; CDR aligns it to its own size."""
        size = struct.calcsize(kind)
        if self.is_cdr:
            self.at += -self.at % size
        (value,) = struct.unpack(self.order + kind, self._take(size))
        return float(value)

    def integer(self, kind: str = "I") -> int:
        """A whole number of a ``struct`` type of at most 32 bits."""
        return int(self.number(kind))

    def floats(self, count: int) -> tuple[float, ...]:
        """Numbers of double precision."""
        if self.is_cdr and count:
            self.at += -self.at % 8
        return struct.unpack(f"{self.order}{count}d", self._take(8 * count))

    def count(self, least: int) -> int:
        """Length of a sequence whose entries take at least ``least`` bytes."""
        n = self.integer()
        if n * least > len(self.view) - self.at:
            problem = f"{n} entries in {len(self.view) - self.at} bytes"
            raise FormatError(self.file, "message", problem, f"{least} bytes or more of each")
        return n

    def octets(self) -> memoryview:
        """A sequence of bytes, not copied."""
        return self._take(self.count(1))

    def text(self) -> str:
        """A string; that of CDR ends with a zero."""
        return bytes(self.octets()).rstrip(b"\0").decode("utf-8", "replace")

    def header(self) -> Header:
        """``std_msgs/Header``; that of ROS 1 begins with a number."""
        if not self.is_cdr:
            self.integer()
        seconds, nanoseconds = self.integer("i" if self.is_cdr else "I"), self.integer()
        return Header(seconds * 10**9 + nanoseconds, self.text())

    def _take(self, size: int) -> memoryview:
        if self.at + size > len(self.view):
            raise FormatError(self.file, "message", f"{len(self.view)} bytes", f"at least {self.at + size}")
        part = self.view[self.at : self.at + size]
        self.at += size
        return part
