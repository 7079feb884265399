"""Writer of GLB, the binary form of glTF 2.0, for points and meshes; read by browsers, Blender and MeshLab.

glTF's world has y up and linear vertex colours: scenes are rotated and colours converted from sRGB here. Open3D leaves
out glTF's points, therefore points may also be written as small squares.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.export.arrays import check_rows, colour_to_uint8, select_finite, to_numpy
from dhtorch.runtime import storage

_FLOAT, _UINT = 5126, 5125
_POINTS, _TRIANGLES = 0, 4
_VERTICES, _INDICES = 34962, 34963  # targets of a buffer view


@dataclass(frozen=True)
class Shape:
    """A point cloud, or a mesh if it has triangles."""

    name: str
    xyz: Any  # (P, 3) m
    rgb: Any = None  # (P, 3) uint8, or float in [0, 1]; None = grey
    normal: Any = None  # (P, 3)
    face: Any = None  # (F, 3)
    values: Mapping[str, Any] = field(default_factory=dict)  # (P,) each; written as float attributes _NAME
    square: float | None = (
        None  # m, side of the squares across the normals as which points are written; None = as points
    )


def write_glb(path: str | Path, shapes: Sequence[Shape], *, up: Sequence[float] = (0.0, -1.0, 0.0)) -> None:
    """Write point clouds and meshes into one file, each as a node.

    Args:
        path: of the file.
        shapes: non-finite points and their triangles are left out, and shapes without points.
        up: the up direction in the shapes' axes; becomes glTF's +y. The default is for OpenCV camera axes.

    Raises:
        ValueError: wrong array shapes, a triangle with an invalid corner, or an ``up`` without direction.
    """
    builder = _GltfBuilder()
    rotation = _rotation_to_y_up(np.asarray(up, np.float64))
    for shape in shapes:
        builder.add(shape, rotation)
    nodes = list(range(len(builder.nodes)))
    document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "dhtorch"}, "scene": 0}
    document["scenes"] = [{"nodes": nodes}] if nodes else [{}]
    if nodes:
        material = {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": 0, "roughnessFactor": 1}
        unlit = "KHR_materials_unlit"  # the colours contain the lighting already
        document |= {"extensionsUsed": [unlit], "nodes": builder.nodes, "meshes": builder.meshes}
        document["materials"] = [{"pbrMetallicRoughness": material, "doubleSided": True, "extensions": {unlit: {}}}]
        document |= {"accessors": builder.accessors, "bufferViews": builder.views}
        document["buffers"] = [{"byteLength": len(builder.data)}]
    text = storage.dump_strict_json(document, ensure_ascii=True, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if builder.data:
        chunks += struct.pack("<I4s", len(builder.data), b"BIN\0") + bytes(builder.data)
    storage.replace_file(path, struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


class _GltfBuilder:
    """Collects nodes, meshes, accessors and the binary buffer of a file."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.meshes: list[dict[str, Any]] = []
        self.nodes: list[dict[str, Any]] = []

    def add(self, shape: Shape, rotation: list[float]) -> None:
        shape = shape if shape.square is None or shape.face is not None else _squares(shape, shape.square)
        points = check_rows("write_glb", "xyz", shape.xyz, None, 3)
        n = len(points)
        corners = None if shape.face is None else check_rows("write_glb", "face", to_numpy(shape.face), None, 3)
        finite, corners = select_finite(points, corners)
        if not finite.any():
            return
        rgb = np.full((n, 3), 0.6) if shape.rgb is None else check_rows("write_glb", "rgb", shape.rgb, n, 3)
        # sRGB → linear colours as floats: 8 bits are too coarse for dark colours, and some readers fail on 16.
        display = colour_to_uint8(rgb[finite]) / 255.0
        linear = np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
        attributes = {"POSITION": self._floats(points[finite], bounds=True), "COLOR_0": self._floats(linear)}
        if shape.normal is not None:
            normal = check_rows("write_glb", "normal", shape.normal, n, 3)[finite].astype(np.float64)
            length = np.linalg.norm(normal, axis=1, keepdims=True)
            valid = np.isfinite(length) & (length > 0)
            up = np.array([0.0, 1.0, 0.0])
            attributes["NORMAL"] = self._floats(np.where(valid, normal / np.where(valid, length, 1), up))
        for name, value in shape.values.items():
            column = check_rows("write_glb", name, value, n, None)[finite].astype(np.float64)
            attributes[f"_{name.upper()}"] = self._floats(np.nan_to_num(column))
        primitive: dict[str, Any] = {"attributes": attributes, "material": 0, "mode": _POINTS}
        if corners is not None and len(corners):
            index = self._accessor(corners.astype("<u4").reshape(-1), _UINT, "SCALAR", target=_INDICES)
            primitive |= {"indices": index, "mode": _TRIANGLES}
        self.nodes.append({"name": shape.name, "mesh": len(self.meshes), "rotation": rotation})
        self.meshes.append({"name": shape.name, "primitives": [primitive]})

    def _floats(self, values: np.ndarray, bounds: bool = False) -> int:
        kind = "VEC3" if values.ndim == 2 else "SCALAR"
        return self._accessor(np.ascontiguousarray(values, "<f4"), _FLOAT, kind, bounds=bounds)

    def _accessor(
        self,
        values: np.ndarray,
        component: int,
        kind: str,
        *,
        target: int = _VERTICES,
        bounds: bool = False,
    ) -> int:
        entry: dict[str, Any] = {"bufferView": len(self.views), "componentType": component}
        entry |= {"count": len(values), "type": kind}
        if bounds:
            entry |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        size = values.nbytes
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": size, "target": target})
        self.data += values.tobytes() + b"\0" * (-size % 4)
        self.accessors.append(entry)
        return len(self.accessors) - 1


def _squares(shape: Shape, side: float) -> Shape:
    """The mesh with a square of two triangles, across the normal, in place of each point."""
    centre = check_rows("write_glb", "xyz", shape.xyz, None, 3).astype(np.float64)
    n = len(centre)
    normal = np.zeros((n, 3)) if shape.normal is None else check_rows("write_glb", "normal", shape.normal, n, 3)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    valid = np.isfinite(length) & (length > 0)
    normal = np.where(valid, normal / np.where(valid, length, 1), np.array([0.0, 0.0, 1.0]))
    a = np.cross(normal, np.eye(3)[np.abs(normal).argmin(1)])
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(normal, a)
    corner = (centre[:, None] + side / 2 * np.stack((-a - b, a - b, a + b, b - a), 1)).reshape(-1, 3)
    face = (4 * np.arange(n)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    rgb = None if shape.rgb is None else check_rows("write_glb", "rgb", shape.rgb, n, 3).repeat(4, 0)
    values = {k: check_rows("write_glb", k, v, n, None).repeat(4) for k, v in shape.values.items()}
    return replace(shape, xyz=corner, rgb=rgb, normal=normal.repeat(4, 0), face=face, values=values)


def _rotation_to_y_up(up: np.ndarray) -> list[float]:
    """Quaternion x, y, z, w of the smallest rotation from ``up`` to +y; a half turn is about x."""
    length = np.linalg.norm(up)
    if up.shape != (3,) or not length > 0 or not math.isfinite(length):
        raise ValueError(f"write_glb: up is {up.tolist()}, expected a direction of three numbers")
    x, y, z = (up / length).tolist()
    if y < -1 + 1e-9:
        return [1.0, 0.0, 0.0, 0.0]
    q = np.array([-z, 0.0, x, 1 + y])  # (up × y, 1 + up · y)
    return (q / np.linalg.norm(q)).tolist()
