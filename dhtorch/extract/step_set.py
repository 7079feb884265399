"""RLDS data set as the source of a LeRobot data set: numbers, texts and encoded images of each step."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import import_optional
from dhtorch.data.readers.rlds_steps import EpisodeSteps
from dhtorch.data.recording import Recording
from dhtorch.export import lerobot as out
from dhtorch.extract.enriched import camera_feature
from dhtorch.extract.origin import TABLE_GROUP_ROWS, DatasetSource

#: Columns that every table has; a feature of the same name gets a prefix.
_RESERVED_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")


@dataclass(frozen=True, eq=False)
class RldsSource(DatasetSource):
    """An RLDS data set: see :class:`dhtorch.extract.origin.DatasetSource`.

    Args:
        recordings: one per episode.
        numbers: of the episodes.
        fps: steps per second.
        limit: maximum rows of an episode; None = all.
    """

    recordings: Sequence[Recording]
    numbers: Sequence[int]
    fps: float
    limit: int | None = None
    cached: dict[int, EpisodeSteps] = field(default_factory=dict, repr=False)  # steps of the episode read last

    @property
    def features(self) -> dict[str, out.FeatureSpec]:
        """Features of its columns; arrays of several dimensions are flattened by rows, their shape is in the info."""
        steps = self._steps(0)
        features: dict[str, out.FeatureSpec] = {}
        for name, spec in steps.features.items():
            if spec.kind == "image":
                content = steps.values(name, range(1))[0]
                hw = files.decode_image_header(content, steps.place.file).hw
                more = {} if spec.dtype == "uint8" else {"is_depth_map": True, "depth_unit": "mm"}
                channels = abs(spec.shape[-1]) if spec.shape else 3
                features[_column_name(name, picture=True)] = out.image_feature(hw, channels, **more)
            elif spec.kind == "text" and name != steps.instruction:
                features[_column_name(name)] = {"dtype": "string", "shape": [1], "names": None}
            elif spec.kind == "tensor":
                feature = out.number_feature(spec.dtype, int(np.prod(spec.shape)))
                features[_column_name(name)] = (
                    feature | {"info": {"shape": list(spec.shape)}} if len(spec.shape) > 1 else feature
                )
        return features

    def batches(self, i: int, tasks: list[str]) -> Iterator[Any]:
        """As :meth:`DatasetSource.batches`."""
        pyarrow = import_optional("pyarrow")
        steps = self._steps(i)
        n = steps.n if self.limit is None else min(steps.n, self.limit)
        for start in range(0, n, TABLE_GROUP_ROWS):
            part = range(start, min(start + TABLE_GROUP_ROWS, n))
            at = np.array(part)
            columns: dict[str, Any] = {"timestamp": (at / self.fps).astype(np.float32), "frame_index": at}
            texts = [""] * len(part) if steps.instruction is None else steps.values(steps.instruction, part)
            tasks += [text for text in dict.fromkeys(texts) if text not in tasks]
            columns["task_index"] = np.array([tasks.index(text) for text in texts])
            for name, spec in steps.features.items():
                if name != steps.instruction:
                    columns[_column_name(name, spec.kind == "image")] = _read_cells(steps, name, part)
            yield pyarrow.table(columns)

    def about(self, i: int) -> dict[str, Any]:
        """Split, number within the split, and metadata of the episode."""
        return self._steps(i).about

    def _steps(self, i: int) -> EpisodeSteps:
        """Steps of episode ``i``; the last episode is cached."""
        if i not in self.cached:
            self.cached.clear()
            self.cached[i] = EpisodeSteps.of(self.recordings[i])
        return self.cached[i]


def _column_name(name: str, picture: bool = False) -> str:
    """RLDS feature name -> LeRobot feature name."""
    column = camera_feature(name) if picture else name.replace("/", ".")
    return f"source.{column}" if column in _RESERVED_COLUMNS else column


def _read_cells(steps: EpisodeSteps, name: str, part: range) -> Any:
    """Feature and range of steps -> Arrow array."""
    pyarrow = import_optional("pyarrow")
    values = steps.values(name, part)
    kind = steps.features[name].kind
    if kind == "image":
        suffixes = ["jpg" if content[:2] == b"\xff\xd8" else "png" for content in values]
        return pyarrow.array(
            [
                {"bytes": x, "path": f"frame-{i:06d}.{suffix}"}
                for i, x, suffix in zip(part, values, suffixes, strict=True)
            ]
        )
    if kind == "text":
        return pyarrow.array(values)
    assert isinstance(values, np.ndarray)
    size = values.shape[1]
    flat = pyarrow.array(values.reshape(-1))
    return flat if size == 1 else pyarrow.FixedSizeListArray.from_arrays(flat, size)
