"""LeRobot: a window of frames of an enriched set, depth tokens, one training step of ACT that sees depth.

In an environment that has lerobot and dhtorch:  python benchmarks/clients/lerobot_policy.py DST
"""

import inspect
import json
import sys

import torch
from columns import columns
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from torch.nn.functional import interpolate

from dhtorch import ExtendDepth
from dhtorch.transform import ExtendedDataset

SIDE, HORIZON = 96, 4  # px; frames that are predicted
ACT, NAMES = {"dim_model": 64, "dim_feedforward": 64, "n_heads": 2, "device": "cpu"}, ("colour", "depth")


def main(root: str) -> None:
    found = columns(root)
    keys, target, step = found["keys"], found["target"], 1 / found["fps"]
    window = {keys["image"]: [-2 * step, 0.0], keys["depth"]: [-2 * step, 0.0]}
    window[target] = [k * step for k in range(HORIZON)]
    metres = {"depth_output_unit": "m"} if "depth_output_unit" in inspect.signature(LeRobotDataset).parameters else {}
    data = LeRobotDataset("local/set", root=root, delta_timestamps=window, video_backend="pyav", **metres)
    extended = ExtendedDataset(data, ExtendDepth(**keys, n=256, tokens_hw=(56, 56)))
    batch = torch.utils.data.default_collate([extended[i] for i in (2, 3)])

    z = batch[keys["depth"]][:, -1].float()  # (B, 1, h, w) m, 0 = no depth
    pictures = batch[keys["image"]][:, -1], torch.where(z > 0, 1 / z.clamp_min(0.1), 0.0).expand(-1, 3, -1, -1)
    sample = {f"observation.images.{n}": interpolate(x, (SIDE, SIDE)) for n, x in zip(NAMES, pictures, strict=True)}
    sample["observation.environment_state"] = batch["dhtorch.tokens"].flatten(1)
    sample["observation.state"] = batch.get("observation.state", batch[target][:, 0]).float()
    sample |= {"action": batch[target].float(), "action_is_pad": batch[f"{target}_is_pad"]}
    inputs = {f"observation.images.{n}": PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE)) for n in NAMES}
    for key, kind in (("observation.environment_state", FeatureType.ENV), ("observation.state", FeatureType.STATE)):
        inputs[key] = PolicyFeature(kind, tuple(sample[key].shape[1:]))
    outputs = {"action": PolicyFeature(FeatureType.ACTION, tuple(sample["action"].shape[2:]))}
    shape = {"chunk_size": HORIZON, "n_action_steps": HORIZON, "pretrained_backbone_weights": None}
    policy = ACTPolicy(ACTConfig(input_features=inputs, output_features=outputs, **shape, **ACT))
    optimiser = torch.optim.AdamW(policy.parameters(), 1e-4)
    loss, _ = policy(sample)
    loss.backward()
    through = policy.model.encoder_env_state_input_proj.weight.grad
    assert through is not None
    optimiser.step()
    said = {"frames": len(data), "target": target, "known": float((z > 0).float().mean()), "loss": float(loss.detach())}
    print(
        json.dumps(said | {"tokens_known": int(batch["dhtorch.tokens_valid"].sum()), "gradient": bool(through.any())})
    )


if __name__ == "__main__":
    main(sys.argv[1])
