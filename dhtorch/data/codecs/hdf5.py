"""Codec of HDF5: arrays of numbers, read one row at a time.

Shape, type and storage of an array are checked first. References out of the file (soft and external links, external
storage, virtual arrays) and filters that need a plug-in are refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dhtorch.data.io.decode import MAX_FILE_BYTES, FormatError, import_optional
from dhtorch.data.io.safe_open import check_regular_file, open_regular, unreadable_error

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_FILTERS = {"gzip", "lzf", "shuffle", "fletcher32"}  # built into the library
_MAX_NAMES = 10_000


class Hdf5Array(NamedTuple):
    """An array in an HDF5 file: its key, shape and type."""

    file: Path
    key: str
    shape: tuple[int, ...]
    dtype: np.dtype

    def row(self, i: int) -> np.ndarray:
        """Entry ``i`` of the first axis, as stored.

        Raises:
            FormatError: the file has changed or its data is damaged.
            IndexError: no such entry.
        """
        if not 0 <= i < self.shape[0]:
            raise IndexError(f"{self.file}: {self.key}: entry {i} of {self.shape[0]}")
        with _open_hdf5(self.file) as group:
            array = _check_array(group, self.key, self.file)
            if array.shape != self.shape or array.dtype != self.dtype:
                problem = f"{array.dtype} of {array.shape}"
                raise FormatError(self.file, self.key, problem, f"{self.dtype} of {self.shape}")
            return np.asarray(array[i])


def list_hdf5_arrays(file: Path) -> dict[str, Hdf5Array]:
    """Name → array, for the arrays of numbers at the top level of a file; reads no values.

    Raises:
        FormatError: missing or damaged file, an array stored in another file, or rows beyond ``MAX_FILE_BYTES``.
        ImportError: no decoder is installed.
    """
    with _open_hdf5(file) as group:
        if len(group) > _MAX_NAMES:
            raise FormatError(file, "names", f"{len(group)}", f"at most {_MAX_NAMES}")
        arrays = {}
        for key in group:
            array = _check_array(group, key, file)
            arrays[key] = Hdf5Array(file, key, array.shape, array.dtype)
        return arrays


@contextmanager
def _open_hdf5(file: Path) -> Iterator[Any]:
    library = import_optional("h5py")
    try:
        with open_regular(file) as stream:
            head = stream.read(len(_SIGNATURE))
    except OSError as error:
        raise unreadable_error(file, error) from None
    if head != _SIGNATURE:
        raise FormatError(file, "content", repr(head), "an HDF5 file")
    try:
        with library.File(file, "r") as group:
            yield group
    except (FormatError, IndexError):
        raise
    except Exception as error:  # any error of the library means damage
        raise FormatError(file, "data", error or type(error).__name__, "a whole HDF5 file") from None


def _check_array(group: Any, key: str, file: Path) -> Any:
    """The array ``key``, checked: numbers, stored in this file, with rows that fit into memory."""
    library = import_optional("h5py")
    if not isinstance(group.get(key, getlink=True), library.HardLink):
        raise FormatError(file, key, "a link", "an array in this file")
    array = group.get(key)
    if not isinstance(array, library.Dataset) or array.dtype.kind not in "fiu" or not array.shape:
        raise FormatError(file, key, type(array).__name__, "an array of numbers")
    if array.is_virtual or array.external:
        raise FormatError(file, key, "values in another file", "an array in this file")
    pipeline = array.id.get_create_plist()
    names = {1: "gzip", 2: "shuffle", 3: "fletcher32", 32000: "lzf"}
    filters = {names.get(pipeline.get_filter(i)[0], "unknown") for i in range(pipeline.get_nfilters())}
    if not filters <= _FILTERS:
        raise FormatError(file, f"{key} filters", ", ".join(sorted(filters)), ", ".join(sorted(_FILTERS)))
    if array.shape[0] > (size := check_regular_file(file)):
        raise FormatError(file, f"{key} size", f"{array.shape[0]} rows in {size} bytes", "at most one per byte")
    row = math.prod(array.shape[1:]) * array.dtype.itemsize
    chunk = math.prod(array.chunks or (1,)) * array.dtype.itemsize
    if max(row, chunk) > MAX_FILE_BYTES:
        raise FormatError(
            file, f"{key} size", f"rows of {row} and chunks of {chunk} bytes", f"at most {MAX_FILE_BYTES}"
        )
    return array
