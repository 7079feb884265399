"""Risk–coverage, distance and reliability curves of a scene, sampled for the figures and small in a result file."""

from __future__ import annotations

import math
from typing import Any

import torch

from dhtorch.metrics import reliability, risk
from dhtorch.metrics.errors import Points

#: Number of points of a risk–coverage curve, and of bins of the other two curves.
_N_CURVE_POINTS, _N_BINS = 20, 10


def sample_curves(pooled: Points) -> dict[str, Any]:
    """Risk–coverage, error-over-distance and reliability curves of one scene, as lists of equal length.

    Returns:
        ``risk_coverage``: ``coverage`` (fraction of the candidates), ``risk`` (mean capped error of the answers with
        the highest scores), ``oracle`` (the same by rising error), ``score`` (threshold) and ``median_rel`` at
        twentieths of the answers. ``distance``: tenths of the candidates by true depth: ``depth`` (m, median),
        ``coverage``, ``median_rel`` (None without answers). ``reliability``: ``claimed``, ``realised`` and ``weight``
        in ten bins of equal width (None where empty). Empty lists without answers or candidates.
    """
    answered = pooled.answered()
    n = answered.keep.numel()
    order = answered.score.argsort(descending=True, stable=True)
    rank = torch.tensor(
        sorted({max(1, round(n * (k + 1) / _N_CURVE_POINTS)) for k in range(_N_CURVE_POINTS)}) if n else [],
        dtype=torch.long,
    )
    coverage, mean = risk.risk_coverage(pooled)
    _, oracle = risk.risk_coverage(pooled, oracle=True)
    ranked = answered.error[order]
    return {
        "risk_coverage": {
            "coverage": _round_digits(coverage[rank - 1].tolist()),
            "risk": _round_digits(mean[rank - 1].tolist()),
            "oracle": _round_digits(oracle[rank - 1].tolist()),
            "score": _round_digits(answered.score[order][rank - 1].tolist()),
            "median_rel": _round_digits([float(ranked[:k].quantile(0.5)) for k in rank.tolist()]),
        },
        "distance": _by_distance(pooled),
        "reliability": _reliability(pooled),
    }


def _by_distance(pooled: Points) -> dict[str, list[float | None]]:
    bins = torch.tensor_split(pooled.true_depth.argsort(stable=True), min(_N_BINS, pooled.true_depth.numel()) or 1)
    curves: dict[str, list[float | None]] = {"depth": [], "coverage": [], "median_rel": []}
    for index in bins if pooled.true_depth.numel() else ():
        points: Points = pooled[index]
        error = points.answered().error
        curves["depth"].append(float(points.true_depth.quantile(0.5)))
        curves["coverage"].append(float(points.keep.double().mean()))
        curves["median_rel"].append(float(error.quantile(0.5)) if error.numel() else None)
    return {name: _round_digits(values) for name, values in curves.items()}


def _reliability(pooled: Points) -> dict[str, list[float | None]]:
    table = reliability.reliability_diagram(*reliability.pool_answers([pooled]), bins=_N_BINS)
    return {name: _round_digits(getattr(table, name).tolist()) for name in ("claimed", "realised", "weight")}


def _round_digits(values: list[float | None]) -> list[float | None]:
    """Five significant digits: enough for a figure, short in a result file. NaN becomes None."""
    return [None if v is None or math.isnan(v) else float(f"{v:.5g}") for v in values]
