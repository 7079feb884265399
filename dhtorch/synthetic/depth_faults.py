"""Simulated depth faults: errors of networks, sensors and data files applied to true depth maps.

Every fault maps a true depth map (B, h, w) in m, 0 = none, to a map of the same size with as many zeros or fewer.
Random faults draw from a seed on the CPU, the same for every map of a batch, so that a map's fault does not depend on
its batch mates.
"""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from dhtorch.geometry.checks import check
from dhtorch.geometry.filters import gaussian_blur
from dhtorch.geometry.patches import rescale_field_of_view

#: Structured light: f · baseline of the disparity f · baseline / z, px · m, and the step of the disparity, px.
_FOCAL_BASELINE_PX_M, _DISPARITY_STEP_PX = 580 * 0.075, 0.125

#: Ratio of two depths from which they belong to different surfaces. Source: chosen, steeper surfaces are not mixed.
_SIDE_RATIO = 1.2

#: Ghosts: depth below which a sensor returns a false depth, m, and the least and the largest false depth, m.
#: Source: chosen, minimum ranges of phone LiDARs and depth cameras.
_MIN_RANGE_M, _GHOST_DEPTH_M = 0.35, (1.0, 10.0)

#: Relative change of depth above which a pixel of a faulty map counts as wrong.
_MIN_WRONG_REL = 0.02

DepthFault = Callable[[Tensor, Generator], Tensor]


def scale_depth(depth: Tensor, factor: float) -> Tensor:
    """The map with all depths multiplied by ``factor``."""
    return depth * factor


def tilt_depth(depth: Tensor, share: float, angle: float) -> Tensor:
    """The map with depths that grow by the fraction ``share`` across the image, in the direction ``angle`` (rad)."""
    x, y = _pixel_grid(depth)
    return depth * (1 + 0.5 * share * (math.cos(angle) * x + math.sin(angle) * y))


def _warp_depth(depth: Tensor, sigma: float, generator: Generator) -> Tensor:
    """The map with smooth errors: waves of mean zero and standard deviation ``sigma`` added to its log depth."""
    x, y = _pixel_grid(depth)
    field = torch.zeros_like(x + y)
    for _ in range(6):
        across, down, phase = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
        across, down = (2.5 * (2 * u - 1) for u in (across, down))
        field = field + torch.cos(math.pi * (across * x + down * y) + 2 * math.pi * phase)
    field = (field - field.mean()) / field.std().clamp_min(1e-6)
    return depth * (sigma * field).exp()


def _blur_depth(depth: Tensor, share: float = 0.012) -> Tensor:
    """The map with edges that mix foreground and background: Gaussian mean of the valid depths around each pixel."""
    sigma_px = max(0.5, share * depth.shape[-1])
    valid = (depth > 0).to(depth)
    mean = gaussian_blur(depth[:, None], sigma_px) / gaussian_blur(valid[:, None], sigma_px).clamp_min(1e-6)
    return torch.where(depth > 0, mean[:, 0], 0.0)


def _move_objects(depth: Tensor, generator: Generator) -> Tensor:
    """The map with three displaced objects: the pixels around a random pixel, at about its depth, times three."""
    faulty = depth
    for u, v in _draw_pixels(depth, generator, 3):
        middle = depth[:, v, u][:, None, None]
        level = (depth / middle.clamp_min(1e-6)).clamp_min(1e-6).log().abs() < 0.08
        inside = (_pixel_distance(depth, u, v) < 0.12) & level & (depth > 0) & (middle > 0)
        faulty = torch.where(inside, 3.0 * depth, faulty)
    return faulty


def _fill_discs(depth: Tensor, generator: Generator) -> Tensor:
    """The map with smoothly invented discs: the blurred surroundings times a smooth factor."""
    blurred = _blur_depth(depth, 0.1)
    faulty = depth
    for u, v in _draw_pixels(depth, generator, 4):
        off = 0.25 * (2 * float(torch.rand((), generator=generator)) - 1)
        x, y = _pixel_grid(depth)
        r = _pixel_distance(depth, u, v) / 0.1
        invented = blurred * (1 + off * (1 - r.square()).clamp_min(0) + 0.05 * off * (x + y))
        faulty = torch.where((r < 1) & (depth > 0), invented, faulty)
    return faulty


def _depth_of_steps(depth: Tensor, steps: Tensor) -> Tensor:
    """The map with quantised disparity, as of structured light; no depth below half a disparity step."""
    return torch.where(
        (depth > 0) & (steps >= 1), _FOCAL_BASELINE_PX_M / (steps.clamp_min(1) * _DISPARITY_STEP_PX), 0.0
    )


def mirror_depth(depth: Tensor) -> Tensor:
    """The map mirrored left to right."""
    return depth.flip(-1)


def _clip_far_depth(depth: Tensor, _: Generator) -> Tensor:
    """The map clipped at the quantile 0.6 of its depths, as by a file format with too few bits."""
    valid = torch.where(depth > 0, depth, torch.inf).flatten(1).sort(-1).values
    last = (0.6 * ((depth > 0).flatten(1).sum(-1) - 1).clamp_min(0)).long()
    return depth.minimum(valid.gather(1, last[:, None])[..., None])


def _mix_outlines(depth: Tensor, generator: Generator) -> Tensor:
    """The map with flying pixels: along outlines, random pixels with a random mean of the foreground's and the
    background's depth."""
    share, weight = torch.rand(2, *depth.shape[-2:], generator=generator, dtype=torch.float64).to(depth)
    near, far = _extreme_neighbours(depth)
    weight = 0.1 + 0.8 * weight
    mixed = (depth > 0) & (far > _SIDE_RATIO * near) & (share < 0.6)
    return torch.where(mixed, weight * near + (1 - weight) * far, depth)


def _bleed_edges(depth: Tensor, generator: Generator) -> Tensor:
    """The map with a foreground that spreads over its background by two to six pixels."""
    for _ in range(int(torch.randint(2, 7, (), generator=generator))):  # of maps that were upsampled by two to six
        near, _ = _extreme_neighbours(depth)
        depth = torch.where((depth > 0) & (near < depth / _SIDE_RATIO), near, depth)
    return depth


def _ghost_returns(depth: Tensor, generator: Generator) -> Tensor:
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


#: Faults of network predictions: of shape and scale, alone and combined.
NETWORK_FAULTS: dict[str, DepthFault] = {
    "scale_short": lambda depth, _: scale_depth(depth, 0.8),
    "scale_long": lambda depth, _: scale_depth(depth, 1.25),
    "shift": lambda depth, _: torch.where(depth > 0, (depth + 0.15).clamp_min(0).maximum(0.01 * depth), 0.0),
    "tilt": lambda depth, _: tilt_depth(depth, share=0.1, angle=0.6),
    "warp_small": lambda depth, g: _warp_depth(depth, 0.013, g),
    "warp_large": lambda depth, g: _warp_depth(depth, 0.05, g),
    "simulated": lambda depth, g: scale_depth(_warp_depth(depth, 0.013, g), 1.05),
    "blur": lambda depth, _: _blur_depth(depth),
    "jumps": _move_objects,
    "invented": _fill_discs,
    "quantised": lambda depth, _: _depth_of_steps(
        depth, (_FOCAL_BASELINE_PX_M / depth.clamp_min(1e-6) / _DISPARITY_STEP_PX).round()
    ),
}

#: Faults of sensors and data sets applied to correct maps.
FILE_FAULTS: dict[str, DepthFault] = {
    "unit": lambda depth, _: scale_depth(depth, 5.0),
    "mirrored": lambda depth, _: mirror_depth(depth),
    "rolled": lambda depth, _: depth.roll(round(0.1 * depth.shape[-1]), -1),
    "wrong_k": lambda depth, _: rescale_field_of_view(depth, factor=1.1),
}
DEPTH_FAULTS = NETWORK_FAULTS | FILE_FAULTS

#: Faults of file formats that leave only a lower bound of the depth.
FORMAT_FAULTS: dict[str, DepthFault] = {"cut": _clip_far_depth}

#: Faults of a sensor at single pixels, by the name of their cause in :class:`dhtorch.codes.WrongCause`.
RETURN_FAULTS: dict[str, DepthFault] = {
    "ghost": _ghost_returns,
    "flying_pixel": _mix_outlines,
    "edge_bleed": _bleed_edges,
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
