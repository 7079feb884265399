"""Names of an enriched set's columns, from what its ``meta/info.json`` says."""

import json
import sys
from pathlib import Path
from typing import Any


def columns(root: str, *, tables: bool = False) -> dict[str, Any]:
    """Options for ``ExtendDepth``, and beside them ``target``: what a policy predicts, and ``fps``.

    ``tables``: the loader has only what stands in the tables, so a picture that is video ends the script.
    """
    info = json.loads((Path(root) / "meta" / "info.json").read_text())
    features = info["features"]
    maps = [k for k, f in features.items() if "quantiser_step_m" in (f.get("info") or {})]
    depth = next(k for k in maps if "_depth_sigma" not in k)
    image = depth.removesuffix("_enriched").removesuffix("_depth")
    camera = f"observation.{image.removeprefix('observation.images.')}"
    keys = {"image": image, "depth": depth, "intrinsics": f"{camera}.intrinsics", "depth_unit": "m"}
    if tables and features[image]["dtype"] == "video":
        sys.exit(f"{image} is video: found no picture in the tables, expected a loader that decodes, as LeRobot's")
    target = "action" if "action" in features else f"{camera}.T_world_from_cam"  # a hand-held camera's own motion
    return {"keys": keys, "target": target, "fps": info["fps"]}
