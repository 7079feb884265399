"""Depth upsampling: sparse returns to a dense map by bilinear, joint bilateral, guided and defocus-guided filters.

Defocus-guided filling: the coarse depth of a sensor fixes the two unknowns of defocus, the scale and the side of the
focus; the defocus of edges then gives depth between the returns. The other functions are its baselines: bilinear
interpolation, and the two filters that make a coarse depth map follow the edges of the image.

Alphabet: ``coarse`` (B, h, w) m, 0 = no return, covering the same field as ``guide`` (B, C, H, W); ``dense`` (B, H, W).
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.experiments.focal.blur import BlurMap
from dhtorch.geometry import filters
from dhtorch.geometry.checks import check
from dhtorch.geometry.filters import box_mean, gaussian_blur

#: Smallest sum of weights of returns for which a pixel gets a depth.
_MIN_WEIGHT = 1e-6


def fill_bilinear(
    coarse: Tensor,  # (B, h, w) m, 0 = no return
    hw: tuple[int, int],
) -> Tensor:
    """Dense depth (B, H, W) m by bilinear interpolation of the returns; 0 where all four neighbours are missing.

    Raises:
        ValueError: wrong shape.

    Gradient: to the returns.
    """
    check("fill_bilinear", coarse=(coarse, "B h w"))
    is_return = (coarse > 0).to(coarse.dtype)
    total, weight = (_resize(x, hw) for x in (coarse * is_return, is_return))
    answered = weight > _MIN_WEIGHT
    return torch.where(
        answered, total / torch.where(answered, weight, torch.ones_like(weight)), torch.zeros_like(total)
    )


def fill_joint_bilateral(
    coarse: Tensor,  # (B, h, w) m, 0 = no return
    guide: Tensor,  # (B, C, H, W) float in [0, 1] or uint8
    *,
    radius: int = 2,
    spatial: float = 0.8,
    contrast: float = 0.1,
) -> Tensor:
    """Dense depth (B, H, W) m: mean of nearby returns, weighted by distance and by similarity in the guide.

    Args:
        coarse, guide: with the same field of view.
        radius: of the window, in pixels of the coarse map.
        spatial: standard deviation of the distance weight, in pixels of the coarse map.
        contrast: standard deviation of the weight of guide differences.

    Raises:
        ValueError: wrong shapes.

    Gradient: to the returns and the guide.
    Source: J. Kopf, M. Cohen, D. Lischinski, M. Uyttendaele, "Joint bilateral upsampling", 2007.
    """
    sizes = check("fill_joint_bilateral", coarse=(coarse, "B h w"), guide=(guide, "B C H W"))
    scaled_guide = (guide / 255.0 if guide.dtype == torch.uint8 else guide).to(coarse.dtype)
    H, W, h, w = (sizes[k] for k in "HWhw")
    y, x = _coarse_coordinates(H, h, coarse), _coarse_coordinates(W, w, coarse)
    row, column = torch.floor(y + 0.5).long(), torch.floor(x + 0.5).long()
    # The guide value of a return is the mean over the pixels that its coarse pixel covers.
    small = F.interpolate(scaled_guide, (h, w), mode="area")
    total = weight = torch.zeros_like(scaled_guide[:, 0])
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            r, c = (row + dy).clamp(0, h - 1), (column + dx).clamp(0, w - 1)
            inside = (row + dy == r)[:, None] & (column + dx == c)
            squared_distance = ((y - r) ** 2)[:, None] + (x - c) ** 2
            value, colour = coarse[:, r][:, :, c], small[:, :, r][..., c]
            squared_contrast = ((scaled_guide - colour) ** 2).mean(1)
            kernel = torch.exp(-0.5 * (squared_distance / spatial**2 + squared_contrast / contrast**2))
            kernel = torch.where(inside & (value > 0), kernel, 0.0)
            total, weight = total + kernel * value, weight + kernel
    answered = weight > _MIN_WEIGHT
    return torch.where(
        answered, total / torch.where(answered, weight, torch.ones_like(weight)), torch.zeros_like(total)
    )


def fill_guided(
    coarse: Tensor,  # (B, h, w) m, 0 = no return
    guide: Tensor,  # (B, C, H, W) float in [0, 1] or uint8
    *,
    radius: int = 1,
    smooth: float = 1e-3,
) -> Tensor:
    """Dense depth (B, H, W) m by a guided filter: around every pixel a linear function of the grey guide.

    The coefficients are fitted to the returns alone and interpolated, so depth edges follow the edges of the guide. 0
    without a return nearby.

    Args:
        coarse, guide: with the same field of view.
        radius: of the windows, in pixels of the coarse map.
        smooth: grey variance below which a window counts as flat.

    Raises:
        ValueError: wrong shapes.

    kornia's ``guided_blur`` is equal if every pixel has a return; it has no mask for missing ones.

    Gradient: to the returns and the guide.
    Source: K. He, J. Sun, "Fast guided filter", 2015.
    """
    sizes = check("fill_guided", coarse=(coarse, "B h w"), guide=(guide, "B C H W"))
    grey = filters.grayscale(guide).to(coarse.dtype)
    is_return = (coarse > 0).to(coarse.dtype)[:, None]
    count = box_mean(is_return, radius)
    has_return = count > _MIN_WEIGHT
    count_or_one = torch.where(has_return, count, torch.ones_like(count))

    def mean(x: Tensor) -> Tensor:
        return box_mean(x * is_return, radius) / count_or_one

    z, coarse_grey = coarse[:, None], F.interpolate(grey, coarse.shape[-2:], mode="area")
    mean_grey, mean_depth = mean(coarse_grey), mean(z)
    slope = (mean(coarse_grey * z) - mean_grey * mean_depth) / (
        mean(coarse_grey * coarse_grey) - mean_grey * mean_grey
    ).clamp_min(0).add(smooth)
    hw = (sizes["H"], sizes["W"])
    slope, offset = (_resize(mean(x)[:, 0], hw) for x in (slope, mean_depth - slope * mean_grey))
    depth = slope * grey[:, 0] + offset
    answered = (_resize(has_return.to(coarse.dtype)[:, 0], hw) > 1 - _MIN_WEIGHT) & (depth > 0)
    return torch.where(answered, depth, torch.zeros_like(depth))


def fill_defocus_guided(
    dense: Tensor,  # (B, H, W) m, 0 = none: interpolated returns
    coarse: Tensor,  # (B, h, w) m, 0 = no return
    blur: BlurMap,
    *,
    reach_px: float = 4.0,
    steps: int = 12,
    distrust: float = 1.0,
) -> Tensor:
    """Dense depth (B, H, W) m: interpolated depth, corrected by depth from defocus with inverse-variance weights.

    Lens and focus distance are unknown: they are fitted as the focus that explains the measured blur best on the
    interpolated depth (blur grows with the distance from the focus in inverse depth), which fixes scale and side. The
    defocus depth of every valid pixel is then fused with the interpolated one by inverse variance: its own variance is
    the mean squared deviation over the image, that of the interpolation the local curvature.

    Args:
        dense, coarse: from one sensor.
        blur: of the image, from :func:`dhtorch.experiments.focal.blur.estimate_blur`.
        reach_px: standard deviation of the average over defocus depths.
        steps: number of intervals of the search for the focus, equal in inverse depth.
        distrust: factor on the variance of the defocus depth; below 1 gives it more weight than its variance justifies.

    Returns:
        Depth; unchanged away from edges, where ``dense`` is 0, and where no focus explains the blur.

    Raises:
        ValueError: wrong shapes.

    Gradient: to depth and blur; the choice of the focus carries none.
    """
    sizes = check("fill_defocus_guided", dense=(dense, "B H W"), coarse=(coarse, "B h w"), sigma=(blur.sigma, "B H W"))
    has_depth = dense > 0
    inverse = torch.where(has_depth, 1 / torch.where(has_depth, dense, torch.ones_like(dense)), torch.zeros_like(dense))
    weight_mask = (blur.valid & has_depth).to(dense.dtype)
    focus, offset, gain = _fit_focus_model(inverse, blur.sigma, weight_mask, steps)
    side = torch.where(inverse > focus, torch.ones_like(inverse), -torch.ones_like(inverse))
    has_gain = gain > 0
    defocus_inverse = focus + side * (
        (blur.sigma - offset) / torch.where(has_gain, gain, torch.ones_like(gain))
    ).clamp_min(0)
    deviation = (defocus_inverse - inverse) * weight_mask
    count = weight_mask.sum((1, 2), keepdim=True).clamp_min(1)
    defocus_variance = (deviation * deviation).sum((1, 2), keepdim=True) / count + 1e-12
    # Uncertainty of the interpolation: half the change from one return to the next.
    step = sizes["H"] / sizes["h"]
    curvature = gaussian_blur(inverse[:, None], step / 2)[:, 0] - inverse
    prior_variance = curvature * curvature + 1e-12
    weight = weight_mask * prior_variance / (prior_variance + distrust * defocus_variance)
    smoothed = gaussian_blur(torch.stack((weight * deviation, weight, torch.ones_like(weight)), 1), reach_px)
    fused = inverse + smoothed[:, 0] / smoothed[:, 2]
    corrected = has_depth & has_gain & (fused > 0)
    return torch.where(corrected, 1 / torch.where(corrected, fused, torch.ones_like(fused)), dense)


def _fit_focus_model(inverse: Tensor, sigma: Tensor, mask: Tensor, steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Focus, blur in focus and gain (B, 1, 1) such that sigma = offset + gain |inverse − focus|, by least squares."""
    far = torch.where(mask > 0, inverse, torch.full_like(inverse, math.inf)).amin((1, 2))
    near = torch.where(mask > 0, inverse, torch.full_like(inverse, -math.inf)).amax((1, 2))
    empty = ~(near > far)
    far, near = torch.where(empty, torch.zeros_like(far), far), torch.where(empty, torch.ones_like(near), near)
    total = mask.sum((1, 2)).clamp_min(1)
    fits = []
    for k in range(steps + 1):
        focus = far + (near - far) * (k / steps)
        x = (inverse - focus[:, None, None]).abs()
        mean_x, mean_y = ((mask * v).sum((1, 2)) / total for v in (x, sigma))
        dx, dy = x - mean_x[:, None, None], sigma - mean_y[:, None, None]
        sxx = (mask * dx * dx).sum((1, 2)).clamp_min(1e-12)
        sxy = (mask * dx * dy).sum((1, 2))
        gain = (sxy / sxx).clamp_min(0)
        explained = gain * sxy
        fits.append(torch.stack((explained, focus, mean_y - gain * mean_x, gain)))
    table = torch.stack(fits)  # (steps + 1, 4, B)
    best = table[:, 0].detach().argmax(0)
    focus, offset, gain = (table[:, k].gather(0, best[None])[0][:, None, None] for k in (1, 2, 3))
    gain = torch.where(empty[:, None, None], torch.zeros_like(gain), gain)
    return focus, offset, gain


def _resize(x: Tensor, hw: tuple[int, int]) -> Tensor:
    """Bilinear resampling of maps (B, h, w) to size ``hw``."""
    return F.interpolate(x[:, None], hw, mode="bilinear", align_corners=False)[:, 0]


def _coarse_coordinates(size: int, small: int, like: Tensor) -> Tensor:
    """Coordinates (size,) of the fine pixels along one axis in pixels of the coarse map."""
    index = torch.arange(size, dtype=like.dtype, device=like.device)
    return (index + 0.5) * (small / size) - 0.5
