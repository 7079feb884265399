"""Filters of a swept map by its neighbours and by the sensor's returns, before both are merged.

    swept map ─ halo ─ seam ─ lines, specks ─ pinholes, gaps amid returns ─ swept map
    returns ─────┴───────┴──────────┴────────────────┘

A filter makes an answer UNCERTAIN, widens its sigma, or answers an unanswered pixel from its neighbours (FILLED); every
other pixel keeps its bits.

Alphabet: maps (B, h, w); q inverse depth (1/m): linear in the pixel on a plane.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.codes import Gate, Source
from dhtorch.geometry.components import small_components
from dhtorch.geometry.windows import window_extreme
from dhtorch.pipeline.dense_options import DEFAULT_DENSE_OPTIONS, DenseOptions
from dhtorch.records import DepthMap


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
    answered: Tensor  # bool, a return or a swept depth


def filter_map(
    swept: DepthMap,
    returns: SensorReturns,
    reach: Tensor,
    sparse: Tensor | None = None,
    options: DenseOptions = DEFAULT_DENSE_OPTIONS,
) -> DepthMap:
    """The swept map without halos, seams, lines one pixel wide and specks; pinholes of one surface are filled.

    Args:
        swept: map (B, h, w) before the merge.
        returns: of the same pixels.
        reach: (B,) m, depth to which the sensor returns.
        sparse: (B,) bool, whether the returns are sparse: then silence is no evidence, and gaps are no pinholes.
        options: tuning constants.

    Gradient: of depths that are kept; filled ones carry none.
    """
    dense = torch.ones_like(reach, dtype=torch.bool) if sparse is None else ~sparse
    with torch.no_grad():
        halo = _halo(_known(swept, returns), reach, dense, options)
        swept = _silence(swept, halo)
        swept = _silence(swept, _unsupported(_known(swept, returns), options))
        filled = _fill(_known(swept, returns), dense, options)
    return _answer(swept, *filled)


def _known(swept: DepthMap, returns: SensorReturns) -> _Known:
    keep = swept.keep & ~returns.usable
    depth = torch.where(returns.usable, returns.depth.to(swept.depth), torch.where(keep, swept.depth, torch.inf))
    sigma = torch.where(returns.usable, returns.sigma.to(swept.sigma), torch.where(keep, swept.sigma, 0.0))
    q = 1 / depth
    return _Known(q, sigma * q.square(), returns.usable, keep | returns.usable)


def _silence(swept: DepthMap, which: Tensor) -> DepthMap:
    """The map with pixels ``which`` (B, h, w) UNCERTAIN."""
    which = which & swept.keep
    nan = torch.full_like(swept.depth, torch.nan)
    return swept.replace(
        depth=torch.where(which, nan, swept.depth),
        sigma=torch.where(which, nan, swept.sigma),
        score=swept.score.masked_fill(which, 0.0),
        source=swept.source.masked_fill(which, Source.NONE),
        gate=swept.gate.masked_fill(which, Gate.UNCERTAIN),
    )


def _halo(known: _Known, reach: Tensor, dense: Tensor, options: DenseOptions) -> Tensor:
    """Swept pixels (B, h, w) bool at the depth of returns beside them, in front of something farther.

    Where the sensor reaches it would return from such a foreground; its silence there refutes the depth. A window that
    holds the edge of the foreground is matched at the foreground's depth on both sides of the edge.
    """
    q, _, usable, answered = known
    swept = answered & ~usable
    within = q * (options.halo_reach * reach)[:, None, None] > 1
    near = torch.where(usable, q, 0.0)
    beside = window_extreme(near, options.halo_radius_px, torch.maximum) * options.step_ratio > q
    far = torch.where(swept, q, torch.inf)
    background = window_extreme(far, options.background_radius_px, torch.minimum) * options.step_ratio < q
    return swept & within & beside & background & dense[:, None, None]


def _same_surface(known: _Known, options: DenseOptions) -> tuple[Tensor, Tensor]:
    """Whether a pixel and its right, its lower neighbour are answered on one surface: (B, h, w-1), (B, h-1, w) bool."""

    def same(a: Tensor, b: Tensor) -> Tensor:
        return (a - b).abs() <= options.same_surface_ratio * torch.minimum(a, b)

    q, answered = known.q, known.answered
    right = answered[..., 1:] & answered[..., :-1] & same(q[..., 1:], q[..., :-1])
    return right, answered[:, 1:] & answered[:, :-1] & same(q[:, 1:], q[:, :-1])


def _unsupported(known: _Known, options: DenseOptions) -> Tensor:
    """Swept pixels (B, h, w) bool in lines one pixel wide, and in specks that remain without those."""
    right, down = _same_surface(known, options)
    block = right[:, 1:] & right[:, :-1] & down[..., 1:] & down[..., :-1]
    padded = F.pad(block, (1, 1, 1, 1))
    line = ~(padded[:, 1:, 1:] | padded[:, 1:, :-1] | padded[:, :-1, 1:] | padded[:, :-1, :-1])
    line &= ~known.usable
    rest = known.answered & ~line
    speck = small_components(rest, options.speck_px, same=(right, down)) & ~known.usable
    return (line & known.answered) | speck


class _Filled(NamedTuple):
    """Pixels with an interpolated depth."""

    where: Tensor  # (B, h, w) bool
    depth: Tensor  # (B, h, w) m
    sigma: Tensor  # (B, h, w) m


def _fill(known: _Known, dense: Tensor, options: DenseOptions) -> _Filled:
    """Depth of pinholes, and of gaps of one pixel amid returns, whose rim lies on one plane."""
    r, margin = options.rim_radius_px, options.speck_px
    silent = F.pad(~known.answered, (margin,) * 4, value=True)
    hole = small_components(silent, margin)[:, margin:-margin, margin:-margin]
    usable = known.usable
    gap = ~known.answered & (_between(usable, 1) | _between(usable, 2))
    hole = (hole | gap) & dense[:, None, None]
    rim = known.answered & window_extreme(hole, 1, torch.logical_or)
    b, y, x = hole.nonzero(as_tuple=True)
    padded = [F.pad(torch.where(rim, v, 0.0), (r,) * 4) for v in (known.q, known.sigma)]
    weight = F.pad(rim, (r,) * 4).to(known.q)
    offsets = [(dy, dx) for dy in range(-r, r + 1) for dx in range(-r, r + 1)]

    def at(values: Tensor, dy: int, dx: int) -> Tensor:
        return values[b, y + (r + dy), x + (r + dx)]

    sums = [torch.zeros_like(x, dtype=known.q.dtype) for _ in range(10)]
    n, sx, sy, sxx, sxy, syy, sq, sxq, syq, ss = sums
    for dy, dx in offsets:
        w, q = at(weight, dy, dx), at(padded[0], dy, dx)
        n += w
        ss += at(padded[1], dy, dx)
        for total, value, factor in (
            (sx, w, dx),
            (sy, w, dy),
            (sxx, w, dx * dx),
            (sxy, w, dx * dy),
            (syy, w, dy * dy),
            (sxq, q, dx),
            (syq, q, dy),
            (sq, q, 1),
        ):
            if factor:
                total += value * factor
    # normal equations of q = a + b dx + c dy, by cofactors
    c_xx, c_xy, c_yy = syy * n - sy * sy, sx * sy - sxy * n, sxx * n - sx * sx
    c_nx, c_ny = sxy * sy - sx * syy, sxy * sx - sxx * sy
    c_nn = sxx * syy - sxy * sxy
    det = c_nn * n + c_nx * sx + c_ny * sy
    inv = 1 / det.clamp_min(1e-6)
    a0 = (c_nn * sq + c_nx * sxq + c_ny * syq) * inv
    a1 = (c_nx * sq + c_xx * sxq + c_xy * syq) * inv
    a2 = (c_ny * sq + c_xy * sxq + c_yy * syq) * inv
    worst, square = torch.zeros_like(a0), torch.zeros_like(a0)
    for dy, dx in offsets:
        residual = (at(padded[0], dy, dx) - (a0 + a1 * dx + a2 * dy)) * at(weight, dy, dx)
        worst = torch.maximum(worst, residual.abs())
        square += residual * residual
    n_1 = n.clamp_min(1)
    sigma = ss / n_1 + (square / n_1).sqrt()
    fits = (det > 0.5) & (n >= options.min_rim_pixels) & (a0 > 0) & (worst <= options.rim_ratio * a0)
    where = torch.zeros_like(hole)
    depth, spread = torch.zeros_like(known.q), torch.zeros_like(known.q)
    where[b, y, x] = fits
    depth[b, y, x] = 1 / a0.clamp_min(1e-9)
    spread[b, y, x] = sigma / a0.clamp_min(1e-9).square()
    return _Filled(where, depth, spread)


def _between(mask: Tensor, step: int) -> Tensor:
    """Pixels (B, h, w) with pixels of the mask on two opposite sides, ``step`` and one px away, or one px and ``step``."""
    m = F.pad(mask, (step,) * 4)
    h, w = mask.shape[1:]

    def shifted(dy: int, dx: int) -> Tensor:
        return m[:, step + dy : step + dy + h, step + dx : step + dx + w]

    out = torch.zeros_like(mask)
    for dy, dx in ((0, 1), (1, 0)):
        out |= shifted(dy, dx) & shifted(-step * dy, -step * dx)
        out |= shifted(step * dy, step * dx) & shifted(-dy, -dx)
    return out


def _answer(swept: DepthMap, where: Tensor, depth: Tensor, sigma: Tensor) -> DepthMap:
    """The map with filled pixels; those that are too uncertain stay unanswered."""
    return swept.replace(
        depth=torch.where(where, depth.to(swept.depth), swept.depth),
        sigma=torch.where(where, sigma.to(swept.sigma), swept.sigma),
        score=torch.where(where, 0.1 / (0.1 + sigma / depth.clamp_min(1e-9)), swept.score),
        source=swept.source.masked_fill(where, Source.FILLED),
        gate=swept.gate.masked_fill(where, Gate.ANSWER),
    )
