"""Tables, figures and the page from archived results alone: of every experiment, and what they must survive.

``DHTORCH_STORE=1 pytest tests/docs/test_report.py`` stores the tables anew, after a change that is meant.
"""

import copy
import functools
import io
import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from support import result_files as archived
from support.digests import summary
from support.stored_values import stored_values

from dhtorch.cli import run
from dhtorch.experiments import report
from dhtorch.experiments.outcome import DEPTH_METRICS
from dhtorch.experiments.report import cells, figures, jobs, layouts, page, text
from dhtorch.experiments.report.cells import flatten_row, scene_rows
from dhtorch.experiments.report.published import PAPER, parse_printed
from dhtorch.experiments.report.tables import ReportTable, full_tables
from dhtorch.runtime import results as result_files
from dhtorch.viz.plots.markup import Markup, escape_html, make_tag

FILE = Path(__file__).with_name("report_tables.json")
NAMES = [make.__name__ for make in archived.ALL]
STORED = [*NAMES, "sweep of numbers", "sweep of names", "sweep of a probe"]


@functools.cache
def results():
    """One result of every kind; nobody changes them."""
    return {make.__name__: make() for make in archived.ALL}


def parse(markup):
    return ET.fromstring(markup.removeprefix("<!doctype html>"))


# ---------------------------------------------------------------------------------------------------- tables


def described(figure):
    """Words of a figure, and digests of what its panels draw."""
    lines = [figure.title, figure.caption, f"folded {figure.folded}, legends {len(figure.drawn.legends)}"]
    for axes in figure.drawn.axes:
        scales = [axes.get_xscale(), axes.get_yscale(), *axes.get_ylim()]
        lines.append(f"{axes.get_title('left')}: {axes.get_xlabel()}, {axes.get_ylabel()}, {scales}")
        drawn = [*(line.get_xydata() for line in axes.lines), *(box.get_bbox() for box in axes.patches)]
        drawn += [points.get_offsets() for points in axes.collections]
        lines += [" ".join(f"{x:.4g}" for x in summary(np.asarray(each))[2:]) for each in drawn]
    return lines


@pytest.mark.parametrize("name", NAMES)
def test_the_tables_and_figures_of_an_experiment_are_those_that_are_stored(name):
    """Cells beside the paper's, summaries, intervals, notes: whole, as Markdown; and what the figures draw."""
    result = results()[name]
    drawn = [line for figure in figures.result_figures(result) for line in described(figure)]
    shown = "\n".join([re.sub(r"\(2\d{3}-.*?code \S*\)", "()", report.to_markdown(result)), *drawn])
    assert shown == stored_values(FILE, {name: shown}, STORED)[name]
    rows = [{k: v for k, v in r.items() if k in ("scene", "pair", "truth")} | {"method": "one"} for r in result["rows"]]
    assert not figures.result_figures({**result, "rows": rows, "summary": {}})
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
    settings = json.dumps(result["config"], indent=2)
    for part in (result["data"]["name"], result["key"], result["meta"]["utc"], settings, result["why"] or ""):
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


# ---------------------------------------------------------------------------------------------------- sweeps


def job(method, n, coverage):
    """The main job of a sweep."""
    numbers = {"coverage": coverage, "median_rel": 0.1 - coverage / 20, "corr": coverage - 0.1, "ms.track": 1234.5}
    summary_ = {name: {"value": v, "low": None, "high": None, "n": 1, "unit": "1"} for name, v in numbers.items()}
    config = {"method": {"n": n}, "pairs": "gap"}
    rows = [{"scene": "room", "pair": None, "method": method, **numbers}]
    named = [vars(metric) for metric in DEPTH_METRICS]
    shared = {"data": {"name": "room"}, "summary": summary_, "metrics": named}
    return {"experiment": "pair", "config": config, "rows": rows, **shared}


JOBS = [job(m, n, c) for m, c in (("paper", 0.5), ("map", 0.7)) for n in (256, 4096, 1024)]
SWEEPS = {
    "sweep of numbers": lambda: JOBS,
    "sweep of names": lambda: JOBS[::3],
    "sweep of a probe": lambda: (
        [archived.probed("vo_probe", depth_cells=n) for n in (1, 2)]
        + [{k: v for k, v in archived.next_motion().items() if k != "metrics"}]
    ),
}


@pytest.mark.parametrize("name", SWEEPS)
def test_a_sweep_s_table_file_and_figure_are_those_that_are_stored(name, tmp_path, capsys):
    swept = SWEEPS[name]()
    shown = [
        text.tables_to_markdown([jobs.jobs_table(swept)]),
        jobs.write_jobs_csv(tmp_path / "x.csv", swept).read_text(),
    ]
    shown = "\n".join([*shown, *described(jobs.sweep_figure(swept))])
    assert shown == stored_values(FILE, {name: shown}, STORED)[name]
    assert not jobs.draw_sweep(tmp_path / "x.png", JOBS[:1])
    report.print_sweep(swept, tmp_path / "drawn")
    assert (tmp_path / "drawn/sweep.png").read_bytes().startswith(b"\x89PNG") and "sweep.png" in capsys.readouterr().out
    report.print_sweep([{**r, "config": {**r["config"], "figures": False}} for r in swept], tmp_path / "bare")
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
