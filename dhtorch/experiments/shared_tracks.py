"""Tracks asked once: variants that differ in the pose, the gates or the seed look at the same ones."""

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
    """Remembers the tracks of one batch of pairs.

    A seat filled by the same function with the same options, asked about the same images, pixels and initial values,
    gets the same record. Its time is charged to every variant as if each had tracked.
    """

    def __init__(self) -> None:
        self._known: list[tuple[Any, tuple[Tensor, ...], Tracks, float]] = []
        self._owed = 0.0

    def seat(self, track: TrackStage) -> TrackStage:
        """The track seat of one variant."""
        self._owed = 0.0
        return partial(self._track, track)

    def charge(self, ms: dict[str, float]) -> None:
        """Add to ``ms["track"]`` what the tracks that were remembered had cost."""
        if self._owed:
            ms["track"] = ms.get("track", 0.0) + self._owed
            self._owed = 0.0

    def _track(
        self,
        track: TrackStage,
        image_0: Tensor,
        image_1: Tensor,
        uv_0: Tensor,
        *,
        hint: TrackHint = NO_HINT,  # its pyramid says nothing that the image does not
    ) -> Tracks:
        start = time.perf_counter()
        key = stage_key(track), hint.levels
        question = (image_0, image_1, uv_0, uv_0 if hint.start is None else hint.start)
        for known, asked, tracks, ms in self._known:
            if known == key and all(map(_is_same_tensor, asked, question)):
                self._owed += ms
                return tracks
        tracks = track(image_0, image_1, uv_0, hint=hint)
        self._known.append((key, question, tracks, 1e3 * (time.perf_counter() - start)))
        return tracks


def _is_same_tensor(a: Tensor, b: Tensor) -> bool:
    """The same memory, or equal values: views that were chosen stand in new memory."""
    if a.shape != b.shape or a.dtype != b.dtype:
        return False
    return (a.data_ptr() == b.data_ptr() and a.stride() == b.stride()) or torch.equal(a, b)


def stage_key(fn: Any) -> Any:
    """What a seat does, comparable: partials of one function with equal options are equal, however often they are
    nested."""
    if not isinstance(fn, partial):
        return fn
    options = {k: stage_key(v) for k, v in fn.keywords.items()}
    args = tuple(map(stage_key, fn.args))
    if isinstance(fn.func, partial):
        inner, before, others = stage_key(fn.func)
        return inner, before + args, others | options
    return fn.func, args, options
