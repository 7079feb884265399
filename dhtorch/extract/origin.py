"""Where the rows of a new data set come from: a LeRobot data set's own tables and videos, or a recording's frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dhtorch.data.io import decode as files
from dhtorch.data.io import safe_open as doors
from dhtorch.data.io.decode import FormatError, import_optional
from dhtorch.data.readers.lerobot_meta import LeRobotEpisodes, LeRobotMeta, read_lerobot_episodes, read_lerobot_meta
from dhtorch.data.recording import Recording
from dhtorch.export import lerobot as out

#: Rows that are held together.
TABLE_GROUP_ROWS = 8

#: Frames a second where nothing tells.
DEFAULT_FPS = 30.0

#: Files of ``meta/`` that are written anew.
_REWRITTEN_META_FILES = (
    "info.json",
    "stats.json",
    "tasks.parquet",
    "tasks.jsonl",
    "episodes.jsonl",
    "episodes_stats.jsonl",
    "intrinsics.json",
)


class DatasetSource(Protocol):
    """A data set with episodes: what it holds beside the depth that is to be added."""

    @property
    def version(self) -> int | None:
        """Of LeRobot's format; None = another."""

    @property
    def tasks(self) -> tuple[str, ...] | None:
        """Texts by ``task_index``; None = numbered as they come."""

    @property
    def features(self) -> dict[str, out.FeatureSpec]:
        """Of its columns and videos, as LeRobot describes them."""

    @property
    def fps(self) -> float:
        """Rows a second."""

    @property
    def robot(self) -> str:
        """Its name."""

    @property
    def splits(self) -> dict[str, list[int]]:
        """Name of a split → numbers of its episodes."""

    @property
    def more(self) -> dict[str, Path]:
        """Other files of the set: relative name → file."""

    def batches(self, i: int, tasks: list[str]) -> Iterator[Any]:
        """The rows of an episode in their order, as Arrow tables of few; texts not among the ``tasks`` join them."""

    def clips(self, i: int, length: int) -> dict[str, tuple[Path, out.VideoSegment]]:
        """Video key → its file and place, of episode ``i`` of those that were opened."""

    def words(self, i: int) -> list[str] | None:
        """The tasks that are noted for an episode; None = those of its rows."""

    def about(self, i: int) -> dict[str, Any]:
        """What else is said of an episode; ``split`` is the one that it belongs to."""


@dataclass(frozen=True, eq=False)
class LeRobotSource:
    """A LeRobot data set: see :class:`DatasetSource`."""

    meta: LeRobotMeta
    info: dict[str, Any]
    episodes: LeRobotEpisodes
    tasks: tuple[str, ...]
    limit: int | None = None
    bounds: Path | None = None  # no link below it may lead out of it; None = links are followed

    @classmethod
    def open(
        cls, root: Path, numbers: Sequence[int], *, limit: int | None = None, bounds: Path | None = None
    ) -> LeRobotSource:
        """The set at ``root`` with those of its episodes, ``limit`` rows of each at most.

        Raises:
            FormatError: damaged metadata.
        """
        meta = read_lerobot_meta(root)
        info = files.read_json(root / "meta" / "info.json")
        return cls(meta, info, read_lerobot_episodes(meta, numbers), tuple(_read_tasks(meta)), limit, bounds)

    @property
    def version(self) -> int:
        """Of the format."""
        return self.meta.version

    @property
    def fps(self) -> float:
        """Rows a second."""
        return self.meta.fps

    @property
    def robot(self) -> str:
        """Its name."""
        return str(self.info.get("robot_type") or "unknown")

    @property
    def splits(self) -> dict[str, list[int]]:
        """Name → numbers of the episodes that were opened; none where the info does not say it as LeRobot does."""
        found: dict[str, list[int]] = {}
        said = self.info.get("splits")
        for name, span in said.items() if isinstance(said, dict) else ():
            first, colon, last = str(span).partition(":")
            if colon and first.isdigit() and last.isdigit():
                found[str(name)] = [k for k in map(int, self.episodes.numbers) if int(first) <= k < int(last)]
        return {name: numbers for name, numbers in found.items() if numbers}

    def about(self, i: int) -> dict[str, Any]:
        """What else is said of an episode: nothing that is not copied."""
        return {}

    @property
    def features(self) -> dict[str, out.FeatureSpec]:
        """Of its columns and videos, as its info has them, without videos that no episode has."""
        last = range(len(self.episodes))
        gone = {k for k in self.meta.videos if not any(self.episodes[i].videos[k][0].is_file() for i in last)}
        return {k: dict(f) for k, f in self.info["features"].items() if k not in gone}

    def clips(self, i: int, length: int) -> dict[str, tuple[Path, out.VideoSegment]]:
        """Video key → its file and place, of episode ``i`` of those that were opened.

        Raises:
            FormatError: a missing file.
        """
        episode, found = self.episodes[i], {}
        for key in (k for k, f in self.features.items() if f["dtype"] == "video"):
            file, start = episode.videos[key]
            if not file.is_file():
                raise FormatError(file, key, "no such file", f"the video of episode {episode.number}")
            if not self._stays(file):
                raise FormatError(file, key, "a link that leads out of the data set", "a file inside, or follow_links")
            chunk, number = divmod(episode.number, out.FILES_PER_CHUNK)
            if self.meta.version == 3:
                places = (self.episodes.columns[f"videos/{key}/{name}"][i] for name in ("chunk_index", "file_index"))
                chunk, number = map(int, places)
            found[key] = file, out.VideoSegment(chunk, number, float(start), float(start) + length / self.meta.fps)
        return found

    def _stays(self, path: Path) -> bool:
        return self.bounds is None or doors.is_inside(path, self.bounds)

    def batches(self, i: int, tasks: list[str]) -> Iterator[Any]:
        """As :meth:`DatasetSource.batches`; ``frame_index`` and ``task_index`` are added where they are missing."""
        pyarrow, dataset = import_optional("pyarrow", extra="scale"), import_optional("pyarrow.dataset", extra="scale")
        episode = self.episodes[i]
        table = dataset.dataset(str(episode.data), format="parquet")
        own = "episode_index" in table.schema.names
        rows = dataset.field("episode_index") == episode.number if own else None
        scan = table.scanner(filter=rows, batch_size=TABLE_GROUP_ROWS, use_threads=False, batch_readahead=1)
        done, first = 0, 0.0
        for batch in scan.to_batches():
            if not batch.num_rows or done == self.limit:
                continue
            part = pyarrow.Table.from_batches([batch])
            part = part if self.limit is None else part.slice(0, self.limit - done)
            if "frame_index" not in part.column_names:
                first = part.column("timestamp")[0].as_py() if not done else first
                part = _with_frame_index(part, done, first)
            yield _with_task_index(part)
            done += part.num_rows

    def words(self, i: int) -> list[str] | None:
        """The tasks that ``meta/`` notes for an episode; None = none noted."""
        number = int(self.episodes.numbers[i])
        return _read_episode_tasks(self.meta).get(number)

    @property
    def more(self) -> dict[str, Path]:
        """Other files of the set: relative name → file."""
        root = self.meta.root
        found = [*(p for p in root.iterdir() if p.is_file()), *(root / "meta").iterdir()]
        kept = (p for p in sorted(found) if p.is_file() and p.name not in _REWRITTEN_META_FILES and self._stays(p))
        return {str(p.relative_to(root)): p for p in kept}


def _with_frame_index(part: Any, done: int, first: float) -> Any:
    """Rows without ``frame_index``, numbered in their order; times that begin elsewhere begin at 0."""
    pyarrow = import_optional("pyarrow", extra="scale")
    stamp = part.column("timestamp").to_numpy()
    part = part.append_column("frame_index", pyarrow.array(done + np.arange(len(stamp))))
    if not first:
        return part
    place = part.column_names.index("timestamp")
    part = part.append_column("source.timestamp", part.column("timestamp"))
    return part.set_column(place, "timestamp", pyarrow.array((stamp - first).astype(stamp.dtype)))


def _with_task_index(part: Any) -> Any:
    """Rows with the number of their task; the first where none is noted."""
    pyarrow = import_optional("pyarrow", extra="scale")
    if "task_index" in part.column_names:
        return part
    return part.append_column("task_index", pyarrow.array(np.zeros(part.num_rows, np.int64)))


def _read_tasks(meta: LeRobotMeta) -> list[str]:
    """Texts by ``task_index``; one that is not there is empty."""
    lines, table = meta.root / "meta" / "tasks.jsonl", meta.root / "meta" / "tasks.parquet"
    found: dict[int, str] = {}
    if lines.is_file():
        for text in files.read_text(lines).splitlines():
            row = files.decode_json(text, lines) if text.strip() else None
            if row is not None:
                found[files.get_entry(row, "task_index", int, lines)] = files.get_entry(row, "task", str, lines)
    elif table.is_file():
        read = import_optional("pyarrow.parquet", extra="scale").read_table(table)
        names = [name for name in read.column_names if name != "task_index"]
        if "task_index" not in read.column_names or not names:
            raise FormatError(table, "columns", ", ".join(read.column_names), "task_index and task")
        texts = read.column("task" if "task" in names else names[-1]).to_pylist()
        found = dict(zip(read.column("task_index").to_pylist(), map(str, texts), strict=True))
    if any(k is None or not 0 <= k < 10**6 for k in found):
        raise FormatError(lines if lines.is_file() else table, "task_index", sorted(found, key=str)[0], "a count")
    return [found.get(k, "") for k in range(max(found, default=0) + 1)]


def _read_episode_tasks(meta: LeRobotMeta) -> dict[int, list[str]]:
    lines, found = meta.root / "meta" / "episodes.jsonl", {}
    if meta.version == 2:
        for text in files.read_text(lines).splitlines():
            row = files.decode_json(text, lines) if text.strip() else {}
            if isinstance(row.get("tasks"), list):
                found[row["episode_index"]] = [str(task) for task in row["tasks"]]
        return found
    parquet = import_optional("pyarrow.parquet", extra="scale")
    for table in sorted((meta.root / "meta" / "episodes").glob("*/*.parquet")):
        if "tasks" in parquet.read_schema(table).names:
            read = parquet.read_table(table, columns=["episode_index", "tasks"])
            rows = zip(read.column("episode_index").to_pylist(), read.column("tasks").to_pylist(), strict=True)
            found |= {number: list(tasks) for number, tasks in rows if isinstance(tasks, list)}
    return found


def has_frame_rate(recording: Recording) -> bool:
    """Whether a recording tells how often it has a frame."""
    return recording.rate_hz is not None or (recording.times is not None and len(recording) > 1)


def frame_rate(recording: Recording) -> float:
    """Frames a second: nominal, else by the median step between time stamps, else :data:`DEFAULT_FPS`."""
    if recording.rate_hz is not None:
        return recording.rate_hz
    if recording.times is None or len(recording) < 2:
        return DEFAULT_FPS
    steps = recording.times.diff() / recording.number.diff()
    step = float(steps.median())
    return round(1 / step, 3) if step > 0 else DEFAULT_FPS
