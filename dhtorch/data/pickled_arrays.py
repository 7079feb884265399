"""Functions that a pickle may call, implemented here: arrays and other plain data, rebuilt from their parts.

A pickle creates an array in steps: an empty array, an element type, then the state with the array's bytes. numpy's own
unpickling is not used. ``spend(n)`` is called before ``n`` bytes are created; it raises when a file creates more bytes
than a file of its size can hold.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, Final

import numpy as np

SCALAR_TYPES: Final = (str, int, float, bool, bytes, type(None))

_DTYPE_PATTERN = re.compile(r"[<>|=]?(?:b1|[iu][1248]|f[248]|[SU]\d{1,4}|O8?)")
_ARRAY_NAME: Final = "numpy.ndarray"
_SpendBytes = Callable[[int], None]


class PermittedName(str):
    """Token of a permitted name; it is never resolved."""


class _PendingDtype:
    """Element type under construction: code such as ``f8`` and byte order."""

    def __init__(self, code: str) -> None:
        self.code, self.order = code, "="


class PendingArray:
    """An array under construction, empty until its state is set."""

    value: np.ndarray | list[Any] | None = None
    shape: tuple[int, ...] = ()


def apply_state(spend: _SpendBytes, target: Any, state: Any) -> Any:
    """Set the state of ``target``, an array or an element type under construction, and return it.

    Raises:
        ValueError, TypeError: another target, or an invalid state.
    """
    if type(target) is _PendingDtype:
        _, order, subarray, names = state[:4]
        if order not in ("<", ">", "|", "=") or subarray is not None or names is not None:
            raise ValueError("a structured element type")
        target.order = order
    elif type(target) is PendingArray:
        _, shape, dtype, fortran, raw = state
        _fill_array(spend, target, shape, dtype, fortran, raw)
    else:
        raise TypeError("state of an object that is no array or element type")
    return target


def array_from_bytes(dtype: np.dtype, shape: tuple[int, ...], fortran: bool, raw: bytes) -> np.ndarray:
    """Raw bytes → array, after checking that its shape matches the number of bytes.

    Raises:
        ValueError: not plain numbers or strings, or a shape that does not match the bytes.
    """
    if dtype.kind not in "biufSU" or dtype.itemsize == 0 or dtype.names or dtype.subdtype:
        raise ValueError(f"array of {dtype}")
    # With a zero in the shape any other length matches 0 bytes, and loops over that axis would not end: limit it.
    if len(shape) > 8 or any(type(n) is not int or not 0 <= n <= max(len(raw), 4096) for n in shape):
        raise ValueError(f"array shape {shape}")
    if math.prod(shape) * dtype.itemsize != len(raw):
        raise ValueError(f"{len(raw)} bytes for an array of {shape}")
    array = np.frombuffer(raw, dtype).reshape(shape, order="F" if fortran else "C")
    return array if dtype.isnative else array.astype(dtype.newbyteorder("="))


def check_scalar(value: Any) -> Any:
    """``value``, checked to be a scalar as key of a dict or member of a set (hashes of others may be expensive).

    Raises:
        TypeError: any other value.
    """
    if type(value) not in SCALAR_TYPES or (type(value) is int and abs(value) >= 1 << 63):
        raise TypeError(f"a key of type {type(value).__name__}")
    return value


def _fill_array(
    spend: _SpendBytes, target: PendingArray, shape: Any, dtype: Any, fortran: Any, raw: Any
) -> PendingArray:
    if target.value is not None or type(dtype) is not _PendingDtype or type(shape) is not tuple:
        raise TypeError("an array with an invalid state")
    if dtype.code.lstrip("<>|=").startswith("O"):
        if type(raw) is not list or len(shape) > 1 or len(raw) != math.prod(shape):
            raise ValueError(f"an object array of shape {shape}")
        target.value, target.shape = raw, shape
    else:
        if not isinstance(raw, bytes | bytearray) or type(fortran) is not bool:
            raise TypeError("an array without bytes")
        spend(len(raw))
        target.value = array_from_bytes(np.dtype(dtype.order + dtype.code.lstrip("<>|=")), shape, fortran, bytes(raw))
    return target


def _new_dtype(_spend: _SpendBytes, code: Any, *_flags: Any) -> _PendingDtype:
    if type(code) is not str or not _DTYPE_PATTERN.fullmatch(code):
        raise ValueError("an element type other than number, string or object")
    return _PendingDtype(code)


def _new_array(_spend: _SpendBytes, kind: Any, _shape: Any, _code: Any) -> PendingArray:
    if kind != _ARRAY_NAME or type(kind) is not PermittedName:
        raise TypeError("an array of another class")
    return PendingArray()


def _new_scalar(spend: _SpendBytes, dtype: Any, raw: Any) -> Any:
    array = _fill_array(spend, PendingArray(), (), dtype, False, raw).value
    if not isinstance(array, np.ndarray):
        raise TypeError("a scalar of objects")
    return array.item()


def _from_buffer(spend: _SpendBytes, raw: Any, dtype: Any, shape: Any, order: Any) -> PendingArray:
    return _fill_array(spend, PendingArray(), shape, dtype, order == "F", raw)


def _encode(spend: _SpendBytes, text: Any, encoding: Any) -> bytes:
    if type(text) is not str or encoding != "latin1":
        raise TypeError("an encoding other than latin1")
    spend(len(text))
    return text.encode("latin-1")


def _new_set(_spend: _SpendBytes, items: Any = ()) -> set[Any]:
    if type(items) not in (list, tuple):
        raise TypeError("a set that is not made from a list")
    return set(map(check_scalar, items))


#: Name of a permitted function → its implementation.
PERMITTED_CALLS: Final[dict[str, Callable[..., Any]]] = {
    "numpy.dtype": _new_dtype,
    "numpy.core.multiarray._reconstruct": _new_array,
    "numpy.core.multiarray.scalar": _new_scalar,
    "numpy.core.numeric._frombuffer": _from_buffer,
    "_codecs.encode": _encode,  # bytes in protocol 2
    "collections.OrderedDict": lambda _spend: {},
    "builtins.bytes": lambda _spend: b"",
    "builtins.set": _new_set,  # sets in protocols 2 and 3
}

#: Names permitted in a pickle; ``numpy._core`` of numpy 2 is mapped to ``numpy.core``, ``__builtin__`` of Python 2 to
#: ``builtins``.
PERMITTED_NAMES: Final = {*PERMITTED_CALLS, _ARRAY_NAME}
