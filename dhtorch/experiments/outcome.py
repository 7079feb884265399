"""Outcome of a job: rows, a summary over scenes, examples, and the answer to its question."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from dhtorch import pytree
from dhtorch.metrics import curves, errors, holdout, reliability, risk
from dhtorch.pipeline.pair import merge
from dhtorch.records import Estimate, Frame, Samples

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


@dataclass(frozen=True)
class MainMetric:
    """A metric by which the jobs of a sweep are compared; its unit is that of its entries in the summary."""

    name: str  # in the summary, without the name of the variant
    larger_is_better: bool | None = None  # None = neither is
    with_interval: bool = False  # compared with its interval


#: Main metrics of experiments on depth at samples.
DEPTH_METRICS = (
    MainMetric("coverage", larger_is_better=True),
    MainMetric("median_rel", larger_is_better=False),
    MainMetric("p90_rel", larger_is_better=False),
    MainMetric("corr", larger_is_better=True),
    MainMetric("coverage_at_5", larger_is_better=True),
    MainMetric("ms", larger_is_better=False),
)


@dataclass(frozen=True)
class Example:
    """First pair of a scene, for figures and the point cloud (batch size 1)."""

    scene: str
    method: str
    frame: Frame  # the method's input
    samples: Samples
    estimate: Estimate
    truth: holdout.Truth
    pair: str = ""  # the reference view and the views that were used, as numbers of the recording
    cutoff: float | None = None  # m
    #: Options of dhtorch.pipeline.completion.complete_depth; None for variants with a call or a pose of their own.
    call_options: dict[str, Any] | None = None

    def cpu(self) -> "Example":
        """Example on the CPU, for figures."""
        moved = {k: getattr(self, k).to("cpu") for k in ("frame", "samples", "estimate", "truth")}
        return replace(self, **moved)


@dataclass
class Outcome:
    """Rows of a result file, the summary over scenes, and an example of each scene."""

    rows: list[Row] = field(default_factory=list)
    summary: dict[str, Any] = field(default_factory=dict)
    examples: list[Example] = field(default_factory=list)
    n_pairs: int = 0
    question: str | None = None
    expectation: str | None = None
    verdict: str | None = None
    why: str | None = None
    points: dict[tuple[str, str, str], errors.Points] = field(default_factory=dict)  # (scene, variant, cohort) → pool
    cohort: str = "full"  # the one that the verdict and the numbers of the summary without a cohort are about
    metrics: Sequence[MainMetric] = DEPTH_METRICS  # by which the jobs of a sweep are compared

    def add(self, part: "Outcome") -> None:
        """Add the rows, examples, pairs and points of a part, as of one scene; the summary is not changed."""
        self.rows += part.rows
        self.examples += part.examples
        self.n_pairs += part.n_pairs
        self.points |= part.points

    def decide(self, question: str, expectation: str, holds: bool | None, why: str) -> "Outcome":
        """Outcome with the answer to its question: True supported, False refuted, None undecided."""
        words = {True: "supported", False: "refuted", None: "undecided"}
        return replace(self, question=question, expectation=expectation, verdict=words[holds], why=why)

    def scenes(self, variant: str, cohort: str | None = None) -> dict[str, Row]:
        """Scene → row of one variant and cohort (None = the deciding one); scenes with a role are left out."""
        key = (variant, cohort or self.cohort, None, None)
        return {r["scene"]: r for r in self.rows if (r["method"], r["truth"], r["pair"], r.get("role")) == key}


def join_outcomes(outcomes: Iterable[Outcome]) -> Outcome:
    """Outcomes of several runs as one, with the deciding cohort of the first; their variants have different names."""
    parts = list(outcomes)
    joined = Outcome(cohort=parts[0].cohort, metrics=parts[0].metrics) if parts else Outcome()
    for part in parts:
        known = {example.scene for example in joined.examples}
        joined.add(replace(part, examples=[example for example in part.examples if example.scene not in known]))
        joined.summary |= part.summary
    return joined


#: Number of a summary → (least, largest) value of its bar.
Bars = Mapping[str, tuple[float, float]]


def judge_bars(summary: Mapping[str, Any], bars: Bars) -> tuple[bool | None, str]:
    """(all bars met, None if undecided; the bars that are missed and the numbers that are undefined)."""
    values = {name: summary.get(name, {}).get("value") for name in bars}
    defined = {name: value for name, value in values.items() if value is not None}
    missed = [
        f"{name} {value:.3f} (bar {', '.join(f'{end:g}' for end in bars[name] if math.isfinite(end))})"
        for name, value in defined.items()
        if not bars[name][0] <= value <= bars[name][1]
    ]
    undefined = [name for name in bars if name not in defined]
    notes = [f"not measured: {', '.join(undefined)}"] if undefined else []
    why = "; ".join([f"{len(defined) - len(missed)} of {len(defined)} bars met", *missed, *notes])
    return (None if undefined and not missed else not missed), why
