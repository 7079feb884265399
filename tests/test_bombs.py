"""Files of a few kilobytes that ask for gigabytes or minutes, and files that are none: refused before either is spent."""

from __future__ import annotations

import io
import json
import os
import pickle
import socket
import struct
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import hostile
import numpy as np
import pytest

from dhtorch import data
from dhtorch.data import files
from dhtorch.data.codecs import hdf5, npy, parquet, pickles, tarballs, tiff, video
from dhtorch.data.files import FormatError
from dhtorch.data.members import zip_members
from dhtorch.testing.mp4 import write_video

pyarrow = pytest.importorskip("pyarrow")
tifffile = pytest.importorskip("tifffile")
h5py = pytest.importorskip("h5py")
from pyarrow import parquet as arrow_parquet  # noqa: E402

FRUGAL = 256 << 20  # bytes above the level before the call


def dictionary(file: Path) -> Callable[[Path], Any]:
    table = (
        pyarrow.table({"x": pyarrow.array([bytes(1 << 20)] * 20_000).dictionary_encode().cast("binary")}) if 0 else None
    )
    del table
    column = pyarrow.DictionaryArray.from_arrays(np.zeros(20_000, np.int32), [bytes(1 << 20)])
    arrow_parquet.write_table(pyarrow.table({"x": column}), file, compression="zstd", store_schema=False)
    return lambda path: parquet.read_columns(path, ["x"])


def zeros(file: Path) -> Callable[[Path], Any]:
    column = pyarrow.DictionaryArray.from_arrays(np.zeros(40_000_000, np.int32), [0.5])
    arrow_parquet.write_table(pyarrow.table({"x": column}), file, compression="zstd", store_schema=False)
    return lambda path: parquet.read_columns(path, ["x"])


def objects(file: Path) -> Callable[[Path], Any]:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", "[" + "{}," * 4_000_000 + "{}]")
    return lambda path: files.decode_json(zip_members(path)["metadata"].read(), path)


def long_directory(file: Path) -> Callable[[Path], Any]:
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("metadata", "{}")
    raw = file.read_bytes()
    end = raw.index(b"PK\5\6")
    long = struct.pack("<4sQHHIIQQQQ", b"PK\6\6", 44, 45, 45, 0, 0, 1, 1, 9_000_000_000, 0)
    place = struct.pack("<4sIQI", b"PK\6\7", 0, end, 1)
    file.write_bytes(raw[:end] + long + place + raw[end : end + 8] + b"\xff" * 12 + b"\0\0")
    return zip_members


def many_entries(file: Path) -> Callable[[Path], Any]:
    entry = struct.pack("<4s6H3I5H2I", b"PK\1\2", 20, 20, 0, 0, 0, 33, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0) + b"a"
    body = entry * 400_000
    file.write_bytes(body + struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, len(body), 0, 0))
    return zip_members


def small_numbers(file: Path) -> Callable[[Path], Any]:
    np.savez_compressed(file, data=np.zeros(100_000_000, np.uint8))
    return lambda path: npy.read_npz(path, "data")


def large_tile(file: Path) -> Callable[[Path], Any]:
    tifffile.imwrite(file, np.zeros((24, 32), np.uint8), tile=(32, 32), compression="zlib")
    raw = bytearray(file.read_bytes())
    for tag in (322, 323):
        at = (
            raw.index(struct.pack("<HH", tag, 3))
            if struct.pack("<HH", tag, 3) in raw
            else raw.index(struct.pack("<HH", tag, 4))
        )
        raw[at + 2 : at + 4] = struct.pack("<H", 4)
        raw[at + 8 : at + 12] = struct.pack("<I", 49_984)
    file.write_bytes(raw)
    return tiff.read_tiff


def many_samples(file: Path) -> Callable[[Path], Any]:
    write_video(file, [np.zeros((32, 32, 3), np.uint8)] * 3, [0.0, 0.1, 0.2])
    raw = bytearray(file.read_bytes())
    at = raw.index(b"stsz")
    raw[at + 8 : at + 16] = struct.pack(">II", 10, 50_000_000)
    file.write_bytes(raw)
    return video.video_header


def empty_sets(file: Path) -> Callable[[Path], Any]:
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "|O", "fortran_order": False, "shape": ()})  # type: ignore[arg-type]
    file.write_bytes(head.getvalue() + b"\x80\x04](" + b"\x8f" * 9_000_000 + b"e.")
    return pickles.read_npy


def stacks(file: Path) -> Callable[[Path], Any]:
    with h5py.File(file, "w") as group:
        group.create_dataset("stack_train", (999_999, 10, 8, 8, 3), "u1", chunks=(1, 10, 8, 8, 3))
    return hdf5.hdf5_arrays


def scans(file: Path) -> Callable[[Path], Any]:
    picture = cv2.imencode(".jpg", np.zeros((4000, 4000), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    at = picture.rindex(b"\xff\xda")
    file.write_bytes(picture[:at] + picture[at:-2] * 900 + b"\xff\xd9")
    return files.read_image


def words(file: Path) -> Callable[[Path], Any]:
    file.write_bytes(b"1 " * 25_000_000)
    return files.read_rows


def lines(file: Path) -> Callable[[Path], Any]:
    file.write_bytes(b"ab\x0b" * 10_000_000)
    return files.read_rows


def wide_text(file: Path) -> Callable[[Path], Any]:
    file.write_bytes("\N{GRINNING FACE}".encode() + b"a" * 60_000_000)
    return files.read_text


BOMBS: dict[str, Callable[[Path], Callable[[Path], Any]]] = {
    "a dictionary.parquet": dictionary,
    "runs.parquet": zeros,
    "objects.r3d": objects,
    "long directory.r3d": long_directory,
    "entries.r3d": many_entries,
    "small numbers.npz": small_numbers,
    "tile.tif": large_tile,
    "samples.mp4": many_samples,
    "sets.npy": empty_sets,
    "stacks.h5": stacks,
    "scans.jpg": scans,
    "words.txt": words,
    "lines.txt": lines,
    "wide.txt": wide_text,
}


@pytest.mark.parametrize("name", BOMBS)
def test_little_that_would_become_much_is_refused(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a child of its own, so that time and memory are those of this file."""
    monkeypatch.setattr(hostile, "BYTES", FRUGAL)
    (tmp_path / "capture").mkdir()
    file = tmp_path / "capture" / name
    outcome = hostile.run(BOMBS[name](file), file, tmp_path)
    assert outcome.kind == "FormatError", outcome
    assert name in outcome.detail
