"""ExtendDepth with a stub method: the arguments that it passes, the features that it makes of an estimate, bad samples."""

import copy
import warnings
from functools import partial

import numpy as np
import pytest
import torch
from support.stub_samples import FixedEstimate, H, K, N, Stub, W, added, pose, sample, tiny
from torch.utils.data import default_collate

import dhtorch
from dhtorch.codes import Gate
from dhtorch.transforms import ExtendDepth, SampleError, SampleProblem, extend_depth

QUIET = {"none": 0, "no_second_view": 0, "no_depth": 0, "unreadable": 0}
NONE, ALONE, EMPTY, UNREADABLE = range(4)


def batch(n=3, **changes):
    return default_collate([sample(k, **changes) for k in range(n)])


# ---------------------------------------------------------------------------------------------------- what it adds


def test_every_answer_has_its_place():
    given, method = sample(), FixedEstimate()
    mine = added(tiny(method)(given))
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
    sigmas = [0.01 * base[0], 0.01 * base[1], 5 * base[2], 5 * base[3], 0.01 * base[4], 0]
    scores = [0.5 + 0.1 * base[0], 0.5 + 0.1 * base[1], 0.25 * base[2], 0.25 * base[3], 0.5 + 0.1 * base[4], 0]
    for name, values in (("depth", wanted), ("sigma", sigmas), ("score", scores)):
        assert mine[name].tolist() == pytest.approx(values), name
    assert mine["gate"].tolist() == [6, 6, 0, 0, 0, 6] and mine["hole"].tolist() == samples.hole[0].tolist()
    assert mine["flag"].tolist() == samples.flag[0].tolist() == [8, 8, 1, 1, 8, 1]
    assert torch.equal(mine["uv"], estimate.uv[0]) and mine["problem"] == NONE
    for k, (u, v) in enumerate(mine["uv"].tolist()):
        z = wanted[k]
        assert mine["xyz"][k].tolist() == pytest.approx([(u - K[2]) / K[0] * z, (v - K[3]) / K[1] * z, z], abs=1e-6)


def test_the_pose_is_a_matrix_where_there_is_one():
    fit = pose(1)
    wanted = torch.eye(4)
    wanted[:3, :3], wanted[:3, 3] = fit.R[0], fit.t[0]
    for code, ok in ((0, True), (4, True), (1, False), (2, False), (3, False)):
        mine = added(tiny(FixedEstimate([code]))(sample()))
        assert mine["pose_code"] == code and mine["pose_ok"] == ok
        assert torch.equal(mine["T_1_from_0"], wanted * ok), "no NaN"
        assert torch.equal(mine["pose_cov"], torch.arange(36.0).view(6, 6) * ok)


def test_the_sample_is_not_changed_and_keys_bear_the_prefix():
    given = sample(task="look")
    before = copy.deepcopy(given)
    out = tiny(prefix="far/")(given)
    assert given.keys() == before.keys() and all(out[k] is given[k] for k in given)
    assert all(np.array_equal(given[k], before[k]) for k in given)
    assert {k.split("/")[0] for k in out.keys() - given.keys()} == {"far"} and len(out) == len(given) + 17


# --------------------------------------------------------------------------------------------- what the method receives


def test_the_method_receives_both_views_number_seed_and_hint():
    method, given, hints = FixedEstimate(), sample(), []
    tiny(method, n=12, seed=5)(given)
    assert method.arguments["n"] == 12 and method.arguments["seed"] == 5
    for view, key in (("reference", "image"), ("other", "before")):
        assert np.array_equal(method.arguments[view].image[0].permute(1, 2, 0), given[key])
    assert np.allclose(method.arguments["reference"].depth[0], given["depth"] / 1000)
    assert not method.arguments["other"].depth.any()
    for options, n in (({}, 9), ({"n": 4}, 4)):
        transform = tiny(Stub(answer=FixedEstimate(), n=9), **options)
        assert transform.method.n == n and added(transform(given))["depth"].shape == (n,)

    def track(image_0, image_1, uv_0, *, hint):
        hints.append(hint.levels)
        return dhtorch.stages.track.lucas_kanade(image_0, image_1, uv_0, window=5)

    for options in ({}, {"hint": dhtorch.TrackHint(levels=2)}):
        tiny(dhtorch.PAPER.replace(n=4, track=track), **options)(given)
    assert hints == [None, 2]


def test_seeds_of_samples_differ_by_their_index():
    method = FixedEstimate()
    for index in (4, np.int64(4), torch.tensor([4]), np.array([[4]], np.int32)):
        tiny(method, seed=3, index_key="index")(sample(index=index))
        assert torch.equal(method.arguments["seed"], torch.tensor([7]))
    tiny(method, seed=10, index_key="index", batched=True)(batch(3))
    assert torch.equal(method.arguments["seed"], torch.tensor([10, 11, 12]))
    tiny(method, seed=10, batched=True)(batch(3))
    assert method.arguments["seed"] == 10
    for wrong, n in ((0.5, 1), (np.float32(2), 1), ([1, 2], 1), (torch.ones(3, 2, dtype=torch.int64), 3)):
        words = rf"index: found torch\.\w+ of shape .*, expected {n} whole numbers"
        given = sample(index=wrong) if n == 1 else {**batch(3), "index": wrong}
        with pytest.raises(SampleError, match=words):
            tiny(index_key="index", batched=n > 1)(given)
    with pytest.raises(SampleError, match="place: found no such key"):
        tiny(index_key="place")(sample())


class Net(torch.nn.Module):
    def __init__(self, size):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(size))


def test_a_method_is_a_name_or_a_record_and_its_networks_are_submodules():
    for name in ("paper", "map"):
        assert ExtendDepth(depth_unit="m", method=name).method is dhtorch.pipeline.presets.METHODS[name]
    assert ExtendDepth(depth_unit="m").method.n == 2048, "dhtorch.extend's own"
    stages = {"score": Net(2), "track": partial(print, Net(1), net=partial(print, net=Net(3))), "pose": print}
    sizes = sorted(p.numel() for p in tiny(dhtorch.PAPER.replace(**stages)).parameters())
    assert sizes == [1, 2, 3] and not list(tiny(dhtorch.PAPER).parameters())


# ---------------------------------------------------------------------------------------------------- one view


def test_rows_of_a_batch_without_a_view_are_silent_beside_the_others():
    given = {**batch(3), "before_is_pad": torch.tensor([[False], [True], [False]])}
    mine = added(tiny(FixedEstimate([0, 0, 2]), batched=True)(given))
    assert mine["problem"].tolist() == [NONE, ALONE, NONE]
    assert mine["gate"].tolist() == [[6, 6, 0, 0, 0, 6], [Gate.NO_TRACK] * N, [6, 6, 0, 0, 0, 6]]
    assert mine["source"][1].tolist() == [1, 1, 0, 0, 1, 0]
    assert mine["pose_ok"].tolist() == [True, False, False] and mine["pose_code"].tolist() == [0, 0, 2]
    assert not mine["T_1_from_0"][1:].any() and not mine["pose_cov"][1:].any()
    given = {**batch(2), "before_is_pad": torch.tensor([[False], [True]])}
    assert added(tiny(FixedEstimate([4, 4]), batched=True)(given))["pose_code"].tolist() == [4, 0]
    where = {"image": "observation.images.front", "other_image": "observation.images.before", "prefix": "dhtorch."}
    for padded in (True, False):  # of nested samples
        pictures = {
            "front": given["image"],
            "before": given["before"],
            "before_is_pad": torch.tensor([[False], [padded]]),
        }
        nested = {k: x for k, x in given.items() if k not in ("image", "before", "before_is_pad")}
        nested["observation"] = {"images": pictures}
        mine = added(tiny(FixedEstimate([0, 0]), batched=True, **where)(nested))
        assert mine["problem"].tolist() == [NONE, ALONE if padded else NONE]


EMPTY_MAP = np.zeros((H, W), np.uint16)


@pytest.mark.parametrize(
    ("changes", "options", "problem"),
    [
        ({}, {}, NONE),
        ({"before_is_pad": [True]}, {}, ALONE),
        ({"depth": EMPTY_MAP}, {}, EMPTY),
        ({"depth": EMPTY_MAP, "before_is_pad": [True]}, {}, EMPTY),
        ({"depth": EMPTY_MAP, "intrinsics": [1.0, 1, 90, 90]}, {"on_error": "flag"}, UNREADABLE),
        ({"depth": EMPTY_MAP + np.pad([[np.uint16(900)]], ((3, H - 4), (4, W - 5)))}, {}, NONE),
    ],
)
def test_the_worst_problem_is_stated(changes, options, problem):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert added(tiny(**options)(sample(**changes)))["problem"] == problem
    names = (SampleProblem.NONE, SampleProblem.NO_SECOND_VIEW, SampleProblem.NO_DEPTH, SampleProblem.UNREADABLE)
    assert names == (NONE, ALONE, EMPTY, UNREADABLE)


# ---------------------------------------------------------------------------------------------------- bad samples

#: Changes of a sample, None = without the key, and the message.
BAD = [
    ({"depth": None}, "depth: found no such key, expected one of"),
    ({"before": None}, "before: found no such key"),
    ({"depth": sample()["depth"] / 1e3}, r"0\.00.* m .*are the numbers metres"),
    ({"depth": sample()["depth"] * 1e3}, "millimetres"),
    ({"depth": sample()["depth"].T}, "orientation differs"),
    ({"image": sample()["image"][..., :2]}, "1 or 3 channels"),
    ({"image": sample()["image"] / 127.5 - 1}, r"expected \[0, 1\]"),
    ({"image": sample()["image"].astype(np.int32)}, "expected uint8"),
    ({"image": sample()["image"] * np.nan}, r"expected \[0, 1\]"),
    ({"intrinsics": np.array(K) / 42}, "min_focal=0.05"),
    ({"intrinsics": [1.0, 1, 90, 90]}, "focal length 1 px"),
    ({"intrinsics": np.array(K) * np.nan}, "focal length nan"),
    ({"intrinsics": np.ones(6)}, "3x3, 4x4, fx fy cx cy or a camera"),
    ({"depth": "depth.png"}, "depth: found str.*, expected an array of numbers"),
    ({"index": 0.5}, "whole numbers"),
    ({"image": None}, "image: found no such key"),
]


@pytest.mark.parametrize("row", range(len(BAD)))
def test_a_bad_sample_raises_is_skipped_or_has_the_shapes_of_a_good_one_and_no_number(row):
    changes, message = BAD[row]
    bad = {k: x for k, x in sample(**changes).items() if x is not None}
    with pytest.raises(SampleError, match=message):
        tiny(index_key="index")(bad)
    skipping, flagging = (tiny(index_key="index", patch=7, on_error=policy) for policy in ("skip", "flag"))
    with pytest.warns(UserWarning, match=f"^skipped: .*{message}"):
        assert skipping(bad) is None
    good = added(flagging(sample()))  # an image that cannot be read takes its size from one that could
    with pytest.warns(UserWarning, match=f"^flagged: .*{message}") as caught:
        out = added(flagging(bad))
    assert len(caught) == 1 and default_collate([out, good])["depth"].shape == (2, N)
    assert {k: (v.shape, v.dtype) for k, v in out.items()} == {k: (v.shape, v.dtype) for k, v in good.items()}
    assert out.pop("problem") == UNREADABLE and not any(v.any() for v in out.values())
    assert skipping.report() == {**QUIET, "unreadable": 1} and flagging.report() == {
        **QUIET,
        "none": 1,
        "unreadable": 1,
    }


def test_tokens_of_an_image_that_is_missing_take_the_size_last_seen():
    lost = {k: v for k, v in sample().items() if k != "image"}
    extender = tiny(on_error="flag", patch=7)
    with pytest.raises(SampleError, match=r"image: found no such key.*no image gives the size.*give tokens_hw"):
        extender(lost)
    small = sample(image=sample()["image"][:14], depth="x")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        extender(sample())
        for given in (lost, small):
            assert added(extender(given))["tokens"].shape == (4 * 6, 10), "as of the first good sample"
        assert added(tiny(on_error="flag", patch=7, tokens_hw=(21, 7))(lost))["tokens"].shape == (3, 10)


NAMES = r"method is 'mapp', expected one of \['auto', 'fused', 'kornia', 'map', 'paper'\] or a Method"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"on_error": "ignore"}, "on_error is 'ignore', expected one of raise, skip, flag"),
        ({"batched": True, "on_error": "skip"}, "on_error is 'skip', expected one of raise, flag"),
        ({"fit": "squash"}, "fit is 'squash', expected one of stretch, pad, crop"),
        ({"tokens_hw": (10, 224)}, "found an image of 10x224, expected at least one patch of 14 px"),
        ({"patch": 0}, "at least one patch of 0 px"),
        ({"colour": "image"}, "colour"),
        ({"method": "mapp"}, NAMES),
    ],
)
def test_options_that_cannot_be_are_refused(options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        ExtendDepth(**{"depth_unit": "mm", **options})
    assert tiny(patch=500).patch == 500, "the size of the image is not known yet"


# ---------------------------------------------------------------------------------------------------- gradients, counts


def test_workers_count_in_rows_of_their_own(monkeypatch):
    """More workers than rows share some, and none writes into that of the main process."""
    extender = tiny()
    extender.tally.add(torch.tensor([0], dtype=torch.int32))
    for worker in (0, 1, 126, 127):
        info = type("Info", (), {"id": worker})()
        monkeypatch.setattr(extend_depth, "get_worker_info", lambda info=info: info)
        extender.tally.add(torch.tensor([3, 3]))
    assert extender.report() == {**QUIET, "none": 1, "unreadable": 8}
    used = extender.tally.counts.sum(1)
    assert used[0] == 1 and sorted(used[used > 0].tolist()) == [1, 2, 2, 4]
    twin = copy.deepcopy(extender)
    twin.tally.add(torch.tensor([2]))
    assert twin.report() == {**QUIET, "none": 1, "unreadable": 8, "no_depth": 1} and extender.report()["no_depth"] == 0
    assert extender.tally.counts.is_shared() and twin.tally.counts.is_shared(), "seen by workers that are spawned later"
