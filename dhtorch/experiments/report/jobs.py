"""The jobs of a sweep: the settings that differ, then the main metrics; as a table, as CSV, and as curves.

Which metrics are the main ones, and which of their values is better, is named by the experiment, in its result. Of a
result without such names, those of experiments on depth are taken, and if it has none of these its first metrics.
"""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.experiments.outcome import DEPTH_METRICS, MainMetric
from dhtorch.experiments.report.cells import (
    EMPTY_CELL,
    Result,
    format_metric_interval,
    format_value,
    metric_heading,
    metric_style,
    summary_entry,
    variant_names,
)
from dhtorch.experiments.report.figures import Figure, metric_axis
from dhtorch.experiments.report.tables import INTERVAL_LABEL, ReportTable
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count
from dhtorch.viz.plots import add_legend, assign_strokes, make_figure, save_figure, set_axis, set_title
from dhtorch.viz.plots.colours import INK
from dhtorch.viz.plots.figures import draw_rows, set_rows

#: Settings that do not distinguish jobs.
_IGNORED_SETTINGS = ("output", "resume", "traceback", "figures", "workers", "threads", "launch")

#: Groups of settings with named choices; their members are listed only if they differ under the same name.
NAMED_GROUPS = ("method", "data", "pairs", "experiment")


def _differing_settings(results: Sequence[Result]) -> list[dict[str, str]]:
    """Settings that differ between results: for each result, name → value as text."""
    choices = []
    for result in results:
        pairs = result["config"].get("pairs")
        target = str(pairs.get("_target_") if isinstance(pairs, Mapping) else pairs)
        pair_choice = target.rpartition(".")[2].removeprefix("by_")
        named = " ".join(variant_names(result)), result["data"]["name"], pair_choice, result["experiment"]
        choices.append(dict(zip(NAMED_GROUPS, map(str, named), strict=True)))
    flat = [dict(_flatten_config(result["config"])) for result in results]
    groups = [group for group in NAMED_GROUPS if len({choice[group] for choice in choices}) > 1]
    differing = [{group: choice[group] for group in groups} for choice in choices]
    for name in dict.fromkeys(name for settings in flat for name in settings):
        values_by_choice: dict[str, set[str]] = {}
        for settings, choice in zip(flat, choices, strict=True):
            among = values_by_choice.setdefault(choice.get(name.partition(".")[0], ""), set())
            among.add(settings.get(name, EMPTY_CELL))
        if any(len(values) > 1 for values in values_by_choice.values()):
            for row, settings in zip(differing, flat, strict=True):
                row[name] = settings.get(name, EMPTY_CELL)
    return differing


def _flatten_config(config: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Settings of a configuration as (dotted name, value as text)."""
    for key, value in config.items():
        if str(key).startswith("_") or (not above and key in _IGNORED_SETTINGS):
            continue
        if isinstance(value, Mapping):
            yield from _flatten_config(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", "null" if value is None else str(value)


def _main_metrics(results: Sequence[Result]) -> list[MainMetric]:
    """Metrics of a table of results, without those of which no result has a value; all if none has any."""
    named: dict[str, MainMetric] = {}
    for result in results:
        variants = variant_names(result)
        metrics: Sequence[MainMetric] = [MainMetric(**metric) for metric in result.get("metrics", ())]
        if "metrics" not in result:
            of_first = [name for v in variants[:1] for name in result["summary"] if name.startswith(f"{v}.")]
            first = [name.removeprefix(f"{variants[0]}.") for name in of_first] or list(result["summary"])
            of_depth = any(_entry(result, v, metric.name) for v in variants for metric in DEPTH_METRICS)
            metrics = DEPTH_METRICS if of_depth else [MainMetric(name) for name in first[:6]]
        named |= {metric.name: metric for metric in metrics}
    entries = {name: [_entry(r, v, name) for r in results for v in variant_names(r)] for name in named}
    valued = [metric for name, metric in named.items() if any(e.get("value") is not None for e in entries[name])]
    return valued or list(named.values())


def _entry(result: Result, variant: str, metric: str) -> Mapping[str, Any]:
    """Summary entry of a main metric; ``ms`` is the sum over the stages."""
    entry = summary_entry(result, variant, metric)
    if metric != "ms" or entry:
        return entry
    stages = {name.rpartition("ms.")[2] for name in result["summary"] if ".ms." in f".{name}"}
    spent = [summary_entry(result, variant, f"ms.{stage}").get("value") for stage in stages]
    spent = [value for value in spent if value is not None]
    return {"value": sum(spent), "unit": "ms"} if spent else {}


@dataclass(frozen=True)
class _JobRow:
    """Row of a job and variant."""

    labels: list[str]
    entries: dict[str, Mapping[str, Any]]  # metric → its entry in the summary
    note: str = ""  # why it has no value, if it has none


def _job_rows(results: Sequence[Result]) -> tuple[list[str], list[_JobRow]]:
    """Label columns, and a row for every job and variant that has a value; a job without values has one with a note."""
    settings, metrics = _differing_settings(results), _main_metrics(results)
    heads = list(dict.fromkeys(name for row in settings for name in row))
    several = any(len(variant_names(result)) > 1 for result in results)
    heads += ["method"] if several and "method" not in heads else []
    rows: list[_JobRow] = []
    for result, row in zip(results, settings, strict=True):
        entries = {v: {m.name: _entry(result, v, m.name) for m in metrics} for v in variant_names(result)}
        valued = [v for v, of in entries.items() if any(e.get("value") is not None for e in of.values())]
        # why a job has no value: the first note of its rows, else the reason of its verdict
        notes = [f"{r['scene']}: {r['note']}" for r in result["rows"] if r.get("note")]
        note = "" if valued else next(iter([*notes, *filter(None, [result.get("why")])]), "")
        for variant in valued or list(entries)[:1]:
            label = {**row, "method": variant} if "method" in heads else row
            rows.append(_JobRow([label.get(name, EMPTY_CELL) for name in heads], entries[variant], note))
    return (heads, rows) if heads else (["job"], [replace(row, labels=[str(k + 1)]) for k, row in enumerate(rows)])


def jobs_table(results: Sequence[Result]) -> ReportTable | None:
    """Table of jobs with the best value of every column highlighted; None for fewer than two results."""
    if len(results) < 2:
        return None
    heads, rows = _job_rows(results)
    head, body, best = list(heads), [list(row.labels) for row in rows], set()
    directions: dict[bool, list[str]] = {True: [], False: []}
    for metric in _main_metrics(results):
        entries = [row.entries[metric.name] for row in rows]
        values = [entry.get("value") for entry in entries]
        known = {value for value in values if value is not None}
        heading = {"coverage_at_5": "coverage at 5 %", "ms": "ms"}.get(metric.name) or metric_heading(metric.name)
        if metric.larger_is_better is not None:
            directions[metric.larger_is_better].append(heading)
        if metric.larger_is_better is not None and len(known) > 1:
            best_value = max(known) if metric.larger_is_better else min(known)
            best |= {(n, len(head)) for n, value in enumerate(values) if value == best_value}
        units = {entry["unit"] for entry in entries if entry.get("unit") not in (None, "", "1", "count")}
        unit = units.pop() if len(units) == 1 else ""  # where the heading does not name it
        head.append(heading if not unit or unit in heading.split() else f"{heading}, {unit}")
        for cells, value in zip(body, values, strict=True):
            in_ms = metric.name == "ms" and value is not None
            cells.append(f"{value:.0f}" if in_ms else format_value(value, metric.name))
        if _has_interval(metric, rows):
            head.append(INTERVAL_LABEL)
            for cells, e in zip(body, entries, strict=True):
                cells.append(format_metric_interval(e.get("low"), e.get("high"), metric.name) or EMPTY_CELL)
    if any(row.note for row in rows):
        head.append("note")
        body = [[*cells, row.note] for cells, row in zip(body, rows, strict=True)]
    sides = {True: "larger is better", False: "smaller is better"}
    note = "; ".join(f"{sides[side]}: {', '.join(names)}" for side, names in directions.items() if names)
    return ReportTable(format_count(len(results), "job"), head, body, len(heads), note=note, best=frozenset(best))


def _has_interval(metric: MainMetric, rows: Sequence[_JobRow]) -> bool:
    """Whether the intervals of a metric are shown: it is compared with them, and a row has one."""
    return metric.with_interval and any(row.entries[metric.name].get("low") is not None for row in rows)


def write_jobs_csv(path: Path, results: Sequence[Result]) -> Path:
    """Write the table of jobs as CSV with all digits: fractions from 0 to 1, empty cells without a value.

    A metric with an interval is followed by its ends, ``NAME_low`` and ``NAME_high``. Where a job has no value, a last
    column ``note`` says why.

    Raises:
        OSError: the file cannot be written.
    """
    heads, rows = _job_rows(results)
    columns = [
        (f"{metric.name}{suffix}", metric.name, field)
        for metric in _main_metrics(results)
        for field, suffix in (("value", ""), ("low", "_low"), ("high", "_high"))
        if field == "value" or _has_interval(metric, rows)
    ]
    noted = any(row.note for row in rows)
    lines = [[*heads, *(heading for heading, _, _ in columns), *["note"] * noted]]
    for row in rows:
        numbers = [row.entries[name].get(field) for _, name, field in columns]
        lines.append([*row.labels, *("" if n is None else repr(n) for n in numbers), *[row.note] * noted])
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return storage.replace_file(path, text.getvalue().encode())


def sweep_figure(results: Sequence[Result]) -> Figure | None:
    """Figure of a sweep: at most six main metrics; None for fewer than two rows with values.

    The horizontal axis is the option with the most values among those whose values are all numbers, with one curve for
    each combination of the other options; with options of names alone every combination is a row of a chart instead,
    with its interval where the result has one.
    """
    heads, rows = _job_rows(results)
    values = {m.name: [row.entries[m.name].get("value") for row in rows] for m in _main_metrics(results)}
    metrics = [name for name, of in values.items() if sum(value is not None for value in of) > 1][:6]
    if not metrics:
        return None
    different = {k: {row.labels[k] for row in rows} for k, name in enumerate(heads) if name != "job"}
    numeric = [k for k, labels in different.items() if len(labels) > 1 and all(map(_is_number, labels))]
    column = max(numeric, key=lambda k: len(different[k]), default=None)
    curves: dict[str, list[int]] = {}
    for n, row in enumerate(rows):
        others = [(head, label) for k, (head, label) in enumerate(zip(heads, row.labels, strict=True)) if k != column]
        name = ", ".join(label if head in NAMED_GROUPS else f"{head} {label}" for head, label in others)
        curves.setdefault(name if column is not None else ", ".join(row.labels), []).append(n)
    figure, panels = make_figure(len(metrics), (400, 250 if column is not None else 66 + 19 * len(rows)))
    strokes = assign_strokes(curves)
    for axes, metric in zip(panels, metrics, strict=True):
        percent = metric_style(metric) == "percent"
        ends = [[row.entries[metric].get(name) for name in ("low", "value", "high")] for row in rows]
        of_depth = (
            metric_axis(metric, [end for of_row in ends for end in of_row]) if percent or metric == "corr" else {}
        )
        set_title(axes, metric_heading(metric) + ", %" * percent)
        if column is None:
            draw_rows(axes, ends, [INK] * len(rows))
            set_rows(axes, list(curves))
            set_axis(axes, "x", **of_depth)
            continue
        places = np.array([float(row.labels[column]) for row in rows])
        for name, stroke in strokes.items():
            order = sorted(curves[name], key=places.__getitem__)
            y = np.array([values[metric][n] for n in order], float)
            axes.plot(places[order], y, marker="o", **stroke.options(), markersize=6.8)
        set_axis(axes, "x", heads[column], log=places.min() > 0 and places.max() > 8 * places.min())
        set_axis(axes, "y", **of_depth)
    if column is None:
        return Figure("The sweep", "Lines: 95 % interval of a bootstrap over scenes.", figure)
    add_legend(figure, {name: stroke.options() for name, stroke in strokes.items()} if len(curves) > 1 else {})
    return Figure("The sweep", f"Along {heads[column]}, medians over scenes.", figure)


def draw_sweep(path: Path, results: Sequence[Result]) -> bool:
    """Write the figure of a sweep as PNG; False, and no file, if there is none."""
    figure = sweep_figure(results)
    if figure is not None:
        save_figure(figure.drawn, path)
    return figure is not None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
