"""What a LeRobot data set says about itself: features, episodes, and where the rows and videos of an episode lie."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dhtorch.data import files
from dhtorch.data.codec_parquet import parquet_header, read_columns
from dhtorch.data.files import FormatError

_MAX_EPISODES = 10_000_000
_V2_DATA = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
_V2_VIDEO = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
_V3_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_V3_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"


@dataclass(frozen=True)
class Feature:
    """One column or video."""

    key: str
    dtype: str  # "video", "image", or a numpy name
    shape: tuple[int, ...]
    info: dict[str, Any] = field(default_factory=dict)

    @property
    def hw(self) -> tuple[int, int]:
        """(height, width) of a picture, channels first or last."""
        h_w = (
            self.shape[1:] if len(self.shape) == 3 and self.shape[0] in (1, 3) and self.shape[2] > 4 else self.shape[:2]
        )
        return h_w[0], h_w[1]

    @property
    def is_depth(self) -> bool:
        """Marked as depth, by the flag of today or of old; a plain array by its name."""
        marked = self.info.get("is_depth_map") is True or self.info.get("video.is_depth_map") is True
        return marked or (self.dtype not in ("video", "image") and len(self.shape) >= 2 and "depth" in self.key)


@dataclass(frozen=True)
class Episode:
    """Place of one episode."""

    number: int
    length: int | None  # frames, as the metadata have it
    data: Path
    videos: dict[str, tuple[Path, float]]  # key → file and the time (s) in it at which the episode starts


@dataclass(frozen=True)
class Meta:
    """``meta/info.json``, checked."""

    root: Path
    version: int  # 2 or 3
    fps: float
    features: dict[str, Feature]
    chunks_size: int
    data_path: str
    video_path: str


def read_meta(root: Path) -> Meta:
    """The data set's own description.

    Raises:
        FormatError: missing or damaged ``meta/info.json``, or a version other than 2.x and 3.x.
    """
    file = root / "meta" / "info.json"
    info = files.read_json(file)
    text = files.get(info, "codebase_version", str, file)
    version = re.fullmatch(r"v?([23])\.\d{1,3}", text)
    if not version:
        raise FormatError(file, "codebase_version", text, "v2.x or v3.x")
    number = int(version[1])
    chunks = info.get("chunks_size", 1000)
    if type(chunks) is not int or not 0 < chunks < 10**9:
        raise FormatError(file, "chunks_size", chunks, "a positive number")
    templates = {"data_path": (_V2_DATA, _V3_DATA), "video_path": (_V2_VIDEO, _V3_VIDEO)}
    paths = {key: info.get(key) or defaults[number - 2] for key, defaults in templates.items()}
    for key, value in paths.items():
        if not isinstance(value, str):
            raise FormatError(file, key, type(value).__name__, "a path")
    features = files.get(info, "features", dict, file)
    return Meta(
        root=root,
        version=number,
        fps=files.to_positive(info.get("fps"), file, "fps"),
        features={key: _feature(key, value, file) for key, value in features.items()},
        chunks_size=chunks,
        data_path=paths["data_path"],
        video_path=paths["video_path"],
    )


def read_episodes(meta: Meta, wanted: list[int] | None) -> list[Episode]:
    """The wanted episodes (None = all), in their order.

    Raises:
        FormatError: missing or damaged tables, or an episode that is not there.
    """
    found: dict[int, Episode] = {}
    listed = _episodes_v3 if meta.version == 3 else _episodes_v2
    for episode in listed(meta, None if wanted is None else set(wanted)):
        found.setdefault(episode.number, episode)
    missing = [n for n in wanted or () if n not in found]
    if missing or not found:
        raise FormatError(meta.root / "meta", "episodes", f"{len(found)} of those asked for", missing or "at least one")
    return [found[n] for n in wanted or sorted(found)]


def _episodes_v3(meta: Meta, wanted: set[int] | None) -> Iterator[Episode]:
    tables = sorted((meta.root / "meta" / "episodes").glob("*/*.parquet"))
    if not tables:
        raise FormatError(meta.root / "meta" / "episodes", "tables", "none", "chunk-000/file-000.parquet")
    videos = [key for key, feature in meta.features.items() if feature.dtype == "video"]
    for table in tables:
        have = set(parquet_header(table).columns)
        names = ["episode_index", "data/chunk_index", "data/file_index"]
        names += [f"videos/{key}/{part}" for key in videos for part in ("chunk_index", "file_index", "from_timestamp")]
        spans = ["dataset_from_index", "dataset_to_index"] if "dataset_from_index" in have else []
        columns = read_columns(table, names + spans)
        numbers = [_count(x, table, "episode_index") for x in columns["episode_index"]]
        for i, number in enumerate(numbers):
            if wanted is not None and number not in wanted:
                continue
            row = {name: values[i] for name, values in columns.items()}
            places = {}
            for key in videos:
                at = _seconds(row[f"videos/{key}/from_timestamp"], table, key)
                index = {
                    part: _count(row[f"videos/{key}/{part}"], table, key) for part in ("chunk_index", "file_index")
                }
                places[key] = (_path(meta, "video_path", {**index, "video_key": key}), at)
            index = {part: _count(row[f"data/{part}"], table, part) for part in ("chunk_index", "file_index")}
            ends = [_count(row[name], table, name, 2**53) for name in spans]
            length = ends[1] - ends[0] if ends else None
            yield Episode(number, length, _path(meta, "data_path", index), places)


def _episodes_v2(meta: Meta, wanted: set[int] | None) -> Iterator[Episode]:
    table = meta.root / "meta" / "episodes.jsonl"
    videos = [key for key, feature in meta.features.items() if feature.dtype == "video"]
    for line, text in enumerate(files.read_text(table).splitlines(), 1):
        if not text.strip():
            continue
        row = files.decode_json(text, table)
        number = _count(files.get(row, "episode_index", int, table), table, f"line {line}")
        length = _count(files.get(row, "length", int, table), table, f"line {line}")
        if wanted is not None and number not in wanted:
            continue
        index: dict[str, int | str] = {"episode_chunk": number // meta.chunks_size, "episode_index": number}
        places = {key: (_path(meta, "video_path", {**index, "video_key": key}), 0.0) for key in videos}
        yield Episode(number, length, _path(meta, "data_path", index), places)


def colour_keys(meta: Meta, asked: str | Sequence[str] | None = None) -> list[str]:
    """Keys of the colour features asked for; None = all.

    Raises:
        FormatError: none, or one that is not there.
    """
    colour = [key for key, f in meta.features.items() if f.dtype in ("video", "image") and not f.is_depth]
    keys = colour if asked is None else [asked] if isinstance(asked, str) else list(asked)
    unknown = [key for key in keys if key not in colour]
    if unknown or not keys:
        raise FormatError(
            meta.root / "meta" / "info.json", "cameras", ", ".join(unknown) or "none", f"of {', '.join(colour)}"
        )
    return keys


def inside(root: Path, name: str, file: Path, field: str) -> Path:
    """A file below ``root``.

    Raises:
        FormatError: an absolute name, or one that leads out.
    """
    if not name or "\x00" in name or len(name) > 1000 or Path(name).is_absolute() or ".." in Path(name).parts:
        raise FormatError(file, field, name, "a file inside the data set")
    return root / name


def _path(meta: Meta, key: str, values: dict[str, Any]) -> Path:
    """A path template filled in. Python's own ``format`` would also follow attributes and pad to any width."""
    file, template = meta.root / "meta" / "info.json", getattr(meta, key)

    def fill(match: re.Match[str]) -> str:
        name, width = match[1], match[2]
        if name not in values or (width and isinstance(values[name], str)):
            raise FormatError(file, key, match[0], f"one of {', '.join(values)}")
        return str(values[name]).zfill(int(width or 0))

    name = re.sub(r"\{(\w{1,40})(?::0(\d)d)?\}", fill, template[:500])
    if "{" in name or "}" in name:
        raise FormatError(file, key, template, "a path with fields such as {file_index:03d}")
    return inside(meta.root, name, file, key)


def _feature(key: str, value: Any, file: Path) -> Feature:
    dtype = files.get(value, "dtype", str, file)
    shape = value.get("shape") or ()
    if (
        not isinstance(shape, list | tuple)
        or len(shape) > 8
        or any(type(n) is not int or not 0 <= n < 2**31 for n in shape)
    ):
        raise FormatError(file, f"features.{key}.shape", shape, "a few counts")
    if dtype in ("video", "image") and (len(shape) not in (2, 3) or not 0 < math.prod(shape) <= 4 * files.MAX_PIXELS):
        raise FormatError(file, f"features.{key}.shape", shape, "height, width and channels")
    info = value.get("info") or value.get("video_info") or {}
    if not isinstance(info, dict) or any(c in key for c in "/\\\x00") or key in ("", ".", ".."):
        raise FormatError(file, f"features.{key}", type(info).__name__, "an object under a plain name")
    return Feature(key, dtype, tuple(shape), info)


def _count(value: Any, file: Path, field: str, limit: int = _MAX_EPISODES) -> int:
    number = float(files.to_array(value, (), file, field))
    if not 0 <= number < limit or number != int(number):
        raise FormatError(file, field, number, f"a count below {limit}")
    return int(number)


def _seconds(value: Any, file: Path, field: str) -> float:
    return float(files.to_array(value, (), file, f"videos/{field}/from_timestamp"))
