"""Reader of RLDS data sets in TFRecord files (TFDS), without TensorFlow; one recording per episode and camera.

``features.json`` names the features and ``dataset_info.json`` the set. A record is an episode; each feature holds the
values of all steps in order: ``steps/observation/image_0`` one encoded image a step, ``steps/action`` for example seven
numbers a step. Opening a set reads only the lengths of its records; reading a frame reads only that frame's images.

The format has no place for intrinsics, poses, time stamps and the unit of depth: they come from options, or from
features where a set has them; without them 16-bit depth images are in mm and arrays in m, an assumption. Stationary
cameras give no depth (NO_BASELINE).
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dhtorch.data import convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.codecs import tfrecord
from dhtorch.data.io import decode as files
from dhtorch.data.recording import Recording, Recordings, consecutive_frame_numbers
from dhtorch.data.stored_sizes import StoredSizes
from dhtorch.data.units import DepthUnit
from dhtorch.records import Camera, Frame

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
    file = root / "features.json"
    nodes = files.get_entry(
        files.read_json(file), f"featuresDict.features.{_STEPS_FEATURE}.sequence.feature", dict, file
    )
    features: dict[str, StepFeature] = {}
    _flatten(nodes, "", features, file, 0)

    def find(key: str, option: str, chosen: str | None, *names: str) -> str | None:
        files.refuse_if(
            chosen is not None and chosen not in features,
            root,
            f"option {option}",
            chosen,
            f"one of {', '.join(features)}",
        )
        return chosen or next((name for name in names if name != key and name in features), None)

    rigs = []
    for key in _select_colour(root, features, camera):
        hw = _picture_size(root, features, key)
        stated = intrinsics_options.parse_intrinsics(root, hw, intrinsics, K, fov)
        depth_names = (re.sub(word, "depth", key) for word in ("image", "rgb"))
        rig = partial(
            _open_camera,
            root=root,
            features=features,
            image=key,
            hw=hw,
            depth=find(key, "depth", depth, *depth_names),
            stated=stated,
            K_depth=K_depth,
            distortion=distortion,
            intrinsics=find(key, "intrinsics", stated.feature, f"{key}_intrinsics"),
            pose=find(key, "pose", pose, f"{key}_T_world_from_cam"),
            rate_hz=rate,
        )
        rigs.append((key, rig))
    episodes = _locate_episodes(root, split, episode)
    about = root / "dataset_info.json"
    stated_name = files.read_json(about).get("name") if about.is_file() else None
    of_set = stated_name if isinstance(stated_name, str) and stated_name else root.resolve().parent.name
    names = [f"{of_set}/{e.split}_{e.number:06d}/{key.rpartition('/')[2]}" for e in episodes for key, _ in rigs]
    parts = tuple(rig for _, rig in rigs)
    return Recordings(names, partial(_make_recording, names=tuple(names), episodes=tuple(episodes), rigs=parts))


@dataclass(frozen=True)
class StepFeature:
    """Type and shape of one feature of a step, from ``features.json``."""

    kind: str  # "image", "text", or "tensor"
    dtype: str
    shape: tuple[int, ...]  # of one step; -1 = not stated
    encoded: bool = False  # an array stored as one string of encoded bytes


def _flatten(node: Any, name: str, features: dict[str, StepFeature], file: Path, depth: int) -> None:
    """Add the features below ``node`` of the feature tree to ``features``, names joined by ``/``."""
    files.refuse_if(
        not isinstance(node, dict) or depth > 32, file, name or _STEPS_FEATURE, type(node).__name__, "a feature"
    )
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
        raise files.FormatError(file, f"{name} shape", sizes, "whole numbers") from None
    files.refuse_if(
        len(dimensions) > 8 or any(not -1 <= size <= files.MAX_PIXELS for size in dimensions),
        file,
        f"{name} shape",
        dimensions,
        "sizes of an array",
    )
    return dimensions


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
        raise files.FormatError(root, "option camera", ", ".join(not_colour) or "no camera", expected)
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
        raise files.FormatError(place.file, key, "no images", "encoded images")
    return files.decode_image_header(tfrecord.read_span(place.file, pictures.spans[0]), place.file).hw


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
    files.refuse_if(
        split is not None and split not in shards, root, "option split", split, f"one of {', '.join(sorted(shards))}"
    )
    selected = None if numbers is None else {numbers} if isinstance(numbers, int) else {int(each) for each in numbers}
    locations: list[RecordLocation] = []
    n_before = 0
    for name in sorted(shards) if split is None else [split]:
        places = [(file, span) for file in shards[name] for span in tfrecord.index_records(file)]
        if selected is not None and (missing := selected - set(range(len(places)))):
            raise files.FormatError(root, "option episode", min(missing), f"0 to {len(places) - 1} in {name}")
        locations += [
            RecordLocation(name, i, n_before + i, *at)
            for i, at in enumerate(places)
            if selected is None or i in selected
        ]
        n_before += len(places)
    files.refuse_if(
        not locations, root, "records", "none", "TFRecord files named <set>-<split>.tfrecord-<shard>-of-<shards>"
    )
    return locations


def _make_recording(
    i: int,
    *,
    names: tuple[str, ...],
    episodes: tuple[RecordLocation, ...],
    rigs: tuple[Callable[..., Recording], ...],
) -> Recording:
    """Position → recording: the cameras of the first episode, then those of the second, …"""
    episode, rig = episodes[i // len(rigs)], rigs[i % len(rigs)]
    body = tfrecord.read_record(episode.file, episode.span)
    example = tfrecord.parse_example(body, episode.file, episode.span.offset)
    return rig(names[i], episode, example)


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


Example = dict[str, tfrecord.ExampleFeature]


def _open_camera(
    name: str,
    episode: RecordLocation,
    example: Example,
    *,
    root: Path,
    features: dict[str, StepFeature],
    image: str,
    hw: tuple[int, int],
    depth: str | None,
    stated: intrinsics_options.ParsedIntrinsics,
    K_depth: Sequence[float] | None,
    distortion: Sequence[float] | None,
    intrinsics: str | None,
    pose: str | None,
    rate_hz: float | None,
) -> Recording:
    """The recording of a camera with its features and options in an episode, from the episode's parsed record."""
    file, described = episode.file, features[depth] if depth else None
    images = _pictures(file, example, image)
    n = len(images)
    files.refuse_if(not 0 < n <= _MAX_EPISODE_STEPS, file, image, f"{n} steps", f"1 to {_MAX_EPISODE_STEPS}")
    depths = _depths(root, file, example, depth, described, (n, image)) if depth and described else ()
    h, w = (*(described.shape if described else ()), -1, -1)[:2]
    depth_hw, depth_camera = (h, w) if min(h, w) > 0 else None, None
    if described is not None and K_depth is not None:
        matrix = convert.parse_K_option(K_depth, root, "option K_depth")
        depth_camera = convert.to_camera(matrix, depth_hw or hw, root, "K_depth")
    if stated.K is not None:
        cameras = convert.to_camera(convert.make_K(*stated.K), hw, root, "option K", distortion)
    elif intrinsics is None:
        raise intrinsics_options.missing_intrinsics_error(
            root, image, "data.intrinsics=FEATURE", depth=depth is not None
        )
    else:
        values = _numbers(file, example, intrinsics, features[intrinsics], (4, 9), n)
        cameras = convert.to_cameras(values, hw, file, intrinsics, distortion)
    poses = None
    if pose is not None:
        poses = convert.parse_poses(_numbers(file, example, pose, features[pose], (7, 16), n), file, pose)
    number = consecutive_frame_numbers(n)
    return Recording(
        name=name,
        format="rlds",
        load=LoadStep(file, images, hw, depths, described, cameras, depth_camera, episode, features),
        number=number,
        root=root,
        times=None if rate_hz is None else number.double() / rate_hz,
        poses=poses,
        rate_hz=rate_hz,
        report=stated.report + (() if depth else (f"{image}: no depth feature: depth is empty",)),
        episode=episode.place,
        camera_name=image,
        depth_unit=_ASSUMED_DEPTH_UNITS.get(described.kind) if described else None,
        # Depth with a K of its own does not cover the image's field.
        stored=StoredSizes(hw, None if K_depth is not None else depth_hw),
    )


def _pictures(file: Path, example: Example, key: str) -> tuple[tfrecord.ByteSpan, ...]:
    feature = example.get(f"{_STEPS_FEATURE}/{key}")
    if feature is None or feature.kind != "bytes":
        raise files.FormatError(file, key, "nothing" if feature is None else "numbers", "encoded images")
    return feature.spans


def _depths(
    root: Path, file: Path, example: Example, key: str, described: StepFeature, steps: tuple[int, str]
) -> tuple[tfrecord.ByteSpan, ...]:
    """Span of bytes of the depth of each step, as many as of the image."""
    n, image = steps
    if described.kind == "image":
        spans = _pictures(file, example, key)
        files.refuse_if(len(spans) != n, file, key, f"{len(spans)} images", f"{n}, as many as {image}")
        return spans
    shape, feature = described.shape, example.get(f"{_STEPS_FEATURE}/{key}")
    h, w = (*shape, 0, 0)[:2]
    single = len(shape) == 2 or (len(shape) == 3 and shape[2] == 1)
    if described.dtype != "float32" or described.encoded or not single or min(h, w) < 1:
        stored = f"{described.dtype} {shape}"
        raise files.FormatError(root / "features.json", key, stored, "16-bit images, or float32 (h, w)")
    size = 4 * h * w
    whole = feature is not None and feature.kind == "float" and len(feature.spans) == 1
    if feature is None or not whole or feature.spans[0].length != n * size:
        raise files.FormatError(file, key, "other numbers", f"{n} arrays of {h}x{w} floats")
    return tuple(tfrecord.ByteSpan(feature.spans[0].offset + i * size, size) for i in range(n))


def _numbers(
    file: Path, example: Example, key: str, described: StepFeature, sizes: tuple[int, ...], n: int
) -> np.ndarray:
    """Values (n, size) float64 of a feature, one row a step; ``size`` must be one of ``sizes``."""
    size = int(np.prod(described.shape)) if described.shape and min(described.shape) > 0 else 0
    feature = example.get(f"{_STEPS_FEATURE}/{key}")
    if feature is None or size not in sizes:
        expected = " or ".join(map(str, sizes))
        raise files.FormatError(file, key, f"{size} numbers a step" if feature else "nothing", f"{expected} numbers")
    values = tfrecord.read_feature_numbers(file, key, feature, n * size)
    files.refuse_if(len(values) != n * size, file, key, f"{len(values)} numbers", f"{size} for each of {n} steps")
    return values.reshape(n, size).astype(np.float64)
