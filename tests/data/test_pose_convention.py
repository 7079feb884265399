"""Conventions of poses: poses written in each one are taken back to the true ones, and its words name it."""

import re

import pytest
import torch
from support.stated_poses import DIRECTIONS, rotation, state_poses

from dhtorch.data.pose_convention import PoseConvention, parse_pose_convention, right_handed_axes
from dhtorch.data.units import UNIT_METRES
from dhtorch.geometry import se3
from dhtorch.records import Pose
from dhtorch.validation.pose_check import pose_readings

DESCRIPTIONS = {
    "world_to_camera": "world-to-camera poses (inverted)",
    "opengl": "OpenGL camera axes (x right, y up, z back)",
    "right_up_back": "OpenGL camera axes (x right, y up, z back)",
    "ros": "camera axes x forward, y left, z up",
    "wxyz": "quaternion order wxyz",
    "xyzw": "quaternion order xyzw",
    "mm": "translations in mm",
    "0.3048": "translations in units of 0.305 m",
    "world_to_camera+opengl": "world-to-camera poses (inverted) with OpenGL camera axes (x right, y up, z back)",
    "opengl+wxyz+cm": "OpenGL camera axes (x right, y up, z back) with quaternion order wxyz with translations in cm",
}


def random_quaternions(n=40):
    q = torch.randn(n, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return q / q.norm(dim=-1, keepdim=True)


def random_poses(n=40):
    g = torch.Generator().manual_seed(1)
    return Pose(rotation(random_quaternions(n)), torch.randn(n, 3, dtype=torch.float64, generator=g))


def test_every_reading_is_undone_and_its_words_are_read_back():
    true = random_poses()
    for reading in pose_readings():
        meant = reading.convention.apply(state_poses(true, reading.convention))
        assert float((se3.to_matrix(meant) - se3.to_matrix(true)).abs().max()) < 1e-9, reading
        assert parse_pose_convention(str(reading.convention)) == reading.convention
    assert str(PoseConvention()) == "opencv" and PoseConvention().is_trivial
    assert not PoseConvention(unit="mm").is_trivial
    assert parse_pose_convention(0.1) == parse_pose_convention("0.1") == PoseConvention(unit=0.1)


def stated_otherwise():
    """Convention → (poses as a file states them, what they mean)."""
    true, q = random_poses(), random_quaternions()
    right, down, forward = true.R.unbind(-1)
    inverse, none = se3.invert(true), torch.zeros(len(q), 3, dtype=torch.float64)
    turned = Pose(rotation(q), none)
    return {
        "opengl": (Pose(torch.stack((right, -down, -forward), -1), true.t), true),
        "ros": (Pose(torch.stack((forward, -right, -down), -1), true.t), true),
        "wxyz": (Pose(rotation(q[:, [3, 0, 1, 2]]), none), turned),  # numbers w x y z, read as x y z w
        "xyzw": (Pose(rotation(q[:, [1, 2, 3, 0]]), none), turned),
        "world_to_camera+mm": (Pose(inverse.R, 1000 * inverse.t), true),  # the unit is that of the file
    }


@pytest.mark.parametrize("convention", stated_otherwise())
def test_stated_poses_mean_the_true_ones(convention):
    stated, true = stated_otherwise()[convention]
    meant = parse_pose_convention(convention).apply(stated)
    torch.testing.assert_close(se3.to_matrix(meant), se3.to_matrix(true))


def test_there_are_24_right_handed_axes():
    axes = right_handed_axes()
    assert len(set(axes)) == 24 and {"right_down_forward", "right_up_back", "forward_left_up"} <= set(axes)
    assert "right_up_forward" not in axes
    for each in axes:
        a, b, c = (torch.tensor(DIRECTIONS[word]) for word in each.split("_"))
        assert torch.equal(torch.linalg.cross(a, b), c), each


@pytest.mark.parametrize("text", DESCRIPTIONS)
def test_descriptions(text):
    assert parse_pose_convention(text).describe() == DESCRIPTIONS[text]


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", ""),
        ("OpenGL", "OpenGL"),
        ("right_up_forward", "right_up_forward"),
        ("world_to_camera+gl", "gl"),
        ("opengl+", ""),
        ("-1", "-1"),
        ("0", "0"),
        ("nan", "nan"),
        ("inf", "inf"),
    ],
)
def test_another_word_is_refused_with_the_known_ones(text, word):
    expected = re.escape(
        f"pose_convention: found {word!r}, expected world_to_camera, opencv, opengl, ros, right_up_back"
    )
    with pytest.raises(ValueError, match=f"^{expected}") as e:
        parse_pose_convention(text)
    assert all(name in str(e.value) for name in ("wxyz", "xyzw", *UNIT_METRES)) and "\n" not in str(e.value)
