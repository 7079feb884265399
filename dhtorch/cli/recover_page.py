"""What ``dhtorch PATH`` says of what it made: the numbers, the sentences of the console, the beginning of the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dhtorch.cli import completed_folder as completed
from dhtorch.cli import gate_messages as reasons
from dhtorch.cli.completed_folder import CompletionTask, Row
from dhtorch.codes import Source
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.runtime.console import format_count
from dhtorch.viz.viewer.exhibit import PageOpening

#: Frames whose pixels are looked at for the range and the stated error: coarse to fine, they see the same.
_MAX_MEASURED_FRAMES = 40

#: Reasons of silence that are named on the page, the most frequent; the least share of the pixels that one must have.
_MAX_LISTED_REASONS, _MIN_REASON_SHARE = 3, 0.005


@dataclass(frozen=True)
class RecoveryStats:
    """What became of the frames of one recording that were made, as shares of all their pixels."""

    frames: int
    sensor: float
    recovered: float
    silent: float
    pixels: float  # recovered, a frame
    reasons: tuple[tuple[str, float], ...]  # codes' names and shares of all pixels, the largest first
    near: float | None = None  # m; 2 % and 98 % of what was recovered; None = nothing was
    far: float | None = None
    error: float | None = None  # median stated sigma / depth


def measure_recovery(task: CompletionTask, frames: Sequence[int]) -> RecoveryStats:
    """The numbers of whole frames."""
    rows = [task.done[task.name(i)] for i in frames]
    totals = [sum(row["pixels"].values()) for row in rows]
    share = {
        kind: float(np.mean([row["pixels"].get(kind, 0) / n for row, n in zip(rows, totals, strict=True)]))
        for kind in ("sensor", "swept", "none")
    }
    pixels = sum(row["pixels"].get("swept", 0) for row in rows) / len(rows)
    ends: dict[str, float] = {}
    depth, ratio = _read_swept_pixels(task, frames)
    if len(depth):
        near, far = np.percentile(depth, (2, 98)).tolist()
        ends = {"near": near, "far": far, "error": float(np.median(ratio))}
    reasons = tuple(sorted(_average_silent_shares(rows).items(), key=lambda item: -item[1]))
    return RecoveryStats(len(rows), share["sensor"], share["swept"], share["none"], pixels, reasons, **ends)


def _read_swept_pixels(task: CompletionTask, frames: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Depth and sigma / depth of swept pixels, of some frames."""
    depth, ratio = [np.zeros(0)], [np.zeros(0)]
    for i in frames[:_MAX_MEASURED_FRAMES]:
        maps, source = completed.read_completed_maps(task, i)
        swept = (source == Source.SWEPT) & (maps["depth"] > 0)
        depth.append(maps["depth"][swept])
        ratio.append(maps["sigma"][swept] / maps["depth"][swept])
    return np.concatenate(depth), np.concatenate(ratio)


def _average_silent_shares(rows: Sequence[Row]) -> dict[str, float]:
    """Mean shares of silent pixels by reason."""
    silent: dict[str, float] = {}
    for row in rows:
        for name, share in row["silent"].items():
            silent[name] = silent.get(name, 0.0) + share / len(rows)
    return silent


def describe_recovery(task: CompletionTask, found: RecoveryStats, hw: tuple[int, int]) -> list[str]:
    """What it is, and what was recovered; of pictures (h, w)."""
    recording, (h, w) = task.recording, hw
    kind = f"{task.scene.name}: a {recording.format} capture, {format_count(len(recording), 'frame')} of {w}x{h}"
    guess = intrinsics_options.find_guess_report(recording.report)
    what = f"{kind}; the sensor answers {found.sensor:.0%} of the pixels{f'; its {guess}' if guess else ''}."
    if found.error is None:
        return [what, f"Nothing was recovered: {_explain_silence(found)}."]
    amount = f"Recovered {found.pixels:,.0f} pixels a frame that the sensor lacks, from {found.near:.1f} m to"
    of = f"({format_count(found.frames, 'frame')})"
    return [what, f"{amount} {found.far:.1f} m, median stated error {found.error:.1%} {of}."]


def build_opening(said: Sequence[str], found: RecoveryStats, picture: bytes, place: str) -> PageOpening:
    """The beginning of the page; ``picture`` is the PNG of a frame, ``place`` names it."""
    shown = {"Recovered, pixels a frame": f"{found.pixels:,.0f}"}
    if found.error is not None:
        shown |= {"Recovered, from – to": f"{found.near:.1f} – {found.far:.1f} m"}
        shown |= {"Median stated error": f"{found.error:.1%}"}
    shares = {"Sensor": found.sensor, "Recovered": found.recovered, "Silent": found.silent}
    shown |= {f"{kind}, of the pixels": f"{share:.1%}" for kind, share in shares.items()}
    silent = [
        f"{reasons.describe_gate(name)} ({share:.1%} of the pixels)"
        for name, share in found.reasons
        if share >= _MIN_REASON_SHARE
    ]
    silence = [f"Silent, most often: {'; '.join(silent[:_MAX_LISTED_REASONS])}."] if silent else []
    told_of = "picture, the sensor's depth and the completed one on one scale in metres, and sigma / depth"
    return PageOpening(shown, [*said, *silence], picture, f"{place}: {told_of}.")


def _explain_silence(found: RecoveryStats) -> str:
    """Why frames are silent, by the reason that most silent pixels have and that something helps against."""
    for name, share in found.reasons:
        if share > 0.01 and (said := reasons.suggest_remedy(name)) is not None:
            return said
    return "nothing lies beyond the sensor, which answers nearly everywhere; cutoff=2.0 shows what views can do"
