"""Access to archived results: variants, cohorts, rows of scenes, metrics of rows and of the summary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Result = Mapping[str, Any]
Row = Mapping[str, Any]

#: Fields of a row that are not metrics.
NON_METRIC_FIELDS = ("scene", "pair", "method", "truth", "role", "note", "curves", "overlay")


def variant_names(result: Result) -> list[str]:
    """Names of the variants, in the order of the rows."""
    return list(dict.fromkeys(row["method"] for row in result["rows"]))


def cohort_names(result: Result) -> list[str | None]:
    """Names of the kinds of ground truth, in the order of the rows."""
    return list(dict.fromkeys(row.get("truth") for row in result["rows"]))


def last_cohort(result: Result) -> str | None:
    """Cohort of the verdict: the one whose name is omitted in the summary."""
    cohorts = cohort_names(result) or [None]
    if len(cohorts) == 1:
        return cohorts[0]
    variants, names = variant_names(result), list(result["summary"])
    unnamed = (t for t in reversed(cohorts) if not any(f"{v}.{t}." in name for v in variants for name in names))
    return next(unnamed, cohorts[-1])


def scene_rows(result: Result, truth: str | None = None, variant: str | None = None) -> list[Row]:
    """Rows of scenes, of one cohort and variant or of all."""
    rows = [row for row in result["rows"] if row["pair"] is None and truth in (None, row.get("truth"))]
    return [row for row in rows if variant in (None, row["method"])]


def deciding_rows(result: Result) -> list[Row]:
    """Rows of scenes of the cohort of the verdict."""
    return scene_rows(result, last_cohort(result))


def scene_label(row: Row) -> str:
    """Name of a scene with its role."""
    return f"{row['scene']} ({row['role']})" if row.get("role") else str(row["scene"])


def metric_value(row: Row, metric: str) -> Any:
    """Value of a metric in a row; a dotted name is a member of a group."""
    if metric in row or "." not in metric:
        return row.get(metric)
    group, _, rest = metric.partition(".")
    inner = row.get(group)
    return metric_value(inner, rest) if isinstance(inner, Mapping) else None


def summary_entry(result: Result, variant: str, metric: str, truth: str | None = None) -> Mapping[str, Any]:
    """Summary entry of a metric; its key omits the name of a single variant and that of the last cohort."""
    last = truth is None or truth == last_cohort(result)
    names = [f"{variant}.{metric}"] if last else [f"{variant}.{truth}.{metric}"]
    names += [metric] if last and len(variant_names(result)) == 1 else []
    return next((result["summary"][n] for n in names if n in result["summary"]), {})


def flatten_row(row: Row, prefix: str = "") -> dict[str, Any]:
    """Metrics of a row as a flat dictionary, groups as ``group.member``, without curves and overlays."""
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if not prefix and name in NON_METRIC_FIELDS:
            continue
        if isinstance(value, Mapping):
            flat |= flatten_row(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


def describe_result(result: Result) -> str:
    """One line of text: experiment, data, verdict, time and code version."""
    verdict = f", {result['verdict']}" if result["verdict"] else ""
    meta = result["meta"]
    return (
        f"{result['experiment']} on {result['data']['name']}{verdict} ({meta['utc']}, code {meta['git'] or 'unknown'})"
    )
