"""What makes answers equal bit for bit: alone or in a batch, in any order, in whatever worker.

On the CPU, torch works with vector instructions and hands what is left over at the end of a row to scalar ones, which
may round differently; a matrix product takes another way through its sums when its sizes change; and a sum is split by
its length. An element's answer would then depend on how many others travel with it. Three habits keep that away, and
whoever works on rows of points follows them:

- rows are filled up to whole :data:`ELEMENTWISE_LANES` (:func:`round_up`), with points whose answers nobody reads;
- matrix products and sums over points run over whole :data:`PRODUCT_LANES` and :data:`SUM_LANES`; products of 2×2 and
  3×3 matrices are written out as sums;
- sin, atan2, pow, … go through :func:`pad_elementwise`.

Additions, products, quotients and square roots are exact to rounding everywhere and need no such care. How many points
are worked on at once (:data:`MAX_CHUNK_POINTS`) is a matter of speed: it is a multiple of all of them, and changes no
bit.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

#: Rows of so many points leave no tail to a vector loop (two AVX-512 registers of float32 hold 32 values).
ELEMENTWISE_LANES = 64

#: Matrix products over points round alike in any company when the number of points is a multiple of this.
PRODUCT_LANES = 16

#: Sums over whole blocks of so many points round alike in any company, however many empty ones follow.
SUM_LANES = 256

#: Points whose windows are read at once: few enough for these to stay in the cache.
MAX_CHUNK_POINTS = 256


def round_up(count: int, lanes: int = ELEMENTWISE_LANES) -> int:
    """``count`` rounded up to whole lanes, at least one."""
    return max(count + -count % lanes, lanes)


def pad_elementwise(fn: Callable[..., Tensor], *xs: Tensor) -> Tensor:
    """``fn(*xs)`` elementwise on equally shaped tensors, padded so that no element falls into the scalar tail.

    Gradient: that of ``fn``. Raises ValueError for unequal shapes.
    """
    shape = xs[0].shape
    if any(x.shape != shape for x in xs):
        raise ValueError(f"pad_elementwise: shapes are {[tuple(x.shape) for x in xs]}, expected equal shapes")
    tail = -xs[0].numel() % ELEMENTWISE_LANES
    padded = [torch.nn.functional.pad(x.reshape(-1), (0, tail), value=0.5) for x in xs]
    return fn(*padded)[: xs[0].numel()].reshape(shape)
