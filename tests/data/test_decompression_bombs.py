"""Files of a few kilobytes that ask for gigabytes or minutes, and files that are none: refused before either is spent."""

import io
import json
import os
import pickle
import struct
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support import damage_harness as hostile
from support import writers
from support.box_scene import walk
from support.byte_damage import STRANGE_FILES
from support.writers.parts import write_video

from dhtorch import data
from dhtorch.data.codecs import hdf5, npy, parquet, pickles, tarballs, tiff, video
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.members import list_zip_members

pyarrow = pytest.importorskip("pyarrow")
tifffile = pytest.importorskip("tifffile")
h5py = pytest.importorskip("h5py")
from pyarrow import parquet as arrow_parquet  # noqa: E402

FRUGAL = 256 << 20  # bytes above the level before the call


def write_dictionary(file: Path, n: int, entry: Any) -> None:
    """A column of one value, as often as it likes."""
    column = pyarrow.DictionaryArray.from_arrays(np.zeros(n, np.int32), [entry])
    arrow_parquet.write_table(pyarrow.table({"x": column}), file, compression="zstd", store_schema=False)


def write_objects(file: Path) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", "[" + "{}," * 4_000_000 + "{}]")


def write_long_directory(file: Path) -> None:
    """Nine gigabytes of nothing, all of it directory."""
    size = 9_000_000_000
    long = struct.pack("<4sQHHIIQQQQ", b"PK\6\6", 44, 45, 45, 0, 0, 1, 1, size, 0)
    place = struct.pack("<4sIQI", b"PK\6\7", 0, size, 1)
    file.touch()
    os.truncate(file, size)
    with file.open("ab") as stream:
        stream.write(long + place + struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, 2**32 - 1, 2**32 - 1, 0))


def many_entries() -> bytes:
    entry = struct.pack("<4s6H3I5H2I", b"PK\1\2", 20, 20, 0, 0, 0, 33, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0) + b"a"
    body = entry * 400_000
    return body + struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, len(body), 0, 0)


def write_samples(file: Path) -> None:
    write_video(file, [np.zeros((32, 32, 3), np.uint8)] * 3, [0.0, 0.1, 0.2])
    raw = file.read_bytes()
    at = raw.index(b"stsz") + 8
    file.write_bytes(raw[:at] + struct.pack(">II", 10, 50_000_000) + raw[at + 8 :])


def empty_sets() -> bytes:
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "|O", "fortran_order": False, "shape": ()})  # type: ignore[arg-type]
    return head.getvalue() + b"\x80\x04](" + b"\x8f" * 3_000_000 + b"e."


def write_stacks(file: Path) -> None:
    with h5py.File(file, "w") as group:
        group.create_dataset("stack_train", (999_999, 10, 8, 8, 3), "u1", chunks=(1, 10, 8, 8, 3))


def many_scans() -> bytes:
    image = cv2.imencode(".jpg", np.zeros((4000, 4000), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    at = image.rindex(b"\xff\xda")
    return image[:at] + image[at:-2] * 900 + b"\xff\xd9"


#: Name of a file → (what writes it, how it is read).
BOMBS: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "a dictionary.parquet": (lambda file: write_dictionary(file, 20_000, bytes(1 << 20)), lambda path: parquet.read_columns(path, ["x"])),
    "runs.parquet": (lambda file: write_dictionary(file, 40_000_000, 0.5), lambda path: parquet.read_columns(path, ["x"])),
    "objects.r3d": (write_objects, lambda path: files.decode_json(list_zip_members(path)["metadata"].read(), path)),
    "long directory.r3d": (write_long_directory, list_zip_members),
    "entries.r3d": (lambda file: file.write_bytes(many_entries()), list_zip_members),
    "small numbers.npz": (
        lambda file: np.savez_compressed(file, data=np.zeros(100_000_000, np.uint8)),
        lambda path: npy.read_npz(path, "data"),
    ),
    "tile.tif": (
        lambda file: tifffile.imwrite(
            file, np.zeros((24, 32), np.uint8), tile=(20_000, 20_000), compression="zlib", compressionargs={"level": 1}
        ),
        tiff.read_tiff,
    ),
    "samples.mp4": (write_samples, video.read_video_header),
    "sets.npy": (lambda file: file.write_bytes(empty_sets()), pickles.read_npy),
    "stacks.h5": (write_stacks, hdf5.list_hdf5_group),
    "scans.jpg": (lambda file: file.write_bytes(many_scans()), files.read_image),
    "words.txt": (lambda file: file.write_bytes(b"1 " * 25_000_000), files.read_rows),
    "lines.txt": (lambda file: file.write_bytes(b"ab\x0b" * 10_000_000), files.read_rows),
    "wide.txt": (lambda file: file.write_bytes("\N{GRINNING FACE}".encode() + b"a" * 60_000_000), files.read_text),
}  # fmt: skip


@pytest.mark.parametrize("name", BOMBS)
def test_little_that_would_become_much_is_refused(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a child of its own, so that time and memory are those of this file."""
    monkeypatch.setattr(hostile, "BYTES", FRUGAL)
    (tmp_path / "capture").mkdir()
    write, read = BOMBS[name]
    write(file := tmp_path / "capture" / name)
    outcome = hostile.run(read, file, tmp_path)
    assert outcome.kind == "FormatError", outcome
    assert name in outcome.detail


READERS: dict[str, Callable[[Path], object]] = {
    "bytes": files.read_bytes,
    "table": parquet.read_parquet_header,
    "arrays": hdf5.list_hdf5_group,
    "archive": lambda path: list(tarballs.iter_tar_members(path)),
    "members": list_zip_members,
    "video": video.read_video_header,
}


@pytest.mark.parametrize("kind", ["pipe", "socket", "device"])
def test_what_is_no_regular_file_is_never_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """A pipe would wait for ever, a device may never end; a link to one is one."""
    monkeypatch.setattr(hostile, "PATIENCE", 10.0)
    STRANGE_FILES[kind](file := tmp_path / "capture")
    outcomes = {what: hostile.run(read, file, tmp_path) for what, read in READERS.items()}
    words = f"found a {kind}, expected a regular file"
    assert not [what for what, each in outcomes.items() if each.kind != "FormatError" or words not in each.detail]


def test_a_size_of_thousands_of_digits_is_a_damaged_header(tmp_path: Path) -> None:
    file = tmp_path / "x.tar"
    with tarfile.open(file, "w", format=tarfile.PAX_FORMAT) as archive:
        info = tarfile.TarInfo("a")
        info.pax_headers = {"size": "9" * 5000}
        archive.addfile(info)
    with pytest.raises(FormatError, match=r"x.tar: header at byte \d+: found size 9+…, expected a number of bytes"):
        list(tarballs.iter_tar_members(file))


DUMP = {k: [{"stamp": k, "tcp": np.zeros(7), "ft": np.zeros(6)}] for k in range(20_000)}
#: What is large because it holds much: as of BOMBS, and what it gives.
HONEST: dict[str, tuple[Callable[[Path], object], Callable[[Path], object], object]] = {
    "x.txt": (lambda f: f.write_text("1.0 2.0 3.0 4.0\n" * 100_000), lambda f: files.read_table(f).shape, (100_000, 4)),
    "x.json": (
        lambda f: f.write_text(json.dumps({"poses": [[0.25] * 7] * 100_000})),
        lambda f: len(files.read_json(f)["poses"]),
        100_000,
    ),
    "x.jpg": (
        lambda f: cv2.imwrite(str(f), np.zeros((480, 640, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        lambda f: files.read_image(f).shape,
        (3, 480, 640),
    ),
    "x.png": (
        lambda f: cv2.imwrite(str(f), np.zeros((4000, 6000), np.uint8)),
        lambda f: files.read_image(f).shape,
        (1, 4000, 6000),
    ),
    "x.npz": (
        lambda f: np.savez_compressed(f, data=np.zeros((2000, 3000), np.uint8)),
        lambda f: npy.read_npz(f, "data").dtype,
        np.float32,
    ),
    "x.npy": (lambda f: np.save(f, DUMP, allow_pickle=True), lambda f: len(pickles.read_npy(f)), 20_000),  # type: ignore[arg-type]
    "x.parquet": (
        lambda f: arrow_parquet.write_table(pyarrow.table({"x": ["pick up the cube"] * 300_000}), f),
        lambda f: parquet.read_columns(f, ["x"])["x"][-1],
        "pick up the cube",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HONEST)
def test_honest_files_stay_within_the_law(tmp_path: Path, name: str) -> None:
    write, read, answer = HONEST[name]
    write(tmp_path / name)
    assert read(tmp_path / name) == answer


def test_links_that_leave_a_capture_are_refused_unless_asked_for(tmp_path: Path) -> None:
    """Also those that are met when a frame is read, and in another process; not within it, nor to the whole."""
    outside, root, secret = (tmp_path / name for name in ("outside", "capture", "secret"))
    for folder in (outside, root):
        writers.write_tum(folder, walk(3, hw=(24, 32)))
    secret.write_text("root:x:0:0\n")
    (root / "real.txt").write_text((root / "rgb.txt").read_text())
    picture = next((root / "rgb").iterdir())
    for place, target, refused in (
        (root / "rgb.txt", secret, True),
        (root / "rgb.txt", "../outside/rgb.txt", True),
        (root / "rgb.txt", "real.txt", False),
        (picture, outside / "rgb" / picture.name, True),
    ):
        place.unlink()
        place.symlink_to(target)
        if target != secret:
            assert all(frame.image.numel() for frame in data.open(root, "tum", follow_links=True))
        if not refused:
            assert all(frame.image.numel() for frame in data.open(root, "tum"))
            continue
        with pytest.raises(FormatError, match=r"link: found one to outside .*follow_links=true") as caught:
            list(pickle.loads(pickle.dumps(data.open_all(root, "tum")[0])))
        assert "root:x" not in str(caught.value)
    (tmp_path / "entry").symlink_to(outside)
    assert data.open(tmp_path / "entry")[0].image.numel(), "the capture itself may lie behind a link"


def test_a_text_counts_two_bytes_a_letter_and_five_a_byte_of_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted: list[tuple[str, int]] = []
    monkeypatch.setattr(files, "check_memory", lambda file, field, takes, *_: counted.append((field, takes)))
    for name, text in (("a.txt", "plain text"), ("b.txt", "\N{GRINNING FACE}")):
        (tmp_path / name).write_text(text, encoding="utf-8")
        assert files.read_text(tmp_path / name) == text
    assert counted == [("text", 2 * 10), ("text", 5 * 4)]
