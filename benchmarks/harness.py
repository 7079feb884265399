"""Timing both sides in turn, in one process, and one row format for every script.

Rows: ``{name, mode, n, batch, threads, processor, git, device, ours_ms, ours_iqr, peer, peer_ms, ratio, ours_error,
peer_error, bar}``; ``ratio`` is ours / peer of medians, below 1 = ours is faster. A row whose work is counted also has
``floor_ms``, the least time that its multiply-adds and bytes take at the rates measured on that machine
(:func:`measure_rates`).
"""

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import torch

from dhtorch.ops import builder, loader
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage

#: Clocks by name: what a wall shows, or (on a busy machine) the time this process was really given.
CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}

#: What holds torch, oneDNN, MKL, OpenCV and (through torch's) our compiled code to AVX2; each library reads its own.
#: torch.compile keeps what it made for wider vectors and would use it wrongly, so that its cache is another one.
AVX2 = {
    "TORCHINDUCTOR_CACHE_DIR": f"{tempfile.gettempdir()}/torchinductor-avx2-{os.getuid()}",
    "ATEN_CPU_CAPABILITY": "avx2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "MKL_ENABLE_INSTRUCTIONS": "AVX2",
    "OPENCV_CPU_DISABLE": "AVX512-SKX",
}

#: Side of the matrices whose product gives the rate of multiply-adds: three of them are 3 MB.
RATE_SIDE = 512

#: Length of the vector whose copy gives the rate of memory: 128 MB.
RATE_FLOATS = 1 << 25


def in_turn(
    calls: Sequence[Callable[[], Any]],
    *,
    repeats: int = 15,
    warm_up: int = 3,
    clock: str = "wall",
    device: str = "cpu",
    least_ms: float = 0.0,
) -> list[list[float]]:
    """Milliseconds of each call, ``repeats`` times, the calls taking turns so that noise hits all alike.

    Calls that take less than ``least_ms`` are repeated until they do not, and their mean counts as one time. On
    another device than the CPU times are those between two events of it.
    """
    counts = []
    for call in calls:
        for _ in range(warm_up):
            call()
        took = _time(call, 1, clock, device)
        counts.append(max(1, round(least_ms / took)) if took > 0 else 1)
    times: list[list[float]] = [[] for _ in calls]
    for _ in range(repeats):
        for call, count, record in zip(calls, counts, times, strict=True):
            record.append(_time(call, count, clock, device))
    return times


def _time(call: Callable[[], Any], count: int, clock: str, device: str) -> float:
    """Mean milliseconds of ``count`` calls."""
    if device != "cpu":
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        torch.cuda.synchronize()
        start.record()
        for _ in range(count):
            call()
        end.record()
        torch.cuda.synchronize()
        return start.elapsed_time(end) / count
    now = CLOCKS[clock]
    begin = now()
    for _ in range(count):
        call()
    return 1e3 * (now() - begin) / count


@contextmanager
def with_compiled_operators() -> Iterator[None]:
    """Compiled code is used in this block, and in processes forked from it; as a decorator, in each call."""
    before, loader._loaded = loader._loaded, [_library()]  # no mock, which takes longer than a small call
    try:
        yield
    finally:
        loader._loaded = before


@cache
def _library() -> Path:
    """The compiled file, built unless it was, and loaded for whoever asks."""
    path = builder.build()
    torch.ops.load_library(str(path))
    return path


@cache
def _code() -> str | None:
    """The commit whose code is measured."""
    return result_files.read_git_revision(Path(result_files.__file__).parent)


class Work(NamedTuple):
    """What a row has to do, per its unit of time, however it is done."""

    multiply_adds: float  # in single precision
    moved_bytes: float  # to and from memory

    def floor_ms(self) -> float:
        """The least milliseconds: of arithmetic or of memory, whichever is longer."""
        multiply_adds, moved = measure_rates(torch.get_num_threads())
        return max(self.multiply_adds / multiply_adds, self.moved_bytes / moved)


@cache
def measure_rates(threads: int) -> tuple[float, float]:
    """Multiply-adds (float32) and bytes to and from memory, each per millisecond, of this machine with ``threads``.

    The first from a matrix product in cache, the second from a copy of more than the caches hold; the fastest of
    several, because whatever else runs only slows them down. With ``--avx2`` they are those of AVX2.
    """
    a, out = torch.rand(RATE_SIDE, RATE_SIDE), torch.empty(RATE_SIDE, RATE_SIDE)
    source = torch.rand(RATE_FLOATS)
    target = torch.empty_like(source)
    product, copy = in_turn([lambda: torch.mm(a, a, out=out), lambda: target.copy_(source)], repeats=25)
    return RATE_SIDE**3 / min(product), 2 * source.nbytes / min(copy)


def iqr(values: Sequence[float]) -> float:
    """Interquartile range."""
    quarters = statistics.quantiles(values, n=4)
    return quarters[2] - quarters[0]


def row(
    name: str, ours: Sequence[float], peer: str, theirs: Sequence[float], *, work: Work | None = None, **more: Any
) -> dict[str, Any]:
    """One line of a result file; ``more`` fills n, batch, threads, mode, errors, bar."""
    a, b = statistics.median(ours), statistics.median(theirs)
    base = {
        "mode": "eager",
        "n": None,
        "batch": 1,
        "device": "cpu",
        "ours_error": None,
        "peer_error": None,
        "bar": False,
    }
    timing = {"ours_ms": a, "ours_iqr": iqr(ours), "peer": peer, "peer_ms": b, "ratio": a / b}
    timing |= {} if work is None else {"floor_ms": work.floor_ms()}
    return {"name": name, **base, "threads": torch.get_num_threads(), **place(), **timing, **more}


def place() -> dict[str, str | None]:
    """Where a row is measured: the processor, and the commit whose code it is."""
    return {"processor": result_files.describe_processor(), "git": _code()}


def set_threads(threads: int) -> None:
    """The same number of threads for torch and OpenCV."""
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)


class _LimitInstructions(argparse.Action):
    """Begin the script again in a process whose libraries use no wider vectors than those of AVX2."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        if any(os.environ.get(name) != value for name, value in AVX2.items()):
            os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **AVX2})


def arguments(description: str) -> argparse.ArgumentParser:
    """The options every script has; rows are measured in torch unless they say otherwise (with_compiled_operators)."""
    os.environ[loader.SWITCH] = "0"
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--full", action="store_true", help="the whole grid instead of the default few minutes")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--clock", choices=[*CLOCKS], default="wall", help="cpu: on a machine that others use too")
    parser.add_argument(
        "--avx2", action=_LimitInstructions, nargs=0, help="torch, oneDNN, MKL and OpenCV without AVX-512"
    )
    parser.add_argument("--device", default="cpu", help="cpu, or cuda where the script knows how")
    return parser


def report(rows: list[dict[str, Any]], path: Path | None) -> None:
    """Print the rows as a table and write them as strict JSON."""
    head = f"{'name':34} {'mode':8} {'n':>6} {'B':>3} {'thr':>3} {'ours ms':>9} {'iqr':>7} {'peer':22} {'ms':>9}"
    print(head + f" {'ratio':>6} {'ours err':>9} {'peer err':>9} {'floor ms':>9} {'/ floor':>7}")
    for r in rows:
        errors = "".join(f" {r[k]:9.4g}" if r[k] is not None else f" {'-':>9}" for k in ("ours_error", "peer_error"))
        floor = f" {r['floor_ms']:9.3f} {r['ours_ms'] / r['floor_ms']:7.1f}" if "floor_ms" in r else ""
        print(
            f"{r['name']:34} {r['mode']:8} {r['n'] or 0:6d} {r['batch']:3d} {r['threads']:3d} {r['ours_ms']:9.2f} "
            f"{r['ours_iqr']:7.2f} {r['peer']:22} {r['peer_ms']:9.2f} {r['ratio']:6.2f}{errors}{floor}"
        )
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        storage.write_json(path, rows)
        print(f"wrote {path}")
