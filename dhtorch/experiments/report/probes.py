"""Tables of the probes: error of every arm and its ratios to the context and to DINOv2, with the paper's ratio."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dhtorch.experiments.report import published
from dhtorch.experiments.report.cells import EMPTY_CELL, format_metric_interval, format_value
from dhtorch.experiments.report.published import PublishedTable
from dhtorch.experiments.report.reading import Result, Row, scene_rows, summary_entry, variant_names
from dhtorch.experiments.report.tables import INTERVAL_LABEL, PUBLISHED_LABEL, ReportTable, published_source

#: Our arm → the paper's line.
_PUBLISHED_ARMS = {"dhtorch": "DH-Active", "dinov2": "DINOv2"}

#: Arm whose row stands for a scene that was left out.
_FIRST_ARM = "context"

_RANDOM_WEIGHTS_NOTE = "DINOv2 with random weights: its lines are no evidence about DINOv2."


def future_motion_tables(result: Result) -> list[ReportTable]:
    """Tables of the probe of future motion: all samples, and those that move."""
    cohorts = (
        ("", "all samples", published.FUTURE_MOTION),
        ("moving.", "samples that move", published.FUTURE_MOTION_MOVING),
    )
    heads = [
        "",
        "error",
        INTERVAL_LABEL,
        "× context",
        INTERVAL_LABEL,
        "× DINOv2",
        INTERVAL_LABEL,
        "90 % interval",
        PUBLISHED_LABEL,
    ]
    tables = []
    for prefix, label, table in cohorts:
        rows = []
        for arm in variant_names(result):
            cells = [_label(result, arm)]
            for name in ("mse", "vs_context", "vs_dinov2"):
                e = summary_entry(result, arm, prefix + name)
                cells += [_format_number(e.get("value")), _format_interval(e)]
            cells += [_format_interval(summary_entry(result, arm, f"{prefix}vs_dinov2_90"))]
            rows.append([*cells, table.lines.get(_PUBLISHED_ARMS.get(arm, ""), {}).get("vs_dinov2", EMPTY_CELL)])
        title = f"Future motion of the hand, tasks held out, {label}; error in units of the targets' variance"
        tables.append(ReportTable(title, heads, rows, note=_note(result, table)))
    return tables


def visual_odometry_tables(result: Result) -> list[ReportTable]:
    """Table of the probe of camera motion: one row per scene and arm, then the paper's lines."""
    heads = ["scene", "arm", "pairs", "error", "× mean motion", "× DINOv2", INTERVAL_LABEL]
    rows = []
    for row in scene_rows(result):
        if row.get("note"):
            if row["method"] == _FIRST_ARM:
                rows.append([row["scene"], row["note"], *[EMPTY_CELL] * 5])
            continue
        numbers = [_format_number(row.get(name)) for name in ("mse", "vs_context", "vs_dinov2")]
        arm = "mean motion" if row["method"] == "context" else _label(result, row["method"])
        rows.append(
            [
                row["scene"],
                arm,
                format_value(row.get("n_samples"), how="count"),
                *numbers,
                _format_interval(_ratio_interval(row)),
            ]
        )
    table = published.VISUAL_ODOMETRY
    cited = [
        [
            f"{PUBLISHED_LABEL}: one scene",
            name,
            EMPTY_CELL,
            cells["mse"],
            EMPTY_CELL,
            cells.get("vs_dinov2", EMPTY_CELL),
            "",
        ]
        for name, cells in table.lines.items()
    ]
    title = "Motion of the camera within a scene, blocks held out; error in units of the targets' variance"
    return [ReportTable(title, heads, rows + cited, 2, quoted=len(cited), note=_note(result, table))]


def downstream_tables(result: Result) -> list[ReportTable]:
    """Table of the probe of enriched sets: one row per arm, for blocks and for streams held out."""
    heads = ["held out", "arm", "samples", "error", "× context", INTERVAL_LABEL, "× sensor", INTERVAL_LABEL]
    rows = []
    for row in scene_rows(result):
        cells = [row["scene"].removesuffix(" held out"), _label(result, row["method"])]
        cells += [format_value(row.get("n_samples"), how="count"), _format_number(row.get("mse"))]
        for name in ("vs_context", "vs_sensor"):
            interval = {"low": row.get(f"{name}_low"), "high": row.get(f"{name}_high")}
            cells += [_format_number(row.get(name)), _format_interval(interval)]
        rows.append(cells)
    title = "Next motion of the camera, from enriched sets; error in units of the targets' variance"
    note = "" if _weights(result) else _RANDOM_WEIGHTS_NOTE
    return [ReportTable(title, heads, rows, 2, note=note)]


def _label(result: Result, arm: str) -> str:
    """Name of an arm, marked if DINOv2 has random weights."""
    return f"{arm} (random weights)" if "dinov2" in arm and not _weights(result) else arm


def _weights(result: Result) -> Any:
    """Folder of the weights of DINOv2 in the configuration; None for random weights."""
    network: Mapping[str, Any] = result["config"].get("experiment", {}).get("dinov2") or {}
    return network.get("weights")


def _note(result: Result, table: PublishedTable) -> str:
    """Source of the paper's figures, and a note on random weights."""
    return " ".join((published_source(result, table), *([] if _weights(result) else [_RANDOM_WEIGHTS_NOTE])))


def _ratio_interval(row: Row) -> dict[str, float | None]:
    """Interval of the ratio to DINOv2 in a row."""
    return {"low": row.get("vs_dinov2_low"), "high": row.get("vs_dinov2_high")}


def _format_number(value: float | None) -> str:
    """Cell with three decimals."""
    return format_value(value, how="fine")


def _format_interval(entry: Mapping[str, Any]) -> str:
    """Cell with the interval of an entry."""
    return format_metric_interval(entry.get("low"), entry.get("high"), "ece")
