"""What became of the samples of a scene's first pair, as dots where they lie in the picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dhtorch.codes import Gate, Source, names, words
from dhtorch.experiments.report.figure import Figure, missing, named
from dhtorch.experiments.report.reading import Result, scene_rows, variants
from dhtorch.viz.plots import Key, Layer, Picture
from dhtorch.viz.plots.colours import GATES, SOURCES

#: The variant whose samples are shown first, where a result has it.
FIRST = ("gated", "anchored", "both gates", "gap x1", "map", "paper")

#: Layers from bottom to top, reasons for silence, sensor, recovered: (table, code) → what is said, colour, mark.
LAYERS = {("gate", code): (f"silent: {words(names(Gate)[code])}", colour, "silent") for code, colour in GATES.items()}
LAYERS |= {
    ("source", code): (words(names(Source)[code]), SOURCES[code], mark)
    for code, mark in ((Source.SENSOR, "sensor"), (Source.RECOVERED, "answer"))
}


def overlays(result: Result) -> list[Figure]:
    """One figure per variant, one panel per scene; all but the variant of most interest are folded away."""
    shown = [row for row in scene_rows(result) if (row.get("overlay") or {}).get("u")]
    once = {(row["method"], row["scene"]): row for row in shown}  # cohorts of one variant show the same
    having = list(once.values())
    order = [v for v in variants(result) if any(row["method"] == v for row in having)]
    order.sort(key=lambda v: FIRST.index(v) if v in FIRST else len(FIRST))
    found: list[Figure] = []
    for variant in order:
        mine = [row for row in having if row["method"] == variant]
        panels = [Picture(named(row), row["overlay"]["hw"], layers(row["overlay"]), width=300) for row in mine]
        caption = "Some samples of each scene's first pair, where they lie in the anchor's picture. The picture itself "
        caption += "is not shown: licences of many data sets do not allow it." + missing(
            result, [r["scene"] for r in mine]
        )
        used = {layer.label for panel in panels for layer in panel.layers}
        legend = [
            Key(said, colour, "cross" if mark == "silent" else "dot")
            for said, colour, mark in LAYERS.values()
            if said in used
        ]
        found.append(Figure(f"What became of the samples: {variant}", caption, panels, legend, folded=bool(found)))
    return found


def layers(overlay: Mapping[str, Any]) -> list[Layer]:
    """The samples of an archived overlay by what became of them; those without a place are left out."""
    groups: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for u, v, source, gate in zip(*(overlay[k] for k in ("u", "v", "source", "gate")), strict=True):
        if u is not None and v is not None:
            groups.setdefault(("gate", gate) if source == Source.NONE else ("source", source), []).append((u, v))
    return [
        Layer(said, np.array(groups[key]), colour, mark)
        for key, (said, colour, mark) in LAYERS.items()
        if key in groups
    ]
