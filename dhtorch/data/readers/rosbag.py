"""Reader of robots' recordings: MCAP, ROS 2 bags (``.db3`` or ``.mcap`` in a folder, or alone) and ROS 1 ``.bag``.

Pictures are ``sensor_msgs/Image`` or ``CompressedImage`` (JPEG, PNG, ``compressedDepth``), depth is 16UC1 in mm or
32FC1 in m (REP 118), intrinsics are ``CameraInfo``: K with its distortion, or P for a topic of rectified pictures. Bags
of the RealSense SDK (``/device_0/sensor_0/Depth_0/image/data``) state the depth unit, the extrinsics and the intrinsics
in topics of their own.

For each colour camera the depth is that of its own frame, or called ``aligned_depth_to_color`` or ``depth_registered``
where frames are not named; else the nearest by name. Depth of another camera is registered to the colour by a forward
warp where the transform between the two is fixed in ``/tf_static`` or stated by the SDK; else it keeps its own
intrinsics. Depth and colour are paired by their stamps within half a period. Poses are those of the colour's frame in
the root of its chain of ``/tf``, where something of that chain moves. Pixels are decoded on access.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.clocks import pair_stamps
from dhtorch.data.codecs import ros_images
from dhtorch.data.codecs.bags import BAG_SIGNATURES, MessagePlace, Topic, read_message, read_signature
from dhtorch.data.codecs.ros_messages import parse_message
from dhtorch.data.io import decode as files
from dhtorch.data.readers.rosbag_index import (
    BagIndex,
    ImageStream,
    differ_in_size_alone,
    find_camera,
    index_bag,
    list_bag_files,
)
from dhtorch.data.readers.rosbag_transforms import WORLD_FRAMES
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit
from dhtorch.records import Camera, Frame, Pose

#: Files of the format that are not read: ``metadata.yaml`` repeats what the others hold.
UNUSED_FILES: Final = ("metadata.yaml",)

_REGISTERED: Final = re.compile(r"aligned_depth_to_|depth_registered|depth_to_(rgb|color)|registered")
_NO_COLOUR: Final = re.compile(r"depth|infra|(^|[/_])ir([/_\d]|$)|confidence|disparity|label|mask|seg|debug|overlay")
_COLOUR: Final = re.compile(r"color|colour|rgb")
_SDK_IMAGE: Final = re.compile(r"(/device_\d+/sensor_\d+)/\w+/image/data")


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    if root.is_dir():
        has_metadata = (root / "metadata.yaml").is_file()
        return "metadata.yaml and the files of a ROS 2 bag" if has_metadata and list_bag_files(root) else None
    is_bag = root.suffix.lower() in (".mcap", ".db3", ".bag") and root.is_file()
    return BAG_SIGNATURES.get(read_signature(root)) if is_bag else None


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
    """
    root = Path(root)
    parts = list_bag_files(root) if root.is_dir() else [root]
    files.refuse_if(not parts, root, "files", "none", "one or more .mcap or .db3 files")
    bag = index_bag(root, parts)
    first, *others = _choose_pairs(bag, color, depth)
    recordings = [_open_pair(bag, first, K_options=(intrinsics, K, fov), use_poses=poses)]
    remarks = []
    for pair in others:
        try:
            recordings.append(_open_pair(bag, pair, K_options=(None, None, None), use_poses=poses))
        except files.FormatError as error:
            remarks.append(f"camera {pair.colour.base} left out: {error}")
    if remarks:
        recordings[0] = replace(recordings[0], report=(*recordings[0].report, *remarks))
    if len(recordings) > 1:
        return [replace(each, name=f"{each.name}{each.camera_name}") for each in recordings]
    return recordings


class _Pair(NamedTuple):
    colour: ImageStream
    depth: ImageStream
    registered: bool  # by frame or name


# ----------------------------------------------------------------------------------------------------------- choosing


def _choose_pairs(bag: BagIndex, color: str | None, depth: str | None) -> list[_Pair]:
    """Colour topics with their depth, the best first; one for each colour camera."""
    colours, depths = _candidates(bag, color, "colour"), _candidates(bag, depth, "depth")
    if not colours or not depths:
        missing = "colour" if not colours else "depth"
        raise files.FormatError(
            bag.root, f"{missing} topic", bag.format_topics(), "sensor_msgs/Image or CompressedImage"
        )
    scored = sorted(((_score(a, b), a, b) for a in colours for b in depths), key=lambda entry: entry[0], reverse=True)
    pairs: list[_Pair] = []
    for score, a, b in scored:
        is_new = all(a.base != pair.colour.base and b.base != pair.depth.base for pair in pairs)
        # A further camera has a frame and a place in the names of its own.
        names = [_camera_name(pair.colour) for pair in pairs]
        if not pairs or (is_new and score[:2] == scored[0][0][:2] and _camera_name(a) not in names):
            pairs.append(_Pair(a, b, bool(score[0])))
    return pairs


def _candidates(bag: BagIndex, name: str | None, kind: str) -> list[ImageStream]:
    if name is not None:
        option = f"option {'color' if kind == 'colour' else kind}"
        files.refuse_if(name not in bag.streams, bag.root, option, name, f"one of {bag.format_topics()}")
        stream = bag.streams[name]
        if stream.kind != kind:
            actual = f"{name} of encoding {stream.encoding}"
            raise files.FormatError(bag.root, option, actual, f"pictures of {option.removeprefix('option ')}")
        return [stream]
    streams = [s for s in bag.streams.values() if s.kind == kind]
    return [s for s in streams if kind == "depth" or not _NO_COLOUR.search(s.base.lower())] or streams


def _score(colour: ImageStream, depth: ImageStream) -> tuple[float, ...]:
    """Preference for a pair: registered, near by name, colour, not compressed, many frames."""
    folders = [stream.base.strip("/").split("/")[:-1] for stream in (colour, depth)]
    return (
        float(_is_registered(colour, depth)),
        float(sum(1 for _ in takewhile(lambda parts: parts[0] == parts[1], zip(*folders, strict=False)))),
        float(colour.channels >= 3),
        float(bool(_COLOUR.search(colour.base.lower()))),
        float(not depth.compressed),
        float(not colour.compressed),
        float(min(len(colour.places), len(depth.places))),
    )


def _is_registered(colour: ImageStream, depth: ImageStream) -> bool:
    """Whether the depth is of the colour's frame; where frames are not named, whether its topic is called so."""
    frames = [stream.frame.lstrip("/") for stream in (colour, depth)]
    if all(frames) and _SDK_IMAGE.fullmatch(depth.base) is None:  # the SDK's frames are numbers
        return frames[0] == frames[1]
    return _REGISTERED.search(depth.base.lower()) is not None


def _camera_name(stream: ImageStream) -> str:
    """Frame of a camera, or the folder of its topic where it has no frame."""
    return stream.frame or stream.base.rpartition("/")[0]


# ------------------------------------------------------------------------------------------------------------ opening


def _open_pair(
    bag: BagIndex,
    pair: _Pair,
    *,
    K_options: tuple[intrinsics_options.IntrinsicsOption | None, Sequence[float] | None, float | None],
    use_poses: bool,
) -> Recording:
    colour, depth = pair.colour, pair.depth
    hw, depth_hw = colour.hw, depth.hw
    camera, guess = intrinsics_options.parse_camera(bag.root, hw, *K_options)
    camera, remarks = find_camera(bag, colour) if camera is None else (camera, [])
    if camera is None:
        raise intrinsics_options.missing_intrinsics_error(bag.root, None, f"a CameraInfo of {colour.base}")
    own_camera, depth_remarks = find_camera(bag, depth)
    depth_camera, T, related = _relate(bag, pair, camera, own_camera)
    times = [np.array(stream.stamps_ns, np.int64) for stream in (colour, depth)]
    origin = int(times[0][0])
    pairs = pair_stamps(*((stamps - origin) / 1e9 for stamps in times))
    if not len(pairs):
        problem = f"{len(times[0])} pictures of {colour.topic.name}, {len(times[1])} of {depth.topic.name}, none paired"
        raise files.FormatError(bag.root, "time stamps", problem, "stamps within half a period")
    left_out = sorted(set(range(len(times[0]))) - set(pairs[:, 0].tolist()))
    report = [*guess, *remarks, *depth_remarks, *related]
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
            camera=camera,
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


def _relate(
    bag: BagIndex, pair: _Pair, camera: Camera, own: Camera | None
) -> tuple[Camera | None, Pose | None, list[str]]:
    """(camera of the depth or None where it is the colour's, T_colour_from_depth or None, remarks)."""
    hw, depth_hw = pair.colour.hw, pair.depth.hw
    if own is None:
        if pair.registered or hw == depth_hw:
            remark = f"{pair.depth.topic.name} has no CameraInfo: taken as registered to {pair.colour.topic.name}"
            return None, None, [] if pair.registered else [remark]
        size = f"{depth_hw[1]}x{depth_hw[0]}"
        raise files.FormatError(
            bag.root, pair.depth.topic.name, f"depth of {size} without a CameraInfo", "one beside it"
        )
    T: np.ndarray | None = np.eye(4)
    if not pair.registered:
        T = _find_extrinsics(bag, pair)
    if T is not None and np.allclose(T, np.eye(4), atol=1e-9) and differ_in_size_alone(camera, hw, own, depth_hw):
        return None, None, []
    if T is not None:
        return own, convert.to_poses(T[None], bag.root, "transform of the depth camera"), []
    remark = (
        f"no transform from {pair.depth.topic.name} to {pair.colour.topic.name} in the bag: the depth is not registered"
        " to colour, both cameras are taken to share one centre"
    )
    return own, None, [remark]


def _find_extrinsics(bag: BagIndex, pair: _Pair) -> np.ndarray | None:
    """T_colour_from_depth (4, 4) of the SDK or of the fixed transforms; None where the bag has none."""
    stated: list[dict[str, np.ndarray]] = []
    for stream in (pair.colour, pair.depth):
        prefix = f"{stream.base.removesuffix('/image/data')}/tf/"
        stated.append({n.removeprefix(prefix): T for n, T in bag.sdk_transforms.items() if n.startswith(prefix)})
    for reference in sorted(
        stated[0].keys() & stated[1].keys()
    ):  # transforms map points of the reference to the stream
        return stated[0][reference] @ np.linalg.inv(stated[1][reference])
    if not pair.colour.frame or not pair.depth.frame:
        return None
    return bag.tree.fixed_transform(pair.colour.frame, pair.depth.frame)


def _depth_unit(bag: BagIndex, depth: ImageStream) -> DepthUnit | None:
    if match := _SDK_IMAGE.fullmatch(depth.base):
        for name, metres in bag.sdk_units.items():
            if name.startswith(f"{match[1]}/option/"):
                return DepthUnit(files.to_positive(metres, bag.root, name), name)
    encoding = depth.encoding.partition(";")[0].strip()
    if encoding == "32FC1":
        return None
    # Millimetres. Source: REP 118.
    return DepthUnit(0.001, "REP 118: 16UC1" if encoding == "16UC1" else None)


def _find_poses(
    bag: BagIndex, colour: ImageStream, times_ns: np.ndarray, pairs: np.ndarray, use_poses: bool
) -> tuple[np.ndarray | None, np.ndarray, list[str]]:
    """(camera-to-world of the kept pairs or None, kept pairs, remarks)."""
    if not use_poses or not colour.frame:
        return None, pairs, []
    if not bag.tree.is_whole:
        return None, pairs, [f"{bag.tree.count} transforms are too many to read: no poses"]
    trajectory = bag.tree.poses(colour.frame, times_ns[pairs[:, 0]], bag.root)
    if trajectory is None:
        return None, pairs, []
    c2w, covered, world = trajectory
    # Where less than half of the frames have a pose, the poses are left out instead of the frames.
    if covered.mean() < 0.5:
        remark = f"transforms of {colour.frame} cover {int(covered.sum())} of {len(covered)} frames: no poses"
        return None, pairs, [remark]
    report = files.format_left_out(pairs[~covered, 0].tolist(), f"no transform of {colour.frame} at its time")
    if world not in WORLD_FRAMES:
        report.append(f"poses are relative to the frame {world}: valid only while that is stationary")
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
            # Depth of the colour camera at the density of the depth camera.
            T = self.T_colour_from_depth.to(depth.dtype)
            depth, depth_camera = convert.register_depth(depth, depth_camera, self.camera, self.hw, T), None
        return Frame(torch.from_numpy(image)[None], depth[None], self.camera, depth_camera)

    def _decode(self, place: MessagePlace, k: int, hw: tuple[int, int]) -> np.ndarray:
        topic, data = self.codings[k], read_message(place)
        where = Path(f"{place.file}{topic.name}")
        if self.compressed[k]:
            packed = parse_message(data, "CompressedImage", topic.coding, where)
            if k == 0:
                return files.decode_image(bytes(packed.data), where, hw)
            return ros_images.decode_compressed_depth(bytes(packed.data), packed.format, self.metres, hw, where)
        image = parse_message(data, "Image", topic.coding, where)
        files.refuse_if(
            (image.height, image.width) != hw, where, "size", f"{image.width}x{image.height}", f"{hw[1]}x{hw[0]}"
        )
        return ros_images.decode_depth(image, self.metres, where) if k else ros_images.decode_colour(image, where)
