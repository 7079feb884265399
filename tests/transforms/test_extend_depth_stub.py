"""ExtendDepth with a stub method: the arguments that it passes, and the features that it makes of an estimate."""

import copy
import warnings
from functools import partial

import numpy as np
import pytest
import torch
from support.stub_samples import FixedEstimate, H, K, N, Stub, W, added, pose, sample, tiny
from torch.utils.data import default_collate

import dhtorch
from dhtorch.codes import Gate, Source
from dhtorch.stages.backproject import backproject
from dhtorch.stages.holes import classify
from dhtorch.transforms import ExtendDepth, SampleError, SampleProblem, patch_tokens
from dhtorch.transforms.status import ProblemCounts

QUIET = {"none": 0, "no_second_view": 0, "no_depth": 0, "unreadable": 0}


def batch(n=3, **changes):
    return default_collate([sample(k, **changes) for k in range(n)])


# ---------------------------------------------------------------------------------------------------- what it adds


def test_every_answer_has_its_place():
    given, method = sample(), FixedEstimate()
    out = tiny(method)(given)
    mine = added(out)
    assert list(mine) == [
        *("uv", "xyz", "depth", "sigma", "score", "valid", "source", "flag", "hole", "gate"),
        *("T_1_from_0", "pose_cov", "pose_ok", "pose_code", "tokens", "tokens_valid", "problem"),
    ]
    trace = {}
    estimate = method(method.arguments["reference"], None, trace=trace)
    samples = trace["samples"]
    assert mine["source"].tolist() == [1, 1, 2, 2, 1, 0] and mine["valid"].tolist() == [True] * 5 + [False]
    base = samples.trackability[0].tolist()
    wanted = [base[0], base[1], 10 * base[2], 10 * base[3], base[4], 0]
    assert mine["depth"].tolist() == pytest.approx(wanted)
    assert mine["sigma"].tolist() == pytest.approx(
        [*(0.01 * base[k] for k in (0, 1)), 5 * base[2], 5 * base[3], 0.01 * base[4], 0]
    )
    assert mine["score"].tolist() == pytest.approx(
        [*(0.5 + 0.1 * base[k] for k in (0, 1)), 0.25 * base[2], 0.25 * base[3], 0.5 + 0.1 * base[4], 0]
    )
    assert mine["gate"].tolist() == [6, 6, 0, 0, 0, 6] and mine["hole"].tolist() == samples.hole[0].tolist()
    assert mine["flag"].tolist() == samples.flag[0].tolist() == [8, 8, 1, 1, 8, 1]
    assert torch.equal(mine["uv"], estimate.uv[0])
    for k, (u, v) in enumerate(mine["uv"].tolist()):
        z = wanted[k]
        assert mine["xyz"][k].tolist() == pytest.approx([(u - K[2]) / K[0] * z, (v - K[3]) / K[1] * z, z], abs=1e-6)
    assert mine["problem"] == SampleProblem.NONE


def test_points_lie_on_bent_rays_where_the_lens_bends_them():
    bend = [0.05, -0.02, 0.01, -0.01]
    for k, point in enumerate(added(tiny(distortion=bend)(sample()))["xyz"][:5].double()):
        x, y, _ = point / point[2]
        r2 = x * x + y * y
        radial = 1 + bend[0] * r2 + bend[1] * r2 * r2
        u = K[0] * (x * radial + 2 * bend[2] * x * y + bend[3] * (r2 + 2 * x * x)) + K[2]
        v = K[1] * (y * radial + bend[2] * (r2 + 2 * y * y) + 2 * bend[3] * x * y) + K[3]
        assert [float(u), float(v)] == pytest.approx(added(tiny()(sample()))["uv"][k].tolist(), abs=1e-3)


def test_the_pose_is_a_matrix_where_there_is_one():
    found = pose(1)
    for code, ok in ((0, True), (4, True), (1, False), (2, False), (3, False)):
        mine = added(tiny(FixedEstimate([code]))(sample()))
        assert mine["pose_code"] == code and mine["pose_ok"] == ok
        if ok:
            wanted = torch.eye(4)
            wanted[:3, :3], wanted[:3, 3] = found.R[0], found.t[0]
            assert torch.equal(mine["T_1_from_0"], wanted)
            assert torch.equal(mine["pose_cov"], torch.arange(36.0).view(6, 6))
        else:
            assert not mine["T_1_from_0"].any() and not mine["pose_cov"].any(), "no NaN"


def test_tokens_are_those_of_the_merged_map():
    for options in (
        {"patch": 7},
        {"patch": 7, "tokens_hw": (14, 28)},
        {"patch": 5, "tokens_hw": (30, 20), "fit": "pad"},
    ):
        method = FixedEstimate()
        mine = added(tiny(method, **options)(sample()))
        trace = {}
        estimate = method(method.arguments["reference"], None, trace=trace)
        found = dhtorch.merge(trace["samples"], estimate)
        tokens, known = patch_tokens(found, trace["samples"].hole, (H, W), **options)
        assert torch.equal(mine["tokens"], tokens[0]) and torch.equal(mine["tokens_valid"], known[0]) and known.any()


def test_the_sample_is_not_changed_and_keys_bear_the_prefix():
    given = sample(task="look")
    before = copy.deepcopy(given)
    out = tiny(prefix="far/")(given)
    assert given.keys() == before.keys() and all(out[k] is given[k] for k in given)
    assert all(np.array_equal(given[k], before[k]) for k in given)
    assert {k.split("/")[0] for k in out.keys() - given.keys()} == {"far"} and len(out) == len(given) + 17


# ---------------------------------------------------------------------------------------------------- what it asks


def test_the_method_is_given_both_views_number_and_seed():
    method = FixedEstimate()
    tiny(method, n=12, seed=5)(sample())
    assert method.arguments["n"] == 12 and method.arguments["seed"] == 5
    given = sample()
    for view, key in (("reference", "image"), ("other", "before")):
        assert np.array_equal(method.arguments[view].image[0].permute(1, 2, 0), given[key])
    assert np.allclose(method.arguments["reference"].depth[0], given["depth"] / 1000)
    assert not method.arguments["other"].depth.any()


def test_the_number_of_samples_is_that_of_the_method():
    for options, n in (({}, 9), ({"n": 4}, 4)):
        transform = tiny(Stub(answer=FixedEstimate(), n=9), **options)
        assert transform.method.n == n and added(transform(sample()))["depth"].shape == (n,)
    assert ExtendDepth(depth_unit="m").method.n == 2048, "dhtorch.extend's own"


def test_the_tracker_is_told_what_is_known_of_the_motion():
    seen = []

    def track(image_0, image_1, uv_0, *, hint):
        seen.append(hint.levels)
        return dhtorch.stages.track.lucas_kanade(image_0, image_1, uv_0, window=5)

    for options in ({}, {"hint": dhtorch.TrackHint(levels=2)}):
        tiny(dhtorch.PAPER.replace(n=4, track=track), **options)(sample())
    assert seen == [None, 2]


def test_seeds_of_samples_are_told_apart_by_their_index():
    method = FixedEstimate()
    for index in (4, np.int64(4), torch.tensor([4]), np.array([[4]], np.int32)):
        tiny(method, seed=3, index_key="index")(sample(index=index))
        assert torch.equal(method.arguments["seed"], torch.tensor([7]))
    given = batch(3)
    tiny(method, seed=10, index_key="index", batched=True)(given)
    assert torch.equal(method.arguments["seed"], torch.tensor([10, 11, 12]))
    tiny(method, seed=10, batched=True)(given)
    assert method.arguments["seed"] == 10
    for wrong in (0.5, np.float32(2), [1, 2]):
        with pytest.raises(SampleError, match=r"index: found torch\.\w+ of shape .*, expected 1 whole numbers"):
            tiny(index_key="index")(sample(index=wrong))
    with pytest.raises(SampleError, match="expected 3 whole numbers"):
        tiny(index_key="index", batched=True)({**given, "index": torch.ones(3, 2, dtype=torch.int64)})
    with pytest.raises(SampleError, match="place: found no such key"):
        tiny(index_key="place")(sample())


def test_a_method_is_a_name_or_a_record():
    assert ExtendDepth(depth_unit="m", method="paper").method is dhtorch.pipeline.presets.METHODS["paper"]
    assert ExtendDepth(depth_unit="m", method="map").method is dhtorch.pipeline.presets.METHODS["map"]
    with pytest.raises(
        ValueError,
        match=r"method is 'mapp', expected one of \['auto', 'fused', 'kornia', 'map', 'paper', 'window'\] or a Method",
    ):
        ExtendDepth(depth_unit="m", method="mapp")


def test_networks_in_the_stages_of_a_method_are_submodules():
    class Net(torch.nn.Module):
        def __init__(self, size):
            super().__init__()
            self.weight = torch.nn.Parameter(torch.zeros(size))

    stages = {"score": Net(2), "track": partial(print, Net(1), net=partial(print, net=Net(3))), "pose": print}
    sizes = sorted(p.numel() for p in tiny(dhtorch.PAPER.replace(**stages)).parameters())
    assert sizes == [1, 2, 3] and not list(tiny(dhtorch.PAPER).parameters())


# ---------------------------------------------------------------------------------------------------- one view


def front_end(given, n):
    """The sensor's own samples, stage by stage."""
    frame = tiny().views.read(given).reference
    return classify(frame, backproject(frame, dhtorch.stages.sample.spiral(frame.hw, n)))


@pytest.mark.parametrize("alone", [{"other_image": None}, {}])
def test_without_a_second_view_the_front_end_runs_alone(alone):
    given = sample(before_is_pad=np.array([True]), image=sample()["image"] // 2)
    given["depth"][:, :20] = 0
    method = FixedEstimate()
    extender = tiny(method, n=40, **alone)
    mine, samples = added(extender(given)), front_end(given, 40)
    assert method.calls == 0 and mine["problem"] == SampleProblem.NO_SECOND_VIEW
    usable = samples.usable[0]
    assert 5 < usable.sum() < 35
    assert torch.equal(mine["uv"], samples.uv[0]) and torch.equal(mine["valid"], usable)
    assert torch.equal(mine["source"], usable.int() * Source.SENSOR) and torch.equal(mine["hole"], samples.hole[0])
    assert torch.equal(mine["flag"], samples.flag[0]) and (mine["gate"] == Gate.NO_TRACK).all()
    for name, value in (("depth", samples.depth), ("sigma", samples.sigma), ("score", samples.confidence)):
        assert torch.equal(mine[name], torch.where(usable, value[0], 0.0)), name
    assert torch.allclose(mine["xyz"][usable], samples.xyz[0][usable], atol=1e-6)
    for name in ("T_1_from_0", "pose_cov", "pose_ok", "pose_code"):
        assert not mine[name].any(), name
    paired = added(tiny()(sample()))
    assert {k: v.dtype for k, v in mine.items()} == {k: v.dtype for k, v in paired.items()}
    assert extender.report() == {**QUIET, "no_second_view": 1}


def test_the_front_end_has_the_stages_of_the_method():
    calls = []

    def few(hw, n, *, device, dtype):
        calls.append((hw, n, dtype))
        return torch.full((n, 2), 5.0, dtype=dtype).expand(1, n, 2)

    def far(frame, uv):
        return backproject(frame, uv).replace(sigma=torch.full(uv.shape[:2], 0.125))

    def dark(frame, samples):
        return samples.replace(hole=samples.hole * 0 + 4)

    def track(*_, **__):
        raise AssertionError("there is one view")

    method = dhtorch.PAPER.replace(n=3, sample=few, backproject=far, classify=dark, track=track)
    mine = added(tiny(method, other_image=None)(sample()))
    assert calls == [((H, W), 3, torch.float32)] and (mine["uv"] == 5).all()
    assert (mine["sigma"] == 0.125).all() and (mine["hole"] == 4).all()


def test_rows_of_a_batch_without_a_view_are_silent_beside_the_others():
    given = {**batch(3), "before_is_pad": torch.tensor([[False], [True], [False]])}
    method = FixedEstimate([0, 0, 2])
    mine = added(tiny(method, batched=True)(given))
    assert mine["problem"].tolist() == [0, SampleProblem.NO_SECOND_VIEW, 0]
    assert mine["gate"][0].tolist() == mine["gate"][2].tolist() == [6, 6, 0, 0, 0, 6]
    assert mine["gate"][1].tolist() == [Gate.NO_TRACK] * N and mine["source"][1].tolist() == [1, 1, 0, 0, 1, 0]
    assert mine["pose_ok"].tolist() == [True, False, False] and mine["pose_code"].tolist() == [0, 0, 2]
    assert not mine["T_1_from_0"][1:].any() and not mine["pose_cov"][1:].any()
    given = {**batch(2), "before_is_pad": torch.tensor([[False], [True]])}
    assert added(tiny(FixedEstimate([4, 4]), batched=True)(given))["pose_code"].tolist() == [4, 0]


@pytest.mark.parametrize("padded", [True, False])
@pytest.mark.parametrize("batched", [True, False])
def test_a_padded_view_of_a_nested_sample_is_no_view(padded, batched):
    given = batch(2) if batched else sample()
    where = {"image": "observation.images.front", "other_image": "observation.images.before", "prefix": "dhtorch."}
    pictures = {"front": given.pop("image"), "before": given.pop("before")}
    pictures["before_is_pad"] = torch.tensor([[False], [padded]]) if batched else torch.tensor([padded])
    mine = added(
        tiny(FixedEstimate([0, 0] if batched else [0]), batched=batched, **where)(
            {**given, "observation": {"images": pictures}}
        )
    )
    alone = SampleProblem.NO_SECOND_VIEW if padded else SampleProblem.NONE
    assert mine["problem"].flatten().tolist() == ([SampleProblem.NONE, alone] if batched else [alone])


def test_the_worst_problem_is_told():
    none = 0 * sample()["depth"]
    for changes, options, problem in (
        ({}, {}, SampleProblem.NONE),
        ({"before_is_pad": [True]}, {}, SampleProblem.NO_SECOND_VIEW),
        ({"depth": none}, {}, SampleProblem.NO_DEPTH),
        ({"depth": none, "before_is_pad": [True]}, {}, SampleProblem.NO_DEPTH),
        ({"depth": none, "intrinsics": [1.0, 1, 90, 90]}, {"on_error": "flag"}, SampleProblem.UNREADABLE),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert added(tiny(**options)(sample(**changes)))["problem"] == problem
    one = none.copy()
    one[3, 4] = 900
    assert added(tiny()(sample(depth=one)))["problem"] == SampleProblem.NONE, "one return is a return"
    assert (SampleProblem.NONE, SampleProblem.NO_SECOND_VIEW, SampleProblem.NO_DEPTH, SampleProblem.UNREADABLE) == (
        0,
        1,
        2,
        3,
    )


# ---------------------------------------------------------------------------------------------------- bad samples


BAD = {
    "missing key": (
        lambda s: {k: v for k, v in s.items() if k != "depth"},
        "depth: found no such key, expected one of",
    ),
    "missing other": (lambda s: {k: v for k, v in s.items() if k != "before"}, "before: found no such key"),
    "metres as mm": (lambda s: {**s, "depth": s["depth"] / 1e3}, r"0\.00.* m .*are the numbers metres"),
    "mm as 10 m": (lambda s: {**s, "depth": s["depth"] * 1e3}, "millimetres"),
    "transposed": (lambda s: {**s, "depth": s["depth"].T}, "orientation differs"),
    "two channels": (lambda s: {**s, "image": s["image"][..., :2]}, "1 or 3 channels"),
    "two dimensions": (lambda s: {**s, "image": s["image"][..., 0]}, "expected .C, H, W. or .H, W, C."),
    "normalised": (lambda s: {**s, "image": s["image"] / 127.5 - 1}, r"expected \[0, 1\]"),
    "0 to 255 float": (lambda s: {**s, "image": s["image"].astype(np.float32)}, r"expected \[0, 1\]"),
    "int32 image": (lambda s: {**s, "image": s["image"].astype(np.int32)}, "expected uint8"),
    "nan image": (lambda s: {**s, "image": s["image"] * np.nan}, r"expected \[0, 1\]"),
    "normalised K": (lambda s: {**s, "intrinsics": s["intrinsics"] / 42}, "min_focal=0.05"),
    "nan K": (lambda s: {**s, "intrinsics": s["intrinsics"] * np.nan}, "focal length nan"),
    "no focal length": (lambda s: {**s, "intrinsics": s["intrinsics"] * [0.0, 1, 1, 1]}, "focal length"),
    "K of six": (lambda s: {**s, "intrinsics": np.ones(6)}, "3x3, 4x4, fx fy cx cy or a camera"),
    "text": (lambda s: {**s, "depth": "depth.png"}, "expected an array of numbers"),
    "none": (lambda s: {**s, "depth": None}, "expected an array of numbers"),
    "index": (lambda s: {**s, "index": 0.5}, "whole numbers"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_samples_say_what_is_wrong(name):
    change, message = BAD[name]
    with pytest.raises(SampleError, match=message):
        tiny(index_key="index")(change(sample()))
    for policy in ("skip", "flag"):
        careful = tiny(index_key="index", on_error=policy)
        good = careful(sample())  # an image that cannot be read takes its size from one that could
        with pytest.warns(UserWarning, match=message):
            out = careful(change(sample()))
        assert careful.report() == {**QUIET, "none": 1, "unreadable": 1}
        if policy == "skip":
            assert out is None
        else:
            assert added(out)["problem"] == SampleProblem.UNREADABLE and not added(out)["valid"].any()
            assert default_collate([added(out), added(good)])["depth"].shape == (2, N)


def test_a_flagged_sample_has_the_shapes_of_a_good_one_and_no_number():
    extender = tiny(on_error="flag", patch=7, n=12)
    good = added(extender(sample()))
    for wrong, word in (({"depth": "x"}, "depth: found str"), ({"intrinsics": [1.0, 1, 90, 90]}, "focal length 1 px")):
        with pytest.warns(UserWarning, match=f"^flagged: .*{word}") as caught:
            bad = added(extender(sample(**wrong)))
        assert len(caught) == 1
        assert {k: (v.shape, v.dtype) for k, v in bad.items()} == {k: (v.shape, v.dtype) for k, v in good.items()}
        assert bad.pop("problem") == SampleProblem.UNREADABLE and not any(v.any() for v in bad.values())
    assert extender.report() == {**QUIET, "none": 1, "unreadable": 2}


def test_a_skipped_sample_is_none():
    extender = tiny(on_error="skip")
    with pytest.warns(UserWarning, match="^skipped: depth: found no such key"):
        assert extender({k: v for k, v in sample().items() if k != "depth"}) is None
    with pytest.warns(UserWarning, match="^skipped: image: found no such key"):
        assert extender({k: v for k, v in sample().items() if k != "image"}) is None, "no size is needed"
    assert extender.report() == {**QUIET, "unreadable": 2} and extender(sample()) is not None


def test_a_bad_sample_raises_unless_told_otherwise():
    with pytest.raises(SampleError, match="focal length 1 px"):
        tiny()(sample(intrinsics=[1.0, 1, 90, 90]))
    with pytest.raises(SampleError, match="depth: found no such key"):
        tiny()({k: v for k, v in sample().items() if k != "depth"})


def test_tokens_of_a_picture_that_is_missing_take_the_size_last_seen():
    lost = {k: v for k, v in sample().items() if k != "image"}
    extender = tiny(on_error="flag", patch=7)
    with pytest.raises(SampleError, match=r"image: found no such key.*no image gives the size.*give tokens_hw"):
        extender(lost)
    extender(sample())
    with pytest.warns(UserWarning, match="image: found no such key"):
        assert added(extender(lost))["tokens"].shape == (4 * 6, 10)
    small = sample(image=sample()["image"][:14], depth="x")
    with pytest.warns(UserWarning, match="depth"):
        assert added(extender(small))["tokens"].shape == (4 * 6, 10), "as of the first good sample"
    with pytest.warns(UserWarning, match="image"):
        assert added(tiny(on_error="flag", patch=7, tokens_hw=(21, 7))(lost))["tokens"].shape == (3, 10)


def test_a_bad_row_of_a_batch_is_zero_and_the_others_stay():
    given = batch(4)
    good = added(tiny(batched=True)(given))
    given["intrinsics"][2, 0] = 1e-3
    with pytest.raises(SampleError, match="sample 2 of the batch: intrinsics: focal length"):
        tiny(batched=True)(given)
    extender = tiny(batched=True, on_error="flag")
    with pytest.warns(UserWarning, match="flagged: sample 2 of the batch") as caught:
        flagged = added(extender(given))
    assert len(caught) == 1 and flagged["problem"].tolist() == [0, 0, 3, 0]
    for k, v in flagged.items():
        assert v.dtype == good[k].dtype and torch.equal(v[[0, 1, 3]], good[k][[0, 1, 3]]), k
        assert k == "problem" or not v[2].any(), k
    assert extender.report() == {**QUIET, "none": 3, "unreadable": 1}
    with pytest.raises(SampleError, match="depth: found no such key"):
        extender({k: v for k, v in given.items() if k != "depth"})


def test_options_that_cannot_be_are_refused():
    for options, message in [
        ({"on_error": "ignore"}, "on_error is 'ignore', expected one of raise, skip, flag"),
        ({"batched": True, "on_error": "skip"}, "on_error is 'skip', expected one of raise, flag"),
        ({"fit": "squash"}, "fit is 'squash', expected one of stretch, pad, crop"),
        ({"tokens_hw": (10, 224)}, "found an image of 10x224, expected at least one patch of 14 px"),
        ({"patch": 0}, "at least one patch of 0 px"),
    ]:
        with pytest.raises(ValueError, match=message):
            tiny(**options)
    assert tiny(patch=500).patch == 500, "the size of the picture is not known yet"
    with pytest.raises(TypeError, match="colour"):
        tiny(colour="image")


# ---------------------------------------------------------------------------------------------------- gradients, counts


def test_gradients_pass_where_they_are_asked_for():
    def method(a, b, *, n=N, seed=0, trace=None):
        estimate = FixedEstimate()(a, b, n=n, trace=trace)
        scaled = estimate.depth.nan_to_num() * a.image.mean() * b.image.mean()
        return estimate.replace(depth=torch.where(estimate.keep, scaled, torch.nan))

    image = torch.rand(3, H, W, generator=torch.Generator().manual_seed(0)).requires_grad_()
    extender = tiny(method, other_image="image")
    extender(sample(image=image))["dhtorch.depth"].sum().backward()
    assert image.grad.abs().min() > 0
    with torch.no_grad():
        assert not extender(sample(image=image))["dhtorch.depth"].requires_grad


def test_counts_are_by_problem():
    tally = ProblemCounts()
    tally.add(torch.tensor([0, 3, 3]))
    tally.add(torch.tensor([1], dtype=torch.int32))
    assert tally.report() == {"none": 1, "no_second_view": 1, "no_depth": 0, "unreadable": 2}
    twin = copy.deepcopy(tally)
    twin.add(torch.tensor([2]))
    assert twin.report()["no_depth"] == 1 and tally.report()["no_depth"] == 0 and twin.report()["unreadable"] == 2
    assert tally.counts.is_shared() and twin.counts.is_shared(), "seen by workers that are spawned later"


def test_workers_count_in_rows_of_their_own(monkeypatch):
    """More workers than rows share some, and none writes into that of the main process."""
    tally = ProblemCounts()
    tally.add(torch.tensor([0]))
    for worker in (0, 1, 126, 127):
        info = type("Info", (), {"id": worker})()
        monkeypatch.setattr("dhtorch.transforms.status.get_worker_info", lambda info=info: info)
        tally.add(torch.tensor([3]))
    assert tally.report() == {**QUIET, "none": 1, "unreadable": 4}
    used = tally.counts.sum(1)
    assert used[0] == 1 and sorted(used[used > 0].tolist()) == [1, 1, 1, 2]
