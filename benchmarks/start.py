"""How long a fresh interpreter needs before it can answer, beside one that loads torch alone.

    python benchmarks/start.py --json benchmarks/results/start.json --clock cpu

Each side is a process of its own, ``python -c``, and both take turns; times are those of the whole process, user and
system together with ``--clock cpu``. ``start_import`` loads the package, whose names are imported when they are asked
for; ``start_extend`` also the method, and ``start_names`` everything that ``from dhtorch import *`` gives.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from typing import Any

import harness

#: What is run, by row, and what it is compared with.
ASKED = {
    "start_import": "import dhtorch",
    "start_extend": "from dhtorch import extend",
    "start_names": "from dhtorch import *",
}
PEER = "import torch"


def took(code: str, clock: str) -> float:
    """Milliseconds of a fresh interpreter that runs some code."""
    before, begin = os.times(), time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True)
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return 1e3 * (cpu if clock == "cpu" else time.perf_counter() - begin)


def measure(options: Any) -> list[dict[str, Any]]:
    """A row for each thing asked, all of them in turn after one round that fills the caches of files."""
    codes = {**ASKED, "": PEER}
    for code in codes.values():
        took(code, options.clock)
    times: dict[str, list[float]] = {name: [] for name in codes}
    for _ in range(options.repeats):
        for name, code in codes.items():
            times[name].append(took(code, options.clock))
    peer = times.pop("")
    return [harness.row(name, ours, PEER, peer, bar=True) for name, ours in times.items()]


def main() -> None:
    """Print the table; write it with ``--json``."""
    options = harness.arguments(__doc__ or "").parse_args()
    harness.set_threads(1)
    rows = measure(options)
    print(f"milliseconds, medians of {options.repeats}")
    harness.report(rows, options.json)


if __name__ == "__main__":
    main()
