"""Safe codec of pickled ``.npy`` files: numbers, strings, plain containers and numpy arrays only.

A pickle is a program for a stack machine whose instructions can call any function of the interpreter. This is a
separate machine for the same instructions: names in the file (``numpy.ndarray``) are never resolved but stay tokens,
and *call* accepts only the few tokens that rebuild arrays, implemented here. No code of the file can run, and sizes are
limited to the available bytes. Protocols 2 to 5, module paths of numpy 1 and 2.
"""

import gc
import math
import re
import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

from dhtorch.data.codecs.npy import parse_npy_header
from dhtorch.data.io.decode import FormatError, read_bytes
from dhtorch.runtime import safe_open

_MAX_INSTRUCTIONS: Final = 10_000_000  # instructions of one pickle
_MAX_NESTING: Final = 32  # containers inside containers

#: Upper bounds in bytes of a value's memory: on the stack, in its container, in the memo and in the returned copy.
_BYTES_PER_VALUE: Final = {set: 500, dict: 500, list: 250, tuple: 120, float: 40, int: 40, bool: 16, type(None): 16}
_BYTES_PER_OTHER_VALUE: Final = 100

_MARK = object()

# ------------------------------------------------------------------------------------------- what a pickle may call
#
# An array is created in steps: an empty array, an element type, then the state with the array's bytes; numpy's own
# unpickling is not used. ``spend(n)`` is called before ``n`` bytes are created; it raises when a file creates more
# bytes than a file of its size can hold.

_SCALAR_TYPES: Final = (str, int, float, bool, bytes, type(None))

_DTYPE_PATTERN = re.compile(r"[<>|=]?(?:b1|[iu][1248]|f[248]|[SU]\d{1,4}|O8?)")
_ARRAY_NAME: Final = "numpy.ndarray"
_SpendBytes = Callable[[int], None]


class _PermittedName(str):
    """Token of a permitted name; it is never resolved."""


class _PendingDtype:
    """Element type under construction: code such as ``f8`` and byte order."""

    def __init__(self, code: str) -> None:
        self.code, self.order = code, "="


class _PendingArray:
    """An array under construction, empty until its state is set."""

    value: np.ndarray | list[Any] | None = None
    shape: tuple[int, ...] = ()


def _array_from_bytes(dtype: np.dtype, shape: tuple[int, ...], fortran: bool, raw: bytes) -> np.ndarray:
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


def _check_scalar(value: Any) -> Any:
    """``value``, checked to be a scalar as key of a dict or member of a set (hashes of others may be expensive).

    Raises:
        TypeError: any other value.
    """
    if type(value) not in _SCALAR_TYPES or (type(value) is int and abs(value) >= 1 << 63):
        raise TypeError(f"a key of type {type(value).__name__}")
    return value


def _fill_array(
    spend: _SpendBytes, target: _PendingArray, shape: Any, dtype: Any, fortran: Any, raw: Any
) -> _PendingArray:
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
        target.value = _array_from_bytes(np.dtype(dtype.order + dtype.code.lstrip("<>|=")), shape, fortran, bytes(raw))
    return target


def _new_dtype(_spend: _SpendBytes, code: Any, *_flags: Any) -> _PendingDtype:
    if type(code) is not str or not _DTYPE_PATTERN.fullmatch(code):
        raise ValueError("an element type other than number, string or object")
    return _PendingDtype(code)


def _new_array(_spend: _SpendBytes, kind: Any, _shape: Any, _code: Any) -> _PendingArray:
    if kind != _ARRAY_NAME or type(kind) is not _PermittedName:
        raise TypeError("an array of another class")
    return _PendingArray()


def _new_scalar(spend: _SpendBytes, dtype: Any, raw: Any) -> Any:
    array = _fill_array(spend, _PendingArray(), (), dtype, False, raw).value
    if not isinstance(array, np.ndarray):
        raise TypeError("a scalar of objects")
    return array.item()


def _from_buffer(spend: _SpendBytes, raw: Any, dtype: Any, shape: Any, order: Any) -> _PendingArray:
    return _fill_array(spend, _PendingArray(), shape, dtype, order == "F", raw)


def _encode(spend: _SpendBytes, text: Any, encoding: Any) -> bytes:
    if type(text) is not str or encoding != "latin1":
        raise TypeError("an encoding other than latin1")
    spend(len(text))
    return text.encode("latin-1")


def _new_set(_spend: _SpendBytes, items: Any = ()) -> set[Any]:
    if type(items) not in (list, tuple):
        raise TypeError("a set that is not made from a list")
    return set(map(_check_scalar, items))


#: Name of a permitted function → its implementation.
_PERMITTED_CALLS: Final[dict[str, Callable[..., Any]]] = {
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
_PERMITTED_NAMES: Final = {*_PERMITTED_CALLS, _ARRAY_NAME}


# ------------------------------------------------------------------------------------------------------- the machine


def read_npy(file: Path) -> Any:
    """The content of a ``.npy`` file: an array of numbers, or the pickled object in it.

    A 0-d object array, as ``np.save`` makes of a dict, gives the object itself; a 1-d one gives a list.

    Returns:
        Arrays (native byte order, read-only), dict, list, tuple, set, str, bytes, int, float, bool, None.

    Raises:
        FormatError: missing or damaged file, or a pickle with any other content or call.
    """
    data = read_bytes(file, 128_000_000)
    shape, fortran, dtype, start = parse_npy_header(file, "header", data)
    body = data[start:]
    if dtype.hasobject:
        return load_pickle(body, file)
    try:
        return _array_from_bytes(dtype, shape, fortran, body)
    except (ValueError, TypeError, OverflowError) as error:
        raise FormatError(file, "data", error, f"numbers of type {dtype}") from None


def load_pickle(data: bytes, file: Path) -> Any:
    """Pickle of plain data → its object; ``file`` names it in errors.

    Raises:
        FormatError: not plain data, too large, nested too deep, or truncated.
    """
    gc_was_enabled = gc.isenabled()
    gc.disable()  # no cycles can arise, and the collector's repeated passes would dominate the time
    try:
        return _Unpickler(data, file).run()
    except FormatError:
        raise
    except (IndexError, KeyError, TypeError, ValueError, AttributeError, OverflowError, struct.error) as error:
        problem = f"{type(error).__name__} {error}"
        raise FormatError(file, "pickle", problem, "a whole pickle of arrays and plain containers") from None
    finally:
        if gc_was_enabled:
            gc.enable()


class _Unpickler:
    """Stack machine for one pickle: stack, memo, and instructions by the table ``_INSTRUCTIONS``."""

    def __init__(self, data: bytes, file: Path) -> None:
        self.data, self.file, self.at = data, file, 0
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}
        self.steps = self.nodes = 0
        self.taken = 0  # memory of Python objects in bytes
        self.most = max(safe_open.MAX_MEMORY_BYTES, safe_open.MAX_MEMORY_RATIO * len(data))
        self.budget = 4 * len(data) + 4096  # bytes that calls may still create: shared values could multiply

    def run(self) -> Any:
        while True:
            self.steps += 1
            if self.steps > _MAX_INSTRUCTIONS:
                raise FormatError(self.file, "pickle", f"more than {_MAX_INSTRUCTIONS} instructions", "fewer")
            code = self.data[self.at]
            self.at += 1
            if code == 0x2E:  # STOP
                return self._plain(self.stack.pop(), 0)
            step = _INSTRUCTIONS.get(code)
            if step is None:
                raise FormatError(
                    self.file, "pickle", f"instruction {bytes([code])!r}", "an instruction for plain data"
                )
            step(self)

    # ------------------------------------------------------------------------------------------------- bytes and stack

    def take(self, n: int) -> bytes:
        end = self.at + n
        if n < 0 or end > len(self.data):
            raise ValueError(f"{n} bytes expected, {len(self.data) - self.at} left")
        content, self.at = self.data[self.at : end], end
        return content

    def unpack(self, form: str) -> Any:
        return struct.unpack(form, self.take(struct.calcsize(form)))[0]

    def _since_mark(self) -> list[Any]:
        at = len(self.stack) - 1
        while self.stack[at] is not _MARK:
            at -= 1
            if at < 0:
                raise ValueError("no mark on the stack")
        items = self.stack[at + 1 :]
        del self.stack[at:]
        return items

    def push(self, value: Any) -> None:
        self.stack.append(value)
        self._take_memory(_BYTES_PER_VALUE.get(type(value), _BYTES_PER_OTHER_VALUE))

    def _remember(self, key: int) -> None:
        self.memo[key] = self.stack[-1]
        self._take_memory(_BYTES_PER_OTHER_VALUE)

    def _recall(self, key: int) -> None:
        self.stack.append(self.memo[key])
        self._take_memory(_BYTES_PER_VALUE[bool])

    def _take_memory(self, n: int) -> None:
        self.taken += n
        if self.taken > self.most:
            safe_open.check_memory(self.file, "pickle", self.taken, f"{self.steps} instructions", len(self.data))

    def top(self, kind: type) -> Any:
        if type(self.stack[-1]) is not kind:
            raise TypeError(f"{kind.__name__} expected on the stack")
        return self.stack[-1]

    def _pop_n(self, n: int) -> tuple[Any, ...]:
        if len(self.stack) < n:
            raise IndexError("empty stack")
        items = tuple(self.stack[-n:])
        del self.stack[-n:]
        return items

    # ---------------------------------------------------------------------------------------------------- instructions

    def _push_text(self, form: str) -> None:
        self.push(self.take(self.unpack(form)).decode("utf-8", "surrogatepass"))

    def extend(self, kind: type, items: Iterable[Any]) -> None:
        target = self.top(kind)
        (target.update if kind is set else target.extend)(items)

    def _set_items(self, items: list[Any]) -> None:
        target = self.top(dict)
        if len(items) % 2:
            raise ValueError("a key without a value")
        for key, value in zip(items[::2], items[1::2], strict=True):
            target[_check_scalar(key)] = value

    def integer(self, n: int) -> None:
        if not 0 <= n <= 16:
            raise ValueError(f"an integer of {n} bytes")
        self.push(int.from_bytes(self.take(n), "little", signed=True))

    def name(self, module: Any, attribute: Any) -> None:
        text = re.sub(r"^numpy\._core\b", "numpy.core", f"{module}.{attribute}")
        text = re.sub(r"^__builtin__\b", "builtins", text)
        if text not in _PERMITTED_NAMES or type(module) is not str or type(attribute) is not str:
            raise FormatError(self.file, "pickle", f"the name {text}", "numpy arrays and plain containers only")
        self.push(_PermittedName(text))

    def line(self) -> str:
        end = self.data.index(b"\n", self.at, self.at + 256)
        return self.take(end - self.at + 1)[:-1].decode()

    def call(self) -> None:
        function, args = self._pop_n(2)
        if type(function) is not _PermittedName or type(args) is not tuple:
            raise TypeError("a call of a name that is not permitted")
        self.push(_PERMITTED_CALLS[function](self.spend, *args))

    def build(self) -> None:
        target, state = self._pop_n(2)
        if type(target) is _PendingDtype:
            _, order, subarray, names = state[:4]
            if order not in ("<", ">", "|", "=") or subarray is not None or names is not None:
                raise ValueError("a structured element type")
            target.order = order
        elif type(target) is _PendingArray:
            _, shape, dtype, fortran, raw = state
            _fill_array(self.spend, target, shape, dtype, fortran, raw)
        else:
            raise TypeError("state of an object that is no array or element type")
        self.push(target)

    def spend(self, n: int) -> None:
        self.budget -= n
        if self.budget < 0:
            raise FormatError(self.file, "pickle", "arrays larger than the file", "as many bytes as it has")

    # ---------------------------------------------------------------------------------------------------------- result

    def _plain(self, value: Any, depth: int) -> Any:
        """The result: pending arrays replaced by arrays, every container copied.

        Raises for containers that contain themselves (too deep) or that share parts repeatedly, such as each list ten
        times in the next (more nodes than the file has instructions).
        """
        self.nodes += 1
        if depth > _MAX_NESTING or self.nodes > 8 * self.steps + 64:
            raise FormatError(self.file, "pickle", "containers nested too deep", f"at most {_MAX_NESTING} deep")
        kind = type(value)
        if kind in _SCALAR_TYPES or kind is bytearray:
            return value
        if kind in (list, tuple, set):
            return kind(self._plain(item, depth + 1) for item in value)
        if kind is dict:
            return {key: self._plain(item, depth + 1) for key, item in value.items()}
        if kind is _PendingArray and value.value is not None:
            if isinstance(value.value, np.ndarray):
                return value.value
            items = [self._plain(item, depth + 1) for item in value.value]
            return items if value.shape else items[0]
        raise TypeError(f"a bare {kind.__name__} is no data")


_INSTRUCTIONS: Final[dict[int, Callable[[_Unpickler], Any]]] = {
    ord(code): step
    for code, step in {
        "\x80": lambda m: m.take(1),  # PROTO: the version is ignored, unknown instructions raise
        "\x95": lambda m: m.take(8),  # FRAME
        "(": lambda m: m.push(_MARK),
        "0": lambda m: m._pop_n(1),
        "1": lambda m: m._since_mark(),
        "2": lambda m: m.push(m.stack[-1]),
        "N": lambda m: m.push(None),
        "\x88": lambda m: m.push(True),
        "\x89": lambda m: m.push(False),
        "J": lambda m: m.push(m.unpack("<i")),
        "K": lambda m: m.push(m.unpack("<B")),
        "M": lambda m: m.push(m.unpack("<H")),
        "G": lambda m: m.push(m.unpack(">d")),
        "\x8a": lambda m: m.integer(m.unpack("<B")),
        "\x8b": lambda m: m.integer(m.unpack("<i")),
        "X": lambda m: m._push_text("<I"),
        "\x8c": lambda m: m._push_text("<B"),
        "\x8d": lambda m: m._push_text("<Q"),
        "B": lambda m: m.push(m.take(m.unpack("<I"))),
        "C": lambda m: m.push(m.take(m.unpack("<B"))),
        "\x8e": lambda m: m.push(m.take(m.unpack("<Q"))),
        "\x96": lambda m: m.push(m.take(m.unpack("<Q"))),  # a byte array
        "]": lambda m: m.push([]),
        "}": lambda m: m.push({}),
        ")": lambda m: m.push(()),
        "\x8f": lambda m: m.push(set()),
        "l": lambda m: m.push(list(m._since_mark())),
        "t": lambda m: m.push(tuple(m._since_mark())),
        "\x85": lambda m: m.push(m._pop_n(1)),
        "\x86": lambda m: m.push(m._pop_n(2)),
        "\x87": lambda m: m.push(m._pop_n(3)),
        "a": lambda m: m.extend(list, m._pop_n(1)),
        "e": lambda m: m.extend(list, m._since_mark()),
        "\x90": lambda m: m.extend(set, map(_check_scalar, m._since_mark())),
        "s": lambda m: m._set_items(list(m._pop_n(2))),
        "u": lambda m: m._set_items(m._since_mark()),
        "q": lambda m: m._remember(m.unpack("<B")),
        "r": lambda m: m._remember(m.unpack("<I")),
        "\x94": lambda m: m._remember(len(m.memo)),
        "h": lambda m: m._recall(m.unpack("<B")),
        "j": lambda m: m._recall(m.unpack("<I")),
        "c": lambda m: m.name(m.line(), m.line()),
        "\x93": lambda m: m.name(*m._pop_n(2)),
        "R": _Unpickler.call,
        "b": _Unpickler.build,
    }.items()
}
