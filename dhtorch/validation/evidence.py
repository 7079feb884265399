"""What speaks for or against a depth map, pixel by pixel, each kind of evidence by itself.

    near returns, triangulated points ── sparse_evidence ─┐
    pictures of other views ──────────── photometric_evidence ───┼─ Said: sigmas, and whether an error would have been
    told maps of other views ──────────────── consistency_evidence ────┘

Alphabet: d a depth of the map, m; r = log(d / what it is held against), positive where the map is too far; a *grid* is
the picture over which a map is judged, (h, w), each of its pixels the mean of what it covers.

Saying nothing is the rule: a kind of evidence counts for a pixel only where it would have told an error of a fifth.
"""

from __future__ import annotations

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
from dhtorch.records import Estimate, Samples

#: Error as a log ratio that evidence must be able to tell, and the sigmas at which it does.
DETECTABLE_LOG_RATIO, DETECTION_SIGMAS = math.log(1.2), 3.0

#: Grid pixels that an answer speaks for around it, and the log ratio by which neighbours on one surface of the map
#: differ at most.
SUPPORT_RADIUS_PX, SURFACE_LOG_RATIO = 8, 0.06

#: Factors on inverse depth that are tried beside the map's own.
RIVAL_FACTORS = (0.3, 0.42, 0.58, 0.75, 0.88, 1.14, 1.33, 1.75, 2.4, 3.4)

#: Correlation of windows from which on they show the same, and what a place must correlate to be a rival.
MATCH_CORRELATION, RIVAL_CORRELATION = 0.75, 0.8

#: Radius of the windows, grid pixels, and how many of a window's pixels err by themselves.
EVIDENCE_RADIUS_PX, INDEPENDENT_EVIDENCE_PIXELS = 4, 8.0

#: Share of a window that must have a depth.
MIN_FILLED_RATIO = 0.6


class Evidence(NamedTuple):
    """What one kind of evidence says of every pixel, (B, h, w) each."""

    misfit: Tensor  # sigmas, positive where the map is too far; NaN where nothing is said
    sure: Tensor  # bool: an error of a fifth would have been told
    view: Tensor  # int32, which view said so; -1 = our own answers, -2 = none


class ValidationReferences(NamedTuple):
    """Depths that a map is held against at places of the picture, (B, N) each."""

    uv: Tensor  # (B, N, 2) px
    depth: Tensor  # m; 1 where there is none
    sigma: Tensor  # relative to depth
    shared: Tensor  # the part of sigma that all share
    used: Tensor  # bool
    near: Tensor  # bool: a near return, else triangulated


def validation_references(samples: Samples, estimate: Estimate, *, near: bool) -> ValidationReferences:
    """Near returns away from edges (where ``near``), else answers of the sparse method. Gradient: none."""
    check("validation_references", depth=(samples.depth, "B N"), answer=(estimate.depth, "B N"))
    returned = samples.usable & ((samples.flag & (Flag.DEPTH_EDGE | Flag.SPECULAR)) == 0) & near
    told = estimate.keep & (estimate.depth > 0) & (estimate.sigma > 0) & ~returned
    used = returned | told
    depth = torch.where(returned, samples.depth, torch.where(told, estimate.depth, 1.0)).detach()
    sigma = torch.where(returned, samples.sigma, torch.where(told, estimate.sigma, 1.0)).detach()
    shared = torch.where(told, estimate.sigma_shared, 0.0).detach().nan_to_num()
    return ValidationReferences(samples.uv, depth, sigma / depth, shared / depth, used, returned)


def resolution_sigma(depth: Tensor, hw: tuple[int, int]) -> Tensor:
    """Standard deviation (B, h, w) of log depth by which a map coarser than the grid ``hw`` may be off at its pixels
    and not be wrong; 0 where it is as fine.

    A coarse map knows the depths of its pixels' centres. An outline between two centres lies anywhere as likely: at a
    pixel of the grid that is a share o of the way from one to the other it is the other's depth that is true with
    probability o. Gradient: none.
    """
    check("resolution_sigma", depth_map=(depth, "B y x"))
    if not is_coarser(depth, hw):
        return depth.new_zeros(len(depth), *hw)
    log = torch.where(depth > 0, depth.detach(), torch.nan).log()
    sides = zip(log.shape[-2:], hw, strict=True)
    (row, row_beside, off_row), (column, column_beside, off_column) = (_between(n, m, log.device) for n, m in sides)
    here = log[:, row[:, None], column]
    down, across = log[:, row_beside[:, None], column], log[:, row[:, None], column_beside]
    down, across = ((beside - here).square().nan_to_num(0.0) for beside in (down, across))
    return (off_row[:, None] * down + off_column * across).sqrt()


def is_coarser(depth: Tensor, hw: tuple[int, int]) -> bool:
    """Whether a map (..., h, w) has fewer pixels along a side than a grid over the same field."""
    return any(n < m for n, m in zip(depth.shape[-2:], hw, strict=True))


def pixel_centres(n: int, m: int, device: torch.device) -> Tensor:
    """Where the centres (m,) of ``m`` pixels along a side lie, from its edge on, in pixels of ``n`` along that side."""
    return (torch.arange(m, device=device) + 0.5) * n / m


def _between(n: int, m: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Of ``m`` pixels along a side of which a map has ``n``: the map's pixel each is in, that on its other side, and
    which share of the way to that one it stands."""
    place = pixel_centres(n, m, device)
    index = place.floor().clamp_max(n - 1)
    off = place - index - 0.5
    beside = (index + off.sign()).clamp(0, n - 1)
    return index.long(), beside.long(), off.abs() * (n < m)


def inflate_sigma(found: ValidationReferences, loose: Tensor, hw: tuple[int, int]) -> ValidationReferences:
    """Depths to hold a map against whose pixels (B, h, w) stand for depths that differ by so much (log); ``hw`` of the
    picture. Gradient: none."""
    check("inflate_sigma", loose=(loose, "B h w"), uv=(found.uv, "B N 2"))
    at = sample_nearest(loose, resize_pixels(found.uv, hw, (loose.shape[-2], loose.shape[-1])))[0]
    return found._replace(sigma=(found.sigma.square() + at.square()).sqrt())


def no_evidence(like: Tensor) -> Evidence:
    """Nothing is said of any pixel of a grid."""
    nowhere = torch.full_like(like, -2, dtype=torch.int32)
    return Evidence(torch.full_like(like, torch.nan), torch.zeros_like(like, dtype=torch.bool), nowhere)


def sparse_evidence(
    depth: Tensor,  # (B, h, w) m, 0 = the map says nothing
    hw: tuple[int, int],  # of the picture
    found: ValidationReferences,
    tolerance: float | Tensor,  # (B, h, w) or one for all
    returns: Samples | None = None,  # (B, h, w) each: near returns at every pixel of the grid
) -> Evidence:
    """Near returns at the pixel itself, else answers around it that lie on the same surface of the map.

    Answers around a pixel are not taken for independent: together they are as unsure as one of them, and more so by as
    much as they disagree. Gradient: none.
    """
    check("sparse_evidence", depth=(depth, "B h w"), uv=(found.uv, "B N 2"))
    h, w = depth.shape[-2:]
    place = resize_pixels(found.uv, hw, (h, w))
    at, inside = sample_nearest(depth, place)
    used = found.used & inside & (at > 0)
    ratio = torch.where(used, (at / found.depth).clamp_min(1e-9), 1.0).log()
    weight = torch.where(used, 1 / found.sigma.square().clamp_min(1e-8), 0.0)
    columns = torch.stack([torch.ones_like(ratio), ratio, ratio.square(), found.sigma.square()], 1)
    total, mean, square, own = _spread(columns * weight[:, None], place, depth, at).unbind(1)
    there = (total > 0) & (depth > 0)
    total = torch.where(there, total, 1.0)
    mean, square, own = (torch.where(there, x / total, 0.0) for x in (mean, square, own))
    variance = own + (square - mean.square()).clamp_min(0)
    if returns is not None:
        fine = returns.usable & ((returns.flag & (Flag.DEPTH_EDGE | Flag.SPECULAR)) == 0) & (depth > 0)
        direct = torch.where(fine, depth / torch.where(fine, returns.depth, 1.0), 1.0).log()
        mean = torch.where(fine, direct, mean)
        noise = (returns.sigma / torch.where(fine, returns.depth, 1.0)).square()
        variance, there = torch.where(fine, noise, variance), there | fine
    sigma = (variance + tolerance**2).sqrt()
    misfit = torch.where(there, mean / sigma, torch.nan)
    return Evidence(
        misfit, there & (DETECTION_SIGMAS * sigma <= DETECTABLE_LOG_RATIO), torch.where(there, -1, -2).to(torch.int32)
    )


def photometric_evidence(
    depth: Tensor,  # (B, h, w) m, 0 = the map says nothing
    base: plane_sweep.ReferenceView,
    source_views: list[surface.SourceView],
    tolerance: float | Tensor,  # (B, h, w) or one for all
) -> Evidence:
    """How the map fits the pictures of other views, whatever their exposure, beside other depths along the same rays.

    Where the windows show the same, the step towards equal grey values is the evidence, as unsure as grey values and
    motion make it; where they do not, and at another depth they do, how much better it fits there. Where several views
    tell, the one that speaks least against the map counts: the others may see something that hides the pixel.

    Says nothing: pixels hidden by the map itself or outside the view, without texture, without baseline (depths of a
    fifth more or less fit alike), windows with too many holes, or that fit nowhere. Gradient: none.
    """
    said = no_evidence(depth)
    q, solid = _filled(depth)
    for k, source_view in enumerate(source_views):
        misfit, sure = _view_evidence(q, base, source_view, tolerance)
        there = misfit.isfinite() & solid & source_view.use[:, None, None]
        milder = there & (said.misfit.isnan() | (misfit.abs() < said.misfit.abs()))
        index = torch.full_like(said.view, k)
        said = Evidence(*(torch.where(milder, a, b) for a, b in zip((misfit, sure, index), said, strict=True)))
    return said


def depth_consistency_evidence(
    depth: Tensor,  # (B, h, w) m, 0 = the map says nothing
    base: plane_sweep.ReferenceView,
    source_views: list[surface.SourceView],
    maps: list[Tensor],  # (B, h', w') m of each source view, 0 = says nothing
    tolerance: float | Tensor,  # (B, h, w) or one for all
) -> Evidence:
    """What lies in front of a surface that another view's map shows: one of the two maps is wrong.

    A point behind the other map's surface may be hidden there, and two maps of one source may err alike, so agreement
    says nothing of truth: ``sure`` is never set. Gradient: none.
    """
    said = no_evidence(depth)
    q = torch.where(depth > 0, 1 / depth.clamp_min(1e-6), 0.0)
    for k, (source_view, there) in enumerate(zip(source_views, maps, strict=True)):
        view = source_view.view
        uv, front = plane_sweep.project_inverse_depth(view, base.ray, q.flatten(1))
        z = (se3.rotate(view.T_1_from_0.R, base.ray)[..., 2] + q.flatten(1) * view.T_1_from_0.t[:, None, 2]) / (
            q.flatten(1).clamp_min(1e-6)
        )
        at, inside = sample_nearest(nearest_surface(there), uv)
        fine = front & inside & at.isfinite() & (z > 0) & source_view.use[:, None]
        r = torch.where(fine, z / torch.where(fine, at, 1.0), 1.0).clamp_min(1e-9).log().unflatten(-1, base.hw)
        wide = _moves(base, view, q) >= 1.5
        through = fine.unflatten(-1, base.hw) & (depth > 0) & wide & (r < 0)
        misfit = torch.where(through, r / (math.sqrt(2) * tolerance), torch.nan)
        worse = through & (said.misfit.isnan() | (misfit < said.misfit))
        said = Evidence(
            torch.where(worse, misfit, said.misfit),
            said.sure,
            torch.where(worse, torch.full_like(said.view, k), said.view),
        )
    return said


def nearest_surface(depth: Tensor) -> Tensor:
    """The nearest depth of each pixel (B, h, w) of a map and of those beside it; infinite where none has one."""
    known = torch.where(depth > 0, depth, torch.inf)
    return -F.max_pool2d(-known[:, None], 3, 1, 1)[:, 0]


def _view_evidence(
    q: Tensor, base: plane_sweep.ReferenceView, source_view: surface.SourceView, tolerance: float | Tensor
) -> tuple[Tensor, Tensor]:
    """Evidence (B, h, w) of one view in sigmas, NaN where it says nothing, and whether it would have told an error."""
    view, picture, fit, _ = source_view
    here = plane_sweep.fit_windows(base, view, picture, q, radius=EVIDENCE_RADIUS_PX)
    plane = 0.03 * q.flatten(1).amax(-1)
    seen = (
        here.seen
        & ~plane_sweep.occlusion_mask(plane_sweep.epipolar_warp(base, view), q, plane)
        & base.known.unflatten(-1, base.hw)
    )
    own = (here.noise + surface.GREY_NOISE**2) / (INDEPENDENT_EVIDENCE_PIXELS * here.contrast)
    shared = surface.pose_variance(base, view, fit, q, here.motion)
    sigma = ((own + shared) / q.square().clamp_min(1e-12) + tolerance**2).sqrt()
    step = torch.where(q > 0, here.step / q.clamp_min(1e-9), 0.0)  # of log(1 / d)
    best, factor, beside = _rivals(q, base, source_view)
    ours = here.correlation.clamp(-0.99, 0.999)
    fits = ours >= MATCH_CORRELATION
    # A window's log-likelihood goes by its unexplained share of variance.
    better = (
        (INDEPENDENT_EVIDENCE_PIXELS * ((1 - ours.square().where(ours > 0, 0.0)) / (1 - best.square())).log())
        .clamp_min(0)
        .sqrt()
    )
    alone = (INDEPENDENT_EVIDENCE_PIXELS * ((1 - beside.square()) / (1 - ours.square())).log()).clamp_min(
        0
    ).sqrt() >= 1.5
    away = factor.log()
    far = ~fits & (best >= RIVAL_CORRELATION) & (better >= 1.0) & (away.abs() > DETECTION_SIGMAS * tolerance)
    misfit = torch.where(fits & alone, step.clamp(-0.5, 0.5) / sigma, torch.nan)
    misfit = torch.where(far, away.sign() * better * DETECTION_SIGMAS / 2, misfit)
    misfit = torch.where(seen, misfit, torch.nan)
    return misfit, fits & alone & (DETECTION_SIGMAS * sigma <= DETECTABLE_LOG_RATIO) & seen


def _rivals(
    q: Tensor, base: plane_sweep.ReferenceView, source_view: surface.SourceView
) -> tuple[Tensor, Tensor, Tensor]:
    """Of other depths along the rays: the best correlation, its factor on q, and the best of those a fifth away or a
    little more; (B, h, w) each."""
    best, factor = torch.zeros_like(q), torch.ones_like(q)
    beside = torch.zeros_like(q)
    for rival in RIVAL_FACTORS:
        there = plane_sweep.fit_windows(
            base, source_view.view, source_view.picture, q * rival, radius=EVIDENCE_RADIUS_PX
        )
        value = torch.where(there.seen, there.correlation, 0.0).clamp(0, 0.999)
        factor = torch.where(value > best, rival, factor)
        best = torch.maximum(best, value)
        if abs(math.log(rival)) > 0.7 * DETECTABLE_LOG_RATIO and abs(math.log(rival)) < 3 * DETECTABLE_LOG_RATIO:
            beside = torch.maximum(beside, value)
    return best, factor, beside


def _moves(base: plane_sweep.ReferenceView, view: plane_sweep.SweptView, q: Tensor) -> Tensor:
    """Pixels (B, h, w) by which a depth moves in the other view that is a fifth further."""
    flat = q.flatten(1)
    here, there = (
        plane_sweep.project_inverse_depth(view, base.ray, flat * s)[0] for s in (1.0, math.exp(-DETECTABLE_LOG_RATIO))
    )
    return (here - there).norm(dim=-1).unflatten(-1, base.hw)


def _filled(depth: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse depth (B, h, w), holes filled by the mean around, and which pixels have windows with enough of it."""
    there = (depth > 0) & depth.isfinite()
    q = torch.where(there, 1 / depth.clamp_min(1e-6), 0.0)
    count = neighbours.window_sum(there.to(q), EVIDENCE_RADIUS_PX)
    mean = neighbours.window_sum(q, EVIDENCE_RADIUS_PX) / count.clamp_min(1)
    return torch.where(there, q, mean), there & (count >= MIN_FILLED_RATIO * (2 * EVIDENCE_RADIUS_PX + 1) ** 2)


def _spread(columns: Tensor, place: Tensor, depth: Tensor, at: Tensor) -> Tensor:
    """Sums (B, C, h, w) of columns (B, C, N) over all places around that lie on the same surface of the map, the
    nearer the more."""
    (B, C, _), (h, w) = columns.shape, depth.shape[-2:]
    step = torch.arange(-SUPPORT_RADIUS_PX, SUPPORT_RADIUS_PX + 1, device=depth.device)
    dv, du = (x.reshape(-1) for x in torch.meshgrid(step, step, indexing="ij"))
    distance = (du.square() + dv.square()).to(depth).sqrt()
    near = distance <= SUPPORT_RADIUS_PX
    du, dv, kernel = du[near], dv[near], (1 - distance[near] / (SUPPORT_RADIUS_PX + 1))
    centre = containing_pixels(place)
    around = centre[:, :, None] + torch.stack([du, dv], -1).to(centre)
    index, inside = nearest_pixel_index((h, w), around.flatten(1, 2))
    there = depth.flatten(1).gather(1, index).unflatten(1, (-1, len(du)))
    level = (there.clamp_min(1e-9) / at[..., None].clamp_min(1e-9)).log().abs() < SURFACE_LOG_RATIO
    weight = (level & inside.unflatten(1, (-1, len(du)))).to(depth) * kernel
    given = (columns[..., None] * weight[:, None]).flatten(2)
    total = depth.new_zeros(B, C, h * w)
    return total.scatter_add(2, index[:, None].expand_as(given), given).unflatten(-1, (h, w))
