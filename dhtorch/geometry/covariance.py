"""From normal equations to what they say about the estimate.

Alphabet: ``H`` = Σ w Jᵀ J in px² per tangent unit², ``xi`` = (rotation rad, translation m), left perturbation.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.geometry.least_squares import solve_spd
from dhtorch.geometry.shapes import check


def from_normal(
    H: Tensor,  # (B, n, n)
    sigma: Tensor,  # (B,) standard deviation of one residual coordinate
) -> tuple[Tensor, Tensor]:
    """Covariance sigma² H⁻¹ (B, n, n) and ``ok`` (B,); zero where H is singular.

    First-order: right for small residuals, with weights that are relative inverse variances.

    Gradient: to H and sigma. Raises ValueError for wrong shapes.
    """
    check("from_normal", H=(H, "B n n"), sigma=(sigma, "B"))
    eye = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device).expand_as(H)
    inverse, ok = solve_spd(H, eye)
    inverse = 0.5 * (inverse + inverse.transpose(1, 2))
    return inverse * (sigma * sigma)[:, None, None], ok


def mahalanobis(
    x: Tensor,  # (B, n)
    cov: Tensor,  # (B, n, n)
) -> Tensor:
    """Length (B,) of x in standard deviations, sqrt(xᵀ Σ⁻¹ x); 0 where Σ is singular.

    Gradient: to x and cov, except at x = 0. Raises ValueError for wrong shapes.
    """
    check("mahalanobis", x=(x, "B n"), cov=(cov, "B n n"))
    whitened, _ = solve_spd(cov, x[..., None])
    return (x * whitened[..., 0]).sum(-1).clamp_min(0).sqrt()
