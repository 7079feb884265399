"""The camera alone, in a robot, and a robot that a policy drives: LeRobot's own configuration, frames and inference."""

import json
import os
import subprocess
import sys
from pathlib import Path

import draccus
import lerobot
import numpy as np
import pytest
import torch
from fake_hardware import HW, RANGE_M, FakeArm, FakeArmConfig, FakeDepthCamera, FakeDepthCameraConfig, intrinsics, room
from lerobot.cameras import CameraConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.utils import make_robot_action, prepare_observation_for_inference
from lerobot.utils.import_utils import register_third_party_plugins

register_third_party_plugins()
from lerobot_camera_dhtorch import DhtorchCamera, DhtorchCameraConfig, ExtendDepthStep, insert_steps  # noqa: E402

from dhtorch import ExtendDepth  # noqa: E402
from dhtorch.codes import Source  # noqa: E402
from dhtorch.transforms import SampleProblem  # noqa: E402

try:
    from lerobot.rollout.inference.sync import SyncInferenceEngine
    from lerobot.utils.feature_utils import build_dataset_frame, hw_to_dataset_features
except ImportError:  # before 0.6
    from lerobot.datasets.utils import build_dataset_frame, hw_to_dataset_features

    SyncInferenceEngine = None

STATE, IMAGE = "observation.state", "observation.images.front"
TOKENS = "observation.environment_state"
STEPS = 5


def config(**options):
    return DhtorchCameraConfig(camera=FakeDepthCameraConfig(), intrinsics=intrinsics(), n=512, gap=2, **options)


def test_the_camera_gives_the_maps_of_extend_depth_beyond_the_sensors_range():
    camera = DhtorchCamera(config(size=128))
    sensor = FakeDepthCamera(FakeDepthCameraConfig())
    frames = [(sensor.read(), sensor.read_depth()) for _ in range(4)]
    with camera:
        pictures = [camera.read_latest() for _ in frames]
        depth, sigma = camera.read_latest_depth(), camera.read_latest_sigma()
        assert camera.read_latest_depth() is depth  # of the same picture: nothing is read anew
    assert np.array_equal(pictures[3], frames[3][0]) and depth.dtype == sigma.dtype == np.uint16
    extend = ExtendDepth(n=512, dense={"size": 128}, intrinsics=intrinsics(), depth_unit="mm", batched=False)
    image, whole = (torch.as_tensor(np.stack(pair)) for pair in zip(frames[1], frames[3], strict=True))
    out = extend({"image": image, "depth": whole})
    for given, name in ((depth, "depth_map"), (sigma, "sigma_map")):
        metres = out[f"dhtorch.{name}"].repeat_interleave(2, 0).repeat_interleave(2, 1)
        assert given.shape == (*HW, 1) and np.array_equal(given[..., 0] > 0, metres > 0)
        assert np.abs(given[..., 0] - 1000 * metres.numpy()).max() < 1
    far = (depth > 0) & (frames[3][1] == 0)
    truth = room(range_m=100.0)[3].depth[0].numpy()[..., None]
    assert far.mean() > 0.05 and np.median(depth[far]) > 1000 * RANGE_M
    known = far & (truth > 0)
    assert np.median(np.abs(depth[known] / 1000 / truth[known] - 1)) < 0.2


def test_the_first_frame_has_the_sensors_depth_and_a_reset_starts_anew():
    camera = DhtorchCamera(config(size=128))
    with camera:
        first = camera.read_depth()
        camera.read(), camera.read()
        assert (camera.read_depth() > 1200 * RANGE_M).any()
        camera.reset()
        assert not (camera.read_depth() > 1200 * RANGE_M).any() and not (first > 1200 * RANGE_M).any()


def test_the_same_picture_again_is_no_new_frame():
    camera = DhtorchCamera(config(size=64))
    with camera:
        for _ in range(20):  # the room's last frame repeats
            camera.read_latest()
        last, kept = camera.read_latest_depth(), len(camera.window.past)
        camera.read_latest()
        assert kept == 2 and camera.read_latest_depth() is last and not torch.equal(*(x[0] for x in camera.window.past))


def test_the_configuration_is_read_as_lerobot_reads_it():
    stated = {"type": "dhtorch", "camera": {"type": "fake_depth", "fps": 30}, "intrinsics": intrinsics()}
    parsed = draccus.decode(CameraConfig, stated)
    assert isinstance(parsed, DhtorchCameraConfig) and parsed.type == "dhtorch" and parsed.fps == 30
    assert isinstance(FakeArm(FakeArmConfig(cameras={"front": parsed})).cameras["front"], DhtorchCamera)
    with pytest.raises(ValueError, match="use_depth"):
        DhtorchCameraConfig(camera=FakeDepthCameraConfig(use_depth=False), intrinsics=intrinsics())


def save_policy(folder):
    """A small ACT with random weights that sees picture, state and depth tokens, with its processors."""
    numbers = {"intrinsics": intrinsics(), "depth_unit": "m", "gap": 2, "tokens_key": TOKENS}
    options = {"n": 512, "tokens_hw": (28, 28)}
    step = ExtendDepthStep(image=IMAGE, depth=f"{IMAGE}_depth", options=options, **numbers)
    count = step.single.blank_columns(HW)["tokens"].numel()
    inputs = {STATE: PolicyFeature(FeatureType.STATE, (8,)), TOKENS: PolicyFeature(FeatureType.ENV, (count,))}
    inputs[IMAGE] = PolicyFeature(FeatureType.VISUAL, (3, *HW))
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (8,))}
    small = {"dim_model": 64, "dim_feedforward": 64, "n_heads": 2, "chunk_size": 4, "n_action_steps": 1}
    small |= {"device": "cpu", "pretrained_backbone_weights": None}
    act = ACTConfig(input_features=inputs, output_features=outputs, **small)
    stats = {key: {"mean": torch.zeros(8), "std": torch.ones(8)} for key in (STATE, "action")}
    stats[IMAGE] = {"mean": torch.full((3, 1, 1), 0.5), "std": torch.full((3, 1, 1), 0.25)}
    torch.manual_seed(0)
    before, after = make_pre_post_processors(act, dataset_stats=stats)
    insert_steps(before, before=[step])
    for part in (ACTPolicy(act), before, after):
        part.save_pretrained(folder)


@pytest.mark.skipif(SyncInferenceEngine is None, reason="lerobot-rollout is in LeRobot 0.6 and later")
def test_lerobot_rollout_runs_the_saved_policy_on_the_camera(tmp_path):
    save_policy(tmp_path)
    camera = {"type": "dhtorch", "intrinsics": intrinsics(), "gap": 2, "n": 512, "camera": {"type": "fake_depth"}}
    words = ["--strategy.type=base", f"--policy.path={tmp_path}", "--policy.device=cpu", "--device=cpu", "--fps=2"]
    words += ["--duration=4", "--robot.type=fake_arm", "--robot.discover_packages_path=fake_hardware"]
    words += [f"--robot.cameras={json.dumps({'front': camera})}", "--play_sounds=false"]
    path = os.pathsep.join([str(Path(__file__).parent), os.environ["PYTHONPATH"]])
    command = [sys.executable, "-m", "lerobot.scripts.lerobot_rollout", *words]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "Rollout finished" in done.stderr + done.stdout, done.stderr[-2000:]
    assert int(done.stdout.split("actions sent: ")[1].split()[0]) > 3


@pytest.mark.parametrize("wrapped", [False, True], ids=["depth camera", "dhtorch camera"])
def test_a_policy_drives_a_robot_from_a_saved_folder(wrapped, tmp_path):
    camera = config(size=64) if wrapped else FakeDepthCameraConfig()
    arm = FakeArm(FakeArmConfig(cameras={"front": camera}))
    arm.connect()
    features = hw_to_dataset_features(arm.observation_features, "observation")
    features |= hw_to_dataset_features(arm.action_features, "action")
    save_policy(tmp_path)
    policy = ACTPolicy.from_pretrained(tmp_path)
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(tmp_path))
    seen = []
    last = len(before.steps) - 1
    before.register_after_step_hook(lambda i, row: seen.append(row["observation"]) if i == last else None)
    assert (SyncInferenceEngine is None) == (lerobot.__version__ < "0.6")
    names = list(arm.action_features)
    engine = (SyncInferenceEngine or Loop)(policy, before, after, features, names, "task", "cpu", arm.name)
    for episode in range(2):
        engine.reset()
        for _ in range(STEPS if episode == 0 else 1):
            action = engine.get_action(build_dataset_frame(features, arm.get_observation(), prefix="observation"))
            arm.send_action(dict(zip(names, action.tolist(), strict=True)))
    arm.disconnect()
    assert len(arm.sent) == STEPS + 1 and all(np.isfinite(list(sent.values())).all() for sent in arm.sent)
    assert len({tuple(sent.values()) for sent in arm.sent}) > 1
    problems = [row["observation.dh_problem"].item() for row in seen]
    none, no_view = SampleProblem.NONE, SampleProblem.NO_SECOND_VIEW
    assert problems == [no_view, no_view, *[none] * (STEPS - 2), no_view]
    recovered = [bool((row["observation.dh_source"] == Source.RECOVERED).any()) for row in seen]
    assert any(recovered[2:STEPS]) and not any(recovered[:2]) and not recovered[-1]


class Loop:
    """Inference as LeRobot 0.4 has it in its scripts; 0.6 has its own engine."""

    def __init__(self, policy, before, after, features, names, task, device, robot):
        self.parts, self.features, self.names, self.robot = (policy, before, after), features, names, robot

    def reset(self):
        for part in self.parts:
            part.reset()

    def get_action(self, frame):
        policy, before, after = self.parts
        with torch.inference_mode():
            frame = prepare_observation_for_inference(frame, torch.device("cpu"), "task", self.robot)
            action = make_robot_action(after(policy.select_action(before(frame))), self.features)
        return torch.tensor([action[name] for name in self.names])
