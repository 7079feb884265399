"""Torch's process-wide defaults and the strides of tensors kept away from what a public computation gives.

``torch.set_default_dtype``, ``torch.set_default_device`` and ``torch.autocast`` change what ``torch.eye(2)`` or a
matrix product gives. Poses, covariances and depth in metres need float32 at least, so results must not depend on them.
The order in which torch sums depends on strides, and compiled operators read contiguous tensors alone: views, as of
channels-last images, would round differently.
"""

import contextlib
from collections.abc import Callable, Iterator
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from dhtorch.pytree import Record

_P = ParamSpec("_P")
_T = TypeVar("_T")


def standard_numerics(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Decorator: within a call the default dtype is float32, the default device the CPU, autocast is off, and tensors
    among the arguments, in records, lists and tuples, too, are contiguous.

    Nothing is changed where they are so already, or while ``torch.compile`` traces. The default dtype belongs to the
    process: while a call that had to change it lasts, other threads have float32, too.
    """

    @wraps(function)
    def wrapped(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        if torch.compiler.is_compiling():
            return function(*args, **kwargs)
        with _standard_defaults():
            return function(*map(_contiguous, args), **{name: _contiguous(x) for name, x in kwargs.items()})

    return wrapped


def _contiguous(value: Any) -> Any:
    """The value with contiguous tensors; other kinds of objects, as dicts that a call fills, are themselves."""
    if isinstance(value, Tensor):
        return value.contiguous()
    if isinstance(value, Record):
        tensors = [x for x in pytree.tree_leaves(value) if isinstance(x, Tensor)]
        return value if all(x.is_contiguous() for x in tensors) else value.map(Tensor.contiguous)
    return type(value)(map(_contiguous, value)) if type(value) in (list, tuple) else value


@contextlib.contextmanager
def _standard_defaults() -> Iterator[None]:
    with contextlib.ExitStack() as restored:
        for device in ("cpu", "cuda"):
            if torch.is_autocast_enabled(device):
                restored.enter_context(torch.autocast(device, enabled=False))
        dtype = torch.get_default_dtype()
        if dtype != torch.float32:
            restored.callback(torch.set_default_dtype, dtype)
            torch.set_default_dtype(torch.float32)
        if torch.get_default_device().type != "cpu":
            restored.enter_context(torch.device("cpu"))
        yield
