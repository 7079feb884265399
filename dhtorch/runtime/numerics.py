"""Torch's process-wide defaults kept away from computations that state no dtype or device of their own.

``torch.set_default_dtype``, ``torch.set_default_device`` and ``torch.autocast`` change what ``torch.eye(2)`` or a
matrix product gives. Poses, covariances and depth in metres need float32 at least, so results must not depend on them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

_P = ParamSpec("_P")
_T = TypeVar("_T")


def standard_numerics(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Decorator: within a call the default dtype is float32, the default device the CPU, and autocast is off.

    Nothing is changed where they are so already, or while ``torch.compile`` traces. The default dtype belongs to the
    process: while a call that had to change it lasts, other threads have float32, too.
    """

    @wraps(function)
    def wrapped(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        if torch.compiler.is_compiling():
            return function(*args, **kwargs)
        with _standard_defaults():
            return function(*args, **kwargs)

    return wrapped


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
