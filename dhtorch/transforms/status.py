"""What was wrong with samples, and how often: a code per sample, and counts that data-loader workers share."""

from __future__ import annotations

import copy
from typing import Any, Final

import torch
from torch import Tensor
from torch.utils.data import get_worker_info

from dhtorch.codes import names


class SampleProblem:
    """Codes of ``problem``, the worst one of a sample."""

    NONE: Final = 0
    NO_SECOND_VIEW: Final = 1  #: front end only: one frame, or the other one only pads the episode
    NO_DEPTH: Final = 2  #: the sensor gave no return at all
    UNREADABLE: Final = 3  #: left out; every number of ours is 0


#: Workers that are counted apart; more share a row, and may then lose counts.
_MAX_COUNT_ROWS = 128


class ProblemCounts:
    """Counts by problem, in memory that forked and spawned workers share, each writing to a row of its own."""

    def __init__(self) -> None:
        self.counts = _share_memory(torch.zeros(_MAX_COUNT_ROWS, len(names(SampleProblem)), dtype=torch.int64))

    def add(self, problem: Tensor) -> None:
        """Count the codes of some samples."""
        worker = get_worker_info()
        row = 0 if worker is None else 1 + worker.id % (_MAX_COUNT_ROWS - 1)
        counts = self.counts[row].numpy()  # of which torch would make several operations for each sample
        for code in problem.tolist():
            counts[code] += 1

    def report(self) -> dict[str, int]:
        """Number of samples by problem, all workers together."""
        total = self.counts.sum(0).tolist()
        return {name.lower(): total[code] for code, name in names(SampleProblem).items()}

    def __deepcopy__(self, memo: dict[int, Any]) -> ProblemCounts:
        twin = copy.copy(self)
        twin.counts = _share_memory(self.counts.clone())
        return twin


def _share_memory(counts: Tensor) -> Tensor:
    return counts.share_memory_()
