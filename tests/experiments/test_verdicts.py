"""Every verdict goes either way: numbers of an experiment → supported, refuted or undecided."""

import dataclasses
from functools import partial

import pytest
from support.paper_protocol_runs import outcome_of_rows, probe_errors

from dhtorch.experiments.compare import dense_comparison, learned
from dhtorch.experiments.focal import defocus, defocus_fusion, focus_stack
from dhtorch.experiments.negative import helix_correlation, hole_attention, icp
from dhtorch.experiments.paper import (
    ablation,
    calibration,
    device_pose,
    gate_ablation,
    global_map,
    heldout,
    hole_census,
    latency,
    motion,
    range_split,
    real_holes,
)
from dhtorch.experiments.probes import downstream_probe, learned_score, rh20t_probe
from dhtorch.experiments.protocol import Outcome
from dhtorch.metrics.bootstrap import Interval


def numbers(**values):
    """A summary of values; ``__`` stands for a dot."""
    return {name.replace("__", "."): {"value": value} for name, value in values.items()}


def rows(truth, **methods):
    """An outcome with one row of scene ``a`` for each method: its numbers."""
    return outcome_of_rows(*(("a", name.replace("_and_", " "), truth, row) for name, row in methods.items()))


def with_summary(outcome, **values):
    return dataclasses.replace(outcome, summary=numbers(**values))


def honest(naive, held_out, passed):
    return outcome_of_rows(
        ("a", "m", "cyclic", {"median_rel": naive}), ("a", "m", "heldout", {"median_rel": held_out, "passes": passed})
    )


def drop_outs(real, hidden, kept=5):
    outcome = rows("real_holes", gated={"n_candidates": 9, "n_kept": kept})
    return with_summary(outcome, gated__median_rel=real, gated__full__median_rel=hidden)


def anchored(ours, theirs):
    names = ("corr", "median_rel")
    outcome = rows(
        "heldout", anchored=dict(zip(names, ours, strict=True)), device_gl_to_cv=dict(zip(names, theirs, strict=True))
    )
    outcome.summary = {
        f"{v}.{k}": {"value": None} for v in ("device_raw", "device_gl_to_cv", "anchored") for k in names
    }
    return outcome


def trend(recovered, error):
    row = {"rank_corr_recovered": recovered, "rank_corr_error": error}
    return outcome_of_rows(("a", "gap x1", "heldout", row))


def split(**changes):
    values = {"gated__coverage": 0.6, "gated__median_rel": 0.1, "gated__p90_rel": 0.3}
    return numbers(**values | {"device_raw__median_rel": 1.0, "no_gates__p90_rel": 0.4} | changes)


def gates(both, parallax, residual):
    names = ("both gates", "parallax gate off", "reprojection gate off")
    return {f"{n}.corr": {"value": v} for n, v in zip(names, (both, parallax, residual), strict=True)}


def census(share, hole):
    return numbers(hole_share__trackable_no_lidar=share, trackability_hole=hole, trackability_valid=1.0)


def ranked(aurc, ece):
    return rows("full", m={"aurc": aurc, "mean_risk": 0.1, "ece": ece, "monotonicity": 1.0})


def fragments(voxels, islands):
    return outcome_of_rows(
        ("a", "sensor device", global_map.MAP_TRUTH, {"n_voxels": 100, "n_islands": 5}),
        ("a", "fused device", global_map.MAP_TRUTH, {"n_voxels": voxels, "n_islands": islands}),
        ("a", "fused anchored", global_map.MAP_TRUTH, {"n_fragments": 3}),
    )


def refined(covered, nearer, confident):
    return outcome_of_rows(
        ("a", "good", "trajectory", {"n_voxels": 100}),
        ("a", "good + icp points", "trajectory", {"n_voxels": covered, "confident_share": confident, "n_pairs": 1}),
        ("a", "none", "trajectory", {"drift_rel": 0.2}),
        ("a", "none + icp points", "trajectory", {"drift_rel": nearer}),
    )


def attention(after):
    shares = {f"centre__route_share__{k}": 0.5 for k in ("triangulate", "change_exposure", "turn_head")}
    return with_summary(rows("sensor", centre={"hole_rate": 0.6}, attention={"hole_rate": after}), **shares)


def correlations(oracle, deployed, rho=0.2):
    return rows("full", oracle_side={"corr": oracle, "rho_abs": rho}, by_height={"corr": deployed, "rho_abs": rho})


def scene_errors(ours, theirs, truth, *pairs, **common):
    """Scenes in which two methods have these errors."""
    return outcome_of_rows(
        *(
            (str(k), name, truth, {**common, **row})
            for k, pair in enumerate(pairs)
            for name, row in zip((ours, theirs), pair, strict=True)
        )
    )


def fused(*pairs):
    rel = [tuple({"mean_rel": x} for x in pair) for pair in pairs]
    return scene_errors("defocus_guided", "bilinear", "left_out", *rel, corr=0.9)


def networks(*pairs):
    rel = [({"median_rel": mine}, {"on_ours": {"median_rel": theirs}}) for mine, theirs in pairs]
    return scene_errors("paper", "vggt_oracle", "full", *rel)


def stacks(clean, field, gated):
    values = {"clean__rank_corr": clean, "light_field__rank_corr": field, "light_field__abs_corr": abs(field)}
    return Outcome(summary=numbers(**values, light_field__gated_abs_corr=gated, light_field__flip_share=0.2))


def intervals(paper, by_hand):
    pairs = (("learned.aurc_ratio", paper), ("learned.aurc_ratio_by_error", by_hand))
    return {name: Interval(*values, 9) for name, values in pairs}


def times(speedup, growth):
    ratio = lambda low, high: {"value": (low + high) / 2, "low": low, "high": high, "n": 3, "unit": "1"}  # noqa: E731
    summary = {"paper.front_end.48x64": ratio(1, 1), "paper.pair.48x64": ratio(9, 9), "paper.growth": ratio(*growth)}
    return summary | ({} if speedup is None else {"paper.speedup": ratio(*speedup)})


ROBOT = {"dinov2": 1.0, "context": 2.0}
CONTROLS = {"true_motion": 0.2, "shuffled": 2.2}


def robot(ratio, origin="DINOv2", spread=0.0, **more):
    return rh20t_probe.verdict(probe_errors(spread, **ROBOT, dhtorch=ratio, **more), origin, 0.02)


def downstream(dhtorch=0.8, true_depth=0.7):
    factors = {"sensor": 1.0, "context": 1.1, "true_motion": 0.1, "shuffled": 1.2}
    errors = probe_errors(groups=20, cohorts=("all",), dhtorch=dhtorch, true_depth=true_depth, **factors)
    return downstream_probe.verdict(errors, errors, None)


def dense(**more):
    fine = {"dense__answered": 0.6, "dense__ause_ratio": 0.4, "dense__within_sigma": 0.7}
    return dense_comparison.verdict(Outcome(summary=numbers(**fine | more)), peers=False)


GOOD, BAD = (0.9, 0.1), (0.5, 0.2)
SIZES, LOST = ((48, 64), (96, 128)), "not measured: no library"

#: (verdict, arguments, expected); an argument is made by its function from the values behind it.
VERDICTS = [
    *(
        (heldout.verdict, (honest(0.01, 0.06, True), "m"), True),
        (heldout.verdict, (honest(0.01, 0.03, True), "m"), False),
    ),
    (heldout.verdict, (honest(0.01, 0.06, False), "m"), False),
    (heldout.verdict, (honest(None, 0.03, False), "m"), None),
    *((range_split.verdict, (split(),), True), (range_split.verdict, (split(gated__coverage=0.2),), False)),
    *((range_split.verdict, (split(device_raw__median_rel=x),), y) for x, y in ((0.1, False), (None, True))),
    (range_split.verdict, (split(no_gates__p90_rel=0.3),), False),
    (range_split.verdict, (split(gated__median_rel=None),), None),
    *(
        (real_holes.verdict, (drop_outs(a, b),), y)
        for a, b, y in ((0.4, 0.1, True), (0.1, 0.4, False), (None, 0.1, None))
    ),
    *((device_pose.verdict, (anchored(a, b),), y) for a, b, y in ((GOOD, BAD, True), (BAD, GOOD, False))),
    (device_pose.verdict, (anchored(GOOD, (None, None)),), None),
    *((gate_ablation.verdict, (gates(*x),), y) for x, y in (((0.8, 0.1, 0.7), True), ((0.8, 0.75, 0.5), False))),
    (gate_ablation.verdict, (gates(0.8, None, 0.1),), None),
    *((motion.verdict, (trend(a, b),), y) for a, b, y in ((0.5, -0.5, True), (None, None, None), (-0.5, -0.5, False))),
    (motion.verdict, (trend(0.5, 0.5),), False),
    *(
        (hole_census.verdict, (census(a, b),), y)
        for a, b, y in ((0.9, 1.0, True), (0.4, 1.0, False), (0.9, 0.05, False))
    ),
    (hole_census.verdict, (census(None, 1.0),), None),
    *((calibration.verdict, (ranked(*x), "m"), y) for x, y in (((0.05, 0.3), True), ((0.05, 0.05), False))),
    (calibration.verdict, (ranked(0.2, 0.3), "m"), False),
    *((ablation.verdict, ({"a": x},), y) for x, y in ((0.95, True), (0.8, False), (None, None))),
    *((global_map.verdict, (fragments(120, k),), y) for k, y in ((9, True), (5, True), (4, False))),
    *((global_map.verdict, (fragments(k, 9),), y) for k, y in ((100, False), (None, None))),
    *((icp.verdict, (refined(k, 0.1, 0.3),), y) for k, y in ((90, True), (100, False), (None, None))),
    *((icp.verdict, (refined(90, *x),), False) for x in ((0.3, 0.3), (0.1, 0.7))),
    *(
        (helix_correlation.verdict, (rows("full", own_arm={"corr": a}, flow={"corr": b}),), y)
        for a, b, y in ((0.0, 0.3, True), (0.2, 0.3, False), (0.4, 0.3, False), (-0.2, -0.1, None), (None, 0.3, None))
    ),
    *((hole_attention.verdict, (attention(x),), y) for x, y in ((0.7, True), (0.5, False), (None, None))),
    *((defocus.verdict, (correlations(*x),), y) for x, y in (((0.66, 0.06), True), ((0.66, 0.5), False))),
    *((defocus.verdict, (correlations(*x),), False) for x in ((0.2, 0.0), (0.66, 0.06, 0.8))),
    (defocus.verdict, (Outcome(),), None),
    (defocus_fusion.verdict, (fused((0.03, 0.02), (0.03, 0.02), (0.02, 0.02)),), True),
    (defocus_fusion.verdict, (fused((0.03, 0.02), (0.03, 0.02), (0.01, 0.02)),), False),  # never lower, in the paper
    *((defocus_fusion.verdict, (x,), None) for x in (fused((0.02, 0.02), (0.02, 0.02)), fused())),
    (focus_stack.verdict, (stacks(0.69, 0.15, 0.21),), True),
    *((focus_stack.verdict, (stacks(*x),), False) for x in ((0.3, 0.1, 0.1), (0.69, 0.6, 0.2), (0.69, 0.1, 0.9))),
    (learned.verdict, (networks((0.06, 0.03), (0.05, 0.02), (0.02, 0.03)), "paper", "vggt_oracle"), True),
    (learned.verdict, (networks((0.06, 0.03), (0.02, 0.03)), "paper", "vggt_oracle"), False),
    (learned.verdict, (networks((None, 0.03), (0.02, None)), "paper", "vggt_oracle"), None),
    *(
        (learned_score.verdict, (intervals((0.6, 0.5, 0.7), x),), y)
        for x, y in (((0.9, 0.85, 0.95), True), ((0.95, 0.85, 1.02), None), ((1.01, 0.85, 1.2), False))
    ),
    (learned_score.verdict, (intervals((0.6, None, None), (0.9, None, None)),), None),
    *(
        (latency.verdict, ("paper", times(a, b), SIZES, LOST), y)
        for a, b, y in (
            *(((100, 200), (1.0, 3.0), True), ((50, 90), (1.0, 3.0), False), ((100, 200), (3.5, 4.0), False)),
            *(((90, 200), (1.0, 3.0), None), ((100, 200), (3.0, 4.0), None), ((90, 200), (3.5, 4.0), False)),
            *((None, (1.0, 3.0), None), (None, (3.5, 4.0), False)),
        )
    ),
    *((robot, (x,), y) for x, y in ((1.006, True), (1.05, False), (0.90, False))),
    *((partial(robot, origin=None), (1.006,), None), (partial(robot, spread=0.3), (1.0,), None)),
    (partial(robot, true_motion=1.0, shuffled=1.0), (1.006,), None),  # shuffled features that help are a leak
    *((partial(robot, **CONTROLS, true_depth=x), (1.006,), y) for x, y in ((1.0, True), (2.0, None))),
    *((downstream, x, y) for x, y in (((), True), ((1.2,), False), ((1.2, 1.0), None))),
    *((dense, (), None), (partial(dense, dense__wrong_share=0.06), (), False)),
]


@pytest.mark.parametrize(
    ("verdict", "arguments", "expected"),
    [
        pytest.param(*row, id=f"{getattr(row[0], '__module__', 'probe').rpartition('.')[2]} {k}")
        for k, row in enumerate(VERDICTS)
    ],
)
def test_a_verdict_goes_either_way(verdict, arguments, expected):
    holds, why = verdict(*arguments)
    assert holds is expected and why
