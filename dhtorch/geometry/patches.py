"""Patches: images and points -> square patches around the points, their reductions, grey values and nearest pixels.

Alphabet: ``image`` (B, C, H, W); ``uv`` (B, N, 2) px; ``pixel`` (B, N, 2) int32, the pixel (u, v) that contains it;
``corner`` (B, N, 2) integer (u, v) of a patch's top-left pixel.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor

from dhtorch.geometry.checks import check, constant, is_transformed
from dhtorch.geometry.determinism import ELEMENTWISE_LANES, chunk_size
from dhtorch.ops.constants import LUMA_THOUSANDTHS, MAX_KERNEL_WINDOW_PX
from dhtorch.ops.dispatch import operator, run_kernel

#: Luma weights of red, green and blue, ratios; those of ``cv2.cvtColor`` (``tests/geometry/test_patches.py``).
#: Source: ITU-R BT.601.
LUMA_WEIGHTS = tuple(k / 1000 for k in LUMA_THOUSANDTHS)

#: Largest count of patch pixel values that are reduced at once: few enough to stay in the cache and to need no fresh
#: memory pages. Source: derived, fits the L2/L3 cache.
MAX_CHUNK_NUMBERS = 1 << 18

#: Variance of rounding grey values in [0, 1] to 8 bits: the lower limit of residual variances.
#: Source: derived, step² / 12 of a uniform distribution, with step 1 / 255.
QUANTISATION_VARIANCE = 1 / (12 * 255**2)


def reduce_patches(
    image: Tensor,  # (B, C, H, W), planar or interleaved in memory
    pixel: Tensor,  # (B, N, 2) int32, of :func:`containing_pixels`
    size: int,
    reduce: Callable[[Tensor], tuple[Tensor, ...]],
    *,
    grey: bool = False,
) -> tuple[Tensor, ...]:
    """Images and pixels -> results (B, N) of ``reduce`` on the patch around each pixel; the patches are not kept.

    ``reduce`` is called with chunks of points and maps their pixels (C, size, size, P), points last, to tensors (P,);
    with ``grey`` their grey values (size, size, P). Elementwise operations then run along contiguous points. It must
    treat every point alike and not depend on P, a multiple of ``ELEMENTWISE_LANES``: the last points may be padding. A
    patch that would leave the image is shifted back inside.

    Raises:
        ValueError: wrong shapes, or an image smaller than a patch.

    Gradient: to the image, through ``reduce``.
    """
    sizes = check("reduce_patches", image=(image, "B C H W"), pixel=(pixel, "B N 2"))
    B, N, C, H, W = (sizes[k] for k in "BNCHW")
    _check_patch_size("reduce_patches", size, H, W)
    flat, (b, c, v, u) = flatten_images(image)
    x, y = _clamp_inside(pixel if image.numel() < 1 << 31 else pixel.long(), (H, W), size)
    centre = torch.add(x if u == 1 else x * u, y, alpha=v)
    index_kwargs: Any = {"device": image.device, "dtype": centre.dtype}
    if B > 1:
        centre = centre + torch.arange(0, B * b, b, **index_kwargs)[:, None]
    centre, padding = centre.flatten(), -(B * N) % ELEMENTWISE_LANES
    if padding:
        centre = torch.nn.functional.pad(centre, (0, padding), value=(size // 2) * (u + v))
    most = chunk_size(MAX_CHUNK_NUMBERS, image)
    chunk_points = max(most // (C * size * size * ELEMENTWISE_LANES), 1) * ELEMENTWISE_LANES
    read = partial(_read_patches, flat, (C, c))
    compiling = torch.compiler.is_compiling()
    offsets = (_patch_offsets.__wrapped__ if is_transformed() else _patch_offsets)(size, (v, u), **index_kwargs)
    if compiling:
        centre, chunk_points = _materialise(centre), len(centre)  # computed once per point instead of once per pixel
    if u == C == 3 and image.dtype == torch.uint8 and (compiling or (grey and product_is_exact(image))):
        read, grey = partial(_read_interleaved_patches, flat, grey), False
    parts = (centre,) if len(centre) <= chunk_points else centre.split(chunk_points)
    patches = (read(offsets, part) for part in parts)
    results = [reduce(luma(pixels, 0)[0] if grey else pixels) for pixels in patches]
    joined = results[0] if len(parts) == 1 else [torch.cat(x) for x in zip(*results, strict=True)]
    return tuple((x[: B * N] if padding else x).view(B, N) for x in joined)


def fits_window_kernel(_image: Tensor, _pixel: Tensor, *, size: int) -> bool:
    """Whether the compiled kernels support windows of this size."""
    return size <= MAX_KERNEL_WINDOW_PX


def run_window_kernel(name: str, windows: tuple[Tensor, Tensor, int], output: Tensor, *numbers: Any) -> Tensor:
    """Run a kernel on the windows of a size around pixels of images -> its output.

    Raises:
        ValueError: as :func:`reduce_patches`.
    """
    image, pixel, size = windows
    sizes = check("reduce_patches", image=(image, "B C H W"), pixel=(pixel, "B N 2"))
    _check_patch_size("reduce_patches", size, sizes["H"], sizes["W"])
    flat, steps = flatten_images(image)
    return run_kernel(name, (flat, pixel), output, *steps, *(sizes[k] for k in "CHW"), size, *numbers)


def whole_is_faster(hw: tuple[int, int], n: int, size: int) -> bool:
    """Whether windows of all pixels of an image are faster to compute than the patches around n of them."""
    # Number of points over number of pixels of an image from which on windows of the whole image are faster than
    # patches, a ratio.
    return size % 2 == 1 and n >= 0.25 * hw[0] * hw[1]


def gather_reduced(reduced: Tensor, pixel: Tensor, size: int) -> Tensor:
    """Results ``reduced`` (B, H, W) for the patch of every pixel -> (B, N), those that :func:`reduce_patches` gives for
    the pixels (B, N, 2)."""
    x, y = _clamp_inside(pixel, (reduced.shape[1], reduced.shape[2]), size)
    return reduced.flatten(1).gather(1, torch.add(x, y, alpha=reduced.shape[2]).long())


@lru_cache(maxsize=32)
def _patch_offsets(size: int, steps: tuple[int, int], *, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Flat indices (size, size, 1) of a patch's pixels relative to its centre; ``steps`` are the strides of row and
    column. Cached, because few different ones occur."""
    rows, columns = (
        torch.arange(-(size // 2) * k, (size - size // 2) * k, k, device=device, dtype=dtype) for k in steps
    )
    return (rows[:, None] + columns)[..., None]


def _read_patches(flat: Tensor, channels: tuple[int, int], offsets: Tensor, centre: Tensor) -> Tensor:
    """Pixels (C, size, size, P) of patches, by flat index of their centre; ``channels`` are their count and stride."""
    index = offsets + centre
    C, c = channels
    if torch.compiler.is_compiling():
        return torch.stack([flat[index + k * c] for k in range(C)])
    row = index.flatten()
    rows = [flat[k * c :].index_select(0, row) for k in range(C)]
    return (rows[0] if C == 1 else torch.stack(rows)).view(C, *index.shape)


def _read_interleaved_patches(flat: Tensor, grey: bool, offsets: Tensor, centre: Tensor) -> Tensor:
    """Pixels (3, size, size, P) of patches of an interleaved uint8 image, or their ``grey`` values.

    Rows of pixels are read as blocks of memory. Grey values are one matrix product, whose sums of integers below 2²⁴
    are exact in any order.
    """
    size = len(offsets)
    blocks = flat.as_strided((max(flat.numel() - 3 * size + 1, 0), 3 * size), (1, 1))
    first = offsets[:, 0] + centre
    if torch.compiler.is_compiling():
        pixels = blocks[first].unflatten(-1, (size, 3)).permute(3, 0, 2, 1)
        return _materialise(luma(pixels, 0)[0] if grey else pixels)
    rows = blocks.index_select(0, first.flatten()).float()
    weights = (_luma_matrix.__wrapped__ if is_transformed() else _luma_matrix)(size, flat.device)
    values = (weights @ rows.t()).div_(255 * 1000)
    return values.view(size, size, -1).transpose(0, 1)


@lru_cache(maxsize=32)
def _luma_matrix(size: int, device: torch.device) -> Tensor:
    """Matrix (size, 3 size) that maps a row of interleaved pixels to grey values."""
    weight = torch.eye(size, dtype=torch.float32, device=device)[..., None]
    return (weight * torch.tensor(LUMA_THOUSANDTHS, dtype=torch.float32, device=device)).flatten(1)


def _materialise(x: Tensor) -> Tensor:
    """The same values in memory of their own, so that a compiler computes them once: a strided view needs memory."""
    x = x.contiguous()
    return x.as_strided(x.shape, x.stride())


def _clamp_inside(pixel: Tensor, hw: tuple[int, int], size: int) -> tuple[Tensor, Tensor]:
    """Pixels (B, N, 2) -> columns and rows (B, N) of the nearest pixels whose patches lie inside the image."""
    u, v = pixel.unbind(-1)
    before, after = size // 2, size - size // 2
    return u.clamp(before, hw[1] - after), v.clamp(before, hw[0] - after)


def is_patch_inside(pixel: Tensor, hw: tuple[int, int], size: int) -> Tensor:
    """Whether the patch around each pixel (B, N, 2) lies in an image of size ``hw``, (B, N)."""
    x, y = _clamp_inside(pixel, hw, size)
    return (x == pixel[..., 0]) & (y == pixel[..., 1])


def is_inside_picture(uv: Tensor, picture: Tensor) -> Tensor:
    """Whether points (B, N, 2) px lie in an image (…, H, W), (B, N): its outer pixels belong to it entirely."""
    H, W = picture.shape[-2:]
    return ((uv >= -0.5) & (uv <= constant(uv, [W, H]) - 0.5)).all(-1)


def flatten_images(image: Tensor) -> tuple[Tensor, tuple[int, int, int, int]]:
    """Images -> one flat tensor in memory order, and its strides of image, channel, row and column."""
    C, H, W = image.shape[1:]
    if C > 1 and image.stride(1) == 1 and image.stride(3) == C:
        return image.permute(0, 2, 3, 1).reshape(-1), (H * W * C, 1, W * C, C)
    return image.reshape(-1), (C * H * W, H * W, W, 1)


def _check_patch_size(where: str, size: int, H: int, W: int) -> None:
    if size > min(H, W):
        raise ValueError(f"{where}: image of {H}x{W} pixels is smaller than a patch of {size}x{size}")


def extract_patches(image: Tensor, corner: Tensor, size: int) -> Tensor:
    """Images and corners -> square patches (B, N, C, size, size) whose top-left pixels are ``corner`` (B, N, 2).

    A patch that would leave the image is shifted back inside, so every pixel returned exists.

    Without a graph the pixels are read through one overlapping view of the whole buffer; with a graph through a
    gather, whose backward scatters into the image. Both return the same numbers.

    Raises:
        ValueError: the image is smaller than a patch.
    """
    sizes = check("extract_patches", image=(image, "B C H W"), corner=(corner, "B N 2"))
    B, C, H, W = (sizes[k] for k in "BCHW")
    _check_patch_size("extract_patches", size, H, W)
    u = corner[..., 0].clamp(0, W - size)
    v = corner[..., 1].clamp(0, H - size)
    plane = torch.arange(B * C, device=image.device).view(B, 1, C) * (H * W)
    first = plane + (v * W + u)[..., None]  # (B, N, C) flat index of the top-left pixels
    return extract_windows(image, first, size)


def extract_windows(image: Tensor, first: Tensor, size: int) -> Tensor:
    """Planes (*, H, W) and flat indices of top-left pixels -> square windows (*first.shape, size, size).

    The unchecked part of :func:`extract_patches`: ``first`` counts pixels through the whole stack, and the caller
    guarantees that every window lies inside its plane.
    """
    W = image.shape[-1]
    image = image.contiguous()
    rows = torch.arange(0, size * W, W, device=image.device)
    if _view_is_safe(image):
        # Row by row: a contiguous slice is copied as a block of memory, which is several times faster.
        view = image.as_strided((max(image.numel() - size + 1, 0), size), (1, 1))
        return view.index_select(0, (first.reshape(-1, 1) + rows).flatten()).view(*first.shape, size, size)
    index = first[..., None, None] + rows[:, None] + torch.arange(size, device=image.device)
    return image.flatten()[index]


def luma(rgb: Tensor, dim: int) -> Tensor:
    """Pixels with channels along ``dim`` (1 or 3, float in [0, 1] or uint8) -> grey values in [0, 1], BT.601.

    The channel dimension is kept with size 1. Floating images keep their dtype, uint8 becomes float32. For patches;
    whole images use :func:`dhtorch.geometry.filters.grayscale`, by kornia.
    """
    # Divided first, so that an image in bytes and the same image in floats have equal grey values, bit for bit.
    rgb = rgb.float().div_(255) if rgb.dtype == torch.uint8 else rgb
    if rgb.shape[dim] == 1:
        return rgb
    r, g, b = rgb.split(1, dim)
    return torch.add(torch.add(LUMA_WEIGHTS[0] * r, g, alpha=LUMA_WEIGHTS[1]), b, alpha=LUMA_WEIGHTS[2])


def sample_nearest(grid: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Grid (B, h, w) and points ``uv`` (B, N, 2) -> values (B, N) at the nearest pixels, and whether these exist.

    Outside the grid, and for non-finite ``uv``, the value is that of some border pixel and ``inside`` is false.
    """
    sizes = check("sample_nearest", grid=(grid, "B h w"), uv=(uv, "B N 2"))
    index, inside = nearest_pixel_index((sizes["h"], sizes["w"]), containing_pixels(uv))
    return grid.flatten(1).gather(1, index), inside


def nearest_pixel_index(hw: tuple[int, int], pixel: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (B, N, 2) of :func:`containing_pixels` -> flat indices (B, N) in a grid of size ``hw``, and whether they
    exist.

    Where it does not, the index is that of some border pixel.
    """
    x, y = _clamp_inside(pixel, hw, 1)
    return torch.add(x, y, alpha=hw[1]).long(), (x == pixel[..., 0]) & (y == pixel[..., 1])


@operator(
    kernel=lambda uv: run_kernel("containing_pixels", [uv], uv.new_empty(uv.shape, dtype=torch.int32)),
    dtypes={"uv": torch.float32},
    any_layout=("uv",),
)
def containing_pixels(uv: Tensor) -> Tensor:
    """Points ``uv`` -> the pixels that contain them, int32; a pixel outside any image for non-finite points."""
    return round_half_up(uv.nan_to_num(-1.0)).int()


def round_half_up(uv: Tensor) -> Tensor:
    """Nearest integers, halves upwards (``Tensor.round`` rounds them to even, which depends on the position)."""
    return torch.floor(uv.detach() + 0.5)


def product_is_exact(image: Tensor) -> bool:
    """Whether a float32 matrix product has 24 bits here and the overlapping view of rows that it reads may be used."""
    reduced_precision = (
        torch.is_autocast_enabled(image.device.type) or torch.get_float32_matmul_precision() != "highest"
    )
    return _view_is_safe(image) and not reduced_precision


def _view_is_safe(image: Tensor) -> bool:
    """Whether an overlapping view may be used: its backward would materialise every window, vmap does not support it,
    and a compiler fuses the gather anyway."""
    if torch.compiler.is_compiling() or (image.requires_grad and torch.is_grad_enabled()):
        return False
    return not torch._C._functorch.is_functorch_wrapped_tensor(image)


def rescale_field_of_view(depth: Tensor, factor: float, right: float = 0.0) -> Tensor:
    """Map (..., h, w) -> map resampled about its centre by 1 / ``factor`` and shifted by ``right`` of its width.

    Each pixel gets the value at its offset from the centre over ``factor``, plus ``right`` times the width; 0 outside.

    Gradient: to the map; the choice of pixels carries none.
    """
    h, w = depth.shape[-2:]
    rows, columns = (
        ((torch.arange(n, device=depth.device) - (n - 1) / 2) / factor + (n - 1) / 2 + shift).round().long()
        for n, shift in ((h, 0.0), (w, right * w))
    )
    inside = ((rows >= 0) & (rows < h))[:, None] & ((columns >= 0) & (columns < w))
    values = depth[..., rows.clamp(0, h - 1), :][..., columns.clamp(0, w - 1)]
    return torch.where(inside, values, 0.0)
