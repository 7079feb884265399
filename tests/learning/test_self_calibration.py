"""Self-calibration in the built-in room, in a short setting, and the parts of its loss on exact poses and surfaces."""

import sys
from pathlib import Path

import pytest
import torch

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
