"""Result files: schema, strictness, atomic writing, and the key that decides whether a job is done."""

import copy
import json
import math
import os
import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest
import torch

from dhtorch import archive

KEY = "0123456789abcdef" * 4


def result(**changes):
    parts = {
        "experiment": "pair",
        "key": KEY,
        "meta": archive.meta(device="cpu", dtype=torch.float32, threads=1, seed=0),
        "config": {"method": {"n": 2048}, "holdout": {"cutoff": math.inf}},
        "data": {"name": "room", "scenes": ["room"], "n_pairs": 1, "digest": archive.data_digest({})},
        "summary": {"coverage": {"value": 0.5, "low": None, "high": None, "n": 1, "unit": "1"}},
        "rows": [
            {
                "scene": "room",
                "pair": (0, 5),
                "method": "paper",
                "n_kept": np.int64(3),
                "median_rel": torch.tensor(0.5),
            },
            {"scene": "room", "pair": None, "method": "paper", "corr": math.nan, "ms": {"track": np.float32(1.5)}},
        ],
    }
    return archive.build(**{**parts, **changes})


def test_a_result_survives_the_disk_and_is_strict(tmp_path):
    written = result()
    path = archive.write(tmp_path / "deep" / "result.json", written)
    text = path.read_text()
    assert "NaN" not in text and "Infinity" not in text
    assert archive.read(path) == archive.read(path.parent) == written == json.loads(text)
    assert written["rows"][1]["corr"] is None and written["config"]["holdout"]["cutoff"] is None
    assert written["rows"][0]["pair"] == [0, 5] and written["rows"][0]["n_kept"] == 3
    assert [p.name for p in path.parent.iterdir()] == ["result.json"]


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("schema",), 2, r"\.schema: found 2, expected 1"),
        (("experiment",), None, r"\.experiment: found None, expected a text"),
        (("question",), "why?", r"\.question: found 'why\?', expected null"),
        (("key",), "abc", r"\.key: found 'abc', expected 64 hexadecimal digits"),
        (("meta", "threads"), "two", r"\.meta\.threads: found 'two', expected a whole number"),
        (("meta", "seed"), True, r"\.meta\.seed: found True, expected a whole number"),
        (("meta", "host"), "x", r"\.meta\.host: found an unknown field"),
        (("data", "scenes"), "room", r"\.data\.scenes: found 'room', expected a list"),
        (
            ("summary", "coverage", "value"),
            "half",
            r"\.summary\.coverage\.value: found 'half', expected a number or null",
        ),
        (("rows", 0, "pair"), [1], r"\.rows\.0\.pair: found \[1\], expected \[i, j\] or null"),
        (("rows", 1, "median_rel"), math.nan, r"\.rows\.1\.median_rel: found nan, expected a finite number or null"),
        (("extra",), 1, r"\.extra: found an unknown field"),
    ],
)
def test_validation_names_the_field(place, value, message):
    bad = copy.deepcopy(result())
    inner = bad
    for name in place[:-1]:
        inner = inner[name]
    inner[place[-1]] = value
    with pytest.raises(ValueError, match=message):
        archive.validate(bad)


@pytest.mark.parametrize("place", [("rows",), ("meta", "git"), ("summary", "coverage", "unit"), ("rows", 0, "scene")])
def test_a_missing_field_is_named(place):
    bad = copy.deepcopy(result())
    inner = bad
    for name in place[:-1]:
        inner = inner[name]
    del inner[place[-1]]
    with pytest.raises(ValueError, match=r"\." + r"\.".join(map(str, place)) + ": found nothing, expected"):
        archive.validate(bad)


def test_an_experiment_has_a_question_and_a_verdict():
    asked = {"experiment": "motion", "question": "Does it?", "expectation": "Yes.", "why": "It did."}
    assert result(**asked, verdict="supported")["verdict"] == "supported"
    with pytest.raises(ValueError, match="verdict: found 'perhaps', expected supported, refuted, undecided"):
        result(**asked, verdict="perhaps")
    with pytest.raises(ValueError, match="question: found None, expected a text"):
        result(experiment="motion", verdict="refuted")


def test_reading_says_what_is_wrong_with_a_file(tmp_path):
    path = tmp_path / "result.json"
    with pytest.raises(FileNotFoundError, match=r"result\.json: found no file"):
        archive.read(path)
    for text in ("", "{", '{"a": NaN}', '{"a": 1}', "[]", "\x00"):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"result\.json"):
            archive.read(path)
        assert not archive.finished(path, KEY)


def test_finished_asks_for_the_same_key(tmp_path):
    assert not archive.finished(tmp_path, KEY)
    archive.write(tmp_path / "result.json", result())
    assert archive.finished(tmp_path / "result.json", KEY) and archive.finished(tmp_path, KEY)
    assert not archive.finished(tmp_path, KEY[::-1])


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = archive.write(tmp_path / "result.json", result())
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"\.key"):
        archive.write(path, {**result(), "key": "x"})
    os_replace, archive.Path.replace = archive.Path.replace, lambda *_: (_ for _ in ()).throw(OSError("disk full"))
    try:
        with pytest.raises(OSError, match="disk full"):
            archive.write(path, {**result(), "key": KEY[::-1]})
    finally:
        archive.Path.replace = os_replace
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["result.json"]


def test_a_killed_writer_leaves_a_whole_file(tmp_path):
    path = archive.write(tmp_path / "result.json", result())
    code = f"""
        from pathlib import Path
        from dhtorch import archive
        path = Path({str(path)!r})
        one = archive.read(path)
        one["rows"] = one["rows"] * 2000
        print("ready", flush=True)
        while True:
            archive.write(path, one)
    """
    writer = subprocess.Popen([sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE)
    try:
        assert writer.stdout.readline() == b"ready\n"
        for _ in range(30):
            assert len(archive.read(path)["rows"]) in (2, 4000)  # read while it is being replaced
    finally:
        os.kill(writer.pid, signal.SIGKILL)
        writer.wait()
        writer.stdout.close()
    assert archive.finished(path, KEY)


def test_what_a_killed_writer_left_is_cleared(tmp_path):
    path = archive.write(tmp_path / "result.json", result())
    for name in (".result.json.abc.tmp", ".result.json.1.tmp", "result.json.tmp", ".other.json.1.tmp", "x.tmp"):
        (tmp_path / name).write_text("{")
    archive.clear(path)
    archive.clear(tmp_path / "nowhere" / "result.json")
    assert {p.name for p in tmp_path.iterdir()} == {"result.json", "result.json.tmp", ".other.json.1.tmp", "x.tmp"}
    assert archive.finished(path, KEY)


def test_rows_may_hold_what_an_experiment_needs(tmp_path):
    rows = [
        {"scene": "room", "pair": None, "method": "dinov2", "note": "too short", "ms": {"p50": 1.0, "p99": None}},
        {"scene": "", "pair": [3, 1], "method": "a.b", "curve": [[0.1, 0.2], [0.3, math.nan]], "ok": np.bool_(True)},
    ]
    asked = {"experiment": "latency", "question": "Q", "expectation": "E", "why": "W", "verdict": "undecided"}
    summary = {"a.b.median_rel": {"value": None, "low": None, "high": None, "n": 0, "unit": "1"}}
    written = result(rows=rows, summary=summary, **asked)
    archive.write(tmp_path / "result.json", written)
    assert archive.read(tmp_path)["rows"][1] == {**rows[1], "curve": [[0.1, 0.2], [0.3, None]], "ok": True}


def test_the_key_is_of_settings_code_and_data(tmp_path):
    code = tmp_path / "code"
    (code / "sub").mkdir(parents=True)
    (code / "a.py").write_text("x = 1\n")
    (code / "sub" / "b.py").write_text("y = 1\n")
    config = {"seed": 0, "device": "cpu", "data": {"root": "/data/a", "gap": 2}, "resume": False, "limit": math.inf}
    key = lambda c=config, d="digest": archive.result_key(c, d, code_dir=code)  # noqa: E731
    first = key()
    assert first == key({**config, "device": "cuda", "resume": True, "data": {"gap": 2, "root": "/data/b"}})
    assert first == key({**config, "output": "elsewhere", "workers": 4, "traceback": True, "figures": False})
    weights = [key({**config, "weights": name}) for name in ("/a/net.pt", "/b/net.pt", "/a/other.pt")]
    assert weights[0] == weights[1] != weights[2], "of a file its name counts, not its folder"
    others = {
        key({**config, "seed": 1}),
        key({**config, "data": {"gap": 3}}),
        key({**config, "limit": None}),
        key(d="x"),
    }
    (code / "note.txt").write_text("not code")
    assert first == key()
    (code / "sub" / "b.py").write_text("y = 2\n")
    others.add(key())
    (code / "sub" / "b.py").rename(code / "sub" / "c.py")
    others.add(key())
    (code / "calibration").mkdir()
    (code / "calibration" / "map.json").write_text("{}")
    others.add(key())
    assert first not in others and len(others) == 7, "a table that scores are read from decides a result as code does"
    archive.validate({**result(), "key": archive.result_key(config, "")})


def test_the_digest_reads_names_sizes_and_both_ends(tmp_path):
    head, tail = b"h" * archive.EDGE_BYTES, b"t" * archive.EDGE_BYTES
    one = tmp_path / "one"
    digest = lambda data, name="a/depth.bin": (one.write_bytes(data), archive.data_digest({name: one}))[1]  # noqa: E731
    first = digest(head + b"middle" + tail)
    assert first == digest(head + b"MIDDLE" + tail), "only the two ends are read"
    assert first not in {
        digest(head + b"middle" + tail, "b/depth.bin"),
        digest(head + b"middles" + tail),
        digest(b"x" + head[1:] + b"middle" + tail),
        digest(head + b"middle" + tail[1:] + b"x"),
    }
    elsewhere = tmp_path / "two"
    elsewhere.write_bytes(b"short")
    assert digest(b"short") == archive.data_digest({"a/depth.bin": elsewhere})
    assert archive.data_digest({"a": one, "b": elsewhere}) == archive.data_digest({"b": elsewhere, "a": one})


def test_settings_lose_what_belongs_to_one_machine(tmp_path, monkeypatch):
    monkeypatch.setenv("DHTORCH_DATA", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    config = {
        "data": {"root": str(tmp_path / "sets" / "holo")},
        "more": [{"root": "/elsewhere/tum"}, {"root": "sets/kitchen"}],
        "weights": "/models/net.pt",
        "name": "a/b",
        "hydra": {"job": 1},
    }
    short = archive.portable(config)
    assert short == {
        "data": {"root": "sets/holo"},
        "more": [{"root": "tum"}, {"root": "sets/kitchen"}],
        "weights": "net.pt",
        "name": "a/b",
    }
    monkeypatch.delenv("DHTORCH_DATA")
    assert archive.portable(config)["data"]["root"] == "holo"


def test_meta_says_when_and_with_what():
    meta = archive.meta(device="cpu", dtype=torch.float64, threads=2, seed=7)
    assert meta["dtype"] == "float64" and meta["versions"]["torch"].split("+")[0] == torch.__version__.split("+")[0]
    assert meta["utc"].endswith("+00:00") and (meta["git"] is None or isinstance(meta["git"], str))


def test_what_json_cannot_hold_is_refused():
    with pytest.raises(TypeError, match="found a object"):
        archive.strict({"x": object()})
