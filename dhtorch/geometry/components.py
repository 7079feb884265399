"""Connected pixels of maps: which pixels belong to a component of few pixels.

Alphabet: maps (B, h, w) bool. Pixels are connected to their four neighbours.
"""

import torch
from torch import Tensor

from dhtorch.ops.dispatch import operator, run_kernel


@torch.no_grad()
def small_components(mask: Tensor, n_pixels: int, *, same: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """Pixels (B, h, w) bool of ``mask`` whose component has fewer than ``n_pixels``.

    Args:
        mask: (B, h, w) bool.
        n_pixels: least number of pixels of a component that is not small.
        same: (B, h, w - 1) and (B, h - 1, w) bool, whether a pixel of the mask is connected to its right and to its
            lower neighbour; None = wherever both are in the mask.

    A component of n pixels is at most n - 1 steps long: after so many steps, in each of which every pixel takes the
    least number of its neighbours, its pixels have one number, and none of their neighbours has another.
    Cost: ``n_pixels`` passes over the map.
    """
    if n_pixels <= 1:
        return torch.zeros_like(mask)
    right, down = mask[..., 1:] & mask[..., :-1], mask[:, 1:] & mask[:, :-1]
    if same is not None:
        right, down = right & same[0], down & same[1]
    return _small(mask, right, down, n_pixels=n_pixels)


@operator(
    kernel=lambda *masks, n_pixels: run_kernel(
        "small_components", masks, torch.empty_like(masks[0], memory_format=torch.contiguous_format), n_pixels
    ),
    dtypes=dict.fromkeys(("mask", "right", "down"), torch.bool),
    any_layout=("mask", "right", "down"),
)
def _small(mask: Tensor, right: Tensor, down: Tensor, *, n_pixels: int) -> Tensor:
    """:func:`small_components` of a mask whose pixels are connected to the right and down."""
    b, h, w = mask.shape
    far = b * h * w
    label = torch.arange(far, device=mask.device, dtype=torch.int32).view(b, h, w)
    not_right, not_down = (~right).to(torch.int32) * far, (~down).to(torch.int32) * far
    for _ in range(n_pixels - 1):
        a, c = label[..., :-1], label[..., 1:]
        least = label.clone()
        least[..., :-1] = torch.minimum(least[..., :-1], c + not_right)
        least[..., 1:] = torch.minimum(least[..., 1:], a + not_right)
        a, c = label[:, :-1], label[:, 1:]
        least[:, :-1] = torch.minimum(least[:, :-1], c + not_down)
        least[:, 1:] = torch.minimum(least[:, 1:], a + not_down)
        label = least
    differs = torch.zeros_like(mask)
    border = right & (label[..., 1:] != label[..., :-1])
    differs[..., 1:] |= border
    differs[..., :-1] |= border
    border = down & (label[:, 1:] != label[:, :-1])
    differs[:, 1:] |= border
    differs[:, :-1] |= border
    flat = label.flatten().long()
    count = torch.zeros(far, dtype=torch.int32, device=mask.device)
    count.index_add_(0, flat, (mask.int() + n_pixels * differs.int()).flatten())
    return mask & (count[flat].view_as(mask) < n_pixels)
