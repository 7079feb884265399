"""Results as one self-contained HTML page: tables, figures, settings, verdicts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path

from dhtorch.experiments.report import job_figure, jobs, published
from dhtorch.experiments.report.figure import Figure
from dhtorch.experiments.report.layouts import SHOWN_COLUMNS, layout_tables
from dhtorch.experiments.report.plots import result_figures
from dhtorch.experiments.report.reading import Result
from dhtorch.experiments.report.tables import INTERVAL_LABEL, PUBLISHED_LABEL, ReportTable, full_tables, generic_tables
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count
from dhtorch.runtime.output_folder import open_output_file
from dhtorch.viz.plots import LegendKey, render_inline_svg
from dhtorch.viz.plots.colours import to_css_colour
from dhtorch.viz.plots.document import build_document
from dhtorch.viz.plots.markup import Markup, join_markup, make_tag

PAGE_CSS = Path(__file__).with_name("page.css")

#: Longest text, in letters, that is not wrapped in a column of labels.
_MAX_COLUMN_LETTERS = 60

#: Data settings with sequences of a benchmark that the paper uses.
_BENCHMARK_DATA = ("tum11", "arkit5")

_VERDICT_CLASSES = {"supported": "good", "refuted": "bad", "undecided": "open"}


def render_report(results: Sequence[Result]) -> str:
    """Render results as one well-formed HTML page.

    Args:
        results: valid ones, as from :func:`dhtorch.runtime.results.read_result`.
    """
    title = "dhtorch: results"
    names = _section_ids(results)
    sections = [_section(result, name) for result, name in zip(results, names, strict=True)]
    skip = make_tag("a", "To the results", href=f"#{names[0]}" if names else "#", class_="skip")
    swept = jobs.jobs_table(results)
    sweep = _sweep(results, swept) if swept and _is_one_sweep(results) else ""
    overview = _overview(results, names)
    if any(layout_tables(result) for result in results):
        top = make_tag("header", make_tag("h1", title), make_tag("p", _about(results), class_="lead"), sweep, overview)
        return build_document(title, skip, top, make_tag("main", *sections), own=PAGE_CSS)
    # without lines of the paper the numbers come first
    top = make_tag("header", make_tag("h1", title), sweep)
    return build_document(title, skip, top, make_tag("main", *sections), make_tag("footer", overview), own=PAGE_CSS)


def _sweep(results: Sequence[Result], table: ReportTable) -> Markup:
    """Table of the jobs of a sweep, and their curves along the swept option."""
    figure = job_figure.sweep_figure(results)
    return join_markup((table_markup(table), figures_markup([figure]) if figure else ""))


def _is_one_sweep(results: Sequence[Result]) -> bool:
    """Whether all results are of one experiment, so that one table can compare them."""
    return len({result["experiment"] for result in results}) == 1


def write_report(path: Path, results: Sequence[Result]) -> Path:
    """Write the page of some results to a file.

    Raises:
        ValueError: the path is a folder, or does not end in .html.
        OSError: the file cannot be written.
    """
    if path.is_dir():
        raise ValueError(f"{path}: found a folder, expected the name of an HTML file")
    if path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"{path}: found {path.suffix or 'no ending'}, expected a name that ends in .html")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: folder {path.parent} does not exist")
    with open_output_file(path, "--html"):
        return storage.replace_file(path, render_report(results).encode("utf-8"))


def _section_ids(results: Sequence[Result]) -> list[str]:
    """HTML ids of the sections."""
    return [f"result-{k + 1}" for k in range(len(results))]


def _about(results: Sequence[Result]) -> Markup:
    """Introduction: number of results, source of the quoted figures, and data of the results."""
    names = dict.fromkeys(result["data"]["name"] for result in results)
    benchmark_names, other_names = (
        [n for n in names if (n in _BENCHMARK_DATA) == in_benchmark] for in_benchmark in (True, False)
    )
    sentences = [f" marks figures quoted from “{published.PAPER_CITATION}”, measured on the paper’s own data."]
    if other_names:
        sentences.append(
            f"That data could not be downloaded for these results: ours are from other scenes"
            f" ({', '.join(other_names)})."
        )
    if benchmark_names:
        sentences.append(
            f"Of its benchmarks the paper does not name the sequences; ours are {', '.join(benchmark_names)}."
        )
    sentences.append("The two are shown side by side for orientation: no line reproduces a line of the paper.")
    count = f"Everything on this page comes from {format_count(len(results), 'archived result file')}. "
    return join_markup((count, make_tag("span", PUBLISHED_LABEL, class_="theirs-word"), " ".join(sentences)))


def _overview(results: Sequence[Result], references: Sequence[str]) -> Markup:
    """Table of all results with links to their sections."""
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
            result["why"] or "no question",
        ]
        kinds = ("", "num", "num", "", "why")
        rows.append(
            make_tag("tr", link, *(make_tag("td", c, class_=k or None) for c, k in zip(cells, kinds, strict=True)))
        )
    head = make_tag("thead", make_tag("tr", *(make_tag("th", h, scope="col") for h in heads)))
    table = make_tag("table", make_tag("caption", make_tag("span", "All results")), head, make_tag("tbody", *rows))
    return make_tag("nav", _scrolling(table, "All results"), aria_label="Results")


def _badge(result: Result) -> Markup:
    """Verdict of a result as a coloured label; a dash without a verdict."""
    verdict = result["verdict"]
    return make_tag("span", verdict, class_=f"badge {_VERDICT_CLASSES[verdict]}") if verdict else make_tag("span", "–")


def _section(result: Result, name: str) -> Markup:
    """Section of one result: facts, question, the paper's tables, figures, all tables, settings."""
    data, meta = result["data"], result["meta"]
    title = result["experiment"].replace("_", " ")
    heading = make_tag("h2", title, " ", make_tag("small", f"on {data['name']}"), id=f"{name}-title")
    machine = f"{meta['device']}, {meta['dtype']}, {format_count(meta['threads'], 'thread')}, seed {meta['seed']}"
    counts = f"{format_count(len(data['scenes']), 'scene')}, {format_count(data['n_pairs'], 'pair')}"
    facts = f"{counts} · {meta['utc']} · code {meta['git'] or 'unknown'} · {machine}"
    paper_tables, figures = layout_tables(result), result_figures(result)
    generics = generic_tables(result, SHOWN_COLUMNS)
    leading = [] if paper_tables or result["verdict"] else generics[:1]  # the main table comes before the facts
    parts = [heading, *map(table_markup, leading), make_tag("p", facts, class_="facts"), _question(result)]
    parts += map(table_markup, paper_tables)
    parts.append(figures_markup([figure for figure in figures if not figure.folded]))
    folded = [figure_markup(figure) for figure in figures if figure.folded]
    parts += [make_tag("details", make_tag("summary", "The other variants"), *folded)] if folded else []
    tables = [table_markup(table) for table in generics[len(leading) :]]
    everything = [table_markup(table) for table in full_tables(result)]
    parts += [
        make_tag(
            "details",
            make_tag("summary", "By scene and by gate"),
            *tables,
            open=None if paper_tables else "open",
        ),
        make_tag("details", make_tag("summary", "Every number of the result file"), *everything),
        _settings(result),
    ]
    return make_tag("section", *parts, id=name, aria_labelledby=f"{name}-title")


def _question(result: Result) -> Markup:
    """Question, expectation and verdict of a result."""
    if result["verdict"] is None:
        return make_tag("p", "The main job has no question and no verdict.", class_="facts")
    texts = [(k, result[k.lower()]) for k in ("Question", "Expectation")]
    pairs = [(make_tag("dt", k), make_tag("dd", text)) for k, text in texts]
    pairs.append((make_tag("dt", "Verdict"), make_tag("dd", _badge(result), " ", result["why"])))
    return make_tag("dl", *(part for pair in pairs for part in pair), class_="question")


def _settings(result: Result) -> Markup:
    """Folded configuration of a result, with its key and the versions of libraries."""
    meta = result["meta"]
    versions = ", ".join(f"{k} {v}" for k, v in meta["versions"].items() if v)
    lines = (("key", result["key"]), ("data digest", result["data"]["digest"]), ("versions", versions))
    facts = make_tag(
        "dl", *(part for k, v in lines for part in (make_tag("dt", k), make_tag("dd", v))), class_="question"
    )
    text = storage.dump_strict_json(result["config"], indent=2)
    return make_tag("details", make_tag("summary", "Configuration"), facts, make_tag("pre", text))


# ---------------------------------------------------------------------------------------------- tables and figures


def table_markup(table: ReportTable) -> Markup:
    """Markup of a table with caption, headings and note; wide tables scroll inside their own frame.

    A text repeated in consecutive columns becomes one cell that spans them; long words are broken into lines.
    """
    theirs = {k for k, name in enumerate(table.head) if name == PUBLISHED_LABEL}
    first = table.n_label

    def cells(at: int, row: Sequence[str], kind: str) -> Markup:
        tags = []
        for k, text, span in _merge_cells(row, first):
            cell = make_tag("strong", text) if (at, k) in table.best else text
            if k == 0:
                tags.append(make_tag("th", cell, scope="row"))
                continue
            style = (
                ("why " if len(text) > _MAX_COLUMN_LETTERS else "")
                if k < first
                else "num "
                if _is_short(text)
                else "word "
            )
            style = (style + "theirs-cell" * (k in theirs)).strip()
            tags.append(make_tag("td", cell, class_=style or None, colspan=span if span > 1 else None))
        return make_tag("tr", *tags, class_=kind or None)

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
    markup = make_tag("table", make_tag("caption", make_tag("span", table.title)), make_tag("thead", *heads), *bodies)
    note = make_tag("p", table.note, class_="note") if table.note else ""
    return join_markup((_scrolling(markup, table.title), note))


def _spanning_headings(over: Sequence[tuple[str, int]]) -> list[Markup]:
    """Cells of the row of upper headings."""
    tags = []
    for text, span in over:
        if text:
            tags.append(make_tag("th", text, colspan=span, scope="colgroup", class_="over"))
        else:
            tags.append(make_tag("td", colspan=span if span > 1 else None))
    return tags


def _heading(k: int, name: str, n_label: int, theirs: bool) -> Markup:
    """Cell of a column's heading; empty for a column without a name."""
    if not name:
        return make_tag("td")
    style = ("num " if k >= n_label else "") + ("theirs-cell" if theirs else "")
    return make_tag("th", name, scope="col", class_=style.strip() or None)


def _merge_cells(row: Sequence[str], first: int) -> Iterator[tuple[int, str, int]]:
    """Column, text and span of the cells of a row; equal texts in consecutive columns from ``first`` on are merged."""
    k = 0
    while k < len(row):
        end = k + 1
        while end < len(row) and k >= first and row[end] == row[k] and not _is_short(row[k]):
            end += 1
        yield k, row[k], end - k
        k = end


def _is_short(cell: str) -> bool:
    """Whether a cell is a number, aligned right, rather than a text such as a reason for its absence."""
    return " " not in cell or any(c.isdigit() for c in cell)


def _scrolling(table: Markup, label: str) -> Markup:
    """A table inside a frame that scrolls horizontally."""
    return make_tag("div", table, class_="scroll", tabindex="0", role="region", aria_label=label)


def figure_markup(figure: Figure) -> Markup:
    """Markup of a figure: caption, legend, and panels side by side if the page is wide enough."""
    legend = [make_tag("li", _swatch(key), key.text) for key in figure.legend]
    below = make_tag("figcaption", make_tag("strong", f"{figure.title}. "), figure.caption)
    drawn = [Markup(render_inline_svg(panel)) for panel in figure.panels]
    panels = make_tag("div", *drawn, class_="panels wide" if figure.wide else "panels")
    return make_tag("figure", below, make_tag("ul", *legend, class_="legend") if legend else "", panels)


def figures_markup(drawn: Sequence[Figure]) -> Markup:
    """Markup of figures, one below the other; those of one panel are side by side if the page is wide enough."""
    parts = []
    for single_panel, group in groupby(drawn, key=lambda figure: len(figure.panels) == 1 and not figure.wide):
        each = [figure_markup(figure) for figure in group]
        parts.append(make_tag("div", *each, class_="figures") if single_panel else join_markup(each))
    return join_markup(parts)


def _swatch(key: LegendKey) -> Markup:
    """Sample of the colour and shape of a legend entry."""
    dashed = " again" if key.stroke and key.stroke.dashes else ""
    return make_tag("span", class_=f"swatch {key.shape}{dashed}", style=f"color: {to_css_colour(key.colour)}")
