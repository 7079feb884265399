"""Stage 3: samples → samples with trackability and a hole class, the cause of a missing return.

A sample without a usable return has exactly one class (``codes.Hole``), and each class has a suggested route
(``codes.ROUTE_OF_HOLE``). The main class, TRACKABLE_NO_LIDAR, is a candidate for triangulation; it implies no cause of
the missing return.
"""

from functools import lru_cache

import torch
from torch import Tensor

from dhtorch.codes import ROUTE_OF_HOLE, Flag, Hole, first_reason
from dhtorch.geometry.checks import all_finite, is_transformed, shaped
from dhtorch.geometry.linalg import eigenvalues_2x2
from dhtorch.geometry.patches import (
    containing_pixels,
    fits_window_kernel,
    flatten_images,
    product_is_exact,
    reduce_patches,
    run_window_kernel,
)
from dhtorch.ops.dispatch import operator, run_kernel
from dhtorch.records import MIN_TRACKABILITY, Frame, Samples


@shaped("frame.image: B C H W, samples.uv: B N 2, samples.flag: B N")
def classify(
    frame: Frame,
    samples: Samples,
    *,
    block: int = 7,
    min_trackability: float = MIN_TRACKABILITY,
) -> Samples:
    """Samples with their trackability and, where they have no usable return, their hole class.

    The first class that applies, in this order: AT_BORDER, TOO_DARK, TOO_BRIGHT, HIGHLIGHT, LOW_TEXTURE, else
    TRACKABLE_NO_LIDAR. A sample with a usable return is no hole.

    Args:
        frame: the B views the samples were taken from.
        samples: from :func:`dhtorch.stages.backproject.backproject`.
        block: side of the block the gradient matrix is averaged over, px.
        min_trackability: smaller eigenvalue (image in [0, 1]) below which there is nothing to track.

    Returns:
        Samples with ``trackability`` and ``hole`` filled.

    Raises:
        ValueError: wrong shapes.

    Gradient: ``trackability`` to the image; classes carry none.
    Cost: reads (block + 2)² pixels per sample, whatever the image size.
    Source: paper, "Hole taxonomy"; J. Shi, C. Tomasi, "Good features to track", 1994.
    """
    trackability = min_eigenvalue(frame.image, samples.uv, block=block)
    hole = _classify_holes(samples.xyz, samples.flag, trackability, min_trackability=min_trackability)
    return samples.replace(trackability=trackability.to(samples.depth.dtype), hole=hole)


@operator(
    kernel=lambda xyz, flag, *others, min_trackability: run_kernel(
        "classify_holes", (xyz, flag, *others), torch.empty_like(flag), min_trackability
    ),
    dtypes={"xyz": torch.float32, "flag": torch.int32, "trackability": torch.float32},
)
def _classify_holes(xyz: Tensor, flag: Tensor, trackability: Tensor, *, min_trackability: float) -> Tensor:
    """Hole class (B, N) int32 of points (B, N, 3), flags (B, N) and trackability (B, N)."""
    hole = (_class_of_flag.__wrapped__ if is_transformed() else _class_of_flag)(flag.device)[flag]
    textureless = (trackability.detach() < min_trackability) & (hole == Hole.TRACKABLE_NO_LIDAR)
    return hole.masked_fill_(textureless, Hole.LOW_TEXTURE).masked_fill_(all_finite(xyz, -1), Hole.NONE)


@lru_cache(maxsize=8)
def _class_of_flag(device: torch.device) -> Tensor:
    """Hole class (256,) of every flag value, ignoring texture: one table look-up instead of four masks of samples."""
    flag = torch.arange(256, dtype=torch.int32, device=device)
    return first_reason(
        ((flag & Flag.BORDER).bool(), Hole.AT_BORDER),
        ((flag & Flag.UNDEREXPOSED).bool(), Hole.TOO_DARK),
        ((flag & Flag.SATURATED).bool(), Hole.TOO_BRIGHT),
        ((flag & Flag.SPECULAR).bool(), Hole.HIGHLIGHT),
        otherwise=Hole.TRACKABLE_NO_LIDAR,
    )


@shaped("image: B C H W, uv: B N 2")
def min_eigenvalue(
    image: Tensor,  # (B, C, H, W)
    uv: Tensor,  # (B, N, 2) px
    *,
    block: int = 7,
) -> Tensor:
    """Smaller eigenvalue (B, N) of the mean gradient matrix around pixels: Shi–Tomasi trackability.

    Equal to ``cv2.cornerMinEigenVal(grey, block, 3)`` at the nearest pixel wherever the block and the 3×3 Sobel
    filter stay inside the image (``tests/stages/test_holes.py``); nearer to the border the block is moved inside.
    kornia's ``gftt_response`` filters the whole picture, through another window.

    Gradient: to the image; at equal eigenvalues the subgradient without the split is taken.
    """
    return _window_texture(image, containing_pixels(uv), size=block + 2)


@operator(
    kernel=lambda image, pixel, *, size: run_window_kernel(
        "window_texture",
        (image, pixel, size),
        image.new_empty(pixel.shape[:2], dtype=torch.float32),
        flatten_images(image)[1][3] == 3 and product_is_exact(image),
    ),
    dtypes={"image": torch.uint8, "pixel": torch.int32},
    any_layout=("image",),
    when=fits_window_kernel,
)
def _window_texture(image: Tensor, pixel: Tensor, *, size: int) -> Tensor:
    """:func:`min_eigenvalue` around pixels (B, N, 2) of images (B, C, H, W), in windows of ``size`` px."""
    (eigenvalue,) = reduce_patches(image, pixel, size, _texture, grey=True)
    return eigenvalue


def _texture(grey: Tensor) -> tuple[Tensor]:
    """Smaller eigenvalue (P,) of the mean of ((gx², gx gy), (gx gy, gy²)) over windows (size, size, P).

    Sobel gradients of all but the outermost pixels.
    """
    across, down = grey[:, 2:] - grey[:, :-2], grey[2:] - grey[:-2]
    gx = torch.add(across[:-2] + across[2:], across[1:-1], alpha=2)
    gy = torch.add(down[:, :-2] + down[:, 2:], down[:, 1:-1], alpha=2)
    smaller, _ = eigenvalues_2x2((gx * gx).sum((0, 1)), (gx * gy).sum((0, 1)), (gy * gy).sum((0, 1)))
    return (smaller / (16 * len(gx) * len(gx)),)


def suggest_route(hole: Tensor) -> Tensor:
    """Suggested route of each hole: ``codes.Hole`` (…) → ``codes.Route`` (…), for the user of the map."""
    table = torch.tensor([ROUTE_OF_HOLE[k] for k in sorted(ROUTE_OF_HOLE)], dtype=hole.dtype, device=hole.device)
    return table[hole.long()]
