"""Filling in between sparse returns: plain interpolation, guides of grey values, and defocus as a guide.

The idea: a sensor's coarse depth settles the two things that defocus alone cannot know, the scale and the side of the
focus, and defocus then tells, edge by edge, what lies between the returns. The other functions are what it has to beat:
bilinear interpolation, and the two filters that let a coarse depth map follow the edges of the picture.

Alphabet: ``coarse`` (B, h, w) m, 0 = no return, covering the same field as ``guide`` (B, C, H, W); ``dense`` (B, H, W).
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.experiments.focal.blur import BlurMap
from dhtorch.geometry import filters
from dhtorch.geometry.checks import check
from dhtorch.geometry.filters import box_mean, gaussian_blur

#: Least weight of returns that makes an answer.
_MIN_WEIGHT = 1e-6


def fill_bilinear(
    coarse: Tensor,  # (B, h, w) m, 0 = no return
    hw: tuple[int, int],
) -> Tensor:
    """Dense depth (B, H, W) m by bilinear interpolation among the returns; 0 where none of the four is there.

    Raises:
        ValueError: wrong shape.

    Gradient: to the returns.
    """
    check("fill_bilinear", coarse=(coarse, "B h w"))
    there = (coarse > 0).to(coarse.dtype)
    total, weight = (_resize(x, hw) for x in (coarse * there, there))
    seen = weight > _MIN_WEIGHT
    return torch.where(seen, total / torch.where(seen, weight, torch.ones_like(weight)), torch.zeros_like(total))


def fill_joint_bilateral(
    coarse: Tensor,  # (B, h, w) m, 0 = no return
    guide: Tensor,  # (B, C, H, W) float in [0, 1] or uint8
    *,
    radius: int = 2,
    spatial: float = 0.8,
    contrast: float = 0.1,
) -> Tensor:
    """Dense depth (B, H, W) m: a mean of the returns around, weighted by distance and by likeness in the guide.

    Args:
        coarse, guide: of one field.
        radius: returns looked at, in steps of the coarse map either way.
        spatial: standard deviation of the distance, in those steps.
        contrast: standard deviation of the guide's difference.

    Raises:
        ValueError: wrong shapes.

    Gradient: to the returns and the guide.
    Source: J. Kopf, M. Cohen, D. Lischinski, M. Uyttendaele, "Joint bilateral upsampling", 2007.
    """
    sizes = check("fill_joint_bilateral", coarse=(coarse, "B h w"), guide=(guide, "B C H W"))
    picture = (guide / 255.0 if guide.dtype == torch.uint8 else guide).to(coarse.dtype)
    H, W, h, w = (sizes[k] for k in "HWhw")
    y, x = _coarse_coordinates(H, h, coarse), _coarse_coordinates(W, w, coarse)
    row, column = torch.floor(y + 0.5).long(), torch.floor(x + 0.5).long()
    # The guide at a return is the mean over the pixels it stands for.
    small = F.interpolate(picture, (h, w), mode="area")
    total = weight = torch.zeros_like(picture[:, 0])
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            r, c = (row + dy).clamp(0, h - 1), (column + dx).clamp(0, w - 1)
            inside = (row + dy == r)[:, None] & (column + dx == c)
            near = ((y - r) ** 2)[:, None] + (x - c) ** 2
            value, colour = coarse[:, r][:, :, c], small[:, :, r][..., c]
            unlike = ((picture - colour) ** 2).mean(1)
            share = torch.exp(-0.5 * (near / spatial**2 + unlike / contrast**2))
            share = torch.where(inside & (value > 0), share, 0.0)
            total, weight = total + share * value, weight + share
    seen = weight > _MIN_WEIGHT
    return torch.where(seen, total / torch.where(seen, weight, torch.ones_like(weight)), torch.zeros_like(total))


def fill_guided(
    coarse: Tensor,  # (B, h, w) m, 0 = no return
    guide: Tensor,  # (B, C, H, W) float in [0, 1] or uint8
    *,
    radius: int = 1,
    smooth: float = 1e-3,
) -> Tensor:
    """Dense depth (B, H, W) m that is, around every pixel, a linear function of the grey guide.

    The functions are fitted to the returns alone and interpolated in between, so that the guide's own edges decide
    where depth changes. 0 where no return is near.

    Args:
        coarse, guide: of one field.
        radius: of the windows, in steps of the coarse map.
        smooth: grey variance below which a window counts as flat.

    Raises:
        ValueError: wrong shapes.

    kornia's ``guided_blur`` is the same where every pixel has a return; it cannot leave out those without.

    Gradient: to the returns and the guide.
    Source: K. He, J. Sun, "Fast guided filter", 2015.
    """
    sizes = check("fill_guided", coarse=(coarse, "B h w"), guide=(guide, "B C H W"))
    grey = filters.grayscale(guide).to(coarse.dtype)
    there = (coarse > 0).to(coarse.dtype)[:, None]
    count = box_mean(there, radius)
    some = count > _MIN_WEIGHT
    safe = torch.where(some, count, torch.ones_like(count))

    def mean(x: Tensor) -> Tensor:
        return box_mean(x * there, radius) / safe

    z, small = coarse[:, None], F.interpolate(grey, coarse.shape[-2:], mode="area")
    middle, level = mean(small), mean(z)
    slope = (mean(small * z) - middle * level) / (mean(small * small) - middle * middle).clamp_min(0).add(smooth)
    hw = (sizes["H"], sizes["W"])
    slope, offset = (_resize(mean(x)[:, 0], hw) for x in (slope, level - slope * middle))
    found = slope * grey[:, 0] + offset
    seen = (_resize(some.to(coarse.dtype)[:, 0], hw) > 1 - _MIN_WEIGHT) & (found > 0)
    return torch.where(seen, found, torch.zeros_like(found))


def fill_defocus_guided(
    dense: Tensor,  # (B, H, W) m, 0 = none: interpolated returns
    coarse: Tensor,  # (B, h, w) m, 0 = no return
    blur: BlurMap,
    *,
    reach_px: float = 4.0,
    steps: int = 12,
    distrust: float = 1.0,
) -> Tensor:
    """Dense depth (B, H, W) m: the interpolated one, corrected by what defocus says, as much as it has earned.

    Neither lens nor focus has to be known: on the interpolated depth the distance in focus is looked for that explains
    the measured blur best (blur grows with the distance from it in inverse depth), which fixes scale and side. The
    claim of every valid pixel is then weighed against the interpolated value by inverse variance: that of the claim is
    its mean squared deviation in the picture, that of the interpolation its own local curvature.

    Args:
        dense, coarse: from one sensor.
        blur: of the picture, from :func:`dhtorch.experiments.focal.blur.estimate_blur`.
        reach_px: over which claims are averaged.
        steps: distances in focus tried, in equal steps of inverse depth.
        distrust: factor on the variance of the claims; below 1 they are believed more than they have earned.

    Returns:
        Depth; as it was where no edge is, where nothing was interpolated, or where blur explains nothing.

    Raises:
        ValueError: wrong shapes.

    Gradient: to depth and blur; the choice of the focus carries none.
    """
    sizes = check("fill_defocus_guided", dense=(dense, "B H W"), coarse=(coarse, "B h w"), sigma=(blur.sigma, "B H W"))
    known = dense > 0
    inverse = torch.where(known, 1 / torch.where(known, dense, torch.ones_like(dense)), torch.zeros_like(dense))
    use = (blur.valid & known).to(dense.dtype)
    focus, offset, gain = _fit_focus_model(inverse, blur.sigma, use, steps)
    side = torch.where(inverse > focus, torch.ones_like(inverse), -torch.ones_like(inverse))
    works = gain > 0
    claim = focus + side * ((blur.sigma - offset) / torch.where(works, gain, torch.ones_like(gain))).clamp_min(0)
    deviation = (claim - inverse) * use
    count = use.sum((1, 2), keepdim=True).clamp_min(1)
    claim_variance = (deviation * deviation).sum((1, 2), keepdim=True) / count + 1e-12
    # What interpolation cannot know: half the change from one return to the next.
    step = sizes["H"] / sizes["h"]
    slack = gaussian_blur(inverse[:, None], step / 2)[:, 0] - inverse
    prior_variance = slack * slack + 1e-12
    weight = use * prior_variance / (prior_variance + distrust * claim_variance)
    near = gaussian_blur(torch.stack((weight * deviation, weight, torch.ones_like(weight)), 1), reach_px)
    fused = inverse + near[:, 0] / near[:, 2]
    better = known & works & (fused > 0)
    return torch.where(better, 1 / torch.where(better, fused, torch.ones_like(fused)), dense)


def _fit_focus_model(inverse: Tensor, sigma: Tensor, use: Tensor, steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Focus, blur in focus and gain (B, 1, 1) such that sigma = offset + gain |inverse − focus|, by least squares."""
    far = torch.where(use > 0, inverse, torch.full_like(inverse, math.inf)).amin((1, 2))
    near = torch.where(use > 0, inverse, torch.full_like(inverse, -math.inf)).amax((1, 2))
    empty = ~(near > far)
    far, near = torch.where(empty, torch.zeros_like(far), far), torch.where(empty, torch.ones_like(near), near)
    total = use.sum((1, 2)).clamp_min(1)
    fits = []
    for k in range(steps + 1):
        focus = far + (near - far) * (k / steps)
        x = (inverse - focus[:, None, None]).abs()
        mean_x, mean_y = ((use * v).sum((1, 2)) / total for v in (x, sigma))
        dx, dy = x - mean_x[:, None, None], sigma - mean_y[:, None, None]
        sxx = (use * dx * dx).sum((1, 2)).clamp_min(1e-12)
        sxy = (use * dx * dy).sum((1, 2))
        gain = (sxy / sxx).clamp_min(0)
        explained = gain * sxy
        fits.append(torch.stack((explained, focus, mean_y - gain * mean_x, gain)))
    table = torch.stack(fits)  # (steps + 1, 4, B)
    best = table[:, 0].detach().argmax(0)
    focus, offset, gain = (table[:, k].gather(0, best[None])[0][:, None, None] for k in (1, 2, 3))
    gain = torch.where(empty[:, None, None], torch.zeros_like(gain), gain)
    return focus, offset, gain


def _resize(x: Tensor, hw: tuple[int, int]) -> Tensor:
    return F.interpolate(x[:, None], hw, mode="bilinear", align_corners=False)[:, 0]


def _coarse_coordinates(size: int, small: int, like: Tensor) -> Tensor:
    """Where the pixels (size,) of one side lie on the coarse map."""
    place = torch.arange(size, dtype=like.dtype, device=like.device)
    return (place + 0.5) * (small / size) - 0.5
