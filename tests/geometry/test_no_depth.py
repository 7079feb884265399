"""Values that stand for no return: codes, saturated metres, far constants."""

import numpy as np
import pytest
import torch

from dhtorch.data.io.decode import to_metres
from dhtorch.geometry.no_depth import clear_far_constant, clear_no_depth
from dhtorch.transforms import SampleSpec


def scene(h=60, w=80, seed=0):
    """A tilted floor from 1 m to 4 m with noise."""
    rows = torch.linspace(4, 1, h)[:, None].expand(h, w)
    return rows + 0.01 * torch.rand(h, w, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("dtype", [np.uint16, np.int32, np.int64])
@pytest.mark.parametrize("unit", ["mm", 0.001, 0.0002])
def test_the_largest_16_bit_code_is_no_return_in_every_type_and_unit(dtype, unit):
    code = (1000 * scene()).numpy().astype(dtype)
    code[:20, ::3] = 65535
    code[0, 1] = 65534
    sample = {"image": np.zeros((60, 80, 3), np.uint8), "depth": code, "intrinsics": [80.0, 80.0, 39.5, 29.5]}
    metres = 0.001 if unit == "mm" else unit
    depth = SampleSpec(depth_unit=unit).read(sample).reference.depth[0]
    assert torch.equal(depth == 0, torch.from_numpy(code == 65535))
    assert torch.allclose(depth, torch.from_numpy(np.where(code == 65535, 0, code) * metres).float())
    read = to_metres(code, 1 / metres)
    assert np.array_equal(read == 0, code == 65535) and np.allclose(read, depth.numpy())
    assert read[0, 1] == pytest.approx(65534 * metres)


def test_the_code_is_no_return_unless_the_capture_states_others():
    code = np.array([[0, 65535, 500]], np.uint16)
    assert to_metres(code, 1000.0, invalid=(0, 500)).tolist() == [[0.0, pytest.approx(65.535), 0.0]]


@pytest.mark.parametrize("unit", ["m", "mm", 0.01])
def test_saturated_floats_are_no_return(unit):
    per_metre = {"m": 1.0, "mm": 1000.0}.get(unit, 100.0)
    depth = scene()
    for k, value in enumerate([torch.nan, torch.inf, -torch.inf, -2.0, 65.535, 65504.0, 65535.0]):
        depth[k, ::7] = value
    stored = depth * per_metre
    stored[10, 5] = 65535.0  # as a code
    sample = {"image": torch.zeros(3, 60, 80), "depth": stored, "intrinsics": [80.0, 80.0, 39.5, 29.5]}
    read = SampleSpec(depth_unit=unit).read(sample).reference.depth[0]
    hole = read == 0
    assert bool(hole[:7, ::7].all()) and bool(hole[10, 5]) and int(hole.sum()) == 7 * len(depth[0, ::7]) + 1
    cleared = clear_no_depth(depth)
    assert torch.equal(cleared == 0, hole.index_put((torch.tensor(10), torch.tensor(5)), torch.tensor(False)))


@pytest.mark.parametrize("far", [10.0, 20.0, 100.0, 1000.0, 65.535, 99.87, 1e10])
def test_the_far_plane_of_a_simulator_is_no_return(far):
    depth = scene()
    depth[:15] = far
    cleared = clear_no_depth(depth)
    assert torch.equal(cleared[:15], torch.zeros(15, 80)) and torch.equal(cleared[15:], depth[15:])


def test_a_limit_in_tens_of_metres_is_no_return_although_depth_reaches_it():
    depth = 3 * scene()
    depth = torch.where(depth > 10, 10.0, depth)
    assert torch.equal(clear_far_constant(depth) == 0, depth == 10)


@pytest.mark.parametrize(
    "depth",
    [
        torch.full((60, 80), 100.0),  # nothing nearer: a wrong unit, a wall
        torch.where(scene() > 3, 3.0, scene()),  # cut at 3 m: a fault that validation names
        torch.where(torch.arange(80) > 60, 0.8, 0.3).expand(60, 80),  # a table from above, a gripper before it
        torch.where(3.1 * scene() > 11.3, 11.3, 3.1 * scene()),  # a wall that floor and ceiling reach
        40 * scene(),  # outdoors
    ],
    ids=["constant", "cut", "table", "wall", "outdoors"],
)
def test_surfaces_are_no_far_constant(depth):
    assert torch.equal(clear_no_depth(depth), depth)


def test_a_few_pixels_at_the_largest_depth_are_kept():
    depth = scene()
    depth.view(-1)[: depth.numel() // 200] = 20.0
    assert torch.equal(clear_far_constant(depth), depth)
