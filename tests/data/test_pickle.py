"""Pickled .npy files: plain data comes back as it was, anything else is refused and nothing in it runs."""

import pickle
import pickletools
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.pickled_values import plain_values

from dhtorch.data.codecs import pickles
from dhtorch.data.io.decode import FormatError

FILE = Path("some.npy")
FLAG: list[str] = []


def same(a: Any, b: Any) -> bool:
    if isinstance(b, np.ndarray) and b.dtype.hasobject:
        return isinstance(a, list) and same(a, list(b))
    if isinstance(b, np.ndarray):
        return isinstance(a, np.ndarray) and a.dtype == b.dtype.newbyteorder("=") and np.array_equal(a, b)
    if isinstance(b, np.generic):
        return type(a) is type(b.item()) and a == b.item()
    if isinstance(b, dict):
        return type(a) is dict and a.keys() == b.keys() and all(same(a[k], b[k]) for k in b)
    if isinstance(b, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return type(a) is type(b) and a == b


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_plain_data_comes_back(protocol: int) -> None:
    content = pickle.dumps(plain_values(), protocol)
    assert same(pickles.load_pickle(content, FILE), plain_values())
    old = content.replace(b"numpy._core.", b"numpy.core.") if protocol < 4 else None  # as numpy 1 wrote it
    assert old is None or same(pickles.load_pickle(old, FILE), plain_values())


SHARED = [1, 2, 3]
#: Content of a ``.npy`` file, and what is read of it where that differs.
CONTENT: list[tuple[Any, Any]] = [
    ({"a": np.arange(3)}, None),
    (np.arange(6.0).reshape(2, 3), None),
    (np.asfortranarray(np.eye(3)), None),
    (np.arange(3, dtype=">u2"), None),
    (np.array([{"a": 1}, 2], dtype=object), [{"a": 1}, 2]),
    ({"color": SHARED, "depth": SHARED}, None),  # two names for one list stay equal
    ({str(s): [{"tcp": np.arange(7.0) + i, "robot_ft": np.zeros(6), "timestamp": i} for i in range(600)] for s in range(10)}, None),
]  # fmt: skip


@pytest.mark.parametrize(("content", "expected"), CONTENT)
def test_npy_files(tmp_path: Path, content: Any, expected: Any) -> None:
    np.save(tmp_path / "x.npy", content, allow_pickle=True)
    assert same(pickles.read_npy(tmp_path / "x.npy"), content if expected is None else expected)


# ------------------------------------------------------------------------------------------------------ code in a file


class Bomb:
    def __init__(self, function: Callable[..., Any], *args: Any) -> None:
        self.call = function, args

    def __reduce__(self) -> tuple[Any, ...]:
        return self.call


def ring(text: str = "") -> None:
    FLAG.append(text)


class Setter:
    """Its state would be set by a method of its class."""

    def __setstate__(self, state: object) -> None:
        ring("setstate")

    def __getstate__(self) -> object:
        return {"x": 1}


def _op(text: str) -> bytes:
    return b"\x8c" + bytes([len(text)]) + text.encode()


def _global(module: str, name: str) -> bytes:
    return _op(module) + _op(name) + b"\x93"


ATTACKS: dict[str, bytes] = {
    "os.system": pickle.dumps(Bomb(__import__("os").system, "touch pwned")),
    "os.system, protocol 0": b"cos\nsystem\n(S'touch pwned'\ntR.",
    "os.system, protocol 2": pickle.dumps(Bomb(__import__("os").system, "touch pwned"), 2),
    "eval": pickle.dumps(Bomb(eval, "ring()")),
    "exec": pickle.dumps(Bomb(exec, "ring()")),
    "getattr": pickle.dumps(Bomb(getattr, np.arange(3), "tolist")),
    "import": pickle.dumps(Bomb(__import__, "os")),
    "own function": pickle.dumps(Bomb(ring, "reduce")),
    "function inside an array of objects": pickle.dumps(np.array([Bomb(ring, "array")], dtype=object)),
    "function as a key": pickle.dumps({"a": [Bomb(ring, "deep")]}),
    "class": pickle.dumps(Setter()),
    "class with slots, protocol 2": pickle.dumps(Setter(), 2),
    "dotted path from numpy": b"\x80\x04" + _global("numpy", "core.multiarray.os.system") + _op("x") + b"\x85R.",
    "attribute of a permitted module": b"\x80\x04" + _global("numpy", "load") + _op("x") + b"\x85R.",
    "permitted module, other name": b"\x80\x04" + _global("numpy.core.multiarray", "fromfile") + b"N\x85R.",
    "codecs by another door": b"\x80\x04" + _global("_codecs", "decode") + b"C\x01a" + _op("zip") + b"\x86R.",
    "codecs with a transform": b"\x80\x04" + _global("_codecs", "encode") + _op("a") + _op("rot13") + b"\x86R.",
    "dtype as a function": b"\x80\x04" + _global("numpy", "dtype") + b"N\x85R.",
    "dtype of objects": b"\x80\x04" + _global("numpy.core.multiarray", "scalar") + _global("numpy", "dtype") + _op("O8") + b"\x89\x88\x87R" + b"C\x08" + bytes(8) + b"\x86R.",
    "subclass of an array": b"\x80\x04" + _global("numpy.core.multiarray", "_reconstruct") + _global("numpy", "dtype") + b"K\x00\x85C\x01b\x87R.",
    "extension registry": b"\x80\x02\x82\x01.",
    "persistent id": b"\x80\x02" + b"Pname\n.",
    "binary persistent id": b"\x80\x02K\x01Q.",
    "instance": b"(ios\nsystem\n.",
    "new object": b"\x80\x02" + b"cbuiltins\nset\n)\x81.",
    "buffers from outside": b"\x80\x05\x97.",
    "a bare name": b"\x80\x02cnumpy\nndarray\n.",
    "an array without its state": b"\x80\x04" + _global("numpy.core.multiarray", "_reconstruct") + _global("numpy", "ndarray") + b"K\x00\x85C\x01b\x87R.",
    "state for a dict": b"\x80\x02}}b.",
}  # fmt: skip


@pytest.mark.parametrize("name", ATTACKS)
def test_nothing_in_a_file_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    FLAG.clear()
    with pytest.raises(FormatError, match=r"some.npy: pickle: found") as error:
        pickles.load_pickle(ATTACKS[name], FILE)
    assert FLAG == [] and list(tmp_path.iterdir()) == [] and "\n" not in str(error.value)


# ---------------------------------------------------------------------------------------------------- size and nesting


def array_of(shape: tuple[int, ...], raw: bytes, code: str = "f8") -> bytes:
    numbers = b"".join(b"\x8a\x08" + struct.pack("<q", n) for n in shape)
    dtype = _global("numpy", "dtype") + _op(code) + b"\x89\x88\x87R"
    shell = _global("numpy.core.multiarray", "_reconstruct") + _global("numpy", "ndarray") + b"K\x00\x85C\x01b\x87R"
    return (
        b"\x80\x04"
        + shell
        + b"(K\x01("
        + numbers
        + b"t"
        + dtype
        + b"\x89B"
        + struct.pack("<I", len(raw))
        + raw
        + b"tb."
    )


HUGE: dict[str, bytes] = {
    "array of 2**40 numbers": array_of((2**40,), bytes(8)),
    "array of 2**62 rows of nothing": array_of((2**62, 0), b""),
    "negative size": array_of((-1, -1), bytes(8)),
    "product beyond 64 bits": array_of((2**32, 2**32), bytes(8)),
    "text element of 9999 characters": array_of((2**20,), bytes(8), "U9999"),
    "unicode of 4 GB": b"\x80\x04X\xff\xff\xff\xffa.",
    "bytes of 2**63": b"\x80\x04\x8e" + struct.pack("<Q", 2**63) + b"a.",
    "byte array of 2**40": b"\x80\x05\x96" + struct.pack("<Q", 2**40) + b"a.",
    "integer of 2 GB": b"\x80\x02\x8b\xff\xff\xff\x7fa.",
    "integer of many digits": b"\x80\x02\x8a\xff" + b"\x7f" * 255 + b".",
    "list in itself": b"\x80\x02]q\x00h\x00a.",
    "deep list": b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b".",
    "deep tuple as a key": b"\x80\x02}" + b")" + b"\x85" * 100_000 + b"K\x01s.",
    "a billion laughs": b"\x80\x02(lq\x00" + b"".join(b"0(" + b"h" + bytes([i]) + (b"h" + bytes([i])) * 9 + b"lq" + bytes([i + 1]) for i in range(12)) + b".",
    "one array a million times": b"",  # filled in below
    "keys that collide": b"\x80\x02}(" + b"".join(b"\x8a\x10" + (i * (2**61 - 1)).to_bytes(16, "little") + b"N" for i in range(1, 20_000)) + b"u.",
    "mark without end": b"\x80\x02" + b"t.",
    "nothing": b"",
    "no stop": b"\x80\x02K\x01",
}  # fmt: skip
_shared = (
    b"\x80\x04" + _global("_codecs", "encode") + b"q\x00X" + struct.pack("<I", 10_000) + b"a" * 10_000 + _op("latin1")
)
HUGE["one array a million times"] = _shared + b"\x86q\x01" + b"h\x00h\x01R" * 20_000 + b"."


@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", HUGE)
def test_sizes_are_not_believed(name: str) -> None:
    """What is refused never takes more memory than some copies of the file."""
    tracemalloc.start()
    try:
        with pytest.raises(FormatError, match=r"some.npy: pickle: found"):
            pickles.load_pickle(HUGE[name], FILE)
        assert tracemalloc.get_traced_memory()[1] < 64 << 20
    finally:
        tracemalloc.stop()


def test_a_memo_of_any_number_costs_one_entry() -> None:
    """Python's own reader makes room for twice the number: 64 GB."""
    assert pickles.load_pickle(b"\x80\x02K\x01r\xff\xff\xff\xff0j\xff\xff\xff\xff.", FILE) == 1


def test_damaged_headers(tmp_path: Path) -> None:
    file = tmp_path / "x.npy"
    np.save(file, np.arange(4.0))
    good = file.read_bytes()
    for bad in (
        b"",
        good[:5],
        good[:50],
        good[:-1],
        good + b"x",
        good.replace(b"(4,)", b"(5,)"),
        good.replace(b"(4,)", b"4**9"),
        good.replace(b"(4,)", b"(-4,"),
        good.replace(b"'<f8'", b"'|O'\x20"),
        good.replace(b"'<f8'", b"'<V8'"),
        good.replace(b"'<f8'", b"'<M8'"),
    ):
        file.write_bytes(bad)
        with pytest.raises(FormatError, match=r"x.npy: (header|data|pickle|file)"):
            pickles.read_npy(file)


HEADERS = [
    "",
    "()",
    "{}",
    "[" * 5000,
    "(" * 9000 + ")" * 9000,
    "-" * 9000 + "1",
    "'" + "x" * 100,
    "'" * 3,
    "{'descr': (), 'fortran_order': False, 'shape': (4,)}",  # numpy's parser: IndexError
    "{'descr': [], 'fortran_order': False, 'shape': (4,)}",
    "{'descr': [()], 'fortran_order': False, 'shape': (4,)}",
    "{'descr': ['<f8'], 'fortran_order': False, 'shape': (4,)}",
    "{'descr': '<f99999999999999999999', 'fortran_order': False, 'shape': (4,)}",
    f"{{'descr': [('a', '<f8', ({2**70},))], 'fortran_order': False, 'shape': (4,)}}",
    f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({2**70},)}}",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (4, -1)}",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (True,)}",
    "{'descr': '<f8', 'fortran_order': 'no', 'shape': (4,)}",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (4L,)}",  # as Python 2 wrote it: four, and there are three
    "{'descr': '<f8', 'fortran_order': False, 'shape': (4L,",
    "{[]: 1}",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (4,)} + 1",
    "__import__('os')._exit(86)",
    "\x00",
    "\\",
    "é",
]


@pytest.mark.parametrize("version", [1, 2, 3, 9])
def test_no_header_raises_anything_else(tmp_path: Path, version: int) -> None:
    for text in HEADERS:
        head = text.encode() + b"\n"
        size = struct.pack("<H" if version == 1 else "<I", len(head))
        (tmp_path / "x.npy").write_bytes(b"\x93NUMPY" + bytes([version, 0]) + size + head + bytes(24))
        with pytest.raises(FormatError, match=r"x.npy: (header|header shape|data): found ") as caught:
            pickles.read_npy(tmp_path / "x.npy")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("inner", [11, 15, 22, 30, 37])
def test_containers_that_share_parts_have_at_most_eight_values_per_instruction_and_64(inner: int) -> None:
    """A list of numbers that stands in another one several times, at two bytes each time."""
    accepted = set()
    for times in range(1, 56):
        content = b"\x80\x02](]q\x01(" + inner * b"K\x01" + b"e" + (times - 1) * b"h\x01" + b"e."
        n_values, n_instructions = 1 + times * (inner + 1), len(list(pickletools.genops(content)))
        accepted.add(within := n_values <= 8 * n_instructions + 64)
        if within:
            assert pickles.load_pickle(content, FILE) == times * [inner * [1]]
        else:
            with pytest.raises(FormatError, match="containers nested too deep"):
                pickles.load_pickle(content, FILE)
    assert accepted == {True, False}
