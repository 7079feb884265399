"""Stage 7, how sure: the selective score and its threshold, which is the last gate."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from dhtorch.codes import Gate
from dhtorch.geometry.shapes import check
from dhtorch.records import Estimate, PoseFit, Samples, Tracks

#: The pose's part of a variance is subtracted from the whole; no own part is believed to be a smaller share of it.
OWN_SHARE = 1e-6

#: Relative errors and ratios beyond these limits are not told apart: their squares stay in the range of float32.
SMALLEST, LARGEST = 1e-6, 1e6


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
    return _silence(estimate, score, min_score)


def rank_by_error(
    estimate: Estimate,
    samples: Samples,
    tracks: Tracks,
    fit: PoseFit,
    *,
    residual_scale_px: float = 0.5,
    photometric_scale: float | None = None,
    round_trip_scale_px: float | None = 0.4,
    half_error: float = 0.1,
    recalibration: Callable[[Tensor], Tensor] | None = None,
    min_score: float = 0.0,
) -> Estimate:
    """Score every answer by the relative error to expect of it: h / (h + e).

    e = (own part of sigma) / depth · sqrt(1 + (r / s)² + …): how far the depth moves with the noise of its own track,
    more where the track disagrees with the pose. The part of sigma that all points of the pair share belongs in the
    sigma that is reported; it says how good the pair is, not which of its points are better, and stays out.

    Args:
        estimate: from seat 6, with ``sigma``, ``sigma_shared`` and ``residual_px``.
        samples, fit: part of the seat's signature; this score does not read them.
        tracks: with ``photometric`` and ``error``, where a scale asks for them.
        residual_scale_px: reprojection residual s that counts as much as the track's own noise.
        photometric_scale: grey difference of the patches that does, in grey values from 0 to 1; None = not asked.
        round_trip_scale_px: round trip that does; None = not asked.
        half_error: expected error h at which the score is one half.
        recalibration: elementwise, score → probability that the error is below 10 %, such as the table of a
            calibration (``dhtorch.calibration``); None leaves the score as it is. A rising one changes no order.
        min_score: answers below it (after recalibration) are silenced with LOW_SCORE.

    Returns:
        Estimate with ``score`` in [0, 1], 0 where silent or where no error can be stated.

    Raises:
        ValueError: wrong shapes.

    Gradient: to sigma, depth, residual and what else is asked; the threshold carries none.
    """
    check("rank_by_error", gate=(estimate.gate, "B N"), uv=(samples.uv, "B N 2"), valid=(tracks.valid, "B N"))
    terms = [(estimate.residual_px, residual_scale_px)]
    if photometric_scale is not None:
        terms.append((tracks.photometric, photometric_scale))
    if round_trip_scale_px is not None:
        terms.append((tracks.error, round_trip_scale_px))
    expected, stated = _expected_error(estimate, terms)
    zero = torch.zeros_like(expected)
    score = torch.where(stated, half_error / (half_error + expected), zero)
    if recalibration is not None:
        score = torch.where(stated, recalibration(score), zero)
    return _silence(estimate, score, min_score)


def _expected_error(estimate: Estimate, terms: list[tuple[Tensor, float]]) -> tuple[Tensor, Tensor]:
    """Relative error (B, N) to expect, from the own part of sigma and (term, scale) pairs, and where it can be said."""
    whole, shared, depth = estimate.sigma, estimate.sigma_shared, estimate.depth
    stated = estimate.keep & (depth > 0) & whole.isfinite() & shared.isfinite()
    for x, _ in terms:
        stated = stated & x.isfinite()
    one, zero = torch.ones_like(depth), torch.zeros_like(depth)
    inverse = 1 / torch.where(stated, depth, one)
    whole = (torch.where(stated, whole, one) * inverse).clamp(max=LARGEST)
    shared = (torch.where(stated, shared, zero) * inverse).clamp(max=LARGEST)
    own = torch.maximum(whole * whole - shared * shared, OWN_SHARE * whole * whole).clamp_min(SMALLEST * SMALLEST)
    spread = one
    for x, scale in terms:
        ratio = (torch.where(stated, x, zero) / scale).clamp(max=LARGEST)
        spread = spread + ratio * ratio
    return (own * spread).sqrt(), stated


def _silence(estimate: Estimate, score: Tensor, min_score: float) -> Estimate:
    """The estimate with its score; answers that score below ``min_score`` become silent."""
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
