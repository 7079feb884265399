"""The doors that all readers go through, and the one error they raise.

:func:`opened` is the only way to a file's bytes: regular files alone, inside the capture. :func:`allow` is the law of
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
MAX_MEMORY, GROWTH = 256 << 20, 8


class FormatError(ValueError):
    """A file is not what its format promises: ``file: field: found …, expected …`` in one line.

    Survives pickling, so it arrives intact from a data-loader worker.
    """

    def __init__(self, file: str | Path, field: str = "", found: object = "", expected: object = "") -> None:
        super().__init__(str(file), field, _short(found), _short(expected, 400))

    def __str__(self) -> str:
        file, field, found, expected = self.args
        return f"{file}: {field}: found {found}, expected {expected}" if field else file


@contextmanager
def opened(file: Path) -> Iterator[BinaryIO]:
    """A file of a capture, open for reading: the only way to its bytes.

    Raises:
        FormatError: missing, unreadable, a pipe, socket, device or folder (which might never answer), or a link that
            leads out of the capture (see :func:`inside`).
    """
    try:
        kind = file.stat().st_mode  # before it is opened: some devices act on that alone
        _stay(file)
        if not stat.S_ISREG(kind):
            raise FormatError(file, "file", _KINDS.get(stat.S_IFMT(kind), "something else"), "a regular file")
        stream = os.fdopen(os.open(file, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)), "rb")
    except FormatError:
        raise
    except UNREADABLE as error:
        raise unreadable(file, error) from None
    with stream:
        yield stream


_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
}


def check_file(file: Path) -> int:
    """Bytes of a file that a library will open by its name.

    Raises:
        FormatError: as :func:`opened`.
    """
    with opened(file) as stream:
        return os.fstat(stream.fileno()).st_size


#: The capture that is being read, and whether its links may lead out of it.
_capture: ContextVar[Path | None] = ContextVar("capture", default=None)


@contextmanager
def inside(root: Path | None) -> Iterator[None]:
    """Meanwhile links below ``root`` that lead out of it are refused; None: links are followed anywhere."""
    before = _capture.set(root)
    try:
        yield
    finally:
        _capture.reset(before)


def lies_in(file: Path, root: Path) -> bool:
    """Whether a file, wherever links lead, lies in a capture: a folder, or the folder of a file."""
    home = root.resolve()
    return file.resolve().is_relative_to(home.parent if root.is_file() else home)


def _stay(file: Path) -> None:
    """Refuse a link that leads out of the capture that is being read."""
    root = _capture.get()
    if root is None or not file.is_relative_to(root):
        return
    if not lies_in(file, root):
        raise FormatError(file, "link", "one that leads out of the capture", "a file inside (follow_links=true allows)")


def allow(file: Path, field: str, takes: int, found: object, asked: int = 0) -> None:
    """The law of memory: at most ``MAX_MEMORY`` bytes, or ``GROWTH`` times the bytes that were asked for.

    Args:
        file, field, found: for the error.
        takes: bytes that are about to be taken, by a bound that costs nothing.
        asked: bytes of the arrays asked for, of a shape that the file is long enough for.

    Raises:
        FormatError: more than that.
    """
    most = max(MAX_MEMORY, GROWTH * asked)
    if takes > most:
        raise FormatError(file, field, f"{found}: {takes} bytes of memory", f"at most {most}")


def last_change(file: Path) -> int:
    """When a file was changed last, ns: part of the key of whatever is kept of it in memory.

    Raises:
        FormatError: the file is missing or unreadable.
    """
    try:
        return file.stat().st_mtime_ns
    except UNREADABLE as error:
        raise unreadable(file, error) from None


#: What opening a file may raise; ValueError: a name that no file can have.
UNREADABLE = (OSError, ValueError)


def unreadable(file: Path, error: Exception) -> FormatError:
    """What to raise instead of ``error``, one of ``UNREADABLE``."""
    found = "no such file" if isinstance(error, FileNotFoundError) else error
    return FormatError(file, "file", found, "a readable file")


def _short(value: object, limit: int = 120) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= limit else text[: limit - 1] + "…"
