"""Figures of a completed or aligned view: image, input depth, resulting depth, sigma / depth.

Arrays may be torch tensors or numpy arrays, on any device, of one view (no batch dimension).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from dhtorch.codes import Source, count_kinds, names
from dhtorch.viz.plots import colours
from dhtorch.viz.plots.axis import Axis
from dhtorch.viz.plots.canvas import TEXT_SIZE_PT, Canvas, save_figure
from dhtorch.viz.plots.colours import INK, Stroke

#: Width of an image, points.
PICTURE_WIDTH_PT = 340.0
#: Gap between two images, points.
PICTURE_GAP_PT = 12.0
#: Height of the title of an image, points.
TITLE_HEIGHT_PT = 20.0
#: Height of a colour scale with its numbers, points.
SCALE_HEIGHT_PT = 46.0
#: Height of the title above all images, points.
HEADER_HEIGHT_PT = 22.0
#: Pixels per inch of a figure.
_FIGURE_DPI = 160.0
#: Quantile of depth at the lower end of the scale.
_LOW_DEPTH_QUANTILE = 0.01
#: Quantile of depth at the upper end of the scale.
_HIGH_DEPTH_QUANTILE = 0.99
#: Range of the scale of sigma / depth.
_SIGMA_REL_RANGE = (0.005, 0.2)
#: Ratio of the ends of a scale above which ticks are placed by decades.
_MIN_DECADE_RATIO = 8.0


def draw_completed(
    path: str | Path | IO[bytes],
    image: Any,  # (C, h, w) or (C, H, W) uint8, or float in [0, 1]
    depth: Any,  # (h, w) m, 0 or NaN without an answer
    sigma: Any,  # (h, w) m
    source: Any,  # (h, w) codes.Source
    *,
    title: str = "",
    dpi: float = _FIGURE_DPI,
    kind: str = "png",
) -> None:
    """Draw image, sensor depth, completed depth on the same scale, and its sigma / depth.

    ``kind`` is the format where ``path`` is an open file.

    Log depth, near blue, far red; the nearest and farthest 1 % of the depths have the end colours. Pixels without an
    answer are blank.
    """
    z, s, code = (as_array(x) for x in (depth, sigma, source))
    answered = np.isfinite(z) & (z > 0) & (code != Source.NONE)
    sensed = answered & (code == Source.SENSOR)
    depth_axis = fit_depth_axis(z[answered])
    sensor_panel = (
        f"Sensor: {_format_percent(sensed)} of the pixels",
        apply_log_cmap(z, sensed, depth_axis, colours.DEPTH_CMAP),
    )
    completed_panel = (
        f"Completed: {format_kinds(code, answered)}",
        apply_log_cmap(z, answered, depth_axis, colours.DEPTH_CMAP),
    )
    panels = (("Picture", to_unit_rgb(image)), sensor_panel, completed_panel)
    figure = _draw_four_panels(title, panels, (z, s, answered), dpi)
    save_figure(figure, path, kind)


def draw_aligned(
    path: str | Path | IO[bytes],
    image: Any,  # (C, h, w) or (C, H, W) uint8, or float in [0, 1]
    input_map: Any,  # (1, h, w) or (h, w), any unit, 0 or NaN without a value
    depth: Any,  # (h, w) m, 0 or NaN without an answer
    sigma: Any,  # (h, w) m
    *,
    title: str = "",
) -> None:
    """Draw image, input map, aligned map, and its sigma / depth; both maps on log scales over their own ranges."""
    x, z, s = (as_array(q) for q in (input_map, depth, sigma))
    x = x.reshape(x.shape[-2:])
    has_value, answered = np.isfinite(x) & (x > 0), np.isfinite(z) & (z > 0)
    input_panel = (
        f"Input map: {_format_percent(has_value)}, own range",
        apply_log_cmap(x, has_value, fit_depth_axis(x[has_value]), colours.DEPTH_CMAP),
    )
    aligned_panel = (
        f"Aligned: {_format_percent(answered)}, the rest no answer",
        apply_log_cmap(z, answered, fit_depth_axis(z[answered]), colours.DEPTH_CMAP),
    )
    panels = (("Picture", to_unit_rgb(image)), input_panel, aligned_panel)
    save_figure(_draw_four_panels(title, panels, (z, s, answered), _FIGURE_DPI), path)


def _draw_four_panels(
    title: str,
    panels: Sequence[tuple[str, np.ndarray]],
    result: tuple[np.ndarray, np.ndarray, np.ndarray],
    dpi: float,
) -> Any:
    """Figure of three images, then sigma / depth of ``result`` (depth, sigma, mask), with both scales and the title."""
    z, s, answered = result
    depth_axis, sigma_axis = fit_depth_axis(z[answered]), fit_sigma_axis()
    ratio = np.where(answered, s / np.where(answered, z, 1), 1)
    height = PICTURE_WIDTH_PT * z.shape[0] / z.shape[1]
    top = 2 * (height + TITLE_HEIGHT_PT) + SCALE_HEIGHT_PT
    canvas = Canvas(2 * PICTURE_WIDTH_PT + PICTURE_GAP_PT, top + HEADER_HEIGHT_PT * bool(title), dpi)
    canvas.title(title, 2 * PICTURE_WIDTH_PT + PICTURE_GAP_PT, top + HEADER_HEIGHT_PT)
    for k, (words, pixels) in enumerate(
        (*panels, ("Sigma / depth", apply_log_cmap(ratio, answered, sigma_axis, colours.ERROR_CMAP)))
    ):
        left, bottom = (
            (k % 2) * (PICTURE_WIDTH_PT + PICTURE_GAP_PT),
            SCALE_HEIGHT_PT + (k < 2) * (height + TITLE_HEIGHT_PT),
        )
        canvas.title(words, PICTURE_WIDTH_PT, bottom + height + TITLE_HEIGHT_PT, left)
        canvas.picture(pixels, (left, bottom, PICTURE_WIDTH_PT, height))
    draw_scale(canvas, depth_axis, colours.DEPTH_CMAP, 0.0)
    draw_scale(canvas, sigma_axis, colours.ERROR_CMAP, PICTURE_WIDTH_PT + PICTURE_GAP_PT)
    return canvas.figure


def fit_depth_axis(depth: np.ndarray) -> Axis:
    """Depths -> log axis between their 1 % and 99 % quantiles."""
    low, high = np.quantile(depth, (_LOW_DEPTH_QUANTILE, _HIGH_DEPTH_QUANTILE)).tolist() if depth.size else (0.5, 5.0)
    high = max(high, 1.25 * low)
    return Axis(low, high, "depth, m", log=True)


def fit_sigma_axis() -> Axis:
    """The log axis of sigma / depth, the same in every figure."""
    return Axis(*_SIGMA_REL_RANGE, "sigma / depth, %", log=True, percent=True)


def apply_log_cmap(values: np.ndarray, there: np.ndarray, axis: Axis, kind: str) -> np.ndarray:
    """Values (h, w) -> colours (h, w, 3) in [0, 1] on a log axis; background colour where ``there`` is False."""
    low, high = math.log(axis.low), math.log(axis.high)
    places = (np.log(np.where(there, values, axis.low).clip(1e-9)) - low) / (high - low)
    background = np.array(colours.parse_rgb(colours.PICTURE)) / 255
    return np.where(there[..., None], apply_cmap(places.clip(0, 1), kind), background)


def apply_cmap(places: np.ndarray, kind: str) -> np.ndarray:
    """Positions in [0, 1] -> colours (…, 3)."""
    from matplotlib import colormaps  # noqa: PLC0415

    return colormaps[kind](places)[..., :3]


def draw_scale(canvas: Canvas, axis: Axis, kind: str, left: float, width: float = PICTURE_WIDTH_PT) -> None:
    """Draw a colour scale with ticks and label below an image."""
    base, height = SCALE_HEIGHT_PT - 18.0, 9.0
    canvas.picture(apply_cmap(np.linspace(0, 1, 256)[None].repeat(2, 0), kind), (left, base, width, height))
    decades = axis.log and axis.high > _MIN_DECADE_RATIO * axis.low
    ticks = axis.ticks(8) if decades else Axis(axis.low, axis.high).ticks(8)
    for tick in ticks:
        u = left + width * axis.place(tick)
        canvas.lines([((u, base), (u, base - 3))], Stroke(INK, 0.7))
        canvas.text(
            axis.write(tick),
            min(max(u, left + 6), left + width - 6),
            base - 13,
            size=TEXT_SIZE_PT - 1,
            ha="center",
        )
    canvas.text(axis.label, left + width / 2, 1, ha="center")


def format_kinds(source: Any, answered: np.ndarray) -> str:
    """Fractions of the pixels by kind as text, recovered first; ``answered`` (h, w): those with a depth."""
    code = np.where(answered, as_array(source), Source.NONE).astype(np.int64)
    counts = count_kinds(np.bincount(code.ravel(), minlength=len(names(Source))))
    return ", ".join(f"{kind} {100 * n / code.size:.0f} %" for kind, n in counts.items() if kind != "no_answer")


def _format_percent(mask: np.ndarray) -> str:
    return f"{100 * mask.mean():.0f} %"


def to_unit_rgb(image: Any) -> np.ndarray:
    """Image (C, H, W) -> (H, W) or (H, W, 3) in [0, 1]."""
    pixels = as_array(image)
    pixels = pixels / 255.0 if pixels.dtype == np.uint8 else pixels
    pixels = np.clip(pixels, 0, 1)
    return pixels[0] if len(pixels) == 1 else pixels.transpose(1, 2, 0)


def as_array(x: Any) -> np.ndarray:
    """Tensor or array -> numpy array."""
    return x.detach().cpu().numpy() if hasattr(x, "detach") else np.asarray(x)
