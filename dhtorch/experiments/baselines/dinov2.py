"""DINOv2 through ``transformers``: the visual branch with which the paper compares the time of its front end.

The cost of a forward pass does not depend on the values of the weights, so random ones suffice for timing; features
need the real ones, from a local folder. Nothing is ever downloaded.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from kornia.enhance import normalize
from torch import Tensor

from dhtorch.geometry.checks import check

#: Installation of the library.
_INSTALL_HINT = 'pip install "dhtorch[learned]"'

#: Mean of the colours with which the network was trained.
COLOUR_MEAN = (0.485, 0.456, 0.406)

#: Standard deviation of the colours with which the network was trained.
COLOUR_STD = (0.229, 0.224, 0.225)


def import_dinov2() -> tuple[Any, Any]:
    """``Dinov2Config`` and ``Dinov2Model`` of ``transformers``, imported only here.

    Raises:
        ImportError: it is not installed; the message has the command.
    """
    try:
        from transformers import Dinov2Config, Dinov2Model  # noqa: PLC0415  (seconds, and optional)
    except ImportError as error:
        raise ImportError(f"DINOv2 needs transformers ({error}): {_INSTALL_HINT}") from error
    return Dinov2Config, Dinov2Model


def load_dinov2(
    weights: str | Path | None = None,
    *,
    hidden: int = 1024,
    layers: int = 24,
    heads: int = 16,
    patch: int = 14,
    side: int = 224,
    seed: int = 0,
) -> torch.nn.Module:
    """Build or load a DINOv2 network in evaluation mode; the default sizes are those of DINOv2-L (ViT-L/14 at 224×224).

    Call it with ``pixel_values=`` (B, 3, H, W), from :func:`preprocess_image`; ``last_hidden_state`` of its output is
    (B, 1 + patches, hidden), the class token first.

    Args:
        weights: folder with ``config.json`` and weights, as ``save_pretrained`` writes it; it then
            determines the sizes. None = random weights of the sizes below.
        hidden, layers, heads: width, number of layers and of attention heads.
        patch, side: sides of a patch and of the square image, px.
        seed: seed of random weights; torch's global random state is not changed.

    Raises:
        ImportError: ``transformers`` is not installed.
        FileNotFoundError: no such folder.
    """
    Config, Model = import_dinov2()
    if weights is not None:
        if not Path(weights).is_dir():
            raise FileNotFoundError(f"{weights}: found no folder, expected one with config.json and DINOv2 weights")
        network: torch.nn.Module = Model.from_pretrained(str(weights), local_files_only=True)
        return network.eval()
    sizes = {"hidden_size": hidden, "num_hidden_layers": layers, "num_attention_heads": heads}
    config = Config(**sizes, patch_size=patch, image_size=side)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = Model(config)
    return network.eval()


def preprocess_image(image: Tensor, side: int = 224) -> Tensor:
    """Image (B, C, H, W) → the network's input: resized to a square, colours normalised.

    Args:
        image: (B, C, H, W) with C 1 or 3, float in [0, 1] or uint8.
        side: side of the result, px; the aspect ratio is not kept.

    Returns:
        (B, 3, side, side).
    """
    check("preprocess_image", image=(image, "B C H W"))
    x = image / 255 if image.dtype == torch.uint8 else image
    x = torch.nn.functional.interpolate(x, (side, side), mode="bicubic", antialias=True, align_corners=False)
    return normalize(x.clamp(0, 1).expand(-1, 3, -1, -1), x.new_tensor(COLOUR_MEAN), x.new_tensor(COLOUR_STD))
