"""The simplest dense map: the sensor's own returns carried on to where the picture looks alike.

No second view and no geometry: what it says beyond the sensor's reach is a guess from nearer surfaces.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from kornia.filters import joint_bilateral_blur
from torch import Tensor

from dhtorch.codes import Gate
from dhtorch.experiments.baselines.stereo import estimate_from_depth
from dhtorch.geometry import camera as cam
from dhtorch.geometry.patches import sample_nearest
from dhtorch.pipeline.dense import downscale_grey
from dhtorch.records import Estimate, Frame, Samples

#: Longer side of the pictures, px; window and its spreads in space (px) and grey value.
_MAX_SIDE_PX, _FILTER_WINDOW_PX, _SPATIAL_SIGMA_PX, _GREY_SIGMA = 96, 9, 3.0, 0.1

#: Times that returns are carried on: windows reach across the picture.
_N_ROUNDS = 30

#: Least weight of returns in a window that fills its middle.
_MIN_WEIGHT = 1e-3


def fill_bilateral(reference: Frame, samples: Samples) -> Estimate:
    """Depth at the samples by joint bilateral filling (kornia's filter), round after round from the rim of a hole.

    Score falls with the rounds it took. Gate NO_TRACK where none reached.
    """
    picture = downscale_grey(reference, _MAX_SIDE_PX)[0]
    h, w = picture.shape[-2:]
    known = (reference.depth > 0) & reference.depth.isfinite()
    weight = F.interpolate(known[:, None].to(picture), (h, w), mode="area")
    depth = F.interpolate(torch.where(known, reference.depth, 0.0)[:, None].to(picture), (h, w), mode="area")
    depth = depth / weight.clamp_min(_MIN_WEIGHT)
    told = weight > _MIN_WEIGHT
    age = torch.zeros_like(depth)
    for k in range(_N_ROUNDS):
        mass, total = (_joint_bilateral_blur(x, picture) for x in (told.to(depth), torch.where(told, depth, 0.0)))
        new = ~told & (mass > _MIN_WEIGHT)
        depth = torch.where(new, total / mass.clamp_min(_MIN_WEIGHT), depth)
        age = torch.where(new, 1.0 + k, age)
        told = told | new
    uv = cam.depth_pixels(reference.camera, reference.hw, None, (h, w), samples.uv)
    found = sample_nearest(torch.where(told, depth, torch.nan)[:, 0], uv)[0]
    noise = 0.01 * (1 + sample_nearest(age[:, 0], uv)[0])
    return estimate_from_depth(samples, found, noise, torch.where(found > 0, Gate.ANSWER, Gate.NO_TRACK))


def _joint_bilateral_blur(x: Tensor, guide: Tensor) -> Tensor:
    blurred: Tensor = joint_bilateral_blur(
        x, guide, _FILTER_WINDOW_PX, _GREY_SIGMA, (_SPATIAL_SIGMA_PX, _SPATIAL_SIGMA_PX)
    )
    return blurred
