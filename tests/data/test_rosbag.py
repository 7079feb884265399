"""Robots' recordings: bags of every storage written by the library rosbags and read back; damaged and odd ones."""

import bz2
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lz4.frame
import numpy as np
import pytest
import torch
from support.box_scene import render, walk
from support.capture_cases import Case, check_case, check_frames
from support.writers.rosbag import BagLayout, BagWriter, write_rosbag

from dhtorch import data
from dhtorch.data.codecs import bags, ros_images
from dhtorch.data.io.decode import FormatError, import_optional
from dhtorch.data.readers.rosbag_index import crop_camera
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame, Pose

STEP = 1e-3  # m, of a code of 16UC1
CAMERA_FRAME = BagLayout().colour_frame
SDK_DEPTH, SDK_COLOUR = "/device_0/sensor_0/Depth_0/image/data", "/device_0/sensor_1/Color_0/image/data"


STORAGES = {
    "mcap": BagLayout(storage="mcap"),
    "sqlite3": BagLayout(storage="sqlite3"),
    "ros1.bag": BagLayout(storage="ros1"),
    "ros1_bz2.bag": BagLayout(storage="ros1", compression="bz2"),
    "ros1_lz4.bag": BagLayout(storage="ros1", compression="lz4"),
}
PACKED = "/camera/color/image_raw/compressed"
PACKED_DEPTH = "/camera/aligned_depth_to_color/image_raw/compressedDepth"
#: Name of the bag, its layout, step of depth, and whether images are lossless.
BAGS = [
    *((name, layout, STEP, True) for name, layout in STORAGES.items()),
    ("a", BagLayout(colour_encoding="bgr8", depth_encoding="32FC1"), 0, True),
    ("a", BagLayout(colour_encoding="rgba8"), STEP, True),
    ("a", BagLayout(colour_encoding="bgra8"), STEP, True),
    ("a", BagLayout(colour_encoding="png", colour_topic=PACKED, depth_encoding="16UC1 png", depth_topic=PACKED_DEPTH),
     STEP, True),
    ("a", BagLayout(colour_encoding="jpeg", colour_topic=PACKED, depth_encoding="32FC1 png", depth_topic=PACKED_DEPTH),
     4e-3, False),
    *((name, BagLayout(storage, depth_encoding=depth, padding=12, big_endian=big), STEP, True)
      for depth in ("16UC1", "32FC1") for big in (False, True) for name, storage in (("a", "mcap"), ("a.bag", "ros1"))),
]  # fmt: skip


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_chunks_of_mcap_are_decompressed(tmp_path: Path, compression: str) -> None:
    writer = pytest.importorskip("mcap.writer")
    reader = pytest.importorskip("mcap.reader")
    frames = walk(3)
    write_rosbag(tmp_path / "bag", frames)
    (source,) = (tmp_path / "bag").glob("*.mcap")
    kind = writer.CompressionType[compression.upper()]
    with source.open("rb") as old, (tmp_path / "a.mcap").open("wb") as new:
        out = writer.Writer(new, compression=kind, chunk_size=20_000)
        out.start()
        channels: dict[int, int] = {}
        for schema, channel, message in reader.make_reader(old).iter_messages():
            if channel.id not in channels:
                number = out.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = out.register_channel(channel.topic, channel.message_encoding, number)
            out.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        out.finish()
    check_frames(data.open(tmp_path / "a.mcap"), frames, STEP, exact=True)


# ------------------------------------------------------------------------------------------------- two cameras, poses


OWN = Camera(torch.tensor([[55.0, 55.5]]), torch.tensor([[30.5, 22.5]]))
T_COLOUR_FROM_DEPTH = se3.exp(torch.tensor([[0.02, -0.01, 0.03, 0.05, -0.01, 0.02]]).double())
APART = {
    "depth_topic": "/camera/depth/image_rect_raw",
    "depth_frame": "camera_depth_optical_frame",
}


def two_cameras(n: int = 2) -> list[Frame]:
    """Frames whose depth is taken by another camera than the colour."""
    frames = []
    for frame in walk(n):
        T_world_from_depth = se3.compose(frame.T_world_from_cam, T_COLOUR_FROM_DEPTH)
        seen = render(OWN, T_world_from_depth, frame.hw, float(frame.time))
        frames.append(frame.replace(depth=seen.depth, depth_camera=OWN))
    return frames


def matrix(T: Pose) -> np.ndarray:
    return se3.to_matrix(T)[0].numpy()


def assert_registered(recording: data.Recording) -> None:
    assert recording.report == ()
    for got, want in zip(recording, walk(len(recording)), strict=True):
        assert got.depth_camera is None
        camera = cameras.resize(got.camera, got.hw, tuple(got.depth.shape[1:]))
        exact = render(camera, want.T_world_from_cam, tuple(got.depth.shape[1:])).depth
        seen = got.depth > 0
        assert float(seen.float().mean()) > 0.6
        error = ((got.depth - exact).abs() / exact)[seen]
        assert float(error.median()) < 0.01  # of a pixel's shift; 5 cm and 2 degrees unregistered make 5 %


def spare(frames: list[Frame], layout: BagLayout) -> Any:
    """What writes messages of other cameras at the beginning of a bag."""
    return lambda bag: [bag.write_frame(frame, layout) for frame in frames]


def inverted(n: int = 2, deeper: float = 0) -> list[Frame]:
    return [frame.replace(image=255 - frame.image, depth=frame.depth + deeper) for frame in walk(n)]


def side(name: str) -> BagLayout:
    """The topics of one of two cameras."""
    topics = {kind: f"/{name}/{topic}/image_raw" for kind, topic in
              (("colour_topic", "color"), ("depth_topic", "aligned_depth_to_color"))}  # fmt: skip
    return BagLayout(**topics, colour_frame=f"{name}_optical", depth_frame=f"{name}_optical", poses=False)


def holed() -> list[Frame]:
    """A grey frame with values that are no depth."""
    (frame,) = walk(1)
    frame.depth[0, 0, :4] = torch.tensor([float("nan"), float("inf"), -1.0, 0.0])
    return [frame.replace(image=frame.image[:, 1:2].expand(-1, 3, -1, -1))]


def moving_tree(bag: BagWriter) -> None:
    """Poses of the camera in a frame that may move."""
    for f in walk(2):
        bag.write_transform("/tf", float(f.time), "base_link", CAMERA_FRAME, matrix(f.T_world_from_cam))


def bag_case(name: str, frames: Any, layout: BagLayout, expect: Any = None, *, file: str = "a", begin: Any = None,
             written: Any = None, path: str | None = None, **more: Any) -> Case:  # fmt: skip
    """A bag with the frames (``written`` where others than the expected ones) in a layout."""

    def write(root: Path, shots: list[Frame]) -> None:
        write_rosbag(root / file, shots if written is None else written, layout, begin=begin)

    return Case(name, write, frames, (), expect or {}, path=file if path is None else path, **more)


def unit_of(layout: BagLayout) -> tuple[float, str] | None:
    return None if layout.depth_encoding.startswith("32FC1") else (STEP, "REP 118: 16UC1")


PACKED_LAYOUT = BagLayout(colour_topic=PACKED, colour_encoding="png", depth_topic="/spare/depth/image", infos=False,
                          poses=False)  # fmt: skip
TIMES = [100.0, 100.033333, 100.066667]
CASES = [
    *(bag_case(f"{name} {k}", 3, layout, {"format": "rosbag", "report": (), "posed": True, "unit": unit_of(layout),
                                          "times of": TIMES, "same": ([0, 1, 2], step, 1.0, exact)}, file=name)
      for k, (name, layout, step, exact) in enumerate(BAGS)),
    *(bag_case(f"a file of the folder alone, {name}", 3, STORAGES[name], {"same": ([0, 1, 2], STEP, 1.0, True)},
               file=name, path=f"{name}/{name}{part}")
      for name, part in (("mcap", ".mcap"), ("sqlite3", ".db3"))),
    bag_case("grey images and holes", holed, BagLayout(colour_encoding="mono8", depth_encoding="32FC1"),
             {"returns": 48 * 64 - 4}),
    bag_case("a raw topic is preferred", 2, BagLayout("ros1"), {"camera": "/camera/color/image_raw"}, file="a.bag"),
    bag_case("of two colour topics the raw one", 2, BagLayout(), {"same": ([0, 1], STEP, 1.0, True)},
             begin=spare(inverted(), PACKED_LAYOUT)),
    bag_case("a topic by option", 2, BagLayout(), {"same": ([0, 1], STEP)}, options={"color": PACKED},
             written=inverted(), begin=spare(walk(2), PACKED_LAYOUT)),
    *(bag_case(f"option {options}", 2, BagLayout(), options=options, error=message) for options, message in (
        ({"color": "/nothing"}, r"option color: found /nothing, expected one of /camera"),
        ({"depth": "/camera/color/image_raw"}, r"option depth: found /camera/color/image_raw of encoding rgb8"))),
    *(bag_case(f"each camera is a recording, {name}", frames, side("left"),
               {"camera": f"/{name}/color/image_raw", "f": walk(1)[0].camera.f[0].tolist(),
                "median": pytest.approx(float(torch.cat([f.depth for f in frames()]).median()), abs=STEP)},
               written=walk(2), begin=spare(inverted(deeper=1), side("right")), which=place)
      for place, (name, frames) in enumerate((("right", lambda: inverted(deeper=1)), ("left", lambda: walk(2))))),
    bag_case("without a transform depth keeps its camera", two_cameras, BagLayout(**APART),
             {"depth f": OWN.f[0].tolist(), "report": ["the depth is not registered to colour"]}),
    bag_case("images without depth", 5, BagLayout(), {"number": [0, 1, 3, 4], "report": ["^frame 2: no depth of"],
                                                      "same": ([0, 1, 3, 4], STEP, 1.0, True)},
             written=[], begin=lambda bag: [bag.write_frame(frame, BagLayout(depth_lag_s=0.6 if i == 2 else 0.0))
                                            for i, frame in enumerate(walk(5))]),
    bag_case("poses in a frame that may move", 2, BagLayout(poses=False), {
        "report": ("poses are relative to the frame base_link: valid only while that is stationary",),
        "same": ([0, 1], STEP, 1.0, True)}, begin=moving_tree),
    bag_case("no calibration, K by option", 2, BagLayout(infos=False), {"same": ([0, 1], STEP, 1.0, True)},
             options={"K": [61.5, 58.25, 33.5, 21.75]}),
    bag_case("no depth topic", 2, BagLayout(depth_topic="/a/ir/image"),
             error=r"depth topic: found .*/a/ir/image \(16UC1\)"),
    bag_case("no calibration", 2, BagLayout(infos=False),
             error=r"no intrinsics, expected .*data.K=.* CameraInfo of /camera/color/image_raw"),
    bag_case("no images", 1, BagLayout("ros1"), written=[], file="a.bag",
             begin=lambda bag: [bag.write("/joy", "std_msgs/msg/Float32", 100.0, {"data": 1.0}) for _ in range(2)],
             error=r"colour topic: found /joy \(std_msgs/Float32\), expected"),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_variants_are_read_and_faults_named(case: Case, tmp_path: Path) -> None:
    check_case(case, tmp_path)


def test_depth_of_another_camera_is_registered_by_the_fixed_transform(tmp_path: Path) -> None:
    write_rosbag(tmp_path / "bag", two_cameras(), BagLayout(**APART, T_colour_from_depth=matrix(T_COLOUR_FROM_DEPTH)))
    assert_registered(data.open(tmp_path / "bag"))


def test_the_sdk_of_realsense_states_unit_and_extrinsics(tmp_path: Path) -> None:
    metres = 0.00025

    def begin(bag: BagWriter) -> None:
        bag.write("/device_0/sensor_0/option/Depth_Units/value", "std_msgs/msg/Float32", 100.0, {"data": metres})
        for topic, T in ((SDK_DEPTH, np.eye(4)), (SDK_COLOUR, matrix(T_COLOUR_FROM_DEPTH))):
            transform = bag.transform(T)
            fields = {"translation": transform.translation, "rotation": transform.rotation}
            bag.write(topic.replace("image/data", "tf/0"), "geometry_msgs/msg/Transform", 100.0, fields)

    layout = BagLayout(
        storage="ros1", colour_topic=SDK_COLOUR, depth_topic=SDK_DEPTH, depth_encoding="mono16", metres=metres,
        colour_frame="0", depth_frame="0", poses=False,
    )  # fmt: skip
    write_rosbag(tmp_path / "a.bag", two_cameras(), layout, begin=begin)
    recording = data.open(tmp_path / "a.bag")
    assert recording.depth_unit.metres == pytest.approx(metres)
    assert "Depth_Units" in recording.depth_unit.source and recording.report == ()
    assert_registered(recording)
    twice = data.open(tmp_path / "a.bag", depth_unit=2 * metres)
    torch.testing.assert_close(twice[0].depth, 2 * recording[0].depth)


def test_poses_along_a_chain_are_interpolated(tmp_path: Path) -> None:
    frames = walk(3)
    mount = se3.exp(torch.tensor([[0.1, 0.2, -0.3, 1.2, -1.2, 1.2]]).double())
    T_body = [matrix(se3.compose(frame.T_world_from_cam, se3.invert(mount))) for frame in frames]

    stated = [
        ("/tf_static", 100.0, "base_link", CAMERA_FRAME, matrix(mount)),
        *(("/tf", float(frame.time), "odom", "base_link", T) for frame, T in zip(frames, T_body, strict=True)),
    ]
    middle = [frames[0], frames[1].replace(time=(frames[0].time + frames[1].time) / 2)]
    layout = BagLayout(poses=False)
    write_rosbag(tmp_path / "bag", middle, layout, begin=lambda bag: [bag.write_transform(*each) for each in stated])
    recording = data.open(tmp_path / "bag")
    torch.testing.assert_close(recording[0].T_world_from_cam.t, frames[0].T_world_from_cam.t, atol=1e-9, rtol=0)
    between = recording[1].T_world_from_cam
    halves = [se3.relative(between, frames[i].T_world_from_cam) for i in (0, 1)]
    angles = [float(se3.rotation_angle(T.R)) for T in halves]
    assert angles[0] == pytest.approx(angles[1], rel=1e-6) and recording.report == ()
    assert data.open(tmp_path / "bag", poses=False).poses is None


# ------------------------------------------------------------------------------------------------------- intrinsics


def info(model: str, d: Sequence[float], focal: Sequence[float] = (600.0, 600.0), **more: int) -> SimpleNamespace:
    """A CameraInfo of 640 x 480 pixels."""
    fields = dict.fromkeys(("binning_x", "binning_y", "x_offset", "y_offset", "roi_height", "roi_width"), 0) | more
    k = np.array([focal[0], 0, 320, 0, focal[1], 240, 0, 0, 1.0])
    return SimpleNamespace(height=480, width=640, distortion_model=model, d=np.array(d), k=k, **fields)


def test_lens_models() -> None:
    five = (0.1, -0.2, 0.001, 0.002, 0.05)
    assert ros_images.to_opencv_distortion(info("plumb_bob", five), Path("a")) == list(five)
    assert ros_images.to_opencv_distortion(info("equidistant", (0.0,) * 4), Path("a")) is None
    with pytest.raises(FormatError, match="distortion_model: found equidistant"):
        ros_images.to_opencv_distortion(info("equidistant", (0.1, 0.0, 0.0, 0.0)), Path("a"))


def test_terms_of_a_lens_are_those_of_opencv() -> None:
    D = torch.tensor([[0.1, -0.2, 0.03, -0.04, 0.05]], dtype=torch.float64)
    xy = torch.rand(1, 9, 2, generator=torch.manual_seed(0), dtype=torch.float64) - 0.3
    camera = Camera(torch.ones(1, 2).double(), torch.zeros(1, 2).double(), D)
    shift = torch.from_numpy(ros_images._brown_conrady_terms(xy[0].numpy())) @ D[0]
    torch.testing.assert_close(cameras.distort(camera, xy)[0] - xy[0], shift)


def test_an_inverse_lens_model_is_inverted() -> None:
    """Ideal coordinates by the stated polynomial are those that the returned lens maps back to the pixel."""
    D = (-0.05, 0.03, 0.0015, -0.002, -0.01)
    stated = info("Inverse Brown Conrady", D, (600.0, 540.0))
    wanted = ros_images.to_opencv_distortion(stated, Path("a"))
    camera = Camera(torch.tensor([[600.0, 540]]), torch.tensor([[320.0, 240]]), torch.tensor([wanted]))
    uv = torch.tensor([[[0.0, 0], [639, 0], [320, 479], [100, 333]]])
    x, y = ((uv[0] - camera.c) / camera.f).T
    r2 = x * x + y * y
    radial = 1 + D[0] * r2 + D[1] * r2**2 + D[4] * r2**3
    ideal = torch.stack(
        (
            x * radial + 2 * D[2] * x * y + D[3] * (r2 + 2 * x * x),
            y * radial + 2 * D[3] * x * y + D[2] * (r2 + 2 * y * y),
            torch.ones_like(x),
        ),
        -1,
    )
    torch.testing.assert_close(cameras.project(camera, ideal[None]), uv, atol=0.1, rtol=0)


def test_region_of_interest_and_binning() -> None:
    """K of the half-size image of a region: the same ray passes through the same point of the scene."""
    region = info("", (), binning_x=2, binning_y=2, x_offset=100, y_offset=40, roi_height=400, roi_width=500)
    K, hw = crop_camera(region.k.reshape(3, 3), region)
    assert hw == (200, 250)
    # The pixel (120, 60) of the full image is (20, 20) of the region, whose centre is 20.5 / 2 - 0.5 after binning.
    for axis, at in enumerate((120, 60)):
        place = K[axis, axis] * (at - (320, 240)[axis]) / 600 + K[axis, 2]
        assert place == pytest.approx((20 + 0.5) / 2 - 0.5)
    assert crop_camera(region.k.reshape(3, 3), info("", ()))[1] == (480, 640)


def raw(encoding: str, step: int, pixels: np.ndarray) -> SimpleNamespace:
    h, w = pixels.shape[:2]
    return SimpleNamespace(height=h, width=w, encoding=encoding, is_bigendian=0, step=step, data=pixels.reshape(-1))


def test_bayer_and_yuv_pictures() -> None:
    red = np.zeros((4, 4), np.uint8)
    red[::2, ::2] = 200  # rggb: red at even rows and columns
    got = ros_images.decode_colour(raw("bayer_rggb8", 4, red), Path("a"))
    assert got.shape == (3, 4, 4) and int(got[0, 2, 2]) == 200 and int(got[2].max()) == 0
    for encoding in ("uyvy", "yuyv"):
        image = raw(encoding, 8, np.full((2, 4, 2), 128, np.uint8))
        assert int(np.ptp(ros_images.decode_colour(image, Path("a")).astype(int))) <= 2
    for image, named in (
        (raw("rgb9", 4, red), "encoding: found rgb9"),
        (raw("mono8", 3, red), "size, step: found 4x4 pixels in rows of 3 bytes"),
        (raw("mono8", 5, red), "data: found 16 bytes, expected 4 rows of 5 bytes"),
    ):
        with pytest.raises(FormatError, match=named):
            ros_images.decode_colour(image, Path("a"))


# ---------------------------------------------------------------------------------------------- damaged, odd, hostile


@pytest.mark.parametrize("name", STORAGES)
def test_a_truncated_bag_gives_its_whole_messages_or_one_line(tmp_path: Path, name: str) -> None:
    write_rosbag(tmp_path / name, walk(4), STORAGES[name])
    file = tmp_path / name if name.endswith(".bag") else next((tmp_path / name).glob("*.[md][cb]*"))
    whole = file.read_bytes()
    counts = set()
    for share in (0.02, 0.3, 0.7, 0.95):
        file.write_bytes(whole[: int(len(whole) * share)])
        try:
            recording = data.open(tmp_path / name, poses=False)
            counts.add(len(recording))
            _ = [frame.depth for frame in recording]
        except FormatError as error:
            assert "\n" not in str(error)
    if name in ("mcap", "ros1.bag"):
        assert counts & {2, 3, 4}


def test_a_view_in_a_database_is_not_executed(tmp_path: Path) -> None:
    write_rosbag(tmp_path / "bag", walk(2), BagLayout(storage="sqlite3"))
    (file,) = (tmp_path / "bag").glob("*.db3")
    with sqlite3.connect(file) as database:
        database.execute("ALTER TABLE messages RENAME TO stored")
        database.execute("CREATE VIEW messages AS SELECT * FROM stored")
    with pytest.raises(FormatError, match="messages: found view, expected a plain table"):
        data.open(file)


@pytest.mark.parametrize(
    ("size", "compression", "named"),
    [
        (1000, "lz4", "chunk: found 1001 bytes, expected 1000 bytes of lz4 data"),
        (1000, "zstd", "chunk: found 1001 bytes, expected 1000 bytes of zstd data"),
        (1000, "bz2", "chunk: found 1001 bytes, expected 1000 bytes of bz2 data"),
        (1_000_001, "lz4", "chunk: found 1000000 bytes, expected 1000001"),
        (1 << 29, "lz4", "chunk"),
        (-1, "lz4", "chunk size"),
        (10, "snappy", "compression: found snappy"),
    ],
)
def test_a_chunk_that_unpacks_to_more_than_it_says_is_refused(
    tmp_path: Path, size: int, compression: str, named: str
) -> None:
    zeros = b"\0" * 1_000_000
    packers = {
        "lz4": lz4.frame.compress,
        "bz2": bz2.compress,
        "zstd": import_optional("compression.zstd", "backports.zstd").compress,
    }
    packed = packers.get(compression, bytes)(zeros)
    if compression in packers:
        assert bags.decompress_chunk(packed, compression, 1_000_000, tmp_path) == zeros
    with pytest.raises(FormatError, match=named):
        bags.decompress_chunk(packed, compression, size, tmp_path)
