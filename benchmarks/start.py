"""How long a fresh interpreter needs before it can answer, beside one that loads torch alone.

    python benchmarks/start.py --json benchmarks/results/start.json --clock cpu

Each side is a process of its own, ``python -c``, and both take turns; times are those of the whole process, user and
system together with ``--clock cpu``. ``start_import`` loads the package, whose names are imported when they are asked
for; ``start_extend`` also the method, and ``start_names`` everything that ``from dhtorch import *`` gives.
``start_compiled`` is a worker's first pose by the compiled stage (500 points): with what another process compiled,
kept (``torch.compiler.save_cache_artifacts``) and the worker loaded, beside a worker that compiles for itself.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import harness

#: What is run, by row, and what it is compared with.
START_MODES = {
    "start_import": "import dhtorch",
    "start_extend": "from dhtorch import extend",
    "start_names": "from dhtorch import *",
}
PEER = "import torch"

#: A first compiled pose, after what the worker does before and before what it does after.
POSE = """
import sys
sys.path.insert(0, {here!r})
import torch
from pathlib import Path
import pnp
{before}
samples, tracks, camera, _ = pnp.scene(1, 500, 0.3, 0)
with torch.inference_mode():
    draws = pnp.uniform_draws(torch.arange(1), 1, pnp.HYPOTHESES)
    torch.compile(pnp.pnp_ransac)(samples, tracks, camera, camera, draws)
{after}
"""
LOAD = "torch.compiler.load_cache_artifacts(Path({file!r}).read_bytes())"
KEEP = "Path({file!r}).write_bytes(torch.compiler.save_cache_artifacts()[0])"

#: Times that a worker compiles: it takes a minute.
COMPILED = 2


def took(code: str, clock: str, **environment: str) -> float:
    """Milliseconds of a fresh interpreter that runs some code."""
    before, begin = os.times(), time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True, env={**os.environ, **environment})
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return 1e3 * (cpu if clock == "cpu" else time.perf_counter() - begin)


def measure(options: Any) -> list[dict[str, Any]]:
    """A row for each thing asked, all of them in turn after one round that fills the caches of files."""
    codes = {**START_MODES, "": PEER}
    for code in codes.values():
        took(code, options.clock)
    times: dict[str, list[float]] = {name: [] for name in codes}
    for _ in range(options.repeats):
        for name, code in codes.items():
            times[name].append(took(code, options.clock))
    peer = times.pop("")
    return [harness.row(name, ours, PEER, peer, bar=True) for name, ours in times.items()]


def compiled(options: Any) -> dict[str, Any]:
    """A row: a worker that loads what was compiled, beside one that compiles; each begins with an empty cache."""
    times: list[list[float]] = [[], []]
    with tempfile.TemporaryDirectory() as folder:
        kept = {"file": str(Path(folder) / "kept")}
        cold = POSE.format(here=str(Path(__file__).parent), before="", after=KEEP.format(**kept))
        warm = POSE.format(here=str(Path(__file__).parent), before=LOAD.format(**kept), after="")
        for k in range(COMPILED):
            for code, record in ((cold, times[1]), (warm, times[0])):
                cache = Path(folder) / f"{k}{len(record)}{code is warm}"
                record.append(took(code, options.clock, TORCHINDUCTOR_CACHE_DIR=str(cache)))
    return harness.row("start_compiled", times[0], "compiling", times[1], mode="torch.compile")


def main() -> None:
    """Print the table; write it with ``--json``."""
    options = harness.arguments(__doc__ or "").parse_args()
    harness.set_threads(1)
    rows = [*measure(options), compiled(options)]
    print(f"milliseconds, medians of {options.repeats}")
    harness.report(rows, options.json)


if __name__ == "__main__":
    main()
