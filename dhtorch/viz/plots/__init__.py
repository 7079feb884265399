"""Figures of jobs, of the report page and of notebooks, and the project's colours.

``colours`` defines all colours, ``axis`` the mapping of values to positions, ``canvas`` a bare figure, ``panel`` a pair
of axes; ``pictures`` draws the samples of a pair, ``maps`` a completed or aligned view, ``previews`` frames of a
completed recording, ``validation`` a validated view; ``svg`` converts a panel to inline SVG. matplotlib is imported on
first use.
"""

from __future__ import annotations

from dhtorch.viz.plots.axis import Axis, fit_axis
from dhtorch.viz.plots.canvas import (
    Canvas,
    LegendKey,
    Mark,
    append_cutoff,
    format_capture_name,
    format_frame,
    prefix_title,
    save_figure,
)
from dhtorch.viz.plots.colours import Stroke, assign_strokes
from dhtorch.viz.plots.maps import draw_aligned, draw_completed
from dhtorch.viz.plots.panel import Panel, save_panels
from dhtorch.viz.plots.pictures import (
    MIN_CURVE_ANSWERS,
    LayeredPicture,
    PointLayer,
    draw_depth,
    draw_holes,
    draw_risk_coverage,
    draw_samples,
)
from dhtorch.viz.plots.previews import CompletedView, Strip, draw_contact_sheet, fit_common_depth_axis
from dhtorch.viz.plots.svg import render_inline_svg
from dhtorch.viz.plots.validation import draw_validation

__all__ = [
    "MIN_CURVE_ANSWERS",
    "Axis",
    "Canvas",
    "CompletedView",
    "LayeredPicture",
    "LegendKey",
    "Mark",
    "Panel",
    "PointLayer",
    "Strip",
    "Stroke",
    "append_cutoff",
    "assign_strokes",
    "draw_aligned",
    "draw_completed",
    "draw_contact_sheet",
    "draw_depth",
    "draw_holes",
    "draw_risk_coverage",
    "draw_samples",
    "draw_validation",
    "fit_axis",
    "fit_common_depth_axis",
    "format_capture_name",
    "format_frame",
    "prefix_title",
    "render_inline_svg",
    "save_figure",
    "save_panels",
]
