"""Random damage with valid check sums: a file is decoded, one field of it changed, and encoded again.

``byte_damage`` changes bytes; here the library of a format, or knowledge of its fields, writes the damaged file, and
readers decode it. Every choice is drawn from the given generator.
"""

import io
import random
import struct
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np

from support import byte_damage as mutations

#: Numbers to replace a count, a size or an offset.
ODD = (0, 1, 2, 7, 255, 256, 65_535, 65_536, 10**6, 50_000_000, 2**31 - 1, 2**31, 2**32 - 1)

_BOXES = (b"stsz", b"stts", b"ctts", b"stsc", b"stco", b"stss", b"elst", b"tkhd", b"mdhd", b"avc1", b"hdlr", b"trak")


def recode(good: mutations.Capture, draw: random.Random) -> tuple[str, mutations.Capture]:
    """(description, damaged capture); files of an unknown format get damaged bytes."""
    want = dict(good)
    name = mutations._victim(want, draw)
    content = want[name]
    assert content is not None
    for knows, way in _WAYS:
        if knows(content):
            try:
                want[name] = way(content, draw)
            except Exception as error:  # a library that refuses to write such a file: the damage is lost, not the case
                return f"{name}: {way.__name__.strip('_')}: {type(error).__name__}", want
            return f"{name}: {way.__name__.strip('_')}", want
    return mutations.mutate(good, draw)


def _mp4(content: bytes, draw: random.Random) -> bytes:
    """A number in a box of the index."""
    raw = bytearray(content)
    places = [at for kind in _BOXES if (at := content.find(kind)) >= 4]
    if not places:
        return content
    at = draw.choice(places) + draw.choice((-4, 8, 12, 16, 20, 24))
    if at + 4 <= len(raw):
        raw[at : at + 4] = struct.pack(">I", draw.choice(ODD))
    return bytes(raw)


def _tiff(content: bytes, draw: random.Random) -> bytes:
    """Type, count or value of a tag."""
    raw = bytearray(content)
    order = "<" if content[:2] == b"II" else ">"
    (at,) = struct.unpack_from(f"{order}I", content, 4)
    (count,) = struct.unpack_from(f"{order}H", content, at)
    tag = at + 2 + 12 * draw.randrange(max(1, count))
    form, place = draw.choice((("H", 0), ("H", 2), ("I", 4), ("I", 8)))
    struct.pack_into(f"{order}{form}", raw, tag + place, draw.choice(ODD) % (1 << (16 if form == "H" else 32)))
    return bytes(raw)


def _parquet(content: bytes, draw: random.Random) -> bytes:
    """A column of another type, with holes, of other lengths, or repeated; another compression."""
    import pyarrow  # noqa: PLC0415
    from pyarrow import parquet  # noqa: PLC0415

    table = parquet.read_table(io.BytesIO(content))
    k = draw.randrange(table.num_columns)
    n = table.num_rows
    columns: list[Callable[[], Any]] = [
        lambda: pyarrow.array([None] * n),
        lambda: pyarrow.array(["a" * draw.choice((0, 1, 5000))] * n),
        lambda: pyarrow.array([float("nan")] * n),
        lambda: pyarrow.array([draw.choice((-1, 2**62, 0))] * n),
        lambda: pyarrow.array([[1.0] * draw.randrange(4) for _ in range(n)]),
        lambda: pyarrow.array([{"bytes": draw.randbytes(20), "path": "../../x"}] * n),
        lambda: table.column(draw.randrange(table.num_columns)),
    ]
    table = table.set_column(k, table.column_names[k], draw.choice(columns)())
    if draw.random() < 0.2:
        table = pyarrow.concat_tables([table] * draw.choice((0, 2, 30))) if draw.random() < 0.9 else table.slice(0, 0)
    out = io.BytesIO()
    way = draw.choice(("none", "snappy", "gzip", "zstd"))
    parquet.write_table(table, out, compression=way, use_dictionary=draw.random() < 0.5)
    return out.getvalue()


def _hdf5(content: bytes, draw: random.Random) -> bytes:
    """An array of another shape or type, stored in other pieces."""
    import h5py  # noqa: PLC0415

    out = io.BytesIO(content)
    with h5py.File(out, "r+") as group:
        key = draw.choice(sorted(group))
        shape = list(group[key].shape)
        shape[draw.randrange(len(shape))] = draw.choice((0, 1, 3, 1000, 999_999))
        kind = draw.choice(("u1", "f4", "f8", "i8", "S5"))
        del group[key]
        group.create_dataset(key, tuple(shape), kind, chunks=True, compression=draw.choice((None, "gzip", "lzf")))
    return out.getvalue()


def _npz(content: bytes, draw: random.Random) -> bytes:
    """An array of another type or shape; of an archive, one of its arrays."""
    if content[:2] != b"PK":
        return _npy(content, draw)
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        names = old.namelist()
        victim = draw.choice(names)
        for name in names:
            body = old.read(name)
            new.writestr(name, _npy(body, draw) if name == victim and body[:6] == b"\x93NUMPY" else body)
    return out.getvalue()


def _npy(content: bytes, draw: random.Random) -> bytes:
    array = np.load(io.BytesIO(content), allow_pickle=False)
    ways: list[Callable[[], np.ndarray]] = [
        lambda: array.astype(draw.choice(("u1", "i8", "f2", "f8", "?", "c8"))),
        lambda: np.full_like(array, draw.choice((0, 1)), dtype="f8") * draw.choice((np.nan, np.inf, -1.0, 1e300)),
        lambda: array.reshape(-1)[: draw.randrange(array.size + 1)],
        lambda: array[None],
        lambda: np.zeros((draw.choice((0, 1, 5000)), draw.choice((1, 5000))), "u1"),
    ]
    out = io.BytesIO()
    np.save(out, draw.choice(ways)())
    return out.getvalue()


def _jpeg(content: bytes, draw: random.Random) -> bytes:
    """A size in the frame header, or scans once more and again."""
    raw = bytearray(content)
    if draw.random() < 0.5:
        at = next((i for i in range(len(raw) - 9) if raw[i] == 0xFF and raw[i + 1] in (0xC0, 0xC2)), 0)
        struct.pack_into(">H", raw, at + draw.choice((5, 7)), draw.choice(ODD) % 65_536)
        return bytes(raw)
    at = content.rfind(b"\xff\xda")
    return content[:at] + content[at:-2] * draw.choice((2, 50, 1500)) + content[-2:]


#: (whether a file is of a format, how to damage it).
_WAYS: tuple[tuple[Callable[[bytes], bool], Callable[[bytes, random.Random], bytes]], ...] = (
    (lambda c: c[4:8] == b"ftyp", _mp4),
    (lambda c: c[:4] in (b"II*\0", b"MM\0*"), _tiff),
    (lambda c: c[:4] == b"PAR1", _parquet),
    (lambda c: c[:4] == b"\x89HDF", _hdf5),
    (lambda c: c[:6] == b"\x93NUMPY" or (c[:2] == b"PK" and b".npy" in c[:200]), _npz),
    (lambda c: c[:2] == b"\xff\xd8", _jpeg),
)
