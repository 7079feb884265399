"""Which frames make a pair."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch

from dhtorch.data import pairs
from dhtorch.data.recording import Recording, Recordings, consecutive_frame_numbers
from dhtorch.data.rig import join_cameras
from dhtorch.data.scene import Scene, Scenes, scenes_of
from dhtorch.records import Frame, Pose


def _no_frame(i: int) -> Frame:
    raise AssertionError("choosing pairs must not read frames")


def line(n: int, **fields: object) -> Recording:
    """``n`` frames, 0.1 s and 0.05 m apart."""
    t = torch.zeros(n, 3, dtype=torch.float64)
    t[:, 0] = 0.05 * torch.arange(n)
    poses = Pose(torch.eye(3, dtype=torch.float64).expand(n, 3, 3), t)
    whole = Recording(
        "line", "test", _no_frame, consecutive_frame_numbers(n), times=0.1 * torch.arange(n).double(), poses=poses
    )
    return replace(whole, **fields)


LOST = line(4, number=torch.tensor([0, 1, 3, 4]))
GAPS = line(5, number=torch.tensor([0, 1, 4, 5, 9]))
FAR = line(3, number=torch.tensor([0, 50, 51]))
TWO = line(2, number=torch.tensor([3, 90]))
BACK = replace(
    line(5),
    poses=Pose(
        line(5).poses.R, torch.tensor([0, 0.2, 0, 0.2, 0.2], dtype=torch.float64)[:, None] * torch.eye(3).double()[0]
    ),
)
RIG = join_cameras([line(4, name=name, camera_name=name) for name in ("a", "b", "c")])

#: Pairs, or positions, and what they are.
CHOSEN = [
    (lambda: pairs.by_gap(line(5), 3), [(0, 3), (1, 4)]),
    (lambda: pairs.by_gap(line(24), 20), [(0, 20), (1, 21), (2, 22), (3, 23)]),
    (lambda: pairs.by_gap(line(25), 20), [(0, 20), (2, 22), (4, 24)]),  # from 25 frames on by two
    (lambda: pairs.by_gap(line(25), 20, stride=3), [(0, 20), (3, 23)]),
    (lambda: pairs.by_gap(Scene(line(5), gap=4)), [(0, 4)]),
    (lambda: pairs.by_gap(line(2)), [(0, 1)]),  # two frames are one pair
    (lambda: pairs.by_gap(line(2, number=torch.tensor([3, 8]))), [(0, 1)]),
    (lambda: pairs.by_gap(LOST, 1), [(0, 1), (2, 3)]),  # a lost frame does not shift pairs
    (lambda: pairs.by_gap(LOST, 2), [(1, 2)]),
    (lambda: pairs.by_gap(LOST, 4), [(0, 3)]),
    (lambda: pairs.by_time(line(5), 0.3), [(0, 3), (1, 4)]),
    (lambda: pairs.by_time(line(5), 0.34), [(0, 3), (1, 4)]),
    (lambda: pairs.by_time(line(4, times=torch.tensor([0, 0.1, 0.3, 0.4]).double()), 0.2, tolerance=0.01), [(1, 2)]),
    (lambda: pairs.by_baseline(line(5), 0.15, tolerance=0.001), [(0, 3), (1, 4)]),
    (lambda: pairs.by_baseline(line(6), 0.18), [(0, 3), (1, 4), (2, 5)]),  # 0.15 m is within a quarter of 0.18 m
    (lambda: pairs.by_baseline(BACK, 0.2, tolerance=0.01), [(0, 1), (1, 2), (2, 3)]),  # the earliest
    (lambda: pairs.by_scaled_gap(Scene(line(5), gap=2), 0.5), [(0, 1), (1, 2), (2, 3), (3, 4)]),
    (lambda: pairs.by_scaled_gap(Scene(line(5), gap=1), 0.5), [(0, 1), (1, 2), (2, 3), (3, 4)]),  # at least one frame
    (lambda: pairs.by_scaled_gap(Scene(line(5), gap=3), 2.0), []),
    (lambda: pairs.by_scaled_gap(Scene(line(3, number=torch.tensor([0, 2, 4])), gap=3), 1.0), []),
    *(
        (lambda factor=factor: pairs.by_scaled_gap(Scene(line(12), gap=3), factor, stride=1)[:1], [(0, gap)])
        for factor, gap in ((0.5, 2), (0.1, 1), (2.0, 6), (1.4, 4))
    ),
    (lambda: pairs.by_choice(line(4)), [(0, (1, 2, 3)), (1, (0, 2, 3)), (2, (0, 1, 3)), (3, (0, 1, 2))]),
    (lambda: [p.reference for p in pairs.by_choice(line(60))], [*range(0, 60, 2)]),  # the stride of the other ways
    (lambda: [list(p.candidates) for p in pairs.by_choice(line(60))], [pairs.candidate_frames(line(60), i) for i in range(0, 60, 2)]),
    (lambda: pairs.by_choice(line(9), steps=[4, 1, 4], stride=4), [(0, (1, 4)), (4, (0, 3, 5, 8)), (8, (4, 7))]),
    (lambda: pairs.by_choice(GAPS, steps=(1, 4)), [(0, (1, 2)), (1, (0, 3)), (2, (0, 3)), (3, (1, 2, 4)), (4, (3,))]),
    (lambda: pairs.by_choice(TWO), [(0, (1,)), (1, (0,))]),  # two frames, far apart
    (lambda: pairs.by_choice(line(4), past=True), [(1, (0,)), (2, (0, 1)), (3, (0, 1, 2))]),
    (lambda: pairs.by_choice(line(2), past=True), [(1, (0,))]),
    (lambda: [p for p in pairs.by_choice(line(40), past=True) if not max(p.candidates) < p.reference > 0], []),
    (lambda: pairs.by_choice(FAR, past=True), [(1, (0,)), (2, (1,))]),  # where no step fits, the nearest before it
    (lambda: pairs.to_fixed_pairs(pairs.by_gap(line(5), 3)), [(0, 3), (1, 4)]),
    (lambda: pairs.to_fixed_pairs([(0, 3), (1, 4)]), [(0, 3), (1, 4)]),
    (lambda: pairs.Pair(0, 3).candidates, ()),
    (lambda: pairs.Pair(*(0, (1, 2))).candidates, (1, 2)),
    (lambda: pairs.spaced_frames(3, 9, 1), [9]),
    (lambda: pairs.spaced_frames(9, 3, 1), [3]),
    (lambda: pairs.spaced_frames(0, 20, 5), [4, 8, 12, 16, 20]),
    (lambda: pairs.spaced_frames(2, 9, 7), [3, 4, 5, 6, 7, 8, 9]),
    (lambda: pairs.spaced_frames(2, 9, 3), [4, 7, 9]),
    (lambda: pairs.candidate_frames(line(60), 30), [0, 10, 18, 22, 25, 27, 28, 29, 31, 32, 33, 35, 38, 42, 50]),
    (lambda: pairs.candidate_frames(line(10), 0), [1, 2, 3, 5, 8]),
    (lambda: pairs.candidate_frames(line(10), 9, steps=(1, 4)), [5, 8]),
    (lambda: pairs.candidate_frames(GAPS, 2), [1, 3, 4]),  # numbers 4 - 3, 4 + 1 and 4 + 5 are there
    (lambda: pairs.candidate_frames(line(2, number=torch.tensor([0, 7])), 0), [1]),  # where no step fits the nearest
    (lambda: pairs.candidate_frames(line(3, number=torch.tensor([0, 50, 110])), 1), [0]),
    (lambda: pairs.by_cameras(RIG)[:4], [(0, (1, 2)), (1, (0, 2)), (2, (0, 1)), (3, (4, 5))]),
    (
        lambda: pairs.by_cameras(RIG, instants=[1], reference="b", past=True),
        [(3 * k + 1, (3 * k - 3, 3 * k - 2, 3 * k - 1)) for k in (1, 2, 3)],
    ),
    (lambda: pairs.by_cameras(RIG, instants=[1], reference="c")[1], (5, (0, 1, 2, 6, 7, 8))),
    (lambda: Scene.of(line(2, number=torch.tensor([3, 8]))).gap, 5),  # two frames know their step
    (lambda: (Scene(line(2), gap=7).gap, Scene.of(line(3)).gap), (7, None)),
]  # fmt: skip


@pytest.mark.parametrize(("call", "expected"), CHOSEN)
def test_frames_that_make_a_pair(call: Callable[[], object], expected: object) -> None:
    assert call() == expected


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: pairs.by_gap(line(5), 5),
            r"pairs.gap: found 5 for 5 frames \(line, frame numbers 0 to 4\), expected at most 4",
        ),
        (lambda: pairs.by_gap(line(5), -1), r"pairs.gap: found -1, expected a whole number of at least 1"),
        (lambda: pairs.by_gap(line(5), 0), r"pairs.gap: found 0, expected a whole number"),
        (lambda: pairs.by_gap(line(5), 1.5), r"pairs.gap: found 1.5, expected a whole number"),
        (lambda: pairs.by_gap(line(5), 1, stride=0), r"pairs.stride: found 0"),
        (lambda: pairs.by_choice(line(1)), r"pairs: line has one frame, expected two at least"),
        (lambda: pairs.by_choice(line(5), steps=()), r"pairs.steps: found none"),
        (
            lambda: pairs.by_choice(line(5), steps=(1, 0)),
            r"pairs.steps: found 0, expected a whole number of at least 1",
        ),
        (lambda: pairs.by_choice(line(5), stride=0), r"pairs.stride: found 0"),
        (lambda: pairs.by_choice(line(3), stride=3, past=True), r"found no two of 3 frames of line at stride 3, past"),
        (lambda: pairs.by_gap(line(5)), r"pairs.gap: line has no gap of its own, expected a number of frames"),
        (lambda: pairs.by_gap(line(1), 1), r"pairs.gap: found 1 for 1 frame"),
        (lambda: pairs.by_time(line(5), -1), r"pairs.seconds: found -1, expected a positive number"),
        (lambda: pairs.by_time(line(5, times=None), 1), r"pairs.seconds: line has no time stamps"),
        (lambda: pairs.by_time(line(5), 1, tolerance=-1), r"pairs.tolerance: found -1, expected 0 or more"),
        (lambda: pairs.by_baseline(line(5, poses=None), 1), r"pairs.metres: line has no poses"),
        (lambda: pairs.by_baseline(line(5), float("nan")), r"pairs.metres: found nan, expected a positive number"),
        (lambda: pairs.by_baseline(line(5), 9), r"found no two of 5 frames of line at 9 m ± 2.25 m"),
        (
            lambda: pairs.by_gap(line(3, number=torch.tensor([0, 2, 4])), 3),
            r"found no two of 3 frames of line at gap 3",
        ),
        (lambda: pairs.by_time(line(5), 0.34, tolerance=0.01), r"found no two of 5 frames of line at 0.34 s ± 0.01 s, expected at least one"),
        (lambda: pairs.by_scaled_gap(line(5), 1.0), r"pairs.factor: line has no gap"),
        (lambda: pairs.candidate_frames(line(3), 0, past=True), "line has nothing before frame 0, expected a later one"),
        (lambda: pairs.candidate_frames(line(1), 0), "has one frame"),
        (lambda: pairs.candidate_frames(line(4), 9), "frame 9 of line"),
        (lambda: pairs.to_fixed_pairs(pairs.by_choice(line(3))), r"pairs: found 2 candidate frames \(pairs=auto\).*pairs=gap, time or"),
        (lambda: pairs.spaced_frames(0, 3, 4), r"views: found 4 for frames 0 to 3, expected 1 to 3"),
        *((choose, r"data: found \[\], expected a recording whose camera moves") for choose in (
            lambda: pairs.by_gap([]), lambda: pairs.by_time([], seconds=1.0), lambda: pairs.by_baseline([], metres=1.0),
        )),
    ],
)  # fmt: skip
def test_impossible_pairs_say_why(call: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_scenes_are_opened_when_they_are_asked_for() -> None:
    opened = []

    def make(i: int) -> Recording:
        opened.append(i)
        return line(i + 3)

    whole = scenes_of(Recordings(("a", "b", "c"), make))
    assert len(whole) == 3 and opened == [] and len(whole[1].recording) == 4 and opened == [1]
    room_scene = Scenes(whole.recordings, partial(Scene, near=2.0, room="hall"))
    assert [(s.near, s.gap, s.place, s.hint.levels) for s in room_scene[1:]] == [(2.0, None, "hall", None)] * 2
    assert (
        scenes_of(room_scene) is room_scene
        and Scene(line(3), levels=6).hint.levels == 6
        and Scene(line(3)).place == "line"
    )
    first = room_scene[0]
    assert scenes_of(first) == [first] and scenes_of([first, line(4)])[0] is first
    assert [s.recording.name for s in scenes_of(line(4))] == ["line"]
