"""Interface of the formats of an enriched data set: episodes are written atomically, each with a summary.

The maps of an episode are stored in shards until all are computed; then they are joined with its rows, few at a time,
into one file, whose metadata hold the summary of all rows. After an interruption the file of that episode is rewritten.
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

#: Maximum number of time bins of an episode in its summary.
_N_TIME_BINS = 24

#: Name in the summary for refuted poses that match no convention.
UNKNOWN_CONVENTION = "unknown"


class DatasetTarget(Protocol):
    """Writer of one format."""

    def own(self, k: int) -> Row | None:
        """Summary of the ``k``-th episode; None = it is not complete yet."""

    def assemble(self, k: int, before: Sequence[Row], parts: Mapping[str, Sequence[Path]]) -> Row:
        """Write the ``k``-th episode from the shards of its cameras; ``before``: summaries of the earlier episodes."""

    def planned_files(self, missing: Sequence[int]) -> list[Path]:
        """Files that the episodes ``missing`` and the metadata of the data set are written to, as far as known."""

    def finish(self, owns: Sequence[Row]) -> None:
        """Write the metadata of the data set; ``owns``: summaries of all episodes."""


class MapCounts:
    """Counts and moments over the frames of one camera in one episode."""

    def __init__(self) -> None:
        self.pixels: list[np.ndarray] = []
        self.no_answer: list[np.ndarray] = []
        self.moments: FeatureMoments | None = None
        self.refuted: Counter[str] = Counter()
        self.unread = 0

    def add(self, row: Mapping[str, Any] | None) -> None:
        """Add the row of a frame; None = it could not be read."""
        if row is None or not row["depth"]:
            self.unread += 1
            return
        self.pixels.append(np.asarray(row["pixels"], np.int64))
        self.no_answer.append(np.asarray(row["no_answer"], np.int64))
        if row["refuted"]:
            self.refuted[CONVENTIONS[row["refuted"] - 1] or UNKNOWN_CONVENTION] += 1
        moments = FeatureMoments(*np.asarray(row["moments"], np.float64).reshape(5, 5))
        self.moments = moments if self.moments is None else self.moments + moments

    def summary(self) -> Row:
        """Pixels by source and by reason, in total and along time; refuted poses by the convention that they match."""
        if not self.pixels:
            no_pixels: Row = {key: [] for key in ("pixels", "no_answer", "over_time", "no_answer_over_time")}
            return {**no_pixels, "unread": self.unread, "frames": 0, "refuted": {}}
        pixels, no_answer = np.stack(self.pixels), np.stack(self.no_answer)
        parts = np.array_split(np.arange(len(pixels)), min(_N_TIME_BINS, len(pixels)))
        along, reasons = ([x[at].sum(0) / max(1, pixels[at].sum()) for at in parts] for x in (pixels, no_answer))
        more = {"over_time": along, "no_answer_over_time": reasons, "unread": self.unread}
        more |= {"frames": len(pixels), "refuted": dict(sorted(self.refuted.items()))}
        return {"pixels": pixels.sum(0), "no_answer": no_answer.sum(0), **more}

    def of_maps(self) -> tuple[FeatureMoments, FeatureMoments, FeatureMoments] | None:
        """Moments of depth, sigma and the image; None if no frame could be read."""
        if self.moments is None:
            return None
        parts = [FeatureMoments(*(x[span] for x in self.moments)) for span in (slice(0, 1), slice(1, 2), slice(2, 5))]
        return parts[0], parts[1], parts[2]
