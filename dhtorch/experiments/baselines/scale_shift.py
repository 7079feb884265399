"""Usual metric alignments of a depth map: scale, or scale and shift, from pixels with depth of both."""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.geometry.checks import check

#: Number of RANSAC trials.
_N_RANSAC_TRIALS = 200

#: Largest relative error of an inlier.
_MAX_INLIER_ERROR = 0.05


def fit_median_scale(x: Tensor, z: Tensor) -> tuple[float, float]:
    """Map values x and depths z, (n,) each → (scale with median ratio one, shift 0); scale NaN without points."""
    check("fit_median_scale", x=(x, "n"), z=(z, "n"))
    return (float((z / x).median()), 0.0) if len(x) else (float("nan"), 0.0)


def fit_scale_shift(x: Tensor, z: Tensor) -> tuple[float, float]:
    """Map values x and depths z, (n,) each → (s, t) minimising Σ(s x + t − z)²; NaN with fewer than two points."""
    check("fit_scale_shift", x=(x, "n"), z=(z, "n"))
    if len(x) < 2:
        return float("nan"), float("nan")
    A = torch.stack((x, torch.ones_like(x)), -1).double()
    s, t = torch.linalg.lstsq(A, z.double()[:, None]).solution[:, 0].tolist()
    return s, t


def fit_scale_shift_ransac(x: Tensor, z: Tensor, *, seed: int = 0) -> tuple[float, float]:
    """Map values x and depths z, (n,) each → (s, t) by RANSAC, refined by least squares on the inliers."""
    check("fit_scale_shift_ransac", x=(x, "n"), z=(z, "n"))
    if len(x) < 2:
        return float("nan"), float("nan")
    draw = torch.randint(len(x), (_N_RANSAC_TRIALS, 2), generator=torch.Generator().manual_seed(seed))
    (x0, x1), (z0, z1) = x[draw].double().unbind(-1), z[draw].double().unbind(-1)
    s = (z1 - z0) / torch.where(x1 == x0, torch.nan, x1 - x0)
    t = z0 - s * x0
    inlier = (s[:, None] * x + t[:, None] - z).abs() < _MAX_INLIER_ERROR * z
    best = inlier[inlier.sum(-1).argmax()]
    return fit_scale_shift(x[best], z[best])
