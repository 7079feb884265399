"""Statistics of ``dhtorch PATH``, their printed sentences, and the opening of the viewer page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dhtorch.cli import completed_folder as completed
from dhtorch.cli import gate_messages as reasons
from dhtorch.cli.completed_folder import CompletionTask, Row
from dhtorch.codes import is_estimated
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.recording import Recording
from dhtorch.runtime.console import format_count
from dhtorch.validation.capture_check import CaptureCheck
from dhtorch.viz.viewer.exhibit import PageOpening

#: Maximum number of frames read for depth range and stated error; further frames show the same surfaces.
_MAX_MEASURED_FRAMES = 40

#: Reasons for missing answers listed on the page, the most frequent.
_MAX_LISTED_REASONS = 3

#: Smallest fraction of the pixels of a listed reason.
_MIN_REASON_SHARE = 0.005


@dataclass(frozen=True)
class RecoveryStats:
    """Statistics of the completed frames of one recording; fractions are of all their pixels."""

    frames: int
    sensor: float
    recovered: float
    no_answer: float
    pixels: float  # recovered pixels per frame
    reasons: tuple[tuple[str, float], ...]  # gate names and fractions of all pixels, the largest first
    near: float | None = None  # m; 2 % and 98 % percentile of recovered depth; None = nothing recovered
    far: float | None = None
    error: float | None = None  # median stated sigma / depth


def measure_recovery(task: CompletionTask, frames: Sequence[int]) -> RecoveryStats:
    """Statistics of complete frames."""
    rows = [task.done[task.name(i)] for i in frames]
    totals = [sum(row["pixels"].values()) for row in rows]

    def n_of(row: Row, kind: str) -> int:
        pixels: Mapping[str, int] = row["pixels"]
        return completed.count_estimated(pixels) if kind == "swept" else pixels.get(kind, 0)

    fraction = {
        kind: float(np.mean([n_of(row, kind) / n for row, n in zip(rows, totals, strict=True)]))
        for kind in ("sensor", "swept", "none")
    }
    pixels = sum(n_of(row, "swept") for row in rows) / len(rows)
    depth_stats: dict[str, float] = {}
    depth, ratio = _read_swept_pixels(task, frames)
    if len(depth):
        near, far = np.percentile(depth, (2, 98)).tolist()
        depth_stats = {"near": near, "far": far, "error": float(np.median(ratio))}
    reasons = tuple(sorted(_average_no_answer_shares(rows).items(), key=lambda item: -item[1]))
    return RecoveryStats(
        len(rows), fraction["sensor"], fraction["swept"], fraction["none"], pixels, reasons, **depth_stats
    )


def _read_swept_pixels(task: CompletionTask, frames: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Depth and sigma / depth of the swept pixels of the first ``_MAX_MEASURED_FRAMES`` frames."""
    depth, ratio = [np.zeros(0)], [np.zeros(0)]
    for i in frames[:_MAX_MEASURED_FRAMES]:
        maps, source = completed.read_completed_maps(task, i)
        swept = is_estimated(source) & (maps["depth"] > 0)
        depth.append(maps["depth"][swept])
        ratio.append(maps["sigma"][swept] / maps["depth"][swept])
    return np.concatenate(depth), np.concatenate(ratio)


def _average_no_answer_shares(rows: Sequence[Row]) -> dict[str, float]:
    """Mean fraction of unanswered pixels by reason."""
    shares: dict[str, float] = {}
    for row in rows:
        for name, share in row["no_answer"].items():
            shares[name] = shares.get(name, 0.0) + share / len(rows)
    return shares


def describe_recovery(
    task: CompletionTask, stats: RecoveryStats, hw: tuple[int, int], check: CaptureCheck
) -> list[str]:
    """Printed sentences: the capture (images (h, w)), and what was recovered, else what its check shows."""
    recording, (h, w) = task.recording, hw
    kind = f"{task.scene.name}: a {recording.format} capture, {format_count(len(recording), 'frame')} of {w}x{h}"
    guess = intrinsics_options.find_guess_report(recording.report)
    sensor = f"{kind}; the sensor has depth at {stats.sensor:.0%} of the pixels{f'; its {guess}' if guess else ''}."
    if stats.error is None:
        blamed = bool(check.findings) and stats.no_answer > _MIN_REASON_SHARE
        reason = str(check.findings[0]) if blamed else _explain_silence(stats)
        return [sensor, f"Nothing was recovered: {reason}."]
    amount = f"Recovered {stats.pixels:,.0f} pixels per frame without sensor depth, from {stats.near:.1f} m to"
    frames = f"({format_count(stats.frames, 'frame')})"
    return [sensor, f"{amount} {stats.far:.1f} m, median sigma {stats.error:.1%} of the depth {frames}."]


def describe_check(check: CaptureCheck) -> list[str]:
    """Sentences of the page on what was assumed and on the findings."""
    assumed = [f"{check.assumed_unit[:1].upper()}{check.assumed_unit[1:]}."] if check.assumed_unit else []
    return [*assumed, *(f"Warning: {finding}." for finding in check.findings)]


def describe_placing(check: CaptureCheck, recording: Recording, placed: Recording) -> list[str]:
    """Sentence on how the map is joined where the capture's poses are not used; none where they are."""
    if recording.poses is not None or placed.poses is None:
        return []
    n = int(placed.poses.t.isfinite().all(-1).sum())
    why = "the stated poses are refuted" if check.poses_refuted else "the capture has no poses"
    return [f"The map is joined by the motion that near returns give ({format_count(n, 'frame')}): {why}."]


def build_opening(sentences: Sequence[str], stats: RecoveryStats, picture: bytes, caption: str) -> PageOpening:
    """The opening of the page; ``picture`` is the PNG of the contact sheet."""
    shown = {"Recovered pixels per frame": f"{stats.pixels:,.0f}"}
    if stats.error is not None:
        shown |= {"Recovered depth range": f"{stats.near:.1f} – {stats.far:.1f} m"}
        shown |= {"Median sigma / depth": f"{stats.error:.1%}"}
    fractions = {"Sensor": stats.sensor, "Recovered": stats.recovered, "No answer": stats.no_answer}
    shown |= {f"{kind}, fraction of the pixels": f"{share:.1%}" for kind, share in fractions.items()}
    listed = [
        f"{reasons.describe_gate(name)} ({share:.1%} of the pixels)"
        for name, share in stats.reasons
        if share >= _MIN_REASON_SHARE
    ]
    reason_lines = (
        [f"Most frequent reasons for no answer: {'; '.join(listed[:_MAX_LISTED_REASONS])}."] if listed else []
    )
    return PageOpening(shown, [*sentences, *reason_lines], picture, caption)


def _explain_silence(stats: RecoveryStats) -> str:
    """Most frequent reason for missing answers that has a remedy."""
    for name, share in stats.reasons:
        if share > 0.01 and (remedy := reasons.suggest_remedy(name)) is not None:
            return remedy
    return "the sensor has depth almost everywhere; cutoff=2.0 hides far returns to show what other views recover"
