"""Figure of a validated depth map: image, state of every pixel, depth, evidence.

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

#: Evidence at the ends of its colour map, sigmas.
_MAX_EVIDENCE_SIGMAS = 6.0


def draw_validation(
    path: str | Path | IO[bytes],
    image: Any,  # (C, H, W) uint8, or float in [0, 1]
    depth: Any,  # (h, w) m, 0 or NaN without depth
    state: Any,  # (h, w) codes.State
    evidence: Any,  # (h, w) sigmas, positive where the map is too far; NaN without evidence
    *,
    title: str = "",
) -> None:
    """Draw image, states, log depth and evidence.

    Evidence is red where the map is too far and blue where it is too near; blank without evidence.
    """
    z, code, sigmas = (as_array(x) for x in (depth, state, evidence))
    has_depth = np.isfinite(z) & (z > 0)
    height = PICTURE_WIDTH_PT * z.shape[0] / z.shape[1]
    top = 2 * (height + TITLE_HEIGHT_PT) + SCALE_HEIGHT_PT
    canvas = Canvas(2 * PICTURE_WIDTH_PT + PICTURE_GAP_PT, top + HEADER_HEIGHT_PT * bool(title), dpi=160)
    canvas.title(title, 2 * PICTURE_WIDTH_PT + PICTURE_GAP_PT, top + HEADER_HEIGHT_PT)
    background = np.array(colours.parse_rgb(colours.PICTURE)) / 255
    states = colours.colour_by_code(colours.STATE_COLOURS, code.astype(np.int64)) / 255
    n_wrong, n_consistent = (((code == k) & has_depth).sum() for k in (State.WRONG, State.CONSISTENT))
    depth_axis, evidence_axis = (
        fit_depth_axis(z[has_depth]),
        Axis(-_MAX_EVIDENCE_SIGMAS, _MAX_EVIDENCE_SIGMAS, "evidence, sigmas"),
    )
    evidence_rgb = apply_cmap(
        (np.nan_to_num(sigmas).clip(-_MAX_EVIDENCE_SIGMAS, _MAX_EVIDENCE_SIGMAS) + _MAX_EVIDENCE_SIGMAS)
        / (2 * _MAX_EVIDENCE_SIGMAS),
        colours.SIGNED_CMAP,
    )
    panels = [
        ("Picture", 1, to_unit_rgb(image)),
        (_describe_states(int(n_wrong), int(n_consistent), int(has_depth.sum())), 1, states),
        ("Depth", 0, apply_log_cmap(z, has_depth, depth_axis, colours.DEPTH_CMAP)),
        ("Evidence: red too far, blue too near", 0, np.where(np.isnan(sigmas)[..., None], background, evidence_rgb)),
    ]
    for k, (words, row, pixels) in enumerate(panels):
        left, bottom = (k % 2) * (PICTURE_WIDTH_PT + PICTURE_GAP_PT), SCALE_HEIGHT_PT + row * (height + TITLE_HEIGHT_PT)
        canvas.title(words, PICTURE_WIDTH_PT, bottom + height + TITLE_HEIGHT_PT, left)
        canvas.picture(pixels, (left, bottom, PICTURE_WIDTH_PT, height))
    draw_scale(canvas, depth_axis, colours.DEPTH_CMAP, 0.0)
    draw_scale(canvas, evidence_axis, colours.SIGNED_CMAP, PICTURE_WIDTH_PT + PICTURE_GAP_PT)
    save_figure(canvas.figure, path)


def _describe_states(wrong: int, consistent: int, size: int) -> str:
    """Title of the states: checked pixels as a fraction of those with depth, wrong ones as one of the checked."""
    checked = wrong + consistent
    wrong_text = f", of which {100 * wrong / checked:.1f} % are wrong" if checked else ""
    return f"Checked: {100 * checked / size:.0f} % of the depth{wrong_text}" if size else "No depth"
