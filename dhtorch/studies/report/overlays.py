"""What became of the samples of a scene's first pair, as dots where they lie in the picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dhtorch.codes import Gate, Source, names, words
from dhtorch.studies.report.figure import Figure, missing, named
from dhtorch.studies.report.markup import Markup, tag
from dhtorch.studies.report.reading import Result, scene_rows, variants
from dhtorch.studies.report.svg import picture

#: The variant whose samples are shown first, where a result has it.
FIRST = ("gated", "anchored", "both gates", "gap x1", "map", "paper")

#: Layers from bottom to top: reasons for silence, sensor, recovered.
LAYERS = [f"gate{code}" for code in names(Gate)] + [f"source{Source.SENSOR}", f"source{Source.RECOVERED}"]


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
        panels: list[Markup] = []
        used: set[str] = set()
        for row in mine:
            layers = _layers(row["overlay"])
            used.update(name for name, _, _ in layers)
            title = tag("p", named(row), class_="panel-title")
            panels.append(tag("div", title, picture(named(row), row["overlay"]["hw"], layers)))
        caption = "Some samples of each scene's first pair, where they lie in the anchor's picture. The picture itself "
        caption += "is not shown: licences of many data sets do not allow it." + missing(
            result, [r["scene"] for r in mine]
        )
        legend = [(f"box {name}", _said(name)) for name in LAYERS if name in used]
        found.append(Figure(f"What became of the samples: {variant}", caption, panels, legend, folded=bool(found)))
    return found


def _layers(overlay: Mapping[str, Any]) -> list[tuple[str, list[float], list[float]]]:
    groups: dict[str, tuple[list[float], list[float]]] = {}
    for u, v, source, gate in zip(*(overlay[k] for k in ("u", "v", "source", "gate")), strict=True):
        name = f"gate{gate}" if source == Source.NONE else f"source{source}"
        us, vs = groups.setdefault(name, ([], []))
        us.append(u)
        vs.append(v)
    return [(name, *groups[name]) for name in LAYERS if name in groups]


def _said(name: str) -> str:
    if name.startswith("source"):
        return words(names(Source)[int(name.removeprefix("source"))])
    return "silent: " + words(names(Gate)[int(name.removeprefix("gate"))])
