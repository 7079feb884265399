"""The page, the figures and the paper's tables, on results of every experiment and on what they must survive."""

import copy
import functools
import xml.etree.ElementTree as ET
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import result_files as archived

from dhtorch.codes import Gate, Source
from dhtorch.experiments import report
from dhtorch.experiments.report import cells, curves, layouts, page, plots, published, text
from dhtorch.experiments.report.figure import Figure
from dhtorch.experiments.report.reading import flatten_row, scene_rows
from dhtorch.experiments.report.tables import MAIN_COLUMNS, ReportTable, full_tables
from dhtorch.runtime import results as result_files
from dhtorch.viz import plots as drawing
from dhtorch.viz.plots import Axis, Panel, Stroke, colours
from dhtorch.viz.plots.markup import Markup, escape_html, make_tag

REPO = Path(__file__).resolve().parents[2]
NAMES = [make.__name__ for make in archived.ALL]
every = pytest.mark.parametrize("result", NAMES, indirect=True)
#: Every sixth kind; the others among the slow tests.
some = pytest.mark.parametrize(
    "result",
    [pytest.param(name, marks=[pytest.mark.slow] * (k % 6 > 0)) for k, name in enumerate(NAMES)],
    indirect=True,
)


@functools.cache
def results():
    """One result of every kind, in the order of ``NAMES``; nobody changes them."""
    return [make() for make in archived.ALL]


@pytest.fixture
def result(request):
    """The result of a name."""
    return results()[NAMES.index(request.param)]


@functools.cache
def page_of(name):
    """The page of one result."""
    return page.render_report([results()[NAMES.index(name)]])


def parse(markup):
    assert markup.startswith("<!doctype html>\n")
    return ET.fromstring(markup.removeprefix("<!doctype html>"))


def words(tree):
    """Text of every element that holds text itself."""
    return {"".join(e.itertext()).strip() for e in tree.iter()}


# ---------------------------------------------------------------------------------------------------- the page


@pytest.mark.parametrize("name", NAMES)
def test_the_page_is_whole_and_needs_nothing_else(name):
    made = page_of(name)
    tree = parse(made)
    assert tree.get("lang") == "en" and tree.find("head/title").text
    for word in ("http", "//", "@import", "url(", "<script", "<link", "<img"):
        assert word not in made.replace("<!doctype html>", ""), word
    ids = [e.get("id") for e in tree.iter() if e.get("id")]
    assert len(ids) == len(set(ids))
    for e in tree.iter():
        assert not (e.keys() and {"src", "onclick", "onload"} & set(e.keys()))
        assert e.get("href") is None or e.get("href").removeprefix("#") in ids
        assert e.get("aria-labelledby") is None or e.get("aria-labelledby") in ids
        if e.tag == "table":
            assert e.find("caption") is not None and "".join(e.find("caption").itertext()), "a table has a caption"
            assert all(th.get("scope") for th in e.iter("th"))
        if e.tag == "svg":
            assert e.get("role") == "img" and e.get("aria-label")
    style = tree.find("head/style").text
    used = {c for e in tree.iter() for c in (e.get("class") or "").split()}
    assert used and not [c for c in used if f".{c}" not in style and f'[class^="{c[:4]}"]' not in style]


@pytest.mark.parametrize("name", NAMES)
def test_the_page_holds_every_scene_and_every_number(name):
    result, tree = results()[NAMES.index(name)], parse(page_of(name))
    said = words(tree)
    for row in scene_rows(result):
        assert row["scene"] in said and row["method"] in said
        for name, number in flatten_row(row).items():
            if isinstance(number, int | float) and not isinstance(number, bool):
                assert f"{number:.5g}" in said or str(number) in said, name
    for name, found in result["summary"].items():
        assert name in said
        assert found["value"] is None or f"{found['value']:.5g}" in said or str(found["value"]) in said
    for note in {row["note"] for row in result["rows"] if row.get("note")}:
        assert note in said
    whole = "".join(tree.itertext())
    for part in (result["data"]["name"], result["key"], result["meta"]["utc"], '"levels": 4', result["why"] or ""):
        assert part in whole
    assert result["verdict"] is None or result["verdict"] in said


@pytest.mark.slow
def test_several_results_stand_on_one_page_in_their_order():
    tree = parse(page.render_report(results()))
    links = [a for a in tree.iter("a") if a.get("class") != "skip"]
    sections = list(tree.iter("section"))
    assert [a.text for a in links] == [r["experiment"] for r in results()]
    assert [a.get("href")[1:] for a in links] == [s.get("id") for s in sections]
    assert "could not be downloaded" in "".join(tree.find("body/header/p").itertext())
    benchmark = {**results()[0], "data": {**results()[0]["data"], "name": "tum11"}}
    said = "".join(parse(page.render_report([benchmark])).find("body/header/p").itertext())
    assert "does not name the sequences" in said and "could not be downloaded" not in said


HOSTILE = '</td><script>alert("&amp;")</script>\x00\x1b|\n`${x}` ]]> \ud800 é'


@some
def test_names_cannot_break_the_page(result):
    bad = copy.deepcopy(result)
    old = bad["rows"][0]["scene"]
    for row in bad["rows"]:
        row["scene"] = HOSTILE if row["scene"] == old else row["scene"]
        row["method"] = "<b onload='x'>" + row["method"]
    bad["summary"] = {"<i>" + k: v for k, v in bad["summary"].items()}
    bad |= {k: bad[k] and "<u>" + bad[k] for k in ("question", "why")}
    bad["config"]["<p>"] = "</pre><h1>"
    made = page.render_report([bad])
    tree = parse(made)
    assert not {"script", "b", "i", "u"} & {e.tag for e in tree.iter()}
    assert '</td><script>alert("&amp;")</script>\ufffd\ufffd|' in "".join(tree.itertext())
    made.encode()
    for line in report.to_markdown(bad).splitlines():
        assert "<" not in line
        assert not line.startswith("|") or line.endswith("|")


def emptied(value, name=""):
    """The same with null for every number that a schema lets be null."""
    if isinstance(value, dict):
        return {k: emptied(v, k) for k, v in value.items()}
    if isinstance(value, list):
        return [emptied(v) for v in value] if name not in ("pair", "hw") else value
    return None if isinstance(value, float) or name in ("n_candidates", "n_kept", "passes") else value


@some
def test_nulls_everywhere_are_shown_as_nothing(result):
    bare = {**result, "rows": [emptied(r) for r in result["rows"]]}
    bare["summary"] = {k: {**v, "value": None, "low": None, "high": None} for k, v in result["summary"].items()}
    result_files.validate_result(bare)
    assert "None" not in "".join(parse(page.render_report([bare])).itertext())
    assert "None" not in report.to_markdown(bare)
    nothing = {**result, "summary": {}, "rows": [r for r in bare["rows"] if r["pair"] is not None]}
    parse(page.render_report([nothing]))
    parse(page.render_report([{**nothing, "rows": []}]))


@pytest.mark.slow
@pytest.mark.parametrize("some", [slice(0, None, 6), pytest.param(slice(None), marks=pytest.mark.slow)])
def test_committed_results_make_a_page(some):
    paths = [p for p in sorted((REPO / "benchmarks/results").glob("*.json")) if p.read_text().startswith("{")][some]
    results = [result_files.read_result(path) for path in paths]
    made = page.render_report(results)
    scenes = {row["scene"] for r in results for row in r["rows"]}
    assert parse(made) is not None and scenes and all(f">{escape_html(scene)}<" in made for scene in scenes)


def test_markup_is_escaped_once():
    assert (
        make_tag("a", "<", Markup("<b/>"), title='"&', class_="x", no=None)
        == '<a title="&quot;&amp;" class="x">&lt;<b/></a>'
    )
    assert escape_html(escape_html("&")) == "&amp;" and make_tag("td") == "<td></td>" and make_tag("br") == "<br/>"


# ---------------------------------------------------------------------------------------------------- the command


@pytest.mark.slow
def test_the_command_writes_a_page_and_nowhere_else(tmp_path, capsys):
    kept = result_files.write_result(tmp_path / "sweep/a/result.json", results()[0])
    result_files.write_result(tmp_path / "sweep/b/result.json", results()[1])
    before = kept.read_bytes()
    assert report.main([str(tmp_path / "sweep"), "--html", str(tmp_path / "page.html")]) == 0
    assert "2 results" in capsys.readouterr().out
    assert (tmp_path / "page.html").read_text(encoding="utf-8") == page.render_report(results()[:2])
    for target, reason in ((tmp_path / "sweep", "found a folder"), (kept, "ends in .html")):
        with pytest.raises(ValueError, match=reason):
            report.main([str(tmp_path / "sweep"), "--html", str(target)])
    with pytest.raises(OSError, match="no/page"):
        report.main([str(kept), "--html", str(tmp_path / "no/page.html")])
    with pytest.raises(SystemExit):
        report.main([str(kept), "--html", "x.html", "--markdown"])
    with pytest.raises(FileNotFoundError, match="expected a result"):
        report.main([str(tmp_path / "nothing"), "--html", str(tmp_path / "new.html")])
    assert kept.read_bytes() == before and not (tmp_path / "new.html").exists()


# ---------------------------------------------------------------------------------------------------- paper's tables


@every
def test_tables_are_rectangles_in_every_medium(result):
    found = [*report.tables(result), *full_tables(result)]
    for table in found:
        assert all(len(row) == len(table.head) for row in table.rows), table.title
        assert not table.over or sum(span for _, span in table.over) == len(table.head)
        assert table.footer + table.quoted <= len(table.rows)
        lines = text.table_to_markdown(table).splitlines()
        assert len({line.replace("\\|", "").count("|") for line in lines}) == 1
    for block in text.tables_to_markdown(found).split("\n\n"):
        assert not block.startswith("|") or "\n| :--" in block


SOURCES = {
    "range_split": (published.RANGE_SPLIT, published.CUTOFF_SWEEP),
    "real_holes": (published.REAL_HOLES,),
    "gate_ablation": (published.GATE_ABLATION,),
    "heldout": (published.HELD_OUT, published.CYCLIC, published.CROSS_DATA),
    "calibration": (published.SCORE_CALIBRATION, published.THRESHOLDS),
    "hole_census": (published.HOLE_CENSUS,),
    "device_pose": (published.DEVICE_POSE,),
    "motion": (published.BASELINE_MOTION,),
    "global_map": (published.GLOBAL_MAP,),
    "latency": (published.LATENCY,),
    "learned": (published.LEARNED,),
    "helix_correlation": (published.HELIX,),
    "icp": (published.ICP,),
    "hole_attention": (published.HOLE_ATTENTION,),
    "defocus": (published.DEFOCUS,),
    "focus_stack": (published.FOCUS_STACK,),
    "defocus_fusion": (published.DEFOCUS_FUSION,),
}


@pytest.mark.parametrize("result", SOURCES, indirect=True)
def test_every_figure_of_the_paper_stands_in_the_table_of_its_experiment(result):
    tables = layouts.layout_tables(result)
    for quoted in SOURCES[result["experiment"]]:
        (table,) = [t for t in tables if t.note and quoted.where in t.note and quoted.data in t.note][:1]
        cells = [cell for row in table.rows for cell in row]
        for line in quoted.lines.values():
            assert all(cell in cells for cell in line.values()), quoted.where
        assert result["data"]["name"] in table.note


def test_ours_stands_beside_the_papers_line():
    main, cutoffs = layouts.layout_tables(archived.range_split())
    assert main.flat_head() == [
        "",
        "scenes",
        "truth kept",
        *(f"{m}, {who}" for m in ("coverage", "corr", "median", "p90") for who in ("ours", "published")),
    ]
    assert [row[0] for row in main.rows] == list(published.RANGE_SPLIT.lines), "the paper's lines in the paper's order"
    gated = main.rows[4]
    ours = archived.range_split()["summary"]["gated.coverage"]["value"]
    assert gated[3:5] == [f"{100 * ours:.1f} %", "64.2 %"] and gated[1] == "2"
    assert main.rows[0][3:7] == ["0 %", "0.0 %", "–", "–"], "silent, not missing"
    assert [row[0] for row in cutoffs.rows] == [
        "gated, cutoff x0.75 (published: 1.5 m)",
        "gated (published: 2.0 m)",
        "gated, cutoff x1.25 (published: 2.5 m)",
    ]
    gates = layouts.layout_tables(archived.gate_ablation())[0]
    assert [row[0].split(" (")[0] for row in gates.rows] == [
        "gap x0.5",
        "both gates",
        "gap x2",
        "parallax gate off",
        "reprojection gate off",
    ]


def test_the_comparison_says_what_paper_is_and_leaves_its_sigma_blank():
    result = result_files.read_result(REPO / "benchmarks/results/method_comparison.json")
    (table,) = layouts.layout_tables(result)
    rows = {row[0]: dict(zip(table.head, row, strict=True)) for row in table.rows}
    heads = [cells.metric_heading(m) for m in ("within_sigma", "within_2sigma", "ece")]
    assert all(rows[name][head] == cells.EMPTY_CELL for name in ("paper", "opencv") for head in heads)
    assert all(rows["auto"][head] != cells.EMPTY_CELL for head in heads)
    assert [row[0] for row in table.rows][:2] == ["paper", "opencv"] and "minimal solver" in table.note


def test_real_holes_beyond_the_cutoff_have_a_table_of_their_own():
    result = result_files.read_result(REPO / "benchmarks/results/room_range_split.json")
    main, holes, _ = layouts.layout_tables(result)
    assert holes.title.startswith("Beyond the cutoff where the sensor has no return") and len(holes.rows) == 5
    rows = [r for r in result["rows"] if r["pair"] is None and r["truth"] == "real_holes" and r["method"] == "gated"]
    gated = dict(zip(holes.head, holes.rows[-1], strict=True))
    assert gated["candidates"] == f"{sum(r['n_candidates'] for r in rows):,}"
    assert main.flat_head()[2] == "truth kept" and main.rows[0][3] == "0 %", "the sensor alone answers nothing"


def test_a_cell_of_another_type_is_refused_and_names_its_column():
    with pytest.raises(ValueError, match=r"median_rel: found \{'a': 1\}, expected a number"):
        cells.format_value({"a": 1}, "median_rel")


def test_negative_results_stand_beside_the_papers_figure():
    """Ours from the committed files, not copied here: the cell beside the paper's is the summary's number."""

    def beside(name, label, heading, metric):
        result = result_files.read_result(REPO / f"benchmarks/results/{name}.json")
        table = layouts.layout_tables(result)[0]
        (row,) = [row for row in table.rows if row[0] == label]
        at = table.flat_head().index(f"{heading}, ours")
        assert table.flat_head()[at + 1] == f"{heading}, published"
        assert row[at] == cells.format_value(result["summary"][metric]["value"], metric)
        return row[at + 1]

    oracle = "side from an oracle"
    assert beside("defocus", oracle, "corr", "oracle_side.corr") == "0.66"
    assert beside("defocus", oracle, "|ρ| of blur", "oracle_side.rho_abs") == "0.22"
    assert beside("defocus", "side by height in the image", "corr", "by_height.corr") == "0.06"
    assert beside("focus_stack", "clean", "Spearman", "clean.rank_corr") == "0.69"
    field = "optics of a light field"
    assert beside("focus_stack", field, "sign flipped", "light_field.flip_share") == "∼1/5"
    assert beside("focus_stack", field, "|corr|, most confident quarter", "light_field.gated_abs_corr") == "0.21"
    assert beside("defocus_fusion", "bilinear", "corr", "bilinear.corr") == "0.82–0.99"


def test_a_stack_of_one_measure_and_a_sweep_have_the_tables_that_they_can_have():
    first, other = layouts.layout_tables(archived.focus_stack())
    assert [row[0] for row in first.rows] == ["clean", "noisy", "optics of a light field", "nothing blurred"]
    assert {row[0].split(", ")[1] for row in other.rows} == {"variance"} and not other.quoted
    (swept,) = layouts.layout_tables(archived.screened("focus_stack", ("given",), ("order_corr", "halves_corr")))
    assert "Sweeps" in swept.title and len(swept.rows) == 1 and not swept.note
    (given_,) = layouts.layout_tables(archived.screened("focus_stack", ("given",), ("rank_corr", "gated_corr")))
    assert [row[0] for row in given_.rows] == [
        "given",
        "published: clean synthetic",
        "published: real light fields",
    ]


def test_what_one_picture_cannot_tell_apart_has_a_table_of_its_own():
    rows = {row[0]: row[1:] for row in layouts.layout_tables(archived.defocus())[1].rows}
    assert rows["in focus, soft texture"] == ["2.40", "0.00"] and rows["nearer than the focus"] == ["1.66", "1.69"]


def test_what_was_not_measured_says_why():
    rows = archived.rows_of(
        {"gated": (0.05, 0.5)}, scenes=("a", "b"), notes={("a", "gated"): "too short", ("b", "gated"): "too short"}
    )
    rows += archived.rows_of(
        {"device_raw": (1.0, 0.1)}, scenes=("a",), notes={("a", "device_raw"): "no device trajectory"}
    )
    result = archived.result("range_split", rows)
    main = layouts.layout_tables(result)[0]
    cells = {row[0]: row[3::2] for row in main.rows}
    assert cells["gated"] == ["too short"] * 4 and cells["device pose (raw)"] == ["no device trajectory"] * 4
    assert cells["no gates"] == ["not run"] * 4
    by_scene = next(t for t in report.tables(result) if "pairs" in t.head)
    assert by_scene.rows[0][3:] == ["too short"] * len(by_scene.head[3:]) and len(MAIN_COLUMNS) <= len(
        by_scene.head[3:]
    )
    assert ["0 of 2 scenes", "gated"] in [row[:2] for row in by_scene.rows]
    assert "too short" in report.to_markdown(result) and "not run" in report.to_markdown(result)


def test_a_reason_in_all_columns_is_said_once_and_long_words_are_broken():
    table = ReportTable(
        "t", ["scene", "why", "pairs", "median", "p90"], [["a", "w" * 90, "3", "too short", "too short"]], 2
    )
    made = page.table_markup(table)
    assert made.count("too short") == 1 and '<td class="word" colspan="2">too short</td>' in made
    assert f'<td class="why">{"w" * 90}</td>' in made and '<td class="num">3</td>' in made
    dashes = page.table_markup(ReportTable("t", ["scene", "median", "p90"], [["a", "–", "–"]]))
    assert dashes.count("–") == 2, "nothing is no reason"


def test_the_cohort_that_the_summary_leaves_unnamed_decides():
    result = archived.calibration()
    held, split = layouts.layout_tables(result)[:2]
    assert "heldout" in held.title and held.quoted == 2 and "full" in split.title and split.quoted == 0
    result["summary"]["paper.heldout.ece"]["value"], result["summary"]["paper.ece"]["value"] = 0.111, 0.222
    held, split, steps = layouts.layout_tables(result)[:3]
    assert held.rows[0][3] == "0.111" and split.rows[0][3] == "0.222"
    assert [row[0].removesuffix(" (knee)") for row in steps.rows] == ["0", "0.1", "0.3", "0.5"]
    assert [steps.rows[2][k] for k in (2, 4)] == ["34.3 %", "9.5 %"]


def test_passes_are_counted_without_scenes_of_a_role():
    result = archived.heldout()
    table = layouts.layout_tables(result)[2]
    mine = [r["passes"] for r in scene_rows(result, "heldout", "paper") if not r["role"]]
    assert table.rows[0][table.head.index("passes")] == f"{sum(mine)}/{len(mine)}" and len(mine) == 3


def test_printed_figures_are_read_back():
    assert published.parse_printed("64.2 %") == pytest.approx(0.642) and published.parse_printed("32,690") == 32690
    assert published.parse_printed("−0.33") == -0.33 and published.parse_printed("571 M") == 571e6
    assert all(published.parse_printed(word) is None for word in ("1.4–3.5 %", "yes", "8/11", "≈ 0.16", "", None))


# ---------------------------------------------------------------------------------------------------- figures


def titles(result):
    return [figure.title.split(":")[0] for figure in plots.result_figures(result)]


def test_figures_are_those_that_the_numbers_allow():
    shared = ["Risk against coverage", "Error against distance", "Coverage against distance", "Reliability"]
    assert titles(archived.pair()) == [*shared, "Source or gate of the samples"]
    assert "Cutoff sweep" in titles(archived.range_split()) and "Latency" in titles(archived.latency())
    assert "Motion dependence" in titles(archived.motion()) and "Threshold on the score" in titles(
        archived.calibration()
    )
    assert titles(archived.hole_census()) == ["Why returns are missing"]
    old = {
        **archived.pair(),
        "rows": [{k: v for k, v in r.items() if k not in ("curves", "overlay")} for r in archived.pair()["rows"]],
    }
    assert titles(old) == []


def test_scenes_that_a_figure_lacks_are_named():
    for figure in plots.result_figures(archived.range_split()):
        if figure.title.startswith(("Risk", "Error", "What")):
            assert "terrace/CAMERA_01 (too short)" in figure.caption


def test_a_mean_over_few_answers_is_not_drawn():
    result = archived.pair()
    for row in result["rows"]:
        if row["pair"] is None:
            row["n_candidates"] = 100
            row["curves"]["risk_coverage"]["coverage"] = [0.02 * k for k in range(1, 21)]  # 2, 4, … 40 answers
    (line,) = [m for m in curves.risk_figure(result).panels[0].marks if m.kind == "line" and not m.stroke.dashes]
    assert len(line.places) == 16, "from ten answers on"


def test_bins_of_several_scenes_weigh_every_scene_the_same():
    a = {"claimed": [0.1, None, 0.9], "realised": [0.2, None, 1.0], "weight": [0.5, 0.0, 0.5]}
    b = {"claimed": [0.3, 0.5, None], "realised": [0.0, 0.4, None], "weight": [2.0, 6.0, 0.0]}
    claimed, realised, weight = curves.pool_reliability([a, b])
    assert weight == pytest.approx([0.375, 0.375, 0.25])
    assert claimed == pytest.approx([(0.25 * 0.1 + 0.125 * 0.3) / 0.375, 0.5, 0.9])
    assert realised == pytest.approx([0.25 * 0.2 / 0.375, 0.4, 1.0])


def test_an_overlay_draws_every_point_once_in_its_class():
    result = archived.pair()
    row = next(r for r in result["rows"] if r["pair"] is None)
    figure = plots.result_figures(result)[-1]
    drawn = {layer.label: layer for layer in figure.panels[0].layers}
    source, gate = row["overlay"]["source"], row["overlay"]["gate"]
    assert len(drawn["sensor"].uv) == source.count(Source.SENSOR) and drawn["sensor"].colour == colours.SENSOR
    assert len(drawn["recovered"].uv) == source.count(Source.RECOVERED)
    assert drawn["recovered"].colour == colours.RECOVERED
    silent = [g for s, g in zip(source, gate, strict=True) if s == Source.NONE]
    assert len(drawn["unanswered: parallax"].uv) == silent.count(Gate.PARALLAX)
    assert sum(len(layer.uv) for layer in drawn.values()) == len(source)
    assert {key.text for key in figure.legend} >= set(drawn)
    svg = drawing.render_inline_svg(figure.panels[0])
    round_ends = [p.get("d").count("M") for p in ET.fromstring(svg).iter("path") if "linecap" in p.get("style")]
    assert sum(round_ends) == sum(len(layer.uv) for layer in drawn.values() if layer.mark != "unanswered"), "a dot each"


def test_a_line_breaks_where_a_value_is_missing():
    panel, stroke = Panel("t", Axis(0, 1), Axis(0, 1)), Stroke(colours.INK)
    panel.line([0, 0.5, 1, None, 0.2], [0, 0.5, 1, 1, 0.2], stroke)
    panel.line([0, 0.5, 1], [0, None, 1], stroke)
    line, *dots = panel.marks
    assert len(line.places) == 3 and [m.kind for m in dots] == ["dot"] * 3
    (left, low), _, (right, high) = line.places
    assert left < right and low < high, "up is up"


ends = st.floats(1e-3, 1e3)


@given(ends, st.floats(1.01, 1e4), st.booleans())
def test_ticks_are_few_round_and_inside(low, factor, log):
    axis = drawing.fit_axis([low, low * factor], "", log=log)
    ticks = axis.ticks()
    assert 1 <= len(ticks) <= 8 and ticks == sorted(set(ticks))
    assert all(axis.low * 0.998 <= t <= axis.high * 1.002 for t in ticks)
    assert axis.place(axis.low) == 0 and axis.place(axis.high) == 1
    assert all(axis.place(a) < axis.place(b) for a, b in pairwise(ticks))
    assert len({axis.write(t) for t in ticks}) == len(ticks)


@given(st.lists(st.one_of(st.none(), st.floats(-1e6, 1e6)), max_size=5), st.booleans())
def test_an_axis_takes_any_values(values, log):
    axis = drawing.fit_axis(values, "", log=log)
    assert axis.low < axis.high and (not log or axis.low > 0)
    for v in values:
        assert v is None or 0 <= axis.place(v) <= 1


def test_figures_of_one_panel_stand_side_by_side():
    one, two = (Figure("t", "c", [Panel("t", Axis(0, 1), Axis(0, 1))] * n, []) for n in (1, 2))
    made = ET.fromstring(f"<div>{page.figures_markup([one, one, two, one])}</div>")
    assert [(part.get("class"), len(part.findall("figure"))) for part in made] == [
        ("figures", 2),
        (None, 0),
        ("figures", 1),
    ]


@pytest.mark.parametrize("result", SOURCES, indirect=True)
@pytest.mark.parametrize("one_scene", [False, True])
def test_the_console_prints_the_papers_figures_also_for_one_scene(result, one_scene, capsys):
    if one_scene:
        result = {**result, "rows": [row for row in result["rows"] if row["scene"] == archived.SCENES[0]]}
    report.print_brief(result)
    printed = capsys.readouterr().out
    for quoted in SOURCES[result["experiment"]]:
        for name, line in quoted.lines.items():
            assert all(cell in printed for cell in line.values()), f"{quoted.where}: {name}"
        assert " ".join(quoted.notes) in " ".join(printed.split())


# ---------------------------------------------------------------------------------------------------- the knee


def test_the_knee_stands_in_the_table_and_in_the_figures():
    result = archived.calibration()
    numbers = {0.1: (0.55, 0.10), 0.3: (0.40, 0.05), 0.5: (0.10, 0.045)}
    for threshold, (coverage, error) in numbers.items():
        result["summary"][f"paper.at_{threshold}.coverage"]["value"] = coverage
        result["summary"][f"paper.at_{threshold}.median_rel"]["value"] = error
    result["summary"]["paper.coverage"]["value"], result["summary"]["paper.median_rel"]["value"] = 0.65, 0.13
    assert layouts.threshold_knee(result, "paper") == "0.3"
    (table,) = [t for t in layouts.layout_tables(result) if t.title.startswith("Selective threshold, paper")]
    assert [row[0] for row in table.rows] == ["0", "0.1", "0.3 (knee)", "0.5"] and "at 0.3" in table.note
    figures = {figure.title: figure for figure in plots.result_figures(result)}
    for title in ("Threshold on the score", "Risk against coverage"):
        tips = [mark.tooltip for panel in figures[title].panels for mark in panel.marks if "knee" in mark.tooltip]
        assert tips and layouts.KNEE_DEFINITION in figures[title].caption, title
    (tip,) = [
        m.tooltip for p in figures["Threshold on the score"].panels for m in p.marks if "paper, knee" in m.tooltip
    ]
    assert "score from 0.3" in tip
    result["summary"]["paper.at_0.3.median_rel"]["n"] -= 1
    assert layouts.threshold_knee(result, "paper") == "0.1", "a threshold at which a scene is silent is no point"
