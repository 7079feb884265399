"""Probes: every arm's error, as it is and as a multiple of the context's and of DINOv2's, beside the paper's ratio."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dhtorch.experiments.report import published
from dhtorch.experiments.report.cells import NOTHING, between, show
from dhtorch.experiments.report.published import Published
from dhtorch.experiments.report.reading import Result, Row, entry, scene_rows, variants
from dhtorch.experiments.report.tables import INTERVAL, PUBLISHED, Table, source

#: Our arm → the paper's line.
KNOWN = {"dhtorch": "DH-Active", "dinov2": "DINOv2"}

#: Of a scene that was left out one line is enough.
_FIRST = "context"

_RANDOM = "DINOv2 with random weights: its lines say nothing about DINOv2."


def future_motion(result: Result) -> list[Table]:
    """Tables of the probe of future motion: all samples, and those that move."""
    cohorts = (("", "all samples", published.PROBE), ("moving.", "samples that move", published.PROBE_MOVING))
    heads = ["", "error", INTERVAL, "× context", INTERVAL, "× DINOv2", INTERVAL, "90 % interval", PUBLISHED]
    found = []
    for prefix, words, theirs in cohorts:
        rows = []
        for arm in variants(result):
            cells = [_label(result, arm)]
            for name in ("mse", "vs_context", "vs_dinov2"):
                e = entry(result, arm, prefix + name)
                cells += [_number(e.get("value")), _spread(e)]
            cells += [_spread(entry(result, arm, f"{prefix}vs_dinov2_90"))]
            rows.append([*cells, theirs.lines.get(KNOWN.get(arm, ""), {}).get("vs_dinov2", NOTHING)])
        title = f"Future motion of the hand, tasks held out, {words}; error in units of the targets' variance"
        found.append(Table(title, heads, rows, note=_note(result, theirs)))
    return found


def visual_odometry(result: Result) -> list[Table]:
    """One row per scene and arm, then the paper's."""
    heads = ["scene", "arm", "pairs", "error", "× mean motion", "× DINOv2", INTERVAL]
    rows = []
    for row in scene_rows(result):
        if row.get("note"):
            if row["method"] == _FIRST:
                rows.append([row["scene"], row["note"], *[NOTHING] * 5])
            continue
        numbers = [_number(row.get(name)) for name in ("mse", "vs_context", "vs_dinov2")]
        arm = "mean motion" if row["method"] == "context" else _label(result, row["method"])
        rows.append([row["scene"], arm, show(row["n_samples"], how="count"), *numbers, _spread(_interval(row))])
    theirs = published.VISUAL_ODOMETRY
    cited = [
        [f"{PUBLISHED}: one scene", name, NOTHING, cells["mse"], NOTHING, cells.get("vs_dinov2", NOTHING), ""]
        for name, cells in theirs.lines.items()
    ]
    title = "Motion of the camera within a scene, blocks held out; error in units of the targets' variance"
    return [Table(title, heads, rows + cited, 2, quoted=len(cited), note=_note(result, theirs))]


def _label(result: Result, arm: str) -> str:
    return f"{arm} (random weights)" if "dinov2" in arm and not _weights(result) else arm


def _weights(result: Result) -> Any:
    network: Mapping[str, Any] = result["config"].get("experiment", {}).get("dinov2") or {}
    return network.get("weights")


def _note(result: Result, theirs: Published) -> str:
    return " ".join((source(result, theirs), *([] if _weights(result) else [_RANDOM])))


def _interval(row: Row) -> dict[str, float | None]:
    return {"low": row.get("vs_dinov2_low"), "high": row.get("vs_dinov2_high")}


def _number(value: float | None) -> str:
    return show(value, how="fine")


def _spread(found: Mapping[str, Any]) -> str:
    return between(found.get("low"), found.get("high"), "ece")
