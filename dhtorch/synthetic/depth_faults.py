"""Simulated depth faults: errors of networks, sensors and data files applied to true depth maps.

Every fault maps a true depth map (B, h, w) in m, 0 = none, to a map of the same size with as many zeros or fewer.
Random faults draw from a seed on the CPU, the same for every map of a batch, so that a map's fault does not depend on
its batch mates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from dhtorch.geometry.checks import check
from dhtorch.geometry.filters import gaussian_blur
from dhtorch.geometry.patches import rescale_field_of_view

#: Scale factors of the scale faults, and the shift of the shift fault, m.
_SCALE_FACTORS, _SHIFT_M = (0.8, 1.25), 0.15

#: Tilt: relative change of depth from one side of the image to the other.
_TILT_SHARE = 0.10

#: Standard deviations of low-frequency warps, of log depth, and their largest number of waves across the image.
_WARP_SIGMAS, _MAX_WARP_WAVES = (0.013, 0.05), 2.5

#: Standard deviation of the blur that mixes both sides of an edge, as a fraction of the width.
_BLUR_SIGMA_REL = 0.012

#: Local jumps: number of objects, the factor on their depth (0.6 m → 1.8 m), the radius of an object as a fraction of
#: the width, and the largest difference of its log depth from that of its centre.
_N_JUMPS, _JUMP_FACTOR, _JUMP_RADIUS_REL, _JUMP_MAX_LOG_STEP = 3, 3.0, 0.12, 0.08

#: Invented depth: number of discs filled smoothly, their radius as a fraction of the width, and the largest error.
_N_DISCS, _DISC_RADIUS_REL, _MAX_INVENTED_REL = 4, 0.10, 0.25

#: Structured light: f · baseline of the disparity f · baseline / z, px · m, and the step of the disparity, px.
_FOCAL_BASELINE_PX_M, _DISPARITY_STEP_PX = 580 * 0.075, 0.125

#: Factor of a wrong unit (5000 per metre read as 1000 per metre), and factor of a focal length that is too long.
_UNIT_FACTOR, _FOCAL_FACTOR = 5.0, 1.1

#: Sideways shift of a rolled map, as a fraction of its width.
_ROLL_SHARE = 0.1

#: Quantile of depth at which a map is clipped.
_CLIP_SHARE = 0.6

#: Ratio of two depths from which they belong to different surfaces. Source: chosen, steeper surfaces are not mixed.
_SIDE_RATIO = 1.2

#: Flying pixels: fraction of the pixels along an outline, one on either side of it, that are mixed, and the least
#: weight of either side. Source: chosen, a time-of-flight camera without a filter.
_FLYING_SHARE, _MIN_FLYING_WEIGHT = 0.6, 0.1

#: Edge bleed: fewest and most pixels by which a foreground spreads over its background. Source: chosen, depth maps that
#: were upsampled by two to six.
_BLEED_PX = (2, 6)

#: Ghosts: depth below which a sensor returns a false depth, m, and the least and the largest false depth, m.
#: Source: chosen, minimum ranges of phone LiDARs and depth cameras.
_MIN_RANGE_M, _GHOST_DEPTH_M = 0.35, (1.0, 10.0)

#: Relative change of depth above which a pixel of a faulty map counts as wrong.
_MIN_WRONG_REL = 0.02

DepthFault = Callable[[Tensor, Generator], Tensor]


def scale_depth(depth: Tensor, factor: float) -> Tensor:
    """The map with all depths multiplied by ``factor``."""
    return depth * factor


def shift_depth(depth: Tensor, shift: float) -> Tensor:
    """The map with ``shift`` m added to all depths, which remain at least a hundredth of the original."""
    return torch.where(depth > 0, (depth + shift).clamp_min(0).maximum(0.01 * depth), 0.0)


def tilt_depth(depth: Tensor, share: float, angle: float) -> Tensor:
    """The map with depths that grow by the fraction ``share`` across the image, in the direction ``angle`` (rad)."""
    x, y = _pixel_grid(depth)
    return depth * (1 + 0.5 * share * (math.cos(angle) * x + math.sin(angle) * y))


def warp_depth(depth: Tensor, sigma: float, generator: Generator) -> Tensor:
    """The map with smooth errors: waves of mean zero and standard deviation ``sigma`` added to its log depth."""
    x, y = _pixel_grid(depth)
    field = torch.zeros_like(x + y)
    for _ in range(6):
        across, down, phase = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
        across, down = (_MAX_WARP_WAVES * (2 * u - 1) for u in (across, down))
        field = field + torch.cos(math.pi * (across * x + down * y) + 2 * math.pi * phase)
    field = (field - field.mean()) / field.std().clamp_min(1e-6)
    return depth * (sigma * field).exp()


def blur_depth(depth: Tensor, share: float = _BLUR_SIGMA_REL) -> Tensor:
    """The map with edges that mix foreground and background: Gaussian mean of the valid depths around each pixel."""
    sigma_px = max(0.5, share * depth.shape[-1])
    valid = (depth > 0).to(depth)
    mean = gaussian_blur(depth[:, None], sigma_px) / gaussian_blur(valid[:, None], sigma_px).clamp_min(1e-6)
    return torch.where(depth > 0, mean[:, 0], 0.0)


def move_objects(depth: Tensor, generator: Generator, *, n: int = _N_JUMPS, factor: float = _JUMP_FACTOR) -> Tensor:
    """The map with ``n`` displaced objects: the pixels around a random pixel, at about its depth, times ``factor``."""
    faulty = depth
    for u, v in _draw_pixels(depth, generator, n):
        middle = _depth_at(depth, u, v)
        level = (depth / middle.clamp_min(1e-6)).clamp_min(1e-6).log().abs() < _JUMP_MAX_LOG_STEP
        inside = _is_within(depth, u, v, _JUMP_RADIUS_REL) & level & (depth > 0) & (middle > 0)
        faulty = torch.where(inside, factor * depth, faulty)
    return faulty


def fill_discs(depth: Tensor, generator: Generator) -> Tensor:
    """The map with smoothly invented discs: the blurred surroundings times a smooth factor."""
    blurred = blur_depth(depth, _DISC_RADIUS_REL)
    faulty = depth
    for u, v in _draw_pixels(depth, generator, _N_DISCS):
        off = _MAX_INVENTED_REL * (2 * float(torch.rand((), generator=generator)) - 1)
        x, y = _pixel_grid(depth)
        r = _pixel_distance(depth, u, v) / _DISC_RADIUS_REL
        invented = blurred * (1 + off * (1 - r.square()).clamp_min(0) + 0.05 * off * (x + y))
        faulty = torch.where((r < 1) & (depth > 0), invented, faulty)
    return faulty


def quantise_disparity(depth: Tensor) -> Tensor:
    """The map with quantised disparity, as of structured light; no depth below half a disparity step."""
    steps = (_FOCAL_BASELINE_PX_M / depth.clamp_min(1e-6) / _DISPARITY_STEP_PX).round()
    return torch.where(
        (depth > 0) & (steps >= 1), _FOCAL_BASELINE_PX_M / (steps.clamp_min(1) * _DISPARITY_STEP_PX), 0.0
    )


def mirror_depth(depth: Tensor) -> Tensor:
    """The map mirrored left to right."""
    return depth.flip(-1)


def roll_depth(depth: Tensor, share: float = _ROLL_SHARE) -> Tensor:
    """The map rolled to the right by the fraction ``share`` of its width."""
    return depth.roll(round(share * depth.shape[-1]), -1)


def clip_far_depth(depth: Tensor, nearer: float = _CLIP_SHARE) -> Tensor:
    """The map clipped at the quantile ``nearer`` of its depths, as by a file format with too few bits."""
    valid = torch.where(depth > 0, depth, torch.inf).flatten(1).sort(-1).values
    last = (nearer * ((depth > 0).flatten(1).sum(-1) - 1).clamp_min(0)).long()
    return depth.minimum(valid.gather(1, last[:, None])[..., None])


def mix_outlines(depth: Tensor, generator: Generator) -> Tensor:
    """The map with flying pixels: along outlines, random pixels with a random mean of the foreground's and the
    background's depth."""
    share, weight = torch.rand(2, *depth.shape[-2:], generator=generator, dtype=torch.float64).to(depth)
    near, far = _extreme_neighbours(depth)
    weight = _MIN_FLYING_WEIGHT + (1 - 2 * _MIN_FLYING_WEIGHT) * weight
    mixed = (depth > 0) & (far > _SIDE_RATIO * near) & (share < _FLYING_SHARE)
    return torch.where(mixed, weight * near + (1 - weight) * far, depth)


def bleed_edges(depth: Tensor, generator: Generator, *, foreground: bool = True) -> Tensor:
    """The map with a foreground that spreads over its background by two to six pixels, or the reverse."""
    low, high = _BLEED_PX
    for _ in range(int(torch.randint(low, high + 1, (), generator=generator))):
        near, far = _extreme_neighbours(depth)
        spread = near if foreground else far
        reached = (spread < depth / _SIDE_RATIO) if foreground else (spread > depth * _SIDE_RATIO)
        depth = torch.where((depth > 0) & reached, spread, depth)
    return depth


def ghost_returns(depth: Tensor, generator: Generator) -> Tensor:
    """The map with a smooth false depth of 1 to 10 m where the true one is below the sensor's minimum range."""
    low, high = _GHOST_DEPTH_M
    middle, slope = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
    x, y = _pixel_grid(depth)
    false_depth = (low * (high / low) ** middle * (1 + 0.1 * (slope - 0.5) * (x + y))).clamp(low, high)
    return torch.where((depth > 0) & (depth < _MIN_RANGE_M), false_depth, depth)


def _extreme_neighbours(depth: Tensor) -> tuple[Tensor, Tensor]:
    """Least and largest depth (B, h, w) in the 3 × 3 window around each pixel, holes left out."""
    near = -F.max_pool2d(-torch.where(depth > 0, depth, torch.inf)[:, None], 3, 1, 1)[:, 0]
    return near, F.max_pool2d(depth[:, None], 3, 1, 1)[:, 0]


def _deterministic(fault: Callable[[Tensor], Tensor]) -> DepthFault:
    """A deterministic fault as a :data:`DepthFault`, which ignores the generator."""
    return lambda depth, _generator: fault(depth)


#: Faults of network predictions: of shape and scale, alone and combined.
NETWORK_FAULTS: dict[str, DepthFault] = {
    "scale_short": _deterministic(partial(scale_depth, factor=_SCALE_FACTORS[0])),
    "scale_long": _deterministic(partial(scale_depth, factor=_SCALE_FACTORS[1])),
    "shift": _deterministic(partial(shift_depth, shift=_SHIFT_M)),
    "tilt": _deterministic(partial(tilt_depth, share=_TILT_SHARE, angle=0.6)),
    "warp_small": lambda depth, g: warp_depth(depth, _WARP_SIGMAS[0], g),
    "warp_large": lambda depth, g: warp_depth(depth, _WARP_SIGMAS[1], g),
    "simulated": lambda depth, g: scale_depth(warp_depth(depth, _WARP_SIGMAS[0], g), 1.05),
    "blur": _deterministic(blur_depth),
    "jumps": move_objects,
    "invented": fill_discs,
    "quantised": _deterministic(quantise_disparity),
}

#: Faults of sensors and data sets applied to correct maps.
FILE_FAULTS: dict[str, DepthFault] = {
    "unit": _deterministic(partial(scale_depth, factor=_UNIT_FACTOR)),
    "mirrored": _deterministic(mirror_depth),
    "rolled": _deterministic(roll_depth),
    "wrong_k": _deterministic(partial(rescale_field_of_view, factor=_FOCAL_FACTOR)),
}
DEPTH_FAULTS = NETWORK_FAULTS | FILE_FAULTS

#: Faults of file formats that leave only a lower bound of the depth.
FORMAT_FAULTS: dict[str, DepthFault] = {"cut": _deterministic(clip_far_depth)}

#: Faults of a sensor at single pixels, by the name of their cause in :class:`dhtorch.codes.WrongCause`.
RETURN_FAULTS: dict[str, DepthFault] = {
    "ghost": ghost_returns,
    "flying_pixel": mix_outlines,
    "edge_bleed": bleed_edges,
}

#: The fault of using the map of another frame.
WRONG_TIME = "time"


def apply_fault(
    name: str,
    depth: Tensor,  # (B, h, w) m, 0 = none
    *,
    seed: int = 0,
    other: Tensor | None = None,  # (B, h, w) m, of another time
) -> tuple[Tensor, Tensor]:
    """The map with a fault, and a mask of pixels wrong by more than ``_MIN_WRONG_REL``, (B, h, w) each.

    Args:
        name: of :data:`DEPTH_FAULTS`, :data:`FORMAT_FAULTS` or :data:`RETURN_FAULTS`, or ``time``.
        depth: the true map.
        seed: of the random draws.
        other: the map that ``time`` returns.

    Raises:
        ValueError: an unknown fault, no map of another time, or wrong shapes.

    Gradient: to ``depth`` where the fault is a function of values, not of pixel positions.
    """
    check("apply_fault", depth=(depth, "B h w"), other=(other, "B h w"))
    if name == WRONG_TIME:
        if other is None:
            raise ValueError("apply_fault: found no map of another time, expected other=")
        faulty = other
    elif name in (faults := DEPTH_FAULTS | FORMAT_FAULTS | RETURN_FAULTS):
        faulty = faults[name](depth, Generator().manual_seed(seed))
    else:
        raise ValueError(f"apply_fault: found {name!r}, expected one of {', '.join((*faults, WRONG_TIME))}")
    wrong = (faulty > 0) & (depth > 0) & ((faulty - depth).abs() > _MIN_WRONG_REL * depth)
    return faulty, wrong


def _pixel_grid(depth: Tensor) -> tuple[Tensor, Tensor]:
    """Columns (1, w) and rows (h, 1) of a map from -1 to 1."""
    h, w = depth.shape[-2:]
    x, y = (torch.linspace(-1, 1, n, dtype=depth.dtype, device=depth.device) for n in (w, h))
    return x[None], y[:, None]


def _draw_pixels(depth: Tensor, generator: Generator, n: int) -> list[tuple[int, int]]:
    """Columns and rows of ``n`` random pixels away from the border."""
    h, w = depth.shape[-2:]
    share = 0.1 + 0.8 * torch.rand(n, 2, generator=generator, dtype=torch.float64)
    return [(int(x * w), int(y * h)) for x, y in share.tolist()]


def _pixel_distance(depth: Tensor, u: int, v: int) -> Tensor:
    """Distance (h, w) of every pixel from the pixel (u, v), in widths of the map."""
    h, w = depth.shape[-2:]
    rows, columns = (torch.arange(n, dtype=depth.dtype, device=depth.device) for n in (h, w))
    return ((columns[None] - u).square() + (rows[:, None] - v).square()).sqrt() / w


def _is_within(depth: Tensor, u: int, v: int, radius: float) -> Tensor:
    return _pixel_distance(depth, u, v) < radius


def _depth_at(depth: Tensor, u: int, v: int) -> Tensor:
    """Depth (B, 1, 1) at the pixel (u, v)."""
    return depth[:, v, u][:, None, None]
