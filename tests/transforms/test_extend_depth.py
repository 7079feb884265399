"""ExtendDepth with methods of the package on the built-in room: what it adds, batches, workers, gradients, maps."""

import copy
import io
import pickle
import warnings
from inspect import signature

import numpy as np
import pytest
import torch
from support.loader_batches import join_features, load_batches
from support.sample_dicts import GAP, NEAR, SIDE, Frames, frames, room
from support.stub_samples import added
from torch.utils.data import default_collate

import dhtorch
from dhtorch import MAP, PAPER
from dhtorch.codes import Flag, Gate, Source
from dhtorch.pipeline import completion, dense
from dhtorch.records import MergedDepth
from dhtorch.stages import score
from dhtorch.transforms import (
    DenseMaps,
    ExtendDepth,
    ExtendedDataset,
    SampleError,
    SampleProblem,
    SampleSpec,
    patch_tokens,
)

N, P, SIZE = 256, (SIDE // 14) ** 2, 84
DENSE = {"planes": 24, "size": SIZE, "refinements": 1, "max_sigma_rel": 0.3}
MAPS = {"depth_map": torch.float32, "sigma_map": torch.float32, "score_map": torch.float32}
MAPS |= {"source_map": torch.int32, "gate_map": torch.int32}


def sparse(**options):
    return ExtendDepth(**{"depth_unit": "mm", "other_image": "before", "n": N, **options})


def mapped(**options):
    return sparse(**{"method": MAP.replace(n=N), "dense": DENSE, "n": None, **options})


@pytest.fixture(scope="module")
def items():
    torch.set_num_threads(1)
    return list(frames())


@pytest.fixture
def sample(items):
    return {**items[GAP], "before": items[0]["image"]}


@pytest.fixture(scope="module")
def pair(items):
    """What is added to a sample with two views, with maps and without."""
    whole = {**items[GAP], "before": items[0]["image"]}
    return added(mapped()(whole)), added(mapped(dense=False)(whole))


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(torch.as_tensor(a[k]), torch.as_tensor(b[k])) for k in a)


# ---------------------------------------------------------------------------------------------------- what it adds


def test_it_adds_what_the_method_answers(sample):
    before = copy.deepcopy(sample)
    out = sparse()(sample)
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
    **dict.fromkeys(("depth", "sigma", "score"), ((N,), torch.float32)),
    "valid": ((N,), torch.bool),
    **dict.fromkeys(("source", "flag", "hole", "gate"), ((N,), torch.int32)),
    "T_1_from_0": ((4, 4), torch.float32),
    "pose_cov": ((6, 6), torch.float32),
    "pose_ok": ((), torch.bool),
    "pose_code": ((), torch.int32),
    "tokens": ((P, 10), torch.float32),
    "tokens_valid": ((P,), torch.bool),
    "problem": ((), torch.int32),
}
BOTH = {Source.SENSOR, Source.SWEPT}

#: What is done to the sample -> (options, changes, problem, sources of the map's pixels with depth).
CASES = {
    "pair": ({}, lambda s: {}, SampleProblem.NONE, BOTH),
    "one view": ({"other_image": None}, lambda s: {}, SampleProblem.NO_SECOND_VIEW, {Source.SENSOR}),
    "padded": ({}, lambda s: {"before_is_pad": np.array([True])}, SampleProblem.NO_SECOND_VIEW, {Source.SENSOR}),
    "no depth": ({}, lambda s: {"depth": 0 * s["depth"]}, SampleProblem.NO_DEPTH, set()),
    "nan depth": ({}, lambda s: {"depth": np.full((SIDE, SIDE), np.nan, np.float32)}, SampleProblem.NO_DEPTH, set()),
    "black": ({}, lambda s: {"image": 0 * s["image"]}, SampleProblem.NONE, {Source.SENSOR}),
    "half": (
        {},
        lambda s: {k: torch.from_numpy(s[k]).permute(2, 0, 1).half() / 255 for k in ("image", "before")},
        SampleProblem.NONE,
        BOTH,
    ),
    "unreadable": ({"on_error": "flag"}, lambda s: {"depth": s["depth"][:, :50]}, SampleProblem.UNREADABLE, set()),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("make", [sparse, mapped])
def test_shapes_are_fixed_and_numbers_finite(sample, make, name):
    options, change, problem, sources = CASES[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore" if name == "unreadable" else "error")
        out = added(make(**options)({**sample, **change(sample)}))
    wanted = SHAPES | ({k: ((SIZE, SIZE), t) for k, t in MAPS.items()} if make is mapped else {})
    assert {k: (tuple(v.shape), v.dtype) for k, v in out.items()} == wanted
    assert all(v.isfinite().all() for v in out.values()) and out["problem"] == problem
    for key in ("depth", "sigma", "score", "xyz"):
        assert (out[key][~out["valid"]] == 0).all(), key
    if make is mapped:
        silent = out["source_map"] == Source.NONE
        assert all((out[k][silent] == 0).all() for k in ("depth_map", "sigma_map", "score_map"))
        assert bool((out["depth_map"][~silent] > 0).all()) and bool(out["gate_map"].any()) == (name != "unreadable")
        assert set(out["source_map"].unique().tolist()) - {Source.FILLED} == {Source.NONE, *sources}
    if problem == SampleProblem.NO_DEPTH:
        assert not out["valid"].any() and not out["pose_ok"] and (out["flag"] & Flag.NO_DEPTH).bool().all()
    if problem == SampleProblem.NO_SECOND_VIEW:
        assert (out["gate"] == Gate.NO_TRACK).all() and not out["pose_ok"] and out["valid"].any()
        assert (out["source"][out["valid"]] == Source.SENSOR).all()
        assert same(out, added(make(other_image=None)(sample)))


# ------------------------------------------------------------------------------------------------ cameras and methods


class Scorer(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Parameter(torch.tensor(0.5))

    def forward(self, estimate, samples, tracks, fit):
        ranked = score.confidence(estimate, samples, tracks, fit)
        return ranked.replace(score=ranked.score * self.gain)


def test_any_method_serves_and_a_learned_part_is_a_part_of_the_module(sample, items):
    out = added(sparse(method=dhtorch.extend.replace(score={"min_score": 0.9}, n=64), n=None)(sample))
    assert out["depth"].shape == (64,) and not ((out["source"] == Source.RECOVERED) & (out["score"] < 0.9)).any()
    module = sparse(method=dhtorch.extend.replace(score=Scorer()))
    (gain,) = module.parameters()
    out, plain = added(module(sample)), added(sparse()(sample))
    out["score"].sum().backward()
    recovered = out["source"] == Source.RECOVERED
    assert gain.grad > 0 and torch.equal(out["score"][recovered], 0.5 * plain["score"][recovered])
    many = {**items[GAP], "image": np.stack([items[k]["image"] for k in (0, 3, 4, GAP)])}
    out = added(ExtendDepth(depth_unit="mm", method=PAPER.replace(views=5), other_at=(0, 1, 2), n=N)(many))
    assert {k: v.shape for k, v in out.items()} == {k: v.shape for k, v in plain.items()}
    assert (out["source"] == Source.RECOVERED).any()


# ------------------------------------------------------------------------------------------------ batches and workers


@pytest.mark.parametrize(
    ("make", "options", "n"),
    [
        (sparse, {}, 6),
        (sparse, {"index_key": "index", "distortion": [0.05, -0.02, 0.001, 0.0, 0.0]}, 6),
        (mapped, {"index_key": "index", "seed": 3}, 4),
    ],
)
def test_a_batch_is_its_samples_and_the_unpaired_get_the_sensor_alone(items, make, options, n):
    samples = [{**items[i], "before": items[i - GAP]["image"]} for i in range(GAP, GAP + n)]
    samples[1] = {**samples[1], "depth": (make is mapped) * samples[1]["depth"]}
    pads = {1} if make is mapped else {2}
    samples = [{"before_is_pad": torch.tensor([k in pads]), **s} for k, s in enumerate(samples)]
    single, batched = make(**options), make(**options, batched=True)
    together = added(batched(default_collate(samples)))
    assert same(added(default_collate([single(s) for s in samples])), together)
    counts = {"none": n - 1, "no_second_view": 1, "no_depth": 0, "unreadable": 0}
    assert batched.report() == single.report() == counts | ({} if make is mapped else {"none": 4, "no_depth": 1})
    if make is mapped:
        assert (together["source_map"] == Source.SWEPT).flatten(1).any(1).tolist() == [True, False, True, True]
        reference = SampleSpec(depth_unit="mm").read(items[GAP + 1]).reference
        sensed = dense.sensor_depth_map(reference, method=MAP.replace(n=N), size=SIZE)
        assert torch.equal(together["depth_map"][1], sensed.depth[0].nan_to_num())
        assert torch.equal(together["gate_map"][1], sensed.gate[0])


class Nested(Frames):
    """Frames with a dict inside."""

    def __getitem__(self, i):
        return {**super().__getitem__(i), "episode": {"number": torch.tensor(i)}}


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning", "ignore:.*pin_memory.*:UserWarning")
@pytest.mark.parametrize(
    ("workers", "context", "batch", "by_batch", "options"),
    [
        (0, None, 5, False, {}),
        (2, "fork", 2, False, {"persistent_workers": True, "pin_memory": True}),
        *(pytest.param(1, context, 4, True, {}, marks=pytest.mark.slow) for context in ("fork", "spawn")),
        pytest.param(1, "spawn", 3, False, {}, marks=pytest.mark.slow),
    ],
)
def test_workers_and_batch_size_change_nothing(items, workers, context, batch, by_batch, options):
    here = ExtendedDataset(Frames(items), sparse(index_key="index", seed=5), gap=GAP)
    wanted = join_features(load_batches(here, 0)[0])
    extender = sparse(index_key="index", seed=5)
    dataset = ExtendedDataset(Nested(items), extender, gap=GAP, by_batch=by_batch)
    options = {**options, **({"collate_fn": dataset.collate} if by_batch else {})}
    batches, loader = load_batches(dataset, workers, context, batch, **options)
    rows = join_features(batches)
    assert same(wanted, rows) and all(not v.requires_grad and v.dtype == wanted[k].dtype for k, v in rows.items())
    assert batches[0]["task"] == ["look around"] * batch and "before" not in batches[0]
    assert batches[0]["episode"]["number"].tolist() == batches[0]["index"].tolist()
    episodes = 2 if options.get("persistent_workers") else 1
    if episodes == 2:
        assert same(rows, join_features(list(loader)))
    assert extender.report() == {"none": 3 * episodes, "no_second_view": 9 * episodes, "no_depth": 0, "unreadable": 0}


@pytest.mark.filterwarnings("ignore")
def test_maps_in_a_worker_are_the_same_also_where_an_item_is_corrupt(items):
    options = {"on_error": "flag", "tokens_hw": (56, 56)}
    here, there = (
        join_features(load_batches(ExtendedDataset(Frames(items[: GAP + 2], {1}), mapped(**options), gap=GAP), *w)[0])
        for w in ((0,), (1, "fork"))
    )
    assert same(here, there)
    assert here["dhtorch.problem"].tolist() == [1, 3, 1, 1, 1, 1, 0, 3], "the last one's other view is corrupt"
    flat = here["dhtorch.source_map"].flatten(1)
    assert flat.any(1).tolist() == [k not in (1, 7) for k in range(8)] and (flat[GAP] == Source.SWEPT).any()
    with pytest.raises(SampleError, match="no image gives the size of its maps"):
        mapped(**options)({"depth": items[0]["depth"]})


def test_it_pickles_and_copies_and_torch_compile_leaves_it_as_it_is(sample):
    """torch.compile would trace for many minutes into a sample that Python reads; a model around it is compiled."""
    one = sparse(index_key="index")
    first = one(sample)
    for twin in (pickle.loads(pickle.dumps(one)), copy.deepcopy(one)):
        assert same(added(first), added(twin(sample))) and twin.report()["none"] == 2 and one.report()["none"] == 1
    buffer = io.BytesIO()
    torch.save(first, buffer)
    assert buffer.tell() < 4e5, "samples carry no more than they say"
    for compiled in (torch.compile(one, backend="eager"), torch.compile(torch.nn.Sequential(one), backend="eager")):
        assert same(added(compiled(sample)), added(first))


# ---------------------------------------------------------------------------------------------------------- dense maps


def test_maps_and_tokens_are_those_of_the_dense_method(sample, pair):
    out, plain = pair
    assert out.keys() == plain.keys() | MAPS.keys()
    assert [k for k in plain if not torch.equal(out[k], plain[k])] == ["tokens", "tokens_valid"]
    read = SampleSpec(depth_unit="mm", other_image="before").read(sample)
    method = MAP.replace(n=N)
    with torch.no_grad():
        found = completion.complete_depth(
            read.reference, read.other, method=method, calibration=completion.default_calibration(), **DENSE
        )
    swept = found.source == Source.SWEPT
    assert swept.sum() > 500 and (~found.keep).sum() > 500, "or there is nothing to compare"
    for key in ("depth", "sigma", "score", "source", "gate"):
        expected = torch.where(found.keep | (key == "gate"), getattr(found, key), 0)[0]
        assert torch.equal(out[f"{key}_map"], expected), key
    uv = dense.map_pixel_centres(read.reference, (SIZE, SIZE))
    hole = method.sample_depth_at(read.reference, uv).hole
    every = MergedDepth(uv[None], *(out[f"{key}_map"].reshape(1, -1) for key in ("depth", "sigma", "score", "source")))
    tokens, known = patch_tokens(every, hole, (SIDE, SIDE))
    assert torch.equal(out["tokens"], tokens[0]) and torch.equal(out["tokens_valid"], known[0])


def test_maps_and_tokens_learn_from_images_and_depth(sample):
    tensors = {k: torch.from_numpy(sample[k].astype(np.float32)) for k in ("image", "before", "depth")}
    leaves = {k: (v / 255 if k != "depth" else v).requires_grad_() for k, v in tensors.items()}
    out = added(mapped()({**sample, **leaves}))
    swept = out["source_map"] == Source.SWEPT
    assert swept.sum() > 500
    for total in (out["depth_map"][swept].log().sum(), out["tokens"].square().sum()):
        for name, gradient in zip(
            leaves, torch.autograd.grad(total, list(leaves.values()), retain_graph=True), strict=True
        ):
            assert gradient.isfinite().all() and gradient.any(), name


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"sise": 224}, "dense: found 'sise', expected some of source_views, planes, size, refinements, min_corr"),
        ({"method": MAP}, "dense: found 'method', expected some of"),
        ({"planes": 12.5}, "dense.planes: found 12.5, expected a whole number"),
        ({"size": True}, "dense.size: found True, expected a whole number"),
        ({"max_sigma_rel": "little"}, "dense.max_sigma_rel: found 'little', expected a number"),
        ("yes", "dense: found 'yes', expected true, false or options among"),
    ],
)
def test_options_of_maps_are_checked_when_it_is_made_and_default_to_those_of_the_function(wrong, words):
    for name in ("dense", "extract.dense"):
        with pytest.raises(ValueError, match=words.replace("dense", name, 1)):
            DenseMaps.from_options(wrong, name)
    with pytest.raises(ValueError, match=words):
        mapped(dense=wrong)
    standard = DenseMaps.from_options(True).options
    assert standard == DenseMaps.from_options({}).options and DenseMaps.from_options(False) is None
    parameters = signature(completion.complete_depth).parameters
    assert {k: parameters[k].default for k in standard} == standard
    changed = {"size": 224, "max_sigma_rel": 1}
    assert DenseMaps.from_options(changed).options == {**standard, **changed}


# ----------------------------------------------------------------------------------------------- tokens and validation
