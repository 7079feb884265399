"""Output folders of every command: fresh, again, with other inputs, torn, locked, with what others put there; kills."""

import json
import multiprocessing
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from support import writers
from support.processes import start, stop

from dhtorch import data
from dhtorch.cli import run
from dhtorch.metrics.holdout import range_split
from dhtorch.runtime.output_folder import PRIVATE_FOLDER, is_private, open_output_folder
from dhtorch.synthetic.recording import SyntheticRoom

ROOM = ["data=synthetic", "data.hw=[96,128]", "data.depth_hw=[96,128]", "data.supersample=1", "data.n_frames=6"]
COMPLETE = ["planes=16", "refinements=1", "steps=[1]", "cutoff=2.0", "method=map", "method.n=256", "threads=1"]
PAIR = [*ROOM, "pairs.gap=3", "method=paper", "method.n=256"]
FEW = ["method=paper", "method.n=64", "method.hypotheses=10", "gap=0", "dense=false", "max_frames=2"]

#: Command → its words, with CAPTURE, MAPS, RESULT and OUT for paths, and a file that it writes.
COMMANDS = {
    "complete": (["complete", "CAPTURE", "out=OUT", *COMPLETE, "max_frames=2", "arrays=true"], "depth/000000.png"),
    "recover": (["CAPTURE", "out=OUT", "method=map", "method.n=256", "planes=16", "steps=[1]", "mesh=false"], "view.html"),
    "align": (["align", *ROOM, "depth=MAPS", "out=OUT", "max_frames=1", "steps=[1]", "method.n=256"], "align.html"),
    "validate": (["validate", *ROOM, "max_frames=1", "window=0", "size=96", "method.n=256", "output=OUT"], "validate.json"),
    "stream": (["stream", *ROOM, "max_frames=2", "method.n=256", "output=OUT"], "stream.json"),
    "run": (["run", *PAIR, "output=OUT"], "result.json"),
    "sweep": (["-m", *PAIR, "batch=1,2", "output=OUT"], "multirun.yaml"),
    "integrate": (["integrate", *PAIR, "mesh=false", "dense=false", "output=OUT"], "synthetic_room/map.ply"),
    "extract": (["extract", *ROOM, "method.n=64", "out=OUT", "extract.shard_rows=2", "extract.columns=[depth]"], "shard-00000.parquet"),
    "enrich": (["enrich", "CAPTURE", "OUT", *FEW, "columns=[depth,sigma,source,geometry_image]"], "meta/info.json"),
    "nerfstudio": (["enrich", "CAPTURE", "OUT", *FEW, "format=nerfstudio"], "transforms.json"),
    "inspect": (["inspect", "CAPTURE", "--out", "OUT"], "kitchen.png"),
    "view": (["view", "RESULT", "html=OUT/page.html", "max_frames=1"], "page.html"),
    "report": (["report", "RESULT", "--html", "OUT/page.html"], "page.html"),
}  # fmt: skip

#: Commands that continue in a folder of the same settings → the file that states these, if there is one.
CONTINUED = {"complete": "complete.json", "recover": "complete.json", "align": "complete.json", "extract": None}
CONTINUED |= {"enrich": "meta/dhtorch.json", "nerfstudio": "meta/dhtorch.json"}


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Four views of the room as numbered frames."""
    whole = SyntheticRoom(hw=(96, 128), n_frames=22, lidar="exact", supersample=1, image_noise=0.0)
    path = tmp_path_factory.mktemp("captures") / "kitchen"
    writers.write_counted_frames(path, [range_split(whole[k], 2.0) for k in (0, 7, 14, 21)])
    return path


@pytest.fixture(scope="module")
def inputs(capture, tmp_path_factory):
    """Function: words -> the words with the paths of the inputs; the result is made where it is needed."""
    maps, result = tmp_path_factory.mktemp("maps"), tmp_path_factory.mktemp("result") / "job"
    np.save(
        maps / "0000.npy", 1.5 * SyntheticRoom(hw=(96, 128), n_frames=1, supersample=1).truth(0)["depth"][0].numpy()
    )

    def fill(words, out):
        if any("RESULT" in word for word in words) and not result.exists():
            assert run.main(["run", *PAIR, f"output={result}"]) == 0
        for name, path in {"CAPTURE": capture, "MAPS": maps, "RESULT": result, "OUT": out}.items():
            words = [word.replace(name, str(path)) for word in words]
        return words

    return fill


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


def contents(folder):
    """{path: content, or target of a link} of all that is in a folder, dhtorch's private files excluded."""
    paths = [p for p in sorted(folder.rglob("*")) if not is_private(p.relative_to(folder))]
    paths = [p for p in paths if p.is_symlink() or p.is_file()]
    return {p.relative_to(folder).as_posix(): str(p.readlink()) if p.is_symlink() else p.read_bytes() for p in paths}


def one_line(text):
    lines = [line for line in text.strip().splitlines() if "depth unit assumed" not in line]
    assert len(lines) == 1 and lines[0].startswith("dhtorch: "), lines
    return lines[0]


# ---------------------------------------------------------------------------------------- every command, every situation


def go_again(words, file, out, _name, _capsys):
    """It replaces its own files and leaves the rest."""
    assert run.main(words) == 0
    mine = {"notes.txt": b"mine", "depth/mine.png": b"mine", "meta/mine.md": b"mine"}
    for name, content in mine.items():
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_bytes(content)
    names = set(contents(out))
    assert file in names
    assert run.main(words) == 0
    after = contents(out)
    assert set(after) == names and mine.items() <= after.items()


def block(words, file, out, name, capsys):
    """A file, a link or a link to nothing in the way is named and stays."""
    (out.parent / "elsewhere").write_text("mine")
    (out / file).parent.mkdir(parents=True, exist_ok=True)
    for place in (
        lambda path: path.write_text("mine"),
        lambda path: path.symlink_to(out.parent / "elsewhere"),
        lambda path: path.symlink_to(out.parent / "nowhere"),
    ):
        (out / file).unlink(missing_ok=True)
        place(out / file)
        before = contents(out.parent)
        assert run.main(words) == run.EXIT_FAILED
        line = one_line(capsys.readouterr().err)
        starts_empty = name in CONTINUED and name != "extract"
        assert (str(out) if starts_empty else str(out / file)) in line
        assert contents(out.parent) == before and not (out.parent / "nowhere").exists()


def _hold(folder, file, ready):
    private = PRIVATE_FOLDER if file is None else f".{file}{PRIVATE_FOLDER}"
    with open_output_folder(folder, "out", private=private):
        ready.set()
        signal.pause()


def lock(words, file, out, name, capsys):
    """A second writer is refused in one line."""
    context = multiprocessing.get_context("fork")
    ready = context.Event()
    first = context.Process(target=_hold, args=(out, file if name in ("view", "report") else None, ready))
    first.start()
    try:
        assert ready.wait(30)
        assert run.main(words) == run.EXIT_FAILED
    finally:
        first.kill()
        first.join()
    line = one_line(capsys.readouterr().err)
    assert str(out) in line and f"another dhtorch process ({first.pid} on" in line and "one writer" in line
    assert contents(out) == {}


def change(words, file, out, name, capsys):
    """Other settings are refused where a command continues; elsewhere the new files take the place of the old ones."""
    assert run.main(words) == 0
    before = contents(out)
    capsys.readouterr()
    code = run.main([*words, "seed=1"] if name not in ("inspect", "report") else words)
    line = capsys.readouterr().err.strip().rpartition("\n")[2]
    assert code == (run.EXIT_FAILED if name in CONTINUED else run.EXIT_DONE)
    assert code == run.EXIT_DONE or (contents(out) == before and "seed 0 there, 1 here" in line), line


def tear(words, _file, out, name, capsys):
    """An empty or shortened file counts as missing, unfinished ones are removed, and the file of the settings is read."""
    assert run.main(words) == 0
    whole, stated = contents(out), CONTINUED[name]
    names = sorted(whole.keys() - {stated})
    assert len(names) >= 3
    for k, each in enumerate(names):  # the head of a short file says too little of whose it is
        (out / each).write_bytes(whole[each][:-1] if k % 2 and len(whole[each]) > 64 else b"")
    for each in ("unfinished/3.mp4", ".shard-00001.parquet.x7.tmp"):
        (out / PRIVATE_FOLDER / each).parent.mkdir(exist_ok=True)
        (out / PRIVATE_FOLDER / each).write_bytes(b"half")
    assert run.main(words) == 0
    after = contents(out)
    assert after.keys() == whole.keys() and [p.name for p in (out / PRIVATE_FOLDER).rglob("*")] == ["manifest"]
    assert not [each for each in names if after[each] != whole[each] and not each.startswith("figures/")]
    capsys.readouterr()
    for content in (b"", b"null") if stated else ():
        (out / stated).write_bytes(content)
        assert run.main(words) == run.EXIT_FAILED and str(out / stated) in one_line(capsys.readouterr().err)
        assert {k: x for k, x in contents(out).items() if k != stated} == {
            k: x for k, x in after.items() if k != stated
        }


#: Situation → commands for which it is tried in seconds, and those of minutes.
SITUATIONS = {
    block: (["complete", "stream"], COMMANDS),
    lock: (["complete", "run", "view"], COMMANDS),
    go_again: (["complete", "enrich"], [name for name in COMMANDS if name not in ("integrate", "recover", "sweep")]),
    change: (["complete", "enrich"], [name for name in COMMANDS if name != "sweep"]),
    tear: (["complete", "enrich"], ["nerfstudio", "extract"]),
}
ROWS = [(situation, name, False) for situation, (quick, _) in SITUATIONS.items() for name in quick]
ROWS += [
    (situation, name, True) for situation, (quick, all_) in SITUATIONS.items() for name in all_ if name not in quick
]


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize(
    ("situation", "name"),
    [
        pytest.param(each, name, id=f"{each.__name__} {name}", marks=[pytest.mark.slow] * is_slow)
        for each, name, is_slow in ROWS
    ],
)
def test_a_folder_in_a_situation(situation, name, inputs, tmp_path, capsys):
    words, file = COMMANDS[name]
    out = tmp_path / "out"
    if name == "report":  # which makes no folder
        out.mkdir()
    situation(inputs(words, out), file, out, name, capsys)


# ------------------------------------------------------------------------------------------------------------ complete


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *((folder, target) for folder in ("depth", "figures", "meta") for target in ("elsewhere", "nowhere")),
        *(
            (f"{kind}/000002.png", what)
            for kind in ("depth", "figures", "sigma")
            for what in ("file", "link", "folder")
        ),
        *(("meta/000002.json", what) for what in ("file", "link", "folder")),
        ("poses.txt", "edited"),
    ],
)
def test_what_is_in_the_way_of_a_frame_stops_it_before_anything_is_changed(
    capture, again, tmp_path, capsys, name, kind
):
    path, what = again / name, "a link"
    if kind in ("elsewhere", "nowhere"):
        path.rename(tmp_path / "elsewhere")
        (tmp_path / "elsewhere" / "mine.png").write_bytes(b"mine")
        path.symlink_to(tmp_path / kind)
    elif kind == "link":
        path.symlink_to(tmp_path / "mine")
    elif kind == "folder":
        path.mkdir()
        what = "a folder or device"
    else:
        path.write_bytes((path.read_bytes() if kind == "edited" else b"") + b"mine")
        what = "a file that was changed since" if kind == "edited" else "a file that dhtorch did not write"
    before = contents(tmp_path)
    assert complete(capture, again, "max_frames=3", "figures=all") == run.EXIT_FAILED
    assert f"found {path}, {what}" in one_line(capsys.readouterr().err) and contents(tmp_path) == before
    if "00000" in name:
        assert complete(capture, again, "max_frames=2", "figures=all") == 0, "frames not wanted are not in the way"


@pytest.mark.slow
def test_files_of_a_frame_that_a_killed_run_left_are_removed_and_an_edited_figure_stays(capture, again):
    (again / "meta" / "000001.json").unlink()
    (again / "depth" / "mine.png").write_bytes(b"mine")
    figure = again / "figures" / "000000.png"
    figure.write_bytes(figure.read_bytes() + b"# mine\n")
    edited = figure.read_bytes()
    assert complete(capture, again, "max_frames=1", "figures=all") == 0
    assert {name for name in contents(again) if "00000" in name or "mine" in name} == {
        *(f"{kind}/000000.png" for kind in ("depth", "sigma", "source", "images", "figures")),
        "meta/000000.json",
        "depth/mine.png",
    }
    assert figure.read_bytes() == edited and run.main(["inspect", str(again), "--out", str(again.parent / "o")]) == 0


@pytest.mark.slow
def test_folders_of_an_older_version_are_continued_or_replaced(capture, again, inputs, tmp_path, capsys):
    shutil.rmtree(again / PRIVATE_FOLDER)
    foreign = again / "depth" / "000002.png"
    foreign.write_bytes(b"mine or of a killed run")
    before = contents(again)
    assert complete(capture, again, "max_frames=3") == run.EXIT_FAILED and contents(again) == before
    assert f"found {foreign}, a file that dhtorch did not write" in one_line(capsys.readouterr().err)
    for removed in (foreign, again / "meta" / "000000.json"):  # the older files are in the manifest then
        removed.unlink()
        assert complete(capture, again, "max_frames=3") == 0
    assert len(data.open(again)) == 3
    job = Path(shutil.copytree(inputs(["RESULT"], "")[0], tmp_path / "job"))
    shutil.rmtree(job / PRIVATE_FOLDER)
    (job / "notes.txt").write_text("mine")
    for words, code, said in (
        (["resume=true"], 0, "finished and valid, left untouched"),
        (["seed=1"], 0, "wrote "),
        (["seed=1", "resume=true"], run.EXIT_FAILED, "result.json, a file that was changed since dhtorch wrote it"),
    ):
        if code:
            result = json.loads((job / "result.json").read_text())
            (job / "result.json").write_text(json.dumps(result | {"rows": []}))
        assert run.main(["run", *PAIR, *words, f"output={job}"]) == code and said in "".join(capsys.readouterr())
    assert (job / "notes.txt").read_text() == "mine" and result["config"]["seed"] == 1


def test_a_folder_that_cannot_be_written_is_named(inputs, tmp_path, capsys, monkeypatch):
    real, out = Path.mkdir, tmp_path / "out"

    def refuse(self, *args, **options):
        if PRIVATE_FOLDER in self.name:
            raise PermissionError(13, "Permission denied", str(self))
        return real(self, *args, **options)

    monkeypatch.setattr(Path, "mkdir", refuse)
    for name in ("complete", "validate", "stream", "run", "inspect"):
        assert run.main(inputs(COMMANDS[name][0], out)) == run.EXIT_FAILED
        assert f"{out}: Permission denied" in one_line(capsys.readouterr().err)


# ----------------------------------------------------------------------------------------------------- two, and killed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "place"),
    [(signal.SIGKILL, "depth/000000.png"), (signal.SIGKILL, "figures/000001.png"), (signal.SIGINT, "meta/000000.json")],
)
def test_a_stopped_process_loses_the_frame_that_was_being_made(capture, tmp_path, how, place):
    out, whole = tmp_path / "maps", tmp_path / "whole"
    words = ["complete", str(capture), *COMPLETE, "figures=all"]
    assert run.main([*words, f"out={whole}"]) == 0
    code = stop(start(tmp_path, *words, f"out={out}"), lambda: [p for p in [out / place] if p.exists()], 1, how)
    kept = {p.stem for p in (out / "meta").glob("*.json")}
    assert len(kept) < 4
    if how == signal.SIGINT:
        assert code == run.EXIT_INTERRUPTED
        line = one_line((tmp_path / "err").read_text())
        assert f"{len(kept)} of 4 frames" in line and "run the same command again for the rest" in line
        assert len(data.open(out)) == len(kept), "a recording even so"
    (out / "depth" / "mine.png").write_bytes(b"mine")
    before = {name: (out / "depth" / f"{name}.png").stat().st_mtime_ns for name in kept}
    assert run.main([*words, f"out={out}"]) == 0
    assert {name: (out / "depth" / f"{name}.png").stat().st_mtime_ns for name in kept} == before
    made, expected = contents(out), contents(whole)
    assert made.pop("depth/mine.png") == b"mine" and set(made) == set(expected)
    kinds = ("depth", "sigma", "source")
    assert {k: x for k, x in made.items() if k.startswith(kinds)}.items() <= expected.items()


@pytest.mark.slow
def test_two_at_once_with_different_options_do_not_mix(capture, tmp_path):
    out = tmp_path / "out"
    words = ["complete", str(capture), f"out={out}", *COMPLETE]
    ends = []
    for k, more in enumerate(([], ["seed=7"])):
        (tmp_path / str(k)).mkdir()
        ends.append(start(tmp_path / str(k), *words, *more))
    codes = [process.wait(200) for process in ends]
    assert sorted(codes) == [run.EXIT_DONE, run.EXIT_FAILED]
    line = one_line((tmp_path / str(codes.index(run.EXIT_FAILED)) / "err").read_text())
    assert str(out) in line and ("dhtorch process" in line or "seed" in line)
    keys = {json.loads(path.read_text())["key"] for path in (out / "meta").iterdir()}
    assert len(keys) == 1 and len(data.open(out)) == 4
