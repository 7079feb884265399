"""What a reference view may see: one other frame, by frame gap, by time or by baseline; or several, to choose among.

Positions are those in the recording; the reference view is the frame whose depth is extended. Gaps and steps are
counted in the capture's own frame numbers: where a frame was lost the pairs that need it are missing, the others do not
shift.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import torch

from dhtorch.data.recording import Recording
from dhtorch.data.rig import Rig
from dhtorch.data.scene import Scene, SceneLike
from dhtorch.runtime.console import format_count

#: From this many frames on, neighbouring reference views are nearly the same picture: take every other one.
_MANY_FRAMES = 25

#: Steps from a reference view, in frames, to those around it that are offered to a method which chooses for itself.
CANDIDATE_STEPS = (1, 2, 3, 5, 8, 12, 20, 30)


class Pair(NamedTuple):
    """A reference view and what it may see: one other frame, or several among which the method chooses.

    Equal to the plain tuple ``(i, j)`` or ``(i, (k1, k2, …))``, which ``Pair(*item)`` reads.
    """

    reference: int
    other: int | tuple[int, ...]

    @property
    def offered(self) -> tuple[int, ...]:
        """The frames to choose among, in rising order; none where the other frame is fixed."""
        return () if isinstance(self.other, int) else tuple(self.other)


def to_fixed_pairs(pairs: Iterable[Sequence[int]] | Iterable[Pair]) -> list[tuple[int, int]]:
    """The pairs as (i, j), for what cannot let a method choose.

    Raises:
        ValueError: frames to choose among.
    """
    found = []
    for i, j in pairs:
        if not isinstance(j, int):
            raise ValueError(
                f"pairs: found {len(j)} frames to choose among (pairs=auto), expected one: pairs=gap, time or baseline"
            )
        found.append((i, j))
    return found


def by_choice(
    scene: SceneLike, steps: Sequence[int] = CANDIDATE_STEPS, stride: int | None = None, past: bool = False
) -> list[Pair]:
    """Every reference view with the frames around it, among which a method chooses: nobody has to know a gap.

    Args:
        scene: its recording's frames.
        steps: how far before and after the reference view frames are offered, see :func:`candidate_frames`.
        stride: step from reference view to reference view. None = 2 where there are 25 frames or more, else 1.
        past: only frames before the reference view; the first frame is none then.

    Raises:
        ValueError: one frame alone, no steps or one below 1, stride below 1, or no reference view.
    """
    recording = Scene.of(scene).recording
    number = recording.number.tolist()
    if len(number) < 2:
        raise ValueError(f"pairs: {recording.name} has one frame, expected two at least")
    steps, place = _check_steps(steps), {k: p for p, k in enumerate(number)}
    references = [i for i in range(0, len(number), _choose_stride(recording, stride)) if i > 0 or not past]
    pairs = [Pair(i, tuple(_candidates_of_numbers(number, place, i, steps, past))) for i in references]
    return _require_pairs(pairs, recording, f"stride {stride}, past frames alone")


def by_gap(scene: SceneLike, gap: int | None = None, stride: int | None = None) -> list[Pair]:
    """Pairs whose frame numbers differ by ``gap``.

    Args:
        scene: its recording's frames.
        gap: step in frames. None = the scene's own.
        stride: step from reference view to reference view. None = 2 where there are 25 frames or more, else 1.

    Raises:
        ValueError: no gap given and none known, gap or stride below 1, or no two frames that far apart.
    """
    scene = Scene.of(scene)
    recording, gap = scene.recording, scene.gap if gap is None else gap
    if gap is None:
        raise ValueError(f"pairs.gap: {recording.name} knows no gap of its own, expected a number of frames")
    gap = _check_positive_int("pairs.gap", gap)
    number = recording.number.tolist()
    if gap > number[-1] - number[0]:
        span = f"{format_count(len(number), 'frame')} ({recording.name}, frame numbers {number[0]} to {number[-1]})"
        raise ValueError(f"pairs.gap: found {gap} for {span}, expected at most {number[-1] - number[0]}")
    place = {k: i for i, k in enumerate(number)}
    references = range(0, len(number), _choose_stride(recording, stride))
    pairs = [Pair(i, place[number[i] + gap]) for i in references if number[i] + gap in place]
    return _require_pairs(pairs, recording, f"gap {gap}")


def by_time(scene: SceneLike, seconds: float, tolerance: float | None = None, stride: int | None = None) -> list[Pair]:
    """Pairs whose stamps differ by ``seconds``, give or take ``tolerance``; the closest frame counts.

    Args:
        scene: its recording's frames; needs time stamps.
        seconds: time from reference view to source view.
        tolerance: s. None = half the median step from frame to frame.
        stride: step from reference view to reference view. None = 2 where there are 25 frames or more, else 1.

    Raises:
        ValueError: no time stamps, seconds not positive, tolerance negative, or no two frames that far apart.
    """
    recording = Scene.of(scene).recording
    if recording.times is None:
        raise ValueError(f"pairs.seconds: {recording.name} has no time stamps, expected a recording with them")
    _check_positive("pairs.seconds", seconds)
    step = float(recording.times.diff().median()) if len(recording) > 1 else 0.0
    tolerance = _check_not_negative("pairs.tolerance", step / 2 if tolerance is None else tolerance)
    pairs = []
    for i in range(0, len(recording), _choose_stride(recording, stride)):
        miss = (recording.times[i + 1 :] - recording.times[i] - seconds).abs()
        if miss.numel() and float(miss.min()) <= tolerance:
            pairs.append(Pair(i, i + 1 + int(miss.argmin())))
    return _require_pairs(pairs, recording, f"{seconds} s ± {tolerance:g} s")


def by_baseline(
    scene: SceneLike, metres: float, tolerance: float | None = None, stride: int | None = None
) -> list[Pair]:
    """Pairs whose camera centres lie ``metres`` apart, give or take ``tolerance``; the earliest such frame counts.

    The earliest, because a camera that comes back later has seldom the same view.

    Args:
        scene: its recording's frames; needs poses.
        metres: distance of the two camera centres.
        tolerance: m. None = a quarter of ``metres``.
        stride: step from reference view to reference view. None = 2 where there are 25 frames or more, else 1.

    Raises:
        ValueError: no poses, metres not positive, tolerance negative, or no two frames that far apart.
    """
    recording = Scene.of(scene).recording
    if recording.poses is None:
        raise ValueError(f"pairs.metres: {recording.name} has no poses, expected a recording with them")
    _check_positive("pairs.metres", metres)
    tolerance = _check_not_negative("pairs.tolerance", metres / 4 if tolerance is None else tolerance)
    centre = recording.poses.t
    pairs = []
    for i in range(0, len(recording), _choose_stride(recording, stride)):
        good = ((centre[i + 1 :] - centre[i]).norm(dim=-1) - metres).abs() <= tolerance
        if bool(good.any()):
            pairs.append(Pair(i, i + 1 + int(torch.nonzero(good)[0])))
    return _require_pairs(pairs, recording, f"{metres} m ± {tolerance:g} m")


def by_cameras(
    scene: SceneLike,
    instants: Sequence[int] = (0,),
    reference: str | None = None,
    stride: int | None = None,
    past: bool = False,
) -> list[Pair]:
    """Every reference view of a rig with what its other cameras saw: at the same instant, and ``instants`` away.

    Where one is not 0 the reference view's own camera is offered, too: views in space and in time. One frame alone is a
    fixed pair, several are offered to the method.

    Args:
        scene: its recording is a :class:`dhtorch.data.rig.Rig`.
        instants: how many instants from the reference view to those offered; 0 = the same.
        reference: name of the camera whose depth is extended. None = all.
        stride: step from reference view to reference view, in instants. None = 2 where there are 25 or more, else 1.
        past: only instants up to the reference view's.

    Raises:
        ValueError: one camera alone, an unknown one, instants below 0, or no pair.
    """
    recording = Scene.of(scene).recording
    if not isinstance(recording, Rig):
        expected = "several cameras as one recording (data=rig, dhtorch.data.rig.join_cameras)"
        raise ValueError(f"pairs=cameras: {recording.name} is one camera, expected {expected}")
    if reference is not None and reference not in recording.cameras:
        raise ValueError(f"pairs.anchor: found {reference}, expected one of {', '.join(recording.cameras)}")
    if not instants or any(isinstance(s, bool) or int(s) != s or s < 0 for s in instants):
        raise ValueError(f"pairs.instants: found {list(instants)}, expected whole numbers of at least 0")
    C, n = len(recording.cameras), len(recording) // len(recording.cameras)
    chosen = range(C) if reference is None else [recording.cameras.index(reference)]
    every = (2 if n >= _MANY_FRAMES else 1) if stride is None else _check_positive_int("pairs.stride", stride)
    pairs = []
    for k in range(0, n, every):
        near = {k + way * s for s in instants for way in ((-1,) if past else (-1, 1)) if 0 <= k + way * s < n}
        for c in chosen:
            offered = sorted(q * C + d for q in near for d in range(C) if (q, d) != (k, c))
            if offered:
                pairs.append(Pair(k * C + c, offered[0] if len(offered) == 1 else tuple(offered)))
    return _require_pairs(pairs, recording, f"instants {list(instants)}")


def by_scaled_gap(scene: SceneLike, factor: float, stride: int | None = None) -> list[Pair]:
    """Pairs at ``factor`` times the scene's own gap, rounded, at least one frame; none where it is too short.

    Raises:
        ValueError: no gap known, factor not positive, or stride below 1.
    """
    scene = Scene.of(scene)
    recording = scene.recording
    if scene.gap is None:
        raise ValueError(f"pairs.factor: {recording.name} knows no gap of its own, expected one with a gap")
    gap = max(1, int(_check_positive("pairs.factor", factor) * scene.gap + 0.5))
    span = int(recording.number[-1] - recording.number[0])
    try:
        return by_gap(scene, gap, stride) if gap <= span else []
    except ValueError:  # frames were lost: no two of those left are that far apart
        return []


def candidate_frames(
    recording: Recording, i: int, steps: Sequence[int] = CANDIDATE_STEPS, past: bool = False
) -> list[int]:
    """Positions of frames before and after ``i`` among which a method may choose its other views, in rising order.

    Steps count in the capture's own frame numbers; a frame that was lost is left out. A recording that is shorter than
    the longest step offers what it has, and where no step fits the nearest frame is offered. ``past``: frames before
    ``i`` alone.

    Raises:
        ValueError: no such frame, no steps or one below 1, or no other frame.
    """
    number = recording.number.tolist()
    if not 0 <= i < len(number):
        raise ValueError(f"pairs: found frame {i} of {recording.name}, expected 0 to {len(number) - 1}")
    offered = _candidates_of_numbers(number, {k: p for p, k in enumerate(number)}, i, _check_steps(steps), past)
    if not offered:
        found, expected = ("nothing before frame 0", "a later one") if past else ("one frame", "two at least")
        raise ValueError(f"pairs: {recording.name} has {found}, expected {expected}")
    return offered


def spaced_frames(i: int, j: int, views: int) -> list[int]:
    """``views`` different positions spread evenly over the way from ``i`` to ``j``: ``j`` is the last, ``i`` no part.

    Raises:
        ValueError: there are not that many. One alone is ``j``, wherever it lies.
    """
    if views == 1 and i != j:
        return [j]
    if not 1 <= views <= j - i:
        raise ValueError(f"views: found {views} for frames {i} to {j}, expected 1 to {j - i}")
    return [i + round((j - i) * (k + 1) / views) for k in range(views)]


def _candidates_of_numbers(
    number: Sequence[int], place: Mapping[int, int], i: int, steps: Sequence[int], past: bool
) -> list[int]:
    """:func:`candidate_frames`, of frame numbers whose places are known; empty where there is no other frame."""
    ways = (-1,) if past else (-1, 1)
    offered = sorted(place[k] for s in steps for k in (number[i] + way * s for way in ways) if k in place)
    if offered:
        return offered
    others = [p for p in (i - 1, i + 1) if 0 <= p < len(number) and (p < i or not past)]
    return [min(others, key=lambda p: abs(number[p] - number[i]))] if others else []


def _check_steps(steps: Sequence[int]) -> list[int]:
    if not steps:
        raise ValueError("pairs.steps: found none, expected whole numbers of at least 1")
    return sorted({_check_positive_int("pairs.steps", step) for step in steps})


def _choose_stride(recording: Recording, stride: int | None) -> int:
    if stride is None:
        return 2 if len(recording) >= _MANY_FRAMES else 1
    return _check_positive_int("pairs.stride", stride)


def _require_pairs(pairs: list[Pair], recording: Recording, wanted: str) -> list[Pair]:
    if not pairs:
        found = f"no two of {format_count(len(recording), 'frame')} of {recording.name}"
        raise ValueError(f"pairs: found {found} at {wanted}, expected at least one pair")
    return pairs


def _check_positive_int(name: str, value: int) -> int:
    if isinstance(value, bool) or int(value) != value or value < 1:
        raise ValueError(f"{name}: found {value}, expected a whole number of at least 1")
    return int(value)


def _check_positive(name: str, value: float) -> float:
    if not 0 < value < float("inf"):
        raise ValueError(f"{name}: found {value}, expected a positive number")
    return value


def _check_not_negative(name: str, value: float) -> float:
    if not 0 <= value < float("inf"):
        raise ValueError(f"{name}: found {value}, expected 0 or more")
    return value
