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
from dhtorch.viz.plots.canvas import SMALL, Canvas, save
from dhtorch.viz.plots.colours import INK, Stroke

#: Width of a picture, between two of them, and the heights of a title and of a scale with its numbers, points.
WIDTH, GAP, TITLE, SCALE = 340.0, 12.0, 20.0, 46.0
#: Height of the title above all pictures, points.
HEAD = 22.0
#: Shares of the depths that the scale leaves out at its ends.
NEAREST, FARTHEST = 0.01, 0.99
#: Scale of sigma / depth.
SIGMA_REL = (0.005, 0.2)
#: From this ratio of its ends on, round numbers on a scale are those of decades.
DECADES = 8.0


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
    metres = depths(z[known])
    before = f"Sensor: {_percent(sensed)} of the pixels", coloured(z, sensed, metres, colours.DEPTH)
    after = f"Completed: {_percent(known)}, the rest is silent", coloured(z, known, metres, colours.DEPTH)
    _draw(path, title, (("Picture", rgb_of(image)), before, after), (z, s, known))


def draw_anchored(
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
    before = f"Map as given: {_percent(there)}, own range", coloured(x, there, depths(x[there]), colours.DEPTH)
    after = f"Anchored: {_percent(known)}, the rest is silent", coloured(z, known, depths(z[known]), colours.DEPTH)
    _draw(path, title, (("Picture", rgb_of(image)), before, after), (z, s, known))


def _draw(
    path: str | Path | IO[bytes],
    title: str,
    shown: Sequence[tuple[str, np.ndarray]],
    found: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Three pictures and sigma / depth of the depth, sigma and mask ``found``, with the scales of both below them
    and the title above."""
    z, s, known = found
    metres, share = depths(z[known]), Axis(*SIGMA_REL, "sigma / depth, %", log=True, percent=True)
    ratio = np.where(known, s / np.where(known, z, 1), 1)
    height = WIDTH * z.shape[0] / z.shape[1]
    top = 2 * (height + TITLE) + SCALE
    canvas = Canvas(2 * WIDTH + GAP, top + HEAD * bool(title), dpi=160)
    canvas.title(title, 2 * WIDTH + GAP, top + HEAD)
    for k, (words, pixels) in enumerate((*shown, ("Sigma / depth", coloured(ratio, known, share, colours.ERROR)))):
        left, bottom = (k % 2) * (WIDTH + GAP), SCALE + (k < 2) * (height + TITLE)
        canvas.title(words, WIDTH, bottom + height + TITLE, left)
        canvas.picture(pixels, (left, bottom, WIDTH, height))
    scale(canvas, metres, colours.DEPTH, 0.0)
    scale(canvas, share, colours.ERROR, WIDTH + GAP)
    save(canvas.figure, path)


def depths(depth: np.ndarray) -> Axis:
    """The scale of all depths."""
    low, high = np.quantile(depth, (NEAREST, FARTHEST)).tolist() if depth.size else (0.5, 5.0)
    high = max(high, 1.25 * low)
    return Axis(low, high, "depth, m", log=True)


def coloured(values: np.ndarray, there: np.ndarray, axis: Axis, kind: str) -> np.ndarray:
    """(h, w, 3) in [0, 1]: values by a colour map along a logarithmic axis, the ground where there is none."""
    low, high = math.log(axis.low), math.log(axis.high)
    places = (np.log(np.where(there, values, axis.low).clip(1e-9)) - low) / (high - low)
    ground = np.array(colours.rgb(colours.PICTURE)) / 255
    return np.where(there[..., None], mapped(places.clip(0, 1), kind), ground)


def mapped(places: np.ndarray, kind: str) -> np.ndarray:
    """Colours (…, 3) of places in [0, 1]."""
    from matplotlib import colormaps  # noqa: PLC0415

    return colormaps[kind](places)[..., :3]


def scale(canvas: Canvas, axis: Axis, kind: str, left: float) -> None:
    """A colour map from end to end under a picture, with round numbers and what they mean."""
    base, height = SCALE - 18.0, 9.0
    canvas.picture(mapped(np.linspace(0, 1, 256)[None].repeat(2, 0), kind), (left, base, WIDTH, height))
    decades = axis.log and axis.high > DECADES * axis.low
    ticks = axis.ticks(8) if decades else Axis(axis.low, axis.high).ticks(8)
    for tick in ticks:
        u = left + WIDTH * axis.place(tick)
        canvas.lines([((u, base), (u, base - 3))], Stroke(INK, 0.7))
        canvas.text(axis.write(tick), min(max(u, left + 6), left + WIDTH - 6), base - 13, size=SMALL - 1, ha="center")
    canvas.text(axis.label, left + WIDTH / 2, 1, ha="center")


def _percent(mask: np.ndarray) -> str:
    return f"{100 * mask.mean():.0f} %"


def rgb_of(image: Any) -> np.ndarray:
    """(H, W) or (H, W, 3) in [0, 1]."""
    pixels = as_array(image)
    pixels = pixels / 255.0 if pixels.dtype == np.uint8 else pixels
    pixels = np.clip(pixels, 0, 1)
    return pixels[0] if len(pixels) == 1 else pixels.transpose(1, 2, 0)


def as_array(x: Any) -> np.ndarray:
    """A tensor of any device, or an array, as an array."""
    return x.detach().cpu().numpy() if hasattr(x, "detach") else np.asarray(x)
