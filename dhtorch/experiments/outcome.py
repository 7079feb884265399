"""What a job of the laboratory found: rows, a summary over scenes, examples, and the answer to its question."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

from dhtorch.experiments.rows import Row
from dhtorch.metrics import errors, holdout
from dhtorch.records import Estimate, Frame, Samples


@dataclass(frozen=True)
class Example:
    """The first pair of a scene, kept for figures and the point cloud (batch size 1)."""

    scene: str
    method: str
    frame: Frame  # as the method saw it
    samples: Samples
    estimate: Estimate
    truth: holdout.Truth
    pair: str = ""  # the reference view and the views that were used, as numbers of the recording
    cutoff: float | None = None  # m
    asked: dict[str, Any] | None = (
        None  # as dhtorch.pipeline.dense.complete_depth takes it; None where the method was not simply asked
    )

    def cpu(self) -> Example:
        """The same on the CPU, for figures."""
        moved = {k: getattr(self, k).to("cpu") for k in ("frame", "samples", "estimate", "truth")}
        return replace(self, **moved)


@dataclass
class Outcome:
    """What a job found: rows of a result file, the summary over scenes, and an example of each scene."""

    rows: list[Row] = field(default_factory=list)
    summary: dict[str, Any] = field(default_factory=dict)
    examples: list[Example] = field(default_factory=list)
    n_pairs: int = 0
    question: str | None = None
    expectation: str | None = None
    verdict: str | None = None
    why: str | None = None
    points: dict[tuple[str, str, str], errors.Points] = field(default_factory=dict)  # (scene, variant, cohort) → pool

    def decide(self, question: str, expectation: str, holds: bool | None, why: str) -> Outcome:
        """The same with the answer to its question: True supported, False refuted, None undecided."""
        words = {True: "supported", False: "refuted", None: "undecided"}
        return replace(self, question=question, expectation=expectation, verdict=words[holds], why=why)

    def scenes(self, variant: str, cohort: str = "full") -> dict[str, Row]:
        """Scene → its row, for one variant; scenes with a role are left out."""
        wanted = (variant, cohort, None, None)
        return {r["scene"]: r for r in self.rows if (r["method"], r["truth"], r["pair"], r.get("role")) == wanted}


def join_outcomes(outcomes: Iterable[Outcome]) -> Outcome:
    """Several runs as one: their variants must bear different names."""
    whole = Outcome()
    for part in outcomes:
        whole.rows += part.rows
        whole.summary |= part.summary
        whole.examples += [e for e in part.examples if e.scene not in {x.scene for x in whole.examples}]
        whole.n_pairs += part.n_pairs
        whole.points |= part.points
    return whole
