"""Interface of the formats of an enriched data set: episodes are written atomically, each with a summary.

The maps of an episode are stored in shards until all are computed; then they are joined with its rows, few at a time,
into one file, whose metadata hold the summary of all rows. After an interruption the file of that episode is rewritten.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dhtorch.data.io.decode import import_optional
from dhtorch.export.lerobot import FeatureMoments, LogHistogram
from dhtorch.extract.columns import Row
from dhtorch.geometry.pose_conventions import CONVENTIONS

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
        self.ranges = [LogHistogram.parse([])] * 3  # of depth, sigma, and sigma / depth of recovered pixels
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
        ranges = np.asarray(row["ranges"], np.int64).reshape(3, -1)
        self.ranges = [total + LogHistogram(counts) for total, counts in zip(self.ranges, ranges, strict=True)]

    def summary(self) -> Row:
        """Pixels by source and by reason, in total and along time; recovered ones by sigma / depth, see LogHistogram;
        refuted poses by the convention that they match."""
        if not self.pixels:
            keys = ("pixels", "no_answer", "over_time", "no_answer_over_time", "recovered_sigma_rel_bins")
            no_pixels: Row = {key: [] for key in keys}
            return {**no_pixels, "unread": self.unread, "frames": 0, "refuted": {}}
        pixels, no_answer = np.stack(self.pixels), np.stack(self.no_answer)
        parts = np.array_split(np.arange(len(pixels)), min(24, len(pixels)))
        along, reasons = ([x[at].sum(0) / max(1, pixels[at].sum()) for at in parts] for x in (pixels, no_answer))
        more = {"over_time": along, "no_answer_over_time": reasons, "unread": self.unread}
        more |= {"frames": len(pixels), "refuted": dict(sorted(self.refuted.items()))}
        more |= {"recovered_sigma_rel_bins": self.ranges[2].pack()}
        return {"pixels": pixels.sum(0), "no_answer": no_answer.sum(0), **more}


def iter_rows(parts: Sequence[Path]) -> Iterator[Row]:
    """Shards -> their rows in order, one group in memory at a time."""
    parquet = import_optional("pyarrow.parquet")
    for path in parts:
        with parquet.ParquetFile(path) as file:
            for batch in file.iter_batches(batch_size=8):
                yield from batch.to_pylist()


class PeekableRows:
    """Iterator over rows with access to the next row before it is taken."""

    def __init__(self, rows: Iterator[Row]) -> None:
        self.rows = rows
        self.row = next(rows, None)

    def take(self, frame: int) -> Row | None:
        """Frame number -> the next row if it belongs to that frame, else None."""
        row = self.row
        if row is None or row["frame_index"] != frame:
            return None
        self.row = next(self.rows, None)
        return row


def iter_instants(rows_by_camera: Mapping[str, PeekableRows]) -> Iterator[dict[str, Row]]:
    """Rows by camera -> rows of each instant that all cameras have; other rows are skipped."""
    while all(rows.row is not None for rows in rows_by_camera.values()):
        latest = max(rows.row["frame_index"] for rows in rows_by_camera.values() if rows.row is not None)
        for rows in rows_by_camera.values():
            while rows.row is not None and rows.row["frame_index"] < latest:
                rows.row = next(rows.rows, None)
        if all(rows.row is not None and rows.row["frame_index"] == latest for rows in rows_by_camera.values()):
            yield {key: row for key, rows in rows_by_camera.items() if (row := rows.take(latest)) is not None}
