"""The benchmark of planted faults: what counts as right, and the outcomes of a few rows."""

import sys
from pathlib import Path

import pytest
import torch
from support.cluttered_walk import walk
from support.stated_poses import poses_of

from dhtorch.data.recording import Recording

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

import capture_faults

#: Many whole runs of commands: minutes. `pytest -m slow` runs them.
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def frames():
    return list(walk())


def recording(frames, poses=None, first=0):
    return Recording("walk", "made", frames.__getitem__, torch.arange(first, first + len(frames)), poses=poses)


def test_the_truth_is_right_and_changed_frames_are_not(frames):
    true = poses_of(frames)
    sound = capture_faults.Sound(frames, list(range(len(frames))), true)
    assert capture_faults.is_right(recording(frames, true), sound, 0)
    assert capture_faults.is_right(recording(frames[2:], true[2:], first=2), sound, 0), "two frames left out"
    assert capture_faults.is_right(recording(frames[2:], true[2:]), sound, 2), "the first two lost by a lag"
    assert not capture_faults.is_right(recording(frames[2:], true[2:]), sound, 0), "numbers that moved"
    changes = [
        lambda f: f.replace(depth=1.02 * f.depth),
        lambda f: f.replace(depth=f.depth.flip(-1)),
        lambda f: f.replace(depth=f.depth[..., ::2, ::2]),
        lambda f: f.replace(image=f.image.flip(-1)),
        lambda f: f.replace(depth=torch.where(torch.rand(f.depth.shape) < 0.1, 0.0, f.depth)),
        lambda f: f.replace(camera=f.camera.replace(f=1.02 * f.camera.f)),
        lambda f: f.replace(camera=f.camera.replace(c=f.camera.c + 3)),
    ]
    for k, change in enumerate(changes):
        assert not capture_faults.is_right(recording([change(f) for f in frames], true), sound, 0), k
    assert not capture_faults.is_right(recording(frames, true.replace(t=1.1 * true.t)), sound, 0)
    assert not capture_faults.is_right(recording(frames), sound, 0), "without its poses"


def test_numbers_of_the_summary():
    def row(fault, outcome, counted=True):
        return {"fault": fault, "outcome": outcome, "counted": counted}

    rows = [row("none", "right"), row("none", "alarm"), row("lag_1", "named"), row("lag_1", "silent", False)]
    rows += [row("w2c", "otherwise"), row("w2c", "refused"), row("w2c", "right")]
    summary = capture_faults.summarise(rows)
    assert summary["outcomes"] == {"right": 1, "refused": 1, "named": 1, "otherwise": 1, "silent": 1, "unchecked": 0}
    assert summary["n_counted"] == 4 and summary["named_rightly"] == 3 / 4
    assert summary["false_alarms"] == 1 / 2 and summary["n_sound"] == 2


@pytest.mark.parametrize(
    ("fault", "layout", "outcome"),
    [
        ("opengl", "counted_frames", "named"),
        ("w2c", "record3d_mp4", None),
    ],
)
def test_outcomes_of_rows(fault, layout, outcome, frames, tmp_path):
    sound = capture_faults.read_sound(frames, layout)
    row = capture_faults.run_row(frames, layout, capture_faults.FAULTS[fault], sound, tmp_path / "capture")
    assert (row and row["outcome"]) == outcome, row
