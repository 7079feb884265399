"""Pyramidal Lucas-Kanade: points of a source pyramid -> their displacements to a target pyramid, without gradients.

Alphabet: ``x`` a point of the first image (the source) and ``d`` its displacement to the second (the target), (2, M) px
of the level at hand, the M points of all pairs in one row; ``batch`` (M,) the pair a point belongs to; T the window at
x, J the target, g = (dT/dx, dT/dy), A = sum g gᵀ; ``moments`` (5 or 6, M): sum g T, A_xx, A_xy, A_yy and, where the
gain is estimated, sum T².

Cost. A Gauss-Newton step solves A step = sum g (J(d) - T). J between pixels is a weighted mean of J at
pixels, and the sum over the window is linear in J; so sum g J(d) is the same weighted mean of a few numbers
C[o] = sum_p g(p) J(p + o), o an offset in whole pixels. This *map* C is computed once for a small square of offsets, by
a depthwise convolution whose channels are the points. After that a step touches eight numbers per point, and no pixel.
Coarse levels only provide a start: there the points of a small *cell* of the image share one search.

The whole search has a compiled kernel.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry.checks import all_finite, is_static
from dhtorch.geometry.determinism import ELEMENTWISE_LANES, MAX_CHUNK_POINTS, chunk_size, round_up
from dhtorch.geometry.linalg import adjugate_2x2, determinant_2x2, eigenvalues_2x2
from dhtorch.geometry.patches import QUANTISATION_VARIANCE
from dhtorch.geometry.pyramid import GRAD_X_PLANE, GRAD_Y_PLANE, GREY_PLANE, OUTSIDE_MARGIN_PX, Pyramid
from dhtorch.ops.dispatch import operator

#: Width of a cell, px of its level: on coarse levels, which only provide the start of the next one, the points of a
#: cell share one search. Cells are nested, so that they share its start as well.
CELL_PX = 4

#: Finest level with cells, 0 = full resolution.
CELL_LEVEL = 2

#: Number of the step on a map, from 1, that is extrapolated to the limit of the steps (Aitken); finest level only.
AITKEN_STEP = 6

#: Limits of the ratio of successive steps in that extrapolation.
AITKEN_RATIO_RANGE = (-0.9, 0.9)

#: Factor on ``epsilon_px``, the step length at which a point has converged, on coarse levels.
COARSE_EPSILON_FACTOR = 4.0

#: Largest number of Gauss-Newton steps on one map.
STEPS_PER_MAP = 8

#: Radii of a point's successive maps on the top level, where the displacement is unknown and few cells are searched,
#: px. A map of radius r covers the offsets from -r to r + 1.
TOP_RADII = (2, 2, 2, 2)

#: Radii of the maps on the levels between, px.
MIDDLE_RADII = (1, 2, 2)

#: Radii of the maps on the finest level, px.
FINEST_RADII = (1, 2, 2, 2)

#: Limits of the gain between two windows, a ratio of contrasts.
CONTRAST_RATIO_RANGE = (0.2, 5.0)


class SearchOptions(NamedTuple):
    """Options of the search; see :func:`dhtorch.stages.track.lucas_kanade`."""

    window: int
    iterations: int
    epsilon_px: float
    min_eigenvalue: float
    normalise: str


class _Views(NamedTuple):
    """Two pyramids and the options of a search; see :func:`search_displacements`."""

    source: Pyramid
    target: Pyramid
    o: SearchOptions
    near_levels: int
    alike: bool


class _Pair(NamedTuple):
    """One level of two pyramids, the options of its search, and the bounds of its points."""

    source: Pyramid
    target: Pyramid
    o: SearchOptions
    level: int
    low: Tensor  # (2, 1) px of the level
    high: Tensor  # (2, 1) px of the level


class _Templates(NamedTuple):
    """The windows of image 0, which do not depend on image 1."""

    x: Tensor  # (2, M) px of the level
    batch: Tensor  # (M,)
    moments: Tensor  # (5 or 6, M) see the alphabet
    A_inv: Tensor  # (2, 2, M)


class _State(NamedTuple):
    """State of the search for every point."""

    d: Tensor  # (2, M) px of the level
    active: Tensor  # (M,) the search goes on
    on_map: Tensor  # (M,) the point lies within its map


def search_displacements(
    source: Pyramid,
    target: Pyramid,
    o: SearchOptions,
    x: Tensor,  # (2, M) px, M a multiple of LANES
    d: Tensor,  # (2, M) px, the start
    batch: Tensor,  # (M,)
    *,
    known: Tensor,  # (M,) bool, other points are not searched for
    begun: Tensor,  # (M,) bool
    near_levels: int,
    alike: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Points x and start d -> displacements (2, M), whether they are valid (M,), and A (3, M) of the finest level.

    Coarse to fine. ``alike``: all ``d`` are equal, so that the points of a cell may share a search. ``begun``: points
    whose ``d`` is within the range of the finest ``near_levels`` levels; they skip the coarser ones.
    """
    views = _Views(source, target, o, near_levels, alike)
    return _search(x.contiguous(), d.contiguous(), batch, known, begun, views=views)


def _search_kernel(
    x: Tensor, d: Tensor, batch: Tensor, known: Tensor, begun: Tensor, *, views: _Views
) -> tuple[Tensor, Tensor, Tensor]:
    source, target = views.source, views.target
    o = views.o
    displacement, A = d.new_empty(2, d.shape[-1]), d.new_empty(3, d.shape[-1])
    valid = torch.empty_like(known)
    torch.ops.dhtorch.lk_search.default(
        source=source.levels,
        target=target.levels,
        x=x,
        d=d,
        batch=batch,
        known=known,
        begun=begun,
        found=displacement,
        A=A,
        valid=valid,
        top_radii=TOP_RADII,
        middle_radii=MIDDLE_RADII,
        finest_radii=FINEST_RADII,
        near_levels=views.near_levels,
        alike=views.alike,
        cell_px=CELL_PX,
        cell_level=CELL_LEVEL,
        window=o.window,
        iterations=o.iterations,
        steps_per_map=STEPS_PER_MAP,
        pad=source.pad,
        margin=OUTSIDE_MARGIN_PX,
        remove_bias=o.normalise != "none",
        estimate_gain=o.normalise == "gain_bias",
        epsilon=o.epsilon_px,
        coarse_epsilon=o.epsilon_px * COARSE_EPSILON_FACTOR,
        min_eigenvalue=o.min_eigenvalue,
        min_gain=CONTRAST_RATIO_RANGE[0],
        max_gain=CONTRAST_RATIO_RANGE[1],
        aitken_step=AITKEN_STEP,
        min_ratio=AITKEN_RATIO_RANGE[0],
        max_ratio=AITKEN_RATIO_RANGE[1],
    )
    return displacement, valid, A


@operator(
    kernel=_search_kernel,
    dtypes={
        "x": torch.float32,
        "d": torch.float32,
        "batch": torch.int64,
        "known": torch.bool,
        "begun": torch.bool,
    },
    nested=lambda *_, views: (*views.source.levels, *views.target.levels),
)
def _search(
    x: Tensor, d: Tensor, batch: Tensor, known: Tensor, begun: Tensor, *, views: _Views
) -> tuple[Tensor, Tensor, Tensor]:
    """:func:`search_displacements` of contiguous points."""
    source, target, o, near_levels, alike = views
    top = min(len(source.levels), len(target.levels)) - 1
    coarse_options = o._replace(epsilon_px=o.epsilon_px * COARSE_EPSILON_FACTOR)

    def start(level: int, x: Tensor, d: Tensor, batch: Tensor, begun: Tensor | None = None) -> Tensor:
        """Start of the search on ``level``: the displacement of the level above."""
        if level == top:
            return d * 0.5**top
        if begun is not None and level + 1 >= near_levels:
            return masked_apply(~begun, lambda *cold: (start(level, *cold),), (d * 0.5**level,), (x, d, batch))[0]
        if alike and level + 1 >= CELL_LEVEL:
            return _search_by_cell(source, level + 1, partial(coarse, level + 1, begun=None), x, d, batch) * 2
        return coarse(level + 1, x, d, batch, begun) * 2

    def coarse(level: int, x: Tensor, d: Tensor, batch: Tensor, begun: Tensor | None) -> Tensor:
        pair = _Pair(source, target, coarse_options, level, *target.bounds(level))
        radii = TOP_RADII if level == top or level + 1 == near_levels else MIDDLE_RADII
        pixel = source.corner(level, x * 0.5**level + 0.5)  # interpolated on the finest level only
        all_known = torch.ones_like(batch, dtype=torch.bool)
        return _search_level(pair, radii, pixel, start(level, x, d, batch, begun), batch, all_known)[0]

    pair = _Pair(source, target, o, 0, *target.bounds(0))
    d, on_map, textured, A = _search_level(
        pair, FINEST_RADII if top else TOP_RADII, x, start(0, x, d, batch, begun), batch, known
    )
    return d, known & textured & on_map & is_between(x + d, pair.low, pair.high), A


def lucas_kanade_step(
    source: Pyramid, target: Pyramid, o: SearchOptions, x: Tensor, x_1: Tensor, batch: Tensor
) -> tuple[Tensor, Tensor]:
    """One differentiable Gauss-Newton step (2, M) on the finest level, to be subtracted from ``x_1``; and whether each
    window is textured (M,)."""
    G = _remove_gain_bias(source.windows(0, x, batch, o.window), o.normalise)
    J = target.windows(0, x_1, batch, o.window, (GREY_PLANE,))
    moments = _moments(G, o.normalise)
    A_inv, textured = _inverse(moments[2:5], o.min_eigenvalue * o.window**2)
    steps = _steps((_kernels(G, o.normalise) * J).sum(-1), moments, A_inv)
    return steps if o.normalise != "gain_bias" else steps[:2] / steps[2].clamp(*CONTRAST_RATIO_RANGE), textured


def squared_differences(
    source: Pyramid, target: Pyramid, o: SearchOptions, x: Tensor, d: Tensor, batch: Tensor
) -> Tensor:
    """Sum (M,) of squared grey differences between the windows at ``x`` and ``x + d``, after normalisation."""
    return _squared_differences(
        source.levels[0],
        target.levels[0],
        x.contiguous(),
        (x + d).contiguous(),
        batch,
        source=source,
        target=target,
        o=o,
    )


def _squared_differences_kernel(
    level_0: Tensor,
    level_1: Tensor,
    x: Tensor,
    y: Tensor,
    batch: Tensor,
    *,
    source: Pyramid,
    target: Pyramid,
    o: SearchOptions,
) -> Tensor:
    sums = torch.empty_like(x[0])
    torch.ops.dhtorch.window_differences.default(
        source=level_0,
        target=level_1,
        x=x,
        y=y,
        batch=batch,
        sums=sums,
        window=o.window,
        pad=source.pad,
        margin=OUTSIDE_MARGIN_PX,
        remove_bias=o.normalise != "none",
        estimate_gain=o.normalise == "gain_bias",
        min_gain=CONTRAST_RATIO_RANGE[0],
        max_gain=CONTRAST_RATIO_RANGE[1],
    )
    return sums


@operator(
    kernel=_squared_differences_kernel,
    dtypes=dict.fromkeys(("level_0", "level_1", "x", "y"), torch.float32) | {"batch": torch.int64},
)
def _squared_differences(
    level_0: Tensor,
    level_1: Tensor,
    x: Tensor,
    y: Tensor,
    batch: Tensor,
    *,
    source: Pyramid,
    target: Pyramid,
    o: SearchOptions,
) -> Tensor:
    """:func:`squared_differences` between ``x`` and ``y`` (2, M) on the finest levels of the pyramids."""
    sums, size = [], chunk_size(MAX_CHUNK_POINTS, x)
    for p, q, b in zip(*(points.split(size, -1) for points in (x, y, batch)), strict=True):
        T = source.windows(0, p, b, o.window, (GREY_PLANE,))[0]
        J = target.windows(0, q, b, o.window, (GREY_PLANE,))[0]
        if o.normalise != "none":
            T, J = T - T.mean(-1, keepdim=True), J - J.mean(-1, keepdim=True)
        if o.normalise == "gain_bias":
            J = J / _gain((T * J).sum(-1), (T * T).sum(-1)).clamp(*CONTRAST_RATIO_RANGE)[:, None]
        sums.append((J - T).square().sum(-1))
    total = torch.cat(sums)
    return torch.where(total.isfinite(), total, torch.full_like(total, o.window**2))


def compare_windows(
    source: Pyramid,
    target: Pyramid,
    o: SearchOptions,
    uv_0: Tensor,  # (B, N, 2) px
    uv_1: Tensor,  # (B, N, 2) px
) -> tuple[Tensor, Tensor]:
    """Windows of two images around points -> rms grey difference (B, N), and whether the first has texture (B, N)."""
    B, N, _ = uv_0.shape
    fill = round_up(B * N) - B * N
    like = source.levels[0]
    x, x_1 = (F.pad(uv.to(like.dtype).permute(2, 0, 1).reshape(2, -1), (0, fill)) for uv in (uv_0, uv_1))
    batch = F.pad(torch.arange(B, device=x.device).repeat_interleave(N), (0, fill))
    rms = (squared_differences(source, target, o, x, x_1 - x, batch) / o.window**2).sqrt()
    size = chunk_size(MAX_CHUNK_POINTS, x)
    chunks = zip(*(y.split(size, -1) for y in (x, x_1, batch)), strict=True)
    textured = torch.cat([lucas_kanade_step(source, target, o, *chunk)[1] for chunk in chunks])
    return rms[: B * N].view(B, N), textured[: B * N].view(B, N)


def window_covariance(A: Tensor, variance: Tensor) -> Tensor:
    """Normal matrices A and variances s² -> covariances s² A⁻¹ (2, 2, M).

    The small eigenvalue of A is raised to 1e-5 of the large one, which float32 can represent.
    """
    a, b, c = torch.where(A.isfinite(), A, torch.zeros_like(A)).double()
    small, _ = eigenvalues_2x2(a, b, c)
    lift = (1e-5 * (a + c - small).clamp_min(1e-4) - small).clamp_min(0)
    a, c = a + lift, c + lift
    scale = variance.double().clamp_min(QUANTISATION_VARIANCE) / determinant_2x2(a, b, b, c)
    return (torch.stack(adjugate_2x2(a, b, b, c)) * scale).to(A.dtype).unflatten(0, (2, 2))


def masked_apply(
    wanted: Tensor, fn: Callable[..., Sequence[Tensor]], values: tuple[Tensor, ...], columns: tuple[Any, ...]
) -> Sequence[Tensor]:
    """``values`` (each (..., M)), replaced where ``wanted`` (M,) by the results of ``fn(*columns)``.

    ``columns`` are tensors (..., M) or trees of them. Where shapes may depend on values, ``fn`` gets only the wanted
    points, padded with copies of the first.
    """
    if is_static(wanted):
        return tuple(torch.where(wanted, new, old) for new, old in zip(fn(*columns), values, strict=True))
    index = wanted.nonzero()[:, 0]
    if not len(index):
        return values
    index = _pad_to_lanes(index)
    new = fn(*(_select_points(column, index) for column in columns))
    return tuple(old.index_copy(-1, index, n) for old, n in zip(values, new, strict=True))


def _select_points(column: Any, index: Tensor) -> Any:
    """The points ``index`` of a tensor (..., M), or of each tensor in a named tuple."""
    if isinstance(column, Tensor):
        return column.index_select(-1, index)
    return type(column)(*(_select_points(part, index) for part in column))


def _pad_to_lanes(index: Tensor) -> Tensor:
    """An index (M,) padded to whole ``ELEMENTWISE_LANES`` with copies of its first element."""
    return torch.cat([index, index[:1].expand(-len(index) % ELEMENTWISE_LANES)])


def _search_by_cell(
    pyramid: Pyramid, level: int, fn: Callable[..., Tensor], x: Tensor, d: Tensor, batch: Tensor
) -> Tensor:
    """``fn(x, d, batch)`` (2, M) at the centre of the cell of each point ``x`` (2, M); all ``d`` are equal.

    Where shapes may depend on values it is computed once per cell.
    """
    size = CELL_PX * 2**level
    H, W = pyramid.hw()
    columns, rows = -(-W // size), -(-H // size)
    low, high = pyramid.bounds()

    def search(cell: Tensor) -> Tensor:
        centre = torch.stack([cell % columns, cell // columns % rows]).to(x)
        centre = torch.minimum((centre + 0.5) * size, high - 0.5)
        return fn(centre, d[:, :1].expand_as(centre).contiguous(), cell // (rows * columns))

    column, row = ((x - low) / size).long().clamp_min(0)
    cell_of_point = (batch * rows + row.clamp_max(rows - 1)) * columns + column.clamp_max(columns - 1)
    if is_static(x):
        return search(cell_of_point)
    occupied = cell_of_point.new_zeros(len(pyramid.levels[0]) * rows * columns).index_fill_(0, cell_of_point, 1)
    cells = _pad_to_lanes(occupied.nonzero()[:, 0])
    return search(cells).index_select(-1, (occupied.cumsum(0) - 1)[cell_of_point])


def _search_level(
    pair: _Pair, radii: tuple[int, ...], x: Tensor, d: Tensor, batch: Tensor, known: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Search on one level -> displacement (2, M); whether each point lies within its last map and is textured (M,); A.

    All points are searched on a first map, those that have not converged on further ones. A is (3, M).
    """
    o = pair.o
    corner = pair.target.corner(pair.level, x + d) - radii[0]
    C, moments = _correlation_map(pair, radii[0], x, corner, batch)
    A_inv, textured = _inverse(moments[2:5], o.min_eigenvalue * o.window**2)
    windows = _Templates(x, batch, moments, A_inv)
    active = known & textured & is_between(x + d, pair.low, pair.high)
    first, *further = (min(STEPS_PER_MAP, o.iterations - k * STEPS_PER_MAP) for k in range(len(radii)))
    state = _on_map(pair, first, _steps(C, moments, A_inv), corner, x, _State(d, active, active))
    for radius, steps in zip(radii[1:], further, strict=True):
        if steps > 0:
            search_again = partial(_recentre_map, pair, radius, steps)
            state = _State(*masked_apply(state.active, search_again, state, (windows, state)))
    return state.d, state.on_map, textured, moments[2:5]


def _recentre_map(pair: _Pair, radius: int, steps: int, windows: _Templates, state: _State) -> _State:
    """:func:`_on_map` with a new map around the points' current positions; the windows' moments are reused."""
    x, batch, moments, A_inv = windows
    corner = pair.target.corner(pair.level, x + state.d) - radius
    C, _ = _correlation_map(pair, radius, x, corner, batch, moments)
    return _on_map(pair, steps, _steps(C, moments, A_inv), corner, x, state)


def _on_map(
    pair: _Pair,
    steps: int,
    field: Tensor,  # (2 or 3, n, n, M) see _steps
    corner: Tensor,  # (2, M) first pixel of the map in the target
    x: Tensor,  # (2, M)
    state: _State,
) -> _State:
    """The state after ``steps`` Gauss-Newton steps of the active points on one map.

    Beyond a map's border its field fades to zero, so that a point that leaves stays near it.
    """
    o, start = pair.o, x + state.d - corner
    p = start
    node = torch.arange(field.shape[1], dtype=p.dtype, device=p.device)[:, None]
    step = torch.zeros_like(p)
    for k in range(1, steps + 1):
        hat = torch.rsub((p[:, None] - node).abs_(), 1).clamp_min_(0)  # (2, n, M) bilinear weights, 1 - |p - node|
        previous, step = step, ((field * hat[0]).sum(2) * hat[1]).sum(1)
        if len(field) == 3:
            step = step[:2] / step[2].clamp(*CONTRAST_RATIO_RANGE)
        if k == AITKEN_STEP and k < steps and pair.level == 0:
            ratio = (step * previous).sum(0) / (previous * previous).sum(0).clamp_min(o.epsilon_px**2)
            step = torch.where(
                (step * step).sum(0) > o.epsilon_px**2, step / (1 - ratio.clamp(*AITKEN_RATIO_RANGE)), step
            )
        p = p - step
    p = torch.where(state.active & all_finite(p, 0), p, start)
    within = (p == p.clamp(0, field.shape[1] - 1.0)).all(0)
    unconverged = ~within | ((step * step).sum(0) > o.epsilon_px**2)
    active = state.active & unconverged & is_between(p, pair.low - corner, pair.high - corner)
    return _State(p + corner - x, active, within)


def _steps(C: Tensor, moments: Tensor, A_inv: Tensor) -> Tensor:
    """Correlations (K, ..., M) -> Gauss-Newton steps (2, ..., M), which are linear in them.

    With K = 3 the steps are those for equal contrast, and a third plane is the gain to divide them by.
    """
    shape = (2, *(1,) * (C.ndim - 2), C.shape[-1])
    change = C[:2] - moments[:2].view(shape)
    steps = A_inv[:, 0].view(shape) * change[0] + A_inv[:, 1].view(shape) * change[1]
    return steps if len(C) == 2 else torch.cat([steps, _gain(C[2:], moments[5])])


def _correlation_map(
    pair: _Pair, radius: int, x: Tensor, corner: Tensor, batch: Tensor, moments: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Windows at ``x`` (2, M) -> map (K, n, n, M) that begins at the target's pixels ``corner``, and their moments."""
    o, w = pair.o, pair.o.window
    side = w + 2 * radius + 1
    planes = (
        (GRAD_X_PLANE, GRAD_Y_PLANE)
        if moments is not None and o.normalise != "gain_bias"
        else (GRAD_X_PLANE, GRAD_Y_PLANE, GREY_PLANE)
    )
    first_0, fraction = pair.source.locate(pair.level, x, batch, w // 2, planes)
    first_1, _ = pair.target.locate(pair.level, corner + radius, batch, w // 2 + radius, (GREY_PLANE,))
    maps, sums, size = [], [], chunk_size(MAX_CHUNK_POINTS, x)
    for i, j, f in zip(*(y.split(size, -1) for y in (first_0, first_1, fraction)), strict=True):
        G = _remove_gain_bias(pair.source.read(pair.level, i, w, None if pair.level else f), o.normalise)
        if moments is None:
            sums.append(_moments(G, o.normalise))
        kernel = _kernels(G, o.normalise).reshape(-1, 1, w, w)
        J = pair.target.read(pair.level, j, side).repeat(1, len(kernel) // len(f[0]), 1).view(1, -1, side, side)
        maps.append(F.conv2d(J, kernel, groups=len(kernel)).unflatten(1, (-1, len(f[0])))[0])
    C = torch.cat(maps, 1).permute(0, 2, 3, 1).contiguous()
    return C, torch.cat(sums, -1) if moments is None else moments


def _remove_gain_bias(G: Tensor, normalise: str) -> Tensor:
    """Windows (3, M, w²) of g_x, g_y and T, made orthogonal to what ``normalise`` leaves free (bias, gain)."""
    if normalise == "none":
        return G
    G = G - G.mean(-1, keepdim=True)
    if normalise == "bias":
        return G
    g, T = G[:2], G[2:]
    energy = (T * T).sum(-1, keepdim=True)
    slope = (g * T).sum(-1, keepdim=True) / torch.where(energy > 0, energy, torch.ones_like(energy))
    return torch.cat([g - slope * T, T])


def _kernels(G: Tensor, normalise: str) -> Tensor:
    """The kernels (K, M, w²) that are correlated with J: g, and T where the gain is estimated."""
    return G if normalise == "gain_bias" else G[:2]


def _moments(G: Tensor, normalise: str) -> Tensor:
    """Sums over the windows (3, M, w²) of g_x, g_y and T: (5 or 6, M), see the alphabet."""
    last = 3 if normalise == "gain_bias" else 2
    return torch.cat([(G[:2] * G[2]).sum(-1), (G[:2] * G[0]).sum(-1), (G[1:last] * G[1:last]).sum(-1)])


def _gain(correlation: Tensor, energy: Tensor) -> Tensor:
    """Correlation of T with J and energy of T -> gain, the contrast of J over that of T; 1 where T is flat."""
    ratio = correlation / torch.where(energy > 0, energy, torch.ones_like(energy))
    return torch.where(energy > 0, ratio, torch.ones_like(ratio))


def _inverse(A: Tensor, min_eigenvalue: float) -> tuple[Tensor, Tensor]:
    """A (3, M) -> inverse (2, 2, M), zero where the small eigenvalue is not above the limit; and whether it is (M,)."""
    a, b, c = A.double()
    textured = eigenvalues_2x2(a, b, c)[0] > min_eigenvalue
    det = torch.where(textured, determinant_2x2(a, b, b, c), torch.ones_like(a))
    inverse = torch.stack(adjugate_2x2(a, b, b, c)) / det
    return torch.where(textured, inverse, torch.zeros_like(inverse)).to(A.dtype).unflatten(0, (2, 2)), textured


def is_between(x: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Whether points (2, M) lie between bounds, (M,); false for NaN."""
    return ((x >= low) & (x <= high)).all(0)
