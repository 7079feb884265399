"""Writer of PLY (binary, little-endian) for points and meshes; read by MeshLab, CloudCompare, Blender and Open3D."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.export.arrays import check_rows, colour_to_uint8, select_finite, to_numpy
from dhtorch.runtime import storage

_PLY_TYPES = {"f4": "float", "u1": "uchar", "i4": "int"}


def write_ply(
    path: str | Path,
    xyz: Any,  # (P, 3) m
    rgb: Any = None,  # (P, 3) uint8, or float in [0, 1]
    *,
    normal: Any = None,  # (P, 3)
    face: Any = None,  # (F, 3) triangles
    comments: Sequence[str] = ("metres; x right, y down, z forward",),
    **values: Any,  # (P,) each
) -> int:
    """Write points, or a mesh, with further values per point; returns the number of points.

    Properties: x y z, nx ny nz, red green blue, then ``values`` in their order. Integers from 0 to 255 (codes) become
    uchar, other integers int, everything else float. ``sigma``, ``score``, ``hole`` (class of the sensor's hole,
    codes.Hole; written as ``class``) and ``source`` (codes.Source) are the names used throughout. ``sigma`` is written
    again as ``quality``, the property that MeshLab colours and selects by.

    Args:
        path: of the file.
        xyz: points; non-finite ones and their triangles are left out.
        rgb, normal, values: of each point.
        face: corners as indices of points; makes it a mesh.
        comments: lines of the header.

    Returns:
        Number of points written.

    Raises:
        ValueError: arrays of unequal length or wrong shape, or a triangle with an invalid corner.
    """
    points = check_rows("write_ply", "xyz", xyz, None, 3)
    n = len(points)
    columns: dict[str, np.ndarray] = dict(zip("xyz", points.T.astype("<f4"), strict=True))
    if normal is not None:
        normals = np.nan_to_num(check_rows("write_ply", "normal", normal, n, 3)).T.astype("<f4")
        columns |= dict(zip(("nx", "ny", "nz"), normals, strict=True))
    if rgb is not None:
        colours = colour_to_uint8(check_rows("write_ply", "rgb", rgb, n, 3)).T
        columns |= dict(zip(("red", "green", "blue"), colours, strict=True))
    for name, value in values.items():
        if value is not None:
            columns["class" if name == "hole" else name] = _to_ply_number(check_rows("write_ply", name, value, n, None))
    if "sigma" in columns:
        columns.setdefault("quality", columns["sigma"])
    corners = None if face is None else check_rows("write_ply", "face", to_numpy(face), None, 3)
    finite, corners = select_finite(points, corners)
    vertex = np.zeros(n, [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        vertex[name] = column
    vertex = vertex[finite]
    # One line of ASCII a comment, which PLY demands of its header: other characters are escaped.
    plain = [" ".join(line.split()).encode("ascii", "backslashreplace").decode("ascii") for line in comments]
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in plain)]
    header += [f"element vertex {len(vertex)}"]
    header += [f"property {_PLY_TYPES[column.dtype.str[1:]]} {name}" for name, column in columns.items()]
    body = vertex.tobytes()
    if corners is not None:
        header += [f"element face {len(corners)}", "property list uchar int vertex_indices"]
        triangles = np.zeros(len(corners), [("n", "u1"), ("corner", "<i4", 3)])
        triangles["n"], triangles["corner"] = 3, corners
        body += triangles.tobytes()
    storage.replace_file(path, "\n".join([*header, "end_header\n"]).encode("ascii") + body)
    return len(vertex)


def _to_ply_number(values: np.ndarray) -> np.ndarray:
    """Values as uchar, int or float, little-endian."""
    if values.dtype.kind == "b" or (values.dtype.kind in "iu" and (not values.size or values.min() >= 0)):
        small = not values.size or values.max() <= 255
        return values.astype("u1" if small else "<i4")
    return values.astype("<i4" if values.dtype.kind in "iu" else "<f4")
