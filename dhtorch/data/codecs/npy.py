"""Codec of ``.npy`` and ``.npz`` without pickled objects (for those see :mod:`dhtorch.data.codecs.pickles`).

The header is a Python expression, and numpy's parser of it is not written for damaged files: all its errors become
``FormatError`` here. An array's declared size is compared with its bytes.
"""

import io
import math
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from dhtorch.data.codecs.zips import check_zip_directory
from dhtorch.data.io.decode import FormatError, read_bytes
from dhtorch.runtime.safe_open import MAX_FILE_BYTES, check_memory, open_regular

#: Largest size of a header in bytes.
_MAX_HEADER_BYTES = 12_288


class _NpyHeader(NamedTuple):
    """Shape, order and type of an array, from its header."""

    shape: tuple[int, ...]
    fortran: bool  # first axis fastest
    dtype: np.dtype
    start: int  # offset of the values


def parse_npy_header(file: Path, field: str, head: bytes) -> _NpyHeader:
    """Header of an ``.npy`` file from its first bytes (12 KB suffice), for numbers, texts or pickled objects.

    Raises:
        FormatError: not such a header, or an invalid shape.
    """
    stream = io.BytesIO(head)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on headers written by Python 2
            version = np.lib.format.read_magic(stream)
            read_header = (
                np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            )
            shape, fortran, dtype = read_header(stream)
    except Exception as error:  # numpy's parser: its exceptions are not specified
        raise FormatError(file, field, f"{type(error).__name__} {error}", "a numpy array header") from None
    if len(shape) > 8 or any(type(n) is not int or not 0 <= n <= 2**40 for n in shape):
        raise FormatError(file, f"{field} shape", shape, "a few counts")
    return _NpyHeader(shape, bool(fortran), dtype, stream.tell())


def parse_real_npy_header(file: Path, field: str, head: bytes) -> _NpyHeader:
    """As :func:`parse_npy_header`, of real numbers only."""
    header = parse_npy_header(file, field, head)
    if header.dtype.kind not in "fiu" or header.dtype.hasobject:
        raise FormatError(file, f"{field} dtype", header.dtype, "real numbers")
    return header


def read_real_npy(file: Path, field: str) -> np.ndarray:
    """Array of real numbers in an ``.npy`` file as floating point; pickled objects are refused.

    Raises:
        FormatError: missing file, damaged header, not numeric, or another number of bytes than the header claims.
    """
    return _decode_real_npy(file, field, read_bytes(file))


def _decode_real_npy(file: Path, field: str, raw: bytes) -> np.ndarray:
    """The bytes of an ``.npy`` file of real numbers as floating point.

    Raises:
        FormatError: as :func:`parse_real_npy_header`, or another number of bytes than in the header.
    """
    header = parse_real_npy_header(file, field, raw)
    count, left = math.prod(header.shape), len(raw) - header.start
    if count * header.dtype.itemsize != left:
        raise FormatError(file, field, f"{left} bytes", f"{header.shape} of {header.dtype}")
    array = np.frombuffer(raw, header.dtype, count, header.start)
    array = array.reshape(header.shape, order="F" if header.fortran else "C")
    return array.astype(_smallest_float_dtype(header.dtype))


def _smallest_float_dtype(dtype: np.dtype) -> type[np.floating]:
    """The smallest floating-point type that represents all values exactly."""
    exact = dtype.itemsize <= (4 if dtype.kind == "f" else 2)
    return np.float32 if exact else np.float64


def list_npz_members(file: Path) -> list[str]:
    """Names of the members of an ``.npz`` archive, in its order.

    Raises:
        FormatError: missing or damaged archive.
    """
    with open_regular(file) as stream:
        check_zip_directory(stream, file)
        with _open_archive(stream, file) as archive:
            return archive.namelist()


def list_npz(file: Path) -> set[str]:
    """Names of the arrays of an ``.npz`` archive, after checking the memory that all of them take together.

    Raises:
        FormatError: missing or damaged archive, or larger than the memory limit allows.
    """
    with open_regular(file) as stream:
        check_zip_directory(stream, file)
        with _open_archive(stream, file) as archive:
            size = sum(member.file_size for member in archive.infolist())
            check_memory(file, "arrays", size, f"{size} bytes unpacked", file.stat().st_size)
            return {name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")}


@contextmanager
def _open_archive(stream: BinaryIO, file: Path) -> Iterator[zipfile.ZipFile]:
    """The archive of a stream, with its errors as FormatError."""
    try:
        with zipfile.ZipFile(stream) as archive:
            yield archive
    except FormatError:
        raise
    except (zipfile.BadZipFile, zlib.error, struct.error, ValueError, RuntimeError, EOFError, OSError) as error:
        raise FormatError(file, "archive", error, "a whole .npz archive") from None


def read_npz(file: Path, key: str) -> np.ndarray:
    """Array ``key`` of an ``.npz`` archive as floating point; pickled objects are refused.

    Raises:
        FormatError: missing or damaged archive, no such key, not numeric, or larger than declared or than
            ``MAX_FILE_BYTES``.
    """
    data = read_bytes(file)
    check_zip_directory(io.BytesIO(data), file)
    with _open_archive(io.BytesIO(data), file) as archive:
        names = archive.namelist()
        if f"{key}.npy" not in names:
            raise FormatError(file, "key", ", ".join(sorted(names)[:8]) or "nothing", f"{key}.npy")
        if (count := names.count(f"{key}.npy")) > 1:
            raise FormatError(file, "key", f"{count} members {key}.npy", "one")
        member = archive.getinfo(f"{key}.npy")
        if member.file_size > MAX_FILE_BYTES:
            raise FormatError(file, key, "an array that unpacks beyond the limit", f"at most {MAX_FILE_BYTES} bytes")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FormatError(file, key, f"compression {member.compress_type}", "none or deflate, as numpy writes")
        with archive.open(member) as stream:
            header = parse_real_npy_header(file, key, stream.read(_MAX_HEADER_BYTES))
        takes = member.file_size + math.prod(header.shape) * np.dtype(_smallest_float_dtype(header.dtype)).itemsize
        check_memory(file, key, takes, f"{header.shape} of {header.dtype}", len(data))
        raw = archive.read(member)
    return _decode_real_npy(file, key, raw)
