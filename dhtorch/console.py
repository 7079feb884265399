"""How the command speaks: progress, how much is said, and whose warnings are heard.

Three levels: ``quiet`` (results and errors), ``normal``, ``verbose`` (what is read and done, and when). The level
stands in the environment variable ``VERBOSITY``, so that the processes of a launcher have it, too.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

#: Flag → level.
FLAGS = {"-q": "quiet", "--quiet": "quiet", "-v": "verbose", "--verbose": "verbose"}
VERBOSITY = "DHTORCH_VERBOSITY"

#: Below the options of a sub-command that reads its own arguments.
EPILOG = (
    "-q says no more than what was asked for and -v what is read and done, as for every word of dhtorch. "
    "Exit code: 0 done, 2 bad option or bad data, 130 interrupted."
)


def progress(items: Iterable[Any], text: str, total: int) -> Iterator[Any]:
    """A progress bar with rate and time left on a terminal, nothing elsewhere."""
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn  # noqa: PLC0415

    columns = ("{task.description:24}", BarColumn(), MofNCompleteColumn(), "{task.fields[rate]}", TimeRemainingColumn())
    hidden = not sys.stderr.isatty() or verbosity() == "quiet"
    with Progress(*columns, console=Console(stderr=True), disable=hidden, transient=True) as bar:
        task = bar.add_task(text, total=total, rate="")
        for item in items:
            yield item
            speed = bar.tasks[task].speed
            bar.update(task, advance=1, rate=f"{speed:.1f}/s" if speed else "")


def verbosity() -> str:
    """quiet, normal or verbose."""
    return os.environ.get(VERBOSITY, "normal")


@contextlib.contextmanager
def speaking(flags: Sequence[str]) -> Iterator[None]:
    """Set how much is said for one call of the command and the processes it starts."""
    before = os.environ.get(VERBOSITY)
    if flags:
        os.environ[VERBOSITY] = FLAGS[flags[-1]]
    listen()
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(VERBOSITY, None)
        else:
            os.environ[VERBOSITY] = before
        listen()


def listen() -> None:
    """Debug messages of dhtorch go to stderr where much is to be said; nobody else's do."""
    logger = logging.getLogger("dhtorch")
    verbose = verbosity() == "verbose"
    for handler in [h for h in logger.handlers if h.get_name() == VERBOSITY]:
        logger.removeHandler(handler)
    for name, known in logging.root.manager.loggerDict.items():
        if name.startswith("dhtorch") and isinstance(known, logging.Logger):
            known.disabled = False  # Hydra's own set-up silences whatever logger is there before it
    logger.setLevel(logging.DEBUG if verbose else logging.NOTSET)
    logger.propagate = not verbose
    if verbose:
        handler = logging.StreamHandler()
        handler.set_name(VERBOSITY)
        handler.setFormatter(logging.Formatter("%(relativeCreated)7.0f ms  %(name)s: %(message)s"))
        logger.addHandler(handler)


def unsaid() -> contextlib.AbstractContextManager[Any]:
    """What is printed meanwhile is not heard where nothing is to be said."""
    return contextlib.redirect_stdout(io.StringIO()) if verbosity() == "quiet" else contextlib.nullcontext()


def leave_the_pipe() -> None:
    """Let Python's own last flush go nowhere instead of failing once more."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def hushed() -> Iterator[None]:
    """:func:`hush`, for as long as a call of the command takes."""
    with warnings.catch_warnings():
        hush()
        yield


def hush() -> None:
    """Warnings that other libraries cause are not the user's business, unless Python's -W asks for them."""
    if not sys.warnoptions:
        warnings.filterwarnings("ignore", module=r"(?!dhtorch\b)")
