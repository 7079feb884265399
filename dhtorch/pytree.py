"""Records: frozen dataclasses of tensors, registered as pytrees.

A record has shared leading (batch) dimensions, is never changed in place, and is an ordinary pytree: it passes
through ``torch.func``, ``torch.compile(fullgraph=True)``, pickling and data-loader workers. An absent field is
``None``. There is no tensor subclass and there are no operators.
"""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, Self, TypeVar, dataclass_transform

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

R = TypeVar("R", bound="Record")

#: Field metadata: the dtype of this field is part of its meaning (codes, time stamps);
#: ``.to(dtype)`` does not change it.
KEEP_DTYPE = {"keep_dtype": True}


class Record:
    """Base class of all records, which are declared with :func:`record`; never instantiated itself."""

    def map(self, fn: Callable[[Tensor], Tensor]) -> Self:
        """Apply ``fn`` to every tensor, nested records included; ``None`` stays ``None``."""
        return type(self)(**{k: _map_value(v, fn) for k, v in _items(self)})

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """Move to a device and/or floating dtype, as ``Tensor.to``.

        A dtype is applied to floating-point fields only; time stamps, codes and ``uint8`` images keep theirs.
        """
        device, dtype, non_blocking, _ = torch._C._nn._parse_to(*args, **kwargs)
        changes: dict[str, Any] = {}
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            if isinstance(value, Record):
                changes[field.name] = value.to(device=device, dtype=dtype, non_blocking=non_blocking)
            elif isinstance(value, Tensor):
                keep = dtype is None or field.metadata.get("keep_dtype", False) or not value.is_floating_point()
                changes[field.name] = value.to(device, value.dtype if keep else dtype, non_blocking=non_blocking)
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]

    def pin_memory(self) -> Self:
        """Page-locked copies; ``torch.utils.data.DataLoader(pin_memory=True)`` calls this."""
        return self.map(lambda x: x.pin_memory())

    def detach(self) -> Self:
        """A copy detached from the autograd graph."""
        return self.map(lambda x: x.detach())

    def replace(self, **changes: Any) -> Self:
        """A copy with some fields replaced."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]

    def __getitem__(self, index: Any) -> Self:
        """Index the leading dimensions of every tensor."""
        return self.map(lambda x: x[index])


@dataclass_transform(frozen_default=True, eq_default=False)
def record(cls: type[R]) -> type[R]:
    """Make ``cls`` (a subclass of :class:`Record`) a frozen dataclass that is registered as a pytree."""
    cls = dataclasses.dataclass(frozen=True, eq=False)(cls)
    pytree.register_dataclass(cls, field_names=[f.name for f in dataclasses.fields(cls)])  # type: ignore[arg-type]
    torch.serialization.add_safe_globals([cls])
    return cls


def stack(records: Iterable[R], dim: int = 0) -> R:
    """Join equally shaped records along a new leading dimension."""
    return _join(list(records), lambda xs: torch.stack(xs, dim))


def collate(records: Iterable[R], dim: int = 0) -> R:
    """Join records along a dimension, the first (batch); the ``collate_fn`` of a data loader over frames or pairs.

    Raises:
        ValueError: no record, different kinds of records, a field present in some records only, or unequal shapes.
    """
    return _join(list(records), lambda xs: torch.cat(xs, dim).contiguous())


def chunked_apply(fn: Callable[..., R], size: int, *batch: Any) -> R:
    """``fn(*batch)`` computed in chunks of at most ``size`` batch items of tensors and records, none of them ``None``.

    ``fn`` must process every item independently. Gradient: that of ``fn``.
    """
    count = len(_first(batch[0]))
    if count <= size:
        return fn(*batch)
    return collate(fn(*(x[i : i + size] for x in batch)) for i in range(0, count, size))


def _first(x: Any) -> Tensor:
    """The first tensor in a tensor or record, without traversing all fields."""
    while isinstance(x, Record):
        x = next(value for _, value in _items(x) if value is not None)
    tensor: Tensor = x
    return tensor


def _items(rec: Record) -> list[tuple[str, Any]]:
    return [(f.name, getattr(rec, f.name)) for f in dataclasses.fields(rec)]  # type: ignore[arg-type]


def _map_value(value: Any, fn: Callable[[Tensor], Tensor]) -> Any:
    if isinstance(value, Record):
        return value.map(fn)
    return fn(value) if isinstance(value, Tensor) else value


def _join(records: list[R], join: Callable[[list[Tensor]], Tensor]) -> R:
    if not records:
        raise ValueError("collate: expected at least one record, found none")
    if len({type(r) for r in records}) != 1:
        raise ValueError(f"collate: expected records of one kind, found {sorted({type(r).__name__ for r in records})}")
    joined: dict[str, Any] = {}
    for name, first in _items(records[0]):
        values = [getattr(r, name) for r in records]
        where = f"{type(records[0]).__name__}.{name}"
        if any((v is None) != (first is None) for v in values):
            raise ValueError(f"collate: {where} is present in some records and absent in others")
        if first is None:
            joined[name] = None
        elif isinstance(first, Record):
            joined[name] = _join(values, join)
        else:
            try:
                joined[name] = join(values)
            except RuntimeError as error:
                shapes = sorted({tuple(v.shape) for v in values})
                raise ValueError(f"collate: {where} has unequal shapes {shapes}") from error
    return type(records[0])(**joined)
