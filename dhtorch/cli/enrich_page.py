"""One page about an enriched data set: what became of its pixels and why, by camera, along time, by episode."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.cli.gate_messages import describe_gate
from dhtorch.codes import Gate, Source, names
from dhtorch.experiments.report.figure import Figure
from dhtorch.experiments.report.page import PAGE_CSS, figures_markup, table_markup
from dhtorch.experiments.report.tables import ReportTable
from dhtorch.extract.enriched import NO_ANSWER_REASONS, NO_OTHER_VIEW
from dhtorch.extract.targets import UNKNOWN_CONVENTION
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count
from dhtorch.viz.plots import Axis, LegendKey, Panel
from dhtorch.viz.plots.colours import GATE_COLOURS, RECOVERED, SENSOR, SILENT, SOFT, Stroke
from dhtorch.viz.plots.document import build_document
from dhtorch.viz.plots.markup import make_tag

Row = Mapping[str, Any]

#: Of the page and of the numbers beside it.
_REPORT_NAME = "report"

#: Episodes that are listed, those with least depth first.
_MAX_LISTED_EPISODES = 10

#: Reasons of silence that are drawn, the most frequent.
_MAX_DRAWN_REASONS = 4

#: Least share of the pixels of a reason that is named.
_MIN_REASON_SHARE = 5e-4

#: Kind of a pixel → its codes.
_CODES_OF_KIND = {"sensor": (Source.SENSOR,), "recovered": (Source.RECOVERED, Source.SWEPT), "silent": (Source.NONE,)}
_REASON_COLOURS = {**GATE_COLOURS, NO_OTHER_VIEW: SOFT}
_KIND_COLOURS = {"sensor": SENSOR, "recovered": RECOVERED, "silent": SILENT}


def summarise_cameras(owns: Sequence[Row]) -> list[tuple[str, dict[str, float], dict[str, float]]]:
    """Camera, shares of its pixels by kind, and shares that are silent by gate, the largest first."""
    return [
        (name, *_pixel_shares([own["cameras"][name] for own in owns if name in own["cameras"]]))
        for name in _list_cameras(owns)
    ]


def describe_refuted_poses(owns: Sequence[Row]) -> list[str]:
    """Of every camera whose given poses the near returns contradict in some frames: in how many, and the reading."""
    found = []
    for name in _list_cameras(owns):
        cameras = [own["cameras"][name] for own in owns if name in own["cameras"]]
        against = sum((Counter(camera["refuted"]) for camera in cameras), Counter())
        if against:
            frames = f"{against.total()} of {format_count(sum(camera['frames'] for camera in cameras), 'frame')}"
            found.append(
                f"{name}: the poses given contradict the near returns in {frames}{_describe_readings(against)}"
            )
    return found


def write_enrich_page(folder: Path, about: Row, owns: Sequence[Row]) -> Path:
    """Write the page and, beside it, what it says as numbers; where the page is."""
    listed = [{k: own[k] for k in ("number", "length", "cameras")} for own in owns]
    codes = {"pixels": names(Source), "silent": NO_ANSWER_REASONS}
    storage.write_json(folder / f"{_REPORT_NAME}.json", {"data": about["data"], "codes": codes, "episodes": listed})
    return storage.replace_file(folder / f"{_REPORT_NAME}.html", _build_page(about, owns).encode("utf-8"))


def _build_page(about: Row, owns: Sequence[Row]) -> str:
    """The page.

    Args:
        about: what all episodes share.
        owns: what each amounts to, as :class:`dhtorch.extract.targets.DatasetTarget` notes it.
    """
    title = f"{about['data']['source']}: what became of its pixels"
    frames = sum(own["length"] for own in owns)
    step = f"depth in steps of {1e3 * about['step_m']:.3g} mm" if about["step_m"] else "depth as it was found"
    episodes = f"{format_count(len(owns), 'episode')}, {format_count(frames, 'frame')}"
    lead = f"{episodes}; {step}; dhtorch {about['version']}, method {about['method']}"
    tables = [
        table
        for table in (_build_camera_table(owns), _build_refuted_table(owns), _build_worst_table(owns))
        if table.rows
    ]
    figures = [figure for figure in (_build_time_figure(owns), _build_reason_figure(owns)) if figure is not None]
    parts = [*(table_markup(t) for t in tables), figures_markup(figures)]
    top = make_tag("header", make_tag("h1", title), make_tag("p", lead, class_="lead"))
    return build_document(title, top, make_tag("main", *parts), own=PAGE_CSS)


def _pixel_shares(cameras: Sequence[Row]) -> tuple[dict[str, float], dict[str, float]]:
    pixels = np.sum([np.array(c["pixels"], float) for c in cameras if c["pixels"]], 0)
    silent = np.sum([np.array(c["silent"], float) for c in cameras if c["pixels"]], 0)
    total = max(1.0, float(np.sum(pixels)))
    if not np.size(pixels):
        return dict.fromkeys(_CODES_OF_KIND, 0.0) | {"silent": 1.0}, {}
    kinds = {kind: float(sum(pixels[code] for code in codes)) / total for kind, codes in _CODES_OF_KIND.items()}
    gates = {name: float(silent[code]) / total for code, name in NO_ANSWER_REASONS.items() if code != Gate.ANSWER}
    return kinds, {
        name: share for name, share in sorted(gates.items(), key=lambda x: -x[1]) if share >= _MIN_REASON_SHARE
    }


def _list_cameras(owns: Sequence[Row]) -> list[str]:
    """Of all cameras."""
    return list(dict.fromkeys(name for own in owns for name in own["cameras"]))


def _describe_readings(against: Mapping[str, int]) -> str:
    """Behind a sentence about refuted poses: how they read."""
    known = {reading: n for reading, n in against.items() if reading != UNKNOWN_CONVENTION}
    readings = " or ".join(f"{reading} ({n})" if len(against) > 1 else reading for reading, n in known.items())
    return f"; they look like {readings}" if known else "; they fit in no reading that is known"


def _build_camera_table(owns: Sequence[Row]) -> ReportTable:
    rows = []
    for name, kinds, reasons in summarise_cameras(owns):
        why = "; ".join(f"{describe_gate(gate)} {share:.1%}" for gate, share in reasons.items())
        rows.append([name, why or "—", *(f"{share:.1%}" for share in kinds.values())])
    return ReportTable("Pixels by camera", ["camera", "silent because", *_CODES_OF_KIND], rows, n_label=2)


def _build_refuted_table(owns: Sequence[Row]) -> ReportTable:
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
    rows = sorted(rows, key=lambda row: -int(row[3]) / int(row[4]))[:_MAX_LISTED_EPISODES]
    note = "See the axes, the direction and the unit of the poses." if rows else ""
    head = ["episode", "camera", "they look like", "frames", "of"]
    return ReportTable("Poses given that the near returns contradict", head, rows, n_label=3, note=note)


def _build_worst_table(owns: Sequence[Row]) -> ReportTable:
    found = []
    for own in owns:
        for name, camera in own["cameras"].items():
            kinds, reasons = _pixel_shares([camera])
            found.append((kinds["silent"], own["number"], name, kinds, reasons, camera["unread"]))
    rows = []
    for _, number, name, kinds, reasons, unread in sorted(found, key=lambda x: (-x[0], x[1], x[2]))[
        :_MAX_LISTED_EPISODES
    ]:
        why = next((describe_gate(gate) for gate in reasons), "—")
        rows.append([str(number), name, why, *(f"{share:.1%}" for share in kinds.values()), str(unread)])
    head = ["episode", "camera", "silent most often because", *_CODES_OF_KIND, "frames not read"]
    return ReportTable("Episodes with least depth first", head, rows, n_label=3)


def _build_time_figure(owns: Sequence[Row]) -> Figure | None:
    """Shares along the episodes, mean over them."""
    panels = []
    for name, mean in _average_over_episodes(owns, "over_time"):
        panel = _make_share_panel(name)
        for kind, codes in _CODES_OF_KIND.items():
            _draw_shares(panel, sum(mean[code] for code in codes), _KIND_COLOURS[kind])
        panels.append(panel)
    keys = [LegendKey(kind, colour, "line") for kind, colour in _KIND_COLOURS.items()]
    return Figure("Along time", "Mean over the episodes, by camera.", panels, keys) if panels else None


def _build_reason_figure(owns: Sequence[Row]) -> Figure | None:
    """The reasons of silence that are most frequent, along the episodes."""
    found = _average_over_episodes(owns, "silent_over_time")
    gates = [gate for gate in _REASON_COLOURS if any(mean[gate].max() > 0 for _, mean in found)]
    gates = sorted(gates, key=lambda gate: -max(float(mean[gate].mean()) for _, mean in found))[:_MAX_DRAWN_REASONS]
    panels = []
    for name, mean in found if gates else []:
        panel = _make_share_panel(name)
        for gate in gates:
            _draw_shares(panel, mean[gate], _REASON_COLOURS[gate])
        panels.append(panel)
    keys = [LegendKey(describe_gate(NO_ANSWER_REASONS[gate]), _REASON_COLOURS[gate], "line") for gate in gates]
    return Figure("Why silent, along time", "Share of all pixels, by camera.", panels, keys) if panels else None


def _average_over_episodes(owns: Sequence[Row], column: str) -> list[tuple[str, np.ndarray]]:
    """Camera and what a column is along time (codes, parts), mean over the episodes; those with two parts at least."""
    found = []
    for name in _list_cameras(owns):
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


def _make_share_panel(name: str) -> Panel:
    return Panel(name, Axis(0, 1, "part of the episode, %", percent=True), Axis(0, 1, "pixels, %", percent=True))


def _draw_shares(panel: Panel, shares: Any, colour: str) -> None:
    panel.line(np.linspace(0, 1, len(shares)).tolist(), shares.tolist(), Stroke(colour, 1.8))
