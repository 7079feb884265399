"""Image folders of other people's tools: written from each format's description, read back; and their variants."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from support import writers
from support.box_scene import CAMERA, HW, check_same, render, turned_back, walk
from support.box_scene import pose as box_pose
from support.writers import parts
from torch import Tensor

from dhtorch import data
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import open3d
from dhtorch.data.units import DepthUnit
from dhtorch.export import arrays
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame

EXACT = [name for name, w in writers.CAPTURE_WRITERS.items() if w.is_exact and w.step_m is not None and w.has_poses]
#: Layouts of JPEGs, films or depth in metres.
LOSSY = [name for name in writers.CAPTURE_WRITERS if name not in EXACT]


@pytest.fixture
def field_cases() -> Path:
    """Folder of captures in other tools' layouts."""
    folder = Path(os.environ.get("DHTORCH_DATA", "/nowhere")) / "field_cases"
    if not folder.is_dir():
        pytest.skip("DHTORCH_DATA has no field_cases")
    return folder


def with_confidence(frames: list[Frame]) -> list[Frame]:
    """The frames with the highest confidence, which phones' layouts store."""
    return [frame.replace(conf=torch.full_like(frame.depth, 2, dtype=torch.uint8)) for frame in frames]


@pytest.mark.parametrize("name", [name for name in EXACT if name != "rlds"])
def test_every_layout_gives_back_the_scene(tmp_path: Path, name: str) -> None:
    writer, frames = writers.CAPTURE_WRITERS[name], with_confidence(walk(3))
    recording = turned_back(data.open(writer(tmp_path, frames), **writer.options), writer.up)
    assert recording.format == writer.format and len(recording) == 3
    assert recording.depth_unit is not None and recording.depth_unit.is_assumed is not writer.states_unit
    assert recording.depth_unit.metres == pytest.approx(writer.step_m)
    check_same(recording, frames, writer.step_m or 0)


@pytest.mark.parametrize("name", [*LOSSY, "rlds"])
def test_every_lossy_layout_gives_back_cameras_poses_and_depth(tmp_path: Path, name: str) -> None:
    writer, frames = writers.CAPTURE_WRITERS[name], with_confidence(walk(3))
    recording = turned_back(data.open(writer(tmp_path, frames), **writer.options), writer.up)
    assert recording.format == writer.format and len(recording) == 3
    if writer.step_m is not None and recording.depth_unit is not None:
        assert recording.depth_unit.metres == pytest.approx(writer.step_m)
    for got, want in zip(recording, frames, strict=True):
        torch.testing.assert_close(got.camera.f, want.camera.f, atol=1e-3, rtol=0)
        torch.testing.assert_close(got.camera.c, want.camera.c, atol=1e-3, rtol=0)
        tolerance = 0.02 if name == "record3d_mp4" else (writer.step_m or 2e-3) / 2 + 1e-6
        returned = got.depth > 0
        assert float(returned.float().mean()) > (
            0.2 if name == "record3d_mp4" else 0.99
        )  # steep pixels of a film are holes
        assert float((got.depth - want.depth).abs()[returned].median()) <= tolerance
        assert float((got.image.float() - want.image.float()).abs().mean()) < 12
        if writer.has_poses:
            torch.testing.assert_close(got.T_world_from_cam.R, want.T_world_from_cam.R, atol=1e-6, rtol=0)
            torch.testing.assert_close(got.T_world_from_cam.t, want.T_world_from_cam.t, atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", writers.CAPTURE_WRITERS)
def test_no_layout_has_a_file_that_is_not_read(tmp_path: Path, name: str) -> None:
    writer = writers.CAPTURE_WRITERS[name]
    recording = data.open(writer(tmp_path, with_confidence(walk(3))), **writer.options)
    assert not [line for line in recording.report if line.startswith("not read")]


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("bop", "scene_camera.json: depth_scale"),
        ("replica", "cam_params.json: scale"),
        ("sens_folder", "_info.txt: m_depthShift"),
        ("scannet", "ScanNet stores mm"),
        ("icl_nuim", "ICL-NUIM stores 1/5000 m"),
        ("named_frames", None),
        ("ros_tum", None),
        ("open3d", None),
    ],
)
def test_what_states_the_unit_is_named(tmp_path: Path, name: str, source: str | None) -> None:
    path = writers.CAPTURE_WRITERS[name](tmp_path, walk(2))
    unit = data.open(path).depth_unit
    assert unit is not None and unit.source == source
    frame = data.open(path)[0]
    twice = data.open(path, depth_unit=2 * unit.metres)
    assert twice.depth_unit == DepthUnit(2 * unit.metres, "option depth_unit")
    torch.testing.assert_close(twice[0].depth, 2 * frame.depth)


# ---------------------------------------------------------------------------------------------------------------- BOP


def test_bop_without_poses_and_with_gaps(tmp_path: Path) -> None:
    writers.write_bop(tmp_path, walk(4), poses=False, depth_scale=1.0)
    (tmp_path / "rgb" / "000001.png").unlink()
    table = tmp_path / "scene_camera.json"
    entries = json.loads(table.read_text())
    del entries["2"]
    table.write_text(json.dumps(entries))
    recording = data.open(tmp_path)
    assert recording.number.tolist() == [0, 3] and recording.poses is None
    assert recording.report == ("frame 1: no image: left out", "frame 2: no camera: left out", "no poses")
    assert recording.depth_unit == DepthUnit(0.001, "scene_camera.json: depth_scale")


def test_bop_reads_each_frame_by_its_own_entry(tmp_path: Path) -> None:
    frames = walk(2)
    writers.write_bop(tmp_path, frames, depth_scale=0.1)
    table = tmp_path / "scene_camera.json"
    entries = json.loads(table.read_text())
    entries["1"]["depth_scale"] = 0.2
    entries["1"]["cam_K"][0] = 70.0
    table.write_text(json.dumps(entries))
    first, second = data.open(tmp_path)
    torch.testing.assert_close(second.depth, 2 * frames[1].depth, atol=2e-4, rtol=0)
    torch.testing.assert_close(first.depth, frames[0].depth, atol=1e-4, rtol=0)
    assert float(first.camera.f[0, 0]) == 61.5 and float(second.camera.f[0, 0]) == 70


def test_bop_sensors_are_recordings(tmp_path: Path) -> None:
    writers.write_bop(tmp_path, walk(2))
    for folder in ("rgb", "depth"):
        (tmp_path / folder).rename(tmp_path / f"{folder}_realsense")
    (tmp_path / "scene_camera.json").rename(tmp_path / "scene_camera_realsense.json")
    (recording,) = data.open_all(tmp_path)
    assert recording.name.endswith("/realsense") and len(recording) == 2


def test_bad_bop(tmp_path: Path) -> None:
    writers.write_bop(tmp_path, walk(2))
    table = tmp_path / "scene_camera.json"
    good = json.loads(table.read_text())

    def fails(message: str, **changes: object) -> None:
        table.write_text(json.dumps({"0": good["0"] | changes, "1": good["1"]}))
        with pytest.raises(FormatError, match=message):
            data.open(tmp_path)

    fails("depth_scale: found nothing, expected a finite number", depth_scale=None)
    fails("depth_scale: found -1.0, expected a positive number", depth_scale=-1)
    fails(r"cam_K: found \[1.0\], expected 9 finite numbers", cam_K=[1])
    fails("pose 0 determinant", cam_R_w2c=[2, 0, 0, 0, 2, 0, 0, 0, 2])
    fails("cam_t_w2c: found nothing", cam_t_w2c=None)
    table.write_text(json.dumps({"a": good["0"]}))
    with pytest.raises(FormatError, match="entry a"):
        data.open(tmp_path)


# ------------------------------------------------------------------------------------------------------------- Replica


def test_replica_finds_its_parameters_one_folder_above(tmp_path: Path) -> None:
    writers.write_replica(tmp_path / "office0", walk(2), parameters_above=True)
    recording = data.open(tmp_path / "office0")
    assert torch.equal(recording[0].camera.f, CAMERA.f)
    (tmp_path / "cam_params.json").unlink()
    with pytest.raises(FormatError, match=r"K: found no intrinsics, expected data.fov=69 .* or cam_params.json"):
        data.open(tmp_path / "office0")
    unstated = data.open(tmp_path / "office0", K=[61.5, 58.25, 33.5, 21.75]).depth_unit
    assert unstated is not None and unstated.is_assumed and unstated.metres == pytest.approx(1 / 6553.5)


def test_replica_of_imap_states_neither_K_nor_unit(tmp_path: Path) -> None:
    frames = walk(3)
    for i, frame in enumerate(frames):
        image = parts.encode_unfiltered_png(arrays.frame_to_hwc(frame))
        parts.save_file(tmp_path / "rgb" / f"rgb_{i}.png", image)
        code = arrays.encode_depth_codes(frame.depth, 1000)
        parts.save_file(tmp_path / "depth" / f"depth_{i}.png", parts.encode_unfiltered_png(code))
    rows = [parts.format_row(arrays.pose_matrix(frame).ravel()) for frame in frames]
    parts.save_file(tmp_path / "traj_w_c.txt", "\n".join(rows))
    recording = data.open(tmp_path, K=[61.5, 58.25, 33.5, 21.75])
    assert recording.format == "replica" and recording.depth_unit == DepthUnit(0.001)
    check_same(recording, frames, 1e-3)


def test_replica_takes_poses_by_number_where_images_are_missing(tmp_path: Path) -> None:
    frames = walk(4)
    writers.write_replica(tmp_path, frames)
    for name in ("frame000001.jpg", "depth000001.png"):
        (tmp_path / "results" / name).unlink()
    recording = data.open(tmp_path)
    assert recording.number.tolist() == [0, 2, 3]
    assert recording.report == ("traj.txt: 4 poses for 3 images: matched by the images' numbers",)
    torch.testing.assert_close(recording.poses.t[1], frames[2].T_world_from_cam.t[0])


def test_K_of_another_size_is_scaled_or_refused(tmp_path: Path) -> None:
    writers.write_replica(tmp_path, walk(1))
    file = tmp_path / "cam_params.json"
    twice = cameras.resize(CAMERA, HW, (96, 128))
    (fx, fy), (cx, cy) = twice.f[0].tolist(), twice.c[0].tolist()
    values = {"w": 128, "h": 96, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "scale": 6553.5}
    file.write_text(json.dumps(values))
    recording = data.open(tmp_path)
    torch.testing.assert_close(recording[0].camera.c, CAMERA.c)
    assert recording.report == ("images of 64x48, cam_params.json states K for 128x96: K is scaled",)
    file.write_text(json.dumps(values | {"h": 128}))
    with pytest.raises(FormatError, match="image size: found 128x128, expected 64x48 as the images"):
        data.open(tmp_path)


# -------------------------------------------------------------------------------------------- ScanNet, SensReader, 3RScan

NARROW = Camera(torch.tensor([[50.0, 49.0]]), torch.tensor([[23.0, 17.0]]))


def two_camera_walk(n: int = 4) -> list[Frame]:
    """Frames with depth of another size and camera than the image."""
    frames = []
    for i in range(n):
        image, depth = render(CAMERA, box_pose(i), HW, 100 + i / 30), render(NARROW, box_pose(i), (36, 48))
        frames.append(image.replace(depth=depth.depth, depth_camera=NARROW))
    return frames


@pytest.mark.parametrize("write", [writers.write_scannet, writers.write_sens_folder])
def test_depth_has_a_camera_of_its_own_and_lost_poses_are_left_out(tmp_path: Path, write: Callable[..., None]) -> None:
    frames = two_camera_walk()
    write(tmp_path, frames, lost=[2])
    recording = data.open(tmp_path)
    assert recording.number.tolist() == [0, 1, 3]
    assert recording.report == ("frame 2: the pose is not finite (tracking lost): left out",)
    got = recording[2]
    assert torch.equal(got.depth_camera.f, NARROW.f) and torch.equal(got.depth_camera.c, NARROW.c)
    assert torch.equal(got.camera.f, CAMERA.f)
    torch.testing.assert_close(got.depth, frames[3].depth, atol=0.6e-3, rtol=0)
    torch.testing.assert_close(got.T_world_from_cam.t, frames[3].T_world_from_cam.t)


def test_all_poses_lost_is_no_poses(tmp_path: Path) -> None:
    writers.write_scannet(tmp_path, walk(2), lost=[0, 1])
    recording = data.open(tmp_path)
    assert len(recording) == 2 and recording.poses is None
    assert recording.report[0] == "every pose is missing or not finite (tracking lost)"


def test_scannet_K_of_the_original_size_is_scaled_to_smaller_images(tmp_path: Path) -> None:
    K = np.eye(4)
    K[:2, :3] = [[1170.0, 0, 647.75], [0, 1170.0, 483.75]]
    writers.write_scannet(tmp_path, [render(CAMERA, box_pose(0), (242, 324))])
    (tmp_path / "intrinsic" / "intrinsic_color.txt").write_text(parts.format_rows(K))
    recording = data.open(tmp_path)
    assert float(recording[0].camera.f[0, 0]) == pytest.approx(1170 / 4)
    assert recording.report == ("images of 324x242, intrinsic_color.txt states K for 1296x968: K is scaled",)


def test_scannet_in_one_folder(tmp_path: Path) -> None:
    writers.write_scannet(tmp_path / "folders", walk(2))
    flat = tmp_path / "flat"
    flat.mkdir()
    for folder in ("color", "depth", "pose"):
        for file in (tmp_path / "folders" / folder).iterdir():
            file.rename(flat / f"{int(file.stem):05d}{file.suffix}")
    (tmp_path / "folders" / "intrinsic" / "intrinsic_color.txt").rename(flat / "intrinsic.txt")
    recording = data.open(flat)
    assert recording.format == "scannet" and len(recording) == 2 and recording.poses is not None
    assert torch.equal(recording[0].camera.f, CAMERA.f)


def test_extrinsics_that_are_not_applied_are_named(tmp_path: Path) -> None:
    writers.write_scannet(tmp_path, walk(1))
    matrix = np.eye(4)
    matrix[0, 3] = 0.03
    (tmp_path / "intrinsic" / "extrinsic_color.txt").write_text(parts.format_rows(matrix))
    (line,) = data.open(tmp_path).report
    assert line.startswith("extrinsic_color.txt is not the identity; not applied")
    (tmp_path / "intrinsic" / "extrinsic_color.txt").write_text(parts.format_rows(matrix[:3]))
    with pytest.raises(FormatError, match=r"extrinsic_color\.txt: .*3 rows.*4 rows"):
        data.open(tmp_path)


def test_sens_folder_of_png_depth_in_another_unit(tmp_path: Path) -> None:
    frames = walk(2)
    writers.write_sens_folder(tmp_path, frames, pgm=False)
    info = tmp_path / "_info.txt"
    info.write_text(info.read_text().replace("m_depthShift = 1000", "m_depthShift = 500"))
    recording = data.open(tmp_path)
    assert recording.depth_unit == DepthUnit(1 / 500, "_info.txt: m_depthShift")
    torch.testing.assert_close(recording[0].depth, 2 * frames[0].depth, atol=2e-3, rtol=0)
    unstated = "".join(line for line in info.read_text().splitlines(True) if "m_depthShift" not in line)
    (tmp_path / "_info.txt").write_text(unstated)
    assert data.open(tmp_path).depth_unit == DepthUnit(1 / 1000)
    info.write_text(unstated + "m_depthShift = 500\n")
    info.write_text(info.read_text().replace("= 500", "= many"))
    with pytest.raises(FormatError, match=r"_info.txt: m_depthShift: found many, expected a number"):
        data.open(tmp_path)


# -------------------------------------------------------------------------------------------------------------- Open3D


@pytest.mark.parametrize(
    "trajectory", ["trajectory.log", "odometry.log", "scene/trajectory.log", "livingroom-traj.txt"]
)
@pytest.mark.parametrize("intrinsics", ["camera_primesense.json", "camera_intrinsic.json", "intrinsic.json"])
def test_open3d_gives_back_the_scene(tmp_path: Path, trajectory: str, intrinsics: str) -> None:
    frames = walk(2)
    writers.write_open3d(tmp_path, frames, trajectory=trajectory, intrinsics=intrinsics)
    recording = data.open(tmp_path)
    assert recording.format == "open3d" and recording.report == ()
    check_same(recording, frames, 1e-3)


def test_of_two_trajectories_the_optimised_one_is_read_and_the_other_compared(tmp_path: Path) -> None:
    frames = walk(3)
    writers.write_open3d(tmp_path, frames, trajectory="odometry.log")
    moved = (tmp_path / "odometry.log").read_text()
    writers.write_open3d(tmp_path, frames)
    recording = data.open(tmp_path)
    (line,) = recording.report
    assert "poses are those of trajectory.log; odometry.log (data.trajectory=odometry.log) differs by at most" in line
    assert float(line.split("at most ")[1].split(" m")[0]) < 1e-12
    last = moved.splitlines()
    last[-4] = last[-4].rsplit(" ", 1)[0] + " 9.5"
    (tmp_path / "odometry.log").write_text("\n".join(last))
    assert float(data.open(tmp_path).report[0].split("at most ")[1].split(" m")[0]) > 5
    assert data.open(tmp_path, trajectory="odometry.log").poses.t[2].tolist() != recording.poses.t[2].tolist()


def test_trajectories_are_compared_whatever_their_worlds_are() -> None:
    poses = se3.to_matrix(se3.exp(torch.randn(4, 6, generator=torch.manual_seed(0), dtype=torch.float64))).numpy()
    found = open3d._motion_from_first(poses[3] @ poses[:3])
    np.testing.assert_allclose(found, open3d._motion_from_first(poses[:3]), atol=1e-12)
    np.testing.assert_allclose(found[0], np.eye(4), atol=1e-12)


def test_motions_between_frames_are_no_poses(tmp_path: Path) -> None:
    writers.write_open3d(tmp_path, walk(3), trajectory="odometry.log")
    file = tmp_path / "odometry.log"
    file.write_text(file.read_text().replace("0 0 1\n", "0 1 3\n").replace("1 1 2\n", "1 2 3\n"))
    recording = data.open(tmp_path)
    assert recording.poses is None
    assert recording.report[0] == "odometry.log: motions between two frames, not poses of frames: not used"


def test_fewer_poses_than_images_are_matched_by_number(tmp_path: Path) -> None:
    frames = walk(4)
    writers.write_open3d(tmp_path, frames)
    lines = (tmp_path / "trajectory.log").read_text().splitlines()
    (tmp_path / "trajectory.log").write_text("\n".join(lines[:5] + lines[10:]))
    recording = data.open(tmp_path)
    assert recording.number.tolist() == [0, 2, 3] and recording.report == ("frame 1: no pose: left out",)
    torch.testing.assert_close(recording.poses.t[1], frames[2].T_world_from_cam.t[0])
    assert data.open(tmp_path, fps=10).times.tolist() == pytest.approx([0.0, 0.2, 0.3])
    (tmp_path / "trajectory.log").write_text("\n".join(["0 0 9", *lines[1:5]]))
    with pytest.raises(FormatError, match=r"trajectory.log: poses: found 1, expected 4, one for each image"):
        data.open(tmp_path)


def test_of_two_trajectories_the_one_of_more_frames_is_read(tmp_path: Path) -> None:
    frames = walk(4)
    writers.write_open3d(tmp_path, frames, trajectory="odometry.log")
    writers.write_open3d(tmp_path, frames)
    lines = (tmp_path / "trajectory.log").read_text().splitlines()
    (tmp_path / "trajectory.log").write_text("\n".join(lines[:5]))
    recording = data.open(tmp_path)
    assert len(recording) == 4 and "poses are those of odometry.log; trajectory.log" in recording.report[0]


def test_intrinsics_by_rows_are_noticed(tmp_path: Path) -> None:
    writers.write_open3d(tmp_path, walk(1))
    file = tmp_path / "camera_intrinsic.json"
    document = json.loads(file.read_text())
    document["intrinsic_matrix"] = np.reshape(document["intrinsic_matrix"], (3, 3)).T.ravel().tolist()
    file.write_text(json.dumps(document))
    recording = data.open(tmp_path)
    assert torch.equal(recording[0].camera.c, CAMERA.c)
    assert "intrinsic_matrix is by rows" in recording.report[0]


@pytest.mark.parametrize(("apart_us", "paired"), [(400_000, True), (600_000, False)])
def test_a_single_image_is_paired_within_half_a_second(tmp_path: Path, apart_us: int, paired: bool) -> None:
    writers.write_open3d(tmp_path, walk(1))
    for folder, stamp in (("color", 0), ("depth", apart_us)):
        (tmp_path / folder / "00000.png").rename(tmp_path / folder / f"0000001-{stamp:012d}.png")
    if paired:
        assert len(data.open(tmp_path)) == 1
    else:
        with pytest.raises(FormatError, match="depth maps: found 1 for 1 images"):
            data.open(tmp_path)


def test_images_and_depth_are_paired_by_a_table_or_by_stamps(tmp_path: Path) -> None:
    frames = walk(3)
    writers.write_open3d(tmp_path, frames)
    rows = []
    for i in range(3):
        (tmp_path / "color" / f"{i:05d}.png").rename(tmp_path / "color" / f"{i + 7:07d}-{i * 33333:012d}.png")
        (tmp_path / "depth" / f"{i:05d}.png").rename(tmp_path / "depth" / f"{i + 1:07d}-{i * 33333 + 4000:012d}.png")
        rows.append(f"depth/{i + 1:07d}-{i * 33333 + 4000:012d}.png color/{i + 7:07d}-{i * 33333:012d}.png")
    check_same(data.open(tmp_path), frames, 1e-3)
    (tmp_path / "rgbd.match").write_text("\n".join([rows[2], rows[0]]))
    recording = data.open(tmp_path)
    assert recording.number.tolist() == [0, 2]
    assert recording.report == ("frame 1: no depth map: left out", "1 depth map without an image: left out")
    torch.testing.assert_close(recording[1].depth, frames[2].depth, atol=1e-3, rtol=0)
    (tmp_path / "rgbd.match").write_text("depth/0.png color/0.png")
    with pytest.raises(
        FormatError, match=r"rgbd.match: line 1: .* expected the names of an image and of its depth map"
    ):
        data.open(tmp_path)


# ----------------------------------------------------------------------------------------------- SUN3D and rotated codes


def rotated(code: np.ndarray) -> np.ndarray:
    return np.left_shift(code, 3) | np.right_shift(code, 13)


def test_codes_beyond_8_metres_survive_the_rotation(tmp_path: Path) -> None:
    frames = [frame.replace(depth=3 * frame.depth) for frame in walk(2)]
    writers.write_sun3d(tmp_path, frames)
    assert float(frames[0].depth.max()) > 8.2
    torch.testing.assert_close(data.open(tmp_path)[0].depth, frames[0].depth, atol=0.6e-3, rtol=0)


def test_sun3d_codes_that_are_not_rotated_are_read_as_they_are(tmp_path: Path) -> None:
    frames = walk(2)
    writers.write_sun3d(tmp_path, frames)
    for file, frame in zip(sorted((tmp_path / "depth").iterdir()), frames, strict=True):
        file.write_bytes(parts.encode_unfiltered_png(arrays.encode_depth_codes(frame.depth, 1000)))
    recording = data.open(tmp_path)
    torch.testing.assert_close(recording[0].depth, frames[0].depth, atol=0.6e-3, rtol=0)
    assert recording.depth_unit == DepthUnit(0.001) and "not rotated by 3 bits" in recording.report[0]


def test_sun_rgbd_image_has_no_pose(tmp_path: Path) -> None:
    frames = walk(1)
    writers.write_sun3d(tmp_path, frames)
    (tmp_path / "intrinsics.txt").write_text("61.5 0 33.5 0 58.25 21.75 0 0 1\n")
    recording = data.open(tmp_path)
    assert recording.poses is None and torch.equal(recording[0].camera.c, CAMERA.c)
    assert recording.report == ("extrinsics/ holds the tilt of one image, no pose: not read", "no poses")


def test_numbered_frames_with_rotated_codes(tmp_path: Path) -> None:
    frames = walk(2)
    writers.write_counted_frames(tmp_path, frames)
    for file, frame in zip(sorted((tmp_path / "depth").iterdir()), frames, strict=True):
        file.write_bytes(parts.encode_unfiltered_png(rotated(arrays.encode_depth_codes(frame.depth, 1000))))
    assert float((data.open(tmp_path)[0].depth / frames[0].depth).median()) == pytest.approx(8, rel=0.01)
    check_same(data.open(tmp_path, rotated_bits=3), frames, 1e-3)


def test_apc_scene_states_its_poses_in_one_file(tmp_path: Path) -> None:
    frames = [frame.replace(depth=frame.depth / 4) for frame in walk(2)]
    titles = [("Color camera intrinsic matrix", arrays.K_matrix(CAMERA)), ("Bin-to-world transformation", np.eye(4))]
    for i, frame in enumerate(frames):
        image, code = arrays.frame_to_hwc(frame), arrays.encode_depth_codes(frame.depth, 10000)
        parts.save_file(tmp_path / f"frame-{i:06d}.color.png", parts.encode_unfiltered_png(image))
        parts.save_file(tmp_path / f"frame-{i:06d}.depth.png", parts.encode_unfiltered_png(rotated(code)))
        titles.append((f"Camera-to-world extrinsic matrix (camera pose) for frame-{i:06d}", arrays.pose_matrix(frame)))
    text = "".join(f"# {title}\n{parts.format_rows(matrix)}\n" for title, matrix in titles)
    (tmp_path / "cam.info.txt").write_text("# Environment: shelf\n" + text)
    recording = data.open(tmp_path)
    assert recording.format == "apc" and recording.report == ()
    torch.testing.assert_close(recording[1].depth, frames[1].depth, atol=0.6e-4, rtol=0)
    torch.testing.assert_close(recording.poses.t[1], frames[1].T_world_from_cam.t[0])


# ---------------------------------------------------------------------------------------------- ICL-NUIM, ROS recorders


def test_icl_nuim_takes_the_published_K_and_its_frame_numbers(tmp_path: Path) -> None:
    image, depth = torch.zeros(1, 3, 480, 640, dtype=torch.uint8), torch.ones(1, 480, 640)
    frames = [frame.replace(image=image, depth=depth) for frame in walk(3)]
    writers.write_icl_nuim(tmp_path, frames, calibration=False)
    trajectory = tmp_path / "livingRoom0.gt.freiburg"
    trajectory.write_text("\n".join(trajectory.read_text().splitlines()[1:]))  # the published files begin with frame 1
    recording = data.open(tmp_path)
    assert recording.number.tolist() == [1, 2]
    assert recording.report == ("frame 0: no pose in livingRoom0.gt.freiburg: left out",)
    torch.testing.assert_close(recording.times, torch.tensor([1, 2]).double() / 30)
    assert recording[0].camera.f.tolist() == [[pytest.approx(481.2), 480]]
    torch.testing.assert_close(recording.poses.t[0], frames[1].T_world_from_cam.t[0])
    torch.testing.assert_close(recording.poses.R[0], frames[1].T_world_from_cam.R[0], atol=1e-12, rtol=0)


def test_negative_fy_mirrors_the_poses_of_any_sequence(tmp_path: Path) -> None:
    frames = walk(2)
    writers.write_icl_nuim(tmp_path, frames, trajectory="groundtruth.txt", calibration=False)
    recording = data.open(tmp_path, K=[61.5, -58.25, 33.5, 21.75])
    torch.testing.assert_close(recording.poses.R[1], frames[1].T_world_from_cam.R[0], atol=1e-12, rtol=0)
    assert recording.times is None
    assert any("negative fy" in line for line in recording.report)
    as_stored = data.open(tmp_path, K=[61.5, 58.25, 33.5, 21.75])
    assert float(as_stored.poses.t[1, 1]) == pytest.approx(-float(recording.poses.t[1, 1]))


@pytest.mark.parametrize("order", ["{0} depth/{0}.png {0} rgb/{0}.png", "{0} rgb/{0}.png {0} depth/{0}.png"])
def test_columns_of_associations_are_found_by_their_folders(tmp_path: Path, order: str) -> None:
    frames = walk(3)
    writers.write_icl_nuim(tmp_path, frames)
    (tmp_path / "associations.txt").write_text("\n".join(order.format(i) for i in range(3)))
    check_same(data.open(tmp_path), frames, 1 / 5000)


@pytest.mark.parametrize(
    "text",
    [
        "61.5 58.25 33.5 21.75\n",
        "# fx fy cx cy k1 k2 p1 p2\n61.5 58.25 33.5 21.75 0.1 0 0 0",
        "61.5 0 33.5\n0 58.25 21.75\n0 0 1\n",
    ],
)
def test_calibration_file_states_K(tmp_path: Path, text: str) -> None:
    writers.write_ros_tum(tmp_path, walk(2))
    (tmp_path / "calibration.txt").write_text(text)
    camera = data.open(tmp_path)[0].camera
    assert torch.equal(camera.f, CAMERA.f) and torch.equal(camera.c, CAMERA.c)
    assert (camera.distortion is not None) == ("k1" in text)
    (tmp_path / "calibration.txt").write_text("61.5 58.25")
    with pytest.raises(FormatError, match=r"calibration.txt: numbers: found 61.5 58.25, expected fx fy cx cy"):
        data.open(tmp_path)


def test_unit_of_a_ros_recorder_is_assumed_and_can_be_set(tmp_path: Path) -> None:
    frames = walk(2)
    writers.write_ros_tum(tmp_path, frames)
    assert data.open(tmp_path).depth_unit == DepthUnit(1 / 5000)
    check_same(data.open(tmp_path, depth_unit="mm"), frames, 1 / 1000)
    check_same(data.open(tmp_path, units_per_metre=1000), frames, 1 / 1000)
    tum = tmp_path.parent / "rgbd_dataset_freiburg3_desk"
    tmp_path.rename(tum)
    assert data.open(tum).depth_unit == DepthUnit(1 / 5000, "TUM RGB-D stores 1/5000 m")


# ------------------------------------------------------------------------------------------------------ numbered frames


@pytest.mark.parametrize(("scale", "factor"), [(1000, 1), (0.001, 1), (0.0005, 0.5), (2000.0, 0.5)])
def test_depth_scale_is_codes_per_metre_or_metres_per_code(tmp_path: Path, scale: float, factor: float) -> None:
    frames = walk(1)
    writers.write_counted_frames(tmp_path, frames)
    (tmp_path / "meta.json").write_text(json.dumps({"depth_scale": scale}))
    recording = data.open(tmp_path)
    assert recording.depth_unit == DepthUnit(pytest.approx(factor / 1000), "meta.json: depth_scale")
    torch.testing.assert_close(recording[0].depth, factor * frames[0].depth, atol=1e-3, rtol=0)


def test_named_frames_without_pose_files_have_no_poses(tmp_path: Path) -> None:
    writers.write_named_frames(tmp_path, walk(2))
    for file in tmp_path.glob("*.pose.txt"):
        file.unlink()
    recording = data.open(tmp_path)
    assert len(recording) == 2 and recording.poses is None
    assert recording.report == ("no frame-XXXXXX.pose.txt: no poses",)


def test_two_intrinsics_that_differ_are_named(tmp_path: Path) -> None:
    writers.write_counted_frames(tmp_path, walk(1))
    other = [[70, 0, 32], [0, 70, 24], [0, 0, 1]]
    (tmp_path / "meta.json").write_text(json.dumps({"K": other}))
    assert data.open(tmp_path).report == ("K.txt states another K than the one in use: f 61.5, c 33.5 21.75",)
    (tmp_path / "meta.json").write_text(json.dumps({"K": other, "K_depth": arrays.K_matrix(CAMERA).tolist()}))
    assert data.open(tmp_path).report == ()
    assert data.open(tmp_path, K=[70, 70, 32, 24]).report == ()


@pytest.mark.parametrize("name", ["cam_K.txt", "camera_intrinsics.txt", "intrinsic.txt"])
@pytest.mark.parametrize("n", [1, 3, 4])
def test_intrinsics_files_of_many_names_and_shapes(tmp_path: Path, name: str, n: int) -> None:
    writers.write_counted_frames(tmp_path, walk(1))
    (tmp_path / "K.txt").unlink()
    matrix = np.eye(4)
    matrix[:3, :3] = arrays.K_matrix(CAMERA)
    row = np.array([[matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]])
    (tmp_path / name).write_text(parts.format_rows(row if n == 1 else matrix[:n, :n]))
    recording = data.open(tmp_path)
    assert torch.equal(recording[0].camera.f, CAMERA.f) and torch.equal(recording[0].camera.c, CAMERA.c)
    (tmp_path / name).write_text("1 2 3 4 5")
    with pytest.raises(FormatError, match=f"{name}: K: found 5 numbers, expected fx fy cx cy, or a 3x3 or 4x4 matrix"):
        data.open(tmp_path)


@pytest.mark.parametrize("folder", ["poses", "pose"])
def test_numbered_frames_with_a_pose_file_each(tmp_path: Path, folder: str) -> None:
    frames = walk(4)
    writers.write_counted_frames(tmp_path, frames)
    (tmp_path / "poses.txt").unlink()
    for i, frame in enumerate(frames):
        parts.save_file(tmp_path / folder / f"{i:05d}.txt", parts.format_rows(arrays.pose_matrix(frame)))
    check_same(data.open(tmp_path), frames, 1e-3)
    (tmp_path / folder / "00001.txt").write_text("nan nan nan nan\n" * 4)
    (tmp_path / folder / "00002.txt").unlink()
    recording = data.open(tmp_path)
    assert recording.number.tolist() == [0, 3]
    lost = "frame 1: the pose is not finite (tracking lost): left out"
    assert recording.report == ("frame 2: no pose: left out", lost)
    torch.testing.assert_close(recording.poses.t[1], frames[3].T_world_from_cam.t[0])


@pytest.mark.parametrize("lost", ["nan " * 16, "-inf " * 16, "nan " * 7, "0 0 0 0 0 0 0"])
def test_lost_poses_of_numbered_frames_are_left_out(tmp_path: Path, lost: str) -> None:
    frames = walk(3)
    writers.write_counted_frames(tmp_path, frames)
    file = tmp_path / "poses.txt"
    lines = file.read_text().splitlines()
    if len(lost.split()) == 7:
        matrices = [arrays.pose_matrix(frame) for frame in frames]
        lines = [parts.format_row([*T[:3, 3], *arrays.rotation_to_xyzw(T[:3, :3])]) for T in matrices]
    lines[1] = lost
    file.write_text("\n".join(lines))
    recording = data.open(tmp_path)
    assert recording.number.tolist() == [0, 2]
    assert recording.report == ("frame 1: the pose is not finite (tracking lost): left out",)
    torch.testing.assert_close(recording.poses.R[1], frames[2].T_world_from_cam.R[0], atol=1e-12, rtol=0)


# ---------------------------------------------------------------------------------------------------------- unread files


@pytest.mark.parametrize(
    ("name", "named"),
    [
        ("camera.yaml", True),
        ("extrinsics.json", True),
        ("poses/0.npy", True),
        ("calibration/cam.xml", True),
        ("sub/trajectory.log", True),
        ("README.txt", False),
        ("LICENSE.txt", False),
        ("SHA256SUMS", False),
        ("notes.md", False),
        ("complete.json", False),
        ("sub/image.png", False),
        (".hidden.json", False),
    ],
)
def test_files_beside_the_images_that_were_not_read_are_named(tmp_path: Path, name: str, named: bool) -> None:
    writers.write_counted_frames(tmp_path, walk(1))
    parts.save_file(tmp_path / name, "1 2 3\n")
    report = data.open(tmp_path).report
    assert report == ((f"not read: {name} (cameras, poses or units in them are not used)",) if named else ())


def test_many_unread_files_are_counted(tmp_path: Path) -> None:
    writers.write_counted_frames(tmp_path, walk(1))
    for i in range(9):
        parts.save_file(tmp_path / f"{i}.json", "{}")
        parts.save_file(tmp_path / "poses" / f"{i}.txt", "1")
    (line,) = data.open(tmp_path).report
    assert line.startswith("not read: 0.json, 1.json, 2.json, 3.json, 4.json and 5 others (")
    assert "poses/ (9 files)" not in line
    for i in range(9):
        (tmp_path / f"{i}.json").unlink()
    assert data.open(tmp_path).report[0].startswith("not read: poses/ (9 files) (")


def test_where_K_is_missing_the_files_that_may_hold_it_are_named(tmp_path: Path) -> None:
    writers.write_counted_frames(tmp_path, walk(1))
    (tmp_path / "K.txt").rename(tmp_path / "camera.yaml")
    with pytest.raises(
        FormatError, match=r"K: found no intrinsics; not read: camera.yaml \(.*\), expected data.fov=69"
    ):
        data.open(tmp_path)


def test_poses_of_a_recording_are_read_as_before_where_another_file_lies_beside(tmp_path: Path) -> None:
    frames = walk(2)
    writers.write_bop(tmp_path, frames)
    parts.save_file(tmp_path / "K.txt", "1 0 0\n0 1 0\n0 0 1\n")  # of another layout: the specific reader wins
    recording = data.open(tmp_path)
    assert recording.format == "bop" and torch.equal(recording[0].camera.f, CAMERA.f)
    assert recording.report == ("not read: K.txt (cameras, poses or units in them are not used)",)


# ------------------------------------------------------------------------------------------------------------ real files


@pytest.mark.parametrize(
    ("case", "format", "n", "f", "source"),
    [
        ("02-redwood", "open3d", 5, 525, None),
        ("05-bop-depth-scale", "bop", 5, 525, "scene_camera.json: depth_scale"),
        ("06-scannet-export", "scannet", 4, 1063.125, "ScanNet stores mm"),
        ("07-replica-niceslam", "replica", 5, 525, "cam_params.json: scale"),
        ("21-3rscan", "sens_folder", 3, 787.5, "_info.txt: m_depthShift"),
    ],
)
def test_field_cases(field_cases: Path, case: str, format: str, n: int, f: float, source: str | None) -> None:
    recording = data.open(field_cases / case)
    assert recording.format == format and len(recording) == n
    assert recording.poses is not None and recording.poses.t.shape[0] == n
    assert recording.depth_unit is not None and recording.depth_unit.source == source
    assert float(recording[0].camera.f[0, 0]) == pytest.approx(f)
    depth = torch.cat([frame.depth[frame.depth > 0] for frame in recording])
    assert float(depth.median()) == pytest.approx(1.861, rel=0.005)


def test_field_case_icl_nuim(field_cases: Path) -> None:
    recording = data.open(field_cases / "19-icl-nuim")
    assert len(recording) == 3 and recording[0].camera.f.tolist() == [[pytest.approx(481.2), 480]]
    assert recording.depth_unit == DepthUnit(1 / 5000, "ICL-NUIM stores 1/5000 m")


def test_field_case_ros_recorder(field_cases: Path) -> None:
    recording = data.open(field_cases / "20-ros-tum-mm")
    assert recording[0].camera.f.tolist() == [[525, 525]] and recording.depth_unit == DepthUnit(1 / 5000)
    depth: Tensor = data.open(field_cases / "20-ros-tum-mm", depth_unit="mm")[0].depth
    assert float(depth[depth > 0].median()) == pytest.approx(1.861, rel=0.01)


def test_depth_that_lies_turned_against_its_own_camera_is_refused(tmp_path: Path) -> None:
    frames = [frame.replace(depth_camera=cameras.resize(CAMERA, frame.hw, frame.depth.shape[-2:])) for frame in walk(2)]
    writers.write_named_frames(tmp_path / "upright", frames)
    assert data.open(tmp_path / "upright")[0].depth.shape == frames[0].depth.shape
    writers.write_named_frames(tmp_path / "turned", [frame.replace(depth=frame.depth.mT) for frame in frames])
    with pytest.raises(FormatError, match=r"depth\.png: size: found \d+x\d+, turned against its intrinsics"):
        data.open(tmp_path / "turned")


def test_coarse_depth_with_a_camera_of_its_own_has_no_gaps(tmp_path: Path) -> None:
    """It is registered to the picture at its own density, not at that of the picture."""
    (frame,) = walk(1)
    coarse = torch.full((1, frame.hw[0] // 2, frame.hw[1] // 2), 2.0)
    camera = cameras.resize(CAMERA, frame.hw, tuple(coarse.shape[-2:]))
    writers.write_named_frames(tmp_path, [frame.replace(depth=coarse, depth_camera=camera)])
    depth = data.open(tmp_path)[0].depth
    assert depth.shape == coarse.shape and (depth[0, 1:-1, 1:-1] == 2).all()
