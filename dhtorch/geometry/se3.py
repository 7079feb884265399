"""Rigid motions SE(3): poses, composition, exponential map, logarithm, adjoint.

Alphabet: ``T_b_from_a`` maps points of frame a into frame b, ``x_b = R x_a + t``; adjacent frame names match when
chained: ``compose(T_c_from_b, T_b_from_a)``. Tangent ``xi = (rotation rad, translation m)``; perturbation on the left,
``T ← exp(xi) · T``. kornia's ``Se3`` puts translation first; the order is changed in :func:`exp` alone.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from dhtorch.geometry.checks import shaped
from dhtorch.geometry.determinism import pad_elementwise
from dhtorch.pytree import Record, record

if TYPE_CHECKING:
    from kornia.geometry.liegroup import Se3


@record
class Pose(Record):
    """A batch of B rigid motions."""

    R: Tensor  # (B, 3, 3)
    t: Tensor  # (B, 3) m

    @classmethod
    def from_kornia(cls, motion: Any) -> "Pose":
        """A ``kornia.geometry.liegroup.Se3``, or ``T_cam_from_world`` of a ``kornia.geometry.camera.PinholeCamera``.

        Gradient: to the motion.
        """
        extrinsics = getattr(motion, "extrinsics", None)
        return cls(motion.so3.matrix(), motion.t) if extrinsics is None else from_matrix(extrinsics)

    def to_kornia(self) -> "Se3":
        """As a ``kornia.geometry.liegroup.Se3``, whose tangents have the translation first, here it is last.

        Gradient: to the motion.
        """
        from kornia.geometry.liegroup import Se3, So3  # noqa: PLC0415  (imported where it is used: 0.2 s)

        return Se3(So3.from_matrix(self.R), self.t)


def identity(batch: int, like: Tensor) -> Pose:
    """Identity poses (``batch``,) with the device and dtype of ``like``."""
    eye = torch.eye(3, dtype=like.dtype, device=like.device)
    return Pose(eye.expand(batch, 3, 3), torch.zeros(batch, 3, dtype=like.dtype, device=like.device))


def from_matrix(T: Tensor) -> Pose:
    """Pose of matrices (B, 4, 4) or (B, 3, 4)."""
    return Pose(T[..., :3, :3], T[..., :3, 3])


def to_matrix(T: Pose) -> Tensor:
    """Matrices (B, 4, 4) of a pose, by kornia."""
    from kornia.geometry.conversions import Rt_to_matrix4x4  # noqa: PLC0415

    return Rt_to_matrix4x4(T.R, T.t[..., None])


@shaped("T.R: B 3 3, xyz: B N 3", "se3.apply")
def apply(T: Pose, xyz: Tensor) -> Tensor:
    """Points (B, N, 3) of the source frame in the target frame."""
    return rotate(T.R, xyz) + T.t[:, None]


def rotate(R: Tensor, xyz: Tensor) -> Tensor:
    """Rotated points (B, N, 3): R (B, 3, 3) times each point.

    Written out instead of a matrix product, so that rounding cannot depend on the batch size.
    """
    x, y, z = xyz[..., 0:1], xyz[..., 1:2], xyz[..., 2:3]
    return x * R[:, None, :, 0] + y * R[:, None, :, 1] + z * R[:, None, :, 2]


def compose(T_c_from_b: Pose, T_b_from_a: Pose) -> Pose:
    """Composition ``T_c_from_a``."""
    t = (T_c_from_b.R @ T_b_from_a.t[..., None])[..., 0] + T_c_from_b.t
    return Pose(T_c_from_b.R @ T_b_from_a.R, t)


def invert(T_b_from_a: Pose) -> Pose:
    """Inverse ``T_a_from_b``."""
    R = T_b_from_a.R.transpose(-1, -2)
    return Pose(R, -(R @ T_b_from_a.t[..., None])[..., 0])


def relative(T_world_from_a: Pose, T_world_from_b: Pose) -> Pose:
    """Relative pose ``T_b_from_a`` of two poses in one world."""
    return compose(invert(T_world_from_b), T_world_from_a)


def orthonormal(R: Tensor) -> Tensor:
    """Rotations (B, 3, 3) of nearly orthonormal matrices R, by Gram-Schmidt: removes rounding drift. Gradient: to R."""
    x = R[:, 0] / (R[:, 0] * R[:, 0]).sum(-1, keepdim=True).sqrt()
    z = torch.linalg.cross(x, R[:, 1])
    z = z / (z * z).sum(-1, keepdim=True).sqrt()
    return torch.stack((x, torch.linalg.cross(z, x), z), 1)


def hat(v: Tensor) -> Tensor:
    """Cross-product matrix (…, 3, 3) of vectors (…, 3): ``hat(v) @ w = v × w``, by kornia."""
    from kornia.geometry.liegroup import So3  # noqa: PLC0415

    return So3.hat(v)


@shaped("xi: B 6", "se3.exp")
def exp(xi: Tensor) -> Pose:
    """Exponential map: Pose of tangents (B, 6), rotation vector (rad) then translation part (m).

    Closed form with series below 0.1 rad, so that value and gradient are exact at zero as well. Equal to
    ``kornia.geometry.liegroup.Se3.exp`` of the reordered vector (``tests/geometry/test_kornia.py``).
    """
    omega, upsilon = xi[..., :3], xi[..., 3:]
    theta2 = (omega * omega).sum(-1)[..., None, None]
    small = theta2 < 1e-2
    safe2 = torch.where(small, torch.ones_like(theta2), theta2)
    theta = safe2.sqrt()
    a = torch.where(
        small, 1 - theta2 / 6 * (1 - theta2 / 20 * (1 - theta2 / 42)), pad_elementwise(torch.sin, theta) / theta
    )
    b = torch.where(
        small,
        0.5 - theta2 / 24 * (1 - theta2 / 30 * (1 - theta2 / 56)),
        (1 - pad_elementwise(torch.cos, theta)) / safe2,
    )
    c = torch.where(small, (1 - theta2 / 20 * (1 - theta2 / 42 * (1 - theta2 / 72))) / 6, (1 - a) / safe2)
    W = hat(omega)
    # W² = ω ωᵀ − θ² I saves a product and keeps the result exactly symmetric.
    eye = torch.eye(3, dtype=xi.dtype, device=xi.device)
    W2 = omega[..., :, None] * omega[..., None, :] - theta2 * eye
    V = eye + b * W + c * W2
    return Pose(eye + a * W + b * W2, (V @ upsilon[..., None])[..., 0])


@shaped("T.R: B 3 3, T.t: B 3", "se3.log")
def log(T: Pose) -> Tensor:
    """Logarithm (B, 6), rotation vector (rad) then translation part (m): ``exp(log(T))`` is T, for rotations below π.

    Gradient: to the pose, exact at zero rotation as well. Near π the axis is lost to rounding.
    """
    R = T.R
    axis = 0.5 * _rotation_axis(R)
    sin2 = (axis * axis).sum(-1, keepdim=True)
    cos = 0.5 * (R.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1)
    small = (sin2 < 1e-4) & (cos > 0)
    sin = torch.where(small, torch.ones_like(sin2), sin2).sqrt()
    theta = pad_elementwise(torch.atan2, sin, torch.where(small, torch.zeros_like(cos), cos))
    omega = axis * torch.where(small, 1 + sin2 * (1 / 6 + sin2 * (3 / 40 + sin2 * (5 / 112))), theta / sin)
    theta2 = (omega * omega).sum(-1)[..., None, None]
    half = 0.5 * torch.where(small, torch.ones_like(theta), theta)
    cotangent = pad_elementwise(torch.cos, half) / pad_elementwise(torch.sin, half)
    whole = (1 - half * cotangent)[..., None] / torch.where(small[..., None], torch.ones_like(theta2), theta2)
    square = torch.where(small[..., None], (1 + theta2 / 60 * (1 + theta2 / 42)) / 12, whole)
    W = hat(omega)
    W_t = (W @ T.t[..., None])[..., 0]
    W2_t = (W @ W_t[..., None])[..., 0]
    return torch.cat((omega, T.t - 0.5 * W_t + square[..., 0] * W2_t), -1)


@shaped("T.R: B 3 3, T.t: B 3", "se3.adjoint")
def adjoint(T: Pose) -> Tensor:
    """Adjoint (B, 6, 6), which transports tangents through a motion: ``T · exp(xi) = exp(adjoint(T) @ xi) · T``.

    Gradient: to the pose.
    """
    top = torch.cat((T.R, torch.zeros_like(T.R)), -1)
    return torch.cat((top, torch.cat((hat(T.t) @ T.R, T.R), -1)), -2)


@shaped("T.R: B 3 3, T.t: B 3, xi: B 6", "se3.retract")
def retract(T: Pose, xi: Tensor) -> Pose:
    """Retraction ``exp(xi) · T`` for tangents (B, 6)."""
    return compose(exp(xi), T)


def rotation_angle(R: Tensor) -> Tensor:
    """Angle (…,) in rad of rotation matrices (…, 3, 3); accurate at zero and at π."""
    axis = _rotation_axis(R)
    trace = R.diagonal(dim1=-2, dim2=-1).sum(-1)
    return pad_elementwise(torch.atan2, axis.norm(dim=-1), trace - 1)


def turn_between(up: Sequence[float], to: Sequence[float] = (0.0, -1.0, 0.0)) -> Tensor:
    """The smallest rotation (3, 3) that takes ``up`` to ``to``; a rotation by π is about x.

    Raises:
        ValueError: a direction of zero length.
    """
    a, b = (torch.tensor(list(v), dtype=torch.float64) for v in (up, to))
    if not (float(a.norm()) > 0 and float(b.norm()) > 0):
        raise ValueError(f"up: found {list(up)}, expected a direction of three numbers")
    a, b = a / a.norm(), b / b.norm()
    if float(a @ b) < -1 + 1e-9:
        return torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    v = torch.linalg.cross(a, b)
    K = torch.zeros(3, 3, dtype=torch.float64)
    K[0, 1], K[0, 2], K[1, 2] = -v[2], v[1], -v[0]
    K = K - K.T
    return torch.eye(3, dtype=torch.float64) + K + K @ K / (1 + a @ b)


def _rotation_axis(R: Tensor) -> Tensor:
    """The axis of rotations (…, 3, 3) times twice the sine of their angle."""
    return torch.stack((R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]), -1)
