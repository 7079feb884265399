"""LeRobot: a window of frames of an enriched set, depth tokens, one training step of ACT that sees depth.

The samples go through LeRobot's own processors: pictures, depth, state and action are normalised by ``meta/stats``.

In an environment that has lerobot and dhtorch:  python benchmarks/clients/lerobot_policy.py DST
"""

import json
import sys

import torch
from columns import columns
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from torch.nn.functional import interpolate

from dhtorch import ExtendDepth
from dhtorch.transforms import ExtendedDataset

SIDE, HORIZON = 96, 4  # px; frames that are predicted
ACT = {"dim_model": 64, "dim_feedforward": 64, "n_heads": 2, "device": "cpu"}
PREFIX = "observation.dh_"  # of what is added to pictures named as LeRobot's: its processors keep such keys alone
STATE, TOKENS = "observation.state", "observation.environment_state"


def main(root: str) -> None:
    spec = columns(root)
    keys, target, step = spec["keys"], spec["target"], 1 / spec["fps"]
    window = {keys["image"]: [-2 * step, 0.0], keys["depth"]: [-2 * step, 0.0]}
    window[target] = [k * step for k in range(HORIZON)]
    data = LeRobotDataset("local/set", root=root, delta_timestamps=window, video_backend="pyav")
    extended = ExtendedDataset(data, ExtendDepth(**{**keys, "depth_unit": "auto"}, n=256, tokens_hw=(56, 56)))
    batch = torch.utils.data.default_collate([extended[i] for i in (2, 3)])

    image, depth, stats = keys["image"], keys["depth"], data.meta.stats
    batch |= {key: batch[key][:, -1].float() for key in (image, depth)}  # this frame of the window
    batch |= {"action": batch[target].float(), "action_is_pad": batch[f"{target}_is_pad"]}
    batch[STATE] = batch.get(STATE, batch["action"][:, 0]).float()
    batch[TOKENS] = batch[f"{PREFIX}tokens"].flatten(1)
    stats = {STATE: stats[target], **stats, "action": stats[target]}
    kinds = {image: FeatureType.VISUAL, depth: FeatureType.VISUAL, STATE: FeatureType.STATE, TOKENS: FeatureType.ENV}
    inputs = {key: PolicyFeature(kind, tuple(batch[key].shape[1:])) for key, kind in kinds.items()}
    outputs = {"action": PolicyFeature(FeatureType.ACTION, tuple(batch["action"].shape[2:]))}
    shape = {"chunk_size": HORIZON, "n_action_steps": HORIZON, "pretrained_backbone_weights": None}
    config = ACTConfig(input_features=inputs, output_features=outputs, **shape, **ACT)
    before, _ = make_pre_post_processors(config, dataset_stats=stats)
    sample = before(batch)
    mine = [key for key in batch if key.startswith(PREFIX)]
    assert all(torch.equal(sample[key], batch[key]) for key in mine), "the processors changed what dhtorch made"

    known = batch[depth] > 0  # 0 = no depth, which no statistics count
    seen = torch.where(known, sample[depth], 0.0).requires_grad_()
    policy_input = {**sample, image: interpolate(sample[image], (SIDE, SIDE))}
    policy_input[depth] = interpolate(seen.expand(-1, 3, -1, -1), (SIDE, SIDE))
    policy = ACTPolicy(config)
    optimiser = torch.optim.AdamW(policy.parameters(), 1e-4)
    loss, _ = policy(policy_input)
    loss.backward()
    through = policy.model.encoder_env_state_input_proj.weight.grad
    assert loss.isfinite() and through is not None and seen.grad is not None
    optimiser.step()
    result = {"frames": len(data), "target": target, "known": float(known.float().mean()), "loss": float(loss.detach())}
    result |= {"tokens_known": int(batch[f"{PREFIX}tokens_valid"].sum()), "kept": len(mine)}
    result |= {"gradient": bool(through.any()), "depth_gradient": bool(seen.grad.any())}
    if known.any():  # of normalised depth, m, over what is known
        result["normalised"] = [float(seen.detach()[known].mean()), float(seen.detach()[known].std())]
    print(json.dumps(result))


if __name__ == "__main__":
    main(sys.argv[1])
