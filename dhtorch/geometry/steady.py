"""Elementwise functions whose rounding does not depend on where in a tensor an element stands.

On the CPU, torch evaluates sin, atan2, pow, … with vector instructions and hands the last few elements of a tensor to
the scalar library, which may round differently. An element's answer would then depend on how many others travel with
it.
Additions, products, quotients and square roots are exact to rounding everywhere and need no such care.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

#: A multiple of every vector loop's stride (two AVX-512 registers of float32 hold 32 values).
STRIDE = 64


def steady(fn: Callable[..., Tensor], *xs: Tensor) -> Tensor:
    """``fn(*xs)`` elementwise on equally shaped tensors, padded so that no element falls into the scalar tail.

    Gradient: that of ``fn``. Raises ValueError for unequal shapes.
    """
    shape = xs[0].shape
    if any(x.shape != shape for x in xs):
        raise ValueError(f"steady: shapes are {[tuple(x.shape) for x in xs]}, expected equal shapes")
    tail = -xs[0].numel() % STRIDE
    padded = [torch.nn.functional.pad(x.reshape(-1), (0, tail), value=0.5) for x in xs]
    return fn(*padded)[: xs[0].numel()].reshape(shape)
