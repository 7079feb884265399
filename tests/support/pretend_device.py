"""A pretended accelerator: tensors that say ``cuda`` and compute on the CPU, so that no device is needed.

Operations that mix devices raise as on a device; those for which the host waits (it reads a value, or a shape depends on
values) are recorded with the lines that called them. Rounding, speed and memory are the CPU's.
"""

import traceback
from collections import Counter
from contextlib import nullcontext
from pathlib import Path
from unittest import mock

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

import dhtorch

DEVICE = torch.device("meta")
_aten = torch.ops.aten
_PACKAGE = str(Path(dhtorch.__file__).parent)

#: Operations that read values on the host or whose result has a size that depends on values.
_WAITS = {
    _aten._local_scalar_dense.default: "item",
    _aten.is_nonzero.default: "bool",
    _aten.equal.default: "equal",
    _aten.nonzero.default: "nonzero",
    _aten.masked_select.default: "masked_select",
    _aten._linalg_check_errors.default: "linalg_check_errors",
    _aten._linalg_eigh.default: "eigh",
    _aten._linalg_svd.default: "svd",
    _aten.linalg_lstsq.default: "lstsq",
    _aten._unique2.default: "unique",
    _aten.unique_dim.default: "unique",
    _aten.repeat_interleave.Tensor: "repeat_interleave",
    _aten.bincount.default: "bincount",
}
_INDEXED = {_aten.index.Tensor: 1, _aten.index_put_.default: 1, _aten.index_put.default: 1}
_COPIES = {_aten._to_copy.default, _aten.copy_.default}


class OnDevice(Tensor):
    """A tensor whose values lie in ``held``, on the CPU."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> "OnDevice":
        x = Tensor._make_wrapper_subclass(
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=DEVICE,
            requires_grad=held.requires_grad,
        )
        x.held = held
        return x

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        raise RuntimeError(f"{func}: found a tensor of the pretended device outside its mode")


class PretendDevice(TorchDispatchMode):
    """Inside, ``cuda`` is a device; ``waits`` counts (kind, file:line of the package) of what made the host wait."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter[tuple[str, str]] = Counter()

    def __enter__(self):
        make, is_autocast = torch.tensor, torch.is_autocast_enabled

        def tensor(data, *, device=None, **options):  # these two build tensors without the dispatcher
            x = make(data, **options)
            return x if device is None else x.to(device)

        def new_tensor(like, data, *, dtype=None, device=None, **options):
            return tensor(data, dtype=like.dtype if dtype is None else dtype, device=device or like.device, **options)

        self._patches = [
            mock.patch.object(torch, "tensor", tensor),
            mock.patch.object(Tensor, "new_tensor", new_tensor),
            mock.patch.object(torch, "inference_mode", lambda on=True: torch.no_grad() if on else nullcontext()),
            mock.patch.object(torch, "is_autocast_enabled", lambda t="cpu": t != DEVICE.type and is_autocast(t)),
        ]
        for patch in self._patches:
            patch.start()
        return super().__enter__()

    def __exit__(self, *args):
        for patch in self._patches:
            patch.stop()
        return super().__exit__(*args)

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        leaves = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
        there = any(isinstance(x, OnDevice) for x in leaves)
        wanted = kwargs.get("device")
        wanted = None if wanted is None else torch.device(wanted)
        if wanted is not None:
            kwargs["device"] = torch.device("cpu")
        is_copy = func in _COPIES
        home = [x for x in leaves if not isinstance(x, OnDevice)]
        # Indices at home are copied to the device.
        is_index = func in _INDEXED and all(any(x is i for i in args[1]) for x in home)
        if there and not is_copy and any(x.ndim for x in home) and not is_index:
            shapes = [(tuple(x.shape), x.device.type) for x in leaves]
            raise RuntimeError(f"{func}: expected all tensors on one device, found {shapes}")
        self._record(func, args, kwargs, there, wanted)
        result = func(*tree_map(_unwrap, args), **tree_map(_unwrap, kwargs))
        if func is _aten.copy_.default:
            return args[0]
        if wanted is not None:
            there = wanted.type == DEVICE.type
        if not there:
            return result
        known = {id(x.held): x for x in tree_leaves((args, kwargs)) if isinstance(x, OnDevice)}
        return tree_map(lambda x: known.get(id(x), OnDevice(x)) if isinstance(x, Tensor) else x, result)

    def _record(self, func, args, kwargs, there, wanted) -> None:
        kind = _WAITS.get(func) if there else None
        if there and func in _INDEXED:
            indices = [i for i in args[1] if i is not None]
            if any(i.dtype in (torch.bool, torch.uint8) for i in indices):
                scalar = len(args) > 2 and args[2].numel() == 1
                kind = None if scalar and len(indices) == 1 and func is not _aten.index.Tensor else "mask index"
            elif any(not isinstance(i, OnDevice) for i in indices):
                kind = "index from the host"
        if func is _aten._to_copy.default and wanted is not None:
            source = DEVICE.type if there else "cpu"
            if source != wanted.type and not kwargs.get("non_blocking"):
                kind = f"copy to {wanted.type}"
        if func is _aten.copy_.default and isinstance(args[0], OnDevice) != isinstance(args[1], OnDevice):
            kind = "copy_"
        if kind is not None:
            self.waits[kind, _where()] += 1

    def to(self, x: Tensor) -> Tensor:
        """A tensor on the pretended device, without a wait."""
        return OnDevice(x)


def _unwrap(x):
    return x.held if isinstance(x, OnDevice) else x


def _where() -> str:
    """File and line of the package that called, innermost first."""
    for frame in reversed(traceback.extract_stack()):
        name = frame.filename.removeprefix(f"{_PACKAGE}/")
        if name != frame.filename and "/pytree" not in frame.filename and not name.endswith("checks.py"):
            return f"{name}:{frame.name}:{frame.lineno}"
    return "elsewhere"
