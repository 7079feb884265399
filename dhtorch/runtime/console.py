"""Console output: progress bar, verbosity, warnings, escaping of control characters.

Verbosity: ``quiet`` (results and errors), ``normal``, ``verbose`` (log of inputs and steps, with times). It is kept in
the environment variable ``_VERBOSITY_VARIABLE``, which a launcher's processes inherit.
"""

import contextlib
import difflib
import io
import logging
import multiprocessing
import os
import sys
import time
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, TextIO

#: Wrapper of a loop that shows its progress: (items, text, number of items) → items.
Progress = Callable[..., Iterable[Any]]

#: Flag → level.
VERBOSITY_FLAGS = {"-q": "quiet", "--quiet": "quiet", "-v": "verbose", "--verbose": "verbose"}
_VERBOSITY_VARIABLE = "DHTORCH_VERBOSITY"

#: Time between two lines of progress where stderr is no terminal, s. Source: chosen so that short jobs print none.
_LINE_INTERVAL_S = 30.0

#: Names of a folder that are compared with a missing one. Bounds the time of a message.
_MAX_NAMES_COMPARED = 2000


def format_count(n: int, word: str) -> str:
    """Number and noun: ``1 frame``, ``2 frames``."""
    return f"{n} {word}{'s' * (n != 1)}"


def suggest_name(unknown: str, known: Iterable[str]) -> str:
    """`` (did you mean NAME?)`` with the known name nearest to ``unknown``; empty without a near one."""
    names = list(dict.fromkeys(known))
    full_names = {name.rpartition(".")[2]: name for name in reversed(names)}
    near = difflib.get_close_matches(unknown, names, 1, 0.6)
    near = near or [
        full_names[k] for k in difflib.get_close_matches(unknown.rpartition(".")[2], list(full_names), 1, 0.7)
    ]
    return f" (did you mean {near[0]}?)" if near else ""


def suggest_path(missing: Path) -> str:
    """`` (did you mean PATH?)`` with the nearest name in the deepest existing folder above; empty without one."""
    below = missing
    while not below.parent.is_dir() and below.parent != below:
        below = below.parent
    try:
        names = [entry.name for entry in islice(below.parent.iterdir(), _MAX_NAMES_COMPARED)]
    except OSError:
        return ""
    near = difflib.get_close_matches(below.name, names, 1, 0.6)
    return f" (did you mean {below.with_name(near[0])}?)" if near else ""


def has_screen() -> bool:
    """Whether windows can be opened on this machine."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _escape_control(text: str) -> str:
    """Text with control and bidirectional characters escaped, so that a terminal does not interpret them; line ends and
    tabs are kept."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        c
        if c in "\n\t" or unicodedata.category(c) not in ("Cc", "Cf", "Cs", "Zl", "Zp")
        else (f"\\x{ord(c):02x}" if ord(c) < 256 else f"\\u{ord(c):04x}" if ord(c) < 65536 else f"\\U{ord(c):08x}")
        for c in text
    )


def escape_markup(text: str) -> str:
    """Text for rich in which neither rich markup nor control characters are interpreted."""
    from rich.markup import escape  # noqa: PLC0415

    return escape(_escape_control(text))


def unwrap_terminal(stream: Any) -> TextIO:
    """The raw stream, for writers that control the terminal and escape other text by :func:`escape_markup`."""
    raw: TextIO = stream.stream if isinstance(stream, _EscapingStream) else stream
    return raw


class _EscapingStream:
    """Stream wrapper that escapes written text by :func:`_escape_control`; everything else is delegated.

    Not a subclass of Python's streams, which would close the wrapped stream on deletion.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream  # unescaped, for the progress bar

    def write(self, text: str) -> int:
        """Write escaped text."""
        self.stream.write(_escape_control(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write escaped text."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextlib.contextmanager
def escape_output() -> Iterator[None]:
    """Context in which stdout and stderr escape control characters."""
    old_streams: Any = sys.stdout, sys.stderr
    escaping: Any = tuple(s if isinstance(s, _EscapingStream) else _EscapingStream(s) for s in old_streams)
    sys.stdout, sys.stderr = escaping
    try:
        yield
    finally:
        sys.stdout, sys.stderr = old_streams


def progress(items: Iterable[Any], text: str, total: int) -> Iterator[Any]:
    """Iterate over ``items``; number done, rate and time left as a bar on a terminal, elsewhere as a line now and then.

    Quiet output has neither.
    """
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import BarColumn, MofNCompleteColumn, Progress  # noqa: PLC0415

    columns = ("{task.description:24}", BarColumn(), MofNCompleteColumn(), "{task.fields[rate]}")
    is_quiet = get_verbosity() == "quiet"
    is_terminal = sys.stderr.isatty() and multiprocessing.current_process().name == "MainProcess"  # no worker's
    start = last_line = time.monotonic()
    bar_console = Console(file=unwrap_terminal(sys.stderr))
    with Progress(*columns, console=bar_console, disable=is_quiet or not is_terminal, transient=True) as bar:
        task = bar.add_task(escape_markup(text), total=total, rate="")
        for done, item in enumerate(items, 1):
            yield item
            now = time.monotonic()
            # Rate and time left: ``1.4/s, 0:35 left``, ``5.2 s each, 2:40 left``
            seconds = now - start
            each = max(seconds, 1e-6) / done
            left = round(each * max(0, total - done))
            rate = f"{1 / each:.1f}/s" if each < 1 else f"{each:.1f} s each"
            hours, minutes = divmod(left // 60, 60)
            rate = f"{rate}, {f'{hours}:{minutes:02d}' if hours else minutes}:{left % 60:02d} left"
            bar.update(task, advance=1, rate=rate)
            if not (is_quiet or is_terminal) and done < total and now - last_line >= _LINE_INTERVAL_S:
                print(f"{text}: {done} of {total}, {rate}", file=sys.stderr, flush=True)
                last_line = now


def get_verbosity() -> str:
    """quiet, normal or verbose."""
    return os.environ.get(_VERBOSITY_VARIABLE, "normal")


@contextlib.contextmanager
def set_verbosity(flags: Sequence[str]) -> Iterator[None]:
    """Context that sets the verbosity for one call of the command and the processes it starts."""
    old_level = os.environ.get(_VERBOSITY_VARIABLE)
    if flags:
        os.environ[_VERBOSITY_VARIABLE] = VERBOSITY_FLAGS[flags[-1]]
    configure_logging()
    try:
        yield
    finally:
        if old_level is None:
            os.environ.pop(_VERBOSITY_VARIABLE, None)
        else:
            os.environ[_VERBOSITY_VARIABLE] = old_level
        configure_logging()


def configure_logging() -> None:
    """With verbose output, send the debug messages of dhtorch, and only these, to stderr."""
    logger = logging.getLogger("dhtorch")
    verbose = get_verbosity() == "verbose"
    for handler in [h for h in logger.handlers if h.get_name() == _VERBOSITY_VARIABLE]:
        logger.removeHandler(handler)
    for name, existing in logging.root.manager.loggerDict.items():
        if name.startswith("dhtorch") and isinstance(existing, logging.Logger):
            existing.disabled = False  # Hydra's set-up disables loggers that exist before it
    logger.setLevel(logging.DEBUG if verbose else logging.NOTSET)
    logger.propagate = not verbose
    if verbose:
        handler = logging.StreamHandler()
        handler.set_name(_VERBOSITY_VARIABLE)
        handler.setFormatter(logging.Formatter("%(relativeCreated)7.0f ms  %(name)s: %(message)s"))
        logger.addHandler(handler)


def mute_if_quiet() -> contextlib.AbstractContextManager[Any]:
    """Context that discards printed text with quiet output."""
    return contextlib.redirect_stdout(io.StringIO()) if get_verbosity() == "quiet" else contextlib.nullcontext()


def discard_broken_pipe() -> None:
    """Redirect stdout to the null device, so that Python's final flush does not fail again."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def show_warnings_in_a_line() -> Iterator[None]:
    """Context in which warnings of other libraries are ignored and ours are printed in one line, as errors are.

    That operators are not compiled, an ImportWarning of ours, is printed unless output is quiet. Python's -W decides
    instead where it is used.
    """
    old_format = warnings.formatwarning
    with warnings.catch_warnings():
        if not sys.warnoptions:
            warnings.filterwarnings("ignore", module=r"(?!dhtorch\b)")
            action: Any = "ignore" if get_verbosity() == "quiet" else "default"
            warnings.filterwarnings(action, category=ImportWarning, module="dhtorch")
        warnings.formatwarning = lambda message, *where, **more: f"dhtorch: warning: {message}\n"
        try:
            yield
        finally:
            warnings.formatwarning = old_format
