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
from dhtorch.viz.plots.canvas import Canvas, save_figure
from dhtorch.viz.plots.maps import (
    HEADER_HEIGHT_PT,
    PICTURE_GAP_PT,
    PICTURE_WIDTH_PT,
    SCALE_HEIGHT_PT,
    TITLE_HEIGHT_PT,
    apply_cmap,
    apply_log_cmap,
    as_array,
    draw_scale,
    fit_depth_axis,
    to_unit_rgb,
)

#: Sigmas at the ends of the colour map of evidence.
_MAX_EVIDENCE_SIGMAS = 6.0


def draw_validation(
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
    height = PICTURE_WIDTH_PT * z.shape[0] / z.shape[1]
    top = 2 * (height + TITLE_HEIGHT_PT) + SCALE_HEIGHT_PT
    canvas = Canvas(2 * PICTURE_WIDTH_PT + PICTURE_GAP_PT, top + HEADER_HEIGHT_PT * bool(title), dpi=160)
    canvas.title(title, 2 * PICTURE_WIDTH_PT + PICTURE_GAP_PT, top + HEADER_HEIGHT_PT)
    ground = np.array(colours.parse_rgb(colours.PICTURE)) / 255
    states = colours.colour_by_code(colours.STATE_COLOURS, code.astype(np.int64)) / 255
    wrong, fine = (((code == k) & known).sum() for k in (State.WRONG, State.CONSISTENT))
    metres, ends = fit_depth_axis(z[known]), Axis(-_MAX_EVIDENCE_SIGMAS, _MAX_EVIDENCE_SIGMAS, "evidence, sigmas")
    strength = apply_cmap(
        (np.nan_to_num(sigmas).clip(-_MAX_EVIDENCE_SIGMAS, _MAX_EVIDENCE_SIGMAS) + _MAX_EVIDENCE_SIGMAS)
        / (2 * _MAX_EVIDENCE_SIGMAS),
        colours.SIGNED_CMAP,
    )
    shown = [
        ("Picture", 1, to_unit_rgb(image)),
        (_describe_states(int(wrong), int(fine), int(known.sum())), 1, states),
        ("Depth", 0, apply_log_cmap(z, known, metres, colours.DEPTH_CMAP)),
        ("Evidence: red too far, blue too near", 0, np.where(np.isnan(sigmas)[..., None], ground, strength)),
    ]
    for k, (words, row, pixels) in enumerate(shown):
        left, bottom = (k % 2) * (PICTURE_WIDTH_PT + PICTURE_GAP_PT), SCALE_HEIGHT_PT + row * (height + TITLE_HEIGHT_PT)
        canvas.title(words, PICTURE_WIDTH_PT, bottom + height + TITLE_HEIGHT_PT, left)
        canvas.picture(pixels, (left, bottom, PICTURE_WIDTH_PT, height))
    draw_scale(canvas, metres, colours.DEPTH_CMAP, 0.0)
    draw_scale(canvas, ends, colours.SIGNED_CMAP, PICTURE_WIDTH_PT + PICTURE_GAP_PT)
    save_figure(canvas.figure, path)


def _describe_states(wrong: int, fine: int, size: int) -> str:
    """The states in words: known is a share of the pixels with a depth, wrong one of what is known, as in tables and
    limits."""
    known = wrong + fine
    told = f", of which {100 * wrong / known:.1f} % are wrong" if known else ""
    return f"Known: {100 * known / size:.0f} % of the depth{told}" if size else "No depth"
