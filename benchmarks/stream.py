"""Time per frame of a method that chooses its views, and of a stream.

    python benchmarks/stream.py --json benchmarks/results/stream.json

``auto`` is a whole anchor: the choice among the frames around it, five views and their joining; its peer is
``map`` of five given views (``window``). ``fused`` is that joined with a plane sweep; its peer is the second release's
``auto`` and sweep, without filters of the map. ``push`` is the newest frame answered from past ones at 640×480 with
1,024 samples; its peer is the same work in OpenCV's stages: the views that the stream asked, each tracked, posed and
triangulated. Frames of 7s_redkitchen_stream_200 (640×480, near limit 2 m) where DHTORCH_DATA is set, else of the
built-in room. All sides take turns in one process.
"""

import os
from functools import partial
from pathlib import Path
from typing import Any

import harness
import torch

from dhtorch import data, extend
from dhtorch.data.pairs import candidate_frames, spaced_frames
from dhtorch.data.recording import Recording
from dhtorch.experiments.baselines import opencv
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import dense
from dhtorch.pipeline.dense_options import DEFAULT_DENSE_OPTIONS
from dhtorch.pipeline.presets import AUTO, FUSED, MAP
from dhtorch.pipeline.stream import Stream
from dhtorch.pytree import stack
from dhtorch.records import Frame
from dhtorch.stages import triangulate
from dhtorch.synthetic.recording import SyntheticRoom

#: ``auto`` of the second release.
AUTO_2 = AUTO.replace(
    verify_views=None,
    guide=None,
    pose_samples=0,
    select_views={"near": 0, "prefer_tracked": False, "reserve": 0},
)

PEER = partial(
    extend,
    track=opencv.opencv_lucas_kanade,
    pose=opencv.opencv_pnp_ransac,
    triangulate=partial(triangulate.two_view, solver=opencv.opencv_triangulate),
)


def load() -> tuple[Recording, float, int, int]:
    """A recording, its near limit and gap, and the reference view that is asked."""
    root = os.environ.get("DHTORCH_DATA")
    if root:
        return data.open(Path(root) / "7s_redkitchen_stream_200"), 2.0, 20, 40
    return SyntheticRoom(n_frames=24), 2.0, 6, 12


def measure(threads: int, options: Any) -> list[dict[str, Any]]:
    """A row for a whole reference view and one for a frame of the stream."""
    harness.set_threads(threads)
    recording, near, gap, i = load()
    seen: dict[int, Frame] = {}

    def view(k: int) -> Frame:
        if k not in seen:
            seen[k] = range_split(recording[k], near)
        return seen[k]

    offered = stack([view(k) for k in candidate_frames(recording, i)])
    five = stack([view(k) for k in spaced_frames(i, i + gap, 5)])

    def auto() -> None:
        with torch.no_grad():
            AUTO(view(i), offered)

    def window() -> None:
        with torch.no_grad():
            MAP.replace(views=5)(view(i), five)

    def fused() -> None:
        with torch.no_grad():
            FUSED(view(i), offered)

    def auto_and_sweep() -> None:
        with torch.no_grad():
            trace: dict[str, Any] = {}
            selected = dense.selected_views(AUTO_2(view(i), offered, trace=trace), offered, trace)
            swept = dense.sweep_views(view(i), selected, AUTO_2, DEFAULT_DENSE_OPTIONS)
            dense.merge_returns(dense.gate_sweep(swept, DEFAULT_DENSE_OPTIONS), swept.returns)

    sides = harness.in_turn([auto, window, fused, auto_and_sweep], repeats=options.repeats, clock=options.clock)
    settings = {"n": AUTO.n, "batch": 1, "bar": True}
    rows = [
        harness.row("auto_reference_view", sides[0], "window", sides[1], **settings),
        harness.row("fused_reference_view", sides[2], "auto_2 and its sweep", sides[3], **settings),
    ]

    method = AUTO.replace(n=1024)
    stream = Stream(method)
    for k in range(i - max(stream.steps), i):
        if k >= 0:
            stream.past.append(view(k))
    trace: dict[str, Any] = {}
    past = list(stream.past)

    def push() -> None:
        stream.past.clear()
        stream.past.extend(past)
        stream.push(view(i), trace=trace)

    push()
    source_frames = [view(i - s) for s in trace["back"][:, 0].tolist()]

    def peer() -> None:
        with torch.no_grad():
            for other in source_frames:
                PEER(view(i), other, n=1024)

    ours, theirs = harness.in_turn([push, peer], repeats=options.repeats, clock=options.clock)
    return [*rows, harness.row("stream_push", ours, "opencv", theirs, n=1024, batch=1, bar=True)]


def main() -> None:
    """Print the table; write it with ``--json``."""
    options = harness.arguments(__doc__ or "").parse_args()
    rows = [row for threads in (1, 2) for row in measure(threads, options)]
    print(f"{load()[0].name}: milliseconds, medians of {options.repeats}")
    harness.report(rows, options.json)


if __name__ == "__main__":
    main()
