"""Time per pair, whole and by stage: ``method=paper`` against the same seats filled by OpenCV.

    python benchmarks/pair.py --json benchmarks/results/pair.json

Pairs of TUM fr1/desk (640×480, near limit 1 m, gap 4) where DHTORCH_DATA is set, else of the built-in room. Both sides
take turns in one process; errors are medians of the relative depth error over the same candidates.
"""

from __future__ import annotations

import os
import statistics
from functools import partial
from pathlib import Path
from typing import Any

import harness
import torch

from dhtorch import data, tree
from dhtorch.baselines import opencv
from dhtorch.data.pairs import by_gap
from dhtorch.data.synthetic import SyntheticRoom
from dhtorch.evaluate import errors, holdout
from dhtorch.pair import extend
from dhtorch.records import Frame
from dhtorch.stages import triangulate

OURS = extend
PEER = partial(
    extend,
    track=opencv.lucas_kanade,
    pose=opencv.pnp_ransac,
    triangulate=partial(triangulate.two_view, solver=opencv.triangulate),
)


def load(batch: int) -> tuple[str, Frame, Frame, Frame, float]:
    """Name, near views 0 and 1, view 0 with all its returns, cutoff: ``batch`` pairs, repeated if need be."""
    root = os.environ.get("DHTORCH_DATA")
    if root:
        recording: Any = data.open(Path(root) / "tum_fr1_desk9", near=1.0, gap=4)
    else:
        recording = SyntheticRoom()
    chosen = by_gap(recording)
    chosen = [chosen[k % len(chosen)] for k in range(batch)]
    anchor, other = (tree.collate([recording[p[k]] for p in chosen]) for k in (0, 1))
    near = recording.near
    return recording.name, holdout.range_split(anchor, near), holdout.range_split(other, near), anchor, near


def median_error(method: Any, pair: tuple[str, Frame, Frame, Frame, float]) -> float | None:
    """Median relative depth error over the answered candidates."""
    _, near, other, anchor, cutoff = pair
    trace: dict[str, Any] = {}
    estimate = method(near, other, trace=trace)
    truth = holdout.candidates(trace["samples"], holdout.truth_at(anchor, estimate.uv), cutoff)
    return errors.measure(errors.select(estimate, truth))["median_rel"]


def measure(batch: int, threads: int, repeats: int, n: int = 2048) -> list[dict[str, Any]]:
    """Rows for one batch size and thread count: the whole pair, then each stage."""
    harness.set_threads(threads)
    pair = load(batch)
    traces: list[list[dict[str, float]]] = [[], []]

    def call(side: int, method: Any) -> None:
        trace: dict[str, Any] = {}
        with torch.no_grad():
            method(pair[1], pair[2], n=n, trace=trace)
        traces[side].append(trace["ms"])

    ours, theirs = harness.in_turn([partial(call, 0, OURS), partial(call, 1, PEER)], repeats=repeats)
    found = [median_error(m, pair) for m in (OURS, PEER)]
    name, common = f"pair_paper_b{batch}", {"n": n, "batch": batch}
    scale = [[t / batch for t in side] for side in (ours, theirs)]
    rows = [
        harness.row(name, scale[0], "opencv", scale[1], **common, ours_error=found[0], peer_error=found[1], bar=True)
    ]
    for stage in traces[0][0]:
        a, b = ([t[stage] / batch for t in side[-repeats:]] for side in traces)
        rows.append(harness.row(f"{name}.{stage}", a, "opencv", b, **common))
    return rows


def main() -> None:
    """Print the table; write it with ``--json``."""
    options = harness.arguments(__doc__ or "").parse_args()
    rows = []
    for threads in (1, 2):
        for batch in (1, 8, 32) if options.full else (1, 8):
            rows += measure(batch, threads, options.repeats)
    print(f"{load(1)[0]}: milliseconds per pair, medians of {options.repeats}; errors are median relative depth errors")
    harness.report(rows, options.json)
    whole = [r["ratio"] for r in rows if r["bar"]]
    print(f"ours / opencv, whole pair: {min(whole):.2f} to {max(whole):.2f}, median {statistics.median(whole):.2f}")


if __name__ == "__main__":
    main()
