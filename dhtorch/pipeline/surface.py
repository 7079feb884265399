"""The surface that a view and its source views show together: found among planes, then fitted by grey values.

What is searched for is one number a pixel, its inverse depth. Signs of a census find the plane, whatever the light;
grey values then say where the surface lies between planes, every view by its own variance, and how surely.

Alphabet: q inverse depth (1/m), as in :mod:`dhtorch.geometry.plane_sweep`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry import plane_sweep
from dhtorch.geometry import windows as neighbours
from dhtorch.geometry.checks import any_possible
from dhtorch.ops.dispatch import operator
from dhtorch.records import PoseFit

#: A pixel's own noise of grey values (a step of eight bits is 0.004), and how many of a window's pixels err by
#: themselves: noise is shared through the lens, the resampling and the texture.
GREY_NOISE, INDEPENDENT_WINDOW_PIXELS = 0.002, 5.0

#: Cost of a surface (of one view, as sweep.aggregate counts) at which grey values tell as much as they seem to: where
#: signs fit less well, windows show something else as well, and where they fit better, less noise.
NOMINAL_COST = 40.0

#: Cost (of one view) by which the best place along the line must beat every other that is further away in the pictures
#: than so many pixels. What surrounds a pixel weighs by the price of jumps (18 from each side): a rival within more
#: than one may be the better one, as where a texture repeats.
MIN_SECOND_BEST_MARGIN, SECOND_BEST_RADIUS_PX = 5, 3.0

#: Every such pixel tells how far one moves in the pictures from plane to plane, of all rows and columns alike.
MOTION_STRIDE_PX = 17

#: A pixel whose window of so many pixels to each side holds a step of the surface may belong to the other side of it:
#: standard deviation as a share of the step.
EDGE_RADIUS_PX, EDGE_SIGMA_RATIO = 4, 0.17

#: Correlation of its windows from which on a view has a say in a pixel's depth.
MIN_WINDOW_CORRELATION = 0.5

#: Least values of what the variance by a motion divides by: inverse depth (1/m), squared motion of a pixel ((px·m)²),
#: depth (m).
MIN_INVERSE_DEPTH, MIN_SQUARED_MOTION, MIN_ABS_DEPTH = 1e-6, 1e-12, 1e-9

#: Below any weight that a view can have.
MIN_WEIGHT = 1e-37

#: Planes that a fit may move a pixel in one step and in all, and by which one surface must be nearer to hide another.
MAX_STEP_PLANES, MAX_TOTAL_PLANES, OCCLUSION_PLANES = 1.0, 1.5, 1.5

#: Planes by which the derivative of a step is found, and the least that it is believed to be.
DERIVATIVE_PLANES, MIN_STEP_DERIVATIVE = 0.1, 0.25

#: Planes by which neighbours differ at most that lie on one surface.
SURFACE_PLANES = 1.5


class SourceView(NamedTuple):
    """A view that is swept, and how well its motion is known."""

    view: plane_sweep.SweptView
    picture: Tensor  # (B, 3, H, W) the view's, with its gradients
    fit: PoseFit
    use: Tensor  # (B,) bool


class RefinedSurface(NamedTuple):
    """What the views together say of every pixel, (B, h, w) each."""

    q: Tensor  # 1/m
    own: Tensor  # 1/m², variance of q by the grey values and by the surface around
    shared: Tensor  # 1/m², by the motions
    correlation: Tensor  # of the view that fits best, -1 where none sees the pixel
    seen: Tensor  # bool, by one view at least, and not hidden there


class SweptSurface(NamedTuple):
    """The best surface through the planes, (B, h, w) each."""

    q: Tensor  # 1/m, between the planes by a parabola
    misfit: Tensor  # cost of the surface there for each view, see sweep.aggregate
    alone: Tensor  # bool, no other place along the line costs nearly as little


@torch.no_grad()
def sweep_planes(base: plane_sweep.ReferenceView, source_views: list[SourceView], q: Tensor) -> SweptSurface:
    """The best surface through the planes q (B, D) 1/m, rising from 0. Gradient: none."""
    views = torch.stack([source_view.use for source_view in source_views]).sum(0).clamp_min(1)
    best, some = plane_sweep.aggregate_best_plane(_costs(base, source_views, q), views)
    step = q[:, 1] - q[:, 0]
    place = (best.plane + best.shift) * step[:, None, None]
    each = views[:, None, None]
    alone = (
        plane_sweep.second_best_margin(some, best, _second_best_reach(base, source_views, place, step))
        >= MIN_SECOND_BEST_MARGIN * each
    )
    return SweptSurface(place, (best.cost - _idle_cost(source_views, best.cost)[:, None, None]) / each.to(q), alone)


def _idle_cost(source_views: list[SourceView], like: Tensor) -> Tensor:
    """What a surface costs (B,) by views that are read for others of the batch alone: the same at all its planes."""
    unused = [~source_view.use for source_view in source_views if any_possible(source_view.use)]
    if not unused:
        return torch.zeros_like(source_views[0].use, dtype=like.dtype)
    return plane_sweep.N_PATHS * plane_sweep.UNSEEN_COST * torch.stack(unused).sum(0).to(like.dtype)


def _costs(base: plane_sweep.ReferenceView, source_views: list[SourceView], q: Tensor) -> Tensor:
    """How badly every pixel fits all views at every plane, (B, h, w, D) uint8."""
    C = plane_sweep.new_cost_volume(q, hw=base.hw)
    fresh = True
    for view, _, _, use in source_views:
        if any_possible(use):
            plane_sweep.add_census_costs(C, base, view, q, use, fresh=fresh)
            fresh = False
    if fresh:
        C.zero_()
    return plane_sweep.planes_last(C)


def _second_best_reach(
    base: plane_sweep.ReferenceView, source_views: list[SourceView], q: Tensor, step: Tensor
) -> Tensor:
    """Planes (B,) beyond which a pixel has moved by more than a few in the view that moves most."""
    moved = []
    some = q.flatten(1)[:, ::MOTION_STRIDE_PX]  # whose median is that of all
    for view, _, _, use in source_views:
        go = plane_sweep.epipolar_warp(base, view)
        go = go._replace(a=go.a[..., ::MOTION_STRIDE_PX])
        (u_0, v_0), (u_1, v_1) = (go.at(some + k * step[:, None]) for k in (0, 1))
        length = torch.hypot(u_1 - u_0, v_1 - v_0).median(-1).values
        moved.append(torch.where(use, length, 0.0))
    return (SECOND_BEST_RADIUS_PX / torch.stack(moved).amax(0).clamp_min(1e-3)).ceil().clamp(2, 1e4)


def refine_surface(
    base: plane_sweep.ReferenceView, source_views: list[SourceView], start: SweptSurface, q: Tensor, steps: int
) -> RefinedSurface:
    """The surface through ``start``, fitted in so many ``steps`` by grey values to all views that are of use.

    Gradient: of ``q`` to pictures, cameras and motions, by the implicit function theorem where the last step ends.
    """
    plane = q[:, 1] - q[:, 0]
    near = MAX_TOTAL_PLANES * plane[:, None, None]
    with torch.no_grad():
        goes = [plane_sweep.epipolar_warp(base, source_view.view) for source_view in source_views]
        at = neighbours.smooth_within_tolerance(start.q, SURFACE_PLANES * plane)
        for _ in range(steps):
            moved = at + _joined(base, source_views, goes, at, plane)[0]
            at = torch.minimum(torch.maximum(moved, start.q - near), start.q + near).clamp_min(0)
            at = neighbours.smooth_within_tolerance(at, SURFACE_PLANES * plane)
    step, found = _joined(base, source_views, goes, at, plane, last=True)
    if step.requires_grad:
        step = step / _slope(base, source_views, goes, at, plane)
    edge = EDGE_SIGMA_RATIO * neighbours.window_range(at, EDGE_RADIUS_PX)
    own = found.own * (start.misfit / NOMINAL_COST).square() + edge.square()
    return found._replace(q=at + (step - step.detach()), own=own)


@torch.no_grad()
def _slope(
    base: plane_sweep.ReferenceView,
    source_views: list[SourceView],
    goes: list[plane_sweep.EpipolarWarp],
    at: Tensor,
    plane: Tensor,
) -> Tensor:
    """How much smaller a step gets (B, h, w) as a surface comes nearer to where it fits best: 1 where grey values are
    straight between pixels. By it the gradient of the step becomes that of the place where it ends."""
    little = DERIVATIVE_PLANES * plane[:, None, None]
    before, after = (_joined(base, source_views, goes, at + sign * little, plane)[0] for sign in (-1, 1))
    return ((before - after) / (2 * little)).clamp_min(MIN_STEP_DERIVATIVE)


def _joined(
    base: plane_sweep.ReferenceView,
    source_views: list[SourceView],
    goes: list[plane_sweep.EpipolarWarp],
    at: Tensor,
    plane: Tensor,
    *,
    last: bool = False,
) -> tuple[Tensor, RefinedSurface]:
    """The step (B, h, w) that the views together ask for at inverse depths ``at``, each by its own variance, and how
    well they fit there; what the motions add to that (``shared``) where it is the last. The gradient is the step's."""
    none = torch.zeros_like(at)
    said = _ViewSums(none, none.clone(), none.clone(), best=torch.full_like(at, -1), seen=torch.zeros_like(at).bool())
    for (view, picture, fit, use), go in zip(source_views, goes, strict=True):
        one = plane_sweep.fit_windows(base, view, picture, at)
        with torch.no_grad():
            here = one.seen & use[:, None, None] & ~plane_sweep.occlusion_mask(go, at, OCCLUSION_PLANES * plane)
            moved = pose_variance(base, view, fit, at, one.motion) if last else None
        said = _add_view(said, one, here, MAX_STEP_PLANES * plane, moved)
    step = said.step / said.weight.clamp_min(MIN_WEIGHT)
    own, shared = 1 / said.weight, said.shared
    if last:
        shared = torch.where(said.weight > 0, shared / said.weight, torch.inf)
    return step, RefinedSurface(at, own, shared, said.best, said.seen)


class _ViewSums(NamedTuple):
    """What some views said of every pixel, (B, h, w) each: sums of steps and of the motions' variances, by weight."""

    step: Tensor
    weight: Tensor
    shared: Tensor
    best: Tensor  # correlation
    seen: Tensor  # bool


def _add_view(
    said: _ViewSums, one: plane_sweep.WindowFit, here: Tensor, most: Tensor, moved: Tensor | None
) -> _ViewSums:
    """What they said with one view more, where it sees pixels ``here`` (B, h, w): a step of at ``most`` (B,) 1/m, and
    the variance by its motion if that is asked for."""
    return _add_to_sums(*(one.step, one.contrast, one.noise, one.correlation), here, most, moved, *said)


def _add_to_sums_kernel(*tensors: Tensor | None) -> _ViewSums:
    *given, most, moved, step, weight, shared, best, seen = tensors
    sums = _ViewSums(step, weight, shared, best, seen)  # type: ignore[arg-type]
    variance = step.new_empty(0) if moved is None else moved  # type: ignore[union-attr]
    limits = GREY_NOISE**2, INDEPENDENT_WINDOW_PIXELS, MIN_WINDOW_CORRELATION
    torch.ops.dhtorch.add_view.default(*given, most, variance, *sums, *limits)  # in place
    return sums


@operator(
    kernel=_add_to_sums_kernel,
    dtypes=dict.fromkeys(("step", "contrast", "noise", "correlation"), torch.float32)
    | {"here": torch.bool}
    | dict.fromkeys(("most", "moved", "sum_step", "sum_weight", "sum_shared", "best"), torch.float32)
    | {"seen": torch.bool},
)
def _add_to_sums(*tensors: Any) -> _ViewSums:
    """:func:`_add_view` of the fields of a fit and of the sums, which may be overwritten."""
    step, contrast, noise, correlation, here, most, moved, sum_step, sum_weight, sum_shared, best, seen = tensors
    with torch.no_grad():
        own = (noise + GREY_NOISE**2) / (INDEPENDENT_WINDOW_PIXELS * contrast)
        weight = torch.where(here & (correlation > MIN_WINDOW_CORRELATION), 1 / own, 0.0)
        shared = sum_shared if moved is None else sum_shared + weight * moved
        best = torch.where(here, torch.maximum(best, correlation), best)
    limit = most[:, None, None]
    total = sum_step + weight * torch.minimum(torch.maximum(step, -limit), limit)
    return _ViewSums(total, sum_weight + weight, shared, best, seen | here)


def pose_variance(
    base: plane_sweep.ReferenceView, view: plane_sweep.SweptView, fit: PoseFit, q: Tensor, motion: Tensor
) -> Tensor:
    """Variance (B, h, w) of q (B, h, w) 1/m, in 1/m², by the motion's covariance.

    ``motion`` (B, h, w, 2) px·m: d pixel / d q in the view, as :func:`dhtorch.geometry.plane_sweep.fit_windows` gives
    it.
    """
    cov = fit.cov if fit.shutter is None else fit.shutter.cov
    cov = torch.where(fit.ok[:, None, None], cov, 0.0).nan_to_num().to(q)
    T = view.T_1_from_0
    known = T.R, T.t, view.camera.f, cov
    return _pose_variance(base.ray, q.flatten(1), *known, motion.flatten(1, 2)).view_as(q)


def _pose_variance_kernel(*tensors: Tensor) -> Tensor:
    ray, q, R, t, f, cov, motion = tensors
    variance = torch.empty_like(q)
    limits = MIN_INVERSE_DEPTH, MIN_SQUARED_MOTION, MIN_ABS_DEPTH
    planes, moved = (x.mT.contiguous() for x in (ray, motion))
    torch.ops.dhtorch.pose_variance.default(planes, q, *(R, t, f), cov.contiguous(), moved, variance, *limits)
    return variance


@operator(
    kernel=_pose_variance_kernel,
    dtypes=dict.fromkeys(("ray", "q", "R", "t", "f", "cov", "motion"), torch.float32),
    any_layout=("ray", "cov", "motion"),
)
def _pose_variance(*tensors: Any) -> Tensor:
    """:func:`pose_variance` (B, N) on rays (B, N, 3) that move by ``motion`` (B, N, 2) px·m in a view with focal
    lengths f (B, 2), from the covariance (B, 6, 6) of its motion R, t, or (B, 9, 9) with a shutter's turn."""
    ray, q, R, t, f, cov, motion = tensors
    flat = q.clamp_min(MIN_INVERSE_DEPTH)
    x, y, z = (part / flat + t[:, None] for part, t in zip(plane_sweep.rotate_rays(R, ray), t.unbind(-1), strict=True))
    du, dv = motion.unbind(-1)
    share = 1 / (du * du + dv * dv).clamp_min(MIN_SQUARED_MOTION)
    # what a shift of the point does along the motion, as epipolar.point_jacobians, one number a tensor
    inv_z = 1 / torch.where(z.abs() < MIN_ABS_DEPTH, torch.full_like(z, MIN_ABS_DEPTH), z)
    gx, gy = (f[:, None] * inv_z * d * share for f, d in zip(f.unbind(-1), (du, dv), strict=True))
    gz = -(gx * x + gy * y) * inv_z
    turned = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
    row = [*turned, gx, gy, gz]
    if cov.shape[-1] > len(row):
        row += [r * ray[..., 1] for r in turned]
    total = torch.zeros_like(z)
    for i, r in enumerate(row):  # written out: a matrix product differs with the batch
        carried = row[0] * cov[:, i, 0, None]
        for j in range(1, len(row)):
            carried = torch.addcmul(carried, row[j], cov[:, i, j, None])
        total = torch.addcmul(total, carried, r)
    return total.clamp_min(0)
