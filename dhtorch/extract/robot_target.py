"""Writer of an enriched data set as LeRobot tables: one file per episode, joined from its shards and its source."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.codes import names
from dhtorch.data.codecs.tiff import decode_tiff
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError, import_optional
from dhtorch.data.readers.lerobot_meta import LeRobotFeature
from dhtorch.export import lerobot
from dhtorch.export.lerobot import FeatureMoments, FeatureSpec, LogHistogram
from dhtorch.export.video import open_lossless_video
from dhtorch.extract import policy_columns
from dhtorch.extract.enriched import (
    MAP_FILES,
    MAP_STEPS,
    NUMBER_COLUMNS,
    DatasetCamera,
    blank_maps,
    decode_map,
    number_column,
)
from dhtorch.extract.origin import SOURCE_CARD, TABLE_GROUP_ROWS, DatasetSource, LeRobotSource
from dhtorch.extract.policy_columns import POLICY_COLUMNS, PolicyColumnWriter
from dhtorch.extract.shards import iter_groups
from dhtorch.extract.targets import MapCounts, PeekableRows, Row, iter_instants, iter_rows
from dhtorch.runtime import safe_open as doors
from dhtorch.runtime import storage
from dhtorch.runtime.output_folder import is_whole

#: Key of the metadata with the summary of an episode.
_EPISODE_METADATA_KEY = b"dhtorch.episode"


class LeRobotTarget:
    """Writer of LeRobot tables.

    Args:
        root: of the new data set.
        version: 3, or 2 for v2.1.
        views: its cameras.
        origin: source data set; None = recordings, whose images are in the shards.
        numbers: episode numbers in the source.
        step: m, quantisation step of the depth maps.
        maps: names of the maps to write, see :data:`MAP_FILES`, and of the columns made of them, see
            :data:`dhtorch.extract.policy_columns.POLICY_COLUMNS`.
        as_images: maps are images in the tables; else numbers, and one-channel images of the source, which LeRobot's
            policies take as pictures of three channels, become numbers, too.
        fps: of a recording.
        task: of a recording.
        key: of the settings and data, stored in every table.
        n: samples of a frame, if the data set has columns of them.
        cut: some rows of the source are left out, so that the index of others changes.

    Raises:
        ValueError: columns that the source already has, names that are invalid in file names, or videos that this
            version would have to cut.
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
        maps: Sequence[str],
        as_images: bool,
        fps: float,
        task: str | None,
        key: str,
        n: int = 0,
        cut: bool = False,
    ) -> None:
        self.root, self.version, self.views = root, version, views
        self.origin, self.numbers, self.step, self.fps = origin, numbers, step, fps
        self.tasks = origin.tasks if origin is not None else (task or "look around",)
        self.key, self.n, self.cut = key, n, cut
        self.maps, self.as_images = tuple(maps), as_images
        if "geometry_image" in self.maps:
            import_optional("av")
        self.source_features: dict[str, FeatureSpec] = {} if origin is None else origin.features
        # LeRobot's policies take every image and video feature as a picture of three channels: other images of one
        # channel (depth, masks) become numbers, value for value, and such videos stay as files without a feature.
        one_channel: dict[str, list[str]] = {"image": [], "video": []}
        for name, feature in self.source_features.items():
            if feature["dtype"] in one_channel and name not in views and _parse_feature(name, feature).channels == 1:
                one_channel[feature["dtype"]].append(name)
        self.unlisted = [] if as_images else one_channel["video"]
        #: Image columns of the source that become numbers -> their features, by the type of the first image.
        self.pixels: dict[str, FeatureSpec] = {}
        if origin is not None and not as_images:
            first: Any = next(iter(origin.batches(0, []))) if one_channel["image"] else None
            with doors.restrict_links(origin.bounds):
                for name in one_channel["image"]:
                    cell = first.column(name)[0].as_py()
                    feature = self.source_features[name]
                    pixels = _decode_cell(name, feature, cell, origin.root)
                    info = dict(feature.get("info") or {})
                    self.pixels[name] = lerobot.map_feature(pixels.shape, str(pixels.dtype), **info)
        self.keys = {view.key: self._keys(view) for view in views.values()}
        #: Camera -> feature of its geometry images.
        self.geometry = {view: keys["geometry_image"] for view, keys in self.keys.items() if "geometry_image" in keys}
        self.renumbered = cut or list(numbers) != list(range(len(numbers)))
        for name in (*self.source_features, *views):
            if not name or any(mark in name for mark in ("/", "\\", "..", "\0")):
                raise ValueError(f"data: found a feature called {name!r}, expected a name without / and ..")
        if version == 2 and isinstance(origin, LeRobotSource) and origin.version == 3:
            for video in (k for k, f in origin.features.items() if f["dtype"] == "video"):
                starts = origin.episodes.columns[f"videos/{video}/from_timestamp"]
                files = {origin.episodes[i].videos[video][0] for i in range(len(origin.episodes))}
                if np.any(starts != 0) or len(files) != len(starts):
                    raise ValueError(
                        f"format: found videos of several episodes ({video}), expected one each for v2.1; use lerobot"
                    )

    # -------------------------------------------------------------------------------------------------- the columns

    def _keys(self, view: DatasetCamera) -> dict[str, str]:
        """Camera -> added columns: kind → column name."""
        depth = f"{view.key}_depth"
        depth = f"{depth}_enriched" if depth in self.source_features else depth
        columns = {
            name: f"{view.key}_dhtorch_{name}" if c.enrich == "png" else depth if name == "depth" else f"{depth}_{name}"
            for name, c in MAP_FILES.items()
            if name in self.maps
        }
        columns |= {key: f"observation.{view.name}.dhtorch_{key}" for key in NUMBER_COLUMNS}
        policy = {"geometry_image": f"{view.key}_geometry_image", "point_cloud": f"observation.{view.name}.point_cloud"}
        columns |= {kind: column for kind, column in policy.items() if kind in self.maps}
        columns["K"] = f"observation.{view.name}.intrinsics"
        if view.posed:
            columns["pose"] = f"observation.{view.name}.T_world_from_cam"
        for kind, key in list(columns.items()):
            if key in self.source_features and kind in ("K", "pose"):
                del columns[kind]  # the source has the same values
            elif key in self.source_features:
                raise ValueError(f"data: found a column {key} in the source, expected a set that is not enriched yet")
        return columns

    def added(self) -> dict[str, FeatureSpec]:
        """LeRobot features of the added columns."""
        features: dict[str, FeatureSpec] = {}
        numbers = {key: number_column(c, self.n) for key, c in NUMBER_COLUMNS.items()}
        for key, view in self.views.items():
            maps: dict[str, FeatureSpec] = {}
            for name, spec in MAP_FILES.items():
                codes = {} if spec.codes is None else {str(k): word.lower() for k, word in names(spec.codes).items()}
                if spec.enrich == "tiff":
                    step = self.step / MAP_STEPS.get(name, 1)
                    maps[name] = lerobot.depth_feature(view.map_hw, step, as_image=self.as_images)
                elif self.as_images:
                    maps[name] = lerobot.image_feature(view.map_hw, 1, codes=codes)
                else:
                    maps[name] = lerobot.map_feature(view.map_hw, "uint8", codes=codes)
            by_kind: dict[str, FeatureSpec] = {
                **maps,
                **{key: lerobot.number_feature(c.kind, math.prod(c.shape)) for key, c in numbers.items()},
                "geometry_image": policy_columns.geometry_feature(view.hw, self.fps),
                "point_cloud": policy_columns.CLOUD_FEATURE,
                "K": lerobot.number_feature("float64", 9),
                "pose": lerobot.number_feature("float64", 16),
            }
            if self.origin is None:
                features[key] = lerobot.image_feature(view.hw)
            features |= {column: by_kind[kind] for kind, column in self.keys[key].items()}
        return features

    def features(self, columns: Iterable[str]) -> dict[str, FeatureSpec]:
        """LeRobot features of all columns of the tables, and of the videos."""
        features = {key: self.pixels.get(key, f) for key, f in self.source_features.items() if key not in self.unlisted}
        for name in columns:
            if name not in features and name not in self.added():
                is_integer = name.removeprefix("source.") != "timestamp" and name != "observation.time"
                features[name] = lerobot.number_feature("int64" if is_integer else "float64")
        if "timestamp" not in self.source_features:
            features["timestamp"] = lerobot.number_feature("float32")
        return features | self.added()

    # ------------------------------------------------------------------------------------------------- one episode

    def file(self, k: int) -> Path:
        """Path of the table of the ``k``-th episode."""
        return self.root / lerobot.episode_table_path(self.version, k)

    def own(self, k: int) -> Row | None:
        """As :meth:`DatasetTarget.own`."""
        parquet = import_optional("pyarrow.parquet")
        try:
            doors.check_regular_file(self.file(k))
            metadata = parquet.read_metadata(self.file(k)).metadata or {}
            summary: Row = storage.parse_strict_json(metadata[_EPISODE_METADATA_KEY].decode())
            return summary if summary["key"] == self.key and all(map(is_whole, self._videos(k))) else None
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def assemble(self, k: int, before: Sequence[Row], parts: Mapping[str, Sequence[Path]]) -> Row:
        """As :meth:`DatasetTarget.assemble`."""
        parquet = import_optional("pyarrow.parquet")
        start = sum(each["length"] for each in before)
        tallies = {key: MapCounts() for key in self.views}
        moments: dict[str, FeatureMoments] = {}
        task_indices: dict[int, None] = {}
        tasks = self._tasks(before)
        path = self.file(k)
        length, writer = 0, None
        with storage.write_atomically(path) as sink, ExitStack() as closing:
            closing.enter_context(doors.restrict_links(None if self.origin is None else self.origin.bounds))
            policy = {key: closing.enter_context(self._open_policy_columns(k, key)) for key in self.views}
            for table in self._join_rows(k, start, parts, tallies, policy, tasks):
                if writer is None:
                    layout = lerobot.make_arrow_schema(
                        self.features(table.column_names),
                        dict(zip(table.schema.names, table.schema.types, strict=True)),
                        {},
                    )
                    writer = closing.enter_context(parquet.ParquetWriter(sink, layout, compression="zstd"))
                writer.write_table(table.select(layout.names).cast(layout))
                length += table.num_rows
                task_indices |= dict.fromkeys(table.column("task_index").to_pylist())
                self._add_moments(moments, table)
            if writer is None:
                raise ValueError(f"episode {self.numbers[k]}: found no frame that can be read, expected one")
            task_texts = [tasks[i] for i in task_indices if i is not None and 0 <= i < len(tasks)]
            moments |= {column: each for writer in policy.values() for column, each in writer.moments.items()}
            summary = self._summary(k, start, length, task_texts, moments, tallies)
            writer.add_key_value_metadata({_EPISODE_METADATA_KEY: storage.dump_strict_json(summary)})
            self._copy_videos(k, length)
        return summary

    def _tasks(self, owns: Sequence[Row]) -> list[str]:
        """Task texts by ``task_index``: of the source, else in order of appearance in the summaries ``owns``."""
        if self.tasks is not None:
            return list(self.tasks)
        return list(dict.fromkeys(task for summary in owns for task in summary["tasks"]))

    def _join_rows(
        self,
        k: int,
        start: int,
        parts: Mapping[str, Sequence[Path]],
        tallies: Mapping[str, MapCounts],
        policy: Mapping[str, PolicyColumnWriter],
        tasks: list[str],
    ) -> Iterator[Any]:
        """Rows of an episode with the added columns, as Arrow tables of few rows."""
        rows_by_camera = {key: PeekableRows(iter_rows(files)) for key, files in parts.items()}
        if self.origin is None:
            yield from self._recording_rows(k, start, rows_by_camera, tallies, policy)
            return
        pyarrow, done = import_optional("pyarrow"), 0
        for part in self.origin.batches(k, tasks):
            table, n = part, part.num_rows
            for key, feature in self.pixels.items():  # images of one channel become numbers
                root, spec = self.origin.root, self.source_features[key]
                cells = table.column(key).to_pylist()
                pictures = [_decode_cell(key, spec, cell, root) for cell in cells]
                wrong = [picture.dtype for picture in pictures if str(picture.dtype) != feature["dtype"]]
                if wrong:
                    expected = f"{feature['dtype']}, as in the first row"
                    raise FormatError(root or Path(), key, wrong[0], expected)
                pixels = lerobot.nested_lists(np.stack(pictures)[:, None])
                table = table.set_column(table.column_names.index(key), key, pixels)
            numbers = part.column("frame_index").to_pylist()
            times = (
                part.column("timestamp").to_pylist()
                if "timestamp" in part.column_names
                else [i / self.fps for i in numbers]
            )
            for key, rows in rows_by_camera.items():
                camera_rows = [rows.take(i) for i in numbers]
                for row in camera_rows:
                    tallies[key].add(row)
                added = {**self._cells(key, camera_rows, done), **policy[key].add(camera_rows, times)}
                for column, values in added.items():
                    table = table.append_column(column, values)
            # Episodes are numbered from 0 and rows consecutively; changed numbers of the source are kept under
            # ``source.``, repeated where the source has such columns of its own source.
            for name, values in {"episode_index": np.full(n, k), "index": start + done + np.arange(n)}.items():
                array = pyarrow.array(values.astype(np.int64))
                if name not in table.column_names:
                    table = table.append_column(name, array)
                elif self.renumbered or self.version == 3:
                    position = table.column_names.index(name)
                    if self.renumbered:
                        kept = f"source.{name}"
                        while kept in table.column_names:
                            kept = f"source.{kept}"
                        table = table.append_column(kept, table.column(name))
                    table = table.set_column(position, name, array)
            yield table
            done += n

    def _recording_rows(
        self,
        k: int,
        start: int,
        rows_by_camera: Mapping[str, PeekableRows],
        tallies: Mapping[str, MapCounts],
        policy: Mapping[str, PolicyColumnWriter],
    ) -> Iterator[Any]:
        """Rows of an episode from recordings, without instants that have an unreadable frame."""
        pyarrow = import_optional("pyarrow")
        done = 0
        for group in iter_groups(iter_instants(rows_by_camera), TABLE_GROUP_ROWS):
            for shots in group:
                for key, row in shots.items():
                    tallies[key].add(row)
            kept = [shots for shots in group if all(row["picture"] for row in shots.values())]
            if not kept:
                continue
            index = done + np.arange(len(kept))
            first = [next(iter(shots.values())) for shots in kept]
            table = pyarrow.table(
                {
                    "timestamp": (index / self.fps).astype(np.float32),
                    "frame_index": index,
                    "episode_index": np.full(len(kept), k),
                    "index": start + index,
                    "task_index": np.zeros(len(kept), np.int64),
                    "observation.frame_number": [row["frame_index"] for row in first],
                    "observation.time": np.array([row["timestamp"] for row in first], np.float64),
                }
            )
            for key in rows_by_camera:
                rows = [shots[key] for shots in kept]
                pictures = [
                    {"bytes": row["picture"], "path": f"frame-{i:06d}.png"} for row, i in zip(rows, index, strict=True)
                ]
                cells = {
                    key: pyarrow.array(pictures),
                    **self._cells(key, rows, done),
                    **policy[key].add(rows, (index / self.fps).tolist()),
                }
                for column, values in cells.items():
                    table = table.append_column(column, values)
            yield table
            done += len(kept)

    def _cells(self, key: str, camera_rows: Sequence[Row | None], done: int) -> dict[str, Any]:
        """Camera and rows (None = unreadable) -> column → Arrow array of cells."""
        pyarrow = import_optional("pyarrow")
        blanks, cells = blank_maps(self.views[key]), {}
        values: list[Any]
        for kind, column in self.keys[key].items():
            if kind in POLICY_COLUMNS:
                continue  # of PolicyColumnWriter
            if kind in blanks:
                suffix = MAP_FILES[kind].enrich
                files = [row[kind] if row is not None and row["depth"] else blanks[kind] for row in camera_rows]
                if not self.as_images:
                    maps = [decode_map(file, kind, self.views[key].map_hw) for file in files]
                    cells[column] = lerobot.nested_lists(np.stack(maps)[:, None])
                    continue
                values = [{"bytes": file, "path": f"frame-{done + i:06d}.{suffix}"} for i, file in enumerate(files)]
            elif kind in NUMBER_COLUMNS:
                stored = number_column(NUMBER_COLUMNS[kind], self.n)
                blank = np.zeros(stored.shape, stored.kind)
                rows = [row[kind] if row is not None and row["depth"] else blank for row in camera_rows]
                values = [np.asarray(row).reshape(-1).tolist() for row in rows]
                values = [x[0] if len(x) == 1 else x for x in values]
            else:
                n = 9 if kind == "K" else 16
                values = [row[kind] if row is not None and row["depth"] else [float("nan")] * n for row in camera_rows]
            cells[column] = pyarrow.array(values)
        return cells

    def _summary(
        self,
        k: int,
        start: int,
        length: int,
        tasks: Sequence[str],
        moments: dict[str, FeatureMoments],
        tallies: Mapping[str, MapCounts],
    ) -> Row:
        """Summary of a complete episode."""
        ranges: dict[str, LogHistogram] = {}
        for key, tally in tallies.items():
            if tally.moments is None:
                continue
            moments[key] = FeatureMoments(*(x[2:5] for x in tally.moments))  # of red, green and blue
            for place, name in enumerate(("depth", "sigma")):
                if column := self.keys[key].get(name):
                    moments[column] = FeatureMoments(*(x[place : place + 1] for x in tally.moments))
                    ranges[column] = tally.ranges[place]
        episode_tasks = None if self.origin is None else self.origin.words(k)
        summary: Row = storage.to_strict_json(
            {
                "key": self.key,
                "number": self.numbers[k],
                "start": start,
                "length": length,
                "tasks": list(tasks) if episode_tasks is None else episode_tasks,
                "about": {} if self.origin is None else self.origin.about(k),
                "cameras": {self.views[key].name: tally.summary() for key, tally in tallies.items()},
            }
        )
        packed = {name: each.pack() for name, each in ranges.items()}
        return summary | {"moments": {name: each.pack() for name, each in moments.items()}, "ranges": packed}

    @contextmanager
    def _open_policy_columns(self, k: int, key: str) -> Iterator[PolicyColumnWriter]:
        """Writer of the policy columns of a camera in episode ``k``; its video is complete at the end."""
        view, keys = self.views[key], {kind: self.keys[key][kind] for kind in POLICY_COLUMNS if kind in self.keys[key]}
        if "geometry_image" not in keys:
            yield PolicyColumnWriter(keys, view, None)
            return
        clip = self._new_clip(k, 0)
        path = self.root / lerobot.episode_video_path(self.version, keys["geometry_image"], clip, k)
        with open_lossless_video(path, view.hw, self.fps) as append:
            yield PolicyColumnWriter(keys, view, append)

    def _new_clip(self, k: int, length: int) -> lerobot.VideoSegment:
        """Segment of a video that is written for the ``k``-th episode alone."""
        return lerobot.VideoSegment(*divmod(k, lerobot.FILES_PER_CHUNK), 0.0, length / self.fps)

    def _videos(self, k: int) -> list[Path]:
        """Videos of geometry images of the ``k``-th episode."""
        clip = self._new_clip(k, 0)
        return [self.root / lerobot.episode_video_path(self.version, x, clip, k) for x in self.geometry.values()]

    def _copy_videos(self, k: int, length: int) -> None:
        """Copy the videos of an episode unchanged, except those that are there with all bytes."""
        for key, (file, clip) in self._clips(k, length).items():
            storage.copy_file(file, self.root / lerobot.episode_video_path(self.version, key, clip, k))

    def _clips(self, k: int, length: int) -> dict[str, tuple[Path, lerobot.VideoSegment]]:
        """Video key → source file and its segment in the new data set."""
        if self.origin is None:
            return {}
        clips = self.origin.clips(k, length)
        if self.origin.version == 3:
            return clips
        chunk, file = divmod(k, lerobot.FILES_PER_CHUNK)
        return {key: (path, clip._replace(chunk=chunk, file=file)) for key, (path, clip) in clips.items()}

    # ---------------------------------------------------------------------------------------------------- the whole

    def planned_files(self, missing: Sequence[int]) -> list[Path]:
        """As :meth:`DatasetTarget.planned_files`."""
        names = (*lerobot.META_FILES[self.version], "source_episodes.jsonl", "source_features.json", "intrinsics.json")
        videos = [file for k in missing for file in self._videos(k)]
        files = [*(self.file(k) for k in missing), *videos, *(self.root / "meta" / name for name in names)]
        return [*files, self.root / policy_columns.MODALITY_FILE] if videos else files

    def finish(self, owns: Sequence[Row]) -> None:
        """As :meth:`DatasetTarget.finish`."""
        parquet = import_optional("pyarrow.parquet")
        features = self.features(parquet.read_schema(self.file(0)).names)
        # Distortion coefficients, which the format cannot hold, with the source's entries of other cameras.
        others = {} if self.origin is None else self.origin.meta_file("intrinsics.json")
        lenses = {key: entry for key, entry in others.items() if key not in self.views}
        lenses |= {view.key: {"dist": list(view.lens)} for view in self.views.values() if view.lens}
        if lenses:
            storage.write_json(self.root / "meta" / "intrinsics.json", lenses)
        if any(summary["about"] for summary in owns):  # metadata of source episodes that the format cannot hold
            rows = [{"episode_index": k, **summary["about"]} for k, summary in enumerate(owns)]
            text = "".join(storage.dump_strict_json(row) + "\n" for row in rows)
            storage.replace_file(self.root / "meta" / "source_episodes.jsonl", text.encode())
        if self.unlisted:
            unlisted = {key: self.source_features[key] for key in self.unlisted}
            storage.write_json(self.root / "meta" / "source_features.json", unlisted)
        tasks = self._tasks(owns)
        for k, summary in enumerate(owns):
            self._copy_videos(k, summary["length"])  # those of episodes that were complete before
        for name, file in ({} if self.origin is None else self.origin.more).items():
            storage.copy_file(file, self.root / (SOURCE_CARD if name == "README.md" else name))
        if videos := {
            f"{view.name}_geometry_image": self.geometry[key] for key, view in self.views.items() if self.geometry
        }:
            has_modality = self.origin is not None and policy_columns.MODALITY_FILE in self.origin.more
            source = self.origin.root if self.origin is not None and has_modality else None
            modality = policy_columns.make_modality(source, features, videos)
            storage.write_json(self.root / policy_columns.MODALITY_FILE, modality)
        episodes = [
            lerobot.EpisodeSpec(
                number=k,
                length=summary["length"],
                start=summary["start"],
                tasks=summary["tasks"],
                videos={
                    **{key: clip for key, (_, clip) in self._clips(k, summary["length"]).items()},
                    **dict.fromkeys(self.geometry.values(), self._new_clip(k, summary["length"])),
                },
                stats=self._stats([summary], features) if self.version == 2 else {},
            )
            for k, summary in enumerate(owns)
        ]
        about = lerobot.make_info(
            self.version,
            features,
            episodes,
            fps=self.fps,
            n_tasks=len(tasks),
            robot="unknown" if self.origin is None else self.origin.robot,
        )
        about["splits"] = (
            self._splits(owns) or about["splits"]
        )  # with splits of the source, "train: all" would be wrong
        lerobot.write_lerobot_meta(self.root, self.version, about, episodes, tasks, self._stats(owns, features))

    def _stats(self, owns: Sequence[Row], features: Mapping[str, FeatureSpec]) -> dict[str, Any]:
        """Summaries and features -> statistics of columns of numbers, images and maps.

        LeRobot's training ends in an error where an image or a video has no statistics: without pictures that could be
        read, those of the source are kept, else they change nothing (mean 0, standard deviation 1).
        LeRobot for v2.1 rejects a data set unless every feature with "image" in its name has statistics of three
        channels: those of a map are repeated three times, those of numbers with such a name are left out.
        """
        frames = sum(summary["length"] for summary in owns)
        maps = {self.keys[key][name] for key in self.views for name in ("depth", "sigma") if name in self.keys[key]}
        stats = {}
        for name, feature in features.items():
            is_map, is_picture = name in maps, feature["dtype"] in ("image", "video")
            packed = [summary["moments"][name] for summary in owns if name in summary["moments"]]
            total = reduce(add, map(FeatureMoments.parse, packed)) if packed else None
            entry = None
            if is_map:
                ranges = [summary["ranges"][name] for summary in owns if name in summary["ranges"]]
                histogram = reduce(add, map(LogHistogram.parse, ranges), LogHistogram.parse([]))
                entry = histogram.stats(total or FeatureMoments.of(np.zeros((0, 1))), frames, (1, 1, 1))
            elif total is not None:
                entry = total.stats(frames, (len(total.n), 1, 1) if is_picture else (len(total.n),))
            if entry is None and is_picture:
                shape = (_parse_feature(name, feature).channels, 1, 1)
                source = {} if self.origin is None else self.origin.meta_file("stats.json").get(name, {})
                shapes = [np.shape(source.get(k) or 0) for k in ("mean", "std")] if isinstance(source, dict) else []
                entry = LogHistogram.parse([]).stats(FeatureMoments.of(np.zeros((0, 1))), frames, shape)
                entry = {**source, "count": [frames]} if shapes == [shape] * 2 else entry
            if self.version == 2 and "image" in name and entry is not None:
                if not (is_map or is_picture):
                    continue
                entry = {k: v * (3 // len(v)) if k != "count" else v for k, v in entry.items()}
            if entry is not None:
                stats[name] = entry
        return stats

    def _add_moments(self, moments: dict[str, FeatureMoments], table: Any) -> None:
        """Add to ``moments`` those of numbers, and of the first picture of every image column that no camera reads."""
        for name in table.column_names:
            kind = str(table.schema.field(name).type)
            if kind.startswith("struct"):
                feature = self.source_features.get(name)
                if feature is None or name in self.views or _parse_feature(name, feature).channels != 3:
                    continue
                root = None if self.origin is None else self.origin.root
                pixels = _decode_cell(name, feature, table.column(name)[0].as_py(), root)
                colours = np.broadcast_to(pixels, (3, *pixels.shape[-2:])).reshape(3, -1).T
                here = FeatureMoments.of(colours / 255)
            elif kind.count("list<") > 1:
                continue  # maps, whose moments are those of their pixels
            else:
                try:
                    cells = table.column(name).to_pylist()
                    values = np.array(cells, np.float64).reshape(len(cells), -1)
                except (TypeError, ValueError):
                    continue  # text, or rows of different length
                if not values.size or values.shape[1] > 4096:
                    continue
                here = FeatureMoments.of(values)
            moments[name] = moments[name] + here if name in moments else here

    def _splits(self, owns: Sequence[Row]) -> dict[str, str]:
        """Splits of the source in the new episode numbers, if the episodes of a split are consecutive."""
        consecutive: dict[str, str] = {}
        splits: dict[str, list[int]] = {} if self.origin is None else dict(self.origin.splits)
        for summary in owns:
            if "split" in summary["about"]:
                splits.setdefault(summary["about"]["split"], []).append(summary["number"])
        for name, numbers in splits.items():
            indices = [k for k, number in enumerate(self.numbers) if number in set(numbers)]
            if indices and indices == list(range(indices[0], indices[-1] + 1)):
                consecutive[name] = f"{indices[0]}:{indices[-1] + 1}"
        return consecutive


def _decode_cell(key: str, feature: FeatureSpec, cell: Any, root: Path | None) -> np.ndarray:
    """Cell of an image column -> its pixels (h, w) as stored, or (3, h, w) of a colour image.

    Args:
        key: of the feature.
        feature: its specification.
        cell: bytes, or the path of a file below ``root``.
        root: of the data set; None = its cells hold bytes.

    Raises:
        FormatError: no image, or one of another size.
    """
    place = root or Path(key)
    data, path = ((cell or {}).get(name) for name in ("bytes", "path"))
    if not data and root is not None and path:
        place = files.resolve_inside(root, path, root, key)
        data = files.read_bytes(place)
    if not data:
        raise FormatError(place, key, "an empty cell", "an image")
    hw = _parse_feature(key, feature).hw
    if data[:2] in (b"II", b"MM"):
        return decode_tiff(data, place, hw)
    if files.decode_image_header(data, place).bits == 16:
        return files.decode_depth_png(data, place, 1.0, hw).astype(np.uint16)
    pixels = files.decode_image(data, place, hw)
    return pixels[0] if len(pixels) == 1 else pixels


def _parse_feature(key: str, feature: FeatureSpec) -> LeRobotFeature:
    return LeRobotFeature(key, feature["dtype"], tuple(feature["shape"]), dict(feature.get("info") or {}))
