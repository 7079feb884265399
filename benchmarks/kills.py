"""Faults in the command's sleep: killed, told to end, raced, and out of disk, again and again; what is lost is counted.

    python benchmarks/kills.py --times 50 --json benchmarks/results/kills.json

Every fault hits ``dhtorch extract`` on a small set at a moment drawn from the seed. Afterwards the same command is run
undisturbed, and its rows are held against those of a run that nobody disturbed: ``lost``, ``doubled`` and ``changed``
rows, and files ``left`` behind (processes too), each of which must be 0.
"""

from __future__ import annotations

import argparse
import hashlib
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from dhtorch import storage

COMMAND = (sys.executable, "-m", "dhtorch", "extract", "data=synthetic", "data.n_frames=6", "method.n=64")
OPTIONS = ("extract.gap=0", "extract.shard_rows=1", "extract.columns=[depth]")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the faults, print a line for each; exit code 1 where anything was lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(argv)
    draw, found = random.Random(options.seed), dict[str, dict[str, int]]()
    with tempfile.TemporaryDirectory(prefix="dhtorch-kills-") as place:
        whole = Path(place) / "whole"
        began = time.monotonic()
        start(whole).wait()
        took, want = time.monotonic() - began, contents(whole)
        for name, fault in FAULTS.items():
            counts = Counter(lost=0, doubled=0, changed=0, left=0)
            for number in range(options.times):
                folder = Path(place) / f"{name}-{number}"
                fault(folder, draw.uniform(0.3, 1.0) * took)
                start(folder).wait()
                counts.update(difference(want, contents(folder)))
                counts["left"] += sum(file.name.startswith(".") for file in folder.iterdir())
            found[name] = dict(counts)
            print(f"{name:10} {options.times} times: {found[name]}", flush=True)
    if options.json:
        words = " ".join(["python benchmarks/kills.py", *(argv if argv is not None else sys.argv[1:])])
        storage.write_json(options.json, {"command": words, "times": options.times, "faults": found})
    return int(any(any(counts.values()) for counts in found.values()))


def start(folder: Path, limit: int | None = None) -> subprocess.Popen[bytes]:
    """The command in a process of its own; ``limit``: blocks of 512 or 1024 bytes that a file of it may have."""
    words = [*COMMAND, *OPTIONS, f"out={folder}"]
    if limit is not None:
        words = ["sh", "-c", f'ulimit -f {limit} && exec "$@"', "sh", *words]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _signalled(number: int) -> Callable[[Path, float], None]:
    def fault(folder: Path, after: float) -> None:
        process = start(folder)
        time.sleep(after)
        process.send_signal(number)
        process.wait()

    return fault


def _raced(folder: Path, after: float) -> None:
    """A second one in the same folder."""
    first = start(folder)
    time.sleep(after / 4)
    second = start(folder)
    first.wait()
    second.wait()


def _full(folder: Path, after: float) -> None:
    """No file may grow beyond some bytes."""
    start(folder, limit=1 + int(after)).wait()


FAULTS: dict[str, Callable[[Path, float], None]] = {
    "kill": _signalled(signal.SIGKILL),
    "terminate": _signalled(signal.SIGTERM),
    "race": _raced,
    "full disk": _full,
}


def contents(folder: Path) -> dict[str, str]:
    """Name → digest of the shards."""
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.glob("*.parquet")}


def difference(want: dict[str, str], have: dict[str, str]) -> dict[str, int]:
    """Shards that are missing, too many, or other than they should be."""
    changed = sum(have[name] != want[name] for name in have.keys() & want.keys())
    return {"lost": len(want.keys() - have.keys()), "doubled": len(have.keys() - want.keys()), "changed": changed}


if __name__ == "__main__":
    raise SystemExit(main())
