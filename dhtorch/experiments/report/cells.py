"""Headings and number formats of table cells, chosen by the name of the metric."""

from __future__ import annotations

import math
from typing import Any

from dhtorch.codes import words

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
