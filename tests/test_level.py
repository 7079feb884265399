"""Which way is up: the floor that is believed lies as near to the guess as is promised."""

import os
from pathlib import Path

import pytest
import torch

from dhtorch import MAP, data
from dhtorch.integrate.level import WITHIN, floor

GUESSES = torch.nn.functional.normalize(torch.randn(12, 3, dtype=torch.float64, generator=torch.manual_seed(0)), dim=-1)


def level_floor():
    """A floor with a wall behind it, m; up is -y."""
    u, v = torch.rand(2, 4000, dtype=torch.float64, generator=torch.manual_seed(1)) * 4
    return torch.cat((torch.stack((u, 1 + 0 * u, v), -1), torch.stack((u, 1 - v / 4, 4 + 0 * u), -1)[:1000]))


def test_a_floor_is_found():
    up = torch.tensor([0.1, -1.0, 0.1], dtype=torch.float64)
    found = floor(level_floor(), up / up.norm(), 0.02)
    tilt = (found - torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)).abs().max()
    assert tilt < 0.02 / 4, "the wall's foot lies in the slab of 2 cm that is fitted, 4 m wide"
    assert floor(level_floor()[:50], up / up.norm(), 0.02) is None, "of few points none is believed"


@pytest.mark.skipif("DHTORCH_DATA" not in os.environ, reason="DHTORCH_DATA is unset")
def test_a_door_is_no_floor_far_from_the_guess():
    frame = data.open(Path(os.environ["DHTORCH_DATA"]) / "r3d_door")[0]
    h, w = frame.hw
    uv = torch.stack(torch.meshgrid(torch.arange(0, w, 24.0), torch.arange(0, h, 24.0), indexing="xy"), -1)
    xyz = MAP.backproject(frame, uv.reshape(-1, 2)).xyz[0].double()
    found = [floor(xyz, guess, 0.05) for guess in GUESSES]
    assert any(axis is None for axis in found)
    assert all(float(axis @ guess) > WITHIN for axis, guess in zip(found, GUESSES, strict=True) if axis is not None)
