"""What leaves a worker in one piece of shared memory: which tensors, where they lie in it, and what does not."""

from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset, default_collate

from dhtorch.transforms import AddedCollate, collate_kept
from dhtorch.transforms.collate import collate_shared, pack_shared

PREFIX = "ours."
SHAPES = {"depth": (3,), "tokens": (5, 2), "flag": (7,), "one": (), "none": (0, 2)}
TYPES = {"depth": torch.float64, "tokens": torch.float32, "flag": torch.bool, "one": torch.int32, "none": torch.int64}

pytestmark = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")


class Items(Dataset):
    """Tensors of all shapes and types under our prefix, and others."""

    def __init__(self, missing=()):
        self.missing = missing

    def __len__(self):
        return 6

    def __getitem__(self, i):
        made = torch.Generator().manual_seed(i)
        mine = {key: torch.rand(shape, generator=made).mul(9).to(TYPES[key]) for key, shape in SHAPES.items()}
        mine |= {
            "turned": mine["tokens"].T,
            "text": f"item {i}",
            "array": np.full(2, i / 2),
        }
        item = {"picture": torch.full((4, 4), i), **{PREFIX + key: x for key, x in mine.items()}, "theirs": i}
        return None if i in self.missing else item


def batches(collate, workers, **items):
    options = {"multiprocessing_context": "fork", "timeout": 60} if workers else {}
    return list(DataLoader(Items(**items), 3, collate_fn=collate, num_workers=workers, **options))


def pieces(batch):
    return {key: x.untyped_storage().data_ptr() for key, x in batch.items() if torch.is_tensor(x) and x.numel()}


def whole(samples):
    return pack_shared(default_collate(samples), PREFIX)


@pytest.mark.parametrize(
    "collate", [partial(collate_shared, prefix=PREFIX), whole, partial(collate_kept, prefix=PREFIX)]
)
def test_from_a_worker_our_tensors_come_in_one_piece(collate):
    expected = batches(None, 0)
    for found, batch in zip(batches(collate, 1), expected, strict=True):
        assert found.keys() - {"dhtorch.skipped"} == batch.keys() and found[PREFIX + "text"] == batch[PREFIX + "text"]
        for key, x in batch.items():
            if torch.is_tensor(x):
                assert found[key].dtype == x.dtype and torch.equal(found[key], x), key
        shared = [key for key in (*SHAPES, "turned") if key != "none"]
        lie = pieces(found)
        assert len({lie[PREFIX + key] for key in shared}) == 1
        assert len({lie[key] for key in (PREFIX + "depth", "picture", "theirs")}) == 3
        bounds = sorted((found[PREFIX + key].data_ptr(), found[PREFIX + key].nbytes) for key in shared)
        assert all(begin + size <= after for (begin, size), (after, _) in pairwise(bounds)), "one lies over another"
        assert all((begin - bounds[0][0]) % 64 == 0 for begin, _ in bounds)
        assert bounds[-1][0] + bounds[-1][1] - bounds[0][0] <= found[PREFIX + "depth"].untyped_storage().nbytes()


@pytest.mark.parametrize("collate", [partial(collate_shared, prefix=PREFIX), whole])
def test_where_nothing_leaves_the_process_nothing_is_shared(collate):
    for batch in batches(collate, 0):
        assert len(set(pieces(batch).values())) == len(pieces(batch))
        assert not any(x.is_shared() for x in batch.values() if torch.is_tensor(x))


def test_a_batch_without_ours_is_torchs():
    for found, expected in zip(batches(partial(collate_shared, prefix="nobody"), 1), batches(None, 1), strict=True):
        assert found.keys() == expected.keys() and len(set(pieces(found).values())) == len(pieces(found))


def test_skipped_items_leave_their_batch():
    first, second = batches(partial(collate_kept, prefix=PREFIX), 1, missing=(1, 3, 4, 5))
    assert first["theirs"].tolist() == [0, 2] and first["dhtorch.skipped"] == 1
    assert len(first[PREFIX + "depth"]) == 2 and second == {"dhtorch.skipped": 3}


def test_another_collator_keeps_its_keys_beside_ours():
    own = AddedCollate(lambda samples: {"picture": torch.stack([s["picture"] for s in samples])}, PREFIX)
    for found, expected in zip(batches(own, 1), batches(None, 0), strict=True):
        assert found.keys() == expected.keys() - {"theirs"}
        assert torch.equal(found["picture"], expected["picture"])
        lie = pieces(found)
        assert torch.equal(found[PREFIX + "tokens"], expected[PREFIX + "tokens"])
        assert lie[PREFIX + "depth"] == lie[PREFIX + "tokens"] != lie["picture"]


def test_shapes_that_differ_are_told(monkeypatch):
    monkeypatch.setattr(Items, "__getitem__", lambda self, i: {PREFIX + "depth": torch.zeros(2 + i)})
    with pytest.raises(RuntimeError, match=r"equal size, but got \[2\] at entry 0 and \[3\] at entry 1"):
        batches(partial(collate_shared, prefix=PREFIX), 1)
