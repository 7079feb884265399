"""ExtendDepth: layouts and units, what it adds, data-loader workers, batches, tokens beside DINOv2, bad input."""

import copy
import io
import pickle
import warnings
from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch
from support.loader_batches import join_features, load_batches
from support.sample_dicts import GAP, NEAR, SIDE, Frames, frames, room
from torch.utils.data import default_collate

import dhtorch
from dhtorch import PAPER
from dhtorch.codes import Flag, Gate, Source
from dhtorch.geometry import camera as cam
from dhtorch.records import DepthValidation, Frame
from dhtorch.stages import score
from dhtorch.transforms import (
    ExtendDepth,
    ExtendedDataset,
    SampleError,
    SampleProblem,
    SampleSpec,
    ValidateDepth,
    collate_kept,
    sample_spec,
    validate_depth,
)

extend_window = PAPER.replace(views=5)

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
    read = SampleSpec(depth_unit="mm", other_image="before").read(sample)
    trace = {}
    estimate = dhtorch.extend(read.reference, read.other, n=N, trace=trace)
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
    expected = {
        "no depth": SampleProblem.NO_DEPTH,
        "nan depth": SampleProblem.NO_DEPTH,
        "unreadable": SampleProblem.UNREADABLE,
    }
    expected |= {"one view": SampleProblem.NO_SECOND_VIEW, "padded": SampleProblem.NO_SECOND_VIEW}
    assert out["problem"] == expected.get(what, SampleProblem.NONE)
    if what in ("no depth", "nan depth"):
        assert not out["valid"].any() and not out["pose_ok"] and (out["flag"] & Flag.NO_DEPTH).bool().all()
    if what in ("one view", "padded"):
        assert (out["gate"] == Gate.NO_TRACK).all() and not out["pose_ok"] and out["valid"].any()
        assert (out["source"][out["valid"]] == Source.SENSOR).all()


def test_one_view_and_a_padded_pair_say_the_same(sample):
    alone = transform(other_image=None)(sample)
    assert same(alone, transform()({**sample, "before_is_pad": torch.tensor([True])}))


# ---------------------------------------------------------------------------------------------------- layouts and units


@pytest.mark.parametrize("batched", [False, True])
def test_a_map_with_one_return_where_no_sample_is_has_depth(sample, batched):
    ask = transform(other_image=None, batched=batched)
    maps = [np.array(sample["depth"]), 0 * np.array(sample["depth"]), 0 * np.array(sample["depth"])]
    seen = added(transform(other_image=None)(sample))["uv"].round().long()
    at = next((v, u) for v in range(SIDE) for u in range(SIDE) if not (seen == torch.tensor([u, v])).all(-1).any())
    maps[1][at] = 1500
    said = [SampleProblem.NO_SECOND_VIEW, SampleProblem.NO_SECOND_VIEW, SampleProblem.NO_DEPTH]
    samples = [sample | {"depth": x} for x in maps]
    found = added(ask(default_collate(samples)))["problem"] if batched else [added(ask(s))["problem"] for s in samples]
    assert list(found) == said


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


@pytest.mark.parametrize(
    ("change", "options"),
    [
        (as_float_chw, {}),
        (as_time_with_depth, {"other_image": None}),
        (lambda s: {**s, "depth": (s["depth"] / 1000).astype(np.float64)}, {"depth_unit": "m"}),
    ],
)
def test_layouts_of_one_sample_give_one_answer(sample, change, options):
    assert same(transform()(sample), transform(**options)(change(sample)))


def test_a_half_type_of_torch_is_lifted(sample):
    sample = as_float_chw(sample)
    changed = {k: sample[k].to(torch.bfloat16) for k in ("image", "before", "depth")}
    out = added(transform()({**sample, **changed}))
    assert out["depth"].dtype == torch.float32 and all(v.isfinite().all() for v in out.values())
    both = out["valid"] & added(transform()(sample))["valid"]
    assert both.sum() > 100 and out["pose_ok"]


def test_two_cameras_answer_as_the_method_with_two_cameras(sample, items):
    """The other view cut out eight pixels further left: an image with a K of its own."""
    K = sample["intrinsics"]
    sample["before"] = np.pad(sample["before"], ((0, 0), (8, 0), (0, 0)), "edge")[:, :SIDE]
    sample["K_before"] = K + np.float32([[0, 0, 8], [0, 0, 0], [0, 0, 0]])
    image, before = (torch.from_numpy(sample[k]).permute(2, 0, 1)[None] for k in ("image", "before"))
    mm = torch.from_numpy(sample["depth"].astype(np.float32))[None]
    one, two = (cam.from_matrix(torch.from_numpy(x)[None]) for x in (K, sample["K_before"]))
    trace = {}
    estimate = dhtorch.extend(Frame(image, mm / 1000, one), Frame(before, 0 * mm, two), n=N, trace=trace)
    found = dhtorch.merge(trace["samples"], estimate)
    own, shared = (added(transform(other_intrinsics=k)(sample)) for k in ("K_before", None))
    assert torch.equal(own["depth"], found.depth[0]) and torch.equal(own["sigma"], found.sigma[0])
    assert torch.equal(own["T_1_from_0"][:3, 3], trace["fit"].T_1_from_0.t[0]) and own["pose_ok"]
    assert not torch.allclose(own["T_1_from_0"], shared["T_1_from_0"], atol=1e-3)
    plain = added(transform()({**sample, "before": items[0]["image"]}))
    apart = (own["T_1_from_0"] - plain["T_1_from_0"]).abs().max()
    assert apart < 0.02 < (shared["T_1_from_0"] - plain["T_1_from_0"]).abs().max(), (
        "the same motion, whatever was cut out"
    )


def test_a_depth_map_of_its_own_size_and_camera(sample):
    half = sample["depth"][1::2, 1::2]
    K = sample["intrinsics"]
    # Pixels 1, 3, 5, … of the image: a camera whose pixel centres are exactly those.
    own = [K[0, 0] / 2, K[1, 1] / 2, (K[0, 2] - 1) / 2, (K[1, 2] - 1) / 2]
    read = SampleSpec(depth_unit="mm", depth_intrinsics=own).read({**sample, "depth": half})
    assert read.reference.depth_camera is not None and read.reference.depth.shape == (1, SIDE // 2, SIDE // 2)
    out = added(transform(depth_intrinsics=own)({**sample, "depth": half}))
    whole = added(transform()(sample))
    both = (out["source"] == Source.SENSOR) & (whole["source"] == Source.SENSOR)
    assert both.sum() > 20 and ((out["depth"] / whole["depth"])[both] - 1).abs().median() < 0.01
    with pytest.raises(SampleError, match="no scaled image"):
        transform()({**sample, "depth": np.repeat(sample["depth"], 2, 0)})


def test_low_confidence_is_no_return(sample):
    conf = np.zeros((SIDE, SIDE), np.uint8)
    conf[: SIDE // 2] = 2
    out = added(transform(confidence="conf")({**sample, "conf": conf}))
    low = (out["flag"] & Flag.LOW_CONF) != 0
    assert low.any() and (out["uv"][low][:, 1] >= SIDE // 2 - 0.5).all() and (out["source"][low] != Source.SENSOR).all()


# ---------------------------------------------------------------------------------------------------- methods and seeds


def test_any_method_will_do(sample):
    quiet = dhtorch.extend.replace(score={"min_score": 0.9}, n=64)
    out = added(ExtendDepth(depth_unit="mm", other_image="before", method=quiet)(sample))
    assert out["depth"].shape == (64,)
    assert not ((out["source"] == Source.RECOVERED) & (out["score"] < 0.9)).any()


def test_a_learned_part_is_a_part_of_the_module(sample):
    class Scorer(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.gain = torch.nn.Parameter(torch.tensor(0.5))

        def forward(self, estimate, samples, tracks, fit):
            ranked = score.confidence(estimate, samples, tracks, fit)
            return ranked.replace(score=ranked.score * self.gain)

    module = transform(method=dhtorch.extend.replace(score=Scorer()))
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


@pytest.fixture(scope="module")
def in_process(items):
    dataset = ExtendedDataset(Frames(items), transform(index_key="index", seed=5), gap=GAP)
    return join_features(load_batches(dataset, 0)[0])


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning", "ignore:.*pin_memory.*:UserWarning")
@pytest.mark.parametrize(
    ("workers", "context", "batch", "options"),
    [
        (0, None, 5, {}),
        (2, "fork", 2, {"persistent_workers": True, "pin_memory": True}),
        pytest.param(1, "spawn", 3, {}, marks=pytest.mark.slow),
    ],
)
def test_workers_and_batch_size_change_nothing(items, in_process, workers, context, batch, options):
    extender = transform(index_key="index", seed=5)
    dataset = ExtendedDataset(Frames(items), extender, gap=GAP)
    batches, loader = load_batches(dataset, workers, context, batch, **options)
    rows = join_features(batches)
    assert [k for k, v in in_process.items() if not torch.equal(v, rows[k])] == []
    assert all(not v.requires_grad for v in rows.values())
    assert batches[0]["task"] == ["look around"] * batch and "before" not in batches[0]
    if options.get("persistent_workers"):
        again = join_features(list(loader))
        assert all(torch.equal(v, again[k]) for k, v in rows.items())
    episodes = 2 if options.get("persistent_workers") else 1
    assert extender.report() == {"none": 3 * episodes, "no_second_view": 9 * episodes, "no_depth": 0, "unreadable": 0}


@pytest.mark.filterwarnings("ignore")
def test_corrupt_samples_in_the_middle(items):
    corrupt = {3, 8}
    with pytest.raises(OSError, match="premature end"):
        load_batches(ExtendedDataset(Frames(items, corrupt), transform(other_image=None)), 1, "fork")
    skipping = transform(on_error="skip", other_image=None)
    batches, _ = load_batches(ExtendedDataset(Frames(items, corrupt), skipping), 2, "fork", collate_fn=collate_kept)
    assert torch.cat([b["index"] for b in batches]).tolist() == [i for i in range(12) if i not in corrupt]
    assert sum(int(b["dhtorch.skipped"]) for b in batches) == 2 == skipping.report()["unreadable"]
    flagging = transform(on_error="flag", other_image=None)
    batches, _ = load_batches(ExtendedDataset(Frames(items, corrupt), flagging), 2, "fork")
    rows = join_features(batches)
    assert (rows["dhtorch.problem"] == SampleProblem.UNREADABLE).nonzero()[:, 0].tolist() == sorted(corrupt)
    assert flagging.report() == {"none": 0, "no_second_view": 10, "no_depth": 0, "unreadable": 2}
    assert batches[0]["image"].shape[1:] == (SIDE, SIDE, 3) and batches[1]["image"][1].sum() == 0


class Nested(Frames):
    """Frames with a dict inside."""

    def __getitem__(self, i):
        return {**super().__getitem__(i), "episode": {"number": torch.tensor(i)}}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("by_batch", [False, True])
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_what_is_added_leaves_a_worker_in_one_piece(items, in_process, by_batch, context):
    extender = transform(index_key="index", seed=5, batched=by_batch or None)
    dataset = ExtendedDataset(Nested(items), extender, gap=GAP, by_batch=by_batch, consumed=("depth",))
    batches, _ = load_batches(dataset, 1, context, 4, collate_fn=dataset.collate)
    rows = join_features(batches)
    assert [k for k, v in in_process.items() if not torch.equal(v, rows[k]) or v.dtype != rows[k].dtype] == []
    for batch in batches:
        ours = {k: x for k, x in batch.items() if k.startswith("dhtorch.")}
        assert len(ours) == len(in_process) and len({x.untyped_storage().data_ptr() for x in ours.values()}) == 1
        bounds = sorted((x.data_ptr(), x.numel() * x.element_size()) for x in ours.values())
        assert all(a + size <= b for (a, size), (b, _) in pairwise(bounds)), "one lies over another"
        assert all(x.is_contiguous() and x.data_ptr() % 8 == 0 for x in ours.values())
        assert all(x.untyped_storage().data_ptr() != batch["image"].untyped_storage().data_ptr() for x in ours.values())
        assert batch["episode"]["number"].tolist() == batch["index"].tolist() and "depth" not in batch
    (own,) = load_batches(dataset, 0, None, 12, collate_fn=dataset.collate)[0]
    mine = [x.untyped_storage().data_ptr() for k, x in own.items() if k.startswith("dhtorch.")]
    assert len(set(mine)) == len(mine), "nothing is shared where nothing leaves the process"


@pytest.mark.filterwarnings("ignore")
def test_skipped_samples_leave_a_batch(items):
    skipping = ExtendedDataset(Frames(items, {3, 8}), transform(on_error="skip", other_image=None))
    batches, _ = load_batches(skipping, 2, "fork", 4, collate_fn=skipping.collate)
    assert [b["dhtorch.skipped"].item() for b in batches] == [1, 0, 1]
    rows = join_features(batches)
    expected = [transform(other_image=None)(items[i]) for i in range(12) if i not in (3, 8)]
    assert [k for k, x in rows.items() if not torch.equal(x, torch.stack([e[k] for e in expected]))] == []


@pytest.mark.filterwarnings("ignore")
def test_a_whole_batch_skipped(items):
    skipping = transform(on_error="skip", other_image=None)
    batches, _ = load_batches(ExtendedDataset(Frames(items[:4], {0, 1}), skipping), 0, collate_fn=collate_kept)
    assert batches[0] == {"dhtorch.skipped": 2} and batches[1]["dhtorch.depth"].shape == (2, N)
    with pytest.raises(SampleError, match="neither item 0 nor its neighbours"):
        ExtendedDataset(Frames(items[:2], {0, 1}), transform(on_error="flag"))[0]


class Threads(Frames):
    def __getitem__(self, i):
        return {"torch": torch.get_num_threads(), "cv2": cv2.getNumThreads()}


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_one_thread_in_a_worker(items):
    cv2.setNumThreads(2)
    batches, _ = load_batches(Threads(items[:2]), 1, "fork")
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


@pytest.mark.slow
def test_tokens_stand_beside_dinov2_and_both_learn():
    transformers = pytest.importorskip("transformers")
    source = room()
    near = [torch.where(source[i].depth <= NEAR, source[i].depth, 0.0) for i in (0, GAP)]
    config = transformers.Dinov2Config(
        hidden_size=32, num_hidden_layers=1, num_attention_heads=2, patch_size=14, image_size=SIDE
    )
    network = transformers.Dinov2Model(config)
    images = torch.cat([source[0].image, source[GAP].image]).float() / 255
    depth, images = torch.cat(near).requires_grad_(), images.requires_grad_()
    K = cam.to_matrix(source[0].camera).expand(2, 3, 3).clone().requires_grad_()
    extender = ExtendDepth(depth_unit="m", other_image="other", batched=True, n=N)
    out = extender({"image": images, "other": images.flip(0), "depth": depth, "intrinsics": K})
    seen = network(pixel_values=images).last_hidden_state[:, 1:]
    tokens = torch.cat((seen, out["dhtorch.tokens"]), -1)
    assert seen.shape == (2, P, 32) and tokens.shape == (2, P, 42)
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


def test_what_a_verdict_does_not_know_is_0_and_said_to_be_unknown():
    """A number is known with both its bounds; a map that is cut at 0 m is cut."""
    pixel, number, nan = torch.zeros(3, 1, 2), torch.tensor([[1.0, 0.9, 1.1]]).repeat(3, 1), float("nan")
    number[1, 2], number[2] = nan, nan
    told = {"state": pixel.int(), "view": pixel.int(), "clip_depth": torch.tensor([0.0, 3.0, nan])}
    told["depth"] = torch.tensor([[[1.0, 0.0]]]).expand(3, 1, 2)
    told |= dict.fromkeys(("evidence", "sparse_evidence", "photometric_evidence", "consistency_evidence"), pixel)
    told |= {"outline_evidence": pixel, "cause": pixel.int()}
    numbers = ("scale", "scale_near", "scale_far", "scale_vs_trajectory", "shift", "tilt", "wrong")
    keys = validate_depth._validation_keys(DepthValidation(**told, **dict.fromkeys(numbers, number)))
    assert keys["state_share"].tolist() == [[1.0, 0.0, 0.0]] * 3, "where the map says nothing, nothing is shared out"
    for name in validate_depth._INTERVAL_KEYS:
        assert keys[f"{name}_known"].tolist() == [True, False, False] and keys[name].isfinite().all()
        assert torch.equal(keys[name][0], number[0]) and keys[name][2].tolist() == [0.0] * 3
    assert keys["clip_depth_known"].tolist() == [True, True, False] and keys["clip_depth"].tolist() == [0.0, 3.0, 0.0]


@pytest.mark.parametrize("transform", [ExtendDepth, ValidateDepth])
@pytest.mark.parametrize(
    "sample", [None, torch.zeros(3, 8, 8), "frame", [1, 2]], ids=["none", "tensor", "text", "list"]
)
def test_what_is_no_sample_is_named(transform, sample):
    said = rf"sample: found {type(sample).__name__}.*, expected a dict with pictures and depth; image_transforms"
    with pytest.raises(SampleError, match=said):
        transform(depth_unit="m")(sample)


def test_no_sample_is_skipped_but_cannot_be_flagged():
    with pytest.warns(UserWarning, match="skipped: sample: found None"):
        assert ExtendDepth(depth_unit="m", on_error="skip")(None) is None
    with pytest.raises(SampleError, match="found NoneType"):
        ExtendDepth(depth_unit="m", on_error="flag")(None)


@pytest.mark.parametrize("transform", [ExtendDepth, ValidateDepth])
def test_a_transform_without_a_unit_says_which_there_are(transform):
    with pytest.raises(ValueError, match=r"depth_unit is '', expected one of \['m', 'mm'\], metres per unit, or auto"):
        transform()


def test_one_return_that_no_probe_meets_is_a_return():
    depth = torch.zeros(2, 60, 80)
    depth[1, 31, 17] = 1.5
    assert 2 * sample_spec._MAX_PROBES < 60 * 80
    assert sample_spec._has_return(depth, sample_spec._probe_depth(depth)).tolist() == [False, True]
    assert sample_spec._has_return(depth[1:] + 1, sample_spec._probe_depth(depth[1:] + 1)).tolist() == [True]


def test_torch_compile_leaves_the_transform_as_it_is(sample):
    """It would trace for many minutes into a sample that Python reads; a model around the transform is compiled."""
    extend = transform()
    model = torch.nn.Sequential(extend)
    plain = extend(sample)
    for compiled in (torch.compile(extend, backend="eager"), torch.compile(model, backend="eager")):
        assert same(compiled(sample), plain)
