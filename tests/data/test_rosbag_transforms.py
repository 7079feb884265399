"""Coordinate frames of a bag: poses along a chain of fixed and moving transforms, and when there is no answer."""

from __future__ import annotations

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


def test_times_far_from_every_stamp_have_no_pose() -> None:
    late = transform("odom", "base", 3, (3, 0, 0))
    found = robot(late).poses("camera", np.array([-0.06, -0.04, 1.04, 1.06, 2, 2.96, 3.04, 3.06]) * S, BAG)
    assert found is not None
    assert found[1].tolist() == [False, True, True, False, False, True, True, False]


@pytest.mark.parametrize(
    "more",
    [
        transform("map", "base", 0, (0, 0, 0)),
        transform("tool", "camera", 0, (0, 0, 0)),
        transform("camera", "odom", 0, (0, 0, 0)),
    ],
    ids=["a moving frame of two parents", "a fixed frame of two parents", "a circle"],
)
def test_a_chain_that_is_none_has_no_poses(more: Transform) -> None:
    assert robot(more).poses("camera", np.array([0]), BAG) is None


def test_where_nothing_moves_there_are_no_poses() -> None:
    fixed = tree(transform("base", "arm", 0, (0, 1, 0)), transform("base", "arm", 1, (0, 1 + 5e-10, 0)))
    assert fixed.poses("arm", np.array([0]), BAG) is None and robot().poses("nobody", np.array([0]), BAG) is None
    moved = tree(transform("base", "arm", 0, (0, 1, 0)), transform("base", "arm", 0.1, (0, 1 + 2e-9, 0)))
    assert moved.poses("arm", np.array([0]), BAG) is not None


def test_fixed_transforms_join_two_frames_over_their_common_ancestor() -> None:
    made = robot(transform("arm", "tool", 0, (0.5, 0, 0), 30))
    T_camera_from_tool = np.linalg.inv(matrix((0, 0, 2))) @ matrix((0.5, 0, 0), 30)
    found = made.fixed_transform("/camera", "tool")
    assert found is not None
    np.testing.assert_allclose(found, T_camera_from_tool, atol=1e-12)
    up = made.fixed_transform("base", "/camera")
    assert up is not None
    np.testing.assert_allclose(up, matrix((0, 1, 0), 90) @ matrix((0, 0, 2)), atol=1e-12)
    same = made.fixed_transform("arm", "arm")
    assert same is not None and np.array_equal(same, np.eye(4))
    assert made.fixed_transform("odom", "camera") is None, "base moves"
    assert made.fixed_transform("elsewhere", "camera") is None


def test_a_tree_that_is_too_large_is_not_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rosbag_transforms, "_MAX_TRANSFORMS", 3)
    made = tree(*(transform("odom", "base", k, (k, 0, 0)) for k in range(3)))
    assert made.is_whole and made.count == 3
    made.add([transform("odom", "base", 9, (0, 0, 0))])
    assert not made.is_whole and made.count == 4 and len(made.entries["base"]) == 3
