"""Sources of an enriched data set: tables and videos of a LeRobot data set, frame rate of a recording."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data.codecs.parquet import read_columns, read_parquet_header
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError, import_optional
from dhtorch.data.readers.lerobot_meta import LeRobotEpisodes, LeRobotMeta, read_lerobot_episodes, read_lerobot_meta
from dhtorch.data.recording import Recording
from dhtorch.export import lerobot as out
from dhtorch.runtime import safe_open as doors
from dhtorch.runtime.safe_open import is_inside

#: Rows of one Arrow table in memory.
TABLE_GROUP_ROWS = 8

#: Frames per second if a recording has neither a rate nor time stamps.
DEFAULT_FPS = 30.0

#: Largest number of tasks of a data set. Source: derived, more than the episodes of any published set.
_MAX_TASKS = 10**6

#: Data set card of the source beside that of the enriched set.
SOURCE_CARD = "README.source.md"

#: Files of ``meta/`` that state which run wrote an enriched set, and with which result: those of a source that is one
#: itself are not copied.
METADATA_FILE, REPORT_FILES = "dhtorch.json", ("report.json", "report.html")

#: Files that are rewritten or belong to the source's own run, and are not copied.
_REWRITTEN_META_FILES = (
    METADATA_FILE,
    *REPORT_FILES,
    SOURCE_CARD,
    "info.json",
    "stats.json",
    "tasks.parquet",
    "tasks.jsonl",
    "episodes.jsonl",
    "episodes_stats.jsonl",
    "intrinsics.json",
    "source_features.json",
)


class DatasetSource:
    """A data set with episodes: its content that an enriched data set copies. What a format lacks is empty."""

    version: int | None = None  # of LeRobot's format; None = another format
    tasks: tuple[str, ...] | None = None  # texts by ``task_index``; None = numbered in order of appearance
    fps: float  # rows per second
    robot: str = "unknown"
    root: Path | None = None  # of the files that image cells name; None = cells hold images
    bounds: Path | None = None  # folder that links must not lead out of; None = links are followed

    @property
    def features(self) -> dict[str, out.FeatureSpec]:
        """LeRobot features of its columns and videos."""
        raise NotImplementedError

    @property
    def splits(self) -> dict[str, list[int]]:
        """Split name → episode numbers."""
        return {}

    @property
    def more(self) -> dict[str, Path]:
        """Other files of the data set: relative name → file."""
        return {}

    def meta_file(self, name: str) -> dict[str, Any]:
        """Object in a JSON file of LeRobot's ``meta/``; empty if there is none."""
        return {}

    def batches(self, i: int, tasks: list[str]) -> Iterator[Any]:
        """Rows of episode ``i`` in order, as Arrow tables of few rows; new task texts are appended to ``tasks``."""
        raise NotImplementedError

    def clips(self, i: int, length: int) -> dict[str, tuple[Path, out.VideoSegment]]:
        """Video key → file and segment of the ``i``-th opened episode of ``length`` rows."""
        return {}

    def words(self, i: int) -> list[str] | None:
        """Task texts in the metadata of episode ``i``; None = those of its rows."""
        return None

    def about(self, i: int) -> dict[str, Any]:
        """Other metadata of episode ``i``; ``split`` is the name of its split."""
        return {}


@dataclass(frozen=True, eq=False, kw_only=True)
class LeRobotSource(DatasetSource):
    """A LeRobot data set: see :class:`DatasetSource`."""

    meta: LeRobotMeta
    info: dict[str, Any]
    episodes: LeRobotEpisodes
    tasks: tuple[str, ...]
    version: int
    fps: float
    root: Path
    robot: str
    limit: int | None = None
    bounds: Path | None = None

    @classmethod
    def open(
        cls, root: Path, numbers: Sequence[int], *, limit: int | None = None, bounds: Path | None = None
    ) -> "LeRobotSource":
        """Folder and episode numbers -> source with at most ``limit`` rows per episode.

        Raises:
            FormatError: damaged metadata.
        """
        with doors.restrict_links(bounds):
            meta = read_lerobot_meta(root)
            info = files.read_json(root / "meta" / "info.json")
            episodes = read_lerobot_episodes(meta, numbers)
            lines, table = root / "meta" / "tasks.jsonl", root / "meta" / "tasks.parquet"
            named: dict[int, str] = {}  # texts by task_index
            if lines.is_file():
                for text in files.read_text(lines).splitlines():
                    row = files.decode_json(text, lines) if text.strip() else None
                    if row is not None:
                        task = files.get_entry(row, "task", str, lines)
                        named[files.get_entry(row, "task_index", int, lines)] = task
            elif table.is_file():
                names = [name for name in read_parquet_header(table).columns if name != "task_index"]
                name = "task" if "task" in names else names[-1] if names else "task"
                content = read_columns(table, ["task_index", name])
                indices = np.asarray(content["task_index"])
                if indices.dtype.kind not in "iu":
                    raise FormatError(table, "task_index", f"{indices.dtype} {indices[:1].tolist()}", "whole numbers")
                named = dict(zip(indices.tolist(), map(str, content[name]), strict=True))
            if any(not 0 <= k < _MAX_TASKS for k in named):
                file = lines if lines.is_file() else table
                raise FormatError(file, "task_index", min(named), f"0 to {_MAX_TASKS - 1}")
            tasks = tuple(named.get(k, "") for k in range(max(named, default=0) + 1))  # missing ones are empty
        return cls(
            meta=meta,
            info=info,
            episodes=episodes,
            tasks=tasks,
            limit=limit,
            bounds=bounds,
            version=meta.version,
            fps=meta.fps,
            root=meta.root,
            robot=str(info.get("robot_type") or "unknown"),
        )

    @property
    def features(self) -> dict[str, out.FeatureSpec]:
        """Features in its info, without videos that no opened episode has."""
        videos = [self.episodes[i].videos for i in range(len(self.episodes))]
        missing = {key for key in self.meta.videos if not any(each[key][0].is_file() for each in videos)}
        return {k: dict(f) for k, f in self.info["features"].items() if k not in missing}

    def meta_file(self, name: str) -> dict[str, Any]:
        """As :meth:`DatasetSource.meta_file`."""
        file = self.meta.root / "meta" / name
        content = files.read_json(file) if file.is_file() and self._is_inside(file) else {}
        return content if isinstance(content, dict) else {}

    @property
    def splits(self) -> dict[str, list[int]]:
        """Split name → numbers of the opened episodes; empty if the info has no splits in LeRobot's form."""
        episodes: dict[str, list[int]] = {}
        splits = self.info.get("splits")
        for name, span in splits.items() if isinstance(splits, dict) else ():
            first, colon, last = str(span).partition(":")
            if colon and first.isdigit() and last.isdigit():
                episodes[str(name)] = [k for k in map(int, self.episodes.numbers) if int(first) <= k < int(last)]
        return {name: numbers for name, numbers in episodes.items() if numbers}

    def clips(self, i: int, length: int) -> dict[str, tuple[Path, out.VideoSegment]]:
        """Video key → file and segment of the ``i``-th opened episode of ``length`` rows.

        Raises:
            FormatError: a missing file, or a link that leads out of the data set.
        """
        episode, clips = self.episodes[i], {}
        for key in (k for k, f in self.features.items() if f["dtype"] == "video"):
            file, start = episode.videos[key]
            if not file.is_file():
                raise FormatError(file, key, "no such file", f"the video of episode {episode.number}")
            if not self._is_inside(file):
                raise FormatError(file, key, "a link that leads out of the data set", "a file inside, or follow_links")
            chunk, number = divmod(episode.number, out.FILES_PER_CHUNK)
            if self.meta.version == 3:
                indices = (self.episodes.columns[f"videos/{key}/{name}"][i] for name in ("chunk_index", "file_index"))
                chunk, number = map(int, indices)
            clips[key] = file, out.VideoSegment(chunk, number, float(start), float(start) + length / self.meta.fps)
        return clips

    def _is_inside(self, path: Path) -> bool:
        """Whether a path may be read: inside ``bounds`` after resolving links."""
        return self.bounds is None or is_inside(path, self.bounds)

    def batches(self, i: int, tasks: list[str]) -> Iterator[Any]:
        """As :meth:`DatasetSource.batches`; missing ``frame_index`` and ``task_index`` are added.

        Raises:
            FormatError: a damaged table, a link that leads out of the data set, or a ``task_index`` that is no count.
        """
        pyarrow, file = import_optional("pyarrow"), self.episodes[i].data
        try:
            for part in self._scan(i):
                for value in part.column("task_index").to_pylist():
                    is_number = isinstance(value, int | float) and not isinstance(value, bool)
                    if value is not None and not (is_number and 0 <= value < _MAX_TASKS and value == int(value)):
                        raise FormatError(file, "task_index", value, f"a whole number from 0 to {_MAX_TASKS - 1}")
                yield part
        except (pyarrow.ArrowException, OSError) as error:
            raise FormatError(file, "rows", error, "decodable columns") from None

    def _scan(self, i: int) -> Iterator[Any]:
        """Rows of episode ``i`` with ``frame_index`` and ``task_index``."""
        pyarrow, dataset = import_optional("pyarrow"), import_optional("pyarrow.dataset")
        episode = self.episodes[i]
        with doors.restrict_links(self.bounds):
            read_parquet_header(episode.data)
        table = dataset.dataset(str(episode.data), format="parquet")
        has_episodes = "episode_index" in table.schema.names
        rows = dataset.field("episode_index") == episode.number if has_episodes else None
        scan = table.scanner(filter=rows, batch_size=TABLE_GROUP_ROWS, use_threads=False, batch_readahead=1)
        done, first = 0, 0.0
        for batch in scan.to_batches():
            if not batch.num_rows or done == self.limit:
                continue
            part = pyarrow.Table.from_batches([batch])
            part = part if self.limit is None else part.slice(0, self.limit - done)
            if "frame_index" not in part.column_names:  # counted, with time stamps from 0
                stamp = part.column("timestamp").to_numpy()
                first = part.column("timestamp")[0].as_py() if not done else first
                part = part.append_column("frame_index", pyarrow.array(done + np.arange(len(stamp))))
                if first:
                    place = part.column_names.index("timestamp")
                    part = part.append_column("source.timestamp", part.column("timestamp"))
                    part = part.set_column(place, "timestamp", pyarrow.array((stamp - first).astype(stamp.dtype)))
            if "task_index" not in part.column_names:
                part = part.append_column("task_index", pyarrow.array(np.zeros(part.num_rows, np.int64)))
            yield part
            done += part.num_rows

    def words(self, i: int) -> list[str] | None:
        """Task texts of episode ``i`` in ``meta/``; None = none."""
        episode_tasks: dict[int, list[str]] = {}
        with doors.restrict_links(self.bounds):
            if self.meta.version == 2:
                lines = self.meta.root / "meta" / "episodes.jsonl"
                for text in files.read_text(lines).splitlines():
                    row = files.decode_json(text, lines) if text.strip() else {}
                    if isinstance(row, dict) and isinstance(row.get("tasks"), list):
                        number = files.get_entry(row, "episode_index", int, lines)
                        episode_tasks[number] = [str(task) for task in row["tasks"]]
                return episode_tasks.get(int(self.episodes.numbers[i]))
            for table in sorted((self.meta.root / "meta" / "episodes").glob("*/*.parquet")):
                if "tasks" in read_parquet_header(table).columns:
                    content = read_columns(table, ["episode_index", "tasks"])
                    rows = zip(np.asarray(content["episode_index"]).tolist(), content["tasks"], strict=True)
                    episode_tasks |= {number: [*map(str, tasks)] for number, tasks in rows if isinstance(tasks, list)}
            return episode_tasks.get(int(self.episodes.numbers[i]))

    @property
    def more(self) -> dict[str, Path]:
        """Other files of the data set: relative name → file."""
        root = self.meta.root
        files = [*(p for p in root.iterdir() if p.is_file()), *(root / "meta").iterdir()]
        kept = (p for p in sorted(files) if p.is_file() and p.name not in _REWRITTEN_META_FILES and self._is_inside(p))
        return {str(p.relative_to(root)): p for p in kept}


def has_frame_rate(recording: Recording) -> bool:
    """Whether a recording has a nominal rate, or time stamps to compute one."""
    return recording.rate_hz is not None or (recording.times is not None and len(recording) > 1)


def frame_rate(recording: Recording) -> float:
    """Recording -> frames per second: nominal, else from the median time step, else :data:`DEFAULT_FPS`."""
    if recording.rate_hz is not None:
        return recording.rate_hz
    if recording.times is None or len(recording) < 2:
        return DEFAULT_FPS
    steps = recording.times.diff() / recording.number.diff()
    step = float(steps.median())
    return round(1 / step, 3) if step > 0 else DEFAULT_FPS
