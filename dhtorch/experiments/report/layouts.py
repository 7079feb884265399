"""Tables of known experiments in the layout of the paper, with the paper's figures beside the result's."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

from dhtorch.experiments.report import negatives, probes, published, timings
from dhtorch.experiments.report.cells import EMPTY_CELL, format_value, metric_heading
from dhtorch.experiments.report.reading import (
    Result,
    cohort_names,
    last_cohort,
    scene_rows,
    summary_entry,
    variant_names,
)
from dhtorch.experiments.report.tables import (
    DERIVED_NUMBERS,
    OURS_LABEL,
    PUBLISHED_LABEL,
    KnownLines,
    ReportTable,
    TableLine,
    match_lines,
    published_source,
    scene_table,
    variant_table,
)
from dhtorch.metrics.risk import find_knee

#: What the method of the paper is here, and why some of its cells are blank.
#: Numbers of a stated sigma, see dhtorch.metrics.uncertainty.
_UNCERTAINTY_COLUMNS = ("interval_1", "interval_2", "worst_bias", "ause", "chi2")
#: Causes of sigma, see dhtorch.records.SigmaBudget.
_TERMS = ("track", "pose", "reference", "lens", "model")

_COMPARISON_NOTE = (
    "paper: what its text leaves open (samples, window, levels, hypotheses, minimal solver, score formula) was chosen "
    "here, see docs/methods.md; opencv: the same stages of OpenCV. Cells of a sigma or a probability are blank for "
    "methods that state none."
)

#: What tables and figures mark as the knee, see :func:`dhtorch.metrics.risk.find_knee`.
KNEE_DEFINITION = "the point farthest below the chord between the ends of the curve"

_CUTOFF_PATTERN = r"(?:gated,? )?cutoff .*"
_RANGE_SPLIT_LINES: KnownLines = (
    ("sensor_only", "sensor-only (after cutoff)", "sensor-only (after cutoff)"),
    ("device_raw", "device pose (raw)", "device pose (raw)"),
    ("device_gl_to_cv", "device pose (GL→CV)", "device pose (GL→CV)"),
    ("no_gates", "no gates", "no gates"),
    ("gated", "gated", "gated"),
)
_CUTOFF_LINES: KnownLines = (
    (r"gated, cutoff (?:[x×]0\.75|1\.5 m)", None, "1.5 m"),
    (r"gated(?:, cutoff (?:[x×]1(?:\.0)?|2(?:\.0)? m))?", None, "2.0 m"),
    (r"gated, cutoff (?:[x×]1\.25|2\.5 m)", None, "2.5 m"),
)
_GATE_LINES: KnownLines = (
    (r"gap (?:[x×]0\.5|16)", None, "gap 16"),
    (r"both gates|gap (?:[x×]1(?:\.0)?|30)", None, "gap 30 (default)"),
    (r"gap (?:[x×]2(?:\.0)?|60)", None, "gap 60"),
    (r"parallax gate off.*", None, "parallax gate OFF (gap 30)"),
    (r"reprojection gate off.*", None, "reprojection gate OFF (gap 30)"),
)
_REAL_HOLES_LINES: KnownLines = (("no_gates", "no gates", "no gates"), ("gated", "gated", "gated"))
_LEARNED_LINES: KnownLines = (
    (r"(?!dust3r|vggt|constant).*", None, "DH-Active"),
    (r"dust3r(?:_oracle)?", None, "DUSt3R"),
    (r"vggt(?:_oracle)?", None, "VGGT-1B"),
)


def layout_tables(result: Result) -> list[ReportTable]:
    """Tables of an experiment in the paper's layout; of others with at least three variants, one by variant."""
    build = EXPERIMENT_LAYOUTS.get(result["experiment"])
    if build:
        return build(result)
    columns = ("n_scenes", "coverage", "median_rel", "p90_rel", "corr", "pnp_success")
    measured = [
        metric
        for metric in columns[1:]
        if any(summary_entry(result, variant, metric) for variant in variant_names(result))
    ]
    if len(variant_names(result)) < 3 or not measured:
        return []
    return [variant_table(result, "Medians over scenes", ("n_scenes", *measured))]


def _range_split(result: Result) -> list[ReportTable]:
    """Tables of the range split: far-field recovery by variant, and the sweep over cutoffs."""
    title = "Controlled far-field recovery, medians over scenes"
    columns = ("n_scenes", "truth_kept", "coverage", "corr", "median_rel", "p90_rel")
    lines = match_lines(result, _RANGE_SPLIT_LINES, without=_CUTOFF_PATTERN)
    tables = [variant_table(result, title, columns, lines, published.RANGE_SPLIT)]
    if "real_holes" in cohort_names(result):
        hole_title = "Beyond the cutoff where the sensor has no return, medians over scenes; candidates added up"
        lines = [TableLine(v, v) for v in variant_names(result) if scene_rows(result, "real_holes", v)]
        hole_columns = ("n_scenes", "n_candidates", "coverage", "median_rel", "p90_rel")
        tables.append(variant_table(result, hole_title, hole_columns, lines, truth="real_holes"))
    if any(re.fullmatch(_CUTOFF_PATTERN, v) for v in variant_names(result)):
        title = "Cutoff sensitivity, gated, medians over scenes; candidates added up"
        sweep_columns = ("cutoff_m", "pnp_success", "n_candidates", "coverage", "median_rel")
        lines = [
            line
            for line in match_lines(result, _CUTOFF_LINES)
            if line.paper or re.fullmatch(_CUTOFF_PATTERN, line.variant or "")
        ]
        tables.append(variant_table(result, title, sweep_columns, lines, published.CUTOFF_SWEEP))
    return tables


def _real_holes(result: Result) -> list[ReportTable]:
    """Tables of the real holes: drop-outs of the sensor, and hidden far returns if measured."""
    columns = ("n_scenes", "n_candidates", "truth_kept", "coverage", "median_rel", "p90_rel")
    tables, title = [], "The sensor's true drop-outs, medians over scenes"
    tables.append(variant_table(result, title, columns, match_lines(result, _REAL_HOLES_LINES), published.REAL_HOLES))
    tables += [
        variant_table(result, "The same on hidden far returns", columns, truth=hidden)
        for hidden in cohort_names(result)
        if hidden != last_cohort(result)
    ]
    return tables


def _gate_ablation(result: Result) -> list[ReportTable]:
    """Table of the gate ablation by variant."""
    columns = ("n_scenes", "truth_kept", "corr", "median_rel", "coverage", "p90_rel")
    return [
        variant_table(
            result,
            "Gate ablation, medians over scenes",
            columns,
            match_lines(result, _GATE_LINES),
            published.GATE_ABLATION,
        )
    ]


def _held_out(result: Result) -> list[ReportTable]:
    """Tables of the hold-out: by scene, cyclic against held out, and over scenes."""
    truth = "heldout" if "heldout" in cohort_names(result) else None
    columns: tuple[str, ...] = ("truth_kept", "n_kept", "corr", "median_rel", "residual_px", "passes", "coverage")
    columns += ("n_recovered", "reach_p95_m", "reach_max_m", "returns_p95_m")
    title = "Hold-out triangulation (set B never sees the pose calibration)"
    tables = [scene_table(result, title, columns, truth, published.HELD_OUT)]
    if "cyclic" in cohort_names(result):
        tables.append(_naive_protocol(result))
    columns_over_scenes = ("n_scenes", "median_rel", "range", "corr", "ece", "coverage", "passes")
    title = "Cross-dataset depth-anchored geometry, medians over scenes"
    name = result["data"]["name"]
    lines = [TableLine(name if len(variant_names(result)) == 1 else f"{name}, {v}", v) for v in variant_names(result)]
    return [*tables, variant_table(result, title, columns_over_scenes, lines, published.CROSS_DATA, truth)]


def _naive_protocol(result: Result) -> ReportTable:
    """Table of the median error on the pose's own inliers (cyclic) against that on held-out points."""
    rows = []
    for v in variant_names(result):
        naive, held_out = (summary_entry(result, v, "median_rel", t).get("value") for t in ("cyclic", "heldout"))
        ratio = format_value(held_out / naive, how="number") + "×" if naive and held_out is not None else EMPTY_CELL
        rows.append([v, format_value(naive, "median_rel"), format_value(held_out, "median_rel"), ratio])
    cited = [
        [f"{PUBLISHED_LABEL}: {name}", *(c.get(m, EMPTY_CELL) for m in ("cyclic", "heldout", "ratio"))]
        for name, c in published.CYCLIC.lines.items()
    ]
    title = "Median error: cyclic, held out"
    heads = ["", "cyclic", "held out", "ratio of the two"]
    return ReportTable(title, heads, rows + cited, quoted=len(cited), note=published_source(result, published.CYCLIC))


def _calibration(result: Result) -> list[ReportTable]:
    """Tables of the calibration by ground truth, and of thresholds; the paper has hold-outs and the range split."""
    columns = ("n_scenes", "truth_kept", "ece", "ece_pooled", "aurc", "aurc_excess", "mean_risk", "monotonicity")
    tables = []
    for truth in reversed(cohort_names(result)):
        held_out = truth == "heldout" or len(cohort_names(result)) == 1
        title = f"Calibration, ground truth: {truth}, medians over scenes"
        tables.append(
            variant_table(result, title, columns, None, published.SCORE_CALIBRATION if held_out else None, truth)
        )
    return tables + [table for v in variant_names(result) if (table := _thresholds(result, v))]


def _thresholds(result: Result, variant: str) -> ReportTable | None:
    """Table of coverage and errors of the answers above each threshold of the score; None with fewer than two."""
    rows, knee = [], threshold_knee(result, variant)
    for name, numbers in threshold_points(result, variant):
        published_cells = published.THRESHOLDS.lines.get(name, {})
        cells = [f"{name} (knee)" if name == knee else name]
        for m in ("coverage", "median_rel"):
            cells += [format_value(numbers[m], m), published_cells.get(m, EMPTY_CELL)]
        rows.append([*cells, format_value(numbers["p90_rel"], "p90_rel")])
    over = (("", 1), (metric_heading("coverage"), 2), (metric_heading("median_rel"), 2), ("", 1))
    heads = ["score from", OURS_LABEL, PUBLISHED_LABEL, OURS_LABEL, PUBLISHED_LABEL, metric_heading("p90_rel")]
    title = f"Selective threshold, {variant}, medians over scenes"
    note = f"Knee, {KNEE_DEFINITION}, while every scene has answers: {f'at {knee}' if knee else 'none'}. "
    note += published_source(result, published.THRESHOLDS)
    return ReportTable(title, heads, rows, over=over, note=note) if len(rows) > 1 else None


def threshold_points(result: Result, variant: str) -> list[tuple[str, dict[str, float | None]]]:
    """Thresholds of the score, increasing, with coverage and errors of the answers at or above them; 0 keeps all."""
    thresholds = {
        m[1] for name in result["summary"] if (m := re.search(r"(?:^|\.)at_(\d+(?:\.\d+)?)\.coverage$", name))
    }
    prefixes = {f"{float(name):g}": f"at_{name}." for name in sorted(thresholds, key=float)}
    prefixes = {"0": "", **prefixes} if prefixes else {}
    metrics = ("coverage", "median_rel", "p90_rel")
    return [
        (name, {m: summary_entry(result, variant, prefix + m).get("value") for m in metrics})
        for name, prefix in prefixes.items()
    ]


def _census(result: Result) -> list[ReportTable]:
    """Table of the hole census by scene."""
    columns = ("hole_share.trackable_no_lidar", "trackability_hole", "trackability_valid")
    return [scene_table(result, "Why returns are missing: the key class", columns, None, published.HOLE_CENSUS)]


def _device_pose(result: Result) -> list[ReportTable]:
    """Table of triangulation with the device trajectory and with the estimated pose."""
    columns: tuple[str, ...] = ("n_scenes", "rotation_deg", "translation_m", "direction_deg")
    columns += ("truth_kept", "corr", "coverage", "median_rel")
    title = "Triangulation from the device's trajectory and from the metric pose estimate, medians over scenes"
    return [variant_table(result, title, columns, None, published.DEVICE_POSE)]


def _motion(result: Result) -> list[ReportTable]:
    """Table of errors and recovered holes by baseline."""
    columns = ("n_scenes", "baseline_m", "truth_kept", "coverage", "median_rel", "n_recovered", "recovered_share")
    return [variant_table(result, "Motion dependence, medians over scenes", columns, None, published.BASELINE_MOTION)]


def _global_map(result: Result) -> list[ReportTable]:
    """Table of the maps with and without recovered points; the paper has a statement, no figure."""
    columns: tuple[str, ...] = ("n_scenes", "n_voxels", "voxels_vs_sensor", "right_share")
    columns += ("n_islands", "largest_island", "n_fragments")
    title = "Maps, medians over scenes; voxels, islands and fragments added up"
    return [variant_table(result, title, columns, None, published.GLOBAL_MAP)]


def _learned(result: Result) -> list[ReportTable]:
    """Table of the learned methods."""
    columns: tuple[str, ...] = ("n_scenes", "median_rel", "corr", "coverage", "scale", "metric", "parameters")
    columns += ("weight_bytes", "device", "seconds_per_video")
    title = "Reference results under different inputs and scale protocols, medians over scenes"
    return [variant_table(result, title, columns, match_lines(result, _LEARNED_LINES), published.LEARNED)]


def _ablation(result: Result) -> list[ReportTable]:
    """Table of the ablation by part."""
    columns = ("n_scenes", "truth_kept", "coverage", "median_rel", "p90_rel", "corr", "aurc", "median_rel_ratio")
    return [variant_table(result, "Ablation, medians over scenes", columns)]


def _comparison(result: Result) -> list[ReportTable]:
    """Table of the method comparison, with ratios to the reference method."""
    columns = ["coverage", "median_rel", "median_rel_ratio", "worst_scene_ratio", "aurc", "aurc_ratio", "coverage_at_5"]
    columns += ["within_sigma", "within_2sigma", *_UNCERTAINTY_COLUMNS, "ece", "realised_risk_5", "realised_risk_10"]
    measured = [m for m in columns if any(summary_entry(result, v, m) for v in variant_names(result))]
    table = variant_table(result, "Methods, over scenes", ["n_scenes", *measured])
    return [replace(table, note=_COMPARISON_NOTE)]


def _part_ablation(result: Result) -> list[ReportTable]:
    """Table of the ablation of parts, as ratios to the method of the paper."""
    columns: tuple[str, ...] = ("n_scenes", "coverage", "median_rel_ratio_at_equal_coverage", "aurc_ratio")
    columns += ("coverage_at_5", "within_sigma", "within_2sigma", "ece", "pair_ms", "extra_ms")
    optional_columns = ("error_ratio_to_window", "aurc_full_ratio_to_window")
    columns += tuple(m for m in optional_columns if any(summary_entry(result, v, m) for v in variant_names(result)))
    return [variant_table(result, "Parts alone and left out, ratios to the paper's method", columns)]


def _views_study(result: Result) -> list[ReportTable]:
    """Tables of the study of view selection: over scenes, and by scene against the best fixed gap."""
    auto_rows = {**result, "rows": [row for row in result["rows"] if row["method"] == "auto" and not row.get("role")]}
    return [
        variant_table(result, "Chosen views and fixed gaps, over scenes", ("n_scenes", "coverage", "coverage_at_5")),
        scene_table(auto_rows, "Against the best gap", ("coverage_at_5", "best_gap", "fixed_gap_ratio", "one_partner")),
    ]


def _uncertainty(result: Result) -> list[ReportTable]:
    """Tables of the study of stated uncertainty: over scenes, and of the last method by scene."""
    columns = ("n_scenes", *_UNCERTAINTY_COLUMNS[:2], "scenes_within", "room_bias", "bias_over_floor", "aurc", "ause")
    by_scene = ("n_kept", *_UNCERTAINTY_COLUMNS[:-1], "calibrated_2", "floor", *(f"{term}_share" for term in _TERMS))
    last = variant_names(result)[-1]
    of_last = {**result, "rows": [row for row in result["rows"] if row["method"] == last and not row.get("role")]}
    return [
        variant_table(result, "Intervals and bias, over scenes", (*columns, "chi2", "chi2_median")),
        scene_table(of_last, f"{last} by scene, with the shares of the causes in sigma² (medians of pairs)", by_scene),
    ]


def _dense(result: Result) -> list[ReportTable]:
    """Table of the comparison of dense methods."""
    columns = ("n_scenes", "n_kept", "coverage", "median_rel", "wrong_share", "coverage_at_5", "aurc")
    return [variant_table(result, "Dense maps, sparse samples, and other methods with the same motion", columns)]


def _learned_score(result: Result) -> list[ReportTable]:
    """Table of the answers in the order of each score."""
    columns = ("n_scenes", "n_kept", "aurc", "aurc_excess", "aurc_ratio", "aurc_ratio_by_error", "coverage_at_5")
    return [variant_table(result, "The same answers in the order of each score, over scenes", columns)]


def threshold_knee(result: Result, variant: str) -> str | None:
    """The threshold at the knee of median error against coverage; None without a knee.

    Thresholds at which a scene has no answer left are no points of the curve: their median is over other scenes.
    """
    n_scenes = summary_entry(result, variant, "median_rel").get("n")
    known = [
        (name, numbers["coverage"], numbers["median_rel"])
        for name, numbers in threshold_points(result, variant)
        if summary_entry(result, variant, f"at_{name}.median_rel").get("n", n_scenes) == n_scenes
        and numbers["coverage"] is not None
        and numbers["median_rel"] is not None
    ]
    k = find_knee([c for _, c, _ in known], [e for _, _, e in known])
    return None if k is None else known[k][0]


EXPERIMENT_LAYOUTS: dict[str, Callable[[Result], list[ReportTable]]] = {
    "range_split": _range_split,
    "real_holes": _real_holes,
    "gate_ablation": _gate_ablation,
    "heldout": _held_out,
    "calibration": _calibration,
    "hole_census": _census,
    "device_pose": _device_pose,
    "motion": _motion,
    "global_map": _global_map,
    "learned": _learned,
    "ablation": _ablation,
    "latency": timings.latency_tables,
    "method_comparison": _comparison,
    "learned_score": _learned_score,
    "part_ablation": _part_ablation,
    "uncertainty_study": _uncertainty,
    "views_study": _views_study,
    "dense_comparison": _dense,
    "helix_correlation": negatives.helix_tables,
    "icp": negatives.icp_tables,
    "hole_attention": negatives.attention_tables,
    "defocus": negatives.defocus_tables,
    "focus_stack": negatives.focus_stack_tables,
    "defocus_fusion": negatives.fusion_tables,
    "rh20t_probe": probes.future_motion_tables,
    "vo_probe": probes.visual_odometry_tables,
    "downstream_probe": probes.downstream_tables,
}
#: Columns of these tables that the generic tables leave out.
SHOWN_COLUMNS = ("trackability_hole", "trackability_valid", "passes", "parameters", "weight_bytes", *DERIVED_NUMBERS)

#: Experiments with variants of the paper: name → (lines, published table).
_COUNTERPARTS: dict[str, tuple[KnownLines, published.PublishedTable]] = {
    "range_split": (_RANGE_SPLIT_LINES, published.RANGE_SPLIT),
    "real_holes": (_REAL_HOLES_LINES, published.REAL_HOLES),
    "gate_ablation": (_GATE_LINES, published.GATE_ABLATION),
    "learned": (_LEARNED_LINES, published.LEARNED),
}


def published_counterparts(result: Result) -> dict[str, dict[str, float]]:
    """Variant → metric → the paper's figure, for figures that show both."""
    known_lines, table = _COUNTERPARTS.get(result["experiment"], ((), None))
    figures: dict[str, dict[str, float]] = {}
    for line in match_lines(result, known_lines):
        if table and line.variant and line.paper:
            cells = {m: published.parse_printed(cell) for m, cell in table.lines[line.paper].items()}
            figures[line.variant] = {m: number for m, number in cells.items() if number is not None}
    return figures
