"""How the command ends when it is told to: SIGTERM and SIGHUP as Ctrl-C, with the exit code that says so.

Whoever is killed cannot tell its workers. So a worker watches who started it: see :mod:`dhtorch.runtime.parent_watch`.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType

#: Signals that end the command in order.
_TERMINATION_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


class ReceivedSignal:
    """The signal that ended a call, if any."""

    number: int | None = None

    def code(self, otherwise: int) -> int:
        """Exit code: 128 and the number of the signal, as a shell would report it."""
        return otherwise if self.number is None else 128 + self.number


@contextlib.contextmanager
def catch_termination() -> Iterator[ReceivedSignal]:
    """Meanwhile the first SIGTERM or SIGHUP raises KeyboardInterrupt; further ones do not disturb the tidying up.

    A signal that the caller ignores stays ignored (``nohup``); outside the main thread nothing is changed.
    """
    told = ReceivedSignal()

    def tell(number: int, _frame: FrameType | None) -> None:
        if told.number is None:
            told.number = number
            raise KeyboardInterrupt

    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {n: signal.signal(n, tell) for n in _TERMINATION_SIGNALS if signal.getsignal(n) is not signal.SIG_IGN}
    try:
        yield told
    finally:
        if told.number is not None:
            _shutdown_worker_pool()
        for number, handler in before.items():
            signal.signal(number, handler)


def _shutdown_worker_pool() -> None:
    """End the processes of joblib's launcher, where there are any: they outlive a call."""
    pool = sys.modules.get("joblib.externals.loky.reusable_executor")
    executor = getattr(pool, "_executor", None)
    if executor is not None:
        executor.shutdown(wait=True, kill_workers=True)
