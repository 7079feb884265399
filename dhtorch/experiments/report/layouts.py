"""Tables of known experiments in the layout of the paper, with the paper's figures beside the result's.

A table is (title, columns) or (title, columns, the paper's table, lines); what is no such list is a function.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from dhtorch.experiments.report.cells import (
    EMPTY_CELL,
    Result,
    Row,
    cohort_names,
    format_metric_interval,
    format_value,
    last_cohort,
    metric_heading,
    scene_rows,
    summary_entry,
    variant_names,
)
from dhtorch.experiments.report.published import PAPER, parse_printed
from dhtorch.experiments.report.tables import (
    DERIVED_NUMBERS,
    INTERVAL_LABEL,
    OURS_LABEL,
    PUBLISHED_LABEL,
    KnownLines,
    ReportTable,
    match_lines,
    published_source,
    scene_table,
    variant_table,
)
from dhtorch.metrics.risk import find_knee

#: What tables and figures mark as the knee, see :func:`dhtorch.metrics.risk.find_knee`.
KNEE_DEFINITION = "the point farthest below the chord between the ends of the curve"
#: What the method of the paper is here, and why some of its cells are blank.
_COMPARISON_NOTE = (
    "paper: what its text leaves open (samples, window, levels, hypotheses, minimal solver, score formula) was chosen "
    "here, see docs/methods.md; opencv: the same stages of OpenCV. Cells of a sigma or a probability are blank for "
    "methods that state none."
)
_RANDOM_WEIGHTS_NOTE = "DINOv2 with random weights: its lines are no evidence about DINOv2."
_CUTOFF_PATTERN = r"(?:gated,? )?cutoff .*"


class Layout(NamedTuple):
    """A table by variant, over scenes."""

    title: str
    columns: str  # metrics
    paper: str = ""  # key of its table in PAPER
    lines: KnownLines = ()  # in the paper's order


_RANGE_SPLIT = Layout(
    "Controlled far-field recovery, medians over scenes",
    "n_scenes truth_kept coverage corr median_rel p90_rel",
    "range_split",
    (
        ("sensor_only", "sensor-only (after cutoff)", "sensor-only (after cutoff)"),
        ("device_raw", "device pose (raw)", "device pose (raw)"),
        ("device_gl_to_cv", "device pose (GL→CV)", "device pose (GL→CV)"),
        ("no_gates", "no gates", "no gates"),
        ("gated", "gated", "gated"),
    ),
)
_CUTOFFS = Layout(
    "Cutoff sensitivity, gated, medians over scenes; candidates added up",
    "cutoff_m pnp_success n_candidates coverage median_rel",
    "cutoff_sweep",
    (
        (r"gated, cutoff (?:[x×]0\.75|1\.5 m)", None, "1.5 m"),
        (r"gated(?:, cutoff (?:[x×]1(?:\.0)?|2(?:\.0)? m))?", None, "2.0 m"),
        (r"gated, cutoff (?:[x×]1\.25|2\.5 m)", None, "2.5 m"),
    ),
)
_REAL_HOLES = Layout(
    "The sensor's true drop-outs, medians over scenes",
    "n_scenes n_candidates truth_kept coverage median_rel p90_rel",
    "real_holes",
    (("no_gates", "no gates", "no gates"), ("gated", "gated", "gated")),
)
_DEFOCUS = Layout(
    "Inverse depth from the blur of one image, medians over scenes",
    "n_scenes coverage rho_abs corr rank_corr side_right",
    "defocus",
    (
        ("natural", "unchanged images", "unsigned"),
        ("oracle_side", "side from an oracle", "side from an oracle"),
        ("by_height", "side by height in the image", "side has to be produced"),
        ("by_colour", "side by colour of the blur", "side has to be produced"),
        ("all_beyond", "always beyond the focus", "side has to be produced"),
        ("height_alone", "height alone, no blur", None),
        ("texture_alone", "texture alone, no lens", None),
    ),
)
_FOCUS_STACK = Layout(
    "Depth from a focal stack, medians over scenes; share of scenes with a flipped sign",
    "n_scenes rank_corr gated_corr flip_share abs_corr gated_abs_corr",
    "focus_stack",
    (
        ("clean", None, "clean synthetic"),
        ("noisy|moved|aligned", None, None),
        ("light_field", "optics of a light field", "real light fields"),
        ("no_focus", "nothing blurred", None),
    ),
)
#: Columns of the comparison of methods that a result may lack.
_COMPARED = (
    "coverage median_rel median_rel_ratio worst_scene_ratio aurc aurc_ratio coverage_at_5 within_sigma within_2sigma "
    "interval_1 interval_2 scenes_within calibrated_scenes_within worst_bias room_bias bias_over_floor ause chi2 "
    "chi2_median ece realised_risk_5 realised_risk_10"
)


def layout_tables(result: Result) -> list[ReportTable]:
    """Tables of an experiment in the paper's layout; of others with at least three variants, one by variant."""
    build = EXPERIMENT_LAYOUTS.get(result["experiment"])
    if callable(build):
        return list(build(result))
    if build:
        return [_by_variant(result, layout) for layout in build]
    measured = _measured(result, "coverage median_rel p90_rel corr pnp_success")
    if len(variant_names(result)) < 3 or not measured:
        return []
    return [variant_table(result, "Medians over scenes", ["n_scenes", *measured])]


def published_counterparts(result: Result) -> dict[str, dict[str, float]]:
    """Variant → metric → the paper's figure, for figures that show both."""
    layout, figures = _WITH_COUNTERPARTS.get(result["experiment"]), {}
    for _, variant, paper in match_lines(result, layout.lines) if layout else ():
        if layout and variant and paper:
            numbers = {m: parse_printed(cell) for m, cell in PAPER[layout.paper].lines[paper].items()}
            figures[variant] = {m: number for m, number in numbers.items() if number is not None}
    return figures


def _by_variant(result: Result, layout: Layout, **options: Any) -> ReportTable:
    title, columns, paper, lines = layout
    return variant_table(result, title, columns.split(), lines, PAPER.get(paper), **options)


def _measured(result: Result, columns: str) -> list[str]:
    """Those of the columns that the summary has of any variant."""
    variants = variant_names(result)
    return [m for m in columns.split() if any(summary_entry(result, v, m) for v in variants)]


def _range_split(result: Result) -> Iterator[ReportTable]:
    """Tables of the range split: far-field recovery by variant, and the sweep over cutoffs."""
    yield _by_variant(result, _RANGE_SPLIT, only=lambda v, _: not re.fullmatch(_CUTOFF_PATTERN, v or ""))
    if "real_holes" in cohort_names(result):
        title = "Beyond the cutoff where the sensor has no return, medians over scenes; candidates added up"
        columns = ["n_scenes", "n_candidates", "coverage", "median_rel", "p90_rel"]
        measured = {row["method"] for row in scene_rows(result, "real_holes")}
        yield variant_table(result, title, columns, truth="real_holes", only=lambda v, _: v in measured)
    if any(re.fullmatch(_CUTOFF_PATTERN, v) for v in variant_names(result)):
        yield _by_variant(result, _CUTOFFS, only=lambda v, paper: bool(paper or re.fullmatch(_CUTOFF_PATTERN, v or "")))


def _real_holes(result: Result) -> Iterator[ReportTable]:
    """Tables of the real holes: drop-outs of the sensor, and hidden far returns if measured."""
    yield _by_variant(result, _REAL_HOLES)
    for hidden in cohort_names(result):
        if hidden != last_cohort(result):
            yield variant_table(result, "The same on hidden far returns", _REAL_HOLES.columns.split(), truth=hidden)


def _held_out(result: Result) -> Iterator[ReportTable]:
    """Tables of the hold-out: by scene, cyclic against held out, and over scenes."""
    truth, variants = "heldout" if "heldout" in cohort_names(result) else None, variant_names(result)
    columns = "truth_kept n_kept corr median_rel residual_px passes coverage n_recovered reach_p95_m reach_max_m"
    title = "Hold-out triangulation (set B never sees the pose calibration)"
    yield scene_table(result, title, [*columns.split(), "returns_p95_m"], truth, PAPER["heldout"])
    if "cyclic" in cohort_names(result):  # the median error on the pose's own inliers against that on held-out points
        rows, quoted = [], PAPER["cyclic"]
        for v in variants:
            naive, held_out = (summary_entry(result, v, "median_rel", t).get("value") for t in ("cyclic", "heldout"))
            ratio = format_value(held_out / naive, how="number") + "×" if naive and held_out is not None else EMPTY_CELL
            rows.append([v, format_value(naive, "median_rel"), format_value(held_out, "median_rel"), ratio])
        cited = _cite(quoted.lines, "cyclic heldout ratio")
        heads, note = ["", "cyclic", "held out", "ratio of the two"], published_source(result, quoted)
        yield ReportTable("Median error: cyclic, held out", heads, rows + cited, quoted=len(cited), note=note)
    name = result["data"]["name"]
    lines = [(re.escape(v), name if len(variants) == 1 else f"{name}, {v}", None) for v in variants]
    columns = "n_scenes median_rel range corr ece coverage passes"
    title = "Cross-dataset depth-anchored geometry, medians over scenes"
    yield variant_table(result, title, columns.split(), lines, PAPER["cross_data"], truth)


def _calibration(result: Result) -> Iterator[ReportTable]:
    """Tables of the calibration by ground truth, and of thresholds; the paper has hold-outs and the range split."""
    columns = ["n_scenes", "truth_kept", "ece", "ece_pooled", "aurc", "aurc_excess", "mean_risk", "monotonicity"]
    for truth in reversed(cohort_names(result)):
        quoted = PAPER["score_calibration"] if truth == "heldout" or len(cohort_names(result)) == 1 else None
        title = f"Calibration, ground truth: {truth}, medians over scenes"
        yield variant_table(result, title, columns, None, quoted, truth)
    for variant in variant_names(result):
        rows, knee, quoted = [], threshold_knee(result, variant), PAPER["thresholds"]
        for name, numbers in threshold_points(result, variant):
            cells = [f"{name} (knee)" if name == knee else name]
            for m in ("coverage", "median_rel"):
                cells += [format_value(numbers[m], m), quoted.lines.get(name, {}).get(m, EMPTY_CELL)]
            rows.append([*cells, format_value(numbers["p90_rel"], "p90_rel")])
        over = (("", 1), (metric_heading("coverage"), 2), (metric_heading("median_rel"), 2), ("", 1))
        heads = ["score from", *[OURS_LABEL, PUBLISHED_LABEL] * 2, metric_heading("p90_rel")]
        title = f"Selective threshold, {variant}, medians over scenes"
        note = f"Knee, {KNEE_DEFINITION}, while every scene has answers: {f'at {knee}' if knee else 'none'}. "
        if len(rows) > 1:
            yield ReportTable(title, heads, rows, over=over, note=note + published_source(result, quoted))


def threshold_points(result: Result, variant: str) -> list[tuple[str, dict[str, float | None]]]:
    """Thresholds of the score, increasing, with coverage and errors of the answers at or above them; 0 keeps all."""
    matches = (re.search(r"(?:^|\.)at_(\d+(?:\.\d+)?)\.coverage$", name) for name in result["summary"])
    thresholds = sorted({match[1] for match in matches if match}, key=float)
    prefixes = {f"{float(name):g}": f"at_{name}." for name in thresholds}
    return [
        (name, {m: summary_entry(result, variant, prefix + m).get("value") for m in _THRESHOLD_METRICS})
        for name, prefix in ({"0": "", **prefixes} if prefixes else {}).items()
    ]


_THRESHOLD_METRICS = ("coverage", "median_rel", "p90_rel")


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


def _census(result: Result) -> Iterator[ReportTable]:
    """Table of the hole census by scene."""
    columns = ("hole_share.trackable_no_lidar", "trackability_hole", "trackability_valid")
    yield scene_table(result, "Why returns are missing: the key class", columns, None, PAPER["hole_census"])


def _comparison(result: Result) -> Iterator[ReportTable]:
    """Table of the method comparison, with ratios to the reference method."""
    table = variant_table(result, "Methods, over scenes", ["n_scenes", *_measured(result, _COMPARED)])
    yield replace(table, note=_COMPARISON_NOTE)


def _uncertainty(result: Result) -> Iterator[ReportTable]:
    """Tables of an archived study of stated uncertainty: over scenes, and of the last method by scene."""
    columns = "n_scenes interval_1 interval_2 scenes_within room_bias bias_over_floor aurc ause chi2 chi2_median"
    yield variant_table(result, "Intervals and bias, over scenes", columns.split())
    last = variant_names(result)[-1]
    rows = [row for row in result["rows"] if row["method"] == last and not row.get("role")]
    columns = "n_kept interval_1 interval_2 worst_bias ause calibrated_2 floor track_share pose_share reference_share"
    title = f"{last} by scene, with the shares of the causes in sigma² (medians of pairs)"
    yield scene_table({**result, "rows": rows}, title, [*columns.split(), "lens_share", "model_share"])


def _latency(result: Result) -> Iterator[ReportTable]:
    """Tables of a latency result: branches as in the paper, two machine-independent ratios, every stage."""
    columns, stage_columns = "device p50_ms p95_ms p99_ms parameters weight_bytes peak_mib", "p50_ms p95_ms p99_ms"

    def cells_of(row: Row, metrics: str) -> list[str]:  # its note in place of missing values
        missing = row.get("note", EMPTY_CELL)
        values = ((row.get(m), m) for m in metrics.split())
        return [branch_name(row), *(missing if value is None else format_value(value, m) for value, m in values)]

    rows, cited = scene_rows(result), _cite(PAPER["latency"].lines, columns)
    labels = {"cpu": "CPU", "cores": "cores", "threads": "threads", "load": "load of the machine"}
    facts = []
    for name, label in labels.items():
        values = dict.fromkeys(format_value(row[name], how="plain") for row in rows if row.get(name) is not None)
        facts += [f"{label} {', '.join(values)}"] if values else []
    note = f"{published_source(result, PAPER['latency'])} " + f"Measured with {'; '.join(facts)}." * bool(facts)
    branches = [cells_of(row, columns) for row in rows if is_whole_branch(row)]
    heads = ["branch", *map(metric_heading, columns.split())]
    yield ReportTable("Measured latency", heads, branches + cited, quoted=len(cited), note=note.strip())
    published_ratios = {
        "speedup": ("DINOv2-L / front end", "96"),
        "growth": ("front end at 1440×1920 / 224×224", "3.81 / 1.11"),
    }
    ratios = [
        [label, format_value(e["value"], how="plain"), format_metric_interval(e["low"], e["high"], name), published]
        for name, (label, published) in published_ratios.items()
        for v in variant_names(result)
        if (e := summary_entry(result, v, name))
    ]
    if ratios:
        yield ReportTable("Ratios", ["", OURS_LABEL, "lowest–highest round", PUBLISHED_LABEL], ratios)
    stages = [cells_of(row, stage_columns) for row in rows if not is_whole_branch(row)]
    if stages:
        yield ReportTable("Latency by stage", ["stage", *map(metric_heading, stage_columns.split())], stages)


def branch_name(row: Row) -> str:
    """Name of the branch or stage of a row, with its image size."""
    size = f", {format_value(row['hw'])}" if row.get("hw") else ""
    return f"{row['method']} {row.get('stage', '').replace('_', ' ')}".strip() + size


def is_whole_branch(row: Row) -> bool:
    """Whether a row is of a whole branch rather than of one stage."""
    return row.get("stage") in ("front_end", "pair", "forward") or "parameters" in row


def _defocus(result: Result) -> Iterator[ReportTable]:
    """Tables of depth from defocus: by estimate of the side of the focus, then the two ambiguities."""
    yield _by_variant(result, _DEFOCUS)
    walls = {
        "in focus, sharp texture": ("blank_wall.sharp_paint_px", None),
        "in focus, soft texture": ("blank_wall.soft_paint_px", None),
        "nearer than the focus": ("two_sides.near_px", "two_sides.true_px"),
        "beyond the focus": ("two_sides.far_px", "two_sides.true_px"),
    }
    value = {name: e.get("value") for name, e in result["summary"].items()} | {None: 0.0}
    rows = [
        [wall, format_value(value.get(measured), measured), format_value(value.get(truth), measured)]
        for wall, (measured, truth) in walls.items()
    ]
    if any(value.get(measured) is not None for measured, _ in walls.values()):
        yield ReportTable("The two ambiguities, each alone: a wall", ["", "measured blur px", "true px"], rows)


def _focus_stack(result: Result) -> Iterator[ReportTable]:
    """Tables of focal stacks: the first sharpness measure with the paper, other measures, sweeps without depth."""
    measured = [v for v in variant_names(result) if summary_entry(result, v, "rank_corr")]
    others = [v for v in measured if ", " in v]
    first = [v for v in measured if v not in others]
    if first:
        yield _by_variant(result, _FOCUS_STACK, only=lambda v, _: v in first)
    if others:
        layout = _FOCUS_STACK._replace(title="Other sharpness measures", paper="")
        yield _by_variant(result, layout, only=lambda v, _: v in others)
    if any(summary_entry(result, v, "order_corr") for v in variant_names(result)):
        columns = ("n_scenes", "order_corr", "halves_corr", "motion_px")
        yield variant_table(result, "Sweeps without depth, medians over scenes", columns)


def _future_motion(result: Result) -> Iterator[ReportTable]:
    """Tables of the probe of future motion: all samples, and those that move."""
    heads = ["", "error", INTERVAL_LABEL, "× context", INTERVAL_LABEL, "× DINOv2", INTERVAL_LABEL, "90 % interval"]
    for prefix, label, key in (
        ("", "all samples", "future_motion"),
        ("moving.", "samples that move", "future_motion_moving"),
    ):
        rows, quoted = [], PAPER[key]
        for arm in variant_names(result):
            cells = [_arm_label(result, arm)]
            for name in ("mse", "vs_context", "vs_dinov2"):
                e = summary_entry(result, arm, prefix + name)
                cells += [format_value(e.get("value"), how="fine"), _interval(e)]
            cells.append(_interval(summary_entry(result, arm, f"{prefix}vs_dinov2_90")))
            line = {"dhtorch": "DH-Active", "dinov2": "DINOv2"}.get(arm, "")
            rows.append([*cells, quoted.lines.get(line, {}).get("vs_dinov2", EMPTY_CELL)])
        title = f"Future motion of the hand, tasks held out, {label}; error in units of the targets' variance"
        yield ReportTable(title, [*heads, PUBLISHED_LABEL], rows, note=_probe_note(result, key))


def _visual_odometry(result: Result) -> Iterator[ReportTable]:
    """Table of the probe of camera motion: one row per scene and arm, then the paper's lines."""
    heads = ["scene", "arm", "pairs", "error", "× mean motion", "× DINOv2", INTERVAL_LABEL]
    rows = []
    for row in scene_rows(result):
        if row.get("note"):  # the row of the first arm stands for a scene that was left out
            rows += [[row["scene"], row["note"], *[EMPTY_CELL] * 5]] if row["method"] == "context" else []
            continue
        arm = "mean motion" if row["method"] == "context" else _arm_label(result, row["method"])
        numbers = [format_value(row.get(name), how="fine") for name in ("mse", "vs_context", "vs_dinov2")]
        n = format_value(row.get("n_samples"), how="count")
        rows.append([row["scene"], arm, n, *numbers, _interval(row, "vs_dinov2_")])
    cited = [
        [
            f"{PUBLISHED_LABEL}: one scene",
            name,
            EMPTY_CELL,
            *(cells.get(m, EMPTY_CELL) for m in ("mse", "", "vs_dinov2")),
        ]
        for name, cells in PAPER["visual_odometry"].lines.items()
    ]
    rows += [[*cells, ""] for cells in cited]
    title = "Motion of the camera within a scene, blocks held out; error in units of the targets' variance"
    yield ReportTable(title, heads, rows, 2, quoted=len(cited), note=_probe_note(result, "visual_odometry"))


def _downstream(result: Result) -> Iterator[ReportTable]:
    """Table of the probe of enriched sets: one row per arm, for blocks and for streams held out."""
    heads = ["held out", "arm", "samples", "error", "× context", INTERVAL_LABEL, "× sensor", INTERVAL_LABEL]
    rows = []
    for row in scene_rows(result):
        cells = [row["scene"].removesuffix(" held out"), _arm_label(result, row["method"])]
        cells += [format_value(row.get("n_samples"), how="count"), format_value(row.get("mse"), how="fine")]
        for name in ("vs_context", "vs_sensor"):
            cells += [format_value(row.get(name), how="fine"), _interval(row, f"{name}_")]
        rows.append(cells)
    title = "Next motion of the camera, from enriched sets; error in units of the targets' variance"
    yield ReportTable(title, heads, rows, 2, note="" if _dinov2_weights(result) else _RANDOM_WEIGHTS_NOTE)


def _dinov2_weights(result: Result) -> Any:
    """Folder of the weights of DINOv2 in the configuration; None for random weights."""
    return (result["config"].get("experiment", {}).get("dinov2") or {}).get("weights")


def _arm_label(result: Result, arm: str) -> str:
    """Name of an arm, marked if DINOv2 has random weights."""
    return f"{arm} (random weights)" if "dinov2" in arm and not _dinov2_weights(result) else arm


def _probe_note(result: Result, key: str) -> str:
    """Source of the paper's figures, and a note on random weights."""
    return published_source(result, PAPER[key]) + f" {_RANDOM_WEIGHTS_NOTE}" * (not _dinov2_weights(result))


def _interval(entry: Mapping[str, Any], prefix: str = "") -> str:
    """Cell with three decimals of the interval of an entry or of a row's metric."""
    return format_metric_interval(entry.get(f"{prefix}low"), entry.get(f"{prefix}high"), "ece")


def _cite(lines: Mapping[str, Mapping[str, str]], columns: str) -> list[list[str]]:
    """Rows of the paper's lines."""
    return [
        [f"{PUBLISHED_LABEL}: {name}", *(cells.get(m, EMPTY_CELL) for m in columns.split())]
        for name, cells in lines.items()
    ]


#: Experiment → its tables.
EXPERIMENT_LAYOUTS: dict[str, tuple[Layout, ...] | Callable[[Result], Any]] = {
    "range_split": _range_split,
    "real_holes": _real_holes,
    "gate_ablation": (
        Layout(
            "Gate ablation, medians over scenes",
            "n_scenes truth_kept corr median_rel coverage p90_rel",
            "gate_ablation",
            (
                (r"gap (?:[x×]0\.5|16)", None, "gap 16"),
                (r"both gates|gap (?:[x×]1(?:\.0)?|30)", None, "gap 30 (default)"),
                (r"gap (?:[x×]2(?:\.0)?|60)", None, "gap 60"),
                (r"parallax gate off.*", None, "parallax gate OFF (gap 30)"),
                (r"reprojection gate off.*", None, "reprojection gate OFF (gap 30)"),
            ),
        ),
    ),
    "heldout": _held_out,
    "calibration": _calibration,
    "hole_census": _census,
    "device_pose": (
        Layout(
            "Triangulation from the device's trajectory and from the metric pose estimate, medians over scenes",
            "n_scenes rotation_deg translation_m direction_deg truth_kept corr coverage median_rel",
            "device_pose",
        ),
    ),
    "motion": (
        Layout(
            "Motion dependence, medians over scenes",
            "n_scenes baseline_m truth_kept coverage median_rel n_recovered recovered_share",
            "baseline_motion",
        ),
    ),
    "global_map": (
        Layout(
            "Maps, medians over scenes; voxels, islands and fragments added up",
            "n_scenes n_voxels voxels_vs_sensor right_share n_islands largest_island n_fragments",
            "global_map",
        ),
    ),
    "learned": (
        Layout(
            "Reference results under different inputs and scale protocols, medians over scenes",
            "n_scenes median_rel corr coverage scale metric parameters weight_bytes device seconds_per_video",
            "learned",
            (
                (r"(?!dust3r|vggt|constant).*", None, "DH-Active"),
                (r"dust3r(?:_oracle)?", None, "DUSt3R"),
                (r"vggt(?:_oracle)?", None, "VGGT-1B"),
            ),
        ),
    ),
    "ablation": (
        Layout(
            "Ablation, medians over scenes",
            "n_scenes truth_kept coverage median_rel p90_rel corr aurc median_rel_ratio",
        ),
    ),
    "latency": _latency,
    "method_comparison": _comparison,
    "uncertainty_study": _uncertainty,
    "learned_score": (
        Layout(
            "The same answers in the order of each score, over scenes",
            "n_scenes n_kept aurc aurc_excess aurc_ratio aurc_ratio_by_error coverage_at_5",
        ),
    ),
    "dense_comparison": (
        Layout(
            "Dense maps, sparse samples, and other methods with the same motion",
            "n_scenes n_kept coverage median_rel wrong_share coverage_at_5 aurc",
        ),
    ),
    "helix_correlation": (
        Layout(
            "Shift as a depth cue: correlation with the sensor's inverse depth, medians over scenes",
            "n_scenes corr rank_corr corr_answered coverage flow_share along_share",
            "helix",
            (
                ("own_arm", "own arm in time", "dual-helix correlation"),
                ("between_arms", "between the arms", None),
                ("best_arm", "the better of both", None),
                ("flow", "plain flow", "plain 2-D optical flow"),
                ("flow_along_arm", "plain flow along the arm", None),
            ),
        ),
    ),
    "icp": (
        Layout(
            "ICP over external poses, medians over scenes; voxels summed",
            "n_scenes n_voxels voxels_vs_pose right_share confident_share rotation_deg drift_deg drift_rel",
            "icp",
            (("good", None, "device pose (VIO) alone"), (r"good \+ icp points", None, "ICP over it")),
        ),
    ),
    "hole_attention": (
        Layout(
            "Gaze on the holes, medians over scenes",
            "n_scenes hole_rate rise cluster_share cluster_returns",
            "hole_attention",
            (
                ("centre", "gaze at the centre", "before"),
                ("attention", "gaze on the largest hole cluster", "gaze on the largest hole cluster"),
                ("random", "random gaze", None),
                ("even", "even samples", None),
            ),
        ),
        Layout(
            "Ways to fill the holes",
            "n_scenes route_share.triangulate route_share.change_exposure route_share.get_closer route_share.turn_head",
        ),
    ),
    "defocus": _defocus,
    "focus_stack": _focus_stack,
    "defocus_fusion": (
        Layout(
            "Filling in between returns, medians over scenes; ratios to bilinear",
            "n_scenes corr mean_rel mean_rel_ratio edge_mean_rel rmse_m changed_rel",
            "defocus_fusion",
            (("bilinear", None, "bilinear"),),
        ),
    ),
    "rh20t_probe": _future_motion,
    "vo_probe": _visual_odometry,
    "downstream_probe": _downstream,
}
#: Columns of these tables that the generic tables leave out.
SHOWN_COLUMNS = ("trackability_hole", "trackability_valid", "passes", "parameters", "weight_bytes", *DERIVED_NUMBERS)
#: Experiments with variants of the paper, whose numbers figures show.
_WITH_COUNTERPARTS: dict[str, Layout] = {"range_split": _RANGE_SPLIT, "real_holes": _REAL_HOLES}
_WITH_COUNTERPARTS |= {name: EXPERIMENT_LAYOUTS[name][0] for name in ("gate_ablation", "learned")}  # type: ignore[index]
