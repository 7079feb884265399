"""Errors of a device's own trajectory: each has the stated size, and none by default."""

from __future__ import annotations

import math

import torch

from dhtorch.geometry import se3
from dhtorch.synthetic.device_trajectory import reported_poses
from dhtorch.synthetic.paths import hand_held_path
from dhtorch.synthetic.recording import SyntheticRoom


def path(n=40):
    return hand_held_path("walk", n, step_m=0.02, rate_hz=30.0, seed=1), torch.arange(n).double() / 30


def degrees(a, b):
    return se3.rotation_angle(a.R.mT @ b.R) * 180 / math.pi


def test_errors_have_the_stated_size():
    poses, times = path()
    same = reported_poses(poses, times)
    assert torch.equal(same.R, poses.R) and torch.equal(same.t, poses.t)
    torch.testing.assert_close(
        degrees(poses, reported_poses(poses, times, offset_deg=5.0)), torch.full((40,), 5.0).double()
    )
    drift = degrees(poses, reported_poses(poses, times, drift_deg_per_s=3.0))
    torch.testing.assert_close(drift, 3.0 * times, atol=1e-6, rtol=0)
    noise = degrees(poses, reported_poses(poses, times, rotation_noise_deg=1.0, seed=3))
    assert 1.2 < noise.square().mean().sqrt() < 2.3, "three axes of one degree each"
    again = reported_poses(poses, times, rotation_noise_deg=1.0, seed=4)
    assert not torch.equal(again.R, reported_poses(poses, times, rotation_noise_deg=1.0, seed=3).R)


def test_a_late_pose_is_that_of_an_earlier_time():
    poses, times = path()
    late = reported_poses(poses, times, lag_s=2 / 30)
    torch.testing.assert_close(late.t[2:], poses.t[:-2], atol=1e-9, rtol=0)
    torch.testing.assert_close(late.R[2:], poses.R[:-2], atol=1e-6, rtol=0)
    assert torch.equal(late.t[0], poses.t[0]), "before the first frame it is the first"
    half = reported_poses(poses, times, lag_s=0.5 / 30)
    torch.testing.assert_close(half.t[1:], (poses.t[1:] + poses.t[:-1]) / 2)
    torch.testing.assert_close(degrees(poses[1:], half[1:]), degrees(half[1:], poses[:-1]), atol=1e-5, rtol=0)


def test_the_room_reports_them_and_keeps_the_truth():
    true = SyntheticRoom(hw=(24, 32), n_frames=6)
    room = SyntheticRoom(hw=(24, 32), n_frames=6, trajectory_lag_s=1 / 30, trajectory_drift_deg_per_s=2.0)
    assert torch.equal(room.true_poses.R, true.true_poses.R) and not torch.equal(room.poses.R, true.poses.R)
    assert torch.equal(room[3].image, true[3].image)
    torch.testing.assert_close(room.poses.t[3], true.poses.t[2])
