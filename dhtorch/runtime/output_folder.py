"""Output folder of a command: one writer at a time, and a manifest of the files that dhtorch wrote there.

The private folder ``.dhtorch`` of an output folder holds the lock, the manifest and unfinished files. A file is
dhtorch's own if the manifest lists its path with its content; only such files are replaced or removed. A link on the
way to a file, or another file under its name, stops the command. The entry of a file is written before the file gets
its name, and the system releases the lock of a process that ends, so a killed process leaves nothing that the next run
cannot identify. Everything in the private folder is dhtorch's own.

:mod:`dhtorch.runtime.storage` consults the open folder for every file that it writes.
"""

import contextlib
import errno
import json
import os
import socket
import stat
import time
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from types import ModuleType

from dhtorch.runtime.safe_open import MAX_TEXT_BYTES, describe_kind, read_bytes

fcntl: ModuleType | None
try:
    import fcntl
except ImportError:  # not on this system: no locking
    fcntl = None

#: Name of the private folder.
PRIVATE_FOLDER = ".dhtorch"

#: Names in the private folder: lock, manifest, folder of unfinished files.
_LOCK, _MANIFEST, _UNFINISHED = "lock", "manifest", "unfinished"

#: Content of a file in the manifest: size in bytes, CRC-32, and CRC-32 of the first ``_HEAD_BYTES``.
_Identity = tuple[int, int, int]

#: Bytes at the beginning of a file by which a shortened one (lost end after a crash of the system) is recognised.
#: Source: derived, 64 = the PNG header and the first compressed bytes.
_HEAD_BYTES = 64

#: Identity of a file whose content another program writes: any content is dhtorch's own.
_ANY_CONTENT: _Identity = (-1, 0, 0)

#: Longest name of a file or folder. Source: NAME_MAX of Linux's and macOS's file systems, and of Windows.
_MAX_NAME_BYTES = 255

#: Suffix of a file while it is written beside its place; its name begins with a dot.
UNFINISHED_SUFFIX = ".tmp"


@dataclass(eq=False)
class OutputFolder:
    """An open output folder; made by :func:`open_output_folder`."""

    path: Path  # as the option gives it
    root: Path  # absolute
    option: str  # that names the folder, for messages
    private: Path
    only: Path | None = None  # the one file of a command whose output is a file
    is_unlisted: bool = False  # no manifest at the start: a new folder, or one of an older version
    _entries: dict[str, list[_Identity]] = field(default_factory=dict)
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
        # A file that is longer than all that dhtorch wrote is not read
        entries = self._entries.get(self._name(path), ())
        known = [each for each in entries if each == _ANY_CONTENT or each[0] >= status.st_size]
        if not known or not status.st_size or _ANY_CONTENT in known:
            return bool(known)
        size, _, head_crc = identity = _identify(path)
        return identity in known or any(_HEAD_BYTES <= size < n and head_crc == head for n, _, head in known)

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

    def record(self, path: Path, content: Path | None) -> None:
        """Enter ``path``, before it gets its name, with the content of a file, or, None, with any content."""
        name, identity = self._name(path), _ANY_CONTENT if content is None else _identify(content)
        known = self._entries.setdefault(name, [])
        if identity in known:
            return
        known.append(identity)
        line = (json.dumps([*identity, name]) + "\n").encode()
        if os.write(self._handle, line) < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.private / _MANIFEST))

    def adopt(self, paths: Iterable[Path]) -> None:
        """Enter existing files, written by an older version without a manifest; links are left out."""
        for path in paths:
            status = _read_status(path)
            if status is not None and stat.S_ISREG(status.st_mode) and not is_private(Path(self._name(path))):
                self.record(path, path)

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
        name = _find_relative_path(path, self.root)
        if name is None:
            raise ValueError(f"{path}: expected a path below {self.root}")
        return name.as_posix()

    def _open_manifest(self) -> None:
        """Read the manifest; lines that are not valid, as of a torn write, are left out."""
        path = self.private / _MANIFEST
        is_written = path.exists() and path.stat().st_size > 0
        text = read_bytes(path, MAX_TEXT_BYTES).decode("utf-8", "replace") if is_written else ""
        self.is_unlisted = not text
        for line in text.splitlines():
            with contextlib.suppress(ValueError, TypeError, RecursionError):
                size, crc, head_crc, name = json.loads(line)
                self._entries.setdefault(str(name), []).append((int(size), int(crc), int(head_crc)))
        self._handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        if text and not text.endswith("\n"):
            os.write(self._handle, b"\n")

    def _remove_unfinished(self) -> None:
        """Remove unfinished files of the private folder, left by a killed process; links are not followed."""
        unfinished = self.private / _UNFINISHED
        for place, _, names in os.walk(self.private):
            for name in names:
                if Path(place) == unfinished or is_unfinished(name):
                    Path(place, name).unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            unfinished.rmdir()


#: Locks held by this process, to which the system would grant a second lock.
_locked_paths: set[Path] = set()

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
                os.close(opened._handle)
                opened._remove_unfinished()
                if not opened._entries:
                    (home / _MANIFEST).unlink(missing_ok=True)
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
    if any(_find_relative_path(path, each.private) is not None for each in _open_folders):
        return None
    matches = [
        each
        for each in _open_folders
        if _find_relative_path(path, each.root) is not None and each.only in (None, path.absolute())
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
    entries = () if folder is None else folder._entries.get(folder._name(path), ())
    is_as_long = any(each == _ANY_CONTENT or each[0] == status.st_size for each in entries)
    return folder is None or not entries or is_as_long or not folder.owns(path)


def is_unfinished(name: str) -> bool:
    """Whether a file of this name is one that was being written beside its place."""
    return name.startswith(".") and name.endswith(UNFINISHED_SUFFIX)


def is_private(path: Path) -> bool:
    """Whether a path leads into a private folder of dhtorch: its files are neither results nor data."""
    return any(part.startswith(".") and part.endswith(PRIVATE_FOLDER) for part in path.parts)


def _find_relative_path(path: Path, root: Path) -> Path | None:
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


def _identify(path: Path) -> _Identity:
    """Identity of the file at ``path``."""
    size = crc = head_crc = 0
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            head_crc = head_crc if size else zlib.crc32(block[:_HEAD_BYTES])
            size += len(block)
            crc = zlib.crc32(block, crc)
    return size, crc, head_crc


@contextlib.contextmanager
def acquire_file_lock(file: str | Path, what: str) -> Iterator[None]:
    """Context that holds the lock ``file``, which is removed at the end.

    The operating system holds the lock (fcntl) and releases it when the owner ends, however it ends. The content of
    the file (process, host, time) only serves the error message.

    Args:
        file: lock file; its folder is created if missing.
        what: option and folder, for the error message.

    Raises:
        BlockingIOError: another process holds the lock; the message names it and for how long.
    """
    path = Path(file).absolute()
    if fcntl is None:
        yield
        return
    if path in _locked_paths:
        raise BlockingIOError(f"{what}: found this process already writing there, expected one writer")
    handle = _open_locked(path, what)
    _locked_paths.add(path)
    try:
        owner = {"process": os.getpid(), "host": socket.gethostname(), "since": time.time()}
        os.write(handle, json.dumps(owner).encode())
        yield
    finally:
        _locked_paths.discard(path)
        path.unlink(missing_ok=True)  # before release, so that no newer lock file is removed
        os.close(handle)


def _open_locked(path: Path, what: str) -> int:
    """Open and lock the file at ``path`` -> descriptor; retries if the file was replaced meanwhile."""
    assert fcntl is not None
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        except FileNotFoundError:  # its owner removed the folder meanwhile
            continue
        try:
            fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.exists() and path.stat().st_ino == os.fstat(handle).st_ino:
                os.truncate(handle, 0)  # content left by a dead owner
                return handle
        except BlockingIOError:
            owner = "another dhtorch process"
            with contextlib.suppress(ValueError, KeyError, TypeError, OverflowError, RecursionError):
                record = json.loads(os.pread(handle, 1000, 0).decode())
                age = max(0, round(time.time() - float(record["since"])))
                host = " ".join(str(record["host"]).split())
                owner += f" ({int(record['process'])} on {host}, for {age} s)"
            os.close(handle)
            raise BlockingIOError(f"{what}: found {owner} writing there, expected one writer at a time") from None
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)  # its owner removed it meanwhile
