"""dhtorch fetch against a local server: digests, resumption, limits, archives that try to lead out; licences first."""

import hashlib
import http.server
import io
import json
import os
import tarfile
import threading
import zipfile
from dataclasses import asdict
from pathlib import Path

import pytest

from dhtorch.cli import fetch
from dhtorch.cli.fetch import FetchedScene, download, fetch_scenes
from dhtorch.cli.run import main

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
    return FetchedScene("kitchen", "CC BY 4.0", "https://example.org", FILES, **{**options, **changes})


def archive_of(*members, kind="w:gz"):
    """A tar archive of (name, content), a link where the content is a text."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode=kind) as tar:
        for name, content in members:
            info = tarfile.TarInfo(name)
            if isinstance(content, str):
                info.type, info.linkname = tarfile.SYMTYPE, content
                tar.addfile(info)
                continue
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    return out.getvalue()


def archived(server, content, *, known=True, files=None, **changes):
    server.files["/a.tgz"] = content
    options = {
        "archive": f"{server.address}/a.tgz",
        "archive_sha256": sha(content) if known else None,
        "inside": "set/",
    }
    files = {"rgb.png": sha(PICTURE)} if files is None else files
    return FetchedScene("room", "MIT", "https://example.org", files, **{**options, **changes})


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


def test_an_interrupted_download_goes_on_where_it_stopped(server, tmp_path):
    server.cut = 60_000
    with pytest.raises(OSError, match=r"found 60000 bytes, expected 102400; run again to go on"):
        fetch_scenes([scene(server)], tmp_path)
    assert names(tmp_path) == [], "no unfinished file has a name"
    server.cut = None
    assert fetch_scenes([scene(server)], tmp_path) == 3
    assert [r for path, r in server.asked if "png" in path] == [None, "bytes=60000-"]
    assert (tmp_path / "kitchen/rgb/0 1.png").read_bytes() == PICTURE


def test_a_server_without_ranges_and_a_stale_part_begin_anew(server, tmp_path):
    server.files["/a"] = PICTURE
    part = tmp_path / hashlib.sha256(f"{server.address}/a".encode()).hexdigest()
    server.ranges = False
    part.with_suffix(".part").write_bytes(b"old")
    assert download(f"{server.address}/a", tmp_path, sha(PICTURE)).read_bytes() == PICTURE
    server.ranges = True
    part.with_suffix(".part").write_bytes(PICTURE + b"more")
    assert download(f"{server.address}/a", tmp_path, sha(PICTURE)).read_bytes() == PICTURE


def test_a_wrong_digest_a_size_above_the_limit_and_no_answer_are_one_line(server, tmp_path):
    made = scene(server)
    server.files["/kitchen/rgb/0%201.png"] = PICTURE[:-1] + b"!"
    with pytest.raises(ValueError, match=r"0%201.png: found SHA-256 \w+…, expected \w+…$"):
        fetch_scenes([made], tmp_path)
    assert names(tmp_path) == [] and not list(tmp_path.rglob("*.part")), "a wrong file is not gone on with"
    server.files["/kitchen/rgb/0%201.png"] = PICTURE
    with pytest.raises(ValueError, match="found more than 1000 bytes, expected at most that"):
        fetch_scenes([made], tmp_path, max_bytes=1000)
    server.files.clear()
    with pytest.raises(OSError, match=r"kitchen/rgb/0%201.png: Not Found"):
        fetch_scenes([FetchedScene(**asdict(made))], tmp_path)
    assert names(tmp_path) == []


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
    for bad in ({"folder": "../x"}, {"files": {"a/../../x": "0"}}, {"texts": {"/x": ""}}, {"base": "file:///etc/"}):
        file = tmp_path / "t.json"
        file.write_text(json.dumps({"scenes": [asdict(scene(server)) | bad]}))
        with pytest.raises(ValueError, match=r"t.json: .*expected (one inside the folder|an http or https address)"):
            fetch.read_fetch_table(file)
    (tmp_path / "t.json").write_text("[]")
    with pytest.raises(ValueError, match="found no table of scenes"):
        fetch.read_fetch_table(tmp_path / "t.json")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "kitchen").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FileExistsError, match="a link"):
        fetch_scenes([scene(server)], tmp_path / "out")
    (tmp_path / "own" / "kitchen").mkdir(parents=True)
    (tmp_path / "own" / "kitchen" / "poses.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="did not write"):
        fetch_scenes([scene(server)], tmp_path / "own")
    assert not list((tmp_path / "elsewhere").iterdir()) and (tmp_path / "own/kitchen/poses.txt").read_text() == "mine"


def test_licences_come_first_and_nothing_is_fetched_without_consent(server, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DHTORCH_DATA", raising=False)
    (tmp_path / "t.json").write_text(json.dumps({"scenes": [asdict(scene(server))]}))
    assert main(["fetch", "shared_scenes", "--table", "t.json"]) == 2
    out, err = capsys.readouterr()
    assert out == "kitchen: CC BY 4.0; https://example.org\n" and "licences not accepted" in err and not server.asked
    assert main(["fetch", "shared_scenes", "--table", "t.json", "--yes"]) == 0
    out, _ = capsys.readouterr()
    assert out.index("CC BY") < out.index("3 files fetched into dhtorch_data")
    monkeypatch.setenv("DHTORCH_DATA", str(tmp_path / "data"))
    assert main(["fetch", "shared_scenes", "--table", "t.json", "--yes"]) == 0
    assert len(names(tmp_path / "data")) == 3
    server.files.clear()
    assert main(["fetch", "shared_scenes", "--table", "t.json", "--yes", "--out", "new"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("dhtorch: http://127.0.0.1") and "Not Found" in line


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
