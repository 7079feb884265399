"""Question: are the sensor's real holes recovered as well as hidden returns?

Expectation (written before the run): no; real drop-outs lie at edges, on dark, shiny and distant surfaces, so on the
median scene their error is larger, and some scenes have no answer at all.
What would refute it: on the median scene the error on real holes is not above that on hidden returns.
"""

from collections.abc import Mapping, Sequence
from functools import partial

from dhtorch.data.scene import SceneLike
from dhtorch.experiments.cohorts import missing_truth_reason, real_holes
from dhtorch.experiments.paper.range_split import NO_GATES
from dhtorch.experiments.protocol import (
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


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    progress: Progress = no_progress,
) -> Outcome:
    """Errors with and without gates on the sensor's own drop-outs and on hidden far returns.

    Needs independent truth: other scenes have a row with a note. A drop-out counts if it passes the filter of
    :func:`dhtorch.metrics.holdout.select_real_holes`; ``n_dropped`` counts the others. Cohorts: ``full`` (hidden
    returns; another ``holdout.truth`` by its name) and ``real_holes``; variants ``no_gates`` and ``gated``.

    Args and errors: as :func:`dhtorch.experiments.protocol.run`; of ``methods`` the first is used.
    Source: paper, "Real holes are harder than masked ones".
    """
    method = next(iter(methods.values()))
    variants = {
        "no_gates": Variant(method.replace(triangulate=NO_GATES), needs=missing_truth_reason),
        "gated": Variant(method, needs=missing_truth_reason),
    }
    test = settings.truth[-1]
    cohorts = {test: partial(held_back_truth, test=test), "real_holes": partial(real_holes, test=test)}
    hole_protocol = Protocol(variants, cohorts, min_candidates=1)
    outcome = run_protocol(scenes, hole_protocol, pairs, settings, progress=progress)
    return outcome.decide(
        "Are the sensor's real holes recovered as well as hidden returns?",
        "No: on the median scene the error on real holes is larger, and some scenes have no answer.",
        *verdict(outcome, test),
    )


def verdict(outcome: Outcome, hidden_cohort: str = "full") -> tuple[bool | None, str]:
    """(the gated method has the larger error on real holes; both errors, scenes without an answer)."""
    holes = outcome.scenes("gated", "real_holes")
    real, hidden = (outcome.summary.get(f"gated.{k}median_rel", {}).get("value") for k in ("", f"{hidden_cohort}."))
    measured = {s: r for s, r in holes.items() if r.get("n_candidates")}
    unanswered = [s for s, r in measured.items() if not r["n_kept"]]
    n = sum(r["n_candidates"] for r in measured.values())
    counted = f"{n} drop-outs on {len(measured)} of {len(holes)} scenes survive the filter"
    note = f"; no answer on {', '.join(unanswered)}" if unanswered else ""
    if real is None or hidden is None:
        return None, counted + note
    return real > hidden, f"{counted}; median error {real:.1%} against {hidden:.1%} on hidden returns{note}"
