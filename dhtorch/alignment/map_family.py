"""Family of a depth map: whether depth, or inverse depth, is linear in its values.

The error models (:mod:`dhtorch.alignment.error_model`) describe a map that is linear in depth up to a slow drift. A
disparity map or a z-buffer that is read as depth is not, and drift would hide that: the part of the map between near
returns would be answered as if it followed from them.
"""

from typing import Final

import torch
from torch import Tensor

from dhtorch.alignment.options import DEFAULT_ALIGNMENT_OPTIONS, AlignmentOptions
from dhtorch.alignment.references import MetricReferences
from dhtorch.geometry.covariance import masked_median
from dhtorch.geometry.least_squares import solve_spd

#: Families of maps that are read as depth: linear in depth; in inverse depth, rising (disparity) or falling with the
#: values (z-buffer of OpenGL, MuJoCo, PyBullet: 1 - near / depth, scaled).
MAP_FAMILIES: Final = ("depth", "disparity", "z-buffer")


def find_map_family(points: MetricReferences, options: AlignmentOptions = DEFAULT_ALIGNMENT_OPTIONS) -> Tensor:
    """References on a map that is read as depth -> index (B,) of its family in ``MAP_FAMILIES``.

    The family is that of depth unless the near returns contradict it: the least absolute relative error of a line from
    value to depth is above ``family_min_error``, and that of a line to inverse depth is below it by the factor
    ``family_max_ratio``. Gradient: none.
    """
    with torch.no_grad():
        near = points.used & points.near
        weight = points.weight(near, options)
        x = points.x - masked_median(points.x, near)
        spread = masked_median(x.abs(), near).clamp_min(1e-12)
        x = torch.where(near, x / spread, 0.0)
        errors, slopes = [], []
        for y in (points.depth, 1 / points.depth):
            line, ok = least_absolute_line(x, y, weight, options)
            error = masked_median(((x * line[:, :1] + line[:, 1:]) / y - 1).abs(), near)[:, 0]
            errors.append(torch.where(ok, error, torch.inf))
            slopes.append(line[:, 0])
        is_inverse = (
            (near.sum(-1) >= options.family_min_references)
            & (errors[0] > options.family_min_error)
            & (errors[1] < options.family_max_ratio * errors[0])
        )
        return torch.where(is_inverse, torch.where(slopes[1] > 0, 1, 2), 0)


def least_absolute_line(x: Tensor, y: Tensor, weight: Tensor, options: AlignmentOptions) -> tuple[Tensor, Tensor]:
    """Values (B, N), targets and weights -> the line (B, 2), slope and offset, of least absolute relative error, and
    whether it could be fitted (B,): least squares with weights, repeated (Huber's, with a small bend)."""
    A = torch.stack((x, torch.ones_like(x)), -1) / y[..., None]
    eye = 1e-9 * torch.eye(2).to(x)
    w = weight
    for _ in range(10):
        W = A * w[..., None]
        line, ok = solve_spd(W.mT @ A + eye, W.sum(1)[..., None])
        w = weight / (((A @ line)[..., 0] - 1).square() + options.huber_bend**2).sqrt()
    return line[..., 0], ok
