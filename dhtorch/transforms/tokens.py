"""Sparse depth pooled to the patch grid of a vision transformer: one depth token per patch token.

Alphabet: B images, N samples, P = rows × columns of patches, row by row, as in ViT and DINOv2.
"""

import torch
from torch import Tensor

from dhtorch.codes import Hole, Source, names
from dhtorch.geometry.checks import check
from dhtorch.ops.dispatch import operator
from dhtorch.records import MergedDepth

#: Channels of a token: 1/m, 1/m, then fractions of the patch's samples in [0, 1].
TOKEN_CHANNELS = ("inverse_depth", "sigma", "answered", *(f"hole_{name.lower()}" for name in names(Hole).values()))

#: Number of hole classes; their codes count from 0.
_N_HOLE_CLASSES = len(names(Hole))

#: How an image is resized to the network's input: stretched, letterboxed, or cropped to fill.
FIT_MODES = ("stretch", "pad", "crop")


def token_grid(hw: tuple[int, int], *, patch: int = 14, tokens_hw: tuple[int, int] | None = None) -> tuple[int, int]:
    """Image size ``hw`` and network input size ``tokens_hw`` (None = ``hw``) -> rows and columns of patches.

    Raises:
        ValueError: the image is smaller than a patch.
    """
    height, width = hw if tokens_hw is None else tokens_hw
    if patch < 1 or min(height, width) < patch:
        raise ValueError(f"tokens: found an image of {height}x{width}, expected at least one patch of {patch} px")
    return height // patch, width // patch


def patch_tokens(
    merged: MergedDepth,
    hole: Tensor,  # (B, N) codes.Hole
    hw: tuple[int, int],
    *,
    patch: int = 14,
    tokens_hw: tuple[int, int] | None = None,
    fit: str = "stretch",
) -> tuple[Tensor, Tensor]:
    """Samples with depth and hole class -> tokens (B, P, 10) and whether a patch has any depth (B, P) bool.

    Tokens hold inverse depth, because it is bounded and triangulation errors are uniform in it. ``inverse_depth`` and
    ``sigma`` are the mean and standard deviation of the inverse depth of a random point of the patch: noise of the
    samples plus their spread. ``answered`` is the fraction of samples with a depth. The fractions of the hole classes
    give the reasons for missing returns, ``hole_none`` being the fraction with a usable return; they sum to 1, or to 0
    in a patch without samples.

    The channels need no statistics of a data set: fractions lie in [0, 1], ``inverse_depth`` and ``sigma`` are 1/m on
    the same scale in every set: 0 to 4 for depths beyond 0.25 m, 0 in a patch without a depth.

    Args:
        merged: sensor and recovered depths, from :func:`dhtorch.pipeline.pair.merge`.
        hole: class of each sample.
        hw: size of the image that ``merged.uv`` are pixels of.
        patch: side of a patch, px of the network's input.
        tokens_hw: size of the network's input; None = ``hw``. The remainder of a size that is no multiple of the
            patch, on the right and below, is dropped, as the network's convolution drops it.
        fit: how the image is resized to that size, one of :data:`FIT_MODES`.

    Raises:
        ValueError: wrong shapes, an unknown fit, or no patch.

    Gradient: to depth and sigma; none through the patch of a sample and whether it has a depth.
    """
    check("patch_tokens", uv=(merged.uv, "B N 2"), depth=(merged.depth, "B N"), hole=(hole, "B N"))
    check("patch_tokens", depth=(merged.depth, "B N"), sigma=(merged.sigma, "B N"), source=(merged.source, "B N"))
    rows, columns = token_grid(hw, patch=patch, tokens_hw=tokens_hw)
    scale, margin = _placement(hw, tokens_hw or hw, fit)
    return _pool_tokens(
        merged.uv,
        merged.depth,
        merged.sigma,
        merged.source,
        hole,
        grid=(patch, rows, columns),
        scale=scale,
        margin=margin,
    )


def _pool_tokens_kernel(
    uv: Tensor,
    depth: Tensor,
    sigma: Tensor,
    source: Tensor,
    hole: Tensor,
    *,
    grid: tuple[int, int, int],
    scale: list[float],
    margin: list[float],
) -> tuple[Tensor, Tensor]:
    tokens = depth.new_empty(len(depth), grid[1] * grid[2], len(TOKEN_CHANNELS))
    valid = torch.empty_like(tokens[..., 0], dtype=torch.bool)
    samples = uv.contiguous(), depth, sigma, source, hole
    torch.ops.dhtorch.patch_tokens.default(*samples, tokens, valid, *grid, *scale, *margin)
    return tokens, valid


@operator(
    kernel=_pool_tokens_kernel,
    dtypes={
        "uv": torch.float32,
        "depth": torch.float32,
        "sigma": torch.float32,
        "source": torch.int32,
        "hole": torch.int32,
    },
    any_layout=("uv",),
)
def _pool_tokens(
    uv: Tensor,
    depth: Tensor,
    sigma: Tensor,
    source: Tensor,
    hole: Tensor,
    *,
    grid: tuple[int, int, int],
    scale: list[float],
    margin: list[float],
) -> tuple[Tensor, Tensor]:
    """:func:`patch_tokens` of samples; ``grid``: side of a patch in px, rows and columns of patches."""
    patch, rows, columns = grid
    # Pixels (B, N, 2) -> index (B, N) of the patch that contains each; rows · columns if none does
    position = uv.detach().double() + 0.5
    position = position * (scale[0] if scale[0] == scale[1] else position.new_tensor(scale))
    if any(margin):
        position = position + position.new_tensor(margin)
    column, row = (position / patch).floor().unbind(-1)
    inside = (column.clamp(0, columns - 1) == column) & (row.clamp(0, rows - 1) == row)
    cell = torch.where(inside, torch.add(column, row, alpha=columns), rows * columns).long()

    def total(x: Tensor) -> Tensor:  # (B, N, k) → (B, P + 1, k), the last for samples outside all patches
        zero = torch.zeros(x.shape[0], rows * columns + 1, x.shape[2], dtype=torch.float64, device=x.device)
        return zero.scatter_add(1, cell[..., None].expand_as(x), x)

    answered = (source != Source.NONE) & (depth > 0)
    inverse = torch.where(answered, depth, torch.inf).double().reciprocal()
    noise = torch.where(answered, sigma, 0.0).double() * inverse * inverse
    is_class = hole[..., None] == torch.arange(_N_HOLE_CLASSES, dtype=hole.dtype, device=hole.device)
    sums = total(
        torch.cat((torch.ones_like(inverse)[..., None], inverse[..., None], answered[..., None], is_class), -1)
    )
    per_sample, per_answered = sums[..., ::2][..., :2].clamp_min(1).reciprocal().split(1, -1)
    mean = sums[..., 1:2] * per_answered
    residual = torch.where(answered, inverse - mean[..., 0].gather(1, cell), 0.0)
    variance = total((noise * noise + residual * residual)[..., None]) * per_answered
    positive = variance > 0
    spread = torch.where(positive, torch.where(positive, variance, 1.0).sqrt(), 0.0)
    tokens = torch.cat((mean, spread, sums[..., 2:] * per_sample), -1)[:, :-1]
    return tokens.to(depth.dtype), sums[:, :-1, 2] > 0


def _placement(hw: tuple[int, int], tokens_hw: tuple[int, int], fit: str) -> tuple[list[float], list[float]]:
    """Image and input size -> scale and margin along x and y that map (uv + ½) into the network's input."""
    if fit not in FIT_MODES:
        raise ValueError(f"tokens: fit is {fit!r}, expected one of {', '.join(FIT_MODES)}")
    scale = [tokens_hw[1] / hw[1], tokens_hw[0] / hw[0]]
    if fit != "stretch":
        scale = [min(scale) if fit == "pad" else max(scale)] * 2
    margin = [(tokens_hw[k] - hw[k] * s) / 2 for k, s in zip((1, 0), scale, strict=True)]
    return scale, margin
