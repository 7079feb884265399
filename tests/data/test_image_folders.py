"""Image folders of other people's tools: written from each format's description, edited, read back or refused."""

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support import writers
from support.box_scene import CAMERA, HW, check_same, render, turned_back, walk
from support.box_scene import pose as box_pose
from support.capture_cases import DELETE, Case, check_case, edit_files
from support.writers import parts

from dhtorch import data
from dhtorch.data.units import DepthUnit
from dhtorch.export import arrays
from dhtorch.geometry import camera as cameras
from dhtorch.records import Camera, Frame


def with_confidence(frames: list[Frame]) -> list[Frame]:
    """The frames with the highest confidence, which phones' layouts store."""
    return [frame.replace(conf=torch.full_like(frame.depth, 2, dtype=torch.uint8)) for frame in frames]


@pytest.mark.parametrize("name", writers.CAPTURE_WRITERS)
def test_every_layout_gives_back_the_scene(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole, with its unit and no file unread; layouts of JPEGs, films or depth in metres nearly so.

    Opening decodes nothing (but the first map of SUN3D, whose codes may be rotated), and recordings can be pickled.
    """
    writer, frames = writers.CAPTURE_WRITERS[name], with_confidence(walk(3))
    path = writer(tmp_path, frames)
    with monkeypatch.context() as patch:
        for decoder in () if name == "sun3d" else ("cv2.imdecode", "lzfse.decompress"):
            patch.setattr(decoder, lambda *_: pytest.fail("opening decodes an image or a depth map"))
        patch.setattr("dhtorch.data.codecs.video._Decoder.frame", lambda *_: pytest.fail("opening decodes a film"))
        recording = data.open(path, **writer.options)
    recording = turned_back(pickle.loads(pickle.dumps(recording)), writer.up)
    assert recording.format == writer.format and len(recording) == 3
    assert not [line for line in recording.report if line.startswith("not read")]
    if writer.step_m is not None and recording.depth_unit is not None:
        assert recording.depth_unit.metres == pytest.approx(writer.step_m)
        assert recording.depth_unit.is_assumed is not writer.states_unit
    if writer.is_exact and writer.step_m is not None and writer.has_poses and name != "rlds":
        check_same(recording, frames, writer.step_m)
        return
    is_film = name == "record3d_mp4"  # steep pixels of a film are holes
    for got, want in zip(recording, frames, strict=True):
        torch.testing.assert_close(got.camera.f, want.camera.f, atol=1e-3, rtol=0)
        torch.testing.assert_close(got.camera.c, want.camera.c, atol=1e-3, rtol=0)
        returned = got.depth > 0
        assert float(returned.float().mean()) > (0.2 if is_film else 0.99)
        tolerance = 0.02 if is_film else (writer.step_m or 2e-3) / 2 + 1e-6
        assert float((got.depth - want.depth).abs()[returned].median()) <= tolerance
        assert float((got.image.float() - want.image.float()).abs().mean()) < 12
        if writer.has_poses:
            torch.testing.assert_close(got.T_world_from_cam.R, want.T_world_from_cam.R, atol=1e-6, rtol=0)
            torch.testing.assert_close(got.T_world_from_cam.t, want.T_world_from_cam.t, atol=1e-6, rtol=0)


# ------------------------------------------------------------------------------------------------- variants and faults

NARROW = Camera(torch.tensor([[50.0, 49.0]]), torch.tensor([[23.0, 17.0]]))
OPTION_K = [61.5, 58.25, 33.5, 21.75]
F, C = [61.5, 58.25], [33.5, 21.75]
SHIFTED = np.eye(4)
SHIFTED[0, 3] = 0.03
TWICE = cameras.resize(CAMERA, HW, (96, 128))


def two_camera_walk(n: int = 4) -> list[Frame]:
    """Frames with depth of another size and camera than the image."""
    frames = []
    for i in range(n):
        image, depth = render(CAMERA, box_pose(i), HW, 100 + i / 30), render(NARROW, box_pose(i), (36, 48))
        frames.append(image.replace(depth=depth.depth, depth_camera=NARROW))
    return frames


def rotated(code: np.ndarray) -> np.ndarray:
    return np.left_shift(code, 3) | np.right_shift(code, 13)


def codes(i: int, per_metre: float = 1000) -> np.ndarray:
    return arrays.encode_depth_codes(walk(i + 1)[i].depth, per_metre)


def write_imap(root: Path, frames: list[Frame]) -> None:
    """Replica as iMAP has it."""
    for i, frame in enumerate(frames):
        image, code = arrays.frame_to_hwc(frame), arrays.encode_depth_codes(frame.depth, 1000)
        edit_files(root, [(f"rgb/rgb_{i}.png", image), (f"depth/depth_{i}.png", code)])
    (root / "traj_w_c.txt").write_text("\n".join(parts.format_row(arrays.pose_matrix(f).ravel()) for f in frames))


def write_apc(root: Path, frames: list[Frame]) -> None:
    """A shelf scene: poses and K in one file."""
    titles = [("Color camera intrinsic matrix", arrays.K_matrix(CAMERA)), ("Bin-to-world transformation", np.eye(4))]
    for i, frame in enumerate(frames):
        code = rotated(arrays.encode_depth_codes(frame.depth, 10000))
        image = arrays.frame_to_hwc(frame)
        edit_files(root, [(f"frame-{i:06d}.color.png", image), (f"frame-{i:06d}.depth.png", code)])
        titles.append((f"Camera-to-world extrinsic matrix (camera pose) for frame-{i:06d}", arrays.pose_matrix(frame)))
    text = "".join(f"# {title}\n{parts.format_rows(matrix)}\n" for title, matrix in titles)
    (root / "cam.info.txt").write_text("# Environment: shelf\n" + text)


def rename_stamped(n: int, depth_lag_us: int) -> list[tuple[str, Any]]:
    """Names with numbers that do not match and time stamps that do."""
    images = [(f"color/{i:05d}.png", Path(f"color/{i + 7:07d}-{i * 33333:012d}.png")) for i in range(n)]
    lagging = [f"depth/{i + 1:07d}-{i * 33333 + depth_lag_us:012d}.png" for i in range(n)]
    return images + [(f"depth/{i:05d}.png", Path(name)) for i, name in enumerate(lagging)]


def drop_block(text: str) -> str:
    """A trajectory without its second block."""
    lines = text.splitlines()
    return "\n".join(lines[:5] + lines[10:])


def cut_line(name: str, line: int, text: str) -> tuple[str, Any]:
    """An edit that replaces a line of a file."""
    return name, lambda content: "\n".join(text if k == line else each for k, each in enumerate(content.splitlines()))


def seven_numbers(lost: str) -> str:
    """Poses of three frames as seven numbers a line, the second lost."""
    matrices = [arrays.pose_matrix(frame) for frame in walk(3)]
    lines = [parts.format_row([*T[:3, 3], *arrays.rotation_to_xyzw(T[:3, :3])]) for T in matrices]
    return "\n".join([lines[0], lost, lines[2]])


def write_twice(root: Path, frames: list[Frame]) -> None:
    """An Open3D folder with two trajectories."""
    writers.write_open3d(root, frames, trajectory="odometry.log")
    writers.write_open3d(root, frames)


def far(text: str) -> str:
    """A trajectory that ends somewhere else."""
    lines = text.splitlines()
    lines[-2] = lines[-2].rsplit(" ", 1)[0] + " 9.5"
    return "\n".join(lines)


def turned_walk(turned: bool) -> list[Frame]:
    """Frames with depth of its own camera, which lies turned or not."""
    frames = [frame.replace(depth_camera=CAMERA) for frame in walk(2)]
    return [frame.replace(depth=frame.depth.mT) for frame in frames] if turned else frames


def coarse() -> list[Frame]:
    """A frame with depth of half the size."""
    camera = cameras.resize(CAMERA, HW, (24, 32))
    return [walk(1)[0].replace(depth=torch.full((1, 24, 32), 2.0), depth_camera=camera)]


def blank(n: int) -> list[Frame]:
    """Frames of the size that published calibrations belong to."""
    image, depth = torch.zeros(1, 3, 480, 640, dtype=torch.uint8), torch.ones(1, 480, 640)
    return [frame.replace(image=image, depth=depth) for frame in walk(n)]


def matrix_text(n: int) -> str:
    """K as four numbers, or as a matrix of n rows."""
    matrix = np.eye(4)
    matrix[:3, :3] = arrays.K_matrix(CAMERA)
    return parts.format_rows(np.array([OPTION_K]) if n == 1 else matrix[:n, :n])


LOST = "frame 1: the pose is not finite (tracking lost): left out"
IN_DEPTH_K = {"depth f": [50.0, 49.0], "f": F, "report": (LOST,), "number": [0, 2, 3]}
STATED_K = {
    "w": 128,
    "h": 96,
    **dict(zip(("fx", "fy", "cx", "cy"), (*TWICE.f[0].tolist(), *TWICE.c[0].tolist()), strict=True)),
}
ROWS_K = arrays.K_matrix(CAMERA).ravel().tolist()
ICL = {"edits": [cut_line("livingRoom0.gt.freiburg", 0, "")], "written": {"calibration": False}}
bop, replica, scannet, sens = writers.write_bop, writers.write_replica, writers.write_scannet, writers.write_sens_folder
open3d, sun3d, icl, ros = writers.write_open3d, writers.write_sun3d, writers.write_icl_nuim, writers.write_ros_tum
counted, named = writers.write_counted_frames, writers.write_named_frames
MIXED_BOP = {"1": {"depth_scale": 0.2, "cam_K": {0: 70.0}}}

CASES = [
    # BOP
    Case("bop without poses, with gaps", bop, 4, [("rgb/000001.png", DELETE), ("scene_camera.json", {"2": DELETE})],
         {"number": [0, 3], "posed": False, "unit": (0.001, "scene_camera.json: depth_scale"),
          "report": ("frame 1: no image: left out", "frame 2: no camera: left out", "no poses")},
         written={"poses": False, "depth_scale": 1.0}),
    Case("bop, each frame by its own entry", bop, 2, [("scene_camera.json", MIXED_BOP)],
         {"f": F, "last f": [70.0, 58.25], "report": [r"depth_scale differs from frame to frame"], "medians": pytest.approx(
             [k * float(frame.depth.median()) for k, frame in zip((1, 2), walk(2), strict=True)], abs=2e-4)}),
    Case("bop sensors are recordings", bop, 2,
         [("rgb", Path("rgb_realsense")), ("depth", Path("depth_realsense")),
          ("scene_camera.json", Path("scene_camera_realsense.json"))],
         {"name": "realsense", "same": ([0, 1], 1e-4)}),
    Case("bop, no scale", bop, 2, [("scene_camera.json", {"0": {"depth_scale": DELETE}})],
         error="scene_camera.json: depth_scale: found nothing, expected a finite number"),
    Case("bop, negative scale", bop, 2, [("scene_camera.json", {"0": {"depth_scale": -1}})],
         error="depth_scale: found -1.0, expected a positive number"),
    Case("bop, short K", bop, 2, [("scene_camera.json", {"0": {"cam_K": [1]}})],
         error=r"cam_K: found \[1.0\], expected 9 finite numbers"),
    Case("bop, no rotation", bop, 2, [("scene_camera.json", {"0": {"cam_R_w2c": [2, 0, 0, 0, 2, 0, 0, 0, 2]}})],
         error="pose 0 determinant"),
    Case("bop, no translation", bop, 2, [("scene_camera.json", {"0": {"cam_t_w2c": DELETE}})],
         error="cam_t_w2c: found nothing"),
    Case("bop, no number", bop, 2, [("scene_camera.json", '{"a": {}}')], error="entry a"),
    Case("bop beside K of another layout", bop, 2, [("K.txt", "1 0 0\n0 1 0\n0 0 1\n")],
         {"format": "bop", "f": F, "report": ("not read: K.txt (cameras, poses or units in them are not used)",)}),
    # Replica
    Case("replica, parameters above", replica, 2, [("cam_params.json", Path("../cam_params.json"))],
         {"f": F, "unit": (pytest.approx(1 / 6553.5), "cam_params.json: scale")}),
    Case("replica without parameters", replica, 2, [("cam_params.json", DELETE)],
         error=r"K: found no intrinsics, expected data.fov=69 .* or cam_params.json"),
    Case("replica without parameters, with K", replica, 2, [("cam_params.json", DELETE)],
         {"unit": (1 / 6553.5, None), "same": ([0, 1], 1 / 6553.5)}, options={"K": OPTION_K}),
    Case("replica of imap", write_imap, 3, (), {"format": "replica", "unit": (0.001, None), "same": ([0, 1, 2], 1e-3)},
         options={"K": OPTION_K}),
    Case("replica, poses by number", replica, 4,
         [("results/frame000001.jpg", DELETE), ("results/depth000001.png", DELETE)],
         {"number": [0, 2, 3], "same": ([0, 2, 3], 1 / 6553.5),
          "report": ("traj.txt: 4 poses for 3 images: matched by the images' numbers",)}),
    Case("replica, too few poses", replica, 3, [("traj.txt", lambda text: text.splitlines()[0])],
         error=r"traj.txt: lines: found 1, expected 3, one for each image \(the last is 2\)"),
    Case("K of another size is scaled", replica, 1, [("cam_params.json", {"camera": STATED_K})],
         {"c": pytest.approx(C), "f": pytest.approx(F),
          "report": ("images of 64x48, cam_params.json states K for 128x96: K is scaled",)}),
    Case("K of another shape is refused", replica, 1, [("cam_params.json", {"camera": STATED_K | {"h": 128}})],
         error="image size: found 128x128, expected 64x48 as the images"),
    Case("K of no size is refused", replica, 1, [("cam_params.json", {"camera": STATED_K | {"w": 0.1}})],
         error=r"cam_params.json: image size: found 0x96, expected 64x48"),
    Case("K of another shape, an option", replica, 1, [("cam_params.json", {"camera": STATED_K | {"h": 128}})],
         {"f": F, "report": ()}, options={"K": OPTION_K}),
    # ScanNet, SensReader, 3RScan
    Case("scannet, depth of another camera", scannet, two_camera_walk, (),
         IN_DEPTH_K | {"same": ([0, 2, 3], 1e-3)}, written={"lost": [1]}),
    Case("sens folder, depth of another camera", sens, two_camera_walk, (),
         IN_DEPTH_K | {"same": ([0, 2, 3], 1e-3)}, written={"lost": [1]}),
    Case("all poses lost is no poses", scannet, 2, (),
         {"posed": False, "number": [0, 1], "report": ["every pose is missing or not finite", "no poses"]},
         written={"lost": [0, 1]}),
    Case("scannet K of the original size", scannet, lambda: [render(CAMERA, box_pose(0), (242, 324))],
         [("intrinsic/intrinsic_color.txt", "1170 0 647.75 0\n0 1170 483.75 0\n0 0 1 0\n0 0 0 1")],
         {"f": pytest.approx([1170 / 4, 1170 / 4]),
          "report": ("images of 324x242, intrinsic_color.txt states K for 1296x968: K is scaled",)}),
    Case("scannet in one folder", scannet, 2,
         [*((f"{folder}/{i}.{end}", Path(f"{i:05d}.{end}")) for i in range(2)
            for folder, end in (("color", "jpg"), ("depth", "png"), ("pose", "txt"))),
          ("intrinsic/intrinsic_color.txt", Path("intrinsic.txt"))],
         {"format": "scannet", "f": F, "same": ([0, 1], 1e-3), "unit": (1 / 1000, "ScanNet stores mm")}),
    Case("extrinsics are named", scannet, 1, [("intrinsic/extrinsic_color.txt", parts.format_rows(SHIFTED))],
         {"report": ["^extrinsic_color.txt is not the identity; not applied"]}),
    Case("extrinsics of three rows", scannet, 1, [("intrinsic/extrinsic_color.txt", parts.format_rows(SHIFTED[:3]))],
         error=r"extrinsic_color\.txt: .*3 rows.*4 rows"),
    Case("sens folder of png in another unit", sens, 2,
         [("_info.txt", [("m_depthShift = 1000", "m_depthShift = 500")])],
         {"unit": (1 / 500, "_info.txt: m_depthShift"), "same": ([0, 1], 1e-3, 2.0)}, written={"pgm": False}),
    Case("sens folder without unit", sens, 2, [("_info.txt", [("m_depthShift = 1000\n", "")])],
         {"unit": (1 / 1000, None), "same": ([0, 1], 1e-3)}),
    Case("sens folder, no number", sens, 2, [("_info.txt", [("m_depthShift = 1000", "m_depthShift = many")])],
         error=r"_info.txt: m_depthShift: found 'many', expected a finite number"),
    Case("sens folder, K of twice the size", sens, 1,
         [("_info.txt", [("m_colorWidth = 64", "m_colorWidth = 32"), ("m_colorHeight = 48", "m_colorHeight = 24")])],
         {"f": pytest.approx([123, 116.5]), "c": pytest.approx([67.5, 44]), "report": [r"states K for 32x24: K is scaled"]}),
    Case("sens folder, extrinsics are named", sens, 1,
         [("_info.txt", [("m_frames", f"m_calibrationDepthExtrinsic = {parts.format_row(SHIFTED.ravel())}\nm_frames")])],
         {"report": [r"m_calibrationDepthExtrinsic not the identity; not applied"]}),
    # Open3D
    *(Case(f"open3d {trajectory} {intrinsics}", open3d, 2, (), {"format": "open3d", "report": (), "same": ([0, 1], 1e-3)},
           written={"trajectory": trajectory, "intrinsics": intrinsics})
      for trajectory, intrinsics in (
          ("trajectory.log", "camera_primesense.json"), ("odometry.log", "camera_intrinsic.json"),
          ("scene/trajectory.log", "intrinsic.json"), ("livingroom-traj.txt", "camera_primesense.json"))),
    *(Case(f"of two trajectories {name}", write_twice, 3, edits, {"report": [words]})
      for name, edits, words in (
          ("the optimised one", [], r"poses are those of trajectory.log; odometry.log \(data.trajectory=odometry.log\) "
           r"differs by at most (0|[\d.]+e-1\d) m"),
          ("the optimised one, unlike the other", [("odometry.log", far)], r"trajectory.log; .* differs by at most [5-9]"),
          ("that of more frames", [("trajectory.log", lambda text: "\n".join(text.splitlines()[:5]))],
           "poses are those of odometry.log; trajectory.log .* has 1 poses for 3"))),
    Case("a trajectory by option", write_twice, 3, [("odometry.log", far)], {"end": 9.5},
         options={"trajectory": "odometry.log"}),
    Case("motions are no poses", open3d, 3, [("odometry.log", [("0 0 1\n", "0 1 3\n"), ("1 1 2\n", "1 2 3\n")])],
         {"posed": False, "report": ["^odometry.log: motions between two frames, not poses of frames: not used", "no poses"]},
         written={"trajectory": "odometry.log"}),
    Case("fewer poses than images", open3d, 4, [("trajectory.log", drop_block)],
         {"number": [0, 2, 3], "report": ("frame 1: no pose: left out",), "times": pytest.approx([0.0, 0.2, 0.3]),
          "same": ([0, 2, 3], 1e-3)}, options={"fps": 10}),
    Case("poses of other frames", open3d, 4, [("trajectory.log", "0 0 9\n" + parts.format_rows(np.eye(4)))],
         error=r"trajectory.log: poses: found 1, expected 4, one for each image"),
    Case("K by rows", open3d, 1, [("camera_intrinsic.json", {"intrinsic_matrix": ROWS_K})],
         {"c": C, "report": ["intrinsic_matrix is by rows"]}),
    Case("one image within half a second", open3d, 1,
         [("color/00000.png", Path("color/0000001-000000000000.png")),
          ("depth/00000.png", Path("depth/0000001-000000400000.png"))], {"number": [0]}),
    Case("one image beyond half a second", open3d, 1,
         [("color/00000.png", Path("color/0000001-000000000000.png")),
          ("depth/00000.png", Path("depth/0000001-000000600000.png"))], error="depth maps: found 1 for 1 images"),
    Case("paired by stamps", open3d, 3, rename_stamped(3, 4000), {"same": ([0, 1, 2], 1e-3)}),
    Case("paired by a table", open3d, 3,
         [("color/00000.png", Path("color/a.png")),
          ("rgbd.match", "depth/00002.png color/00001.png\ndepth/00000.png color/a.png")],
         {"number": [0, 2], "report": ["^frame 1: no depth map", "^1 depth map without an image: left out"]}),
    Case("a table of other names", open3d, 3, [("rgbd.match", "depth/0.png color/0.png")],
         error=r"rgbd.match: line 1: .* expected the names of an image and of its depth map"),
    # SUN3D, APC and rotated codes
    Case("codes beyond 8 m survive the rotation", sun3d,
         lambda: [frame.replace(depth=3 * frame.depth) for frame in walk(2)], (), {"median": pytest.approx(
             float(torch.cat([3 * f.depth for f in walk(2)]).median()), abs=1e-3)}),
    Case("sun3d codes that are not rotated", sun3d, 2,
         [("depth/*-000000000000.png", codes(0)), ("depth/*-000000033333.png", codes(1))],
         {"same": ([0, 1], 1e-3), "unit": (0.001, None), "report": ["not rotated by 3 bits"]}),
    Case("sun rgb-d has no pose", sun3d, 1, [("intrinsics.txt", "61.5 0 33.5 0 58.25 21.75 0 0 1\n")],
         {"posed": False, "c": C,
          "report": ("extrinsics/ holds the tilt of one image, no pose: not read", "no poses")}),
    Case("numbered frames of rotated codes", counted, 2,
         [("depth/00000.png", rotated(codes(0))), ("depth/00001.png", rotated(codes(1)))],
         {"same": ([0, 1], 1e-3)}, options={"rotated_bits": 3}),
    Case("apc", write_apc, lambda: [frame.replace(depth=frame.depth / 4) for frame in walk(2)], (),
         {"format": "apc", "report": (), "f": F, "posed": True,
          "median": pytest.approx(float(torch.cat([f.depth / 4 for f in walk(2)]).median()), abs=1e-4)}),
    # TUM's relatives
    Case("icl-nuim, published K and frame numbers", icl, lambda: blank(3), **ICL, expect={
        "number": [1, 2], "report": ("frame 0: no pose in livingRoom0.gt.freiburg: left out",),
        "times": pytest.approx([1 / 30, 2 / 30]), "f": pytest.approx([481.2, 480])}),
    Case("negative fy mirrors the poses", icl, 2, (),
         {"same": ([0, 1], 1 / 5000), "times": None, "report": ["negative fy", "images are numbered"][::-1]},
         options={"K": [61.5, -58.25, 33.5, 21.75]},
         written={"trajectory": "groundtruth.txt", "calibration": False}),
    Case("associations in the other order", icl, 3,
         [("associations.txt", "\n".join(f"{i} rgb/{i}.png {i} depth/{i}.png" for i in range(3)))],
         {"same": ([0, 1, 2], 1 / 5000), "unit": (1 / 5000, "ICL-NUIM stores 1/5000 m")}),
    Case("calibration of four numbers", ros, 2, [("calibration.txt", "61.5 58.25 33.5 21.75\n")],
         {"f": F, "c": C, "lens": None}),
    Case("calibration with a lens", ros, 2,
         [("calibration.txt", "# fx fy cx cy k1 k2 p1 p2\n61.5 58.25 33.5 21.75 0.1 0 0 0")],
         {"f": F, "c": C, "lens": pytest.approx([0.1, 0, 0, 0])}),
    Case("calibration as a matrix", ros, 2, [("calibration.txt", "61.5 0 33.5\n0 58.25 21.75\n0 0 1\n")],
         {"f": F, "c": C, "lens": None}),
    Case("calibration of two numbers", ros, 2, [("calibration.txt", "61.5 58.25")],
         error=r"calibration.txt: numbers: found 61.5 58.25, expected fx fy cx cy"),
    Case("ros recorder, unit assumed", ros, 2, (), {"unit": (1 / 5000, None)}),
    Case("ros recorder in mm", ros, 2, (), {"same": ([0, 1], 1e-3)}, options={"depth_unit": "mm"}),
    Case("ros recorder, codes of a metre", ros, 2, (), {"same": ([0, 1], 1e-3)}, options={"units_per_metre": 1000}),
    Case("tum by its folder's name", lambda root, frames: ros(root / "rgbd_dataset_freiburg3_desk", frames), 2, (),
         {"unit": (1 / 5000, "TUM RGB-D stores 1/5000 m")}, path="rgbd_dataset_freiburg3_desk"),
    # numbered frames
    Case("depth turned against its own camera", named, lambda: turned_walk(True),
         error=r"depth\.png: size: found \d+x\d+, turned against its intrinsics"),
    Case("depth of its own camera", named, lambda: turned_walk(False), (), {"depth hw": (48, 64)}),
    # registered to the image at the density of the depth map, without gaps
    Case("coarse depth with a camera of its own", named, coarse, (), {"depth hw": (24, 32), "median": 2.0, "returns": 768}),
    *(Case(f"depth_scale {scale}", counted, 1, [("meta.json", f'{{"depth_scale": {scale}}}')],
           {"unit": (pytest.approx(factor / 1000), "meta.json: depth_scale"), "same": ([0], 2e-3, factor)})
      for scale, factor in ((1000, 1), (0.001, 1), (0.0005, 0.5), (2000.0, 0.5))),
    Case("named frames without poses", named, 2, [("*.pose.txt", DELETE)],
         {"posed": False, "number": [0, 1], "report": ("no frame-XXXXXX.pose.txt: no poses",)}),
    Case("two K that differ", counted, 1, [("meta.json", '{"K": [[70, 0, 32], [0, 70, 24], [0, 0, 1]]}')],
         {"report": ("K.txt states another K than the one in use: f 61.5, c 33.5 21.75",)}),
    Case("two K, one of the depth", counted, 1,
         [("meta.json", f'{{"K": [[70, 0, 32], [0, 70, 24], [0, 0, 1]], "K_depth": {arrays.K_matrix(CAMERA).tolist()}}}')],
         {"report": ()}),
    Case("two K, one of an option", counted, 1, [("meta.json", '{"K": [[70, 0, 32], [0, 70, 24], [0, 0, 1]]}')],
         {"report": (), "f": [70, 70]}, options={"K": [70, 70, 32, 24]}),
    *(Case(f"{name} of {n} rows", counted, 1, [("K.txt", DELETE), (name, matrix_text(n))], {"f": F, "c": C})
      for name, n in (("cam_K.txt", 1), ("camera_intrinsics.txt", 3), ("intrinsic.txt", 4), ("cam_K.txt", 4))),
    Case("K of five numbers", counted, 1, [("K.txt", DELETE), ("cam_K.txt", "1 2 3 4 5")],
         error="cam_K.txt: K: found 5 numbers, expected fx fy cx cy, or a 3x3 or 4x4 matrix"),
    *(Case(f"a file each in {folder}", counted, 4,
           [("poses.txt", DELETE),
            *((f"{folder}/{i:05d}.txt", parts.format_rows(arrays.pose_matrix(walk(4)[i]))) for i in (0, 3)),
            (f"{folder}/00001.txt", "nan nan nan nan\n" * 4)],
           {"number": [0, 3], "same": ([0, 3], 1e-3), "report": ("frame 2: no pose: left out", LOST)})
      for folder in ("poses", "pose")),
    *(Case(f"lost as {lost[:9]}", counted, 3, [("poses.txt", seven_numbers(lost)) if len(lost.split()) == 7
                                               else cut_line("poses.txt", 1, lost)],
           {"number": [0, 2], "report": (LOST,), "same": ([0, 2], 1e-3)})
      for lost in ("nan " * 16, "-inf " * 16, "nan " * 7, "0 0 0 0 0 0 0")),
    # files that are not read
    *(Case(f"{name} beside", counted, 1, [(name, "1 2 3\n")], {"report": (
        (f"not read: {name} (cameras, poses or units in them are not used)",) if is_named else ())})
      for name, is_named in (
          ("camera.yaml", True), ("extrinsics.json", True), ("poses/0.npy", True), ("calibration/cam.xml", True),
          ("sub/trajectory.log", True), ("README.txt", False), ("LICENSE.txt", False), ("SHA256SUMS", False),
          ("notes.md", False), ("complete.json", False), ("sub/image.png", False), (".hidden.json", False))),
    Case("many files beside", counted, 1,
         [(name, "{}") for i in range(9) for name in (f"{i}.json", f"poses/{i}.txt")],
         {"report": [r"^not read: 0.json, 1.json, 2.json, 3.json, 4.json and 5 others \("]}),
    Case("a folder of files beside", counted, 1, [(f"poses/{i}.txt", "1") for i in range(9)],
         {"report": [r"^not read: poses/ \(9 files\) \("]}),
    Case("where K may be is named", counted, 1, [("K.txt", Path("camera.yaml"))],
         error=r"K: found no intrinsics; not read: camera.yaml \(.*\), expected data.fov=69"),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_variants_are_read_and_faults_named(case: Case, tmp_path: Path) -> None:
    check_case(case, tmp_path)


# ------------------------------------------------------------------------------------------------------------ real files

FIELD = Path(os.environ.get("DHTORCH_DATA", "/nowhere")) / "field_cases"


@pytest.mark.skipif(not FIELD.is_dir(), reason="DHTORCH_DATA has no field_cases")
@pytest.mark.parametrize(
    ("case", "format", "n", "f", "unit", "median"),
    [
        ("02-redwood", "open3d", 5, 525, DepthUnit(1e-3), 1.861),
        ("05-bop-depth-scale", "bop", 5, 525, "scene_camera.json: depth_scale", 1.861),
        ("06-scannet-export", "scannet", 4, 1063.125, "ScanNet stores mm", 1.861),
        ("07-replica-niceslam", "replica", 5, 525, "cam_params.json: scale", 1.861),
        ("21-3rscan", "sens_folder", 3, 787.5, "_info.txt: m_depthShift", 1.861),
        ("19-icl-nuim", "tum", 3, 481.2, DepthUnit(1 / 5000, "ICL-NUIM stores 1/5000 m"), None),
        ("20-ros-tum-mm", "tum", None, 525, DepthUnit(1 / 5000), 1.861 / 5),
    ],
)
def test_field_cases(
    case: str, format: str, n: int | None, f: float, unit: DepthUnit | str, median: float | None
) -> None:
    recording = data.open(FIELD / case)
    assert recording.format == format and n in (None, len(recording)) and recording.depth_unit is not None
    assert unit in (recording.depth_unit, recording.depth_unit.source)
    assert recording.poses is not None or format == "tum"
    assert float(recording[0].camera.f[0, 0]) == pytest.approx(f)
    depth = torch.cat([frame.depth[frame.depth > 0] for frame in recording])
    assert median is None or float(depth.median()) == pytest.approx(median, rel=0.01)
