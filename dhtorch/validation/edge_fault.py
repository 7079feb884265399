"""Fault of a window's depth beside its pictures that coinciding edges show: mirrored, rolled, or not registered.

Depth steps are mostly edges of the picture, too. Each fault of :mod:`dhtorch.validation.faults` that moves depth within
the picture is undone in a few frames; the one under which edges coincide clearly better is the finding. Unlike tracks
against near returns this needs no motion, and works where motion is too large to be tracked.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import torch
from torch import Tensor

from dhtorch.data.orientation import edge_correlation, log_depth_edges, picture_edges, smooth_log_depth
from dhtorch.geometry import camera as cam
from dhtorch.records import Frame
from dhtorch.validation.edge_lag import clear_lead, depth_over_picture
from dhtorch.validation.faults import KNOWN_FAULTS, NO_FAULT, KnownFault

#: Kinds of faults that are tried.
_KINDS: Final = ("mirrored", "rolled", "registration")

#: Frames that are examined, evenly spread. Limits the time to about a second. Source: origin not recorded.
_MAX_FRAMES: Final = 6

#: Fewest frames. Source: derived, as the orientation of files, where three
#: frames never decided wrongly.
_MIN_FRAMES: Final = 3

#: Longer side of the grid on which edges are compared, px. Source: derived, as :mod:`dhtorch.data.orientation`.
_GRID_PX: Final = 160

#: A fault is reported if the mean correlation of edges with it undone exceeds that without by this.
#: Source: chosen on the sound captures of the shared data (at most 0.03: 7-Scenes, whose depth lies some pixels beside
#: its pictures) and on planted faults.
_MIN_LEAD: Final = 0.05


def find_edge_fault(frames: Sequence[Frame]) -> KnownFault | None:
    """Frames (B = 1 each, with pictures and depth) -> the fault of their depth that edges show. Gradient: none."""
    reduced = _ReducedFrames.of(frames)
    if reduced is None:
        return None
    without = reduced.scores(NO_FAULT)
    best, best_lead = None, 0.0
    for fault in KNOWN_FAULTS:
        if fault.kind not in _KINDS:
            continue
        lead = clear_lead(reduced.scores(fault) - without, _MIN_LEAD)
        if lead > best_lead:
            best, best_lead = fault, lead
    return best


def do_edges_refute(frames: Sequence[Frame], fault: KnownFault) -> bool:
    """Whether edges coincide clearly better without a fault than with it undone. Gradient: none."""
    reduced = _ReducedFrames.of(frames) if fault.kind in _KINDS else None
    return reduced is not None and clear_lead(reduced.scores(NO_FAULT) - reduced.scores(fault), _MIN_LEAD) > 0


class _ReducedFrames(NamedTuple):
    """A few frames on the grid on which edges are compared: faults are undone there, not on the stored maps."""

    pictures: Sequence[Tensor]  # edge vectors (3, h, w) of each
    frames: Sequence[Frame]  # their ``depth`` (1, h, w) is the smoothed logarithm of depth
    covered: Sequence[Tensor]  # (1, h, w) 1 where it has values, else 0

    @classmethod
    def of(cls, frames: Sequence[Frame]) -> _ReducedFrames | None:
        """Up to :data:`_MAX_FRAMES` spread ones, each once; None of too few."""
        places = [round(k * (len(frames) - 1) / (_MAX_FRAMES - 1)) for k in range(_MAX_FRAMES)] if frames else []
        chosen = list({id(frames[place]): frames[place] for place in places}.values())
        if len(chosen) < _MIN_FRAMES:
            return None
        with torch.no_grad():
            pictures = [picture_edges(frame.image[0], grid_px=_GRID_PX) for frame in chosen]
            reduced = [_reduce(frame, picture) for frame, picture in zip(chosen, pictures, strict=True)]
        return cls(pictures, [frame for frame, _ in reduced], [covered for _, covered in reduced])

    def scores(self, fault: KnownFault) -> Tensor:
        """Correlation (n,) of edges of the pictures with those of the frames' depth with a fault undone."""
        scores = []
        for picture, frame, covered in zip(*self, strict=True):
            log_depth, mask = (depth_over_picture(frame, fault.undo(x)) for x in (frame.depth, covered))
            scores.append(edge_correlation(picture, *log_depth_edges(log_depth, mask > 0)))
        return torch.tensor(scores, dtype=torch.float64)


def _reduce(frame: Frame, picture: Tensor) -> tuple[Frame, Tensor]:
    """A frame with its depth smoothed to the grid (3, h, w) of its picture's edges, and the mask of its values."""
    hw = picture.shape[-2], picture.shape[-1]
    log_depth, covered = smooth_log_depth(frame.depth[0], hw)
    stored_hw = frame.depth.shape[-2], frame.depth.shape[-1]
    depth_camera = None if frame.depth_camera is None else cam.resize(frame.depth_camera, stored_hw, hw)
    return frame.replace(depth=log_depth[None], depth_camera=depth_camera), covered[None].float()
