"""Progress of all jobs of a sweep together, whichever processes they run in.

Every job notes in a file of its own how far it is, the process that started them reads these files and draws one bar.
The files lie below the sweep's folder, which all launchers share, and go when the sweep ends.
"""

from __future__ import annotations

import contextlib
import math
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from dhtorch.runtime import console
from dhtorch.runtime.console import format_count

#: Below the sweep's folder.
_NOTES_FOLDER = ".progress"

#: Seconds between two looks, and between two notes of a job.
_PAUSE_S = 0.25


def record_progress(folder: Path, job: str, scenes: int) -> Callable[[Iterable[Any], str, int], Iterator[Any]]:
    """What wraps the loops of one job: (items, text, number of items) → items; it notes the job's share done.

    Args:
        folder: of the sweep; where nobody looks, nothing is noted.
        job: a name that no other job has.
        scenes: loops that are expected; of more the share creeps on.
    """
    note, begun = folder / _NOTES_FOLDER / job, 0

    def wrap(items: Iterable[Any], text: str, total: int) -> Iterator[Any]:
        nonlocal begun
        begun += 1
        before, last = begun - 1, -math.inf
        for k, item in enumerate(items):
            yield item
            if time.monotonic() - last > _PAUSE_S or k + 1 == total:
                last = time.monotonic()
                _write_note(note, min(1.0, (before + (k + 1) / max(total, 1)) / max(scenes, begun)), text)

    return wrap


def mark_finished(folder: Path, job: str) -> None:
    """Note that a job has ended, well or not."""
    _write_note(folder / _NOTES_FOLDER / job, 1.0, "")


@contextlib.contextmanager
def show_sweep_progress(folder: Path, n_jobs: int) -> Iterator[None]:
    """A bar over all jobs with the time left, on a terminal, for as long as they run."""
    if not sys.stderr.isatty() or console.get_verbosity() == "quiet":
        yield
        return
    notes, stop = folder / _NOTES_FOLDER, threading.Event()
    shutil.rmtree(notes, ignore_errors=True)
    notes.mkdir(parents=True)
    drawer = threading.Thread(target=_draw_bar, args=(notes, n_jobs, stop), daemon=True)
    drawer.start()
    try:
        yield
    finally:
        stop.set()
        drawer.join(5)
        shutil.rmtree(notes, ignore_errors=True)


def _read_progress(notes: Path) -> tuple[float, int, list[str]]:
    """Jobs done with the shares of those that run, the number of whole ones, and what the running ones are at."""
    shares, at = [], []
    for path in sorted(p for p in notes.glob("*") if not p.name.endswith("~")):
        with contextlib.suppress(OSError, ValueError):
            share, _, text = path.read_text(encoding="utf-8").partition(" ")
            shares.append(float(share))
            at += [text] if text and float(share) < 1 else []
    return sum(shares), sum(s >= 1 for s in shares), at


def _draw_bar(notes: Path, n_jobs: int, stop: threading.Event) -> None:
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import BarColumn, Progress, TimeRemainingColumn  # noqa: PLC0415

    columns: Sequence[Any] = ("{task.description}", BarColumn(), "{task.percentage:.0f} %", TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(f"0 of {format_count(n_jobs, 'job')}", total=n_jobs)
        while not stop.wait(_PAUSE_S):
            done, whole, at = _read_progress(notes)
            said = f"{whole} of {format_count(n_jobs, 'job')}" + (f", {', '.join(at[:2])}" if at else "")
            bar.update(task, completed=done, description=said)


def _write_note(note: Path, share: float, text: str) -> None:
    """Whole or not at all; a job never fails because nobody looks."""
    if note.parent.is_dir():
        with contextlib.suppress(OSError):
            part = note.with_name(f"{note.name}~")
            part.write_text(f"{share:.4f} {text}", encoding="utf-8")
            part.replace(note)
