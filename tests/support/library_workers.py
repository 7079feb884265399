"""What computes in the workers of a data loader, for each of several caches of compiled operators; a program.

``python library_workers.py WORKERS CACHE …`` prints a JSON list for each cache: of every worker the description of its
operators, its warnings, and whether a sweep has the answer of torch. The program itself loads no library.
"""

import json
import os
import sys
import warnings
from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset

from dhtorch.geometry import plane_sweep
from dhtorch.ops import loader


def sweep() -> torch.Tensor:
    """Costs of a small random volume, aggregated."""
    cost = torch.randint(0, 31, (2, 4, 5, 6), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    return plane_sweep.aggregate_best_plane(cost, torch.tensor(1))[1]


class Workers(Dataset[Any]):
    """Item of each worker: what computes there, after two sweeps."""

    def __init__(self, count: int, expected: torch.Tensor) -> None:
        self.count, self.expected = count, expected

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, i: int) -> Any:
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            warnings.simplefilter("ignore", ImportWarning)  # as Python has it
            same = all(torch.equal(sweep(), self.expected) for _ in range(2))
            return loader.describe_operators(), [str(w.message) for w in heard], same


def as_lists(batch: list[Any]) -> list[Any]:
    """The only item of a batch."""
    return [*batch[0]]


if __name__ == "__main__":
    count, caches = int(sys.argv[1]), sys.argv[2:]
    os.environ["DHTORCH_OPS"] = "0"
    expected = sweep()
    del os.environ["DHTORCH_OPS"]
    for cache in caches:
        os.environ["DHTORCH_CACHE"] = cache
        assert not loader._loaded and not loader._tried
        print(json.dumps(list(DataLoader(Workers(count, expected), 1, num_workers=count, collate_fn=as_lists))))
