"""Archived results as tables of text cells: the generic tables of every experiment and builders for the layouts."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dhtorch.codes import words
from dhtorch.experiments.report.cells import (
    EMPTY_CELL,
    format_exact,
    format_metric_interval,
    format_value,
    metric_heading,
)
from dhtorch.experiments.report.published import PublishedTable
from dhtorch.experiments.report.reading import (
    NON_METRIC_FIELDS,
    Result,
    Row,
    cohort_names,
    describe_result,
    flatten_row,
    last_cohort,
    metric_value,
    scene_rows,
    summary_entry,
    variant_names,
)
from dhtorch.runtime.console import format_count

#: Lines of a table: (pattern of our variant, its label or None = its own name, the paper's line or None).
KnownLines = Sequence[tuple[str, str | None, str | None]]

#: Label of the row with the intervals over scenes.
INTERVAL_LABEL = "95 % interval"
#: Cell of a line of the paper without a counterpart in the result.
_NOT_RUN = "not run"
#: Label of lines and columns that quote the paper.
PUBLISHED_LABEL = "published"
#: Label of columns with the numbers of the result.
OURS_LABEL = "ours"

#: Columns of the main table, one row per scene; the optional ones appear if the result has them.
MAIN_COLUMNS = ("n_candidates", "coverage", "median_rel", "p90_rel", "corr", "residual_px", "pnp_success")
_OPTIONAL_COLUMNS = ("truth_kept", "n_real_holes", "wrong_share", "aurc", "ece")
#: Metrics of every scene that are only in the full tables.
_DETAIL_METRICS = {
    "within_sigma",
    "within_2sigma",
    "aurc_excess",
    "aurc_full",
    "augrc",
    "monotonicity",
    "ece_equal_mass",
}
_DETAIL_METRICS |= {
    "coverage_at_5",
    "coverage_at_10",
    "coverage_at_20",
    "cutoff_m",
    "n_pairs",
    "n_few",
    "n_kept",
    "n_holes",
}
_DETAIL_METRICS |= {"n_recovered"}
#: Groups of metrics with a table of their own: (name, title).
_METRIC_GROUPS = (
    ("n_dropped", "truth dropped"),
    ("hole_share", "holes by class"),
    ("route_share", "ways to fill the holes"),
    ("gate_share", "samples by gate"),
    ("ms", "milliseconds per pair"),
)


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


@dataclass(frozen=True)
class TableLine:
    """Line of a table by variant: one of the result, one of the paper, or both side by side."""

    label: str
    variant: str | None
    paper: str | None = None


def generic_tables(result: Result, shown: Sequence[str] = ()) -> list[ReportTable]:
    """Tables of any result: errors by scene for every cohort, further columns except ``shown``, and metric groups."""
    rows = scene_rows(result)
    tables = []
    if any(metric in row for row in rows for metric in MAIN_COLUMNS) or (rows and all(row.get("note") for row in rows)):
        has_cohorts = len(cohort_names(result)) > 1
        for truth in cohort_names(result):
            columns = (*MAIN_COLUMNS, *(m for m in _OPTIONAL_COLUMNS if _is_measured(rows, m)))
            title = f"{describe_result(result)}; ground truth: {truth}" if has_cohorts else describe_result(result)
            tables.append(scene_table(result, title, columns, truth))
        excluded = _DETAIL_METRICS | set(MAIN_COLUMNS) | set(_OPTIONAL_COLUMNS) | set(NON_METRIC_FIELDS) | set(shown)
        more = [m for m in _scalars(rows) if m not in excluded]
        tables += [scene_table(result, "further columns", more)] if more else []
    elif rows:
        tables.append(_plain_table(result, rows))
    groups = [_group_table(result, *group) for group in _METRIC_GROUPS]
    return tables + [table for table in (_odd_surface_table(result), *groups) if table]


def _is_measured(rows: Sequence[Row], metric: str) -> bool:
    """Whether a metric is defined in a row; of a count whether any row has more than none."""
    values = [row[metric] for row in rows if row.get(metric) is not None]
    return any(values) if metric.startswith("n_") else bool(values)


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
    has_variants = len(variant_names(result)) > 1
    pairs = [(r["scene"], r["method"]) for r in result["rows"] if r["pair"] is not None and r.get("truth") == truth]

    def line(scene: str, method: str, count: str, cells: list[str]) -> list[str]:
        return [*([scene, method] if has_variants else [scene]), count, *cells]

    body = []
    for row in sorted(rows, key=lambda row: order.index(row["scene"])):
        name = f"{row['scene']} ({row['role']})" if row.get("role") else row["scene"]
        cells = [format_value(metric_value(row, m), m) for m in columns]
        if row.get("note"):
            cells = [row["note"] if cell == EMPTY_CELL else cell for cell in cells]
        body.append(line(name, row["method"], str(pairs.count((row["scene"], row["method"]))), cells))
    footer = []
    for method in dict.fromkeys(row["method"] for row in rows if not row.get("role")):
        counted = [row for row in rows if row["method"] == method and not row.get("role")]
        n_pairs = sum(pairs.count((row["scene"], method)) for row in counted)
        footer.append(
            line(
                _n_scenes(counted),
                method,
                str(n_pairs),
                [_number_over_scenes(result, method, m, truth) for m in columns],
            )
        )
        intervals = [_format_interval(summary_entry(result, method, m, truth), m) for m in columns]
        footer += [line(INTERVAL_LABEL, method, "", intervals)] if any(intervals) else []
    cited = _published_rows(quoted, columns, (quoted.lines if quoted else {}), 1 + has_variants)
    single = all(r["pair"][0] == r["pair"][1] for r in result["rows"] if r["pair"] is not None)
    heads = [
        "scene",
        *(["method"] if has_variants else []),
        "frames" if single and pairs else "pairs",
        *map(metric_heading, columns),
    ]
    note = published_source(result, quoted) if quoted else ""
    return ReportTable(title, heads, body + footer + cited, 1 + has_variants, len(footer), len(cited), note=note)


def variant_table(
    result: Result,
    title: str,
    columns: Sequence[str],
    lines: Sequence[TableLine] | None = None,  # None = one per variant
    published: PublishedTable | None = None,
    truth: str | None = None,  # None = the cohort of the verdict
) -> ReportTable:
    """Table by variant with summaries over scenes and the paper's figures beside them; its other lines follow."""
    truth = truth or last_cohort(result)
    lines = [TableLine(v, v) for v in variant_names(result)] if lines is None else lines
    theirs = published.lines if published else {}
    used = [line.paper for line in lines if line.paper]
    double = {m for m in columns if any(m in theirs[p] for p in used)}
    body = []
    for line in lines:
        cells = [line.label]
        for metric in columns:
            cells.append(_number_over_scenes(result, line.variant, metric, truth) if line.variant else _NOT_RUN)
            cells += [theirs.get(line.paper or "", {}).get(metric, EMPTY_CELL)] if metric in double else []
        body.append(cells)
    rest = {name: cells for name, cells in theirs.items() if name not in used}
    cited = _published_rows(published, columns, rest, 1, double)
    note = published_source(result, published) if published else ""
    if not double:
        return ReportTable(title, ["", *map(metric_heading, columns)], body + cited, quoted=len(cited), note=note)
    over = (("", 1), *((metric_heading(m), 2) if m in double else ("", 1) for m in columns))
    heads = [
        "",
        *(h for m in columns for h in ((OURS_LABEL, PUBLISHED_LABEL) if m in double else (metric_heading(m),))),
    ]
    return ReportTable(title, heads, body + cited, quoted=len(cited), over=over, note=note)


def match_lines(result: Result, known: KnownLines, without: str = r"(?!)") -> list[TableLine]:
    """Lines of a table: the paper's in its order, each with the matching variants, then the other variants."""
    names = [variant for variant in variant_names(result) if not re.fullmatch(without, variant)]
    lines, used = [], set()
    for pattern, label, paper in known:
        matching = [variant for variant in names if variant not in used and re.fullmatch(pattern, variant)]
        used.update(matching)
        for variant in matching:
            same_name = paper is None or paper.lower().startswith(variant.lower())
            label_shown = label or (variant if same_name else f"{variant} ({PUBLISHED_LABEL}: {paper})")
            lines.append(TableLine(label_shown, variant, paper))
        if not matching:
            lines.append(TableLine(label or paper or pattern, None, paper))
    return lines + [TableLine(variant, variant) for variant in names if variant not in used]


def full_tables(result: Result) -> list[ReportTable]:
    """All numbers of a result with five digits: summary, scenes, pairs."""
    tables = []
    if result["summary"]:
        fields = ("value", "low", "high", "n", "unit")
        rows = [[name, *(format_exact(e[k]) for k in fields)] for name, e in result["summary"].items()]
        tables.append(ReportTable("Summary over scenes", ["metric", "value", "low", "high", "n", "unit"], rows))
    for title, pairs in (("Scenes", False), ("Pairs", True)):
        flat = [(row, flatten_row(row)) for row in result["rows"] if (row["pair"] is not None) == pairs]
        if not flat:
            continue
        labels = [k for k in ("scene", "pair", "method", "truth", "role", "note") if any(k in row for row, _ in flat)]
        metrics = list(dict.fromkeys(m for _, numbers in flat for m in numbers))
        body = [
            [*(format_exact(row.get(k)) for k in labels), *(format_exact(numbers.get(m)) for m in metrics)]
            for row, numbers in flat
        ]
        tables.append(ReportTable(title, [*labels, *metrics], body, len(labels)))
    return tables


def published_source(result: Result, quoted: PublishedTable) -> str:
    """Note with the source and data of the paper's figures and the data of the result."""
    data = result["data"]
    n = len(data["scenes"])
    ours = f"Ours: {data['name']}, {format_count(n, 'scene')}."
    return " ".join((f"Published: {quoted.where}, {quoted.data}.", *quoted.notes, ours))


# ---------------------------------------------------------------------------------------------- cells over scenes


def _range_over(rows: Sequence[Row]) -> str:
    """Cell with the smallest and the largest median error over scenes."""
    errors = [row["median_rel"] for row in rows if row.get("median_rel") is not None]
    return (format_metric_interval(min(errors), max(errors), "median_rel") or EMPTY_CELL) if errors else EMPTY_CELL


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


def _format_interval(entry: Mapping[str, Any], metric: str) -> str:
    """Cell with the interval of a summary entry; empty for derived numbers."""
    return "" if metric in DERIVED_NUMBERS else format_metric_interval(entry.get("low"), entry.get("high"), metric)


def _n_scenes(rows: Sequence[Row]) -> str:
    """Cell with the number of scenes, of how many if some were skipped."""
    n, n_skipped = len(rows), sum(bool(row.get("note")) for row in rows)
    return f"{n - n_skipped} of {format_count(n, 'scene')}" if n_skipped else format_count(n, "scene")


def _published_rows(
    published: PublishedTable | None,
    columns: Sequence[str],
    lines: Mapping[str, Mapping[str, str]],
    n_label: int,
    double: frozenset[str] | set[str] | None = None,
) -> list[list[str]]:
    """Rows of the paper's lines without a counterpart; a table by scene also has a column of pairs."""
    rows = []
    for name, cells in lines.items() if published else ():
        row = [f"{PUBLISHED_LABEL}: {name}", *[""] * (n_label - 1 + (double is None))]
        for metric in columns:
            row += [""] * (metric in (double or ())) + [cells.get(metric, EMPTY_CELL)]
        rows.append(row)
    return rows


# ---------------------------------------------------------------------------------------------- other tables


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


def _odd_surface_table(result: Result) -> ReportTable | None:
    """Table of surfaces that are evaluated separately, such as mirrors; None without any."""
    columns = ("n_candidates", "coverage", "median_rel", "p90_rel", "corr")
    kinds = dict.fromkeys(kind for row in scene_rows(result) for kind in row.get("apart") or {})
    rows = [
        [
            kind,
            variant,
            *(format_value(summary_entry(result, variant, f"apart.{kind}.{m}").get("value"), m) for m in columns),
        ]
        for kind in kinds
        for variant in variant_names(result)
    ]
    return (
        ReportTable("surfaces evaluated separately", ["surface", "method", *map(metric_heading, columns)], rows, 2)
        if rows
        else None
    )


def _plain_table(result: Result, rows: Sequence[Row]) -> ReportTable:
    """Table of rows without candidates, such as timings: one column per field."""
    names = [k for k in dict.fromkeys(k for row in rows for k in row) if k not in ("pair", "curves", "overlay")]
    names = [k for k in names if any(not isinstance(row.get(k), Mapping) and row.get(k) is not None for row in rows)]
    n_label = next((k for k, n in enumerate(names) if not isinstance(rows[0].get(n), str)), len(names))
    body = [[format_value(row.get(name), name) for name in names] for row in rows]
    return ReportTable(describe_result(result), list(map(metric_heading, names)), body, max(1, n_label))


def _scalars(rows: Sequence[Row]) -> list[str]:
    """Names of the fields that are a number in any row."""
    names = (k for row in rows for k, v in row.items() if isinstance(v, int | float))
    return list(dict.fromkeys(names))
