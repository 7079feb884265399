"""Question: is the device's own trajectory good enough to triangulate with?

Expectation (written before the run): no; as the device writes it, it is useless where its axes differ from the
camera's, and even converted its rotation is off by more than triangulation forgives, so that depth correlates with
truth better under the anchored pose.
What would refute it: on the median scene the converted trajectory gives a correlation at least as high and an error at
most as large as the anchored pose. (On data sets whose trajectory comes from a motion-capture system or from depth
registration this may well happen: they are not a phone's.)
"""

import math
from collections.abc import Mapping, Sequence
from functools import partial

from dhtorch.data.scene import SceneLike, scenes_of
from dhtorch.experiments.cohorts import (
    HeldOut,
    hide_nothing,
    missing_trajectory_reason,
    trajectory_pose,
    trajectory_pose_fit,
)
from dhtorch.experiments.outcome import Row
from dhtorch.experiments.protocol import (
    Answer,
    Method,
    Outcome,
    Progress,
    Protocol,
    ScenePairs,
    Settings,
    no_progress,
    run_protocol,
)
from dhtorch.geometry import se3


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    progress: Progress = no_progress,
) -> Outcome:
    """Errors of held-out samples triangulated under the device's trajectory, raw and converted, and under ours.

    Variants ``device_raw`` (left out where every trajectory has OpenCV axes: it would be ``device_gl_to_cv`` again),
    ``device_gl_to_cv``, ``anchored`` (the pose estimated from near returns); rows carry
    ``rotation_deg``, ``translation_m`` and ``direction_deg``, by which each variant's relative pose differs from the
    converted trajectory's. Cohort: set B of the hold-out, the same for all three.

    Args and errors: as :func:`dhtorch.experiments.protocol.run`; of ``methods`` the first is used.
    Source: paper, "LiDAR-anchored relative pose".
    """
    split = HeldOut(next(iter(methods.values())), settings)
    has_other_axes = any(s.recording.pose_axes != "cv" for s in scenes_of(scenes) if s.recording.poses is not None)
    raw = split.variant(fit=partial(trajectory_pose_fit, raw=True), needs=missing_trajectory_reason)
    variants = ({"device_raw": raw} if has_other_axes else {}) | {
        "device_gl_to_cv": split.variant(fit=trajectory_pose_fit, needs=missing_trajectory_reason),
        "anchored": split.variant(),
    }
    heldout_protocol = Protocol(variants, {"heldout": split.heldout}, hide_nothing, _trajectory_disagreement)
    outcome = run_protocol(scenes, heldout_protocol, pairs, settings, progress=progress)
    return outcome.decide(
        "Is the device's own trajectory good enough to triangulate with?",
        "No: depth correlates with truth better, and errs less, under the anchored pose.",
        *verdict(outcome),
    )


def _trajectory_disagreement(answer: Answer) -> Row:
    """Difference of a pair's relative pose from that of the device's trajectory: rotation, translation, direction."""
    device_pose, fit = trajectory_pose(answer.batch), answer.trace["fit"]
    if device_pose is None or not bool(fit.ok[0]):
        return {"rotation_deg": None, "translation_m": None, "direction_deg": None, "baseline_m": None}
    device_pose, T = device_pose.to(fit.cov.dtype), fit.T_1_from_0
    angle = se3.rotation_angle(T.R @ device_pose.R.mT)[0]
    norms = (T.t.norm(dim=-1) * device_pose.t.norm(dim=-1)).clamp_min(1e-12)
    direction = ((T.t * device_pose.t).sum(-1) / norms).clamp(-1, 1).acos()[0]
    return {
        "rotation_deg": math.degrees(float(angle)),
        "translation_m": float((T.t - device_pose.t).norm(dim=-1)[0]),
        "direction_deg": math.degrees(float(direction)),
        "baseline_m": float(T.t.norm(dim=-1)[0]),
    }


def verdict(outcome: Outcome) -> tuple[bool | None, str]:
    """(the estimated pose is better in correlation and error on most scenes with a trajectory; both numbers)."""
    device = outcome.scenes("device_gl_to_cv", "heldout")
    ours = outcome.scenes("anchored", "heldout")
    both = [s for s in device if None not in (device[s].get("corr"), ours[s].get("corr"))]
    if not both:
        return None, "no scene on which both poses gave answers"
    better = [ours[s]["corr"] > device[s]["corr"] and ours[s]["median_rel"] < device[s]["median_rel"] for s in both]
    summary = outcome.summary

    def describe(variant: str) -> str:
        corr, error = (summary[f"{variant}.{k}"]["value"] for k in ("corr", "median_rel"))
        return "no answer" if corr is None else f"corr {corr:.2f}, error {error:.1%}"

    variants = [v for v in ("device_raw", "device_gl_to_cv", "anchored") if f"{v}.corr" in summary]
    why = "; ".join(f"{v}: {describe(v)}" for v in variants)
    why += "" if "device_raw" in variants else "; all trajectories have OpenCV axes: raw and converted are the same"
    return sum(better) > len(both) / 2, f"anchored better in both on {sum(better)} of {len(both)} scenes; {why}"
