"""Ray Data: depth tokens of an enriched set's rows, computed by actors that each hold one transform.

In an environment that has ray[data] and dhtorch:  python benchmarks/clients/ray_data.py DST
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

import numpy as np
import ray
from columns import columns
from torch_loader import Rows

from dhtorch import ExtendDepth
from dhtorch.transforms import ExtendedDataset


class Extend:
    """An actor: opens the set when it starts, and computes the depth tokens of rows by their numbers."""

    def __init__(self, root: str) -> None:
        spec = columns(root, tables=True)
        transform = ExtendDepth(**spec["keys"], other_image="before", n=256, tokens_hw=(56, 56))
        self.data = ExtendedDataset(Rows(root), transform, gap=2)

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        """Number of a row -> its tokens."""
        sample = self.data[int(row["id"])]
        tokens = {key: sample[f"observation.dh_{key}"].numpy() for key in ("tokens", "tokens_valid")}
        return {"index": row["id"], **tokens}


def main(root: str) -> None:
    here = str(Path(__file__).resolve().parent)
    path = os.pathsep.join([here, os.environ.get("PYTHONPATH", "")])
    ray.init(
        **{"num_cpus": 1, "include_dashboard": False, "log_to_driver": False, "object_store_memory": 150_000_000},
        runtime_env={"env_vars": {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}},
    )
    ray.data.DataContext.get_current().enable_progress_bars = False
    rows = ray.data.range(len(Rows(root)))
    extended = rows.map(Extend, fn_constructor_args=(root,), compute=ray.data.ActorPoolStrategy(size=1))
    batch = extended.sort("index").take_batch(3)
    known = int(np.asarray(batch["tokens_valid"]).sum())
    print(json.dumps({"frames": rows.count(), "batch": list(batch["tokens"].shape), "tokens_known": known}))
    ray.shutdown()


if __name__ == "__main__":
    main(str(Path(sys.argv[1]).resolve()))
