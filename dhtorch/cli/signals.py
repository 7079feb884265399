"""SIGTERM and SIGHUP end the command like Ctrl-C, with exit code 128 + signal number.

A killed process cannot end its workers: a worker watches its parent, see :mod:`dhtorch.runtime.parent_watch`.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType

#: Signals that end the command with clean-up.
_TERMINATION_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


class ReceivedSignal:
    """The signal that ended a call, if any."""

    number: int | None = None

    def code(self, otherwise: int) -> int:
        """Exit code 128 + signal number, as a shell reports it; ``otherwise`` without a signal."""
        return otherwise if self.number is None else 128 + self.number


@contextlib.contextmanager
def catch_termination() -> Iterator[ReceivedSignal]:
    """Context in which the first SIGTERM or SIGHUP raises KeyboardInterrupt; later ones do not interrupt the clean-up.

    Signals that are ignored stay ignored (``nohup``); outside the main thread no handler is installed.
    """
    received = ReceivedSignal()

    def handle(number: int, _frame: FrameType | None) -> None:
        if received.number is None:
            received.number = number
            raise KeyboardInterrupt

    old_handlers = {}
    if threading.current_thread() is threading.main_thread():
        old_handlers = {
            n: signal.signal(n, handle) for n in _TERMINATION_SIGNALS if signal.getsignal(n) is not signal.SIG_IGN
        }
    try:
        yield received
    finally:
        if received.number is not None:
            _shutdown_worker_pool()
        for number, handler in old_handlers.items():
            signal.signal(number, handler)


def _shutdown_worker_pool() -> None:
    """End the worker processes of joblib's launcher, if any: they outlive a call."""
    pool = sys.modules.get("joblib.externals.loky.reusable_executor")
    executor = getattr(pool, "_executor", None)
    if executor is not None:
        executor.shutdown(wait=True, kill_workers=True)
