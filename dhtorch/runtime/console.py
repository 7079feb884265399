"""How the command speaks: progress, how much is said, and whose warnings are heard.

Three levels: ``quiet`` (results and errors), ``normal``, ``verbose`` (what is read and done, and when). The level
stands in the environment variable ``_VERBOSITY_VARIABLE``, so that the processes of a launcher have it, too.
"""

from __future__ import annotations

import contextlib
import difflib
import io
import logging
import os
import sys
import unicodedata
import warnings
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TextIO

#: Flag → level.
VERBOSITY_FLAGS = {"-q": "quiet", "--quiet": "quiet", "-v": "verbose", "--verbose": "verbose"}
_VERBOSITY_VARIABLE = "DHTORCH_VERBOSITY"

#: Below the options of a sub-command that reads its own arguments.
HELP_EPILOG = (
    "-q says no more than what was asked for and -v what is read and done, as for every word of dhtorch. "
    "Exit code: 0 done, 2 bad option or bad data, 130 interrupted, 143 or 129 told to end (SIGTERM, SIGHUP)."
)


def format_count(n: int, word: str) -> str:
    """A number of things, the word with an s unless there is one."""
    return f"{n} {word}{'s' * (n != 1)}"


def suggest_name(found: str, known: Iterable[str]) -> str:
    """The name nearest to what was found, as a question; nothing where none is near."""
    names = list(dict.fromkeys(known))
    ends = {name.rpartition(".")[2]: name for name in reversed(names)}
    near = difflib.get_close_matches(found, names, 1, 0.6)
    near = near or [ends[k] for k in difflib.get_close_matches(found.rpartition(".")[2], list(ends), 1, 0.7)]
    return f" (did you mean {near[0]}?)" if near else ""


def escape_control(text: str) -> str:
    """The text without what a terminal would obey: control characters, and marks that turn the direction of writing,
    are spelt out. Line ends and tabs stay."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        c if c in "\n\t" or unicodedata.category(c) not in ("Cc", "Cf", "Cs", "Zl", "Zp") else _escape_character(c)
        for c in text
    )


def _escape_character(c: str) -> str:
    return f"\\x{ord(c):02x}" if ord(c) < 256 else f"\\u{ord(c):04x}" if ord(c) < 65536 else f"\\U{ord(c):08x}"


def escape_markup(text: str) -> str:
    """The text as rich takes it, with nothing in it that rich or a terminal would obey."""
    from rich.markup import escape  # noqa: PLC0415

    return escape(escape_control(text))


def unwrap_terminal(stream: Any) -> TextIO:
    """The stream for a writer that commands a terminal on purpose, and passes the rest through
    :func:`escape_markup`."""
    found: TextIO = stream.stream if isinstance(stream, EscapingStream) else stream
    return found


class EscapingStream:
    """A stream that names from files, values and errors pass on their way to a terminal; see :func:`escape_control`.

    All but writing is the stream's own. It is no subclass of Python's streams, which close what they hold when they go.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream  # what goes there directly is obeyed: a progress bar

    def write(self, text: str) -> int:
        """As of every stream."""
        self.stream.write(escape_control(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """As of every stream."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextlib.contextmanager
def escape_output() -> Iterator[None]:
    """Meanwhile nothing that is printed reaches a terminal as a command."""
    before: Any = sys.stdout, sys.stderr
    guarded: Any = tuple(s if isinstance(s, EscapingStream) else EscapingStream(s) for s in before)
    sys.stdout, sys.stderr = guarded
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def progress(items: Iterable[Any], text: str, total: int) -> Iterator[Any]:
    """A progress bar with rate and time left on a terminal, nothing elsewhere."""
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn  # noqa: PLC0415

    columns = ("{task.description:24}", BarColumn(), MofNCompleteColumn(), "{task.fields[rate]}", TimeRemainingColumn())
    hidden = not sys.stderr.isatty() or get_verbosity() == "quiet"
    with Progress(*columns, console=Console(file=unwrap_terminal(sys.stderr)), disable=hidden, transient=True) as bar:
        task = bar.add_task(escape_markup(text), total=total, rate="")
        for item in items:
            yield item
            speed = bar.tasks[task].speed
            bar.update(task, advance=1, rate=f"{speed:.1f}/s" if speed else "")


def get_verbosity() -> str:
    """quiet, normal or verbose."""
    return os.environ.get(_VERBOSITY_VARIABLE, "normal")


@contextlib.contextmanager
def set_verbosity(flags: Sequence[str]) -> Iterator[None]:
    """Set how much is said for one call of the command and the processes it starts."""
    before = os.environ.get(_VERBOSITY_VARIABLE)
    if flags:
        os.environ[_VERBOSITY_VARIABLE] = VERBOSITY_FLAGS[flags[-1]]
    configure_logging()
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(_VERBOSITY_VARIABLE, None)
        else:
            os.environ[_VERBOSITY_VARIABLE] = before
        configure_logging()


def configure_logging() -> None:
    """Debug messages of dhtorch go to stderr where much is to be said; nobody else's do."""
    logger = logging.getLogger("dhtorch")
    verbose = get_verbosity() == "verbose"
    for handler in [h for h in logger.handlers if h.get_name() == _VERBOSITY_VARIABLE]:
        logger.removeHandler(handler)
    for name, known in logging.root.manager.loggerDict.items():
        if name.startswith("dhtorch") and isinstance(known, logging.Logger):
            known.disabled = False  # Hydra's own set-up silences whatever logger is there before it
    logger.setLevel(logging.DEBUG if verbose else logging.NOTSET)
    logger.propagate = not verbose
    if verbose:
        handler = logging.StreamHandler()
        handler.set_name(_VERBOSITY_VARIABLE)
        handler.setFormatter(logging.Formatter("%(relativeCreated)7.0f ms  %(name)s: %(message)s"))
        logger.addHandler(handler)


def mute_if_quiet() -> contextlib.AbstractContextManager[Any]:
    """What is printed meanwhile is not heard where nothing is to be said."""
    return contextlib.redirect_stdout(io.StringIO()) if get_verbosity() == "quiet" else contextlib.nullcontext()


def discard_broken_pipe() -> None:
    """Let Python's own last flush go nowhere instead of failing once more."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def show_warnings_in_a_line() -> Iterator[None]:
    """:func:`ignore_foreign_warnings`, for as long as a call of the command takes; what is heard is one line, as errors
    are."""
    usual = warnings.formatwarning
    with warnings.catch_warnings():
        ignore_foreign_warnings()
        warnings.formatwarning = lambda message, *where, **more: f"dhtorch: warning: {message}\n"
        try:
            yield
        finally:
            warnings.formatwarning = usual


def ignore_foreign_warnings() -> None:
    """Warnings that other libraries cause are not the user's business, unless Python's -W asks for them."""
    if not sys.warnoptions:
        warnings.filterwarnings("ignore", module=r"(?!dhtorch\b)")
