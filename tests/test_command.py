"""The command: a job end to end, sweeps, resuming, clear errors, the installed wheel."""

import json
import os
import re
import subprocess
import sys
import venv
from pathlib import Path

import numpy as np
import pytest

from dhtorch import archive
from dhtorch.run import config_dir

TINY = ["data.hw=[120,160]", "data.n_frames=4", "pairs.gap=2", "method.n=256"]
REPO = Path(__file__).resolve().parents[1]


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
    return folder, done


def results(folder):
    return sorted(folder.rglob("result.json"))


def test_one_job_writes_one_result_and_its_pictures(job):
    folder, done = job
    (path,) = results(folder)
    result = archive.read(path)
    assert result["experiment"] == "pair" and result["data"]["n_pairs"] == 2
    assert {p.name for p in path.parent.rglob("*") if p.is_file()} == {
        "result.json", "samples.png", "holes.png", "depth.png", "risk_coverage.png", "points.ply",
    }  # fmt: skip
    for word in (
        "coverage",
        "median",
        "p90",
        "corr",
        "residual",
        "pose found",
        "holes by class",
        "milliseconds",
        "wrote",
    ):
        assert word in done.stdout, word
    assert str(path) in done.stdout
    rows = result["rows"]
    assert [r["pair"] for r in rows] == [[0, 2], [1, 3], None]
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
        + [("sigma", "<f4"), ("score", "<f4"), ("source", "u1")]
    )
    points = np.frombuffer(body, layout)
    assert len(points) == count > 50 and set(points["source"]) <= {1, 2} and 1 in points["source"]
    assert (points["z"] > 0.2).all() and (points["z"] < 50).all()


def test_results_do_not_name_the_machine(job):
    (path,) = results(job[0])
    assert str(Path.home()) not in path.read_text() and str(job[0]) not in path.read_text()


def test_report_reads_the_archive(job):
    (path,) = results(job[0])
    shown = dhtorch(job[0], "report", str(path))
    assert shown.returncode == 0 and "synthetic_room" in shown.stdout
    plain = dhtorch(job[0], "report", "--markdown", str(path))
    assert "| scene" in plain.stdout
    missing = dhtorch(job[0], "report", "nowhere")
    assert missing.returncode == 2 and len(missing.stderr.strip().splitlines()) == 1 and "nowhere" in missing.stderr


def test_sweep_and_resume(tmp_path):
    sweep = ["--multirun", *TINY, "figures=false", "method=paper,opencv", "hydra.sweep.dir=sweep", "resume=true"]
    first = dhtorch(tmp_path, *sweep)
    assert first.returncode == 0, first.stderr
    paths = results(tmp_path)
    assert len(paths) == 2
    before = [p.read_bytes() for p in paths]
    assert {json.loads(b)["rows"][0]["method"] for b in before} == {"paper", "opencv"}
    paths[1].write_text(paths[1].read_text()[:200])  # as after a kill: not a valid result
    again = dhtorch(tmp_path, *sweep)
    assert again.returncode == 0 and "left untouched" in again.stdout
    assert paths[0].read_bytes() == before[0]
    assert archive.read(paths[1])["key"] == json.loads(before[1])["key"]


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
        ([*TINY, "method.sample.foveation=-1"], ["foveation"]),
        (["data.lidar=radar"], ["radar", "phone"]),
    ],
)
def test_bad_input_gets_one_clear_line(tmp_path, args, words):
    done = dhtorch(tmp_path, *args)
    assert done.returncode != 0
    assert "Traceback" not in done.stderr and len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert all(w in done.stderr for w in words), done.stderr
    assert not results(tmp_path)


def test_a_traceback_is_shown_when_asked_for(tmp_path):
    done = dhtorch(tmp_path, *TINY, "pairs.gap=99", "traceback=true")
    assert done.returncode != 0 and "Traceback" in done.stderr


def test_help_reads_well(tmp_path):
    done = dhtorch(tmp_path, "--help")
    assert done.returncode == 0
    for word in ("dhtorch", "data=auto", "method: ", "paper", "holdout", "--multirun"):
        assert word in done.stdout, word
    assert max(len(line) for line in done.stdout.splitlines()) < 200


def test_batches_and_workers_give_the_same_rows(tmp_path):
    rows = []
    for k, extra in enumerate((["batch=1"], ["batch=2", "workers=2"])):
        folder = tmp_path / str(k)
        folder.mkdir()
        done = dhtorch(folder, *TINY, "figures=false", *extra)
        assert done.returncode == 0, done.stderr
        (path,) = results(folder)
        rows.append([{k: v for k, v in r.items() if k != "ms"} for r in archive.read(path)["rows"]])
    assert rows[0] == rows[1]


@pytest.mark.slow
def test_the_wheel_runs_from_an_empty_folder(tmp_path):
    """Built, installed beside the present environment's libraries, run where no checkout is."""
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "-o", str(tmp_path), str(REPO)],
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    venv.create(tmp_path / "env", with_pip=True)
    python = tmp_path / "env" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "-q", "--no-deps", str(wheel)], check=True)
    libraries = next(p for p in sys.path if p.endswith("site-packages"))
    here = next((tmp_path / "env").rglob("site-packages"))
    (here / "libraries.pth").write_text(libraries + "\n")
    empty = tmp_path / "empty"
    empty.mkdir()
    code = "import dhtorch.run; print(dhtorch.run.config_dir())"
    where = subprocess.run([python, "-P", "-c", code], cwd=empty, capture_output=True, text=True, check=True).stdout
    assert Path(where.strip()) == here / "dhtorch" / "conf" != config_dir()
    done = subprocess.run(
        [tmp_path / "env/bin/dhtorch", *TINY, "figures=false"], check=False, cwd=empty, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert len(results(empty)) == 1
