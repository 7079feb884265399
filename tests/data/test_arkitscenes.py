"""ARKitScenes: captures written with its layout and clocks and read back, and damaged ones."""

import inspect
import math
import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from support import writers
from support.arkitscenes_frames import VGA, VGA_HW, path, shots
from support.box_scene import CAMERA, HW, disagreement, off_wall, render, world_points
from support.capture_cases import DELETE, Case, check_case, edit_files

from dhtorch import data
from dhtorch.cli.run import config_dir
from dhtorch.data import FormatError, clocks, convert
from dhtorch.data.readers import arkitscenes, ca1m
from dhtorch.experiments.protocol import PairDataset
from dhtorch.geometry import camera as cameras
from dhtorch.metrics import holdout
from dhtorch.records import Frame, Pose


def capture(root: Path, n: int = 4, **more: list[Frame]) -> list[Frame]:
    """Writes a capture of small pictures with depth, confidence and poses at the same times; returns its frames."""
    frames = shots(100 + np.arange(n) / 60)
    assets = {"lowres_wide": frames, "lowres_depth": frames, **more}
    writers.write_arkitscenes(root, assets, trajectory=frames)
    return frames


def stored(root: Path, **options: object) -> data.Recording:
    return data.open(root, "arkitscenes", upright=False, **options)


def test_larger_pictures_find_depth_and_pose_at_other_clocks(tmp_path: Path) -> None:
    root = tmp_path / "1"
    vga = shots(100.004 + np.arange(6) / 30, VGA, VGA_HW)
    small = shots(100 + np.arange(14) / 60)
    sparse = shots([100.0, 100.1, 100.2])
    writers.write_arkitscenes(root, {"vga_wide": vga, "lowres_depth": small}, trajectory=sparse)
    recording = stored(root)
    assert len(recording) == 6 and recording.report == ()
    for i, want in enumerate(vga):
        frame = recording[i]
        stamp = float(frame.time)
        near = min(small, key=lambda f: abs(float(f.time) - stamp))
        torch.testing.assert_close(frame.depth, near.depth, atol=6e-4, rtol=0)
        assert torch.equal(frame.image, want.image) and torch.equal(frame.camera.f, VGA.f)
        assert torch.equal(frame.depth_camera.c, CAMERA.c)
        true = path(stamp)  # linear in position, at constant speed in rotation: exact
        torch.testing.assert_close(frame.T_world_from_cam.t, true.t, atol=1e-9, rtol=0)
        torch.testing.assert_close(frame.T_world_from_cam.R, true.R, atol=1e-9, rtol=0)
    own = stored(root, interpolate=False)  # 4 ms from the poses at 100.0, 100.1 and, a little more, 100.2
    assert own.number.tolist() == [0, 3] and own.report == ("4 images without a pose: left out",)
    with pytest.raises(FormatError, match=r"frames of vga_wide: found 6 images without depth: left out"):
        stored(root, max_difference=0.002)


def at(n: int, rate: float = 60, start: float = 100, **options: Any) -> Any:
    """Frames at a rate."""
    return lambda: shots(start + np.arange(n) / rate, **options)


def write(root: Path, frames: list[Frame], *, trajectory: list[Frame] | None = None, **more: list[Frame]) -> None:
    """A capture of small images with depth, confidence and poses at the same times, and further assets."""
    assets = {"lowres_wide": frames, "lowres_depth": frames, **more}
    writers.write_arkitscenes(root / "1", assets, trajectory=frames if trajectory is None else trajectory)


def write_wide(root: Path, frames: list[Frame], *, name: str) -> None:
    """Large images of another asset."""
    wide = shots(100 + np.arange(3) / 10, cameras.resize(VGA, VGA_HW, (192, 256)), (192, 256))
    writers.write_arkitscenes(root / "1", {name: wide, "lowres_depth": frames}, trajectory=frames)


def write_3dod(root: Path, frames: list[Frame]) -> None:
    """The frames one folder further down."""
    inner = root / MIXED / "42445173_frames"
    writers.write_arkitscenes(inner, {"lowres_wide": frames, "lowres_depth": frames}, trajectory=frames)


def without(rows: tuple[int, ...]) -> Any:
    return lambda text: "\n".join(row for i, row in enumerate(text.splitlines()) if i not in rows)


MIXED = "3dod/Validation/42445173"
DOWN = Pose(torch.tensor([[[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]]).double(), torch.zeros(1, 3).double())
TRAJ = "1/lowres_wide.traj"
STORED = {"format": "arkitscenes", "upright": False}
WIDE = cameras.resize(VGA, VGA_HW, (192, 256)).f[0].tolist()
BORROWED = cameras.resize(CAMERA, HW, (192, 256)).c[0].tolist()
NO_POSES = ("3 images without a pose: left out",)
PINCAM = "64 48 61.5 58.25 33.5 21.75\n"


def arkit(name: str, frames: Any, edits: Any = (), expect: Any = None, **more: Any) -> Case:
    options = STORED | more.pop("options", {})
    return Case(name, more.pop("write", write), frames, edits, expect or {}, path="1", options=options, **more)


def all_vga() -> dict[str, list[Frame]]:
    return {"vga_wide": shots(100 + np.arange(4) / 60, VGA, VGA_HW)}


CASES = [
    arkit("whole", at(4), (), {"format": "arkitscenes", "report": (), "number": [0, 1, 2, 3],
                               "rate": pytest.approx(60, rel=0.03), "truth": False, "depth f": None,
                               "times": [100.0, 100.017, 100.033, 100.05],  # the names carry milliseconds
                               "same": ([0, 1, 2, 3], 1e-3, 1.0, True)}),
    *(Case(f"3dod keeps its frames one folder down, {path}", write_3dod, at(3, 10), [(f"{MIXED}/a.json", "{}")],
           {"format": "arkitscenes", "number": [0, 1, 2]}, path=path) for path in (MIXED, f"{MIXED}/42445173_frames")),
    arkit("a camera that looks straight down", lambda: [render(CAMERA, DOWN, HW, 100.0)], (),
          {"hw": HW, "report": ["no confidence", "the camera looks straight up or down: images are not rotated"]},
          options={"upright": True}),
    *(arkit(f"{name} is wide", at(3, 10), (), {"f": pytest.approx(WIDE), "report": ()}, write=write_wide,
            written={"name": name}) for name in ("wide", "color")),
    *(arkit(f"intrinsics of {name} are borrowed", at(3, 10), [(f"1/{name}_intrinsics/*", DELETE)],
            {"c": pytest.approx(BORROWED), "report": ("no wide_intrinsics: lowres_wide_intrinsics, scaled",)},
            write=write_wide, written={"name": name}) for name in ("wide", "color")),
    arkit("no intrinsics of any size", at(3, 10), [("1/*_intrinsics/*", DELETE)], write=write_wide,
          written={"name": "wide"}, error="wide_intrinsics: found none, also of no other size"),
    arkit("the first by name", at(4), (), {"hw": HW}, written=all_vga()),
    arkit("the largest by name", at(4), (), {"hw": VGA_HW}, written=all_vga(), options={"image": "vga_wide"}),
    arkit("no such asset", at(4), options={"image": "wide"},
          error=r"wide: found none, expected <video id>_<seconds>.png"),
    arkit("no such name", at(4), options={"image": "ultrawide"},
          error="option image: found ultrawide, expected one of lowres_wide, vga_wide, wide"),
    arkit("no pose is taken over", at(12), [(TRAJ, without((3, 4, 5)))],
          {"number": [0, 1, 2, 6, 7, 8, 9, 10, 11], "report": NO_POSES,
           "same": ([0, 1, 2, 6, 7, 8, 9, 10, 11], 1e-3)}, options={"interpolate": False}),
    arkit("no gap of 67 ms is bridged", at(12), [(TRAJ, without((3, 4, 5)))],
          {"number": [0, 1, 2, 6, 7, 8, 9, 10, 11]}, options={"max_pose_gap": 0.05}),
    arkit("the first and last need a pose", at(6), (), {"number": [2, 3]},
          written={"trajectory": shots(100 + np.arange(2, 4) / 60)}),
    arkit("no pose at all", at(6), written={"trajectory": shots([100.06 + 0.04])},
          error="6 images without a pose: left out, expected images with depth"),
    arkit("no trajectory", at(4), [(TRAJ, DELETE)],
          {"posed": False, "number": [0, 1, 2, 3],
           "report": ("no lowres_wide.traj: frames have no pose and are not rotated",)}, options={"upright": True}),
    arkit("poses not read", at(4), [(TRAJ, DELETE)], {"posed": False, "report": ()}, options={"poses": False}),
    arkit("names sorted as numbers", lambda: shots([99.95, 99.9833, 100.0, 100.0167]), (),
          {"times": [99.95, 99.983, 100.0, 100.017], "same": ([0, 1, 2, 3], 1e-3)}),
    # the depth before and after is 16 ms away: not its depth
    arkit("parts missing in the middle", at(8),
          [("1/lowres_depth/*_100.017.png", DELETE), ("1/confidence/*_100.050.png", DELETE),
           ("1/lowres_wide_intrinsics/*_100.083.pincam", DELETE), ("1/lowres_wide/*_100.100.png", DELETE)],
          {"number": [0, 2, 4, 6], "same": ([0, 2, 4, 7], 1e-3), "report": (
              "1 depth map without a picture: left out", "1 image without depth: left out",
              "1 image without confidence: left out", "1 image without intrinsics: left out")}),
    arkit("no confidence", at(4), [("1/confidence/*", DELETE)],
          {"conf": False, "report": ("no confidence: all returns are weighted equally",)}),
    arkit("no depth", at(4), [("1/lowres_depth/*", DELETE)],
          error=r"lowres_depth: found none, expected <video id>_<seconds>.png"),
    arkit("no gap at all", at(4), options={"max_pose_gap": 0}, error="option max_pose_gap: found 0.0"),
    *(arkit(f"pincam {text[:20]}", at(4), [("1/lowres_wide_intrinsics/*_100.000.pincam", text)], error=message)
      for text, message in (
          ("64 48 61 58 33", r"pincam: line 1: found 5 columns, expected 6 numbers"),
          ("64 48 nan 58 33 21", r"pincam: intrinsics: found .*nan.*, expected 6 finite numbers"),
          ("64.5 48 61 58 33 21", r"pincam: width and height: found 64.5 48, expected the size of an image"),
          ("0 48 61 58 33 21", r"pincam: width and height: found 0 48"),
          ("1e5 1e5 61 58 33 21", r"pincam: width and height: found 100000 100000"),
          ("640 480 61 58 33 21", r"lowres_wide.*png: size: found 64x48, expected 640x480"),
          (PINCAM * 2, r"pincam: intrinsics: found nothing"),
          ("64 48 -61 58 33 21", r"pincam: intrinsics focal length"))),
    arkit("levels above 2", at(4), [("1/confidence/*_100.000.png", np.full((*HW, 1), 3, np.uint8))],
          error=r"confidence: found 1 channels up to 3, expected 1 channel of 0, 1 or 2"),
    arkit("confidence of three channels", at(4), [("1/confidence/*_100.000.png", np.zeros((*HW, 3), np.uint8))],
          error=r"confidence: found 3 channels"),
    arkit("rows that are lost", at(4), [(TRAJ, lambda text: "\n".join(
        ["100.0 nan 0 0 0 0 0", *text.splitlines()[1:], "100.2 inf 0 0 0 0 0"]))], {"number": [1, 2, 3]}),
    *(arkit(f"trajectory {text[:20]}", at(4), [(TRAJ, text)], error=message) for text, message in (
        ("100.0 nan 0 0 0 0 0", r"lowres_wide.traj: poses: found no usable row"),
        ("100.0 0 0 0 0 0", r"lowres_wide.traj: line 1: found 6 columns, expected 7 numbers"),
        ("one 0 0 0 0 0 0", r"lowres_wide.traj: line 1: found one"),
        ("# nothing", r"lowres_wide.traj: poses: found no usable row"))),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_variants_are_read_and_faults_named(case: Case, tmp_path: Path) -> None:
    check_case(case, tmp_path)


def test_downloads_complete_each_other(tmp_path: Path) -> None:
    frames = shots(100 + np.arange(3) / 10)
    wide = shots(100 + np.arange(3) / 10, VGA, VGA_HW)
    raw, up = (tmp_path / subset / "Training" / "42" for subset in ("raw", "upsampling"))
    writers.write_arkitscenes(up, {"wide": wide, "lowres_depth": frames, "highres_depth": wide})
    assert stored(up).poses is None
    writers.write_arkitscenes(raw, {"lowres_wide": frames}, trajectory=frames)
    recording = stored(up, image="wide")
    torch.testing.assert_close(recording.poses.t, torch.cat([f.T_world_from_cam.t for f in frames]))
    assert hasattr(stored(raw, image="lowres_wide"), "truth")
    elsewhere = tmp_path / "42"  # not where the download puts it: nothing beside it is read
    up.rename(elsewhere)
    assert stored(elsewhere).poses is None


def test_a_gap_is_bridged_by_interpolation_and_one_pose_serves_the_images_near_it(tmp_path: Path) -> None:
    write(tmp_path, shots(100 + np.arange(12) / 60))
    edit_files(tmp_path, [(TRAJ, without((3, 4, 5)))])
    bridged = stored(tmp_path / "1")
    assert len(bridged) == 12
    torch.testing.assert_close(bridged.poses.t[4:5], path(float(bridged.times[4])).t, atol=1e-9, rtol=0)
    writers.write_arkitscenes(tmp_path / "1", {}, trajectory=shots([100 + 2 / 60 - 0.004]))  # 4 ms off
    recording = stored(tmp_path / "1")
    assert recording.number.tolist() == [2] and recording.rate_hz is None
    torch.testing.assert_close(recording.poses.t, path(100 + 2 / 60 - 0.004).t, atol=1e-5, rtol=0)


def test_names_a_millisecond_apart_are_one_instant(tmp_path: Path) -> None:
    """Names are cut to milliseconds, each by itself, and the trajectory has six decimals."""
    root = tmp_path / "1"
    frames = capture(root)
    times = np.array([float(f.time) for f in frames])
    writers.write_arkitscenes(root, {}, trajectory=shots(times + 0.0001))
    rows = np.loadtxt(root / "lowres_wide.traj")
    assert (rows[:, 0] * 1000 % 1).max() > 0.4  # the stamps are no whole milliseconds
    recording = stored(root)
    for got, want in zip(recording, shots(times + 0.0001), strict=True):  # its own pose, not one in between
        torch.testing.assert_close(got.T_world_from_cam.t, want.T_world_from_cam.t, atol=1e-7, rtol=0)
    first, second, *_ = sorted((root / "lowres_wide_intrinsics").iterdir())
    first.rename(first.with_name(first.name.replace("100.000", "100.001")))
    second.rename(second.with_name(second.name.replace("100.017", "100.019")))
    recording = stored(root)
    assert recording.number.tolist() == [0, 2, 3] and recording.report == ("1 image without intrinsics: left out",)


def test_confidence_is_that_of_the_depth_map(tmp_path: Path) -> None:
    root = tmp_path / "1"
    image = shots([100.0], VGA, VGA_HW)
    depths = shots([99.991, 100.007])
    writers.write_arkitscenes(root, {"vga_wide": image, "lowres_depth": depths}, trajectory=image)
    assert torch.equal(stored(root)[0].conf, depths[1].conf)
    edit_files(
        root, [("confidence/*_100.007.png", DELETE)]
    )  # the other one is near the image too, but belongs to another depth map
    with pytest.raises(FormatError, match="1 image without confidence: left out"):
        stored(root)


def test_nearest_against_brute_force() -> None:
    rng = np.random.default_rng(0)
    for m in (1, 2, 30):
        times, others = rng.uniform(0, 1, 50), np.sort(rng.uniform(0, 1, m))
        gap = np.abs(times[:, None] - others)
        want = np.where(gap.min(1) <= 0.03, gap.argmin(1), -1)
        assert np.array_equal(clocks.nearest_stamps(times, others, 0.03), want)


def test_rotation_vectors_and_the_way_between_rotations() -> None:
    rng = np.random.default_rng(1)
    for angle in (0.0, 1e-12, 1e-3, 1.0, math.pi - 1e-9, math.pi):
        axis = rng.normal(size=3)
        vector = axis / np.linalg.norm(axis) * angle
        R = convert.to_c2w(convert.to_quaternions(vector[None]), np.zeros((1, 3)), Path("x"))[0, :3, :3]
        np.testing.assert_allclose(R, cv2.Rodrigues(vector)[0], atol=1e-12)
        a = convert.to_quaternions(rng.normal(size=(1, 3)))
        b = convert.to_quaternions(rng.normal(size=(1, 3)))
        for sign in (1, -1):
            q = convert.slerp(a, sign * b, np.array([0.3]))
            assert np.linalg.norm(q) == pytest.approx(1, abs=1e-12)
            part, whole = (2 * math.acos(min(abs(float((a * x).sum())), 1)) for x in (q, b))
            assert part == pytest.approx(0.3 * whole, abs=1e-7)
        np.testing.assert_allclose(convert.slerp(a, a, np.array([0.7])), a, atol=1e-15)


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_pictures_are_turned_upright_by_the_poses(tmp_path: Path, turns: int) -> None:
    root = tmp_path / "1"
    frames = shots(100 + np.arange(3) / 60, turns=turns)
    laser = shots(100 + np.arange(3) / 60, VGA, VGA_HW, turns=turns)
    writers.write_arkitscenes(
        root, {"lowres_wide": frames, "lowres_depth": frames, "highres_depth": laser}, trajectory=frames
    )
    (tmp_path / "metadata.csv").write_text("video_id,visit_id,fold,sky_direction\n1,1,Training,Up\n")  # a lie
    recording = data.open(root)
    (h, w), (f, c) = HW, (CAMERA.f[0], CAMERA.c[0])
    f_want, c_want = {  # the rules for integer pixel centres, written out
        0: ([f[0], f[1]], [c[0], c[1]]),
        1: ([f[1], f[0]], [h - 1 - c[1], c[0]]),
        2: ([f[0], f[1]], [w - 1 - c[0], h - 1 - c[1]]),
        3: ([f[1], f[0]], [c[1], w - 1 - c[0]]),
    }[turns]
    for i, frame in enumerate(recording):
        size = HW if turns % 2 == 0 else HW[::-1]
        assert frame.hw == size and frame.depth.shape[1:] == size and frame.conf.shape[1:] == size
        assert torch.equal(frame.conf, frame.image[:, 1] // 86) and frame.conf.unique().numel() > 1
        assert frame.camera.f[0].tolist() == [float(x) for x in f_want]
        assert frame.camera.c[0].tolist() == [float(x) for x in c_want]
        assert float(frame.T_world_from_cam.R[0, 2, 1]) < -0.9  # down in the picture is down in the world
        assert torch.linalg.det(frame.T_world_from_cam.R).item() == pytest.approx(1)
        assert float(off_wall(world_points(frame)).max()) < 2e-3
        lit = render(frame.camera, path(float(frames[i].time)), size)  # what an upright camera there sees
        assert float((lit.image.int() - frame.image.int()).abs().double().mean()) < 0.5
        truth = recording.truth(i)["depth"]
        assert truth.shape[1:] == size
        assert float(((truth - lit.depth).abs() / lit.depth)[truth > 0].median()) < 0.01
    assert disagreement(recording[0], recording[2])[0] < 0.01
    assert stored(root)[0].hw == HW


def test_laser_depth_is_taken_to_the_images_pixels(tmp_path: Path) -> None:
    root = tmp_path / "1"
    laser_camera = cameras.resize(VGA, VGA_HW, (192, 256))
    laser = shots(100 + np.arange(3) / 10, laser_camera, (192, 256))
    frames = shots(100 + np.arange(13) / 60)
    writers.write_arkitscenes(
        root, {"lowres_wide": frames, "lowres_depth": frames, "highres_depth": laser}, trajectory=frames
    )
    recording = pickle.loads(pickle.dumps(stored(root)))
    assert len(recording) == 13
    exact = recording.truth(6)  # same instant, another camera: half a laser pixel on a slanted wall
    want = frames[6].depth
    assert exact["depth"].shape == want.shape and exact["depth"].dtype == torch.float32
    known = exact["depth"] > 0
    assert float(known.double().mean()) > 0.9
    assert float(((exact["depth"] - want).abs() / want)[known].max()) < 0.02
    assert float(exact["disagreement"]) < 0.01 and exact["surface"].shape == want.shape
    late = recording.truth(3)  # the nearest laser map is 50 ms away: accepted, and measurably off
    assert float(exact["disagreement"]) < float(late["disagreement"]) < 0.05
    assert recording.surfaces == {0: "ordinary"} and recording.odd_surfaces == ()


def test_laser_depth_far_in_time_or_in_disagreement_is_no_truth(tmp_path: Path) -> None:
    root = tmp_path / "1"
    frames = shots(100 + np.arange(13) / 60)
    wrong = frames[0].replace(depth=frames[0].depth * 1.1)  # registration failed
    writers.write_arkitscenes(
        root, {"lowres_wide": frames, "lowres_depth": frames, "highres_depth": [wrong]}, trajectory=frames
    )
    recording = stored(root)
    assert recording.report == ("8 frames without laser depth within 0.08 s: no ground truth",)
    rejected = recording.truth(0)
    assert not rejected["depth"].any() and float(rejected["disagreement"]) == pytest.approx(0.091, abs=0.002)
    assert stored(root, max_disagreement=0.2).truth(0)["depth"].all()
    far = recording.truth(-1)
    assert not far["depth"].any() and math.isnan(float(far["disagreement"]))
    assert len(stored(root, max_truth_gap=1.0).report) == 0
    blind = frames[0].replace(depth=torch.zeros_like(frames[0].depth))
    writers.write_arkitscenes(root, {"highres_depth": frames[:1], "lowres_depth": [blind]})
    unchecked = stored(root).truth(0)  # right, but nothing says so
    assert not unchecked["depth"].any() and math.isnan(float(unchecked["disagreement"]))
    assert not hasattr(stored(root, truth=False), "truth")


def test_laser_truth_enters_the_main_job(tmp_path: Path) -> None:
    root = tmp_path / "1"
    frames = shots(100 + np.arange(4) / 60)
    laser = shots(100 + np.arange(4) / 60, VGA, VGA_HW)
    for frame in frames:
        frame.depth[..., 32:] = 0  # what the LiDAR does not see
    writers.write_arkitscenes(
        root, {"lowres_wide": frames, "lowres_depth": frames, "highres_depth": laser}, trajectory=frames
    )
    reference, _, exact, surface, *_ = PairDataset(stored(root), [(0, 3)], torch.float32)[0]
    assert exact.depth_camera is None and surface.shape == exact.depth.shape
    uv = torch.tensor([[[20.0, 20.0], [40.0, 30.0], [50.0, 10.0]]])
    assert (holdout.sample_truth(reference, uv, truth="raw").depth > 0).tolist() == [[True, False, False]]
    found = holdout.sample_truth(exact, uv, truth="full")
    assert found.ok.all() and float((found.depth - 1.8).abs().max()) < 0.1


def test_other_folders_are_not_taken_for_captures(tmp_path: Path) -> None:
    for names in (("rgb", "depth"), ("wide",), ("wide", "color"), ("lowres_wide",)):
        root = tmp_path / "-".join(names)
        for name in names:
            (root / name).mkdir(parents=True)
        assert arkitscenes.recognise(root) is None
    assert arkitscenes.recognise(tmp_path / "gone") is None


@pytest.mark.parametrize("reader", [arkitscenes, ca1m])
def test_settings_hold_the_defaults(reader: object) -> None:
    settings = OmegaConf.load(config_dir() / "data" / f"{reader.__name__.split('.')[-1]}.yaml")
    options = {k: p.default for k, p in inspect.signature(reader.read).parameters.items() if k != "root"}
    assert {k: settings[k] for k in options} == options
