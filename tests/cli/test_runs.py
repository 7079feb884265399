"""Whole runs of the command: files and printed text of a job, verbosity, progress, signals, sweeps, the demo; what is finished
stays, what is not is done, whatever stopped it, and one failing job stops no other."""

import csv
import errno
import io
import json
import logging
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import warnings
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import hydra
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from support import writers
from support.processes import start, stop
from support.tiny_runs import ROOM, TINY

from dhtorch.cli import inspect as capture
from dhtorch.cli import job, process_capture, run
from dhtorch.cli.run import config_dir, job_name
from dhtorch.codes import Source
from dhtorch.data.pairs import by_gap
from dhtorch.data.scene import Scene
from dhtorch.experiments import protocol
from dhtorch.experiments.finished_scenes import FinishedScenes
from dhtorch.experiments.outcome import DEPTH_METRICS, Outcome
from dhtorch.experiments.paper import hole_census
from dhtorch.experiments.report import advice, jobs, page
from dhtorch.pipeline.presets import METHODS
from dhtorch.runtime import console, storage
from dhtorch.runtime import results as result_files
from dhtorch.runtime.output_folder import is_private, open_output_file
from dhtorch.runtime.ply import read_ply_vertices
from dhtorch.synthetic import recording
from dhtorch.synthetic import recording as rooms
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.viz.viewer import html

#: What Windows refuses in a name, and the names that it keeps for itself.
REFUSED = re.compile(r'[<>:"|?*\\\x00-\x1f]|[. ]$')
RESERVED = {"con", "prn", "aux", "nul", *(f"{d}{k}" for d in ("com", "lpt") for k in range(10))}
CALL = "import json, sys; from dhtorch.cli.run import main; print('\\x00', [main(a) for a in json.loads(sys.argv[1])])"


def small_room(n=3, **options):
    return SyntheticRoom(**{"hw": (60, 80), "n_frames": n, "lidar": "exact", "supersample": 1, **options})


def process(folder, *calls, **options):
    """The command once for each of the calls, in one process of its own."""
    env = {k: v for k, v in os.environ.items() if k not in ("DHTORCH_DATA", console._VERBOSITY_VARIABLE)}
    call = [sys.executable, "-c", CALL, json.dumps(calls)]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    return subprocess.run(call, cwd=folder, env=env, text=True, timeout=550, check=False, **options)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Two small captures side by side."""
    folder = tmp_path_factory.mktemp("captures")
    for name in ("one", "two"):
        writers.write_counted_frames(folder / name, list(small_room()))
    return folder


@pytest.fixture(scope="module")
def ran(frames, tmp_path_factory):
    """Every command once, in one process of its own from an empty folder: the folder, and how the process ended."""
    folder = tmp_path_factory.mktemp("words")
    calls = [
        ["data.hw=[120,160]", "data.n_frames=3", "pairs.gap=2", "method.n=1024", "output=job"],
        ["inspect", str(frames / "one"), "--out", "sheets"],
        ["report", "job"],
        ["report", "job", "--markdown"],
        ["report", "job", "--html", "page.html"],
        ["integrate", *ROOM, "voxel=0.1", "mesh=false", "output=map"],
        ["extract", *ROOM[:-1], "data.gap=2", "extract.tokens_hw=[56,70]", "out=features"],
        ["view", "job", "html=view.html"],
    ]
    return folder, process(folder, *calls)


@pytest.mark.slow
@pytest.mark.timeout(600)  # seconds of work, but a busy machine stretches them
def test_a_run_of_any_command_prints_no_warning_and_files_have_names_for_every_system(ran):
    folder, done = ran
    assert done.stderr == "" and done.stdout.partition("\x00")[2].strip() == str([0] * 8)
    names = {part for p in folder.rglob("*") for part in p.relative_to(folder).parts}
    assert len(names) >= 15
    for name in names:
        assert not REFUSED.search(name) and name.split(".")[0].lower() not in RESERVED, name
    for text in ("data.root=C:\\data\\x,seed=1", "a=b|c", "k='x y'", "x=1.", "data.root=/a/b:c", "q=*?<>"):
        assert not REFUSED.search(run.job_name(text)), run.job_name(text)


@pytest.mark.slow
def test_one_job_writes_one_result_its_figures_and_points(ran):
    folder, done = ran
    job = folder / "job"
    result = result_files.read_result(job)
    assert result["experiment"] == "pair" and result["data"]["n_pairs"] == 1
    assert {p.name for p in job.rglob("*") if p.is_file()} == {
        "manifest", "result.json", "completed.png", "samples.png", "holes.png", "depth.png", "risk_coverage.png", "points.ply",
    }  # fmt: skip
    words = ("coverage", "median", "p90", "corr", "residual", "pose found", f"wrote {job / 'result.json'}", "| scene")
    assert all(word in done.stdout for word in words), done.stdout
    others = [p.stat().st_mtime_ns for p in job.rglob("*.*") if p.name != "result.json" and p.is_file()]
    assert (job / "result.json").stat().st_mtime_ns >= max(others), "written last: with it the job is whole"
    assert [r["pair"] for r in result["rows"]] == [[0, 2], None]
    names = {"coverage", "median_rel", "p90_rel", "corr", "residual_px", "pnp_success", "aurc", "ece"}
    text = (job / "result.json").read_text()
    assert names <= set(result["summary"]) and str(Path.home()) not in text and str(folder) not in text
    points = read_ply_vertices(next(job.rglob("points.ply"))).vertex
    assert len(points) > 50 and set(points["source"]) <= {1, 2} and 1 in points["source"]
    assert (points["z"] > 0.2).all() and (points["z"] < 50).all()
    assert points.dtype.names == (*"xyz", "red", "green", "blue", "sigma", "score", "class", "source", "quality")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="pipes end otherwise there")
def test_a_reader_that_leaves_is_no_error(ran):
    code = "import sys; from dhtorch.cli.run import main; sys.exit(main(['report', 'job', '--markdown']))"
    read, write = os.pipe()
    os.close(read)
    call = [sys.executable, "-c", code]
    done = subprocess.run(call, cwd=ran[0], stdout=write, stderr=subprocess.PIPE, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, b"")


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_broken_file_is_one_line_from_a_worker_too(command, tmp_path, workers):
    writers.write_counted_frames(tmp_path / "set", list(small_room()))
    image = tmp_path / "set" / "images" / "00001.png"
    image.write_bytes(image.read_bytes()[:200])
    words = ["data=auto", f"data.root={tmp_path / 'set'}", "data.gap=1", "data.near=2.0", "figures=false"]
    if workers:
        done = process(tmp_path, [*words, f"workers={workers}"])
        code, err = int(done.stdout.partition("\x00")[2].strip(" []\n")), done.stderr
    else:
        code, _, err = command(*words)
    assert code == 2 and len(err.strip().splitlines()) == 1, err
    assert "00001.png" in err and "Traceback" not in err


@pytest.mark.slow
@pytest.mark.parametrize("pairs", [["pairs=time", "pairs.seconds=0.06"], ["pairs=baseline", "pairs.metres=0.04"]])
def test_pairs_by_time_and_by_baseline(command, tmp_path, pairs):
    code, _, err = command("data.hw=[120,160]", "data.n_frames=3", "method.n=1024", *pairs, "figures=false", "output=o")
    assert code == 0, err
    assert result_files.read_result(tmp_path / "o")["data"]["n_pairs"] >= 1


@pytest.mark.slow
def test_batches_and_workers_give_the_same_rows(tmp_path):
    words = ["data.hw=[120,160]", "data.n_frames=5", "pairs.gap=2", "method.n=1024", "figures=false"]
    process(tmp_path, [*words, "batch=1", "output=0"], [*words, "batch=2", "workers=2", "output=1"])
    rows = [result_files.read_result(tmp_path / str(k))["rows"] for k in range(2)]
    plain = [[{k: v for k, v in row.items() if k != "ms"} for row in each] for each in rows]
    assert plain[0] == plain[1]


# ---------------------------------------------------------------------------------------------------------- verbosity


@pytest.mark.slow
def test_quiet_prints_where_the_result_is_and_verbose_what_is_read(command, tmp_path):
    result, brief = tmp_path / "job" / "result.json", command(*TINY, "output=a")[1]
    for words, ends, out_holds, err_holds in (
        (["-q", *TINY, "output=job", "resume=true"], 0, f"{result}$", "$"),
        (["-v", *TINY, "output=job", "resume=true"], 0, ".*left untouched$", "."),  # verbosity is none of the settings
        (["--quiet", "--multirun", *TINY, "output=sweep", "seed=0,1"], 0, r"\S+result.json\s\S+result.json$", "$"),
        (["view", "job", f"html={tmp_path / 'view.html'}", "-q"], 0, "$", "$"),
        (["-q", *TINY, "pairs.gap=99"], 2, "$", ".*pairs.gap"),
        ([*TINY, "-v", "output=b"], 0, ".*coverage", r"( *\d+ ms  dhtorch\..*\n?)+$"),
        ([*TINY, "output=c"], 0, ".*coverage", "$"),  # the next call is as before
    ):
        code, out, err = command(*words)
        assert code == ends and re.match(out_holds, out.strip(), re.S) and re.match(err_holds, err), (words, out, err)
        if "output=b" in words:
            assert "synthetic_room" in err and "digest" in err and len(out.splitlines()) > len(brief.splitlines())
    assert (tmp_path / "view.html").is_file() and len(brief.splitlines()) <= 15 and "samples by gate" not in brief
    assert not logging.getLogger("dhtorch").handlers and console._VERBOSITY_VARIABLE not in os.environ


class Terminal(io.StringIO):
    """A stream that reports to be a terminal."""

    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("stream", "level", "total", "step_s", "lines"),
    [
        (Terminal, "normal", 5, None, None),
        (Terminal, "quiet", 5, None, []),
        (io.StringIO, "quiet", 5, None, []),
        (io.StringIO, "normal", 5, 5.0, ["2 of 5, 5.0 s each, 0:15 left", "4 of 5, 5.0 s each, 0:05 left"]),
        (io.StringIO, "normal", 3, 7200.0, ["1 of 3, 7200.0 s each, 4:00:00 left", "2 of 3, 7200.0 s each, 2:00:00 left"]),
        (io.StringIO, "normal", 60, 0.5, ["20 of 60, 2.0/s, 0:20 left", "40 of 60, 2.0/s, 0:10 left"]),
        (io.StringIO, "normal", 25, 9.0, [f"{n} of 25, 9.0 s each, {9 * (25 - n) // 60}:{9 * (25 - n) % 60:02d} left" for n in range(2, 25, 2)]),
    ],
)  # fmt: skip
def test_progress_is_a_bar_on_a_terminal_and_a_line_now_and_then_elsewhere(
    monkeypatch, stream, level, total, step_s, lines
):
    """Number done, rate and time left, not after the last item; none with quiet output."""
    if step_s is not None:
        now = iter(step_s * np.arange(total + 1))
        monkeypatch.setattr(console, "time", SimpleNamespace(monotonic=lambda: next(now)))
    monkeypatch.setattr(console, "_LINE_INTERVAL_S", 10.0)
    monkeypatch.setattr(sys, "stderr", shown := stream())
    monkeypatch.setenv(console._VERBOSITY_VARIABLE, level)
    monkeypatch.setenv("TERM", "xterm")
    assert list(console.progress(range(total), "room", total)) == list(range(total))
    said = shown.getvalue()
    assert ("room" in said) if lines is None else said.splitlines() == [f"room: {line}" for line in lines]


EVIL = "a\x1b[31mred\x07\x9b2J\u202ereversed\r"


def test_nothing_that_a_terminal_obeys_is_printed(tmp_path, capsys):
    with console.escape_output(), console.escape_output():
        print(EVIL)
        print(EVIL, file=sys.stderr)
        sys.stdout.writelines(["1\t2\n"])
        assert sys.stdout.encoding and sys.stdout.fileno is not None
    out, err = capsys.readouterr()
    assert out.splitlines()[0] == err.strip() == r"a\x1b[31mred\x07\x9b2J\u202ereversed\x0d" and out.endswith("1\t2\n")
    texts = {"naïve ✓ 深度": "naïve ✓ 深度", "\U000e0001": r"\U000e0001"}
    assert {text: console._escape_control(text) for text in texts} == texts
    folder = tmp_path / EVIL.replace("\r", "")
    folder.mkdir()
    for words in (["inspect", str(folder)], ["report", str(folder)], [f"data.x={EVIL}"]):
        assert run.main(words) == 2
        out, err = capsys.readouterr()
        assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", out + err), words


# ----------------------------------------------------------------------------------------------- signals and full disks


@pytest.mark.parametrize(
    ("number", "before", "code"),
    [
        (signal.SIGTERM, signal.SIG_DFL, 143),
        (signal.SIGHUP, signal.SIG_DFL, 129),
        (signal.SIGINT, signal.default_int_handler, 130),
        (signal.SIGHUP, signal.SIG_IGN, 0),  # as nohup does
    ],
)
def test_a_signal_ends_a_call_in_order(number, before, code, monkeypatch, capsys):
    tidied = []

    def dispatch(_argv):
        try:
            signal.raise_signal(number)
        finally:
            tidied.append(True)
        return 0

    inherited = signal.signal(number, before)
    monkeypatch.setattr(run, "_dispatch", dispatch)
    try:
        assert run.main([]) == code and tidied
        assert ("dhtorch: interrupted" in capsys.readouterr().err) == (code > 0)
        assert signal.getsignal(number) is before
    finally:
        signal.signal(number, inherited)


_PARENT = """
import multiprocessing, sys, time
from dhtorch.runtime.parent_watch import exit_with_parent
def work():
    exit_with_parent()
    exit_with_parent()
    print(multiprocessing.current_process().pid, flush=True)
    time.sleep(60)
if __name__ == "__main__":
    process = multiprocessing.get_context("spawn" if len(sys.argv) > 1 else "fork").Process(target=work)
    process.start()
    process.join()
"""


def test_a_worker_ends_with_a_killed_parent(tmp_path):
    (tmp_path / "parent.py").write_text(_PARENT)
    parent = subprocess.Popen([sys.executable, "parent.py"], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    with parent.stdout:
        worker = int(parent.stdout.readline())
        parent.kill()
        parent.wait()
        end = time.monotonic() + 5
        while Path(f"/proc/{worker}").exists() and time.monotonic() < end:
            time.sleep(0.05)
        assert not Path(f"/proc/{worker}").exists()


def test_a_full_disk_names_the_file(tmp_path, monkeypatch):
    error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(error))
    with pytest.raises(OSError, match=r"No space left on device: '.*x\.json'"):
        storage.write_json(tmp_path / "x.json", {})
    assert not list(tmp_path.iterdir())


def stopping(function, after):
    """The function, and Ctrl-C where it is called once more than ``after`` times."""
    calls = iter(range(after))

    def call(*args, **options):
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return function(*args, **options)

    return call


@pytest.mark.slow
def test_ctrl_c_keeps_contact_sheets_and_the_old_page(command, frames, monkeypatch, ran):
    monkeypatch.setattr(capture, "write_contact_sheet", stopping(capture.write_contact_sheet, 1))
    code, out, err = command("inspect", str(frames), "--out", "sheets")
    assert code == 130 and "1 contact sheet in sheets kept" in err and len(err.strip().splitlines()) == 1
    assert [p.name for p in Path("sheets").glob("*.png")] == [re.search(r"sheets/(\S+png)", out)[1]]
    Path("job").symlink_to(ran[0] / "job")
    with open_output_file("out.html", "html"):
        storage.replace_file("out.html", b"the old one")
    for words, module, name in (
        (["report", "job", "--html", "out.html"], page, "render_report"),
        (["view", "job", "html=out.html"], html, "build_viewer_page"),
    ):
        monkeypatch.setattr(module, name, stopping(getattr(module, name), 0))
        code, _, err = command(*words)
        assert code == 130 and "interrupted" in err and "Traceback" not in err
        assert Path("out.html").read_text(encoding="utf-8") == "the old one"
        assert len(list(Path().glob("*out*"))) == 2, "the page and its manifest"


# ------------------------------------------------------------------------------------------------- the way of a capture


@pytest.mark.slow
def test_the_demo_goes_the_whole_way(command, monkeypatch, tmp_path):
    small = lambda **options: SyntheticRoom(**{**options, "hw": (96, 128), "n_frames": 4})  # noqa: E731
    monkeypatch.setattr(rooms, "SyntheticRoom", small)
    words = ["demo", "--max-frames", "1", "--size", "64", "--method.n", "256", "--no-browser", "--out", "d"]
    code, out, err = command(*words)
    assert code == 0 and not err
    result = tmp_path / "d" / "result"
    assert out.splitlines()[-1] == f"Open {(result / 'view.html').as_uri()}" and (result / "view.html").is_file()
    glb = (result / "map.glb").read_bytes()
    chunk = json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")])
    position = chunk["accessors"][chunk["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    heights = read_ply_vertices(result / "map.ply").vertex["y"]
    for low, high in ((heights.min(), heights.max()), (position["min"][1], position["max"][1])):
        assert -0.2 < low < 0.2 and 1.5 < high < 2.8, "the floor at height 0, the ceiling above it"
    assert command(*words)[0] == 0, "the capture is used again"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "write", "words", "reader"),
    [
        ("it's küche 寝室", writers.write_tum, ["--max-frames", "2"], []),
        ("above", writers.write_counted_frames, ["--max-frames", "1", "--fov", "60"], ["data.fov=60"]),
    ],
)
def test_the_printed_next_command_runs_with_the_reader_options_of_this_one(
    command, tmp_path, path, write, words, reader
):
    """The way of a phone scan: the map is written and the printed command measures the error."""
    place = tmp_path / path / ("capture" if reader else "")
    write(place, list(small_room(4, hw=(120, 160), depth_hw=(120, 160), step_m=0.05, lidar="phone")))
    (place / "K.txt").unlink(missing_ok=True)
    code, out, err = command(path, *words, "--size", "96", "--method.n", "512")
    assert code == 0, err
    header = next((tmp_path / "dhtorch_out").rglob("map.ply")).read_bytes().partition(b"end_header")[0]
    assert header.isascii() and b"vertex" in header
    (line,) = [line for line in out.splitlines() if line.startswith("Next: ")]
    following = shlex.split(line.partition("dhtorch ")[2])
    assert following[:2] == ["run", f"{path}/capture" if reader else path] and {*reader} <= {*following}
    code, out, err = command(*following, "figures=false")
    assert code == 0 and re.search(r"coverage|answered", out), err


@pytest.mark.parametrize(
    ("depths", "low", "high"),
    [
        *(([[depth] * 3], depth, 1.11 * depth) for depth in (0.9531, 1.0, 104.2, 9.96, 0.0123)),
        ([[1.0, 1.23, 9.0], [2.0, 1.25, 0.0], [0.0, 0.0, 0.0]], 1.5, 1.5),  # of 1.23 and 1.625
        ([[0.0]], 2.0, 2.0),
    ],
)
def test_the_printed_cutoff_lies_among_the_returns(monkeypatch, depths, low, high):
    maps = lambda _, i: ({"depth": np.array(depths[i])}, np.full(len(depths[i]), int(Source.SENSOR)))  # noqa: E731
    monkeypatch.setattr(process_capture.complete, "read_completed_maps", maps)
    settings = {"data": {"fov": 60, "K": None, "camera": ["a"]}, "path": "x", "reader_format": "tum"}
    task, frames = SimpleNamespace(settings=settings, scene=SimpleNamespace(name="x")), list(range(len(depths)))
    line = process_capture._format_next_step(process_capture._RecoveredFrames(task, frames, {}, 0), "a.html")
    words, _, cutoff = line.rpartition(" --cutoff ")
    assert words.endswith("dhtorch run x data.fov=60 'data.camera=[a]' data.format=tum")
    assert low <= float(cutoff) <= high


# -------------------------------------------------------------------------------------------------------------- sweeps


@pytest.mark.slow
def test_a_sweep_ends_with_one_table_and_its_file(command, tmp_path):
    code, out, _ = command("-m", *ROOM[:-1], "figures=false", "pairs.gap=1,2", "method.n=256", "output=a=b")
    assert code == 0
    with (tmp_path / "a=b/sweep.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [r["pairs.gap"] for r in rows] == ["1", "2"]
    columns = [name for name in rows[0] if name != "note"]  # of jobs without values
    assert columns == ["pairs.gap", *(metric.name for metric in DEPTH_METRICS)]
    (at,) = [k for k, line in enumerate(out.splitlines()) if re.match(r"\s*pairs.gap\s+coverage\s+median\s+p90", line)]
    assert len(out.splitlines()) - at < 12
    code, out, _ = command("report", "a=b")
    assert code == 0 and "pairs.gap" in out and "truth dropped" not in out
    assert command("report", "a=b", "--html", "p.html")[0] == 0 and "2 jobs" in (tmp_path / "p.html").read_text()
    results = [result_files.read_result(p) for p in sorted(tmp_path.rglob("result.json"))]
    for k, (coverage, error) in enumerate(((0.5, 0.1), (0.4, 0.05))):
        results[k]["summary"] |= {"coverage": {"value": coverage}, "median_rel": {"value": error}}
    assert {(0, 1), (1, 2)} <= jobs.jobs_table(results).best


@pytest.mark.parametrize(
    ("shares", "word"),
    [
        ({"answer": 0.0, "no_track": 0.9, "residual": 0.1}, "smaller pairs.gap"),
        ({"answer": 0.0, "no_baseline": 0.9, "residual": 0.1}, "larger pairs.gap"),
        ({"answer": 0.3, "no_track": 0.7}, None),
    ],
)
def test_few_answers_come_with_advice(shares, word):
    lines = advice({"rows": [{"scene": "s", "pair": None, "method": "m", "gate_share": shares}]})
    assert lines == [] if word is None else word in lines[0]


SIX = [*TINY, "method=paper,opencv", "seed=0,1,2"]
LAUNCHERS = {
    "basic": None,
    "joblib": "hydra_joblib_launcher",
    "submitit_local": "hydra_submitit_launcher",
    "submitit_slurm": "hydra_submitit_launcher",
    "ray": "hydra_ray_launcher",
}


def results(folder):
    """Files of finished jobs; folders may go while they are looked for."""
    return sorted(Path(place, name) for place, _, names in os.walk(folder) for name in names if name == "result.json")


def seen(paths):
    """What must not change: bytes, inode and time of change."""
    return {p: (p.read_bytes(), p.stat().st_ino, p.stat().st_mtime_ns) for p in paths}


def asked(path):
    result = result_files.read_result(path)
    return next(r["method"] for r in result["rows"]), result["config"]["seed"]


@pytest.mark.slow
def test_kill_9_in_the_middle_of_a_sweep_loses_and_doubles_nothing(tmp_path):
    sweep = ["-m", "resume=true", "output=sweep", *SIX]
    code = stop(start(tmp_path, *sweep), partial(results, tmp_path), 2, signal.SIGKILL)
    assert code == -signal.SIGKILL
    before = seen(results(tmp_path))
    assert 2 <= len(before) < 6
    torn, *_ = before
    left = torn.parent / ".dhtorch" / "unfinished" / "0.json"  # as if the kill had come while a file was written
    left.parent.mkdir(exist_ok=True)
    left.write_text("{")
    torn.write_text(torn.read_text()[:300])  # as a file system leaves it that loses the end of a file
    del before[torn]

    again = start(tmp_path, *sweep)
    assert again.wait(200) == 0, (tmp_path / "err").read_text()
    after = results(tmp_path)
    combinations = [asked(p) for p in after]
    assert sorted(combinations) == [(m, s) for m in ("opencv", "paper") for s in range(3)], "none lost, none doubled"
    assert len({result_files.read_result(p)["key"] for p in after}) == 6
    assert seen(before) == before, "what was finished is untouched"
    files = {p.name for p in tmp_path.joinpath("sweep").rglob("*") if p.is_file() and not is_private(p)}
    assert files == {"result.json", "multirun.yaml", "sweep.csv"} and not left.exists()
    n = len(before)
    assert f"6 jobs: {6 - n} finished, {n} left untouched, 0 failed" in (tmp_path / "out").read_text()


@pytest.mark.slow
def test_an_interrupted_sweep_says_how_to_go_on(tmp_path, command, monkeypatch):
    real, calls = job.run, []

    def interrupted(*args, **options):
        calls.append(1)
        if len(calls) == 3:
            signal.raise_signal(signal.SIGINT)
        return real(*args, **options)

    monkeypatch.setattr(job, "run", interrupted)
    code, _, err = command("-m", *SIX)
    assert code == 130 and "Traceback" not in err and "interrupted" in err
    before = seen(results(tmp_path))
    assert len(before) == 2
    for path in before:
        config = result_files.read_result(path)["config"]
        assert "output" not in config and "hydra" not in config
    program, *words = shlex.split(err.strip().splitlines()[-1])
    assert program == "dhtorch"
    code, out, err = command(*words)
    assert code == 0 and "6 jobs: 4 finished, 2 left untouched, 0 failed" in out, err
    assert seen(before) == before and len({asked(p) for p in results(tmp_path)}) == len(results(tmp_path)) == 6


def test_an_interrupted_job_writes_nothing(tmp_path, command, monkeypatch):
    monkeypatch.setattr(result_files, "write_result", lambda *_: signal.raise_signal(signal.SIGINT))
    code, _, err = command(*TINY)
    assert code == 130 and "resume=true output=outputs/" in err and not results(tmp_path)


def test_an_unforeseen_error_is_one_failed_job(command, monkeypatch):
    monkeypatch.setattr(job, "run", lambda *_, **__: 1 / 0)
    code, out, err = command("-m", *TINY, "seed=0,1")
    assert code == 1 and "0 finished, 0 left untouched, 2 failed" in out
    assert "Traceback" in err and "failed: seed=0: ZeroDivisionError: division by zero" in err


@pytest.mark.slow
def test_a_finished_job_is_done_again_where_it_is_another_question(command, tmp_path):
    """Words behind ``resume=true``, what is printed, and the number of results; the data are changed in between."""
    room = SyntheticRoom(hw=(60, 80), n_frames=3, supersample=1, lidar="exact")
    for name in ("set", "sets/set", "changed/set"):
        writers.write_counted_frames(tmp_path / name, list(room))
    image = next((tmp_path / "changed").rglob("*.png"))
    image.write_bytes(image.read_bytes() + b"\0")
    small = ["pairs.gap=2", "method.n=256", "figures=false"]
    of = lambda root: ["data=auto", f"data.root={tmp_path / root}", *small, "output=there"]  # noqa: E731
    for words, said, n in (
        (TINY, "wrote", 1),
        ([*TINY, "batch=1"], "wrote", 2),  # in a folder of its own
        ([*TINY, "traceback=true", "workers=0"], "left untouched", 2),
        ([*TINY, "seed=1"], "wrote", 3),
        ([*TINY, "output=here"], "wrote", 4),
        ([*TINY, "output=here", "holdout.truth=raw"], "wrote", 4),
        ([*TINY, "output=here", "data.depth_noise=2"], "wrote", 4),
        (of("set"), "wrote", 5),
        (of("sets/set"), "left untouched", 5),
        (of("changed/set"), "wrote", 5),
    ):
        code, out, err = command("resume=true", *words)
        assert code == 0 and said in out and len(results(tmp_path)) == n, (words, out, err)
    assert {p.relative_to(tmp_path).parts[0] for p in results(tmp_path)} == {"outputs", "here", "there"}
    result = result_files.read_result(tmp_path / "there")
    assert result["config"]["data"]["root"] == "set", "no place of this machine"
    files = result_files.list_files_below([(tmp_path / "changed/set", None)])
    assert result["data"]["digest"] == result_files.compute_data_digest(files)


@pytest.mark.slow
@pytest.mark.parametrize("launch", [[], ["launch=joblib", "hydra.launcher.n_jobs=2"]])
def test_a_failing_job_stops_no_other_and_any_launcher_resumes_them(command, tmp_path, launch):
    if launch:
        pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    sweep = ["-m", "resume=true", *TINY, "pairs.gap=2,9,1"]
    assert start(tmp_path, *sweep, *launch).wait(200) == 1
    err = (tmp_path / "err").read_text()
    assert "3 jobs: 2 finished, 0 left untouched, 1 failed" in (tmp_path / "out").read_text()
    assert "failed: pairs.gap=9: pairs.gap: found 9" in err and "Traceback" not in err and "Warning" not in err
    before = seen(results(tmp_path))
    assert len(before) == 2 and all("resumed" in str(p) for p in before)
    assert not list(tmp_path.rglob("*gap=9*")), "no empty folder of the failed job"
    code, out, _ = command(*sweep)
    assert code == 1 and "3 jobs: 0 finished, 2 left untouched, 1 failed" in out and seen(before) == before


def test_a_broken_launcher_says_how_to_go_on(command, monkeypatch):
    def die(*_args):
        raise RuntimeError("a worker process was killed")

    monkeypatch.setattr("hydra._internal.hydra.Hydra.multirun", die)
    code, out, err = command("-m", *TINY, "seed=0,1")
    assert code == 1 and out == "" and "a worker process was killed" in err
    assert "Finished jobs are kept. To run the rest:\n  dhtorch " in err
    words = shlex.split(err.strip().splitlines()[-1])
    assert {"-m", "resume=true", "seed=0,1", *TINY} <= set(words) and any(w.startswith("output=") for w in words)


@pytest.mark.parametrize("name", [p.stem for p in (config_dir() / "launch").glob("*.yaml")])
def test_launchers_compose(name):
    plugin = f"hydra_plugins.{LAUNCHERS[name]}" if LAUNCHERS[name] else "hydra"
    pytest.importorskip(plugin)
    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3", job_name="dhtorch"):
        cfg = hydra.compose("run", [f"launch={name}", "output=x"], return_hydra_config=True)
    launcher = OmegaConf.to_container(cfg.hydra.launcher, resolve=True)
    own = OmegaConf.to_container(OmegaConf.load(config_dir() / "launch" / f"{name}.yaml"))
    wanted = own.get("hydra", {}).get("launcher", {})
    assert launcher["_target_"].startswith(f"{plugin}.") and launcher | wanted == launcher and "launch" not in cfg


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(st.lists(st.text(min_size=1), min_size=2, max_size=2, unique=True))
def test_names_of_jobs_are_safe_short_and_different(texts):
    names = [job_name(t) for t in texts]
    assert names[0] != names[1]
    for name in names:
        assert re.fullmatch(r"[\w.,=+~@-]{1,120}", name, re.ASCII) and name not in (".", "..")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("method=paper,seed=0", "method=paper,seed=0"),
        ("", "defaults"),
        ("data.hw=[120,160],seed=0", "data.hw=120,160,seed=0-"),
        ("data.root=/sets/tum", "data.root=tum"),
    ],
)
def test_names_of_jobs_can_be_read(monkeypatch, text, name):
    monkeypatch.setenv("DHTORCH_DATA", "/sets/")
    assert job_name(text)[: len(name)] == name and len(job_name(text)) == len(name) + 8 * name.endswith("-")


@pytest.mark.parametrize("asked", [[], ["always"]])
def test_only_our_own_warnings_are_seen(monkeypatch, asked):
    monkeypatch.setattr(sys, "warnoptions", asked)
    modules = ["torch.nn", "hydra.main", "dhtorchy", "dhtorch.pipeline.pair"]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with console.show_warnings_in_a_line():
            for module in modules:
                warnings.warn_explicit("careful", UserWarning, f"{module}.py", 1, module=module)
    assert [Path(w.filename).stem for w in caught] == (modules if asked else ["dhtorch.pipeline.pair"])


ROOMS = ["data=synthetic_seeds", "pairs=gap", "pairs.gap=2", "method=paper", "method.n=1024", "figures=false"]


@pytest.fixture(scope="module")
def scenes():
    """Three small rooms; the built-in ones of several seeds are larger."""
    small = {"hw": (120, 160), "n_frames": 3, "supersample": 1, "lidar": "exact"}
    rooms = [recording.SyntheticRoom(name=f"room/{k}", seed=k, **small) for k in range(3)]
    return [Scene(room, near=2.0, gap=2) for room in rooms]


@pytest.fixture
def small_rooms(monkeypatch, scenes):
    """The command runs on the small rooms."""
    monkeypatch.setattr(recording, "open_rooms", lambda **_: scenes)


@pytest.fixture
def computed(monkeypatch, small_rooms):
    """Names of the scenes that the loops of pairs compute, and the number of those after which Ctrl-C is pressed."""
    real, state = protocol._run_scene, {"scenes": [], "stop": math.inf}

    def run(scene, *args):
        if len(state["scenes"]) == state["stop"]:
            signal.raise_signal(signal.SIGINT)
        state["scenes"].append(scene.name)
        return real(scene, *args)

    monkeypatch.setattr(protocol, "_run_scene", run)
    return state


def content(folder):
    """All files of a job but for times: the result without milliseconds, pictures and points as they are."""
    files = {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.glob("*") if p.is_file()}
    result = json.loads(files.pop("result.json"))

    def timeless(value):
        if isinstance(value, dict):
            return {k: timeless(v) for k, v in value.items() if k not in ("ms", "utc", "git") and "ms." not in k}
        return [timeless(v) for v in value] if isinstance(value, list) else value

    result["config"].pop("resume")
    return timeless(result), files


def interrupt(command, computed, folder, *options, after):
    computed["scenes"].clear()
    computed["stop"] = after
    code, _, err = command(*ROOMS, *options, f"output={folder}")
    assert code == 130 and "Finished scenes are kept" in err and "resume=true" in err, err
    assert not Path(folder, "result.json").exists()
    kept = list(Path(folder, ".dhtorch", "scenes").rglob("*.pt"))
    assert len(kept) == after, "one file for every scene that was finished"
    computed["scenes"].clear()
    computed["stop"] = math.inf
    return kept


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "loops"),
    [((), 1), pytest.param(("experiment=calibration",), 2, marks=pytest.mark.slow)],
    ids=["pair", "two loops"],
)
def test_the_rest_is_computed_and_the_result_is_that_of_an_uninterrupted_run(
    command, computed, tmp_path, options, loops
):
    assert command(*ROOMS, *options, "output=whole")[0] == 0
    assert any(row.get("median_rel") for row in content(tmp_path / "whole")[0]["rows"]), "there are answers to compare"
    assert len(computed["scenes"]) == 3 * loops
    done = 3 * loops - 1
    interrupt(command, computed, "cut", *options, after=done)
    code, _, err = command(*ROOMS, *options, "resume=true", "output=cut")
    assert code == 0 and len(computed["scenes"]) == 1, err
    assert content(tmp_path / "cut") == content(tmp_path / "whole")
    assert not (tmp_path / "cut" / ".dhtorch" / "scenes").exists(), "nothing is kept beside the result"
    assert command(*ROOMS, *options, "resume=true", "output=cut")[0] == 0 and len(computed["scenes"]) == 1


@pytest.mark.slow
def test_a_damaged_or_foreign_scene_other_settings_and_a_run_without_resume_use_nothing(command, computed):
    first, second = sorted(interrupt(command, computed, "a", after=2))
    shutil.copytree("a", "b")
    shutil.copytree("a", "c")
    first.write_bytes(first.read_bytes()[:-100])
    shutil.copy(first.parent / second.name, first.parent / "x.pt")
    stored = torch.load(second, weights_only=True)
    torch.save({**stored, "identity": (stored["identity"][0], "another scene")}, second)
    for words in (["resume=true", "output=a"], ["method.n=900", "resume=true", "output=b"], ["output=c"]):
        computed["scenes"].clear()
        assert command(*ROOMS, *words)[0] == 0 and len(computed["scenes"]) == 3


@pytest.mark.slow
def test_experiments_with_loops_of_their_own_keep_their_scenes(command, monkeypatch, small_rooms, tmp_path):
    """hole_census has a loop of its own, helix_correlation that of the protocol."""
    for experiment, module, name in (
        ("hole_census", hole_census, "_join_frames"),
        ("helix_correlation", protocol, "_join_rows"),
    ):
        options = [f"experiment={experiment}"]
        assert command(*ROOMS, *options, f"output={experiment}")[0] == 0
        real, calls = getattr(module, name), []

        def stop(*args, real=real, calls=calls):
            calls.append(1)
            if len(calls) == stop.at:
                raise ValueError("data: the disk is gone")
            return real(*args)

        per_scene = 1 if experiment == "hole_census" else 5
        stop.at = 2 * per_scene + 1
        monkeypatch.setattr(module, name, stop)
        code, _, err = command(*ROOMS, *options, f"output={experiment}_cut")
        assert code == 2 and "the disk is gone" in err
        calls.clear()
        stop.at = 0
        assert command(*ROOMS, *options, "resume=true", f"output={experiment}_cut")[0] == 0
        assert len(calls) == per_scene, "one of three scenes"
        assert content(tmp_path / f"{experiment}_cut") == content(tmp_path / experiment)


@pytest.mark.slow
def test_examples_for_figures_are_kept_with_their_method(scenes, tmp_path):
    variants = {"paper": protocol.Variant(METHODS["paper"].replace(n=512))}

    def run():
        settings = protocol.Settings(finished=FinishedScenes(tmp_path / "s", "k" * 64))
        return protocol.run(scenes[:1], protocol.Protocol(variants, min_candidates=0), by_gap, settings)

    (first,), (second,) = (run().examples for _ in range(2))
    assert second.call_options["method"] is variants["paper"].method and second.pair == first.pair
    assert torch.equal(first.frame.image, second.frame.image) and first.cutoff == second.cutoff
    ours, theirs = (
        [e.samples.uv, e.estimate.depth, e.truth.depth, e.call_options["others"].depth] for e in (first, second)
    )
    assert all(torch.equal(a, b) or a.isnan().equal(b.isnan()) for a, b in zip(ours, theirs, strict=True))
    assert first.call_options.keys() == second.call_options.keys()


def test_a_store_reads_no_code_and_follows_no_link(tmp_path):
    store = FinishedScenes(tmp_path / "s", "k" * 64)
    keep = store.loop()
    rows = [{"scene": "a/b", "pair": (0, 1), "method": "m", "x": math.nan, "flag": True, "none": None}]
    assert keep("a/b", lambda: Outcome(rows, n_pairs=2)).rows == rows
    (file,) = (tmp_path / "s").rglob("*.pt")
    again = FinishedScenes(tmp_path / "s", "k" * 64).loop()("a/b", lambda: pytest.fail("computed again"))
    assert repr(again.rows) == repr(rows) and again.n_pairs == 2
    file.write_bytes(b"\x80\x04\x8c\x05posix\x94\x8c\x06system\x94\x93\x94\x8c\x04true\x94\x85\x94R\x94.")
    assert FinishedScenes(tmp_path / "s", "k" * 64).loop()("a/b", lambda: Outcome(n_pairs=7)).n_pairs == 7
    FinishedScenes(tmp_path / "s", "other").loop()
    assert not file.exists(), "scenes of other settings are removed"
