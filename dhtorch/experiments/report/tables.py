"""Archived results as tables of text cells, ready for any medium; every kind of result gets these."""

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

#: (pattern of our variant, its label or None = its own name, the paper's line)
KnownLines = Sequence[tuple[str, str | None, str | None]]

#: First cell of the row with the intervals over scenes.
INTERVAL_LABEL = "95 % interval"
#: A line of the paper that this result has no counterpart for.
_NOT_RUN = "not run"
#: Marks lines and columns that quote the paper.
PUBLISHED_LABEL, OURS_LABEL = "published", "ours"

#: The main table, one row per scene. The optional ones appear where a result has them.
MAIN_COLUMNS = ("n_candidates", "coverage", "median_rel", "p90_rel", "corr", "residual_px", "pnp_success")
_OPTIONAL_COLUMNS = ("wrong_share", "aurc", "ece")
#: Measured of every scene, and too much for the first look.
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
#: Groups of metrics that get a table of their own: name and title.
_METRIC_GROUPS = (
    ("n_dropped", "truth dropped"),
    ("hole_share", "holes by class"),
    ("route_share", "what could fill the holes"),
    ("gate_share", "what became of samples"),
    ("ms", "milliseconds per pair"),
)


@dataclass(frozen=True)
class ReportTable:
    """Text cells."""

    title: str
    head: list[str]
    rows: list[list[str]]
    n_label: int = 1  # leading columns that are words
    footer: int = 0  # rows that sum up, after the others
    quoted: int = 0  # rows of the paper, after these
    over: tuple[tuple[str, int], ...] = ()  # headings over several columns: (text, columns)
    note: str = ""  # what must be known to read it
    best: frozenset[tuple[int, int]] = frozenset()  # (row, column) of cells that stand out

    def flat_head(self) -> list[str]:
        """One heading per column, with what stands over it."""
        above = [text for text, span in self.over for _ in range(span)] or [""] * len(self.head)
        return [", ".join(filter(None, pair)) for pair in zip(above, self.head, strict=True)]


@dataclass(frozen=True)
class TableLine:
    """A line of a table by variant: one of ours, one of the paper's, or both side by side."""

    label: str
    variant: str | None
    paper: str | None = None


def generic_tables(result: Result, shown: Sequence[str] = ()) -> list[ReportTable]:
    """Errors by scene for every cohort, what else was measured, and the groups; ``shown`` stands elsewhere already."""
    rows = scene_rows(result)
    found = []
    if any(metric in row for row in rows for metric in MAIN_COLUMNS) or (rows and all(row.get("note") for row in rows)):
        several = len(cohort_names(result)) > 1
        for truth in cohort_names(result):
            columns = (*MAIN_COLUMNS, *(m for m in _OPTIONAL_COLUMNS if any(row.get(m) is not None for row in rows)))
            title = f"{describe_result(result)}; held against {truth}" if several else describe_result(result)
            found.append(scene_table(result, title, columns, truth))
        known = _DETAIL_METRICS | set(MAIN_COLUMNS) | set(_OPTIONAL_COLUMNS) | set(NON_METRIC_FIELDS) | set(shown)
        more = [m for m in _scalars(rows) if m not in known]
        found += [scene_table(result, "further columns", more)] if more else []
    elif rows:
        found.append(_plain_table(result, rows))
    groups = [_group_table(result, *group) for group in _METRIC_GROUPS]
    return found + [table for table in (_odd_surface_table(result), *groups) if table]


def scene_table(
    result: Result,
    title: str,
    columns: Sequence[str],
    truth: str | None = None,  # None = the cohort that decides
    quoted: PublishedTable | None = None,
) -> ReportTable:
    """One row per scene and variant, the summary over scenes, then the paper's lines; roles stand apart."""
    truth = truth or last_cohort(result)
    rows = scene_rows(result, truth)
    order = list(dict.fromkeys(row["scene"] for row in result["rows"]))
    several = len(variant_names(result)) > 1
    pairs = [(r["scene"], r["method"]) for r in result["rows"] if r["pair"] is not None and r.get("truth") == truth]

    def line(scene: str, method: str, count: str, cells: list[str]) -> list[str]:
        return [*([scene, method] if several else [scene]), count, *cells]

    body = []
    for row in sorted(rows, key=lambda row: order.index(row["scene"])):
        name = f"{row['scene']} ({row['role']})" if row.get("role") else row["scene"]
        cells = [format_value(metric_value(row, m), m) for m in columns]
        if row.get("note"):
            cells = [row["note"] if cell == EMPTY_CELL else cell for cell in cells]
        body.append(line(name, row["method"], str(pairs.count((row["scene"], row["method"]))), cells))
    footer = []
    for method in dict.fromkeys(row["method"] for row in rows if not row.get("role")):
        mine = [row for row in rows if row["method"] == method and not row.get("role")]
        n_pairs = sum(pairs.count((row["scene"], method)) for row in mine)
        footer.append(
            line(
                _n_scenes(mine), method, str(n_pairs), [_number_over_scenes(result, method, m, truth) for m in columns]
            )
        )
        spread = [_format_interval(summary_entry(result, method, m, truth), m) for m in columns]
        footer += [line(INTERVAL_LABEL, method, "", spread)] if any(spread) else []
    cited = _published_rows(quoted, columns, (quoted.lines if quoted else {}), 1 + several)
    single = all(r["pair"][0] == r["pair"][1] for r in result["rows"] if r["pair"] is not None)
    heads = [
        "scene",
        *(["method"] if several else []),
        "frames" if single and pairs else "pairs",
        *map(metric_heading, columns),
    ]
    note = published_source(result, quoted) if quoted else ""
    return ReportTable(title, heads, body + footer + cited, 1 + several, len(footer), len(cited), note=note)


def variant_table(
    result: Result,
    title: str,
    columns: Sequence[str],
    lines: Sequence[TableLine] | None = None,  # None = one per variant
    published: PublishedTable | None = None,
    truth: str | None = None,  # None = the cohort that decides
) -> ReportTable:
    """One row per variant, summed up over scenes, the paper's figure beside ours; its other lines follow."""
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
    """The paper's lines in its order, each with our variant of that kind, then what else we ran."""
    names = [v for v in variant_names(result) if not re.fullmatch(without, v)]
    found, used = [], set()
    for pattern, label, paper in known:
        matching = [v for v in names if v not in used and re.fullmatch(pattern, v)]
        used.update(matching)
        for v in matching:
            alike = paper is None or paper.lower().startswith(v.lower())
            shown = label or (v if alike else f"{v} ({PUBLISHED_LABEL}: {paper})")
            found.append(TableLine(shown, v, paper))
        if not matching:
            found.append(TableLine(label or paper or pattern, None, paper))
    return found + [TableLine(v, v) for v in names if v not in used]


def full_tables(result: Result) -> list[ReportTable]:
    """All that was measured, with five digits: the summary, every scene, every pair."""
    found = []
    if result["summary"]:
        fields = ("value", "low", "high", "n", "unit")
        rows = [[name, *(format_exact(e[k]) for k in fields)] for name, e in result["summary"].items()]
        found.append(ReportTable("Summary over scenes", ["metric", "value", "low", "high", "n", "unit"], rows))
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
        found.append(ReportTable(title, [*labels, *metrics], body, len(labels)))
    return found


def published_source(result: Result, quoted: PublishedTable) -> str:
    """Where the paper's figures are from, and that ours are from elsewhere."""
    data = result["data"]
    n = len(data["scenes"])
    ours = f"Ours: {data['name']}, {format_count(n, 'scene')}."
    return " ".join((f"Published: {quoted.where}, {quoted.data}.", *quoted.notes, ours))


# ---------------------------------------------------------------------------------------------- cells over scenes


def _range_over(rows: Sequence[Row]) -> str:
    found = [row["median_rel"] for row in rows if row.get("median_rel") is not None]
    return (format_metric_interval(min(found), max(found), "median_rel") or EMPTY_CELL) if found else EMPTY_CELL


def _passes(rows: Sequence[Row]) -> str:
    found = [bool(row["passes"]) for row in rows if row.get("passes") is not None]
    return f"{sum(found)}/{len(found)}" if found else EMPTY_CELL


#: Numbers over scenes that are no median of the scenes' own: from the rows of the scenes.
DERIVED_NUMBERS: dict[str, Callable[[Sequence[Row]], str]] = {
    "n_scenes": lambda rows: str(sum(not row.get("note") for row in rows)),
    "range": _range_over,
    "passes": _passes,
}


def _number_over_scenes(result: Result, variant: str, metric: str, truth: str | None) -> str:
    """One number over scenes without a role; where nothing was measured on any, why."""
    rows = [row for row in scene_rows(result, truth, variant) if not row.get("role")]
    found = summary_entry(result, variant, metric, truth).get("value")
    if found is None:  # words, such as a device, are in the rows alone
        said = {row[metric] for row in rows if isinstance(row.get(metric), str)}
        found = said.pop() if len(said) == 1 else None
    cell = format_value(found, metric) if metric not in DERIVED_NUMBERS else DERIVED_NUMBERS[metric](rows)
    notes = [row["note"] for row in rows if row.get("note")]
    silent = cell == EMPTY_CELL and len(notes) == len(rows) > 0
    return "; ".join(dict.fromkeys(notes)) if silent else cell


def _format_interval(found: Mapping[str, Any], metric: str) -> str:
    return "" if metric in DERIVED_NUMBERS else format_metric_interval(found.get("low"), found.get("high"), metric)


def _n_scenes(rows: Sequence[Row]) -> str:
    n, silent = len(rows), sum(bool(row.get("note")) for row in rows)
    return f"{n - silent} of {format_count(n, 'scene')}" if silent else format_count(n, "scene")


def _published_rows(
    published: PublishedTable | None,
    columns: Sequence[str],
    lines: Mapping[str, Mapping[str, str]],
    n_label: int,
    double: frozenset[str] | set[str] | None = None,
) -> list[list[str]]:
    """Lines of the paper without a counterpart of ours; in a table by scene a column counts the pairs."""
    found = []
    for name, cells in lines.items() if published else ():
        row = [f"{PUBLISHED_LABEL}: {name}", *[""] * (n_label - 1 + (double is None))]
        for metric in columns:
            row += [""] * (metric in (double or ())) + [cells.get(metric, EMPTY_CELL)]
        found.append(row)
    return found


# ---------------------------------------------------------------------------------------------- other tables


def _group_table(result: Result, group: str, title: str) -> ReportTable | None:
    """One row per variant and one column per member of a group of metrics; None where there is none."""
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
    """Surfaces that are counted apart, such as mirrors."""
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
    return ReportTable("counted apart", ["surface", "method", *map(metric_heading, columns)], rows, 2) if rows else None


def _plain_table(result: Result, rows: Sequence[Row]) -> ReportTable:
    """Rows that are no scenes of candidates, as timings are: every field a column."""
    names = [k for k in dict.fromkeys(k for row in rows for k in row) if k not in ("pair", "curves", "overlay")]
    names = [k for k in names if any(not isinstance(row.get(k), Mapping) and row.get(k) is not None for row in rows)]
    n_label = next((k for k, n in enumerate(names) if not isinstance(rows[0].get(n), str)), len(names))
    body = [[format_value(row.get(name), name) for name in names] for row in rows]
    return ReportTable(describe_result(result), list(map(metric_heading, names)), body, max(1, n_label))


def _scalars(rows: Sequence[Row]) -> list[str]:
    """Fields that are a number in some row."""
    found = (k for row in rows for k, v in row.items() if isinstance(v, int | float))
    return list(dict.fromkeys(found))
