"""RH20T scenes: written with known geometry, read back, and damaged."""

import json
import math
import pickle
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.capture_cases import DELETE, Case, check_case, check_frames
from support.rh20t_frames import BASE, CAMERA, FIXED, HAND, HW, moving, still

pytest.importorskip("av")

from support.box_scene import off_wall, pose, render, world_points

from dhtorch import data
from dhtorch.data.codecs.video import close_videos
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import rh20t, rh20t_robot, rh20t_set
from dhtorch.data.readers.rh20t_robot import ROBOT_ARMS, RobotStream
from dhtorch.export.video import write_lossless
from dhtorch.geometry import se3
from dhtorch.records import Frame
from dhtorch.synthetic.rh20t import to_robot_notation, write_rh20t


@pytest.fixture(autouse=True)
def _clean() -> Iterator[None]:
    yield
    close_videos()


# ------------------------------------------------------------------------------------------------------ written scenes


def scene(tmp_path: Path, **options: object) -> Path:
    hand = se3.to_matrix(pose(5, 0.3))[0].numpy()
    both = {FIXED: still(), HAND: moving()}
    return write_rh20t(tmp_path, both, **{"T_world_from_base": BASE, "hand_at_calibration": hand, **options})


# ------------------------------------------------------------------------------------------------ written, then read


@pytest.mark.parametrize("configuration", range(1, 8))
def test_fixed_and_hand_held_cameras_give_back_the_scene(tmp_path: Path, configuration: int) -> None:
    serials = (FIXED, *ROBOT_ARMS[configuration].in_hand)
    hand = se3.to_matrix(pose(5, 0.3))[0].numpy()
    shots = {FIXED: still(), serials[1]: moving()}
    root = write_rh20t(
        tmp_path, shots, configuration=configuration, T_world_from_base=BASE, hand_at_calibration=hand
    )  # fmt: skip
    recordings = {r.name.split("/")[1]: r for r in data.open_all(root)}
    assert data.recognise(root)[0] == "rh20t" and recordings.keys() == shots.keys()
    for serial, frames in shots.items():
        assert recordings[serial].report == () and recordings[serial].rate_hz == pytest.approx(10)
        check_frames(recordings[serial], frames, 1e-3)
    assert len(pickle.dumps(recordings[FIXED])) < 20_000


def test_second_camera_on_the_hand_keeps_its_place_beside_the_first(tmp_path: Path) -> None:
    first, second = ROBOT_ARMS[6].in_hand
    beside = se3.exp(torch.tensor([[0.1, -0.2, 0.05, 0.06, 0.01, -0.02]]).double())
    frames = [render(CAMERA, se3.compose(f.T_world_from_cam, beside), HW, float(f.time)) for f in moving()]
    hand = se3.to_matrix(pose(5, 0.3))[0].numpy()
    shots = {first: moving(), second: frames}
    root = write_rh20t(tmp_path, shots, configuration=6, T_world_from_base=BASE, hand_at_calibration=hand)
    check_frames(data.open(root, serials=[second]), frames, 1e-3)


def test_a_hand_camera_taken_for_a_fixed_one_is_wrong(tmp_path: Path) -> None:
    """So that the test above can tell: its extrinsics hold at calibration alone."""
    recording = data.open(scene(tmp_path), serials=[HAND], in_hand=[])
    assert float(off_wall(world_points(recording[1])).median()) > 0.05


def test_low_bytes_lie_above_high_bytes(tmp_path: Path) -> None:
    """Codes around the wrap of the low byte: swapped planes would give 0.001 m steps of 256."""
    frame = still(1)[0]
    codes = torch.tensor([0, 255, 256, 257, 511, 512, 3000, 65279]).repeat(36, 8)
    root = write_rh20t(tmp_path, {FIXED: [frame.replace(depth=(codes / 1000)[None].float())]})
    torch.testing.assert_close(data.open(root)[0].depth[0], codes / 1000, atol=1e-6, rtol=0)


def test_depth_in_a_parallel_tree_at_half_the_size(tmp_path: Path) -> None:
    beside = tmp_path / "RH20T_depth" / "scene"
    root = scene(tmp_path / "RH20T", depth_root=beside)
    recording = data.open(root, serials=[FIXED], depth_root=str(beside))
    check_frames(recording, still(), 1e-3)
    small = [np.full((36, 32), 1, np.uint8) for _ in range(3)]
    write_lossless(beside / f"cam_{FIXED}" / "depth.mp4", small, "yuvj420p")
    frame = data.open(root, serials=[FIXED], depth_root=str(beside))[0]
    assert frame.depth.shape == (1, 18, 32) and float(frame.depth.max()) == pytest.approx(0.257)
    write_lossless(beside / f"cam_{FIXED}" / "depth.mp4", [x[:, :30] for x in small], "yuvj420p")
    with pytest.raises(FormatError, match=r"depth.mp4: size: found 30x36"):
        data.open(root, serials=[FIXED], depth_root=str(beside))


def test_outliers_of_a_lossy_high_byte_are_dropped(tmp_path: Path) -> None:
    frame = still(1)[0]
    spoilt = frame.depth.clone()
    spoilt[0, 10, 10] += 0.256
    spoilt[0, 20, 40] -= 0.256
    root = write_rh20t(tmp_path, {FIXED: [frame.replace(depth=spoilt)]})
    assert bool((data.open(root)[0].depth > 0).all())
    kept = data.open(root, outlier=0.15)[0].depth[0] > 0
    assert not kept[10, 10] and not kept[20, 40] and int((~kept).sum()) <= 4


# -------------------------------------------------------------------------------------------- the robot and its clocks


def test_streams_at_their_own_clocks(tmp_path: Path) -> None:
    streams = rh20t.read_robot_streams(scene(tmp_path))
    forces = {"force_torque_base", "force_torque_base_raw", "robot_ft"}
    forces |= {f"{name}/{serial}" for name in ("force_torque", "force_torque_raw") for serial in (FIXED, HAND)}
    assert streams.keys() == {"tcp_base", "joint", "gripper_command", "gripper_info"} | forces
    times = np.array([1_600_000_100.05, 1_600_000_100.15])
    joint, covered = streams["joint"].at(times)
    assert covered.all()
    np.testing.assert_allclose(joint, np.arange(7) + np.array([[0.05], [0.15]]), atol=1e-6)
    np.testing.assert_allclose(streams["gripper_command"].at(times)[0][:, 0], [49.95, 49.85], atol=1e-6)
    assert streams["tcp_base"].pose and streams["tcp_base"].values.shape == (3, 7)
    for name, want in (("force_torque_base", 0.05), (f"force_torque/{HAND}", 0.1), (f"force_torque_raw/{FIXED}", 3.1)):
        assert not streams[name].pose
        np.testing.assert_allclose(streams[name].at(times)[0][0], np.full(6, want), atol=1e-6)


def test_forces_that_are_none_and_forces_that_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "transformed").mkdir()
    file, stamp = tmp_path / "transformed" / "force_torque_base.npy", 1_600_000_000_500
    entries = [{"timestamp": stamp + i, "zeroed": value} for i, value in enumerate((np.full(6, np.nan), None, [0] * 6))]
    np.save(file, {FIXED: entries}, allow_pickle=True)
    streams = rh20t.read_robot_streams(tmp_path)
    assert streams.keys() == {"force_torque_base"} and streams["force_torque_base"].values.tolist() == [[0.0] * 6]
    np.save(file, {FIXED: [{"timestamp": stamp, "zeroed": [0] * 5}]}, allow_pickle=True)
    with pytest.raises(FormatError, match=r"force_torque_base.npy: zeroed: found 5 numbers, expected 6"):
        rh20t.read_robot_streams(tmp_path)
    np.save(file, {FIXED: [{"zeroed": [0] * 6}]}, allow_pickle=True)
    with pytest.raises(FormatError, match=r"force_torque_base.npy: entries: found something else, expected objects"):
        rh20t.read_robot_streams(tmp_path)


def test_serials_that_begin_with_a_letter_are_in_millimetres_too(tmp_path: Path) -> None:
    """The authors' tool writes the PNG of these cameras (L515) in quarters of a millimetre; the video is not a PNG."""
    root = write_rh20t(tmp_path, {"f0172289": still(2)})
    check_frames(data.open(root), still(2), 1e-3)


def test_tcp_of_each_camera_is_a_stream(tmp_path: Path) -> None:
    entry = {"timestamp": 1_600_000_000_500, "tcp": np.array([1.0, 2, 3, 1, 0, 0, 0]), "robot_ft": np.zeros(6)}
    lost = {**entry, "timestamp": 1_600_000_000_400, "tcp": np.full(7, np.nan)}
    (tmp_path / "transformed").mkdir()
    np.save(tmp_path / "transformed" / "tcp.npy", {FIXED: [entry, lost]}, allow_pickle=True)
    stream = rh20t.read_robot_streams(tmp_path)[f"tcp/{FIXED}"]
    assert stream.times.tolist() == [1_600_000_000.5] and stream.values.tolist() == [[1, 2, 3, 1, 0, 0, 0]]


def test_rotations_turn_at_constant_speed_the_short_way() -> None:
    angle = 2.5
    end = np.array([2.0, 0, 0, math.cos(angle / 2), 0, 0, math.sin(angle / 2)])
    end[3:] *= -1  # the same rotation
    stream = RobotStream(np.array([0.0, 1.0]), np.stack(([0, 0, 0, 1, 0, 0, 0], end)), pose=True)
    values, covered = stream.at(np.array([0.0, 0.2, 0.5, 1.0]), max_gap=2)
    assert covered.all()
    np.testing.assert_allclose(values[:, 0], [0, 0.4, 1, 2])
    got = 2 * np.arctan2(values[:, 6], values[:, 3])
    np.testing.assert_allclose(got % (2 * math.pi), np.array([0, 0.2, 0.5, 1]) * angle, atol=1e-12)


def test_gaps_are_not_bridged() -> None:
    stream = RobotStream(np.array([0.0, 0.1, 2.0]), np.array([[0.0], [1], [20]]))
    values, covered = stream.at(np.array([-1.0, 0.05, 0.1, 1.0, 1.9999, 2.5]))
    assert covered.tolist() == [False, True, True, False, True, False]
    np.testing.assert_allclose(values[[1, 2, 4], 0], [0.5, 1, 20])
    one = RobotStream(np.array([5.0]), np.array([[7.0]]))
    assert one.at(np.array([4.0, 5.0, 6.0]))[1].tolist() == [False, True, False]


@pytest.mark.parametrize("configuration", [1, 3, 5, 6])
def test_calibration_tcp_in_the_robots_notation(tmp_path: Path, configuration: int) -> None:
    arm = ROBOT_ARMS[configuration]
    for i in range(4):
        T = se3.to_matrix(pose(3 * i, 0.2))[0].numpy()
        np.save(tmp_path / "tcp.npy", to_robot_notation(arm.robot, T))
        np.testing.assert_allclose(rh20t_robot.read_calibration_tcp(tmp_path / "tcp.npy", arm), T, atol=1e-12)
    np.save(tmp_path / "tcp.npy", np.zeros(5))
    with pytest.raises(FormatError, match=r"tcp.npy: tcp: found"):
        rh20t_robot.read_calibration_tcp(tmp_path / "tcp.npy", arm)


# ---------------------------------------------------------------------------------------------------------- bad input


def write_scene(root: Path, _frames: list[Frame], *, name: str = "scene_cfg_0001", **options: Any) -> None:
    """A scene with a fixed camera and one on the hand."""
    scene(root, **options).rename(root / name)


def rh20t_case(name: str, edits: Any = (), expect: Any = None, *, serial: str | None = FIXED, **more: Any) -> Case:
    path = more.pop("path", None) or more.setdefault("written", {}).get("name", "scene_cfg_0001")
    options = ({} if serial is None else {"serials": [serial]}) | more.pop("options", {})
    frames = moving if serial == HAND else still
    return Case(name, write_scene, frames, edits, expect or {}, path=path, options=options, **more)


def stamps_with(**change: Any) -> tuple[str, Any]:
    """An edit of the time stamps of the fixed camera."""
    return f"{SCENE}/cam_{FIXED}/timestamps.npy", lambda stamps: {
        kind: change[kind](list(values)) if kind in change else values for kind, values in stamps.items()
    }


SCENE = "scene_cfg_0001"
META, TCP = f"{SCENE}/metadata.json", f"{SCENE}/transformed/tcp_base.npy"
FULL_K = np.array([[900.0, 0, 639.5, 0], [0, 900, 359.5, 0], [0, 0, 1, 0]])
K_FILE = ("calib/*/intrinsics.npy", lambda _: {FIXED: FULL_K, HAND: FULL_K[:, :3]})
NO_DEPTH = f"camera {FIXED}: no depth.mp4: depth is empty"
STANDS = "^unknown configuration: every camera is assumed stationary"

CASES = [
    # Which arrays a scene with a human lacks is not documented: cameras that stand still are read without any.
    *(rh20t_case(f"a human shows the task, {serial}, without {lacking}",
                 [(SCENE, Path(f"{SCENE}_human")), *((name, DELETE) for name in lacking)],
                 {"format": "rh20t", "posed": serial == FIXED or not lacking, "same": ([0, 1, 2], 1e-3),
                  "report": () if serial == FIXED or not lacking else (
                      f"camera {HAND} is on the hand, without {lacking[-1].rpartition('/')[2]}: no poses",)},
                 serial=serial, path=f"{SCENE}_human")
      for serial in (FIXED, HAND)
      for lacking in ((), (f"{SCENE}_human/transformed/tcp_base.npy",),
                      (f"{SCENE}_human/transformed/tcp_base.npy", "calib/*/tcp.npy"))),
    # A centre stays a centre; the plain rule would put it half a pixel off.
    *(rh20t_case(f"K of the full size, {serial}", [K_FILE], {"c": [31.5, 17.5], "f": [45, 45]}, serial=serial)
      for serial in (FIXED, HAND)),
    rh20t_case("K of another shape", [K_FILE], options={"calibrated_hw": (480, 640)},
               error=r"intrinsics.npy: image size: found 64x36, expected the shape of 640x480"),
    rh20t_case("no depth", (), {"empty": [True] * 3, "report": (NO_DEPTH,), "unit": None}, written={"depth": False}),
    *(rh20t_case(f"depth 15 ms later, {options}", (), {"number": [0, 1, 2], "same": ([0, 1, 2], 1e-3)},
                 written={"lag": 0.015}, options=options) for options in ({}, {"max_difference": 0.016})),
    rh20t_case("depth too late", written={"lag": 0.015}, options={"max_difference": 0.01},
               error=r"no depth within 0.01 s of any image"),
    rh20t_case("one depth too late", [stamps_with(depth=lambda t: [t[0], t[1] + 40, t[2]])],
               {"number": [0, 2], "same": ([0, 2], 1e-3), "report": ["1 image without depth within 0.02 s"]}),
    rh20t_case("a stamp too many", [stamps_with(color=lambda t: [*t, t[-1] + 100])],
               {"number": [0, 1, 2], "report": ["", "4 color stamps for 3 frames"]}, written={"depth": False}),
    rh20t_case("a stamp twice", [stamps_with(color=lambda t: [t[0], t[0], t[2]])],
               {"number": [0, 2], "report": ["", "1 color frame with a time stamp not later"]}, written={"depth": False}),
    rh20t_case("a gap of the tcp", [(TCP, lambda entries: {s: e[:2] for s, e in entries.items()})],
               {"number": [0, 1], "same": ([0, 1], 1e-3), "report": ["1 frame in a gap of the tcp stream"]}, serial=HAND),
    rh20t_case("no tcp", [(TCP, DELETE)], {"posed": False, "report": ["without tcp_base.npy: no poses"]}, serial=HAND),
    rh20t_case("no such camera", serial="7", error=r"option serials: found 7, expected some of 043322070878, 75061207"),
    rh20t_case("no such robot", options={"configuration": 9}, error=r"option configuration: found 9, expected 1 to 7"),
    rh20t_case("no images", [(f"{SCENE}/cam_{HAND}/color.mp4", DELETE)], serial=HAND, error=r"color.mp4"),
    rh20t_case("one camera without images, marked as bad",
               [(f"{SCENE}/cam_{HAND}/color.mp4", DELETE), (META, {"bad_calib_view": [FIXED]})],
               {"report": (f"camera {HAND}: no color.mp4: left out",
                           f"camera {FIXED}: calibration marked as bad in the metadata")}, serial=None),
    *(rh20t_case(f"calibration {value}", [(META, json.dumps({"calib": value}))], serial=None,
                 error=r"metadata.json: calib") for value in (-1, "../../x", None, 1.5)),
    rh20t_case("no calibration", [(META, "{}")], serial=None,
               error=r"metadata.json: calib: found -1, expected .*-1 = none"),
    rh20t_case("calibrations elsewhere", [("calib", Path("elsewhere"))], serial=None,
               error=r"intrinsics.npy: file: found no such file"),
    rh20t_case("no configuration", (), {"report": [STANDS], "same": ([0, 1, 2], 1e-3)}, written={"name": "scene"}),
    rh20t_case("configuration by option", (), {"report": (), "same": ([0, 1, 2], 1e-3)}, serial=HAND,
               written={"name": "scene"}, options={"configuration": 1}),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_variants_are_read_and_faults_named(case: Case, tmp_path: Path) -> None:
    check_case(case, tmp_path)


def test_calibrations_elsewhere(tmp_path: Path) -> None:
    root = scene(tmp_path / "a")
    shutil.move(tmp_path / "a" / "calib", tmp_path / "calibrations")
    assert len(data.open_all(root, calibration=str(tmp_path / "calibrations"))) == 2


def test_a_large_array_where_a_pose_is_expected_is_named_by_its_shape(tmp_path):
    file = tmp_path / "tcp.npy"
    np.save(file, np.zeros((5000, 5000), np.uint8))
    with pytest.raises(FormatError, match=r"tcp: found an array of shape \(5000, 5000\), expected 7 finite numbers"):
        rh20t_robot.read_calibration_tcp(file, rh20t_robot.RobotArm("ur5", (), *[np.eye(4)] * 3))


# ------------------------------------------------------------------------------------------------------ folders of a set


def robot_folder(root: Path, name: str, *cameras: str, calib: int | str = 1234) -> Path:
    """A scene with the (empty) videos of some cameras."""
    for serial in cameras:
        (root / name / f"cam_{serial}").mkdir(parents=True)
        (root / name / f"cam_{serial}" / "color.mp4").touch()
    (root / name).mkdir(parents=True, exist_ok=True)
    (root / name / "metadata.json").write_text(json.dumps({"calib": calib}))
    return root / name


def test_a_set_is_its_calibrated_robot_scenes_with_the_camera_in_the_order_of_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hand, other = ROBOT_ARMS[1].in_hand[0], "750612070851"
    later = robot_folder(tmp_path, "task_0002_user_0001_scene_0001_cfg_0001", hand, other)
    first = robot_folder(tmp_path / "RH20T_cfg1", "task_0001_user_0001_scene_0003_cfg_0001", hand)
    third = robot_folder(tmp_path, "task_0003_user_0001_scene_0001_cfg_0005", ROBOT_ARMS[5].in_hand[1])
    robot_folder(tmp_path, "task_0001_user_0001_scene_0001_cfg_0001_human", hand)
    robot_folder(tmp_path, "task_0001_user_0001_scene_0001_cfg_0008", hand)
    robot_folder(tmp_path, "task_0004_user_0001_scene_0001_cfg_0001", other)
    robot_folder(tmp_path, "task_0005_user_0001_scene_0001_cfg_0001", hand, calib=-1)
    robot_folder(tmp_path, "task_0006_user_0001_scene_0001_cfg_0001", hand, calib="-1")
    (robot_folder(tmp_path, "task_0007_user_0001_scene_0001_cfg_0001", hand) / "metadata.json").unlink()
    calls: list[dict[str, object]] = []
    monkeypatch.setattr(rh20t, "read", lambda scene, **options: [(scene, calls.append(options))])
    found = rh20t_set.open_set(tmp_path)
    assert found.names == [
        f"{f.name}/{s}" for f, s in ((first, hand), (later, hand), (third, ROBOT_ARMS[5].in_hand[1]))
    ]
    assert [found[k][0] for k in range(3)] == [first, later, third]
    defaults = {"max_difference": 0.02, "max_gap": 0.5, "outlier": 0.0}
    assert calls[1] == {"serials": [hand], "depth_root": None, **defaults}
    options = {"max_difference": 0.1, "max_gap": 0.2, "outlier": 3.0}
    found = rh20t_set.open_set(tmp_path, camera=other, depth_root="depths", **options)
    assert found.names == [f"{f.name}/{other}" for f in (later, tmp_path / "task_0004_user_0001_scene_0001_cfg_0001")]
    assert found[0][0] == later and calls[-1] == {"serials": [other], "depth_root": f"depths/{later.name}", **options}
    assert rh20t_set.open_set(tmp_path, limit=1).names == [f"{first.name}/{hand}"]
    with pytest.raises(FormatError, match=r"scenes: found none, expected task_…_cfg_… folders .* camera 'nobody'"):
        rh20t_set.open_set(tmp_path, camera="nobody")
    with pytest.raises(FormatError, match="path: found no such folder"):
        rh20t_set.open_set(tmp_path / "nowhere")
