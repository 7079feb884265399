"""The points of a PLY file as something to see: what is left of a result where its data are not."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from dhtorch.codes import Gate, Hole, Source
from dhtorch.geometry.se3 import turn_between
from dhtorch.viz.viewer.exhibit import EMPTY_SWEPT_CLOUD, Exhibit, PairExhibit, SweptPointCloud

#: Points of a file that are shown; of more, as many drawn at random.
_MAX_POINTS = 100_000

_DTYPE_OF_PLY = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1"}
_DTYPE_OF_PLY |= {"char": "i1", "int8": "i1", "short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2"}
_DTYPE_OF_PLY |= {"int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4"}


def read_ply_exhibit(path: Path) -> Exhibit:
    """The points of a PLY file, as :func:`dhtorch.export.write_ply` writes it: no pictures, no tracks.

    Properties that are not there are taken to be recovered points without sigma and score. Swept points become a cloud
    of their own.

    Raises:
        ValueError: no binary little-endian PLY with x, y and z, or a file shorter than it says.
        OSError: no such file.
    """
    vertex = _read_ply(path)
    vertex = vertex[np.isfinite([vertex[a] for a in "xyz"]).all(0)]
    if len(vertex) > _MAX_POINTS:
        vertex = _subsample(vertex)
    n, known = len(vertex), vertex.dtype.names or ()
    column = {name: vertex[name] if name in known else np.zeros(n) for name in ("sigma", "score")}
    source = vertex["source"] if "source" in known else np.full(n, Source.RECOVERED)
    hole = (
        vertex["class"] if "class" in known else np.where(source == Source.SENSOR, Hole.NONE, Hole.TRACKABLE_NO_LIDAR)
    )
    xyz = np.stack([vertex[a] for a in "xyz"], -1).astype(np.float32)
    up = _read_up(path)
    xyz = xyz if up is None else (xyz @ turn_between(up).T.numpy()).astype(np.float32)
    grey = np.full(n, 128, np.uint8)
    rgb = np.stack([vertex[c] if c in known else grey for c in ("red", "green", "blue")], -1)
    dense = source == Source.SWEPT
    swept = SweptPointCloud(
        xyz[dense], rgb[dense].astype(np.uint8), *(column[name][dense] for name in ("sigma", "score"))
    )
    absent = np.full(n, np.nan, np.float32)
    zero = np.zeros((n, 2), np.float32)
    depth = xyz[:, 2] if (xyz[:, 2] > 0).all() else np.linalg.norm(xyz, axis=1)  # a map's origin is no camera
    samples = {"xyz": xyz, "rgb": rgb.astype(np.uint8), "depth": depth, "source": source.astype(np.int32), **column}
    samples |= {"uv_0": zero, "uv_1": zero, "tracked": np.zeros(n, bool), "candidate": np.zeros(n, bool)}
    samples |= {"gate": np.full(n, Gate.ANSWER, np.int32), "hole": hole.astype(np.int32)}
    samples |= dict.fromkeys(("parallax_deg", "residual_px", "error"), absent)
    rest = {name: values[~dense] for name, values in samples.items()}
    return Exhibit(
        path.name, [PairExhibit(path.name, rest, np.eye(4), swept=swept if dense.any() else EMPTY_SWEPT_CLOUD)]
    )


def _subsample(vertex: np.ndarray) -> np.ndarray:
    """So many of them as a page can hold: what was recovered first, up to half, as the sensor's lie closer together."""
    draw = np.random.default_rng(0)
    ours = vertex["source"] != Source.SENSOR if "source" in (vertex.dtype.names or ()) else np.zeros(len(vertex), bool)
    first = ours.nonzero()[0]
    rest = (~ours).nonzero()[0]
    n = min(len(first), max(_MAX_POINTS // 2, _MAX_POINTS - len(rest)))
    chosen = [draw.choice(which, k, replace=False) for which, k in ((first, n), (rest, _MAX_POINTS - n))]
    return vertex[np.sort(np.concatenate(chosen))]


def _read_up(path: Path) -> list[float] | None:
    """The upward direction that a comment of the header tells; None where none does."""
    head = path.read_bytes().partition(b"end_header\n")[0].decode("ascii", "replace")
    found = re.search(r"^comment up (\S+) (\S+) (\S+)$", head, re.MULTILINE)
    try:
        up = [float(v) for v in found.groups()] if found else []
    except ValueError:
        return None
    return up if np.isfinite(up).all() and np.linalg.norm(up) > 0 else None


def _read_ply(path: Path) -> np.ndarray:
    head, end, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii", "replace").split("\n")
    if (
        lines[0].strip() != "ply"
        or not end
        or "format binary_little_endian 1.0" not in (line.strip() for line in lines)
    ):
        raise ValueError(f"{path}: found no binary little-endian PLY file")
    layout: list[tuple[str, str]] = []
    count, first = None, True
    for words in (line.split() for line in lines):
        if words[:1] == ["element"]:
            if count is not None:
                break  # vertices come first; what follows (faces) is not shown
            first = words[1] == "vertex"
            count = int(words[2]) if first and words[2].isdigit() else None
        elif words[:1] == ["property"] and count is not None:
            if words[1] not in _DTYPE_OF_PLY or words[-1] in dict(layout):
                raise ValueError(f"{path}: found {' '.join(words)!r}, expected a number of each vertex")
            layout.append((words[-1], _DTYPE_OF_PLY[words[1]]))
    if count is None or not {"x", "y", "z"} <= {name for name, _ in layout}:
        raise ValueError(f"{path}: found no vertices with x, y and z as its first element")
    kind = np.dtype(layout)
    if len(body) < count * kind.itemsize:
        raise ValueError(f"{path}: found {len(body)} bytes of points, expected {count * kind.itemsize}")
    return np.frombuffer(body, kind, count)
