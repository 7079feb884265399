"""The one loop behind every experiment: pairs of a scene in, rows of a result out.

A *variant* is a method as an experiment runs it. A *cohort* is what its answers are held against; it is counted for
every variant alike, also where the pose fails. A *protocol* joins both and says what the methods may see. An
experiment is a protocol, a question about the rows it gives, and a verdict.
"""

from __future__ import annotations

import math
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
from dhtorch.experiments.loading import CandidateViews, PairDataset, candidate_views, load_pairs, move_to_device
from dhtorch.experiments.outcome import Example, Outcome
from dhtorch.experiments.rows import Row, overlay_points, scene_row, summarise_rows
from dhtorch.experiments.shared_tracks import SharedTracks
from dhtorch.geometry.patches import extract_patches, round_half_up, sample_nearest
from dhtorch.metrics import errors, holdout
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.spec import Trace
from dhtorch.pipeline.view_report import ViewReport, report_selection, with_view_selection
from dhtorch.records import NO_HINT, Estimate, Frame, PoseFit, Samples, TrackHint, Tracks

ScenePairs = Callable[[Scene], Sequence[Pair] | Sequence[tuple[int, int]]]
Progress = Callable[[Iterable[Any], str, int], Iterable[Any]]

#: A pair with fewer candidates says nothing: it is dropped and counted.
MIN_CANDIDATES = 20

#: A track looks at this many pixels across (LK window and a margin): what lies within may pull at it.
_TRACK_REACH_PX = 25


def no_progress(items: Iterable[Any], _text: str, _total: int) -> Iterable[Any]:
    """No progress bar."""
    return items


@dataclass(frozen=True)
class Settings:
    """What all pairs of a job share."""

    cutoff: float | None = None  # m; None = the scene's own near limit
    cutoff_factor: float = 1.0  # on either
    truth: tuple[str, ...] = ("full",)  # truth tests to report: raw | 5x5 | full
    seed: int = 0
    device: str = "cpu"
    dtype: torch.dtype = torch.float32
    batch: int = 1
    workers: int = 0

    def cutoff_of(self, scene: Scene) -> float | None:
        """The cutoff on one scene, m; None where nothing is known to be near."""
        cutoff = scene.near if self.cutoff is None else self.cutoff
        return None if cutoff is None else cutoff * self.cutoff_factor


@dataclass(frozen=True)
class Batch:
    """Some pairs of one scene, loaded: all that a protocol may look at."""

    scene: Scene
    pairs: Sequence[Pair]
    cutoff: float | None  # m
    reference: Frame
    others: tuple[Frame, ...]  # further views, the pair's own last; none where frames are offered instead
    exact: Frame  # the reference view with the depth it is held against
    surface: Tensor  # (B, H, W) kind of surface, (B, 1, 1) where the recording knows none
    disagreement: Tensor  # (B,) median relative difference of the independent truth from the sensor; NaN = not known
    around: tuple[Frame, ...] = ()  # offered to one variant or another, in the order of the recording

    @property
    def odd(self) -> dict[int, str]:
        """Kinds of surface that are counted apart: code → name."""
        room = self.scene.recording
        if not isinstance(room, TruthRecording):
            return {}
        return {k: name for k, name in room.surfaces.items() if name in room.odd_surfaces}

    def kinds(self, uv: Tensor) -> Tensor | None:
        """Kind of surface (B, N) at samples; one whose track window touches an odd surface counts with that."""
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
    """A method as an experiment runs it."""

    method: Method
    ask: Callable[..., Estimate] | None = (
        None  # in the place of the method's line: (method, reference view, others, *, …)
    )
    fit: Callable[[Batch, int], PoseFit] | None = None  # a pose from elsewhere: (batch, number of samples) → fit
    seed: int | None = None  # None = the job's
    given: Callable[[Batch], Mapping[str, Any]] = lambda _batch: {}  # further options: an oracle may see it all
    offers: CandidateViews | None = None  # other views in the place of the pair's own; silent where it is offered none
    needs: Callable[[Scene], str | None] = lambda _scene: None  # scene → why it cannot run there, None = it can
    chooses: bool = False  # ``ask`` chooses among several views, as the method does
    two_frames: bool = False  # cannot choose: what it is judged by would take part in the choice


@dataclass(frozen=True)
class Answer:
    """What one variant said about the pairs of a batch, and what it is held against."""

    batch: Batch
    variant: str
    estimate: Estimate
    trace: Trace
    truths: Mapping[str, holdout.Truth]

    @property
    def samples(self) -> Samples:
        """The samples as the method saw them."""
        samples: Samples = self.trace["samples"]
        return samples

    @property
    def other(self) -> tuple[int, Frame]:
        """The view (B = 1) that tracks and pose of the trace belong to: its position in the recording, and the view."""
        pair = self.batch.pairs[0]
        if isinstance(pair.other, int):
            return pair.other, self.batch.others[-1]
        k = int(self.trace["choice"].index[-1, 0]) if "choice" in self.trace else 0
        return pair.candidates[k], self.batch.around[k]

    def one(self, b: int) -> Answer:
        """Pair ``b`` alone; milliseconds are the batch's share."""
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
                exact=self.batch.exact[cut],
                surface=self.batch.surface[cut],
                disagreement=self.batch.disagreement[cut],
            ),
            estimate=self.estimate[cut],
            trace={**records, "ms": {k: v / size for k, v in self.trace["ms"].items()}},
            truths={k: v[cut] for k, v in self.truths.items()},
        )


def held_back_truth(batch: Batch, trace: Trace, *, test: str = "full") -> holdout.Truth:
    """The cohort of the range split: samples whose return was held back and passes the truth test."""
    samples: Samples = trace["samples"]
    kinds = batch.kinds(samples.uv)
    odd = None if kinds is None else torch.isin(kinds, torch.tensor([*batch.odd], dtype=kinds.dtype).to(kinds.device))
    found = holdout.sample_truth(batch.exact, samples.uv, truth=test)
    return holdout.select_candidates(samples, found, batch.cutoff if _has_cutoff(batch.cutoff) else None, excluded=odd)


def spread_pairs(pairs: ScenePairs, references: int | None, scene: Scene) -> list[tuple[int, int]]:
    """Some of the scene's pairs of two frames, evenly spread; None = all."""
    found = to_fixed_pairs(pairs(scene))
    if references is None or len(found) <= references:
        return found
    return [found[(2 * k + 1) * len(found) // (2 * references)] for k in range(references)]


def no_columns(_answer: Answer) -> Row:
    """Nothing beyond the usual columns."""
    return {}


@dataclass(frozen=True)
class Protocol:
    """Which variants run, what they may see, what they are held against, and what else is noted of each pair."""

    variants: Mapping[str, Variant]
    cohorts: Mapping[str, Cohort] = field(default_factory=lambda: {"full": held_back_truth})  # the last one decides
    hide: Callable[[Frame, float | None], Frame] = holdout.range_split  # (view, cutoff) → what a method may see
    columns: Callable[[Answer], Row] = no_columns  # of one pair; numbers are joined over the pairs of a scene by median
    min_candidates: int = MIN_CANDIDATES

    @property
    def offers(self) -> CandidateViews | None:
        """All frames that are offered to any variant, in the order of the recording; None where none asks for them."""
        asked = list(dict.fromkeys(v.offers for v in self.variants.values() if v.offers is not None))
        return partial(_all_candidates, asked) if asked else None

    def views(self, pairs: Sequence[Pair]) -> int:
        """Views that are loaded of every pair: as many as some variant asks for, and as a short gap holds."""
        wanted = max((v.method.views for v in self.variants.values() if v.offers is None), default=1)
        return min([wanted, *(max(1, j - i) for i, j in pairs if isinstance(j, int))])

    def batch(self, settings: Settings, pairs: Sequence[Pair]) -> int:
        """Pairs per call: one where reference views are offered differently many views."""
        return settings.batch if self.offers is None and not any(pair.candidates for pair in pairs) else 1

    def allows(self, pairs: Sequence[Pair]) -> None:
        """Refuse frames to choose among where a variant cannot choose.

        Raises:
            ValueError: such a variant and such pairs.
        """
        for v in self.variants.values():
            if v.two_frames or v.fit is not None or (v.ask is not None and not v.chooses):
                to_fixed_pairs(pairs)


def run(
    scenes: Sequence[SceneLike],
    protocol: Protocol,
    pairs: ScenePairs,
    settings: Settings,
    *,
    progress: Progress = no_progress,
) -> Outcome:
    """Run every variant on every pair of every scene.

    Truth is the held-back return of the reference view, or, for a recording that knows it, the exact depth
    (``truth(i)``); surfaces such as mirrors are then counted apart. Points are pooled inside a scene; the summary is
    the median over scenes without a role. A scene for which ``pairs`` gives none keeps a row that says "too short".

    Args:
        scenes: see :class:`dhtorch.data.scene.Scene`; a recording is a scene without notes.
        protocol: variants, cohorts and what is hidden.
        pairs: scene → list of :class:`dhtorch.data.pairs.Pair`, or plain (reference view, other).
        settings: cutoff, seed, device, batch, workers.
        progress: wraps the loop over a scene's batches: (items, text, number of items) → items.

    Raises:
        ValueError: bad data or options, as the readers, ``pairs`` and the hold-out raise them.
    """
    outcome = Outcome()
    for scene in scenes_of(scenes):
        chosen = [Pair(*pair) for pair in pairs(scene)]  # first: a data set without pairs of views says so
        protocol.allows(chosen)
        collected = _SceneCollector(scene, protocol, settings)
        data = PairDataset(scene.recording, chosen, settings.dtype, protocol.views(chosen), protocol.offers)
        size = protocol.batch(settings, chosen)
        loader = load_pairs(data, batch=size, workers=settings.workers)
        for at, items in zip(range(0, len(chosen), size), progress(loader, scene.name, len(loader)), strict=True):
            shown = move_to_device(tuple(items), settings.device)
            collected.add(Batch(scene, chosen[at : at + size], collected.cutoff, *shown))
        outcome.rows += collected.rows()
        outcome.examples += collected.examples
        outcome.n_pairs += len(chosen)
        outcome.points |= {(scene.name, *k): pytree.collate(p) for k, p in collected.pooled.items()}
    outcome.summary = summarise_rows(outcome.rows, list(protocol.variants), list(protocol.cohorts))
    return outcome


class _SceneCollector:
    """Collects the answers on one scene and turns them into rows."""

    def __init__(self, scene: Scene, protocol: Protocol, settings: Settings) -> None:
        self.scene, self.protocol, self.settings = scene, protocol, settings
        self.cutoff = settings.cutoff_of(scene)
        self.missing = {k: reason for k, v in protocol.variants.items() if (reason := v.needs(scene))}
        self.variants = {k: v for k, v in protocol.variants.items() if k not in self.missing}
        self.last = list(protocol.cohorts)[-1]
        blind = protocol.hide is holdout.range_split and not _has_cutoff(self.cutoff)
        self.least = 0 if blind else protocol.min_candidates
        self.examples: list[Example] = []
        self.pair_rows: list[Row] = []
        self.pooled: dict[tuple[str, str], list[errors.Points]] = {}
        self.apart: dict[tuple[str, str, str], list[errors.Points]] = {}
        self.census: list[dict[int, float]] = []
        self.dropped: dict[tuple[str, str], list[dict[str, int]]] = {}
        self.overlays: dict[str, Row] = {}
        self.n_few = 0

    def add(self, batch: Batch) -> None:
        """Run all variants on one batch of pairs."""
        near = self.protocol.hide(batch.reference, self.cutoff)
        views = tuple(self.protocol.hide(view, self.cutoff) for view in batch.others)
        offered = self._offered(batch)
        seen: dict[Any, Frame | None] = {}
        shared, enough = SharedTracks(), [True] * len(batch.pairs)
        for k, (name, variant) in enumerate(self.variants.items()):
            which, some = self._view_of(variant, batch, views, offered)
            if which not in seen:  # one record for all who see the same, so that they share tracks
                seen[which] = pytree.stack(some) if len(some) > 1 else next(iter(some), None)
            estimate, trace = self._ask(variant, batch, near, seen[which], shared)
            truths = {cohort: of(batch, trace) for cohort, of in self.protocol.cohorts.items()}
            answer = Answer(batch, name, estimate, trace, truths)
            if k == 0:
                self._count_holes(variant.method, batch.reference, answer.samples.uv)
                enough = [int(ok.sum()) >= self.least for ok in truths[self.last].ok]
                self.n_few += enough.count(False)
            choices = []
            for b, counts in enumerate(enough):
                one = answer.one(b)
                choices.append(self._picked(one))
                if counts:
                    self._note(one, choices[-1])
            if not self.examples:
                self.examples.append(self._example(answer.one(0), choices[0], near[:1], seen[which]))

    def _example(self, first: Answer, choice: ViewReport | None, near: Frame, seen: Frame | None) -> Example:
        variant, (reference, other) = self.protocol.variants[first.variant], first.batch.pairs[0]
        views = choice.views if choice is not None else (other,)
        asked: dict[str, Any] | None = None
        if seen is not None and variant.ask is None and variant.fit is None:
            others = seen[:, :1] if seen.image.dim() == 5 else seen[:1]
            asked = {"others": others, "method": variant.method, "seed": self.settings.seed, "hint": self.scene.hint}
        return Example(
            self.scene.name,
            first.variant,
            near,
            *(first.samples, first.estimate, first.truths[self.last]),
            pair=f"{reference} → {', '.join(map(str, views))}",
            cutoff=self.cutoff,
            asked=asked,
        )

    def rows(self) -> list[Row]:
        """One row per pair, variant and cohort, then one per variant and cohort for the scene (pair null)."""
        rows = list(self.pair_rows)
        for name in self.protocol.variants:
            for cohort in self.protocol.cohorts:
                key = (name, cohort)
                mine = [r for r in self.pair_rows if (r["method"], r["truth"]) == key]
                row: Row = {"scene": self.scene.name, "pair": None, "method": name, "truth": cohort}
                row |= {"role": self.scene.role, "cutoff_m": self.cutoff}
                row |= {"n_pairs": len(mine), "n_few": self.n_few}
                if not mine:
                    row["note"] = self.missing.get(name) or ("too few candidates" if self.n_few else "too short")
                else:
                    shares = {
                        names(Hole)[k].lower(): sum(c[k] for c in self.census) / len(self.census)
                        for k in names(Hole)
                        if k
                    }
                    apart = {k[2]: p for k, p in self.apart.items() if k[:2] == key}
                    row |= scene_row(mine, self.pooled[key], self.dropped[key], apart) | {"hole_share": shares}
                    row |= {"overlay": self.overlays[name]} if cohort == self.last else {}
                rows.append(row)
        return rows

    def _offered(self, batch: Batch) -> dict[int, Frame]:
        """Position → frame, as variants see it, of all that are offered."""
        positions = candidate_views(batch.pairs[0], self.scene.recording, self.protocol.offers)
        return {k: self.protocol.hide(view, self.cutoff) for k, view in zip(positions, batch.around, strict=True)}

    def _view_of(
        self, variant: Variant, batch: Batch, views: Sequence[Frame], offered: Mapping[int, Frame]
    ) -> tuple[Any, list[Frame]]:
        """Other views of one variant, and what they are told apart by from those of others."""
        if variant.offers is None and views:
            return variant.method.views, list(views[-variant.method.views :])
        positions = tuple(candidate_views(batch.pairs[0], self.scene.recording, variant.offers))
        return positions, [offered[k] for k in positions]

    def _ask(
        self, variant: Variant, batch: Batch, near: Frame, seen: Frame | None, shared: SharedTracks
    ) -> tuple[Estimate, Trace]:
        method = variant.method if batch.others and variant.offers is None else with_view_selection(variant.method)
        trace: Trace = {}
        spoil = getattr(
            self.scene.recording, "spoil_track", lambda track: track
        )  # some recordings lead trackers astray
        seed = self.settings.seed if variant.seed is None else variant.seed
        told: dict[str, Any] = {"seed": seed, "hint": self.scene.hint, "track": spoil(shared.seat(method.track))}
        if variant.fit is not None:
            told["fit"] = variant.fit(batch, method.n)
        told |= variant.given(batch)
        if seen is None:  # every sample is counted, none is found again
            told["track"] = _track_nothing
        with torch.no_grad():
            ask = method if variant.ask is None else partial(variant.ask, method)
            estimate = ask(near, near if seen is None else seen, trace=trace, **told)
        shared.charge(trace["ms"])
        return estimate, trace

    def _picked(self, answer: Answer) -> ViewReport | None:
        """Which frames a variant chose that was offered some."""
        pair, offers = answer.batch.pairs[0], self.variants[answer.variant].offers
        offered = candidate_views(pair, self.scene.recording, offers)
        if not offered:  # silent, where frames were asked for and there are none
            return None if offers is None else ViewReport(pair.reference, (), 0)
        return report_selection(pair.reference, offered, answer.trace)

    def _count_holes(self, method: Method, reference: Frame, uv: Tensor) -> None:
        """The sensor's own holes, before anything is held back."""
        for hole in method.sample_depth_at(reference, uv).hole:
            total = max(int((hole != Hole.NONE).sum()), 1)
            self.census.append({k: float((hole == k).sum()) / total for k in names(Hole)})

    def _note(self, answer: Answer, choice: ViewReport | None) -> None:
        """Rows and points of one pair."""
        estimate, fit, kinds = answer.estimate, answer.trace["fit"], answer.batch.kinds(answer.samples.uv)
        hole = ~answer.samples.usable
        share = {gate.lower(): float((estimate.gate == code).float().mean()) for code, gate in names(Gate).items()}
        pair = [answer.batch.pairs[0].reference, answer.other[0]]
        common: Row = {"scene": self.scene.name, "pair": pair, "method": answer.variant}
        found: Row = {"pnp_ok": bool(fit.ok[0]), "n_inlier": int(fit.n_inlier[0]), "n_holes": int(hole.sum())}
        found |= {"n_recovered": int((estimate.keep & hole).sum()), "gate_share": share, "ms": answer.trace["ms"]}
        more = self.protocol.columns(answer) | ({} if choice is None else choice.row())
        self.overlays.setdefault(answer.variant, overlay_points(answer.samples, estimate, answer.batch.reference.hw))
        for cohort, truth in answer.truths.items():
            points = errors.points_from_estimate(estimate, truth)
            self.pooled.setdefault((answer.variant, cohort), []).append(points)
            self.dropped.setdefault((answer.variant, cohort), []).append(truth.dropped())
            self.pair_rows.append({**common, "truth": cohort, **found, **errors.measure_errors(points), **more})
            for code, kind in answer.batch.odd.items() if kinds is not None else ():
                there = truth.replace(code=_reopen_kind(truth, kinds, code))
                self.apart.setdefault((answer.variant, cohort, kind), []).append(
                    errors.points_from_estimate(estimate, there)
                )


def _all_candidates(asked: Sequence[CandidateViews], recording: Recording, reference: int) -> list[int]:
    return sorted({k for offers in asked for k in offers(recording, reference)})


def _track_nothing(image_0: Tensor, image_1: Tensor, uv_0: Tensor, *, hint: TrackHint = NO_HINT) -> Tracks:
    """No sample is found again: there is no other view."""
    zero = torch.zeros_like(uv_0[..., 0])
    lost = torch.zeros_like(zero, dtype=torch.bool)
    cov = torch.eye(2).to(uv_0).expand(*zero.shape, 2, 2)
    return Tracks(uv_0=uv_0, uv_1=uv_0, error=zero, photometric=zero, cov=cov, valid=lost)


def _has_cutoff(cutoff: float | None) -> bool:
    return cutoff is not None and cutoff != math.inf


def _reopen_kind(truth: holdout.Truth, kinds: Tensor | None, kind: int) -> Tensor:
    """Codes in which the samples on one kind of surface, turned away as EXCLUDED, count, and no others."""
    if kinds is None:
        return truth.code
    code = torch.where(truth.code == holdout.TruthCode.EXCLUDED, holdout.TruthCode.CANDIDATE, truth.code)
    return torch.where(kinds == kind, code, torch.full_like(code, holdout.TruthCode.EXCLUDED))
