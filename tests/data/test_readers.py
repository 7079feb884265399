"""Readers against scenes of exact geometry, against the real pieces, and against damaged files."""

import io
import math
import pickle
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from support import writers
from support.box_scene import BOX, CAMERA, HW, check_same, disagreement, hit, pose, render, walk
from support.capture_cases import DELETE, Case, check_case
from support.writers import parts

from dhtorch import data
from dhtorch.data import convert
from dhtorch.data.codecs import npy
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.recording import consecutive_frame_numbers
from dhtorch.data.scene import Scene
from dhtorch.export import arrays
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame, Pose
from dhtorch.runtime import safe_open

# ------------------------------------------------------------------------------------------------ written, then read


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


def stereo_pair() -> list[Frame]:
    """Frames of a rectified pair with a baseline of 12.5 cm."""
    cams = [Camera(torch.tensor([[60.0, 60.0]]), torch.tensor([[c, 22.25]])) for c in (30.25, 33.5)]
    away = Pose(torch.eye(3, dtype=torch.float64)[None], torch.tensor([[0.125, 0, 0]], dtype=torch.float64))
    return [render(cams[0], se3.identity(1, BOX), HW), render(cams[1], away, HW)]


def test_rectified_pairs_give_back_the_scene(tmp_path: Path) -> None:
    left, right = stereo_pair()
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
        torch.testing.assert_close(frame.T_world_from_cam.t, right.T_world_from_cam.t, atol=1e-12, rtol=0)
        assert disagreement(recording[0], right)[0] < 0.005


# ------------------------------------------------------------------------------------------------------- recordings


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


def still_driving(root: Path, frames: list[Frame]) -> None:
    lidar = Pose(torch.cat([pose(i).R for i in range(3)]), torch.cat([pose(i).t for i in range(3)]))
    writers.write_driving(root, {"FRONT": frames}, lidar)


def write_views(root: Path, _frames: list[Frame]) -> None:
    """A pair of Middlebury 2005 with constant disparities."""
    codes = np.full((370, 463), 90, np.uint8)
    codes[:, :50] = 0
    for name, image in {"view1": codes, "view5": codes, "disp1": codes, "disp5": codes + 1}.items():
        cv2.imwrite(str(root / f"{name}.png"), image)
    (root / "dmin.txt").write_text("270\n")


def write_car(root: Path, frames: list[Frame], *, both: bool = False) -> None:
    """A scene whose LiDAR has poses of its own, with one camera or two."""
    T = se3.exp(torch.tensor([[1.0, -0.3 + 0.1 * i, 0.2, 0.1, 0.2, 0.3] for i in range(len(frames))]).double())
    left = {"LEFT": [render(CAMERA, pose(i + 7), HW, 100 + i / 30) for i in range(3)]} if both else {}
    writers.write_driving(root / "one", {"FRONT": frames, **left}, T)


def write_calib(root: Path, frames: list[Frame]) -> None:
    writers.write_calib_pair(root, *frames)


def write_npz(root: Path, frames: list[Frame]) -> None:
    writers.write_npz_pair(root, *frames)


def npz(*arrays_: np.ndarray, **named: np.ndarray) -> bytes:
    """An archive of arrays."""
    file = io.BytesIO()
    np.savez(file, *arrays_, **named)
    return file.getvalue()


def poses_with(place: tuple[int, int], value: float) -> str:
    rows = np.stack([arrays.pose_matrix(frame).ravel() for frame in walk(3)])
    rows[place] = value
    return parts.format_rows(rows)


COLOUR, DEPTH = "frame-000001.color.png", "frame-000001.depth.png"
PNG = parts.encode_unfiltered_png(arrays.frame_to_hwc(walk(2)[1]))
HUGE = PNG[:16] + (60000).to_bytes(4, "big") * 2 + PNG[24:]
named, counted = writers.write_named_frames, writers.write_counted_frames
K_60 = '"K": [[60, 0, 30], [0, 60, 20], [0, 0, 1]]'
SCENE = "scene_0000000000000000000000000000000000000000.json"
PGM = b"P5\n# a remark\n64 48\n65535\n"


def pgm(i: int) -> bytes:
    return PGM + arrays.encode_depth_codes(walk(i + 1)[i].depth, 1000).astype(">u2").tobytes()


def datum(k: int, **change: object) -> tuple[str, object]:
    """An edit of an entry of a scene of DGP."""
    return SCENE, {"data": {k: change}}


CASES = [
    # images
    *(Case(f"{file} {k}", named, 3, [(file, content)], error=message) for k, (file, content, message) in enumerate((
        (COLOUR, PNG[: len(PNG) // 2],
         r"frame-000001.color.png: data: found a truncated or damaged png file of \d+ bytes, expected a whole file"),
        (COLOUR, PNG[:60] + bytes([PNG[60] ^ 1]) + PNG[61:], r"color.png: data: found a truncated or damaged"),
        (COLOUR, b"", r"color.png: file size: found 0 bytes"),
        (COLOUR, b"GIF89a" + bytes(40), r"color.png: content: found b'GIF89a.*expected a PNG or JPEG image"),
        (COLOUR, np.zeros((10, 12, 3), np.uint8), r"color.png: size: found 12x10, expected 64x48"),
        (COLOUR, np.zeros(HW, np.uint16), r"color.png: bits per channel: found 16, expected 8"),
        (COLOUR, HUGE, r"color.png: size: found 60000x60000, expected 1 to 64000000 pixels"),
        (DEPTH, np.zeros((*HW, 1), np.uint8),
         r"depth.png: depth: found png with 1 channels of 8 bits, expected png with 1 channel of 16 bits"),
        (DEPTH, PNG, r"depth.png: depth: found png with 3 channels of 8 bits"),
        (DEPTH, np.zeros((24, 32), np.uint16), r"depth.png: size: found 32x24, expected 64x48")))),
    # numbered frames
    Case("named frames at a rate", named, 4, (), {"rate": 30, "times": [0, 1 / 30, 2 / 30, 3 / 30], "number": [0, 1, 2, 3],
         "same": ([0, 1, 2, 3], 1e-3, 1.0, True)}, written={"fps": 30}),
    Case("an incomplete frame", named, 3, [(DEPTH, DELETE)],
         {"number": [0, 2], "report": ("frame 1: no depth: left out",), "same": ([0, 2], 1e-3)}),
    Case("no whole frame", named, 3, [("*.depth.png", DELETE)],
         error=r"frames: found none complete among 3, expected frame-XXXXXX"),
    Case("counted frames have no times", counted, 4, (), {"times": None, "same": ([0, 1, 2, 3], 1e-3)}),
    Case("fewer poses", counted, 3, [("poses.txt", lambda text: "\n".join(text.splitlines()[:2]))],
         error=r"poses.txt count: found 2, expected 3, one for each file of images/"),
    Case("another name", counted, 3, [("depth/00001.png", Path("depth/00007.png"))],
         error=r"file names: found 00001 in one of images/ and depth/, expected the same names in both"),
    Case("fewer depth maps", counted, 3, [("depth/00001.png", DELETE)], error=r"depth count: found 2, expected 3"),
    Case("no image", counted, 3, [("images/*", DELETE)], error=r"images: frames: found no image",
         options={"format": "frames_dir"}),
    Case("a pose that is no rotation", counted, 3, [("poses.txt", poses_with((1, 0), 5))],
         error=r"poses.txt: pose 1 determinant: found .*, expected 1 \(a rotation\)"),
    Case("a pose of another scale", counted, 3, [("poses.txt", poses_with((1, 15), 2))],
         error=r"poses.txt: pose 1 last row: found \[0.0, 0.0, 0.0, 2.0\], expected 0 0 0 1"),
    Case("poses of three numbers", counted, 3, [("poses.txt", "1 2 3\n" * 3)],
         error=r"poses.txt: columns: found 3, expected 16 \(4x4 by rows\) or 7"),
    Case("poses of six numbers", counted, 3, [("poses.txt", DELETE), ("pose.txt", "0 0 0 0 0 0\n" * 3)],
         error="pose.txt: columns: found 6"),
    Case("poses of words", counted, 3, [("poses.txt", " ".join(["one"] * 16))], error=r"poses.txt: line 1: found one one"),
    Case("no poses", counted, 3, [("poses.txt", DELETE)], {"posed": False, "report": ("no poses.txt: no poses",)},
         options={"format": "frames_dir"}),
    Case("numbers of two digits, in color/", counted, 3,
         [(f"{folder}/{i:05d}.png", Path(f"{to}/{8 + i}.png")) for folder, to in (("images", "color"), ("depth", "depth"))
          for i in range(3)],
         {"number": [8, 9, 10], "same": ([0, 1, 2], 1e-3)}),
    Case("depth as 16-bit grey maps", counted, 2,
         [(f"depth/{i:05d}.png", DELETE) for i in range(2)] + [(f"depth/{i:05d}.pgm", pgm(i)) for i in range(2)],
         {"same": ([0, 1], 1e-3)}),
    Case("a short grey map", counted, 1, [("depth/00000.png", DELETE), ("depth/00000.pgm", pgm(0)[:-1])],
         error="00000.pgm: data: found 6143 bytes, expected 2 for each of 64x48 pixels"),
    *(Case(f"K {text!r}", counted, 3, [("K.txt", text)], error=message) for text, message in (
        ("nan 0 30\n0 60 20\n0 0 1", r"K.txt: K: found \[\[nan, .*expected 3x3 finite numbers"),
        ("0 0 30\n0 60 20\n0 0 1", r"K.txt: K focal length: found \[0.0, 60.0\], expected two positive"),
        ("60 0 3000\n0 60 20\n0 0 1",
         r"K.txt: K principal point: found \[3000.0, 20.0\], expected a place near the 64x48"),
        ("60 9 30\n0 60 20\n0 0 1", r"K.txt: K: found .*no skew"),
        ("60 0 30\n0 60 20", r"K.txt: K: found 6 numbers, expected fx fy cx cy, or a 3x3 or 4x4 matrix"))),
    Case("no K", counted, 3, [("K.txt", DELETE)], error=r"K: found no intrinsics, expected data.fov=69"),
    Case("no K, an option", counted, 3, [("K.txt", DELETE)], {"f": [60, 61]}, options={"K": (60, 61, 30, 20)}),
    Case("an option of two numbers", counted, 3, [("K.txt", DELETE)], options={"K": (60, 61)},
         error=r"option K: found \[60.0, 61.0\], expected 4 finite numbers"),
    *(Case(f"meta.json {text[:60]}", counted, 3, [("meta.json", text)], error=message) for text, message in (
        (f'{{{K_60}, "dist": [1, 2]}}', r"distortion: found \[1, 2\], expected 4, 5 or 8 numbers"),
        ('{"K": ', r"meta.json: JSON: found Expecting value"), ("[" * 100000, r"meta.json: JSON: "),
        (f'{{{K_60}, "depth_scale": -1}}', r"meta.json: depth_scale: found -1.0, expected a positive number"))),
    # pairs
    *(Case(f"calib.txt {old} {new}", write_calib, stereo_pair, [("calib.txt", [(old, new)])], error=message)
      for old, new, message in (
          ("doffs=3.25", "doffs=9", r"calib.txt: doffs: found 9.0, expected 3.25, the difference of the principal points"),
          ("baseline=125.0", "baseline=0", r"calib.txt: baseline: found 0.0, expected a positive length"),
          ("baseline=125.0", "", r"calib.txt: baseline: found nothing, expected a finite number"),
          ("width=64", "width=65", r"calib.txt: width and height: found 65x48, expected 64x48, as im0.png"),
          ("cam1=[60.0", "cam1=[50.0", r"calib.txt: focal length: found .*, expected equal ones"),
          ("cam0=[", "cam0=[x", r"calib.txt: cam0: found "))),
    *(Case(f"disp0.pfm {k}", write_calib, stereo_pair, [("disp0.pfm", content)], error=message)
      for k, (content, message) in enumerate((
          (b"Pf\n64 48\n-1\n" + bytes(12287), r"disp0.pfm: data: found 12287 bytes, expected 4 for each of 64x48 pixels"),
          (b"PF\n64 48\n-1\n" + bytes(12288), r"disp0.pfm: header: found b'PF"),
          (b"Pf\n48 64\n-1\n" + bytes(12288), r"disp0.pfm: size: found 48x64, expected 64x48"),
          (DELETE, r"disp0.pfm: file: found no such file, expected a disparity map")))),
    *(Case(f"scene_disp.npz {k}", write_npz, stereo_pair, [("scene_disp.npz", content)], error=message)
      for k, (content, message) in enumerate((
          (npz(np.zeros(HW))[:100], r"scene_disp.npz: archive: found .*, expected a whole zip archive"),
          (npz(np.array([{"a": 1}], dtype=object)), r"scene_disp.npz: arr_0 dtype: found object, expected real numbers"),
          (npz(other=np.zeros(HW)), r"scene_disp.npz: key: found other.npy, expected arr_0.npy"),
          (npz(np.zeros((3, 3))), r"scene_disp.npz: arr_0: found shape \(3, 3\), expected \(48, 64\), as the image")))),
    # A third of the size: f = 3740 / 3 px, disparity 90 / 3 px, and a shift of 270 / 3 px between the principal points.
    Case("middlebury 2005", write_views, 1, (), {
        "f": pytest.approx([3740 / 3] * 2), "c": [231.0, 184.5], "last c": pytest.approx([321.0, 184.5]),
        "returns": 370 * 413, "report": ["principal point assumed"], "second": [0.16, 0, 0],
        "medians": pytest.approx([0.16 * 3740 / (k + 270) for k in (90, 91)])}),
    Case("middlebury 2005 without a shift", write_views, 1, [("dmin.txt", "far\n")], error=r"dmin\.txt: shift"),
    Case("an npz pair without meta.json", write_npz, stereo_pair, [("meta.json", DELETE)],
         error=r"meta.json: file: found no such file"),
    # driving
    Case("driving", write_car, 3, (),
         {"format": "driving", "title": "one/FRONT", "rate": pytest.approx(30, rel=1e-3), "same": ([0, 1, 2], 1e-5, 1.0, True),
          "times": pytest.approx([100 + i / 30 for i in range(3)], abs=2e-6)}, options={"hide_px": 0}, path="one"),
    *(Case(f"driving, {n} frames", write_car, n, (), {"rate": rate, "number": list(range(n))}, options={"hide_px": 0},
           path="one") for n, rate in ((1, None), (2, pytest.approx(30, rel=1e-3)))),
    *(Case(f"driving, two cameras, {name}", write_car, 3, (), {"title": f"one/{name}", "hw": HW}, which=k, path="one",
           written={"both": True}) for k, name in enumerate(("FRONT", "LEFT"))),
    Case("driving, one camera without the car", write_car, 3, (),
         {"title": "one/LEFT", "hw": (36, 64), "depth hw": (36, 64), "c": CAMERA.c[0].tolist()}, path="one",
         written={"both": True}, options={"cameras": ["LEFT"], "crop_bottom": 0.25}),
    *(Case(f"driving {message[:50]}", still_driving, 3, edits, error=message, options=options)
      for edits, options, message in (
          ([datum(1, datum={"image": {"pose": {"rotation": {"qw": None}}}})], {},
           r"scene_0+.json: pose.rotation: found .*, expected 4 finite numbers"),
          ([datum(1, datum={"image": {"pose": {"rotation": dict.fromkeys(("qx", "qy", "qz", "qw"), 0)}}})], {},
           r"pose.rotation 0: found \[0.0, 0.0, 0.0, 0.0\], expected four numbers, not all zero"),
          ([datum(1, datum={"image": {"filename": "/etc/passwd"}})], {},
           r"filename: found /etc/passwd, expected a file inside the scene's folder"),
          ([datum(1, id={"timestamp": "noon"})], {}, r"id.timestamp: found noon, expected an ISO 8601 time"),
          ([(SCENE, {"samples": DELETE})], {}, r"samples: found nothing, expected a list"),
          ([datum(0, datum={"point_cloud": {"point_format": ["X", "Y", "INTENSITY"]}})], {},
           r"npz: data: found shape \(\d+, 4\), expected points with columns X, Y, INTENSITY"),
          ([], {"crop_bottom": 1.5}, r"option crop_bottom: found 1.5"),
          ([], {"cameras": ["REAR"]}, r"cameras: found REAR, expected images of FRONT"),
          ([("calibration/*.json", '{"names": ["LIDAR"], "intrinsics": [{}]}')], {},
           r"names: found LIDAR, expected FRONT among as many names as intrinsics"))),
    Case("an instant without its sweep", still_driving, 3, [("point_cloud/LIDAR/000001.npz", DELETE)],
         {"number": [0, 2], "report": ("FRONT: instant 1 lacks its image or its sweep: left out",)}),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_variants_are_read_and_faults_named(case: Case, tmp_path: Path) -> None:
    check_case(case, tmp_path)


@pytest.mark.parametrize(
    ("path", "format", "message"),
    [
        ("nowhere", "auto", r"nowhere: path: found no such file or folder, expected a capture"),
        ("nowhere", "tum", r"nowhere: path: found no such file or folder, expected a tum capture"),
        ("empty", "auto", r"format: found an empty folder, expected from a phone: Record3D's \.r3d"),
        ("empty", "frames_dir", r"frames: found none, expected frame-XXXXXX"),
        (
            "scan.xyz",
            "auto",
            r"scan.xyz: format: found a finished 3D model without its frames, expected the frames, from a phone",
        ),
        *(("scan.xyz", format, r"scan.xyz") for format in data.FORMATS),  # a file, also where the reader is named
        ("scene", "kitti", rf"format: found kitti, expected auto, {', '.join(data.FORMATS)}"),
        ("scene", "driving", r"scene_\*.json: found 0 such files, expected exactly one"),
        ("scene", "tum", r"rgb frames: found none"),
        ("scene", "rectified", r"calib.txt|left.png: found 0 such files"),
    ],
)
def test_nothing_there_or_unknown(tmp_path: Path, path: str, format: str, message: str) -> None:
    writers.write_named_frames(tmp_path / "scene", walk(1))
    (tmp_path / "empty").mkdir()
    (tmp_path / "scan.xyz").write_text("1 2 3")
    with pytest.raises(FormatError, match=message) as caught:
        _ = data.open_all(tmp_path / path, format)[0]
    assert "\n" not in str(caught.value)


def test_an_unknown_option_is_named_beside_the_known_ones(tmp_path: Path) -> None:
    writers.write_named_frames(tmp_path, walk(1))
    assert data.recognise(tmp_path) == ("frames_dir", "frame-XXXXXX.{color,depth,pose} files")
    with pytest.raises(ValueError, match="format frames_dir has no option 'unit', expected one of intrinsics, K, fov"):
        data.open(tmp_path, unit=3)


def test_scenes_need_their_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tmp_path / "scene"
    writers.write_named_frames(scene, walk(3))
    scenes = [{"path": scene.name, "near": 2.0, "gap": 1}, {"path": scene.name, "format": "frames_dir", "levels": 6}]
    monkeypatch.delenv("DHTORCH_DATA", raising=False)
    with pytest.raises(FormatError, match="DHTORCH_DATA: environment variable: found nothing, expected the folder"):
        data.open_scenes(scenes=scenes)
    monkeypatch.setenv("DHTORCH_DATA", str(scene / "gone"))
    with pytest.raises(FormatError, match=r"gone: path: found no such folder, .*DHTORCH_DATA"):
        data.open_scenes(scenes=scenes)
    monkeypatch.setenv("DHTORCH_DATA", str(scene.parent))
    first, second = data.open_scenes(scenes=scenes)
    assert (first.near, first.gap, second.levels, second.gap) == (2.0, 1, 6, None)
    with pytest.raises(FormatError, match="scenes: found none"):
        data.open_scenes(scene)
    for entry in ({"near": 2.0}, "holo_a"):
        with pytest.raises(FormatError, match=r"scenes: found .*expected entries with a path, as \{path:holo_a"):
            data.open_scenes(scene, [entry])


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


def test_format_error_survives_pickling() -> None:
    error = pickle.loads(pickle.dumps(FormatError(Path("a/b.png"), "size", "1x1", "2x2")))
    assert str(error) == "a/b.png: size: found 1x1, expected 2x2"
    assert len(str(FormatError("a", "f", "x" * 1000 + "\n", "y"))) < 200
