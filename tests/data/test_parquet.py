"""What a Parquet footer says of its chunks, read without Arrow, which ends the process where a footer lies."""

import numpy as np
import pytest

from dhtorch.data.codecs import parquet
from dhtorch.data.io.decode import FormatError

pyarrow = pytest.importorskip("pyarrow")
from pyarrow import parquet as arrow  # noqa: E402


def table():
    columns = {"text": ["a" * 50, "b"] * 100, "number": np.arange(200), "list": [[1.0, 2.0]] * 200}
    return pyarrow.table({**columns, "flag": [True, False] * 100, "cell": [{"bytes": b"x", "path": "p"}] * 200})


@pytest.mark.parametrize("codec", ["none", "snappy", "gzip", "zstd", "lz4", "brotli"])
def test_chunks_are_those_that_arrow_sees(tmp_path, codec):
    file = tmp_path / "x.parquet"
    arrow.write_table(table(), file, compression=codec, row_group_size=50)
    meta = arrow.ParquetFile(file).metadata
    for groups in ([0, 1, 2, 3], [2]):
        seen = [meta.row_group(g).column(i) for g in groups for i in range(meta.num_columns)]
        found = parquet._read_chunks(file, frozenset(groups))
        want = [(c.path_in_schema, c.physical_type, c.num_values, c.total_compressed_size) for c in seen]
        assert [(c.path, c.kind, c.values, c.packed) for c in found] == want
    assert parquet.read_columns(file, ["text"], (60, 62))["text"] == ["a" * 50, "b"]


def test_statistics_that_do_not_fit_the_schema_do_not_end_the_process(tmp_path):
    file = tmp_path / "x.parquet"
    arrow.write_table(pyarrow.table({"x": [1, 2, 3]}), file)
    whole = file.read_bytes()
    required = whole.replace(b"\x25\x02\x18\x01x", b"\x25\x00\x18\x01x")
    assert required != whole, "the column is no longer optional, its histogram has two levels"
    file.write_bytes(required)
    with pytest.raises(FormatError, match=r"x.parquet: data: found .*histogram"):
        parquet.read_columns(file, ["x"])


def test_cells_and_columns_that_are_not_there(tmp_path):
    file = tmp_path / "x.parquet"
    arrow.write_table(table(), file, row_group_size=50)
    assert [parquet.read_row(file, ("number",), row)["number"] for row in (60, 61, 99, 100, 199)] == [
        60,
        61,
        99,
        100,
        199,
    ]
    read = parquet.read_columns(file, ["number"], (0, 2), optional=["text", "gone"])
    assert list(read) == ["number", "text"] and read["text"] == ["a" * 50, "b"]
    for call, named in (
        (lambda: parquet.read_columns(file, ["gone"]), "columns: found .*, expected gone"),
        (lambda: parquet.read_columns(file, ["number"], (0, 201)), "rows: found 200, expected rows 0 to 200"),
        (lambda: parquet.read_row(file, ("number",), 200), "rows: found 200, expected row 200"),
        (lambda: parquet.read_row(file, ("number",), -1), "rows: found 200, expected row -1"),
    ):
        with pytest.raises(FormatError, match=named):
            call()
