"""Hooks of other projects, imitated by what is known of them; none of the packages is installed here."""

import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.sample_dicts import DEPTH_VIDEO, GAP, SIDE, Frames, Stream, depth_video, frames
from support.stub_samples import sample as tiny_sample
from support.stub_samples import tiny
from torch.utils.data import DataLoader, default_collate

from dhtorch.codes import Source
from dhtorch.data.readers.lerobot_depth import dequantise_depth
from dhtorch.data.readers.lerobot_meta import LeRobotFeature
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

N = 128
KEYS = ("uv", "xyz", "depth", "sigma", "score", "valid", "T_1_from_0", "tokens", "problem")


@pytest.fixture(scope="module")
def items():
    return list(frames())


def equal(a, b):
    return all(np.array_equal(np.asarray(a[f"dhtorch.{k}"]), np.asarray(b[f"dhtorch.{k}"])) for k in KEYS)


# ---------------------------------------------------------------------------------------------------- LeRobot


class LeRobot(torch.utils.data.Dataset):
    """Items as LeRobotDataset hands them out: dotted keys, float CHW in [0, 1], depth (1, H, W) float mm of a video in
    which *no return* comes back as the codec's lower or upper limit, frames along time and ``_is_pad`` where
    ``delta_timestamps`` asks."""

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
        out = {
            self.camera: self.picture(i),
            self.depth: torch.where(mm > 0, mm, torch.where(torch.arange(SIDE) < SIDE // 2, 10.0, 10000.0)),
            "observation.state": torch.zeros(7),
            "action": torch.ones(7),
            "timestamp": torch.tensor(i / self.fps),
            "frame_index": torch.tensor(i % 9),
            "episode_index": torch.tensor(item["episode_index"]),
            "index": torch.tensor(i),
            "task": item["task"],
        }
        if self.deltas:
            first = next(
                k for k in range(i, -1, -1) if k == 0 or self.items[k - 1]["episode_index"] != item["episode_index"]
            )
            places = [i + d for d in self.deltas]
            out[self.camera] = torch.stack([self.picture(max(p, first)) for p in places])
            out[f"{self.camera}_is_pad"] = torch.tensor([p < first for p in places])
        return out


def wrist(items, **options):
    K = items[0]["intrinsics"].astype(float)
    keys = {"image": LeRobot.camera, "depth": LeRobot.depth, "depth_unit": "auto"}
    keys["intrinsics"] = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]  # the format has no place for them
    return ExtendDepth(**{**keys, "index_key": "index", "n": N, "prefix": "dhtorch.", **options})


def test_lerobot_frames_along_time(items):
    dataset = ExtendedDataset(LeRobot(items, deltas=[-GAP, 0]), wrist(items))
    assert len(dataset) == 12 and dataset.fps == 30 and not hasattr(dataset, "hf_dataset")
    out = dataset[GAP]
    assert out["task"] == "look around" and out[LeRobot.camera].shape == (2, 3, SIDE, SIDE)
    assert out["dhtorch.pose_ok"] and (out["dhtorch.source"] == Source.RECOVERED).any()
    plain = ExtendDepth(depth_unit="mm", other_image="before", index_key="index", n=N)
    assert equal(out, plain({**items[GAP], "before": items[0]["image"]})), "both ends of the codes are no returns"
    padded = [dataset[i] for i in (0, 3, 9, 11)]
    assert [int(p["dhtorch.problem"]) for p in padded] == [SampleProblem.NO_SECOND_VIEW] * 4
    assert not any((p["dhtorch.source"] == Source.RECOVERED).any() for p in padded)


def test_lerobot_looks_back_by_itself(items):
    along = ExtendedDataset(LeRobot(items, deltas=[-GAP, 0]), wrist(items))
    back = ExtendedDataset(LeRobot(items), wrist(items, other_image="earlier"), gap=GAP)
    for i in (0, GAP, 8, 10):
        assert equal(along[i], back[i]), i
    assert "earlier" not in back[GAP] and "earlier_is_pad" not in back[GAP]
    assert back[-1]["index"] == 11
    with pytest.raises(IndexError):
        back[12]
    for wrong in ({"transform": wrist(items), "gap": 3}, {"transform": wrist(items, other_image="e"), "gap": 0}):
        with pytest.raises(ValueError, match="gap"):
            ExtendedDataset(LeRobot(items), **wrong)
    with pytest.raises(ValueError, match="single samples"):
        ExtendedDataset(LeRobot(items), wrist(items, batched=True))


def test_lerobot_dataset_in_a_loader(items):
    dataset = ExtendedDataset(LeRobot(items, deltas=[-GAP, 0]), wrist(items))
    assert len(pickle.loads(pickle.dumps(dataset))) == 12
    (batch,) = DataLoader(dataset, 12, num_workers=1, worker_init_fn=one_thread, multiprocessing_context="fork")
    assert batch["dhtorch.tokens"].shape == (12, 64, 10) and batch["action"].shape == (12, 7)
    assert equal(batch, default_collate([dataset[i] for i in range(12)]))


def test_lerobot_collate_that_drops_none(items):
    """LeRobot's own collator leaves out samples that are None; so does ours."""
    dataset = ExtendedDataset(Frames(items, corrupt={1}), ExtendDepth(depth_unit="mm", n=N, on_error="skip"))
    with pytest.warns(UserWarning, match="item 1 cannot be loaded: frame 1: premature end"):
        samples = [dataset[i] for i in range(3)]
    theirs = default_collate([s for s in samples if s is not None])
    ours = collate_kept(samples)
    assert equal(theirs, ours) and ours["dhtorch.skipped"] == 1


def test_streams(items):
    lost = [dict(x) for x in items[:4]]
    del lost[2]["depth"]
    stream = ExtendedStream(Stream(lost), ExtendDepth(depth_unit="mm", n=N, on_error="skip"))
    assert stream.fps == 30
    with pytest.warns(UserWarning, match="depth: found no such key"):
        out = list(stream)
    assert [x["index"] for x in out] == [0, 1, 3] and stream.transform.report()["unreadable"] == 1
    assert len(pickle.loads(pickle.dumps(stream)).dataset.items) == 4


# ---------------------------------------------------------------------------------------------------- openpi


def openpi_stack(samples):
    """openpi collates by stacking every leaf with numpy."""
    return {k: np.stack([np.asarray(s[k]) for s in samples]) for k in samples[0]}


def test_openpi_takes_and_gives_numpy(items):
    data = {f"observation/{k}": items[GAP][k] for k in ("image", "depth")}
    data |= {"observation/before": items[0]["image"], "observation/state": np.zeros(7, np.float32)}
    keys = {"image": "observation/image", "depth": "observation/depth", "other_image": "observation/before"}
    K = items[0]["intrinsics"].tolist()
    fn = NumpyTransform(ExtendDepth(**keys, depth_unit="mm", intrinsics=K, n=N))
    out = pickle.loads(pickle.dumps(fn))(data)
    assert all(isinstance(v, np.ndarray) for v in out.values()) and data.keys() < out.keys()
    assert openpi_stack([out, out])["dhtorch.tokens"].shape == (2, 64, 10)
    plain = ExtendDepth(depth_unit="mm", other_image="before", n=N)({**items[GAP], "before": items[0]["image"]})
    assert equal(out, plain)
    with pytest.warns(UserWarning), pytest.raises(SampleError, match="cannot be skipped"):
        NumpyTransform(ExtendDepth(**keys, depth_unit="m", intrinsics=K, on_error="skip"))(data)


# ---------------------------------------------------------------------------------------------------- RLDS, OpenVLA


def rlds_frame(items, i):
    """A frame as RLDS hands it to ``batch_transform``: numpy, a window axis in front, bytes for text. 16-bit depth was
    decoded to float by dividing by 65535."""
    window = [i - GAP, i]
    return {
        "observation": {
            "image_primary": np.stack([items[k]["image"] for k in window]),
            "depth_primary": np.stack([items[k]["depth"][..., None] for k in window]).astype(np.float32) / 65535,
            "timestep": np.arange(2),
            "pad_mask": np.array([True, True]),
        },
        "task": {"language_instruction": b"look around"},
        "action": np.zeros((1, 7), np.float32),
        "dataset_name": b"room",
    }


def openvla_transform(frame):
    """What OpenVLA makes of it: tensors of its own, nothing of the rest."""
    picture = torch.from_numpy(frame["observation"]["image_primary"][-1].copy()).permute(2, 0, 1) / 255
    ids = torch.arange(len(frame["task"]["language_instruction"]))
    return {"pixel_values": picture, "input_ids": ids, "labels": ids, "dataset_name": frame["dataset_name"]}


def openvla_collate(instances):
    """Stacks the keys it knows, and pads."""
    pad = torch.nn.utils.rnn.pad_sequence
    out = {"pixel_values": torch.stack([x["pixel_values"] for x in instances])}
    return out | {k: pad([x[k] for x in instances], batch_first=True) for k in ("input_ids", "labels")}


def test_openvla_batch_transform(items):
    keys = {"image": "observation.image_primary", "depth": "observation.depth_primary"}
    K = items[0]["intrinsics"].tolist()
    transform = ExtendDepth(**keys, intrinsics=K, depth_unit=65.535, n=N)
    hook = pickle.loads(pickle.dumps(RldsBatchTransform(openvla_transform, transform)))
    out = hook(rlds_frame(items, GAP))
    assert "observation" not in out and out["dataset_name"] == b"room" and out["dhtorch.pose_ok"]
    plain = ExtendDepth(depth_unit="mm", other_image="before", n=N)({**items[GAP], "before": items[0]["image"]})
    assert torch.allclose(out["dhtorch.depth"], plain["dhtorch.depth"], rtol=1e-3)
    batch = AddedCollate(openvla_collate)([out, hook(rlds_frame(items, GAP + 1))])
    assert batch["pixel_values"].shape == (2, 3, SIDE, SIDE) and batch["input_ids"].shape == (2, 11)
    assert batch["dhtorch.tokens"].shape == (2, 64, 10) and "dataset_name" not in batch
    wrong = ExtendDepth(**keys, intrinsics=K, depth_unit="m", n=N)
    with pytest.raises(SampleError, match=r"median return is 0\.0\d* m .* at least 0\.01 m"):
        wrong(
            {
                "observation": {
                    k: v / 10 if "depth" in k else v for k, v in rlds_frame(items, GAP)["observation"].items()
                }
            }
        )


# ---------------------------------------------------------------------------------------------------- torchvision v2


class TvTensor(torch.Tensor):
    """A tensor subclass such as ``tv_tensors.Image``; arithmetic on it must not meet our stages."""

    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):
        if getattr(func, "__name__", "") in ("add", "mul", "gather", "where"):
            raise AssertionError("arithmetic on a tv_tensor")
        return super().__torch_function__(func, types, args, kwargs or {})


class Compose(torch.nn.Module):
    """``v2.Compose``: modules and functions in turn, one argument."""

    def __init__(self, transforms):
        super().__init__()
        self.transforms = transforms

    def forward(self, *inputs):
        for transform in self.transforms:
            outputs = transform(*inputs)
            inputs = outputs if isinstance(outputs, tuple) else (outputs,)
        return outputs


def halve(sample):
    """A resize to half: pictures by area, masks by nearest; intrinsics stay as they are, as v2 leaves them."""
    half = (SIDE // 2, SIDE // 2)
    resized = {}
    for key, mode in {"image": "area", "before": "area", "depth": "nearest-exact"}.items():
        plain = sample[key].as_subclass(torch.Tensor).float()
        resized[key] = torch.nn.functional.interpolate(plain[None], half, mode=mode)[0].as_subclass(TvTensor)
    return {**sample, **resized}


def test_torchvision_pipeline(items):
    picture = {
        k: torch.from_numpy(x["image"]).permute(2, 0, 1) / 255 for k, x in (("image", items[GAP]), ("before", items[0]))
    }
    wrapped = {k: v.as_subclass(TvTensor) for k, v in picture.items()}
    mask = torch.from_numpy(items[GAP]["depth"].astype(np.float32))[None].as_subclass(TvTensor)
    sample = {**items[GAP], **wrapped, "depth": mask}
    whole = Compose([ExtendDepth(depth_unit="mm", other_image="before", n=N)])(sample)
    assert type(whole["image"]) is TvTensor and type(whole["dhtorch.depth"]) is torch.Tensor
    plain = ExtendDepth(depth_unit="mm", other_image="before", n=N)({**items[GAP], "before": items[0]["image"]})
    assert equal(whole, plain)
    stated = ExtendDepth(depth_unit="mm", other_image="before", n=N, intrinsics_hw=(SIDE, SIDE))
    out = Compose([halve, stated])(sample)
    sensed = (out["dhtorch.source"] == Source.SENSOR) & (out["dhtorch.flag"] == 0)
    # The same places of the room, whatever the size of the picture: directions of the points agree with the full K.
    uv = 2 * out["dhtorch.uv"][sensed] + 0.5
    K = torch.from_numpy(items[0]["intrinsics"]).double()
    x = (uv.double() - K[:2, 2]) / K[[0, 1], [0, 1]]
    xyz = out["dhtorch.xyz"][sensed].double()
    assert sensed.sum() > 20 and torch.allclose(xyz[:, :2] / xyz[:, 2:], x, atol=1e-5)
    unmoved = ExtendDepth(method="map", depth_unit="mm", other_image="before", n=1024)
    assert Compose([unmoved])(sample)["dhtorch.pose_ok"]
    assert not Compose([halve, unmoved])(sample)["dhtorch.pose_ok"], "K of another size is contradicted"


# ----------------------------------------------------------------------------------------- samples and batches


def test_a_batch_is_not_taken_for_time():
    one, two = tiny_sample(0), tiny_sample(1)
    batch = default_collate([{**x, "task": "lift"} for x in (one, two)])
    for left_out in ((), ("task",), ("task", "index")):
        shown = {k: v for k, v in batch.items() if k not in left_out}
        if left_out == ("task", "index"):
            shown["intrinsics"] = torch.eye(3).expand(2, 3, 3)
        with pytest.raises(SampleError, match=r"beside 2 pictures, expected one sample; batched=True reads 2 samples"):
            tiny()(shown)
    whole = tiny(batched=True)(batch)
    assert whole["dhtorch.uv"].shape[0] == 2
    judge = ValidateDepth(depth_unit="mm", other_image="before")
    with pytest.raises(SampleError, match="batched=True"):
        judge(batch)


@pytest.mark.parametrize(("what", "on_error"), [(torch.zeros(3, 8, 8), "skip"), (None, "raise")])
def test_a_picture_is_no_sample(what, on_error):
    """What LeRobot's image_transforms hands over; skipped it would leave nothing of a data set, and nobody would know."""
    with pytest.raises(SampleError, match=r"wrap the data set instead, ExtendedDataset\(dataset, transform\)"):
        tiny(on_error=on_error)(what)


def test_a_loader_extends_whole_batches_and_the_bits_are_the_same(items):
    source, options = LeRobot(items[GAP:]), {"other_image": "earlier"}
    single = ExtendedDataset(source, wrist(items, **options), gap=1)
    whole = ExtendedDataset(source, wrist(items, **options, batched=True), gap=1, by_batch=True)
    a = next(iter(DataLoader(single, batch_size=2)))
    b = next(iter(DataLoader(whole, batch_size=2, collate_fn=whole.collate)))
    assert a.keys() == b.keys() and "earlier" not in b
    assert all(torch.equal(a[k], b[k]) for k in a if isinstance(a[k], torch.Tensor))
    with pytest.raises(ValueError, match="expected one for single samples, or by_batch=True"):
        ExtendedDataset(source, whole.transform)
    itself = ExtendedDataset(source, single.transform, gap=1, by_batch=True)
    c = next(iter(DataLoader(itself, batch_size=2, collate_fn=itself.collate)))
    assert all(torch.equal(b[k], c[k]) for k in b if isinstance(b[k], torch.Tensor)) and not single.transform.batched
    with pytest.raises(ValueError, match="batched is False, expected True"):
        ExtendedDataset(source, wrist(items, **options, batched=False), by_batch=True)


@pytest.mark.parametrize("by_batch", [False, True])
def test_what_was_consumed_stays_in_the_worker_and_changes_no_answer(items, by_batch):
    class Nested(torch.utils.data.Dataset):
        def __len__(self):
            return 4

        def __getitem__(self, i):
            if i == 2 and not by_batch:
                raise OSError("a torn file")
            item = items[i]
            told = {"depth": item["depth"], "state": np.float32(i), "image": item["image"]}
            return {"observation": told, "intrinsics": item["intrinsics"]}

    options = {"image": "observation.image", "depth": "observation/depth", "depth_unit": "mm", "n": 64}
    options |= {"batched": by_batch, "on_error": "raise" if by_batch else "flag"}
    whole, light = (
        ExtendedDataset(Nested(), ExtendDepth(**options), by_batch=by_batch, consumed=keys)
        for keys in ((), ("observation/depth", "intrinsics"))
    )
    for workers in (0, 1):
        a, b = (
            next(iter(DataLoader(d, 4, num_workers=workers, collate_fn=d.collate if by_batch else None)))
            for d in (whole, light)
        )
        assert b["observation"].keys() == {"state", "image"} and a.keys() ^ b.keys() == {"intrinsics"}
        assert torch.equal(a["observation"]["image"], b["observation"]["image"])
        assert all(torch.equal(a[k], b[k]) for k in a if k.startswith("dhtorch.")), workers
        assert b["dhtorch.problem"].tolist() == [1, 1, 1 if by_batch else 3, 1]
    for wrong in ("intrinsics", ["action"], ["mm"]):
        with pytest.raises(
            ValueError,
            match="expected a list of some of observation.image, observation/depth, intri".replace(".", r"\."),
        ):
            ExtendedDataset(Nested(), whole.transform, by_batch=by_batch, consumed=wrong)


class Declared(torch.utils.data.Dataset):
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
        ("video", {"is_depth_map": True}, None, None),  # 0.4 decodes it as a picture
        ("video", {"is_depth_map": True, "depth_unit": "m"}, None, None),
        ("image", {"is_depth_map": True}, "mm", None),
        ("float32", None, "mm", None),
    ],
)
def test_the_unit_is_that_which_the_data_set_declares(dtype, info, output, unit):
    transform = ExtendDepth(image="i", depth="d", depth_unit="auto")
    if unit is None:
        with pytest.raises(
            ValueError, match="without a unit that this LeRobot declares, expected depth_unit in its info"
        ):
            ExtendedDataset(Declared(dtype, info, output), transform)
        return
    assert ExtendedDataset(Declared(dtype, info, output), transform).transform.views.depth_unit == unit
    assert ExtendedStream(Declared(dtype, info, output), transform).transform.views.depth_unit == unit
    assert transform.views.depth_unit == "auto", "the transform itself is unchanged"


#: Codec of a depth video and unit -> what LeRobot 0.6.1 decodes codes 0 to 3, 2047 and 4092 to 4095 to, and how many of
#: them at either end are no return: two, and those of the same millimetre.
DECODED = [
    ({}, "mm", [10.0, 11.0, 12.0, 13.0, 3383.0, 9987.0, 9991.0, 9996.0, 10000.0], 2),
    (
        *({}, "m"),
        [0.0100002289, 0.0111546516, 0.0123102665, 0.0134656429, 3.38254452, 9.98668194, 9.99112034, 9.99555969, 10.0],
        2,
    ),
    ({"use_log": False}, "mm", [10.0, 12.0, 15.0, 17.0, 5004.0, 9993.0, 9995.0, 9998.0, 10000.0], 2),
    (
        *({"use_log": False}, "m"),
        [0.00999999978, 0.0124395601, 0.0148791205, 0.0173186809, 5.00378036, 9.9926815, 9.995121, 9.9975605, 10.0],
        2,
    ),
    (
        *({"depth_min": 0.5, "depth_max": 60.0}, "m"),
        [0.5, 0.502701759, 0.505404949, 0.508110046, 12.4319992, 59.8715134, 59.9143181, 59.9571495, 60.0],
        2,
    ),
    (
        *({"depth_min": 0.3, "depth_max": 0.8}, "m"),
        [0.300000191, 0.30011487, 0.300229311, 0.300344467, 0.542215824, 0.799610615, 0.799740791, 0.799870491, 0.8],
        2,
    ),
    ({"depth_min": 0.3, "depth_max": 0.8}, "mm", [300.0, 300.0, 300.0, 300.0, 542.0, 800.0, 800.0, 800.0, 800.0], 4),
]


@pytest.mark.parametrize(("codec", "unit", "decoded", "n_ends"), DECODED)
@pytest.mark.parametrize("stated", ["auto", "unit"])
def test_both_ends_of_a_depth_video_are_no_returns(codec, unit, decoded, n_ends, stated):
    data = SimpleNamespace(**depth_video("d", unit, **codec))
    transform = ExtendDepth(image="i", depth="d", depth_unit="auto" if stated == "auto" else unit)
    views = ExtendedDataset(data, transform).transform.views
    kinds = [torch.float32, torch.float64] + [torch.uint16, torch.int32] * (unit == "mm")
    for kind in kinds:
        metres = views.metres([torch.tensor([[decoded]]).to(kind)])[0].flatten()
        assert metres.bool().tolist() == [False] * n_ends + [True] * (9 - 2 * n_ends) + [False] * n_ends
    assert transform.views.depth_range == (0.0, np.inf) and views.depth_unit == unit
    codes = LeRobotFeature("d", "video", (1, 4096, 1), data.meta.features["d"]["info"])
    returns = dequantise_depth(codes, np.arange(4096, dtype=np.uint16), "info.json")
    low, high = declared_depth_range(data, "d")
    assert np.array_equal((returns > low) & (returns <= high), returns > 0) == (n_ends == 2), "the reader's own limits"


def test_limits_that_are_stated_remain_within_those_of_a_depth_video():
    data = SimpleNamespace(**depth_video("d"))
    for stated, expected in (((0.3, 20.0), (0.3, 9.99334)), ((0.0, 4.0), (0.0117324, 4.0))):
        transform = ExtendDepth(image="i", depth="d", depth_unit="mm", depth_range=stated)
        for wrapper in (ExtendedDataset, ExtendedStream):
            assert wrapper(data, transform).transform.views.depth_range == pytest.approx(expected, abs=1e-6)
    with pytest.raises(ValueError, match=r"info.json: d depth_min, depth_max, shift: found \[5.0, 4.0, 3.5\]"):
        declared_depth_range(SimpleNamespace(**depth_video("d", depth_min=5.0, depth_max=4.0)), "d")


@pytest.mark.parametrize(
    ("dtype", "output", "is_marked"), [("image", "mm", True), ("video", None, True), ("video", "mm", False)]
)
def test_depth_that_is_no_decoded_video_has_no_limits(dtype, output, is_marked):
    data = Declared(dtype, DEPTH_VIDEO, output)
    data.meta.depth_keys *= is_marked
    assert declared_depth_range(data, "d") == declared_depth_range(data, "e") == (0.0, np.inf)
    transform = ExtendDepth(image="i", depth="d", depth_unit="mm")
    assert ExtendedDataset(data, transform).transform is transform and declared_depth_range([], "d") == (0.0, np.inf)


def test_a_validation_reads_the_ends_of_a_depth_video_as_no_returns(items):
    options = {"image": LeRobot.camera, "depth": LeRobot.depth, "judging": {"size": 56, "views": False}, "n": N}
    judge = ValidateDepth(**options, depth_unit="auto", intrinsics=items[0]["intrinsics"].astype(float))
    out = next(iter(ExtendedStream(LeRobot(items), judge)))
    told = LeRobot(items)[0]
    told[LeRobot.depth] = torch.from_numpy(items[0]["depth"].astype(np.float32))[None]
    plain = ValidateDepth(**options, depth_unit="mm", intrinsics=items[0]["intrinsics"].astype(float))(told)
    assert out.keys() == plain.keys() and (items[0]["depth"] == 0).mean() > 0.1
    assert all(torch.equal(out[key], plain[key]) for key in plain if key.startswith("observation.dh_"))


def test_without_a_data_set_no_unit_is_declared():
    transform = ExtendDepth(image="i", depth="d", depth_unit="auto")
    with pytest.raises(ValueError, match="found list, expected a LeRobot data set"):
        ExtendedDataset([{}], transform)
    with pytest.raises(ValueError, match="found no feature d, expected one of other"):
        ExtendedDataset(SimpleNamespace(meta=SimpleNamespace(features={"other": {}})), transform)
    with pytest.raises(ValueError, match="'auto' for samples without a data set"):
        tiny(depth_unit="auto")(tiny_sample())


def test_the_prefix_that_lerobots_processors_keep():
    """They keep what begins with "observation." and the action; everything else is gone behind them."""
    assert ExtendDepth(image="observation.images.front", depth_unit="m").prefix == "observation.dh_"
    assert ExtendDepth(image="observation.image_primary", depth_unit="m").prefix == "dhtorch."
    out = tiny(prefix="observation.dh_")(tiny_sample())
    kept = {k for k in out if k.startswith("observation.")}
    assert len(kept) == len(tiny()(tiny_sample()).keys() - tiny_sample().keys()) == 17


@pytest.mark.parametrize("posed", [False, True])
def test_a_gap_adds_the_earlier_picture_its_mark_and_its_pose(posed, monkeypatch):
    monkeypatch.setattr(adapters, "_as_declared", lambda transform, _: transform)
    views = SimpleNamespace(image="image", other_image="earlier", pose="T", other_pose="T_earlier" if posed else None)
    items = [{"image": f"picture {k}", "T": f"pose {k}", "episode": k // 3} for k in range(5)]
    views.keys = lambda: ("image",)
    transform = SimpleNamespace(views=views, on_error="raise", batched=False)
    data = ExtendedDataset(items, transform, gap=2, episode_key="episode")
    for k, (source, is_pad) in enumerate([(0, True), (1, True), (0, False), (3, True), (4, True)]):
        found = data._load(k)
        assert found.pop("earlier_is_pad").tolist() == [is_pad]
        added = {"earlier": f"picture {source}"} | ({"T_earlier": f"pose {source}"} if posed else {})
        assert found == items[k] | added
