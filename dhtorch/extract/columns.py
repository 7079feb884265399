"""Columns of a row of features: names, shapes, units, and their conversion to an Arrow table.

Alphabet: N samples of a frame, P patches of its token grid.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from dhtorch.codes import names
from dhtorch.data.io.decode import import_optional
from dhtorch.transforms import SampleProblem, schema

Row = dict[str, Any]  # column → number, text or array

#: Columns that identify a row: they come first, and every shard has them.
KEY_COLUMNS = ("episode_index", "frame_index", "timestamp", "recording")

#: Kinds other than numbers → estimated bytes of a value, and the blank one.
_OTHER_KINDS: dict[str, tuple[int, Any]] = {"str": (1, ""), "bytes": (1 << 18, b"")}


class Column(NamedTuple):
    """One column of a table."""

    kind: str  # numpy dtype of a number, "str", or "bytes" = a file
    shape: tuple[int, ...]  # of one row
    unit: str
    about: str

    @property
    def n_bytes(self) -> int:
        """Bytes in memory of one row; files and texts are estimated."""
        if self.kind in _OTHER_KINDS:
            return _OTHER_KINDS[self.kind][0]
        return np.dtype(self.kind).itemsize * math.prod(self.shape)


def feature_columns(
    n: int, patches: int, *, half: bool = False, map_hw: tuple[int, int] | None = None
) -> dict[str, Column]:
    """Numbers of samples and tokens, map size (None = no maps) -> all columns of a row, in order."""
    sizes = {"N": n, "P": patches, **({} if map_hw is None else dict(zip("HW", map_hw, strict=True)))}
    added = schema.columns_of_options(() if map_hw is None else ("dense",))
    return {
        "episode_index": Column("int64", (), "1", "number of the episode in its data set, else of the recording"),
        "frame_index": Column("int64", (), "1", "number of the frame in its capture"),
        "timestamp": Column("float64", (), "s", "time stamp of the frame as its data set has it; NaN = none"),
        "recording": Column("str", (), "1", "name of the recording"),
        **{spec.key: stored_column(spec, sizes, half=half) for spec in added},
    }


def stored_column(spec: schema.ColumnSpec, sizes: Mapping[str, int], *, half: bool = False) -> Column:
    """Column of the transform -> stored column: codes as uint8, with ``half`` suitable floats as float16."""
    kind = "uint8" if spec.codes is not None else "float16" if half and spec.half else spec.dtype
    return Column(kind, schema.resolve_shape(spec.shape, sizes), spec.unit, spec.meaning)


def select_columns(available: Mapping[str, Column], wanted: Sequence[str] | None) -> dict[str, Column]:
    """All columns and wanted names (None = all) -> key columns, wanted columns and ``problem``.

    Raises:
        ValueError: an unknown column.
    """
    for name in wanted or ():
        if name not in available:
            raise ValueError(f"extract.columns: found {name!r}, expected some of {', '.join(available)}")
    keep = set(available if wanted is None else wanted) | {*KEY_COLUMNS, "problem"}
    return {name: column for name, column in available.items() if name in keep}


def blank_features(wanted: Mapping[str, Column]) -> Row:
    """Columns -> features of an unreadable frame: zeros, and ``problem`` UNREADABLE."""
    blank = {
        k: _OTHER_KINDS[c.kind][1] if c.kind in _OTHER_KINDS else np.zeros(c.shape, c.kind)
        for k, c in wanted.items()
        if k not in KEY_COLUMNS
    }
    return {**blank, "problem": np.asarray(SampleProblem.UNREADABLE, wanted["problem"].kind)}


def code_tables() -> dict[str, dict[int, str]]:
    """Column → code → name, for the metadata of a file."""
    return {spec.key: names(spec.codes) for spec in schema.COLUMNS if spec.codes is not None}


def arrow_schema(wanted: Mapping[str, Column], metadata: Mapping[str, str]) -> Any:
    """Columns and metadata -> Arrow schema: fixed-size lists, unit and meaning in every field."""
    pyarrow = import_optional("pyarrow")
    fields = [
        pyarrow.field(name, _arrow_type(pyarrow, c), nullable=False, metadata={"unit": c.unit, "about": c.about})
        for name, c in wanted.items()
    ]
    return pyarrow.schema(fields, metadata=dict(metadata))


def arrow_table(rows: Iterable[Row], wanted: Mapping[str, Column], layout: Any) -> Any:
    """Rows (at least one) -> Arrow table with the schema of :func:`arrow_schema`."""
    pyarrow = import_optional("pyarrow")
    rows = list(rows)
    arrays = []
    for name, column in wanted.items():
        if column.kind in _OTHER_KINDS:
            arrays.append(pyarrow.array([row[name] for row in rows], _arrow_type(pyarrow, column)))
            continue
        values = np.stack([np.asarray(row[name]).astype(column.kind) for row in rows])
        array = pyarrow.array(values.reshape(-1))
        for size in reversed(column.shape):
            array = pyarrow.FixedSizeListArray.from_arrays(array, size)
        arrays.append(array)
    return pyarrow.Table.from_arrays(arrays, schema=layout)


def _arrow_type(pyarrow: Any, column: Column) -> Any:
    other_kinds = {"str": pyarrow.string(), "bytes": pyarrow.binary()}
    kind = other_kinds.get(column.kind) or pyarrow.from_numpy_dtype(np.dtype(column.kind))
    for size in reversed(column.shape):
        kind = pyarrow.list_(kind, size)
    return kind
