"""Lucas-Kanade, affine registration and the reading of patches as one would explain them: one point at a time.

No method calls this module. It says in one reading what :mod:`~dhtorch.geometry.lucas_kanade`,
:mod:`~dhtorch.geometry.affine_alignment` and :mod:`~dhtorch.geometry.patches` compute, and tests hold these against it: every
window is read from its pixels in every step, every system of equations is solved by itself, in float64. Constants
and options are written again and not imported, so that they are checked as well. No maps, chunks, lanes or graph.

Alphabet: ``x`` (2,) a point of image 0, ``d`` (2,) its displacement, px; T the window at x, g = (dT/dx, dT/dy) (2, w²),
J (w²,) what image 1 shows; ``p`` (2, w²) a pixel's offset in the window.

Lucas-Kanade, each level from coarse to fine:

    (1)  E(d) = Σ_p (J(x + d + p) − T(p))²                what is to become small
    (2)  A = Σ g gᵀ,   A step = Σ g (J − T)               one Gauss-Newton step
    (3)  d ← d − step
    (4)  step + ratio step + ratio² step + … = step / (1 − ratio)      a leap (Aitken)
    (5)  cov = s² A⁻¹,   s² = E / (w² − 2)

Affine registration, by inverse composition (Baker and Matthews 2004):

    (6)  J ≈ gain (T + ∇T · (δ + D p)) + bias             linear regression on eight pictures
    (7)  M ← M (1 + D)⁻¹,   m ← m − M δ                   the window is read at m + M p
    (8)  step − share (taken + bend)                      Anderson 1965, with a memory of one step
    (9)  cov = M S'⁻¹ S S'⁻¹ Mᵀ s² (1 + gain²) / gain²    S' is S without the noise in T's gradient

How closely fast and slow agree (measured, and held by ``tests/geometry/test_reference_implementations.py``): tracks and registrations to
5e-14 px in float64 and 1.1e-5 px in float32, patches bit for bit, grey values to the last bit of a float32. A track
that left one of its maps on the way is held at the map's border by the fast search and not by this one;
:attr:`Track.stayed` says whether it did.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

#: Planes of a level.
GREY, SLOPE_X, SLOPE_Y = 0, 1, 2

#: Ratios of contrast that are believed, and of size.
GAIN, SCALE = (0.2, 5.0), (0.4, 2.5)

#: Variance of grey values rounded to 8 bits.
ROUNDING = 1 / 12 / 255**2


# ------------------------------------------------------------------------------------------------ reading


def patch(
    image: Tensor,  # (C, H, W)
    pixel: Sequence[int],  # (u, v)
    size: int,
) -> Tensor:
    """The patch (C, size, size) around a pixel, ``size // 2`` pixels before it; moved inside where it would leave."""
    left = min(max(int(pixel[0]) - size // 2, 0), image.shape[2] - size)
    top = min(max(int(pixel[1]) - size // 2, 0), image.shape[1] - size)
    return image[:, top : top + size, left : left + size]


def nearest(
    grid: Tensor,  # (H, W)
    uv: Sequence[float],
) -> tuple[Tensor, bool]:
    """The value at the pixel that a place lies in (a half belongs to the next one), and whether it exists.

    Outside the grid the value of the nearest border pixel.
    """
    H, W = grid.shape
    u, v = (math.floor(float(y) + 0.5) for y in uv)
    return grid[min(max(v, 0), H - 1), min(max(u, 0), W - 1)], 0 <= u < W and 0 <= v < H


def luma(rgb: Tensor) -> Tensor:
    """Grey values (1, …) float in [0, 1] of channels (1 or 3, …), float in [0, 1] or bytes; BT.601."""
    rgb = rgb.float() / 255 if rgb.dtype == torch.uint8 else rgb
    return rgb if len(rgb) == 1 else 0.299 * rgb[:1] + 0.587 * rgb[1:2] + 0.114 * rgb[2:]


class Level(NamedTuple):
    """One level of a picture: grey mirrored beyond the border, slopes zero there."""

    planes: Tensor  # (3, H + 2 pad, W + 2 pad) grey, its slopes along x and y
    pad: int

    @property
    def hw(self) -> tuple[int, int]:
        """Without the padding."""
        return self.planes.shape[1] - 2 * self.pad, self.planes.shape[2] - 2 * self.pad

    def read(self, plane: int, at: Tensor) -> Tensor:
        """Values (P,) at places (2, P) px, bilinear; beyond the padding its last value."""
        x = self.planes[plane]
        u = (at[0] + self.pad).clamp(0, x.shape[1] - 1)
        v = (at[1] + self.pad).clamp(0, x.shape[0] - 1)
        j, i = u.floor().long(), v.floor().long()
        j2, i2 = (j + 1).clamp(max=x.shape[1] - 1), (i + 1).clamp(max=x.shape[0] - 1)
        b, a = u - j, v - i
        above = (1 - b) * x[i, j] + b * x[i, j2]
        below = (1 - b) * x[i2, j] + b * x[i2, j2]
        return (1 - a) * above + a * below

    def window(self, plane: int, x: Tensor, size: int) -> Tensor:
        """Values (size²,) around a place (2,)."""
        return self.read(plane, x[:, None] + offsets(size))


def offsets(size: int) -> Tensor:
    """Offsets (2, size²) float64 of a window's pixels from its middle, row by row."""
    s = torch.arange(size, dtype=torch.float64) - size // 2
    return torch.stack((s.repeat(size), s.repeat_interleave(size)))


def levels(image: Tensor, n: int, window: int) -> list[Level]:
    """``n`` levels of one picture (C, H, W), finest first, padded by half a window and 8 px, in float64.

    Half the size: smoothed by (1 4 6 4 1) / 16 along x and y, every other pixel. Slopes: Scharr's filter.
    """
    grey = luma(image).double()[None]
    levels = list[Level]()
    binomial = torch.tensor([1.0, 4, 6, 4, 1], dtype=torch.float64) / 16
    side, ahead = torch.tensor([3.0, 10, 3]).double() / 16, torch.tensor([-1.0, 0, 1]).double() / 2
    across, down = side[:, None] * ahead, ahead[:, None] * side
    pad = window // 2 + 8
    for _ in range(n):
        slopes = F.conv2d(F.pad(grey, (1, 1, 1, 1), "reflect"), torch.stack((across, down))[:, None])
        mirrored = F.pad(grey, (pad,) * 4, "reflect")
        levels.append(Level(torch.cat((mirrored, F.pad(slopes, (pad,) * 4)), 1)[0], pad))
        smooth = F.conv2d(F.pad(grey, (2, 2, 2, 2), "reflect"), (binomial[:, None] * binomial)[None, None])
        grey = smooth[..., ::2, ::2]
    return levels


# ------------------------------------------------------------------------------------------------ Lucas-Kanade


class Options(NamedTuple):
    """How to search; see :func:`dhtorch.stages.track.lucas_kanade`."""

    window: int = 21
    iterations: int = 30
    epsilon_px: float = 0.01
    min_eigenvalue: float = 1e-4 * 2**10 / 255**2
    normalise: str = "none"


class Track(NamedTuple):
    """A point found again."""

    uv_1: Tensor  # (2,) px
    error: float  # px, round trip
    photometric: float  # rms grey difference
    cov: Tensor  # (2, 2) px²
    valid: bool
    stayed: bool  # no step led further than the fast search looks from where a spell of steps began


def lucas_kanade(
    levels_0: Sequence[Level],
    levels_1: Sequence[Level],
    x: Tensor,  # (2,) px
    o: Options,
    *,
    start: Tensor | None = None,  # (2,) px, where to begin in image 1
    max_round_trip_px: float = 1.0,
) -> Track:
    """Track a point to image 1 and back. The way back begins as if nothing were known of the way there."""
    d = torch.zeros_like(x) if start is None else start - x
    alike = start is None
    there = search(levels_0, levels_1, x, d, o, alike=alike)
    forward, stayed = there.d, there.stayed
    backward, returned = torch.zeros_like(d), False
    if there.valid:
        back = search(levels_1, levels_0, x + forward, -d, o, alike=alike)
        backward, returned, stayed = back.d, back.valid, stayed and back.stayed
    error = float((forward + backward).norm())
    squares = difference(levels_0[0], levels_1[0], x, x + forward, o)
    variance = max(squares / (o.window**2 - 2), ROUNDING)
    cov = variance * torch.linalg.inv(there.A)  # (5)
    valid = there.valid and returned and error < max_round_trip_px
    return Track(x + forward, error, math.sqrt(squares / o.window**2), cov, valid, stayed)


class Displacement(NamedTuple):
    """Where a search ended."""

    d: Tensor  # (2,) px of the level
    valid: bool  # textured, at rest near where the last spell of steps began; on the finest level inside image 1, too
    A: Tensor  # (2, 2)
    stayed: bool  # see Track


def search(
    levels_0: Sequence[Level],
    levels_1: Sequence[Level],
    x: Tensor,  # (2,) px
    d: Tensor,  # (2,) px
    o: Options,
    *,
    alike: bool,
) -> Displacement:
    """Coarse to fine. Coarse levels only say where the next one starts, so they look at whole pixels and are content
    with four times the ``epsilon_px``.

    ``alike``: all points start alike; then those of a cell of 4 × 4 pixels, of level 2 and above, share one search.
    """
    H, W = levels_0[0].hw
    top = len(levels_0) - 1
    rough = o._replace(epsilon_px=4 * o.epsilon_px)
    place, searched = x, list[Displacement]()
    starts = {0: x}
    for level in range(1, top + 1):
        if alike and level >= 2:
            size = 4 * 2**level
            last = torch.tensor([-(-W // size), -(-H // size)]).double() - 1
            cell = torch.minimum(((place + 0.5) / size).floor(), last)
            place = torch.minimum((cell + 0.5) * size, torch.tensor([W - 1.0, H - 1.0]).double())
        starts[level] = place
    d = d / 2**top
    for level in range(top, 0, -1):
        pixel = (starts[level] / 2**level + 0.5).floor()
        reach = (2, 2, 2, 2) if level == top else (1, 2, 2)
        searched.append(descend(levels_0[level], levels_1[level], pixel, d, rough, reach))
        d = 2 * searched[-1].d
    reach = (1, 2, 2, 2) if top else (2, 2, 2, 2)
    last_one = descend(levels_0[0], levels_1[0], x, d, o, reach, finest=True)
    inside = within(x + last_one.d, levels_1[0].hw)
    stayed = last_one.stayed and all(f.stayed for f in searched)
    return last_one._replace(valid=last_one.valid and inside, stayed=stayed)


def descend(
    level_0: Level,
    level_1: Level,
    x: Tensor,  # (2,) px of the level
    d: Tensor,  # (2,) px of the level
    o: Options,
    reach: Sequence[int],
    *,
    finest: bool = False,
) -> Displacement:
    """One level: up to ``iterations`` steps (3), eight in a spell, until the last of a spell is short enough.

    A spell searches ``reach`` px around the pixel it begins in; a point that is beyond at the end of its last spell
    runs away, and is not found.
    """
    g, T = template(level_0, x, o)
    A = g @ g.T
    if torch.linalg.eigvalsh(A)[0] <= o.min_eigenvalue * o.window**2:
        return Displacement(d, valid=False, A=A, stayed=True)
    on_map = stayed = True
    for spell, r in enumerate(reach):
        steps = min(8, o.iterations - 8 * spell)
        if steps <= 0:
            break
        corner = (x + d).floor() - r
        step = torch.zeros_like(d)
        for k in range(1, steps + 1):
            last, step = step, one_step(level_1, x + d, g, T, o)
            if finest and k == 6 and k < steps:
                step = leap(last, step, o.epsilon_px)
            d = d - step  # (3)
            p = x + d - corner
            on_map = bool(((p >= 0) & (p <= 2 * r + 1)).all())
            stayed = stayed and on_map
        if step @ step <= o.epsilon_px**2:
            break
    return Displacement(d, on_map, A, stayed)


def template(level: Level, x: Tensor, o: Options) -> tuple[Tensor, Tensor]:
    """g (2, w²) and T (w²,) of a window, without what the normalisation leaves free: a mean, and multiples of T."""
    T = level.window(GREY, x, o.window)
    g = torch.stack([level.window(k, x, o.window) for k in (SLOPE_X, SLOPE_Y)])
    if o.normalise == "none":
        return g, T
    g = g - g.mean(-1, keepdim=True)
    T = T - T.mean()
    if o.normalise == "gain_bias":
        g = g - (g @ T)[:, None] / (T @ T) * T
    return g, T


def one_step(level: Level, x_1: Tensor, g: Tensor, T: Tensor, o: Options) -> Tensor:
    """(2), to be subtracted from ``x_1`` (2,). Image 1 of more contrast has steeper slopes than T: shorter steps."""
    J = level.window(GREY, x_1, o.window)
    step = torch.linalg.solve(g @ g.T, g @ (J - T))
    return step / (T @ J / (T @ T)).clamp(*GAIN) if o.normalise == "gain_bias" else step


def leap(last: Tensor, step: Tensor, epsilon_px: float) -> Tensor:
    """(4), of a step that is not short yet; ratios beyond 0.9 are not believed."""
    if step @ step <= epsilon_px**2:
        return step
    ratio = step @ last / (last @ last).clamp_min(epsilon_px**2)
    return step / (1 - ratio.clamp(-0.9, 0.9))


def difference(level_0: Level, level_1: Level, x: Tensor, x_1: Tensor, o: Options) -> float:
    """(1) after normalisation, in grey values of image 0."""
    T, J = level_0.window(GREY, x, o.window), level_1.window(GREY, x_1, o.window)
    if o.normalise != "none":
        T, J = T - T.mean(), J - J.mean()
    if o.normalise == "gain_bias":
        J = J / (T @ J / (T @ T)).clamp(*GAIN)
    return float((J - T).square().sum())


def within(x: Tensor, hw: tuple[int, int]) -> bool:
    """Whether a place (2,) lies in a picture: half a pixel around the outermost pixels' middles belongs to them."""
    u, v = x.tolist()
    return -0.5 <= u <= hw[1] - 0.5 and -0.5 <= v <= hw[0] - 0.5


# ------------------------------------------------------------------------------------------------ affine registration


class Registered(NamedTuple):
    """As :class:`dhtorch.geometry.affine_alignment.AffineRegistration`, of one point."""

    uv_1: Tensor  # (2,) px
    linear: Tensor  # (2, 2)
    rms: float
    cov: Tensor  # (2, 2) px²
    shift_px: float
    ok: bool


class Fit(NamedTuple):
    """How well windows agree."""

    gain: float
    variance: float  # mean square that gain and bias leave
    share: float  # of white noise that reading between pixels leaves

    @property
    def noise(self) -> float:
        """Variance of white noise, the same in both images, that would leave such a residual."""
        return self.variance / (self.share + believed(self.gain) ** 2)


def believed(gain: float) -> float:
    """A ratio of contrast within its limits."""
    return min(max(gain, GAIN[0]), GAIN[1])


class Regression:
    """(6) around the whole pixel nearest to a place of image 0: eight pictures, their normal equations, their noise."""

    def __init__(self, level: Level, x: Tensor, window: int) -> None:
        self.w, self.h, self.q = window, window // 2, (x + 0.5).floor()
        self.p = offsets(window)
        self.u, self.v = self.p / self.h
        gx, gy, T = (level.window(k, self.q, window) for k in (SLOPE_X, SLOPE_Y, GREY))
        self.T = T - T.mean()
        pictures = (gx, gy, self.u * gx, self.u * gy, self.v * gx, self.v * gy, self.T, torch.ones_like(T))
        self.Q = torch.stack(pictures)
        # What 2 / 255 of noise would say of a corner that moves by 2 px: matters where a window has a single edge.
        damping = torch.tensor([0.0, 0, 1, 1, 1, 1, 0, 0]).double() * (2 / 255 / 2) ** 2
        self.S = self.Q @ self.Q.T + torch.diag(damping)
        self.place = torch.cat((torch.ones(1).double(), (x - self.q) / self.h))  # (1, u, v) of the point itself
        self.textured = bool(torch.linalg.cond(self.S) < 1e12)

    def read(self, level: Level, centre: Tensor, m: Tensor, M: Tensor) -> Tensor:
        """J at m + M p; further than half a window and 8 px from ``centre`` what is there."""
        off = (m - centre)[:, None] + M @ self.p
        return level.read(GREY, centre[:, None] + off.clamp(-self.h - 8, self.h + 8))

    def solve(self, J: Tensor) -> Tensor:
        """The motion (3, 2) px of T's pixels that explains J: δ, and what D p adds to it at u = 1 and at v = 1."""
        s = torch.linalg.solve(self.S, self.Q @ J)
        return s[:6].view(3, 2) / believed(float(s[6]))

    def fit(self, at: Tensor, J: Tensor) -> Fit:
        """Of J, read at places (2, P). Between two pixels, a and 1 - a away, a² + (1 - a)² of the noise is left."""
        gain = float(self.T @ J / (self.T @ self.T))
        rest = J - gain * self.T
        a = at - at.floor()
        return Fit(gain, float(rest.var(correction=0)), float((a**2 + (1 - a) ** 2).prod(0).mean()))

    def covariance(self, M: Tensor, fit: Fit) -> Tensor:
        """(9): white noise of one variance in both images through the regression."""
        n, gain2 = self.w**2, believed(fit.gain) ** 2
        variance = max(fit.noise, ROUNDING) * n / (n - 8)
        P = torch.kron(self.place[None], torch.eye(2).double())  # (2, 6) what the six motions do to the place
        R = P @ torch.linalg.inv(self.S)[:6]
        C = R[:, :6] @ P.T
        slope = 2 * (3**2 + 10**2 + 3**2) / 32**2  # of Scharr's filter, in white noise
        of_u, of_v = slope * (self.u**2).sum(), slope * (self.v**2).sum()
        sizes = [slope * n, slope * n, of_u, of_u, of_v, of_v, n, 0]
        energy = torch.diag(torch.tensor([float(s) for s in sizes]).double()) * variance
        S = torch.linalg.inv(C)
        false = S @ R @ energy @ R.T @ S  # noise that passes for texture, at most nine tenths of it
        most = float(torch.linalg.eigvals(C @ false).real.max())
        true = torch.linalg.inv(S - false * (0.9 / max(most, 0.9)))
        return M @ (true @ S @ true) @ M.T * variance * (1 + gain2) / gain2


def nearest_inside(x: Tensor, hw: tuple[int, int]) -> Tensor:
    """The pixel of a picture nearest to a place (2,)."""
    return torch.minimum((x + 0.5).floor().clamp_min(0), torch.tensor([hw[1] - 1.0, hw[0] - 1.0]).double())


def composed(m: Tensor, M: Tensor, change: Tensor, half: int) -> tuple[Tensor, Tensor]:
    """(7)."""
    D = torch.stack((change[1], change[2]), 1) / half
    back = M @ torch.linalg.inv(torch.eye(2).double() + D)
    return m - back @ change[0], back


def register(
    levels_0: Sequence[Level],
    levels_1: Sequence[Level],
    x: Tensor,  # (2,) px
    x_1: Tensor,  # (2,) px, the start
    *,
    window: int = 21,
    iterations: int = 7,
    epsilon_px: float = 0.01,
    max_shift_px: float = 2.0,
) -> Registered:
    """Gauss-Newton steps from an unturned window; what ends too far, too large or worse than it began is not believed.

    A window that has grown by half is read from the half-size level, where its pixels meet pixels again.
    """
    eye = torch.eye(2).double()
    if not (within(x, levels_0[0].hw) and within(x_1, levels_1[0].hw)):
        return Registered(x_1, eye, rms=0.0, cov=eye, shift_px=0.0, ok=False)
    w = Regression(levels_0[0], x, window)
    m, M, fit, first = _steps(w, levels_1[0], 1.0, x_1 - (x - w.q), eye, iterations=iterations, epsilon_px=epsilon_px)
    if len(levels_1) > 1 and torch.linalg.det(M) > 1.5**2:
        m, M, fit, _ = _steps(w, levels_1[1], 0.5, m, M, iterations=iterations, epsilon_px=epsilon_px)
    end = m + M @ (x - w.q)
    size = float(torch.linalg.det(M))
    shift = float((end - x_1).norm())
    shift = shift if math.isfinite(shift) else max_shift_px
    sane = SCALE[0] ** 2 < size < SCALE[1] ** 2 and GAIN[0] < fit.gain < GAIN[1] and shift <= max_shift_px
    ok = w.textured and sane and fit.noise <= 1.2 * first.noise and within(m, levels_1[0].hw)
    if not ok:
        end, M, fit = x_1, eye, first
    rms = math.sqrt(fit.variance) / believed(fit.gain)
    return Registered(end, M, rms, w.covariance(M, fit), shift, ok)


def _steps(
    w: Regression, level: Level, zoom: float, m: Tensor, M: Tensor, *, iterations: int, epsilon_px: float
) -> tuple[Tensor, Tensor, Fit, Fit]:
    """Steps (7) of size (8) on one level: the warp, how well it fits, and how well the start did."""
    m, M = m * zoom, M * zoom
    centre = nearest_inside(m, level.hw)
    J = w.read(level, centre, m, M)
    first = w.fit(m[:, None], J)
    taken, before = torch.zeros(3, 2).double(), None
    for _ in range(iterations):
        step = change = w.solve(J)
        if before is not None:
            bend = change - before
            share = float((change * bend).sum() / bend.square().sum())
            step = change - min(max(share, -0.5), 0.5 / 1.5) * (taken + bend)  # (8)
        taken, before = step, change
        m, M = composed(m, M, step, w.h)
        J = w.read(level, centre, m, M)
        if change.abs().sum(0).max() <= epsilon_px * zoom:
            break
    return m / zoom, M / zoom, w.fit(m[:, None] + M @ w.p, J), first


def register_step(
    level_0: Level,
    level_1: Level,
    x: Tensor,  # (2,) px
    x_1: Tensor,  # (2,) px
    linear: Tensor,  # (2, 2)
    *,
    window: int = 21,
) -> Tensor:
    """Where one step (7) from a registration leads: (2,) px."""
    w = Regression(level_0, x, window)
    m = x_1 - linear @ (x - w.q)
    J = w.read(level_1, nearest_inside(m, level_1.hw), m, linear)
    m, M = composed(m, linear, w.solve(J), w.h)
    return m + M @ (x - w.q)
