"""Output folders: what dhtorch wrote is replaced and removed, nothing else; one writer at a time; kill -9 loses nothing."""

import json
import multiprocessing
import os
import re
import signal
import socket
import stat
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import pytest
from support.byte_damage import STRANGE_FILES
from support.damage_harness import bytes_read

from dhtorch.data import FormatError
from dhtorch.runtime import output_folder, storage
from dhtorch.runtime.output_folder import PRIVATE_FOLDER, acquire_file_lock, open_output_file, open_output_folder

CONTENT = bytes(range(256)) * 4
FORK = multiprocessing.get_context("fork")
pytestmark = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")


def contents(folder: Path) -> dict[str, bytes]:
    files = [p for p in folder.rglob("*") if p.is_file() and not output_folder.is_private(p.relative_to(folder))]
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


def write(folder: Path, **files: bytes) -> None:
    with open_output_folder(folder, "out"):
        for name, content in files.items():
            storage.replace_file(folder / name.replace("__", "/"), content)


def refused(folder: Path, message: str, kind: type[Exception] | tuple = FileExistsError, option: str = "out") -> None:
    with pytest.raises(kind, match=message), open_output_folder(folder, option):
        pass


def private(folder: Path) -> list[str]:
    """What is left in the private folder."""
    return [p.name for p in (folder / PRIVATE_FOLDER).iterdir()]


def test_written_files_are_replaced_by_the_next_run_and_removed(tmp_path):
    out = tmp_path / "deep" / "out"
    write(out, a=CONTENT, depth__b=CONTENT)
    write(out, a=b"new")
    assert contents(out) == {"a": b"new", "depth/b": CONTENT} and private(out) == ["manifest"]
    assert stat.S_IMODE((out / "a").stat().st_mode) == 0o644
    (out / "a").write_bytes(CONTENT)  # an older content of ours is ours, and in a copied folder, too
    out.rename(tmp_path / "moved")
    out = tmp_path / "moved"
    with open_output_folder(out, "out") as folder:
        assert not folder.is_unlisted and folder.owns(out / "a") and folder.lists(out / "depth" / "b")
        assert folder.remove(out / "a") and not folder.remove(out / "a") and not folder.remove(out / "depth" / "c")
    assert contents(out) == {"depth/b": CONTENT}


@pytest.mark.parametrize(
    ("content", "is_own", "is_whole"),
    [
        (CONTENT + b"x", False, True),
        (b"x" + CONTENT[1:], False, True),
        (CONTENT[:-1] + b"x", False, True),
        (b"x" * 100, False, True),
        (b"short", False, True),
        (CONTENT[:63], False, True),
        (CONTENT[:64], True, False),
        (CONTENT[:-1], True, False),
        (b"", True, False),
        (CONTENT, True, True),
        (None, False, False),
    ],
)
def test_a_changed_file_is_of_its_author_and_a_shortened_one_is_torn_and_missing(tmp_path, content, is_own, is_whole):
    out, file = tmp_path / "out", tmp_path / "out" / "a"
    write(out, a=CONTENT)
    file.unlink() if content is None else file.write_bytes(content)
    assert output_folder.is_whole(file) == bool(content), "without the manifest only an empty one is known"
    with open_output_folder(out, "out") as folder:
        assert folder.owns(file) == is_own and output_folder.is_whole(file) == is_whole
        assert not output_folder.is_whole(out / "b") and not output_folder.is_whole(out)
        changed = pytest.raises(FileExistsError, match="changed since dhtorch wrote it")
        with nullcontext() if is_own or content is None else changed:
            folder.check([file])
            storage.replace_file(file, CONTENT)
            file.write_bytes(content or b"")
        assert folder.remove(file) == (is_own or content is None)


def test_a_file_longer_than_any_that_dhtorch_wrote_is_not_read(tmp_path):
    write(tmp_path, a=CONTENT)
    (tmp_path / "a").unlink()
    STRANGE_FILES["3 GiB"](tmp_path / "a")
    begin = bytes_read()
    with open_output_folder(tmp_path, "out") as folder:
        assert not folder.owns(tmp_path / "a") and not folder.remove(tmp_path / "a")
    assert bytes_read() - begin < 1 << 20


@pytest.mark.parametrize("target", ["elsewhere", "nowhere"])
def test_files_of_others_and_links_are_neither_followed_replaced_nor_removed(tmp_path, target):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    write(out, a=CONTENT, depth__a=CONTENT, b=CONTENT)
    elsewhere.mkdir()
    for name in ("elsewhere/a", "out/mine"):
        (tmp_path / name).write_bytes(CONTENT)
    for path in (out / "depth" / "a", out / "depth", out / "a"):
        path.rmdir() if path.is_dir() else path.unlink()
    (out / "folder").mkdir()
    (out / "depth").symlink_to(tmp_path / target)
    (out / "a").symlink_to(tmp_path / target / "a")
    with open_output_folder(out, "out") as folder:
        for name, message in {
            "mine": "out: found .*/mine, a file that dhtorch did not write, expected none: remove or rename it",
            "folder": "/folder, a folder or device",
            "mine/x": "mine, a file, where a folder is needed",
            "depth/a": "out: found .*/out/depth, a link, expected",
            "a": "/out/a, a link",
        }.items():
            with pytest.raises(FileExistsError, match=message):
                storage.replace_file(out / name, b"")
            with pytest.raises(FileExistsError, match=message):
                folder.check([out / "b", out / name])
            assert (name == "depth/a" or not folder.owns(out / name)) and not folder.remove(out / name)
        for name in ("depth", "mine"):
            with pytest.raises(FileExistsError, match=f"/out/{name}, a"):
                folder.check_folders([out / "new", out / name])
        assert not list((out / PRIVATE_FOLDER).rglob("*.tmp"))
    assert contents(elsewhere) == {"a": CONTENT} and (out / "depth").is_symlink() and (out / "a").is_symlink()
    assert (out / "mine").read_bytes() == (out / "b").read_bytes() == CONTENT


def test_the_folder_may_be_a_link_and_paths_may_be_spelt_otherwise(tmp_path, monkeypatch):
    (tmp_path / "real").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "real")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    monkeypatch.chdir(tmp_path)
    with open_output_folder("out", "out") as folder:
        for path in (Path("out/a"), tmp_path / "real/b", Path("out/../real/c"), Path("out/../..", tmp_path.name, "d")):
            storage.replace_file(path, b"1")  # the last one is outside
        assert all(folder.owns(tmp_path / "real" / name) for name in "abc")
        with open_output_folder(tmp_path / "real", "out") as same:
            assert same is folder
    assert contents(tmp_path / "real") == dict.fromkeys("abc", b"1") and (tmp_path / "d").is_file()
    refused(Path("dangling"), "out: dangling is a link to nothing, expected a folder or a new path", NotADirectoryError)
    refused(Path("d"), "out: d is a file, expected a folder or a new path", NotADirectoryError)


@pytest.mark.timeout(10)  # opening a pipe waits for the other end
@pytest.mark.parametrize("name", ["", "lock", "manifest", "unfinished"])
@pytest.mark.parametrize("kind", [*STRANGE_FILES, "link"])
def test_what_is_in_the_place_of_dhtorchs_own_records_is_refused(tmp_path, name, kind):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    own = out / PRIVATE_FOLDER / name
    for folder in (own.parent, elsewhere):
        folder.mkdir(parents=True)
    (elsewhere / "1.txt").write_text("mine")
    own.symlink_to(elsewhere) if kind == "link" else STRANGE_FILES[kind](own)
    begin = bytes_read()
    if (name, kind) in (("unfinished", "folder"), ("lock", "3 GiB"), ("", "folder")):  # as they should be, or not read
        write(out)
        assert not own.exists()
        return
    large = (name, kind) == ("manifest", "3 GiB")
    message = "file size: found 3221225472 bytes" if large else f"out: found {out / PRIVATE_FOLDER}.*, a "
    refused(out, message, (FileExistsError, FormatError))
    assert bytes_read() - begin < 1 << 20 and contents(elsewhere) == {"1.txt": b"mine"}


def test_a_folder_without_results_leaves_nothing(tmp_path):
    there, user = tmp_path / "there", tmp_path / "out" / "user.dhtorch"
    there.mkdir()
    for path in (tmp_path / "a" / "b", there):
        with open_output_folder(path, "out"):
            assert (path / PRIVATE_FOLDER / "lock").is_file()
    assert not (tmp_path / "a" / "b").exists() and not list(there.iterdir())
    write(tmp_path / "out", a=b"1")
    (tmp_path / "out" / "a").unlink()
    assert not storage.has_files(tmp_path / "out"), "private files are no results"
    user.mkdir()
    (user / "a").write_text("mine")
    assert storage.has_files(tmp_path / "out")


def test_inner_folders_have_their_own_manifest_and_older_files_are_adopted(tmp_path):
    (tmp_path / "a").write_bytes(CONTENT)
    (tmp_path / "link").symlink_to(tmp_path / "a")
    (tmp_path / ".dhtorchs").write_bytes(b"")
    with open_output_folder(tmp_path, "out") as outer, open_output_folder(tmp_path / "scene", "out") as inner:
        for name in ("scene/a", "b", f"scene/{PRIVATE_FOLDER}/x"):
            storage.replace_file(tmp_path / name, b"1")
        assert inner.lists(tmp_path / "scene" / "a") and not outer.lists(tmp_path / "scene" / "a")
        assert outer.lists(tmp_path / "b") and not outer.lists(tmp_path / "scene" / PRIVATE_FOLDER / "x")
        assert outer.is_unlisted
        outer.adopt(tmp_path.glob("*"))
        outer.adopt((tmp_path / PRIVATE_FOLDER).glob("*"))
        outer.record(tmp_path / "any", None)
        assert outer.owns(tmp_path / "a") and not outer.owns(tmp_path / "link")
        assert not outer.lists(tmp_path / PRIVATE_FOLDER / "lock") and outer.lists(tmp_path / ".dhtorchs")
    (tmp_path / "any").write_bytes(b"any")
    with open_output_folder(tmp_path, "out") as folder:
        assert not folder.is_unlisted and folder.owns(tmp_path / "any")


def test_a_torn_or_malicious_manifest_owns_nothing_more(tmp_path):
    write(tmp_path / "out", a=CONTENT)
    manifest = tmp_path / "out" / PRIVATE_FOLDER / "manifest"
    lines = ["[1, 2]", "[[[", '["x", 0, 0, "b"]', "7", "[" * 100_000, '[0, 0, 0, "../b"]', '[3, 1, 1, "b']
    manifest.write_text(manifest.read_text() + "\n".join(lines))
    for name in ("b", "out/b"):
        (tmp_path / name).write_bytes(b"mine")
    write(tmp_path / "out", c=b"1")
    write(tmp_path / "out", c=b"2", a=b"2")
    assert contents(tmp_path) == {"b": b"mine", "out/b": b"mine", "out/a": b"2", "out/c": b"2"}


def test_a_file_as_output_has_records_of_its_own(tmp_path):
    page = tmp_path / "page.html"
    (tmp_path / "notes.txt").write_text("mine")
    for content in (b"1", b"2"):
        with open_output_file(page, "html"):
            storage.replace_file(page, content)
            storage.replace_file(tmp_path / "other", content)  # not of the command
    names = {"page.html", f".page.html{PRIVATE_FOLDER}", "notes.txt", "other"}
    assert page.read_bytes() == b"2" and {p.name for p in tmp_path.iterdir()} == names
    notes = tmp_path / "notes.txt"
    with pytest.raises(FileExistsError, match=r"html: found .*notes\.txt"), open_output_file(notes, "html"):
        pass
    write(tmp_path / "out", **{"view.html": b"1"})
    with open_output_file(tmp_path / "out" / "view.html", "html"):
        storage.replace_file(tmp_path / "out" / "view.html", b"2")
    assert [p.name for p in (tmp_path / "out").iterdir() if p.name != PRIVATE_FOLDER] == ["view.html"]


def test_unfinished_private_files_of_a_dead_process_are_removed_by_the_next(tmp_path):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    write(out, a=CONTENT)
    elsewhere.mkdir()
    (out / PRIVATE_FOLDER / "shards").mkdir()
    for folder in (out / PRIVATE_FOLDER / "shards", elsewhere, out):
        (folder / ".shard.parquet.0123.tmp").write_bytes(b"half")
        (folder / "shard.parquet").write_bytes(b"whole")
    (out / PRIVATE_FOLDER / "link").symlink_to(elsewhere)
    with open_output_folder(out, "out"):
        assert not [*(out / PRIVATE_FOLDER).glob("shards/*.tmp")], "before the run writes"
    left = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*.tmp")}
    assert left == {"elsewhere/.shard.parquet.0123.tmp", "out/.shard.parquet.0123.tmp"}, "of others"
    assert (out / PRIVATE_FOLDER / "shards" / "shard.parquet").is_file()


@pytest.mark.parametrize("name", ["x" * 256, "é" * 128, f"folder/{'x' * 256}", f"{'x' * 256}/file"])
def test_a_name_that_is_too_long_is_refused_before_anything_is_written(tmp_path, name):
    with open_output_folder(tmp_path / "out", "out") as folder:
        with pytest.raises(OSError, match=r"File name too long \(256 bytes, at most 255") as error:
            folder.check([tmp_path / "out" / "a", tmp_path / "out" / name])
        assert error.value.filename == f"out: {tmp_path / 'out' / name}"
        storage.replace_file(tmp_path / "out" / ("x" * 250 + ".json"), CONTENT)
    storage.replace_file(tmp_path / ("x" * 250 + ".json"), CONTENT)  # outside of all
    page = tmp_path / ("x" * 245 + ".html")  # its private folder has a longer name
    with pytest.raises(OSError, match="File name too long"), open_output_file(page, "html"):
        pass
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "x" * 250 + ".json"]


# -------------------------------------------------------------------------------------------------------- two writers


def _race(folder, number):
    """Message of a refused writer, empty for one that has written."""
    try:
        write(folder, a=b"%d" % number, depth__b=b"%d" % number)
        return ""
    except BlockingIOError as error:
        return str(error)


def test_of_fifty_that_race_each_is_refused_in_a_line_or_right(tmp_path):
    out = tmp_path / "out"
    with ProcessPoolExecutor(50, mp_context=FORK) as pool:
        ends = list(pool.map(partial(_race, out), range(50)))
    winners = [b"%d" % number for number, refusal in enumerate(ends) if not refusal]
    assert all("another dhtorch process" in line and "\n" not in line for line in ends if line)
    files = contents(out)
    assert set(files) == {"a", "depth/b"} and files["a"] == files["depth/b"] and files["a"] in winners
    assert private(out) == ["manifest"]
    with open_output_folder(out, "out") as folder:
        assert folder.owns(out / "a") and folder.owns(out / "depth" / "b")


def _hold(folder, ready):
    with open_output_folder(folder, "out"):
        ready.set()
        signal.pause()


def test_a_second_process_is_refused_with_the_owner_and_a_dead_one_blocks_nobody(tmp_path, monkeypatch):
    out, ready = tmp_path / "out", FORK.Event()
    other = FORK.Process(target=_hold, args=(out, ready))
    other.start()
    try:
        assert ready.wait(30)
        now = time.time()
        monkeypatch.setattr(time, "time", lambda: now + 7)
        owner = rf"another dhtorch process \({other.pid} on {re.escape(socket.gethostname())}, for [78] s\)"
        refused(out, f"^out: {out}: found {owner} writing there, expected one writer at a time", BlockingIOError)
        (tmp_path / "link").symlink_to(out)
        refused(tmp_path / "link", "another dhtorch process", BlockingIOError)
        for record in (b"", b"{", b'{"process": 1}', b"[" * 900, b'{"process": "\xff", "host": 1, "since": 1e999}'):
            (out / PRIVATE_FOLDER / "lock").write_bytes(record)
            refused(out, "found another dhtorch process writing there", BlockingIOError)
    finally:
        other.kill()
        other.join()
    file = out / PRIVATE_FOLDER / "lock"
    assert file.exists()
    with acquire_file_lock(file, "out: x"):
        assert json.loads(file.read_text())["process"] == os.getpid()
        with pytest.raises(BlockingIOError, match="out: x: found this process"), acquire_file_lock(file, "out: x"):
            pass
    write(out, a=b"1")
    assert contents(out) == {"a": b"1"} and not file.exists()


#: Calls of the system before which a writer is killed.
MOMENTS = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.chmod"}


def _killed_at(folder: Path, moment: int) -> bool:
    """Write three files in a child that is killed before its ``moment``-th call of the system -> whether it was."""
    pid = os.fork()
    if pid == 0:
        import sys  # noqa: PLC0415

        calls = iter(range(10_000))

        def hook(event: str, args: tuple[object, ...]) -> None:
            if event in MOMENTS and args and str(args[0]).startswith(str(folder)) and next(calls) == moment:
                os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(hook)
        write(folder, **{"a": CONTENT, "depth__b": CONTENT, "c": CONTENT})
        os._exit(0)
    return os.WIFSIGNALED(os.waitpid(pid, 0)[1])


@pytest.mark.slow
@pytest.mark.parametrize("is_written_before", [False, True])
def test_kill_9_at_any_moment_leaves_only_files_that_the_next_run_replaces(tmp_path, is_written_before):
    was_killed, moment = True, -1
    while was_killed:
        moment += 1
        out = tmp_path / str(moment)
        if is_written_before:
            write(out, a=b"old", depth__b=b"old")
        was_killed = _killed_at(out, moment)
        assert all(content in (CONTENT, b"old") for content in contents(out).values())
        write(out, a=b"new", depth__b=b"new", c=b"new")
        assert contents(out) == {"a": b"new", "depth/b": b"new", "c": b"new"} and private(out) == ["manifest"]
        for line in (out / PRIVATE_FOLDER / "manifest").read_text().splitlines():
            assert len(json.loads(line)) == 4
    assert moment > 15
