"""Reader of RLDS data sets in TFRecord files (TFDS), without TensorFlow; one recording per episode and camera.

``features.json`` names the features and ``dataset_info.json`` the set. A record is an episode; each feature holds the
values of all steps in order: ``steps/observation/image_0`` one encoded image a step, ``steps/action`` for example seven
numbers a step. Opening a set reads only the lengths of its records; reading a frame reads only that frame's images.

The format has no place for intrinsics, poses, time stamps and the unit of depth: they come from options, or from
features where a set has them; without them 16-bit depth images are in mm and arrays in m, an assumption. Stationary
cameras give no depth (NO_BASELINE).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dhtorch.data import convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.codecs import tfrecord
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.recording import Recording, Recordings, consecutive_frame_numbers
from dhtorch.data.stored_sizes import StoredSizes
from dhtorch.data.units import DepthUnit
from dhtorch.records import Camera, Frame, Pose

_MAX_EPISODE_STEPS = 100_000  # steps of an episode

_SHARD_PATTERN = re.compile(r"^(?P<set>.+)-(?P<split>[^-]+)\.tfrecord-(?P<shard>\d{5})-of-(?P<of>\d{5})$")
#: Convention of the unit of depth by the kind of its feature: 16-bit images in mm, arrays of floats in m.
_ASSUMED_DEPTH_UNITS = {"image": DepthUnit(1e-3), "tensor": DepthUnit(1.0)}
_STEPS_FEATURE = "steps"


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    if not root.is_dir() or not (root / "features.json").is_file():
        return None
    shard = next((file for file in root.iterdir() if _SHARD_PATTERN.match(file.name)), None)
    return None if shard is None else f"features.json and {shard.name}"


def read(
    root: str | Path,
    *,
    split: str | None = None,
    episode: int | Sequence[int] | None = None,
    camera: str | Sequence[str] | None = None,
    depth: str | None = None,
    K: Sequence[float] | None = None,
    fov: float | None = None,
    K_depth: Sequence[float] | None = None,
    distortion: Sequence[float] | None = None,
    intrinsics: intrinsics_options.IntrinsicsOption | None = None,
    pose: str | None = None,
    rate_hz: float | None = None,
) -> Recordings:
    """Open a folder with ``features.json`` and the TFRecord files beside it.

    Args:
        root: the folder, as a rule named after the set's version.
        split: such as ``train``. None = all.
        episode: number or numbers of the episodes, counted through the files of a split. None = all.
        camera: feature or features of colour images, such as ``observation/image_0``. None = all.
        depth: feature with depth: 16-bit images, or an array. None = the camera's name with ``depth`` in place of
            ``image`` or ``rgb``; where there is none, depth is empty and the report notes it.
        K: fx, fy, cx, cy of the image. None = from ``intrinsics``.
        fov: horizontal field of view of the image in degrees, for a guessed K where none is available.
        K_depth: as ``K``, of a depth map that is not registered to colour.
        distortion: of the image, in OpenCV's order.
        intrinsics: feature with 4 (fx fy cx cy) or 9 numbers a step; or four numbers as ``K``, or one as ``fov``.
            None = ``<camera>_intrinsics`` where there is one.
        pose: feature with the camera-to-world pose of every step: 16 numbers (4×4 by rows) or 7 (x y z qx qy qz qw).
            None = ``<camera>_T_world_from_cam`` where there is one, else no poses.
        rate_hz: steps per second; without it there are no times.

    Returns:
        Recordings named ``<set>/<split>_<number>/<camera>``; an episode is read on access.

    Raises:
        FormatError: an unknown split, feature or episode, or damaged metadata; on access to an episode also no K, a
            damaged record, or values that are no camera or pose.
    """
    root = Path(root)
    rate = None if rate_hz is None else files.to_positive(rate_hz, root, "option rate_hz")
    features = _read_step_features(root)
    keys = _select_colour(root, features, camera)
    rigs = []
    for key in keys:
        hw = _picture_size(root, features, key)
        stated = intrinsics_options.parse_intrinsics(root, hw, intrinsics, K, fov)
        rig = _CameraSpec(
            root=root,
            features=features,
            image=key,
            hw=hw,
            depth=_find_depth_feature(root, features, key, depth),
            stated=stated,
            K_depth=K_depth,
            distortion=distortion,
            intrinsics=_find_companion(root, features, key, stated.feature, "intrinsics"),
            pose=_find_companion(root, features, key, pose, "pose", "T_world_from_cam"),
            rate_hz=rate,
        )
        rigs.append(rig)
    episodes = _locate_episodes(root, split, episode)
    names = [
        f"{_read_set_name(root)}/{e.split}_{e.number:06d}/{rig.image.rpartition('/')[2]}"
        for e in episodes
        for rig in rigs
    ]
    return Recordings(names, _MakeRecording(tuple(names), tuple(episodes), tuple(rigs)))


@dataclass(frozen=True)
class StepFeature:
    """Type and shape of one feature of a step, from ``features.json``."""

    kind: str  # "image", "text", or "tensor"
    dtype: str
    shape: tuple[int, ...]  # of one step; -1 = not stated
    encoded: bool = False  # an array stored as one string of encoded bytes


def _read_step_features(root: Path) -> dict[str, StepFeature]:
    """``features.json`` → name → feature of the steps, such as ``observation/image_0``.

    Raises:
        FormatError: no such file, or no steps in it.
    """
    file = root / "features.json"
    tree = files.read_json(file)
    nodes = files.get_entry(tree, f"featuresDict.features.{_STEPS_FEATURE}.sequence.feature", dict, file)
    features: dict[str, StepFeature] = {}
    _flatten(nodes, "", features, file, 0)
    return features


def _flatten(node: Any, name: str, features: dict[str, StepFeature], file: Path, depth: int) -> None:
    """Add the features below ``node`` of the feature tree to ``features``, names joined by ``/``."""
    if not isinstance(node, dict) or depth > 32:
        raise FormatError(file, name or _STEPS_FEATURE, type(node).__name__, "a feature")
    if isinstance(inner := node.get("featuresDict"), dict):
        for key, value in files.get_entry(inner, "features", dict, file).items():
            _flatten(value, f"{name}/{key}" if name else key, features, file, depth + 1)
        return
    if isinstance(image := node.get("image"), dict):
        features[name] = StepFeature("image", str(image.get("dtype", "uint8")), _parse_shape(image, file, name))
    elif isinstance(tensor := node.get("tensor"), dict):
        encoded = tensor.get("encoding", "none") not in ("none", "")
        features[name] = StepFeature("tensor", str(tensor.get("dtype", "")), _parse_shape(tensor, file, name), encoded)
    elif "text" in node:
        features[name] = StepFeature("text", "string", ())


def _parse_shape(node: dict[str, Any], file: Path, name: str) -> tuple[int, ...]:
    shape = node.get("shape")
    sizes = shape.get("dimensions", []) if isinstance(shape, dict) else []
    try:
        dimensions = tuple(int(size) for size in sizes)
    except (TypeError, ValueError):
        raise FormatError(file, f"{name} shape", sizes, "whole numbers") from None
    if len(dimensions) > 8 or any(not -1 <= size <= files.MAX_PIXELS for size in dimensions):
        raise FormatError(file, f"{name} shape", dimensions, "sizes of an array")
    return dimensions


def _read_set_name(root: Path) -> str:
    """The name in ``dataset_info.json``, else the name of the folder above."""
    file = root / "dataset_info.json"
    name = files.read_json(file).get("name") if file.is_file() else None
    return name if isinstance(name, str) and name else root.resolve().parent.name


def _select_colour(root: Path, features: dict[str, StepFeature], camera: str | Sequence[str] | None) -> list[str]:
    colour_features = [
        name for name, f in features.items() if f.kind == "image" and f.dtype == "uint8" and f.shape[-1:] != (1,)
    ]
    colour_features = sorted(
        (name for name in colour_features if "depth" not in name), key=lambda name: files.natural_sort_key(Path(name))
    )
    names = colour_features if camera is None else [camera] if isinstance(camera, str) else list(camera)
    not_colour = [name for name in names if name not in colour_features]
    if not_colour or not names:
        expected = f"one of {', '.join(colour_features)}" if colour_features else "a feature with colour images"
        raise FormatError(root, "option camera", ", ".join(not_colour) or "no camera", expected)
    return names


def _picture_size(root: Path, features: dict[str, StepFeature], key: str) -> tuple[int, int]:
    """(h, w) of a feature's images: from its stated shape, else from the header of the first image."""
    shape = features[key].shape
    if len(shape) >= 2 and min(shape[:2]) > 0:
        return shape[0], shape[1]
    place = _locate_episodes(root, None, None)[0]
    body = tfrecord.read_record(place.file, place.span)
    pictures = tfrecord.parse_example(body, place.file, place.span.offset).get(f"{_STEPS_FEATURE}/{key}")
    if pictures is None or pictures.kind != "bytes" or not pictures.spans:
        raise FormatError(place.file, key, "no images", "encoded images")
    return files.decode_image_header(tfrecord.read_span(place.file, pictures.spans[0]), place.file).hw


def _find_depth_feature(root: Path, features: dict[str, StepFeature], image: str, option: str | None) -> str | None:
    if option is not None:
        return _check_feature(root, features, option, "depth")
    names = (re.sub(word, "depth", image) for word in ("image", "rgb"))
    return next((name for name in names if name != image and name in features), None)


def _find_companion(
    root: Path, features: dict[str, StepFeature], image: str, feature: str | None, option: str, suffix: str = ""
) -> str | None:
    """The feature named by the option, else ``<camera>_<suffix or option>`` where there is one."""
    name = f"{image}_{suffix or option}"
    return (
        _check_feature(root, features, feature, option) if feature is not None else name if name in features else None
    )


def _check_feature(root: Path, features: dict[str, StepFeature], name: str | None, option: str) -> str | None:
    if name is not None and name not in features:
        raise FormatError(root, f"option {option}", name, f"one of {', '.join(features)}")
    return name


@dataclass(frozen=True)
class RecordLocation:
    """The record of an episode: its file and span of bytes."""

    split: str
    number: int  # in its split
    place: int  # number among all episodes of the opened splits
    file: Path
    span: tfrecord.ByteSpan


def _locate_episodes(root: Path, split: str | None, numbers: int | Sequence[int] | None) -> list[RecordLocation]:
    shards: dict[str, list[Path]] = {}
    for file in sorted(root.iterdir(), key=files.natural_sort_key):
        if match := _SHARD_PATTERN.match(file.name):
            shards.setdefault(match["split"], []).append(file)
    if split is not None and split not in shards:
        raise FormatError(root, "option split", split, f"one of {', '.join(sorted(shards))}")
    selected = None if numbers is None else {numbers} if isinstance(numbers, int) else {int(each) for each in numbers}
    locations: list[RecordLocation] = []
    n_before = 0
    for name in sorted(shards) if split is None else [split]:
        places = [(file, span) for file in shards[name] for span in tfrecord.index_records(file)]
        if selected is not None and (missing := selected - set(range(len(places)))):
            raise FormatError(root, "option episode", min(missing), f"0 to {len(places) - 1} in {name}")
        locations += [
            RecordLocation(name, i, n_before + i, *at)
            for i, at in enumerate(places)
            if selected is None or i in selected
        ]
        n_before += len(places)
    if not locations:
        raise FormatError(root, "records", "none", "TFRecord files named <set>-<split>.tfrecord-<shard>-of-<shards>")
    return locations


@dataclass(frozen=True, eq=False)
class _MakeRecording:
    """Position → recording: the cameras of the first episode, then those of the second, …"""

    names: tuple[str, ...]
    episodes: tuple[RecordLocation, ...]
    rigs: tuple[_CameraSpec, ...]

    def __call__(self, i: int) -> Recording:
        episode, rig = self.episodes[i // len(self.rigs)], self.rigs[i % len(self.rigs)]
        body = tfrecord.read_record(episode.file, episode.span)
        example = tfrecord.parse_example(body, episode.file, episode.span.offset)
        return rig.recording(self.names[i], episode, example)


@dataclass(frozen=True, eq=False)
class LoadStep:
    """Position → frame."""

    file: Path
    images: tuple[tfrecord.ByteSpan, ...]
    hw: tuple[int, int]
    depths: tuple[tfrecord.ByteSpan, ...]  # of encoded images or of arrays' numbers, one a step
    depth: StepFeature | None
    cameras: Camera  # (n), or (1) for all
    depth_camera: Camera | None
    place: RecordLocation
    features: dict[str, StepFeature]  # of a step

    def __call__(self, i: int) -> Frame:
        """Frame ``i``."""
        image = files.decode_image(tfrecord.read_span(self.file, self.images[i]), self.file, self.hw)
        camera = self.cameras[i : i + 1] if self.cameras.f.shape[0] > 1 else self.cameras
        depth = torch.zeros(self.hw) if self.depth is None else self._depth(i, self.depth)
        return Frame(torch.from_numpy(image)[None], depth[None], camera, self.depth_camera)

    def _depth(self, i: int, feature: StepFeature) -> Tensor:
        data = tfrecord.read_span(self.file, self.depths[i])
        if feature.kind == "image":
            units_per_metre = 1 / _ASSUMED_DEPTH_UNITS["image"].metres
            return torch.from_numpy(files.decode_depth_png(data, self.file, units_per_metre))
        depth = np.frombuffer(data, "<f4").astype(np.float64).reshape(feature.shape[:2])
        keep = np.isfinite(depth) & (depth > 0) & (depth < 1e6)
        return torch.from_numpy(np.where(keep, depth, 0).astype(np.float32))


@dataclass(frozen=True, eq=False, kw_only=True)
class _CameraSpec:
    """One camera of the set with its features and options."""

    root: Path
    features: dict[str, StepFeature]
    image: str
    hw: tuple[int, int]
    depth: str | None
    stated: intrinsics_options.ParsedIntrinsics
    K_depth: Sequence[float] | None
    distortion: Sequence[float] | None
    intrinsics: str | None
    pose: str | None
    rate_hz: float | None

    def recording(self, name: str, episode: RecordLocation, example: dict[str, tfrecord.ExampleFeature]) -> Recording:
        """The recording of this camera in an episode, from the episode's parsed record."""
        file = episode.file
        images = self._pictures(file, example, self.image)
        n = len(images)
        if not 0 < n <= _MAX_EPISODE_STEPS:
            raise FormatError(file, self.image, f"{n} steps", f"1 to {_MAX_EPISODE_STEPS}")
        depths = () if self.depth is None else self._depths(file, example, self.depth, n)
        cameras, depth_camera = self._cameras(file, example, n)
        load = LoadStep(
            file=file,
            images=images,
            hw=self.hw,
            depths=depths,
            depth=None if self.depth is None else self.features[self.depth],
            cameras=cameras,
            depth_camera=depth_camera,
            place=episode,
            features=self.features,
        )
        return Recording(
            name=name,
            format="rlds",
            load=load,
            number=consecutive_frame_numbers(n),
            root=self.root,
            times=None if self.rate_hz is None else consecutive_frame_numbers(n).double() / self.rate_hz,
            poses=None if self.pose is None else self._poses(file, example, self.pose, n),
            rate_hz=self.rate_hz,
            report=self.stated.report + (() if self.depth else (f"{self.image}: no depth feature: depth is empty",)),
            episode=episode.place,
            camera_name=self.image,
            depth_unit=_ASSUMED_DEPTH_UNITS.get(self.features[self.depth].kind) if self.depth else None,
            stored=StoredSizes(self.hw, self._registered_depth_hw()),
        )

    def _registered_depth_hw(self) -> tuple[int, int] | None:
        """Size of depth over the picture's field, if the features state it; None for depth with its own K."""
        h, w = (*(self.features[self.depth].shape if self.depth else ()), -1, -1)[:2]
        return None if self.K_depth is not None or min(h, w) < 1 else (h, w)

    def _pictures(
        self, file: Path, example: dict[str, tfrecord.ExampleFeature], key: str
    ) -> tuple[tfrecord.ByteSpan, ...]:
        feature = example.get(f"{_STEPS_FEATURE}/{key}")
        if feature is None or feature.kind != "bytes":
            raise FormatError(file, key, "nothing" if feature is None else "numbers", "encoded images")
        return feature.spans

    def _depths(
        self, file: Path, example: dict[str, tfrecord.ExampleFeature], key: str, n: int
    ) -> tuple[tfrecord.ByteSpan, ...]:
        """Span of bytes of each step's depth (n)."""
        described = self.features[key]
        if described.kind == "image":
            spans = self._pictures(file, example, key)
            if len(spans) != n:
                raise FormatError(file, key, f"{len(spans)} images", f"{n}, as many as {self.image}")
            return spans
        shape, feature = described.shape, example.get(f"{_STEPS_FEATURE}/{key}")
        h, w = (*shape, 0, 0)[:2]
        single = len(shape) == 2 or (len(shape) == 3 and shape[2] == 1)
        if described.dtype != "float32" or described.encoded or not single or min(h, w) < 1:
            stored = f"{described.dtype} {shape}"
            raise FormatError(self.root / "features.json", key, stored, "16-bit images, or float32 (h, w)")
        size = 4 * h * w
        whole = feature is not None and feature.kind == "float" and len(feature.spans) == 1
        if feature is None or not whole or feature.spans[0].length != n * size:
            raise FormatError(file, key, "other numbers", f"{n} arrays of {h}x{w} floats")
        return tuple(tfrecord.ByteSpan(feature.spans[0].offset + i * size, size) for i in range(n))

    def _numbers(
        self, file: Path, example: dict[str, tfrecord.ExampleFeature], key: str, sizes: tuple[int, ...], n: int
    ):
        """Values (n, size) float64 of a feature, one row a step; ``size`` must be one of ``sizes``."""
        described = self.features[key]
        size = int(np.prod(described.shape)) if described.shape and min(described.shape) > 0 else 0
        feature = example.get(f"{_STEPS_FEATURE}/{key}")
        if feature is None or size not in sizes:
            expected = " or ".join(map(str, sizes))
            raise FormatError(file, key, f"{size} numbers a step" if feature else "nothing", f"{expected} numbers")
        values = tfrecord.read_feature_numbers(file, key, feature, n * size)
        if len(values) != n * size:
            raise FormatError(file, key, f"{len(values)} numbers", f"{size} for each of {n} steps")
        return values.reshape(n, size).astype(np.float64)

    def _cameras(self, file: Path, example: dict[str, tfrecord.ExampleFeature], n: int) -> tuple[Camera, Camera | None]:
        of_depth = None
        if self.depth is not None and self.K_depth is not None:
            shape = self.features[self.depth].shape
            hw = (shape[0], shape[1]) if len(shape) >= 2 and min(shape[:2]) > 0 else self.hw
            of_depth = convert.to_camera(
                convert.parse_K_option(self.K_depth, self.root, "option K_depth"), hw, self.root, "K_depth"
            )
        if self.stated.K is not None:
            K = convert.make_K(*self.stated.K)
            return convert.to_camera(K, self.hw, self.root, "option K", self.distortion), of_depth
        if self.intrinsics is None:
            raise intrinsics_options.missing_intrinsics_error(
                self.root, self.image, "data.intrinsics=FEATURE", depth=self.depth is not None
            )
        values = self._numbers(file, example, self.intrinsics, (4, 9), n)
        return convert.to_cameras(values, self.hw, file, self.intrinsics, self.distortion), of_depth

    def _poses(self, file: Path, example: dict[str, tfrecord.ExampleFeature], key: str, n: int) -> Pose:
        return convert.parse_poses(self._numbers(file, example, key, (7, 16), n), file, key)
