"""Reading pixels of a batch of images at a batch of places, without touching the rest of the image.

Alphabet: ``image`` (B, C, H, W); ``corner`` (B, N, 2) integer (u, v) of a patch's top-left pixel; ``uv`` (B, N, 2) px.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from dhtorch.geometry.shapes import check

#: ITU-R BT.601 luma, the weights of ``cv2.cvtColor`` and ``kornia.color.rgb_to_grayscale``.
LUMA = (0.299, 0.587, 0.114)

#: Numbers of patches that are summarised together: few enough to stay in cache, and to need no fresh memory pages.
NUMBERS = 1 << 17

#: Rows of this many points leave no tail to vector loops, which may round differently there.
LANES = 64


def summarise(
    image: Tensor,  # (B, C, H, W), planar or interleaved in memory
    corner: Tensor,  # (B, N, 2) integer
    size: int,
    reduce: Callable[[Tensor], tuple[Tensor, ...]],
) -> tuple[Tensor, ...]:
    """A few numbers (B, N) about each patch whose top-left pixel is ``corner``, without keeping the patches.

    ``reduce`` sees some points at a time and turns their pixels (C, size, size, P), points last, into tensors (P,).
    Whatever it does pixel by pixel then runs along contiguous points. It must treat every point alike and may not
    count on P, which is a multiple of LANES: the last ones are there to fill up. A patch that would leave the image
    is shifted back inside.

    Raises:
        ValueError: wrong shapes, or an image smaller than a patch.

    Gradient: to the image, through ``reduce``.
    """
    sizes = check("lookup.summarise", image=(image, "B C H W"), corner=(corner, "B N 2"))
    B, N, C, H, W = (sizes[k] for k in "BNCHW")
    _fits("summarise", size, H, W)
    flat, (b, c, v, u) = _flat(image)
    whole = torch.int32 if image.numel() < 1 << 31 else torch.int64
    left, top = corner.unbind(-1)
    first = torch.add(top.clamp(0, H - size) * v, left.clamp(0, W - size), alpha=u)
    if B > 1:
        first = first + torch.arange(B, device=image.device)[:, None] * b
    first = torch.nn.functional.pad(first.to(whole).flatten(), (0, -(B * N) % LANES))
    down, right = (torch.arange(0, size * k, k, device=image.device, dtype=whole) for k in (v, u))
    steps = down[:, None, None] + right[:, None]
    at_once = max(NUMBERS // (C * size * size * LANES), 1) * LANES
    if torch.compiler.is_compiling():
        # A view by strides needs memory: made so, the index is computed once per point and not again for every pixel.
        first, at_once = first.as_strided(first.shape, (1,)), len(first)
    parts = (first,) if len(first) <= at_once else first.split(at_once)
    found = [reduce(_take(flat, steps + points, C, c)) for points in parts]
    joined = found[0] if len(parts) == 1 else [torch.cat(x) for x in zip(*found, strict=True)]
    return tuple(x[: B * N].view(B, N) for x in joined)


def _take(flat: Tensor, index: Tensor, C: int, c: int) -> Tensor:
    """Numbers (C, *index.shape) at an index and at C - 1 further steps ``c`` from it."""
    if torch.compiler.is_compiling():
        return torch.stack([flat[index + k * c] for k in range(C)])
    row = index.flatten()
    return torch.stack([flat[k * c :].index_select(0, row) for k in range(C)]).view(C, *index.shape)


def _flat(image: Tensor) -> tuple[Tensor, tuple[int, int, int, int]]:
    """All images as one row of numbers, and the steps in it from image to image, channel, row and column."""
    C, H, W = image.shape[1:]
    if C > 1 and image.stride(1) == 1 and image.stride(3) == C:
        return image.permute(0, 2, 3, 1).reshape(-1), (H * W * C, 1, W * C, C)
    return image.reshape(-1), (C * H * W, H * W, W, 1)


def _fits(where: str, size: int, H: int, W: int) -> None:
    if size > min(H, W):
        raise ValueError(f"lookup.{where}: image of {H}x{W} pixels is smaller than a patch of {size}x{size}")


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
    _fits("patches", size, H, W)
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
    steps = torch.arange(size, device=image.device)
    if _view_is_safe(image):
        # Row by row: a contiguous slice is copied as a block of memory, which is several times faster.
        view = image.as_strided((max(image.numel() - size + 1, 0), size), (1, 1))
        return view.index_select(0, (first.reshape(-1, 1) + steps * W).flatten()).view(*first.shape, size, size)
    index = first[..., None, None] + steps[:, None] * W + steps
    return image.flatten()[index]


def luma(rgb: Tensor, dim: int) -> Tensor:
    """Grey values in [0, 1] of pixels whose channels (1 or 3, float in [0, 1] or uint8) lie along ``dim``; BT.601.

    The channel dimension is kept with size 1. Floating images keep their dtype, uint8 becomes float32.
    """
    # Divided first, so that the bytes and the floats of one picture have the same grey, bit for bit.
    rgb = rgb / 255.0 if rgb.dtype == torch.uint8 else rgb
    if rgb.shape[dim] == 1:
        return rgb
    r, g, b = rgb.split(1, dim)
    return torch.add(torch.add(LUMA[0] * r, g, alpha=LUMA[1]), b, alpha=LUMA[2])


def nearest(grid: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Values (B, N) of ``grid`` (B, h, w) at the nearest pixel of ``uv`` (B, N, 2), and whether that pixel exists.

    Outside the grid, and for non-finite ``uv``, the value is that of some border pixel and ``inside`` is false.
    """
    sizes = check("lookup.nearest", grid=(grid, "B h w"), uv=(uv, "B N 2"))
    index, inside = nearest_index((sizes["h"], sizes["w"]), uv)
    return grid.flatten(1).gather(1, index), inside


def nearest_index(hw: tuple[int, int], uv: Tensor) -> tuple[Tensor, Tensor]:
    """Flat index (B, N) of the nearest pixel of ``uv`` (B, N, 2) in a grid of size ``hw``, and whether it exists.

    Where it does not, and for non-finite ``uv``, the index is 0.
    """
    u, v = round_half_up(uv).unbind(-1)
    inside = (u >= 0) & (v >= 0) & (u < hw[1]) & (v < hw[0])
    u, v = torch.where(inside, u, 0), torch.where(inside, v, 0)
    return torch.add(u.long(), v.long(), alpha=hw[1]), inside


def round_half_up(uv: Tensor) -> Tensor:
    """Nearest integers, halves upwards (``Tensor.round`` sends them to the even side, which depends on the place)."""
    return torch.floor(uv.detach() + 0.5)


def _view_is_safe(image: Tensor) -> bool:
    """Whether an overlapping view may be used: its backward would materialise every window, vmap refuses it, and a
    compiler fuses the gather anyway."""
    if torch.compiler.is_compiling() or (image.requires_grad and torch.is_grad_enabled()):
        return False
    return not torch._C._functorch.is_functorch_wrapped_tensor(image)
