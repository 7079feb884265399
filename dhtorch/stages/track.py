"""Stage 4: the samples found again in the other image, by pyramidal Lucas-Kanade, forward and back.

The search stands in :mod:`dhtorch.geometry.lucas_kanade`, whose alphabet is used here: the points of all pairs in one
row, ``x`` (2, M) in image 0 and ``d`` their displacement to image 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry import affine_alignment
from dhtorch.geometry import lucas_kanade as lk
from dhtorch.geometry.checks import any_possible, check
from dhtorch.geometry.coarse_flow import (
    CoarseFlow,
    apply_similarity,
    invert_similarity,
    is_not_identity,
    undo_similarity,
)
from dhtorch.geometry.determinism import round_up
from dhtorch.geometry.inference_mode import run_without_grad
from dhtorch.geometry.linalg import small_matmul
from dhtorch.geometry.pyramid import Pyramid, PyramidCache, build_pyramid
from dhtorch.records import NO_HINT, TrackHint, Tracks

#: A search from a coarse flow begins on the first level (the second at least) whose windows are so many times as wide
#: as the flow's cells are apart there: four small pixels, of which a cell is about five.
START_LEVEL_MARGIN = 0.8

#: Smallest eigenvalue of A per pixel of the window below which it is not tracked: 1e-4 of cv2, which sums gradients
#: of 8-bit images scaled by 2^-5.
MIN_TRACK_EIGENVALUE = 1e-4 * 2**10 / 255**2


def lucas_kanade(
    image_0: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    image_1: Tensor,  # (B, C, H', W')
    uv_0: Tensor,  # (B, N, 2) px
    *,
    hint: TrackHint = NO_HINT,
    window: int = 21,
    levels: int = 4,
    iterations: int = 30,
    epsilon_px: float = 0.01,
    max_round_trip_px: float = 1.0,
    normalise: str = "none",
    min_eigenvalue: float = MIN_TRACK_EIGENVALUE,
    start: Callable[..., CoarseFlow] | None = None,
) -> Tracks:
    """Track points from image 0 to image 1 and back; a track that does not return to its start is not valid.

    From coarse to fine, every window takes Gauss-Newton steps towards the smallest squared grey difference to its
    template. The way back starts from the point found as if nothing were known of the way there (with a start that was
    hinted: from the opposite displacement), so that it is a test. A window that still runs away at the end of the way
    there is lost and not tested.

    Args:
        image_0, image_1: (B, C, H, W) with C 1 or 3, float in [0, 1] or uint8; the two may differ in size.
        uv_0: (B, N, 2) px, x to the right and y down, 0 the middle of the first pixel.
        hint: where to start in image 1, pyramids of image 0 made once for many views, and ``levels`` for this scene.
        window: width in pixels, odd.
        levels: pyramid levels, full resolution included; fewer where a level would be no larger than the window.
        iterations: most Gauss-Newton steps per level. A point that is not at rest after eight goes on only as far as
            three maps reach (``dhtorch.geometry.lucas_kanade``).
        epsilon_px: a shorter step has converged; on coarse levels, which only provide a start, four times that.
        normalise: ``none``; ``bias`` removes the means of both windows; ``gain_bias`` also their ratio of contrast.
        min_eigenvalue: of A / window² (grey values in [0, 1]); a window with less has too little texture.
        start: ``(image_0, image_1, *, linear) -> Flow``, such as :func:`dhtorch.geometry.coarse_flow.coarse_flow`:
            asked for the coarse motion of the whole picture, there and back, where the hint has none. Turn, zoom and
            gain of a pair are undone in image 1 before it is searched. None = the search starts at ``uv_0``.

    Returns:
        Tracks in the dtype of ``uv_0``: ``uv_1`` (B, N, 2) px; ``error`` (B, N) px, the round trip (the way there where
        it led nowhere); ``cov`` (B, N, 2, 2) px²; ``valid`` (B, N). ``photometric`` (B, N) is the rms grey difference
        of the windows, in grey values of image 0, after normalisation; ``cov`` is s² A⁻¹ with s² the residual variance,
        not below that of 8-bit rounding, and the small eigenvalue of A kept from vanishing: always finite, large
        without texture. It understates white noise, which reading between pixels smooths out of the residual.
        ``valid``: inside image 1 on the finest level from start to end, not running away at either end, textured, round
        trip below its limit. Not valid: ``uv_1`` is the last position; for a ``uv_0`` outside the image the start of
        the search, with 0 for what is not finite.

    Raises:
        ValueError: wrong shapes or options, an image no larger than the window, pyramids of another image.

    Gradient: the search has none. When an image or ``uv_0`` requires it, valid points take one more, differentiable
    step (:func:`refine_tracks`); all other fields are detached.

    Source: Lucas and Kanade 1981; Bouguet 2000 (pyramid); Baker and Matthews 2004 (inverse composition); checked
    against ``cv2.calcOpticalFlowPyrLK`` (``tests/stages/test_track.py``).
    Twin: ``lucas_kanade`` of ``tests/support/reference.py``, one point at a time.

    Example:
        >>> import torch
        >>> from dhtorch.stages.track import lucas_kanade
        >>> v, u = torch.meshgrid(torch.arange(80.0), torch.arange(100.0), indexing="ij")
        >>> here, there = (0.5 + 0.2 * (0.4 * (u - dx)).sin() + 0.2 * (0.3 * (v + dx)).cos() for dx in (0.0, 1.5))
        >>> uv_0 = torch.tensor([[[40.0, 30.0], [60.5, 45.25], [99.0, 40.0]]])  # (B, N, 2)
        >>> tracks = lucas_kanade(here[None, None], there[None, None], uv_0)  # two (B, C, H, W)
        >>> tracks.uv_1.shape, tracks.cov.shape
        (torch.Size([1, 3, 2]), torch.Size([1, 3, 2, 2]))
        >>> (tracks.uv_1 - uv_0).round(decimals=1)[0, :2]
        tensor([[ 1.5000, -1.5000],
                [ 1.5000, -1.5000]])
        >>> tracks.valid  # the third has left the image
        tensor([[ True,  True, False]])
    """
    check("lucas_kanade", image_0=(image_0, "B C H W"), uv_0=(uv_0, "B N 2"), start=(hint.start, "B N 2"))
    check("lucas_kanade", image_1=(image_1, "B C H W"), uv_0=(uv_0, "B N 2"))
    _check_options(iterations, normalise)
    o = lk.SearchOptions(window, iterations, epsilon_px, min_eigenvalue, normalise)
    levels = levels if hint.levels is None else hint.levels
    with torch.no_grad():
        source = _source(hint, image_0, levels, window)
        flows = resolve_coarse_flow(image_0, image_1, hint, start)
        view = None if flows is None else _DerotatedImage(image_1, flows)
        target = build_pyramid(image_1 if view is None else view.image, levels, window)
        tracks = run_without_grad(
            _there_and_back,
            source,
            target,
            uv_0.detach(),
            o,
            init=hint.start if view is None else view.begin(uv_0.detach(), hint.start),
            homewards=None if view is None else view.back,
            near_levels=levels if flows is None else _levels_for_flow(flows[0], source.hw(), window),
            limit_px=max_round_trip_px,
        )
        tracks = tracks if view is None else view.to_image(tracks)
    if torch.is_grad_enabled() and (image_0.requires_grad or image_1.requires_grad or uv_0.requires_grad):
        uv_1 = refine_tracks(
            image_0, image_1, uv_0, tracks.uv_1, window=window, normalise=normalise, min_eigenvalue=min_eigenvalue
        )
        if view is not None:  # a step through image 1 as it is says nothing of a window that is changed there
            uv_1 = torch.where(view.changed[:, None, None], tracks.uv_1 + (uv_1 - uv_1.detach()), uv_1)
        return tracks.replace(uv_0=uv_0, uv_1=torch.where(tracks.valid[..., None], uv_1, tracks.uv_1))
    return tracks


def refine_tracks(
    image_0: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    image_1: Tensor,  # (B, C, H', W')
    uv_0: Tensor,  # (B, N, 2) px
    uv_1: Tensor,  # (B, N, 2) px
    *,
    window: int = 21,
    normalise: str = "none",
    min_eigenvalue: float = MIN_TRACK_EIGENVALUE,
) -> Tensor:
    """One differentiable Gauss-Newton step from ``uv_1``: the position (B, N, 2) as a function of the images.

    Where the search has converged the step is zero but its derivative is not: it is that of the converged position (by
    the implicit function theorem, with the Gauss-Newton Hessian). Points that are not finite, outside an image or
    without texture stay where they are, with 0 for what is not finite.

    Raises:
        ValueError: wrong shapes or options, or an image no larger than the window.

    Gradient: to both images and ``uv_0``; ``uv_1`` is detached.
    """
    check("refine_tracks", image_0=(image_0, "B C H W"), uv_0=(uv_0, "B N 2"), uv_1=(uv_1, "B N 2"))
    check("refine_tracks", image_1=(image_1, "B C H W"), uv_0=(uv_0, "B N 2"))
    _check_options(1, normalise)
    source = build_pyramid(image_0, 1, window)
    target = build_pyramid(image_1, 1, window, gradients=False)
    B, N, _ = uv_0.shape
    x, x_1 = (uv.to(source.levels[0].dtype).permute(2, 0, 1).reshape(2, B * N) for uv in (uv_0, uv_1.detach()))
    usable = lk.is_between(x, *source.bounds(0)) & lk.is_between(x_1, *target.bounds(0))
    start = _finite(x_1)
    x, x_1 = (torch.where(usable, y, torch.zeros_like(y)) for y in (x, x_1))
    batch = torch.arange(B, device=x.device).repeat_interleave(N)
    o = lk.SearchOptions(window, 1, 0.0, min_eigenvalue, normalise)
    step, textured = lk.lucas_kanade_step(source, target, o, x, x_1, batch)
    found = start - torch.where(usable & textured, step, torch.zeros_like(step))
    return found.reshape(2, B, N).permute(1, 2, 0).to(uv_0.dtype)


def resolve_coarse_flow(
    image_0: Tensor, image_1: Tensor, hint: TrackHint, start: Callable[..., CoarseFlow] | None
) -> tuple[CoarseFlow, CoarseFlow] | None:
    """The coarse motion of the pictures there and back: the hint's, else what ``start`` says, else none."""
    if hint.flows is not None or start is None:
        return hint.flows
    there = start(image_0, image_1)
    return there, start(image_1, image_0, linear=invert_similarity(there.linear))


class _DerotatedImage:
    """Image 1 with the turn, zoom and gain of its pair undone, and the ways between the two."""

    def __init__(self, image: Tensor, flows: tuple[CoarseFlow, CoarseFlow]) -> None:
        self.hw = image.shape[-2], image.shape[-1]
        self.flows, self.linear = flows, flows[0].linear
        self.turned = is_not_identity(self.linear)
        self.changed = self.turned | (flows[0].gain != 1)
        # Under a compiler, which sees no values, everything is undone, if it be nothing.
        undo = any_possible(self.changed)
        self.image = undo_similarity(image, self.linear, flows[0].gain) if undo else image

    def begin(self, uv_0: Tensor, known: Tensor | None) -> Tensor:
        """Where to look in the upright picture for pixels (B, N, 2) of image 0; ``known`` in image 1 goes before."""
        uv_1 = self.flows[0].at(uv_0) if known is None else known
        return apply_similarity(invert_similarity(self.linear), uv_1, self.hw)

    def back(self, uv: Tensor) -> Tensor:
        """Where to look in image 0 for pixels (B, N, 2) of the upright picture."""
        return self.flows[1].at(apply_similarity(self.linear, uv, self.hw))

    def to_image(self, tracks: Tracks) -> Tracks:
        """Tracks to the upright picture as tracks to image 1."""
        A = self.linear.to(tracks.cov)[:, None]
        uv_1 = apply_similarity(self.linear, tracks.uv_1, self.hw)
        inside = ((uv_1 >= -0.5) & (uv_1 <= uv_1.new_tensor([self.hw[1] - 0.5, self.hw[0] - 0.5]))).all(-1)
        cov = torch.where(self.turned[:, None, None, None], small_matmul(small_matmul(A, tracks.cov), A.mT), tracks.cov)
        return tracks.replace(uv_1=uv_1, cov=cov, valid=tracks.valid & (inside | ~self.turned[:, None]))


def _there_and_back(
    source: Pyramid,
    target: Pyramid,
    uv_0: Tensor,
    o: lk.SearchOptions,
    *,
    init: Tensor | None,
    homewards: Callable[[Tensor], Tensor] | None,
    near_levels: int,
    limit_px: float,
) -> Tracks:
    """Tracks of all points, laid out in one row (2, M), filled up to whole ``LANES`` by points outside the image."""
    B, N, _ = uv_0.shape
    fill = round_up(B * N) - B * N

    def row(uv: Tensor) -> Tensor:
        return F.pad(uv.to(source.levels[0].dtype).permute(2, 0, 1).reshape(2, B * N), (0, fill), value=-2.0)

    def grid(y: Tensor) -> Tensor:  # (..., M) -> (B, N, ...)
        y = y[..., : B * N].reshape(*y.shape[:-1], B, N).movedim((-2, -1), (0, 1))
        return y.to(uv_0.dtype) if y.is_floating_point() else y

    x = row(uv_0)
    d = torch.zeros_like(x) if init is None else row(init) - x
    given = d.isfinite().all(0)
    d = torch.where(given, d, torch.zeros_like(d))
    known = lk.is_between(x, *source.bounds(0))
    elsewhere = _finite(x) + d
    x = torch.where(known, x, torch.zeros_like(x))
    batch = F.pad(torch.arange(B, device=x.device).repeat_interleave(N), (0, fill))

    search = partial(lk.search_displacements, o=o, alike=init is None, near_levels=near_levels)

    def back(x: Tensor, d: Tensor, batch: Tensor, known: Tensor, begun: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return search(target, source, x=x, d=d, batch=batch, known=known, begun=begun)

    forward, found, A = search(source, target, x=x, d=d, batch=batch, known=known, begun=given)
    begin = -d
    if homewards is not None:
        begin = row(homewards(grid(x + forward))) - (x + forward)
        given = begin.isfinite().all(0)
        begin = torch.where(given, begin, torch.zeros_like(begin))
    nothing = torch.zeros_like(d), torch.zeros_like(found), torch.zeros_like(A)
    backward, returned, _ = lk.masked_apply(found, back, nothing, (x + forward, begin, batch, found, given))
    error = (forward + backward).square().sum(0).sqrt()
    squares = lk.squared_differences(source, target, o, x, forward, batch)
    return Tracks(
        uv_0=uv_0,
        uv_1=grid(torch.where(known, x + forward, elsewhere)),
        error=grid(error),
        photometric=grid((squares / o.window**2).sqrt()),
        cov=grid(lk.window_covariance(A, squares / (o.window**2 - 2))),
        valid=grid(found & returned & (error < limit_px)),
    )


def _levels_for_flow(flow: CoarseFlow, hw: tuple[int, int], window: int) -> int:
    """How many levels a search needs that starts where a coarse flow says: until a window reaches as far as that may
    be wrong."""
    cell_px = max(n / cells for n, cells in zip(hw, flow.support.shape[1:], strict=True))
    return max(2, 1 + math.ceil(math.log2(START_LEVEL_MARGIN * cell_px / window)))


def _finite(x: Tensor) -> Tensor:
    return torch.where(x.isfinite(), x, torch.zeros_like(x))


def _check_options(iterations: int, normalise: str) -> None:
    if normalise not in ("none", "bias", "gain_bias"):
        raise ValueError(f"lucas_kanade: normalise is {normalise!r}, expected none, bias or gain_bias")
    if iterations < 1:
        raise ValueError(f"lucas_kanade: iterations is {iterations}, expected at least 1")


def _source(hint: TrackHint, image: Tensor, levels: int, window: int) -> Pyramid:
    """The pyramid of image 0: the caller's, where it has one."""
    if hint.pyramid is None:
        return build_pyramid(image, levels, window)
    found, expected = (tuple(x.shape) for x in (hint.pyramid.image, image))
    if found != expected:
        raise ValueError(f"lucas_kanade: hint.pyramid is of an image of shape {found}, expected {expected}")
    return hint.pyramid(levels, window)


def lucas_kanade_affine(
    image_0: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    image_1: Tensor,  # (B, C, H', W')
    uv_0: Tensor,  # (B, N, 2) px
    *,
    hint: TrackHint = NO_HINT,
    track: Callable[..., Tracks] = lucas_kanade,
    window: int = 21,
    levels: int = 4,
    iterations: int = 7,
    epsilon_px: float = 0.01,
    max_shift_px: float = 2.0,
    start: Callable[..., CoarseFlow] | None = None,
) -> Tracks:
    """Track as ``track`` does, then register every window once more, free to shear and to change its brightness.

    Args:
        hint: as in :func:`lucas_kanade`; handed on to ``track``.
        track: the search that finds the windows, any tracker; it is told the ``levels`` and shares the pyramid.
        window: of the registration; the search has its own.
        levels: of the search, where it follows hints.
        iterations, epsilon_px, max_shift_px: of the registration, see
            :func:`dhtorch.geometry.affine_alignment.register_affine`.
        start: as in :func:`lucas_kanade`; ``track`` finds its answer in the hint, and the registration begins with its
            turn and zoom.

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
    check("lucas_kanade_affine", image_0=(image_0, "B C H W"), uv_0=(uv_0, "B N 2"), start=(hint.start, "B N 2"))
    check("lucas_kanade_affine", image_1=(image_1, "B C H W"), uv_0=(uv_0, "B N 2"))
    with torch.no_grad():
        known = PyramidCache(image_0) if hint.pyramid is None else hint.pyramid
        levels = levels if hint.levels is None else hint.levels
        source = _source(hint.replace(pyramid=known), image_0, levels, window)
        flows = resolve_coarse_flow(image_0, image_1, hint, start)
        tracks = track(image_0, image_1, uv_0, hint=TrackHint(hint.start, known, levels, flows))
        target = build_pyramid(image_1, 2, window, gradients=False)
        found = affine_alignment.register_affine(
            source,
            target,
            uv_0,
            tracks.uv_1,
            wanted=tracks.valid,
            linear=None if flows is None else flows[0].linear,
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
        again = affine_alignment.registration_step(source, target, uv_0, tracks.uv_1, found.linear, window=window)
        # The value is the search's, bit for bit; the step lends its derivative.
        return tracks.replace(uv_1=torch.where(tracks.valid[..., None], uv_1 + (again - again.detach()), uv_1))
    return tracks
