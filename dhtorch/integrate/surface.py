"""Where a volume's distance passes through zero: points with normals, or a mesh.

A crossing lies on an edge between two neighbouring voxels that are both known, one in front of the surface and one
behind it. Where something is unknown there is no surface; a jump from far in front to far behind within one step is the
rim of what a view could see, and no surface either.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.geometry import sparse_grid
from dhtorch.integrate.volume import BLOCK_SIDE, BLOCK_VOXELS, VOLUME_SOURCES, Volume
from dhtorch.pytree import Record, collate, record

#: Largest step of the distance across a surface, in truncations: a view's rim is a step of up to two.
_MAX_STEP_TRUNCATIONS = 1.5
#: Blocks along the side of a brick that is meshed at a time.
_BRICK_BLOCKS = 8
#: Points that are described at a time.
_POINTS_PER_CHUNK = 1 << 18
#: Fractions of a voxel below which a vertex of the mesh counts as lying on a voxel.
_SNAP_VOXELS = 1e-4


@record
class Surface(Record):
    """Points on the surface of a volume, and the triangles between them where it was meshed."""

    xyz: Tensor  # (P, 3) m in the world
    normal: Tensor  # (P, 3) unit, towards the open side; NaN where unknown
    features: Tensor  # (P, C) weighted means
    sigma: Tensor  # (P,) m, of the mean of all views, as if each erred for itself
    source: Tensor  # (P,) int32 codes.Source, the one with the largest weight
    face: Tensor | None = None  # (F, 3) int64, counter-clockwise seen from the open side


def extract_points(volume: Volume, *, min_weight: float = 0.0) -> Surface:
    """The crossings of all grid edges, as points; no mesh.

    Args:
        volume: from :func:`dhtorch.integrate.fuse_views`.
        min_weight: 1/m², least weight of the two voxels of a crossing.

    Raises:
        ValueError: a negative weight.

    Gradient: none.
    """
    _check_volume(min_weight)
    ahead = [_crossing_edges(volume, axis, min_weight) for axis in range(3)]
    a, b = (torch.cat([pair[k] for pair in ahead]) for k in (0, 1))
    order = sparse_grid.pack_cells(a + b).argsort()  # by place: the order does not depend on how the blocks came
    a, b = a[order], b[order]
    front, back = _distance(volume, a), _distance(volume, b)
    t = front / (front - back)
    return _describe(volume, a, b, t, (a + t[:, None] * (b - a)) * volume.voxel)


def extract_mesh(volume: Volume, *, min_weight: float = 0.0) -> Surface:
    """The surface as triangles, by marching cubes over all cells whose eight corners are known.

    Bricks of blocks are meshed one after the other; they share their borders, and vertices on the same grid edge become
    one, so that no seam is left.

    Args:
        volume: from :func:`dhtorch.integrate.fuse_views`.
        min_weight: 1/m², least weight of all corners of a cell.

    Raises:
        ImportError: scikit-image is missing; the extra ``mesh`` brings it.
        ValueError: a negative weight.

    Gradient: none.
    Source: T. Lewiner et al. 2003, as implemented by scikit-image.
    """
    _check_volume(min_weight)
    try:
        from skimage.measure import marching_cubes  # noqa: PLC0415
    except ImportError as error:
        raise ImportError(
            "extract_mesh: found no scikit-image, expected the extra: pip install 'dhtorch[mesh]'"
        ) from error
    vertices, faces, count = [], [], 0
    for origin, distance, known in _dense_bricks(volume, min_weight):
        cell = _meshable_cells(distance, known, _MAX_STEP_TRUNCATIONS * volume.truncation)
        if not bool(cell.any()):
            continue
        mask = torch.nn.functional.pad(cell, (1, 0) * 3)  # asked at a cell's far corner
        if not bool(((distance > 0) & mask).any() and ((distance <= 0) & known).any()):
            continue
        try:
            found = marching_cubes(distance.numpy(), 0.0, gradient_direction="descent", mask=mask.numpy())
        except (RuntimeError, ValueError):  # no crossing in this brick
            continue
        vertices.append(torch.from_numpy(found[0].copy()).double() + origin)
        faces.append(torch.from_numpy(found[1].astype("int64")) + count)
        count += len(found[0])
    if not count:
        none = torch.zeros(0, 3, dtype=torch.int64)
        return _describe(volume, none, none, volume.distance.new_zeros(0), none.double()).replace(face=none)
    return _weld_vertices(volume, torch.cat(vertices), torch.cat(faces))


def _weld_vertices(volume: Volume, vertices: Tensor, faces: Tensor) -> Surface:
    """One vertex for each grid edge, and no triangle that has lost its area."""
    device = volume.key.device
    rounded = vertices.round()
    on = (vertices - rounded).abs() < _SNAP_VOXELS
    a = torch.where(on, rounded, vertices.floor()).long()
    b = torch.where(on, rounded, vertices.ceil()).long()
    number, which = sparse_grid.pack_cells(a + b).unique(return_inverse=True)
    first = torch.full_like(number, len(a)).scatter_reduce(0, which, torch.arange(len(a)), "amin")
    faces = which[faces]
    whole = (faces != faces.roll(1, 1)).all(-1)
    a, b, at = a[first].to(device), b[first].to(device), vertices[first].to(device)
    part = ((at - a).sum(-1) / (b - a).sum(-1).clamp_min(1)).to(volume.distance.dtype)
    return _describe(volume, a, b, part, at * volume.voxel).replace(face=faces[whole].to(device))


def _describe(volume: Volume, a: Tensor, b: Tensor, t: Tensor, xyz: Tensor) -> Surface:
    """Points between voxels ``a`` and ``b`` (P, 3), with what the two know; some at a time, to bound the memory."""
    parts = zip(*(x.split(_POINTS_PER_CHUNK) for x in (a, b, t, xyz)), strict=True)
    return collate(_described(volume, *part) for part in parts)


def _described(volume: Volume, a: Tensor, b: Tensor, t: Tensor, xyz: Tensor) -> Surface:
    t = t.to(volume.distance.dtype)[:, None]
    index, known = _voxel_slots(volume, torch.stack((a, b)))
    share = torch.where(known[..., None], torch.stack((1 - t, t)), 0.0)
    weight = (volume.weight.flatten(0, 1)[index] * share).sum(0) / share.sum(0).clamp_min(1e-12)
    mixed = (volume.features.flatten(0, 1)[index].to(t.dtype) * share).sum(0)
    slope = (_distance_gradient(volume, torch.stack((a, b))) * share).sum(0)
    length = slope.norm(dim=-1, keepdim=True)
    codes = torch.tensor(VOLUME_SOURCES, dtype=torch.int32, device=weight.device)
    return Surface(
        xyz=xyz.to(t.dtype),
        normal=torch.where(length > 0, slope / length, torch.nan),
        features=mixed[:, 1:] / mixed[:, :1].clamp_min(1e-6),
        sigma=weight.sum(-1).rsqrt(),
        source=codes[weight.argmax(-1)],  # of equals the first
    )


def _distance_gradient(volume: Volume, ijk: Tensor) -> Tensor:
    """Differences (…, 3) of the distance along the axes, over two steps or, beside the unknown, over one."""
    here = _distance(volume, ijk)
    slopes = []
    for step in torch.eye(3, dtype=torch.int64, device=ijk.device):
        ahead, behind = (_distance(volume, ijk + sign * step) for sign in (1, -1))
        both = ahead.isfinite() & behind.isfinite()
        one = (ahead - here).nan_to_num(0.0) + (here - behind).nan_to_num(0.0)
        slopes.append(torch.where(both, (ahead - behind) / 2, one))
    return torch.stack(slopes, -1)


def _voxel_slots(volume: Volume, ijk: Tensor) -> tuple[Tensor, Tensor]:
    """Where voxels stand in the flattened blocks, and whether anything is known of them."""
    block = ijk.div(BLOCK_SIDE, rounding_mode="floor")
    x, y, z = (ijk - block * BLOCK_SIDE).unbind(-1)
    at, found = sparse_grid.find_cells(volume.key, sparse_grid.pack_cells(block))
    index = at * BLOCK_VOXELS + (x * BLOCK_SIDE + y) * BLOCK_SIDE + z
    if not len(volume.key):
        return index, found
    return index, found & (volume.weight.flatten(0, 1)[index] > 0).any(-1)


def _distance(volume: Volume, ijk: Tensor) -> Tensor:
    """Distances (…,) at voxels; NaN where nothing is known."""
    index, known = _voxel_slots(volume, ijk)
    return torch.where(known, volume.distance.flatten()[index], torch.nan) if len(volume.key) else known.float()


def _crossing_edges(volume: Volume, axis: int, min_weight: float) -> tuple[Tensor, Tensor]:
    """Voxels (P, 3) in front of the surface and their neighbours along ``axis`` behind it."""
    shape = (-1, BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE)
    distance = torch.where(_known(volume, min_weight), volume.distance, torch.nan).view(shape)
    dim = axis + 1
    step = torch.nn.functional.one_hot(torch.tensor(axis, device=volume.key.device), 3)
    at, found = sparse_grid.find_cells(volume.key, sparse_grid.pack_cells(sparse_grid.unpack_cells(volume.key) + step))
    beyond = distance.narrow(dim, 0, 1)[at] if len(at) else distance.narrow(dim, 0, 1)
    beyond = torch.where(found.view(-1, 1, 1, 1), beyond, torch.nan)
    ahead = torch.cat((distance.narrow(dim, 1, BLOCK_SIDE - 1), beyond), dim)
    crossing = ((distance > 0) != (ahead > 0)) & ((distance - ahead).abs() <= _MAX_STEP_TRUNCATIONS * volume.truncation)
    place = crossing.nonzero()
    low = sparse_grid.unpack_cells(volume.key[place[:, 0]]) * BLOCK_SIDE + place[:, 1:]
    front = (distance[crossing] > 0)[:, None]
    high = low + step
    return torch.where(front, low, high), torch.where(front, high, low)


def _known(volume: Volume, min_weight: float) -> Tensor:
    total = volume.weight.sum(-1)
    return (total > 0) & (total >= min_weight)


def _dense_bricks(volume: Volume, min_weight: float):
    """Dense pieces: origin (3,) in voxels, distance and what is known (n, n, n), with one voxel of the next brick."""
    block = sparse_grid.unpack_cells(volume.key)
    brick = sparse_grid.pack_cells(block.div(_BRICK_BLOCKS, rounding_mode="floor"))
    key = volume.key.cpu()
    distance = volume.distance.cpu()
    known = _known(volume, min_weight).cpu()
    local = torch.cartesian_prod(*(torch.arange(_BRICK_BLOCKS + 1),) * 3)
    n = BLOCK_SIDE * _BRICK_BLOCKS + 1
    for number in brick.unique():
        first = sparse_grid.unpack_cells(number.cpu()) * _BRICK_BLOCKS
        at, found = sparse_grid.find_cells(key, sparse_grid.pack_cells(first + local))
        dense = torch.ones(len(local), BLOCK_VOXELS)
        there = torch.zeros(len(local), BLOCK_VOXELS, dtype=torch.bool)
        dense[found], there[found] = distance[at[found]], known[at[found]]
        dense, there = (
            x.view(*(_BRICK_BLOCKS + 1,) * 3, *(BLOCK_SIDE,) * 3)
            .permute(0, 3, 1, 4, 2, 5)
            .reshape(*((_BRICK_BLOCKS + 1) * BLOCK_SIDE,) * 3)
            for x in (dense, there)
        )
        yield first.double() * BLOCK_SIDE, dense[:n, :n, :n].contiguous(), there[:n, :n, :n]


def _meshable_cells(distance: Tensor, known: Tensor, max_step: float) -> Tensor:
    """Cells (n - 1)³ of which every corner is known and no edge is a rim."""
    ok = torch.ones_like(known[1:, 1:, 1:])
    n = ok.shape[0]
    corners = [slice(0, n), slice(1, n + 1)]
    for x in corners:
        for y in corners:
            for z in corners:
                ok &= known[x, y, z]
    for dim in range(3):
        steep = distance.diff(dim=dim).abs() > max_step
        others = [d for d in range(3) if d != dim]
        for i in corners:
            for k in corners:
                index = [slice(None)] * 3
                index[others[0]], index[others[1]] = i, k
                ok &= ~steep[tuple(index)]
    return ok


def _check_volume(min_weight: float) -> None:
    if not min_weight >= 0:
        raise ValueError(f"integrate: min_weight is {min_weight}, expected 0 or more")
