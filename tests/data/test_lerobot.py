"""LeRobot data sets, v3 and v2.1: written with known geometry, read back, and damaged."""

import json
import pickle
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.box_scene import CAMERA, HW, pose, render
from support.capture_cases import DELETE, Case, check_case, check_frames
from support.robot_episodes import two_episodes

pytest.importorskip("av")
pytest.importorskip("pyarrow")

import av
import pyarrow
from pyarrow import parquet
from support.writers.lerobot import quantise_lerobot_depth, write_lerobot
from support.writers.parts import write_video

from dhtorch import data
from dhtorch.cli import run
from dhtorch.data.codecs import parquet as codec_parquet
from dhtorch.data.codecs.video import close_videos
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers import lerobot_rows
from dhtorch.data.readers.lerobot_meta import LeRobotFeature
from dhtorch.data.units import DepthUnit
from dhtorch.export.arrays import encode_depth_codes
from dhtorch.records import Camera, Frame

KEY = "observation.images.front"
STEP = {"video": 3e-3, "tiff": 1e-6, "png": 1e-3, "array": 1e-3}  # m, up to 5 m (codes: 2.8 mm there)


@pytest.fixture(autouse=True)
def _clean() -> Iterator[None]:
    yield
    close_videos()


# ------------------------------------------------------------------------------------------------ written, then read


def test_one_episode_and_its_camera_by_name(tmp_path: Path) -> None:
    write_lerobot(tmp_path, two_episodes())
    check_frames(data.open(tmp_path, episode=1, camera=KEY), two_episodes()[1], STEP["video"], exact=True)
    assert [r.name[-12:] for r in data.open_all(tmp_path, episode=[1, 0])] == ["000001/front", "000000/front"]


@pytest.mark.parametrize("version", [3, 2])
def test_thousands_of_episodes_are_listed_and_none_is_opened(
    tmp_path: Path, version: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twenty thousand, by copies of the metadata: opening reads no table, and the last one is the right one."""
    write_lerobot(tmp_path, two_episodes(), version=version)
    n, meta = 20_000, tmp_path / "meta"
    if version == 2:
        (meta / "episodes.jsonl").write_text("\n".join(json.dumps({"episode_index": i, "length": 4}) for i in range(n)))
        for kind in ("data", "videos"):
            for file in list((tmp_path / kind).rglob("episode_000001.*")):
                other = Path(str(file).replace("chunk-000", "chunk-019").replace("000001", f"{n - 1:06d}"))
                other.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(file, other)
        rewrite(next((tmp_path / "data/chunk-019").iterdir()), partial(with_column, "episode_index", n - 1))
    else:
        listed = meta / "episodes/chunk-000/file-000.parquet"
        parquet.write_table(many(parquet.read_table(listed), n), listed)
        rewrite(tmp_path / "data/chunk-000/file-000.parquet", lambda t: with_column("episode_index", n - 1, t.slice(2)))
    opened: list[Path] = []
    read = lerobot_rows.read_columns
    monkeypatch.setattr(lerobot_rows, "read_columns", lambda f, *a, **k: opened.append(f) or read(f, *a, **k))
    recordings = data.open_all(tmp_path)
    assert opened == []
    assert len(recordings) == n and recordings.names[7].endswith("/episode_000007/front")
    check_frames(recordings[-1], two_episodes()[1], STEP["video"], exact=True)
    assert data.open_capture(tmp_path, gap=3)[-1].gap == 3 and 1 <= len(opened) <= 4
    assert recordings[n - 1].name == recordings.names[-1]
    assert pickle.loads(pickle.dumps(recordings)).names == recordings.names
    assert [r.name for r in recordings[n - 1 :]] == recordings.names[n - 1 :]
    with pytest.raises(IndexError):
        recordings[n]
    with pytest.raises(FormatError, match=r"20000 recordings: .*episode_000000/front, .*…, expected one"):
        data.open(tmp_path)


def many(table: pyarrow.Table, n: int) -> pyarrow.Table:
    """The first row n − 1 times, then the second, numbered."""
    rows = table.take([0] * (n - 1) + [1])
    return rows.set_column(rows.schema.get_field_index("episode_index"), "episode_index", pyarrow.array(range(n)))


def with_column(name: str, value: int, table: pyarrow.Table) -> pyarrow.Table:
    """The table with one value in every row of a column."""
    return table.set_column(table.schema.get_field_index(name), name, pyarrow.array([value] * len(table)))


def test_lost_zeros_are_no_returns(tmp_path: Path) -> None:
    frame = two_episodes()[0][0]
    depth = frame.depth.clone()
    depth[0, :4], depth[0, 4:6], depth[0, 6:8], depth[0, 8:10], depth[0, 10] = 0, 12.0, 9.5, 0.011, 0.3
    write_lerobot(tmp_path, [[frame.replace(depth=depth)]])
    got = data.open(tmp_path)[0].depth[0]
    assert not got[:6].any() and not got[8:10].any()  # never a made-up centimetre
    torch.testing.assert_close(got[6:8], depth[0, 6:8], atol=2.2e-3, rtol=0)
    assert bool((got[10:] > 0).all())
    cut = data.open(tmp_path, depth_range=[0.5, 3.0])[0].depth[0]
    assert torch.equal(cut, torch.where((got >= 0.5) & (got <= 3), got, torch.zeros_like(got))) and bool(
        (cut != got).any()
    )


@pytest.mark.parametrize("log", [True, False])
def test_codes_to_metres(log: bool) -> None:
    feature = LeRobotFeature(
        "d", "video", (1, 4096, 1), {"video.depth_min": 0.2, "video.depth_max": 4, "video.use_log": log}
    )
    metres = lerobot_rows.dequantise_depth(feature, np.arange(4096, dtype=np.uint16), Path("x"))
    assert not metres[[0, 1, 4094, 4095]].any() and (np.diff(metres[2:-2]) > 0).all()
    steps = np.diff(metres[2:-2])
    assert steps[-1] / steps[0] == pytest.approx((4 + 3.5) / (0.2 + 3.5) if log else 1, rel=0.01)
    assert metres[1000] == pytest.approx(3.7 * (7.5 / 3.7) ** (1000 / 4095) - 3.5 if log else 0.2 + 3.8 * 1000 / 4095)
    with pytest.raises(FormatError, match="12-bit codes"):
        lerobot_rows.dequantise_depth(feature, np.array([4096], dtype=np.uint16), Path("x"))
    for wrong in (5.0, -1.0, "0.2", None, [0.2], 10**400, float("nan"), float("inf")):
        bad = LeRobotFeature("d", "video", (1, 1), {"video.depth_min": wrong, "video.depth_max": 4.0})
        with pytest.raises(
            FormatError, match=r"x: d depth_min, depth_max, shift: found .*, expected a range of metres"
        ):
            lerobot_rows.dequantise_depth(bad, np.zeros((1, 1), np.uint16), Path("x"))
    bad = LeRobotFeature("d", "video", (1, 1), {"video.shift": -0.01, "video.use_log": log})
    if log:
        with pytest.raises(FormatError, match="a range of metres"):
            lerobot_rows.dequantise_depth(bad, np.zeros((1, 1), np.uint16), Path("x"))


def test_writer_codes_by_the_published_rule() -> None:
    """Step 1.5 mm at 1 m, 1.8 at 2 m, 2.8 at 5 m, 4.4 at 10 m."""
    z = torch.tensor([[[1.0, 2.0, 5.0, 9.98]]])
    blank = Frame(torch.zeros(1, 3, 1, 4), z, CAMERA)
    codes = quantise_lerobot_depth(blank)
    feature = LeRobotFeature("d", "video", (1, 4, 1), {})
    metres = lerobot_rows.dequantise_depth(feature, codes + np.array([[0], [1]], dtype=np.uint16), Path("x"))
    np.testing.assert_allclose(np.diff(metres, axis=0)[0] * 1000, [1.5, 1.8, 2.8, 4.4], atol=0.06)


def test_a_grey_camera_of_8_bits_is_no_depth(tmp_path: Path) -> None:
    """One channel alone does not make depth: infrared cameras have it, too."""
    write_lerobot(tmp_path, two_episodes(), depth="video", depth_pixels="yuv420p12le")
    edit(tmp_path, lambda info: info["features"][f"{KEY}_depth"].update(info={"video.pix_fmt": "gray"}))
    assert {r.camera_name for r in data.open_all(tmp_path, episode=0, fov=60.0)} == {KEY, f"{KEY}_depth"}


def test_a_depth_video_of_16_bits_holds_steps_of_an_assumed_millimetre(tmp_path: Path) -> None:
    episodes = two_episodes()
    write_lerobot(tmp_path, episodes, depth=None)
    pictures = [encode_depth_codes(frame.depth, 1000) for episode in episodes for frame in episode]
    key, (video,) = f"{KEY}_raw", (tmp_path / "videos").rglob("*.mp4")
    file = Path(str(video).replace(KEY, key))
    file.parent.mkdir(parents=True)
    with av.open(str(file), "w", format="matroska") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.pix_fmt, (stream.height, stream.width) = "gray16le", pictures[0].shape
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="gray16le")))
        container.mux(stream.encode())
    feature = {"dtype": "video", "shape": [*episodes[0][0].depth.shape[1:], 1], "names": None, "info": {}}
    edit(tmp_path, lambda info: info["features"].update({key: feature}))
    (table,) = (tmp_path / "meta" / "episodes").rglob("*.parquet")
    rows = parquet.read_table(table)
    for name in ("chunk_index", "file_index", "from_timestamp", "to_timestamp"):
        rows = rows.append_column(f"videos/{key}/{name}", rows.column(f"videos/{KEY}/{name}"))
    parquet.write_table(rows, table)
    recording = data.open(tmp_path, episode=1, tolerance=1e-3)  # Matroska counts milliseconds
    assert recording.depth_unit == DepthUnit(1e-3) and "gray16le" in recording.report[0]
    torch.testing.assert_close(recording[0].depth, episodes[1][0].depth, atol=6e-4, rtol=0)
    torch.testing.assert_close(
        data.open(tmp_path, episode=1, tolerance=1e-3, depth_unit="cm")[0].depth, 10 * recording[0].depth
    )


def edit(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    file = root / "meta" / "info.json"
    info = json.loads(file.read_text())
    change(info)
    file.write_text(json.dumps(info))


# -------------------------------------------------------------------------------------------------- intrinsics, depth


# ------------------------------------------------------------------------------------------------------- rows and time


def rewrite(file: Path, change: Callable[[pyarrow.Table], pyarrow.Table]) -> None:
    parquet.write_table(change(parquet.read_table(file)), file, row_group_size=3)


def test_episodes_are_not_told_from_the_stamps(tmp_path: Path) -> None:
    """In v3 both start at stamp 0 in one table and one video; the boundary stands in meta/episodes alone."""
    write_lerobot(tmp_path, two_episodes())
    file = tmp_path / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    name = f"videos/{KEY}/from_timestamp"
    rewrite(file, lambda t: t.set_column(t.schema.get_field_index(name), name, pyarrow.array([0.0, 1 / 30])))
    first, second = data.open_all(tmp_path)
    assert torch.equal(first[0].image, two_episodes()[0][0].image)
    assert torch.equal(second[0].image, two_episodes()[0][1].image)  # as the table says
    rewrite(file, lambda t: t.set_column(t.schema.get_field_index(name), name, pyarrow.array([0.0, 0.1 + 2e-4])))
    with pytest.raises(FormatError, match=r"time 0.100200 s: found nearest frame at 0.100000 s, expected one within"):
        data.open(tmp_path, episode=1)[0]
    assert torch.equal(data.open(tmp_path, episode=1, tolerance=1e-3)[0].image, two_episodes()[1][1].image)


def write_film(root: Path, _frames: list[Frame], *, pictures: list[int], stamps: list[float] | None = None) -> None:
    """A set whose colour video of episode 1 has these frames at these time stamps in s."""
    write_lerobot(root, two_episodes(), version=2, depth="tiff")
    file = root / "videos" / "chunk-000" / KEY / "episode_000001.mp4"
    images = [two_episodes()[1][i].image[0].permute(1, 2, 0).numpy() for i in pictures]
    write_video(file, images, [i / 30 for i in range(len(images))] if stamps is None else stamps, crf=1)


@pytest.mark.parametrize(
    ("written", "numbers", "times"),
    [
        (([4, 7, 9], [0.5, 0.6, 0.9]), [4, 7, 9], [0.5, 0.6, 0.9]),
        (([4, 4, 9], [np.nan] * 3), [0, 1, 2], None),
        (([4, np.nan, 9], [0.5, 0.4, 0.9]), [0, 1, 2], [0.0, 0.1, 0.2]),
    ],
)
def test_a_capture_keeps_its_clock_where_that_increases(monkeypatch, written, numbers, times) -> None:
    monkeypatch.setattr(lerobot_rows, "find_capture_columns", lambda _: True)
    table = {name: np.array([-1, *x]) for name, x in zip(lerobot_rows._CAPTURE_COLUMNS, written, strict=True)}
    own = np.arange(3)
    found = lerobot_rows.read_capture_clock(None, table, own + 1, own, np.array([0.0, 0.1, 0.2]))
    assert found[0].tolist() == numbers and (found[1] is None if times is None else found[1].tolist() == times)


INFO, SIDE = "meta/info.json", "meta/intrinsics.json"
TABLE = "data/chunk-000/episode_000001.parquet"
DEPTH = f"{KEY}_depth"
FIRST, SECOND = (lambda: two_episodes()[0]), (lambda: two_episodes()[1])


def write_both(root: Path, _frames: list[Frame], **options: Any) -> None:
    write_lerobot(root, two_episodes(), **options)


def write_left(root: Path, frames: list[Frame], **options: Any) -> None:
    """A set with the films of another camera."""
    write_both(root, frames, **options)
    shutil.copytree(root / "videos/chunk-000" / KEY, root / "videos/chunk-000/observation.images.left")


def declare(name: str) -> tuple[str, Any]:
    """An edit of the features: another camera like the first."""

    def change(text: str) -> str:
        info = json.loads(text)
        info["features"] |= {
            key.replace("front", name): info["features"][key]
            for key in (KEY, f"{KEY}.intrinsics")
            if key in info["features"]
        }
        return json.dumps(info)

    return INFO, change


def lenses() -> list[Frame]:
    """Frames of cameras that change."""
    return [render(Camera(CAMERA.f + i, CAMERA.c), pose(i), HW, i / 30) for i in range(3)]


def set_case(name: str, edits: Any = (), expect: Any = None, *, frames: Any = FIRST, **more: Any) -> Case:
    options = {"episode": 1 if frames is SECOND else 0} | more.pop("options", {})
    return Case(name, more.pop("write", write_both), frames, edits, expect or {}, options=options, **more)


def feature(key: str, **change: Any) -> tuple[str, Any]:
    return INFO, {"features": {key: change}}


def column(name: str, values: list[float]) -> Any:
    """An edit of a table."""
    cells = pyarrow.array(np.array(values, np.float32))
    return lambda table: table.set_column(table.schema.get_field_index(name), name, cells)


def late(table: pyarrow.Table) -> pyarrow.Table:
    """A table without numbers of rows whose times begin one frame later."""
    stamps = table.column("timestamp").to_numpy() + 1 / 30
    return column("timestamp", stamps)(table).drop_columns(["frame_index"])


def odd_tracks(info: dict[str, Any]) -> tuple[str, Any]:
    return feature(DEPTH, info=info)


NO_K = {"intrinsics": None}
SIDE_CAR = {KEY: {"K": [[50, 0, 30], [0, 50, 20], [0, 0, 1]], "dist": [0.1, 0.01, 0, 0, 0],
                  "K_depth": [[70, 0, 31], [0, 66, 23], [0, 0, 1]]}}  # fmt: skip
ALL = {"same": ([0, 1], 3e-3), "report": ()}
WRIST = {"dtype": "image", "shape": [*HW, 3], "info": {}}
V2 = {"version": 2}

CASES = [
    *(set_case(name, (), {"number": numbers, "report": report, "same": (numbers, 1e-5)}, frames=SECOND,
               write=write_film, written={"pictures": numbers, "stamps": stamps})
      for name, numbers, stamps, report in (
          ("rows beyond a shorter video", [0, 1, 2], None,
           ["row 3 has no picture in episode_000001.mp4: left out; the video ends early"]),
          ("rows of lost images", [0, 2, 3], [0, 2 / 30, 3 / 30],
           ["^row 1 has no picture in episode_000001.mp4: left out$"]),
          ("a video at another rate with a frame for each row", [0, 1, 2, 3], [i / 25 for i in range(4)],
           ["has as many frames as rows, but at other times: paired by their order$"]))),
    *(set_case(f"version {version}, {image}, {depth}", (), {
        "name": f"episode_{episode:06d}/front", "report": (), "rate": 30,
        "times of": [round(i / 30, 6) for i in range(n)], "same": (list(range(n)), STEP[depth], 1.0, True)},
               frames=frames, written={"version": version, "image": image, "depth": depth, "intrinsics": intrinsics})
      for image, depth, intrinsics in (("video", "video", "feature"), ("image", "tiff", "side-car"),
                                       ("video", "png", "feature"), ("image", "array", "feature"))
      for version in (2, 3) for episode, n, frames in ((0, 2, FIRST), (1, 4, SECOND))),
    *(set_case(f"depth without a flag, {depth}", [odd_tracks({"is_depth_map": DELETE})],
               {"report": report, "unit": unit, "same": ([0, 1], STEP[depth], 1.0, True)}, written={"depth": depth},
               options=options)
      for depth, kind, unit in (("video", "gray12le", None), ("png", "uint16", (1e-3, None)))
      for options, report in (
          ({}, (f"{DEPTH} looks like depth: one channel, {kind}, without is_depth_map; data.depth={DEPTH} sets it",)),
          ({"depth": DEPTH}, ()))),
    # times that begin one frame after the video: by time every row would get the next image
    set_case("rows without numbers whose clock is late", [(TABLE, late)],
             {"number": [0, 1, 2, 3], "times of": [0.0, 0.033333, 0.066667, 0.1], "same": ([0, 1, 2, 3], 1e-5),
              "report": ["times begin at 0.03333 s: images taken by the order of rows"]}, frames=SECOND,
             written=V2 | {"depth": "tiff"}),
    set_case("a camera that is only declared", [declare("ghost")], {"name": "episode_000000/front"}, written=V2),
    set_case("a camera that is only declared, by name", [declare("ghost")], written=V2,
             options={"camera": "observation.images.ghost"}, error="ghost"),
    *(set_case(f"{camera} of two cameras", [declare("left")], {"name": f"episode_000000/{camera}"}, which=place,
               written=V2, options={"camera": ["observation.images.left", KEY], "K": [60, 60, 30, 20]}, write=write_left)
      for place, camera in enumerate(("left", "front"))),
    *(set_case(f"codes in {pixels}", (), ALL, written={"depth_pixels": pixels})
      for pixels in ("gray12le", "yuv420p12le")),
    set_case("the older flag of depth", [odd_tracks({"is_depth_map": DELETE, "video.is_depth_map": True})], ALL),
    set_case("a shape of three channels",
             [odd_tracks({"is_depth_map": False, "video.pix_fmt": "gray12le"}), feature(DEPTH, shape={2: 3})],
             {"same": ([0, 1], 3e-3)}),
    set_case("millimetres", (), {"unit": (1e-3, None), "same": ([0, 1], 1e-3)}, written={"depth": "png"}),
    set_case("metres by option", (), {"same": ([0, 1], 1e-3, 1000)}, written={"depth": "png"},
             options={"depth_unit": "m"}),
    set_case("metres by info", [odd_tracks({"depth_unit": "m"})],
             {"unit": (1.0, f"{INFO}: {DEPTH} depth_unit"), "same": ([0, 1], 1e-3, 1000)}, written={"depth": "png"}),
    *(set_case(f"unit {unit}", [odd_tracks({"depth_unit": unit})], written={"depth": "png"},
               error=r"depth_unit: found .*, expected one of m, cm, mm, inch") for unit in ("ft", 1000, ["m"])),
    # intrinsics
    set_case("no K", written=NO_K,
             error=r"observation.images.front: found no intrinsics, expected data.fov=69 .*meta/intrinsics.json"),
    set_case("K and lens by option", (), {"f": CAMERA.f[0].tolist(), "lens": pytest.approx([0.1, 0, 0, 0])},
             written=NO_K, options={"K": [61.5, 58.25, 33.5, 21.75], "distortion": [0.1, 0, 0, 0]}),
    set_case("K in the side-car", [(SIDE, json.dumps(SIDE_CAR))],
             {"f": [50, 50], "depth f": [70, 66], "lens": pytest.approx([0.1, 0.01, 0, 0, 0])}, written=NO_K),
    set_case("K of depth by option", [(SIDE, json.dumps(SIDE_CAR))], {"depth f": [71, 66]}, written=NO_K,
             options={"K_depth": [71, 66, 31, 23]}),
    set_case("an unknown feature", written=NO_K, options={"intrinsics": "x"},
             error=r"option intrinsics: found x, expected one of"),
    set_case("two options", written=NO_K, options={"K": [1, 1, 1, 1], "fov": 60},
             error=r"options: found data.K and data.fov, expected one of them"),
    set_case("four numbers", (), {"f": CAMERA.f[0].tolist(), "report": ()}, written=NO_K,
             options={"intrinsics": [61.5, 58.25, 33.5, 21.75]}),
    set_case("degrees", (), {"f": pytest.approx([HW[1] / 2] * 2), "report": ["guess"]}, written=NO_K,
             options={"intrinsics": 90}),
    *(set_case(f"fov {fov}", written=NO_K, options={"fov": fov}, error="1 to 179 degrees") for fov in (0, 179, True)),
    Case("K changes from frame to frame", lambda root, frames: write_lerobot(root, [two_episodes()[0], frames]), lenses,
         (), {"all f": [61.5, 62.5, 63.5], "same": ([0, 1, 2], 3e-3)}, options={"episode": 1}),
    # cameras and depth
    set_case("depth named like its camera", [(INFO, {"features": {"observation.images.wrist": WRIST}})],
             {"report": (), "empty": [False, False]}, written={"depth": "array"}, options={"camera": KEY}),
    *(set_case(f"depth of another name, {depth}", [
        (INFO, [(f'"{DEPTH}"', '"side_depth"')]), (INFO, {"features": {"observation.images.wrist": WRIST}})], expect,
        written={"depth": "array"}, options={"camera": KEY} | ({"depth": depth} if depth else {}), error=error)
      for depth, expect, error in (
          (None, {"report": (f"{KEY}: no depth feature: depth is empty",), "empty": [True, True], "depth hw": HW}, None),
          ("side_depth", None, r"side_depth, expected|columns"),
          ("nothing_there", None, r"option depth: found nothing_there"))),
    set_case("no such episode", options={"episode": 7},
             error=r"meta: episodes: found 0 of those requested, expected \[7\]"),
    set_case("no such camera", options={"camera": "wrist"},
             error=r"info.json: cameras: found wrist, expected some of observation.images.front"),
    # rows
    set_case("a row is missing", [(TABLE, lambda t: t.take([0, 1, 3]))],
             {"number": [0, 1, 3], "report": ["3 rows, 4 according to meta/episodes"], "same": ([0, 1, 3], 3e-3)},
             frames=SECOND, written=V2),
    set_case("rows out of order", [(TABLE, lambda t: t.take([0, 1, 3])), (TABLE, lambda t: t.take([0, 2, 1]))],
             {"number": [0, 3], "report": ["1 row out of order: left out", ""]}, frames=SECOND, written=V2),
    set_case("a wrong stamp", [(TABLE, column("timestamp", [0, 9, 2 / 30, 3 / 30]))],
             {"number": [0, 1, 2, 3], "times": pytest.approx([0, 1 / 30, 2 / 30, 3 / 30]),
              "report": ["1 time stamp out of order: rows keep the order of their numbers", ""]}, frames=SECOND,
             written=V2 | {"depth": None}),
    *(set_case(f"info {key} {value}", [(INFO, {key: value})], error=rf"info.json: {key}", written={"depth": None})
      for key, value in (
          ("data_path", "../{chunk_index:03d}.parquet"), ("data_path", "/etc/{chunk_index:03d}.parquet"),
          ("data_path", "{chunk_index.__class__}.parquet"), ("data_path", "{chunk_index:0999999999d}.parquet"),
          ("data_path", "{other}.parquet"), ("video_path", "{video_key:03d}"), ("codebase_version", "v1.6"),
          ("fps", 0), ("fps", None), ("chunks_size", 0), ("features", []))),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_variants_are_read_and_faults_named(case: Case, tmp_path: Path) -> None:
    check_case(case, tmp_path)


# ---------------------------------------------------------------------------------------------------------- bad input


def test_pages_that_unpack_into_too_much_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Megabytes of zeros in a few kilobytes: honest in the footer, then claimed by a page alone."""
    file = tmp_path / "x.parquet"
    parquet.write_table(pyarrow.table({"x": [bytes(3 << 20)] * 2}), file, compression="zstd", use_dictionary=False)
    assert file.stat().st_size < 10_000 and len(codec_parquet.read_columns(file, ["x"])["x"][1]) == 3 << 20
    monkeypatch.setattr(codec_parquet, "_MAX_UNPACKED_BYTES", 4 << 20)
    with pytest.raises(FormatError, match=r"x.parquet: x: found \d+ bytes, expected at most 4194304"):
        codec_parquet.read_columns(file, ["x"])
    parquet.write_table(pyarrow.table({"x": np.arange(100)}), file, use_dictionary=False, compression="none")
    assert codec_parquet.read_columns(file, ["x"])["x"].tolist() == list(range(100))
    good = file.read_bytes()
    assert good[4:7] == b"\x15\x00\x15", "Thrift's compact form: field 1, a data page, then field 2, its size unpacked"
    size = ((good[7] & 127) | good[8] << 7) // 2  # zigzag, seven bits a byte
    coded = [bytes([(2 * n & 127) | 128, 2 * n >> 7]) for n in (size, size + 1000)]
    file.write_bytes(good.replace(coded[0], coded[1], 1))
    with pytest.raises(FormatError, match=rf"that unpack into {size + 1000}"):
        codec_parquet.read_columns(file, ["x"])


def test_columns_that_cannot_be_arrays(tmp_path: Path) -> None:
    file = tmp_path / "x.parquet"
    columns = {"hole": [1.0, None], "ragged": [[1.0], [1.0, 2.0]], "text": ["a", "b"], "deep": [[[1, 2]], [[3, 4]]]}
    parquet.write_table(pyarrow.table(columns), file)
    for name, message in (("hole", "1 missing values"), ("ragged", "lists of unequal length"), ("none", "columns")):
        with pytest.raises(FormatError, match=message):
            codec_parquet.read_columns(file, [name])
    read = codec_parquet.read_columns(file, ["text", "deep"], (1, 2))
    assert read["text"] == ["b"] and read["deep"].tolist() == [[[3, 4]]]
    assert codec_parquet.read_row(file, ("deep",), 1)["deep"].tolist() == [[3, 4]]
    with pytest.raises(FormatError, match=r"rows: found 2, expected row 2"):
        codec_parquet.read_row(file, ("deep",), 2)


def test_a_set_without_intrinsics_can_be_looked_at(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_lerobot(tmp_path / "x", [two_episodes()[0]], version=2, intrinsics=None, depth=None, poses=False)
    assert run.main(["inspect", str(tmp_path / "x"), "--out", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert "no intrinsics: depth cannot be computed" in out and "frames " in out and "field of view" not in out
