"""A set by GR00T's ``meta/modality.json``: state and action by slices, videos by frames, words by task, all rows.

Geometry images are decoded and compared with the depth in the tables.

python benchmarks/clients/groot_modality.py DST
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from columns import columns
from pyarrow import parquet

from dhtorch.data.codecs.video import read_video_frame, read_video_times
from dhtorch.functional import decode_geometry_image


def parts(modality: dict[str, Any], kind: str, features: dict[str, Any]) -> dict[str, tuple[str, slice]]:
    """Name → column and slice of the parts of state or action."""
    default = {"state": "observation.state", "action": "action"}[kind]
    found = {}
    for name, part in modality[kind].items():
        key, span = part.get("original_key", default), slice(part["start"], part["end"])
        assert 0 <= span.start < span.stop <= features[key]["shape"][0], (kind, name, span)
        found[f"{kind}.{name}"] = key, span
    return found


def frame(root: Path, info: dict[str, Any], key: str, row: dict[str, Any], episode: dict[str, Any]) -> np.ndarray:
    """Frame of a video at the time of a row."""
    number, start = row["episode_index"], episode.get(f"videos/{key}/from_timestamp", 0.0)
    places = {"video_key": key, "episode_chunk": number // info["chunks_size"], "episode_index": number}
    places |= {f"{k}_index": episode.get(f"videos/{key}/{k}_index", 0) for k in ("chunk", "file")}
    file = root / info["video_path"].format(**places)
    times = read_video_times(file)
    place = int(np.abs(times - (row["timestamp"] + start)).argmin())
    return read_video_frame(file, place)


def main(root: str) -> None:
    folder, keys = Path(root), columns(root)["keys"]
    info = json.loads((folder / "meta" / "info.json").read_text())
    modality, features = json.loads((folder / "meta" / "modality.json").read_text()), info["features"]
    rows = [
        row for file in sorted((folder / "data").rglob("*.parquet")) for row in parquet.read_table(file).to_pylist()
    ]
    listed = [
        r for f in sorted((folder / "meta" / "episodes").rglob("*.parquet")) for r in parquet.read_table(f).to_pylist()
    ]
    episodes = {row["episode_index"]: row for row in listed}
    numbers = parts(modality, "state", features) | parts(modality, "action", features)
    videos = {name: part["original_key"] for name, part in modality["video"].items()}
    words = [part.get("original_key", f"annotation.{name}") for name, part in modality["annotation"].items()]
    missing = [key for key in (*videos.values(), *words) if key not in features and key != "task_index"]
    worst, known, seen = 0.0, 0, 0
    for row in rows:
        sample = {name: np.asarray(row[key], np.float64)[span] for name, (key, span) in numbers.items()}
        assert all(np.isfinite(x).all() for x in sample.values()), row["index"]
        for name, key in videos.items():
            picture = frame(folder, info, key, row, episodes.get(row["episode_index"], {}))
            assert list(picture.shape) == features[key]["shape"], (name, picture.shape)
            seen += 1
            if "geometry_image" not in (features[key].get("info") or {}) or not key.startswith(keys["image"]):
                continue
            decoded = decode_geometry_image(torch.from_numpy(picture).movedim(-1, 0)).depth.numpy()
            depth = np.asarray(row[keys["depth"]], np.float32)[0]
            v, u = ((2 * np.arange(n) + 1) * m // (2 * n) for n, m in zip(decoded.shape, depth.shape, strict=True))
            depth = depth[v[:, None], u]
            assert np.array_equal(decoded > 0, depth > 0), row["index"]
            both = depth > 0
            known += int(both.sum())
            worst = max(worst, float(np.abs(1 / decoded[both] - 1 / depth[both]).max(initial=0.0)))
    result = {"frames": len(rows), "parts": len(numbers), "videos": len(videos), "pictures": seen, "missing": missing}
    print(json.dumps(result | {"known": known, "largest_difference": {"inverse depth": worst}}))


if __name__ == "__main__":
    main(sys.argv[1])
