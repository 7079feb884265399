"""Causes of single wrong pixels: ghosts below a sensor's minimum range, flying pixels, edge bleed.

    map ──────────────────────────── flying_evidence ───┐
    map, pictures of source views ── outline_evidence ──┼─ refutations beside those of dhtorch.validation.evidence
    near points, states, misfits ─── name_causes ───────┴─ codes.WrongCause per pixel

Alphabet: d a depth of the map, m; q = 1 / d; an *outline* is where depths of neighbouring pixels differ by a ratio of
at least ``side_ratio``; the *rival* of a pixel near an outline is the depth of the surface beyond it, continued over
the pixel.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.codes import State, WrongCause, first_reason
from dhtorch.geometry import plane_sweep
from dhtorch.geometry.checks import check
from dhtorch.pipeline import surface
from dhtorch.validation.options import DEFAULT_VALIDATION_OPTIONS, ValidationOptions

#: Standard deviation of grey values, of [0, 1], that is assumed at least, and squared displacement, px², by which a
#: projected pixel misses its place. Source: chosen on built-in room 0, the best of five pairs.
_MIN_GREY_SIGMA, _PLACE_VARIANCE_PX2 = 0.01, 0.09

#: Largest squared difference of two grey values, sigmas²: of pixels that show different surfaces, or something hidden.
#: Source: chosen on built-in room 0, the best of three.
_MAX_SQUARED_SIGMAS = 16.0

#: Added to both misfits of a ratio, sigmas², so that two good fits differ little.
#: Source: chosen on built-in room 0 and holo_a, where 0.3 to 2 give the same results.
_MISFIT_FLOOR = 0.3

#: Weight of the ratio of the least misfits beside the largest difference of misfits.
#: Source: chosen on built-in room 0, where either alone separates less.
_RATIO_WEIGHT = 3.0

#: Difference of grey values, of [0, 1], over which the weight of a window's pixel decreases by e.
#: Source: chosen on built-in room 0.
_SIMILAR_GREY = 0.05

#: Radius of the windows around a pixel at an outline, grid pixels: smaller than a bleed is wide.
#: Source: chosen on built-in room 0, the best of 1 to 4.
_OUTLINE_WINDOW_RADIUS_PX = 2


#: Limit of a gain before it is averaged, sigmas². Source: derived, half of the largest squared difference.
_MAX_GAIN = 8.0

#: Relative difference of depths up to which neighbours' gains are averaged.
#: Source: derived, half of what two sides differ by.
_LEVEL_RATIO = 0.1

#: Fraction of the largest inverse depth by which an occluding pixel must be nearer.
#: The same as in dhtorch.validation.evidence.
_OCCLUSION_STEP = 0.03


#: Distance over which pixels of one surface of the map share the name of a ghost, grid pixels.
#: Source: derived, an eighth of a picture 320 wide.
_MAX_GHOST_RADIUS_PX = 40


class RefutedPixels(NamedTuple):
    """What refutes pixels of a map, (B, h, w) each."""

    misfit: Tensor  # sigmas, positive where the map is too far; NaN where nothing was compared
    view: Tensor  # int32, index of the source view; -2 = the map itself, or none
    unsupported: Tensor  # bool: evidence from wider windows is no support here


def extend_surface(depth: Tensor, steps: int, ratio: float, *, far: bool) -> Tensor:
    """Map (B, h, w) -> map whose farther surfaces (``far``, else the nearer ones) are continued over their outlines by
    ``steps`` pixels, where depths differ by at least ``ratio``. Gradient: none."""
    extended = depth.detach()
    for _ in range(steps):
        if far:
            beyond = F.max_pool2d(extended[:, None], 3, 1, 1)[:, 0]
            reached = beyond > ratio * extended
        else:
            beyond = -F.max_pool2d(-torch.where(extended > 0, extended, torch.inf)[:, None], 3, 1, 1)[:, 0]
            reached = ratio * beyond < extended
        extended = torch.where((extended > 0) & reached, beyond, extended)
    return extended


def flying_evidence(
    depth: Tensor,  # (B, h, w) m, 0 = no value
    tolerance: Tensor,  # (B, h, w), sigma of log depth
    options: ValidationOptions = DEFAULT_VALIDATION_OPTIONS,
) -> RefutedPixels:
    """Map -> pixels that lie between a foreground and a background, on neither.

    A pixel of a surface, and of a line one pixel wide, has neighbours at its depth in the 5 × 5 window around it; a
    flying one has few, and surfaces before and behind it. Gradient: none.
    """
    check("flying_evidence", depth=(depth, "B h w"), tolerance=(tolerance, "B h w"))
    log = torch.where(depth > 0, depth, torch.nan).log()
    around = _windows(F.pad(log[:, None], (2,) * 4, mode="replicate")[:, 0], 2)[..., 2:-2, 2:-2]
    difference = around - log[:, None]
    n_level = (difference.abs() < options.flying_log_ratio).sum(1) - 1  # without itself
    n_before, n_behind = ((sign * difference > options.flying_log_ratio).sum(1) for sign in (-1, 1))
    to_near = torch.where(difference < 0, -difference, 0.0).nan_to_num().amax(1)
    to_far = torch.where(difference > 0, difference, 0.0).nan_to_num().amax(1)
    flying = (
        (n_level <= options.max_flying_neighbours)
        & (torch.minimum(n_before, n_behind) >= options.min_side_pixels)
        & (to_near + to_far > torch.tensor(options.side_ratio).log())
    )
    nearer = to_near < to_far  # belongs to the foreground: too far
    size = torch.minimum(to_near, to_far) / tolerance
    flying = flying & (size > options.refuting_evidence_sigmas)
    misfit = torch.where(flying, torch.where(nearer, size, -size), torch.nan)
    return RefutedPixels(misfit, torch.full_like(depth, -2, dtype=torch.int32), flying)


@torch.no_grad()
def outline_evidence(
    depth: Tensor,  # (B, h, w) m, 0 = no value
    base: plane_sweep.ReferenceView,
    source_views: list[surface.SourceView],
    options: ValidationOptions = DEFAULT_VALIDATION_OPTIONS,
) -> RefutedPixels:
    """Map and source views -> evidence at pixels within ``outline_reach_px`` of an outline: how much better pictures
    fit the depth of the surface beyond it.

    Grey values are compared at two depths, in small windows of pixels of similar grey, since windows as wide as those
    of ``photometric_evidence`` show the foreground on either side of its outline. Of several views the one counts in
    which the rival gains most, since something may occlude it in the others; views in which the map itself occludes a
    pixel do not. Gains are averaged over the same surface in 3 × 3 pixels. Gradient: none.
    """
    check("outline_evidence", depth=(depth, "B h w"), image=(base.image, "B 1 h w"))
    misfit = torch.full_like(depth, torch.nan)
    best_view = torch.full_like(depth, -2, dtype=torch.int32)
    unsupported = torch.zeros_like(depth, dtype=torch.bool)
    grey = base.image[:, 0]
    difference = _windows(grey, _OUTLINE_WINDOW_RADIUS_PX) - grey[:, None]
    weight = (-difference.abs() / _SIMILAR_GREY).exp().nan_to_num(0.0)
    own = torch.where(_occluded(depth, base, source_views), torch.nan, _grey_misfits(depth, base, source_views))
    for far in (True, False):
        rival = extend_surface(depth, options.outline_reach_px, options.side_ratio, far=far)
        near_outline = (rival != depth) & (depth > 0)
        gain, view = _rival_gain(own, _grey_misfits(rival, base, source_views), weight)
        gain = _mean_on_surface(torch.where(near_outline, gain, -torch.inf), depth)
        limit = options.outline_gain if far else options.occluding_outline_gain
        sigmas = (options.refuting_evidence_sigmas * gain / limit).clamp_min(0)
        better = gain.isfinite() & (misfit.isnan() | (sigmas > misfit.abs()))
        misfit = torch.where(better, -sigmas if far else sigmas, misfit)
        best_view = torch.where(better, view, best_view)
        unsupported = unsupported | (gain > (-options.min_own_gain if far else 0.0))
    return RefutedPixels(misfit, best_view, unsupported)


def _windows(x: Tensor, radius: int) -> Tensor:
    """Map (B, h, w) -> values (B, n, h, w) of the n pixels in the window around each, NaN outside the map."""
    padded = F.pad(x[:, None], (radius,) * 4, value=torch.nan)
    return F.unfold(padded, 2 * radius + 1).unflatten(2, x.shape[-2:])


def _occluded(depth: Tensor, base: plane_sweep.ReferenceView, source_views: list[surface.SourceView]) -> Tensor:
    """Pixels (V, B, h, w) that a nearer pixel of the map occludes in a view."""
    q = torch.where(depth > 0, 1 / depth.clamp_min(1e-6), 0.0)
    step = _OCCLUSION_STEP * q.flatten(1).amax(-1)
    views = [source_view.view for source_view in source_views]
    masks = [plane_sweep.occlusion_mask(plane_sweep.epipolar_warp(base, view), q, step) for view in views]
    return torch.stack(masks) if masks else torch.zeros(0, *depth.shape, dtype=torch.bool, device=depth.device)


def _mean_on_surface(gain: Tensor, depth: Tensor) -> Tensor:
    """Gains (B, h, w), limited, averaged over the pixels of a surface in 3 × 3 that have one; -inf where none has."""
    has_gain = gain.isfinite()
    around = _windows(torch.where(has_gain, gain.clamp(-_MAX_GAIN, _MAX_GAIN), torch.nan), 1)
    ratio = _windows(depth, 1) / depth[:, None].clamp_min(1e-6)
    level = ((ratio - 1).abs() < _LEVEL_RATIO) & around.isfinite()
    mean = torch.where(level, around, 0.0).sum(1) / level.sum(1).clamp_min(1)
    return torch.where(has_gain, mean, -torch.inf)


def _grey_misfits(depth: Tensor, base: plane_sweep.ReferenceView, source_views: list[surface.SourceView]) -> Tensor:
    """Squared differences (V, B, h, w) of grey values at the map's depth, in sigmas² with a limit; NaN unseen."""
    q = torch.where(depth > 0, 1 / depth.clamp_min(1e-6), 0.0)
    out = []
    for source_view in source_views:
        uv, in_front = plane_sweep.project_inverse_depth(source_view.view, base.ray, q.flatten(1))
        values, inside = plane_sweep.sample_bilinear(source_view.picture, uv)
        grey, du, dv = (x.unflatten(-1, base.hw) for x in values.unbind(1))
        seen = (inside & in_front).unflatten(-1, base.hw) & (depth > 0) & source_view.use[:, None, None]
        out.append(_squared_sigmas(base.image[:, 0], grey, du.square() + dv.square(), seen))
    return torch.stack(out) if out else depth.new_zeros(0, *depth.shape)


def _squared_sigmas(grey: Tensor, other: Tensor, gradient2: Tensor, seen: Tensor) -> Tensor:
    """Grey values of two views (B, h, w) -> squared difference in sigmas² up to a gain, NaN where unseen."""
    a, b = (torch.where(seen, x, torch.nan).flatten(1).nanmedian(1).values[:, None, None] for x in (grey, other))
    difference = grey - other * (a / b.clamp_min(1e-3))
    spread = 1.483 * torch.where(seen, difference.abs(), torch.nan).flatten(1).nanmedian(1).values[:, None, None]
    variance = spread.clamp_min(_MIN_GREY_SIGMA).square() + _PLACE_VARIANCE_PX2 * gradient2
    return torch.where(seen, (difference.square() / variance).clamp_max(_MAX_SQUARED_SIGMAS), torch.nan)


def _rival_gain(own: Tensor, rival: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Misfits (V, B, h, w) at two depths -> by how much the rival explains the pictures better, sigmas², -inf where no
    view shows both; and the index of the view in which it gains most."""
    if not len(own):
        return torch.full_like(weight[:, 0], -torch.inf), torch.full_like(weight[:, 0], -2, dtype=torch.int32)
    means = []
    for a, b in zip(own, rival, strict=True):
        both = a.isfinite() & b.isfinite()
        total = (_windows(both.to(a), _OUTLINE_WINDOW_RADIUS_PX).nan_to_num() * weight).sum(1)
        parts = (_windows(torch.where(both, x, 0.0), _OUTLINE_WINDOW_RADIUS_PX).nan_to_num() * weight for x in (a, b))
        means.append(torch.stack([torch.where(both, x.sum(1) / total.clamp_min(1e-6), torch.inf) for x in parts]))
    own_mean, rival_mean = torch.stack(means, 1)
    shown = own_mean.isfinite()
    gain = torch.where(shown, own_mean - rival_mean, -torch.inf)
    least_own, least_rival = own_mean.amin(0), rival_mean.amin(0)
    ratio = ((least_own + _MISFIT_FLOOR) / (least_rival + _MISFIT_FLOOR)).log()
    score = gain.amax(0) + _RATIO_WEIGHT * ratio
    return torch.where(shown.any(0), score, -torch.inf), gain.argmax(0).to(torch.int32)


def name_causes(
    depth: Tensor,  # (B, h, w) m, 0 = no value
    state: Tensor,  # (B, h, w) int32, codes.State
    misfit: Tensor,  # (B, h, w) of the evidence that decided the state, positive where the map is too far
    point_depth: Tensor,  # (B, h, w) m, of the triangulated points around the pixel; NaN without any
    flying: Tensor,  # (B, h, w) bool
    options: ValidationOptions = DEFAULT_VALIDATION_OPTIONS,
) -> Tensor:
    """Map, states and evidence -> codes.WrongCause (B, h, w) int32 of the wrong pixels, NONE of all others.

    Ghost: triangulated points there, or elsewhere on the same surface of the map, lie below the minimum range, and the
    map lies far behind them. Edge bleed: the
    pixel lies within ``outline_reach_px`` of an outline, on the surface of one side, in a band of wrong pixels no wider
    than twice that, and its evidence points to the other side. Gradient: none.
    """
    wrong = state == State.WRONG
    below_range = (point_depth < options.min_sensor_range_m) & (depth > options.ghost_ratio * point_depth)
    # Mask (B, h, w) grown over neighbouring pixels of similar depth, by ``_MAX_GHOST_RADIUS_PX``
    mask = wrong & below_range
    grown = torch.where(mask, depth, 0.0)
    for _ in range(_MAX_GHOST_RADIUS_PX):
        beside = F.max_pool2d(grown[:, None], 3, 1, 1)[:, 0]
        level = (depth / beside.clamp_min(1e-6)).clamp_min(1e-6).log().abs() < options.surface_log_ratio
        grown = torch.where((grown == 0) & (depth > 0) & level, depth, grown)
    ghost = grown > 0
    steps, ratio = options.outline_reach_px, options.side_ratio
    has_farther, has_nearer = (extend_surface(depth, steps, ratio, far=far) != depth for far in (True, False))
    bleeds = (has_farther & (misfit < 0)) | (has_nearer & (misfit > 0))
    return first_reason(
        (~wrong, WrongCause.NONE),
        (ghost, WrongCause.GHOST),
        (flying, WrongCause.FLYING_PIXEL),
        (bleeds & ~_is_wide(wrong & ~flying, steps), WrongCause.EDGE_BLEED),
        otherwise=WrongCause.OTHER,
    )


def _is_wide(mask: Tensor, radius: int) -> Tensor:
    """Pixels (B, h, w) of a mask within a square of side 2 radius + 1 that it fills."""
    side = 2 * radius + 1
    x = mask[:, None].float()
    core = 1 - F.max_pool2d(1 - x, side, 1, radius)
    return F.max_pool2d(core, side, 1, radius)[:, 0] > 0
