"""Writer of LeRobot data sets v3.0 and v2.1: features, table schemas, statistics and the files below ``meta/``.

A map (depth, its standard deviation, codes) is either an array (1, h, w) of numbers in the table or an image in it, as
float32 TIFF in metres or 8-bit PNG; 0 = no depth. LeRobot's policies take every image and video feature as a picture of
three channels, whatever ``is_depth_map`` states, so that only sets whose maps are numbers train without further
options. LeRobot's other form of depth, 12-bit video, has no code for *no return*. Tables hold one episode each, in both
versions; ``meta/info.json`` is written last.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dhtorch.runtime import storage

FeatureSpec = dict[str, Any]  # as in meta/info.json

#: Version → ``codebase_version`` in ``meta/info.json``.
_CODEBASE_VERSIONS = {3: "v3.0", 2: "v2.1"}

#: Files per chunk folder.
FILES_PER_CHUNK = 1000

_HWC_NAMES = ["height", "width", "channels"]
_CHW_NAMES = ["channels", "height", "width"]

#: Bins of a :class:`LogHistogram` per factor of two: a bin is 2.2 % wide. Source: derived: 2^(1/32).
_BINS_PER_OCTAVE = 32

#: Octaves of a :class:`LogHistogram`, powers of two of a metre: 0.06 mm to 4 km. Source: derived: an eighth of the
#: default step of depth (2^-13 m) and a half of it, to beyond any range sensor.
_OCTAVES = (-14, 12)

#: Fractions of answered values in the statistics of a map, by LeRobot's names. Source: names of LeRobot 0.4's stats.
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_PATH_TEMPLATES = {
    3: ("data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"),
    2: ("data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"),
}  # fmt: skip


class VideoSegment(NamedTuple):
    """The video file and time span of an episode."""

    chunk: int
    file: int
    start: float  # s in the file
    stop: float


@dataclass(frozen=True)
class EpisodeSpec:
    """Metadata of one episode for ``meta/``; its table is the file with its number."""

    number: int
    length: int
    start: int  # index of its first row
    tasks: Sequence[str] = ()
    videos: Mapping[str, VideoSegment] = field(default_factory=dict)
    stats: Mapping[str, Any] = field(default_factory=dict)


class FeatureMoments(NamedTuple):
    """Moments of numbers in k channels, float64, from which statistics are computed; sums combine sets."""

    n: np.ndarray  # (k,)
    mean: np.ndarray
    spread: np.ndarray  # sum of squared deviations from the mean: sums of squares lose the variance of time stamps
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray, valid: np.ndarray | None = None) -> "FeatureMoments":
        """Moments of numbers (n, k), over those that are finite and ``valid``; may be over none."""
        x = np.asarray(values, np.float64)
        keep = np.isfinite(x) if valid is None else np.isfinite(x) & valid
        n = keep.sum(0).astype(np.float64)
        mean = np.where(keep, x, 0.0).sum(0) / np.maximum(n, 1.0)
        spread = (np.where(keep, x - mean, 0.0) ** 2).sum(0)
        low, high = np.where(keep, x, np.inf), np.where(keep, x, -np.inf)
        return cls(n, mean, spread, low.min(0, initial=np.inf), high.max(0, initial=-np.inf))

    @classmethod
    def parse(cls, packed: Sequence[Sequence[float | None]]) -> "FeatureMoments":
        """Inverse of :meth:`pack`."""
        rows = [np.array([np.nan if x is None else x for x in row]) for row in packed]
        rows[3], rows[4] = np.where(np.isnan(rows[3]), np.inf, rows[3]), np.where(np.isnan(rows[4]), -np.inf, rows[4])
        return cls(*rows)

    def pack(self) -> list[list[float | None]]:
        """Lists for strict JSON; non-finite limits (of no numbers) become null."""
        return [[float(x) if np.isfinite(x) else None for x in row] for row in self]

    def __add__(self, other: "FeatureMoments") -> "FeatureMoments":  # type: ignore[override]
        """Moments of the union of both sets of numbers (Chan, Golub and LeVeque 1979)."""
        n, difference = self.n + other.n, other.mean - self.mean
        weight = other.n / np.maximum(n, 1.0)
        mean, spread = self.mean + difference * weight, self.spread + other.spread + difference**2 * self.n * weight
        return FeatureMoments(n, mean, spread, np.minimum(self.low, other.low), np.maximum(self.high, other.high))

    def stats(self, frames: int, shape: Sequence[int]) -> dict[str, Any] | None:
        """The entry of ``meta/stats`` with values of ``shape``; None where a channel has no number."""
        if not (self.n > 0).all():
            return None
        values = {"min": self.low, "max": self.high, "mean": self.mean, "std": np.sqrt(self.spread / self.n)}
        return {**{k: x.reshape(shape).tolist() for k, x in values.items()}, "count": [frames]}


class LogHistogram(NamedTuple):
    """Counts of positive numbers in bins of equal ratio, of which robust ranges are computed; sums combine sets."""

    counts: np.ndarray  # (N_BINS,) int64

    @classmethod
    def of(cls, values: np.ndarray) -> "LogHistogram":
        """Histogram of the numbers above 0; the others are left out."""
        x = np.asarray(values, np.float64)
        place = np.floor((np.log2(x[np.isfinite(x) & (x > 0)]) - _OCTAVES[0]) * _BINS_PER_OCTAVE)
        return cls(np.bincount(place.clip(0, N_BINS - 1).astype(np.int64), minlength=N_BINS))

    @classmethod
    def parse(cls, packed: Sequence[Sequence[int]]) -> "LogHistogram":
        """Inverse of :meth:`pack`."""
        counts = np.zeros(N_BINS, np.int64)
        for place, count in packed:
            counts[place] = count
        return cls(counts)

    def pack(self) -> list[list[int]]:
        """Lists (bin, count) of the bins that are not empty, for JSON."""
        return [[int(place), int(self.counts[place])] for place in np.flatnonzero(self.counts)]

    def __add__(self, other: "LogHistogram") -> "LogHistogram":  # type: ignore[override]
        """Histogram of both sets of numbers."""
        return LogHistogram(self.counts + other.counts)

    def quantile(self, fraction: float) -> float:
        """Value below which a fraction of the numbers is, exact to a bin's width; NaN = of no numbers."""
        sums = np.cumsum(self.counts)
        if not sums[-1]:
            return float("nan")
        target = fraction * sums[-1]
        place = int(np.searchsorted(sums, target))
        inside = (target - (sums[place] - self.counts[place])) / max(self.counts[place], 1)
        return float(2.0 ** (_OCTAVES[0] + (place + inside) / _BINS_PER_OCTAVE))

    def stats(self, moments: FeatureMoments, frames: int, shape: Sequence[int]) -> dict[str, Any]:
        """The entry of ``meta/stats`` of a map: over its answered pixels, with the 1 % and 99 % quantiles as range.

        A few wrong depths decide over the extremes, and thereby over a policy's normalisation. A map without any
        answer has the entry that changes nothing: mean 0, standard deviation 1, range 0 to 1.
        """
        if not self.counts.any():
            values = {"min": 0.0, "max": 1.0, "mean": 0.0, "std": 1.0} | dict.fromkeys(_QUANTILES, 0.0)
            values["q99"] = 1.0
        else:
            values = {name: self.quantile(fraction) for name, fraction in _QUANTILES.items()}
            low, high = float(moments.low[0]), float(moments.high[0])
            values = {name: min(max(value, low), high) for name, value in values.items()}
            std = float(np.sqrt(moments.spread[0] / moments.n[0]))
            values |= {"min": values["q01"], "max": values["q99"], "mean": float(moments.mean[0]), "std": std}
        return {**{k: np.full(shape, x).tolist() for k, x in values.items()}, "count": [frames]}


#: Bins of a :class:`LogHistogram`.
N_BINS = (_OCTAVES[1] - _OCTAVES[0]) * _BINS_PER_OCTAVE


# -------------------------------------------------------------------------------------------------------- features


def number_feature(kind: str, n: int = 1, names: Sequence[str] | None = None) -> FeatureSpec:
    """Specification of a feature with ``n`` numbers per frame."""
    return {"dtype": kind, "shape": [n], "names": None if names is None else list(names)}


def image_feature(hw: Sequence[int], channels: int = 3, **info: Any) -> FeatureSpec:
    """Specification of a feature of images in the table."""
    return {"dtype": "image", "shape": [*hw, channels], "names": list(_HWC_NAMES), **({"info": info} if info else {})}


def map_feature(hw: Sequence[int], kind: str, **info: Any) -> FeatureSpec:
    """Specification of a map (1, h, w) of numbers in the table."""
    return {"dtype": kind, "shape": [1, *hw], "names": list(_CHW_NAMES), "info": info}


def depth_feature(hw: Sequence[int], step: float, *, as_image: bool) -> FeatureSpec:
    """Specification of depth maps in metres (see the module), whose values are multiples of ``step`` m.

    An array of numbers has no ``depth_unit``: LeRobot 0.6 would convert the statistics of the feature into its output
    unit, and not the numbers.
    """
    info = {"is_depth_map": True, "quantiser_step_m": step, "no_depth": 0.0}
    return image_feature(hw, 1, depth_unit="m", **info) if as_image else map_feature(hw, "float32", unit="m", **info)


def make_arrow_schema(
    features: Mapping[str, FeatureSpec], types: Mapping[str, Any], metadata: Mapping[bytes, bytes]
) -> Any:
    """Arrow schema of a table: ``types`` where a column has one already, else by its feature; videos have no column."""
    import pyarrow  # noqa: PLC0415

    cell = pyarrow.struct([("bytes", pyarrow.binary()), ("path", pyarrow.string())])
    fields = []
    columns: dict[str, Any] = {}  # by which the library ``datasets`` recognises image and array columns
    for key, feature in features.items():
        if feature["dtype"] == "video":
            continue
        dtype, shape = feature["dtype"], list(feature["shape"])
        value = {"dtype": dtype, "_type": "Value"}
        if dtype == "image":
            columns[key] = {"_type": "Image"}
        elif shape in ([], [1]):
            columns[key] = value
        elif len(shape) == 1:
            columns[key] = {"feature": value, "length": shape[0], "_type": "Sequence"}
        else:
            columns[key] = {"shape": shape, "dtype": dtype, "_type": f"Array{len(shape)}D"}
        kind = types.get(key)
        if kind is None and feature["dtype"] == "image":
            kind = cell
        elif kind is None:
            kind = pyarrow.from_numpy_dtype(np.dtype(feature["dtype"]))
            if len(feature["shape"]) > 1:
                for _ in feature["shape"]:  # lists in lists, as the library datasets stores arrays
                    kind = pyarrow.list_(kind)
            elif list(feature["shape"]) != [1]:
                kind = pyarrow.list_(kind, feature["shape"][0])
        fields.append(pyarrow.field(key, kind))
    huggingface = json.dumps({"info": {"features": columns}}).encode()
    return pyarrow.schema(fields, metadata={**dict(metadata), b"huggingface": huggingface})


def nested_lists(values: np.ndarray) -> Any:
    """Array (n, …) -> Arrow column of n nested lists."""
    import pyarrow  # noqa: PLC0415

    column = pyarrow.array(np.ascontiguousarray(values).reshape(-1))
    for axis in range(values.ndim - 1, 0, -1):
        offsets = np.arange(int(np.prod(values.shape[:axis])) + 1, dtype=np.int64) * values.shape[axis]
        column = pyarrow.ListArray.from_arrays(pyarrow.array(offsets.astype(np.int32)), column)
    return column


# ----------------------------------------------------------------------------------------------------------- places


def episode_table_path(version: int, number: int) -> str:
    """Relative path of an episode's table."""
    return _fill_template(_PATH_TEMPLATES[version][0], *divmod(number, FILES_PER_CHUNK), number)


def episode_video_path(version: int, key: str, clip: VideoSegment, number: int) -> str:
    """Relative path of an episode's video."""
    return _fill_template(_PATH_TEMPLATES[version][1].replace("{video_key}", key), clip.chunk, clip.file, number)


def _fill_template(template: str, chunk: int, file: int, number: int) -> str:
    return template.format(
        chunk_index=chunk, file_index=file, episode_chunk=number // FILES_PER_CHUNK, episode_index=number
    )


# ------------------------------------------------------------------------------------------------------------- meta


def make_info(
    version: int,
    features: Mapping[str, FeatureSpec],
    episodes: Sequence[EpisodeSpec],
    *,
    fps: float,
    n_tasks: int,
    robot: str,
) -> dict[str, Any]:
    """Contents of ``meta/info.json``."""
    data, video = _PATH_TEMPLATES[version]
    videos = [key for key, feature in features.items() if feature["dtype"] == "video"]
    first, last = episodes[0].number, episodes[-1].number
    counts = (
        {"total_videos": len(videos) * len(episodes), "total_chunks": last // FILES_PER_CHUNK + 1}
        if version == 2
        else {}
    )
    sizes = {} if version == 2 else {"data_files_size_in_mb": 100, "video_files_size_in_mb": 200}
    return {
        "codebase_version": _CODEBASE_VERSIONS[version],
        "robot_type": robot,
        "total_episodes": len(episodes),
        "total_frames": sum(episode.length for episode in episodes),
        "total_tasks": n_tasks,
        **counts,
        "chunks_size": FILES_PER_CHUNK,
        **sizes,
        "fps": int(fps) if float(fps).is_integer() else fps,
        "splits": {"train": f"{first}:{last + 1}"},
        "data_path": data,
        "video_path": video if videos else None,
        "features": dict(features),
    }


#: LeRobot version → names below ``meta/`` of the files that :func:`write_lerobot_meta` writes.
META_FILES = {
    2: ("episodes.jsonl", "tasks.jsonl", "episodes_stats.jsonl", "stats.json", "info.json"),
    3: ("episodes/chunk-000/file-000.parquet", "tasks.parquet", "stats.json", "info.json"),
}


def write_lerobot_meta(
    root: Path,
    version: int,
    about: Mapping[str, Any],  # contents of info.json, see make_info
    episodes: Sequence[EpisodeSpec],
    tasks: Sequence[str],  # by task_index
    stats: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Write the files below ``meta/`` atomically → their paths; ``info.json``, which marks a data set, is last."""
    meta, written = root / "meta", []
    if version == 2:
        rows = [{"episode_index": e.number, "tasks": list(e.tasks), "length": e.length} for e in episodes]
        written.append(_write_json_lines(meta / "episodes.jsonl", rows))
        task_rows = [{"task_index": k, "task": task} for k, task in enumerate(tasks)]
        written.append(_write_json_lines(meta / "tasks.jsonl", task_rows))
        if stats is not None:
            stat_rows = [{"episode_index": e.number, "stats": e.stats} for e in episodes]
            written.append(_write_json_lines(meta / "episodes_stats.jsonl", stat_rows))
    else:
        places = [divmod(e.number, FILES_PER_CHUNK) for e in episodes]
        columns: dict[str, list[Any]] = {
            "episode_index": [e.number for e in episodes],
            "tasks": [list(e.tasks) for e in episodes],
            "length": [e.length for e in episodes],
            "data/chunk_index": [chunk for chunk, _ in places],
            "data/file_index": [file for _, file in places],
            "dataset_from_index": [e.start for e in episodes],
            "dataset_to_index": [e.start + e.length for e in episodes],
        }
        for key in episodes[0].videos:
            clips = [e.videos[key] for e in episodes]
            ends = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
            columns |= {f"videos/{key}/{name}": list(x) for name, x in zip(ends, zip(*clips, strict=True), strict=True)}
        zeros = [0] * len(episodes)
        columns = columns | {"meta/episodes/chunk_index": zeros, "meta/episodes/file_index": zeros}
        written.append(_write_table(meta / "episodes" / "chunk-000" / "file-000.parquet", columns))
        numbered: dict[str, list[Any]] = {"task_index": list(range(len(tasks))), "task": list(tasks)}
        written.append(_write_table(meta / "tasks.parquet", numbered, index="task"))
    if stats is not None:
        written.append(storage.write_json(meta / "stats.json", stats))
    return [*written, storage.write_json(meta / "info.json", about)]


def _write_json_lines(path: Path, rows: Iterable[Any]) -> Path:
    return storage.replace_file(path, "".join(storage.dump_strict_json(row) + "\n" for row in rows).encode())


def _write_table(path: Path, columns: Mapping[str, list[Any]], index: str | None = None) -> Path:
    """Write a small parquet table; ``index`` is the column that pandas uses as index."""
    import pyarrow  # noqa: PLC0415
    from pyarrow import parquet  # noqa: PLC0415

    table = pyarrow.table(dict(columns))
    if index is not None:
        pandas_types = {name: "unicode" if isinstance(cells[0], str) else "int64" for name, cells in columns.items()}
        column_entries = [
            {
                "name": name,
                "field_name": name,
                "pandas_type": pandas_type,
                "numpy_type": pandas_type.replace("unicode", "object"),
            }
            for name, pandas_type in pandas_types.items()
        ]
        pandas_metadata = {
            "index_columns": [index],
            "column_indexes": [],
            "columns": column_entries,
            "pandas_version": "2.0.0",
        }
        table = table.replace_schema_metadata({b"pandas": json.dumps(pandas_metadata).encode()})
    sink = pyarrow.BufferOutputStream()
    parquet.write_table(table, sink)
    return storage.replace_file(path, sink.getvalue().to_pybytes())
