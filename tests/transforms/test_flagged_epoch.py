"""``on_error="flag"``: an epoch goes on where the keys of a sample are missing, of another shape or not finite."""

import warnings

import numpy as np
import pytest
import torch
from support.stub_samples import H, N, W, added, sample, tiny
from torch.utils.data import DataLoader, Dataset, default_collate

from dhtorch.transforms import ExtendedDataset, ExtendedStream, SampleError, SampleProblem, one_thread

GOOD, BAD = (0, 2, 3), 1


def without(name):
    return lambda x: {k: v for k, v in x.items() if k != name}


def changed(**values):
    return lambda x: {**x, **values}


def nan_picture(x):
    return {**x, "image": np.full_like(x["image"], np.nan)}


#: (what is wrong with the sample, its message).
FAULTS = {
    "not a number": (nan_picture, "image: found the value nan"),
    "one pixel": (
        lambda x: {**x, "image": np.where(np.arange(W)[:, None] == 3, np.inf, x["image"]).astype(np.float32)},
        "image",
    ),
    "another size": (
        lambda x: {**x, "image": x["image"][:14]},
        r"image: found float32 of shape \(14, 42, 3\), expected",
    ),
    "no channels": (lambda x: {**x, "image": x["image"][..., 0]}, "image: found float32 of shape"),
    "RGBA": (lambda x: {**x, "image": np.zeros((H, W, 4), np.float32)}, "image: found float32 of shape"),
    "bytes": (lambda x: {**x, "image": np.zeros((H, W, 3), np.uint8)}, "image: found uint8 of shape"),
    "no picture": (without("image"), "image: found no such key"),
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
}


def floats(k):
    """A sample with pictures of floats and a key that the transform does not read."""
    x = sample(k)
    return {
        **x,
        "image": np.float32(x["image"]) / 255,
        "before": np.float32(x["before"]) / 255,
        "state": np.float32([k]),
    }


class Items(Dataset):
    """Four samples, of which one is spoiled, or raises."""

    def __init__(self, spoil, bad=BAD):
        self.spoil, self.bad = spoil, bad

    def __len__(self):
        return 4

    def __getitem__(self, i):
        return self.spoil(floats(i)) if i == self.bad else floats(i)


def raise_error(_):
    raise OSError("premature end of file")


def same(x):
    return x


def batch_of(dataset, workers, by_batch):
    loader = DataLoader(
        dataset,
        4,
        num_workers=workers,
        collate_fn=dataset.collate if by_batch else None,
        worker_init_fn=one_thread,
        multiprocessing_context="fork" if workers else None,
    )
    (batch,) = loader
    return batch


def check(batch, good, bad=BAD):
    """All rows but one are those of the sound batch; that one has zeros, and its problem is stated."""
    assert batch.keys() == good.keys()
    rows = [k for k in range(4) if k != bad]
    for key, value in batch.items():
        if isinstance(value, torch.Tensor):
            assert value.shape == good[key].shape and value.dtype == good[key].dtype, key
            assert torch.equal(value[rows], good[key][rows]), key
            assert not value.is_floating_point() or bool(value.isfinite().all()), key
    columns = added(batch)
    assert columns["problem"].tolist() == [3 if k == bad else 0 for k in range(4)]
    assert not any(value[bad].any() for key, value in columns.items() if key != "problem")


@pytest.mark.parametrize("by_batch", [False, True])
@pytest.mark.parametrize("fault", [*FAULTS, "raises"])
def test_an_epoch_goes_on_with_zeros_in_place_of_a_bad_sample(fault, by_batch):
    spoil, message = FAULTS.get(fault, (raise_error, "item 1 cannot be loaded: premature end of file"))
    options = {"on_error": "flag", "patch": 7, "index_key": "index"}
    good = batch_of(ExtendedDataset(Items(same), tiny(**options), by_batch=by_batch), 0, by_batch)
    dataset = ExtendedDataset(Items(spoil), tiny(**options), by_batch=by_batch)
    with pytest.warns(UserWarning, match=f"^flagged: .*{message}") as caught:
        batch = batch_of(dataset, 0, by_batch)
    assert len(caught) == 1
    check(batch, good)
    assert dataset.transform.report()["unreadable"] == 1 and dataset.transform.report()["none"] == 3


@pytest.mark.parametrize("by_batch", [False, True])
@pytest.mark.parametrize("bad", [0, 3])
def test_in_workers_too_and_where_the_first_sample_is_bad(bad, by_batch):
    options = {"on_error": "flag", "patch": 7}
    good = batch_of(ExtendedDataset(Items(same), tiny(**options), by_batch=by_batch), 0, by_batch)
    for fault in ("not a number", "depth is None", "another size", "no picture"):
        dataset = ExtendedDataset(Items(FAULTS[fault][0], bad), tiny(**options), by_batch=by_batch)
        check(batch_of(dataset, 1, by_batch), good, bad)
        assert dataset.transform.report()["unreadable"] == 1


@pytest.mark.parametrize("consumed", [(), ("depth", "before", "intrinsics")])
def test_keys_that_are_consumed_may_be_off(consumed):
    for by_batch in (False, True):
        options = {"by_batch": by_batch, "consumed": consumed}
        good = batch_of(ExtendedDataset(Items(same), tiny(on_error="flag"), **options), 0, by_batch)
        for fault in ("depth is None", "no source view", "another depth"):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                batch = batch_of(
                    ExtendedDataset(Items(FAULTS[fault][0]), tiny(on_error="flag"), **options), 0, by_batch
                )
            check(batch, good)
            assert not {*consumed} & batch.keys()


def test_a_stream_takes_the_shapes_of_its_first_good_sample():
    for fault in ("depth is None", "no picture", "RGBA", "not a number"):
        stream = ExtendedStream([floats(0), FAULTS[fault][0](floats(1)), floats(2)], tiny(on_error="flag"))
        with pytest.warns(UserWarning, match="^flagged: "):
            batch = default_collate(list(stream))
        assert batch["dhtorch.problem"].tolist() == [0, SampleProblem.UNREADABLE, 0]
        assert batch["image"].shape == (3, H, W, 3) and batch["depth"].shape == (3, H, W)
        assert batch["dhtorch.depth"].shape == (3, N) and bool(batch["image"].isfinite().all())


def test_a_set_without_a_good_sample_is_named():
    dataset = ExtendedDataset([{"image": 3}] * 3, tiny(on_error="flag"))
    with pytest.raises(SampleError, match="neither item 1 nor its neighbours can be loaded"):
        dataset[1]
    with pytest.raises(ValueError, match="on_error is 'skip', expected raise or flag where by_batch is set"):
        ExtendedDataset(Items(same), tiny(on_error="skip"), by_batch=True)
    wrong = ExtendedDataset(Items(same), tiny(on_error="flag", depth_unit=1e-6))
    with pytest.warns(UserWarning, match="flagged: depth: the median return"):
        assert batch_of(wrong, 0, False)["dhtorch.problem"].tolist() == [3, 3, 3, 3]
