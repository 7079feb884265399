"""Rows of a result: rows of pairs → row of a scene → summary over scenes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from dhtorch import pytree
from dhtorch.metrics import curves, errors, holdout, reliability, risk
from dhtorch.pipeline.pair import merge
from dhtorch.records import Estimate, Samples

Row = dict[str, Any]

#: Maximum number of points of an overlay.
MAX_OVERLAY_POINTS = 200

#: Columns of a pair that a scene row recomputes from its pooled points, or that identify the pair.
_RECOMPUTED_COLUMNS = {
    "scene",
    "pair",
    "method",
    "truth",
    "gate_share",
    "ms",
    "pnp_ok",
    "n_inlier",
    "n_holes",
    "n_recovered",
    "n_real_holes",
}


def scene_row(
    pairs: Sequence[Row],
    points: Sequence[errors.Points],
    dropped: Sequence[Mapping[str, int]],
    apart: Mapping[str, Sequence[errors.Points]],
    *,
    reads_score: bool = True,
) -> Row:
    """Rows and points of the pairs of one scene and variant → scene row: pooled metrics, means and medians over pairs.

    Args:
        pairs: rows of the pairs.
        points: candidates of each pair.
        dropped: counts of returns that the truth test removed, of each pair.
        apart: kind of surface → candidates on it, of surfaces that are evaluated separately.
        reads_score: evaluate the score as a probability; None otherwise: a score that only orders answers claims none.
    """
    pool = pytree.collate(points)
    row: Row = errors.measure_errors(pool) | risk.measure_risk(pool)
    row |= reliability.measure_reliability([pool if reads_score else pool[:0]])
    row["pnp_success"] = mean_or_none([float(r["pnp_ok"]) for r in pairs])
    row |= {key: mean_or_none([r[key] for r in pairs]) for key in ("n_holes", "n_recovered")}
    row["n_dropped"] = {k: sum(d[k] for d in dropped) for k in dropped[0]}
    row["truth_kept"] = holdout.truth_kept_ratio(pool.keep.numel(), row["n_dropped"])
    row["n_real_holes"] = sum(r["n_real_holes"] for r in pairs)
    row["gate_share"] = {k: mean_or_none([r["gate_share"][k] for r in pairs]) for k in pairs[0]["gate_share"]}
    row["ms"] = {k: median_or_none([r["ms"].get(k, 0.0) for r in pairs]) for k in pairs[0]["ms"]}
    row["apart"] = {kind: errors.measure_errors(pytree.collate(p)) for kind, p in apart.items()}
    row["curves"] = curves.sample_curves(pool)
    extra = {
        k
        for r in pairs
        for k, v in r.items()
        if k not in _RECOMPUTED_COLUMNS | row.keys() and isinstance(v, int | float)
    }
    return row | {k: median_or_none([r[k] for r in pairs if r.get(k) is not None]) for k in sorted(extra)}


def summarise_rows(rows: Sequence[Row], variants: Sequence[str], cohorts: Sequence[str]) -> dict[str, Any]:
    """Scene rows → ``<variant>.<metric>`` and, for further cohorts, ``<variant>.<cohort>.<metric>``.

    With one variant and one cohort the prefix is left out. Scenes with a role enter no number.
    """
    summary: dict[str, Any] = {}
    for variant in variants:
        for cohort in cohorts:
            scenes = [
                {k: v for k, v in row.items() if k not in ("pair", "role")}
                for row in rows
                if row["pair"] is None and (row["method"], row["truth"], row["role"]) == (variant, cohort, None)
            ]
            prefix = f"{variant}." if len(variants) > 1 or len(cohorts) > 1 else ""
            if cohort != cohorts[-1]:
                prefix += f"{cohort}."
            summary |= {prefix + name: value for name, value in errors.summarise_scenes(scenes).items()}
    return summary


def overlay_points(samples: Samples, estimate: Estimate, hw: tuple[int, int]) -> Row:
    """Pixels, gates, sources and depths of at most :data:`MAX_OVERLAY_POINTS` samples of the first pair, for drawing.

    Without the image: result files are published, and licences of many data sets do not allow that.
    """
    whole = merge(samples, estimate)
    step = max(1, math.ceil(samples.uv.shape[1] / MAX_OVERLAY_POINTS))
    columns: Row = {"hw": list(hw), "u": whole.uv[0, ::step, 0].round(), "v": whole.uv[0, ::step, 1].round()}
    columns |= {"gate": estimate.gate[0, ::step], "source": whole.source[0, ::step]}
    columns |= {"depth": [float(f"{v:.4g}") for v in whole.depth[0, ::step].tolist()]}
    return {k: v.int().tolist() if isinstance(v, Tensor) else v for k, v in columns.items()}


def mean_or_none(values: Sequence[float]) -> float | None:
    """Mean; None if there are no values."""
    return sum(values) / len(values) if values else None


def median_or_none(values: Sequence[float]) -> float | None:
    """Lower median; None if there are no values."""
    return float(torch.tensor(values, dtype=torch.float64).median()) if values else None
