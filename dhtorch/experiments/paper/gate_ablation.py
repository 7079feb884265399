"""Question: which gate carries the abstention, and how does the frame gap trade error for coverage?

Expectation (written before the run): without the parallax gate correlation collapses (the paper: 0.745 to 0.034) while
the median error hardly moves; without the reprojection gate little happens; over the gaps the median error changes
little and coverage falls with the gap.
What would refute it: taking away the parallax gate does not cost more correlation than taking away the other.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from dhtorch.data.pairs import Pair, by_gap, by_scaled_gap
from dhtorch.data.scene import Scene, SceneLike
from dhtorch.experiments.cohorts import HeldOut, hide_nothing
from dhtorch.experiments.outcome import join_outcomes
from dhtorch.experiments.protocol import (
    Answer,
    Method,
    Outcome,
    Progress,
    Protocol,
    ScenePairs,
    Settings,
    no_progress,
    run_protocol,
)

GapPairs = dict[str, Callable[[Any], list[Pair]]]


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    factors: Sequence[float] = (0.5, 2.0),
    gaps: Sequence[int] = (),
    progress: Progress = no_progress,
) -> Outcome:
    """Hold-out errors with each gate off, and at other frame gaps.

    Variants ``both gates``, ``parallax gate off``, ``reprojection gate off`` at the job's own pairs; ``gap x0.5`` for
    each of ``factors`` (on the scene's gap) and ``gap 16`` for each of ``gaps`` (frames). A recording too short for a
    gap has a row with a note.

    Args:
        scenes, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: name → method; the first is used.
        factors: further gaps, as factors on the scene's own.
        gaps: further gaps in frames.

    Source: paper, "Effect of the gate".
    """
    split = HeldOut(next(iter(methods.values())), settings)
    gate_options = {
        "both gates": {},
        "parallax gate off": {"min_parallax_deg": None},
        "reprojection gate off": {"max_residual_px": None},
    }
    variants = {}
    for name, options in gate_options.items():
        variant = split.variant()
        variants[name] = replace(variant, method=variant.method.replace(triangulate=options))
    main = run_protocol(
        scenes, Protocol(variants, {"heldout": split.heldout}, hide_nothing), pairs, settings, progress=progress
    )
    parts = [main, *sweep_gaps(scenes, split, pairs_at_gaps(factors, gaps), settings, progress)]
    outcome = join_outcomes(parts)
    return outcome.decide(
        "Which gate carries the abstention, and how does the frame gap trade error for coverage?",
        "Without the parallax gate correlation falls by more than without the reprojection gate.",
        *verdict(outcome.summary),
    )


def pairs_at_gaps(factors: Sequence[float], gaps: Sequence[int]) -> GapPairs:
    """Name of a gap → pairs of a recording at that gap; no pairs if it is too short."""
    scaled: GapPairs = {f"gap x{f:g}": partial(by_scaled_gap, factor=f) for f in factors}
    return scaled | {f"gap {g}": partial(_pairs_at_gap, gap=g) for g in gaps}


def sweep_gaps(
    scenes: Sequence[SceneLike],
    split: HeldOut,
    gaps: GapPairs,
    settings: Settings,
    progress: Progress,
    columns: Callable[[Answer], dict[str, Any]] = lambda _answer: {},
) -> list[Outcome]:
    """Outcomes of the hold-out, one per gap."""
    parts = []
    for name, pairs in gaps.items():
        heldout_protocol = Protocol({name: split.variant()}, {"heldout": split.heldout}, hide_nothing, columns)
        part = run_protocol(scenes, heldout_protocol, pairs, settings, progress=progress)
        part.summary = {f"{name}.{k}": v for k, v in part.summary.items()}
        parts.append(part)
    return parts


def verdict(summary: Mapping[str, Any]) -> tuple[bool | None, str]:
    """(the parallax gate costs more correlation than the other when off; correlations, medians over scenes)."""
    corr = {name: summary.get(f"{name}.corr", {}).get("value") for name in ("both gates", "parallax gate off")}
    corr["reprojection gate off"] = summary.get("reprojection gate off.corr", {}).get("value")
    if any(v is None for v in corr.values()):
        return None, "no scene with answers"
    both, without_parallax, without_residual = corr.values()
    why = ", ".join(f"{name} {value:.3f}" for name, value in corr.items())
    return both - without_parallax > both - without_residual, f"correlation: {why} (medians over scenes)"


def _pairs_at_gap(scene: Scene, gap: int) -> list[Pair]:
    number = scene.recording.number
    span = int(number[-1] - number[0])
    return by_gap(scene, gap) if gap <= span else []
