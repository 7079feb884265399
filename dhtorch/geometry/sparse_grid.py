"""Cells of a regular grid, of which only some are there: as sorted numbers instead of a table of space.

Alphabet: ``ijk`` (…, 3) int64, a cell's place in steps of the grid; ``key`` its number, 21 bits for each axis, so that
numbers sort as places do. A list of numbers in rising order is looked up by bisection: no table, no collision, and the
same order whichever order the points came in.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.geometry.checks import check

CELL_BITS = 21
#: Places from -REACH to REACH - 1 have a number.
CELL_RANGE = 1 << (CELL_BITS - 1)
#: Number of a place that is out of reach.
OUT_OF_RANGE = -1


def pack_cells(ijk: Tensor) -> Tensor:
    """Numbers (…,) of cells (…, 3) int64; NOWHERE for a place out of reach. Gradient: none."""
    check("pack_cells", ijk=(ijk, "* 3"))
    shifted = ijk + CELL_RANGE
    inside = ((shifted >= 0) & (shifted < 2 * CELL_RANGE)).all(-1)
    x, y, z = shifted.unbind(-1)
    return torch.where(inside, (x << 2 * CELL_BITS) + (y << CELL_BITS) + z, OUT_OF_RANGE)


def unpack_cells(key: Tensor) -> Tensor:
    """Cells (…, 3) int64 of numbers (…,), the inverse of :func:`pack_cells`. Gradient: none."""
    mask = 2 * CELL_RANGE - 1
    return torch.stack((key >> 2 * CELL_BITS, (key >> CELL_BITS) & mask, key & mask), -1) - CELL_RANGE


def find_cells(
    keys: Tensor,  # (K,) int64, rising
    wanted: Tensor,  # (…,) int64
) -> tuple[Tensor, Tensor]:
    """Where numbers stand in a list: positions (…,), 0 where they are not in it, and whether they are.

    Raises:
        ValueError: wrong shapes.
    """
    K = check("find_cells", keys=(keys, "K"))["K"]
    if not K:
        return torch.zeros_like(wanted), torch.zeros_like(wanted, dtype=torch.bool)
    at = torch.searchsorted(keys, wanted).clamp_max(K - 1)
    found = keys[at] == wanted
    return torch.where(found, at, 0), found


def occupied_cells(
    xyz: Tensor,  # (…, 3) m
    side: float,
) -> Tensor:
    """Numbers (V,), rising, of the cells of ``side`` metres that points fall into; non-finite points are nowhere.

    Raises:
        ValueError: wrong shapes, or a side that is not positive.
    """
    check("occupied_cells", xyz=(xyz, "* 3"))
    if not side > 0:
        raise ValueError(f"occupied_cells: side is {side}, expected a positive length")
    scaled = xyz.reshape(-1, 3).double() / side
    there = (scaled.abs() < CELL_RANGE).all(-1)  # false for NaN
    return pack_cells(scaled[there].floor().long()).unique()


def touches_cells(
    keys: Tensor,  # (K,) int64, rising
    others: Tensor,  # (V,) int64, rising
) -> Tensor:
    """Whether (K,) bool each cell is one of the others, or touches one, be it by a corner.

    Raises:
        ValueError: wrong shapes.
    """
    check("touches_cells", keys=(keys, "K"), others=(others, "V"))
    around = pack_cells(unpack_cells(keys)[:, None] + _steps(keys))
    return find_cells(others, around)[1].any(-1)


def connected_components(keys: Tensor) -> Tensor:
    """Which cells (K,), numbers in rising order, hang together by faces, edges or corners: labels (K,) int64 from 0.

    Two cells have the same label when a chain of touching cells joins them; labels rise with their first cell.

    Raises:
        ValueError: wrong shapes.

    Cost: the logarithm of the longest chain, times 13 look-ups of all cells.
    """
    check("connected_components", keys=(keys, "K"))
    at, found = find_cells(
        keys, pack_cells(unpack_cells(keys)[:, None] + _steps(keys)[14:])
    )  # each pair of neighbours once
    a, b = torch.arange(len(keys), device=keys.device)[:, None].expand_as(at)[found], at[found]
    label = torch.arange(len(keys), device=keys.device)
    while True:
        one, other = label[a], label[b]
        new = label.scatter_reduce(0, torch.maximum(one, other), torch.minimum(one, other), "amin")
        while bool((new[new] != new).any()):
            new = new[new]
        if torch.equal(new, label):
            return label.unique(return_inverse=True)[1]
        label = new


def _steps(like: Tensor) -> Tensor:
    """The 27 steps (27, 3) to a cell itself (at 13) and its neighbours, opposite ones mirrored about the middle."""
    return torch.cartesian_prod(*(torch.arange(-1, 2, device=like.device),) * 3)
