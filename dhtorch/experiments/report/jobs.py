"""A sweep's result: one table of its jobs, what differs between them on the left and what came of it on the right."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from dhtorch.experiments.report.cells import EMPTY_CELL, format_value, metric_heading
from dhtorch.experiments.report.reading import Result, summary_entry, variant_names
from dhtorch.experiments.report.tables import ReportTable
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count

#: Metric → whether more is better.
JOB_METRICS = {"coverage": True, "median_rel": False, "p90_rel": False, "coverage_at_5": True, "ms": False}

#: Settings that make no other job.
_IGNORED_SETTINGS = ("output", "resume", "traceback", "figures", "workers", "threads", "launch")

#: Groups whose choices have a name of their own; what they set is named beside it only where it differs under one name.
_NAMED_GROUPS = ("method", "data", "pairs", "experiment")


def differing_settings(results: Sequence[Result]) -> list[dict[str, str]]:
    """Of every result, the settings that are not the same in all, by name."""
    choices = [_group_choices(result) for result in results]
    flat = [dict(_flatten_config(result["config"])) for result in results]
    found: list[dict[str, str]] = [{} for _ in results]
    for group in _NAMED_GROUPS:
        if len({chosen[group] for chosen in choices}) > 1:
            for row, chosen in zip(found, choices, strict=True):
                row[group] = chosen[group]
    for name in dict.fromkeys(name for leaves in flat for name in leaves):
        group = name.partition(".")[0]
        told: dict[str, set[str]] = {}
        for leaves, chosen in zip(flat, choices, strict=True):
            told.setdefault(chosen.get(group, ""), set()).add(leaves.get(name, EMPTY_CELL))
        if any(len(values) > 1 for values in told.values()):
            for row, leaves in zip(found, flat, strict=True):
                row[name] = leaves.get(name, EMPTY_CELL)
    return found


def job_numbers(result: Result, variant: str) -> dict[str, float | None]:
    """The numbers of one row; milliseconds are those of all seats together."""
    numbers = {m: summary_entry(result, variant, m).get("value") for m in JOB_METRICS if m != "ms"}
    seats = {name.rpartition("ms.")[2] for name in result["summary"] if "ms." in f".{name}"}
    spent = [summary_entry(result, variant, f"ms.{seat}").get("value") for seat in seats]
    return {**numbers, "ms": sum(v for v in spent if v is not None) if any(v is not None for v in spent) else None}


def job_rows(results: Sequence[Result]) -> tuple[list[str], list[tuple[list[str], dict[str, float | None]]]]:
    """Names of the columns of words, and for every job and variant its words and its numbers."""
    told = differing_settings(results)
    names = list(dict.fromkeys(name for row in told for name in row))
    several = "method" not in names and any(len(variant_names(result)) > 1 for result in results)
    rows = []
    for result, row in zip(results, told, strict=True):
        for variant in variant_names(result):
            label = {**row, "method": variant} if "method" in row or several else row
            rows.append(
                ([label.get(n, EMPTY_CELL) for n in _column_headings(names, several)], job_numbers(result, variant))
            )
    return _column_headings(names, several) or ["job"], rows if _column_headings(
        names, several
    ) else _number_duplicates(rows)


def jobs_table(results: Sequence[Result]) -> ReportTable | None:
    """One row per job; the best of every column is marked. None for fewer than two results."""
    if len(results) < 2:
        return None
    heads, rows = job_rows(results)
    body = [
        [*labels, *(format_value(numbers[m], m) if m != "ms" else _format_ms(numbers[m]) for m in JOB_METRICS)]
        for labels, numbers in rows
    ]
    best = set()
    for k, (metric, more) in enumerate(JOB_METRICS.items(), start=len(heads)):
        values = {n: v for n, (_, numbers) in enumerate(rows) if (v := numbers[metric]) is not None}
        if len(values) > 1:
            wanted = max(values.values()) if more else min(values.values())
            best |= {(n, k) for n, v in values.items() if v == wanted and len(set(values.values())) > 1}
    named = {"coverage_at_5": "coverage at 5 %", "ms": "ms"}
    title = format_count(len(results), "job")
    return ReportTable(
        title,
        [*heads, *(named.get(m) or metric_heading(m) for m in JOB_METRICS)],
        body,
        len(heads),
        best=frozenset(best),
    )


def write_jobs_csv(path: Path, results: Sequence[Result]) -> Path:
    """The same table with every digit, as comma-separated values: shares from 0 to 1, nothing where nothing is known.

    Raises:
        OSError: the file cannot be written.
    """
    heads, rows = job_rows(results)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*heads, *JOB_METRICS])
    for labels, numbers in rows:
        writer.writerow([*labels, *("" if numbers[m] is None else repr(numbers[m]) for m in JOB_METRICS)])
    return storage.replace_file(path, text.getvalue().encode())


def _column_headings(names: Sequence[str], several: bool) -> list[str]:
    return [*names, *(["method"] if several else [])]


def _number_duplicates(
    rows: list[tuple[list[str], dict[str, float | None]]],
) -> list[tuple[list[str], dict[str, float | None]]]:
    """Jobs that nothing tells apart."""
    return [([str(k + 1)], numbers) for k, (_, numbers) in enumerate(rows)]


def _format_ms(value: float | None) -> str:
    return EMPTY_CELL if value is None else f"{value:.0f}"


def _group_choices(result: Result) -> dict[str, str]:
    """Group → name of what was chosen."""
    config = result["config"]
    pairs = config.get("pairs")
    target = str(pairs.get("_target_")) if isinstance(pairs, Mapping) else str(pairs)
    return {
        "method": " ".join(variant_names(result)),
        "data": str(result["data"]["name"]),
        "pairs": target.rpartition(".")[2].removeprefix("by_"),
        "experiment": str(result["experiment"]),
    }


def _flatten_config(config: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    for key, value in config.items():
        if str(key).startswith("_") or (not above and key in _IGNORED_SETTINGS):
            continue
        if isinstance(value, Mapping):
            yield from _flatten_config(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", "null" if value is None else str(value)
