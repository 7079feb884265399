"""Confidence and error of answers -> the area under their risk–coverage curve, with ranks that have a gradient."""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.geometry.checks import check


def risk_coverage_loss(
    confidence: Tensor,  # (B, N), any numbers that order the answers of a set, such as -ln(expected error)
    error: Tensor,  # (B, N) relative error, counted as 1 where larger
    keep: Tensor | None = None,  # (B, N) bool, answers that count
    *,
    temperature: float = 0.1,
) -> Tensor:
    """Confidences and errors -> area (B,) under the risk–coverage curve of each set, least in the order of the errors.

    The risk of the surest k answers is their mean error, and the area the mean risk over all k: an error at rank r
    counts with (1/r + 1/(r + 1) + … + 1/n) / n. Here a rank is 1 plus the sum of sigmoid(Δconfidence / temperature)
    over the other answers; for a temperature towards 0 and confidences without ties the area is ``aurc`` of
    :func:`dhtorch.metrics.risk.measure_risk`.

    Args:
        confidence, error: of the answers of B sets, such as pairs or scenes.
        keep: answers that count; None = all.
        temperature: difference of confidence at which two answers are ordered with weight 0.73 instead of 1.

    Returns:
        (B,) area, 0 for a set without answers. For the geometric mean over sets minimise the mean of its logarithm.

    Raises:
        ValueError: wrong shapes, or a temperature that is not positive.

    Gradient: to both; 0 from answers that do not count, and to the error where it is larger than 1.
    Memory: B · N².
    Source: derived, the area of Y. Geifman, G. Uziel, R. El-Yaniv, "Bias-reduced uncertainty estimation", 2019, as a
    sum over answers; soft ranks as in T. Qin, T. Liu, H. Li, "A general approximation framework for direct optimization
    of information retrieval measures", 2010.
    """
    check("risk_coverage_loss", confidence=(confidence, "B N"), error=(error, "B N"), keep=(keep, "B N"))
    if not temperature > 0:
        raise ValueError(f"risk_coverage_loss: temperature is {temperature}, expected a positive number")
    used = torch.ones_like(error, dtype=torch.bool) if keep is None else keep
    c = torch.where(used, confidence, 0)
    e = torch.where(used, error, 0).clamp(max=1)
    n = used.sum(-1, keepdim=True).to(c)
    ahead = ((c[..., None, :] - c[..., :, None]) / temperature).sigmoid()
    others = used[..., None, :] & ~torch.eye(c.shape[-1], dtype=torch.bool, device=c.device)
    rank = 1 + torch.where(others, ahead, 0).sum(-1)
    weight = torch.digamma(n + 1) - torch.digamma(torch.where(used, rank, 1))
    return torch.where(used, e * weight, 0).sum(-1) / n[..., 0].clamp_min(1)
