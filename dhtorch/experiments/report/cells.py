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
    "error_ratio_to_window": "error ratio to window",
    "aurc_full_ratio_to_window": "AURC ratio to window, unanswered as 1",
    "fixed_gap_ratio": "ratio to the best gap",
    "pair_ms": "ms per pair",
    "extra_ms": "ms more",
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
    "worst_bias": "largest bias of a range",
    "room_bias": "largest bias, rooms",
    "bias_over_floor": "largest bias over floor",
    "chi2": "χ² of disjoint views",
    "chi2_median": "χ², from the median",
}
#: Metric → style, where the rules of :func:`metric_style` do not apply.
_METRIC_STYLES = {
    "coverage": "percent",
    "pnp_success": "percent",
    "within_sigma": "percent",
    "within_2sigma": "percent",
    "truth_kept": "percent",
}
_METRIC_STYLES |= dict.fromkeys(("rho_abs", "corr", "rank_corr", "abs_corr", "gated_corr", "gated_abs_corr"), "ratio")
_METRIC_STYLES |= {"order_corr": "ratio", "halves_corr": "ratio", "side_right": "percent", "mean_rel_ratio": "fine"}
_METRIC_STYLES |= dict.fromkeys(("interval_1", "interval_2", "calibrated_2", "scenes_within", "floor"), "percent")
_METRIC_STYLES |= {"worst_bias": "percent", "room_bias": "percent", "ause": "fine", "bias_over_floor": "ratio"}
_METRIC_STYLES |= {"chi2": "ratio", "chi2_median": "ratio"}
_METRIC_STYLES |= dict.fromkeys(("mse", "vs_context", "vs_dinov2", "vs_xfeat"), "fine")
_METRIC_STYLES |= {"ece": "fine", "ece_equal_mass": "fine", "ece_pooled": "fine", "monotonicity": "fine"}
_METRIC_STYLES |= {"parameters": "large", "weight_bytes": "bytes", "peak_mib": "mebibytes"}
_STYLE_DECIMALS = {"count": 0, "number": 1, "ratio": 2, "fine": 3}
_LARGE = ((1e9, "B"), (1e6, "M"), (1e3, "k"))
_BYTES = ((1e9, "GB"), (1e6, "MB"), (1e3, "kB"))


def metric_heading(metric: str) -> str:
    """Heading of a metric."""
    return _METRIC_HEADINGS.get(metric) or words(metric.replace(".", " "))


def metric_style(metric: str) -> str:
    """Style of a metric: percent, ratio, fine, number, count, large, bytes, mebibytes or plain."""
    group, _, last = metric.rpartition(".")
    if last in _METRIC_STYLES:
        return _METRIC_STYLES[last]
    if last.startswith("n_") or group.endswith("n_dropped"):
        return "count"
    if last.startswith("coverage_") or last.endswith(("_rel", "_share", "_success")) or group.endswith("_share"):
        return "percent"
    if last.startswith(("aurc", "augrc")):
        return "fine"
    if group.split(".")[-1] == "ms":
        return "number"
    return "ratio" if last.endswith(("_px", "_ratio")) else "plain"


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
    if isinstance(value, float):
        return f"{value:.5g}"
    return format_value(value, how="plain")


def format_metric_interval(low: float | None, high: float | None, metric: str) -> str:
    """Cell of an interval; empty without one."""
    if low is None or high is None:
        return ""
    return f"{format_value(low, metric).removesuffix(' %')}–{format_value(high, metric)}"


def _format_number(value: float, how: str) -> str:
    """Text of a number in a style."""
    if how == "percent":
        return _format_percent(value)
    if how == "count":
        return f"{value:,.0f}"
    if how in ("large", "bytes"):
        return _format_with_unit(value, _LARGE if how == "large" else _BYTES)
    if how == "mebibytes":
        return _format_with_unit(value * 2**20, _BYTES)
    return f"{value:.{_STYLE_DECIMALS[how]}f}" if how in _STYLE_DECIMALS else _format_three_digits(value)


def _format_percent(value: float) -> str:
    """Two decimals below 10 %, one above, none at 0 and 100."""
    percent = 100 * value
    decimals = 0 if percent in (0, 100) else 2 if abs(percent) < 9.995 else 1
    return f"{percent:.{decimals}f} %"


def _format_three_digits(value: float) -> str:
    """Text with three significant digits."""
    if value == 0:
        return "0"
    decimals = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:.{decimals}f}" if decimals <= 5 else f"{value:.1e}"


def _format_with_unit(value: float, units: tuple[tuple[float, str], ...]) -> str:
    """Text of a number with the largest unit that fits."""
    for size, unit in units:
        if abs(value) >= size:
            return f"{_format_three_digits(value / size)} {unit}"
    return f"{value:.0f}"
