"""Reading an archived result: its variants and cohorts, rows of scenes, numbers of rows and summary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Result = Mapping[str, Any]
Row = Mapping[str, Any]

#: Fields of a row that are no measurement.
NON_METRIC_FIELDS = ("scene", "pair", "method", "truth", "role", "note", "curves", "overlay")


def variant_names(result: Result) -> list[str]:
    """Names in the order of the rows."""
    return list(dict.fromkeys(row["method"] for row in result["rows"]))


def cohort_names(result: Result) -> list[str | None]:
    """What answers are held against, in the order of the rows."""
    return list(dict.fromkeys(row.get("truth") for row in result["rows"]))


def last_cohort(result: Result) -> str | None:
    """The cohort that decides: the one whose name the summary leaves out."""
    found = cohort_names(result) or [None]
    if len(found) == 1:
        return found[0]
    known, names = variant_names(result), list(result["summary"])
    unnamed = (t for t in reversed(found) if not any(f"{v}.{t}." in name for v in known for name in names))
    return next(unnamed, found[-1])


def scene_rows(result: Result, truth: str | None = None, variant: str | None = None) -> list[Row]:
    """Rows of scenes: of one cohort and one variant, or of all."""
    found = [row for row in result["rows"] if row["pair"] is None and truth in (None, row.get("truth"))]
    return [row for row in found if variant in (None, row["method"])]


def metric_value(row: Row, metric: str) -> Any:
    """A number of a row; a dotted name looks into its groups."""
    if metric in row or "." not in metric:
        return row.get(metric)
    group, _, rest = metric.partition(".")
    inner = row.get(group)
    return metric_value(inner, rest) if isinstance(inner, Mapping) else None


def summary_entry(result: Result, variant: str, metric: str, truth: str | None = None) -> Mapping[str, Any]:
    """Summary of a metric; it bears no variant's name where there is but one, and no cohort's for the last."""
    last = truth is None or truth == last_cohort(result)
    names = [f"{variant}.{metric}"] if last else [f"{variant}.{truth}.{metric}"]
    names += [metric] if last and len(variant_names(result)) == 1 else []
    return next((result["summary"][n] for n in names if n in result["summary"]), {})


def flatten_row(row: Row, prefix: str = "") -> dict[str, Any]:
    """The measurements of a row, groups as ``group.member``; curves and overlays are left to the figures."""
    flat: dict[str, Any] = {}
    for name, found in row.items():
        if not prefix and name in NON_METRIC_FIELDS:
            continue
        if isinstance(found, Mapping):
            flat |= flatten_row(found, f"{prefix}{name}.")
        else:
            flat[prefix + name] = found
    return flat


def describe_result(result: Result) -> str:
    """One line: experiment, data, verdict, when and with which code."""
    verdict = f", {result['verdict']}" if result["verdict"] else ""
    meta = result["meta"]
    return (
        f"{result['experiment']} on {result['data']['name']}{verdict} ({meta['utc']}, code {meta['git'] or 'unknown'})"
    )
