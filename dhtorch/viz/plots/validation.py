"""A judged depth map: the picture, what is said of every pixel, the map, and how strongly.

Arrays may be torch tensors or numpy arrays, on any device, of one view (no batch dimension).
"""

from __future__ import annotations

from pathlib import Path
from typing import IO, Any

import numpy as np

from dhtorch.codes import State
from dhtorch.viz.plots import colours
from dhtorch.viz.plots.axis import Axis
from dhtorch.viz.plots.canvas import Canvas, save
from dhtorch.viz.plots.maps import (
    GAP,
    HEAD,
    SCALE,
    TITLE,
    WIDTH,
    as_array,
    coloured,
    depths,
    mapped,
    rgb_of,
    scale,
)

#: Sigmas at the ends of the colour map of evidence.
END = 6.0


def draw_verdict(
    path: str | Path | IO[bytes],
    image: Any,  # (C, H, W) uint8, or float in [0, 1]
    depth: Any,  # (h, w) m, 0 or NaN where nothing is known
    state: Any,  # (h, w) codes.State
    evidence: Any,  # (h, w) sigmas, positive where the map is too far; NaN where nothing is said
    *,
    title: str = "",
) -> None:
    """Draw the picture, the states, the map by the logarithm of its depth, and the evidence.

    Evidence is red where the map is too far and blue where it is too near. What cannot be known is left blank.
    """
    z, code, sigmas = (as_array(x) for x in (depth, state, evidence))
    known = np.isfinite(z) & (z > 0)
    height = WIDTH * z.shape[0] / z.shape[1]
    top = 2 * (height + TITLE) + SCALE
    canvas = Canvas(2 * WIDTH + GAP, top + HEAD * bool(title), dpi=160)
    canvas.title(title, 2 * WIDTH + GAP, top + HEAD)
    ground = np.array(colours.rgb(colours.PICTURE)) / 255
    states = np.array([colours.rgb(colours.STATES[k]) for k in sorted(colours.STATES)])[code.astype(np.int64)] / 255
    wrong, fine = (((code == k) & known).sum() for k in (State.WRONG, State.CONSISTENT))
    metres, ends = depths(z[known]), Axis(-END, END, "evidence, sigmas")
    strength = mapped((np.nan_to_num(sigmas).clip(-END, END) + END) / (2 * END), colours.SIGNED)
    shown = [
        ("Picture", 1, rgb_of(image)),
        (_said(int(wrong), int(fine), int(known.sum())), 1, states),
        ("Depth", 0, coloured(z, known, metres, colours.DEPTH)),
        ("Evidence: red too far, blue too near", 0, np.where(np.isnan(sigmas)[..., None], ground, strength)),
    ]
    for k, (words, row, pixels) in enumerate(shown):
        left, bottom = (k % 2) * (WIDTH + GAP), SCALE + row * (height + TITLE)
        canvas.title(words, WIDTH, bottom + height + TITLE, left)
        canvas.picture(pixels, (left, bottom, WIDTH, height))
    scale(canvas, metres, colours.DEPTH, 0.0)
    scale(canvas, ends, colours.SIGNED, WIDTH + GAP)
    save(canvas.figure, path)


def _said(wrong: int, fine: int, size: int) -> str:
    """The states in words: known is a share of the pixels with a depth, wrong one of what is known, as in tables and
    limits."""
    known = wrong + fine
    told = f", of which {100 * wrong / known:.1f} % are wrong" if known else ""
    return f"Known: {100 * known / size:.0f} % of the depth{told}" if size else "No depth"
