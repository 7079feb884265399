"""Cache of tracks: variants that differ only in pose, gates or seed share the tracks of a batch."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dhtorch.records import NO_HINT, TrackHint, Tracks

TrackStage = Callable[..., Tracks]


class SharedTracks:
    """Cache of the tracks of one batch of pairs.

    The same function with the same options, images, pixels and initial values returns the cached record. Its time is
    added to every variant as if each had tracked.
    """

    def __init__(self) -> None:
        self._cached: list[tuple[Any, tuple[Tensor, ...], Tracks, float]] = []
        self._uncharged_ms = 0.0

    def shared_tracker(self, track: TrackStage) -> TrackStage:
        """Cached track stage of one variant."""
        self._uncharged_ms = 0.0
        return partial(self._track, track)

    def charge(self, ms: dict[str, float]) -> None:
        """Add the time of the cached tracks to ``ms["track"]``."""
        if self._uncharged_ms:
            ms["track"] = ms.get("track", 0.0) + self._uncharged_ms
            self._uncharged_ms = 0.0

    def _track(
        self,
        track: TrackStage,
        image_0: Tensor,
        image_1: Tensor,
        uv_0: Tensor,
        *,
        hint: TrackHint = NO_HINT,  # its pyramid is a function of the image
    ) -> Tracks:
        start = time.perf_counter()
        key = stage_key(track), hint.levels
        inputs = (image_0, image_1, uv_0, uv_0 if hint.start is None else hint.start, *(hint.between or ()))
        for cached_key, cached_inputs, tracks, ms in self._cached:
            if (
                cached_key == key
                and len(cached_inputs) == len(inputs)
                and all(map(_is_same_tensor, cached_inputs, inputs))
            ):
                self._uncharged_ms += ms
                return tracks
        tracks = track(image_0, image_1, uv_0, hint=hint)
        self._cached.append((key, inputs, tracks, 1e3 * (time.perf_counter() - start)))
        return tracks


def _is_same_tensor(a: Tensor, b: Tensor) -> bool:
    """Whether two tensors share memory or have equal values (selected views are copies)."""
    if a.shape != b.shape or a.dtype != b.dtype:
        return False
    return (a.data_ptr() == b.data_ptr() and a.stride() == b.stride()) or torch.equal(a, b)


def stage_key(fn: Any) -> Any:
    """Comparable key of a stage: partials of one function with equal options have equal keys, however nested."""
    if not isinstance(fn, partial):
        return fn
    options = {k: stage_key(v) for k, v in fn.keywords.items()}
    args = tuple(map(stage_key, fn.args))
    if isinstance(fn.func, partial):
        inner, before, others = stage_key(fn.func)
        return inner, before + args, others | options
    return fn.func, args, options
