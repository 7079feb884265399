"""DINOv2 through ``transformers``: the visual branch with which the paper compares the time of its front end.

The cost of a forward pass does not depend on the values of the weights, so random ones suffice for timing; features
need the real ones, from a local file or folder. Nothing is ever downloaded.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import torch
from kornia.enhance import normalize
from torch import Tensor

from dhtorch.experiments.baselines.dinov2_weights import Dinov2Weights, read_dinov2_weights
from dhtorch.geometry.checks import check

#: Installation of the library.
_INSTALL_HINT = 'pip install "dhtorch[learned]"'

#: Mean of the colours with which the network was trained.
COLOUR_MEAN = (0.485, 0.456, 0.406)

#: Standard deviation of the colours with which the network was trained.
COLOUR_STD = (0.229, 0.224, 0.225)


def import_dinov2(*, registers: bool = False) -> tuple[Any, Any]:
    """Configuration and model class of ``transformers``, imported only here: DINOv2, or with register tokens.

    Raises:
        ImportError: it is not installed; the message has the command.
    """
    try:
        import transformers  # noqa: PLC0415  (seconds, and optional)

        name = "Dinov2WithRegisters" if registers else "Dinov2"
        return getattr(transformers, f"{name}Config"), getattr(transformers, f"{name}Model")
    except (ImportError, AttributeError) as error:
        raise ImportError(f"DINOv2 needs transformers ({error}): {_INSTALL_HINT}") from error


def load_dinov2(
    weights: str | Path | None = None,
    *,
    layer: int | None = None,
    hidden: int = 1024,
    layers: int = 24,
    heads: int = 16,
    patch: int = 14,
    side: int = 224,
    seed: int = 0,
) -> torch.nn.Module:
    """Build or load a DINOv2 network in evaluation mode; the default sizes are those of DINOv2-L (ViT-L/14 at 224×224).

    Call it with ``pixel_values=`` (B, 3, H, W), from :func:`preprocess_image`; ``last_hidden_state`` of its output is
    (B, 1 + R + patches, hidden): the class token, R = :func:`register_count` register tokens, the patches row by row.

    Args:
        weights: folder or file as of :func:`dhtorch.experiments.baselines.dinov2_weights.read_dinov2_weights`; it then
            determines the sizes. None = random weights of the sizes below.
        layer: number of layers that are kept, from the first; None = all. The final norm follows the last kept one.
        hidden, layers, heads: width, number of layers and of attention heads.
        patch, side: sides of a patch and of the square image, px.
        seed: seed of random weights; torch's global random state is not changed.

    Raises:
        ImportError: ``transformers`` is not installed.
        FormatError: the file is missing, or not exactly one DINOv2 network.
        ValueError: the network has fewer layers than ``layer``.
    """
    if weights is None:
        Config, Model = import_dinov2()
        sizes = {"hidden_size": hidden, "num_hidden_layers": layers, "num_attention_heads": heads}
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network: torch.nn.Module = Model(Config(**sizes, patch_size=patch, image_size=side))
    else:
        import_dinov2()  # before a large file is read
        network = _with_weights(read_dinov2_weights(weights))
    # The network without the layers behind the first ``layer``
    encoder = cast(Any, network).encoder
    if layer is not None:
        if not 1 <= layer <= len(encoder.layer):
            raise ValueError(f"dinov2: layer is {layer}, expected 1 to {len(encoder.layer)}")
        encoder.layer = encoder.layer[:layer]
    return network.eval()


def register_count(network: torch.nn.Module) -> int:
    """Number of register tokens between the class token and the patch tokens of a network's output."""
    return int(getattr(network.config, "num_register_tokens", 0))


def _with_weights(weights: Dinov2Weights) -> torch.nn.Module:
    """The network of the sizes and parameters of a file, every one of them set."""
    Config, Model = import_dinov2(registers=weights.has_registers)
    from transformers.utils import logging  # noqa: PLC0415

    had_bar, verbosity = logging.is_progress_bar_enabled(), logging.get_verbosity()
    logging.disable_progress_bar()
    logging.set_verbosity_error()
    try:
        network, info = Model.from_pretrained(
            None, config=Config(**weights.sizes), state_dict=weights.state, output_loading_info=True
        )
    finally:
        logging.set_verbosity(verbosity)
        if had_bar:
            logging.enable_progress_bar()
    wrong = {name: sorted(map(str, keys)) for name, keys in info.items() if keys}
    if wrong:
        raise ValueError(f"{weights.origin}: transformers set not all parameters of DINOv2: {wrong}")
    loaded: torch.nn.Module = network.float()
    cast(Any, loaded).weights_origin = weights.origin
    return loaded


def describe_weights(network: torch.nn.Module) -> str:
    """Width, depth and file of a network with read weights, with what is to be known of them."""
    loaded = cast(Any, network)
    config = loaded.config
    size = f"{len(loaded.encoder.layer)} of {config.num_hidden_layers} layers, width {config.hidden_size}"
    return f"DINOv2 ({size}) with the weights of {loaded.weights_origin}"


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
