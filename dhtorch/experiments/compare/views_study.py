"""Question: does view selection reach the best fixed gap, and does it abstain without a baseline?

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

QUESTION = "Does view selection reach the best fixed gap, and does it abstain without a baseline?"
EXPECTATION = "On every scene as much at 5 % mean risk as at the best fixed gap, and no answers under pure rotation."

#: Least ratio to the coverage of the best gap that counts as reaching it.
_MIN_REACHED_RATIO = 0.95

#: Largest fraction of samples answered under pure rotation that counts as unanswered.
_MAX_ANSWERED_RATIO = 0.005

#: Added to both coverages of a ratio: coverages below a few per cent are noise.
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
    """Coverage of ``auto`` and of ``map`` at fixed gaps (variants ``map, gap <frames>``) on the same reference views.

    The source view of a reference view at a gap is the frame whose number is larger by the gap, or else smaller by it;
    where there is neither, the reference view's candidates count as unanswered. The summary holds, over scenes without
    a role whose reference views have several candidate views: ``<variant>.coverage_at_5`` (mean),
    ``auto.fixed_gap_ratio`` (geometric mean) and ``auto.fixed_gap_ratio_worst`` (smallest) of (auto + 0.01) / (best gap
    + 0.01), of the coverages at 5 % mean risk. Scene rows of ``auto`` carry ``best_gap``, ``fixed_gap_ratio`` and
    ``one_partner``.

    ``auto.rotation_answered`` and ``map.rotation_answered`` are the fraction of samples without a return that is
    answered, pooled over scenes of the role ``rotation``; of ``map`` over all its gaps, where a reference view has a
    source view. Scene rows of such scenes carry it as ``recovered_share``.

    Args:
        scenes, chosen, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`; of ``pairs``
            only the reference views are used.
        methods: ``map``, of one source view, and ``auto``, which selects views; None = ``chosen``.
        gaps: gaps of ``map``, frames.
        reference_views: number of reference views of a scene, evenly spaced; None = all.
        rotations: further scenes with pure rotation; one that is already in ``scenes`` is left out.
        rotation_gaps: gaps of ``map`` on scenes of that role.
        seeds: number of seeds, from the job's own upwards; coverages are medians over them, rows are the first's.

    Raises:
        ValueError: one of the two methods is missing, no gap, or fewer than one reference view; else as the main job.
    """
    methods = dict(methods or chosen)
    _check_options(methods, gaps, rotation_gaps, reference_views)
    all_scenes = list(scenes_of(scenes))
    all_scenes += [scene for scene in scenes_of(rotations) if scene.name not in {listed.name for listed in all_scenes}]
    spread = partial(protocol.spread_pairs, pairs, reference_views)
    rotating = [scene for scene in all_scenes if scene.role == "rotation"]
    moving = [scene for scene in all_scenes if scene.role != "rotation"]
    fixed = {gap: f"map, gap {gap}" for gap in (*gaps, *rotation_gaps)}
    parts = []
    for part_scenes, part_gaps, min_candidates in (
        (moving, gaps, protocol.MIN_CANDIDATES),
        (rotating, rotation_gaps, 0),
    ):
        variants = _variants(methods, {gap: fixed[gap] for gap in part_gaps}, settings.seed, seeds)
        part_protocol = Protocol(variants, min_candidates=min_candidates)  # rotations are evaluated on their holes
        parts.append(protocol.run(part_scenes, part_protocol, spread, settings, progress=progress))
    outcome = join_outcomes(parts)
    keep_first_seed(outcome, (*fixed.values(), "auto"), seeds)
    with_role = {scene.name for scene in all_scenes if scene.role is not None}
    single_view = {
        scene.name for scene in all_scenes if scene.name not in with_role and _has_one_source_view(scene, spread)
    }
    coverages = {
        name: _coverage_by_scene(outcome, name, seeds, with_role) for name in ("auto", *(fixed[gap] for gap in gaps))
    }
    outcome.summary |= _coverages(coverages, single_view)
    outcome.summary |= _compare_with_best_gap(outcome, coverages, {fixed[gap]: gap for gap in gaps}, single_view)
    outcome.summary |= _rotation_answered(outcome, {scene.name for scene in rotating})
    return outcome.decide(QUESTION, EXPECTATION, *verdict(outcome, single_view))


def view_at_gap(recording: Recording, reference: int, *, gap: int) -> list[int]:
    """[Position of the frame ``gap`` numbers after the reference view, or else before it]; empty without either."""
    for step in (gap, -gap):
        positions: list[int] = (recording.number == recording.number[reference] + step).nonzero()[:, 0].tolist()
        if positions:
            return positions
    return []


def coverage_ratio(auto: float, best: float) -> float:
    """Coverage of ``auto`` over that of the best gap, with :data:`_COVERAGE_FLOOR` added to both."""
    return (auto + _COVERAGE_FLOOR) / (best + _COVERAGE_FLOOR)


def verdict(outcome: Outcome, alone: Collection[str] = ()) -> tuple[bool | None, str]:
    """(both bars met, or None if undecided; worst ratio to the best gap, fraction answered under pure rotation)."""
    names = ("auto.fixed_gap_ratio_worst", "auto.rotation_answered", "map.rotation_answered")
    worst, answered, fixed = (outcome.summary.get(name, {}).get("value") for name in names)
    note = f"; one source view only: {', '.join(sorted(alone))}" if alone else ""
    if worst is None:
        return None, f"no scene whose reference views have several source views{note}"
    below = {s: r for s, r in _gap_ratios(outcome).items() if r < _MIN_REACHED_RATIO}
    missed = ", ".join(f"{scene} {r:.2f}" for scene, r in sorted(below.items(), key=lambda item: item[1]))
    why = f"of the best fixed gap's coverage at 5 % risk at least {worst:.2f} on every scene"
    why += f" (below {_MIN_REACHED_RATIO:g}: {missed or 'none'})"
    if answered is None:
        return None, f"{why}; no scene in which the camera only turns{note}"
    map_answered = "–" if fixed is None else f"{fixed:.2%}"
    why += (
        f"; in a turn {answered:.2%} of the samples without a return answered, map at fixed gaps {map_answered}{note}"
    )
    return worst >= _MIN_REACHED_RATIO and answered <= _MAX_ANSWERED_RATIO, why


def _check_options(
    methods: Mapping[str, Method], gaps: Sequence[int], rotation_gaps: Sequence[int], reference_views: int | None
) -> None:
    if missing := {"map", "auto"} - methods.keys():
        raise ValueError(f"experiment.methods: found {', '.join(methods)}, expected {', '.join(sorted(missing))} too")
    for option, frames in (("gaps", gaps), ("rotation_gaps", rotation_gaps)):
        if not frames or min(frames) < 1:
            raise ValueError(f"experiment.{option}: found {list(frames)}, expected numbers of frames from 1 on")
    if reference_views is not None and reference_views < 1:
        raise ValueError(f"experiment.reference_views: found {reference_views}, expected at least 1, or null for all")


def _variants(methods: Mapping[str, Method], fixed: Mapping[int, str], seed: int, seeds: int) -> dict[str, Variant]:
    """``auto`` with the candidate views of the reference view, and ``map`` at every gap, once per seed."""
    variants = {}
    for k in range(seeds):
        variants[seed_variant_name("auto", k)] = Variant(methods["auto"], seed=seed + k, offers=candidate_frames)
        for gap, name in fixed.items():
            variants[seed_variant_name(name, k)] = Variant(
                methods["map"], seed=seed + k, offers=partial(view_at_gap, gap=gap)
            )
    return variants


def _has_one_source_view(scene: Scene, pairs: ScenePairs) -> bool:
    """Whether all reference views of a scene have a single candidate view."""
    return all(len(candidate_frames(scene.recording, i)) == 1 for i, _ in pairs(scene))


def _coverage_by_scene(outcome: Outcome, name: str, seeds: int, left_out: Collection[str]) -> dict[str, float]:
    """Scene → coverage at 5 % risk, median over seeds; scenes without candidates are left out."""
    coverages = {}
    for scene, points in points_by_seed(outcome, name, seeds, left_out).items():
        values = [v for v in map(_coverage_at_5, points) if v is not None]
        if values:
            coverages[scene] = statistics.median(values)
    return coverages


def _coverage_at_5(points: Points) -> float | None:
    return risk.measure_risk(points)["coverage_at_5"]


def _coverages(coverages: Mapping[str, Mapping[str, float]], single_view: Collection[str]) -> Row:
    """Mean coverage at 5 % risk of every variant over scenes with several candidate views."""
    return {
        f"{name}.coverage_at_5": bootstrap.interval_over_scenes(
            [v for scene, v in by_scene.items() if scene not in single_view], statistic="mean"
        ).entry("1")
        for name, by_scene in coverages.items()
    }


def _compare_with_best_gap(
    outcome: Outcome,
    coverages: Mapping[str, Mapping[str, float]],
    gaps: Mapping[str, int],
    single_view: Collection[str],
) -> Row:
    """Write the best gap and the ratio to it into the rows of ``auto`` → geometric mean and minimum of the ratios."""
    rows = outcome.scenes("auto")
    for scene, auto in coverages["auto"].items():
        best = max(gaps, key=lambda name: coverages[name][scene])  # the first of equal ones
        rows[scene]["best_gap"] = gaps[best]
        rows[scene]["fixed_gap_ratio"] = coverage_ratio(auto, coverages[best][scene])
        rows[scene]["one_partner"] = scene in single_view
    ratios = list(_gap_ratios(outcome).values())
    return {
        "auto.fixed_gap_ratio": bootstrap.interval_over_scenes(ratios, statistic="geometric_mean").entry("1"),
        "auto.fixed_gap_ratio_worst": bootstrap.without_interval(min(ratios, default=None), len(ratios)),
    }


def _gap_ratios(outcome: Outcome) -> dict[str, float]:
    """Scene → ratio to the best gap; scenes with a single candidate view are left out."""
    rows = outcome.scenes("auto")
    return {s: r["fixed_gap_ratio"] for s, r in rows.items() if "fixed_gap_ratio" in r and not r["one_partner"]}


def _rotation_answered(outcome: Outcome, rotating: Collection[str]) -> Row:
    """Fraction of samples without a return that is answered, over scenes with pure rotation; filled in scene rows."""
    pair_rows = [r for r in outcome.rows if r["scene"] in rotating and r["pair"] is not None and r["views"]]
    for row in outcome.rows:
        if row["scene"] in rotating and row["pair"] is None:
            name = row["scene"], row["method"]
            row["recovered_share"] = _answered_share([r for r in pair_rows if (r["scene"], r["method"]) == name])
    ratios = {
        name: _answered_share([r for r in pair_rows if r["method"].partition(",")[0] == name])
        for name in ("auto", "map")
    }
    return {
        f"{name}.rotation_answered": bootstrap.without_interval(ratio, len(rotating)) for name, ratio in ratios.items()
    }


def _answered_share(rows: Sequence[Row]) -> float | None:
    """Fraction of the samples without a return of all pairs that is answered; None without such samples."""
    holes = sum(row["n_holes"] for row in rows)
    return sum(row["n_recovered"] for row in rows) / holes if holes else None
