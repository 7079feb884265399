"""The table of a sweep: of every experiment, in its own metrics, with direction, unit and interval."""

from __future__ import annotations

import csv
import importlib
import json
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from dhtorch.experiments import report
from dhtorch.experiments.outcome import DEPTH_METRICS, MainMetric, Outcome
from dhtorch.experiments.probes.probing import (
    PROBE_ARMS,
    PROBE_METRICS,
    ProbeErrors,
    record_probes,
    summarise_over_scenes,
)
from dhtorch.experiments.report import job_figure, jobs, page
from dhtorch.experiments.report.cells import EMPTY_CELL

ROOT = Path(__file__).resolve().parents[2]
EXPERIMENTS = sorted(p.stem for p in (ROOT / "conf" / "experiment").glob("*.yaml"))

#: Metrics that the experiments find only while they run.
DYNAMIC = {"latency"}


def metrics_of(experiment: str) -> tuple[MainMetric, ...]:
    settings = yaml.safe_load((ROOT / "conf" / "experiment" / f"{experiment}.yaml").read_text())
    module = importlib.import_module(settings["_target_"].rpartition(".")[0])
    return getattr(module, "_METRICS", getattr(module, "PROBE_METRICS", DEPTH_METRICS))


@cache
def committed_results() -> dict[str, dict[str, Any]]:
    """Experiment → one of its committed results."""
    found = [
        json.loads(path.read_text()) for path in sorted((ROOT / "benchmarks" / "results").glob("*.json"), reverse=True)
    ]
    return {result["experiment"]: result for result in found if isinstance(result, dict) and "experiment" in result}


@pytest.mark.parametrize("experiment", [name for name in EXPERIMENTS if name not in DYNAMIC])
def test_the_named_metrics_of_an_experiment_are_in_its_results(experiment: str) -> None:
    if experiment not in committed_results():
        pytest.skip("no committed result")
    metrics = metrics_of(experiment)
    result = {**committed_results()[experiment], "metrics": [vars(metric) for metric in metrics]}
    found = jobs.main_metrics([result])
    missing = {metric.name for metric in metrics} - {metric.name for metric in found} - {"vs_xfeat", "ms"}
    assert not missing, f"{experiment} names {missing}, which no summary has"
    table = jobs.jobs_table([result, result])
    assert table is not None and len(table.rows[0]) > 1


def probe_result(cells: int, seed: int) -> dict[str, Any]:
    """Result of ``vo_probe`` on one scene, with random errors."""
    generator = torch.Generator().manual_seed(seed)
    errors = ProbeErrors([f"room {k}" for k in range(5)])
    arms = [arm for arm, blocks in PROBE_ARMS.items() if not {"xfeat", "efficientnet", "true_depth"} & set(blocks)]
    for cohort in ("moving", "all"):
        errors.counts[cohort] = torch.full((5,), 20.0, dtype=torch.float64)
        errors.squares |= {(arm, cohort): 10 + 10 * torch.rand(5, generator=generator).double() for arm in arms}
    outcome = Outcome(metrics=PROBE_METRICS)
    record_probes(outcome, errors, "room")
    config = {"experiment": {"depth_cells": cells}, "pairs": "gap", "output": "x"}
    return {
        "experiment": "vo_probe",
        "config": config,
        "data": {"name": "room"},
        "rows": outcome.rows,
        "summary": summarise_over_scenes(outcome, arms),
        "metrics": [vars(metric) for metric in outcome.metrics],
    }


def test_a_probe_sweep_has_error_ratio_and_interval_in_every_cell(tmp_path: Path) -> None:
    results = [probe_result(cells, seed) for seed, cells in enumerate((1, 2, 4))]
    table = jobs.jobs_table(results)
    assert table is not None and len(table.rows) == 3 * 8
    assert table.head[:2] == ["experiment.depth_cells", "method"]
    assert table.head[2::2] == ["squared error / variance", "ratio to context", "ratio to DINOv2"]
    assert not any(cell in ("", EMPTY_CELL) for row in table.rows for cell in row), "no empty cell"
    assert table.note == "smaller is better: squared error / variance, ratio to context, ratio to DINOv2"
    (best,) = {n for n, column in table.best if column == 2}
    rows = list(csv.DictReader(jobs.write_jobs_csv(tmp_path / "sweep.csv", results).read_text().splitlines()))
    errors = [float(row["mse"]) for row in rows]
    assert errors.index(min(errors)) == best
    assert all(float(row["vs_dinov2_low"]) <= float(row["vs_dinov2"]) <= float(row["vs_dinov2_high"]) for row in rows)


def test_a_job_without_values_says_why(tmp_path: Path) -> None:
    results = [probe_result(1, 0), probe_result(2, 0)]
    for name in results[1]["summary"]:
        results[1]["summary"][name] = {"value": None, "low": None, "high": None, "n": 0, "unit": "1"}
    results[1]["rows"] = [{**row, "note": "5 pairs, fewer than 30"} for row in results[1]["rows"]]
    table = jobs.jobs_table(results)
    assert table is not None and table.head[-1] == "note" and len(table.rows) == 9
    assert [row[-1] for row in table.rows] == [""] * 8 + ["room: 5 pairs, fewer than 30"]
    rows = list(csv.DictReader(jobs.write_jobs_csv(tmp_path / "sweep.csv", results).read_text().splitlines()))
    assert rows[-1]["note"] == "room: 5 pairs, fewer than 30" and rows[-1]["mse"] == "" and rows[0]["note"] == ""


def test_a_result_that_names_no_metric_still_has_a_table() -> None:
    result = {key: value for key, value in probe_result(1, 0).items() if key != "metrics"}
    assert [metric.name for metric in jobs.main_metrics([result])][:2] == ["mse", "vs_context"]
    table = jobs.jobs_table([result, result])
    assert table is not None and not table.best, "which side is better is unknown"


def depth_result(method: str, n: int | str, coverage: float) -> dict[str, Any]:
    """Result of the main job with one variant and its main metrics."""
    numbers = {"coverage": coverage, "median_rel": 0.1 - coverage / 20, "corr": coverage - 0.1, "ms.track": 100.0}
    summary = {name: {"value": v, "low": None, "high": None, "n": 1, "unit": "1"} for name, v in numbers.items()}
    return {
        "experiment": "pair",
        "config": {"method": {"n": n}, "pairs": "gap"},
        "data": {"name": "room"},
        "rows": [{"scene": "room", "pair": None, "method": method, **numbers}],
        "summary": summary,
        "metrics": [vars(metric) for metric in DEPTH_METRICS],
    }


def test_a_sweep_of_a_number_is_drawn_along_it_with_a_curve_for_every_method() -> None:
    results = [depth_result(m, n, c) for m, c in (("paper", 0.5), ("map", 0.7)) for n in (256, 4096, 1024)]
    table = jobs.jobs_table(results)
    assert table is not None and "corr" in table.head, "the correlation is a column"
    figure = job_figure.sweep_figure(results)
    assert figure is not None and [key.text for key in figure.legend] == ["paper", "map"]
    assert [panel.title for panel in figure.panels] == ["coverage, %", "median, %", "corr", "ms"]
    for panel in figure.panels:
        assert panel.x.label == "method.n" and panel.x.log, "values over more than a decade"
        lines = [mark for mark in panel.marks if mark.kind == "line"]
        assert len(lines) == 2 and all([u for u, _ in m.places] == sorted(u for u, _ in m.places) for m in lines)
        assert len([mark for mark in panel.marks if mark.kind == "dot"]) == 6
    tips = [mark.tooltip for mark in figure.panels[0].marks if mark.tooltip]
    assert "map method.n 4096: 70.0 %" in tips


def test_a_sweep_of_names_is_a_chart_and_one_job_is_no_sweep(tmp_path: Path) -> None:
    results = [depth_result(m, 256, c) for m, c in (("paper", 0.5), ("map", 0.7))]
    figure = job_figure.sweep_figure(results)
    assert figure is not None and not figure.legend and figure.panels[0].rows == ["paper", "map"]
    assert job_figure.sweep_figure(results[:1]) is None and not job_figure.draw_sweep(tmp_path / "x.png", results[:1])
    assert not (tmp_path / "x.png").exists()
    intervals = job_figure.sweep_figure([probe_result(1, 0), probe_result(1, 1)])
    assert intervals is not None and sum(mark.kind == "line" for mark in intervals.panels[0].marks) == 16


def test_the_curves_of_a_sweep_stand_beside_its_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = [depth_result("map", n, 0.5 + n / 4096) for n in (256, 512)]
    report.print_sweep(results, tmp_path)
    assert (tmp_path / "sweep.png").read_bytes().startswith(b"\x89PNG") and "and sweep.png" in capsys.readouterr().out
    assert page._sweep(results, jobs.jobs_table(results)).count("<svg") == 4
    for result in results:
        result["config"]["figures"] = False
    report.print_sweep(results, tmp_path / "bare")
    assert sorted(p.name for p in (tmp_path / "bare").glob("*.*")) == [".dhtorch", "sweep.csv"]
