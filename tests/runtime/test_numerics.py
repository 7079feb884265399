"""Results do not depend on torch's default dtype, default device or autocast, and these are left as they were."""

import contextlib

import pytest
import torch

import dhtorch
from dhtorch import functional
from dhtorch.synthetic import SyntheticRoom


@contextlib.contextmanager
def default_dtype(dtype):
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@contextlib.contextmanager
def default_device(name):
    torch.set_default_device(name)
    try:
        yield
    finally:
        torch.set_default_device(None)


STATES = {
    "float64": lambda: default_dtype(torch.float64),
    "bfloat16": lambda: default_dtype(torch.bfloat16),
    "autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    "meta": lambda: default_device("meta"),
}


def state():
    return torch.get_default_dtype(), str(torch.get_default_device()), torch.is_autocast_enabled("cpu")


def answers(a, b):
    """Depth, sigma and gates of the public computations."""
    few = {"n": 128, "seed": 0}
    estimates = [dhtorch.PAPER(a, b, **few), dhtorch.AUTO(a, [b], **few)]
    maps = dhtorch.complete_depth(a, [b], method=dhtorch.FUSED.replace(n=128), size=64)
    validation = dhtorch.validate_depth(None, a, b, size=48)
    aligned = dhtorch.align_depth(maps.depth * 3, estimates[0], hw=a.hw, kind="scale")
    image = functional.geometry_image(maps.depth, maps.sigma, maps.source)
    return [
        *(x for e in estimates for x in (e.depth, e.sigma, e.gate)),
        *(maps.depth, maps.sigma, validation.state, aligned.depth, image),
    ]


@pytest.fixture(scope="module")
def frames():
    room = SyntheticRoom(n_frames=3, hw=(90, 120))
    return room[0], room[2]


@pytest.fixture(scope="module")
def expected(frames):
    return answers(*frames)


@pytest.mark.parametrize("name", STATES)
def test_results_do_not_depend_on_the_defaults_of_torch(frames, expected, name):
    with STATES[name]():
        before = state()
        found = answers(*frames)
        assert state() == before
    for ours, standard in zip(found, expected, strict=True):
        assert ours.dtype == standard.dtype and ours.device == standard.device
        assert torch.equal(ours.nan_to_num(-1), standard.nan_to_num(-1))
