"""One writer for a folder: a file beside its content that says who writes there, and that nobody forgets.

The system holds the lock, not the file: it ends with its owner, however that ended, so that a dead owner blocks nobody.
What stands in the file is for the message.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from dhtorch.runtime.storage import dump_strict_json, parse_strict_json

fcntl: ModuleType | None
try:
    import fcntl
except ImportError:  # not on this system: nothing is locked there
    fcntl = None

#: Locks of this process: the system would give it a second one.
_held_locks: set[Path] = set()


@contextlib.contextmanager
def acquire_file_lock(file: str | Path, what: str) -> Iterator[None]:
    """Meanwhile this process alone writes what ``file`` stands for. The file is gone afterwards.

    Args:
        file: of the lock; its folder is made where it is missing.
        what: the option and the folder that it names, for the message.

    Raises:
        BlockingIOError: another process holds it; the message names that and since when.
    """
    path = Path(file).absolute()
    if fcntl is None:
        yield
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    if path in _held_locks:
        raise BlockingIOError(f"{what}: found this process writing there already, expected one writer")
    handle = _open_locked(path, what)
    _held_locks.add(path)
    try:
        os.write(
            handle,
            dump_strict_json({"process": os.getpid(), "host": socket.gethostname(), "since": time.time()}).encode(),
        )
        yield
    finally:
        _held_locks.discard(path)
        path.unlink(missing_ok=True)  # before it is let go, so that nobody's newer file is removed
        os.close(handle)


def _open_locked(path: Path, what: str) -> int:
    """An open, locked file that still stands at ``path``."""
    assert fcntl is not None
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.exists() and path.stat().st_ino == os.fstat(handle).st_ino:
                os.truncate(handle, 0)  # what a dead owner said of itself
                return handle
        except BlockingIOError:
            owner = _describe_owner(os.pread(handle, 1000, 0))
            os.close(handle)
            raise BlockingIOError(f"{what}: found {owner} writing there, expected one writer at a time") from None
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)  # its owner removed it meanwhile


def _describe_owner(text: bytes) -> str:
    try:
        said = parse_strict_json(text.decode())
        age = max(0, round(time.time() - float(said["since"])))
        return f"process {int(said['process'])} on {said['host']} (for {age} s)"
    except (ValueError, KeyError, TypeError):
        return "another process"
