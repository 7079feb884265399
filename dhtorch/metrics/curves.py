"""Risk–coverage, distance and reliability curves of a scene, sampled for the figures and small in a result file."""

import math
from typing import Any

import torch

from dhtorch.metrics import reliability, risk
from dhtorch.metrics.errors import Points


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
    rank = torch.tensor(sorted({max(1, round(n * k / 20)) for k in range(1, 21)}) if n else [], dtype=torch.long)
    coverage, mean = risk.risk_coverage(pooled)
    _, oracle = risk.risk_coverage(pooled, oracle=True)
    ranked = answered.error[order]
    diagram = reliability.reliability_diagram(*reliability.pool_answers([pooled]))
    distance: dict[str, list[float | None]] = {"depth": [], "coverage": [], "median_rel": []}
    n_candidates = pooled.true_depth.numel()
    bins = torch.tensor_split(pooled.true_depth.argsort(stable=True), min(10, n_candidates) or 1)
    for index in bins if n_candidates else ():
        points: Points = pooled[index]
        error = points.answered().error
        distance["depth"].append(float(points.true_depth.quantile(0.5)))
        distance["coverage"].append(float(points.keep.double().mean()))
        distance["median_rel"].append(float(error.quantile(0.5)) if error.numel() else None)
    curves = {
        "risk_coverage": {
            "coverage": coverage[rank - 1].tolist(),
            "risk": mean[rank - 1].tolist(),
            "oracle": oracle[rank - 1].tolist(),
            "score": answered.score[order][rank - 1].tolist(),
            "median_rel": [float(ranked[:k].quantile(0.5)) for k in rank.tolist()],
        },
        "distance": distance,
        "reliability": {name: getattr(diagram, name).tolist() for name in ("claimed", "realised", "weight")},
    }
    # Five significant digits: enough for a figure, short in a result file.
    return {
        name: {k: [None if v is None or math.isnan(v) else float(f"{v:.5g}") for v in x] for k, x in curve.items()}
        for name, curve in curves.items()
    }
