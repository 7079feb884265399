"""The main job: methods on every pair of every scene, held against the returns that were kept back.

It asks no question (its question, expectation and verdict are null); the experiments beside it do, and call it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from dhtorch import tree
from dhtorch.codes import Gate, Hole, names
from dhtorch.data.files import set_opencv_threads
from dhtorch.evaluate import calibrate, errors, holdout, risk
from dhtorch.geometry.lookup import nearest, patches, round_half_up
from dhtorch.pair import Trace
from dhtorch.records import Estimate, Frame, Samples

Method = partial[Estimate]  # of dhtorch.pair.extend, with its seats and options
Row = dict[str, Any]

#: A pair with fewer candidates says nothing: it is dropped and counted.
MIN_CANDIDATES = 20

#: Search radius in a sparse depth map, px: the truth test reads sparse returns in 7×7 windows, so do the samples.
SPARSE_SEARCH_PX = 3


#: A track looks at this many pixels across (LK window and a margin): what lies within may pull at it.
REACH_PX = 25


@dataclass(frozen=True)
class Settings:
    """What all pairs of a job share."""

    cutoff: float | None = None  # m; None = the scene's own near limit
    truth: tuple[str, ...] = ("full",)  # truth tests to report: raw | 5x5 | full
    seed: int = 0
    device: str = "cpu"
    dtype: torch.dtype = torch.float32
    batch: int = 1
    workers: int = 0


@dataclass(frozen=True)
class Example:
    """The first pair of a scene, kept for figures and the point cloud (batch size 1)."""

    scene: str
    method: str
    frame: Frame  # as the method saw it
    samples: Samples
    estimate: Estimate
    truth: holdout.Truth

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


class PairData(Dataset[tuple[Frame, Frame, Frame, Tensor]]):
    """Pairs of one recording for a data loader: anchor, other view, anchor with its truth as depth, surface classes."""

    def __init__(self, recording: Any, pairs: Sequence[tuple[int, int]], dtype: torch.dtype) -> None:
        self.recording, self.pairs, self.dtype = recording, pairs, dtype

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> tuple[Frame, Frame, Frame, Tensor]:
        i, j = self.pairs[index]
        anchor, other = (self.recording[k].to(self.dtype) for k in (i, j))
        if not hasattr(self.recording, "truth"):
            return anchor, other, anchor, torch.zeros(1, 1, 1)
        exact = self.recording.truth(i)
        return (
            anchor,
            other,
            anchor.replace(depth=exact["depth"].to(self.dtype), depth_camera=None),
            exact["surface"].float(),
        )


def run(
    recordings: Sequence[Any],
    methods: Mapping[str, Method],
    pairs: Callable[[Any], Sequence[tuple[int, int]]],
    settings: Settings,
    *,
    progress: Callable[[Iterable[Any], str, int], Iterable[Any]] = lambda items, _text, _total: items,
) -> Outcome:
    """Run every method on every pair of every recording.

    Truth is the held-back return of the anchor, or, for a recording that knows it, the exact depth (``truth(i)``);
    surfaces such as mirrors are then counted apart. Candidates are counted before any method runs, also where the
    pose fails. Points are pooled inside a scene; the summary is the median over scenes without a role.

    Args:
        recordings: scenes, see ``dhtorch.data``.
        methods: name → method.
        pairs: recording → list of (anchor, other).
        settings: cutoff, truth tests, seed, device, batch, workers.
        progress: wraps the loop over a scene's batches: (items, text, number of items) → items.

    Raises:
        ValueError: bad data or options, as the readers, ``pairs`` and the hold-out raise them.
    """
    outcome = Outcome()
    for recording in recordings:
        scene = _Scene(recording, {name: adapt(m, recording) for name, m in methods.items()}, settings)
        chosen = pairs(recording)
        loader = DataLoader(
            PairData(recording, chosen, settings.dtype),
            batch_size=settings.batch,
            num_workers=settings.workers,
            collate_fn=_collate,
            worker_init_fn=_one_thread,
            # A fork would copy the locks of whatever threads torch and OpenCV run here, and may never return.
            multiprocessing_context="spawn" if settings.workers else None,
        )
        at = 0
        for batch in progress(loader, recording.name, len(loader)):
            size = batch[0].image.shape[0]
            scene.add(chosen[at : at + size], *batch)
            at += size
        outcome.rows += scene.rows()
        outcome.examples += scene.examples
        outcome.n_pairs += len(chosen)
    outcome.summary = summarise(outcome.rows, list(methods), settings.truth)
    return outcome


def adapt(method: Method, recording: Any) -> Method:
    """The method with what this scene's data asks for: pyramid levels, a search in sparse depth."""
    seats = dict(method.keywords)
    if recording.levels is not None:
        seats["track"] = partial(seats["track"], levels=recording.levels)
    if recording.sparse:
        seats["backproject"] = partial(seats["backproject"], search_px=SPARSE_SEARCH_PX)
    return partial(method.func, **seats)


def summarise(rows: Sequence[Row], methods: Sequence[str], truths: Sequence[str]) -> dict[str, Any]:
    """Scene rows → ``<method>.<metric>`` and, for further truth tests, ``<method>.<truth>.<metric>``.

    With one method and one test the prefix is left out. Scenes with a role stay out of every number.
    """
    summary: dict[str, Any] = {}
    for method in methods:
        for truth in truths:
            scenes = [
                {k: v for k, v in row.items() if k not in ("pair", "role")}
                for row in rows
                if row["pair"] is None and row["method"] == method and row["truth"] == truth and row["role"] is None
            ]
            parts = [method] * (len(methods) > 1 or len(truths) > 1) + [truth] * (truth != truths[-1])
            prefix = "".join(f"{p}." for p in parts)
            summary |= {prefix + name: value for name, value in errors.summarise(scenes).items()}
    return summary


class _Scene:
    """Collects pairs of one recording and turns them into rows."""

    def __init__(self, recording: Any, methods: Mapping[str, Method], settings: Settings) -> None:
        self.recording, self.methods, self.settings = recording, methods, settings
        self.cutoff = recording.near if settings.cutoff is None else settings.cutoff
        self.examples: list[Example] = []
        self.pair_rows: list[Row] = []
        self.pooled: dict[tuple[str, str], list[errors.Points]] = {}
        self.apart: dict[tuple[str, str, str], list[errors.Points]] = {}
        self.census: list[dict[int, float]] = []
        self.dropped: dict[str, list[dict[str, int]]] = {t: [] for t in settings.truth}
        self.n_few = 0

    def add(self, pairs: Sequence[tuple[int, int]], anchor: Frame, other: Frame, exact: Frame, surface: Tensor) -> None:
        """Run all methods on one batch of pairs."""
        device = self.settings.device
        anchor, other, exact, surface = anchor.to(device), other.to(device), exact.to(device), surface.to(device)
        near, seen = holdout.range_split(anchor, self.cutoff), holdout.range_split(other, self.cutoff)
        for name, method in self.methods.items():
            trace: Trace = {}
            with torch.no_grad():
                estimate = method(near, seen, seed=self.settings.seed, trace=trace)
            samples: Samples = trace["samples"]
            kinds = self._kinds(surface, samples.uv) if surface.shape[-1] > 1 else None
            if name == next(iter(self.methods)):
                self._count_holes(method, anchor, samples.uv)
                truths = {test: self._truth(test, exact, samples, kinds) for test in self.settings.truth}
                enough = [
                    int(t.ok.sum()) >= MIN_CANDIDATES or not self._has_truth for t in self._each(truths, len(pairs))
                ]
                self.n_few += enough.count(False)
                for test, truth in truths.items():
                    self.dropped[test] += [truth[b : b + 1].dropped() for b in range(len(pairs)) if enough[b]]
            for b, pair in enumerate(pairs):
                if enough[b]:
                    self._add_pair(name, pair, b, len(pairs), estimate, trace, truths, kinds)
            if not self.examples:
                last = truths[self.settings.truth[-1]]
                self.examples.append(Example(self.recording.name, name, near[:1], samples[:1], estimate[:1], last[:1]))

    def rows(self) -> list[Row]:
        """One row per pair, method and truth test, then one per method and test for the scene (pair null)."""
        rows = list(self.pair_rows)
        for name in self.methods:
            for test in self.settings.truth:
                mine = [r for r in self.pair_rows if r["method"] == name and r["truth"] == test]
                points = self.pooled.get((name, test), [])
                row = {
                    "scene": self.recording.name,
                    "pair": None,
                    "method": name,
                    "truth": test,
                    "role": self.recording.role,
                }
                row |= {"cutoff_m": self.cutoff, "n_pairs": len(mine), "n_few": self.n_few}
                if points:
                    pool = tree.collate(points)
                    row |= errors.measure(pool) | risk.measure(pool) | calibrate.measure([pool])
                    row |= {"pnp_success": _mean([float(r["pnp_ok"]) for r in mine])}
                    row |= {key: _mean([r[key] for r in mine]) for key in ("n_holes", "n_recovered")}
                    row["n_dropped"] = _add(self.dropped[test])
                    row["hole_share"] = {
                        names(Hole)[k].lower(): _mean([c[k] for c in self.census]) for k in names(Hole) if k
                    }
                    row["gate_share"] = {k: _mean([r["gate_share"][k] for r in mine]) for k in mine[0]["gate_share"]}
                    row["ms"] = {k: _median([r["ms"][k] for r in mine]) for k in mine[0]["ms"]}
                    row["apart"] = {
                        kind: errors.measure(tree.collate(p))
                        for (m, t, kind), p in self.apart.items()
                        if (m, t) == (name, test)
                    }
                rows.append(row)
        return rows

    @property
    def _has_truth(self) -> bool:
        return self.cutoff is not None and self.cutoff != float("inf")

    def _truth(self, test: str, exact: Frame, samples: Samples, kinds: Tensor | None) -> holdout.Truth:
        found = holdout.truth_at(exact, samples.uv, truth=test, sparse=self.recording.sparse)
        odd = (
            None
            if kinds is None
            else torch.isin(kinds, torch.tensor(self._odd, dtype=kinds.dtype, device=kinds.device))
        )
        return holdout.candidates(samples, found, self.cutoff if self._has_truth else None, excluded=odd)

    def _kinds(self, surface: Tensor, uv: Tensor) -> Tensor:
        """Kind of surface at each sample; one whose track window touches an odd surface counts with that."""
        kind = nearest(surface, uv)[0]
        corner = (round_half_up(uv) - REACH_PX // 2).long()
        around = patches(surface[:, None], corner, min(REACH_PX, *surface.shape[-2:]))[:, :, 0].flatten(-2)
        for code in self._odd:
            kind = torch.where((around == code).any(-1), torch.full_like(kind, code), kind)
        return kind

    @property
    def _odd(self) -> list[int]:
        return [k for k, name in self.recording.surfaces.items() if name in self.recording.odd_surfaces]

    def _each(self, truths: Mapping[str, holdout.Truth], n: int) -> list[holdout.Truth]:
        strictest = truths[self.settings.truth[-1]]
        return [strictest[b : b + 1] for b in range(n)]

    def _count_holes(self, method: Method, anchor: Frame, uv: Tensor) -> None:
        """The sensor's own holes, before anything is held back."""
        samples = method.keywords["classify"](anchor, method.keywords["backproject"](anchor, uv))
        for hole in samples.hole:
            total = max(int((hole != Hole.NONE).sum()), 1)
            self.census.append({k: float((hole == k).sum()) / total for k in names(Hole)})

    def _add_pair(
        self,
        name: str,
        pair: tuple[int, int],
        b: int,
        size: int,
        estimate: Estimate,
        trace: Trace,
        truths: Mapping[str, holdout.Truth],
        kinds: Tensor | None,
    ) -> None:
        one, samples = estimate[b : b + 1], trace["samples"][b : b + 1]
        hole = samples.xyz.isnan().any(-1)
        share = {gate.lower(): float((one.gate == code).float().mean()) for code, gate in names(Gate).items()}
        for test, truth in truths.items():
            points = errors.select(one, truth[b : b + 1])
            self.pooled.setdefault((name, test), []).append(points)
            row = {"scene": self.recording.name, "pair": list(pair), "method": name, "truth": test}
            row |= {"pnp_ok": bool(trace["fit"].ok[b]), "n_inlier": int(trace["fit"].n_inlier[b])}
            row |= errors.measure(points)
            row |= {"n_holes": int(hole.sum()), "n_recovered": int((one.keep & hole).sum())}
            row |= {"gate_share": share, "ms": {k: v / size for k, v in trace["ms"].items()}}
            self.pair_rows.append(row)
            if kinds is None:
                continue
            for code in self._odd:
                kind, there = self.recording.surfaces[code], truth[b : b + 1]
                there = there.replace(code=torch.where(kinds[b : b + 1] == code, _reopen(there), holdout.Rule.EXCLUDED))
                self.apart.setdefault((name, test, kind), []).append(errors.select(one, there))


def _reopen(truth: holdout.Truth) -> Tensor:
    """Codes in which a sample turned away as EXCLUDED counts."""
    return torch.where(truth.code == holdout.Rule.EXCLUDED, holdout.Rule.CANDIDATE, truth.code)


def _collate(items: list[tuple[Frame, Frame, Frame, Tensor]]) -> tuple[Frame, Frame, Frame, Tensor]:
    anchor, other, exact, surface = zip(*items, strict=True)
    return tree.collate(anchor), tree.collate(other), tree.collate(exact), torch.cat(surface)


def _one_thread(_worker: int) -> None:
    torch.set_num_threads(1)
    set_opencv_threads(1)


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _median(values: Sequence[float]) -> float | None:
    return float(torch.tensor(values, dtype=torch.float64).median()) if values else None


def _add(counts: Sequence[Mapping[str, int]]) -> dict[str, int]:
    return {k: sum(c[k] for c in counts) for k in (counts[0] if counts else {})}
