"""Codec of HDF5: arrays of numbers, read one row at a time.

Shape, type and storage of an array are checked first. References out of the file (soft and external links, external
storage, virtual arrays) and filters that need a plug-in are refused.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dhtorch.data.io.decode import FormatError, import_optional
from dhtorch.runtime.safe_open import (
    MAX_FILE_BYTES,
    MAX_TEXT_BYTES,
    check_memory,
    check_regular_file,
    open_regular,
    unreadable_error,
)

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_FILTERS = {"gzip", "lzf", "shuffle", "fletcher32"}  # built into the library
_MAX_NAMES = 10_000


class Hdf5Array(NamedTuple):
    """An array in an HDF5 file: its key (names of groups and of the array, joined by ``/``), shape and type."""

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
        return self._read(i)

    def values(self) -> np.ndarray:
        """All entries of a small array, such as the poses of an episode.

        Raises:
            FormatError: beyond the memory limit, or as :meth:`row`.
        """
        size = math.prod(self.shape) * self.dtype.itemsize
        check_memory(self.file, self.key, size, f"an array of {self.shape}")
        return self._read(())

    def _read(self, index: int | tuple[()]) -> np.ndarray:
        with _open_hdf5(self.file) as group:
            array = _check_array(group, self.key, self.file)
            if array.shape != self.shape or array.dtype != self.dtype:
                problem = f"{array.dtype} of {array.shape}"
                raise FormatError(self.file, self.key, problem, f"{self.dtype} of {self.shape}")
            return np.asarray(array[index])


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


def list_hdf5_group(file: Path, path: str = "") -> dict[str, Hdf5Array | None]:
    """Name → array, or None for a group, of the group ``path``; entries of other kinds are left out.

    Raises:
        FormatError: missing or damaged file, or a link on the way.
        ImportError: no decoder is installed.
    """
    library = import_optional("h5py")
    with _open_hdf5(file) as root:
        group = _walk(root, path, file)
        if not isinstance(group, library.Group):
            raise FormatError(file, path or "/", "no group", "a group")
        if len(group) > _MAX_NAMES:
            raise FormatError(file, f"{path}/ names", f"{len(group)}", f"at most {_MAX_NAMES}")
        entries: dict[str, Hdf5Array | None] = {}
        for name in group:
            if not isinstance(group.get(name, getlink=True), library.HardLink):
                continue
            kind = group.get(name, getclass=True)
            if kind is library.Group:
                entries[name] = None
            elif kind is library.Dataset and group[name].dtype.kind in "fiu" and group[name].shape:
                key = f"{path}/{name}".lstrip("/")
                array = _check_array(root, key, file)
                entries[name] = Hdf5Array(file, key, array.shape, array.dtype)
        return entries


def read_hdf5_text(file: Path, path: str, attribute: str) -> str | None:
    """A text attribute of the group ``path``; None where there is none.

    Raises:
        FormatError: missing or damaged file, a link on the way, or no text.
    """
    with _open_hdf5(file) as root:
        attributes = _walk(root, path, file).attrs
        if attribute not in attributes:
            return None
        if (size := attributes.get_id(attribute).get_storage_size()) > MAX_TEXT_BYTES:
            raise FormatError(file, attribute, f"{size} bytes", f"at most {MAX_TEXT_BYTES}")
        value = attributes[attribute]
    text = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
    if not isinstance(text, str):
        raise FormatError(file, attribute, type(value).__name__, "a text")
    return text


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


def _walk(root: Any, path: str, file: Path) -> Any:
    """The entry at a path of names, reached without links to elsewhere."""
    library = import_optional("h5py")
    entry = root
    for name in filter(None, path.split("/")):
        link = entry.get(name, getlink=True) if isinstance(entry, library.Group) else None
        if not isinstance(link, library.HardLink):
            raise FormatError(file, path, "nothing" if link is None else "a link", "an entry of this file")
        entry = entry[name]
    return entry


def _check_array(group: Any, key: str, file: Path) -> Any:
    """The array ``key``, checked: numbers, stored in this file, with rows that fit into memory."""
    library = import_optional("h5py")
    array = _walk(group, key, file)
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
