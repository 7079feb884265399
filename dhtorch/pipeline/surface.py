"""Surface of a reference view from its posed source views: best plane by census costs, then a fit of grey values.

The unknown is one number per pixel, its inverse depth. Census codes find the plane, independent of exposure; grey
values then give the position between planes, each view weighted by its variance, and its standard deviation.

Alphabet: q inverse depth (1/m), as in :mod:`dhtorch.geometry.plane_sweep`.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry import plane_sweep, windows
from dhtorch.geometry.checks import any_possible
from dhtorch.ops.dispatch import operator
from dhtorch.pipeline.dense_options import DEFAULT_DENSE_OPTIONS, DenseOptions
from dhtorch.records import PoseFit


class SourceView(NamedTuple):
    """A view that is swept, with its pose and the covariance of that."""

    view: plane_sweep.SweptView
    picture: Tensor  # (B, 3, H, W), the view's grey image and its gradients
    fit: PoseFit
    use: Tensor  # (B,) bool


class RefinedSurface(NamedTuple):
    """The joint fit of all source views, (B, h, w) each."""

    q: Tensor  # 1/m
    own: Tensor  # 1/m², variance of q by grey values and by edges of the surface
    shared: Tensor  # 1/m², variance of q by the motions
    correlation: Tensor  # of the view that fits best, -1 where no view sees the pixel
    seen: Tensor  # bool, visible and not occluded in at least one view


class _SweptSurface(NamedTuple):
    """The best surface through the planes, (B, h, w) each."""

    q: Tensor  # 1/m, between the planes by a parabola
    misfit: Tensor  # cost of the surface there per view, see plane_sweep.aggregate_best_plane
    alone: Tensor  # bool, no other place along the ray costs nearly as little


@torch.no_grad()
def sweep_planes(
    base: plane_sweep.ReferenceView,
    source_views: list[SourceView],
    q: Tensor,
    options: DenseOptions = DEFAULT_DENSE_OPTIONS,
) -> _SweptSurface:
    """The surface of least census cost through the planes q (B, D) 1/m, rising from 0. Gradient: none."""
    n_views = torch.stack([source_view.use for source_view in source_views]).sum(0).clamp_min(1)
    best, aggregated = plane_sweep.aggregate_best_plane(_costs(base, source_views, q), n_views)
    spacing = q[:, 1] - q[:, 0]
    best_q = (best.plane + best.shift) * spacing[:, None, None]
    n_views = n_views[:, None, None]
    # Number of planes (B,) that move a pixel by ``second_best_radius_px`` in the view with the largest motion
    lengths = []
    sampled = best_q.flatten(1)[:, :: options.motion_stride_px]  # its median is close to that of all pixels
    for view, _, _, use in source_views:
        warp = plane_sweep.epipolar_warp(base, view)
        warp = warp._replace(a=warp.a[..., :: options.motion_stride_px])
        (u_0, v_0), (u_1, v_1) = (warp.at(sampled + k * spacing[:, None]) for k in (0, 1))
        length = torch.hypot(u_1 - u_0, v_1 - v_0).median(-1).values
        lengths.append(torch.where(use, length, 0.0))
    reach = (options.second_best_radius_px / torch.stack(lengths).amax(0).clamp_min(1e-3)).ceil().clamp(2, 1e4)
    margin = plane_sweep.second_best_margin(aggregated, best, reach)
    alone = margin >= options.min_second_best_margin * n_views
    misfit = (best.cost - _unused_cost(source_views, best.cost)[:, None, None]) / n_views.to(q)
    return _SweptSurface(best_q, misfit, alone)


def _unused_cost(source_views: list[SourceView], like: Tensor) -> Tensor:
    """Cost (B,) that views add to every plane of batch elements that do not use them."""
    unused = [~source_view.use for source_view in source_views if any_possible(source_view.use)]
    if not unused:
        return torch.zeros_like(source_views[0].use, dtype=like.dtype)
    return plane_sweep.N_PATHS * plane_sweep.UNSEEN_COST * torch.stack(unused).sum(0).to(like.dtype)


def _costs(base: plane_sweep.ReferenceView, source_views: list[SourceView], q: Tensor) -> Tensor:
    """Census cost of every pixel at every plane, summed over the views, (B, h, w, D) uint8."""
    C = plane_sweep.new_cost_volume(q, hw=base.hw)
    fresh = True
    for view, _, _, use in source_views:
        if any_possible(use):
            plane_sweep.add_census_costs(C, base, view, q, use, fresh=fresh)
            fresh = False
    if fresh:
        C.zero_()
    return plane_sweep.planes_last(C)


def refine_surface(
    base: plane_sweep.ReferenceView,
    source_views: list[SourceView],
    start: _SweptSurface,
    q: Tensor,
    steps: int,
    options: DenseOptions = DEFAULT_DENSE_OPTIONS,
) -> RefinedSurface:
    """The surface ``start`` refined by ``steps`` Gauss-Newton steps on the grey values of all views in use.

    ``q`` (B, D) 1/m are the planes of ``start``.

    Gradient: of the result's ``q`` to images, cameras and motions, by the implicit function theorem where the last
    step ends.
    """
    spacing = q[:, 1] - q[:, 0]
    max_shift = options.max_total_planes * spacing[:, None, None]
    tolerance = options.surface_planes * spacing
    with torch.no_grad():
        warps = [plane_sweep.epipolar_warp(base, source_view.view) for source_view in source_views]
        low, high = ((start.q + sign * max_shift).clamp_min(0) for sign in (-1, 1))
        at = windows.smooth_within_tolerance(start.q, tolerance)
        for _ in range(steps):
            at = (at + _joint_step(base, source_views, warps, at, spacing, options)[0]).clamp(low, high)
            at = windows.smooth_within_tolerance(at, tolerance)
    step, sums = _joint_step(base, source_views, warps, at, spacing, options, last=True)
    if step.requires_grad:
        step = step / _step_derivative(base, source_views, warps, at, spacing, options)
    edge_sigma = options.edge_sigma_ratio * windows.window_range(at, options.edge_radius_px)
    own = 1 / sums.weight * (start.misfit / options.nominal_cost).square() + edge_sigma.square()
    assert sums.shared is not None
    shared = torch.where(sums.weight > 0, sums.shared / sums.weight, torch.inf)
    return RefinedSurface(at + (step - step.detach()), own, shared, sums.best, sums.seen)


@torch.no_grad()
def _step_derivative(
    base: plane_sweep.ReferenceView,
    source_views: list[SourceView],
    warps: list[plane_sweep.EpipolarWarp],
    at: Tensor,
    spacing: Tensor,
    options: DenseOptions,
) -> Tensor:
    """Negative derivative (B, h, w) of the step by inverse depth: 1 where grey values are linear between pixels.

    Divided by it, the gradient of the step becomes that of the surface where the steps end.
    """
    delta = options.derivative_planes * spacing[:, None, None]
    before, after = (_joint_step(base, source_views, warps, at + sign * delta, spacing, options)[0] for sign in (-1, 1))
    return ((before - after) / (2 * delta)).clamp_min(options.min_step_derivative)


def _joint_step(
    base: plane_sweep.ReferenceView,
    source_views: list[SourceView],
    warps: list[plane_sweep.EpipolarWarp],
    at: Tensor,
    spacing: Tensor,
    options: DenseOptions,
    *,
    last: bool = False,
) -> "tuple[Tensor, _ViewSums]":
    """The step (B, h, w) at inverse depths ``at``, the weighted mean of the views' steps, and the sums over the views.

    Weights are inverse variances. The variance by the motions (``shared``) is computed only for the ``last`` step.
    Gradient: of the step.
    """
    sums: _ViewSums | None = None
    for (view, picture, fit, use), warp in zip(source_views, warps, strict=True):
        window = plane_sweep.fit_windows(base, view, picture, at)
        with torch.no_grad():
            occluded = plane_sweep.occlusion_mask(warp, at, options.occlusion_planes * spacing)
            visible = window.seen & use[:, None, None] & ~occluded
            pose_var = pose_variance(base, view, fit, at, window.motion) if last else None
        max_step = options.max_step_planes * spacing
        columns = window.step, window.contrast, window.noise, window.correlation
        before = (None,) * len(_ViewSums._fields) if sums is None else sums
        sums = _add_to_sums(*columns, visible, max_step, pose_var, *before, options=options)
    assert sums is not None
    # Below any weight of a view: no division by 0.
    return sums.step / sums.weight.clamp_min(1e-37), sums


class _ViewSums(NamedTuple):
    """Weighted sums over the views, (B, h, w) each: of their steps and of the variances by their motions."""

    step: Tensor
    weight: Tensor
    best: Tensor  # largest correlation, -1 where no view sees the pixel
    seen: Tensor  # bool
    shared: Tensor | None  # None without variances by motions


def _add_to_sums_kernel(*tensors: Tensor | None, options: DenseOptions) -> _ViewSums:
    columns, pose_var, before = tensors[:6], tensors[6], tensors[7:]
    first = before[0] is None
    if first:
        step, *_, visible, _ = columns
        like = step, step, step, visible, pose_var
        before = tuple(None if x is None else torch.empty_like(x) for x in like)
    *sums, shared = before
    none = columns[0].new_empty(0)  # type: ignore[union-attr]
    variances = (none, none) if pose_var is None else (pose_var, shared)
    limits = options.grey_noise**2, options.independent_window_pixels, options.min_window_correlation
    torch.ops.dhtorch.add_view.default(*columns, *variances, *sums, *limits, first)  # in place
    return _ViewSums(*before)  # type: ignore[arg-type]


@operator(
    kernel=_add_to_sums_kernel,
    dtypes=dict.fromkeys(("step", "contrast", "noise", "correlation"), torch.float32)
    | {"visible": torch.bool}
    | dict.fromkeys(("max_step", "pose_var", "sum_step", "sum_weight", "best"), torch.float32)
    | {"seen": torch.bool, "sum_shared": torch.float32},
)
def _add_to_sums(*tensors: Any, options: DenseOptions) -> _ViewSums:
    """:func:`_add_view` of the fields of a window fit and of the sums; it may overwrite the latter."""
    step, contrast, noise, correlation, visible, max_step, pose_var, *before = tensors
    if before[0] is None:
        zeros = torch.zeros_like(correlation)
        before = [zeros, zeros, torch.full_like(zeros, -1), torch.zeros_like(visible), zeros]
    sum_step, sum_weight, best, seen, sum_shared = before
    with torch.no_grad():
        own = (noise + options.grey_noise**2) / (options.independent_window_pixels * contrast)
        weight = torch.where(visible & (correlation > options.min_window_correlation), 1 / own, 0.0)
        shared = None if pose_var is None else sum_shared + weight * pose_var
        best = torch.where(visible, torch.maximum(best, correlation), best)
    limit = max_step[:, None, None]
    total = sum_step + weight * torch.minimum(torch.maximum(step, -limit), limit)
    return _ViewSums(total, sum_weight + weight, best, seen | visible, shared)


def pose_variance(
    base: plane_sweep.ReferenceView, view: plane_sweep.SweptView, fit: PoseFit, q: Tensor, motion: Tensor
) -> Tensor:
    """Variance (B, h, w) in 1/m² of inverse depths q (B, h, w) 1/m that the covariance of a view's pose causes.

    ``motion`` (B, h, w, 2) px·m is d pixel / d q in the view, from :func:`dhtorch.geometry.plane_sweep.fit_windows`.
    """
    cov = fit.cov if fit.shutter is None else fit.shutter.cov
    cov = torch.where(fit.ok[:, None, None], cov, 0.0).nan_to_num().to(q)
    T = view.T_1_from_0
    pose_args = T.R, T.t, view.camera.f, cov
    return _pose_variance(base.ray, q.flatten(1), *pose_args, motion.flatten(1, 2)).view_as(q)


def _pose_variance_kernel(*tensors: Tensor) -> Tensor:
    ray, q, R, t, f, cov, motion = tensors
    variance = torch.empty_like(q)
    # Least inverse depth (1/m), squared motion of a pixel ((px·m)²) and depth (m) that are divided by.
    limits = 1e-6, 1e-12, 1e-9
    ray_rows, motion_rows = (x.mT.contiguous() for x in (ray, motion))
    torch.ops.dhtorch.pose_variance.default(ray_rows, q, *(R, t, f), cov.contiguous(), motion_rows, variance, *limits)
    return variance


@operator(
    kernel=_pose_variance_kernel,
    dtypes=dict.fromkeys(("ray", "q", "R", "t", "f", "cov", "motion"), torch.float32),
    any_layout=("ray", "cov", "motion"),
)
def _pose_variance(*tensors: Any) -> Tensor:
    """:func:`pose_variance` (B, N) of rays (B, N, 3) with ``motion`` (B, N, 2) px·m in a view with focal lengths f
    (B, 2), from the covariance (B, 6, 6) of its pose R, t, or (B, 9, 9) with a rolling shutter's rotation."""
    ray, q, R, t, f, cov, motion = tensors
    q_safe = q.clamp_min(1e-6)
    x, y, z = (
        part / q_safe + t[:, None] for part, t in zip(plane_sweep.rotate_rays(R, ray), t.unbind(-1), strict=True)
    )
    du, dv = motion.unbind(-1)
    inv_square = 1 / (du * du + dv * dv).clamp_min(1e-12)
    # derivative along the motion by the point, as epipolar.point_jacobians, one tensor per component
    inv_z = 1 / torch.where(z.abs() < 1e-9, torch.full_like(z, 1e-9), z)
    gx, gy = (f[:, None] * inv_z * d * inv_square for f, d in zip(f.unbind(-1), (du, dv), strict=True))
    gz = -(gx * x + gy * y) * inv_z
    rotation = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
    row = [*rotation, gx, gy, gz]
    if cov.shape[-1] > len(row):
        row += [r * ray[..., 1] for r in rotation]
    total = torch.zeros_like(z)
    for i, r in enumerate(row):  # written out: the rounding of a matrix product depends on the batch size
        product = row[0] * cov[:, i, 0, None]
        for j in range(1, len(row)):
            product = torch.addcmul(product, row[j], cov[:, i, j, None])
        total = torch.addcmul(total, product, r)
    return total.clamp_min(0)
