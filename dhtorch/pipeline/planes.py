"""Depth of surfaces without texture: slanted planes from the answers around them, before returns and sweep are merged.

    swept map, returns ── cells ──┐
    grey image ───────────────────┴─ support along rays ─ plane of most support ─ tests ─ swept map with filled pixels

The map is divided into *cells*, squares of ``plane_cell_px``. From every cell rays run in all directions over cells of
the same grey value; the first cells on each ray that have answers are the cell's *support*. The plane that most of the
support lies on gives the depth of the cell's unanswered pixels. Rays end where the grey value changes, so that textured
surfaces, on which a sweep without an answer has failed for another reason, have no support.

Alphabet: maps (B, h, w); cells (B, rows, columns), N = rows · columns of them; S support cells of a cell; q inverse
depth (1/m), on a plane q = a u + b v + c of pixels (u, v), exactly.
"""

import math
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry.checks import any_possible, is_static
from dhtorch.geometry.linalg import quadratic_form
from dhtorch.geometry.windows import window_extreme
from dhtorch.ops.dispatch import operator
from dhtorch.pipeline.dense_options import DEFAULT_DENSE_OPTIONS, DenseOptions
from dhtorch.pipeline.map_filters import (
    FIELD_DTYPES,
    SensorReturns,
    copy_fields,
    fill_fields,
    map_fields,
    with_fields,
)
from dhtorch.records import DepthMap

#: Least inverse depth that is divided by, 1/m: of farther points than any sensor or sweep measures.
#: Source: derived, a distance of 1e6 m.
MIN_PLANE_INVERSE_DEPTH = 1e-6

#: Directions of the second and third support cell of a hypothesis, in sixteenths of a turn from the first, the step
#: from one first direction to the next, and the slots of the rays that are used. Source: chosen on built-in rooms and
#: shared scenes: half as many fill a tenth less, twice as many hardly more.
_TRIPLES = ((5, 10, 1, 2), (4, 8, 2, 1), (3, 6, 2, 1))

#: Number of directions of rays that :data:`_TRIPLES` counts. Source: derived, a turn over its unit.
_DIRECTIONS = 16


class _Cells(NamedTuple):
    """Means over the answered pixels of every cell, (B, rows, columns) each."""

    u: Tensor  # px
    v: Tensor  # px
    q: Tensor  # 1/m
    variance: Tensor  # of depth, relative
    answered: Tensor  # bool, enough pixels are answered
    grey: Tensor  # mean over all pixels


class _Support(NamedTuple):
    """Support cells of every cell, (B, S, N) each."""

    x: Tensor  # px, from the middle of the cell
    y: Tensor  # px
    q: Tensor  # 1/m
    variance: Tensor  # of depth, relative
    exists: Tensor  # bool


class _Planes(NamedTuple):
    """The plane of every cell, (B, N) each: q = q_0 + a (x - x_0) + b (y - y_0), px from the middle of the cell."""

    q_0: Tensor  # 1/m
    x_0: Tensor  # px
    y_0: Tensor  # px
    a: Tensor  # 1/m/px
    b: Tensor  # 1/m/px
    n: Tensor  # support cells on the plane
    inverse: tuple[Tensor, Tensor, Tensor]  # 1/px², entries of the inverse scatter of their pixels
    residual: Tensor  # root mean square of their residuals, relative to q
    common: Tensor  # their mean variance of depth, relative

    def at(self, x: Tensor, y: Tensor) -> Tensor:
        """Inverse depth at pixels from the middle of the cell."""
        return self.q_0 + self.a * (x - self.x_0) + self.b * (y - self.y_0)

    def leverage(self, x: Tensor, y: Tensor) -> Tensor:
        """Variance of :meth:`at` over that of one support cell; it grows with the distance from the support."""
        return 1 / self.n.clamp_min(1) + quadratic_form(x - self.x_0, y - self.y_0, *self.inverse)


#: Dtypes that the kernel reads, of the maps before and after the filters, returns, grey image and reach.
_FILL_DTYPES: dict[str, torch.dtype | tuple[torch.dtype, ...]] = {
    **{f"{map_}_{name}": dtype for map_ in ("swept", "support") for name, dtype in FIELD_DTYPES.items()},
    **{f"returns_{name}": torch.float32 for name in ("depth", "sigma", "confidence")},
    "usable": torch.bool,
    "grey": torch.float32,
    "reach": torch.float32,
}

#: Options that the kernel reads, in its order.
_KERNEL_OPTIONS = (
    *("plane_cell_px", "min_cell_pixels", "plane_ray_support", "min_plane_support", "plane_neighbours"),
    *("plane_grey_difference", "plane_inlier_ratio", "min_triple_area", "min_plane_share", "max_plane_sigma_rel"),
    *("max_plane_disagreement", "max_plane_difference", "max_refuted_rays", "independent_support"),
    *("common_sigma_ratio", "max_sigma_rel"),
)


def fill_planes(
    swept: DepthMap,
    support: DepthMap,
    returns: SensorReturns,
    grey: Tensor,
    reach: Tensor,
    *,
    sparse: Tensor | None = None,
    options: DenseOptions = DEFAULT_DENSE_OPTIONS,
) -> DepthMap:
    """The swept map with unanswered pixels of weakly textured planes answered (FILLED) from the answers around them.

    Args:
        swept: map (B, h, w) before the merge.
        support: the same before its filters: on weak texture the sweep answers in lines and specks, which the filters
            make silent although most of them lie on the surface.
        returns: of the same pixels; they support planes as swept answers do.
        grey: (B, 1, h, w), the reference image.
        reach: (B,) m, depth to which the sensor returns; its silence there refutes a nearer plane.
        sparse: (B,) bool, whether the returns are sparse: then silence is no evidence.
        options: tuning constants.

    Sigma joins the residuals of the support, the plane's covariance at the pixel, the disagreement with the planes of
    the cells around and the part of the support's own sigma that is common to all of it. A pixel stays silent where too
    few support cells lie on one plane, where the plane is extrapolated too far, or where neighbours disagree; and every
    pixel of a view without swept answers.

    Gradient: of filled depths to the depths of their support; its selection and sigma carry none.
    Cost: linear in pixels; independent of the number of planes and source views.
    """
    dense = torch.ones_like(reach, dtype=torch.bool) if sparse is None else ~sparse
    reach = torch.where(dense, options.plane_reach * reach, 0.0).to(swept.depth)
    maps = *map_fields(swept), *map_fields(support)
    return with_fields(swept, _filled(*maps, *returns, grey, reach, options=options))


@cache
def _tables(reach_cells: int, ray_support: int) -> list[Tensor]:
    """:func:`_steps` (directions, cells, 2) and :func:`_triples` (hypotheses, 3) as int32."""
    return [torch.tensor(x, dtype=torch.int32) for x in (_steps(reach_cells), _triples(ray_support))]


def _fill_kernel(*tensors: Any, options: DenseOptions) -> Sequence[Tensor]:
    filled = copy_fields(tensors)
    known = (x.contiguous() for x in tensors[len(filled) :])
    depth, sigma, _, _, gate, returned, returned_sigma, _, usable, grey, reach = known
    torch.ops.dhtorch.fill_planes.default(
        *(depth, sigma, gate, returned, returned_sigma, usable, grey, reach),
        *_tables(options.plane_reach_cells, options.plane_ray_support),
        *filled,
        *(getattr(options, name) for name in _KERNEL_OPTIONS),
        MIN_PLANE_INVERSE_DEPTH,
    )
    return filled


@operator(kernel=_fill_kernel, dtypes=_FILL_DTYPES, any_layout=tuple(_FILL_DTYPES))
def _filled(*tensors: Any, options: DenseOptions) -> Sequence[Tensor]:
    """:func:`fill_planes` of the tensors of maps, returns, grey image and reach (0 where returns are sparse)."""
    n = len(FIELD_DTYPES)
    swept, support = (DepthMap(*fields) for fields in (tensors[:n], tensors[n : 2 * n]))
    returns = SensorReturns(*tensors[2 * n : -2])
    grey, reach = tensors[-2:]
    has_sweep = support.keep.flatten(1).any(1)[:, None, None]
    unanswered = has_sweep & ~swept.keep & ~returns.usable
    if not any_possible(unanswered):
        return tensors[:n]
    cells = _cells(*_known(support, returns), grey[:, 0].detach().to(swept.depth), options)
    with torch.no_grad():
        slots = _support_slots(cells, options)
    middle = _cell_middles(cells, options)
    # The support (B, S, N) from its indices; its pixels are counted from the ``middle`` of the supported cell.
    index = slots.clamp_min(0).flatten(1)

    def take(x: Tensor) -> Tensor:
        return x.flatten(1).gather(1, index).view(slots.shape)

    supports = _Support(
        take(cells.u) - middle[0], take(cells.v) - middle[1], take(cells.q), take(cells.variance), slots >= 0
    )
    to_fill = _cell_sums(unanswered.float(), options) > 0
    planes = _fit_planes(
        supports, window_extreme(to_fill, options.plane_neighbours, torch.logical_or).flatten(1), options
    )
    accepted, disagreement = _tested(planes, supports, cells.answered.shape, options)
    accepted &= ~_is_refuted(planes, supports, reach, options).view(accepted.shape)
    q, relative = _at_pixels(planes, disagreement, swept.depth.shape, cells.answered.shape, options)
    accepted = _per_pixel(accepted, swept.depth.shape, options)
    within_reach = q * reach[:, None, None] > 1
    plausible = (q > MIN_PLANE_INVERSE_DEPTH) & (relative <= options.max_sigma_rel)
    where = unanswered & accepted & plausible & ~within_reach
    depth = 1 / torch.where(where, q, torch.ones_like(q))
    return fill_fields(swept, where, depth, relative * depth.detach(), relative)


def _known(swept: DepthMap, returns: SensorReturns) -> tuple[Tensor, Tensor, Tensor]:
    """Depth and sigma (B, h, w) of returns and swept answers, 1 elsewhere, and where there is either."""
    keep, usable = swept.keep, returns.usable
    depth = torch.where(usable, returns.depth.to(swept.depth), torch.where(keep, swept.depth, 1.0))
    sigma = torch.where(usable, returns.sigma.to(swept.sigma), torch.where(keep, swept.sigma, 1.0))
    known = (keep | usable) & (depth > 0) & depth.isfinite()
    return torch.where(known, depth, torch.ones_like(depth)), sigma, known


def _cells(depth: Tensor, sigma: Tensor, known: Tensor, grey: Tensor, options: DenseOptions) -> _Cells:
    """Cell means of maps (B, h, w); the mean of a plane's inverse depths lies on the plane."""
    h, w = depth.shape[1:]
    rows, columns = (torch.arange(n, device=depth.device).to(depth) for n in (h, w))
    count = _cell_sums(known.to(depth), options)
    safe = count.clamp_min(1)

    def mean(x: Tensor) -> Tensor:
        return _cell_sums(torch.where(known, x, torch.zeros_like(x)), options) / safe

    return _Cells(
        u=mean(columns.expand_as(depth)),
        v=mean(rows[:, None].expand_as(depth)),
        q=mean(1 / depth),
        variance=mean((sigma / depth).detach().square()),
        answered=count >= options.min_cell_pixels,
        grey=_cell_sums(grey, options) / _cell_sums(torch.ones_like(grey), options),
    )


def _cell_sums(x: Tensor, options: DenseOptions) -> Tensor:
    """Map (B, h, w) -> sums over the pixels of each cell (B, rows, columns); cells at the border may have fewer."""
    side = options.plane_cell_px
    h, w = x.shape[1:]
    x = F.pad(x, (0, -w % side, 0, -h % side))
    for dim in (1, 2):
        x = _sums(x.unflatten(dim, (-1, side)).movedim(dim + 1, 1))
    return x


def _sums(x: Tensor) -> Tensor:
    """Sums (B, …) over the second axis of (B, S, …), view by view: their rounding depends on no batch mate."""
    return torch.stack([view.sum(0) for view in x])


def _cell_middles(cells: _Cells, options: DenseOptions) -> tuple[Tensor, Tensor]:
    """Pixels u and v (N,) of the middles of the cells."""
    side = options.plane_cell_px
    rows, columns = (
        torch.arange(n, device=cells.q.device).to(cells.q) * side + (side - 1) / 2 for n in cells.q.shape[1:]
    )
    return columns.expand(len(rows), -1).flatten(), rows[:, None].expand(-1, len(columns)).flatten()


def _steps(reach_cells: int) -> list[list[tuple[int, int]]]:
    """Rows and columns from a cell to those on each of its rays, from the nearest."""
    angles = (2 * math.pi * k / _DIRECTIONS for k in range(_DIRECTIONS))
    return [
        [(round(r * math.sin(angle)), round(r * math.cos(angle))) for r in range(1, reach_cells + 1)]
        for angle in angles
    ]


def _support_slots(cells: _Cells, options: DenseOptions) -> Tensor:
    """Flat indices (B, S, N) of the support of every cell, ray by ray from the nearest; -1 where there is none."""
    reach, per_ray = options.plane_reach_cells, options.plane_ray_support
    rows, columns = cells.q.shape[1:]
    margin = (reach,) * 4
    index = torch.arange(rows * columns, device=cells.q.device, dtype=torch.int32).view(1, rows, columns)
    index = F.pad(index.expand(len(cells.q), -1, -1), margin, value=-1)
    grey = F.pad(cells.grey, margin, value=torch.inf)
    answered = F.pad(cells.answered, margin)
    rays = []
    for steps in _steps(reach):
        support = torch.full((per_ray, *cells.q.shape), -1, dtype=torch.int32, device=cells.q.device)
        count = torch.zeros_like(cells.answered, dtype=torch.int32)
        open_ = torch.ones_like(cells.answered)
        for down, right in steps:
            top, left = reach + down, reach + right
            place = slice(None), slice(top, top + rows), slice(left, left + columns)
            open_ = open_ & ((grey[place] - cells.grey).abs() <= options.plane_grey_difference)
            take = open_ & answered[place]
            for slot in range(per_ray):
                support[slot] = torch.where(take & (count == slot), index[place], support[slot])
            count = count + take.to(count.dtype)
        rays.append(support)
    return torch.cat(rays).transpose(0, 1).flatten(2).long()


def _triples(per_ray: int) -> list[tuple[int, int, int]]:
    """Slots of the three support cells of each hypothesis."""
    out = []
    for second, third, step, slots in _TRIPLES:
        for first in range(0, _DIRECTIONS, step):
            rays = [(first + turn) % _DIRECTIONS * per_ray for turn in (0, second, third)]
            out += [(rays[0] + slot, rays[1] + slot, rays[2] + slot) for slot in range(min(slots, per_ray))]
    for first in range(0, _DIRECTIONS, 2):  # both ends of one ray, and the start of another
        for turn in (4, 9):
            out.append((first * per_ray, (first + 1) * per_ray - 1, (first + turn) % _DIRECTIONS * per_ray))
    return out


@torch.no_grad()
def _best_hypothesis(support: _Support, wanted: Tensor, options: DenseOptions) -> Tensor:
    """Support cells (B, S, N) bool on the plane through three of them that costs least, by truncated squares, of
    ``wanted`` cells (B, N) bool; none of the others.

    Source: P. Torr, A. Zisserman, "MLESAC" (CVIU 2000), the truncated score.
    """
    if is_static(wanted):
        return _cheapest_plane(support, options) & wanted[:, None]
    inlier = torch.zeros_like(support.exists)
    for k in range(len(wanted)):  # view by view: the sums then depend on no batch mate
        # Few enough cells at once for their support (five arrays of 64) to stay in a cache of 1 MB; it changes no bit.
        for index in wanted[k].nonzero()[:, 0].split(512):
            block = _Support(*(x[k : k + 1, :, index] for x in support))
            inlier[k : k + 1, :, index] = _cheapest_plane(block, options)
    return inlier


def _cheapest_plane(support: _Support, options: DenseOptions) -> Tensor:
    """:func:`_best_hypothesis` of some of the cells."""
    x, y, q, _, exists = support
    limit = options.plane_inlier_ratio * q
    weight = torch.where(exists, 1 / limit.clamp_min(MIN_PLANE_INVERSE_DEPTH), 0.0)
    terms = x * weight, y * weight, weight, q * weight
    least_area = options.plane_cell_px**2 * options.min_triple_area
    least = torch.full_like(x[:, 0], torch.inf)
    plane = [torch.zeros_like(least) for _ in range(3)]
    for i, j, k in _triples(options.plane_ray_support):
        dx, dy, dq = (tuple(z[:, m] - z[:, i] for m in (j, k)) for z in (x, y, q))
        area = dx[0] * dy[1] - dy[0] * dx[1]
        valid = exists[:, i] & exists[:, j] & exists[:, k] & (area.abs() > least_area)
        area = torch.where(valid, area, torch.ones_like(area))
        a, b = (dq[0] * dy[1] - dy[0] * dq[1]) / area, (dx[0] * dq[1] - dq[0] * dx[1]) / area
        c = q[:, i] - a * x[:, i] - b * y[:, i]
        residual = _residual((a, b, c), terms)
        cost = residual.mul_(residual).clamp_max_(1).sum(1)
        better = valid & (c > 0) & (cost < least)
        least = torch.where(better, cost, least)
        plane = [torch.where(better, new, old) for new, old in zip((a, b, c), plane, strict=True)]
    return exists & (_residual(plane, terms).abs() < 1) & least.isfinite()[:, None]


def _residual(plane: Sequence[Tensor], terms: tuple[Tensor, ...]) -> Tensor:
    """Residuals (B, S, N) of planes a, b, c (B, N) from weighted x, y, 1 and q (B, S, N)."""
    a, b, c = (p[:, None] for p in plane)
    x, y, one, q = terms
    return (a * x).addcmul_(b, y).addcmul_(c, one).sub_(q)


def _fit_planes(support: _Support, wanted: Tensor, options: DenseOptions) -> _Planes:
    """The plane of the best hypothesis, fitted to its support twice: the second time to that of the first fit; without
    support in cells that are not ``wanted`` (B, N) bool."""
    inlier = _best_hypothesis(support, wanted, options)
    with torch.no_grad():
        planes = _least_squares(support, inlier, options)
        q = planes.at(support.x.movedim(1, 0), support.y.movedim(1, 0)).movedim(0, 1)
        near = (q - support.q).abs() < options.plane_inlier_ratio * support.q
        inlier = inlier.any(1, keepdim=True) & support.exists & near
    return _least_squares(support, inlier, options)


def _least_squares(support: _Support, inlier: Tensor, options: DenseOptions) -> _Planes:
    """The plane of the support ``inlier`` (B, S, N) bool. Gradient: of the plane to q."""
    n = inlier.sum(1).to(support.q)

    def mean(x: Tensor) -> Tensor:
        return _sums(torch.where(inlier, x, torch.zeros_like(x))) / n.clamp_min(1)

    x_0, y_0, q_0 = (mean(values) for values in (support.x.detach(), support.y.detach(), support.q))
    dx, dy, dq = support.x - x_0[:, None], support.y - y_0[:, None], support.q - q_0[:, None]
    xx, xy, yy, xq, yq = (mean(product) for product in (dx * dx, dx * dy, dy * dy, dx * dq, dy * dq))
    det = (xx * yy - xy * xy).clamp_min((options.plane_cell_px**2 / 12) ** 2)  # at least the scatter within one cell
    a, b = (yy * xq - xy * yq) / det, (xx * yq - xy * xq) / det
    residual = (a[:, None] * dx + b[:, None] * dy - dq).detach() / support.q.detach().clamp_min(MIN_PLANE_INVERSE_DEPTH)
    scale = 1 / (det * n.clamp_min(1))
    inverse = yy * scale, -xy * scale, xx * scale
    return _Planes(
        q_0=q_0,
        x_0=x_0,
        y_0=y_0,
        a=a,
        b=b,
        n=n,
        inverse=inverse,
        residual=mean(residual.square()).sqrt(),
        common=mean(support.variance),
    )


@torch.no_grad()
def _tested(planes: _Planes, support: _Support, shape: torch.Size, options: DenseOptions) -> tuple[Tensor, Tensor]:
    """Whether the plane of each cell holds, and its mean relative difference from those of the cells around: (B, rows,
    columns) each."""
    zero = torch.zeros_like(planes.q_0)
    q = planes.at(zero, zero)
    enough = (planes.n >= options.min_plane_support) & (q > MIN_PLANE_INVERSE_DEPTH)
    most = planes.n >= options.min_plane_share * support.exists.sum(1)
    sigma = options.plane_inlier_ratio / 3 * planes.leverage(zero, zero).sqrt()
    disagreement = _disagreement(planes, q, enough, shape, options)
    near = (sigma <= options.max_plane_sigma_rel) & (disagreement <= options.max_plane_disagreement)
    return (enough & most & near).view(shape), disagreement.view(shape)


@torch.no_grad()
def _is_refuted(planes: _Planes, support: _Support, reach: Tensor, options: DenseOptions) -> Tensor:
    """Whether the sensor's silence refutes the plane of each cell (B, N), as between a foreground and a background.

    All cells of a ray before its first support are unanswered. Where the plane is within the ``reach`` (B,) m of the
    sensor in the last of them, the sensor would have returned.
    """
    first = slice(None, None, options.plane_ray_support)
    x, y, q, exists = (z[:, first].movedim(1, 0) for z in (support.x, support.y, support.q, support.exists))
    on_plane = exists & ((planes.at(x, y) - q).abs() < options.plane_inlier_ratio * q)
    distance = (x.square() + y.square()).sqrt()
    before = 1 - options.plane_cell_px / distance.clamp_min(options.plane_cell_px)
    refuted = on_plane & (planes.at(before * x, before * y) * reach[:, None] > 1)
    return refuted.sum(0) > options.max_refuted_rays * on_plane.sum(0)


def _disagreement(planes: _Planes, q: Tensor, enough: Tensor, shape: torch.Size, options: DenseOptions) -> Tensor:
    """Mean relative difference (B, N) of the inverse depths q (B, N) of cells from those by planes of cells around."""
    radius, side = options.plane_neighbours, options.plane_cell_px
    rows, columns = shape[1:]
    q = q.view(shape).clamp_min(MIN_PLANE_INVERSE_DEPTH)
    a, b, own, valid = (F.pad(x.view(shape), (radius,) * 4) for x in (planes.a, planes.b, q, enough))
    total, count = torch.zeros_like(q), torch.zeros_like(q)
    for i in range(2 * radius + 1):
        for j in range(2 * radius + 1):
            place = slice(None), slice(i, i + rows), slice(j, j + columns)
            there = own[place] - side * (a[place] * (j - radius) + b[place] * (i - radius))
            share = (there / q - 1).abs().clamp_max(options.max_plane_difference)
            total = total + torch.where(valid[place], share, 0.0)
            count = count + valid[place].to(count)
    own_count = enough.view(shape).to(count)
    return (total / (count - own_count).clamp_min(1)).flatten(1)


def _at_pixels(
    planes: _Planes, disagreement: Tensor, shape: torch.Size, cells: torch.Size, options: DenseOptions
) -> tuple[Tensor, Tensor]:
    """Inverse depth and sigma / depth (B, h, w) of the planes of the cells at all pixels."""
    side = options.plane_cell_px

    def pixel(x: Tensor) -> Tensor:
        return _per_pixel(x.view(cells), shape, options)

    rows, columns = (
        torch.arange(n, device=disagreement.device).to(disagreement) % side - (side - 1) / 2 for n in shape[1:]
    )
    y, x = rows[:, None], columns
    at = _Planes(*(tuple(map(pixel, p)) if isinstance(p, tuple) else pixel(p) for p in planes))  # type: ignore[arg-type]
    with torch.no_grad():
        plane = (options.plane_inlier_ratio / 3) ** 2 / options.independent_support * at.leverage(x, y)
        common = options.common_sigma_ratio**2 * at.common
        relative = (at.residual.square() + plane + pixel(disagreement).square() + common).sqrt()
    return at.at(x, y), relative


def _per_pixel(x: Tensor, shape: torch.Size, options: DenseOptions) -> Tensor:
    """Values of cells (B, rows, columns) at their pixels (B, h, w)."""
    side = options.plane_cell_px
    return x.repeat_interleave(side, 1).repeat_interleave(side, 2)[:, : shape[1], : shape[2]]
