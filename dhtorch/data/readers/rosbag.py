"""Reader of robots' recordings: MCAP, ROS 2 bags (``.db3`` or ``.mcap`` in a folder, or alone) and ROS 1 ``.bag``.

Pictures are ``sensor_msgs/Image`` or ``CompressedImage`` (JPEG, PNG, ``compressedDepth``), depth is 16UC1 in mm or
32FC1 in m (REP 118), intrinsics are ``CameraInfo``: K with its distortion, or P for a topic of rectified pictures. Bags
of the RealSense SDK (``/device_0/sensor_0/Depth_0/image/data``) state the depth unit, the extrinsics and the intrinsics
in topics of their own.

For each colour camera the depth is that registered to it (``aligned_depth_to_color``, ``depth_registered``, or of the
same frame), else the nearest by name. Depth of another camera is registered to the colour by a forward warp where the
transform between the two is fixed in ``/tf_static`` or stated by the SDK; else it keeps its own intrinsics. Depth and
colour are paired by their stamps within half a period. Poses are those of the colour's frame in the root of its chain
of ``/tf``, where something of that chain moves. Pixels are decoded on access.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dhtorch.data import convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.clocks import pair_stamps
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
from dhtorch.data.io.safe_open import open_regular
from dhtorch.data.readers.rosbag_transforms import WORLD_FRAMES, TransformTree
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit
from dhtorch.geometry import camera as cameras
from dhtorch.records import Camera, Frame, Pose

#: Files of the format that are not read: ``metadata.yaml`` repeats what the others hold.
UNUSED_FILES: Final = ("metadata.yaml",)

_IMAGE_TYPES: Final = {"sensor_msgs/Image": False, "sensor_msgs/CompressedImage": True}  # type → whether compressed
_CODINGS: Final = ("cdr", "ros1")
_SUFFIXES: Final = (".mcap", ".db3", ".bag")
_TRANSPORTS: Final = ("compressed", "compressedDepth")  # last parts of the names of compressed topics

_REGISTERED: Final = re.compile(r"aligned_depth_to_|depth_registered|depth_to_(rgb|color)|registered")
_NO_DEPTH: Final = re.compile(r"infra|(^|[/_])ir([/_\d]|$)|confidence|disparity|amplitude|label|mask|seg")
_NO_COLOUR: Final = re.compile(r"depth|infra|(^|[/_])ir([/_\d]|$)|confidence|disparity|label|mask|seg|debug|overlay")
_COLOUR: Final = re.compile(r"color|colour|rgb")
_SDK_IMAGE: Final = re.compile(r"(/device_\d+/sensor_\d+)/\w+/image/data")
_MAX_NAMES_SHOWN: Final = 12  # topics in a message

_MILLIMETRE: Final = 0.001  # m of a code of 16UC1. Source: REP 118
_MIN_POSED_SHARE: Final = 0.5  # of the frames, below which the poses are left out instead of the frames


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    if root.is_dir():
        has_metadata = (root / "metadata.yaml").is_file()
        return "metadata.yaml and the files of a ROS 2 bag" if has_metadata and _list_parts(root) else None
    if root.suffix.lower() not in _SUFFIXES or not root.is_file():
        return None
    return next((what for signature, what in _SIGNATURES.items() if _read_head(root).startswith(signature)), None)


def read(
    root: str | Path,
    *,
    color: str | None = None,
    depth: str | None = None,
    intrinsics: intrinsics_options.IntrinsicsOption | None = None,
    K: Sequence[float] | None = None,
    fov: float | None = None,
    poses: bool = True,
) -> list[Recording]:
    """Open one bag.

    Args:
        root: the folder of a ROS 2 bag, or a ``.mcap``, ``.db3`` or ``.bag`` file.
        color, depth: topics of the pictures and of their depth. None = chosen by their encodings and names.
        intrinsics, K, fov: of the pictures where the bag has no ``CameraInfo`` of them, or instead of it; see
            :mod:`dhtorch.data.intrinsics`.
        poses: use the transforms of ``/tf`` and ``nav_msgs/Odometry``.

    Returns:
        One recording for each colour camera with depth.

    Raises:
        FormatError: no pictures with depth, no K, an unknown topic or encoding, or a damaged file.
        ImportError: the decoder of the bag's chunks is not installed.
    """
    root = Path(root)
    parts = _list_parts(root) if root.is_dir() else [root]
    if not parts:
        raise FormatError(root, "files", "none", "one or more .mcap or .db3 files")
    bag = _index(root, parts)
    first, *others = _choose_pairs(bag, color, depth)
    recordings = [_open_pair(bag, first, K_options=(intrinsics, K, fov), use_poses=poses)]
    remarks = []
    for pair in others:
        try:
            recordings.append(_open_pair(bag, pair, K_options=(None, None, None), use_poses=poses))
        except FormatError as error:
            remarks.append(f"camera {pair.colour.base} left out: {error}")
    if remarks:
        recordings[0] = replace(recordings[0], report=(*recordings[0].report, *remarks))
    if len(recordings) > 1:
        return [replace(each, name=f"{each.name}{each.camera_name}") for each in recordings]
    return recordings


class _Head(NamedTuple):
    """Properties of a stream of pictures, from its first message."""

    frame: str
    hw: tuple[int, int]
    encoding: str
    is_depth: bool
    channels: int


@dataclass(eq=False)
class _Stream:
    """Messages of a topic of pictures."""

    topic: Topic
    compressed: bool
    head: _Head | None = None  # None: neither colour nor depth
    stamps_ns: list[int] = field(default_factory=list)
    recorded_ns: list[int] = field(default_factory=list)
    places: list[MessagePlace] = field(default_factory=list)

    @property
    def base(self) -> str:
        """Name of the topic without that of its compression."""
        parent, _, last = self.topic.name.rpartition("/")
        return parent if last in _TRANSPORTS else self.topic.name


@dataclass(eq=False)
class _Bag:
    """Index of a bag."""

    root: Path
    streams: dict[str, _Stream] = field(default_factory=dict)
    infos: dict[str, ros_messages.CameraInfo] = field(default_factory=dict)  # by topic, the first of each
    tree: TransformTree = field(default_factory=TransformTree)
    sdk_transforms: dict[str, np.ndarray] = field(default_factory=dict)  # topic → T_stream_from_reference
    sdk_units: dict[str, float] = field(default_factory=dict)  # topic → m
    others: Counter[str] = field(default_factory=Counter)  # topics of other types or codings


class _Pair(NamedTuple):
    colour: _Stream
    depth: _Stream
    registered: bool  # by name or frame


# ------------------------------------------------------------------------------------------------------------- index


_SIGNATURES: Final = {
    mcap.MCAP_SIGNATURE: "an MCAP file",
    rosbag1.BAG_SIGNATURE: "a ROS 1 bag",
    rosbag_database.SQLITE_SIGNATURE: "a ROS 2 bag in SQLite",
}


def _list_parts(root: Path) -> list[Path]:
    """Files of a bag of several parts, in their order."""
    return sorted((file for file in root.iterdir() if file.suffix in (".db3", ".mcap")), key=files.natural_sort_key)


def _read_head(file: Path) -> bytes:
    try:
        with open_regular(file) as stream:
            return stream.read(16)
    except (FormatError, OSError):
        return b""


def _iter_messages(file: Path) -> Iterator[IndexedMessage]:
    head = _read_head(file)
    if head.startswith(rosbag1.BAG_SIGNATURE):
        return rosbag1.iter_bag_messages(file)
    if head.startswith(rosbag_database.SQLITE_SIGNATURE):
        return rosbag_database.iter_database_messages(file)
    return mcap.iter_mcap_messages(file)


def _read_message(place: MessagePlace) -> bytes:
    """All bytes of a message."""
    if place.chunk == rosbag_database.DATABASE_ROW:
        return rosbag_database.read_database_message(place)
    if not 0 <= place.length <= files.MAX_FILE_BYTES:
        raise FormatError(place.file, "message", f"{place.length} bytes", f"at most {files.MAX_FILE_BYTES}")
    if place.chunk >= 0:
        is_mcap = _read_head(place.file).startswith(mcap.MCAP_SIGNATURE)
        content = (mcap.read_mcap_chunk if is_mcap else rosbag1.read_bag_chunk)(place.file, place.chunk)
        return content[place.start : place.start + place.length]
    with open_regular(place.file) as stream:
        stream.seek(place.start)
        return stream.read(place.length)


def _index(root: Path, parts: Sequence[Path]) -> _Bag:
    bag = _Bag(root)
    count = 0
    for file in parts:
        for message in _iter_messages(file):
            count += 1
            if count % 4096 == 0:
                check_message_count(file, count)
            _add_message(bag, message)
    for stream in bag.streams.values():
        _set_stamps(stream)
    return bag


def _add_message(bag: _Bag, message: IndexedMessage) -> None:
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
    data = message.head if message.place.length <= HEAD_BYTES else _read_message(message.place)
    return data, message.topic.coding, message.place.file


def _add_picture(bag: _Bag, message: IndexedMessage) -> None:
    topic, file = message.topic, message.place.file
    stream = bag.streams.get(topic.name)
    if stream is None:
        stream = bag.streams[topic.name] = _Stream(topic, _IMAGE_TYPES[topic.type])
        stream.head = _describe_stream(stream, message)
    stream.stamps_ns.append(ros_messages.parse_header(message.head, topic.coding, file).stamp_ns)
    stream.recorded_ns.append(message.time_ns)
    stream.places.append(message.place)


def _describe_stream(stream: _Stream, message: IndexedMessage) -> _Head | None:
    """Kind of the pictures of a topic, from its first message; None for neither colour nor depth."""
    topic, file = stream.topic, message.place.file
    head = ros_messages.parse_image_head(message.head, topic.coding, file, compressed=stream.compressed)
    name = stream.base.lower()
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
        _, data = ros_messages.parse_compressed_image(_read_message(message.place), topic.coding, file)
        where = Path(f"{file}{topic.name}")
        header = files.decode_image_header(ros_images.strip_depth_header(bytes(data), is_depth), where)
        hw, channels = header.hw, header.channels
    return _Head(head.header.frame, hw, head.encoding, is_depth, channels)


def _set_stamps(stream: _Stream) -> None:
    """Messages in the order of their stamps; stamps that were never set are replaced by the times of recording."""
    stamps = np.array(stream.stamps_ns, np.int64)
    if not stamps.any():
        stamps = np.array(stream.recorded_ns, np.int64)
    order = np.argsort(stamps, kind="stable")
    stream.stamps_ns = stamps[order].tolist()
    stream.places = [stream.places[i] for i in order]


# ----------------------------------------------------------------------------------------------------------- choosing


def _choose_pairs(bag: _Bag, color: str | None, depth: str | None) -> list[_Pair]:
    """Colour topics with their depth, the best first; one for each colour camera."""
    colours = _candidates(bag, color, is_depth=False)
    depths = _candidates(bag, depth, is_depth=True)
    if not colours or not depths:
        missing = "colour" if not colours else "depth"
        raise FormatError(bag.root, f"{missing} topic", _format_topics(bag), "sensor_msgs/Image or CompressedImage")
    scored = sorted(
        ((_score(bag, a, b), a, b) for a in colours for b in depths), key=lambda entry: entry[0], reverse=True
    )
    pairs: list[_Pair] = []
    for score, a, b in scored:
        is_new = all(a.base != pair.colour.base and b.base != pair.depth.base for pair in pairs)
        # A further camera has a frame and a place in the names of its own.
        if not pairs or (is_new and score[:2] == scored[0][0][:2] and _camera_name(a) not in map(_camera_of, pairs)):
            pairs.append(_Pair(a, b, bool(score[0])))
    return pairs


def _candidates(bag: _Bag, name: str | None, *, is_depth: bool) -> list[_Stream]:
    if name is not None:
        option = "depth" if is_depth else "color"
        if name not in bag.streams:
            raise FormatError(bag.root, f"option {option}", name, f"one of {_format_topics(bag)}")
        stream = bag.streams[name]
        if stream.head is None or stream.head.is_depth != is_depth:
            encoding = "unknown" if stream.head is None else stream.head.encoding
            raise FormatError(bag.root, f"option {option}", f"{name} of encoding {encoding}", f"pictures of {option}")
        return [stream]
    found = [s for s in bag.streams.values() if s.head is not None and s.head.is_depth == is_depth]
    if is_depth:
        return found
    return [s for s in found if not _NO_COLOUR.search(s.base.lower())] or found


def _score(bag: _Bag, colour: _Stream, depth: _Stream) -> tuple[float, ...]:
    """Preference for a pair: registered, near by name, colour, not compressed, many frames."""
    assert colour.head is not None
    names = [stream.base.strip("/").split("/") for stream in (colour, depth)]
    shared = 0
    for a, b in zip(*(parts[:-1] for parts in names), strict=False):
        if a != b:
            break
        shared += 1
    return (
        float(_is_registered(colour, depth)),
        float(shared),
        float(colour.head.channels >= 3),
        float(bool(_COLOUR.search(colour.base.lower()))),
        float(not depth.compressed),
        float(not colour.compressed),
        float(min(len(colour.places), len(depth.places))),
    )


def _is_registered(colour: _Stream, depth: _Stream) -> bool:
    """Whether the depth's name or frame is that of depth registered to the colour."""
    assert colour.head is not None and depth.head is not None
    if _REGISTERED.search(depth.base.lower()):
        return True
    frames = [stream.head.frame.lstrip("/") for stream in (colour, depth) if stream.head is not None]
    is_sdk = _SDK_IMAGE.fullmatch(depth.base) is not None
    return not is_sdk and frames[0] == frames[1] and bool(frames[0]) and not frames[0].isdigit()


def _camera_name(stream: _Stream) -> str:
    """Frame of a camera, or the folder of its topic where it has no frame."""
    frame = stream.head.frame if stream.head is not None else ""
    return frame or stream.base.rpartition("/")[0]


def _camera_of(pair: _Pair) -> str:
    return _camera_name(pair.colour)


def _format_topics(bag: _Bag) -> str:
    names = [f"{s.topic.name} ({s.head.encoding if s.head else 'unused'})" for s in bag.streams.values()]
    names = names or list(bag.others)
    return ", ".join(names[:_MAX_NAMES_SHOWN]) + (" …" if len(names) > _MAX_NAMES_SHOWN else "") or "no topic"


# ------------------------------------------------------------------------------------------------------------ opening


class _Eye(NamedTuple):
    """Camera of a topic."""

    camera: Camera
    report: tuple[str, ...] = ()


def _open_pair(
    bag: _Bag,
    pair: _Pair,
    *,
    K_options: tuple[intrinsics_options.IntrinsicsOption | None, Sequence[float] | None, float | None],
    use_poses: bool,
) -> Recording:
    colour, depth = pair.colour, pair.depth
    assert colour.head is not None and depth.head is not None
    hw, depth_hw = colour.head.hw, depth.head.hw
    option = intrinsics_options.parse_intrinsics(bag.root, hw, *K_options)
    if option.feature is not None:
        raise FormatError(bag.root, "option intrinsics", option.feature, "four numbers fx, fy, cx, cy")
    if option.K is not None:
        eye: _Eye | None = _Eye(convert.to_camera(convert.make_K(*option.K), hw, bag.root, "option K"))
    else:
        eye = _find_camera(bag, colour)
    if eye is None:
        raise intrinsics_options.missing_intrinsics_error(bag.root, None, f"a CameraInfo of {colour.base}")
    depth_eye = _find_camera(bag, depth)
    depth_camera, T, remarks = _relate(bag, pair, eye.camera, depth_eye)
    times = [np.array(stream.stamps_ns, np.int64) for stream in (colour, depth)]
    origin = int(times[0][0])
    pairs = pair_stamps(*((stamps - origin) / 1e9 for stamps in times))
    if not len(pairs):
        problem = f"{len(times[0])} pictures of {colour.topic.name}, {len(times[1])} of {depth.topic.name}, none paired"
        raise FormatError(bag.root, "time stamps", problem, "stamps within half a period")
    left_out = sorted(set(range(len(times[0]))) - set(pairs[:, 0].tolist()))
    report = [*option.report, *eye.report, *(depth_eye.report if depth_eye is not None else ()), *remarks]
    report += files.format_left_out(left_out, f"no depth of {depth.topic.name} within half a period")
    c2w, pairs, pose_remarks = _find_poses(bag, colour, times[0], pairs, use_poses)
    unit = _depth_unit(bag, depth)
    name = bag.root.resolve().name if bag.root.is_dir() else bag.root.stem
    return Recording(
        name=name,
        format="rosbag",
        load=_Load(
            pictures=tuple(colour.places[i] for i in pairs[:, 0]),
            depths=tuple(depth.places[j] for j in pairs[:, 1]),
            codings=(colour.topic, depth.topic),
            compressed=(colour.compressed, depth.compressed),
            hw=hw,
            depth_hw=depth_hw,
            camera=eye.camera,
            depth_camera=depth_camera,
            T_colour_from_depth=T,
            metres=1.0 if unit is None else unit.metres,
        ),
        number=torch.from_numpy(pairs[:, 0].copy()),
        root=bag.root,
        times=torch.from_numpy(times[0][pairs[:, 0]] / 1e9),
        poses=None if c2w is None else convert.to_poses(c2w, bag.root, "transforms"),
        rate_hz=None,
        camera_name=colour.base,
        report=tuple(dict.fromkeys([*report, *pose_remarks])),
        depth_unit=unit,
    )


def _find_camera(bag: _Bag, stream: _Stream) -> _Eye | None:
    """Camera of a topic from the CameraInfo beside it, else from the only one of its frame; None without any."""
    assert stream.head is not None
    parent = stream.base.rpartition("/")[0]
    names = [f"{parent}/camera_info", f"{stream.base}/camera_info", f"{parent.rpartition('/')[0]}/info/camera_info"]
    name = next((name for name in names if name in bag.infos), None)
    if name is None:
        frame = stream.head.frame
        of_frame = [n for n, info in bag.infos.items() if frame and info.header.frame == frame and info.K[0, 0] > 0]
        name = of_frame[0] if len(of_frame) == 1 else None
    if name is None or not bag.infos[name].K[0, 0] > 0:  # 0 = not calibrated
        return None
    info, where = bag.infos[name], Path(f"{bag.root}{name}")
    is_rectified = "rect" in stream.base.rpartition("/")[2] and info.P[0, 0] > 0
    K, D = (info.P[:, :3], None) if is_rectified else (info.K, ros_images.to_opencv_distortion(info, where))
    K, hw = _crop(K, info)
    report: tuple[str, ...] = ()
    if hw != stream.head.hw:
        h, w = stream.head.hw
        if abs(w * hw[0] - h * hw[1]) > max(h, w):  # more than a pixel off the calibration's aspect
            raise FormatError(where, "width, height", f"{hw[1]}x{hw[0]}", f"{w}x{h} as {stream.topic.name}")
        K = convert.resize_K(K, hw, stream.head.hw)
        report = (f"{stream.topic.name}: K of {hw[1]}x{hw[0]} pixels is scaled to {w}x{h}",)
    return _Eye(convert.to_camera(K, stream.head.hw, where, "P" if is_rectified else "K", D), report)


def _crop(K: np.ndarray, info: ros_messages.CameraInfo) -> tuple[np.ndarray, tuple[int, int]]:
    """K and size of the region of interest after binning."""
    h, w = (roi or whole for roi, whole in zip(info.roi_hw, info.hw, strict=True))
    K = K.copy()
    K[:2, 2] -= info.offset
    bx, by = (max(1, n) for n in info.binning)
    if (bx, by) == (1, 1):
        return K, (h, w)
    return convert.resize_K(K, (h, w), (h // by, w // bx)), (h // by, w // bx)


def _relate(
    bag: _Bag, pair: _Pair, camera: Camera, depth_eye: _Eye | None
) -> tuple[Camera | None, Pose | None, list[str]]:
    """(camera of the depth or None where it is the colour's, T_colour_from_depth or None, remarks)."""
    assert pair.colour.head is not None and pair.depth.head is not None
    hw, depth_hw = pair.colour.head.hw, pair.depth.head.hw
    if depth_eye is None:
        if pair.registered or hw == depth_hw:
            remark = f"{pair.depth.topic.name} has no CameraInfo: taken as registered to {pair.colour.topic.name}"
            return None, None, [] if pair.registered else [remark]
        size = f"{depth_hw[1]}x{depth_hw[0]}"
        raise FormatError(bag.root, pair.depth.topic.name, f"depth of {size} without a CameraInfo", "one beside it")
    own = depth_eye.camera
    T: np.ndarray | None = np.eye(4)
    if not pair.registered:
        T = _find_extrinsics(bag, pair)
    if T is not None and np.allclose(T, np.eye(4), atol=1e-9) and _same_lens(camera, hw, own, depth_hw):
        return None, None, []
    if T is not None:
        return own, convert.to_poses(T[None], bag.root, "transform of the depth camera"), []
    remark = (
        f"no transform from {pair.depth.topic.name} to {pair.colour.topic.name} in the bag: the depth is not registered"
        " to colour, both cameras are taken to share one centre"
    )
    return own, None, [remark]


def _same_lens(camera: Camera, hw: tuple[int, int], own: Camera, depth_hw: tuple[int, int]) -> bool:
    """Whether two cameras differ in the size of their images alone."""
    scaled = cameras.resize(camera, hw, depth_hw)
    is_close = torch.allclose(scaled.f, own.f, rtol=1e-3) and torch.allclose(scaled.c, own.c, rtol=0, atol=0.51)
    if camera.distortion is None or own.distortion is None:
        return is_close  # a driver that registers depth may state no distortion of it
    is_alike = camera.distortion.shape == own.distortion.shape and torch.allclose(camera.distortion, own.distortion)
    return is_close and is_alike


def _find_extrinsics(bag: _Bag, pair: _Pair) -> np.ndarray | None:
    """T_colour_from_depth (4, 4) of the SDK or of the fixed transforms; None where the bag has none."""
    found: list[dict[str, np.ndarray]] = []
    for stream in (pair.colour, pair.depth):
        prefix = f"{stream.base.removesuffix('/image/data')}/tf/"
        found.append({n.removeprefix(prefix): T for n, T in bag.sdk_transforms.items() if n.startswith(prefix)})
    for reference in found[0].keys() & found[1].keys():  # transforms map points of the reference to the stream
        return found[0][reference] @ np.linalg.inv(found[1][reference])
    assert pair.colour.head is not None and pair.depth.head is not None
    if not pair.colour.head.frame or not pair.depth.head.frame:
        return None
    return bag.tree.fixed_transform(pair.colour.head.frame, pair.depth.head.frame)


def _depth_unit(bag: _Bag, depth: _Stream) -> DepthUnit | None:
    assert depth.head is not None
    if match := _SDK_IMAGE.fullmatch(depth.base):
        for name, metres in bag.sdk_units.items():
            if name.startswith(f"{match[1]}/option/"):
                return DepthUnit(files.to_positive(metres, bag.root, name), name)
    encoding = depth.head.encoding.partition(";")[0].strip()
    if encoding == "32FC1":
        return None
    return DepthUnit(_MILLIMETRE, "REP 118: 16UC1" if encoding == "16UC1" else None)


def _find_poses(
    bag: _Bag, colour: _Stream, times_ns: np.ndarray, pairs: np.ndarray, use_poses: bool
) -> tuple[np.ndarray | None, np.ndarray, list[str]]:
    """(camera-to-world of the kept pairs or None, kept pairs, remarks)."""
    assert colour.head is not None
    if not use_poses or not colour.head.frame:
        return None, pairs, []
    if not bag.tree.is_whole:
        return None, pairs, [f"{bag.tree.count} transforms are too many to read: no poses"]
    found = bag.tree.poses(colour.head.frame, times_ns[pairs[:, 0]], bag.root)
    if found is None:
        return None, pairs, []
    c2w, covered, world = found
    if covered.mean() < _MIN_POSED_SHARE:
        remark = f"transforms of {colour.head.frame} cover {int(covered.sum())} of {len(covered)} frames: no poses"
        return None, pairs, [remark]
    report = files.format_left_out(pairs[~covered, 0].tolist(), f"no transform of {colour.head.frame} at its time")
    if world not in WORLD_FRAMES:
        report.append(f"poses are relative to the frame {world}: right only while that stands still")
    return c2w[covered], pairs[covered], report


@dataclass(frozen=True, eq=False)
class _Load:
    """Position → frame."""

    pictures: tuple[MessagePlace, ...]
    depths: tuple[MessagePlace, ...]
    codings: tuple[Topic, Topic]
    compressed: tuple[bool, bool]
    hw: tuple[int, int]
    depth_hw: tuple[int, int]
    camera: Camera
    depth_camera: Camera | None  # None = the colour's
    T_colour_from_depth: Pose | None  # None = not known, or the identity
    metres: float  # of a code of depth

    def __call__(self, i: int) -> Frame:
        image = self._decode(self.pictures[i], 0, self.hw)
        depth = torch.from_numpy(self._decode(self.depths[i], 1, self.depth_hw))
        depth_camera = self.depth_camera
        if depth_camera is not None and self.T_colour_from_depth is not None:
            depth, depth_camera = self._register(depth, depth_camera, self.T_colour_from_depth), None
        return Frame(torch.from_numpy(image)[None], depth[None], self.camera, depth_camera)

    def _decode(self, place: MessagePlace, k: int, hw: tuple[int, int]) -> np.ndarray:
        topic, data = self.codings[k], _read_message(place)
        where = Path(f"{place.file}{topic.name}")
        if self.compressed[k]:
            encoding, content = ros_messages.parse_compressed_image(data, topic.coding, where)
            if k == 0:
                return files.decode_image(bytes(content), where, hw)
            return ros_images.decode_compressed_depth(bytes(content), encoding, self.metres, hw, where)
        image = ros_messages.parse_image(data, topic.coding, where)
        if image.hw != hw:
            raise FormatError(where, "size", f"{image.hw[1]}x{image.hw[0]}", f"{hw[1]}x{hw[0]}")
        return ros_images.decode_depth(image, self.metres, where) if k else ros_images.decode_colour(image, where)

    def _register(self, depth: Tensor, depth_camera: Camera, T: Pose) -> Tensor:
        """Depth of the colour camera at the density of the depth camera."""
        size = convert.size_of_registered_depth(depth_camera, self.camera, self.hw)
        return convert.register_depth(
            depth, depth_camera, cameras.resize(self.camera, self.hw, size), size, T.to(depth.dtype)
        )
