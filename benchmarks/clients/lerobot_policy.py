"""A set from ``dhtorch enrich`` in LeRobot: opened unmodified, a window of frames, one training step of ACT with depth.

Runs in an environment that has lerobot (0.4.4 and 0.6.1 were tried):  python benchmarks/clients/lerobot_policy.py DST
"""

import json
import os
import sys
from pathlib import Path

os.environ.setdefault("HF_HUB_OFFLINE", "1")

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy

SIDE, HORIZON = 96, 4  # px; frames that are predicted


def main(root: str) -> None:
    info = json.loads((Path(root) / "meta" / "info.json").read_text())
    features = info["features"]
    depth_key = next(k for k, f in features.items() if "quantiser_step_m" in f.get("info", {}) and "sigma" not in k)
    action_key = "action" if "action" in features else next(k for k in features if k.endswith("intrinsics"))
    window = {depth_key: [-1 / info["fps"], 0.0], action_key: [k / info["fps"] for k in range(HORIZON)]}
    data = LeRobotDataset("local/enriched", root=root, delta_timestamps=window, video_backend="pyav")
    batch = torch.utils.data.default_collate([data[i] for i in range(2, 4)])

    metres = depth_unit(data, depth_key) * batch[depth_key][:, -1].float()  # (B, 1, h, w), 0 = no depth
    near = torch.where(metres > 0, 1 / metres.clamp_min(0.1), 0.0)  # 1/m: no depth is infinitely far
    small = torch.nn.functional.interpolate(near, (SIDE, SIDE)).expand(-1, 3, -1, -1)
    colour = batch[depth_key.removesuffix("_depth")]
    sample = {
        "observation.images.colour": torch.nn.functional.interpolate(colour, (SIDE, SIDE)),
        "observation.images.depth": small.contiguous(),
        "observation.state": batch.get("observation.state", batch[action_key][:, 0]).float(),
        "action": batch[action_key].float(),
        "action_is_pad": batch[f"{action_key}_is_pad"],
    }
    n, m = sample["observation.state"].shape[-1], sample["action"].shape[-1]
    picture = PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE))
    config = ACTConfig(
        input_features={
            "observation.images.colour": picture,
            "observation.images.depth": picture,
            "observation.state": PolicyFeature(FeatureType.STATE, (n,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (m,))},
        chunk_size=HORIZON,
        n_action_steps=HORIZON,
        pretrained_backbone_weights=None,
        dim_model=64,
        dim_feedforward=64,
        n_heads=2,
        device="cpu",
    )
    policy = ACTPolicy(config)
    optimiser = torch.optim.AdamW(policy.parameters(), 1e-4)
    loss, _ = policy(sample)
    loss.backward()
    optimiser.step()
    through_depth = bool(policy.model.backbone.conv1.weight.grad.abs().sum() > 0)
    known = float((metres > 0).float().mean())
    print(json.dumps({"frames": len(data), "known": known, "loss": float(loss.detach()), "gradient": through_depth}))


def depth_unit(data: LeRobotDataset, key: str) -> float:
    """Metres in one of what the loader returns: millimetres since it knows depth, before that as stored."""
    return 1e-3 if getattr(data.meta, "depth_keys", None) and key in data.meta.depth_keys else 1.0


if __name__ == "__main__":
    main(sys.argv[1])
