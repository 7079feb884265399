"""Question: does recovery depend on the translational baseline?

Expectation (written before the run): yes; with a longer baseline more of the candidates are answered and more holes
are recovered until tracking suffers, and answers err less; a nearly static camera recovers little (the paper: 663
against 105 hole candidates, 1.4 against 3.5 %).
What would refute it: over the pairs of the median scene the share of recovered holes does not rise, or the error does
not fall, with the baseline.
"""

from collections.abc import Mapping, Sequence
from functools import partial

import torch

from dhtorch.data.scene import SceneLike
from dhtorch.experiments.cohorts import HeldOut
from dhtorch.experiments.outcome import Row, join_outcomes
from dhtorch.experiments.paper.gate_ablation import pairs_at_gaps, sweep_gaps
from dhtorch.experiments.paper.heldout import recovery_columns
from dhtorch.experiments.protocol import Answer, Method, Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.metrics import bootstrap
from dhtorch.metrics.correlation import spearman


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    factors: Sequence[float] = (0.25, 0.5, 1.0, 2.0),
    progress: Progress = no_progress,
) -> Outcome:
    """Rank correlation of recovery and error with the baseline, from the hold-out at several frame gaps.

    Every pair's row carries ``baseline_m`` and ``recovered_share``. Rows of scenes carry ``rank_corr_recovered`` and
    ``rank_corr_error``: Spearman correlation over the scene's pairs, all gaps together, of the baseline with the
    recovered fraction of holes and with the median error.

    Args:
        scenes, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: name → method; the first is used.
        pairs: not used; pairs are made from ``factors``.
        factors: gaps, as factors on the scene's own.

    Source: paper, "Held-out triangulation on in-house captures" and "Limitations" (motion dependence).
    """
    split = HeldOut(next(iter(methods.values())), settings)
    parts = sweep_gaps(scenes, split, pairs_at_gaps(factors, ()), settings, progress, partial(_baseline_columns, split))
    outcome = join_outcomes(parts)
    for name in dict.fromkeys(r["scene"] for r in outcome.rows):
        pair_rows = [r for r in outcome.rows if r["scene"] == name and r["pair"] is not None]
        trend = {
            "rank_corr_recovered": _spearman(pair_rows, "recovered_share"),
            "rank_corr_error": _spearman(pair_rows, "median_rel"),
        }
        for row in outcome.rows:
            if row["scene"] == name and row["pair"] is None:
                row.update(trend)
    return outcome.decide(
        "Does recovery depend on the translational baseline?",
        "With a longer baseline more holes are recovered, and answers err less.",
        *verdict(outcome),
    )


def _baseline_columns(split: HeldOut, answer: Answer) -> Row:
    """Baseline and recovered fraction of holes of one pair."""
    columns = recovery_columns(split, answer)
    fit = answer.trace["fit"]
    baseline = float(fit.T_1_from_0.t[0].norm()) if bool(fit.ok[0]) else None
    ratio = columns["n_recovered"] / columns["n_holes"] if columns["n_holes"] else None
    return columns | {"baseline_m": baseline, "recovered_share": ratio}


def verdict(outcome: Outcome) -> tuple[bool | None, str]:
    """(recovery rises and error falls with the baseline on the median scene; rank correlations)."""
    scenes = {r["scene"]: r for r in outcome.rows if r["pair"] is None and r["role"] is None}.values()
    recovered = bootstrap.interval_over_scenes([r["rank_corr_recovered"] for r in scenes])
    error = bootstrap.interval_over_scenes([r["rank_corr_error"] for r in scenes])
    if recovered.value is None or error.value is None:
        return None, "no scene with pairs of different baselines"
    return recovered.value > 0 and error.value < 0, (
        f"rank correlation with the baseline, median over {recovered.n} scenes: recovered share "
        f"{recovered.value:+.2f}, error {error.value:+.2f}"
    )


def _spearman(rows: Sequence[Row], metric: str) -> float | None:
    """Rank correlation of a metric with the baseline over the pairs that have both; None with fewer than 4."""
    both = [(r["baseline_m"], r[metric]) for r in rows if None not in (r.get("baseline_m"), r.get(metric))]
    if len(both) < 4:
        return None
    x, y = (torch.tensor(v, dtype=torch.float64) for v in zip(*both, strict=True))
    return spearman(x, y)
