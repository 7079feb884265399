"""Pairs of a recording: a reference view with one source view (by gap, time, baseline) or with candidates.

Indices are positions in the recording; the reference view is the frame whose depth is extended. Gaps and steps count in
the capture's own frame numbers: where a frame was lost the pairs that need it are missing and the others do not shift.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import torch

from dhtorch.data.recording import Recording
from dhtorch.data.rig import Rig
from dhtorch.data.scene import Scene, SceneLike
from dhtorch.runtime.console import format_count

#: From this many frames on every second frame is a reference view: neighbouring ones show nearly the same picture.
_MANY_FRAMES = 25

#: Distances in frames from a reference view to its candidate source views, before and after it.
CANDIDATE_STEPS = (1, 2, 3, 5, 8, 12, 20, 30)


class Pair(NamedTuple):
    """A reference view with one source view, or several candidates among which the method selects.

    Equal to the plain tuple ``(i, j)`` or ``(i, (k1, k2, …))``, which ``Pair(*item)`` reads.
    """

    reference: int
    other: int | tuple[int, ...]

    @property
    def candidates(self) -> tuple[int, ...]:
        """The candidate source views in rising order; empty where the source view is fixed."""
        return () if isinstance(self.other, int) else tuple(self.other)


def to_fixed_pairs(pairs: Iterable[Sequence[int]] | Iterable[Pair]) -> list[tuple[int, int]]:
    """The pairs as tuples (i, j), for callers without view selection.

    Raises:
        ValueError: a pair with candidates instead of one source view.
    """
    fixed = []
    for i, j in pairs:
        if not isinstance(j, int):
            raise ValueError(
                f"pairs: found {len(j)} candidate frames (pairs=auto), "
                "expected one source view (pairs=gap, time or baseline)"
            )
        fixed.append((i, j))
    return fixed


def by_choice(
    scene: SceneLike, steps: Sequence[int] = CANDIDATE_STEPS, stride: int | None = None, past: bool = False
) -> list[Pair]:
    """Every reference view with the frames around it as candidates, among which a method selects its source views.

    Args:
        scene: its recording's frames.
        steps: distances of the candidates before and after the reference view, see :func:`candidate_frames`.
        stride: step from reference view to reference view. None = 2 where there are 25 frames or more, else 1.
        past: only frames before the reference view; the first frame is then no reference view.

    Raises:
        ValueError: a single frame, no steps or one below 1, stride below 1, or no reference view.
    """
    recording = Scene.of(scene).recording
    number = recording.number.tolist()
    if len(number) < 2:
        raise ValueError(f"pairs: {recording.name} has one frame, expected two at least")
    steps, place = _check_steps(steps), {k: p for p, k in enumerate(number)}
    references = [i for i in range(0, len(number), _choose_stride(recording, stride)) if i > 0 or not past]
    pairs = [Pair(i, tuple(_candidates_of_numbers(number, place, i, steps, past))) for i in references]
    return _require_pairs(pairs, recording, f"stride {stride}, past frames only")


def by_gap(scene: SceneLike, gap: int | None = None, stride: int | None = None) -> list[Pair]:
    """Pairs whose frame numbers differ by ``gap``.

    Args:
        scene: its recording's frames.
        gap: step in frames. None = the scene's own.
        stride: step from reference view to reference view. None = 2 where there are 25 frames or more, else 1.

    Raises:
        ValueError: neither ``gap`` nor the scene's own gap, gap or stride below 1, or no two frames that far apart.
    """
    scene = Scene.of(scene)
    recording, gap = scene.recording, scene.gap if gap is None else gap
    if gap is None:
        raise ValueError(f"pairs.gap: {recording.name} has no gap of its own, expected a number of frames")
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
    """Pairs whose time stamps differ by ``seconds`` ± ``tolerance``; the closest frame is taken.

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
    """Pairs whose camera centres are ``metres`` ± ``tolerance`` apart; the earliest such frame is taken.

    The earliest, because a camera that returns later seldom has the same view.

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
    """Every reference view of a rig with frames of its other cameras, at the same instant and ``instants`` away.

    At instants other than 0 the reference view's own camera is a candidate too: views in space and in time. A single
    frame gives a fixed pair, several are candidates.

    Args:
        scene: its recording is a :class:`dhtorch.data.rig.Rig`.
        instants: distances of the candidates from the reference view, in instants; 0 = the same instant.
        reference: name of the camera whose depth is extended. None = all.
        stride: step from reference view to reference view, in instants. None = 2 where there are 25 or more, else 1.
        past: only instants up to the reference view's.

    Raises:
        ValueError: a single camera, an unknown camera, instants below 0, or no pair.
    """
    recording = Scene.of(scene).recording
    if not isinstance(recording, Rig):
        expected = "several cameras as one recording (data=rig, dhtorch.data.rig.join_cameras)"
        raise ValueError(f"pairs=cameras: {recording.name} is one camera, expected {expected}")
    if reference is not None and reference not in recording.cameras:
        raise ValueError(f"pairs.reference: found {reference}, expected one of {', '.join(recording.cameras)}")
    if not instants or any(isinstance(s, bool) or int(s) != s or s < 0 for s in instants):
        raise ValueError(f"pairs.instants: found {list(instants)}, expected whole numbers of at least 0")
    C, n = len(recording.cameras), len(recording) // len(recording.cameras)
    chosen = range(C) if reference is None else [recording.cameras.index(reference)]
    step = (2 if n >= _MANY_FRAMES else 1) if stride is None else _check_positive_int("pairs.stride", stride)
    pairs = []
    for k in range(0, n, step):
        near = {k + sign * s for s in instants for sign in ((-1,) if past else (-1, 1)) if 0 <= k + sign * s < n}
        for c in chosen:
            candidates = sorted(q * C + d for q in near for d in range(C) if (q, d) != (k, c))
            if candidates:
                pairs.append(Pair(k * C + c, candidates[0] if len(candidates) == 1 else tuple(candidates)))
    return _require_pairs(pairs, recording, f"instants {list(instants)}")


def by_scaled_gap(scene: SceneLike, factor: float, stride: int | None = None) -> list[Pair]:
    """Pairs at ``factor`` times the scene's own gap, rounded, at least one frame; none if the recording is too short.

    Raises:
        ValueError: the scene has no gap, factor not positive, or stride below 1.
    """
    scene = Scene.of(scene)
    recording = scene.recording
    if scene.gap is None:
        raise ValueError(f"pairs.factor: {recording.name} has no gap of its own, expected a scene with a gap")
    gap = max(1, int(_check_positive("pairs.factor", factor) * scene.gap + 0.5))
    span = int(recording.number[-1] - recording.number[0])
    try:
        return by_gap(scene, gap, stride) if gap <= span else []
    except ValueError:  # frames were lost: no two of the remaining ones are that far apart
        return []


def candidate_frames(
    recording: Recording, i: int, steps: Sequence[int] = CANDIDATE_STEPS, past: bool = False
) -> list[int]:
    """Positions of the candidate source views of frame ``i``, before and after it, in rising order.

    Steps count in the capture's own frame numbers; lost frames are left out, and steps beyond the recording's ends too.
    Where no step fits, the nearest frame is the candidate. ``past``: only frames before ``i``.

    Raises:
        ValueError: no such frame, no steps or one below 1, or no other frame.
    """
    number = recording.number.tolist()
    if not 0 <= i < len(number):
        raise ValueError(f"pairs: found frame {i} of {recording.name}, expected 0 to {len(number) - 1}")
    candidates = _candidates_of_numbers(number, {k: p for p, k in enumerate(number)}, i, _check_steps(steps), past)
    if not candidates:
        extent, expected = ("nothing before frame 0", "a later one") if past else ("one frame", "two at least")
        raise ValueError(f"pairs: {recording.name} has {extent}, expected {expected}")
    return candidates


def spaced_frames(i: int, j: int, views: int) -> list[int]:
    """``views`` different positions evenly spaced from ``i`` (excluded) to ``j`` (the last one).

    Raises:
        ValueError: fewer than ``views`` frames lie in between. A single view is ``j``, also where ``j`` < ``i``.
    """
    if views == 1 and i != j:
        return [j]
    if not 1 <= views <= j - i:
        raise ValueError(f"views: found {views} for frames {i} to {j}, expected 1 to {j - i}")
    return [i + round((j - i) * (k + 1) / views) for k in range(views)]


def _candidates_of_numbers(
    number: Sequence[int], place: Mapping[int, int], i: int, steps: Sequence[int], past: bool
) -> list[int]:
    """:func:`candidate_frames` from frame numbers and number → position; empty where there is no other frame."""
    signs = (-1,) if past else (-1, 1)
    candidates = sorted(place[k] for s in steps for k in (number[i] + sign * s for sign in signs) if k in place)
    if candidates:
        return candidates
    neighbours = [p for p in (i - 1, i + 1) if 0 <= p < len(number) and (p < i or not past)]
    return [min(neighbours, key=lambda p: abs(number[p] - number[i]))] if neighbours else []


def _check_steps(steps: Sequence[int]) -> list[int]:
    if not steps:
        raise ValueError("pairs.steps: found none, expected whole numbers of at least 1")
    return sorted({_check_positive_int("pairs.steps", step) for step in steps})


def _choose_stride(recording: Recording, stride: int | None) -> int:
    if stride is None:
        return 2 if len(recording) >= _MANY_FRAMES else 1
    return _check_positive_int("pairs.stride", stride)


def _require_pairs(pairs: list[Pair], recording: Recording, criterion: str) -> list[Pair]:
    if not pairs:
        shortage = f"no two of {format_count(len(recording), 'frame')} of {recording.name}"
        raise ValueError(f"pairs: found {shortage} at {criterion}, expected at least one pair")
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
