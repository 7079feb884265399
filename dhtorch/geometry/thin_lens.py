"""Thin lens: depth and focus distance -> signed diameter of the blur spot, and the inverse.

Alphabet: ``f`` focal length and ``s`` focus distance (m, from the lens), ``z`` depth (m), ``A = f / N`` diameter of
the aperture, ``c`` diameter of the spot (px). The spot grows with the distance in *inverse* depth:

    c = gain · (1/s − 1/z),   gain = A f s / ((s − f) · pixel pitch)

so c is positive beyond the focus and negative in front of it. An image determines |c| alone.
"""

import torch
from torch import Tensor

from dhtorch.geometry.checks import shaped
from dhtorch.pytree import Record, record

#: Standard deviation of the Gaussian that replaces a disc, over the disc's diameter, a ratio.
#: Source: derived, equal second moments per axis: (c / 2)² / 4 = (c / 4)².
GAUSSIAN_OF_DISC = 0.25


@record
class Lens(Record):
    """A lens and the pixel pitch of its sensor."""

    focal_length_m: Tensor  # (B,)
    f_number: Tensor  # (B,) focal length over the diameter of the aperture
    pixel_pitch_m: Tensor  # (B,) distance of neighbouring pixels on the sensor


@shaped("lens.focal_length_m: B, focus_m: B S")
def spot_gain(lens: Lens, focus_m: Tensor) -> Tensor:
    """Lens and focus distances (B, S) beyond the focal length -> spot diameter per dioptre out of focus, (B, S) px m.

    Gradient: to lens and distances.
    """
    f, N, pitch = (x[:, None] for x in (lens.focal_length_m, lens.f_number, lens.pixel_pitch_m))
    beyond = (focus_m - f).clamp_min(1e-9)
    return f * f / N * focus_m / (beyond * pitch)


@shaped("depth: B N, focus_m: B")
def spot_diameter(lens: Lens, depth: Tensor, focus_m: Tensor) -> Tensor:
    """Depth (B, N) m and focus distance (B,) m -> signed spot diameter (B, N) px, positive beyond the focus.

    A depth of 0 (none) gives NaN.

    Gradient: to lens, depth and distance.
    """
    has_depth = depth > 0
    inverse = 1 / torch.where(has_depth, depth, torch.ones_like(depth))
    c = spot_gain(lens, focus_m[:, None]) * (1 / focus_m[:, None] - inverse)
    return torch.where(has_depth, c, torch.full_like(c, torch.nan))


@shaped("diameter: B N, focus_m: B")
def depth_of_spot(lens: Lens, diameter: Tensor, focus_m: Tensor) -> Tensor:
    """*Signed* spot diameter (B, N) px and focus distance (B,) m -> depth (B, N) m; inverse of :func:`spot_diameter`.

    NaN where no depth gives such a spot: beyond the focus the diameter is bounded by that of infinity.

    Gradient: to lens, diameter and distance.
    """
    inverse = 1 / focus_m[:, None] - diameter / spot_gain(lens, focus_m[:, None])
    has_depth = inverse > 0
    depth = 1 / torch.where(has_depth, inverse, torch.ones_like(inverse))
    return torch.where(has_depth, depth, torch.full_like(depth, torch.nan))
