"""Figures along a setting: cutoff, baseline, threshold on the score."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

from dhtorch.experiments.report import published
from dhtorch.experiments.report.cells import format_value
from dhtorch.experiments.report.figure import (
    KNEE_WIDTH_PT,
    PUBLISHED_KEY,
    SCENE_STROKE,
    Figure,
    deciding_rows,
    metric_axis,
    share_axis,
    variant_legend,
    variant_strokes,
)
from dhtorch.experiments.report.layouts import KNEE_DEFINITION, threshold_knee, threshold_points
from dhtorch.experiments.report.reading import Result, Row, metric_value, summary_entry, variant_names
from dhtorch.viz.plots import LegendKey, Panel, Stroke, fit_axis
from dhtorch.viz.plots.colours import INK

_SWEPT_METRICS = (("coverage", "coverage, %"), ("median_rel", "median error, %"))
#: The paper's default cutoff, m.
_DEFAULT_CUTOFF_M = 2.0


def cutoff_figure(result: Result) -> Figure | None:
    """Coverage and error against the cutoff, as a ratio to the default one."""
    ratios = {variant: ratio for variant in variant_names(result) if (ratio := _cutoff_ratio(variant)) is not None}
    cited = {}
    for cells in published.CUTOFF_SWEEP.lines.values():
        numbers = {m: published.parse_printed(cell) for m, cell in cells.items()}
        cited[(numbers["cutoff_m"] or 0.0) / _DEFAULT_CUTOFF_M] = numbers
    panels = _sweep_panels(result, ratios, lambda row: ratios[row["method"]], "cutoff, ratio to the default", cited)
    caption = "The default cutoff is 2 m in the paper; here it is each scene's own near limit or the job's cutoff."
    return Figure("Cutoff sweep", caption, panels, [*_SWEEP_LEGEND, PUBLISHED_KEY], wide=True) if panels else None


def motion_figure(result: Result) -> Figure | None:
    """Coverage and error against the baseline."""
    if result["experiment"] != "motion":
        return None
    panels = _sweep_panels(result, variant_names(result), lambda row: row.get("baseline_m"), "baseline, m", {})
    caption = "Every dot is one gap between the two views, drawn at the median baseline of that gap."
    return Figure("Motion dependence", caption, panels, _SWEEP_LEGEND, wide=True) if panels else None


def threshold_figure(result: Result) -> Figure | None:
    """Error against coverage by threshold on the score: the paper's figure of selective risk."""
    paths = {v: path for v in variant_names(result) if len(path := _threshold_path(result, v)) > 1}
    if not paths:
        return None
    cited = {
        name: (published.parse_printed(cells["coverage"]), published.parse_printed(cells["median_rel"]))
        for name, cells in published.THRESHOLDS.lines.items()
    }
    errors = [e for path in paths.values() for _, _, e in path] + [e for _, e in cited.values()]
    panel = Panel("", share_axis("coverage, %"), metric_axis("median_rel", errors, "median error, %"), size=(560, 320))
    strokes = variant_strokes(result)
    for v, path in paths.items():
        panel.line([c for _, c, _ in path], [e for _, _, e in path], strokes[v])
        for name, c, e in path:
            panel.dot(c, e, strokes[v], f"{v}, {_sweep_point(name, c, e)}")
        for name, c, e in (point for point in path if point[0] == threshold_knee(result, v)):
            panel.dot(c, e, strokes[v], f"{v}, knee, {_sweep_point(name, c, e)}", width=KNEE_WIDTH_PT)
    for name, (coverage, error) in cited.items():
        if coverage is not None and error is not None:
            panel.diamond(coverage, error, f"published, {_sweep_point(name, coverage, error)}")
    caption = "Each dot is a threshold on the score, medians over scenes; the paper gives two (0 and 0.3). "
    caption += f"Large dot: the knee, {KNEE_DEFINITION}."
    legend = [*variant_legend(result, list(paths)), PUBLISHED_KEY]
    return Figure("Threshold on the score", caption, [panel], legend, wide=True)


def _sweep_point(name: str, coverage: float, error: float) -> str:
    """Text of a threshold with its error and coverage."""
    return f"score from {name}: {format_value(error, 'median_rel')} at {format_value(coverage, 'coverage')}"


def _threshold_path(result: Result, variant: str) -> list[tuple[str, float, float]]:
    """Points (threshold, coverage, median error) of a variant with both values."""
    points = []
    for name, numbers in threshold_points(result, variant):
        c, e = numbers["coverage"], numbers["median_rel"]
        if c is not None and e is not None:
            points.append((name, c, e))
    return points


def _sweep_panels(
    result: Result,
    swept: Mapping[str, float] | Sequence[str],  # variants
    axis_value: Callable[[Row], float | None],  # row → value on the axis
    label: str,
    cited: Mapping[float, Mapping[str, float | None]],  # value → the paper's figures
) -> list[Panel]:
    """Panels of coverage and error against a setting: scenes, medians, the paper; empty with fewer than two values."""
    rows = [row for row in deciding_rows(result) if row["method"] in swept and not row.get("role")]
    points = [(x, row) for row in rows if (x := axis_value(row)) is not None and not row.get("note")]
    if len({x for x, _ in points}) < 2:
        return []
    axis, panels = fit_axis([*(x for x, _ in points), *cited], label), []
    for metric, words in _SWEPT_METRICS:
        published_values = {x: cells.get(metric) for x, cells in cited.items()}
        y = metric_axis(metric, [*(metric_value(row, metric) for _, row in points), *published_values.values()], words)
        panel = Panel(words, axis, y, size=(400, 250))
        for scene in dict.fromkeys(row["scene"] for _, row in points):
            line = sorted(
                ((x, metric_value(row, metric)) for x, row in points if row["scene"] == scene), key=lambda m: m[0]
            )
            panel.line([x for x, _ in line], [v for _, v in line], SCENE_STROKE)
        _draw_medians(panel, result, points, metric)
        for x, number in published_values.items():
            if number is not None:
                panel.diamond(x, number, f"published: {format_value(number, metric)}")
        panels.append(panel)
    return panels


def _draw_medians(panel: Panel, result: Result, points: Sequence[tuple[float, Row]], metric: str) -> None:
    """Draw the summary over scenes at the median axis value of each variant."""
    names = dict.fromkeys(row["method"] for _, row in points)
    positions = sorted((_median([x for x, row in points if row["method"] == v]), v) for v in names)
    values = [summary_entry(result, v, metric).get("value") for _, v in positions]
    panel.line([x for x, _ in positions], values, _MEDIAN_STROKE)
    for (x, v), number in zip(positions, values, strict=True):
        if number is not None:
            panel.dot(x, number, _MEDIAN_STROKE, f"{v}: {format_value(number, metric)}", width=8)


def _median(values: Sequence[float]) -> float:
    """Median of some values."""
    ordered = sorted(values)
    return (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2


def _cutoff_ratio(variant: str) -> float | None:
    """Cutoff of a variant as a ratio to the default one; None for a variant outside the sweep."""
    match = re.fullmatch(r"gated(?:, cutoff (?:[x×]([\d.]+)|([\d.]+) m))?", variant)
    if not match:
        return None
    return float(match[1]) if match[1] else float(match[2]) / _DEFAULT_CUTOFF_M if match[2] else 1.0


_MEDIAN_STROKE = Stroke(INK, 2.8)
_SWEEP_LEGEND = [
    LegendKey("median over scenes", INK, stroke=_MEDIAN_STROKE),
    LegendKey("single scenes", SCENE_STROKE.colour, stroke=SCENE_STROKE),
]
