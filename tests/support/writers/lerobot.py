"""Test writer of LeRobot data sets: v3 with shared tables and videos, v2.1 with files per episode."""

import itertools
import json
import math
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data.io.decode import import_optional
from dhtorch.export.arrays import (
    K_matrix,
    encode_depth_codes,
    frame_to_hwc,
    pose_matrix,
)
from dhtorch.export.tiff import encode_float_tiff
from dhtorch.export.video import write_lossless
from dhtorch.records import Frame
from support.writers.parts import encode_unfiltered_png, save_file

_DEPTH_QUANTISATION = {"video.depth_min": 0.01, "video.depth_max": 10.0, "video.shift": 3.5, "video.use_log": True}
_FILES_PER_CHUNK = 1000


def write_lerobot(
    root: Path,
    episodes: Sequence[Sequence[Frame]],
    *,
    version: int = 3,
    camera: str = "observation.images.front",
    fps: int = 30,
    image: str = "video",
    depth: str | None = "video",
    intrinsics: str | None = "feature",
    poses: bool = True,
    depth_pixels: str = "gray12le",
    group: int = 3,
) -> None:
    """Write a data set of one camera, with frames every 1/``fps`` s.

    Args:
        root: an empty folder.
        episodes: frames of each.
        version: 3, or 2 for v2.1.
        camera: key of the colour feature; depth is ``<camera>_depth``.
        fps: frame rate.
        image: ``"video"`` or ``"image"`` (PNG in the table).
        depth: ``"video"`` (12-bit logarithmic codes), ``"tiff"`` (float, m), ``"png"`` (mm), ``"array"`` (integer mm in
            the table), None.
        intrinsics: ``"feature"`` (``<camera>.intrinsics``, 9 numbers), ``"side-car"`` or None.
        poses: write ``<camera>.pose``, 16 numbers.
        depth_pixels: pixel format of the depth video.
        group: rows per row group.
    """
    first = episodes[0][0]
    key, frames = f"{camera}_depth", [frame for episode in episodes for frame in episode]
    features: dict[str, Any] = {
        camera: _picture_feature(image, (*first.hw, 3), {"video.fps": fps, "video.is_depth_map": False}),
        "timestamp": _plain_feature("float32", 1),
        **{name: _plain_feature("int64", 1) for name in ("frame_index", "episode_index", "index", "task_index")},
    }
    if depth is not None:
        shape, kind = (*first.depth.shape[1:], 1), {"video": "video", "array": "uint16"}.get(depth, "image")
        info = {"is_depth_map": True} | (
            _DEPTH_QUANTISATION if depth == "video" else {"depth_unit": "m"} if depth == "tiff" else {}
        )
        features[key] = _picture_feature(kind, shape, info)
    if intrinsics == "feature":
        features[f"{camera}.intrinsics"] = _plain_feature("float64", 9)
    if poses:
        features[f"{camera}.pose"] = _plain_feature("float64", 16)
    rows = _make_columns(episodes, fps, features, camera, depth)
    spans = [range(len(frames))] if version == 3 else _episode_row_ranges(episodes)
    for number, span in enumerate(spans):
        part_rows = {name: [cells[i] for i in span] for name, cells in rows.items()}
        _write_table(root / _file_path("data", "", number, version, "parquet"), part_rows, group)
        part_frames = [frames[i] for i in span]
        if image == "video":
            pictures = [frame_to_hwc(frame) for frame in part_frames]
            write_lossless(
                root / _file_path("videos", camera, number, version, "mp4"), pictures, "rgb24", rate=Fraction(fps)
            )
        if depth == "video":
            codes = [quantise_lerobot_depth(frame) for frame in part_frames]
            write_lossless(
                root / _file_path("videos", key, number, version, "mp4"), codes, depth_pixels, rate=Fraction(fps)
            )
    videos = [name for name, feature in features.items() if feature["dtype"] == "video"]
    _write_meta(root, episodes, version, fps, features, videos)
    if intrinsics == "side-car":
        distortion = first.camera.distortion
        entry = {"K": K_matrix(first.camera).tolist()} | (
            {} if distortion is None else {"dist": distortion[0].tolist()}
        )
        entry |= {} if first.depth_camera is None else {"K_depth": K_matrix(first.depth_camera).tolist()}
        save_file(root / "meta" / "intrinsics.json", json.dumps({camera: entry}))


def quantise_lerobot_depth(frame: Frame) -> np.ndarray:
    """Depth map → 12-bit codes: no return and too near become code 0, too far the last code."""
    low, high, shift = (_DEPTH_QUANTISATION[f"video.{name}"] for name in ("depth_min", "depth_max", "shift"))
    z = frame.depth[0].double().numpy()
    fraction = np.log((z + shift) / (low + shift)) / math.log((high + shift) / (low + shift))
    return np.rint(fraction * 4095).clip(0, 4095).astype(np.uint16)


def _picture_feature(dtype: str, shape: Sequence[int], info: dict[str, Any]) -> dict[str, Any]:
    return {"dtype": dtype, "shape": list(shape), "names": ["height", "width", "channels"], "info": info}


def _plain_feature(dtype: str, n: int) -> dict[str, Any]:
    return {"dtype": dtype, "shape": [n], "names": None}


def _episode_row_ranges(episodes: Sequence[Sequence[Frame]]) -> list[range]:
    ends = np.cumsum([0, *(len(episode) for episode in episodes)]).tolist()
    return [range(a, b) for a, b in itertools.pairwise(ends)]


def _file_path(top: str, key: str, number: int, version: int, suffix: str) -> str:
    if version == 3:
        return "/".join(part for part in (top, key, "chunk-000", f"file-{number:03d}.{suffix}") if part)
    return "/".join(part for part in (top, "chunk-000", key, f"episode_{number:06d}.{suffix}") if part)


def _make_columns(
    episodes: Sequence[Sequence[Frame]], fps: int, features: dict[str, Any], camera: str, depth: str | None
) -> dict[str, list[Any]]:
    """Column → one value per frame of the set."""
    rows: dict[str, list[Any]] = {name: [] for name, feature in features.items() if feature["dtype"] != "video"}
    for number, episode in enumerate(episodes):
        for i, frame in enumerate(episode):
            indices = {"timestamp": i / fps, "frame_index": i, "episode_index": number, "task_index": 0}
            values: dict[str, Any] = {**indices, "index": len(rows["timestamp"])}
            name = f"frame-{i:06d}"
            values[camera] = {"bytes": encode_unfiltered_png(frame_to_hwc(frame)), "path": f"{name}.png"}
            if depth in ("tiff", "png"):
                content = (
                    encode_float_tiff(frame.depth[0].numpy())
                    if depth == "tiff"
                    else encode_unfiltered_png(encode_depth_codes(frame.depth, 1000))
                )
                values[f"{camera}_depth"] = {"bytes": content, "path": f"{name}.{depth}"}
            elif depth == "array":
                values[f"{camera}_depth"] = encode_depth_codes(frame.depth, 1000)[..., None].tolist()
            values[f"{camera}.intrinsics"] = K_matrix(frame.camera).ravel().tolist()
            if f"{camera}.pose" in rows:
                values[f"{camera}.pose"] = pose_matrix(frame).ravel().tolist()
            for column, cells in rows.items():
                cells.append(values[column])
    return rows


def _write_table(file: Path, columns: dict[str, list[Any]], group: int) -> None:
    pyarrow, parquet = import_optional("pyarrow"), import_optional("pyarrow.parquet")
    types = {"timestamp": pyarrow.float32()}
    arrays = {name: pyarrow.array(cells, types.get(name)) for name, cells in columns.items()}
    file.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(pyarrow.table(arrays), file, row_group_size=group)


def _write_meta(
    root: Path, episodes: Sequence[Sequence[Frame]], version: int, fps: int, features: dict[str, Any], videos: list[str]
) -> None:
    folder, stem = {
        3: ("chunk-{chunk_index:03d}", "file-{file_index:03d}"),
        2: ("chunk-{episode_chunk:03d}", "episode_{episode_index:06d}"),
    }[version]
    video = f"{{video_key}}/{folder}" if version == 3 else f"{folder}/{{video_key}}"
    info = {
        "codebase_version": "v3.0" if version == 3 else "v2.1",
        "robot_type": "none",
        "total_episodes": len(episodes),
        "total_frames": sum(map(len, episodes)),
        "total_tasks": 1,
        "chunks_size": _FILES_PER_CHUNK,
        "fps": fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": f"data/{folder}/{stem}.parquet",
        "video_path": f"videos/{video}/{stem}.mp4" if videos else None,
        "features": features,
    }
    save_file(root / "meta" / "info.json", json.dumps(info))
    if version == 2:
        lines = [{"episode_index": i, "tasks": ["look"], "length": len(e)} for i, e in enumerate(episodes)]
        save_file(root / "meta" / "episodes.jsonl", "".join(json.dumps(line) + "\n" for line in lines))
        save_file(root / "meta" / "tasks.jsonl", json.dumps({"task_index": 0, "task": "look"}) + "\n")
        return
    spans = _episode_row_ranges(episodes)
    zeros = [0] * len(spans)
    table: dict[str, list[Any]] = {"episode_index": list(range(len(spans))), "length": [len(s) for s in spans]}
    table |= {"data/chunk_index": zeros, "data/file_index": zeros, "tasks": [["look"]] * len(spans)}
    table |= {"dataset_from_index": [s.start for s in spans], "dataset_to_index": [s.stop for s in spans]}
    for key in videos:
        table |= {f"videos/{key}/chunk_index": zeros, f"videos/{key}/file_index": zeros}
        table[f"videos/{key}/from_timestamp"] = [s.start / fps for s in spans]
        table[f"videos/{key}/to_timestamp"] = [s.stop / fps for s in spans]
    _write_table(root / "meta" / "episodes" / "chunk-000" / "file-000.parquet", table, 100)
    _write_table(root / "meta" / "tasks.parquet", {"task_index": [0], "task": ["look"]}, 100)
