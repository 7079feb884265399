"""All figures of a result from its rows and summary; this module builds those that compare variants or timings."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from dhtorch.codes import Hole, names, words
from dhtorch.experiments.report import curves, published, sweeps
from dhtorch.experiments.report.cells import format_value
from dhtorch.experiments.report.figure import (
    PUBLISHED_KEY,
    Figure,
    deciding_rows,
    metric_axis,
    scene_label,
    share_axis,
    variant_strokes,
)
from dhtorch.experiments.report.layouts import published_counterparts
from dhtorch.experiments.report.overlays import overlay_figures
from dhtorch.experiments.report.reading import Result, Row, scene_rows, summary_entry, variant_names
from dhtorch.experiments.report.timings import branch_name, is_whole_branch
from dhtorch.viz.plots import LegendKey, Panel, Stroke, fit_axis
from dhtorch.viz.plots.colours import HOLE_COLOURS, SERIES_COLOURS, SOFT

#: Kind of a timing → stroke.
_TIMED_STROKES = {
    "front end and pair": Stroke(SERIES_COLOURS[0]),
    "single stages": Stroke(SERIES_COLOURS[4]),
    "visual branch": Stroke(SERIES_COLOURS[1]),
}


def result_figures(result: Result) -> list[Figure]:
    """All figures for which a result has the numbers."""
    makers: tuple[Callable[[Result], Figure | None], ...] = (
        latency_figure,
        side_by_side_figure,
        sweeps.cutoff_figure,
        sweeps.motion_figure,
        sweeps.threshold_figure,
        holes_figure,
        curves.risk_figure,
        curves.error_by_distance_figure,
        curves.coverage_by_distance_figure,
        curves.reliability_figure,
    )
    figures = [figure for make in makers if (figure := make(result))]
    return [*figures, *overlay_figures(result)]


def side_by_side_figure(result: Result) -> Figure | None:
    """Medians over scenes with their intervals, one row per variant."""
    rows = variant_names(result)
    if len(rows) < 2:
        return None
    counterparts, panels, strokes = published_counterparts(result), [], variant_strokes(result)
    for metric, label in (("coverage", "coverage, %"), ("median_rel", "median error, %"), ("corr", "correlation")):
        entries = {v: summary_entry(result, v, metric) for v in rows}
        ours = [e.get(k) for e in entries.values() for k in ("value", "low", "high")]
        if not any(v is not None for v in ours):
            continue
        cited = {v: number for v in rows if (number := counterparts.get(v, {}).get(metric)) is not None}
        axis = metric_axis(metric, [*ours, *cited.values()])
        panel = Panel(label, axis, None, size=(400, 0), rows=rows)
        for k, (v, e) in enumerate(entries.items()):
            if e.get("low") is not None:
                panel.line([e["low"], e["high"]], [k, k], strokes[v])
            if e.get("value") is not None:
                panel.dot(e["value"], k, strokes[v], f"{v}: {format_value(e['value'], metric)}")
            if v in cited:
                panel.diamond(cited[v], k, f"published: {format_value(cited[v], metric)}")
        panels.append(panel)
    caption = "Dots: median over scenes; lines: 95 % interval of a bootstrap over scenes."
    legend = [PUBLISHED_KEY] if any(counterparts.values()) else []
    return Figure("Variants side by side", caption, panels, legend, wide=True) if panels else None


def latency_figure(result: Result) -> Figure | None:
    """Latencies in milliseconds on a logarithmic axis."""
    rows = [(branch_name(row), row) for row in scene_rows(result) if row.get("p50_ms")]
    if not rows:
        return None
    cited = {
        f"published: {name}": number
        for name, cells in published.LATENCY.lines.items()
        if (number := published.parse_printed(cells["p50_ms"]))
    }
    labels = [*(name for name, _ in rows), *cited]
    times = [t for _, row in rows for t in (row["p50_ms"], _slow_ms(row))]
    x = fit_axis([*times, *cited.values()], "milliseconds (logarithmic)", log=True)
    panel = Panel("", x, None, size=(720, 0), rows=labels)
    for k, (name, row) in enumerate(rows):
        kind = "visual branch" if row.get("stage") == "forward" else "single stages"
        stroke = _TIMED_STROKES["front end and pair" if is_whole_branch(row) and kind == "single stages" else kind]
        panel.line([row["p50_ms"], _slow_ms(row)], [k, k], stroke)
        panel.dot(row["p50_ms"], k, stroke, f"{name}: {format_value(row['p50_ms'])} ms")
    for k, (name, number) in enumerate(cited.items()):
        panel.diamond(number, len(rows) + k, f"{name}: {number:g} ms")
    caption = "Dots: p50; lines reach to p99, or to p95 where there were too few calls."
    legend = [*(LegendKey(name, stroke.colour, "dot") for name, stroke in _TIMED_STROKES.items()), PUBLISHED_KEY]
    return Figure("Latency", caption, [panel], legend, wide=True)


def holes_figure(result: Result) -> Figure | None:
    """Fractions of the hole classes by scene, as stacked bars."""
    if result["experiment"] != "hole_census":
        return None
    variant = next(iter(variant_names(result)), None)
    bars: dict[str, Mapping[str, float | None]] = {
        scene_label(row): row["hole_share"]
        for row in deciding_rows(result)
        if row["method"] == variant and any((row.get("hole_share") or {}).values())
    }
    if not bars:
        return None
    for name, cells in published.HOLE_CENSUS.lines.items():
        number = published.parse_printed(cells["hole_share.trackable_no_lidar"])
        bars[f"published: {name}"] = {"trackable_no_lidar": number}
    classes = {name.lower(): code for code, name in names(Hole).items() if code}
    panel = Panel("", share_axis("share of the holes, %"), None, size=(720, 0), rows=list(bars))
    for k, fractions in enumerate(bars.values()):
        at = 0.0
        for name, code in classes.items():
            fraction = fractions.get(name) or 0.0
            if fraction > 0:
                panel.bar(at, at + fraction, k + 0.32, k - 0.32, HOLE_COLOURS[code], SOFT)
            at += fraction
    legend = [LegendKey(words(name), HOLE_COLOURS[code], "box") for name, code in classes.items()]
    caption = "Holes of the sensor by class; for the published captures only the key class is reported."
    return Figure("Why returns are missing", caption, [panel], legend, wide=True)


def _slow_ms(row: Row) -> float | None:
    """Slow end of a latency: p99, or p95 without it."""
    latency: float | None = row.get("p99_ms") or row.get("p95_ms")
    return latency
