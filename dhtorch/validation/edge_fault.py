"""Fault of a window's depth beside its pictures that coinciding edges show: mirrored, rolled, or not registered.

Depth steps are mostly edges of the picture, too. Each fault of :mod:`dhtorch.validation.faults` that moves depth within
the picture is undone in a few frames; the one under which edges coincide clearly better is the finding. Unlike tracks
against near returns this needs no motion, and works where motion is too large to be tracked.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch
from torch import Tensor

from dhtorch.data.orientation import depth_edges, edge_correlation, picture_edges
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
    inputs = _reduced_frames(frames)
    if inputs is None:
        return None
    without = _scores(*inputs, NO_FAULT)
    best, best_lead = None, 0.0
    for fault in KNOWN_FAULTS:
        if fault.kind not in _KINDS:
            continue
        lead = clear_lead(_scores(*inputs, fault) - without, _MIN_LEAD)
        if lead > best_lead:
            best, best_lead = fault, lead
    return best


def do_edges_refute(frames: Sequence[Frame], fault: KnownFault) -> bool:
    """Whether edges coincide clearly better without a fault than with it undone. Gradient: none."""
    inputs = _reduced_frames(frames) if fault.kind in _KINDS else None
    if inputs is None:
        return False
    return clear_lead(_scores(*inputs, NO_FAULT) - _scores(*inputs, fault), _MIN_LEAD) > 0


def _reduced_frames(frames: Sequence[Frame]) -> tuple[list[Tensor], list[Frame]] | None:
    """Edges of pictures and their frames, up to :data:`_MAX_FRAMES` spread ones, each once; None of too few."""
    spread = [frames[round(k * (len(frames) - 1) / (_MAX_FRAMES - 1))] for k in range(_MAX_FRAMES)] if frames else []
    chosen = list({id(frame): frame for frame in spread}.values())
    if len(chosen) < _MIN_FRAMES:
        return None
    with torch.no_grad():
        pictures = [picture_edges(frame.image[0], grid_px=_GRID_PX) for frame in chosen]
    return pictures, [_coarse(frame) for frame in chosen]


def _coarse(frame: Frame) -> Frame:
    """A frame with every k-th value of its depth, so that the longer side has at least twice the grid's."""
    if frame.depth_camera is not None:
        return frame
    step = max(1, max(frame.depth.shape[-2:]) // (2 * _GRID_PX))
    return frame.replace(depth=frame.depth[..., ::step, ::step])


def _scores(pictures: Sequence[Tensor], frames: Sequence[Frame], fault: KnownFault) -> Tensor:
    """Correlation (n,) of edges of pictures with those of the frames' depth with a fault undone."""
    hw = pictures[0].shape[-2], pictures[0].shape[-1]
    with torch.no_grad():
        edges = [depth_edges(depth_over_picture(frame, fault.undo(frame.depth)), hw) for frame in frames]
    scores = [edge_correlation(picture, *each) for picture, each in zip(pictures, edges, strict=True)]
    return torch.tensor(scores, dtype=torch.float64)
