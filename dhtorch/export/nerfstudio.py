"""Writer of nerfstudio data: ``transforms.json`` beside images, depth and confidence.

Pixel centres are at integers here and at half-integers in nerfstudio, whose cameras look along −z, with y up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

#: Transformation from OpenCV camera axes to those of OpenGL.
_GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])

#: Step in m of the depth images: nerfstudio's ``depth_unit_scale_factor``.
DEPTH_UNIT_M = 1e-3

#: Relative sigma whose confidence is one half.
_HALF_CONFIDENCE_SIGMA = 0.1

#: nerfstudio's names of the first distortion coefficients, in OpenCV's order.
_LENS_NAMES = ("k1", "k2", "p1", "p2", "k3")


def make_nerfstudio_frame(
    stem: str,
    hw: Sequence[int],
    K: np.ndarray,  # (3, 3), pixel centres at integers
    T_world_from_cam: np.ndarray,  # (4, 4), OpenCV axes
    lens: Sequence[float] = (),  # OpenCV's order
    time: float = math.nan,  # s, NaN = none
) -> dict[str, Any]:
    """One entry of ``frames`` in a ``transforms.json``.

    ``timestamp`` and ``dhtorch_source_file_path`` (codes.Source of every depth) are no fields of nerfstudio, which
    ignores them; NeRFCapture writes the first, too.

    Raises:
        ValueError: more distortion coefficients than nerfstudio has.
    """
    if any(lens[len(_LENS_NAMES) :]):
        raise ValueError(f"nerfstudio: found {len(lens)} distortion coefficients, expected {' '.join(_LENS_NAMES)}")
    return {
        "file_path": f"images/{stem}.png",
        "depth_file_path": f"depth/{stem}.png",
        "confidence_file_path": f"confidence/{stem}.png",
        "dhtorch_source_file_path": f"source/{stem}.png",
        "w": int(hw[1]),
        "h": int(hw[0]),
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2]) + 0.5,
        "cy": float(K[1, 2]) + 0.5,
        **{name: float(x) for name, x in zip(_LENS_NAMES, lens, strict=False)},
        **({"timestamp": float(time)} if math.isfinite(time) else {}),
        "transform_matrix": (np.asarray(T_world_from_cam, np.float64) @ _GL_FROM_CV).tolist(),
    }


def quantise_nerfstudio_depth(depth: np.ndarray) -> np.ndarray:
    """Depth (h, w) in m → uint16 steps, 0 = no depth; depths beyond the last step become 0."""
    z = np.rint(np.asarray(depth, np.float64) / DEPTH_UNIT_M)
    return np.where((z >= 1) & (z <= 65534), z, 0).astype(np.uint16)


def encode_confidence(depth: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Depth and sigma (h, w) in m → confidence (h, w) uint8, 0 = no depth.

    255 · s / (s + sigma / depth), at least 1, with s = :data:`_HALF_CONFIDENCE_SIGMA`.
    """
    valid = depth > 0
    ratio = np.where(valid, sigma, 1) / np.where(valid, depth, 1)
    return np.where(valid, np.rint(255 * _HALF_CONFIDENCE_SIGMA / (_HALF_CONFIDENCE_SIGMA + ratio)).clip(1), 0).astype(
        np.uint8
    )
