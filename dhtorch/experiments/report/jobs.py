"""Table of the jobs of a sweep: the settings that differ, then the main metrics; as cells and as CSV.

Which metrics are the main ones, and which of their values is better, is named by the experiment, in its result. Of a
result without such names, those of experiments on depth are taken, and if it has none of these its first metrics.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dhtorch.experiments.outcome import DEPTH_METRICS, MainMetric
from dhtorch.experiments.report.cells import EMPTY_CELL, format_metric_interval, format_value, metric_heading
from dhtorch.experiments.report.reading import Result, summary_entry, variant_names
from dhtorch.experiments.report.tables import INTERVAL_LABEL, ReportTable
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count

#: Columns of a result that names no metrics and has none of depth, at most.
_MAX_UNNAMED_METRICS = 6

#: Prefix of the summary's entries of a stage's time, which the metric ``ms`` adds up.
_STAGE_TIMES = "ms."

#: Settings that do not distinguish jobs.
_IGNORED_SETTINGS = ("output", "resume", "traceback", "figures", "workers", "threads", "launch")

#: Groups of settings with named choices; their members are listed only if they differ under the same name.
NAMED_GROUPS = ("method", "data", "pairs", "experiment")


def differing_settings(results: Sequence[Result]) -> list[dict[str, str]]:
    """Settings that differ between results: for each result, name → value as text."""
    choices = [_group_choices(result) for result in results]
    flat = [dict(_flatten_config(result["config"])) for result in results]
    differing: list[dict[str, str]] = [{} for _ in results]
    for group in NAMED_GROUPS:
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


def main_metrics(results: Sequence[Result]) -> list[MainMetric]:
    """Metrics of a table of results, without those of which no result has a value; all if none has any."""
    named = {metric.name: metric for result in results for metric in _named_metrics(result)}
    valued = [
        metric
        for name, metric in named.items()
        if any(_entry(result, v, name).get("value") is not None for result in results for v in variant_names(result))
    ]
    return valued or list(named.values())


def _named_metrics(result: Result) -> Sequence[MainMetric]:
    """The metrics that a result names; else those of depth, if it has any; else its first ones."""
    if "metrics" in result:
        return [MainMetric(**metric) for metric in result["metrics"]]
    variants = variant_names(result)
    if any(_entry(result, v, metric.name) for v in variants for metric in DEPTH_METRICS):
        return DEPTH_METRICS
    names = [name.removeprefix(f"{v}.") for v in variants[:1] for name in result["summary"] if name.startswith(f"{v}.")]
    names = names or list(result["summary"])
    return [MainMetric(name) for name in names[:_MAX_UNNAMED_METRICS]]


def _entry(result: Result, variant: str, metric: str) -> Mapping[str, Any]:
    """Summary entry of a main metric; ``ms`` is the sum over the stages."""
    entry = summary_entry(result, variant, metric)
    if metric != "ms" or entry:
        return entry
    stages = {name.rpartition(_STAGE_TIMES)[2] for name in result["summary"] if _STAGE_TIMES in f".{name}"}
    spent = [summary_entry(result, variant, _STAGE_TIMES + stage).get("value") for stage in stages]
    spent = [value for value in spent if value is not None]
    return {"value": sum(spent), "unit": "ms"} if spent else {}


@dataclass(frozen=True)
class JobRow:
    """Row of a job and variant."""

    labels: list[str]
    entries: dict[str, Mapping[str, Any]]  # metric → its entry in the summary
    note: str = ""  # why it has no value, if it has none


def job_rows(results: Sequence[Result]) -> tuple[list[str], list[JobRow]]:
    """Label columns, and a row for every job and variant that has a value; a job without values has one with a note."""
    settings, metrics = differing_settings(results), main_metrics(results)
    names = list(dict.fromkeys(name for row in settings for name in row))
    show_method = "method" not in names and any(len(variant_names(result)) > 1 for result in results)
    heads = _column_headings(names, show_method)
    rows: list[JobRow] = []
    for result, row in zip(results, settings, strict=True):
        entries = {v: {m.name: _entry(result, v, m.name) for m in metrics} for v in variant_names(result)}
        valued = [v for v, of in entries.items() if any(e.get("value") is not None for e in of.values())]
        for variant in valued or list(entries)[:1]:
            label = {**row, "method": variant} if "method" in row or show_method else row
            note = "" if valued else _explain_absence(result)
            rows.append(JobRow([label.get(name, EMPTY_CELL) for name in heads], entries[variant], note))
    return (heads, rows) if heads else (["job"], [replace(row, labels=[str(k + 1)]) for k, row in enumerate(rows)])


def _explain_absence(result: Result) -> str:
    """Why a job has no value: the first note of its rows, else the reason of its verdict."""
    notes = [f"{row['scene']}: {row['note']}" for row in result["rows"] if row.get("note")]
    return next(iter([*notes, *filter(None, [result.get("why")])]), "")


def jobs_table(results: Sequence[Result]) -> ReportTable | None:
    """Table of jobs with the best value of every column highlighted; None for fewer than two results."""
    if len(results) < 2:
        return None
    heads, rows = job_rows(results)
    head, body, best = list(heads), [list(row.labels) for row in rows], set()
    for metric in main_metrics(results):
        values = [row.entries[metric.name].get("value") for row in rows]
        known = [value for value in values if value is not None]
        if metric.larger_is_better is not None and len(set(known)) > 1:
            best_value = max(known) if metric.larger_is_better else min(known)
            best |= {(n, len(head)) for n, value in enumerate(values) if value == best_value}
        head.append(_metric_heading(metric, [row.entries[metric.name] for row in rows]))
        for cells, value in zip(body, values, strict=True):
            cells.append(_format_ms(value) if metric.name == "ms" else format_value(value, metric.name))
        if _has_interval(metric, rows):
            head.append(INTERVAL_LABEL)
            for cells, row in zip(body, rows, strict=True):
                entry = row.entries[metric.name]
                cells.append(format_metric_interval(entry.get("low"), entry.get("high"), metric.name) or EMPTY_CELL)
    if any(row.note for row in rows):
        head.append("note")
        body = [[*cells, row.note] for cells, row in zip(body, rows, strict=True)]
    return ReportTable(
        format_count(len(results), "job"),
        head,
        body,
        len(heads),
        note=_describe_directions(main_metrics(results)),
        best=frozenset(best),
    )


def write_jobs_csv(path: Path, results: Sequence[Result]) -> Path:
    """Write the table of jobs as CSV with all digits: fractions from 0 to 1, empty cells without a value.

    A metric with an interval is followed by its ends, ``NAME_low`` and ``NAME_high``. Where a job has no value, a last
    column ``note`` says why.

    Raises:
        OSError: the file cannot be written.
    """
    heads, rows = job_rows(results)
    columns = [
        (f"{metric.name}{suffix}", metric.name, field)
        for metric in main_metrics(results)
        for field, suffix in (("value", ""), ("low", "_low"), ("high", "_high"))
        if field == "value" or _has_interval(metric, rows)
    ]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    noted = any(row.note for row in rows)
    writer.writerow([*heads, *(heading for heading, _, _ in columns), *(["note"] if noted else [])])
    for row in rows:
        numbers = [row.entries[name].get(field) for _, name, field in columns]
        cells = ["" if number is None else repr(number) for number in numbers]
        writer.writerow([*row.labels, *cells, *([row.note] if noted else [])])
    return storage.replace_file(path, text.getvalue().encode())


def _has_interval(metric: MainMetric, rows: Sequence[JobRow]) -> bool:
    """Whether the intervals of a metric are shown: it is compared with them, and a row has one."""
    return metric.with_interval and any(row.entries[metric.name].get("low") is not None for row in rows)


def _metric_heading(metric: MainMetric, entries: Sequence[Mapping[str, Any]]) -> str:
    """Heading of a metric's column, with its unit where the heading does not name it."""
    heading = {"coverage_at_5": "coverage at 5 %", "ms": "ms"}.get(metric.name) or metric_heading(metric.name)
    units = {entry["unit"] for entry in entries if entry.get("unit") not in (None, "", "1", "count")}
    unit = units.pop() if len(units) == 1 else ""
    return heading if not unit or unit in heading.split() else f"{heading}, {unit}"


def _describe_directions(metrics: Sequence[MainMetric]) -> str:
    """Sentence that says of which metrics larger values are better, and of which smaller ones."""
    parts = []
    for larger, text in ((True, "larger is better"), (False, "smaller is better")):
        names = [_metric_heading(metric, ()) for metric in metrics if metric.larger_is_better is larger]
        parts += [f"{text}: {', '.join(names)}"] if names else []
    return "; ".join(parts)


def _column_headings(names: Sequence[str], show_method: bool) -> list[str]:
    """Headings of the label columns."""
    return [*names, *(["method"] if show_method else [])]


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
