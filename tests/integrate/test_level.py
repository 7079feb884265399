"""Which way is up: the floor that is believed lies as near to the guess as is promised."""

import os
from pathlib import Path

import pytest
import torch
from support.writers import CAPTURE_WRITERS

from dhtorch import MAP, data
from dhtorch.data.recording import Recording
from dhtorch.geometry import se3
from dhtorch.integrate.level import (
    _MIN_GUESS_COSINE,
    _UP_BY_FORMAT,
    _fit_floor_normal,
    _fit_upright_direction,
    estimate_up,
    mean_camera_up,
)
from dhtorch.records import Pose
from dhtorch.synthetic import SyntheticRoom

GUESSES = torch.nn.functional.normalize(torch.randn(12, 3, dtype=torch.float64, generator=torch.manual_seed(0)), dim=-1)


def level_floor():
    """A floor with a wall behind it, m; up is -y."""
    u, v = torch.rand(2, 4000, dtype=torch.float64, generator=torch.manual_seed(1)) * 4
    return torch.cat((torch.stack((u, 1 + 0 * u, v), -1), torch.stack((u, 1 - v / 4, 4 + 0 * u), -1)[:1000]))


def test_a_floor_is_found():
    down = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    askew = se3.exp(torch.tensor([[0.3, 0.0, 0.1, 0.0, 0.0, 0.0]], dtype=torch.float64)).R[0]
    for turn, guess in ((torch.eye(3).double(), down + 0.1), (askew, down)):  # of what the cameras hold upright
        axis = _fit_floor_normal(level_floor() @ turn.T, guess / guess.norm(), 0.02)
        assert (axis - turn @ down).abs().max() < 0.02 / 4, "the wall's foot lies in the slab of 2 cm, 4 m wide"
    assert _fit_floor_normal(level_floor()[:50], down, 0.02) is None, "of few points none is believed"


def test_a_plane_of_less_than_a_tenth_of_the_points_is_no_floor():
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    cloud = 4 * torch.rand(4000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    for n, is_floor in ((300, False), (700, True)):
        floor = torch.cat((cloud, level_floor()[:n]))
        assert (_fit_floor_normal(floor, up, 0.02) is not None) == is_floor, n


@pytest.mark.skipif("DHTORCH_DATA" not in os.environ, reason="DHTORCH_DATA is unset")
def test_a_door_is_no_floor_far_from_the_guess():
    frame = data.open(Path(os.environ["DHTORCH_DATA"]) / "r3d_door")[0]
    h, w = frame.hw
    uv = torch.stack(torch.meshgrid(torch.arange(0, w, 24.0), torch.arange(0, h, 24.0), indexing="xy"), -1)
    xyz = MAP.backproject(frame, uv.reshape(-1, 2)).xyz[0].double()
    found = [_fit_floor_normal(xyz, guess, 0.05) for guess in GUESSES]
    assert any(axis is None for axis in found)
    assert all(
        float(axis @ guess) > _MIN_GUESS_COSINE for axis, guess in zip(found, GUESSES, strict=True) if axis is not None
    )


def test_walls_tell_where_no_floor_is_seen():
    """Two walls at any angle and a little furniture; the camera looks down by 20°."""
    draw = torch.manual_seed(2)
    turn = torch.rand(3000, dtype=torch.float64, generator=draw) < 0.5
    walls = torch.where(turn[:, None], torch.tensor([1.0, 0, 0]).double(), torch.tensor([0.6, 0, 0.8]).double())
    walls = walls + 0.03 * torch.randn(3000, 3, dtype=torch.float64, generator=draw)
    clutter = torch.randn(1500, 3, dtype=torch.float64, generator=draw)
    normal = torch.cat((walls, clutter, clutter[:50] * torch.nan))
    guess = torch.tensor([0.0, -0.94, 0.34], dtype=torch.float64)
    found = _fit_upright_direction(normal, guess / guess.norm())
    assert found is not None and float(found @ torch.tensor([0.0, -1, 0]).double()) > 0.9986, "3°"
    assert _fit_upright_direction(clutter, guess / guess.norm()) is None, "what stands anyhow tells nothing"
    assert _fit_upright_direction(normal[:50], guess / guess.norm()) is None
    steps = torch.tensor([0.0, -1, 0]).double() + 0.03 * torch.randn(1500, 3, dtype=torch.float64, generator=draw)
    found = _fit_upright_direction(torch.cat((steps, clutter)), guess / guess.norm())
    assert found is not None and float(found @ torch.tensor([0.0, -1, 0]).double()) > 0.9986, "what is level alone"


def held(kind: str, rotation: tuple[float, float, float], chained: bool = False) -> list[float]:
    """Which way is up in a world with a level floor, y up, whose camera was turned by a rotation vector.

    ``chained``: the map stands in the world of its first camera.
    """
    turn = se3.exp(torch.tensor([[*rotation, 0.0, 0.0, 0.0]], dtype=torch.float64)).R
    pose = Pose(torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64)) @ turn, torch.zeros(1, 3).double())
    recording = Recording(kind, kind, load=lambda _i: None, number=torch.tensor([0]), poses=pose)  # type: ignore[arg-type]
    if chained:
        return estimate_up(recording, [se3.identity(1, pose.t)], level_floor(), 0.02)
    return estimate_up(recording, [pose], level_floor() * torch.tensor([1.0, -1, -1]), 0.02)


@pytest.mark.parametrize("rotation", [(0.0, 0, 0), (0, 0, torch.pi / 2), (0, 0, -torch.pi / 2), (-torch.pi / 2, 0, 0)])
def test_a_phones_world_is_level_however_it_is_held(rotation):
    """Lying, upright either way round with pictures that lie, and above a table, straight down."""
    assert held("stray", rotation) == [0.0, 1.0, 0.0]
    assert held("stray", rotation, chained=True) == pytest.approx([0, -1, 0], abs=0.01), "a world of its own"


@pytest.mark.parametrize("layout", ["stray", "r3d", "record3d_exr", "arkitscenes"])
def test_the_room_stands_upright_where_the_format_states_which_way_is_up(layout, tmp_path):
    writer, scene = CAPTURE_WRITERS[layout], SyntheticRoom(n_frames=2, hw=(24, 32), supersample=1)
    recording = data.open(writer(tmp_path, list(scene)), **writer.options)
    poses = [recording.poses[k : k + 1] for k in range(len(recording))]
    up = estimate_up(recording, poses, torch.zeros(0, 3), 0.02)
    assert up == list(_UP_BY_FORMAT[recording.format]), "not one that was fitted"
    tilt = torch.rad2deg(torch.acos(mean_camera_up(poses) @ torch.tensor(up).double()))
    assert float(tilt) < 10, "the cameras look down by 9°"


def test_a_trajectory_that_begins_in_its_first_camera_is_not_taken_for_level():
    assert held("record3d", (0.0, 0, 0)) == [0.0, 1.0, 0.0]
    assert held("tum", (0.2, 0, 0)) == pytest.approx([0, 1, 0], abs=0.01), (
        "z is up by the format; the floor knows better"
    )


def test_a_map_is_in_the_recordings_world_if_a_frame_of_it_is_there():
    R = se3.exp(torch.tensor([[0.1 * k, 0.0, 0.0, 0.0, 0.0, 0.0] for k in range(4)], dtype=torch.float64)).R
    poses = Pose(R[1:], torch.zeros(3, 3).double())
    recording = Recording("a", "stray", load=lambda _i: None, number=torch.arange(3), poses=poses)  # type: ignore[arg-type]
    none = torch.zeros(0, 3)
    assert estimate_up(recording, [poses[2:3]], none, 0.02) == [0.0, 1.0, 0.0]
    for given in ([], [Pose(R[:1], poses.t[:1])]):
        assert estimate_up(recording, given, none, 0.02) == mean_camera_up(given).tolist()
    turned = se3.exp(torch.tensor([[torch.pi / 2, 0, 0, 0, 0, 0]]).double())
    assert mean_camera_up([turned]).tolist() == pytest.approx([0, 0, -1], abs=1e-6)
    assert mean_camera_up([]).tolist() == [0, -1, 0]
