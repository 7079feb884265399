"""Result files: schema, strictness, atomic writing, and the key that decides whether a job is done."""

import ast
import contextlib
import copy
import json
import math
import multiprocessing
import os
import shutil
import stat
import subprocess
import sys
import time
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import hydra
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from support.byte_damage import change_middle
from support.small_result import KEY, result

import dhtorch
from dhtorch.cli.run import config_dir, job_name
from dhtorch.runtime import code_dependencies, storage
from dhtorch.runtime import results as result_files
from dhtorch.runtime.output_folder import open_output_folder

MISSING = object()
QUESTION = {"experiment": "motion", "question": "Q", "expectation": "E", "why": "W", "verdict": "refuted"}
NO_QUESTION = {"question": None, "expectation": None, "why": None, "verdict": None}


def write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


# ------------------------------------------------------------------------------------------------------------- schema

#: Part of a result → its place and fields.
PARTS = {
    (): "schema experiment question expectation verdict why key meta config data summary rows",
    ("meta",): "utc git versions device dtype threads seed",
    ("data",): "name scenes n_pairs digest",
    ("summary", "coverage"): "value low high n unit",
    ("rows", 1): "scene pair method",
}

#: Place in a result, what stands there instead, and the message after "found".
WRONG = [
    ((), [], "[], expected an object"),
    (("schema",), 2, "2, expected 1"),
    (("schema",), "1", "'1', expected a whole number"),
    (("schema",), True, "True, expected a whole number"),
    (("experiment",), None, "None, expected a text"),
    (("question",), "x" * 58, f"'{'x' * 58}', expected null for this experiment"),
    (("question",), "x" * 59, f"'{'x' * 56}..., expected null for this experiment"),
    *(((name,), 3, "3, expected a text or null") for name in NO_QUESTION),
    *(((name,), "x", "'x', expected null for this experiment") for name in NO_QUESTION),
    (("key",), None, "None, expected a text"),
    *((("key",), key, f"'{key}', expected 64 hexadecimal digits") for key in ("abc", "0" * 50)),
    *(
        (("key",), key, ", expected 64 hexadecimal digits")
        for key in ("0" * 63, "0" * 65, "g" + "0" * 63, "A" + "0" * 63)
    ),
    *(((name,), [], "[], expected an object") for name in ("meta", "config", "data", "summary")),
    (("rows",), {}, "{}, expected a list"),
    *((("meta", name), 1, "1, expected a text") for name in ("utc", "device", "dtype", "processor", "operators")),
    (("meta", "git"), 1, "1, expected a text or null"),
    (("meta", "versions"), [], "[], expected an object"),
    *((("meta", name), 1.5, "1.5, expected a whole number") for name in ("threads", "seed")),
    (("meta", "seed"), True, "True, expected a whole number"),
    (("data", "name"), None, "None, expected a text"),
    (("data", "scenes"), "room", "'room', expected a list"),
    (("data", "n_pairs"), 1.0, "1.0, expected a whole number"),
    (("data", "digest"), 5, "5, expected a text"),
    (("summary", "coverage"), 0.5, "0.5, expected an object"),
    *((("summary", "coverage", name), "x", "'x', expected a number or null") for name in ("value", "low", "high")),
    (("summary", "coverage", "high"), True, "True, expected a number or null"),
    (("summary", "coverage", "n"), 1.5, "1.5, expected a whole number"),
    (("summary", "coverage", "unit"), None, "None, expected a text"),
    (("rows", 1), [], "[], expected an object"),
    (("rows", 0, "scene"), None, "None, expected a text"),
    (("rows", 0, "method"), 1, "1, expected a text"),
    *((("rows", 0, name), ["a"], "['a'], expected a text or null") for name in ("truth", "role", "note")),
    (("rows", 0, "pair"), "05", "'05', expected a list or null"),
    *((("rows", 0, "pair"), x, f"{x}, expected [i, j] or null") for x in ([1], [0, 1, 2], [0, 1.5], [True, 1])),
    (("rows", 1, "median_rel"), math.nan, "nan, expected a finite number or null"),
    (("rows", 0, "deep"), {"a": [1.0, {"b": math.inf}]}, "inf, expected a finite number or null"),
    (("config", "x"), -math.inf, "-inf, expected a finite number or null"),
    (("summary", "coverage", "value"), math.nan, "nan, expected a finite number or null"),
    *(((*place, name), MISSING, "nothing, expected ") for place, names in PARTS.items() for name in names.split()),
    *(
        ((*place, "zz"), 1, f"an unknown field, expected {', '.join(names.split())}")
        for place, names in PARTS.items()
        if "rows" not in place
    ),
]


def changed(place, new):
    """A result with something else, or nothing, at a place."""
    if not place:
        return new
    twin = copy.deepcopy(result())
    inner = twin
    for name in place[:-1]:
        inner = inner[name]
    inner[place[-1]] = new
    if new is MISSING:
        del inner[place[-1]]
    return twin


@pytest.mark.parametrize(("place", "value", "message"), WRONG)
def test_a_field_that_is_not_of_its_kind_is_named(place, value, message):
    with pytest.raises(ValueError, match=r"^file" + "".join(rf"\.{p}" for p in place)) as error:
        result_files.validate_result(changed(place, value), "file")
    assert message in str(error.value) and ": found " in str(error.value)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("summary", "coverage", "value"), 1),
        (("summary", "coverage", "low"), -2.5),
        (("rows", 0, "note"), "more"),
        (("rows", 0, "curve"), [[0.1, 0.2], [0.3, None]]),
        (("meta", "git"), "v1"),
        (("meta", "processor"), "a"),
        (("rows",), []),
        (("seal",), "of release 3"),
    ],
)
def test_whole_numbers_are_numbers_rows_hold_more_and_older_fields_are_known(place, value):
    result_files.validate_result(changed(place, value))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        *((QUESTION | {"verdict": verdict}, None) for verdict in ("supported", "refuted", "undecided")),
        (QUESTION | {"verdict": "perhaps"}, "verdict: found 'perhaps', expected supported, refuted, undecided"),
        *((QUESTION | {name: x}, f"{name}: found {x!r}, expected a text") for name in NO_QUESTION for x in (None, "")),
        *((NO_QUESTION | {"experiment": experiment}, None) for experiment in ("pair", "integrate")),
        (QUESTION | {"experiment": "integrate"}, "question: found 'Q', expected null for this experiment"),
    ],
)
def test_only_experiments_have_a_question_and_a_verdict(fields, message):
    if message is None:
        assert result(**fields)["verdict"] == fields["verdict"]
    else:
        with pytest.raises(ValueError, match=rf"^result\.{message}"):
            result(**fields)


def test_strict_json_holds_numbers_texts_lists_and_objects():
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
    for value, kind in ([1j], "complex"), ({"x": object()}, "object"):
        with pytest.raises(TypeError, match=f"result: found a {kind}, expected a value that JSON can hold"):
            storage.to_strict_json(value)


# -------------------------------------------------------------------------------------------------------------- files


def test_a_result_is_read_as_written_with_a_line_for_every_row_and_entry(tmp_path):
    summary = {name: {"value": 1.0, "low": None, "high": None, "n": 1, "unit": "°"} for name in "ab"}
    written = result(summary=summary, rows=[*result()["rows"], {"scene": "é", "pair": None, "method": "m", "ok": True}])
    path = result_files.write_result(tmp_path / "deep" / "result.json", written)
    text = path.read_text(encoding="utf-8")
    assert result_files.read_result(path) == result_files.read_result(path.parent) == written == json.loads(text)
    assert written["rows"][1]["corr"] is None and written["config"]["holdout"]["cutoff"] is None
    assert written["rows"][0]["pair"] == [0, 5] and written["rows"][0]["n_kept"] == 3
    assert [p.name for p in path.parent.iterdir()] == ["result.json"]
    lines = text.split("\n")
    assert text.endswith("\n}\n") and sum(line.startswith('  {"scene": "') for line in lines) == 3
    assert sum(line.startswith(('  "a": {', '  "b": {')) and "°" in line for line in lines) == 2
    assert sum(line.startswith(' "config": {"method": ') for line in lines) == 1
    empty = result_files.write_result(tmp_path / "e.json", result(summary={}, rows=[], config={})).read_text()
    assert ' "rows": []' in empty and ' "summary": {}' in empty and json.loads(empty)["rows"] == []


#: Text in the place of a result → the message.
UNREADABLE = {
    None: "found no file",
    "": "result.json",
    "{": "found no strict JSON",
    "\x00": "result.json",
    '{"a": 1}': "found nothing, expected",
    "[]": "expected an object",
    **{f'{{"a": {word}}}': rf"no strict JSON \(the constant {word}\), e" for word in ("NaN", "Infinity", "-Infinity")},
    '{"a": {"n": 1, "n": 2}}': r"found no strict JSON \(the key 'n' twice\), expected a result",
    **dict.fromkeys(("[" * 200_000, '{"a":' * 900 + "1" + "}" * 900, "[" * 100 + "]" * 100), "found no strict JSON"),
}


@pytest.mark.parametrize("text", UNREADABLE, ids=range(len(UNREADABLE)))
def test_a_file_that_is_no_result_is_named_and_not_finished(tmp_path, text):
    path = tmp_path / "result.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises((ValueError, FileNotFoundError), match=UNREADABLE[text]) as error:
        result_files.read_result(path)
    assert "result.json" in str(error.value) and not result_files.is_finished(path, KEY)


def test_a_result_of_the_same_key_is_finished(tmp_path):
    path = result_files.write_result(tmp_path / "result.json", result())
    assert result_files.is_finished(str(path), KEY) and result_files.is_finished(tmp_path, KEY)
    assert not result_files.is_finished(path, KEY[:-1]) and not result_files.is_finished(path, KEY[::-1])
    assert storage.parse_strict_json('{"a": {"b": 1}, "b": [{"b": 2}]}') == {"a": {"b": 1}, "b": [{"b": 2}]}


def test_what_is_not_finite_is_not_written(tmp_path):
    for value in (math.nan, math.inf):
        with pytest.raises(ValueError, match="JSON"):
            storage.write_json(tmp_path / "a.json", [value])
    assert not list(tmp_path.iterdir())
    path = storage.write_json(tmp_path / "a.json", {"é": [1, None]})
    assert path.read_bytes() == '{\n "é": [\n  1,\n  null\n ]\n}\n'.encode()


def refuse(*_):
    raise OSError("disk full")


def test_a_failed_write_leaves_the_old_file_and_a_replaced_one_is_whole_and_readable_by_all(tmp_path, monkeypatch):
    path = result_files.write_result(tmp_path / "new" / "result.json", result())
    before, inode = path.read_bytes(), path.stat().st_ino
    with pytest.raises(ValueError, match=r"\.key"):
        result_files.write_result(path, {**result(), "key": "x"})
    with monkeypatch.context() as patch, pytest.raises(OSError, match="disk full"):
        patch.setattr(storage.Path, "replace", refuse)
        result_files.write_result(path, {**result(), "key": KEY[::-1]})
    assert path.read_bytes() == before
    assert storage.replace_file(str(path), b"two") == path and path.stat().st_ino != inode, "never written into"
    assert path.read_bytes() == b"two" and path.stat().st_mode & 0o777 == 0o644
    assert [p.name for p in path.parent.iterdir()] == ["result.json"]


@pytest.mark.parametrize("refused", ["", "sync", "open"])
def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch, refused):
    """Content, then name, then the folder that holds the name; a system that cannot sync or open a folder is no error."""
    log, sync, replace, real_open = [], os.fsync, storage.Path.replace, os.open

    def synced(handle):
        is_folder = stat.S_ISDIR(os.fstat(handle).st_mode)
        log.append("folder" if is_folder else os.fstat(handle).st_size)
        return refuse() if is_folder and refused == "sync" else sync(handle)

    def opened(path, *args, **options):
        is_refused = refused == "open" and Path(path).is_dir() and not args[0] & os.O_CREAT
        return refuse() if is_refused else real_open(path, *args, **options)

    def renamed(self, target):
        log.append((self.parent == target.parent, self.name.startswith(".a.bin."), self.name.endswith(".tmp")))
        return replace(self, target)

    for place, name, function in ((os, "fsync", synced), (os, "open", opened), (storage.Path, "replace", renamed)):
        monkeypatch.setattr(place, name, function)
    n_open = len([*Path("/proc/self/fd").iterdir()])
    assert storage.replace_file(tmp_path / "a.bin", b"seven b").read_bytes() == b"seven b"
    assert log == [7, (True, True, True), "folder"][: 3 - (refused == "open")]
    assert len([*Path("/proc/self/fd").iterdir()]) == n_open, "every file is closed"


def test_a_copy_has_the_bytes_of_its_source(tmp_path):
    source, copied = tmp_path / "source", tmp_path / "copy"
    assert storage.copy_file(source, copied) == copied and not copied.exists(), "no source"
    source.write_bytes(bytes(300_000))
    storage.copy_file(source, copied)
    inode = copied.stat().st_ino
    storage.copy_file(source, copied)
    assert copied.read_bytes() == source.read_bytes() and copied.stat().st_ino == inode, "not written again"
    for file in (source, copied):
        change_middle(file)
        storage.copy_file(source, copied)
        assert copied.read_bytes() == source.read_bytes() and file.stat().st_size == 300_000
    with open_output_folder(tmp_path / "out", "out"):
        write(tmp_path / "out" / "copy", bytes(300_000))
        with pytest.raises(FileExistsError, match="a file that dhtorch did not write"):
            storage.copy_file(source, tmp_path / "out" / "copy")


# --------------------------------------------------------------------------------------------------------------- keys

BASE = {"a": 1, "deep": {"b": [1, {"c": 2}]}, "data": {"root": "/data/a", "gap": 2}}
#: Options of place and pace, which do not change a result.
NO_KEY = ("root", "folder", "cache", "output", "figures", "device", "resume", "traceback", "workers", "hydra")
SAME = [
    {"data": {"gap": 2, "root": "/data/b"}, "deep": {"b": (1, {"c": 2})}, "a": 1},
    *({**BASE, name: 5} for name in NO_KEY),
    *({**BASE, "deep": {"b": [1, {"c": 2, name: 5}], name: {"x": 1}}} for name in NO_KEY),
]
OTHER = [
    *({**BASE, name: 5} for name in ("rooted", "seed", "threads", "dtype", "batch")),
    *({**BASE, "a": value} for value in (2, "1", None, math.inf, "/a/net.pt", "/a/other.pt")),
    *({**BASE, "deep": {"b": value}} for value in ([{"c": 2}, 1], [1, {"c": 3}])),
    {**BASE, "deep": {"c": [1, {"c": 2}]}},
    {**BASE, "data": {"gap": 3}},
]


def test_every_option_counts_but_those_of_place_and_pace(tmp_path):
    key = lambda config, digest="d": result_files.compute_result_key(config, digest, code_dir=tmp_path)  # noqa: E731
    first = key(BASE)
    assert {key(config) for config in SAME} == {first}, "neither order nor the kind of a list"
    keys = {first, key(BASE, "e"), *map(key, OTHER)}
    assert len(keys) == 2 + len(OTHER) and all(len(k) == 64 for k in keys)
    assert key({"a": "x"}, "yz") != key({"a": "xy"}, "z")
    assert key({**BASE, "a": "/a/net.pt"}) == key({**BASE, "a": "/b/net.pt"}), "of a file its name counts"


FILES = {"a.py": "from dhtorch.sub import b\n", "sub/__init__.py": "", "sub/b.py": "2", "sub/m.json": "3"}


@pytest.mark.parametrize(
    ("files", "counts"),
    [
        (dict(reversed(FILES.items())), False),
        (FILES | {"x.json": "4", "other/y.json": "5", "d.py": "6"}, False),
        (FILES | {"a.py": "from dhtorch.sub import b as c\n"}, True),
        (FILES | {"sub/b.py": "0"}, True),
        (FILES | {"sub/m.json": "0"}, True),
        (FILES | {"sub/n.json": "3"}, True),
        ({name: text for name, text in FILES.items() if name != "sub/m.json"}, True),
        ({name: text for name, text in FILES.items() if name != "a.py"} | {"c.py": FILES["a.py"]}, True),
    ],
)
def test_code_that_is_reached_counts_by_name_and_content(tmp_path, files, counts):
    keys = []
    for place, content in (("one", FILES), ("two", files)):
        for name, text in content.items():
            write(tmp_path / place / name, text)
        config = {"method": {"_target_": "dhtorch.a.function"}, "score": {"_target_": "dhtorch.c.function"}}
        keys.append(result_files.compute_result_key(config, "d", code_dir=tmp_path / place))
    assert (keys[0] != keys[1]) == counts


def digest(folder, **texts):
    return result_files.compute_data_digest({name: write(folder / name, text) for name, text in texts.items()})


def test_the_digest_reads_names_and_every_byte(tmp_path):
    content, texts = bytes(300_000), [{"a": "one", "b": "two"}, {"a": "two", "b": "one"}, {"a": "one"}, {"b": "one"}]
    texts += [{}, {"a": "on", "b": "etwo"}, {"a": ""}, {"a": "\0" * 65537}, {"a": "\0" * 65536}]
    texts += [{"a": content}, {"b": content}, {"a": content + b"x"}, {"a": content[1:]}]
    # Written one after the other, names, sizes and contents of these one and two files are the same bytes.
    texts += [{"a": "0b 3xyzxyz"}, {"a": "0", "b 3xyzxyz0b": "xyz"}]
    assert len({digest(tmp_path, **each) for each in texts}) == len(texts)
    first = digest(tmp_path / "elsewhere", b="two", a="one")
    assert first == digest(tmp_path, a="one", b="two"), "neither the order nor the place of files"
    file = write(tmp_path / "a", content)
    whole = result_files.compute_data_digest({"a": file})
    for is_same in (False, True):  # there and back
        change_middle(file)
        assert (result_files.compute_data_digest({"a": file}) == whole) == is_same


def test_a_file_is_hashed_once_until_it_changes(tmp_path, monkeypatch):
    """A file younger than the step of a file system's clock is always read: a second write may leave its times."""
    file, read, now = write(tmp_path / "a", bytes(1000)), [], time.time_ns()
    hashed = storage.hashlib.file_digest
    monkeypatch.setattr(storage.hashlib, "file_digest", lambda *of: (read.append(1), hashed(*of))[1])
    first = storage.compute_file_digest(file)
    assert storage.compute_file_digest(file) == first and len(read) == 2
    monkeypatch.setattr(storage.time, "time_ns", lambda: now + 10**12)
    assert {storage.compute_file_digest(file) for _ in range(3)} == {first} and len(read) == 3
    change_middle(file)
    assert storage.compute_file_digest(file) != first and len(read) == 4


def test_files_of_data_and_settings_are_named_by_their_place(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    for name in ("one/set/a.bin", "one/set/sub/b.bin", "two/set/a.bin", "three.npz", "plain", "sub/list.txt"):
        write(tmp_path / name, name)
    one, two, file = tmp_path / "one" / "set", tmp_path / "two" / "set", tmp_path / "three.npz"
    found = result_files.list_files_below([(one, one), (None, None), (two, None), (one, one), (file, file)])
    assert found == {
        "0/a.bin": one / "a.bin",
        "0/sub/b.bin": one / "sub" / "b.bin",
        "1/a.bin": two / "a.bin",
        "2/three.npz": file,
    }
    assert result_files.list_files_below([]) == result_files.list_files_below([(None, None)]) == {}
    settings = {
        "method": {"weights": str(file), "seats": [{"a": "sub/list.txt"}, "~/three.npz"], "n": 5},
        "plain": "plain",  # no place, a word
        "beside": "three.npz",
        "gone": "/nowhere/net.pt",
        "folder": str(tmp_path / "sub"),
    }
    assert result_files.list_files_named(settings) == {
        "settings/.method.weights": file,
        "settings/.method.seats.0.a": Path("sub/list.txt"),
        "settings/.method.seats.1": file,
        "settings/.beside": Path("three.npz"),
    }


def test_what_a_link_leads_to_is_read_where_readers_follow_it(tmp_path, monkeypatch):
    """The path of a target that no reader opens enters the digest; nothing outside, and no closed folder, is read."""
    root, outside, scan = tmp_path / "set", tmp_path / "outside", os.scandir
    for name in ("set/depth/a", "outside/images/b", "outside/c", "set/closed/d"):
        write(tmp_path / name, name)

    def closed(folder):
        if Path(folder).name == "closed":
            raise PermissionError(folder)
        return scan(folder)

    monkeypatch.setattr(os, "scandir", closed)
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


#: Settings, with SETS for the folder of data and HERE for that above it → what is stored of them.
PORTABLE = [
    ({"w": "SETS/a/b"}, {"w": "a/b"}),
    ({"w": "SETS"}, {"w": "sets"}),
    ({"w": "HERE/setsofmine/c"}, {"w": "c"}),
    ({"w": "SETS/a/../d"}, {"w": "d"}),
    ({"deep": [{"w": "HERE/x.pt"}]}, {"deep": [{"w": "x.pt"}]}),
    ({"more": [{"root": "/elsewhere/tum"}, {"root": "sets/kitchen"}]}, {"more": [{"root": "tum"}, {"root": "kitchen"}]}),
    ({"root": "", "w": "a/b", "n": 3, 4: None}, {"root": "", "w": "a/b", "n": 3, "4": None}),
    ({"seats": ("x", 1.5), "place": "~"}, {"seats": ["x", 1.5], "place": "~"}),
    ({"root": "far/away/set", "hydra": 1, "output": 2}, {"root": "set"}),
    ({"a": {"output": 3, "hydra": 4, "root": ["r/one", "r/two"]}}, {"a": {"root": ["one", "two"]}}),
]  # fmt: skip


@pytest.mark.parametrize(("settings", "stored"), PORTABLE)
def test_settings_lose_what_belongs_to_one_machine(tmp_path, monkeypatch, settings, stored):
    base = tmp_path / "sets"
    text = json.dumps(settings)
    filled = text.replace("SETS", str(base)).replace("HERE", str(tmp_path))
    given = settings if text == filled else json.loads(filled)
    monkeypatch.delenv("DHTORCH_DATA", raising=False)
    assert result_files.make_portable(given, base) == result_files.make_portable(given, str(base)) == stored
    monkeypatch.setenv("DHTORCH_DATA", str(base))
    assert result_files.make_portable(given) == result(config=given)["config"] == stored
    if settings == {"w": "SETS/a/b"}:
        assert result_files.make_portable(given, tmp_path) == {"w": "sets/a/b"}, "a base that is given goes first"


# ------------------------------------------------------------------------------------------------------- metadata


def test_metadata_hold_what_is_given_and_what_is_installed(monkeypatch):
    given = {"device": "cuda:1", "threads": 3, "seed": 11, "operators": "torch"}
    meta = result_files.collect_run_metadata(**given, dtype=torch.float64)
    assert given.items() <= meta.items() and meta["dtype"] == "float64"
    assert {k: meta["versions"][k] for k in ("numpy", "python")} == {
        "numpy": np.__version__,
        "python": ".".join(map(str, sys.version_info[:3])),
    }
    assert {"dhtorch", "torch", "kornia", "opencv-python-headless", "hydra-core"} <= meta["versions"].keys()
    assert 0 <= (datetime.now(UTC) - datetime.fromisoformat(meta["utc"])).total_seconds() < 60
    absent = result_files.importlib.metadata.PackageNotFoundError("torch")
    monkeypatch.setattr(result_files.importlib.metadata, "version", lambda _: (_ for _ in ()).throw(absent))
    assert result_files.collect_run_metadata(**given, dtype="x")["versions"]["torch"] is None


def test_the_commit_is_that_of_the_code(tmp_path, monkeypatch):
    """A package in a folder of its own under version control, outside of it, and without git."""
    file = write(tmp_path / "package" / "__init__.py", "")
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    commits = []
    for words in (
        ["init", "-q"],
        ["add", "package"],
        ["commit", "-q", "-m", "x"],
        None,
        ["commit", "-qam", "y"],
        ["tag", "v7"],
    ):
        commits.append(result_files.read_git_revision(file.parent))
        if words is None:
            write(file, "x = 1\n")
        else:
            subprocess.run([*git, *words], check=True, capture_output=True)
    first = commits[3]
    assert commits[:2] == [None] * 2 and len(first) >= 7 and commits[4] == f"{first}-dirty"
    assert commits[5] != first and result_files.read_git_revision(file.parent) == "v7"
    monkeypatch.setenv("PATH", str(tmp_path))
    assert result_files.read_git_revision(file.parent) is None


HERE = {"key": "a", "config": {"n": 1}, "data": {"digest": "d"}, "git": "v1", "version": "0"}
NO_RUN = "about.json: found .*, expected a file written by dhtorch complete"


@pytest.mark.parametrize(
    ("content", "here", "message"),
    [
        *((text, {}, NO_RUN) for text in ("null", "[]", "7", '"x"', "{}", "", '{"key": 1}')),
        ('{"key": 1, "config": {"n": 1}, "data": 3}', {}, NO_RUN),
        (HERE, {}, None),
        (None, {}, "holds other files, expected an empty folder, or one that this command wrote"),
        (HERE, {"key": "b", "config": {"n": 2}}, r"files of another run \(n 1 there, 2 here\)"),
        (HERE, {"key": "b", "config": {"m": {"k": 2}}}, r"another run \(m.k None there, 2 here\)"),
        (HERE, {"key": "b", "data": {"digest": "e"}}, r"another run \(other data\)"),
        (HERE, {"key": "b"}, r"another run \(other code\)"),
        (HERE, {"key": "b", "git": "v2"}, r"another run \(other code: v1 there, v2 here\)"),
        (HERE | {"git": None}, {"key": "b", "git": None, "version": "2"}, r"other code: 0 there, 2 here\)"),
    ],
)
def test_a_folder_of_another_run_is_refused(tmp_path, content, here, message):
    file, other = tmp_path / "about.json", tmp_path / "about.txt"
    write(other if content is None else file, content if isinstance(content, str) else json.dumps(content))
    if message is None:
        result_files.check_same_run(tmp_path, file, HERE | here, "complete")
        result_files.check_same_run(tmp_path / "new", tmp_path / "new" / "about.json", HERE, "complete")
        return
    with pytest.raises(FileExistsError, match=message) as refused:
        result_files.check_same_run(tmp_path, file, HERE | here, "complete")
    assert "\n" not in str(refused.value)


ROOT = Path(dhtorch.__file__).parent
MODULES = sorted(ROOT.rglob("*.py"))


@cache
def settings(*overrides):
    OmegaConf.register_new_resolver("dhtorch.job_name", job_name, replace=True)
    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3", job_name="dhtorch"):
        return OmegaConf.to_container(hydra.compose("run", list(overrides)), resolve=True)


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """A copy of the package that may be edited."""
    folder = tmp_path_factory.mktemp("copy") / "dhtorch"
    return Path(shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns("__pycache__")))


@contextlib.contextmanager
def edited(path):
    """A file with a comment at its end, for as long as it is looked at."""
    before = path.read_bytes()
    path.write_bytes(before + b"\n# edited\n")
    yield
    path.write_bytes(before)


MAIN = ("data=synthetic",)
TABLE = "method.score.recalibration={_target_: dhtorch.metrics.calibration.load_probability, name: map}"


@pytest.mark.parametrize(
    ("overrides", "path", "counts"),
    [
        (MAIN, "stages/track.py", True),
        (MAIN, "stages/fuse.py", True),
        (MAIN, "geometry/se3.py", True),
        (MAIN, "pipeline/pair.py", True),  # imported when a method is called
        (MAIN, "synthetic/room.py", True),
        (MAIN, "experiments/protocol.py", True),
        (MAIN, "metrics/risk.py", True),
        (MAIN, "viz/viewer/exhibit.py", False),
        (MAIN, "viz/viewer/html.py", False),
        (MAIN, "experiments/negative/icp.py", False),
        (MAIN, "extract/dataset.py", False),
        (MAIN, "experiments/report/page.py", False),
        (MAIN, "cli/run.py", False),
        (MAIN, "metrics/calibration/map.json", False),
        ((*MAIN, "experiment=icp"), "experiments/negative/icp.py", True),
        ((*MAIN, "experiment=icp"), "experiments/paper/heldout.py", False),
        ((*MAIN, "method=opencv"), "experiments/baselines/opencv.py", True),
        (MAIN, "experiments/baselines/opencv.py", False),
        ((*MAIN, TABLE), "metrics/calibration/map.json", True),  # which travels with its module
        ((*MAIN, "root:dhtorch.extract.dataset"), "extract/dataset.py", True),
    ],
)
def test_a_result_is_another_one_when_what_it_reaches_is_edited(package, overrides, path, counts):
    config = settings(*(each for each in overrides if not each.startswith("root:")))
    roots = [each.removeprefix("root:") for each in overrides if each.startswith("root:")]
    key = lambda: result_files.compute_result_key(config, "d", code_dir=package, roots=roots)  # noqa: E731
    before = key()
    with edited(package / path):
        assert (key() != before) == counts
    assert key() == before


def test_a_comment_or_docstring_is_no_other_code(package):
    path = package / "metrics" / "risk.py"
    before = code_dependencies.digest_source(path)
    source = path.read_text()
    path.write_text(source.replace('"""', '"""Edited. ', 1) + "\n# edited\n")
    assert code_dependencies.digest_source(path) == before
    path.write_text(source + "\nEDITED = 1\n")
    assert code_dependencies.digest_source(path) != before
    path.write_text(source)


def test_names_are_those_of_modules_functions_and_packages():
    reach = lambda *names: set(code_dependencies.find_reachable_modules(names))  # noqa: E731
    assert reach("dhtorch.codes.Gate") == reach("dhtorch.codes") == {"__init__.py", "codes.py"}
    assert {"geometry/__init__.py", "geometry/se3.py", "pytree.py"} <= reach("dhtorch.geometry.se3.exp")
    assert reach("dhtorch.nothing", "dhtorch.nowhere.at.all") == {"__init__.py"} and reach("nobody.knows") == set()
    assert reach() == set() and list(code_dependencies.find_reachable_modules(["dhtorch.records"])) == sorted(
        code_dependencies.find_reachable_modules(["dhtorch.records"])
    )


def test_somebody_elses_function_counts_and_what_it_takes_from_here(tmp_path, monkeypatch):
    (tmp_path / "their_tracker.py").write_text("from dhtorch.stages import track\n\ndef follow(): ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    found = code_dependencies.find_reachable_modules(["their_tracker.follow"])
    assert found["elsewhere:their_tracker"] == tmp_path / "their_tracker.py"
    assert {"stages/track.py", "geometry/lucas_kanade.py"} <= set(found) and "pipeline/multiview.py" not in found
    config = {"track": {"_target_": "their_tracker.follow"}}
    before = result_files.compute_result_key(config, "d")
    with edited(tmp_path / "their_tracker.py"):
        assert result_files.compute_result_key(config, "d") != before
    sys.modules.pop("their_tracker", None)


def written(path):
    """Names that a file imports of the package, read with the grammar."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "dhtorch")
        elif isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "dhtorch":
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_no_import_of_the_package_is_missed():
    for path in MODULES:
        found, expected = set(code_dependencies.iter_imports(path.read_text(encoding="utf-8"))), set(written(path))
        assert expected <= found, path
        assert not found - expected or '"""' in path.read_text(encoding="utf-8"), "an example in a docstring"
    told = "from dhtorch.a import (\n    b,  # a note\n    c as d,\n)\n\ndef f():\n    import dhtorch.e\n    from dhtorch import g\n"
    assert list(code_dependencies.iter_imports(told)) == [
        "dhtorch.a",
        "dhtorch.a.b",
        "dhtorch.a.c",
        "dhtorch.e",
        "dhtorch",
        "dhtorch.g",
    ]


def test_nothing_is_imported_by_a_name_that_is_made_at_run_time():
    """Such an import would be out of reach: but of the package's own doors, and of modules that settings name."""
    allowed = {"__init__.py", "viz/viewer/again.py", "data/io/decode.py", "cli/run.py", "cli/option_checks.py"}
    users = {p.relative_to(ROOT).as_posix() for p in MODULES if "import_module(" in p.read_text(encoding="utf-8")}
    assert users <= allowed


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


def write_for_ever(path, ready):
    one = result_files.read_result(path)
    one["rows"] = one["rows"] * 200
    while True:
        result_files.write_result(path, one)
        ready.set()
