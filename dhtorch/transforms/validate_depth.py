"""Sample dict → the same dict plus a validation of its depth map: a transform for data loaders."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from dhtorch.codes import State
from dhtorch.geometry.no_depth import clear_no_depth
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import get_method
from dhtorch.pytree import stack
from dhtorch.records import NO_HINT, DepthValidation, Frame, TrackHint
from dhtorch.runtime.numerics import standard_numerics
from dhtorch.transforms.sample_access import SampleError, SampleReader, check_sample
from dhtorch.transforms.sample_spec import SampleSpec, check_sample_orientation, default_prefix
from dhtorch.validation.validate import validate_depth


class ValidateDepth(torch.nn.Module):
    """Sample dict with images and depth -> the same dict plus the validation of a depth map, per pixel and per frame.

    A new dict is returned, other keys untouched. Shapes are fixed by ``size`` and the image size, every number is
    finite, and masks mark the valid ones.

    Args:
        map: key of the map to validate, (h, w) m over the field of view of the image; None = the sensor's own depth.
        map_unit: metres per unit of the map.
        method: a name (:data:`dhtorch.pipeline.presets.METHODS`) or a :class:`dhtorch.pipeline.method.Method`.
        n: samples per image; None = the method's own number.
        judging: options of :func:`dhtorch.validation.validate.validate_depth`: ``views``, ``source_views``, ``size``,
            ``tolerance``.
        hint: prior information on the motion between the views, for the tracker.
        seed: of the pose search.
        batched: samples are collated batches; None = single samples, and a sample that looks like a batch is rejected.
        prefix: of the added keys. None = ``dhtorch.``, and ``observation.dh_`` where ``image`` is named as LeRobot
            names its pictures (``observation.images.…``): its processors keep no other keys.
        **views: keys, layouts and units of the images, the depth and the intrinsics: see
            :class:`dhtorch.transforms.SampleSpec`. ``depth_unit`` is required.

    Returns:
        The sample plus, under prefixed keys (with B in front for a batch): ``state`` (h, w) of
        :class:`dhtorch.codes.State`; ``evidence`` (h, w) sigmas, 0 without evidence; ``state_share`` (3,) of the
        pixels with a depth, by state; ``scale``, ``shift``, ``tilt``, ``wrong`` (3,) value, low, high, with
        ``<name>_known``; ``clip_depth`` () m, where the map is clipped, with ``clip_depth_known``. Unknown values are
        0. Without a source view only the near returns are evidence.

    Raises:
        ValueError: invalid options.
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
        prefix: str | None = None,
        **views: Any,
    ) -> None:
        super().__init__()
        method = get_method(method, n)
        accepted = ("views", "source_views", "size", "tolerance")
        if unknown := [name for name in judging or {} if name not in accepted]:
            raise ValueError(f"judging: found {', '.join(unknown)}, expected some of {', '.join(accepted)}")
        if not map_unit > 0:
            raise ValueError(f"map_unit is {map_unit!r}, expected a positive number of metres")
        self.views = SampleSpec(**views)
        self.method, self.map, self.map_unit, self.judging = method, map, map_unit, dict(judging or {})
        self.hint, self.seed, self.batched = hint, seed, bool(batched)
        self.prefix = default_prefix(self.views.image) if prefix is None else prefix
        self._batched_option = batched

    @standard_numerics
    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """Sample or batch -> copy of it with the added keys."""
        check_sample(sample, self.views.image, self.views.intrinsics, self._batched_option)
        with torch.no_grad():
            read = self.views.read(sample, batched=self.batched)
            if bool(read.bad.any()):
                raise SampleError(read.complaint())
            depth = None
            if self.map is not None:
                leaves = SampleReader(sample, batched=self.batched, dtype=read.reference.camera.f.dtype)
                leaves.like = read.reference.image
                planes = leaves.planes(self.map, 1).to(read.reference.camera.f)
                check_sample_orientation(self.map, planes, read.reference.hw)
                depth = clear_no_depth(planes[:, 0] * self.map_unit, self.map_unit)
            validation = self._validate(depth, read.reference, None)
            if read.other is not None and bool(read.paired.any()):
                with_source = self._validate(depth, read.reference, read.other)
                rows = torch.arange(len(read.paired), device=read.paired.device)
                validation = stack([validation, with_source])[read.paired.long(), rows]
        has_depth = validation.depth > 0
        n_pixels = has_depth.sum((1, 2)).clamp_min(1)
        states = (State.CANNOT_KNOW, State.CONSISTENT, State.WRONG)
        fractions = [((validation.state == code) & has_depth).sum((1, 2)) / n_pixels for code in states]
        added = {
            "state": validation.state,
            "evidence": validation.evidence.nan_to_num(0.0, 0.0, 0.0),
            "state_share": torch.stack(fractions, -1).to(validation.depth),
        }
        for name in ("scale", "shift", "tilt", "wrong"):  # each with its confidence interval: value, low, high
            value = getattr(validation, name)
            added |= {name: value.nan_to_num(0.0, 0.0, 0.0), f"{name}_known": value.isfinite().all(-1)}
        added["clip_depth"] = validation.clip_depth.nan_to_num(0.0)
        added["clip_depth_known"] = validation.clip_depth.isfinite()
        return {**sample, **{self.prefix + key: x if self.batched else x[0].contiguous() for key, x in added.items()}}

    def _validate(self, depth: Tensor | None, reference: Frame, others: Frame | None) -> DepthValidation:
        return validate_depth(
            depth, reference, others, method=self.method, seed=self.seed, hint=self.hint, **self.judging
        )
