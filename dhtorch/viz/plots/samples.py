"""Figures of a pair's samples, depth errors and risk-coverage curves: arrays → PNG.

Arrays may be torch tensors or numpy arrays, on any device, of one pair (no batch dimension).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dhtorch.codes import ROUTE_OF_HOLE, Gate, Hole, Route, Source, names, words
from dhtorch.runtime.console import format_count
from dhtorch.viz.plots import colours
from dhtorch.viz.plots.colours import GATE_COLOURS, HOLE_COLOURS, INK, RECOVERED, SENSOR, Stroke, assign_strokes
from dhtorch.viz.plots.figures import (
    draw_line,
    make_figure,
    prefix_title,
    save_figure,
    set_axis,
    set_title,
    to_plain_line,
)
from dhtorch.viz.plots.maps import as_array, to_unit_rgb

#: Smallest number of answers whose mean error is drawn.
MIN_CURVE_ANSWERS = 10


class PointLayer(NamedTuple):
    """Points of one kind on an image."""

    label: str
    uv: np.ndarray  # (P, 2) px
    colour: str
    is_answer: bool  # a dot rather than a cross


def draw_points(axes: Any, title: str, hw: Sequence[float], layers: Sequence[PointLayer], image: Any = None) -> None:
    """Draw layers of points over a pale grey image, or over an empty background."""
    grey = np.full((1, 1), 0.93) if image is None else 0.45 + 0.5 * np.mean(np.atleast_3d(to_unit_rgb(image)), -1)
    extent = (-0.5, hw[1] - 0.5, hw[0] - 0.5, -0.5)
    axes.imshow(grey, cmap=colours.GREY_CMAP, vmin=0, vmax=1, extent=extent)
    for layer in layers:
        edge = {"edgecolors": colours.WHITE, "linewidths": 0.3} if layer.is_answer else {"linewidths": 0.8}
        marker, label = "o" if layer.is_answer else "x", f"{layer.label}  {len(layer.uv)}"
        axes.scatter(*layer.uv.T, s=9 if layer.is_answer else 6, color=layer.colour, marker=marker, label=label, **edge)
    axes.axis("off")
    set_title(axes, title, 520.0)


def draw_samples(
    path: str | Path,
    image: Any,  # (C, H, W) float in [0, 1] or uint8
    uv: Any,  # (N, 2) px
    source: Any,  # (N,) codes.Source of the merged map
    gate: Any,  # (N,) codes.Gate
    *,
    title: str = "",
) -> None:
    """Draw the outcome of every sample: sensor return, recovered depth, or the gate that rejected it."""
    source, gate = as_array(source), as_array(gate)
    layers = [
        (words(name), (source == Source.NONE) & (gate == code), GATE_COLOURS[code], False)
        for code, name in names(Gate).items()
        if code != Gate.ANSWER
    ]
    layers += [
        ("sensor", source == Source.SENSOR, SENSOR, True),
        ("recovered", source == Source.RECOVERED, RECOVERED, True),
    ]
    _save_layers(path, image, uv, layers, prefix_title("Outcome of the samples", title))


def draw_holes(
    path: str | Path,
    image: Any,  # (C, H, W) float in [0, 1] or uint8
    uv: Any,  # (N, 2) px
    hole: Any,  # (N,) codes.Hole
    *,
    title: str = "",
) -> None:
    """Draw the samples without a sensor return, by cause (codes.Hole) and remedy (codes.Route)."""
    hole, routes = as_array(hole), names(Route)
    layers = [("sensor", hole == Hole.NONE, SENSOR, True)]
    layers += [
        (f"{words(name)} → {words(routes[ROUTE_OF_HOLE[code]])}", hole == code, HOLE_COLOURS[code], True)
        for code, name in reversed(names(Hole).items())
        if code != Hole.NONE
    ]
    _save_layers(path, image, uv, layers, prefix_title("Causes of missing returns", title))


def _save_layers(
    path: str | Path, image: Any, uv: Any, layers: Sequence[tuple[str, np.ndarray, str, bool]], title: str
) -> None:
    """Draw groups of pixels (label, mask, colour, whether a dot) over an image, with their counts in the legend."""
    uv, hw = as_array(uv), tuple(image.shape[-2:])
    shown = [PointLayer(label, uv[mask], colour, is_answer) for label, mask, colour, is_answer in layers if mask.any()]
    figure, (axes,) = make_figure(size=(520, 520 * hw[0] / hw[1] + 20))
    draw_points(axes, title, hw, shown, image)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=9, labelcolor=INK, reverse=True)
    save_figure(figure, path)


def draw_depth(
    path: str | Path,
    true_depth: Any,  # (P,) m
    depth: Any,  # (P,) m
    score: Any = None,  # (P,) in [0, 1]
    *,
    title: str = "",
) -> None:
    """Draw recovered against true depth on logarithmic axes, with the ±10 % band, the highest scores on top.

    NaN (no answer) is skipped; answers beyond the axes are drawn on their edge and counted.
    """
    true, recovered = as_array(true_depth).ravel(), as_array(depth).ravel()
    valid = np.isfinite(true) & np.isfinite(recovered) & (true > 0) & (recovered > 0)
    scores = np.zeros(valid.sum()) if score is None else as_array(score).ravel()[valid]
    order = np.argsort(scores, kind="stable")
    true, recovered, scores = true[valid][order], recovered[valid][order], scores[order]
    low, high = (float(true.min() / 1.5), float(true.max() * 1.5)) if len(true) else (1.0, 10.0)
    figure, (axes,) = make_figure(size=(440, 400))
    ends = np.array([low, high])
    axes.fill_between(ends, 0.9 * ends, 1.1 * ends, color=colours.FAINT, label="± 10 %")
    axes.plot(ends, ends, color=INK, linewidth=1, label="no error")
    coloured = {"color": SENSOR} if score is None else {"c": scores, "cmap": colours.SCORE_CMAP, "vmin": 0, "vmax": 1}
    dots = axes.scatter(true, recovered.clip(low, high), s=9, alpha=0.75, linewidth=0, clip_on=False, **coloured)
    if score is not None and len(true):
        figure.colorbar(dots, label="score", shrink=0.6).outline.set_visible(False)
    if len(true):
        error = np.abs(recovered / true - 1)
        lines = [format_count(len(true), "answer"), f"median error {100 * np.median(error):.1f} %"]
        lines.append(f"within 10 %: {100 * (error < 0.1).mean():.0f} %")
        outside = int(((recovered < low) | (recovered > high)).sum())
        text = "\n".join([*lines, *([f"{outside} beyond the axes"] if outside else [])])
        axes.text(0.03, 0.97, text, va="top", color=colours.SOFT, transform=axes.transAxes)
    for name, kind in (("x", "true"), ("y", "recovered")):
        set_axis(axes, name, f"{kind} depth, m", log=True, limits=(low, high))
    set_title(axes, prefix_title("Recovered against true", title))
    axes.legend(loc="lower right", frameon=False, fontsize=9, labelcolor=INK)
    save_figure(figure, path)


def draw_risk_coverage(
    path: str | Path,
    curves: Mapping[str, tuple[Any, Any]],  # name → coverage (n,), risk (n,)
    *,
    oracle: tuple[Any, Any] | None = None,
    title: str = "",
) -> None:
    """Draw risk against coverage, as from :func:`dhtorch.metrics.risk.risk_coverage`; the ideal order is dashed.

    Means over fewer than ten answers are not drawn.
    """
    figure, (axes,) = make_figure(size=(440, 300))
    for level in (0.05, 0.1):
        axes.axhline(level, color=colours.UNANSWERED, linewidth=0.8)
    if oracle is not None:
        draw_line(axes, as_array(oracle[0]), as_array(oracle[1]), Stroke(INK, 1, (4, 3)), label="ideal order")
    for name, stroke in assign_strokes(curves).items():
        coverage, risk = (as_array(values)[MIN_CURVE_ANSWERS - 1 :] for values in curves[name])
        if len(coverage):
            draw_line(axes, coverage, risk, stroke, label=to_plain_line(name))
            axes.plot(coverage[-1], risk[-1], "o", color=stroke.colour, markersize=5)
    labels = {"x": "answered fraction of the candidates, %", "y": "mean relative error (at most 1), %"}
    for axis, label in labels.items():
        high = getattr(axes, f"get_{axis}lim")()[1]
        set_axis(axes, axis, label, percent=True, limits=(0.0, min(1.0, max(high, 0.12))))
    set_title(axes, prefix_title("Risk against coverage", title))
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=9, labelcolor=INK)
    save_figure(figure, path)
