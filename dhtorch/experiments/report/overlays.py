"""What became of the samples of a scene's first pair, as dots where they lie in the picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dhtorch.codes import Gate, Source, names, words
from dhtorch.experiments.report.figure import Figure, missing_scenes_note, scene_label
from dhtorch.experiments.report.reading import Result, scene_rows, variant_names
from dhtorch.viz.plots import LayeredPicture, LegendKey, PointLayer
from dhtorch.viz.plots.colours import GATE_COLOURS, SOURCE_COLOURS

#: The variant whose samples are shown first, where a result has it.
_PREFERRED_VARIANTS = ("gated", "anchored", "both gates", "gap x1", "map", "paper")

#: Layers from bottom to top, reasons for silence, sensor, recovered: (table, code) → what is said, colour, mark.
_OVERLAY_LAYERS = {
    ("gate", code): (f"silent: {words(names(Gate)[code])}", colour, "silent") for code, colour in GATE_COLOURS.items()
}
_OVERLAY_LAYERS |= {
    ("source", code): (words(names(Source)[code]), SOURCE_COLOURS[code], mark)
    for code, mark in ((Source.SENSOR, "sensor"), (Source.RECOVERED, "answer"))
}


def overlay_figures(result: Result) -> list[Figure]:
    """One figure per variant, one panel per scene; all but the variant of most interest are folded away."""
    shown = [row for row in scene_rows(result) if (row.get("overlay") or {}).get("u")]
    once = {(row["method"], row["scene"]): row for row in shown}  # cohorts of one variant show the same
    having = list(once.values())
    order = [v for v in variant_names(result) if any(row["method"] == v for row in having)]
    order.sort(key=lambda v: _PREFERRED_VARIANTS.index(v) if v in _PREFERRED_VARIANTS else len(_PREFERRED_VARIANTS))
    found: list[Figure] = []
    for variant in order:
        mine = [row for row in having if row["method"] == variant]
        panels = [
            LayeredPicture(scene_label(row), row["overlay"]["hw"], overlay_layers(row["overlay"]), width=300)
            for row in mine
        ]
        caption = "Some samples of each scene's first pair, where they lie in the reference view. The picture itself "
        caption += "is not shown: licences of many data sets do not allow it." + missing_scenes_note(
            result, [r["scene"] for r in mine]
        )
        used = {layer.label for panel in panels for layer in panel.layers}
        legend = [
            LegendKey(said, colour, "cross" if mark == "silent" else "dot")
            for said, colour, mark in _OVERLAY_LAYERS.values()
            if said in used
        ]
        found.append(Figure(f"What became of the samples: {variant}", caption, panels, legend, folded=bool(found)))
    return found


def overlay_layers(overlay: Mapping[str, Any]) -> list[PointLayer]:
    """The samples of an archived overlay by what became of them; those without a place are left out."""
    groups: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for u, v, source, gate in zip(*(overlay[k] for k in ("u", "v", "source", "gate")), strict=True):
        if u is not None and v is not None:
            groups.setdefault(("gate", gate) if source == Source.NONE else ("source", source), []).append((u, v))
    return [
        PointLayer(said, np.array(groups[key]), colour, mark)
        for key, (said, colour, mark) in _OVERLAY_LAYERS.items()
        if key in groups
    ]
