"""Output folder of a command: one writer at a time, and a manifest of the files that dhtorch wrote there.

The private folder ``.dhtorch`` of an output folder holds the lock, the manifest and unfinished files. A file is
dhtorch's own if the manifest lists its path with its content; only such files are replaced or removed. A link on the
way to a file, or another file under its name, stops the command. The entry of a file is written before the file gets
its name, and the system releases the lock of a process that ends, so a killed process leaves nothing that the next run
cannot identify. Everything in the private folder is dhtorch's own.

:mod:`dhtorch.runtime.storage` consults the open folder for every file that it writes.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import stat
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import NamedTuple

from dhtorch.runtime.file_lock import acquire_file_lock
from dhtorch.runtime.safe_open import MAX_TEXT_BYTES, describe_kind, read_bytes

#: Name of the private folder.
PRIVATE_FOLDER = ".dhtorch"

#: Names in the private folder: lock, manifest, folder of unfinished files.
_LOCK, _MANIFEST, _UNFINISHED = "lock", "manifest", "unfinished"

#: Bytes at the beginning of a file by which a shortened one (lost end after a crash of the system) is recognised.
#: Source: derived, 64 = the PNG header and the first compressed bytes.
_HEAD_BYTES = 64

#: Bytes read at a time. Source: chosen on no data, any size reads equally fast.
_BLOCK_BYTES = 1 << 20

#: Size in the manifest of a file whose content another program writes: any content is dhtorch's own.
_ANY_SIZE = -1

#: Longest name of a file or folder. Source: NAME_MAX of Linux's and macOS's file systems, and of Windows.
_MAX_NAME_BYTES = 255

#: Suffix of a file while it is written beside its place; its name begins with a dot.
UNFINISHED_SUFFIX = ".tmp"


class FileIdentity(NamedTuple):
    """What identifies the content of a file: size, CRC-32, and CRC-32 of its first bytes."""

    size: int  # bytes
    crc: int
    head_crc: int

    @classmethod
    def of(cls, path: Path) -> FileIdentity:
        """Identity of the file at ``path``."""
        size = crc = head_crc = 0
        with path.open("rb") as file:
            while block := file.read(_BLOCK_BYTES):
                if not size:
                    head_crc = zlib.crc32(block[:_HEAD_BYTES])
                size += len(block)
                crc = zlib.crc32(block, crc)
        return cls(size, crc, head_crc)

    def covers(self, other: FileIdentity) -> bool:
        """Whether a file of the identity ``other`` is this file, or this file without its end."""
        if self.size == _ANY_SIZE or other.size == 0:
            return True
        is_shortened = _HEAD_BYTES <= other.size < self.size and other.head_crc == self.head_crc
        return is_shortened or self == other


@dataclass(eq=False)
class OutputFolder:
    """An open output folder; made by :func:`open_output_folder`."""

    path: Path  # as the option gives it
    root: Path  # absolute
    option: str  # that names the folder, for messages
    private: Path
    only: Path | None = None  # the one file of a command whose output is a file
    is_unlisted: bool = False  # no manifest at the start: a new folder, or one of an older version
    _entries: dict[str, list[FileIdentity]] = field(default_factory=dict)
    _handle: int = -1  # of the manifest
    _numbers: Iterator[int] = field(default_factory=count)

    def check(self, paths: Iterable[Path]) -> None:
        """Raise an error unless each of ``paths``, below the folder, is free or holds a file that dhtorch wrote.

        Raises:
            FileExistsError: the first link, foreign file or folder on the way to one of them.
            OSError: the first name that is too long for the file system.
        """
        checked: set[Path] = set()
        for path in paths:
            self._check_parents(path, checked)
            status = _read_status(path)
            if status is None:
                continue
            if not stat.S_ISREG(status.st_mode):
                self._refuse(path, "a link" if stat.S_ISLNK(status.st_mode) else "a folder or device")
            if not self.owns(path):
                what = "was changed since dhtorch wrote it" if self.lists(path) else "dhtorch did not write"
                self._refuse(path, f"a file that {what}")

    def check_folders(self, folders: Iterable[Path]) -> None:
        """Raise an error unless each of ``folders``, below the folder, is free or a folder that no link leads to.

        Raises:
            FileExistsError: the first link or file on the way.
            OSError: the first name that is too long for the file system.
        """
        checked: set[Path] = set()
        for folder in folders:
            self._check_parents(folder / "x", checked)

    def lists(self, path: Path) -> bool:
        """Whether the manifest lists ``path``."""
        return self._name(path) in self._entries

    def owns(self, path: Path) -> bool:
        """Whether the regular file at ``path`` is as dhtorch wrote it; false for any other path."""
        status = _read_status(path)
        if status is None or not stat.S_ISREG(status.st_mode):
            return False
        known = self._entries.get(self._name(path), ())
        entries = [each for each in known if each.size == _ANY_SIZE or each.size >= status.st_size]
        if not entries:
            return False
        identity = FileIdentity.of(path)
        return any(entry.covers(identity) for entry in entries)

    def is_shortened(self, path: Path, size: int) -> bool:
        """Whether the file of ``size`` bytes at ``path`` is one that dhtorch wrote, without its end."""
        sizes = {entry.size for entry in self._entries.get(self._name(path), ())}
        return bool(sizes) and not sizes & {size, _ANY_SIZE} and self.owns(path)

    def remove(self, path: Path) -> bool:
        """Remove the file at ``path`` if dhtorch wrote it and no link leads there -> whether it was removed."""
        try:
            self._check_parents(path, set())
        except FileExistsError:
            return False
        is_own = self.owns(path)
        if is_own:
            path.unlink()
        return is_own

    def record(self, path: Path, unfinished: Path) -> None:
        """Enter the file ``unfinished`` in the manifest under its future name ``path``."""
        self._add([(path, FileIdentity.of(unfinished))])

    def claim(self, path: Path) -> None:
        """Enter ``path``, which another program writes for the command, with any content.

        Raises:
            FileExistsError: a link or a foreign file is there.
        """
        self.check([path])
        self._add([(path, FileIdentity(_ANY_SIZE, 0, 0))])

    def adopt(self, paths: Iterable[Path]) -> None:
        """Enter existing files, written by an older version without a manifest; links are left out."""
        regular = [path for path in paths if stat.S_ISREG(getattr(_read_status(path), "st_mode", 0))]
        self._add([(path, FileIdentity.of(path)) for path in regular if not is_private(Path(self._name(path)))])

    def new_unfinished(self, suffix: str) -> Path:
        """Path for a file while it is written; such files of a killed process are removed by the next one."""
        folder = self.private / _UNFINISHED
        folder.mkdir(exist_ok=True)
        return folder / f"{next(self._numbers)}{suffix}"

    def _check_parents(self, path: Path, checked: set[Path]) -> None:
        """Raise FileExistsError for a link or file among the folders between the root and ``path``, OSError for a name
        that is too long."""
        parent = self.root
        *folders, name = Path(self._name(path)).parts
        for part in (*folders, name):
            if (n_bytes := len(os.fsencode(part))) > _MAX_NAME_BYTES:
                reason = f"{os.strerror(errno.ENAMETOOLONG)} ({n_bytes} bytes, at most {_MAX_NAME_BYTES})"
                raise OSError(errno.ENAMETOOLONG, reason, f"{self.option}: {path}")
        for part in folders:
            parent = parent / part
            if parent in checked:
                continue
            status = _read_status(parent)
            if status is None:
                return
            if not stat.S_ISDIR(status.st_mode):
                self._refuse(parent, "a link" if stat.S_ISLNK(status.st_mode) else "a file, where a folder is needed")
            checked.add(parent)

    def _refuse(self, path: Path, what: str) -> None:
        remedy = f"remove or rename it, or set another {self.option}"
        raise FileExistsError(f"{self.option}: found {path}, {what}, expected none: {remedy}")

    def _name(self, path: Path) -> str:
        """Path relative to the root."""
        name = find_relative_path(path, self.root)
        if name is None:
            raise ValueError(f"{path}: expected a path below {self.root}")
        return name.as_posix()

    def _add(self, entries: Iterable[tuple[Path, FileIdentity]]) -> None:
        lines = []
        for path, identity in entries:
            known = self._entries.setdefault(self._name(path), [])
            if identity not in known:
                known.append(identity)
                lines.append(json.dumps([*identity, self._name(path)]) + "\n")
        content = "".join(lines).encode()
        if content and os.write(self._handle, content) < len(content):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.private / _MANIFEST))

    def _open_manifest(self) -> None:
        """Read the manifest; lines that are not valid, as of a torn write, are left out."""
        path = self.private / _MANIFEST
        is_written = path.exists() and path.stat().st_size > 0
        text = read_bytes(path, MAX_TEXT_BYTES).decode("utf-8", "replace") if is_written else ""
        self.is_unlisted = not text
        for line in text.splitlines():
            with contextlib.suppress(ValueError, TypeError, RecursionError):
                *numbers, name = json.loads(line)
                size, crc, head_crc = (int(x) for x in numbers)
                self._entries.setdefault(str(name), []).append(FileIdentity(size, crc, head_crc))
        self._handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        if text and not text.endswith("\n"):
            os.write(self._handle, b"\n")

    def _close(self) -> None:
        os.close(self._handle)
        self._remove_unfinished()
        if not self._entries:
            (self.private / _MANIFEST).unlink(missing_ok=True)

    def _remove_unfinished(self) -> None:
        """Remove unfinished files of the private folder, left by a killed process; links are not followed."""
        unfinished = self.private / _UNFINISHED
        for place, _, names in os.walk(self.private):
            for name in names:
                if Path(place) == unfinished or is_unfinished(name):
                    Path(place, name).unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            unfinished.rmdir()


#: Folders that this process has open, in the order of opening.
_open_folders: list[OutputFolder] = []


@contextlib.contextmanager
def open_output_folder(
    folder: str | Path, option: str, *, private: str = PRIVATE_FOLDER, only: Path | None = None
) -> Iterator[OutputFolder]:
    """Context with an output folder, which no other process can open meanwhile; created if missing.

    A folder that this process has open already is passed on. At the end a folder in which nothing was written is
    removed, if it was created here.

    Args:
        folder: the folder; it may itself be a link to a folder.
        option: name of the option that gives it, for messages.
        private, only: see :func:`open_output_file`.

    Raises:
        BlockingIOError: another process has it open; the message names folder and process.
        FileExistsError: a link or file is where the private folder must be.
        NotADirectoryError: ``folder`` is a file.
        OSError: it cannot be written.
    """
    path = Path(folder).expanduser()
    root = path.absolute()
    home = root / private
    inside = next((each for each in _open_folders if each.private.resolve() == home.resolve()), None)
    if inside is not None:
        yield inside
        return
    if (root.exists() or root.is_symlink()) and not root.is_dir():
        what = "a file" if root.exists() else "a link to nothing"
        raise NotADirectoryError(f"{option}: {path} is {what}, expected a folder or a new path")
    is_new = not root.exists()
    opened = OutputFolder(path, root, option, home, only)
    opened.check_folders([home])
    try:
        home.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
    for name, kind in ((_LOCK, stat.S_IFREG), (_MANIFEST, stat.S_IFREG), (_UNFINISHED, stat.S_IFDIR)):
        status = _read_status(home / name)
        if status is not None and stat.S_IFMT(status.st_mode) != kind:
            what = f"{describe_kind(status.st_mode)}, expected dhtorch's own {describe_kind(kind)[2:]}"
            raise FileExistsError(f"{option}: found {home / name}, {what}; remove it")
    try:
        with acquire_file_lock(home / _LOCK, f"{option}: {path if only is None else only}"):
            opened._remove_unfinished()
            opened._open_manifest()
            _open_folders.append(opened)
            try:
                yield opened
            finally:
                _open_folders.remove(opened)
                opened._close()
    finally:
        with contextlib.suppress(OSError):  # not empty: files were written, or another process has it open
            home.rmdir()
            if is_new:
                root.rmdir()


@contextlib.contextmanager
def open_output_file(file: str | Path, option: str) -> Iterator[OutputFolder]:
    """Context with the folder of a command whose output is one file, checked.

    The private folder belongs to the file (``.NAME.dhtorch``), unless the file lies in an output folder of dhtorch.

    Raises:
        FileExistsError: a link or a foreign file is under the file's name.
        OSError: as :func:`open_output_folder`.
    """
    file = Path(file).expanduser().absolute()
    is_inside = (file.parent / PRIVATE_FOLDER).is_dir()
    options = {} if is_inside else {"private": f".{file.name}{PRIVATE_FOLDER}", "only": file}
    with open_output_folder(file.parent, option, **options) as folder:  # type: ignore[arg-type]
        folder.check([file])
        yield folder


def find_output_folder(path: Path) -> OutputFolder | None:
    """The innermost open folder to which a file belongs; None for private files and outside of all."""
    if any(find_relative_path(path, each.private) is not None for each in _open_folders):
        return None
    matches = [
        each
        for each in _open_folders
        if find_relative_path(path, each.root) is not None and each.only in (None, path.absolute())
    ]
    return max(matches, key=lambda each: len(each.root.parts), default=None)


def is_whole(path: Path) -> bool:
    """Whether there is a file with content at ``path`` that is no shortened file of the open folder it belongs to.

    An empty or shortened output, as a crash of the system leaves it, counts as missing: it is written again. A file
    that someone changed otherwise is whole.
    """
    try:
        status = path.stat()
    except OSError:
        return False
    if not stat.S_ISREG(status.st_mode) or not status.st_size:
        return False
    folder = find_output_folder(path)
    return folder is None or not folder.is_shortened(path, status.st_size)


def is_unfinished(name: str) -> bool:
    """Whether a file of this name is one that was being written beside its place."""
    return name.startswith(".") and name.endswith(UNFINISHED_SUFFIX)


def is_private(path: Path) -> bool:
    """Whether a path leads into a private folder of dhtorch: its files are neither results nor data."""
    return any(part.startswith(".") and part.endswith(PRIVATE_FOLDER) for part in path.parts)


def find_relative_path(path: Path, root: Path) -> Path | None:
    """Path relative to ``root`` (absolute), as written or with links resolved; None = not below ``root``."""
    absolute = path.absolute()
    if absolute.is_relative_to(root) and ".." not in (name := absolute.relative_to(root)).parts:
        return name
    start = root.resolve()
    place = absolute.parent.resolve() / absolute.name
    return place.relative_to(start) if place.is_relative_to(start) else None


def _read_status(path: Path) -> os.stat_result | None:
    """Status of a path itself, not of what a link leads to; None = nothing is there."""
    try:
        return path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return None
