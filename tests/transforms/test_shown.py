"""What objects print, names of codes, and a gap that was forgotten."""

import numpy as np
import pytest
import torch

import dhtorch
from dhtorch import ExtendDepth, codes
from dhtorch.transforms import ExtendedDataset
from dhtorch.transforms.sample_access import SampleError

KEYS = {"image": "image", "other_image": "before", "depth": "depth", "intrinsics": "K", "depth_unit": "mm"}


def items(n=3):
    one = {
        "image": torch.rand(3, 48, 64),
        "depth": torch.full((1, 48, 64), 1500, dtype=torch.int32),
        "K": torch.tensor([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]),
        "episode_index": torch.tensor(0),
    }
    return [one] * n


def test_integer_codes_have_names():
    assert codes.name("gate", 0) == "ANSWER" and codes.name("dhtorch.hole", torch.tensor([0])) == ["NONE"]
    low = codes.Gate.LOW_PARALLAX if hasattr(codes.Gate, "LOW_PARALLAX") else max(codes.names(codes.Gate))
    grid = np.array([[0, low], [low, 0]])
    assert codes.name("observation.dh_gate_map", grid)[0] == ["ANSWER", codes.names(codes.Gate)[low]]
    assert codes.name("flag", 5) == "NO_DEPTH|SPECULAR" and codes.name("flag", 0) == ""
    assert codes.name("problem", torch.tensor(2)) == "NO_DEPTH" and codes.name(codes.Source, 1) == "SENSOR"
    with pytest.raises(ValueError, match="found the column 'depth', expected one of flag, hole"):
        codes.name("depth", 0)
    with pytest.raises(ValueError, match="Gate: found the code 99"):
        codes.name("gate", 99)


def test_objects_say_what_they_hold():
    assert repr(dhtorch.MAP).startswith("Method(n=2048, views=1, sample=spiral, ") and "fuse=" not in repr(dhtorch.MAP)
    assert "fuse=fuse_consistent" in repr(dhtorch.AUTO)
    transform = ExtendDepth(**KEYS, n=64)
    assert "n=64" in repr(transform) and repr(transform).endswith("reads image, depth, K, before; adds dhtorch.*)")
    data = ExtendedDataset(items(), transform, gap=1)
    assert repr(data).startswith("ExtendedDataset(3 items of list, the source view 1 items before, ExtendDepth(Method(")


def test_a_forgotten_gap_is_named():
    with pytest.raises(SampleError, match="before: found no such key and no gap, expected gap=N"):
        ExtendedDataset(items(), ExtendDepth(**KEYS, n=64))[0]
    with_both = [{**item, "before": item["image"]} for item in items()]
    assert "dhtorch.depth" in ExtendedDataset(with_both, ExtendDepth(**KEYS, n=64))[0]
