"""Readers against scenes of exact geometry, against the real pieces, and against damaged files."""

from __future__ import annotations

import io
import json
import math
import os
import pickle
import random
import shutil
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from dhtorch import data, tree
from dhtorch.data import codec_numpy, convert, driving, files, frames_dir, rectified, tum, writers
from dhtorch.data.files import FormatError
from dhtorch.data.recording import Recording, numbers
from dhtorch.data.writers import parts
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import lookup, se3
from dhtorch.records import Camera, Frame, Pose

ROOT = os.environ.get("DHTORCH_DATA")
real = pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")

BOX = torch.tensor([2.0, 1.5, 3.0], dtype=torch.float64)  # half sizes of the room, m
HW = (48, 64)
CAMERA = Camera(torch.tensor([[61.5, 58.25]]), torch.tensor([[33.5, 21.75]]))  # nothing about it is symmetric


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> Iterator[None]:
    """Many tiny operations: a second thread only waits, for long on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


# -------------------------------------------------------------------------------------- a room known to the last digit


def render(
    camera: Camera, T: Pose, hw: tuple[int, int], time: float = 0.0, depth_camera: Camera | None = None
) -> Frame:
    """What a camera at ``T`` inside the box sees; depth exact to float32."""
    xyz, _ = _hit(camera, T, hw)
    tone = [torch.sin(3 * xyz[..., 0] + 1), torch.sin(4 * xyz[..., 1] - xyz[..., 0]), torch.sin(5 * xyz[..., 2])]
    image = ((torch.stack(tone) * 0.5 + 0.5) * 255).round().to(torch.uint8)
    _, depth = _hit(depth_camera or camera, T, hw)
    stamp = torch.tensor([time], dtype=torch.float64)
    return Frame(image[None], depth[None].float(), camera, depth_camera, time=stamp, T_world_from_cam=T)


def _hit(camera: Camera, T: Pose, hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
    v, u = torch.meshgrid(torch.arange(hw[0]), torch.arange(hw[1]), indexing="ij")
    uv = torch.stack((u, v), -1).reshape(1, -1, 2).double()
    ray = se3.rotate(T.R, cameras.rays(camera.to(torch.float64), uv))[0]
    depth = ((torch.sign(ray) * BOX - T.t[0]) / ray).amin(-1)
    return (T.t[0] + depth[:, None] * ray).reshape(*hw, 3), depth.reshape(hw)


def pose(i: int) -> Pose:
    """A path with every rotation axis in it."""
    xi = torch.tensor([[0.25 - 0.03 * i, 0.7 + 0.05 * i, -0.4 + 0.04 * i, 0.3 * math.sin(i), 0.1 * i, -0.2 + 0.08 * i]])
    return se3.exp(xi.double())


def walk(n: int = 4, camera: Camera = CAMERA, hw: tuple[int, int] = HW, **options: Camera) -> list[Frame]:
    return [render(camera, pose(i), hw, 100 + i / 30, **options) for i in range(n)]


def off_wall(xyz: Tensor) -> Tensor:
    """Relative distance of world points from the walls."""
    return ((xyz.double().abs() / BOX).amax(-1) - 1).abs()


def world_points(frame: Frame) -> Tensor:
    v, u = torch.nonzero(frame.depth[0] > 0, as_tuple=True)
    uv = torch.stack((u, v), -1).double()[None]
    camera = (frame.depth_camera or frame.camera).to(torch.float64)
    return se3.apply(frame.T_world_from_cam, cameras.unproject(camera, uv, frame.depth[0, v, u].double()[None]))[0]


def disagreement(a: Frame, b: Frame, near: float = math.inf, reach: int = 0) -> tuple[float, int]:
    """Median of |z − z'| / z' between the points of ``a`` carried into ``b`` and the returns there, and their number.

    ``reach``: look for the agreeing return within so many pixels (sparse depth).
    """
    v, u = torch.nonzero((a.depth[0] > 0) & (a.depth[0] < near), as_tuple=True)
    xyz = cameras.unproject(a.depth_camera or a.camera, torch.stack((u, v), -1).float()[None], a.depth[0, v, u][None])
    xyz = se3.apply(se3.relative(a.T_world_from_cam, b.T_world_from_cam), xyz.double())
    uv, z = cameras.project(b.depth_camera or b.camera, xyz.float()), xyz[..., 2]
    best = torch.full_like(z, math.inf)
    for dv in range(-reach, reach + 1):
        for du in range(-reach, reach + 1):
            value, inside = lookup.nearest(b.depth, uv + torch.tensor([du, dv]))
            error = (z - value).abs() / value.clamp(min=1e-9)
            best = torch.where(inside & (value > 0) & (z > 0), torch.minimum(best, error), best)
    found = best[torch.isfinite(best)]
    return float(found.median()), found.numel()


# ------------------------------------------------------------------------------------------------ written, then read


def check_same(got: Recording, frames: list[Frame], step: float) -> None:
    """K, pose and time as written, depth to half a quantisation step, every point back on its wall."""
    for i, want in enumerate(frames):
        frame = got[i]
        assert frame.image.dtype == torch.uint8 and frame.depth.dtype == torch.float32
        assert torch.equal(frame.camera.f, want.camera.f) and torch.equal(frame.camera.c, want.camera.c)
        torch.testing.assert_close(frame.T_world_from_cam.R, want.T_world_from_cam.R, atol=1e-12, rtol=0)
        torch.testing.assert_close(frame.T_world_from_cam.t, want.T_world_from_cam.t, atol=1e-12, rtol=0)
        torch.testing.assert_close(frame.depth, want.depth, atol=step / 2 + 1e-6, rtol=0)
        assert torch.equal(frame.image, want.image)
        assert float(off_wall(world_points(frame)).max()) < 2 * step
    if len(frames) > 1:
        assert len(got) == len(frames)
        assert disagreement(got[0], got[1])[0] < 0.02


def test_tum_gives_back_the_scene(tmp_path: Path) -> None:
    lens = torch.tensor([tum._CALIBRATION[1][1]])
    frames = walk(3, CAMERA.replace(distortion=lens))
    writers.write_tum(tmp_path, frames)
    recording = data.open(tmp_path)
    assert recording.format == "tum" and recording.report == ()
    assert torch.equal(recording[0].camera.distortion, lens)
    torch.testing.assert_close(recording.times, torch.cat([f.time for f in frames]), atol=1e-6, rtol=0)
    check_same(recording, frames, 1 / 5000)


def blank(n: int) -> list[Frame]:
    """Frames of the size that the published TUM calibration belongs to, with nothing to see."""
    image, depth = torch.zeros(1, 3, 480, 640, dtype=torch.uint8), torch.ones(1, 480, 640)
    stamps = [torch.tensor([100 + i / 30], dtype=torch.float64) for i in range(n)]
    return [Frame(image, depth, CAMERA, time=t, T_world_from_cam=pose(i)) for i, t in enumerate(stamps)]


@pytest.mark.parametrize(
    ("number", "fx", "k1"), [(1, 517.306408, 0.262383), (2, 520.908620, 0.231222), (3, 535.4, None)]
)
def test_tum_takes_the_calibration_of_its_camera(tmp_path: Path, number: int, fx: float, k1: float | None) -> None:
    writers.write_tum(tmp_path, blank(1), camera=number)
    camera = data.open(tmp_path)[0].camera
    assert float(camera.f[0, 0]) == pytest.approx(fx)
    assert camera.distortion is None if k1 is None else float(camera.distortion[0, 0]) == pytest.approx(k1)
    ros = data.open(tmp_path, intrinsics="ros")[0].camera
    assert ros.distortion is None and ros.f.tolist() == [[525, 525]] and ros.c.tolist() == [[319.5, 239.5]]
    (tmp_path / "groundtruth.txt").unlink()
    named = tmp_path.rename(tmp_path.parent / f"rgbd_dataset_freiburg{number}_xyz")
    assert torch.equal(data.open(named)[0].camera.f, camera.f)
    assert torch.equal(data.open(named, camera=1)[0].camera.f, torch.tensor([[517.306408, 516.469215]]))


def test_named_frames_give_back_the_scene(tmp_path: Path) -> None:
    frames = walk()
    writers.write_named_frames(tmp_path, frames, fps=30)
    recording = data.open(tmp_path)
    assert recording.format == "frames_dir" and recording.rate_hz == 30 and recording.number.tolist() == [0, 1, 2, 3]
    torch.testing.assert_close(recording.times, torch.arange(4).double() / 30)
    check_same(recording, frames, 1 / 1000)


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
    exact = _hit(CAMERA, pose(0), HW)[1][None]
    # Half a pixel on a slanted wall, that is all that a warp to the nearest pixel may cost.
    assert float(((frame.depth - exact).abs() / exact)[filled].median()) < 0.01
    wrong = ((kept.depth - exact).abs() / exact).median()
    assert float(wrong) > 0.015  # so the check above can tell


def test_rectified_pairs_give_back_the_scene(tmp_path: Path) -> None:
    cams = [Camera(torch.tensor([[60.0, 60.0]]), torch.tensor([[c, 22.25]])) for c in (30.25, 33.5)]
    away = Pose(torch.eye(3, dtype=torch.float64)[None], torch.tensor([[0.125, 0, 0]], dtype=torch.float64))
    left, right = render(cams[0], se3.identity(1, BOX), HW), render(cams[1], away, HW)
    writers.write_calib_pair(tmp_path / "calib", left, right)
    writers.write_npz_pair(tmp_path / "npz", left, right)
    for name in ("calib", "npz"):
        recording = data.open(tmp_path / name)
        assert recording.format == "rectified" and recording.gap == 1 and recording.times is None
        assert len(recording) == 2
        check_same(recording, [left], 1e-5)
        frame = recording[1]
        assert not frame.depth.any() and torch.equal(frame.image, right.image)
        assert torch.equal(frame.camera.c, right.camera.c)
        torch.testing.assert_close(frame.T_world_from_cam.t, away.t, atol=1e-12, rtol=0)
        assert disagreement(recording[0], right)[0] < 0.005


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
    decode = files._decode
    monkeypatch.setattr(files, "_decode", lambda *args: decoded.append(args[0]) or decode(*args))
    recording = data.open(tmp_path)
    assert len(recording) == 4 and decoded == []
    frame = recording[2]
    assert len(decoded) == 2 and frame.image.shape == (1, 3, *HW)


def test_recording_is_a_sequence(tmp_path: Path) -> None:
    writers.write_named_frames(tmp_path, walk())
    recording = data.open(tmp_path, near=1.5, gap=2, levels=6, role="rotation")
    assert (recording.near, recording.gap, recording.levels, recording.role) == (1.5, 2, 6, "rotation")
    assert len(list(recording)) == 4
    assert torch.equal(recording[-1].image, recording[3].image)
    with pytest.raises(IndexError):
        recording[4]
    with pytest.raises(ValueError, match="found no frame"):
        replace(recording, number=numbers(0), poses=None)
    with pytest.raises(ValueError, match="found 4 poses, expected one for each of 3 frames"):
        replace(recording, number=numbers(3))


def test_recording_travels_to_spawned_workers(tmp_path: Path) -> None:
    writers.write_named_frames(tmp_path, walk())
    recording = pickle.loads(pickle.dumps(data.open(tmp_path)))
    loader = DataLoader(
        recording, batch_size=2, num_workers=1, collate_fn=tree.collate, multiprocessing_context="spawn"
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
        assert abs(parts.quaternion(c2w[:3, :3]) @ q) == pytest.approx(1, abs=1e-12)
    looking = convert.cv_from_gl(np.eye(4)[None])[0]
    np.testing.assert_array_equal(looking @ [0, 0, 1, 0], [0, 0, -1, 0])  # forward is −z in GL axes
    np.testing.assert_array_equal(looking @ [0, 1, 0, 0], [0, -1, 0, 0])  # down is −y


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
    depth = convert.splat(xyz, camera, (7, 9))
    want = torch.zeros(7, 9)
    want[3, 4], want[3, 5], want[3, 6] = 1, 1, 4
    assert torch.equal(depth, want)
    want[3, 6] = 0  # 4 m beside 1 m, one pixel apart
    assert torch.equal(convert.splat(xyz, camera, (7, 9), hide_px=1), want)
    assert not convert.splat(xyz[:0], camera, (7, 9)).any()


@pytest.mark.parametrize("reach", [1, 2, 3, 8])
def test_window_min_against_pooling(reach: int) -> None:
    depth = torch.rand(13, 17)
    want = -torch.nn.functional.max_pool2d(-depth[None, None], 2 * reach + 1, 1, reach)[0, 0]
    assert torch.equal(convert._window_min(depth, reach), want)


def test_association_is_one_to_one_and_closest_first() -> None:
    assert tum.associate([0.0, 0.1, 0.2], [0.11, 0.205, 0.5], 0.02) == [(1, 0), (2, 1)]
    assert tum.associate([0.0, 0.01], [0.009], 0.02) == [(1, 0)]
    assert tum.associate([0.0], [0.02], 0.02) == []  # the limit itself is outside
    rng = np.random.default_rng(1)
    a, b = np.sort(rng.uniform(0, 3, 40)), np.sort(rng.uniform(0, 3, 40))
    taken: dict[int, int] = {}
    for d, i, j in sorted((abs(x - y), i, j) for i, x in enumerate(a) for j, y in enumerate(b)):
        if d < 0.05 and i not in taken and j not in taken.values():
            taken[i] = j
    assert tum.associate(list(a), list(b), 0.05) == sorted(taken.items())


def test_tum_bridges_no_gap_of_the_trajectory(tmp_path: Path) -> None:
    frames = walk(4)
    frames = [f.replace(time=torch.tensor([100.0 + 0.5 * i], dtype=torch.float64)) for i, f in enumerate(frames)]
    writers.write_tum(tmp_path, frames)
    lines = (tmp_path / "groundtruth.txt").read_text().splitlines()
    lines[4] = lines[4].split()[0] + " nan nan nan nan nan nan nan"  # lost at frame 1
    lines[5] = lines[5].split()[0] + " 0 0 0 0 0 0 0"  # and, differently said, at frame 2
    (tmp_path / "groundtruth.txt").write_text("\n".join(lines))
    recording = data.open(tmp_path)
    assert recording.number.tolist() == [0, 3]
    assert recording.report == ("2 RGB-D frames without a pose within 0.02 s: left out",)
    assert len(data.open(tmp_path, poses=False)) == 4


def test_tum_interpolates_between_neighbouring_poses(tmp_path: Path) -> None:
    writers.write_tum(tmp_path, walk(2))
    a, b = pose(0), pose(1)
    rows = [
        f"{100 + s:.4f} " + parts.text_row([*T.t[0], *(q * parts.quaternion(T.R[0].numpy()))])
        for s, T, q in ((-0.004, a, 1), (0.012, b, -1))
    ]
    (tmp_path / "groundtruth.txt").write_text("# no camera named\n" + "\n".join(rows))
    recording = data.open(tmp_path)
    assert len(recording) == 1
    torch.testing.assert_close(recording.poses.t[0], 0.75 * a.t[0] + 0.25 * b.t[0], atol=1e-9, rtol=0)
    full = se3.rotation_angle(a.R.mT @ b.R)
    assert float(se3.rotation_angle(a.R.mT @ recording.poses.R) / full) == pytest.approx(0.25, abs=0.002)


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
    every = ", ".join((*data.FORMATS, *data.STACK_FORMATS))
    fails(rf"format: found an empty folder, expected one of {every}", tmp_path / "empty")
    (tmp_path / "scan.xyz").write_text("1 2 3")
    fails(r"scan.xyz: format: found a .xyz file, expected one of", tmp_path / "scan.xyz")
    for format in data.FORMATS:  # also where the reader is named and the path is a file
        fails(r"scan.xyz", tmp_path / "scan.xyz", format)
    fails(rf"format: found kitti, expected auto, {every}", named, "kitti")
    fails(r"data: format frames_dir has no option 'unit', expected one of K, K_depth, distortion", named, unit=3)
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
    with pytest.raises(FormatError, match=r"scenes: .*expected an entry with a path"):
        data.open_scenes(named, [{"near": 2.0}])


def test_damaged_pictures(named: Path) -> None:
    colour, depth = named / "frame-000001.color.png", named / "frame-000001.depth.png"
    good_colour, good_depth = colour.read_bytes(), depth.read_bytes()
    colour.write_bytes(good_colour[: len(good_colour) // 2])
    fails(
        r"frame-000001.color.png: data: found a truncated or damaged png file of \d+ bytes, expected all of it", named
    )
    colour.write_bytes(good_colour[:60] + bytes([good_colour[60] ^ 1]) + good_colour[61:])
    fails(r"color.png: data: found a truncated or damaged", named)
    colour.write_bytes(b"")
    fails(r"color.png: file size: found 0 bytes", named)
    colour.write_bytes(b"GIF89a" + bytes(40))
    fails(r"color.png: content: found b'GIF89a.*expected a PNG or JPEG image", named)
    colour.write_bytes(parts.png(np.zeros((10, 12, 3), np.uint8)))
    fails(r"color.png: size: found 12x10, expected 64x48", named)
    colour.write_bytes(parts.png(np.zeros(HW, np.uint16)))
    fails(r"color.png: bits per channel: found 16, expected 8", named)
    colour.write_bytes(good_colour)
    depth.write_bytes(parts.png(np.zeros((*HW, 1), np.uint8)))
    fails(r"depth.png: depth: found png with 1 channels of 8 bits, expected png with 1 channel of 16 bits", named)
    depth.write_bytes(good_colour)
    fails(r"depth.png: depth: found png with 3 channels of 8 bits", named)
    depth.write_bytes(parts.png(np.zeros((24, 32), np.uint16)))
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
    header = files.image_header(file)
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
    (tmp_path / "c.png").write_bytes(parts.png(picture))
    assert files.read_image(tmp_path / "c.png")[:, 0, 1].tolist() == [250, 100, 3]
    (tmp_path / "d.png").write_bytes(parts.png(np.array([[0, 65535, 1234]], np.uint16)))
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
    fails(r"images: frames: found no image", counted)


def test_bad_poses(counted: Path) -> None:
    file = counted / "poses.txt"
    rows = np.loadtxt(file)
    for column, value, message in (
        (0, "nan", r"poses.txt: pose: found a non-finite number in matrix 1"),
        (0, "5", r"poses.txt: pose 1 determinant: found .*, expected 1 \(a rotation\)"),
        (15, "2", r"poses.txt: pose 1 last row: found \[0.0, 0.0, 0.0, 2.0\], expected 0 0 0 1"),
    ):
        bad = rows.copy()
        bad[1, column] = float(value)
        np.savetxt(file, bad)
        fails(message, counted)
    file.write_text("1 2 3\n")
    fails(r"poses.txt: line 1: found 3 columns, expected 16 numbers", counted)
    file.write_text(" ".join(["one"] * 16))
    fails(r"poses.txt: line 1: found one one", counted)
    file.unlink()
    fails(r"poses.txt: file: found no such file", counted, "frames_dir")


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
        ("60 0 30\n0 60 20", r"K.txt: K: found .*expected 3x3"),
    ):
        file.write_text(text)
        fails(message, counted)
    file.unlink()
    fails(r"K: found neither meta.json nor an intrinsics file, expected one of them, or option K", counted)
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


def test_bad_tum(tmp_path: Path) -> None:
    writers.write_tum(tmp_path, blank(3), camera=1)
    good = {name: (tmp_path / name).read_text() for name in ("rgb.txt", "depth.txt", "groundtruth.txt")}

    def restore() -> None:
        for name, text in good.items():
            (tmp_path / name).write_text(text)

    (tmp_path / "depth.txt").write_text(good["depth.txt"].replace("100.", "900.", 1))
    recording = data.open(tmp_path)
    assert len(recording) == 2 and recording.report == ("1 images without a depth map within 0.02 s: left out",)
    lagging = good["depth.txt"].replace("\n1", "\n7")
    (tmp_path / "depth.txt").write_text(lagging)
    fails(r"time stamps: found 3 images and 3 depth maps, none within 0.02 s of one another, expected pairs", tmp_path)
    restore()
    (tmp_path / "groundtruth.txt").write_text(good["groundtruth.txt"].replace("\n100", "\n500"))
    fails(r"groundtruth.txt: time stamps: found no pose within 0.02 s of any image, expected overlapping", tmp_path)
    (tmp_path / "groundtruth.txt").write_text("# freiburg1\n")
    fails(r"groundtruth.txt: poses: found no usable row", tmp_path)
    (tmp_path / "groundtruth.txt").write_text("# freiburg1\n1 2 3\n")
    fails(r"groundtruth.txt: line 2: found 3 columns, expected 8 numbers", tmp_path)
    (tmp_path / "groundtruth.txt").unlink()
    fails(r"camera: found an unknown one, expected freiburg1, 2 or 3 in the folder's name, option camera", tmp_path)
    assert data.open(tmp_path, camera=2).poses is None
    fails(r"option camera: found 4, expected 1, 2 or 3", tmp_path, camera=4)
    fails(r"option intrinsics: found default, expected camera or ros", tmp_path, intrinsics="default")
    restore()
    (tmp_path / "rgb.txt").write_text(good["rgb.txt"].replace("rgb/", "../rgb/"))
    fails(r"rgb.txt: line 2: found ../rgb/.*, expected a file inside the sequence's folder", tmp_path)
    (tmp_path / "rgb.txt").write_text("soon rgb/1.png\n")
    fails(r"rgb.txt: line 1: found soon rgb/1.png, expected a time stamp and a file name", tmp_path)
    restore()
    next((tmp_path / "rgb").iterdir()).unlink()
    fails(r"rgb/100.*png: file: found no such file, expected a readable file", tmp_path)


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
    fails(r"scene_disp.npz: archive: found .*, expected a whole .npz archive", npz)
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
    for name, body in (("liar", bytes(64)), ("big", bytes(files.MAX_BYTES))):
        with zipfile.ZipFile(tmp_path / f"{name}.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            archive.writestr("data.npy", head.getvalue() + body)
    with pytest.raises(FormatError, match=r"liar.npz: data: found 64 bytes, expected \(1000000000000,\) of float64"):
        codec_numpy.read_npz(tmp_path / "liar.npz", "data")
    with pytest.raises(FormatError, match=r"big.npz: data: found an array that unpacks beyond the limit"):
        codec_numpy.read_npz(tmp_path / "big.npz", "data")


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


def _written(name: str, root: Path) -> Path:
    """Two small frames in one of the layouts."""
    if name == "named":
        writers.write_named_frames(root, walk(2, depth_camera=CAMERA), fps=30)
    elif name == "counted":
        writers.write_counted_frames(root, walk(2))
    elif name == "driving":
        writers.write_driving(root, {"FRONT": walk(2)}, Pose(torch.cat([pose(0).R] * 2), torch.cat([pose(0).t] * 2)))
    elif name == "tum":
        writers.write_tum(root, walk(2))
    else:
        left, right = render(CAMERA, pose(0), HW), render(CAMERA, pose(0), HW)
        f = CAMERA.f[:, :1].expand(1, 2)
        left, right = (x.replace(camera=CAMERA.replace(f=f)) for x in (left, right))
        right = right.replace(T_world_from_cam=Pose(pose(0).R, pose(0).t + torch.tensor([[0.125, 0, 0]])))
        {"calib": writers.write_calib_pair, "npz": writers.write_npz_pair}[name](root, left, right)
    return root


@pytest.mark.parametrize("name", ["named", "counted", "tum", "driving", "calib", "npz"])
def test_damaged_bytes_are_a_format_error_or_valid_frames(name: str, tmp_path: Path) -> None:
    _written(name, tmp_path)
    format = data.recognise(tmp_path)[0]
    assert sum(len(recording) for recording in data.open_all(tmp_path)) == 2
    victims = sorted(file for file in tmp_path.rglob("*") if file.is_file())
    tokens = (b"nan", b"inf", b"-1", b"1e999", b"", b"\x00", b'"', b"[", b"null", b"9" * 20, b"\xff\xff", b"\n")
    draw = random.Random(name)
    refused = 0
    for _ in range(100):
        file = draw.choice(victims)
        good = file.read_bytes()
        at = draw.randrange(len(good) if draw.random() < 0.5 else min(60, len(good)))
        file.write_bytes(
            good[:at] + (draw.choice(tokens) + good[at + draw.randrange(4) :] if draw.random() < 0.8 else b"")
        )
        try:
            frames = [frame for recording in data.open_all(tmp_path, format) for frame in recording]
            for frame in frames:
                assert bool(torch.isfinite(frame.depth).all()) and bool((frame.depth >= 0).all())
                assert bool((frame.camera.f > 0).all()) and bool(torch.isfinite(frame.T_world_from_cam.R).all())
        except FormatError as error:
            assert "\n" not in str(error) and str(tmp_path) in str(error)
            refused += 1
        file.write_bytes(good)
    assert refused > 50


def test_format_error_survives_pickling() -> None:
    error = pickle.loads(pickle.dumps(FormatError(Path("a/b.png"), "size", "1x1", "2x2")))
    assert str(error) == "a/b.png: size: found 1x1, expected 2x2"
    assert len(str(FormatError("a", "f", "x" * 1000 + "\n", "y"))) < 200


# -------------------------------------------------------------------------------------------------------- real pieces

# Largest median disagreement of points carried from the first and the last anchor into their partner with the data set's
# own poses: about 1.5 times what was measured (holo_a 0.27 %, kitchens 0.38, 0.66, 0.53, 0.54 %, desk9 0.44 %, rpy 0.89 %).
# Transposed, inverted or GL poses gave 2.0 % at the very least, mostly 5 to 40 %.
WORLD = [
    ("holo_a", 3, 0.004),
    ("7s_redkitchen_000", 20, 0.006),
    ("7s_redkitchen_200", 20, 0.010),
    ("7s_redkitchen_400", 20, 0.008),
    ("7s_redkitchen_600", 20, 0.008),
    ("tum_fr1_desk9", 4, 0.007),
    ("tum_fr1_rpy_a", 4, 0.013),
]


@pytest.mark.data
@real
@pytest.mark.parametrize(("name", "gap", "bound"), WORLD)
def test_real_frames_agree_in_the_world(name: str, gap: int, bound: float) -> None:
    recording = data.open(Path(ROOT) / name)
    R, t = recording.poses.R, recording.poses.t
    wrong = [Pose(R.mT, t), se3.invert(recording.poses), Pose(R @ torch.diag(torch.tensor([1.0, -1, -1]).to(R)), t)]
    for i in (0, len(recording) - gap - 1):
        assert disagreement(recording[i], recording[i + gap])[0] < bound
        for poses in wrong:  # the check can tell
            mistaken = replace(recording, poses=poses)
            assert disagreement(mistaken[i], mistaken[i + gap])[0] > 1.5 * bound
    frame = recording[0]
    assert frame.image.shape[1:] == (3, *frame.hw) and frame.depth.shape[1:] == frame.hw and frame.depth_camera is None
    assert recording.report == () and not bool(torch.isnan(frame.depth).any()) and float(frame.depth.max()) < 14


@pytest.mark.data
@real
def test_real_driving_agrees_in_the_world() -> None:
    recordings = data.open_all(Path(ROOT) / "dgp_drive6cam", crop_bottom=0.25)
    assert [r.name.split("/")[1] for r in recordings] == ["CAMERA_01", "CAMERA_05", "CAMERA_07"]
    # Measured 1.2, 0.5 and 0.5 %, with the best return within 3 px; transposed rotations gave 1.3 % (a long lens that
    # looks straight ahead), 6.5 and 7.5 %.
    for recording, bound in zip(recordings, (0.018, 0.0075, 0.0075), strict=True):
        assert len(recording) == 3 and recording.sparse and len(recording.report) == 3
        assert recording[0].image.shape == (1, 3, 912, 1936)
        error, count = disagreement(recording[0], recording[1], reach=3)
        assert error < bound and count > 300
        step = recording.poses.t.diff(dim=0).norm(dim=-1)
        assert bool(((step > 0.5) & (step < 2)).all())


@pytest.mark.data
@real
@pytest.mark.parametrize("name", ["middlebury_motorcycle", "eth3d_terrace"])
def test_real_pairs_match_along_the_disparity(name: str) -> None:
    """Grey values found through depth, K and pose in the other image: best where they are, worse 2 px aside."""
    left, right = data.open(Path(ROOT) / name)
    v, u = torch.nonzero(left.depth[0, ::3, ::3] > 0, as_tuple=True)
    v, u = 3 * v, 3 * u
    xyz = cameras.unproject(left.camera, torch.stack((u, v), -1).float()[None], left.depth[0, v, u][None])
    uv = cameras.project(
        right.camera, se3.apply(se3.relative(left.T_world_from_cam, right.T_world_from_cam), xyz).float()
    )
    grey = [lookup.luma(f.image, 1)[:, 0] for f in (left, right)]

    def miss(du: float) -> float:
        value, inside = lookup.nearest(grey[1], uv + torch.tensor([du, 0]))
        return float((value - grey[0][0, v, u]).abs()[inside].mean())

    errors = {du: miss(du) for du in (-2, -1, 0, 1, 2)}
    assert min(errors, key=errors.get) == 0, errors
    assert float(left.depth[left.depth > 0].min()) > 1.5 and not bool(right.depth.any())


@pytest.mark.data
@real
def test_all_real_pieces_are_recognised_by_their_content() -> None:
    want = {"holo_a": "frames_dir", "7s_redkitchen_000": "frames_dir", "tum_fr1_desk9": "tum", "tum_fr1_rpy_a": "tum"}
    want |= {"middlebury_motorcycle": "rectified", "eth3d_terrace": "rectified", "dgp_drive6cam": "driving"}
    assert {name: data.recognise(Path(ROOT) / name)[0] for name in want} == want


@pytest.mark.data
@real
def test_side_cars_are_not_required_where_the_format_says_it(tmp_path: Path) -> None:
    """holo_a, desk9, terrace and the car without their meta.json: the same scene."""
    for name in ("holo_a", "tum_fr1_desk9", "eth3d_terrace", "dgp_drive6cam"):
        bare = tmp_path / f"bare_{name}"
        bare.mkdir()
        for entry in (Path(ROOT) / name).iterdir():
            if entry.name != "meta.json":
                (bare / entry.name).symlink_to(entry)
        a, b = data.open_all(bare)[0][0], data.open_all(Path(ROOT) / name)[0][0]
        assert torch.equal(a.depth, b.depth)
        torch.testing.assert_close(a.camera.f, b.camera.f)


def test_every_format_has_the_two_functions() -> None:
    for module in (driving, frames_dir, rectified, tum):
        assert module in data.FORMATS.values()
    for module in data.FORMATS.values():
        assert callable(module.recognise) and callable(module.read)
