"""Reading pixels of a batch of images at a batch of places, without touching the rest of the image.

Alphabet: ``image`` (B, C, H, W); ``uv`` (B, N, 2) px; ``pixel`` (B, N, 2) int32, the (u, v) that it lies
in; ``corner`` (B, N, 2) integer (u, v) of a patch's top-left pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor

from dhtorch.geometry.checks import check, is_transformed
from dhtorch.geometry.determinism import ELEMENTWISE_LANES
from dhtorch.ops.constants import LUMA_THOUSANDTHS, MAX_KERNEL_WINDOW_PX
from dhtorch.ops.dispatch import operator

#: ITU-R BT.601 luma, the weights of ``cv2.cvtColor`` (``tests/geometry/test_patches.py``).
LUMA_WEIGHTS = tuple(k / 1000 for k in LUMA_THOUSANDTHS)

#: Numbers of patches that are summarised together: few enough to stay in cache, and to need no fresh memory pages.
MAX_CHUNK_NUMBERS = 1 << 18

#: Share of an image's pixels from which on windows of the whole image are faster than as many patches.
WHOLE_IMAGE_RATIO = 0.25

#: Variance of rounding grey values to 8 bits; no residual is believed to be smaller.
QUANTISATION_VARIANCE = 1 / (12 * 255**2)


def reduce_patches(
    image: Tensor,  # (B, C, H, W), planar or interleaved in memory
    pixel: Tensor,  # (B, N, 2) int32, of :func:`containing_pixels`
    size: int,
    reduce: Callable[[Tensor], tuple[Tensor, ...]],
    *,
    grey: bool = False,
) -> tuple[Tensor, ...]:
    """A few numbers (B, N) about the patch around each pixel, without keeping the patches.

    ``reduce`` sees some points at a time and turns their pixels (C, size, size, P), points last, into tensors (P,);
    with ``grey`` their grey values (size, size, P). Whatever it does pixel by pixel then runs along contiguous points.
    It must treat every point alike and may not count on P, which is a multiple of LANES: the last ones are there to
    fill up. A patch that would leave the image is moved back inside.

    Raises:
        ValueError: wrong shapes, or an image smaller than a patch.

    Gradient: to the image, through ``reduce``.
    Twin: ``patch`` of ``tests/support/reference.py``, one point at a time.
    """
    sizes = check("reduce_patches", image=(image, "B C H W"), pixel=(pixel, "B N 2"))
    B, N, C, H, W = (sizes[k] for k in "BNCHW")
    _must_fit("reduce_patches", size, H, W)
    flat, (b, c, v, u) = flatten_images(image)
    x, y = _moved_inside(pixel if image.numel() < 1 << 31 else pixel.long(), (H, W), size)
    middle = torch.add(x if u == 1 else x * u, y, alpha=v)
    whole: Any = {"device": image.device, "dtype": middle.dtype}
    if B > 1:
        middle = middle + torch.arange(0, B * b, b, **whole)[:, None]
    middle, fill = middle.flatten(), -(B * N) % ELEMENTWISE_LANES
    if fill:
        middle = torch.nn.functional.pad(middle, (0, fill), value=(size // 2) * (u + v))
    at_once = max(MAX_CHUNK_NUMBERS // (C * size * size * ELEMENTWISE_LANES), 1) * ELEMENTWISE_LANES
    read = partial(_read, flat, (C, c))
    compiling = torch.compiler.is_compiling()
    around = (_around.__wrapped__ if is_transformed() else _around)(size, (v, u), **whole)
    if compiling:
        middle, at_once = _in_memory(middle), len(middle)  # computed once per point and not again for every pixel
    if u == C == 3 and image.dtype == torch.uint8 and (compiling or (grey and product_is_exact(image))):
        read, grey = partial(_read_rows, flat, grey), False
    parts = (middle,) if len(middle) <= at_once else middle.split(at_once)
    seen = (read(around, part) for part in parts)
    numbers = [reduce(luma(pixels, 0)[0] if grey else pixels) for pixels in seen]
    joined = numbers[0] if len(parts) == 1 else [torch.cat(x) for x in zip(*numbers, strict=True)]
    return tuple((x[: B * N] if fill else x).view(B, N) for x in joined)


def fits_window_kernel(_image: Tensor, _pixel: Tensor, *, size: int) -> bool:
    """Whether kernels read windows of this size."""
    return size <= MAX_KERNEL_WINDOW_PX


def window_arguments(image: Tensor, pixel: Tensor, size: int) -> tuple[Tensor, Tensor, tuple[int, ...]]:
    """What a kernel reads of windows (B, N): the images as one row of numbers, the pixels, and the steps from image to
    image, channel, row and column, channels, height, width and window size.

    Raises:
        ValueError: as :func:`reduce_patches`.
    """
    sizes = check("reduce_patches", image=(image, "B C H W"), pixel=(pixel, "B N 2"))
    _must_fit("reduce_patches", size, sizes["H"], sizes["W"])
    flat, steps = flatten_images(image)
    return flat, pixel, (*steps, *(sizes[k] for k in "CHW"), size)


def whole_is_faster(hw: tuple[int, int], n: int, size: int) -> bool:
    """Whether windows of all pixels of an image are faster than the patches around n of them."""
    return size % 2 == 1 and n >= WHOLE_IMAGE_RATIO * hw[0] * hw[1]


def gather_reduced(found: Tensor, pixel: Tensor, size: int) -> Tensor:
    """What was found (B, H, W) for every pixel's patch, at the pixels (B, N, 2) that :func:`reduce_patches` would
    ask."""
    x, y = _moved_inside(pixel, (found.shape[1], found.shape[2]), size)
    return found.flatten(1).gather(1, torch.add(x, y, alpha=found.shape[2]).long())


@lru_cache(maxsize=32)
def _around(size: int, steps: tuple[int, int], *, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Flat indices (size, size, 1) of a patch's pixels, less that of its middle, by the ``steps`` to the next row and
    column; the same few patches are asked for again and again."""
    down, right = (torch.arange(-(size // 2) * k, (size - size // 2) * k, k, device=device, dtype=dtype) for k in steps)
    return (down[:, None] + right)[..., None]


def _read(flat: Tensor, channels: tuple[int, int], around: Tensor, middle: Tensor) -> Tensor:
    """Pixels (C, size, size, P) of patches, by flat index of their middle; how many channels, and the steps there."""
    index = around + middle
    C, c = channels
    if torch.compiler.is_compiling():
        return torch.stack([flat[index + k * c] for k in range(C)])
    row = index.flatten()
    rows = [flat[k * c :].index_select(0, row) for k in range(C)]
    return (rows[0] if C == 1 else torch.stack(rows)).view(C, *index.shape)


def _read_rows(flat: Tensor, grey: bool, around: Tensor, middle: Tensor) -> Tensor:
    """Pixels (3, size, size, P) of patches of an interleaved uint8 picture, or their ``grey`` values.

    Rows of pixels are read as blocks of memory. Grey values come out of one matrix product, whose sums of whole
    numbers below 2²⁴ are exact in whatever order they are taken.
    """
    size = len(around)
    blocks = flat.as_strided((max(flat.numel() - 3 * size + 1, 0), 3 * size), (1, 1))
    first = around[:, 0] + middle
    if torch.compiler.is_compiling():
        pixels = blocks[first].unflatten(-1, (size, 3)).permute(3, 0, 2, 1)
        return _in_memory(luma(pixels, 0)[0] if grey else pixels)
    rows = blocks.index_select(0, first.flatten()).float()
    weights = (_weights.__wrapped__ if is_transformed() else _weights)(size, flat.device)
    values = (weights @ rows.t()).div_(255 * 1000)
    return values.view(size, size, -1).transpose(0, 1)


@lru_cache(maxsize=32)
def _weights(size: int, device: torch.device) -> Tensor:
    """The matrix (size, 3 size) that makes a row of pixels grey."""
    weight = torch.eye(size, dtype=torch.float32, device=device)[..., None]
    return (weight * torch.tensor(LUMA_THOUSANDTHS, dtype=torch.float32, device=device)).flatten(1)


def _in_memory(x: Tensor) -> Tensor:
    """The same numbers, which a compiler then computes once: a view by strides needs memory."""
    x = x.contiguous()
    return x.as_strided(x.shape, x.stride())


def _moved_inside(pixel: Tensor, hw: tuple[int, int], size: int) -> tuple[Tensor, Tensor]:
    """Columns and rows (B, N) of the pixels nearest to those given whose patches lie in the image."""
    u, v = pixel.unbind(-1)
    before, after = size // 2, size - size // 2
    return u.clamp(before, hw[1] - after), v.clamp(before, hw[0] - after)


def is_patch_inside(pixel: Tensor, hw: tuple[int, int], size: int) -> Tensor:
    """Whether the patch around each pixel (B, N, 2) lies in an image of size ``hw``, (B, N)."""
    x, y = _moved_inside(pixel, hw, size)
    return (x == pixel[..., 0]) & (y == pixel[..., 1])


def flatten_images(image: Tensor) -> tuple[Tensor, tuple[int, int, int, int]]:
    """All images as one row of numbers, and the steps in it from image to image, channel, row and column."""
    C, H, W = image.shape[1:]
    if C > 1 and image.stride(1) == 1 and image.stride(3) == C:
        return image.permute(0, 2, 3, 1).reshape(-1), (H * W * C, 1, W * C, C)
    return image.reshape(-1), (C * H * W, H * W, W, 1)


def _must_fit(where: str, size: int, H: int, W: int) -> None:
    if size > min(H, W):
        raise ValueError(f"lookup.{where}: image of {H}x{W} pixels is smaller than a patch of {size}x{size}")


def extract_patches(image: Tensor, corner: Tensor, size: int) -> Tensor:
    """Square patches (B, N, C, size, size) whose top-left pixels are ``corner`` (B, N, 2).

    A patch that would leave the image is shifted back inside, so every pixel returned exists.

    Without a graph the pixels are read through one overlapping view of the whole buffer; with a graph through a
    gather, whose backward scatters into the image. Both return the same numbers.

    Raises:
        ValueError: the image is smaller than a patch.
    """
    sizes = check("extract_patches", image=(image, "B C H W"), corner=(corner, "B N 2"))
    B, C, H, W = (sizes[k] for k in "BCHW")
    _must_fit("extract_patches", size, H, W)
    u = corner[..., 0].clamp(0, W - size)
    v = corner[..., 1].clamp(0, H - size)
    plane = torch.arange(B * C, device=image.device).view(B, 1, C) * (H * W)
    first = plane + (v * W + u)[..., None]  # (B, N, C) flat index of the top-left pixels
    return extract_windows(image, first, size)


def extract_windows(image: Tensor, first: Tensor, size: int) -> Tensor:
    """Square windows (*first.shape, size, size) of a stack of planes (*, H, W), by flat index of their top-left pixels.

    The fast and unchecked part of :func:`extract_patches`: ``first`` counts pixels through the whole stack, and the
    caller sees to it that every window lies inside its plane.
    """
    W = image.shape[-1]
    image = image.contiguous()
    rows = _rows(size, W, device=image.device)
    if _view_is_safe(image):
        # Row by row: a contiguous slice is copied as a block of memory, which is several times faster.
        view = image.as_strided((max(image.numel() - size + 1, 0), size), (1, 1))
        return view.index_select(0, (first.reshape(-1, 1) + rows).flatten()).view(*first.shape, size, size)
    index = first[..., None, None] + rows[:, None] + torch.arange(size, device=image.device)
    return image.flatten()[index]


@lru_cache(maxsize=64)
def _rows(size: int, width: int, *, device: torch.device) -> Tensor:
    """Flat indices (size,) of the rows of a window, less that of its first; asked for again and again."""
    return torch.arange(0, size * width, width, device=device)


def luma(rgb: Tensor, dim: int) -> Tensor:
    """Grey values in [0, 1] of pixels whose channels (1 or 3, float in [0, 1] or uint8) lie along ``dim``; BT.601.

    The channel dimension is kept with size 1. Floating images keep their dtype, uint8 becomes float32. For patches:
    whole pictures are for ``filters.grey``, by kornia, which takes twice as long on so few numbers.
    """
    # Divided first, so that the bytes and the floats of one picture have the same grey, bit for bit.
    rgb = rgb.float().div_(255) if rgb.dtype == torch.uint8 else rgb
    if rgb.shape[dim] == 1:
        return rgb
    r, g, b = rgb.split(1, dim)
    return torch.add(torch.add(LUMA_WEIGHTS[0] * r, g, alpha=LUMA_WEIGHTS[1]), b, alpha=LUMA_WEIGHTS[2])


def sample_nearest(grid: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Values (B, N) of ``grid`` (B, h, w) at the nearest pixel of ``uv`` (B, N, 2), and whether that pixel exists.

    Outside the grid, and for non-finite ``uv``, the value is that of some border pixel and ``inside`` is false.
    Twin: ``nearest`` of ``tests/support/reference.py``.
    """
    sizes = check("sample_nearest", grid=(grid, "B h w"), uv=(uv, "B N 2"))
    index, inside = nearest_pixel_index((sizes["h"], sizes["w"]), containing_pixels(uv))
    return grid.flatten(1).gather(1, index), inside


def nearest_pixel_index(hw: tuple[int, int], pixel: Tensor) -> tuple[Tensor, Tensor]:
    """Flat index (B, N) of a pixel (B, N, 2) of :func:`containing_pixels` in a grid of size ``hw``, and whether it
    exists.

    Where it does not, the index is that of some border pixel.
    """
    x, y = _moved_inside(pixel, hw, 1)
    return torch.add(x, y, alpha=hw[1]).long(), (x == pixel[..., 0]) & (y == pixel[..., 1])


def _containing_pixels_kernel(uv: Tensor) -> Tensor:
    uv = uv.contiguous()  # samples that a batch shares are a view
    pixel = torch.empty_like(uv, dtype=torch.int32)
    torch.ops.dhtorch.containing_pixels.default(uv, pixel)
    return pixel


@operator(kernel=_containing_pixels_kernel, dtypes={"uv": torch.float32}, any_layout=("uv",))
def containing_pixels(uv: Tensor) -> Tensor:
    """The pixel that each ``uv`` lies in, int32; one outside of any image where it is no place at all."""
    return round_half_up(uv.nan_to_num(-1.0)).int()


def round_half_up(uv: Tensor) -> Tensor:
    """Nearest integers, halves upwards (``Tensor.round`` sends them to the even side, which depends on the place)."""
    return torch.floor(uv.detach() + 0.5)


def product_is_exact(image: Tensor) -> bool:
    """Whether a matrix product has 24 bits here, and the overlapping view of rows that goes with it may be used."""
    reduced = torch.is_autocast_enabled(image.device.type) or torch.get_float32_matmul_precision() != "highest"
    return _view_is_safe(image) and not reduced


def _view_is_safe(image: Tensor) -> bool:
    """Whether an overlapping view may be used: its backward would materialise every window, vmap refuses it, and a
    compiler fuses the gather anyway."""
    if torch.compiler.is_compiling() or (image.requires_grad and torch.is_grad_enabled()):
        return False
    return not torch._C._functorch.is_functorch_wrapped_tensor(image)


def rescale_field_of_view(depth: Tensor, factor: float, right: float = 0.0) -> Tensor:
    """A map (..., h, w) laid over the picture with another field of view: each pixel shows what lies nearer to the
    middle by ``factor``, or farther from it, and ``right`` of the width beside that; 0 where that is outside.

    Gradient: to the map; the choice of pixels carries none.
    """
    h, w = depth.shape[-2:]
    rows, columns = (
        ((torch.arange(n, device=depth.device) - (n - 1) / 2) / factor + (n - 1) / 2 + aside).round().long()
        for n, aside in ((h, 0.0), (w, right * w))
    )
    inside = ((rows >= 0) & (rows < h))[:, None] & ((columns >= 0) & (columns < w))
    found = depth[..., rows.clamp(0, h - 1), :][..., columns.clamp(0, w - 1)]
    return torch.where(inside, found, 0.0)
