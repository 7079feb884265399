"""One way to type every command: ``dhtorch COMMAND PATH [--option value | option=value ...]``, and its help."""

import json
import logging
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from support import writers
from support.tiny_runs import TINY

import dhtorch
from dhtorch.cli import commands, demo, process_capture, run
from dhtorch.cli.commands import COMMANDS, list_options, resolve_option, to_overrides
from dhtorch.runtime import console
from dhtorch.runtime.ply import read_ply_vertices
from dhtorch.synthetic.recording import SyntheticRoom

#: Commands that read a capture and compute maps from its frames.
COMPUTING = [name for name in COMMANDS if name not in ("inspect", "report", "fetch", "run")]


def overrides(name, *argv):
    return to_overrides(name, argv, list_options(name, run.config_dir()), {"--multirun", "--cfg"}, console.suggest_name)


def test_the_list_of_commands_is_short_and_complete(command):
    code, out, _ = command("--help")
    lines = out.splitlines()
    assert code == 0 and len(lines) <= 30 and max(map(len, lines)) < 120
    for name in {*run._CONFIGURED_COMMANDS, *run._PARSED_COMMANDS, "run", "demo"} - {"recover"}:
        (line,) = [line for line in lines if line.startswith(f"  {name} ")]
        assert len(line.split()) > 4, line


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_is_short(command, name):
    code, out, _ = command(name, "--help")
    lines = out.splitlines()
    assert code == 0 and len(lines) <= 45 and max(map(len, lines)) < 120
    assert len(COMMANDS[name].examples) == 3
    assert len(COMMANDS[name].options) <= 15 and (len(COMMANDS[name].options) >= 8 or name in ("report", "fetch"))
    known = list_options(name, run.config_dir())
    for option in COMMANDS[name].options:
        note = known[resolve_option(name, option, known)]
        assert (note.default and (note.note or option == "seed")) or option == "out", option
    assert "Exit code: 0 done" in out and "130 interrupted" in out


@pytest.mark.parametrize("name", COMPUTING)
def test_common_options_have_one_name(name):
    known = list_options(name, run.config_dir())
    for option in ("max_frames", "every", *(["method"] if name not in ("pin", "scale") else []), "device", "out"):
        assert resolve_option(name, option, known), option


@pytest.mark.parametrize(
    ("name", "typed", "expected"),
    [
        ("complete", "x --out d --max-frames 3", "x out=d max_frames=3"),
        ("complete", "x --out=d max-frames=3", "x out=d max_frames=3"),
        ("stream", "x --out d", "x output=d"),
        ("complete", "--points --no-figures x", "points=true figures=false x"),
        ("complete", "--points x --arrays false", "points=true x arrays=false"),
        ("complete", "--fov 69 --K 1,2,3,4 x", "data.fov=69 data.K=1,2,3,4 x"),
        ("extract", "x --gap 5 --columns a,b --tokens-hw 56,56", "x extract.gap=5 extract.columns=[a,b] extract.tokens_hw=[56,56]"),
        ("extract", "--dense --half", "extract.dense=true extract.half=true"),
        ("run", "x --cutoff 2.0 --method.n 512", "x holdout.cutoff=2.0 method.n=512"),
        ("run", "--multirun method=map,paper --cfg job", "--multirun method=map,paper --cfg=job"),
        ("recover", "x --mesh --minutes null", "x mesh=true minutes=null"),
    ],
)  # fmt: skip
def test_options_and_overrides_are_the_same(name, typed, expected):
    assert overrides(name, *typed.split()) == expected.split()


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["complete", "x", "--size"], ["--size: found no value", "expected --size VALUE"]),
        (["complete", "x", "--max-frame", "3"], ["--max-frame", "(did you mean --max-frames?)"]),
        (["complete", "x", "--no-size"], ["--no-size", "unknown option"]),
        (["/nope/room.r3d"], ["/nope/room.r3d: no such file or folder"]),
        (["./captures/kitchen"], ["./captures/kitchen: no such file or folder", "did you mean captures/kitchn?"]),
        (["kitchn.r3d"], ["kitchn.r3d: no such file or folder"]),
        (["capturs"], ["capturs: no such file or folder (did you mean captures?)"]),
        (["inspec", "captures"], ["inspec: found an unknown argument (did you mean inspect?)"]),
        (["compleet", "--help"], ["compleet: found an unknown argument (did you mean complete?)"]),
        (["help", "recovr"], ["recovr: found an unknown argument (did you mean recover?)"]),
        (["inspect", "captures", "--cfg", "job"], ["--cfg: found an unknown option, expected one listed by --help"]),
        (["inspect", "captures", "fow=63"], ["fow: found an unknown option (did you mean fov?)"]),
        (["inspect", "captures", "data.fow=63"], ["data.fow: found an unknown option (did you mean data.fov?)"]),
        (["inspect", "captures", "max_frame=3"], ["max_frame: found an unknown option (did you mean max_frames?)"]),
        (["inspect", "captures", "-x"], ["-x: found an unknown flag"]),
        (["report", "captures", "htlm=x.html"], ["htlm: found an unknown option (did you mean html?)"]),
    ],
)
def test_a_slip_has_one_line_with_the_nearest_name(command, tmp_path, argv, words):
    (tmp_path / "captures" / "kitchn").mkdir(parents=True)
    code, out, err = command(*argv)
    (line,) = err.strip().splitlines()
    assert code == 2 and not out and line.startswith("dhtorch: ")
    for word in words:
        assert word in line, line


def test_a_path_that_does_not_exist_is_one_line_before_torch_is_loaded(tmp_path):
    """Every positional argument that is read, of every command; `source` of pin may be a camera's number."""
    read = {"": 1, "enrich": 1, "scale": 2, "pin": 2} | dict.fromkeys(
        (
            "recover",
            "inspect",
            "view",
            "complete",
            "extract",
            "integrate",
            "stream",
            "validate",
            "align",
            "run",
            "report",
        ),
        1,
    )
    assert {*COMMANDS} - {*read} == {"demo", "fetch"}
    lines = [[*filter(None, [name]), *["."] * k, "no/such.r3d"] for name, n in read.items() for k in range(n)]
    code = f"import sys\nfrom dhtorch.cli import run\nprint([run.main(words) for words in {lines}], 'torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.split("]") == [str([2] * len(lines))[:-1], " False\n"]
    told = done.stderr.splitlines()
    assert len(told) == len(lines) and all(t.startswith("dhtorch: no/such.r3d: no such file or folder") for t in told)


@pytest.mark.parametrize("words", [[], ["help"], ["--help"], ["-q"]])
def test_the_bare_command_prints_help(command, words):
    assert command(*words)[:2] == (0, commands.format_overview(run.EXIT_CODES) + "\n")


@pytest.mark.parametrize("words", [["help", "complete"], ["--help", "complete"]])
def test_help_of_a_command_is_typed_before_it_as_well(command, words):
    assert command(*words) == command("complete", "--help")


@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in ("inspect", "report", "fetch")])
def test_a_device_that_torch_cannot_use_is_one_line(command, monkeypatch, name):
    words = {
        "recover": ["recover", "."],
        "align": ["align", ".", "depth=.", "out=o"],
        "complete": ["complete", ".", "out=o"],
        "scale": ["scale", ".", "."],
        "pin": ["pin", ".", "."],
    }
    words |= {
        "enrich": ["enrich", ".", "o"],
        "extract": ["extract", "data=synthetic", "out=o"],
        "demo": ["demo", "--no-browser"],
    }
    monkeypatch.setattr(demo, "write_demo_capture", lambda folder: (folder, folder))
    code, _, err = command(
        *words.get(name, [name, *TINY] if name == "run" else [name, "data=synthetic"]), "--device", "cuda:7"
    )
    (line,) = err.strip().splitlines()
    assert code == 2 and line.startswith("dhtorch: device: found 'cuda:7', expected cpu"), line


@pytest.mark.parametrize(
    ("name", "arguments"), [(name, example) for name, each in COMMANDS.items() for example, _ in each.examples]
)
def test_examples_of_the_help_are_accepted(command, monkeypatch, tmp_path, name, arguments):
    """Every example is parsed, composed and checked as printed; its computation is replaced by a record of the call."""
    called = []
    record = SimpleNamespace(run=lambda *_, **__: called.append(name), main=lambda _: called.append(name))
    monkeypatch.setattr(run, "importlib", SimpleNamespace(import_module=lambda _: record))
    monkeypatch.setattr(run, "_instantiate_parts", lambda *_: {})
    monkeypatch.setattr(run, "_run_single", lambda *_: called.append(name) or 0)
    monkeypatch.setattr(run, "_run_sweep", lambda *_, **__: called.append(name) or 0)
    monkeypatch.setattr(demo, "write_demo_capture", lambda _: (tmp_path / "PATH", tmp_path / "out"))
    monkeypatch.setattr(demo, "open_page", lambda *_, **__: None)
    for folder in (
        "PATH",
        "SRC",
        "MODEL",
        "CAPTURE",
        "REF",
        "SET",
        "picture.png",
        "RESULT",
        "outputs/2026-01-31/12-00-00",
    ):
        (tmp_path / folder).mkdir(parents=True)
    code, _, err = command(*(["recover"] if name == "recover" else [name]), *shlex.split(arguments))
    assert code == 0 and called == [name], err


@pytest.mark.parametrize(
    ("name", "typed", "expected"),
    [
        ("inspect", "x --fov 63 --max-frames 3", "x --max-frames=3 data.fov=63"),
        ("inspect", "--fov=63 x max_frames=3", "x --max-frames=3 data.fov=63"),
        ("inspect", "fov=63 K=1,2,3,4 x", "x data.fov=63 data.K=1,2,3,4"),
        ("inspect", "data.fov=63 x --data.fps 30 --depth-lag -1", "x data.fov=63 data.fps=30 data.depth_lag=-1"),
        ("inspect", "x --follow-links --camera a,b", "x data.follow_links=true data.camera=a,b"),
        ("inspect", "x format=tum --no-traceback depth_unit=mm", "x --format=tum data.depth_unit=mm"),
        ("report", "x html=-a.html", "x --html=-a.html"),
        ("fetch", "shared_scenes --yes --out d", "shared_scenes --yes --out=d"),
    ],
)
def test_commands_with_a_parser_of_their_own_have_the_same_grammar(command, monkeypatch, name, typed, expected):
    seen = []
    monkeypatch.setattr(run, "importlib", SimpleNamespace(import_module=lambda _: SimpleNamespace(main=seen.append)))
    Path("x").mkdir()
    assert command(name, *typed.split()) == (0, "", "") and seen == [expected.split()]


def test_every_option_that_a_message_of_inspect_names_can_be_typed(command, monkeypatch):
    """Options of readers in the texts of all modules that read, check or show a capture."""
    folders = [Path(dhtorch.__file__).parent / name for name in ("data", "validation", "cli/inspect.py")]
    files = [file for folder in folders for file in (folder.rglob("*.py") if folder.is_dir() else [folder])]
    names = {name for file in files for name in re.findall(r"\bdata\.(\w+)=", file.read_text())} - {"NAME"}
    assert {"K", "fov", "K_depth", "depth_unit", "depth_turn", "pose_convention", "camera", "trajectory"} <= names
    seen = []
    monkeypatch.setattr(run, "importlib", SimpleNamespace(import_module=lambda _: SimpleNamespace(main=seen.append)))
    typed = [f"data.{name}=1" for name in sorted(names)]
    assert command("inspect", ".", *typed) == (0, "", "") and seen == [[".", *typed]]


def test_everything_is_shown_on_request(command):
    code, out, _ = command("complete", "--help-all")
    assert code == 0 and "min_correlation: 0.75" in out and "method: auto, " in out and "_target_" in out
    code, out, _ = command("complete", "x", "--cfg", "job", "--out", "d", "--size", "96")
    assert code == 0 and "root: x" in out and "size: 96" in out


SMALL_DEMO = ["--max-frames", "1", "--size", "64", "--method.n", "256", "--no-browser"]


@pytest.mark.slow
def test_the_demo_goes_the_whole_way(command, monkeypatch, tmp_path):
    monkeypatch.setattr(demo, "_IMAGE_HW", (96, 128))
    monkeypatch.setattr(demo, "_N_FRAMES", 4)
    code, out, err = command("demo", *SMALL_DEMO, "--out", "d")
    assert code == 0 and not err
    page = tmp_path / "d" / "result" / "view.html"
    assert page.is_file() and out.splitlines()[-1] == f"Open {page.as_uri()}"
    glb = (page.parent / "map.glb").read_bytes()
    chunk = json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")])
    position = chunk["accessors"][chunk["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    heights = read_ply_vertices(page.parent / "map.ply").vertex["y"]
    for low, high in ((heights.min(), heights.max()), (position["min"][1], position["max"][1])):
        assert -0.2 < low < 0.2 and 1.5 < high < 2.8, "the floor at height 0, the ceiling above it"
    assert command("demo", *SMALL_DEMO, "--out", "d")[0] == 0, "the capture is used again"
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("notes")
    code, _, err = command("demo", "--out", "mine")
    assert code == 2 and "has other content" in err


def next_command(out):
    (line,) = [line for line in out.splitlines() if line.startswith("Next: ")]
    return shlex.split(line.partition("dhtorch ")[2])


@pytest.mark.slow
def test_the_printed_next_command_runs(command, tmp_path):
    """The way of a phone scan, with a name beyond ASCII: the map is written and the printed command measures the error."""
    name = "it's küche 寝室"
    room = SyntheticRoom(n_frames=4, hw=(120, 160), depth_hw=(120, 160), step_m=0.05)
    writers.write_tum(tmp_path / name, [room[k] for k in range(4)])
    code, out, err = command(name, "--max-frames", "2", "--size", "96", "--method.n", "512")
    assert code == 0, err
    header = (tmp_path / "dhtorch_out" / name / "map.ply").read_bytes().partition(b"end_header")[0]
    assert header.isascii() and b"vertex" in header
    words = next_command(out)
    assert words[:2] == ["run", name]
    code, out, err = command(*words, "figures=false")
    assert code == 0 and re.search(r"coverage|answered", out), err


@pytest.mark.slow
def test_the_next_command_has_the_reader_options_of_this_one(command, tmp_path):
    room = SyntheticRoom(n_frames=3, hw=(120, 160), depth_hw=(120, 160), step_m=0.05)
    writers.write_counted_frames(tmp_path / "above" / "capture", [room[k] for k in range(3)])
    (tmp_path / "above" / "capture" / "K.txt").unlink(missing_ok=True)
    code, out, err = command("above", "--max-frames", "1", "--size", "96", "--method.n", "512", "--fov", "60")
    assert code == 0, err
    words = next_command(out)
    assert words[:2] == ["run", "above/capture"] and "data.fov=60" in words
    assert command(*words, "figures=false")[0] == 0


def test_the_cutoff_lies_among_the_returns(monkeypatch):
    import numpy as np  # noqa: PLC0415

    from dhtorch.codes import Source  # noqa: PLC0415

    for depth in (0.9531, 1.0, 104.2, 9.96, 0.0123):
        maps = {"depth": np.full((4, 4), depth)}, np.full((4, 4), int(Source.SENSOR))
        monkeypatch.setattr(process_capture.completed, "read_completed_maps", lambda *_, maps=maps: maps)
        cutoff = process_capture._choose_cutoff(SimpleNamespace(task=None, frames=[0]))
        assert depth <= float(f"{cutoff:g}") < 1.11 * depth, depth


def test_every_command_computes_with_the_threads_of_its_settings(command, monkeypatch, tmp_path):
    """Commands without the option have one: beside other work torch's further threads spin."""
    torch = pytest.importorskip("torch")
    seen, before = [], torch.get_num_threads()
    record = SimpleNamespace(
        run=lambda *_, **__: seen.append(torch.get_num_threads()), main=lambda _: seen.append(torch.get_num_threads())
    )
    monkeypatch.setattr(run, "importlib", SimpleNamespace(import_module=lambda _: record))
    monkeypatch.setattr(
        demo, "write_demo_capture", lambda _: seen.append(torch.get_num_threads()) or (tmp_path, tmp_path / "out")
    )
    monkeypatch.setattr(demo, "open_page", lambda *_, **__: None)
    try:
        for words in (["inspect", "."], ["report", "."], ["stream", "data=synthetic"], ["demo"]):
            torch.set_num_threads(2)
            assert command(*words)[0] == 0
        assert seen == [1] * 5
        assert command("stream", "data=synthetic", "threads=2")[0] == 0 and seen[5:] == [2]
    finally:
        torch.set_num_threads(before)


def test_a_list_of_settings_files_is_read(tmp_path):
    file = tmp_path / "x.yaml"
    file.write_text("defaults:\n  - method: map\na: 1 # one\nb:\n  c: [1, 2] # two\nd: null\nhydra:\n  e: 3\n")
    notes = commands.read_option_notes(file)
    assert notes["a"] == ("1", "one") and notes["b.c"] == ("[1, 2]", "two") and notes["d"] == ("null", "")
    assert notes["method"].default == "map" and not any("e" in name.split(".") for name in notes)


@pytest.mark.parametrize("words", [["~method@experiment.methods.kornia"], ["+seed=1"], ["-m", "seed=1"]])
def test_deletions_and_additions_of_hydra_are_no_paths(words):
    assert run._name_positionals("run", words) == words
    assert run._name_positionals("run", ["~/room.r3d", *words]) == ["data=auto", "data.root='~/room.r3d'", *words]


@pytest.mark.slow
@pytest.mark.parametrize("flags", [["--cfg", "job"], ["-c", "job"], ["--info", "defaults-tree"]])
def test_hydra_s_own_flags_go_with_deletions(command, flags):
    argv = ["experiment=method_comparison", "~method@experiment.methods.kornia", *flags, "experiment.seeds=1"]
    handlers = list(logging.getLogger().handlers)
    code, out, err = command("run", *argv)
    assert code == 0, err
    assert logging.getLogger().handlers == handlers, "a later job of the process would write to a closed stream"
    assert not re.search(r"^ +kornia:", out, re.M)
