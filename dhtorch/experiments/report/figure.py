"""Shared parts of figures: the Figure type, one colour per variant, axes for fractions and errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dhtorch.experiments.report.reading import Result, Row, last_cohort, scene_rows, variant_names
from dhtorch.viz import plots as drawing
from dhtorch.viz.plots import Axis, LayeredPicture, LegendKey, Panel, Stroke, fit_axis
from dhtorch.viz.plots.colours import PAPER_FILL, SOFT

#: Smallest relative error of a logarithmic axis.
MIN_DRAWN_ERROR = 1e-3
#: Largest relative error of a logarithmic axis.
MAX_DRAWN_ERROR = 10.0
#: Diameter of the dot that marks a knee, points.
KNEE_WIDTH_PT = 11.0
#: Legend entry of the paper's figures.
PUBLISHED_KEY = LegendKey("published", PAPER_FILL, "diamond")
#: Stroke of a single scene among others.
SCENE_STROKE = Stroke(SOFT, 0.9, opacity=0.55)


@dataclass(frozen=True)
class Figure:
    """Panels with one caption and one legend."""

    title: str
    caption: str
    panels: Sequence[Panel | LayeredPicture]
    legend: Sequence[LegendKey] = ()
    wide: bool = False
    folded: bool = False  # hidden until it is unfolded


def variant_strokes(result: Result) -> dict[str, Stroke]:
    """Variant → stroke, the same in every figure of a result."""
    return drawing.assign_strokes(variant_names(result))


def variant_legend(result: Result, drawn: Sequence[str]) -> list[LegendKey]:
    """Legend of the drawn variants, in the order of the result."""
    return [LegendKey(v, stroke.colour, stroke=stroke) for v, stroke in variant_strokes(result).items() if v in drawn]


def scene_label(row: Row) -> str:
    """Name of a scene with its role."""
    return f"{row['scene']} ({row['role']})" if row.get("role") else str(row["scene"])


def deciding_rows(result: Result) -> list[Row]:
    """Rows of scenes of the cohort of the verdict."""
    return scene_rows(result, last_cohort(result))


def missing_scenes_note(result: Result, drawn: Sequence[str]) -> str:
    """Sentence with the scenes missing from a figure and the reasons; empty if none is missing."""
    absent = {row["scene"]: row.get("note") or "no answer" for row in deciding_rows(result)}
    reasons = [f"{scene} ({why})" for scene, why in absent.items() if scene not in drawn]
    return f" Not drawn: {', '.join(reasons)}." if reasons else ""


def share_axis(label: str) -> Axis:
    """Axis from 0 to 100 %."""
    return Axis(0.0, 1.0, label, percent=True)


def metric_axis(metric: str, values: Sequence[float | None], label: str = "") -> Axis:
    """Axis of coverage (0 to 100 %), correlation (up to 1) or an error (logarithmic for a large range)."""
    finite = [v for v in values if v is not None]
    if metric == "coverage":
        return share_axis(label)
    if metric == "corr":
        return Axis(max(-1.0, min([0.0, *finite])) - 0.02, 1.0, label)
    positive = [v for v in finite if v > 0]
    if positive and max(positive) > 8 * min(positive):
        return fit_axis(finite, label, log=True, percent=True, floor=MIN_DRAWN_ERROR, cap=MAX_DRAWN_ERROR)
    return fit_axis(finite, label, percent=True, low=0.0)
