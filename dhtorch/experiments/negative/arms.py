"""Spiral arms as 1-D signals: sampling along an arm, and shifts along it by windowed cross-correlation.

Alphabet: ``signal`` (B, L) grey values at even steps along an arm; a *site* is an index into it; ``lag`` number of
steps by which the window around a site is shifted in the other signal. A lag is a displacement along the arm; motion
across the arm is not measured: under forward motion every point moves along its radius, and an arm crosses all radii.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.geometry import filters
from dhtorch.geometry.checks import check
from dhtorch.pytree import Record, record

#: Variance of a window (grey values in [0, 1]) below which it is too flat to be matched.
_FLAT_VARIANCE = 1e-6


@record
class ArmShift(Record):
    """Shift of the window around each site along the arm, with its correlation."""

    lag: Tensor  # (B, K) steps along the arm; 0 where not valid
    peak: Tensor  # (B, K) normalised correlation there, in [-1, 1]; 0 where not valid
    valid: Tensor  # (B, K) bool: windows inside, not flat, and the peak not at an end of the search range


def sample_arm(
    image: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    arm: Tensor,  # (L, 2) px
    *,
    blur_px: float = 1.5,
) -> Tensor:
    """Grey values (B, L) along an arm by bilinear interpolation of the image after a Gaussian blur.

    The blur makes windows tolerant to small motion across the arm, and prevents aliasing of fine texture.

    Args:
        image: B images.
        arm: positions, the same in all images; outside the image the border is repeated.
        blur_px: standard deviation; 0 = none.

    Raises:
        ValueError: wrong shapes.

    Gradient: to the image and to ``arm``.
    """
    check("sample_arm", image=(image, "B C H W"), arm=(arm, "L 2"))
    grey = filters.grayscale(image).to(arm.dtype)
    H, W = grey.shape[-2:]
    if blur_px > 0:
        reach = max(1, int(3 * blur_px + 0.5))
        grey = filters.gaussian_blur(grey, blur_px, reach_px=reach)
    limit = torch.tensor([W - 1, H - 1], dtype=arm.dtype, device=arm.device)
    x = torch.minimum(arm.clamp_min(0), limit)
    low = torch.minimum(x.detach().floor(), (limit - 1).clamp_min(0))
    a, b = (x - low).unbind(-1)
    flat = grey.flatten(1)
    first = (low[:, 1] * W + low[:, 0]).long()
    right, below = (1 if W > 1 else 0), (W if H > 1 else 0)
    top = flat[:, first] * (1 - a) + flat[:, first + right] * a
    bottom = flat[:, first + below] * (1 - a) + flat[:, first + below + right] * a
    return top * (1 - b) + bottom * b


def correlate_windows(
    signal_0: Tensor,  # (B, L)
    signal_1: Tensor,  # (B, M)
    site_0: Tensor,  # (B, K) int64, index into signal 0
    site_1: Tensor,  # (B, K) int64, index into signal 1 at which lag 0 lies
    *,
    window: int = 41,
    max_lag: int = 40,
    min_peak: float = 0.5,
) -> ArmShift:
    """Windowed normalised cross-correlation of two signals, its highest peak refined between steps by a parabola.

    Args:
        signal_0, signal_1: the same arm in two images, or two arms.
        site_0, site_1: centre of each window, and centre of its search range.
        window: steps in a window, odd.
        max_lag: half width of the search range, in steps.
        min_peak: smallest correlation of a match.

    Returns:
        Shift. Not valid: a window or a search that leaves its signal, a flat window, a peak at the end of the search
        or below ``min_peak``.

    Raises:
        ValueError: wrong shapes, an even window, ``max_lag`` below 1, or signals shorter than window and search.

    Gradient: of the parabola through three correlations to both signals; the argmax carries none.
    """
    check("correlate_windows", signal_0=(signal_0, "B L"), signal_1=(signal_1, "B M"), site_0=(site_0, "B K"))
    check("correlate_windows", signal_0=(signal_0, "B L"), site_1=(site_1, "B K"), site_0=(site_0, "B K"))
    if window < 3 or window % 2 == 0 or max_lag < 1:
        raise ValueError(
            f"correlate_windows: window is {window} and max_lag {max_lag}, expected odd from 3, and from 1"
        )
    span = window + 2 * max_lag
    if signal_0.shape[1] < window or signal_1.shape[1] < span:
        lengths = f"{signal_0.shape[1]} and {signal_1.shape[1]} steps"
        raise ValueError(f"correlate_windows: signals have {lengths}, expected at least {window} and {span}")
    start_0, start_1 = site_0 - window // 2, site_1 - span // 2
    last_0, last_1 = signal_0.shape[1] - window, signal_1.shape[1] - span
    inside = (start_0 >= 0) & (start_0 <= last_0) & (start_1 >= 0) & (start_1 <= last_1)
    template = _read_windows(signal_0, start_0.clamp(0, last_0), window)  # (B, K, window)
    search = _read_windows(signal_1, start_1.clamp(0, last_1), span)  # (B, K, span)
    score, textured = _normalised_correlation(template, search)
    best = score.detach()[..., 1:-1].argmax(-1) + 1
    left, peak, right = (score.gather(-1, (best + k)[..., None])[..., 0] for k in (-1, 0, 1))
    curvature = left - 2 * peak + right
    curved = curvature < -1e-6
    offset = torch.where(
        curved, 0.5 * (left - right) / torch.where(curved, curvature, -torch.ones_like(curvature)), 0.0
    )
    ends = torch.maximum(score.detach()[..., 0], score.detach()[..., -1])
    valid = inside & textured & (ends <= peak) & (peak >= min_peak)
    zero = torch.zeros_like(peak)
    return ArmShift(torch.where(valid, best - max_lag + offset, zero), torch.where(valid, peak, zero), valid)


def _read_windows(signal: Tensor, start: Tensor, length: int) -> Tensor:
    """Windows (B, K, length) of a signal from start indices (B, K)."""
    index = start[..., None] + torch.arange(length, device=signal.device)
    return signal.gather(1, index.flatten(1)).view(index.shape)


def _normalised_correlation(template: Tensor, search: Tensor) -> tuple[Tensor, Tensor]:
    """Correlation (B, K, lags) of a window with every window of the search range, and whether it is textured (B, K)."""
    window = template.shape[-1]
    windows = search.unfold(-1, window, 1)  # (B, K, lags, window), a view
    t = template - template.mean(-1, keepdim=True)
    power_t = (t * t).mean(-1, keepdim=True)
    offset = search.mean(-1, keepdim=True)  # against cancellation in the variances below
    centred = windows - offset[..., None]
    mean_p = centred.mean(-1)
    power_p = (centred * centred).mean(-1) - mean_p * mean_p
    covariance = (centred * t[..., None, :]).mean(-1)
    both_textured = (power_t > _FLAT_VARIANCE) & (power_p > _FLAT_VARIANCE)
    norm = torch.where(both_textured, power_t * power_p, torch.ones_like(power_p)).sqrt()
    return torch.where(both_textured, covariance / norm, torch.zeros_like(covariance)), (power_t > _FLAT_VARIANCE)[
        ..., 0
    ]
