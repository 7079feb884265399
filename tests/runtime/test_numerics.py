"""Results do not depend on torch's default dtype, default device or autocast, which are left as they were, nor on
strides."""

import contextlib

import pytest
import torch
from support.public_entries import VIEWS, differing_entries, public_results

from dhtorch.ops import loader


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


@pytest.fixture(scope="module")
def expected():
    return public_results()


@pytest.mark.parametrize("name", STATES)
def test_results_do_not_depend_on_the_defaults_of_torch(expected, name):
    with STATES[name]():
        before = state()
        found = public_results()
        assert state() == before
    assert differing_entries(found, expected) == []


def test_results_do_not_depend_on_strides(monkeypatch):
    """Of torch; compiled operators, which read contiguous tensors alone: tests/ops/test_compiled.py."""
    monkeypatch.setenv("DHTORCH_OPS", "0")
    monkeypatch.setattr(loader, "_loaded", [])
    contiguous = public_results()
    for layout in VIEWS:
        assert differing_entries(public_results(layout), contiguous) == [], layout
