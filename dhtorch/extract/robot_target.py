"""An enriched data set as LeRobot's tables: an episode is one file, which is joined from its shards and its origin."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.codes import names
from dhtorch.data.io.decode import import_optional
from dhtorch.export import lerobot
from dhtorch.export.lerobot import FeatureMoments, FeatureSpec
from dhtorch.extract.columns import Column
from dhtorch.extract.enriched import (
    MAP_FILES,
    MAP_STEPS,
    NUMBER_COLUMNS,
    DatasetCamera,
    blank_maps,
    number_column,
)
from dhtorch.extract.instants import PeekableRows, iter_groups, iter_instants, iter_rows
from dhtorch.extract.origin import DatasetSource, LeRobotSource
from dhtorch.extract.targets import MapCounts, Row
from dhtorch.runtime import storage

#: Metadata of an episode: what its rows amount to.
_EPISODE_METADATA_KEY = b"dhtorch.episode"

_DEFAULT_TASK = "look around"


class LeRobotTarget:
    """LeRobot tables.

    Args:
        root: of the new set.
        version: 3, or 2 for v2.1.
        views: its cameras.
        origin: the data set it comes from; None = recordings, whose pictures are in the shards.
        numbers: of the episodes at their source.
        step: m, of the depth maps.
        fps: of a recording.
        task: of a recording.
        key: of the settings and data, which every table notes.
        n: samples of a frame, where columns of them are in the set.
        cut: some rows of the origin are left out, so that others have another index.

    Raises:
        ValueError: columns that the source has already, names that are no file's, or videos that this version would
            have to cut.
    """

    def __init__(
        self,
        root: Path,
        version: int,
        views: Mapping[str, DatasetCamera],
        *,
        origin: DatasetSource | None,
        numbers: Sequence[int],
        step: float,
        fps: float,
        task: str | None,
        key: str,
        n: int = 0,
        cut: bool = False,
    ) -> None:
        self.root, self.version, self.views = root, version, views
        self.origin, self.numbers, self.step, self.fps = origin, numbers, step, fps
        self.tasks = origin.tasks if origin is not None else (task or _DEFAULT_TASK,)
        self.key, self.n, self.cut = key, n, cut
        self.given: dict[str, FeatureSpec] = {} if origin is None else origin.features
        self.keys = {view.key: self._keys(view) for view in views.values()}
        self.renumbered = cut or list(numbers) != list(range(len(numbers)))
        for name in (*self.given, *views):
            if not name or any(mark in name for mark in ("/", "\\", "..", "\0")):
                raise ValueError(f"data: found a feature called {name!r}, expected a name without / and ..")
        if version == 2 and isinstance(origin, LeRobotSource) and origin.version == 3:
            _refuse_shared_videos(origin)

    # -------------------------------------------------------------------------------------------------- the columns

    def _keys(self, view: DatasetCamera) -> dict[str, str]:
        """What is added for a camera: kind → column."""
        depth = f"{view.key}_depth"
        depth = f"{depth}_enriched" if depth in self.given else depth
        found = {
            name: f"{view.key}_dhtorch_{name}" if c.enrich == "png" else depth if name == "depth" else f"{depth}_{name}"
            for name, c in MAP_FILES.items()
        }
        found |= {key: f"observation.{view.name}.dhtorch_{key}" for key in NUMBER_COLUMNS}
        found["K"] = f"observation.{view.name}.intrinsics"
        if view.posed:
            found["pose"] = f"observation.{view.name}.T_world_from_cam"
        for kind, key in list(found.items()):
            if key in self.given and kind in ("K", "pose"):
                del found[kind]  # the source has it, value for value
            elif key in self.given:
                raise ValueError(f"data: found a column {key} in the source, expected a set that is not enriched yet")
        return found

    def added(self) -> dict[str, FeatureSpec]:
        """The features beside those of the source."""
        found: dict[str, FeatureSpec] = {}
        for key, view in self.views.items():
            of: dict[str, FeatureSpec] = {
                **{name: self._map_feature(name, view) for name in MAP_FILES},
                **{key: _number_feature(number_column(c, self.n)) for key, c in NUMBER_COLUMNS.items()},
                "K": lerobot.number_feature("float64", 9),
                "pose": lerobot.number_feature("float64", 16),
            }
            if self.origin is None:
                found[key] = lerobot.image_feature(view.hw)
            found |= {column: of[kind] for kind, column in self.keys[key].items()}
        return found

    def _map_feature(self, name: str, view: DatasetCamera) -> FeatureSpec:
        spec = MAP_FILES[name]
        if spec.enrich == "tiff":
            return lerobot.depth_feature(view.map_hw, self.step / MAP_STEPS.get(name, 1))
        table = {} if spec.codes is None else names(spec.codes)
        return lerobot.image_feature(view.map_hw, 1, codes={str(k): name.lower() for k, name in table.items()})

    def features(self, columns: Iterable[str]) -> dict[str, FeatureSpec]:
        """Of all columns of the tables, and the videos."""
        found = dict(self.given)
        for name in columns:
            if name not in found and name not in self.added():
                whole = name.removeprefix("source.") != "timestamp" and name != "observation.time"
                found[name] = lerobot.number_feature("int64" if whole else "float64")
        if "timestamp" not in self.given:
            found["timestamp"] = lerobot.number_feature("float32")
        return found | self.added()

    # ------------------------------------------------------------------------------------------------- one episode

    def file(self, k: int) -> Path:
        """The table of the ``k``-th episode."""
        return self.root / lerobot.episode_table_path(self.version, k)

    def own(self, k: int) -> Row | None:
        """As :meth:`Target.own`."""
        parquet = import_optional("pyarrow.parquet", extra="scale")
        try:
            metadata = parquet.read_metadata(self.file(k)).metadata or {}
            found: Row = storage.parse_strict_json(metadata[_EPISODE_METADATA_KEY].decode())
        except (OSError, ValueError, KeyError):
            return None
        return found if found["key"] == self.key else None

    def assemble(self, k: int, before: Sequence[Row], parts: Mapping[str, Sequence[Path]]) -> Row:
        """As :meth:`Target.assemble`."""
        parquet = import_optional("pyarrow.parquet", extra="scale")
        start = sum(each["length"] for each in before)
        tallies = {key: MapCounts() for key in self.views}
        moments: dict[str, FeatureMoments] = {}
        seen: dict[int, None] = {}
        tasks = self._tasks(before)
        clean = self.file(k)
        clean.parent.mkdir(parents=True, exist_ok=True)
        length, writer = 0, None
        with storage.write_atomically(clean, clean.with_name(f".{clean.name}.tmp")) as sink, ExitStack() as closing:
            for table in self._joined(k, start, parts, tallies, tasks):
                if writer is None:
                    layout = lerobot.make_arrow_schema(self.features(table.column_names), _column_types(table), {})
                    writer = closing.enter_context(parquet.ParquetWriter(sink, layout, compression="zstd"))
                writer.write_table(table.select(layout.names).cast(layout))
                length += table.num_rows
                seen |= dict.fromkeys(table.column("task_index").to_pylist())
                _add_moments(moments, table)
            if writer is None:
                raise ValueError(f"episode {self.numbers[k]}: found no frame that can be read, expected one")
            said = [tasks[i] for i in seen if i is not None and 0 <= i < len(tasks)]
            own = self._summary(k, start, length, said, moments, tallies)
            writer.add_key_value_metadata({_EPISODE_METADATA_KEY: storage.dump_strict_json(own)})
            self._copy_videos(k, length)
        return own

    def _tasks(self, owns: Sequence[Row]) -> list[str]:
        """Texts by ``task_index``, where they are numbered as they come those of the episodes ``owns``."""
        if self.tasks is not None:
            return list(self.tasks)
        return list(dict.fromkeys(task for own in owns for task in own["tasks"]))

    def _joined(
        self,
        k: int,
        start: int,
        parts: Mapping[str, Sequence[Path]],
        tallies: Mapping[str, MapCounts],
        tasks: list[str],
    ) -> Iterator[Any]:
        """The rows of an episode with what is added, as Arrow tables of few rows."""
        made = {key: PeekableRows(iter_rows(files)) for key, files in parts.items()}
        if self.origin is None:
            yield from self._plain(k, start, made, tallies)
            return
        done = 0
        for part in self.origin.batches(k, tasks):
            table, n = part, part.num_rows
            numbers = part.column("frame_index").to_pylist()
            for key, rows in made.items():
                found = [rows.take(i) for i in numbers]
                for row in found:
                    tallies[key].add(row)
                for column, values in self._cells(key, found, done).items():
                    table = table.append_column(column, values)
            yield self._renumbered(table, k, start + done)
            done += n

    def _plain(
        self, k: int, start: int, made: Mapping[str, PeekableRows], tallies: Mapping[str, MapCounts]
    ) -> Iterator[Any]:
        """The rows of recordings, without instants of which a frame could not be read."""
        pyarrow = import_optional("pyarrow", extra="scale")
        done = 0
        for group in iter_groups(iter_instants(made)):
            for shots in group:
                for key, row in shots.items():
                    tallies[key].add(row)
            kept = [shots for shots in group if all(row["picture"] for row in shots.values())]
            if not kept:
                continue
            at = done + np.arange(len(kept))
            first = [next(iter(shots.values())) for shots in kept]
            table = pyarrow.table(
                {
                    "timestamp": (at / self.fps).astype(np.float32),
                    "frame_index": at,
                    "episode_index": np.full(len(kept), k),
                    "index": start + at,
                    "task_index": np.zeros(len(kept), np.int64),
                    "observation.frame_number": [row["frame_index"] for row in first],
                    "observation.time": np.array([row["timestamp"] for row in first], np.float64),
                }
            )
            for key in made:
                rows = [shots[key] for shots in kept]
                pictures = [
                    {"bytes": row["picture"], "path": f"frame-{i:06d}.png"} for row, i in zip(rows, at, strict=True)
                ]
                cells = {key: pyarrow.array(pictures), **self._cells(key, rows, done)}
                for column, values in cells.items():
                    table = table.append_column(column, values)
            yield table
            done += len(kept)

    def _cells(self, key: str, found: Sequence[Row | None], done: int) -> dict[str, Any]:
        """Column → cells of some rows of a camera; None = a frame that could not be read."""
        pyarrow = import_optional("pyarrow", extra="scale")
        nothing, cells = blank_maps(self.views[key]), {}
        values: list[Any]
        for kind, column in self.keys[key].items():
            if kind in nothing:
                end = MAP_FILES[kind].enrich
                files = [row[kind] if row is not None and row["depth"] else nothing[kind] for row in found]
                values = [{"bytes": file, "path": f"frame-{done + i:06d}.{end}"} for i, file in enumerate(files)]
            elif kind in NUMBER_COLUMNS:
                stored = number_column(NUMBER_COLUMNS[kind], self.n)
                blank = np.zeros(stored.shape, stored.kind)
                rows = [row[kind] if row is not None and row["depth"] else blank for row in found]
                values = [_flat_number(row) for row in rows]
            else:
                n = 9 if kind == "K" else 16
                values = [row[kind] if row is not None and row["depth"] else [float("nan")] * n for row in found]
            cells[column] = pyarrow.array(values)
        return cells

    def _renumbered(self, table: Any, k: int, start: int) -> Any:
        """Episodes from 0 and rows one after another, as loaders count."""
        pyarrow = import_optional("pyarrow", extra="scale")
        n = table.num_rows
        news = {"episode_index": np.full(n, k), "index": start + np.arange(n)}
        for name, values in news.items():
            mine = pyarrow.array(values.astype(np.int64))
            if name not in table.column_names:
                table = table.append_column(name, mine)
            elif self.renumbered or self.version == 3:
                place = table.column_names.index(name)
                if self.renumbered:
                    table = table.append_column(f"source.{name}", table.column(name))
                table = table.set_column(place, name, mine)
        return table

    def _summary(
        self,
        k: int,
        start: int,
        length: int,
        tasks: Sequence[str],
        moments: dict[str, FeatureMoments],
        tallies: Mapping[str, MapCounts],
    ) -> Row:
        for key, tally in tallies.items():
            maps = tally.of_maps()
            if maps is not None:
                moments |= {self.keys[key]["depth"]: maps[0], self.keys[key]["sigma"]: maps[1], key: maps[2]}
        said = None if self.origin is None else self.origin.words(k)
        found: Row = storage.to_strict_json(
            {
                "key": self.key,
                "number": self.numbers[k],
                "start": start,
                "length": length,
                "tasks": list(tasks) if said is None else said,
                "about": {} if self.origin is None else self.origin.about(k),
                "cameras": {self.views[key].name: tally.summary() for key, tally in tallies.items()},
            }
        )
        return found | {"moments": {name: each.pack() for name, each in moments.items()}}

    def _copy_videos(self, k: int, length: int) -> None:
        """Byte for byte."""
        for key, (file, clip) in self._clips(k, length).items():
            storage.copy_file(file, self.root / lerobot.episode_video_path(self.version, key, clip, k))

    def _clips(self, k: int, length: int) -> dict[str, tuple[Path, lerobot.VideoSegment]]:
        if self.origin is None:
            return {}
        found = self.origin.clips(k, length)
        if self.origin.version == 3:
            return found
        chunk, file = divmod(k, lerobot.FILES_PER_CHUNK)
        return {key: (path, clip._replace(chunk=chunk, file=file)) for key, (path, clip) in found.items()}

    # ---------------------------------------------------------------------------------------------------- the whole

    def finish(self, owns: Sequence[Row]) -> None:
        """As :meth:`Target.finish`."""
        parquet = import_optional("pyarrow.parquet", extra="scale")
        features = self.features(parquet.read_schema(self.file(0)).names)
        self._write_lenses()
        self._write_about(owns)
        tasks = self._tasks(owns)
        for name, file in ({} if self.origin is None else self.origin.more).items():
            storage.copy_file(file, self.root / name)
        episodes = [
            lerobot.EpisodeSpec(
                number=k,
                length=own["length"],
                start=own["start"],
                tasks=own["tasks"],
                videos={key: clip for key, (_, clip) in self._clips(k, own["length"]).items()},
                stats=self._stats([own], features) if self.version == 2 else {},
            )
            for k, own in enumerate(owns)
        ]
        about = lerobot.make_info(
            self.version,
            features,
            episodes,
            fps=self.fps,
            n_tasks=len(tasks),
            robot="unknown" if self.origin is None else self.origin.robot,
        )
        about["splits"] = self._splits(owns) or about["splits"]  # beside the origin's, "train: all" would be wrong
        lerobot.write_lerobot_meta(self.root, self.version, about, episodes, tasks, self._stats(owns, features))

    def _stats(self, owns: Sequence[Row], features: Mapping[str, FeatureSpec]) -> dict[str, Any]:
        """Of every column of numbers, and of the pictures and maps that were looked at.

        A LeRobot that reads v2.1 refuses a set unless whatever has "image" in its name has statistics of three
        channels: a map's stand there three times, and numbers of such a name have none.
        """
        frames = sum(own["length"] for own in owns)
        found = {}
        for name, feature in features.items():
            each = [FeatureMoments.parse(own["moments"][name]) for own in owns if name in own["moments"]]
            if not each:
                continue
            total = each[0]
            for more in each[1:]:
                total = total + more
            visual = feature["dtype"] in ("image", "video")
            entry = total.stats(frames, (len(total.n), 1, 1) if visual else (len(total.n),))
            if self.version == 2 and "image" in name and entry is not None:
                if not visual:
                    continue
                entry = {k: v * (3 // len(v)) if k != "count" else v for k, v in entry.items()}
            if entry is not None:
                found[name] = entry
        return found

    def _splits(self, owns: Sequence[Row]) -> dict[str, str]:
        """The origin's splits in this set's numbers, where the episodes of each follow one another."""
        found: dict[str, str] = {}
        splits: dict[str, list[int]] = {} if self.origin is None else dict(self.origin.splits)
        for own in owns:
            if "split" in own["about"]:
                splits.setdefault(own["about"]["split"], []).append(own["number"])
        for name, numbers in splits.items():
            places = [k for k, number in enumerate(self.numbers) if number in set(numbers)]
            if places and places == list(range(places[0], places[-1] + 1)):
                found[name] = f"{places[0]}:{places[-1] + 1}"
        return found

    def _write_about(self, owns: Sequence[Row]) -> None:
        """What an origin says of its episodes and the format has no place for."""
        if any(own["about"] for own in owns):
            rows = [{"episode_index": k, **own["about"]} for k, own in enumerate(owns)]
            text = "".join(storage.dump_strict_json(row) + "\n" for row in rows)
            storage.replace_file(self.root / "meta" / "source_episodes.jsonl", text.encode())

    def _write_lenses(self) -> None:
        """Lenses, which no feature of the format holds, in the side-car that the reader knows."""
        lenses = {view.key: {"dist": list(view.lens)} for view in self.views.values() if view.lens}
        if lenses:
            storage.write_json(self.root / "meta" / "intrinsics.json", lenses)


def _number_feature(column: Column) -> FeatureSpec:
    return lerobot.number_feature(column.kind, math.prod(column.shape))


def _flat_number(value: Any) -> Any:
    """A number, or a list of several, as a table of the format holds it."""
    flat = np.asarray(value).reshape(-1).tolist()
    return flat[0] if len(flat) == 1 else flat


def _column_types(table: Any) -> dict[str, Any]:
    return dict(zip(table.schema.names, table.schema.types, strict=True))


def _add_moments(moments: dict[str, FeatureMoments], table: Any) -> None:
    """Of the columns of numbers."""
    for name in table.column_names:
        cells = table.column(name).to_pylist() if "struct" not in str(table.schema.field(name).type) else []
        try:
            values = np.array(cells, np.float64).reshape(len(cells), -1)
        except (TypeError, ValueError):
            continue  # text, or rows of different length
        if values.size and values.shape[1] <= 4096:
            here = FeatureMoments.of(values)
            moments[name] = moments[name] + here if name in moments else here


def _refuse_shared_videos(origin: LeRobotSource) -> None:
    for key in (k for k, f in origin.features.items() if f["dtype"] == "video"):
        starts = origin.episodes.columns[f"videos/{key}/from_timestamp"]
        files = {origin.episodes[i].videos[key][0] for i in range(len(origin.episodes))}
        if np.any(starts != 0) or len(files) != len(starts):
            raise ValueError(
                f"format: found videos of several episodes ({key}), expected one each for v2.1; use lerobot"
            )
