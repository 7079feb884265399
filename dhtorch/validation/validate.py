"""Validation of a depth map: consistent, wrong or unknown per pixel; scale, shift, tilt and wrong fraction per frame.

    method ─ near returns, triangulated points ─ sparse_evidence ────────────┐
           └ motions ─ pictures of source views ─ photometric_evidence ──────┼─ states ─┐
                     └ maps of source views ──── depth_consistency_evidence ─┘          ├─ DepthValidation
             ratios to the sparse references ─ scale, shift, tilt ──────────────────────┘

The map may come from anywhere. The metric scale of the motions is that of the sensor's returns: where the map is the
sensor's own, a wrong scale is common to the map and to all references, and only a given trajectory
(``T_world_from_cam``) can detect it.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from dhtorch import pytree
from dhtorch.codes import Gate, State
from dhtorch.geometry import camera as cam
from dhtorch.geometry import plane_sweep, se3
from dhtorch.geometry.checks import check
from dhtorch.geometry.covariance import masked_median
from dhtorch.geometry.patches import sample_nearest
from dhtorch.pipeline import dense
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import AUTO, MAP
from dhtorch.pipeline.spec import Trace
from dhtorch.pipeline.surface import SourceView
from dhtorch.pipeline.view_report import with_view_selection
from dhtorch.records import NO_HINT, DepthValidation, Estimate, Frame, PoseFit, TrackHint
from dhtorch.runtime.numerics import standard_numerics
from dhtorch.validation import evidence, wrong_causes
from dhtorch.validation.evidence import Evidence, ValidationReferences
from dhtorch.validation.options import DEFAULT_VALIDATION_OPTIONS, ValidationOptions

#: Sparse method of a fast validation, with one source view and ``views=False``: some dozens of points determine the
#: scale, and as few their motion. ``experiment=validate_study`` compares it with the whole method.
QUICK_METHOD = MAP.replace(n=256, hypotheses=64, pose={"near_steps": 2, "steps": 3})


@standard_numerics
def validate_depth(
    depth_map: Tensor | None,  # (B, h, w) m, 0 or not finite = no value; None = the sensor's own
    reference: Frame,
    others: Frame | Sequence[Frame] | None = None,
    *,
    other_maps: Tensor | None = None,  # (V, B, h', w') m
    method: Method = AUTO,
    views: bool = True,
    source_views: int = 2,
    size: int = 320,
    tolerance: float = 0.025,
    options: ValidationOptions = DEFAULT_VALIDATION_OPTIONS,
    seed: int | Tensor = 0,
    fit: PoseFit | None = None,
    hint: TrackHint = NO_HINT,
    trace: Trace | None = None,
) -> DepthValidation:
    """Depth map, reference view and source views -> state of every pixel and numbers of the frame, with intervals.

    Args:
        depth_map: over the field of view of the reference view's picture, of any size.
        reference: B reference views, whose near returns determine the metric scale.
        others: source views, as :class:`dhtorch.pipeline.method.Method` takes them; None = near returns are the only
            evidence.
        other_maps: maps of the source views from the same source as ``depth_map``; for the sensor's own map it is the
            views' own depth.
        method: the sparse method that triangulates points and estimates motions; it selects among the views.
        views: also use the pictures of source views; False is faster, with sparse evidence alone.
        source_views: most source views whose pictures are used, those with the most information.
        size: longer side of the validation grid, px.
        tolerance: relative error that never counts as wrong; at most a third of the error that must be detected.
        options: tuning constants of evidence, states and numbers.
        seed, fit, hint, trace: as :class:`dhtorch.pipeline.method.Method` takes them.

    Returns:
        DepthValidation (B, h, w) over the field of view of the reference view's picture. CONSISTENT only where evidence
        that would have detected an error of 20 % finds none; WRONG where some refutes the depth by three sigmas;
        CANNOT_KNOW where kinds of evidence contradict each other, or there is none. Where a map is clipped
        (``clip_depth``: all larger depths have that value) the pixels at that depth are WRONG or CANNOT_KNOW, since
        their depth is only a lower bound.

    Raises:
        ValueError: wrong shapes, maps that are no real numbers or have fewer than 2×2 pixels, or an option out of
            range.

    Gradient: none.
    Cost: that of the method, and with ``views`` eleven fits of every grid pixel for each source view.
    """
    limit = options.detectable_log_ratio / options.refuting_evidence_sigmas
    if not 0 < tolerance < limit:
        raise ValueError(f"validate_depth: tolerance is {tolerance}, expected above 0 and below {limit:.3f}")
    if size < 16 or source_views < 1:
        raise ValueError(f"validate_depth: size is {size}, source views {source_views}, expected at least 16 and 1")
    check("validate_depth", image=(reference.image, "B C H W"), depth_map=(depth_map, "B h w"))
    check("validate_depth", depth=(reference.depth, "B y x"), depth_map=(depth_map, "B h w"))
    check("validate_depth", other_maps=(other_maps, "V B h w"))
    for name, maps in (("depth_map", depth_map), ("other_maps", other_maps)):
        if maps is not None and (maps.dtype == torch.bool or maps.is_complex()):
            kind = str(maps.dtype).removeprefix("torch.")
            raise ValueError(f"validate_depth: {name} is of {kind}, expected real numbers, m")
        if maps is not None and min(maps.shape[-2:]) < 2:
            raise ValueError(f"validate_depth: {name} has shape {tuple(maps.shape)}, expected at least 2×2 pixels")
    trace = {} if trace is None else trace
    with torch.no_grad():
        selected_views = (
            None if others is None else _estimate_views(method, reference, others, trace, seed=seed, fit=fit, hint=hint)
        )
        return validate_against(
            depth_map,
            reference,
            selected_views,
            trace["choice"].index if "choice" in trace else None,
            other_maps=other_maps,
            method=method,
            views=views,
            source_views=source_views,
            size=size,
            tolerance=tolerance,
            options=options,
        )


@torch.no_grad()
@standard_numerics
def validate_against(
    depth_map: Tensor | None,  # (B, h, w) m, 0 or not finite = no value; None = the sensor's own
    reference: Frame,
    selected: dense.SelectedViews | None,
    offered: Tensor | None = None,  # (views, B) index of the selected views among those passed; None = all
    *,
    other_maps: Tensor | None = None,  # (V, B, h', w') m
    method: Method = AUTO,
    views: bool = True,
    source_views: int = 2,
    size: int = 320,
    tolerance: float = 0.025,
    options: ValidationOptions = DEFAULT_VALIDATION_OPTIONS,
) -> DepthValidation:
    """Depth map and the result of the sparse method -> validation: the second half of :func:`validate_depth`, for
    several maps of one frame.

    Arguments, result, errors and cost as there. Gradient: none.
    """
    hw = dense.map_hw(reference.hw, size)
    # Depths of the same pixel are compared: without a separate depth camera the lens distortion does not matter.
    undistorted = (
        reference if reference.depth_camera is not None else reference.replace(camera=cam.ideal(reference.camera))
    )
    returns = method.backproject(undistorted, dense.map_pixel_centres(reference, hw)).map(lambda x: x.unflatten(1, hw))
    is_sensor_map = depth_map is None
    grid = _finite_positive(
        returns.depth if depth_map is None else _resize_nearest(depth_map.to(reference.camera.f), hw)
    )
    samples = method.sample_depth(reference) if selected is None else selected.samples
    estimate = Estimate.unanswered(samples, Gate.NO_TRACK, n_views=0) if selected is None else selected.joined
    points = evidence.validation_references(samples, estimate, near=not is_sensor_map)
    resolution = torch.zeros_like(grid) if depth_map is None else evidence.resolution_sigma(depth_map.to(grid), hw)
    points = evidence.inflate_sigma(points, resolution, reference.hw)
    allowed_sigma = (resolution.square() + tolerance**2).sqrt()
    sparse = evidence.sparse_evidence(
        grid, reference.hw, points, allowed_sigma, None if is_sensor_map else returns, options
    )
    nothing = evidence.no_evidence(grid)
    photometric = consistency = nothing
    flying = outlines = wrong_causes.RefutedPixels(nothing.misfit, nothing.view, nothing.sure)
    if selected is not None and views:
        n = len(selected.fits.code)
        number = torch.arange(n)[:, None].expand(-1, len(grid)) if offered is None else offered
        maps = None if is_sensor_map else other_maps
        photometric, consistency, outlines = _evidence_of_views(
            grid,
            reference,
            selected,
            number.to(grid.device),
            maps=maps,
            is_sensor_map=is_sensor_map,
            most=source_views,
            allowed_sigma=allowed_sigma,
            options=options,
        )
        flying = _flying_pixels(grid, depth_map, allowed_sigma, options)
        # Between two pixels of a coarser map an outline lies anywhere.
        is_between = resolution > tolerance
        outlines = outlines._replace(
            misfit=outlines.misfit.masked_fill(is_between, torch.nan), unsupported=outlines.unsupported & ~is_between
        )
    agrees = torch.zeros_like(flying.unsupported)
    if not is_sensor_map:
        ratio = torch.where(returns.usable, grid / torch.where(returns.usable, returns.depth, 1.0), 0.0)
        agrees = ratio.clamp_min(1e-6).log().abs() < options.supporting_evidence_sigmas * allowed_sigma
    combined = combine_evidence(sparse, photometric, consistency, options=options)
    clip_depth, at_clip_depth = clipped_depth(grid, *combined[:2], options)
    is_flying, at_outline, state, misfit, view = _refute_outlines(combined, flying, outlines, agrees, options)
    state = torch.where(at_clip_depth & (state != State.WRONG), State.CANNOT_KNOW, state).to(torch.int32)
    window = (2 * options.evidence_radius_px + 1) ** 2  # its pixels count as one independent pixel
    n_wrong, n_known = (m.sum((1, 2)) / window for m in (state == State.WRONG, state != State.CANNOT_KNOW))
    point_depth = evidence.triangulated_depth(grid, reference.hw, points, options)
    no_scale = torch.full((len(grid), 3), torch.nan).to(grid)
    by_trajectory = no_scale if selected is None else _scale_vs_trajectory(reference, selected, options)
    scale, near, far, shift, tilt = _frame_numbers(grid, reference, points, is_sensor_map, options)
    return DepthValidation(
        depth=grid,
        state=state,
        evidence=misfit,
        view=view,
        sparse_evidence=sparse.misfit,
        photometric_evidence=photometric.misfit,
        consistency_evidence=consistency.misfit,
        outline_evidence=at_outline,
        cause=wrong_causes.name_causes(grid, state, misfit, point_depth, is_flying, options),
        scale=by_trajectory if is_sensor_map else scale,
        scale_near=near,
        scale_far=no_scale if is_sensor_map else far,
        scale_vs_trajectory=by_trajectory,
        shift=shift,
        tilt=tilt,
        wrong=share_interval(n_wrong.to(grid), n_known.to(grid)),
        clip_depth=clip_depth,
    )


def _top_views(
    grid: Tensor, reference: Frame, selected: dense.SelectedViews, most: int
) -> tuple[plane_sweep.ReferenceView, Tensor, list[SourceView]]:
    """The reference view on the grid, and the ``most`` informative selected views: their index and images."""
    base = plane_sweep.make_reference_view(*dense.downscale_grey(reference, max(grid.shape[-2:])))
    index, use_view = dense.top_views(selected, most)
    has_baseline = selected.fits.t_snr > 5  # the translation is significant
    use_view = selected.fits.ok.gather(0, index) & (use_view | has_baseline.gather(0, index))
    views = [
        dense.source_view_of(selected, k, max(base.hw), use, base.image) for k, use in zip(index, use_view, strict=True)
    ]
    return base, index, views


def _estimate_views(
    method: Method, reference: Frame, others: Frame | Sequence[Frame], trace: Trace, **method_args: Any
) -> dense.SelectedViews:
    """Result of the sparse method on the reference view, with view selection if there are more than it uses."""
    others = others if isinstance(others, Frame) else pytree.stack(others)
    several = others.image.dim() == 5
    method = with_view_selection(method) if several and len(others.image) > method.views else method
    estimate = method(reference, others, trace=trace, **method_args)
    return dense.selected_views(estimate, others, trace)


def _evidence_of_views(
    grid: Tensor,
    reference: Frame,
    selected: dense.SelectedViews,
    number: Tensor,  # (views, B) index of the selected views among those passed
    *,
    maps: Tensor | None,
    is_sensor_map: bool,
    most: int,
    allowed_sigma: Tensor,
    options: ValidationOptions,
) -> tuple[Evidence, Evidence, wrong_causes.RefutedPixels]:
    """Photometric and depth consistency evidence of the most informative views, and evidence at outlines from all views
    with a motion, numbered among the views passed."""
    base, index, views = _top_views(grid, reference, selected, most)
    places = number.gather(0, index)
    photometric = evidence.photometric_evidence(grid, base, views, allowed_sigma, options)
    consistency = evidence.no_evidence(grid)
    batch = torch.arange(len(grid), device=grid.device)
    depths = [] if maps is None else [_nearest_surfaces(maps.to(grid)[n, batch], base.hw) for n in places]
    if is_sensor_map:
        depths = [_sensor_map(selected.frames[k, batch], base.hw) for k in index]
    if depths:
        depths = [_finite_positive(depth) for depth in depths]
        consistency = evidence.depth_consistency_evidence(grid, base, views, depths, allowed_sigma, options)
    base, index, views = _top_views(grid, reference, selected, len(selected.fits.code))
    outlines = wrong_causes.outline_evidence(grid, base, views, options)
    return (
        photometric._replace(view=_renumber_views(photometric.view, places)),
        consistency._replace(view=_renumber_views(consistency.view, places)),
        outlines._replace(view=_renumber_views(outlines.view, number.gather(0, index))),
    )


def _flying_pixels(
    grid: Tensor, depth_map: Tensor | None, allowed_sigma: Tensor, options: ValidationOptions
) -> wrong_causes.RefutedPixels:
    """Flying pixels on the grid, of a coarser map on its own pixels."""
    hw = (grid.shape[-2], grid.shape[-1])
    if depth_map is None or not evidence.is_coarser(depth_map, hw):
        return wrong_causes.flying_evidence(grid, allowed_sigma, options)
    own = _finite_positive(depth_map.to(grid))
    sigma = _resize_nearest(allowed_sigma, (own.shape[-2], own.shape[-1]))
    flying = wrong_causes.flying_evidence(own, sigma, options)
    return wrong_causes.RefutedPixels(*(_resize_nearest(x, hw) for x in flying))


def _renumber_views(view: Tensor, number: Tensor) -> Tensor:
    """Indices (B, h, w) of selected views -> among the views passed, ``number`` (V, B) of the selected ones."""
    batch = torch.arange(number.shape[1], device=number.device)[:, None, None]
    place = number[view.clamp_min(0).long(), batch].to(torch.int32)
    return torch.where(view >= 0, place, view)


# -------------------------------------------------------------------------------------------------- maps on one grid


def _finite_positive(depth: Tensor) -> Tensor:
    """Depth with 0 where it is not finite or not positive."""
    depth = depth.nan_to_num(0.0, 0.0, 0.0)
    return torch.where(depth > 0, depth, 0.0)


def _resize_nearest(depth_map: Tensor, hw: tuple[int, int]) -> Tensor:
    """Map (…, h, w) resampled to a grid of size ``hw`` by the nearest pixel."""
    rows, columns = (
        evidence.pixel_centres(n, m, depth_map.device).floor().long().clamp_max(n - 1)
        for n, m in zip(depth_map.shape[-2:], hw, strict=True)
    )
    return depth_map[..., rows[:, None], columns]


def _nearest_surfaces(depth_map: Tensor, hw: tuple[int, int]) -> Tensor:
    """Map resampled to a grid; a coarser one by the least depth of the pixels around, since an outline lies anywhere
    between two."""
    if evidence.is_coarser(depth_map, hw):
        valid_depth = _finite_positive(depth_map)
        depth_map = torch.where(valid_depth > 0, evidence.nearest_surface(valid_depth), 0.0)
    return _resize_nearest(depth_map, hw)


def _sensor_map(frame: Frame, hw: tuple[int, int]) -> Tensor:
    """Sensor depth of a view at the pixels of a grid over its picture."""
    uv = dense.map_pixel_centres(frame, hw).expand(len(frame.camera.f), -1, -1)
    depth_hw = frame.depth.shape[-2], frame.depth.shape[-1]
    place = cam.depth_pixels(frame.camera, frame.hw, frame.depth_camera, depth_hw, uv)
    depth, inside = sample_nearest(frame.depth.to(uv), place)
    return torch.where(inside, depth, 0.0).unflatten(1, hw)


# -------------------------------------------------------------------------------------------------------------- states


def _refute_outlines(
    combined: tuple[Tensor, Tensor, Tensor],
    flying: wrong_causes.RefutedPixels,
    outlines: wrong_causes.RefutedPixels,
    agrees: Tensor,  # (B, h, w) bool, with a near return at the pixel itself, of another sensor than the map
    options: ValidationOptions,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """State, misfit and view of the other evidence, changed where flying pixels or the surface beyond an outline refute
    a pixel -> flying pixels, evidence at outlines, state, misfit, view.

    Windows and references around a pixel do not support it there: it is unknown where the pictures fit its own depth
    little better than the surface beyond the outline. Where a near return at the pixel itself agrees, nothing changes.
    """
    state, misfit, view = combined
    is_flying = flying.misfit.isfinite()
    at_outline, outline_view, unsupported = (
        torch.where(is_flying, a, b) for a, b in zip(flying, outlines, strict=True)
    )
    refuted = (at_outline.abs() > options.refuting_evidence_sigmas) & ~agrees
    new = refuted & (state != State.WRONG)
    unsupported = (state == State.CONSISTENT) & unsupported & ~agrees
    state = torch.where(new, State.WRONG, torch.where(unsupported, State.CANNOT_KNOW, state)).to(torch.int32)
    return is_flying, at_outline, state, torch.where(new, at_outline, misfit), torch.where(new, outline_view, view)


def clipped_depth(
    grid: Tensor, state: Tensor, misfit: Tensor, options: ValidationOptions = DEFAULT_VALIDATION_OPTIONS
) -> tuple[Tensor, Tensor]:
    """Map, states and misfits -> depth (B,) at which the map is clipped, NaN where it is not, and the pixels (B, h, w)
    at that depth.

    A plateau at the largest depth of a map may be a wall in front of the camera: it is a clip depth where evidence
    shows that much of it is too near. Correlation windows across its outline show the foreground, and sparse references
    at the outline lie on a "surface" that clipping has merged from two: both support pixels that are wrong.

    Gradient: none.
    """
    farthest = grid.amax((1, 2))
    at_plateau = (grid > 0) & (grid >= farthest[:, None, None])
    n = (grid > 0).sum((1, 2)).clamp_min(1)
    too_near, decided = (state == State.WRONG) & (misfit < 0), state != State.CANNOT_KNOW
    rate, other_rate = (
        (too_near & m).sum((1, 2)) / (decided & m).sum((1, 2)).clamp_min(1)
        for m in (at_plateau, (grid > 0) & ~at_plateau)
    )
    is_clipped = (
        (at_plateau.sum((1, 2)) >= options.min_plateau_ratio * n)
        & (rate >= options.min_clipped_wrong_ratio)
        & (rate > options.clipped_rate_factor * other_rate)
    )
    return torch.where(is_clipped, farthest, torch.nan), at_plateau & is_clipped[:, None, None]


def combine_evidence(
    *kinds: Evidence, options: ValidationOptions = DEFAULT_VALIDATION_OPTIONS
) -> tuple[Tensor, Tensor, Tensor]:
    """Sparse, photometric and consistency evidence -> state, misfit and view (B, h, w).

    A pixel is wrong where one kind refutes it, unless another kind supports it. Gradient: none.
    """
    refuting = torch.stack([k.misfit.abs() > options.refuting_evidence_sigmas for k in kinds])
    supporting = torch.stack([k.sure & (k.misfit.abs() < options.supporting_evidence_sigmas) for k in kinds])
    wrong, consistent = refuting.any(0), supporting.any(0)
    state = torch.where(wrong, State.WRONG, torch.where(consistent, State.CONSISTENT, State.CANNOT_KNOW))
    state = torch.where(wrong & consistent, State.CANNOT_KNOW, state).to(torch.int32)
    misfit = torch.stack([k.misfit for k in kinds])
    size = misfit.abs().nan_to_num(-1.0)
    most = torch.where(refuting, size, -1.0).argmax(0)
    least = torch.where(supporting, size, torch.inf).argmin(0)
    largest = size.argmax(0)
    pick = torch.where(wrong, most, torch.where(consistent, least, largest))[None]
    view = torch.stack([k.view for k in kinds]).gather(0, pick)[0]
    picked = misfit.gather(0, pick)[0]
    return state, picked, torch.where(picked.isnan(), -2, view).to(torch.int32)


def share_interval(part: Tensor, whole: Tensor) -> Tensor:
    """Counts (B,) of a part and of the whole -> ratio (B, 3) with its interval of 95 %; NaN of none. Gradient: none.

    Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference", 1927.
    """
    n, z = whole.clamp_min(1e-6), 1.96
    p = part / n
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * (p * (1 - p) / n + z * z / (4 * n * n)).sqrt()
    out = torch.stack([p, (middle - half).clamp_min(0), (middle + half).clamp_max(1)], -1)
    return torch.where((whole > 0)[:, None], out, torch.nan)


def _frame_numbers(
    grid: Tensor, reference: Frame, points: ValidationReferences, is_sensor_map: bool, options: ValidationOptions
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Map and sparse references -> scale, that of near and of far references, shift and tilt, (B, 3) each: value, low,
    high."""
    h, w = grid.shape[-2:]
    depth_at, inside = sample_nearest(grid, cam.resize_pixels(points.uv, reference.hw, (h, w)))
    used = points.used & inside & (depth_at > 0)
    ratio = torch.where(used, depth_at / points.depth, 1.0)
    log = ratio.log()
    own_sigma = (points.sigma.square() - points.shared.square()).clamp_min(1e-6).sqrt()
    kinds = []
    for mask, scale_sigma in ((points.near, options.sensor_scale_sigma), (~points.near, 0.0)):
        shared = masked_median(points.shared, used & mask)[:, 0].nan_to_num()
        common = (shared.square() + scale_sigma**2).sqrt()
        kinds.append(_robust_mean(log, own_sigma, used & mask, common, options))
    near, far = kinds
    both = _inverse_variance_mean(near, far)
    if is_sensor_map:
        near = both = (torch.full_like(near[0], torch.nan), near[1])
    shape = _shift_and_tilt(ratio, points, used, own_sigma, reference.hw, options)
    return (*(_factor_interval(*of) for of in (both, near, far)), *shape)  # type: ignore[return-value]


def _robust_mean(
    x: Tensor, sigma: Tensor, used: Tensor, common: Tensor, options: ValidationOptions
) -> tuple[Tensor, Tensor]:
    """Robust mean (B,) of x (B, N) by Tukey's biweight, and its standard deviation, which includes the ``common`` (B,)
    one; NaN of too few."""
    mean = masked_median(x, used)
    spread = 1.483 * masked_median((x - mean).abs(), used)
    n = used.sum(-1)
    for _ in range(5):
        width = (sigma.square() + spread.square()).sqrt().clamp_min(1e-4)
        t = (x - mean) / (3.0 * width)
        weight = torch.where(used & (t.abs() < 1), (1 - t.square()).square() / width.square(), 0.0)
        mean = ((weight * x).sum(-1, keepdim=True) / weight.sum(-1, keepdim=True).clamp_min(1e-12)).where(
            weight.sum(-1, keepdim=True) > 0, mean
        )
    effective = n.clamp(1, options.max_independent_references).to(x)
    own_sd = (spread[:, 0].square() + masked_median(sigma, used)[:, 0].square()).sqrt() / effective.sqrt()
    sd = (own_sd.square() * 1.5 + common.square()).sqrt()
    too_few = n < options.min_scale_references
    return torch.where(too_few, torch.nan, mean[:, 0]), torch.where(too_few, torch.inf, sd)


def _inverse_variance_mean(*parts: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Inverse variance mean (B,) of the defined parts, and its standard deviation, larger where the parts disagree."""
    value = torch.stack([v for v, _ in parts])
    weight = torch.stack([torch.where(v.isfinite(), 1 / s.square().clamp_min(1e-12), 0.0) for v, s in parts])
    total = weight.sum(0)
    mean = (weight * value.nan_to_num()).sum(0) / total.clamp_min(1e-12)
    chi = (weight * (value.nan_to_num() - mean).square()).sum(0)
    sd = (chi.clamp_min(1.0) / total.clamp_min(1e-12)).sqrt()
    return torch.where(total > 0, mean, torch.nan), sd


def _factor_interval(log: Tensor, sd: Tensor) -> Tensor:
    """Logarithm of a factor and its standard deviation -> the factor (B, 3) with its interval of 95 %."""
    return torch.stack([log, log - 1.96 * sd, log + 1.96 * sd], -1).exp().where(log.isfinite()[:, None], torch.nan)


def _shift_and_tilt(
    ratio: Tensor,
    points: ValidationReferences,
    used: Tensor,
    sigma: Tensor,
    hw: tuple[int, int],
    options: ValidationOptions,
) -> tuple[Tensor, Tensor]:
    """Shift in m and tilt, (B, 3) each, of map / reference = scale + shift / reference + tilt · place."""
    size = torch.tensor([hw[1], hw[0]]).to(ratio)
    place = (points.uv + 0.5) / size - 0.5
    inverse = torch.where(used, 1 / points.depth, 0.0)
    X = torch.cat([torch.ones_like(inverse)[..., None], inverse[..., None], place], -1).double()
    y = ratio.double()
    median = masked_median(ratio, used).double()
    spread = 1.483 * masked_median((ratio - median.to(ratio)).abs(), used).double()
    width = (sigma.double().square() + spread.square()).sqrt().clamp_min(1e-4)
    residual = y - median
    eye = 1e-9 * torch.eye(4).to(X)
    for _ in range(6):
        t = residual / (3.0 * width)
        weight = torch.where(used & (t.abs() < 1), (1 - t.square()).square() / width.square(), 0.0)
        normal = (X * weight[..., None]).mT @ X + eye
        beta = torch.linalg.solve(normal, ((X * weight[..., None]).mT @ y[..., None]))[..., 0]
        residual = y - (X @ beta[..., None])[..., 0]
    n = used.sum(-1).clamp_min(1)
    inflation = (n / n.clamp_max(options.max_independent_references)).double()[:, None, None]
    cov = torch.linalg.inv(normal) * inflation * 1.5
    too_few = (n < options.min_shape_references)[:, None]
    sd = cov.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    shift = torch.stack([beta[:, 1], beta[:, 1] - 1.96 * sd[:, 1], beta[:, 1] + 1.96 * sd[:, 1]], -1)
    gradient = beta[:, 2:]
    magnitude = gradient.norm(dim=-1)
    direction = gradient / magnitude.clamp_min(1e-12)[:, None]
    sd_tilt = ((direction[:, None] @ cov[:, 2:, 2:] @ direction[..., None])[:, 0, 0]).clamp_min(0).sqrt()
    tilt = torch.stack([magnitude, (magnitude - 1.96 * sd_tilt).clamp_min(0), magnitude + 1.96 * sd_tilt], -1)
    return tuple(torch.where(too_few, torch.nan, x.to(ratio)) for x in (shift, tilt))  # type: ignore[return-value]


def _scale_vs_trajectory(reference: Frame, selected: dense.SelectedViews, options: ValidationOptions) -> Tensor:
    """Ratio (B, 3) of the sensor's metric scale to the trajectory's, by the baselines of the views; NaN
    without a trajectory."""
    no_scale = torch.full((len(reference.camera.f), 3), torch.nan).to(reference.camera.f)
    if reference.T_world_from_cam is None or selected.frames.T_world_from_cam is None:
        return no_scale
    V = len(selected.fits.t_snr)
    T_world_from_reference = reference.T_world_from_cam.map(lambda x: x.expand(V, *x.shape))
    trajectory_baseline = torch.stack(
        [se3.relative(T_world_from_reference[k], selected.frames.T_world_from_cam[k]).t.norm(dim=-1) for k in range(V)]
    ).to(no_scale)
    baseline = selected.fits.T_1_from_0.t.norm(dim=-1)
    used = selected.fits.ok & (selected.fits.t_snr > 10) & (trajectory_baseline > 0.01) & baseline.isfinite()
    log = torch.where(used, baseline / trajectory_baseline.clamp_min(1e-6), 1.0).clamp_min(1e-6).log().T
    n = used.sum(0)
    median = masked_median(log, used.T)
    spread = 1.483 * masked_median((log - median).abs(), used.T)[:, 0].where(n > 2, 0.0)
    noise = masked_median(1 / selected.fits.t_snr.clamp_min(1).T, used.T)[:, 0].where(n > 0, 1.0)
    sd = (spread.square() + noise.square() + options.trajectory_scale_sigma**2).sqrt()
    return _factor_interval(torch.where(n > 0, median[:, 0], torch.nan), sd)
