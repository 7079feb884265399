"""Affine registration: windows of a tracked pair of images -> sub-pixel position, affine motion, gain and covariance.

Alphabet: ``p`` an offset in the window, px, and u, v the same from -1 to 1; the window of image 0 is centred on the
integer pixel q nearest to ``uv_0``; T is its grey value, with its gradient; the ``warp`` W (3, 2, M), px, maps its
pixels to image 1: the centre to W_0, (u, v) to W_0 + u W_1 + v W_2, which is W_0 + A p. J is sampled there; ``gain`` g
and ``bias`` b: J ≈ g T + b. The M points of all pairs form one row, in the last dimension.

Inverse composition (Baker and Matthews 2004) puts the small change δ, D of a step on the side of T, whose derivatives
never change: J ≈ g (T + ∇T · (δ + D p)) + b is linear regression of J on eight fixed images, ∇T, u ∇T, v ∇T, T and 1,
so gain and bias need no iteration of their own. T is never interpolated, which keeps its noise white.

The steps shrink by a factor that is nearly constant and, where noise in T's gradient counts as texture, not small. Two
steps determine it, and the third includes part of those to follow (Anderson 1965, with a memory of one step).

The steps on one level have a compiled kernel.
"""

from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry import linalg as closed_form
from dhtorch.geometry.checks import any_possible, constant, is_static, shaped
from dhtorch.geometry.determinism import MAX_CHUNK_POINTS, chunk_size, run_without_grad
from dhtorch.geometry.least_squares import MIN_PIVOT, solve_spd
from dhtorch.geometry.linalg import matmul_planes, solve_cholesky
from dhtorch.geometry.lucas_kanade import is_between, masked_apply
from dhtorch.geometry.patches import QUANTISATION_VARIANCE, round_half_up
from dhtorch.geometry.pyramid import (
    GRAD_X_PLANE,
    GRAD_Y_PLANE,
    GREY_PLANE,
    OUTSIDE_MARGIN_PX,
    SEARCH_PADDING_PX,
    Pyramid,
)
from dhtorch.ops.dispatch import operator

#: Largest extrapolation added to a step, as a multiple of that step; more overshoots under large warps.
MAX_EXTRAPOLATION = 0.5

#: Damping of the affine part of the normal equations, (grey value / px)²: the information of 2 / 255 of noise about a
#: corner that moves by 2 px. It only matters where the window determines no affine motion (a single edge).
#: Source: derived, (2 / 255 / 2 px)².
AFFINE_DAMPING = (2 / 255 / 2) ** 2

#: Limits of the gain of a registration, a ratio of contrasts.
REGISTRATION_GAIN_RANGE = (0.2, 5.0)

#: Limits of the linear magnification of a registered window, a ratio.
REGISTRATION_SCALE_RANGE = (0.4, 2.5)

#: Variance of a pyramid's gradient (Scharr's filter) in unit white noise, px⁻².
#: Source: derived, 2 · (3² + 10² + 3²) / 32².
GRADIENT_NOISE = 2 * (3**2 + 10**2 + 3**2) / 32**2

#: Largest fraction of the gradient's energy that is attributed to noise.
MAX_NOISE_RATIO = 0.9


class _AffineRegistration(NamedTuple):
    """Result of :func:`register_affine` for B × N points."""

    uv_1: Tensor  # (B, N, 2) px, the position of uv_0 in image 1
    linear: Tensor  # (B, N, 2, 2) d uv_1 / d uv_0 of the window
    rms: Tensor  # (B, N) grey difference of the windows in grey values of image 0, gain and bias taken out
    cov: Tensor  # (B, N, 2, 2) px² of uv_1
    shift_px: Tensor  # (B, N) distance from the start to the end of the search, also of rejected points
    ok: Tensor  # (B, N) bool; where not, uv_1 is the start and linear the identity


class _Views(NamedTuple):
    """The pyramids of both images, and the options of the search."""

    source: Pyramid
    target: Pyramid
    window: int
    steps: int
    epsilon_px: float
    max_shift_px: float


class _State(NamedTuple):
    """State of the search for every point."""

    warp: Tensor  # (3, 2, M) px
    textured: Tensor  # (M,) the normal equations have a solution
    quality: Tensor  # (3, M) see _quality
    start_quality: Tensor  # (3, M) the same at the start of this search
    inverse: Tensor  # (2, 8, M) rows of the inverse normal equations, for the motion of the point in the window


@shaped("uv_0: B N 2, uv_1: B N 2, wanted: B N, source.levels.0: B C H W, target.levels.0: B c h w")
def register_affine(
    source: Pyramid,
    target: Pyramid,
    uv_0: Tensor,  # (B, N, 2) px
    uv_1: Tensor,  # (B, N, 2) px, the start
    *,
    wanted: Tensor | None = None,  # (B, N) bool
    linear: Tensor | None = None,  # (B, 2, 2)
    window: int = 21,
    iterations: int = 7,
    epsilon_px: float = 0.01,
    max_shift_px: float = 2.0,
) -> _AffineRegistration:
    """Points ``uv_0`` and their tracks ``uv_1`` -> registered positions, up to an affine motion, a gain and a bias.

    A track is the position where a window fits best by *translation alone*; under the perspective of a slanted surface
    it is off by a fraction of a pixel that no residual shows. Gauss–Newton steps from there, with affine motion and
    brightness free, remove that fraction.

    Args:
        source, target: ``build_pyramid(image, levels, window)`` of both images; the second level of ``target`` is
            sampled where a window is magnified by more than 1.5.
        uv_1: closer than about a quarter of the window; the search begins there.
        linear: rotation and zoom of the windows of a pair at the start, None = identity.
        wanted: points to register, by default all; the others cost nothing and are not ok, their values are undefined.
        window: width in pixels, odd.
        iterations: largest number of Gauss–Newton steps.
        epsilon_px: step of the window's corners, px, at which the search has converged.
        max_shift_px: a search that ends further from its start is rejected.

    Returns:
        :class:`_AffineRegistration`. Rejected (not ok): without texture, not finite, too far, magnification or gain out
        of range, outside the image, or a larger residual than at the start; the values are then those of the start.
        ``cov`` is first-order and for white noise of equal variance in both images, which it estimates from the
        residual; interpolation smooths that noise and the noise of T's gradient inflates A; both are accounted for.

    Raises:
        ValueError: wrong shapes.

    Gradient: none; apply :func:`registration_step` to the result.
    Cost: one patch of image 1 per point, and 441 samples of it per point and step.
    """
    B, N, _ = uv_0.shape
    with torch.no_grad():
        xy_0, xy_1, batch, usable = _flatten_points(source, target, uv_0, uv_1)
        if wanted is not None:
            usable = usable & wanted.reshape(-1)
        views = _Views(source, target, window, iterations, epsilon_px, max_shift_px)
        start_linear = _identity(xy_1)
        if linear is not None:
            start_linear = linear.to(xy_1).permute(2, 1, 0).repeat_interleave(N, -1)
        register = partial(_register, views)
        zero = torch.zeros_like(xy_1[0])
        unregistered = xy_1, _identity(xy_1), zero, _identity(xy_1), zero, zero > 0
        fields = run_without_grad(masked_apply, usable, register, unregistered, (xy_0, xy_1, start_linear, batch))

    def grid(y: Tensor) -> Tensor:  # (..., M) -> (B, N, ...)
        y = y.unflatten(-1, (B, N)).movedim((-2, -1), (0, 1))
        return y.to(uv_0.dtype) if y.is_floating_point() else y

    registered, linear, rms, cov, shift_px, ok = (grid(y) for y in fields)
    return _AffineRegistration(torch.where(ok[..., None], registered, uv_1.detach()), linear, rms, cov, shift_px, ok)


@shaped("uv_0: B N 2, uv_1: B N 2, linear: B N 2 2, source.levels.0: B C H W, target.levels.0: B c h w")
def registration_step(
    source: Pyramid,
    target: Pyramid,
    uv_0: Tensor,  # (B, N, 2) px
    uv_1: Tensor,  # (B, N, 2) px
    linear: Tensor,  # (B, N, 2, 2)
    *,
    window: int = 21,
) -> Tensor:
    """Registration -> ``uv_1`` (B, N, 2) after one step that is differentiable by the images and ``uv_0``.

    Where the search has converged the step is nearly zero but its derivative is not: it is that of the converged
    position, by the implicit function theorem with the Gauss–Newton Hessian. Points without texture do not move.

    Raises:
        ValueError: wrong shapes.

    Gradient: to both pyramids and ``uv_0``; ``uv_1`` and ``linear`` are detached.
    """
    B, N, _ = uv_0.shape
    xy_0, xy_1, batch, usable = _flatten_points(source, target, uv_0, uv_1)
    q = round_half_up(xy_0)
    point = _window_coordinates(xy_0 - q, window)
    A = linear.detach().to(xy_0.dtype).permute(3, 2, 0, 1).reshape(2, 2, B * N)
    usable = usable & A.isfinite().all(0).all(0)
    warp = _initial_warp(xy_1, point.detach(), torch.where(usable, A, _identity(A)), window)
    Q = _basis_images(source, q, batch, window)
    patch, corner = _patch(target, 0, warp[0], batch, window)
    J = _read(patch, _relative_to(corner, warp), window)
    solution, solved = solve_spd(_normal_matrix(Q), (Q * J[:, None]).sum(-1)[..., None])
    warp = _compose(warp, _warp_change(solution[..., 0]), window)
    xy = torch.where(usable & solved, (warp * point[:, None]).sum(0), xy_1)
    return xy.T.reshape(B, N, 2).to(uv_0.dtype)


def _flatten_points(
    source: Pyramid, target: Pyramid, uv_0: Tensor, uv_1: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points of all pairs in one row: positions in both images (2, M), their pair (M,), and whether both are usable."""
    B, N, _ = uv_0.shape
    xy_0, xy_1 = (uv.to(source.levels[0].dtype).permute(2, 0, 1).reshape(2, B * N) for uv in (uv_0, uv_1.detach()))
    batch = torch.arange(B, device=uv_0.device).repeat_interleave(N)
    usable = is_between(xy_0.detach(), *source.bounds()) & is_between(xy_1, *target.bounds())
    xy_0, xy_1 = (torch.where(usable, y, torch.zeros_like(y)) for y in (xy_0, xy_1))
    return xy_0, xy_1, batch, usable


def _register(
    views: _Views,
    xy_0: Tensor,  # (2, M) px
    xy_1: Tensor,  # (2, M) px
    start_linear: Tensor,  # (2, 2, M)
    batch: Tensor,  # (M,)
) -> tuple[Tensor, ...]:
    """Points and start -> fields of an :class:`_AffineRegistration`, points last."""
    target, window = views.target, views.window
    q = round_half_up(xy_0)
    point = _window_coordinates(xy_0 - q, window)
    warp = _initial_warp(xy_1, point, start_linear, window)
    state = _search(views, 0, q, point, warp, batch)
    best = state._replace(warp=warp, quality=state.start_quality)
    if len(target.levels) > 1:
        # Magnification from which on image 1 is sampled on its half-size level, where neighbouring pixels of the
        # window are about a pixel apart again.
        magnified = _determinant(_linear(state.warp, window)) > 1.5**2
        state = _State(*masked_apply(magnified, partial(_search, views, 1), state, (q, point, state.warp, batch)))
    shift = ((state.warp * point[:, None]).sum(0) - xy_1).square().sum(0).sqrt()
    shift = torch.where(shift.isfinite(), shift, torch.full_like(shift, views.max_shift_px))
    area_scale, gain = _determinant(_linear(state.warp, window)), state.quality[0]
    in_range = (
        (area_scale > REGISTRATION_SCALE_RANGE[0] ** 2)
        & (area_scale < REGISTRATION_SCALE_RANGE[1] ** 2)
        & (gain > REGISTRATION_GAIN_RANGE[0])
        & (gain < REGISTRATION_GAIN_RANGE[1])
    )
    # Residual noise variance at the end over that at the start, a ratio, above which a search has diverged.
    not_diverged = _noise(state.quality) <= 1.2 * _noise(best.quality)
    ok = (state.textured & in_range & not_diverged & is_between(state.warp[0], *target.bounds())) & (
        shift <= views.max_shift_px
    )
    best = _State(*(torch.where(ok, new, old) for new, old in zip(state, best, strict=True)))
    rms = best.quality[1].sqrt() / best.quality[0].clamp(*REGISTRATION_GAIN_RANGE)
    A = _linear(best.warp, window).transpose(0, 1)
    return (best.warp * point[:, None]).sum(0), A, rms, _covariance(best, point, window), shift, ok


def _search(
    views: _Views,
    level: int,
    q: Tensor,  # (2, M) px
    point: Tensor,  # (3, M)
    warp: Tensor,  # (3, 2, M) px
    batch: Tensor,  # (M,)
) -> _State:
    """Steps of all points, with image 1 sampled on one level."""
    levels = views.source.levels[0], views.target.levels[level]
    return _register_level(*levels, q, point, warp, batch, views=views, level=level)


def _register_level_kernel(
    source: Tensor,
    target: Tensor,
    q: Tensor,
    point: Tensor,
    warp: Tensor,
    batch: Tensor,
    *,
    views: _Views,
    level: int,
) -> _State:
    scale = 0.5**level
    textured = torch.empty_like(batch, dtype=torch.bool)
    registered_warp, fit, first = torch.empty_like(warp), torch.empty_like(point), torch.empty_like(point)
    inverse = warp.new_empty(2, 8, len(batch))
    torch.ops.dhtorch.register_affine.default(
        source=source,
        target=target,
        q=q,
        place=point,
        begin=warp * scale,
        batch=batch,
        warp=registered_warp,
        textured=textured,
        fit=fit,
        first=first,
        inverse=inverse,
        window=views.window,
        steps=views.steps,
        source_pad=views.source.pad,
        target_pad=views.target.pad,
        epsilon=views.epsilon_px * scale,
        search_padding=SEARCH_PADDING_PX,
        margin=OUTSIDE_MARGIN_PX,
        max_extrapolation=MAX_EXTRAPOLATION,
        min_gain=REGISTRATION_GAIN_RANGE[0],
        max_gain=REGISTRATION_GAIN_RANGE[1],
        damping=AFFINE_DAMPING,
        min_pivot=MIN_PIVOT,
    )
    return _State(registered_warp / scale, textured, fit, first, inverse)


@operator(
    kernel=_register_level_kernel,
    dtypes=dict.fromkeys(("source", "target", "q", "point", "warp"), torch.float32) | {"batch": torch.int64},
    # The source has gradients, and every window, with its search range, lies within the padding.
    when=lambda source, *_, views, level: (
        source.shape[1] > GRAD_Y_PLANE
        and min(views.source.pad, views.target.pad) >= views.window // 2 + SEARCH_PADDING_PX
    ),
)
def _register_level(
    source: Tensor,
    target: Tensor,
    q: Tensor,
    point: Tensor,
    warp: Tensor,
    batch: Tensor,
    *,
    views: _Views,
    level: int,
) -> _State:
    """:func:`_search` on the levels ``source`` and ``target``, a chunk of points at a time."""
    scale, window = 0.5**level, views.window
    size = chunk_size(MAX_CHUNK_POINTS, warp)
    buffers = None if is_static(warp) else warp.new_empty(2, min(size, len(batch)), 8, window * window)
    parts = []
    for q_, point_, warp_, batch_ in zip(*(y.split(size, -1) for y in (q, point, warp * scale, batch)), strict=True):
        patch, corner = _patch(views.target, level, warp_[0], batch_, window)
        Q = _basis_images(views.source, q_, batch_, window, None if buffers is None else buffers[0, : len(batch_)])
        products = None if buffers is None else buffers[1, : len(batch_)]
        state = _iterate(Q, patch, _relative_to(corner, warp_), views, views.epsilon_px * scale, products)
        inverse = (state.inverse[:6].unflatten(0, (3, 2)) * point_[:, None, None]).sum(0)
        parts.append(state._replace(warp=_relative_to(-corner, state.warp) / scale, inverse=inverse))
    return _State(*(torch.cat(field, -1) for field in zip(*parts, strict=True)))


def _iterate(
    Q: Tensor,  # (M, 8, w²)
    patch: Tensor,  # (M, 1, s, s)
    warp: Tensor,  # (3, 2, M) px of the patch
    o: _Views,
    epsilon_px: float,
    products: Tensor | None,  # (M, 8, w²), to be overwritten
) -> _State:
    """Steps of one chunk of points, warps in pixels of the patch; ``inverse`` is the whole one, (8, 8, M)."""
    # The normal equations are inverted with a unit diagonal.
    H = _normal_matrix(Q)
    diagonal = H.diagonal(dim1=1, dim2=2).double()
    s = diagonal.masked_fill(~(diagonal > 0), 1.0).rsqrt()
    s = s[:, :, None] * s[:, None]
    L, info = torch.linalg.cholesky_ex(H * s)
    textured = (info == 0) & (L.diagonal(dim1=1, dim2=2).amin(-1) > MIN_PIVOT)
    L = torch.where(textured[:, None, None], L, torch.eye(8, dtype=L.dtype, device=L.device) * AFFINE_DAMPING**0.5)
    if L.is_cpu:
        inverse = torch.cholesky_inverse(L)
    else:
        inverse = solve_cholesky(torch.eye(L.shape[-1], dtype=L.dtype, device=L.device).expand_as(L), L)
    inverse = (inverse * s).to(H.dtype)
    J = _read(patch, warp, o.window)
    quality = start_quality = _quality(Q[:, 6], J, _interpolation_noise_factor(warp[0, ..., None].clone()))
    moving, step, previous = textured, None, None
    for _ in range(o.steps):
        sums = torch.mul(Q, J[:, None], out=products).sum(-1)
        change = _warp_change((inverse * sums[:, None]).sum(-1))
        step, previous = _extrapolate(change, step, previous), change
        warp = torch.where(moving, _compose(warp, step, o.window), warp)
        J = _read(patch, warp, o.window)
        moving = moving & (change.abs().sum(0).amax(0) > epsilon_px)
        if not any_possible(moving):
            break
    if o.steps:
        quality = _quality(Q[:, 6], J, _interpolation_noise_factor(_positions(warp, o.window).flatten(2)))
    return _State(warp, textured, quality, start_quality, inverse.permute(1, 2, 0))


def _extrapolate(change: Tensor, step: Tensor | None, previous: Tensor | None) -> Tensor:
    """The step to take (3, 2, M): regression gave ``previous``, then ``change`` after ``step`` was taken."""
    if step is None or previous is None:
        return change
    bend = change - previous
    ratio = (change * bend).sum((0, 1)) / (bend * bend).sum((0, 1)).clamp_min(1e-20)
    return change - ratio.clamp(-MAX_EXTRAPOLATION, MAX_EXTRAPOLATION / (1 + MAX_EXTRAPOLATION)) * (step + bend)


def _covariance(state: _State, point: Tensor, window: int) -> Tensor:
    """Covariance (2, 2, M) of the position of a ``point`` (3, M) of the window in image 1.

    With R = ``inverse`` and C = S⁻¹ its part for that point, white noise of variance s² gives s² (1 + 1/g²) C. But S
    includes the noise of T and its gradient as if it were texture: noise of energy E adds S (R E Rᵀ) S to it. Without
    that term S is S', and the spread S'⁻¹ S S'⁻¹.
    """
    R = state.inverse.double()
    C = (R[:, :6].unflatten(1, (3, 2)) * point.double()[:, None]).sum(1)
    square, n = state.quality[0].clamp(*REGISTRATION_GAIN_RANGE).double().square(), window * window
    variance = _noise(state.quality).double().clamp_min(QUANTISATION_VARIANCE) * (n / (n - 8))
    u2 = (window // 2 + 1) / (window // 2) / 3  # mean over the window
    energy = constant(R, [1.0, 1.0, u2, u2, u2, u2, 1 / GRADIENT_NOISE, 0.0]) * GRADIENT_NOISE * n
    noise = (R[:, None] * R[None] * energy[:, None]).sum(2) * variance
    S = _inverse(C)
    spurious = matmul_planes(matmul_planes(S, noise), S)
    ratio = matmul_planes(C, spurious)
    trace = (ratio[0, 0] + ratio[1, 1]) / 2
    largest = trace + (trace * trace - _determinant(ratio)).clamp_min(0).sqrt()
    corrected = _inverse(S - spurious * (MAX_NOISE_RATIO / largest.clamp_min(MAX_NOISE_RATIO)))
    spread = matmul_planes(matmul_planes(corrected, S), corrected) * (variance * (1 + square) / square)
    A = _linear(state.warp, window).double()
    return matmul_planes(matmul_planes(A.transpose(0, 1), spread), A).to(state.warp.dtype)


def _window_coordinates(offset: Tensor, window: int) -> Tensor:
    """Offset (2, M), px, from the centre of the window -> its coordinates (1, u, v), (3, M)."""
    return torch.cat((torch.ones_like(offset[:1]), offset / (window // 2)))


def _identity(like: Tensor) -> Tensor:
    """Identities (2, 2, M)."""
    return torch.eye(2, dtype=like.dtype, device=like.device)[..., None].expand(2, 2, like.shape[-1])


def _initial_warp(target_point: Tensor, point: Tensor, A: Tensor, window: int) -> Tensor:
    """The warp with linear part ``A``, transposed, that maps ``point`` (3, M) to ``target_point`` (2, M)."""
    sides = A * (window // 2)
    return torch.cat(((target_point - (sides * point[1:, None]).sum(0))[None], sides))


def _linear(warp: Tensor, window: int) -> Tensor:
    """Warp -> linear part, transposed: Aᵀ (2, 2, M)."""
    return warp[1:] / (window // 2)


def _relative_to(corner: Tensor, warp: Tensor) -> Tensor:
    """The warp in coordinates with origin ``corner`` (2, M)."""
    return torch.cat(((warp[0] - corner)[None], warp[1:]))


def _basis_images(source: Pyramid, q: Tensor, batch: Tensor, window: int, out: Tensor | None = None) -> Tensor:
    """The eight images (M, 8, w²) of the regression, of windows around integer pixels ``q`` (2, M): ∇T, u ∇T, v ∇T, T
    without its mean, and 1; u and v run from -1 to 1."""
    first, _ = source.locate(0, q, batch, window // 2, (GRAD_X_PLANE, GRAD_Y_PLANE, GREY_PLANE))
    G = source.read(0, first, window).transpose(0, 1)
    s = torch.linspace(-1, 1, window, dtype=q.dtype, device=q.device)
    one = torch.ones_like(G[:, :1])
    u = s.repeat(window)
    v = s.repeat_interleave(window)
    g, T = G[:, :2], G[:, 2:]
    return torch.cat((g, g * u, g * v, T - T.mean(-1, keepdim=True), one), 1, out=out)


def _patch(target: Pyramid, level: int, x: Tensor, batch: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """Patches (M, 1, s, s) of image 1 that cover the window and its search range, and their first pixels (2, M)."""
    reach = window // 2 + SEARCH_PADDING_PX
    H, W = target.hw(level)
    middle = torch.minimum(round_half_up(x).clamp_min(0), constant(x, [[W - 1], [H - 1]]))
    first, _ = target.locate(level, middle, batch, reach, (GREY_PLANE,))
    side = 2 * reach + 1
    return target.read(level, first, side)[0].unflatten(-1, (side, side))[:, None], middle - reach


def _positions(warp: Tensor, window: int) -> Tensor:
    """Warp -> positions of the window's pixels, planes (2, M, w, w)."""
    s = torch.linspace(-1, 1, window, dtype=warp.dtype, device=warp.device)
    middle, right, down = warp[..., None]
    return (middle + down * s)[..., None] + (right * s)[..., None, :]


def _read(patch: Tensor, warp: Tensor, window: int) -> Tensor:
    """J (M, w²) sampled in a patch, the warp in pixels of it; beyond its border the border's value."""
    middle = (patch.shape[-1] - 1) / 2
    grid = _positions(_relative_to(torch.full_like(warp[0], middle), warp) / middle, window).permute(1, 2, 3, 0)
    return F.grid_sample(patch, grid, padding_mode="border", align_corners=True).flatten(1)


def _quality(T: Tensor, J: Tensor, noise_factor: Tensor) -> Tensor:
    """Quality of fit (3, M): gain of J over T; mean square residual after gain and bias; and ``noise_factor``."""
    energy = (T * T).sum(-1)
    gain = (T * J).sum(-1) / torch.where(energy > 0, energy, torch.ones_like(energy))
    residual = J - gain[:, None] * T
    variance = (residual - residual.mean(-1, keepdim=True)).square().mean(-1)
    return torch.stack((gain, variance, noise_factor))


def _interpolation_noise_factor(positions: Tensor) -> Tensor:
    """Mean fraction (M,) of white noise variance after bilinear interpolation at ``positions`` (2, M, k), overwritten.

    Without it half-pixel positions would look like better fits.
    """
    u, v = positions.frac_().abs_().sub_(0.5).square_().mul_(2).add_(0.5)
    return u.mul_(v).mean(-1)


def _noise(quality: Tensor) -> Tensor:
    """Quality of fit -> variance (M,) of white noise, equal in both images, that gives such a residual."""
    gain, variance, noise_factor = quality
    return variance / (noise_factor + gain.clamp(*REGISTRATION_GAIN_RANGE).square())


def _normal_matrix(Q: Tensor) -> Tensor:
    """Normal equations (M, 8, 8) of the eight images."""
    damping = constant(Q, [0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0]) * AFFINE_DAMPING
    return torch.bmm(Q, Q.transpose(1, 2)) + torch.diag(damping)


def _warp_change(solution: Tensor) -> Tensor:
    """Solution (M, 8) -> change of the warp (3, 2, M), px: δ, and its increments at u = 1 and v = 1."""
    return (solution[:, :6].T / solution[:, 6].clamp(*REGISTRATION_GAIN_RANGE)).unflatten(0, (3, 2))


def _compose(warp: Tensor, change: Tensor, window: int) -> Tensor:
    """The warp after a change of the template: A becomes A (1 + D)⁻¹, and with that W_0 becomes W_0 - A δ."""
    half = window // 2
    sides = matmul_planes(_inverse(_identity(change) + change[1:] / half), warp[1:])
    return torch.cat(((warp[0] - (sides * change[0, :, None]).sum(0) / half)[None], sides))


def _determinant(A: Tensor) -> Tensor:
    return closed_form.determinant_2x2(*A.flatten(0, 1))


def _inverse(A: Tensor) -> Tensor:
    """Inverse of matrices (2, 2, M), the determinant bounded away from zero."""
    return closed_form.inverse_2x2(*A.flatten(0, 1), least=1e-30).unflatten(0, (2, 2))
