"""Run a function in inference mode where no gradient is required -> its result as ordinary tensors, bit for bit.

``torch.no_grad`` still counts versions and walks the dispatcher's autograd layer at every operation;
``torch.inference_mode`` does neither, but its tensors can enter no graph afterwards. So they stay inside, and the
results are copied. No bit of a result depends on it.
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


def run_without_grad(fn: Callable[..., _Result], *args: Any, **options: Any) -> _Result:
    """``fn(*args, **options)``, in inference mode where no tensor among the arguments requires a gradient.

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
