"""Simulators' demonstrations in HDF5: every layout written and read back; links and damage."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from support.box_scene import walk
from support.writers.simulator_hdf5 import write_simulator_hdf5

from dhtorch import data
from dhtorch.data.io.decode import FormatError
from dhtorch.records import Frame

h5py = pytest.importorskip("h5py")

UNITS = {"robomimic": None, "maniskill3": 1 / 1000, "maniskill2": 1 / 1024}


def still(n: int = 3) -> list[Frame]:
    """Frames of a camera that stands."""
    return walk(1) * n


def same_frames(recording: data.Recording, frames: list[Frame], tolerance: float) -> None:
    assert len(recording) == len(frames)
    for got, want in zip(recording, frames, strict=True):
        torch.testing.assert_close(got.depth, want.depth, atol=tolerance, rtol=0)
        assert torch.equal(got.image, want.image)
        torch.testing.assert_close(got.camera.f, want.camera.f)
        torch.testing.assert_close(got.camera.c, want.camera.c)
        if recording.poses is not None:
            torch.testing.assert_close(got.T_world_from_cam.R, want.T_world_from_cam.R, atol=1e-9, rtol=0)
            torch.testing.assert_close(got.T_world_from_cam.t, want.T_world_from_cam.t, atol=1e-9, rtol=0)


@pytest.mark.parametrize("layout", UNITS)
def test_every_layout_is_read_back(tmp_path: Path, layout: str) -> None:
    episodes = [still(), still(2)] if layout == "robomimic" else [walk(3), walk(2)]
    write_simulator_hdf5(tmp_path / "a.hdf5", episodes, layout)
    recordings = data.open_all(tmp_path / "a.hdf5")
    names = ["demo_0", "demo_1"] if layout == "robomimic" else ["traj_0", "traj_1"]
    assert list(recordings.names) == [f"a/{name}/front" for name in names]
    for recording, frames in zip(recordings, episodes, strict=True):
        step = UNITS[layout]
        assert recording.poses is not None and recording.times is None
        assert (recording.depth_unit is None) == (step is None)
        assert step is None or recording.depth_unit.metres == pytest.approx(step)
        same_frames(pickle.loads(pickle.dumps(recording)), frames, 1e-6 if step is None else step / 2 + 1e-6)
    assert recordings[1].episode == 1 and recordings[1].camera_name == "front"


def test_pictures_of_numbers_become_bytes(tmp_path: Path) -> None:
    write_simulator_hdf5(tmp_path / "a.hdf5", [walk(1)], "maniskill3")
    numbers = np.zeros((1, 48, 64, 3), np.float32)
    numbers[0, 0, :7, 0] = [0.0, 0.2, 0.75, 1.0, 1.5, -0.1, np.nan]
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        del file["traj_0/obs/sensor_data/front/rgb"]
        file["traj_0/obs/sensor_data/front/rgb"] = numbers
    assert data.open(tmp_path / "a.hdf5")[0].image[0, 0, 0, :7].tolist() == [0, 51, 191, 255, 255, 0, 0]


def test_one_pose_source_suffices(tmp_path: Path) -> None:
    write_simulator_hdf5(tmp_path / "a.h5", [walk(3)], "maniskill3")
    with h5py.File(tmp_path / "a.h5", "a") as root:
        del root["traj_0/obs/sensor_param/front/cam2world_gl"]
    same_frames(data.open(tmp_path / "a.h5"), walk(3), 6e-4)


def test_a_camera_in_the_hand_has_no_pose(tmp_path: Path) -> None:
    write_simulator_hdf5(tmp_path / "a.h5", [walk(2)], "robomimic", camera="robot0_eye_in_hand")
    assert data.open(tmp_path / "a.h5").poses is None


def test_K_is_asked_for_where_the_file_has_none(tmp_path: Path) -> None:
    write_simulator_hdf5(tmp_path / "a.h5", [walk(2)], "robomimic", parameters=False)
    recordings = data.open_all(tmp_path / "a.h5")
    with pytest.raises(FormatError, match=r"front: found no intrinsics, expected .*data.K"):
        _ = recordings[0]
    same_frames(data.open(tmp_path / "a.h5", K=[61.5, 58.25, 33.5, 21.75]), walk(2), 1e-6)


def test_a_z_buffer_is_converted_where_its_planes_are_set(tmp_path: Path) -> None:
    planes = (0.01, 50.0)
    write_simulator_hdf5(tmp_path / "a.h5", [still()], "robomimic", clip_planes=planes)
    assert float(data.open(tmp_path / "a.h5")[0].depth.min()) > 0.9  # as stored
    for got, want in zip(data.open(tmp_path / "a.h5", clip_planes=planes), still(), strict=True):
        torch.testing.assert_close(got.depth, want.depth, rtol=1e-4, atol=0)  # of float32 near 1
    with pytest.raises(FormatError, match="clip_planes"):
        data.open(tmp_path / "a.h5", clip_planes=[2.0, 1.0])


def test_cameras_are_chosen_by_name(tmp_path: Path) -> None:
    write_simulator_hdf5(tmp_path / "a.h5", [walk(2)], "maniskill3")
    with pytest.raises(FormatError, match="option camera: found hand, expected among front"):
        data.open(tmp_path / "a.h5", camera="hand")


def test_links_to_other_files_are_refused(tmp_path: Path) -> None:
    write_simulator_hdf5(tmp_path / "secret.h5", [walk(2)], "maniskill3")
    write_simulator_hdf5(tmp_path / "a.h5", [walk(2)], "maniskill3")
    with h5py.File(tmp_path / "a.h5", "a") as root:
        del root["traj_0/obs/sensor_data/front/depth"]
        root["traj_0/obs/sensor_data/front/depth"] = h5py.ExternalLink(
            "secret.h5", "traj_0/obs/sensor_data/front/depth"
        )
    with pytest.raises(FormatError):
        data.open(tmp_path / "a.h5")
    with h5py.File(tmp_path / "b.h5", "w") as root:
        root["traj_0"] = h5py.ExternalLink("secret.h5", "traj_0")
    with pytest.raises(FormatError):
        data.open(tmp_path / "b.h5")


@pytest.mark.parametrize(
    ("path", "value", "text"),
    [
        ("depth", [[1.0]], "depth"),
        ("rgb", [[[1.0]]], "an array of"),
    ],
)
def test_arrays_of_other_shapes(tmp_path: Path, path: str, value: list[object], text: str) -> None:
    write_simulator_hdf5(tmp_path / "a.h5", [walk(2)], "maniskill3")
    with h5py.File(tmp_path / "a.h5", "a") as root:
        del root[f"traj_0/obs/sensor_data/front/{path}"]
        root[f"traj_0/obs/sensor_data/front/{path}"] = value
    with pytest.raises(FormatError, match=text):
        data.open(tmp_path / "a.h5")
