"""An RLDS data set as the origin of a LeRobot one: numbers, texts and encoded pictures, step by step."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import import_optional
from dhtorch.data.readers.rlds_steps import EpisodeSteps
from dhtorch.data.recording import Recording
from dhtorch.export import lerobot as out
from dhtorch.extract.enriched import camera_feature
from dhtorch.extract.origin import TABLE_GROUP_ROWS

#: Columns that every table has; a feature of that name is kept under another.
_RESERVED_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")


#: How such a file begins.
_JPEG_MAGIC = b"\xff\xd8"


@dataclass(frozen=True, eq=False)
class RldsSource:
    """An RLDS data set: see :class:`dhtorch.extract.origin.DatasetSource`.

    Args:
        recordings: one of each episode.
        numbers: of the episodes.
        fps: steps a second.
        limit: rows of an episode at most.
    """

    recordings: Sequence[Recording]
    numbers: Sequence[int]
    fps: float
    limit: int | None = None
    held: dict[int, EpisodeSteps] = field(default_factory=dict, repr=False)  # of the episode that was asked for last

    version = None
    tasks = None
    robot = "unknown"

    @property
    def features(self) -> dict[str, out.FeatureSpec]:
        """Of its columns: arrays of several dimensions by rows, with their shape in the info."""
        steps = self._steps(0)
        found: dict[str, out.FeatureSpec] = {}
        for name, described in steps.features.items():
            if described.kind == "image":
                content = steps.values(name, range(1))[0]
                hw = files.decode_image_header(content, steps.place.file).hw
                more = {} if described.dtype == "uint8" else {"is_depth_map": True, "depth_unit": "mm"}
                channels = abs(described.shape[-1]) if described.shape else 3
                found[_column_name(name, picture=True)] = out.image_feature(hw, channels, **more)
            elif described.kind == "text" and name != steps.instruction:
                found[_column_name(name)] = {"dtype": "string", "shape": [1], "names": None}
            elif described.kind == "tensor":
                feature = out.number_feature(described.dtype, int(np.prod(described.shape)))
                found[_column_name(name)] = (
                    feature | {"info": {"shape": list(described.shape)}} if len(described.shape) > 1 else feature
                )
        return found

    @property
    def splits(self) -> dict[str, list[int]]:
        """None but what is said of each episode."""
        return {}

    @property
    def more(self) -> dict[str, Path]:
        """No file that does not describe TFRecord files."""
        return {}

    def batches(self, i: int, tasks: list[str]) -> Iterator[Any]:
        """As :meth:`Origin.batches`."""
        pyarrow = import_optional("pyarrow", extra="scale")
        steps = self._steps(i)
        n = steps.n if self.limit is None else min(steps.n, self.limit)
        for start in range(0, n, TABLE_GROUP_ROWS):
            part = range(start, min(start + TABLE_GROUP_ROWS, n))
            at = np.array(part)
            columns: dict[str, Any] = {"timestamp": (at / self.fps).astype(np.float32), "frame_index": at}
            said = [""] * len(part) if steps.instruction is None else steps.values(steps.instruction, part)
            tasks += [text for text in dict.fromkeys(said) if text not in tasks]
            columns["task_index"] = np.array([tasks.index(text) for text in said])
            for name, described in steps.features.items():
                if name != steps.instruction:
                    columns[_column_name(name, described.kind == "image")] = _read_cells(steps, name, part)
            yield pyarrow.table(columns)

    def clips(self, i: int, length: int) -> dict[str, tuple[Path, out.VideoSegment]]:
        """None."""
        return {}

    def words(self, i: int) -> list[str] | None:
        """Those of its rows."""
        return None

    def about(self, i: int) -> dict[str, Any]:
        """The split, the number in it, and the episode's metadata."""
        return self._steps(i).about

    def _steps(self, i: int) -> EpisodeSteps:
        """Of episode ``i``, whose record is read once."""
        if i not in self.held:
            self.held.clear()
            self.held[i] = EpisodeSteps.of(self.recordings[i])
        return self.held[i]


def _column_name(name: str, picture: bool = False) -> str:
    """LeRobot's name of a feature."""
    found = camera_feature(name) if picture else name.replace("/", ".")
    return f"source.{found}" if found in _RESERVED_COLUMNS else found


def _read_cells(steps: EpisodeSteps, name: str, part: range) -> Any:
    pyarrow = import_optional("pyarrow", extra="scale")
    values = steps.values(name, part)
    kind = steps.features[name].kind
    if kind == "image":
        ends = ["jpg" if content[:2] == _JPEG_MAGIC else "png" for content in values]
        return pyarrow.array(
            [{"bytes": x, "path": f"frame-{i:06d}.{end}"} for i, x, end in zip(part, values, ends, strict=True)]
        )
    if kind == "text":
        return pyarrow.array(values)
    assert isinstance(values, np.ndarray)
    size = values.shape[1]
    flat = pyarrow.array(values.reshape(-1))
    return flat if size == 1 else pyarrow.FixedSizeListArray.from_arrays(flat, size)
