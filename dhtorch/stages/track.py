"""Stage 4: the samples found again in the other image, by pyramidal Lucas-Kanade, forward and back.

Alphabet: ``x`` a point of the first image and ``d`` its displacement, (2, M) px of the level at hand, the M points of
all pairs in one row; ``batch`` (M,) the pair a point belongs to; T the window of the first image (the template), J the
second image, g = (dT/dx, dT/dy) the template's gradient, A = sum g gᵀ.

Why it is fast. A Gauss-Newton step solves A step = sum g (J(d) - T). J between pixels is a weighted mean of J at
pixels, and the sum over the window is linear in J; so sum g J(d) is the same weighted mean of a few numbers
C[o] = sum_p g(p) J(p + o), o an offset in whole pixels. C is computed once for a small square of offsets, by a
depthwise convolution whose channels are the points. After that a step touches eight numbers per point, and no pixel.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry.lookup import luma, patches, round_half_up, windows
from dhtorch.geometry.pyramid import REACH, Pyramid, build_pyramid
from dhtorch.geometry.shapes import check
from dhtorch.records import Tracks

#: Smallest eigenvalue of A per pixel of the window below which it is not tracked: 1e-4 of cv2, which sums the
#: gradients of 8-bit images scaled by 2^-5.
MIN_EIGENVALUE = 1e-4 * 2**10 / 255**2

#: Points that are convolved at once. Always the same number, so that the kernel, and with it the rounding of a point's
#: answer, does not depend on how many other points there are; small, so that their windows stay in the cache.
CHUNK = 256

#: A correlation map covers whole-pixel offsets from -radius to radius + 1; larger on the coarsest level.
RADIUS, RADIUS_TOP = 1, 3

#: Steps on the first and on the second map of a level; the third may use what is left of ``iterations``.
STEPS_PER_MAP = (10, 8)

#: Steps that all points of a map make together, before those still moving are picked out.
DENSE_STEPS = 4

#: Variance of rounding grey values to 8 bits: no residual is believed to be smaller.
QUANTISATION = 1 / (12 * 255**2)


class _Options(NamedTuple):
    window: int
    iterations: int
    epsilon_px: float
    min_eigenvalue: float
    normalise: str


class _Pair(NamedTuple):
    """One level of two pyramids."""

    source: Tensor  # (B, 3, rows, width)
    target: Tensor  # (B, 3, rows', width')
    pad: int
    bounds: tuple[Tensor, Tensor]  # (2, 1) px of the target's positions
    sub_pixel: bool  # whether the source's windows are read between pixels


class _Windows(NamedTuple):
    """What is known of the windows of M points after a first look."""

    at_rest: Tensor  # (2, M) sum g T: what the correlation of g would be if J were T
    A: Tensor  # (3, M) A_xx, A_xy, A_yy
    energy: Tensor  # (M,) sum T²; only where the gain is estimated


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

    From coarse to fine, every window moves by Gauss-Newton steps until the squared grey difference to its template
    (taken once, at the pixel nearest to the point) no longer falls. The way back starts from the point found, as if
    nothing were known of the way there (with ``uv_1_init``: from the opposite displacement), so that it is a test.

    Args:
        uv_1_init: where to start in image 1; not finite = at ``uv_0``, which is also the default.
        pyramid_0: ``build_pyramid(image_0, levels, window)``, to be made once for an anchor tracked into many views.
        window: width in pixels, odd.
        levels: pyramid levels, full resolution included; fewer where a level would be no larger than the window.
        iterations: most Gauss-Newton steps per level; a point that outruns three maps of a level stops there earlier.
        epsilon_px: a point whose step is shorter, in pixels of the level, has converged on it.
        normalise: ``none``; ``bias`` removes the means of both windows; ``gain_bias`` their contrast as well.
        min_eigenvalue: of A / window² (image in [0, 1]), below which a window has too little texture.

    Returns:
        Tracks. ``error`` is the round trip; ``photometric`` the rms grey difference of the windows (after
        normalisation, in grey values of image 0); ``cov`` = s² A⁻¹ with s² the residual variance, not below that of
        8-bit rounding, and A's small eigenvalue kept from vanishing, so that it is finite, and large without texture.
        Valid: inside image 1 from start to end on the finest level, textured, round trip below the limit. Where not
        valid, ``uv_1`` is the last position; for a ``uv_0`` outside the image it is the start, with 0 for non-finite.

    Raises:
        ValueError: wrong shapes or options, an image not larger than the window, or a pyramid made for another image.

    Gradient: the search has none. When an image or ``uv_0`` requires it, valid points take one more, differentiable
    step (:func:`refine`); all other fields are detached.

    Cost: three times that of the way forward alone is never reached; see ``benchmarks/``.

    Source: Lucas and Kanade 1981; Baker and Matthews 2004 (inverse composition); Bouguet 2000 (pyramid);
    checked against ``cv2.calcOpticalFlowPyrLK``.
    """
    check("lucas_kanade", image_0=(image_0, "B C H W"), uv_0=(uv_0, "B N 2"), uv_1_init=(uv_1_init, "B N 2"))
    check("lucas_kanade", image_1=(image_1, "B C H W"), uv_0=(uv_0, "B N 2"))
    if normalise not in ("none", "bias", "gain_bias") or iterations < 1:
        raise ValueError(f"lucas_kanade: expected normalise none, bias or gain_bias and iterations >= 1, "
                         f"found {normalise!r} and {iterations}")  # fmt: skip
    options = _Options(window, iterations, epsilon_px, min_eigenvalue, normalise)
    with torch.no_grad():
        source = build_pyramid(image_0, levels, window) if pyramid_0 is None else pyramid_0
        target = build_pyramid(image_1, levels, window)
        _check_pyramid(source, image_0, window)
        tracks = _track(source, target, uv_0, uv_1_init, max_round_trip_px, options)
    if torch.is_grad_enabled() and (image_0.requires_grad or image_1.requires_grad or uv_0.requires_grad):
        refined = refine(image_0, image_1, uv_0, tracks.uv_1, window=window, normalise=normalise)
        tracks = tracks.replace(uv_0=uv_0, uv_1=torch.where(tracks.valid[..., None], refined, tracks.uv_1))
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
    """One differentiable Gauss-Newton step from ``uv_1``: the position (B, N, 2) in image 1 as a function of both images.

    At the optimum the step is zero, but its derivative is that of the optimum with respect to whatever moves it (by
    the implicit function theorem, with the Gauss-Newton Hessian). Both windows are read between pixels. Points
    without texture, or not finite, stay where they are.

    Raises:
        ValueError: wrong shapes, or an image too small for the window.

    Gradient: to both images and ``uv_0``; ``uv_1`` is detached.
    """
    sizes = check("refine", image_0=(image_0, "B C H W"), uv_0=(uv_0, "B N 2"), uv_1=(uv_1, "B N 2"))
    check("refine", image_1=(image_1, "B C H W"), uv_0=(uv_0, "B N 2"))
    margin = window // 2 + 2
    if min(*image_0.shape[-2:], *image_1.shape[-2:]) <= max(margin, window):
        raise ValueError(f"refine: an image of {sizes['H']}x{sizes['W']} pixels is too small for window {window}")
    start = _finite(uv_1.detach())
    J = _between(*_window(image_1, start, window + 1, margin))
    G = _project(torch.stack(_template(image_0, uv_0, window)).flatten(-2), normalise)
    g, T = G[:2], G[2]  # (2, B, N, w²), (B, N, w²)
    J = J.flatten(-2)
    A = torch.stack([(g[0] * g[0]).sum(-1), (g[0] * g[1]).sum(-1), (g[1] * g[1]).sum(-1)])
    A_inv, textured = _inverse(A, min_eigenvalue * window**2)
    residual = (g * J).sum(-1) - (g * T).sum(-1)
    step = (A_inv * residual).sum(1)
    if normalise == "gain_bias":
        step = step / _gain((T * J).sum(-1), (T * T).sum(-1))
    usable = textured & uv_0.isfinite().all(-1) & uv_1.isfinite().all(-1)
    return torch.where(usable[..., None], start - step.movedim(0, -1), start)


def _track(source: Pyramid, target: Pyramid, uv_0: Tensor, init: Tensor | None, max_round_trip_px: float, o: _Options):
    B, N, _ = uv_0.shape
    dtype = source.levels[0].dtype
    pad = -(B * N) % CHUNK if B * N else CHUNK

    def flat(uv: Tensor) -> Tensor:  # (B, N, 2) -> (2, M)
        return F.pad(uv.to(dtype).permute(2, 0, 1).reshape(2, -1), (0, pad), value=-1.0)

    x = flat(uv_0.detach())
    alive = _within(x, _bounds(source, 0, x))
    given = _finite(x)
    x = torch.where(alive, given, torch.zeros_like(x))
    d = torch.zeros_like(x)
    if init is not None:
        start = flat(init.detach())
        d = torch.where(start.isfinite().all(0), _finite(start) - given, d)
    batch = torch.arange(B, device=x.device)[:, None].expand(B, N).reshape(-1)
    batch = F.pad(batch, (0, pad))
    forward, found, A = _search(source, target, x, d, batch, alive, o)
    x_1 = x + forward
    back, returned, _ = _search(target, source, x_1, -d, batch, found, o)
    error = (forward + back).square().sum(0).sqrt()
    pair = _Pair(source.levels[0], target.levels[0], source.pad, _bounds(target, 0, x), True)
    variance = _residual(pair, x, forward, batch, o)
    valid = found & returned & (error < max_round_trip_px)
    uv_1 = torch.where(alive, x_1, given + d)

    def full(y: Tensor) -> Tensor:  # (..., M) -> (B, N, ...)
        return y[..., : B * N].movedim(-1, 0).reshape(B, N, *y.shape[:-1])

    n = o.window**2
    return Tracks(
        uv_0=uv_0,
        uv_1=full(uv_1),
        error=full(error),
        photometric=full((variance / n).sqrt()),
        cov=full(_covariance(A, variance / (n - 2))),
        valid=full(valid),
    )


def _search(source: Pyramid, target: Pyramid, x: Tensor, d: Tensor, batch: Tensor, alive: Tensor, o: _Options):
    """Coarse to fine: displacement (2, M), whether it was found (M,), and A (3, M) of the finest level."""
    n = min(len(source.levels), len(target.levels))
    d = d / 2 ** (n - 1)
    for level in range(n - 1, -1, -1):
        # Between pixels only where it decides the answer: the coarse levels take the window at the nearest pixel.
        anchor = _pixel(x * 0.5**level, source.hw(level)) if level else x
        pair = _Pair(source.levels[level], target.levels[level], source.pad, _bounds(target, level, x), level == 0)
        d, A, textured = _descend(pair, anchor, d, batch, alive, RADIUS_TOP if level == n - 1 else RADIUS, o)
        d = d * 2 if level else d
    return d, alive & textured & _within(x + d, _bounds(target, 0, x)), A


def _descend(pair: _Pair, x: Tensor, d: Tensor, batch: Tensor, alive: Tensor, radius: int, o: _Options):
    """The Gauss-Newton steps of one level: all points on a first map, then those that outran it on new ones."""
    live = alive & _within(x + d, pair.bounds)
    rounds = _split(o.iterations, STEPS_PER_MAP)
    d, live, windows_ = _on_new_map(pair, x, d, batch, live, None, radius, rounds[0], o)
    for steps in rounds[1:]:
        columns = (x, d, batch, live, *windows_)
        d, live = _for_some(
            live,
            (d, live),
            columns,
            lambda x, d, batch, live, *known, n=steps: _on_new_map(
                pair, x, d, batch, live, _Windows(*known), radius, n, o
            )[:2],
        )
    _, textured = _inverse(windows_.A, o.min_eigenvalue * o.window**2)
    return d, windows_.A, textured


def _for_some(wanted: Tensor, values: tuple[Tensor, ...], columns: tuple[Tensor, ...], fn) -> tuple[Tensor, ...]:
    """``values`` (each (..., M)) with what ``fn(*columns)`` returns where ``wanted``.

    Where shapes may depend on values ``fn`` sees only the wanted points, filled up to whole chunks.
    """
    if _static(wanted):
        return tuple(torch.where(wanted, new, old) for new, old in zip(fn(*columns), values, strict=True))
    some = wanted.nonzero()[:, 0]
    if not len(some):
        return values
    some = torch.cat([some, some[:1].expand(-len(some) % CHUNK)])  # the copies of a point agree
    new = fn(*(y.index_select(-1, some) for y in columns))
    return tuple(old.index_copy(-1, some, n) for old, n in zip(values, new, strict=True))


def _on_new_map(pair, x, d, batch, live, known, radius, steps, o: _Options):
    """At most ``steps`` steps on one map around where the points are. ``live`` marks those that want (more) steps.

    A point stops for good when its step is short or when it leaves image 1, and on this map when it leaves the map.
    """
    middle = _pixel(x + d, _hw(pair.target, pair.pad))
    C, known = _correlations(pair, x, middle, batch, known, radius, o)
    A_inv, textured = _inverse(known.A, o.min_eigenvalue * o.window**2)
    origin = middle - radius - x  # of the map, as a displacement
    low, high = (b - x - origin for b in pair.bounds)
    n = C.shape[1]
    moving = live & textured
    p = d - origin
    fixed = (C, A_inv, known.at_rest, known.energy, low.clamp_min(0), high.clamp_max(n - 1))
    dense, rest = min(DENSE_STEPS, steps), max(steps - DENSE_STEPS, 0)
    p_, moving_ = _walk(p, moving, *fixed, steps=dense, o=o)
    if rest:
        p_, moving_ = _for_some(moving_, (p_, moving_), (p_, moving_, *fixed), lambda *y: _walk(*y, steps=rest, o=o))
    off_map = (p_ != p_.clamp(0, n - 1)).any(0)
    return p_ + origin, live & textured & (moving_ | off_map) & _within(p_, (low, high)), known


def _walk(p, moving, C, A_inv, at_rest, energy, low, high, *, steps: int, o: _Options) -> tuple[Tensor, Tensor]:
    """Gauss-Newton steps of map positions ``p`` (2, M) where ``moving`` (M,): short steps and the map's end stop it."""
    node = torch.arange(C.shape[1], dtype=p.dtype, device=p.device)[:, None]
    for _ in range(steps):
        hat = (p[:, None] - node).abs_().neg_().add_(1).clamp_min_(0)  # (2, n, M) bilinear weights
        c = ((C * hat[0]).sum(2) * hat[1]).sum(1)  # (K, M)
        step = (A_inv * (c[:2] - at_rest)).sum(1)
        if o.normalise == "gain_bias":
            step = step / _gain(c[2], energy)
        p = torch.where(moving, p - step, p)
        moving = moving & ((step * step).sum(0) > o.epsilon_px**2) & (p == p.clamp(low, high)).all(0)
    return p, moving


def _correlations(pair: _Pair, x: Tensor, middle: Tensor, batch: Tensor, known, radius: int, o: _Options):
    """Maps (K, n, n, M) of the windows at ``x`` (2, M) of the source around the pixels ``middle`` of the target."""
    w, side = o.window, o.window + 2 * radius + 1
    K = 3 if o.normalise == "gain_bias" else 2
    plane = pair.source.shape[-1] * pair.source.shape[-2]
    planes = torch.tensor([1, 2, 0], device=x.device)[:, None] * plane
    first_0, fraction = _first(pair.source, pair.pad, x, batch, w // 2)
    first_1, _ = _first(pair.target, pair.pad, middle, batch, w // 2 + radius)
    C, moments = [], []
    for i, j, f in zip((first_0 + planes).split(CHUNK, 1), first_1.split(CHUNK), fraction.split(CHUNK, 1), strict=True):
        G = _project(_lookup(pair.source, i, f if pair.sub_pixel else None, w), o.normalise)  # g_x, g_y, T
        if known is None:
            g, T = G[:2], G[2]
            squares = [(g * T).sum(-1), (g * G[0]).sum(-1), (G[1:K] * G[1:K]).sum(-1)]
            moments.append(torch.cat(squares))
        J = windows(pair.target, j.repeat(K), side).view(1, K * CHUNK, side, side)
        c = F.conv2d(J, G[:K].reshape(K * CHUNK, 1, w, w), groups=K * CHUNK)
        C.append(c.view(K, CHUNK, -1).transpose(1, 2))
    if known is None:
        m = torch.cat(moments, 1)
        known = _Windows(m[:2], m[2:5], m[-1])
    return torch.cat(C, -1).view(K, side - w + 1, side - w + 1, x.shape[1]), known


def _residual(pair: _Pair, x: Tensor, d: Tensor, batch: Tensor, o: _Options) -> Tensor:
    """Squared grey differences (M,) between the windows at ``x`` and at ``x + d``, summed."""
    first_0, fraction_0 = _first(pair.source, pair.pad, x, batch, o.window // 2)
    first_1, fraction_1 = _first(pair.target, pair.pad, x + d, batch, o.window // 2)
    columns = (first_0, first_1, fraction_0, fraction_1)
    sums = []
    for i, j, f, g in zip(*(y.split(CHUNK, -1) for y in columns), strict=True):
        T, J = _lookup(pair.source, i, f, o.window), _lookup(pair.target, j, g, o.window)
        sums.append((_compare(T, J, o.normalise) ** 2).sum(-1))
    return torch.cat(sums)


def _compare(T: Tensor, J: Tensor, normalise: str) -> Tensor:
    """J - T (*, n), in grey values of T, after normalisation."""
    if normalise != "none":
        T, J = T - T.mean(-1, keepdim=True), J - J.mean(-1, keepdim=True)
    if normalise == "gain_bias":
        J = J / _gain((T * J).sum(-1, keepdim=True), (T * T).sum(-1, keepdim=True))
    return J - T


def _lookup(level: Tensor, first: Tensor, fraction: Tensor | None, w: int) -> Tensor:
    """Windows (*, w²) of a pyramid level, ``fraction`` (2, M) to the right of and below the pixels ``first`` (*, M)."""
    if fraction is None:
        return windows(level, first, w).flatten(-2)
    s = w + 1
    pixels = windows(level, first, s).flatten(-2)
    # Shifting the flat window reads neighbours at full speed; what it carries over a row's end is in the last column.
    pixels = torch.lerp(pixels[..., :-1], pixels[..., 1:], fraction[0][:, None])
    pixels = torch.lerp(pixels[..., : w * s - 1], pixels[..., s : s + w * s - 1], fraction[1][:, None])
    return pixels.unfold(-1, w, s).flatten(-2)


def _template(image: Tensor, uv: Tensor, window: int) -> tuple[Tensor, Tensor, Tensor]:
    """Window and its gradients (B, N, w, w) around ``uv``, between pixels; the gradient is zero outside the image."""
    grey, fraction = _window(image, _finite(uv), window + 3, window // 2 + 2)
    smooth = (3 / 32) * (grey[..., :-2, :] + grey[..., 2:, :]) + (10 / 32) * grey[..., 1:-1, :]
    slope = grey[..., 2:, :] - grey[..., :-2, :]
    grad_x = smooth[..., 2:] - smooth[..., :-2]
    grad_y = (3 / 32) * (slope[..., :-2] + slope[..., 2:]) + (10 / 32) * slope[..., 1:-1]
    steps = torch.arange(window + 1, device=uv.device) - window // 2
    pixel = _finite(uv.detach()).floor()[..., None] + steps  # (B, N, 2, w + 1)
    H, W = image.shape[-2:]
    in_x, in_y = (pixel[..., 0, :] >= 0) & (pixel[..., 0, :] < W), (pixel[..., 1, :] >= 0) & (pixel[..., 1, :] < H)
    mask = (in_y[..., :, None] & in_x[..., None, :]).to(grey.dtype)
    T = grey[..., 1:-1, 1:-1]
    return _between(grad_x * mask, fraction), _between(grad_y * mask, fraction), _between(T, fraction)


def _window(image: Tensor, uv: Tensor, size: int, margin: int) -> tuple[Tensor, Tensor]:
    """Grey pixels (B, N, size, size) whose middle is ``floor(uv)``, mirrored outside the image, and uv's fraction."""
    H, W = image.shape[-2:]
    grey = F.pad(luma(image, dim=1), (margin,) * 4, mode="reflect")
    limit = torch.tensor([W - 1, H - 1], dtype=uv.dtype, device=uv.device)
    pixel = torch.minimum(uv.detach().floor().clamp_min(0), limit)
    corner = pixel.long() + (margin - (size - 1) // 2)
    return patches(grey, corner, size)[:, :, 0], (uv - pixel).to(grey.dtype)


def _between(pixels: Tensor, fraction: Tensor) -> Tensor:
    """Bilinear values (B, N, s - 1, s - 1) at an offset ``fraction`` (B, N, 2) from ``pixels`` (B, N, s, s)."""
    fx, fy = fraction[..., 0, None, None], fraction[..., 1, None, None]
    rows = pixels[..., :-1] + fx * (pixels[..., 1:] - pixels[..., :-1])
    return rows[..., :-1, :] + fy * (rows[..., 1:, :] - rows[..., :-1, :])


def _project(G: Tensor, normalise: str) -> Tensor:
    """Windows (3, ..., n) of g_x, g_y and T with what the normalisation makes free (bias, gain) taken out of them."""
    if normalise == "none":
        return G
    G = G - G.mean(-1, keepdim=True)
    if normalise == "bias":
        return G
    g, T = G[:2], G[2:]
    energy = (T * T).sum(-1, keepdim=True)
    known = energy > 0
    share = (g * T).sum(-1, keepdim=True) / torch.where(known, energy, torch.ones_like(energy))
    return torch.cat([g - share * T, T])


def _gain(correlation: Tensor, energy: Tensor) -> Tensor:
    """Contrast of J in units of T's, kept within a factor of five."""
    known = energy > 0
    gain = correlation / torch.where(known, energy, torch.ones_like(energy))
    return torch.where(known, gain, torch.ones_like(gain)).clamp(0.2, 5.0)


def _inverse(A: Tensor, min_eigenvalue: float) -> tuple[Tensor, Tensor]:
    """(2, 2, *) inverse of A (3, *), zero where its small eigenvalue is not above the limit; and where it is."""
    a, b, c = A.double()
    small = _small_eigenvalue(a, b, c)
    textured = small > min_eigenvalue
    det = torch.where(textured, a * c - b * b, torch.ones_like(a))
    inverse = torch.stack([torch.stack([c, -b]), torch.stack([-b, a])]) / det
    return torch.where(textured, inverse, torch.zeros_like(inverse)).to(A.dtype), textured


def _covariance(A: Tensor, variance: Tensor) -> Tensor:
    """(2, 2, M)."""
    a, b, c = A.double()
    small = _small_eigenvalue(a, b, c)
    large = a + c - small
    lift = ((1e-5 * large).clamp_min(1e-9) - small).clamp_min(0)
    a, c = a + lift, c + lift
    scale = variance.double().clamp_min(QUANTISATION) / (a * c - b * b)
    return (torch.stack([torch.stack([c, -b]), torch.stack([-b, a])]) * scale).to(A.dtype)


def _small_eigenvalue(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    return ((a + c) - ((a - c).square() + 4 * b.square()).sqrt()) / 2


def _split(total: int, parts: tuple[int, ...]) -> list[int]:
    """``total`` in at most len(parts) + 1 parts, the first ones not larger than ``parts``."""
    sizes = []
    for part in (*parts, total):
        sizes.append(min(part, total - sum(sizes)))
    return [size for size in sizes if size]


def _first(level: Tensor, pad: int, x: Tensor, batch: Tensor, half: int) -> tuple[Tensor, Tensor]:
    """Flat index (M,) in a pyramid level of the grey pixel ``half`` above and left of floor(x), and x's fraction."""
    rows, width = level.shape[-2:]
    limit = torch.tensor([[width], [rows]], dtype=x.dtype, device=x.device) - (2 * pad + 1)
    whole = torch.minimum(x.floor().clamp_min(0), limit)
    u, v = whole.long() + (pad - half)
    return (batch * (3 * rows) + v) * width + u, (x - whole).clamp(-0.5, 1)


def _pixel(x: Tensor, hw: tuple[int, int]) -> Tensor:
    """Nearest pixel (2, M) of an image."""
    limit = torch.tensor([[hw[1] - 1], [hw[0] - 1]], dtype=x.dtype, device=x.device)
    return torch.minimum(round_half_up(x).clamp_min(0), limit)


def _hw(level: Tensor, pad: int) -> tuple[int, int]:
    return level.shape[-2] - 2 * pad, level.shape[-1] - 2 * pad


def _bounds(pyramid: Pyramid, level: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest and largest position (2, 1) that lies on a pixel of the full resolution, in pixels of a level."""
    H, W = pyramid.hw()
    high = torch.tensor([[W - 0.5], [H - 0.5]], dtype=like.dtype, device=like.device)
    return torch.full_like(high, -0.5) * 0.5**level, high * 0.5**level


def _within(x: Tensor, bounds: tuple[Tensor, Tensor]) -> Tensor:
    """Whether points (2, M) lie between bounds; not for NaN."""
    return ((x >= bounds[0]) & (x <= bounds[1])).all(0)


def _finite(x: Tensor) -> Tensor:
    return torch.where(x.isfinite(), x, torch.zeros_like(x))


def _static(x: Tensor) -> bool:
    """Whether shapes must not depend on values."""
    return torch.compiler.is_compiling() or torch._C._functorch.is_functorch_wrapped_tensor(x)


def _check_pyramid(pyramid: Pyramid, image: Tensor, window: int) -> None:
    if pyramid.hw() != tuple(image.shape[-2:]) or len(pyramid.levels[0]) != len(image):
        raise ValueError(f"lucas_kanade: pyramid_0 is of {len(pyramid.levels[0])} images of {pyramid.hw()} pixels, "
                         f"image_0 has shape {tuple(image.shape)}")  # fmt: skip
    if pyramid.pad != window // 2 + REACH:
        raise ValueError("lucas_kanade: pyramid_0 was built for another window")
