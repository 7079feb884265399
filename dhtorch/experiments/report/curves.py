"""Figures of the curves in the rows of scenes: risk against coverage, errors by distance, reliability."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from dhtorch.experiments.report.cells import format_value
from dhtorch.experiments.report.figure import (
    KNEE_WIDTH_PT,
    MAX_DRAWN_ERROR,
    MIN_DRAWN_ERROR,
    Figure,
    deciding_rows,
    missing_scenes_note,
    scene_label,
    share_axis,
    variant_legend,
    variant_strokes,
)
from dhtorch.experiments.report.layouts import KNEE_DEFINITION
from dhtorch.experiments.report.reading import Result, Row, variant_names
from dhtorch.metrics.risk import find_knee
from dhtorch.viz.plots import MIN_CURVE_ANSWERS, Axis, Panel, Stroke, fit_axis
from dhtorch.viz.plots.colours import FAINT, SOFT

_OWN_RANGE_NOTE = "Every scene has its own range of depth."

_Curve = Mapping[str, Any]
_MakeAxis = Callable[[Sequence[_Curve]], Axis]  # curves to be drawn → axis


def risk_figure(result: Result) -> Figure | None:
    """Mean error of the most confident answers against their fraction of the candidates."""
    with_oracle = len(variant_names(result)) <= 2

    def x_axis(curves: Sequence[_Curve]) -> Axis:
        max_coverage = fit_axis([0.0, *(v for c in curves for v in c["coverage"])], "", low=0.0).high
        return Axis(0.0, min(1.0, max_coverage), "answered fraction of the candidates, %", percent=True)

    def y_axis(curves: Sequence[_Curve]) -> Axis:
        drawn = [v for c in curves for k in ("risk", "oracle")[: 1 + with_oracle] for v in c[k]]
        return fit_axis(drawn, "mean error, %", log=True, percent=True, floor=MIN_DRAWN_ERROR, cap=1.0)

    def draw(panel: Panel, curve: _Curve, row: Row, stroke: Stroke) -> None:
        n = row.get("n_candidates") or 0
        drawn_points = [(c or 0.0) * n >= MIN_CURVE_ANSWERS - 0.5 for c in curve["coverage"]]
        x, y, best = (
            [v for v, ok in zip(curve[k], drawn_points, strict=True) if ok] for k in ("coverage", "risk", "oracle")
        )
        if with_oracle:
            panel.line(x, best, stroke._replace(width=1.0, dashes=(2.5, 2.5), opacity=0.8))
        panel.line(x, y, stroke)
        points = [(c, r) for c, r in zip(x, y, strict=True) if c is not None and r is not None]
        knee = find_knee([c for c, _ in points], [r for _, r in points])
        if knee is not None:
            c, r = points[knee]
            label = f"knee: {format_value(r, 'mean_rel')} at {format_value(c, 'coverage')}"
            panel.dot(c, r, stroke, label, width=KNEE_WIDTH_PT)

    caption = "Mean relative error (at most 1) of the most confident answers; logarithmic. A mean over fewer "
    caption += (
        f"than {MIN_CURVE_ANSWERS} answers is not drawn. Large dot: the knee, {KNEE_DEFINITION}."
        + " Dashed: the best possible order." * with_oracle
    )
    return _by_scene(result, "Risk against coverage", caption, "risk_coverage", x_axis, y_axis, draw)


def error_by_distance_figure(result: Result) -> Figure | None:
    """Median error against true depth, by scene."""
    caption = "Median relative error of the answers in tenths of the candidates by true depth; logarithmic. "
    caption += _OWN_RANGE_NOTE

    def axis(values: Sequence[float | None]) -> Axis:
        return fit_axis(values, "median error, %", log=True, percent=True, floor=MIN_DRAWN_ERROR, cap=MAX_DRAWN_ERROR)

    return _by_distance(result, "Error against distance", caption, "median_rel", axis)


def coverage_by_distance_figure(result: Result) -> Figure | None:
    """Coverage against true depth, by scene."""
    caption = f"Answered fraction in tenths of the candidates by true depth. {_OWN_RANGE_NOTE}"
    return _by_distance(
        result, "Coverage against distance", caption, "coverage", lambda _values: share_axis("coverage, %")
    )


def reliability_figure(result: Result) -> Figure | None:
    """Observed frequency of errors below 10 % against the score, one panel per variant."""
    panels, strokes = [], variant_strokes(result)
    for variant in strokes:
        curves = [row["curves"]["reliability"] for row in deciding_rows(result) if _is_counted(row, variant)]
        if not curves:
            continue
        panel = Panel(variant, share_axis("score as a probability, %"), share_axis("answers with error < 10 %, %"))
        claimed, realised, weight = pool_reliability(curves)
        for k, w in enumerate(weight):
            panel.bar(k / len(weight) + 0.01, (k + 1) / len(weight) - 0.01, 0.0, w, FAINT)
        panel.line([0.0, 1.0], [0.0, 1.0], Stroke(SOFT, 1.0, (4, 3)))
        panel.line(claimed, realised, strokes[variant])
        for x, y, w in zip(claimed, realised, weight, strict=True):
            if x is not None and y is not None:
                labels = [
                    f"{name} {format_value(v, how='percent')}"
                    for name, v in (("claimed", x), ("realised", y), ("weight", w))
                ]
                panel.dot(x, y, strokes[variant], ", ".join(labels))
        panels.append(panel)
    caption = "Fraction of answers within 10 % against the score, in ten bins; every scene without a role has the same "
    caption += (
        "weight. Bars: fraction of the answers in the bin. On the diagonal the score is a calibrated probability."
    )
    return Figure("Reliability", caption, panels) if panels else None


def pool_reliability(scenes: Sequence[_Curve]) -> tuple[list[float | None], list[float | None], list[float]]:
    """Reliability bins over scenes of equal weight: claimed probability, realised frequency, weight of each bin."""
    shares = []
    for scene in scenes:
        weights = [float(w or 0.0) for w in scene["weight"]]
        shares.append([w / sum(weights) / len(scenes) for w in weights])
    weight = [float(sum(column)) for column in zip(*shares, strict=True)]

    def mean(name: str, k: int) -> float | None:
        total = sum(part[k] * (scene[name][k] or 0.0) for scene, part in zip(scenes, shares, strict=True))
        return total / weight[k] if weight[k] > 0 else None

    bins = range(len(weight))
    return [mean("claimed", k) for k in bins], [mean("realised", k) for k in bins], weight


def _by_scene(
    result: Result,
    title: str,
    caption: str,
    kind: str,
    x_axis: _MakeAxis,
    y_axis: _MakeAxis,
    draw: Callable[[Panel, _Curve, Row, Stroke], None],
    *,
    own: bool = False,  # every panel has its own x axis
) -> Figure | None:
    """Figure with one panel per scene and one line per variant; all panels have the same y axis."""
    rows = [row for row in deciding_rows(result) if any((row.get("curves") or {}).get(kind, {}).values())]
    if not rows:
        return None
    curves = [row["curves"][kind] for row in rows]
    x, y = x_axis(curves), y_axis(curves)
    panels, strokes = [], variant_strokes(result)
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    for scene in scenes:
        scene_rows = [row for row in rows if row["scene"] == scene]
        panel = Panel(scene_label(scene_rows[0]), x_axis([row["curves"][kind] for row in scene_rows]) if own else x, y)
        for row in scene_rows:
            draw(panel, row["curves"][kind], row, strokes[row["method"]])
        panels.append(panel)
    legend = variant_legend(result, [row["method"] for row in rows])
    caption += " Of lines that coincide only the last is visible." * (len(legend) > 2)
    return Figure(title, caption + missing_scenes_note(result, scenes), panels, legend)


def _by_distance(
    result: Result, title: str, caption: str, metric: str, axis: Callable[[Sequence[float | None]], Axis]
) -> Figure | None:
    """Figure of a metric against true depth, one panel per scene."""

    def x_axis(curves: Sequence[_Curve]) -> Axis:
        return fit_axis([v for c in curves for v in c["depth"]], "true depth, m")

    def draw(panel: Panel, curve: _Curve, _row: Row, stroke: Stroke) -> None:
        panel.line(curve["depth"], curve[metric], stroke)

    def y_axis(curves: Sequence[_Curve]) -> Axis:
        return axis([v for c in curves for v in c[metric]])

    return _by_scene(result, title, caption, "distance", x_axis, y_axis, draw, own=True)


def _is_counted(row: Row, variant: str) -> bool:
    """Whether a row has answers of the variant and is part of the summary."""
    if row["method"] != variant or row.get("role"):
        return False
    return any((row.get("curves") or {}).get("reliability", {}).get("weight") or [])
