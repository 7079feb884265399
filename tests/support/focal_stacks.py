"""Random focal stacks with depth, and exact light fields of a smooth texture."""

import torch
from torch import Tensor

from dhtorch.experiments.focal.stacks import FocalStack


def random_stack(seed: int, slices: int = 5, hw: tuple[int, int] = (12, 16), depth: bool = True) -> FocalStack:
    """A focal stack of random pictures, with random depth of 0.2 to 2.7 m and one pixel without depth."""
    draw = torch.Generator().manual_seed(seed)
    images = torch.randint(0, 256, (1, slices, 3, *hw), generator=draw).to(torch.uint8)
    metres = 0.2 + 2.5 * torch.rand(1, *hw, generator=draw)
    metres[:, 2, 3] = 0
    return FocalStack(images, depth=metres.half().float() if depth else None)


def texture(y: Tensor, x: Tensor) -> Tensor:
    """Colours (…, 3) from 0 to 255 at places (y, x), smooth: nothing above 0.3 cycles a pixel."""
    waves = [torch.sin(1.7 * x + 0.3 * y), torch.sin(1.1 * y - 0.9 * x), torch.sin(1.8 * y + 0.2 * x)]
    return 127.5 + 110 * torch.stack(waves, -1)


def light_field(disparity: Tensor, hw: tuple[int, int], n: int = 9) -> Tensor:
    """An exact light field (n, n, H, W, 3) of a textured surface with this disparity (px from view to view)."""
    y, x = torch.meshgrid(
        torch.arange(hw[0], dtype=torch.float64), torch.arange(hw[1], dtype=torch.float64), indexing="ij"
    )
    step = torch.arange(n, dtype=torch.float64) - (n - 1) / 2
    views = [[texture(y + disparity * u, x + disparity * v) for v in step] for u in step]
    return torch.stack([torch.stack(row) for row in views]).round().to(torch.uint8)
