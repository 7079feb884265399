"""Problem codes of samples, and their counts in memory shared by data-loader workers."""

from __future__ import annotations

import copy
from typing import Any, Final

import torch
from torch import Tensor
from torch.utils.data import get_worker_info

from dhtorch.codes import CodeTable, code, names


class SampleProblem(CodeTable):
    """Codes of ``problem``: the worst problem of a sample."""

    NONE: Final = code(0, "none")
    NO_SECOND_VIEW: Final = code(1, "front end only: one frame, or the source view only pads the episode")
    NO_DEPTH: Final = code(2, "the sensor has no return at all")
    UNREADABLE: Final = code(3, "left out; all added numbers are 0")


#: Rows of the table of counts; more workers than rows share a row, and may then lose counts.
_MAX_COUNT_ROWS = 128


class ProblemCounts:
    """Counts by problem in memory shared with forked and spawned workers, each of which writes its own row."""

    def __init__(self) -> None:
        counts = torch.zeros(_MAX_COUNT_ROWS, len(names(SampleProblem)), dtype=torch.int64, device="cpu")
        self.counts = _share_memory(counts)

    def add(self, problem: Tensor) -> None:
        """Count problem codes (B,) of samples."""
        worker = get_worker_info()
        row = 0 if worker is None else 1 + worker.id % (_MAX_COUNT_ROWS - 1)
        counts = self.counts[row].numpy()  # numpy: several torch operations per sample cost more
        for number in problem.tolist():
            counts[number] += 1

    def report(self) -> dict[str, int]:
        """Number of samples by problem, summed over all workers."""
        total = self.counts.sum(0).tolist()
        return {name.lower(): total[code] for code, name in names(SampleProblem).items()}

    def __deepcopy__(self, memo: dict[int, Any]) -> ProblemCounts:
        clone = copy.copy(self)
        clone.counts = _share_memory(self.counts.clone())
        return clone


def _share_memory(counts: Tensor) -> Tensor:
    return counts.share_memory_()
