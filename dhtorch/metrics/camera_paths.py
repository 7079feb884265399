"""Poses of the same cameras in two worlds -> the similarity between these, with a covariance."""

from __future__ import annotations

import numpy as np
import torch

from dhtorch.geometry import se3
from dhtorch.geometry.se3 import Pose
from dhtorch.metrics.grouped import covariance_of_mean, mad_sigma


def align_camera_paths(
    own: np.ndarray,  # (F, 4, 4) camera to world, m
    other: np.ndarray,  # (F, 4, 4) camera to the other world, its units
    scale: float,  # m per unit
    sigma: float,  # of log(scale)
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rigid part of the similarity x_own = scale · R x_other + t for a known scale, by medians over the cameras.

    Returns:
        R (3, 3), t (3,) m, and the covariance (7, 7) of rotation (rad, on the left), translation (m) and log(scale).
        An error of rotation or scale moves t by the lever of the cameras' centre.
    """
    turns = own[:, :3, :3] @ other[:, :3, :3].transpose(0, 2, 1)
    u, _, vt = np.linalg.svd(np.median(turns, 0))
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    turned = scale * other[:, :3, 3] @ R.T
    offset = own[:, :3, 3] - turned
    rest = torch.from_numpy(turns @ R.T)
    omega = se3.log(Pose(rest, torch.zeros(len(rest), 3, dtype=torch.float64)))[:, :3].numpy()
    centre = turned.mean(0)
    cov = np.zeros((7, 7))
    cov[:3, :3], cov[6, 6] = covariance_of_mean(omega), sigma**2
    lever = np.concatenate((se3.hat(torch.from_numpy(centre)).numpy(), np.zeros((3, 3)), -centre[:, None]), 1)
    cov[3:6] = lever @ cov
    cov[:, 3:6] = cov[3:6].T
    cov[3:6, 3:6] = lever[:, [0, 1, 2, 6]] @ cov[np.ix_([0, 1, 2, 6], [3, 4, 5])] + covariance_of_mean(offset)
    return R, np.median(offset, 0), cov


def scale_of_camera_paths(
    own: np.ndarray,  # (F, 4, 4)
    other: np.ndarray,  # (F, 4, 4)
) -> tuple[float, float] | None:
    """Metres per unit by the paths alone and its relative scatter: distances of cameras a half of the path apart; None
    where fewer than three of them moved."""
    half = len(own) // 2
    a, b = (np.linalg.norm(c[half:, :3, 3] - c[: len(c) - half, :3, 3], axis=1) for c in (own, other))
    ok = (a > 0) & (b > 0)
    if ok.sum() < 3:
        return None
    ratio = np.log(a[ok] / b[ok])
    return float(np.exp(np.median(ratio))), float(mad_sigma(ratio))
