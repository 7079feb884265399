"""Figure of a sweep: its main metrics along the swept option, one curve for each combination of the other options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from dhtorch.experiments.report.cells import format_value, metric_heading, metric_style
from dhtorch.experiments.report.figure import Figure, metric_axis
from dhtorch.experiments.report.jobs import NAMED_GROUPS, JobRow, job_rows, main_metrics
from dhtorch.experiments.report.reading import Result
from dhtorch.viz.plots import Axis, LegendKey, Panel, Stroke, assign_strokes, fit_axis, save_panels
from dhtorch.viz.plots.colours import INK

#: Panels of a figure at most, in the order of the metrics.
_MAX_PANELS = 6

#: Width and height of a panel along a number, points.
_PANEL_SIZE_PT = (400.0, 250.0)

#: Stroke of a chart, whose lines have names.
_CHART_STROKE = Stroke(INK)


def sweep_figure(results: Sequence[Result]) -> Figure | None:
    """Figure of a sweep; None for fewer than two rows with values.

    The horizontal axis is the option with the most values among those whose values are all numbers; with options of
    names alone every combination is a line of a chart instead. Intervals are drawn where the result has them.
    """
    heads, rows = job_rows(results)
    metrics = [
        metric.name for metric in main_metrics(results) if sum(_value(row, metric.name) is not None for row in rows) > 1
    ][:_MAX_PANELS]
    if not metrics:
        return None
    column = _swept_column(heads, rows)
    if column is None:
        names = [", ".join(row.labels) for row in rows]
        panels = [_make_chart(names, rows, metric) for metric in metrics]
        return Figure("The sweep", "Lines: 95 % interval of a bootstrap over scenes.", panels, wide=True)
    curves: dict[str, list[JobRow]] = {}
    for row in sorted(rows, key=lambda row: float(row.labels[column])):
        curves.setdefault(_curve_name(heads, row, column), []).append(row)
    legend = [LegendKey(n, s.colour, stroke=s) for n, s in assign_strokes(curves).items()] if len(curves) > 1 else []
    panels = [_make_panel(heads[column], column, curves, metric) for metric in metrics]
    caption = f"Along {heads[column]}, medians over scenes."
    return Figure("The sweep", caption, panels, legend, wide=True)


def draw_sweep(path: Path, results: Sequence[Result]) -> bool:
    """Write the figure of a sweep as PNG; False, and no file, if there is none."""
    figure = sweep_figure(results)
    if figure is not None:
        save_panels(path, [panel for panel in figure.panels if isinstance(panel, Panel)], figure.legend)
    return figure is not None


def _swept_column(heads: Sequence[str], rows: Sequence[JobRow]) -> int | None:
    """The column of numbers with the most different ones, at least two; None without any."""
    different = {k: len({row.labels[k] for row in rows}) for k in range(len(heads)) if heads[k] != "job"}
    numeric = [k for k, n in different.items() if n > 1 and all(_is_number(row.labels[k]) for row in rows)]
    return max(numeric, key=different.__getitem__, default=None)


def _curve_name(heads: Sequence[str], row: JobRow, column: int) -> str:
    others = [(name, label) for k, (name, label) in enumerate(zip(heads, row.labels, strict=True)) if k != column]
    return ", ".join(label if name in NAMED_GROUPS else f"{name} {label}" for name, label in others)


def _make_panel(option: str, column: int, curves: Mapping[str, Sequence[JobRow]], metric: str) -> Panel:
    """Panel of one metric along a number."""
    places = [float(row.labels[column]) for rows in curves.values() for row in rows]
    positive = min(places) > 0 and max(places) > 8 * min(places)
    x = fit_axis(places, option, log=positive)
    panel = Panel(_title(metric), x, _metric_axis(metric, list(curves.values())), size=_PANEL_SIZE_PT)
    for name, stroke in assign_strokes(curves).items():
        values = [(float(row.labels[column]), _value(row, metric)) for row in curves[name]]
        panel.line([at for at, _ in values], [value for _, value in values], stroke)
        for at, value in values:
            if value is not None:
                panel.dot(at, value, stroke, f"{name} {option} {at:g}: {format_value(value, metric)}".strip())
    return panel


def _make_chart(names: Sequence[str], rows: Sequence[JobRow], metric: str) -> Panel:
    """Panel of one metric with a line for every job."""
    panel = Panel(_title(metric), _metric_axis(metric, [rows]), None, size=(_PANEL_SIZE_PT[0], 0), rows=names)
    for k, row in enumerate(rows):
        low, value, high = (row.entries[metric].get(name) for name in ("low", "value", "high"))
        if low is not None:
            panel.line([low, high], [k, k], _CHART_STROKE)
        if value is not None:
            panel.dot(value, k, _CHART_STROKE, f"{names[k]}: {format_value(value, metric)}")
    return panel


def _metric_axis(metric: str, curves: Sequence[Sequence[JobRow]]) -> Axis:
    """Axis for all values and intervals of a metric."""
    values = [row.entries[metric].get(name) for rows in curves for row in rows for name in ("low", "value", "high")]
    if metric_style(metric) == "percent" or metric == "corr":
        return metric_axis(metric, values)
    return fit_axis(values, "")


def _title(metric: str) -> str:
    return metric_heading(metric) + ", %" * (metric_style(metric) == "percent")


def _value(row: JobRow, metric: str) -> float | None:
    value: float | None = row.entries[metric].get("value")
    return value


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
