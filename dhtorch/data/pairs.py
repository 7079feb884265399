"""Which two frames make a pair: by frame gap, by time, or by baseline.

A pair is (i, j), positions in the recording with i < j; i is the anchor whose depth is extended. Gaps are counted in
the capture's own frame numbers: where a frame was lost the pairs that need it are missing, the others do not shift.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from dhtorch.data.recording import Recording
from dhtorch.data.scene import Given, Scene

#: From this many frames on, neighbouring anchors are nearly the same picture: take every other one.
_MANY = 25


def by_gap(scene: Given, gap: int | None = None, stride: int | None = None) -> list[tuple[int, int]]:
    """Pairs whose frame numbers differ by ``gap``.

    Args:
        scene: its recording's frames.
        gap: step in frames. None = the scene's own.
        stride: step from anchor to anchor. None = 2 where there are 25 frames or more, else 1.

    Raises:
        ValueError: no gap given and none known, gap or stride below 1, or no two frames that far apart.
    """
    scene = Scene.of(scene)
    recording, gap = scene.recording, scene.gap if gap is None else gap
    if gap is None:
        raise ValueError(f"pairs.gap: {recording.name} knows no gap of its own, expected a number of frames")
    gap = _positive_int("pairs.gap", gap)
    number = recording.number.tolist()
    if gap > number[-1] - number[0]:
        span = f"{len(number)} frames ({recording.name}, frame numbers {number[0]} to {number[-1]})"
        raise ValueError(f"pairs.gap: found {gap} for {span}, expected at most {number[-1] - number[0]}")
    place = {k: i for i, k in enumerate(number)}
    anchors = range(0, len(number), _stride(recording, stride))
    return _some([(i, place[number[i] + gap]) for i in anchors if number[i] + gap in place], recording, f"gap {gap}")


def by_time(
    scene: Given, seconds: float, tolerance: float | None = None, stride: int | None = None
) -> list[tuple[int, int]]:
    """Pairs whose stamps differ by ``seconds``, give or take ``tolerance``; the closest frame counts.

    Args:
        scene: its recording's frames; needs time stamps.
        seconds: time from anchor to partner.
        tolerance: s. None = half the median step from frame to frame.
        stride: step from anchor to anchor. None = 2 where there are 25 frames or more, else 1.

    Raises:
        ValueError: no time stamps, seconds not positive, tolerance negative, or no two frames that far apart.
    """
    recording = Scene.of(scene).recording
    if recording.times is None:
        raise ValueError(f"pairs.seconds: {recording.name} has no time stamps, expected a recording with them")
    _positive("pairs.seconds", seconds)
    step = float(recording.times.diff().median()) if len(recording) > 1 else 0.0
    tolerance = _not_negative("pairs.tolerance", step / 2 if tolerance is None else tolerance)
    pairs = []
    for i in range(0, len(recording), _stride(recording, stride)):
        miss = (recording.times[i + 1 :] - recording.times[i] - seconds).abs()
        if miss.numel() and float(miss.min()) <= tolerance:
            pairs.append((i, i + 1 + int(miss.argmin())))
    return _some(pairs, recording, f"{seconds} s ± {tolerance:g} s")


def by_baseline(
    scene: Given, metres: float, tolerance: float | None = None, stride: int | None = None
) -> list[tuple[int, int]]:
    """Pairs whose camera centres lie ``metres`` apart, give or take ``tolerance``; the earliest such frame counts.

    The earliest, because a camera that comes back later has seldom the same view.

    Args:
        scene: its recording's frames; needs poses.
        metres: distance of the two camera centres.
        tolerance: m. None = a quarter of ``metres``.
        stride: step from anchor to anchor. None = 2 where there are 25 frames or more, else 1.

    Raises:
        ValueError: no poses, metres not positive, tolerance negative, or no two frames that far apart.
    """
    recording = Scene.of(scene).recording
    if recording.poses is None:
        raise ValueError(f"pairs.metres: {recording.name} has no poses, expected a recording with them")
    _positive("pairs.metres", metres)
    tolerance = _not_negative("pairs.tolerance", metres / 4 if tolerance is None else tolerance)
    centre = recording.poses.t
    pairs = []
    for i in range(0, len(recording), _stride(recording, stride)):
        good = ((centre[i + 1 :] - centre[i]).norm(dim=-1) - metres).abs() <= tolerance
        if bool(good.any()):
            pairs.append((i, i + 1 + int(torch.nonzero(good)[0])))
    return _some(pairs, recording, f"{metres} m ± {tolerance:g} m")


def by_scaled_gap(scene: Given, factor: float, stride: int | None = None) -> list[tuple[int, int]]:
    """Pairs at ``factor`` times the scene's own gap, rounded, at least one frame; none where it is too short.

    Raises:
        ValueError: no gap known, factor not positive, or stride below 1.
    """
    scene = Scene.of(scene)
    recording = scene.recording
    if scene.gap is None:
        raise ValueError(f"pairs.factor: {recording.name} knows no gap of its own, expected one with a gap")
    gap = max(1, int(_positive("pairs.factor", factor) * scene.gap + 0.5))
    span = int(recording.number[-1] - recording.number[0])
    try:
        return by_gap(scene, gap, stride) if gap <= span else []
    except ValueError:  # frames were lost: no two of those left are that far apart
        return []


#: Steps from an anchor, in frames, to those around it that are offered to a method which chooses for itself.
LADDER = (1, 2, 3, 5, 8, 12, 20, 30)


def around(recording: Recording, i: int, steps: Sequence[int] = LADDER) -> list[int]:
    """Positions of frames before and after ``i`` among which a method may choose its other views, in rising order.

    Steps count in the capture's own frame numbers; a frame that was lost is left out. A recording that is shorter than
    the longest step offers what it has, and one of two frames the other one.

    Raises:
        ValueError: no such frame, or the recording has no other.
    """
    number = recording.number.tolist()
    if not 0 <= i < len(number):
        raise ValueError(f"pairs: found frame {i} of {recording.name}, expected 0 to {len(number) - 1}")
    place = {k: p for p, k in enumerate(number)}
    offered = sorted(place[k] for s in steps for k in (number[i] - s, number[i] + s) if k in place)
    if not offered and len(number) > 1:
        offered = [min((p for p in range(len(number)) if p != i), key=lambda p: abs(number[p] - number[i]))]
    if not offered:
        raise ValueError(f"pairs: {recording.name} has one frame, expected two at least")
    return offered


def between(i: int, j: int, views: int) -> list[int]:
    """``views`` different positions spread evenly over the way from ``i`` to ``j``: ``j`` is the last, ``i`` no part.

    Raises:
        ValueError: there are not that many.
    """
    if not 1 <= views <= j - i:
        raise ValueError(f"views: found {views} for frames {i} to {j}, expected 1 to {j - i}")
    return [i + round((j - i) * (k + 1) / views) for k in range(views)]


def _stride(recording: Recording, stride: int | None) -> int:
    if stride is None:
        return 2 if len(recording) >= _MANY else 1
    return _positive_int("pairs.stride", stride)


def _some(pairs: list[tuple[int, int]], recording: Recording, wanted: str) -> list[tuple[int, int]]:
    if not pairs:
        found = f"no two of {len(recording)} frames of {recording.name}"
        raise ValueError(f"pairs: found {found} at {wanted}, expected at least one pair")
    return pairs


def _positive_int(name: str, value: int) -> int:
    if isinstance(value, bool) or int(value) != value or value < 1:
        raise ValueError(f"{name}: found {value}, expected a whole number of at least 1")
    return int(value)


def _positive(name: str, value: float) -> float:
    if not 0 < value < float("inf"):
        raise ValueError(f"{name}: found {value}, expected a positive number")
    return value


def _not_negative(name: str, value: float) -> float:
    if not 0 <= value < float("inf"):
        raise ValueError(f"{name}: found {value}, expected 0 or more")
    return value
