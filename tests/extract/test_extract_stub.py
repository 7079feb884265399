"""``dhtorch extract`` in this process, on recordings of a few pixels with a stub method."""

import json
from types import SimpleNamespace

import pytest
import torch
from support.stub_recordings import Load, recording
from support.stub_samples import FixedEstimate, N, Stub

pytest.importorskip("pyarrow")

from dhtorch import extract
from dhtorch.extract import FeatureTable, shards
from dhtorch.runtime import results as result_files
from dhtorch.transforms import SampleError


@pytest.fixture
def made(tmp_path, capsys):
    """Function that extracts two episodes of three frames: options -> exit code, output, progress bars, folder."""

    def call(recordings=None, out="out", options=None, **settings):
        if recordings is None:
            recordings = [recording(3, gap=1), recording(3, name="two", load=Load(30), gap=1)]
        shown = []

        def progress(items, text, total):
            shown.append((text, total))
            yield from items

        asked = {"shard_rows": 4, "tokens_hw": (28, 42), "gap": None, **(options or {})}
        plain = {"data": {"name": "made"}, "method": {"n": 6}, "seed": 0, "workers": 0, "out": str(tmp_path / out)}
        parts = {
            "data": recordings,
            "method": Stub(answer=FixedEstimate(), n=N),
            "extract": extract.ExtractOptions(**asked),
        }
        code = extract.run({**plain, "choices": {"data": "made"}, **settings}, parts, progress=progress)
        return SimpleNamespace(code=code, said=capsys.readouterr().out, shown=shown, folder=tmp_path / out)

    return call


def bytes_of(folder):
    return {p.name: p.read_bytes() for p in shards.shard_files(folder)}


def test_every_frame_is_a_row(made):
    done = made()
    features = FeatureTable(done.folder)
    assert done.code == 0 and features.place["episode_index"].tolist() == [0, 0, 0, 1, 1, 1]
    assert features.place["frame_index"].tolist() == [0, 1, 2] * 2
    assert [int(row["dhtorch.problem"]) for row in features] == [1, 0, 0] * 2, "no view goes across episodes"
    assert [p.name for p in sorted(done.folder.iterdir())] == [".dhtorch", "shard-00000.parquet", "shard-00001.parquet"]
    size = sum(p.stat().st_size for p in done.folder.glob("*.parquet"))
    assert done.said == (
        f"{done.folder}: 2 shards, 6 rows, {size / 1e6:.1f} MB\nframes with a problem: 2 no second view\n"
    )
    assert done.shown == [("6 frames", 6)]


def test_a_file_at_a_shards_place_that_dhtorch_did_not_write_is_refused_before_any_row(made, tmp_path):
    foreign = tmp_path / "out" / "shard-00001.parquet"
    foreign.parent.mkdir()
    foreign.write_bytes(b"foreign")
    loaded = []
    with pytest.raises(FileExistsError, match=r"shard-00001\.parquet.*dhtorch did not write"):
        made(recording(9, load=loaded.append, gap=1))
    assert foreign.read_bytes() == b"foreign" and not loaded


def test_options_reach_the_rows(made):
    whole = FeatureTable(made(options={"gap": 2, "patch": 7}).folder)
    assert [int(row["dhtorch.problem"]) for row in whole] == [1, 1, 0] * 2
    assert whole[0]["dhtorch.tokens"].shape == (24, 10) and whole.about["grid"] == [4, 6]
    tall = {"tokens_hw": (98, 28)}
    fits = [FeatureTable(made(out=fit, options={"fit": fit, **tall}).folder)[2] for fit in ("stretch", "pad", "crop")]
    one, two, three = (row["dhtorch.tokens"] for row in fits)
    assert one.shape == (14, 10) and not any(torch.equal(*pair) for pair in ((one, two), (two, three), (one, three)))
    few = FeatureTable(made(out="few", options={"columns": ["depth"], "half": True}).folder)
    assert few.columns == ("depth", "problem") and few.about["columns"]["depth"]["kind"] == "float16"
    assert torch.allclose(few[2]["dhtorch.depth"], whole[2]["dhtorch.depth"], rtol=2**-11)
    bad = [recording(2, load=Load(bad={1}))]
    with pytest.raises(ValueError, match="one, frame 1: position 1 is damaged"):
        made(bad, out="bad", options={"gap": 0})


def test_the_same_extraction_is_made_once(made, monkeypatch):
    left = made(out="empty", options={"gap": 0}).folder.parent / "out" / ".dhtorch" / "unfinished" / "7.parquet"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"PAR1")  # of a killed run
    real, calls = shards.write_shard, []

    def interrupted(*args):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*args)

    with monkeypatch.context() as patched:
        patched.setattr(shards, "write_shard", interrupted)
        words = r"^1 of 2 shards in .*out are complete and stay; run the same command again"
        with pytest.raises(KeyboardInterrupt, match=words):
            made()
    first = made()
    assert "2 shards (1 left untouched), 6 rows" in first.said and not left.exists()
    before = bytes_of(first.folder)
    torn = shards.shard_files(first.folder)[1]
    torn.write_bytes(torn.read_bytes()[:-100])
    again = made()
    assert "2 shards (1 left untouched), 6 rows" in again.said and again.shown == [("6 frames", 2)]
    assert bytes_of(first.folder) == before and [p.name for p in (first.folder / ".dhtorch").iterdir()] == ["manifest"]
    for changes in ({}, {"options": {"address": "head:1"}}, {"traceback": True}):  # where and how fast rows are made
        third = made(**changes)
        assert "2 shards (2 left untouched), 6 rows" in third.said and "2 no second view" in third.said
        assert third.shown == [], "nothing is computed"
    for changes, said in (
        ({"seed": 1}, "seed 0 there, 1 here"),
        ({"method": {"n": 7}}, "method.n 6 there, 7 here"),
        ({"data": {"name": "made", "gap": 1}}, "data.gap None there, 1 here"),
        ({"options": {"on_error": "skip"}}, "extract.on_error raise there, skip here"),
        ({"choices": {"data": "other"}}, "other code"),
    ):
        with pytest.raises(FileExistsError, match=said):
            made(**changes)
    assert bytes_of(first.folder) == before


def test_other_data_is_another_question(made, tmp_path):
    root = tmp_path / "set"
    root.mkdir()
    (root / "a.bin").write_bytes(b"one")
    folder = made([recording(root=root)], options={"gap": 0}).folder
    assert "1 left untouched" in made([recording(root=root)], options={"gap": 0}).said
    shared, _ = shards.read_shard_metadata(folder / "shard-00000.parquet")
    assert str(tmp_path) not in json.dumps(shared), "no place of this machine"
    (root / "a.bin").write_bytes(b"two")
    with pytest.raises(FileExistsError, match="other data"):
        made([recording(root=root)], options={"gap": 0})
    weights = tmp_path / "net.pt"
    weights.write_bytes(b"w")
    made(out="learned", method={"weights": str(weights)})
    assert "left untouched" in made(out="learned", method={"weights": str(weights)}).said
    weights.write_bytes(b"v")
    with pytest.raises(FileExistsError, match="other data"):
        made(out="learned", method={"weights": str(weights)})
    assert bytes_of(folder)


def test_a_shard_tells_where_it_comes_from(made):
    folder = made(seed=3, options={"engine": "local"}).folder
    shared, own = shards.read_shard_metadata(shards.shard_files(folder)[1])
    meta = result_files.collect_run_metadata(device="cpu", dtype="float32", threads=1, seed=3, operators="torch")
    assert shared["format"] == 1 and shared["git"] == meta["git"] and shared["versions"] == meta["versions"]
    assert shared["version"] == meta["versions"]["dhtorch"]
    assert shared["data"]["name"] == "made" and (shared["data"]["recordings"], shared["data"]["frames"]) == (2, 6)
    assert shared["config"]["data"] == {"name": "made"} and shared["config"]["seed"] == 3
    asked = shared["config"]["extract"]
    assert (
        "engine" not in asked and "address" not in asked and asked["shard_rows"] == 4 and asked["tokens_hw"] == [28, 42]
    )
    uv = shared["columns"]["uv"]
    assert (uv["kind"], uv["shape"], uv["unit"]) == ("float32", [6, 2], "px") and len(shared["channels"]) == 10
    assert shared["grid"] == [2, 3] and shared["codes"]["hole"]["4"] == "TOO_DARK"
    assert own == {"number": 1, "of": 2, "counts": {"none": 2, "skipped": 0}}
    assert json.loads(json.dumps(shared)) == shared and str(folder) not in json.dumps(shared)


BAD = {"load": Load(bad={1, 2}), "numbers": [10, 11, 12, 13, 14]}


def test_a_bad_frame_ends_the_run_or_is_skipped_or_flagged_counted_and_named(made):
    words = r"^one, frame 11: position 1 is damaged \(set extract.on_error=skip or flag to continue with the other frames\)$"
    with pytest.raises(SampleError, match=words):
        made([recording(**BAD)], options={"gap": 1, "shard_rows": 1})
    for on_error, kept, problems in (
        ("skip", [10, 13, 14], [1, 1, 0]),
        ("flag", [10, 11, 12, 13, 14], [1, 3, 3, 1, 0]),
    ):
        done = made([recording(**BAD)], out=on_error, options={"gap": 1, "on_error": on_error})
        features = FeatureTable(done.folder)
        assert features.place["frame_index"].tolist() == kept and f", {len(kept)} rows," in done.said
        name = "skipped" if on_error == "skip" else "unreadable"
        assert f"frames with a problem: 2 no second view, 2 {name}\n" in done.said
        assert done.said.endswith("  one, frame 11: position 1 is damaged\n  one, frame 12: position 2 is damaged\n")
        rows = list(features)
        assert [int(row["dhtorch.problem"]) for row in rows] == problems
        for row in rows:
            if row.pop("dhtorch.problem") == 3:
                assert not any(v.any() for v in row.values())
    for n, more in ((4, "  and 1 more\n"), (3, "position 2 is damaged\n")):  # only three are named
        done = made([recording(6, load=Load(bad=set(range(n))))], out=str(n), options={"gap": 0, "on_error": "skip"})
        assert done.said.count("is damaged") == 3 and done.said.endswith(more)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"out": "file"}, r"out: .*file is a file, expected a folder or a new path"),
        *(({"workers": n}, f"workers: found {n}, expected a whole number of at least 0") for n in (-1, 1.5, None)),
        ({"options": {"tokens_hw": (7, 7)}}, "found an image of 7x7, expected at least one patch of 14"),
    ],
)
def test_the_folder_and_the_workers_are_checked_first(changes, words, made, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises((ValueError, NotADirectoryError), match=words):
        made(**changes)
    assert not (tmp_path / "out").exists()
    done = made(recording(3), out="deep/er", options={"gap": 0})  # one recording need not be a list
    assert done.code == 0 and (tmp_path / "deep" / "er" / "shard-00000.parquet").exists()
    assert done.said.startswith(f"{done.folder}: 1 shard, 3 rows") and "3 no second view" in done.said
