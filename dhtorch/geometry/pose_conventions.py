"""Conventions of camera poses: a relative pose → its readings under other axes, as the inverse, in other units.

Alphabet: ``M`` takes our camera axes (x right, y down, z forward) to those of another convention, so that a relative
motion ``T`` in the other axes is Mᵀ T M in ours. The numbers alone do not determine the convention; near returns do.
"""

import itertools

import torch
from torch import Tensor

from dhtorch.geometry import se3
from dhtorch.geometry.checks import shaped
from dhtorch.geometry.se3 import Pose

#: Camera axes in which poses are written, as rows of M.
CAMERA_AXES: dict[str, tuple[tuple[int, int, int], ...]] = {
    "": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "OpenGL axes (x right, y up, z backward)": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "left-handed axes (x right, y up, z forward)": ((1, 0, 0), (0, -1, 0), (0, 0, 1)),
    "robot axes (x forward, y left, z up)": ((0, 0, 1), (-1, 0, 0), (0, -1, 0)),
    "axes of a picture turned by a quarter": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "axes of a picture turned by half": ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    "axes of a picture turned by three quarters": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
}

#: Directions of a pose: as stated, or its inverse.
POSE_DIRECTIONS = ("", "the inverse")

#: Metres per unit of a translation.
#: Source: derived, SI prefixes.
TRANSLATION_UNITS = {"": 1.0, "millimetres": 1e-3, "centimetres": 1e-2}

_COMBINATIONS = sorted(
    itertools.product(CAMERA_AXES, POSE_DIRECTIONS, TRANSLATION_UNITS),
    key=lambda parts: sum(bool(part) for part in parts),
)

#: Names of the readings, the simplest first; the first is the pose as stated.
CONVENTIONS = tuple(", ".join(part for part in parts if part) for parts in _COMBINATIONS)

#: Names of the camera axes that can be stated, and their M.
STATED_AXES = {"cv": CAMERA_AXES[""], "gl": CAMERA_AXES["OpenGL axes (x right, y up, z backward)"]}


@shaped("T.R: B 3 3, T.t: B 3, other_way.R: B 3 3, other_way.t: B 3")
def pose_hypotheses(
    T: Pose,  # (B,), as stated
    other_way: Pose,  # (B,), with every pose that it is computed from inverted
) -> Pose:
    """Motions (B, K) of the stated numbers under each of the K :data:`CONVENTIONS`.

    Raises:
        ValueError: wrong shapes.

    Gradient: to both.
    """
    hypotheses = []
    for axes, direction, unit in _COMBINATIONS:
        motion = motion_from_axes(other_way if direction else T, CAMERA_AXES[axes])
        hypotheses.append(Pose(motion.R, motion.t * TRANSLATION_UNITS[unit]))
    return Pose(torch.stack([m.R for m in hypotheses], 1), torch.stack([m.t for m in hypotheses], 1))


def motion_from_axes(T: Pose, axes: tuple[tuple[int, int, int], ...]) -> Pose:
    """A motion (B,) between cameras with ``axes``, converted to our camera axes. Gradient: to the motion."""
    M = _axes_matrix(axes, T.R)
    return Pose(M.T @ T.R @ M, (M.T @ T.t[..., None])[..., 0])


def pose_from_axes(T_world_from_cam: Pose, axes: tuple[tuple[int, int, int], ...]) -> Pose:
    """The pose (B,) of a camera with ``axes``, converted to our camera axes. Gradient: to the pose."""
    return T_world_from_cam.replace(R=T_world_from_cam.R @ _axes_matrix(axes, T_world_from_cam.R))


@shaped("T_world_from_1.R: B 3 3, cov_0: B 6 6, cov_1: B 6 6")
def relative_covariance(
    T_world_from_1: Pose,  # (B,)
    cov_0: Tensor,  # (B, 6, 6) of the left perturbation of T_world_from_0
    cov_1: Tensor,  # (B, 6, 6) of the left perturbation of T_world_from_1
) -> Tensor:
    """Covariance (B, 6, 6) of T_1_from_0 of two poses in one world whose errors are independent.

    Gradient: to all. Raises ValueError for wrong shapes.
    """
    A = se3.adjoint(se3.invert(T_world_from_1))
    return A @ (cov_0 + cov_1) @ A.mT


def _axes_matrix(axes: tuple[tuple[int, int, int], ...], like: Tensor) -> Tensor:
    return torch.tensor(axes, dtype=like.dtype, device=like.device)
