"""Robots' recordings: bags of every storage written by the library rosbags and read back; damaged and odd ones."""

from __future__ import annotations

import bz2
import pickle
import sqlite3
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import lz4.frame
import numpy as np
import pytest
import torch
from support.box_scene import disagreement, off_wall, own_camera, render, walk, world_points
from support.writers.rosbag import BagLayout, BagWriter, write_rosbag

from dhtorch import data
from dhtorch.data.codecs import bags, ros_images
from dhtorch.data.io.decode import FormatError, import_optional
from dhtorch.data.readers.rosbag_index import crop_camera
from dhtorch.data.units import DepthUnit
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame, Pose

STEP = 1e-3  # m, of a code of 16UC1
CAMERA_FRAME = BagLayout().colour_frame
SDK_DEPTH, SDK_COLOUR = "/device_0/sensor_0/Depth_0/image/data", "/device_0/sensor_1/Color_0/image/data"


def same_frames(recording: data.Recording, frames: list[Frame], *, image: float = 0, depth: float = STEP / 2) -> None:
    assert len(recording) == len(frames)
    for got, want in zip(recording, frames, strict=True):
        torch.testing.assert_close(got.camera.f, want.camera.f)
        torch.testing.assert_close(got.camera.c, want.camera.c)
        torch.testing.assert_close(got.depth, want.depth, atol=depth + 1e-6, rtol=0)
        torch.testing.assert_close(got.time, want.time, atol=1e-6, rtol=0)
        assert float((got.image.float() - want.image.float()).abs().mean()) <= image
        if recording.poses is not None:
            torch.testing.assert_close(got.T_world_from_cam.R, want.T_world_from_cam.R, atol=1e-9, rtol=0)
            torch.testing.assert_close(got.T_world_from_cam.t, want.T_world_from_cam.t, atol=1e-9, rtol=0)


STORAGES = {
    "mcap": BagLayout(storage="mcap"),
    "sqlite3": BagLayout(storage="sqlite3"),
    "ros1.bag": BagLayout(storage="ros1"),
    "ros1_bz2.bag": BagLayout(storage="ros1", compression="bz2"),
    "ros1_lz4.bag": BagLayout(storage="ros1", compression="lz4"),
}
PACKED = "/camera/color/image_raw/compressed"
PACKED_DEPTH = "/camera/aligned_depth_to_color/image_raw/compressedDepth"
#: Name of the bag, its layout, largest mean error of the images and largest one of depth.
BAGS = [
    *((name, layout, 0, STEP / 2) for name, layout in STORAGES.items()),
    ("a", BagLayout(colour_encoding="bgr8", depth_encoding="32FC1"), 0, 1e-6),
    ("a", BagLayout(colour_encoding="rgba8"), 0, STEP / 2),
    ("a", BagLayout(colour_encoding="bgra8"), 0, STEP / 2),
    ("a", BagLayout(colour_encoding="png", colour_topic=PACKED, depth_encoding="16UC1 png", depth_topic=PACKED_DEPTH), 0, STEP / 2),
    ("a", BagLayout(colour_encoding="jpeg", colour_topic=PACKED, depth_encoding="32FC1 png", depth_topic=PACKED_DEPTH), 3, 2e-3),
    *(
        (name, BagLayout(storage, depth_encoding=depth, padding=12, big_endian=big), 0, STEP / 2)
        for depth in ("16UC1", "32FC1")
        for big in (False, True)
        for name, storage in (("a", "mcap"), ("a.bag", "ros1"))
    ),
]  # fmt: skip


@pytest.mark.parametrize(("name", "layout", "image", "depth"), BAGS)
def test_bags_are_read_back(tmp_path: Path, name: str, layout: BagLayout, image: float, depth: float) -> None:
    frames = walk(3)
    write_rosbag(tmp_path / name, frames, layout)
    (recording,) = data.open_all(tmp_path / name)
    assert recording.format == "rosbag" and recording.poses is not None and recording.report == ()
    is_metric = layout.depth_encoding.startswith("32FC1")
    assert recording.depth_unit == (None if is_metric else DepthUnit(STEP, "REP 118: 16UC1"))
    for part in [] if name.endswith(".bag") else tmp_path.glob(f"{name}/*.[md][cb]*"):
        same_frames(data.open(part), frames, image=image, depth=depth)  # a file of the folder alone
    same_frames(pickle.loads(pickle.dumps(recording)), frames, image=image, depth=depth)
    if depth == STEP / 2:
        assert float(off_wall(world_points(own_camera(recording[1]))).max()) < 2 * STEP
        assert disagreement(own_camera(recording[0]), own_camera(recording[1]))[0] < 0.04


def test_messages_have_the_times_at_which_they_were_recorded(tmp_path: Path) -> None:
    frames = walk(2)
    write_rosbag(tmp_path / "a.bag", frames, BagLayout("ros1"))
    times = {message.time_ns for message in bags.iter_messages(tmp_path / "a.bag")}
    assert {round(1e9 * float(frame.time)) for frame in frames} <= times


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
    same_frames(data.open(tmp_path / "a.mcap"), frames)


def test_grey_images_and_holes(tmp_path: Path) -> None:
    (frame,) = walk(1)
    frame.depth[0, 0, :4] = torch.tensor([float("nan"), float("inf"), -1.0, 0.0])
    write_rosbag(tmp_path / "bag", [frame], BagLayout(colour_encoding="mono8", depth_encoding="32FC1"))
    got = data.open(tmp_path / "bag")[0]
    assert torch.equal(got.image[0, 0], frame.image[0, 1])
    assert got.depth[0, 0, :4].tolist() == [0, 0, 0, 0] and bool((got.depth[0, 1:] > 0).all())


def test_a_raw_topic_is_preferred_and_topics_can_be_set(tmp_path: Path) -> None:
    frames = walk(2)
    other = [frame.replace(image=255 - frame.image) for frame in frames]
    write_rosbag(tmp_path / "a.bag", frames, BagLayout(storage="ros1"))
    assert data.open(tmp_path / "a.bag").camera_name == "/camera/color/image_raw"

    spare = {"depth_topic": "/spare/depth/image", "infos": False, "poses": False}
    layout = BagLayout(colour_topic=PACKED, colour_encoding="png", **spare)
    write_rosbag(tmp_path / "b", frames, begin=lambda bag: [bag.write_frame(frame, layout) for frame in other])
    same_frames(data.open(tmp_path / "b"), frames)
    assert torch.equal(data.open(tmp_path / "b", color=PACKED)[0].image, other[0].image)
    for options, message in (
        ({"color": "/nothing"}, r"option color: found /nothing, expected one of /camera"),
        ({"depth": "/camera/color/image_raw"}, r"option depth: found /camera/color/image_raw of encoding rgb8"),
    ):
        with pytest.raises(FormatError, match=message):
            data.open(tmp_path / "b", **options)


def test_each_camera_is_a_recording(tmp_path: Path) -> None:
    left, right = walk(2), [frame.replace(image=255 - frame.image, depth=frame.depth + 1) for frame in walk(2)]
    layouts = [
        BagLayout(
            colour_topic=f"/{side}/color/image_raw", depth_topic=f"/{side}/aligned_depth_to_color/image_raw",
            colour_frame=f"{side}_optical", depth_frame=f"{side}_optical", poses=False,
        )
        for side in ("left", "right")
    ]  # fmt: skip

    write_rosbag(tmp_path / "bag", left, layouts[0], begin=lambda bag: [bag.write_frame(f, layouts[1]) for f in right])
    recordings = data.open_all(tmp_path / "bag")
    by_camera = {recording.camera_name: recording for recording in recordings}
    assert by_camera.keys() == {"/left/color/image_raw", "/right/color/image_raw"}
    assert len({recording.name for recording in recordings}) == 2
    same_frames(by_camera["/left/color/image_raw"], left)
    same_frames(by_camera["/right/color/image_raw"], right)


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
    for got, want in zip(recording, walk(len(recording)), strict=True):
        assert got.depth_camera is None
        camera = cameras.resize(got.camera, got.hw, tuple(got.depth.shape[1:]))
        exact = render(camera, want.T_world_from_cam, tuple(got.depth.shape[1:])).depth
        seen = got.depth > 0
        assert float(seen.float().mean()) > 0.6
        error = ((got.depth - exact).abs() / exact)[seen]
        assert float(error.median()) < 0.01  # of a pixel's shift; 5 cm and 2 degrees unregistered make 5 %


def test_depth_of_another_camera_is_registered_by_the_fixed_transform(tmp_path: Path) -> None:
    layout = BagLayout(**APART, T_colour_from_depth=matrix(T_COLOUR_FROM_DEPTH))
    write_rosbag(tmp_path / "bag", two_cameras(), layout)
    recording = data.open(tmp_path / "bag")
    assert recording.report == ()
    assert_registered(recording)


def test_without_a_transform_depth_keeps_its_camera_and_it_is_reported(tmp_path: Path) -> None:
    write_rosbag(tmp_path / "bag", two_cameras(), BagLayout(**APART))
    recording = data.open(tmp_path / "bag")
    torch.testing.assert_close(recording[0].depth_camera.f, OWN.f)
    assert any("the depth is not registered to colour" in line for line in recording.report)


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


def test_unpaired_pictures_are_left_out_and_named(tmp_path: Path) -> None:
    frames = walk(5)

    layouts = [BagLayout(depth_lag_s=0.6 if i == 2 else 0.0) for i in range(5)]
    write_rosbag(tmp_path / "bag", [], begin=lambda bag: [*map(bag.write_frame, frames, layouts)])
    recording = data.open(tmp_path / "bag")
    assert recording.number.tolist() == [0, 1, 3, 4]
    assert any(line.startswith("frame 2: no depth of") for line in recording.report)
    same_frames(recording, [frames[i] for i in (0, 1, 3, 4)])


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


def test_poses_in_a_frame_that_may_move_are_named(tmp_path: Path) -> None:
    stated = [("/tf", float(f.time), "base_link", CAMERA_FRAME, matrix(f.T_world_from_cam)) for f in walk(2)]
    layout = BagLayout(poses=False)
    write_rosbag(tmp_path / "bag", walk(2), layout, begin=lambda bag: [bag.write_transform(*each) for each in stated])
    recording = data.open(tmp_path / "bag")
    assert recording.report == ("poses are relative to the frame base_link: valid only while that is stationary",)
    same_frames(recording, walk(2))


# ------------------------------------------------------------------------------------------------------- intrinsics


def test_without_calibration_K_is_an_option(tmp_path: Path) -> None:
    write_rosbag(tmp_path / "bag", walk(2), BagLayout(infos=False))
    same_frames(data.open(tmp_path / "bag", K=[61.5, 58.25, 33.5, 21.75]), walk(2))


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


@pytest.mark.parametrize(
    ("layout", "n", "begin", "message"),
    [
        (BagLayout(depth_topic="/a/ir/image"), 2, None, r"depth topic: found .*/a/ir/image \(16UC1\)"),
        (BagLayout(infos=False), 2, None, r"no intrinsics, expected .*data.K=.* CameraInfo of /camera/color/image_raw"),
        (
            BagLayout("ros1"),
            0,
            lambda bag: [bag.write("/joy", "std_msgs/msg/Float32", 100.0, {"data": 1.0}) for _ in range(2)],
            r"colour topic: found /joy \(std_msgs/Float32\), expected",
        ),
    ],
)
def test_what_a_bag_lacks_is_named(
    tmp_path: Path, layout: BagLayout, n: int, begin: Callable[[BagWriter], object] | None, message: str
) -> None:
    write_rosbag(tmp_path / "a.bag", walk(n or 1)[:n], layout, begin=begin)
    with pytest.raises(FormatError, match=message):
        data.open(tmp_path / "a.bag")


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


def test_nothing_is_written_beside_a_database(tmp_path: Path) -> None:
    write_rosbag(tmp_path / "bag", walk(2), BagLayout(storage="sqlite3"))
    before = {file.name: file.stat().st_mtime_ns for file in (tmp_path / "bag").iterdir()}
    _ = data.open(tmp_path / "bag")[0]
    assert {file.name: file.stat().st_mtime_ns for file in (tmp_path / "bag").iterdir()} == before


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
