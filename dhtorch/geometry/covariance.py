"""Covariances: normal equations → covariance of an estimate, its Mahalanobis length, shape of tracks' noise.

Alphabet: ``H`` = Σ w Jᵀ J in px² per tangent unit², ``xi`` = (rotation rad, translation m), left perturbation.
"""

import torch
from torch import Tensor

from dhtorch.geometry.checks import shaped
from dhtorch.geometry.least_squares import normal_equations, solve_spd
from dhtorch.geometry.linalg import upper_triangle


@shaped("H: B n n, sigma: B")
def covariance_from_normal(
    H: Tensor,  # (B, n, n)
    sigma: Tensor,  # (B,) standard deviation of one residual coordinate
) -> tuple[Tensor, Tensor]:
    """Covariance sigma² H⁻¹ (B, n, n) and ``ok`` (B,); zero where H is singular.

    First-order: right for small residuals, with weights that are relative inverse variances.

    Gradient: to H and sigma. Raises ValueError for wrong shapes.
    """
    eye = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device).expand_as(H)
    inverse, ok = solve_spd(H, eye)
    inverse = 0.5 * (inverse + inverse.transpose(1, 2))
    return inverse * (sigma * sigma)[:, None, None], ok


@shaped("x: B n, cov: B n n")
def mahalanobis(
    x: Tensor,  # (B, n)
    cov: Tensor,  # (B, n, n)
) -> Tensor:
    """Length (B,) of x in standard deviations, sqrt(xᵀ Σ⁻¹ x); 0 where Σ is singular.

    Gradient: to x and cov, except at x = 0. Raises ValueError for wrong shapes.
    """
    whitened, _ = solve_spd(cov, x[..., None])
    return (x * whitened[..., 0]).sum(-1).clamp_min(0).sqrt()


@shaped("rows: B n 2 N, weight: B N, used: B N, group: N")
def grouped_covariance(
    rows: Tensor,  # (B, n + 1, 2, N), of linearise: n columns of the Jacobian, then the residual
    weight: Tensor,  # (B, N) ≥ 0
    used: Tensor,  # (B, N) bool, points that count in a group
    group: Tensor,  # (N,) long, from 0
    sigma: Tensor,  # (B,) of one residual coordinate, px
) -> Tensor:
    """Covariance (B, n, n) of a weighted fit whose residuals are not independent within groups; 0 where singular.

    The sandwich H⁻¹ (Σ s sᵀ · G / (G − n) + sigma² H) H⁻¹ over the scores s = Σ w Jᵀ r of G groups with points.

    Gradient: to rows, weight and sigma. Raises ValueError for wrong shapes.
    Source: K.-Y. Liang, S. Zeger, "Longitudinal data analysis using generalized linear models", 1986.
    """
    H, _ = normal_equations(rows, weight)
    scores = (rows[:, :-1] * rows[:, -1:]).sum(2) * weight[:, None]  # (B, n, N)
    n_groups = int(group.max()) + 1
    sums = scores.new_zeros(*scores.shape[:2], n_groups).index_add_(2, group, scores)
    count = scores.new_zeros(len(H), n_groups).index_add_(1, group, used.to(H.dtype))
    n = (count > 0).sum(-1)[:, None, None]
    meat = sums @ sums.mT * (n / (n - H.shape[-1]).clamp_min(1)) + H * (sigma * sigma)[:, None, None]
    half, _ = solve_spd(H, meat)
    return solve_spd(H, half.mT.contiguous())[0]


def chi2_quantile(p: float, degrees: int) -> float:
    """Quantile of a chi-squared distribution, by bisection. Gradient: none."""
    low, high = 0.0, 1000.0
    half = torch.tensor(degrees / 2, dtype=torch.float64)
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = float(torch.special.gammainc(half, torch.tensor(middle / 2, dtype=torch.float64))) < p
        low, high = (middle, high) if below else (low, middle)
    return high


@shaped("cov: B N 2 2, used: B N")
def noise_shape(
    cov: Tensor,  # (B, N, 2, 2) px²
    used: Tensor,  # (B, N) bool
    isotropic: float,
) -> Tensor:
    """Shape of the noise of tracks without its scale: covariances over the median of their mean variance (B, N, 2, 2).

    A tracker's covariance gives the direction and the relative size of a patch's errors; their absolute size has other
    causes as well (a patch with two depths, a lens that deviates from its model) and is estimated from residuals. The
    fraction ``isotropic`` of the shape is replaced by the unit matrix, so that no track and no direction counts as free
    of such errors.

    Returns:
        The unit matrix where a track is not used or its covariance is not positive and finite.

    Gradient: to cov, the median's choice excepted. Raises ValueError for wrong shapes.
    """
    xx, xy, yy = upper_triangle(cov)
    valid = used & (xx > 0) & (yy > 0) & (xx * yy > xy * xy) & (xx + yy < torch.inf)
    size = torch.where(valid, 0.5 * (xx + yy), torch.ones_like(xx))
    scale = masked_median(size, valid)[..., None, None]
    eye = torch.eye(2, dtype=cov.dtype, device=cov.device)
    shape = (1 - isotropic) * cov / scale + isotropic * eye
    return torch.where(valid[..., None, None], shape, eye)


@shaped("x: B N, used: B N")
def masked_median(
    x: Tensor,  # (B, N)
    used: Tensor,  # (B, N) bool
) -> Tensor:
    """Median (B, 1) of the used entries, the lower of the middle two; 1 where none is used.

    Gradient: to the entry that is the median. Raises ValueError for wrong shapes.
    """
    if x.shape[-1] == 0:
        return x.new_ones((*x.shape[:-1], 1))
    middle = x.masked_fill(~used, torch.nan).nanmedian(-1, keepdim=True).values
    return torch.where(middle.isnan(), torch.ones_like(middle), middle)
