"""A method is a record: seven functions in a row, and the few options that belong to none of them.

    anchor view ─ sample ─ backproject ─ classify ─┬─ near, with depth ──── pose ────┐
                                                   └─ trackable, without ─ track ────┴─ triangulate ─ score

A seat takes any callable with the seat's signature: a function, a ``functools.partial`` of one, a lambda, an
``nn.Module``. Nobody looks into it. What a caller knows beforehand, such as where a track may start, is told to the
tracker as its ``hint``.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dhtorch.frames import agreed
from dhtorch.records import NO_HINT, Choice, Estimate, Frame, GivenPose, PoseFit, Samples, TrackHint, Tracks
from dhtorch.stages.backproject import backproject
from dhtorch.stages.fuse import inverse_variance
from dhtorch.stages.holes import classify
from dhtorch.stages.pose import pnp_ransac
from dhtorch.stages.sample import spiral
from dhtorch.stages.score import rank
from dhtorch.stages.track import lucas_kanade
from dhtorch.stages.triangulate import two_view

#: Intermediates and milliseconds by stage name; fill one with ``method(..., trace=trace)``.
Trace = dict[str, Any]


@dataclass(frozen=True, eq=False, kw_only=True)
class Method:
    """Seven seats and the options beside them; called, it extends the depth sensor of an anchor view.

    Near returns fix the metric relative pose of two views; every tracked sample, those without a return above all, is
    triangulated under that pose; gates leave a hole with a reason where the geometry is weak. Of several other views
    each answers as a pair, and ``fuse`` joins what they say.

    The defaults are the paper's (:data:`dhtorch.methods.PAPER`).
    """

    # seats: (positional arguments) -> answer
    sample: Callable[..., Tensor] = spiral  # (hw, n, *, device, dtype) -> uv (n, 2) px
    backproject: Callable[..., Samples] = backproject  # (frame, uv)
    classify: Callable[..., Samples] = classify  # (frame, samples) -> samples with their holes
    track: Callable[..., Tracks] = lucas_kanade  # (image_0, image_1, uv_0, *, hint)
    pose: Callable[..., PoseFit] = pnp_ransac  # (samples, tracks, camera_0, camera_1, draws)
    triangulate: Callable[..., Estimate] = two_view  # (samples, tracks, fit, camera_0, camera_1)
    score: Callable[..., Estimate] = rank  # (estimate, samples, tracks, fit)
    fuse: Callable[..., Estimate] = inverse_variance  # (estimates (V, B, N)); asked where there are several views
    choose: Callable[..., Tensor | Choice] | None = None  # (anchor, others, views, *, fit) -> (views, B) indices
    given: Callable[..., GivenPose] | None = None  # (anchor, others) -> motions from elsewhere, or None

    n: int = 2048  # samples per anchor
    hypotheses: int = 200  # minimal samples drawn by the pose search
    min_trackability: float = 1e-5  # samples below it are not used (gate NO_TEXTURE)
    views: int = 1  # other views that are used, of more the best are chosen
    chain: bool = True  # begin the search in each view where its predecessor was found, further on at the same pace

    def __call__(
        self,
        anchor: Frame,
        others: Frame | Sequence[Frame],
        *,
        seed: int | Tensor = 0,
        fit: PoseFit | GivenPose | None = None,
        hint: TrackHint = NO_HINT,
        trace: Trace | None = None,
        **changes: Any,
    ) -> Estimate:
        """Depth along the samples of ``anchor``, by the parallax to one other view or several.

        Args:
            anchor: B views.
            others: B other views; or several of each anchor, V × B in one record or a sequence of V, in the order in
                which the camera took them. Their depth is not read. Cameras may differ.
            seed: an int gives every pair the same draws; a (B,) int64 tensor gives each pair its own. All views of an
                anchor have the same.
            fit: a pose that is believed, (B,) or (V, B): seat 5 is then skipped; or a :class:`GivenPose` from
                elsewhere, which near returns may refute (:func:`dhtorch.stages.given.hold`). None = as ``given`` says.
            hint: what is known of the motion, for the tracker.
            trace: a dict that receives ``samples``, ``tracks`` (as tracked), ``tracks_ideal`` (undistorted), ``fit``,
                ``estimate`` and ``ms`` (milliseconds by stage). Of several views those of the last, with ``ms`` summed
                and ``views``, the traces of all.
            **changes: seats and options for this call alone, as :meth:`replace` takes them.

        Returns:
            Estimate for the B × n samples, silent ones with their reason; in the dtype of the intrinsics, float32
            where these are half precision. Images and depth may be of any floating dtype, each frame's
            of its own (:func:`dhtorch.frames.agreed`).

        Raises:
            ValueError: wrong shapes, different batch sizes or devices, nothing to see, no other view.
            TypeError: no such seat or option, or no frame.

        Memory: grows with the answers; pyramids are held of eight pairs at most, unless a graph keeps them.
        Gradient: recovered depth to all images, to the near depth and to intrinsics; choices (flags, inliers, gates)
        carry none.
        Cost: linear in views; the anchor's pyramid is built once.
        Source: paper, section "Method".
        """
        # The two ways of joining the seats know the record, so they come after it.
        from dhtorch.pair import ask_pair  # noqa: PLC0415
        from dhtorch.window import ask_window  # noqa: PLC0415

        method = self.replace(**changes) if changes else self
        anchor, others = agreed(anchor, others)
        if fit is None and method.given is not None:
            fit = method.given(anchor, others)
        ask = ask_pair if others.image.dim() == 4 else ask_window
        return ask(method, anchor, others, seed=seed, fit=fit, hint=hint, trace=trace)

    def replace(self, **changes: Any) -> Method:
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

    def look(self, frame: Frame) -> Samples:
        """Seats 1 to 3, the front end: where to look, what the sensor says there, why a return is missing."""
        like = frame.camera.f
        return self.look_at(frame, self.sample(frame.hw, self.n, device=like.device, dtype=like.dtype))

    def look_at(self, frame: Frame, uv: Tensor) -> Samples:
        """Seats 2 and 3: the samples (B, N) at pixels ``uv`` (N, 2) or (B, N, 2)."""
        return self.classify(frame, self.backproject(frame, uv))


def parts(*seats: Any) -> Iterator[Any]:
    """What sits in seats: callables, and what partials of the standard library hold, options that are none included."""
    for seat in seats:
        if isinstance(seat, Method):
            yield from parts(*(getattr(seat, f.name) for f in fields(seat)))
        elif isinstance(seat, partial):
            yield from parts(seat.func, *seat.args, *seat.keywords.values())
        else:
            yield seat


def options(seat: Any, function: Callable[..., Any]) -> dict[str, Any] | None:
    """The options by name with which ``function`` sits in a seat, itself or in a partial; None where another does."""
    own = seat.keywords if isinstance(seat, partial) and seat.func is function and not seat.args else {}
    if seat is not function and not own:
        return None
    known = inspect.signature(function).parameters.values()
    return {**{p.name: p.default for p in known if p.kind is p.KEYWORD_ONLY}, **own}


def networks(*seats: Any) -> Iterator[torch.nn.Module]:
    """The networks in seats: modules, and what partials of the standard library hold of them."""
    return (part for part in parts(*seats) if isinstance(part, torch.nn.Module))
