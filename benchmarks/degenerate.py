"""Ten thousand degenerate and adversarial pairs: nothing raises, nothing that is promised is missing.

    nice python benchmarks/degenerate.py --json benchmarks/results/degenerate.json

Kinds of trouble (``degenerate_pairs``) take turns in batches of 64, 96×128 pixels, 128 samples. For every method and
kind: exceptions, pairs that break a promise of the records, share of pairs with a pose, share of the samples answered,
and how far those answers are from what the reference view's pixels really show.
"""

import argparse
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import harness
import torch
from degenerate_pairs import KINDS, Pair, make
from torch import Tensor

from dhtorch import pytree
from dhtorch.codes import Gate, PoseCode, names
from dhtorch.geometry.patches import sample_nearest
from dhtorch.pipeline.pair import merge
from dhtorch.pipeline.presets import METHODS
from dhtorch.pipeline.spec import Trace
from dhtorch.records import Estimate, Frame, PoseFit
from dhtorch.runtime import storage

BATCH = 64


@dataclass
class Batch:
    """Some pairs that are answered together."""

    numbers: list[int]
    kinds: list[str]
    reference: Frame
    other: Frame
    uv: Tensor  # (B, N, 2) px
    truth: Tensor  # (B, H, W) m

    def one(self, b: int) -> "Batch":
        """Pair ``b`` alone."""
        s = slice(b, b + 1)
        parts = (self.reference[s], self.other[s], self.uv[s], self.truth[s])
        return Batch(self.numbers[s], self.kinds[s], *parts)

    def estimate(self, method: str) -> tuple[Estimate, Trace]:
        """What a method says, and how it came to it."""
        trace: Trace = {}
        seed = torch.tensor(self.numbers)
        estimate = METHODS[method](
            self.reference, self.other, sample=lambda *_a, **_k: self.uv, n=self.uv.shape[1], seed=seed, trace=trace
        )
        return estimate, trace


def batches(n: int, *, seed: int = 0, size: int = BATCH) -> Iterator[Batch]:
    """Pairs 0 … n - 1; those whose camera has a lens apart, because a batch has one for all or none."""
    waiting: dict[bool, list[tuple[int, str, Pair]]] = {True: [], False: []}
    for number in range(n):
        kind, pair = make(number, seed=seed)
        same = waiting[pair.lens is not None]
        same.append((number, kind, pair))
        if len(same) == size:
            yield join(same)
            same.clear()
    yield from (join(rest) for rest in waiting.values() if rest)


def join(items: list[tuple[int, str, Pair]]) -> Batch:
    """A batch of numbers, kinds and pairs."""
    numbers, kinds, pairs = zip(*items, strict=True)
    references, others = zip(*(pair.frames() for pair in pairs), strict=True)
    uv, truth = torch.stack([pair.uv for pair in pairs]), torch.stack([pair.truth for pair in pairs])
    return Batch([*numbers], [*kinds], pytree.collate(references), pytree.collate(others), uv, truth)


def broken(estimate: Estimate, trace: Trace) -> dict[str, Tensor]:
    """Promise → (B,) bool, where it is not kept."""
    e, fit, tracks, keep = estimate, trace["fit"], trace["tracks"], estimate.keep
    merged = merge(trace["samples"], e)
    positive = (e.depth > 0) & (e.sigma > 0) & e.depth.isfinite() & e.sigma.isfinite()
    is_empty = e.depth.isnan() & e.sigma.isnan() & e.sigma_shared.isnan() & (e.score == 0)
    shared = (e.sigma_shared >= 0) & (e.sigma_shared <= e.sigma * (1 + 1e-4))
    tracked = tracks.valid & ~(tracks.uv_1.isfinite().all(-1) & tracks.cov.isfinite().flatten(2).all(-1))
    points: dict[str, Tensor] = {
        "an answer is a depth with a sigma": keep & ~positive,
        "the shared part is no more than sigma": keep & ~shared,
        "silence is NaN with score 0": ~keep & ~is_empty,
        "score in [0, 1]": ~((e.score >= 0) & (e.score <= 1)),
        "a gate of the table": ~torch.isin(e.gate, torch.tensor([*names(Gate)], dtype=e.gate.dtype)),
        "parallax and residual are numbers": ~((e.parallax_deg >= 0) & (e.residual_px >= 0))
        | ~(e.parallax_deg.isfinite() & e.residual_px.isfinite()),
        "one or two views": ~((e.n_views == 1) | (e.n_views == 2)),
        "a valid track is a place with a covariance": tracked,
        "the map is a number everywhere": ~(
            merged.depth.isfinite() & merged.sigma.isfinite() & merged.score.isfinite()
        ),
        "an inlier is a near point of a pose": fit.inlier
        & ~(trace["samples"].xyz.isfinite().all(-1) & fit.ok[:, None]),
    }
    return {k: v.any(-1) for k, v in points.items()} | _broken_pose(fit)


def _broken_pose(fit: PoseFit) -> dict[str, Tensor]:
    T, d = fit.T_1_from_0, fit.cov.diagonal(dim1=-2, dim2=-1)
    values = [T.R, T.t, fit.cov, fit.rms_px, fit.sigma_px, fit.t_snr]
    values += [] if fit.shutter is None else [fit.shutter.shutter_rate, fit.shutter.cov]
    flat = torch.cat([v.reshape(len(fit.code), -1) for v in values], -1)
    off = (T.R.double() @ T.R.double().mT - torch.eye(3, dtype=torch.float64)).abs().amax((-1, -2))
    return {
        "a code of the table": ~torch.isin(fit.code, torch.tensor([*names(PoseCode)], dtype=fit.code.dtype)),
        "a pose is made of numbers": fit.ok & ~flat.isfinite().all(-1),
        "no pose is NaN throughout": ~fit.ok & ~flat.isnan().all(-1),
        "R is a rotation": fit.ok & ~((off < 1e-4) & (torch.linalg.det(T.R.nan_to_num().double()) > 0)),
        "variances are positive": fit.ok & ~(d >= 0).all(-1),
    }


@dataclass
class Tally:
    """What one method did with one kind of trouble."""

    n_pairs: int = 0
    n_points: int = 0
    posed: int = 0
    exceptions: Counter[str] = field(default_factory=Counter)
    promises: Counter[str] = field(default_factory=Counter)
    examples: list[int] = field(default_factory=list)  # numbers of pairs with a fault
    errors: list[Tensor] = field(default_factory=list)  # relative, of the answers
    sigmas: list[Tensor] = field(default_factory=list)  # errors in stated standard deviations

    def row(self, method: str, kind: str, seed: int) -> dict[str, Any]:
        """One line of the result file."""
        e, s = (torch.cat([*x, torch.empty(0)]) for x in (self.errors, self.sigmas))
        some = len(e) > 0
        return {
            "name": kind,
            "method": method,
            "seed": seed,
            "n_pairs": self.n_pairs,
            "exceptions": self.exceptions.total(),
            "broken_promises": self.promises.total(),
            "faults": dict(self.exceptions + self.promises),
            "examples": self.examples[:5],
            "posed": self.posed / max(self.n_pairs, 1),
            "answered": len(e) / max(self.n_points, 1),
            "median_rel": float(e.median()) if some else None,
            "p90_rel": float(e.quantile(0.9)) if some else None,
            "wrong_share": float((e > 0.1).double().mean()) if some else None,
            "within_3sigma": float((s <= 3).double().mean()) if some else None,
        }


def answer(batch: Batch, method: str, tallies: dict[str, Tally]) -> None:
    """Ask one method about a batch; where that raises, about its pairs one by one."""
    try:
        estimate, trace = batch.estimate(method)
    except Exception as error:
        if len(batch.kinds) > 1:
            for b in range(len(batch.kinds)):
                answer(batch.one(b), method, tallies)
        else:
            tally = tallies[batch.kinds[0]]
            tally.n_pairs, tally.n_points = tally.n_pairs + 1, tally.n_points + batch.uv.shape[1]
            tally.exceptions[f"{type(error).__name__}: {error}"[:120]] += 1
            tally.examples.append(batch.numbers[0])
        return
    true = sample_nearest(batch.truth, batch.uv.nan_to_num().clamp(-1e3, 1e3))[0]
    faults = broken(estimate, trace)
    for b, kind in enumerate(batch.kinds):
        tally, keep = tallies[kind], estimate.keep[b] & true[b].isfinite()
        tally.n_pairs, tally.n_points = tally.n_pairs + 1, tally.n_points + batch.uv.shape[1]
        tally.posed += int(trace["fit"].ok[b])
        off = (estimate.depth[b] - true[b])[keep].abs().double()
        tally.errors.append((off / true[b][keep]).float())
        tally.sigmas.append((off / estimate.sigma[b][keep]).float())
        broken_promises = [promise for promise, where in faults.items() if where[b]]
        tally.promises.update(broken_promises)
        tally.examples += [batch.numbers[b]] if broken_promises else []


def run(n: int, *, seed: int = 0, methods: tuple[str, ...] = ("map", "paper")) -> list[dict[str, Any]]:
    """One row per method and kind."""
    tallies = {m: {kind: Tally() for kind in KINDS} for m in methods}
    for batch in batches(n, seed=seed):
        for method in methods:
            with torch.no_grad():
                answer(batch, method, tallies[method])
    return [t.row(m, kind, seed) for m, kinds in tallies.items() for kind, t in kinds.items() if t.n_pairs]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--n", type=int, default=10_000, help="number of pairs")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    harness.set_threads(1)
    start = time.perf_counter()
    rows = run(options.n, seed=options.seed)
    show(rows)
    print(f"{options.n} pairs, {time.perf_counter() - start:.0f} s")
    if options.json is not None:
        storage.write_json(options.json, rows)


def show(rows: list[dict[str, Any]]) -> None:
    """The rows as a table, the sum of each method last."""
    print(f"{'kind':28} {'method':6} {'pairs':>5} {'raise':>5} {'break':>5} {'posed':>6} {'answers':>7} ", end="")
    print(f"{'median':>7} {'p90':>7} {'>10 %':>6} {'<3σ':>6}")
    for r in rows:
        shares = [r["median_rel"], r["p90_rel"], r["wrong_share"], r["within_3sigma"]]
        shares_text = " ".join(f"{v:7.3g}" if v is not None else "      -" for v in shares)
        print(
            f"{r['name']:28} {r['method']:6} {r['n_pairs']:5d} {r['exceptions']:5d} {r['broken_promises']:5d} ", end=""
        )
        print(f"{r['posed']:6.2f} {r['answered']:7.3f} {shares_text}", r["faults"] or "")
    for method in dict.fromkeys(r["method"] for r in rows):
        of = [r for r in rows if r["method"] == method]
        print(
            f"{method}: {sum(r['exceptions'] for r in of)} exceptions, {sum(r['broken_promises'] for r in of)} ", end=""
        )
        print(f"broken promises in {sum(r['n_pairs'] for r in of)} pairs")


if __name__ == "__main__":
    main()
