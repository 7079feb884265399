"""RLDS without TensorFlow: steps of TFRecord files as a generator in OpenVLA's form, depth tokens, one training step.

python benchmarks/clients/rlds_steps.py SET [DEGREES FROM SIDE TO SIDE]
"""

import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from columns import train_step
from torch.utils.data import default_collate

from dhtorch import ExtendDepth
from dhtorch.data import open_all
from dhtorch.data.codecs import tfrecord
from dhtorch.geometry.camera import to_matrix
from dhtorch.transforms import RldsBatchTransform

IMAGE, GAP = "observation.image_primary", 2


def steps(root: str, **options: Any) -> Iterator[dict[str, Any]]:
    """Every step with the picture some steps before it; the first ones of an episode are padded with their own."""
    files = sorted(Path(root).glob("*-train.tfrecord-*"))
    records = [(file, span) for file in files for span in tfrecord.index_records(file)]
    episodes = open_all(root, "rlds", split="train", camera="observation/image_0", **options)
    for (file, span), recording in zip(records, episodes, strict=True):
        features = tfrecord.parse_example(tfrecord.read_record(file, span), file, span.offset)
        actions = tfrecord.read_feature_numbers(file, "action", features["steps/action"], 7 * len(recording)).reshape(
            -1, 7
        )
        for i in range(len(recording)):
            frame, pair = recording[i], [recording[max(i - GAP, 0)].image[0], recording[i].image[0]]
            pictures = torch.stack(pair).movedim(1, -1).numpy()
            observation = {"image_primary": pictures, "depth_primary": frame.depth[0].numpy()}
            task = {"language_instruction": b"look around"}
            more = {f"{IMAGE}_is_pad": np.array([i < GAP, False]), "intrinsics": to_matrix(frame.camera)[0].numpy()}
            yield {"observation": observation, "task": task, "action": actions[i].astype(np.float32), **more}


def model_inputs(step: dict[str, Any]) -> dict[str, Any]:
    return {"pixel_values": torch.from_numpy(step["observation"]["image_primary"][-1].copy()), "action": step["action"]}


def main(root: str, fov: str | None = None) -> None:
    keys = {"image": IMAGE, "depth": "observation.depth_primary", "intrinsics": "intrinsics", "depth_unit": "m"}
    transform = RldsBatchTransform(model_inputs, ExtendDepth(**keys, n=256, tokens_hw=(56, 56)))
    options = {} if fov is None else {"fov": float(fov)}
    batch = default_collate([transform(step) for step in islice(steps(root, **options), GAP, GAP + 2)])
    tokens, known = batch["dhtorch.tokens"], batch["dhtorch.tokens_valid"]
    frames = sum(1 for _ in steps(root, **options))
    train_step(tokens, known, batch["action"], frames=frames, target_column="action")


if __name__ == "__main__":
    main(*sys.argv[1:])
