"""Stage 7, how sure: the selective score and its threshold, which is the last gate."""

from __future__ import annotations

import torch

from dhtorch.codes import Gate
from dhtorch.geometry.shapes import check
from dhtorch.records import Estimate, PoseFit, Samples, Tracks


def rank(
    estimate: Estimate,
    samples: Samples,
    tracks: Tracks,
    fit: PoseFit,
    *,
    half_parallax_deg: float = 2.0,
    residual_scale_px: float = 3.0,
    min_score: float = 0.0,
) -> Estimate:
    """Score every answer by its parallax and residual: p / (p + p½) · max(0, 1 − r / r₀).

    The paper describes a continuous score that rises with parallax and falls with the reprojection residual but
    prints no formula; this one, with both constants as options, is ours. The score orders answers by risk; it is not
    a probability.

    Args:
        estimate: from seat 6.
        samples, tracks, fit: part of the seat's signature; this score does not read them.
        half_parallax_deg: parallax p½ at which the first factor is one half.
        residual_scale_px: residual r₀ at which the second factor reaches zero.
        min_score: answers below it are silenced with LOW_SCORE.

    Returns:
        Estimate with ``score`` in [0, 1], 0 where silent.

    Raises:
        ValueError: wrong shapes.

    Gradient: to parallax and residual; the threshold carries none.
    Source: paper, "Selective confidence".
    """
    check("rank", gate=(estimate.gate, "B N"), uv=(samples.uv, "B N 2"), valid=(tracks.valid, "B N"))
    parallax, residual = estimate.parallax_deg, estimate.residual_px
    score = parallax / (parallax + half_parallax_deg) * (1 - residual / residual_scale_px).clamp_min(0)
    low = estimate.keep & (score < min_score)
    gate = torch.where(low, torch.full_like(estimate.gate, Gate.LOW_SCORE), estimate.gate)
    keep = gate == Gate.ANSWER
    nan = torch.full_like(estimate.depth, torch.nan)
    return estimate.replace(
        depth=torch.where(keep, estimate.depth, nan),
        sigma=torch.where(keep, estimate.sigma, nan),
        sigma_shared=torch.where(keep, estimate.sigma_shared, nan),
        score=torch.where(keep, score, torch.zeros_like(score)),
        gate=gate,
    )
