"""ExtendDepth: layouts and units, what it adds, data-loader workers, batches, tokens beside DINOv2, bad input."""

import copy
import io
import pickle
import warnings
from functools import partial

import cv2
import numpy as np
import pytest
import torch
from sample_dicts import GAP, NEAR, SIDE, Frames, frames, room
from torch.utils.data import DataLoader, default_collate

import dhtorch
from dhtorch.codes import Flag, Gate, Hole, Source, names
from dhtorch.data.synthetic import SyntheticRoom
from dhtorch.geometry import camera as cam
from dhtorch.stages import score
from dhtorch.transform import (
    CHANNELS,
    ExtendDepth,
    ExtendedDataset,
    Problem,
    SampleError,
    Views,
    collate_kept,
    grid,
    one_thread,
    patch_tokens,
)
from dhtorch.window import extend_window

N = 256
P = (SIDE // 14) ** 2


def transform(**options):
    return ExtendDepth(**{"depth_unit": "mm", "other_image": "before", "n": N, **options})


@pytest.fixture(scope="module")
def items():
    return list(frames())


@pytest.fixture
def sample(items):
    return {**items[GAP], "before": items[0]["image"]}


def added(out, prefix="dhtorch."):
    return {k.removeprefix(prefix): v for k, v in out.items() if k.startswith(prefix)}


def same(a, b):
    a, b = added(a), added(b)
    assert a.keys() == b.keys()
    return [k for k in a if not torch.equal(torch.as_tensor(a[k]), torch.as_tensor(b[k]))] == []


# ---------------------------------------------------------------------------------------------------- what it adds


def test_it_adds_what_the_method_answers(sample, items):
    before = copy.deepcopy(sample)
    out = transform()(sample)
    assert out is not sample and all(out[k] is sample[k] for k in sample)
    assert all(np.array_equal(sample[k], before[k]) for k in sample), "the sample is not changed in place"
    read = Views(depth_unit="mm", other_image="before").read(sample)
    trace = {}
    estimate = dhtorch.extend(read.anchor, read.other, n=N, trace=trace)
    found, mine = dhtorch.merge(trace["samples"], estimate), added(out)
    assert torch.equal(mine["depth"], found.depth[0]) and torch.equal(mine["uv"], found.uv[0])
    assert torch.equal(mine["gate"], estimate.gate[0]) and torch.equal(mine["source"], found.source[0])
    assert torch.equal(mine["T_1_from_0"][:3, :3], trace["fit"].T_1_from_0.R[0]) and mine["pose_ok"]
    assert torch.equal(mine["T_1_from_0"][3], torch.tensor([0.0, 0, 0, 1]))
    sensed = mine["source"] == Source.SENSOR
    assert torch.equal(mine["xyz"][sensed], trace["samples"].xyz[0][sensed])
    recovered = mine["source"] == Source.RECOVERED
    assert recovered.sum() > 20 and torch.equal(mine["xyz"][recovered][:, 2], mine["depth"][recovered])
    z = room().truth(GAP)["depth"][0][tuple((mine["uv"] + 0.5).floor().long().flip(-1).T)]
    assert (mine["depth"] - z).abs()[sensed].max() <= 5.1e-4, "whole millimetres"
    assert mine["depth"][sensed].max() <= NEAR + 1e-3


SHAPES = {
    "uv": ((N, 2), torch.float32),
    "xyz": ((N, 3), torch.float32),
    "depth": ((N,), torch.float32),
    "sigma": ((N,), torch.float32),
    "score": ((N,), torch.float32),
    "valid": ((N,), torch.bool),
    "source": ((N,), torch.int32),
    "flag": ((N,), torch.int32),
    "hole": ((N,), torch.int32),
    "gate": ((N,), torch.int32),
    "T_1_from_0": ((4, 4), torch.float32),
    "pose_cov": ((6, 6), torch.float32),
    "pose_ok": ((), torch.bool),
    "pose_code": ((), torch.int32),
    "tokens": ((P, 10), torch.float32),
    "tokens_valid": ((P,), torch.bool),
    "problem": ((), torch.int32),
}


@pytest.mark.parametrize("what", ["pair", "one view", "no depth", "black", "nan depth", "padded", "unreadable"])
def test_shapes_are_fixed_and_numbers_finite(sample, what):
    options = {"other_image": None} if what == "one view" else {"on_error": "flag"} if what == "unreadable" else {}
    if what == "no depth":
        sample["depth"] = 0 * sample["depth"]
    if what == "black":
        sample["image"] = 0 * sample["image"]
    if what == "nan depth":
        sample["depth"] = np.full((SIDE, SIDE), np.nan, dtype=np.float32)
    if what == "padded":
        sample["before_is_pad"] = np.array([True])
    if what == "unreadable":
        sample["depth"] = sample["depth"][:, :50]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore" if what == "unreadable" else "error")
        out = added(transform(**options)(sample))
    assert {k: (tuple(v.shape), v.dtype) for k, v in out.items()} == SHAPES
    assert all(v.isfinite().all() for v in out.values())
    for key in ("depth", "sigma", "score", "xyz"):
        assert (out[key][~out["valid"]] == 0).all(), key
    expected = {"no depth": Problem.NO_DEPTH, "nan depth": Problem.NO_DEPTH, "unreadable": Problem.UNREADABLE}
    expected |= {"one view": Problem.NO_SECOND_VIEW, "padded": Problem.NO_SECOND_VIEW}
    assert out["problem"] == expected.get(what, Problem.NONE)
    if what in ("no depth", "nan depth"):
        assert not out["valid"].any() and not out["pose_ok"] and (out["flag"] & Flag.NO_DEPTH).bool().all()
    if what in ("one view", "padded"):
        assert (out["gate"] == Gate.NO_TRACK).all() and not out["pose_ok"] and out["valid"].any()
        assert (out["source"][out["valid"]] == Source.SENSOR).all()


def test_one_view_and_a_padded_pair_say_the_same(sample):
    alone = transform(other_image=None)(sample)
    assert same(alone, transform()({**sample, "before_is_pad": torch.tensor([True])}))


# ---------------------------------------------------------------------------------------------------- layouts and units


def as_float_chw(s):
    image = {k: torch.from_numpy(s[k]).permute(2, 0, 1) / 255 for k in ("image", "before")}
    return {**s, **image, "depth": torch.from_numpy(s["depth"].astype(np.int64))[None]}


def as_time(s):
    """Frames along time as ``delta_timestamps`` hands them out, the depth of the last one only."""
    s = as_float_chw(s)
    s["image"] = torch.stack((s.pop("before"), s["image"]))
    return {**s, "image_is_pad": torch.tensor([False, False])}


def as_time_with_depth(s):
    s = as_time(s)
    return {**s, "depth": torch.stack((s["depth"] * 0, s["depth"])), "intrinsics": np.stack([s["intrinsics"]] * 2)}


def as_nested(s):
    keys = ("image", "before", "depth")
    return {**{k: v for k, v in s.items() if k not in keys}, "observation": {k: s[k] for k in keys}}


def as_dotted(s):
    return {f"observation.images.{k}": v for k, v in s.items()}


@pytest.mark.parametrize(
    ("change", "options"),
    [
        (as_float_chw, {}),
        (as_time, {"other_image": None}),
        (as_time_with_depth, {"other_image": None}),
        (as_nested, {"image": "observation.image", "depth": "observation/depth", "other_image": "observation.before"}),
        (
            as_dotted,
            {
                "image": "observation.images.image",
                "depth": "observation.images.depth",
                "intrinsics": "observation.images.intrinsics",
                "other_image": "observation.images.before",
            },
        ),
        (lambda s: {**s, "depth": s["depth"][..., None]}, {}),
        (lambda s: {**s, "depth": s["depth"].astype(">u2")}, {}),
        (lambda s: {**s, "depth": (s["depth"] / 1000).astype(np.float64)}, {"depth_unit": "m"}),
        (lambda s: {**s, "depth": s["depth"].astype(np.float32)}, {}),
        (lambda s: {**s, "intrinsics": s["intrinsics"].ravel()}, {}),
        (lambda s: {**s, "intrinsics": s["intrinsics"][[0, 1, 0, 1], [0, 1, 2, 2]].tolist()}, {}),
        (lambda s: {**s, "image": s["image"][::-1][::-1], "before": np.asfortranarray(s["before"])}, {"layout": "hwc"}),
    ],
)
def test_layouts_of_one_sample_give_one_answer(sample, change, options):
    assert same(transform()(sample), transform(**options)(change(sample)))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_other_floating_types_are_lifted(sample, dtype):
    sample = as_float_chw(sample)
    changed = {k: sample[k].to(dtype) for k in ("image", "before", "depth")}
    out = added(transform()({**sample, **changed}))
    assert out["depth"].dtype == torch.float32 and all(v.isfinite().all() for v in out.values())
    both = out["valid"] & added(transform()(sample))["valid"]
    assert both.sum() > 100 and out["pose_ok"]


def test_intrinsics_may_be_given_once_or_belong_to_another_size(sample):
    K = sample["intrinsics"].astype(np.float64)
    fixed = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    plain = transform()(sample)
    assert same(plain, transform(intrinsics=fixed)({k: v for k, v in sample.items() if k != "intrinsics"}))
    double = [2 * K[0, 0], 2 * K[1, 1], 2 * (K[0, 2] + 0.5) - 0.5, 2 * (K[1, 2] + 0.5) - 0.5]
    other = added(transform(intrinsics=double, intrinsics_hw=(2 * SIDE, 2 * SIDE))(sample))
    assert torch.allclose(other["xyz"], added(plain)["xyz"], atol=1e-4)
    with pytest.raises(SampleError, match=r"principal point.*another size"):
        transform(intrinsics=double)(sample)


def test_a_depth_map_of_its_own_size_and_camera(sample):
    half = sample["depth"][1::2, 1::2]
    K = sample["intrinsics"]
    # Pixels 1, 3, 5, … of the image: a camera whose pixel centres are exactly those.
    own = [K[0, 0] / 2, K[1, 1] / 2, (K[0, 2] - 1) / 2, (K[1, 2] - 1) / 2]
    read = Views(depth_unit="mm", depth_intrinsics=own).read({**sample, "depth": half})
    assert read.anchor.depth_camera is not None and read.anchor.depth.shape == (1, SIDE // 2, SIDE // 2)
    out = added(transform(depth_intrinsics=own)({**sample, "depth": half}))
    whole = added(transform()(sample))
    both = (out["source"] == Source.SENSOR) & (whole["source"] == Source.SENSOR)
    assert both.sum() > 20 and ((out["depth"] / whole["depth"])[both] - 1).abs().median() < 0.01
    with pytest.raises(SampleError, match="transposed"):
        transform()({**sample, "depth": np.repeat(sample["depth"], 2, 0)})


def test_confidence_and_depth_range(sample):
    conf = np.zeros((SIDE, SIDE), np.uint8)
    conf[: SIDE // 2] = 2
    out = added(transform(confidence="conf")({**sample, "conf": conf}))
    low = (out["flag"] & Flag.LOW_CONF) != 0
    assert low.any() and (out["uv"][low][:, 1] >= SIDE // 2 - 0.5).all() and (out["source"][low] != Source.SENSOR).all()
    for wrong in (conf + 1.0, conf.astype(np.float32) + 0.5):
        with pytest.raises(SampleError, match="0 low, 1 medium, 2 high"):
            transform(confidence="conf")({**sample, "conf": wrong})
    limit = float(np.median(sample["depth"][sample["depth"] > 0])) / 1000
    near = added(transform(depth_range=(0.0, limit))(sample))
    assert 0 < near["depth"][near["source"] == Source.SENSOR].max() <= limit


def test_distortion_reaches_the_points(sample):
    plain, bent = (added(transform(distortion=d)(sample)) for d in (None, [0.1, -0.05, 0.001, 0.0, 0.0]))
    both = (plain["source"] == Source.SENSOR) & (bent["source"] == Source.SENSOR)
    assert not torch.allclose(plain["xyz"][both], bent["xyz"][both], atol=1e-4)
    assert torch.equal(plain["depth"][both], bent["depth"][both])


# ---------------------------------------------------------------------------------------------------- bad input


BAD = {
    "missing key": (
        lambda s: {k: v for k, v in s.items() if k != "depth"},
        "depth: found no such key, expected one of",
    ),
    "missing other": (lambda s: {k: v for k, v in s.items() if k != "before"}, "before: found no such key"),
    "metres as mm": (lambda s: {**s, "depth": s["depth"] / 1e3}, r"0\.00.* m .*are the numbers metres"),
    "mm as 10 m": (lambda s: {**s, "depth": s["depth"] * 1e3}, "millimetres"),
    "transposed": (lambda s: {**s, "depth": s["depth"][:, :60]}, "transposed"),
    "two channels": (lambda s: {**s, "image": s["image"][..., :2]}, "1 or 3 channels"),
    "two dimensions": (lambda s: {**s, "image": s["image"][..., 0]}, "expected .C, H, W. or .H, W, C."),
    "normalised": (lambda s: {**s, "image": s["image"] / 127.5 - 1}, r"expected floats in \[0, 1\]"),
    "0 to 255 float": (lambda s: {**s, "image": s["image"].astype(np.float32)}, r"expected floats in \[0, 1\]"),
    "int32 image": (lambda s: {**s, "image": s["image"].astype(np.int32)}, "expected uint8"),
    "nan image": (lambda s: {**s, "image": s["image"] * np.nan}, r"expected floats in \[0, 1\]"),
    "other K": (lambda s: {**s, "intrinsics": s["intrinsics"] * 4}, "principal point"),
    "nan K": (lambda s: {**s, "intrinsics": s["intrinsics"] * np.nan}, "principal point"),
    "no focal length": (lambda s: {**s, "intrinsics": s["intrinsics"] * [[0, 1, 1]] * 1.0}, "focal length"),
    "K of six": (lambda s: {**s, "intrinsics": np.ones(6)}, "3x3, or fx fy cx cy"),
    "text": (lambda s: {**s, "depth": "depth.png"}, "expected an array of numbers"),
    "none": (lambda s: {**s, "depth": None}, "expected an array of numbers"),
    "index": (lambda s: {**s, "index": 0.5}, "whole numbers"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_samples_say_what_is_wrong(sample, name):
    change, message = BAD[name]
    with pytest.raises(SampleError, match=message):
        transform(index_key="index")(change(sample))
    for policy in ("skip", "flag"):
        careful = transform(index_key="index", on_error=policy)
        good = careful(sample)  # an image that cannot be read takes its size from one that could
        with pytest.warns(UserWarning, match=message):
            out = careful(change(sample))
        assert careful.report() == {"none": 1, "no_second_view": 0, "no_depth": 0, "unreadable": 1}
        assert same(good, transform(index_key="index")(sample))
        if policy == "skip":
            assert out is None
        else:
            assert added(out)["problem"] == Problem.UNREADABLE and not added(out)["valid"].any()
            assert default_collate([added(out), added(good)])["depth"].shape == (2, N)


def test_options_that_cannot_be():
    with pytest.raises(TypeError, match="depth_unit"):
        ExtendDepth()
    for options, message in [
        ({"depth_unit": "cm"}, "depth_unit"),
        ({"depth_unit": -1.0}, "depth_unit"),
        ({"method": "papier"}, "expected one of .'map', 'paper'"),
        ({"on_error": "ignore"}, "on_error"),
        ({"batched": True, "on_error": "skip"}, "on_error"),
        ({"layout": "whc"}, "layout"),
        ({"fit": "squash"}, "fit"),
        ({"tokens_hw": (10, 224)}, "at least one patch"),
        ({"patch": 0}, "at least one patch"),
        ({"other_at": [0, 1]}, "other_at"),
        ({"method": lambda a, b, **_: None, "n": None}, "give n"),
    ]:
        with pytest.raises(ValueError, match=message):
            transform(**options)
    with pytest.raises(TypeError, match="colour"):
        transform(colour="image")


def test_a_size_that_nothing_tells_is_an_error(sample):
    nothing = {k: v for k, v in sample.items() if k != "image"}
    with pytest.raises(SampleError, match="give tokens_hw"):
        transform(on_error="flag")(nothing)
    with pytest.warns(UserWarning, match="image: found no such key"):
        assert added(transform(on_error="flag", tokens_hw=(224, 224))(nothing))["tokens"].shape == (256, 10)


# ---------------------------------------------------------------------------------------------------- methods and seeds


def test_any_method_will_do(sample):
    quiet = partial(dhtorch.extend, score=partial(score.rank, min_score=0.9), n=64)
    out = added(ExtendDepth(depth_unit="mm", other_image="before", method=quiet)(sample))
    assert out["depth"].shape == (64,)
    assert not ((out["source"] == Source.RECOVERED) & (out["score"] < 0.9)).any()


def test_a_learned_part_is_a_part_of_the_module(sample):
    class Scorer(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.gain = torch.nn.Parameter(torch.tensor(0.5))

        def forward(self, estimate, samples, tracks, fit):
            ranked = score.rank(estimate, samples, tracks, fit)
            return ranked.replace(score=ranked.score * self.gain)

    module = transform(method=partial(dhtorch.extend, score=Scorer()))
    assert [p.shape for p in module.parameters()] == [()]
    out = added(module(sample))
    out["score"].sum().backward()
    (gain,) = module.parameters()
    assert gain.grad > 0
    assert torch.equal(
        out["score"][out["source"] == Source.RECOVERED],
        0.5 * added(transform()(sample))["score"][out["source"] == Source.RECOVERED],
    )


def test_many_views_for_a_method_of_many(items):
    images = np.stack([items[k]["image"] for k in (0, 3, 4, GAP)])
    sample = {**items[GAP], "image": images}
    many = ExtendDepth(depth_unit="mm", method=extend_window, other_at=(0, 1, 2), n=N)
    pair, out = added(transform(other_image=None)(sample)), added(many(sample))
    assert {k: v.shape for k, v in out.items()} == {k: v.shape for k, v in pair.items()}
    assert (out["source"] == Source.RECOVERED).any()
    assert ExtendDepth(depth_unit="mm", other_at=1, n=N).views.read(sample).other.image.shape == (1, 3, SIDE, SIDE)


def test_seeds(sample):
    one, two = (
        added(transform(seed=s, index_key="index")({**sample, "index": i}))["pose_cov"] for s, i in ((3, 4), (0, 7))
    )
    assert torch.equal(one, two)
    same_draws = added(transform(seed=7)(sample))["pose_cov"]
    assert torch.equal(one, same_draws)


# ---------------------------------------------------------------------------------------------------- batches


@pytest.mark.parametrize("options", [{}, {"index_key": "index", "distortion": [0.05, -0.02, 0.001, 0.0, 0.0]}])
def test_a_batch_is_its_samples(items, options):
    samples = [{**items[i], "before": items[i - GAP]["image"]} for i in range(GAP, 12)]
    samples[1] = {**samples[1], "depth": 0 * samples[1]["depth"]}
    samples[2] = {**samples[2], "before_is_pad": torch.tensor([True])}
    samples = [{"before_is_pad": torch.tensor([False]), **s} for s in samples]
    single, batched = transform(**options), transform(**options, batched=True)
    together = added(batched(default_collate(samples)))
    alone = added(default_collate([single(s) for s in samples]))
    assert [k for k in alone if not torch.equal(alone[k], together[k])] == []
    assert batched.report() == single.report() == {"none": 4, "no_second_view": 1, "no_depth": 1, "unreadable": 0}


def test_a_bad_row_of_a_batch(items):
    samples = [{**items[i], "before": items[i - GAP]["image"]} for i in range(GAP, 10)]
    good = added(transform(batched=True)(default_collate(samples)))
    samples[2] = {**samples[2], "intrinsics": samples[2]["intrinsics"] * np.float32(np.nan)}
    with pytest.raises(SampleError, match=r"sample 2 of the batch: .*principal point"):
        transform(batched=True)(default_collate(samples))
    careful = transform(batched=True, on_error="flag")
    with pytest.warns(UserWarning, match="sample 2"):
        flagged = added(careful(default_collate(samples)))
    assert flagged["problem"].tolist() == [0, 0, Problem.UNREADABLE, 0]
    assert all(v.isfinite().all() for v in flagged.values()) and not flagged["valid"][2].any()
    for k in flagged:
        assert torch.equal(flagged[k][[0, 1, 3]], good[k][[0, 1, 3]]), k
    assert careful.report()["unreadable"] == 1


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no accelerator")
def test_a_batch_on_an_accelerator(items):
    samples = default_collate([{**items[i], "before": items[i - GAP]["image"]} for i in range(GAP, 12)])
    here = added(transform(batched=True)(samples))
    moved = {k: v.cuda() if torch.is_tensor(v) else v for k, v in samples.items()}
    there = {k: v.cpu() for k, v in added(transform(batched=True)(moved)).items()}
    both = here["valid"] & there["valid"]
    assert (here["valid"] == there["valid"]).float().mean() > 0.98
    assert torch.allclose(here["depth"][both], there["depth"][both], rtol=1e-2)


# ---------------------------------------------------------------------------------------------------- workers


def loaded(dataset, workers, context=None, batch=2, **options):
    loader = DataLoader(
        dataset,
        batch,
        num_workers=workers,
        multiprocessing_context=context,
        worker_init_fn=one_thread if workers else None,
        timeout=120 if workers else 0,
        **options,
    )
    return list(loader), loader


def in_rows(batches):
    return {
        k: torch.cat([b[k] for b in batches]) for k in batches[0] if k.startswith("dhtorch.") and k != "dhtorch.skipped"
    }


@pytest.fixture(scope="module")
def in_process(items):
    dataset = ExtendedDataset(Frames(items), transform(index_key="index", seed=5), gap=GAP)
    return in_rows(loaded(dataset, 0)[0])


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning", "ignore:.*pin_memory.*:UserWarning")
@pytest.mark.parametrize(
    ("workers", "context", "batch", "options"),
    [
        (0, None, 5, {}),
        (1, "fork", 3, {}),
        (2, "fork", 2, {"persistent_workers": True, "pin_memory": True}),
        (2, "spawn", 3, {"persistent_workers": True}),
    ],
)
def test_workers_and_batch_size_change_nothing(items, in_process, workers, context, batch, options):
    extender = transform(index_key="index", seed=5)
    dataset = ExtendedDataset(Frames(items), extender, gap=GAP)
    batches, loader = loaded(dataset, workers, context, batch, **options)
    rows = in_rows(batches)
    assert [k for k, v in in_process.items() if not torch.equal(v, rows[k])] == []
    assert all(not v.requires_grad for v in rows.values())
    assert batches[0]["task"] == ["look around"] * batch and "before" not in batches[0]
    if options.get("persistent_workers"):
        again = in_rows(list(loader))
        assert all(torch.equal(v, again[k]) for k, v in rows.items())
    episodes = 2 if options.get("persistent_workers") else 1
    assert extender.report() == {"none": 3 * episodes, "no_second_view": 9 * episodes, "no_depth": 0, "unreadable": 0}


@pytest.mark.filterwarnings("ignore")
def test_corrupt_samples_in_the_middle(items):
    corrupt = {3, 8}
    with pytest.raises(OSError, match="premature end"):
        loaded(ExtendedDataset(Frames(items, corrupt), transform(other_image=None)), 1, "fork")
    skipping = transform(on_error="skip", other_image=None)
    batches, _ = loaded(ExtendedDataset(Frames(items, corrupt), skipping), 2, "fork", collate_fn=collate_kept)
    assert torch.cat([b["index"] for b in batches]).tolist() == [i for i in range(12) if i not in corrupt]
    assert sum(int(b["dhtorch.skipped"]) for b in batches) == 2 == skipping.report()["unreadable"]
    flagging = transform(on_error="flag", other_image=None)
    batches, _ = loaded(ExtendedDataset(Frames(items, corrupt), flagging), 2, "fork")
    rows = in_rows(batches)
    assert (rows["dhtorch.problem"] == Problem.UNREADABLE).nonzero()[:, 0].tolist() == sorted(corrupt)
    assert flagging.report() == {"none": 0, "no_second_view": 10, "no_depth": 0, "unreadable": 2}
    assert batches[0]["image"].shape[1:] == (SIDE, SIDE, 3) and batches[1]["image"][1].sum() == 0


@pytest.mark.filterwarnings("ignore")
def test_a_whole_batch_skipped(items):
    skipping = transform(on_error="skip", other_image=None)
    batches, _ = loaded(ExtendedDataset(Frames(items[:4], {0, 1}), skipping), 0, collate_fn=collate_kept)
    assert batches[0] == {"dhtorch.skipped": 2} and batches[1]["dhtorch.depth"].shape == (2, N)
    with pytest.raises(SampleError, match="neither item 0 nor its neighbours"):
        ExtendedDataset(Frames(items[:2], {0, 1}), transform(on_error="flag"))[0]


class Threads(Frames):
    def __getitem__(self, i):
        return {"torch": torch.get_num_threads(), "cv2": cv2.getNumThreads()}


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_one_thread_in_a_worker(items):
    cv2.setNumThreads(2)
    batches, _ = loaded(Threads(items[:2]), 1, "fork")
    assert batches[0]["torch"].tolist() == batches[0]["cv2"].tolist() == [1, 1] and cv2.getNumThreads() == 2
    cv2.setNumThreads(1)


def test_it_pickles_and_copies(sample):
    one = transform(index_key="index", confidence=None)
    first = one(sample)
    for twin in (pickle.loads(pickle.dumps(one)), copy.deepcopy(one)):
        assert same(first, twin(sample)) and twin.report()["none"] == 2 and one.report()["none"] == 1
    buffer = io.BytesIO()
    torch.save(first, buffer)
    assert buffer.tell() < 4e5, "samples carry no more than they say"


# ---------------------------------------------------------------------------------------------------- tokens


def test_tokens_by_hand():
    """Pooled one patch at a time, in plain Python."""
    torch.manual_seed(0)
    B, M, hw, patch = 2, 300, (45, 60), 14
    uv = torch.rand(B, M, 2) * torch.tensor([hw[1] - 1.0, hw[0] - 1.0])
    depth, source = 0.5 + 4 * torch.rand(B, M), torch.randint(0, 3, (B, M), dtype=torch.int32)
    hole = torch.where(source == Source.SENSOR, Hole.NONE, torch.randint(1, 7, (B, M), dtype=torch.int32))
    found = dhtorch.Map(uv, torch.where(source > 0, depth, 0.0), 0.1 * depth, depth, source)
    tokens, known = patch_tokens(found, hole, hw, patch=patch)
    rows, columns = grid(hw, patch=patch)
    assert (rows, columns) == (3, 4) and tokens.shape == (B, 12, len(CHANNELS))
    for b in range(B):
        for r in range(rows):
            for c in range(columns):
                u, v = uv[b].T + 0.5
                inside = (u >= c * patch) & (u < (c + 1) * patch) & (v >= r * patch) & (v < (r + 1) * patch)
                some = inside & (source[b] > 0)
                token = tokens[b, r * columns + c]
                assert known[b, r * columns + c] == some.any()
                if some.any():
                    inverse = 1 / depth[b][some].double()
                    spread = ((0.1 * inverse) ** 2).mean() + inverse.var(correction=0)
                    assert torch.isclose(token[0].double(), inverse.mean(), rtol=1e-5)
                    assert torch.isclose(token[1].double(), spread.sqrt(), rtol=1e-5)
                shares = [some.sum(), *((inside & (hole[b] == k)).sum() for k in names(Hole))]
                expected = torch.stack([x / inside.sum().clamp_min(1) for x in shares])
                assert torch.allclose(token[2:], expected, atol=1e-6)


@pytest.mark.parametrize("fit", ["stretch", "pad", "crop"])
def test_tokens_lie_where_the_network_sees_them(fit):
    """Grey values of the picture as the network gets it, and tokens of the same picture, agree about the place."""
    hw, side = (60, 120), 56
    uv = torch.cartesian_prod(torch.arange(120.0), torch.arange(60.0))[None]
    value = 1 / (1 + uv[..., 0] + 200 * uv[..., 1])  # a depth that tells the pixel
    one = torch.ones_like(value)
    found = dhtorch.Map(uv, value, 0 * one, one, one.int())
    tokens, known = patch_tokens(found, one.int() * 0, hw, tokens_hw=(side, side), fit=fit)
    picture = (1 / value).view(120, 60).T[None, None]
    if fit == "crop":
        picture = picture[..., 30:90]
    shape = (side // 2, side) if fit == "pad" else (side, side)
    picture = torch.nn.functional.interpolate(picture, shape, mode="area")
    if fit == "pad":
        picture = torch.nn.functional.pad(picture, (0, 0, side // 4, side // 4))
    wanted = torch.nn.functional.avg_pool2d(picture, 14).flatten()
    got = tokens[0, :, 0]
    assert torch.equal(known[0], wanted > 0) and (got[~known[0]] == 0).all()
    assert torch.allclose(got[known[0]], wanted[known[0]], rtol=0.05)


def test_tokens_refuse_what_cannot_be():
    found = dhtorch.Map(*(torch.zeros(1, 0, 2), *torch.zeros(3, 1, 0), torch.zeros(1, 0, dtype=torch.int32)))
    tokens, known = patch_tokens(found, torch.zeros(1, 0), (28, 28))
    assert tokens.shape == (1, 4, 10) and not known.any() and (tokens == 0).all()
    with pytest.raises(ValueError, match="at least one patch"):
        patch_tokens(found, torch.zeros(1, 0), (10, 28))
    with pytest.raises(ValueError, match="fit"):
        patch_tokens(found, torch.zeros(1, 0), (28, 28), fit="squash")
    with pytest.raises(ValueError, match="expected"):
        patch_tokens(found, torch.zeros(2, 0), (28, 28))


def test_tokens_stand_beside_dinov2_and_both_learn():
    transformers = pytest.importorskip("transformers")
    source = SyntheticRoom(hw=(224, 224), n_frames=GAP + 1, lidar="exact", image_noise=0.0)
    near = [torch.where(source[i].depth <= NEAR, source[i].depth, 0.0) for i in (0, GAP)]
    config = transformers.Dinov2Config(
        hidden_size=32, num_hidden_layers=1, num_attention_heads=2, patch_size=14, image_size=224
    )
    network = transformers.Dinov2Model(config)
    images = torch.cat([source[0].image, source[GAP].image]).float() / 255
    depth, images = torch.cat(near).requires_grad_(), images.requires_grad_()
    K = cam.to_matrix(source[0].camera).expand(2, 3, 3).clone().requires_grad_()
    extender = ExtendDepth(depth_unit="m", other_image="other", batched=True, n=512)
    out = extender({"image": images, "other": images.flip(0), "depth": depth, "intrinsics": K})
    seen = network(pixel_values=images).last_hidden_state[:, 1:]
    tokens = torch.cat((seen, out["dhtorch.tokens"]), -1)
    assert seen.shape == (2, 256, 32) and tokens.shape == (2, 256, 42)
    head = torch.nn.Linear(42, 4)
    head(tokens).square().mean().backward()
    assert head.weight.grad[:, 32:].abs().max() > 0
    for name, x in {"depth": depth, "images": images, "K": K}.items():
        assert x.grad.isfinite().all() and x.grad.abs().max() > 0, name
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.encoder.parameters())
    # What far tokens owe to the intrinsics comes through triangulation alone.
    K.grad = None
    out = extender(
        {"image": images.detach(), "other": images.detach().flip(0), "depth": depth.detach(), "intrinsics": K}
    )
    recovered = out["dhtorch.source"] == Source.RECOVERED
    assert recovered.sum() > 20
    out["dhtorch.depth"][recovered].sum().backward()
    assert K.grad.abs().max() > 0
