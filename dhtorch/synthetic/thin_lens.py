"""Pictures with defocus, made from an all-in-focus picture and its exact depth.

The scene is sliced into layers of equal steps in inverse depth, which are equal steps of the spot's diameter whatever
is in focus. Every layer is spread by its disc (by the disc's exact transfer function, so diameters need not be whole
pixels), and layers are laid over each other from near to far, each covering what is behind it. Where a near layer has
become transparent and nothing behind it was ever seen, the picture is filled from what is there: the one thing that a
single view cannot know. Light is added up as light: display values are squared first.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from dhtorch.geometry.checks import check
from dhtorch.geometry.thin_lens import Lens, spot_gain

#: Largest number of layers; beyond it a layer's spot differs by more than ``step_px`` from the exact one.
_MAX_LAYERS = 96

#: Least part of a pixel that must be covered before its light is scaled up to a whole.
_MIN_COVER = 1e-3


def make_lens(focal_length_px: float, *, focal_length_m: float = 0.035, f_number: float = 1.4) -> Lens:
    """A lens (B = 1) whose picture has this focal length in pixels; the default is a fast one on a full frame."""
    values = (focal_length_m, f_number, focal_length_m / focal_length_px)
    for name, value in zip(("focal_length_m", "f_number", "pixel pitch"), values, strict=True):
        if not value > 0:
            raise ValueError(f"lens: {name} is {value}, expected a positive number")
    return Lens(*(torch.tensor([v]) for v in values))


def render_defocus(
    image: Tensor,  # (B, C, H, W) all in focus, float in [0, 1] or uint8
    depth: Tensor,  # (B, H, W) m, everywhere known
    lens: Lens,
    focus_m: Tensor,  # (B, S)
    *,
    step_px: float = 0.5,
    gamma: float = 2.0,
) -> Tensor:
    """The picture as the lens sees it, (B, S, C, H, W) float in [0, 1], once for each distance in focus.

    Args:
        image, depth: of the B pictures, of one size.
        lens: in B or 1.
        focus_m: distances in focus.
        step_px: how much the spot's diameter may change from layer to layer.
        gamma: display values to this power are light.

    Raises:
        ValueError: wrong shapes, a depth that is not positive, or a focus not beyond the focal length.

    Gradient: to the image; layers are chosen without one.
    """
    sizes = check("render_defocus", image=(image, "B C H W"), depth=(depth, "B H W"), focus_m=(focus_m, "B S"))
    if not bool((depth > 0).all()):
        raise ValueError("render_defocus: depth has pixels without a value, expected positive depth everywhere")
    lens = lens.map(lambda x: x.expand(sizes["B"]))
    if not bool((focus_m > lens.focal_length_m[:, None]).all()):
        raise ValueError("render_defocus: focus_m expected beyond the focal length of the lens")
    picture = image / 255.0 if image.dtype == torch.uint8 else image
    made = [
        _render_scene(picture[b] ** gamma, 1 / depth[b], spot_gain(lens, focus_m)[b], 1 / focus_m[b], step_px)
        for b in range(sizes["B"])
    ]
    return torch.stack(made).clamp(0, 1) ** (1 / gamma)


def _render_scene(light: Tensor, inverse: Tensor, gain: Tensor, focus: Tensor, step_px: float) -> Tensor:
    """One scene (C, H, W) at S distances in focus (S,), all in dioptres: (S, C, H, W)."""
    low, high = float(inverse.min()), float(inverse.max())
    count = min(max(math.ceil((high - low) * float(gain.max()) / step_px), 1) + 1, _MAX_LAYERS)
    place = torch.linspace(high, low, count, dtype=inverse.dtype)  # near first
    widest = float((gain[:, None] * (focus[:, None] - place)).abs().max())
    margin = math.ceil(widest / 2) + 2
    size = (light.shape[-2] + 2 * margin, light.shape[-1] + 2 * margin)
    position = (high - inverse) / max(high - low, 1e-12) * (count - 1)
    radius = _frequencies(size, light)
    total = light.new_zeros(len(focus), light.shape[0], *size)
    cover = light.new_zeros(len(focus), 1, *size)
    solid = torch.cat((light, torch.ones_like(light[:1])))
    for k in range(count):
        share = (1 - (position - k).abs()).clamp_min(0)  # a tent: neighbours add up to one
        if not bool(share.any()):
            continue
        spectrum = torch.fft.rfft2(pad((solid * share)[None], (margin,) * 4, mode="replicate"))
        spread = torch.stack(
            [_disc_transfer(radius, abs(float(g * (f - place[k])))) for g, f in zip(gain, focus, strict=True)]
        )
        blurred = torch.fft.irfft2(spectrum * spread[:, None], s=size)
        alpha = blurred[:, -1:].clamp(0, 1)
        visible = torch.minimum(alpha, 1 - cover)
        total = total + blurred[:, :-1] * (visible / alpha.clamp_min(_MIN_COVER))
        cover = cover + visible
    whole = total / cover.clamp_min(_MIN_COVER)
    return whole[..., margin:-margin, margin:-margin]


def _frequencies(size: tuple[int, int], like: Tensor) -> Tensor:
    """Cycles per pixel (H, W // 2 + 1) of the real transform."""
    v, u = torch.fft.fftfreq(size[0], dtype=like.dtype), torch.fft.rfftfreq(size[1], dtype=like.dtype)
    return (v[:, None] ** 2 + u**2).sqrt()


def _disc_transfer(radius: Tensor, diameter: float) -> Tensor:
    """Transfer function of a uniform disc: 2 J1(x) / x, x = π times diameter times frequency."""
    x = math.pi * diameter * radius
    some = x > 1e-3
    safe = torch.where(some, x, torch.ones_like(x))
    return torch.where(some, 2 * torch.special.bessel_j1(safe) / safe, torch.ones_like(x))
