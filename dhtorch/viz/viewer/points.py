"""PLY file -> exhibit with points only, e.g. for a result whose data are missing."""

import re
from pathlib import Path

import numpy as np

from dhtorch.codes import Gate, Hole, Source, is_swept
from dhtorch.geometry.se3 import turn_between
from dhtorch.runtime.ply import read_ply_vertices
from dhtorch.viz.viewer.exhibit import EMPTY_SWEPT_CLOUD, Exhibit, PairExhibit, SweptPointCloud

#: Maximum number of points shown; of more, a random subset.
_MAX_POINTS = 100_000


def read_ply_exhibit(path: Path) -> Exhibit:
    """PLY file of :func:`dhtorch.export.write_ply` -> exhibit without images and tracks.

    Missing properties default to recovered points without sigma and score. Swept and filled points become a
    separate cloud.

    Raises:
        ValueError: no PLY (text or binary little-endian) with x, y and z, or a truncated file.
    """
    vertex, header, *_ = read_ply_vertices(path)
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
    up = _read_up(header)
    xyz = xyz if up is None else (xyz @ turn_between(up).T.numpy()).astype(np.float32)
    grey = np.full(n, 128, np.uint8)
    rgb = np.stack([vertex[c] if c in properties else grey for c in ("red", "green", "blue")], -1)
    swept_only = is_swept(source)
    columns = (*column.values(), source.astype(np.uint8))
    swept = SweptPointCloud(xyz[swept_only], rgb[swept_only].astype(np.uint8), *(x[swept_only] for x in columns))
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


def _read_up(header: bytes) -> list[float] | None:
    """Upward direction from the header comment ``up``, None without one."""
    match = re.search(r"^comment up (\S+) (\S+) (\S+)$", header.decode("ascii", "replace"), re.MULTILINE)
    try:
        up = [float(v) for v in match.groups()] if match else []
    except ValueError:
        return None
    return up if np.isfinite(up).all() and np.linalg.norm(up) > 0 else None
