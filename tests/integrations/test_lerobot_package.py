"""integrations/lerobot without LeRobot: its window of frames and its steps for depth."""

import enum
import importlib
import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
from support.sample_dicts import SIDE, depth_video

from dhtorch import ExtendDepth
from dhtorch.functional import decode_geometry_image
from dhtorch.transforms import declared_depth_range, declared_depth_unit

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "integrations" / "lerobot"
NAME = "lerobot_camera_dhtorch"


@pytest.fixture(scope="module")
def window():
    """The module of the window, which imports no LeRobot."""
    spec = importlib.util.spec_from_file_location("window", PACKAGE / NAME / "window.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def steps():
    """The module of the steps, beside stand-ins for the few classes of LeRobot that it names."""
    stubs = {name: ModuleType(name) for name in ("lerobot", "lerobot.configs", "lerobot.configs.types", NAME)}
    processor = stubs["lerobot.processor"] = ModuleType("lerobot.processor")
    for name in ("FeatureType", "PipelineFeatureType", "PolicyFeature"):
        setattr(stubs["lerobot.configs.types"], name, object)
    processor.DataProcessorPipeline, processor.ProcessorStep = list, type("ProcessorStep", (), {})
    processor.ProcessorStepRegistry = SimpleNamespace(register=lambda name: lambda step: step)
    processor.TransitionKey = enum.Enum("TransitionKey", ["OBSERVATION", "COMPLEMENTARY_DATA", "DONE", "TRUNCATED"])
    stubs[NAME].__path__ = [str(PACKAGE / NAME)]  # the package without its __init__, which needs cameras
    with pytest.MonkeyPatch.context() as patched:
        for name, module in stubs.items():
            patched.setitem(sys.modules, name, module)
        yield importlib.import_module(f"{NAME}.steps")
        for name in [name for name in sys.modules if name.startswith(f"{NAME}.")]:
            del sys.modules[name]


IMAGE, DEPTH = "observation.images.wrist", "observation.images.wrist_depth"
K = [100.0, 100.0, (SIDE - 1) / 2, (SIDE - 1) / 2]


@pytest.fixture(params=["mm", "m"])
def video(request):
    """A data set with a depth video, the observation of a frame, and its depth in m: ramps, 0 = none at both ends."""
    data = SimpleNamespace(**depth_video(DEPTH, request.param))
    truth = torch.linspace(0.5, 4.0, SIDE * SIDE).reshape(SIDE, SIDE).mul(1000).round().div(1000)
    handed = truth.clone()
    truth[:20], truth[-20:], handed[:20], handed[-20:] = 0.0, 0.0, 0.01, 10.0
    handed = handed * (1000 if request.param == "mm" else 1)
    observation = {IMAGE: torch.rand(1, 3, SIDE, SIDE), DEPTH: handed[None, None]}
    return data, observation, truth


def run(steps, step, observation):
    return step({steps.TransitionKey.OBSERVATION: observation})[steps.TransitionKey.OBSERVATION]


def test_pictures_and_points_of_a_depth_video_are_in_metres_without_its_ends(steps, video):
    data, observation, truth = video
    observation |= {"sigma": 0.01 * observation[DEPTH], "source": torch.ones(1, SIDE, SIDE)}
    step = steps.GeometryImageStep.from_dataset(data, DEPTH, to="picture", sigma="sigma", source="source")
    maps = decode_geometry_image(run(steps, step, observation)["picture"])
    known = truth > 0
    assert torch.equal(maps.depth[0] > 0, known) and (maps.depth[0] / truth - 1)[known].abs().max() < 0.032
    assert ((maps.sigma[0] / maps.depth[0])[known] / 0.01 - 1).abs().max() < 0.02
    step = steps.PointCloudStep.from_dataset(data, DEPTH, image=IMAGE, intrinsics=K, n=SIDE * SIDE)
    z = run(steps, step, observation)["observation.points"][0, :, 2]
    assert torch.equal(z.unique(), truth[known].unique())
    assert run(steps, type(step)(**json.loads(json.dumps(step.config))), observation)["observation.points"].equal(
        run(steps, step, observation)["observation.points"]
    )
    with pytest.raises(ValueError, match=f"{DEPTH}: depth_unit is None, expected m or mm; from_dataset"):
        steps.PointCloudStep(image=IMAGE, intrinsics=K, depth=DEPTH)


def test_a_mask_leaves_out_the_ends_of_a_depth_video_alone(steps, video):
    data, observation, truth = video
    step = steps.MaskSilenceStep.from_dataset(data, [DEPTH, "observation.dh_sigma_map"], "before")
    step = steps.MaskSilenceStep(**json.loads(json.dumps(step.config)))
    observation["observation.dh_sigma_map"] = torch.tensor([[0.0, 0.004, 20.0]])
    out = run(steps, step, observation)
    assert torch.equal(out[f"{DEPTH}_known"][0, 0], truth > 0)
    assert out["observation.dh_sigma_map_known"].tolist() == [[False, True, True]]
    whole = {**observation, DEPTH: torch.tensor([[0, 9, 500, 20_000]], dtype=torch.int32)}  # a robot's camera
    assert run(steps, step, whole)[f"{DEPTH}_known"].tolist() == [[False, True, True, True]]


def test_depth_of_windows_validations_and_references_has_the_limits_of_its_video(steps, video):
    data, observation, truth = video
    data.root, data.meta.stats = Path("none"), {}
    for kind in (steps.ExtendDepthStep, steps.ValidateDepthStep):
        step = kind.from_dataset(data, IMAGE, intrinsics=K, options={"n": 32})
        step = kind(**json.loads(json.dumps(step.config)))
        assert torch.equal(step.single.views.metres([observation[DEPTH][0]])[0, 0] > 0, truth > 0)
    pin = steps.CameraPinStep(image=IMAGE, intrinsics=K)
    stated = {"depth_unit": declared_depth_unit(data, DEPTH), "depth_range": declared_depth_range(data, DEPTH)}
    pin.set_reference(observation[IMAGE], observation[DEPTH], **stated)
    torch.testing.assert_close(pin.pin.frame.depth[0], truth)
    pin.load_state_dict(pin.state_dict())
    torch.testing.assert_close(pin.pin.frame.depth[0], truth)


@pytest.mark.parametrize("gap", [1, 2, 3])
def test_windows_of_a_running_episode_are_those_of_a_loader(window, gap):
    frames = torch.arange(12.0).reshape(6, 2)
    stream = window.FrameWindow(gap)
    for start, stop in ((0, 4), (4, 6)):
        for i in range(start, stop):
            images, depths, is_pad = stream.push(frames[i], 10 * frames[i])
            earlier = max(i - gap, start)  # LeRobot's: held at the first frame of the episode, and marked
            assert torch.equal(images, frames[[earlier, i]]) and torch.equal(depths, 10 * images)
            assert is_pad.tolist() == [i - gap < start, False]
        stream.reset()


def test_state_is_the_past_and_a_buffer_that_is_filled_anew_does_not_change_it(window):
    first, buffer = window.FrameWindow(2), torch.zeros(3)
    assert first.state_dict() == {}
    for value in (1.0, 2.0, 3.0):
        first.push(buffer.fill_(value), buffer)
    second = window.FrameWindow(2)
    second.load_state_dict(first.state_dict())
    images, _, is_pad = second.push(buffer.fill_(4.0), buffer)
    assert images[:, 0].tolist() == [2.0, 4.0] and not is_pad.any()
    second.load_state_dict({})
    assert second.push(buffer, buffer)[2].tolist() == [True, False]
    with pytest.raises(ValueError, match="at least 1"):
        window.FrameWindow(0)


def test_blank_columns_have_the_shapes_of_a_sample():
    transform = ExtendDepth(depth_unit="m", n=32, dense={"size": 40}, batched=False)
    K = torch.tensor([[60.0, 0, 40], [0, 60, 30], [0, 0, 1]])
    sample = {"image": torch.rand(3, 60, 80), "depth": torch.ones(30, 40), "intrinsics": K}
    blank = transform.blank_columns((60, 80))
    out = transform(sample)
    assert {f"dhtorch.{key}": x.shape[1:] for key, x in blank.items()} == {
        key: x.shape for key, x in out.items() if key not in sample
    }
