"""Surface extraction from a signed distance volume: zero crossings as points with normals, or as a triangle mesh.

A crossing lies on an edge between two neighbouring observed voxels, one in front of the surface and one behind it.
There is no surface beside an unobserved voxel; a step from far in front to far behind within one voxel is the rim of a
view's visible part, and no surface either.
"""

import torch
from torch import Tensor

from dhtorch.geometry import sparse_grid
from dhtorch.integrate.volume import BLOCK_SIDE, BLOCK_VOXELS, VOLUME_SOURCES, Volume
from dhtorch.pytree import Record, collate, record

#: Largest step of the distance across a surface, in truncations; the rim of a view is a step of up to two.
_MAX_STEP_TRUNCATIONS = 1.5
#: Blocks along the side of one brick of the mesh extraction.
_BRICK_BLOCKS = 8
#: Bits of a voxel's position within its block, per axis. Source: derived, log2 of BLOCK_SIDE.
_SIDE_BITS = BLOCK_SIDE.bit_length() - 1


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
    table = _VoxelTable(volume, min_weight)
    edges = [_crossing_edges(table, axis) for axis in range(3)]
    a, b = (torch.cat([pair[k] for pair in edges]) for k in (0, 1))
    order = sparse_grid.pack_cells(a + b).argsort()  # sorted by position: independent of the order of fusion
    a, b = a[order], b[order]
    numbers = table.number(torch.stack((a, b)))
    front, back = table.at(numbers)
    t = front / (front - back)
    return _interpolate(table, numbers, t, (a + t[:, None] * (b - a)) * volume.voxel)


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
    try:
        from skimage.measure import marching_cubes  # noqa: PLC0415
    except ImportError as error:
        raise ImportError("extract_mesh: found no scikit-image, expected it: pip install scikit-image") from error
    table = _VoxelTable(volume, min_weight)
    vertices, faces, count = [], [], 0
    for origin, distance, observed in _dense_bricks(table):
        # Cells (n - 1)³ of which every corner is observed and no edge is a rim.
        cell = _both_ends(observed, 0, 1, 2)
        for dim in range(3):
            is_rim = distance.diff(dim=dim).abs() > _MAX_STEP_TRUNCATIONS * volume.truncation
            cell &= _both_ends(~is_rim, *({0, 1, 2} - {dim}))
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
        none = torch.zeros(2, 0, dtype=torch.int64, device=volume.key.device)
        return _interpolate(table, none, volume.distance.new_zeros(0), empty.double()).replace(face=empty)
    return _weld_vertices(table, torch.cat(vertices), torch.cat(faces))


def _weld_vertices(table: "_VoxelTable", vertices: Tensor, faces: Tensor) -> Surface:
    """Surface of a mesh (vertices in voxels) with one vertex per grid edge and without degenerate triangles."""
    volume, device = table.volume, table.volume.key.device
    rounded = vertices.round()
    on_voxel = (vertices - rounded).abs() < 1e-4
    a = torch.where(on_voxel, rounded, vertices.floor()).long()
    b = torch.where(on_voxel, rounded, vertices.ceil()).long()
    cells, vertex_of = sparse_grid.pack_cells(a + b).unique(return_inverse=True)
    first = torch.full_like(cells, len(a)).scatter_reduce(0, vertex_of, torch.arange(len(a)), "amin")
    faces = vertex_of[faces]
    not_degenerate = (faces != faces.roll(1, 1)).all(-1)
    a, b, position = a[first].to(device), b[first].to(device), vertices[first].to(device)
    t = ((position - a).sum(-1) / (b - a).sum(-1).clamp_min(1)).to(volume.distance.dtype)
    numbers = table.number(torch.stack((a, b)))
    return _interpolate(table, numbers, t, position * volume.voxel).replace(face=faces[not_degenerate].to(device))


def _interpolate(table: "_VoxelTable", numbers: Tensor, t: Tensor, xyz: Tensor) -> Surface:
    """Surface points at fractions ``t`` (P,) between two voxels each, ``numbers`` (2, P), computed in chunks."""
    n = 1 << 18  # points of a chunk: bounds the memory
    parts = zip(*(x.split(n, -1) for x in (numbers, t)), xyz.split(n), strict=True)
    return collate(_interpolate_chunk(table, *part) for part in parts)


def _interpolate_chunk(table: "_VoxelTable", numbers: Tensor, t: Tensor, xyz: Tensor) -> Surface:
    volume, t = table.volume, t.to(table.distance.dtype)[:, None]
    observed = ~table.at(numbers).isnan()
    index = torch.where(observed, numbers, 0)
    fraction = torch.where(observed[..., None], torch.stack((1 - t, t)), 0.0)
    weight = (volume.weight.flatten(0, 1)[index] * fraction).sum(0) / fraction.sum(0).clamp_min(1e-12)
    feature_sums = (volume.features.flatten(0, 1)[index].to(t.dtype) * fraction).sum(0)
    gradient = (table.gradient(numbers) * fraction).sum(0)
    length = gradient.norm(dim=-1, keepdim=True)
    codes = torch.tensor(VOLUME_SOURCES, dtype=torch.int32, device=weight.device)
    return Surface(
        xyz=xyz.to(t.dtype),
        normal=torch.where(length > 0, gradient / length, torch.nan),
        features=feature_sums[:, 1:] / feature_sums[:, :1].clamp_min(1e-6),
        sigma=weight.sum(-1).rsqrt(),
        source=codes[weight.argmax(-1)],  # the first of equal weights
    )


class _VoxelTable:
    """Voxels of a volume by number: 512 for each block in turn, then those of one unobserved block, which stands for
    all absent ones. Blocks side by side are looked up once."""

    def __init__(self, volume: Volume, min_weight: float) -> None:
        if not min_weight >= 0:
            raise ValueError(f"integrate: min_weight is {min_weight}, expected 0 or more")
        self.volume = volume
        total = volume.weight.sum(-1)
        self.distance = self._pad(torch.where(total > 0, volume.distance, torch.nan))  # NaN = unobserved
        self.chosen = self.distance  # NaN = unobserved, or with too little weight
        if min_weight > 0:
            self.chosen = self._pad(torch.where(total >= min_weight, volume.distance, torch.nan))
        self._slots = torch.arange(len(volume.key) + 1, device=volume.key.device)
        self._position = sparse_grid.unpack_cells(volume.key)
        # Slot (K + 1,) of the block beside each block; K = absent.
        steps = {(axis, sign): torch.zeros_like(self._position[:1]) for axis in range(3) for sign in (1, -1)}
        for (axis, sign), step in steps.items():
            step[:, axis] = sign
        self.next = {k: torch.cat((self._slot(self._position + step), self._slots[-1:])) for k, step in steps.items()}

    def _pad(self, x: Tensor) -> Tensor:
        """(K, 512) -> (K + 1, 512), the last NaN."""
        return torch.nn.functional.pad(x, (0, 0, 0, 1), value=torch.nan)

    def _slot(self, block: Tensor) -> Tensor:
        slot, exists = sparse_grid.find_cells(self.volume.key, sparse_grid.pack_cells(block))
        return torch.where(exists, slot, len(self.volume.key))

    def number(self, ijk: Tensor) -> Tensor:
        """Numbers (…,) of voxels ``ijk`` (…, 3)."""
        block = ijk >> _SIDE_BITS
        x, y, z = (ijk & (BLOCK_SIDE - 1)).unbind(-1)
        return (((self._slot(block) << _SIDE_BITS) + x << _SIDE_BITS) + y << _SIDE_BITS) + z

    def at(self, number: Tensor) -> Tensor:
        """Distances (…,) m of voxels; NaN where unobserved."""
        return self.distance.flatten()[number]

    def gradient(self, number: Tensor) -> Tensor:
        """Gradient (…, 3) of the distance per voxel: central differences, one-sided beside unobserved voxels."""
        here = self.at(number)
        derivatives = []
        for axis in range(3):
            ahead, behind = (self.at(self._step(number, axis, sign)) for sign in (1, -1))
            is_central = ahead.isfinite() & behind.isfinite()
            one_sided = (ahead - here).nan_to_num(0.0) + (here - behind).nan_to_num(0.0)
            derivatives.append(torch.where(is_central, (ahead - behind) / 2, one_sided))
        return torch.stack(derivatives, -1)

    def _step(self, number: Tensor, axis: int, sign: int) -> Tensor:
        """Numbers (…,) of the voxels one step (±1) along an axis."""
        bits = _SIDE_BITS * (2 - axis)
        last = BLOCK_SIDE - 1 if sign > 0 else 0
        jump = (self.next[axis, sign] - self._slots) * BLOCK_VOXELS - (sign * (BLOCK_SIDE - 1) << bits)
        is_last = (number >> bits) & (BLOCK_SIDE - 1) == last
        return number + torch.where(is_last, jump[number >> 3 * _SIDE_BITS], sign << bits)


def _crossing_edges(table: _VoxelTable, axis: int) -> tuple[Tensor, Tensor]:
    """Grid edges along ``axis`` that cross the surface: their voxels (P, 3) in front of it and behind it."""
    volume, dim = table.volume, axis + 1
    step = torch.nn.functional.one_hot(torch.tensor(axis, device=volume.key.device), 3)
    chosen = table.chosen.view(-1, BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE)
    distance = chosen[:-1]
    beyond = chosen.narrow(dim, 0, 1)[table.next[axis, 1][:-1]]
    next_distance = torch.cat((distance.narrow(dim, 1, BLOCK_SIDE - 1), beyond), dim)
    crossing = ((distance > 0) != (next_distance > 0)) & (
        (distance - next_distance).abs() <= _MAX_STEP_TRUNCATIONS * volume.truncation
    )
    index = crossing.nonzero()
    low = sparse_grid.unpack_cells(volume.key[index[:, 0]]) * BLOCK_SIDE + index[:, 1:]
    front = (distance[crossing] > 0)[:, None]
    high = low + step
    return torch.where(front, low, high), torch.where(front, high, low)


def _dense_bricks(table: _VoxelTable):
    """Dense bricks: origin (3,) in voxels, distance and observed (n, n, n), with one voxel of the next brick."""
    key = table.volume.key.cpu()
    brick = sparse_grid.pack_cells(sparse_grid.unpack_cells(key).div(_BRICK_BLOCKS, rounding_mode="floor"))
    distance = table.volume.distance.cpu()
    observed = ~table.chosen[:-1].cpu().isnan()
    local = torch.cartesian_prod(*(torch.arange(_BRICK_BLOCKS + 1),) * 3)
    n = BLOCK_SIDE * _BRICK_BLOCKS + 1
    for number in brick.unique():
        first = sparse_grid.unpack_cells(number) * _BRICK_BLOCKS
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


def _both_ends(x: Tensor, *dims: int) -> Tensor:
    """Mask of grid points -> mask of the steps between neighbours along ``dims``, True where both ends are."""
    for dim in dims:
        n = x.shape[dim] - 1
        x = x.narrow(dim, 0, n) & x.narrow(dim, 1, n)
    return x
