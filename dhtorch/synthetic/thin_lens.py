"""Defocus rendering of an all-in-focus image with exact depth, by a thin-lens model.

The scene is sliced into layers of equal steps in inverse depth, which are equal steps of the blur spot's diameter for
any focus. Every layer is convolved with its disc (by the disc's exact transfer function, so diameters need not be whole
pixels), and layers are composited from near to far, each occluding those behind it. Where a near layer is transparent
and the image shows nothing behind it, its background is filled in from the visible layers; a single view has no data
there. Blending is in linear light: display values are squared first.
"""

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from dhtorch.geometry.checks import check
from dhtorch.geometry.thin_lens import Lens, spot_gain

#: Largest number of layers; beyond it a layer's spot differs by more than ``step_px`` from the exact one.
_MAX_LAYERS = 96

#: Least covered fraction of a pixel in the normalisation of its light.
_MIN_COVER = 1e-3


def make_lens(focal_length_px: float, *, focal_length_m: float = 0.035, f_number: float = 1.4) -> Lens:
    """A thin lens (B = 1) with a focal length in pixels; the default is a fast full-frame lens."""
    values = (focal_length_m, f_number, focal_length_m / focal_length_px)
    for name, value in zip(("focal_length_m", "f_number", "pixel pitch"), values, strict=True):
        if not value > 0:
            raise ValueError(f"lens: {name} is {value}, expected a positive number")
    return Lens(*(torch.tensor([v]) for v in values))


def render_defocus(
    image: Tensor,  # (B, C, H, W) all in focus, float in [0, 1] or uint8
    depth: Tensor,  # (B, H, W) m, positive everywhere
    lens: Lens,
    focus_m: Tensor,  # (B, S)
    *,
    step_px: float = 0.5,
    gamma: float = 2.0,
) -> Tensor:
    """Images with defocus, (B, S, C, H, W) float in [0, 1], one for each focus distance.

    Args:
        image, depth: of the B pictures, of one size.
        lens: in B or 1.
        focus_m: distances in focus.
        step_px: largest change of the spot's diameter from layer to layer.
        gamma: exponent from display values to linear light.

    Raises:
        ValueError: wrong shapes, a depth that is not positive, or a focus not beyond the focal length.

    Gradient: to the image; the choice of layers has none.
    """
    sizes = check("render_defocus", image=(image, "B C H W"), depth=(depth, "B H W"), focus_m=(focus_m, "B S"))
    if not bool((depth > 0).all()):
        raise ValueError("render_defocus: depth has pixels without a value, expected positive depth everywhere")
    lens = lens.map(lambda x: x.expand(sizes["B"]))
    if not bool((focus_m > lens.focal_length_m[:, None]).all()):
        raise ValueError("render_defocus: focus_m expected beyond the focal length of the lens")
    picture = image / 255.0 if image.dtype == torch.uint8 else image
    rendered = [
        _render_scene(picture[b] ** gamma, 1 / depth[b], spot_gain(lens, focus_m)[b], 1 / focus_m[b], step_px)
        for b in range(sizes["B"])
    ]
    return torch.stack(rendered).clamp(0, 1) ** (1 / gamma)


def _render_scene(light: Tensor, inverse: Tensor, gain: Tensor, focus: Tensor, step_px: float) -> Tensor:
    """One scene (C, H, W) at S distances in focus (S,), all in dioptres: (S, C, H, W)."""
    low, high = float(inverse.min()), float(inverse.max())
    count = min(max(math.ceil((high - low) * float(gain.max()) / step_px), 1) + 1, _MAX_LAYERS)
    layer_inverse = torch.linspace(high, low, count, dtype=inverse.dtype)  # near first
    widest = float((gain[:, None] * (focus[:, None] - layer_inverse)).abs().max())
    margin = math.ceil(widest / 2) + 2
    size = (light.shape[-2] + 2 * margin, light.shape[-1] + 2 * margin)
    position = (high - inverse) / max(high - low, 1e-12) * (count - 1)
    v, u = torch.fft.fftfreq(size[0], dtype=light.dtype), torch.fft.rfftfreq(size[1], dtype=light.dtype)
    radius = (v[:, None] ** 2 + u**2).sqrt()
    total = light.new_zeros(len(focus), light.shape[0], *size)
    cover = light.new_zeros(len(focus), 1, *size)
    solid = torch.cat((light, torch.ones_like(light[:1])))
    for k in range(count):
        weight = (1 - (position - k).abs()).clamp_min(0)  # linear weights: those of neighbouring layers add up to one
        if not bool(weight.any()):
            continue
        spectrum = torch.fft.rfft2(pad((solid * weight)[None], (margin,) * 4, mode="replicate"))
        spread = torch.stack(
            [_disc_transfer(radius, abs(float(g * (f - layer_inverse[k])))) for g, f in zip(gain, focus, strict=True)]
        )
        blurred = torch.fft.irfft2(spectrum * spread[:, None], s=size)
        alpha = blurred[:, -1:].clamp(0, 1)
        visible = torch.minimum(alpha, 1 - cover)
        total = total + blurred[:, :-1] * (visible / alpha.clamp_min(_MIN_COVER))
        cover = cover + visible
    image = total / cover.clamp_min(_MIN_COVER)
    return image[..., margin:-margin, margin:-margin]


def _disc_transfer(radius: Tensor, diameter: float) -> Tensor:
    """Transfer function of a uniform disc: 2 J1(x) / x, x = π times diameter times frequency."""
    x = math.pi * diameter * radius
    is_nonzero = x > 1e-3
    safe = torch.where(is_nonzero, x, torch.ones_like(x))
    return torch.where(is_nonzero, 2 * torch.special.bessel_j1(safe) / safe, torch.ones_like(x))
