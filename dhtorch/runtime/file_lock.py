"""Exclusive lock on a folder by a lock file, so that one process writes to it.

The operating system holds the lock (fcntl) and releases it when the owner ends, however it ends. The content of the
file (process, host, time) only serves the error message.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

fcntl: ModuleType | None
try:
    import fcntl
except ImportError:  # not on this system: no locking
    fcntl = None

#: Locks held by this process, to which the system would grant a second lock.
_locked_paths: set[Path] = set()


@contextlib.contextmanager
def acquire_file_lock(file: str | Path, what: str) -> Iterator[None]:
    """Context that holds the lock ``file``; the file is removed at the end.

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
        os.write(
            handle,
            json.dumps({"process": os.getpid(), "host": socket.gethostname(), "since": time.time()}).encode(),
        )
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
            owner = _describe_owner(os.pread(handle, 1000, 0))
            os.close(handle)
            raise BlockingIOError(f"{what}: found {owner} writing there, expected one writer at a time") from None
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)  # its owner removed it meanwhile


def _describe_owner(text: bytes) -> str:
    try:
        record = json.loads(text.decode())
        age = max(0, round(time.time() - float(record["since"])))
        owner = f"another dhtorch process ({int(record['process'])} on {record['host']}, for {age} s)"
        return " ".join(owner.split())
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return "another dhtorch process"
