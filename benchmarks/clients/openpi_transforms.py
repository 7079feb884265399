"""openpi's interface: a chain of dict -> dict transforms with NumPy leaves, then every leaf stacked to a batch.

openpi itself is not on a package index; images are resized by its client, ``openpi_client``. A geometry image, where
the set has one, is passed as a second camera; the resizing does not blend its codes.

In an environment that has openpi-client and dhtorch:  python benchmarks/clients/openpi_transforms.py DST
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from columns import columns, train_step
from openpi_client import image_tools
from PIL import Image
from torch_loader import Rows

from dhtorch import ExtendDepth
from dhtorch.data.codecs.video import read_video_frame
from dhtorch.functional import decode_geometry_image
from dhtorch.transforms import NumpyTransform

GAP, SIDE = 2, 224  # frames; px
KEYS = {f"{key}": f"observation/{key}" for key in ("image", "other_image", "depth", "intrinsics")}


def policy_inputs(data: dict[str, Any]) -> dict[str, Any]:
    """Sample -> the model's inputs: images by the names that it expects, and depth tokens."""
    picture = image_tools.resize_with_pad(image_tools.convert_to_uint8(data["observation/image"]), SIDE, SIDE)
    images = {"image": {"base_0_rgb": picture}, "image_mask": {"base_0_rgb": np.True_}}
    if "observation/geometry" in data:
        geometry = image_tools.resize_with_pad(data["observation/geometry"], SIDE, SIDE, method=Image.NEAREST)
        images["image"]["left_wrist_0_rgb"], images["image_mask"]["left_wrist_0_rgb"] = geometry, np.True_
    tokens = {"depth_tokens": data["dhtorch.tokens"], "depth_mask": data["dhtorch.tokens_valid"]}
    return {**images, **tokens, "actions": np.asarray(data["actions"], np.float32), "prompt": data["prompt"]}


def stack(samples: list[Any]) -> Any:
    if isinstance(samples[0], dict):
        return {key: stack([sample[key] for sample in samples]) for key in samples[0]}
    return np.stack([np.asarray(sample) for sample in samples])


def main(root: str) -> None:
    spec = columns(root, tables=True)
    rows, keys = Rows(root), spec["keys"]

    def repacked(i: int) -> dict[str, Any]:
        out = {KEYS[name]: rows[i][keys[name]] for name in ("image", "depth", "intrinsics")}
        out[KEYS["other_image"]] = rows[i - GAP][keys["image"]]
        geometry = sorted(Path(root).glob(f"videos/**/{keys['image']}_geometry_image/**/*.mp4"))
        if geometry:  # a file for each episode, from its first frame
            file = geometry[rows[i]["episode_index"]]
            out["observation/geometry"] = read_video_frame(file, rows[i]["frame_index"])
        return {**out, "actions": rows[i][spec["target"]], "prompt": "look around"}

    extend = NumpyTransform(ExtendDepth(**KEYS, depth_unit=keys["depth_unit"], n=256, tokens_hw=(56, 56)))
    batch = stack([policy_inputs(extend(repacked(i))) for i in (GAP, GAP + 1)])
    tokens, target = torch.from_numpy(batch["depth_tokens"]), torch.from_numpy(batch["actions"])
    assert batch["image"]["base_0_rgb"].shape == (2, SIDE, SIDE, 3)
    geometry = batch["image"].get("left_wrist_0_rgb")
    more = {}
    if geometry is not None:  # every code is one of the stored ones
        stored = torch.from_numpy(np.stack([repacked(i)["observation/geometry"] for i in (GAP, GAP + 1)]))
        before, resized = (
            decode_geometry_image(each.movedim(-1, 1)).depth for each in (stored, torch.from_numpy(geometry))
        )
        assert {*resized.unique().tolist()} <= {0.0, *before.unique().tolist()}
        more["geometry_known"] = float((resized > 0).float().mean())
    train_step(tokens, batch["depth_mask"], target, frames=len(rows), target_column=spec["target"], **more)


if __name__ == "__main__":
    main(sys.argv[1])
