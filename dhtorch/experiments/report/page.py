"""Results as one HTML page that needs nothing beside itself: tables, figures, settings, verdicts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path

from dhtorch.experiments.report import jobs, published
from dhtorch.experiments.report.figure import Figure
from dhtorch.experiments.report.layouts import SHOWN_COLUMNS, layout_tables
from dhtorch.experiments.report.plots import result_figures
from dhtorch.experiments.report.reading import Result
from dhtorch.experiments.report.tables import INTERVAL_LABEL, PUBLISHED_LABEL, ReportTable, full_tables, generic_tables
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count
from dhtorch.viz.plots import LegendKey, render_inline_svg
from dhtorch.viz.plots.colours import to_css_colour
from dhtorch.viz.plots.document import build_document
from dhtorch.viz.plots.markup import Markup, join_markup, make_tag

PAGE_CSS = Path(__file__).with_name("page.css")

#: Letters of a text that a column of words is not widened for.
_MAX_COLUMN_LETTERS = 60

#: Data settings that list sequences of a benchmark that the paper uses.
_BENCHMARK_DATA = ("tum11", "arkit5")

_VERDICT_CLASSES = {"supported": "good", "refuted": "bad", "undecided": "open"}


def render_report(results: Sequence[Result]) -> str:
    """All results as one well-formed page.

    Args:
        results: valid ones, as from :func:`dhtorch.runtime.results.read_result`.
    """
    title = "dhtorch: results"
    names = _section_ids(results)
    sections = [_section(result, name) for result, name in zip(results, names, strict=True)]
    skip = make_tag("a", "To the results", href=f"#{names[0]}" if names else "#", class_="skip")
    swept = jobs.jobs_table(results)
    sweep = table_markup(swept) if swept and _is_one_sweep(results) else ""
    overview = _overview(results, names)
    if any(layout_tables(result) for result in results):
        top = make_tag("header", make_tag("h1", title), make_tag("p", _about(results), class_="lead"), sweep, overview)
        return build_document(title, skip, top, make_tag("main", *sections), own=PAGE_CSS)
    # no line of the paper stands here: the numbers begin
    top = make_tag("header", make_tag("h1", title), sweep)
    return build_document(title, skip, top, make_tag("main", *sections), make_tag("footer", overview), own=PAGE_CSS)


def _is_one_sweep(results: Sequence[Result]) -> bool:
    """Whether the results are jobs of one kind, which one table can compare."""
    return len({result["experiment"] for result in results}) == 1


def write_report(path: Path, results: Sequence[Result]) -> Path:
    """Write the page.

    Raises:
        ValueError: the name is that of a folder, or does not end in .html.
        OSError: the file cannot be written.
    """
    if path.is_dir():
        raise ValueError(f"{path}: found a folder, expected the name of an HTML file")
    if path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"{path}: found {path.suffix or 'no ending'}, expected a name that ends in .html")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: found no folder {path.parent}, expected one")
    return storage.replace_file(path, render_report(results).encode("utf-8"))


def _section_ids(results: Sequence[Result]) -> list[str]:
    return [f"result-{k + 1}" for k in range(len(results))]


def _about(results: Sequence[Result]) -> Markup:
    names = dict.fromkeys(result["data"]["name"] for result in results)
    same, other = ([n for n in names if (n in _BENCHMARK_DATA) == known] for known in (True, False))
    said = [f" marks figures quoted from “{published.PAPER_CITATION}”, measured on the paper’s own data."]
    if other:
        said.append(
            f"That data could not be downloaded for these results: ours are from other scenes ({', '.join(other)})."
        )
    if same:
        said.append(f"Of its benchmarks the paper does not name the sequences; ours are {', '.join(same)}.")
    said.append("The two stand side by side for orientation: no line reproduces a line of the paper.")
    count = f"Everything on this page comes from {format_count(len(results), 'archived result file')}. "
    return join_markup((count, make_tag("span", PUBLISHED_LABEL, class_="theirs-word"), " ".join(said)))


def _overview(results: Sequence[Result], references: Sequence[str]) -> Markup:
    heads = ("experiment", "data", "scenes", "pairs", "verdict", "why")
    rows = []
    for result, name in zip(results, references, strict=True):
        data = result["data"]
        link = make_tag("th", make_tag("a", result["experiment"], href=f"#{name}"), scope="row")
        cells = [
            data["name"],
            len(data["scenes"]),
            data["n_pairs"],
            _badge(result),
            result["why"] or "asks no question",
        ]
        kinds = ("", "num", "num", "", "why")
        rows.append(
            make_tag("tr", link, *(make_tag("td", c, class_=k or None) for c, k in zip(cells, kinds, strict=True)))
        )
    head = make_tag("thead", make_tag("tr", *(make_tag("th", h, scope="col") for h in heads)))
    table = make_tag("table", make_tag("caption", make_tag("span", "All results")), head, make_tag("tbody", *rows))
    return make_tag("nav", _scrolling(table, "All results"), aria_label="Results")


def _badge(result: Result) -> Markup:
    verdict = result["verdict"]
    return make_tag("span", verdict, class_=f"badge {_VERDICT_CLASSES[verdict]}") if verdict else make_tag("span", "–")


def _section(result: Result, name: str) -> Markup:
    data, meta = result["data"], result["meta"]
    title = result["experiment"].replace("_", " ")
    heading = make_tag("h2", title, " ", make_tag("small", f"on {data['name']}"), id=f"{name}-title")
    machine = f"{meta['device']}, {meta['dtype']}, {format_count(meta['threads'], 'thread')}, seed {meta['seed']}"
    counts = f"{format_count(len(data['scenes']), 'scene')}, {format_count(data['n_pairs'], 'pair')}"
    facts = f"{counts} · {meta['utc']} · code {meta['git'] or 'unknown'} · {machine}"
    paper, drawn = layout_tables(result), result_figures(result)
    generics = generic_tables(result, SHOWN_COLUMNS)
    first = [] if paper or result["verdict"] else generics[:1]  # one's own numbers, before anything is explained
    parts = [heading, *map(table_markup, first), make_tag("p", facts, class_="facts"), _question(result)]
    parts += map(table_markup, paper)
    parts.append(figures_markup([figure for figure in drawn if not figure.folded]))
    folded = [figure_markup(figure) for figure in drawn if figure.folded]
    parts += [make_tag("details", make_tag("summary", "The same of the other variants"), *folded)] if folded else []
    tables = [table_markup(table) for table in generics[len(first) :]]
    everything = [table_markup(table) for table in full_tables(result)]
    parts += [
        make_tag(
            "details",
            make_tag("summary", "By scene, and what became of every sample"),
            *tables,
            open=None if paper else "open",
        ),
        make_tag("details", make_tag("summary", "Every number of the result file"), *everything),
        _settings(result),
    ]
    return make_tag("section", *parts, id=name, aria_labelledby=f"{name}-title")


def _question(result: Result) -> Markup:
    if result["verdict"] is None:
        return make_tag("p", "The main job: it asks no question.", class_="facts")
    said = [(k, result[k.lower()]) for k in ("Question", "Expectation")]
    pairs = [(make_tag("dt", k), make_tag("dd", text)) for k, text in said]
    pairs.append((make_tag("dt", "Verdict"), make_tag("dd", _badge(result), " ", result["why"])))
    return make_tag("dl", *(part for pair in pairs for part in pair), class_="question")


def _settings(result: Result) -> Markup:
    meta = result["meta"]
    versions = ", ".join(f"{k} {v}" for k, v in meta["versions"].items() if v)
    lines = (("key", result["key"]), ("data digest", result["data"]["digest"]), ("versions", versions))
    known = make_tag(
        "dl", *(part for k, v in lines for part in (make_tag("dt", k), make_tag("dd", v))), class_="question"
    )
    text = storage.dump_strict_json(result["config"], indent=2)
    return make_tag("details", make_tag("summary", "Configuration"), known, make_tag("pre", text))


# ---------------------------------------------------------------------------------------------- tables and figures


def table_markup(table: ReportTable) -> Markup:
    """A table with caption, headings and its note; wide ones scroll inside their own frame.

    A reason that stands in several columns in a row is said once, over all of them; long words are broken into lines.
    """
    theirs = {k for k, name in enumerate(table.head) if name == PUBLISHED_LABEL}
    first = table.n_label

    def cells(at: int, row: Sequence[str], kind: str) -> Markup:
        made = []
        for k, text, span in _merge_cells(row, first):
            cell = make_tag("strong", text) if (at, k) in table.best else text
            if k == 0:
                made.append(make_tag("th", cell, scope="row"))
                continue
            style = (
                ("why " if len(text) > _MAX_COLUMN_LETTERS else "")
                if k < first
                else "num "
                if _is_short(text)
                else "word "
            )
            style = (style + "theirs-cell" * (k in theirs)).strip()
            made.append(make_tag("td", cell, class_=style or None, colspan=span if span > 1 else None))
        return make_tag("tr", *made, class_=kind or None)

    n_body = len(table.rows) - table.footer - table.quoted
    kinds = [""] * n_body + ["sum"] * table.footer + ["cited"] * table.quoted
    kinds = ["interval" if row[0] == INTERVAL_LABEL else kind for row, kind in zip(table.rows, kinds, strict=True)]
    groups = [table.rows[:n_body], table.rows[n_body : n_body + table.footer], table.rows[n_body + table.footer :]]
    bodies, at = [], 0
    for group in groups:
        if group:
            numbered = zip(range(at, at + len(group)), group, kinds[at:], strict=False)
            bodies.append(make_tag("tbody", *(cells(n, row, kind) for n, row, kind in numbered)))
        at += len(group)
    heads = [make_tag("tr", *_spanning_headings(table.over))] if table.over else []
    heads.append(make_tag("tr", *(_heading(k, name, first, k in theirs) for k, name in enumerate(table.head))))
    made = make_tag("table", make_tag("caption", make_tag("span", table.title)), make_tag("thead", *heads), *bodies)
    note = make_tag("p", table.note, class_="note") if table.note else ""
    return join_markup((_scrolling(made, table.title), note))


def _spanning_headings(over: Sequence[tuple[str, int]]) -> list[Markup]:
    made = []
    for text, span in over:
        if text:
            made.append(make_tag("th", text, colspan=span, scope="colgroup", class_="over"))
        else:
            made.append(make_tag("td", colspan=span if span > 1 else None))
    return made


def _heading(k: int, name: str, n_label: int, theirs: bool) -> Markup:
    if not name:
        return make_tag("td")
    style = ("num " if k >= n_label else "") + ("theirs-cell" if theirs else "")
    return make_tag("th", name, scope="col", class_=style.strip() or None)


def _merge_cells(row: Sequence[str], first: int) -> Iterator[tuple[int, str, int]]:
    """Column, text and width of the cells of a row: equal words in a row, from column ``first`` on, are one."""
    k = 0
    while k < len(row):
        end = k + 1
        while end < len(row) and k >= first and row[end] == row[k] and not _is_short(row[k]):
            end += 1
        yield k, row[k], end - k
        k = end


def _is_short(cell: str) -> bool:
    """Numbers stand to the right; reasons for their absence are set as words."""
    return " " not in cell or any(c.isdigit() for c in cell)


def _scrolling(table: Markup, label: str) -> Markup:
    return make_tag("div", table, class_="scroll", tabindex="0", role="region", aria_label=label)


def figure_markup(figure: Figure) -> Markup:
    """Panels side by side where there is room, with caption and legend."""
    legend = [make_tag("li", _swatch(key), key.text) for key in figure.legend]
    below = make_tag("figcaption", make_tag("strong", f"{figure.title}. "), figure.caption)
    drawn = [Markup(render_inline_svg(panel)) for panel in figure.panels]
    panels = make_tag("div", *drawn, class_="panels wide" if figure.wide else "panels")
    return make_tag("figure", below, make_tag("ul", *legend, class_="legend") if legend else "", panels)


def figures_markup(drawn: Sequence[Figure]) -> Markup:
    """Figures one below the other; those of one panel stand side by side where there is room."""
    made = []
    for alone, group in groupby(drawn, key=lambda figure: len(figure.panels) == 1 and not figure.wide):
        each = [figure_markup(figure) for figure in group]
        made.append(make_tag("div", *each, class_="figures") if alone else join_markup(each))
    return join_markup(made)


def _swatch(key: LegendKey) -> Markup:
    """What stands for an entry of a legend."""
    again = " again" if key.stroke and key.stroke.dashes else ""
    return make_tag("span", class_=f"swatch {key.shape}{again}", style=f"color: {to_css_colour(key.colour)}")
