"""Timings: the paper's branches, the two ratios that any machine can test, and every stage."""

from __future__ import annotations

from dhtorch.experiments.report import published
from dhtorch.experiments.report.cells import NOTHING, between, head, show
from dhtorch.experiments.report.reading import Result, Row, entry, scene_rows, variants
from dhtorch.experiments.report.tables import OURS, PUBLISHED, Table, source

COLUMNS = ("device", "p50_ms", "p95_ms", "p99_ms", "parameters", "weight_bytes", "peak_mib")
STAGE_COLUMNS = ("p50_ms", "p95_ms", "p99_ms")
#: Summary's name → (words, what the paper has).
RATIOS = {"speedup": ("DINOv2-L / front end", "96"), "growth": ("front end at 1440×1920 / 224×224", "3.81 / 1.11")}


def latency(result: Result) -> list[Table]:
    """Tables of a result of timings."""
    whole = [row for row in scene_rows(result) if is_whole(row)]
    cited = [
        [f"{PUBLISHED}: {name}", *(cells.get(m, NOTHING) for m in COLUMNS)]
        for name, cells in published.LATENCY.lines.items()
    ]
    note = f"{source(result, published.LATENCY)} {_machine(result)}".strip()
    rows = [_line(row, COLUMNS) for row in whole]
    found = [Table("Measured latency", ["branch", *map(head, COLUMNS)], rows + cited, quoted=len(cited), note=note)]
    ratios = [
        [words, show(e["value"], how="plain"), between(e["low"], e["high"], name), theirs]
        for name, (words, theirs) in RATIOS.items()
        for v in variants(result)
        if (e := entry(result, v, name))
    ]
    if ratios:
        found.append(Table("Ratios", ["", OURS, "lowest–highest round", PUBLISHED], ratios))
    stages = [_line(row, STAGE_COLUMNS) for row in scene_rows(result) if not is_whole(row)]
    if stages:
        found.append(Table("Latency by stage", ["stage", *map(head, STAGE_COLUMNS)], stages))
    return found


def branch(row: Row) -> str:
    """What a row of timings is about."""
    size = f", {show(row['hw'])}" if row.get("hw") else ""
    return f"{row['method']} {row.get('stage', '').replace('_', ' ')}".strip() + size


def is_whole(row: Row) -> bool:
    """Whether a row is about a branch and not about one stage of it."""
    return row.get("stage") in ("front_end", "pair", "forward") or "parameters" in row


def _line(row: Row, columns: tuple[str, ...]) -> list[str]:
    missing = row.get("note", NOTHING)
    return [branch(row), *(missing if row.get(m) is None else show(row[m], m) for m in columns)]


def _machine(result: Result) -> str:
    """On what ours were measured."""
    said = []
    for name, words in (("cpu", "CPU"), ("cores", "cores"), ("threads", "threads"), ("load", "load of the machine")):
        known = dict.fromkeys(show(row[name], how="plain") for row in scene_rows(result) if row.get(name) is not None)
        said += [f"{words} {', '.join(known)}"] if known else []
    return f"Measured with {'; '.join(said)}." if said else ""
