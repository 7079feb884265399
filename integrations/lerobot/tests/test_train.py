"""``lerobot-train``, as installed, with a policy whose saved preprocessor has steps of this package."""

import json
import os
import subprocess
import sys
from pathlib import Path

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot_camera_dhtorch import GeometryImageStep, MaskSilenceStep, insert_steps

SET = os.environ["DHTORCH_LEROBOT_SET"]
DEPTH = "observation.images.left_depth_enriched"
MAPS = {"depth": DEPTH, "sigma": f"{DEPTH}_sigma", "source": "observation.images.left_dhtorch_source"}


def save_policy(folder):
    """A small ACT that sees the picture and the geometry image of the set's maps."""
    features = json.loads((Path(SET) / "meta" / "info.json").read_text())["features"]
    height, width = features[DEPTH]["shape"][1:]
    picture = features["observation.images.left"]["shape"]
    inputs = {"observation.state": PolicyFeature(FeatureType.STATE, (8,))}
    inputs["observation.images.left"] = PolicyFeature(FeatureType.VISUAL, (3, *picture[:2]))
    inputs["observation.images.geometry"] = PolicyFeature(FeatureType.VISUAL, (3, height, width))
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (8,))}
    small = {
        "dim_model": 64,
        "dim_feedforward": 64,
        "n_heads": 2,
        "device": "cpu",
        "chunk_size": 4,
        "n_action_steps": 4,
    }
    config = ACTConfig(
        input_features=inputs, output_features=outputs, pretrained_backbone_weights=None, push_to_hub=False, **small
    )
    before, after = make_pre_post_processors(
        config, dataset_stats={"action": {"mean": torch.zeros(8), "std": torch.ones(8)}}
    )
    masks = [MaskSilenceStep(keys=[DEPTH], stage=stage) for stage in ("before", "after")]
    insert_steps(
        before,
        before=[GeometryImageStep(to="observation.images.geometry", depth_unit="m", **MAPS), masks[0]],
        after=masks[1:],
    )
    for part in (ACTPolicy(config), before, after):
        part.save_pretrained(folder)


def test_lerobot_train_goes_on_with_a_saved_preprocessor(tmp_path):
    save_policy(tmp_path / "policy")
    words = [f"--policy.path={tmp_path / 'policy'}", "--policy.push_to_hub=false", "--policy.device=cpu"]
    words += ["--dataset.repo_id=local/set", f"--dataset.root={SET}", "--dataset.video_backend=pyav"]
    words += ["--steps=2", "--batch_size=2", "--num_workers=0", "--log_freq=1", f"--output_dir={tmp_path / 'out'}"]
    command = [sys.executable, "-m", "lerobot.scripts.lerobot_train", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "End of training" in done.stderr + done.stdout, done.stderr[-2000:]
    saved = list((tmp_path / "out" / "checkpoints").rglob("policy_preprocessor.json"))
    steps = [step.get("registry_name") for step in json.loads(saved[0].read_text())["steps"]]
    assert steps.count("dhtorch_mask_silence") == 2 and "dhtorch_geometry_image" in steps
