"""Codec of parquet tables: selected columns and rows as arrays, without reading the rest of the file.

The footer is checked before it reaches the decoder, and every column chunk before it is decoded: the sizes in its page
headers must add up to the footer's and stay below a limit, so that a page cannot unpack into gigabytes.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dhtorch.data.codecs import thrift
from dhtorch.data.io.decode import FormatError, import_optional
from dhtorch.runtime.safe_open import (
    MAX_FILE_BYTES,
    MAX_MEMORY_BYTES,
    MAX_MEMORY_RATIO,
    MAX_TEXT_BYTES,
    open_regular,
    read_version,
    unreadable_error,
)

_MAX_ROWS = 50_000_000

#: Limit of the unpacked bytes of the requested columns, where the file is small: decoding makes a few copies.
_MAX_UNPACKED_BYTES = MAX_MEMORY_BYTES // 4


class ParquetHeader(NamedTuple):
    """Number of rows, column names and row groups of a table, from its footer."""

    rows: int
    columns: tuple[str, ...]
    groups: tuple[int, ...]  # first row of each row group, and the number of rows


def read_parquet_header(file: Path) -> ParquetHeader:
    """Rows, columns and row groups of a table; reads only its footer.

    Raises:
        FormatError: missing, truncated or damaged file, or more than ``_MAX_ROWS`` rows.
        ImportError: no decoder is installed.
    """
    return _open_table(file)[1]


def read_columns(
    file: Path,
    columns: Sequence[str],
    rows: tuple[int, int] | None = None,
    *,
    optional: Sequence[str] = (),
) -> dict[str, np.ndarray | list[Any]]:
    """Columns of the rows ``first`` to ``end`` (exclusive), decoding only the row groups that hold them.

    Args:
        file: a table.
        columns: names.
        rows: ``first`` and ``end``; None = all.
        optional: further columns, read where the table has them.

    Returns:
        For each name an array (rows, …) of numbers, or a list where the column holds texts, bytes or structures. Lists
        of numbers of one length, nested as deep as they like, become the further axes of the array.

    Raises:
        FormatError: as :func:`read_parquet_header`; no such column or rows, values missing, or lists of unequal length.
        ImportError: no decoder is installed.
    """
    table, header = _open_table(file)
    columns = [*columns, *(name for name in optional if name in header.columns and name not in columns)]
    return _read_open_columns(file, (table, header), columns, rows or (0, header.rows))


def _read_open_columns(
    file: Path, opened: tuple[Any, ParquetHeader], columns: Sequence[str], rows: tuple[int, int]
) -> dict[str, np.ndarray | list[Any]]:
    """As :func:`read_columns`, of an opened table."""
    (table, header), (first, end) = opened, rows
    missing = [name for name in columns if name not in header.columns]
    if missing:
        raise FormatError(file, "columns", ", ".join(header.columns), ", ".join(missing))
    if not 0 <= first <= end <= header.rows:
        raise FormatError(file, "rows", header.rows, f"rows {first} to {end - 1}")
    spans = list(zip(header.groups, header.groups[1:], strict=False))
    groups = [i for i, (low, high) in enumerate(spans) if low < end and high > first]
    pyarrow = import_optional("pyarrow")
    try:
        _check_pages(file, columns, groups)
        read = table.read_row_groups(groups, columns=list(columns), use_threads=False)
        start = first - (spans[groups[0]][0] if groups else 0)
        if groups and read.num_rows != spans[groups[-1]][1] - spans[groups[0]][0]:
            raise FormatError(file, "rows", read.num_rows, "as many as in the footer")
        rows_read = read.slice(start, end - first)
        return {name: _column_to_array(rows_read.column(name).combine_chunks(), file, name) for name in columns}
    except (pyarrow.ArrowException, OSError, ValueError, TypeError, KeyError, MemoryError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(file, "data", error, "decodable columns") from None


def read_cell(file: Path, column: str, row: int) -> Any:
    """One value of a column; its row group is cached, so that neighbouring rows are not decoded again.

    Raises:
        FormatError: as :func:`read_columns`.
    """
    key = (file, read_version(file), column)
    first, values = _row_group_cache.get(key, (0, ()))
    if not first <= row < first + len(values):
        _row_group_cache.pop(key, None)
        while len(_row_group_cache) >= _MAX_CACHED:
            _row_group_cache.popitem(last=False)
        table, header = _open_table(file)
        starts = header.groups
        if not 0 <= row < starts[-1]:
            raise FormatError(file, "rows", starts[-1], f"row {row}")
        group = int(np.searchsorted(starts, row, "right")) - 1
        rows = starts[group], starts[group + 1]
        first, values = rows[0], _read_open_columns(file, (table, header), [column], rows)[column]
        _row_group_cache[key] = (first, values)
    return values[row - first]


#: Cache of row groups: (file, its version, column) → first row and values.
_row_group_cache: OrderedDict[tuple[Path, tuple[int, ...], str], tuple[int, Any]] = OrderedDict()
_MAX_CACHED = 4


def _open_table(file: Path) -> tuple[Any, ParquetHeader]:
    size = _footer_size(file)
    pyarrow, parquet = import_optional("pyarrow"), import_optional("pyarrow.parquet")
    limits = {"thrift_string_size_limit": size, "thrift_container_size_limit": max(size, 1)}
    try:
        table = parquet.ParquetFile(file, memory_map=False, pre_buffer=False, **limits)
        meta = table.metadata
        counts = [meta.row_group(i).num_rows for i in range(meta.num_row_groups)]
        names = tuple(table.schema_arrow.names)
    except (pyarrow.ArrowException, OSError, ValueError, TypeError, KeyError, MemoryError) as error:
        raise FormatError(file, "footer", error, "a whole parquet file") from None
    if min(counts, default=0) < 0 or sum(counts) != meta.num_rows or meta.num_rows > _MAX_ROWS:
        raise FormatError(file, "footer", f"{meta.num_rows} rows in groups of {counts[:4]}", f"at most {_MAX_ROWS}")
    starts = np.cumsum([0, *counts]).tolist()
    return table, ParquetHeader(meta.num_rows, names, tuple(starts))


def _footer_size(file: Path) -> int:
    try:
        with open_regular(file) as stream:
            head = stream.read(4)
            size = stream.seek(0, 2)
            stream.seek(max(size - 8, 0))
            tail = stream.read(8)
    except OSError as error:
        raise unreadable_error(file, error) from None
    length = int.from_bytes(tail[:4], "little")
    if size < 12 or head != b"PAR1" or tail[4:] != b"PAR1" or not 0 < length <= min(size - 12, MAX_TEXT_BYTES):
        raise FormatError(file, "file", f"{size} bytes from {head!r} to {tail[4:]!r}", "a whole parquet file")
    return length


# ----------------------------------------------------------------------------------------------------------- values


def _column_to_array(column: Any, file: Path, name: str) -> np.ndarray | list[Any]:
    """Arrow's nested lists → the axes of an array."""
    types = import_optional("pyarrow.types")
    if column.null_count:
        raise FormatError(file, name, f"{column.null_count} missing values", "a value in every row")
    kind = getattr(column.type, "storage_type", column.type)
    column = getattr(column, "storage", column)
    if types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind):
        return column.to_numpy(zero_copy_only=False)
    if not (types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind)):
        return column.to_pylist()
    count = len(column)
    inner = _column_to_array(column.flatten(), file, name)
    if isinstance(inner, list):
        return column.to_pylist()
    if types.is_fixed_size_list(kind):
        width = kind.list_size
    else:
        widths = np.diff(column.offsets.to_numpy())
        width = int(widths[0]) if count else 0
        if (widths != width).any():
            raise FormatError(file, name, "lists of unequal length", "one length for all rows")
    if len(inner) != count * width:
        raise FormatError(file, name, f"{len(inner)} numbers", f"{width} for each of {count} rows")
    return inner.reshape(count, width, *inner.shape[1:])


# ------------------------------------------------------------------------------------------------------------ pages


class _Chunk(NamedTuple):
    """One column of one row group, as described in the footer."""

    path: str
    kind: int  # index in _PHYSICAL_TYPES
    codec: int  # index in _CODECS
    values: int
    unpacked: int  # bytes, with page headers
    packed: int
    start: int  # of the first page


#: Physical types and codecs, indexed by their numbers in a footer.
_PHYSICAL_TYPES = ("BOOLEAN", "INT32", "INT64", "INT96", "FLOAT", "DOUBLE", "BYTE_ARRAY", "FIXED_LEN_BYTE_ARRAY")
_CODECS = ("UNCOMPRESSED", "SNAPPY", "GZIP", "LZO", "BROTLI", "LZ4", "ZSTD", "LZ4_RAW")
_TYPE_BYTES = {"INT32": 4, "FLOAT": 4, "INT96": 12, "BOOLEAN": 1}
_STRING_TYPES = ("BYTE_ARRAY", "FIXED_LEN_BYTE_ARRAY")


def _check_pages(file: Path, columns: Sequence[str], groups: Sequence[int]) -> None:
    """Raise FormatError where a chunk's pages, by their headers, unpack to more than the footer's size or the limit."""
    total = 0
    chunks = _read_chunks(file, frozenset(groups))
    with open_regular(file) as stream:
        limit = max(_MAX_UNPACKED_BYTES, MAX_MEMORY_RATIO * stream.seek(0, 2))
        for chunk in chunks:
            if any(chunk.path == name or chunk.path.startswith(f"{name}.") for name in columns):
                total += _unpacked_chunk_bytes(file, stream, chunk)
            if total > limit:
                raise FormatError(file, chunk.path, f"{total} bytes", f"at most {limit}")


def _read_chunks(file: Path, groups: frozenset[int]) -> list[_Chunk]:
    """The chunks of the given row groups; parsed here, since Arrow aborts the process on damaged chunk metadata."""
    key = (file, read_version(file), groups)
    if key in _chunk_cache:
        return _chunk_cache[key]
    size = _footer_size(file)
    with open_regular(file) as stream:
        stream.seek(-8 - size, 2)
        footer = stream.read(size)
    try:
        enumerated = enumerate(thrift.iter_list_structs(footer, 0, 4))
        chunks = [_parse_chunk(column[3]) for g, group in enumerated if g in groups for column in group[1]]
    except (IndexError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise FormatError(file, "footer", error, "a whole parquet file") from None
    while len(_chunk_cache) >= _MAX_CACHED:
        _chunk_cache.popitem(last=False)
    _chunk_cache[key] = chunks
    return chunks


#: Cache of chunks: (file, its version, row groups) → chunks.
_chunk_cache: OrderedDict[tuple[Path, tuple[int, ...], frozenset[int]], list[_Chunk]] = OrderedDict()


def _parse_chunk(fields: dict[int, Any]) -> _Chunk:
    path = b".".join(fields[3]).decode("utf-8", "replace")
    start, dictionary = int(fields[9]), int(fields.get(11) or 0)
    start = dictionary if 0 < dictionary < start else start
    numbers = [int(fields[k]) for k in (1, 4, 5, 6, 7)]
    if not (0 <= numbers[0] < len(_PHYSICAL_TYPES) and 0 <= numbers[1] < len(_CODECS)):
        raise ValueError(f"type {numbers[0]} and codec {numbers[1]} of {path}")
    return _Chunk(path, numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], start)


def _unpacked_chunk_bytes(file: Path, stream: Any, chunk: _Chunk) -> int:
    """Unpacked bytes of the pages of one column chunk."""
    values = unpacked = at = 0
    width = _TYPE_BYTES.get(_PHYSICAL_TYPES[chunk.kind], 8)
    if chunk.start < 4 or not 0 <= chunk.packed <= MAX_FILE_BYTES:
        raise FormatError(file, chunk.path, f"{chunk.packed} bytes at {chunk.start}", "a column inside the file")
    stream.seek(chunk.start)
    data = stream.read(chunk.packed)
    while at < len(data) and values < chunk.values:
        try:
            page, at = thrift.parse_struct(data, at)
            full, packed = int(page[2]), int(page[3])
            inner = page.get(5) or page.get(8) or {}
            count, entries = int(inner.get(1, 0)), int((page.get(7) or {}).get(1, 0))
        except (IndexError, KeyError, TypeError, ValueError, AttributeError) as error:
            raise FormatError(file, chunk.path, f"a page header: {error}", "a whole page") from None
        if min(full, packed, count) < 0 or packed > len(data) - at or full > chunk.unpacked:
            problem = f"a page of {packed} bytes that unpack into {full}"
            raise FormatError(file, chunk.path, problem, f"at most {chunk.unpacked}")
        values += count
        if entries and _PHYSICAL_TYPES[chunk.kind] in _STRING_TYPES:
            width = max(width, _longest_dictionary_entry(file, chunk, data[at : at + packed], full))
        unpacked += max(full, width * max(count, entries))
        at += packed
    if values != chunk.values:
        raise FormatError(file, chunk.path, f"pages of {values} values", chunk.values)
    return unpacked


def _longest_dictionary_entry(file: Path, chunk: _Chunk, packed: bytes, full: int) -> int:
    """Bytes of a dictionary's longest entry: a row takes a few bits in the file but a whole entry in memory."""
    pyarrow = import_optional("pyarrow")
    if full > _MAX_UNPACKED_BYTES or _PHYSICAL_TYPES[chunk.kind] != "BYTE_ARRAY":
        return full  # a fixed length is at most the whole page
    try:
        plain = packed
        if _CODECS[chunk.codec] != "UNCOMPRESSED":
            plain = pyarrow.Codec(_CODECS[chunk.codec].lower()).decompress(packed, full, asbytes=True)
    except (pyarrow.ArrowException, OSError, ValueError, TypeError) as error:
        raise FormatError(file, chunk.path, error, "a dictionary that unpacks") from None
    at = longest = 0
    while at + 4 <= len(plain):
        length = int.from_bytes(plain[at : at + 4], "little")
        at, longest = at + 4 + length, max(longest, length)
    return longest
