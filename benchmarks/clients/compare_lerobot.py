"""An enriched set as LeRobot's loader gives it against the bytes in its tables, value by value, and its statistics.

In an environment that has lerobot:  python benchmarks/clients/compare_lerobot.py DST
"""

import io
import json
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image
from pyarrow import parquet


def main(root: str) -> None:
    data = LeRobotDataset("local/set", root=root, video_backend="pyav")
    tables = sorted((Path(root) / "data").rglob("*.parquet"))
    rows = [row for table in tables for row in parquet.read_table(table).to_pylist()]
    assert len(rows) == len(data), f"{len(data)} frames, the tables have {len(rows)}"
    features = data.meta.features
    known = {k for k in getattr(data.meta, "depth_keys", []) if features[k]["dtype"] == "image"}  # given in mm
    maps = [k for k, f in features.items() if "quantiser_step_m" in (f.get("info") or {})]
    numbers = [k for k in features if k.endswith((".intrinsics", ".T_world_from_cam")) or k == "action"]
    worst = dict.fromkeys(("depth", "sigma", "numbers", "statistics"), 0.0)
    loaded = {key: [] for key in maps}
    for i, row in enumerate(rows):
        item = data[i]
        assert float(item["timestamp"]) == np.float32(row["timestamp"]), i
        assert int(item["index"]) == row["index"] == i and int(item["frame_index"]) == row["frame_index"], i
        for key in numbers:
            worst["numbers"] = max(worst["numbers"], float(np.abs(np.float32(row[key]) - item[key].numpy()).max()))
        for key in maps:
            cell = row[key]  # numbers, or a picture
            stored = np.array(Image.open(io.BytesIO(cell["bytes"])) if isinstance(cell, dict) else cell).squeeze()
            z = item[key].numpy().squeeze() * (1e-3 if key in known else 1.0)
            assert np.array_equal(z > 0, stored > 0), (i, key)
            name = "sigma" if "_depth_sigma" in key else "depth"
            worst[name] = max(worst[name], float(np.abs(z - stored).max()))
            loaded[key].append(z[z > 0])
    for key in maps:  # what a normaliser is given, in the unit of the items
        values = np.concatenate(loaded[key]).astype(np.float64)
        if key in data.meta.stats:
            mean = float(np.ravel(data.meta.stats[key]["mean"])[0]) * (1e-3 if key in known else 1.0)
            worst["statistics"] = max(worst["statistics"], abs(mean / values.mean() - 1))
    unit = "mm" if known else "m"
    print(json.dumps({"frames": len(rows), "maps": len(maps), "unit": unit, "largest_difference": worst}))


if __name__ == "__main__":
    main(sys.argv[1])
