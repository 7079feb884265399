"""What a Parquet footer says of its chunks, read without Arrow, which ends the process where a footer lies."""

import numpy as np
import pytest

from dhtorch.data.codecs import parquet, thrift
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
        assert [(c.path, parquet._PHYSICAL_TYPES[c.kind], c.values, c.packed) for c in found] == want
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


def test_a_file_that_changed_is_read_again(tmp_path):
    file = tmp_path / "x.parquet"
    for n in (3, 5):
        arrow.write_table(pyarrow.table({"x": list(range(n))}), file)
        assert parquet.read_columns(file, ["x"])["x"].tolist() == list(range(n))


def test_a_cell_costs_one_footer_and_columns_that_are_not_there_none(tmp_path, monkeypatch):
    file, opened, real = tmp_path / "x.parquet", [], parquet._open_table
    arrow.write_table(table(), file, row_group_size=50)
    monkeypatch.setattr(parquet, "_open_table", lambda path: opened.append(path) or real(path))
    assert [parquet.read_cell(file, "number", row) for row in (60, 61, 99)] == [60, 61, 99] and len(opened) == 1
    assert parquet.read_cell(file, "number", 100) == 100 and len(opened) == 2, "another group"
    read = parquet.read_columns(file, ["number"], (0, 2), optional=["text", "gone"])
    assert list(read) == ["number", "text"] and read["text"] == ["a" * 50, "b"] and len(opened) == 3
    with pytest.raises(FormatError, match="gone"):
        parquet.read_columns(file, ["gone"])


@pytest.mark.parametrize(
    "damaged", [b"", b"\x15", b"\x19\xfc\xff\xff\xff\xff\x07", b"\x1c" * 40, b"\x15\x02\x00", b"\x1b\x00\x00"]
)
def test_damaged_structures_raise(damaged):
    with pytest.raises((ValueError, IndexError)):
        list(thrift.iter_list_structs(damaged, 0, 4))


def test_a_byte_and_a_double_in_thrift():
    said = bytes([0x13, 100, 0x17, *8 * [9], 0x13, 7, 0])
    assert thrift.parse_struct(b"??" + said, 2) == ({1: 100, 2: None, 3: 7}, 2 + len(said))


def test_a_structure_in_thrift():
    said = bytes([0x15, 0x04, 0x18, 2, 104, 105, 0x19, 0x25, 1, 4, 0x11, 0x1C, 0x15, 5, 0, 0])
    assert thrift.parse_struct(said, 0) == ({1: 2, 2: b"hi", 3: [-1, 2], 4: True, 5: {1: -3}}, len(said))
