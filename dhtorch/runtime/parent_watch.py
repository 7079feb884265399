"""Workers that end with the process that started them, even where that one was killed and could not tell them."""

from __future__ import annotations

import os
import threading
import time

#: Seconds between two looks.
_POLL_PERIOD_S = 1.0

_watching_pids: set[int] = set()  # processes that watch already: a fork inherits the note and not the thread


def exit_with_parent() -> None:
    """End this process at once when its parent is gone. Called in a worker; a second call changes nothing."""
    if os.getpid() in _watching_pids or not hasattr(os, "getppid"):
        return
    _watching_pids.add(os.getpid())
    threading.Thread(target=_wait_for_exit, args=(os.getppid(),), name="dhtorch-leash", daemon=True).start()


def _wait_for_exit(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL_PERIOD_S)
    os._exit(1)  # what is half written is no result, and nobody waits for one
