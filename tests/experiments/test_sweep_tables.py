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

from dhtorch.experiments.outcome import DEPTH_METRICS, MainMetric, Outcome
from dhtorch.experiments.probes.probing import (
    PROBE_ARMS,
    PROBE_METRICS,
    ProbeErrors,
    record_probes,
    summarise_over_scenes,
)
from dhtorch.experiments.report import jobs
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
    arms = [arm for arm, blocks in PROBE_ARMS.items() if not {"xfeat", "efficientnet"} & set(blocks)]
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
