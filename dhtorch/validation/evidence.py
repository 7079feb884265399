"""Evidence for or against a depth map, pixel by pixel, one function per kind of evidence.

    near returns, triangulated points ── sparse_evidence ────────────┐
    pictures of source views ─────────── photometric_evidence ───────┼─ Evidence: misfit in sigmas, and detectability
    depth maps of source views ───────── depth_consistency_evidence ─┘

Alphabet: d a depth of the map, m; r = log(d / reference depth), positive where the map is too far; a *grid* is the
picture at the resolution (h, w) at which a map is validated, each of its pixels the mean of what it covers.

By default a pixel has no evidence: a kind of evidence supports a pixel only where it would have detected an error of
20 %.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.codes import Flag
from dhtorch.geometry import plane_sweep, se3
from dhtorch.geometry import windows as neighbours
from dhtorch.geometry.camera import resize_pixels
from dhtorch.geometry.checks import check
from dhtorch.geometry.patches import containing_pixels, nearest_pixel_index, sample_nearest
from dhtorch.pipeline import surface
from dhtorch.pipeline.dense_options import DenseOptions
from dhtorch.records import Estimate, Samples
from dhtorch.validation.options import DEFAULT_VALIDATION_OPTIONS, ValidationOptions


class Evidence(NamedTuple):
    """One kind of evidence for every pixel, (B, h, w) each."""

    misfit: Tensor  # sigmas, positive where the map is too far; NaN where there is no evidence
    sure: Tensor  # bool: an error of 20 % would have been detected
    view: Tensor  # int32, index of the source view it is from; -1 = sparse references, -2 = none


class ValidationReferences(NamedTuple):
    """Sparse reference depths at places of the picture, (B, N) each."""

    uv: Tensor  # (B, N, 2) px
    depth: Tensor  # m; 1 where there is none
    sigma: Tensor  # relative to depth
    shared: Tensor  # part of sigma that all share
    used: Tensor  # bool
    near: Tensor  # bool: a near return, else triangulated


def validation_references(samples: Samples, estimate: Estimate, *, near: bool) -> ValidationReferences:
    """Samples and estimate -> near returns away from edges (if ``near``), else triangulated points. Gradient: none."""
    check("validation_references", depth=(samples.depth, "B N"), answer=(estimate.depth, "B N"))
    returned = samples.usable & ((samples.flag & (Flag.DEPTH_EDGE | Flag.SPECULAR)) == 0) & near
    triangulated = estimate.keep & (estimate.depth > 0) & (estimate.sigma > 0) & ~returned
    used = returned | triangulated
    depth = torch.where(returned, samples.depth, torch.where(triangulated, estimate.depth, 1.0)).detach()
    sigma = torch.where(returned, samples.sigma, torch.where(triangulated, estimate.sigma, 1.0)).detach()
    shared = torch.where(triangulated, estimate.sigma_shared, 0.0).detach().nan_to_num()
    return ValidationReferences(samples.uv, depth, sigma / depth, shared / depth, used, returned)


def resolution_sigma(depth: Tensor, hw: tuple[int, int]) -> Tensor:
    """Depth map and size of the grid -> standard deviation (B, h, w) of log depth due to the map's coarser resolution;
    0 where it is as fine as the grid.

    A coarse map has the depths of its pixels' centres. An outline between two centres lies anywhere with equal
    probability: at a pixel of the grid that is a fraction o of the way from one to the other, the other's depth is true
    with probability o. Gradient: none.
    """
    check("resolution_sigma", depth_map=(depth, "B y x"))
    if not is_coarser(depth, hw):
        return depth.new_zeros(len(depth), *hw)
    log = torch.where(depth > 0, depth.detach(), torch.nan).log()
    sides = zip(log.shape[-2:], hw, strict=True)
    (row, next_row, row_weight), (column, next_column, column_weight) = (
        _two_nearest_pixels(n, m, log.device) for n, m in sides
    )
    centre = log[:, row[:, None], column]
    down, across = log[:, next_row[:, None], column], log[:, row[:, None], next_column]
    down, across = ((neighbour - centre).square().nan_to_num(0.0) for neighbour in (down, across))
    return (row_weight[:, None] * down + column_weight * across).sqrt()


def is_coarser(depth: Tensor, hw: tuple[int, int]) -> bool:
    """Whether a map (..., h, w) has fewer pixels along a side than a grid over the same field."""
    return any(n < m for n, m in zip(depth.shape[-2:], hw, strict=True))


def pixel_centres(n: int, m: int, device: torch.device) -> Tensor:
    """Centres (m,) of ``m`` pixels along a side, measured from its edge in pixels of ``n`` along that side."""
    return (torch.arange(m, device=device) + 0.5) * n / m


def _two_nearest_pixels(n: int, m: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Resampling along a side from n to m pixels: index (m,) of the nearest source pixel, of the second nearest, and
    the weight of the latter."""
    place = pixel_centres(n, m, device)
    index = place.floor().clamp_max(n - 1)
    offset = place - index - 0.5
    second = (index + offset.sign()).clamp(0, n - 1)
    return index.long(), second.long(), offset.abs() * (n < m)


def inflate_sigma(references: ValidationReferences, loose: Tensor, hw: tuple[int, int]) -> ValidationReferences:
    """References whose sigma includes the resolution of the map, ``loose`` (B, h, w) of log depth at their places;
    ``hw`` of the picture. Gradient: none."""
    check("inflate_sigma", loose=(loose, "B h w"), uv=(references.uv, "B N 2"))
    at = sample_nearest(loose, resize_pixels(references.uv, hw, (loose.shape[-2], loose.shape[-1])))[0]
    return references._replace(sigma=(references.sigma.square() + at.square()).sqrt())


def no_evidence(like: Tensor) -> Evidence:
    """Evidence without a value at any pixel of the grid ``like``."""
    no_view = torch.full_like(like, -2, dtype=torch.int32)
    return Evidence(torch.full_like(like, torch.nan), torch.zeros_like(like, dtype=torch.bool), no_view)


def sparse_evidence(
    depth: Tensor,  # (B, h, w) m, 0 = no value
    hw: tuple[int, int],  # of the picture
    references: ValidationReferences,
    tolerance: float | Tensor,  # (B, h, w), or a number for all pixels
    returns: Samples | None = None,  # (B, h, w) each: near returns at every pixel of the grid
    options: ValidationOptions = DEFAULT_VALIDATION_OPTIONS,
) -> Evidence:
    """Map and sparse references -> evidence from the near return at the pixel itself, else from the references around
    it on the same surface of the map.

    References around a pixel are not independent: their mean has the variance of one of them, plus the variance
    between them. Gradient: none.
    """
    check("sparse_evidence", depth=(depth, "B h w"), uv=(references.uv, "B N 2"))
    h, w = depth.shape[-2:]
    place = resize_pixels(references.uv, hw, (h, w))
    at, inside = sample_nearest(depth, place)
    used = references.used & inside & (at > 0)
    ratio = torch.where(used, (at / references.depth).clamp_min(1e-9), 1.0).log()
    weight = torch.where(used, 1 / references.sigma.square().clamp_min(1e-8), 0.0)
    columns = torch.stack([torch.ones_like(ratio), ratio, ratio.square(), references.sigma.square()], 1)
    total, mean, mean_square, own_variance = _splat_on_surface(
        columns * weight[:, None], place, depth, at, options
    ).unbind(1)
    valid = (total > 0) & (depth > 0)
    total = torch.where(valid, total, 1.0)
    mean, mean_square, own_variance = (torch.where(valid, x / total, 0.0) for x in (mean, mean_square, own_variance))
    variance = own_variance + (mean_square - mean.square()).clamp_min(0)
    if returns is not None:
        has_return = returns.usable & ((returns.flag & (Flag.DEPTH_EDGE | Flag.SPECULAR)) == 0) & (depth > 0)
        return_ratio = torch.where(has_return, depth / torch.where(has_return, returns.depth, 1.0), 1.0).log()
        mean = torch.where(has_return, return_ratio, mean)
        noise = (returns.sigma / torch.where(has_return, returns.depth, 1.0)).square()
        variance, valid = torch.where(has_return, noise, variance), valid | has_return
    sigma = (variance + tolerance**2).sqrt()
    misfit = torch.where(valid, mean / sigma, torch.nan)
    return Evidence(
        misfit,
        valid & (options.detection_sigmas * sigma <= options.detectable_log_ratio),
        torch.where(valid, -1, -2).to(torch.int32),
    )


def triangulated_depth(
    depth: Tensor,  # (B, h, w) m, 0 = no value
    hw: tuple[int, int],  # of the picture
    references: ValidationReferences,
    options: ValidationOptions = DEFAULT_VALIDATION_OPTIONS,
) -> Tensor:
    """Map and references -> geometric mean depth (B, h, w) m of the triangulated points around each pixel on the same
    surface of the map, NaN without any. Gradient: none."""
    check("triangulated_depth", depth=(depth, "B h w"), uv=(references.uv, "B N 2"))
    place = resize_pixels(references.uv, hw, (depth.shape[-2], depth.shape[-1]))
    at, inside = sample_nearest(depth, place)
    weight = (references.used & ~references.near & inside & (at > 0)).to(depth)
    columns = torch.stack([weight, weight * references.depth.clamp_min(1e-6).log()], 1)
    total, log_sum = _splat_on_surface(columns, place, depth, at, options).unbind(1)
    return torch.where(total > 0, (log_sum / total.clamp_min(1e-9)).exp(), torch.nan)


def photometric_evidence(
    depth: Tensor,  # (B, h, w) m, 0 = no value
    base: plane_sweep.ReferenceView,
    source_views: list[surface.SourceView],
    tolerance: float | Tensor,  # (B, h, w), or a number for all pixels
    options: ValidationOptions = DEFAULT_VALIDATION_OPTIONS,
) -> Evidence:
    """Map and source views -> evidence from the photometric match at the map's depth, compared with other depths along
    the same rays; invariant to exposure.

    Where the windows match, the evidence is the depth step towards equal grey values, with the sigma of grey values and
    motion; where they do not and match at another depth, it is how much better they match there. Of several views the
    one with the least misfit counts: in the others something may occlude the pixel.

    No evidence: pixels occluded by the map itself or outside the view, without texture, without baseline (depths 20 %
    larger or smaller match as well), windows with too many holes or without a match. Gradient: none.
    """
    best = no_evidence(depth)
    q, filled = _fill_holes(depth, options)
    for k, source_view in enumerate(source_views):
        misfit, sure = _view_evidence(q, base, source_view, tolerance, options)
        valid = misfit.isfinite() & filled & source_view.use[:, None, None]
        milder = valid & (best.misfit.isnan() | (misfit.abs() < best.misfit.abs()))
        index = torch.full_like(best.view, k)
        best = Evidence(*(torch.where(milder, a, b) for a, b in zip((misfit, sure, index), best, strict=True)))
    return best


def depth_consistency_evidence(
    depth: Tensor,  # (B, h, w) m, 0 = no value
    base: plane_sweep.ReferenceView,
    source_views: list[surface.SourceView],
    maps: list[Tensor],  # (B, h', w') m of each source view, 0 = no value
    tolerance: float | Tensor,  # (B, h, w), or a number for all pixels
    options: ValidationOptions = DEFAULT_VALIDATION_OPTIONS,
) -> Evidence:
    """Map and maps of source views -> evidence against pixels in front of a surface of another view's map, where one of
    the two maps is wrong.

    A point behind the other map's surface may be occluded there, and two maps of one source may have the same errors,
    so that agreement is no evidence: ``sure`` is never set. Gradient: none.
    """
    worst = no_evidence(depth)
    q = torch.where(depth > 0, 1 / depth.clamp_min(1e-6), 0.0)
    for k, (source_view, other_map) in enumerate(zip(source_views, maps, strict=True)):
        view = source_view.view
        uv, front = plane_sweep.project_inverse_depth(view, base.ray, q.flatten(1))
        z = (se3.rotate(view.T_1_from_0.R, base.ray)[..., 2] + q.flatten(1) * view.T_1_from_0.t[:, None, 2]) / (
            q.flatten(1).clamp_min(1e-6)
        )
        surface_depth, inside = sample_nearest(nearest_surface(other_map), uv)
        valid = front & inside & surface_depth.isfinite() & (z > 0) & source_view.use[:, None]
        r = (
            torch.where(valid, z / torch.where(valid, surface_depth, 1.0), 1.0)
            .clamp_min(1e-9)
            .log()
            .unflatten(-1, base.hw)
        )
        has_baseline = _parallax_px(base, view, q, options) >= 1.5
        in_front = valid.unflatten(-1, base.hw) & (depth > 0) & has_baseline & (r < 0)
        misfit = torch.where(in_front, r / (math.sqrt(2) * tolerance), torch.nan)
        worse = in_front & (worst.misfit.isnan() | (misfit < worst.misfit))
        worst = Evidence(
            torch.where(worse, misfit, worst.misfit),
            worst.sure,
            torch.where(worse, torch.full_like(worst.view, k), worst.view),
        )
    return worst


def nearest_surface(depth: Tensor) -> Tensor:
    """Least depth in the 3 × 3 window around each pixel (B, h, w) of a map; infinite where it has no value."""
    depth_or_inf = torch.where(depth > 0, depth, torch.inf)
    return -F.max_pool2d(-depth_or_inf[:, None], 3, 1, 1)[:, 0]


def _view_evidence(
    q: Tensor,
    base: plane_sweep.ReferenceView,
    source_view: surface.SourceView,
    tolerance: float | Tensor,
    options: ValidationOptions,
) -> tuple[Tensor, Tensor]:
    """Misfit (B, h, w) from one source view in sigmas, NaN without evidence, and whether an error would be detected."""
    view, picture, fit, _ = source_view
    window = plane_sweep.fit_windows(base, view, picture, q, radius=options.evidence_radius_px)
    plane_step = 0.03 * q.flatten(1).amax(-1)
    visible = (
        window.seen
        & ~plane_sweep.occlusion_mask(plane_sweep.epipolar_warp(base, view), q, plane_step)
        & base.known.unflatten(-1, base.hw)
    )
    own_var = (window.noise + DenseOptions.grey_noise**2) / (options.independent_evidence_pixels * window.contrast)
    shared_var = surface.pose_variance(base, view, fit, q, window.motion)
    sigma = ((own_var + shared_var) / q.square().clamp_min(1e-12) + tolerance**2).sqrt()
    step = torch.where(q > 0, window.step / q.clamp_min(1e-9), 0.0)  # of log(1 / d)
    best, factor, neighbour = _rivals(q, base, source_view, options)
    correlation = window.correlation.clamp(-0.99, 0.999)
    matches = correlation >= options.match_correlation
    # The log likelihood of a window is that of the unexplained fraction of its variance.
    n = options.independent_evidence_pixels
    unexplained = 1 - correlation.square().where(correlation > 0, 0.0)
    rival_sigmas = (n * (unexplained / (1 - best.square())).log()).clamp_min(0).sqrt()
    own_sigmas = (n * ((1 - neighbour.square()) / (1 - correlation.square())).log()).clamp_min(0).sqrt()
    distinct = own_sigmas >= 1.5
    log_factor = factor.log()
    refuted = (
        ~matches
        & (best >= options.rival_correlation)
        & (rival_sigmas >= 1.0)
        & (log_factor.abs() > options.detection_sigmas * tolerance)
    )
    misfit = torch.where(matches & distinct, step.clamp(-0.5, 0.5) / sigma, torch.nan)
    misfit = torch.where(refuted, log_factor.sign() * rival_sigmas * options.detection_sigmas / 2, misfit)
    misfit = torch.where(visible, misfit, torch.nan)
    return misfit, matches & distinct & (options.detection_sigmas * sigma <= options.detectable_log_ratio) & visible


def _rivals(
    q: Tensor, base: plane_sweep.ReferenceView, source_view: surface.SourceView, options: ValidationOptions
) -> tuple[Tensor, Tensor, Tensor]:
    """Best correlation at rival depths along the rays, its factor on q, and the best correlation at rivals about 20 %
    off; (B, h, w) each."""
    best, factor = torch.zeros_like(q), torch.ones_like(q)
    neighbour = torch.zeros_like(q)
    for rival in options.rival_factors:
        window = plane_sweep.fit_windows(
            base, source_view.view, source_view.picture, q * rival, radius=options.evidence_radius_px
        )
        value = torch.where(window.seen, window.correlation, 0.0).clamp(0, 0.999)
        factor = torch.where(value > best, rival, factor)
        best = torch.maximum(best, value)
        if 0.7 * options.detectable_log_ratio < abs(math.log(rival)) < 3 * options.detectable_log_ratio:
            neighbour = torch.maximum(neighbour, value)
    return best, factor, neighbour


def _parallax_px(
    base: plane_sweep.ReferenceView, view: plane_sweep.SweptView, q: Tensor, options: ValidationOptions
) -> Tensor:
    """Image motion (B, h, w) px in the source view when the depth increases by 20 %."""
    flat = q.flatten(1)
    uv, uv_farther = (
        plane_sweep.project_inverse_depth(view, base.ray, flat * s)[0]
        for s in (1.0, math.exp(-options.detectable_log_ratio))
    )
    return (uv - uv_farther).norm(dim=-1).unflatten(-1, base.hw)


def _fill_holes(depth: Tensor, options: ValidationOptions) -> tuple[Tensor, Tensor]:
    """Inverse depth (B, h, w) with holes filled by the window mean, and the pixels whose windows have enough depths."""
    valid = (depth > 0) & depth.isfinite()
    q = torch.where(valid, 1 / depth.clamp_min(1e-6), 0.0)
    radius = options.evidence_radius_px
    count = neighbours.window_sum(valid.to(q), radius)
    mean = neighbours.window_sum(q, radius) / count.clamp_min(1)
    min_count = options.min_filled_ratio * (2 * radius + 1) ** 2
    return torch.where(valid, q, mean), valid & (count >= min_count)


def _splat_on_surface(
    columns: Tensor, place: Tensor, depth: Tensor, depth_at: Tensor, options: ValidationOptions
) -> Tensor:
    """Sums (B, C, h, w) of columns (B, C, N) over the places around each pixel on the same surface of the map, with
    weights that decrease with distance."""
    (B, C, _), (h, w) = columns.shape, depth.shape[-2:]
    radius = options.support_radius_px
    step = torch.arange(-radius, radius + 1, device=depth.device)
    dv, du = (x.reshape(-1) for x in torch.meshgrid(step, step, indexing="ij"))
    distance = (du.square() + dv.square()).to(depth).sqrt()
    in_disc = distance <= radius
    du, dv, kernel = du[in_disc], dv[in_disc], (1 - distance[in_disc] / (radius + 1))
    centre = containing_pixels(place)
    pixels = centre[:, :, None] + torch.stack([du, dv], -1).to(centre)
    index, inside = nearest_pixel_index((h, w), pixels.flatten(1, 2))
    target_depth = depth.flatten(1).gather(1, index).unflatten(1, (-1, len(du)))
    ratio = target_depth.clamp_min(1e-9) / depth_at[..., None].clamp_min(1e-9)
    same_surface = ratio.log().abs() < options.surface_log_ratio
    weight = (same_surface & inside.unflatten(1, (-1, len(du)))).to(depth) * kernel
    weighted = (columns[..., None] * weight[:, None]).flatten(2)
    total = depth.new_zeros(B, C, h * w)
    return total.scatter_add(2, index[:, None].expand_as(weighted), weighted).unflatten(-1, (h, w))
