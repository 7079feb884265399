"""Every command that writes a folder: one writer at a time, and what others put there is neither replaced nor removed."""

import json
import multiprocessing
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support import writers

from dhtorch import data
from dhtorch.cli import run
from dhtorch.metrics.holdout import range_split
from dhtorch.runtime.output_folder import PRIVATE_FOLDER, is_private, open_output_folder
from dhtorch.synthetic.recording import SyntheticRoom

#: Many whole runs of commands: minutes. `pytest -m slow` runs them.
pytestmark = pytest.mark.slow

ROOM = ["data=synthetic", "data.hw=[96,128]", "data.depth_hw=[96,128]", "data.supersample=1", "data.n_frames=6"]
COMPLETE = ["planes=16", "refinements=1", "steps=[1]", "cutoff=2.0", "method=map", "method.n=256", "threads=1"]
PAIR = [*ROOM, "pairs.gap=3", "method=paper", "method.n=256"]

#: Command → its words, with CAPTURE, MAPS, RESULT and OUT for paths, and a file that it writes.
COMMANDS = {
    "complete": (["complete", "CAPTURE", "out=OUT", *COMPLETE], "depth/000000.png"),
    "recover": (
        ["CAPTURE", "out=OUT", "method=map", "method.n=256", "planes=16", "steps=[1]", "mesh=false"],
        "view.html",
    ),
    "align": (["align", *ROOM, "depth=MAPS", "out=OUT", "max_frames=1", "steps=[1]", "method.n=256"], "align.html"),
    "validate": (
        ["validate", *ROOM, "max_frames=1", "window=0", "size=96", "method.n=256", "output=OUT"],
        "validate.json",
    ),
    "stream": (["stream", *ROOM, "max_frames=2", "method.n=256", "output=OUT"], "stream.json"),
    "run": (["run", *PAIR, "output=OUT"], "result.json"),
    "sweep": (["-m", *PAIR, "seed=0,1", "output=OUT"], "multirun.yaml"),
    "integrate": (["integrate", *PAIR, "mesh=false", "dense=false", "output=OUT"], "synthetic_room/map.ply"),
    "extract": (["extract", *ROOM, "method.n=64", "out=OUT"], "shard-00000.parquet"),
    "enrich": (["enrich", "CAPTURE", "OUT", "dense=false", "method.n=64"], "meta/info.json"),
    "inspect": (["inspect", "CAPTURE", "--out", "OUT"], "kitchen.png"),
    "view": (["view", "RESULT", "html=OUT/page.html", "max_frames=1"], "page.html"),
    "report": (["report", "RESULT", "--html", "OUT/page.html"], "page.html"),
}


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Four views of the room as numbered frames."""
    whole = SyntheticRoom(hw=(96, 128), n_frames=22, lidar="exact", supersample=1, image_noise=0.0)
    path = tmp_path_factory.mktemp("captures") / "kitchen"
    writers.write_counted_frames(path, [range_split(whole[k], 2.0) for k in (0, 7, 14, 21)])
    return path


@pytest.fixture(scope="module")
def inputs(capture, tmp_path_factory):
    """Word of ``COMMANDS`` → path."""
    maps, result = tmp_path_factory.mktemp("maps"), tmp_path_factory.mktemp("result") / "job"
    room = SyntheticRoom(n_frames=6, hw=(96, 128), depth_hw=(96, 128), supersample=1)
    for k in range(len(room)):
        np.save(maps / f"{k:04d}.npy", 1.5 * room.truth(k)["depth"][0].numpy())
    assert run.main(["run", *PAIR, f"output={result}"]) == 0
    return {"CAPTURE": str(capture), "MAPS": str(maps), "RESULT": str(result)}


@pytest.fixture(scope="module")
def completed(capture, tmp_path_factory):
    """Two frames of the capture, completed."""
    out = tmp_path_factory.mktemp("completed") / "out"
    assert complete(capture, out, "max_frames=2", "figures=all") == 0
    return out


@pytest.fixture
def again(completed, tmp_path):
    """A copy of the completed folder."""
    return Path(shutil.copytree(completed, tmp_path / "out"))


def complete(capture, out, *words):
    return run.main(["complete", str(capture), f"out={out}", *COMPLETE, *words])


def words_of(command, inputs, out):
    words = COMMANDS[command][0]
    for name, path in {**inputs, "OUT": str(out)}.items():
        words = [word.replace(name, path) for word in words]
    return words


def contents(folder):
    """{path: content, or target of a link} of all that is in a folder, dhtorch's private files excluded."""
    paths = [p for p in sorted(folder.rglob("*")) if not is_private(p.relative_to(folder))]
    paths = [p for p in paths if p.is_symlink() or p.is_file()]
    return {p.relative_to(folder).as_posix(): str(p.readlink()) if p.is_symlink() else p.read_bytes() for p in paths}


def one_line(capsys):
    printed = capsys.readouterr().err.strip().splitlines()
    lines = [line for line in printed if "depth unit assumed" not in line]
    assert len(lines) == 1 and lines[0].startswith("dhtorch: "), lines
    return lines[0]


# ------------------------------------------------------------------------------------------------------ every command


def _hold(folder, file, ready):
    private = PRIVATE_FOLDER if file is None else f".{file}{PRIVATE_FOLDER}"
    with open_output_folder(folder, "out", private=private):
        ready.set()
        signal.pause()


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("command", COMMANDS)
def test_the_second_writer_is_refused_in_one_line(command, inputs, tmp_path, capsys):
    out, context = tmp_path / "out", multiprocessing.get_context("fork")
    ready = context.Event()
    file = "page.html" if command in ("view", "report") else None
    first = context.Process(target=_hold, args=(out, file, ready))
    first.start()
    try:
        assert ready.wait(30)
        assert run.main(words_of(command, inputs, out)) == run.EXIT_FAILED
    finally:
        first.kill()
        first.join()
    line = one_line(capsys)
    assert str(out) in line and f"another dhtorch process ({first.pid} on" in line and "one writer" in line
    assert contents(out) == {}


@pytest.mark.parametrize("kind", ["file", "link", "link to nothing"])
@pytest.mark.parametrize("command", COMMANDS)
def test_what_is_in_the_way_is_named_and_stays(command, kind, inputs, tmp_path, capsys):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    path = out / COMMANDS[command][1]
    path.parent.mkdir(parents=True)
    elsewhere.write_text("mine")
    if kind == "file":
        path.write_text("mine")
    else:
        path.symlink_to(elsewhere if kind == "link" else tmp_path / "nowhere")
    before = contents(tmp_path)
    assert run.main(words_of(command, inputs, out)) == run.EXIT_FAILED
    line = one_line(capsys)
    has_other_rule = command in ("complete", "recover", "align", "enrich")  # these start in an empty folder only
    assert (str(out) if has_other_rule else str(path)) in line
    assert contents(tmp_path) == before and not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize("command", [name for name in COMMANDS if name not in ("integrate", "recover", "sweep")])
def test_said_again_it_replaces_its_own_and_leaves_the_rest(command, inputs, tmp_path):
    out = tmp_path / "out"
    words = words_of(command, inputs, out)
    out.mkdir()  # report makes no folder
    assert run.main(words) == 0
    mine = {"notes.txt": b"mine", "depth/mine.png": b"mine", "meta/mine.md": b"mine"}
    for name, content in mine.items():
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_bytes(content)
    names = set(contents(out))
    assert COMMANDS[command][1] in names
    assert run.main(words) == 0
    after = contents(out)
    assert set(after) == names and mine.items() <= after.items()


# ----------------------------------------------------------------------------------------------------------- complete


def test_a_second_complete_leaves_files_and_links_of_others(capture, again, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for name in ("a.png", "000001.png", "000009.png"):
        (elsewhere / name).write_bytes(b"mine")
    mine = [
        "depth/000009.png",
        "depth/a.png",
        "depth/.a.png.b.tmp",
        "figures/a.png",
        "figures/000009.png",
        "a",
        "meta/a",
    ]
    for name in mine:
        (again / name).write_bytes(b"mine")
    (again / "depth" / "link.png").symlink_to(elsewhere / "a.png")
    (again / "figures" / "dangling.png").symlink_to(tmp_path / "nowhere")
    (again / "figures" / "more").symlink_to(elsewhere)
    (again / "points").symlink_to(elsewhere)  # a folder that these options do not write
    before, others = contents(again), contents(elsewhere)
    assert complete(capture, again, "max_frames=3", "figures=all") == 0
    after = contents(again)
    assert {name: after[name] for name in before if name != "poses.txt"} == {
        name: content for name, content in before.items() if name != "poses.txt"
    }
    assert contents(elsewhere) == others and "depth/000002.png" in after and "figures/000002.png" in after


@pytest.mark.parametrize("folder", ["depth", "figures", "meta"])
@pytest.mark.parametrize("target", ["elsewhere", "nowhere"])
def test_a_folder_that_is_a_link_stops_it(capture, again, tmp_path, capsys, folder, target):
    (again / folder).rename(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "mine.png").write_bytes(b"mine")
    (again / folder).symlink_to(tmp_path / target)
    before = contents(tmp_path)
    assert complete(capture, again, "max_frames=3", "figures=all") == run.EXIT_FAILED
    assert f"found {again / folder}, a link" in one_line(capsys)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("name", ["depth/000002.png", "meta/000002.json", "figures/000002.png", "sigma/000002.png"])
@pytest.mark.parametrize("kind", ["file", "link", "folder"])
def test_a_foreign_name_of_a_frame_stops_it_before_anything_is_changed(capture, again, tmp_path, capsys, name, kind):
    (tmp_path / "mine").write_bytes(b"mine")
    if kind == "file":
        (again / name).write_bytes(b"mine")
    elif kind == "link":
        (again / name).symlink_to(tmp_path / "mine")
    else:
        (again / name).mkdir()
    before = contents(tmp_path)
    assert complete(capture, again, "max_frames=3", "figures=all") == run.EXIT_FAILED
    assert f"found {again / name}, a {kind}" in one_line(capsys)
    assert contents(tmp_path) == before
    assert complete(capture, again, "max_frames=2", "figures=all") == 0, "frames that are not wanted are not in the way"


def test_a_file_that_was_edited_is_not_replaced(capture, again, capsys):
    for name, is_written in (("poses.txt", True), ("figures/000000.png", False)):
        original = (again / name).read_bytes()
        (again / name).write_bytes(original + b"# mine\n")
        before = contents(again)
        assert complete(capture, again, "max_frames=3", "figures=all") == (run.EXIT_FAILED if is_written else 0)
        if is_written:
            assert f"found {again / name}, a file that was changed since" in one_line(capsys)
            assert contents(again) == before
        else:
            assert contents(again)[name] == before[name]
        (again / name).write_bytes(original)


def test_files_of_a_frame_that_a_killed_run_left_are_removed(capture, again):
    (again / "meta" / "000001.json").unlink()
    (again / "depth" / "mine.png").write_bytes(b"mine")
    assert complete(capture, again, "max_frames=1") == 0
    assert {name for name in contents(again) if "00000" in name or "mine" in name} == {
        *(f"{kind}/000000.png" for kind in ("depth", "sigma", "source", "images", "figures")),
        "meta/000000.json",
        "depth/mine.png",
    }


def test_a_folder_of_an_older_version_is_resumed(capture, again, capsys):
    shutil.rmtree(again / PRIVATE_FOLDER)
    (again / "depth" / "000002.png").write_bytes(b"mine or of a killed run")
    before = contents(again)
    assert complete(capture, again, "max_frames=3") == run.EXIT_FAILED
    assert f"found {again / 'depth' / '000002.png'}, a file that dhtorch did not write" in one_line(capsys)
    assert contents(again) == before
    (again / "depth" / "000002.png").unlink()
    assert complete(capture, again, "max_frames=3") == 0
    (again / "meta" / "000000.json").unlink()
    assert complete(capture, again, "max_frames=3") == 0, "the older files are in the manifest now"
    assert len(data.open(again)) == 3


def _command(words, folder):
    """The command in a process of its own."""
    return subprocess.Popen([sys.executable, "-m", "dhtorch", *words], cwd=folder, stderr=subprocess.PIPE, text=True)


def _wait_for(path, process):
    end = time.monotonic() + 120
    while not path.exists() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.01)
    assert path.exists()


@pytest.mark.slow
def test_two_at_once_with_different_options_do_not_mix(capture, tmp_path):
    out = tmp_path / "out"
    words = ["complete", str(capture), f"out={out}", *COMPLETE]
    first = _command(words, tmp_path)
    _wait_for(out / PRIVATE_FOLDER / "lock", first)
    second = _command([*words, "seed=7"], tmp_path)
    lines = second.communicate(timeout=200)[1].strip().splitlines()
    (line,) = [s for s in lines if "depth unit assumed" not in s]  # said where the first ends before the second reads
    assert first.wait(200) == 0 and second.returncode == run.EXIT_FAILED
    assert str(out) in line and ("dhtorch process" in line or "seed" in line)
    keys = {json.loads(path.read_text())["key"] for path in (out / "meta").iterdir()}
    assert len(keys) == 1 and len(data.open(out)) == 4
    first.stderr.close()


@pytest.mark.slow
def test_kill_9_midway_and_resume(capture, tmp_path):
    out, whole = tmp_path / "out", tmp_path / "whole"
    words = ["complete", str(capture), *COMPLETE, "figures=all"]
    assert run.main([*words, f"out={whole}"]) == 0
    for k, place in enumerate(("depth/000000.png", "figures/000001.png")):
        process = _command([*words, f"out={out}{k}"], tmp_path)
        _wait_for(Path(f"{out}{k}") / place, process)
        process.kill()
        process.communicate()
        (Path(f"{out}{k}") / "depth" / "mine.png").write_bytes(b"mine")
        assert run.main([*words, f"out={out}{k}"]) == 0
        made = contents(Path(f"{out}{k}"))
        assert made.pop("depth/mine.png") == b"mine"
        assert set(made) == set(contents(whole))
        depths = {name: content for name, content in made.items() if name.startswith(("depth", "sigma", "source"))}
        assert depths.items() <= contents(whole).items()


# ----------------------------------------------------------------------------------------------------------- the others


def test_a_result_of_an_older_version_is_replaced(inputs, tmp_path, capsys):
    out = Path(shutil.copytree(inputs["RESULT"], tmp_path / "out"))
    shutil.rmtree(out / PRIVATE_FOLDER)
    (out / "notes.txt").write_text("mine")
    assert run.main(["run", *PAIR, "seed=1", f"output={out}"]) == 0
    assert (out / "notes.txt").read_text() == "mine"
    assert json.loads((out / "result.json").read_text())["config"]["seed"] == 1
    capsys.readouterr()


def test_a_read_only_folder_is_named(inputs, tmp_path, capsys, monkeypatch):
    real, out = Path.mkdir, tmp_path / "out"

    def refuse(self, *args, **options):
        if PRIVATE_FOLDER in self.name:
            raise PermissionError(13, "Permission denied", str(self))
        return real(self, *args, **options)

    monkeypatch.setattr(Path, "mkdir", refuse)
    for command in ("complete", "validate", "stream", "run", "inspect"):
        assert run.main(words_of(command, inputs, out)) == run.EXIT_FAILED
        assert f"{out}: Permission denied" in one_line(capsys)


def test_the_manifest_is_no_data(again):
    recording = partial(data.open, again)
    assert len(recording()) == 2
    listed = run.main(["inspect", str(again), "--out", str(again.parent / "sheets")])
    assert listed == 0
