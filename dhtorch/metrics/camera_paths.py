"""Poses of the same cameras in two worlds -> the similarity between these; measured motions -> errors of a path."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from dhtorch.geometry import se3
from dhtorch.geometry.se3 import Pose
from dhtorch.metrics.grouped import N_STRETCHES, covariance_of_mean


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


class CameraMotions(NamedTuple):
    """P measured motions between cameras of a path, ordered by the first camera."""

    first: np.ndarray  # (P,) int, places on the path
    second: np.ndarray  # (P,) int, later ones
    T: np.ndarray  # (P, 4, 4) second camera from first, m
    cov: np.ndarray  # (P, 6, 6) of the left perturbation (rotation rad, translation m), up to a common factor


class _PathDifference(NamedTuple):
    """A path against measured motions between its cameras."""

    length: float  # the path's over the measured one, if nothing else is wrong
    length_sigma: float
    curl: np.ndarray  # (3,) rad, rotation from the first to the last camera that was not measured, likewise
    curl_sigma: float  # rad, of its length
    is_curl: bool  # whether the curl fits better than the length
    shift: np.ndarray  # (P,) m, by which a second camera is off if its rotation is right; without the better of the two
    turn: np.ndarray  # (P,) rad, by which it is off if its place is right


def motions_of_path(
    c2w: np.ndarray,  # (F, 4, 4) camera to world, m
) -> CameraMotions:
    """Motions over a quarter of a path of known poses, all equally exact."""
    span = max(1, len(c2w) // 4)
    first = np.arange(len(c2w) - span)
    T = np.linalg.inv(c2w[first + span]) @ c2w[first]
    return CameraMotions(first, first + span, T, np.tile(np.eye(6), (len(first), 1, 1)))


def compare_motions(
    motions: CameraMotions,
    c2w: np.ndarray,  # (F, 4, 4) camera to world of the path, m
) -> _PathDifference | None:
    """Length, curl and single cameras of a path against measured motions.

    What a motion does to the image is measured well, its rotation and its translation alone are not: another length
    and an even curl are fitted one at a time, by robust least squares. Standard deviations are those of a jackknife
    over stretches of the path, as many as there are motions that follow each other.

    Returns:
        The difference; None where fewer than three motions follow each other.
    """
    first, second, T, cov = motions
    n_stretches = int((len(c2w) - 1) // np.median(second - first)) if len(T) else 0
    if min(n_stretches, len(T)) < 3:
        return None
    between = np.linalg.inv(c2w[second]) @ c2w[first]
    turn = T[:, :3, :3] @ between[:, :3, :3].transpose(0, 2, 1)
    omega = se3.log(Pose(torch.from_numpy(turn), torch.zeros(len(T), 3, dtype=torch.float64)))[:, :3].numpy()
    step = np.zeros((len(T), 6, 1))  # of the path, in the measured axes
    step[:, 3:] = turn @ between[:, :3, 3:]
    curl = np.zeros((len(T), 6, 3))
    curl[:, :3] = c2w[second, :3, :3].transpose(0, 2, 1) * ((second - first) / (len(c2w) - 1))[:, None, None]
    off = np.concatenate((omega, T[:, :3, 3]), 1) - step[..., 0]
    parts = np.array_split(np.arange(len(T)), min(N_STRETCHES, n_stretches))
    fits = [_fit_stretches(columns, off, cov, parts) for columns in (step, curl)]
    rests = [off - columns @ x for columns, (x, _) in zip((step, curl), fits, strict=True)]
    distances = [np.sqrt((rest * _solve(cov, rest)).sum(1)) for rest in rests]
    unit = max(min(np.median(d) for d in distances), 1e-9)
    is_curl = bool(np.diff([np.log1p((d / unit) ** 2).sum() for d in distances])[0] < 0)
    rest, cross = rests[is_curl], cov[:, :3, 3:]
    shift = rest[:, 3:] - _times(cross.transpose(0, 2, 1), _solve(cov[:, :3, :3], rest[:, :3]))
    turned = rest[:, :3] - _times(cross, _solve(cov[:, 3:, 3:], rest[:, 3:]))
    (change, change_sigma), (angles, angle_sigma) = fits
    length = 1 / max(1 + float(change[0]), 0.1)
    return _PathDifference(
        length=length,
        length_sigma=length * change_sigma,
        curl=angles,
        curl_sigma=angle_sigma,
        is_curl=is_curl,
        shift=np.linalg.norm(shift, axis=1),
        turn=np.linalg.norm(turned, axis=1),
    )


def _fit_stretches(
    columns: np.ndarray, y: np.ndarray, cov: np.ndarray, parts: Sequence[np.ndarray]
) -> tuple[np.ndarray, float]:
    """Robust solution (n,), and the standard deviation of its length by a jackknife over parts of the P rows."""
    x = _robust_fit(columns, y, cov)
    without = [_robust_fit(*(np.delete(each, part, 0) for each in (columns, y, cov))) for part in parts]
    return x, float(np.sqrt((len(parts) - 1) / len(parts) * ((np.array(without) - x) ** 2).sum()))


def _robust_fit(columns: np.ndarray, y: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Solution (n,) of columns (P, m, n) for rows (P, m) with covariances (P, m, m) up to a common factor: reweighted
    least squares with Cauchy's kernel, which bends at the median distance."""
    W = np.linalg.inv(cov)
    weight = np.ones(len(y))
    for _ in range(20):
        A = columns.transpose(0, 2, 1) @ W * weight[:, None, None]
        x = np.linalg.solve((A @ columns).sum(0), _times(A, y).sum(0))
        rest = y - columns @ x
        square = (rest * _times(W, rest)).sum(1)
        weight = 1 / (1 + square / max(float(np.median(square)), 1e-18))  # exact copies of a path have no residual
    return x


def _times(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Products (P, n) of matrices (P, n, m) and vectors (P, m)."""
    return (A @ x[..., None])[..., 0]


def _solve(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Solutions (P, n) of matrices (P, n, n) and vectors (P, n)."""
    return np.linalg.solve(A, x[..., None])[..., 0]
