"""Pearson's and Spearman's correlation coefficients of two flat lists; None where undefined."""

import torch
from torch import Tensor


def pearson(x: Tensor, y: Tensor) -> float | None:
    """Pearson's r of two (P,) lists; None with fewer than two values or without spread."""
    if x.numel() < 2:
        return None
    x, y = x - x.mean(), y - y.mean()
    scale = float((x * x).sum().sqrt() * (y * y).sum().sqrt())
    return float((x * y).sum()) / scale if scale > 0 else None


def spearman(x: Tensor, y: Tensor) -> float | None:
    """Spearman's rank correlation of two (P,) lists: Pearson's of their ranks."""
    return pearson(_ranks(x), _ranks(y))


def _ranks(x: Tensor) -> Tensor:
    """Ranks (P,) float64 from 0, ties by their mean."""
    values, group = torch.unique(x, return_inverse=True)
    count = torch.bincount(group, minlength=values.numel()).double()
    return (count.cumsum(0) - (count + 1) / 2)[group]
