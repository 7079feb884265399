"""Orientation of depth maps beside their pictures: the eight symmetries of a rectangle, scored by coinciding edges.

A *symmetry* ``k`` in 0…7 is applied to stored depth: mirrored left to right if k ≥ 4, then turned by k mod 4 quarter
turns clockwise. ``SYMMETRY_NAMES`` has their names.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import cv2
import numpy as np
import torch
from torch import Tensor

from dhtorch.data.convert import rot90_image

#: What is done to a stored map, by symmetry.
SYMMETRY_NAMES: Final = (
    "as stored",
    "turned by 90 degrees",
    "turned by 180 degrees",
    "turned by 270 degrees",
    "mirrored left to right",
    "mirrored and turned by 90 degrees",
    "mirrored upside down",
    "mirrored and turned by 270 degrees",
)

#: Longer side of the grid on which edges are compared, px; limits the sharpness of edges, about that of LiDAR maps.
#: Source: chosen on the captures of tests/data/test_orientation.py (80 and 320 were no better).
_GRID_PX = 160
#: Standard deviation of the blur before the gradients, px of the grid: tolerance of colour beside depth.
#: Source: chosen on the same captures; between 0.7 and 2.5 the share of right answers varies by 3 %.
_BLUR_PX = 1.0
#: Edge strength up to which a pixel counts, in mean strengths: one silhouette must not decide alone.
#: Source: as :data:`_BLUR_PX`.
_MAX_EDGE_STRENGTH = 3.0
#: Grey value, of 255, added before the logarithm: noise of dark pixels makes no edges. Source: origin not recorded.
_DARK_OFFSET = 16.0
#: Share of a grid pixel's neighbourhood that must have returns. Source: origin not recorded.
_MIN_COVERAGE = 0.5
#: Least lead of the best symmetry's mean score over the second one's for a decision.
#: Source: chosen on the same captures: no wrong decision on three or more of their frames.
MIN_ORIENTATION_LEAD = 0.04


def apply_symmetry(x: Tensor, k: int) -> Tensor:
    """Map or picture (…, h, w) under symmetry ``k`` → (…, h, w) or (…, w, h)."""
    return rot90_image(x.flip(-1) if k >= 4 else x, k % 4)


def orientation_scores(
    image: Tensor,  # (C, H, W), C 1 or 3; float in [0, 1] or uint8
    depth: Tensor,  # (h, w) m, 0 = no return; any size
) -> Tensor:
    """Agreement (8,) in [−1, 1] of the picture's edges with the edges of the depth map under each symmetry.

    Both are resampled to one grid over the whole field of view. An edge is a vector (strength, strength · cos 2a,
    strength · sin 2a) with the direction a of its gradient; the score is the correlation coefficient of these vectors
    over pixels with returns. A map of another aspect ratio is stretched. One frame decides rarely against the truth
    (3 of 70), several nearly never: average the scores of a few frames.
    """
    grey = image.float().mean(0) * (1.0 if image.dtype == torch.uint8 else 255.0)
    scale = _GRID_PX / max(grey.shape)
    hw = max(2, round(grey.shape[0] * scale)), max(2, round(grey.shape[1] * scale))
    log_grey = np.log(_resample(grey.numpy(), hw) + _DARK_OFFSET)
    picture = _edge_vectors(_blur(log_grey), np.ones(hw, bool))
    scores = []
    for k in range(len(SYMMETRY_NAMES)):
        log_depth, covered = _smooth_log_depth(apply_symmetry(depth, k).numpy(), hw)
        scores.append(_correlation(picture, _edge_vectors(log_depth, covered), covered))
    return torch.tensor(scores, dtype=torch.float64)


def select_symmetry(
    frames: Iterable[tuple[Tensor, Tensor]],  # image and depth of a few frames, as orientation_scores
    candidates: Sequence[int] = range(8),
) -> tuple[int | None, Tensor]:
    """(symmetry of the depth that the edges support clearly best, None = undecided; mean scores (8,) of the frames)."""
    scores = torch.stack([orientation_scores(image, depth) for image, depth in frames]).mean(0)
    first, second = sorted(candidates, key=lambda k: -float(scores[k]))[:2]
    return (first if scores[first] - scores[second] >= MIN_ORIENTATION_LEAD else None), scores


def _resample(x: np.ndarray, hw: tuple[int, int]) -> np.ndarray:
    """Map (h, w) averaged or interpolated to the size ``hw``."""
    return np.asarray(cv2.resize(x.astype(np.float32), hw[::-1], interpolation=cv2.INTER_AREA))


def _blur(x: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.GaussianBlur(x, (0, 0), _BLUR_PX))


def _smooth_log_depth(depth: np.ndarray, hw: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Logarithm (h, w) of the mean inverse depth of the returns near each grid pixel, and the mask of covered ones."""
    has_return = depth > 0
    inverse = np.where(has_return, 1 / np.where(has_return, depth, 1), 0)
    total, coverage = (_blur(_resample(x, hw)) for x in (inverse, has_return))
    enough = coverage > _MIN_COVERAGE
    log_depth = np.log(np.where(enough, total / np.maximum(coverage, 1e-6), 1) + 1e-9)
    inner = cv2.erode(enough.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0  # gradients do not touch gaps
    return log_depth, inner


def _edge_vectors(x: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(3, h, w) capped strength of the gradient times (1, cos 2a, sin 2a); 0 outside the mask."""
    gy, gx = np.gradient(x)
    strength = np.where(mask, np.hypot(gx, gy), 0)
    mean = strength[mask].mean() if mask.any() else 0.0
    capped = np.minimum(strength, _MAX_EDGE_STRENGTH * mean)
    square = np.maximum(strength * strength, 1e-18)
    return capped * np.stack((np.ones_like(gx), (gx * gx - gy * gy) / square, 2 * gx * gy / square))


def _correlation(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float:
    """Correlation coefficient of two vector fields (3, h, w) over a mask; 0 where one of them is constant."""
    if not mask.any():
        return 0.0
    a, b = (x[:, mask] - x[:, mask].mean(-1, keepdims=True) for x in (a, b))
    return float((a * b).sum() / max(float(np.sqrt((a * a).sum() * (b * b).sum())), 1e-12))
