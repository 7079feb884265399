"""Coordinate frames of a bag: poses along a chain of fixed and moving transforms, and when there is no answer."""

import math
from pathlib import Path

import numpy as np
import pytest

from dhtorch.data.readers import rosbag_transforms
from dhtorch.data.readers.rosbag_transforms import Transform, TransformTree

BAG = Path("a.bag")
S = 1_000_000_000


def transform(parent: str, child: str, stamp_s: float, t: tuple[float, ...], turn_deg: float = 0.0) -> Transform:
    """A transform that turns about z."""
    half = math.radians(turn_deg) / 2
    return Transform(round(stamp_s * S), parent, child, t, (0.0, 0.0, math.sin(half), math.cos(half)))


def matrix(t: tuple[float, ...], turn_deg: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    T[:2, :2] = [[c, -s], [s, c]]
    T[:3, 3] = t
    return T


def tree(*transforms: Transform) -> TransformTree:
    made = TransformTree()
    made.add(transforms)
    return made


def robot(*more: Transform) -> TransformTree:
    """odom -> base (moves and turns) -> arm (fixed) -> camera (fixed)."""
    base = [transform("/odom", "base", k / 4, (k / 4, 0, 0), 10 * k) for k in range(5)]
    fixed = [transform("base", "/arm", 0, (0, 1, 0), 90), transform("arm", "camera", 0, (0, 0, 2))]
    return tree(*base, *fixed, *fixed, *more)


def test_poses_are_products_along_the_chain_between_the_stamps() -> None:
    found = robot().poses("/camera", np.array([0, S // 8, S]), BAG)
    assert found is not None
    c2w, covered, root = found
    assert root == "odom" and covered.tolist() == [True] * 3
    hand = matrix((0, 1, 0), 90) @ matrix((0, 0, 2))
    for T, (x, turn) in zip(c2w, ((0, 0), (0.125, 5), (1, 40)), strict=True):
        np.testing.assert_allclose(T, matrix((x, 0, 0), turn) @ hand, atol=1e-9)


def arm(*more: Transform) -> TransformTree:
    return tree(transform("base", "arm", 0, (0, 1, 0)), *more)


#: Tree, frame, times in s, and where the frame has a pose; None: it has none at all.
COVERED = [
    (robot(transform("odom", "base", 3, (3, 0, 0))), "camera", [-0.06, -0.04, 1.04, 1.06, 2, 2.96, 3.04, 3.06], [0, 1, 1, 0, 0, 1, 1, 0]),
    (robot(transform("map", "base", 0, (0, 0, 0))), "camera", [0], None),  # a moving frame of two parents
    (robot(transform("tool", "camera", 0, (0, 0, 0))), "camera", [0], None),  # a fixed frame of two parents
    (robot(transform("camera", "odom", 0, (0, 0, 0))), "camera", [0], None),  # a circle
    (robot(), "nobody", [0], None),
    (arm(transform("base", "arm", 1, (0, 1 + 5e-10, 0))), "arm", [0], None),  # nothing moves
    (arm(transform("base", "arm", 0.1, (0, 1 + 2e-9, 0))), "arm", [0], [1]),
]  # fmt: skip


@pytest.mark.parametrize(("made", "frame", "times", "covered"), COVERED)
def test_when_a_frame_has_a_pose(
    made: TransformTree, frame: str, times: list[float], covered: list[int] | None
) -> None:
    answer = made.poses(frame, np.array(times) * S, BAG)
    assert (None if answer is None else answer[1].astype(int).tolist()) == covered


@pytest.mark.parametrize(
    ("target", "source", "expected"),
    [
        ("/camera", "tool", np.linalg.inv(matrix((0, 0, 2))) @ matrix((0.5, 0, 0), 30)),  # over their common ancestor
        ("base", "/camera", matrix((0, 1, 0), 90) @ matrix((0, 0, 2))),
        ("arm", "arm", np.eye(4)),
        ("odom", "camera", None),  # base moves
        ("elsewhere", "camera", None),
    ],
)
def test_fixed_transforms_join_two_frames(target: str, source: str, expected: np.ndarray | None) -> None:
    answer = robot(transform("arm", "tool", 0, (0.5, 0, 0), 30)).fixed_transform(target, source)
    assert (answer is None) == (expected is None)
    assert answer is None or np.allclose(answer, expected, atol=1e-12)


def test_a_tree_that_is_too_large_is_not_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rosbag_transforms, "_MAX_TRANSFORMS", 3)
    made = tree(*(transform("odom", "base", k, (k, 0, 0)) for k in range(3)))
    assert made.is_whole and made.count == 3
    made.add([transform("odom", "base", 9, (0, 0, 0))])
    assert not made.is_whole and made.count == 4 and len(made.entries["base"]) == 3
