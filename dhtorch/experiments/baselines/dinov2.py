"""DINOv2 through ``transformers``: the visual branch that the paper times its front end against.

The cost of a forward pass does not depend on the values of the weights, so random ones will do for timing; features
need the real ones, from a folder on this machine. Nothing is ever downloaded.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from kornia.enhance import normalize
from torch import Tensor

from dhtorch.geometry.checks import check

#: What to install where the library is missing.
_INSTALL_HINT = 'pip install "dhtorch[learned]"'

#: Mean and standard deviation of the colours the network was trained with.
COLOUR_MEAN, COLOUR_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def import_dinov2() -> tuple[Any, Any]:
    """``Dinov2Config`` and ``Dinov2Model`` of ``transformers``, imported only here.

    Raises:
        ImportError: it is not installed; the message says how to.
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
    """A DINOv2 network in evaluation mode; the default sizes are those of DINOv2-L (ViT-L/14 at 224×224).

    Call it with ``pixel_values=`` (B, 3, H, W), from :func:`preprocess_image`; ``last_hidden_state`` of its answer is
    (B, 1 + patches, hidden), the class token first.

    Args:
        weights: folder with ``config.json`` and weights, as ``save_pretrained`` writes it; its sizes then count.
            None = random weights of the sizes below.
        hidden, layers, heads: width, depth and attention heads.
        patch, side: sides of a patch and of the square picture, px.
        seed: of random weights; torch's own random state is left alone.

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
    """A picture as the network expects it: square, colours centred and scaled.

    Args:
        image: (B, C, H, W) with C 1 or 3, float in [0, 1] or uint8.
        side: of the result, px; the picture is stretched to it.

    Returns:
        (B, 3, side, side).
    """
    check("preprocess_image", image=(image, "B C H W"))
    x = image / 255 if image.dtype == torch.uint8 else image
    x = torch.nn.functional.interpolate(x, (side, side), mode="bicubic", antialias=True, align_corners=False)
    return normalize(x.clamp(0, 1).expand(-1, 3, -1, -1), x.new_tensor(COLOUR_MEAN), x.new_tensor(COLOUR_STD))
