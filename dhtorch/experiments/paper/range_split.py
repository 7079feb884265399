"""Question: can near returns alone recover far depth, and is the pose from near returns the cause?

Expectation (written before the run): with returns beyond the cutoff hidden, the anchored pose answers most far
candidates with an error of a few to some ten per cent; triangulation from the device's own trajectory is not usable;
the gates cut the tail (p90) at a small cost in coverage.
What would refute it: on the median scene the gated method answers fewer than a quarter of the candidates, or its error
is not below that of the device's trajectory as the device writes it, or the gates do not lower p90.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from dhtorch.codes import Gate
from dhtorch.data.scene import SceneLike, scenes_of
from dhtorch.experiments.baselines.device_pose import known_pose_fit
from dhtorch.experiments.cohorts import (
    far_real_holes,
    missing_trajectory_reason,
    missing_truth_reason,
    trajectory_pose_fit,
)
from dhtorch.experiments.outcome import Row, join_outcomes
from dhtorch.experiments.protocol import (
    Answer,
    Cohort,
    Method,
    Outcome,
    Progress,
    Protocol,
    ScenePairs,
    Settings,
    Variant,
    held_back_truth,
    no_progress,
    run_protocol,
)
from dhtorch.geometry import se3
from dhtorch.pipeline.spec import Trace
from dhtorch.records import Estimate, Frame

# Baseline without a second view: the sensor's own returns.


def sensor_only(
    method: Method, frame_0: Frame, _frame_1: Frame, *, trace: Trace | None = None, **_options: Any
) -> Estimate:
    """Estimate from the front end's usable returns; every other sample is unanswered (gate NO_TRACK).

    Replaces the call of a method: it runs stages 1 to 3 and does not use the second view.

    Returns:
        Estimate whose ``depth`` and ``sigma`` are the sensor's.
    """
    start = time.perf_counter()
    like = frame_0.camera.f
    samples = method.sample_depth(frame_0)
    keep = samples.usable
    nan = torch.full_like(samples.depth, torch.nan)
    zero = torch.zeros_like(samples.depth)
    estimate = Estimate(
        uv=samples.uv,
        depth=torch.where(keep, samples.depth, nan),
        sigma=torch.where(keep, samples.sigma, nan),
        sigma_shared=torch.where(keep, zero, nan),
        parallax_deg=zero,
        residual_px=zero,
        n_views=torch.ones_like(samples.hole),
        score=torch.where(keep, samples.confidence, zero),
        gate=torch.where(keep, Gate.ANSWER, Gate.NO_TRACK).to(torch.int32),
    )
    if trace is not None:
        eye = se3.identity(like.shape[0], like)
        fit = known_pose_fit(eye.replace(t=torch.full_like(eye.t, torch.nan)), samples.uv.shape[1])
        trace.update(samples=samples, fit=fit, estimate=estimate, ms={"sensor": 1e3 * (time.perf_counter() - start)})
    return estimate


#: Options of the triangulation stage that switch off the paper's two gates.
NO_GATES = {"min_parallax_deg": None, "max_residual_px": None}


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    cutoff_factors: Sequence[float] = (0.75, 1.25),
    cutoffs: Sequence[float] = (),
    progress: Progress = no_progress,
) -> Outcome:
    """Errors and coverage of five estimates of far depth on one cohort, and of the gated one at other cutoffs.

    Variants: ``sensor_only``, ``device_raw``, ``device_gl_to_cv``, ``no_gates``, ``gated`` at the scene's cutoff;
    ``gated, cutoff x0.75`` for each of ``cutoff_factors`` and ``gated, cutoff 1.5 m`` for each of ``cutoffs``.
    Candidates are counted before any of them runs, from independent truth where the recording has it; rows then carry
    ``truth_disagreement``, the median relative difference of truth and sensor where both have depth. A candidate is a
    sample whose return the cutoff masked; those beyond it at which the sensor has no return are the cohort
    ``real_holes``, of the recordings with independent truth. The truth test is that of ``settings.truth``, and
    ``truth_kept`` the fraction of the masked returns that pass it.

    Args:
        scenes, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: name → method; the first is used.
        cutoff_factors: further cutoffs, as factors on the scene's.
        cutoffs: further cutoffs in metres.

    Raises:
        ValueError: a candidate of a scene has a return in the input of the methods; else as the main job.

    Source: paper, "Strict near/far range split".
    """
    method = next(iter(methods.values()))
    device = {
        name: partial(trajectory_pose_fit, raw=raw) for name, raw in (("device_raw", True), ("device_gl_to_cv", False))
    }
    variants = {
        "sensor_only": Variant(method, estimate=sensor_only),
        **{name: Variant(method, fit=fit, needs=missing_trajectory_reason) for name, fit in device.items()},
        "no_gates": Variant(method.replace(triangulate=NO_GATES)),
        "gated": Variant(method),
    }
    test = settings.truth[-1]
    cohorts: dict[str, Cohort] = {test: partial(held_back_truth, test=test)}
    if any(missing_truth_reason(scene) is None for scene in scenes_of(scenes)):
        cohorts = {"real_holes": partial(far_real_holes, test=test), **cohorts}
    main_protocol = Protocol(variants, cohorts, columns=_truth_columns)
    main = run_protocol(scenes, main_protocol, pairs, settings, progress=progress)
    require_no_returns(main.rows, test)
    sweep = {f"gated, cutoff x{f:g}": replace(settings, cutoff_factor=f) for f in cutoff_factors}
    sweep |= {f"gated, cutoff {c:g} m": replace(settings, cutoff=c, cutoff_factor=1.0) for c in cutoffs}
    parts = [main]
    for name, cutoff_settings in sweep.items():
        part = run_protocol(
            scenes,
            Protocol({name: Variant(method)}, {test: cohorts[test]}, columns=_truth_columns),
            pairs,
            cutoff_settings,
            progress=progress,
        )
        part.summary = {f"{name}.{k}": v for k, v in part.summary.items()}
        parts.append(part)
    outcome = join_outcomes(parts)
    return outcome.decide(
        "Can near returns alone recover far depth, and is the pose from near returns the cause?",
        (
            "The gated method answers at least a quarter of the far candidates on the median scene, with an "
            "error below that of triangulation from the device's raw trajectory; the gates lower p90."
        ),
        *verdict(outcome.summary),
    )


def require_no_returns(rows: Sequence[Row], cohort: str) -> None:
    """Check that the sensor alone answers no candidate of the range split.

    Raises:
        ValueError: it does; the message names the scenes.
    """
    answered = {
        row["scene"]: row["n_kept"]
        for row in rows
        if row["pair"] is None and (row["method"], row["truth"]) == ("sensor_only", cohort) and row.get("n_kept")
    }
    if answered:
        counts = ", ".join(f"{scene} {n}" for scene, n in answered.items())
        raise ValueError(f"range_split: found candidates with a return of the sensor ({counts}), expected none")


def verdict(summary: Mapping[str, Any]) -> tuple[bool | None, str]:
    """(coverage, error and p90 of the scene medians meet the expectation; the numbers)."""

    def value(name: str) -> float | None:
        entry: float | None = summary.get(name, {}).get("value")
        return entry

    coverage, error, p90 = (value(f"gated.{k}") for k in ("coverage", "median_rel", "p90_rel"))
    raw, ungated_p90 = value("device_raw.median_rel"), value("no_gates.p90_rel")
    if coverage is None or error is None or p90 is None or ungated_p90 is None:
        return None, "no scene on which the gated method answered"
    raw_text = "no answer" if raw is None else f"{raw:.1%}"
    why = (
        f"gated: coverage {coverage:.1%}, median error {error:.1%}, p90 {p90:.1%} ({ungated_p90:.1%} without gates); "
        f"raw device trajectory: {raw_text} (medians over scenes)"
    )
    return coverage >= 0.25 and (raw is None or error < raw) and p90 < ungated_p90, why


def _truth_columns(answer: Answer) -> Row:
    value = float(answer.batch.disagreement[0])
    return {"truth_disagreement": value if value == value else None}  # noqa: PLR0124  (NaN is not equal to itself)
