"""Evaluation loop of all experiments: run variants of a method on the pairs of every scene → rows of a result.

A *variant* is a method with the options of an experiment. A *cohort* selects the samples with truth that are evaluated;
it is the same for every variant, also where the pose fails. A *protocol* combines both and hides part of the input from
the methods. An experiment is a protocol, a question about its rows, and a verdict.
"""

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dhtorch import pytree
from dhtorch.codes import Gate, Hole, names
from dhtorch.data.pairs import Pair, to_fixed_pairs
from dhtorch.data.recording import Recording, TruthRecording
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.finished_scenes import FinishedScenes
from dhtorch.experiments.loading import CandidateViews, PairDataset, candidate_views, load_pairs, move_to_device
from dhtorch.experiments.outcome import (
    Example,
    MainMetric,
    Outcome,
    Row,
    mean_or_none,
    median_or_none,
    overlay_points,
    scene_row,
    summarise_rows,
)
from dhtorch.geometry.patches import extract_patches, round_half_up, sample_nearest
from dhtorch.metrics import errors, holdout
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.spec import Trace
from dhtorch.pipeline.view_report import ViewReport, report_selection, with_view_selection
from dhtorch.records import NO_HINT, Estimate, Frame, PoseFit, Samples, TrackHint, Tracks
from dhtorch.stages.track_chain import frames_between, images_used

# Cache of tracks: variants that differ only in pose, gates or seed share the tracks of a batch.

TrackStage = Callable[..., Tracks]


class SharedTracks:
    """Cache of the tracks of one batch of pairs.

    The same function with the same options, images, pixels and initial values returns the cached record. Its time is
    added to every variant as if each had tracked.
    """

    def __init__(self) -> None:
        self._cached: list[tuple[Any, tuple[Tensor, ...], Tracks, float]] = []
        self._uncharged_ms = 0.0

    def shared_tracker(self, track: TrackStage) -> TrackStage:
        """Cached track stage of one variant."""
        self._uncharged_ms = 0.0
        return partial(self._track, track)

    def charge(self, ms: dict[str, float]) -> None:
        """Add the time of the cached tracks to ``ms["track"]``."""
        if self._uncharged_ms:
            ms["track"] = ms.get("track", 0.0) + self._uncharged_ms
            self._uncharged_ms = 0.0

    def _track(
        self,
        track: TrackStage,
        image_0: Tensor,
        image_1: Tensor,
        uv_0: Tensor,
        *,
        hint: TrackHint = NO_HINT,  # its pyramid is a function of the image
    ) -> Tracks:
        start = time.perf_counter()
        key = stage_key(track), hint.levels
        inputs = (image_0, image_1, uv_0, uv_0 if hint.start is None else hint.start, *(hint.between or ()))
        for cached_key, cached_inputs, tracks, ms in self._cached:
            if (
                cached_key == key
                and len(cached_inputs) == len(inputs)
                and all(map(_is_same_tensor, cached_inputs, inputs))
            ):
                self._uncharged_ms += ms
                return tracks
        tracks = track(image_0, image_1, uv_0, hint=hint)
        self._cached.append((key, inputs, tracks, 1e3 * (time.perf_counter() - start)))
        return tracks


def _is_same_tensor(a: Tensor, b: Tensor) -> bool:
    """Whether two tensors share memory or have equal values (selected views are copies)."""
    is_same_memory = a.data_ptr() == b.data_ptr() and a.stride() == b.stride()
    return a.shape == b.shape and a.dtype == b.dtype and (is_same_memory or torch.equal(a, b))


def stage_key(fn: Any) -> Any:
    """Comparable key of a stage: partials of one function with equal options have equal keys, however nested."""
    if not isinstance(fn, partial):
        return fn
    options = {k: stage_key(v) for k, v in fn.keywords.items()}
    args = tuple(map(stage_key, fn.args))
    if isinstance(fn.func, partial):
        inner, before, others = stage_key(fn.func)
        return inner, before + args, others | options
    return fn.func, args, options


ScenePairs = Callable[[Scene], Sequence[Pair] | Sequence[tuple[int, int]]]
Progress = Callable[[Iterable[Any], str, int], Iterable[Any]]

#: Fewest candidates of a pair; a pair with fewer is dropped and counted.
MIN_CANDIDATES = 20

#: Side of the window that influences a track (LK window and a margin), px.
_TRACK_REACH_PX = 25


def no_progress(items: Iterable[Any], _text: str, _total: int) -> Iterable[Any]:
    """No progress bar."""
    return items


@dataclass(frozen=True)
class Settings:
    """Options shared by all pairs of a job."""

    cutoff: float | None = None  # m; None = the scene's own near limit
    cutoff_factor: float = 1.0  # multiplies either cutoff
    truth: tuple[str, ...] = ("full",)  # truth tests to report: raw | 5x5 | full
    seed: int = 0
    device: str = "cpu"
    dtype: torch.dtype = torch.float32
    batch: int = 1
    workers: int = 0
    between: int | None = None  # frames between the two of a pair for its tracker, at most; None = as many as it uses
    finished: FinishedScenes = field(default_factory=FinishedScenes, repr=False, compare=False)  # of an earlier run

    def cutoff_of(self, scene: Scene) -> float | None:
        """Cutoff of a scene, m; None where it has no near limit."""
        cutoff = scene.near if self.cutoff is None else self.cutoff
        return None if cutoff is None else cutoff * self.cutoff_factor


@dataclass(frozen=True)
class Batch:
    """Pairs of one scene, loaded: the input of cohorts and columns."""

    scene: Scene
    pairs: Sequence[Pair]
    cutoff: float | None  # m
    reference: Frame
    others: tuple[Frame, ...]  # source views, the pair's own last; empty if candidate frames are offered instead
    exact: Frame  # the reference view with its true depth
    surface: Tensor  # (B, H, W) kind of surface, (B, 1, 1) where the recording has none
    disagreement: Tensor  # (B,) median relative difference of the independent truth from the sensor; NaN = none
    around: tuple[Frame, ...] = ()  # candidate source views of any variant, in the order of the recording
    between: tuple[Tensor, ...] = ()  # images (B, C, H, W) between the reference view and the pair's own source view

    @property
    def odd(self) -> dict[int, str]:
        """Kinds of surface that are evaluated separately: code → name."""
        room = self.scene.recording
        if not isinstance(room, TruthRecording):
            return {}
        return {k: name for k, name in room.surfaces.items() if name in room.odd_surfaces}

    def kinds(self, uv: Tensor) -> Tensor | None:
        """Kind of surface (B, N) at samples; an odd surface within the track's window takes precedence."""
        if self.surface.shape[-1] == 1:
            return None
        kind = sample_nearest(self.surface, uv)[0]
        corner = (round_half_up(uv) - _TRACK_REACH_PX // 2).long()
        around = extract_patches(self.surface[:, None], corner, min(_TRACK_REACH_PX, *self.surface.shape[-2:]))[
            :, :, 0
        ].flatten(-2)
        for code in self.odd:
            kind = torch.where((around == code).any(-1), torch.full_like(kind, code), kind)
        return kind


Cohort = Callable[[Batch, Trace], holdout.Truth]


@dataclass(frozen=True)
class Variant:
    """A method with the options of an experiment."""

    method: Method
    estimate: Callable[..., Estimate] | None = (
        None  # replaces the method's call: (method, reference view, source views, *, …)
    )
    fit: Callable[[Batch, int], PoseFit] | None = None  # replaces the estimated pose: (batch, number of samples) → fit
    seed: int | None = None  # None = the job's
    call_options: Callable[[Batch], Mapping[str, Any]] = (
        lambda _batch: {}
    )  # further options of the call, from the whole batch (for oracles)
    offers: CandidateViews | None = (
        None  # candidate source views instead of the pair's own; unanswered if there are none
    )
    needs: Callable[[Scene], str | None] = lambda _scene: (
        None
    )  # scene → reason why the variant cannot run there, None = it can
    chooses: bool = False  # ``estimate`` selects among candidate views, as the method does
    two_frames: bool = False  # no view selection: the held-out samples would influence it

    @property
    def states_sigma(self) -> bool:
        """Whether the sigma of its estimates is a statement: always for ``estimate``, else as the method."""
        return self.estimate is not None or self.method.states_sigma


@dataclass(frozen=True)
class Answer:
    """Estimate of one variant on the pairs of a batch, with the truth of every cohort."""

    batch: Batch
    variant: str
    estimate: Estimate
    trace: Trace
    truths: Mapping[str, holdout.Truth]

    @property
    def samples(self) -> Samples:
        """Samples of the method's input, after hiding."""
        samples: Samples = self.trace["samples"]
        return samples

    @property
    def other(self) -> tuple[int, Frame]:
        """Source view (B = 1) of the trace's tracks and pose: (position in the recording, frame)."""
        pair = self.batch.pairs[0]
        if isinstance(pair.other, int):
            return pair.other, self.batch.others[-1]
        k = int(self.trace["choice"].index[-1, 0]) if "choice" in self.trace else 0
        return pair.candidates[k], self.batch.around[k]

    def one(self, b: int) -> "Answer":
        """Answer of pair ``b`` alone; its milliseconds are those of the batch divided by the number of pairs."""
        size, cut = len(self.batch.pairs), slice(b, b + 1)
        records = {k: v[cut] for k, v in self.trace.items() if isinstance(v, pytree.Record)}
        records |= {k: self.trace[k][:, cut] for k in ("choice",) if k in self.trace}
        return replace(
            self,
            batch=replace(
                self.batch,
                pairs=self.batch.pairs[cut],
                reference=self.batch.reference[cut],
                others=tuple(f[cut] for f in self.batch.others),
                around=tuple(f[cut] for f in self.batch.around),
                between=tuple(image[cut] for image in self.batch.between),
                exact=self.batch.exact[cut],
                surface=self.batch.surface[cut],
                disagreement=self.batch.disagreement[cut],
            ),
            estimate=self.estimate[cut],
            trace={**records, "ms": {k: v / size for k, v in self.trace["ms"].items()}},
            truths={k: v[cut] for k, v in self.truths.items()},
        )


def held_back_truth(batch: Batch, trace: Trace, *, test: str = "full") -> holdout.Truth:
    """Cohort of the range split: truth at samples whose return was masked and whose truth passes the truth test."""
    truth = far_truth(batch, trace, test=test)
    if batch.cutoff is None or batch.cutoff == math.inf:
        return truth
    return holdout.require_masked(truth, batch.reference, trace["samples"].uv, batch.cutoff)


def far_truth(batch: Batch, trace: Trace, *, test: str = "full") -> holdout.Truth:
    """Truth beyond the cutoff that passes the truth test, whether or not the sensor has a return there."""
    samples: Samples = trace["samples"]
    kinds = batch.kinds(samples.uv)
    odd = None if kinds is None else torch.isin(kinds, torch.tensor([*batch.odd], dtype=kinds.dtype).to(kinds.device))
    truth_at_samples = holdout.sample_truth(batch.exact, samples.uv, truth=test)
    return holdout.select_candidates(
        samples, truth_at_samples, batch.cutoff if _has_cutoff(batch.cutoff) else None, excluded=odd
    )


def spread_pairs(pairs: ScenePairs, references: int | None, scene: Scene) -> list[tuple[int, int]]:
    """Pairs of two frames of a scene, ``references`` of them evenly spaced; None = all."""
    fixed = to_fixed_pairs(pairs(scene))
    if references is None or len(fixed) <= references:
        return fixed
    return [fixed[(2 * k + 1) * len(fixed) // (2 * references)] for k in range(references)]


@dataclass(frozen=True)
class Protocol:
    """Variants to run, the input they see, the cohorts that are evaluated, and further columns of each pair."""

    variants: Mapping[str, Variant]
    cohorts: Mapping[str, Cohort] = field(
        default_factory=dict
    )  # the last one selects the pairs; none = those of the range split, by the truth tests of the settings
    hide: Callable[[Frame, float | None], Frame] = holdout.range_split  # (view, cutoff) → the view as a method sees it
    columns: Callable[[Answer], Row] = (
        lambda _answer: {}
    )  # of one pair; numbers enter the scene's row as medians over pairs
    min_candidates: int = MIN_CANDIDATES
    reads_scores: bool = False  # the score of every method is evaluated as a probability, also one that only orders

    @property
    def offers(self) -> CandidateViews | None:
        """Union of the candidate views of all variants, in the order of the recording; None if no variant has any."""
        functions = list(dict.fromkeys(v.offers for v in self.variants.values() if v.offers is not None))
        return partial(_all_candidates, functions) if functions else None

    def views(self, pairs: Sequence[Pair]) -> int:
        """Number of source views loaded per pair: the maximum over variants, at most the smallest gap of a pair."""
        most = max((v.method.views for v in self.variants.values() if v.offers is None), default=1)
        return min([most, *(max(1, j - i) for i, j in pairs if isinstance(j, int))])

    def between(self, settings: Settings) -> int:
        """Number of frames loaded between the two of a pair: the settings', else the maximum over variants."""
        if settings.between is not None:
            return settings.between
        return max((images_used(v.method.track) for v in self.variants.values() if v.offers is None), default=0)


def run_protocol(
    scenes: Sequence[SceneLike],
    protocol: Protocol,
    pairs: ScenePairs,
    settings: Settings,
    *,
    progress: Progress = no_progress,
) -> Outcome:
    """Run every variant on every pair of every scene → rows, summary, examples and pooled points.

    Truth is the held-back return of the reference view, or the exact depth of a recording that has it (``truth(i)``);
    surfaces such as mirrors are then evaluated separately. Points are pooled inside a scene; the summary is the median
    over scenes without a role. A scene without pairs has a row with the note "too short".

    Args:
        scenes: see :class:`dhtorch.data.scene.Scene`; a recording is a scene without a near limit or role.
        protocol: variants, cohorts and the function that hides input.
        pairs: scene → list of :class:`dhtorch.data.pairs.Pair`, or plain (reference view, other).
        settings: cutoff, seed, device, batch, workers.
        progress: wraps the loop over a scene's batches: (items, text, number of items) → items.

    Raises:
        ValueError: bad data or options, as the readers, ``pairs`` and the hold-out raise them.
    """
    protocol = (
        protocol
        if protocol.cohorts
        else replace(protocol, cohorts={test: partial(held_back_truth, test=test) for test in settings.truth})
    )
    outcome = Outcome(cohort=list(protocol.cohorts)[-1])
    keep = settings.finished.loop({name: variant.method for name, variant in protocol.variants.items()})
    for scene in scenes_of(scenes):
        outcome.add(keep(scene.name, partial(_run_scene, scene, protocol, pairs, settings, progress)))
    outcome.summary = summarise_rows(outcome.rows, list(protocol.variants), list(protocol.cohorts))
    return outcome


#: The same under the name that every experiment's function has.
run = run_protocol


def _run_scene(scene: Scene, protocol: Protocol, pairs: ScenePairs, settings: Settings, progress: Progress) -> Outcome:
    """Rows, example and points of one scene."""
    chosen = [Pair(*pair) for pair in pairs(scene)]  # first: raises for a data set without pairs of views
    for v in protocol.variants.values():
        if v.two_frames or v.fit is not None or (v.estimate is not None and not v.chooses):
            to_fixed_pairs(chosen)  # raises for pairs with candidate views, which the variant cannot select from
    collector = _SceneCollector(scene, protocol, settings)
    views, between = protocol.views(chosen), protocol.between(settings)
    data = PairDataset(scene.recording, chosen, settings.dtype, views, protocol.offers, between)
    # one pair per call where the number of candidate views or of frames between may differ
    n_between = {len(frames_between(i, j, between)) for i, j in chosen if isinstance(j, int)}
    same = protocol.offers is None and not any(pair.candidates for pair in chosen) and len(n_between) <= 1
    size = settings.batch if same else 1
    loader = load_pairs(data, batch=size, workers=settings.workers)
    for start, items in zip(range(0, len(chosen), size), progress(loader, scene.name, len(loader)), strict=True):
        on_device = move_to_device(tuple(items), settings.device)
        collector.add(Batch(scene, chosen[start : start + size], collector.cutoff, *on_device))
    points = {(scene.name, *k): pytree.collate(p) for k, p in collector.pooled.items()}
    return Outcome(collector.rows(), examples=collector.examples, n_pairs=len(chosen), points=points)


class _SceneCollector:
    """Accumulator of the answers on one scene → its rows."""

    def __init__(self, scene: Scene, protocol: Protocol, settings: Settings) -> None:
        self.scene, self.protocol, self.settings = scene, protocol, settings
        self.cutoff = settings.cutoff_of(scene)
        self.missing = {k: reason for k, v in protocol.variants.items() if (reason := v.needs(scene))}
        self.variants = {k: v for k, v in protocol.variants.items() if k not in self.missing}
        self.deciding_cohort = list(protocol.cohorts)[-1]
        nothing_hidden = protocol.hide is holdout.range_split and not _has_cutoff(self.cutoff)
        self.fewest_candidates = 0 if nothing_hidden else protocol.min_candidates
        self.examples: list[Example] = []
        self.pair_rows: list[Row] = []
        self.pooled: dict[tuple[str, str], list[errors.Points]] = {}
        self.separate_points: dict[tuple[str, str, str], list[errors.Points]] = {}
        self.census: list[dict[int, float]] = []
        self.dropped: dict[tuple[str, str], list[dict[str, int]]] = {}
        self.overlays: dict[str, Row] = {}
        self.n_few = 0

    def add(self, batch: Batch) -> None:
        """Run all variants on one batch of pairs."""
        reference = self.protocol.hide(batch.reference, self.cutoff)
        views = tuple(self.protocol.hide(view, self.cutoff) for view in batch.others)
        offered = candidate_views(batch.pairs[0], self.scene.recording, self.protocol.offers)
        candidates = {k: self.protocol.hide(v, self.cutoff) for k, v in zip(offered, batch.around, strict=True)}
        inputs: dict[Any, Frame | None] = {}
        shared, enough = SharedTracks(), [True] * len(batch.pairs)
        for k, (name, variant) in enumerate(self.variants.items()):
            if variant.offers is None and views:
                view_key: Any = variant.method.views
                frames = list(views[-variant.method.views :])
            else:
                view_key = tuple(candidate_views(batch.pairs[0], self.scene.recording, variant.offers))
                frames = [candidates[j] for j in view_key]
            if view_key not in inputs:  # one record for all variants with equal input, so that they share tracks
                inputs[view_key] = pytree.stack(frames) if len(frames) > 1 else next(iter(frames), None)
            others = inputs[view_key]
            method = variant.method if batch.others and variant.offers is None else with_view_selection(variant.method)
            trace: Trace = {}
            # some synthetic recordings distort tracks
            distort = getattr(self.scene.recording, "spoil_track", lambda track: track)
            seed = self.settings.seed if variant.seed is None else variant.seed
            track = distort(shared.shared_tracker(method.track))
            hint = self.scene.hint if variant.offers is not None else self._hint(batch, others)
            options: dict[str, Any] = {"seed": seed, "hint": hint, "track": track}
            if variant.fit is not None:
                options["fit"] = variant.fit(batch, method.n)
            options |= variant.call_options(batch)
            if others is None:  # no source view: all samples count, none is tracked
                options["track"] = _track_nothing
            with torch.no_grad():
                call = method if variant.estimate is None else partial(variant.estimate, method)
                estimate = call(reference, reference if others is None else others, trace=trace, **options)
            shared.charge(trace["ms"])
            truths = {cohort: of(batch, trace) for cohort, of in self.protocol.cohorts.items()}
            answer = Answer(batch, name, estimate, trace, truths)
            if k == 0:
                # fractions of the kinds of holes of the sensor, before any return is held back
                for hole in variant.method.sample_depth_at(batch.reference, answer.samples.uv).hole:
                    total = max(int((hole != Hole.NONE).sum()), 1)
                    self.census.append({code: float((hole == code).sum()) / total for code in names(Hole)})
                enough = [int(ok.sum()) >= self.fewest_candidates for ok in truths[self.deciding_cohort].ok]
                self.n_few += enough.count(False)
            reports = []
            for b, is_counted in enumerate(enough):
                pair_answer = answer.one(b)
                reports.append(self._selection_report(pair_answer))
                if is_counted:
                    self._add_pair(pair_answer, reports[-1])
            if not self.examples:
                self.examples.append(self._example(answer.one(0), reports[0], reference[:1], inputs[view_key]))

    def _example(self, answer: Answer, report: ViewReport | None, near: Frame, others: Frame | None) -> Example:
        variant, (reference, other) = self.protocol.variants[answer.variant], answer.batch.pairs[0]
        views = report.views if report is not None else (other,)
        options: dict[str, Any] | None = None
        if others is not None and variant.estimate is None and variant.fit is None:
            selected = others[:, :1] if others.image.dim() == 5 else others[:1]
            options = {
                "others": selected,
                "method": variant.method,
                "seed": self.settings.seed,
                "hint": self._hint(answer.batch, selected),
            }
        return Example(
            self.scene.name,
            answer.variant,
            near,
            *(answer.samples, answer.estimate, answer.truths[self.deciding_cohort]),
            pair=f"{reference} → {', '.join(map(str, views))}",
            cutoff=self.cutoff,
            call_options=options,
        )

    def rows(self) -> list[Row]:
        """One row per pair, variant and cohort, then one per variant and cohort for the scene (pair null)."""
        rows = list(self.pair_rows)
        for name in self.protocol.variants:
            for cohort in self.protocol.cohorts:
                key = (name, cohort)
                pair_rows = [r for r in self.pair_rows if (r["method"], r["truth"]) == key]
                row: Row = {"scene": self.scene.name, "pair": None, "method": name, "truth": cohort}
                row |= {"role": self.scene.role, "cutoff_m": self.cutoff}
                row |= {"n_pairs": len(pair_rows), "n_few": self.n_few}
                if not pair_rows:
                    row["note"] = self.missing.get(name) or ("too few candidates" if self.n_few else "too short")
                else:
                    hole_ratios = {
                        names(Hole)[k].lower(): sum(c[k] for c in self.census) / len(self.census)
                        for k in names(Hole)
                        if k
                    }
                    separate = {k[2]: p for k, p in self.separate_points.items() if k[:2] == key}
                    reads_score = self.protocol.reads_scores or self.variants[name].states_sigma
                    pooled, dropped = self.pooled[key], self.dropped[key]
                    row |= scene_row(pair_rows, pooled, dropped, separate, reads_score=reads_score)
                    row["hole_share"] = hole_ratios
                    row |= {"overlay": self.overlays[name]} if cohort == self.deciding_cohort else {}
                rows.append(row)
        return rows

    def _hint(self, batch: Batch, others: Frame | None) -> TrackHint:
        """The scene's hint, with the images between the reference view and its only source view."""
        if not batch.between or others is None or others.image.dim() != 4:
            return self.scene.hint
        return self.scene.hint.replace(between=tuple(image[: len(others.image)] for image in batch.between))

    def _selection_report(self, answer: Answer) -> ViewReport | None:
        """Report of the view selection of one answer; None for a variant without candidate views."""
        pair, offers = answer.batch.pairs[0], self.variants[answer.variant].offers
        if offered := candidate_views(pair, self.scene.recording, offers):
            return report_selection(pair.reference, offered, answer.trace)
        # unanswered: the variant needs candidate views and there are none
        return None if offers is None else ViewReport(pair.reference, (), 0)

    def _add_pair(self, answer: Answer, report: ViewReport | None) -> None:
        """Add the rows and points of one pair."""
        estimate, fit, kinds = answer.estimate, answer.trace["fit"], answer.batch.kinds(answer.samples.uv)
        if not self.variants[answer.variant].states_sigma:
            estimate = estimate.replace(sigma=torch.full_like(estimate.sigma, torch.nan))
        hole = ~answer.samples.usable
        gate_ratio = {gate.lower(): float((estimate.gate == code).float().mean()) for code, gate in names(Gate).items()}
        pair = [answer.batch.pairs[0].reference, answer.other[0]]
        identity: Row = {"scene": self.scene.name, "pair": pair, "method": answer.variant}
        columns: Row = {
            "pnp_ok": bool(fit.ok[0]),
            "n_inlier": int(fit.n_inlier[0]),
            "n_holes": int(hole.sum()),
            "n_recovered": int((estimate.keep & hole).sum()),
            "gate_share": gate_ratio,
            "ms": answer.trace["ms"],
        }
        extra = self.protocol.columns(answer) | ({} if report is None else report.row())
        self.overlays.setdefault(answer.variant, overlay_points(answer.samples, estimate, answer.batch.reference.hw))
        for cohort, truth in answer.truths.items():
            points = errors.points_from_estimate(estimate, truth)
            self.pooled.setdefault((answer.variant, cohort), []).append(points)
            self.dropped.setdefault((answer.variant, cohort), []).append(truth.dropped())
            counted = {"n_real_holes": truth.n_real_holes, **errors.measure_errors(points)}
            self.pair_rows.append({**identity, "truth": cohort, **columns, **counted, **extra})
            excluded, candidate = holdout.TruthCode.EXCLUDED, holdout.TruthCode.CANDIDATE
            for code, kind in answer.batch.odd.items() if kinds is not None else ():
                # the excluded samples on this kind of surface as candidates, and all others excluded
                reopened = torch.where(truth.code == excluded, candidate, truth.code)
                on_kind = truth.replace(
                    code=torch.where(torch.as_tensor(kinds == code), reopened, torch.full_like(reopened, excluded))
                )
                self.separate_points.setdefault((answer.variant, cohort, kind), []).append(
                    errors.points_from_estimate(estimate, on_kind)
                )


def _all_candidates(functions: Sequence[CandidateViews], recording: Recording, reference: int) -> list[int]:
    return sorted({k for offers in functions for k in offers(recording, reference)})


def _track_nothing(image_0: Tensor, image_1: Tensor, uv_0: Tensor, *, hint: TrackHint = NO_HINT) -> Tracks:
    """Tracker without a source view: no track is valid."""
    zero = torch.zeros_like(uv_0[..., 0])
    invalid = torch.zeros_like(zero, dtype=torch.bool)
    cov = torch.eye(2).to(uv_0).expand(*zero.shape, 2, 2)
    return Tracks(uv_0=uv_0, uv_1=uv_0, error=zero, photometric=zero, cov=cov, valid=invalid)


def _has_cutoff(cutoff: float | None) -> bool:
    return cutoff is not None and cutoff != math.inf


#: A pair of frames, or a frame alone as (i, i).
ScreenedItem = tuple[int, int]


def screen_scenes(
    scenes: Sequence[Any],
    items: Callable[[Any], Sequence[ScreenedItem]],
    evaluate: Callable[[Any, ScreenedItem], Mapping[str, Row]],
    variants: Sequence[str],
    *,
    truth: str,
    metrics: Sequence[MainMetric],
    whole: Callable[[Any, Sequence[Mapping[str, Row]]], Mapping[str, Row]] = lambda _scene, _results: {},
    finished: FinishedScenes,
    progress: Progress,
) -> Outcome:
    """Evaluate every item of every scene → rows of items and scenes, and their summary.

    Rows: one per item and variant, then one per scene and variant, in which counts are summed, ratios of a
    group (a dict) are means over the items that have them, and other numbers are medians. The summary
    is the median over scenes without a role; intervals come from resampling scenes.

    Args:
        scenes: each has a ``name`` and a ``role``, as a Scene, and a row per variant.
        items: scene → pairs or frames to evaluate.
        evaluate: scene, item → variant → numbers; a variant may be left out of an item.
        variants: their names, in order.
        truth: name of the truth, for the rows.
        metrics: main metrics of the experiment.
        whole: scene, results of ``evaluate`` on all its items → variant → numbers that replace those of the scene's
            row.
        finished: scenes of an interrupted run, of the settings.
        progress: wraps the loop over a scene's items: (items, text, number of items) → items.
    """

    def screen(scene: Any) -> Outcome:
        part = Outcome()
        chosen = list(items(scene))
        with torch.no_grad():
            results = [evaluate(scene, item) for item in progress(chosen, scene.name, len(chosen))]
            replacements = whole(scene, results)
        scene_name = {"scene": scene.name}
        for item, result in zip(chosen, results, strict=True):
            part.rows += [{**scene_name, "pair": list(item), "method": v, "truth": truth, **result[v]} for v in result]
        for variant in variants:
            variant_results = [result[variant] for result in results if variant in result]
            row = {**scene_name, "pair": None, "method": variant, "truth": truth, "role": scene.role}
            note = {} if variant_results else {"note": "nothing to estimate"}
            part.rows.append(
                row
                | {"n_pairs": len(variant_results)}
                | note
                | _join_rows(variant_results)
                | replacements.get(variant, {})
            )
        part.n_pairs = len(chosen)
        return part

    outcome = finished.run(scenes, screen, metrics=metrics)
    outcome.summary = summarise_rows(outcome.rows, variants, [truth])
    return outcome


def paired_metric(outcome: Outcome, truth: str, first: str, second: str, metric: str) -> list[tuple[float, float]]:
    """[(first variant's metric, second variant's metric)] of scenes without a role on which both have it."""
    first_rows, second_rows = outcome.scenes(first, truth), outcome.scenes(second, truth)
    both = [
        (row.get(metric), second_rows[scene].get(metric)) for scene, row in first_rows.items() if scene in second_rows
    ]
    return [(a, b) for a, b in both if a is not None and b is not None]


def _join_rows(rows: Sequence[Row]) -> Row:
    joined: Row = {}
    for key in dict.fromkeys(k for row in rows for k in row):
        values = [row[key] for row in rows if row.get(key) is not None]
        if values and isinstance(values[0], Mapping):
            joined[key] = {k: mean_or_none([v[k] for v in values if v[k] is not None]) for k in values[0]}
        else:
            joined[key] = (sum(values) if values else 0) if key.startswith("n_") else median_or_none(values)
    return joined
