"""matplotlib settings for notebook figures: width of a printed page, print resolution, font size of the text."""

from collections.abc import Mapping
from typing import Any

#: Width of a figure, inches.
FIGURE_WIDTH_IN = 7.2

#: For ``matplotlib.pyplot.rcParams``; sizes in points.
NOTEBOOK_RC_PARAMS: Mapping[str, Any] = {
    "figure.dpi": 160,
    "figure.labelsize": 8,
    "font.size": 8,
    "axes.titlesize": 8.5,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.2,
    "lines.markersize": 3.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "scatter.edgecolors": "none",
}
