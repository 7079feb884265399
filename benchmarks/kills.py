"""Faults in the command's sleep: killed, told to end, raced, and out of disk, again and again; what is lost is counted.

    python benchmarks/kills.py --times 50 --json benchmarks/results/kills.json

Every fault hits ``dhtorch extract`` and ``dhtorch enrich`` on a small set, with two workers, at a moment drawn from the
seed. Afterwards the same command is run undisturbed, and its files are held against those of a run that nobody
disturbed: ``lost``, ``doubled`` and ``changed`` files, and hidden files and processes ``left`` behind, each of which
must be 0.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from dhtorch import storage

ROOM = ("data=synthetic", "data.n_frames=6", "data.hw=[96,128]", "data.depth_hw=[48,64]", "method.n=64", "workers=2")
COMMANDS = {
    "extract": (*ROOM, "extract.gap=1", "extract.shard_rows=1", "extract.columns=[depth]"),
    "enrich": (*ROOM, "shard_rows=1", "report=false"),
}
PATIENCE_S = 5  # after which a process that lives on is left behind


def main(argv: Sequence[str] | None = None) -> int:
    """Run the faults, print a line for each; exit code 1 where anything was lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(argv)
    found: dict[str, dict[str, int]] = {}
    with tempfile.TemporaryDirectory(prefix="dhtorch-kills-") as place:
        for command in COMMANDS:
            found |= suffered(command, Path(place) / command, options)
    print(f"{sum(sum(counts.values()) for counts in found.values())} lost, doubled, changed or left")
    if options.json:
        rows = [{"name": name, "times": options.times, **counts} for name, counts in found.items()]
        storage.write_json(options.json, rows)
    return int(any(any(counts.values()) for counts in found.values()))


def suffered(command: str, place: Path, options: argparse.Namespace) -> dict[str, dict[str, int]]:
    """What every fault, so many times, costs one command."""
    draw, found, began = random.Random(options.seed), {}, time.monotonic()
    if start(command, place / "whole").wait():
        raise SystemExit(f"dhtorch {command}: fails undisturbed")
    took, want = time.monotonic() - began, contents(place / "whole")
    for name, fault in FAULTS.items():
        counts = Counter(lost=0, doubled=0, changed=0, left=0)
        for number in range(options.times):
            folder = place / f"{name}-{number}"
            counts["left"] += fault(command, folder, draw.uniform(0.0, 1.0) * took)
            start(command, folder).wait()
            counts.update(difference(want, contents(folder)))
            counts["left"] += sum(file.name.startswith(".") for file in folder.rglob("*"))
            shutil.rmtree(folder)
        found[f"{command}, {name}"] = dict(counts)
        print(f"{command}, {name}: {options.times} times: {dict(counts)}", flush=True)
    return found


def start(command: str, folder: Path, limit: int | None = None) -> subprocess.Popen[bytes]:
    """The command in a process group of its own; ``limit``: blocks of 512 or 1024 bytes that a file of it may have."""
    words = [sys.executable, "-m", "dhtorch", command, *COMMANDS[command], f"out={folder}"]
    if limit is not None:
        words = ["sh", "-c", f'ulimit -f {limit} && exec "$@"', "sh", *words]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)


def ended(*processes: subprocess.Popen[bytes]) -> int:
    """Waits for processes; how many of their groups live on, which are then killed."""
    left = 0
    for process in processes:
        process.wait()
        end = time.monotonic() + PATIENCE_S
        while alive := _alive(process.pid):
            if time.monotonic() > end:
                os.killpg(process.pid, signal.SIGKILL)
                break
            time.sleep(0.05)
        left += alive
    return left


def _alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def _signalled(number: int) -> Callable[[str, Path, float], int]:
    def fault(command: str, folder: Path, after: float) -> int:
        process = start(command, folder)
        time.sleep(after)
        process.send_signal(number)
        return ended(process)

    return fault


def _raced(command: str, folder: Path, after: float) -> int:
    """A second one in the same folder."""
    first = start(command, folder)
    time.sleep(after / 4)
    return ended(first, start(command, folder))


def _full(command: str, folder: Path, after: float) -> int:
    """No file may grow beyond some kilobytes."""
    return ended(start(command, folder, limit=1 + int(2 * after)))


FAULTS: dict[str, Callable[[str, Path, float], int]] = {
    "kill": _signalled(signal.SIGKILL),
    "terminate": _signalled(signal.SIGTERM),
    "race": _raced,
    "full disk": _full,
}


def contents(folder: Path) -> dict[str, str]:
    """Name → digest of the files."""
    files = [file for file in folder.rglob("*") if file.is_file()]
    return {str(f.relative_to(folder)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}


def difference(want: dict[str, str], have: dict[str, str]) -> dict[str, int]:
    """Files that are missing, too many, or other than they should be."""
    changed = sum(have[name] != want[name] for name in have.keys() & want.keys())
    return {"lost": len(want.keys() - have.keys()), "doubled": len(have.keys() - want.keys()), "changed": changed}


if __name__ == "__main__":
    raise SystemExit(main())
