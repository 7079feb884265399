"""Tables of timings: branches as in the paper, two machine-independent ratios, and every stage."""

from __future__ import annotations

from dhtorch.experiments.report import published
from dhtorch.experiments.report.cells import EMPTY_CELL, format_metric_interval, format_value, metric_heading
from dhtorch.experiments.report.reading import Result, Row, scene_rows, summary_entry, variant_names
from dhtorch.experiments.report.tables import OURS_LABEL, PUBLISHED_LABEL, ReportTable, published_source

_TIMING_COLUMNS = ("device", "p50_ms", "p95_ms", "p99_ms", "parameters", "weight_bytes", "peak_mib")
_STAGE_COLUMNS = ("p50_ms", "p95_ms", "p99_ms")
#: Name in the summary → (label, the paper's value).
_PUBLISHED_RATIOS = {
    "speedup": ("DINOv2-L / front end", "96"),
    "growth": ("front end at 1440×1920 / 224×224", "3.81 / 1.11"),
}


def latency_tables(result: Result) -> list[ReportTable]:
    """Tables of a latency result: branches, ratios, stages."""
    branches = [row for row in scene_rows(result) if is_whole_branch(row)]
    cited = [
        [f"{PUBLISHED_LABEL}: {name}", *(cells.get(m, EMPTY_CELL) for m in _TIMING_COLUMNS)]
        for name, cells in published.LATENCY.lines.items()
    ]
    note = f"{published_source(result, published.LATENCY)} {_machine_note(result)}".strip()
    rows = [_table_row(row, _TIMING_COLUMNS) for row in branches]
    tables = [
        ReportTable(
            "Measured latency",
            ["branch", *map(metric_heading, _TIMING_COLUMNS)],
            rows + cited,
            quoted=len(cited),
            note=note,
        )
    ]
    ratios = [
        [
            words,
            format_value(e["value"], how="plain"),
            format_metric_interval(e["low"], e["high"], name),
            published_ratio,
        ]
        for name, (words, published_ratio) in _PUBLISHED_RATIOS.items()
        for v in variant_names(result)
        if (e := summary_entry(result, v, name))
    ]
    if ratios:
        tables.append(ReportTable("Ratios", ["", OURS_LABEL, "lowest–highest round", PUBLISHED_LABEL], ratios))
    stages = [_table_row(row, _STAGE_COLUMNS) for row in scene_rows(result) if not is_whole_branch(row)]
    if stages:
        tables.append(ReportTable("Latency by stage", ["stage", *map(metric_heading, _STAGE_COLUMNS)], stages))
    return tables


def branch_name(row: Row) -> str:
    """Name of the branch or stage of a row, with its image size."""
    size = f", {format_value(row['hw'])}" if row.get("hw") else ""
    return f"{row['method']} {row.get('stage', '').replace('_', ' ')}".strip() + size


def is_whole_branch(row: Row) -> bool:
    """Whether a row is of a whole branch rather than of one stage."""
    return row.get("stage") in ("front_end", "pair", "forward") or "parameters" in row


def _table_row(row: Row, columns: tuple[str, ...]) -> list[str]:
    """Cells of a row; its note in place of missing values."""
    missing = row.get("note", EMPTY_CELL)
    return [branch_name(row), *(missing if row.get(m) is None else format_value(row[m], m) for m in columns)]


def _machine_note(result: Result) -> str:
    """Note on the machine of the measurement."""
    facts = []
    for name, label in (("cpu", "CPU"), ("cores", "cores"), ("threads", "threads"), ("load", "load of the machine")):
        values = dict.fromkeys(
            format_value(row[name], how="plain") for row in scene_rows(result) if row.get(name) is not None
        )
        facts += [f"{label} {', '.join(values)}"] if values else []
    return f"Measured with {'; '.join(facts)}." if facts else ""
