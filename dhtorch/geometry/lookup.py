"""Reading pixels of a batch of images at a batch of places, without touching the rest of the image.

Alphabet: ``image`` (B, C, H, W); ``corner`` (B, N, 2) integer (u, v) of a patch's top-left pixel; ``uv`` (B, N, 2) px.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.geometry.shapes import check

#: ITU-R BT.601 luma, the weights of ``cv2.cvtColor`` and ``kornia.color.rgb_to_grayscale``.
LUMA = (0.299, 0.587, 0.114)


def patches(image: Tensor, corner: Tensor, size: int) -> Tensor:
    """Square patches (B, N, C, size, size) whose top-left pixels are ``corner`` (B, N, 2).

    A patch that would leave the image is shifted back inside, so every pixel returned exists.

    Without a graph the pixels are read through one overlapping view of the whole buffer; with a graph through a
    gather, whose backward scatters into the image. Both return the same numbers.

    Raises:
        ValueError: the image is smaller than a patch.
    """
    sizes = check("lookup.patches", image=(image, "B C H W"), corner=(corner, "B N 2"))
    B, C, H, W = (sizes[k] for k in "BCHW")
    if size > min(H, W):
        raise ValueError(f"lookup.patches: image of {H}x{W} pixels is smaller than a patch of {size}x{size}")
    u = corner[..., 0].clamp(0, W - size)
    v = corner[..., 1].clamp(0, H - size)
    plane = torch.arange(B * C, device=image.device).view(B, 1, C) * (H * W)
    first = plane + (v * W + u)[..., None]  # (B, N, C) flat index of the top-left pixels
    return windows(image, first, size)


def windows(image: Tensor, first: Tensor, size: int) -> Tensor:
    """Square windows (*first.shape, size, size) of a stack of planes (*, H, W), by flat index of their top-left pixels.

    The fast and unchecked part of :func:`patches`: ``first`` counts pixels through the whole stack, and the caller
    sees to it that every window lies inside its plane.
    """
    W = image.shape[-1]
    image = image.contiguous()
    if _view_is_safe(image):
        view = image.as_strided((max(image.numel() - (size - 1) * (W + 1), 0), size, size), (1, W, 1))
        return view.index_select(0, first.flatten()).view(*first.shape, size, size)
    steps = torch.arange(size, device=image.device)
    index = first[..., None, None] + steps[:, None] * W + steps
    return image.flatten()[index]


def luma(rgb: Tensor, dim: int) -> Tensor:
    """Grey values in [0, 1] of pixels whose channels (1 or 3, float in [0, 1] or uint8) lie along ``dim``; BT.601.

    The channel dimension is kept with size 1. Floating images keep their dtype, uint8 becomes float32.
    """
    grey = rgb / 255.0 if rgb.dtype == torch.uint8 else rgb
    if grey.shape[dim] == 1:
        return grey
    r, g, b = grey.split(1, dim)
    return LUMA[0] * r + LUMA[1] * g + LUMA[2] * b


def nearest(grid: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Values (B, N) of ``grid`` (B, h, w) at the nearest pixel of ``uv`` (B, N, 2), and whether that pixel exists.

    Outside the grid, and for non-finite ``uv``, the value is that of some border pixel and ``inside`` is false.
    """
    sizes = check("lookup.nearest", grid=(grid, "B h w"), uv=(uv, "B N 2"))
    h, w = sizes["h"], sizes["w"]
    centre = round_half_up(uv)
    inside = (centre >= 0).all(-1) & (centre[..., 0] <= w - 1) & (centre[..., 1] <= h - 1)
    index = torch.where(inside, centre[..., 1] * w + centre[..., 0], torch.zeros_like(centre[..., 0])).long()
    return grid.flatten(1).gather(1, index), inside


def round_half_up(uv: Tensor) -> Tensor:
    """Nearest integers, halves upwards (``Tensor.round`` sends them to the even side, which depends on the place)."""
    return torch.floor(uv.detach() + 0.5)


def _view_is_safe(image: Tensor) -> bool:
    """Whether an overlapping view may be used: its backward would materialise every window, vmap refuses it, and a
    compiler fuses the gather anyway."""
    if torch.compiler.is_compiling() or (image.requires_grad and torch.is_grad_enabled()):
        return False
    return not torch._C._functorch.is_functorch_wrapped_tensor(image)
