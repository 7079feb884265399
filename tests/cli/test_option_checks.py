"""Checks of words, option names and values before any work, and the table at the end of a sweep."""

import csv
import importlib
import re
import shutil
from types import SimpleNamespace

import pytest
from support import writers
from support.tiny_runs import TINY

from dhtorch.cli import job, run, view
from dhtorch.cli import option_checks as words
from dhtorch.cli import sweep_state as together
from dhtorch.experiments.outcome import DEPTH_METRICS
from dhtorch.experiments.report import advice, jobs
from dhtorch.runtime import results as result_files
from dhtorch.synthetic.recording import SyntheticRoom


@pytest.mark.parametrize(
    ("typed", "begins", "near"),
    [
        (["inspct", "x"], "inspct", "inspect"),
        (["version"], "version", "--version"),
        (["nonsense"], "nonsense", "complete"),
        (["seed=x"], "seed", "whole number"),
        (["seed=1.5"], "seed", "whole number"),
        (["method.n=0"], "method.n", "at least 1"),
        (["method.n=nan"], "method.n", "whole number"),
        (["pairs.gap=abc"], "pairs.gap", "whole number"),
        (["pair.gap=3"], "pair.gap", "pairs.gap"),
        (["+pair.gap=3"], "pair.gap", "pairs.gap"),
        (["++sede=3"], "sede", "seed"),
        (["method=mop"], "method", "map"),
        (["method.track.windw=3"], "method.track.windw", "method.track.window"),
        (["method.pose.far_weight=a"], "method.pose.far_weight", "number"),
        (["data.hw=60"], "data.hw", "list"),
        (["holdout.cutoff=far"], "holdout.cutoff", "positive"),
        (["figures=maybe"], "figures", "true"),
        (["threads=0"], "threads", "at least 1"),
        (["data=auto"], "data.root", "data.root=VALUE"),
        (["data=auto", "data.root=x", "data.camra=front"], "data.camra", "data.camera"),
        (["data=tum", "data.root=x", "data.registr=false"], "data.registr", "an unknown option"),
        (["data.camera=front"], "data.camera", "an unknown option"),
        (["recover", ".", "data.format=tum"], "data.format", "format"),
        (["--multrun"], "--multrun", "--multirun"),
        (["integrate", "voxel=abc"], "voxel", "positive"),
        (["integrate", "vxel=1"], "vxel", "voxel"),
        (["complete", "."], "out", "out=VALUE"),
        (["-m", "seed=0,1", "pairs.gp=3"], "pairs.gp", "pairs.gap"),
        (["-m", "method=choice(paper,mop)"], "method", "map"),
        (["-m", "method=glob(zz*)"], "method", "one of auto"),
    ],
)
def test_a_slip_is_said_in_one_line_before_any_work(command, monkeypatch, typed, begins, near):
    monkeypatch.setattr(job, "run", lambda *_, **__: pytest.fail("work was begun"))
    code, out, err = command(*typed)
    assert code == 2 and out == ""
    (line,) = err.strip().splitlines()
    assert line.startswith(f"dhtorch: {begins}: ") and near in line, line


def test_an_option_of_a_function_may_be_added_and_no_other(command):
    assert command(*TINY, "+data.name=kitchen", "output=o")[0] == 0
    assert command(*TINY, "+method.nothing=1")[0] == 2


def test_the_folder_of_what_is_made_is_out_or_output_to_every_command(command, tmp_path):
    assert command(*TINY, "out=a=b")[0] == 0 and (tmp_path / "a=b/result.json").is_file()
    (tmp_path / "empty").mkdir()
    (line,) = command("complete", "empty", "output=o")[2].splitlines()
    assert "empty: format" in line and "out:" not in line
    assert "empty: format" in command("validate", "empty", "out=o")[2]


@pytest.mark.slow
def test_the_first_word_of_view_may_be_a_capture(command, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(view, "run", lambda settings, *_, **__: asked.append(settings))
    monkeypatch.setattr(run, "_instantiate_parts", lambda *_: {})
    for name in ("capture", "view", "job", "sweep/1"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("job", "sweep/1"):
        (tmp_path / name / "result.json").write_text("{}")
    for words_ in (["capture"], ["view"], ["view", "data=tum"], ["job"], ["sweep"]):
        assert command("view", *words_)[0] == 0
    assert command("view", "nowhere")[0] == 2
    assert [s["result"] for s in asked] == [None, None, None, "job", "sweep"]
    assert [s["choices"]["data"] for s in asked] == ["auto", "auto", "tum", *["synthetic"] * 2]
    assert [s["data"]["root"] for s in asked[:3]] == ["capture", "view", "view"]


@pytest.mark.parametrize(
    ("first", "module"),
    [
        (["enrich", "{}", "out=o"], "dhtorch.cli.enrich"),
        (["validate", "{}", "depth=d"], "dhtorch.cli.validate"),
        pytest.param(["align", "{}", "depth=d", "out=o"], "dhtorch.cli.align", marks=pytest.mark.slow),
        pytest.param(["complete", "{}", "out=o"], "dhtorch.cli.complete", marks=pytest.mark.slow),
        (["extract", "data=auto", "data.root={}", "out=o"], "dhtorch.extract"),
        (["{}"], "dhtorch.cli.process_capture"),
        (["run", "data=auto", "data.root={}"], "dhtorch.cli.job"),
    ],
)
def test_options_of_the_reader_that_is_recognised_are_options(command, monkeypatch, tmp_path, first, module):
    """``data=auto`` lists none of them: those of the capture's own format are taken, of another refused."""
    room = SyntheticRoom(hw=(24, 32), n_frames=2, lidar="exact", supersample=1)
    writers.write_counted_frames(tmp_path / "one", [room[i] for i in range(2)])
    typed = [word.format(tmp_path / "one") for word in first]
    asked = []

    def run(settings, parts, *_, **__):
        opened = parts.get("data")
        asked.append((settings["data"]["register"], opened is None or len(opened) == 1))
        raise ValueError("seen")

    monkeypatch.setattr(importlib.import_module(module), "run", run)
    code, _, err = command(*typed, "data.register=false")
    assert code != 0 and "seen" in err and asked == [(False, True)]
    if module.endswith("process_capture"):  # opens the capture itself
        monkeypatch.undo()
        monkeypatch.chdir(tmp_path)
    code, _, err = command(*typed, "data.camera=front")
    assert code != 0 and "format frames_dir has no option 'camera', expected one of intrinsics" in err


def test_inspect_takes_the_options_of_the_reader_too(command, tmp_path):
    room = SyntheticRoom(hw=(24, 32), n_frames=2, lidar="exact", supersample=1)
    writers.write_counted_frames(tmp_path / "one", [room[i] for i in range(2)])
    assert command("inspect", str(tmp_path / "one"), "data.register=false", "--out", str(tmp_path / "sheet"))[0] == 0
    code, _, err = command("inspect", str(tmp_path / "one"), "data.registr=false")
    assert code == 2 and "did you mean data.register?" in err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("typed", "methods"),
    [
        ("method=choice(paper,map)", ["paper", "map"]),
        ("method=glob(pa*)", ["paper", "paper_direct"]),
        ("method=glob([pa*,opencv],exclude=paper_direct)", ["paper", "opencv"]),
    ],
)
def test_the_sweeps_of_hydra_choose_groups(command, monkeypatch, typed, methods):
    chosen = []

    def run(_settings, _parts, choices, folder, **_):
        chosen.append(choices["method"])
        return job.JobStatus(str(folder), "failed", "not run")

    monkeypatch.setattr(job, "run", run)
    _, out, _ = command("-m", typed, "method.n=64", "output=o")
    assert chosen == methods and f"{len(methods)} jobs" in out


@pytest.mark.slow
def test_deleting_the_holdout_is_no_holdout(command, monkeypatch):
    seen = []
    monkeypatch.setattr(
        job, "run", lambda s, _, c, f, **__: seen.append((s["holdout"], c)) or job.JobStatus(str(f), "x")
    )
    for typed in ("~holdout", "~holdout=range", "holdout=none"):
        assert command(typed, "output=o")[0] == 0
    assert seen[0] == seen[1] == seen[2] and seen[0][0]["cutoff"] == float("inf")
    code, out, err = command("~holdout", "--cfg", "job")
    assert code == 0 and "cutoff: .inf" in out, err


def test_names_of_places_are_one_text():
    assert words.quote_words(["output=a=b,c=1/x"]) == ["output='a=b,c=1/x'"]
    assert words.quote_words(["out=/tmp/a=b (1)/c"]) == ["out='/tmp/a=b (1)/c'"]
    assert words.quote_words(["seed=0,1", "extract.columns=[a,b]"], True) == ["seed=0,1", "extract.columns=[a,b]"]


@pytest.mark.slow
def test_a_sweep_ends_with_one_table_and_its_file(command, tmp_path):
    data = ["data.hw=[60,80]", "data.n_frames=3", "data.supersample=1", "data.lidar=exact", "figures=false"]
    code, out, _ = command("-m", *data, "pairs.gap=1,2", "method.n=256", "output=a=b")
    assert code == 0
    with (tmp_path / "a=b/sweep.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [r["pairs.gap"] for r in rows] == ["1", "2"]
    columns = [name for name in rows[0] if name != "note"]  # of jobs without values
    assert columns == ["pairs.gap", *(metric.name for metric in DEPTH_METRICS)]
    (at,) = [k for k, line in enumerate(out.splitlines()) if re.match(r"\s*pairs.gap\s+coverage\s+median\s+p90", line)]
    assert len(out.splitlines()) - at < 12
    assert not (tmp_path / "a=b" / together._NOTES_FOLDER).exists()
    code, out, _ = command("report", "a=b")
    assert code == 0 and "pairs.gap" in out and "truth dropped" not in out
    assert command("report", "a=b", "--html", "p.html")[0] == 0 and "2 jobs" in (tmp_path / "p.html").read_text()
    results = [result_files.read_result(p) for p in sorted(tmp_path.rglob("result.json"))]
    for k, (coverage, error) in enumerate(((0.5, 0.1), (0.4, 0.05))):
        results[k]["summary"] |= {"coverage": {"value": coverage}, "median_rel": {"value": error}}
    assert {(0, 1), (1, 2)} <= jobs.jobs_table(results).best


@pytest.mark.slow
def test_a_job_says_little_and_all_of_it_when_asked(command):
    code, out, _ = command(*TINY)
    assert code == 0 and len(out.splitlines()) <= 15 and "samples by gate" not in out
    assert len(command("-v", *TINY)[1].splitlines()) > len(out.splitlines())


def test_jobs_note_how_far_they_are(tmp_path):
    (tmp_path / together._NOTES_FOLDER).mkdir(parents=True)
    wrap = together.record_progress(tmp_path, "one", 2)
    assert list(wrap(range(4), "first", 4)) == [0, 1, 2, 3]
    assert together._read_progress(tmp_path / together._NOTES_FOLDER) == (0.5, 0, ["first"])
    together.mark_finished(tmp_path, "one")
    assert together._read_progress(tmp_path / together._NOTES_FOLDER)[:2] == (1.0, 1)
    assert list(together.record_progress(tmp_path / "unwatched", "one", 1)([7], "x", 1)) == [7]


@pytest.mark.parametrize(("gate", "word"), [("no_track", "smaller pairs.gap"), ("no_baseline", "larger pairs.gap")])
def test_silence_comes_with_advice(gate, word):
    row = {"scene": "s", "pair": None, "method": "m", "gate_share": {"answer": 0.0, gate: 0.9, "residual": 0.1}}
    assert word in advice({"rows": [row]})[0]
    assert advice({"rows": [{**row, "gate_share": {"answer": 0.3, gate: 0.7}}]}) == []


@pytest.mark.slow
def test_one_bar_covers_all_jobs_and_scenes_of_every_process(command, tmp_path, monkeypatch):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    seen, asked = [], []

    def draw(notes, n_jobs, stop):
        asked.append(n_jobs)
        while not stop.wait(0.02):
            seen.append(together._read_progress(notes))
        seen.append(together._read_progress(notes))

    monkeypatch.setattr(together, "_draw_bar", draw)
    monkeypatch.setattr(together, "sys", SimpleNamespace(stderr=SimpleNamespace(isatty=lambda: True)))
    rooms = ["data=synthetic_seeds", "data.seed=[0,1]", "data.hw=[60,80]", "data.n_frames=3"]
    options = ["method.n=256", "pairs.gap=1,2", "figures=false", "launch=joblib", "hydra.launcher.n_jobs=2"]
    code, _, err = command("-m", *rooms, *options, "output=sweep")
    assert code == 0, err
    assert asked == [2], "jobs, which the bar is over"
    done = [share for share, _, _ in seen]
    assert done == sorted(done) and seen[-1] == (2.0, 2, []), "the notes of two workers are one growing sum"
    assert any(0 < share < 2 for share in done), "it moves while they run"
    assert not (tmp_path / "sweep" / together._NOTES_FOLDER).exists()


@pytest.mark.parametrize(
    "content",
    [
        "_target_: dhtorch.pipeline.method.Method\n_partial_: x",
        "n: [1, 2",
        "a: b: c",
        "\tn: 1",
        "n: 1\n  m: 2",
        "&a [*b]",
        "- 1\n- 2",
        "3",
        "",
        "%",
        "\x00",
    ],
)
@pytest.mark.parametrize("command", ["complete", "run"])
def test_settings_of_a_user_that_are_no_settings_are_one_line(tmp_path, monkeypatch, capsys, content, command):
    shutil.copytree(run.config_dir(), tmp_path / "conf")
    (tmp_path / "conf" / "method" / "mine.yaml").write_text(content)
    monkeypatch.setattr(run, "config_dir", lambda: tmp_path / "conf")
    monkeypatch.chdir(tmp_path)
    words_typed = ["data=synthetic", "data.n_frames=2", "method=mine"]
    assert run.main([command, *words_typed, *(["out=out"] if command == "complete" else [])]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and "Traceback" not in message
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())
