"""Sparse regular grid: points -> sorted cell keys, with look-up, neighbours and connected components of cells.

Alphabet: ``ijk`` (…, 3) int64, a cell's position in steps of the grid; ``key`` its number, 21 bits for each axis, so
that keys sort as positions do. A sorted list of keys is searched by bisection: no dense table, no collision, and a
result that does not depend on the order of the points.
"""

import torch
from torch import Tensor

from dhtorch.geometry.checks import shaped

#: Bits of a key per axis. Source: derived, ⌊63 / 3⌋: three axes fit a non-negative int64.
CELL_BITS = 21

#: Positions from -CELL_RANGE to CELL_RANGE - 1 along an axis, in cells, have a key. Source: derived, 2^(CELL_BITS - 1).
CELL_RANGE = 1 << (CELL_BITS - 1)

#: Key of a position out of range. Source: derived, valid keys are non-negative.
OUT_OF_RANGE = -1


@shaped("ijk: * 3")
def pack_cells(ijk: Tensor) -> Tensor:
    """Cells (…, 3) int64 -> keys (…,); :data:`OUT_OF_RANGE` for positions out of range. Gradient: none."""
    shifted = ijk + CELL_RANGE
    inside = ((shifted >= 0) & (shifted < 2 * CELL_RANGE)).all(-1)
    x, y, z = shifted.unbind(-1)
    return torch.where(inside, (x << 2 * CELL_BITS) + (y << CELL_BITS) + z, OUT_OF_RANGE)


def unpack_cells(key: Tensor) -> Tensor:
    """Keys (…,) -> cells (…, 3) int64, the inverse of :func:`pack_cells`. Gradient: none."""
    mask = 2 * CELL_RANGE - 1
    return torch.stack((key >> 2 * CELL_BITS, (key >> CELL_BITS) & mask, key & mask), -1) - CELL_RANGE


@shaped("keys: K")
def find_cells(
    keys: Tensor,  # (K,) int64, rising
    wanted: Tensor,  # (…,) int64
) -> tuple[Tensor, Tensor]:
    """Sorted keys and wanted keys -> positions (…,) in the list, 0 for keys that are absent, and whether present.

    Raises:
        ValueError: wrong shapes.
    """
    if not len(keys):
        return torch.zeros_like(wanted), torch.zeros_like(wanted, dtype=torch.bool)
    position = torch.searchsorted(keys, wanted).clamp_max(len(keys) - 1)
    is_present = keys[position] == wanted
    return torch.where(is_present, position, 0), is_present


@shaped("xyz: * 3")
def occupied_cells(
    xyz: Tensor,  # (…, 3) m
    side: float,
) -> Tensor:
    """Points -> keys (V,), rising, of the cells of ``side`` metres that contain them; non-finite points are left out.

    Raises:
        ValueError: wrong shapes, or a side that is not positive.
    """
    if not side > 0:
        raise ValueError(f"occupied_cells: side is {side}, expected a positive length")
    scaled = xyz.reshape(-1, 3).double() / side
    in_range = (scaled.abs() < CELL_RANGE).all(-1)  # false for NaN
    return pack_cells(scaled[in_range].floor().long()).unique_consecutive().unique()


@shaped("keys: K, others: V")
def touches_cells(
    keys: Tensor,  # (K,) int64, rising
    others: Tensor,  # (V,) int64, rising
) -> Tensor:
    """Keys -> whether each cell, (K,) bool, is one of ``others`` or touches one by a face, edge or corner.

    Raises:
        ValueError: wrong shapes.
    """
    around = pack_cells(unpack_cells(keys)[:, None] + _neighbour_steps(keys))
    return find_cells(others, around)[1].any(-1)


@shaped("keys: K")
def connected_components(keys: Tensor) -> Tensor:
    """Sorted keys (K,) -> labels (K,) int64 from 0 of the components connected by faces, edges or corners.

    Two cells have the same label when a chain of touching cells connects them; labels rise with their first cell.

    Raises:
        ValueError: wrong shapes.

    Cost: the logarithm of the longest chain, times 13 look-ups of all cells.
    """
    position, is_present = find_cells(
        keys, pack_cells(unpack_cells(keys)[:, None] + _neighbour_steps(keys)[14:])
    )  # each pair of neighbours once
    a, b = torch.arange(len(keys), device=keys.device)[:, None].expand_as(position)[is_present], position[is_present]
    label = torch.arange(len(keys), device=keys.device)
    while True:
        label_a, label_b = label[a], label[b]
        merged = label.scatter_reduce(0, torch.maximum(label_a, label_b), torch.minimum(label_a, label_b), "amin")
        while bool((merged[merged] != merged).any()):
            merged = merged[merged]
        if torch.equal(merged, label):
            return label.unique(return_inverse=True)[1]
        label = merged


def _neighbour_steps(like: Tensor) -> Tensor:
    """Steps (27, 3) to a cell itself (index 13) and its neighbours; opposite steps mirror about the middle index."""
    return torch.cartesian_prod(*(torch.arange(-1, 2, device=like.device),) * 3)
