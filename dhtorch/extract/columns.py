"""What a row of features is: names, shapes, units, and how arrays become columns of an Arrow table.

Alphabet: N samples of a frame, P patches of its token grid.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from dhtorch.codes import Flag, Gate, Hole, PoseCode, Source, names
from dhtorch.data.io.decode import import_optional
from dhtorch.transforms import TOKEN_CHANNELS, SampleProblem, maps

Row = dict[str, Any]  # column → number, text or array

#: Where a row belongs: these columns come first, and every shard has them.
KEY_COLUMNS = ("episode_index", "frame_index", "timestamp", "recording")

#: Columns with codes → their table.
_COLUMN_CODES: dict[str, type] = {
    "source": Source,
    "flag": Flag,
    "hole": Hole,
    "gate": Gate,
    "pose_code": PoseCode,
    "problem": SampleProblem,
    "source_map": Source,
    "gate_map": Gate,
}

#: Columns of floats that keep their meaning with eleven bits; pixels and poses do not.
_HALF_COLUMNS = ("xyz", "depth", "sigma", "score", "tokens", *maps.MAP_NUMBER_KEYS)


#: Kinds that are no numbers → bytes of one, roughly.
_GUESSED_BYTES = {"str": 1, "bytes": 1 << 18}


class Column(NamedTuple):
    """One column of a table."""

    kind: str  # numpy's name of the type of a number, "str", or "bytes" = a file
    shape: tuple[int, ...]  # of one row
    unit: str
    about: str

    @property
    def n_bytes(self) -> int:
        """In memory, of one row, files and texts by a guess."""
        return _GUESSED_BYTES.get(self.kind) or np.dtype(self.kind).itemsize * math.prod(self.shape)


def feature_columns(
    n: int, patches: int, *, half: bool = False, map_hw: tuple[int, int] | None = None
) -> dict[str, Column]:
    """All columns of rows with ``n`` samples, ``patches`` tokens and maps of that size (None = no maps), in order."""
    f, byte, flag = "float32", "uint8", "bool"
    found = {
        "episode_index": Column("int64", (), "1", "number of the episode in its data set, else of the recording"),
        "frame_index": Column("int64", (), "1", "number of the frame in its capture"),
        "timestamp": Column("float64", (), "s", "time stamp of the frame as its data set has it; NaN = none"),
        "recording": Column("str", (), "1", "name of the recording"),
        "uv": Column(f, (n, 2), "px", "where the samples are: x right, y down, whole numbers are pixel centres"),
        "xyz": Column(f, (n, 3), "m", "points in the camera of the frame: x right, y down, z forward"),
        "depth": Column(f, (n,), "m", "z of the points, by sensor or triangulation; 0 = none"),
        "sigma": Column(f, (n,), "m", "standard deviation of depth; 0 = none"),
        "score": Column(f, (n,), "1", "confidence of the sensor, or score of the recovered depth, in [0, 1]"),
        "valid": Column(flag, (n,), "1", "there is a depth"),
        "source": Column(byte, (n,), "code", "where the depth comes from"),
        "flag": Column(byte, (n,), "bits", "what is wrong with the sensor's return"),
        "hole": Column(byte, (n,), "code", "why the sensor gave no usable return"),
        "gate": Column(byte, (n,), "code", "why no depth was recovered"),
        "T_1_from_0": Column(f, (4, 4), "1, m", "pose of the other view: its points from those of the frame; 0 = none"),
        "pose_cov": Column(f, (6, 6), "rad², rad m, m²", "covariance of that pose, rotation first, left perturbation"),
        "pose_ok": Column(flag, (), "1", "there is a pose"),
        "pose_code": Column(byte, (), "code", "how the search for the pose ended"),
        "tokens": Column(
            f, (patches, len(TOKEN_CHANNELS)), "1/m, 1/m, share", "depth tokens of the patches, row by row"
        ),
        "tokens_valid": Column(flag, (patches,), "1", "a sample of the patch has a depth"),
        **({} if map_hw is None else _map_columns(map_hw)),
        "problem": Column(byte, (), "code", "what was wrong with the frame"),
    }
    half_names = _HALF_COLUMNS if half else ()
    return {k: c._replace(kind="float16") if k in half_names else c for k, c in found.items()}


def _map_columns(hw: tuple[int, int]) -> dict[str, Column]:
    """Columns of every pixel, over the field of the picture (:func:`dhtorch.pipeline.dense.map_pixel_centres`)."""
    f, byte, none = "float32", "uint8", "0 = none, where a DepthMap has NaN"
    return {
        "depth_map": Column(f, hw, "m", f"z of every pixel, by sensor or sweep; {none}"),
        "sigma_map": Column(f, hw, "m", f"standard deviation of depth_map; {none}"),
        "score_map": Column(f, hw, "1", "confidence of the sensor, or score of the swept depth, in [0, 1]"),
        "source_map": Column(byte, hw, "code", "where the depth of a pixel comes from"),
        "gate_map": Column(byte, hw, "code", "why a pixel has no depth"),
    }


def select_columns(found: Mapping[str, Column], wanted: Sequence[str] | None) -> dict[str, Column]:
    """The place of a row, the wanted columns (None = all) and ``problem``.

    Raises:
        ValueError: no such column.
    """
    for name in wanted or ():
        if name not in found:
            raise ValueError(f"columns: found {name!r}, expected some of {', '.join(found)}")
    keep = set(found if wanted is None else wanted) | {*KEY_COLUMNS, "problem"}
    return {name: column for name, column in found.items() if name in keep}


def blank_features(wanted: Mapping[str, Column]) -> Row:
    """The features of a frame that cannot be read: zeros, and a ``problem`` that says so."""
    empty: dict[str, Any] = {"str": "", "bytes": b""}
    zeros = {k: empty[c.kind] if c.kind in empty else np.zeros(c.shape, c.kind) for k, c in wanted.items()}
    zeros = {k: value for k, value in zeros.items() if k not in KEY_COLUMNS}
    return {**zeros, "problem": np.asarray(SampleProblem.UNREADABLE, wanted["problem"].kind)}


def code_tables() -> dict[str, dict[int, str]]:
    """Column → what its codes mean, for the metadata of a file."""
    return {column: names(table) for column, table in _COLUMN_CODES.items()}


def arrow_schema(wanted: Mapping[str, Column], metadata: Mapping[str, str]) -> Any:
    """Arrow schema: lists of fixed size, unit and meaning with every field."""
    pyarrow = import_optional("pyarrow", extra="scale")
    fields = [
        pyarrow.field(name, _arrow_type(pyarrow, c), nullable=False, metadata={"unit": c.unit, "about": c.about})
        for name, c in wanted.items()
    ]
    return pyarrow.schema(fields, metadata=dict(metadata))


def arrow_table(rows: Iterable[Row], wanted: Mapping[str, Column], layout: Any) -> Any:
    """Arrow table of some rows, at least one, in the layout that :func:`arrow_schema` made."""
    pyarrow = import_optional("pyarrow", extra="scale")
    rows = list(rows)
    arrays = []
    for name, column in wanted.items():
        if column.kind in _GUESSED_BYTES:
            arrays.append(pyarrow.array([row[name] for row in rows], _arrow_type(pyarrow, column)))
            continue
        values = np.stack([np.asarray(row[name]).astype(column.kind) for row in rows])
        array = pyarrow.array(values.reshape(-1))
        for size in reversed(column.shape):
            array = pyarrow.FixedSizeListArray.from_arrays(array, size)
        arrays.append(array)
    return pyarrow.Table.from_arrays(arrays, schema=layout)


def _arrow_type(pyarrow: Any, column: Column) -> Any:
    named = {"str": pyarrow.string(), "bytes": pyarrow.binary()}
    kind = named.get(column.kind) or pyarrow.from_numpy_dtype(np.dtype(column.kind))
    for size in reversed(column.shape):
        kind = pyarrow.list_(kind, size)
    return kind
