"""Stage 4: two images and sample pixels → tracks with covariance, by pyramidal Lucas-Kanade, forward and back.

The search is in :mod:`dhtorch.geometry.lucas_kanade`, whose alphabet is used here: the points of all pairs in one row,
``x`` (2, M) in image 0 and ``d`` their displacement to image 1.
"""

import math
from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry import affine_alignment
from dhtorch.geometry import lucas_kanade as lk
from dhtorch.geometry.checks import any_possible, constant, shaped
from dhtorch.geometry.coarse_flow import (
    CoarseFlow,
    apply_similarity,
    invert_similarity,
    is_not_identity,
    undo_similarity,
)
from dhtorch.geometry.determinism import round_up, run_without_grad
from dhtorch.geometry.linalg import small_matmul
from dhtorch.geometry.pyramid import Pyramid, PyramidCache, build_pyramid
from dhtorch.records import NO_HINT, TrackHint, Tracks

#: Least eigenvalue of A per pixel of a window that is tracked, squared grey values in [0, 1] per px²; cv2 sums
#: gradients of 8-bit images scaled by 2^-5.
#: Source: OpenCV calcOpticalFlowPyrLK default minEigThreshold 1e-4, derived, times 2^10 / 255².
MIN_TRACK_EIGENVALUE = 1e-4 * 2**10 / 255**2


@shaped("image_0: B C H W, uv_0: B N 2, hint.start: B N 2, image_1: B c h w")
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
    """Tracks of points uv_0 from image 0 to image 1 and back; a track that does not return to its start is not valid.

    From coarse to fine, every window takes Gauss-Newton steps towards the smallest squared grey difference to its
    template. The backward search starts from the forward result without using the forward displacement (with a hinted
    start: from the opposite displacement), so that it is an independent test. A window that still diverges at the end
    of the forward search is lost and not tested.

    Args:
        image_0, image_1: (B, C, H, W) with C 1 or 3, float in [0, 1] or uint8; the two may differ in size.
        uv_0: (B, N, 2) px, x to the right and y down, 0 the middle of the first pixel.
        hint: start in image 1, pyramid of image 0 shared by many views, and ``levels`` for this scene.
        window: width in pixels, odd.
        levels: pyramid levels, full resolution included; fewer where a level would be no larger than the window.
        iterations: most Gauss-Newton steps per level. A point that has not converged after eight continues only as far
            as three maps reach (``dhtorch.geometry.lucas_kanade``).
        epsilon_px: a shorter step has converged; on coarse levels, which only provide a start, four times that.
        normalise: ``none``; ``bias`` removes the means of both windows; ``gain_bias`` also their ratio of contrast.
        min_eigenvalue: of A / window² (grey values in [0, 1]); a window with less has too little texture.
        start: coarse motion of the whole image, forward and backward, where the hint has none; a function
            ``(image_0, image_1, *, linear) -> CoarseFlow`` such as
            :func:`dhtorch.geometry.coarse_flow.coarse_flow`. Rotation, zoom and gain of a pair are undone in image 1
            before the search. None = the search starts at ``uv_0``.

    Returns:
        Tracks in the dtype of ``uv_0``: ``uv_1`` (B, N, 2) px; ``error`` (B, N) px, the round trip (the forward
        displacement where the forward search is lost); ``cov`` (B, N, 2, 2) px²; ``valid`` (B, N). ``photometric`` (B,
        N) is the rms grey difference of the windows, in grey values of image 0, after normalisation; ``cov`` is s² A⁻¹
        with s² the residual variance, not below that of 8-bit rounding, and the small eigenvalue of A kept from
        vanishing: always finite, large without texture. It understates white noise, which interpolation smooths out of
        the residual. ``valid``: inside image 1 on the finest level from start to end, not diverging in either
        direction, textured, round trip below its limit. Not valid: ``uv_1`` is the last position; for a ``uv_0``
        outside the image the start of the search, with 0 for what is not finite.

    Raises:
        ValueError: wrong shapes or options, an image no larger than the window, pyramids of another image.

    Gradient: the search has none. When an image or ``uv_0`` requires it, valid points take one more, differentiable
    step (:func:`refine_tracks`); all other fields are detached.

    Source: Lucas and Kanade 1981; Bouguet 2000 (pyramid); Baker and Matthews 2004 (inverse composition); checked
    against ``cv2.calcOpticalFlowPyrLK`` (``tests/functional/test_points.py``).

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
        >>> tracks.valid  # the third is outside image 1
        tensor([[ True,  True, False]])
    """
    _check_options(iterations, normalise)
    o = lk.SearchOptions(window, iterations, epsilon_px, min_eigenvalue, normalise)
    levels = levels if hint.levels is None else hint.levels
    with torch.no_grad():
        source = _source_pyramid(hint, image_0, levels, window)
        flows = resolve_coarse_flow(image_0, image_1, hint, start)
        view = None if flows is None else _DerotatedImage(image_1, flows)
        target = build_pyramid(image_1 if view is None else view.image, levels, window)
        near_levels = levels
        if flows is not None:  # the first level (at least the second) whose windows are 4 / 5 as wide as a cell
            cell_px = max(n / cells for n, cells in zip(source.hw(), flows[0].support.shape[1:], strict=True))
            near_levels = max(2, 1 + math.ceil(math.log2(0.8 * cell_px / window)))
        tracks = run_without_grad(
            _track_both_ways,
            source,
            target,
            uv_0.detach(),
            o,
            init=hint.start if view is None else view.begin(uv_0.detach(), hint.start),
            back_start_of=None if view is None else view.back,
            near_levels=near_levels,
            limit_px=max_round_trip_px,
        )
        tracks = tracks if view is None else view.to_image(tracks)
    if torch.is_grad_enabled() and (image_0.requires_grad or image_1.requires_grad or uv_0.requires_grad):
        uv_1 = refine_tracks(
            image_0, image_1, uv_0, tracks.uv_1, window=window, normalise=normalise, min_eigenvalue=min_eigenvalue
        )
        if (
            view is not None
        ):  # a step on the unchanged image 1 has another value where image 1 was changed for the search
            uv_1 = torch.where(view.changed[:, None, None], tracks.uv_1 + (uv_1 - uv_1.detach()), uv_1)
        return tracks.replace(uv_0=uv_0, uv_1=torch.where(tracks.valid[..., None], uv_1, tracks.uv_1))
    return tracks


@shaped("image_0: B C H W, uv_0: B N 2, uv_1: B N 2, image_1: B c h w")
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
    """One differentiable Gauss-Newton step from ``uv_1``: positions (B, N, 2) as a function of the images.

    Where the search has converged the step is zero but its derivative is not: it is that of the converged position (by
    the implicit function theorem, with the Gauss-Newton Hessian). Points that are not finite, outside an image or
    without texture stay where they are, with 0 for what is not finite.

    Raises:
        ValueError: wrong shapes or options, or an image no larger than the window.

    Gradient: to both images and ``uv_0``; ``uv_1`` is detached.
    """
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
    refined = start - torch.where(usable & textured, step, torch.zeros_like(step))
    return refined.reshape(2, B, N).permute(1, 2, 0).to(uv_0.dtype)


def resolve_coarse_flow(
    image_0: Tensor, image_1: Tensor, hint: TrackHint, start: Callable[..., CoarseFlow] | None
) -> tuple[CoarseFlow, CoarseFlow] | None:
    """Coarse motion of the images, forward and backward: the hint's, else the result of ``start``, else None.

    A hint that says where the points begin needs no coarse motion.
    """
    if hint.flows is not None or hint.start is not None or start is None:
        return hint.flows
    forward = start(image_0, image_1)
    return forward, start(image_1, image_0, linear=invert_similarity(forward.linear))


class _DerotatedImage:
    """Image 1 with rotation, zoom and gain of its pair undone, and the maps between the two."""

    def __init__(self, image: Tensor, flows: tuple[CoarseFlow, CoarseFlow]) -> None:
        self.hw = image.shape[-2], image.shape[-1]
        self.flows, self.linear = flows, flows[0].linear
        self.rotated = is_not_identity(self.linear)
        self.changed = self.rotated | (flows[0].gain != 1)
        # Under torch.compile, without values, the transform is always undone, even where it is the identity.
        undo = any_possible(self.changed)
        self.image = undo_similarity(image, self.linear, flows[0].gain) if undo else image

    def begin(self, uv_0: Tensor, start: Tensor | None) -> Tensor:
        """Start in the derotated image of pixels (B, N, 2) of image 0; ``start`` in image 1 takes precedence."""
        uv_1 = self.flows[0].at(uv_0) if start is None else start
        return apply_similarity(invert_similarity(self.linear), uv_1, self.hw)

    def back(self, uv: Tensor) -> Tensor:
        """Start in image 0 of pixels (B, N, 2) of the derotated image."""
        return self.flows[1].at(apply_similarity(self.linear, uv, self.hw))

    def to_image(self, tracks: Tracks) -> Tracks:
        """Tracks into the derotated image as tracks into image 1."""
        A = self.linear.to(tracks.cov)[:, None]
        uv_1 = apply_similarity(self.linear, tracks.uv_1, self.hw)
        inside = ((uv_1 >= -0.5) & (uv_1 <= constant(uv_1, [self.hw[1] - 0.5, self.hw[0] - 0.5]))).all(-1)
        cov = torch.where(
            self.rotated[:, None, None, None], small_matmul(small_matmul(A, tracks.cov), A.mT), tracks.cov
        )
        return tracks.replace(uv_1=uv_1, cov=cov, valid=tracks.valid & (inside | ~self.rotated[:, None]))


def _track_both_ways(
    source: Pyramid,
    target: Pyramid,
    uv_0: Tensor,
    o: lk.SearchOptions,
    *,
    init: Tensor | None,
    back_start_of: Callable[[Tensor], Tensor] | None,
    near_levels: int,
    limit_px: float,
) -> Tracks:
    """Tracks of all points, forward and back, in one row (2, M) padded to whole ``LANES`` by points outside."""
    B, N, _ = uv_0.shape
    fill = round_up(B * N) - B * N

    def row(uv: Tensor) -> Tensor:
        return F.pad(uv.to(source.levels[0].dtype).permute(2, 0, 1).reshape(2, B * N), (0, fill), value=-2.0)

    def grid(y: Tensor) -> Tensor:  # (..., M) -> (B, N, ...)
        y = y[..., : B * N].reshape(*y.shape[:-1], B, N).movedim((-2, -1), (0, 1))
        return y.to(uv_0.dtype) if y.is_floating_point() else y

    x = row(uv_0)
    d = torch.zeros_like(x) if init is None else row(init) - x
    has_start = d.isfinite().all(0)
    d = torch.where(has_start, d, torch.zeros_like(d))
    inside = lk.is_between(x, *source.bounds(0))
    unsearched = _finite(x) + d
    x = torch.where(inside, x, torch.zeros_like(x))
    batch = F.pad(torch.arange(B, device=x.device).repeat_interleave(N), (0, fill))

    search = partial(lk.search_displacements, o=o, alike=init is None, near_levels=near_levels)

    def back(x: Tensor, d: Tensor, batch: Tensor, inside: Tensor, begun: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return search(target, source, x=x, d=d, batch=batch, known=inside, begun=begun)

    forward, forward_ok, A = search(source, target, x=x, d=d, batch=batch, known=inside, begun=has_start)
    back_start = -d
    if back_start_of is not None:
        back_start = row(back_start_of(grid(x + forward))) - (x + forward)
        has_start = back_start.isfinite().all(0)
        back_start = torch.where(has_start, back_start, torch.zeros_like(back_start))
    fill_values = torch.zeros_like(d), torch.zeros_like(forward_ok), torch.zeros_like(A)
    backward, backward_ok, _ = lk.masked_apply(
        forward_ok, back, fill_values, (x + forward, back_start, batch, forward_ok, has_start)
    )
    error = (forward + backward).square().sum(0).sqrt()
    squares = lk.squared_differences(source, target, o, x, forward, batch)
    return Tracks(
        uv_0=uv_0,
        uv_1=grid(torch.where(inside, x + forward, unsearched)),
        error=grid(error),
        photometric=grid((squares / o.window**2).sqrt()),
        cov=grid(lk.window_covariance(A, squares / (o.window**2 - 2))),
        valid=grid(forward_ok & backward_ok & (error < limit_px)),
    )


def _finite(x: Tensor) -> Tensor:
    return torch.where(x.isfinite(), x, torch.zeros_like(x))


def _check_options(iterations: int, normalise: str) -> None:
    if normalise not in ("none", "bias", "gain_bias"):
        raise ValueError(f"lucas_kanade: normalise is {normalise!r}, expected none, bias or gain_bias")
    if iterations < 1:
        raise ValueError(f"lucas_kanade: iterations is {iterations}, expected at least 1")


def _source_pyramid(hint: TrackHint, image: Tensor, levels: int, window: int) -> Pyramid:
    """The pyramid of image 0: the hint's, or a new one."""
    if hint.pyramid is None:
        return build_pyramid(image, levels, window)
    shape, image_shape = (tuple(x.shape) for x in (hint.pyramid.image, image))
    if shape != image_shape:
        raise ValueError(f"lucas_kanade: hint.pyramid is of an image of shape {shape}, expected {image_shape}")
    return hint.pyramid(levels, window)


@shaped("image_0: B C H W, uv_0: B N 2, hint.start: B N 2, image_1: B c h w")
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
    """Tracks of ``track`` with every window registered once more by an affine warp with gain and bias.

    Args:
        hint: as in :func:`lucas_kanade`; passed on to ``track``.
        track: the search, any tracker; its hint holds ``levels`` and the shared pyramid.
        window: of the registration; the search has its own.
        levels: of the search, where it uses hints.
        iterations, epsilon_px, max_shift_px: of the registration, see
            :func:`dhtorch.geometry.affine_alignment.register_affine`.
        start: as in :func:`lucas_kanade`; ``track`` has its result in the hint, and the registration starts with its
            rotation and zoom.

    Returns:
        Tracks of ``track`` with new ``uv_1``, ``cov`` (right for white noise, see ``register_affine``) and
        ``photometric``, a residual with gain and bias taken out. A registration that is rejected leaves the position
        and raises ``error`` to its shift, at most ``max_shift_px``; ``photometric`` and ``cov`` are then those of the
        unregistered window. ``valid`` is untouched.

    Raises:
        ValueError: as ``track``.

    Gradient: as :func:`lucas_kanade`, by one more step of the registration; all other fields are detached.
    Source: Baker and Matthews 2004, "Lucas-Kanade 20 years on", inverse composition with appearance variation.
    """
    with torch.no_grad():
        pyramid = PyramidCache(image_0) if hint.pyramid is None else hint.pyramid
        levels = levels if hint.levels is None else hint.levels
        source = _source_pyramid(hint.replace(pyramid=pyramid), image_0, levels, window)
        flows = resolve_coarse_flow(image_0, image_1, hint, start)
        tracks = track(image_0, image_1, uv_0, hint=TrackHint(hint.start, pyramid, levels, flows))
        target = build_pyramid(image_1, 2, window, gradients=False)
        registration = affine_alignment.register_affine(
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
        registered, rejected = tracks.valid & registration.ok, tracks.valid & ~registration.ok
        uv_1 = torch.where(registered[..., None], registration.uv_1, tracks.uv_1)
        error = torch.maximum(tracks.error, registration.shift_px.clamp(max=max_shift_px))
        tracks = tracks.replace(
            uv_0=uv_0,
            uv_1=uv_1,
            error=torch.where(rejected, error, tracks.error),
            photometric=torch.where(tracks.valid, registration.rms, tracks.photometric),
            cov=torch.where(tracks.valid[..., None, None], registration.cov, tracks.cov),
        )
    if torch.is_grad_enabled() and (image_0.requires_grad or image_1.requires_grad or uv_0.requires_grad):
        source, target = build_pyramid(image_0, 1, window), build_pyramid(image_1, 1, window)
        differentiable = affine_alignment.registration_step(
            source, target, uv_0, tracks.uv_1, registration.linear, window=window
        )
        # The value is that of the search, bit for bit; the derivative that of the step.
        return tracks.replace(
            uv_1=torch.where(tracks.valid[..., None], uv_1 + (differentiable - differentiable.detach()), uv_1)
        )
    return tracks
