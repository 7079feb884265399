"""Dense maps in a data loader and in shards: fixed shapes, unchanged sparse keys, no depth where there is no answer."""

import pickle
import warnings
from inspect import signature

import numpy as np
import pytest
import torch
from support.loader_batches import join_features, load_batches
from support.sample_dicts import GAP, SIDE, Frames, frames
from support.stub_recordings import Load, recording, rows
from support.stub_samples import added
from torch.utils.data import default_collate

from dhtorch import MAP
from dhtorch.cli.run import main
from dhtorch.codes import Source
from dhtorch.extract import ExtractOptions, FeatureTable, columns, shards
from dhtorch.extract.dataset import common_map_hw
from dhtorch.pipeline import completion, dense
from dhtorch.records import MergedDepth
from dhtorch.transforms import (
    AddedCollate,
    DenseMaps,
    ExtendDepth,
    ExtendedDataset,
    NumpyTransform,
    RldsBatchTransform,
    SampleError,
    SampleProblem,
    SampleSpec,
    patch_tokens,
)

N, SIZE = 256, 84
DENSE = {"planes": 24, "size": SIZE, "refinements": 1, "max_sigma_rel": 0.3}
METHOD = MAP.replace(n=N)
SHAPES = {
    "depth_map": torch.float32,
    "sigma_map": torch.float32,
    "score_map": torch.float32,
    "source_map": torch.int32,
    "gate_map": torch.int32,
}


def transform(**options):
    return ExtendDepth(**{"depth_unit": "mm", "other_image": "before", "method": METHOD, "dense": DENSE, **options})


@pytest.fixture(scope="module")
def items():
    torch.set_num_threads(1)
    return list(frames())


@pytest.fixture
def sample(items):
    return {**items[GAP], "before": items[0]["image"]}


@pytest.fixture(scope="module")
def pair(items):
    """What is added to a sample with two views, and to the same one without maps."""
    whole = {**items[GAP], "before": items[0]["image"]}
    return added(transform()(whole)), added(transform(dense=False)(whole))


# ---------------------------------------------------------------------------------------------------- what is added


def test_the_other_keys_are_those_without_maps(pair):
    out, sparse = pair
    assert out.keys() == sparse.keys() | SHAPES.keys()
    assert [k for k in sparse if not torch.equal(out[k], sparse[k])] == ["tokens", "tokens_valid"]


def test_maps_and_tokens_are_those_of_the_dense_method(sample, pair):
    out = pair[0]
    read = SampleSpec(depth_unit="mm", other_image="before").read(sample)
    with torch.no_grad():
        found = completion.complete_depth(
            read.reference, read.other, method=METHOD, calibration=completion.default_calibration(), **DENSE
        )
    swept = found.source == Source.SWEPT
    assert swept.sum() > 500 and (~found.keep).sum() > 500, "or there is nothing to compare"
    for key in ("depth", "sigma", "score", "source", "gate"):
        expected = torch.where(found.keep | (key == "gate"), getattr(found, key), 0)[0]
        assert torch.equal(out[f"{key}_map"], expected), key
    uv = dense.map_pixel_centres(read.reference, (SIZE, SIZE))
    hole = METHOD.sample_depth_at(read.reference, uv).hole
    every = MergedDepth(uv[None], *(out[f"{key}_map"].reshape(1, -1) for key in ("depth", "sigma", "score", "source")))
    tokens, known = patch_tokens(every, hole, (SIDE, SIDE))
    assert torch.equal(out["tokens"], tokens[0]) and torch.equal(out["tokens_valid"], known[0])


@pytest.mark.parametrize("what", ["pair", "one view", "no depth", "black", "half", "unreadable"])
def test_shapes_are_fixed_and_numbers_finite(sample, what):
    options = {"other_image": None} if what == "one view" else {"on_error": "flag"} if what == "unreadable" else {}
    if what == "no depth":
        sample["depth"] = 0 * sample["depth"]
    if what == "black":
        sample["image"] = 0 * sample["image"]
    if what == "half":
        for key in ("image", "before"):
            sample[key] = torch.from_numpy(sample[key]).permute(2, 0, 1).half() / 255
    if what == "unreadable":
        sample["depth"] = sample["depth"][:, :50]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore" if what == "unreadable" else "error")
        out = added(transform(**options, tokens_hw=(56, 70))(sample))
    assert {k: (tuple(out[k].shape), out[k].dtype) for k in SHAPES} == {k: ((SIZE, SIZE), t) for k, t in SHAPES.items()}
    assert all(v.isfinite().all() for v in out.values()) and out["tokens"].shape == (20, 10)
    silent = out["source_map"] == Source.NONE
    assert all((out[k][silent] == 0).all() for k in ("depth_map", "sigma_map", "score_map"))
    assert bool((out["depth_map"][~silent] > 0).all())
    asked = {"pair": (Source.SENSOR, Source.SWEPT), "half": (Source.SENSOR, Source.SWEPT), "unreadable": ()}
    expected = asked.get(what, () if what == "no depth" else (Source.SENSOR,))
    assert set(out["source_map"].unique().tolist()) - {Source.FILLED} == {Source.NONE, *expected}
    if what == "unreadable":
        assert out["problem"] == SampleProblem.UNREADABLE and not out["gate_map"].any()


def test_a_batch_is_its_samples_and_the_unpaired_get_the_sensor_alone(items):
    samples = [{**items[i], "before": items[i - GAP]["image"]} for i in range(GAP, 10)]
    samples = [{**s, "before_is_pad": torch.tensor([k == 1])} for k, s in enumerate(samples)]
    options = {"index_key": "index", "seed": 3}
    single, batched = transform(**options), transform(**options, batched=True)
    together = added(batched(default_collate(samples)))
    alone = added(default_collate([single(s) for s in samples]))
    assert [k for k in alone if not torch.equal(alone[k], together[k])] == []
    assert (together["source_map"] == Source.SWEPT).flatten(1).any(1).tolist() == [True, False, True, True]
    reference = SampleSpec(depth_unit="mm").read(items[GAP + 1]).reference
    sensed = dense.sensor_depth_map(reference, method=METHOD, size=SIZE)
    assert torch.equal(together["depth_map"][1], sensed.depth[0].nan_to_num())
    assert torch.equal(together["gate_map"][1], sensed.gate[0])
    none = added(transform(other_image=None, **options)(items[GAP + 1]))
    assert all(torch.equal(none[k], together[k][1]) for k in none)


def test_maps_and_tokens_learn_from_pictures_and_depth(items):
    keys = ("image", "before", "depth")
    given = {**items[GAP], "before": items[0]["image"]}
    tensors = {k: torch.from_numpy(given[k].astype(np.float32)) for k in keys}
    leaves = {k: (v / 255 if k != "depth" else v).requires_grad_() for k, v in tensors.items()}
    out = added(transform()({**given, **leaves}))
    swept = out["source_map"] == Source.SWEPT
    assert swept.sum() > 500
    out["depth_map"][swept].log().sum().backward(retain_graph=True)
    for name, leaf in leaves.items():
        assert leaf.grad.isfinite().all() and leaf.grad.any(), name
        leaf.grad = None
    out["tokens"].square().sum().backward()
    assert all(leaf.grad.isfinite().all() and leaf.grad.any() for leaf in leaves.values())


# ---------------------------------------------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"sise": 224}, "dense: found 'sise', expected some of source_views, planes, size, refinements, min_corr"),
        ({"method": MAP}, "dense: found 'method', expected some of"),
        ({"planes": 12.5}, "dense.planes: found 12.5, expected a whole number"),
        ({"size": True}, "dense.size: found True, expected a whole number"),
        ({"max_sigma_rel": "little"}, "dense.max_sigma_rel: found 'little', expected a number"),
        ("yes", "dense: found 'yes', expected true, false or options among"),
    ],
)
def test_options_that_cannot_be_raise_when_it_is_made(wrong, said):
    with pytest.raises(ValueError, match=said):
        transform(dense=wrong)
    with pytest.raises(ValueError, match=f"extract.{said}"):
        ExtractOptions(dense=wrong)


def test_true_is_what_complete_does_by_itself():
    standard = DenseMaps.from_options(True)
    assert standard.options == DenseMaps.from_options({}).options and DenseMaps.from_options(False) is None
    parameters = signature(completion.complete_depth).parameters
    assert {k: parameters[k].default for k in standard.options} == standard.options
    changed = DenseMaps.from_options({"size": 224, "max_sigma_rel": 1}).options
    assert changed == {**standard.options, "size": 224, "max_sigma_rel": 1}


# ---------------------------------------------------------------------------------------------------- loaders


@pytest.mark.filterwarnings("ignore")
def test_a_worker_says_the_same_also_where_an_item_is_corrupt(items):
    def dataset(transform):
        return ExtendedDataset(Frames(items[: GAP + 2], {1}), transform, gap=GAP)

    options = {"on_error": "flag", "tokens_hw": (56, 56)}
    here = join_features(load_batches(dataset(transform(**options)), 0)[0])
    there = join_features(load_batches(dataset(transform(**options)), 1, "fork")[0])
    assert [k for k, v in here.items() if not torch.equal(v, there[k])] == []
    assert here["dhtorch.problem"].tolist() == [1, 3, 1, 1, 1, 1, 0, 3], "the last one's other view is corrupt"
    flat = here["dhtorch.source_map"].flatten(1)
    assert flat.any(1).tolist() == [k not in (1, 7) for k in range(8)] and (flat[GAP] == Source.SWEPT).any()


def test_a_corrupt_sample_without_a_picture_cannot_be_flagged(sample):
    with pytest.raises(SampleError, match="no image gives the size of its maps"):
        transform(on_error="flag", tokens_hw=(56, 56))({"depth": sample["depth"]})


def test_it_pickles_and_other_people_s_loaders_carry_it(sample, pair):
    twin = pickle.loads(pickle.dumps(transform()))
    data = NumpyTransform(twin)(sample)
    assert all(np.array_equal(data[f"dhtorch.{k}"], pair[0][k]) for k in SHAPES)
    rlds = RldsBatchTransform(lambda frame: {"labels": 1}, twin)
    batch = AddedCollate(lambda rows: {"n": len(rows)})([rlds(sample), rlds(sample)])
    assert batch["n"] == 2 and torch.equal(batch["dhtorch.depth_map"][1], pair[0]["depth_map"])


# ---------------------------------------------------------------------------------------------------- shards

ROOM = ["data.hw=[96,128]", "data.depth_hw=[48,64]", "data.n_frames=3", "data.supersample=1", "data.path=lateral"]
ROOM += ["data.step_m=0.1", "data.range_limit=2.0"]
ASKED = [*ROOM, "method=map", f"method.n={N}", "extract.gap=2", "extract.shard_rows=2"]


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """``dhtorch extract`` in this process, from an empty folder."""
    pytest.importorskip("pyarrow")
    monkeypatch.chdir(tmp_path)

    def call(*more, dense="{size: 48, planes: 12, max_sigma_rel: 0.3, refinements: 0}", out="out"):
        code = main(["extract", *ASKED, f"out={out}", f"extract.dense={dense}", *more])
        return (code, *capsys.readouterr())

    return call


def bytes_of(folder):
    return {p.name: p.read_bytes() for p in sorted(folder.glob("*.parquet"))}


@pytest.mark.slow
def test_maps_are_written_read_back_and_resumed(command, tmp_path):
    code, said, err = command("extract.half=true")
    assert code == 0 and "2 shards, 3 rows" in said, err
    features = FeatureTable("out")
    about = features.about["columns"]
    kinds = {k: (about[k]["kind"], about[k]["shape"], about[k]["unit"]) for k in SHAPES}
    f, byte = ("float16", [36, 48]), ("uint8", [36, 48], "code")
    numbers = {"depth_map": (*f, "m"), "sigma_map": (*f, "m"), "score_map": (*f, "1")}
    assert kinds == {**numbers, "source_map": byte, "gate_map": byte}
    assert all("0 = none, where a DepthMap has NaN" in about[k]["about"] for k in ("depth_map", "sigma_map"))
    assert features.about["codes"]["source_map"]["3"] == "SWEPT"
    found = [added(row) for row in features]
    sources = [set(row["source_map"].unique().tolist()) for row in found]
    assert [Source.SWEPT in one for one in sources] == [False, False, True]
    for one in found:
        assert {k: v.dtype for k, v in one.items() if k in SHAPES} == SHAPES and one["depth_map"].any()
        assert torch.equal(one["depth_map"] > 0, one["source_map"] > 0)
        assert torch.equal(one["depth_map"], one["depth_map"].half().float())
    before = bytes_of(tmp_path / "out")
    (tmp_path / "out" / "shard-00001.parquet").unlink()
    assert "2 shards (1 left untouched), 3 rows" in command("extract.half=true")[1]
    assert bytes_of(tmp_path / "out") == before
    code, _, err = command("extract.half=true", dense="{size: 48, planes: 12, max_sigma_rel: 0.3, refinements: 1}")
    assert code == 2 and "extract.dense.refinements 0 there, 1 here" in err


def test_a_misspelt_option_is_said_before_anything_is_read(command, tmp_path):
    code, _, err = command(dense="{sise: 48}")
    assert code == 2 and "extract.dense: found 'sise', expected some of source_views" in err
    assert len(err.strip().splitlines()) == 1 and not list(tmp_path.iterdir())


class OtherSize(Load):
    """Frames whose picture is wider from a position on."""

    def __init__(self, first_wide, **options):
        super().__init__(**options)
        self.first_wide = first_wide

    def __call__(self, i):
        one = super().__call__(i)
        if i < self.first_wide:
            return one
        return one.replace(image=one.image.repeat(1, 1, 1, 2), depth=one.depth.repeat(1, 1, 2))


def test_recordings_of_another_shape_are_refused_before_the_work(tmp_path):
    small, wide = recording(2, load=Load(bad={0})), recording(2, name="two", load=OtherSize(0))
    assert common_map_hw([small, recording(3)], DenseMaps.from_options({"size": 21})) == (14, 21)
    said = "extract.dense: two has pictures of 28x84 and maps of 11x32, expected maps of 21x32 as of one; extract them"
    with pytest.raises(ValueError, match=said):
        common_map_hw([small, wide], DenseMaps.from_options({"size": 32}))
    with pytest.raises(ValueError, match="found no frame that can be read"):
        common_map_hw([recording(2, load=Load(bad={0, 1}))], DenseMaps.from_options(True))


def test_a_frame_of_another_shape_is_one_that_cannot_be_read():
    wanted = columns.feature_columns(6, 6, map_hw=(14, 21))
    made = rows([recording(2, load=OtherSize(1))], 0, wanted=wanted, dense={"size": 21})
    assert made[0].features["depth_map"].shape == (14, 21) and made[1].features is None
    assert "one, frame 1: depth_map: found 7x21, expected 14x21 as of the first frame" in made[1].complaint


def test_few_maps_are_held_at_once():
    assert shards._rows_per_group(columns.feature_columns(2048, 256)) == shards._MAX_GROUP_ROWS
    large = columns.feature_columns(2048, 256, map_hw=(480, 640))
    assert 1 < shards._rows_per_group(large) < 5
    held = shards._rows_per_group(large) * sum(c.n_bytes for c in large.values())
    assert held <= shards._MAX_GROUP_BYTES < held * 2
    assert shards._rows_per_group(columns.feature_columns(64, 256, map_hw=(2160, 3840))) == 1
