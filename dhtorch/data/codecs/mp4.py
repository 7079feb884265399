"""Boxes of an mp4: check of the declared number of samples against the file's length, and display matrix.

The check precedes a decoder, which allocates memory for the samples: some tables are short for any number of samples,
all of one size, runs of one duration, fragments of defaults.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from dhtorch.data.io.decode import FormatError
from dhtorch.runtime.safe_open import MAX_TEXT_BYTES, check_memory

#: Types of the first box of a file.
MP4_FIRST_BOXES: Final = (b"ftyp", b"styp", b"moov", b"moof", b"mdat", b"wide", b"free", b"skip", b"uuid", b"pnot")

_CONTAINER_BOXES: Final = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"moof", b"traf", b"edts", b"mvex")
_RUN_LENGTH_BOXES: Final = (b"stts", b"ctts")  # tables of (count, value)
_BYTES_PER_SAMPLE: Final = 200  # memory of a decoder and of our table per sample
_MAX_DEPTH: Final = 12
_MAX_BOXES: Final = 200_000
#: (a, b, c, d) of a track's matrix, x' = a x + c y and y' = b x + d y in a picture with y down -> symmetry of
#: :mod:`dhtorch.data.orientation`.
SYMMETRY_OF_MATRIX: Final = {
    (1, 0, 0, 1): 0,
    (0, 1, -1, 0): 1,
    (-1, 0, 0, -1): 2,
    (0, -1, 1, 0): 3,
    (-1, 0, 0, 1): 4,
    (0, -1, -1, 0): 5,
    (1, 0, 0, -1): 6,
    (0, 1, 1, 0): 7,
}


class _Box(NamedTuple):
    kind: bytes
    start: int  # offset of its content
    end: int


def check_sample_count(stream: BinaryIO, file: Path) -> None:
    """Raise FormatError for a file that declares more samples than bytes, or than the memory limit allows.

    Raises:
        FormatError: too many samples or boxes.
    """
    total = stream.seek(0, 2)
    n_samples = 0
    for number, box in enumerate(_iter_boxes(stream, _Box(b"", 0, total), 0)):
        if number > _MAX_BOXES:
            raise FormatError(file, "boxes", f"more than {_MAX_BOXES}", "a file with fewer")
        declared = _declared_samples(stream, box, file)
        if declared > total:
            raise FormatError(file, box.kind.decode(), f"{declared} samples in {total} bytes", "at most one per byte")
        n_samples += declared if box.kind in (b"stsz", b"stz2", b"trun") else 0
        check_memory(
            file, "samples", _BYTES_PER_SAMPLE * max(n_samples, declared), f"{max(n_samples, declared)} samples"
        )


def read_display_symmetry(stream: BinaryIO, track: int = 0) -> int:
    """Symmetry that the display matrix of a video track applies to the stored frames; 0 where it is no quarter turn."""
    matrix, videos = b"", 0
    for number, box in enumerate(_iter_boxes(stream, _Box(b"", 0, stream.seek(0, 2)), 0)):
        if number > _MAX_BOXES:
            break
        if box.kind == b"tkhd":
            stream.seek(box.start)
            version = stream.read(1)
            stream.seek(box.start + (52 if version == b"\1" else 40))
            matrix = stream.read(20)
        elif box.kind == b"hdlr":
            stream.seek(box.start + 8)
            if stream.read(4) == b"vide":
                if videos == track and len(matrix) == 20:
                    a, b, _, c, d = (entry / 65536 for entry in struct.unpack(">5i", matrix))
                    return SYMMETRY_OF_MATRIX.get((a, b, c, d), 0)
                videos += 1
    return 0


def _iter_boxes(stream: BinaryIO, inside: _Box, depth: int) -> Iterator[_Box]:
    """Boxes in depth-first order; a damaged box ends its container."""
    at = inside.start
    while at + 8 <= inside.end:
        stream.seek(at)
        size, kind = struct.unpack(">I4s", stream.read(8))
        start = at + 8
        if size == 1:
            (size,) = struct.unpack(">Q", stream.read(8).ljust(8, b"\0"))
            start += 8
        end = inside.end if size == 0 else at + size
        if end < start:
            return
        box = _Box(kind, start, min(end, inside.end))
        yield box
        if kind in _CONTAINER_BOXES and depth < _MAX_DEPTH:
            yield from _iter_boxes(stream, box, depth + 1)
        at = end


def _declared_samples(stream: BinaryIO, box: _Box, file: Path) -> int:
    """Number of samples that a table declares; 0 for other boxes."""
    stream.seek(box.start)
    if box.kind in (b"stsz", b"stz2"):
        _, _, n = struct.unpack(">III", stream.read(12).ljust(12, b"\0"))
        return int(n)
    if box.kind == b"trun":
        _, n = struct.unpack(">II", stream.read(8).ljust(8, b"\0"))
        return int(n)
    if box.kind in _RUN_LENGTH_BOXES:
        if box.end - box.start > MAX_TEXT_BYTES:
            raise FormatError(file, box.kind.decode(), f"{box.end - box.start} bytes", f"at most {MAX_TEXT_BYTES}")
        table = stream.read(box.end - box.start)[8:]
        return sum(n for n, _ in struct.iter_unpack(">II", table[: len(table) // 8 * 8]))
    return 0
