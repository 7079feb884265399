"""The rows of an episode's shards as they are asked for: of one camera frame by frame, of several by their instants."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from dhtorch.data.io.decode import import_optional
from dhtorch.extract.columns import Row
from dhtorch.extract.origin import TABLE_GROUP_ROWS


def iter_rows(parts: Sequence[Path]) -> Iterator[Row]:
    """The rows of some shards in their order, held one group at a time."""
    parquet = import_optional("pyarrow.parquet", extra="scale")
    for path in parts:
        with parquet.ParquetFile(path) as file:
            for batch in file.iter_batches(batch_size=8):
                yield from batch.to_pylist()


class PeekableRows:
    """Rows of which the first is looked at before it is taken."""

    def __init__(self, rows: Iterator[Row]) -> None:
        self.rows = rows
        self.row = next(rows, None)

    def take(self, frame: int) -> Row | None:
        """The next row if it is that of the frame."""
        row = self.row
        if row is None or row["frame_index"] != frame:
            return None
        self.row = next(self.rows, None)
        return row

    def drop(self) -> None:
        """Pass over the next row."""
        self.row = next(self.rows, None)


def iter_instants(made: Mapping[str, PeekableRows]) -> Iterator[dict[str, Row]]:
    """The rows of one instant of all cameras; those without their instant are passed over."""
    while all(rows.row is not None for rows in made.values()):
        latest = max(rows.row["frame_index"] for rows in made.values() if rows.row is not None)
        for rows in made.values():
            while rows.row is not None and rows.row["frame_index"] < latest:
                rows.drop()
        if all(rows.row is not None and rows.row["frame_index"] == latest for rows in made.values()):
            yield {key: row for key, rows in made.items() if (row := rows.take(latest)) is not None}


def iter_groups(rows: Iterable[dict[str, Row]]) -> Iterator[list[dict[str, Row]]]:
    """So many that are held together."""
    group: list[dict[str, Row]] = []
    for row in rows:
        group.append(row)
        if len(group) == TABLE_GROUP_ROWS:
            yield group
            group = []
    if group:
        yield group
