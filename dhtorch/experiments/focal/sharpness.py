"""Depth from a focal stack: a pixel is as far as the distance at which it looked sharpest.

The classical recipe: a measure of sharpness for every pixel of every picture, the best picture of each pixel, and a
parabola through the measure around it, so that the answer falls between pictures. Pictures that moved or breathed
(changed their magnification with the focus) are first laid over each other.

Alphabet: ``images`` (B, S, C, H, W), S pictures of one view; ``measure_sharpness`` (B, S, H, W); ``place`` (B, H, W)
    position
in the stack, in pictures, fractions allowed.
"""

from __future__ import annotations

import torch
from kornia.geometry.transform import remap
from torch import Tensor

from dhtorch.geometry import filters
from dhtorch.geometry.checks import check
from dhtorch.geometry.filters import correlate_separable, gaussian_blur
from dhtorch.pytree import Record, record

#: Measures of sharpness.
SHARPNESS_MEASURES = ("modified_laplacian", "gradient_energy", "variance")


@record
class FocusMap(Record):
    """Where in the stack every pixel is sharpest."""

    place: Tensor  # (B, H, W) pictures from the first, in [0, S − 1]
    confidence: Tensor  # (B, H, W) in [0, 1]: how far the peak stands out of the other pictures


def measure_sharpness(
    images: Tensor,  # (B, S, C, H, W) C 1 or 3; float in [0, 1] or uint8
    measure: str = "modified_laplacian",
    *,
    window_px: float = 6.0,
) -> Tensor:
    """Sharpness (B, S, H, W) of every pixel in every picture, averaged over a Gaussian window.

    ``modified_laplacian``: sum of the absolute second differences along both axes. ``gradient_energy``: sum of the
    squared first differences (Sobel; kornia's ``spatial_gradient`` takes up to three times as long). ``variance``: of
    the grey values in the window.

    Args:
        images: B stacks of at least two pictures.
        measure: one of :data:`SHARPNESS_MEASURES`.
        window_px: standard deviation of the window.

    Raises:
        ValueError: wrong shapes, fewer than two pictures, or another measure.

    Gradient: to the images.
    Source: S. Pertuz, D. Puig, M. A. García, "Analysis of focus measure operators for shape-from-focus", 2013.
    """
    sizes = check("measure_sharpness", images=(images, "B S C H W"))
    _check_two_images("sharpness", sizes["S"])
    if measure not in SHARPNESS_MEASURES:
        raise ValueError(f"measure_sharpness: measure is {measure!r}, expected one of {', '.join(SHARPNESS_MEASURES)}")
    grey = filters.grayscale(images.flatten(0, 1))
    if measure == "modified_laplacian":
        second = [-1.0, 2.0, -1.0]
        raw = correlate_separable(grey, [1.0], second).abs() + correlate_separable(grey, second, [1.0]).abs()
    elif measure == "gradient_energy":
        slope, smooth = [-0.5, 0.0, 0.5], [0.25, 0.5, 0.25]
        across, down = correlate_separable(grey, smooth, slope), correlate_separable(grey, slope, smooth)
        raw = across * across + down * down
    else:
        centred = grey - gaussian_blur(grey, window_px)
        raw = centred * centred
    return gaussian_blur(raw, window_px).view(sizes["B"], sizes["S"], sizes["H"], sizes["W"])


def find_sharpest(
    measured: Tensor,  # (B, S, H, W) not negative
) -> FocusMap:
    """The sharpest picture of every pixel, placed between pictures by a Gaussian through three of them.

    Confidence is 1 minus the mean over the peak: 0 where no picture stands out, at most 1 − 1 / S. A peak at either end
    stays there: nothing tells how far beyond it the best would be.

    Raises:
        ValueError: wrong shapes or fewer than two pictures.

    Gradient: through the three sharpnesses to ``measured``; the choice carries none.
    """
    sizes = check("find_sharpest", measured=(measured, "B S H W"))
    _check_two_images("sharpest", sizes["S"])
    best = measured.detach().argmax(1, keepdim=True)
    left, peak, right = (measured.gather(1, (best + k).clamp(0, sizes["S"] - 1)) for k in (-1, 0, 1))
    seen = peak > 0
    floor = 1e-6 * torch.where(seen, peak, torch.ones_like(peak))
    a, b, c = (torch.log(torch.where(seen, x, torch.ones_like(x)) + floor) for x in (left, peak, right))
    bend = a - 2 * b + c
    inner = (best > 0) & (best < sizes["S"] - 1) & (bend < -1e-9)
    shift = torch.where(inner, 0.5 * (a - c) / torch.where(inner, bend, -torch.ones_like(bend)), torch.zeros_like(bend))
    mean = measured.mean(1, keepdim=True)
    confidence = torch.where(seen, 1 - mean / torch.where(seen, peak, torch.ones_like(peak)), torch.zeros_like(peak))
    return FocusMap((best + shift.clamp(-0.5, 0.5))[:, 0], confidence[:, 0])


def depth_at_focus(
    place: Tensor,  # (B, H, W)
    focus_m: Tensor | None,  # (B, S) m, of the pictures in their order
) -> Tensor:
    """Depth (B, H, W) m at places in a stack: inverse distances are interpolated, in which blur is linear.

    Raises:
        ValueError: no distances (then only the order is known), wrong shapes, or distances that do not rise or fall
            throughout, so that between two pictures there would be no distance between theirs.

    Gradient: to place and distances.
    """
    if focus_m is None:
        raise ValueError(
            "depth_at_focus: focus_m is None, expected distances: without them only the order in depth is known"
        )
    sizes = check("depth_at_focus", place=(place, "B H W"), focus_m=(focus_m, "B S"))
    _check_two_images("depth_at", sizes["S"])
    step = focus_m.diff(dim=1)
    if not bool(((step > 0).all(1) | (step < 0).all(1)).all()):
        raise ValueError(
            "depth_at_focus: focus_m expected to rise or to fall throughout: sort the pictures by distance"
        )
    low = place.detach().floor().clamp(0, sizes["S"] - 2)
    index = low.long().flatten(1)
    inverse = 1 / focus_m
    first, second = (inverse.gather(1, index + k).view(place.shape) for k in (0, 1))
    return 1 / (first + (place - low) * (second - first))


def align_stack(
    images: Tensor,  # (B, S, C, H, W) float in [0, 1] or uint8
    *,
    reference: int | None = None,
    blur_px: float = 3.0,
    iterations: int = 20,
) -> tuple[Tensor, Tensor]:
    """The stack with every picture laid over the reference, and the motions found.

    Magnification and shift of each picture are estimated by Gauss–Newton on pictures that are blurred alike (what
    focus changes most is fine detail) and freed of brightness and contrast, each starting from its neighbour's, which
    was focused nearly as it is.

    Args:
        images: B stacks.
        reference: position of the picture that stays; None = the middle one.
        blur_px: blur before comparison.
        iterations: per picture.

    Returns:
        images (B, S, C, H, W), float, borders repeated; motion (B, S, 3): magnification minus one, shift right and
        down in px, such that the pixel at x (from the middle) of the reference is seen at x (1 + m) + shift.

    Raises:
        ValueError: wrong shapes, fewer than two pictures, or no such reference.

    Gradient: of the resampling to the images; the motion carries none.
    Source: G. Evangelidis, E. Psarakis, "Parametric image alignment using enhanced correlation coefficient", 2008.
    """
    sizes = check("align_stack", images=(images, "B S C H W"))
    B, S = sizes["B"], sizes["S"]
    _check_two_images("align", S)
    middle = S // 2 if reference is None else reference
    if not 0 <= middle < S:
        raise ValueError(f"align_stack: reference is {reference}, expected a position from 0 to {S - 1}")
    pictures = images / 255.0 if images.dtype == torch.uint8 else images
    with torch.no_grad():
        soft = [gaussian_blur(filters.grayscale(pictures[:, k]), blur_px) for k in range(S)]
        found = [pictures.new_zeros(B, 3) for _ in range(S)]
        for k in [*range(middle - 1, -1, -1), *range(middle + 1, S)]:
            start = found[k + 1] if k < middle else found[k - 1]
            found[k] = _register_similarity(soft[middle], soft[k], start, iterations)
    moved = [_resample(pictures[:, k], found[k]) if k != middle else pictures[:, k] for k in range(S)]
    return torch.stack(moved, 1), torch.stack(found, 1)


def _register_similarity(fixed: Tensor, moving: Tensor, motion: Tensor, iterations: int) -> Tensor:
    """Gauss–Newton for magnification and shift (B, 3) of ``moving`` against ``fixed`` (B, 1, H, W)."""
    inner = slice(8, -8)
    x, y = _offsets_from_centre(fixed)
    scale = float(max(fixed.shape[-2:])) / 2  # magnification in pixels at the border: unknowns of like size
    target = _standardise(fixed[..., inner, inner])
    for _ in range(iterations):
        seen = _resample(moving, motion)
        across = correlate_separable(seen, [1.0], [-0.5, 0.0, 0.5])[..., inner, inner]
        down = correlate_separable(seen, [-0.5, 0.0, 0.5], [1.0])[..., inner, inner]
        part = seen[..., inner, inner]
        spread = part.var((-2, -1), correction=0, keepdim=True).clamp_min(1e-12).sqrt()
        radial = (across * x[:, inner] + down * y[inner]) / scale
        J = torch.stack((radial, across, down), -1) / spread[..., None]
        J = (J - J.mean((-3, -2), keepdim=True)).flatten(1, 3).double()  # (B, P, 3)
        r = (target - _standardise(part)).flatten(1).double()
        normal = (J[..., :, None] * J[..., None, :]).sum(1) + 1e-9 * torch.eye(3, dtype=torch.float64, device=J.device)
        step = torch.linalg.solve(normal, (J * r[..., None]).sum(1)).to(motion.dtype)
        step = step.clamp(-4, 4)
        motion = motion + torch.stack((step[:, 0] / scale, step[:, 1], step[:, 2]), -1)
    return motion


def _resample(picture: Tensor, motion: Tensor) -> Tensor:
    """Pictures (B, C, H, W) read at x (1 + m) + shift, bicubic, by kornia."""
    H, W = picture.shape[-2:]
    x, y = _offsets_from_centre(picture)
    m, du, dv = (motion[:, k, None, None] for k in range(3))
    u, v = x * (1 + m) + du + (W - 1) / 2, y * (1 + m) + dv + (H - 1) / 2
    u, v = u.expand(-1, H, W), v.expand(-1, H, W)
    return remap(picture, u, v, mode="bicubic", padding_mode="border", align_corners=True)


def _offsets_from_centre(picture: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels right of (1, W) and below (H, 1) the middle of the picture."""
    H, W = picture.shape[-2:]
    x = torch.arange(W, dtype=picture.dtype, device=picture.device) - (W - 1) / 2
    y = torch.arange(H, dtype=picture.dtype, device=picture.device) - (H - 1) / 2
    return x[None], y[:, None]


def _standardise(x: Tensor) -> Tensor:
    """Zero mean, unit variance over each picture."""
    x = x - x.mean((-2, -1), keepdim=True)
    return x / (x * x).mean((-2, -1), keepdim=True).clamp_min(1e-12).sqrt()


def _check_two_images(where: str, count: int) -> None:
    if count < 2:
        raise ValueError(f"{where}: found {count} picture, expected a stack of at least two, at different focus")
