"""A set from ``dhtorch enrich`` as LeRobot's loader gives it against the bytes in its tables: rows, times, depth.

Runs in an environment that has lerobot:  python benchmarks/clients/compare_lerobot.py DST
"""

import io
import json
import os
import sys
from pathlib import Path

os.environ.setdefault("HF_HUB_OFFLINE", "1")

import numpy as np
import pyarrow.parquet as parquet
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image


def main(root: str) -> None:
    data = LeRobotDataset("local/enriched", root=root, video_backend="pyav")
    tables = sorted((Path(root) / "data").rglob("*.parquet"))
    rows = [row for table in tables for row in parquet.read_table(table).to_pylist()]
    maps = [k for k, f in data.meta.features.items() if "quantiser_step_m" in (f.get("info") or {})]
    known = set(getattr(data.meta, "depth_keys", []) or [])
    worst = 0.0
    for i, row in enumerate(rows):
        item = data[i]
        assert float(item["timestamp"]) == np.float32(row["timestamp"]), i
        assert int(item["index"]) == row["index"] == i and int(item["frame_index"]) == row["frame_index"], i
        for key in maps:
            stored = np.array(Image.open(io.BytesIO(row[key]["bytes"])))
            loaded = item[key][0].numpy() * (1e-3 if key in known else 1.0)
            assert np.array_equal(loaded > 0, stored > 0) or key.endswith("_sigma"), (i, key)
            worst = max(worst, float(np.abs(loaded - stored).max()))
    pictures = [k for k in data.meta.camera_keys if k not in maps]
    said = {"frames": len(rows), "maps": len(maps), "pictures": len(pictures), "largest_difference_m": worst}
    print(json.dumps(said))


if __name__ == "__main__":
    main(sys.argv[1])
