"""Files of rows: what a column is, what a shard says of itself, what is torn or of another extraction, reading back."""

import json
import os
import sys
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("pyarrow")

import pyarrow
from pyarrow import parquet

from dhtorch.data import FormatError
from dhtorch.extract import FeatureTable, JoinedDataset, columns, engines, shards
from dhtorch.extract.dataset import ExtractedRow
from dhtorch.extract.plan import ShardSpec

N, P = 5, 6
SHARED = {
    "key": "k" * 64,
    "config": {"seed": 0, "method": {"n": 5}},
    "data": {"digest": "d"},
    "git": "v1-2-gab",
    "version": "0.1",
    "columns": dict.fromkeys(columns.feature_columns(N, P)),
    "codes": {"problem": {"0": "NONE", "1": "NO_SECOND_VIEW", "2": "NO_DEPTH", "3": "UNREADABLE"}},
}


def row(k, wanted=None, episode=0, problem=0):
    rng = np.random.default_rng(k)
    found = columns.feature_columns(N, P) if wanted is None else wanted
    values = {
        name: rng.integers(0, 2, c.shape) if c.kind in ("uint8", "bool") else rng.normal(size=c.shape)
        for name, c in found.items()
    }
    place = {"episode_index": episode, "frame_index": k, "timestamp": k / 10, "recording": f"r{episode}"}
    return {**values, **place, "problem": problem}


def written(folder, pieces, wanted=None, shared=SHARED, of=None):
    """Shards of some rows each."""
    wanted = columns.feature_columns(N, P) if wanted is None else wanted
    shared = {**shared, "columns": dict.fromkeys(wanted)}
    folder.mkdir(exist_ok=True)
    first = 0
    for number, piece in enumerate(pieces):
        shard = ShardSpec(number, of or len(pieces), range(first, first + len(piece)))
        shards.write_shard(folder, shard, piece, wanted, shared)
        first += len(piece)
    return folder


# ---------------------------------------------------------------------------------------------------- columns


def test_columns_have_the_shapes_types_and_units_that_they_are_known_by():
    f, byte, flag, code = "float32", "uint8", "bool", "code"
    wanted = {
        "episode_index": ("int64", (), "1"),
        "frame_index": ("int64", (), "1"),
        "timestamp": ("float64", (), "s"),
        "recording": ("str", (), "1"),
        "uv": (f, (N, 2), "px"),
        "xyz": (f, (N, 3), "m"),
        "depth": (f, (N,), "m"),
        "sigma": (f, (N,), "m"),
        "score": (f, (N,), "1"),
        "valid": (flag, (N,), "1"),
        "source": (byte, (N,), code),
        "flag": (byte, (N,), "bits"),
        "hole": (byte, (N,), code),
        "gate": (byte, (N,), code),
        "T_1_from_0": (f, (4, 4), "1, m"),
        "pose_cov": (f, (6, 6), "rad², rad m, m²"),
        "pose_ok": (flag, (), "1"),
        "pose_code": (byte, (), code),
        "tokens": (f, (P, 10), "1/m, 1/m, share"),
        "tokens_valid": (flag, (P,), "1"),
        "problem": (byte, (), code),
    }
    found, tables = columns.feature_columns(N, P), columns.code_tables()
    assert sum(tables["flag"]) == 255 and max(max(t) for t in tables.values()) == 128, "a byte holds every code"
    assert {k: (c.kind, c.shape, c.unit) for k, c in found.items()} == wanted and list(found) == list(wanted)
    half = columns.feature_columns(N, P, half=True)
    assert {k for k in half if half[k] != found[k]} == {"xyz", "depth", "sigma", "score", "tokens"}
    assert all(half[k] == found[k]._replace(kind="float16") for k in half if half[k] != found[k])


def test_chosen_columns_keep_place_problem_and_order():
    every = columns.feature_columns(N, P)
    place = ["episode_index", "frame_index", "timestamp", "recording"]
    for wanted, kept in (
        (None, list(every)),
        (["tokens", "uv"], [*place, "uv", "tokens", "problem"]),
        ([], [*place, "problem"]),
    ):
        assert list(columns.select_columns(every, wanted)) == kept
    with pytest.raises(
        ValueError, match=r"extract\.columns: found 'colour', expected some of episode_index, .*problem$"
    ):
        columns.select_columns(every, ["uv", "colour"])
    blank = columns.blank_features(
        columns.select_columns(columns.feature_columns(N, P, half=True), ["xyz", "pose_ok", "gate"])
    )
    assert {k: (v.dtype, v.shape) for k, v in blank.items()} == {
        "xyz": (np.float16, (N, 3)),
        "gate": (np.uint8, (N,)),
        "pose_ok": (np.bool_, ()),
        "problem": (np.uint8, ()),
    }
    assert blank.pop("problem") == 3 and not any(v.any() for v in blank.values())


# ---------------------------------------------------------------------------------------------------- shards


def test_a_shard_says_what_it_holds(tmp_path):
    wanted = columns.feature_columns(N, P)
    given = [row(k, problem=(0, 1, 1, 3)[k]) for k in range(4)]
    counts = shards.write_shard(tmp_path, ShardSpec(2, 7, range(8, 14)), given, wanted, SHARED)
    assert counts == {"none": 1, "no_second_view": 2, "unreadable": 1, "skipped": 2}
    path = tmp_path / "shard-00002.parquet"
    assert [p.name for p in tmp_path.iterdir()] == [path.name], "nothing else is left"
    shared, own = shards.read_shard_metadata(path)
    assert shared == SHARED and own == {"number": 2, "of": 7, "counts": dict(counts)}
    metadata = parquet.read_metadata(path)
    field = parquet.read_schema(path).field("uv")
    assert field.metadata == {b"unit": b"px", b"about": wanted["uv"].about.encode()} and not field.nullable
    assert field.type == pyarrow.list_(pyarrow.list_(pyarrow.float32(), 2), N)
    assert metadata.num_rows == 4 and metadata.row_group(0).column(0).compression == "ZSTD"
    assert list(json.loads(metadata.metadata[b"dhtorch.shard"])["counts"]) == sorted(counts)
    assert json.loads(metadata.metadata[b"dhtorch"]) == SHARED


@pytest.mark.parametrize(
    ("map_hw", "n", "groups"), [(None, 35, [16, 16, 3]), ((480, 640), 7, [3, 3, 1]), ((2160, 3840), 2, [1, 1])]
)
def test_rows_are_stored_in_groups_of_sixteen_or_fewer_where_maps_are_large(map_hw, n, groups, tmp_path, monkeypatch):
    """16 MB at most are held at once."""
    wanted = columns.feature_columns(N, P, map_hw=map_hw)
    few = columns.select_columns(wanted, ["pose_ok"])
    sizes, write = [], columns.arrow_table
    monkeypatch.setattr(
        shards, "arrow_table", lambda rows, _, layout: sizes.append(len(rows)) or write(rows, few, layout)
    )
    monkeypatch.setattr(shards, "arrow_schema", lambda _, metadata: columns.arrow_schema(few, metadata))
    shared = SHARED | {"columns": dict.fromkeys(few)}
    shards.write_shard(tmp_path, ShardSpec(0, 1, range(n)), (row(k, few) for k in range(n)), wanted, shared)
    metadata = parquet.read_metadata(tmp_path / "shard-00000.parquet")
    assert sizes == groups == [metadata.row_group(k).num_rows for k in range(metadata.num_row_groups)]
    features = FeatureTable(tmp_path)
    assert all(features.at(0, k)["dhtorch.pose_ok"] == bool(row(k, few)["pose_ok"]) for k in range(n))


def test_finished_shards_are_whole_and_of_this_extraction(tmp_path):
    pieces = [[row(0)], [row(1, problem=1), row(2)], [row(3)]]
    folder, twin = (written(tmp_path / name, pieces) for name in ("out", "twin"))
    assert [p.read_bytes() for p in shards.shard_files(folder)] == [p.read_bytes() for p in shards.shard_files(twin)]
    finished = shards.find_finished_shards(folder, SHARED)
    assert list(finished) == [f"shard-0000{k}.parquet" for k in range(3)]
    assert [*finished.values()] == [Counter(none=1), Counter(none=1, no_second_view=1), Counter(none=1)]
    torn = folder / "shard-00001.parquet"
    torn.write_bytes(torn.read_bytes()[:-50])
    assert sorted(shards.find_finished_shards(folder, SHARED)) == ["shard-00000.parquet", "shard-00002.parquet"]
    parquet.write_table(pyarrow.table({"a": [1]}), torn)
    assert len(shards.find_finished_shards(folder, SHARED)) == 2, "a table of somebody else's"
    with pytest.raises(FormatError, match=r"shard-00001.parquet: metadata: found KeyError.*a shard of dhtorch extract"):
        shards.read_shard_metadata(torn)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"config": {"seed": 3, "method": {"n": 5}}}, "seed 0 there, 3 here"),
        ({"config": {"seed": 0, "method": {"n": 9}}}, "method.n 5 there, 9 here"),
        ({"config": {"seed": 1, "method": {"n": 9}}}, "method.n 5 there, 9 here"),
        ({"config": {"method": {"n": 5}}}, "seed 0 there, None here"),
        ({"config": {"seed": 0, "method": {"n": 5}, "z": 1}}, "z None there, 1 here"),
        ({"data": {"digest": "e"}}, "other data"),
        ({"git": "v2"}, "other code: v1-2-gab there, v2 here"),
        ({"git": None}, "other code: v1-2-gab there, 0.1 here"),
        ({}, "other code"),
    ],
)
def test_the_first_difference_between_two_extractions_is_said(tmp_path, change, said):
    folder = written(tmp_path / "out", [[row(0)]])
    ours = {**SHARED, **change, "key": "x" * 64}
    expected = rf"shard-00000.parquet: found a shard of another extraction \({said}\), expected one of this extraction, or another"
    with pytest.raises(FileExistsError, match=expected):
        shards.find_finished_shards(folder, ours)
    assert shards.find_finished_shards(folder, {**SHARED, **change}), "the key alone decides"


# ---------------------------------------------------------------------------------------------------- reading back


def test_rows_come_back_in_the_types_of_the_transform(tmp_path):
    half = columns.feature_columns(N, P, half=True)
    given = [[row(0), row(1)], [row(4)], [row(0, episode=2), row(3, episode=2)]]
    features = FeatureTable(written(tmp_path / "out", given, half))
    flat = [one for piece in given for one in piece]
    assert len(features) == 5 and features.columns == tuple(k for k in half if k not in columns.KEY_COLUMNS)
    kinds = {"float32": torch.float32, "float16": torch.float32, "bool": torch.bool, "uint8": torch.int32}
    for one, mine in zip(flat, features, strict=True):
        assert mine.keys() == {f"dhtorch.{k}" for k in features.columns}
        for name in features.columns:
            value = mine[f"dhtorch.{name}"]
            assert value.dtype == kinds[half[name].kind] and tuple(value.shape) == half[name].shape
            wanted = np.asarray(one[name]).astype(half[name].kind).astype(np.float64)
            assert np.array_equal(value.double().numpy(), wanted), name
    assert features.place["episode_index"].tolist() == [0, 0, 0, 2, 2]
    assert features.place["frame_index"].tolist() == [0, 1, 4, 0, 3]
    assert features.place["timestamp"].tolist() == [0.0, 0.1, 0.4, 0.0, 0.3]
    assert features.about["key"] == SHARED["key"]


def test_a_row_is_found_by_place_and_by_episode_and_frame(tmp_path):
    folder = written(tmp_path / "out", [[row(0), row(1)], [row(0, episode=2), row(7, episode=2)]])
    features = FeatureTable(folder, ["depth", "gate"], prefix="far.")
    assert features.at(2, 7).keys() == {"far.depth", "far.gate"}
    for i, key in enumerate(((0, 0), (0, 1), (2, 0), (2, 7))):
        mine = features.at(*key)
        assert all(torch.equal(mine[k], features[i][k]) and torch.equal(mine[k], features[i - 4][k]) for k in mine)
        assert np.array_equal(mine["far.depth"], row(key[1])["depth"].astype(np.float32))
    for i in (4, -5):
        with pytest.raises(IndexError):
            features[i]
    with pytest.raises(KeyError, match="no features of frame 1 of episode 2"):
        features.at(2, 1)
    features[0]["far.depth"].zero_()
    assert features[0]["far.depth"].any(), "a copy of its own"


def test_a_rewritten_file_is_read_again(tmp_path):
    folder = written(tmp_path / "out", [[row(0)]])
    first, before = FeatureTable(folder)[0], (folder / "shard-00000.parquet").stat()
    written(folder, [[row(0) | {"depth": np.full(N, 8.0)}]])
    os.utime(folder / "shard-00000.parquet", ns=(before.st_atime_ns, before.st_mtime_ns))
    assert not torch.equal(first["dhtorch.depth"], torch.full((N,), 8.0))
    assert torch.equal(FeatureTable(folder)[0]["dhtorch.depth"], torch.full((N,), 8.0))


@pytest.mark.parametrize(
    ("pieces", "of", "wanted", "words"),
    [
        ([], None, None, "shards: found none, expected a folder written by dhtorch extract"),
        (
            [[row(0)], [row(1)]],
            3,
            None,
            "shards: found 2, expected 3: run the same dhtorch extract again for the missing",
        ),
        *(
            ([[row(0)]], None, ["uv", name], f"columns: found {name}, expected some of uv, xyz, .*problem$")
            for name in ("colour", "timestamp")
        ),
    ],
)
def test_a_folder_without_a_whole_extraction_is_refused(pieces, of, wanted, words, tmp_path):
    with pytest.raises(FormatError, match=words):
        FeatureTable(written(tmp_path / "out", pieces, of=of), wanted)


def test_items_are_joined_by_the_numbers_of_episode_and_frame(tmp_path):
    features = FeatureTable(written(tmp_path / "out", [[row(0), row(1), row(0, episode=1)]]), ["depth"])
    items = [
        {"episode_index": torch.tensor(1), "frame_index": 0, "x": 1},
        {"episode_index": 0, "frame_index": 1, "x": 2},
    ]
    joined = JoinedDataset(items, features)
    assert len(joined) == 2 and joined[0]["x"] == 1 and joined[1].keys() == {*items[1], "dhtorch.depth"}
    wanted = [features[2]["dhtorch.depth"], features[1]["dhtorch.depth"]]
    loaded = torch.utils.data.DataLoader(joined, batch_size=None, num_workers=1, multiprocessing_context="fork")
    assert all(torch.equal(item["dhtorch.depth"], x) for item, x in zip(loaded, wanted, strict=True))
    nested = JoinedDataset([{"m": {"e": 0, "f": 1}}], features, episode_key="m.e", frame_key="m/f")
    assert torch.equal(nested[0]["dhtorch.depth"], wanted[1])
    with pytest.raises(KeyError, match="frame 5 of episode 0"):
        JoinedDataset([{"episode_index": 0, "frame_index": 5}], features)[0]


# ---------------------------------------------------------------------------------------------------- engines


class Counted(torch.utils.data.Dataset):
    """Answers that tell their position, and how they were made."""

    def __len__(self):
        return 50

    def __getitem__(self, i):
        if i == 60:
            raise RuntimeError("shapes do not fit")
        return ExtractedRow({"at": i, "threads": torch.get_num_threads()}, {"depth": np.full(3, i)}, str(i))


class Ray:
    """The little of Ray and Ray Data that is used, in this process."""

    def __init__(self):
        self.log, self.context = [], SimpleNamespace(execution_options=SimpleNamespace())
        self.DataContext = SimpleNamespace(get_current=lambda: self.context)

    def init(self, **options):
        self.log.append(("init", options))

    def put(self, value):
        return [value]

    def get(self, reference):
        return reference[0]

    def shutdown(self):
        self.log.append(("shutdown", {}))

    def from_numpy(self, blocks):
        self.log.append(("blocks", [len(b) for b in blocks]))
        self.blocks = blocks
        return self

    def map_batches(self, task, *, batch_size, num_cpus):
        assert batch_size is None and num_cpus == 1
        self.task = task
        return self

    def iter_batches(self, *, batch_size, prefetch_batches):
        assert batch_size is None and prefetch_batches == 1
        return (self.task({"data": block}) for block in self.blocks)


@pytest.fixture
def ray(monkeypatch):
    fake = Ray()
    monkeypatch.setitem(sys.modules, "ray", fake)
    monkeypatch.setitem(sys.modules, "ray.data", fake)
    return fake


@pytest.mark.parametrize("engine", ["local", "ray"])
def test_answers_come_in_the_order_of_their_positions_as_they_are(engine, ray):
    order = [7, 3, 3, 20, *range(49, 9, -1)]
    answers = list(engines.run_engine(engine, Counted(), order, workers=0))
    assert [a.place["at"] for a in answers] == order and {a.place["threads"] for a in answers} == {1}
    assert all(type(a) is ExtractedRow and a.complaint == str(a.place["at"]) for a in answers)
    assert all(a.features["depth"].tolist() == [a.place["at"]] * 3 for a in answers)
    with pytest.raises(RuntimeError, match=r"^shapes do not fit"):
        list(engines.run_engine(engine, Counted(), [60], workers=0))
    assert ray.log == [] or [name for name, _ in ray.log] == ["init", "blocks", "shutdown"] * 2


def test_ray_is_given_blocks_of_sixteen_and_left_when_a_reader_stops_early(ray):
    answers = engines.run_ray(Counted(), range(40), None)
    assert next(answers).place["at"] == 0
    answers.close()
    assert [name for name, _ in ray.log] == ["init", "blocks", "shutdown"] and ray.log[1][1] == [16, 16, 8]
    options = ray.log[0][1]
    assert options["address"] is None and options["include_dashboard"] is False and options["log_to_driver"] is False
    assert options["object_store_memory"] == 300_000_000
    assert ray.context.execution_options.preserve_order is True and ray.context.enable_progress_bars is False


def test_a_cluster_that_is_there_is_joined_and_left(ray, monkeypatch):
    asked = []
    monkeypatch.setattr(
        engines.socket,
        "create_connection",
        lambda where, timeout: asked.append((where, timeout)) or SimpleNamespace(close=int),
    )
    for address, where in (
        ("ray://head:10001", [("head", 10001)]),
        ("10.0.0.1:6379", [("10.0.0.1", 6379)]),
        ("auto", []),
    ):
        asked.clear()
        ray.log.clear()
        assert len(list(engines.run_ray(Counted(), [1, 2], address))) == 2
        assert [w for w, _ in asked] == where and all(timeout == 10 for _, timeout in asked)
        assert ray.log[0][1]["address"] == address and "object_store_memory" not in ray.log[0][1]
        assert ray.log[-1][0] == "shutdown"


def test_a_cluster_that_does_not_answer_is_said(ray, monkeypatch):
    def refused(where, timeout):
        raise ConnectionRefusedError("refused")

    monkeypatch.setattr(engines.socket, "create_connection", refused)
    with pytest.raises(
        ConnectionError, match=r"address: no connection to ray://head:1 \(refused\), expected a Ray clu"
    ):
        list(engines.run_ray(Counted(), [1], "ray://head:1"))
    assert not ray.log
    monkeypatch.setattr(ray, "init", lambda **_: (_ for _ in ()).throw(ValueError("no node")))
    with pytest.raises(ConnectionError, match=r"engine=ray: no node"):
        list(engines.run_ray(Counted(), [1], None))
