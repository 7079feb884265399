"""Names of an enriched set's columns, read from its ``meta/info.json``."""

import json
import sys
from pathlib import Path
from typing import Any


def columns(root: str, *, tables: bool = False) -> dict[str, Any]:
    """Path of a set -> ``keys``, options for ``ExtendDepth``; ``target``, the column that a policy predicts; ``fps``.

    ``tables``: the loader reads only the tables, so the script stops where images are stored as video.
    """
    info = json.loads((Path(root) / "meta" / "info.json").read_text())
    features = info["features"]
    maps = [k for k, f in features.items() if "quantiser_step_m" in (f.get("info") or {})]
    depth = next(k for k in maps if "_depth_sigma" not in k)
    image = depth.removesuffix("_enriched").removesuffix("_depth")
    camera = f"observation.{image.removeprefix('observation.images.')}"
    keys = {"image": image, "depth": depth, "intrinsics": f"{camera}.intrinsics", "depth_unit": "m"}
    if tables and features[image]["dtype"] == "video":
        sys.exit(f"{image} is video: found no picture in the tables, expected a loader that decodes video (LeRobot)")
    target = "action" if "action" in features else f"{camera}.T_world_from_cam"  # a hand-held camera's own motion
    return {"keys": keys, "target": target, "fps": info["fps"]}
