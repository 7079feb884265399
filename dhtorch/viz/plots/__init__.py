"""Figures of jobs, of report pages and of notebooks as matplotlib axes, and the project's colours.

``colours`` defines all colours; ``figures`` makes axes, legends and files; ``samples`` draws the samples of a pair,
``maps`` the maps of a view or of some frames; ``markup`` writes pages. matplotlib is imported on first use.
"""

from dhtorch.viz.plots.colours import Stroke, assign_strokes
from dhtorch.viz.plots.figures import (
    add_legend,
    append_cutoff,
    draw_line,
    encode_uri,
    format_capture_name,
    format_frame,
    make_figure,
    mark_options,
    prefix_title,
    save_figure,
    set_axis,
    set_title,
)
from dhtorch.viz.plots.maps import (
    CompletedView,
    Strip,
    draw_aligned,
    draw_completed,
    draw_contact_sheet,
    draw_validation,
    fit_common_depth_axis,
    make_image_grid,
)
from dhtorch.viz.plots.samples import draw_depth, draw_holes, draw_risk_coverage, draw_samples

__all__ = [
    "CompletedView",
    "Strip",
    "Stroke",
    "add_legend",
    "append_cutoff",
    "assign_strokes",
    "draw_aligned",
    "draw_completed",
    "draw_contact_sheet",
    "draw_depth",
    "draw_holes",
    "draw_line",
    "draw_risk_coverage",
    "draw_samples",
    "draw_validation",
    "encode_uri",
    "fit_common_depth_axis",
    "format_capture_name",
    "format_frame",
    "make_figure",
    "make_image_grid",
    "mark_options",
    "prefix_title",
    "save_figure",
    "set_axis",
    "set_title",
]
