"""Registration of small windows under affine motion, gain and bias: what is left to correct after a track was found.

Alphabet: ``p`` an offset in the window, px; the window of image 0 stands on the whole pixel q nearest to ``uv_0`` and
holds T and its gradient; the warp p → x + A p says where its pixels lie in image 1, J reads there; ``gain`` g and
``bias`` b: J ≈ g T + b. M points of all pairs travel in one row: x (2, M), A (2, 2, M).

Inverse composition (Baker and Matthews 2004) puts the small change δ, D of a step on the side of T, whose derivatives
never change: J ≈ g (T + ∇T · (δ + D p)) + b is linear regression of J on eight fixed pictures, ∇T, ∇T p, T and 1, so
gain and bias need no iteration of their own. T is never read between pixels, which keeps its noise white.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry.least_squares import solve_spd
from dhtorch.geometry.lookup import round_half_up
from dhtorch.geometry.pyramid import GRAD_X, GRAD_Y, GREY, REACH, Pyramid
from dhtorch.geometry.shapes import check

#: Points treated at once: few enough for their windows to stay in the cache.
CHUNK = 256

#: Steps that all points take, before those that still move are picked out.
STEPS_TOGETHER = 4

#: Added to the normal equations' affine part: what 2 / 255 of noise would say of a corner that moves by 2 px. It only
#: matters where the window determines no affine motion (a single edge).
DAMPING = (2 / 255 / 2) ** 2

#: Ratios of contrast beyond these limits are not believed, nor windows that grow or shrink by more.
GAIN, SCALE = (0.2, 5.0), (0.4, 2.5)

#: From this magnification on image 1 is read from its half-size level, where a pixel of the window meets a pixel again.
HALVE = 1.5

#: Variance of rounding grey values to 8 bits; no residual is believed to be smaller.
QUANTISATION = 1 / (12 * 255**2)

#: Variance of a pyramid's gradient in unit white noise.
GRADIENT_NOISE = 2 * (3**2 + 10**2 + 3**2) / 32**2

#: Share of the gradient's energy that is at most put down to noise.
MOST_NOISE = 0.9

#: A search that ends with this much more residual noise than it began with has diverged.
WORSE = 1.2

#: Which of the moments 1, u, v, uu, uv, vv is the product of two of 1, u, v.
_PRODUCT = ((0, 1, 2), (1, 3, 4), (2, 4, 5))


class Registration(NamedTuple):
    """What :func:`register` finds for B × N points."""

    uv_1: Tensor  # (B, N, 2) px, where uv_0 lies in image 1
    linear: Tensor  # (B, N, 2, 2) d uv_1 / d uv_0 of the window
    rms: Tensor  # (B, N) grey difference of the windows in grey values of image 0, gain and bias taken out
    cov: Tensor  # (B, N, 2, 2) px² of uv_1
    shift_px: Tensor  # (B, N) from the start to where the search went, also where that was rejected
    ok: Tensor  # (B, N) bool; where not, uv_1 is the start and linear the identity


class _State(NamedTuple):
    x: Tensor  # (2, M) px
    A: Tensor  # (2, 2, M)
    textured: Tensor  # (M,) the normal equations have a solution
    moving: Tensor  # (M,) not yet converged
    fit: Tensor  # (3, M) see _quality
    first: Tensor  # (3, M) the same where this search began
    inverse: Tensor  # (8, 8, M) of the normal equations


def register(
    source: Pyramid,
    target: Pyramid,
    uv_0: Tensor,  # (B, N, 2) px
    uv_1: Tensor,  # (B, N, 2) px, the start
    *,
    wanted: Tensor | None = None,  # (B, N) bool
    window: int = 21,
    iterations: int = 10,
    epsilon_px: float = 0.01,
    max_shift_px: float = 2.0,
) -> Registration:
    """Register the window around ``uv_0`` in the other image, up to an affine motion, a gain and a bias.

    A track is the place where a window fits best *unturned and unscaled*; under the perspective of a slanted surface
    that place is off by a fraction of a pixel that no residual shows. Gauss–Newton steps from there, with the window
    free to shear and to change its brightness, take the fraction out.

    Args:
        source, target: ``build_pyramid(image, levels, window)`` of both images; the second level of ``target`` is read
            where a window is magnified by more than 1.5.
        uv_1: closer than about a quarter of the window; the search begins there, unturned.
        wanted: points to register, by default all; the others cost nothing and are not ok, their numbers of no meaning.
        window: width in pixels, odd.
        iterations: most Gauss–Newton steps.
        epsilon_px: a step that moves no corner of the window further has converged.
        max_shift_px: a search that ends further from its start is rejected.

    Returns:
        :class:`Registration`. Rejected (not ok): without texture, not finite, too far, magnified or in contrast beyond
        belief, outside the image, or a larger residual than at the start; the numbers are then those of the start.
        ``cov`` is first-order and for white noise of equal variance in both images, which it estimates from the
        residual; reading between pixels smooths that noise and inflates A by the noise of T's gradient, and both are
        accounted for.

    Raises:
        ValueError: wrong shapes.

    Gradient: none; take :func:`step` from the result.
    Cost: reads a patch of image 1 once and 441 pixels of it per point and step.
    """
    B, N = (check("register", uv_0=(uv_0, "B N 2"), uv_1=(uv_1, "B N 2"), wanted=(wanted, "B N"))[k] for k in "BN")
    with torch.no_grad():
        here, there, batch, usable = _rows(source, target, uv_0, uv_1)
        if wanted is not None:
            usable = usable & wanted.reshape(-1)
        q = round_half_up(here)
        d = here - q
        still = torch.eye(2, dtype=d.dtype, device=d.device)[..., None].expand(2, 2, B * N)
        search = partial(_search, source, target, epsilon_px=epsilon_px, window=window)
        together = min(STEPS_TOGETHER, iterations)
        state = _resume(usable, _nothing(there - d, still), partial(search, level=0, steps=together), q, batch)
        start = state._replace(x=there - d, A=still, fit=state.first)
        if iterations > together:
            on = partial(search, level=0, steps=iterations - together)
            state = _resume(usable & state.moving, state, on, q, batch)
        if len(target.levels) > 1:
            on = partial(search, level=1, steps=iterations)
            state = _resume(usable & (_determinant(state.A) > HALVE**2), state, on, q, batch)
        shift = (state.x + _apply(state.A, d) - there).square().sum(0).sqrt()
        shift = torch.where(shift.isfinite(), shift, torch.full_like(shift, max_shift_px))
        ok = usable & _accept(state, start, target, shift, max_shift_px)
        state = _State(*(torch.where(ok, new, old) for new, old in zip(state, start, strict=True)))
        cov = _covariance(state, d, window)

    def grid(y: Tensor) -> Tensor:  # (..., M) -> (B, N, ...)
        y = y.unflatten(-1, (B, N)).movedim((-2, -1), (0, 1))
        return y.to(uv_0.dtype) if y.is_floating_point() else y

    rms = state.fit[1].sqrt() / state.fit[0].clamp(*GAIN)
    found = torch.where(ok, state.x + _apply(state.A, d), there)
    return Registration(
        uv_1=torch.where(grid(ok)[..., None], grid(found), uv_1.detach()),
        linear=grid(state.A),
        rms=grid(rms),
        cov=grid(cov),
        shift_px=grid(shift),
        ok=grid(ok),
    )


def step(
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
    """
    B, N = (check("step", uv_0=(uv_0, "B N 2"), uv_1=(uv_1, "B N 2"), linear=(linear, "B N 2 2"))[k] for k in "BN")
    here, there, batch, usable = _rows(source, target, uv_0, uv_1)
    q = round_half_up(here)
    A = linear.detach().to(here.dtype).permute(2, 3, 0, 1).reshape(2, 2, B * N)
    usable = usable & A.isfinite().all(0).all(0)
    A = torch.where(usable, A, torch.eye(2, dtype=A.dtype, device=A.device)[..., None])
    x = there - _apply(A, (here - q).detach())
    G = _template(source, q, batch, window)
    patch, corner = _patch(target, 0, x, batch, window)
    J = _read(patch, x - corner, A, window)
    solution, solved = solve_spd(_normal(G), _right_side(G, J)[..., None])
    x, A_new, _ = _compose(x, A, solution[..., 0].T.to(x.dtype), window)
    found = torch.where(usable & solved, x + _apply(A_new, here - q), there)
    return found.T.reshape(B, N, 2).to(uv_0.dtype)


def _rows(source: Pyramid, target: Pyramid, uv_0: Tensor, uv_1: Tensor):
    """Points of all pairs in a row: places in both images (2, M), their pair (M,), and whether both are usable."""
    B, N, _ = uv_0.shape
    here, there = (uv.to(source.levels[0].dtype).permute(2, 0, 1).reshape(2, B * N) for uv in (uv_0, uv_1.detach()))
    batch = torch.arange(B, device=uv_0.device).repeat_interleave(N)
    usable = _inside(here.detach(), source) & _inside(there, target)
    here, there = (torch.where(usable, y, torch.zeros_like(y)) for y in (here, there))
    return here, there, batch, usable


def _search(
    source: Pyramid,
    target: Pyramid,
    points: tuple[Tensor, ...],  # q (2, M), x (2, M), A (2, 2, M), batch (M,)
    *,
    level: int,
    steps: int,
    window: int,
    epsilon_px: float,
) -> _State:
    """Steps of all points, a chunk at a time, reading image 1 from one level."""
    zoom = 0.5**level
    parts = []
    for q, x, A, batch in zip(*(y.split(CHUNK, -1) for y in points), strict=True):
        G = _template(source, q, batch, window)
        state = _descend(G, target, level, steps, epsilon_px * zoom, (x * zoom, A * zoom, batch))
        parts.append(state._replace(x=state.x / zoom, A=state.A / zoom))
    return _State(*(torch.cat(field, -1) for field in zip(*parts, strict=True)))


def _descend(
    G: Tensor, target: Pyramid, level: int, steps: int, epsilon_px: float, points: tuple[Tensor, ...]
) -> _State:
    """Steps of one chunk, everything in pixels of the level read."""
    x, A, batch = points
    window = G.shape[-1]
    patch, corner = _patch(target, level, x, batch, window)
    H = _normal(G)
    eye = torch.eye(8, dtype=H.dtype, device=H.device)
    inverse, textured = solve_spd(H, eye.expand_as(H))
    J = _read(patch, x - corner, A, window)
    fit = first = _quality(G[2], J, x, A)
    moving = textured
    for _ in range(steps):
        solution = (inverse * _right_side(G, J)[:, None]).sum(-1).T
        x_new, A_new, moved = _compose(x, A, solution, window)
        x, A = torch.where(moving, x_new, x), torch.where(moving, A_new, A)
        J = _read(patch, x - corner, A, window)
        moving = moving & (moved > epsilon_px)
        if not _static(x) and not moving.any():
            break
    if steps:
        fit = _quality(G[2], J, x, A)
    inverse = torch.where(textured[:, None, None], inverse, eye / DAMPING).permute(1, 2, 0)
    return _State(x, A, textured, moving, fit, first, inverse)


def _nothing(x: Tensor, A: Tensor) -> _State:
    """The state of points that are not registered."""
    none, fit = torch.zeros_like(x[0], dtype=torch.bool), x.new_zeros(3, x.shape[1])
    eye = torch.eye(8, dtype=x.dtype, device=x.device)[..., None]
    return _State(x, A, none, none, fit, fit, (eye / DAMPING).expand(8, 8, x.shape[1]))


def _resume(wanted: Tensor, state: _State, search: Callable[..., _State], q: Tensor, batch: Tensor) -> _State:
    """The state, replaced where ``wanted`` (M,) by that of a further search from there."""
    points = (q, state.x, state.A, batch)
    if _static(wanted):
        return _State(*(torch.where(wanted, new, old) for new, old in zip(search(points), state, strict=True)))
    some = wanted.nonzero()[:, 0]
    if not len(some):
        return state
    new = search(tuple(y.index_select(-1, some) for y in points))
    return _State(*(old.index_copy(-1, some, n) for old, n in zip(state, new, strict=True)))


def _accept(state: _State, start: _State, target: Pyramid, shift: Tensor, max_shift_px: float) -> Tensor:
    """Which searches are believed (M,)."""
    size, gain = _determinant(state.A), state.fit[0]
    sane = (size > SCALE[0] ** 2) & (size < SCALE[1] ** 2) & (gain > GAIN[0]) & (gain < GAIN[1])
    better = _noise(state.fit) <= WORSE * _noise(start.fit)
    return state.textured & sane & better & (shift <= max_shift_px) & _inside(state.x, target)


def _covariance(state: _State, d: Tensor, window: int) -> Tensor:
    """Covariance (2, 2, M) of where the offset ``d`` (2, M) of the window goes.

    With R the rows of the inverse normal equations that move d and C = S⁻¹ their part for d itself, white noise of
    variance s² moves d by s² (1 + 1/g²) C. But S holds the noise of T and its gradient as if it were texture: noise of
    energy E adds S (R E Rᵀ) S to it. With that taken out S is S' and the spread S'⁻¹ S S'⁻¹.
    """
    weight = torch.stack((torch.ones_like(d[0]), d[0] / (window // 2), d[1] / (window // 2))).double()
    R = (state.inverse[:6].unflatten(0, (3, 2)).double() * weight[:, None, None]).sum(0)  # (2, 8, M)
    C = (R[:, :6].unflatten(1, (3, 2)) * weight[:, None]).sum(1)
    square, n = state.fit[0].clamp(*GAIN).double().square(), window * window
    variance = _noise(state.fit).double().clamp_min(QUANTISATION) * (n / (n - 8))
    u2 = (window // 2 + 1) / (window // 2) / 3  # mean over the window
    energy = R.new_tensor([1.0, 1.0, u2, u2, u2, u2, 1 / GRADIENT_NOISE, 0.0]) * GRADIENT_NOISE * n
    noise = (R[:, None] * R[None] * energy[:, None]).sum(2) * variance
    S = _inverse(C)
    false = _product(_product(S, noise), S)
    ratio = _product(C, false)
    trace = (ratio[0, 0] + ratio[1, 1]) / 2
    most = trace + (trace * trace - _determinant(ratio)).clamp_min(0).sqrt()
    true = _inverse(S - false * (MOST_NOISE / most.clamp_min(MOST_NOISE)))
    spread = _product(_product(true, S), true) * (variance * (1 + square) / square)
    A = state.A.double()
    return _product(_product(A, spread), A.transpose(0, 1)).to(state.x.dtype)


def _template(source: Pyramid, q: Tensor, batch: Tensor, window: int) -> Tensor:
    """Windows (3, M, w, w) of the gradient and of T without its mean, around whole pixels ``q`` (2, M)."""
    first, _ = source.locate(0, q, batch, window // 2, (GRAD_X, GRAD_Y, GREY))
    G = source.read(0, first, window)
    T = G[2:] - G[2:].mean(-1, keepdim=True)
    return torch.cat([G[:2], T]).unflatten(-1, (window, window))


def _patch(target: Pyramid, level: int, x: Tensor, batch: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """Patches (M, 1, s, s) of image 1 with room to move, and their first pixels (2, M)."""
    reach = window // 2 + REACH
    H, W = target.hw(level)
    middle = torch.minimum(round_half_up(x).clamp_min(0), x.new_tensor([[W - 1], [H - 1]]))
    first, _ = target.locate(level, middle, batch, reach, (GREY,))
    side = 2 * reach + 1
    return target.read(level, first, side)[0].unflatten(-1, (side, side))[:, None], middle - reach


def _places(x: Tensor, A: Tensor, window: int) -> Tensor:
    """Where the window's pixels lie: the planes (2, M, w, w) of x + A p."""
    half = window // 2
    p = torch.arange(-half, half + 1, dtype=x.dtype, device=x.device)
    return (x[..., None, None] + A[:, 1, :, None, None] * p[:, None]) + A[:, 0, :, None, None] * p


def _read(patch: Tensor, x: Tensor, A: Tensor, window: int) -> Tensor:
    """J (M, w, w) at x + A p, x (2, M) px of the patch; beyond its border the border's value."""
    scale = 2 / (patch.shape[-1] - 1)
    grid = _places(x * scale - 1, A * scale, window).permute(1, 2, 3, 0)
    return F.grid_sample(patch, grid, padding_mode="border", align_corners=True)[:, 0]


def _quality(T: Tensor, J: Tensor, x: Tensor, A: Tensor) -> Tensor:
    """How well windows agree (3, M): gain of J over T; mean square of what gain and bias leave; and which share of the
    variance of white noise reading between pixels has left in J (which would make half a pixel look a better fit)."""
    J = J - J.mean((-2, -1), keepdim=True)
    energy = (T * T).sum((-2, -1))
    gain = (T * J).sum((-2, -1)) / torch.where(energy > 0, energy, torch.ones_like(energy))
    variance = (J - gain[:, None, None] * T).square().mean((-2, -1))
    f = _places(x, A, T.shape[-1])
    f = f - f.floor()
    share = 1 - 2 * f * (1 - f)
    share = (share[0] * share[1]).mean((-2, -1))
    return torch.stack((gain, variance, share))


def _noise(fit: Tensor) -> Tensor:
    """Variance (M,) of white noise, the same in both images, that would leave such a residual."""
    gain, variance, share = fit
    return variance / (share + gain.clamp(*GAIN).square())


def _moments(Q: Tensor) -> Tensor:
    """Sums (M, 3, k) of pictures (k, M, w, w) times 1, u and v; u and v run from -1 to 1."""
    s = torch.linspace(-1, 1, Q.shape[-1], dtype=Q.dtype, device=Q.device)
    rows, columns = Q.sum(-1), Q.sum(-2)
    return torch.stack((rows.sum(-1), (columns * s).sum(-1), (rows * s).sum(-1))).permute(2, 0, 1)


def _right_side(G: Tensor, J: Tensor) -> Tensor:
    """Sums (M, 8) of J times the eight pictures."""
    ends = torch.stack(((G[2] * J).sum((-2, -1)), J.sum((-2, -1))), 1)
    return torch.cat((_moments(G[:2] * J).flatten(1), ends), 1)


def _normal(G: Tensor) -> Tensor:
    """Normal equations (M, 8, 8) of the eight pictures: ∇T, u ∇T, v ∇T, T and 1."""
    g, T = G[:2], G[2]
    Q = torch.stack((g[0] * g[0], g[0] * g[1], g[1] * g[1]))
    s = torch.linspace(-1, 1, Q.shape[-1], dtype=Q.dtype, device=Q.device)
    rows, columns, mixed = Q.sum(-1), Q.sum(-2), (Q * s).sum(-1)
    sums = torch.stack((rows, columns * s, rows * s, columns * s * s, mixed * s, rows * s * s)).sum(-1)  # (6, 3, M)
    product, pair = (torch.tensor(t, device=Q.device) for t in (_PRODUCT, ((0, 1), (1, 2))))
    H = sums[product][:, :, pair].permute(4, 0, 2, 1, 3).reshape(-1, 6, 6)
    damping = torch.tensor([0.0, 0.0, 1.0, 1.0, 1.0, 1.0], dtype=H.dtype, device=H.device) * DAMPING
    H = H + torch.diag(damping)
    side = torch.stack((_moments(g * T).flatten(1), _moments(g).flatten(1)), -1)  # (M, 6, 2)
    energy, zero = (T * T).sum((-2, -1)), torch.zeros_like(T[:, 0, 0])
    corner = torch.stack((energy, zero, zero, zero + T.shape[-2] * T.shape[-1]), -1).unflatten(-1, (2, 2))
    return torch.cat((torch.cat((H, side), 2), torch.cat((side.transpose(1, 2), corner), 2)), 1)


def _compose(x: Tensor, A: Tensor, solution: Tensor, window: int) -> tuple[Tensor, Tensor, Tensor]:
    """The warp after a step on the template's side, and how far it moves the window's corners, px."""
    half = window // 2
    c = solution[:6] / solution[6].clamp(*GAIN)
    D = torch.stack((torch.stack((c[2], c[4])), torch.stack((c[3], c[5])))) / half
    eye = torch.eye(2, dtype=x.dtype, device=x.device)[..., None]
    A_new = _product(A, _inverse(eye + D))
    moved = (c[:2].abs() + half * D.abs().sum(1)).amax(0)
    return x - _apply(A_new, c[:2]), A_new, moved


def _inside(x: Tensor, pyramid: Pyramid) -> Tensor:
    low, high = pyramid.bounds(0)
    return ((x >= low) & (x <= high)).all(0)


def _determinant(A: Tensor) -> Tensor:
    return A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]


def _inverse(A: Tensor) -> Tensor:
    """Inverse of (2, 2, M), its determinant kept from vanishing."""
    det = _determinant(A)
    det = torch.where(det.abs() > 1e-30, det, torch.full_like(det, 1e-30))
    return torch.stack((torch.stack((A[1, 1], -A[0, 1])), torch.stack((-A[1, 0], A[0, 0])))) / det


def _product(A: Tensor, B: Tensor) -> Tensor:
    """(2, 2, M) times (2, 2, M), as sums: rounding then does not depend on the batch."""
    return (A[:, :, None] * B[None]).sum(1)


def _apply(A: Tensor, d: Tensor) -> Tensor:
    return A[:, 0] * d[0] + A[:, 1] * d[1]


def _static(x: Tensor) -> bool:
    """Whether shapes must not depend on values."""
    return torch.compiler.is_compiling() or torch._C._functorch.is_functorch_wrapped_tensor(x)
