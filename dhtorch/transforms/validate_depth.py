"""Sample dict → the same sample with a verdict on its depth: whether it is right, as a transform for data loaders."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from dhtorch.codes import State
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import get_method
from dhtorch.pytree import stack
from dhtorch.records import NO_HINT, DepthValidation, Frame, TrackHint
from dhtorch.transforms.sample_access import SampleError, SampleReader, check_sample
from dhtorch.transforms.sample_spec import SampleSpec
from dhtorch.validation.validate import validate_depth

#: Numbers of a frame that are added with their interval: value, low, high.
_INTERVAL_KEYS = ("scale", "shift", "tilt", "wrong")


class ValidateDepth(torch.nn.Module):
    """Add to each sample whether a depth map of it is right: states and evidence of every pixel, and of the whole.

    A new dict is returned, other keys untouched. Shapes are fixed by ``size`` and the size of the image, every number
    is finite, and masks say what is meant.

    Args:
        map: key of the map to judge, (h, w) m over the field of the image; None = the sensor's own depth.
        map_unit: metres a step of the map.
        method: a name (:data:`dhtorch.pipeline.presets.METHODS`) or a :class:`dhtorch.pipeline.method.Method`.
        n: samples per image; None = the method's own number.
        judging: options of :func:`dhtorch.validation.validate.validate_depth`: ``views``, ``source_views``, ``size``,
            ``tolerance``.
        hint: what is known of the motion between the views, for the tracker.
        seed: of the pose search.
        batched: samples are collated batches; None = single ones, and what shows a batch is refused.
        prefix: of the keys that are added.
        **views: where the images, the depth and the intrinsics are, and their units: see
            :class:`dhtorch.transforms.SampleSpec`. ``depth_unit`` must be given.

    Returns:
        The sample and, behind the prefix (with B in front of a batch): ``state`` (h, w) of
        :class:`dhtorch.codes.State`; ``evidence`` (h, w) sigmas, 0 where nothing is said; ``state_share`` (3,) of the
        pixels with a depth, by state; ``scale``, ``shift``, ``tilt``, ``wrong`` (3,) value, low, high, with
        ``<name>_known``; ``clip_depth`` () m, where the map is cut, with ``clip_depth_known``; what cannot be known, or
        is not so, is 0. Without a second view near returns alone speak.

    Raises:
        ValueError: options that cannot be.
        SampleError: a bad sample.

    Gradient: none.
    Cost: as :func:`dhtorch.validation.validate.validate_depth`.
    """

    def __init__(
        self,
        *,
        map: str | None = None,
        map_unit: float = 1.0,
        method: str | Method = "auto",
        n: int | None = None,
        judging: Mapping[str, Any] | None = None,
        hint: TrackHint = NO_HINT,
        seed: int = 0,
        batched: bool | None = None,
        prefix: str = "dhtorch.",
        **views: Any,
    ) -> None:
        super().__init__()
        method = get_method(method, n)
        known = ("views", "source_views", "size", "tolerance")
        if unknown := [name for name in judging or {} if name not in known]:
            raise ValueError(f"judging: found {', '.join(unknown)}, expected some of {', '.join(known)}")
        if not map_unit > 0:
            raise ValueError(f"map_unit is {map_unit!r}, expected a positive number of metres")
        self.views = SampleSpec(**views)
        self.method, self.map, self.map_unit, self.judging = method, map, map_unit, dict(judging or {})
        self.hint, self.seed, self.batched, self.prefix = hint, seed, bool(batched), prefix
        self._stated = batched

    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """The sample with our keys."""
        check_sample(sample, self.views.image, self.views.intrinsics, self._stated)
        with torch.no_grad():
            read = self.views.read(sample, batched=self.batched)
            if bool(read.bad.any()):
                raise SampleError(read.complaint())
            depth = self._map(sample, read.reference)
            verdict = self._judged(depth, read.reference, None)
            if read.other is not None and bool(read.paired.any()):
                seen = self._judged(depth, read.reference, read.other)
                rows = torch.arange(len(read.paired), device=read.paired.device)
                verdict = stack([verdict, seen])[read.paired.long(), rows]
        added = _validation_keys(verdict)
        return {**sample, **{self.prefix + key: x if self.batched else x[0].contiguous() for key, x in added.items()}}

    def _judged(self, depth: Tensor | None, reference: Frame, others: Frame | None) -> DepthValidation:
        return validate_depth(
            depth, reference, others, method=self.method, seed=self.seed, hint=self.hint, **self.judging
        )

    def _map(self, sample: Mapping[str, Any], reference: Frame) -> Tensor | None:
        if self.map is None:
            return None
        leaves = SampleReader(sample, batched=self.batched, dtype=reference.camera.f.dtype)
        leaves.like = reference.image
        planes = leaves.planes(self.map, 1).to(reference.camera.f)
        return planes[:, 0] * self.map_unit


def _validation_keys(verdict: DepthValidation) -> dict[str, Tensor]:
    there = verdict.depth > 0
    n = there.sum((1, 2)).clamp_min(1)
    states = (State.CANNOT_KNOW, State.CONSISTENT, State.WRONG)
    shares = [((verdict.state == code) & there).sum((1, 2)) / n for code in states]
    added = {
        "state": verdict.state,
        "evidence": verdict.evidence.nan_to_num(0.0, 0.0, 0.0),
        "state_share": torch.stack(shares, -1).to(verdict.depth),
    }
    for name in _INTERVAL_KEYS:
        value = getattr(verdict, name)
        added |= {name: value.nan_to_num(0.0, 0.0, 0.0), f"{name}_known": value.isfinite().all(-1)}
    return added | {"clip_depth": verdict.clip_depth.nan_to_num(0.0), "clip_depth_known": verdict.clip_depth.isfinite()}
