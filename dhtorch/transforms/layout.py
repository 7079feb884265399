"""Layout of samples: type and shape of the values of a good one, for samples in which they are missing or others.

A flagged sample must collate with good ones: what is missing or of another shape becomes zeros of the good one's shape,
and so do values with numbers that are not finite.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dhtorch.transforms.sample_access import get_value, has_key, replace_values

#: Key under which :class:`dhtorch.transforms.ExtendedDataset` marks the items of a batch that are not read: bool.
UNREADABLE_KEY = "dhtorch unreadable"


def zeros_like(value: Any) -> Any:
    """Value -> zeros of the same structure, shape and type; what has no zero (a camera) stays."""
    if isinstance(value, Mapping):
        return {k: zeros_like(v) for k, v in value.items()}
    if isinstance(value, str | bytes):
        return type(value)()
    if isinstance(value, list | tuple):
        return type(value)(zeros_like(v) for v in value)
    if isinstance(value, bool | int | float):
        return type(value)(0)
    if isinstance(value, Tensor):
        return torch.zeros_like(value)
    return np.zeros_like(value) if isinstance(value, np.ndarray | np.generic) else value


def explain_difference(sample: Mapping[str, Any], like: Mapping[str, Any], keys: Iterable[str]) -> str | None:
    """First of the ``keys`` in ``like`` that a sample lacks, or whose value has another type or shape; None = none."""
    for key in keys:
        if not has_key(like, key):
            continue
        expected = get_value(like, key)
        if not has_key(sample, key):
            return f"{key}: found no such key, expected {_describe(expected)}"
        if not _is_alike(value := get_value(sample, key), expected):
            return f"{key}: found {_describe(value)}, expected {_describe(expected)} as in other items"
    return None


def conform(sample: Mapping[str, Any], like: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Any]:
    """Sample -> copy with all keys of ``like``: zeros for missing ones, and for ``keys`` of another type or shape."""
    out = _fill(sample, like)
    stated = [key for key in keys if has_key(like, key)]
    off = [key for key in stated if not _is_alike(get_value(out, key), get_value(like, key))]
    return replace_values(out, {key: zeros_like(get_value(like, key)) for key in off})


def clear_non_finite(sample: Mapping[str, Any], keys: Iterable[str], rows: Tensor | None = None) -> dict[str, Any]:
    """Sample -> copy with zeros for values of ``keys`` that have a number which is not finite.

    ``rows`` (B,): of a batch, the samples to which this applies, each by itself; None = one sample.
    """
    cleared: dict[str, Any] = {}
    for key in keys:
        value = get_value(sample, key) if has_key(sample, key) else None
        if isinstance(value, np.ndarray) and value.dtype.kind == "f" and not np.isfinite(value).all():
            cleared[key] = np.zeros_like(value)
        elif isinstance(value, Tensor) and value.is_floating_point():
            is_off = ~value.detach().isfinite()
            off = is_off.any() if rows is None else is_off.flatten(1).any(1) & rows.to(value.device)
            if bool(off.any()):
                mask = off if rows is None else off.view(-1, *[1] * (value.ndim - 1))
                cleared[key] = value.masked_fill(mask, 0)
    return replace_values(sample, cleared)


def _fill(sample: Mapping[str, Any], like: Mapping[str, Any]) -> dict[str, Any]:
    """Copy of a sample with zeros for the keys that ``like`` has and it lacks, in nested dicts too."""
    out = dict(sample)
    for key, value in like.items():
        if key not in out:
            out[key] = zeros_like(value)
        elif isinstance(value, Mapping):
            out[key] = _fill(out[key] if isinstance(out[key], Mapping) else {}, value)
    return out


def _is_alike(value: Any, like: Any) -> bool:
    if isinstance(like, Tensor | np.ndarray):
        same_kind = isinstance(value, Tensor) == isinstance(like, Tensor)
        return same_kind and _dtype_and_shape(value) == _dtype_and_shape(like)
    if isinstance(like, list | tuple):
        same = type(value) is type(like) and len(value) == len(like)
        return same and all(map(_is_alike, value, like))
    return type(value) is type(like)


def _dtype_and_shape(value: Any) -> tuple[Any, tuple[int, ...]]:
    return getattr(value, "dtype", None), tuple(getattr(value, "shape", ()))


def _describe(value: Any) -> str:
    dtype, shape = _dtype_and_shape(value)
    return type(value).__name__ if dtype is None else f"{str(dtype).removeprefix('torch.')} of shape {shape}"
