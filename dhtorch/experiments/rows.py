"""Rows of a result: how the pairs of a scene become one row, and the rows of scenes a summary."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from dhtorch import pytree
from dhtorch.metrics import curves, errors, reliability, risk
from dhtorch.pipeline.pair import merge
from dhtorch.records import Estimate, Samples

Row = dict[str, Any]

#: Points of an overlay.
MAX_OVERLAY_POINTS = 200

#: Columns of a pair that a scene row measures anew on its pooled points, or that name the pair.
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
}


def scene_row(
    pairs: Sequence[Row],
    points: Sequence[errors.Points],
    dropped: Sequence[Mapping[str, int]],
    apart: Mapping[str, Sequence[errors.Points]],
) -> Row:
    """One scene and variant: metrics over the pooled points, means and medians over the pairs.

    Args:
        pairs: rows of the pairs.
        points: their candidates.
        dropped: their counts of what the truth test removed.
        apart: candidates on surfaces that are counted apart.
    """
    pool = pytree.collate(points)
    row: Row = errors.measure_errors(pool) | risk.measure_risk(pool) | reliability.measure_reliability([pool])
    row["pnp_success"] = mean_or_none([float(r["pnp_ok"]) for r in pairs])
    row |= {key: mean_or_none([r[key] for r in pairs]) for key in ("n_holes", "n_recovered")}
    row["n_dropped"] = {k: sum(d[k] for d in dropped) for k in dropped[0]}
    row["gate_share"] = {k: mean_or_none([r["gate_share"][k] for r in pairs]) for k in pairs[0]["gate_share"]}
    row["ms"] = {k: median_or_none([r["ms"].get(k, 0.0) for r in pairs]) for k in pairs[0]["ms"]}
    row["apart"] = {kind: errors.measure_errors(pytree.collate(p)) for kind, p in apart.items()}
    row["curves"] = curves.sample_curves(pool)
    more = {
        k
        for r in pairs
        for k, v in r.items()
        if k not in _RECOMPUTED_COLUMNS | row.keys() and isinstance(v, int | float)
    }
    return row | {k: median_or_none([r[k] for r in pairs if r.get(k) is not None]) for k in sorted(more)}


def summarise_rows(rows: Sequence[Row], variants: Sequence[str], cohorts: Sequence[str]) -> dict[str, Any]:
    """Scene rows → ``<variant>.<metric>`` and, for further cohorts, ``<variant>.<cohort>.<metric>``.

    With one variant and one cohort the prefix is left out. Scenes with a role stay out of every number.
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
    """The first pair as points to draw: pixels, gates, sources and depths of at most :data:`MAX_OVERLAY_POINTS`
    samples.

    No picture goes along: result files are published, and licences of many data sets do not allow that.
    """
    whole = merge(samples, estimate)
    step = max(1, math.ceil(samples.uv.shape[1] / MAX_OVERLAY_POINTS))
    found: Row = {"hw": list(hw), "u": whole.uv[0, ::step, 0].round(), "v": whole.uv[0, ::step, 1].round()}
    found |= {"gate": estimate.gate[0, ::step], "source": whole.source[0, ::step]}
    found |= {"depth": [float(f"{v:.4g}") for v in whole.depth[0, ::step].tolist()]}
    return {k: v.int().tolist() if isinstance(v, Tensor) else v for k, v in found.items()}


def mean_or_none(values: Sequence[float]) -> float | None:
    """Mean, None of nothing."""
    return sum(values) / len(values) if values else None


def median_or_none(values: Sequence[float]) -> float | None:
    """Lower median, None of nothing."""
    return float(torch.tensor(values, dtype=torch.float64).median()) if values else None
