"""One progress bar for all jobs of a sweep, in any number of processes.

Every job writes its progress to a file of its own; the process that started the jobs reads these files and draws one
bar. The files lie below the sweep's folder, which all launchers share, and are removed when the sweep ends.
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
from dhtorch.runtime.output_folder import PRIVATE_FOLDER

#: Folder of the progress files, below the sweep's folder.
_NOTES_FOLDER = Path(PRIVATE_FOLDER, "progress")

#: Seconds between two updates of the bar, and of a job's file.
_PAUSE_S = 0.25


def record_progress(folder: Path, job: str, scenes: int) -> Callable[[Iterable[Any], str, int], Iterator[Any]]:
    """Wrapper for the loops of one job, (items, text, number of items) -> items, which records the finished fraction.

    Args:
        folder: of the sweep; without a progress folder nothing is written.
        job: unique name of the job.
        scenes: expected number of loops; with more loops the fraction is of their number so far.
    """
    note, n_loops = folder / _NOTES_FOLDER / job, 0

    def wrap(items: Iterable[Any], text: str, total: int) -> Iterator[Any]:
        nonlocal n_loops
        n_loops += 1
        n_finished, last = n_loops - 1, -math.inf
        for k, item in enumerate(items):
            yield item
            if time.monotonic() - last > _PAUSE_S or k + 1 == total:
                last = time.monotonic()
                _write_note(note, min(1.0, (n_finished + (k + 1) / max(total, 1)) / max(scenes, n_loops)), text)

    return wrap


def mark_finished(folder: Path, job: str) -> None:
    """Record that a job has ended, successfully or not."""
    _write_note(folder / _NOTES_FOLDER / job, 1.0, "")


@contextlib.contextmanager
def show_sweep_progress(folder: Path, n_jobs: int) -> Iterator[None]:
    """Context that shows one bar over all jobs with the time left, on a terminal."""
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


def _draw_bar(notes: Path, n_jobs: int, stop: threading.Event) -> None:
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import BarColumn, Progress, TimeRemainingColumn  # noqa: PLC0415

    columns: Sequence[Any] = ("{task.description}", BarColumn(), "{task.percentage:.0f} %", TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(f"0 of {format_count(n_jobs, 'job')}", total=n_jobs)
        while not stop.wait(_PAUSE_S):
            # Sum of the jobs' finished fractions, number of finished jobs, texts of the running ones
            shares, texts = [], []
            for path in sorted(p for p in notes.glob("*") if not p.name.endswith("~")):
                with contextlib.suppress(OSError, ValueError):
                    fraction, _, text = path.read_text(encoding="utf-8").partition(" ")
                    shares.append(float(fraction))
                    texts += [text] if text and float(fraction) < 1 else []
            n_finished = sum(share >= 1 for share in shares)
            description = f"{n_finished} of {format_count(n_jobs, 'job')}" + (
                f", {', '.join(texts[:2])}" if texts else ""
            )
            bar.update(task, completed=sum(shares), description=description)


def _write_note(note: Path, share: float, text: str) -> None:
    """Write a progress file atomically; errors are ignored."""
    if note.parent.is_dir():
        with contextlib.suppress(OSError):
            part = note.with_name(f"{note.name}~")
            part.write_text(f"{share:.4f} {text}", encoding="utf-8")
            part.replace(note)
