"""HTML report of an enriched data set (its pixels by camera, over time and by episode), and its data set card.

The card of a LeRobot set is ``README.md`` with the tags of the Hugging Face hub: cameras with their intrinsics, where
their depth comes from and how exact it is, versions, the licence of the source, and how the set is loaded and trained
on. The card of the source is kept as ``README.source.md``.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dhtorch.cli.gate_messages import describe_gate
from dhtorch.codes import SOURCES_OF_KIND, Gate, Source, count_kinds, names, words
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import import_optional
from dhtorch.experiments.report.figures import Figure
from dhtorch.experiments.report.page import PAGE_CSS, figures_markup, table_markup
from dhtorch.experiments.report.tables import ReportTable
from dhtorch.export.lerobot import LogHistogram
from dhtorch.extract.enriched import NO_ANSWER_REASONS, NO_OTHER_VIEW
from dhtorch.extract.origin import REPORT_FILES, SOURCE_CARD
from dhtorch.extract.policy_columns import N_POINTS
from dhtorch.extract.robot_target import LeRobotTarget
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
            known = {reading: n for reading, n in refuted.items() if reading != UNKNOWN_CONVENTION}
            fits = " or ".join(f"{reading} ({n})" if len(refuted) > 1 else reading for reading, n in known.items())
            end = f"they fit as {fits}" if known else "no known convention fits"
            sentences.append(f"{name}: the input poses contradict the near returns in {frames}; {end}")
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
    # The page as HTML
    title = f"{about['data']['source']}: outcome of its pixels"
    frames = sum(own["length"] for own in owns)
    step = f"depth in steps of {1e3 * about['step_m']:.3g} mm" if about["step_m"] else "depth not quantised"
    episodes = f"{format_count(len(owns), 'episode')}, {format_count(frames, 'frame')}"
    lead = f"{episodes}; {step}; dhtorch {about['version']}, method {about['method']}"
    tables = (_build_camera_table(owns), _build_refuted_table(owns), _build_worst_table(owns))
    parts = [
        *(table_markup(table) for table in tables if table.rows),
        figures_markup([f for f in (_build_time_figure(owns), _build_reason_figure(owns)) if f is not None]),
    ]
    top = make_tag("header", make_tag("h1", title), make_tag("p", lead, class_="lead"))
    return storage.replace_file(
        page, build_document(title, top, make_tag("main", *parts), own=PAGE_CSS).encode("utf-8")
    )


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


# ------------------------------------------------------------------------------------------------------ data set card

#: Name of the card.
CARD = "README.md"

#: ``license:`` in the head of a card, as the hub writes identifiers of licences.
_LICENCE = re.compile(r"\A---\n(?:.*\n)*?license:[ \t]*[\"']?([A-Za-z0-9][A-Za-z0-9.\-]{0,40})[\"']?[ \t]*\n")


def write_enrich_card(target: LeRobotTarget, about: Mapping[str, Any], owns: Sequence[Mapping[str, Any]]) -> Path:
    """Write the card of a complete set; ``about``: metadata of all files, ``owns``: summaries of all episodes."""
    root = target.root
    info = files.read_json(root / "meta" / "info.json")
    stats = files.read_json(root / "meta" / "stats.json")
    card = root / SOURCE_CARD
    stated = _LICENCE.match(files.read_text(card).replace("\r\n", "\n")) if card.is_file() else None
    licence = None if stated is None else stated[1]
    source = _plain(about["data"]["source"])
    head = ["---", *([f"license: {licence}"] if licence else []), "task_categories:", "- robotics", "tags:"]
    head += ["- LeRobot", "- depth", "- dhtorch", "configs:", "- config_name: default"]
    head += ["  data_files: data/*/*.parquet", "---", "", f"# {_plain(about['data']['name'])} with depth", ""]
    frames = format_count(info["total_frames"], "frame")
    size = f"{format_count(info['total_episodes'], 'episode')}, {frames} at {info['fps']:g} per second"
    writer = f"dhtorch {about['version']} (`dhtorch enrich`, method {about['method']})"
    code = info["codebase_version"]
    body = [f"LeRobot {code} set, written from `{source}` by {writer}: {size}.", ""]
    columns = (
        "camera",
        "picture",
        "map",
        "fx, fy, cx, cy (px)",
        *map(words, SOURCES_OF_KIND),
        "depth (m)",
        "sigma (m)",
    )
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    cameras = {camera.name: camera for camera in summarise_cameras(owns)}
    # Of each camera fx, fy, cx, cy of the first row that has them
    parquet, K = import_optional("pyarrow.parquet"), {}
    present = set(parquet.read_schema(target.file(0)).names)
    for key, view in target.views.items():
        column = f"observation.{view.name}.intrinsics"
        if column in present:
            rows = np.array(parquet.read_table(target.file(0), columns=[column]).column(column).to_pylist(), np.float64)
            valid = rows[np.isfinite(rows).all(1)] if rows.ndim == 2 and rows.shape[1] == 9 else rows[:0]
            if len(valid):
                K[key] = valid[0][[0, 4, 2, 5]].tolist()
    for key, view in target.views.items():
        camera = cameras.get(view.name)
        percent = ["0.0%"] * len(SOURCES_OF_KIND) if camera is None else camera.format_kinds().values()
        numbers = K.get(key)
        lens = "unknown" if numbers is None else ", ".join(f"{x:.1f}" for x in numbers)
        depth, sigma = (stats.get(target.keys[key].get(name, "")) for name in ("depth", "sigma"))
        span = typical = "–"
        if camera is not None and camera.kinds["no_answer"] != 1 and depth is not None:
            low, high = (float(np.ravel(depth[name])[0]) for name in ("q01", "q99"))
            span = f"{low:.2f}–{high:.2f}"
            typical = "–" if sigma is None else f"{float(np.ravel(sigma['q50'])[0]):.4f}"
        sizes = [f"{w}×{h}" for h, w in (view.hw, view.map_hw)]
        lines.append(f"| {' | '.join([f'`{key}`', *sizes, lens, *percent, span, typical])} |")
    body += ["## Cameras", "", *lines, ""]
    body += [*_describe_maps(target, about, info), ""]
    known = f"`{licence}`, by its card (`{SOURCE_CARD}`)" if licence else "not stated by the source"
    body += ["## Licence", "", f"Pictures, states and actions are the source's: {known}.", ""]
    return storage.replace_file(
        target.root / CARD, ("\n".join([*head, *body, *_describe_loading(target, info)]) + "\n").encode("utf-8")
    )


def _describe_maps(target: LeRobotTarget, about: Mapping[str, Any], info: Mapping[str, Any]) -> list[str]:
    """Sentences on the columns of a camera, and how the set is loaded and trained on."""
    keys = target.keys[next(iter(target.views))]
    step = f"in steps of {1e3 * about['step_m']:.3g} mm" if about["step_m"] else "not quantised"
    form = "32-bit TIFF" if target.as_images else "an array of numbers (1, h, w)"
    lines = [
        f"`{keys['depth']}` is {form} in metres, {step}; **0 = no depth**, which is no distance: mask it",
        "before depth is normalised. Statistics in `meta/stats.json` are over answered pixels, their range holds the",
        "values from the 1 % to the 99 % quantile, as the depths of the table do; its sigma is the median.",
    ]
    if "sigma" in keys:
        lines.append(f"`{keys['sigma']}` is the standard deviation of the depth, in metres.")
    if "source" in keys:
        codes = ", ".join(f"{code} {name.lower()}" for code, name in names(Source).items())
        lines.append(f"`{keys['source']}` is where a depth comes from: {codes}.")
    if "geometry_image" in keys:
        stated = info["features"][keys["geometry_image"]]["info"]
        decoding = stated["geometry_image"]
        lines += [
            f"`{keys['geometry_image']}` is a video without loss ({stated['video.codec']}, {stated['video.pix_fmt']}) "
            "of bytes that decode as",
            f"`depth_m = {decoding['depth_m']}`,",
            f"`sigma_m = {decoding['sigma_m']}`,",
            f"`source = {decoding['source']}` (`{decoding['function']}`);",
            "encoded again with loss, its depth is no longer exact to half a code.",
        ]
    if "point_cloud" in keys:
        lines += [
            f"`{keys['point_cloud']}` is {N_POINTS} points (x right, y down, z forward) in metres",
            "of the camera, by pixels with a depth in a fixed order; they repeat where there are fewer, and are",
            "all 0 in a frame without depth. Its first points are a smaller cloud of the whole picture.",
        ]
    if "K" in keys:
        lines.append(f"`{keys['K']}` is K of the picture by rows; pixel centres are whole numbers.")
    return lines


def _describe_loading(target: LeRobotTarget, info: Mapping[str, Any]) -> list[str]:
    """How the set is loaded and trained on."""
    depth = target.keys[next(iter(target.views))]["depth"]
    lines = ["## Loading", "", "```python", "from lerobot.datasets.lerobot_dataset import LeRobotDataset", ""]
    lines += [
        'dataset = LeRobotDataset("local/set", root="THIS_FOLDER")',
        f'depth = dataset[0]["{depth}"]  # (1, h, w)',
    ]
    lines += ["```"]
    if {"action", "observation.state"} <= info["features"].keys() and not target.as_images:
        train = "lerobot-train --dataset.repo_id=local/set --dataset.root=THIS_FOLDER --policy.type=act"
        lines += ["", "```bash", f"{train} --policy.push_to_hub=false", "```"]
    return lines


def _plain(text: Any) -> str:
    """Text in one line without marks of tables and code."""
    return re.sub(r"[\s|`<>]+", " ", str(text)).strip()
