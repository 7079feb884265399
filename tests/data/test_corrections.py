"""Corrections of every format: each option takes what its fault has made of a capture back to the truth."""

import re

import pytest
import torch
from support import box_scene as box
from support import writers
from support.stated_poses import poses_of, state_poses, with_poses

from dhtorch import data
from dhtorch.data.corrections import Corrections
from dhtorch.data.pose_convention import parse_pose_convention
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit
from dhtorch.geometry import se3
from dhtorch.records import Camera

N = 6


@pytest.fixture(scope="module")
def frames():
    return box.walk(N, hw=(24, 32))


@pytest.fixture(scope="module")
def folder(frames, tmp_path_factory):
    """A folder of numbered frames whose depth is in millimetres by its layout alone."""
    root = tmp_path_factory.mktemp("counted")
    writers.write_counted_frames(root, frames)
    return root


def recording(frames, **fields):
    return Recording("box", "made", frames.__getitem__, torch.arange(10, 10 + len(frames)), **fields)


@pytest.mark.parametrize(
    "convention", ["world_to_camera", "opengl", "ros", "wxyz", "xyzw", "mm", "0.5", "world_to_camera+opengl"]
)
@pytest.mark.parametrize("write", [writers.write_counted_frames, writers.write_tum])
def test_stated_poses_are_taken_back(convention, write, frames, tmp_path):
    true = poses_of(frames)
    write(tmp_path, with_poses(frames, state_poses(true, parse_pose_convention(convention))))
    (as_read,) = data.open_all(tmp_path)
    (corrected,) = data.open_all(tmp_path, pose_convention=convention)
    assert float((se3.to_matrix(as_read.poses) - se3.to_matrix(true)).abs().max()) > 0.1
    assert float((se3.to_matrix(corrected.poses) - se3.to_matrix(true)).abs().max()) < 1e-5
    assert torch.equal(corrected[1].T_world_from_cam.t, corrected.poses.t[1:2])


@pytest.mark.parametrize(("unit", "metres"), [("1/5000", 1 / 5000), ("inch", 0.0254), (0.004, 0.004), ("mm", 0.001)])
def test_a_unit_is_applied_to_the_stored_steps(unit, metres, folder):
    (as_read,), (corrected,) = data.open_all(folder), data.open_all(folder, depth_unit=unit)
    assert as_read.depth_unit == DepthUnit(0.001) and corrected.depth_unit == DepthUnit(metres, "option depth_unit")
    torch.testing.assert_close(corrected[2].depth, as_read[2].depth * metres / 0.001)
    assert torch.equal(corrected[2].image, as_read[2].image)


@pytest.mark.parametrize("lag", [1, 3, -2])
def test_a_lag_is_undone(lag, frames):
    """Depth that comes ``lag`` frames late, with the confidence and the camera of its own frame."""
    cameras = [Camera(torch.full((1, 2), 20.0 + k), torch.full((1, 2), 15.0)) for k in range(N)]
    conf = [torch.full((1, 24, 32), k, dtype=torch.uint8) for k in range(N)]
    true = [f.replace(depth_camera=c, conf=x) for f, c, x in zip(frames, cameras, conf, strict=True)]
    places = [min(max(k - lag, 0), N - 1) for k in range(N)]
    late = [
        true[k].replace(depth=true[p].depth, conf=true[p].conf, depth_camera=true[p].depth_camera)
        for k, p in enumerate(places)
    ]
    times = torch.arange(N, dtype=torch.float64) / 30
    corrected = Corrections(depth_lag=lag).apply(recording(late, poses=poses_of(true), times=times))
    assert len(corrected) == N - abs(lag)
    for frame, number in zip(corrected, corrected.number.tolist(), strict=True):
        want = true[number - 10]
        assert torch.equal(frame.image, want.image) and torch.equal(frame.depth, want.depth)
        assert torch.equal(frame.conf, want.conf) and torch.equal(frame.depth_camera.f, want.depth_camera.f)
        assert torch.equal(frame.T_world_from_cam.t, want.T_world_from_cam.t)
        assert float(frame.time) == float(times[number - 10])
    plural = "s" * (abs(lag) > 1)
    assert f"depth is that of {abs(lag)} frame{plural} {'later' if lag > 0 else 'earlier'}" in corrected.report


@pytest.mark.parametrize(
    ("options", "fault", "k", "image"),
    [
        ({"depth_lag": 0}, lambda depth: depth, 3, 3),
        ({"depth_unit": "cm"}, lambda depth: 100 * depth, 3, 3),  # a format in metres: a factor
        ({"depth_turn": "left_right"}, lambda depth: depth.flip(-1), 3, 3),
        ({"depth_turn": "upside_down"}, lambda depth: depth.flip(-2), 3, 3),
        ({"depth_turn": "180"}, lambda depth: depth.flip(-2, -1), 3, 3),
        ({"depth_turn": 180}, lambda depth: depth.flip(-2, -1), 3, 3),
        ({"depth_unit": 0.5, "depth_lag": 1, "pose_convention": "cm"}, lambda depth: 2 * depth, 1, 0),
    ],
)
def test_a_fault_of_depth_is_undone(options, fault, k, image, frames):
    """Frame ``image`` of the result has the depth of frame ``k``."""
    made = recording([frame.replace(depth=fault(frame.depth)) for frame in frames], poses=poses_of(frames))
    corrected = Corrections(**options).apply(made)
    lag, scale = options.get("depth_lag", 0), 0.01 if "pose_convention" in options else 1
    assert len(corrected) == N - lag
    torch.testing.assert_close(corrected[image].depth, frames[k].depth)
    assert torch.equal(corrected[image].image, frames[image].image)
    torch.testing.assert_close(corrected.poses.t, poses_of(frames).t[: N - lag] * scale)


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("depth_unit", "feet", "m, cm, mm, inch"),
        ("pose_convention", "gl", "world_to_camera, opencv"),
        ("pose_convention", "0", "world_to_camera, opencv"),
        ("depth_turn", 45, "90"),
        ("depth_turn", "left", "left_right"),
        ("depth_lag", 1.5, "a whole number of frames"),
        ("depth_lag", "1", "a whole number of frames"),
        ("depth_lag", True, "a whole number of frames"),
        *(("depth_lag", lag, "less") for lag in (N, -N, 100)),  # as long as the recording
    ],
)
def test_a_wrong_value_is_refused_before_anything_is_read(option, value, expected, folder):
    with pytest.raises(ValueError, match=rf"^{option}: found {re.escape(repr(value))[:4]}.*expected .*{expected}"):
        data.open_all(folder, **{option: value})


def test_a_factor_of_poses_may_be_a_number(folder, frames):
    """A command line gives ``0.1`` as a number."""
    (corrected,) = data.open_all(folder, pose_convention=0.1)
    torch.testing.assert_close(corrected.poses.t, 0.1 * poses_of(frames).t, atol=1e-6, rtol=0)
