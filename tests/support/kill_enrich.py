"""Kills ``dhtorch enrich`` at chosen moments and finishes each run, in forks of one process that is loaded once.

    python tests/support/kill_enrich.py SRC FOLDER MOMENTS -- OPTION…

First it runs undisturbed into FOLDER/whole and counts the calls of the file system (files opened for writing, renamed,
removed, folders made): these are the moments. Then, for each of MOMENTS of them evenly spread (0 = all), a child is
killed with SIGKILL right before it into FOLDER/<moment>, and another one finishes there. Last, a disk is full: no file
may grow beyond 2 kB, and then one may. Prints a line of JSON.
"""

import contextlib
import io
import json
import os
import resource
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from dhtorch.cli import enrich  # noqa: F401  (what a child would have to load)
from dhtorch.cli.run import main

MOMENTS = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "shutil.rmtree", "os.link", "os.truncate"}


def counted(folder: Path, at: Callable[[int], None]) -> None:
    """Call ``at`` with its number at every moment that concerns the folder."""
    seen = 0

    def hook(event: str, args: tuple[Any, ...]) -> None:
        nonlocal seen
        if event not in MOMENTS or not args or not str(args[0]).startswith(str(folder)):
            return
        if event == "open" and not (isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR)):
            return
        at(seen)
        seen += 1

    sys.addaudithook(hook)


def child(work: Callable[[], int]) -> tuple[int, str]:
    """(exit status, stderr) of work in a process of its own; a negative status is a signal."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        stderr, code = io.StringIO(), 99
        with contextlib.redirect_stderr(stderr), contextlib.redirect_stdout(io.StringIO()):
            code = work()
        os.write(write, stderr.getvalue()[-4000:].encode())
        os._exit(code)
    os.close(write)
    with os.fdopen(read, "rb") as stream:
        child_stderr = stream.read().decode()
    status = os.waitpid(pid, 0)[1]
    return os.waitstatus_to_exitcode(status), child_stderr


def struck(source: str, folder: Path, moments: int, options: Sequence[str]) -> dict[str, Any]:
    def run(out: Path, at: Callable[[int], None] | None = None, limit: int | None = None) -> Callable[[], int]:
        def work() -> int:
            if limit is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
            if at is not None:
                counted(out, at)
            return main(["enrich", source, str(out), *options])

        return work

    log = folder / "moments"
    with log.open("wb", buffering=0) as calls:
        first = child(run(folder / "whole", lambda n: calls.write(b".") and None))
    total = log.stat().st_size
    chosen = range(total) if not moments else [total * (k + 1) // (moments + 1) for k in range(moments)]
    ends = []
    for moment in chosen:
        out = folder / str(moment)
        killed = child(run(out, lambda n, m=moment: os.kill(os.getpid(), signal.SIGKILL) if n == m else None))
        ends.append([moment, killed[0], child(run(out))])
    full = child(run(folder / "full", limit=2000))
    return {"whole": first, "total": total, "ends": ends, "full": full, "after": child(run(folder / "full"))}


if __name__ == "__main__":
    cut = sys.argv.index("--")
    print(json.dumps(struck(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), sys.argv[cut + 1 :])))
