"""The sweep that README shows: its jobs, a row each.

    python benchmarks/sweep.py --json benchmarks/results/sweep.json

A row holds what a job was told otherwise than the others (``overrides``) and the numbers of its scene; ``ms`` is the
time of a pair, on whatever machine, beside whatever else it does.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage

#: The command, as README has it.
COMMAND = "dhtorch -m method=paper,map,auto method.n=512,2048"
COLUMNS = ("coverage", "median_rel", "p90_rel", "coverage_at_5")


def row(folder: Path) -> dict[str, Any]:
    """The numbers of one job."""
    result = result_files.read_result(folder)
    (scene_row,) = (r for r in result["rows"] if r["pair"] is None and r["truth"] == "full")
    overrides = {"method": scene_row["method"], "method.n": result["config"]["method"]["n"]}
    row = {"overrides": overrides, **{key: scene_row[key] for key in COLUMNS}, "ms": sum(scene_row["ms"].values())}
    return row | {"processor": result["meta"]["processor"]}


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        words = [*COMMAND.split()[1:], f"output={folder}", "figures=false"]
        done = subprocess.run([sys.executable, "-m", "dhtorch", *words], cwd=folder, check=False)
        if done.returncode == 0:
            rows = [row(path.parent) for path in sorted(Path(folder).rglob("result.json"))]
            rows.sort(key=lambda r: [COMMAND.index(str(v)) for v in r["overrides"].values()])
            options.json.write_text(storage.dump_strict_json(rows, indent=1) + "\n")
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
