"""How a map is usually put into metres: one scale, or a scale and a shift, from pixels where both are known."""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.geometry.checks import check

#: Trials of RANSAC, and the relative miss up to which a pixel agrees.
_N_RANSAC_TRIALS, _MAX_INLIER_ERROR = 200, 0.05


def fit_median_scale(x: Tensor, z: Tensor) -> tuple[float, float]:
    """Scale that makes the median ratio one, shift 0; (n,) each, NaN of nothing."""
    check("fit_median_scale", x=(x, "n"), z=(z, "n"))
    return (float((z / x).median()), 0.0) if len(x) else (float("nan"), 0.0)


def fit_scale_shift(x: Tensor, z: Tensor) -> tuple[float, float]:
    """Scale and shift of the least squares of ``s x + t − z``, (n,) each; NaN of fewer than two points."""
    check("fit_scale_shift", x=(x, "n"), z=(z, "n"))
    if len(x) < 2:
        return float("nan"), float("nan")
    A = torch.stack((x, torch.ones_like(x)), -1).double()
    s, t = torch.linalg.lstsq(A, z.double()[:, None]).solution[:, 0].tolist()
    return s, t


def fit_scale_shift_ransac(x: Tensor, z: Tensor, *, seed: int = 0) -> tuple[float, float]:
    """Scale and shift that most points agree with, then least squares of these; (n,) each."""
    check("fit_scale_shift_ransac", x=(x, "n"), z=(z, "n"))
    if len(x) < 2:
        return float("nan"), float("nan")
    draw = torch.randint(len(x), (_N_RANSAC_TRIALS, 2), generator=torch.Generator().manual_seed(seed))
    (x0, x1), (z0, z1) = x[draw].double().unbind(-1), z[draw].double().unbind(-1)
    s = (z1 - z0) / torch.where(x1 == x0, torch.nan, x1 - x0)
    t = z0 - s * x0
    agrees = (s[:, None] * x + t[:, None] - z).abs() < _MAX_INLIER_ERROR * z
    best = agrees[agrees.sum(-1).argmax()]
    return fit_scale_shift(x[best], z[best])
