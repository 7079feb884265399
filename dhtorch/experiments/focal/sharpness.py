"""Depth from focus: per-pixel sharpness of a focal stack, its maximum over the stack, and depth at that focus.

The classical recipe: a sharpness measure at every pixel of every image, the sharpest image of each pixel, and a
parabola through the log measure around it for a position between images. Images with motion or breathing
(magnification that changes with focus) are aligned first.

Alphabet: ``images`` (B, S, C, H, W), S images of one view; ``measured`` (B, S, H, W) sharpness; ``place`` (B, H, W)
fractional index in the stack.
"""

import torch
from kornia.geometry.transform import remap
from torch import Tensor

from dhtorch.geometry import filters
from dhtorch.geometry.checks import check
from dhtorch.geometry.filters import correlate_separable, gaussian_blur
from dhtorch.pytree import Record, record

#: Names of the sharpness measures.
SHARPNESS_MEASURES = ("modified_laplacian", "gradient_energy", "variance")


@record
class _FocusMap(Record):
    """Fractional index of the sharpest image at every pixel, with a confidence."""

    place: Tensor  # (B, H, W) index in the stack, in [0, S − 1]
    confidence: Tensor  # (B, H, W) in [0, 1]: 1 − mean / peak of the sharpness over the images


def measure_sharpness(
    images: Tensor,  # (B, S, C, H, W) C 1 or 3; float in [0, 1] or uint8
    measure: str = "modified_laplacian",
    *,
    window_px: float = 6.0,
) -> Tensor:
    """Sharpness (B, S, H, W) of every pixel in every image, averaged over a Gaussian window.

    ``modified_laplacian``: sum of the absolute second differences along both axes. ``gradient_energy``: sum of the
    squared first differences (Sobel). ``variance``: of the grey values in the window.

    Args:
        images: B stacks of at least two images.
        measure: one of :data:`SHARPNESS_MEASURES`.
        window_px: standard deviation of the window.

    Raises:
        ValueError: wrong shapes, fewer than two images, or an unknown measure.

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
        gradient_x, gradient_y = correlate_separable(grey, smooth, slope), correlate_separable(grey, slope, smooth)
        raw = gradient_x * gradient_x + gradient_y * gradient_y
    else:
        centred = grey - gaussian_blur(grey, window_px)
        raw = centred * centred
    return gaussian_blur(raw, window_px).view(sizes["B"], sizes["S"], sizes["H"], sizes["W"])


def find_sharpest(
    measured: Tensor,  # (B, S, H, W) not negative
) -> _FocusMap:
    """Index of the sharpest image of every pixel, refined between images by a Gaussian through three values.

    Confidence is 1 − mean / peak: 0 for equal sharpness in all images, at most 1 − 1 / S. A peak at the first or the
    last image is not refined, as the maximum may lie outside the stack.

    Raises:
        ValueError: wrong shapes or fewer than two images.

    Gradient: through the three sharpness values to ``measured``; the argmax carries none.
    """
    sizes = check("find_sharpest", measured=(measured, "B S H W"))
    _check_two_images("sharpest", sizes["S"])
    best = measured.detach().argmax(1, keepdim=True)
    left, peak, right = (measured.gather(1, (best + k).clamp(0, sizes["S"] - 1)) for k in (-1, 0, 1))
    has_peak = peak > 0
    floor = 1e-6 * torch.where(has_peak, peak, torch.ones_like(peak))
    a, b, c = (torch.log(torch.where(has_peak, x, torch.ones_like(x)) + floor) for x in (left, peak, right))
    curvature = a - 2 * b + c
    inner = (best > 0) & (best < sizes["S"] - 1) & (curvature < -1e-9)
    shift = torch.where(
        inner, 0.5 * (a - c) / torch.where(inner, curvature, -torch.ones_like(curvature)), torch.zeros_like(curvature)
    )
    mean = measured.mean(1, keepdim=True)
    confidence = torch.where(
        has_peak, 1 - mean / torch.where(has_peak, peak, torch.ones_like(peak)), torch.zeros_like(peak)
    )
    return _FocusMap((best + shift.clamp(-0.5, 0.5))[:, 0], confidence[:, 0])


def depth_at_focus(
    place: Tensor,  # (B, H, W)
    focus_m: Tensor | None,  # (B, S) m, of the images in their order
) -> Tensor:
    """Depth (B, H, W) m at fractional stack indices, by interpolating inverse focus distances, in which blur is linear.

    Raises:
        ValueError: no distances (which leaves only the order of depths), wrong shapes, or distances that are not
            strictly monotonic.

    Gradient: to ``place`` and the distances.
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
    """Align every image of a stack to the reference: images -> aligned images, motions.

    Magnification and shift of each image are estimated by Gauss–Newton on equally blurred images (focus mostly affects
    fine detail) with zero mean and unit variance, starting from the motion of the neighbour in the stack, whose focus
    is similar.

    Args:
        images: B stacks.
        reference: index of the image that is not moved; None = the middle one.
        blur_px: standard deviation of the blur before alignment.
        iterations: per image.

    Returns:
        images (B, S, C, H, W), float, borders repeated; motion (B, S, 3): magnification minus one, shift right and
        down in px, such that the pixel at x (from the centre) of the reference appears at x (1 + m) + shift.

    Raises:
        ValueError: wrong shapes, fewer than two images, or no such reference.

    Gradient: through the resampling to the images; the motion carries none.
    Source: G. Evangelidis, E. Psarakis, "Parametric image alignment using enhanced correlation coefficient", 2008.
    """
    sizes = check("align_stack", images=(images, "B S C H W"))
    B, S = sizes["B"], sizes["S"]
    _check_two_images("align", S)
    middle = S // 2 if reference is None else reference
    if not 0 <= middle < S:
        raise ValueError(f"align_stack: reference is {reference}, expected a position from 0 to {S - 1}")
    scaled = images / 255.0 if images.dtype == torch.uint8 else images
    with torch.no_grad():
        blurred = [gaussian_blur(filters.grayscale(scaled[:, k]), blur_px) for k in range(S)]
        motions = [scaled.new_zeros(B, 3) for _ in range(S)]
        for k in [*range(middle - 1, -1, -1), *range(middle + 1, S)]:
            start = motions[k + 1] if k < middle else motions[k - 1]
            motions[k] = _register_similarity(blurred[middle], blurred[k], start, iterations)
    aligned = [_resample(scaled[:, k], motions[k]) if k != middle else scaled[:, k] for k in range(S)]
    return torch.stack(aligned, 1), torch.stack(motions, 1)


def _register_similarity(fixed: Tensor, moving: Tensor, motion: Tensor, iterations: int) -> Tensor:
    """Gauss–Newton estimate of magnification − 1 and shift (B, 3) of ``moving`` against ``fixed`` (B, 1, H, W)."""
    inner = slice(8, -8)
    x, y = _offsets_from_centre(fixed)
    scale = float(max(fixed.shape[-2:])) / 2  # magnification in pixels at the border: unknowns of similar scale
    target = _standardise(fixed[..., inner, inner])
    for _ in range(iterations):
        warped = _resample(moving, motion)
        gradient_x = correlate_separable(warped, [1.0], [-0.5, 0.0, 0.5])[..., inner, inner]
        gradient_y = correlate_separable(warped, [-0.5, 0.0, 0.5], [1.0])[..., inner, inner]
        cropped = warped[..., inner, inner]
        spread = cropped.var((-2, -1), correction=0, keepdim=True).clamp_min(1e-12).sqrt()
        radial = (gradient_x * x[:, inner] + gradient_y * y[inner]) / scale
        J = torch.stack((radial, gradient_x, gradient_y), -1) / spread[..., None]
        J = (J - J.mean((-3, -2), keepdim=True)).flatten(1, 3).double()  # (B, P, 3)
        r = (target - _standardise(cropped)).flatten(1).double()
        normal = (J[..., :, None] * J[..., None, :]).sum(1) + 1e-9 * torch.eye(3, dtype=torch.float64, device=J.device)
        step = torch.linalg.solve(normal, (J * r[..., None]).sum(1)).to(motion.dtype)
        step = step.clamp(-4, 4)
        motion = motion + torch.stack((step[:, 0] / scale, step[:, 1], step[:, 2]), -1)
    return motion


def _resample(images: Tensor, motion: Tensor) -> Tensor:
    """Images (B, C, H, W) sampled at x (1 + m) + shift, bicubic, by kornia."""
    H, W = images.shape[-2:]
    x, y = _offsets_from_centre(images)
    m, du, dv = (motion[:, k, None, None] for k in range(3))
    u, v = x * (1 + m) + du + (W - 1) / 2, y * (1 + m) + dv + (H - 1) / 2
    u, v = u.expand(-1, H, W), v.expand(-1, H, W)
    return remap(images, u, v, mode="bicubic", padding_mode="border", align_corners=True)


def _offsets_from_centre(images: Tensor) -> tuple[Tensor, Tensor]:
    """Pixel coordinates relative to the image centre: x (1, W) and y (H, 1)."""
    H, W = images.shape[-2:]
    x = torch.arange(W, dtype=images.dtype, device=images.device) - (W - 1) / 2
    y = torch.arange(H, dtype=images.dtype, device=images.device) - (H - 1) / 2
    return x[None], y[:, None]


def _standardise(x: Tensor) -> Tensor:
    """Images normalised to zero mean and unit variance each."""
    x = x - x.mean((-2, -1), keepdim=True)
    return x / (x * x).mean((-2, -1), keepdim=True).clamp_min(1e-12).sqrt()


def _check_two_images(where: str, count: int) -> None:
    """Raise ValueError for a stack of fewer than two images."""
    if count < 2:
        raise ValueError(f"{where}: found {count} picture, expected a stack of at least two, at different focus")
