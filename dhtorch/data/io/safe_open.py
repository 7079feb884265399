"""The doors that all readers go through, and the one error they raise.

:func:`open_regular` is the only way to a file's bytes: regular files alone, inside the capture. :func:`check_memory` is
the law of
memory: whoever is about to make much of few bytes asks first.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import BinaryIO

#: What opening a capture or reading one frame may take: so many bytes, or so many times what was asked for.
MAX_MEMORY_BYTES, MAX_MEMORY_RATIO = 256 << 20, 8


class FormatError(ValueError):
    """A file is not what its format promises: ``file: field: found …, expected …`` in one line.

    Survives pickling, so it arrives intact from a data-loader worker.
    """

    def __init__(self, file: str | Path, field: str = "", found: object = "", expected: object = "") -> None:
        super().__init__(str(file), field, _shorten(found), _shorten(expected, 400))

    def __str__(self) -> str:
        file, field, found, expected = self.args
        return f"{file}: {field}: found {found}, expected {expected}" if field else file


@contextmanager
def open_regular(file: Path) -> Iterator[BinaryIO]:
    """A file of a capture, open for reading: the only way to its bytes.

    Raises:
        FormatError: missing, unreadable, a pipe, socket, device or folder (which might never answer), or a link that
            leads out of the capture (see :func:`restrict_links`).
    """
    try:
        kind = file.stat().st_mode  # before it is opened: some devices act on that alone
        _check_link(file)
        if not stat.S_ISREG(kind):
            raise FormatError(file, "file", _FILE_KINDS.get(stat.S_IFMT(kind), "something else"), "a regular file")
        stream = os.fdopen(os.open(file, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)), "rb")
    except FormatError:
        raise
    except _OPEN_ERRORS as error:
        raise unreadable_error(file, error) from None
    with stream:
        yield stream


_FILE_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
}


def check_regular_file(file: Path) -> int:
    """Bytes of a file that a library will open by its name.

    Raises:
        FormatError: as :func:`open_regular`.
    """
    with open_regular(file) as stream:
        return os.fstat(stream.fileno()).st_size


#: The capture that is being read, and whether its links may lead out of it.
_restricted_root: ContextVar[Path | None] = ContextVar("capture", default=None)


@contextmanager
def restrict_links(root: Path | None) -> Iterator[None]:
    """Meanwhile links below ``root`` that lead out of it are refused; None: links are followed anywhere."""
    before = _restricted_root.set(root)
    try:
        yield
    finally:
        _restricted_root.reset(before)


def is_inside(file: Path, root: Path) -> bool:
    """Whether a file, wherever links lead, lies in a capture: a folder, or the folder of a file."""
    home = root.resolve()
    return file.resolve().is_relative_to(home.parent if root.is_file() else home)


def _check_link(file: Path) -> None:
    """Refuse a link that leads out of the capture that is being read."""
    root = _restricted_root.get()
    if root is None or not file.is_relative_to(root):
        return
    if not is_inside(file, root):
        raise FormatError(file, "link", "one that leads out of the capture", "a file inside (follow_links=true allows)")


def check_memory(file: Path, field: str, takes: int, found: object, asked: int = 0) -> None:
    """The law of memory: at most ``MAX_MEMORY_BYTES`` bytes, or ``MAX_MEMORY_RATIO`` times the bytes that were asked
    for.

    Args:
        file, field, found: for the error.
        takes: bytes that are about to be taken, by a bound that costs nothing.
        asked: bytes of the arrays asked for, of a shape that the file is long enough for.

    Raises:
        FormatError: more than that.
    """
    most = max(MAX_MEMORY_BYTES, MAX_MEMORY_RATIO * asked)
    if takes > most:
        raise FormatError(file, field, f"{found}: {takes} bytes of memory", f"at most {most}")


def modification_time_ns(file: Path) -> int:
    """When a file was changed last, ns: part of the key of whatever is kept of it in memory.

    Raises:
        FormatError: the file is missing or unreadable.
    """
    try:
        return file.stat().st_mtime_ns
    except _OPEN_ERRORS as error:
        raise unreadable_error(file, error) from None


#: What opening a file may raise; ValueError: a name that no file can have.
_OPEN_ERRORS = (OSError, ValueError)


def unreadable_error(file: Path, error: Exception) -> FormatError:
    """What to raise instead of ``error``, one of ``_OPEN_ERRORS``."""
    found = "no such file" if isinstance(error, FileNotFoundError) else error
    return FormatError(file, "file", found, "a readable file")


def _shorten(value: object, limit: int = 120) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= limit else text[: limit - 1] + "…"
