"""Rows of an episode read lazily from its shards: of one camera by frame, of several cameras by instant."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from dhtorch.data.io.decode import import_optional
from dhtorch.extract.columns import Row
from dhtorch.extract.origin import TABLE_GROUP_ROWS


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

    def drop(self) -> None:
        """Skip the next row."""
        self.row = next(self.rows, None)


def iter_instants(rows_by_camera: Mapping[str, PeekableRows]) -> Iterator[dict[str, Row]]:
    """Rows by camera -> rows of each instant that all cameras have; other rows are skipped."""
    while all(rows.row is not None for rows in rows_by_camera.values()):
        latest = max(rows.row["frame_index"] for rows in rows_by_camera.values() if rows.row is not None)
        for rows in rows_by_camera.values():
            while rows.row is not None and rows.row["frame_index"] < latest:
                rows.drop()
        if all(rows.row is not None and rows.row["frame_index"] == latest for rows in rows_by_camera.values()):
            yield {key: row for key, rows in rows_by_camera.items() if (row := rows.take(latest)) is not None}


def iter_groups(rows: Iterable[dict[str, Row]]) -> Iterator[list[dict[str, Row]]]:
    """Instants -> lists of up to ``TABLE_GROUP_ROWS`` of them."""
    group: list[dict[str, Row]] = []
    for row in rows:
        group.append(row)
        if len(group) == TABLE_GROUP_ROWS:
            yield group
            group = []
    if group:
        yield group
