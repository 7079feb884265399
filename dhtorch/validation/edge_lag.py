"""Lag between the depth and the pictures of a window: edges of the depth of another frame coincide better.

Works without poses and without texture on surfaces, where the picture moves by a pixel of the grid per frame or more.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Final, NamedTuple

import torch
from torch import Tensor

from dhtorch.data.orientation import correlation_of_sums, depth_edges, edge_correlations, picture_edges
from dhtorch.geometry import camera as cam
from dhtorch.geometry.patches import sample_nearest
from dhtorch.pipeline.dense import map_pixel_centres
from dhtorch.records import Frame
from dhtorch.validation.faults import MAX_LAG_FRAMES

#: Longer side of the grid on which edges are compared, px.
#: Source: chosen on lags planted into holo_a, 7-Scenes and desk9 (160 misses lags of one frame).
_GRID_PX: Final = 320

#: A lag is reported if the mean correlation of edges exceeds that without lag by this.
#: Source: chosen on the sound captures of the shared data: at most 0.030 (7-Scenes, whose depth lies
#: some pixels beside its pictures), and on planted lags of one frame: at least 0.042 where pictures move 3 px a frame.
_MIN_LEAD: Final = 0.038

#: Least lead in standard errors over the frames. Source: origin not recorded.
_MIN_LEAD_ERRORS: Final = 4.0

#: Shifts of depth beside its pictures that are no lag, px of the grid: up to 6 px of a picture 640 wide.
#: Source: chosen on 7-Scenes, whose depth is not registered exactly.
_SHIFTS_PX: Final = (-3, -1, 0, 1, 3)

#: Frames that are compared under all shifts. Limits the time. Source: origin not recorded.
_MAX_SHIFTED_FRAMES: Final = 5

#: Fewest frames with both a picture and the depth of another frame. Source: origin not recorded.
_MIN_FRAMES: Final = 4


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
        if lag == 0 or len(places) < _MIN_FRAMES:
            continue
        lead = scores[places, [i + lag for i in places]] - scores[places, places]
        if (mean := clear_lead(lead, _MIN_LEAD)) > best.lead:
            best = EdgeLag(lag, mean)
    if best.lag == 0:
        return best
    places = [i for i in range(n) if 0 <= i + best.lag < n]
    places = places[:: max(1, len(places) // _MAX_SHIFTED_FRAMES)]
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


def clear_lead(lead: Tensor, least: float, errors: float = _MIN_LEAD_ERRORS) -> float:
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
