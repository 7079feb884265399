"""Stage 4: the samples found again in the other image, by pyramidal Lucas-Kanade, forward and back.

Alphabet: ``x`` a point of the first image (the source) and ``d`` its displacement to the second (the target), (2, M) px
of the level at hand, the M points of all pairs in one row; ``batch`` (M,) the pair a point belongs to; T the window at
x, J the target, g = (dT/dx, dT/dy), A = sum g gᵀ; ``moments`` (5 or 6, M): sum g T, A_xx, A_xy, A_yy and, where the
gain is estimated, sum T².

Why it is fast. A Gauss-Newton step solves A step = sum g (J(d) - T). J between pixels is a weighted mean of J at
pixels, and the sum over the window is linear in J; so sum g J(d) is the same weighted mean of a few numbers
C[o] = sum_p g(p) J(p + o), o an offset in whole pixels. This *map* C is computed once for a small square of offsets, by
a depthwise convolution whose channels are the points. After that a step touches eight numbers per point, and no pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry import affine
from dhtorch.geometry.pyramid import GRAD_X, GRAD_Y, GREY, REACH, Pyramid, build_pyramid
from dhtorch.geometry.shapes import check
from dhtorch.records import Tracks

#: Smallest eigenvalue of A per pixel of the window below which it is not tracked: 1e-4 of cv2, which sums gradients
#: of 8-bit images scaled by 2^-5.
MIN_EIGENVALUE = 1e-4 * 2**10 / 255**2

#: Points whose windows are read at once: few enough for the windows to stay in the cache.
CHUNK = 256

#: Rows of points are filled up to multiples of this, so that vector instructions leave no remainder and a point's
#: rounding does not depend on how many others there are.
LANES = 64

#: A map covers the offsets from -radius to radius + 1; larger on the coarsest level, where nothing is known yet.
RADIUS, RADIUS_TOP = 1, 3

#: Steps on the first map of a level and on each further one, until ``iterations`` are used up.
FIRST_STEPS, NEXT_STEPS = 8, 4

#: Steps that all points of a map take together, before those that still move are picked out.
STEPS_TOGETHER = 4

#: Coarse levels only provide a start: there a step has converged at so many times ``epsilon_px``.
COARSE_EPSILON = 4.0

#: A ratio of contrasts beyond these limits is not believed.
GAIN = (0.2, 5.0)

#: Variance of rounding grey values to 8 bits; no residual is believed to be smaller.
QUANTISATION = 1 / (12 * 255**2)


class _Options(NamedTuple):
    window: int
    iterations: int
    epsilon_px: float
    min_eigenvalue: float
    normalise: str


class _Pair(NamedTuple):
    """One level of two pyramids, and where points may be on it."""

    source: Pyramid
    target: Pyramid
    level: int
    low: Tensor  # (2, 1) px of the level
    high: Tensor  # (2, 1) px of the level


def lucas_kanade(
    image_0: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    image_1: Tensor,  # (B, C, H', W')
    uv_0: Tensor,  # (B, N, 2) px
    *,
    uv_1_init: Tensor | None = None,  # (B, N, 2) px
    pyramid_0: Pyramid | None = None,
    window: int = 21,
    levels: int = 4,
    iterations: int = 30,
    epsilon_px: float = 0.01,
    max_round_trip_px: float = 1.0,
    normalise: str = "none",
    min_eigenvalue: float = MIN_EIGENVALUE,
) -> Tracks:
    """Track points from image 0 to image 1 and back; a track that does not return to its start is not valid.

    From coarse to fine, every window takes Gauss-Newton steps towards the smallest squared grey difference to its
    template. The way back starts from the point found as if nothing were known of the way there (with ``uv_1_init``:
    from the opposite displacement), so that it is a test.

    Args:
        uv_1_init: where to start in image 1; at ``uv_0`` by default and where it is not finite.
        pyramid_0: ``build_pyramid(image_0, levels, window)``, made once for an anchor tracked into many views.
        window: width in pixels, odd.
        levels: pyramid levels, full resolution included; fewer where a level would be no larger than the window.
        iterations: most Gauss-Newton steps per level. A point that outruns its map waits for the next one, made after
            step 8 and then after every fourth.
        epsilon_px: a shorter step has converged; on coarse levels, which only provide a start, four times that.
        normalise: ``none``; ``bias`` removes the means of both windows; ``gain_bias`` also their ratio of contrast.
        min_eigenvalue: of A / window² (grey values in [0, 1]); a window with less has too little texture.

    Returns:
        Tracks in the dtype of ``uv_0``. ``error`` is the round trip (the way there where it led nowhere);
        ``photometric`` the rms grey difference of the windows, in grey values of image 0, after normalisation; ``cov``
        is s² A⁻¹ with s² the residual variance, not below that of 8-bit rounding, and the small eigenvalue of A kept
        from vanishing: always finite, large without texture. It understates white noise, which reading between pixels
        smooths out of the residual. ``valid``: inside image 1 on the finest level from start to end, textured, round
        trip below its limit. Not valid: ``uv_1`` is the last position; for a ``uv_0`` outside the image the start of
        the search, with 0 for what is not finite.

    Raises:
        ValueError: wrong shapes or options, an image no larger than the window, a pyramid of another image or window.

    Gradient: the search has none. When an image or ``uv_0`` requires it, valid points take one more, differentiable
    step (:func:`refine`); all other fields are detached.

    Source: Lucas and Kanade 1981; Bouguet 2000 (pyramid); Baker and Matthews 2004 (inverse composition); checked
    against ``cv2.calcOpticalFlowPyrLK``.
    """
    check("lucas_kanade", image_0=(image_0, "B C H W"), uv_0=(uv_0, "B N 2"), uv_1_init=(uv_1_init, "B N 2"))
    check("lucas_kanade", image_1=(image_1, "B C H W"), uv_0=(uv_0, "B N 2"))
    _check_options(iterations, normalise)
    o = _Options(window, iterations, epsilon_px, min_eigenvalue, normalise)
    with torch.no_grad():
        source = build_pyramid(image_0, levels, window) if pyramid_0 is None else pyramid_0
        _check_pyramid(source, image_0, window)
        target = build_pyramid(image_1, levels, window)
        tracks = _there_and_back(source, target, uv_0.detach(), uv_1_init, max_round_trip_px, o)
    if torch.is_grad_enabled() and (image_0.requires_grad or image_1.requires_grad or uv_0.requires_grad):
        uv_1 = refine(image_0, image_1, uv_0, tracks.uv_1, window=window, normalise=normalise)
        return tracks.replace(uv_0=uv_0, uv_1=torch.where(tracks.valid[..., None], uv_1, tracks.uv_1))
    return tracks


def refine(
    image_0: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    image_1: Tensor,  # (B, C, H', W')
    uv_0: Tensor,  # (B, N, 2) px
    uv_1: Tensor,  # (B, N, 2) px
    *,
    window: int = 21,
    normalise: str = "none",
    min_eigenvalue: float = MIN_EIGENVALUE,
) -> Tensor:
    """One differentiable Gauss-Newton step from ``uv_1``: the position (B, N, 2) as a function of the images.

    Where the search has converged the step is zero but its derivative is not: it is that of the converged position (by
    the implicit function theorem, with the Gauss-Newton Hessian). Points that are not finite, outside an image or
    without texture stay where they are, with 0 for what is not finite.

    Raises:
        ValueError: wrong shapes or options, or an image no larger than the window.

    Gradient: to both images and ``uv_0``; ``uv_1`` is detached.
    """
    check("refine", image_0=(image_0, "B C H W"), uv_0=(uv_0, "B N 2"), uv_1=(uv_1, "B N 2"))
    check("refine", image_1=(image_1, "B C H W"), uv_0=(uv_0, "B N 2"))
    _check_options(1, normalise)
    source, target = build_pyramid(image_0, 1, window), build_pyramid(image_1, 1, window)
    B, N, _ = uv_0.shape
    x, x_1 = (uv.to(source.levels[0].dtype).permute(2, 0, 1).reshape(2, B * N) for uv in (uv_0, uv_1.detach()))
    usable = _within(x, *source.bounds(0)) & _within(x_1, *target.bounds(0))
    start = _finite(x_1)
    x, x_1 = (torch.where(usable, y, torch.zeros_like(y)) for y in (x, x_1))
    batch = torch.arange(B, device=x.device).repeat_interleave(N)
    G = _project(source.windows(0, x, batch, window), normalise)
    J = target.windows(0, x_1, batch, window, (GREY,))
    moments = _moments(G, normalise)
    A_inv, textured = _inverse(moments[2:5], min_eigenvalue * window**2)
    step = _steps((_kernels(G, normalise) * J).sum(-1), moments, A_inv)
    if normalise == "gain_bias":
        step = step[:2] / step[2].clamp(*GAIN)
    found = start - torch.where(usable & textured, step, torch.zeros_like(step))
    return found.reshape(2, B, N).permute(1, 2, 0).to(uv_0.dtype)


def _there_and_back(source: Pyramid, target: Pyramid, uv_0: Tensor, init: Tensor | None, limit_px: float, o: _Options):
    """Tracks of all points, laid out in one row (2, M), filled up to whole LANES by points outside the image."""
    B, N, _ = uv_0.shape
    fill = -(B * N) % LANES if N else LANES

    def row(uv: Tensor) -> Tensor:
        return F.pad(uv.to(source.levels[0].dtype).permute(2, 0, 1).reshape(2, B * N), (0, fill), value=-2.0)

    def grid(y: Tensor) -> Tensor:  # (..., M) -> (B, N, ...)
        y = y[..., : B * N].reshape(*y.shape[:-1], B, N).movedim((-2, -1), (0, 1))
        return y.to(uv_0.dtype) if y.is_floating_point() else y

    x = row(uv_0)
    d = torch.zeros_like(x) if init is None else row(init) - x
    d = torch.where(d.isfinite().all(0), d, torch.zeros_like(d))
    known = _within(x, *source.bounds(0))
    elsewhere = _finite(x) + d
    x = torch.where(known, x, torch.zeros_like(x))
    batch = F.pad(torch.arange(B, device=x.device).repeat_interleave(N), (0, fill))

    forward, found, A = _search(source, target, o, x, d, batch, known)
    search_back = partial(_search, target, source, o)
    nothing = torch.zeros_like(d), torch.zeros_like(found), torch.zeros_like(A)
    backward, returned, _ = _for_some(found, search_back, nothing, (x + forward, -d, batch, found))
    error = (forward + backward).square().sum(0).sqrt()
    squares = _sum_of_squares(source, target, x, forward, batch, o)
    return Tracks(
        uv_0=uv_0,
        uv_1=grid(torch.where(known, x + forward, elsewhere)),
        error=grid(error),
        photometric=grid((squares / o.window**2).sqrt()),
        cov=grid(_covariance(A, squares / (o.window**2 - 2))),
        valid=grid(found & returned & (error < limit_px)),
    )


def _search(source: Pyramid, target: Pyramid, o: _Options, x: Tensor, d: Tensor, batch: Tensor, known: Tensor):
    """Coarse to fine from ``d``: displacement (2, M), whether it was found (M,), and A (3, M) of the finest level."""
    top = min(len(source.levels), len(target.levels)) - 1
    coarse = o._replace(epsilon_px=o.epsilon_px * COARSE_EPSILON)
    d = d * 0.5**top
    for level in range(top, 0, -1):
        pair = _Pair(source, target, level, *target.bounds(level))
        pixel = source.corner(level, x * 0.5**level + 0.5)  # read between pixels only where it decides the answer
        d, _, _ = _descend(pair, coarse, RADIUS_TOP if level == top else RADIUS, pixel, d, batch, known)
        d = d * 2
    pair = _Pair(source, target, 0, *target.bounds(0))
    d, textured, A = _descend(pair, o, RADIUS if top else RADIUS_TOP, x, d, batch, known)
    return d, known & textured & _within(x + d, pair.low, pair.high), A


def _descend(pair: _Pair, o: _Options, radius: int, x: Tensor, d: Tensor, batch: Tensor, known: Tensor):
    """One level: all points on a first map, then those that outran it on further ones.

    Returns the displacement, whether the window is textured (M,), and A (3, M).
    """
    first = min(FIRST_STEPS, o.iterations)
    corner = pair.target.corner(pair.level, x + d) - radius
    C, moments = _map(pair, o, radius, x, corner, batch)
    A_inv, textured = _inverse(moments[2:5], o.min_eigenvalue * o.window**2)
    live = known & textured & _within(x + d, pair.low, pair.high)
    d, live = _on_map(pair, o, first, _steps(C, moments, A_inv), corner, x, d, live)
    for done in range(first, o.iterations, NEXT_STEPS):
        again = partial(_on_new_map, pair, o, radius, min(NEXT_STEPS, o.iterations - done))
        d, live = _for_some(live, again, (d, live), (x, d, batch, live, moments, A_inv))
    return d, textured, moments[2:5]


def _for_some(wanted: Tensor, fn: Callable, values: tuple[Tensor, ...], columns: tuple[Tensor, ...]):
    """``values`` (each (..., M)), replaced where ``wanted`` (M,) by what ``fn(*columns)`` returns.

    Where shapes may depend on values, ``fn`` sees only the wanted points, filled up by copies of the first.
    """
    if _static(wanted):
        return tuple(torch.where(wanted, new, old) for new, old in zip(fn(*columns), values, strict=True))
    some = wanted.nonzero()[:, 0]
    if not len(some):
        return values
    some = torch.cat([some, some[:1].expand(-len(some) % LANES)])
    new = fn(*(column.index_select(-1, some) for column in columns))
    return tuple(old.index_copy(-1, some, n) for old, n in zip(values, new, strict=True))


def _on_new_map(pair: _Pair, o: _Options, radius: int, steps: int, x, d, batch, live, moments, A_inv):  # noqa: PLR0917
    """:func:`_on_map` with a map around where the points are, of windows whose moments are known."""
    corner = pair.target.corner(pair.level, x + d) - radius
    C, _ = _map(pair, o, radius, x, corner, batch, moments)
    return _on_map(pair, o, steps, _steps(C, moments, A_inv), corner, x, d, live)


def _on_map(
    pair: _Pair,
    o: _Options,
    steps: int,
    field: Tensor,  # (2 or 3, n, n, M) see _steps
    corner: Tensor,  # (2, M) the target's pixel where the map begins
    x: Tensor,  # (2, M)
    d: Tensor,  # (2, M)
    live: Tensor,  # (M,) wants to move
) -> tuple[Tensor, Tensor]:
    """At most ``steps`` steps on one map: the displacement, and who wants more.

    A point stops for good at a short step or when it leaves the level's bounds, and on this map when it leaves the map.
    """
    low, high, end = pair.low - corner, pair.high - corner, field.shape[1] - 1.0  # all positions are on the map now
    start = x + d - corner
    still = (field, low.clamp_min(0), high.clamp_max(end))
    together = steps if x.shape[1] <= CHUNK else min(steps, STEPS_TOGETHER)
    p, moving = _walk(o, together, start, live, *still)
    if steps > together:
        further = partial(_walk, o, steps - together)
        p, moving = _for_some(moving, further, (p, moving), (p, moving, *still))
    p = torch.where(p.isfinite(), p, start)
    off_the_map = (p != p.clamp(0, end)).any(0)
    return p + corner - x, live & (moving | off_the_map) & _within(p, low, high)


def _walk(o: _Options, steps: int, p: Tensor, moving: Tensor, field: Tensor, low: Tensor, high: Tensor):
    """Gauss-Newton steps of map positions ``p`` (2, M) while ``moving`` (M,); a short step or a bound ends it."""
    node = torch.arange(field.shape[1], dtype=p.dtype, device=p.device)[:, None]
    for _ in range(steps):
        hat = (1 - (p[:, None] - node).abs()).clamp_min(0)  # (2, n, M) bilinear weights
        step = ((field * hat[0]).sum(2) * hat[1]).sum(1)
        if len(field) == 3:
            step = step[:2] / step[2].clamp(*GAIN)
        p = torch.where(moving, p - step, p)
        moving = moving & ((step * step).sum(0) > o.epsilon_px**2) & (p == p.clamp(low, high)).all(0)
        if not _static(p) and not moving.any():
            break
    return p, moving


def _steps(C: Tensor, moments: Tensor, A_inv: Tensor) -> Tensor:
    """Gauss-Newton steps (2, ..., M) from correlations (K, ..., M), as linear in them as a map is between its nodes.

    With K = 3 the steps are those for equal contrast, and a third plane is the gain they are to be divided by.
    """
    shape = (2, *(1,) * (C.ndim - 2), C.shape[-1])
    change = C[:2] - moments[:2].view(shape)
    steps = A_inv[:, 0].view(shape) * change[0] + A_inv[:, 1].view(shape) * change[1]
    return steps if len(C) == 2 else torch.cat([steps, _gain(C[2:], moments[5])])


def _map(
    pair: _Pair, o: _Options, radius: int, x: Tensor, corner: Tensor, batch: Tensor, moments: Tensor | None = None
):
    """Map (K, n, n, M) of the windows at ``x`` (2, M) that begins at the target's pixels ``corner``; the moments."""
    w, side = o.window, o.window + 2 * radius + 1
    first_0, fraction = pair.source.locate(pair.level, x, batch, w // 2, (GRAD_X, GRAD_Y, GREY))
    first_1, _ = pair.target.locate(pair.level, corner + radius, batch, w // 2 + radius, (GREY,))
    maps, sums = [], []
    for i, j, f in zip(*(y.split(CHUNK, -1) for y in (first_0, first_1, fraction)), strict=True):
        G = _project(pair.source.read(pair.level, i, w, None if pair.level else f), o.normalise)
        if moments is None:
            sums.append(_moments(G, o.normalise))
        kernel = _kernels(G, o.normalise)
        K, m = kernel.shape[:2]
        J = pair.target.read(pair.level, j.expand(K, m), side).view(1, K * m, side, side)
        maps.append(F.conv2d(J, kernel.reshape(K * m, 1, w, w), groups=K * m).view(K, m, side - w + 1, side - w + 1))
    C = torch.cat(maps, 1).permute(0, 2, 3, 1).contiguous()
    return C, torch.cat(sums, -1) if moments is None else moments


def _sum_of_squares(source: Pyramid, target: Pyramid, x: Tensor, d: Tensor, batch: Tensor, o: _Options) -> Tensor:
    """Squared grey differences between the windows at ``x`` and ``x + d`` after normalisation, summed: (M,)."""
    sums = []
    for p, q, b in zip(*(y.split(CHUNK, -1) for y in (x, x + d, batch)), strict=True):
        T = source.windows(0, p, b, o.window, (GREY,))[0]
        J = target.windows(0, q, b, o.window, (GREY,))[0]
        if o.normalise != "none":
            T, J = T - T.mean(-1, keepdim=True), J - J.mean(-1, keepdim=True)
        if o.normalise == "gain_bias":
            J = J / _gain((T * J).sum(-1), (T * T).sum(-1)).clamp(*GAIN)[:, None]
        sums.append((J - T).square().sum(-1))
    total = torch.cat(sums)
    return torch.where(total.isfinite(), total, torch.full_like(total, o.window**2))


def _project(G: Tensor, normalise: str) -> Tensor:
    """Windows (3, M, w²) of g_x, g_y and T with what the normalisation leaves free (bias, gain) taken out of them."""
    if normalise == "none":
        return G
    G = G - G.mean(-1, keepdim=True)
    if normalise == "bias":
        return G
    g, T = G[:2], G[2:]
    energy = (T * T).sum(-1, keepdim=True)
    share = (g * T).sum(-1, keepdim=True) / torch.where(energy > 0, energy, torch.ones_like(energy))
    return torch.cat([g - share * T, T])


def _kernels(G: Tensor, normalise: str) -> Tensor:
    """What a step needs correlated with J, (K, M, w²): g, and T where the gain is estimated."""
    return G if normalise == "gain_bias" else G[:2]


def _moments(G: Tensor, normalise: str) -> Tensor:
    """Sums over the windows (3, M, w²) of g_x, g_y and T: (5 or 6, M), see the alphabet."""
    last = 3 if normalise == "gain_bias" else 2
    return torch.cat([(G[:2] * G[2]).sum(-1), (G[:2] * G[0]).sum(-1), (G[1:last] * G[1:last]).sum(-1)])


def _gain(correlation: Tensor, energy: Tensor) -> Tensor:
    """Contrast of J in units of T's."""
    gain = correlation / torch.where(energy > 0, energy, torch.ones_like(energy))
    return torch.where(energy > 0, gain, torch.ones_like(gain))


def _inverse(A: Tensor, min_eigenvalue: float) -> tuple[Tensor, Tensor]:
    """Inverse (2, 2, M) of A (3, M), zero where its small eigenvalue is not above the limit; and where it is (M,)."""
    a, b, c = A.double()
    textured = _small_eigenvalue(a, b, c) > min_eigenvalue
    det = torch.where(textured, a * c - b * b, torch.ones_like(a))
    inverse = torch.stack([c, -b, -b, a]) / det
    return torch.where(textured, inverse, torch.zeros_like(inverse)).to(A.dtype).unflatten(0, (2, 2)), textured


def _covariance(A: Tensor, variance: Tensor) -> Tensor:
    """s² A⁻¹ (2, 2, M). The small eigenvalue of A is raised to 1e-5 of the large one, which float32 can represent."""
    a, b, c = torch.where(A.isfinite(), A, torch.zeros_like(A)).double()
    small = _small_eigenvalue(a, b, c)
    lift = (1e-5 * (a + c - small).clamp_min(1e-4) - small).clamp_min(0)
    a, c = a + lift, c + lift
    scale = variance.double().clamp_min(QUANTISATION) / (a * c - b * b)
    return (torch.stack([c, -b, -b, a]) * scale).to(A.dtype).unflatten(0, (2, 2))


def _small_eigenvalue(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    half = (a - c) / 2
    return (a + c) / 2 - (half * half + b * b).sqrt()


def _within(x: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Whether points (2, M) lie between bounds; NaN does not."""
    return ((x >= low) & (x <= high)).all(0)


def _finite(x: Tensor) -> Tensor:
    return torch.where(x.isfinite(), x, torch.zeros_like(x))


def _static(x: Tensor) -> bool:
    """Whether shapes must not depend on values."""
    return torch.compiler.is_compiling() or torch._C._functorch.is_functorch_wrapped_tensor(x)


def _check_options(iterations: int, normalise: str) -> None:
    if normalise not in ("none", "bias", "gain_bias"):
        raise ValueError(f"lucas_kanade: normalise is {normalise!r}, expected none, bias or gain_bias")
    if iterations < 1:
        raise ValueError(f"lucas_kanade: iterations is {iterations}, expected at least 1")


def _check_pyramid(pyramid: Pyramid, image: Tensor, window: int) -> None:
    found, expected = (len(pyramid.levels[0]), *pyramid.hw()), (image.shape[0], *image.shape[-2:])
    if found != expected or pyramid.pad != window // 2 + REACH:
        raise ValueError(
            f"lucas_kanade: pyramid_0 is of (B, H, W) {found} with padding {pyramid.pad}, "
            f"expected {expected} with {window // 2 + REACH}"
        )


def lucas_kanade_affine(
    image_0: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    image_1: Tensor,  # (B, C, H', W')
    uv_0: Tensor,  # (B, N, 2) px
    *,
    uv_1_init: Tensor | None = None,  # (B, N, 2) px
    pyramid_0: Pyramid | None = None,
    track: Callable[..., Tracks] = lucas_kanade,
    window: int = 21,
    levels: int = 4,
    iterations: int = 10,
    epsilon_px: float = 0.01,
    max_shift_px: float = 2.0,
) -> Tracks:
    """Track as ``track`` does, then register every window once more, free to shear and to change its brightness.

    Args:
        uv_1_init, pyramid_0: as in :func:`lucas_kanade`.
        track: the search that finds the windows, a seat-4 function; it is given ``window`` and ``levels``.
        window, levels: of both searches.
        iterations, epsilon_px, max_shift_px: of the registration, see :func:`dhtorch.geometry.affine.register`.

    Returns:
        Tracks of ``track`` with new ``uv_1``, ``cov`` (right for white noise, see ``register``) and ``photometric``, a
        residual with gain and bias taken out. A registration that is rejected leaves the position and
        raises ``error`` to how far it went, at most ``max_shift_px``; ``photometric`` and ``cov`` are then those of the
        unregistered window. ``valid`` is untouched.

    Raises:
        ValueError: as ``track``.

    Gradient: as :func:`lucas_kanade`, by one more step of the registration; all other fields are detached.
    Source: Baker and Matthews 2004, "Lucas-Kanade 20 years on", inverse composition with appearance variation.
    """
    check("lucas_kanade_affine", image_0=(image_0, "B C H W"), uv_0=(uv_0, "B N 2"), uv_1_init=(uv_1_init, "B N 2"))
    check("lucas_kanade_affine", image_1=(image_1, "B C H W"), uv_0=(uv_0, "B N 2"))
    with torch.no_grad():
        source = build_pyramid(image_0, levels, window) if pyramid_0 is None else pyramid_0
        tracks = track(image_0, image_1, uv_0, uv_1_init=uv_1_init, pyramid_0=source, window=window, levels=levels)
        target = build_pyramid(image_1, 2, window)
        found = affine.register(
            source,
            target,
            uv_0,
            tracks.uv_1,
            window=window,
            iterations=iterations,
            epsilon_px=epsilon_px,
            max_shift_px=max_shift_px,
        )
        moved, rejected = tracks.valid & found.ok, tracks.valid & ~found.ok
        uv_1 = torch.where(moved[..., None], found.uv_1, tracks.uv_1)
        error = torch.maximum(tracks.error, found.shift_px.clamp(max=max_shift_px))
        tracks = tracks.replace(
            uv_0=uv_0,
            uv_1=uv_1,
            error=torch.where(rejected, error, tracks.error),
            photometric=torch.where(tracks.valid, found.rms, tracks.photometric),
            cov=torch.where(tracks.valid[..., None, None], found.cov, tracks.cov),
        )
    if torch.is_grad_enabled() and (image_0.requires_grad or image_1.requires_grad or uv_0.requires_grad):
        source, target = build_pyramid(image_0, 1, window), build_pyramid(image_1, 1, window)
        again = affine.step(source, target, uv_0, tracks.uv_1, found.linear, window=window)
        # The value is the search's, bit for bit; the step lends its derivative.
        return tracks.replace(uv_1=torch.where(tracks.valid[..., None], uv_1 + (again - again.detach()), uv_1))
    return tracks
