"""Tables, figures and the page from archived results alone: of every experiment, and what they must survive.

``DHTORCH_STORE=1 pytest tests/docs/test_report.py`` stores the tables anew, after a change that is meant.
"""

import copy
import csv
import functools
import importlib
import io
import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from rich.console import Console
from support import result_files as archived
from support.stored_values import stored_values

from dhtorch.cli import run
from dhtorch.codes import Source
from dhtorch.experiments import report
from dhtorch.experiments.outcome import DEPTH_METRICS, Outcome
from dhtorch.experiments.probes.probing import (
    PROBE_ARMS,
    PROBE_METRICS,
    ProbeErrors,
    record_probes,
    summarise_over_scenes,
)
from dhtorch.experiments.report import cells, figures, jobs, layouts, page, text
from dhtorch.experiments.report.published import PAPER, parse_printed
from dhtorch.experiments.report.reading import flatten_row, scene_rows
from dhtorch.experiments.report.tables import ReportTable, full_tables
from dhtorch.runtime import results as result_files
from dhtorch.viz.plots.markup import Markup, escape_html, make_tag

REPO = Path(__file__).resolve().parents[2]
FILE = Path(__file__).with_name("report_tables.json")
NAMES = archived.NAMES
EXPERIMENTS = sorted(p.stem for p in (REPO / "conf" / "experiment").glob("*.yaml"))


@functools.cache
def results():
    """One result of every kind; nobody changes them."""
    return {name: archived.make(name) for name in archived.NAMES}


@functools.cache
def committed():
    """Name → committed result of an experiment."""
    paths = sorted((REPO / "benchmarks" / "results").glob("*.json"))
    return {path.stem: result_files.read_result(path) for path in paths if '"schema"' in path.read_text()[:20]}


def parse(markup):
    return ET.fromstring(markup.removeprefix("<!doctype html>"))


# ---------------------------------------------------------------------------------------------------- tables


@pytest.mark.parametrize("name", NAMES)
def test_the_tables_of_an_experiment_are_those_that_are_stored(name):
    """Cells beside the paper's, summaries, intervals, notes: whole, as Markdown; and the brief form on the console."""
    result = results()[name]
    shown = re.sub(r"\(2\d{3}-.*?code \S*\)", "()", report.to_markdown(result))
    assert shown == stored_values(FILE, {name: shown}, NAMES)[name]
    for table in [*report.tables(result), *full_tables(result)]:
        assert all(len(row) == len(table.head) for row in table.rows), table.title
        assert not table.over or sum(span for _, span in table.over) == len(table.head)


@pytest.mark.parametrize("name", sorted(layouts.EXPERIMENT_LAYOUTS.keys() & set(NAMES)))
@pytest.mark.parametrize("one_scene", [False, True])
def test_the_console_prints_every_figure_of_the_paper_also_for_one_scene(name, one_scene, capsys):
    result = results()[name]
    rows = [row for row in result["rows"] if not one_scene or row["scene"] == archived.SCENES[0]]
    report.print_brief({**result, "rows": rows})
    printed = " ".join(capsys.readouterr().out.split())
    quoted = [PAPER[key] for key in SOURCES.get(name, [name]) if key in PAPER]
    assert quoted or name in ("ablation", "method_comparison", "dense_comparison", "learned_score", "downstream_probe")
    for table in quoted:
        assert all(cell in printed for line in table.lines.values() for cell in line.values()), table.where
        assert table.where in printed and " ".join(table.notes) in printed


#: Kind of result → tables of the paper that it is shown beside, where it has other names.
SOURCES = {
    "range_split": ("range_split", "cutoff_sweep"),
    "heldout": ("heldout", "cyclic", "cross_data"),
    "calibration": ("score_calibration", "thresholds"),
    "motion": ("baseline_motion",),
    "helix_correlation": ("helix",),
}


@pytest.mark.parametrize(
    ("value", "metric", "how", "cell"),
    [
        (0.01234, "median_rel", None, "1.23 %"),
        (0.25, "p90_rel", None, "25.0 %"),
        (1.0, "pnp_success", None, "100 %"),
        (0.0, "coverage", None, "0 %"),
        (None, "corr", None, "–"),
        (0.456, "residual_px", None, "0.46"),
        (-0.0654, "aurc", None, "−0.065"),
        (32690, "n_candidates", None, "32,690"),
        (21.0, "n_dropped.wide", None, "21"),
        (10.04, "ms.track", None, "10.0"),
        (304_368_640, "parameters", None, "304 M"),
        (1_217_474_560, "weight_bytes", None, "1.22 GB"),
        (1900.0, "peak_mib", None, "1.99 GB"),
        (0, "parameters", None, "0"),
        (0.0123456, "baseline_m", None, "0.0123"),
        (1e-7, "baseline_m", None, "1.0e−07"),
        (12345, "", "plain", "12345"),
        (True, "passes", None, "yes"),
        ([224, 224], "hw", None, "224×224"),
    ],
)
def test_a_number_is_written_in_the_style_of_its_metric(value, metric, how, cell):
    assert cells.format_value(value, metric, how) == cell


def test_a_cell_of_another_type_is_refused_and_printed_figures_are_read_back():
    with pytest.raises(ValueError, match=r"median_rel: found \{'a': 1\}, expected a number"):
        cells.format_value({"a": 1}, "median_rel")
    printed = {"64.2 %": 0.642, "32,690": 32690, "−0.33": -0.33, "571 M": 571e6, "1.26 B": 1.26e9}
    assert {cell: parse_printed(cell) for cell in printed} == pytest.approx(printed)
    assert all(parse_printed(word) is None for word in ("1.4–3.5 %", "yes", "8/11", "≈ 0.16", "", None))


@pytest.mark.parametrize(
    ("name", "label", "heading", "metric", "theirs"),
    [
        ("defocus", "side from an oracle", "corr", "oracle_side.corr", "0.66"),
        ("defocus", "side from an oracle", "|ρ| of blur", "oracle_side.rho_abs", "0.22"),
        ("focus_stack", "clean", "Spearman", "clean.rank_corr", "0.69"),
        ("focus_stack", "optics of a light field", "sign flipped", "light_field.flip_share", "∼1/5"),
        ("defocus_fusion", "bilinear", "corr", "bilinear.corr", "0.82–0.99"),
        ("range_split", "gated", "coverage", "gated.coverage", "64.2 %"),
        ("gate_ablation", "gap x2 (published: gap 60)", "median", "gap x2.median_rel", "6.3 %"),
    ],
)
def test_ours_of_the_committed_files_stands_beside_the_paper_s(name, label, heading, metric, theirs):
    result = committed()[name]
    table = layouts.layout_tables(result)[0]
    (row,) = [row for row in table.rows if row[0] == label]
    at = table.flat_head().index(f"{heading}, ours")
    assert row[at] == cells.format_value(result["summary"][metric]["value"], metric) and row[at + 1] == theirs
    assert table.flat_head()[at + 1] == f"{heading}, published"


def test_the_comparison_leaves_the_sigma_of_a_method_that_states_none_blank():
    (table,) = layouts.layout_tables(committed()["method_comparison"])
    rows = {row[0]: dict(zip(table.head, row, strict=True)) for row in table.rows}
    for name, blank in (("paper", True), ("opencv", True), ("auto", False)):
        for metric in ("within_sigma", "within_2sigma", "ece"):
            assert (rows[name][cells.metric_heading(metric)] == cells.EMPTY_CELL) == blank


def test_what_was_not_measured_says_why():
    notes = {(scene, "gated"): "too short" for scene in "ab"} | {("a", "device_raw"): "no device trajectory"}
    rows = archived.rows_of({"gated": (0.05, 0.5)}, scenes=("a", "b"), notes=notes)
    rows += archived.rows_of({"device_raw": (1.0, 0.1)}, scenes=("a",), notes=notes)
    result = archived.result("range_split", rows)
    said = {row[0]: set(row[3::2]) for row in layouts.layout_tables(result)[0].rows}
    assert said["gated"] == {"too short"} and said["device pose (raw)"] == {"no device trajectory"}
    assert said["no gates"] == {"not run"}
    by_scene = next(t for t in report.tables(result) if "pairs" in t.head)
    assert set(by_scene.rows[0][3:]) == {"too short"}
    assert ["0 of 2 scenes", "gated"] in [row[:2] for row in by_scene.rows]


def test_the_knee_stands_in_the_table_and_in_the_figures():
    result = archived.make("calibration")
    numbers = {"": (0.65, 0.13), "at_0.1.": (0.55, 0.10), "at_0.3.": (0.40, 0.05), "at_0.5.": (0.10, 0.045)}
    for prefix, values in numbers.items():
        for metric, value in zip(("coverage", "median_rel"), values, strict=True):
            result["summary"][f"paper.{prefix}{metric}"]["value"] = value
    (table,) = [t for t in layouts.layout_tables(result) if t.title.startswith("Selective threshold, paper")]
    assert [row[0] for row in table.rows] == ["0", "0.1", "0.3 (knee)", "0.5"] and "at 0.3" in table.note
    (axes,) = figures._thresholds(result).drawn.axes
    assert [0.40, 0.05] in [
        xy for line in axes.lines if line.get_markersize() == 11 for xy in line.get_xydata().tolist()
    ]
    result["summary"]["paper.at_0.3.median_rel"]["n"] -= 1
    assert layouts.threshold_knee(result, "paper") == "0.1", "a threshold at which a scene is silent is no point"


# ---------------------------------------------------------------------------------------------------- the page


@pytest.fixture
def undrawn(monkeypatch):
    """Figures of a page are made and not drawn."""
    monkeypatch.setattr(page, "encode_uri", lambda figure, kind: f"data:image/{kind};base64,")


@pytest.mark.parametrize("name", ["range_split", "latency", *(pytest.param(n, marks=pytest.mark.slow) for n in NAMES)])
@pytest.mark.usefixtures("undrawn")
def test_the_page_needs_nothing_else_and_holds_every_number(name):
    result = results()[name]
    tree = parse(page.render_report([result]))
    ids = [e.get("id") for e in tree.iter() if e.get("id")]
    assert len(ids) == len(set(ids)) and tree.get("lang") == "en" and tree.find("head/title").text
    for e in tree.iter():
        assert e.tag not in ("script", "link") and not {"onclick", "onload"} & set(e.keys())
        assert e.get("href") is None or e.get("href").removeprefix("#") in ids
        assert e.get("aria-labelledby") is None or e.get("aria-labelledby") in ids
        assert e.tag != "img" or (e.get("src").startswith("data:image/") and e.get("alt"))
        assert e.tag != "th" or e.get("scope")
        assert e.tag != "table" or "".join(e.find("caption").itertext()), "a table has a caption"
    style = tree.find("head/style").text
    assert "url(" not in style and "@import" not in style
    used = {c for e in tree.iter() for c in (e.get("class") or "").split()}
    assert used and not [c for c in used if f".{c}" not in style]
    said, whole = {"".join(e.itertext()).strip() for e in tree.iter()}, "".join(tree.itertext())
    numbers = [v for row in scene_rows(result) for v in flatten_row(row).values()]
    numbers += [e["value"] for e in result["summary"].values()]
    for number in numbers:
        if isinstance(number, int | float) and not isinstance(number, bool):
            assert f"{number:.5g}" in said or str(number) in said
    words = {row[key] for row in result["rows"] for key in ("scene", "method", "note") if row.get(key)}
    assert words | set(result["summary"]) <= said
    for part in (result["data"]["name"], result["key"], result["meta"]["utc"], '"levels": 4', result["why"] or ""):
        assert part in whole


HOSTILE = '</td><script>alert("&amp;")</script>\x00\x1b|\n`${x}` ]]> \ud800 é'


@pytest.mark.usefixtures("undrawn")
def test_names_cannot_break_the_page():
    bad = copy.deepcopy(results()["range_split"])
    for row in bad["rows"]:
        row |= {"scene": row["scene"].replace("kitchen_000", HOSTILE), "method": "<b onload='x'>" + row["method"]}
    bad["summary"] = {"<i>" + k: v for k, v in bad["summary"].items()}
    bad |= {k: "<u>" + bad[k] for k in ("question", "why")}
    bad["config"]["<p>"] = "</pre><h1>"
    made = page.render_report([bad])
    tree = parse(made)
    assert not {"script", "b", "i", "u"} & {e.tag for e in tree.iter()}
    assert '</td><script>alert("&amp;")</script>\ufffd\ufffd|' in "".join(tree.itertext()) and made.encode()
    for line in report.to_markdown(bad).splitlines():
        assert "<" not in line and (not line.startswith("|") or line.endswith("|"))
    assert make_tag("a", "<", Markup("<b/>"), title='"&', class_="x", no=None) == (
        '<a title="&quot;&amp;" class="x">&lt;<b/></a>'
    )
    assert escape_html(escape_html("&")) == "&amp;" and make_tag("td") == "<td></td>" and make_tag("br") == "<br/>"


def emptied(value, name=""):
    """The same with null for every number that a schema lets be null."""
    if isinstance(value, dict):
        return {k: emptied(v, k) for k, v in value.items()}
    if isinstance(value, list):
        return [emptied(v) for v in value] if name not in ("pair", "hw") else value
    return None if isinstance(value, float) or name in ("n_candidates", "n_kept", "passes") else value


@pytest.mark.parametrize("name", ["range_split", "calibration", "latency"])
@pytest.mark.usefixtures("undrawn")
def test_nulls_everywhere_are_shown_as_nothing(name):
    result = results()[name]
    bare = {**result, "rows": [emptied(r) for r in result["rows"]]}
    bare["summary"] = {k: {**v, "value": None, "low": None, "high": None} for k, v in result["summary"].items()}
    result_files.validate_result(bare)
    nothing = {**result, "summary": {}, "rows": []}
    assert "None" not in "".join(parse(page.render_report([bare, nothing])).itertext())
    assert "None" not in report.to_markdown(bare)


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_committed_results_make_a_page():
    made = page.render_report(list(committed().values())[::6])
    scenes = {row["scene"] for result in list(committed().values())[::6] for row in result["rows"]}
    assert parse(made) is not None and scenes and all(f">{escape_html(scene)}<" in made for scene in scenes)


def test_a_reason_in_all_columns_is_said_once_and_long_words_are_broken():
    cells_of = ["a", "w" * 90, "3", "too short", "too short"]
    made = page.table_markup(ReportTable("t", ["scene", "why", "pairs", "median", "p90"], [cells_of], 2))
    assert made.count("too short") == 1 and '<td class="word" colspan="2">too short</td>' in made
    assert f'<td class="why">{"w" * 90}</td>' in made and '<td class="num">3</td>' in made
    dashes = page.table_markup(ReportTable("t", ["scene", "median", "p90"], [["a", "–", "–"]]))
    assert dashes.count("–") == 2, "nothing is no reason"


def test_the_command_prints_tables_or_writes_a_page_and_nothing_else(tmp_path, capsys):
    kept = result_files.write_result(tmp_path / "sweep/a/result.json", results()["latency"])
    result_files.write_result(tmp_path / "sweep/b/result.json", results()["hole_census"])
    before = kept.read_bytes()
    assert run.main(["report", str(kept.parent)]) == 0 and "latency on rooms" in capsys.readouterr().out
    assert run.main(["report", str(tmp_path / "sweep"), "--markdown"]) == 0
    for block in capsys.readouterr().out.split("\n\n"):
        lines = [line.replace("\\|", "").count("|") for line in block.splitlines() if line.startswith("|")]
        assert len(set(lines)) <= 1, "every row has as many cells"
    assert run.main(["report", str(tmp_path / "sweep"), "--html", str(tmp_path / "page.html")]) == 0
    assert "2 results" in capsys.readouterr().out
    tree = parse((tmp_path / "page.html").read_text(encoding="utf-8"))
    assert [a.text for a in tree.iter("a") if a.get("class") != "skip"] == ["latency", "hole_census"]
    assert "could not be downloaded" in "".join(tree.find("body/header/p").itertext())
    for arguments, reason in (
        ([kept, "--html", tmp_path / "sweep"], "found a folder"),
        ([kept, "--html", kept], "ends in .html"),
        ([kept, "--html", tmp_path / "no/page.html"], "no/page"),
        ([kept.parent.parent / "none.json"], "no such file"),
        ([kept, "--html", "x.html", "--markdown"], "markdown: found true with html"),
    ):
        assert run.main(["report", *map(str, arguments)]) == 2 and reason in capsys.readouterr().err
    assert kept.read_bytes() == before


# ---------------------------------------------------------------------------------------------------- figures


@pytest.mark.parametrize(
    ("name", "titles"),
    [
        (
            "pair",
            "Risk against coverage, Error against distance, Coverage against distance, Reliability, Source or gate",
        ),
        ("hole_census", "Why returns are missing"),
        ("helix_correlation", "Variants side by side"),
    ],
)
def test_figures_are_those_that_the_numbers_allow(name, titles):
    drawn = figures.result_figures(results()[name])
    assert [figure.title.split(" of the")[0] for figure in drawn] == titles.split(", ")
    rows = [{k: v for k, v in r.items() if k in ("scene", "pair", "method", "truth")} for r in results()[name]["rows"]]
    assert not figures.result_figures({**results()[name], "rows": rows, "summary": {}})


def test_scenes_that_a_figure_lacks_are_named_and_a_mean_over_few_answers_is_not_drawn():
    assert "terrace/CAMERA_01 (too short)" in figures._risk(results()["range_split"]).caption
    result = archived.make("pair")
    for row in scene_rows(result):
        row["n_candidates"] = 100
        row["curves"]["risk_coverage"]["coverage"] = [0.02 * k for k in range(1, 21)]  # 2, 4, … 40 answers
    (line,) = [
        x for x in figures._risk(result).drawn.axes[0].lines if x.get_linewidth() == 1.8 and len(x.get_xdata()) > 1
    ]
    assert len(line.get_xdata()) == 16, "from ten answers on"


def test_bins_of_several_scenes_weigh_every_scene_the_same():
    a = {"claimed": [0.1, None, 0.9], "realised": [0.2, None, 1.0], "weight": [0.5, 0.0, 0.5]}
    b = {"claimed": [0.3, 0.5, None], "realised": [0.0, 0.4, None], "weight": [2.0, 6.0, 0.0]}
    claimed, realised, weight = figures.pool_reliability([a, b])
    assert weight == pytest.approx([0.375, 0.375, 0.25])
    assert claimed == pytest.approx([(0.25 * 0.1 + 0.125 * 0.3) / 0.375, 0.5, 0.9])
    assert realised == pytest.approx([0.25 * 0.2 / 0.375, 0.4, 1.0])


def test_an_overlay_draws_every_point_once_in_its_class():
    overlay = next(row["overlay"] for row in scene_rows(results()["pair"]))
    layers = {layer.label: layer.uv for layer in figures.overlay_layers(overlay)}
    source = np.array(overlay["source"])
    uv = np.array([overlay["u"], overlay["v"]]).T
    assert (layers["sensor"] == uv[source == Source.SENSOR]).all()
    assert (layers["recovered"] == uv[source == Source.RECOVERED]).all()
    assert sum(map(len, layers.values())) == len(source)
    assert [len(x.uv) for x in figures.overlay_layers({**overlay, "u": [None] * len(source)})] == []


# ---------------------------------------------------------------------------------------------------- sweeps


def metrics_of(experiment):
    settings = yaml.safe_load((REPO / "conf" / "experiment" / f"{experiment}.yaml").read_text())
    module = importlib.import_module(settings["_target_"].rpartition(".")[0])
    return getattr(module, "_METRICS", getattr(module, "PROBE_METRICS", DEPTH_METRICS))


@pytest.mark.parametrize("experiment", [name for name in EXPERIMENTS if name != "latency"])  # found while it runs
def test_the_named_metrics_of_an_experiment_are_in_its_results(experiment):
    result = next((r for r in reversed(committed().values()) if r["experiment"] == experiment), None)
    if result is None:
        pytest.skip("no committed result")
    named = {**result, "metrics": [vars(metric) for metric in metrics_of(experiment)]}
    found = {metric.name for metric in jobs.main_metrics([named])}
    missing = {metric.name for metric in metrics_of(experiment)} - found - {"vs_xfeat", "ms"}
    assert not missing and len(jobs.jobs_table([named, named]).rows[0]) > 1


def probe_result(cells_per_side, seed):
    """Result of ``vo_probe`` on one scene, with random errors."""
    generator, errors = torch.Generator().manual_seed(seed), ProbeErrors([f"room {k}" for k in range(5)])
    arms = [arm for arm, blocks in PROBE_ARMS.items() if not {"xfeat", "efficientnet", "true_depth"} & set(blocks)]
    for cohort in ("moving", "all"):
        errors.counts[cohort] = torch.full((5,), 20.0, dtype=torch.float64)
        errors.squares |= {(arm, cohort): 10 + 10 * torch.rand(5, generator=generator).double() for arm in arms}
    outcome = Outcome(metrics=PROBE_METRICS)
    record_probes(outcome, errors, "room")
    return {
        "experiment": "vo_probe",
        "config": {"experiment": {"depth_cells": cells_per_side}, "pairs": "gap", "output": "x"},
        "data": {"name": "room"},
        "rows": outcome.rows,
        "summary": summarise_over_scenes(outcome, arms),
        "metrics": [vars(metric) for metric in outcome.metrics],
    }


def test_a_probe_sweep_has_error_ratio_and_interval_in_every_cell(tmp_path):
    swept = [probe_result(n, seed) for seed, n in enumerate((1, 2, 4))]
    table = jobs.jobs_table(swept)
    headings = ["squared error / variance", "ratio to context", "ratio to DINOv2"]
    assert len(table.rows) == 3 * 8 and table.head[:2] == ["experiment.depth_cells", "method"]
    assert table.head[2::2] == headings and table.note == f"smaller is better: {', '.join(headings)}"
    assert not any(cell in ("", cells.EMPTY_CELL) for row in table.rows for cell in row), "no empty cell"
    (best,) = {n for n, column in table.best if column == 2}
    rows = list(csv.DictReader(jobs.write_jobs_csv(tmp_path / "sweep.csv", swept).read_text().splitlines()))
    errors = [float(row["mse"]) for row in rows]
    assert errors.index(min(errors)) == best and f"**{table.rows[best][2]}**" in text.table_to_markdown(table)
    assert all(float(row["vs_dinov2_low"]) <= float(row["vs_dinov2"]) <= float(row["vs_dinov2_high"]) for row in rows)
    unnamed = {key: value for key, value in swept[0].items() if key != "metrics"}
    assert [metric.name for metric in jobs.main_metrics([unnamed])][:2] == ["mse", "vs_context"]
    assert not jobs.jobs_table([unnamed, unnamed]).best, "which side is better is unknown"
    for entry in swept[1]["summary"].values():
        entry |= {"value": None, "low": None, "high": None}
    swept[1]["rows"] = [{**row, "note": "5 pairs, fewer than 30"} for row in swept[1]["rows"]]
    noted = jobs.jobs_table(swept[:2])
    assert [row[-1] for row in noted.rows] == [""] * 8 + ["room: 5 pairs, fewer than 30"] and noted.head[-1] == "note"
    rows = list(csv.DictReader(jobs.write_jobs_csv(tmp_path / "sweep.csv", swept[:2]).read_text().splitlines()))
    assert rows[-1]["note"] == "room: 5 pairs, fewer than 30" and rows[-1]["mse"] == "" and rows[0]["note"] == ""


def depth_result(method, n, coverage):
    """Result of the main job with one variant and its main metrics."""
    numbers = {"coverage": coverage, "median_rel": 0.1 - coverage / 20, "corr": coverage - 0.1, "ms.track": 1234.5}
    summary = {name: {"value": v, "low": None, "high": None, "n": 1, "unit": "1"} for name, v in numbers.items()}
    config = {"method": {"n": n}, "pairs": "gap"}
    rows = [{"scene": "room", "pair": None, "method": method, **numbers}]
    named = [vars(metric) for metric in DEPTH_METRICS]
    return {"experiment": "pair", "config": config, "data": {"name": "room"}, "rows": rows} | {
        "summary": summary,
        "metrics": named,
    }


def test_a_sweep_is_drawn_along_its_number_or_as_a_chart_of_names(tmp_path, capsys):
    swept = [depth_result(m, n, c) for m, c in (("paper", 0.5), ("map", 0.7)) for n in (256, 4096, 1024)]
    assert jobs.jobs_table(swept).rows[0] == ["paper", "256", "50.0 %", "7.50 %", "0.40", "1234"]
    panels = jobs.sweep_figure(swept).drawn.axes
    assert [axes.get_title("left") for axes in panels] == ["coverage, %", "median, %", "corr", "ms"]
    for axes in panels:
        assert axes.get_xlabel() == "method.n" and axes.get_xscale() == "log", "values over more than a decade"
        assert [line.get_xdata().tolist() for line in axes.lines] == [[256, 1024, 4096]] * 2
    assert [line.get_ydata().tolist() for line in panels[0].lines] == [[0.5] * 3, [0.7] * 3]
    chart = jobs.sweep_figure(swept[::3]).drawn
    assert [t.get_text() for t in chart.axes[0].get_yticklabels()] == ["paper", "map"] and not chart.legends
    assert jobs.sweep_figure(swept[:1]) is None and not jobs.draw_sweep(tmp_path / "x.png", swept[:1])
    report.print_sweep(swept, tmp_path)
    assert (tmp_path / "sweep.png").read_bytes().startswith(b"\x89PNG") and "and sweep.png" in capsys.readouterr().out
    for result in swept:
        result["config"]["figures"] = False
    report.print_sweep(swept, tmp_path / "bare")
    assert sorted(p.name for p in (tmp_path / "bare").glob("*.*")) == [".dhtorch", "sweep.csv"]


def test_the_console_takes_names_literally():
    out, result = io.StringIO(), json.loads(json.dumps(results()["pair"]).replace("office_desk", "hall [a]|b"))
    report.print_tables(result, Console(file=out))
    assert "hall [a]|b" in out.getvalue() and "…" not in out.getvalue()
    assert "hall [a]\\|b" in report.to_markdown(result)


def test_the_console_shows_summaries_bold_intervals_dim_and_the_paper_s_lines_in_a_colour():
    out = io.StringIO()
    report.print_tables(results()["heldout"], Console(file=out, force_terminal=True, width=240))
    kinds = {"\x1b[33m": "published: ", "\x1b[2m": "95 % interval", "\x1b[1m": " scenes ", "": "kitchen_000"}
    for style, start in kinds.items():
        lines = [line for line in out.getvalue().splitlines() if start in re.sub("\x1b.*?m", "", line)[:20]]
        assert lines and all((style in line) if style else ("\x1b" not in line) for line in lines), start
