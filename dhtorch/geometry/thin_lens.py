"""A thin lens: how large the spot is that a point out of focus becomes, and which depths a spot may come from.

Alphabet: ``f`` focal length and ``s`` distance in focus (m, from the lens), ``z`` depth (m), ``A = f / N`` diameter of
the aperture, ``c`` diameter of the spot (px). The spot grows with the distance in *inverse* depth:

    c = gain · (1/s − 1/z),   gain = A f s / ((s − f) · pixel pitch)

so c is positive beyond the focus and negative in front of it. A picture shows |c| alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.geometry.checks import check
from dhtorch.pytree import Record, record

#: A disc of diameter c spreads as a Gaussian of this share of c as standard deviation (equal second moments).
GAUSSIAN_OF_DISC = 0.25


@record
class Lens(Record):
    """A lens and the pixels behind it."""

    focal_length_m: Tensor  # (B,)
    f_number: Tensor  # (B,) focal length over the diameter of the aperture
    pixel_pitch_m: Tensor  # (B,) distance of two pixels on the sensor


def spot_gain(lens: Lens, focus_m: Tensor) -> Tensor:
    """Pixels of spot diameter per dioptre out of focus, (B, S), of focus distances (B, S) beyond the focal length.

    Gradient: to lens and distances.
    """
    check("spot_gain", f=(lens.focal_length_m, "B"), focus_m=(focus_m, "B S"))
    f, N, pitch = (x[:, None] for x in (lens.focal_length_m, lens.f_number, lens.pixel_pitch_m))
    beyond = (focus_m - f).clamp_min(1e-9)
    return f * f / N * focus_m / (beyond * pitch)


def spot_diameter(lens: Lens, depth: Tensor, focus_m: Tensor) -> Tensor:
    """Signed spot diameter (B, N) px of points at ``depth`` (B, N) m with ``focus_m`` (B,) in focus; + beyond it.

    A depth of 0 (none) gives NaN.

    Gradient: to lens, depth and distance.
    """
    check("spot_diameter", depth=(depth, "B N"), focus_m=(focus_m, "B"))
    known = depth > 0
    inverse = 1 / torch.where(known, depth, torch.ones_like(depth))
    c = spot_gain(lens, focus_m[:, None]) * (1 / focus_m[:, None] - inverse)
    return torch.where(known, c, torch.full_like(c, torch.nan))


def depth_of_spot(lens: Lens, diameter: Tensor, focus_m: Tensor) -> Tensor:
    """Depth (B, N) m of a *signed* spot diameter (B, N) px: the inverse of :func:`spot_diameter`.

    NaN where no depth gives such a spot: beyond the focus it does not grow past that of infinity.

    Gradient: to lens, diameter and distance.
    """
    check("depth_of_spot", diameter=(diameter, "B N"), focus_m=(focus_m, "B"))
    inverse = 1 / focus_m[:, None] - diameter / spot_gain(lens, focus_m[:, None])
    known = inverse > 0
    depth = 1 / torch.where(known, inverse, torch.ones_like(inverse))
    return torch.where(known, depth, torch.full_like(depth, torch.nan))
