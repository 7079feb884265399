"""HTML report of an enriched data set: outcome of its pixels by camera, over time and by episode."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dhtorch.cli.gate_messages import describe_gate
from dhtorch.codes import SOURCES_OF_KIND, Gate, Source, count_kinds, names, words
from dhtorch.experiments.report.figures import Figure
from dhtorch.experiments.report.page import PAGE_CSS, figures_markup, table_markup
from dhtorch.experiments.report.tables import ReportTable
from dhtorch.export.lerobot import LogHistogram
from dhtorch.extract.enriched import NO_ANSWER_REASONS, NO_OTHER_VIEW
from dhtorch.extract.origin import REPORT_FILES
from dhtorch.extract.targets import UNKNOWN_CONVENTION
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count
from dhtorch.viz.plots import add_legend, make_figure, set_axis, set_title
from dhtorch.viz.plots.colours import FILLED, GATE_COLOURS, RECOVERED, SENSOR, SOFT, UNANSWERED
from dhtorch.viz.plots.markup import build_document, make_tag

Row = Mapping[str, Any]

#: Episodes listed, those with least depth first.
_MAX_LISTED_EPISODES = 10

#: Reasons for missing answers drawn in the figure, the most frequent first.
_MAX_DRAWN_REASONS = 4

#: Smallest fraction of the pixels of a reason that is listed.
_MIN_REASON_SHARE = 5e-4

_REASON_COLOURS = {**GATE_COLOURS, NO_OTHER_VIEW: SOFT}
_KIND_COLOURS = {"recovered": RECOVERED, "filled": FILLED, "sensor": SENSOR, "no_answer": UNANSWERED}


class CameraSummary(NamedTuple):
    """Outcome of the pixels of one camera."""

    name: str
    kinds: dict[str, float]  # fractions of the pixels by kind, see codes.SOURCES_OF_KIND
    reasons: dict[str, float]  # fractions of the pixels without an answer by gate, the largest first
    sigma_rel: float  # median sigma / depth of the recovered pixels; NaN = none

    def format_kinds(self) -> dict[str, str]:
        """The fractions as text, with the median sigma of the recovered pixels."""
        shown = {kind: f"{fraction:.1%}" for kind, fraction in self.kinds.items()}
        if self.kinds["recovered"] and math.isfinite(self.sigma_rel):
            shown["recovered"] += f" (median sigma {self.sigma_rel:.1%} of the depth)"
        return shown


def summarise_cameras(owns: Sequence[Row]) -> list[CameraSummary]:
    """Outcome of the pixels per camera."""
    summaries = []
    for name in _list_cameras(owns):
        rows = [own["cameras"][name] for own in owns if name in own["cameras"]]
        bins = [LogHistogram.parse(row["recovered_sigma_rel_bins"]) for row in rows]
        summaries.append(CameraSummary(name, *_pixel_shares(rows), reduce(add, bins).quantile(0.5)))
    return summaries


def describe_refuted_poses(owns: Sequence[Row]) -> list[str]:
    """One sentence per camera whose input poses contradict the near returns: number of frames, likely convention."""
    sentences = []
    for name in _list_cameras(owns):
        cameras = [own["cameras"][name] for own in owns if name in own["cameras"]]
        refuted = sum((Counter(camera["refuted"]) for camera in cameras), Counter())
        if refuted:
            frames = f"{refuted.total()} of {format_count(sum(camera['frames'] for camera in cameras), 'frame')}"
            sentences.append(
                f"{name}: the input poses contradict the near returns in {frames}{_describe_readings(refuted)}"
            )
    return sentences


def page_files(folder: Path) -> tuple[Path, Path]:
    """The files that :func:`write_enrich_page` writes: numbers and page."""
    numbers, page = REPORT_FILES
    return folder / numbers, folder / page


def write_enrich_page(folder: Path, about: Row, owns: Sequence[Row]) -> Path:
    """Write the page and its numbers as JSON; returns the path of the page."""
    listed = [{k: own[k] for k in ("number", "length", "cameras")} for own in owns]
    codes = {"pixels": names(Source), "no_answer": NO_ANSWER_REASONS}
    numbers, page = page_files(folder)
    storage.write_json(numbers, {"data": about["data"], "codes": codes, "episodes": listed})
    return storage.replace_file(page, _build_page(about, owns).encode("utf-8"))


def _build_page(about: Row, owns: Sequence[Row]) -> str:
    """The page as HTML.

    Args:
        about: metadata shared by all episodes.
        owns: statistics of each episode, from :class:`dhtorch.extract.targets.DatasetTarget`.
    """
    title = f"{about['data']['source']}: outcome of its pixels"
    frames = sum(own["length"] for own in owns)
    step = f"depth in steps of {1e3 * about['step_m']:.3g} mm" if about["step_m"] else "depth not quantised"
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
    readable = [c for c in cameras if c["pixels"]]
    if not readable:
        return dict.fromkeys(SOURCES_OF_KIND, 0.0) | {"no_answer": 1.0}, {}
    pixels = np.sum([np.array(c["pixels"], float) for c in readable], 0)
    no_answer = np.sum([np.array(c["no_answer"], float) for c in readable], 0)
    total = max(1.0, float(np.sum(pixels)))
    kinds = {kind: float(n) / total for kind, n in count_kinds(pixels).items()}
    gates = {name: float(no_answer[code]) / total for code, name in NO_ANSWER_REASONS.items() if code != Gate.ANSWER}
    return kinds, {
        name: share for name, share in sorted(gates.items(), key=lambda x: -x[1]) if share >= _MIN_REASON_SHARE
    }


def _list_cameras(owns: Sequence[Row]) -> list[str]:
    """Names of all cameras, in order of appearance."""
    return list(dict.fromkeys(name for own in owns for name in own["cameras"]))


def _describe_readings(refuted: Mapping[str, int]) -> str:
    """End of the sentence about refuted poses: the conventions that would fit."""
    known_readings = {reading: n for reading, n in refuted.items() if reading != UNKNOWN_CONVENTION}
    readings = " or ".join(f"{reading} ({n})" if len(refuted) > 1 else reading for reading, n in known_readings.items())
    return f"; they fit as {readings}" if known_readings else "; no known convention fits"


def _build_camera_table(owns: Sequence[Row]) -> ReportTable:
    rows = []
    for camera in summarise_cameras(owns):
        breakdown = "; ".join(f"{describe_gate(gate)} {share:.1%}" for gate, share in camera.reasons.items())
        rows.append([camera.name, breakdown or "—", *camera.format_kinds().values()])
    head = ["camera", "no answer because", *map(words, SOURCES_OF_KIND)]
    return ReportTable("Pixels by camera", head, rows, n_label=2)


def _build_refuted_table(owns: Sequence[Row]) -> ReportTable:
    """Table of episodes and cameras whose input poses contradict the near returns."""
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
    note = "Check the axes, the direction (camera to world or back) and the unit of the poses." if rows else ""
    head = ["episode", "camera", "they fit as", "frames", "of"]
    return ReportTable("Input poses that contradict the near returns", head, rows, n_label=3, note=note)


def _build_worst_table(owns: Sequence[Row]) -> ReportTable:
    cameras_by_episode = []
    for own in owns:
        for name, camera in own["cameras"].items():
            kinds, reasons = _pixel_shares([camera])
            cameras_by_episode.append((kinds["no_answer"], own["number"], name, kinds, reasons, camera["unread"]))
    rows = []
    for _, number, name, kinds, reasons, unread in sorted(cameras_by_episode, key=lambda x: (-x[0], x[1], x[2]))[
        :_MAX_LISTED_EPISODES
    ]:
        reason = next((describe_gate(gate) for gate in reasons), "—")
        rows.append([str(number), name, reason, *(f"{share:.1%}" for share in kinds.values()), str(unread)])
    head = ["episode", "camera", "most frequent reason for no answer", *map(words, SOURCES_OF_KIND), "frames not read"]
    return ReportTable("Episodes with least depth first", head, rows, n_label=3)


def _build_time_figure(owns: Sequence[Row]) -> Figure | None:
    """Fractions of pixels by kind over episode time, averaged over the episodes."""
    kinds = {name: count_kinds(mean) for name, mean in _average_over_episodes(owns, "over_time")}
    curves = {name: {words(kind): values for kind, values in of.items()} for name, of in kinds.items()}
    colours = {words(kind): colour for kind, colour in _KIND_COLOURS.items()}
    return _draw_over_time("Over time", "Mean over the episodes, by camera.", curves, colours)


def _build_reason_figure(owns: Sequence[Row]) -> Figure | None:
    """Most frequent reasons for missing answers over episode time."""
    averages = _average_over_episodes(owns, "no_answer_over_time")
    gates = [gate for gate in _REASON_COLOURS if any(mean[gate].max() > 0 for _, mean in averages)]
    gates = sorted(gates, key=lambda gate: -max(float(mean[gate].mean()) for _, mean in averages))[:_MAX_DRAWN_REASONS]
    reasons = {gate: describe_gate(NO_ANSWER_REASONS[gate]) for gate in gates}
    curves = {name: {reasons[gate]: mean[gate] for gate in gates} for name, mean in averages if gates}
    colours = {reasons[gate]: _REASON_COLOURS[gate] for gate in gates}
    return _draw_over_time("Reasons for no answer over time", "Fraction of all pixels, by camera.", curves, colours)


def _draw_over_time(
    title: str, caption: str, curves: Mapping[str, Mapping[str, Any]], colours: Mapping[str, str]
) -> Figure | None:
    """Figure of fractions of the pixels over episode time: camera → name → values; None without cameras."""
    if not curves:
        return None
    figure, panels = make_figure(len(curves))
    for axes, (camera, of_camera) in zip(panels, curves.items(), strict=True):
        for name, values in of_camera.items():
            axes.plot(np.linspace(0, 1, len(values)), values, color=colours[name], linewidth=1.8)
        for axis, label in (("x", "time in the episode, %"), ("y", "pixels, %")):
            set_axis(axes, axis, label, percent=True, limits=(0.0, 1.0))
        set_title(axes, camera)
    add_legend(figure, {name: {"color": colour, "linewidth": 1.8} for name, colour in colours.items()})
    return Figure(title, caption, figure)


def _average_over_episodes(owns: Sequence[Row], column: str) -> list[tuple[str, np.ndarray]]:
    """Per camera: name and a column over time (parts, codes), averaged over the episodes; needs at least two parts."""
    averages = []
    for name in _list_cameras(owns):
        shares = [np.array(own["cameras"][name][column]) for own in owns if name in own["cameras"]]
        longest = max((len(x) for x in shares if len(x)), default=0)
        if longest < 2:
            continue
        times = np.linspace(0, 1, longest)
        resampled = [
            [np.interp(times, np.linspace(0, 1, len(x)), x[:, c]) for c in range(x.shape[1])] for x in shares if len(x)
        ]
        averages.append((name, np.mean(resampled, 0)))
    return averages
