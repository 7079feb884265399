"""Whether the near returns show that a map which is read as depth is none."""

import pytest
import torch

from dhtorch.alignment.align import align_depth
from dhtorch.alignment.map_family import MAP_FAMILIES, find_map_family, least_absolute_line
from dhtorch.alignment.options import DEFAULT_ALIGNMENT_OPTIONS
from dhtorch.alignment.references import MetricReferences
from dhtorch.codes import Gate
from dhtorch.records import Samples
from dhtorch.synthetic import depth_faults
from dhtorch.synthetic.recording import SyntheticRoom

DEPTH, DISPARITY, Z_BUFFER = range(3)


def z_buffer(near, far):
    return lambda z: far / (far - near) * (1 - near / z)


@pytest.fixture
def depth():
    return 1 + 1.5 * torch.rand(1, 400, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def family(x, depth, near=None, noise=0.0, seed=0):
    """Family of a map with these values (1, N) at references of this depth, which have relative noise."""
    g = torch.Generator().manual_seed(seed)
    share = torch.rand(*x.shape, 2, generator=g, dtype=torch.float64)
    one, every = torch.ones_like(x), torch.ones_like(x, dtype=torch.bool)
    measured = depth * (1 + noise * torch.randn(x.shape, generator=g, dtype=torch.float64))
    near = every if near is None else near
    return find_map_family(MetricReferences(share, x, 0 * one, measured, 1e-4 * one, 0 * one, near, every)).tolist()


@pytest.mark.parametrize("noise", [0.0, 0.005, 0.01])
@pytest.mark.parametrize("planes", [(0.01, 50.0), (0.1, 100.0), (0.5, 5.0)])
def test_a_z_buffer_is_found_whatever_its_planes(depth, planes, noise):
    assert family(z_buffer(*planes)(depth), depth, noise=noise) == [Z_BUFFER]


@pytest.mark.parametrize("noise", [0.0, 0.005, 0.01])
@pytest.mark.parametrize("line", [(1.0, 0.0), (300.0, 20.0), (0.2, 0.5)])
def test_disparity_up_to_scale_and_shift_is_found(depth, line, noise):
    assert family(line[0] / depth + line[1], depth, noise=noise) == [DISPARITY]


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05])
@pytest.mark.parametrize(
    "change",
    [lambda z: z, lambda z: 0.2 * z, lambda z: 1.4 * z - 0.3, lambda z: z**1.5, lambda z: z**0.6, lambda z: z.log()],
)
def test_maps_that_rise_with_depth_are_of_depth(depth, change, noise):
    assert family(change(depth), depth, noise=noise) == [DEPTH]


def test_without_range_or_returns_nothing_is_found(depth):
    wall = 1.5 + 0.01 * depth
    assert family(1 / wall, wall, noise=0.005) == [DEPTH], "a line describes it to the returns' noise"
    assert family(1 / wall, wall) == [DEPTH], "a line describes it to 1e-5, far below the least error"
    few = torch.arange(depth.shape[1])[None] < 40
    assert family(1 / depth, depth, near=few) == [DEPTH] and family(1 / depth, depth) == [DISPARITY]


def test_a_line_of_least_absolute_error_passes_by_gross_outliers():
    x = torch.linspace(0, 1, 41, dtype=torch.float64)[None]
    y = 2 * x + 1
    y[:, 5::6] *= 0.5  # 6 of 41
    line, ok = least_absolute_line(x, y, torch.ones_like(x), DEFAULT_ALIGNMENT_OPTIONS)
    assert ok.all() and torch.allclose(line, torch.tensor([[2.0, 1.0]], dtype=torch.float64), atol=0.05)


def test_every_map_of_a_batch_has_a_family_of_its_own(depth):
    x = torch.cat((depth, 1 / depth, z_buffer(0.01, 50.0)(depth)))
    assert family(x, depth.expand(3, -1)) == [DEPTH, DISPARITY, Z_BUFFER]


@pytest.fixture(scope="module")
def room():
    """Depth of the built-in room, and near returns at random pixels with the noise of a sensor."""
    truth = SyntheticRoom(n_frames=2, hw=(96, 128), depth_hw=(96, 128), supersample=1).truth(0)["depth"].double()
    g = torch.Generator().manual_seed(0)
    uv = torch.rand(1, 500, 2, generator=g) * torch.tensor([127.0, 95.0])
    z = truth[0][uv[0, :, 1].round().long(), uv[0, :, 0].round().long()][None].float()
    z = z * (1 + 0.003 * torch.randn(z.shape, generator=g))
    zero, code = torch.zeros_like(z), torch.zeros_like(z, dtype=torch.int32)
    return truth, Samples(uv, z, 0.01 * z, torch.stack((z, z, z), -1), zero + 1, code, zero, code)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["metric", "scale", "affine"])
@pytest.mark.parametrize(("change", "name"), [(z_buffer(0.01, 50.0), "z-buffer"), (lambda z: 1 / z, "disparity")])
def test_a_map_that_is_no_depth_gets_no_answer_and_its_family_is_named(room, kind, change, name):
    truth, near = room
    trace = {}
    found = align_depth(change(truth), near, kind=kind, trace=trace)
    assert not found.keep.any() and (found.gate == Gate.NO_POSE).all() and found.depth.isnan().all()
    assert MAP_FAMILIES[int(trace["chosen"].family)] == name and trace["chosen"].model.tolist() == [-1]


def test_disparity_that_is_stated_is_aligned(room):
    truth, near = room
    trace = {}
    found = align_depth(40 / truth + 3, near, kind="inverse", trace=trace)
    assert found.keep.all() and float(((found.depth - truth) / truth).abs().median()) < 0.005
    assert trace["chosen"].family is None


#: Every third fault; the others run with the slow tests.
FAULTS = [
    pytest.param(name, marks=[pytest.mark.slow] * (k % 3 > 0))
    for k, name in enumerate(["none", *depth_faults.DEPTH_FAULTS])
]


@pytest.mark.parametrize("name", FAULTS)
def test_no_planted_fault_of_depth_is_taken_for_another_family(room, name):
    truth, near = room
    x = truth if name == "none" else depth_faults.apply_fault(name, truth)[0]
    trace = {}
    align_depth(x, near, trace=trace)
    assert trace["chosen"].family.tolist() == [DEPTH]
