"""Reader of extracted features: by row, by episode and frame, or joined to their data set."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from dhtorch.data.codecs.parquet import read_columns, read_row
from dhtorch.data.io.decode import FormatError
from dhtorch.extract.columns import KEY_COLUMNS
from dhtorch.extract.shards import read_shard_metadata, shard_files
from dhtorch.transforms.sample_access import get_value


class FeatureTable(Sequence[dict[str, Tensor]]):
    """The rows of an extraction, sorted by episode and frame; read lazily.

    A row is a dict with the keys and shapes that :class:`dhtorch.transforms.ExtendDepth` adds to a sample, so a model
    gets the same input from stored features and from the loader. float16 is converted to float32.

    Args:
        folder: output of ``dhtorch extract``.
        columns: to read; None = all. Fewer are faster.
        prefix: of the keys.

    Attributes:
        about: metadata of the extraction: ``columns``, ``codes``, ``config``, ``data``, ``version``, ``git``, ``key``.
        place: column → (rows,) array: ``episode_index``, ``frame_index``, ``timestamp``.

    Raises:
        FormatError: no extraction in the folder, an unfinished one, or an unknown column.
        ImportError: pyarrow is missing.
    """

    def __init__(self, folder: str | Path, columns: Sequence[str] | None = None, *, prefix: str = "dhtorch.") -> None:
        self.files = shard_files(Path(folder))
        if not self.files:
            raise FormatError(folder, "shards", "none", "a folder written by dhtorch extract")
        self.about, shard_metadata = read_shard_metadata(self.files[0])
        if len(self.files) != shard_metadata["of"]:
            expected = f"{shard_metadata['of']}: run the same dhtorch extract again for the missing ones"
            raise FormatError(folder, "shards", len(self.files), expected)
        available = [name for name in self.about["columns"] if name not in KEY_COLUMNS]
        for name in columns or ():
            if name not in available:
                raise FormatError(folder, "columns", name, f"some of {', '.join(available)}")
        self.columns, self.prefix = tuple(available if columns is None else columns), prefix
        places = [read_columns(file, KEY_COLUMNS[:3]) for file in self.files]
        self.place = {name: np.concatenate([np.asarray(part[name]) for part in places]) for name in KEY_COLUMNS[:3]}
        self._starts = np.cumsum([0, *(len(part["episode_index"]) for part in places)])
        pairs = zip(self.place["episode_index"].tolist(), self.place["frame_index"].tolist(), strict=True)
        self._row = {pair: i for i, pair in enumerate(pairs)}

    def __repr__(self) -> str:
        return f"FeatureTable({len(self)} rows of {self.files[0].parent}: {', '.join(self.columns)})"

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, index: int) -> dict[str, Tensor]:  # type: ignore[override]  # one row at a time
        i = range(len(self))[index]
        k = int(np.searchsorted(self._starts, i, "right")) - 1
        values = read_row(self.files[k], self.columns, i - int(self._starts[k]))
        row_values = {name: torch.from_numpy(np.array(values[name])) for name in self.columns}
        # In the dtypes of the transform: bool, float32 or int32.
        return {
            self.prefix + name: x if x.dtype == torch.bool else x.float() if x.is_floating_point() else x.int()
            for name, x in row_values.items()
        }

    def at(self, episode: int, frame: int) -> dict[str, Tensor]:
        """Numbers of episode and frame -> row.

        Raises:
            KeyError: no such row: the frame was skipped, or belongs to another data set.
        """
        try:
            return self[self._row[episode, frame]]
        except KeyError:
            raise KeyError(f"no features of frame {frame} of episode {episode}") from None


class JoinedDataset(Dataset[Any]):
    """Map-style data set and extracted features -> items with their features, matched by episode and frame.

    Args:
        dataset: ``dataset[i]`` is a dict with the numbers of its episode and frame, as in LeRobot.
        features: of the same frames.
        episode_key, frame_key: keys of those numbers.
    """

    def __init__(
        self,
        dataset: Any,
        features: FeatureTable,
        *,
        episode_key: str = "episode_index",
        frame_key: str = "frame_index",
    ) -> None:
        self.dataset, self.features, self.keys = dataset, features, (episode_key, frame_key)

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> dict[str, Any]:
        sample = self.dataset[index]
        return {**sample, **self.features.at(*(int(get_value(sample, key)) for key in self.keys))}
