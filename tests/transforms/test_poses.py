"""Poses in samples: which shapes are read, of one pose, one per sample and one per frame."""

import numpy as np
import pytest
import torch

from dhtorch.transforms import poses
from dhtorch.transforms.sample_access import SampleError

ROWS_OF_POSES, ROWS_OF_SIGMAS = ((3, 4), 4), ((6,), 6)


class Leaves:
    """A batch of two samples with one value."""

    def __init__(self, value):
        self.sample, self.like, self.value = {"pose": value}, torch.zeros(2, 3), value

    def get(self, key):
        return self.value


@pytest.mark.parametrize(("rows", "tail"), [(3, ROWS_OF_POSES), (4, ROWS_OF_POSES), (6, ROWS_OF_SIGMAS)])
def test_a_matrix_is_read_per_sample_per_frame_or_once_for_all_frames(rows, tail):
    columns = tail[1]
    values = torch.arange(2.0 * 5 * rows * columns).view(2, 5, rows, columns)
    for given, wanted in ((values[:, 3], values[:, 3]), (values, values[:, 3]), (values[:, :1], values[:, 0])):
        found = poses._read_matrix(Leaves(given), "pose", 5, 3, tail)
        assert found.dtype == torch.float64 and torch.equal(found, wanted.double())


@pytest.mark.parametrize(
    ("shape", "tail"),
    [
        ((2, 5, 4), ROWS_OF_POSES),
        ((2, 4, 3), ROWS_OF_POSES),
        ((2, 4), ROWS_OF_POSES),
        ((2, 3, 4, 4), ROWS_OF_POSES),
        ((2, 5, 2, 4), ROWS_OF_POSES),
        ((2, 4, 4), ROWS_OF_SIGMAS),
        ((2, 4, 6), ROWS_OF_SIGMAS),
    ],
)
def test_other_shapes_are_named_with_those_that_are_accepted(shape, tail):
    expected = "3x4 or 4x4" if tail is ROWS_OF_POSES else "6x6"
    words = (
        rf"pose: found shape \({', '.join(map(str, shape[1:]))},?\), expected {expected}, with or without 5 in front"
    )
    with pytest.raises(SampleError, match=words):
        poses._read_matrix(Leaves(torch.zeros(shape)), "pose", 5, 0, tail)


def test_a_constant_matrix_is_that_of_every_sample():
    T = np.arange(12.0).reshape(3, 4)
    found = poses._read_matrix(Leaves(None), T.tolist(), 5, 0, ROWS_OF_POSES)
    assert found.shape == (2, 3, 4) and (found.numpy() == T).all()


@pytest.mark.parametrize(
    ("pose", "kind"),
    [
        (np.eye(3).tolist(), "1_from_0"),
        (np.full((4, 4), np.nan).tolist(), "1_from_0"),
        (np.eye(4).tolist(), "world_from_cam"),
        ([["a"]], "1_from_0"),
        ([[1, 2], [3]], "1_from_0"),
    ],
)
def test_a_constant_pose_is_finite_and_relative(pose, kind):
    with pytest.raises(
        ValueError, match=r"pose: found .*expected a key, or with pose_kind='1_from_0' 3x4 or 4x4 finite"
    ):
        poses.check_constant_pose(pose, kind)
    for shape in ((3, 4), (4, 4)):
        poses.check_constant_pose(np.ones(shape).tolist(), "1_from_0")


def test_sigmas_of_a_pose_are_two_numbers_of_at_least_zero():
    assert poses.parse_pose_sigmas(None) is None and poses.parse_pose_sigmas("cov") is None
    assert poses.parse_pose_sigmas([0, 0.02]) == (0.0, 0.02)
    for wrong in ([0.1], [0.1, 0.2, 0.3], [-0.1, 0.2], [0.1, float("inf")], [float("nan"), 0.1]):
        with pytest.raises(
            ValueError, match=r"pose_sigma is .*expected a key, or two standard deviations of at least 0"
        ):
            poses.parse_pose_sigmas(wrong, "pose_sigma")
