"""A completed view: the picture, what the sensor says of it, what is known of it now, and how well.

Arrays may be torch tensors or numpy arrays, on any device, of one view (no batch dimension).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from dhtorch.codes import Source
from dhtorch.viz.plots import colours
from dhtorch.viz.plots.axis import Axis
from dhtorch.viz.plots.canvas import TEXT_SIZE_PT, Canvas, save_figure
from dhtorch.viz.plots.colours import INK, Stroke

#: Width of a picture, between two of them, and the heights of a title and of a scale with its numbers, points.
PICTURE_WIDTH_PT, PICTURE_GAP_PT, TITLE_HEIGHT_PT, SCALE_HEIGHT_PT = 340.0, 12.0, 20.0, 46.0
#: Height of the title above all pictures, points.
HEADER_HEIGHT_PT = 22.0
#: Shares of the depths that the scale leaves out at its ends.
_LOW_DEPTH_QUANTILE, _HIGH_DEPTH_QUANTILE = 0.01, 0.99
#: Scale of sigma / depth.
_SIGMA_REL_RANGE = (0.005, 0.2)
#: From this ratio of its ends on, round numbers on a scale are those of decades.
_MIN_DECADE_RATIO = 8.0


def draw_completed(
    path: str | Path | IO[bytes],
    image: Any,  # (C, h, w) or (C, H, W) uint8, or float in [0, 1]
    depth: Any,  # (h, w) m, 0 or NaN where nothing is known
    sigma: Any,  # (h, w) m
    source: Any,  # (h, w) codes.Source
    *,
    title: str = "",
) -> None:
    """Draw the picture, the sensor's depth, the completed one on the same scale, and its sigma / depth.

    Depth is drawn by its logarithm, the nearest blue, the farthest red; what lies beyond the ends of a scale, of the
    depths a hundredth on each side, has the colour of that end. Silence is left blank.
    """
    z, s, code = (as_array(x) for x in (depth, sigma, source))
    known = np.isfinite(z) & (z > 0) & (code != Source.NONE)
    sensed = known & (code == Source.SENSOR)
    metres = fit_depth_axis(z[known])
    before = f"Sensor: {_format_percent(sensed)} of the pixels", apply_log_cmap(z, sensed, metres, colours.DEPTH_CMAP)
    after = (
        f"Completed: {_format_percent(known)}, the rest is silent",
        apply_log_cmap(z, known, metres, colours.DEPTH_CMAP),
    )
    _draw_four_panels(path, title, (("Picture", to_unit_rgb(image)), before, after), (z, s, known))


def draw_aligned(
    path: str | Path | IO[bytes],
    image: Any,  # (C, h, w) or (C, H, W) uint8, or float in [0, 1]
    given: Any,  # (1, h, w) or (h, w), in any unit, 0 or NaN where it has no value
    depth: Any,  # (h, w) m, 0 or NaN where nothing is known
    sigma: Any,  # (h, w) m
    *,
    title: str = "",
) -> None:
    """Draw the picture, a map as it was given, the anchored one, and its sigma / depth; the two maps by the logarithm
    of their values, each over its own range."""
    x, z, s = (as_array(q) for q in (given, depth, sigma))
    x = x.reshape(x.shape[-2:])
    there, known = np.isfinite(x) & (x > 0), np.isfinite(z) & (z > 0)
    before = (
        f"Map as given: {_format_percent(there)}, own range",
        apply_log_cmap(x, there, fit_depth_axis(x[there]), colours.DEPTH_CMAP),
    )
    after = (
        f"Anchored: {_format_percent(known)}, the rest is silent",
        apply_log_cmap(z, known, fit_depth_axis(z[known]), colours.DEPTH_CMAP),
    )
    _draw_four_panels(path, title, (("Picture", to_unit_rgb(image)), before, after), (z, s, known))


def _draw_four_panels(
    path: str | Path | IO[bytes],
    title: str,
    shown: Sequence[tuple[str, np.ndarray]],
    found: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Three pictures and sigma / depth of the depth, sigma and mask ``found``, with the scales of both below them
    and the title above."""
    z, s, known = found
    metres, share = fit_depth_axis(z[known]), Axis(*_SIGMA_REL_RANGE, "sigma / depth, %", log=True, percent=True)
    ratio = np.where(known, s / np.where(known, z, 1), 1)
    height = PICTURE_WIDTH_PT * z.shape[0] / z.shape[1]
    top = 2 * (height + TITLE_HEIGHT_PT) + SCALE_HEIGHT_PT
    canvas = Canvas(2 * PICTURE_WIDTH_PT + PICTURE_GAP_PT, top + HEADER_HEIGHT_PT * bool(title), dpi=160)
    canvas.title(title, 2 * PICTURE_WIDTH_PT + PICTURE_GAP_PT, top + HEADER_HEIGHT_PT)
    for k, (words, pixels) in enumerate(
        (*shown, ("Sigma / depth", apply_log_cmap(ratio, known, share, colours.ERROR_CMAP)))
    ):
        left, bottom = (
            (k % 2) * (PICTURE_WIDTH_PT + PICTURE_GAP_PT),
            SCALE_HEIGHT_PT + (k < 2) * (height + TITLE_HEIGHT_PT),
        )
        canvas.title(words, PICTURE_WIDTH_PT, bottom + height + TITLE_HEIGHT_PT, left)
        canvas.picture(pixels, (left, bottom, PICTURE_WIDTH_PT, height))
    draw_scale(canvas, metres, colours.DEPTH_CMAP, 0.0)
    draw_scale(canvas, share, colours.ERROR_CMAP, PICTURE_WIDTH_PT + PICTURE_GAP_PT)
    save_figure(canvas.figure, path)


def fit_depth_axis(depth: np.ndarray) -> Axis:
    """The scale of all depths."""
    low, high = np.quantile(depth, (_LOW_DEPTH_QUANTILE, _HIGH_DEPTH_QUANTILE)).tolist() if depth.size else (0.5, 5.0)
    high = max(high, 1.25 * low)
    return Axis(low, high, "depth, m", log=True)


def apply_log_cmap(values: np.ndarray, there: np.ndarray, axis: Axis, kind: str) -> np.ndarray:
    """(h, w, 3) in [0, 1]: values by a colour map along a logarithmic axis, the ground where there is none."""
    low, high = math.log(axis.low), math.log(axis.high)
    places = (np.log(np.where(there, values, axis.low).clip(1e-9)) - low) / (high - low)
    ground = np.array(colours.parse_rgb(colours.PICTURE)) / 255
    return np.where(there[..., None], apply_cmap(places.clip(0, 1), kind), ground)


def apply_cmap(places: np.ndarray, kind: str) -> np.ndarray:
    """Colours (…, 3) of places in [0, 1]."""
    from matplotlib import colormaps  # noqa: PLC0415

    return colormaps[kind](places)[..., :3]


def draw_scale(canvas: Canvas, axis: Axis, kind: str, left: float) -> None:
    """A colour map from end to end under a picture, with round numbers and what they mean."""
    base, height = SCALE_HEIGHT_PT - 18.0, 9.0
    canvas.picture(apply_cmap(np.linspace(0, 1, 256)[None].repeat(2, 0), kind), (left, base, PICTURE_WIDTH_PT, height))
    decades = axis.log and axis.high > _MIN_DECADE_RATIO * axis.low
    ticks = axis.ticks(8) if decades else Axis(axis.low, axis.high).ticks(8)
    for tick in ticks:
        u = left + PICTURE_WIDTH_PT * axis.place(tick)
        canvas.lines([((u, base), (u, base - 3))], Stroke(INK, 0.7))
        canvas.text(
            axis.write(tick),
            min(max(u, left + 6), left + PICTURE_WIDTH_PT - 6),
            base - 13,
            size=TEXT_SIZE_PT - 1,
            ha="center",
        )
    canvas.text(axis.label, left + PICTURE_WIDTH_PT / 2, 1, ha="center")


def _format_percent(mask: np.ndarray) -> str:
    return f"{100 * mask.mean():.0f} %"


def to_unit_rgb(image: Any) -> np.ndarray:
    """(H, W) or (H, W, 3) in [0, 1]."""
    pixels = as_array(image)
    pixels = pixels / 255.0 if pixels.dtype == np.uint8 else pixels
    pixels = np.clip(pixels, 0, 1)
    return pixels[0] if len(pixels) == 1 else pixels.transpose(1, 2, 0)


def as_array(x: Any) -> np.ndarray:
    """A tensor of any device, or an array, as an array."""
    return x.detach().cpu().numpy() if hasattr(x, "detach") else np.asarray(x)
