"""Codec of COLMAP's models: cameras, images with their observations, and points, as text or binary.

Poses map world to camera, quaternions start with w, and the centre of the first pixel is (0.5, 0.5) in the file and
(0, 0) here. Every pose and point remembers where the file holds it, so that a model can be written with other ones.
"""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dhtorch.data import convert
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError

#: Camera model → numbers of focal lengths and of distortion coefficients. Source: COLMAP's camera models.
COLMAP_LENSES = {
    "SIMPLE_PINHOLE": (1, 0),
    "PINHOLE": (2, 0),
    "SIMPLE_RADIAL": (1, 1),
    "RADIAL": (1, 2),
    "OPENCV": (2, 4),
    "FULL_OPENCV": (2, 8),
}

#: Numbers of these models in binary files → names. Source: COLMAP, sensor/models.h.
_BINARY_LENSES = dict(zip((0, 1, 2, 3, 4, 6), COLMAP_LENSES, strict=True))


@dataclass(frozen=True, eq=False)
class _ColmapLens:
    """A camera of a model."""

    hw: tuple[int, int]
    K: np.ndarray  # (3, 3), pixel centres at integers
    distortion: tuple[float, ...] | None


class ColmapNumbers(NamedTuple):
    """Where a file holds the numbers of one pose or point: byte offset or line; and their values."""

    at: int
    values: np.ndarray


@dataclass(frozen=True, eq=False)
class ColmapImageEntry:
    """An image of a model."""

    image_id: int
    camera_id: int
    name: str
    pose: ColmapNumbers  # qw, qx, qy, qz, tx, ty, tz of world to camera
    c2w: np.ndarray  # (4, 4)
    uv: np.ndarray  # (n, 2) px, observations, pixel centres at integers
    point: np.ndarray  # (n,) int64, ids of their points, -1 = none


def read_colmap_cameras(file: Path) -> dict[int, _ColmapLens]:
    """Camera id → camera, of ``cameras.txt`` or ``cameras.bin``.

    Raises:
        FormatError: a camera model without OpenCV's distortion, or a damaged file.
    """
    lenses = {}
    for number, model, (w, h), values in _binary_cameras(file) if file.suffix == ".bin" else _text_cameras(file):
        n_focal, _ = COLMAP_LENSES[model]
        focal, (cx, cy), lens = values[:n_focal], values[n_focal : n_focal + 2], values[n_focal + 2 :]
        padded = [*lens, *[0.0] * (4 - len(lens))] if lens else []
        K = convert.make_K(focal[0], focal[-1], cx - 0.5, cy - 0.5)  # pixel centres at integers
        lenses[number] = _ColmapLens((round(h), round(w)), K, tuple(padded) if any(padded) else None)
    return lenses


def read_colmap_images(file: Path, *, observations: bool = True) -> list[ColmapImageEntry]:
    """Images of ``images.txt`` or ``images.bin``; without ``observations`` those of a text file are not read.

    Raises:
        FormatError: a damaged file.
    """
    images = []
    entries = _binary_images(file) if file.suffix == ".bin" else _text_images(file, observations)
    for image_id, pose, camera_id, name, table in entries:
        qw, qx, qy, qz, *t = pose.values.tolist()
        w2c = convert.to_c2w(np.array([[qx, qy, qz, qw]]), np.array([t]), file, f"pose of {name}")[0]
        point = table[:, 2].astype(np.int64)
        images.append(ColmapImageEntry(image_id, camera_id, name, pose, np.linalg.inv(w2c), table[:, :2] - 0.5, point))
    return images


def read_colmap_points(file: Path) -> dict[int, ColmapNumbers]:
    """Point id → its place, of ``points3D.txt`` or ``points3D.bin``.

    Raises:
        FormatError: a damaged file.
    """
    points: dict[int, ColmapNumbers] = {}
    if file.suffix == ".bin":
        cursor, track = _Cursor(file), np.dtype("<u8")
        for _ in range(cursor.take("Q")[0]):
            (number,) = cursor.take("Q")
            points[number] = cursor.numbers(3)
            cursor.take("3Bd")
            cursor.array(track, cursor.take("Q")[0])
        return points
    for line, text in enumerate(files.read_lines(file)):
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        words = text.split(maxsplit=8)
        if len(words) < 8:
            raise FormatError(file, f"line {line + 1}", " ".join(words), "POINT3D_ID, X, Y, Z, R, G, B, ERROR, …")
        place = np.array(parse_numbers(words[1:4], 3, file, line + 1))
        points[parse_id(words[0], file, line + 1)] = ColmapNumbers(line, place)
    return points


def replace_numbers(file: Path, numbers: Sequence[ColmapNumbers]) -> bytes:
    """The bytes of a file of images or points with other poses or places, in metres; all else is unchanged."""
    data = files.read_bytes(file)
    if file.suffix == ".bin":
        out = bytearray(data)
        for at, values in numbers:
            struct.pack_into(f"<{len(values)}d", out, at, *values)
        return bytes(out)
    lines = data.decode("utf-8").splitlines(keepends=True)
    for at, values in numbers:
        words = lines[at].rstrip("\r\n").split(maxsplit=len(values) + 1)
        end = lines[at][len(lines[at].rstrip("\r\n")) :]
        lines[at] = " ".join([words[0], *(f"{v:.12g}" for v in values), *words[len(values) + 1 :]]) + end
    return "".join(["# metres\n", *lines]).encode("utf-8")


# ---------------------------------------------------------------------------------------------------------------- text


def parse_id(word: str, file: Path, line: int) -> int:
    """A number that names a camera, image or point.

    Raises:
        FormatError: anything else.
    """
    if not (word.isdecimal() and len(word) <= 18):
        raise FormatError(file, f"line {line}", word, "an id")
    return int(word)


def parse_numbers(words: Sequence[str], count: int, file: Path, line: int) -> list[float]:
    """``count`` finite numbers.

    Raises:
        FormatError: anything else.
    """
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise FormatError(file, f"line {line}", " ".join(words), f"{count} numbers")
    return values


_Camera = tuple[int, str, tuple[float, float], Sequence[float]]


def _text_cameras(file: Path) -> Iterator[_Camera]:
    for line, words in files.read_rows(file):
        model = words[1] if len(words) > 1 else ""
        if model not in COLMAP_LENSES:
            expected = f"{', '.join(COLMAP_LENSES)} (undistort the images first)"
            raise FormatError(file, f"line {line} model", model, expected)
        values = parse_numbers(words[2:], 4 + sum(COLMAP_LENSES[model]), file, line)
        w, h = (files.to_positive(size, file, f"line {line} size") for size in values[:2])
        yield parse_id(words[0], file, line), model, (w, h), values[2:]


#: Id, pose, camera, name and observations (n, 3): u, v and the id of the point.
_Image = tuple[int, ColmapNumbers, int, str, np.ndarray]


def _text_images(file: Path, observations: bool) -> Iterator[_Image]:
    """Entries of ``images.txt``: two lines each, the second with observations, which may be empty."""
    lines, line, n = files.read_lines(file), 0, 0
    while line < len(lines):
        text = lines[line]
        line += 1
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        words = text.split(maxsplit=9)
        # Most images of a text model, as a bound for damaged files.
        if len(words) != 10 or n >= 1_000_000:
            raise FormatError(file, f"line {line}", f"{len(words)} columns", "IMAGE_ID, QW … TZ, CAMERA_ID, NAME")
        pose = ColmapNumbers(line - 1, np.array(parse_numbers(words[1:8], 7, file, line)))
        ids = [parse_id(word, file, line) for word in (words[0], words[8])]
        seen = lines[line].split() if observations and line < len(lines) else []
        table = np.array(parse_numbers(seen, len(seen) // 3 * 3, file, line + 1)).reshape(-1, 3)
        yield ids[0], pose, ids[1], words[9].strip(), table
        line, n = line + 1, n + 1


# -------------------------------------------------------------------------------------------------------------- binary


class _Cursor:
    """Values of a binary file in turn; running over its end is an error of its format."""

    def __init__(self, file: Path) -> None:
        self.file, self.data, self.at = file, files.read_bytes(file), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        try:
            values = struct.unpack_from(f"<{layout}", self.data, self.at)
        except struct.error:
            raise FormatError(self.file, f"byte {self.at}", "the end of the file", "more values") from None
        self.at += struct.calcsize(f"<{layout}")
        return values

    def numbers(self, n: int) -> ColmapNumbers:
        return ColmapNumbers(self.at, np.array(self.take(f"{n}d")))

    def array(self, dtype: np.dtype, n: int) -> np.ndarray:
        if n > (len(self.data) - self.at) // dtype.itemsize:
            raise FormatError(self.file, f"byte {self.at}", f"{n} entries", "as many as the file holds")
        values = np.frombuffer(self.data, dtype, n, self.at)
        self.at += n * dtype.itemsize
        return values

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        name = self.data[self.at : end].decode("utf-8", "replace") if end >= 0 else ""
        self.at = end + 1 if end >= 0 else len(self.data)
        return name


def _binary_cameras(file: Path) -> Iterator[_Camera]:
    cursor = _Cursor(file)
    for _ in range(cursor.take("Q")[0]):
        number, model, w, h = cursor.take("iiQQ")
        if model not in _BINARY_LENSES:
            names = ", ".join(_BINARY_LENSES.values())
            raise FormatError(file, f"model of camera {number}", model, f"{names} (undistort the images first)")
        name = _BINARY_LENSES[model]
        yield number, name, (w, h), cursor.take(f"{2 + sum(COLMAP_LENSES[name])}d")


def _binary_images(file: Path) -> Iterator[_Image]:
    cursor, observation = _Cursor(file), np.dtype([("uv", "<f8", 2), ("point", "<i8")])
    for _ in range(cursor.take("Q")[0]):
        (image_id,) = cursor.take("I")
        pose = cursor.numbers(7)
        (camera_id,) = cursor.take("I")
        name = cursor.text()
        seen = cursor.array(observation, cursor.take("Q")[0])
        yield image_id, pose, camera_id, name, np.column_stack([seen["uv"], seen["point"]])
