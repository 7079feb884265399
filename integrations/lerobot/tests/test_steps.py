"""The processor steps, in LeRobot's own pipelines, on a set that ``dhtorch enrich`` wrote (``DHTORCH_LEROBOT_SET``)."""

import inspect
import os
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fake_hardware import HW, RANGE_M, FakeDepthCamera, FakeDepthCameraConfig, intrinsics
from lerobot.cameras import CameraConfig
from lerobot.configs.types import FeatureType, NormalizationMode, PipelineFeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.processor import NormalizerProcessorStep, PolicyProcessorPipeline, ProcessorStepRegistry
from lerobot.utils.import_utils import register_third_party_plugins

register_third_party_plugins()  # nothing here imports the package by name before LeRobot has found it
from lerobot_camera_dhtorch import (  # noqa: E402
    CameraPinStep,
    ExtendDepthStep,
    GeometryImageStep,
    MaskSilenceStep,
    PointCloudStep,
    ValidateDepthStep,
    insert_steps,
)

from dhtorch import ExtendDepth  # noqa: E402
from dhtorch.codes import Source  # noqa: E402
from dhtorch.functional import decode_geometry_image  # noqa: E402
from dhtorch.transforms import (  # noqa: E402
    ExtendedDataset,
    SampleError,
    declared_depth_range,
    declared_depth_unit,
)

IMAGE = "observation.images.left"
DEPTH = f"{IMAGE}_depth"
QUICK = {"n": 512, "dense": {"size": 64}}
K = "observation.left.intrinsics"
LENGTH = 10  # frames of an episode


@cache
def dataset(gap=0):
    """The set; with a gap its samples are windows of two frames."""
    info = LeRobotDataset("local/set", root=os.environ["DHTORCH_LEROBOT_SET"], video_backend="pyav")
    if not gap:
        return info
    window = {key: [-gap / info.fps, 0.0] for key in (IMAGE, DEPTH)}
    root = os.environ["DHTORCH_LEROBOT_SET"]
    return LeRobotDataset("local/set", root=root, delta_timestamps=window, video_backend="pyav")


@cache
def column(gap, index):
    """What a data loader has for one frame."""
    transform = ExtendDepth(image=IMAGE, depth=DEPTH, intrinsics=K, depth_unit="auto", **QUICK)
    sample = ExtendedDataset(dataset(gap), transform)[index]
    return {key: value for key, value in sample.items() if key.startswith("observation.dh_")}


def batch(index):
    """One frame as a robot's pipeline has it: a batch of one."""
    return {key: x[None] for key, x in dataset()[index].items() if key.startswith("observation.")}


class Rows:
    """The set with other metadata."""

    def __init__(self, meta):
        self.meta, self.root = meta, dataset().root

    def __getitem__(self, index):
        return dataset()[index]


def extend(gap=2, **more):
    return ExtendDepthStep.from_dataset(dataset(), IMAGE, DEPTH, gap=gap, **{"options": QUICK, **more})


def equal(out, column):
    assert "observation.dh_depth_map" in column
    return all(torch.equal(out[key][0], value) for key, value in column.items())


def reloaded(pipeline, folder):
    pipeline.save_pretrained(folder)
    return PolicyProcessorPipeline.from_pretrained(folder, config_filename=f"{pipeline.name.lower()}.json")


def test_lerobot_finds_the_steps_and_the_camera():
    names = {"extend_depth", "validate_depth", "mask_silence", "geometry_image", "point_cloud", "camera_pin"}
    assert {f"dhtorch_{name}" for name in names} <= set(ProcessorStepRegistry.list())
    assert "dhtorch" in CameraConfig.get_known_choices()


def test_unit_and_intrinsics_are_those_of_the_set():
    assert (extend().views.depth_unit, extend().views.intrinsics) == ("m", K)  # two cameras, one for each episode
    numbers = dataset()[0][K]
    one = SimpleNamespace(features=dataset().meta.features, stats={K: {"min": numbers.numpy(), "max": numbers.numpy()}})
    step = ExtendDepthStep.from_dataset(Rows(one), IMAGE, DEPTH)
    assert step.get_config()["intrinsics"] == numbers.tolist()
    with pytest.raises(ValueError, match="intrinsics"):
        ExtendDepthStep.from_dataset(Rows(SimpleNamespace(features={}, stats={})), IMAGE, DEPTH)


@pytest.mark.parametrize("gap", [1, 2])
def test_a_saved_preprocessor_gives_the_loaders_bits_frame_by_frame(gap, tmp_path):
    pipeline = reloaded(PolicyProcessorPipeline(steps=[extend(gap)], name="policy_preprocessor"), tmp_path)
    assert {Source.SENSOR, Source.RECOVERED} <= set(column(2, 4)["observation.dh_source"].tolist())
    assert Source.SWEPT in column(2, 4)["observation.dh_source_map"]
    with torch.inference_mode():
        for episode in range(2):
            for index in range(4):
                assert equal(pipeline(batch(episode * LENGTH + index)), column(gap, episode * LENGTH + index))
            pipeline.reset()  # without it the first frame of the next episode would have a source view


def test_a_batch_of_windows_gives_the_same_bits():
    pipeline = PolicyProcessorPipeline(steps=[extend(2)])
    samples = torch.utils.data.default_collate([dataset(2)[i] for i in (7, 1, 12)])
    out = pipeline({key: x for key, x in samples.items() if key.startswith("observation.")})
    for row, index in enumerate((7, 1, 12)):
        if index != 1:  # the windows' padding flags are left out here
            assert all(torch.equal(out[key][row], value) for key, value in column(2, index).items())
    out = pipeline(samples)
    assert all(torch.equal(out[key][1], value) for key, value in column(2, 1).items())


def test_state_holds_the_keyframes_and_an_episode_of_another_number_drops_them(tmp_path):
    first = PolicyProcessorPipeline(steps=[extend(2)], name="policy_preprocessor")
    numbered = [
        {**batch(i), "index": torch.tensor([i]), "episode_index": torch.tensor([i // LENGTH])} for i in (7, 8, 9, 10)
    ]
    for sample in numbered[:2]:
        first(sample)
    second = reloaded(first, tmp_path)
    out = second(numbered[2])
    assert equal(out, column(2, 9))
    assert equal(second(numbered[3]), column(2, 10))
    first.reset()
    assert not equal(first(numbered[2]), column(2, 9))


def test_columns_of_the_loader_pass_and_frames_in_random_order_are_refused():
    pipeline = PolicyProcessorPipeline(steps=[extend(2)])
    sample = {**batch(5), **{key: x[None] for key, x in column(2, 5).items()}}
    out = pipeline(sample)
    assert equal(out, column(2, 5)) and not pipeline.steps[0].state_dict()
    both = {key: torch.cat([x, x]) for key, x in batch(5).items()}
    with pytest.raises(SampleError, match="without a window"):
        pipeline(both)


def test_two_steps_with_prefixes_of_their_own_stand_beside_each_other():
    options = {"n": 64, "tokens_hw": (14, 14)}
    steps = [extend(1, prefix=f"observation.dh_{name}_", options=options) for name in ("left", "right")]
    out = PolicyProcessorPipeline(steps=steps)(batch(0))
    assert torch.equal(out["observation.dh_left_tokens"], out["observation.dh_right_tokens"])


def test_whole_millimetres_of_a_camera_become_the_unit_of_the_set():
    pipeline = PolicyProcessorPipeline(steps=[extend(1)])
    scale = 1000 if pipeline.steps[0].get_config()["depth_unit"] == "m" else 1
    whole = {**batch(0), DEPTH: (batch(0)[DEPTH] * scale).round().to(torch.uint16)}
    out = pipeline(whole)
    assert (out[DEPTH] - batch(0)[DEPTH]).abs().max() <= 0.51 / scale and out[DEPTH].is_floating_point()


def test_features_are_those_of_the_columns():
    step = extend(1, tokens_key="observation.environment_state")
    known = {
        PipelineFeatureType.OBSERVATION: {IMAGE: PolicyFeature(FeatureType.VISUAL, tuple(batch(0)[IMAGE].shape[1:]))}
    }
    features = step.transform_features(known)[PipelineFeatureType.OBSERVATION]
    out = PolicyProcessorPipeline(steps=[step])(batch(0))
    added = {key: tuple(x.shape[1:]) for key, x in out.items() if key.startswith("observation.dh_")}
    added["observation.environment_state"] = tuple(out["observation.environment_state"].shape[1:])
    assert {key: feature.shape for key, feature in features.items() if key != IMAGE} == added


@pytest.mark.parametrize("on_bad", ["flag", "clear", "drop"])
def test_bad_frames_are_flagged_cleared_or_dropped(on_bad):
    step = ValidateDepthStep.from_dataset(dataset(), IMAGE, DEPTH, on_bad=on_bad, options={"n": 512})
    samples = [dataset(2)[i] for i in (4, 6)]
    wrong = samples[1][DEPTH].clone()
    wrong[-1, :, 70:86, 40:70] *= 0.8
    samples[1] = {**samples[1], DEPTH: wrong}
    sample = torch.utils.data.default_collate(samples)
    out = PolicyProcessorPipeline(steps=[step])(sample)
    assert out["observation.dh_depth_ok"].tolist() == ([True] if on_bad == "drop" else [True, False])
    assert len(out[IMAGE]) == len(out["task"]) == len(out["action"]) == (1 if on_bad == "drop" else 2)
    assert torch.equal(out[DEPTH][0], sample[DEPTH][0]) and out["observation.dh_state_share"][0, 1] > 0.3
    assert on_bad == "drop" or bool(out[DEPTH][1].any()) == (on_bad == "flag")
    if on_bad == "drop":
        with pytest.raises(SampleError, match="no frame"):
            PolicyProcessorPipeline(steps=[step])({key: x[1:] for key, x in sample.items()})


def test_a_frame_without_evidence_is_bad_where_evidence_is_wanted():
    sample = torch.utils.data.default_collate([dataset(2)[4]])
    sample[DEPTH][:, -1, :, 50:75, 60:85] *= 0.8  # no motion explains these returns
    for min_known, ok in ((0.0, True), (0.2, False)):
        step = ValidateDepthStep.from_dataset(dataset(), IMAGE, DEPTH, min_known=min_known, options={"n": 512})
        assert PolicyProcessorPipeline(steps=[step])(sample)["observation.dh_depth_ok"].tolist() == [ok]
    sample[DEPTH] *= 1000  # another unit than stated
    assert PolicyProcessorPipeline(steps=[step])(sample)["observation.dh_depth_ok"].tolist() == [False]
    with pytest.raises(SampleError, match="found no such key"):
        PolicyProcessorPipeline(steps=[step])({key: x for key, x in sample.items() if key != K})


def test_the_example_of_the_page_runs(tmp_path):
    code = (Path(__file__).parents[1] / "README.md").read_text().split("```python\n")[1].split("```")[0]
    features = {DEPTH: PolicyFeature(FeatureType.VISUAL, tuple(batch(0)[DEPTH].shape[1:]))}
    normalizer = NormalizerProcessorStep(
        features, {FeatureType.VISUAL: NormalizationMode.MEAN_STD}, dataset().meta.stats
    )
    pipeline = PolicyProcessorPipeline(steps=[normalizer], name="policy_preprocessor")
    names = {"dataset": dataset(), "preprocessor": pipeline, "folder": tmp_path}
    exec(code.replace(".wrist", ".left"), names)
    out = reloaded(names["preprocessor"], tmp_path)(batch(4))
    silent = batch(4)[DEPTH] == 0
    assert silent.any() and not out[DEPTH][silent].any() and out["observation.environment_state"].any()


@pytest.mark.parametrize("mode", ["MEAN_STD", "MIN_MAX"])
def test_silence_is_zero_after_the_normaliser(mode, tmp_path):
    key = f"{DEPTH}_enriched"
    features = {key: PolicyFeature(FeatureType.VISUAL, tuple(batch(0)[key].shape[1:]))}
    normalizer = NormalizerProcessorStep(features, {FeatureType.VISUAL: NormalizationMode(mode)}, dataset().meta.stats)
    pipeline = PolicyProcessorPipeline(steps=[normalizer], name="policy_preprocessor")
    sample = batch(4)
    silent = sample[key] == 0
    assert silent.any() and (plain := pipeline(sample)[key])[silent].abs().min() > 0.5
    steps = [MaskSilenceStep(keys=[key], stage=stage) for stage in ("before", "after")]
    insert_steps(pipeline, before=steps[:1], after=steps[1:])
    out = reloaded(pipeline, tmp_path)(sample)
    assert not out[key][silent].any() and torch.equal(out[key][~silent], plain[~silent])
    assert torch.equal(out[f"{key}_known"], ~silent)


def test_pictures_and_points_are_of_the_far_depth():
    steps = [extend(2), GeometryImageStep(to="observation.images.geometry")]
    steps.append(PointCloudStep(image=IMAGE, intrinsics=K, n=200))
    pipeline = PolicyProcessorPipeline(steps=steps)
    for index in range(3, 6):
        out = pipeline(batch(index))
    depth, points = out["observation.dh_depth_map"], out["observation.points"]
    maps = decode_geometry_image(out["observation.images.geometry"])
    assert torch.equal(maps.depth > 0, depth > 0) and (maps.depth - depth).abs().max() < 0.5
    assert torch.equal(maps.source, out["observation.dh_source_map"])
    size = torch.tensor([batch(0)[IMAGE].shape[-1], batch(0)[IMAGE].shape[-2]])
    uv = (points[0] @ batch(3)[K].reshape(3, 3).T)[:, :2] / points[0, :, 2:]
    uv = (uv + 0.5) * torch.tensor([depth.shape[-1], depth.shape[-2]]) / size - 0.5
    assert points.shape == (1, 200, 3) and (uv - uv.round()).abs().max() < 1e-3
    u, v = uv.round().long().T
    assert torch.allclose(depth[0, v, u], points[0, :, 2])


def test_a_moved_camera_is_seen_and_the_reference_is_saved(tmp_path):
    numbers = dataset()[0][K].reshape(3, 3)
    intrinsics = [float(numbers[0, 0]), float(numbers[1, 1]), float(numbers[0, 2]), float(numbers[1, 2])]
    step = CameraPinStep(image=IMAGE, intrinsics=intrinsics)
    with pytest.raises(SampleError, match="no reference"):
        PolicyProcessorPipeline(steps=[step])(batch(0))
    step.set_reference(batch(0)[IMAGE], batch(0)[DEPTH])
    pipeline = reloaded(PolicyProcessorPipeline(steps=[step], name="policy_preprocessor"), tmp_path)
    still, moved = (pipeline(batch(index)) for index in (0, 4))
    assert still["observation.dh_pin_verdict"].tolist() == [0] and moved["observation.dh_pin_verdict"].tolist() == [1]
    assert still["observation.dh_pin_shift_px"] < 0.1 < moved["observation.dh_pin_shift_px"]
    strict = CameraPinStep(image=IMAGE, intrinsics=intrinsics, max_px=0.5)
    strict.set_reference(batch(0)[IMAGE], batch(0)[DEPTH])
    with pytest.raises(SampleError, match="camera moved by at least"):
        PolicyProcessorPipeline(steps=[strict])(batch(4))


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """Folder of a set whose depth LeRobot writes as video, with default options, and the depth (n, H, W) in m; 0 = none.

    The farthest returns of the last rows are beyond the range of the codes."""
    if "depth_output_unit" not in inspect.signature(LeRobotDataset).parameters:
        pytest.skip("LeRobot knows no depth before 0.6")
    root, truth = tmp_path_factory.mktemp("video") / "set", []
    picture = {"dtype": "video", "names": ["height", "width", "channels"]}
    features = {IMAGE: {**picture, "shape": (*HW, 3)}, "action": {"dtype": "float32", "shape": (2,), "names": None}}
    features[DEPTH] = {**picture, "shape": (*HW, 1), "info": {"is_depth_map": True}}
    written = LeRobotDataset.create("local/video", fps=30, root=root, features=features, use_videos=True)
    camera = FakeDepthCamera(FakeDepthCameraConfig())
    for _ in range(5):
        image, depth = camera.read(), camera.read_depth()
        depth[-8:] = 12_000
        written.add_frame({IMAGE: image, DEPTH: depth, "action": np.zeros(2, np.float32), "task": "look"})
        truth.append(np.where(depth < 10_000, depth, 0)[..., 0] / 1000)
    written.save_episode()
    written.finalize()
    return root, torch.from_numpy(np.stack(truth))


def opened(video, unit, **more):
    return LeRobotDataset("local/video", root=video[0], video_backend="pyav", depth_output_unit=unit, **more)


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_steps_read_the_ends_of_a_depth_video_as_no_returns(unit, video, tmp_path):
    data, truth = opened(video, unit), video[1][4]
    rows = [{key: x[None] for key, x in data[i].items() if key.startswith("observation.")} for i in range(5)]
    known, ends = truth > 0, [] if unit == "m" else [10.0, 10_000.0]
    assert 0.1 < known.double().mean() < 0.9 and set(ends) <= set(rows[4][DEPTH].unique().tolist())
    maps = {"sigma": "observation.sigma", "source": "observation.source"}
    extra = {"observation.sigma": 0.01 * rows[4][DEPTH], "observation.source": torch.ones(1, *HW)}
    steps = [
        ExtendDepthStep.from_dataset(data, IMAGE, DEPTH, intrinsics=intrinsics(), gap=2, options=QUICK),
        GeometryImageStep.from_dataset(data, DEPTH, to="observation.images.geometry", **maps),
        PointCloudStep.from_dataset(data, DEPTH, image=IMAGE, intrinsics=intrinsics(), n=4000),
        MaskSilenceStep.from_dataset(data, [DEPTH, "observation.dh_depth_map"], "before"),
        MaskSilenceStep.from_dataset(data, [DEPTH], "after"),
    ]
    pipeline = reloaded(PolicyProcessorPipeline(steps=steps, name="policy_preprocessor"), tmp_path)
    for row in rows:
        out = pipeline({**row, **extra})
    source, z = out["observation.dh_source"], out["observation.dh_depth"]
    near = truth[known].min()
    assert (source == Source.RECOVERED).sum() > 50 and z[source == Source.SENSOR].min() > near - 0.01
    assert z[source == Source.SENSOR].max() < RANGE_M + 0.1
    assert torch.equal(out[f"{DEPTH}_known"][0, 0], known) and not out[DEPTH][0, 0][~known].any()
    swept = out["observation.dh_depth_map"] > 0
    assert torch.equal(out["observation.dh_depth_map_known"], swept) and swept.any()
    image = decode_geometry_image(out["observation.images.geometry"])
    assert torch.equal(image.depth[0] > 0, known) and (image.depth[0] / truth - 1)[known].abs().max() < 0.02
    assert ((image.sigma[0] / image.depth[0] - 0.01)[known].abs() < 0.002).all()
    points = out["observation.points"][0]
    assert near - 0.002 < points[:, 2].min() and points[:, 2].max() < truth.max() + 0.002


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_a_reference_and_a_validation_take_depth_of_a_video(unit, video):
    window = opened(video, unit, delta_timestamps={key: [-2 / 30, 0.0] for key in (IMAGE, DEPTH)})
    step = ValidateDepthStep.from_dataset(window, IMAGE, DEPTH, intrinsics=intrinsics(), options={"n": 512})
    sample = torch.utils.data.default_collate([window[4]])
    out = PolicyProcessorPipeline(steps=[step])(sample)
    assert out["observation.dh_depth_ok"].tolist() == [True] and out["observation.dh_wrong"][0, 0] < 0.02
    pin = CameraPinStep(image=IMAGE, intrinsics=intrinsics())
    stated = {"depth_unit": declared_depth_unit(window, DEPTH), "depth_range": declared_depth_range(window, DEPTH)}
    pin.set_reference(sample[IMAGE][0, -1], sample[DEPTH][0, -1], **stated)
    assert (pin.pin.frame.depth[0] - video[1][4]).abs().max() < 0.004


def test_whole_millimetres_of_a_robot_have_no_ends_and_other_depth_needs_a_unit(video):
    data = opened(video, "mm")
    whole = {DEPTH: (1000 * video[1][:1, None]).round().to(torch.int32)}
    step = MaskSilenceStep.from_dataset(data, [DEPTH], "before")
    known = PolicyProcessorPipeline(steps=[step])(whole)[f"{DEPTH}_known"]
    assert torch.equal(known[0, 0], video[1][0] > 0)
    with pytest.raises(ValueError, match=f"{DEPTH}: depth_unit is None, expected m or mm"):
        PointCloudStep(image=IMAGE, intrinsics=intrinsics(), depth=DEPTH)
    with pytest.raises(ValueError, match="depth_unit is 'auto'"):
        GeometryImageStep(to="observation.images.geometry", depth_unit="auto")
    step = PointCloudStep.from_dataset(data, DEPTH, image=IMAGE, intrinsics=intrinsics(), n=8)
    row = {IMAGE: data[0][IMAGE][None], DEPTH: torch.full((1, 1, *HW), 10.0)}
    assert not PolicyProcessorPipeline(steps=[step])(row)["observation.points"].any()
