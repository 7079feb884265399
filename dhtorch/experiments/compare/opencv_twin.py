"""Question: does the batched torch pipeline give the same results as the same stages by OpenCV, scene by scene?

Expectation (written before the run): yes; on every scene, median error and coverage of ``paper`` lie within 10 % of
those of ``opencv``, because the formulas are the same and only the minimal solver (P3P for EPnP) differs. Where few
points are answered, the choice of minimal samples alone moves both by more. Tracks jump from view to view, since
OpenCV's function has no way through the frames between.
What would refute it: one scene on which either number is worse by more than 10 %.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from dhtorch.data.scene import SceneLike
from dhtorch.experiments import pair
from dhtorch.experiments.protocol import Method, Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.experiments.rows import Row

QUESTION = "Does the batched torch pipeline give the same results as the same stages by OpenCV, scene by scene?"
EXPECTATION = "On every scene median error and coverage of ours are at most 10 % worse than the reference's."


def run(
    scenes: Sequence[SceneLike],
    chosen: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    methods: Mapping[str, Method] | None = None,
    reference: str = "opencv",
    truths: Sequence[str] = ("raw", "5x5", "full"),
    tolerance: float = 0.1,
    progress: Progress = no_progress,
) -> Outcome:
    """Errors and coverage of several methods on the same pairs and truth tests, compared with a reference.

    Args:
        scenes, chosen, pairs, settings, progress: as :func:`dhtorch.experiments.pair.run`.
        methods: name → method; None = ``chosen``. The first that is not the reference is compared with it.
        reference: name of the method to compare with.
        truths: truth tests to report; the last one decides.
        tolerance: fraction by which a number may be worse.

    Raises:
        ValueError: fewer than two methods, or no method of that name; else as the main job.
    """
    methods = dict(methods or chosen)
    if reference not in methods or len(methods) < 2:
        raise ValueError(f"experiment.methods: found {', '.join(methods)}, expected {reference} and one more")
    ours = next(name for name in methods if name != reference)
    settings = replace(settings, truth=tuple(truths), between=0)
    outcome = pair.run(scenes, methods, pairs, settings, progress=progress)
    compared, worse = compare_scenes(outcome.rows, ours, reference, truths[-1], tolerance)
    outcome.question, outcome.expectation = QUESTION, EXPECTATION
    if not compared:
        outcome.verdict, outcome.why = "undecided", "no scene on which both methods answered"
    elif worse:
        outcome.verdict, outcome.why = "refuted", f"worse on {len(worse)} of {compared} scenes: " + "; ".join(worse)
    else:
        outcome.verdict, outcome.why = "supported", f"within {tolerance:.0%} of {reference} on all {compared} scenes"
    return outcome


def compare_scenes(
    rows: Sequence[Row], ours: str, reference: str, truth: str, tolerance: float
) -> tuple[int, list[str]]:
    """(number of compared scenes, a line for every number that is worse by more than ``tolerance``)."""
    scenes = {
        (r["scene"], r["method"]): r for r in rows if r["pair"] is None and r["truth"] == truth and r["role"] is None
    }
    compared, worse = 0, []
    for scene in dict.fromkeys(name for name, _ in scenes):
        a, b = scenes[scene, ours], scenes[scene, reference]
        if a.get("median_rel") is None or b.get("median_rel") is None:
            continue
        compared += 1
        for metric, is_worse in (
            ("median_rel", a["median_rel"] > b["median_rel"] * (1 + tolerance)),
            ("coverage", a["coverage"] < b["coverage"] * (1 - tolerance)),
        ):
            if is_worse:
                worse.append(f"{scene} {metric} {a[metric]:.3f} against {b[metric]:.3f}")
    return compared, worse
