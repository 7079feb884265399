"""Results as one self-contained HTML page: tables, figures, settings, verdicts."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path

from dhtorch.experiments.report import jobs
from dhtorch.experiments.report.cells import Result
from dhtorch.experiments.report.figures import Figure, result_figures
from dhtorch.experiments.report.layouts import SHOWN_COLUMNS, layout_tables
from dhtorch.experiments.report.published import PAPER_CITATION
from dhtorch.experiments.report.tables import INTERVAL_LABEL, PUBLISHED_LABEL, ReportTable, full_tables, generic_tables
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count
from dhtorch.runtime.output_folder import open_output_file
from dhtorch.viz.plots import encode_uri
from dhtorch.viz.plots.markup import Markup, build_document, join_markup, make_tag

PAGE_CSS = Path(__file__).with_name("page.css")


def render_report(results: Sequence[Result]) -> str:
    """Render results as one well-formed HTML page.

    Args:
        results: valid ones, as from :func:`dhtorch.runtime.results.read_result`.
    """
    title = make_tag("h1", "dhtorch: results")
    sections = [_section(result, f"result-{k + 1}") for k, result in enumerate(results)]
    skip = make_tag("a", "To the results", href="#result-1" if results else "#", class_="skip")
    swept = jobs.jobs_table(results)
    is_sweep = swept is not None and len({result["experiment"] for result in results}) == 1
    figure = jobs.sweep_figure(results) if is_sweep else None
    sweep = join_markup([table_markup(swept) if swept and is_sweep else "", figures_markup([figure] if figure else [])])
    overview, main = _overview(results), make_tag("main", *sections)
    if any(layout_tables(result) for result in results):
        # Introduction: number of results, source of the quoted figures, and data of the results
        names = dict.fromkeys(result["data"]["name"] for result in results)
        of_paper = ("tum11", "arkit5")  # sequences of benchmarks that the paper uses
        benchmark, other = ([n for n in names if (n in of_paper) == is_in] for is_in in (True, False))
        sentences = [f" marks figures quoted from “{PAPER_CITATION}”, measured on the paper’s own data."]
        if other:
            sentences.append("That data could not be downloaded for these results: ours are from other scenes")
            sentences[-1] += f" ({', '.join(other)})."
        if benchmark:
            sentences.append(
                f"Of its benchmarks the paper does not name the sequences; ours are {', '.join(benchmark)}."
            )
        sentences.append("The two are shown side by side for orientation: no line reproduces a line of the paper.")
        count = f"Everything on this page comes from {format_count(len(results), 'archived result file')}. "
        body = [
            make_tag(
                "header",
                title,
                make_tag(
                    "p",
                    join_markup((count, make_tag("span", PUBLISHED_LABEL, class_="theirs-word"), " ".join(sentences))),
                    class_="lead",
                ),
                sweep,
                overview,
            ),
            main,
        ]
    else:  # without lines of the paper the numbers come first
        body = [make_tag("header", title, sweep), main, make_tag("footer", overview)]
    return build_document("dhtorch: results", skip, *body, own=PAGE_CSS)


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


def _overview(results: Sequence[Result]) -> Markup:
    """Table of all results with links to their sections."""
    rows = []
    for k, result in enumerate(results):
        data = result["data"]
        link = make_tag("th", make_tag("a", result["experiment"], href=f"#result-{k + 1}"), scope="row")
        cells = ((data["name"], None), (len(data["scenes"]), "num"), (data["n_pairs"], "num"), (_badge(result), None))
        kinds = (*cells, (result["why"] or "no question", "why"))
        rows.append(make_tag("tr", link, *(make_tag("td", cell, class_=kind) for cell, kind in kinds)))
    heads = ("experiment", "data", "scenes", "pairs", "verdict", "why")
    head = make_tag("thead", make_tag("tr", *(make_tag("th", h, scope="col") for h in heads)))
    table = make_tag("table", make_tag("caption", make_tag("span", "All results")), head, make_tag("tbody", *rows))
    return make_tag("nav", _scrolling(table, "All results"), aria_label="Results")


def _badge(result: Result) -> Markup:
    """Verdict of a result as a coloured label; a dash without a verdict."""
    kind = {"supported": "badge good", "refuted": "badge bad", "undecided": "badge open"}.get(result["verdict"])
    return make_tag("span", result["verdict"] or "–", class_=kind)


def _section(result: Result, name: str) -> Markup:
    """Section of one result: facts, question, the paper's tables, figures, all tables, settings."""
    data, meta = result["data"], result["meta"]
    small = make_tag("small", f"on {data['name']}")
    heading = make_tag("h2", result["experiment"].replace("_", " "), " ", small, id=f"{name}-title")
    machine = f"{meta['device']}, {meta['dtype']}, {format_count(meta['threads'], 'thread')}, seed {meta['seed']}"
    counts = f"{format_count(len(data['scenes']), 'scene')}, {format_count(data['n_pairs'], 'pair')}"
    facts = make_tag("p", f"{counts} · {meta['utc']} · code {meta['git'] or 'unknown'} · {machine}", class_="facts")
    paper_tables, generics, figures = (
        layout_tables(result),
        generic_tables(result, SHOWN_COLUMNS),
        result_figures(result),
    )
    leading = [] if paper_tables or result["verdict"] else generics[:1]  # the main table comes before the facts
    question = make_tag("p", "The main job has no question and no verdict.", class_="facts")
    if result["verdict"] is not None:
        verdict = join_markup((_badge(result), " ", result["why"]))
        question = _definitions(
            {"Question": result["question"], "Expectation": result["expectation"], "Verdict": verdict}
        )
    versions = ", ".join(f"{k} {v}" for k, v in meta["versions"].items() if v)
    digests = _definitions({"key": result["key"], "data digest": data["digest"], "versions": versions})
    config = make_tag("pre", storage.dump_strict_json(result["config"], indent=2))
    parts = [heading, *map(table_markup, leading), facts, question, *map(table_markup, paper_tables)]
    parts.append(figures_markup([figure for figure in figures if not figure.folded]))
    if folded := [figures_markup([figure]) for figure in figures if figure.folded]:
        parts.append(_folded("The other variants", folded))
    by_scene = [table_markup(table) for table in generics[len(leading) :]]
    parts.append(_folded("By scene and by gate", by_scene, None if paper_tables else "open"))
    parts.append(_folded("Every number of the result file", map(table_markup, full_tables(result))))
    return make_tag(
        "section", *parts, _folded("Configuration", (digests, config)), id=name, aria_labelledby=f"{name}-title"
    )


def _folded(summary: str, parts: Iterable[Markup], is_open: str | None = None) -> Markup:
    return make_tag("details", make_tag("summary", summary), *parts, open=is_open)


def _definitions(texts: Mapping[str, object]) -> Markup:
    return make_tag(
        "dl", *(make_tag(*part) for k, v in texts.items() for part in (("dt", k), ("dd", v))), class_="question"
    )


def table_markup(table: ReportTable) -> Markup:
    """Markup of a table with caption, headings and note; wide tables scroll inside their own frame.

    A text repeated in consecutive columns becomes one cell that spans them; long words are broken into lines.
    """
    n_body, first = len(table.rows) - table.footer - table.quoted, table.n_label
    kinds = [None] * n_body + ["sum"] * table.footer + ["cited"] * table.quoted
    theirs = [" theirs-cell" * (name == PUBLISHED_LABEL) for name in table.head]
    parts: list[list[Markup]] = [[], [], []]  # body, summary, the paper's
    for at, (row, kind) in enumerate(zip(table.rows, kinds, strict=True)):
        tags, k = [], 0
        while k < len(row):
            text, is_text = row[k], " " in row[k] and not any(c.isdigit() for c in row[k])
            end = k + 1  # a text such as a reason for absence spans the columns that repeat it
            while k >= first and is_text and end < len(row) and row[end] == text:
                end += 1
            style = (" word" if is_text else " num") if k >= first else " why" * (len(text) > 60)
            kind_of_cell = {"class_": (style + theirs[k]).strip() or None, "colspan": end - k if end - k > 1 else None}
            cell = make_tag("strong", text) if (at, k) in table.best else text
            tags.append(make_tag("td", cell, **kind_of_cell) if k else make_tag("th", cell, scope="row"))
            k = end
        shown = make_tag("tr", *tags, class_="interval" if row[0] == INTERVAL_LABEL else kind)
        parts[(kind == "sum") + 2 * (kind == "cited")].append(shown)
    above = [
        make_tag("th", text, colspan=span, scope="colgroup", class_="over")
        if text
        else make_tag("td", colspan=span if span > 1 else None)
        for text, span in table.over
    ]
    names = [
        make_tag("th", name, scope="col", class_=("num" * (k >= first) + theirs[k]).strip() or None)
        if name
        else make_tag("td")
        for k, name in enumerate(table.head)
    ]
    head = make_tag("thead", *[make_tag("tr", *above)] * bool(above), make_tag("tr", *names))
    bodies = [make_tag("tbody", *rows) for rows in parts if rows]
    markup = make_tag("table", make_tag("caption", make_tag("span", table.title)), head, *bodies)
    note = make_tag("p", table.note, class_="note") if table.note else ""
    return join_markup((_scrolling(markup, table.title), note))


def _scrolling(table: Markup, label: str) -> Markup:
    """A table inside a frame that scrolls horizontally."""
    return make_tag("div", table, class_="scroll", tabindex="0", role="region", aria_label=label)


def figures_markup(figures: Sequence[Figure]) -> Markup:
    """Markup of figures; those of one pair of axes are side by side if the page is wide enough."""
    parts = []
    for single, group in groupby(figures, key=lambda figure: len(figure.drawn.axes) == 1):
        each = []
        for figure in group:
            width = round(96 * figure.drawn.get_figwidth())
            source = encode_uri(figure.drawn, "png" if figure.is_raster else "svg")
            image = make_tag("img", src=source, alt=figure.title, style=f"max-width: {width}px")
            caption = make_tag("figcaption", make_tag("strong", f"{figure.title}. "), figure.caption)
            each.append(make_tag("figure", caption, image))
        parts.append(make_tag("div", *each, class_="figures") if single else join_markup(each))
    return join_markup(parts)
