"""Filters of a swept map by its neighbours, the picture and the sensor's returns, before map and returns are merged.

    swept map ─┐
    returns ───┼─ halo ─ fattened edges ─ seam ─ lines, specks ─ pinholes, gaps ─ swept map
    picture ───┘

A filter makes an answer UNCERTAIN, or answers an unanswered pixel from its neighbours on the same surface (FILLED);
every other pixel keeps its bits.

Alphabet: maps (B, h, w); q inverse depth (1/m), which is linear in the pixel on a plane. Windows are read at every
second pixel, in both directions, and only around the pixels in question.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.codes import Gate, Source
from dhtorch.geometry.checks import is_static
from dhtorch.geometry.components import small_components
from dhtorch.geometry.windows import window_extreme
from dhtorch.ops.dispatch import operator
from dhtorch.pipeline.dense_options import DEFAULT_DENSE_OPTIONS, DenseOptions
from dhtorch.records import DepthMap

#: Right, down, left and up: (rows, columns). Source: derived, the four neighbours.
_SIDES = ((0, 1), (1, 0), (0, -1), (-1, 0))

#: Directions in which the rim of a pinhole is looked for, each followed by its opposite.
#: Source: derived, the eight neighbours.
_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))

#: Least determinant of the normal equations of a plane through pixels; that of three corners of a square is 1.
#: Source: derived, determinants are whole numbers, and 0 where the pixels lie on a line.
_MIN_DETERMINANT = 0.5

#: Least inverse depth that a filled pixel divides by, 1/m. Source: derived, as that of the swept ones.
_MIN_INVERSE_DEPTH = 1e-9


#: Fields of a map that gates, filters and fills change, with their dtypes. Source: derived, all but the parts of sigma.
FIELD_DTYPES = dict.fromkeys(("depth", "sigma", "score"), torch.float32) | dict.fromkeys(
    ("source", "gate"), torch.int32
)


class SensorReturns(NamedTuple):
    """The sensor's returns at every pixel of a map, (B, h, w) each."""

    depth: Tensor  # m
    sigma: Tensor  # m
    confidence: Tensor  # in [0, 1]
    usable: Tensor  # bool


class _Known(NamedTuple):
    """The merged map in inverse depth, (B, h, w) each; 0 where it is unanswered."""

    q: Tensor  # 1/m
    sigma: Tensor  # 1/m
    usable: Tensor  # bool, a return
    swept: Tensor  # bool, a swept depth and no return

    @property
    def answered(self) -> Tensor:
        """(B, h, w) bool: a return or a swept depth."""
        return self.usable | self.swept

    def without(self, which: Tensor) -> "_Known":
        """The map without the swept depths ``which`` (B, h, w) bool."""
        return _Known(
            self.q.masked_fill(which, 0.0), self.sigma.masked_fill(which, 0.0), self.usable, self.swept & ~which
        )


def map_fields(of: DepthMap) -> tuple[Tensor, ...]:
    """The fields :data:`FIELD_DTYPES` of a map."""
    return tuple(getattr(of, name) for name in FIELD_DTYPES)


def with_fields(of: DepthMap, fields: Sequence[Tensor]) -> DepthMap:
    """The map with other fields :data:`FIELD_DTYPES`; its other fields stay."""
    return of.replace(**dict(zip(FIELD_DTYPES, fields, strict=True)))


def copy_fields(tensors: Sequence[Tensor]) -> list[Tensor]:
    """Contiguous copies of the first tensors, the fields of a map, for kernels that work in place."""
    return [x.clone(memory_format=torch.contiguous_format) for x in tensors[: len(FIELD_DTYPES)]]


def fill_fields(of: DepthMap, where: Tensor, depth: Tensor, sigma: Tensor, relative: Tensor) -> tuple[Tensor, ...]:
    """The fields of a map answered (FILLED) ``where`` (B, h, w) bool with depth and sigma (B, h, w) m; ``relative``
    (B, h, w) is sigma / depth."""
    return (
        torch.where(where, depth, of.depth),
        torch.where(where, sigma, of.sigma),
        torch.where(where, 0.1 / (0.1 + relative), of.score),
        of.source.masked_fill(where, Source.FILLED),
        of.gate.masked_fill(where, Gate.ANSWER),
    )


def filter_map(
    swept: DepthMap,
    returns: SensorReturns,
    grey: Tensor,
    sparse: Tensor | None = None,
    options: DenseOptions = DEFAULT_DENSE_OPTIONS,
) -> DepthMap:
    """The swept map without halos, seams, lines one pixel wide and specks, its pinholes filled.

    Args:
        swept: map (B, h, w) before the merge.
        returns: of the same pixels.
        grey: (B, h, w) in [0, 1], the picture at the same pixels.
        sparse: (B,) bool, whether the returns are sparse: then a missing one is no evidence.
        options: tuning constants.

    Gradient: to depths that are kept; filled ones carry none.
    Cost: reads windows of some hundred pixels around the pixels beside depth steps and in pinholes, and makes
    ``speck_px`` passes over the map.
    """
    # Depth (B,) m to which the sensor returns, by every ``reach_stride_px``-th pixel; 0 without returns
    usable, depth = (v.flatten(1)[:, :: options.reach_stride_px] for v in (returns.usable, returns.depth.detach()))
    depth = torch.where(usable, depth, torch.inf).sort(-1).values
    n = usable.sum(-1)
    rank = (options.reach_quantile * (n - 1).clamp_min(0)).long()
    reach = torch.where(n > 0, depth.gather(-1, rank[:, None])[:, 0], 0.0)[:, None, None]
    within = returns.usable & (returns.depth.detach() < options.halo_reach * reach)
    within = within if sparse is None else within & ~sparse[:, None, None]
    sensed = returns.depth, returns.sigma, returns.usable, within
    return with_fields(swept, _filter(*map_fields(swept), *sensed, grey.detach(), options=options))


#: Fields of :class:`DenseOptions` that the kernel reads, in its order. Source: derived, its declaration.
_KERNEL_OPTIONS = (
    *("halo_radius_px", "background_radius_px", "speck_px", "hole_radius_px", "max_gap_px", "min_rim_pixels"),
    *("step_ratio", "step_sigmas", "grey_similarity", "fattened_ratio", "seam_sigmas", "seam_ratio"),
    *("same_surface_ratio", "same_surface_sigmas", "rim_ratio"),
)


def _filter_kernel(*maps: Tensor, options: DenseOptions) -> tuple[Tensor, ...]:
    filtered = copy_fields(maps)
    others = [x.contiguous() for x in maps[len(filtered) :]]
    limits = [getattr(options, name) for name in _KERNEL_OPTIONS]
    torch.ops.dhtorch.filter_map.default(*filtered, *others, *limits, _MIN_DETERMINANT, _MIN_INVERSE_DEPTH)  # in place
    return tuple(filtered)


_FILTER_DTYPES = (
    FIELD_DTYPES
    | dict.fromkeys(("near_depth", "near_sigma"), torch.float32)
    | dict.fromkeys(("usable", "within"), torch.bool)
    | {"grey": torch.float32}
)


@operator(kernel=_filter_kernel, dtypes=_FILTER_DTYPES, any_layout=tuple(_FILTER_DTYPES))
def _filter(*maps: Any, options: DenseOptions) -> tuple[Tensor, ...]:
    """:func:`filter_map` of the fields of a swept map, of the returns, of those ``within`` the reach, and a picture."""
    swept, (near_depth, near_sigma, usable, within, grey) = DepthMap(*maps[:5]), maps[5:]
    before = known = _known(swept, SensorReturns(near_depth, near_sigma, torch.zeros_like(near_sigma), usable))
    known = known.without(_halo(known, within, options))
    known = known.without(_fattened(known, grey, options))
    known = known.without(_torn(known, grey, options))
    known = known.without(_unsupported(known, options))
    # The map with answers ``which`` (B, h, w) bool UNCERTAIN
    which = before.swept & ~known.swept
    nan = torch.full_like(swept.depth, torch.nan)
    swept = swept.replace(
        depth=torch.where(which, nan, swept.depth),
        sigma=torch.where(which, nan, swept.sigma),
        score=swept.score.masked_fill(which, 0.0),
        source=swept.source.masked_fill(which, Source.NONE),
        gate=swept.gate.masked_fill(which, Gate.UNCERTAIN),
    )
    where, q, sigma = _fill(known, within, options)
    depth = 1 / q
    return fill_fields(swept, where, depth, sigma * depth.square(), sigma * depth)


@torch.no_grad()
def _known(swept: DepthMap, returns: SensorReturns) -> _Known:
    usable, keep = returns.usable, swept.keep & ~returns.usable
    depth = torch.where(usable, returns.depth.to(swept.depth), torch.where(keep, swept.depth, torch.inf))
    sigma = torch.where(usable, returns.sigma.to(swept.sigma), torch.where(keep, swept.sigma, 0.0))
    q = 1 / depth
    return _Known(q, sigma * q.square(), usable, keep)


def _halo(known: _Known, within: Tensor, options: DenseOptions) -> Tensor:
    """Swept pixels (B, h, w) bool at the depth of returns ``within`` the reach beside them, without a return.

    A window that holds the edge of a foreground is matched at the foreground's depth on both sides of the edge. Where
    the sensor reaches it would return from there, so its silence refutes the depth: if something farther is beside the
    pixel, or if the unanswered strip is no wider than such windows make it. A gap between two returns is no such strip.
    """
    q, _, usable, swept = known
    r, ratio = options.halo_radius_px, options.step_ratio
    near = swept & window_extreme(within, r, torch.logical_or)
    beside = _has_neighbour(q, near, torch.where(within, q, 0.0), r, ratio)
    farthest = window_extreme(torch.where(swept, q, torch.inf), options.background_radius_px, torch.minimum)
    goes_on = _has_neighbour(q, beside, torch.where(swept & ~beside, q, 0.0), r, ratio)
    return beside & ((farthest * ratio < q) | ~(goes_on | _in_gap(usable)))


def _has_neighbour(q: Tensor, which: Tensor, of: Tensor, radius: int, ratio: float) -> Tensor:
    """Pixels ``which`` (B, h, w) bool with one of ``of`` (B, h, w) 1/m, 0 = none, at their depth in the window."""
    b, y, x = _pixels(which)
    padded, own = F.pad(of, (radius,) * 4), q[b, y, x]
    low, high = own / ratio, own * ratio
    between = torch.zeros_like(own, dtype=torch.bool)
    for dy, dx in _window(radius):
        other = padded[b, y + dy, x + dx]
        between |= (other > low) & (other < high)
    out = torch.zeros_like(which)
    out[b, y, x] = between
    return out & which


def _pixels(mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Indices of the pixels of a mask (B, h, w); of all pixels where values must not be read."""
    if is_static(mask):
        axes = (torch.arange(n, device=mask.device) for n in mask.shape)
        b, y, x = (axis.flatten() for axis in torch.meshgrid(*axes, indexing="ij"))
    else:
        b, y, x = mask.nonzero(as_tuple=True)
    return b, y, x


def _fattened(known: _Known, grey: Tensor, options: DenseOptions) -> Tensor:
    """Swept pixels (B, h, w) bool beside something farther, which they resemble more than their own surface.

    Compared are mean similarities, 1 / (1 + (difference of grey values / ``grey_similarity``)²), to answered pixels of
    the window at the pixel's depth or nearer, and to the farther ones.
    """
    q, sigma, _, swept = known
    r, ratio = options.halo_radius_px, options.step_ratio
    farthest = window_extreme(torch.where(swept, q, torch.inf), r, torch.minimum)
    step = torch.maximum(q - q / ratio, options.step_sigmas * sigma)
    edge = swept & (q - farthest > step)
    b, y, x = _pixels(edge)
    padded = [F.pad(v, (r,) * 4) for v in (q, grey)]
    rows, columns = padded[0].shape[1:]
    depths, shades = (v.flatten() for v in padded)
    first = (b * rows + y) * columns + x  # upper left pixel of the window
    own, shade = q[b, y, x], grey[b, y, x]
    near, far, n_near, n_far = (torch.zeros_like(own) for _ in range(4))
    for dy, dx in _window(r):
        place = first + (dy * columns + dx)
        other = depths[place]
        alike = 1 / (1 + ((shades[place] - shade) / options.grey_similarity).square())
        scaled = other * ratio
        is_near, is_far = scaled > own, (other > 0) & (scaled < own)
        near, n_near = near + alike * is_near, n_near + is_near
        far, n_far = far + alike * is_far, n_far + is_far
    out = torch.zeros_like(swept)
    out[b, y, x] = far * n_near > options.fattened_ratio * near * n_far
    return out & edge


def _window(radius: int) -> Iterator[tuple[int, int]]:
    """Every second pixel of the window, in rows and columns of a map that is padded by its radius."""
    for dy in range(0, 2 * radius + 1, 2):
        yield from ((dy, dx) for dx in range(0, 2 * radius + 1, 2))


def _torn(known: _Known, grey: Tensor, options: DenseOptions) -> Tensor:
    """Swept pixels (B, h, w) bool within two pixels of a return, without an edge of the picture between, that are
    inconsistent with it: both would be one surface.

    Depths that differ by more than ``seam_ratio`` are those of two surfaces that look alike.
    """
    q, sigma, usable, swept = known
    out = torch.zeros_like(swept)
    for step in (1, 2):
        for dy, dx in _SIDES:
            other, other_sigma, other_grey = (_shift(v, step * dy, step * dx) for v in (q, sigma, grey))
            differ = (q - other).abs()
            torn = differ.square() > options.seam_sigmas**2 * (sigma.square() + other_sigma.square())
            one = torch.maximum(q, other) < options.seam_ratio * torch.minimum(q, other)
            alike = (grey - other_grey).abs() < options.grey_similarity
            out |= _shift(usable, step * dy, step * dx) & torn & one & alike
    return out & swept


def _unsupported(known: _Known, options: DenseOptions) -> Tensor:
    """Swept pixels (B, h, w) bool in lines one pixel wide, and in specks that remain without those."""
    # Whether a pixel and its right, its lower neighbour are answered on one surface: (B, h, w-1), (B, h-1, w)
    q, answered = known.q, known.answered
    limit = torch.maximum(options.same_surface_ratio * q, options.same_surface_sigmas * known.sigma)
    right = (q[..., 1:] - q[..., :-1]).abs() <= torch.minimum(limit[..., 1:], limit[..., :-1])
    down = (q[:, 1:] - q[:, :-1]).abs() <= torch.minimum(limit[:, 1:], limit[:, :-1])
    right, down = right & answered[..., 1:] & answered[..., :-1], down & answered[:, 1:] & answered[:, :-1]
    line = known.swept & ~_in_block(right[:, 1:] & right[:, :-1] & down[..., 1:] & down[..., :-1])
    speck = small_components(known.answered & ~line, options.speck_px, same=(right, down))
    return line | (speck & known.swept)


def _in_block(corner: Tensor) -> Tensor:
    """Pixels (B, h, w) bool in any of the 2 × 2 blocks (B, h - 1, w - 1) bool, by their upper left pixels."""
    padded = F.pad(corner, (1, 1, 1, 1))
    return padded[:, 1:, 1:] | padded[:, 1:, :-1] | padded[:, :-1, 1:] | padded[:, :-1, :-1]


def _fill(known: _Known, within: Tensor, options: DenseOptions) -> tuple[Tensor, Tensor, Tensor]:
    """Unanswered pixels (B, h, w) bool in pinholes, and in gaps amid answers, whose rim lies on one plane; its inverse
    depth there and sigma, the rim's mean plus the spread about the plane.

    The rim of a pixel are the answered pixels that are met first in eight directions. The sensor's silence refutes the
    plane if some of them are returns ``within`` its reach and the gap is wider than ``max_gap_px`` in all directions.
    """
    r, answered = options.hole_radius_px, known.answered
    open_ = (_enclosed(answered, r) | _in_gap(answered)) & ~answered
    b, y, x = _pixels(open_)
    padded, near, values, sigmas = (F.pad(v, (r,) * 4) for v in (answered, within, known.q, known.sigma))
    rim, widths, total_sigma, refuted = [], [], torch.zeros_like(known.q[b, y, x]), torch.zeros_like(answered[b, y, x])
    for dy, dx in _DIRECTIONS:
        steps = torch.zeros_like(x)
        for k in range(r, 0, -1):
            steps = torch.where(padded[b, y + (r + k * dy), x + (r + k * dx)], k, steps)
        at = b, y + r + steps * dy, x + r + steps * dx  # the pixel itself, 0, where none is met
        rim.append(_RimPoint((steps > 0).to(values), (steps * dx).to(values), (steps * dy).to(values), values[at]))
        total_sigma = total_sigma + sigmas[at]
        refuted |= near[at]
        widths.append(torch.where(steps > 0, steps, options.max_gap_px + 1))
    narrowest = torch.stack([one + other - 1 for one, other in zip(widths[::2], widths[1::2], strict=True)]).amin(0)
    refuted &= narrowest > options.max_gap_px
    q, distance = _fit_plane(rim)
    n = sum((point.met for point in rim), torch.zeros_like(q)).clamp_min(1)
    sigma = total_sigma / n
    limit = torch.maximum(options.rim_ratio * q, options.same_surface_sigmas * sigma)
    fits = ~refuted & (n >= options.min_rim_pixels) & (q > _MIN_INVERSE_DEPTH) & (distance.amax(0) <= limit)
    where, filled, spread = torch.zeros_like(answered), torch.ones_like(known.q), torch.zeros_like(known.q)
    where[b, y, x] = fits
    where &= open_
    unanswered = ~(answered | where)
    for dy, dx in _SIDES:  # beside a pixel that stays unanswered it would be the edge of an island in a larger hole
        where &= ~_shift(unanswered, dy, dx)
    both = answered | where
    where &= _in_block(both[:, 1:, 1:] & both[:, 1:, :-1] & both[:, :-1, 1:] & both[:, :-1, :-1])
    filled[b, y, x] = torch.where(fits, q, 1.0)
    square = sum((one.square() for one in distance), torch.zeros_like(q))
    spread[b, y, x] = (sigma + (square / n).sqrt()).to(spread)
    return where, filled, spread


class _RimPoint(NamedTuple):
    """One rim pixel of each of K pixels, (K,) each; all 0 where there is none."""

    met: Tensor  # 0 or 1
    x: Tensor  # px, from the pixel
    y: Tensor
    q: Tensor  # 1/m


def _fit_plane(rim: list[_RimPoint]) -> tuple[Tensor, Tensor]:
    """Rims -> inverse depth (K,) 1/m of their planes at the pixels, and distances (P, K) 1/m of the points from them.

    NaN where the points do not determine a plane. Written out as sums: rounding depends on no other pixel.
    """
    n, x, y, xx, xy, yy, q, xq, yq = (torch.zeros_like(rim[0].q) for _ in range(9))
    for met, u, v, value in rim:
        n, x, y, q = n + met, x + u, y + v, q + value
        xx, xy, yy, xq, yq = xx + u * u, xy + u * v, yy + v * v, xq + u * value, yq + v * value
    # cofactors of the normal equations of q = a + b x + c y
    aa, ab, ac = xx * yy - xy * xy, xy * y - x * yy, x * xy - xx * y
    bb, bc, cc = n * yy - y * y, x * y - n * xy, n * xx - x * x
    det = n * aa + x * ab + y * ac
    scale = 1 / torch.where(det > _MIN_DETERMINANT, det, torch.nan)
    a, b, c = ((i * q + j * xq + k * yq) * scale for i, j, k in ((aa, ab, ac), (ab, bb, bc), (ac, bc, cc)))
    return a, torch.stack([(value - (a * met + b * u + c * v)).abs() for met, u, v, value in rim])


def _enclosed(mask: Tensor, radius: int) -> Tensor:
    """Pixels (B, h, w) bool with one of the mask within ``radius`` px on each of the four sides."""
    out = torch.ones_like(mask)
    for dy, dx in _SIDES:
        side = torch.zeros_like(mask)
        for k in range(1, radius + 1):
            side |= _shift(mask, k * dy, k * dx)
        out &= side
    return out


def _in_gap(mask: Tensor) -> Tensor:
    """Pixels (B, h, w) bool between two of the mask, one or two pixels wide, in their row or column."""
    out = torch.zeros_like(mask)
    for dy, dx in _SIDES:
        out |= _shift(mask, dy, dx) & (_shift(mask, -dy, -dx) | _shift(mask, -2 * dy, -2 * dx))
    return out


def _shift(x: Tensor, rows: int, columns: int) -> Tensor:
    """Map (B, h, w) -> the value so many rows below and columns to the right of each pixel; 0 outside."""
    h, w = x.shape[1:]
    margin = max(abs(rows), abs(columns))
    return F.pad(x, (margin,) * 4)[:, margin + rows : margin + rows + h, margin + columns : margin + columns + w]
