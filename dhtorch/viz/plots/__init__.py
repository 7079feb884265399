"""Everything that is drawn: figures of a job, of the report's page and of notebooks, and the project's colours.

``colours`` is the one page of colours; ``axis`` says where a number stands, ``canvas`` is a bare figure, ``panel`` one
pair of axes, ``pictures`` shows what a pair found, ``maps`` a completed view, ``verdicts`` a judged one, ``svg`` puts a
panel into a page.
matplotlib is imported when something is drawn.
"""

from __future__ import annotations

from dhtorch.viz.plots.axis import Axis, spanning
from dhtorch.viz.plots.canvas import Canvas, Key, Mark, at_cutoff, frame_of, headed, save
from dhtorch.viz.plots.colours import Stroke, series
from dhtorch.viz.plots.maps import draw_anchored, draw_completed
from dhtorch.viz.plots.panel import Panel
from dhtorch.viz.plots.pictures import (
    FEWEST,
    Layer,
    Picture,
    draw_depth,
    draw_holes,
    draw_risk_coverage,
    draw_samples,
)
from dhtorch.viz.plots.svg import inline
from dhtorch.viz.plots.validation import draw_verdict

__all__ = [
    "FEWEST",
    "Axis",
    "Canvas",
    "Key",
    "Layer",
    "Mark",
    "Panel",
    "Picture",
    "Stroke",
    "at_cutoff",
    "draw_anchored",
    "draw_completed",
    "draw_depth",
    "draw_holes",
    "draw_risk_coverage",
    "draw_samples",
    "draw_verdict",
    "frame_of",
    "headed",
    "inline",
    "save",
    "series",
    "spanning",
]
