"""Values of archived results (variants, cohorts, rows of scenes, metrics of rows and summary), and their cells."""

import math
from collections.abc import Mapping
from typing import Any

from dhtorch.codes import words

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


#: Cell without a value.
EMPTY_CELL = "–"

#: Metric → heading; other metrics have their name as heading.
_METRIC_HEADINGS = {
    "n_candidates": "candidates",
    "n_kept": "answers",
    "n_scenes": "scenes",
    "n_recovered": "holes recovered",
    "n_real_holes": "real holes",
    "truth_kept": "truth kept",
    "n_views": "views",
    "median_rel": "median",
    "p90_rel": "p90",
    "residual_px": "residual px",
    "pnp_success": "pose found",
    "wrong_share": "> 20 % off",
    "aurc": "AURC",
    "aurc_excess": "excess AURC",
    "augrc": "AUGRC",
    "ece": "ECE",
    "ece_equal_mass": "ECE, equal mass",
    "hole_share.trackable_no_lidar": "trackable, no LiDAR",
    "trackability_hole": "trackability, holes",
    "trackability_valid": "trackability, returns",
    "rotation_deg": "rotation error °",
    "translation_m": "translation error m",
    "baseline_m": "baseline m",
    "cutoff_m": "cutoff m",
    "direction_deg": "direction error °",
    "reach_p95_m": "reach p95 m",
    "reach_max_m": "reach m",
    "returns_p95_m": "sensor p95 m",
    "recovered_share": "share of holes",
    "median_rel_ratio": "error ratio",
    "median_rel_ratio_at_equal_coverage": "error ratio, equal coverage",
    "aurc_ratio": "AURC ratio",
    "aurc_ratio_by_error": "AURC ratio to by_error",
    "seconds_per_video": "s per video",
    "ece_pooled": "ECE, pooled",
    "range": "median, range over scenes",
    "p50_ms": "p50 ms",
    "p95_ms": "p95 ms",
    "p99_ms": "p99 ms",
    "parameters": "learned parameters",
    "weight_bytes": "weights",
    "peak_mib": "peak memory",
    "scale": "scale from",
    "metric": "metric?",
    "rho_abs": "|ρ| of blur",
    "rank_corr": "Spearman",
    "abs_corr": "|corr|",
    "gated_corr": "corr, most confident quarter",
    "gated_abs_corr": "|corr|, most confident quarter",
    "flip_share": "sign flipped",
    "order_corr": "order of pictures",
    "halves_corr": "odd against even pictures",
    "mean_rel": "mean",
    "mean_rel_ratio": "mean error ratio",
    "edge_mean_rel": "mean at edges",
    "rmse_m": "RMSE m",
    "changed_rel": "changed",
    "mse": "squared error / variance",
    "vs_context": "ratio to context",
    "vs_dinov2": "ratio to DINOv2",
    "vs_xfeat": "ratio to XFeat",
    "ause": "AUSE",
    "interval_1": "inside k = 1",
    "interval_2": "inside k = 2",
    "calibrated_2": "inside k = 2, calibrated",
    "scenes_within": "scenes with 95 ± 3 %",
    "calibrated_scenes_within": "scenes with 95 ± 3 %, calibrated",
    "worst_bias": "largest bias of a range",
    "room_bias": "largest bias, rooms",
    "bias_over_floor": "largest bias over floor",
    "chi2": "χ² of disjoint views",
    "chi2_median": "χ², from the median",
}
#: Style → metrics for which the rules of :func:`metric_style` do not apply.
_STYLED_METRICS = {
    "percent": "coverage pnp_success within_sigma within_2sigma truth_kept side_right interval_1 interval_2 "
    "calibrated_2 scenes_within calibrated_scenes_within floor worst_bias room_bias",
    "ratio": "rho_abs corr rank_corr abs_corr gated_corr gated_abs_corr order_corr halves_corr bias_over_floor chi2 "
    "chi2_median",
    "fine": "mean_rel_ratio ause mse vs_context vs_dinov2 vs_xfeat ece ece_equal_mass ece_pooled monotonicity",
    "large": "parameters",
    "bytes": "weight_bytes",
    "mebibytes": "peak_mib",
}
_METRIC_STYLES = {metric: style for style, metrics in _STYLED_METRICS.items() for metric in metrics.split()}
_DECIMALS = {"number": 1, "ratio": 2, "fine": 3}
_UNITS = {"large": ((1e9, "B"), (1e6, "M"), (1e3, "k")), "bytes": ((1e9, "GB"), (1e6, "MB"), (1e3, "kB"))}


def metric_heading(metric: str) -> str:
    """Heading of a metric."""
    return _METRIC_HEADINGS.get(metric) or words(metric.replace(".", " "))


def metric_style(metric: str) -> str:
    """Style of a metric: percent, ratio, fine, number, count, large, bytes, mebibytes or plain."""
    group, _, last = metric.rpartition(".")
    rules = (
        (_METRIC_STYLES.get(last, ""), last in _METRIC_STYLES),
        ("count", last.startswith("n_") or group.endswith("n_dropped")),
        ("percent", last.startswith("coverage_") or last.endswith(("_rel", "_share", "_success"))),
        ("percent", group.endswith("_share")),
        ("fine", last.startswith(("aurc", "augrc"))),
        ("number", group.split(".")[-1] == "ms"),
        ("ratio", last.endswith(("_px", "_ratio"))),
    )
    return next((style for style, applies in rules if applies), "plain")


def format_value(value: Any, metric: str = "", how: str | None = None) -> str:
    """Cell of a value in the style of the metric, or in the style ``how``."""
    if value is None:
        return EMPTY_CELL
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return "×".join(format_value(v, how="plain") for v in value)
    if not isinstance(value, int | float):
        raise ValueError(f"cell {metric or how}: found {value!r}, expected a number, a word or a list of them")
    how = how or metric_style(metric)
    whole = isinstance(value, int) and how == "plain"
    return (str(value) if whole else _format_number(float(value), how)).replace("-", "−")


def format_exact(value: Any) -> str:
    """Cell of a value with five significant digits, for the full tables."""
    if isinstance(value, list):
        return ", ".join(map(format_exact, value))
    return f"{value:.5g}" if isinstance(value, float) else format_value(value, how="plain")


def format_metric_interval(low: float | None, high: float | None, metric: str) -> str:
    """Cell of an interval; empty without one."""
    if low is None or high is None:
        return ""
    return f"{format_value(low, metric).removesuffix(' %')}–{format_value(high, metric)}"


def _format_number(value: float, how: str) -> str:
    """Text of a number in a style: per cent have two decimals below 10, one above, none at 0 and 100."""
    if how == "percent":
        decimals = 0 if value in (0, 1) else 2 if abs(100 * value) < 9.995 else 1
        return f"{100 * value:.{decimals}f} %"
    if how == "mebibytes":
        return _format_number(value * 2**20, "bytes")
    if how in _UNITS:
        size, unit = next(((size, f" {unit}") for size, unit in _UNITS[how] if abs(value) >= size), (1.0, ""))
        return f"{_format_number(value / size, 'plain')}{unit}" if unit else f"{value:.0f}"
    if how == "count":
        return f"{value:,.0f}"
    if how in _DECIMALS:
        return f"{value:.{_DECIMALS[how]}f}"
    decimals = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
    return f"{value:.{decimals}f}" if decimals <= 5 else f"{value:.1e}"
