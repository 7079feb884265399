"""Dense depth maps of samples, computed by :func:`dhtorch.pipeline.completion.complete_depth`."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from dhtorch import pytree
from dhtorch.metrics.calibration import Calibration
from dhtorch.pipeline import dense
from dhtorch.pipeline.completion import complete_depth, default_calibration
from dhtorch.pipeline.method import Method
from dhtorch.records import DepthMap, Frame, MergedDepth
from dhtorch.transforms.sample_spec import SampleViews


@dataclass(frozen=True, eq=False)
class DenseMaps:
    """Options of the dense maps of samples, and the calibration of their sigma and score (the package's default)."""

    options: Mapping[str, Any]
    calibration: Calibration = field(default_factory=default_calibration)

    @classmethod
    def from_options(cls, setting: bool | Mapping[str, Any], name: str = "dense") -> "DenseMaps | None":
        """Option ``dense`` -> maps, None if it is off; see :func:`dhtorch.pipeline.dense.dense_options`."""
        options = dense.dense_options(setting, name)
        return None if options is None else cls(options)

    def hw(self, hw: tuple[int, int]) -> tuple[int, int]:
        """Image height and width -> height and width of its map."""
        return dense.map_hw(hw, self.options["size"])

    def complete(self, read: SampleViews, method: Method, **method_args: Any) -> DepthMap:
        """Views of B samples -> maps (B, h, w): completed where a source view exists, else :meth:`sensor_depth`.

        Args:
            read: the views.
            method: the sparse method.
            method_args: ``seed``, ``fit``, ``hint`` and ``trace`` of ``complete_depth``.
        """
        assert read.other is not None
        options = {**self.options, "method": method, "calibration": self.calibration, **method_args}
        completed = complete_depth(read.reference, read.other, **options)
        if bool(read.paired.all()):
            return completed
        rows = torch.arange(len(read.paired), device=read.paired.device)
        return pytree.stack([self.sensor_depth(read.reference, method), completed])[read.paired.long(), rows]

    def sensor_depth(self, reference: Frame, method: Method) -> DepthMap:
        """Reference view -> maps (B, h, w) of the sensor's depth, other pixels unanswered."""
        return dense.sensor_depth_map(reference, method=method, size=self.options["size"])


def map_to_samples(depth_map: DepthMap, frame: Frame, method: Method) -> tuple[MergedDepth, Tensor]:
    """Depth map -> samples (B, h · w), one per pixel, and their hole classes from stages 2 and 3 of the method.

    Gradient: to depth and sigma.
    """
    uv = dense.map_pixel_centres(frame, (depth_map.depth.shape[-2], depth_map.depth.shape[-1]))
    with torch.no_grad():
        hole = method.sample_depth_at(frame, uv).hole
    depth, sigma = (torch.where(depth_map.keep, x, 0.0).flatten(1) for x in (depth_map.depth, depth_map.sigma))
    score, source = depth_map.score.flatten(1), depth_map.source.flatten(1)
    return MergedDepth(uv.expand(len(hole), -1, -1), depth, sigma, score, source), hole
