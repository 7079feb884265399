"""Depth from defocus of a single image: blur of every edge from gradients at two scales, and inverse depth from blur.

A point away from the focus distance is imaged as a spot whose size depends on depth. Blur is measured by blurring the
image further: a sharp edge loses much of its gradient, a soft edge little. Two ambiguities remain in a single image: a
soft edge may be a soft texture in focus (*texture*), and a spot of one size corresponds to two depths, in front of the
focus and beyond it (*side*).

Alphabet: ``sigma`` px, standard deviation of the blur; ``side`` −1 in front of the focus, +1 beyond it.
"""

import torch
from torch import Tensor

from dhtorch.geometry import filters
from dhtorch.geometry.checks import check
from dhtorch.geometry.filters import correlate_separable, gaussian_blur, gaussian_taps
from dhtorch.geometry.thin_lens import GAUSSIAN_OF_DISC, Lens, depth_of_spot
from dhtorch.pytree import Record, record


@record
class BlurMap(Record):
    """Blur of an image per pixel, with gradient energy and validity."""

    sigma: Tensor  # (B, H, W) px; 0 where not valid
    energy: Tensor  # (B, H, W) mean squared gradient, expected noise subtracted
    valid: Tensor  # (B, H, W) bool: gradients well above the noise, and a ratio within the range of possible blurs


def estimate_blur(
    image: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    *,
    fine_px: float = 1.0,
    coarse_px: float = 2.0,
    window_px: float = 6.0,
    noise: float = 1 / 255,
    min_snr: float = 60.0,
    max_sigma_px: float = 8.0,
) -> BlurMap:
    """Standard deviation of the blur around every pixel from gradient energies at two scales: images -> blur map.

    An edge of blur σ, filtered by a Gaussian derivative of width w, has a gradient energy in 1 / √(σ² + w²). The ratio
    of the energies at two widths, summed over a window, gives σ; it does not depend on contrast or direction of the
    edges. Exact for straight, separate edges; finer texture is measured as sharper.

    Args:
        image: B images.
        fine_px, coarse_px: the two widths.
        window_px: standard deviation of the window.
        noise: standard deviation of a pixel, image in [0, 1]; its part of the energies is subtracted.
        min_snr: smallest ratio of a window's energy to that of the noise.
        max_sigma_px: largest blur; a larger one cannot be distinguished from no edge.

    Raises:
        ValueError: wrong shapes, or ``coarse_px`` not above ``fine_px``.

    Gradient: to the image, where valid and blurred.
    Source: S. Zhuo, T. Sim, "Defocus map estimation from a single image", 2011 (the ratio); summed energies are ours.
    """
    check("estimate_blur", image=(image, "B C H W"))
    if not 0 < fine_px < coarse_px:
        raise ValueError(f"estimate_blur: widths are {fine_px} and {coarse_px} px, expected 0 < fine_px < coarse_px")
    grey = filters.grayscale(image)
    fine, fine_noise = _gradient_energy(grey, fine_px, window_px, noise)
    coarse, coarse_noise = _gradient_energy(grey, coarse_px, window_px, noise)
    above_noise = (fine > min_snr * max(fine_noise, 1e-12)) & (coarse > min_snr * max(coarse_noise, 1e-12))
    ratio = torch.where(above_noise, fine, torch.ones_like(fine)) / torch.where(
        above_noise, coarse, torch.ones_like(coarse)
    )
    squared = ratio * ratio
    # Squared ratio of an edge with blur max_sigma_px: below it there may be no edge at all.
    min_squared = (max_sigma_px**2 + coarse_px**2) / (max_sigma_px**2 + fine_px**2)
    valid = above_noise & (squared > min_squared)
    excess = torch.where(valid, squared - 1, torch.ones_like(squared))
    variance = (coarse_px**2 - squared * fine_px**2) / excess
    is_blurred = valid & (variance > 0)
    sigma = torch.where(
        is_blurred, torch.where(is_blurred, variance, torch.ones_like(variance)).sqrt(), torch.zeros_like(variance)
    )
    return BlurMap(sigma, torch.where(above_noise, fine, torch.zeros_like(fine)), valid)


def inverse_depth_from_blur(
    blur: BlurMap,
    side: Tensor,  # (B, H, W) −1 or +1
    lens: Lens,
    focus_m: Tensor,  # (B,)
    *,
    sharp_px: float = 0.0,
) -> Tensor:
    """Inverse depth (B, H, W) in dioptres from blur and the side of the focus; NaN where the blur is not valid.

    Args:
        blur: from :func:`estimate_blur`.
        side: true or estimated side of the focus.
        lens, focus_m: of the image.
        sharp_px: blur of an image in focus, subtracted in squares.

    Raises:
        ValueError: wrong shapes.

    Gradient: to blur, lens and distance.
    """
    check("inverse_depth_from_blur", sigma=(blur.sigma, "B H W"), side=(side, "B H W"), focus_m=(focus_m, "B"))
    excess = blur.sigma * blur.sigma - sharp_px**2
    is_blurred = excess > 0
    spot = torch.where(
        is_blurred, torch.where(is_blurred, excess, torch.ones_like(excess)).sqrt(), torch.zeros_like(excess)
    )
    diameter = side * spot / GAUSSIAN_OF_DISC
    # Beyond the focus the spot of infinity is the largest: a larger measured blur gives inverse depth 0.
    depth = depth_of_spot(lens, diameter.flatten(1), focus_m).view(spot.shape)
    is_finite = depth.isfinite()
    dioptres = torch.where(
        is_finite, 1 / torch.where(is_finite, depth, torch.ones_like(depth)), torch.zeros_like(depth)
    )
    return torch.where(blur.valid, dioptres, torch.full_like(dioptres, torch.nan))


def guess_side_by_height(blur: BlurMap) -> Tensor:
    """Side (B, H, W) of the focus from image height: pixels above the sharpest rows are beyond the focus.

    In upright images of rooms and streets the lower half is nearer. The level of focus is the mean row of the valid
    pixels, weighted by sharpness.

    Raises:
        ValueError: wrong shapes.
    """
    sizes = check("guess_side_by_height", sigma=(blur.sigma, "B H W"))
    row = torch.arange(sizes["H"], dtype=blur.sigma.dtype, device=blur.sigma.device)
    sharp = blur.sigma * blur.sigma + 0.25
    weight = torch.where(blur.valid, 1 / (sharp * sharp), torch.zeros_like(sharp)).sum(-1)  # (B, H)
    level = (weight * row).sum(-1) / weight.sum(-1).clamp_min(1e-12)
    above = row < level[:, None]
    side = torch.where(above, torch.ones_like(weight), -torch.ones_like(weight))
    return side[..., None].expand(blur.sigma.shape)


def guess_side_by_colour(
    image: Tensor,  # (B, 3, H, W) float in [0, 1] or uint8
    *,
    window_px: float = 6.0,
    noise: float = 1 / 255,
) -> Tensor:
    """Side (B, H, W) of the focus from axial colour: red focuses farther than blue, so beyond the focus red is sharper.

    The only cue to the side in a single image, if the lens is not corrected for colour. 0 where either channel has no
    edge.

    Raises:
        ValueError: wrong shapes.
    """
    check("guess_side_by_colour", image=(image, "B 3 H W"))
    red, blue = (estimate_blur(image[:, k : k + 1], window_px=window_px, noise=noise) for k in (0, 2))
    both = red.valid & blue.valid
    variance_difference = torch.where(
        both, blue.sigma * blue.sigma - red.sigma * red.sigma, torch.zeros_like(red.sigma)
    )
    return torch.where(both, torch.sign(gaussian_blur(variance_difference[:, None], window_px / 2)[:, 0]), 0.0)


def _gradient_energy(grey: Tensor, width_px: float, window_px: float, noise: float) -> tuple[Tensor, float]:
    """Mean squared gradient (B, H, W) in a window minus the expected energy of noise, and that expected energy."""
    smooth = gaussian_taps(width_px)
    slope = gaussian_taps(width_px, derivative=True)
    gradient_x, gradient_y = correlate_separable(grey, smooth, slope), correlate_separable(grey, slope, smooth)
    expected = 2 * noise * noise * sum([w * w for w in smooth]) * sum([w * w for w in slope])
    return (gaussian_blur(gradient_x * gradient_x + gradient_y * gradient_y, window_px) - expected)[:, 0], expected
