"""Tables of the six negative results, with the paper's figures beside the result's."""

from __future__ import annotations

from dhtorch.experiments.report import published
from dhtorch.experiments.report.cells import format_value
from dhtorch.experiments.report.reading import Result, summary_entry, variant_names
from dhtorch.experiments.report.tables import KnownLines, ReportTable, match_lines, variant_table

_HELIX_LINES: KnownLines = (
    ("own_arm", "own arm in time", "dual-helix correlation"),
    ("between_arms", "between the arms", None),
    ("best_arm", "the better of both", None),
    ("flow", "plain flow", "plain 2-D optical flow"),
    ("flow_along_arm", "plain flow along the arm", None),
)
_ICP_LINES: KnownLines = (("good", None, "device pose (VIO) alone"), (r"good \+ icp points", None, "ICP over it"))
_ATTENTION_LINES: KnownLines = (
    ("centre", "gaze at the centre", "before"),
    ("attention", "gaze on the largest hole cluster", "gaze on the largest hole cluster"),
    ("random", "random gaze", None),
    ("even", "even samples", None),
)
_DEFOCUS_LINES: KnownLines = (
    ("natural", "unchanged images", "unsigned"),
    ("oracle_side", "side from an oracle", "side from an oracle"),
    ("by_height", "side by height in the image", "side has to be produced"),
    ("by_colour", "side by colour of the blur", "side has to be produced"),
    ("all_beyond", "always beyond the focus", "side has to be produced"),
    ("height_alone", "height alone, no blur", None),
    ("texture_alone", "texture alone, no lens", None),
)
_FOCUS_STACK_LINES: KnownLines = (
    ("clean", None, "clean synthetic"),
    ("noisy|moved|aligned", None, None),
    ("light_field", "optics of a light field", "real light fields"),
    ("no_focus", "nothing blurred", None),
)
_FUSION_LINES: KnownLines = (("bilinear", None, "bilinear"),)


def helix_tables(result: Result) -> list[ReportTable]:
    """Tables of the correlation along the spiral arms, with plain flow."""
    columns = ("n_scenes", "corr", "rank_corr", "corr_answered", "coverage", "flow_share", "along_share")
    title = "Shift as a depth cue: correlation with the sensor's inverse depth, medians over scenes"
    return [variant_table(result, title, columns, match_lines(result, _HELIX_LINES), published.HELIX)]


def icp_tables(result: Result) -> list[ReportTable]:
    """Tables of ICP over poses of three sources, with the poses alone."""
    columns: tuple[str, ...] = ("n_scenes", "n_voxels", "voxels_vs_pose", "right_share", "confident_share")
    columns += ("rotation_deg", "drift_deg", "drift_rel")
    title = "ICP over external poses, medians over scenes; voxels summed"
    return [variant_table(result, title, columns, match_lines(result, _ICP_LINES), published.ICP)]


def attention_tables(result: Result) -> list[ReportTable]:
    """Tables of the gaze on holes: hole rates, then the ways to fill the holes."""
    columns = ("n_scenes", "hole_rate", "rise", "cluster_share", "cluster_returns")
    routes = ("n_scenes", *(f"route_share.{r}" for r in ("triangulate", "change_exposure", "get_closer", "turn_head")))
    title = "Gaze on the holes, medians over scenes"
    gaze_table = variant_table(result, title, columns, match_lines(result, _ATTENTION_LINES), published.HOLE_ATTENTION)
    return [gaze_table, variant_table(result, "Ways to fill the holes", routes)]


def defocus_tables(result: Result) -> list[ReportTable]:
    """Tables of depth from defocus: by estimate of the side of the focus, then the two ambiguities."""
    columns = ("n_scenes", "coverage", "rho_abs", "corr", "rank_corr", "side_right")
    title = "Inverse depth from the blur of one image, medians over scenes"
    tables = [variant_table(result, title, columns, match_lines(result, _DEFOCUS_LINES), published.DEFOCUS)]
    walls = {
        "in focus, sharp texture": ("blank_wall.sharp_paint_px", None),
        "in focus, soft texture": ("blank_wall.soft_paint_px", None),
        "nearer than the focus": ("two_sides.near_px", "two_sides.true_px"),
        "beyond the focus": ("two_sides.far_px", "two_sides.true_px"),
    }
    value = {name: e.get("value") for name, e in result["summary"].items()}
    rows = [
        [wall, format_value(value.get(measured), measured), format_value(value.get(truth) if truth else 0.0, measured)]
        for wall, (measured, truth) in walls.items()
    ]
    if any(value.get(measured) is not None for measured, _ in walls.values()):
        tables.append(ReportTable("The two ambiguities, each alone: a wall", ["", "measured blur px", "true px"], rows))
    return tables


def focus_stack_tables(result: Result) -> list[ReportTable]:
    """Tables of focal stacks: the first sharpness measure with the paper, other measures, sweeps without depth."""
    columns = ("n_scenes", "rank_corr", "gated_corr", "flip_share", "abs_corr", "gated_abs_corr")
    measured = {v for v in variant_names(result) if summary_entry(result, v, "rank_corr")}
    lines = [line for line in match_lines(result, _FOCUS_STACK_LINES) if line.variant in measured]
    first_measure, other_measures = (
        [line for line in lines if (", " in (line.variant or "")) == by_other_measure]
        for by_other_measure in (False, True)
    )
    tables, title = [], "Depth from a focal stack, medians over scenes; share of scenes with a flipped sign"
    if first_measure:
        tables.append(variant_table(result, title, columns, first_measure, published.FOCUS_STACK))
    if other_measures:
        tables.append(variant_table(result, "Other sharpness measures", columns, other_measures))
    if any(summary_entry(result, v, "order_corr") for v in variant_names(result)):
        swept = ("n_scenes", "order_corr", "halves_corr", "motion_px")
        tables.append(variant_table(result, "Sweeps without depth, medians over scenes", swept))
    return tables


def fusion_tables(result: Result) -> list[ReportTable]:
    """Tables of filling between returns, with ratios to plain interpolation."""
    columns = ("n_scenes", "corr", "mean_rel", "mean_rel_ratio", "edge_mean_rel", "rmse_m", "changed_rel")
    title = "Filling in between returns, medians over scenes; ratios to bilinear"
    return [variant_table(result, title, columns, match_lines(result, _FUSION_LINES), published.DEFOCUS_FUSION)]
