"""How time and memory grow with samples, pairs, hypotheses, pixels and views: nothing may grow faster than its input.

    python benchmarks/scaling.py --json benchmarks/results/scaling.json

Each series doubles one size, the others stay; hypotheses are those of stage 5 alone, 16 pairs at once. Growth exponents
are slopes of a line through (log size, log time or log memory): 1 is proportional, 0 constant. Sizes of pictures are in
pixels. Peak memory is what a process of its own needs above its inputs, after one small call of each method has loaded
the libraries. The last rows are the largest batch that is promised to fit: 32 pairs with 4096 samples.
"""

import math
import statistics
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import harness
import pnp
import torch
from torch.nn.functional import interpolate

from dhtorch import pytree
from dhtorch.experiments.memory import peak_mib
from dhtorch.geometry import camera as cam
from dhtorch.metrics import holdout
from dhtorch.pipeline.pair import uniform_draws
from dhtorch.pipeline.presets import METHODS, PAPER
from dhtorch.records import Frame
from dhtorch.stages.pose import pnp_ransac
from dhtorch.synthetic.recording import SyntheticRoom

#: The largest exponent that counts as proportional.
MOST = 1.05


def views(count: int) -> list[Frame]:
    """The reference view's near returns and ``count`` further views of the built-in room, 240x320."""
    room = SyntheticRoom()
    step = max(6 // count, 1)
    frames = [holdout.range_split(room[k * step], 2.0) for k in range(count + 1)]
    return [resized(frame, (240, 320)) for frame in frames]


def resized(frame: Frame, hw: tuple[int, int]) -> Frame:
    """The frame with a picture of another size."""
    image = frame.image / 255 if frame.image.dtype == torch.uint8 else frame.image
    image = interpolate(image, hw, mode="bilinear", antialias=True, align_corners=False).clamp(0, 1)
    camera = cam.resize(frame.camera, frame.hw, hw)
    return frame.replace(image=(image * 255).round().to(torch.uint8), camera=camera)


def repeated(frame: Frame, batch: int) -> Frame:
    """``batch`` copies of a frame."""
    return pytree.collate([frame] * batch)


def series(full: bool) -> dict[str, list[tuple[int, Callable[[], Any]]]]:
    """Calls by name of what grows, each with its size."""
    reference, other = views(1)
    doublings = range(5 if full else 4)
    calls: dict[str, list[tuple[int, Callable[[], Any]]]] = {}
    for method in ("paper", "map"):
        pair = partial(METHODS[method], reference, other)
        calls[f"{method}.samples"] = [(512 << k, partial(pair, n=512 << k)) for k in doublings]
        pairs = [partial(METHODS[method], repeated(reference, 1 << k), repeated(other, 1 << k)) for k in doublings]
        calls[f"{method}.pairs"] = [(1 << k, partial(p, n=512)) for k, p in zip(doublings, pairs, strict=True)]
    samples, tracks, camera, _ = pnp.scene(16, 500, 0.3, seed=1)
    stage = partial(pnp_ransac, samples, tracks, camera, camera)
    calls["pose.hypotheses"] = [(128 << k, partial(stage, uniform_draws(0, 16, 128 << k))) for k in doublings]
    sizes = [(120, 160), (240, 160), (240, 320), (480, 320), (480, 640)][-len(doublings) :]
    shown = [(hw, partial(METHODS["paper"], resized(reference, hw), resized(other, hw), n=512)) for hw in sizes]
    calls["paper.pixels"] = [(hw[0] * hw[1], call) for hw, call in shown]
    counts = [1 << k for k in doublings]
    windows = [partial(PAPER.replace(views=v), reference, pytree.stack(views(v)[1:]), n=512) for v in counts]
    calls["window.views"] = [*zip(counts, windows, strict=True)]
    return calls


def small_calls() -> None:
    """One small call of everything that is measured: libraries are loaded at first use, and belong to no size."""
    frame = Frame(torch.rand(1, 3, 120, 160), torch.ones(1, 120, 160), cam.Camera(*torch.full((2, 1, 2), 80.0)))
    reference, other = frame, frame.replace(image=frame.image.roll(2, -1))
    for method in METHODS.values():
        method(reference, other, n=64)
    PAPER(reference, pytree.stack([other]), n=64)


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """Slope of the least-squares line through the logarithms."""
    x, y = [math.log(s) for s in sizes], [math.log(max(v, 1e-9)) for v in values]
    return statistics.linear_regression(x, y).slope


def measure(name: str, calls: list[tuple[int, Callable[[], Any]]], options: Any) -> list[dict[str, Any]]:
    """Rows of one series, each beside the size half as large."""
    sizes = [size for size, _ in calls]
    times = harness.in_turn(
        [call for _, call in calls], repeats=options.repeats, warm_up=1, clock=options.clock, device=options.device
    )
    # Of the smallest and the largest size: each costs a process that imports everything anew.
    memory = [peak_mib(calls[k][1], small_calls) or math.nan for k in (0, -1)]
    middles = [statistics.median(t) for t in times]
    grows = [exponent(sizes, middles), exponent([sizes[0], sizes[-1]], memory)]
    times_text = ", ".join(f"{size}: {ms:.1f} ms" for size, ms in zip(sizes, middles, strict=True))
    verdict = "" if max(grows) <= MOST else f"   above {MOST}!"
    print(f"{name:18} time ^ {grows[0]:.2f}, memory ^ {grows[1]:.2f}{verdict}", flush=True)
    print(f"{'':18} {times_text}; {memory[0]:.0f} to {memory[1]:.0f} MiB", flush=True)
    rows = []
    for k in range(1, len(sizes)):
        last = k == len(sizes) - 1
        more: dict[str, Any] = {"n": sizes[k], "bar": last, "peak_mib": memory[1] if last else None}
        more |= {"time_exponent": grows[0], "memory_exponent": grows[1]}
        rows.append(harness.row(f"scaling.{name}", times[k], "half_the_size", times[k - 1], **more))
    return rows


def largest(options: Any) -> list[dict[str, Any]]:
    """Rows of both methods with 32 pairs and 4096 samples: 640x480, beside one pair after another."""
    frames = [resized(frame, (480, 640)) for frame in views(1)]
    rows = []
    for method in ("paper", "map"):
        whole = partial(METHODS[method], *(repeated(f, 32) for f in frames), n=4096)
        single = partial(METHODS[method], *frames, n=4096)
        together, alone = harness.in_turn([whole, single], repeats=2, warm_up=1, clock=options.clock)
        memory = [peak_mib(call, small_calls) or math.nan for call in (whole, single)]
        print(f"{method}, B = 32, N = 4096: {memory[0]:.0f} MiB above the inputs; one pair {memory[1]:.0f} MiB")
        more: dict[str, Any] = {"n": 4096, "batch": 32, "bar": True, "peak_mib": memory[0]}
        times = [t / 32 for t in together]
        rows.append(harness.row(f"scaling.{method}.largest", times, "pair_by_pair", alone, **more))
    return rows


def main() -> None:
    """Print the exponents; write the rows with ``--json``."""
    options = harness.arguments(__doc__ or "").parse_args()
    options.repeats = min(options.repeats, 5)
    harness.set_threads(1)
    rows = []
    with torch.no_grad():
        for name, calls in series(options.full).items():
            rows += measure(name, calls, options)
        rows += largest(options)
    harness.report(rows, options.json)


if __name__ == "__main__":
    main()
