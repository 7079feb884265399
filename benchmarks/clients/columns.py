"""What the clients share: names of an enriched set's columns, from its ``meta/info.json``, and one training step."""

import json
import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor


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


def train_step(tokens: Tensor, known: Any, target: Tensor, *, target_column: str, **result: Any) -> None:
    """One step of a network that predicts the target from depth tokens; prints its loss beside the ``result``."""
    head = torch.nn.Linear(tokens[0].numel(), target.shape[1])
    loss = (head(tokens.flatten(1)) - target).square().mean()
    loss.backward()
    torch.optim.SGD(head.parameters(), 1e-3).step()
    result |= {"target": target_column, "loss": float(loss.detach()), "tokens_known": int(known.sum())}
    print(json.dumps(result))
