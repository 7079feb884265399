"""Batch-independent rounding: padding with which results are bit-equal alone, in a batch, in any order and worker.

On the CPU, torch uses vector instructions and scalar ones for the remainder of a row, which may round differently; a
matrix product changes its order of summation with its sizes; and a sum is split by its length. The result of an element
would then depend on the number of the others. Three rules prevent that, for all code on rows of points:

- rows are padded to whole :data:`ELEMENTWISE_LANES` (:func:`round_up`), with points whose results are discarded;
- matrix products and sums over points run over whole :data:`PRODUCT_LANES` and :data:`SUM_LANES`; products of 2×2 and
  3×3 matrices are written out as sums;
- sin, atan2, pow, … go through :func:`pad_elementwise`.

Additions, products, quotients and square roots are correctly rounded everywhere and need no padding. The number of
points that are processed at once (:data:`MAX_CHUNK_POINTS`) affects speed only: it is a multiple of all lane counts and
changes no bit.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils import _pytree as torch_pytree

from dhtorch.geometry.checks import is_transformed
from dhtorch.pytree import Record

_Result = TypeVar("_Result")

#: Multiple of row lengths, in elements, without a scalar tail in vector loops (two AVX-512 registers of float32 hold 32
#: values).
ELEMENTWISE_LANES = 64

#: Multiple of the number of points of a matrix product for which its rounding does not depend on that number.
PRODUCT_LANES = 16

#: Block length of sums over points, in points, for which their rounding does not depend on the zeros appended.
SUM_LANES = 256

#: Number of points whose windows are read at once: few enough for these to stay in the cache.
#: Source: derived, fits the L2/L3 cache.
MAX_CHUNK_POINTS = 256

#: Times as many that an accelerator processes at once, which has no such cache and for which each call costs.
#: Source: chosen on an H100 with 64 pairs, from 64: a call of few points takes as long as one of many.
ACCELERATOR_CHUNKS = 256


def chunk_size(size: int, x: Tensor) -> int:
    """Number of items of ``x`` processed at once: ``size`` on the CPU, more on an accelerator."""
    return size if x.is_cpu else size * ACCELERATOR_CHUNKS


def round_up(count: int, lanes: int = ELEMENTWISE_LANES) -> int:
    """Count -> the next multiple of ``lanes``, at least ``lanes``."""
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


def run_without_grad(fn: Callable[..., _Result], *args: Any, **options: Any) -> _Result:
    """``fn(*args, **options)``, in inference mode where no tensor among the arguments requires a gradient.

    ``torch.no_grad`` still counts versions and walks the dispatcher's autograd layer at every operation;
    ``torch.inference_mode`` does neither, but its tensors can enter no graph afterwards. So they stay inside, and the
    results are copied. No bit of a result depends on it.

    Other tensors that ``fn`` reads must not require one, and ``fn`` must not store tensors that it creates.

    Gradient: that of ``fn``.
    """
    if is_transformed() or torch.is_inference_mode_enabled():  # under a compiler only the first condition is evaluated
        return fn(*args, **options)
    needs_graph = torch.is_grad_enabled() and any(
        isinstance(x, Tensor) and x.requires_grad for x in torch_pytree.tree_leaves((args, options))
    )
    if forward_ad._current_level >= 0 or needs_graph:
        return fn(*args, **options)
    with torch.inference_mode():
        result = fn(*args, **options)
    # A record maps over its own fields: a generic tree map takes several times as long.
    return (
        result.map(_leave_inference_mode)
        if isinstance(result, Record)
        else torch_pytree.tree_map(_leave_inference_mode, result)
    )


def _leave_inference_mode(x: Any) -> Any:
    """The value, with an inference tensor copied to one that can enter a graph."""
    return x.clone() if isinstance(x, Tensor) and x.is_inference() else x
