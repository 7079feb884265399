"""Wrappers of data sets: which item is the source view, skipped samples, and batches of a loader."""

import os
import pickle
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
from support.stub_samples import FixedEstimate, K, added, sample, tiny
from torch.utils.data import DataLoader

from dhtorch.transforms import (
    AddedCollate,
    ExtendedDataset,
    ExtendedStream,
    NumpyTransform,
    RldsBatchTransform,
    SampleError,
    SampleProblem,
    adapters,
    collate_kept,
    one_thread,
)

SAYS_NOTHING = pytest.mark.filterwarnings("ignore:flagged", "ignore:skipped")


class Items(torch.utils.data.Dataset):
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
        return one


def looking_back(gap=2, items=None, **options):
    method = FixedEstimate()
    keys = {k: options.pop(k) for k in ("episode_key",) if k in options}
    return ExtendedDataset(items or Items(), tiny(method, **options), gap=gap, **keys), method


# ---------------------------------------------------------------------------------------------------- map-style


def test_the_other_view_is_so_many_items_back_in_the_same_episode():
    for gap, pairs in ((1, {1: 0, 2: 1, 3: 2, 5: 4, 6: 5}), (2, {2: 0, 3: 1, 6: 4}), (3, {3: 0}), (4, {})):
        dataset, method = looking_back(gap)
        for i in range(7):
            method.arguments = {}
            out = dataset[i]
            assert (out["dhtorch.problem"] == SampleProblem.NONE) == (i in pairs), (gap, i)
            assert out["index"] == i and "before" not in out and "before_is_pad" not in out
            if i in pairs:
                assert np.array_equal(method.arguments["other"].image[0].permute(1, 2, 0), sample(pairs[i])["image"])
                assert np.array_equal(method.arguments["reference"].image[0].permute(1, 2, 0), sample(i)["image"])
            else:
                assert out["dhtorch.problem"] == SampleProblem.NO_SECOND_VIEW and not method.arguments


def test_episodes_are_told_by_a_key_or_are_one():
    for key, pairs in ((None, [2, 3, 4, 5, 6]), ("nested.part", []), ("episode_index", [2, 3, 6])):
        dataset, _ = looking_back(2, episode_key=key)
        assert [i for i in range(7) if dataset[i]["dhtorch.problem"] == 0] == pairs
    dataset, _ = looking_back(1, episode_key="nested.part")
    assert [i for i in range(7) if dataset[i]["dhtorch.problem"] == 0] == [1, 3, 5]


def test_indices_are_those_of_a_sequence():
    dataset, _ = looking_back()
    assert len(dataset) == 7 and dataset[-1]["index"] == 6 and dataset[-7]["index"] == 0
    for i in (7, -8):
        with pytest.raises(IndexError):
            dataset[i]
    assert [x["index"] for x in dataset] == list(range(7)), "a loop ends"


def test_samples_that_hold_both_views_are_taken_as_they_are():
    items = Items(before=sample(3)["image"])
    items.__class__ = type("Both", (Items,), {"__getitem__": lambda self, i: sample(i)})
    dataset = ExtendedDataset(items, tiny())
    out = dataset[2]
    assert out["dhtorch.problem"] == SampleProblem.NONE and np.array_equal(out["before"], sample(2)["before"])


def test_the_rest_is_the_data_sets_own():
    dataset, _ = looking_back()
    assert dataset.fps == 30 and not hasattr(dataset, "meta") and not hasattr(dataset, "__array__")
    twin = pickle.loads(pickle.dumps(dataset))
    assert len(twin) == 7 and twin.gap == 2
    stream = pickle.loads(pickle.dumps(ExtendedStream(Items(), tiny())))
    assert stream.fps == 30 and not hasattr(stream, "__array__") and not hasattr(stream, "meta")


@SAYS_NOTHING
def test_an_item_that_cannot_be_loaded_is_zeros_like_the_first_that_can():
    for corrupt, asked, source in (({3}, 3, 0), ({0, 1}, 0, 2), ({0, 1, 6}, 6, 2), ({0, 1, 2}, 1, 3)):
        items = Items(corrupt=corrupt, words=["a", b"b"], flag=True, number=3, ratio=0.5, row=(1, 2.0), key="x")
        dataset = ExtendedDataset(items, tiny(on_error="flag", other_image=None))
        out = dataset[asked]
        assert items.read[-1] == source, "the first, so that it is the same in every worker"
        assert out["dhtorch.problem"] == SampleProblem.UNREADABLE and not out["image"].any()
        assert (out["image"].shape, out["image"].dtype) == (sample()["image"].shape, np.uint8)
        assert torch.equal(out["episode_index"], torch.tensor(0)) and out["nested"] == {"part": 0}
        assert (out["words"], out["flag"], out["number"], out["ratio"]) == (["", b""], False, 0, 0.0)
        assert out["row"] == (0, 0.0) and out["key"] == "" and type(out["flag"]) is bool and type(out["ratio"]) is float
        assert out["dhtorch.tokens"].shape == (6, 10) and dataset.transform.report()["unreadable"] == 1


@SAYS_NOTHING
def test_the_first_sixteen_items_are_tried_and_neighbours_within_fifteen_places():
    for lost, found in ((15, True), (16, False)):
        items = Items(40, corrupt=set(range(20 + lost)))
        dataset = ExtendedDataset(items, tiny(on_error="flag", other_image=None))
        if found:
            assert dataset[20]["dhtorch.problem"] == SampleProblem.UNREADABLE
        else:
            with pytest.raises(SampleError, match="neither item 20 nor its neighbours can be loaded: item 20 is cut"):
                dataset[20]


def test_the_view_before_a_corrupt_item_is_lost_with_it():
    dataset, _ = looking_back(2, Items(corrupt={1}), on_error="skip")
    with pytest.warns(UserWarning, match="^skipped: item 3 cannot be loaded: item 1 is cut short"):
        assert dataset[3] is None
    assert dataset[2] is not None and dataset.transform.report()["unreadable"] == 1
    with pytest.raises(OSError, match="item 1 is cut short"):
        looking_back(2, Items(corrupt={1}))[0][1]
    for error in (MemoryError, torch.OutOfMemoryError):
        with pytest.raises(error):
            looking_back(2, Items(corrupt={1}, error=error), on_error="flag")[0][1]


def test_a_gap_needs_a_place_for_the_other_view():
    for gap, options in ((0, {}), (-1, {}), (2, {"other_image": None})):
        with pytest.raises(
            ValueError, match=f"gap is {gap}: expected a positive one, and a transform with other_image"
        ):
            looking_back(gap, **options)
    assert looking_back(1)[0].gap == 1
    with pytest.raises(ValueError, match="found a transform for batches, expected one for single samples"):
        looking_back(2, batched=True)


# ---------------------------------------------------------------------------------------------------- streams


def test_a_stream_leaves_out_what_is_skipped():
    given = [sample(k) for k in range(4)]
    given[1]["depth"] = "x"
    with pytest.warns(UserWarning, match="^skipped: depth"):
        assert [x["index"] for x in ExtendedStream(given, tiny(on_error="skip"))] == [0, 2, 3]
    assert all("dhtorch.depth" in x for x in ExtendedStream(given[2:], tiny()))


# ---------------------------------------------------------------------------------------------------- other loaders


def test_openpi_is_given_arrays_for_what_is_added_alone():
    given = sample(state=torch.zeros(3), name="x")
    out, plain = NumpyTransform(tiny())(given), tiny()(given)
    assert out.keys() == plain.keys() and out["state"] is given["state"] and out["name"] == "x"
    for key, value in added(plain).items():
        mine = out[f"dhtorch.{key}"]
        assert isinstance(mine, np.ndarray) and np.array_equal(mine, value.numpy()), key
    with pytest.warns(UserWarning), pytest.raises(SampleError, match="cannot be skipped here: use on_error='flag'"):
        NumpyTransform(tiny(on_error="skip"))({**given, "depth": "x"})


def test_openvla_keeps_its_own_keys_and_ours():
    given = sample()
    hook = RldsBatchTransform(lambda frame: {"pixels": frame["image"], "dhtorchy": 1}, tiny(prefix="far."))
    out = hook(given)
    assert out["pixels"] is given["image"] and out["dhtorchy"] == 1 and not given.keys() & out.keys()
    assert added(out, "far.").keys() == added(tiny()(given)).keys()
    with pytest.warns(UserWarning), pytest.raises(SampleError, match="cannot be skipped here"):
        RldsBatchTransform(dict, tiny(on_error="skip"))({**given, "depth": "x"})


def test_the_added_collator_stacks_our_keys_alone():
    rows = [{"a": k, "dhtorch.x": torch.tensor([k, k]), "far.x": torch.tensor(k)} for k in range(3)]
    own = lambda given: {"sum": sum(one["a"] for one in given)}  # noqa: E731
    out = AddedCollate(own)(rows)
    assert out.keys() == {"sum", "dhtorch.x"} and out["sum"] == 3
    assert torch.equal(out["dhtorch.x"], torch.tensor([[0, 0], [1, 1], [2, 2]]))
    assert AddedCollate(own, prefix="far.")(rows)["far.x"].tolist() == [0, 1, 2]


def test_the_collator_counts_what_was_skipped():
    rows = [{"x": torch.tensor(k)} for k in range(3)]
    out = collate_kept([rows[0], None, rows[2], None])
    assert out["x"].tolist() == [0, 2] and out["dhtorch.skipped"] == 2
    assert collate_kept(rows)["dhtorch.skipped"] == 0
    assert collate_kept([None, None]) == {"dhtorch.skipped": torch.tensor(2)}


@SAYS_NOTHING
def test_a_data_sets_own_collator_counts_them_where_it_skips():
    for on_error, others in (("skip", {"dhtorch.skipped"}), ("flag", set())):
        data, _ = looking_back(items=Items(corrupt={5}), on_error=on_error)
        out = data.collate([data[i] for i in (4, 5, 6)])
        assert out.keys() == data[4].keys() | others
        assert out["index"].tolist() == ([4, 6] if others else [4, 0, 6])
        assert torch.equal(out["dhtorch.depth"][-1], data[6]["dhtorch.depth"])
    assert out["dhtorch.problem"].tolist()[1] == SampleProblem.UNREADABLE


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


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_worker_forked_beside_opencvs_threads_does_not_wait_for_them():
    said = subprocess.run([sys.executable, "-c", FORKED], capture_output=True, text=True, check=True, timeout=60)
    assert said.stdout.strip() == "1"


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_worker_answers_without_a_graph():
    """Weights of the method, and the sample's own, ask for gradients; what comes from a worker has none."""

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
    assert K[0] == batch["intrinsics"][0, 0]
