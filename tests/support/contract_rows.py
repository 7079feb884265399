"""Rows of the contract table of public functions in geometry, stages and metrics, and helpers on trees of tensors.

A :class:`Row` makes the inputs of a function and lists the promises that hold; ``test_contract.py`` has the rows and a
test for every promise. Leaves are the tensors of records, tuples and dicts, in order.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils import _pytree as pytree

#: The promises a row can make.
PROMISES = ("dtype", "batch", "vmap", "capture", "gradcheck", "empty", "shuffle", "padding", "nan", "raises")


@dataclass(frozen=True)
class Row:
    """One public function in the contract table."""

    fn: Callable[..., Any]
    make: Callable[..., tuple]  # (batch, n, dtype) -> positional arguments with leading dims (B, …) or (B, N, …)
    promises: str  # names from PROMISES, separated by blanks
    points: tuple[int, ...] = ()  # positions of arguments with a point axis (axis 1 of every leaf)
    grad: tuple[int, ...] = ()  # positions of arguments whose floating leaves are differentiated
    shared: tuple[int, ...] = ()  # positions of arguments without a batch axis
    bad: Callable[[tuple], tuple] | None = None  # arguments → a call with a wrong shape
    leaks: bool = False  # "nan": 0 · NaN of a hopeless point reaches the gradient of what all points share
    slow: str = ""  # promises that take long: tested with the slow ones
    atol: float = 1e-6  # shuffle, padding, capture: how equal


def leaves(x: Any) -> list[torch.Tensor]:
    """Tensors of a tree, in order."""
    return [v for v in pytree.tree_leaves(x) if isinstance(v, torch.Tensor)]


def tensor_map(fn: Callable[[torch.Tensor], torch.Tensor], x: Any) -> Any:
    """Apply ``fn`` to the tensors of a tree and leave the rest."""
    return pytree.tree_map(lambda v: fn(v) if isinstance(v, torch.Tensor) else v, x)


def take(args: tuple, row: Row, b: int) -> tuple:
    """Arguments of batch element ``b`` alone, batch size 1."""
    return tuple(a if k in row.shared else tensor_map(lambda v: v[b : b + 1], a) for k, a in enumerate(args))


def reorder(args: tuple, row: Row, order: torch.Tensor) -> tuple:
    """Arguments with their points taken in another order."""
    return tuple(tensor_map(lambda v: v[:, order], a) if k in row.points else a for k, a in enumerate(args))


def equal(a: Any, b: Any, atol: float | None = None) -> None:
    """Assert that two trees hold the same values; bit for bit without ``atol``. NaN equals NaN."""
    left, right = leaves(a), leaves(b)
    assert len(left) == len(right)
    for k, (x, y) in enumerate(zip(left, right, strict=True)):
        assert x.shape == y.shape and x.dtype == y.dtype, f"leaf {k}: {x.shape} {x.dtype} against {y.shape} {y.dtype}"
        if atol is None:
            same = (x == y) | (x.isnan() & y.isnan()) if x.is_floating_point() else x == y
            assert same.all(), f"leaf {k}: {(~same).sum()} of {same.numel()} differ"
        else:
            torch.testing.assert_close(x, y, rtol=1e-5, atol=atol, equal_nan=True, msg=lambda m, k=k: f"leaf {k}: {m}")
