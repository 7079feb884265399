"""dhtorch fetch against a local server: digests, resumption, limits, archives that try to lead out; licences first."""

import hashlib
import http.server
import io
import json
import os
import re
import tarfile
import threading
import zipfile
from dataclasses import asdict
from pathlib import Path

import pytest

from dhtorch.cli import fetch
from dhtorch.cli.fetch import _FetchedScene, fetch_scenes

ROOT = os.environ.get("DHTORCH_DATA")


def sha(content):
    return hashlib.sha256(content).hexdigest()


@pytest.fixture
def server():
    """A server of ``files`` (path → bytes) with ranges; ``cut``: bytes after which an answer ends early."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            content, asked = self.server.files.get(self.path), self.headers.get("Range")
            self.server.asked.append((self.path, asked))
            start = int(asked[6:-1]) if asked and self.server.ranges else 0
            if content is None or (asked and start >= len(content)):
                self.send_error(404 if content is None else 416)
                return
            self.send_response(206 if asked and self.server.ranges else 200)
            self.send_header("Content-Length", str(len(content) - start))
            self.end_headers()
            self.wfile.write(content[start:][: self.server.cut])

        def log_message(self, *_):
            pass

    made = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    made.files, made.asked, made.cut, made.ranges = {}, [], None, True
    made.address = f"http://127.0.0.1:{made.server_port}"
    thread = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield made
    made.shutdown()
    thread.join()
    made.server_close()


PICTURE, POSES = bytes(range(256)) * 400, b"0\n1\n2\n3\n4\n"
TRACK = b"# t x\n\nno time\n1.0 a\n2.0 b\n3.0 c\n"
FILES = {"rgb/0 1.png": sha(PICTURE), "poses.txt": sha(b"2\n3\n")}


def scene(server, **changes):
    server.files |= {"/kitchen/rgb/0%201.png": PICTURE, "/kitchen/poses.txt": POSES}
    options = {
        "base": f"{server.address}/kitchen/",
        "cut": {"poses.txt": {"rows": [2, 3]}},
        "texts": {"meta.json": "{}"},
    }
    return _FetchedScene("kitchen", "CC BY 4.0", "https://example.org", FILES, **{**options, **changes})


def archive_of(*members, kind="w:gz"):
    """A tar archive of (name, content), a link where the content is a text."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode=kind) as tar:
        for name, content in members:
            info, is_link = tarfile.TarInfo(name), isinstance(content, str)
            info.type, info.linkname = (tarfile.SYMTYPE, content) if is_link else (tarfile.REGTYPE, "")
            info.size = 0 if is_link else len(content)
            tar.addfile(info, None if is_link else io.BytesIO(content))
    return out.getvalue()


def archived(server, content, *, known=True, files=None, **changes):
    server.files["/a.tgz"] = content
    options = {
        "archive": f"{server.address}/a.tgz",
        "archive_sha256": sha(content) if known else None,
        "inside": "set/",
    }
    files = {"rgb.png": sha(PICTURE)} if files is None else files
    return _FetchedScene("room", "MIT", "https://example.org", files, **{**options, **changes})


def names(folder):
    found = (p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    return sorted(name for name in found if ".dhtorch" not in name)


def test_files_come_one_by_one_and_what_is_there_is_not_asked_for_again(server, tmp_path):
    assert fetch_scenes([scene(server)], tmp_path) == 3
    assert names(tmp_path) == ["kitchen/meta.json", "kitchen/poses.txt", "kitchen/rgb/0 1.png"]
    assert (tmp_path / "kitchen/rgb/0 1.png").read_bytes() == PICTURE
    assert (tmp_path / "kitchen/poses.txt").read_bytes() == b"2\n3\n", "cut to the rows"
    asked = len(server.asked)
    assert fetch_scenes([scene(server)], tmp_path) == 0 and len(server.asked) == asked
    assert not (tmp_path / ".dhtorch" / "fetch").exists()


@pytest.mark.parametrize("kind", ["tar", "zip", "unknown digest"])
def test_an_archive_gives_the_files_of_the_table_alone(server, tmp_path, kind):
    members = [("set/rgb.png", PICTURE), ("set/track.txt", TRACK), ("set/other", b"x"), ("../../evil", b"x")]
    content = archive_of(*members)
    if kind == "zip":
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w") as made:
            for name, data in members:
                made.writestr(name, data)
        content = out.getvalue()
    files = {"rgb.png": sha(PICTURE), "track.txt": sha(b"# t x\n2.0 b\n3.0 c\n")}
    cut = {"track.txt": {"times": [1.5, 3.0]}}
    made = archived(server, content, known=kind != "unknown digest", files=files, cut=cut)
    assert fetch_scenes([made], tmp_path / "out") == 2
    assert names(tmp_path) == ["out/room/rgb.png", "out/room/track.txt"], "nothing else, inside or outside"


KEY = "/kitchen/rgb/0%201.png"


@pytest.mark.parametrize(
    ("changes", "left", "limit", "words", "asked"),
    [
        ({"cut": 60_000}, None, 10**9, "found 60000 bytes, expected 102400; run again to go on", [None, "bytes=60000-"]),
        ({"ranges": False}, b"old", 10**9, None, ["bytes=3-"]),
        ({}, PICTURE + b"more", 10**9, None, ["bytes=102404-", None]),
        ({}, PICTURE[:1000], 10**9, None, ["bytes=1000-"]),
        ({"files": {KEY: PICTURE[:-1] + b"!"}}, None, 10**9, r"0%201.png: found SHA-256 \w+…, expected \w+…$", [None, None]),
        ({}, None, 1000, "found more than 1000 bytes, expected at most that", [None, None]),
        ({"files": {}}, None, 10**9, r"kitchen/rgb/0%201.png: Not Found", [None, None]),
    ],
)  # fmt: skip
def test_a_download_goes_on_where_it_stopped_and_what_is_wrong_is_one_line(
    server, tmp_path, changes, left, limit, words, asked
):
    """Changes of the server, bytes of an earlier try, limit of size → message, and the ranges that are asked for."""
    made, parts = scene(server), tmp_path / ".dhtorch" / "fetch"
    before = dict(vars(server))
    vars(server).update(changes)
    if left is not None:
        parts.mkdir(parents=True)
        (parts / f"{sha(f'{server.address}{KEY}'.encode())}.part").write_bytes(left)
    if words is not None:
        with pytest.raises((ValueError, OSError), match=words):
            fetch_scenes([made], tmp_path, max_bytes=limit)
        is_kept = len(list(tmp_path.rglob("*.part"))) == (1 if "cut" in changes else 0)
        assert names(tmp_path) == [] and is_kept, "no unfinished file has a name, and a wrong one is not gone on with"
        vars(server).update({name: before[name] for name in changes})
    assert fetch_scenes([made], tmp_path) == 3
    assert (tmp_path / "kitchen/rgb/0 1.png").read_bytes() == PICTURE
    assert [r for path, r in server.asked if "png" in path] == asked


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (archive_of(("set/rgb.png", "../../secret")), "found a link or folder as set/rgb.png"),
        (archive_of(("set/other.png", PICTURE)), "found no set/rgb.png in the archive"),
        (archive_of(("set/rgb.png", PICTURE + b"x")), "found SHA-256"),
        (archive_of(("set/rgb.png", PICTURE), kind="w")[:9000], "damaged archive|no tar or zip archive"),
        (b"<html>moved</html>", "found no tar or zip archive"),
    ],
    ids=["link", "missing", "changed", "truncated", "no archive"],
)
def test_an_archive_that_is_not_as_the_table_says_writes_nothing(server, tmp_path, content, words):
    with pytest.raises(ValueError, match=words):
        fetch_scenes([archived(server, content, known=False)], tmp_path / "out")
    assert names(tmp_path) == []


def test_names_and_links_that_lead_out_are_refused(server, tmp_path):
    file, known = tmp_path / "t.json", asdict(scene(server))
    for bad in (
        {"folder": "../x"},
        {"files": {"a/../../x": "0"}},
        {"texts": {"/x": ""}},
        {"base": "file:///etc/"},
        None,
    ):
        file.write_text("[]" if bad is None else json.dumps({"scenes": [known | bad]}))
        with pytest.raises(ValueError, match=r"t.json: .*expected one (inside|as)|t.json: .* an http or https address"):
            fetch.read_fetch_table(file)
    for folder in ("elsewhere", "out", "own/kitchen"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "out" / "kitchen").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "own" / "kitchen" / "poses.txt").write_text("mine")
    for folder, message in (("out", "a link"), ("own", "did not write")):
        with pytest.raises(FileExistsError, match=message):
            fetch_scenes([scene(server)], tmp_path / folder)
    assert not list((tmp_path / "elsewhere").iterdir()) and (tmp_path / "own/kitchen/poses.txt").read_text() == "mine"


def test_licences_come_first_and_nothing_is_fetched_without_consent(command, server, tmp_path, monkeypatch):
    (tmp_path / "t.json").write_text(json.dumps({"scenes": [asdict(scene(server))]}))
    words = ["fetch", "shared_scenes", "--table", "t.json"]
    code, out, err = command(*words)
    assert (code, out) == (2, "kitchen: CC BY 4.0; https://example.org\n") and not server.asked
    assert "licences not accepted" in err
    assert re.match(r"(?s)kitchen: CC BY.*3 files fetched into dhtorch_data", command(*words, "--yes")[1])
    monkeypatch.setenv("DHTORCH_DATA", str(tmp_path / "data"))
    assert command(*words, "--yes")[0] == 0 and len(names(tmp_path / "data")) == 3
    server.files.clear()
    code, _, err = command(*words, "--yes", "--out", "new")
    assert code == 2 and re.fullmatch(r"dhtorch: http://127.0.0.1\S+: Not Found.*\n", err)


def test_the_table_names_every_shared_scene_with_its_licence():
    scenes = {each.folder: each for each in fetch.read_fetch_table(fetch.FETCHED_SETS["shared_scenes"])}
    assert len(scenes) == 10 and all(each.licence and each.source.startswith("https://") for each in scenes.values())
    for each in scenes.values():
        assert all(len(digest) == 64 for digest in each.files.values()) and (each.base or each.archive)
        assert "meta.json" in each.texts and set(each.cut) <= set(each.files)


@pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")
def test_the_digests_are_those_of_the_shared_scenes():
    for each in fetch.read_fetch_table(fetch.FETCHED_SETS["shared_scenes"]):
        folder = Path(ROOT, each.folder)
        there = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
        assert there == {*each.files, *each.texts}, each.folder
        for name, digest in list(each.files.items())[:3]:
            assert sha((folder / name).read_bytes()) == digest
