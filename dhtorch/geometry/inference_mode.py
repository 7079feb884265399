"""What asks for no graph is worked out without the book-keeping for one, which every small operation pays for.

``torch.no_grad`` still counts versions and walks the dispatcher's autograd layer at every operation;
``torch.inference_mode`` does neither, but its tensors may enter no graph ever after. So they stay inside, and what
comes out is copied. No bit of an answer depends on it.
"""

from __future__ import annotations

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
    """``fn(*args, **options)``, in inference mode where no tensor among the arguments asks for a graph.

    Tensors that ``fn`` reads elsewhere must not ask for one; it may keep none that it makes.

    Gradient: that of ``fn``.
    """
    if is_transformed() or torch.is_inference_mode_enabled():  # a compiler looks no further than the first
        return fn(*args, **options)
    if forward_ad._current_level >= 0 or _asked(args, options):
        return fn(*args, **options)
    with torch.inference_mode():
        found = fn(*args, **options)
    # A record knows its own fields: a walk through it as a tree takes several times as long.
    return found.map(_usual) if isinstance(found, Record) else torch_pytree.tree_map(_usual, found)


def _asked(*trees: Any) -> bool:
    """Whether a graph is wanted of what these tensors become."""
    if not torch.is_grad_enabled():
        return False
    return any(isinstance(x, Tensor) and x.requires_grad for x in torch_pytree.tree_leaves(trees))


def _usual(x: Any) -> Any:
    """A tensor that may enter a graph."""
    return x.clone() if isinstance(x, Tensor) and x.is_inference() else x
