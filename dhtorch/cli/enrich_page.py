"""One page about an enriched data set: what became of its pixels and why, by camera, along time, by episode."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.cli.gate_messages import meaning
from dhtorch.codes import Gate, Source, names
from dhtorch.experiments.report.figure import Figure
from dhtorch.experiments.report.page import STYLE, figures_markup, table_markup
from dhtorch.experiments.report.tables import Table
from dhtorch.extract.enriched import NO_VIEW, SILENCE
from dhtorch.extract.targets import UNKNOWN
from dhtorch.runtime import storage
from dhtorch.runtime.console import many
from dhtorch.viz.plots import Axis, Key, Panel
from dhtorch.viz.plots.colours import GATES, RECOVERED, SENSOR, SILENT, SOFT, Stroke
from dhtorch.viz.plots.document import document
from dhtorch.viz.plots.markup import tag

Row = Mapping[str, Any]

#: Of the page and of the numbers beside it.
NAME = "report"

#: Episodes that are listed, those with least depth first.
WORST = 10

#: Reasons of silence that are drawn, the most frequent.
REASONS = 4

#: Least share of the pixels of a reason that is named.
LEAST = 5e-4

#: Kind of a pixel → its codes.
KINDS = {"sensor": (Source.SENSOR,), "recovered": (Source.RECOVERED, Source.SWEPT), "silent": (Source.NONE,)}
_REASON_COLOURS = {**GATES, NO_VIEW: SOFT}
_COLOURS = {"sensor": SENSOR, "recovered": RECOVERED, "silent": SILENT}


def by_camera(owns: Sequence[Row]) -> list[tuple[str, dict[str, float], dict[str, float]]]:
    """Camera, shares of its pixels by kind, and shares that are silent by gate, the largest first."""
    return [(name, *_shares([own["cameras"][name] for own in owns if name in own["cameras"]])) for name in _names(owns)]


def refuted(owns: Sequence[Row]) -> list[str]:
    """Of every camera whose given poses the near returns contradict in some frames: in how many, and the reading."""
    found = []
    for name in _names(owns):
        cameras = [own["cameras"][name] for own in owns if name in own["cameras"]]
        against = sum((Counter(camera["refuted"]) for camera in cameras), Counter())
        if against:
            frames = f"{against.total()} of {many(sum(camera['frames'] for camera in cameras), 'frame')}"
            found.append(f"{name}: the poses given contradict the near returns in {frames}{_looks(against)}")
    return found


def write(folder: Path, about: Row, owns: Sequence[Row]) -> Path:
    """Write the page and, beside it, what it says as numbers; where the page is."""
    listed = [{k: own[k] for k in ("number", "length", "cameras")} for own in owns]
    codes = {"pixels": names(Source), "silent": SILENCE}
    storage.write_json(folder / f"{NAME}.json", {"data": about["data"], "codes": codes, "episodes": listed})
    return storage.replace_file(folder / f"{NAME}.html", page(about, owns).encode("utf-8"))


def page(about: Row, owns: Sequence[Row]) -> str:
    """The page.

    Args:
        about: what all episodes share.
        owns: what each amounts to, as :class:`dhtorch.extract.targets.Target` notes it.
    """
    title = f"{about['data']['source']}: what became of its pixels"
    frames = sum(own["length"] for own in owns)
    step = f"depth in steps of {1e3 * about['step_m']:.3g} mm" if about["step_m"] else "depth as it was found"
    episodes = f"{many(len(owns), 'episode')}, {many(frames, 'frame')}"
    lead = f"{episodes}; {step}; dhtorch {about['version']}, method {about['method']}"
    tables = [table for table in (_cameras(owns), _refuted(owns), _worst(owns)) if table.rows]
    figures = [figure for figure in (_along(owns), _why(owns)) if figure is not None]
    parts = [*(table_markup(t) for t in tables), figures_markup(figures)]
    top = tag("header", tag("h1", title), tag("p", lead, class_="lead"))
    return document(title, top, tag("main", *parts), own=STYLE)


def _shares(cameras: Sequence[Row]) -> tuple[dict[str, float], dict[str, float]]:
    pixels = np.sum([np.array(c["pixels"], float) for c in cameras if c["pixels"]], 0)
    silent = np.sum([np.array(c["silent"], float) for c in cameras if c["pixels"]], 0)
    total = max(1.0, float(np.sum(pixels)))
    if not np.size(pixels):
        return dict.fromkeys(KINDS, 0.0) | {"silent": 1.0}, {}
    kinds = {kind: float(sum(pixels[code] for code in codes)) / total for kind, codes in KINDS.items()}
    gates = {name: float(silent[code]) / total for code, name in SILENCE.items() if code != Gate.ANSWER}
    return kinds, {name: share for name, share in sorted(gates.items(), key=lambda x: -x[1]) if share >= LEAST}


def _names(owns: Sequence[Row]) -> list[str]:
    """Of all cameras."""
    return list(dict.fromkeys(name for own in owns for name in own["cameras"]))


def _looks(against: Mapping[str, int]) -> str:
    """Behind a sentence about refuted poses: how they read."""
    known = {reading: n for reading, n in against.items() if reading != UNKNOWN}
    readings = " or ".join(f"{reading} ({n})" if len(against) > 1 else reading for reading, n in known.items())
    return f"; they look like {readings}" if known else "; they fit in no reading that is known"


def _cameras(owns: Sequence[Row]) -> Table:
    rows = []
    for name, kinds, reasons in by_camera(owns):
        why = "; ".join(f"{meaning(gate)} {share:.1%}" for gate, share in reasons.items())
        rows.append([name, why or "—", *(f"{share:.1%}" for share in kinds.values())])
    return Table("Pixels by camera", ["camera", "silent because", *KINDS], rows, n_label=2)


def _refuted(owns: Sequence[Row]) -> Table:
    """Episodes and cameras whose given poses the near returns contradict."""
    rows = [
        [
            str(own["number"]),
            name,
            "; ".join(camera["refuted"]),
            f"{sum(camera['refuted'].values())}",
            f"{camera['frames']}",
        ]
        for own in owns
        for name, camera in own["cameras"].items()
        if camera["refuted"]
    ]
    rows = sorted(rows, key=lambda row: -int(row[3]) / int(row[4]))[:WORST]
    note = "See the axes, the direction and the unit of the poses." if rows else ""
    head = ["episode", "camera", "they look like", "frames", "of"]
    return Table("Poses given that the near returns contradict", head, rows, n_label=3, note=note)


def _worst(owns: Sequence[Row]) -> Table:
    found = []
    for own in owns:
        for name, camera in own["cameras"].items():
            kinds, reasons = _shares([camera])
            found.append((kinds["silent"], own["number"], name, kinds, reasons, camera["unread"]))
    rows = []
    for _, number, name, kinds, reasons, unread in sorted(found, key=lambda x: (-x[0], x[1], x[2]))[:WORST]:
        why = next((meaning(gate) for gate in reasons), "—")
        rows.append([str(number), name, why, *(f"{share:.1%}" for share in kinds.values()), str(unread)])
    head = ["episode", "camera", "silent most often because", *KINDS, "frames not read"]
    return Table("Episodes with least depth first", head, rows, n_label=3)


def _along(owns: Sequence[Row]) -> Figure | None:
    """Shares along the episodes, mean over them."""
    panels = []
    for name, mean in _means(owns, "over_time"):
        panel = _panel(name)
        for kind, codes in KINDS.items():
            _draw(panel, sum(mean[code] for code in codes), _COLOURS[kind])
        panels.append(panel)
    keys = [Key(kind, colour, "line") for kind, colour in _COLOURS.items()]
    return Figure("Along time", "Mean over the episodes, by camera.", panels, keys) if panels else None


def _why(owns: Sequence[Row]) -> Figure | None:
    """The reasons of silence that are most frequent, along the episodes."""
    found = _means(owns, "silent_over_time")
    gates = [gate for gate in _REASON_COLOURS if any(mean[gate].max() > 0 for _, mean in found)]
    gates = sorted(gates, key=lambda gate: -max(float(mean[gate].mean()) for _, mean in found))[:REASONS]
    panels = []
    for name, mean in found if gates else []:
        panel = _panel(name)
        for gate in gates:
            _draw(panel, mean[gate], _REASON_COLOURS[gate])
        panels.append(panel)
    keys = [Key(meaning(SILENCE[gate]), _REASON_COLOURS[gate], "line") for gate in gates]
    return Figure("Why silent, along time", "Share of all pixels, by camera.", panels, keys) if panels else None


def _means(owns: Sequence[Row], column: str) -> list[tuple[str, np.ndarray]]:
    """Camera and what a column is along time (codes, parts), mean over the episodes; those with two parts at least."""
    found = []
    for name in _names(owns):
        shares = [np.array(own["cameras"][name][column]) for own in owns if name in own["cameras"]]
        longest = max((len(x) for x in shares if len(x)), default=0)
        if longest < 2:
            continue
        at = np.linspace(0, 1, longest)
        spread = [
            [np.interp(at, np.linspace(0, 1, len(x)), x[:, c]) for c in range(x.shape[1])] for x in shares if len(x)
        ]
        found.append((name, np.mean(spread, 0)))
    return found


def _panel(name: str) -> Panel:
    return Panel(name, Axis(0, 1, "part of the episode, %", percent=True), Axis(0, 1, "pixels, %", percent=True))


def _draw(panel: Panel, shares: Any, colour: str) -> None:
    panel.line(np.linspace(0, 1, len(shares)).tolist(), shares.tolist(), Stroke(colour, 1.8))
