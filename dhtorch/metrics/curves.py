"""Curves of a scene, small enough for a result file: what figures are drawn from."""

from __future__ import annotations

import math
from typing import Any

import torch

from dhtorch.metrics import reliability, risk
from dhtorch.metrics.errors import Points

#: Points of a risk–coverage curve and bins of the other two.
_N_CURVE_POINTS, _N_BINS = 20, 10


def sample_curves(pooled: Points) -> dict[str, Any]:
    """Risk–coverage, error against distance and reliability of one scene, as lists of equal length.

    Returns:
        ``risk_coverage``: ``coverage`` (share of the candidates), ``risk`` (mean capped error of the surest answers so
        far), ``oracle`` (the same by rising error), ``score`` (threshold) and ``median_rel`` at twentieths of the
        answers. ``distance``: tenths of the candidates by true depth: ``depth`` (m, median), ``coverage``,
        ``median_rel`` (None where silent). ``reliability``: ``claimed``, ``realised`` and ``weight`` in ten bins of
        equal width (None where empty). Empty lists without answers or candidates.
    """
    answered = pooled.answered()
    n = answered.keep.numel()
    order = answered.score.argsort(descending=True, stable=True)
    at = torch.tensor(
        sorted({max(1, round(n * (k + 1) / _N_CURVE_POINTS)) for k in range(_N_CURVE_POINTS)}) if n else [],
        dtype=torch.long,
    )
    coverage, mean = risk.risk_coverage(pooled)
    _, oracle = risk.risk_coverage(pooled, oracle=True)
    ranked = answered.error[order]
    return {
        "risk_coverage": {
            "coverage": _round_digits(coverage[at - 1].tolist()),
            "risk": _round_digits(mean[at - 1].tolist()),
            "oracle": _round_digits(oracle[at - 1].tolist()),
            "score": _round_digits(answered.score[order][at - 1].tolist()),
            "median_rel": _round_digits([float(ranked[:k].quantile(0.5)) for k in at.tolist()]),
        },
        "distance": _by_distance(pooled),
        "reliability": _reliability(pooled),
    }


def _by_distance(pooled: Points) -> dict[str, list[float | None]]:
    bins = torch.tensor_split(pooled.true_depth.argsort(stable=True), min(_N_BINS, pooled.true_depth.numel()) or 1)
    found: dict[str, list[float | None]] = {"depth": [], "coverage": [], "median_rel": []}
    for index in bins if pooled.true_depth.numel() else ():
        here: Points = pooled[index]
        error = here.answered().error
        found["depth"].append(float(here.true_depth.quantile(0.5)))
        found["coverage"].append(float(here.keep.double().mean()))
        found["median_rel"].append(float(error.quantile(0.5)) if error.numel() else None)
    return {name: _round_digits(values) for name, values in found.items()}


def _reliability(pooled: Points) -> dict[str, list[float | None]]:
    table = reliability.reliability_diagram(*reliability.pool_answers([pooled]), bins=_N_BINS)
    return {name: _round_digits(getattr(table, name).tolist()) for name in ("claimed", "realised", "weight")}


def _round_digits(values: list[float | None]) -> list[float | None]:
    """Five significant digits: a figure shows no more, and a result file holds many curves. NaN becomes None."""
    return [None if v is None or math.isnan(v) else float(f"{v:.5g}") for v in values]
