"""What does not work, in tables: the six negative results, ours beside the paper's figure."""

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
    ("random", "gaze anywhere", None),
    ("even", "even samples", None),
)
_DEFOCUS_LINES: KnownLines = (
    ("natural", "pictures as they came", "unsigned"),
    ("oracle_side", "side from an oracle", "side from an oracle"),
    ("by_height", "side by height in the picture", "side has to be produced"),
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
    """Correlation along the spiral, plain flow beside it."""
    columns = ("n_scenes", "corr", "rank_corr", "corr_answered", "coverage", "flow_share", "along_share")
    title = "Shift as a depth cue: correlation with the sensor's inverse depth, medians over scenes"
    return [variant_table(result, title, columns, match_lines(result, _HELIX_LINES), published.HELIX)]


def icp_tables(result: Result) -> list[ReportTable]:
    """Poses as they came, and ICP over them."""
    columns: tuple[str, ...] = ("n_scenes", "n_voxels", "voxels_vs_pose", "right_share", "confident_share")
    columns += ("rotation_deg", "drift_deg", "drift_rel")
    title = "ICP over poses from elsewhere, medians over scenes; voxels added up"
    return [variant_table(result, title, columns, match_lines(result, _ICP_LINES), published.ICP)]


def attention_tables(result: Result) -> list[ReportTable]:
    """Where to look, then what the holes ask for."""
    columns = ("n_scenes", "hole_rate", "rise", "cluster_share", "cluster_returns")
    routes = ("n_scenes", *(f"route_share.{r}" for r in ("triangulate", "change_exposure", "get_closer", "turn_head")))
    title = "Looking at the holes, medians over scenes"
    found = variant_table(result, title, columns, match_lines(result, _ATTENTION_LINES), published.HOLE_ATTENTION)
    return [found, variant_table(result, "What the holes ask for", routes)]


def defocus_tables(result: Result) -> list[ReportTable]:
    """Ways to find the side of the focus, then what one picture cannot tell apart."""
    columns = ("n_scenes", "coverage", "rho_abs", "corr", "rank_corr", "side_right")
    title = "Inverse depth from the blur of one picture, medians over scenes"
    found = [variant_table(result, title, columns, match_lines(result, _DEFOCUS_LINES), published.DEFOCUS)]
    walls = {
        "in focus, sharp paint": ("blank_wall.sharp_paint_px", None),
        "in focus, soft paint": ("blank_wall.soft_paint_px", None),
        "nearer than the focus": ("two_sides.near_px", "two_sides.true_px"),
        "as far beyond it": ("two_sides.far_px", "two_sides.true_px"),
    }
    value = {name: e.get("value") for name, e in result["summary"].items()}
    rows = [
        [wall, format_value(value.get(claim), claim), format_value(value.get(true) if true else 0.0, claim)]
        for wall, (claim, true) in walls.items()
    ]
    if any(value.get(claim) is not None for claim, _ in walls.values()):
        found.append(ReportTable("The two ambiguities, each alone: a wall", ["", "blur claimed px", "true px"], rows))
    return found


def focus_stack_tables(result: Result) -> list[ReportTable]:
    """The first measure of sharpness beside the paper, then the other measures, then sweeps without depth."""
    columns = ("n_scenes", "rank_corr", "gated_corr", "flip_share", "abs_corr", "gated_abs_corr")
    measured = {v for v in variant_names(result) if summary_entry(result, v, "rank_corr")}
    known = [line for line in match_lines(result, _FOCUS_STACK_LINES) if line.variant in measured]
    first, other = ([line for line in known if (", " in (line.variant or "")) == rest] for rest in (False, True))
    found, title = [], "Depth from a focal stack, medians over scenes; share of scenes with a flipped sign"
    if first:
        found.append(variant_table(result, title, columns, first, published.FOCUS_STACK))
    if other:
        found.append(variant_table(result, "The same by other measures of sharpness", columns, other))
    if any(summary_entry(result, v, "order_corr") for v in variant_names(result)):
        swept = ("n_scenes", "order_corr", "halves_corr", "motion_px")
        found.append(variant_table(result, "Sweeps without depth, medians over scenes", swept))
    return found


def fusion_tables(result: Result) -> list[ReportTable]:
    """Ways to fill in between returns, ratios to plain interpolation."""
    columns = ("n_scenes", "corr", "mean_rel", "mean_rel_ratio", "edge_mean_rel", "rmse_m", "changed_rel")
    title = "Filling in between returns, medians over scenes; ratios to bilinear"
    return [variant_table(result, title, columns, match_lines(result, _FUSION_LINES), published.DEFOCUS_FUSION)]
