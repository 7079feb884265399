"""A method is a record: seven functions in a row, and the few options that belong to none of them.

    reference view ─ sample ─ backproject ─ classify ─┬─ near, with depth ──── pose ────┐
                                                   └─ trackable, without ─ track ────┴─ triangulate ─ score

A seat takes any callable with the seat's signature: a function, a ``functools.partial`` of one, a lambda, an
``nn.Module``. Nobody looks into it. What a caller knows beforehand, such as where a track may start, is told to the
tracker as its ``hint``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, Self

import torch
from torch import Tensor

from dhtorch.records import (
    MIN_TRACKABILITY,
    Estimate,
    Frame,
    PoseFit,
    PosePrior,
    Samples,
    Tracks,
    ViewSelection,
)
from dhtorch.stages.backproject import backproject
from dhtorch.stages.fuse import inverse_variance
from dhtorch.stages.holes import classify
from dhtorch.stages.pose import pnp_ransac
from dhtorch.stages.sample import spiral
from dhtorch.stages.score import confidence
from dhtorch.stages.track import lucas_kanade
from dhtorch.stages.triangulate import two_view

#: Intermediates and milliseconds by stage name; fill one with ``method(..., trace=trace)``.
Trace = dict[str, Any]


@dataclass(frozen=True, eq=False, kw_only=True)
class MethodSpec:
    """Seven seats and the options beside them; called, it extends the depth sensor of a reference view.

    Near returns fix the metric relative pose of two views; every tracked sample, those without a return above all, is
    triangulated under that pose; gates leave a hole with a reason where the geometry is weak. Of several other views
    each answers as a pair, and ``fuse`` joins what they say.

    The defaults are the paper's (:data:`dhtorch.pipeline.presets.PAPER`).
    """

    # seats: (positional arguments) -> answer
    sample: Callable[..., Tensor] = spiral  # (hw, n, *, device, dtype) -> uv (n, 2) px
    backproject: Callable[..., Samples] = backproject  # (frame, uv)
    classify: Callable[..., Samples] = classify  # (frame, samples) -> samples with their holes
    track: Callable[..., Tracks] = lucas_kanade  # (image_0, image_1, uv_0, *, hint)
    pose: Callable[..., PoseFit] = pnp_ransac  # (samples, tracks, camera_0, camera_1, draws)
    triangulate: Callable[..., Estimate] = two_view  # (samples, tracks, fit, camera_0, camera_1)
    score: Callable[..., Estimate] = confidence  # (estimate, samples, tracks, fit)
    fuse: Callable[..., Estimate] = inverse_variance  # (estimates (V, B, N)); asked where there are several views
    select_views: Callable[..., Tensor | ViewSelection] | None = (
        None  # (reference, others, views, *, fit) -> (views, B)
    )
    pose_prior: Callable[..., PosePrior] | None = None  # (reference, others) -> relative poses, or None

    n: int = 2048  # samples per reference view
    hypotheses: int = 200  # minimal samples drawn by the pose search
    min_trackability: float = MIN_TRACKABILITY  # samples below it are not used (gate NO_TEXTURE)
    views: int = 1  # other views that are used, of more the best are chosen
    chain: bool = True  # begin the search in each view where its predecessor was found, further on at the same pace

    def replace(self, **changes: Any) -> Self:
        """The method with other functions in some seats, or other options.

        A dict for a seat changes options of the function that sits there: ``PAPER.replace(track={"levels": 6})``.

        Raises:
            TypeError: no such seat or option.
        """
        known = [f.name for f in fields(self)]
        if unknown := [name for name in changes if name not in known]:
            raise TypeError(f"method: found {', '.join(unknown)}, expected seats and options among {', '.join(known)}")
        given: Any = {k: partial(getattr(self, k), **v) if isinstance(v, Mapping) else v for k, v in changes.items()}
        return replace(self, **given)

    def sample_depth(self, frame: Frame) -> Samples:
        """Seats 1 to 3, the front end: where to look, what the sensor says there, why a return is missing."""
        like = frame.camera.f
        return self.sample_depth_at(frame, self.sample(frame.hw, self.n, device=like.device, dtype=like.dtype))

    def sample_depth_at(self, frame: Frame, uv: Tensor) -> Samples:
        """Seats 2 and 3: the samples (B, N) at pixels ``uv`` (N, 2) or (B, N, 2)."""
        return self.classify(frame, self.backproject(frame, uv))


def iter_components(*seats: Any) -> Iterator[Any]:
    """What sits in seats: callables, and what partials of the standard library hold, options that are none included."""
    for seat in seats:
        if isinstance(seat, MethodSpec):
            yield from iter_components(*(getattr(seat, f.name) for f in fields(seat)))
        elif isinstance(seat, partial):
            yield from iter_components(seat.func, *seat.args, *seat.keywords.values())
        else:
            yield seat


def iter_networks(*seats: Any) -> Iterator[torch.nn.Module]:
    """The networks in seats: modules, and what partials of the standard library hold of them."""
    return (part for part in iter_components(*seats) if isinstance(part, torch.nn.Module))
