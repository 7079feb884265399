"""Writer of depth maps as 16-bit PNG, with the metadata by which :mod:`dhtorch.data` reads the folder as a recording.

A 16-bit PNG holds multiples of a step, 0 is *no depth*. Depths out of range (beyond the last step or nearer than the
first) are left out and reported, not clipped.
"""

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

#: Largest depth code: 65535 means *no return* in several data sets.
MAX_DEPTH_CODE = 65534

#: Steps of sigma per step of depth: sigma is a small fraction of the depth.
SIGMA_STEPS_PER_DEPTH_STEP = 5


class QuantisedDepth(NamedTuple):
    """A depth map in integer steps, (h, w) each; 0 = no depth."""

    depth: np.ndarray  # uint16
    sigma: np.ndarray  # uint16, SIGMA_STEPS_PER_DEPTH_STEP per step of depth; at least 1
    source: np.ndarray  # uint8, codes.Source
    unfit: np.ndarray  # bool: depth or sigma out of the range of the codes


def quantise_depth(
    depth: Any,  # (h, w) m, NaN = no answer
    sigma: Any,  # (h, w) m
    source: Any,  # (h, w) codes.Source
    unit: float,  # m, a step of depth
) -> QuantisedDepth:
    """Depth and sigma in m → nearest steps; a sigma below one step becomes one, as no depth is exact.

    Raises:
        ValueError: unequal shapes.
    """
    z, s = (
        to_numpy(x).astype(np.float64) / step for x, step in ((depth, unit), (sigma, unit / SIGMA_STEPS_PER_DEPTH_STEP))
    )
    code = to_numpy(source)
    if not z.shape == s.shape == code.shape:
        raise ValueError(f"quantise_depth: found shapes {z.shape}, {s.shape}, {code.shape}, expected equal shapes")
    z = z.round()
    s = s.round().clip(1)
    answered = code != Source.NONE
    fits = answered & (z >= 1) & (z <= MAX_DEPTH_CODE) & (s <= MAX_DEPTH_CODE)
    return QuantisedDepth(
        depth=np.where(fits, z, 0).astype(np.uint16),
        sigma=np.where(fits, s, 0).astype(np.uint16),
        source=np.where(fits, code, Source.NONE).astype(np.uint8),
        unfit=answered & ~fits,
    )


def mesh_depth_map(
    depth: np.ndarray,  # (h, w) m, 0 or NaN = no depth
    step: float = 0.03,
) -> np.ndarray:
    """Depth map → triangles (F, 3) of neighbouring pixels, numbered row by row.

    Triangles whose depths differ by ``step`` (relative) or more are left out: no surface across discontinuities."""
    h, w = depth.shape
    number = np.arange(h * w).reshape(h, w)
    a, b, c, d = (number[i : h - 1 + i, j : w - 1 + j].ravel() for i in (0, 1) for j in (0, 1))
    corners = np.concatenate((np.stack((a, c, b), 1), np.stack((b, c, d), 1)))
    z = np.where(depth > 0, depth, np.nan).ravel()[corners]
    return corners[z.max(1) < (1 + step) * z.min(1)]


def encode_png(
    pixels: np.ndarray,  # (h, w) uint8 or uint16, or (h, w, 3) uint8
) -> bytes:
    """Pixels → the bytes of a PNG file, lossless."""
    from PIL import Image  # noqa: PLC0415  (comes with matplotlib)

    out = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(out, "PNG")
    return out.getvalue()


def write_frames_dir_metadata(
    folder: str | Path,
    camera: Camera,  # (n), or (1) for all
    T_world_from_cam: Pose,  # (n), in the order of the images' names
    *,
    unit: float,  # m, a step of depth
    fps: float | None = None,
    times: Sequence[float] | None = None,  # (n) s, where they are not frame number / fps
) -> list[Path]:
    """Write K.txt, meta.json, poses.txt beside ``images/`` and ``depth/``, as read by ``frames_dir``; their paths.

    ``K_frames`` (fx fy cx cy) and ``times`` of meta.json hold what changes from image to image; K.txt has no place for
    it.
    """
    K = to_matrix(camera)[0].double().tolist()
    distortion = {} if camera.distortion is None else {"dist": camera.distortion[0].tolist()}
    clock: dict[str, Any] = {} if fps is None else {"fps": fps}
    clock |= {} if times is None else {"times": list(times)}
    numbers = torch.cat((camera.f, camera.c), -1).double()
    each = {"K_frames": numbers.tolist()} if bool((numbers != numbers[:1]).any()) else {}
    side_car = {"K": K, **distortion, "depth_scale": 1 / unit, "invalid": [0], **clock, **each}
    return [
        _write_rows(Path(folder) / "K.txt", K),
        storage.write_json(Path(folder) / "meta.json", side_car),
        _write_rows(Path(folder) / "poses.txt", se3.to_matrix(T_world_from_cam).double().flatten(1).tolist()),
    ]


def write_tum_metadata(
    folder: str | Path,
    camera: Camera,  # B = 1
    stamps: Sequence[str],  # s, as in the images' names
    T_world_from_cam: Pose | None = None,  # (n); poses that are not finite are left out
    *,
    unit: float,  # m, a step of depth
) -> list[Path]:
    """Write meta.json, calibration.txt and, for poses, groundtruth.txt beside ``rgb/`` and ``depth/``; their paths.

    ``tum`` reads the camera from calibration.txt, which wins over a calibration published for the folder's name
    (``freiburg1``) but holds at most five coefficients of distortion; with more only meta.json is written.
    """
    folder = Path(folder)
    distortion = (torch.zeros(1, 5) if camera.distortion is None else camera.distortion)[0].tolist()
    K = to_matrix(camera)[0].double().tolist()
    side_car = {"K": K, "dist": distortion, "depth_scale": 1 / unit}
    written = [storage.write_json(folder / "meta.json", side_car)]
    if not any(distortion[5:]):
        lens = distortion[:5] if any(distortion) else []
        row = [K[0][0], K[1][1], K[0][2], K[1][2], *lens]
        written.append(_write_rows(folder / "calibration.txt", [row], "# fx fy cx cy, then k1 k2 p1 p2 k3 if any"))
    if T_world_from_cam is None:
        return written
    T = T_world_from_cam.map(lambda x: x.double())
    finite = [k for k in range(len(stamps)) if bool(T.t[k].isfinite().all() and T.R[k].isfinite().all())]
    rows = []
    for k in finite:
        w, *xyz = rotation_to_wxyz(T.R[k])
        rows.append([float(stamps[k]), *T.t[k].tolist(), *xyz, w])
    header = "# timestamp tx ty tz qx qy qz qw"
    return [*written, _write_rows(folder / "groundtruth.txt", rows, header)]


def _write_rows(path: Path, rows: Sequence[Sequence[float]], *header: str) -> Path:
    """Write numbers as text, one row per line, with all digits of float64."""
    lines = [*header, *(" ".join(f"{x:.17g}" for x in row) for row in rows)]
    return storage.replace_file(path, ("\n".join(lines) + "\n").encode())
