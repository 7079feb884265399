"""No depth: the stored values that stand for *no return*, for all readers and transforms.

- *Codes*: 0, and 65535, the largest number of 16 bits, in whatever unit and integer type.
- *Metres*: NaN, infinite, zero and negative values; 65535 codes of a millimetre, 65.535; 65504, the largest half float;
  and 65535 itself.
- *Far constants*: the distance of the far plane, which simulators and networks write where the scene has no surface.
  The largest of about 1,000 evenly spaced values is one if all of these hold: it is at least 10 m; at least 1 % of them
  have exactly this value; others are nearer; and it is a whole multiple of 10 m, or the values between half of it and
  it are at most a twentieth as many. A wall seen from the front is nearer, or has floor, ceiling or side walls that
  reach up to it.

A true depth that equals one of these values by accident becomes a hole of one pixel. No value is capped.
"""

from typing import Final

import torch
from torch import Tensor

from dhtorch.geometry.checks import is_static

#: Depth codes that mean *no return*, 0 first. Source: derived, 0 by the convention of 16-bit PNG; 65535, unsigned
#: 16-bit saturation (ScanNet++, MatrixCity, Azure Kinect exports).
NO_DEPTH_CODES: Final = (0, 65535)

#: Values in m that mean *no return*.
#: Source: derived, 65535 / 1000; largest finite half float (UnrealCV, AirSim, Blender); 65535 as a float.
_NO_DEPTH_METRES: Final = (65.535, 65504.0, 65535.0)  # increasing

#: Relative rounding of these values in float32. Source: derived, some units of the last place, 1.2e-7.
_FLOAT32_ROUNDING: Final = 3e-7

#: Least distance of a far constant, m, beyond the surfaces of most rooms.
_MIN_FAR_M: Final = 10.0

#: Least share of the map's pixels that have a far constant. Source: chosen on the captures of DHTORCH_DATA, where no
#: share of the largest value from 10 m on is above 0.1 %.
_MIN_FAR_SHARE: Final = 0.01

#: Grid of distances, m, of which a far constant is usually a multiple. Source: chosen on far planes and
#: depth limits of simulators and data sets: 10, 20, 50, 80, 100, 200, 1000 m.
_FAR_GRID_M: Final = 10.0

#: Most values between half a far constant and it, per value equal to it.
_MAX_NEARBY_RATIO: Final = 0.05

#: Evenly spaced values of a map by which its far constant is found. Source: derived, ten times the reciprocal of the
#: least share.
_N_FAR_PROBES: Final = 1024


def clear_no_depth(depth: Tensor, unit: float = 1.0) -> Tensor:
    """Depth maps (…, h, w) in m, stored in steps of ``unit`` m -> the same with 0 where a value stands for no return.

    Gradient: to the values kept.
    """
    depth = torch.where((depth > 0) & (depth < torch.inf), depth, 0.0)
    return clear_far_constant(clear_saturated(depth, unit))


def clear_saturated(depth: Tensor, unit: float = 1.0) -> Tensor:
    """Depth (…) in m, finite and not negative, stored in steps of ``unit`` m -> the same with 0 where it is a saturated
    code."""
    for value in sorted((*_NO_DEPTH_METRES, NO_DEPTH_CODES[-1] * unit)):
        if _is_below(depth, value * (1 - _FLOAT32_ROUNDING)):
            return depth
        depth = depth.masked_fill((depth - value).abs() <= value * _FLOAT32_ROUNDING, 0.0)
    return depth


def clear_far_constant(depth: Tensor) -> Tensor:
    """Depth maps (…, h, w) in m, 0 = none -> the same with 0 where the value is a map's far constant, if it has one."""
    probes = depth.flatten(-2)[..., :: max(1, depth.shape[-2] * depth.shape[-1] // _N_FAR_PROBES)]
    if _is_below(probes, _MIN_FAR_M * (1 - _FLOAT32_ROUNDING)):
        return depth
    far = _find_far_constant(probes.detach())
    if not is_static(far) and not bool((far > 0).any()):
        return depth
    return depth.masked_fill(depth.detach() == far[..., None, None], 0.0)


def _find_far_constant(probes: Tensor) -> Tensor:
    """Probed values (…, k) of maps -> far constant (…) of each, NaN where it has none."""
    far = probes.amax(-1)
    n_far = (probes == far[..., None]).sum(-1)
    n_returns = (probes > 0).sum(-1)
    n_nearby = (probes > far[..., None] / 2).sum(-1) - n_far
    remainder = (far / _FAR_GRID_M - (far / _FAR_GRID_M).round()).abs() * _FAR_GRID_M
    on_grid = remainder <= far * _FLOAT32_ROUNDING
    is_far = (far >= _MIN_FAR_M * (1 - _FLOAT32_ROUNDING)) & (n_far >= _MIN_FAR_SHARE * probes.shape[-1])
    is_far = is_far & (n_returns > n_far) & (on_grid | (n_nearby <= _MAX_NEARBY_RATIO * n_far))
    return torch.where(is_far, far, torch.nan)


def _is_below(x: Tensor, limit: float) -> bool:
    """Whether all values are seen to be below a limit; reading them once is cheaper than changing them."""
    return x.numel() == 0 or (not is_static(x) and float(x.detach().amax()) < limit)
