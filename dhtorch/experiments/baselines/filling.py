"""Dense depth from one view by joint bilateral filling of the sensor's returns, guided by the image.

It uses no second view and no geometry: beyond the sensor's range it extrapolates nearer surfaces.
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

#: Longer side of the filtered images, px.
_MAX_SIDE_PX = 96

#: Side of the filter's window, px.
_FILTER_WINDOW_PX = 9

#: Standard deviation of the filter in space, px.
_SPATIAL_SIGMA_PX = 3.0

#: Standard deviation of the filter in grey value.
_GREY_SIGMA = 0.1

#: Rounds of filling; with them windows reach across the image.
_N_ROUNDS = 30

#: Least weight of returns in a window to fill its centre.
_MIN_WEIGHT = 1e-3


def fill_bilateral(reference: Frame, samples: Samples) -> Estimate:
    """Depth at the samples by joint bilateral filling (kornia's filter), round after round from the rim of a hole.

    The score decreases with the number of rounds until a pixel is filled. Gate NO_TRACK where it is not filled.
    """
    image = downscale_grey(reference, _MAX_SIDE_PX)[0]
    h, w = image.shape[-2:]
    has_return = (reference.depth > 0) & reference.depth.isfinite()
    weight = F.interpolate(has_return[:, None].to(image), (h, w), mode="area")
    depth = F.interpolate(torch.where(has_return, reference.depth, 0.0)[:, None].to(image), (h, w), mode="area")
    depth = depth / weight.clamp_min(_MIN_WEIGHT)
    filled = weight > _MIN_WEIGHT
    round_filled = torch.zeros_like(depth)
    for k in range(_N_ROUNDS):
        mass, total = (_joint_bilateral_blur(x, image) for x in (filled.to(depth), torch.where(filled, depth, 0.0)))
        new = ~filled & (mass > _MIN_WEIGHT)
        depth = torch.where(new, total / mass.clamp_min(_MIN_WEIGHT), depth)
        round_filled = torch.where(new, 1.0 + k, round_filled)
        filled = filled | new
    uv = cam.depth_pixels(reference.camera, reference.hw, None, (h, w), samples.uv)
    depth_at_samples = sample_nearest(torch.where(filled, depth, torch.nan)[:, 0], uv)[0]
    noise = 0.01 * (1 + sample_nearest(round_filled[:, 0], uv)[0])
    return estimate_from_depth(
        samples, depth_at_samples, noise, torch.where(depth_at_samples > 0, Gate.ANSWER, Gate.NO_TRACK)
    )


def _joint_bilateral_blur(x: Tensor, guide: Tensor) -> Tensor:
    blurred: Tensor = joint_bilateral_blur(
        x, guide, _FILTER_WINDOW_PX, _GREY_SIGMA, (_SPATIAL_SIGMA_PX, _SPATIAL_SIGMA_PX)
    )
    return blurred
