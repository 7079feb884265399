"""Index of a robot's recording: the topics of images, their stamps and places, calibrations, cameras and transforms."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data.codecs import ros_images
from dhtorch.data.codecs.bags import HEAD_BYTES, IndexedMessage, MessagePlace, Topic, iter_messages, read_message
from dhtorch.data.codecs.ros_messages import parse_message, stamp_ns
from dhtorch.data.io import decode as files
from dhtorch.data.readers.rosbag_transforms import Transform, TransformTree
from dhtorch.geometry import camera as cameras
from dhtorch.records import Camera
from dhtorch.runtime.safe_open import check_memory

_IMAGE_TYPES: Final = {"sensor_msgs/Image": False, "sensor_msgs/CompressedImage": True}  # type → whether compressed
_NO_DEPTH: Final = re.compile(r"infra|(^|[/_])ir([/_\d]|$)|confidence|disparity|amplitude|label|mask|seg")
_MAX_NAMES_SHOWN: Final = 12  # topics in a message


@dataclass(eq=False)
class ImageStream:
    """Messages of a topic of images, and what its first message says of them."""

    topic: Topic
    compressed: bool
    frame: str
    encoding: str
    kind: Literal["colour", "depth", ""] = ""  # neither of the two
    hw: tuple[int, int] = (0, 0)
    channels: int = 3
    stamps_ns: list[int] = field(default_factory=list)
    recorded_ns: list[int] = field(default_factory=list)
    places: list[MessagePlace] = field(default_factory=list)

    @property
    def base(self) -> str:
        """Name of the topic without that of its compression."""
        parent, _, last = self.topic.name.rpartition("/")
        return parent if last in ("compressed", "compressedDepth") else self.topic.name


@dataclass(eq=False)
class BagIndex:
    """Index of a bag."""

    root: Path
    streams: dict[str, ImageStream] = field(default_factory=dict)
    infos: dict[str, Any] = field(default_factory=dict)  # CameraInfo by topic, the first of each
    tree: TransformTree = field(default_factory=TransformTree)
    sdk_transforms: dict[str, np.ndarray] = field(default_factory=dict)  # topic → T_stream_from_reference
    sdk_units: dict[str, float] = field(default_factory=dict)  # topic → m
    others: Counter[str] = field(default_factory=Counter)  # topics of other types or codings

    def format_topics(self) -> str:
        """The topics of images, or the others where there are none, as text."""
        names = [f"{s.topic.name} ({s.encoding})" for s in self.streams.values()] or list(self.others)
        return ", ".join(names[:_MAX_NAMES_SHOWN]) + (" …" if len(names) > _MAX_NAMES_SHOWN else "") or "no topic"


def list_bag_files(root: Path) -> list[Path]:
    """Files of a bag of several parts, in their order."""
    return sorted((file for file in root.iterdir() if file.suffix in (".db3", ".mcap")), key=files.natural_sort_key)


def index_bag(root: Path, parts: Sequence[Path]) -> BagIndex:
    """Index of the messages of all files of a bag; pixels are not decoded.

    Raises:
        FormatError: a damaged file, or more messages than the memory limit allows.
    """
    bag = BagIndex(root)
    count = 0
    for file in parts:
        for message in iter_messages(file):
            count += 1
            if count % 4096 == 0:
                # Memory of a reference and its stamp.
                check_memory(file, "messages", 300 * count, f"{count} messages")
            _add_message(bag, message)
    for stream in bag.streams.values():  # in the order of the stamps; those never set are the times of recording
        stamps = np.array(stream.stamps_ns if any(stream.stamps_ns) else stream.recorded_ns, np.int64)
        order = np.argsort(stamps, kind="stable")
        stream.stamps_ns = stamps[order].tolist()
        stream.places = [stream.places[i] for i in order]
    return bag


def _add_message(bag: BagIndex, message: IndexedMessage) -> None:
    topic, place = message.topic, message.place
    kind = topic.type if topic.coding in ("cdr", "ros1") else ""
    name = kind.rpartition("/")[2]

    def parse() -> Any:
        data = message.head if place.length <= HEAD_BYTES else read_message(place)
        return parse_message(data, name, topic.coding, place.file)

    if kind in _IMAGE_TYPES:
        definition = "CompressedHead" if _IMAGE_TYPES[kind] else "ImageHead"
        head = parse_message(message.head, definition, topic.coding, place.file)
        if topic.name not in bag.streams:
            bag.streams[topic.name] = _describe_stream(message, head, compressed=_IMAGE_TYPES[kind])
        stream = bag.streams[topic.name]
        stream.stamps_ns.append(stamp_ns(head.header))
        stream.recorded_ns.append(message.time_ns)
        stream.places.append(place)
    elif kind == "sensor_msgs/CameraInfo":
        if topic.name not in bag.infos:
            bag.infos[topic.name] = parse()
    elif kind in ("tf2_msgs/TFMessage", "tf/tfMessage", "nav_msgs/Odometry"):
        name = name.replace("tfM", "TFM")
        for each in [parse()] if name == "Odometry" else parse().transforms:
            pose = each.translation.tolist(), each.rotation.tolist()
            bag.tree.add([Transform(stamp_ns(each.header), each.header.frame_id, each.child_frame_id, *pose)])
    elif kind == "geometry_msgs/Transform" and "/tf/" in topic.name:
        T = parse()
        matrix = convert.to_c2w(T.rotation[None], T.translation[None], place.file, topic.name)[0]
        bag.sdk_transforms.setdefault(topic.name, matrix)
    elif kind == "std_msgs/Float32" and re.search(r"/option/Depth[ _]Units/value$", topic.name):
        bag.sdk_units.setdefault(topic.name, float(parse().data))
    else:
        bag.others[f"{topic.name} ({topic.type or topic.coding})"] += 1


def _describe_stream(message: IndexedMessage, head: Any, *, compressed: bool) -> ImageStream:
    """The stream of a topic, from its first message."""
    topic, file = message.topic, message.place.file
    full = head.format if compressed else head.encoding
    encoding = full.partition(";")[0].strip()
    stream = ImageStream(topic, compressed, head.header.frame_id, full)
    name = stream.base.lower()
    if compressed:
        is_depth = (
            "compressedDepth" in full or topic.name.endswith("/compressedDepth") or encoding in ("16UC1", "32FC1")
        )
    else:
        is_depth = encoding in ros_images.DEPTH_ENCODINGS and (encoding != "mono16" or "depth" in name)
    is_colour = not is_depth and (compressed or encoding in ros_images.COLOUR_CHANNELS)
    if not is_colour and (not is_depth or _NO_DEPTH.search(name)):
        return stream
    stream.channels = ros_images.COLOUR_CHANNELS.get(encoding, 3)
    if compressed:
        whole = parse_message(read_message(message.place), "CompressedImage", topic.coding, file)
        image = ros_images.strip_depth_header(bytes(whole.data), is_depth)
        try:
            header = files.decode_image_header(image, Path(f"{file}{topic.name}"))
        except files.FormatError:  # a video's packet, RVL
            return stream
        stream.hw, stream.channels = header.hw, header.channels
    else:
        stream.hw = head.height, head.width
    stream.kind = "depth" if is_depth else "colour"
    return stream


# ------------------------------------------------------------------------------------------------------------ cameras


def find_camera(bag: BagIndex, stream: ImageStream) -> tuple[Camera | None, list[str]]:
    """(camera of a topic, remarks) from the CameraInfo beside it, else from the only one of its frame; None without."""
    parent = stream.base.rpartition("/")[0]
    names = [f"{parent}/camera_info", f"{stream.base}/camera_info", f"{parent.rpartition('/')[0]}/info/camera_info"]
    name = next((name for name in names if name in bag.infos), None)
    if name is None:
        frame = stream.frame
        of_frame = [n for n, info in bag.infos.items() if frame and info.header.frame_id == frame and info.k[0] > 0]
        name = of_frame[0] if len(of_frame) == 1 else None
    if name is None or not bag.infos[name].k[0] > 0:  # 0 = not calibrated
        return None, []
    info, where = bag.infos[name], Path(f"{bag.root}{name}")
    is_rectified = "rect" in stream.base.rpartition("/")[2] and info.p[0] > 0
    D = None if is_rectified else ros_images.to_opencv_distortion(info, where)
    K, hw = crop_camera(info.p.reshape(3, 4)[:, :3] if is_rectified else info.k.reshape(3, 3), info)
    remarks = []
    if hw != stream.hw:
        h, w = stream.hw
        if abs(w * hw[0] - h * hw[1]) > max(h, w):  # more than a pixel off the calibration's aspect
            raise files.FormatError(where, "width, height", f"{hw[1]}x{hw[0]}", f"{w}x{h} as {stream.topic.name}")
        K = convert.resize_K(K, hw, stream.hw)
        remarks.append(f"{stream.topic.name}: K of {hw[1]}x{hw[0]} pixels is scaled to {w}x{h}")
    return convert.to_camera(K, stream.hw, where, "P" if is_rectified else "K", D), remarks


def crop_camera(K: np.ndarray, info: Any) -> tuple[np.ndarray, tuple[int, int]]:
    """K and size of the region of interest of a CameraInfo after binning."""
    h, w = info.roi_height or info.height, info.roi_width or info.width
    K = K - np.array([[0, 0, info.x_offset], [0, 0, info.y_offset], [0, 0, 0]])
    bx, by = max(1, info.binning_x), max(1, info.binning_y)
    if (bx, by) == (1, 1):
        return K, (h, w)
    return convert.resize_K(K, (h, w), (h // by, w // bx)), (h // by, w // bx)


def differ_in_size_alone(camera: Camera, hw: tuple[int, int], own: Camera, depth_hw: tuple[int, int]) -> bool:
    """Whether two cameras differ in the size of their images alone."""
    scaled = cameras.resize(camera, hw, depth_hw)
    is_close = torch.allclose(scaled.f, own.f, rtol=1e-3) and torch.allclose(scaled.c, own.c, rtol=0, atol=0.51)
    if camera.distortion is None or own.distortion is None:
        return is_close  # a driver that registers depth may state no distortion of it
    is_alike = camera.distortion.shape == own.distortion.shape and torch.allclose(camera.distortion, own.distortion)
    return is_close and is_alike
