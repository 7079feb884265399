"""Writer of an enriched data set as nerfstudio folders, one per recording: images, depth with its source, poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dhtorch.data.codecs.tiff import decode_tiff
from dhtorch.export import encode_png, nerfstudio
from dhtorch.extract.enriched import NUMBER_COLUMNS, DatasetCamera
from dhtorch.extract.instants import iter_rows
from dhtorch.extract.targets import MapCounts, Row
from dhtorch.runtime import storage


class NerfstudioTarget:
    """One nerfstudio folder per recording.

    Args:
        root: of the folders; the folder itself if there is one recording.
        views: cameras, see :class:`dhtorch.extract.enriched.DatasetCamera`.
        folders: of the recordings, by episode and then by camera.
        key: of the settings and data.
    """

    def __init__(
        self, root: Path, views: Mapping[str, DatasetCamera], folders: Sequence[Mapping[str, str]], key: str
    ) -> None:
        self.root, self.views, self.folders, self.key = root, views, folders, key

    def _file(self, k: int, camera: str) -> Path:
        return self.root / self.folders[k][camera] / "transforms.json"

    def own(self, k: int) -> Row | None:
        """As :meth:`DatasetTarget.own`."""
        try:
            summaries = [
                storage.parse_strict_json(self._file(k, key).read_text(encoding="utf-8"))["dhtorch"]
                for key in self.views
            ]
        except (OSError, ValueError, KeyError):
            return None
        if any(summary["key"] != self.key for summary in summaries):
            return None
        return {**summaries[0], "cameras": {name: x for summary in summaries for name, x in summary["cameras"].items()}}

    def assemble(self, k: int, before: Sequence[Row], parts: Mapping[str, Sequence[Path]]) -> Row:
        """As :meth:`DatasetTarget.assemble`."""
        for key, view in self.views.items():
            tally, shots = MapCounts(), []
            folder = self._file(k, key).parent
            for row in iter_rows(parts[key]):
                tally.add(row)
                if row["depth"] and np.isfinite(row["pose"]).all():
                    shots.append(_write_shot(folder, row, view))
            if not shots:
                raise ValueError(f"{folder.name}: found no frame with a pose, expected poses (format=nerfstudio)")
            cameras = {view.name: tally.summary()}
            summary = storage.to_strict_json({"key": self.key, "number": k, "length": len(shots), "cameras": cameras})
            storage.write_json(self._file(k, key), nerfstudio.make_transforms(shots, dhtorch=summary))
        written = self.own(k)
        assert written is not None  # just written
        return written

    def planned_files(self, missing: Sequence[int]) -> list[Path]:
        """As :meth:`DatasetTarget.planned_files`."""
        return [self._file(k, key) for k in missing for key in self.views]

    def finish(self, owns: Sequence[Row]) -> None:
        """As :meth:`DatasetTarget.finish`: nothing to write, the folders are independent."""


def _write_shot(folder: Path, row: Row, view: DatasetCamera) -> Row:
    stem = f"frame_{row['frame_index']:06d}"
    depth, sigma = (decode_tiff(row[kind], folder / stem, view.map_hw) for kind in ("depth", "sigma"))
    steps = nerfstudio.quantise_nerfstudio_depth(depth)
    confidence = nerfstudio.encode_confidence(np.where(steps > 0, depth, 0), sigma)
    pictures = {"images": row["picture"], "depth": encode_png(steps), "confidence": encode_png(confidence)}
    pictures["source"] = row["source"]
    for name, content in pictures.items():
        storage.replace_file(folder / name / f"{stem}.png", content)
    K, pose = np.reshape(row["K"], (3, 3)), np.reshape(row["pose"], (4, 4))
    numbers = {f"dhtorch_{key}": np.asarray(row[key]).tolist() for key in NUMBER_COLUMNS}
    return {**nerfstudio.make_nerfstudio_frame(stem, view.hw, K, pose, view.lens, row["timestamp"]), **numbers}
