"""Question: is z ± U true: does the stated interval hold the truth, at every range and in every scene?

Expectation (written before the run): the interval of two standard deviations holds the truth of 95 ± 3 % of the answers
in nine scenes of ten; in built-in rooms, whose truth is exact, no range bin with 200 answers is off by more than 1 %;
in real scenes none is off by more than the floor that is printed for the scene's own truth.
What would refute it: any of the three numbers missed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

from dhtorch.data.pairs import candidate_frames
from dhtorch.data.recording import Recording
from dhtorch.data.scene import SceneLike, scenes_of
from dhtorch.experiments import protocol
from dhtorch.experiments.protocol import Answer, Method, Outcome, Progress, Protocol, ScenePairs, Settings, Variant
from dhtorch.experiments.rows import Row
from dhtorch.metrics import bootstrap
from dhtorch.metrics.calibration import list_calibrations, load_calibration
from dhtorch.metrics.uncertainty import disjoint_agreement, interval_coverage, measure_uncertainty, range_bias
from dhtorch.records import Estimate

QUESTION = "Does the stated interval hold the truth, at every range and in every scene?"
EXPECTATION = "Two sigmas hold 95 ± 3 % in nine scenes of ten; no range bin is off by more than the truth's own floor."

#: Coverage of two standard deviations of a normal error, and the tolerance of a scene. Source: the requirement.
_NOMINAL, _TOLERANCE = 0.95, 0.03

#: Fraction of the scenes that must lie within the tolerance. Source: the requirement.
_MIN_SHARE = 0.9

#: Largest bias of a range bin of a scene whose truth is exact. Source: the requirement.
_MAX_EXACT_BIAS = 0.01

#: Fewest answers of a scene whose coverage counts. Source: derived, 1.5 % of standard error at 95 %.
_MIN_ANSWERS = 200


def run(
    scenes: Sequence[SceneLike],
    chosen: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    methods: Mapping[str, Method] | None = None,
    rooms: Sequence[SceneLike] = (),
    floors: Mapping[str, float] | None = None,
    reference_views: int | None = 4,
    disjoint: Sequence[str] = ("auto",),
    progress: Progress = protocol.no_progress,
) -> Outcome:
    """Coverage of intervals, bias by range, AURC and AUSE, and agreement of disjoint source views, scene by scene.

    Scene rows carry the numbers of :func:`dhtorch.metrics.uncertainty.measure_uncertainty`, ``bias_bins`` (low, high in
    m, n, median and mean signed error), ``floor``, ``calibrated_1`` and ``_2`` (coverage after the package's
    calibration of the method, where there is one), ``chi2`` and ``chi2_median`` of disjoint halves of the candidate
    views, and ``<cause>_share``, the mean share of each cause in sigma² (medians over reference views). The summary
    holds, for every method, means over scenes with their intervals, ``scenes_within`` (share of the scenes whose
    ``interval_2`` is .95 ± .03; ``calibrated_scenes_within``: after the calibration), and ``room_bias`` and
    ``bias_over_floor``, the largest of the biases and of their ratios to the floor.

    Args:
        scenes, chosen, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`; of ``pairs`` only the
            reference views are used.
        methods: name → method that states a sigma; None = ``chosen``.
        rooms: further scenes, with exact truth.
        floors: start of a scene's name → printed relative error of its truth; the longest fitting start counts. Scenes
            without one are left out of ``bias_over_floor``.
        reference_views: number of reference views of a scene, evenly spaced; None = all.
        disjoint: methods that answer twice more, from disjoint halves of the candidate views.
    """
    methods = dict(methods or chosen)
    exact = {scene.name for scene in scenes_of(rooms)}
    everything = [*scenes_of(scenes), *scenes_of(rooms)]
    variants = {name: Variant(method, offers=candidate_frames) for name, method in methods.items()}
    for name in disjoint:
        variants |= disjoint_variants(name, methods[name])
    run_protocol = Protocol(variants, columns=UncertaintyColumns(disjoint))
    spread = partial(protocol.spread_pairs, pairs, reference_views)
    outcome = protocol.run(everything, run_protocol, spread, settings, progress=progress)
    join_halves(outcome, disjoint)
    for name in methods:
        rows = outcome.scenes(name)
        for scene, row in rows.items():
            _add_numbers(row, outcome, (scene, name, outcome.cohort), floors or {}, scene in exact)
        outcome.summary |= {f"{name}.{k}": v for k, v in _summarise(list(rows.values())).items()}
    return outcome.decide(QUESTION, EXPECTATION, *verdict(outcome, list(methods)))


def disjoint_variants(name: str, method: Method) -> dict[str, Variant]:
    """The method with every second candidate view, and with the others: ``<name>, half 0`` and ``<name>, half 1``."""
    return {f"{name}, half {k}": Variant(method, offers=partial(half_of_candidates, half=k)) for k in (0, 1)}


def half_of_candidates(recording: Recording, reference: int, *, half: int) -> list[int]:
    """Every second candidate view of a reference view, from the first (0) or the second (1) on."""
    return candidate_frames(recording, reference)[half::2]


class UncertaintyColumns:
    """Columns of a pair: shares of the causes in sigma²; of the second half of source views the agreement with the
    first."""

    def __init__(self, disjoint: Sequence[str]) -> None:
        self._first = {f"{name}, half 0" for name in disjoint}
        self._waiting: dict[tuple[str, int, str], Estimate] = {}

    def __call__(self, answer: Answer) -> Row:
        """Columns of one answer."""
        estimate, name = answer.estimate, answer.variant
        key = answer.batch.scene.name, answer.batch.pairs[0].reference, name.partition(",")[0]
        if name in self._first:
            self._waiting[key] = estimate
            return {}
        if key in self._waiting and name != key[-1]:
            agreement = disjoint_agreement(self._waiting.pop(key), estimate)
            return {"chi2": agreement.chi2, "chi2_median": agreement.chi2_median, "n_chi2": agreement.n}
        open_ = estimate.keep & ~answer.samples.usable & (estimate.sigma > 0)
        if not bool(open_.any()):
            return {}
        budget, total = estimate.budget, estimate.sigma.square()
        terms = {field: getattr(budget, field) for field in ("track", "pose", "reference", "lens", "model")}
        return {f"{field}_share": float((x / total)[open_].mean()) for field, x in terms.items()}


def join_halves(outcome: Outcome, disjoint: Sequence[str]) -> None:
    """Remove the rows and numbers of the halves; scene rows of the method get the agreement of its halves."""
    for name in disjoint:
        halves = [f"{name}, half {k}" for k in (0, 1)]
        second = {r["scene"]: r for r in outcome.rows if r["method"] == halves[1] and r["pair"] is None}
        for row in outcome.rows:
            if row["method"] == name and row["pair"] is None:
                other = second.get(row["scene"], {})
                row |= {k: other.get(k) for k in ("chi2", "chi2_median", "n_chi2")}
        outcome.rows = [row for row in outcome.rows if row["method"] not in halves]
        starts = tuple(f"{half}." for half in halves)
        outcome.summary = {k: v for k, v in outcome.summary.items() if not k.startswith(starts)}


def summarise_agreement(name: str, rows: Sequence[Row]) -> Row:
    """``<name>.chi2`` and ``.chi2_median`` of scene rows, means over scenes."""
    return {
        f"{name}.{k}": bootstrap.interval_over_scenes([row.get(k) for row in rows], statistic="mean").entry("1")
        for k in ("chi2", "chi2_median")
    }


def _add_numbers(
    row: Row, outcome: Outcome, key: tuple[str, str, str], floors: Mapping[str, float], is_exact: bool
) -> None:
    """The uncertainty numbers of one scene, from its pooled candidates."""
    row["exact"], row["floor"] = is_exact, _MAX_EXACT_BIAS if is_exact else _floor_of(key[0], floors)
    if key not in outcome.points:
        return
    points = outcome.points[key]
    row |= measure_uncertainty(points)
    row["bias_bins"] = [b._asdict() for b in range_bias(points)]
    row["counts"] = int(points.keep.sum()) >= _MIN_ANSWERS
    if key[1] in list_calibrations():
        calibrated = load_calibration(key[1]).apply(points)
        row |= {f"calibrated_{k}": interval_coverage(calibrated, k) for k in (1, 2)}


def _floor_of(scene: str, floors: Mapping[str, float]) -> float | None:
    fitting = [start for start in floors if scene.startswith(start)]
    return floors[max(fitting, key=len)] if fitting else None


def _summarise(rows: Sequence[Row]) -> Row:
    """Summary entries of one method over its scenes."""
    counted = [row for row in rows if row.get("counts")]

    def over(values: Sequence[float | None]) -> Row:
        return bootstrap.interval_over_scenes(values, statistic="mean").entry("1")

    numbers = ("interval_1", "interval_2", "calibrated_1", "calibrated_2", "aurc", "ause", "chi2", "chi2_median")
    summary: Row = {k: over([row.get(k) for row in counted]) for k in numbers if any(k in row for row in counted)}
    for name, coverage in (("scenes_within", "interval_2"), ("calibrated_scenes_within", "calibrated_2")):
        stated = [row[coverage] for row in counted if row.get(coverage) is not None]
        summary[name] = over([float(abs(v - _NOMINAL) <= _TOLERANCE) for v in stated])
    for name, fits in (("room_bias", lambda r: r["exact"]), ("bias_over_floor", lambda r: not r["exact"])):
        summary[name] = _worst_bias([row for row in counted if fits(row) and row["floor"]], name == "room_bias")
    return summary


def _worst_bias(rows: Sequence[Row], absolute: bool) -> Row:
    """Largest bias of a range bin over scenes, in itself or over the scene's floor; no interval."""
    biases = [b["bias"] if absolute else b["bias"] / row["floor"] for row in rows for b in row["bias_bins"]]
    return bootstrap.without_interval(max(map(abs, biases), default=None), len(biases))


def verdict(outcome: Outcome, methods: Sequence[str]) -> tuple[bool | None, str]:
    """(all three bars met by every method, or None where one is undefined; the numbers)."""
    bars: dict[str, Callable[[float], bool]] = {
        "scenes_within": lambda v: v >= _MIN_SHARE,
        "room_bias": lambda v: v <= _MAX_EXACT_BIAS,
        "bias_over_floor": lambda v: v <= 1,
    }
    met, words = [], []
    for method in methods:
        for name, holds in bars.items():
            value = outcome.summary[f"{method}.{name}"]["value"]
            met.append(None if value is None else holds(value))
            words.append(f"{method}.{name} " + ("not measured" if value is None else f"{value:.3f}"))
    decided = False if False in met else (None if None in met else True)
    return decided, "; ".join([f"{met.count(True)} of {len(met)} bars met", *words])
