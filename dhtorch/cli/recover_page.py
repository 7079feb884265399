"""Statistics of ``dhtorch PATH``, their printed sentences, and the opening of the viewer page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from dhtorch.cli import completed_folder as completed
from dhtorch.cli import gate_messages as reasons
from dhtorch.cli.completed_folder import CompletionTask
from dhtorch.codes import SOURCES_OF_KIND, Source, is_recovered, words
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.recording import Recording
from dhtorch.geometry import se3
from dhtorch.runtime.console import format_count
from dhtorch.validation.capture_check import MAX_EXPLAINED_LOSS, CaptureCheck
from dhtorch.validation.pose_check import MAX_UNEXPLAINED_DISAGREEMENT, PoseCheck
from dhtorch.viz.viewer.exhibit import PageOpening

#: Maximum number of frames read for depth range and stated error; further frames show the same surfaces.
_MAX_MEASURED_FRAMES = 40

#: Frames whose returns determine the median return. They bound the time of the summary.
_RETURN_FRAMES = 8

#: Ratio of baseline to depth, and of that ratio to the angle of rotation in rad, below which stated poses have too
#: small a baseline. Source: chosen: a tenth of the advised ratio; above 0.12 to 0.18 of ``tum_fr1_rpy_a``, which turns,
#: and the 0.13 below which ``stages.shared_error.verify_views`` withholds a view.
_MIN_BASELINE_RATIO, _MIN_BASELINE_PER_TURN = 0.01, 0.2

#: Reasons for missing answers listed on the page, the most frequent.
_MAX_LISTED_REASONS = 3

#: Smallest fraction of the pixels of a listed reason.
_MIN_REASON_SHARE = 0.005


class StatedMotion(NamedTuple):
    """Motion of the stated poses from completed frames to their farthest source views, medians over frames."""

    baseline: float  # m
    turn: float  # rad
    depth: float  # m, median return


@dataclass(frozen=True)
class RecoveryStats:
    """Statistics of the completed frames of one recording; fractions are of all their pixels."""

    frames: int
    fractions: Mapping[str, float]  # by kind, see codes.SOURCES_OF_KIND
    pixels: Mapping[str, float]  # per frame, by kind
    reasons: tuple[tuple[str, float], ...]  # gate names and fractions of all pixels, the largest first
    near: float | None = None  # m; 2 % and 98 % percentile of recovered depth; None = nothing recovered
    far: float | None = None
    error: float | None = None  # median stated sigma / depth of the recovered pixels
    motion: StatedMotion | None = None  # where nothing was recovered and poses are stated


def measure_recovery(task: CompletionTask, frames: Sequence[int]) -> RecoveryStats:
    """Statistics of complete frames."""
    rows = [task.done[task.name(i)] for i in frames]
    counts = [completed.count_pixels(row) for row in rows]
    fractions = {kind: float(np.mean([n[kind] / sum(n.values()) for n in counts])) for kind in SOURCES_OF_KIND}
    pixels = {kind: sum(n[kind] for n in counts) / len(counts) for kind in SOURCES_OF_KIND}
    average: dict[str, float] = {}  # fraction of unanswered pixels by reason
    for row in rows:
        for name, share in row["no_answer"].items():
            average[name] = average.get(name, 0.0) + share / len(rows)
    reasons = tuple(sorted(average.items(), key=lambda item: -item[1]))
    stats = RecoveryStats(len(rows), fractions, pixels, reasons)
    depths, ratios = [], []
    for i in frames[:_MAX_MEASURED_FRAMES]:
        maps, source = completed.read_completed_maps(task, i)
        recovered = is_recovered(source) & (maps["depth"] > 0)
        depths.append(maps["depth"][recovered])
        ratios.append(maps["sigma"][recovered] / maps["depth"][recovered])
    depth = np.concatenate(depths)
    if not len(depth):
        return replace(stats, motion=_measure_stated_motion(task, frames))
    near, far = np.percentile(depth, (2, 98)).tolist()
    return replace(stats, near=near, far=far, error=float(np.median(np.concatenate(ratios))))


def measure_median_return(task: CompletionTask, frames: Sequence[int]) -> float | None:
    """Median over some frames of the median sensor depth, m; None where no completed frame has a return."""
    medians = []
    for i in frames[:_RETURN_FRAMES]:
        maps, source = completed.read_completed_maps(task, i)
        returns = maps["depth"][(source == Source.SENSOR) & (maps["depth"] > 0)]
        medians += [float(np.median(returns))] if len(returns) else []
    return float(np.median(medians)) if medians else None


def _measure_stated_motion(task: CompletionTask, frames: Sequence[int]) -> StatedMotion | None:
    """Motion of the stated poses between completed frames and their source views; None without poses or returns."""
    poses, depth = task.recording.poses, measure_median_return(task, frames)
    if poses is None or depth is None:
        return None
    position = {int(number): k for k, number in enumerate(task.recording.number)}
    motions = []
    for i in frames:
        views = [position[number] for number in task.done[task.name(i)]["views"]]
        if views:
            baselines = (poses.t[views] - poses.t[i]).norm(dim=-1)
            turns = se3.rotation_angle(poses.R[views].mT @ poses.R[i])
            motions.append((float(baselines[k := int(baselines.argmax())]), float(turns[k])))
    if not motions:
        return None
    baseline, turn = np.median(motions, 0).tolist()
    return StatedMotion(baseline, turn, depth)


def describe_recovery(
    task: CompletionTask, stats: RecoveryStats, hw: tuple[int, int], check: CaptureCheck
) -> list[str]:
    """Printed sentences: the capture (images (h, w)), and what was recovered, else what its check shows."""
    recording, (h, w) = task.recording, hw
    kind = f"{task.scene.name}: a {recording.format} capture, {format_count(len(recording), 'frame')} of {w}x{h}"
    filled = f"{stats.pixels['filled']:,.0f}" if stats.fractions["filled"] else ""
    guess = intrinsics_options.find_guess_report(recording.report)
    sensor = f"{kind}; the sensor has depth at {stats.fractions['sensor']:.0%} of the pixels"
    sensor += f"; its {guess}." if guess else "."
    if stats.error is None:
        blamed = bool(check.findings) and stats.fractions["no_answer"] > _MIN_REASON_SHARE
        reason = str(check.findings[0]) if blamed else _explain_silence(stats, check.poses)
        also = f" Filled {filled} pixels per frame by interpolation." if filled else ""
        return [sensor, f"Nothing was recovered: {reason}.{also}"]
    amount = f"Recovered {stats.pixels['recovered']:,.0f} pixels per frame from other views, at {stats.near:.1f} m to"
    amount += f" {stats.far:.1f} m, median sigma {stats.error:.1%} of the depth"
    amount += f"; filled {filled} by interpolation" if filled else ""
    return [sensor, f"{amount} ({format_count(stats.frames, 'frame')})."]


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
    shown = {"Recovered pixels per frame": f"{stats.pixels['recovered']:,.0f}"}
    if stats.error is not None:
        shown["Recovered, median sigma / depth"] = f"{stats.error:.1%}"
    for kind, fraction in stats.fractions.items():
        shown[f"{words(kind).capitalize()}, fraction of the pixels"] = f"{fraction:.1%}"
    listed = [
        f"{reasons.describe_gate(name)} ({share:.1%} of the pixels)"
        for name, share in stats.reasons
        if share >= _MIN_REASON_SHARE
    ]
    reason_lines = (
        [f"Most frequent reasons for no answer: {'; '.join(listed[:_MAX_LISTED_REASONS])}."] if listed else []
    )
    return PageOpening(shown, [*sentences, *reason_lines], picture, caption)


def _explain_silence(stats: RecoveryStats, poses: PoseCheck | None) -> str:
    """Most frequent reason for missing answers that has a remedy."""
    for name, share in stats.reasons:
        if share > 0.01 and (remedy := reasons.suggest_remedy(name)) is not None:
            if name == "no_baseline" and stats.motion is not None:
                return _explain_no_baseline(stats.motion, poses)
            return remedy
    return "the sensor has depth almost everywhere; cutoff=2.0 hides far returns to show what other views recover"


def _explain_no_baseline(motion: StatedMotion, poses: PoseCheck | None) -> str:
    """Why near returns show no translation although poses are stated: what these and the check of the capture show."""
    ratio = motion.baseline / motion.depth
    moved = f"the stated poses move by {motion.baseline:.2g} m between views, {ratio:.1%} of the median depth"
    if ratio < max(_MIN_BASELINE_RATIO, _MIN_BASELINE_PER_TURN * motion.turn):
        turned = f"and turn by {math.degrees(motion.turn):.0f} degrees"
        return f"{moved}, {turned}; moving sideways by a tenth of the distance would help"
    unexplained = f"{moved}, which the near returns do not show; more texture, and returns nearby, would help"
    if poses is None:
        return unexplained
    if poses.surfaces.stated > MAX_UNEXPLAINED_DISAGREEMENT:
        disagreement = f"{poses.surfaces.stated:.1%} of the depth"
        return f"{moved}, but poses and depth disagree by {disagreement}: one of them is wrong or noisy"
    if poses.tracks is None:
        return f"{moved}, but too few near returns were tracked; slower motion, more light and texture would help"
    if poses.tracks.stated > MAX_EXPLAINED_LOSS:
        loss = f"near returns miss their tracks: mean loss {poses.tracks.stated:.2f} of 1"
        return f"{moved}, but depth and images do not fit each other ({loss}); see K, and whether one was resized"
    return unexplained
