"""A posed recording as nerfstudio reads it: ``transforms.json`` beside pictures, depth and confidence.

Pixel centres stand at whole numbers here and at halves there; cameras look along −z there, with y upwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

#: Camera axes of OpenGL from those of OpenCV.
_GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])

#: m, a step of the depth pictures: nerfstudio's ``depth_unit_scale_factor``.
_DEPTH_UNIT_M = 1e-3

#: Relative sigma at which confidence is one half.
_HALF_CONFIDENCE_SIGMA = 0.1

#: Names of a lens's first numbers, in OpenCV's order.
_LENS_NAMES = ("k1", "k2", "p1", "p2", "k3")


def make_nerfstudio_frame(
    stem: str,
    hw: Sequence[int],
    K: np.ndarray,  # (3, 3), whole numbers are pixel centres
    T_world_from_cam: np.ndarray,  # (4, 4), OpenCV axes
    lens: Sequence[float] = (),  # OpenCV's order
) -> dict[str, Any]:
    """One of the ``frames`` of a ``transforms.json``.

    Raises:
        ValueError: a lens with more numbers than nerfstudio's.
    """
    if any(lens[len(_LENS_NAMES) :]):
        raise ValueError(f"nerfstudio: found a lens of {len(lens)} numbers, expected {' '.join(_LENS_NAMES)}")
    return {
        "file_path": f"images/{stem}.png",
        "depth_file_path": f"depth/{stem}.png",
        "confidence_file_path": f"confidence/{stem}.png",
        "w": int(hw[1]),
        "h": int(hw[0]),
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2]) + 0.5,
        "cy": float(K[1, 2]) + 0.5,
        **{name: float(x) for name, x in zip(_LENS_NAMES, lens, strict=False)},
        "transform_matrix": (np.asarray(T_world_from_cam, np.float64) @ _GL_FROM_CV).tolist(),
    }


def make_transforms(shots: Sequence[Mapping[str, Any]], **more: Any) -> dict[str, Any]:
    """``transforms.json``; ``more`` is what else it says, which nerfstudio passes over."""
    return {
        "camera_model": "OPENCV",
        "depth_unit_scale_factor": _DEPTH_UNIT_M,
        **more,
        "frames": [dict(s) for s in shots],
    }


def quantise_nerfstudio_depth(depth: np.ndarray) -> np.ndarray:
    """(h, w) uint16 of metres, 0 = none; what is beyond the last step becomes none."""
    z = np.rint(np.asarray(depth, np.float64) / _DEPTH_UNIT_M)
    return np.where((z >= 1) & (z <= 65534), z, 0).astype(np.uint16)


def encode_confidence(depth: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """(h, w) uint8 of depth and sigma in m: 255 is sure, one half of it a relative sigma of
    :data:`_HALF_CONFIDENCE_SIGMA`, 0 none."""
    known = depth > 0
    ratio = np.where(known, sigma, 1) / np.where(known, depth, 1)
    return np.where(known, np.rint(255 * _HALF_CONFIDENCE_SIGMA / (_HALF_CONFIDENCE_SIGMA + ratio)).clip(1), 0).astype(
        np.uint8
    )
