"""Question: what does the method cost beside the visual branch of a robot policy, and how does it grow with the image?

The front end (spiral, back-projection, hole taxonomy; n = 1024) is what the paper times, at 224×224 and at 1440×1920,
next to one forward pass of DINOv2-L at 224×224 on the same machine and threads. Beyond the paper: every stage, the
whole pair, and the memory both need.

Expectation (written before the run): a forward pass of DINOv2-L takes at least 96 times as long as the front end at
224×224, and the front end at 1440×1920 takes at most 3.4 times as long as at 224×224, as in the paper. On few threads
the first ratio should come out larger than the paper's: a transformer uses every core, the front end does not.
What would refute it: a ratio below 96, or a growth above 3.4, beyond the spread from round to round. Milliseconds are
the machine's own and decide nothing.
"""

import contextlib
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from dhtorch.data.pairs import to_fixed_pairs
from dhtorch.data.scene import SceneLike, scenes_of
from dhtorch.experiments import memory
from dhtorch.experiments.baselines import dinov2 as visual
from dhtorch.experiments.outcome import MainMetric, Row
from dhtorch.experiments.protocol import Method, Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.geometry import camera as cam
from dhtorch.metrics import holdout
from dhtorch.metrics.bootstrap import Interval
from dhtorch.pipeline.spec import Trace
from dhtorch.records import Estimate, Frame, Samples

#: The paper's figures (Apple M4 Pro, OpenCV on 14 threads): times in ms, and two ratios to compare on any machine.
_PAPER_FIGURES = {
    "front_end_ms": 1.11,
    "front_end_large_ms": 3.81,
    "dinov2_ms": 106.5,
    "speedup": 96.0,
    "growth": 3.81 / 1.11,
}

#: Column → (quantile, fewest repeats that determine it).
_TAIL_PERCENTILES = {"p50_ms": (0.5, 1), "p95_ms": (0.95, 20), "p99_ms": (0.99, 100)}

#: Name of the visual branch in rows and summary.
VISUAL_BRANCH = "dinov2_l"


@dataclass
class TimedBranch:
    """A call to time, and its milliseconds by stage, one list per round."""

    method: str
    stage: str  # of the whole call; a call that returns a dict of milliseconds by stage adds those
    hw: tuple[int, int]
    call: Callable[[], Any]
    repeats: int  # per round
    more: Row  # parameters, weight_bytes, peak_mib
    rounds: list[dict[str, list[float]]] = field(default_factory=list)

    def times(self, stage: str) -> list[float]:
        """All milliseconds of a stage."""
        return [t for of_round in self.rounds for t in of_round[stage]]

    def medians(self, stage: str) -> list[float]:
        """Median of each round."""
        return [statistics.median(of_round[stage]) for of_round in self.rounds]


def run(
    scenes: Sequence[SceneLike],
    chosen: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    sizes: Sequence[tuple[int, int]] = ((224, 224), (1440, 1920)),
    n: int = 1024,
    rounds: int = 5,
    front_end_repeats: int = 60,
    pair_repeats: int = 20,
    dinov2_repeats: int = 4,
    warm_up: int = 2,
    peak: bool = True,
    dinov2: Callable[..., torch.nn.Module] = visual.load_dinov2,
    progress: Progress = no_progress,
) -> Outcome:
    """Times and memory of the method and DINOv2 on the first pair of the first scene, resampled to each size.

    All branches are timed in every round, so that other load of the machine affects them alike; batch size 1.
    Intervals are the lowest and highest median of a round.

    Args:
        scenes, chosen, pairs, settings, progress: as :func:`dhtorch.experiments.pair.run`; the first method.
        sizes: (height, width) of the images; ratios are taken at the first, growth from the first to the last.
        n: samples.
        rounds: number of rounds.
        front_end_repeats, pair_repeats, dinov2_repeats: calls per round. A 95th percentile needs 20 calls in all, a
            99th 100, else it is null.
        warm_up: untimed calls before each block.
        peak: also measure peak memory, each in a process of its own.
        dinov2: makes the network; without ``transformers`` its row has a note on what to install.

    Returns:
        Outcome with one row per branch, stage and size (``p50_ms``, ``p95_ms``, ``p99_ms``, ``parameters``,
        ``weight_bytes``, ``peak_mib``, …), and in the summary the medians and ratios.

    Raises:
        ValueError: no pair, no size, or a count below 1.
    """
    counts = {"rounds": rounds, "front_end_repeats": front_end_repeats, "pair_repeats": pair_repeats}
    for name, count in {**counts, "dinov2_repeats": dinov2_repeats, "n": n, "sizes": len(sizes)}.items():
        if count < 1:
            raise ValueError(f"experiment.{name}: found {count}, expected at least 1")
    name, method = next(iter(chosen.items()))
    scene = scenes_of(scenes)[0]
    options: dict[str, Any] = {"seed": settings.seed, "hint": scene.hint}
    fixed = to_fixed_pairs(pairs(scene))
    if not fixed:
        raise ValueError(f"latency: {scene.name} has no pair, expected at least one")
    near, cutoff = (
        (scene.recording[k].to(settings.dtype).to(settings.device) for k in fixed[0]),
        settings.cutoff_of(scene),
    )
    views = [holdout.range_split(view, cutoff) for view in near]
    branches: list[TimedBranch] = []
    for hw in sizes:
        frame_0, frame_1 = (_resample_frame(view, (hw[0], hw[1])) for view in views)
        timed: list[tuple[str, Callable[[], Any], int]] = [
            ("front_end", partial(_run_front_end, method, frame_0, n), front_end_repeats),
            ("pair", partial(_run_pair, partial(method, n=n, **options), frame_0, frame_1), pair_repeats),
        ]
        for stage, call, repeats in timed:
            resources = memory.count_weights(method) | {"peak_mib": _peak_mib(call, settings, peak)}
            branches.append(TimedBranch(name, stage, frame_0.hw, call, repeats, resources))
    visual_branches, note = _make_visual_branch(dinov2, views[0], settings, peak, dinov2_repeats)
    branches += visual_branches
    for _ in progress(range(rounds), f"{len(branches)} timings", rounds):
        for branch in branches:
            _time_round(branch, warm_up, settings.device)
    rows = [_timing_row(scene.name, b, stage, settings, n) for b in branches for stage in b.rounds[0]]
    if note:
        rows.append({"scene": scene.name, "pair": None, "method": VISUAL_BRANCH, "stage": "forward", "note": note})
    named = dict.fromkeys(f"{b.stage}.{'x'.join(map(str, b.hw))}" for b in branches)
    metrics = tuple(MainMetric(stage, larger_is_better=False, with_interval=True) for stage in named)
    outcome = Outcome(rows=rows, summary=summarise_timings(branches), n_pairs=1, metrics=metrics)
    return outcome.decide(
        "What does the method cost beside a DINOv2-L forward pass, and how does it grow with the image?",
        (
            "A DINOv2-L forward takes at least 96 times as long as the front end at 224x224, and the front end "
            "grows at most 3.4 times to 1440x1920."
        ),
        *verdict(name, outcome.summary, sizes, note),
    )


def _run_front_end(method: Method, frame: Frame, n: int) -> Samples:
    """Stages 1 to 3 of a method (sample, backproject, classify): the front end that the paper times."""
    return method.replace(n=n).sample_depth(frame)


def _run_pair(method: Callable[..., Estimate], frame_0: Frame, frame_1: Frame) -> dict[str, float]:
    """All seven stages of a method on a pair → milliseconds of each."""
    trace: Trace = {}
    method(frame_0, frame_1, trace=trace)
    return dict(trace["ms"])


def _run_forward(make: Callable[[], torch.nn.Module], pixels: Tensor) -> None:
    """Build the network and run one forward pass, for the peak memory of a process with nothing else."""
    with torch.no_grad():
        make()(pixel_values=pixels)


def verdict(
    method: str, summary: Mapping[str, Any], sizes: Sequence[Sequence[int]], note: str = ""
) -> tuple[bool | None, str]:
    """(both of the paper's ratios hold, None where the spread over rounds does not decide it; the numbers)."""
    first = "x".join(map(str, sizes[0]))
    parts = [f"{stage} {summary[f'{method}.{stage}.{first}']['value']:.3g} ms" for stage in ("front_end", "pair")]
    parts = [f"{first}: {', '.join(parts)}"]
    claims: list[bool | None] = []
    for ratio, label in (("speedup", "DINOv2-L / front end"), ("growth", "growth of the front end")):
        entry, paper = summary.get(f"{method}.{ratio}"), _PAPER_FIGURES[ratio]
        if entry is None:
            claims.append(None)
            parts.append(f"{label} {note if ratio == 'speedup' and note else 'not measured'}")
            continue
        worst, best = (entry["low"], entry["high"]) if ratio == "speedup" else (-entry["high"], -entry["low"])
        limit = paper if ratio == "speedup" else -paper
        claims.append(True if worst >= limit else False if best < limit else None)
        parts.append(f"{label} {entry['value']:.3g} ({entry['low']:.3g} to {entry['high']:.3g}), paper {paper:.3g}")
    return False if False in claims else None if None in claims else True, "; ".join(parts)


def _resample_frame(frame: Frame, hw: tuple[int, int]) -> Frame:
    """Frame with its image resampled to another size; the depth map keeps its own."""
    image = frame.image / 255 if frame.image.dtype == torch.uint8 else frame.image
    image = interpolate(image, hw, mode="bilinear", antialias=True, align_corners=False).clamp(0, 1)
    if frame.image.dtype == torch.uint8:
        image = (image * 255 + 0.5).to(torch.uint8)
    return frame.replace(image=image, camera=cam.resize(frame.camera, frame.hw, hw))


def _make_visual_branch(
    make: Callable[..., torch.nn.Module], frame: Frame, settings: Settings, peak: bool, repeats: int
) -> tuple[list[TimedBranch], str]:
    """([branch of DINOv2's forward pass], "") or ([], reason)."""
    try:
        visual.import_dinov2()
    except ImportError as error:
        return [], f"not measured: {error}"
    side = make.keywords.get("side", 224) if isinstance(make, partial) else 224
    pixels = visual.preprocess_image(frame.image, side).to(settings.dtype)
    # Before this process loads the network, so that there is memory for both.
    peak_memory = _peak_mib(partial(_run_forward, make, pixels), settings, peak, visual.import_dinov2)
    network = make().to(settings.device, settings.dtype)

    def call() -> None:
        network(pixel_values=pixels)

    resources = memory.count_weights(network) | {"peak_mib": peak_memory}
    return [TimedBranch(VISUAL_BRANCH, "forward", (side, side), call, repeats, resources)], ""


def _peak_mib(
    call: Callable[[], Any], settings: Settings, wanted: bool, before: Callable[[], Any] | None = None
) -> float | None:
    """Peak memory on the CPU, in a process of its own; None on other devices or if not ``wanted``."""
    return memory.peak_mib(call, before) if wanted and settings.device == "cpu" else None


def _time_round(branch: TimedBranch, warm_up: int, device: str) -> None:
    """Time one round of a branch, after ``warm_up`` calls, and append it to its rounds."""
    times: dict[str, list[float]] = {branch.stage: []}
    with torch.no_grad():
        for k in range(-warm_up, branch.repeats):
            start = time.perf_counter()
            stages = branch.call()
            if device != "cpu":
                torch.cuda.synchronize(device)
            measured = {branch.stage: 1e3 * (time.perf_counter() - start)}
            if device == "cpu" and isinstance(stages, dict):  # on other devices a stage returns before it is done
                measured |= stages
            for stage, ms in measured.items() if k >= 0 else ():
                times.setdefault(stage, []).append(ms)
    branch.rounds.append(times)


def _timing_row(scene: str, branch: TimedBranch, stage: str, settings: Settings, n: int) -> Row:
    """Row of one branch or stage at one size."""
    times = branch.times(stage)
    row: Row = {"scene": scene, "pair": None, "method": branch.method, "stage": stage, "hw": list(branch.hw)}
    row |= {"n": None if branch.method == VISUAL_BRANCH else n, "repeats": len(times)}
    cpu = ""
    with contextlib.suppress(OSError):
        lines = [x for x in Path("/proc/cpuinfo").read_text().splitlines() if x.startswith("model name")]
        cpu = lines[0].partition(":")[2].strip() if lines else ""
    row |= {"threads": torch.get_num_threads(), "device": settings.device}
    row |= {"cpu": cpu or platform.processor() or platform.machine(), "cores": os.cpu_count()}
    row["load"] = os.getloadavg()[0] if hasattr(os, "getloadavg") else None  # runnable processes, last minute
    for name, (quantile, min_repeats) in _TAIL_PERCENTILES.items():
        row[name] = float(np.quantile(times, quantile)) if len(times) >= min_repeats else None
    row |= {"low_ms": min(branch.medians(stage)), "high_ms": max(branch.medians(stage))}
    return row | branch.more if stage == branch.stage else row


def summarise_timings(branches: Sequence[TimedBranch]) -> dict[str, Any]:
    """Medians by ``<method>.<stage>.<height>x<width>``, memory, and the paper's two ratios, round by round."""
    summary: dict[str, Any] = {}
    front = [b for b in branches if b.stage == "front_end"]
    for b in branches:
        size = "x".join(map(str, b.hw))
        for stage in b.rounds[0]:
            times = b.times(stage)
            entry = _summary_entry(statistics.median(times), b.medians(stage), len(times), "ms")
            summary[f"{b.method}.{stage}.{size}"] = entry
        if b.more["peak_mib"] is not None:
            summary[f"{b.method}.{b.stage}.{size}.peak_mib"] = _summary_entry(b.more["peak_mib"], [], 1, "MiB")
    for b in (front[0], *(b for b in branches if b.method == VISUAL_BRANCH)):
        for key, unit in (("parameters", "count"), ("weight_bytes", "B")):
            summary[f"{b.method}.{key}"] = _summary_entry(b.more[key], [], 1, unit)
    small = front[0].medians("front_end")
    compared = [("growth", b.medians("front_end")) for b in front[1:][-1:]]
    compared += [("speedup", b.medians("forward")) for b in branches if b.method == VISUAL_BRANCH]
    for name, numerators in compared:
        ratios = [a / b for a, b in zip(numerators, small, strict=True)]
        summary[f"{front[0].method}.{name}"] = _summary_entry(statistics.median(ratios), ratios, len(ratios), "1")
    return summary


def _summary_entry(value: float, spread: Sequence[float], n: int, unit: str) -> dict[str, Any]:
    low, high = (min(spread), max(spread)) if spread else (None, None)
    return Interval(value, low, high, n).entry(unit)
