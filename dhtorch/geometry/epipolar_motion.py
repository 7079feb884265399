"""Motion up to scale from rays and tracks without depth, by distances to epipolar lines.

Alphabet: ``x``, ``y`` unit rays (B, 3, N) of view 0 and view 1; ``b`` = Rᵀ y; ``s`` unit direction (B, 3) of the
translation in axes of view 0, for which s · (x × b) = 0.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry import se3
from dhtorch.geometry.checks import shaped
from dhtorch.geometry.covariance import masked_median
from dhtorch.geometry.least_squares import robust_loss
from dhtorch.geometry.reprojection_problem import MEDIAN_1D
from dhtorch.geometry.se3 import Pose


class EpipolarMotion(NamedTuple):
    """Result of :func:`fit_epipolar_motion`."""

    T: Pose  # view 1 from view 0, |t| = 1
    noise_px: Tensor  # (B,) standard deviation of the distances to the epipolar lines
    inlier: Tensor  # (B, N) bool


@shaped("x: B 3 N, y: B 3 N, used: B N, R: B 3 3")
def fit_epipolar_motion(
    x: Tensor,  # (B, 3, N) rays of view 0, any length
    y: Tensor,  # (B, 3, N) rays of view 1, any length
    used: Tensor,  # (B, N) bool
    R: Tensor,  # (B, 3, 3) start, e.g. the pure rotation that fits best
    f_px: Tensor,  # (B,) focal length that turns angles into px
    bend_px: Tensor,  # (B,) bend of the robust kernel at the end
) -> EpipolarMotion:
    """Rotation and direction of translation that minimise robust distances to epipolar lines, in float64.

    The first direction is that of least squares under the start's rotation; steps on five unknowns follow while the
    kernel narrows. The sign is that which puts most points in front of both cameras.

    Raises:
        ValueError: wrong shapes.

    Gradient: none.
    """
    x, y = F.normalize(x, dim=1), F.normalize(y, dim=1)
    weight = used.to(x.dtype)
    b = R.mT @ y
    a = torch.linalg.cross(x, b, dim=1)
    s = torch.linalg.eigh((a * weight[:, None]) @ a.mT).eigenvectors[..., 0]  # of the smallest eigenvalue
    distance = torch.zeros_like(weight)
    # Steps of the search for a direction of translation, a count. Source: chosen on built-in rooms of seeds 40 and
    # 41.
    for k in range(15):
        # Bend of the robust kernel at the first of them, px, half as wide at each further one. Source: chosen on
        # built-in rooms of seeds 40 and 41.
        bend = bend_px[:, None].clamp_min(16.0 / 2**k)
        e = (s[:, None] @ a)[:, 0]
        # Least sine between a ray and the translation: nearer ones have no epipolar line. Source: derived, 3 degrees.
        sine = torch.linalg.cross(s[..., None].expand_as(x), x, dim=1).norm(dim=1).clamp_min(0.05)
        distance = f_px[:, None] * e / sine
        _, robust = robust_loss((distance / bend).square(), "geman_mcclure", 1.0)
        weight = torch.where(used, robust / sine**2, 0.0)
        R, s = _epipolar_step(x, b, a, s, weight, R=R)
        b = R.mT @ y
        a = torch.linalg.cross(x, b, dim=1)
    ahead = ((b - x * (x * b).sum(1, keepdim=True)) * s[..., None] * weight[:, None]).sum((1, 2))
    s = torch.where(ahead[:, None] < 0, -s, s)  # points lie in front of both cameras
    # Largest distance of an inlier, px. Source: derived, three times the last bend of a fit with depth.
    inside = used & (distance.abs() < 3.0)
    noise = masked_median(distance.abs(), inside)[:, 0] / MEDIAN_1D
    # Length of an inlier's distance, in standard deviations. Source: derived, one in 370 Gaussian numbers lies
    # beyond.
    inlier = inside & (distance.abs() < 3.0 * noise[:, None])
    return EpipolarMotion(Pose(R, (R @ s[..., None])[..., 0]), noise, inlier)


def _epipolar_step(x: Tensor, b: Tensor, a: Tensor, s: Tensor, weight: Tensor, *, R: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation and direction after a Gauss-Newton step on s · (x × b), a = x × b."""
    tangent = torch.linalg.svd(s[:, None]).Vh[:, 1:]  # (B, 2, 3)
    dot = (x * b).sum(1, keepdim=True)
    J = torch.cat((x * (s[:, None] @ b) - s[..., None] * dot, tangent @ a), 1)
    H = (J * weight[:, None]) @ J.mT
    # Damping of these steps, a fraction of the trace.
    damping = 1e-9 * H.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None] + 1e-300
    H = H + damping * torch.eye(5, dtype=x.dtype, device=x.device)
    step = torch.linalg.solve_ex(H, (J * (weight * (s[:, None] @ a)[:, 0])[:, None]).sum(-1))[0]
    R = R @ se3.exp(F.pad(-step[:, :3], (0, 3))).R
    return R, F.normalize(s - (step[:, None, 3:] @ tangent)[:, 0], dim=-1)
