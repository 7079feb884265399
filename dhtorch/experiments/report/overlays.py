"""Figures of the samples of each scene's first pair: source or gate of every sample at its pixel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dhtorch.codes import Gate, Source, names, words
from dhtorch.experiments.report.figure import Figure, missing_scenes_note, scene_label
from dhtorch.experiments.report.reading import Result, scene_rows, variant_names
from dhtorch.viz.plots import LayeredPicture, LegendKey, PointLayer
from dhtorch.viz.plots.colours import GATE_COLOURS, SOURCE_COLOURS

#: Variants in order of preference for the first figure.
_PREFERRED_VARIANTS = ("gated", "anchored", "both gates", "gap x1", "map", "paper")

#: Layers from bottom to top (gates, sensor, recovered): (table, code) → label, colour, mark.
_OVERLAY_LAYERS = {
    ("gate", code): (f"unanswered: {words(names(Gate)[code])}", colour, "unanswered")
    for code, colour in GATE_COLOURS.items()
}
_OVERLAY_LAYERS |= {
    ("source", code): (words(names(Source)[code]), SOURCE_COLOURS[code], mark)
    for code, mark in ((Source.SENSOR, "sensor"), (Source.RECOVERED, "answer"))
}


def overlay_figures(result: Result) -> list[Figure]:
    """One figure per variant with one panel per scene; all but the preferred variant are folded."""
    with_overlay = [row for row in scene_rows(result) if (row.get("overlay") or {}).get("u")]
    unique = {
        (row["method"], row["scene"]): row for row in with_overlay
    }  # the cohorts of a variant have the same overlay
    rows = list(unique.values())
    order = [v for v in variant_names(result) if any(row["method"] == v for row in rows)]
    order.sort(key=lambda v: _PREFERRED_VARIANTS.index(v) if v in _PREFERRED_VARIANTS else len(_PREFERRED_VARIANTS))
    figures: list[Figure] = []
    for variant in order:
        variant_rows = [row for row in rows if row["method"] == variant]
        panels = [
            LayeredPicture(scene_label(row), row["overlay"]["hw"], overlay_layers(row["overlay"]), width=300)
            for row in variant_rows
        ]
        caption = "Some samples of each scene's first pair, at their pixels in the reference view. The image itself "
        caption += "is not shown: the licences of many data sets do not allow it." + missing_scenes_note(
            result, [r["scene"] for r in variant_rows]
        )
        used = {layer.label for panel in panels for layer in panel.layers}
        legend = [
            LegendKey(label, colour, "cross" if mark == "unanswered" else "dot")
            for label, colour, mark in _OVERLAY_LAYERS.values()
            if label in used
        ]
        figures.append(
            Figure(f"Source or gate of the samples: {variant}", caption, panels, legend, folded=bool(figures))
        )
    return figures


def overlay_layers(overlay: Mapping[str, Any]) -> list[PointLayer]:
    """Points of an archived overlay by source or gate; samples without a pixel are left out."""
    groups: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for u, v, source, gate in zip(*(overlay[k] for k in ("u", "v", "source", "gate")), strict=True):
        if u is not None and v is not None:
            groups.setdefault(("gate", gate) if source == Source.NONE else ("source", source), []).append((u, v))
    return [
        PointLayer(label, np.array(groups[key]), colour, mark)
        for key, (label, colour, mark) in _OVERLAY_LAYERS.items()
        if key in groups
    ]
