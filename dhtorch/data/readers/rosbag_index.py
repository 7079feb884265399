"""Index of a robot's recording: the topics of pictures, their stamps and places, calibrations and transforms."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from dhtorch.data import convert
from dhtorch.data.codecs import mcap, ros_images, ros_messages, rosbag1, rosbag_database
from dhtorch.data.codecs.bag_messages import (
    HEAD_BYTES,
    IndexedMessage,
    MessagePlace,
    Topic,
    check_message_count,
)
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers.rosbag_transforms import TransformTree
from dhtorch.runtime.safe_open import MAX_FILE_BYTES, open_regular

_IMAGE_TYPES: Final = {"sensor_msgs/Image": False, "sensor_msgs/CompressedImage": True}  # type → whether compressed
_CODINGS: Final = ("cdr", "ros1")
_TRANSPORTS: Final = ("compressed", "compressedDepth")  # last parts of the names of compressed topics
_NO_DEPTH: Final = re.compile(r"infra|(^|[/_])ir([/_\d]|$)|confidence|disparity|amplitude|label|mask|seg")
_MAX_NAMES_SHOWN: Final = 12  # topics in a message
_MESSAGES_PER_CHECK: Final = 4096  # between two checks of the memory that the index takes

#: First bytes of a file → what it is.
BAG_SIGNATURES: Final = {
    mcap.MCAP_SIGNATURE: "an MCAP file",
    rosbag1.BAG_SIGNATURE: "a ROS 1 bag",
    rosbag_database.SQLITE_SIGNATURE: "a ROS 2 bag in SQLite",
}


class PictureHead(NamedTuple):
    """Properties of a stream of pictures, from its first message."""

    frame: str
    hw: tuple[int, int]
    encoding: str
    is_depth: bool
    channels: int


@dataclass(eq=False)
class PictureStream:
    """Messages of a topic of pictures."""

    topic: Topic
    compressed: bool
    encoding: str = ""
    head: PictureHead | None = None  # None: neither colour nor depth
    stamps_ns: list[int] = field(default_factory=list)
    recorded_ns: list[int] = field(default_factory=list)
    places: list[MessagePlace] = field(default_factory=list)

    @property
    def base(self) -> str:
        """Name of the topic without that of its compression."""
        parent, _, last = self.topic.name.rpartition("/")
        return parent if last in _TRANSPORTS else self.topic.name


@dataclass(eq=False)
class BagIndex:
    """Index of a bag."""

    root: Path
    streams: dict[str, PictureStream] = field(default_factory=dict)
    infos: dict[str, ros_messages.CameraInfo] = field(default_factory=dict)  # by topic, the first of each
    tree: TransformTree = field(default_factory=TransformTree)
    sdk_transforms: dict[str, np.ndarray] = field(default_factory=dict)  # topic → T_stream_from_reference
    sdk_units: dict[str, float] = field(default_factory=dict)  # topic → m
    others: Counter[str] = field(default_factory=Counter)  # topics of other types or codings

    def format_topics(self) -> str:
        """The topics of pictures, or the others where there are none, as text."""
        names = [f"{s.topic.name} ({s.head.encoding if s.head else s.encoding})" for s in self.streams.values()]
        names = names or list(self.others)
        return ", ".join(names[:_MAX_NAMES_SHOWN]) + (" …" if len(names) > _MAX_NAMES_SHOWN else "") or "no topic"


def list_bag_files(root: Path) -> list[Path]:
    """Files of a bag of several parts, in their order."""
    return sorted((file for file in root.iterdir() if file.suffix in (".db3", ".mcap")), key=files.natural_sort_key)


def read_signature(file: Path) -> bytes:
    """First bytes of a file; empty where it cannot be read."""
    try:
        with open_regular(file) as stream:
            return stream.read(16)
    except (FormatError, OSError):
        return b""


def _iter_messages(file: Path) -> Iterator[IndexedMessage]:
    head = read_signature(file)
    if head.startswith(rosbag1.BAG_SIGNATURE):
        return rosbag1.iter_bag_messages(file)
    if head.startswith(rosbag_database.SQLITE_SIGNATURE):
        return rosbag_database.iter_database_messages(file)
    return mcap.iter_mcap_messages(file)


def read_message(place: MessagePlace) -> bytes:
    """All bytes of a message."""
    if place.chunk == rosbag_database.DATABASE_ROW:
        return rosbag_database.read_database_message(place)
    if not 0 <= place.length <= MAX_FILE_BYTES:
        raise FormatError(place.file, "message", f"{place.length} bytes", f"at most {MAX_FILE_BYTES}")
    if place.chunk >= 0:
        is_mcap = read_signature(place.file).startswith(mcap.MCAP_SIGNATURE)
        content = (mcap.read_mcap_chunk if is_mcap else rosbag1.read_bag_chunk)(place.file, place.chunk)
        return content[place.start : place.start + place.length]
    with open_regular(place.file) as stream:
        stream.seek(place.start)
        return stream.read(place.length)


def index_bag(root: Path, parts: Sequence[Path]) -> BagIndex:
    """Index of the messages of all files of a bag; pixels are not decoded.

    Raises:
        FormatError: a damaged file, or more messages than the memory limit allows.
        ImportError: the decoder of the bag's chunks is not installed.
    """
    bag = BagIndex(root)
    count = 0
    for file in parts:
        for message in _iter_messages(file):
            count += 1
            if count % _MESSAGES_PER_CHECK == 0:
                check_message_count(file, count)
            _add_message(bag, message)
    for stream in bag.streams.values():
        _set_stamps(stream)
    return bag


def _add_message(bag: BagIndex, message: IndexedMessage) -> None:
    topic = message.topic
    kind = topic.type if topic.coding in _CODINGS else ""
    if kind in _IMAGE_TYPES:
        _add_picture(bag, message)
    elif kind == "sensor_msgs/CameraInfo":
        if topic.name not in bag.infos:
            bag.infos[topic.name] = ros_messages.parse_camera_info(*_whole(message))
    elif kind in ("tf2_msgs/TFMessage", "tf/tfMessage"):
        bag.tree.add(ros_messages.parse_transforms(*_whole(message)))
    elif kind == "nav_msgs/Odometry":
        bag.tree.add([ros_messages.parse_odometry(*_whole(message))])
    elif kind == "geometry_msgs/Transform" and "/tf/" in topic.name:
        t, q = ros_messages.parse_plain_transform(*_whole(message))
        matrix = convert.to_c2w(np.array([q]), np.array([t]), message.place.file, topic.name)[0]
        bag.sdk_transforms.setdefault(topic.name, matrix)
    elif kind == "std_msgs/Float32" and re.search(r"/option/Depth[ _]Units/value$", topic.name):
        bag.sdk_units.setdefault(topic.name, ros_messages.parse_float(*_whole(message)))
    else:
        bag.others[f"{topic.name} ({topic.type or topic.coding})"] += 1


def _whole(message: IndexedMessage) -> tuple[bytes, str, Path]:
    """Arguments of a parser."""
    data = message.head if message.place.length <= HEAD_BYTES else read_message(message.place)
    return data, message.topic.coding, message.place.file


def _add_picture(bag: BagIndex, message: IndexedMessage) -> None:
    topic, file = message.topic, message.place.file
    stream = bag.streams.get(topic.name)
    if stream is None:
        stream = bag.streams[topic.name] = PictureStream(topic, _IMAGE_TYPES[topic.type])
        stream.head = _describe_stream(stream, message)
    stream.stamps_ns.append(ros_messages.parse_header(message.head, topic.coding, file).stamp_ns)
    stream.recorded_ns.append(message.time_ns)
    stream.places.append(message.place)


def _describe_stream(stream: PictureStream, message: IndexedMessage) -> PictureHead | None:
    """Kind of the pictures of a topic, from its first message; None for neither colour nor depth."""
    topic, file = stream.topic, message.place.file
    head = ros_messages.parse_image_head(message.head, topic.coding, file, compressed=stream.compressed)
    name = stream.base.lower()
    stream.encoding = head.encoding
    encoding = head.encoding.partition(";")[0].strip()
    if stream.compressed:
        is_depth = ros_images.is_compressed_depth(head.encoding, topic.name)
    else:
        is_depth = encoding in ros_images.DEPTH_ENCODINGS and (encoding != "mono16" or "depth" in name)
    if is_depth:
        if _NO_DEPTH.search(name):
            return None
    elif not stream.compressed and encoding not in ros_images.COLOUR_CHANNELS:
        return None
    hw = head.hw
    channels = ros_images.COLOUR_CHANNELS.get(encoding, 3)
    if hw is None:
        _, data = ros_messages.parse_compressed_image(read_message(message.place), topic.coding, file)
        picture = ros_images.strip_depth_header(bytes(data), is_depth)
        try:
            header = files.decode_image_header(picture, Path(f"{file}{topic.name}"))
        except FormatError:  # a video's packet, RVL
            return None
        hw, channels = header.hw, header.channels
    return PictureHead(head.header.frame, hw, head.encoding, is_depth, channels)


def _set_stamps(stream: PictureStream) -> None:
    """Messages in the order of their stamps; stamps that were never set are replaced by the times of recording."""
    stamps = np.array(stream.stamps_ns, np.int64)
    if not stamps.any():
        stamps = np.array(stream.recorded_ns, np.int64)
    order = np.argsort(stamps, kind="stable")
    stream.stamps_ns = stamps[order].tolist()
    stream.places = [stream.places[i] for i in order]
