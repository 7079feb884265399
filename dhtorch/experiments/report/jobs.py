"""Table of the jobs of a sweep: the settings that differ, then the main metrics; as cells and as CSV."""

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

#: Metrics of the table → whether a larger value is better.
JOB_METRICS = {"coverage": True, "median_rel": False, "p90_rel": False, "coverage_at_5": True, "ms": False}

#: Settings that do not distinguish jobs.
_IGNORED_SETTINGS = ("output", "resume", "traceback", "figures", "workers", "threads", "launch")

#: Groups of settings with named choices; their members are listed only if they differ under the same name.
_NAMED_GROUPS = ("method", "data", "pairs", "experiment")


def differing_settings(results: Sequence[Result]) -> list[dict[str, str]]:
    """Settings that differ between results: for each result, name → value as text."""
    choices = [_group_choices(result) for result in results]
    flat = [dict(_flatten_config(result["config"])) for result in results]
    differing: list[dict[str, str]] = [{} for _ in results]
    for group in _NAMED_GROUPS:
        if len({choice[group] for choice in choices}) > 1:
            for row, choice in zip(differing, choices, strict=True):
                row[group] = choice[group]
    for name in dict.fromkeys(name for settings in flat for name in settings):
        group = name.partition(".")[0]
        values_by_choice: dict[str, set[str]] = {}
        for settings, choice in zip(flat, choices, strict=True):
            values_by_choice.setdefault(choice.get(group, ""), set()).add(settings.get(name, EMPTY_CELL))
        if any(len(values) > 1 for values in values_by_choice.values()):
            for row, settings in zip(differing, flat, strict=True):
                row[name] = settings.get(name, EMPTY_CELL)
    return differing


def job_numbers(result: Result, variant: str) -> dict[str, float | None]:
    """Metrics of one variant of a job; ``ms`` is the sum over the stages."""
    numbers = {m: summary_entry(result, variant, m).get("value") for m in JOB_METRICS if m != "ms"}
    stages = {name.rpartition("ms.")[2] for name in result["summary"] if "ms." in f".{name}"}
    spent = [summary_entry(result, variant, f"ms.{stage}").get("value") for stage in stages]
    return {**numbers, "ms": sum(v for v in spent if v is not None) if any(v is not None for v in spent) else None}


def job_rows(results: Sequence[Result]) -> tuple[list[str], list[tuple[list[str], dict[str, float | None]]]]:
    """Label columns, and a row of labels and metrics for every job and variant."""
    settings = differing_settings(results)
    names = list(dict.fromkeys(name for row in settings for name in row))
    show_method = "method" not in names and any(len(variant_names(result)) > 1 for result in results)
    rows = []
    for result, row in zip(results, settings, strict=True):
        for variant in variant_names(result):
            label = {**row, "method": variant} if "method" in row or show_method else row
            rows.append(
                ([label.get(n, EMPTY_CELL) for n in _column_headings(names, show_method)], job_numbers(result, variant))
            )
    return _column_headings(names, show_method) or ["job"], rows if _column_headings(
        names, show_method
    ) else _number_duplicates(rows)


def jobs_table(results: Sequence[Result]) -> ReportTable | None:
    """Table of jobs with the best value of every column highlighted; None for fewer than two results."""
    if len(results) < 2:
        return None
    heads, rows = job_rows(results)
    body = [
        [*labels, *(format_value(numbers[m], m) if m != "ms" else _format_ms(numbers[m]) for m in JOB_METRICS)]
        for labels, numbers in rows
    ]
    best = set()
    for k, (metric, larger_is_better) in enumerate(JOB_METRICS.items(), start=len(heads)):
        values = {n: v for n, (_, numbers) in enumerate(rows) if (v := numbers[metric]) is not None}
        if len(values) > 1:
            best_value = max(values.values()) if larger_is_better else min(values.values())
            best |= {(n, k) for n, v in values.items() if v == best_value and len(set(values.values())) > 1}
    headings = {"coverage_at_5": "coverage at 5 %", "ms": "ms"}
    title = format_count(len(results), "job")
    return ReportTable(
        title,
        [*heads, *(headings.get(m) or metric_heading(m) for m in JOB_METRICS)],
        body,
        len(heads),
        best=frozenset(best),
    )


def write_jobs_csv(path: Path, results: Sequence[Result]) -> Path:
    """Write the table of jobs as CSV with all digits: fractions from 0 to 1, empty cells without a value.

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


def _column_headings(names: Sequence[str], show_method: bool) -> list[str]:
    """Headings of the label columns."""
    return [*names, *(["method"] if show_method else [])]


def _number_duplicates(
    rows: list[tuple[list[str], dict[str, float | None]]],
) -> list[tuple[list[str], dict[str, float | None]]]:
    """Rows labelled by number, for jobs with equal settings."""
    return [([str(k + 1)], numbers) for k, (_, numbers) in enumerate(rows)]


def _format_ms(value: float | None) -> str:
    """Cell with milliseconds."""
    return EMPTY_CELL if value is None else f"{value:.0f}"


def _group_choices(result: Result) -> dict[str, str]:
    """Names of the choices of a job by group of settings."""
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
    """Settings of a configuration as (dotted name, value as text)."""
    for key, value in config.items():
        if str(key).startswith("_") or (not above and key in _IGNORED_SETTINGS):
            continue
        if isinstance(value, Mapping):
            yield from _flatten_config(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", "null" if value is None else str(value)
