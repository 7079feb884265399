"""Maps of samples: a depth for every pixel of the reference view, as :func:`dhtorch.pipeline.dense.complete_depth`
finds it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from dhtorch import pytree
from dhtorch.calibration.score_calibration import Calibration
from dhtorch.pipeline import dense
from dhtorch.pipeline.method import Method
from dhtorch.records import DepthMap, Frame, MergedDepth
from dhtorch.transforms.sample_spec import SampleViews


@dataclass(frozen=True, eq=False)
class DenseMaps:
    """How maps are made: all options, and the calibration that travels with the package."""

    options: Mapping[str, Any]
    calibration: Calibration | None = field(default_factory=dense.default_calibration)

    @classmethod
    def asked(cls, given: bool | Mapping[str, Any], name: str = "dense") -> DenseMaps | None:
        """What ``dense=`` asks for, see :func:`dhtorch.pipeline.dense.dense_options`."""
        options = dense.dense_options(given, name)
        return None if options is None else cls(options)

    def hw(self, hw: tuple[int, int]) -> tuple[int, int]:
        """Height and width of the map of a picture."""
        return dense.map_hw(hw, self.options["size"])

    def swept(self, read: SampleViews, method: Method, **asked: Any) -> DepthMap:
        """The maps of samples of which some have a second view; the others get those of :meth:`sensed`.

        Args:
            read: the views.
            method: the sparse method.
            asked: ``seed``, ``fit``, ``hint`` and ``trace``, as ``complete`` takes them.
        """
        assert read.other is not None
        options = {**self.options, "method": method, "calibration": self.calibration, **asked}
        found = dense.complete_depth(read.reference, read.other, **options)
        if bool(read.paired.all()):
            return found
        rows = torch.arange(len(read.paired), device=read.paired.device)
        return pytree.stack([self.sensed(read.reference, method), found])[read.paired.long(), rows]

    def sensed(self, reference: Frame, method: Method) -> DepthMap:
        """The maps of samples without a second view: the sensor where it answers, else silence."""
        return dense.sensor_depth_map(reference, method=method, size=self.options["size"])


def zero_unanswered(found: DepthMap, values: Tensor) -> Tensor:
    """Values (B, h, w) of a map, 0 where there is no depth. Gradient: to the values."""
    return torch.where(found.keep, values, 0.0)


def map_to_samples(found: DepthMap, frame: Frame, method: Method) -> tuple[MergedDepth, Tensor]:
    """Every pixel of a map as a sample (B, h · w), and the class of its hole as the method's seats 2 and 3 name it.

    Gradient: to depth and sigma.
    """
    uv = dense.map_pixel_centres(frame, (found.depth.shape[-2], found.depth.shape[-1]))
    with torch.no_grad():
        hole = method.sample_depth_at(frame, uv).hole
    depth, sigma = (zero_unanswered(found, values).flatten(1) for values in (found.depth, found.sigma))
    score, source = found.score.flatten(1), found.source.flatten(1)
    return MergedDepth(uv.expand(len(hole), -1, -1), depth, sigma, score, source), hole
