"""Test writer of robots' recordings: MCAP and SQLite of ROS 2, and ROS 1 bags, by the library rosbags."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dhtorch.data.io.decode import import_optional
from dhtorch.export.arrays import (
    K_matrix,
    encode_depth_codes,
    frame_time_s,
    frame_to_hwc,
    pose_matrix,
    rotation_to_xyzw,
)
from dhtorch.records import Camera, Frame
from support.writers.parts import encode_unfiltered_png

#: Stored order of the channels of an encoding; others are written as they are.
_CHANNELS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2, 2), "bgra8": (2, 1, 0, 2), "mono8": (1,)}

_TF_DEFINITION = "geometry_msgs/TransformStamped[] transforms"


@dataclass(frozen=True)
class BagLayout:
    """Topics, encodings and storage of a bag."""

    storage: Literal["mcap", "sqlite3", "ros1"] = "mcap"
    compression: str | None = None  # of the chunks: mcap has none here, ros1 bz2 or lz4
    colour_topic: str = "/camera/color/image_raw"
    depth_topic: str = "/camera/aligned_depth_to_color/image_raw"
    colour_encoding: str = "rgb8"  # or jpeg, png
    depth_encoding: str = "16UC1"  # 32FC1, 16UC1 png, 32FC1 png
    colour_frame: str = "camera_color_optical_frame"
    depth_frame: str = "camera_color_optical_frame"
    padding: int = 0  # bytes behind each row
    big_endian: bool = False
    depth_lag_s: float = 0.0
    metres: float = 0.001  # of a code
    poses: bool = True  # /tf from map
    infos: bool = True
    T_colour_from_depth: np.ndarray | None = None  # in /tf_static
    distortion_model: str = "plumb_bob"


def write_rosbag(
    path: Path,
    frames: Sequence[Frame],
    layout: BagLayout | None = None,
    *,
    begin: "Callable[[BagWriter], None] | None" = None,
) -> None:
    """Write frames as messages; ``path`` is a folder, or a ``.bag`` file for ``ros1``.

    Args:
        path: must not exist.
        frames: depth has the camera ``depth_camera``, or that of the image.
        layout: of the bag.
        begin: writes further messages before the first frame.
    """
    layout = layout or BagLayout()
    is_ros1 = layout.storage == "ros1"
    typesys = import_optional("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if is_ros1 else typesys.Stores.ROS2_HUMBLE)
    if is_ros1:  # not in the library's store
        store.register(typesys.get_types_from_msg(_TF_DEFINITION, "tf2_msgs/msg/TFMessage"))
    with _open_writer(path, layout) as writer:
        bag = BagWriter(writer, store, is_ros1)
        if begin is not None:
            begin(bag)
        if layout.T_colour_from_depth is not None:
            first = frame_time_s(frames[0])
            frame_ids = layout.colour_frame, layout.depth_frame
            bag.write_transform("/tf_static", first, *frame_ids, layout.T_colour_from_depth)
        for frame in frames:
            bag.write_frame(frame, layout)


@dataclass
class BagWriter:
    """An open bag, to which messages are written by their type and fields."""

    writer: Any
    store: Any
    is_ros1: bool

    def __post_init__(self) -> None:
        self.connections: dict[str, Any] = {}

    def make(self, kind: str, **fields: Any) -> Any:
        """A message."""
        return self.store.types[kind](**fields)

    def header(self, time: float, frame: str) -> Any:
        """``std_msgs/Header``."""
        nanoseconds = round(time * 1e9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        number = {"seq": 0} if self.is_ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **number)

    def write(self, topic: str, kind: str, time: float, fields: Mapping[str, Any]) -> None:
        """Write a message."""
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr
        data = serialize(self.make(kind, **fields), kind)
        self.writer.write(self.connections[topic], round(time * 1e9), data)

    def write_frame(self, frame: Frame, layout: BagLayout) -> None:
        """Write picture, depth, calibrations and pose of a frame."""
        time = frame_time_s(frame)
        depth_time = time + layout.depth_lag_s
        colour = _encode_colour(frame_to_hwc(frame), layout)
        _write_picture(self, layout.colour_topic, time, layout.colour_frame, colour, layout)
        _write_picture(self, layout.depth_topic, depth_time, layout.depth_frame, _encode_depth(frame, layout), layout)
        if layout.infos:
            h, w = frame.depth.shape[1:]
            depth_camera = frame.depth_camera or frame.camera
            for topic, at, name, camera, hw in (
                (layout.colour_topic, time, layout.colour_frame, frame.camera, frame.hw),
                (layout.depth_topic, depth_time, layout.depth_frame, depth_camera, (h, w)),
            ):
                _write_info(self, topic, at, frame_id=name, camera=camera, hw=hw, layout=layout)
        if layout.poses:
            self.write_transform("/tf", time, "map", layout.colour_frame, pose_matrix(frame))

    def write_transform(self, topic: str, time: float, parent: str, child: str, T: np.ndarray) -> None:
        """Write a transform of ``/tf`` or ``/tf_static``."""
        stamped = self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(time, parent),
            child_frame_id=child,
            transform=self.transform(T),
        )
        self.write(topic, "tf2_msgs/msg/TFMessage", time, {"transforms": [stamped]})

    def transform(self, T: np.ndarray) -> Any:
        """``geometry_msgs/Transform`` of a matrix (4, 4)."""
        x, y, z, w = (float(v) for v in rotation_to_xyzw(T[:3, :3]))
        return self.make(
            "geometry_msgs/msg/Transform",
            translation=self.make("geometry_msgs/msg/Vector3", x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3])),
            rotation=self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )


def _open_writer(path: Path, layout: BagLayout) -> Any:
    path.parent.mkdir(parents=True, exist_ok=True)
    if layout.storage == "ros1":
        library = import_optional("rosbags.rosbag1")
        writer = library.Writer(path)
        if layout.compression:
            writer.set_compression(library.Writer.CompressionFormat[layout.compression.upper()])
        return writer
    library = import_optional("rosbags.rosbag2")
    return library.Writer(path, version=9, storage_plugin=library.StoragePlugin[layout.storage.upper()])


def _encode_colour(picture: np.ndarray, layout: BagLayout) -> tuple[str, np.ndarray | bytes]:
    encoding = layout.colour_encoding
    if encoding in ("jpeg", "png"):
        cv2 = import_optional("cv2")
        options = [cv2.IMWRITE_JPEG_QUALITY, 95] if encoding == "jpeg" else []
        return f"rgb8; {encoding} compressed bgr8", cv2.imencode(f".{encoding}", picture[..., ::-1], options)[
            1
        ].tobytes()
    return encoding, np.ascontiguousarray(picture[..., list(_CHANNELS[encoding])])


def _encode_depth(frame: Frame, layout: BagLayout) -> tuple[str, np.ndarray | bytes]:
    encoding, _, packing = layout.depth_encoding.partition(" ")
    metric = np.ascontiguousarray(frame.depth[0].numpy(), np.float32)
    codes = encode_depth_codes(frame.depth.nan_to_num(0, 0, 0), 1 / layout.metres)
    if not packing:
        return encoding, metric if encoding == "32FC1" else codes
    head = np.zeros(12, np.uint8).tobytes()
    if encoding == "32FC1":  # code = a / depth + b
        a, b = np.float32(4000.0), np.float32(1.0)
        with np.errstate(divide="ignore"):
            codes = np.where(metric > 0, np.round(a / metric + b), 0).astype(np.uint16)
        head = b"\0\0\0\0" + a.tobytes() + b.tobytes()
    return f"{encoding}; compressedDepth png", head + encode_unfiltered_png(codes)


def _write_picture(
    bag: BagWriter, topic: str, time: float, frame_id: str, picture: tuple[str, np.ndarray | bytes], layout: BagLayout
) -> None:
    encoding, data = picture
    header = bag.header(time, frame_id)
    if isinstance(data, bytes):
        fields = {"header": header, "format": encoding, "data": np.frombuffer(data, np.uint8)}
        bag.write(topic, "sensor_msgs/msg/CompressedImage", time, fields)
        return
    h, w = data.shape[:2]
    rows = data.astype(data.dtype.newbyteorder(">" if layout.big_endian else "<")).reshape(h, -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, layout.padding)), constant_values=77)
    fields = {
        "header": header, "height": h, "width": w, "encoding": encoding, "is_bigendian": int(layout.big_endian),
        "step": rows.shape[1], "data": rows.reshape(-1),
    }  # fmt: skip
    bag.write(topic, "sensor_msgs/msg/Image", time, fields)


def _write_info(
    bag: BagWriter, topic: str, time: float, *, frame_id: str, camera: Camera, hw: tuple[int, int], layout: BagLayout
) -> None:
    parts = topic.split("/")
    if parts[-1] in ("compressed", "compressedDepth"):
        parts.pop()
    name = "/".join(
        [*parts[:-2], "info", "camera_info"] if parts[-2:] == ["image", "data"] else [*parts[:-1], "camera_info"]
    )
    K = K_matrix(camera)
    D = np.zeros(5) if camera.distortion is None else camera.distortion[0].double().numpy()
    P = np.concatenate((K, np.zeros((3, 1))), 1)
    region = bag.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    values = {"d": D, "k": K.reshape(-1), "r": np.eye(3).reshape(-1), "p": P.reshape(-1)}
    if bag.is_ros1:
        values = {key.upper(): value for key, value in values.items()}
    fields = {
        "header": bag.header(time, frame_id), "height": hw[0], "width": hw[1],
        "distortion_model": layout.distortion_model, **values, "binning_x": 0, "binning_y": 0, "roi": region,
    }  # fmt: skip
    bag.write(name, "sensor_msgs/msg/CameraInfo", time, fields)
