"""Readers against scenes of exact geometry, against the real pieces, and against damaged files."""

from __future__ import annotations

import io
import json
import math
import pickle
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from support import writers
from support.box_scene import BOX, CAMERA, HW, check_same, disagreement, hit, off_wall, pose, render, walk, world_points
from support.writers import parts
from torch.utils.data import DataLoader

from dhtorch import data, pytree
from dhtorch.data import convert
from dhtorch.data.codecs import npy
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import driving, frames_dir, rectified, tum
from dhtorch.data.recording import consecutive_frame_numbers
from dhtorch.data.scene import Scene
from dhtorch.export import arrays
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Camera, Pose
from dhtorch.runtime import safe_open

# ------------------------------------------------------------------------------------------------ written, then read


def test_named_frames_give_back_the_scene(tmp_path: Path) -> None:
    frames = walk()
    writers.write_named_frames(tmp_path, frames, fps=30)
    recording = data.open(tmp_path)
    assert recording.format == "frames_dir" and recording.rate_hz == 30 and recording.number.tolist() == [0, 1, 2, 3]
    torch.testing.assert_close(recording.times, torch.arange(4).double() / 30)
    check_same(recording, frames, 1 / 1000)


def test_frames_without_numbers_are_counted_from_0() -> None:
    assert consecutive_frame_numbers(3).tolist() == [0, 1, 2]


def test_counted_frames_give_back_the_scene(tmp_path: Path) -> None:
    frames = walk()
    writers.write_counted_frames(tmp_path, frames)
    recording = data.open(tmp_path)
    assert recording.times is None
    check_same(recording, frames, 1 / 1000)


def test_unregistered_depth_is_reprojected_or_kept(tmp_path: Path) -> None:
    infrared = Camera(torch.tensor([[70.0, 66.5]]), torch.tensor([[31.0, 23.0]]))
    frames = walk(depth_camera=infrared)
    writers.write_named_frames(tmp_path, frames)
    kept = data.open(tmp_path, register=False)[0]
    assert torch.equal(kept.depth_camera.f, infrared.f)
    torch.testing.assert_close(kept.depth, frames[0].depth, atol=0.6e-3, rtol=0)
    frame = data.open(tmp_path)[0]
    assert frame.depth_camera is None
    filled = frame.depth > 0
    assert 0.7 < float(filled.double().mean()) < 1  # the narrower view leaves a border empty
    exact = hit(CAMERA, pose(0), HW)[1][None]
    # Half a pixel on a slanted wall, that is all that a warp to the nearest pixel may cost.
    assert float(((frame.depth - exact).abs() / exact)[filled].median()) < 0.01
    wrong = ((kept.depth - exact).abs() / exact).median()
    assert float(wrong) > 0.015  # so the check above can tell


def test_K_of_another_size_keeps_pixel_centres() -> None:
    K = convert.resize_K(np.array([[60.0, 0, 30], [0, 50, 20], [0, 0, 1]]), (40, 60), (80, 30))
    assert K.tolist() == [[30, 0, 14.75], [0, 100, 40.5], [0, 0, 1]]


@pytest.mark.parametrize("turns", [-1, 0, 1, 2, 3])
def test_picture_camera_and_pose_turn_together(turns: int) -> None:
    """The pixel of a turned picture that a point is seen at has the value of its pixel before."""
    lens = torch.tensor([[0.05, -0.02, 0.004, -0.006]])
    camera = Camera(torch.tensor([[30.0, 33.0]]), torch.tensor([[14.0, 9.0]]), lens)
    image, uv = torch.arange(20 * 28).view(20, 28), torch.tensor([[[5.0, 3.0], [22.0, 16.0], [9.0, 12.0]]])
    T = pose(1)
    xyz = se3.apply(T, cameras.unproject(camera, uv, torch.full((1, 3), 2.0)).double())
    c2w = torch.from_numpy(convert.rot90_pose(se3.to_matrix(T).numpy(), turns))
    turned = convert.rot90_camera(camera, (20, 28), turns)
    seen = se3.apply(se3.invert(Pose(c2w[:, :3, :3], c2w[:, :3, 3])), xyz)
    at = cameras.project(turned, seen.float())
    torch.testing.assert_close(at, at.round(), atol=2e-3, rtol=0)
    (u, v), (x, y) = at[0].round().long().T, uv[0].long().T
    assert torch.equal(convert.rot90_image(image, turns)[v, u], image[y, x])


def test_rectified_pairs_give_back_the_scene(tmp_path: Path) -> None:
    cams = [Camera(torch.tensor([[60.0, 60.0]]), torch.tensor([[c, 22.25]])) for c in (30.25, 33.5)]
    away = Pose(torch.eye(3, dtype=torch.float64)[None], torch.tensor([[0.125, 0, 0]], dtype=torch.float64))
    left, right = render(cams[0], se3.identity(1, BOX), HW), render(cams[1], away, HW)
    writers.write_calib_pair(tmp_path / "calib", left, right)
    writers.write_npz_pair(tmp_path / "npz", left, right)
    for name in ("calib", "npz"):
        recording = data.open(tmp_path / name)
        assert recording.format == "rectified" and Scene.of(recording).gap == 1 and recording.times is None
        assert len(recording) == 2
        check_same(recording, [left], 1e-5)
        frame = recording[1]
        assert not frame.depth.any() and torch.equal(frame.image, right.image)
        assert torch.equal(frame.camera.c, right.camera.c)
        torch.testing.assert_close(frame.T_world_from_cam.t, away.t, atol=1e-12, rtol=0)
        assert disagreement(recording[0], right)[0] < 0.005


def test_a_pair_of_middlebury_2005_states_what_it_assumes(tmp_path: Path) -> None:
    codes = np.full((370, 463), 90, np.uint8)
    codes[:, :50] = 0
    for name, image in {"view1": codes, "view5": codes, "disp1": codes, "disp5": codes + 1}.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    (tmp_path / "dmin.txt").write_text("270\n")
    recording = data.open(tmp_path)
    left, right = recording
    # A third of the size: f = 3740 / 3 px, disparity 90 / 3 px, and a shift of 270 / 3 px between the two principal points.
    assert left.camera.f[0, 0] == pytest.approx(3740 / 3) and float(right.camera.c[0, 0] - left.camera.c[0, 0]) == 90
    assert left.camera.c.tolist() == [[231.0, 184.5]]
    assert not left.depth[0, :, :50].any() and (left.depth[0, :, 50:] > 0).all()
    assert float(left.depth[0, 0, 60]) == pytest.approx(0.16 * 3740 / 3 / (90 / 3 + 270 / 3))
    assert float(right.depth[0, 0, 60]) == pytest.approx(0.16 * 3740 / 3 / (91 / 3 + 270 / 3))
    assert recording.poses.t[1].tolist() == [0.16, 0, 0] and "principal point assumed" in recording.report[0]
    (tmp_path / "dmin.txt").write_text("far\n")
    with pytest.raises(FormatError, match=r"dmin\.txt: shift"):
        data.open(tmp_path)


def test_driving_gives_back_the_scene(tmp_path: Path) -> None:
    frames = walk(3)
    lidar = [se3.exp(torch.tensor([[1.0, -0.3 + 0.1 * i, 0.2, 0.1, 0.2, 0.3]]).double()) for i in range(3)]
    lidar = Pose(torch.cat([T.R for T in lidar]), torch.cat([T.t for T in lidar]))
    writers.write_driving(tmp_path / "one", {"FRONT": frames}, lidar)
    recording = data.open(tmp_path / "one", hide_px=0)
    assert recording.format == "driving" and recording.sparse and recording.name == "one/FRONT"
    assert recording.rate_hz == pytest.approx(30, rel=1e-3)
    torch.testing.assert_close(recording.times, torch.cat([f.time for f in frames]), atol=2e-6, rtol=0)
    check_same(recording, frames, 1e-5)

    for n, rate in ((1, None), (2, pytest.approx(30, rel=1e-3))):
        writers.write_driving(tmp_path / f"{n} frames", {"FRONT": frames[:n]}, lidar.map(lambda x, n=n: x[:n]))
        assert data.open(tmp_path / f"{n} frames", hide_px=0).rate_hz == rate
    other = [render(CAMERA, pose(i + 7), HW, 100 + i / 30) for i in range(3)]
    writers.write_driving(tmp_path / "two", {"FRONT": frames, "LEFT": other}, lidar)
    with pytest.raises(FormatError, match=r"found 2 recordings: two/FRONT, two/LEFT, expected one"):
        data.open(tmp_path / "two")
    front, left = data.open_all(tmp_path / "two")
    assert (front.name, left.name) == ("two/FRONT", "two/LEFT")
    # A pixel may now hold the other camera's point, up to half a pixel from its centre.
    assert float(off_wall(world_points(left[1])).max()) < 0.01
    (cropped,) = data.open_all(tmp_path / "two", cameras=["LEFT"], crop_bottom=0.25)
    assert cropped[0].image.shape == (1, 3, 36, 64) and torch.equal(cropped[0].depth, left[0].depth[:, :36])
    assert torch.equal(cropped[0].camera.c, left[0].camera.c)


# ------------------------------------------------------------------------------------------------------- recordings


def test_opening_decodes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writers.write_named_frames(tmp_path, walk())
    decoded = []
    decode = cv2.imdecode
    monkeypatch.setattr(cv2, "imdecode", lambda *args: decoded.append(1) or decode(*args))
    recording = data.open(tmp_path)
    assert len(recording) == 4 and decoded == []
    frame = recording[2]
    assert len(decoded) == 2 and frame.image.shape == (1, 3, *HW)


def test_recording_is_a_sequence(tmp_path: Path) -> None:
    writers.write_named_frames(tmp_path, walk())
    (scene,) = data.open_capture(tmp_path, near=1.5, gap=2, levels=6, role="rotation")
    assert (scene.near, scene.gap, scene.levels, scene.role, scene.root) == (1.5, 2, 6, "rotation", tmp_path)
    recording = scene.recording
    assert len(list(recording)) == 4
    assert torch.equal(recording[-1].image, recording[3].image)
    with pytest.raises(IndexError):
        recording[4]
    with pytest.raises(ValueError, match="found no frame"):
        replace(recording, number=consecutive_frame_numbers(0), poses=None)
    with pytest.raises(ValueError, match="found 4 poses, expected one for each of 3 frames"):
        replace(recording, number=consecutive_frame_numbers(3))


@pytest.mark.slow
def test_recording_travels_to_spawned_workers(tmp_path: Path) -> None:
    writers.write_named_frames(tmp_path, walk())
    recording = pickle.loads(pickle.dumps(data.open(tmp_path)))
    loader = DataLoader(
        recording, batch_size=2, num_workers=1, collate_fn=pytree.collate, multiprocessing_context="spawn"
    )
    batches = list(loader)
    assert [b.image.shape[0] for b in batches] == [2, 2]
    assert torch.equal(batches[1].depth[1], recording[3].depth[0])


# ------------------------------------------------------------------------------------------------------- conversions


def test_quaternions_and_axes() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        axis = rng.normal(size=3)
        axis *= rng.uniform(0, math.pi) / np.linalg.norm(axis)
        angle = np.linalg.norm(axis)
        q = np.append(np.sin(angle / 2) * axis / angle, np.cos(angle / 2))
        c2w = convert.to_c2w(3 * q[None], np.ones((1, 3)), Path("x"))[0]
        np.testing.assert_allclose(c2w[:3, :3], cv2.Rodrigues(axis)[0], atol=1e-12)
        assert abs(arrays.rotation_to_xyzw(c2w[:3, :3]) @ q) == pytest.approx(1, abs=1e-12)
    looking = convert.cv_from_gl(np.eye(4)[None])[0]
    np.testing.assert_array_equal(looking @ [0, 0, 1, 0], [0, 0, -1, 0])  # forward is −z in GL axes
    np.testing.assert_array_equal(looking @ [0, 1, 0, 0], [0, -1, 0, 0])  # down is −y
    moved = np.eye(4) + np.array([[0.0, 0, 0, 1], [0, 0, 0, 2], [0, 0, 0, 3], [0] * 4])
    assert convert.cv_from_gl(moved[None])[0, :3, 3].tolist() == [1, 2, 3]


@pytest.mark.parametrize("sign", [1, -1])
def test_between_two_rotations_lies_half_the_shorter_arc(sign: int) -> None:
    a, b = np.array([[0.0, 0, 0, 1]]), sign * np.array([[0, 0, np.sin(0.5), np.cos(0.5)]])
    half = convert.slerp(a, b, np.array([0.5]))
    np.testing.assert_allclose(half, [[0, 0, np.sin(0.25), np.cos(0.25)]], atol=1e-12)


def test_drifted_rotation_is_moved_to_the_nearest_one() -> None:
    exact = se3.to_matrix(pose(1)).numpy()
    drifted = exact.copy()
    drifted[:, :3, :3] *= 0.9995
    fixed = convert.to_poses(drifted, Path("x"))
    torch.testing.assert_close(fixed.R, torch.from_numpy(exact[:, :3, :3]), atol=1e-12, rtol=0)
    for scale, found in ((1.01, "1.0303"), (-1.0, "-1")):
        bad = exact.copy()
        bad[:, :3, :3] *= scale
        with pytest.raises(
            FormatError, match=rf"poses.txt: pose 0 determinant: found {found}.*expected 1 \(a rotation\)"
        ):
            convert.to_poses(bad, Path("poses.txt"))
    sheared = exact.copy()
    sheared[0, :3, :3] = [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]
    with pytest.raises(FormatError, match="axes that are not at right angles"):
        convert.to_poses(sheared, Path("poses.txt"))


def test_splat_keeps_the_nearest_and_fills_nothing() -> None:
    camera = Camera(torch.tensor([[10.0, 10.0]]), torch.tensor([[4.0, 3.0]]))
    rows = [[0, 0, 2], [0, 0, 1], [0.1, 0, 1], [0, 0, -1], [9, 9, 1], [math.nan, 0, 1], [0.8, 0, 4]]
    xyz = torch.tensor(rows, dtype=torch.float64)
    depth = convert.splat_depth(xyz, camera, (7, 9))
    want = torch.zeros(7, 9)
    want[3, 4], want[3, 5], want[3, 6] = 1, 1, 4
    assert torch.equal(depth, want)
    want[3, 6] = 0  # 4 m beside 1 m, one pixel apart
    assert torch.equal(convert.splat_depth(xyz, camera, (7, 9), hide_px=1), want)
    assert not convert.splat_depth(xyz[:0], camera, (7, 9)).any()


@pytest.mark.parametrize("reach", [1, 2, 3, 8])
def test_a_point_is_hidden_by_a_much_nearer_one_in_the_square_around_it(reach: int) -> None:
    depth = 1 + torch.rand(13, 17, generator=torch.Generator().manual_seed(reach))
    v, u = torch.meshgrid(torch.arange(13), torch.arange(17), indexing="ij")
    camera = Camera(torch.tensor([[20.0, 20.0]]), torch.tensor([[8.0, 6.0]]))
    xyz = cameras.unproject(camera, torch.stack((u, v), -1).view(1, -1, 2).float(), depth.view(1, -1))[0]
    least = -torch.nn.functional.max_pool2d(-depth[None, None], 2 * reach + 1, 1, reach)[0, 0]
    want = torch.where(depth > 1.1 * least, 0, depth)
    assert 0 < int((want == 0).sum()) < want.numel()
    assert torch.equal(convert.splat_depth(xyz, camera, (13, 17), hide_px=reach), want)


# -------------------------------------------------------------------------------------------------------- bad input


def fails(message: str, *args: object, **options: object) -> None:
    """Opening, and reading every frame, ends in one line that contains ``message`` (a regular expression)."""
    with pytest.raises(ValueError, match=message) as caught:
        for recording in data.open_all(*args, **options):
            list(recording)
    assert "\n" not in str(caught.value)


@pytest.fixture
def named(tmp_path: Path) -> Path:
    writers.write_named_frames(tmp_path, walk(3))
    return tmp_path


@pytest.fixture
def counted(tmp_path: Path) -> Path:
    writers.write_counted_frames(tmp_path, walk(3))
    return tmp_path


def test_nothing_there_or_unknown(tmp_path: Path, named: Path) -> None:
    fails(r"nowhere: path: found no such file or folder, expected a capture", tmp_path / "nowhere")
    fails(r"nowhere: path: found no such file or folder, expected a tum capture", tmp_path / "nowhere", "tum")
    (tmp_path / "empty").mkdir()
    every = ", ".join(data.FORMATS)
    fails(r"format: found an empty folder, expected from a phone: Record3D's \.r3d", tmp_path / "empty")
    (tmp_path / "scan.xyz").write_text("1 2 3")
    fails(
        r"scan.xyz: format: found a finished 3D model without its frames, expected the frames, from a phone",
        tmp_path / "scan.xyz",
    )
    for format in data.FORMATS:  # also where the reader is named and the path is a file
        fails(r"scan.xyz", tmp_path / "scan.xyz", format)
    fails(rf"format: found kitti, expected auto, {every}", named, "kitti")
    fails(
        r"data: format frames_dir has no option 'unit', expected one of intrinsics, K, fov, K_depth, distortion",
        named,
        unit=3,
    )
    fails(r"scene_\*.json: found 0 such files, expected exactly one", named, "driving")
    fails(r"rgb frames: found none", named, "tum")
    fails(r"calib.txt|left.png: found 0 such files", named, "rectified")
    fails(r"frames: found none, expected frame-XXXXXX", tmp_path / "empty", "frames_dir")
    assert data.recognise(named) == ("frames_dir", "frame-XXXXXX.{color,depth,pose} files")


def test_scenes_need_their_root(named: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = [{"path": named.name, "near": 2.0, "gap": 1}, {"path": named.name, "format": "frames_dir", "levels": 6}]
    monkeypatch.delenv("DHTORCH_DATA", raising=False)
    with pytest.raises(FormatError, match="DHTORCH_DATA: environment variable: found nothing, expected the folder"):
        data.open_scenes(scenes=scenes)
    monkeypatch.setenv("DHTORCH_DATA", str(named / "gone"))
    with pytest.raises(FormatError, match=r"gone: path: found no such folder, .*DHTORCH_DATA"):
        data.open_scenes(scenes=scenes)
    monkeypatch.setenv("DHTORCH_DATA", str(named.parent))
    first, second = data.open_scenes(scenes=scenes)
    assert (first.near, first.gap, second.levels, second.gap) == (2.0, 1, 6, None)
    with pytest.raises(FormatError, match="scenes: found none"):
        data.open_scenes(named)
    for scene in ({"near": 2.0}, "holo_a"):
        with pytest.raises(FormatError, match=r"scenes: found .*expected entries with a path, as \{path:holo_a"):
            data.open_scenes(named, [scene])


def test_damaged_pictures(named: Path) -> None:
    colour, depth = named / "frame-000001.color.png", named / "frame-000001.depth.png"
    good_colour, good_depth = colour.read_bytes(), depth.read_bytes()
    colour.write_bytes(good_colour[: len(good_colour) // 2])
    fails(
        r"frame-000001.color.png: data: found a truncated or damaged png file of \d+ bytes, expected a whole file",
        named,
    )
    colour.write_bytes(good_colour[:60] + bytes([good_colour[60] ^ 1]) + good_colour[61:])
    fails(r"color.png: data: found a truncated or damaged", named)
    colour.write_bytes(b"")
    fails(r"color.png: file size: found 0 bytes", named)
    colour.write_bytes(b"GIF89a" + bytes(40))
    fails(r"color.png: content: found b'GIF89a.*expected a PNG or JPEG image", named)
    colour.write_bytes(parts.encode_unfiltered_png(np.zeros((10, 12, 3), np.uint8)))
    fails(r"color.png: size: found 12x10, expected 64x48", named)
    colour.write_bytes(parts.encode_unfiltered_png(np.zeros(HW, np.uint16)))
    fails(r"color.png: bits per channel: found 16, expected 8", named)
    colour.write_bytes(good_colour)
    depth.write_bytes(parts.encode_unfiltered_png(np.zeros((*HW, 1), np.uint8)))
    fails(r"depth.png: depth: found png with 1 channels of 8 bits, expected png with 1 channel of 16 bits", named)
    depth.write_bytes(good_colour)
    fails(r"depth.png: depth: found png with 3 channels of 8 bits", named)
    depth.write_bytes(parts.encode_unfiltered_png(np.zeros((24, 32), np.uint16)))
    fails(r"depth.png: size: found 32x24, expected 64x48", named)
    depth.write_bytes(good_depth)
    assert len(list(data.open(named))) == 3


def test_absurd_header_is_refused_before_decoding(named: Path) -> None:
    file = named / "frame-000000.color.png"
    whole = bytearray(file.read_bytes())
    whole[16:24] = (60000).to_bytes(4, "big") * 2
    file.write_bytes(whole)
    fails(r"color.png: size: found 60000x60000, expected 1 to 64000000 pixels", named)


def test_jpeg_must_be_whole(tmp_path: Path) -> None:
    ramp = np.linspace(0, 1, 40)[:, None, None] + np.linspace(0, 1, 56)[:, None]
    picture = (ramp * (30, 70, 120)).astype(np.uint8)
    file = tmp_path / "a.jpg"
    cv2.imwrite(str(file), picture)
    good = file.read_bytes()
    header = files.read_image_header(file)
    assert (header.hw, header.channels, header.bits, header.kind) == ((40, 56), 3, 8, "jpeg")
    assert np.abs(files.read_image(file).transpose(1, 2, 0)[..., ::-1].astype(int) - picture).max() < 12
    file.write_bytes(good[: len(good) // 2])
    with pytest.raises(FormatError, match=r"a.jpg: data: found a truncated or damaged jpeg"):
        files.read_image(file)
    cv2.imwrite(str(file), picture[..., 0])
    assert files.read_image(file).shape == (1, 40, 56)


def test_colours_are_red_green_blue_and_depth_codes_are_masked(tmp_path: Path) -> None:
    picture = np.zeros((2, 3, 3), np.uint8)
    picture[0, 1] = (250, 100, 3)
    (tmp_path / "c.png").write_bytes(parts.encode_unfiltered_png(picture))
    assert files.read_image(tmp_path / "c.png")[:, 0, 1].tolist() == [250, 100, 3]
    (tmp_path / "d.png").write_bytes(parts.encode_unfiltered_png(np.array([[0, 65535, 1234]], np.uint16)))
    depth = files.read_depth_png(tmp_path / "d.png", 1000, invalid=(65535,))
    np.testing.assert_allclose(depth, [[0, 0, 1.234]])


def test_incomplete_named_frame_is_left_out_and_reported(named: Path) -> None:
    (named / "frame-000001.depth.png").unlink()
    recording = data.open(named)
    assert recording.number.tolist() == [0, 2] and recording.report == ("frame 1: no depth: left out",)
    assert torch.equal(recording[1].T_world_from_cam.t, recording.poses.t[1:])
    for file in named.glob("*.depth.png"):
        file.unlink()
    fails(r"frames: found none complete among 3, expected frame-XXXXXX", named)


def test_counted_frames_must_agree(counted: Path) -> None:
    rows = (counted / "poses.txt").read_text().splitlines()
    (counted / "poses.txt").write_text("\n".join(rows[:2]))
    fails(r"poses.txt count: found 2, expected 3, one for each file of images/", counted)
    (counted / "poses.txt").write_text("\n".join(rows))
    shutil.move(counted / "depth" / "00001.png", counted / "depth" / "00007.png")
    fails(r"file names: found 00001 in one of images/ and depth/, expected the same names in both", counted)
    (counted / "depth" / "00007.png").unlink()
    fails(r"depth count: found 2, expected 3", counted)
    for file in (counted / "images").iterdir():
        file.unlink()
    fails(r"images: frames: found no image", counted, "frames_dir")


def test_bad_poses(counted: Path) -> None:
    file = counted / "poses.txt"
    rows = np.loadtxt(file)
    for column, value, message in (
        (0, "5", r"poses.txt: pose 1 determinant: found .*, expected 1 \(a rotation\)"),
        (15, "2", r"poses.txt: pose 1 last row: found \[0.0, 0.0, 0.0, 2.0\], expected 0 0 0 1"),
    ):
        bad = rows.copy()
        bad[1, column] = float(value)
        np.savetxt(file, bad)
        fails(message, counted)
    file.write_text("1 2 3\n" * len(rows))
    fails(r"poses.txt: columns: found 3, expected 16 \(4x4 by rows\) or 7", counted)
    file.write_text(" ".join(["one"] * 16))
    fails(r"poses.txt: line 1: found one one", counted)
    file.unlink()
    unplaced = data.open(counted, "frames_dir")
    assert unplaced.poses is None and "no poses.txt: no poses" in unplaced.report


def test_bad_intrinsics(counted: Path) -> None:
    file = counted / "K.txt"
    for text, message in (
        ("nan 0 30\n0 60 20\n0 0 1", r"K.txt: K: found \[\[nan, .*expected 3x3 finite numbers"),
        ("0 0 30\n0 60 20\n0 0 1", r"K.txt: K focal length: found \[0.0, 60.0\], expected two positive"),
        (
            "60 0 3000\n0 60 20\n0 0 1",
            r"K.txt: K principal point: found \[3000.0, 20.0\], expected a place near the 64x48",
        ),
        ("60 9 30\n0 60 20\n0 0 1", r"K.txt: K: found .*no skew"),
        ("60 0 30\n0 60 20", r"K.txt: K: found 6 numbers, expected fx fy cx cy, or a 3x3 or 4x4 matrix"),
    ):
        file.write_text(text)
        fails(message, counted)
    file.unlink()
    fails(r"K: found no intrinsics, expected data.fov=69", counted)
    assert data.open(counted, K=(60, 61, 30, 20))[0].camera.f.tolist() == [[60, 61]]
    fails(r"option K: found \[60.0, 61.0\], expected 4 finite numbers", counted, K=(60, 61))
    (counted / "meta.json").write_text('{"K": [[60, 0, 30], [0, 60, 20], [0, 0, 1]], "dist": [1, 2]}')
    fails(r"distortion: found \[1, 2\], expected 4, 5 or 8 numbers", counted)
    (counted / "meta.json").write_text('{"K": ')
    fails(r"meta.json: JSON: found Expecting value", counted)
    (counted / "meta.json").write_text("[" * 100000)
    fails(r"meta.json: JSON: ", counted)
    (counted / "meta.json").write_text('{"K": [[60, 0, 30], [0, 60, 20], [0, 0, 1]], "depth_scale": -1}')
    fails(r"meta.json: depth_scale: found -1.0, expected a positive number", counted)


def test_bad_pairs_and_arrays(tmp_path: Path) -> None:
    cams = [Camera(torch.tensor([[60.0, 60.0]]), torch.tensor([[c, 22.25]])) for c in (30.25, 33.5)]
    away = Pose(torch.eye(3, dtype=torch.float64)[None], torch.tensor([[0.125, 0, 0]], dtype=torch.float64))
    left, right = render(cams[0], se3.identity(1, BOX), HW), render(cams[1], away, HW)
    calib, npz = tmp_path / "calib", tmp_path / "npz"
    writers.write_calib_pair(calib, left, right)
    writers.write_npz_pair(npz, left, right)
    text, map_ = (calib / "calib.txt").read_text(), (calib / "disp0.pfm").read_bytes()
    for old, new, message in (
        (
            "doffs=3.25",
            "doffs=9",
            r"calib.txt: doffs: found 9.0, expected 3.25, the difference of the principal points",
        ),
        ("baseline=125.0", "baseline=0", r"calib.txt: baseline: found 0.0, expected a positive length"),
        ("baseline=125.0", "", r"calib.txt: baseline: found nothing, expected a finite number"),
        ("width=64", "width=65", r"calib.txt: width and height: found 65x48, expected 64x48, as im0.png"),
        ("cam1=[60.0", "cam1=[50.0", r"calib.txt: focal length: found .*, expected equal ones"),
        ("cam0=[", "cam0=[x", r"calib.txt: cam0: found "),
    ):
        assert old in text
        (calib / "calib.txt").write_text(text.replace(old, new))
        fails(message, calib)
    (calib / "calib.txt").write_text(text)
    for content, message in (
        (map_[:-1], r"disp0.pfm: data: found 12287 bytes, expected 4 for each of 64x48 pixels"),
        (b"PF" + map_[2:], r"disp0.pfm: header: found b'PF"),
        (map_.replace(b"64 48", b"48 64"), r"disp0.pfm: size: found 48x64, expected 64x48"),
    ):
        (calib / "disp0.pfm").write_bytes(content)
        fails(message, calib)
    (calib / "disp0.pfm").unlink()
    fails(r"disp0.pfm: file: found no such file, expected a disparity map", calib)
    archive = npz / "scene_disp.npz"
    good = archive.read_bytes()
    archive.write_bytes(good[:100])
    fails(r"scene_disp.npz: archive: found .*, expected a whole zip archive", npz)
    np.savez(archive, np.array([{"a": 1}], dtype=object))
    fails(r"scene_disp.npz: arr_0 dtype: found object, expected real numbers", npz)
    np.savez(archive, other=np.zeros(HW))
    fails(r"scene_disp.npz: key: found other.npy, expected arr_0.npy", npz)
    np.savez(archive, np.zeros((3, 3)))
    fails(r"scene_disp.npz: arr_0: found shape \(3, 3\), expected \(48, 64\), as the image", npz)
    (npz / "meta.json").unlink()
    fails(r"meta.json: file: found no such file", npz)


def test_npz_bomb_is_not_unpacked(tmp_path: Path) -> None:
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    for name, body in (("liar", bytes(64)), ("big", bytes(safe_open.MAX_FILE_BYTES))):
        with zipfile.ZipFile(tmp_path / f"{name}.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            archive.writestr("data.npy", head.getvalue() + body)
    with pytest.raises(
        FormatError, match=r"liar.npz: data: found \(1000000000000,\) of float64: \d+ bytes of memory, expected at most"
    ):
        npy.read_npz(tmp_path / "liar.npz", "data")
    with pytest.raises(FormatError, match=r"big.npz: data: found an array that unpacks beyond the limit"):
        npy.read_npz(tmp_path / "big.npz", "data")


def test_bad_driving(tmp_path: Path) -> None:
    lidar = Pose(torch.cat([pose(i).R for i in range(3)]), torch.cat([pose(i).t for i in range(3)]))
    writers.write_driving(tmp_path, {"FRONT": walk(3)}, lidar)
    scene = next(tmp_path.glob("scene_*.json"))
    good = json.loads(scene.read_text())

    def edited(change: object) -> None:
        copy = json.loads(json.dumps(good))
        change(copy)
        scene.write_text(json.dumps(copy))

    edited(lambda s: s["data"][1]["datum"]["image"]["pose"]["rotation"].update(qw=None))
    fails(r"scene_0+.json: pose.rotation: found .*, expected 4 finite numbers", tmp_path)
    edited(lambda s: s["data"][1]["datum"]["image"]["pose"].update(rotation=dict.fromkeys(("qx", "qy", "qz", "qw"), 0)))
    fails(r"pose.rotation 0: found \[0.0, 0.0, 0.0, 0.0\], expected four numbers, not all zero", tmp_path)
    edited(lambda s: s["data"][1]["datum"]["image"].update(filename="/etc/passwd"))
    fails(r"filename: found /etc/passwd, expected a file inside the scene's folder", tmp_path)
    edited(lambda s: s["data"][1]["id"].update(timestamp="noon"))
    fails(r"id.timestamp: found noon, expected an ISO 8601 time", tmp_path)
    edited(lambda s: s.pop("samples"))
    fails(r"samples: found nothing, expected a list", tmp_path)
    edited(lambda s: s["data"][0]["datum"]["point_cloud"].update(point_format=["X", "Y", "INTENSITY"]))
    fails(r"npz: data: found shape \(\d+, 4\), expected points with columns X, Y, INTENSITY", tmp_path)
    edited(lambda s: None)
    fails(r"option crop_bottom: found 1.5", tmp_path, crop_bottom=1.5)
    fails(r"cameras: found REAR, expected images of FRONT", tmp_path, cameras=["REAR"])
    (tmp_path / "point_cloud" / "LIDAR" / "000001.npz").unlink()
    recording = data.open(tmp_path)
    assert recording.number.tolist() == [0, 2]
    assert recording.report == ("FRONT: instant 1 lacks its image or its sweep: left out",)
    next((tmp_path / "calibration").iterdir()).write_text('{"names": ["LIDAR"], "intrinsics": [{}]}')
    fails(r"names: found LIDAR, expected FRONT among as many names as intrinsics", tmp_path)


def test_format_error_survives_pickling() -> None:
    error = pickle.loads(pickle.dumps(FormatError(Path("a/b.png"), "size", "1x1", "2x2")))
    assert str(error) == "a/b.png: size: found 1x1, expected 2x2"
    assert len(str(FormatError("a", "f", "x" * 1000 + "\n", "y"))) < 200


def test_every_format_has_the_two_functions() -> None:
    for module in (driving, frames_dir, rectified, tum):
        assert module in data.FORMATS.values()
    for module in data.FORMATS.values():
        assert callable(module.recognise) and callable(module.read)


def test_numbered_folders_without_poses_and_with_grey_maps(tmp_path: Path) -> None:
    """8, 9, 10 in this order; depth as 16-bit PGM; poses as seven numbers a line, or none."""
    shots = walk(3, hw=(24, 32))
    writers.write_counted_frames(tmp_path, shots)
    for kind, ending in (("images", "png"), ("depth", "png")):
        for i, file in enumerate(sorted((tmp_path / kind).iterdir())):
            file.rename(tmp_path / kind / f"{8 + i}.{ending}")
    (tmp_path / "images").rename(tmp_path / "color")
    numbered = data.open(tmp_path)
    assert numbered.number.tolist() == [8, 9, 10] and numbered.poses is not None
    want = list(numbered)
    for file in sorted((tmp_path / "depth").iterdir()):
        code = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        file.unlink()
        head = b"P5\n# a remark\n32 24\n65535\n"
        file.with_suffix(".pgm").write_bytes(head + code.astype(">u2").tobytes())
    (tmp_path / "poses.txt").unlink()
    bare = data.open(tmp_path)
    assert bare.poses is None and bare.report == ("no poses.txt: no poses",)
    assert all(torch.equal(a.depth, b.depth) and torch.equal(a.image, b.image) for a, b in zip(bare, want, strict=True))
    (tmp_path / "pose.txt").write_text("0 0 0 0 0 0 1\n" * 3)
    unturned = data.open(tmp_path).poses
    assert unturned is not None and bool((unturned.R - torch.eye(3).double() == 0).all())
    (tmp_path / "pose.txt").write_text("0 0 0 0 0 0\n" * 3)
    fails("pose.txt: columns: found 6", tmp_path)
    (tmp_path / "pose.txt").unlink()
    grey = tmp_path / "depth" / "8.pgm"
    grey.write_bytes(grey.read_bytes()[:-1])
    fails("8.pgm: data: found 1535 bytes, expected 2 for each of 32x24 pixels", tmp_path)
