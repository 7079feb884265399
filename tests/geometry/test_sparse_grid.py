"""Cells as numbers, against plain loops over whole numbers of Python."""

import itertools
import math

import numpy as np
import pytest
import scipy.ndimage as ndi
import torch

from dhtorch.geometry import sparse_grid

REACH = 2**20


def number(ijk):
    """Of one cell, in whole numbers of any size."""
    shifted = [int(x) + REACH for x in ijk]
    return (shifted[0] * 2**21 + shifted[1]) * 2**21 + shifted[2] if all(0 <= x < 2**21 for x in shifted) else -1


def touch(a, b):
    return max(abs(x - y) for x, y in zip(a, b, strict=True)) <= 1


def some_cells(n, reach, seed):
    """Distinct cells in the order of their numbers, and those numbers."""
    ijk = sorted({tuple(x) for x in np.random.default_rng(seed).integers(-reach, reach, (n, 3)).tolist()})
    return ijk, torch.tensor([number(x) for x in ijk])


def test_numbers_are_written_with_21_bits_for_each_axis_and_sort_as_places_do():
    edge = (-REACH - 1, -REACH, -1, 0, 5, REACH - 1, REACH)
    ijk = list(itertools.product(edge, edge, edge))
    key = sparse_grid.pack_cells(torch.tensor(ijk))
    assert key.tolist() == [number(x) for x in ijk] and sparse_grid.OUT_OF_RANGE == -1
    inside = [x for x, k in zip(ijk, key.tolist(), strict=True) if k >= 0]
    assert len(inside) == 5**3 and inside == sorted(inside)
    assert sparse_grid.unpack_cells(key[key >= 0]).tolist() == [list(x) for x in inside]
    assert (key[key >= 0].diff() > 0).all()


def test_numbers_are_found_where_they_stand():
    keys = torch.tensor([-1, 3, 4, 9, 100])
    wanted = torch.tensor([[100, 4, 5], [-1, 101, -7]])
    at, found = sparse_grid.find_cells(keys, wanted)
    assert at.tolist() == [[4, 2, 0], [0, 0, 0]]
    assert found.tolist() == [[True, True, False], [True, False, False]]
    at, found = sparse_grid.find_cells(keys[:0], wanted)
    assert at.tolist() == [[0] * 3] * 2 and not found.any() and found.shape == (2, 3)


@pytest.mark.parametrize("side", [0.5, 0.1, 3.0])
def test_points_fall_into_the_cells_that_division_says(side):
    draw = np.random.default_rng(0)
    xyz = np.concatenate([draw.uniform(-2, 2, (40, 3)), draw.integers(-4, 5, (40, 3)) * side]).astype(np.float32)
    xyz[0], xyz[1] = (0.7, -0.7, 0.0), (1.0, -0.5, -1.0)  # 0.7f is less than 7 steps of 0.1, on the border of a cell
    want = sorted({number(math.floor(float(x) / side) for x in p) for p in xyz})
    found = sparse_grid.occupied_cells(torch.from_numpy(xyz).view(2, 40, 3), side)
    assert found.tolist() == want and found.dtype == torch.int64


def test_points_out_of_reach_are_nowhere():
    far = REACH * 0.25
    inside = [[far - 0.25, 0.0, 0.0], [0.0, 0.25 - far, 0.0]]
    outside = [[far, 0.0, 0.0], [0.0, 0.0, far], [0.0, 2 * far, 0.0], [0.0, -2 * far, 0.0]]
    hopeless = [[math.nan, 0.0, 0.0], [0.0, math.inf, 0.0], [0.0, 0.0, -math.inf]]
    found = sparse_grid.occupied_cells(torch.tensor(inside + outside + hopeless, dtype=torch.float64), 0.25)
    assert found.tolist() == sorted([number((REACH - 1, 0, 0)), number((0, 1 - REACH, 0))])
    for side in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="expected a positive length"):
            sparse_grid.occupied_cells(torch.zeros(1, 3), side)


def test_near_cells_are_those_that_touch():
    ijk, keys = some_cells(60, 5, seed=1)
    others, other_keys = some_cells(25, 5, seed=2)
    want = [any(touch(a, b) for b in others) for a in ijk]
    assert sparse_grid.touches_cells(keys, other_keys).tolist() == want and 0.3 < np.mean(want) < 0.8
    for step in itertools.product((-2, -1, 0, 1, 2), repeat=3):
        near = sparse_grid.touches_cells(torch.tensor([number((0, 0, 0))]), torch.tensor([number(step)]))
        assert near.tolist() == [touch((0, 0, 0), step)]


def chain():
    """A long chain of cells, and one between its first and its last."""
    turns = np.cumsum(np.eye(3, dtype=int)[np.random.default_rng(3).integers(0, 3, 70)] * [1, 1, -1], axis=0).tolist()
    return [*turns, np.add(np.min(turns, 0), (0, 0, 5)).tolist()]


STEPS = list(itertools.product((-1, 0, 1), repeat=3))


@pytest.mark.parametrize(
    "ijk",
    [
        *(some_cells(n, reach, seed=n)[0] for n, reach in ((60, 4), (120, 6), (40, 7))),
        [
            (10 * k + s * i, s * j, s * h) for k, (i, j, h) in enumerate(STEPS) for s in (0, 1)
        ],  # all kinds of neighbours
        chain(),
        [],
    ],
)
def test_components_are_those_of_a_labelled_grid(ijk):
    """Labels count up in the order of the first cells."""
    ijk = np.array(sorted({tuple(x) for x in ijk}), dtype=int).reshape(-1, 3)
    dense = np.zeros((300, 160, 160), dtype=int)
    place = tuple((ijk - ijk.min(0, initial=0)).T)
    dense[place] = 1
    label = ndi.label(dense, np.ones((3, 3, 3)))[0][place]
    _, first, want = np.unique(label, return_index=True, return_inverse=True)
    found = sparse_grid.connected_components(torch.tensor([number(x) for x in ijk.tolist()], dtype=torch.int64))
    assert found.tolist() == np.argsort(np.argsort(first))[want].tolist()
