"""Question: when the pose never sees the points it is judged by, how good is triangulated depth, scene by scene?

Expectation (written before the run): the hold-out error is well above that of the naive protocol, which judges the
pose by the inliers it was fitted to (the paper: 3.5 against 0.7 %); most scenes with a clear baseline pass the strict
line, nearly static or nearly rotating ones do not.
What would refute it: the naive protocol is not the smaller of the two on most scenes, or fewer than half the scenes
pass the strict line.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import torch

from dhtorch.data.scene import SceneLike
from dhtorch.experiments import protocol
from dhtorch.experiments.cohorts import HeldOut, hide_nothing
from dhtorch.experiments.outcome import join_outcomes
from dhtorch.experiments.protocol import Answer, Method, Outcome, Progress, Protocol, ScenePairs, Settings
from dhtorch.experiments.rows import Row
from dhtorch.metrics import bootstrap

QUESTION = "How good is triangulated depth on points that the pose never saw, and how many scenes pass the strict line?"
EXPECTATION = "Judging by the pose's own inliers flatters; at least half of the scenes pass the strict line."

#: The strict line of a scene: correlation above, errors and residual below, and answers enough to speak of.
_MIN_CORR, _MAX_MEDIAN_REL, _MAX_RESIDUAL_PX, _MIN_ANSWERS = 0.8, 0.1, 3.0, 10


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    progress: Progress = protocol.no_progress,
) -> Outcome:
    """Split the returns of every pair in halves A (pose) and B (evaluation); judge by B, and naively by A's inliers.

    Rows: cohorts ``cyclic`` and ``heldout``; the held-out scene rows also say whether the scene ``passes``, how far
    recovered holes reach (``reach_p95_m``, ``reach_max_m``, of the pairs' values the median) beside the sensor's own
    returns (``returns_p95_m``). The summary adds ``<method>.n_passes`` and ``<method>.n_scenes``.

    Args and errors: as :func:`dhtorch.experiments.protocol.run`; ``methods`` is name → method.
    Source: paper, "Held-out triangulation on in-house captures" and "Cross-dataset geometry and calibration".
    """
    parts = []
    for name, method in methods.items():
        split = HeldOut(method, settings.seed)
        cohorts = {"cyclic": split.cyclic, "heldout": split.heldout}
        asked = Protocol({name: split.variant()}, cohorts, hide_nothing, partial(recovery_columns, split))
        part = protocol.run(scenes, asked, pairs, settings, progress=progress)
        part.summary |= {f"{name}.{k}": v for k, v in _mark_passes(part.rows, name).items()}
        parts.append(part)
    outcome = join_outcomes(parts)
    return outcome.decide(QUESTION, EXPECTATION, *verdict(outcome, next(iter(methods))))


def recovery_columns(split: HeldOut, answer: Answer) -> Row:
    """How many of the sensor's true holes were recovered and how far they lie, beside how far the sensor sees."""
    whole = split.whole(answer.batch, answer.samples.uv)
    hole = ~whole.usable
    found = answer.estimate.depth[hole & answer.estimate.keep]
    returns = whole.depth[~hole]
    numbers: Row = {"n_holes": int(hole.sum()), "n_recovered": found.numel()}
    for name, depths in (("reach", found), ("returns", returns)):
        some = depths.numel() > 0
        numbers[f"{name}_p95_m"] = float(depths.double().quantile(0.95)) if some else None
        numbers[f"{name}_max_m"] = float(depths.max()) if some else None
    return numbers


def passes_strict_line(row: Mapping[str, Any]) -> bool:
    """Whether a scene passes the strict line; one with fewer than 10 answers does not."""
    numbers = [row.get(k) for k in ("corr", "median_rel", "residual_px")]
    if row.get("n_kept", 0) < _MIN_ANSWERS or any(v is None for v in numbers):
        return False
    corr, median_rel, residual_px = (float(v) for v in numbers if v is not None)
    return corr > _MIN_CORR and median_rel < _MAX_MEDIAN_REL and residual_px < _MAX_RESIDUAL_PX


def _mark_passes(rows: Sequence[Row], method: str) -> dict[str, Any]:
    """Mark the scene rows of the hold-out with ``passes``; their count, and the number of scenes."""
    judged = [r for r in rows if r["pair"] is None and (r["method"], r["truth"]) == (method, "heldout")]
    for row in judged:
        row["passes"] = passes_strict_line(row)
    counted = [r for r in judged if r["role"] is None]
    values = {"n_passes": sum(r["passes"] for r in counted), "n_scenes": len(counted)}
    return {k: bootstrap.without_interval(v, len(counted), "count") for k, v in values.items()}


def verdict(outcome: Outcome, method: str) -> tuple[bool | None, str]:
    """Does the naive protocol flatter, and do half the scenes pass?"""
    naive, honest = outcome.scenes(method, "cyclic"), outcome.scenes(method, "heldout")
    both = [s for s in honest if None not in (naive[s].get("median_rel"), honest[s].get("median_rel"))]
    if not both:
        return None, "no scene on which both protocols have answers"
    ratios = torch.tensor([honest[s]["median_rel"] / max(naive[s]["median_rel"], 1e-9) for s in both])
    flatters = int((ratios > 1).sum())
    n_passes = sum(r["passes"] for r in honest.values())
    typical = bootstrap.interval_over_scenes(ratios.tolist()).value
    holds = flatters > len(both) / 2 and n_passes >= len(honest) / 2
    return holds, (
        f"{n_passes} of {len(honest)} scenes pass the strict line; hold-out error over the naive protocol's: "
        f"median {typical:.2f}, above 1 on {flatters} of {len(both)} scenes"
    )
