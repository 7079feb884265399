"""What figures share: their form, one colour per variant, and axes for shares and errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dhtorch.experiments.report.reading import Result, Row, last_cohort, scene_rows, variant_names
from dhtorch.viz import plots as drawing
from dhtorch.viz.plots import Axis, LayeredPicture, LegendKey, Panel, Stroke, fit_axis
from dhtorch.viz.plots.colours import PAPER_FILL, SOFT

#: Relative errors are drawn between these.
MIN_DRAWN_ERROR, MAX_DRAWN_ERROR = 1e-3, 10.0
#: Legend of the paper's figures.
PUBLISHED_KEY = LegendKey("published", PAPER_FILL, "diamond")
#: A single scene among others.
SCENE_STROKE = Stroke(SOFT, 0.9, opacity=0.55)


@dataclass(frozen=True)
class Figure:
    """Panels with one caption and one legend."""

    title: str
    caption: str
    panels: Sequence[Panel | LayeredPicture]
    legend: Sequence[LegendKey] = ()
    wide: bool = False
    folded: bool = False  # of less interest: shown when asked for


def variant_strokes(result: Result) -> dict[str, Stroke]:
    """Variant → how it is drawn, the same in every figure of a result."""
    return drawing.assign_strokes(variant_names(result))


def variant_legend(result: Result, drawn: Sequence[str]) -> list[LegendKey]:
    """The drawn variants in the order of the result."""
    return [LegendKey(v, stroke.colour, stroke=stroke) for v, stroke in variant_strokes(result).items() if v in drawn]


def scene_label(row: Row) -> str:
    """A scene with its role."""
    return f"{row['scene']} ({row['role']})" if row.get("role") else str(row["scene"])


def deciding_rows(result: Result) -> list[Row]:
    """The rows of scenes for the cohort that decides."""
    return scene_rows(result, last_cohort(result))


def missing_scenes_note(result: Result, drawn: Sequence[str]) -> str:
    """A sentence that names the scenes a figure lacks, and why; empty where it lacks none."""
    absent = {row["scene"]: row.get("note") or "nothing answered" for row in deciding_rows(result)}
    said = [f"{scene} ({why})" for scene, why in absent.items() if scene not in drawn]
    return f" Not drawn: {', '.join(said)}." if said else ""


def share_axis(label: str) -> Axis:
    """0 to 100 %."""
    return Axis(0.0, 1.0, label, percent=True)


def metric_axis(metric: str, values: Sequence[float | None], label: str = "") -> Axis:
    """An axis for coverage (whole), correlation (to 1) or an error (logarithmic where it spans much)."""
    known = [v for v in values if v is not None]
    if metric == "coverage":
        return share_axis(label)
    if metric == "corr":
        return Axis(max(-1.0, min([0.0, *known])) - 0.02, 1.0, label)
    positive = [v for v in known if v > 0]
    if positive and max(positive) > 8 * min(positive):
        return fit_axis(known, label, log=True, percent=True, floor=MIN_DRAWN_ERROR, cap=MAX_DRAWN_ERROR)
    return fit_axis(known, label, percent=True, low=0.0)
