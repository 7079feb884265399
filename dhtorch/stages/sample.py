"""Stage 1: image size → sample pixels: a dual phase-shifted foveated spiral, a Vogel spiral or a regular grid.

Every sampler returns exactly ``n`` pixels inside the image, in a fixed order, without reading the image.
"""

import math
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from dhtorch.geometry.checks import is_transformed, keep_beside


def spiral(
    hw: tuple[int, int],
    n: int = 2048,
    *,
    turns: float | None = None,
    foveation: float = 1.0,
    gaze: tuple[float, float] | None = None,
    inner_px: float = 1.0,
    margin_px: float = 2.0,
    device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Sample pixels (n, 2) on two spiral arms half a turn apart, densest at the gaze centre.

    Point k of an arm sits at the fraction s = (k + ½) / (n / 2) of the arm. Its angle grows with √s and its radius
    runs from ``inner_px`` to the image border along that direction with s ^ ``foveation``, so the arms wind to the
    corners and never leave the image. The area density falls as r ^ (1 / foveation − 2): uniform at ½, as 1 / r at 1.

    Args:
        hw: image (height, width) in pixels.
        n: number of samples; even samples lie on the first arm, odd ones on the second.
        turns: full turns of each arm; by default √(foveation · n / 2π), which makes the spacing along an arm equal
            to the spacing between arms.
        foveation: exponent of the radius, > 0.
        gaze: (u, v) px of the densest point; the image centre by default.
        inner_px: radius of the first point, which keeps the arms apart at the centre.
        margin_px: distance kept from the outermost pixel centres.

    Returns:
        uv (n, 2) px.

    Raises:
        ValueError: n < 0, foveation ≤ 0, a gaze outside the image, or a margin that leaves no image.

    Gradient: none, positions do not depend on data.
    Source: paper, section "Spiral sampling"; angle law derived here for isotropic spacing.
    """
    if foveation <= 0:
        raise ValueError(f"spiral: foveation is {foveation}, expected > 0")
    centre = None if gaze is None else (gaze[0], gaze[1])
    uv = _constant_arms(
        (hw[0], hw[1]), n, turns=turns, foveation=foveation, gaze=centre, inner_px=inner_px, margin_px=margin_px
    )
    if torch.empty(0, device=device).is_cpu or is_transformed():
        return uv.to(device=device, dtype=dtype, copy=True)
    return keep_beside(uv, dtype, torch.empty(0, device=device).device).clone()


def _constant_arms(*args: Any, **options: Any) -> Tensor:
    """:func:`_arms`, a constant for torch.compile, which does not trace into it."""
    return _arms(*args, **options)


# The whole effect of torch.compiler.assume_constant_result, which would import the compiler.
_constant_arms._dynamo_marked_constant = True  # type: ignore[attr-defined]


@lru_cache(maxsize=16)
def _arms(
    hw: tuple[int, int],
    n: int,
    *,
    turns: float | None,
    foveation: float,
    gaze: tuple[float, float] | None,
    inner_px: float,
    margin_px: float,
) -> Tensor:
    """:func:`spiral` in float64; cached, because few distinct patterns occur."""
    box = _frame(hw, n, gaze, margin_px)
    k = torch.arange(n, dtype=torch.float64)
    arm, s = k % 2, (torch.div(k, 2, rounding_mode="floor") + 0.5) / max(math.ceil(n / 2), 1)
    if turns is None:
        turns = math.sqrt(foveation * n / (2 * math.pi))
    return _polar(box, 2 * math.pi * turns * s.sqrt() + math.pi * arm, s**foveation, inner_px)


def vogel_spiral(
    hw: tuple[int, int],
    n: int = 2048,
    *,
    gaze: tuple[float, float] | None = None,
    margin_px: float = 2.0,
    device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Sample pixels (n, 2) of a Vogel spiral: golden-angle steps, radius with √k, uniform density for a central gaze.

    Args and errors as :func:`spiral`. Returns uv (n, 2) px.
    Source: H. Vogel, "A better way to construct the sunflower head", 1979.
    """
    box = _frame(hw, n, gaze, margin_px)
    k = torch.arange(n, dtype=torch.float64)
    # π (3 − √5), the golden section of a full turn.
    uv = _polar(box, math.pi * (3 - math.sqrt(5)) * k, ((k + 0.5) / max(n, 1)).sqrt(), 0.0)
    return uv.to(device=device, dtype=dtype)


def regular_grid(
    hw: tuple[int, int],
    n: int = 2048,
    *,
    margin_px: float = 2.0,
    device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Sample pixels (n, 2) of a regular grid in rows whose lengths differ by at most one point.

    Args and errors as :func:`spiral`. Returns uv (n, 2) px.
    """
    _, low, high = _frame(hw, n, None, margin_px)
    if n == 0:
        return torch.zeros(0, 2, device=device, dtype=dtype)
    rows = min(max(round(math.sqrt(n * hw[0] / hw[1])), 1), n)
    index = torch.arange(n)
    row = torch.div(index * rows, n, rounding_mode="floor")
    first = torch.div(row * n + rows - 1, rows, rounding_mode="floor")  # index of the first point of each row
    count = torch.div((row + 1) * n + rows - 1, rows, rounding_mode="floor") - first
    place = torch.stack(((index - first + 0.5) / count, (row + 0.5) / rows), -1).double()
    return (low + place * (high - low)).to(device=device, dtype=dtype)


def _frame(
    hw: tuple[int, int], n: int, gaze: tuple[float, float] | None, margin_px: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Gaze, lowest and highest admissible pixel, each (2,) as (u, v) in float64."""
    high = (hw[1] - 1 - margin_px, hw[0] - 1 - margin_px)
    if n < 0:
        raise ValueError(f"sampler: n is {n}, expected >= 0")
    if margin_px < 0 or min(high) < margin_px:
        raise ValueError(f"sampler: margin_px = {margin_px} does not fit an image of {hw[0]}x{hw[1]} pixels")
    centre = ((margin_px + high[0]) / 2, (margin_px + high[1]) / 2) if gaze is None else gaze
    if not all(margin_px <= x <= limit for x, limit in zip(centre, high, strict=True)):
        raise ValueError(f"sampler: gaze {gaze} lies outside the image of {hw[0]}x{hw[1]} pixels (margin {margin_px})")
    low = (margin_px, margin_px)
    return (
        torch.tensor(centre, dtype=torch.float64),
        torch.tensor(low, dtype=torch.float64),
        torch.tensor(high, dtype=torch.float64),
    )


def _polar(box: tuple[Tensor, Tensor, Tensor], angle: Tensor, radius: Tensor, inner_px: float) -> Tensor:
    """Pixels (n, 2) of polar coordinates: ``angle`` and ``radius`` in [0, 1], 1 being the image border there."""
    centre, low, high = box
    direction = torch.stack((angle.cos(), angle.sin()), -1)
    room = torch.where(direction > 0, high - centre, centre - low)
    to_border = (room / direction.abs().clamp_min(1e-12)).amin(-1)
    inner = to_border.clamp_max(inner_px)
    uv = centre + (inner + (to_border - inner) * radius)[:, None] * direction
    return torch.minimum(torch.maximum(uv, low), high)
