"""What an enriched data set is written as: a format; an episode is whole or not there, and says what it amounts to.

The maps of an episode wait in shards until all are made; then its rows are joined with them, few at a time, into one
file, whose metadata say what all rows together amount to. Who is killed begins that episode's file anew.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dhtorch.export.lerobot import FeatureMoments
from dhtorch.geometry.pose_conventions import CONVENTIONS

Row = dict[str, Any]

#: Parts of an episode, along time, whose shares are noted.
_N_TIME_BINS = 24

#: What refuted poses look like that fit in no reading of them.
UNKNOWN_CONVENTION = "unknown"


class DatasetTarget(Protocol):
    """How a format is written."""

    def own(self, k: int) -> Row | None:
        """What the ``k``-th episode amounts to; None = it is not whole yet."""

    def assemble(self, k: int, before: Sequence[Row], parts: Mapping[str, Sequence[Path]]) -> Row:
        """Write the ``k``-th episode from the shards of its cameras; ``before``: what those before it amount to."""

    def finish(self, owns: Sequence[Row]) -> None:
        """Write what describes all episodes."""


class MapCounts:
    """Counts over the frames of one camera in one episode."""

    def __init__(self) -> None:
        self.pixels: list[np.ndarray] = []
        self.silent: list[np.ndarray] = []
        self.moments: FeatureMoments | None = None
        self.refuted: Counter[str] = Counter()
        self.unread = 0

    def add(self, row: Mapping[str, Any] | None) -> None:
        """Count a frame; None = it could not be read."""
        if row is None or not row["depth"]:
            self.unread += 1
            return
        self.pixels.append(np.asarray(row["pixels"], np.int64))
        self.silent.append(np.asarray(row["silent"], np.int64))
        if row["refuted"]:
            self.refuted[CONVENTIONS[row["refuted"] - 1] or UNKNOWN_CONVENTION] += 1
        moments = FeatureMoments(*np.asarray(row["moments"], np.float64).reshape(5, 5))
        self.moments = moments if self.moments is None else self.moments + moments

    def summary(self) -> Row:
        """Pixels by source and by reason, in all and along time; frames with refuted poses, by what these look like."""
        if not self.pixels:
            nothing: Row = {key: [] for key in ("pixels", "silent", "over_time", "silent_over_time")}
            return {**nothing, "unread": self.unread, "frames": 0, "refuted": {}}
        pixels, silent = np.stack(self.pixels), np.stack(self.silent)
        parts = np.array_split(np.arange(len(pixels)), min(_N_TIME_BINS, len(pixels)))
        along, why = ([x[at].sum(0) / max(1, pixels[at].sum()) for at in parts] for x in (pixels, silent))
        found = {"over_time": along, "silent_over_time": why, "unread": self.unread}
        found |= {"frames": len(pixels), "refuted": dict(sorted(self.refuted.items()))}
        return {"pixels": pixels.sum(0), "silent": silent.sum(0), **found}

    def of_maps(self) -> tuple[FeatureMoments, FeatureMoments, FeatureMoments] | None:
        """Of depth, sigma and the picture; None where no frame could be read."""
        if self.moments is None:
            return None
        cut = [FeatureMoments(*(x[span] for x in self.moments)) for span in (slice(0, 1), slice(1, 2), slice(2, 5))]
        return cut[0], cut[1], cut[2]
