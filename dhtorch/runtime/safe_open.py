"""Safe access to files for all readers: regular files inside the capture only, memory limits, and FormatError.

Readers open every file with :func:`open_regular`, or read it whole with :func:`read_bytes`, and call
:func:`check_memory` before decompressing or allocating memory whose size comes from a file, against decompression
bombs.
"""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import BinaryIO

#: Largest size in bytes of an array or a file that is read whole.
MAX_FILE_BYTES = 256_000_000
#: Largest size in bytes of a table or a JSON document.
MAX_TEXT_BYTES = 64_000_000

#: Memory in bytes that opening a capture or reading one frame may take, whatever the size of the result.
MAX_MEMORY_BYTES = 256 << 20

#: The same as a multiple of the bytes of the requested arrays; the larger of the two limits applies.
MAX_MEMORY_RATIO = 8


class FormatError(ValueError):
    """A file does not conform to its format: ``file: field: found …, expected …`` in one line.

    Picklable, so that it is passed on intact from a data-loader worker.
    """

    def __init__(self, file: str | Path, field: str = "", value: object = "", expected: object = "") -> None:
        super().__init__(str(file), field, _shorten(value), _shorten(expected, 400))

    def __str__(self) -> str:
        file, field, value, expected = self.args
        return f"{file}: {field}: found {value}, expected {expected}" if field else file


@contextmanager
def open_regular(file: Path) -> Iterator[BinaryIO]:
    """Open a file of a capture for reading, after checking that it is a regular file inside the capture.

    Raises:
        FormatError: missing, unreadable, a pipe, socket, device or folder (reading could block forever), or a link to
            outside the capture (see :func:`restrict_links`).
    """
    try:
        mode = file.stat().st_mode  # before opening: opening alone triggers some devices
        check_link(file)
        if not stat.S_ISREG(mode):
            raise FormatError(file, "file", describe_kind(mode), "a regular file")
        stream = os.fdopen(os.open(file, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)), "rb")
    except FormatError:
        raise
    except _OPEN_ERRORS as error:
        raise unreadable_error(file, error) from None
    if (opened := _opened_files.get()) is not None:
        opened.add(file)
    with stream:
        yield stream


_FILE_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
    stat.S_IFLNK: "a link",
    stat.S_IFREG: "a file",
}


def describe_kind(mode: int) -> str:
    """What a path is, of the mode in its status: a file, a folder, a pipe …"""
    return _FILE_KINDS.get(stat.S_IFMT(mode), "something else")


def check_file_or_folder(path: Path, expected: str) -> None:
    """Check that a path leads to a regular file or a folder, before anything looks inside.

    Raises:
        FormatError: nothing is there, or a pipe, socket or device; ``expected`` ends the message.
    """
    try:
        mode = path.stat().st_mode
    except _OPEN_ERRORS as error:
        reason = error if isinstance(error, PermissionError) else "no such file or folder"
        raise FormatError(path, "path", reason, expected) from None
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise FormatError(path, "path", describe_kind(mode), expected)


def read_bytes(file: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """All bytes of a file, at least one and at most ``limit``.

    Raises:
        FormatError: the file is missing, unreadable, no regular file, outside the capture, empty or too large.
    """
    with open_regular(file) as stream:
        size = os.fstat(stream.fileno()).st_size
        if not 0 < size <= limit:
            raise FormatError(file, "file size", f"{size} bytes", f"1 to {limit} bytes")
        try:
            return stream.read(size)  # of ``limit`` bytes a buffer would be allocated
        except OSError as error:
            raise unreadable_error(file, error) from None


def check_regular_file(file: Path) -> int:
    """Size in bytes of a file that a library will open by name, after the checks of :func:`open_regular`.

    Raises:
        FormatError: as :func:`open_regular`.
    """
    with open_regular(file) as stream:
        return os.fstat(stream.fileno()).st_size


#: Folder or file being read, whose links must not point outside it, and what it is; None = no restriction.
_restricted_root: ContextVar[tuple[Path, str] | None] = ContextVar("capture", default=None)


#: Files opened so far, where they are recorded; None = they are not.
_opened_files: ContextVar[set[Path] | None] = ContextVar("opened_files", default=None)


@contextmanager
def record_opened_files() -> Iterator[set[Path]]:
    """Context that collects the files which :func:`open_regular` opens in it."""
    opened = set[Path]()
    token = _opened_files.set(opened)
    try:
        yield opened
    finally:
        _opened_files.reset(token)


@contextmanager
def restrict_links(root: Path | None, what: str = "capture") -> Iterator[None]:
    """Context in which links below ``root``, a ``what``, that point outside it are refused; None = no restriction."""
    token = _restricted_root.set(None if root is None else (root, what))
    try:
        yield
    finally:
        _restricted_root.reset(token)


def is_inside(file: Path, root: Path) -> bool:
    """Whether a file, with links resolved, lies in the folder ``root``, or in that of the file ``root``."""
    folder = root.resolve()
    return file.resolve().is_relative_to(folder.parent if root.is_file() else folder)


def check_link(file: Path) -> None:
    """Raise FormatError for a link that points outside the capture being read (see :func:`restrict_links`)."""
    root, what = _restricted_root.get() or (None, "")
    if root is None or not file.is_relative_to(root):
        return
    if not is_inside(file, root):
        expected = "a file inside" + " (follow_links=true allows)" * (what == "capture")
        raise FormatError(file, "link", f"one to outside the {what}", expected)


def check_memory(file: Path, field: str, takes: int, value: object, requested: int = 0) -> None:
    """Raise if ``takes`` exceeds both ``MAX_MEMORY_BYTES`` and ``MAX_MEMORY_RATIO`` times the bytes ``requested`` for.

    Args:
        file, field, value: for the error.
        takes: upper bound of the bytes about to be allocated, computed without allocating them.
        requested: bytes of the requested arrays, of a shape that the file is long enough for.

    Raises:
        FormatError: the limit is exceeded.
    """
    limit = max(MAX_MEMORY_BYTES, MAX_MEMORY_RATIO * requested)
    if takes > limit:
        raise FormatError(file, field, f"{value}: {takes} bytes of memory", f"at most {limit}")


def read_file_version(path: Path) -> tuple[int, ...]:
    """Device, inode, size, time of modification and time of change (ns) of a file: a write gives another version.

    The time of change is the system's: no program can set it back, as it can that of modification (on Windows it is the
    time of creation). Two writes within one step of the file system's clock may give one version.
    """
    status = path.stat()
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def read_version(file: Path) -> tuple[int, ...]:
    """As :func:`read_file_version`, used as part of the key of caches of a file's content.

    Raises:
        FormatError: the file is missing or unreadable.
    """
    try:
        return read_file_version(file)
    except _OPEN_ERRORS as error:
        raise unreadable_error(file, error) from None


#: Errors raised on opening a file; ValueError: an invalid name.
_OPEN_ERRORS = (OSError, ValueError)


def unreadable_error(file: Path, error: Exception) -> FormatError:
    """The FormatError to raise instead of ``error``, one of ``_OPEN_ERRORS``."""
    reason = "no such file" if isinstance(error, FileNotFoundError) else error
    return FormatError(file, "file", reason, "a readable file")


def _shorten(value: object, limit: int = 120) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= limit else text[: limit - 1] + "…"
