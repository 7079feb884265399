"""Test writer of RLDS data sets: TFRecord files with TFDS's two JSON files."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dhtorch.data.codecs.tfrecord import crc32c, mask_crc
from dhtorch.export.arrays import (
    K_matrix,
    encode_depth_codes,
    frame_to_hwc,
    pose_matrix,
)
from dhtorch.records import Frame
from support.writers.parts import encode_unfiltered_png, save_file

_FEATURES_CLASS = "tensorflow_datasets.core.features"


def write_rlds(
    root: Path,
    episodes: Sequence[Sequence[Frame]],
    *,
    split: str = "train",
    camera: str = "image_0",
    depth: Literal["png", "array"] | None = "png",
    intrinsics: bool = True,
    poses: bool = True,
    shards: int = 1,
    has_size: bool = True,
) -> None:
    """Write a set of one camera: per step ``observation/<camera>``, an action and the optional features.

    Args:
        root: folder of the set's version.
        episodes: frames of each.
        split: its name.
        camera: name of the colour feature.
        depth: ``"png"`` (mm) or ``"array"`` (float32, m) with ``depth`` in place of ``image`` in its name; None = none.
        intrinsics: write ``observation/<camera>_intrinsics``, 9 numbers.
        poses: write ``observation/<camera>_T_world_from_cam``, 16 numbers.
        shards: number of files.
        has_size: write the images' size in the features.
    """
    first = episodes[0][0]
    depth_name = camera.replace("image", "depth")
    observation: dict[str, Any] = {camera: _describe_picture((*first.hw, 3) if has_size else (-1, -1, 3), "uint8")}
    if depth == "png":
        observation[depth_name] = _describe_picture((*first.depth.shape[1:], 1), "uint16")
    elif depth == "array":
        observation[depth_name] = _describe_tensor(tuple(first.depth.shape[1:]), "float32")
    observation |= {f"{camera}_intrinsics": _describe_tensor((9,), "float32")} if intrinsics else {}
    observation |= {f"{camera}_T_world_from_cam": _describe_tensor((16,), "float32")} if poses else {}
    step = {
        "observation": _describe_dict(observation),
        "action": _describe_tensor((7,), "float32"),
        "is_last": _describe_tensor((), "bool"),
    }
    steps = {
        "pythonClassName": f"{_FEATURES_CLASS}.Dataset",
        "sequence": {"feature": _describe_dict(step), "length": "-1"},
    }
    save_file(root / "features.json", json.dumps(_describe_dict({"steps": steps})))
    counts = [len(part) for part in np.array_split(np.arange(len(episodes)), shards)]
    split_info = {"name": split, "shardLengths": [str(count) for count in counts]}
    save_file(
        root / "dataset_info.json", json.dumps({"name": "tiny_robot", "version": "1.0.0", "splits": [split_info]})
    )
    records = [
        _encode_record(_encode_episode(frames, camera, depth_name, depth, intrinsics, poses, number=k))
        for k, frames in enumerate(episodes)
    ]
    for shard, count in enumerate(counts):
        name = f"tiny_robot-{split}.tfrecord-{shard:05d}-of-{shards:05d}"
        save_file(root / name, b"".join(records[sum(counts[:shard]) : sum(counts[:shard]) + count]))


def _encode_episode(
    frames: Sequence[Frame],
    camera: str,
    depth_name: str,
    depth: str | None,
    intrinsics: bool,
    poses: bool,
    *,
    number: int,
) -> bytes:
    """Message of one episode's record; actions differ from step to step and from episode to episode."""
    n = len(frames)
    features = {
        f"steps/observation/{camera}": _bytes_feature([encode_unfiltered_png(frame_to_hwc(frame)) for frame in frames]),
        "steps/action": _floats_feature(np.arange(7 * n) + 1000 * number),
        "steps/is_last": _int64s_feature([int(i == n - 1) for i in range(n)]),
        "episode_metadata/episode_id": _int64s_feature([-1]),
    }
    if depth == "png":
        features[f"steps/observation/{depth_name}"] = _bytes_feature(
            [encode_unfiltered_png(encode_depth_codes(frame.depth, 1000)) for frame in frames]
        )
    elif depth == "array":
        features[f"steps/observation/{depth_name}"] = _floats_feature(
            np.stack([frame.depth[0].numpy() for frame in frames])
        )
    if intrinsics:
        features[f"steps/observation/{camera}_intrinsics"] = _floats_feature(
            np.stack([K_matrix(frame.camera) for frame in frames])
        )
    if poses:
        features[f"steps/observation/{camera}_T_world_from_cam"] = _floats_feature(
            np.stack([pose_matrix(frame) for frame in frames])
        )
    entries = (
        _encode_field(1, _encode_field(1, name.encode()) + _encode_field(2, value)) for name, value in features.items()
    )
    return _encode_field(1, b"".join(entries))


def _encode_record(body: bytes) -> bytes:
    length = struct.pack("<Q", len(body))
    return length + struct.pack("<I", mask_crc(crc32c(length))) + body + struct.pack("<I", mask_crc(crc32c(body)))


def _encode_field(number: int, content: bytes) -> bytes:
    return _encode_varint(number << 3 | 2) + _encode_varint(len(content)) + content


def _encode_varint(value: int) -> bytes:
    value &= (1 << 64) - 1
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _bytes_feature(values: Sequence[bytes]) -> bytes:
    return _encode_field(1, b"".join(_encode_field(1, value) for value in values))


def _floats_feature(values: np.ndarray) -> bytes:
    return _encode_field(2, _encode_field(1, np.ascontiguousarray(values, "<f4").tobytes()))


def _int64s_feature(values: Sequence[int]) -> bytes:
    return _encode_field(3, _encode_field(1, b"".join(_encode_varint(value) for value in values)))


def _describe_dict(features: dict[str, Any]) -> dict[str, Any]:
    return {"pythonClassName": f"{_FEATURES_CLASS}.FeaturesDict", "featuresDict": {"features": features}}


def _describe_shape(shape: tuple[int, ...]) -> dict[str, Any]:
    return {"dimensions": [str(size) for size in shape]} if shape else {}


def _describe_picture(shape: tuple[int, ...], dtype: str) -> dict[str, Any]:
    image = {"shape": _describe_shape(shape), "dtype": dtype, "encodingFormat": "png"}
    return {"pythonClassName": f"{_FEATURES_CLASS}.Image", "image": image}


def _describe_tensor(shape: tuple[int, ...], dtype: str) -> dict[str, Any]:
    return {
        "pythonClassName": f"{_FEATURES_CLASS}.Tensor",
        "tensor": {"shape": _describe_shape(shape), "dtype": dtype, "encoding": "none"},
    }
