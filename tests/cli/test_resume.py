"""Sweeps: what is finished stays, what is not is done, whatever stopped it; one failing job stops no other."""

import importlib.util
import os
import re
import shlex
import signal
import sys
import warnings
from functools import partial
from pathlib import Path

import hydra
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from support import writers
from support.processes import start, stop

from dhtorch.cli import job
from dhtorch.cli.run import config_dir, job_name
from dhtorch.experiments.protocol import Outcome
from dhtorch.runtime import console
from dhtorch.runtime import results as result_files
from dhtorch.runtime.output_folder import is_private
from dhtorch.synthetic.recording import SyntheticRoom

ROOM = ["data.hw=[60,80]", "data.n_frames=3", "data.supersample=1", "data.lidar=exact"]
TINY = [*ROOM, "pairs.gap=2", "method.n=256", "figures=false"]
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


@pytest.mark.slow
def test_a_failing_job_stops_no_other(command, tmp_path):
    sweep = ["-m", "resume=true", *TINY, "pairs.gap=2,9,1"]
    code, out, err = command(*sweep)
    assert code == 1 and "3 jobs: 2 finished, 0 left untouched, 1 failed" in out
    assert "failed: pairs.gap=9: pairs.gap: found 9" in err and "Traceback" not in err
    before = seen(results(tmp_path))
    assert len(before) == 2 and all("resumed" in str(p) for p in before)
    assert not list(tmp_path.rglob("*gap=9*")), "no empty folder of the failed job"
    code, out, _ = command(*sweep)
    assert code == 1 and "3 jobs: 0 finished, 2 left untouched, 1 failed" in out and seen(before) == before


@pytest.mark.slow
def test_an_unforeseen_error_is_one_failed_job(command, monkeypatch):
    real = job.run

    def broken(settings, *args, **options):
        if settings["seed"] == 0:
            raise ZeroDivisionError("a bug")
        return real(settings, *args, **options)

    monkeypatch.setattr(job, "run", broken)
    code, out, err = command("-m", *TINY, "seed=0,1")
    assert code == 1 and "1 finished, 0 left untouched, 1 failed" in out
    assert "Traceback" in err and "failed: seed=0: ZeroDivisionError: a bug" in err


@pytest.mark.slow
def test_single_jobs_resume_in_folders_of_their_own(command, tmp_path):
    assert command("resume=true", *TINY)[0] == 0
    (first,) = results(tmp_path)
    before = seen([first])
    code, out, _ = command(*TINY, "resume=true", "batch=1")
    assert code == 0 and "wrote" in out and len(results(tmp_path)) == 2, "another job"
    code, out, _ = command(*TINY, "resume=true", "traceback=true", "workers=0")
    assert code == 0 and "left untouched" in out and seen([first]) == before
    assert first.relative_to(tmp_path).parts[:2] == ("outputs", "resumed")


@pytest.mark.slow
def test_another_question_in_the_same_folder_is_done_again(command, tmp_path):
    assert command("output=here", *TINY)[0] == 0
    (path,) = results(tmp_path)
    keys = {result_files.read_result(path)["key"]}
    for n, other in enumerate(("seed=1", "holdout.truth=raw", "data.depth_noise=2"), start=2):
        code, out, _ = command("output=here", "resume=true", *TINY, other)
        keys.add(result_files.read_result(path)["key"])
        assert code == 0 and "wrote" in out and len(keys) == n and results(tmp_path) == [path]


@pytest.mark.slow
def test_joblib_runs_jobs_and_any_launcher_resumes_them(tmp_path, command):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    sweep = ["-m", "output=sweep", *TINY, "pairs.gap=2,9"]
    assert start(tmp_path, *sweep, "launch=joblib", "hydra.launcher.n_jobs=2").wait(200) == 1
    assert "2 jobs: 1 finished, 0 left untouched, 1 failed" in (tmp_path / "out").read_text()
    err = (tmp_path / "err").read_text()
    assert "failed: pairs.gap=9: pairs.gap: found 9" in err and "Traceback" not in err and "Warning" not in err
    before = seen(results(tmp_path))
    code, out, _ = command(*sweep, "resume=true")
    assert code == 1 and "0 finished, 1 left untouched, 1 failed" in out and seen(before) == before


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
    plugin = LAUNCHERS[name]
    if plugin and importlib.util.find_spec(f"hydra_plugins.{plugin}") is None:
        pytest.skip(f"{plugin} is not installed")
    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3", job_name="dhtorch"):
        cfg = hydra.compose("run", [f"launch={name}", "output=x"], return_hydra_config=True)
    launcher = OmegaConf.to_container(cfg.hydra.launcher, resolve=True)
    assert launcher["_target_"].rpartition(".")[0].startswith(f"hydra_plugins.{plugin}" if plugin else "hydra.")
    own = OmegaConf.load(config_dir() / "launch" / f"{name}.yaml")
    wanted = OmegaConf.to_container(own.hydra.launcher) if "hydra" in own else {}
    assert {k: launcher[k] for k in wanted} == wanted and "launch" not in cfg


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


@pytest.mark.slow
def test_changed_data_are_another_question(command, tmp_path):
    room = SyntheticRoom(hw=(60, 80), n_frames=3, supersample=1, lidar="exact")
    writers.write_counted_frames(tmp_path / "set", [room[i] for i in range(3)])
    asked = ["data=auto", "pairs.gap=2", "method.n=256", "figures=false", "resume=true", "output=here"]
    assert command(*asked, f"data.root={tmp_path / 'set'}")[0] == 0
    (path,) = results(tmp_path)
    config, digest = result_files.read_result(path)["config"], result_files.read_result(path)["data"]["digest"]
    assert digest == result_files.compute_data_digest(result_files.list_files_below([(tmp_path / "set", None)]))
    assert config["data"]["root"] == "set", "no place of this machine"
    same = [*asked, f"data.root={tmp_path / 'set'}"]
    assert "left untouched" in command(*same)[1]
    image = next((tmp_path / "set").rglob("*.png"))
    image.write_bytes(image.read_bytes() + b"\0")
    assert "wrote" in command(*same)[1] and result_files.read_result(path)["data"]["digest"] != digest


def test_files_that_settings_name_count_by_content_not_by_place(tmp_path, capsys):
    """The same weights elsewhere ask the same, other weights do not."""
    common = {"threads": None, "resume": True, "figures": False, "device": "cpu", "dtype": "float32", "seed": 0}
    common |= {"batch": 1, "workers": 0, "between": None, "holdout": {"cutoff": 1.0, "truth": "full"}}
    parts = {"data": SyntheticRoom(hw=(8, 8), n_frames=2), "method": None, "pairs": None}
    asked = []

    def experiment(*_, **__):
        asked.append(1)
        return Outcome().decide("Is it asked again?", "only where its files differ", None, "no pair")

    def key(place, words):
        place.mkdir(exist_ok=True)
        (place / "net.pt").write_text(words)
        settings = {**{g: {} for g in job.SETTINGS_GROUPS}, **common, "method": {"weights": str(place / "net.pt")}}
        whole = parts | {"experiment": experiment}
        job.run(settings, whole, dict.fromkeys(job.SETTINGS_GROUPS, "some"), tmp_path / "out", progress=None)
        return result_files.read_result(tmp_path / "out" / "result.json")["key"]

    one, elsewhere, other = key(tmp_path / "a", "w"), key(tmp_path / "b", "w"), key(tmp_path / "a", "v")
    assert one == elsewhere != other and len(asked) == 2
    assert "left untouched" in capsys.readouterr().out


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
