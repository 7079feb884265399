"""Question: does a method that chooses its views reach the best fixed gap, and is it silent without a baseline?

Expectation (written before the run): yes; on every scene whose reference views have several source views ``auto``
answers, at 5 % mean risk, at least nineteen twentieths of what ``map`` answers at the gap that is the best of that
scene in hindsight; where the camera only turns it answers at most one in two hundred of the samples without a return.
What would refute it: one scene on which a fixed gap answers more than that, or a larger share answered where the camera
only turns.
"""

from __future__ import annotations

import statistics
from collections.abc import Collection, Mapping, Sequence
from functools import partial

from dhtorch.data.pairs import CANDIDATE_STEPS, candidate_frames
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments import protocol
from dhtorch.experiments.compare.method_comparison import keep_first_seed, points_by_seed, seed_variant_name
from dhtorch.experiments.outcome import join_outcomes
from dhtorch.experiments.protocol import Method, Outcome, Progress, Protocol, ScenePairs, Settings, Variant
from dhtorch.experiments.rows import Row
from dhtorch.metrics import bootstrap, risk
from dhtorch.metrics.errors import Points

QUESTION = "Does a method that chooses its views reach the best fixed gap, and is it silent without a baseline?"
EXPECTATION = "On every scene as much at 5 % mean risk as at the gap that is best in hindsight, and silence in a turn."

#: The smallest ratio to the best gap that counts as reaching it, and the largest share answered that counts as silence.
_MIN_REACHED_RATIO, _MAX_SILENT_RATIO = 0.95, 0.005

#: Added to both coverages of a ratio: below a few of a hundred they are noise.
_COVERAGE_FLOOR = 0.01


def run(
    scenes: Sequence[SceneLike],
    chosen: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    methods: Mapping[str, Method] | None = None,
    gaps: Sequence[int] = CANDIDATE_STEPS,
    reference_views: int | None = 6,
    rotations: Sequence[SceneLike] = (),
    rotation_gaps: Sequence[int] = tuple(range(1, 12)),
    seeds: int = 1,
    progress: Progress = protocol.no_progress,
) -> Outcome:
    """``auto`` beside ``map`` at fixed gaps (variants ``map, gap <frames>``), on the same reference views of every
    scene.

    The source view of a reference view at a gap is the frame of that much larger number, where there is none of that
    much smaller; where there is neither the reference view's candidates count as silent. The summary holds, over scenes
    without a role whose reference views have several source views: ``<variant>.coverage_at_5`` (mean),
    ``auto.fixed_gap_ratio`` (geometric mean) and ``auto.fixed_gap_ratio_worst`` (smallest) of (auto + 0.01) / (best gap
    + 0.01), of the coverages at 5 % mean risk. Scene rows of ``auto`` carry ``best_gap``, ``fixed_gap_ratio`` and
    ``one_partner``.

    ``auto.rotation_answered`` and ``map.rotation_answered`` are the share of samples without a return that are
    answered, pooled over scenes of the role ``rotation``; of ``map`` over all its gaps, where a reference view has a
    source view. Scene rows of such scenes carry it as ``recovered_share``.

    Args:
        scenes, chosen, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`; of ``pairs`` the
            reference views count.
        methods: ``map``, of one other view, and ``auto``, which chooses; None = ``chosen``.
        gaps: frames.
        anchors: so many of a scene's, evenly spread; None = all.
        rotations: further scenes, for the second half of the question; one that the data hold already is left out.
        rotation_gaps: gaps of ``map`` on scenes of that role.
        seeds: how many, from the job's own upwards; coverages are medians over them, rows and shares the first's.

    Raises:
        ValueError: one of the two methods is missing, no gap, or fewer than one reference view; else as the main job.
    """
    methods = dict(methods or chosen)
    _check_options(methods, gaps, rotation_gaps, reference_views)
    every = list(scenes_of(scenes))
    every += [scene for scene in scenes_of(rotations) if scene.name not in {known.name for known in every}]
    asked = partial(protocol.spread_pairs, pairs, reference_views)
    turning = [scene for scene in every if scene.role == "rotation"]
    moving = [scene for scene in every if scene.role != "rotation"]
    fixed = {gap: f"map, gap {gap}" for gap in (*gaps, *rotation_gaps)}
    parts = []
    for some, asked_gaps, least in ((moving, gaps, protocol.MIN_CANDIDATES), (turning, rotation_gaps, 0)):
        variants = _variants(methods, {gap: fixed[gap] for gap in asked_gaps}, settings.seed, seeds)
        whole = Protocol(variants, min_candidates=least)  # a turn is judged by its holes
        parts.append(protocol.run(some, whole, asked, settings, progress=progress))
    outcome = join_outcomes(parts)
    keep_first_seed(outcome, (*fixed.values(), "auto"), seeds)
    apart = {scene.name for scene in every if scene.role is not None}
    alone = {scene.name for scene in every if scene.name not in apart and _has_one_source_view(scene, asked)}
    reached = {
        name: _coverage_by_scene(outcome, name, seeds, apart) for name in ("auto", *(fixed[gap] for gap in gaps))
    }
    outcome.summary |= _coverages(reached, alone)
    outcome.summary |= _compare_with_best_gap(outcome, reached, {fixed[gap]: gap for gap in gaps}, alone)
    outcome.summary |= _rotation_answered(outcome, {scene.name for scene in turning})
    return outcome.decide(QUESTION, EXPECTATION, *verdict(outcome, alone))


def view_at_gap(recording: Recording, reference: int, *, gap: int) -> list[int]:
    """The position of the frame ``gap`` numbers after the reference view's, where there is none before it; else
    nothing."""
    for step in (gap, -gap):
        found: list[int] = (recording.number == recording.number[reference] + step).nonzero()[:, 0].tolist()
        if found:
            return found
    return []


def coverage_ratio(auto: float, best: float) -> float:
    """How much of the best gap's coverage is reached."""
    return (auto + _COVERAGE_FLOOR) / (best + _COVERAGE_FLOOR)


def verdict(outcome: Outcome, alone: Collection[str] = ()) -> tuple[bool | None, str]:
    """The worst scene against the best gap, and the share answered in a turn."""
    names = ("auto.fixed_gap_ratio_worst", "auto.rotation_answered", "map.rotation_answered")
    worst, answered, fixed = (outcome.summary.get(name, {}).get("value") for name in names)
    apart = f"; one source view only: {', '.join(sorted(alone))}" if alone else ""
    if worst is None:
        return None, f"no scene whose reference views have several source views{apart}"
    below = {s: r for s, r in _gap_ratios(outcome).items() if r < _MIN_REACHED_RATIO}
    missed = ", ".join(f"{scene} {r:.2f}" for scene, r in sorted(below.items(), key=lambda item: item[1]))
    why = f"of the best fixed gap's coverage at 5 % risk at least {worst:.2f} on every scene"
    why += f" (below {_MIN_REACHED_RATIO:g}: {missed or 'none'})"
    if answered is None:
        return None, f"{why}; no scene in which the camera only turns{apart}"
    beside = "–" if fixed is None else f"{fixed:.2%}"
    why += f"; in a turn {answered:.2%} of the samples without a return answered, map at fixed gaps {beside}{apart}"
    return worst >= _MIN_REACHED_RATIO and answered <= _MAX_SILENT_RATIO, why


def _check_options(
    methods: Mapping[str, Method], gaps: Sequence[int], rotation_gaps: Sequence[int], reference_views: int | None
) -> None:
    if missing := {"map", "auto"} - methods.keys():
        raise ValueError(f"experiment.methods: found {', '.join(methods)}, expected {', '.join(sorted(missing))} too")
    for option, given in (("gaps", gaps), ("rotation_gaps", rotation_gaps)):
        if not given or min(given) < 1:
            raise ValueError(f"experiment.{option}: found {list(given)}, expected numbers of frames from 1 on")
    if reference_views is not None and reference_views < 1:
        raise ValueError(f"experiment.reference_views: found {reference_views}, expected at least 1, or null for all")


def _variants(methods: Mapping[str, Method], fixed: Mapping[int, str], seed: int, seeds: int) -> dict[str, Variant]:
    """``auto`` with the frames around the reference view, and ``map`` at every gap, with so many seeds each."""
    found = {}
    for k in range(seeds):
        found[seed_variant_name("auto", k)] = Variant(methods["auto"], seed=seed + k, offers=candidate_frames)
        for gap, name in fixed.items():
            found[seed_variant_name(name, k)] = Variant(
                methods["map"], seed=seed + k, offers=partial(view_at_gap, gap=gap)
            )
    return found


def _has_one_source_view(scene: Scene, pairs: ScenePairs) -> bool:
    """Whether there is nothing to choose from at any of the reference views."""
    return all(len(candidate_frames(scene.recording, i)) == 1 for i, _ in pairs(scene))


def _coverage_by_scene(outcome: Outcome, name: str, seeds: int, apart: Collection[str]) -> dict[str, float]:
    """Scene → coverage at 5 % risk, the median over seeds; scenes without a candidate have none."""
    found = {}
    for scene, points in points_by_seed(outcome, name, seeds, apart).items():
        values = [v for v in map(_coverage_at_5, points) if v is not None]
        if values:
            found[scene] = statistics.median(values)
    return found


def _coverage_at_5(points: Points) -> float | None:
    return risk.measure_risk(points)["coverage_at_5"]


def _coverages(reached: Mapping[str, Mapping[str, float]], alone: Collection[str]) -> Row:
    """Every variant's coverage at 5 % risk, its mean over scenes with several source views."""
    return {
        f"{name}.coverage_at_5": bootstrap.interval_over_scenes(
            [v for scene, v in by_scene.items() if scene not in alone], statistic="mean"
        ).entry("1")
        for name, by_scene in reached.items()
    }


def _compare_with_best_gap(
    outcome: Outcome, reached: Mapping[str, Mapping[str, float]], gaps: Mapping[str, int], alone: Collection[str]
) -> Row:
    """Note the best gap and the ratio to it in the rows of ``auto``, and join the ratios over scenes."""
    rows = outcome.scenes("auto")
    for scene, auto in reached["auto"].items():
        best = max(gaps, key=lambda name: reached[name][scene])  # the first of equals
        rows[scene]["best_gap"] = gaps[best]
        rows[scene]["fixed_gap_ratio"] = coverage_ratio(auto, reached[best][scene])
        rows[scene]["one_partner"] = scene in alone
    ratios = list(_gap_ratios(outcome).values())
    return {
        "auto.fixed_gap_ratio": bootstrap.interval_over_scenes(ratios, statistic="geometric_mean").entry("1"),
        "auto.fixed_gap_ratio_worst": bootstrap.without_interval(min(ratios, default=None), len(ratios)),
    }


def _gap_ratios(outcome: Outcome) -> dict[str, float]:
    """Scene → ratio to the best gap; scenes with one source view are left out."""
    rows = outcome.scenes("auto")
    return {s: r["fixed_gap_ratio"] for s, r in rows.items() if "fixed_gap_ratio" in r and not r["one_partner"]}


def _rotation_answered(outcome: Outcome, turning: Collection[str]) -> Row:
    """Share of the samples without a return that are answered, over the scenes in which the camera only turns."""
    asked = [r for r in outcome.rows if r["scene"] in turning and r["pair"] is not None and r["views"]]
    for row in outcome.rows:
        if row["scene"] in turning and row["pair"] is None:
            name = row["scene"], row["method"]
            row["recovered_share"] = _answered_share([r for r in asked if (r["scene"], r["method"]) == name])
    shares = {
        name: _answered_share([r for r in asked if r["method"].partition(",")[0] == name]) for name in ("auto", "map")
    }
    return {
        f"{name}.rotation_answered": bootstrap.without_interval(share, len(turning)) for name, share in shares.items()
    }


def _answered_share(rows: Sequence[Row]) -> float | None:
    """Samples without a return that some pairs answered, of all that they had; None of none."""
    holes = sum(row["n_holes"] for row in rows)
    return sum(row["n_recovered"] for row in rows) / holes if holes else None
