"""Helpers of the writers: tensors -> numpy arrays, colours -> uint8, and selection of finite points."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor


def to_numpy(x: Any) -> np.ndarray:
    """Tensor (detached and moved to the CPU) or any array-like → numpy array."""
    return x.detach().cpu().numpy() if hasattr(x, "detach") else np.asarray(x)


def check_rows(where: str, name: str, x: Any, n: int | None, width: int | None) -> np.ndarray:
    """``x`` as (n, width), or (n,) where ``width`` is None.

    Raises:
        ValueError: another shape.
    """
    values = to_numpy(x)
    shape = (len(values) if n is None and values.ndim else n, *([] if width is None else [width]))
    if values.shape != shape:
        expected = ", ".join("P" if s is None else str(s) for s in (n, *([] if width is None else [width])))
        raise ValueError(f"{where}: {name} has shape {values.shape}, expected ({expected})")
    return values


def colour_to_uint8(rgb: np.ndarray) -> np.ndarray:
    """Colours → uint8: uint8 is unchanged, floats in [0, 1] are clipped and rounded; NaN is black."""
    if rgb.dtype == np.uint8:
        return rgb
    return np.round(255 * np.clip(np.nan_to_num(rgb.astype(np.float64)), 0, 1)).astype(np.uint8)


def select_finite(xyz: np.ndarray, face: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
    """(mask (P,) of finite points, triangles of finite points, renumbered among these).

    Raises:
        ValueError: a triangle with a corner that does not exist.
    """
    finite = np.isfinite(xyz).all(1)
    if face is None:
        return finite, None
    if face.size and not (face.min() >= 0 and face.max() < len(xyz)):
        raise ValueError(f"export: face names points {face.min()} to {face.max()}, expected 0 to {len(xyz) - 1}")
    renumbered = np.cumsum(finite) - 1
    return finite, renumbered[face[finite[face].all(1)]] if face.size else face.reshape(0, 3)


def rotation_to_wxyz(
    R: Tensor,  # (3, 3)
) -> list[float]:
    """Rotation → quaternion w, x, y, z (kornia's order), w >= 0."""
    from kornia.geometry.conversions import rotation_matrix_to_quaternion  # noqa: PLC0415

    q = rotation_matrix_to_quaternion(R[None])[0]
    return (-q if q[0] < 0 else q).tolist()
