"""Wrappers of data sets and hooks of other projects: one contract for all, and a table of damaged items for an epoch."""

import copy
import os
import pickle
import re
import subprocess
import sys
import warnings
from functools import partial
from itertools import pairwise
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from support.sample_dicts import DEPTH_VIDEO, GAP, SIDE, Frames, Stream, depth_video, frames
from support.stub_samples import FixedEstimate, H, N, W, added, sample, tiny
from torch.utils.data import DataLoader, Dataset, default_collate

from dhtorch.codes import Source
from dhtorch.data.readers.lerobot_meta import LeRobotFeature
from dhtorch.data.readers.lerobot_rows import dequantise_depth
from dhtorch.transforms import (
    AddedCollate,
    ExtendDepth,
    ExtendedDataset,
    ExtendedStream,
    NumpyTransform,
    RldsBatchTransform,
    SampleError,
    SampleProblem,
    ValidateDepth,
    adapters,
    collate_kept,
    declared_depth_range,
    one_thread,
)

QUIET = pytest.mark.filterwarnings("ignore:flagged", "ignore:skipped", "ignore:.*fork.*:DeprecationWarning")


@pytest.fixture(scope="module")
def items():
    return list(frames())


def equal(a, b):
    """Whether all added values are the same bits, whatever their type and prefix."""
    a, b = (added(x) or added(x, "observation.dh_") for x in (a, b))
    return a.keys() == b.keys() and all(np.array_equal(np.asarray(a[k]), np.asarray(b[k])) for k in a)


def state_alone(given):
    """A ``batch_transform`` that keeps one key, and has one whose name begins like ours."""
    return {"state": given["state"], "dhtorchy": 1}


def stacked(samples):
    """openpi collates by stacking every leaf with numpy."""
    return {k: np.stack([np.asarray(s[k]) for s in samples]) for k in samples[0]}


# ---------------------------------------------------------------------------------------- one contract for all adapters


class LeRobot(Dataset):
    """Items as LeRobotDataset hands them out: dotted keys, float CHW in [0, 1], depth (1, H, W) float mm of a video in
    which *no return* comes back as the codec's lower or upper limit, frames along time and ``_is_pad`` with ``deltas``."""

    fps = 30
    camera, depth = "observation.images.wrist", "observation.images.wrist_depth"

    def __init__(self, items, deltas=None):
        self.items, self.deltas = items, deltas
        self.__dict__ |= depth_video(self.depth)

    def __len__(self):
        return len(self.items)

    def picture(self, i):
        return torch.from_numpy(self.items[i]["image"]).permute(2, 0, 1) / 255

    def __getitem__(self, i):
        item = self.items[i]
        mm = torch.from_numpy(item["depth"].astype(np.float32))[None]
        ends = torch.where(torch.arange(SIDE) < SIDE // 2, 10.0, 10000.0)
        out = {self.camera: self.picture(i), self.depth: torch.where(mm > 0, mm, ends), "task": item["task"]}
        out |= {"action": torch.ones(7), "index": torch.tensor(i), "episode_index": torch.tensor(i // 9)}
        if self.deltas:
            first = 9 * (i // 9)
            out[self.camera] = torch.stack([self.picture(max(i + d, first)) for d in self.deltas])
            out[f"{self.camera}_is_pad"] = torch.tensor([i + d < first for d in self.deltas])
        return out


def wrist(items, **options):
    keys = {"image": LeRobot.camera, "depth": LeRobot.depth, "depth_unit": "auto", "index_key": "index", "n": 128}
    K = items[0]["intrinsics"].astype(float)  # the format has no place for them
    return ExtendDepth(**{**keys, "intrinsics": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], "prefix": "dhtorch.", **options})


#: Hook -> what it makes of item GAP with the item GAP places before it, after a round trip through pickle.
HOOKS = {
    "frames along time": lambda items, _: ExtendedDataset(LeRobot(items, deltas=[-GAP, 0]), wrist(items))[GAP],
    "a gap": lambda items, _: ExtendedDataset(LeRobot(items), wrist(items, other_image="earlier"), gap=GAP)[GAP],
    "a batch in the worker": lambda items, _: (
        data := ExtendedDataset(LeRobot(items), wrist(items, other_image="earlier"), gap=GAP, by_batch=True)
    ).collate([data[GAP]]),
    "a stream": lambda items, given: next(iter(ExtendedStream(Stream([given]), plain()))),
    "openpi": lambda items, given: NumpyTransform(plain())(given),
    "OpenVLA": lambda items, given: RldsBatchTransform(dict, plain())(given),
}


def plain(**options):
    return ExtendDepth(**{"depth_unit": "mm", "other_image": "before", "n": 128, "index_key": "index", **options})


@pytest.mark.parametrize("hook", HOOKS)
def test_every_hook_hands_out_the_answer_of_the_transform(items, hook):
    given = {**items[GAP], "before": items[0]["image"]}
    wanted, out = plain()(given), HOOKS[hook](items, given)
    assert wanted["dhtorch.pose_ok"] and (wanted["dhtorch.source"] == Source.RECOVERED).any()
    out = {k: v[0] if hook == "a batch in the worker" else v for k, v in out.items()}
    assert equal(out, wanted), "both ends of the codes of a depth video are no returns"
    assert out["task"] == "look around" and not {"earlier", "earlier_is_pad"} & out.keys()
    assert isinstance(out["dhtorch.depth"], np.ndarray) == (hook == "openpi")


def test_hooks_of_openpi_and_openvla():
    given, state = sample(name="x"), torch.zeros(3)
    for hook in (NumpyTransform(tiny()), RldsBatchTransform(state_alone, tiny())):
        out = pickle.loads(pickle.dumps(hook))({**given, "state": state})
        assert equal(out, tiny()(given)) and out["state"] is state
        assert ("name" in out) == isinstance(hook, NumpyTransform)
    assert stacked([NumpyTransform(tiny())(given)] * 2)["dhtorch.tokens"].shape == (2, 6, 10)
    for hook in (NumpyTransform, partial(RldsBatchTransform, dict)):
        with pytest.warns(UserWarning), pytest.raises(SampleError, match="skipped here: use on_error='flag'"):
            hook(tiny(on_error="skip"))({**given, "depth": "x"})


@QUIET
def test_a_lerobot_data_set_in_loaders(items):
    data = ExtendedDataset(LeRobot(items, deltas=[-GAP, 0]), wrist(items))
    back = ExtendedDataset(LeRobot(items), wrist(items, other_image="earlier"), gap=GAP)
    assert len(pickle.loads(pickle.dumps(data))) == 12 and data.fps == 30 and not hasattr(data, "hf_dataset")
    (batch,) = DataLoader(data, 12, num_workers=1, worker_init_fn=one_thread, multiprocessing_context="fork")
    assert equal(batch, default_collate([data[i] for i in range(12)])) and batch["action"].shape == (12, 7)
    assert batch["dhtorch.problem"].tolist() == [SampleProblem.NO_SECOND_VIEW if k % 9 < GAP else 0 for k in range(12)]
    for i in (0, GAP, 8, 10):
        assert equal(data[i], back[i]), i
    source, options = LeRobot(items[GAP:]), {"other_image": "earlier"}
    single = ExtendedDataset(source, wrist(items, **options), gap=1)
    (wanted, *_) = DataLoader(single, batch_size=2)
    for transform in (wrist(items, **options, batched=True), single.transform):
        whole = ExtendedDataset(source, transform, gap=1, by_batch=True)
        (out, *_) = DataLoader(whole, batch_size=2, collate_fn=whole.collate)
        assert wanted.keys() == out.keys() and not single.transform.batched
        assert all(torch.equal(x, out[k]) for k, x in wanted.items() if isinstance(x, torch.Tensor))


@QUIET
@pytest.mark.parametrize("by_batch", [False, True])
def test_what_was_consumed_stays_in_the_worker_and_changes_no_answer(items, by_batch):
    nested = [
        {
            "observation": {"depth": x["depth"], "state": np.float32(0), "image": x["image"]},
            "intrinsics": x["intrinsics"],
        }
        for x in items[:4]
    ]
    options = {"image": "observation.image", "depth": "observation/depth", "depth_unit": "mm", "n": 64}
    options |= {"batched": by_batch, "on_error": "raise" if by_batch else "flag"}
    whole, light = (
        ExtendedDataset(
            Frames(nested, () if by_batch else {2}), ExtendDepth(**options), by_batch=by_batch, consumed=keys
        )
        for keys in ((), ("observation/depth", "intrinsics"))
    )
    for workers in (0, 1):
        a, b = (
            next(iter(DataLoader(d, 4, num_workers=workers, collate_fn=d.collate if by_batch else None)))
            for d in (whole, light)
        )
        assert b["observation"].keys() == {"state", "image"} and a.keys() ^ b.keys() == {"intrinsics"}
        assert torch.equal(a["observation"]["image"], b["observation"]["image"])
        assert equal(a, b) and b["dhtorch.problem"].tolist() == [1, 1, 1 if by_batch else 3, 1]


# ----------------------------------------------------------------------------------------------------- what is refused


DATA = [{"image": 3}]

#: (how it is made, sentence).
REFUSED = [
    *(
        (lambda gap=gap, o=o: ExtendedDataset(DATA, tiny(**o), gap=gap), f"gap is {gap}: expected a positive one, and")
        for gap, o in ((0, {}), (-1, {}), (2, {"other_image": None}))
    ),
    (lambda: ExtendedDataset(DATA, tiny(batched=True)), "found a transform for batches, expected one for single samples"),
    (lambda: ExtendedDataset(DATA, tiny(batched=False), by_batch=True), "batched is False, expected True"),
    (lambda: ExtendedDataset(DATA, tiny(on_error="skip"), by_batch=True), "on_error is 'skip', expected raise or flag"),
    *(
        (lambda c=c: ExtendedDataset(DATA, tiny(), consumed=c), "expected a list of some of image, depth, intrinsics, b")
        for c in ("intrinsics", ["action"], ["mm"])
    ),
    (lambda: ExtendedDataset(DATA, tiny(depth_unit="auto")), "found list, expected a LeRobot data set"),
    (
        lambda: ExtendedDataset(SimpleNamespace(meta=SimpleNamespace(features={"o": {}})), tiny(depth_unit="auto")),
        "found no feature depth, expected one of o",
    ),
    (lambda: tiny(depth_unit="auto")(sample()), "'auto' for samples without a data set"),
    (
        lambda: declared_depth_range(SimpleNamespace(**depth_video("d", depth_min=5.0, depth_max=4.0)), "d"),
        r"info.json: d depth_min, depth_max, shift: found \[5.0, 4.0, 3.5\]",
    ),
    (
        lambda: ExtendedDataset([{"image": sample()["image"]}], tiny())[0],
        "before: found no such key and no gap, expected gap=N",
    ),
    *(
        (lambda k=k, d=d: tiny()({x: v for x, v in d.items() if x not in k}), r"beside 2 pictures, expected one sample; batched=True")
        for d in (default_collate([sample(k, task="lift") for k in (0, 1)]),)
        for k in ((), ("task",))
    ),
    (
        lambda: tiny()({**default_collate([sample(), sample()]), "index": 0, "intrinsics": torch.eye(3).expand(2, 3, 3)}),
        "beside 2 pictures, expected one sample; batched=True reads 2 samples",
    ),
    (
        lambda: ValidateDepth(depth_unit="mm", other_image="before")(default_collate([sample(), sample()])),
        "batched=True",
    ),
    *(
        (lambda t=t, x=x: t(depth_unit="m")(x), rf"sample: found {type(x).__name__}.*, expected a dict.*wrap the data set")
        for t in (ExtendDepth, ValidateDepth)
        for x in (None, torch.zeros(3, 8, 8), "frame", [1, 2])
    ),
    (lambda: tiny(on_error="skip")(torch.zeros(3, 8, 8)), r"wrap the data set instead, ExtendedDataset\(dataset, tran"),
    (lambda: tiny(on_error="flag")(None), "found NoneType"),
    *((lambda t=t: t(), r"depth_unit is '', expected one of \['m', 'mm'\]") for t in (ExtendDepth, ValidateDepth)),
]  # fmt: skip


@pytest.mark.parametrize("row", range(len(REFUSED)))
def test_what_cannot_be_is_refused(row):
    make, words = REFUSED[row]
    with pytest.raises(ValueError, match=words):
        make()


def test_no_sample_is_skipped_and_names():
    with pytest.warns(UserWarning, match="skipped: sample: found None"):
        assert tiny(on_error="skip")(None) is None
    assert tiny(batched=True)(default_collate([sample(0), sample(1)]))["dhtorch.uv"].shape[0] == 2
    # LeRobot's processors keep what begins with "observation." and the action.
    assert ExtendDepth(image="observation.images.front", depth_unit="m").prefix == "observation.dh_"
    assert ExtendDepth(image="observation.image_primary", depth_unit="m").prefix == "dhtorch."
    text = repr(ExtendedDataset([sample()] * 3, tiny(), gap=1))
    assert text.startswith("ExtendedDataset(3 items of list, the source view 1 items before, ExtendDepth(Stub(")
    assert text.endswith("reads image, depth, intrinsics, before; adds dhtorch.*))")


# -------------------------------------------------------------------------------------- unit and range of a depth video


class Declared(Dataset):
    """A LeRobot set's metadata and the unit in which it hands out its depth."""

    def __init__(self, dtype, info, output=None):
        self.meta = SimpleNamespace(features={"d": {"dtype": dtype, "info": info}}, depth_keys=["d"] if output else [])
        if output:
            self.depth_output_unit = output

    def __len__(self):
        return 1

    def __getitem__(self, i):
        raise AssertionError("the unit is not inferred from numbers")


@pytest.mark.parametrize(
    ("dtype", "info", "output", "unit"),
    [
        ("image", {"is_depth_map": True, "depth_unit": "m"}, "mm", "mm"),  # LeRobot 0.6 converts it
        ("image", {"is_depth_map": True, "depth_unit": "m"}, None, "m"),  # 0.4 does not
        ("video", {"is_depth_map": True}, "m", "m"),
        ("float32", {"is_depth_map": True, "unit": "m"}, "mm", "m"),  # arrays stay as they are, in every version
        ("uint16", {"depth_unit": "mm"}, None, "mm"),
        ("video", {"is_depth_map": True}, None, None),  # 0.4 decodes it as an image
        ("video", {"is_depth_map": True, "depth_unit": "m"}, None, None),
        ("image", {"is_depth_map": True}, "mm", None),
        ("float32", None, "mm", None),
    ],
)
def test_the_unit_is_that_which_the_data_set_declares(dtype, info, output, unit):
    transform = ExtendDepth(image="i", depth="d", depth_unit="auto")
    if unit is None:
        words = "without a unit that this LeRobot declares, expected depth_unit in its info"
        with pytest.raises(ValueError, match=words):
            ExtendedDataset(Declared(dtype, info, output), transform)
        return
    assert ExtendedDataset(Declared(dtype, info, output), transform).transform.views.depth_unit == unit
    assert ExtendedStream(Declared(dtype, info, output), transform).transform.views.depth_unit == unit
    assert transform.views.depth_unit == "auto", "the transform itself is unchanged"


SHORT = {"depth_min": 0.3, "depth_max": 0.8}
LONG = {"depth_min": 0.5, "depth_max": 60.0}

#: Codec of a depth video and unit -> what LeRobot 0.6.1 decodes codes 0 to 3, 2047 and 4092 to 4095 to, and how many of
#: them at either end are no return: two, and those of the same millimetre.
DECODED = [
    ({}, "mm", [10.0, 11.0, 12.0, 13.0, 3383.0, 9987.0, 9991.0, 9996.0, 10000.0], 2),
    ({}, "m", [0.0100002289, 0.0111546516, 0.0123102665, 0.0134656429, 3.38254452, 9.98668194, 9.99112034, 9.99555969, 10.0], 2),
    ({"use_log": False}, "mm", [10.0, 12.0, 15.0, 17.0, 5004.0, 9993.0, 9995.0, 9998.0, 10000.0], 2),
    ({"use_log": False}, "m", [0.00999999978, 0.0124395601, 0.0148791205, 0.0173186809, 5.00378036, 9.9926815, 9.995121, 9.9975605, 10.0], 2),
    (LONG, "m", [0.5, 0.502701759, 0.505404949, 0.508110046, 12.4319992, 59.8715134, 59.9143181, 59.9571495, 60.0], 2),
    (SHORT, "m", [0.300000191, 0.30011487, 0.300229311, 0.300344467, 0.542215824, 0.799610615, 0.799740791, 0.799870491, 0.8], 2),
    (SHORT, "mm", [300.0, 300.0, 300.0, 300.0, 542.0, 800.0, 800.0, 800.0, 800.0], 4),
]  # fmt: skip


@pytest.mark.parametrize(("codec", "unit", "decoded", "n_ends"), DECODED)
@pytest.mark.parametrize("stated", ["auto", "unit"])
def test_both_ends_of_a_depth_video_are_no_returns(codec, unit, decoded, n_ends, stated):
    data = SimpleNamespace(**depth_video("d", unit, **codec))
    transform = ExtendDepth(image="i", depth="d", depth_unit="auto" if stated == "auto" else unit)
    views = ExtendedDataset(data, transform).transform.views
    for kind in [torch.float32, torch.float64] + [torch.uint16, torch.int32] * (unit == "mm"):
        metres = views.metres([torch.tensor([[decoded]]).to(kind)])[0].flatten()
        assert metres.bool().tolist() == [False] * n_ends + [True] * (9 - 2 * n_ends) + [False] * n_ends
    assert transform.views.depth_range == (0.0, np.inf) and views.depth_unit == unit
    codes = LeRobotFeature("d", "video", (1, 4096, 1), data.meta.features["d"]["info"])
    returns = dequantise_depth(codes, np.arange(4096, dtype=np.uint16), "info.json")
    low, high = declared_depth_range(data, "d")
    assert np.array_equal((returns > low) & (returns <= high), returns > 0) == (n_ends == 2), "the reader's own limits"


def test_limits_of_a_depth_video_and_those_that_are_stated(items):
    for stated, expected in (((0.3, 20.0), (0.3, 9.99334)), ((0.0, 4.0), (0.0117324, 4.0))):
        transform = ExtendDepth(image="i", depth="d", depth_unit="mm", depth_range=stated)
        for wrapper in (ExtendedDataset, ExtendedStream):
            views = wrapper(SimpleNamespace(**depth_video("d")), transform).transform.views
            assert views.depth_range == pytest.approx(expected, abs=1e-6)
    for dtype, output, is_marked in (("image", "mm", True), ("video", None, True), ("video", "mm", False)):
        data = Declared(dtype, DEPTH_VIDEO, output)
        data.meta.depth_keys *= is_marked
        assert declared_depth_range(data, "d") == declared_depth_range(data, "e") == (0.0, np.inf)
        transform = ExtendDepth(image="i", depth="d", depth_unit="mm")
        assert ExtendedDataset(data, transform).transform is transform
    assert declared_depth_range([], "d") == (0.0, np.inf)
    options = {"image": LeRobot.camera, "depth": LeRobot.depth, "judging": {"size": 56, "views": False}, "n": 128}
    options["intrinsics"] = items[0]["intrinsics"].astype(float)
    out = next(iter(ExtendedStream(LeRobot(items), ValidateDepth(**options, depth_unit="auto"))))
    given = {**LeRobot(items)[0], LeRobot.depth: torch.from_numpy(items[0]["depth"].astype(np.float32))[None]}
    assert (items[0]["depth"] == 0).mean() > 0.1
    assert equal(out, ValidateDepth(**options, depth_unit="mm")(given)), "a validation reads the ends alike"


# ------------------------------------------------------------------------------------------- items, episodes, neighbours


class Items(Dataset):
    """Two episodes, of four and three frames; corrupt ones raise."""

    fps = 30

    def __init__(self, n=7, corrupt=(), error=OSError, **more):
        self.n, self.corrupt, self.error, self.more, self.read = n, set(corrupt), error, more, []

    def __len__(self):
        return self.n

    def __getitem__(self, i):
        self.read.append(i)
        if i in self.corrupt:
            raise self.error(f"item {i} is cut short")
        one = sample(i, episode_index=torch.tensor(int(i >= 4)), nested={"part": np.int64(i // 2)}, **self.more)
        del one["before"]
        return one | {"T": np.float32(i)}


def looking_back(gap=2, items=None, key="episode_index", **options):
    method = FixedEstimate()
    return ExtendedDataset(items or Items(), tiny(method, **options), gap=gap, episode_key=key), method


@pytest.mark.parametrize(
    ("gap", "key", "sources"),
    [
        (1, "episode_index", {1: 0, 2: 1, 3: 2, 5: 4, 6: 5}),
        (2, "episode_index", {2: 0, 3: 1, 6: 4}),
        (3, "episode_index", {3: 0}),
        (4, "episode_index", {}),
        (2, None, {k: k - 2 for k in range(2, 7)}),
        (2, "nested.part", {}),
        (1, "nested.part", {1: 0, 3: 2, 5: 4}),
    ],
)
def test_the_source_view_is_so_many_items_back_in_the_same_episode(gap, key, sources):
    dataset, method = looking_back(gap, key=key)
    for i, out in enumerate([dataset[k] for k in range(7)]):
        method.arguments = {}
        assert equal(out, dataset[i]) and out["index"] == i and not {"before", "before_is_pad"} & out.keys()
        assert out["dhtorch.problem"] == (0 if i in sources else SampleProblem.NO_SECOND_VIEW)
        if i in sources:
            for view, k in (("other", sources[i]), ("reference", i)):
                assert np.array_equal(method.arguments[view].image[0].permute(1, 2, 0), sample(k)["image"])
        else:
            assert not method.arguments
    assert len(dataset) == 7 and dataset[-1]["index"] == 6 and [x["index"] for x in dataset] == list(range(7))
    for i in (7, -8):
        with pytest.raises(IndexError):
            dataset[i]
    for wrapper in (dataset, ExtendedStream(Items(), tiny())):
        twin = pickle.loads(pickle.dumps(wrapper))
        assert (
            twin.fps == 30 and len(twin.dataset) == 7 and not hasattr(twin, "meta") and not hasattr(twin, "__array__")
        )


@pytest.mark.parametrize("posed", [False, True])
def test_a_gap_adds_the_earlier_image_its_mark_and_its_pose(posed):
    options = {"pose": "T", "pose_kind": "world_from_cam", "other_pose": "T_before"} if posed else {}
    data = looking_back(2, **options)[0]
    for k, (source, is_pad) in enumerate([(0, True), (1, True), (0, False), (1, False), (4, True)]):
        found, item = data._load(k), data.dataset[k]
        assert found.keys() - item.keys() == {"before", "before_is_pad"} | ({"T_before"} if posed else set())
        assert found["before_is_pad"].tolist() == [is_pad] and np.array_equal(found["before"], sample(source)["image"])
        assert not posed or found["T_before"] == source


@QUIET
@pytest.mark.parametrize(
    ("n", "corrupt", "index", "source"),
    [
        *((7, {3}, 3, 0), (7, {0, 1}, 0, 2), (7, {0, 1, 6}, 6, 2), (7, {0, 1, 2}, 1, 3)),
        *((40, set(range(35)), 20, 35), (40, set(range(36)), 20, None)),
    ],
)
def test_an_item_that_cannot_be_loaded_is_zeros_like_the_first_that_can(n, corrupt, index, source):
    """The first sixteen items are tried, and neighbours within fifteen places: the same ones in every worker."""
    items = Items(n, corrupt, words=["a", b"b"], flag=True, number=3, ratio=0.5, row=(1, 2.0), key="x")
    dataset = ExtendedDataset(items, tiny(on_error="flag", other_image=None))
    if source is None:
        with pytest.raises(SampleError, match="neither item 20 nor its neighbours can be loaded: item 20 is cut"):
            dataset[index]
        return
    out = dataset[index]
    assert items.read[-1] == source and out["dhtorch.problem"] == SampleProblem.UNREADABLE and not out["image"].any()
    assert (out["image"].shape, out["image"].dtype) == (sample()["image"].shape, np.uint8)
    assert torch.equal(out["episode_index"], torch.tensor(0)) and out["nested"] == {"part": 0}
    assert (out["words"], out["flag"], out["number"], out["ratio"]) == (["", b""], False, 0, 0.0)
    assert out["row"] == (0, 0.0) and out["key"] == "" and type(out["flag"]) is bool and type(out["ratio"]) is float
    assert out["dhtorch.tokens"].shape == (6, 10) and dataset.transform.report()["unreadable"] == 1


def test_the_view_before_a_corrupt_item_is_lost_with_it():
    dataset, _ = looking_back(2, Items(corrupt={1}), on_error="skip")
    with pytest.warns(UserWarning, match="^skipped: item 3 cannot be loaded: item 1 is cut short"):
        assert dataset[3] is None
    assert dataset[2] is not None and dataset.transform.report()["unreadable"] == 1
    for error, on_error in ((OSError, "raise"), (MemoryError, "flag"), (torch.OutOfMemoryError, "flag")):
        with pytest.raises(error):
            looking_back(2, Items(corrupt={1}, error=error), on_error=on_error)[0][1]


# ------------------------------------------------------------------------------------------- an epoch with damaged items


def without(name):
    return lambda x: {k: v for k, v in x.items() if k != name}


def changed(**values):
    return lambda x: {**x, **values}


def raise_error(_):
    raise OSError("premature end of file")


#: (what is wrong with the sample, its message).
DAMAGED = {
    "not a number": (lambda x: {**x, "image": np.full_like(x["image"], np.nan)}, "image: found the value nan"),
    "one pixel": (
        lambda x: {**x, "image": np.where(np.arange(W)[:, None] == 3, np.inf, x["image"]).astype(np.float32)},
        "image",
    ),
    "another size": (lambda x: {**x, "image": x["image"][:14]}, r"image: found float32 of shape \(14, 42, 3\), expec"),
    "no channels": (lambda x: {**x, "image": x["image"][..., 0]}, "image: found float32 of shape"),
    "RGBA": (changed(image=np.zeros((H, W, 4), np.float32)), "image: found float32 of shape"),
    "bytes": (changed(image=np.zeros((H, W, 3), np.uint8)), "image: found uint8 of shape"),
    "no image": (without("image"), "image: found no such key"),
    "no depth": (without("depth"), "depth: found no such key"),
    "depth is None": (changed(depth=None), "depth: found NoneType, expected uint16"),
    "depth is a name": (changed(depth="0001.png"), "depth: found str"),
    "another depth": (changed(depth=np.ones((3, 4, 5), np.uint16)), "depth: found uint16 of shape"),
    "depth of another type": (changed(depth=np.ones((H, W), np.float64)), "depth: found float64 of shape"),
    "no source view": (without("before"), "before: found no such key"),
    "no intrinsics": (without("intrinsics"), "intrinsics: found no such key"),
    "intrinsics of nothing": (changed(intrinsics=np.float32([0, 0, 0, 0])), "intrinsics: found focal length 0"),
    "intrinsics that are none": (changed(intrinsics=np.full(4, np.nan, np.float32)), "intrinsics"),
    "no index": (without("index"), "index: found no such key"),
    "None": (lambda x: None, "found NoneType, expected a dict"),
    "a list": (lambda x: [1, 2], "found list, expected a dict"),
    "raises": (raise_error, "item 1 cannot be loaded: premature end of file"),
}


def floats(k):
    """A sample with images of floats and a key that the transform does not read."""
    x = sample(k, state=np.float32([k]))
    return {**x, "image": np.float32(x["image"]) / 255, "before": np.float32(x["before"]) / 255}


class Spoiled(Dataset):
    """Four samples, of which one is damaged, or raises."""

    def __init__(self, damage=None, bad=1):
        self.damage, self.bad = damage, bad if damage else None

    def __len__(self):
        return 4

    def __getitem__(self, i):
        return self.damage(floats(i)) if i == self.bad else floats(i)


def epoch(damage, by_batch, workers=0, bad=1, consumed=()):
    """The batch of all items, and their data set."""
    transform = tiny(on_error="flag", patch=7, index_key="index")
    data = ExtendedDataset(Spoiled(damage, bad), transform, by_batch=by_batch, consumed=consumed)
    options = {"multiprocessing_context": "fork", "worker_init_fn": one_thread} if workers else {}
    (batch,) = DataLoader(data, 4, num_workers=workers, collate_fn=data.collate if by_batch else None, **options)
    return batch, data


@QUIET
@pytest.mark.parametrize("by_batch", [False, True])
@pytest.mark.parametrize(
    ("damage", "workers", "bad", "consumed"),
    [
        *((name, 0, 1, ()) for name in DAMAGED),
        *(
            (name, 1, bad, ())
            for name in ("not a number", "depth is None", "another size", "no image")
            for bad in (0, 3)
        ),
        *(
            (name, 0, 1, ("depth", "before", "intrinsics"))
            for name in ("depth is None", "no source view", "another depth")
        ),
    ],
)
def test_an_epoch_goes_on_with_zeros_in_place_of_a_bad_sample(damage, workers, bad, consumed, by_batch):
    """All rows but one are those of the sound batch; that one has zeros, and its problem is stated."""
    spoil, message = DAMAGED[damage]
    good, _ = epoch(None, by_batch, consumed=consumed)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        batch, data = epoch(spoil, by_batch, workers, bad, consumed)
    shown = [str(x.message) for x in caught if "flagged: " in str(x.message)]
    assert workers or (len(shown) == 1 and re.search(f"^flagged: .*{message}", shown[0]))
    assert batch.keys() == good.keys() and not {*consumed} & batch.keys()
    rows = [k for k in range(4) if k != bad]
    for key, value in batch.items():
        if isinstance(value, torch.Tensor):
            assert value.shape == good[key].shape and value.dtype == good[key].dtype, key
            assert torch.equal(value[rows], good[key][rows]), key
            assert not value.is_floating_point() or bool(value.isfinite().all()), key
    columns = added(batch)
    assert columns.pop("problem").tolist() == [3 if k == bad else 0 for k in range(4)]
    assert not any(value[bad].any() for value in columns.values())
    assert data.transform.report() == {"none": 3, "no_second_view": 0, "no_depth": 0, "unreadable": 1}


@QUIET
def test_streams_and_sets_without_a_good_sample():
    for damage in ("depth is None", "no image", "RGBA", "not a number"):
        stream = ExtendedStream([floats(0), DAMAGED[damage][0](floats(1)), floats(2)], tiny(on_error="flag"))
        with pytest.warns(UserWarning, match="^flagged: "):
            batch = default_collate(list(stream))
        assert batch["dhtorch.problem"].tolist() == [0, SampleProblem.UNREADABLE, 0]
        assert batch["image"].shape == (3, H, W, 3) and batch["depth"].shape == (3, H, W)
        assert batch["dhtorch.depth"].shape == (3, N) and bool(batch["image"].isfinite().all())
    given = [sample(k) for k in range(4)]
    given[1]["depth"] = "x"
    stream = ExtendedStream(Stream(given), tiny(on_error="skip"))
    with pytest.warns(UserWarning, match="^skipped: depth"):
        assert [x["index"] for x in stream] == [0, 2, 3]
    assert stream.fps == 30 and stream.transform.report()["unreadable"] == 1
    with pytest.raises(SampleError, match="neither item 1 nor its neighbours can be loaded"):
        ExtendedDataset([{"image": 3}] * 3, tiny(on_error="flag"))[1]
    data = ExtendedDataset(Spoiled(), tiny(on_error="flag", depth_unit=1e-6))
    with pytest.warns(UserWarning, match="flagged: depth: the median return"):
        assert next(iter(DataLoader(data, 4)))["dhtorch.problem"].tolist() == [3, 3, 3, 3]


# --------------------------------------------------------------------------------------- what leaves a worker in one piece

PREFIX = "ours."
SHAPES = {"depth": (3,), "tokens": (5, 2), "flag": (7,), "one": (), "none": (0, 2)}
TYPES = {"depth": torch.float64, "tokens": torch.float32, "flag": torch.bool, "one": torch.int32, "none": torch.int64}


class Mixed(Dataset):
    """Tensors of all shapes and types under our prefix, and others; missing ones are None."""

    def __init__(self, missing=(), grows=0):
        self.missing, self.grows = missing, grows

    def __len__(self):
        return 6

    def __getitem__(self, i):
        made = torch.Generator().manual_seed(i)
        mine = {key: torch.rand(shape, generator=made).mul(9).to(TYPES[key]) for key, shape in SHAPES.items()}
        mine |= {"turned": mine["tokens"].T, "text": f"item {i}", "array": np.full(2 + self.grows * i, i / 2)}
        mine |= {"depth": torch.zeros(2 + i)} if self.grows else {}
        item = {"picture": torch.full((4, 4), i), **{PREFIX + key: x for key, x in mine.items()}, "theirs": i}
        return None if i in self.missing else item


class Itself:
    """A transform that adds nothing: of whole batches."""

    prefix, on_error, batched = PREFIX, "raise", False
    views = SimpleNamespace(other_image=None, keys=lambda: (), depth="d", depth_unit="m", pose=None)

    def with_options(self, batched):
        return self

    def __call__(self, batch):
        return batch


def batches(collate, workers, **items):
    options = {"multiprocessing_context": "fork", "timeout": 60} if workers else {}
    return list(DataLoader(Mixed(**items), 3, collate_fn=collate, num_workers=workers, **options))


def pieces(batch):
    return {key: x.untyped_storage().data_ptr() for key, x in batch.items() if torch.is_tensor(x) and x.numel()}


COLLATORS = {
    "of a data set": partial(adapters._collate_shared, prefix=PREFIX),
    "of whole batches": ExtendedDataset([], Itself(), by_batch=True).collate,
    "of kept samples": partial(collate_kept, prefix=PREFIX),
    "of another": AddedCollate(lambda samples: {k: default_collate([s[k] for s in samples]) for k in ("picture", "theirs")}, PREFIX),
}  # fmt: skip


@QUIET
@pytest.mark.parametrize("name", COLLATORS)
def test_from_a_worker_our_tensors_come_in_one_piece(name):
    expected = batches(None, 0)
    for found, batch in zip(batches(COLLATORS[name], 1), expected, strict=True):
        assert found.keys() - {"dhtorch.skipped"} == batch.keys() and found[PREFIX + "text"] == batch[PREFIX + "text"]
        for key, x in batch.items():
            if torch.is_tensor(x):
                assert found[key].dtype == x.dtype and torch.equal(found[key], x), key
        shared = [PREFIX + key for key in (*SHAPES, "turned") if key != "none"]
        lie = pieces(found)
        assert len({lie[key] for key in shared}) == 1
        assert len({lie[key] for key in (PREFIX + "depth", "picture", "theirs")}) == 3
        bounds = sorted((found[key].data_ptr(), found[key].nbytes) for key in shared)
        assert all(begin + size <= after for (begin, size), (after, _) in pairwise(bounds)), "one lies over another"
        assert all((begin - bounds[0][0]) % 64 == 0 for begin, _ in bounds)
        assert bounds[-1][0] + bounds[-1][1] - bounds[0][0] <= found[PREFIX + "depth"].untyped_storage().nbytes()
    for batch in batches(COLLATORS[name], 0):  # where nothing leaves the process nothing is shared
        assert len(set(pieces(batch).values())) == len(pieces(batch))
        assert not any(x.is_shared() for x in batch.values() if torch.is_tensor(x))
    if name != "of whole batches":
        with pytest.raises(RuntimeError, match=r"equal size"):
            batches(COLLATORS[name], 1, grows=1)


@QUIET
def test_skipped_items_leave_their_batch_and_what_is_not_ours_is_torchs():
    first, second = batches(partial(collate_kept, prefix=PREFIX), 1, missing=(1, 3, 4, 5))
    assert first["theirs"].tolist() == [0, 2] and first["dhtorch.skipped"] == 1
    assert len(first[PREFIX + "depth"]) == 2 and second == {"dhtorch.skipped": 3}
    nobody = batches(partial(adapters._collate_shared, prefix="nobody"), 1)
    for found, expected in zip(nobody, batches(None, 1), strict=True):
        assert found.keys() == expected.keys() and len(set(pieces(found).values())) == len(pieces(found))
    for on_error, others in (("skip", {"dhtorch.skipped"}), ("flag", set())):
        data, _ = looking_back(items=Items(corrupt={5}), on_error=on_error)
        out = data.collate([data[i] for i in (4, 5, 6)])
        assert out.keys() == data[4].keys() | others and out["index"].tolist() == ([4, 6] if others else [4, 0, 6])
        assert torch.equal(out["dhtorch.depth"][-1], data[6]["dhtorch.depth"])
    rows = [{"a": k, "dhtorch.x": torch.tensor([k, k]), "far.x": torch.tensor(k)} for k in range(3)]
    for prefix in ("dhtorch.", "far."):
        out = AddedCollate(lambda given: {"sum": sum(one["a"] for one in given)}, prefix)(rows)
        assert out.keys() == {"sum", f"{prefix}x"} and out["sum"] == 3
        assert torch.equal(out[f"{prefix}x"], default_collate([row[f"{prefix}x"] for row in rows]))


# -------------------------------------------------------------------------------------------------------------- workers


def test_one_thread_is_one_of_torch_and_of_opencv(monkeypatch):
    kept = []
    monkeypatch.setattr(adapters, "disable_malloc_trim", lambda: kept.append("freed memory"))
    before = torch.get_num_threads(), cv2.getNumThreads()
    try:
        torch.set_num_threads(2)
        cv2.setNumThreads(2)
        one_thread(7)
        assert torch.get_num_threads() == 1 and cv2.getNumThreads() == 1 and kept == ["freed memory"]
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


@QUIET
def test_a_worker_answers_without_a_graph():
    """Weights of the method, and the sample's own, require gradients; what comes from a worker has none."""

    class Gain(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.gain = torch.nn.Parameter(torch.tensor(2.0))

        def forward(self, a, b, *, n=6, seed=0, trace=None):
            estimate = FixedEstimate()(a, b, n=n, trace=trace)
            return estimate.replace(depth=estimate.depth * self.gain)

    dataset = ExtendedDataset([sample(k) for k in range(2)], tiny(Gain(), n=6))
    assert dataset[0]["dhtorch.depth"].requires_grad
    (batch,) = DataLoader(dataset, 2, num_workers=1, worker_init_fn=one_thread, multiprocessing_context="fork")
    assert not batch["dhtorch.depth"].requires_grad and batch["dhtorch.depth"].shape == (2, 6)
    assert torch.equal(batch["dhtorch.depth"][1], dataset[1]["dhtorch.depth"].detach())
    assert dataset.transform.report()["none"] == 4, "two here, two in the worker"
    twin = copy.deepcopy(dataset.transform)
    twin(sample())
    assert twin.report()["none"] == 5 and dataset.transform.report()["none"] == 4


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_worker_forked_beside_opencvs_threads_does_not_wait_for_them():
    ended = subprocess.run([sys.executable, "-c", FORKED], capture_output=True, text=True, check=True, timeout=60)
    assert ended.stdout.strip() == "1"


FORKED = """
import os, time, cv2, numpy as np
from dhtorch.transforms import one_thread
cv2.setNumThreads(2)
picture, places = np.zeros((2000, 2000, 3), np.uint8), np.zeros((2000, 2000, 2), np.float32)
said = set()
for _ in range(12):  # on a busy machine the threads are not asleep, and waited for, each time
    cv2.remap(picture, places, None, cv2.INTER_LINEAR)
    time.sleep(0.2)
    pid = os.fork()
    if pid == 0:
        one_thread()
        os._exit(cv2.getNumThreads())
    said.add(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
print(*said)
"""
