"""Figures of a pair's samples, depth errors and risk-coverage curves: arrays → PNG.

Arrays may be torch tensors or numpy arrays, on any device, of one pair (no batch dimension).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dhtorch.codes import ROUTE_OF_HOLE, Gate, Hole, Route, Source, names, words
from dhtorch.runtime.console import format_count
from dhtorch.viz.plots import colours
from dhtorch.viz.plots.axis import Axis, fit_axis
from dhtorch.viz.plots.canvas import Canvas, LegendKey, prefix_title, save_figure
from dhtorch.viz.plots.colours import FAINT, GATE_COLOURS, HOLE_COLOURS, INK, RECOVERED, SENSOR, Stroke, assign_strokes
from dhtorch.viz.plots.panel import Panel

#: Smallest number of answers whose mean error is drawn.
MIN_CURVE_ANSWERS = 10
#: Mark of a layer → shape, diameter (points), width of its white edge (points).
_LAYER_MARKS = {"sensor": ("dot", 2.8, 0.0), "unanswered": ("cross", 2.8, 0.0), "answer": ("dot", 3.8, 0.6)}


class PointLayer(NamedTuple):
    """Points of one kind on an image."""

    label: str
    uv: np.ndarray  # (P, 2) px
    colour: str
    mark: str  # key of _LAYER_MARKS


class LayeredPicture:
    """Layers of points over an image, or over an empty background."""

    def __init__(
        self, title: str, hw: Sequence[float], layers: Sequence[PointLayer], image: Any = None, *, width: float
    ):
        self.title = self.words = title
        self.hw, self.layers, self.image = (float(hw[0]), float(hw[1])), list(layers), image
        self.width, self.inner = width, width * self.hw[0] / self.hw[1]
        self.height = self.inner + 20  # with the title above

    def figure(self, *, dpi: float = 160) -> Any:
        """matplotlib ``Figure`` with title, and a legend with the number of points."""
        canvas = Canvas(self.width, self.height, dpi)
        self.draw(canvas)
        shapes = {layer.label: _LAYER_MARKS[layer.mark][0] for layer in self.layers}
        keys = [LegendKey(f"{x.label}  {len(x.uv)}", x.colour, shapes[x.label]) for x in reversed(self.layers)]
        return canvas.finished(keys)

    def draw(self, canvas: Canvas) -> None:
        """Draw title, image and points."""
        canvas.title(self.title, self.width, self.height)
        w, h = self.width, self.inner
        if self.image is None:
            canvas.area(((0, 0), (w, 0), (w, h), (0, h)), colours.PICTURE)
        else:
            canvas.picture(_to_pale_grey(self.image), (0, 0, w, h))
        for layer in self.layers:
            shape, size, edge = _LAYER_MARKS[layer.mark]
            places = [self._at(u, v) for u, v in layer.uv.tolist()]
            if shape == "cross":
                r = 0.5 * size
                ways = [((u - r, v - r), (u + r, v + r)) for u, v in places]
                ways += [((u - r, v + r), (u + r, v - r)) for u, v in places]
                canvas.lines(ways, Stroke(layer.colour, 0.8))
                continue
            if edge and self.image is not None:
                canvas.dots(places, Stroke(colours.WHITE, size + edge))
            canvas.dots(places, Stroke(layer.colour, size))

    def _at(self, u: float, v: float) -> tuple[float, float]:
        scale = self.width / self.hw[1]
        return (u + 0.5) * scale, self.inner - (v + 0.5) * scale


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
    source, gate = _to_array(source), _to_array(gate)
    layers = [
        (words(name), (source == Source.NONE) & (gate == code), GATE_COLOURS[code], "unanswered")
        for code, name in names(Gate).items()
        if code != Gate.ANSWER
    ]
    layers += [
        ("sensor", source == Source.SENSOR, SENSOR, "sensor"),
        ("recovered", source == Source.RECOVERED, RECOVERED, "answer"),
    ]
    _draw_layers(path, image, uv, layers, prefix_title("Outcome of the samples", title))


def draw_holes(
    path: str | Path,
    image: Any,  # (C, H, W) float in [0, 1] or uint8
    uv: Any,  # (N, 2) px
    hole: Any,  # (N,) codes.Hole
    *,
    title: str = "",
) -> None:
    """Draw the samples without a sensor return, by cause (codes.Hole) and remedy (codes.Route)."""
    hole = _to_array(hole)
    routes = names(Route)
    layers = [("sensor", hole == Hole.NONE, SENSOR, "sensor")]
    for code, name in reversed(names(Hole).items()):
        if code != Hole.NONE:
            label = f"{words(name)} → {words(routes[ROUTE_OF_HOLE[code]])}"
            layers.append((label, hole == code, HOLE_COLOURS[code], "answer"))
    _draw_layers(path, image, uv, layers, prefix_title("Causes of missing returns", title))


def draw_depth(
    path: str | Path,
    true_depth: Any,  # (P,) m
    depth: Any,  # (P,) m
    score: Any = None,  # (P,) in [0, 1]
    *,
    title: str = "",
) -> None:
    """Draw recovered against true depth on logarithmic axes, with the ±10 % band.

    NaN (no answer) is skipped; answers beyond the axes are drawn on their edge and counted.
    """
    true, recovered = _to_array(true_depth).ravel(), _to_array(depth).ravel()
    valid = np.isfinite(true) & np.isfinite(recovered) & (true > 0) & (recovered > 0)
    scores = None if score is None else _to_array(score).ravel()[valid]
    true, recovered = true[valid], recovered[valid]
    low, high = (true.min() / 1.5, true.max() * 1.5) if len(true) else (1.0, 10.0)
    x, y = (Axis(float(low), float(high), f"{kind} depth, m", log=True) for kind in ("true", "recovered"))
    panel = Panel(prefix_title("Recovered against true", title), x, y, size=(380, 386))
    corners = ((low, low / 0.9, high, high, high / 1.1, low), (low, low, 0.9 * high, high, high, 1.1 * low))
    panel.fill(*corners, FAINT)
    panel.line([low, high], [low, high], Stroke(INK, 1))
    keys = [LegendKey("± 10 %", FAINT, "box"), LegendKey("no error", INK, stroke=Stroke(INK, 1))]
    canvas = panel.canvas()
    _draw_scatter(canvas, panel, true, recovered, scores)
    for k, line in enumerate(_describe_errors(true, recovered, low, high) if len(true) else ()):
        canvas.text(line, panel.left + 10, panel.height - panel.top - 18 - 14 * k)
    save_figure(canvas.finished(keys), path)


def _draw_scatter(
    canvas: Canvas, panel: Panel, true: np.ndarray, recovered: np.ndarray, scores: np.ndarray | None
) -> None:
    """Draw answers as dots, the highest scores on top, with a colour bar of the scores."""
    order = np.arange(len(true)) if scores is None else np.argsort(scores, kind="stable")
    places = np.array([panel.at(x, y) for x, y in zip(true[order].tolist(), recovered[order].tolist(), strict=True)])
    axes = canvas.axes()
    options = (
        {"color": SENSOR} if scores is None else {"c": scores[order], "cmap": colours.SCORE_CMAP, "vmin": 0, "vmax": 1}
    )
    dots = axes.scatter(*places.reshape(-1, 2).T, s=9, alpha=0.75, linewidth=0, clip_on=False, **options)
    if scores is not None and len(true):
        bar_axes = canvas.figure.add_axes((1.04, 0.12, 0.025, 0.5))
        canvas.figure.colorbar(dots, cax=bar_axes, label="score").outline.set_visible(False)


def _describe_errors(true: np.ndarray, recovered: np.ndarray, low: float, high: float) -> list[str]:
    """Text lines: number of answers, median error, fraction within 10 %."""
    error = np.abs(recovered / true - 1)
    lines = [format_count(len(true), "answer"), f"median error {100 * np.median(error):.1f} %"]
    lines.append(f"within 10 %: {100 * (error < 0.1).mean():.0f} %")
    outside = int(((recovered < low) | (recovered > high)).sum())
    return [*lines, *([f"{outside} beyond the axes"] if outside else [])]


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
    strokes = assign_strokes(curves)
    drawn = {name: [_to_array(v)[MIN_CURVE_ANSWERS - 1 :].tolist() for v in curve] for name, curve in curves.items()}
    drawn = {name: curve for name, curve in drawn.items() if curve[0]}
    right = fit_axis([0.1, *(x for c, _ in drawn.values() for x in c)], "", low=0.0).high
    top = fit_axis([0.12, *(y for _, r in drawn.values() for y in r)], "", low=0.0).high
    x = Axis(0.0, min(1.0, right), "answered fraction of the candidates, %", percent=True)
    y = Axis(0.0, min(1.0, top), "mean relative error (at most 1), %", percent=True)
    panel = Panel(prefix_title("Risk against coverage", title), x, y, size=(400, 290))
    for level in (0.05, 0.1):
        panel.line([x.low, x.high], [level, level], Stroke(colours.UNANSWERED, 0.8))
    keys = [LegendKey(name, strokes[name].colour, stroke=strokes[name]) for name in drawn]
    if oracle is not None:
        ideal = Stroke(INK, 1, (4, 3))
        panel.line(_to_array(oracle[0]).tolist(), _to_array(oracle[1]).tolist(), ideal)
        keys.append(LegendKey("ideal order", INK, stroke=ideal))
    for name, (coverage, risk) in drawn.items():
        panel.line(coverage, risk, strokes[name])
        panel.dot(coverage[-1], risk[-1], strokes[name], width=5)
    save_figure(panel.figure(keys=keys), path)


def _draw_layers(
    path: str | Path, image: Any, uv: Any, layers: Sequence[tuple[str, np.ndarray, str, str]], title: str
) -> None:
    """Draw groups of pixels (label, mask, colour, mark) over an image, with their counts in the legend."""
    uv, hw = _to_array(uv), tuple(image.shape[-2:])
    shown = [PointLayer(label, uv[mask], colour, mark) for label, mask, colour, mark in layers if mask.any()]
    save_figure(LayeredPicture(title, hw, shown, image, width=520).figure(), path)


def _to_array(x: Any) -> np.ndarray:
    return x.detach().cpu().numpy() if hasattr(x, "detach") else np.asarray(x)


def _to_pale_grey(image: Any) -> np.ndarray:
    """Image -> (H, W) in [0, 1], grey and of low contrast, as a background for marks."""
    pixels = _to_array(image)
    pixels = pixels / 255.0 if pixels.dtype == np.uint8 else pixels
    return 0.45 + 0.5 * np.clip(pixels.mean(0), 0, 1)
