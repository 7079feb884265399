"""Figures of the curves in scene rows: risk and coverage, distance, reliability."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from dhtorch.experiments.report.cells import format_value
from dhtorch.experiments.report.figure import (
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
from dhtorch.experiments.report.reading import Result, Row, variant_names
from dhtorch.viz.plots import MIN_CURVE_ANSWERS, Axis, Panel, Stroke, fit_axis
from dhtorch.viz.plots.colours import FAINT, SOFT

_OWN_RANGE_NOTE = "Every scene has its own range of depth."

_Curve = Mapping[str, Any]
_MakeAxis = Callable[[Sequence[_Curve]], Axis]  # the curves that an axis has to hold → axis


def risk_figure(result: Result) -> Figure | None:
    """Error of the surest answers."""
    ordered = len(variant_names(result)) <= 2

    def across(found: Sequence[_Curve]) -> Axis:
        most = fit_axis([0.0, *(v for c in found for v in c["coverage"])], "", low=0.0).high
        return Axis(0.0, min(1.0, most), "answered share of the candidates, %", percent=True)

    def up(found: Sequence[_Curve]) -> Axis:
        drawn = [v for c in found for k in ("risk", "oracle")[: 1 + ordered] for v in c[k]]
        return fit_axis(drawn, "mean error, %", log=True, percent=True, floor=MIN_DRAWN_ERROR, cap=1.0)

    def draw(panel: Panel, curve: _Curve, row: Row, stroke: Stroke) -> None:
        n = row.get("n_candidates") or 0
        enough = [(c or 0.0) * n >= MIN_CURVE_ANSWERS - 0.5 for c in curve["coverage"]]
        x, y, best = ([v for v, ok in zip(curve[k], enough, strict=True) if ok] for k in ("coverage", "risk", "oracle"))
        if ordered:
            panel.line(x, best, stroke._replace(width=1.0, dashes=(2.5, 2.5), opacity=0.8))
        panel.line(x, y, stroke)

    caption = "Mean relative error (at most 1) of the surest answers, by falling score; logarithmic. A mean over fewer "
    caption += f"than {MIN_CURVE_ANSWERS} answers is not drawn." + " Dashed: the best order there could be." * ordered
    return _by_scene(result, "Risk against coverage", caption, "risk_coverage", across, up, draw)


def error_by_distance_figure(result: Result) -> Figure | None:
    """Error against true depth."""
    caption = "Median relative error of the answers in tenths of the candidates by true depth; logarithmic. "
    caption += _OWN_RANGE_NOTE

    def axis(values: Sequence[float | None]) -> Axis:
        return fit_axis(values, "median error, %", log=True, percent=True, floor=MIN_DRAWN_ERROR, cap=MAX_DRAWN_ERROR)

    return _by_distance(result, "Error against distance", caption, "median_rel", axis)


def coverage_by_distance_figure(result: Result) -> Figure | None:
    """Coverage against true depth."""
    caption = f"Answered share in tenths of the candidates by true depth. {_OWN_RANGE_NOTE}"
    return _by_distance(
        result, "Coverage against distance", caption, "coverage", lambda _values: share_axis("coverage, %")
    )


def reliability_figure(result: Result) -> Figure | None:
    """Realised against claimed probability, one panel per variant."""
    panels, strokes = [], variant_strokes(result)
    for variant in strokes:
        mine = [row["curves"]["reliability"] for row in deciding_rows(result) if _is_counted(row, variant)]
        if not mine:
            continue
        panel = Panel(variant, share_axis("score (claimed probability), %"), share_axis("error < 10 %, share in %"))
        claimed, realised, weight = pool_reliability(mine)
        for k, w in enumerate(weight):
            panel.bar(k / len(weight) + 0.01, (k + 1) / len(weight) - 0.01, 0.0, w, FAINT)
        panel.line([0.0, 1.0], [0.0, 1.0], Stroke(SOFT, 1.0, (4, 3)))
        panel.line(claimed, realised, strokes[variant])
        for x, y, w in zip(claimed, realised, weight, strict=True):
            if x is not None and y is not None:
                said = [
                    f"{word} {format_value(v, how='percent')}"
                    for word, v in (("claimed", x), ("realised", y), ("weight", w))
                ]
                panel.dot(x, y, strokes[variant], ", ".join(said))
        panels.append(panel)
    caption = "Realised share of answers within 10 % against the score, in ten bins; every scene without a role weighs "
    caption += "the same. Bars: share of the answers in the bin. On the diagonal the score would be a probability."
    return Figure("Reliability", caption, panels) if panels else None


def pool_reliability(scenes: Sequence[_Curve]) -> tuple[list[float | None], list[float | None], list[float]]:
    """Reliability bins of several scenes as one, every scene with the same weight: claimed, realised, weight."""
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
    across: _MakeAxis,
    up: _MakeAxis,
    draw: Callable[[Panel, _Curve, Row, Stroke], None],
    *,
    own: bool = False,  # every panel has its own axis across
) -> Figure | None:
    """One panel per scene with one line per variant; all panels have the same axes."""
    having = [row for row in deciding_rows(result) if any((row.get("curves") or {}).get(kind, {}).values())]
    if not having:
        return None
    found = [row["curves"][kind] for row in having]
    x, y = across(found), up(found)
    panels, strokes = [], variant_strokes(result)
    scenes = list(dict.fromkeys(row["scene"] for row in having))
    for scene in scenes:
        mine = [row for row in having if row["scene"] == scene]
        panel = Panel(scene_label(mine[0]), across([row["curves"][kind] for row in mine]) if own else x, y)
        for row in mine:
            draw(panel, row["curves"][kind], row, strokes[row["method"]])
        panels.append(panel)
    drawn = variant_legend(result, [row["method"] for row in having])
    caption += " Of lines that coincide the last is seen." * (len(drawn) > 2)
    return Figure(title, caption + missing_scenes_note(result, scenes), panels, drawn)


def _by_distance(
    result: Result, title: str, caption: str, metric: str, axis: Callable[[Sequence[float | None]], Axis]
) -> Figure | None:
    def across(found: Sequence[_Curve]) -> Axis:
        return fit_axis([v for c in found for v in c["depth"]], "true depth, m")

    def draw(panel: Panel, curve: _Curve, _row: Row, stroke: Stroke) -> None:
        panel.line(curve["depth"], curve[metric], stroke)

    def up(found: Sequence[_Curve]) -> Axis:
        return axis([v for c in found for v in c[metric]])

    return _by_scene(result, title, caption, "distance", across, up, draw, own=True)


def _is_counted(row: Row, variant: str) -> bool:
    """Whether a scene has answers of the variant and counts in the summary."""
    if row["method"] != variant or row.get("role"):
        return False
    return any((row.get("curves") or {}).get("reliability", {}).get("weight") or [])
