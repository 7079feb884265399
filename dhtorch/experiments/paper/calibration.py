"""Question: does the score order answers by risk, and is it a probability?

Expectation (written before the run): it orders, not strictly (risk falls at first as the threshold rises, the trend
is not monotone), and it is not a probability (the paper: expected calibration error 0.22 to 0.28).
What would refute it: on the median scene the area under the risk–coverage curve is not below the mean risk of all
answers (no order), or the expected calibration error is at most 0.1 (calibrated after all).
"""

from collections.abc import Mapping, Sequence

from dhtorch.data.scene import SceneLike
from dhtorch.experiments.cohorts import HeldOut, hide_nothing
from dhtorch.experiments.outcome import Row, join_outcomes, summarise_rows
from dhtorch.experiments.protocol import (
    Method,
    Outcome,
    Progress,
    Protocol,
    ScenePairs,
    Settings,
    Variant,
    no_progress,
    run_protocol,
)
from dhtorch.metrics import bootstrap, errors, reliability, risk


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    thresholds: Sequence[float] = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
    progress: Progress = no_progress,
) -> Outcome:
    """Reliability, risk–coverage and risk at thresholds of every method, on the range split and on the hold-out.

    Cohorts ``heldout`` and that of the range split (``full``, or another ``holdout.truth``), which decides. Scene rows
    carry ``mean_risk`` and, under
    ``at_<threshold>``, coverage, median and p90 error of the answers whose score reaches the threshold. The summary
    adds ``<method>.ece_pooled``: all scenes in one reliability table, each of equal weight.

    Args:
        scenes, methods, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        thresholds: thresholds of the score.

    Source: paper, "Calibration" and the figure on selective risk–coverage.
    """
    range_protocol = Protocol({name: Variant(m) for name, m in methods.items()}, reads_scores=True)
    parts = [run_protocol(scenes, range_protocol, pairs, settings, progress=progress)]
    for name, method in methods.items():
        heldout = HeldOut(method, settings)
        cohorts = {"heldout": heldout.heldout}
        heldout_protocol = Protocol({name: heldout.variant()}, cohorts, hide_nothing, reads_scores=True)
        parts.append(run_protocol(scenes, heldout_protocol, pairs, settings, progress=progress))
    outcome = join_outcomes(parts)
    for row in outcome.rows:
        key = (row["scene"], row["method"], row["truth"])
        if row["pair"] is None and key in outcome.points:
            row.update(_at_thresholds(outcome.points[key], thresholds))
    outcome.summary = summarise_rows(outcome.rows, list(methods), ["heldout", *settings.truth])
    with_role = {r["scene"] for r in outcome.rows if r.get("role")}
    for name in methods:
        points = outcome.points.items()
        own = [p for (s, m, t), p in points if (m, t) == (name, outcome.cohort) and s not in with_role]
        ece = reliability.measure_reliability(own)["ece"]
        outcome.summary[f"{name}.ece_pooled"] = bootstrap.without_interval(ece, len(own))
    return outcome.decide(
        "Does the score order answers by risk, and is it a probability?",
        "It orders (AURC below the mean risk) without being calibrated (ECE above 0.1).",
        *verdict(outcome, next(iter(methods))),
    )


def verdict(outcome: Outcome, method: str) -> tuple[bool | None, str]:
    """(the score orders answers on most scenes and its ECE exceeds 0.1; scene medians), on the range split."""
    scenes = [r for r in outcome.scenes(method).values() if r.get("aurc") is not None]
    if not scenes:
        return None, "no scene with answers"
    orders = sum(r["aurc"] < r["mean_risk"] for r in scenes)
    medians = {
        k: bootstrap.interval_over_scenes([r[k] for r in scenes]).value
        for k in ("aurc", "mean_risk", "ece", "monotonicity")
    }
    medians_text = ", ".join(f"{k} {v:.3f}" for k, v in medians.items() if v is not None)
    holds = orders > len(scenes) / 2 and medians["ece"] is not None and medians["ece"] > 0.1
    return holds, f"orders answers on {orders} of {len(scenes)} scenes; scene medians: {medians_text}"


def _at_thresholds(points: errors.Points, thresholds: Sequence[float]) -> Row:
    answered = points.answered()
    row: Row = {"mean_risk": float(risk.cap_error(answered.error).mean()) if answered.error.numel() else None}
    for threshold in thresholds:
        above = points.replace(keep=points.keep & (points.score >= threshold))
        metrics = errors.measure_errors(above)
        row[f"at_{threshold:g}"] = {k: metrics[k] for k in ("n_kept", "coverage", "median_rel", "p90_rel")}
    return row
