"""Ratios of error and coverage of methods to a reference method, and calibration in rooms that were held out.

A ratio divides the medians over seeds of the two methods, then takes the geometric mean over scenes: a scene where the
error halves and one where it doubles cancel. Calibrated score, sigma and thresholds are fitted on all rooms but one and
evaluated on that one, with the seeds of a scene pooled and every scene of the same weight.
"""

import statistics
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch

from dhtorch import pytree
from dhtorch.metrics import bootstrap, control, errors, reliability, risk
from dhtorch.metrics.bootstrap import Interval
from dhtorch.metrics.calibration import list_calibrations, load_calibration
from dhtorch.metrics.calibration.fitting import fit_calibration
from dhtorch.metrics.errors import Points
from dhtorch.metrics.uncertainty import interval_coverage, measure_uncertainty, range_bias

#: Fewest answers of either method for a scene to have a ratio.
MIN_COMPARED_ANSWERS = 20

#: Fewest answers above a threshold (mean over seeds) for a scene to count in ``within_target_<per cent>``.
MIN_ANSWERS_ABOVE_THRESHOLD = 100

#: Targets of the risk control, per cent of mean error.
_TARGET_PERCENT = (10, 5)

#: Errors are raised to this relative error before a division: below it they are rounding.
MIN_COMPARED_ERROR = 1e-6

#: Numbers of :func:`dhtorch.metrics.uncertainty.measure_uncertainty` that a comparison adds to its own.
_UNCERTAINTY_NUMBERS = ("interval_1", "interval_2", "ause", "worst_bias")

#: Largest bias of a range bin of a scene whose truth is exact. Source: the requirement.
_MAX_EXACT_BIAS = 0.01

#: Fewest answers of a scene whose coverage counts. Source: derived, 1.5 % of standard error at 95 %.
_MIN_INTERVAL_ANSWERS = 200

#: Scene → the candidates of every seed.
SeedPoints = Mapping[str, Sequence[Points]]


@dataclass
class MethodComparison:
    """Summary keys ``<method>.<number>``, one row per method and scene, and the scenes without a number."""

    summary: dict[str, dict[str, Any]] = field(default_factory=dict)
    rows: list[dict[str, Any]] = field(default_factory=list)  # {method, scene, number: value}
    left_out: dict[str, list[str]] = field(default_factory=dict)  # method → scenes without a ratio: too few answers
    unanswered: dict[str, list[str]] = field(
        default_factory=dict
    )  # "<method>.<per cent>" → scenes without an answer above its threshold


def method_ratios(
    methods: Mapping[str, SeedPoints],
    *,
    reference: str = "paper",
    rooms: Mapping[str, str] | None = None,
    fallback: Mapping[str, str] | None = None,
    exact: Sequence[str] = (),
    floors: Mapping[str, float] | None = None,
    draws: int = 2000,
    seed: int = 0,
) -> MethodComparison:
    """Ratios of every other method to the reference, and calibration of every other method.

    Args:
        methods: method → scene → candidates of every seed, with the method's own uncalibrated score and sigma. Seed k
            of one method is paired with seed k of the reference.
        reference: the method to compare with.
        rooms: scene → room, the unit that is held out of calibration; a scene without an entry is its own room.
        fallback: method → the method that replaces it on scenes where it has no candidates of its own, such as
            ``{"auto": "map"}`` where a scene has too few views.
        exact, floors: see :func:`stated_uncertainty`.
        draws, seed: of the bootstrap over scenes.

    Returns:
        Comparison. For every other method, geometric means over scenes: ``median_rel_ratio`` (each method on its own
        answers), ``median_rel_ratio_at_equal_coverage`` (both cut by their own score to the smaller number of answers,
        seed by seed), ``aurc_ratio``. ``worst_scene_ratio``: the largest ratio at equal coverage. The numbers of
        :func:`stated_uncertainty`. ``coverage_at_5``: mean over scenes (on many it is
        zero, so that their median jumps). In held-out rooms, means over scenes: ``within_sigma`` and ``within_2sigma``
        after the correction of sigma; ``realised_risk_<per cent>``, mean capped error at the threshold that nine in ten
        of the other scenes keep, where a scene without an answer above it counts 0 (``risk_of_speaking_<per cent>``:
        without those scenes); ``coverage_within_<per cent>``, coverage above the threshold; ``within_target_<per
        cent>``, fraction of scenes that meet the target among those with a hundred answers above the threshold;
        ``ece_scenes``, :func:`dhtorch.metrics.reliability.excess_ece` scene by scene. And over all answers, every scene
        of the same weight: ``ece`` of the calibrated table, ``ece_sigmoid`` of the sigmoid control, ``ece_raw`` of the
        uncalibrated score.

    Raises:
        ValueError: no reference, or methods that differ in scenes or number of seeds.
    """
    complete = complete_scenes(methods, reference, fallback or {})
    comparison = MethodComparison()
    for method, ours in complete.items():
        if method == reference:
            continue
        rows: dict[str, dict[str, Any]] = {scene: {"method": method, "scene": scene} for scene in ours}
        numbers = _ratios(ours, complete[reference], rows, comparison.left_out.setdefault(method, []), draws, seed)
        numbers |= evaluate_promises(ours, rooms, rows, draws, seed)
        numbers |= stated_uncertainty(method, ours, rows, exact=exact, floors=floors, draws=draws, seed=seed)
        for percent in _TARGET_PERCENT:
            key = f"realised_risk_{percent}"
            comparison.unanswered[f"{method}.{percent}"] = [
                s for s, row in rows.items() if key in row and row[key] is None
            ]
        for name, value in numbers.items():
            comparison.summary[f"{method}.{name}"] = value.entry(errors.metric_unit(name))
        comparison.rows += rows.values()
    return comparison


def multiview_ratios(
    ours: SeedPoints, theirs: SeedPoints, name: str, *, draws: int = 2000, seed: int = 0
) -> tuple[dict[str, Interval], dict[str, dict[str, float]]]:
    """Ratios of one multi-view method to another, with unanswered candidates counted as well.

    Args:
        ours, theirs: the same scenes and seeds.
        name: of the other method, part of the keys.
        draws, seed: of the bootstrap over scenes.

    Returns:
        ``error_ratio_to_<name>``, geometric mean over scenes of the ratio of median errors, both cut by their own score
        to the smaller number of answers; ``worst_scene_ratio_to_<name>``, the largest of them;
        ``aurc_full_ratio_to_<name>``, geometric mean of the ratio of the areas over all candidates, where an
        unanswered candidate counts as an error of one. And the same scene by scene, where it is defined.
    """
    equal, _ = ratio_over_seeds(*cut_to_equal_coverage(ours, theirs), _median_rel)
    full, _ = ratio_over_seeds(ours, theirs, lambda p: risk.measure_risk(p)["aurc_full"], min_answers=0)
    numbers = {
        f"error_ratio_to_{name}": _geometric_mean(equal, draws, seed),
        f"worst_scene_ratio_to_{name}": _worst_ratio(equal),
        f"aurc_full_ratio_to_{name}": _geometric_mean(full, draws, seed),
    }
    rows = {s: {f"error_ratio_to_{name}": equal[s]} if s in equal else {} for s in ours}
    for scene, ratio in full.items():
        rows[scene][f"aurc_full_ratio_to_{name}"] = ratio
    return numbers, rows


def twin_ratios(ours: SeedPoints, theirs: SeedPoints, name: str) -> dict[str, Interval]:
    """How two methods compare on the same pairs: geometric means over scenes of the ratios of coverage and error.

    Returns:
        ``coverage_ratio_to_<name>``, of the answered fractions of the candidates; ``error_ratio_to_<name>``, of the
        median relative errors of each one's answers; ``equal_error_ratio_to_<name>``, of those where both are cut by
        their own score to the smaller number of answers. Scenes with too few answers of either have no ratio.
    """
    scenes = [scene for scene in ours if scene in theirs]
    one, other = ({scene: side[scene] for scene in scenes} for side in (ours, theirs))
    ratios = {
        "coverage": ratio_over_seeds(one, other, lambda p: float(p.keep.double().mean())),
        "error": ratio_over_seeds(one, other, _median_rel),
        "equal_error": ratio_over_seeds(*cut_to_equal_coverage(one, other), _median_rel),
    }
    return {f"{k}_ratio_to_{name}": _geometric_mean(v, draws=2000, seed=0) for k, (v, _) in ratios.items()}


def ratio_over_seeds(
    ours: SeedPoints,
    theirs: SeedPoints,
    measure: Callable[[Points], float | None],
    *,
    min_answers: int = MIN_COMPARED_ANSWERS,
) -> tuple[dict[str, float], list[str]]:
    """(scene → ratio of the medians over seeds of a metric, scenes without a ratio).

    Args:
        ours, theirs: the same scenes.
        measure: candidates of a scene → metric, None where undefined.
        min_answers: a scene with fewer answers of either method (median over seeds) is left out.
    """
    ratios, left_out = {}, []
    for scene in ours:
        kept = [statistics.median(int(p.keep.sum()) for p in side[scene]) for side in (ours, theirs)]
        a, b = (_median_over_seeds(side[scene], measure) for side in (ours, theirs))
        if min(kept) < min_answers or a is None or b is None:
            left_out.append(scene)
        else:
            ratios[scene] = max(a, MIN_COMPARED_ERROR) / max(b, MIN_COMPARED_ERROR)
    return ratios, left_out


def cut_to_equal_coverage(
    ours: SeedPoints, theirs: SeedPoints
) -> tuple[dict[str, list[Points]], dict[str, list[Points]]]:
    """Candidates of both methods, each cut by its own score to the smaller number of answers, seed by seed."""
    cut_ours: dict[str, list[Points]] = {}
    cut_theirs: dict[str, list[Points]] = {}
    for scene in ours:
        pairs = list(zip(ours[scene], theirs[scene], strict=True))
        sizes = [min(int(a.keep.sum()), int(b.keep.sum())) for a, b in pairs]
        cut_ours[scene] = [risk.keep_surest(a, n) for (a, _), n in zip(pairs, sizes, strict=True)]
        cut_theirs[scene] = [risk.keep_surest(b, n) for (_, b), n in zip(pairs, sizes, strict=True)]
    return cut_ours, cut_theirs


def _ratios(
    ours: SeedPoints, theirs: SeedPoints, rows: dict[str, dict[str, Any]], left_out: list[str], draws: int, seed: int
) -> dict[str, Interval]:
    def geometric(ratios: Mapping[str, float], name: str) -> Interval:
        for scene, row in rows.items():
            row[name] = ratios.get(scene)
        return _geometric_mean(ratios, draws, seed)

    own, unanswered = ratio_over_seeds(ours, theirs, _median_rel)
    left_out += unanswered
    equal, _ = ratio_over_seeds(*cut_to_equal_coverage(ours, theirs), _median_rel)
    ranked, _ = ratio_over_seeds(ours, theirs, lambda p: risk.measure_risk(p)["aurc"])
    for scene, row in rows.items():
        row["coverage_at_5"] = _median_over_seeds(ours[scene], lambda p: risk.measure_risk(p)["coverage_at_5"])
    coverages = [row["coverage_at_5"] for row in rows.values()]
    return {
        "median_rel_ratio": geometric(own, "median_rel_ratio"),
        "median_rel_ratio_at_equal_coverage": geometric(equal, "median_rel_ratio_at_equal_coverage"),
        "worst_scene_ratio": _worst_ratio(equal),
        "aurc_ratio": geometric(ranked, "aurc_ratio"),
        "coverage_at_5": bootstrap.interval_over_scenes(coverages, statistic="mean", draws=draws, seed=seed),
    }


def stated_uncertainty(
    method: str,
    ours: SeedPoints,
    rows: dict[str, dict[str, Any]],
    *,
    exact: Sequence[str] = (),
    floors: Mapping[str, float] | None = None,
    draws: int = 2000,
    seed: int = 0,
) -> dict[str, Interval]:
    """Whether the method's own sigma holds, seeds pooled: intervals, AUSE and bias by range.

    Args:
        method: its name; the package's calibration of that name gives the ``calibrated_`` numbers.
        ours: scene → candidates of every seed.
        rows: scene → its numbers; filled in place, also with ``bias_bins`` and the ``floor`` of the scene.
        exact: starts of names of scenes with exact truth: their floor is 1 %.
        floors: start of a scene's name → printed relative error of its truth; the longest fitting start counts.
        draws, seed: of the bootstrap over scenes.

    Returns:
        Means over scenes of ``interval_1``, ``interval_2``, ``ause`` and ``worst_bias``
        (:func:`dhtorch.metrics.uncertainty.measure_uncertainty`). Over scenes with 200 answers: ``scenes_within``, the
        fraction of scenes whose ``interval_2`` is .95 ± .03 (``calibrated_scenes_within``: after the calibration);
        ``room_bias``, the largest bias of a range bin of a scene with exact truth, and ``bias_over_floor``, the largest
        ratio of one to the floor of any other scene that has one.
    """
    start_floors = {**(floors or {}), **dict.fromkeys(exact, _MAX_EXACT_BIAS)}
    within: dict[str, list[float]] = {"scenes_within": [], "calibrated_scenes_within": []}
    biases: dict[bool, list[float]] = {True: [], False: []}
    for scene, points in ours.items():
        pooled = pytree.collate(points)
        numbers = measure_uncertainty(pooled)
        fitting = max((start for start in start_floors if scene.startswith(start)), key=len, default=None)
        floor = None if fitting is None else start_floors[fitting]
        bins = range_bias(pooled)
        row: dict[str, Any] = {k: numbers[k] for k in _UNCERTAINTY_NUMBERS}
        row |= {"floor": floor, "bias_bins": [b._asdict() for b in bins]}
        if method in list_calibrations():
            calibrated = load_calibration(method).apply(pooled)
            row |= {f"calibrated_{k}": interval_coverage(calibrated, k) for k in (1, 2)}
        rows[scene] |= row
        if int(pooled.keep.sum()) < _MIN_INTERVAL_ANSWERS:
            continue
        for name, key in (("scenes_within", "interval_2"), ("calibrated_scenes_within", "calibrated_2")):
            within[name] += [float(abs(row[key] - 0.95) <= 0.03)] if row.get(key) is not None else []
        if floor is not None:
            biases[fitting in exact] += [abs(b.bias) / (1 if fitting in exact else floor) for b in bins]
    stated: dict[str, Sequence[float | None]] = {k: [row[k] for row in rows.values()] for k in _UNCERTAINTY_NUMBERS}
    return {
        **{
            name: bootstrap.interval_over_scenes(values, statistic="mean", draws=draws, seed=seed)
            for name, values in (stated | within).items()
        },
        "room_bias": Interval(max(biases[True], default=None), None, None, len(biases[True])),
        "bias_over_floor": Interval(max(biases[False], default=None), None, None, len(biases[False])),
    }


def evaluate_promises(
    ours: SeedPoints, rooms: Mapping[str, str] | None, rows: dict[str, dict[str, Any]], draws: int, seed: int
) -> dict[str, Interval]:
    """Calibration numbers of a method, fitted on all rooms but one and evaluated there; see :func:`method_ratios`.

    Args:
        ours: scene → candidates of every seed.
        rooms: scene → room.
        rows: scene → its numbers; filled in place.
        draws, seed: of the bootstrap over scenes.
    """
    pooled = {scene: pytree.collate(points) for scene, points in ours.items()}
    calibrated, sigmoid = {}, {}
    for others, held_out in reliability.leave_one_room_out(pooled, rooms):
        if not any(bool(s.keep.any()) for s in others.values()):
            continue  # nothing to fit on: these scenes have no such number
        min_answers = MIN_ANSWERS_ABOVE_THRESHOLD * max(map(len, ours.values()))
        calibration = fit_calibration(
            list(others.values()),
            targets=_TARGET_PERCENT,
            choose=partial(control.scene_quantile_threshold, few=min_answers),
        )
        for scene, points in held_out.items():
            calibrated[scene] = calibration.apply(points)
            sigmoid[scene] = points.replace(score=torch.where(points.keep, calibration.sigmoid(points.score), 0.0))
            metrics = errors.measure_errors(calibrated[scene])
            rows[scene] |= {k: metrics[k] for k in ("within_sigma", "within_2sigma")}
            rows[scene]["ece"] = reliability.excess_ece(calibrated[scene], seed=seed)
            for percent, threshold in calibration.thresholds.items():
                rows[scene][f"realised_risk_{percent}"] = risk.realised_risk(points, threshold)
                above = 0 if threshold is None else int((points.keep & (points.score >= threshold)).sum())
                rows[scene][f"n_above_{percent}"] = above / len(ours[scene])
                rows[scene][f"coverage_within_{percent}"] = above / max(points.keep.numel(), 1)

    def mean(values: list[float | None]) -> Interval:
        return bootstrap.interval_over_scenes(values, statistic="mean", draws=draws, seed=seed)

    evaluated = [rows[scene] for scene in calibrated]
    numbers = {name: mean([row[name] for row in evaluated]) for name in ("within_sigma", "within_2sigma")}
    for percent in _TARGET_PERCENT:
        realised = [row[f"realised_risk_{percent}"] or 0.0 for row in evaluated]
        numbers[f"realised_risk_{percent}"] = mean(realised)
        well_answered = [
            r
            for r, row in zip(realised, evaluated, strict=True)
            if row[f"n_above_{percent}"] >= MIN_ANSWERS_ABOVE_THRESHOLD
        ]
        answered_risks = [
            row[f"realised_risk_{percent}"] for row in evaluated if row[f"realised_risk_{percent}"] is not None
        ]
        numbers[f"risk_of_speaking_{percent}"] = mean(answered_risks)
        numbers[f"coverage_within_{percent}"] = mean([row[f"coverage_within_{percent}"] for row in evaluated])
        numbers[f"within_target_{percent}"] = mean([float(r <= percent / 100) for r in well_answered])
    numbers["ece_scenes"] = mean([row["ece"] for row in evaluated])
    for name, scenes in (("ece", calibrated), ("ece_sigmoid", sigmoid), ("ece_raw", pooled)):
        numbers[name] = reliability.ece_interval([scenes[s] for s in calibrated], draws=draws, seed=seed)
    return numbers


def rotation_answered(
    rows: Sequence[Mapping[str, Any]], variants: Collection[str], cohort: str = "full"
) -> dict[str, Any]:
    """``<first variant>.rotation_answered``: fraction of the samples or pixels without a return that are answered where
    the camera only turns, pooled over such scenes and the variants, which are the seeds of a method."""
    rotations = {row["scene"] for row in rows if row.get("role") == "rotation"}
    pairs = [
        row
        for row in rows
        if row["scene"] in rotations
        and row["pair"] is not None
        and row["method"] in variants
        and row["truth"] == cohort
    ]
    holes = sum(row["n_holes"] for row in pairs)
    answered = sum(row["n_recovered"] for row in pairs) / holes if holes else None
    return {f"{next(iter(variants))}.rotation_answered": bootstrap.without_interval(answered, len(rotations))}


def worst_wrong_share(name: str, scenes: Sequence[Sequence[Points]]) -> dict[str, Any]:
    """``<name>.convoy_wrong``: largest fraction over scenes of candidates that are answered and wrong; seeds of a scene
    are pooled. Empty without a candidate."""
    pooled = [points for points in map(pytree.collate, scenes) if points.keep.numel()]
    if not pooled:
        return {}
    ratios = [float((points.keep & (points.error > errors.GROSS_ERROR_REL)).double().mean()) for points in pooled]
    return {f"{name}.convoy_wrong": bootstrap.without_interval(max(ratios), len(ratios))}


def complete_scenes(
    methods: Mapping[str, SeedPoints], reference: str, fallback: Mapping[str, str]
) -> dict[str, dict[str, Sequence[Points]]]:
    """Candidates of every method on the scenes of the reference, in its order; Args, Raises: :func:`method_ratios`."""
    if reference not in methods:
        raise ValueError(
            f"compare.reference: found {', '.join(methods) or 'no method'}, expected {reference} among them"
        )
    complete: dict[str, dict[str, Sequence[Points]]] = {}
    for method, own_scenes in methods.items():
        scenes = {**methods.get(fallback.get(method, method), {}), **own_scenes}
        for scene, seeds in methods[reference].items():
            if scene not in scenes or len(scenes[scene]) != len(seeds):
                message = f"{len(scenes[scene])} seeds" if scene in scenes else "nothing"
                raise ValueError(
                    f"compare.{method}.{scene}: found {message}, expected {len(seeds)} seeds as {reference}"
                )
        extra = sorted(scenes.keys() - methods[reference].keys())
        if extra:
            raise ValueError(f"compare.{method}.{extra[0]}: found a scene that {reference} does not have")
        complete[method] = {scene: scenes[scene] for scene in methods[reference]}
    return complete


def _geometric_mean(ratios: Mapping[str, float], draws: int, seed: int) -> Interval:
    """Geometric mean over scenes."""
    return bootstrap.interval_over_scenes(list(ratios.values()), statistic="geometric_mean", draws=draws, seed=seed)


def _worst_ratio(ratios: Mapping[str, float]) -> Interval:
    """Largest ratio over scenes, without an interval."""
    return Interval(max(ratios.values(), default=None), None, None, len(ratios))


def _median_over_seeds(seeds: Sequence[Points], measure: Callable[[Points], float | None]) -> float | None:
    defined = [v for v in map(measure, seeds) if v is not None]
    return statistics.median(defined) if defined else None


def _median_rel(points: Points) -> float | None:
    return errors.measure_errors(points)["median_rel"]
