"""The command: a job end to end, clear errors, help. Sweeps and resuming: test_resume.py; the wheel: test_packaging.py."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support import writers

from dhtorch.cli.run import main
from dhtorch.runtime import results as result_files
from dhtorch.synthetic.recording import SyntheticRoom

TINY = ["data.hw=[120,160]", "data.n_frames=3", "pairs.gap=2", "method.n=1024"]


def dhtorch(folder, *args, data=None, timeout=240):
    env = {k: v for k, v in os.environ.items() if k != "DHTORCH_DATA"}
    env |= {"DHTORCH_DATA": str(data)} if data else {}
    command = [sys.executable, "-m", "dhtorch", *args]
    return subprocess.run(command, check=False, cwd=folder, env=env, capture_output=True, text=True, timeout=timeout)


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    folder = tmp_path_factory.mktemp("job")
    done = dhtorch(folder, *TINY)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "", "neither warnings nor a progress bar"
    return folder, done


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """The command in this process, from an empty folder: what needs no process of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DHTORCH_DATA", raising=False)

    def call(*args):
        try:
            code = main(list(args))
        except SystemExit as stop:
            code = stop.code
        out, err = capsys.readouterr()
        return code, out, err

    return call


def results(folder):
    return sorted(folder.rglob("result.json"))


@pytest.mark.slow
def test_one_job_writes_one_result_and_its_pictures(job):
    folder, done = job
    (path,) = results(folder)
    result = result_files.read_result(path)
    assert result["experiment"] == "pair" and result["data"]["n_pairs"] == 1
    assert {p.name for p in path.parent.rglob("*") if p.is_file()} == {
        "manifest", "result.json", "completed.png", "samples.png", "holes.png", "depth.png", "risk_coverage.png", "points.ply",
    }  # fmt: skip
    for word in (
        "coverage",
        "median",
        "p90",
        "corr",
        "residual",
        "pose found",
        "wrote",
    ):
        assert word in done.stdout, word
    assert str(path) in done.stdout
    others = [p.stat().st_mtime_ns for p in path.parent.rglob("*.*") if p != path and p.is_file()]
    assert path.stat().st_mtime_ns >= max(others), "written last: with it the job is whole"
    rows = result["rows"]
    assert [r["pair"] for r in rows] == [[0, 2], None]
    assert {"coverage", "median_rel", "p90_rel", "corr", "residual_px", "pnp_success", "aurc", "ece"} <= set(
        result["summary"]
    )


def test_the_point_cloud_has_sensor_and_recovered_points(job):
    folder, _ = job
    (ply,) = folder.rglob("points.ply")
    head, _, body = ply.read_bytes().partition(b"end_header\n")
    count = int(re.search(rb"element vertex (\d+)", head)[1])
    layout = (
        [(a, "<f4") for a in "xyz"]
        + [(c, "u1") for c in "rgb"]
        + [("sigma", "<f4"), ("score", "<f4"), ("class", "u1"), ("source", "u1"), ("quality", "<f4")]
    )
    points = np.frombuffer(body, layout)
    assert len(points) == count > 50 and set(points["source"]) <= {1, 2} and 1 in points["source"]
    assert (points["z"] > 0.2).all() and (points["z"] < 50).all()


def test_results_do_not_name_the_machine(job):
    (path,) = results(job[0])
    assert str(Path.home()) not in path.read_text() and str(job[0]) not in path.read_text()


def test_report_reads_the_archive(job, command):
    (path,) = results(job[0])
    code, out, _ = command("report", str(path))
    assert not code and "synthetic_room" in out
    code, out, _ = command("report", "--markdown", str(path))
    assert not code and "| scene" in out
    code, _, err = command("report", "nowhere")
    assert code == 2 and len(err.strip().splitlines()) == 1 and "nowhere" in err


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["sede=1"], ["sede"]),
        (["method.track.windw=3"], ["windw"]),
        (["method=papr"], ["papr", "paper"]),
        (["data=auto"], ["data.root"]),
        (["data=auto", "data.root=nowhere"], ["nowhere"]),
        (["data=shared_scenes"], ["DHTORCH_DATA"]),
        ([*TINY, "holdout.cutoff=-1"], ["holdout.cutoff", "-1"]),
        ([*TINY, "holdout.truth=best"], ["holdout.truth", "best"]),
        ([*TINY, "pairs.gap=99"], ["pairs.gap", "99"]),
        ([*TINY, "dtype=int8"], ["dtype", "int8"]),
        ([*TINY, "batch=0"], ["batch", "0"]),
        ([*TINY, "device=gpu"], ["device", "gpu"]),
        (["--config-name=other"], ["--config-name", "--multirun"]),
        ([*TINY, "method.sample.foveation=-1"], ["foveation"]),
        (["data.lidar=radar"], ["radar", "phone"]),
    ],
)
def test_bad_input_gets_one_clear_line(command, tmp_path, args, words):
    code, _, err = command(*args)
    assert code != 0
    assert "Traceback" not in err and len(err.strip().splitlines()) == 1, err
    assert all(w in err for w in words), err
    assert not results(tmp_path)


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_broken_file_is_one_line_from_a_worker_too(command, tmp_path, workers):
    room = SyntheticRoom(hw=(60, 80), n_frames=3, lidar="exact", supersample=1)
    writers.write_counted_frames(tmp_path / "set", [room[i] for i in range(3)])
    image = tmp_path / "set" / "images" / "00001.png"
    image.write_bytes(image.read_bytes()[:200])
    options = ["data=auto", f"data.root={tmp_path / 'set'}", "data.gap=1", "data.near=2.0", "figures=false"]
    if workers:
        done = dhtorch(tmp_path, *options, f"workers={workers}")
        code, err = done.returncode, done.stderr
    else:
        code, _, err = command(*options)
    assert code == 2 and len(err.strip().splitlines()) == 1, err
    assert "00001.png" in err and "Traceback" not in err


@pytest.mark.slow
@pytest.mark.parametrize("pairs", [["pairs=time", "pairs.seconds=0.06"], ["pairs=baseline", "pairs.metres=0.04"]])
def test_pairs_by_time_and_by_baseline(command, tmp_path, pairs):
    code, _, err = command(*[o for o in TINY if not o.startswith("pairs")], *pairs, "figures=false")
    assert code == 0, err
    assert result_files.read_result(results(tmp_path)[0])["data"]["n_pairs"] >= 1


def test_dropped_pairs_are_said(command):
    code, out, _ = command(*TINY, "figures=false", "method.n=64")
    assert code == 0 and "1 pair skipped" in out and "fewer than 20 candidate samples" in out


def test_a_traceback_is_shown_when_asked_for(command):
    code, _, err = command(*TINY, "pairs.gap=99", "traceback=true")
    assert code != 0 and "Traceback" in err


@pytest.mark.slow
def test_batches_and_workers_give_the_same_rows(tmp_path):
    rows = []
    for k, extra in enumerate((["batch=1"], ["batch=2", "workers=2"])):
        folder = tmp_path / str(k)
        folder.mkdir()
        done = dhtorch(folder, *TINY, "data.n_frames=5", "figures=false", *extra)
        assert done.returncode == 0, done.stderr
        (path,) = results(folder)
        rows.append([{k: v for k, v in r.items() if k != "ms"} for r in result_files.read_result(path)["rows"]])
    assert rows[0] == rows[1]
