"""Probes: ridge regression against other solvers, streams against memory, splits, and both experiments on small data."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from dhtorch import data
from dhtorch.baselines import dinov2
from dhtorch.data import rh20t_set, synthetic_robot
from dhtorch.data.codec_video import close_videos
from dhtorch.data.synthetic import SyntheticRoom
from dhtorch.evaluate import probe
from dhtorch.evaluate.bootstrap import Interval
from dhtorch.experiments import front_ends, probing, rh20t_probe, vo_probe
from dhtorch.experiments.protocol import Outcome, Settings
from dhtorch.geometry import se3
from dhtorch.pair import METHODS
from dhtorch.report.layouts import in_layout
from dhtorch.seats import refill
from dhtorch.transform import CHANNELS, ExtendDepth

ROOT = os.environ.get("DHTORCH_DATA")
PENALTIES = torch.tensor([1e-3, 0.1, 3.0], dtype=torch.float64)


def samples(n=120, f=9, d=3, seed=0):
    """Features of very different spread around a common offset, and targets that depend on some."""
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(n, f, generator=g, dtype=torch.float64) * torch.logspace(-3, 3, f, dtype=torch.float64) + 5
    y = (x / x.std(0))[:, :d] @ torch.randn(d, d, generator=g, dtype=torch.float64)
    return x, y + 0.3 * torch.randn(n, d, generator=g, dtype=torch.float64)


def by_least_squares(x, y, penalty):
    """Standardised features, the intercept free, the penalty as further rows; solved by numpy."""
    x, y = x.numpy(), y.numpy()
    mean, std, n = x.mean(0), x.std(0), len(x)
    rows = np.concatenate((np.ones((n, 1)), (x - mean) / std), 1)
    held = np.concatenate((np.zeros((x.shape[1], 1)), np.diag(np.sqrt(n * np.broadcast_to(penalty, x.shape[1])))), 1)
    known = np.concatenate((y, np.zeros((x.shape[1], y.shape[1]))))
    w = np.linalg.lstsq(np.concatenate((rows, held)), known, rcond=None)[0]
    return torch.from_numpy(rows @ w)


# ---------------------------------------------------------------------------------------------------------- regression


def test_ridge_is_scikit_learns():
    linear_model = pytest.importorskip("sklearn.linear_model")
    x, y = samples()
    ours = probe.predict(probe.ridge(probe.moments(x, y), PENALTIES), x)
    scaled = ((x - x.mean(0)) / x.std(0, correction=0)).numpy()
    for k, penalty in enumerate(PENALTIES.tolist()):
        theirs = linear_model.Ridge(alpha=penalty * len(x)).fit(scaled, y.numpy()).predict(scaled)
        assert np.abs(theirs - ours[k].numpy()).max() < 1e-6


@pytest.mark.parametrize("by_feature", [False, True])
def test_ridge_is_least_squares_with_further_rows(by_feature):
    x, y = samples(n=40, f=60)  # more features than samples
    penalty = PENALTIES[:, None] * torch.linspace(0.5, 2, 60) if by_feature else PENALTIES
    ours = probe.predict(probe.ridge(probe.moments(x, y), penalty), x)
    for k in range(len(PENALTIES)):
        torch.testing.assert_close(ours[k], by_least_squares(x, y, penalty[k].numpy()), atol=1e-6, rtol=0)


def test_a_stream_of_shards_is_all_samples_at_once():
    x, y = samples(n=501)
    whole = probe.moments(x, y)
    stream, joined = probe.Stream(9, 3), probe.moments(x[:0], y[:0])
    for a, b in zip(x.split(64), y.split(64), strict=True):
        stream.add(a, b)
        joined = probe.join(joined, probe.moments(a, b))
    for found in (stream.moments, joined):
        for name in ("n", "x", "y", "xx", "xy", "yy"):
            want = getattr(whole, name)
            torch.testing.assert_close(getattr(found, name), want, rtol=0, atol=1e-12 * float(want.abs().max()))
    streamed, together = (probe.ridge(m, PENALTIES).weight for m in (stream.moments, whole))
    torch.testing.assert_close(streamed, together, rtol=1e-9, atol=1e-12)


def test_columns_are_what_those_features_alone_give():
    x, y = samples()
    index = torch.tensor([7, 0, 3])
    ours = probe.ridge(probe.columns(probe.moments(x, y), index), PENALTIES)
    alone = probe.ridge(probe.moments(x[:, index], y), PENALTIES)
    torch.testing.assert_close(ours.weight, alone.weight, rtol=1e-10, atol=0)


def test_samples_that_are_no_numbers_do_not_count():
    x, y = samples()
    spoilt, target = x.clone(), y.clone()
    spoilt[3, 2], target[50, 1] = torch.nan, torch.inf
    rest = torch.tensor([k for k in range(len(x)) if k not in (3, 50)])
    found, want = probe.moments(spoilt, target), probe.moments(x[rest], y[rest])
    assert int(found.n) == len(rest)
    torch.testing.assert_close(found.xx, want.xx, rtol=1e-12, atol=0)


def test_features_that_do_not_vary_and_sets_without_samples():
    x, y = samples()
    x = torch.cat((x, torch.full((len(x), 1), 7.3, dtype=x.dtype), torch.zeros(len(x), 1, dtype=x.dtype)), 1)
    linear = probe.ridge(probe.moments(x, y), PENALTIES)
    assert not linear.weight[:, -2:].any() and linear.weight[:, :-2].all()
    nothing = probe.ridge(probe.moments(x[:0], y[:0]), PENALTIES)
    assert not nothing.weight.any() and not nothing.bias.any()
    mean = probe.predict(probe.ridge(probe.moments(x[:, :0], y), PENALTIES), x[:, :0])
    torch.testing.assert_close(mean, y.mean(0).expand_as(mean))


def test_gradients_reach_the_samples_and_the_penalties():
    x, y = samples(n=7, f=3, d=2)
    x = (x - 5) / x.std(0)
    fit = lambda x, y, p: probe.predict(probe.ridge(probe.moments(x, y), p), x)  # noqa: E731
    inputs = [v.clone().requires_grad_() for v in (x, y, PENALTIES)]
    assert torch.autograd.gradcheck(fit, inputs, atol=1e-6)
    spoilt = x.clone()
    spoilt[2] = torch.nan
    spoilt[:, 1] = 1.0
    spoilt.requires_grad_()
    probe.ridge(probe.moments(spoilt, y), PENALTIES).weight.sum().backward()
    assert spoilt.grad.isfinite().all()


MEMORY = """
import resource, torch
from dhtorch.evaluate import probe
torch.set_num_threads(1)
F, n = {F}, {n}
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
penalties = torch.logspace(-3, 2, 6)
probe.ridge(probe.moments(torch.randn(n, 300), torch.randn(n, 6)), penalties)
before, stream = peak(), probe.Stream(F, 6)
for shards in (2, 40):
    for k in range(shards):
        x = torch.randn(n, F, generator=torch.Generator().manual_seed(k))
        stream.add(x, x[:, :6])
    probe.ridge(stream.moments, penalties)
    print(peak() - before)
"""


def test_memory_is_squares_of_the_features_and_a_shard_however_many_there_are():
    """21,000 x 1,000, which would take 168 MB: five squares and some copies of one shard, after 2 shards as after 42."""
    F, n = 1000, 500
    done = subprocess.run([sys.executable, "-c", MEMORY.format(F=F, n=n)], capture_output=True, text=True, check=True)
    few, many = map(int, done.stdout.split())
    assert many < few + 4e6
    assert few < 5 * F * F * 8 + 5 * n * F * 8 + 20e6


# ------------------------------------------------------------------------------------------------ splits and intervals


def test_every_group_is_judged_once_and_never_learnt_from():
    names = [f"task_{k}" for k in range(11)]
    folds = probe.folds([*names, *names], 4)
    assert sorted(g for fold in folds for g in fold.test) == sorted(names)
    for fold in folds:
        parts = [set(part) for part in fold]
        assert sum(map(len, parts)) == len(set.union(*parts)) == 11 and all(parts)
    assert probe.folds(names, 4) == probe.folds(names[::-1], 4) != probe.folds(names, 4, seed=1)
    with pytest.raises(ValueError, match="at least three"):
        probe.folds(names[:2])


def test_a_ratio_is_paired():
    g = torch.Generator().manual_seed(0)
    hard = torch.rand(30, generator=g, dtype=torch.float64) * 100  # tasks differ by far more than methods
    same, worse = probe.ratio(hard, hard), probe.ratio(1.1 * hard, hard)
    assert (same.value, same.low, same.high) == (1.0, 1.0, 1.0)
    assert worse.low == pytest.approx(1.1) == worse.high
    mean = probe.mean_error(hard, torch.ones(30))
    assert mean.value == pytest.approx(float(hard.mean())) and mean.high - mean.low > 10
    noisy = probe.ratio(hard * (1 + 0.2 * torch.randn(30, generator=g, dtype=torch.float64)), hard)
    assert noisy.low < noisy.value < noisy.high < noisy.low + 0.3


@pytest.mark.parametrize(
    ("low", "high", "want"),
    [(0.99, 1.01, True), (0.97, 1.01, None), (1.03, 1.2, False), (0.5, 0.97, False), (1.01, 1.03, None)],
)
def test_equivalence_within_two_per_cent(low, high, want):
    assert probe.equivalent(Interval(1.0, low, high, 9)) is want
    assert probe.equivalent(Interval(1.0, None, None, 1)) is None


def made(seed=0, groups=8, n=40):
    """Shards in which ``depth`` knows the target, ``dinov2`` a noisier copy, and ``task`` only which group it is."""
    g = torch.Generator().manual_seed(seed)
    shards = probing.Shards()
    for k in range(groups):
        y = torch.randn(n, 2, generator=g) * torch.tensor([1.0, 20.0])
        context = torch.randn(n, 3, generator=g)
        y = y + context[:, :2] * torch.tensor([1.0, 20.0]) + torch.randn(2, generator=g)
        blocks = {"context": context, "depth": y + 0.1 * torch.randn(n, 2, generator=g) * torch.tensor([1.0, 20.0])}
        blocks["dinov2"] = y + torch.randn(n, 2, generator=g) * torch.tensor([1.0, 20.0])
        blocks["task"] = torch.eye(groups)[k].expand(n, groups)
        shards.add(probing.Shard(f"task_{k}", blocks, y, y[:, 0] > 0))
    return shards


def test_errors_are_those_of_groups_not_seen():
    arms = {"context": (), "dhtorch": ("depth",), "dinov2": ("dinov2",), "both": ("depth", "dinov2"), "task": ("task",)}
    with made() as shards:
        judged = probing.judge(shards, arms)
        again = probing.judge(shards, arms)
    error = {arm: judged.mean(arm, "all").value for arm in arms}
    assert error["dhtorch"] < 0.02 < error["dinov2"] < error["context"] < 1
    assert error["both"] < 1.1 * error["dhtorch"]
    assert error["task"] > 0.9 * error["context"], "which task it is must not help on other tasks"
    assert int(judged.counts["all"].sum()) == 320 > int(judged.counts["moving"].sum()) > 100
    assert all(torch.equal(judged.squares[k], again.squares[k]) for k in judged.squares)
    against = judged.ratio("dhtorch", "dinov2", "all")
    assert against.high < 0.2 and probe.equivalent(against) is False
    assert judged.ratio("dhtorch", "nobody", "all").value is None
    bases = {tuple(chosen[0] for chosen in found) for found in judged.penalties.values()}
    assert len(bases) == 1, "all arms share the context's penalty"


def test_shards_of_other_blocks_are_refused():
    x = torch.zeros(2, 3)
    with probing.Shards() as shards:
        shards.add(probing.Shard("a", {"context": x}, x, x[:, 0] > 0))
        with pytest.raises(ValueError, match="as before"):
            shards.add(probing.Shard("b", {"context": x[:, :2]}, x, x[:, 0] > 0))


# ------------------------------------------------------------------------------------------------------------ features


def test_tokens_are_pooled_over_the_patches_that_answer():
    tokens = torch.zeros(1, 16, len(CHANNELS))
    valid = torch.zeros(1, 16, dtype=torch.bool)
    valid[0, [0, 5]] = True  # both in the upper left cell of 2 x 2
    tokens[0, 0, 0], tokens[0, 5, 0] = 1.0, 3.0  # inverse depth
    tokens[0, :, 2] = torch.arange(16.0)  # a share
    found = front_ends.pooled(tokens, valid, (4, 4), 2).view(len(CHANNELS), 2, 2)
    assert found[0].tolist() == [[2.0, 0.0], [0.0, 0.0]]
    assert found[2].tolist() == [[2.5, 4.5], [10.5, 12.5]]
    with pytest.raises(ValueError, match="expected 3 x 4"):
        front_ends.pooled(tokens, valid, (3, 4), 2)
    tokens.requires_grad_()
    front_ends.pooled(tokens, valid, (4, 4), 2).sum().backward()
    assert tokens.grad.isfinite().all() and tokens.grad[0, 0, 0] > 0 == tokens.grad[0, 1, 0]


def small(n=256):
    return refill(METHODS["map"], n=n)


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
    want = front_ends.pooled(added["dhtorch.tokens"][None], added["dhtorch.tokens_valid"][None], (4, 4), 4)
    # Here the transform scales the image's camera to the depth map, there it is given the map's own: equal to rounding.
    torch.testing.assert_close(two(a, b), want, rtol=0, atol=1e-4)
    assert torch.equal(one(a, b), one(a)) and not torch.equal(one(a), two(a, b))


NETWORK = partial(dinov2.load, weights=None, hidden=24, layers=1, heads=2, side=56)


def test_patch_tokens_of_a_network():
    pytest.importorskip("transformers")
    frame = SyntheticRoom(hw=(60, 80), n_frames=1)[0]
    front, real = front_ends.visual(NETWORK, cells=2, device="cpu")
    assert not real and front(frame).shape == (1, 24 * 5)
    both = front.many([frame, frame])
    torch.testing.assert_close(both[0], both[1])
    assert front_ends.visual(None, cells=2, device="cpu") == (None, False)


def test_a_missing_library_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ImportError, match=r"dhtorch\[learned\]"):
        rh20t_probe.run([], {"map": small()}, None, Settings(), dinov2=NETWORK)


# -------------------------------------------------------------------------------------------------------- the robot set


@pytest.fixture(scope="module")
def robot_set(tmp_path_factory):
    pytest.importorskip("av")
    root = tmp_path_factory.mktemp("robot")
    yield synthetic_robot.open_robot(str(root), tasks=3, n_frames=9, scenes=1, hw=(36, 64))
    close_videos()


def test_the_robot_set_is_rh20t(robot_set):
    assert [rh20t_probe.task_of(r) for r in robot_set] == ["task_0001", "task_0002", "task_0003"]
    recording = robot_set[1]
    assert data.recognise(recording.root)[0] == "rh20t" and recording.report == ()
    assert recording[0].hw == (36, 64) and recording[0].depth.shape == (1, 18, 32)
    true = torch.from_numpy(np.stack([synthetic_robot._Episode.of(1, 0, 2).camera(i / 10) for i in range(9)]))
    torch.testing.assert_close(se3.to_matrix(recording.poses), true, atol=1e-6, rtol=0)
    streams = data.rh20t.streams(recording.root)
    assert streams["joint"].values.shape == (9, 7) and streams["gripper_info"].values[0, 0] == 80
    assert (streams["joint"].values.std(0)[[0, 1, 3]] > 0).all()


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
    assert found.names == robot_set.names and len(found[2]) == 9
    assert len(rh20t_set.open_set(tmp_path, limit=2)) == 2
    with pytest.raises(data.FormatError, match="none"):
        rh20t_set.open_set(tmp_path, camera="750612070851")
    with pytest.raises(data.FormatError, match="no such folder"):
        rh20t_set.open_set(tmp_path / "nowhere")


def test_samples_of_a_robot_scene(robot_set):
    recording = robot_set[0]
    index, before, context, target = rh20t_probe.robot(recording, horizon=0.3, history=0.2, stride=1)
    assert index == [2, 3, 4, 5] and before == [0, 1, 2, 3]
    assert context.shape == (4, 23) and target.shape == (4, 6) and context.isfinite().all()
    tcp = data.rh20t.streams(recording.root)["tcp_base"].values
    way = np.linalg.norm(tcp[[5, 6, 7, 8], :3] - tcp[[2, 3, 4, 5], :3], axis=1)
    np.testing.assert_allclose(target[:, :3].norm(dim=1), way, atol=1e-12)
    moved = se3.relative(recording.poses[5:9], recording.poses[2:6])  # camera: later → now, turned as the hand
    torch.testing.assert_close(target[:, 3:].norm(dim=1), se3.rotation_angle(moved.R), atol=1e-6, rtol=0)
    with pytest.raises(ValueError, match="data=rh20t_set"):
        rh20t_probe.robot(SyntheticRoom(), horizon=0.3, history=0.2, stride=1)


def test_scenes_without_poses_of_the_hand_are_noted(robot_set, tmp_path):
    scenes = list(robot_set)
    for k, recording in enumerate(scenes):
        (tmp_path / "transformed").mkdir(exist_ok=True)
        scenes[k] = dataclasses.replace(recording, root=tmp_path)
    assert rh20t_probe.robot(scenes[0], horizon=0.3, history=0.2, stride=1)[2].shape == (0, 23)
    with pytest.raises(ValueError, match="found no sample"):
        rh20t_probe.run(scenes, {"map": small()}, None, Settings(), dinov2=None)
    short = rh20t_probe.run(
        [*robot_set, scenes[0]], {"map": small()}, None, Settings(), dinov2=None, horizon=0.2, history=0.2, stride=5
    )
    assert [r["scene"] for r in short.rows if "note" in r] == [scenes[0].name] and short.n_pairs == 3


def test_the_robot_probe_runs_and_does_not_decide_with_random_weights(robot_set):
    pytest.importorskip("transformers")
    outcome = rh20t_probe.run(
        robot_set, {"map": small()}, None, Settings(), dinov2=NETWORK, horizon=0.2, history=0.2, penalties=(0.1, 10.0)
    )
    assert outcome.verdict == "undecided" and "random weights" in outcome.why and outcome.n_pairs == 15
    rows = outcome.scenes("dhtorch + dinov2", probing.TRUTH)
    assert set(rows) == {"task_0001", "task_0002", "task_0003"} and rows["task_0001"]["n_samples"] == 5
    assert outcome.summary["dinov2.vs_dinov2_90"]["value"] == 1.0
    assert outcome.summary["dhtorch.mse"]["low"] < outcome.summary["dhtorch.mse"]["high"]
    assert outcome.summary["context.mse"]["value"] < 200, "angles that vary by rounding alone are no signal"
    without = rh20t_probe.run(robot_set[:3], {"map": small()}, None, Settings(), dinov2=None, horizon=0.2, history=0.2)
    assert without.verdict == "undecided" and "left out" in without.why and "dinov2.mse" not in without.summary
    ours = without.summary["context.mse"]
    assert ours["value"] > 0 and without.summary["dhtorch.vs_dinov2"]["value"] is None


def judged(ratio, spread=0.0, groups=60):
    """Errors of ours at a ratio to the network's."""
    g = torch.Generator().manual_seed(1)
    base = 1 + torch.rand(groups, generator=g, dtype=torch.float64)
    ours = base * ratio * (1 + spread * torch.randn(groups, generator=g, dtype=torch.float64))
    found = probing.Judged([str(k) for k in range(groups)])
    for cohort in ("all", "moving"):
        found.counts[cohort] = torch.ones(groups, dtype=torch.float64)
        found.squares |= {("dhtorch", cohort): ours, ("dinov2", cohort): base, ("context", cohort): 2 * base}
    return found


def test_the_verdict_follows_the_interval_and_the_weights():
    assert rh20t_probe.verdict(judged(1.006), True, 0.02)[0] is True
    assert rh20t_probe.verdict(judged(1.05), True, 0.02)[0] is False
    assert rh20t_probe.verdict(judged(0.90), True, 0.02)[0] is False
    assert rh20t_probe.verdict(judged(1.0, spread=0.3), True, 0.02)[0] is None
    assert rh20t_probe.verdict(judged(1.006), False, 0.02)[0] is None


def reported(experiment, outcome, weights):
    meta = {"utc": "2026", "git": None}
    data_ = {"name": "made", "scenes": ["a"], "n_pairs": 1}
    config = {"experiment": {"dinov2": {"weights": weights}}}
    result = {"experiment": experiment, "rows": outcome.rows, "summary": outcome.summary, "verdict": None}
    return {**result, "meta": meta, "data": data_, "config": config}


def test_the_tables_quote_the_paper_and_name_random_weights():
    outcome, rooms = Outcome(), Outcome()
    probing.record(outcome, judged(1.5))
    probing.record(rooms, judged(1.5), "kitchen")
    rooms.rows.append({"scene": "yard", "pair": None, "method": "context", "truth": "trajectory", "note": "3 pairs"})
    outcome.summary = probing.summarise(judged(1.5))
    every, moving = in_layout(reported("rh20t_probe", outcome, None))
    assert every.rows[0][0] == "dhtorch" and every.rows[0][5:] == ["1.500", "1.500–1.500", "1.500–1.500", "1.006"]
    assert moving.rows[0][-1] == "1.013" and every.rows[1][0] == "dinov2 (random weights)"
    assert "random weights" in every.note and "RH20T, 799 tasks" in every.note
    (odometry,) = in_layout(reported("vo_probe", rooms, "/some/folder"))
    assert odometry.rows[1][1] == "dinov2" and "random" not in odometry.note
    assert odometry.rows[3][:2] == ["yard", "3 pairs"] and odometry.rows[-2][3:6] == ["1.32", "–", "0.81"]
    assert odometry.rows[-2][0].startswith("published") and odometry.quoted == 2
    for table in (every, moving, odometry):
        assert all(len(row) == len(table.head) for row in table.rows)


# ------------------------------------------------------------------------------------------------------ visual odometry


def test_blocks_share_no_frame_and_pairs_keep_their_distance():
    room = SyntheticRoom(hw=(60, 80), n_frames=31, gap=9)
    blocks = vo_probe.in_blocks(room, 3, 3)
    frames = [{i for pair in block for i in pair} for block in blocks]
    assert not frames[0] & frames[1] and not frames[1] & frames[2] and len(blocks) == 3
    assert all(j - i == 3 for block in blocks for i, j in block) and sum(map(len, blocks)) == 31 - 3 * 3
    room.role = "rotation"
    assert vo_probe.in_blocks(room, 3, 3) == []


def test_visual_odometry_within_the_room():
    pytest.importorskip("transformers")
    room, short = SyntheticRoom(hw=(120, 160), n_frames=12, step_m=0.04), SyntheticRoom(n_frames=6)
    short.name = "short"
    outcome = vo_probe.run(
        [room, short], {"map": small()}, None, Settings(), dinov2=NETWORK, blocks=3, min_pairs=6, penalties=(0.01, 1.0)
    )
    assert outcome.verdict == "undecided" and "random weights" in outcome.why
    error = {arm: outcome.scenes(arm, probing.TRUTH)["synthetic_room"]["mse"] for arm in vo_probe.EVERY}
    assert error["two_view_pose"] < 0.5 * error["context"], error
    assert "fewer than 6" in outcome.scenes("dhtorch", probing.TRUTH)["short"]["note"]
    assert outcome.summary["dhtorch.vs_dinov2"]["n"] == 1


@pytest.mark.data
@pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is unset")
def test_pairs_of_real_sequences_and_their_own_pose():
    recording = data.open(Path(ROOT) / "holo_a", gap=3)
    blocks = vo_probe.in_blocks(recording, 3, 5)
    assert sum(map(len, blocks)) == 35 and all(j == i + 1 for block in blocks for i, j in block)
    two, one = (front_ends.adapted(METHODS["map"], recording, views=v) for v in (2, 1))
    found = vo_probe._Look(recording, Settings(), two, one, None, 8)(*blocks[0][0])
    true = vo_probe._motion(se3.to_matrix(se3.relative(recording.poses[0:1], recording.poses[1:2])))
    assert found["pose"].any() and (found["pose"] - true).abs().max() < 0.03
    assert found["depth"].shape == (1, 320) and found["rgb"].shape == (1, 2 * 3 * 64)
