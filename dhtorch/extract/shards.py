"""Files of rows: written whole or not at all, and recognised when they need not be written again.

Every shard tells where it comes from. The metadata under ``dhtorch`` are the same in all shards of an extraction: the
meaning of columns and codes, version, settings, key, and a digest of the data. Those under ``dhtorch.shard`` are its
own: its number, and how many of its frames had which problem. No time is noted: the same question gives the same bytes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from dhtorch.data.io.decode import FormatError, import_optional
from dhtorch.extract.columns import Column, Row, arrow_schema, arrow_table
from dhtorch.extract.plan import ShardSpec
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage

#: Key of the metadata that all shards share, and of those of one shard.
_SHARED_METADATA_KEY, _SHARD_METADATA_KEY = b"dhtorch", b"dhtorch.shard"

#: Rows that are held and decoded together: few, because a shuffled loader asks for one, and so many bytes of them at
#: most, because maps are large.
_MAX_GROUP_ROWS, _MAX_GROUP_BYTES = 16, 1 << 24

_PATTERN = "shard-*.parquet"
_UNFINISHED = ".tmp"


def write_shard(
    folder: Path, shard: ShardSpec, rows: Iterable[Row], wanted: Mapping[str, Column], shared: Mapping[str, Any]
) -> Counter[str]:
    """Write one shard, rows as they come; the file appears when it is whole.

    Args:
        folder: exists.
        shard: which one.
        rows: of this shard, fewer where frames were skipped.
        wanted: columns.
        shared: metadata of the extraction.

    Returns:
        Number of rows by problem, and ``skipped``.
    """
    parquet = import_optional("pyarrow.parquet", extra="scale")
    layout = arrow_schema(wanted, {_SHARED_METADATA_KEY.decode(): storage.dump_strict_json(shared)})
    problems = shared["codes"]["problem"]
    counts: Counter[str] = Counter()
    unfinished = folder / f".{shard.name}{_UNFINISHED}"
    with (
        storage.write_atomically(folder / shard.name, unfinished) as file,
        parquet.ParquetWriter(file, layout, compression="zstd") as writer,
    ):
        for group in _iter_groups(rows, _rows_per_group(wanted)):
            counts.update(problems[str(int(row["problem"]))].lower() for row in group)
            writer.write_table(arrow_table(group, wanted, layout))
        counts["skipped"] = len(shard.rows) - counts.total()
        own = {"number": shard.number, "of": shard.of, "counts": dict(sorted(counts.items()))}
        writer.add_key_value_metadata({_SHARD_METADATA_KEY: storage.dump_strict_json(own)})
    return counts


def _rows_per_group(wanted: Mapping[str, Column]) -> int:
    """Rows of such columns that are held together, one at least."""
    return max(1, min(_MAX_GROUP_ROWS, _MAX_GROUP_BYTES // sum(column.n_bytes for column in wanted.values())))


def shard_files(folder: Path) -> list[Path]:
    """The shards in a folder, in the order of their rows."""
    return sorted(folder.glob(_PATTERN))


def remove_unfinished(folder: Path) -> None:
    """Remove what a writer left that was killed. Nobody may be writing there meanwhile."""
    for left in folder.glob(f".{_PATTERN}{_UNFINISHED}"):
        left.unlink(missing_ok=True)


def find_finished_shards(folder: Path, shared: Mapping[str, Any]) -> dict[str, Counter[str]]:
    """Shards in a folder that are whole: name → number of rows by problem.

    Raises:
        FileExistsError: a shard of another extraction; the message says what differs.
    """
    found = {}
    for path in shard_files(folder):
        try:
            other, own = read_shard_metadata(path)
        except FormatError:
            continue  # torn: it is written again
        if other["key"] != shared["key"]:
            found_there = f"a shard of another extraction ({result_files.describe_difference(other, shared)})"
            raise FileExistsError(f"{path}: found {found_there}, expected one of this, or another folder for out")
        found[path.name] = Counter(own["counts"])
    return found


def read_shard_metadata(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The metadata of a shard: what all share, and its own.

    Raises:
        FormatError: no shard of ours, or a torn one.
    """
    parquet = import_optional("pyarrow.parquet", extra="scale")
    try:
        metadata = parquet.read_metadata(path).metadata or {}
        return storage.parse_strict_json(metadata[_SHARED_METADATA_KEY].decode()), storage.parse_strict_json(
            metadata[_SHARD_METADATA_KEY].decode()
        )
    except (OSError, ValueError, KeyError) as error:
        raise FormatError(path, "metadata", f"{type(error).__name__}: {error}", "a shard of dhtorch extract") from None


def _iter_groups(rows: Iterable[Row], size: int) -> Iterator[list[Row]]:
    rows = iter(rows)
    while group := list(islice(rows, size)):
        yield group
