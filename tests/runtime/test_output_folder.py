"""Output folders: what dhtorch wrote is replaced and removed, nothing else; one writer at a time; kill -9 loses nothing."""

import json
import multiprocessing
import os
import re
import signal
import socket
import stat
import time
import warnings
from pathlib import Path

import pytest
from support.byte_damage import STRANGE_FILES
from support.damage_harness import bytes_read

from dhtorch.data import FormatError
from dhtorch.runtime import output_folder, storage
from dhtorch.runtime.output_folder import PRIVATE_FOLDER, open_output_file, open_output_folder

CONTENT = bytes(range(256)) * 4


def contents(folder: Path) -> dict[str, bytes]:
    files = [p for p in folder.rglob("*") if p.is_file() and not output_folder.is_private(p.relative_to(folder))]
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


def write(folder: Path, **files: bytes) -> None:
    with open_output_folder(folder, "out"):
        for name, content in files.items():
            storage.replace_file(folder / name.replace("__", "/"), content)


def test_written_files_are_replaced_by_the_next_run_and_removed(tmp_path):
    out = tmp_path / "deep" / "out"
    write(out, a=CONTENT, depth__b=CONTENT)
    write(out, a=b"new")
    assert contents(out) == {"a": b"new", "depth/b": CONTENT}
    assert stat.S_IMODE((out / "a").stat().st_mode) == 0o644
    assert [p.name for p in (out / PRIVATE_FOLDER).iterdir()] == ["manifest"]
    with open_output_folder(out, "out") as folder:
        assert not folder.is_unlisted and folder.owns(out / "a") and folder.lists(out / "depth" / "b")
        assert folder.remove(out / "a") and not folder.remove(out / "a") and not folder.remove(out / "depth" / "c")
    assert contents(out) == {"depth/b": CONTENT}


def test_files_of_others_stop_a_write_and_are_not_removed(tmp_path):
    out = tmp_path / "out"
    write(out, a=CONTENT)
    (out / "mine").write_bytes(CONTENT)
    (out / "folder").mkdir()
    with open_output_folder(out, "out") as folder:
        for name in ("mine", "folder"):
            with pytest.raises(FileExistsError, match=f"out: found .*/{name}, a f"):
                storage.replace_file(out / name, b"")
            with pytest.raises(FileExistsError, match=f"/{name}, "):
                folder.check([out / "a", out / name])
            assert not folder.remove(out / name)
        with pytest.raises(FileExistsError, match="mine, a file, where a folder is needed"):
            storage.replace_file(out / "mine" / "x", b"")
        assert not list((out / PRIVATE_FOLDER).rglob("*.tmp"))
    assert contents(out) == {"a": CONTENT, "mine": CONTENT}


@pytest.mark.parametrize(
    ("change", "is_own"),
    [
        (CONTENT + b"x", False),
        (b"x" + CONTENT[1:], False),
        (CONTENT[:-1] + b"x", False),
        (b"x" * 100, False),
        (b"short", False),
        (CONTENT[:64], True),
        (CONTENT[:-1], True),
        (b"", True),
        (CONTENT, True),
    ],
)
def test_a_changed_file_is_of_its_author_and_a_shortened_one_is_torn(tmp_path, change, is_own):
    out = tmp_path / "out"
    write(out, a=CONTENT)
    (out / "a").write_bytes(change)
    with open_output_folder(out, "out") as folder:
        assert folder.owns(out / "a") == is_own
        if not is_own:
            with pytest.raises(FileExistsError, match="changed since dhtorch wrote it"):
                storage.replace_file(out / "a", b"")
        assert folder.remove(out / "a") == is_own
    assert (out / "a").exists() != is_own


def test_an_older_content_of_ours_is_ours_and_a_copied_folder_too(tmp_path):
    out = tmp_path / "out"
    write(out, a=CONTENT)
    write(out, a=b"new")
    (out / "a").write_bytes(CONTENT)
    out.rename(tmp_path / "moved")
    write(tmp_path / "moved", a=b"newest")
    assert contents(tmp_path / "moved") == {"a": b"newest"}


@pytest.mark.parametrize("target", ["elsewhere", "nowhere"])
def test_no_link_is_followed_replaced_or_removed(tmp_path, target):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "a").write_bytes(CONTENT)
    write(out, a=CONTENT, depth__a=CONTENT)
    for path in (out / "depth" / "a", out / "depth", out / "a"):
        path.rmdir() if path.is_dir() else path.unlink()
    (out / "depth").symlink_to(tmp_path / target)
    (out / "a").symlink_to(tmp_path / target / "a")
    with open_output_folder(out, "out") as folder:
        with pytest.raises(FileExistsError, match=r"out: found .*/out/depth, a link, expected"):
            storage.replace_file(out / "depth" / "a", b"")
        with pytest.raises(FileExistsError, match="/out/depth, a link"):
            folder.check_folders([out / "depth"])
        with pytest.raises(FileExistsError, match="/out/a, a link"):
            storage.replace_file(out / "a", b"")
        assert not folder.owns(out / "a") and not folder.remove(out / "a") and not folder.remove(out / "depth" / "a")
    assert contents(elsewhere) == {"a": CONTENT} and (out / "depth").is_symlink() and (out / "a").is_symlink()


def test_the_folder_may_be_a_link_and_paths_may_be_spelt_otherwise(tmp_path, monkeypatch):
    (tmp_path / "real").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "real")
    monkeypatch.chdir(tmp_path)
    with open_output_folder("out", "out") as folder:
        storage.replace_file(Path("out") / "a", b"1")
        storage.replace_file(tmp_path / "real" / "b", b"1")
        storage.replace_file(Path("out") / ".." / "real" / "c", b"1")
        storage.replace_file(Path("out") / ".." / ".." / tmp_path.name / "d", b"1")  # outside
        assert all(folder.owns(tmp_path / "real" / name) for name in "abc")
        with open_output_folder(tmp_path / "real", "out") as same:
            assert same is folder
    assert contents(tmp_path / "real") == dict.fromkeys("abc", b"1") and (tmp_path / "d").is_file()
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    with (
        pytest.raises(NotADirectoryError, match="dangling is a link to nothing"),
        open_output_folder("dangling", "out"),
    ):
        pass


@pytest.mark.parametrize("name", ["", "lock", "manifest", "unfinished"])
def test_a_link_in_the_place_of_dhtorchs_own_records_is_refused(tmp_path, name):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    (out / PRIVATE_FOLDER if name else out).mkdir(parents=True)
    elsewhere.mkdir()
    (elsewhere / "1.txt").write_text("mine")
    (out / PRIVATE_FOLDER / name).symlink_to(elsewhere)
    with pytest.raises(FileExistsError, match="a link"), open_output_folder(out, "out"):
        pass
    assert contents(elsewhere) == {"1.txt": b"mine"}


@pytest.mark.timeout(10)  # opening a pipe waits for the other end
@pytest.mark.parametrize("name", ["lock", "manifest", "unfinished"])
@pytest.mark.parametrize("kind", STRANGE_FILES)
def test_what_is_no_file_in_the_place_of_dhtorchs_own_records_is_refused(tmp_path, name, kind):
    own = tmp_path / PRIVATE_FOLDER / name
    own.parent.mkdir()
    STRANGE_FILES[kind](own)
    start = bytes_read()
    if (name, kind) in (("unfinished", "folder"), ("lock", "3 GiB")):  # these are as they should be, or not read
        with open_output_folder(tmp_path, "out"):
            pass
        assert not own.exists()
        return
    expected = "file size: found 3221225472 bytes" if (name, kind) == ("manifest", "3 GiB") else f"out: found {own}, a "
    with pytest.raises((FileExistsError, FormatError), match=expected), open_output_folder(tmp_path, "out"):
        pass
    assert bytes_read() - start < 1 << 20


def test_a_file_longer_than_any_that_dhtorch_wrote_is_not_read(tmp_path):
    write(tmp_path, a=CONTENT)
    (tmp_path / "a").unlink()
    STRANGE_FILES["3 GiB"](tmp_path / "a")
    start = bytes_read()
    with open_output_folder(tmp_path, "out") as folder:
        assert not folder.owns(tmp_path / "a") and not folder.remove(tmp_path / "a")
    assert bytes_read() - start < 1 << 20


def test_a_folder_without_results_leaves_nothing(tmp_path):
    for path in (tmp_path / "a" / "b", tmp_path / "there"):
        (tmp_path / "there").mkdir(exist_ok=True)
        with open_output_folder(path, "out"):
            assert (path / PRIVATE_FOLDER / "lock").is_file()
    assert not (tmp_path / "a" / "b").exists() and not list((tmp_path / "there").iterdir())


def test_inner_folders_have_their_own_manifest(tmp_path):
    with open_output_folder(tmp_path, "out") as outer, open_output_folder(tmp_path / "scene", "out") as inner:
        storage.replace_file(tmp_path / "scene" / "a", b"1")
        storage.replace_file(tmp_path / "b", b"1")
        storage.replace_file(tmp_path / "scene" / PRIVATE_FOLDER / "x", b"1")
        assert inner.lists(tmp_path / "scene" / "a") and not outer.lists(tmp_path / "scene" / "a")
        assert outer.lists(tmp_path / "b") and not outer.lists(tmp_path / "scene" / PRIVATE_FOLDER / "x")


def test_adopted_and_claimed_files_are_ours_links_are_not(tmp_path):
    (tmp_path / "a").write_bytes(CONTENT)
    (tmp_path / "link").symlink_to(tmp_path / "a")
    (tmp_path / ".dhtorchs").write_bytes(b"")
    with open_output_folder(tmp_path, "out") as folder:
        assert folder.is_unlisted
        folder.adopt(tmp_path.rglob("*"))
        folder.claim(tmp_path / "b")
        assert folder.owns(tmp_path / "a") and not folder.owns(tmp_path / "link")
        assert not folder.lists(tmp_path / PRIVATE_FOLDER / "lock") and folder.lists(tmp_path / ".dhtorchs")
        with pytest.raises(FileExistsError, match="/link, a link"):
            folder.claim(tmp_path / "link")
    (tmp_path / "b").write_bytes(b"any")
    with open_output_folder(tmp_path, "out") as folder:
        assert not folder.is_unlisted and folder.owns(tmp_path / "b")


def test_a_torn_or_malicious_manifest_owns_nothing_more(tmp_path):
    write(tmp_path / "out", a=CONTENT)
    manifest = tmp_path / "out" / PRIVATE_FOLDER / "manifest"
    lines = ["[1, 2]", "[[[", '["x", 0, 0, "b"]', "7", "[" * 100_000, '[0, 0, 0, "../b"]', '[3, 1, 1, "b']
    manifest.write_text(manifest.read_text() + "\n".join(lines))
    (tmp_path / "b").write_bytes(b"mine")
    (tmp_path / "out" / "b").write_bytes(b"mine")
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
    assert page.read_bytes() == b"2" and {p.name for p in tmp_path.iterdir()} == {
        "page.html",
        f".page.html{PRIVATE_FOLDER}",
        "notes.txt",
        "other",
    }
    with (
        pytest.raises(FileExistsError, match=r"html: found .*notes\.txt"),
        open_output_file(tmp_path / "notes.txt", "html"),
    ):
        pass
    write(tmp_path / "out", **{"view.html": b"1"})
    with open_output_file(tmp_path / "out" / "view.html", "html"):
        storage.replace_file(tmp_path / "out" / "view.html", b"2")
    assert [p.name for p in (tmp_path / "out").iterdir() if p.name != PRIVATE_FOLDER] == ["view.html"]


def test_private_files_are_no_results(tmp_path):
    write(tmp_path / "out", a=b"1")
    (tmp_path / "out" / "a").unlink()
    assert not storage.has_files(tmp_path / "out")
    (tmp_path / "out" / "user.dhtorch").mkdir()
    (tmp_path / "out" / "user.dhtorch" / "a").write_text("mine")
    assert storage.has_files(tmp_path / "out")


@pytest.mark.parametrize(("content", "is_whole"), [(b"", False), (CONTENT[:-1], False), (CONTENT, True), (b"x", True)])
def test_an_empty_or_shortened_file_counts_as_missing_and_an_edited_one_does_not(tmp_path, content, is_whole):
    out = tmp_path / "out"
    write(out, a=CONTENT)
    (out / "a").write_bytes(content)
    with open_output_folder(out, "out"):
        assert output_folder.is_whole(out / "a") == is_whole
        assert not output_folder.is_whole(out / "b") and not output_folder.is_whole(out)
    assert output_folder.is_whole(out / "a") == bool(content), "without the manifest only an empty one is known"


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
    write(out, a=b"new")
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


def _race(folder: Path, start: object, end: object, number: int) -> None:
    start.wait()  # type: ignore[attr-defined]
    try:
        write(folder, a=b"%d" % number, depth__b=b"%d" % number)
    except BlockingIOError as error:
        end.put((number, str(error)))  # type: ignore[attr-defined]
    else:
        end.put((number, ""))  # type: ignore[attr-defined]


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_of_fifty_that_race_each_is_refused_in_a_line_or_right(tmp_path):
    out, context = tmp_path / "out", multiprocessing.get_context("fork")
    start, end = context.Event(), context.SimpleQueue()
    processes = [context.Process(target=_race, args=(out, start, end, k)) for k in range(50)]
    for process in processes:
        process.start()
    start.set()
    ends = dict(end.get() for _ in processes)
    for process in processes:
        process.join()
        assert process.exitcode == 0
    winners = {b"%d" % number for number, refusal in ends.items() if not refusal}
    assert all("another dhtorch process" in line and "\n" not in line for line in ends.values() if line)
    files = contents(out)
    assert set(files) == {"a", "depth/b"} and files["a"] == files["depth/b"] and files["a"] in winners
    assert [p.name for p in (out / PRIVATE_FOLDER).iterdir()] == ["manifest"]
    with open_output_folder(out, "out") as folder:
        assert folder.owns(out / "a") and folder.owns(out / "depth" / "b")


def test_the_refusal_names_the_owner_and_since_when(tmp_path, monkeypatch):
    out, context = tmp_path / "out", multiprocessing.get_context("fork")
    ready = context.Event()
    other = context.Process(target=_hold, args=(out, ready))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        other.start()
    try:
        assert ready.wait(30)
        now = time.time()
        monkeypatch.setattr(time, "time", lambda: now + 7)
        owner = rf"another dhtorch process \({other.pid} on {re.escape(socket.gethostname())}, for [78] s\)"
        with pytest.raises(BlockingIOError, match=f"^out: {out}: found {owner} writing there"):
            write(out, a=b"1")
        for record in (b"", b"{", b'{"process": 1}', b"[" * 900, b'{"process": "\xff", "host": 1, "since": 1e999}'):
            (out / PRIVATE_FOLDER / "lock").write_bytes(record)
            with pytest.raises(BlockingIOError, match="found another dhtorch process writing there"):
                write(out, a=b"1")
    finally:
        other.kill()
        other.join()


def _hold(folder: Path, ready: object) -> None:
    with open_output_folder(folder, "out"):
        ready.set()  # type: ignore[attr-defined]
        signal.pause()


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_second_process_is_refused_and_a_dead_one_blocks_nobody(tmp_path):
    out, context = tmp_path / "out", multiprocessing.get_context("fork")
    ready = context.Event()
    other = context.Process(target=_hold, args=(out, ready))
    other.start()
    try:
        assert ready.wait(30)
        with pytest.raises(BlockingIOError, match=f"out: {out}: found another dhtorch process .* writing there"):
            write(out, a=b"1")
        (tmp_path / "link").symlink_to(out)
        with pytest.raises(BlockingIOError, match="another dhtorch process"):
            write(tmp_path / "link", a=b"1")
    finally:
        other.kill()
        other.join()
    write(out, a=b"1")
    assert contents(out) == {"a": b"1"} and not (out / PRIVATE_FOLDER / "lock").exists()


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
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("is_written_before", [False, True])
def test_kill_9_at_any_moment_leaves_only_files_that_the_next_run_replaces(tmp_path, is_written_before):
    moment = 0
    while True:
        out = tmp_path / str(moment)
        if is_written_before:
            write(out, a=b"old", depth__b=b"old")
        was_killed = _killed_at(out, moment)
        assert all(content in (CONTENT, b"old") for content in contents(out).values())
        write(out, a=b"new", depth__b=b"new", c=b"new")
        assert contents(out) == {"a": b"new", "depth/b": b"new", "c": b"new"}
        assert [p.name for p in (out / PRIVATE_FOLDER).iterdir()] == ["manifest"]
        for line in (out / PRIVATE_FOLDER / "manifest").read_text().splitlines():
            assert len(json.loads(line)) == 4
        if not was_killed:
            break
        moment += 1
    assert moment > 15


def test_a_folder_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    def refuse(*_args: object, **_options: object) -> None:
        raise PermissionError(13, "Permission denied", str(tmp_path / "out" / PRIVATE_FOLDER))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(PermissionError) as error, open_output_folder(tmp_path / "out", "out"):
        pass
    assert error.value.filename == str(tmp_path / "out")
