"""Self-calibration in the built-in room, in a short setting, and the parts of its loss on exact poses and surfaces."""

import sys
from pathlib import Path

import pytest
import torch

from dhtorch.geometry import se3
from dhtorch.geometry.se3 import Pose
from dhtorch.synthetic import SyntheticRoom

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks" / "learning"))

import self_calibration as example


@pytest.fixture(scope="module")
def capture():
    options = {"n_frames": 8, "step_m": 0.08, "hw": (120, 160), "lidar": "exact", "supersample": 1}
    return example.load_capture(SyntheticRoom(path="orbit", **options))


@pytest.mark.slow
def test_planted_errors_are_recovered(capture):
    """In less than half of the steps, on few pixels, from a start without errors: the focal length within 1.5 %, the
    scale within 2 %, and the time offset, which is still moving, far from none."""
    recovered = example.calibrate(example.plant(capture, **example.PLANTED), steps=48, pairs=2, points=160)
    assert abs(recovered["focal"] - 0.05) < 0.015
    assert abs(recovered["scale"] - 0.08) < 0.02
    assert 0.3 < recovered["offset"] < 1.3


def test_planted_errors_are_those_that_calibration_removes(capture):
    planted = example.plant(capture, focal=0.05, scale=0.08, offset=1)
    calibration = example.Calibration()
    with torch.no_grad():
        calibration.focal += torch.tensor(1.05).log()
        calibration.scale += torch.tensor(1.08).log()
    torch.testing.assert_close(calibration.camera(planted.camera).f, capture.camera.f)
    torch.testing.assert_close(calibration.depth(planted.depth)[:-1], capture.depth[1:])
    torch.testing.assert_close(calibration.vector(), torch.tensor([0.05, 0.08, 0.0]))


def test_poses_between_frames_lie_on_the_geodesic(capture):
    world = capture.T_world_from_cam
    k = torch.tensor([0.0, 3.0, 7.0, 2.25], dtype=torch.float64, requires_grad=True)
    poses = example.poses_at(world, k)
    torch.testing.assert_close(poses.R[:3], world.R[[0, 3, 7]])
    torch.testing.assert_close(poses.t[:3], world.t[[0, 3, 7]])
    a, b, between = (Pose(p.R[i : i + 1], p.t[i : i + 1]) for p, i in ((world, 2), (world, 3), (poses, 3)))
    whole, part = (se3.log(se3.relative(end, a)) for end in (b, between))
    torch.testing.assert_close(part, 0.25 * whole)
    assert torch.autograd.gradcheck(lambda k: example.poses_at(world, k).t, k.detach()[3:].requires_grad_())


def test_depth_of_a_slanted_surface_has_its_slope_as_gradient_and_edges_have_no_depth():
    x = torch.arange(160.0)
    plane = (2 + 0.01 * x).expand(1, 120, 160).clone()
    plane[:, :, 120:] += 1.0
    plane[:, :20] = 0
    maps = example.blur_depth(plane)
    uv = torch.tensor([[[60.3, 70.6], [30.0, 90.0], [119.5, 70.0], [60.0, 10.0], [-3.0, 60.0]]], requires_grad=True)
    depth, surface = example.read_depth(maps, uv)
    assert surface.tolist() == [[True, True, False, False, False]]
    torch.testing.assert_close(depth[:, :2], 2 + 0.01 * uv[:, :2, 0], atol=1e-4, rtol=0)
    depth[:, :2].sum().backward()
    torch.testing.assert_close(uv.grad[:, :2], torch.tensor([[[0.01, 0.0]] * 2]), atol=1e-4, rtol=0)


def test_every_pair_comes_before_one_comes_again():
    draws = example.draw_pairs(7, 3, torch.Generator().manual_seed(0))
    drawn = torch.cat([next(draws) for _ in range(7)])
    assert all(sorted(drawn[7 * i : 7 * i + 7].tolist()) == list(range(7)) for i in range(3))


def test_recovered_is_what_the_planted_run_has_beyond_the_other():
    as_it_is = {"focal": 0.01, "scale": -0.002, "offset": 0.1}
    planted = {"focal": 1.01 * 1.05 - 1, "scale": 0.998 * 1.08 - 1, "offset": 1.1}
    assert example.recovered_errors(planted, as_it_is) == pytest.approx(example.PLANTED)


def test_a_capture_needs_poses_and_registered_depth():
    with pytest.raises(ValueError, match="expected poses, and depth at the pixels"):
        example.load_capture(SyntheticRoom(n_frames=1, hw=(60, 80)))
