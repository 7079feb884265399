"""Stage 4 through intermediate images: short tracks from image to image, registered to the reference view's window.

    image 0 ── hop ──> between 1 ── hop ──> between 2 ── … ──> image 1
       └────── register ───┴────── register ────┴──── register ───┘

Windows change little from one image to the next, so that a short track succeeds where one jump over the whole way does
not. But its template is the window of the image before, and the errors of the hops add up. Hence at each image the
window of image 0 is searched once more, from where the chain is: the error is then that of a single track.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry.checks import any_possible, check
from dhtorch.geometry.pyramid import PyramidCache
from dhtorch.records import NO_HINT, TrackHint, Tracks


class _Way(NamedTuple):
    """The images in their order, and what every search between two of them needs."""

    images: Sequence[Tensor]
    pyramids: Sequence[PyramidCache]
    levels: int | None

    def track(
        self, track: Callable[..., Tracks], j: int, k: int, uv: Tensor, wanted: Tensor, start: Tensor | None = None
    ) -> Tracks:
        """Tracks from image ``j`` to image ``k`` of the points uv (B, N, 2) that are ``wanted`` (B, N)."""
        hint = TrackHint(start, self.pyramids[j], self.levels)
        # Outside every image, points cost nothing.
        tracks = track(self.images[j], self.images[k], torch.where(wanted[..., None], uv, -2.0), hint=hint)
        return tracks.replace(valid=tracks.valid & wanted)


def track_chain(
    image_0: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    image_1: Tensor,  # (B, C, H', W')
    uv_0: Tensor,  # (B, N, 2) px
    *,
    hint: TrackHint = NO_HINT,
    track: Callable[..., Tracks],
    hop: Callable[..., Tracks] | None = None,
    between: int = 4,
    register: bool = True,
    max_drift_px: float = 2.0,
    max_round_trip_px: float = 2.0,
    **options: Any,
) -> Tracks:
    """Tracks of points uv_0 from image 0 to image 1 through the images between, registered to image 0 at each.

    Without images between it is ``track``. A point that a hop loses on the way is tracked directly at the end, so that
    a bad image between takes little away.

    Args:
        hint: its ``between`` holds the images, in their order; ``start`` is that of points which are tracked directly,
            ``flows`` are not used.
        track: any tracker of two images.
        hop: tracker of the hops from image to image. None = ``track``.
        between: most images between that are used; of more, as many evenly spaced. With 4 (five hops) the coverage of
            ``paper`` on six video scenes of ``data=shared_scenes`` rose from .23 to .53.
        register: search the window of image 0 in every image, from where the chain is. False = the hops alone.
        max_drift_px: a registration further from the chain's place is another structure and not used; with 1 and 3 px
            coverage is the same to .01.
        max_round_trip_px: of tracks that are not registered in image 1, over the whole way back: 1 px of a single track
            times √5 for five hops.
        **options: of ``track``.

    Returns:
        Tracks, registered ones as ``track`` has them. Where the registration in image 1 fails, the chain's place is
        kept if the hops back through all images end near ``uv_0``: ``cov`` is then the sum of the hops' covariances
        since the last registration, ``error`` the sum of their round trips or, if larger, that of the whole way, and
        ``photometric`` that of the last hop.

    Raises:
        ValueError: as ``track``; ``between`` below 0, or images of another batch size.

    Memory: one pyramid per image between.
    Gradient: that of ``track``: of a registered point by its last step, of one that is not by those of all hops.
    Cost: two tracks per hop, of which registrations have a start; a third for points that are not registered.
    Source: paper, "short LK tracks"; the registration against drift is that of Shi and Tomasi 1994.
    """
    step = partial(track, **options) if options else track
    if between < 0:
        raise ValueError(f"track_chain: between is {between}, expected at least 0")
    supply = hint.between or ()
    chosen = [supply[k] for k in frames_between(-1, len(supply), between)]
    if not chosen:
        return step(image_0, image_1, uv_0, hint=hint if hint.between is None else hint.replace(between=None))
    for image in (*chosen, image_1):
        check("track_chain", image_0=(image_0, "B C H W"), image=(image, "B c h w"), uv_0=(uv_0, "B N 2"))
    images = [image_0, *chosen, image_1]
    first = PyramidCache(image_0) if hint.pyramid is None else hint.pyramid
    way = _Way(images, [first, *map(PyramidCache, images[1:])], hint.levels)
    everywhere = torch.ones_like(uv_0[..., 0], dtype=torch.bool)
    tracks, registered = way.track(step, 0, 1, uv_0, everywhere), everywhere
    for k in range(2, len(images)):
        further = way.track(hop or step, k - 1, k, tracks.uv_1, tracks.valid)
        tracks = further.replace(  # lost ones stay at their last place
            uv_1=torch.where(tracks.valid[..., None], further.uv_1, tracks.uv_1),
            error=tracks.error + further.error,
            cov=tracks.cov + further.cov,
        )
        registered = torch.zeros_like(everywhere)
        if register:
            is_last = k == len(images) - 1
            elsewhere = torch.full_like(uv_0, torch.nan) if hint.start is None else hint.start
            start = torch.where(tracks.valid[..., None], tracks.uv_1.detach(), elsewhere)
            registration = way.track(step, 0, k, uv_0, everywhere if is_last else tracks.valid, start)
            near = (registration.uv_1 - tracks.uv_1).detach().norm(dim=-1) <= max_drift_px
            registered = registration.valid & (near | ~tracks.valid)
            tracks = _choose(registered, registration, tracks)
    tracks = tracks.replace(uv_0=uv_0)
    unregistered = tracks.valid & ~registered
    if not any_possible(unregistered):
        return tracks
    with torch.no_grad():
        distance, returned = _way_back(way, hop or step, tracks.uv_1, uv_0, unregistered)
    return tracks.replace(
        valid=tracks.valid & (registered | (returned & (distance <= max_round_trip_px))),
        error=torch.where(returned, torch.maximum(tracks.error, distance), tracks.error),
    )


def frames_between(i: int, j: int, most: int) -> list[int]:
    """At most ``most`` different positions between ``i`` and ``j`` (both excluded), evenly spaced, from ``i`` on."""
    n = max(0, min(most, abs(j - i) - 1))
    return [i + round((j - i) * (k + 1) / (n + 1)) for k in range(n)]


def images_used(track: Callable[..., Tracks]) -> int:
    """Number of images between the two of a pair that a tracker uses at most, 0 of one that tracks directly."""
    options = track.keywords if isinstance(track, partial) else {}
    used: int = options.get("between", 4)
    return used if getattr(track, "func", track) is track_chain else 0


def _choose(chosen: Tensor, tracks: Tracks, others: Tracks) -> Tracks:
    """The tracks where they are ``chosen`` (B, N), the others elsewhere."""

    def choose(x: Tensor, y: Tensor) -> Tensor:
        return torch.where(chosen.view(*chosen.shape, *[1] * (x.dim() - 2)), x, y)

    names = "uv_1", "error", "photometric", "cov", "valid"
    return others.replace(**{name: choose(getattr(tracks, name), getattr(others, name)) for name in names})


def _way_back(
    way: _Way, hop: Callable[..., Tracks], uv_1: Tensor, uv_0: Tensor, wanted: Tensor
) -> tuple[Tensor, Tensor]:
    """Distance (B, N), px, from ``uv_0`` at which the hops back from ``uv_1`` end, and which of them (B, N) do."""
    for k in range(len(way.images) - 1, 0, -1):
        tracks = way.track(hop, k, k - 1, uv_1, wanted)
        uv_1, wanted = tracks.uv_1, tracks.valid
    return (uv_1 - uv_0).norm(dim=-1), wanted
