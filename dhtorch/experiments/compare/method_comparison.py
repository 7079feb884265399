"""Question: is ``map`` more accurate than ``paper``, and are its sigma and score calibrated?

Expectation (written before the run): over the scenes the median error falls to at most 0.7 of the paper's (of a method
of several views: 0.6), no scene is more than 15 % worse at equal coverage, the area under the risk–coverage curve falls
to 0.65 (0.55), more than a quarter of the candidates can be answered at 5 % mean risk, about 68 % of the errors lie
within one stated sigma and 90 % within two, the recalibrated score is off by at most 0.07, and thresholds chosen on
other rooms keep the mean error within their target; another implementation of the reference (``kornia``) has .9 to 1.1
of its coverage and .9 to 1.15 of its error. The interval of two standard deviations holds the truth of 95 ± 3 % of the
answers in nine scenes of ten; where truth is exact no range bin with 200 answers is off by more than 1 %, elsewhere by
more than the floor that is printed for the scene's own truth.
What would refute it: any of these numbers missed.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from itertools import product

from dhtorch.data.pairs import candidate_frames, to_fixed_pairs
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments import compare_methods as compare
from dhtorch.experiments.baselines import xfeat
from dhtorch.experiments.outcome import Row
from dhtorch.experiments.protocol import (
    Answer,
    Method,
    Outcome,
    Progress,
    Protocol,
    ScenePairs,
    Settings,
    Variant,
    no_progress,
    run_protocol,
)
from dhtorch.metrics import bootstrap
from dhtorch.metrics.errors import Points
from dhtorch.metrics.uncertainty import disjoint_agreement
from dhtorch.records import Estimate
from dhtorch.stages.track_chain import track_chain

#: Number → (bar, whether it holds); the second of two bars is for a method of several views.
METHOD_BARS: dict[str, tuple[float, float, Callable[[float, float], bool]]] = {
    "median_rel_ratio": (0.70, 0.60, lambda value, bar: value <= bar),
    "worst_scene_ratio": (1.15, 1.15, lambda value, bar: value <= bar),
    "aurc_ratio": (0.65, 0.55, lambda value, bar: value <= bar),
    "coverage_at_5": (0.26, 0.27, lambda value, bar: value >= bar),
    "within_sigma": (0.68, 0.68, lambda value, bar: abs(value - bar) <= 0.07),
    "within_2sigma": (0.90, 0.90, lambda value, bar: value >= bar),
    "ece": (0.07, 0.07, lambda value, bar: value <= bar),
    "realised_risk_10": (0.10, 0.10, lambda value, bar: value <= bar),
    "realised_risk_5": (0.05, 0.05, lambda value, bar: value <= bar),
}

#: The same of the stated interval, where scenes define it.
_INTERVAL_BARS: dict[str, tuple[float, float, Callable[[float, float], bool]]] = {
    "scenes_within": (0.9, 0.9, lambda value, bar: value >= bar),
    "room_bias": (0.01, 0.01, lambda value, bar: value <= bar),
    "bias_over_floor": (1.0, 1.0, lambda value, bar: value <= bar),
}

#: Numbers that only a method which states a sigma has.
_SIGMA_NUMBERS = ("within_sigma", "within_2sigma", *_INTERVAL_BARS)

#: Number of another implementation of the reference → the interval in which its ratio must lie.
TWIN_BARS = {"coverage_ratio": (0.9, 1.1), "error_ratio": (0.9, 1.15)}


def run(
    scenes: Sequence[SceneLike],
    chosen: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    methods: Mapping[str, Method] | None = None,
    reference: str = "paper",
    once: Sequence[str] = ("opencv", "kornia", "xfeat"),
    twins: Sequence[str] = ("kornia",),
    ratios: Mapping[str, str] | None = None,
    chained: Sequence[str] = (),
    gaps: Sequence[int] = (),
    seeds: int = 5,
    stand_ins: Mapping[str, str] | None = None,
    baselines: Sequence[str] = (),
    indoor: Sequence[str] = (),
    moving: Sequence[str] = (),
    exact: Sequence[str] = (),
    floors: Mapping[str, float] | None = None,
    disjoint: Sequence[str] = (),
    progress: Progress = no_progress,
) -> Outcome:
    """Errors and coverages of several methods on the same pairs, several seeds each, relative to a reference.

    Rows are those of the first seed; scene rows of a compared method carry ``against_<reference>``: its numbers over
    all seeds. The summary holds, for every compared method, the numbers of
    :func:`dhtorch.experiments.compare_methods.method_ratios`. On scenes with fewer
    than three views a method of several views is replaced by its stand-in; one without a stand-in uses the views there
    are. Scene rows of methods that state a sigma carry ``<cause>_share``, the mean share of each cause in sigma²
    (medians over pairs).

    Args:
        scenes, chosen, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: name → method; None = ``chosen``.
        reference: name of the method to compare with.
        once: methods that are run with one seed and not compared.
        twins: other implementations of the reference among them, with bars of their ratios to it.
        ratios: method → the one that its first seed is divided by, beside twins and reference, which makes
            ``<method>.<number>_ratio_to_<other>``: geometric means over scenes of the ratios of ``coverage``, of the
            median ``error``, and of the error where both are cut by their own score to the same number of answers
            (``equal_error``). Methods that are not there are left out.
        chained: methods that are run once more with their tracker in a chain through the images between the two of a
            pair, as ``<method>_chain``, not compared.
        gaps: frames to a fixed source view, with which the first compared method is run on the reference views as
            ``<method>, gap <frames>``, not compared; a reference view without such a frame counts as unanswered.
        seeds: number of seeds, from the job's own upwards.
        stand_ins: method of several views → method of one; None = the first compared method for all.
        baselines: methods of several views with each of which the others of several views are compared as well.
        indoor: rooms whose scenes make the mean ``<method>.coverage_at_5_indoor``.
        moving: rooms in which near objects move; their scenes, whatever their role, make ``<method>.convoy_wrong``,
            the largest fraction over scenes of candidates (all seeds) that are answered with an error above 20 %.
        exact, floors: starts of names of scenes with exact truth, and start → printed relative error of the truth, see
            :func:`dhtorch.experiments.compare_methods.stated_uncertainty`.
        disjoint: compared methods that select views; they answer twice more, from disjoint halves of the candidates,
            for ``<method>.chi2`` and ``.chi2_median`` (:func:`dhtorch.metrics.uncertainty.disjoint_agreement`), means
            over scenes.

    Scenes with the role ``rotation`` make ``<method>.rotation_answered``
    (:func:`dhtorch.experiments.compare_methods.rotation_answered`).

    Raises:
        ValueError: no reference, or neither a method to compare with it nor a twin; a chained method that is not there;
            else as the main job.
    """
    methods = dict(methods or chosen)
    compared = [name for name in methods if name not in (*once, reference)]
    if absent := sorted({*chained} - set(methods)):
        raise ValueError(f"experiment.chained: found {', '.join(absent)}, expected some of {', '.join(methods)}")
    wrapped = {name: partial(track_chain, track=methods[name].track) for name in chained}
    methods |= {f"{name}_chain": methods[name].replace(track=track) for name, track in wrapped.items()}
    twins = [name for name in twins if name in methods]
    if reference not in methods or not (compared or twins):
        raise ValueError(f"experiment.methods: found {', '.join(methods)}, expected {reference} and one more")
    fallback = stand_ins or {name: compared[0] for name in compared if methods[name].views > 1}
    variants = {
        _seed_variant_name(name, k): _make_variant(method, settings.seed + k, pairs if name in fallback else None)
        for name, method in methods.items()
        for k in range(seeds if name in (reference, *compared) else 1)
    }
    variants |= {
        f"{name}, gap {gap}": Variant(methods[name], offers=partial(_view_at_gap, gap=gap))
        for name, gap in product(compared[:1], gaps)
    }
    variants |= {
        f"{name}, half {half}": Variant(methods[name], offers=partial(half_of_candidates, half=half))
        for name, half in product(disjoint, (0, 1))
    }
    columns = _SigmaColumns({name for name, variant in variants.items() if variant.states_sigma}, disjoint)
    outcome = run_protocol(scenes, Protocol(variants, columns=columns), pairs, settings, progress=progress)
    for name in disjoint:
        _join_halves(outcome, name)
    rooms = {scene.name: scene.place for scene in scenes_of(scenes)}
    with_role = {scene.name for scene in scenes_of(scenes) if scene.role is not None}
    all_points = {name: _points_by_seed(outcome, name, seeds) for name in (reference, *compared)}
    points_of = {
        name: {s: p for s, p in scene_points.items() if s not in with_role} for name, scene_points in all_points.items()
    }
    complete = compare.complete_scenes(points_of, reference, fallback)
    comparison = compare.method_ratios(complete, reference=reference, rooms=rooms, exact=exact, floors=floors)
    for name in (reference, *compared):
        seeds_of = [_seed_variant_name(name, k) for k in range(seeds)]
        outcome.summary |= compare.rotation_answered(outcome.rows, seeds_of, outcome.cohort)
    _keep_first_seed(outcome, methods, seeds)
    outcome.summary |= comparison.summary
    agreement: Row = {}
    known = {name: other for name, other in (ratios or {}).items() if {name, other} <= methods.keys()}
    for name, other in {**dict.fromkeys(twins, reference), **known}.items():
        one, two = (_points_by_seed(outcome, n, 1, apart=with_role) for n in (name, other))
        numbers = {f"{name}.{k}": v.entry("1") for k, v in compare.twin_ratios(one, two, other).items()}
        agreement |= {k: v for k, v in numbers.items() if name in twins and "equal" not in k}
        outcome.summary |= numbers
    outcome.summary |= _indoor_coverage(comparison, rooms, indoor)
    for name, scene_points in all_points.items():
        outcome.summary |= compare.worst_wrong_share(
            name, [p for scene, p in scene_points.items() if rooms[scene] in moving]
        )
    several = [name for name in compared if methods[name].views > 1]
    for name, baseline in product((n for n in several if n not in baselines), baselines):
        if baseline not in compared:
            continue
        against, against_by_scene = compare.multiview_ratios(complete[name], complete[baseline], baseline)
        outcome.summary |= {f"{name}.{k}": v.entry("1") for k, v in against.items()}
        for scene, row in outcome.scenes(name).items():
            row.update(against_by_scene.get(scene, {}))  # none where there were too few candidates
    for numbers in comparison.rows:
        row = outcome.scenes(str(numbers["method"]))[str(numbers["scene"])]
        row[f"against_{reference}"] = {k: v for k, v in numbers.items() if k not in ("scene", "method")}
    without_sigma = {name for name in compared if not methods[name].states_sigma}
    return outcome.decide(
        "Is map more accurate than paper, and are its sigma and score calibrated?",
        (
            "Every number of the list of bars is met; scenes are the unit, thresholds hold in rooms they were "
            "not fitted on."
        ),
        *verdict(comparison, compared, set(several), agreement, without_sigma),
    )


def verdict(
    comparison: compare.MethodComparison,
    compared: Sequence[str],
    several: set[str],
    agreement: Row | None = None,
    without_sigma: Collection[str] = (),
) -> tuple[bool | None, str]:
    """(all bars met, or None if a number is undefined; bars that are missed, scenes without a ratio or an answer).

    ``agreement``: ``<method>.<number>_to_<reference>`` → entry of the summary, of other implementations of the
    reference. ``without_sigma``: methods that state none and have no bars of it.
    """
    missed, n_met = [], 0
    for name, entry in (agreement or {}).items():
        low, high = next(bars for number, bars in TWIN_BARS.items() if f".{number}_to_" in name)
        if entry["value"] is None:
            return None, f"{name} is not defined on these scenes"
        n_met += low <= entry["value"] <= high
        missed += [] if low <= entry["value"] <= high else [f"{name} {entry['value']:.3f} (bars {low:g}, {high:g})"]
    for method, (number, (two_view_bar, multi_view_bar, holds)) in product(
        compared, (METHOD_BARS | _INTERVAL_BARS).items()
    ):
        if method in without_sigma and number in _SIGMA_NUMBERS:
            continue
        value = comparison.summary.get(f"{method}.{number}", {}).get("value")
        bar = multi_view_bar if method in several else two_view_bar
        if value is None and number in METHOD_BARS:
            return None, f"{method}.{number} is not defined on these scenes"
        if value is not None:
            n_met += holds(value, bar)
            missed += [] if holds(value, bar) else [f"{method}.{number} {value:.3f} (bar {bar:g})"]
    notes = [f"{m} without ratio: {', '.join(scenes)}" for m, scenes in comparison.left_out.items() if scenes]
    notes += [f"{m} states no sigma" for m in without_sigma]
    notes += [f"{m} % risk: no answer on {', '.join(scenes)}" for m, scenes in comparison.unanswered.items() if scenes]
    return not missed, "; ".join([f"{n_met} of {n_met + len(missed)} bars met", *missed, *notes])


def _view_at_gap(recording: Recording, reference: int, *, gap: int) -> list[int]:
    """[Position of the frame ``gap`` numbers after the reference view, or else before it]; empty without either."""
    for step in (gap, -gap):
        positions: list[int] = (recording.number == recording.number[reference] + step).nonzero()[:, 0].tolist()
        if positions:
            return positions
    return []


def half_of_candidates(recording: Recording, reference: int, *, half: int) -> list[int]:
    """Every second candidate view of a reference view, from the first (0) or the second (1) on."""
    return candidate_frames(recording, reference)[half::2]


class _SigmaColumns:
    """Columns of a pair: shares of the causes in sigma²; of the second half of source views the agreement with the
    first."""

    def __init__(self, stated: Collection[str], disjoint: Sequence[str]) -> None:
        self._stated, self._first = stated, {f"{name}, half 0" for name in disjoint}
        self._waiting: dict[tuple[str, int, str], Estimate] = {}

    def __call__(self, answer: Answer) -> Row:
        estimate, name = answer.estimate, answer.variant
        key = answer.batch.scene.name, answer.batch.pairs[0].reference, name.partition(",")[0]
        if name in self._first:
            self._waiting[key] = estimate
            return {}
        if key in self._waiting and name.endswith("half 1"):
            agreement = disjoint_agreement(self._waiting.pop(key), estimate)
            return {"chi2": agreement.chi2, "chi2_median": agreement.chi2_median, "n_chi2": agreement.n}
        open_ = estimate.keep & ~answer.samples.usable & (estimate.sigma > 0)
        if name not in self._stated or not bool(open_.any()):
            return {}
        budget, total = estimate.budget, estimate.sigma.square()
        terms = {cause: getattr(budget, cause) for cause in ("track", "pose", "reference", "lens", "model")}
        return {f"{cause}_share": float((x / total)[open_].mean()) for cause, x in terms.items()}


def _join_halves(outcome: Outcome, name: str) -> None:
    """Remove the rows and numbers of the halves of a method; its scene rows and summary get their agreement."""
    halves = [f"{name}, half {k}" for k in (0, 1)]
    second = {r["scene"]: r for r in outcome.rows if r["method"] == halves[1] and r["pair"] is None}
    for row in outcome.rows:
        if row["method"] == name and row["pair"] is None:
            row |= {k: second.get(row["scene"], {}).get(k) for k in ("chi2", "chi2_median", "n_chi2")}
    outcome.rows = [row for row in outcome.rows if row["method"] not in halves]
    outcome.summary = {k: v for k, v in outcome.summary.items() if k.partition(".")[0] not in halves}
    for k in ("chi2", "chi2_median"):
        values = [row.get(k) for row in outcome.scenes(name).values()]
        outcome.summary[f"{name}.{k}"] = bootstrap.interval_over_scenes(values, statistic="mean").entry("1")


def _indoor_coverage(comparison: compare.MethodComparison, rooms: Mapping[str, str], indoor: Sequence[str]) -> Row:
    """Mean coverage at 5 % risk of every method over the scenes of the indoor rooms."""
    coverages: dict[str, list[float]] = {}
    for row in comparison.rows:
        if rooms[row["scene"]] in indoor and row["coverage_at_5"] is not None:
            coverages.setdefault(row["method"], []).append(row["coverage_at_5"])
    return {
        f"{name}.coverage_at_5_indoor": bootstrap.interval_over_scenes(values, statistic="mean").entry("1")
        for name, values in coverages.items()
    }


def _make_variant(method: Method, seed: int, pairs: ScenePairs | None) -> Variant:
    """Variant of a method: candidate views around the reference view if it selects views, else the pair's own.

    With ``pairs`` it is skipped on scenes of too few views.
    """
    offers = None if method.select_views is None else candidate_frames
    views_of = pairs if offers is None and method.views > 1 else None

    def skip_reason(scene: Scene) -> str | None:
        few = views_of is not None and min((j - i for i, j in to_fixed_pairs(views_of(scene))), default=2) < 2
        return xfeat.method_missing_reason(method) or ("fewer than 3 views" if few else None)

    return Variant(method, seed=seed, offers=offers, needs=skip_reason)


def _seed_variant_name(method: str, k: int) -> str:
    """Name of the variant of a method with seed ``k``; that of the first seed is the method's own name."""
    return method if k == 0 else f"{method}, seed {k}"


def _keep_first_seed(outcome: Outcome, methods: Iterable[str], seeds: int) -> None:
    """Remove the later seeds from the rows and the summary; their points remain."""
    later = {_seed_variant_name(name, k) for name in methods for k in range(1, seeds)}
    outcome.rows = [r for r in outcome.rows if r["method"] not in later]
    outcome.summary = {k: v for k, v in outcome.summary.items() if not any(k.startswith(f"{m}.") for m in later)}


def _points_by_seed(outcome: Outcome, method: str, seeds: int, apart: Collection[str] = ()) -> dict[str, list[Points]]:
    """Scene → candidates of every seed, without the scenes in ``apart``."""
    scenes: dict[str, list[Points]] = {}
    for k in range(seeds):
        for (scene, variant, cohort), points in outcome.points.items():
            if (variant, cohort) == (_seed_variant_name(method, k), outcome.cohort) and scene not in apart:
                scenes.setdefault(scene, []).append(points)
    return scenes
