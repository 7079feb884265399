"""Stray Scanner: captures of a known room written and read back, a real one, and damaged ones."""

from __future__ import annotations

import os
import pickle
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from support import writers
from support.box_scene import disagreement, off_wall, own_camera, pose, turned_over, world_points
from support.stray_frames import DEPTH_HW, HW, camera_of, walk

from dhtorch import data, pytree
from dhtorch.data.clocks import FilmPairing
from dhtorch.data.codecs import video as codec_video
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import stray
from dhtorch.export.stray import ARKIT_UP, turn_world
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Frame, Pose

pytest.importorskip("av")

ROOT = os.environ.get("DHTORCH_DATA")
STEP = 1e-3  # m, of the depth codes


def same_scene(recording: data.Recording, frames: list[Frame], image: float = 12) -> None:
    assert len(recording) == len(frames)
    for got, want in zip(recording, frames, strict=True):
        torch.testing.assert_close(got.camera.f, want.camera.f)
        torch.testing.assert_close(got.camera.c, want.camera.c)
        torch.testing.assert_close(got.depth, want.depth, atol=STEP / 2 + 1e-6, rtol=0)
        assert torch.equal(got.conf, want.conf)
        torch.testing.assert_close(got.time, want.time, atol=1e-8, rtol=0)
        T = turn_world(want, ARKIT_UP).T_world_from_cam
        torch.testing.assert_close(got.T_world_from_cam.R, T.R, atol=1e-12, rtol=0)
        torch.testing.assert_close(got.T_world_from_cam.t, T.t, atol=1e-12, rtol=0)
        assert float(off_wall(world_points(own_camera(got))).max()) < 2 * STEP
        assert picture_error(got, want) < image
    assert disagreement(own_camera(recording[0]), own_camera(recording[1]))[0] < 0.04


def picture_error(a: Frame, b: Frame) -> float:
    return float((a.image.float() - b.image.float()).abs().mean())


def steady(i: int) -> Pose:
    """Pose ``i`` of a motion so fast that the picture before or after is clearly another."""
    return se3.exp(torch.tensor([[0.0, 0.12 * i, 0.05 * i, 0.05 * i, 0.0, 0.0]]).double())


# ------------------------------------------------------------------------------------------------ written, then read


@pytest.mark.parametrize("codec", ["libx264", "libx265"])
@pytest.mark.parametrize("depth_format", ["png", "npy"])
def test_capture_gives_back_the_scene(tmp_path: Path, codec: str, depth_format: Any) -> None:
    frames = walk()
    writers.write_stray(tmp_path, frames, codec=codec, per_frame=True, depth_format=depth_format)
    assert data.recognise(tmp_path) == ("stray", "odometry.csv, camera_matrix.csv and depth/")
    recording = data.open(tmp_path)
    assert recording.report == () and recording.number.tolist() == [0, 1, 2, 3]
    assert recording.rate_hz == pytest.approx(60, rel=1e-4)
    same_scene(recording, frames)
    copy = pickle.loads(pickle.dumps(recording))
    assert all(torch.equal(a.image, b.image) for a, b in zip(copy, recording, strict=True))
    assert pytree.collate(list(recording)).image.shape == (4, 3, *HW)


def test_frames_may_start_anywhere(tmp_path: Path) -> None:
    frames = walk()
    writers.write_stray(tmp_path, frames, per_frame=True, start=998)
    recording = data.open(tmp_path)
    assert recording.number.tolist() == [998, 999, 1000, 1001]
    same_scene(recording, frames)


def test_frames_dropped_by_the_app_keep_their_times(tmp_path: Path) -> None:
    """15 frames a second by leaving three of four out: pictures count on, the clock does not follow from them."""
    frames = [f.replace(time=f.time + 3 * i / 60) for i, f in enumerate(walk())]
    frames[3] = frames[3].replace(time=frames[3].time + 1)  # and a pause
    writers.write_stray(tmp_path, frames, per_frame=True)
    (tmp_path / "imu.csv").write_text("timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\nno, number\n")
    recording = data.open(tmp_path)
    assert recording.rate_hz == pytest.approx(15, rel=1e-4) and recording.report == ()
    same_scene(recording, frames)


def test_old_odometry_has_the_K_of_the_last_frame(tmp_path: Path) -> None:
    writers.write_stray(tmp_path, walk())
    assert "fx" not in (tmp_path / "odometry.csv").read_text()
    assert all(torch.equal(f.camera.f, camera_of(3).f) for f in data.open(tmp_path))


def test_new_odometry_has_K_in_every_row_and_empty_cells(tmp_path: Path) -> None:
    writers.write_stray(tmp_path, walk(), per_frame=True)
    lines = (tmp_path / "odometry.csv").read_text().splitlines()
    assert lines[0].endswith("cy, distortion_center_x, distortion_center_y") and lines[1].endswith(", , ")
    assert [float(f.camera.f[0, 0]) for f in data.open(tmp_path)] == [80, 81, 82, 83]
    assert [float(f.camera.f[0, 0]) for f in data.open(tmp_path, per_frame=False)] == [83] * 4
    cells = lines[2].split(",")
    cells[9:13] = [" "] * 4  # a row without
    (tmp_path / "odometry.csv").write_text("\n".join([*lines[:2], ",".join(cells), *lines[3:]]))
    assert [float(f.camera.f[0, 0]) for f in data.open(tmp_path)] == [80, 83, 82, 83]


def test_K_of_another_size(tmp_path: Path) -> None:
    """A capture whose video was made smaller keeps its K: an option gives the size of K."""
    frames = walk(2)
    writers.write_stray(tmp_path, [f.replace(camera=cameras.resize(f.camera, HW, (1440, 1920))) for f in frames])
    camera = data.open(tmp_path, K_hw=(1440, 1920))[0].camera
    torch.testing.assert_close(camera.f, camera_of(1).f)
    torch.testing.assert_close(camera.c, camera_of(1).c)


def test_confidence_of_three_channels(tmp_path: Path) -> None:
    frames = walk(2)
    writers.write_stray(tmp_path, frames, per_frame=True, confidence_channels=3)
    same_scene(data.open(tmp_path), frames)


def test_capture_without_confidence(tmp_path: Path) -> None:
    writers.write_stray(tmp_path, [f.replace(conf=None) for f in walk(2)])
    recording = data.open(tmp_path)
    assert recording.report == () and recording[0].conf is None


def test_random_access_and_opening_decodes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = walk(30, lambda i: pose(i / 8))
    writers.write_stray(tmp_path, frames, per_frame=True)
    recording = data.open(tmp_path)
    for i in (29, 0, 13, 12, 13, 25, 3):
        errors = [picture_error(recording[i], frame) for frame in frames]
        assert errors[i] == min(errors) < 12
        assert torch.equal(recording[i].camera.f, frames[i].camera.f)
    monkeypatch.setattr(codec_video._Decoder, "frame", lambda *_: pytest.fail("decoded a picture"))
    codec_video.close_videos()
    assert len(data.open(tmp_path)) == 30


# --------------------------------------------------------------------------------------------- the first picture lost


def test_first_picture_before_time_zero(tmp_path: Path) -> None:
    """An edit list hides it: a decoder that obeys shows n − 1 pictures, all one row too early."""
    frames = walk(8, steady)
    writers.write_stray(tmp_path, frames, per_frame=True, first_picture="hidden")
    assert len(codec_video.read_video_times(tmp_path / "rgb.mp4")) == 7
    recording = data.open(tmp_path)
    assert recording.report == () and len(recording) == 8
    right = [picture_error(a, b) for a, b in zip(recording, frames, strict=True)]
    wrong = [picture_error(a, b) for a, b in zip(list(recording)[1:], frames, strict=False)]
    assert max(right) < 12 < min(wrong)  # so the check can tell


@pytest.fixture
def room() -> list[Frame]:
    """A furnished room: edges of depth are edges of the picture."""
    synthetic = pytest.importorskip("dhtorch.synthetic.recording")
    scene = synthetic.SyntheticRoom(hw=(96, 128), n_frames=9, lidar="exact", supersample=1, step_m=0.12)
    return [scene[i] for i in range(9)]


def test_first_picture_lost_is_told_by_the_edges(tmp_path: Path, room: list[Frame]) -> None:
    writers.write_stray(tmp_path, room, first_picture="lost")
    recording = data.open(tmp_path)
    assert recording.number.tolist() == list(range(1, 9))
    assert recording.report == (
        "rgb.mp4 has 8 frames for 9 rows: its first frame is lost (by the edges of depth and image)",
        "row 0 has no picture in rgb.mp4: left out",
    )
    pictures = [f.image if f.image.dtype == torch.uint8 else f.image * 255 for f in room]
    assert all(
        float((a.image.float() - b.float()).abs().mean()) < 6 for a, b in zip(recording, pictures[1:], strict=True)
    )
    torch.testing.assert_close(recording.poses.t[:1], turn_world(room[1], ARKIT_UP).T_world_from_cam.t)
    other = data.open(tmp_path, lost_first=False)
    assert other.number.tolist() == list(range(8)) and "its last frame is lost (option lost_first)" in other.report[0]


def test_last_picture_lost_is_told_by_the_edges(tmp_path: Path, room: list[Frame]) -> None:
    writers.write_stray(tmp_path / "long", room)
    writers.write_stray(tmp_path / "short", room[:-1])
    (tmp_path / "short" / "rgb.mp4").rename(tmp_path / "long" / "rgb.mp4")
    recording = data.open(tmp_path / "long")
    assert recording.number.tolist() == list(range(8))
    assert recording.report[0].endswith("its last frame is lost (by the edges of depth and image)")
    assert data.open(tmp_path / "long", lost_first=True).number.tolist() == list(range(1, 9))


def test_a_longer_film_is_paired_from_the_first_picture_on(tmp_path: Path) -> None:
    frames = walk(6)
    writers.write_stray(tmp_path / "rows", frames[:4], per_frame=True)
    writers.write_stray(tmp_path / "film", frames, per_frame=True)
    (tmp_path / "film" / "rgb.mp4").replace(tmp_path / "rows" / "rgb.mp4")
    recording = data.open(tmp_path / "rows")
    assert recording.report == ("rgb.mp4 has 6 frames for 4 rows: paired from the first on",)
    same_scene(recording, frames[:4])


def test_a_shorter_film_of_constant_rate_is_refused_unless_an_option_decides(tmp_path: Path) -> None:
    frames = walk(6)
    writers.write_stray(tmp_path, frames, per_frame=True, pictures=[0, 1, 2], film_times=[0, 1 / 60, 2 / 60])
    expected = r"rgb.mp4: frames: found 3 pictures less than rows at a constant rate.*data.lost_first=true"
    with pytest.raises(FormatError, match=expected):
        data.open(tmp_path)
    recording = data.open(tmp_path, lost_first=False)
    assert recording.report[0] == "rgb.mp4 has 3 frames for 6 rows: its last frames are lost (option lost_first)"
    assert recording.report[1] == "rows 3, 4, 5 have no picture in rgb.mp4: left out"
    same_scene(recording, frames[:3])
    assert data.open(tmp_path, lost_first=True).number.tolist() == [3, 4, 5]


# --------------------------------------------------------------------------------------------- pictures by their stamps


def same_pictures(recording: data.Recording, frames: list[Frame], numbers: list[int]) -> None:
    """The frames with these numbers, each with its own picture, depth and pose."""
    assert recording.number.tolist() == numbers
    for got, i in zip(recording, numbers, strict=True):
        errors = [picture_error(got, frame) for frame in frames]
        assert errors[i] == min(errors) < 12
        torch.testing.assert_close(got.depth, frames[i].depth, atol=STEP / 2 + 1e-6, rtol=0)
        T = turn_world(frames[i], ARKIT_UP).T_world_from_cam
        torch.testing.assert_close(got.T_world_from_cam.t, T.t, atol=1e-12, rtol=0)


LOST = [4, 5, 6]
KEPT = [i for i in range(12) if i not in LOST]


@pytest.mark.parametrize("rate", [60.0, 30.0, 24.0])
def test_rows_of_lost_pictures_are_left_out_and_named(tmp_path: Path, rate: float) -> None:
    """Whatever nominal rate a writer gave the film; the rows are at 60 Hz."""
    frames = walk(12, steady)
    writers.write_stray(tmp_path, frames, pictures=KEPT, film_times=[i / rate for i in KEPT])
    recording = data.open(tmp_path)
    same_pictures(recording, frames, KEPT)
    assert recording.report[0].startswith("rgb.mp4 has 9 frames for 12 rows: paired by their time stamps")
    assert ("it plays" in recording.report[0]) == (rate != 60)
    assert recording.report[1] == "rows 4, 5, 6 have no picture in rgb.mp4: left out"


@pytest.mark.parametrize("every", [2, 3])
def test_a_film_of_a_fraction_of_the_rate(tmp_path: Path, every: int) -> None:
    frames = walk(12, steady)
    kept = list(range(0, 12, every))
    writers.write_stray(tmp_path, frames, pictures=kept)
    recording = data.open(tmp_path)
    same_pictures(recording, frames, kept)
    assert "have no picture in rgb.mp4: left out" in recording.report[1]


def test_a_film_of_another_nominal_rate_or_a_variable_one_keeps_its_rows(tmp_path: Path) -> None:
    frames = walk(8, steady)
    jitter = [i / 60 + 0.006 * (-1) ** i for i in range(8)]
    for name, stamps in (("nominal", [i / 30 for i in range(8)]), ("variable", jitter)):
        writers.write_stray(tmp_path / name, frames, film_times=stamps)
        recording = data.open(tmp_path / name)
        assert recording.report == ()
        same_pictures(recording, frames, list(range(8)))


def test_stamps_that_jitter_do_not_hide_a_lost_picture(tmp_path: Path) -> None:
    frames = walk(12, steady)
    kept = [i for i in range(12) if i != 5]
    writers.write_stray(tmp_path, frames, pictures=kept, film_times=[i / 60 + 0.002 * (-1) ** i for i in kept])
    same_pictures(data.open(tmp_path), frames, kept)


# ---------------------------------------------------------------------------------------------------------- orientation


def test_display_matrix_with_lying_depth_changes_nothing(tmp_path: Path, room: list[Frame]) -> None:
    writers.write_stray(tmp_path / "plain", room)
    for k in (1, 2, 3):
        writers.write_stray(tmp_path / str(k), room, display=k)
        recording = data.open(tmp_path / str(k))
        assert recording.report == ()
        for got, want in zip(recording, data.open(tmp_path / "plain"), strict=True):
            assert torch.equal(got.image, want.image) and torch.equal(got.depth, want.depth)


def test_a_display_matrix_applies_where_depth_lies_as_the_film_is_displayed(tmp_path: Path, room: list[Frame]) -> None:
    writers.write_stray(tmp_path, room, film_turn=3, display=1)
    recording = data.open(tmp_path)
    assert recording.report == (
        "orientation: display matrix of rgb.mp4: pictures are turned by 90 degrees, as depth lies",
    )
    assert max(picture_error(got, want) for got, want in zip(recording, room, strict=True)) < 6
    writers.write_stray(tmp_path / "wrong", room, film_turn=1, display=1)
    with pytest.raises(FormatError, match=r"orientation: found display matrix of rgb.mp4, but edges"):
        data.open(tmp_path / "wrong")


@pytest.mark.parametrize("k", [1, 3])
def test_a_film_turned_upright_is_turned_back(tmp_path: Path, room: list[Frame], k: int) -> None:
    writers.write_stray(tmp_path, room, film_turn=k)
    recording = data.open(tmp_path)
    assert recording.report == (
        "orientation: depth 128x96 (landscape) beside pictures 96x128 (portrait): "
        f"pictures are turned by {270 if k == 1 else 90} degrees, as their edges coincide",
    )
    for got, want in zip(recording, room, strict=True):
        assert got.image.shape == want.image.shape
        assert picture_error(got, want) < 6
        torch.testing.assert_close(got.camera.c, want.camera.c)


# ------------------------------------------------------------------------------------------------- damage and absence


def test_missing_parts_keep_the_rest_in_step(tmp_path: Path) -> None:
    frames = walk(8)
    writers.write_stray(tmp_path, frames, per_frame=True)
    (tmp_path / "depth" / "000002.png").unlink()
    (tmp_path / "confidence" / "000003.png").unlink()
    shutil.copy(tmp_path / "depth" / "000000.png", tmp_path / "depth" / "000099.png")
    lines = (tmp_path / "odometry.csv").read_text().splitlines()
    for row, cell in ((5, "nan"), (6, "0")):
        cells = lines[1 + row].split(",")
        cells[5:9] = [cell] * 4
        lines[1 + row] = ",".join(cells)
    (tmp_path / "odometry.csv").write_text("\n".join(lines))
    recording = data.open(tmp_path)
    assert recording.number.tolist() == [0, 1, 4, 7]
    assert recording.report == (
        "frame 2: no depth: left out",
        "frame 3: no confidence: left out",
        "2 frames (5, 6): its pose is not usable (tracking lost): left out",
        "frame 000099: no row in odometry.csv: left out",
    )
    same_scene(recording, [frames[i] for i in (0, 1, 4, 7)])
    without = data.open(tmp_path, poses=False)
    assert without.poses is None and without.number.tolist() == [0, 1, 4, 5, 6, 7]


def test_no_video(tmp_path: Path) -> None:
    frames = walk()
    writers.write_stray(tmp_path, frames, per_frame=True, video=False)
    expected = "rgb.mp4: file: found no such file, expected .*data.images=false reads depth only"
    with pytest.raises(FormatError, match=expected):
        data.open(tmp_path)
    recording = data.open(tmp_path, images=False, K_hw=HW)
    for got, want in zip(recording, frames, strict=True):
        assert got.image.shape == (1, 3, 0, 0)
        assert torch.equal(got.camera.f, want.camera.f)
        assert float(off_wall(world_points(got)).max()) < 2 * STEP  # by the depth map's own camera
    assert disagreement(recording[0], recording[1])[0] < 0.04


def test_distortion_tables_are_reported(tmp_path: Path) -> None:
    writers.write_stray(tmp_path, walk(2))
    (tmp_path / "distortion").mkdir()
    assert data.open(tmp_path).report == ("distortion/ has lens tables of each frame: they are not applied",)


def test_cut_off_last_row_and_stamps_out_of_order(tmp_path: Path) -> None:
    writers.write_stray(tmp_path, walk())
    table = tmp_path / "odometry.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([*lines[:-1], lines[-1][:40]]))
    recording = data.open(tmp_path, lost_first=False)
    assert recording.number.tolist() == [0, 1, 2]
    assert recording.report[0] == "the last row of odometry.csv is cut off: left out"
    early = "1.5" + lines[3][lines[3].index(",") :]
    table.write_text("\n".join([*lines[:3], early, *lines[4:]]))
    recording = data.open(tmp_path)
    assert recording.times is None and recording.report == ("time stamps do not increase: there are no times",)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("timestamp, frame, x", "time, frame, x", r"odometry.csv: header: found time, frame, x.*, expected timestamp"),
        (", 000001,", ", 1e3,", r"odometry.csv: row 1 frame: found 1e3, expected a frame number"),
        (", 000002,", ", 000001,", r"odometry.csv: row 2 frame: found 1, expected a number beyond 1"),
        (", 000001,", ",", r"odometry.csv: row 1: found 8 columns, expected 9, as the header"),
        ("258528.330141458", "inf", r"odometry.csv: row 0 timestamp: found inf, expected a time in s"),
        (", 000001, ", ", 000001, x", r"odometry.csv: row 1 x: found x.*, expected a number"),
        (", 000001, ", ", 000001, 1e9", r"odometry.csv: pose \d.*: found|row 1 x"),
    ],
)
def test_unsound_odometry(tmp_path: Path, old: str, new: str, message: str) -> None:
    writers.write_stray(tmp_path, walk())
    table = tmp_path / "odometry.csv"
    text = table.read_text()
    assert old in text
    table.write_text(text.replace(old, new, 1))
    with pytest.raises(FormatError, match=message):
        data.open(tmp_path)


def test_unsound_files(tmp_path: Path) -> None:
    writers.write_stray(tmp_path, walk())
    good = (tmp_path / "camera_matrix.csv").read_text()
    for text, message in (
        ("1,2,3\n4,5,6", "camera_matrix.csv: K: found"),
        (good.replace("1.0", "2.0"), r"camera_matrix.csv: intrinsics of frame 0: found .*no skew"),
    ):
        (tmp_path / "camera_matrix.csv").write_text(text)
        with pytest.raises(FormatError, match=message):
            data.open(tmp_path)[0]
    (tmp_path / "camera_matrix.csv").write_text(good)
    depth = tmp_path / "depth" / "000000.png"
    depth.write_bytes(depth.read_bytes()[:-30])
    recording = data.open(tmp_path)
    with pytest.raises(FormatError, match=r"000000.png: data: found a truncated"):
        recording[0]
    assert recording[1].depth.shape == (1, *DEPTH_HW)
    np.save(tmp_path / "depth" / "000001.npy", np.zeros((3, 4)))
    (tmp_path / "depth" / "000001.png").unlink()
    with pytest.raises(FormatError, match=r"000001.npy: depth: found float64 of shape"):
        data.open(tmp_path)[1]
    (tmp_path / "rgb.mp4").write_bytes(b"no video")
    with pytest.raises(FormatError, match=r"rgb.mp4: content"):
        data.open(tmp_path)


# --------------------------------------------------------------------------------------------------------------- real


@pytest.mark.data
@pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")
def test_real_capture() -> None:
    root = Path(str(ROOT)) / "stray_room"
    with pytest.raises(FormatError, match=r"rgb.mp4: file: found no such file"):
        data.open(root)
    recording = data.open(root, images=False)
    assert recording.format == "stray" and recording.report == () and len(recording) == 60
    assert recording.rate_hz == pytest.approx(60, rel=1e-3)
    a, b = recording[0], recording[59]
    assert a.depth.shape == (1, 192, 256) and a.conf.unique().tolist() == [0, 1, 2]
    torch.testing.assert_close(a.camera.f, torch.full((1, 2), 1352.0168))
    torch.testing.assert_close(a.depth_camera.f, a.camera.f / 7.5)
    torch.testing.assert_close(a.depth_camera.c, (a.camera.c + 0.5) / 7.5 - 0.5)
    agree, count = disagreement(a, b)
    assert agree < 0.02 and count > 40_000
    assert disagreement(turned_over(a), turned_over(b))[0] > 0.15  # so the check above can tell


@pytest.mark.parametrize(
    ("leads", "lost"),
    [
        ([0.06, 0.2], "last"),
        ([-0.06, -0.2], "first"),
        ([0.06, 0.05], None),
        ([-0.06, -0.05], None),
        ([0.2, -0.2], None),
        ([0.2], None),
        ([], None),
    ],
)
def test_edges_decide_which_pictures_are_lost_where_all_lead_alike(
    monkeypatch: pytest.MonkeyPatch, leads: list[float], lost: str | None
) -> None:
    pairings = [FilmPairing(np.arange(3) - k) for k in (0, 1, 2)]
    monkeypatch.setattr(stray, "_edge_leads", lambda *_: np.array(leads))
    load: Any = SimpleNamespace(video=Path("rgb.mp4"), root=Path("scan"))
    if lost is None:
        with pytest.raises(FormatError, match=r"rgb\.mp4: frames: found 2 pictures less than rows at a constant rate"):
            stray._choose_pairing(load, pairings, -2, None)
        return
    pairing, choice = stray._choose_pairing(load, pairings, -2, None)
    assert pairing is pairings[-1 if lost == "first" else 0]
    assert choice == f"its {lost} frames are lost (by the edges of depth and image)"


def test_a_pairing_is_stated_with_the_reason_for_it() -> None:
    pairings, load = [FilmPairing(np.arange(3)), FilmPairing(np.arange(3) - 1)], cast("Any", None)
    choose = stray._choose_pairing
    assert choose(load, pairings, 1, None) == (pairings[0], "paired from the first on")
    assert choose(load, pairings, 1, True) == (pairings[1], "its first frame is lost (option lost_first)")
    assert choose(load, pairings, -1, False) == (pairings[0], "its last frame is lost (option lost_first)")
    for speed, pace in (
        (1.0, ""),
        (1.019, ""),
        (1.25, ", it plays 1.25 times as fast"),
        (0.8, ", it plays 1.25 times as slow"),
    ):
        only = FilmPairing(np.arange(3), speed, by_stamps=True)
        assert choose(load, [only], 0, None) == (only, f"paired by their time stamps{pace}")
    assert choose(load, pairings[:1], 0, None) == (pairings[0], "")
