"""A signed distance field in sparse blocks near surfaces, and the fusion of depth views into it.

Alphabet: a *voxel* is a point of a regular grid in the world, ``voxel`` metres apart; a *block* is 8×8×8 of them, and
only blocks that a ray has ended in (or near) exist. Each voxel holds ``distance``, how far it lies in front of the
surface along the viewing rays (m, negative behind, at most ``truncation``), the ``weight`` of its observations, 1/m²,
and the weighted mean of ``features`` such as colour.

A view updates voxels only along the rays of pixels with depth, from the camera to a little behind the surface. All
other voxels are unchanged, so that unobserved space remains unobserved.
"""

import torch
from torch import Tensor

from dhtorch.codes import Source
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import sparse_grid
from dhtorch.geometry.checks import check
from dhtorch.geometry.patches import round_half_up
from dhtorch.pytree import Record, record
from dhtorch.records import Camera, Pose

#: Voxels along the side of a block, and in a block.
BLOCK_SIDE = 8
BLOCK_VOXELS = BLOCK_SIDE**3
#: Sources of depth with separate weights, in the order of ``Volume.weight``.
VOLUME_SOURCES = (Source.SENSOR, Source.RECOVERED, Source.SWEPT, Source.FILLED)
#: What the weight of an observation follows: the variance of its depth, or its confidence.
WEIGHTINGS = ("variance", "confidence")


@record
class Volume(Record):
    """Blocks of a signed distance field; made by :func:`make_volume`, grown by :func:`fuse_views`, changed in place
    only where that is asked for."""

    key: Tensor  # (K,) int64, rising: packed positions of the blocks, see geometry.sparse_grid
    distance: Tensor  # (K, 512) m, positive in front of the surface
    weight: Tensor  # (K, 512, 4) 1/m², of the depths of VOLUME_SOURCES; 0 = unobserved
    n_swept: Tensor  # (K, 512) uint8: number of swept or filled views with a surface within reach; 255 = 255 or more
    features: Tensor  # (K, 512, 1 + C) float16: fraction of the weight with features, and that times their mean
    voxel: float  # m
    truncation: float  # m

    @property
    def bytes(self) -> int:
        """Memory of the blocks."""
        parts = (self.key, self.distance, self.weight, self.n_swept, self.features)
        return sum(x.numel() * x.element_size() for x in parts)


@record
class DepthView(Record):
    """Depth maps to be fused; pixels without depth hold 0."""

    depth: Tensor  # (B, h, w) m, 0 = none
    sigma: Tensor  # (B, h, w) m, standard deviation of depth
    features: Tensor  # (B, h, w, C), averaged along with the distance
    camera: Camera
    T_world_from_cam: Pose


def make_volume(
    voxel: float = 0.02,
    *,
    truncation: float | None = None,
    channels: int = 4,
    device: torch.device | str | None = None,
) -> Volume:
    """An empty volume.

    Args:
        voxel: m from voxel to voxel.
        truncation: m, how far from a surface distances are kept. None = 4 voxels.
        channels: of the features.
        device: of the blocks.

    Raises:
        ValueError: a voxel that is not positive, or a truncation below one voxel.
    """
    truncation = 4 * voxel if truncation is None else truncation
    if not (voxel > 0 and truncation >= voxel):
        raise ValueError(f"integrate: voxel={voxel}, truncation={truncation}, expected 0 < voxel <= truncation")
    key = torch.zeros(0, dtype=torch.int64, device=device)
    values = torch.zeros(0, BLOCK_VOXELS, device=device)
    features = torch.zeros(0, BLOCK_VOXELS, 1 + channels, dtype=torch.float16, device=device)
    weight = values[..., None].expand(-1, -1, len(VOLUME_SOURCES))
    n_swept = values.to(torch.uint8)
    sides = {"voxel": float(voxel), "truncation": float(truncation)}
    return Volume(key, values, weight, n_swept, features, **sides)


def fuse_views(
    volume: Volume,
    view: DepthView,
    *,
    source: int | Tensor = Source.SENSOR,
    max_reach: float = 3.0,
    carve: bool = True,
    weight: str = "variance",
    in_place: bool = False,
) -> Volume:
    """The volume after fusion of B more views: the mean of all distances, weighted by 1/sigma² or by confidence.

    Every voxel of a block in sight is projected into the view and reads the nearest pixel. Its distance to the surface
    there is clamped to the truncation. Behind the surface it is updated as far as the reach, twice sigma but at least
    the truncation, with a weight that fades out over the far half of the reach. Voxels in front are carved free all
    along the ray; voxels without depth at their pixel, and voxels further behind, are unchanged.

    Args:
        volume: of all views fused so far.
        view: B views, fused in their order.
        source: of their depth, one of VOLUME_SOURCES, or (B, h, w) of each pixel; selects the weight that is increased.
        max_reach: in truncations; depth whose twofold sigma exceeds it is left out.
        carve: False = voxels in front of the surface by more than the reach are unchanged.
        weight: ``variance``, 1/sigma²; ``confidence``, the last feature of a pixel, 0 to 1, over the squared side of a
            voxel, as of depths that are all equally precise: the sigma of the surface is then no standard deviation.
        in_place: change ``volume`` where it has all blocks already, instead of a copy.

    Returns:
        Volume with the blocks that the views' surfaces pass through. Depths that are not finite, not positive or
        without a usable sigma, views without a finite pose, and points beyond the grid's range are ignored.

    Raises:
        ValueError: wrong shapes, another source or weight.

    Gradient: none.
    Cost: per view, one projection for each voxel of the blocks in sight.
    Source: B. Curless, M. Levoy 1996; sparse blocks as in M. Nießner et al. 2013, sorted instead of hashed; weight by
    confidence: paper, "Global integration (scope note)".
    """
    _check_view(volume, view)
    # Index in ``VOLUME_SOURCES`` (B, h, w) of the source of each pixel; 0 where there is no depth.
    codes = torch.as_tensor(source, device=view.depth.device)
    if codes.ndim:
        check("fuse_views", source=(codes, "B h w"), depth=(view.depth, "B h w"))
    known = codes.expand_as(view.depth)[..., None] == torch.tensor(VOLUME_SOURCES, device=codes.device)
    if bool((~known.any(-1) & (view.depth > 0)).any()):
        raise ValueError(f"fuse_views: source is {source}, expected one of {VOLUME_SOURCES}")
    channel = known.int().argmax(-1)
    if weight not in WEIGHTINGS:
        raise ValueError(f"weight: found {weight!r}, expected {' or '.join(WEIGHTINGS)}")
    with torch.no_grad():
        integrators = [_ViewIntegrator(volume, view[b : b + 1], max_reach, weight) for b in range(len(view.depth))]
        volume = _grow(volume, [i.blocks() for i in integrators], copy=not in_place)
        for integrator, channels in zip(integrators, channel.flatten(1), strict=True):
            integrator._add_to(volume, channels, carve)
    return volume


def reserve_blocks(volume: Volume, view: DepthView, *, max_reach: float = 3.0) -> Volume:
    """The volume with empty blocks for the surfaces of B views, which are not fused yet.

    A voxel is not updated by views that were fused before its block existed: rays through it are lost. Where later
    views may be wrong, so that free space must be carved, the blocks of all views are reserved first.

    Arguments and errors as of :func:`fuse_views`.
    """
    _check_view(volume, view)
    with torch.no_grad():
        integrators = [_ViewIntegrator(volume, view[b : b + 1], max_reach) for b in range(len(view.depth))]
        return _grow(volume, [integrator.blocks() for integrator in integrators])


def drop_unconfirmed(volume: Volume, least: int = 2) -> Volume:
    """The volume without voxels of swept and filled depth alone that fewer than ``least`` such views confirm; called at
    the end.

    A view with a wrong pose is wrong in all its pixels, and neighbouring pixels have similar errors; a surface that a
    second reference view with other source views shows as well is seldom wrong in the same way.

    Raises:
        ValueError: ``least`` is not positive.
    """
    if least < 1:
        raise ValueError(f"drop_unconfirmed: least is {least}, expected at least 1")
    keep = (volume.n_swept >= least) | (volume.weight[..., : VOLUME_SOURCES.index(Source.SWEPT)] > 0).any(-1)
    return volume.replace(weight=torch.where(keep[..., None], volume.weight, 0.0))


def splat_points(
    camera: Camera,  # B
    hw: tuple[int, int],
    uv: Tensor,  # (B, N, 2) px
    depth: Tensor,  # (B, N) m; not finite or 0 = none
    sigma: Tensor,  # (B, N) m
    features: Tensor,  # (B, N, C)
    *,
    T_world_from_cam: Pose,  # B
    radius: float = 0.03,
    max_radius_px: int = 12,
) -> DepthView:
    """Depth view of sparse points: each becomes a small disc parallel to the image plane.

    A single ray would update only scattered voxels; a disc of a few voxels gives a patch of surface no larger than its
    radius. Where discs overlap the nearer one occludes the other.

    Args:
        camera, hw: of the image in which ``uv`` are pixels.
        uv, depth, sigma, features: of the points.
        T_world_from_cam: pose of the camera.
        radius: m of a disc, at least half a pixel.
        max_radius_px: largest radius in the image, for points close to the camera.

    Raises:
        ValueError: wrong shapes.

    Gradient: none.
    """
    sizes = check("splat_points", f=(camera.f, "B 2"), uv=(uv, "B N 2"), depth=(depth, "B N"), sigma=(sigma, "B N"))
    check("splat_points", depth=(depth, "B N"), features=(features, "B N C"))
    (h, w), B, C = hw, sizes["B"], features.shape[-1]
    with torch.no_grad():
        usable = depth.isfinite() & (depth > 0) & sigma.isfinite() & (sigma > 0) & uv.isfinite().all(-1)
        z = torch.where(usable, depth, 1.0)
        size = (radius * camera.f.amax(-1)[:, None] / z).clamp(0.5, max_radius_px)
        reach = int(size[usable].max().ceil()) if bool(usable.any()) else 0
        step = torch.arange(-reach, reach + 1, device=uv.device)
        offset = torch.cartesian_prod(step, step)  # (O, 2)
        centre = torch.where(usable[..., None], uv, 0.0)
        position = round_half_up(centre).long()[:, :, None] + offset  # (B, N, O, 2)
        covered = usable[..., None] & ((position - centre[:, :, None]).square().sum(-1).sqrt() <= size[..., None])
        covered |= usable[..., None] & (offset == 0).all(-1)
        covered &= (position >= 0).all(-1) & (position[..., 0] < w) & (position[..., 1] < h)
        b, n, o = covered.nonzero(as_tuple=True)
        pixel = (b * h + position[b, n, o, 1]) * w + position[b, n, o, 0]
        # For each pixel the point of the nearest depth, the first of equal ones.
        near = torch.full((B * h * w,), torch.inf, dtype=z.dtype, device=z.device)
        near = near.scatter_reduce(0, pixel, z[b, n], "amin")
        is_nearest = z[b, n] == near[pixel]
        owner = torch.full(near.shape, torch.iinfo(torch.int64).max, device=z.device)
        owner = owner.scatter_reduce(0, pixel[is_nearest], n[is_nearest], "amin")
        has_owner = near.isfinite().view(B, h, w)
        index = torch.where(near.isfinite(), owner, 0).view(B, h * w)

        def spread(values: Tensor) -> Tensor:
            flat = values.gather(1, index[..., None].expand(-1, -1, values.shape[-1])) if values.shape[1] else None
            full = torch.zeros(B, h * w, values.shape[-1]).to(values) if flat is None else flat
            return torch.where(has_owner[..., None], full.view(B, h, w, -1), 0.0)

        maps = spread(torch.cat((z[..., None], sigma.nan_to_num()[..., None], features), -1))
    return DepthView(maps[..., 0], maps[..., 1], maps[..., 2 : 2 + C], camera, T_world_from_cam)


class _ViewIntegrator:
    """Fusion of one view (B = 1) into a volume."""

    def __init__(self, volume: Volume, view: DepthView, max_reach: float, weight: str = "variance") -> None:
        self.voxel, self.truncation = volume.voxel, volume.truncation
        h, w = view.depth.shape[-2:]
        self.hw, self.camera = (h, w), view.camera
        self.R, self.t = view.T_world_from_cam.R[0].double(), view.T_world_from_cam.t[0].double()
        depth, sigma = view.depth.flatten(), view.sigma.flatten()
        self.reach = (2 * sigma).clamp_min(self.truncation)
        usable = (depth > 0) & (depth < sparse_grid.CELL_RANGE * volume.voxel) & sigma.isfinite() & (sigma > 0)
        usable &= self.reach <= max_reach * self.truncation
        usable &= self.R.isfinite().all() & self.t.isfinite().all()
        self.pixel = usable.nonzero()[:, 0]
        self.depth = torch.where(usable, depth, 0.0)
        by_confidence = view.features[..., -1].flatten().nan_to_num().clamp(0, 1) / volume.voxel**2
        self.precision = torch.where(usable, 1 / sigma.square() if weight == "variance" else by_confidence, 0.0)
        self.features = torch.nn.functional.pad(view.features.reshape(h * w, -1), (1, 0), value=1.0)
        # Pixels (…, 2) along the edge of an image
        u, v = torch.arange(w), torch.arange(h)
        sides = [torch.stack((u, torch.full_like(u, k)), -1) for k in (0, h - 1)]
        sides += [torch.stack((torch.full_like(v, k), v), -1) for k in (0, w - 1)]
        edge = cameras.rays(view.camera, torch.cat(sides).to(view.camera.f)[None])[0]
        self.extent = edge[edge.isfinite().all(-1)].abs().amax(0)[:2] if len(edge) else edge.new_zeros(2)

    def blocks(self) -> Tensor:
        """Packed positions of the blocks that the band around the surface passes through."""
        uv = torch.stack((self.pixel % self.hw[1], self.pixel // self.hw[1]), -1).to(self.camera.f)
        ray = cameras.rays(self.camera, uv[None])[0].double()
        is_finite = ray.isfinite().all(-1)
        ray, pixel = ray[is_finite], self.pixel[is_finite]
        unit = ray / ray.norm(dim=-1, keepdim=True)
        surface, reach = ray * self.depth[pixel, None], self.reach[pixel]
        world, direction = surface @ self.R.T + self.t, unit @ self.R.T
        side, blocks = BLOCK_SIDE * self.voxel, []
        longest = float(reach.max()) if len(reach) else 0.0
        steps = max(2, int((self.truncation + longest) / (side / 2)) + 2)
        for k in range(steps):
            along = -self.truncation + (self.truncation + reach) * k / (steps - 1)
            blocks.append(sparse_grid.occupied_cells(world + along[:, None] * direction, side))
        return torch.cat(blocks).unique()

    def _add_to(self, volume: Volume, channels: Tensor, carve: bool) -> None:
        """Update a volume in place, the weights ``channels`` (h · w,) of the pixels; the caller owns the copy."""
        corner = sparse_grid.unpack_cells(volume.key).double() * BLOCK_SIDE * self.voxel
        corner = (corner - self.t) @ self.R  # in camera axes: the rotation's transpose
        local = torch.cartesian_prod(*(torch.arange(BLOCK_SIDE, device=corner.device),) * 3).double() * self.voxel
        local = (local @ self.R).to(self.depth.dtype)
        # Blocks (k,) that may hold a voxel in the view's field and in front of its farthest surface
        centre = corner + local.double().mean(0)
        radius = float(local.norm(dim=-1).max())
        z = centre[:, 2]
        farthest = float((self.depth + self.reach)[self.pixel].max()) if len(self.pixel) else 0.0
        extent = self.extent.double()
        in_field = centre[:, :2].abs() <= extent * z[:, None] + radius * (1 + extent.square()).sqrt()
        in_sight = ((z > -radius) & (z < farthest + radius) & in_field.all(-1)).nonzero()[:, 0]
        for part in in_sight.split(1024):  # bounds the memory; voxels that the view leaves are not touched
            xyz = corner[part].to(local.dtype)[:, None] + local  # (k, 512, 3)
            pixel, along = self._observe(xyz)
            updated = along > -self.reach[pixel]
            if not carve:
                updated &= along <= self.reach[pixel]
            updated = updated.flatten().nonzero()[:, 0]
            pixel, along = pixel.flatten()[updated], along.flatten()[updated]
            voxel = (part[:, None] * BLOCK_VOXELS + torch.arange(BLOCK_VOXELS, device=part.device)).flatten()[updated]
            reach = self.reach[pixel]
            fade = (2 + 2 * along / reach).clamp(0, 1)
            added = self.precision[pixel] * fade
            weight = volume.weight.view(-1, len(VOLUME_SOURCES))
            distance = volume.distance.view(-1)
            old_weight, old = weight[voxel], distance[voxel]
            total = old_weight.sum(-1) + added
            fraction = added / torch.where(total > 0, total, 1.0)
            distance[voxel] = old + fraction * (along.clamp(-self.truncation, self.truncation) - old)
            channel = channels[pixel]
            weight[voxel, channel] = old_weight.gather(1, channel[:, None])[:, 0] + added
            n_swept = volume.n_swept.view(-1)
            confirmed = (channel >= VOLUME_SOURCES.index(Source.SWEPT)) & (along <= reach) & (fade >= 0.5)
            n_swept[voxel] += (confirmed & (n_swept[voxel] < 255)).byte()
            close = along.abs() <= self.truncation
            voxel, part_of_new = voxel[close], fraction[close, None]
            features = volume.features.flatten(0, 1)
            kept = features[voxel].to(part_of_new.dtype)
            features[voxel] = (kept + part_of_new * (self.features[pixel[close]] - kept)).to(features.dtype)

    def _observe(self, xyz: Tensor) -> tuple[Tensor, Tensor]:
        """Voxels (…, 3) m in camera axes -> their pixels (…,), and how far in front of the surface they lie along the
        ray, m; -inf where the view has no depth."""
        x, y, z = xyz.unbind(-1)
        in_field = (z > 0.01) & (x.abs() <= self.extent[0] * z * 1.01) & (y.abs() <= self.extent[1] * z * 1.01)
        uv = cameras.project(self.camera, xyz.flatten(0, 1)[None])[0]
        u, v = round_half_up(uv).view(*xyz.shape[:2], 2).unbind(-1)
        in_field &= (u >= 0) & (v >= 0) & (u < self.hw[1]) & (v < self.hw[0])
        pixel = torch.where(in_field, v * self.hw[1] + u, 0.0).long()
        depth = self.depth[pixel]
        along = (depth - z) * xyz.norm(dim=-1) / z.clamp_min(0.01)
        return pixel, torch.where(in_field & (depth > 0), along, -torch.inf)


def _grow(volume: Volume, keys: list[Tensor], copy: bool = True) -> Volume:
    """A copy of the volume with the blocks of ``keys`` added, empty; without ``copy``, itself if no block is new."""
    key = torch.cat((volume.key, *keys)).unique()
    if len(key) == len(volume.key) and not copy:
        return volume
    index = sparse_grid.find_cells(key, volume.key)[0]

    def zero_padded(x: Tensor) -> Tensor:
        return x.new_zeros(len(key), *x.shape[1:]).index_copy_(0, index, x)

    fields = ("distance", "weight", "n_swept", "features")
    return volume.replace(key=key, **{name: zero_padded(getattr(volume, name)) for name in fields})


def _check_view(volume: Volume, view: DepthView) -> None:
    check("fuse_views", key=(volume.key, "K"), distance=(volume.distance, f"K {BLOCK_VOXELS}"))
    sizes = check(
        "fuse_views",
        depth=(view.depth, "B h w"),
        sigma=(view.sigma, "B h w"),
        features=(view.features, "B h w C"),
        f=(view.camera.f, "B 2"),
        R=(view.T_world_from_cam.R, "B 3 3"),
        t=(view.T_world_from_cam.t, "B 3"),
    )
    kept = volume.features.shape[-1] - 1
    if sizes["C"] != kept:
        raise ValueError(f"fuse_views: features have {sizes['C']} channels, expected the volume's {kept}")
