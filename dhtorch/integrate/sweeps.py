"""Dense depth maps of a recording's reference views: their computation, and their storage in a temporary file.

A map is computed with the estimates of its pair but used only once the frame is placed, which may be after all pairs.
Until then it lies in an unnamed file in half precision, so that no map stays in memory.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from torch import Tensor

from dhtorch.codes import Source, is_estimated
from dhtorch.geometry.windows import window_extreme
from dhtorch.metrics.calibration import Calibration
from dhtorch.pipeline import dense
from dhtorch.pipeline.completion import complete_depth, default_calibration
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.spec import Trace
from dhtorch.records import DepthMap, Estimate, Frame


@dataclass(frozen=True, eq=False)
class DenseSweep:
    """Dense completion of a reference view: its non-default options, and the calibration of its sigma."""

    options: Mapping[str, Any] = field(default_factory=dict)
    calibration: Calibration = field(default_factory=default_calibration)

    @classmethod
    def from_options(cls, settings: bool | Mapping[str, Any] | None, name: str = "dense") -> "DenseSweep | None":
        """The sweep of the option ``dense``, None if it is off; see :func:`dhtorch.pipeline.dense.dense_options`."""
        options = dense.dense_options(settings, name)
        return None if options is None else cls(options)

    def __call__(
        self, method: Method, reference: Frame, others: Frame, *, trace: Trace, track: Any = None, **run_options: Any
    ) -> Estimate:
        """The estimate of ``method(reference, others)``; the dense maps are stored in ``trace["dense"]``.

        Args:
            method, reference, others: as :func:`dhtorch.pipeline.completion.complete_depth` takes them.
            trace: receives the intermediate results of the method.
            track: another function for the method's stage 4; None = its own.
            run_options: ``seed``, ``fit`` and ``hint``.
        """
        method = method if track is None else method.replace(track=track)
        complete_options: dict[str, Any] = {**self.options, "calibration": self.calibration, **run_options}
        trace["dense"] = complete_depth(reference, others, method=method, trace=trace, **complete_options)
        joint: Estimate = trace["fused"]
        return joint


@dataclass(frozen=True, eq=False)
class StoredSweep:
    """The swept and filled pixels of one frame's map (B = 1), stored in a file."""

    file: IO[bytes]
    offset: int
    hw: tuple[int, int]
    n: int  # number of pixels that are kept
    n_filled: int  # those of them that are filled

    def read(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Depth and sigma in m, score, and SWEPT or FILLED, (1, h, w) each, float32; 0 in other pixels."""
        self.file.seek(self.offset)
        h, w = self.hw
        stored = np.frombuffer(self.file.read(4 * h * w * 2), np.float16).reshape(4, 1, h, w)
        depth, sigma, score, source = torch.from_numpy(stored.astype(np.float32))
        return depth, sigma, score, source


class SweepStore:
    """Temporary file with the dense maps of a recording, deleted when no reference to it is left.

    Disk: eight bytes a pixel. A killed process leaves no file behind.
    """

    def __init__(self, folder: Path | None = None) -> None:
        """Args: folder: of the file, created with the first map; None = the system's folder for temporary files."""
        self._folder = folder
        self._file: IO[bytes] | None = None

    def put(self, depth_map: DepthMap, *, edge_rel: float = 0.1) -> StoredSweep:
        """Store the swept and filled pixels of a map (B = 1), except beside a depth step of more than ``edge_rel``.

        Pixels there without a return were fitted in a window that reaches over the step, and may belong to either side.
        """
        if self._file is None:
            if self._folder is not None:
                self._folder.mkdir(parents=True, exist_ok=True)
            self._file = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115  (it lives as long as the store)
        depth = torch.where(depth_map.keep, depth_map.depth, 0.0)
        keep = depth_map.keep & is_estimated(depth_map.source) & (depth_step_rel(depth) <= edge_rel)
        filled = depth_map.source == Source.FILLED
        source = torch.where(filled, Source.FILLED, Source.SWEPT)
        values = torch.cat((depth, depth_map.sigma, depth_map.score, source))
        stored = torch.where(keep, values, 0.0).cpu().numpy().astype(np.float16)
        offset = self._file.seek(0, 2)
        self._file.write(stored.tobytes())
        counts = int(keep.sum()), int((keep & filled).sum())
        return StoredSweep(self._file, offset, (depth.shape[-2], depth.shape[-1]), *counts)


def depth_step_rel(
    depth: Tensor,  # (B, h, w) m, 0 = none
) -> Tensor:
    """Farthest over nearest depth in 3×3 pixels, minus one, (B, h, w); pixels without depth do not count."""
    far = window_extreme(depth, 1, torch.maximum)
    inverse = torch.where(depth > 0, 1 / torch.where(depth > 0, depth, 1.0), 0.0)
    return far * window_extreme(inverse, 1, torch.maximum) - 1
