"""Surface extraction from a signed distance volume: zero crossings as points with normals, or as a triangle mesh.

A crossing lies on an edge between two neighbouring observed voxels, one in front of the surface and one behind it.
There is no surface beside an unobserved voxel; a step from far in front to far behind within one voxel is the rim of a
view's visible part, and no surface either.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.geometry import sparse_grid
from dhtorch.integrate.volume import BLOCK_SIDE, BLOCK_VOXELS, VOLUME_SOURCES, Volume
from dhtorch.pytree import Record, collate, record

#: Largest step of the distance across a surface, in truncations; the rim of a view is a step of up to two.
_MAX_STEP_TRUNCATIONS = 1.5
#: Blocks along the side of one brick of the mesh extraction.
_BRICK_BLOCKS = 8
#: Points whose attributes are interpolated at a time; bounds the memory.
_POINTS_PER_CHUNK = 1 << 18
#: Distance to a voxel, in voxels, below which a vertex of the mesh counts as lying on it.
_SNAP_VOXELS = 1e-4


@record
class Surface(Record):
    """Points on the surface of a volume; with triangles between them if it is a mesh."""

    xyz: Tensor  # (P, 3) m in the world
    normal: Tensor  # (P, 3) unit, towards free space; NaN where undefined
    features: Tensor  # (P, C) weighted means
    sigma: Tensor  # (P,) m, standard deviation of the mean of all views, taken as independent
    source: Tensor  # (P,) int32 codes.Source with the largest weight
    face: Tensor | None = None  # (F, 3) int64, counter-clockwise seen from free space


def extract_points(volume: Volume, *, min_weight: float = 0.0) -> Surface:
    """Surface points of a volume: the zero crossings of all grid edges, without a mesh.

    Args:
        volume: from :func:`dhtorch.integrate.fuse_views`.
        min_weight: 1/m², least weight of the two voxels of a crossing.

    Raises:
        ValueError: a negative weight.

    Gradient: none.
    """
    _check_volume(min_weight)
    edges = [_crossing_edges(volume, axis, min_weight) for axis in range(3)]
    a, b = (torch.cat([pair[k] for pair in edges]) for k in (0, 1))
    order = sparse_grid.pack_cells(a + b).argsort()  # sorted by position: independent of the order of fusion
    a, b = a[order], b[order]
    front, back = _distance(volume, a), _distance(volume, b)
    t = front / (front - back)
    return _interpolate(volume, a, b, t, (a + t[:, None] * (b - a)) * volume.voxel)


def extract_mesh(volume: Volume, *, min_weight: float = 0.0) -> Surface:
    """Triangle mesh of a volume, by marching cubes over all cells whose eight corners are observed.

    Bricks of blocks are meshed one after the other. They share their borders, and vertices on the same grid edge are
    merged, so that no seam remains.

    Args:
        volume: from :func:`dhtorch.integrate.fuse_views`.
        min_weight: 1/m², least weight of the corners of a cell.

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
        raise ImportError("extract_mesh: found no scikit-image, expected it: pip install scikit-image") from error
    vertices, faces, count = [], [], 0
    for origin, distance, observed in _dense_bricks(volume, min_weight):
        cell = _meshable_cells(distance, observed, _MAX_STEP_TRUNCATIONS * volume.truncation)
        if not bool(cell.any()):
            continue
        mask = torch.nn.functional.pad(cell, (1, 0) * 3)  # marching_cubes reads the mask at the far corner of a cell
        if not bool(((distance > 0) & mask).any() and ((distance <= 0) & observed).any()):
            continue
        try:
            mesh = marching_cubes(distance.numpy(), 0.0, gradient_direction="descent", mask=mask.numpy())
        except (RuntimeError, ValueError):  # no crossing in this brick
            continue
        vertices.append(torch.from_numpy(mesh[0].copy()).double() + origin)
        faces.append(torch.from_numpy(mesh[1].astype("int64")) + count)
        count += len(mesh[0])
    if not count:
        empty = torch.zeros(0, 3, dtype=torch.int64)
        return _interpolate(volume, empty, empty, volume.distance.new_zeros(0), empty.double()).replace(face=empty)
    return _weld_vertices(volume, torch.cat(vertices), torch.cat(faces))


def _weld_vertices(volume: Volume, vertices: Tensor, faces: Tensor) -> Surface:
    """Surface of a mesh (vertices in voxels) with one vertex per grid edge and without degenerate triangles."""
    device = volume.key.device
    rounded = vertices.round()
    on_voxel = (vertices - rounded).abs() < _SNAP_VOXELS
    a = torch.where(on_voxel, rounded, vertices.floor()).long()
    b = torch.where(on_voxel, rounded, vertices.ceil()).long()
    cells, vertex_of = sparse_grid.pack_cells(a + b).unique(return_inverse=True)
    first = torch.full_like(cells, len(a)).scatter_reduce(0, vertex_of, torch.arange(len(a)), "amin")
    faces = vertex_of[faces]
    not_degenerate = (faces != faces.roll(1, 1)).all(-1)
    a, b, position = a[first].to(device), b[first].to(device), vertices[first].to(device)
    t = ((position - a).sum(-1) / (b - a).sum(-1).clamp_min(1)).to(volume.distance.dtype)
    return _interpolate(volume, a, b, t, position * volume.voxel).replace(face=faces[not_degenerate].to(device))


def _interpolate(volume: Volume, a: Tensor, b: Tensor, t: Tensor, xyz: Tensor) -> Surface:
    """Surface points at fractions ``t`` (P,) between voxels ``a`` and ``b`` (P, 3), computed in chunks."""
    parts = zip(*(x.split(_POINTS_PER_CHUNK) for x in (a, b, t, xyz)), strict=True)
    return collate(_interpolate_chunk(volume, *part) for part in parts)


def _interpolate_chunk(volume: Volume, a: Tensor, b: Tensor, t: Tensor, xyz: Tensor) -> Surface:
    t = t.to(volume.distance.dtype)[:, None]
    index, observed = _voxel_slots(volume, torch.stack((a, b)))
    fraction = torch.where(observed[..., None], torch.stack((1 - t, t)), 0.0)
    weight = (volume.weight.flatten(0, 1)[index] * fraction).sum(0) / fraction.sum(0).clamp_min(1e-12)
    feature_sums = (volume.features.flatten(0, 1)[index].to(t.dtype) * fraction).sum(0)
    gradient = (_distance_gradient(volume, torch.stack((a, b))) * fraction).sum(0)
    length = gradient.norm(dim=-1, keepdim=True)
    codes = torch.tensor(VOLUME_SOURCES, dtype=torch.int32, device=weight.device)
    return Surface(
        xyz=xyz.to(t.dtype),
        normal=torch.where(length > 0, gradient / length, torch.nan),
        features=feature_sums[:, 1:] / feature_sums[:, :1].clamp_min(1e-6),
        sigma=weight.sum(-1).rsqrt(),
        source=codes[weight.argmax(-1)],  # the first of equal weights
    )


def _distance_gradient(volume: Volume, ijk: Tensor) -> Tensor:
    """Gradient (…, 3) of the distance per voxel: central differences, one-sided beside unobserved voxels."""
    here = _distance(volume, ijk)
    derivatives = []
    for step in torch.eye(3, dtype=torch.int64, device=ijk.device):
        ahead, behind = (_distance(volume, ijk + sign * step) for sign in (1, -1))
        is_central = ahead.isfinite() & behind.isfinite()
        one_sided = (ahead - here).nan_to_num(0.0) + (here - behind).nan_to_num(0.0)
        derivatives.append(torch.where(is_central, (ahead - behind) / 2, one_sided))
    return torch.stack(derivatives, -1)


def _voxel_slots(volume: Volume, ijk: Tensor) -> tuple[Tensor, Tensor]:
    """Indices (…,) of voxels in the flattened blocks, and whether they exist and were observed."""
    block = ijk.div(BLOCK_SIDE, rounding_mode="floor")
    x, y, z = (ijk - block * BLOCK_SIDE).unbind(-1)
    slot, exists = sparse_grid.find_cells(volume.key, sparse_grid.pack_cells(block))
    index = slot * BLOCK_VOXELS + (x * BLOCK_SIDE + y) * BLOCK_SIDE + z
    if not len(volume.key):
        return index, exists
    return index, exists & (volume.weight.flatten(0, 1)[index] > 0).any(-1)


def _distance(volume: Volume, ijk: Tensor) -> Tensor:
    """Distances (…,) at voxels ``ijk`` (…, 3); NaN where unobserved."""
    index, observed = _voxel_slots(volume, ijk)
    return torch.where(observed, volume.distance.flatten()[index], torch.nan) if len(volume.key) else observed.float()


def _crossing_edges(volume: Volume, axis: int, min_weight: float) -> tuple[Tensor, Tensor]:
    """Grid edges along ``axis`` that cross the surface: their voxels (P, 3) in front of it and behind it."""
    shape = (-1, BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE)
    distance = torch.where(_observed(volume, min_weight), volume.distance, torch.nan).view(shape)
    dim = axis + 1
    step = torch.nn.functional.one_hot(torch.tensor(axis, device=volume.key.device), 3)
    slot, exists = sparse_grid.find_cells(
        volume.key, sparse_grid.pack_cells(sparse_grid.unpack_cells(volume.key) + step)
    )
    beyond = distance.narrow(dim, 0, 1)[slot] if len(slot) else distance.narrow(dim, 0, 1)
    beyond = torch.where(exists.view(-1, 1, 1, 1), beyond, torch.nan)
    next_distance = torch.cat((distance.narrow(dim, 1, BLOCK_SIDE - 1), beyond), dim)
    crossing = ((distance > 0) != (next_distance > 0)) & (
        (distance - next_distance).abs() <= _MAX_STEP_TRUNCATIONS * volume.truncation
    )
    index = crossing.nonzero()
    low = sparse_grid.unpack_cells(volume.key[index[:, 0]]) * BLOCK_SIDE + index[:, 1:]
    front = (distance[crossing] > 0)[:, None]
    high = low + step
    return torch.where(front, low, high), torch.where(front, high, low)


def _observed(volume: Volume, min_weight: float) -> Tensor:
    total = volume.weight.sum(-1)
    return (total > 0) & (total >= min_weight)


def _dense_bricks(volume: Volume, min_weight: float):
    """Dense bricks: origin (3,) in voxels, distance and observed (n, n, n), with one voxel of the next brick."""
    block = sparse_grid.unpack_cells(volume.key)
    brick = sparse_grid.pack_cells(block.div(_BRICK_BLOCKS, rounding_mode="floor"))
    key = volume.key.cpu()
    distance = volume.distance.cpu()
    observed = _observed(volume, min_weight).cpu()
    local = torch.cartesian_prod(*(torch.arange(_BRICK_BLOCKS + 1),) * 3)
    n = BLOCK_SIDE * _BRICK_BLOCKS + 1
    for number in brick.unique():
        first = sparse_grid.unpack_cells(number.cpu()) * _BRICK_BLOCKS
        slot, exists = sparse_grid.find_cells(key, sparse_grid.pack_cells(first + local))
        dense = torch.ones(len(local), BLOCK_VOXELS)
        dense_observed = torch.zeros(len(local), BLOCK_VOXELS, dtype=torch.bool)
        dense[exists], dense_observed[exists] = distance[slot[exists]], observed[slot[exists]]
        dense, dense_observed = (
            x.view(*(_BRICK_BLOCKS + 1,) * 3, *(BLOCK_SIDE,) * 3)
            .permute(0, 3, 1, 4, 2, 5)
            .reshape(*((_BRICK_BLOCKS + 1) * BLOCK_SIDE,) * 3)
            for x in (dense, dense_observed)
        )
        yield first.double() * BLOCK_SIDE, dense[:n, :n, :n].contiguous(), dense_observed[:n, :n, :n]


def _meshable_cells(distance: Tensor, observed: Tensor, max_step: float) -> Tensor:
    """Cells (n - 1)³ of which every corner is observed and no edge is a rim."""
    ok = torch.ones_like(observed[1:, 1:, 1:])
    n = ok.shape[0]
    corners = [slice(0, n), slice(1, n + 1)]
    for x in corners:
        for y in corners:
            for z in corners:
                ok &= observed[x, y, z]
    for dim in range(3):
        steep = distance.diff(dim=dim).abs() > max_step
        other_dims = [d for d in range(3) if d != dim]
        for i in corners:
            for k in corners:
                index = [slice(None)] * 3
                index[other_dims[0]], index[other_dims[1]] = i, k
                ok &= ~steep[tuple(index)]
    return ok


def _check_volume(min_weight: float) -> None:
    if not min_weight >= 0:
        raise ValueError(f"integrate: min_weight is {min_weight}, expected 0 or more")
