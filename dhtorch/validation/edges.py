"""Faults of a window's depth beside its pictures that coinciding edges show: a lag; mirrored, rolled, not registered.

Depth steps are mostly edges of the picture, too. Under a lag, edges of the depth of another frame coincide better: this
works without poses and without texture on surfaces, where the picture moves by a pixel of the grid per frame or more.
Each fault of :mod:`dhtorch.validation.faults` that moves depth within the picture is undone in a few frames; the one
under which edges coincide clearly better is the finding. Unlike tracks against near returns this needs no motion, and
works where motion is too large to be tracked.
"""

import itertools
from collections.abc import Sequence
from typing import Final, NamedTuple

import torch
from torch import Tensor

from dhtorch.data.orientation import (
    correlation_of_sums,
    depth_edges,
    edge_correlation,
    edge_correlations,
    log_depth_edges,
    picture_edges,
    smooth_log_depth,
)
from dhtorch.geometry import camera as cam
from dhtorch.geometry.patches import sample_nearest
from dhtorch.pipeline.dense import map_pixel_centres
from dhtorch.records import Frame
from dhtorch.validation.faults import KNOWN_FAULTS, MAX_LAG_FRAMES, NO_FAULT, KnownFault

#: Longer side of the grid on which edges are compared, px.
#: Source: chosen on lags planted into holo_a, 7-Scenes and desk9 (160 misses lags of one frame).
_GRID_PX: Final = 320

#: A lag is reported if the mean correlation of edges exceeds that without lag by this.
#: Source: chosen on the sound captures of the shared data: at most 0.030 (7-Scenes, whose depth lies
#: some pixels beside its pictures), and on planted lags of one frame: at least 0.042 where pictures move 3 px a frame.
_MIN_LEAD: Final = 0.038

#: A fault that moves depth within the picture is reported if the mean correlation with it undone exceeds that without
#: by this. Source: chosen on the sound captures of the shared data (at most 0.03: 7-Scenes, whose depth lies some
#: pixels beside its pictures) and on planted faults.
_MIN_FAULT_LEAD: Final = 0.05

#: Kinds of these faults.
_KINDS: Final = ("mirrored", "rolled", "registration")

#: Shifts of depth beside its pictures that are no lag, px of the grid: up to 6 px of a picture 640 wide.
#: Source: chosen on 7-Scenes, whose depth is not registered exactly.
_SHIFTS_PX: Final = (-3, -1, 0, 1, 3)


class EdgeLag(NamedTuple):
    """Lag with the best coinciding edges."""

    lag: int  # frames by which depth comes late; 0 = no clear lead of another lag
    lead: float  # of its mean correlation over that without lag


def find_edge_lag(frames: Sequence[Frame]) -> EdgeLag:
    """Consecutive frames (B = 1 each, with pictures) -> lag of their depth. Gradient: none."""
    with torch.no_grad():
        pictures = torch.stack([picture_edges(frame.image[0], grid_px=_GRID_PX) for frame in frames])
        hw = pictures.shape[-2], pictures.shape[-1]
        depths = [depth_edges(depth_over_picture(frame, frame.depth), hw) for frame in frames]
        edges, covered = (torch.stack(each) for each in zip(*depths, strict=True))
        scores = edge_correlations(pictures, edges, covered)
    n = len(frames)
    best = EdgeLag(0, 0.0)
    for lag in range(-MAX_LAG_FRAMES, MAX_LAG_FRAMES + 1):
        places = [i for i in range(n) if 0 <= i + lag < n]
        if lag == 0 or len(places) < 4:
            continue
        lead = scores[places, [i + lag for i in places]] - scores[places, places]
        if (mean := clear_lead(lead, _MIN_LEAD)) > best.lead:
            best = EdgeLag(lag, mean)
    if best.lag == 0:
        return best
    places = [i for i in range(n) if 0 <= i + best.lag < n]
    places = places[:: max(1, len(places) // 5)]  # limits the time
    late, now = (
        torch.stack([_shifted_scores(pictures[i], edges[i + by], covered[i + by]) for i in places])
        for by in (best.lag, 0)
    )
    shifted_lead = late[:, int(late.mean(0).argmax())] - now[:, int(now.mean(0).argmax())]
    return best if clear_lead(shifted_lead, _MIN_LEAD) > 0 else EdgeLag(0, 0.0)


def depth_over_picture(frame: Frame, depth: Tensor) -> Tensor:
    """Depth (1, h, w) m as stored in a frame (B = 1) -> (h, w) over the field of view of the picture, 0 outside.

    The frame's depth camera is used where it has one. Gradient: to the depth.
    """
    if frame.depth_camera is None:
        return depth[0]
    h, w = depth.shape[-2:]
    rays = cam.rays(frame.camera, map_pixel_centres(frame, (h, w))[None])
    value, inside = sample_nearest(depth, cam.project(frame.depth_camera, rays))
    return torch.where(inside, value, 0.0).view(h, w)


def clear_lead(lead: Tensor, least: float, errors: float = 4.0) -> float:
    """Mean lead (n,) of one hypothesis over another in n frames where it is above ``least`` and ``errors``, else 0.

    The error is the standard error of the mean. Gradient: none.
    """
    mean = float(lead.mean())
    error = float(lead.std()) / len(lead) ** 0.5
    return mean if mean > max(least, errors * error) else 0.0


def _shifted_scores(picture: Tensor, edges: Tensor, covered: Tensor) -> Tensor:
    """Correlations (shifts,) of edges of a picture with those of depth moved by up to 3 px each way.

    Depth that lies some pixels beside its pictures looks late or early while the camera moves steadily: a lag counts
    only beyond what one shift of all frames explains. The sums of :func:`edge_correlations` under all shifts at once,
    by Fourier transforms.
    """
    mask = covered.to(edges.dtype)
    rows, columns = zip(*itertools.product(_SHIFTS_PX, repeat=2), strict=True)

    def sums(a: Tensor, b: Tensor) -> Tensor:
        """Sums (..., shifts) over the pixels of a times shifted b, (..., h, w) each."""
        spectrum = torch.fft.rfft2(a) * torch.fft.rfft2(b).conj()
        return torch.fft.irfft2(spectrum, s=a.shape[-2:])[..., rows, columns].double()

    edges = edges * mask
    count = mask.sum().double().clamp_min(1)
    sum_a = sums(picture, mask).T
    sum_b = edges.sum((1, 2)).double()
    square_a = sums(picture.square().sum(0), mask)
    square_b = edges.square().sum().double()
    return correlation_of_sums(count, sum_a, sum_b, square_a, square_b, sums(picture, edges).sum(0))


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
        lead = clear_lead(reduced.scores(fault) - without, _MIN_FAULT_LEAD)
        if lead > best_lead:
            best, best_lead = fault, lead
    return best


def do_edges_refute(frames: Sequence[Frame], fault: KnownFault) -> bool:
    """Whether edges coincide clearly better without a fault than with it undone. Gradient: none."""
    reduced = _ReducedFrames.of(frames) if fault.kind in _KINDS else None
    return reduced is not None and clear_lead(reduced.scores(NO_FAULT) - reduced.scores(fault), _MIN_FAULT_LEAD) > 0


class _ReducedFrames(NamedTuple):
    """A few frames on the grid on which edges are compared: faults are undone there, not on the stored maps."""

    pictures: Sequence[Tensor]  # edge vectors (3, h, w) of each
    frames: Sequence[Frame]  # their ``depth`` (1, h, w) is the smoothed logarithm of depth
    covered: Sequence[Tensor]  # (1, h, w) 1 where it has values, else 0

    @classmethod
    def of(cls, frames: Sequence[Frame]) -> "_ReducedFrames | None":
        """Six of them (about a second), evenly spread, each once; None of fewer than three, which decide wrongly."""
        places = [round(k * (len(frames) - 1) / 5) for k in range(6)] if frames else []
        chosen = list({id(frames[place]): frames[place] for place in places}.values())
        if len(chosen) < 3:
            return None
        with torch.no_grad():
            pictures = [picture_edges(frame.image[0], grid_px=160) for frame in chosen]  # as dhtorch.data.orientation
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
