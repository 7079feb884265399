"""A depth map gone wrong in a known way: what networks, sensors and hands full of files do to depth.

Every fault takes a true map (B, h, w) in m, 0 where there is none, and gives a map of the same size with as many zeros
or fewer. Random ones draw from a seed on the CPU, the same for every map of a batch, so that a map's fault does not
depend on its batch mates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Generator, Tensor

from dhtorch.geometry.checks import check
from dhtorch.geometry.filters import gaussian_blur
from dhtorch.geometry.patches import rescale_field_of_view

#: Scales of a map that is otherwise right, and the shift of one, m.
_SCALE_FACTORS, _SHIFT_M = (0.8, 1.25), 0.15

#: Tilt: share of the depth from one side of the picture to the other.
_TILT_SHARE = 0.10

#: Standard deviations of low-frequency warps, of log depth, and how many waves they have across the picture at most.
_WARP_SIGMAS, _MAX_WARP_WAVES = (0.013, 0.05), 2.5

#: Standard deviation of the blur that mixes both sides of an edge, as a share of the width.
_BLUR_SIGMA_REL = 0.012

#: Local jumps: so many objects moved away by this factor (0.6 m → 1.8 m), each of pixels within a share of the width
#: whose depth differs little from that of the middle.
_N_JUMPS, _JUMP_FACTOR, _JUMP_RADIUS_REL, _JUMP_MAX_LOG_STEP = 3, 3.0, 0.12, 0.08

#: Inventions: so many discs of this radius (share of the width) are cut out and filled smoothly, off by this at most.
_N_DISCS, _DISC_RADIUS_REL, _MAX_INVENTED_REL = 4, 0.10, 0.25

#: Structured light: disparities of f · baseline / z px come in eighths.
_FOCAL_BASELINE_PX_M, _DISPARITY_STEP_PX = 580 * 0.075, 0.125

#: A unit of another data set (5000 a metre read as 1000), and a focal length that is too long by this factor.
_UNIT_FACTOR, _FOCAL_FACTOR = 5.0, 1.1

#: A map that was rolled sideways by this share of its width.
_ROLL_SHARE = 0.1

#: A map that is cut where so many of its pixels are nearer.
_CLIP_SHARE = 0.6

#: From which relative change on a pixel of a faulty map counts as wrong.
_MIN_WRONG_REL = 0.02

DepthFault = Callable[[Tensor, Generator], Tensor]


def scale_depth(depth: Tensor, factor: float) -> Tensor:
    """The map in another metre."""
    return depth * factor


def shift_depth(depth: Tensor, shift: float) -> Tensor:
    """All depths ``shift`` m more, at least a hundredth of what they were."""
    return torch.where(depth > 0, (depth + shift).clamp_min(0).maximum(0.01 * depth), 0.0)


def tilt_depth(depth: Tensor, share: float, angle: float) -> Tensor:
    """Depths that grow by ``share`` from one side of the picture to the other, in the direction ``angle`` (rad)."""
    x, y = _pixel_grid(depth)
    return depth * (1 + 0.5 * share * (math.cos(angle) * x + math.sin(angle) * y))


def warp_depth(depth: Tensor, sigma: float, generator: Generator) -> Tensor:
    """A smooth error: log depth plus a few waves of standard deviation ``sigma``, of mean zero over the picture."""
    x, y = _pixel_grid(depth)
    field = torch.zeros_like(x + y)
    for _ in range(6):
        across, down, phase = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
        across, down = (_MAX_WARP_WAVES * (2 * u - 1) for u in (across, down))
        field = field + torch.cos(math.pi * (across * x + down * y) + 2 * math.pi * phase)
    field = (field - field.mean()) / field.std().clamp_min(1e-6)
    return depth * (sigma * field).exp()


def blur_depth(depth: Tensor, share: float = _BLUR_SIGMA_REL) -> Tensor:
    """Edges that mix foreground and background: the Gaussian mean of what is known around each pixel."""
    sigma_px = max(0.5, share * depth.shape[-1])
    known = (depth > 0).to(depth)
    mean = gaussian_blur(depth[:, None], sigma_px) / gaussian_blur(known[:, None], sigma_px).clamp_min(1e-6)
    return torch.where(depth > 0, mean[:, 0], 0.0)


def move_objects(depth: Tensor, generator: Generator, *, n: int = _N_JUMPS, factor: float = _JUMP_FACTOR) -> Tensor:
    """Objects that stand elsewhere: pixels around ``n`` places that lie as deep as the place does, ``factor`` times as
    deep."""
    found = depth
    for u, v in _draw_pixels(depth, generator, n):
        middle = _depth_at(depth, u, v)
        level = (depth / middle.clamp_min(1e-6)).clamp_min(1e-6).log().abs() < _JUMP_MAX_LOG_STEP
        inside = _is_within(depth, u, v, _JUMP_RADIUS_REL) & level & (depth > 0) & (middle > 0)
        found = torch.where(inside, factor * depth, found)
    return found


def fill_discs(depth: Tensor, generator: Generator) -> Tensor:
    """Holes filled with something smooth: discs in which the map is the blurred surroundings times a smooth factor."""
    wide = blur_depth(depth, _DISC_RADIUS_REL)
    found = depth
    for u, v in _draw_pixels(depth, generator, _N_DISCS):
        off = _MAX_INVENTED_REL * (2 * float(torch.rand((), generator=generator)) - 1)
        x, y = _pixel_grid(depth)
        r = _pixel_distance(depth, u, v) / _DISC_RADIUS_REL
        lie = wide * (1 + off * (1 - r.square()).clamp_min(0) + 0.05 * off * (x + y))
        found = torch.where((r < 1) & (depth > 0), lie, found)
    return found


def quantise_disparity(depth: Tensor) -> Tensor:
    """Depth of structured light, which comes in steps that grow as its square; none beyond what one step can tell."""
    steps = (_FOCAL_BASELINE_PX_M / depth.clamp_min(1e-6) / _DISPARITY_STEP_PX).round()
    return torch.where(
        (depth > 0) & (steps >= 1), _FOCAL_BASELINE_PX_M / (steps.clamp_min(1) * _DISPARITY_STEP_PX), 0.0
    )


def mirror_depth(depth: Tensor) -> Tensor:
    """Left for right."""
    return depth.flip(-1)


def roll_depth(depth: Tensor, share: float = _ROLL_SHARE) -> Tensor:
    """Columns moved to the right by a share of the width, those beyond the edge to the left."""
    return depth.roll(round(share * depth.shape[-1]), -1)


def clip_far_depth(depth: Tensor, nearer: float = _CLIP_SHARE) -> Tensor:
    """What is farther than a share of the pixels stands where that share ends, as where numbers of few bits run out."""
    known = torch.where(depth > 0, depth, torch.inf).flatten(1).sort(-1).values
    last = (nearer * ((depth > 0).flatten(1).sum(-1) - 1).clamp_min(0)).long()
    return depth.minimum(known.gather(1, last[:, None])[..., None])


def _deterministic(fault: Callable[[Tensor], Tensor]) -> DepthFault:
    """A fault without anything drawn."""
    return lambda depth, _generator: fault(depth)


#: What a network's map does wrong: shape and metre, alone and together.
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

#: What sensors and data sets do wrong with maps that are right by themselves.
FILE_FAULTS: dict[str, DepthFault] = {
    "unit": _deterministic(partial(scale_depth, factor=_UNIT_FACTOR)),
    "mirrored": _deterministic(mirror_depth),
    "rolled": _deterministic(roll_depth),
    "wrong_k": _deterministic(partial(rescale_field_of_view, factor=_FOCAL_FACTOR)),
}
DEPTH_FAULTS = NETWORK_FAULTS | FILE_FAULTS

#: What a format does to maps that are right by themselves, of which only a bound is left.
FORMAT_FAULTS: dict[str, DepthFault] = {"cut": _deterministic(clip_far_depth)}

#: A fault that is another frame's map: it is no function of this one.
WRONG_TIME = "time"


def apply_fault(
    name: str,
    depth: Tensor,  # (B, h, w) m, 0 = none
    *,
    seed: int = 0,
    other: Tensor | None = None,  # (B, h, w) m, of another time
) -> tuple[Tensor, Tensor]:
    """A map with a fault, and which of its pixels are wrong by more than ``_MIN_WRONG_REL``, (B, h, w) each.

    Args:
        name: of :data:`DEPTH_FAULTS` or :data:`FORMAT_FAULTS`, or ``time``.
        depth: the true map.
        seed: of what is drawn.
        other: what ``time`` gives instead.

    Raises:
        ValueError: an unknown fault, no map of another time, or wrong shapes.

    Gradient: to ``depth`` where the fault is a function of values, not through places.
    """
    check("apply_fault", depth=(depth, "B h w"), other=(other, "B h w"))
    if name == WRONG_TIME:
        if other is None:
            raise ValueError("apply_fault: found no map of another time, expected other=")
        found = other
    elif name in (known := DEPTH_FAULTS | FORMAT_FAULTS):
        found = known[name](depth, Generator().manual_seed(seed))
    else:
        raise ValueError(f"apply_fault: found {name!r}, expected one of {', '.join((*known, WRONG_TIME))}")
    wrong = (found > 0) & (depth > 0) & ((found - depth).abs() > _MIN_WRONG_REL * depth)
    return found, wrong


def _pixel_grid(depth: Tensor) -> tuple[Tensor, Tensor]:
    """Columns (1, w) and rows (h, 1) of a map from -1 to 1."""
    h, w = depth.shape[-2:]
    x, y = (torch.linspace(-1, 1, n, dtype=depth.dtype, device=depth.device) for n in (w, h))
    return x[None], y[:, None]


def _draw_pixels(depth: Tensor, generator: Generator, n: int) -> list[tuple[int, int]]:
    """Columns and rows of ``n`` places away from the border."""
    h, w = depth.shape[-2:]
    share = 0.1 + 0.8 * torch.rand(n, 2, generator=generator, dtype=torch.float64)
    return [(int(x * w), int(y * h)) for x, y in share.tolist()]


def _pixel_distance(depth: Tensor, u: int, v: int) -> Tensor:
    """Of every pixel (h, w) from a place, in widths of the map."""
    h, w = depth.shape[-2:]
    rows, columns = (torch.arange(n, dtype=depth.dtype, device=depth.device) for n in (h, w))
    return ((columns[None] - u).square() + (rows[:, None] - v).square()).sqrt() / w


def _is_within(depth: Tensor, u: int, v: int, radius: float) -> Tensor:
    return _pixel_distance(depth, u, v) < radius


def _depth_at(depth: Tensor, u: int, v: int) -> Tensor:
    """Depth (B, 1, 1) at a place."""
    return depth[:, v, u][:, None, None]
