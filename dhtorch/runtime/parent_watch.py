"""Worker processes end with their parent, also where the parent was killed."""

import os
import threading
import time

#: Period of the check, s.
_POLL_PERIOD_S = 1.0

_watching_pids: set[int] = set()  # processes with a watching thread; a fork inherits the set but not the thread


def exit_with_parent() -> None:
    """End this worker process when its parent ends. A second call has no effect."""
    if os.getpid() in _watching_pids or not hasattr(os, "getppid"):
        return
    _watching_pids.add(os.getpid())
    threading.Thread(target=_wait_for_exit, args=(os.getppid(),), name="dhtorch-leash", daemon=True).start()


def _wait_for_exit(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL_PERIOD_S)
    os._exit(1)  # immediate: partial output is never a valid result
