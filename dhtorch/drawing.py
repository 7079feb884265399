"""Pictures: arrays → PNG; what a pair found → its pictures and its point cloud.

Arrays may be torch tensors or numpy arrays, on any device, of one pair (no batch dimension). matplotlib is imported
when first needed and only through its figure objects, so no global state, window or font setting is touched.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.codes import ROUTE_OF_HOLE, Gate, Hole, Route, Source, names, words
from dhtorch.evaluate import errors
from dhtorch.evaluate.risk import risk_coverage
from dhtorch.export import write_ply
from dhtorch.geometry.camera import unproject
from dhtorch.pair import merge

#: Colours that stay apart for the colour-blind (Okabe and Ito); what was silent is paler than what was answered.
SENSOR, RECOVERED, SILENT, INK = "#0072B2", "#E69F00", "#B4B4B4", "#333333"
GATE_COLOURS = {
    Gate.NO_TRACK: "#9A9A9A",
    Gate.NO_TEXTURE: "#5E5E5E",
    Gate.NO_POSE: "#000000",
    Gate.NO_BASELINE: "#4B0082",
    Gate.BEHIND: "#F0E442",
    Gate.PARALLAX: "#CC79A7",
    Gate.RESIDUAL: "#D55E00",
    Gate.INCONSISTENT: "#882255",
    Gate.UNCERTAIN: "#44AA99",
    Gate.LOW_SCORE: "#999933",
}
HOLE_COLOURS = {
    Hole.TRACKABLE_NO_LIDAR: "#E69F00",
    Hole.LOW_TEXTURE: "#5E5E5E",
    Hole.TOO_BRIGHT: "#F0E442",
    Hole.TOO_DARK: "#000000",
    Hole.HIGHLIGHT: "#CC79A7",
    Hole.AT_BORDER: "#009E73",
}
#: Fewest answers whose mean error is drawn.
FEWEST = 10
MARKERS: dict[str, dict[str, Any]] = {
    "sensor": {"marker": "o", "s": 6, "linewidth": 0},
    "silent": {"marker": "x", "s": 8, "linewidth": 0.8},
    "answer": {"marker": "o", "s": 14, "linewidth": 0.3, "edgecolor": "white"},
}
LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")


def draw_samples(
    path: str | Path,
    image: Any,  # (C, H, W) float in [0, 1] or uint8
    uv: Any,  # (N, 2) px
    source: Any,  # (N,) codes.Source of the merged map
    gate: Any,  # (N,) codes.Gate
    *,
    title: str = "",
) -> None:
    """Draw what became of every sample: a sensor return, a recovered depth, or the reason for silence."""
    source, gate = _array(source), _array(gate)
    layers = [
        (words(name), (source == Source.NONE) & (gate == code), GATE_COLOURS[code], "silent")
        for code, name in names(Gate).items()
        if code != Gate.ANSWER
    ]
    layers += [
        ("sensor", source == Source.SENSOR, SENSOR, "sensor"),
        ("recovered", source == Source.RECOVERED, RECOVERED, "answer"),
    ]
    _overlay(path, image, uv, layers, title or "What became of the samples")


def draw_holes(
    path: str | Path,
    image: Any,  # (C, H, W) float in [0, 1] or uint8
    uv: Any,  # (N, 2) px
    hole: Any,  # (N,) codes.Hole
    *,
    title: str = "",
) -> None:
    """Draw where the sensor is silent and why, with what could be done about it."""
    hole = _array(hole)
    routes = names(Route)
    layers = [("sensor", hole == Hole.NONE, SENSOR, "sensor")]
    for code, name in reversed(names(Hole).items()):
        if code != Hole.NONE:
            label = f"{words(name)} → {words(routes[ROUTE_OF_HOLE[code]])}"
            layers.append((label, hole == code, HOLE_COLOURS[code], "answer"))
    _overlay(path, image, uv, layers, title or "Why there is no return")


def draw_depth(
    path: str | Path,
    true_depth: Any,  # (P,) m
    depth: Any,  # (P,) m
    score: Any = None,  # (P,) in [0, 1]
    *,
    title: str = "",
) -> None:
    """Draw recovered against true depth on logarithmic axes, with the ±10 % band.

    NaN is silence and left out; answers beyond the axes are drawn on their edge and counted.
    """
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter  # noqa: PLC0415

    true, found = _array(true_depth).ravel(), _array(depth).ravel()
    good = np.isfinite(true) & np.isfinite(found) & (true > 0) & (found > 0)
    shade = np.full(true.shape, 1.0) if score is None else _array(score).ravel()
    true, found, shade = true[good], found[good], shade[good]
    figure, axes = panel(4.4, 4.4, title or "Recovered against true depth")
    low, high = (true.min() / 1.5, true.max() * 1.5) if len(true) else (1.0, 10.0)
    line = np.array([low, high])
    axes.fill_between(line, 0.9 * line, 1.1 * line, color=SILENT, alpha=0.35, linewidth=0, label="± 10 %")
    axes.plot(line, line, color=INK, linewidth=1, label="no error")
    order = np.argsort(shade, kind="stable")
    options = {"c": shade[order], "cmap": "viridis", "vmin": 0, "vmax": 1} if score is not None else {"color": SENSOR}
    dots = axes.scatter(
        true[order], found[order].clip(low, high), s=9, alpha=0.75, linewidth=0, clip_on=False, zorder=3, **options
    )
    if score is not None and len(true):
        figure.colorbar(dots, ax=axes, label="score", shrink=0.85, pad=0.02).outline.set_visible(False)
    axes.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high), xlabel="true depth, m")
    axes.set(ylabel="recovered depth, m", aspect="equal")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(10, subs=(1, 2, 3, 5, 7)))
        axis.set_major_formatter(ScalarFormatter())
        axis.set_minor_formatter(NullFormatter())
    if len(true):
        error = np.abs(found / true - 1)
        share, typical = 100 * (error < 0.1).mean(), 100 * np.median(error)
        said = f"{len(true)} answers\nmedian error {typical:.1f} %\nwithin 10 %: {share:.0f} %"
        outside = int(((found < low) | (found > high)).sum())
        said += f"\n{outside} beyond the axes" if outside else ""
        axes.text(0.04, 0.96, said, transform=axes.transAxes, va="top", linespacing=1.4)
    axes.legend(loc="lower right", frameon=False)
    save(figure, path)


def draw_risk_coverage(
    path: str | Path,
    curves: Mapping[str, tuple[Any, Any]],  # name → coverage (n,), risk (n,)
    *,
    oracle: tuple[Any, Any] | None = None,
    title: str = "",
) -> None:
    """Draw risk against coverage, as from :func:`dhtorch.evaluate.risk.risk_coverage`; the best order is dashed.

    A mean over fewer than ten answers is not drawn.
    """
    figure, axes = panel(4.8, 3.4, title or "Error of the surest answers")
    for percent in (5, 10):
        axes.axhline(percent, color=SILENT, linewidth=0.8, zorder=0)
    top, right = 12.0, 10.0
    for k, (name, (coverage, risk)) in enumerate(curves.items()):
        x, y = 100 * _array(coverage)[FEWEST - 1 :], 100 * _array(risk)[FEWEST - 1 :]
        if len(x):
            axes.plot(
                x, y, color=LINES[k % len(LINES)], linewidth=1.8, label=name, marker="o", markevery=[-1], markersize=4
            )
            top, right = max(top, 1.08 * y.max()), max(right, x[-1])
    if oracle is not None:
        axes.plot(100 * _array(oracle[0]), 100 * _array(oracle[1]), "--", color=INK, linewidth=1, label="best order")
    axes.set(xlim=(0, min(100, 1.04 * right)), ylim=(0, min(100, top)))
    axes.set(xlabel="answered share of the candidates, %", ylabel="mean relative error (at most 1), %")
    legend(axes, *axes.get_legend_handles_labels())
    save(figure, path)


def draw_example(folder: str | Path, example: Any) -> list[Path]:
    """Figures and the point cloud of one pair; returns the files written.

    Args:
        folder: made if need be.
        example: a :class:`dhtorch.studies.protocol.Example`.
    """
    e, folder = example.cpu(), Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    whole, image, uv = merge(e.samples, e.estimate), e.frame.image[0], e.samples.uv[0]
    draw_samples(folder / "samples.png", image, uv, whole.source[0], e.estimate.gate[0])
    draw_holes(folder / "holes.png", image, uv, e.samples.hole[0])
    written = ["samples.png", "holes.png", "points.ply"]
    pooled = errors.select(e.estimate, e.truth)
    if pooled.keep.any():
        draw_depth(folder / "depth.png", pooled.true_depth, pooled.depth, pooled.score)
        curves, oracle = {e.method: risk_coverage(pooled)}, risk_coverage(pooled, oracle=True)
        draw_risk_coverage(folder / "risk_coverage.png", curves, oracle=oracle)
        written += ["depth.png", "risk_coverage.png"]
    filled = whole.source[0] != Source.NONE
    xyz = unproject(e.frame.camera, whole.uv, whole.depth)[0][filled]
    columns = {name: getattr(whole, name)[0][filled] for name in ("sigma", "score")}
    columns |= {"hole": e.samples.hole[0][filled], "source": whole.source[0][filled]}
    write_ply(folder / "points.ply", xyz, source_colours(columns["source"]), **columns)
    return [folder / name for name in written]


def source_colours(source: Any) -> np.ndarray:
    """Colours (P, 3) uint8 of points by codes.Source: sensor blue, recovered orange."""
    sensed = _array(source)[:, None] == Source.SENSOR
    return np.where(sensed, _rgb(SENSOR), _rgb(RECOVERED)).astype(np.uint8)


def _array(x: Any) -> np.ndarray:
    return x.detach().cpu().numpy() if hasattr(x, "detach") else np.asarray(x)


def _rgb(colour: str) -> np.ndarray:
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)])


def _grey(image: Any) -> np.ndarray:
    """Picture (H, W) in [0, 1] to draw on: colourless and of little contrast, so that what is drawn stands out."""
    pixels = _array(image)
    pixels = pixels / 255.0 if pixels.dtype == np.uint8 else pixels
    return 0.45 + 0.5 * np.clip(pixels.mean(0), 0, 1)


def panel(width: float, height: float, title: str) -> tuple[Any, Any]:
    """A figure whose axes measure width × height inches; labels and legend lie around them and are not cut off."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure((width, height), dpi=160)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(title, loc="left", fontsize=11)
    return figure, axes


def _overlay(
    path: str | Path, image: Any, uv: Any, layers: Sequence[tuple[str, np.ndarray, str, str]], title: str
) -> None:
    """Draw groups of pixels (label, mask, colour, marker) over a picture, with their counts in a legend beside it."""
    grey, uv = _grey(image), _array(uv)
    H, W = grey.shape
    figure, axes = panel(7.2, 7.2 * H / W, title)
    axes.imshow(grey, cmap="gray", vmin=0, vmax=1, interpolation="antialiased")
    for label, mask, colour, marker in layers:
        if mask.any():
            axes.scatter(*uv[mask].T, c=colour, label=f"{label}  {int(mask.sum())}", **MARKERS[marker])
    axes.set(xlim=(-0.5, W - 0.5), ylim=(H - 0.5, -0.5))
    axes.set_axis_off()
    handles, labels = axes.get_legend_handles_labels()
    legend(axes, handles[::-1], labels[::-1], markerscale=1.8)
    save(figure, path)


def legend(axes: Any, handles: Sequence[Any], labels: Sequence[str], **options: Any) -> None:
    """A legend beside the axes, where it covers nothing."""
    if handles:
        axes.legend(handles, labels, loc="upper left", bbox_to_anchor=(1.0, 1.01), frameon=False, fontsize=9, **options)


def save(figure: Any, path: str | Path) -> None:
    """Write a figure with what lies around its axes."""
    figure.savefig(path, bbox_inches="tight", pad_inches=0.1)
