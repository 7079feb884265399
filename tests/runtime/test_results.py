"""Result files: schema, strictness, atomic writing, and the key that decides whether a job is done."""

import copy
import json
import math
import multiprocessing
import os
import stat
import subprocess
import sys
import time
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from support.byte_damage import change_middle
from support.small_result import KEY, result

from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage
from dhtorch.runtime.output_folder import open_output_folder


def test_a_result_survives_the_disk_and_is_strict(tmp_path):
    written = result()
    path = result_files.write_result(tmp_path / "deep" / "result.json", written)
    text = path.read_text()
    assert "NaN" not in text and "Infinity" not in text
    sealed = {**written, "seal": result_files.compute_seal(written)}
    assert result_files.read_result(path) == result_files.read_result(path.parent) == sealed == json.loads(text)
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
        (("rows", 0, "truth"), ["a"], r"\.rows\.0\.truth: found \['a'\], expected a text or null"),
        (("rows", 0, "note"), {"a": 1}, r"\.rows\.0\.note: found .*, expected a text or null"),
        (("rows", 0, "role"), 3, r"\.rows\.0\.role: found 3, expected a text or null"),
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
        result_files.validate_result(bad)


@pytest.mark.parametrize("place", [("rows",), ("meta", "git"), ("summary", "coverage", "unit"), ("rows", 0, "scene")])
def test_a_missing_field_is_named(place):
    bad = copy.deepcopy(result())
    inner = bad
    for name in place[:-1]:
        inner = inner[name]
    del inner[place[-1]]
    with pytest.raises(ValueError, match=r"\." + r"\.".join(map(str, place)) + ": found nothing, expected"):
        result_files.validate_result(bad)


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
        result_files.read_result(path)
    for text in ("", "{", '{"a": NaN}', '{"a": 1}', "[]", "\x00"):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"result\.json"):
            result_files.read_result(path)
        assert not result_files.is_finished(path, KEY)


def test_finished_asks_for_the_same_key(tmp_path):
    assert not result_files.is_finished(tmp_path, KEY)
    result_files.write_result(tmp_path / "result.json", result())
    assert result_files.is_finished(tmp_path / "result.json", KEY) and result_files.is_finished(tmp_path, KEY)
    assert not result_files.is_finished(tmp_path, KEY[::-1])


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = result_files.write_result(tmp_path / "result.json", result())
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"\.key"):
        result_files.write_result(path, {**result(), "key": "x"})
    os_replace, storage.Path.replace = storage.Path.replace, lambda *_: (_ for _ in ()).throw(OSError("disk full"))
    try:
        with pytest.raises(OSError, match="disk full"):
            result_files.write_result(path, {**result(), "key": KEY[::-1]})
    finally:
        storage.Path.replace = os_replace
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["result.json"]


def write_for_ever(path, ready):
    one = result_files.read_result(path)
    one["rows"] = one["rows"] * 200
    while True:
        result_files.write_result(path, one)
        ready.set()


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_killed_writer_leaves_a_whole_file(tmp_path):
    path = result_files.write_result(tmp_path / "result.json", result())
    context = multiprocessing.get_context("fork")
    ready = context.Event()
    writer = context.Process(target=write_for_ever, args=(path, ready))
    writer.start()
    try:
        assert ready.wait(60)
        for _ in range(20):
            assert len(result_files.read_result(path)["rows"]) == 400  # read while it is being replaced
    finally:
        writer.kill()
        writer.join()
    assert result_files.is_finished(path, KEY)


def test_rows_may_hold_what_an_experiment_needs(tmp_path):
    rows = [
        {"scene": "room", "pair": None, "method": "dinov2", "note": "too short", "ms": {"p50": 1.0, "p99": None}},
        {"scene": "", "pair": [3, 1], "method": "a.b", "curve": [[0.1, 0.2], [0.3, math.nan]], "ok": np.bool_(True)},
    ]
    asked = {"experiment": "latency", "question": "Q", "expectation": "E", "why": "W", "verdict": "undecided"}
    summary = {"a.b.median_rel": {"value": None, "low": None, "high": None, "n": 0, "unit": "1"}}
    written = result(rows=rows, summary=summary, **asked)
    result_files.write_result(tmp_path / "result.json", written)
    assert result_files.read_result(tmp_path)["rows"][1] == {**rows[1], "curve": [[0.1, 0.2], [0.3, None]], "ok": True}


def test_the_key_is_of_settings_code_and_data(tmp_path):
    code = tmp_path / "code"
    (code / "sub").mkdir(parents=True)
    (code / "a.py").write_text("from dhtorch.sub import b\n")
    (code / "sub" / "__init__.py").write_text("")
    (code / "sub" / "b.py").write_text("y = 1\n")
    config = {"seed": 0, "device": "cpu", "data": {"root": "/data/a", "gap": 2}, "resume": False, "limit": math.inf}
    config |= {"method": {"_target_": "dhtorch.a.function"}}
    key = lambda c=config, d="digest": result_files.compute_result_key(c, d, code_dir=code)  # noqa: E731
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
    (code / "c.py").write_text("nobody asks for it")
    assert first == key()
    (code / "sub" / "b.py").write_text("y = 2\n")
    others.add(key())
    (code / "sub" / "table.json").write_text("{}")
    others.add(key())
    assert first not in others and len(others) == 6, "a table that scores are read from decides a result as code does"
    result_files.validate_result({**result(), "key": result_files.compute_result_key(config, "")})


def test_the_digest_reads_names_and_every_byte(tmp_path):
    one, elsewhere = tmp_path / "one", tmp_path / "two"
    digest = lambda data, name="a/depth.bin": (one.write_bytes(data), result_files.compute_data_digest({name: one}))[1]  # noqa: E731
    content = bytes(300_000)
    first = digest(content)
    assert first not in {digest(content, "b/depth.bin"), digest(content + b"x"), digest(content[1:])}
    assert digest(content) == first
    for _ in range(2):  # there and back
        change_middle(one)
        assert (result_files.compute_data_digest({"a/depth.bin": one}) == first) == (one.read_bytes() == content)
    elsewhere.write_bytes(b"short")
    assert digest(b"short") == result_files.compute_data_digest({"a/depth.bin": elsewhere})
    assert result_files.compute_data_digest({"a": one, "b": elsewhere}) == result_files.compute_data_digest(
        {"b": elsewhere, "a": one}
    )


def test_a_file_is_hashed_once_until_it_changes(tmp_path, monkeypatch):
    """A file younger than the step of a file system's clock is always read: a second write may leave its times."""
    file, read, now = tmp_path / "a", [], time.time_ns()
    file.write_bytes(bytes(1000))
    hashed = storage.hashlib.file_digest
    monkeypatch.setattr(storage.hashlib, "file_digest", lambda *of: (read.append(1), hashed(*of))[1])
    first = storage.compute_file_digest(file)
    assert storage.compute_file_digest(file) == first and len(read) == 2
    monkeypatch.setattr(storage.time, "time_ns", lambda: now + 10**12)
    assert {storage.compute_file_digest(file) for _ in range(3)} == {first} and len(read) == 3
    change_middle(file)
    assert storage.compute_file_digest(file) != first and len(read) == 4


def test_a_copy_has_the_bytes_of_its_source(tmp_path):
    source, copy = tmp_path / "source", tmp_path / "copy"
    assert storage.copy_file(source, copy) == copy and not copy.exists(), "no source"
    source.write_bytes(bytes(300_000))
    storage.copy_file(source, copy)
    inode = copy.stat().st_ino
    storage.copy_file(source, copy)
    assert copy.read_bytes() == source.read_bytes() and copy.stat().st_ino == inode, "not written again"
    for changed in (source, copy):
        change_middle(changed)
        storage.copy_file(source, copy)
        assert copy.read_bytes() == source.read_bytes() and changed.stat().st_size == 300_000
    with open_output_folder(tmp_path / "out", "out"):
        (tmp_path / "out" / "copy").write_bytes(bytes(300_000))
        with pytest.raises(FileExistsError, match="a file that dhtorch did not write"):
            storage.copy_file(source, tmp_path / "out" / "copy")


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
    short = result_files.make_portable(config)
    assert short == {
        "data": {"root": "sets/holo"},
        "more": [{"root": "tum"}, {"root": "sets/kitchen"}],
        "weights": "net.pt",
        "name": "a/b",
    }
    monkeypatch.delenv("DHTORCH_DATA")
    assert result_files.make_portable(config)["data"]["root"] == "holo"


def test_meta_says_when_and_with_what():
    meta = result_files.collect_run_metadata(device="cpu", dtype=torch.float64, threads=2, seed=7, operators="torch")
    assert meta["dtype"] == "float64" and meta["versions"]["torch"].split("+")[0] == torch.__version__.split("+")[0]
    assert meta["utc"].endswith("+00:00") and (meta["git"] is None or isinstance(meta["git"], str))


def test_what_json_cannot_hold_is_refused():
    with pytest.raises(TypeError, match="found a object"):
        storage.to_strict_json({"x": object()})


# ---------------------------------------------------------------------------------------------------- each field


@pytest.mark.parametrize(
    ("place", "value", "expected"),
    [
        ((), [], "an object"),
        (("schema",), "1", "a whole number"),
        (("schema",), True, "a whole number"),
        (("experiment",), 3, "a text"),
        (("question",), 3, "a text or null"),
        (("expectation",), [], "a text or null"),
        (("verdict",), 1, "a text or null"),
        (("why",), {}, "a text or null"),
        (("expectation",), "x", "null for this experiment"),
        (("verdict",), "supported", "null for this experiment"),
        (("why",), "x", "null for this experiment"),
        (("key",), None, "a text"),
        (("key",), "0" * 63, "64 hexadecimal digits"),
        (("key",), "0" * 65, "64 hexadecimal digits"),
        (("key",), "g" + "0" * 63, "64 hexadecimal digits"),
        (("key",), "A" + "0" * 63, "64 hexadecimal digits"),
        (("meta",), [], "an object"),
        (("config",), None, "an object"),
        (("data",), "room", "an object"),
        (("summary",), [], "an object"),
        (("rows",), {}, "a list"),
        (("meta", "utc"), None, "a text"),
        (("meta", "git"), 1, "a text or null"),
        (("meta", "versions"), [], "an object"),
        (("meta", "device"), None, "a text"),
        (("meta", "dtype"), None, "a text"),
        (("meta", "threads"), 1.5, "a whole number"),
        (("meta", "seed"), None, "a whole number"),
        (("data", "name"), None, "a text"),
        (("data", "scenes"), {}, "a list"),
        (("data", "n_pairs"), 1.0, "a whole number"),
        (("data", "digest"), 5, "a text"),
        (("summary", "coverage"), 0.5, "an object"),
        (("summary", "coverage", "low"), "x", "a number or null"),
        (("summary", "coverage", "high"), True, "a number or null"),
        (("summary", "coverage", "n"), 1.5, "a whole number"),
        (("summary", "coverage", "unit"), None, "a text"),
        (("rows", 1), [], "an object"),
        (("rows", 0, "scene"), None, "a text"),
        (("rows", 0, "method"), 1, "a text"),
        (("rows", 0, "pair"), "05", "a list or null"),
        (("rows", 0, "pair"), [0, 1, 2], "[i, j] or null"),
        (("rows", 0, "pair"), [0, 1.5], "[i, j] or null"),
        (("rows", 0, "pair"), [True, 1], "[i, j] or null"),
        (("rows", 0, "deep"), {"a": [1.0, {"b": math.inf}]}, "a finite number or null"),
        (("config", "x"), -math.inf, "a finite number or null"),
        (("summary", "coverage", "value"), math.nan, "a finite number or null"),
    ],
)
def test_every_field_is_of_its_kind(place, value, expected):
    bad = changed(result(), place, value)
    with pytest.raises(ValueError, match=r"^file" + "".join(rf"\.{p}" for p in place)) as error:
        result_files.validate_result(bad, "file")
    assert str(error.value).endswith(f", expected {expected}") and ": found " in str(error.value)


def changed(value, place, new):
    """A copy with something else at a place."""
    if not place:
        return new
    twin = copy.deepcopy(value)
    inner = twin
    for name in place[:-1]:
        inner = inner[name]
    inner[place[-1]] = new
    return twin


def test_whole_numbers_are_numbers_and_rows_may_hold_more():
    result_files.validate_result(changed(result(), ("summary", "coverage", "value"), 1))
    result_files.validate_result(changed(result(), ("summary", "coverage", "low"), -2.5))
    result_files.validate_result(changed(result(), ("rows", 0, "note"), "more"))
    result_files.validate_result(changed(result(), ("meta", "git"), "v1"))
    result_files.validate_result(changed(result(), ("rows",), []))


@pytest.mark.parametrize("part", ["top", "meta", "data", "summary", "rows"])
def test_every_field_must_be_there_and_no_other(part):
    fields = {
        "top": "schema experiment question expectation verdict why key meta config data summary rows",
        "meta": "utc git versions device dtype threads seed",
        "data": "name scenes n_pairs digest",
        "summary": "value low high n unit",
        "rows": "scene pair method",
    }[part].split()
    place = {"top": (), "meta": ("meta",), "data": ("data",), "summary": ("summary", "coverage"), "rows": ("rows", 1)}[
        part
    ]
    for name in fields:
        bad = copy.deepcopy(result())
        inner = bad
        for step in place:
            inner = inner[step]
        del inner[name]
        where = ".".join(map(str, ("result", *place, name)))
        with pytest.raises(ValueError, match=f"^{where}: found nothing, expected "):
            result_files.validate_result(bad)
    if part != "rows":
        with pytest.raises(ValueError, match=r"zz: found an unknown field, expected " + ", ".join(fields)):
            result_files.validate_result(changed(result(), (*place, "zz"), 1))


@pytest.mark.parametrize("experiment", ["pair", "integrate", "motion"])
def test_only_experiments_have_a_question(experiment):
    asked = {"question": "Q", "expectation": "E", "why": "W", "verdict": "refuted"}
    if experiment == "motion":
        for verdict in ("supported", "refuted", "undecided"):
            assert result(experiment=experiment, **{**asked, "verdict": verdict})["verdict"] == verdict
        for name in asked:
            for nothing in (None, ""):
                with pytest.raises(ValueError, match=rf"^result\.{name}: found .*, expected a text"):
                    result(experiment=experiment, **{**asked, name: nothing})
    else:
        assert result(experiment=experiment)["verdict"] is None
        for name, text in asked.items():
            with pytest.raises(
                ValueError, match=rf"^result\.{name}: found '{text}', expected null for this experiment"
            ):
                result(experiment=experiment, **{name: text})


def test_long_values_are_cut_in_messages():
    for length, shown in ((58, "'" + "x" * 58 + "'"), (59, "'" + "x" * 56 + "...")):
        with pytest.raises(ValueError, match=r"\.question: found") as error:
            result(question="x" * length)
        assert f"found {shown}, expected" in str(error.value)


def test_strict_makes_of_everything_what_json_holds():
    given = {
        1: (np.float32(0.5), np.arange(3), torch.tensor([[1.0, torch.nan]])),
        "sets": [{3, 1, 2}, frozenset({"b", "a"})],
        "path": Path("/a/b"),
        "not": [math.nan, math.inf, -math.inf, np.float64(math.inf), torch.tensor(math.nan)],
        "as": [True, 0, "x", None, -2.5],
        "deep": {"a": {"b": ((math.nan,),)}},
    }
    assert storage.to_strict_json(given) == {
        "1": [0.5, [0, 1, 2], [[1.0, None]]],
        "sets": [[1, 2, 3], ["a", "b"]],
        "path": "/a/b",
        "not": [None] * 5,
        "as": [True, 0, "x", None, -2.5],
        "deep": {"a": {"b": [[None]]}},
    }
    assert storage.to_strict_json(True) is True and type(storage.to_strict_json(np.int64(3))) is int
    with pytest.raises(TypeError, match="result: found a complex, expected a value that JSON can hold"):
        storage.to_strict_json([1j])


# ---------------------------------------------------------------------------------------------------- files


def test_every_row_and_every_entry_is_a_line_of_its_own(tmp_path):
    summary = {name: {"value": 1.0, "low": None, "high": None, "n": 1, "unit": "°"} for name in "ab"}
    rows = [{"scene": "é", "pair": None, "method": "m"}] * 3
    text = result_files.write_result(tmp_path / "r.json", result(summary=summary, rows=rows)).read_text(
        encoding="utf-8"
    )
    lines = text.split("\n")
    assert text.endswith("\n}\n") and sum(line.startswith('  {"scene": "é"') for line in lines) == 3
    assert sum(line.startswith(('  "a": {', '  "b": {')) and "°" in line for line in lines) == 2
    assert sum(line.startswith(' "config": {"method": ') for line in lines) == 1
    empty = result_files.write_result(tmp_path / "e.json", result(summary={}, rows=[], config={})).read_text()
    assert ' "rows": []' in empty and ' "summary": {}' in empty and json.loads(empty)["rows"] == []


def test_a_file_is_replaced_whole_and_readable_by_all(tmp_path):
    path = storage.replace_file(str(tmp_path / "new" / "a.bin"), b"one")
    assert path == tmp_path / "new" / "a.bin" and path.read_bytes() == b"one" and path.stat().st_mode & 0o777 == 0o644
    inode = path.stat().st_ino
    assert storage.replace_file(path, b"two").read_bytes() == b"two" and path.stat().st_ino != inode, (
        "never written into"
    )
    assert [p.name for p in path.parent.iterdir()] == ["a.bin"]


def is_folder(handle):
    return stat.S_ISDIR(os.fstat(handle).st_mode)


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    """Content, then name, then the folder that holds the name; unfinished it lies beside, where ``clear`` finds it."""
    log, sync, replace = [], os.fsync, storage.Path.replace

    def synced(handle):
        log.append("folder" if is_folder(handle) else os.fstat(handle).st_size)
        sync(handle)

    def renamed(self, target):
        log.append((self.parent == target.parent, self.name.startswith(".a.bin."), self.name.endswith(".tmp")))
        return replace(self, target)

    monkeypatch.setattr(storage.os, "fsync", synced)
    monkeypatch.setattr(storage.Path, "replace", renamed)
    storage.replace_file(tmp_path / "a.bin", b"seven b")
    assert log == [7, (True, True, True), "folder"]


def test_a_system_that_cannot_sync_a_folder_is_no_error(tmp_path, monkeypatch):
    real_open, real_sync, closed = os.open, os.fsync, []

    def no_sync(handle):
        if is_folder(handle):
            closed.append(handle)
            raise OSError("not supported")
        real_sync(handle)

    monkeypatch.setattr(storage.os, "fsync", no_sync)
    assert storage.replace_file(tmp_path / "a", b"x").read_bytes() == b"x" and len(closed) == 1
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(closed[0])

    def no_open(path, *args, **options):
        if Path(path).is_dir() and not args[0] & os.O_CREAT:
            raise OSError("no folders")
        return real_open(path, *args, **options)

    monkeypatch.setattr(storage.os, "open", no_open)
    assert storage.replace_file(tmp_path / "a", b"y").read_bytes() == b"y"


def test_constants_that_json_does_not_know_are_refused(tmp_path):
    path = result_files.write_result(tmp_path / "result.json", result())
    good = path.read_text()
    for word in ("NaN", "Infinity", "-Infinity"):
        path.write_text(good.replace('"value": 0.5', f'"value": {word}'))
        with pytest.raises(
            ValueError, match=rf"result.json: found no strict JSON \(the constant {word}\), expected a re"
        ):
            result_files.read_result(path)
        assert not result_files.is_finished(tmp_path, KEY)
    path.write_text(good)
    assert (
        result_files.is_finished(tmp_path, KEY)
        and result_files.is_finished(str(path), KEY)
        and not result_files.is_finished(path, KEY[:-1])
    )


def test_a_key_that_stands_twice_is_refused(tmp_path):
    path = result_files.write_result(tmp_path / "result.json", result())
    path.write_text(path.read_text().replace('"n": 1,', '"n": 1, "n": 2,'))
    with pytest.raises(ValueError, match=r"result.json: found no strict JSON \(the key 'n' twice\), expected a result"):
        result_files.read_result(path)
    assert storage.parse_strict_json('{"a": {"b": 1}, "b": [{"b": 2}]}') == {"a": {"b": 1}, "b": [{"b": 2}]}


def test_what_is_not_finite_is_not_written(tmp_path):
    for value in (math.nan, math.inf):
        with pytest.raises(ValueError, match="JSON"):
            storage.write_json(tmp_path / "a.json", [value])
    assert not list(tmp_path.iterdir())
    path = storage.write_json(tmp_path / "a.json", {"é": [1, None]})
    assert path.read_bytes() == '{\n "é": [\n  1,\n  null\n ]\n}\n'.encode() and storage.parse_strict_json(
        path.read_text()
    ) == {"é": [1, None]}


# ---------------------------------------------------------------------------------------------------- keys


def test_each_option_counts_but_those_of_place_and_pace(tmp_path):
    (tmp_path / "a.py").write_text("")
    key = lambda config, digest="d": result_files.compute_result_key(config, digest, code_dir=tmp_path)  # noqa: E731
    base = {"a": 1, "deep": {"b": [1, {"c": 2}]}}
    first = key(base)
    assert first == key({"deep": {"b": (1, {"c": 2})}, "a": 1}), "neither order nor the kind of a list"
    for name in ("root", "folder", "cache", "output", "figures", "device", "resume", "traceback", "workers", "hydra"):
        assert key({**base, name: 5}) == first, name
        assert key({"a": 1, "deep": {"b": [1, {"c": 2, name: 5}], name: {"x": 1}}}) == first, f"{name} deep inside"
    others = [
        *({**base, name: 5} for name in ("rooted", "seed", "threads", "dtype", "batch")),
        {**base, "a": 2},
        {**base, "a": "1"},
        {**base, "a": None},
        {"a": 1, "deep": {"b": [{"c": 2}, 1]}},
        {"a": 1, "deep": {"b": [1, {"c": 3}]}},
        {"a": 1, "deep": {"c": [1, {"c": 2}]}},
    ]
    keys = {first, key(base, "e"), *map(key, others)}
    assert len(keys) == 2 + len(others) and all(len(k) == 64 for k in keys)
    assert key({"a": "x"}, "yz") != key({"a": "xy"}, "z")


def test_code_counts_by_name_and_content(tmp_path):
    def key(**files):
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        folder.mkdir()
        for name, text in {"sub____init___py": "", **files}.items():
            path = folder / name.replace("__init__", "@").replace("__", "/").replace("_", ".").replace("@", "__init__")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return result_files.compute_result_key(
            {}, "d", roots=["dhtorch.a", "dhtorch.sub.b", "dhtorch.c"], code_dir=folder
        )

    first = key(a_py="1", sub__b_py="2", sub__m_json="3")
    assert first == key(sub__b_py="2", sub__m_json="3", a_py="1"), "the folder's own place does not count"
    assert first == key(a_py="1", sub__b_py="2", sub__m_json="3", x_json="4", other__y_json="5", d_py="6")
    others = [
        key(a_py="0", sub__b_py="2", sub__m_json="3"),
        key(a_py="1", sub__b_py="0", sub__m_json="3"),
        key(a_py="1", sub__b_py="2", sub__m_json="0"),
        key(c_py="1", sub__b_py="2", sub__m_json="3"),
        key(a_py="1", sub__b_py="2", sub__n_json="3"),
        key(a_py="1", sub__b_py="2"),
        key(a_py="2", sub__b_py="1", sub__m_json="3"),
    ]
    assert len({first, *others}) == 8


def test_a_result_names_no_place_of_this_machine(tmp_path):
    kept = result(config={"data": {"root": str(tmp_path / "sets" / "desk")}, "holdout": {"cutoff": 2.0}})
    assert kept["config"] == {"data": {"root": "desk"}, "holdout": {"cutoff": 2.0}}


def test_the_digest_tells_what_is_joined_from_what_is_apart(tmp_path):
    def digest(**texts):
        for name, text in texts.items():
            (tmp_path / name).write_bytes(text)
        return result_files.compute_data_digest({name: tmp_path / name for name in texts})

    whole = {digest(a=b"one", b=b"two"), digest(a=b"two", b=b"one"), digest(a=b"one"), digest(b=b"one"), digest()}
    whole |= {digest(a=b"on", b=b"etwo"), digest(a=b""), digest(a=b"\0" * 65537), digest(a=b"\0" * 65536)}
    assert len(whole) == 9
    # Written one after the other, names, sizes and contents of these one and two files are the same bytes.
    assert digest(a=b"0b 3xyzxyz") != digest(**{"a": b"0", "b 3xyzxyz0b": b"xyz"})


def test_files_are_named_by_their_place_below_a_root(tmp_path):
    for name in ("one/set/a.bin", "one/set/sub/b.bin", "two/set/a.bin", "three.npz"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    one, two, file = tmp_path / "one" / "set", tmp_path / "two" / "set", tmp_path / "three.npz"
    found = result_files.list_files_below([(one, one), (None, None), (two, None), (one, one), (file, file)])
    assert found == {
        "0/a.bin": one / "a.bin",
        "0/sub/b.bin": one / "sub" / "b.bin",
        "1/a.bin": two / "a.bin",
        "2/three.npz": file,
    }
    assert result_files.list_files_below([]) == result_files.list_files_below([(None, None)]) == {}


def test_files_that_settings_name_are_found_at_every_depth(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    for name in ("net.pt", "sub/list.txt", "plain"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x")
    settings = {
        "method": {"weights": str(tmp_path / "net.pt"), "seats": [{"a": "sub/list.txt"}, "~/net.pt"], "n": 5},
        "plain": "plain",  # no place, a word
        "beside": "net.pt",
        "gone": "/nowhere/net.pt",
        "folder": str(tmp_path / "sub"),
    }
    assert result_files.list_files_named(settings) == {
        "settings/.method.weights": tmp_path / "net.pt",
        "settings/.method.seats.0.a": Path("sub/list.txt"),
        "settings/.method.seats.1": tmp_path / "net.pt",
        "settings/.beside": Path("net.pt"),
    }


def test_places_are_relative_to_the_collection_or_a_last_word(tmp_path, monkeypatch):
    monkeypatch.delenv("DHTORCH_DATA", raising=False)
    base = tmp_path / "sets"
    for given, short in (
        (base / "a" / "b", "a/b"),
        (base, "sets"),
        (tmp_path / "setsofmine" / "c", "c"),
        (tmp_path / "x.pt", "x.pt"),
        (base / "a" / ".." / "d", "d"),
    ):
        assert result_files.make_portable({"w": str(given)}, base) == {"w": short}, given
        assert result_files.make_portable({"deep": [{"w": given}]}, str(base)) == {"deep": [{"w": short}]}
    plain = {"root": "", "w": "a/b", "n": 3, 4: None, "seats": ("x", 1.5), "place": "~"}
    assert result_files.make_portable(plain, base) == {
        "root": "",
        "w": "a/b",
        "n": 3,
        "4": None,
        "seats": ["x", 1.5],
        "place": "~",
    }
    nested = {
        "root": "far/away/set",
        "hydra": 1,
        "output": 2,
        "a": {"output": 3, "hydra": 4, "root": ["r/one", "r/two"]},
    }
    assert result_files.make_portable(nested) == {"root": "set", "a": {"root": ["one", "two"]}}
    monkeypatch.setenv("DHTORCH_DATA", str(base))
    assert result_files.make_portable({"w": str(base / "a" / "b")}) == {"w": "a/b"}
    assert result_files.make_portable({"w": str(base / "a" / "b")}, tmp_path) == {"w": "sets/a/b"}, (
        "a base that is given goes first"
    )


def test_meta_holds_what_it_was_given_and_what_is_installed(tmp_path, monkeypatch):
    meta = result_files.collect_run_metadata(device="cuda:1", dtype="float16", threads=3, seed=11, operators="torch")
    assert (meta["device"], meta["dtype"], meta["threads"], meta["seed"]) == ("cuda:1", "float16", 3, 11)
    assert {"python", "dhtorch", "torch", "kornia", "numpy", "opencv-python-headless", "hydra-core"} == set(
        meta["versions"]
    )
    assert meta["versions"]["python"] == ".".join(map(str, sys.version_info[:3]))
    assert meta["versions"]["numpy"] == np.__version__
    when = datetime.fromisoformat(meta["utc"])
    assert abs((datetime.now(UTC) - when).total_seconds()) < 60 and when.microsecond == 0

    def absent(name):
        raise result_files.importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(result_files.importlib.metadata, "version", absent)
    versions = result_files.collect_run_metadata(device="cpu", dtype="x", threads=1, seed=0, operators="torch")[
        "versions"
    ]
    assert versions["torch"] is None and versions["python"]


def test_the_commit_is_that_of_the_code(tmp_path, monkeypatch):
    """A package in a folder of its own under version control, outside of it, and without git."""
    package = tmp_path / "package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    monkeypatch.setattr(result_files, "__file__", str(package / "runtime/results.py"))
    metadata = partial(result_files.collect_run_metadata, device="cpu", dtype="x", threads=1, seed=0, operators="torch")
    commit = lambda: metadata()["git"]  # noqa: E731
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert commit() is None
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    subprocess.run([*git, "init", "-q"], check=True)
    assert commit() is None, "in a repository, but not of it"
    subprocess.run([*git, "add", "package"], check=True)
    subprocess.run([*git, "commit", "-q", "-m", "x"], check=True)
    clean = commit()
    hashed = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True).stdout
    assert len(clean) >= 7 and hashed.startswith(clean)
    (package / "__init__.py").write_text("x = 1\n")
    assert commit() == f"{clean}-dirty"
    subprocess.run([*git, "commit", "-q", "-a", "-m", "y"], check=True)
    subprocess.run([*git, "tag", "v7"], check=True)
    assert commit() == "v7"
    monkeypatch.setenv("PATH", str(tmp_path))
    assert commit() is None


def test_what_a_link_leads_to_is_read_where_readers_follow_it(tmp_path):
    """The path of a target that no reader opens enters the digest; nothing outside is read."""
    root, outside = tmp_path / "set", tmp_path / "outside"
    for name in ("set/depth/a", "outside/images/b", "outside/c"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    links = {"inner": "depth/a", "again": "depth", "out": outside / "c", "images": outside / "images", "loop": "../set"}
    for name, target in links.items():
        (root / name).symlink_to(target)
    bound, free = (result_files.list_files_below([(root, bounds)]) for bounds in (root, None))
    inside = {"0/depth/a": root / "depth/a", "0/inner": root / "inner", "0/again": "link to depth"}
    inside["0/loop"] = "link to ../set"
    assert bound == inside | {f"0/{name}": f"link to {links[name]}" for name in ("out", "images")}
    assert free == inside | {"0/out": root / "out", "0/images/b": root / "images/b"}
    assert result_files.list_files_below([(root / "depth", root)]) == {"0/a": root / "depth/a"}
    digests = []
    for _ in range(2):
        digests += [result_files.compute_data_digest(files) for files in (bound, free)]
        change_middle(outside / "images/b")
    assert digests[0] == digests[2] and digests[1] != digests[3]


def test_a_folder_that_cannot_be_read_is_left_out(tmp_path, monkeypatch):
    for name in ("a", "closed/b"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    scan = os.scandir

    def refuse(folder):
        if Path(folder).name == "closed":
            raise PermissionError(folder)
        return scan(folder)

    monkeypatch.setattr(os, "scandir", refuse)
    assert result_files.list_files_below([(tmp_path, None)]) == {"0/a": tmp_path / "a"}


@pytest.mark.parametrize(
    "content", ["null", "[]", "7", '"x"', "{}", "", '{"key": 1}', '{"key": 1, "config": {}, "data": 3}']
)
def test_metadata_of_other_types_are_no_run(tmp_path, content):
    file = tmp_path / "about.json"
    file.write_text(content)
    with pytest.raises(
        FileExistsError, match=r"about\.json: found .*, expected a file written by dhtorch complete"
    ) as refused:
        result_files.check_same_run(file, {"key": "a", "config": {}, "data": {"digest": ""}}, "complete")
    assert "\n" not in str(refused.value)
    here = {"key": "a", "config": {"n": 1}, "data": {"digest": "d"}, "git": "v1", "version": "0"}
    file.write_text(json.dumps(here))
    result_files.check_same_run(file, here, "complete")
    with pytest.raises(FileExistsError, match=r"another run \(n 1 there, 2 here\)"):
        result_files.check_same_run(file, {**here, "key": "b", "config": {"n": 2}}, "complete")
