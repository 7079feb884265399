"""Safe codec of pickled ``.npy`` files: numbers, strings, plain containers and numpy arrays only.

A pickle is a program for a stack machine whose instructions can call any function of the interpreter. This is a
separate machine for the same instructions: names in the file (``numpy.ndarray``) are never resolved but stay tokens,
and *call* accepts only the few tokens that rebuild arrays, implemented here. No code of the file can run, and sizes are
limited to the available bytes. Protocols 2 to 5, module paths of numpy 1 and 2.
"""

from __future__ import annotations

import gc
import re
import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

from dhtorch.data.codecs.npy import parse_npy_header
from dhtorch.data.io.decode import FormatError, read_bytes
from dhtorch.data.pickled_arrays import (
    PERMITTED_CALLS,
    PERMITTED_NAMES,
    SCALAR_TYPES,
    PendingArray,
    PermittedName,
    apply_state,
    array_from_bytes,
    check_scalar,
)
from dhtorch.runtime import safe_open

_MAX_INSTRUCTIONS: Final = 10_000_000  # instructions of one pickle
_MAX_NESTING: Final = 32  # containers inside containers

#: Upper bounds in bytes of a value's memory: on the stack, in its container, in the memo and in the returned copy.
_BYTES_PER_VALUE: Final = {set: 500, dict: 500, list: 250, tuple: 120, float: 40, int: 40, bool: 16, type(None): 16}
_BYTES_PER_OTHER_VALUE: Final = 100

_MARK = object()


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
        return array_from_bytes(dtype, shape, fortran, body)
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

    def since_mark(self) -> list[Any]:
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
        self.take_memory(_BYTES_PER_VALUE.get(type(value), _BYTES_PER_OTHER_VALUE))

    def remember(self, key: int) -> None:
        self.memo[key] = self.stack[-1]
        self.take_memory(_BYTES_PER_OTHER_VALUE)

    def recall(self, key: int) -> None:
        self.stack.append(self.memo[key])
        self.take_memory(_BYTES_PER_VALUE[bool])

    def take_memory(self, n: int) -> None:
        self.taken += n
        if self.taken > self.most:
            safe_open.check_memory(self.file, "pickle", self.taken, f"{self.steps} instructions", len(self.data))

    def top(self, kind: type) -> Any:
        if type(self.stack[-1]) is not kind:
            raise TypeError(f"{kind.__name__} expected on the stack")
        return self.stack[-1]

    def pop_n(self, n: int) -> tuple[Any, ...]:
        if len(self.stack) < n:
            raise IndexError("empty stack")
        items = tuple(self.stack[-n:])
        del self.stack[-n:]
        return items

    # ---------------------------------------------------------------------------------------------------- instructions

    def push_text(self, form: str) -> None:
        self.push(self.take(self.unpack(form)).decode("utf-8", "surrogatepass"))

    def extend(self, kind: type, items: Iterable[Any]) -> None:
        target = self.top(kind)
        (target.update if kind is set else target.extend)(items)

    def set_items(self, items: list[Any]) -> None:
        target = self.top(dict)
        if len(items) % 2:
            raise ValueError("a key without a value")
        for key, value in zip(items[::2], items[1::2], strict=True):
            target[check_scalar(key)] = value

    def integer(self, n: int) -> None:
        if not 0 <= n <= 16:
            raise ValueError(f"an integer of {n} bytes")
        self.push(int.from_bytes(self.take(n), "little", signed=True))

    def name(self, module: Any, attribute: Any) -> None:
        text = re.sub(r"^numpy\._core\b", "numpy.core", f"{module}.{attribute}")
        text = re.sub(r"^__builtin__\b", "builtins", text)
        if text not in PERMITTED_NAMES or type(module) is not str or type(attribute) is not str:
            raise FormatError(self.file, "pickle", f"the name {text}", "numpy arrays and plain containers only")
        self.push(PermittedName(text))

    def line(self) -> str:
        end = self.data.index(b"\n", self.at, self.at + 256)
        return self.take(end - self.at + 1)[:-1].decode()

    def call(self) -> None:
        function, args = self.pop_n(2)
        if type(function) is not PermittedName or type(args) is not tuple:
            raise TypeError("a call of a name that is not permitted")
        self.push(PERMITTED_CALLS[function](self.spend, *args))

    def build(self) -> None:
        target, state = self.pop_n(2)
        self.push(apply_state(self.spend, target, state))

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
        if kind in SCALAR_TYPES or kind is bytearray:
            return value
        if kind in (list, tuple, set):
            return kind(self._plain(item, depth + 1) for item in value)
        if kind is dict:
            return {key: self._plain(item, depth + 1) for key, item in value.items()}
        if kind is PendingArray and value.value is not None:
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
        "0": lambda m: m.pop_n(1),
        "1": lambda m: m.since_mark(),
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
        "X": lambda m: m.push_text("<I"),
        "\x8c": lambda m: m.push_text("<B"),
        "\x8d": lambda m: m.push_text("<Q"),
        "B": lambda m: m.push(m.take(m.unpack("<I"))),
        "C": lambda m: m.push(m.take(m.unpack("<B"))),
        "\x8e": lambda m: m.push(m.take(m.unpack("<Q"))),
        "\x96": lambda m: m.push(m.take(m.unpack("<Q"))),  # a byte array
        "]": lambda m: m.push([]),
        "}": lambda m: m.push({}),
        ")": lambda m: m.push(()),
        "\x8f": lambda m: m.push(set()),
        "l": lambda m: m.push(list(m.since_mark())),
        "t": lambda m: m.push(tuple(m.since_mark())),
        "\x85": lambda m: m.push(m.pop_n(1)),
        "\x86": lambda m: m.push(m.pop_n(2)),
        "\x87": lambda m: m.push(m.pop_n(3)),
        "a": lambda m: m.extend(list, m.pop_n(1)),
        "e": lambda m: m.extend(list, m.since_mark()),
        "\x90": lambda m: m.extend(set, map(check_scalar, m.since_mark())),
        "s": lambda m: m.set_items(list(m.pop_n(2))),
        "u": lambda m: m.set_items(m.since_mark()),
        "q": lambda m: m.remember(m.unpack("<B")),
        "r": lambda m: m.remember(m.unpack("<I")),
        "\x94": lambda m: m.remember(len(m.memo)),
        "h": lambda m: m.recall(m.unpack("<B")),
        "j": lambda m: m.recall(m.unpack("<I")),
        "c": lambda m: m.name(m.line(), m.line()),
        "\x93": lambda m: m.name(*m.pop_n(2)),
        "R": _Unpickler.call,
        "b": _Unpickler.build,
    }.items()
}
