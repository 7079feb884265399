"""Parquet files of rows: written atomically, with metadata that identify finished ones.

The metadata under ``dhtorch`` are the same in all shards of an extraction: meaning of columns and codes, version,
settings, key, and a digest of the data. Those under ``dhtorch.shard`` belong to one shard: its number, and its counts
of frames by problem. No time is stored, so that the same settings and data give the same bytes.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError, import_optional
from dhtorch.extract.columns import Column, Row, arrow_schema, arrow_table
from dhtorch.extract.plan import ShardSpec
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage
from dhtorch.runtime.safe_open import check_regular_file

#: Key of the metadata that all shards share.
_SHARED_METADATA_KEY = b"dhtorch"

#: Key of the metadata of one shard.
_SHARD_METADATA_KEY = b"dhtorch.shard"


def write_shard(
    folder: Path, shard: ShardSpec, rows: Iterable[Row], wanted: Mapping[str, Column], shared: Mapping[str, Any]
) -> Counter[str]:
    """Write the rows of one shard as they arrive; the file appears when it is complete.

    Args:
        folder: of the shards, exists.
        shard: to write.
        rows: of this shard, fewer if frames were skipped.
        wanted: columns.
        shared: metadata of the extraction.

    Returns:
        Number of rows by problem, and of the skipped ones as ``skipped``.
    """
    parquet = import_optional("pyarrow.parquet")
    layout = arrow_schema(wanted, {_SHARED_METADATA_KEY.decode(): storage.dump_strict_json(shared)})
    problems = shared["codes"]["problem"]
    counts: Counter[str] = Counter()
    with (
        storage.write_atomically(folder / shard.name) as file,
        parquet.ParquetWriter(file, layout, compression="zstd") as writer,
    ):
        # A row group is decoded as a whole: few rows, because a shuffled loader reads one at a time; maps are large.
        row_bytes = sum(column.n_bytes for column in wanted.values())
        for group in iter_groups(rows, max(1, min(16, (1 << 24) // row_bytes))):
            counts.update(problems[str(int(row["problem"]))].lower() for row in group)
            writer.write_table(arrow_table(group, wanted, layout))
        counts["skipped"] = len(shard.rows) - counts.total()
        shard_metadata = {"number": shard.number, "of": shard.of, "counts": dict(sorted(counts.items()))}
        writer.add_key_value_metadata({_SHARD_METADATA_KEY: storage.dump_strict_json(shard_metadata)})
    return counts


def shard_files(folder: Path) -> list[Path]:
    """Folder -> its shards, in the order of their rows."""
    return sorted(folder.glob("shard-*.parquet"))


def find_finished_shards(folder: Path, shared: Mapping[str, Any]) -> dict[str, Counter[str]]:
    """Folder and metadata of the extraction -> complete shards: name → number of rows by problem.

    Raises:
        FileExistsError: a shard of another extraction; the message lists what differs.
    """
    finished = {}
    for path in shard_files(folder):
        try:
            metadata, shard_metadata = read_shard_metadata(path)
        except FormatError:
            continue  # damaged: it is written again
        if metadata["key"] != shared["key"]:
            mismatch = f"a shard of another extraction ({result_files.describe_difference(metadata, shared)})"
            raise FileExistsError(
                f"{path}: found {mismatch}, expected one of this extraction, or another folder for out"
            )
        finished[path.name] = Counter(shard_metadata["counts"])
    return finished


def read_shard_metadata(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Shard -> metadata shared by all shards, metadata of this shard.

    Raises:
        FormatError: no shard of dhtorch extract, or a damaged one.
    """
    parquet = import_optional("pyarrow.parquet")
    check_regular_file(path)
    try:
        metadata = parquet.read_metadata(path).metadata or {}
        keys = (_SHARED_METADATA_KEY, _SHARD_METADATA_KEY)
        shared, own = (storage.parse_strict_json(metadata[key].decode()) for key in keys)
    except (OSError, ValueError, KeyError) as error:
        raise FormatError(path, "metadata", f"{type(error).__name__}: {error}", "a shard of dhtorch extract") from None
    fields: dict[str, type] = {"key": str, "config": dict, "columns": dict, "data.digest": str}
    for name, kind in {**fields, "of": int, "counts": dict}.items():
        files.get_entry(shared if name in fields else own, name, kind, path)
    return shared, own


def iter_groups(rows: Iterable[Any], size: int) -> Iterator[list[Any]]:
    """Rows -> lists of up to ``size`` of them."""
    rows = iter(rows)
    while group := list(islice(rows, size)):
        yield group
