"""Metadata of LeRobot data sets: features, episodes, and the files with an episode's rows and videos."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data.codecs.parquet import read_columns
from dhtorch.data.io import decode as files

_MAX_EPISODES = 10_000_000
_FILE_INDEX_COLUMNS = ("chunk_index", "file_index")
_V2_DATA = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
_V2_VIDEO = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
_V3_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_V3_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"


@dataclass(frozen=True)
class LeRobotFeature:
    """One feature of a data set: a column of the tables or a video."""

    key: str
    dtype: str  # "video", "image", or a numpy name
    shape: tuple[int, ...]
    info: dict[str, Any] = field(default_factory=dict)

    @property
    def hw(self) -> tuple[int, int]:
        """(height, width) of an image feature, channels first or last."""
        h_w = (
            self.shape[1:] if len(self.shape) == 3 and self.shape[0] in (1, 3) and self.shape[2] > 4 else self.shape[:2]
        )
        return h_w[0], h_w[1]

    @property
    def channels(self) -> int:
        """Number of channels of an image feature, first or last."""
        h, w = self.hw
        return math.prod(self.shape) // max(h * w, 1)

    @property
    def is_depth(self) -> bool:
        """Whether the feature is depth: by its flag (current or older name), a plain array by its key."""
        marked = self.info.get("is_depth_map") is True or self.info.get("video.is_depth_map") is True
        return marked or (self.dtype not in ("video", "image") and len(self.shape) >= 2 and "depth" in self.key)


@dataclass(frozen=True)
class LeRobotEpisode:
    """Table and video files of one episode."""

    number: int
    length: int | None  # frames, from the metadata
    data: Path
    videos: dict[str, tuple[Path, float]]  # key → file and the episode's start in it (s)


@dataclass(frozen=True)
class LeRobotMeta:
    """Contents of ``meta/info.json``, validated."""

    root: Path
    name: str  # of the data set
    version: int  # 2 or 3
    fps: float
    features: dict[str, LeRobotFeature]
    chunks_size: int
    data_path: str
    video_path: str

    @property
    def videos(self) -> list[str]:
        """Keys of the features stored as videos."""
        return [key for key, feature in self.features.items() if feature.dtype == "video"]


@dataclass(frozen=True, eq=False)
class LeRobotEpisodes:
    """The selected episodes, in that order; with tens of thousands of them files are resolved one at a time."""

    meta: LeRobotMeta
    numbers: np.ndarray  # (n,)
    columns: dict[str, np.ndarray]  # (n,) each: ``length``, and in v3 file indices and times as named in meta/episodes

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, i: int) -> LeRobotEpisode:
        meta, number = self.meta, int(self.numbers[i])
        row = {name: values[i].item() for name, values in self.columns.items()}

        def file_fields(prefix: str) -> dict[str, Any]:
            if meta.version == 2:
                return {"episode_chunk": number // meta.chunks_size, "episode_index": number}
            return {part: row[f"{prefix}/{part}"] for part in _FILE_INDEX_COLUMNS}

        videos = {
            key: (
                _fill_path_template(meta, "video_path", {**file_fields(f"videos/{key}"), "video_key": key}),
                row.get(f"videos/{key}/from_timestamp", 0.0),
            )
            for key in meta.videos
        }
        return LeRobotEpisode(
            number, row.get("length"), _fill_path_template(meta, "data_path", file_fields("data")), videos
        )


def read_lerobot_meta(root: Path) -> LeRobotMeta:
    """Read and validate ``meta/info.json``.

    Raises:
        FormatError: missing or damaged ``meta/info.json``, or a version other than 2.x and 3.x.
    """
    file = root / "meta" / "info.json"
    info = files.read_json(file)
    text = files.get_entry(info, "codebase_version", str, file)
    version = re.fullmatch(r"v?([23])\.\d{1,3}", text)
    if not version:
        raise files.FormatError(file, "codebase_version", text, "v2.x or v3.x")
    number = int(version[1])
    chunks = info.get("chunks_size", 1000)
    files.refuse_if(type(chunks) is not int or not 0 < chunks < 10**9, file, "chunks_size", chunks, "a positive number")
    templates = {"data_path": (_V2_DATA, _V3_DATA), "video_path": (_V2_VIDEO, _V3_VIDEO)}
    paths = {key: info.get(key) or defaults[number - 2] for key, defaults in templates.items()}
    for key, value in paths.items():
        files.refuse_if(not isinstance(value, str), file, key, type(value).__name__, "a path")
    features = files.get_entry(info, "features", dict, file)
    return LeRobotMeta(
        root=root,
        name=root.resolve().name,
        version=number,
        fps=files.to_positive(info.get("fps"), file, "fps"),
        features={key: _parse_feature(key, value, file) for key, value in features.items()},
        chunks_size=chunks,
        data_path=paths["data_path"],
        video_path=paths["video_path"],
    )


def read_lerobot_episodes(meta: LeRobotMeta, wanted: Sequence[int] | None) -> LeRobotEpisodes:
    """The ``wanted`` episodes (None = all, by number); of two with the same number the first is used.

    Raises:
        FormatError: missing or damaged tables, an invalid path, or an episode that does not exist.
    """
    columns = _read_columns_v3(meta) if meta.version == 3 else _read_columns_v2(meta)
    numbers, rows = np.unique(columns.pop("episode_index"), return_index=True)
    row_of = dict(zip(numbers.tolist(), rows.tolist(), strict=True))
    selected = numbers.tolist() if wanted is None else list(wanted)
    missing = [n for n in selected if n not in row_of]
    if missing or not selected:
        problem = f"{len(selected) - len(missing)} of those requested"
        raise files.FormatError(meta.root / "meta", "episodes", problem, missing or "at least one")
    rows = np.array([row_of[n] for n in selected])
    episodes = LeRobotEpisodes(meta, np.array(selected), {name: values[rows] for name, values in columns.items()})
    _ = episodes[0]  # raises now for invalid paths
    return episodes


def _read_columns_v3(meta: LeRobotMeta) -> dict[str, np.ndarray]:
    tables = sorted((meta.root / "meta" / "episodes").glob("*/*.parquet"))
    files.refuse_if(not tables, meta.root / "meta" / "episodes", "tables", "none", "chunk-000/file-000.parquet")
    prefixes = ["data", *(f"videos/{key}" for key in meta.videos)]
    counts = ["episode_index", *(f"{prefix}/{part}" for prefix in prefixes for part in _FILE_INDEX_COLUMNS)]
    starts = [f"videos/{key}/from_timestamp" for key in meta.videos]
    parts: list[dict[str, np.ndarray]] = []
    for table in tables:
        spans = ["dataset_from_index", "dataset_to_index"]
        values = read_columns(table, [*counts, *starts], optional=spans)
        columns = {name: _check_counts(values[name], table, name) for name in counts}
        columns |= {name: _check_numbers(values[name], table, name, np.isfinite) for name in starts}
        if {*spans} <= {*values}:
            first, end = (_check_counts(values[name], table, name, 2**53) for name in spans)
            columns["length"] = end - first
        parts.append(columns)
    shared = set.intersection(*({*columns} for columns in parts))
    return {name: np.concatenate([columns[name] for columns in parts]) for name in shared}


def _read_columns_v2(meta: LeRobotMeta) -> dict[str, np.ndarray]:
    table = meta.root / "meta" / "episodes.jsonl"
    rows = []
    for line, text in enumerate(files.read_lines(table), 1):
        if text.strip():
            row = files.decode_json(text, table)
            rows.append([files.get_entry(row, key, int, table) for key in ("episode_index", "length")])
            files.refuse_if(
                not all(0 <= value < _MAX_EPISODES for value in rows[-1]),
                table,
                f"line {line}",
                rows[-1],
                f"counts below {_MAX_EPISODES}",
            )
    numbers = np.array(rows, dtype=np.int64).reshape(-1, 2)
    return {"episode_index": numbers[:, 0], "length": numbers[:, 1]}


def select_colour_keys(meta: LeRobotMeta, requested: str | Sequence[str] | None = None) -> list[str]:
    """The requested keys of colour features, checked; None = all.

    Raises:
        FormatError: no colour feature, or an unknown key.
    """
    pictures = [key for key, f in meta.features.items() if f.dtype in ("video", "image") and not f.is_depth]
    ours = {"codes", "geometry_image"}  # pictures that are maps of codes, which dhtorch writes
    colour = [key for key in pictures if not ours & meta.features[key].info.keys()]
    keys = colour if requested is None else [requested] if isinstance(requested, str) else list(requested)
    unknown = [key for key in keys if key not in colour]
    files.refuse_if(
        unknown or not keys,
        meta.root / "meta" / "info.json",
        "cameras",
        ", ".join(unknown) or "none",
        f"some of {', '.join(colour)}",
    )
    return keys


def _fill_path_template(meta: LeRobotMeta, key: str, values: dict[str, Any]) -> Path:
    """A path template with its fields filled in; ``str.format`` would also access attributes and pad to any width."""
    file, template = meta.root / "meta" / "info.json", getattr(meta, key)

    def fill(match: re.Match[str]) -> str:
        name, width = match[1], match[2]
        files.refuse_if(
            name not in values or (width and isinstance(values[name], str)),
            file,
            key,
            match[0],
            f"one of {', '.join(values)}",
        )
        return str(values[name]).zfill(int(width or 0))

    name = re.sub(r"\{(\w{1,40})(?::0(\d)d)?\}", fill, template[:500])
    files.refuse_if("{" in name or "}" in name, file, key, template, "a path with fields such as {file_index:03d}")
    return files.resolve_inside(meta.root, name, file, key)


def _parse_feature(key: str, value: Any, file: Path) -> LeRobotFeature:
    dtype = files.get_entry(value, "dtype", str, file)
    shape = value.get("shape") or ()
    files.refuse_if(
        not isinstance(shape, list | tuple)
        or len(shape) > 8
        or any(type(n) is not int or not 0 <= n < 2**31 for n in shape),
        file,
        f"features.{key}.shape",
        shape,
        "a few counts",
    )
    files.refuse_if(
        dtype in ("video", "image") and (len(shape) not in (2, 3) or not 0 < math.prod(shape) <= 4 * files.MAX_PIXELS),
        file,
        f"features.{key}.shape",
        shape,
        "height, width and channels",
    )
    info = value.get("info") or value.get("video_info") or {}
    files.refuse_if(
        not isinstance(info, dict) or any(c in key for c in "/\\\x00") or key in ("", ".", ".."),
        file,
        f"features.{key}",
        type(info).__name__,
        "an object under a plain name",
    )
    return LeRobotFeature(key, dtype, tuple(shape), info)


def _check_counts(values: Any, file: Path, field: str, limit: int = _MAX_EPISODES) -> np.ndarray:
    return _check_numbers(values, file, field, lambda x: (x >= 0) & (x < limit) & (x == np.floor(x))).astype(np.int64)


def _check_numbers(values: Any, file: Path, field: str, is_valid: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """A column (n,) as float64, after checking that all values are numbers and valid."""
    files.refuse_if(
        not isinstance(values, np.ndarray) or values.ndim != 1 or values.dtype.kind not in "fiu",
        file,
        field,
        "no numbers",
        "one number per row",
    )
    column = values.astype(np.float64)
    if not (valid := is_valid(column)).all():
        raise files.FormatError(file, field, column[~valid][0], "a count, or a time in s")
    return column
