"""Stray Scanner: captures of a known room written and read back, a real one, and damaged ones."""

import io
import os
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from support import writers
from support.box_scene import disagreement, turned_over
from support.capture_cases import DELETE, Case, check_case
from support.stray_frames import DEPTH_HW, HW, camera_of, walk
from support.writers import parts

from dhtorch import data
from dhtorch.data.clocks import FilmPairing
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import stray
from dhtorch.export.stray import ARKIT_UP, turn_world
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Frame, Pose

pytest.importorskip("av")

ROOT = os.environ.get("DHTORCH_DATA")
STEP = 1e-3  # m, of the depth codes


def picture_error(a: Frame, b: Frame) -> float:
    return float((a.image.float() - b.image.float()).abs().mean())


def steady(i: int) -> Pose:
    """Pose ``i`` of a motion so fast that the picture before or after is clearly another."""
    return se3.exp(torch.tensor([[0.0, 0.12 * i, 0.05 * i, 0.05 * i, 0.0, 0.0]]).double())


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
NO_ROWS = ["^rgb.mp4 has 9 frames for 12 rows: paired by their time stamps", "^rows 4, 5, 6 have no picture in rgb.mp4"]


@pytest.mark.parametrize(
    ("n", "kept", "stamps", "report"),
    [
        # whatever nominal rate a writer gave the film; the rows are at 60 Hz
        *((12, KEPT, [i / rate for i in KEPT], NO_ROWS) for rate in (60.0, 30.0, 24.0)),
        *((12, list(range(0, 12, every)), None, ["", "have no picture in rgb.mp4: left out"]) for every in (2, 3)),
        (8, list(range(8)), [i / 30 for i in range(8)], []),
        (8, list(range(8)), [i / 60 + 0.006 * (-1) ** i for i in range(8)], []),
        (12, [*range(5), *range(6, 12)], [i / 60 + 0.002 * (-1) ** i for i in range(12) if i != 5], ["", ""]),
    ],
)
def test_pictures_are_paired_by_their_stamps(
    tmp_path: Path, n: int, kept: list[int], stamps: list[float] | None, report: list[str]
) -> None:
    frames = walk(n, steady)
    writers.write_stray(tmp_path, frames, pictures=kept, film_times=stamps)
    recording = data.open(tmp_path)
    same_pictures(recording, frames, kept)
    assert len(recording.report) == len(report) and all(map(re.search, report, recording.report))
    if report is NO_ROWS:
        assert ("it plays" in recording.report[0]) == (stamps != [i / 60 for i in KEPT])


@pytest.mark.parametrize(
    ("written", "report"),
    [
        *(({"display": k}, ()) for k in (0, 1, 2, 3)),  # a display matrix with lying depth changes nothing
        (
            {"film_turn": 3, "display": 1},
            ("orientation: display matrix of rgb.mp4: pictures are turned by 90 degrees, as depth lies",),
        ),
        *(
            (
                {"film_turn": k},
                (
                    "orientation: depth 128x96 (landscape) beside pictures 96x128 (portrait): "
                    f"pictures are turned by {degrees} degrees, as their edges coincide",
                ),
            )
            for k, degrees in ((1, 270), (3, 90))
        ),
    ],
)
def test_a_film_is_read_as_depth_lies(
    tmp_path: Path, room: list[Frame], written: dict[str, Any], report: tuple[str, ...]
) -> None:
    writers.write_stray(tmp_path, room, **written)
    recording = data.open(tmp_path)
    assert recording.report == report
    for got, want in zip(recording, room, strict=True):
        assert got.image.shape == want.image.shape and picture_error(got, want) < 6
        torch.testing.assert_close(got.camera.c, want.camera.c)
        torch.testing.assert_close(got.depth, want.depth, atol=STEP / 2 + 1e-6, rtol=0)


def test_a_display_matrix_against_the_edges_is_refused(tmp_path: Path, room: list[Frame]) -> None:
    writers.write_stray(tmp_path, room, film_turn=1, display=1)
    with pytest.raises(FormatError, match=r"orientation: found display matrix of rgb.mp4, but edges"):
        data.open(tmp_path)


def npy(array: np.ndarray) -> bytes:
    """An array as a file."""
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def lagging() -> list[Frame]:
    """15 frames a second by leaving three of four out, and a pause: the clock does not follow from the numbers."""
    frames = [f.replace(time=f.time + 3 * i / 60) for i, f in enumerate(walk())]
    return [*frames[:3], frames[3].replace(time=frames[3].time + 1)]


def cells(row: int, first: int, last: int, text: str) -> tuple[str, Any]:
    """An edit of cells of a row of the odometry."""

    def change(table: str) -> str:
        lines = table.splitlines()
        words = lines[1 + row].split(",")
        words[first:last] = [text] * (last - first)
        return "\n".join([*lines[: 1 + row], ",".join(words), *lines[2 + row :]])

    return ROWS, change


def cut(table: str) -> str:
    lines = table.splitlines()
    return "\n".join([*lines[:-1], lines[-1][:40]])


ROWS = "odometry.csv"
EACH = {"per_frame": True}
SHORT = EACH | {"pictures": [0, 1, 2], "film_times": [0, 1 / 60, 2 / 60]}
IMU = ("imu.csv", "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\nno, number\n")


def large() -> list[Frame]:
    """Frames with K of the size before the video was made smaller."""
    return [f.replace(camera=cameras.resize(f.camera, HW, (1440, 1920))) for f in walk(2)]


def stray_case(name: str, frames: Any, edits: Any = (), expect: Any = None, **more: Any) -> Case:
    return Case(name, writers.write_stray, frames, edits, expect or {}, up=ARKIT_UP, **more)


ALL = {"same": ([0, 1, 2, 3], STEP), "report": ()}
CASES = [
    *(stray_case(f"{codec}, {kind}", walk, (), ALL | {"number": [0, 1, 2, 3], "rate": pytest.approx(60, rel=1e-4)},
                 written=EACH | {"codec": codec, "depth_format": kind})
      for codec in ("libx264", "libx265") for kind in ("png", "npy")),
    # An edit list hides the first image: a decoder that obeys shows n − 1 images, all one row too early.
    stray_case("the first image before time 0", lambda: walk(8, steady), (),
               {"number": list(range(8)), "report": (), "same": (list(range(8)), STEP)},
               written=EACH | {"first_picture": "hidden"}),
    stray_case("no film", walk, written=EACH | {"video": False},
               error="rgb.mp4: file: found no such file, expected .*data.images=false reads depth only"),
    stray_case("depth alone", walk, (),
               {"hw": (0, 0), "all f": [80, 81, 82, 83], "posed": True, "depth hw": DEPTH_HW,
                "depth f": cameras.resize(camera_of(0), HW, DEPTH_HW).f[0].tolist()},
               written=EACH | {"video": False}, options={"images": False, "K_hw": HW}),
    stray_case("starts anywhere", walk, (), ALL | {"number": [998, 999, 1000, 1001]}, written=EACH | {"start": 998}),
    stray_case("frames dropped by the app", lagging, [IMU], ALL | {"rate": pytest.approx(15, rel=1e-4)}, written=EACH),
    stray_case("K of the last frame", walk, (), {"all f": [83] * 4, "report": ()}),
    stray_case("K in every row", walk, (), {"all f": [80, 81, 82, 83]}, written=EACH),
    stray_case("K of the file", walk, (), {"all f": [83] * 4}, written=EACH, options={"per_frame": False}),
    stray_case("a row without K", walk, [cells(1, 9, 13, " ")], {"all f": [80, 83, 82, 83]}, written=EACH),
    stray_case("K of another size", large, (), {"f": camera_of(1).f[0].tolist(), "c": pytest.approx(
        camera_of(1).c[0].tolist(), abs=1e-4)}, options={"K_hw": (1440, 1920)}),
    stray_case("confidence of three channels", lambda: walk(2), (), {"same": ([0, 1], STEP), "conf": True},
               written=EACH | {"confidence_channels": 3}),
    stray_case("no confidence", lambda: [f.replace(conf=None) for f in walk(2)], (), {"conf": False, "report": ()}),
    stray_case("a longer film", lambda: walk(6), [("odometry.csv", lambda text: "\n".join(text.splitlines()[:5])),
                                                  ("depth/00000[45].png", DELETE), ("confidence/00000[45].png", DELETE)],
               {"report": ("rgb.mp4 has 6 frames for 4 rows: paired from the first on",), "same": ([0, 1, 2, 3], STEP)},
               written=EACH),
    stray_case("a shorter film of constant rate", lambda: walk(6), written=SHORT,
               error=r"rgb.mp4: frames: found 3 pictures less than rows at a constant rate.*data.lost_first=true"),
    stray_case("its last pictures lost", lambda: walk(6), (), {"same": ([0, 1, 2], STEP), "report": (
        "rgb.mp4 has 3 frames for 6 rows: its last frames are lost (option lost_first)",
        "rows 3, 4, 5 have no picture in rgb.mp4: left out")}, written=SHORT, options={"lost_first": False}),
    stray_case("its first pictures lost", lambda: walk(6), (), {"number": [3, 4, 5]}, written=SHORT,
               options={"lost_first": True}),
    stray_case("missing parts", lambda: walk(8),
               [("depth/000002.png", DELETE), ("confidence/000003.png", DELETE), ("depth/000099.png", b""),
                cells(5, 5, 9, "nan"), cells(6, 5, 9, "0")],
               {"number": [0, 1, 4, 7], "same": ([0, 1, 4, 7], STEP), "report": (
                   "frame 2: no depth: left out", "frame 3: no confidence: left out",
                   "2 frames (5, 6): its pose is not usable (tracking lost): left out",
                   "frame 000099: no row in odometry.csv: left out")}, written=EACH),
    stray_case("missing poses, none read", lambda: walk(8), [cells(5, 5, 9, "nan")],
               {"number": list(range(8)), "posed": False}, written=EACH, options={"poses": False}),
    stray_case("tables of the lens", lambda: walk(2), [("distortion/0.bin", b"")],
               {"report": ["^distortion/ has lens tables of each frame: they are not applied"]}),
    stray_case("a row that is cut off", walk, [(ROWS, cut)],
               {"number": [0, 1, 2], "report": ["^the last row of odometry.csv is cut off: left out", "frame 000003: no row", "last frame is lost"]},
               options={"lost_first": False}),
    stray_case("stamps out of order", walk, [cells(2, 0, 1, "1.5")],
               {"times": None, "report": ("time stamps do not increase: there are no times",)}),
    *(stray_case(f"odometry {old} {new}", walk, [(ROWS, lambda text, old=old, new=new: text.replace(old, new, 1))],
                 error=message) for old, new, message in (
        ("timestamp, frame, x", "time, frame, x", r"odometry.csv: header: found time, frame, x.*, expected timestamp"),
        (", 000001,", ", 1e3,", r"odometry.csv: row 1 frame: found 1e3, expected a frame number"),
        (", 000002,", ", 000001,", r"odometry.csv: row 2 frame: found 1, expected a number beyond 1"),
        (", 000001,", ",", r"odometry.csv: row 1: found 8 columns, expected 9, as the header"),
        ("258528.330141458", "inf", r"odometry.csv: row 0 timestamp: found inf, expected a time in s"),
        (", 000001, ", ", 000001, x", r"odometry.csv: row 1 x: found x.*, expected a number"),
        (", 000001, ", ", 000001, 1e9", r"odometry.csv: pose \d.*: found|row 1 x"))),
    *(stray_case(f"{name} {message}", walk, edits, error=message) for name, edits, message in (
        ("K of two rows", [("camera_matrix.csv", "1,2,3\n4,5,6")], "camera_matrix.csv: K: found"),
        ("K with skew", [("camera_matrix.csv", [("1.0", "2.0")])],
         r"camera_matrix.csv: intrinsics of frame 0: found .*no skew"),
        ("a short map", [("depth/000000.png", parts.encode_unfiltered_png(np.ones((24, 32), np.uint16))[:-30])],
         r"000000.png: data: found a truncated"),
        ("floats", [("depth/000001.png", DELETE), ("depth/000001.npy", npy(np.zeros((3, 4))))],
         r"000001.npy: depth: found float64 of shape"),
        ("no film", [("rgb.mp4", b"no video")], r"rgb.mp4: content"))),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_variants_are_read_and_faults_named(case: Case, tmp_path: Path) -> None:
    check_case(case, tmp_path)


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
