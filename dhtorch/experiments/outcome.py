"""Outcome of a job: rows, a summary over scenes, examples, and the answer to its question."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from dhtorch.experiments.rows import Row
from dhtorch.metrics import errors, holdout
from dhtorch.records import Estimate, Frame, Samples


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

    def cpu(self) -> Example:
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

    def add(self, part: Outcome) -> None:
        """Add the rows, examples, pairs and points of a part, as of one scene; the summary is not changed."""
        self.rows += part.rows
        self.examples += part.examples
        self.n_pairs += part.n_pairs
        self.points |= part.points

    def decide(self, question: str, expectation: str, holds: bool | None, why: str) -> Outcome:
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
