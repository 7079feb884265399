"""Time per pair, whole and by stage: ``paper`` and ``map`` against the stages of ``paper`` filled by OpenCV.

    python benchmarks/pair.py --json benchmarks/results/pair.json

``map`` does more than the peer (affine tracks, a pose from all tracks, a sigma), so its rows say what that costs.
Pairs of TUM fr1/desk (640×480, near limit 1 m, gap 4) where DHTORCH_DATA is set, else of the built-in room. All sides
take turns in one process; errors are medians of the relative depth error over the same candidates. Rows
``per_far_answer`` are milliseconds per candidate answered within 5 %: their ratio turned over is how many times as many
such answers ours gives in the same time. ``every_pixel`` is the same for ``complete``, whose answers are pixels,
counted on every fourth row and column and multiplied by sixteen. ``auto_reference_view`` is ``auto`` beside ``map``
of five views (``window_1``): one reference view, the same frames around it offered to both, from which each chooses.
Mode ``compiled`` is ours with the compiled code of ``python -m dhtorch.ops``, which the peer has too for the stages
that it shares.
"""

import os
import statistics
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import harness
import torch
from lk import PER_PIXEL
from lk import work as search_work

from dhtorch import data, pytree
from dhtorch.codes import is_estimated
from dhtorch.data.pairs import by_gap
from dhtorch.experiments.baselines import opencv
from dhtorch.metrics import errors, holdout
from dhtorch.pipeline import dense
from dhtorch.pipeline.completion import complete_depth
from dhtorch.pipeline.presets import AUTO, MAP, PAPER
from dhtorch.pipeline.view_report import with_view_selection
from dhtorch.records import DepthMap, Frame
from dhtorch.stages import triangulate
from dhtorch.synthetic.recording import SyntheticRoom

#: Ours, by name.
OURS = {"paper": PAPER, "map": MAP}

#: What ours runs in, by mode.
MODES: dict[str, Callable[[], Any]] = {"eager": nullcontext, "compiled": harness.with_compiled_operators}

#: Relative error of a far answer that counts.
GOOD = 0.05

#: Rows and columns of a map from one pixel that is held against the truth to the next.
EVERY = 4

#: Multiply-adds of ``map`` beyond the search, per point: registration of a window of 21 px (35 products of its normal
#: equations; five steps that read image 1 at 4 multiply-adds of position and 3 of value and project it on 8 pictures),
#: and 40 evaluations of the pose's cost at 120.
MAP_PER_POINT = 21**2 * (35 + 5 * (4 + 3 + 8)) + 40 * 120

PEER = PAPER.replace(
    track=opencv.opencv_lucas_kanade,
    pose=opencv.opencv_pnp_ransac,
    triangulate=partial(triangulate.two_view, solver=opencv.opencv_triangulate),
)


def _recording() -> tuple[Any, float, int]:
    """The recording, its near limit in m and the gap of its pairs."""
    root = os.environ.get("DHTORCH_DATA")
    return (data.open(Path(root) / "tum_fr1_desk9"), 1.0, 4) if root else (SyntheticRoom(), 2.0, 6)


def load(batch: int) -> tuple[str, Frame, Frame, Frame, float]:
    """Name, near views 0 and 1, view 0 with all its returns, cutoff: ``batch`` pairs, repeated if need be."""
    recording, near, gap = _recording()
    chosen = by_gap(recording, gap)
    chosen = [chosen[k % len(chosen)] for k in range(batch)]
    reference, other = (pytree.collate([recording[p[k]] for p in chosen]) for k in (0, 1))
    return recording.name, holdout.range_split(reference, near), holdout.range_split(other, near), reference, near


def median_error(method: Any, pair: tuple[str, Frame, Frame, Frame, float]) -> float | None:
    """Median relative depth error over the answered candidates."""
    return errors.measure_errors(answers(method, pair))["median_rel"]


def answers(method: Any, pair: tuple[str, Frame, Frame, Frame, float]) -> errors.Points:
    """What the method says of the candidates, beside their true depth."""
    _, near, other, reference, cutoff = pair
    trace: dict[str, Any] = {}
    estimate = method(near, other, trace=trace)
    truth = holdout.select_candidates(trace["samples"], holdout.sample_truth(reference, estimate.uv), cutoff)
    return errors.points_from_estimate(estimate, truth)


def work(name: str, n: int, hw: tuple[int, int]) -> harness.Work:
    """Least work of one pair: the search there and back, with ``map`` a fifth level, registration and pose."""
    search = search_work(n, 21, hw, ways=2)
    more = n * (MAP_PER_POINT + 2 * 21**2 * PER_PIXEL) if name == "map" else 0
    return search._replace(multiply_adds=search.multiply_adds + more)


def measure(batch: int, threads: int, options: Any, n: int = 2048) -> list[dict[str, Any]]:
    """Rows for one batch size and thread count: for each method and mode the whole pair, then each stage."""
    harness.set_threads(threads)
    pair = load(batch)
    peer = "opencv", "compiled"  # the stages that it shares with ours take no longer than ours
    methods: dict[tuple[str, str], Callable[..., Any]] = {(k, mode): OURS[k] for k in OURS for mode in MODES}
    methods[peer] = PEER
    traces: dict[tuple[str, str], list[dict[str, float]]] = {side: [] for side in methods}

    def call(side: tuple[str, str]) -> None:
        trace: dict[str, Any] = {}
        with torch.no_grad(), MODES[side[1]]():
            methods[side](pair[1], pair[2], n=n, trace=trace)
        traces[side].append(trace["ms"])

    def points_of(side: tuple[str, str]) -> errors.Points:
        with MODES[side[1]]():
            return answers(methods[side], pair)

    sides = harness.in_turn([partial(call, side) for side in methods], repeats=options.repeats, clock=options.clock)
    times = {side: [t / batch for t in durations] for side, durations in zip(methods, sides, strict=True)}
    points = {side: points_of(side) for side in methods}
    median_rel = {side: errors.measure_errors(points[side])["median_rel"] for side in methods}
    good = {side: int((points[side].answered().error <= GOOD).sum()) / batch for side in methods}
    rows = []
    for side in methods:
        if side == peer:
            continue
        name, common = f"pair_{side[0]}_b{batch}", {"n": n, "batch": batch, "mode": side[1]}
        errors_of = {"ours_error": median_rel[side], "peer_error": median_rel[peer]}
        least = work(side[0], n, pair[1].hw)
        rows.append(harness.row(name, times[side], "opencv", times[peer], work=least, **common, **errors_of, bar=True))
        if good[side] and good[peer]:
            a, b = ([t / good[k] for t in times[k]] for k in (side, peer))
            rows.append(harness.row(f"{name}.per_far_answer", a, "opencv", b, **common))
        for stage in traces[side][0]:
            a, b = ([t[stage] / batch for t in traces[k][-options.repeats :]] for k in (side, peer))
            rows.append(harness.row(f"{name}.{stage}", a, "opencv", b, **common))
    return rows


def measure_every_pixel(threads: int, options: Any, n: int = 2048) -> list[dict[str, Any]]:
    """Time per hidden pixel that ``complete`` answers within 5 %, in torch and compiled, beside an answer of OpenCV."""
    harness.set_threads(threads)
    _, near, other, _, _ = pair = load(1)

    def ours(mode: str = "eager") -> DepthMap:
        with torch.no_grad(), MODES[mode]():
            return complete_depth(near, other, method=MAP, source_views=1)

    def peer() -> None:
        with torch.no_grad():
            PEER(near, other, n=n)

    *sides, theirs = harness.in_turn(
        [*(partial(ours, mode) for mode in MODES), peer], repeats=options.repeats, clock=options.clock
    )
    error, their_error = pixel_errors(ours(), pair), answers(PEER, pair).answered().error
    good, their_good = (int((e <= GOOD).sum()) for e in (error, their_error))
    common = {"n": n, "batch": 1, "ours_error": float(error.median()), "peer_error": float(their_error.median())}
    b = [t / their_good for t in theirs]
    return [
        harness.row("every_pixel.per_far_answer", [t / good / EVERY**2 for t in side], "opencv", b, mode=mode, **common)
        for mode, side in zip(MODES, sides, strict=True)
    ]


def pixel_errors(depth_map: DepthMap, pair: tuple[str, Frame, Frame, Frame, float]) -> torch.Tensor:
    """Relative errors of the swept pixels in every so many rows and columns that have truth beyond the cutoff."""
    _, near, _, reference, cutoff = pair
    chosen = torch.zeros_like(depth_map.keep)
    chosen[:, ::EVERY, ::EVERY] = True
    chosen &= is_estimated(depth_map.source)
    _, h, w = depth_map.depth.shape
    truth = holdout.sample_truth(reference, dense.map_pixel_centres(near, (h, w))[chosen.flatten()][None])
    counts = truth.ok & (truth.depth > cutoff)
    return (depth_map.depth[chosen][None] / truth.depth - 1).abs()[counts]


def measure_anchor(threads: int, options: Any, n: int = 2048) -> list[dict[str, Any]]:
    """The rows of one reference view in the middle of the recording, all other frames being offered."""
    harness.set_threads(threads)
    recording, near, _ = _recording()
    middle = len(recording) // 2
    reference, *others = (
        holdout.range_split(recording[k], near) for k in (middle, *(i for i in range(len(recording)) if i != middle))
    )
    truth_of = recording[middle]
    median_rel = {}

    def call(name: str, method: Any, mode: str = "eager") -> None:
        trace: dict[str, Any] = {}
        with torch.no_grad(), MODES[mode]():
            estimate = method(reference, others, n=n, trace=trace)
        truth = holdout.select_candidates(trace["samples"], holdout.sample_truth(truth_of, estimate.uv), near)
        median_rel[name] = errors.measure_errors(errors.points_from_estimate(estimate, truth))["median_rel"]

    sides = [partial(call, mode, with_view_selection(AUTO), mode) for mode in MODES]
    sides.append(partial(call, "window_1", with_view_selection(MAP.replace(views=5))))
    *ours, peer = harness.in_turn(sides, repeats=options.repeats, clock=options.clock)
    rows = []
    for mode, times in zip(MODES, ours, strict=True):
        more: dict[str, Any] = {"n": n, "mode": mode, "bar": True}
        more |= {"ours_error": median_rel[mode], "peer_error": median_rel["window_1"]}
        rows.append(harness.row("auto_reference_view", times, "window_1", peer, **more))
    return rows


def main() -> None:
    """Print the table; write it with ``--json``."""
    options = harness.arguments(__doc__ or "").parse_args()
    rows = []
    for threads in (1, 2):
        for batch in (1, 8, 32) if options.full else (1, 8):
            rows += measure(batch, threads, options)
        rows += measure_every_pixel(threads, options) + measure_anchor(threads, options)
    print(f"{load(1)[0]}: milliseconds per pair, medians of {options.repeats}; errors are median relative depth errors")
    harness.report(rows, options.json)
    for method in OURS:
        whole = [r["ratio"] for r in rows if r["bar"] and r["name"].startswith(f"pair_{method}_")]
        print(f"{method} / opencv: {min(whole):.2f} to {max(whole):.2f}, median {statistics.median(whole):.2f}")


if __name__ == "__main__":
    main()
