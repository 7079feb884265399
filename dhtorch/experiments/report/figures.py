"""Figures of a result from its rows and summary, as matplotlib axes."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from dhtorch.codes import Gate, Hole, Source, names, words
from dhtorch.experiments.report.cells import (
    Result,
    Row,
    deciding_rows,
    metric_value,
    scene_label,
    scene_rows,
    summary_entry,
    variant_names,
)
from dhtorch.experiments.report.layouts import (
    KNEE_DEFINITION,
    branch_name,
    is_whole_branch,
    published_counterparts,
    threshold_knee,
    threshold_points,
)
from dhtorch.experiments.report.published import PAPER, parse_printed
from dhtorch.metrics.risk import find_knee
from dhtorch.viz.plots import add_legend, assign_strokes, draw_line, make_figure, mark_options, set_axis, set_title
from dhtorch.viz.plots.colours import (
    FAINT,
    GATE_COLOURS,
    HOLE_COLOURS,
    INK,
    SERIES_COLOURS,
    SOFT,
    SOURCE_COLOURS,
    Stroke,
)
from dhtorch.viz.plots.figures import PAPER_MARK, draw_rows, set_rows
from dhtorch.viz.plots.samples import MIN_CURVE_ANSWERS, PointLayer, draw_points

#: Relative errors drawn on a logarithmic axis, from and to.
_ERROR_RANGE = (1e-3, 10.0)
#: Strokes of a median over scenes and of a single scene among others; width of the dot at a knee, points.
_MEDIAN_STROKE, _SCENE_STROKE, _KNEE_WIDTH_PT = Stroke(INK, 2.8), Stroke(SOFT, 0.9, opacity=0.55), 11.0
_FRACTION: dict[str, Any] = {"percent": True, "limits": (0.0, 1.0)}
#: Metric → label of its axis.
_MEASURED = {"coverage": "coverage, %", "median_rel": "median error, %", "corr": "correlation"}
#: Variants in order of preference for the first figure of samples.
_PREFERRED_VARIANTS = ("gated", "anchored", "both gates", "gap x1", "map", "paper")

_Draw = Callable[[Any, Mapping[str, Any], Row, Stroke], None]  # axes, curves of a row, row, stroke


@dataclass(frozen=True)
class Figure:
    """A matplotlib figure with its caption."""

    title: str
    caption: str
    drawn: Any
    folded: bool = False  # hidden until it is unfolded
    is_raster: bool = False  # of too many marks for an SVG


def result_figures(result: Result) -> list[Figure]:
    """All figures for which a result has the numbers."""
    errors = "Median relative error of the answers in tenths of the candidates by true depth; logarithmic."
    coverage = "Answered fraction in tenths of the candidates by true depth."
    motion = "Every dot is one gap between the two views, drawn at the median baseline of that gap."
    figures = (
        _latency(result),
        _side_by_side(result),
        _cutoffs(result),
        _along(result, "Motion dependence", motion, lambda row: row.get("baseline_m"), "baseline, m", {})
        if result["experiment"] == "motion"
        else None,
        _thresholds(result),
        _holes(result),
        _risk(result),
        _by_distance(result, "median_rel", "Error", errors, log=True),
        _by_distance(result, "coverage", "Coverage", coverage, limits=(0.0, 1.0)),
        _reliability(result),
    )
    return [*(figure for figure in figures if figure), *_overlays(result)]


def metric_axis(metric: str, values: Sequence[float | None]) -> dict[str, Any]:
    """Options of ``set_axis`` for coverage (0 to 100 %), correlation (up to 1) or an error (log for a large range)."""
    finite = [v for v in values if v is not None]
    if metric == "coverage":
        return _FRACTION
    if metric == "corr":
        return {"limits": (max(-1.0, min([0.0, *finite])) - 0.02, 1.02)}
    positive = [v for v in finite if v > 0]
    log = bool(positive) and max(positive) > 8 * min(positive)
    return {"percent": True, "log": log, "limits": (None if log else 0.0, None)}


def _side_by_side(result: Result) -> Figure | None:
    """Medians over scenes with their intervals, one row per variant."""
    rows, counterparts = variant_names(result), published_counterparts(result)
    entries = {m: {v: summary_entry(result, v, m) for v in rows} for m in _MEASURED}
    measured = [m for m in _MEASURED if any(e.get("value") is not None for e in entries[m].values())]
    if len(rows) < 2 or not measured:
        return None
    figure, panels = make_figure(len(measured), (400, 66 + 19 * len(rows)))
    strokes = assign_strokes(rows)
    for axes, metric in zip(panels, measured, strict=True):
        cited = {k: n for k, v in enumerate(rows) if (n := counterparts.get(v, {}).get(metric)) is not None}
        ours = [[e.get(name) for name in ("low", "value", "high")] for e in entries[metric].values()]
        draw_rows(axes, ours, [stroke.colour for stroke in strokes.values()])
        axes.plot(list(cited.values()), list(cited), **PAPER_MARK)
        set_rows(axes, rows)
        values = [*(end for interval in ours for end in interval), *cited.values()]
        set_axis(axes, "x", _MEASURED[metric], **metric_axis(metric, values))
    add_legend(figure, {"published": PAPER_MARK} if any(counterparts.values()) else {})
    caption = "Dots: median over scenes; lines: 95 % interval of a bootstrap over scenes."
    return Figure("Variants side by side", caption, figure)


def _latency(result: Result) -> Figure | None:
    """Latencies in milliseconds on a logarithmic axis."""
    rows = [row for row in scene_rows(result) if row.get("p50_ms")]
    if not rows:
        return None
    printed = {f"published: {name}": cells["p50_ms"] for name, cells in PAPER["latency"].lines.items()}
    cited = {name: number for name, cell in printed.items() if (number := parse_printed(cell))}
    strokes = dict(zip(("front end and pair", "single stages", "visual branch"), SERIES_COLOURS[:5:2], strict=True))
    figure, (axes,) = make_figure(size=(720, 66 + 19 * (len(rows) + len(cited))))
    whole = ["front end and pair" if is_whole_branch(row) else "single stages" for row in rows]
    kinds = ["visual branch" if row.get("stage") == "forward" else kind for row, kind in zip(rows, whole, strict=True)]
    intervals = [[row["p50_ms"], row["p50_ms"], row.get("p99_ms") or row.get("p95_ms")] for row in rows]
    draw_rows(axes, intervals, [strokes[kind] for kind in kinds])
    axes.plot(list(cited.values()), range(len(rows), len(rows) + len(cited)), **PAPER_MARK)
    set_rows(axes, [*map(branch_name, rows), *cited])
    set_axis(axes, "x", "milliseconds (logarithmic)", log=True)
    marks = {name: mark_options(colour) for name, colour in strokes.items()}
    add_legend(figure, {**marks, "published": PAPER_MARK})
    return Figure("Latency", "Dots: p50; lines reach to p99, or to p95 where there were too few calls.", figure)


def _holes(result: Result) -> Figure | None:
    """Fractions of the hole classes by scene, as stacked bars."""
    variant = next(iter(variant_names(result)), None)
    bars: dict[str, Mapping[str, float | None]] = {
        scene_label(row): row["hole_share"]
        for row in deciding_rows(result)
        if row["method"] == variant and any((row.get("hole_share") or {}).values())
    }
    if result["experiment"] != "hole_census" or not bars:
        return None
    for name, cells in PAPER["hole_census"].lines.items():
        number = parse_printed(cells["hole_share.trackable_no_lidar"])
        bars[f"published: {name}"] = {"trackable_no_lidar": number}
    figure, (axes,) = make_figure(size=(720, 66 + 19 * len(bars)))
    left = np.zeros(len(bars))
    for code, name in names(Hole).items():
        if code:
            fractions = np.array([bar.get(name.lower()) or 0.0 for bar in bars.values()])
            options = {"color": HOLE_COLOURS[code], "edgecolor": SOFT, "linewidth": 0.5, "label": words(name)}
            axes.barh(range(len(bars)), fractions, 0.64, left, **options)
            left += fractions
    set_rows(axes, list(bars))
    set_axis(axes, "x", "share of the holes, %", **_FRACTION)
    figure.legend(loc="outside upper left", ncols=4, frameon=False, fontsize=9)
    caption = "Holes of the sensor by class; for the published captures only the key class is reported."
    return Figure("Why returns are missing", caption, figure)


def _cutoffs(result: Result) -> Figure | None:
    """Coverage and error against the cutoff, as a ratio to the default one: 2 m in the paper."""
    ratios: dict[str, float | None] = {}
    for variant in variant_names(result):
        if match := re.fullmatch(r"gated(?:, cutoff (?:[x×]([\d.]+)|([\d.]+) m))?", variant):
            ratios[variant] = float(match[1]) if match[1] else float(match[2]) / 2.0 if match[2] else 1.0
    numbers = [{m: parse_printed(c) for m, c in cells.items()} for cells in PAPER["cutoff_sweep"].lines.values()]
    cited = {(line["cutoff_m"] or 0.0) / 2.0: line for line in numbers}
    caption = "The default cutoff is 2 m in the paper; here it is each scene's own near limit or the job's cutoff."
    label = "cutoff, ratio to the default"
    return _along(result, "Cutoff sweep", caption, lambda row: ratios.get(row["method"]), label, cited)


def _along(
    result: Result,
    title: str,
    caption: str,
    axis_value: Callable[[Row], float | None],
    label: str,
    cited: Mapping[float, Mapping[str, float | None]],  # value → the paper's figures
) -> Figure | None:
    """Coverage and error against a setting: scenes, medians, the paper; None with fewer than two values."""
    rows = [row for row in deciding_rows(result) if not row.get("role") and not row.get("note")]
    points = [(x, row) for row in rows if (x := axis_value(row)) is not None]
    if len({x for x, _ in points}) < 2:
        return None
    variants = dict.fromkeys(row["method"] for _, row in points)
    places = sorted((median(x for x, row in points if row["method"] == v), v) for v in variants)
    figure, panels = make_figure(2, (400, 250))
    points.sort(key=lambda point: point[0])
    for axes, (metric, name) in zip(panels, list(_MEASURED.items())[:2], strict=True):
        for scene in dict.fromkeys(row["scene"] for _, row in points):
            line = [(x, metric_value(row, metric)) for x, row in points if row["scene"] == scene]
            draw_line(axes, [x for x, _ in line], [value for _, value in line], _SCENE_STROKE)
        medians = [summary_entry(result, v, metric).get("value") for _, v in places]
        draw_line(axes, [x for x, _ in places], medians, _MEDIAN_STROKE)
        axes.plot([x for x, _ in places], np.array(medians, float), "o", color=INK, markersize=8)
        theirs = [numbers.get(metric) for numbers in cited.values()]
        axes.plot(list(cited), np.array(theirs, float), **PAPER_MARK)
        set_axis(axes, "x", label)
        values = [*(metric_value(row, metric) for _, row in points), *theirs]
        set_axis(axes, "y", name, **metric_axis(metric, values))
    keys: dict[str, Mapping[str, Any]] = {"median over scenes": _MEDIAN_STROKE.options()}
    keys |= {"single scenes": _SCENE_STROKE.options()} | ({"published": PAPER_MARK} if cited else {})
    add_legend(figure, keys)
    return Figure(title, caption, figure)


def _thresholds(result: Result) -> Figure | None:
    """Error against coverage by threshold on the score: the paper's figure of selective risk."""
    paths = {}
    for variant in variant_names(result):
        points = [(name, n["coverage"], n["median_rel"]) for name, n in threshold_points(result, variant)]
        paths[variant] = [point for point in points if None not in point]
    paths = {v: path for v, path in paths.items() if len(path) > 1}
    if not paths:
        return None
    lines = PAPER["thresholds"].lines.values()
    cited = [tuple(parse_printed(cells[m]) for m in ("coverage", "median_rel")) for cells in lines]
    figure, (axes,) = make_figure(size=(560, 320))
    strokes = assign_strokes(variant_names(result))
    for v, path in paths.items():
        axes.plot(*zip(*(point[1:] for point in path), strict=True), marker="o", **strokes[v].options(), markersize=6.8)
        for name, *place in path:
            axes.annotate(name, place, (4, 4), textcoords="offset points", fontsize=8, color=SOFT)
        knee = [place for name, *place in path if name == threshold_knee(result, v)]
        axes.plot(*np.array(knee, float).reshape(-1, 2).T, "o", color=strokes[v].colour, markersize=_KNEE_WIDTH_PT)
    axes.plot(*zip(*cited, strict=True), **PAPER_MARK)
    set_axis(axes, "x", "coverage, %", **_FRACTION)
    errors = [e for path in paths.values() for _, _, e in path] + [e for _, e in cited]
    set_axis(axes, "y", "median error, %", **metric_axis("median_rel", errors))
    add_legend(figure, {v: strokes[v].options() for v in paths} | {"published": PAPER_MARK})
    caption = "Each dot is a threshold on the score, medians over scenes; the paper gives two (0 and 0.3). "
    return Figure("Threshold on the score", f"{caption}Large dot: the knee, {KNEE_DEFINITION}.", figure)


def _risk(result: Result) -> Figure | None:
    """Mean error of the most confident answers against their fraction of the candidates."""
    with_oracle = len(variant_names(result)) <= 2

    def draw(axes: Any, curve: Mapping[str, Any], row: Row, stroke: Stroke) -> None:
        values = {k: np.array(curve[k], float) for k in ("coverage", "risk", "oracle")}
        enough = np.nan_to_num(values["coverage"]) * (row.get("n_candidates") or 0) >= MIN_CURVE_ANSWERS - 0.5
        x, y, best = (v[enough].clip(_ERROR_RANGE[0], 1.0) for v in values.values())
        if with_oracle:
            draw_line(axes, x, best, stroke._replace(width=1.0, dashes=(2.5, 2.5), opacity=0.8))
        draw_line(axes, x, y, stroke)
        known = np.isfinite(x) & np.isfinite(y)
        knee = find_knee(x[known].tolist(), y[known].tolist())
        if knee is not None:
            axes.plot(x[known][knee], y[known][knee], "o", color=stroke.colour, markersize=_KNEE_WIDTH_PT)

    caption = "Mean relative error (at most 1) of the most confident answers; logarithmic. A mean over fewer than "
    caption += f"{MIN_CURVE_ANSWERS} answers is not drawn. Large dot: the knee, {KNEE_DEFINITION}."
    caption += " Dashed: the best possible order." * with_oracle
    axes = {"x": {"label": "answered fraction of the candidates, %", "percent": True, "limits": (0.0, None)}}
    axes["y"] = {"label": "mean error, %", "log": True, "percent": True}
    return _by_scene(result, "Risk against coverage", caption, "risk_coverage", axes, draw)


def _by_distance(result: Result, metric: str, title: str, caption: str, **axis: Any) -> Figure | None:
    """A metric in tenths of the candidates by true depth, by scene."""

    def draw(axes: Any, curve: Mapping[str, Any], _row: Row, stroke: Stroke) -> None:
        values = np.array(curve[metric], float)
        draw_line(axes, curve["depth"], values.clip(*_ERROR_RANGE) if axis.get("log") else values, stroke)

    options = {"x": {"label": "true depth, m"}, "y": {"label": _MEASURED[metric], "percent": True, **axis}}
    caption += " Every scene has its own range of depth."
    return _by_scene(result, f"{title} against distance", caption, "distance", options, draw)


def _by_scene(
    result: Result, title: str, caption: str, kind: str, options: Mapping[str, Mapping[str, Any]], draw: _Draw
) -> Figure | None:
    """Figure with axes per scene and one line per variant; all axes have the same y axis."""
    rows = [row for row in deciding_rows(result) if any((row.get("curves") or {}).get(kind, {}).values())]
    scenes = {row["scene"]: scene_label(row) for row in rows}
    if not scenes:
        return None
    figure, panels = make_figure(len(scenes), sharey=True)
    strokes = assign_strokes(variant_names(result))
    for axes, (scene, label) in zip(panels, scenes.items(), strict=True):
        for row in rows:
            if row["scene"] == scene:
                draw(axes, row["curves"][kind], row, strokes[row["method"]])
        set_title(axes, label)
    for axes in panels:
        for name, option in options.items():
            set_axis(axes, name, **option)
    drawn = {v: stroke.options() for v, stroke in strokes.items() if any(row["method"] == v for row in rows)}
    add_legend(figure, drawn)
    caption += " Of lines that coincide only the last is visible." * (len(drawn) > 2)
    return Figure(title, caption + _missing_scenes_note(result, list(scenes)), figure)


def _missing_scenes_note(result: Result, drawn: Sequence[str]) -> str:
    """Sentence with the scenes missing from a figure and the reasons; empty if none is missing."""
    absent = {row["scene"]: row.get("note") or "no answer" for row in deciding_rows(result)}
    reasons = [f"{scene} ({why})" for scene, why in absent.items() if scene not in drawn]
    return f" Not drawn: {', '.join(reasons)}." if reasons else ""


def _reliability(result: Result) -> Figure | None:
    """Observed frequency of errors below 10 % against the score, axes per variant."""
    curves: dict[str, list[Any]] = {}
    for row in deciding_rows(result):
        curve = (row.get("curves") or {}).get("reliability", {})
        if not row.get("role") and any(curve.get("weight") or []):
            curves.setdefault(row["method"], []).append(curve)
    if not curves:
        return None
    strokes = assign_strokes(variant_names(result))
    figure, panels = make_figure(len(curves))
    for axes, variant in zip(panels, (v for v in strokes if v in curves), strict=True):
        claimed, realised, weight = _pool_reliability(curves[variant])
        edges = np.linspace(0, 1, len(weight) + 1)
        axes.bar(edges[:-1] + 0.01, weight, np.diff(edges) - 0.02, align="edge", color=FAINT)
        draw_line(axes, [0.0, 1.0], [0.0, 1.0], Stroke(SOFT, 1.0, (4, 3)))
        axes.plot(claimed, realised, marker="o", **strokes[variant].options(), markersize=6.8)
        set_axis(axes, "x", "score as a probability, %", **_FRACTION)
        set_axis(axes, "y", "answers with error < 10 %, %", **_FRACTION)
        set_title(axes, variant)
    caption = "Fraction of answers within 10 % against the score, in ten bins; every scene without a role has the same "
    caption += (
        "weight. Bars: fraction of the answers in the bin. On the diagonal the score is a calibrated probability."
    )
    return Figure("Reliability", caption, figure)


def _pool_reliability(scenes: Sequence[Mapping[str, Any]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reliability bins over scenes of equal weight: claimed probability, realised frequency (NaN without), weight."""
    columns = {name: np.array([scene[name] for scene in scenes], float) for name in ("claimed", "realised", "weight")}
    claimed, realised, weights = map(np.nan_to_num, columns.values())
    weights = weights / weights.sum(1, keepdims=True) / len(scenes)
    pooled = weights.sum(0)
    with np.errstate(invalid="ignore"):
        return (weights * claimed).sum(0) / pooled, (weights * realised).sum(0) / pooled, pooled


def _overlays(result: Result) -> list[Figure]:
    """Source or gate of every sample at its pixel: a figure per variant, axes per scene; all but one are folded."""
    with_overlay = [row for row in scene_rows(result) if (row.get("overlay") or {}).get("u")]
    unique = {(row["method"], row["scene"]): row for row in with_overlay}  # the cohorts of a variant have the same
    order = [v for v in variant_names(result) if any(method == v for method, _ in unique)]
    order.sort(key=lambda v: (*_PREFERRED_VARIANTS, v).index(v))
    figures: list[Figure] = []
    for variant in order:
        rows = [row for (method, _), row in unique.items() if method == variant]
        aspect = max(row["overlay"]["hw"][0] / row["overlay"]["hw"][1] for row in rows)
        drawn, panels = make_figure(len(rows), (300, 20 + 300 * aspect))
        used: dict[str, Any] = {}
        for axes, row in zip(panels, rows, strict=True):
            layers = overlay_layers(row["overlay"])
            draw_points(axes, scene_label(row), row["overlay"]["hw"], layers)
            used |= {layer.label: mark_options(layer.colour, "o" if layer.is_answer else "x") for layer in layers}
        add_legend(drawn, used)
        caption = "Some samples of each scene's first pair, at their pixels in the reference view. The image itself is "
        caption += "not shown: the licences of many data sets do not allow it."
        caption += _missing_scenes_note(result, [row["scene"] for row in rows])
        title = f"Source or gate of the samples: {variant}"
        figures.append(Figure(title, caption, drawn, folded=bool(figures), is_raster=True))
    return figures


def overlay_layers(overlay: Mapping[str, Any]) -> list[PointLayer]:
    """Points of an archived overlay by gate and source, from bottom to top; samples without a pixel are left out."""
    uv = np.array([overlay["u"], overlay["v"]], float).T
    source, gate = np.array(overlay["source"], int), np.array(overlay["gate"], int)
    known = np.isfinite(uv).all(1)
    kinds = [
        (f"unanswered: {words(names(Gate)[code])}", (source == Source.NONE) & (gate == code), colour, False)
        for code, colour in GATE_COLOURS.items()
    ]
    kinds += [
        (words(names(Source)[code]), source == code, SOURCE_COLOURS[code], True)
        for code in (Source.SENSOR, Source.RECOVERED)
    ]
    return [PointLayer(k, uv[at & known], colour, dot) for k, at, colour, dot in kinds if (at & known).any()]
