"""Question: do tracks through the frames between a pair raise the coverage over one jump, without more error?

Expectation (written before the run): over the video scenes ``paper`` with tracks through up to four frames between has
at least 1.5 times the coverage of ``paper_direct``, at a median error of at most 1.15 of its own; ``kornia``, with the
same chain, has .9 to 1.1 of the coverage of ``paper`` and .9 to 1.15 of its error.
What would refute it: any of these numbers missed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

from dhtorch.data.scene import SceneLike, scenes_of
from dhtorch.experiments import compare_methods as compare
from dhtorch.experiments import pair
from dhtorch.experiments.protocol import Method, Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.metrics.errors import Points
from dhtorch.stages.track_chain import track_chain

QUESTION = "Do tracks through the frames between a pair raise the coverage over one jump, without more error?"
EXPECTATION = (
    "paper has at least 1.5 times the coverage of paper_direct at 1.15 of its error at most; kornia has .9 to 1.1 of "
    "the coverage of paper and .9 to 1.15 of its error."
)

#: Number of the summary → the interval in which it must lie.
CHAIN_BARS = {
    "paper.coverage_ratio_to_paper_direct": (1.5, float("inf")),
    "paper.error_ratio_to_paper_direct": (0.0, 1.15),
    "kornia.coverage_ratio_to_paper": (0.9, 1.1),
    "kornia.error_ratio_to_paper": (0.9, 1.15),
}


def run(
    scenes: Sequence[SceneLike],
    chosen: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    methods: Mapping[str, Method] | None = None,
    chained: Sequence[str] = ("map",),
    ratios: Mapping[str, str],
    progress: Progress = no_progress,
) -> Outcome:
    """Coverage and errors of methods that track through frames between, as ratios to others on the same pairs.

    Scenes whose gap is one frame, or that have none, are left out: nothing lies between their pairs.

    Args:
        scenes, chosen, pairs, settings, progress: as :func:`dhtorch.experiments.pair.run`.
        methods: name → method; None = ``chosen``.
        chained: methods that are run once more with their tracker in a chain, as ``<method>_chain``.
        ratios: method → the one to compare it with, which makes ``<method>.<number>_ratio_to_<other>``: geometric means
            over scenes of the ratios of coverage, of median error, and of median error where both are cut by their own
            score to the same number of answers (``equal_error``).

    Raises:
        ValueError: a method of ``chained`` or ``ratios`` that is not among the methods; else as the main job.
    """
    methods = dict(methods or chosen)
    if absent := sorted({*chained} - set(methods)):
        raise ValueError(f"experiment.chained: found {', '.join(absent)}, expected some of {', '.join(methods)}")
    wrapped = {name: partial(track_chain, track=methods[name].track) for name in chained}
    methods |= {f"{name}_chain": methods[name].replace(track=track) for name, track in wrapped.items()}
    if absent := sorted({*ratios, *ratios.values()} - set(methods)):
        raise ValueError(f"experiment.methods: found {', '.join(methods)}, expected {', '.join(absent)} as well")
    videos = [scene for scene in scenes_of(scenes) if (scene.gap or 0) > 1 and scene.role is None]
    outcome = pair.run(videos, methods, pairs, replace(settings, truth=("full",)), progress=progress)
    for name, other in ratios.items():
        ours, theirs = (_points(outcome, each) for each in (name, other))
        own = compare.twin_ratios(ours, theirs, other)
        equal = compare.twin_ratios(*compare.cut_to_equal_coverage(ours, theirs), other)
        own |= {f"equal_{k}": v for k, v in equal.items() if k.startswith("error")}
        outcome.summary |= {f"{name}.{k}": v.entry("1") for k, v in own.items()}
    return outcome.decide(QUESTION, EXPECTATION, *_verdict(outcome))


def _points(outcome: Outcome, method: str) -> dict[str, list[Points]]:
    """Scene → candidates of a method, as of one seed."""
    return {scene: [points] for (scene, name, _), points in outcome.points.items() if name == method}


def _verdict(outcome: Outcome) -> tuple[bool | None, str]:
    """(all bars met, None if a number is undefined; the bars that are missed)."""
    values = {name: outcome.summary.get(name, {}).get("value") for name in CHAIN_BARS}
    if undefined := [name for name, value in values.items() if value is None]:
        return None, f"{undefined[0]} is not defined on these scenes"
    missed = [
        f"{name} {values[name]:.3f} (bars {low:g}, {high:g})"
        for name, (low, high) in CHAIN_BARS.items()
        if not low <= values[name] <= high
    ]
    return not missed, "; ".join([f"{len(CHAIN_BARS) - len(missed)} of {len(CHAIN_BARS)} bars met", *missed])
