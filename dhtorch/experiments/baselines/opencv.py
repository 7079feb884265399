"""OpenCV's functions as stages of a method: reference of tests and benchmarks, and ``method=opencv``.

All functions loop over the batch and have no gradient.
"""

from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from dhtorch.codes import PoseCode
from dhtorch.geometry import camera as cam
from dhtorch.geometry import covariance, epipolar, filters, se3
from dhtorch.pipeline.presets import PAPER
from dhtorch.records import NO_HINT, Camera, Pose, PoseFit, Samples, TrackHint, Tracks


def opencv_lucas_kanade(
    image_0: Tensor,
    image_1: Tensor,
    uv_0: Tensor,  # (B, N, 2) px
    *,
    hint: TrackHint = NO_HINT,
    window: int = 21,
    levels: int = 4,
    iterations: int = 30,
    epsilon_px: float = 0.01,
    max_round_trip_px: float = 1.0,
) -> Tracks:
    """Track stage by ``cv2.calcOpticalFlowPyrLK``, forward and backward; ``levels`` includes full resolution.

    Of a hint it uses the levels, and neither start nor pyramid.

    OpenCV reports no covariance: ``cov`` is NaN, and so is every sigma derived from it.
    """
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, iterations, epsilon_px)
    levels = levels if hint.levels is None else hint.levels
    options = {"winSize": (window, window), "maxLevel": levels - 1, "criteria": criteria}
    images = zip(_grey_uint8(image_0), _grey_uint8(image_1), _as_numpy(uv_0, np.float32), strict=True)
    columns = zip(*(_track_pair(*views, options, max_round_trip_px) for views in images), strict=True)
    uv_1, error, photometric, valid = (torch.from_numpy(np.stack(c)).to(uv_0.device) for c in columns)
    cov = torch.full((*uv_0.shape, 2), torch.nan, dtype=uv_0.dtype, device=uv_0.device)
    return Tracks(uv_0, uv_1.to(uv_0), error.to(uv_0), photometric.to(uv_0), cov, valid)


def _track_pair(
    grey_0: np.ndarray, grey_1: np.ndarray, start: np.ndarray, options: dict[str, Any], max_round_trip_px: float
) -> tuple[np.ndarray, ...]:
    """(position, round trip, mean grey difference, validity) of the points of one pair."""
    n = len(start)
    if n == 0:
        return start, np.zeros(n), np.zeros(n), np.zeros(n, bool)
    flow: Any = cv2.calcOpticalFlowPyrLK
    forward, tracked, residual = flow(grey_0, grey_1, start[:, None], None, **options)
    backward, tracked_back, _ = flow(grey_1, grey_0, forward, None, **options)
    uv, tracked = forward[:, 0], tracked[:, 0] > 0
    error = np.linalg.norm(backward[:, 0] - start, axis=-1)
    inside = ((uv >= 0) & (uv <= [grey_1.shape[1] - 1, grey_1.shape[0] - 1])).all(-1)
    valid = tracked & (tracked_back[:, 0] > 0) & inside & (error < max_round_trip_px)
    return (
        uv,
        error,
        np.where(tracked, residual[:, 0], 0) / 255,
        valid,
    )  # the difference is undefined elsewhere


def opencv_pnp_ransac(
    samples: Samples,
    tracks: Tracks,
    camera_0: Camera,
    camera_1: Camera,
    draws: Tensor,  # (B, H, 3): only H is used, OpenCV draws its own samples
    *,
    threshold_px: float = 3.0,
    min_inlier: int = 8,
    confidence: float = 0.999,
) -> PoseFit:
    """Pose stage by ``cv2.solvePnPRansac`` (EPnP) and ``cv2.solvePnPRefineLM`` on the inliers."""
    near = tracks.valid & samples.usable
    K = _as_numpy(cam.to_matrix(camera_1), np.float64)
    R, t, inlier, code = [], [], [], []
    for b in range(near.shape[0]):
        index = near[b].nonzero()[:, 0].cpu().numpy()
        xyz, uv = _as_numpy(samples.xyz[b], np.float64)[index], _as_numpy(tracks.uv_1[b], np.float64)[index]
        solution = (
            _solve_pnp(xyz, uv, K[b], draws.shape[1], threshold_px, confidence) if len(index) >= min_inlier else None
        )
        mask = np.zeros(near.shape[1], bool)
        solved = solution is not None and len(solution[2]) >= min_inlier
        if solution is not None and solved:
            mask[index[solution[2]]] = True
        R.append(solution[0] if solution is not None and solved else np.full((3, 3), np.nan))
        t.append(solution[1] if solution is not None and solved else np.full(3, np.nan))
        inlier.append(mask)
        code.append(PoseCode.OK if solved else PoseCode.TOO_FEW)
    like, device = samples.xyz, samples.xyz.device
    pose = Pose(torch.from_numpy(np.stack(R)).to(like), torch.from_numpy(np.stack(t)).to(like))
    codes = torch.tensor(code, dtype=torch.int32, device=device)
    return _make_pose_fit(samples, tracks, camera_1, pose, torch.from_numpy(np.stack(inlier)).to(device), codes)


def opencv_triangulate(
    uv_0: Tensor, uv_1: Tensor, camera_0: Camera, camera_1: Camera, T_1_from_0: Pose
) -> epipolar.TwoView:
    """``cv2.triangulatePoints`` as the ``solver`` of :func:`dhtorch.stages.triangulate.two_view`."""
    points = []
    K_0, K_1 = _as_numpy(cam.to_matrix(camera_0), np.float64), _as_numpy(cam.to_matrix(camera_1), np.float64)
    T = _as_numpy(se3.to_matrix(T_1_from_0), np.float64)
    for b, (u, v) in enumerate(zip(_as_numpy(uv_0, np.float64), _as_numpy(uv_1, np.float64), strict=True)):
        X = cv2.triangulatePoints(K_0[b] @ np.eye(3, 4), K_1[b] @ T[b, :3], u.T, v.T) if len(u) else np.ones((4, 0))
        points.append((X[:3] / np.where(np.abs(X[3]) < 1e-12, 1e-12, X[3])).T)
    xyz = torch.from_numpy(np.stack(points)).to(uv_0)
    return epipolar.describe_triangulation(xyz, uv_0, uv_1, camera_0, camera_1, T_1_from_0)


def _solve_pnp(
    xyz: np.ndarray, uv: np.ndarray, K: np.ndarray, hypotheses: int, threshold_px: float, confidence: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """R (3, 3), t (3,) and inlier indices of one pair, or None."""
    options: Any = {"reprojectionError": threshold_px, "iterationsCount": hypotheses, "confidence": confidence}
    ok, rvec, tvec, inlier = cv2.solvePnPRansac(xyz, uv, K, None, flags=cv2.SOLVEPNP_EPNP, **options)
    if not ok or inlier is None:
        return None
    inlier = inlier[:, 0]
    rvec, tvec = cv2.solvePnPRefineLM(xyz[inlier], uv[inlier], K, None, rvec, tvec)
    R, t = cv2.Rodrigues(rvec)[0], tvec[:, 0]
    return (R, t, inlier) if np.isfinite(R).all() and np.isfinite(t).all() else None


def _make_pose_fit(
    samples: Samples, tracks: Tracks, camera_1: Camera, pose: Pose, inlier: Tensor, code: Tensor
) -> PoseFit:
    """Residuals, covariance and signal-to-noise ratio of OpenCV's pose, by the formulas of our own pose stage."""
    R, t = pose.R.nan_to_num().double(), pose.t.nan_to_num().double()
    xyz = se3.apply(Pose(R, t), torch.where(inlier[..., None], samples.xyz, torch.ones_like(samples.xyz)).double())
    camera = camera_1.to(torch.float64)
    weight = inlier.double()
    residual = (cam.project(camera, xyz) - tracks.uv_1.nan_to_num().double()) * weight[..., None]
    J = (epipolar.point_jacobians(camera, xyz)[1] * weight[..., None, None]).flatten(1, 2)  # (B, 2N, 6)
    count = inlier.sum(-1)
    squares = (residual * residual).sum((-1, -2))
    sigma_px = (squares / (2 * count - 6).clamp_min(1)).sqrt()
    cov, _ = covariance.covariance_from_normal(J.mT @ J, sigma_px)
    t_snr = covariance.mahalanobis(t, cov[:, 3:, 3:])
    failed, like = code != PoseCode.OK, samples.xyz

    def nan_if_failed(x: Tensor) -> Tensor:
        return torch.where(failed.view(-1, *[1] * (x.ndim - 1)), torch.nan, x).to(like)

    return PoseFit(
        T_1_from_0=pose,
        cov=nan_if_failed(cov),
        inlier=inlier,
        n_inlier=count,
        rms_px=nan_if_failed((squares / count.clamp_min(1)).sqrt()),
        sigma_px=nan_if_failed(sigma_px),
        t_snr=nan_if_failed(t_snr),
        code=code,
    )


def _grey_uint8(image: Tensor) -> list[np.ndarray]:
    """uint8 grey images, as OpenCV's own conversion makes them."""
    if image.dtype == torch.uint8 and image.shape[1] == 3:
        return [
            cv2.cvtColor(np.ascontiguousarray(x), cv2.COLOR_RGB2GRAY) for x in image.permute(0, 2, 3, 1).cpu().numpy()
        ]
    grey = (
        image if image.dtype == torch.uint8 else (filters.grayscale(image) * 255).round().clamp(0, 255).to(torch.uint8)
    )
    return list(grey[:, 0].cpu().numpy())


def _as_numpy(x: Tensor, dtype: type) -> np.ndarray:
    return np.ascontiguousarray(x.detach().cpu().numpy(), dtype=dtype)


#: ``PAPER`` with OpenCV's stages: LK forward and backward, EPnP-RANSAC with LM refinement, triangulatePoints.
OPENCV = PAPER.replace(track=opencv_lucas_kanade, pose=opencv_pnp_ransac, triangulate={"solver": opencv_triangulate})
