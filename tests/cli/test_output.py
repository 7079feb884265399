"""Output of the command, exit codes, files that it leaves, and support of every operating system."""

import ast
import io
import json
import logging
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support import writers
from support.source_trees import parsed
from support.tiny_runs import ROOM, TINY

import dhtorch
from dhtorch.cli import inspect as capture
from dhtorch.cli.run import EXIT_CODES, config_dir, job_name
from dhtorch.experiments.report import page
from dhtorch.ops import loader
from dhtorch.runtime import console, storage
from dhtorch.runtime.output_folder import open_output_file
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.viz.viewer import html

ROOT = Path(dhtorch.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
#: What Windows refuses in a name, and the names that it keeps for itself.
REFUSED = re.compile(r'[<>:"|?*\\\x00-\x1f]|[. ]$')
RESERVED = {"con", "prn", "aux", "nul", *(f"{d}{k}" for d in ("com", "lpt") for k in range(10))}


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Two small captures side by side."""
    folder = tmp_path_factory.mktemp("captures")
    room = SyntheticRoom(hw=(60, 80), n_frames=3, lidar="exact", supersample=1)
    for name in ("one", "two"):
        writers.write_counted_frames(folder / name, [room[i] for i in range(3)])
    return folder


@pytest.fixture(scope="module")
def said(frames, tmp_path_factory):
    """Every word once, in one process of its own from an empty folder: its exit codes, stdout, stderr and files."""
    folder = tmp_path_factory.mktemp("words")
    calls = [
        [*TINY[:-1], "output=job"],  # with its figures
        ["inspect", str(frames / "one"), "--out", "sheets"],
        ["report", "job"],
        ["report", "job", "--html", "page.html"],
        ["integrate", *ROOM, "voxel=0.1", "mesh=false", "output=map"],
        ["extract", *ROOM[:-1], "data.gap=2", "extract.tokens_hw=[56,70]", "out=features"],
        ["view", "job", "html=view.html"],
    ]
    code = (
        "import json, sys; from dhtorch.cli.run import main; print('\\x00', [main(a) for a in json.loads(sys.argv[1])])"
    )
    env = {k: v for k, v in os.environ.items() if k not in ("DHTORCH_DATA", console._VERBOSITY_VARIABLE)}
    run = [sys.executable, "-c", code, json.dumps(calls)]
    done = subprocess.run(run, cwd=folder, env=env, capture_output=True, text=True, timeout=550, check=False)
    return folder, done


@pytest.mark.slow
@pytest.mark.timeout(600)  # seconds of work, but a busy machine stretches them
def test_a_normal_run_of_any_word_says_nothing_on_stderr(said):
    """Neither progress nor warnings, our own or other libraries'."""
    _, done = said
    assert done.stderr == ""
    assert done.stdout.partition("\x00")[2].strip() == str([0] * 7)


@pytest.mark.slow
def test_files_have_names_that_every_system_takes(said):
    folder, _ = said
    names = {part for p in folder.rglob("*") for part in p.relative_to(folder).parts}
    assert len(names) >= 15
    for name in names:
        assert not REFUSED.search(name) and name.split(".")[0].lower() not in RESERVED, name


def test_folders_of_jobs_have_such_names_whatever_the_options():
    for text in ("data.root=C:\\data\\x,seed=1", "a=b|c", "k='x y'", "x=1.", "data.root=/a/b:c", "q=*?<>"):
        assert not REFUSED.search(job_name(text)), job_name(text)


@pytest.mark.slow
def test_quiet_says_where_the_result_is_and_no_more(command, tmp_path):
    code, out, err = command("-q", *TINY, "output=job")
    assert (code, err) == (0, "") and out.strip() == str(tmp_path / "job" / "result.json")
    code, out, err = command("--quiet", "--multirun", *TINY, "output=sweep", "seed=0,1")
    assert (code, err) == (0, "") and len(out.split()) == 2
    assert all(Path(p).is_file() for p in out.split())
    code, out, err = command("view", "job", f"html={tmp_path / 'view.html'}", "-q")
    assert (code, out, err) == (0, "", "") and (tmp_path / "view.html").is_file()


def test_quiet_is_not_silent_about_errors(command):
    code, out, err = command("-q", *TINY, "pairs.gap=99")
    assert code == 2 and out == "" and "pairs.gap" in err
    code, out, _ = command("-q", "inspect", "nowhere")
    assert code == 2 and out == ""


@pytest.mark.slow
def test_verbose_says_what_is_read_and_done(command):
    code, out, err = command(*TINY, "-v")
    lines = err.strip().splitlines()
    assert code == 0 and "coverage" in out
    assert all(re.match(r" *\d+ ms  dhtorch\.", line) for line in lines), err
    assert any("synthetic_room" in line for line in lines) and any("digest" in line for line in lines)
    assert not logging.getLogger("dhtorch").handlers and console._VERBOSITY_VARIABLE not in os.environ
    assert command(*TINY)[2] == "", "the next call is as before"


@pytest.mark.slow
def test_the_loudness_of_a_job_is_none_of_its_settings(command, tmp_path):
    command("-v", *TINY, "output=job", "resume=true")
    before = (tmp_path / "job/result.json").read_bytes()
    _, out, _ = command("-q", *TINY, "output=job", "resume=true")
    assert (tmp_path / "job/result.json").read_bytes() == before and "result.json" in out


class Terminal(io.StringIO):
    """A stream that reports to be a terminal."""

    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("stream", "level", "drawn"),
    [(Terminal, "normal", True), (Terminal, "quiet", False), (io.StringIO, "normal", False)],
)
def test_progress_is_for_terminals(monkeypatch, stream, level, drawn):
    monkeypatch.setattr(sys, "stderr", shown := stream())
    monkeypatch.setenv(console._VERBOSITY_VARIABLE, level)
    monkeypatch.setenv("TERM", "xterm")
    assert list(console.progress(range(3), "pairs of a room", 3)) == [0, 1, 2]
    assert ("pairs of a room" in shown.getvalue()) == drawn
    assert drawn or shown.getvalue() == ""


def test_progress_is_a_line_now_and_then_elsewhere(monkeypatch):
    """Number done, rate and time left, not after the last item; none with quiet output."""
    now = iter(np.arange(0, 100, 5.0).tolist())
    monkeypatch.setattr(console, "time", SimpleNamespace(monotonic=lambda: next(now)))
    monkeypatch.setattr(console, "_LINE_INTERVAL_S", 10.0)
    for level, lines in (
        ("normal", ["a room: frames: 2 of 5, 5.0 s each, 0:15 left", "a room: frames: 4 of 5, 5.0 s each, 0:05 left"]),
        ("quiet", []),
    ):
        monkeypatch.setenv(console._VERBOSITY_VARIABLE, level)
        monkeypatch.setattr(sys, "stderr", io.StringIO())
        assert list(console.progress(range(5), "a room: frames", 5)) == list(range(5))
        assert sys.stderr.getvalue().splitlines() == lines
    assert console._format_rate(600, 3600, 300) == "2.0/s, 25:00 left" and "2:00:00 left" in console._format_rate(
        1, 2, 7200
    )


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="a terminal is made by a POSIX call")
def test_no_color(tmp_path):
    """On a terminal of its own: a warning in yellow, and without colour where NO_COLOR asks for that."""
    import pty  # noqa: PLC0415  (POSIX alone)

    (tmp_path / "pictures").mkdir()
    room = SyntheticRoom(hw=(60, 80), n_frames=3, lidar="exact", supersample=1)
    writers.write_counted_frames(tmp_path / "set", [room[0]])
    (tmp_path / "set/images/00000.png").rename(tmp_path / "pictures/00000.png")
    (tmp_path / "set/depth/00000.png").rename(tmp_path / "pictures/depth.png")
    code = (
        "import os, sys; from dhtorch.cli.run import main; argv = ['inspect', 'pictures', '--out', 'sheets']; main(argv);"
        "print('=' * 9); os.environ['NO_COLOR'] = '1'; main(argv)"
    )
    mine, theirs = pty.openpty()
    env = {k: v for k, v in os.environ.items() if k != "NO_COLOR"} | {"TERM": "xterm", "COLUMNS": "100"}
    child = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, env=env, stdout=theirs, stderr=theirs)
    os.close(theirs)
    parts = []
    while True:
        try:
            part = os.read(mine, 4096)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        parts.append(part)
    os.close(mine)
    assert child.wait(60) == 0, b"".join(parts)
    coloured, plain = b"".join(parts).decode().split("=" * 9)
    colour = re.compile(r"\x1b\[(?:\d+;)*(?:3[0-7]|9[0-7]|38;)")
    assert colour.search(coloured) and "warning" in plain
    assert not colour.search(plain)


# --------------------------------------------------------------------------------------------------- exit codes, Ctrl-C


@pytest.mark.slow
def test_exit_codes_stand_in_every_help(command):
    _, out, _ = command("--help")
    text = " ".join(out.split())
    for code, words in EXIT_CODES.items():
        assert f"{code} {words}" in text
    for word in ("inspect", "report", "complete", "extract", "integrate", "stream", "view"):
        out = " ".join(command(word, "--help")[1].split())
        assert "Exit code: 0 done, 2 bad option or bad data, 130 interrupted" in out, word


@pytest.mark.slow
def test_exit_codes(command):
    assert command(*TINY, "output=fine")[0] == 0
    assert command("report", "fine")[0] == 0
    assert command("--multirun", *TINY, "pairs.gap=2,99")[0] == 1
    assert command(*TINY, "pairs.gap=99")[0] == 2
    for words in (
        ["inspect"],
        ["report", "fine", "--colour"],
        ["view", "nowhere"],
        ["extract"],
        ["complete", "nowhere", "out=x"],
        ["integrate", "voxel=-1"],
        ["stream", "nowhere"],
    ):
        assert command(*words)[0] == 2, words


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="pipes end otherwise there")
def test_a_reader_that_leaves_is_no_error(said):
    folder, _ = said
    code = "import sys; from dhtorch.cli.run import main; sys.exit(main(['report', 'job', '--markdown']))"
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, stdout=write, stderr=subprocess.PIPE, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, b"")


def stopping(function, after):
    """The function, and Ctrl-C where it is called once more than ``after`` times."""
    calls = iter(range(after))

    def call(*args, **options):
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return function(*args, **options)

    return call


@pytest.mark.slow
def test_ctrl_c_leaves_the_sheets_that_are_written(command, frames, monkeypatch):
    monkeypatch.setattr(capture, "write_contact_sheet", stopping(capture.write_contact_sheet, 1))
    code, out, err = command("inspect", str(frames), "--out", "sheets")
    assert code == 130 and "1 contact sheet in sheets kept" in err and len(err.strip().splitlines()) == 1
    assert [p.name for p in Path("sheets").glob("*.png")] == [re.search(r"sheets/(\S+png)", out)[1]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "module", "name"),
    [
        (["report", "job", "--html", "out.html"], page, "render_report"),
        (["view", "job", "html=out.html"], html, "build_viewer_page"),
    ],
)
def test_ctrl_c_keeps_the_old_page(command, monkeypatch, said, words, module, name):
    Path("job").symlink_to(said[0] / "job")
    with open_output_file("out.html", "html"):
        storage.replace_file("out.html", b"the old one")
    monkeypatch.setattr(module, name, stopping(getattr(module, name), 0))
    code, _, err = command(*words)
    assert code == 130 and "interrupted" in err and "Traceback" not in err
    assert Path("out.html").read_text(encoding="utf-8") == "the old one" and len(list(Path().glob("*out*"))) == 2, (
        "the page and its manifest"
    )


@pytest.mark.parametrize(
    ("switch", "loaded", "operators"),
    [
        ("", [Path("library.so")], f"compiled {loader.level()}"),
        ("0", [], "torch (DHTORCH_OPS=0)"),
        (
            "",
            [],
            "torch, 3 to 9 times slower on the CPU than compiled ones; to compile them: python -m dhtorch.ops (needs a",
        ),
    ],
)
def test_version_is_ours_and_says_what_computes(command, monkeypatch, tmp_path, switch, loaded, operators):
    monkeypatch.setenv("DHTORCH_OPS", switch)
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path))
    for name, value in {"_loaded": loaded, "_tried": [], "INSTALLED": tmp_path}.items():
        monkeypatch.setattr(loader, name, value)
    code, out, err = command("--version")
    assert (code, err) == (0, "") and out.startswith(f"dhtorch {dhtorch.__version__}, operators: {operators}")
    assert len(out.splitlines()) == 1


# ----------------------------------------------------------------------------------------------------------- completion


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("dhtorch meth", {"method=", "method."}),
        ("dhtorch method=", {f"method={p.stem}" for p in (config_dir() / "method").glob("*.yaml")}),
        ("dhtorch method=map experiment=ran", {"experiment=range_split"}),
        ("dhtorch method.track.lev", {"method.track.levels="}),
    ],
)
def test_the_shell_completes_groups_choices_and_options(command, monkeypatch, line, expected):
    monkeypatch.setenv("COMP_LINE", line)
    monkeypatch.setenv("COMP_POINT", str(len(line)))
    code, out, _ = command("-sc", "query=bash")
    assert code == 0 and set(out.split()) == expected


def test_completion_is_installed_as_the_help_says(command):
    assert 'eval "$(dhtorch -sc install=bash)"' in command("--help")[1]
    code, out, _ = command("-sc", "install=bash")
    assert code == 0 and "complete " in out and "hydra_bash_completion" in out


# ---------------------------------------------------------------------------------------------------- Windows and macOS


def nodes(path):
    return ast.walk(parsed(path))


def test_no_module_needs_posix_to_load():
    """Modules and calls that one system lacks stand inside a function, where their absence can be answered."""
    posix = {"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "posix", "syslog"}
    for path in FILES:
        top = [n for n in parsed(path).body if isinstance(n, ast.Import | ast.ImportFrom)]
        names = {a.name for n in top if isinstance(n, ast.Import) for a in n.names}
        names |= {str(n.module) for n in top if isinstance(n, ast.ImportFrom)}
        assert not names & posix, path


def test_no_call_that_windows_lacks():
    lacking = {
        "fork",
        "uname",
        "getuid",
        "geteuid",
        "getpgid",
        "setsid",
        "killpg",
        "mkfifo",
        "wait4",
        "sysconf",
        "chown",
    }
    for path in FILES:
        found = {
            n.attr
            for n in nodes(path)
            if isinstance(n, ast.Attribute)
            and isinstance(n.value, ast.Name)
            and n.value.id == "os"
            and n.attr in lacking
        }
        assert not found, (path, found)


def test_paths_are_not_taken_apart_as_text():
    """``/`` cuts names of recordings, groups and topics, and members of archives, never a path of the system."""
    names_of_ours = {
        "data/codecs/hdf5.py",
        "data/readers/rosbag.py",
        "experiments/probes/learned_score.py",
        "testing/rosbag.py",
    }
    for path in FILES:
        for n in nodes(path):
            if isinstance(n, ast.Constant) and isinstance(n.value, str):
                assert not n.value.startswith(("/tmp", "/dev/", "/home")), (path, n.value)
            cuts = isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute) and n.func.attr in ("split", "rsplit")
            if cuts and n.args and isinstance(n.args[0], ast.Constant) and n.args[0].value == "/":
                assert path.relative_to(ROOT).as_posix() in names_of_ours, (path, n.lineno)


def test_text_files_state_their_encoding():
    """Else Windows reads and writes another one than Linux."""
    for path in FILES:
        for n in nodes(path):
            if not (isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute)):
                continue
            ours = isinstance(n.func.value, ast.Name) and n.func.value.id == "files"
            if n.func.attr in ("read_text", "write_text") and not ours and "/proc/" not in ast.unparse(n):
                assert any(k.arg == "encoding" for k in n.keywords), (path, n.lineno)
