"""Degenerate and adversarial pairs: nothing raises, nothing that is promised is missing.

Kinds of trouble (``degenerate_pairs``) take turns in batches of 64, 96×128 pixels, 128 samples. For every method and
kind: pairs that break a promise of the records, and the fraction of the samples answered. The test of the same name
takes two pairs of every kind, ``run(10_000)`` some hundred.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dhtorch import pytree
from dhtorch.codes import Gate, PoseCode, names
from dhtorch.pipeline.pair import merge
from dhtorch.pipeline.presets import METHODS
from dhtorch.pipeline.spec import Trace
from dhtorch.records import Estimate, Frame, PoseFit
from support.degenerate_pairs import KINDS, Pair, make

BATCH = 64


@dataclass
class Batch:
    """Some pairs that are answered together."""

    numbers: list[int]
    kinds: list[str]
    reference: Frame
    other: Frame
    uv: Tensor  # (B, N, 2) px

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
    uv = torch.stack([pair.uv for pair in pairs])
    return Batch([*numbers], [*kinds], pytree.collate(references), pytree.collate(others), uv)


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


def run(n: int, *, seed: int = 0, methods: tuple[str, ...] = ("map", "paper")) -> list[dict[str, Any]]:
    """One row per method and kind: pairs, broken promises, examples of pairs that break one, fraction answered."""
    rows = {
        (method, kind): {"name": kind, "method": method, "n_pairs": 0, "faults": Counter(), "examples": [], "keep": []}
        for method in methods
        for kind in KINDS
    }
    for batch in batches(n, seed=seed):
        for method in methods:
            with torch.no_grad():
                estimate, trace = batch.estimate(method)
            faults = broken(estimate, trace)
            for b, kind in enumerate(batch.kinds):
                row: dict[str, Any] = rows[method, kind]
                row["n_pairs"] += 1
                row["keep"].append(estimate.keep[b])
                broken_promises = [promise for promise, where in faults.items() if where[b]]
                row["faults"].update(broken_promises)
                row["examples"] += [batch.numbers[b]] if broken_promises else []
    return [
        {**row, "faults": dict(row["faults"]), "answered": float(torch.cat(row["keep"]).double().mean())}
        for row in rows.values()
        if row["n_pairs"]
    ]
