"""Registration of small windows under affine motion, gain and bias: what is left to correct after a track was found.

Alphabet: ``p`` an offset in the window, px, and u, v the same from -1 to 1; the window of image 0 stands on the whole
pixel q nearest to ``uv_0`` and holds T and its gradient; the ``warp`` W (3, 2, M), px, says where its pixels lie in
image 1: the middle at W_0, (u, v) at W_0 + u W_1 + v W_2, which is W_0 + A p. J reads there; ``gain`` g and ``bias`` b:
J ≈ g T + b. M points of all pairs travel in one row, last.

Inverse composition (Baker and Matthews 2004) puts the small change δ, D of a step on the side of T, whose derivatives
never change: J ≈ g (T + ∇T · (δ + D p)) + b is linear regression of J on eight fixed pictures, ∇T, u ∇T, v ∇T, T and 1,
so gain and bias need no iteration of their own. T is never read between pixels, which keeps its noise white.

Such steps shrink by a factor that is nearly constant and, where the noise in T's gradient passes for texture, not
small. Two of them tell it, and the third takes part of what would follow at once (Anderson 1965, with a memory of one
step).

The steps on one level have a compiled kernel.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry import linalg as small
from dhtorch.geometry.checks import check, is_static
from dhtorch.geometry.determinism import MAX_CHUNK_POINTS
from dhtorch.geometry.inference_mode import run_without_grad
from dhtorch.geometry.least_squares import MIN_PIVOT, solve_spd
from dhtorch.geometry.linalg import matmul_planes as product
from dhtorch.geometry.lucas_kanade import masked_apply
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

#: Of what would follow a step, at most so many times that step is taken at once; more overshoots under large warps.
MAX_EXTRAPOLATION = 0.5

#: Added to the normal equations' affine part: what 2 / 255 of noise would say of a corner that moves by 2 px. It only
#: matters where the window determines no affine motion (a single edge).
AFFINE_DAMPING = (2 / 255 / 2) ** 2

#: Ratios of contrast beyond these limits are not believed, nor windows that grow or shrink by more.
REGISTRATION_GAIN_RANGE, REGISTRATION_SCALE_RANGE = (0.2, 5.0), (0.4, 2.5)

#: From this magnification on image 1 is read from its half-size level, where a pixel of the window meets a pixel again.
HALVING_MAGNIFICATION = 1.5

#: Variance of a pyramid's gradient in unit white noise.
GRADIENT_NOISE = 2 * (3**2 + 10**2 + 3**2) / 32**2

#: Share of the gradient's energy that is at most put down to noise.
MAX_NOISE_RATIO = 0.9

#: A search that ends with this much more residual noise than it began with has diverged.
MAX_RESIDUAL_GROWTH = 1.2


class AffineRegistration(NamedTuple):
    """What :func:`register_affine` finds for B × N points."""

    uv_1: Tensor  # (B, N, 2) px, where uv_0 lies in image 1
    linear: Tensor  # (B, N, 2, 2) d uv_1 / d uv_0 of the window
    rms: Tensor  # (B, N) grey difference of the windows in grey values of image 0, gain and bias taken out
    cov: Tensor  # (B, N, 2, 2) px² of uv_1
    shift_px: Tensor  # (B, N) from the start to where the search went, also where that was rejected
    ok: Tensor  # (B, N) bool; where not, uv_1 is the start and linear the identity


class _Options(NamedTuple):
    """How to search; see :func:`register_affine`."""

    window: int
    steps: int
    epsilon_px: float
    max_shift_px: float


class _Views(NamedTuple):
    """Both pictures, and how to search in them."""

    source: Pyramid
    target: Pyramid
    o: _Options


class _State(NamedTuple):
    warp: Tensor  # (3, 2, M) px
    textured: Tensor  # (M,) the normal equations have a solution
    fit: Tensor  # (3, M) see _quality
    first: Tensor  # (3, M) the same where this search began
    inverse: Tensor  # (2, 8, M) rows of the inverse normal equations, for the motion of the point in the window


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
) -> AffineRegistration:
    """Register the window around ``uv_0`` in the other image, up to an affine motion, a gain and a bias.

    A track is the place where a window fits best *unturned and unscaled*; under the perspective of a slanted surface
    that place is off by a fraction of a pixel that no residual shows. Gauss–Newton steps from there, with the window
    free to shear and to change its brightness, take the fraction out.

    Args:
        source, target: ``build_pyramid(image, levels, window)`` of both images; the second level of ``target`` is read
            where a window is magnified by more than 1.5.
        uv_1: closer than about a quarter of the window; the search begins there.
        linear: turn and zoom that the windows of a pair begin with, None = none.
        wanted: points to register, by default all; the others cost nothing and are not ok, their numbers of no meaning.
        window: width in pixels, odd.
        iterations: most Gauss–Newton steps.
        epsilon_px: a step that moves no corner of the window further has converged.
        max_shift_px: a search that ends further from its start is rejected.

    Returns:
        :class:`AffineRegistration`. Rejected (not ok): without texture, not finite, too far, magnified or in contrast
        beyond belief, outside the image, or a larger residual than at the start; the numbers are then those of the
        start. ``cov`` is first-order and for white noise of equal variance in both images, which it estimates from the
        residual; reading between pixels smooths that noise and inflates A by the noise of T's gradient, and both are
        accounted for.

    Raises:
        ValueError: wrong shapes.

    Gradient: none; take :func:`registration_step` from the result.
    Twin: ``register_affine`` of ``tests/support/reference.py``, one point at a time.
    Cost: reads a patch of image 1 once and 441 pixels of it per point and step.
    """
    B, N = (
        check("register_affine", uv_0=(uv_0, "B N 2"), uv_1=(uv_1, "B N 2"), wanted=(wanted, "B N"))[k] for k in "BN"
    )
    with torch.no_grad():
        here, there, batch, usable = _rows(source, target, uv_0, uv_1)
        if wanted is not None:
            usable = usable & wanted.reshape(-1)
        views = _Views(source, target, _Options(window, iterations, epsilon_px, max_shift_px))
        begin = _still(there)
        if linear is not None:
            begin = linear.to(there).permute(2, 1, 0).repeat_interleave(N, -1)
        register = partial(_register, views)
        answer = run_without_grad(masked_apply, usable, register, _nothing(there), (here, there, begin, batch))

    def grid(y: Tensor) -> Tensor:  # (..., M) -> (B, N, ...)
        y = y.unflatten(-1, (B, N)).movedim((-2, -1), (0, 1))
        return y.to(uv_0.dtype) if y.is_floating_point() else y

    found, linear, rms, cov, shift_px, ok = (grid(y) for y in answer)
    return AffineRegistration(torch.where(ok[..., None], found, uv_1.detach()), linear, rms, cov, shift_px, ok)


def registration_step(
    source: Pyramid,
    target: Pyramid,
    uv_0: Tensor,  # (B, N, 2) px
    uv_1: Tensor,  # (B, N, 2) px
    linear: Tensor,  # (B, N, 2, 2)
    *,
    window: int = 21,
) -> Tensor:
    """One differentiable step from a registration: ``uv_1`` (B, N, 2) as a function of images and ``uv_0``.

    Where the search has converged the step is nearly zero but its derivative is not: it is that of the converged
    position, by the implicit function theorem with the Gauss–Newton Hessian. Points without texture stay.

    Raises:
        ValueError: wrong shapes.

    Gradient: to both pyramids and ``uv_0``; ``uv_1`` and ``linear`` are detached.
    Twin: ``register_step`` of ``tests/support/reference.py``.
    """
    B, N = (
        check("registration_step", uv_0=(uv_0, "B N 2"), uv_1=(uv_1, "B N 2"), linear=(linear, "B N 2 2"))[k]
        for k in "BN"
    )
    here, there, batch, usable = _rows(source, target, uv_0, uv_1)
    q = round_half_up(here)
    place = _place(here - q, window)
    A = linear.detach().to(here.dtype).permute(3, 2, 0, 1).reshape(2, 2, B * N)
    usable = usable & A.isfinite().all(0).all(0)
    warp = _start(there, place.detach(), torch.where(usable, A, _still(A)), window)
    Q = _pictures(source, q, batch, window)
    patch, corner = _patch(target, 0, warp[0], batch, window)
    J = _read(patch, _from(corner, warp), window)
    solution, solved = solve_spd(_normal(Q), (Q * J[:, None]).sum(-1)[..., None])
    warp = _compose(warp, _change(solution[..., 0]), window)
    found = torch.where(usable & solved, (warp * place[:, None]).sum(0), there)
    return found.T.reshape(B, N, 2).to(uv_0.dtype)


def _rows(source: Pyramid, target: Pyramid, uv_0: Tensor, uv_1: Tensor):
    """Points of all pairs in a row: places in both images (2, M), their pair (M,), and whether both are usable."""
    B, N, _ = uv_0.shape
    here, there = (uv.to(source.levels[0].dtype).permute(2, 0, 1).reshape(2, B * N) for uv in (uv_0, uv_1.detach()))
    batch = torch.arange(B, device=uv_0.device).repeat_interleave(N)
    usable = _inside(here.detach(), source) & _inside(there, target)
    here, there = (torch.where(usable, y, torch.zeros_like(y)) for y in (here, there))
    return here, there, batch, usable


def _register(
    views: _Views,
    here: Tensor,  # (2, M) px
    there: Tensor,  # (2, M) px
    begin: Tensor,  # (2, 2, M)
    batch: Tensor,  # (M,)
) -> tuple[Tensor, ...]:
    """The fields of a :class:`AffineRegistration`, points last."""
    target, o = views.target, views.o
    q = round_half_up(here)
    place = _place(here - q, o.window)
    warp = _start(there, place, begin, o.window)
    state = _search(views, 0, q, place, warp, batch)
    best = state._replace(warp=warp, fit=state.first)
    if len(target.levels) > 1:
        big = _determinant(_linear(state.warp, o.window)) > HALVING_MAGNIFICATION**2
        state = _State(*masked_apply(big, partial(_search, views, 1), state, (q, place, state.warp, batch)))
    shift = ((state.warp * place[:, None]).sum(0) - there).square().sum(0).sqrt()
    shift = torch.where(shift.isfinite(), shift, torch.full_like(shift, o.max_shift_px))
    ok = _accept(state, best.fit, target, o.window) & (shift <= o.max_shift_px)
    best = _State(*(torch.where(ok, new, old) for new, old in zip(state, best, strict=True)))
    rms = best.fit[1].sqrt() / best.fit[0].clamp(*REGISTRATION_GAIN_RANGE)
    A = _linear(best.warp, o.window).transpose(0, 1)
    return (best.warp * place[:, None]).sum(0), A, rms, _covariance(best, place, o.window), shift, ok


def _search(
    views: _Views,
    level: int,
    q: Tensor,  # (2, M) px
    place: Tensor,  # (3, M)
    warp: Tensor,  # (3, 2, M) px
    batch: Tensor,  # (M,)
) -> _State:
    """Steps of all points, reading image 1 from one level."""
    levels = views.source.levels[0], views.target.levels[level]
    return _register_level(*levels, q, place, warp, batch, views=views, level=level)


def _reads_whole_windows(source: Tensor, *_: Tensor, views: _Views, level: int) -> bool:
    """Whether the source has gradients, and every window, with room to move, lies within the padding."""
    padding = min(views.source.pad, views.target.pad)
    return source.shape[1] > GRAD_Y_PLANE and padding >= views.o.window // 2 + SEARCH_PADDING_PX


def _register_level_kernel(
    source: Tensor,
    target: Tensor,
    q: Tensor,
    place: Tensor,
    warp: Tensor,
    batch: Tensor,
    *,
    views: _Views,
    level: int,
) -> _State:
    o, zoom = views.o, 0.5**level
    textured = torch.empty_like(batch, dtype=torch.bool)
    found, fit, first = torch.empty_like(warp), torch.empty_like(place), torch.empty_like(place)
    inverse = warp.new_empty(2, 8, len(batch))
    torch.ops.dhtorch.register_affine.default(
        source=source,
        target=target,
        q=q,
        place=place,
        begin=warp * zoom,
        batch=batch,
        warp=found,
        textured=textured,
        fit=fit,
        first=first,
        inverse=inverse,
        window=o.window,
        steps=o.steps,
        source_pad=views.source.pad,
        target_pad=views.target.pad,
        epsilon=o.epsilon_px * zoom,
        search_padding=SEARCH_PADDING_PX,
        margin=OUTSIDE_MARGIN_PX,
        max_extrapolation=MAX_EXTRAPOLATION,
        min_gain=REGISTRATION_GAIN_RANGE[0],
        max_gain=REGISTRATION_GAIN_RANGE[1],
        damping=AFFINE_DAMPING,
        min_pivot=MIN_PIVOT,
    )
    return _State(found / zoom, textured, fit, first, inverse)


@operator(
    kernel=_register_level_kernel,
    dtypes=dict.fromkeys(("source", "target", "q", "place", "warp"), torch.float32) | {"batch": torch.int64},
    when=_reads_whole_windows,
)
def _register_level(
    source: Tensor,
    target: Tensor,
    q: Tensor,
    place: Tensor,
    warp: Tensor,
    batch: Tensor,
    *,
    views: _Views,
    level: int,
) -> _State:
    """:func:`_search` on the levels ``source`` and ``target``, a chunk of points at a time."""
    pyramid_0, pyramid_1, o = views
    zoom = 0.5**level
    fine = o._replace(epsilon_px=o.epsilon_px * zoom)
    memory = None if is_static(warp) else warp.new_empty(2, min(MAX_CHUNK_POINTS, len(batch)), 8, o.window * o.window)
    parts = []
    for q_, place_, warp_, batch_ in zip(
        *(y.split(MAX_CHUNK_POINTS, -1) for y in (q, place, warp * zoom, batch)), strict=True
    ):
        patch, corner = _patch(pyramid_1, level, warp_[0], batch_, o.window)
        Q = _pictures(pyramid_0, q_, batch_, o.window, None if memory is None else memory[0, : len(batch_)])
        products = None if memory is None else memory[1, : len(batch_)]
        state = _descend(Q, patch, _from(corner, warp_), fine, products)
        inverse = (state.inverse[:6].unflatten(0, (3, 2)) * place_[:, None, None]).sum(0)
        parts.append(state._replace(warp=_from(-corner, state.warp) / zoom, inverse=inverse))
    return _State(*(torch.cat(field, -1) for field in zip(*parts, strict=True)))


def _descend(
    Q: Tensor,  # (M, 8, w²)
    patch: Tensor,  # (M, 1, s, s)
    warp: Tensor,  # (3, 2, M) px of the patch
    o: _Options,
    products: Tensor | None,  # (M, 8, w²), to be overwritten
) -> _State:
    """Steps of one chunk, from warp to warp in pixels of the patch; the whole inverse (8, 8, M)."""
    inverse, textured = _invert(_normal(Q))
    J = _read(patch, warp, o.window)
    fit = first = _quality(Q[:, 6], J, _share(warp[0, ..., None].clone()))
    moving, taken, before = textured, None, None
    for _ in range(o.steps):
        sums = torch.mul(Q, J[:, None], out=products).sum(-1)
        change = _change((inverse * sums[:, None]).sum(-1))
        taken, before = _further(change, taken, before), change
        warp = torch.where(moving, _compose(warp, taken, o.window), warp)
        J = _read(patch, warp, o.window)
        moving = moving & (change.abs().sum(0).amax(0) > o.epsilon_px)
        if not is_static(warp) and not moving.any():
            break
    if o.steps:
        fit = _quality(Q[:, 6], J, _share(_places(warp, o.window).flatten(2)))
    return _State(warp, textured, fit, first, inverse.permute(1, 2, 0))


def _further(change: Tensor, taken: Tensor | None, before: Tensor | None) -> Tensor:
    """The step to take where regression says ``change`` (3, 2, M), having said ``before`` when ``taken`` was taken."""
    if taken is None or before is None:
        return change
    bend = change - before
    share = (change * bend).sum((0, 1)) / (bend * bend).sum((0, 1)).clamp_min(1e-20)
    return change - share.clamp(-MAX_EXTRAPOLATION, MAX_EXTRAPOLATION / (1 + MAX_EXTRAPOLATION)) * (taken + bend)


def _nothing(there: Tensor) -> tuple[Tensor, ...]:
    """The fields of a :class:`AffineRegistration` for points (2, M) that are not registered."""
    none = torch.zeros_like(there[0], dtype=torch.bool)
    zero = torch.zeros_like(there[0])
    return there, _still(there), zero, _still(there), zero, none


def _accept(state: _State, first: Tensor, target: Pyramid, window: int) -> Tensor:
    """Which searches are believed (M,)."""
    size, gain = _determinant(_linear(state.warp, window)), state.fit[0]
    sane = (
        (size > REGISTRATION_SCALE_RANGE[0] ** 2)
        & (size < REGISTRATION_SCALE_RANGE[1] ** 2)
        & (gain > REGISTRATION_GAIN_RANGE[0])
        & (gain < REGISTRATION_GAIN_RANGE[1])
    )
    better = _noise(state.fit) <= MAX_RESIDUAL_GROWTH * _noise(first)
    return state.textured & sane & better & _inside(state.warp[0], target)


def _covariance(state: _State, place: Tensor, window: int) -> Tensor:
    """Covariance (2, 2, M) of where the ``place`` (3, M) in the window goes.

    With R = ``inverse`` and C = S⁻¹ its part for that place, white noise of variance s² moves it by s² (1 + 1/g²) C.
    But S holds the noise of T and its gradient as if it were texture: noise of energy E adds S (R E Rᵀ) S to it. With
    that taken out S is S' and the spread S'⁻¹ S S'⁻¹.
    """
    R = state.inverse.double()
    C = (R[:, :6].unflatten(1, (3, 2)) * place.double()[:, None]).sum(1)
    square, n = state.fit[0].clamp(*REGISTRATION_GAIN_RANGE).double().square(), window * window
    variance = _noise(state.fit).double().clamp_min(QUANTISATION_VARIANCE) * (n / (n - 8))
    u2 = (window // 2 + 1) / (window // 2) / 3  # mean over the window
    energy = R.new_tensor([1.0, 1.0, u2, u2, u2, u2, 1 / GRADIENT_NOISE, 0.0]) * GRADIENT_NOISE * n
    noise = (R[:, None] * R[None] * energy[:, None]).sum(2) * variance
    S = _inverse(C)
    false = product(product(S, noise), S)
    ratio = product(C, false)
    trace = (ratio[0, 0] + ratio[1, 1]) / 2
    most = trace + (trace * trace - _determinant(ratio)).clamp_min(0).sqrt()
    true = _inverse(S - false * (MAX_NOISE_RATIO / most.clamp_min(MAX_NOISE_RATIO)))
    spread = product(product(true, S), true) * (variance * (1 + square) / square)
    A = _linear(state.warp, window).double()
    return product(product(A.transpose(0, 1), spread), A).to(state.warp.dtype)


def _place(d: Tensor, window: int) -> Tensor:
    """Where an offset ``d`` (2, M), px, lies in the window: (1, u, v)."""
    return torch.cat((torch.ones_like(d[:1]), d / (window // 2)))


def _still(like: Tensor) -> Tensor:
    """Identities (2, 2, M)."""
    return torch.eye(2, dtype=like.dtype, device=like.device)[..., None].expand(2, 2, like.shape[-1])


def _start(there: Tensor, place: Tensor, A: Tensor, window: int) -> Tensor:
    """The warp with linear part ``A``, transposed, that sends ``place`` (3, M) ``there`` (2, M)."""
    sides = A * (window // 2)
    return torch.cat(((there - (sides * place[1:, None]).sum(0))[None], sides))


def _linear(warp: Tensor, window: int) -> Tensor:
    """Aᵀ (2, 2, M)."""
    return warp[1:] / (window // 2)


def _from(corner: Tensor, warp: Tensor) -> Tensor:
    """A warp seen from ``corner`` (2, M)."""
    return torch.cat(((warp[0] - corner)[None], warp[1:]))


def _pictures(source: Pyramid, q: Tensor, batch: Tensor, window: int, out: Tensor | None = None) -> Tensor:
    """The eight pictures (M, 8, w²) of windows around whole pixels ``q`` (2, M): ∇T, u ∇T, v ∇T, T without its mean
    and 1; u and v run from -1 to 1."""
    first, _ = source.locate(0, q, batch, window // 2, (GRAD_X_PLANE, GRAD_Y_PLANE, GREY_PLANE))
    G = source.read(0, first, window).transpose(0, 1)
    s = torch.linspace(-1, 1, window, dtype=q.dtype, device=q.device)
    one = torch.ones_like(G[:, :1])
    u = s.repeat(window)
    v = s.repeat_interleave(window)
    g, T = G[:, :2], G[:, 2:]
    return torch.cat((g, g * u, g * v, T - T.mean(-1, keepdim=True), one), 1, out=out)


def _patch(target: Pyramid, level: int, x: Tensor, batch: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """Patches (M, 1, s, s) of image 1 with room to move, and their first pixels (2, M)."""
    reach = window // 2 + SEARCH_PADDING_PX
    H, W = target.hw(level)
    middle = torch.minimum(round_half_up(x).clamp_min(0), x.new_tensor([[W - 1], [H - 1]]))
    first, _ = target.locate(level, middle, batch, reach, (GREY_PLANE,))
    side = 2 * reach + 1
    return target.read(level, first, side)[0].unflatten(-1, (side, side))[:, None], middle - reach


def _places(warp: Tensor, window: int) -> Tensor:
    """Where the window's pixels lie: planes (2, M, w, w)."""
    s = torch.linspace(-1, 1, window, dtype=warp.dtype, device=warp.device)
    middle, right, down = warp[..., None]
    return (middle + down * s)[..., None] + (right * s)[..., None, :]


def _read(patch: Tensor, warp: Tensor, window: int) -> Tensor:
    """J (M, w²) in a patch, the warp in its pixels; beyond its border the border's value."""
    middle = (patch.shape[-1] - 1) / 2
    grid = _places(_from(torch.full_like(warp[0], middle), warp) / middle, window).permute(1, 2, 3, 0)
    return F.grid_sample(patch, grid, padding_mode="border", align_corners=True).flatten(1)


def _quality(T: Tensor, J: Tensor, share: Tensor) -> Tensor:
    """How well windows agree (3, M): gain of J over T; mean square of what gain and bias leave; and ``share``."""
    energy = (T * T).sum(-1)
    gain = (T * J).sum(-1) / torch.where(energy > 0, energy, torch.ones_like(energy))
    rest = J - gain[:, None] * T
    variance = (rest - rest.mean(-1, keepdim=True)).square().mean(-1)
    return torch.stack((gain, variance, share))


def _share(places: Tensor) -> Tensor:
    """Which share (M,) of the variance of white noise is left, on average, by reading at places (2, M, k), overwritten.

    It would make half a pixel look a better fit.
    """
    u, v = places.frac_().abs_().sub_(0.5).square_().mul_(2).add_(0.5)
    return u.mul_(v).mean(-1)


def _noise(fit: Tensor) -> Tensor:
    """Variance (M,) of white noise, the same in both images, that would leave such a residual."""
    gain, variance, share = fit
    return variance / (share + gain.clamp(*REGISTRATION_GAIN_RANGE).square())


def _normal(Q: Tensor) -> Tensor:
    """Normal equations (M, 8, 8) of the eight pictures."""
    damping = torch.tensor([0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0], dtype=Q.dtype, device=Q.device) * AFFINE_DAMPING
    return torch.bmm(Q, Q.transpose(1, 2)) + torch.diag(damping)


def _invert(H: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse (M, 8, 8) of normal equations, and whether there is one."""
    diagonal = H.diagonal(dim1=1, dim2=2).double()
    s = diagonal.masked_fill(~(diagonal > 0), 1.0).rsqrt()
    s = s[:, :, None] * s[:, None]
    L, info = torch.linalg.cholesky_ex(H * s)
    textured = (info == 0) & (L.diagonal(dim1=1, dim2=2).amin(-1) > MIN_PIVOT)
    L = torch.where(textured[:, None, None], L, torch.eye(8, dtype=L.dtype, device=L.device) * AFFINE_DAMPING**0.5)
    return (torch.cholesky_inverse(L) * s).to(H.dtype), textured


def _change(solution: Tensor) -> Tensor:
    """The change (3, 2, M) that a solution (M, 8) says: δ, and what it adds at u = 1 and v = 1, px."""
    return (solution[:, :6].T / solution[:, 6].clamp(*REGISTRATION_GAIN_RANGE)).unflatten(0, (3, 2))


def _compose(warp: Tensor, change: Tensor, window: int) -> Tensor:
    """The warp after a change on the template's side: A becomes A (1 + D)⁻¹, and with that W_0 becomes W_0 - A δ."""
    half = window // 2
    sides = product(_inverse(_still(change) + change[1:] / half), warp[1:])
    return torch.cat(((warp[0] - (sides * change[0, :, None]).sum(0) / half)[None], sides))


def _inside(x: Tensor, pyramid: Pyramid) -> Tensor:
    low, high = pyramid.bounds(0)
    return ((x >= low) & (x <= high)).all(0)


def _determinant(A: Tensor) -> Tensor:
    return small.determinant_2x2(*A.flatten(0, 1))


def _inverse(A: Tensor) -> Tensor:
    """Inverse of (2, 2, M), its determinant kept from vanishing."""
    return small.inverse_2x2(*A.flatten(0, 1), least=1e-30).unflatten(0, (2, 2))
