"""Every figure of the paper that an experiment measures here: paper's line, command, file, our figure, deviation.

Used by ``readme.py`` for docs/results/fidelity.md. The paper's captures are its own, so a deviation is no error of
either side; it says how far a finding carries.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

from cells import read
from cells import table as markdown

from dhtorch.experiments.report.cells import EMPTY_CELL, format_value
from dhtorch.experiments.report.published import PAPER, PublishedTable, parse_printed


class Finding(NamedTuple):
    """A figure of the paper and the entry of a result's summary that stands for it."""

    table: PublishedTable
    line: str
    metric: str
    result: str  # stem of the result file
    entry: str  # of its summary, or as ratio "a / b" of two


def _rows(table: PublishedTable, result: str, lines: dict[str, str], metrics: tuple[str, ...]) -> tuple[Finding, ...]:
    """Findings of several lines (paper's line → our variant) and metrics of one table."""
    return tuple(
        Finding(table, line, metric, result, f"{variant}.{metric}")
        for line, variant in lines.items()
        for metric in metrics
        if metric in table.lines[line]
    )


#: Lines of the paper's table → variants here.
_RANGE_LINES = {
    "device pose (raw)": "device_raw",
    "device pose (GL→CV)": "device_gl_to_cv",
    "no gates": "no_gates",
    "gated": "gated",
}
_GATE_LINES = {
    "gap 30 (default)": "both gates",
    "parallax gate OFF (gap 30)": "parallax gate off",
    "reprojection gate OFF (gap 30)": "reprojection gate off",
}

FINDINGS: tuple[Finding, ...] = (
    Finding(PAPER["latency"], "core front end", "p50_ms", "latency", "paper.front_end.224x224"),
    Finding(PAPER["latency"], "DINOv2-L", "p50_ms", "latency", "dinov2_l.forward.224x224"),
    Finding(PAPER["cross_data"], "TUM RGB-D", "median_rel", "heldout", "paper.median_rel"),
    Finding(PAPER["cross_data"], "TUM RGB-D", "corr", "heldout", "paper.corr"),
    Finding(PAPER["cross_data"], "TUM RGB-D", "ece", "calibration", "paper.heldout.ece"),
    Finding(PAPER["cyclic"], "in-house", "cyclic", "heldout", "paper.cyclic.median_rel"),
    Finding(PAPER["cyclic"], "in-house", "ratio", "heldout", "paper.median_rel / paper.cyclic.median_rel"),
    *_rows(PAPER["range_split"], "range_split", _RANGE_LINES, ("coverage", "corr", "median_rel", "p90_rel")),
    *_rows(
        PAPER["real_holes"],
        "room_real_holes",
        {"no gates": "no_gates", "gated": "gated"},
        ("coverage", "median_rel", "p90_rel"),
    ),
    *_rows(PAPER["gate_ablation"], "gate_ablation", _GATE_LINES, ("corr", "median_rel")),
    Finding(
        PAPER["hole_census"], "indoor", "hole_share.trackable_no_lidar", "hole_census", "hole_share.trackable_no_lidar"
    ),
    Finding(PAPER["device_pose"], "device (VIO) pose", "corr", "device_pose", "device_gl_to_cv.corr"),
    Finding(PAPER["device_pose"], "device (VIO) pose", "corr", "room_device_pose", "device_raw.corr"),
    Finding(PAPER["helix"], "dual-helix correlation", "corr", "helix_correlation", "between_arms.corr"),
    Finding(PAPER["helix"], "plain 2-D optical flow", "corr", "helix_correlation", "flow.corr"),
    Finding(PAPER["icp"], "ICP over it", "n_voxels", "icp", "good + icp points.voxels_vs_pose"),
    Finding(PAPER["hole_attention"], "before", "hole_rate", "hole_attention", "centre.hole_rate"),
    Finding(
        PAPER["hole_attention"],
        "gaze on the largest hole cluster",
        "hole_rate",
        "hole_attention",
        "attention.hole_rate",
    ),
    Finding(PAPER["defocus"], "unsigned", "rho_abs", "defocus", "oracle_side.rho_abs"),
    Finding(PAPER["defocus"], "side from an oracle", "corr", "defocus", "oracle_side.corr"),
    Finding(PAPER["defocus"], "side has to be produced", "corr", "defocus", "by_height.corr"),
    Finding(PAPER["focus_stack"], "clean synthetic", "rank_corr", "focus_stack", "clean.rank_corr"),
    Finding(PAPER["focus_stack"], "clean synthetic", "gated_corr", "focus_stack", "clean.gated_corr"),
    Finding(PAPER["focus_stack"], "real light fields", "abs_corr", "focus_stack", "light_field.abs_corr"),
    Finding(PAPER["focus_stack"], "real light fields", "gated_abs_corr", "focus_stack", "light_field.gated_abs_corr"),
    Finding(PAPER["defocus_fusion"], "bilinear", "corr", "defocus_fusion", "bilinear.corr"),
    Finding(PAPER["future_motion"], "DH-Active", "vs_dinov2", "rh20t_probe", "dhtorch.vs_dinov2"),
    Finding(PAPER["future_motion_moving"], "DH-Active", "vs_dinov2", "rh20t_probe", "dhtorch.moving.vs_dinov2"),
    *(
        Finding(PAPER["visual_odometry"], line, metric, name, f"{arm}.{metric}")
        for name in ("vo_probe", "vo_probe_streams")
        for line, arm in (("DH-Active", "dhtorch"), ("DINOv2", "dinov2"))
        for metric in ("mse", "vs_dinov2")
        if metric in PAPER["visual_odometry"].lines[line]
    ),
)


def table() -> str:
    """The page's table, in Markdown."""
    head = ["paper", "line", "figure", "paper", "here", "95 % interval", "n", "deviation", "file"]
    rows = list(_cells())
    places = ["", *(row[0] for row in rows)]  # a place of the paper stands at its first line
    return markdown(
        head, [[row[0] * (row[0] != last), *row[1:]] for row, last in zip(rows, places, strict=False)], n_label=3
    )


def _cells() -> Iterator[list[str]]:
    for finding in FINDINGS:
        result = read(finding.result)
        printed = finding.table.lines[finding.line][finding.metric]
        entry = _entry(result["summary"], finding)
        metric = "number" if " / " in finding.entry or finding.entry.endswith("_vs_pose") else finding.metric
        interval = [_format(entry.get(bound), metric) for bound in ("low", "high")]
        yield [
            finding.table.where,
            finding.line,
            finding.metric,
            printed,
            _format(entry["value"], metric),
            EMPTY_CELL if EMPTY_CELL in interval else "…".join((interval[0].removesuffix(" %"), interval[1])),
            str(entry.get("n") or EMPTY_CELL),
            _deviation(printed, entry["value"], metric),
            f"`{finding.result}`",
        ]


def _entry(summary: dict[str, Any], finding: Finding) -> dict[str, Any]:
    """The entry of a finding; of a ratio the value alone.

    Raises:
        KeyError: the result has no such entry.
    """
    if " / " not in finding.entry:
        entry: dict[str, Any] = summary[finding.entry]
        return entry
    a, b = (summary[name] for name in finding.entry.split(" / "))
    return {"value": a["value"] / b["value"] if a["value"] is not None and b["value"] else None, "n": a.get("n")}


def _format(value: float | None, metric: str) -> str:
    return EMPTY_CELL if value is None else format_value(value, metric)


def _deviation(printed: str, value: float | None, metric: str) -> str:
    """Ours minus the paper's; a factor where the figure is a time or a ratio; a dash where the paper has no number."""
    theirs = parse_printed(printed.strip("∼≈ ×"))
    if theirs is None or value is None:
        return EMPTY_CELL
    if metric.endswith("_ms") or metric == "number":
        return f"× {value / theirs:.2g}"
    sign = "+" if value >= theirs else "−"
    return sign + format_value(abs(value - theirs), metric)
