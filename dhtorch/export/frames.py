"""Depth maps as PNG files, and what makes a folder of them a recording that :mod:`dhtorch.data` reads again.

A PNG of 16 bits holds whole steps of a stated length, 0 is *no depth*. What such a file cannot hold is left out and
told, never cut off: beyond the last step, or nearer than the first one.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from dhtorch.codes import Source
from dhtorch.export.arrays import rotation_to_wxyz, to_numpy
from dhtorch.geometry import se3
from dhtorch.geometry.camera import to_matrix
from dhtorch.records import Camera, Pose
from dhtorch.runtime import storage

#: The last step: 65535 is *no return* to readers of several sets.
MAX_DEPTH_CODE = 65534

#: Steps of sigma in one of depth: sigma is a small share of the depth.
SIGMA_STEPS_PER_DEPTH_STEP = 5


class QuantisedDepth(NamedTuple):
    """A map in whole steps, (h, w) each; 0 = no depth."""

    depth: np.ndarray  # uint16
    sigma: np.ndarray  # uint16, SIGMA_STEPS to a step of depth; 1 at least
    source: np.ndarray  # uint8, codes.Source
    unfit: np.ndarray  # bool: there is a depth, which the steps cannot hold, or its sigma


def quantise_depth(
    depth: Any,  # (h, w) m, NaN = silent
    sigma: Any,  # (h, w) m
    source: Any,  # (h, w) codes.Source
    unit: float,  # m, a step of depth
) -> QuantisedDepth:
    """A map in steps, each value at the nearest one; a sigma below one step becomes one, as none is sure.

    Raises:
        ValueError: shapes that differ.
    """
    z, s = (
        to_numpy(x).astype(np.float64) / step for x, step in ((depth, unit), (sigma, unit / SIGMA_STEPS_PER_DEPTH_STEP))
    )
    code = to_numpy(source)
    if not z.shape == s.shape == code.shape:
        raise ValueError(f"quantise_depth: found shapes {z.shape}, {s.shape}, {code.shape}, expected three alike")
    z = z.round()
    s = s.round().clip(1)
    wanted = code != Source.NONE
    fits = wanted & (z >= 1) & (z <= MAX_DEPTH_CODE) & (s <= MAX_DEPTH_CODE)
    return QuantisedDepth(
        depth=np.where(fits, z, 0).astype(np.uint16),
        sigma=np.where(fits, s, 0).astype(np.uint16),
        source=np.where(fits, code, Source.NONE).astype(np.uint8),
        unfit=wanted & ~fits,
    )


def mesh_depth_map(
    depth: np.ndarray,  # (h, w) m, 0 or NaN where nothing is known
    step: float = 0.03,
) -> np.ndarray:
    """Triangles (F, 3) between neighbouring pixels, numbered row by row, whose depths differ by less than a share
    ``step``: across a larger one there is no surface."""
    h, w = depth.shape
    number = np.arange(h * w).reshape(h, w)
    a, b, c, d = (number[i : h - 1 + i, j : w - 1 + j].ravel() for i in (0, 1) for j in (0, 1))
    corners = np.concatenate((np.stack((a, c, b), 1), np.stack((b, c, d), 1)))
    z = np.where(depth > 0, depth, np.nan).ravel()[corners]
    return corners[z.max(1) < (1 + step) * z.min(1)]


def encode_png(
    pixels: np.ndarray,  # (h, w) uint8 or uint16, or (h, w, 3) uint8
) -> bytes:
    """The bytes of a PNG file; nothing is lost."""
    from PIL import Image  # noqa: PLC0415  (comes with matplotlib)

    out = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(out, "PNG")
    return out.getvalue()


def write_frames_dir_metadata(
    folder: str | Path,
    camera: Camera,  # B = 1
    T_world_from_cam: Pose,  # (n), in the order of the pictures' names
    *,
    unit: float,  # m, a step of depth
    fps: float | None = None,
) -> list[Path]:
    """What makes ``images/`` and ``depth/`` a recording of the reader ``frames_dir``: K.txt, meta.json, poses.txt."""
    K = to_matrix(camera)[0].double().tolist()
    lens = {} if camera.distortion is None else {"dist": camera.distortion[0].tolist()}
    rate = {} if fps is None else {"fps": fps}
    side = {"K": K, **lens, "depth_scale": 1 / unit, "invalid": [0], **rate}
    return [
        _write_rows(Path(folder) / "K.txt", K),
        storage.write_json(Path(folder) / "meta.json", side),
        _write_rows(Path(folder) / "poses.txt", se3.to_matrix(T_world_from_cam).double().flatten(1).tolist()),
    ]


def write_tum_metadata(
    folder: str | Path,
    camera: Camera,  # B = 1
    stamps: Sequence[str],  # as in the names of the pictures, s
    T_world_from_cam: Pose | None = None,  # (n); poses that are not finite are left out
) -> list[Path]:
    """What makes ``rgb/`` and ``depth/`` a recording of the reader ``tum``: meta.json, and groundtruth.txt for poses.

    The folder's name says which camera's published calibration counts (``freiburg1``, ``fr1``); elsewhere meta.json.
    """
    folder = Path(folder)
    lens = torch.zeros(1, 5) if camera.distortion is None else camera.distortion
    side = {"K": to_matrix(camera)[0].double().tolist(), "dist": lens[0].tolist()}
    written = [storage.write_json(folder / "meta.json", side)]
    if T_world_from_cam is None:
        return written
    T = T_world_from_cam.map(lambda x: x.double())
    known = [k for k in range(len(stamps)) if bool(T.t[k].isfinite().all() and T.R[k].isfinite().all())]
    rows = []
    for k in known:
        w, *xyz = rotation_to_wxyz(T.R[k])
        rows.append([float(stamps[k]), *T.t[k].tolist(), *xyz, w])
    head = "# timestamp tx ty tz qx qy qz qw"
    return [*written, _write_rows(folder / "groundtruth.txt", rows, head)]


def _write_rows(path: Path, rows: Sequence[Sequence[float]], *head: str) -> Path:
    """Numbers as text, a row a line, every digit kept."""
    lines = [*head, *(" ".join(f"{x:.17g}" for x in row) for row in rows)]
    return storage.replace_file(path, ("\n".join(lines) + "\n").encode())
