"""Archived results as tables of text cells: the generic tables of every experiment and builders for the layouts."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from dhtorch.codes import words
from dhtorch.experiments.report.cells import (
    EMPTY_CELL,
    NON_METRIC_FIELDS,
    Result,
    Row,
    cohort_names,
    describe_result,
    flatten_row,
    format_exact,
    format_metric_interval,
    format_value,
    last_cohort,
    metric_heading,
    metric_value,
    scene_label,
    scene_rows,
    summary_entry,
    variant_names,
)
from dhtorch.experiments.report.published import PublishedTable
from dhtorch.runtime.console import format_count

#: Lines of a table: (pattern of our variant, its label or None = its own name, the paper's line or None).
KnownLines = Sequence[tuple[str, str | None, str | None]]

#: Label of the row with the intervals over scenes.
INTERVAL_LABEL = "95 % interval"
#: Labels of lines and columns that quote the paper, and of columns with the numbers of the result.
PUBLISHED_LABEL, OURS_LABEL = "published", "ours"

#: Columns of the main table, one row per scene; the optional ones appear if the result has them.
MAIN_COLUMNS = ("n_candidates", "coverage", "median_rel", "p90_rel", "corr", "residual_px", "pnp_success")
_OPTIONAL_COLUMNS = ("truth_kept", "n_real_holes", "wrong_share", "aurc", "ece")
#: Metrics of every scene that are only in the full tables.
_DETAIL_METRICS = (
    *("within_sigma", "within_2sigma", "aurc_excess", "aurc_full", "augrc", "monotonicity", "ece_equal_mass"),
    *("coverage_at_5", "coverage_at_10", "coverage_at_20", "cutoff_m", "n_pairs", "n_few", "n_kept", "n_holes"),
    "n_recovered",
)
#: Groups of metrics with a table of their own: name → title.
_METRIC_GROUPS = {
    "n_dropped": "truth dropped",
    "hole_share": "holes by class",
    "route_share": "ways to fill the holes",
    "gate_share": "samples by gate",
    "ms": "milliseconds per pair",
}


@dataclass(frozen=True)
class ReportTable:
    """Table of text cells, with the kind of its rows and the span of its headings."""

    title: str
    head: list[str]
    rows: list[list[str]]
    n_label: int = 1  # number of leading columns with labels
    footer: int = 0  # number of summary rows, after the body
    quoted: int = 0  # number of rows of the paper, last
    over: tuple[tuple[str, int], ...] = ()  # upper headings: (text, number of columns)
    note: str = ""  # text below the table
    best: frozenset[tuple[int, int]] = frozenset()  # (row, column) of highlighted cells

    @property
    def cites_paper(self) -> bool:
        """Whether figures of the paper stand in rows or columns."""
        return self.quoted > 0 or PUBLISHED_LABEL in self.head

    def flat_head(self) -> list[str]:
        """One heading per column, prefixed by its upper heading."""
        above = [text for text, span in self.over for _ in range(span)] or [""] * len(self.head)
        return [", ".join(filter(None, pair)) for pair in zip(above, self.head, strict=True)]


def generic_tables(result: Result, shown: Sequence[str] = ()) -> list[ReportTable]:
    """Tables of any result: errors by scene for every cohort, further columns except ``shown``, and metric groups."""
    rows, tables = scene_rows(result), []
    if any(metric in row for row in rows for metric in MAIN_COLUMNS) or (rows and all(row.get("note") for row in rows)):
        measured = {m: [row[m] for row in rows if row.get(m) is not None] for m in _OPTIONAL_COLUMNS}
        # a count has a column where any row has more than none
        optional = [m for m, values in measured.items() if (any(values) if m.startswith("n_") else values)]
        for truth in cohort_names(result):
            title = describe_result(result) + f"; ground truth: {truth}" * (len(cohort_names(result)) > 1)
            tables.append(scene_table(result, title, (*MAIN_COLUMNS, *optional), truth))
        excluded = {*_DETAIL_METRICS, *MAIN_COLUMNS, *_OPTIONAL_COLUMNS, *NON_METRIC_FIELDS, *shown}
        scalars = dict.fromkeys(k for row in rows for k, v in row.items() if isinstance(v, int | float))
        more = [m for m in scalars if m not in excluded]
        tables += [scene_table(result, "further columns", more)] if more else []
    elif rows:  # without candidates, such as timings: one column per field
        names = [k for k in dict.fromkeys(k for row in rows for k in row) if k not in ("pair", "curves", "overlay")]
        shown_names = [k for k in names if any(not isinstance(r.get(k), Mapping | None) for r in rows)]
        n_label = next((k for k, n in enumerate(shown_names) if not isinstance(rows[0].get(n), str)), len(shown_names))
        body = [[format_value(row.get(name), name) for name in shown_names] for row in rows]
        tables.append(
            ReportTable(describe_result(result), list(map(metric_heading, shown_names)), body, max(1, n_label))
        )
    # surfaces that are evaluated separately, such as mirrors
    columns = ("n_candidates", "coverage", "median_rel", "p90_rel", "corr")
    apart = [
        [kind, v, *(format_value(summary_entry(result, v, f"apart.{kind}.{m}").get("value"), m) for m in columns)]
        for kind in dict.fromkeys(kind for row in rows for kind in row.get("apart") or {})
        for v in variant_names(result)
    ]
    heads = ["surface", "method", *map(metric_heading, columns)]
    tables += [ReportTable("surfaces evaluated separately", heads, apart, 2)] if apart else []
    return tables + [table for item in _METRIC_GROUPS.items() if (table := _group_table(result, *item))]


def scene_table(
    result: Result,
    title: str,
    columns: Sequence[str],
    truth: str | None = None,  # None = the cohort of the verdict
    quoted: PublishedTable | None = None,
) -> ReportTable:
    """Table by scene and variant, then the summary over scenes without a role, then the paper's lines."""
    truth = truth or last_cohort(result)
    rows = scene_rows(result, truth)
    order = list(dict.fromkeys(row["scene"] for row in result["rows"]))
    n_label = 1 + (len(variant_names(result)) > 1)
    pairs = [(r["scene"], r["method"]) for r in result["rows"] if r["pair"] is not None and r.get("truth") == truth]

    def count_pairs(row: Row) -> int:  # an archived result may lack the rows of its pairs
        return pairs.count((row["scene"], row["method"])) if pairs else row.get("n_pairs") or 0

    body, footer = [], []
    for row in sorted(rows, key=lambda row: order.index(row["scene"])):
        cells = [format_value(metric_value(row, m), m) for m in columns]
        cells = [row["note"] if cell == EMPTY_CELL and row.get("note") else cell for cell in cells]
        body.append([*(scene_label(row), row["method"])[:n_label], str(count_pairs(row)), *cells])
    for method in dict.fromkeys(row["method"] for row in rows if not row.get("role")):
        counted = [row for row in rows if row["method"] == method and not row.get("role")]
        n, n_skipped = len(counted), sum(bool(row.get("note")) for row in counted)
        n_scenes = f"{n - n_skipped} of {format_count(n, 'scene')}" if n_skipped else format_count(n, "scene")
        n_pairs = str(sum(map(count_pairs, counted)))
        cells = [_number_over_scenes(result, method, m, truth) for m in columns]
        footer.append([*(n_scenes, method)[:n_label], n_pairs, *cells])
        entries = {m: {} if m in DERIVED_NUMBERS else summary_entry(result, method, m, truth) for m in columns}
        intervals = [format_metric_interval(e.get("low"), e.get("high"), m) for m, e in entries.items()]
        footer += [[*(INTERVAL_LABEL, method)[:n_label], "", *intervals]] if any(intervals) else []
    cited = [
        [f"{PUBLISHED_LABEL}: {name}", *[""] * n_label, *(cells.get(m, EMPTY_CELL) for m in columns)]
        for name, cells in (quoted.lines if quoted else {}).items()
    ]
    single = pairs and all(r["pair"][0] == r["pair"][1] for r in result["rows"] if r["pair"] is not None)
    heads = [*("scene", "method")[:n_label], "frames" if single else "pairs", *map(metric_heading, columns)]
    note = published_source(result, quoted) if quoted else ""
    return ReportTable(title, heads, body + footer + cited, n_label, len(footer), len(cited), note=note)


def variant_table(
    result: Result,
    title: str,
    columns: Sequence[str],
    lines: KnownLines | None = None,
    published: PublishedTable | None = None,
    truth: str | None = None,  # None = the cohort of the verdict
    *,
    only: Callable[[str | None, str | None], bool] = lambda variant, paper: True,
) -> ReportTable:
    """Table by variant with summaries over scenes and the paper's figures beside them; its other lines follow.

    Known lines come first, in their order; of them and the other variants those that ``only`` accepts, by our name and
    the paper's.
    """
    truth = truth or last_cohort(result)
    theirs = published.lines if published else {}
    chosen = [line for line in match_lines(result, lines or ()) if only(*line[1:])]
    used = [paper for _, _, paper in chosen if paper]
    double = {m for m in columns if any(m in theirs[p] for p in used)}
    body = []
    for label, variant, paper in chosen:
        cells = [label]
        for metric in columns:
            cells.append("not run" if variant is None else _number_over_scenes(result, variant, metric, truth))
            cells += [theirs.get(paper or "", {}).get(metric, EMPTY_CELL)] * (metric in double)
        body.append(cells)
    cited = [
        [f"{PUBLISHED_LABEL}: {name}", *(x for m in columns for x in [""] * (m in double) + [cells.get(m, EMPTY_CELL)])]
        for name, cells in theirs.items()
        if name not in used
    ]
    note = published_source(result, published) if published else ""
    heads = ["", *map(metric_heading, columns)]
    over: tuple[tuple[str, int], ...] = ()
    if double:
        over = (("", 1), *((metric_heading(m), 2) if m in double else ("", 1) for m in columns))
        pairs = ((OURS_LABEL, PUBLISHED_LABEL) if m in double else (metric_heading(m),) for m in columns)
        heads = ["", *(head for pair in pairs for head in pair)]
    return ReportTable(title, heads, body + cited, quoted=len(cited), over=over, note=note)


def match_lines(result: Result, known: KnownLines) -> list[tuple[str, str | None, str | None]]:
    """(label, our variant, the paper's line): known lines with the variants that match, then the other variants."""
    lines: list[tuple[str, str | None, str | None]] = []
    used: set[str] = set()
    for pattern, label, paper in known:
        matching = [v for v in variant_names(result) if v not in used and re.fullmatch(pattern, v)]
        used.update(matching)
        for variant in matching:
            same_name = paper is None or paper.lower().startswith(variant.lower())
            shown = label or (variant if same_name else f"{variant} ({PUBLISHED_LABEL}: {paper})")
            lines.append((shown, variant, paper))
        lines += [] if matching else [(label or paper or pattern, None, paper)]
    return lines + [(variant, variant, None) for variant in variant_names(result) if variant not in used]


def full_tables(result: Result) -> list[ReportTable]:
    """All numbers of a result with five digits: summary, scenes, pairs."""
    tables = []
    if result["summary"]:
        fields = ("value", "low", "high", "n", "unit")
        rows = [[name, *(format_exact(e[k]) for k in fields)] for name, e in result["summary"].items()]
        tables.append(ReportTable("Summary over scenes", ["metric", *fields], rows))
    for title, pairs in (("Scenes", False), ("Pairs", True)):
        flat = [(row, flatten_row(row)) for row in result["rows"] if (row["pair"] is not None) == pairs]
        labels = [k for k in ("scene", "pair", "method", "truth", "role", "note") if any(k in row for row, _ in flat)]
        metrics = list(dict.fromkeys(m for _, numbers in flat for m in numbers))
        body = [
            [*(format_exact(row.get(k)) for k in labels), *(format_exact(numbers.get(m)) for m in metrics)]
            for row, numbers in flat
        ]
        tables += [ReportTable(title, [*labels, *metrics], body, len(labels))] if flat else []
    return tables


def published_source(result: Result, quoted: PublishedTable) -> str:
    """Note with the source and data of the paper's figures and the data of the result."""
    ours = f"Ours: {result['data']['name']}, {format_count(len(result['data']['scenes']), 'scene')}."
    return " ".join((f"Published: {quoted.where}, {quoted.data}.", *quoted.notes, ours))


def _range_over(rows: Sequence[Row]) -> str:
    """Cell with the smallest and the largest median error over scenes."""
    errors = [row["median_rel"] for row in rows if row.get("median_rel") is not None]
    return format_metric_interval(min(errors), max(errors), "median_rel") if errors else EMPTY_CELL


def _passes(rows: Sequence[Row]) -> str:
    """Cell with the number of scenes that pass, of those tested."""
    passed = [bool(row["passes"]) for row in rows if row.get("passes") is not None]
    return f"{sum(passed)}/{len(passed)}" if passed else EMPTY_CELL


#: Columns computed from the rows of the scenes instead of the summary.
DERIVED_NUMBERS: dict[str, Callable[[Sequence[Row]], str]] = {
    "n_scenes": lambda rows: str(sum(not row.get("note") for row in rows)),
    "range": _range_over,
    "passes": _passes,
}


def _number_over_scenes(result: Result, variant: str, metric: str, truth: str | None) -> str:
    """Cell of a metric over scenes without a role; the notes of the scenes if none was measured."""
    rows = [row for row in scene_rows(result, truth, variant) if not row.get("role")]
    value = summary_entry(result, variant, metric, truth).get("value")
    if value is None:  # texts, such as a device, are only in the rows
        texts = {row[metric] for row in rows if isinstance(row.get(metric), str)}
        value = texts.pop() if len(texts) == 1 else None
    cell = format_value(value, metric) if metric not in DERIVED_NUMBERS else DERIVED_NUMBERS[metric](rows)
    notes = [row["note"] for row in rows if row.get("note")]
    all_skipped = cell == EMPTY_CELL and len(notes) == len(rows) > 0
    return "; ".join(dict.fromkeys(notes)) if all_skipped else cell


def _group_table(result: Result, group: str, title: str) -> ReportTable | None:
    """Table with one row per variant and one column per member of a metric group; None without members."""
    split = [f".{name}".split(f".{group}.", 1) for name in result["summary"]]
    members = list(dict.fromkeys(parts[1] for parts in split if len(parts) > 1))
    rows = []
    for variant in variant_names(result):
        values = [summary_entry(result, variant, f"{group}.{m}").get("value") for m in members]
        total = [format_value(sum(v or 0 for v in values), f"{group}.")] if group == "ms" else []
        rows.append([variant, *(format_value(v, f"{group}.{m}") for v, m in zip(values, members, strict=True)), *total])
    if len(rows) > 1 and all(row[1:] == rows[0][1:] for row in rows):
        rows = [["all methods", *rows[0][1:]]]
    heads = ["method", *map(words, members), *(["total"] if group == "ms" else [])]
    return ReportTable(title, heads, rows) if members and rows else None
