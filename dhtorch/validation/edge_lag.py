"""Lag between the depth and the pictures of a window: edges of the depth of another frame coincide better.

Works without poses and without texture on surfaces, where the picture moves by a pixel of the grid per frame or more.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import torch

from dhtorch.data.orientation import depth_edges, edge_correlation, picture_edges
from dhtorch.records import Frame

#: Largest lag that is tried, frames. Source: derived, the largest lag of dhtorch.validation.faults.
_MAX_LAG_FRAMES: Final = 5

#: Longer side of the grid on which edges are compared, px.
#: Source: chosen on lags planted into holo_a, 7-Scenes and desk9 (160 misses lags of one frame).
_GRID_PX: Final = 320

#: A lag is reported if the mean correlation of edges exceeds that without lag by this.
#: Source: chosen on the sound captures of the shared data: at most 0.030 (7-Scenes, whose depth lies
#: some pixels beside its pictures), and on planted lags of one frame: at least 0.042 where pictures move 3 px a frame.
_MIN_LEAD: Final = 0.038

#: Least lead in standard errors over the frames. Source: origin not recorded.
_MIN_LEAD_ERRORS: Final = 4.0

#: Fewest frames with both a picture and the depth of another frame. Source: origin not recorded.
_MIN_FRAMES: Final = 4


class EdgeLag(NamedTuple):
    """Lag with the best coinciding edges."""

    lag: int  # frames by which depth comes late; 0 = no clear lead of another lag
    lead: float  # of its mean correlation over that without lag


def find_edge_lag(frames: Sequence[Frame]) -> EdgeLag:
    """Consecutive frames (B = 1 each, with pictures) -> lag of their depth. Gradient: none."""
    with torch.no_grad():
        pictures = [picture_edges(frame.image[0], grid_px=_GRID_PX) for frame in frames]
        hw = pictures[0].shape[-2], pictures[0].shape[-1]
        depths = [depth_edges(frame.depth[0], hw) for frame in frames]
    n, best = len(frames), EdgeLag(0, 0.0)

    def score(i: int, lag: int) -> float:
        return edge_correlation(pictures[i], *depths[i + lag])

    without = [score(i, 0) for i in range(n)]
    for lag in range(-_MAX_LAG_FRAMES, _MAX_LAG_FRAMES + 1):
        places = [i for i in range(n) if 0 <= i + lag < n]
        if lag == 0 or len(places) < _MIN_FRAMES:
            continue
        lead = torch.tensor([score(i, lag) - without[i] for i in places], dtype=torch.float64)
        mean, error = float(lead.mean()), float(lead.std()) / len(places) ** 0.5
        if mean > max(_MIN_LEAD, _MIN_LEAD_ERRORS * error, best.lead):
            best = EdgeLag(lag, mean)
    return best
