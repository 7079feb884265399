"""PLY files: the numbers of their vertices, read and written back."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dhtorch.runtime.safe_open import open_regular

#: Largest size of a file, bytes. Source: chosen, eight million splats of 62 numbers.
_MAX_PLY_BYTES = 2 << 30

#: Bytes in which the header ends. Source: chosen, many times that of a splat with 62 properties.
_MAX_HEADER_BYTES = 1 << 17

#: Types of properties → numpy's, little-endian.
_DTYPE_OF_PLY = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1"}
_DTYPE_OF_PLY |= {"char": "i1", "int8": "i1", "short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2"}
_DTYPE_OF_PLY |= {"int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4"}


class PlyVertices(NamedTuple):
    """Vertices of a PLY file, with its header and what follows them."""

    vertex: np.ndarray  # (P,) with a field for each property
    header: bytes  # up to and including ``end_header``
    rest: bytes  # later elements
    is_ascii: bool

    @property
    def xyz(self) -> np.ndarray:
        """Places (P, 3) float64."""
        return np.stack([self.vertex[a] for a in "xyz"], 1).astype(np.float64)

    def encode(self, vertex: np.ndarray) -> bytes:
        """The file's bytes with other values of the same vertices."""
        if not self.is_ascii:
            return self.header + vertex.tobytes() + self.rest
        lines = (" ".join(str(value) for value in row) for row in vertex.tolist())
        return self.header + "".join(f"{line}\n" for line in lines).encode("ascii") + self.rest


def read_ply_vertices(path: Path) -> PlyVertices:
    """Vertices of a binary little-endian or text PLY file.

    Raises:
        ValueError: no regular file, another format, no vertices with x, y and z, a truncated file, or one of more than
            ``_MAX_PLY_BYTES``.
    """
    with open_regular(path) as stream:
        head, end, _ = stream.read(_MAX_HEADER_BYTES).partition(b"end_header\n")
        lines = [line.strip() for line in head.decode("ascii", "replace").split("\n")]
        is_ascii = "format ascii 1.0" in lines
        if lines[0] != "ply" or not end or not (is_ascii or "format binary_little_endian 1.0" in lines):
            raise ValueError(f"{path}: found another format, expected a PLY file, text or binary little-endian")
        count, layout = _read_ply_layout(path, lines)
        if (size := os.fstat(stream.fileno()).st_size) > _MAX_PLY_BYTES:
            raise ValueError(f"{path}: found {size} bytes, expected at most {_MAX_PLY_BYTES}")
        stream.seek(len(head + end))
        body = stream.read(size)
    kind = np.dtype(layout)
    if is_ascii:
        rows = body.split(b"\n", min(count, len(body)))
        try:
            vertex = np.array([tuple(map(float, row.split())) for row in rows[:count]], kind)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: found {error}, expected {len(layout)} numbers in each line") from None
        if len(vertex) < count:
            raise ValueError(f"{path}: found {len(vertex)} lines of points, expected {count}")
        return PlyVertices(vertex, head + end, b"".join(rows[count:]), is_ascii)
    if len(body) < count * kind.itemsize:
        raise ValueError(f"{path}: found {len(body)} bytes of points, expected {count * kind.itemsize}")
    size = count * kind.itemsize
    return PlyVertices(np.frombuffer(body, kind, count), head + end, body[size:], is_ascii)


def _read_ply_layout(path: Path, lines: Sequence[str]) -> tuple[int, list[tuple[str, str]]]:
    """Number of vertices and (name, type) of their properties."""
    layout: list[tuple[str, str]] = []
    count = None
    for words in (line.split() for line in lines):
        if words[:1] == ["element"]:
            if count is not None or words[1:2] != ["vertex"] or not (words[2:] and words[2].isdigit()):
                break  # vertices come first; later elements (faces) are ignored
            count = int(words[2])
        elif words[:1] == ["property"] and count is not None:
            if len(words) != 3 or words[1] not in _DTYPE_OF_PLY or words[-1] in dict(layout):
                raise ValueError(f"{path}: found {' '.join(words)!r}, expected one number per vertex")
            layout.append((words[-1], _DTYPE_OF_PLY[words[1]]))
    if count is None or not {"x", "y", "z"} <= {name for name, _ in layout}:
        raise ValueError(f"{path}: found no vertices with x, y and z as its first element")
    return count, layout
