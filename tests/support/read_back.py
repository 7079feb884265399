"""Files of points, meshes and models as other programs read them: by plyfile, json and struct alone."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

Array = np.ndarray


def same(value: Any, want: Any, tolerance: float = 0.0) -> None:
    np.testing.assert_allclose(np.asarray(value, np.float64), np.asarray(want, np.float64), rtol=0, atol=tolerance)


def read_ply(file: Path) -> Array:
    """Vertices of a PLY file."""
    plyfile = pytest.importorskip("plyfile")
    data = plyfile.PlyData.read(file)
    assert not data.text and data.byte_order == "<"
    return data["vertex"].data


def read_glb(file: Path) -> tuple[list[Any], list[dict[str, Array]]]:
    """Nodes, and the arrays of every mesh by attribute; what loaders rely on holds: sizes, alignment, bounds."""
    data = file.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    document, body = json.loads(data[20 : 20 + size]), data[20 + size :]
    assert kind == b"JSON" and size % 4 == 0 and document["asset"] == {"version": "2.0", "generator": "dhtorch"}
    if body:
        assert struct.unpack_from("<I4s", body) == (len(body) - 8, b"BIN\0") and len(body) % 4 == 0
        assert document["buffers"] == [{"byteLength": len(body) - 8}]

    def array(k: int) -> Array:
        accessor = document["accessors"][k]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3}[accessor["type"]]
        dtype = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        values = np.frombuffer(body, dtype, accessor["count"] * width, 8 + view["byteOffset"])
        values = values.reshape(-1, width) if width > 1 else values
        assert view["byteOffset"] % 4 == 0 and view["byteLength"] == values.nbytes > 0
        if "min" in accessor:
            assert [accessor["min"], accessor["max"]] == [values.min(0).tolist(), values.max(0).tolist()]
        return values

    meshes = []
    for mesh in document.get("meshes", ()):
        (primitive,) = mesh["primitives"]
        arrays = {name: array(k) for name, k in primitive["attributes"].items()}
        assert {len(values) for values in arrays.values()} == {len(arrays["POSITION"])}
        assert "min" in document["accessors"][primitive["attributes"]["POSITION"]]
        assert primitive["mode"] == (4 if "indices" in primitive else 0)
        meshes.append(arrays | ({"indices": array(primitive["indices"])} if "indices" in primitive else {}))
    return document.get("nodes", []), meshes


def linear(rgb: Array) -> Array:
    """sRGB of 8 bits -> linear."""
    x = rgb / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
