"""PLY file -> exhibit with points only, e.g. for a result whose data are missing."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dhtorch.codes import Gate, Hole, Source, is_swept
from dhtorch.geometry.se3 import turn_between
from dhtorch.viz.viewer.exhibit import EMPTY_SWEPT_CLOUD, Exhibit, PairExhibit, SweptPointCloud

#: Maximum number of points shown; of more, a random subset.
_MAX_POINTS = 100_000

_DTYPE_OF_PLY = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1"}
_DTYPE_OF_PLY |= {"char": "i1", "int8": "i1", "short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2"}
_DTYPE_OF_PLY |= {"int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4"}


def read_ply_exhibit(path: Path) -> Exhibit:
    """PLY file of :func:`dhtorch.export.write_ply` -> exhibit without images and tracks.

    Missing properties default to recovered points without sigma and score. Swept points become a separate cloud.

    Raises:
        ValueError: no PLY (text or binary little-endian) with x, y and z, or a truncated file.
        OSError: no such file.
    """
    vertex = read_ply_vertices(path).vertex
    vertex = vertex[np.isfinite([vertex[a] for a in "xyz"]).all(0)]
    if len(vertex) > _MAX_POINTS:
        vertex = _subsample(vertex)
    n, properties = len(vertex), vertex.dtype.names or ()
    column = {name: vertex[name] if name in properties else np.zeros(n) for name in ("sigma", "score")}
    source = vertex["source"] if "source" in properties else np.full(n, Source.RECOVERED)
    hole = (
        vertex["class"]
        if "class" in properties
        else np.where(source == Source.SENSOR, Hole.NONE, Hole.TRACKABLE_NO_LIDAR)
    )
    xyz = np.stack([vertex[a] for a in "xyz"], -1).astype(np.float32)
    up = _read_up(path)
    xyz = xyz if up is None else (xyz @ turn_between(up).T.numpy()).astype(np.float32)
    grey = np.full(n, 128, np.uint8)
    rgb = np.stack([vertex[c] if c in properties else grey for c in ("red", "green", "blue")], -1)
    swept_only = is_swept(source)
    swept = SweptPointCloud(
        xyz[swept_only], rgb[swept_only].astype(np.uint8), *(column[name][swept_only] for name in ("sigma", "score"))
    )
    missing = np.full(n, np.nan, np.float32)
    zero = np.zeros((n, 2), np.float32)
    depth = xyz[:, 2] if (xyz[:, 2] > 0).all() else np.linalg.norm(xyz, axis=1)  # the origin of a map is not a camera
    samples = {"xyz": xyz, "rgb": rgb.astype(np.uint8), "depth": depth, "source": source.astype(np.int32), **column}
    samples |= {"uv_0": zero, "uv_1": zero, "tracked": np.zeros(n, bool), "candidate": np.zeros(n, bool)}
    samples |= {"gate": np.full(n, Gate.ANSWER, np.int32), "hole": hole.astype(np.int32)}
    samples |= dict.fromkeys(("parallax_deg", "residual_px", "error"), missing)
    other_samples = {name: values[~swept_only] for name, values in samples.items()}
    return Exhibit(
        path.name,
        [PairExhibit(path.name, other_samples, np.eye(4), swept=swept if swept_only.any() else EMPTY_SWEPT_CLOUD)],
    )


def _subsample(vertex: np.ndarray) -> np.ndarray:
    """Random subset of ``_MAX_POINTS``; recovered points get up to half of it, as sensor points are denser."""
    draw = np.random.default_rng(0)
    is_recovered = (
        vertex["source"] != Source.SENSOR if "source" in (vertex.dtype.names or ()) else np.zeros(len(vertex), bool)
    )
    recovered = is_recovered.nonzero()[0]
    rest = (~is_recovered).nonzero()[0]
    n = min(len(recovered), max(_MAX_POINTS // 2, _MAX_POINTS - len(rest)))
    subset = [draw.choice(which, k, replace=False) for which, k in ((recovered, n), (rest, _MAX_POINTS - n))]
    return vertex[np.sort(np.concatenate(subset))]


def _read_up(path: Path) -> list[float] | None:
    """Upward direction from the header comment ``up``, None without one."""
    head = path.read_bytes().partition(b"end_header\n")[0].decode("ascii", "replace")
    match = re.search(r"^comment up (\S+) (\S+) (\S+)$", head, re.MULTILINE)
    try:
        up = [float(v) for v in match.groups()] if match else []
    except ValueError:
        return None
    return up if np.isfinite(up).all() and np.linalg.norm(up) > 0 else None


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
        ValueError: another format, no vertices with x, y and z, or a truncated file.
        OSError: no such file.
    """
    head, end, body = path.read_bytes().partition(b"end_header\n")
    lines = [line.strip() for line in head.decode("ascii", "replace").split("\n")]
    is_ascii = "format ascii 1.0" in lines
    if lines[0] != "ply" or not end or not (is_ascii or "format binary_little_endian 1.0" in lines):
        raise ValueError(f"{path}: found another format, expected a PLY file, text or binary little-endian")
    count, layout = _read_ply_layout(path, lines)
    kind = np.dtype(layout)
    if is_ascii:
        rows = body.split(b"\n", count)
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
            if count is not None or words[1:2] != ["vertex"] or not words[-1].isdigit():
                break  # vertices come first; later elements (faces) are ignored
            count = int(words[2])
        elif words[:1] == ["property"] and count is not None:
            if words[1] not in _DTYPE_OF_PLY or words[-1] in dict(layout):
                raise ValueError(f"{path}: found {' '.join(words)!r}, expected one number per vertex")
            layout.append((words[-1], _DTYPE_OF_PLY[words[1]]))
    if count is None or not {"x", "y", "z"} <= {name for name, _ in layout}:
        raise ValueError(f"{path}: found no vertices with x, y and z as its first element")
    return count, layout
