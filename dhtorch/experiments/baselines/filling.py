"""The simplest dense map: the sensor's own returns carried on to where the picture looks alike.

No second view and no geometry: what it says beyond the sensor's reach is a guess from nearer surfaces.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from kornia.filters import joint_bilateral_blur
from torch import Tensor

from dhtorch.codes import Gate
from dhtorch.experiments.baselines.stereo import answer
from dhtorch.geometry import camera as cam
from dhtorch.geometry.patches import nearest
from dhtorch.pipeline.dense import resized
from dhtorch.records import Estimate, Frame, Samples

#: Longer side of the pictures, px; window and its spreads in space (px) and grey value.
SIZE, WINDOW, SPACE, GREY = 96, 9, 3.0, 0.1

#: Times that returns are carried on: windows reach across the picture.
ROUNDS = 30

#: Least weight of returns in a window that fills its middle.
LEAST = 1e-3


def bilateral(anchor: Frame, samples: Samples) -> Estimate:
    """Depth at the samples by joint bilateral filling (kornia's filter), round after round from the rim of a hole.

    Score falls with the rounds it took. Gate NO_TRACK where none reached.
    """
    picture = resized(anchor, SIZE)[0]
    h, w = picture.shape[-2:]
    known = (anchor.depth > 0) & anchor.depth.isfinite()
    weight = F.interpolate(known[:, None].to(picture), (h, w), mode="area")
    depth = F.interpolate(torch.where(known, anchor.depth, 0.0)[:, None].to(picture), (h, w), mode="area")
    depth = depth / weight.clamp_min(LEAST)
    told = weight > LEAST
    age = torch.zeros_like(depth)
    for k in range(ROUNDS):
        mass, total = (_blur(x, picture) for x in (told.to(depth), torch.where(told, depth, 0.0)))
        new = ~told & (mass > LEAST)
        depth = torch.where(new, total / mass.clamp_min(LEAST), depth)
        age = torch.where(new, 1.0 + k, age)
        told = told | new
    uv = cam.depth_pixels(anchor.camera, anchor.hw, None, (h, w), samples.uv)
    found = nearest(torch.where(told, depth, torch.nan)[:, 0], uv)[0]
    noise = 0.01 * (1 + nearest(age[:, 0], uv)[0])
    return answer(samples, found, noise, torch.where(found > 0, Gate.ANSWER, Gate.NO_TRACK))


def _blur(x: Tensor, guide: Tensor) -> Tensor:
    blurred: Tensor = joint_bilateral_blur(x, guide, WINDOW, GREY, (SPACE, SPACE))
    return blurred
