"""Codec of parquet tables: selected columns and rows as arrays, without reading the rest of the file.

The footer is checked before it reaches the decoder, and every column chunk before it is decoded: the sizes in its page
headers must add up to the footer's and stay below a limit, so that a page cannot unpack into gigabytes.
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

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


class _ParquetHeader(NamedTuple):
    """Number of rows, column names and row groups of a table, from its footer."""

    rows: int
    columns: tuple[str, ...]
    groups: tuple[int, ...]  # first row of each row group, and the number of rows


def read_parquet_header(file: Path) -> _ParquetHeader:
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
    first, end = rows or (0, header.rows)
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


def read_row(file: Path, columns: tuple[str, ...], row: int) -> dict[str, Any]:
    """The values of a row; its row group is cached, so that neighbouring rows are not decoded again.

    Raises:
        FormatError: as :func:`read_columns`.
    """
    version = read_version(file)
    starts = _cached_groups(file, version)
    if not 0 <= row < starts[-1]:
        raise FormatError(file, "rows", starts[-1], f"row {row}")
    group = int(np.searchsorted(starts, row, "right")) - 1
    values = _cached_rows(file, version, columns, (starts[group], starts[group + 1]))
    return {name: values[name][row - starts[group]] for name in columns}


@lru_cache(maxsize=1024)
def _cached_groups(file: Path, _version: tuple[int, ...]) -> tuple[int, ...]:
    return read_parquet_header(file).groups


@lru_cache(maxsize=4)
def _cached_rows(file: Path, _version: tuple[int, ...], columns: tuple[str, ...], rows: tuple[int, int]) -> Any:
    return read_columns(file, columns, rows)


def _open_table(file: Path) -> tuple[Any, _ParquetHeader]:
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
    return table, _ParquetHeader(meta.num_rows, names, tuple(starts))


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


#: Physical types and codecs, indexed by their numbers in a footer.
_PHYSICAL_TYPES = ("BOOLEAN", "INT32", "INT64", "INT96", "FLOAT", "DOUBLE", "BYTE_ARRAY", "FIXED_LEN_BYTE_ARRAY")
_CODECS = ("UNCOMPRESSED", "SNAPPY", "GZIP", "LZO", "BROTLI", "LZ4", "ZSTD", "LZ4_RAW")
_TYPE_BYTES = {"INT32": 4, "FLOAT": 4, "INT96": 12, "BOOLEAN": 1}
_DAMAGE = (IndexError, KeyError, TypeError, ValueError, AttributeError)  # errors of the parser below


class _Chunk(NamedTuple):
    """One column of one row group, as described in the footer."""

    path: str
    kind: str  # of _PHYSICAL_TYPES
    codec: str  # of _CODECS
    values: int
    unpacked: int  # bytes, with page headers
    packed: int
    start: int  # of the first page


def _check_pages(file: Path, columns: Sequence[str], groups: Sequence[int]) -> None:
    """Raise FormatError where a chunk's pages, by their headers, unpack to more than the footer's size or the limit."""
    total, chunks = 0, _read_chunks(file, frozenset(groups))
    with open_regular(file) as stream:
        limit = max(_MAX_UNPACKED_BYTES, MAX_MEMORY_RATIO * stream.seek(0, 2))
        for chunk in chunks:
            if not any(chunk.path == name or chunk.path.startswith(f"{name}.") for name in columns):
                continue
            path, values, width = chunk.path, 0, _TYPE_BYTES.get(chunk.kind, 8)
            if chunk.start < 4 or not 0 <= chunk.packed <= MAX_FILE_BYTES:
                raise FormatError(file, path, f"{chunk.packed} bytes at {chunk.start}", "a column inside the file")
            stream.seek(chunk.start)
            data = _Thrift(stream.read(chunk.packed))
            while data.at < len(data.bytes) and values < chunk.values:
                try:
                    page = data.struct()
                    full, packed = int(page[2]), int(page[3])
                    inner = page.get(5) or page.get(8) or {}
                    count, entries = int(inner.get(1, 0)), int((page.get(7) or {}).get(1, 0))
                except _DAMAGE as error:
                    raise FormatError(file, path, f"a page header: {error}", "a whole page") from None
                if min(full, packed, count) < 0 or packed > len(data.bytes) - data.at or full > chunk.unpacked:
                    problem = f"a page of {packed} bytes that unpack into {full}"
                    raise FormatError(file, path, problem, f"at most {chunk.unpacked}")
                values += count
                if entries and chunk.kind.endswith("BYTE_ARRAY"):
                    content = data.bytes[data.at : data.at + packed]
                    width = max(width, _longest_dictionary_entry(file, chunk, content, full))
                total += max(full, width * max(count, entries))
                data.at += packed
            if values != chunk.values:
                raise FormatError(file, path, f"pages of {values} values", chunk.values)
            if total > limit:
                raise FormatError(file, path, f"{total} bytes", f"at most {limit}")


def _read_chunks(file: Path, groups: frozenset[int]) -> list[_Chunk]:
    """The chunks of the given row groups; parsed here, since Arrow aborts the process on damaged chunk metadata."""
    size = _footer_size(file)
    with open_regular(file) as stream:
        stream.seek(-8 - size, 2)
        footer = stream.read(size)
    chunks = []
    try:
        for number, group in enumerate(_Thrift(footer)._iter_structs(4)):
            for fields in (column[3] for column in group[1]) if number in groups else ():
                start, dictionary = int(fields[9]), int(fields.get(11) or 0)
                kind, codec, values, unpacked, packed = (int(fields[k]) for k in (1, 4, 5, 6, 7))
                path = b".".join(fields[3]).decode("utf-8", "replace")
                if min(kind, codec) < 0:
                    raise ValueError(f"type {kind} and codec {codec} of {path}")
                start = dictionary if 0 < dictionary < start else start
                chunks.append(_Chunk(path, _PHYSICAL_TYPES[kind], _CODECS[codec], values, unpacked, packed, start))
    except _DAMAGE as error:
        raise FormatError(file, "footer", error, "a whole parquet file") from None
    return chunks


def _longest_dictionary_entry(file: Path, chunk: _Chunk, packed: bytes, full: int) -> int:
    """Bytes of a dictionary's longest entry: a row takes a few bits in the file but a whole entry in memory."""
    pyarrow = import_optional("pyarrow")
    if full > _MAX_UNPACKED_BYTES or chunk.kind != "BYTE_ARRAY":
        return full  # a fixed length is at most the whole page
    plain = packed
    try:
        if chunk.codec != "UNCOMPRESSED":
            plain = pyarrow.Codec(chunk.codec.lower()).decompress(packed, full, asbytes=True)
    except (pyarrow.ArrowException, OSError, ValueError, TypeError) as error:
        raise FormatError(file, chunk.path, error, "a dictionary that unpacks") from None
    at = longest = 0
    while at + 4 <= len(plain):
        length = int.from_bytes(plain[at : at + 4], "little")
        at, longest = at + 4 + length, max(longest, length)
    return longest


class _Thrift:
    """Values of Thrift's compact protocol in turn, as far as Parquet uses it; damage is one of ``_DAMAGE``."""

    def __init__(self, data: bytes) -> None:
        self.bytes, self.at = data, 0

    def struct(self, depth: int = 0) -> dict[int, Any]:
        """The structure here: field number → value."""
        return {number: self._value(kind, depth) for number, kind in self._fields()}

    def _iter_structs(self, field: int) -> Iterator[dict[int, Any]]:
        """The structures in the list that is this field of the structure here, one by one."""
        for number, kind in self._fields():
            if number != field or kind != 9:
                self._value(kind, 0)
                continue
            count, item_kind = self._list_header()
            if item_kind != 12:
                raise ValueError(f"a list of type {item_kind}")
            for _ in range(count):
                yield self.struct(1)
            return
        raise ValueError(f"no list in field {field}")

    def _fields(self) -> Iterator[tuple[int, int]]:
        """(number, type) of each field of a structure; its value stands here."""
        number = 0
        while head := self._byte():
            number = number + (head >> 4) if head >> 4 else self._zigzag()
            yield number, head & 15

    def _value(self, kind: int, depth: int, in_list: bool = False) -> Any:
        if depth > 12:  # a Parquet footer has nine levels of structures and lists
            raise ValueError("structures nested too deep")
        if kind in (1, 2):  # true and false are encoded in the type; in a list they take a byte
            return self._byte() == 1 if in_list else kind == 1
        if kind in (4, 5, 6):
            return self._zigzag()
        if kind == 3:
            return self._byte()
        if kind in (7, 8):  # a double, which is not needed, or a string
            length = 8 if kind == 7 else self._varint()
            if length > len(self.bytes) - self.at:
                raise ValueError("a string beyond the end")
            self.at += length
            return self.bytes[self.at - length : self.at]
        if kind in (9, 10):
            count, kind = self._list_header()
            return [self._value(kind, depth + 1, in_list=True) for _ in range(count)]
        if kind == 12:
            return self.struct(depth + 1)
        raise ValueError(f"a field of type {kind}")

    def _list_header(self) -> tuple[int, int]:
        """(length, type) of a list."""
        head = self._byte()
        count = head >> 4 if head >> 4 < 15 else self._varint()
        if count > len(self.bytes) - self.at:  # every value takes at least a byte
            raise ValueError(f"a list of {count} values in {len(self.bytes) - self.at} bytes")
        return count, head & 15

    def _byte(self) -> int:
        self.at += 1
        return self.bytes[self.at - 1]

    def _varint(self) -> int:
        number = 0
        for shift in range(0, 70, 7):
            byte = self._byte()
            number |= (byte & 127) << shift
            if byte < 128:
                return number
        raise ValueError("an unterminated number")

    def _zigzag(self) -> int:
        number = self._varint()
        return (number >> 1) ^ -(number & 1)
