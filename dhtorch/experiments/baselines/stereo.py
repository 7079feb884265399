"""What OpenCV makes of two views whose motion is known: rectified semi-global matching, and dense flow triangulated.

Both answer for the same samples as the method and under the same motion. They loop over the batch, carry no gradient,
and state no sigma; a score only orders their answers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from dhtorch.codes import Gate
from dhtorch.geometry import camera as cam
from dhtorch.geometry import epipolar, se3
from dhtorch.geometry.patches import sample_nearest
from dhtorch.pipeline.dense import downscale_grey
from dhtorch.records import Camera, Estimate, Frame, Pose, Samples

#: Disparities of the rectified search, its block, and what a step of one and a larger one cost: OpenCV's usual
#: 8 and 32 per pixel of the block.
_N_DISPARITIES, _BLOCK_PX = 96, 5
_P1, _P2 = 8 * _BLOCK_PX**2, 32 * _BLOCK_PX**2

#: Relative error of depth that a score of one half stands for, and the noise of a disparity or a flow, px.
_HALF_SCORE_ERROR, _MATCH_NOISE_PX = 0.1, 0.5

#: Round trip of a flow above which it is no answer, px.
_MAX_ROUND_TRIP_PX = 1.0


#: OpenCV's type hints lack what it makes at run time.
_CV: Any = cv2


class RectifiedPair(NamedTuple):
    """Two pictures turned so that a point has the same row in both, further left in the second.

    They are tipped on their side where the other camera is above or below, and mirrored where it is on the left.
    """

    pictures: tuple[np.ndarray, np.ndarray]  # uint8
    R: np.ndarray  # (3, 3) from view 0 to the rectified view
    K: np.ndarray  # (3, 3) of the rectified view, upright and not mirrored
    upright: bool
    reach: float  # px · m: disparity = reach / depth in the rectified view; negative where the pictures are mirrored


def is_epipole_inside(views: tuple[tuple[Camera, tuple[int, int]], ...], T_1_from_0: Pose) -> Tensor:
    """Whether either picture (camera and size of view 0, then of view 1) shows the other camera's place, or what lies
    right behind it, (B,) bool: such a pair cannot be rectified."""
    inside = []
    for (camera, size), place in zip(views, (se3.invert(T_1_from_0).t, T_1_from_0.t), strict=True):
        ahead = torch.where(place[:, 2:] < 0, -place, place)
        uv = cam.project(cam.ideal(camera), ahead[:, None])[:, 0]
        limit = uv.new_tensor([size[1], size[0]])
        inside.append(((uv >= 0) & (uv < limit)).all(-1) & (ahead[:, 2] > 1e-9))
    return inside[0] | inside[1]


def match_semi_global(
    reference: Frame,
    other: Frame,
    T_1_from_0: Pose,
    samples: Samples,
    *,
    nearest_m: Tensor,  # (B,)
    size: int = 640,
) -> Estimate:
    """``cv2.StereoSGBM`` (96 disparities, MODE_HH4) on pictures rectified by the known motion, at the samples.

    Pictures are as large as the sweep's; where the nearest depth asks for more disparities than there are, they
    shrink. Gates: NO_TRACK where nothing is matched, NO_POSE without a motion, NO_BASELINE where an epipole lies
    inside a picture.
    """
    (grey_0, camera_0), (grey_1, camera_1) = (downscale_grey(frame, size) for frame in (reference, other))
    hw = _image_hw(grey_0)
    inside = is_epipole_inside(((camera_0, hw), (camera_1, _image_hw(grey_1))), T_1_from_0)
    depth = torch.full_like(samples.depth, torch.nan)
    noise = torch.ones_like(depth)
    uv = cam.depth_pixels(reference.camera, reference.hw, None, hw, samples.uv)
    known = T_1_from_0.t.isfinite().all(-1)
    for b in (known & ~inside).nonzero()[:, 0].tolist():
        one = slice(b, b + 1)
        pictures = [(255 * g[b, 0]).round().clamp(0, 255).to(torch.uint8).cpu().numpy() for g in (grey_0, grey_1)]
        views = (pictures[0], camera_0[one]), (pictures[1], camera_1[one])
        rectified = rectify_pair(*views, T_1_from_0[one], nearest_m=float(nearest_m[b]))
        found, spread = _depth_from_disparity(rectified, camera_0[one], hw)
        at = uv[one].cpu().double()
        depth[b] = sample_nearest(torch.from_numpy(found)[None], at)[0][0].to(depth)
        noise[b] = sample_nearest(torch.from_numpy(spread)[None], at)[0][0].to(depth)
    gate = torch.where(depth.isfinite() & (depth > 0), Gate.ANSWER, Gate.NO_TRACK)
    gate = torch.where((known & inside)[:, None], Gate.NO_BASELINE, gate)
    return estimate_from_depth(samples, depth, noise, torch.where(known[:, None], gate, Gate.NO_POSE))


def rectify_pair(
    view_0: tuple[np.ndarray, Camera], view_1: tuple[np.ndarray, Camera], T_1_from_0: Pose, *, nearest_m: float
) -> RectifiedPair:
    """Two grey pictures and their cameras (B = 1), rectified by ``cv2.stereoRectify``.

    The first is always that from whose places others lie further left, so that disparities are positive.
    """
    (picture_0, camera_0), (picture_1, camera_1) = view_0, view_1
    h, w = picture_0.shape
    K_0, d_0 = _opencv_camera(camera_0)
    K_1, d_1 = _opencv_camera(camera_1)
    R, t = (x[0].double().cpu().numpy() for x in (T_1_from_0.R, T_1_from_0.t))
    R_0, R_1, N_0, N_1 = _CV.stereoRectify(K_0, d_0, K_1, d_1, imageSize=(w, h), R=R, T=t.reshape(3, 1))[:4]
    upright = abs(N_1[0, 3]) >= abs(N_1[1, 3])
    reach = float(-N_1[0, 3] if upright else -N_1[1, 3])
    shrink = min(1.0, _N_DISPARITIES / max(abs(reach) / nearest_m, 1e-9))
    S = np.array([[shrink, 0, (shrink - 1) / 2], [0, shrink, (shrink - 1) / 2], [0, 0, 1]])
    size = max(16, round(w * shrink)), max(16, round(h * shrink))
    turned = []
    for picture, K, d, R_k, N in ((picture_0, K_0, d_0, R_0, N_0), (picture_1, K_1, d_1, R_1, N_1)):
        maps = cv2.initUndistortRectifyMap(K, d, R_k, S @ N[:, :3], size, cv2.CV_32FC1)
        one = _CV.remap(picture, *maps, cv2.INTER_AREA if shrink < 1 else cv2.INTER_LINEAR)
        one = one if upright else one.T
        turned.append(np.ascontiguousarray(one if reach > 0 else one[:, ::-1]))
    return RectifiedPair((turned[0], turned[1]), R_0, S @ N_0[:, :3], upright, reach * shrink)


def match_disparity(pictures: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Disparity (h, w) px of the first of two rectified pictures, not positive where there is none."""
    matcher = _CV.StereoSGBM_create(
        0,
        _N_DISPARITIES,
        _BLOCK_PX,
        _P1,
        _P2,
        disp12MaxDiff=1,
        uniquenessRatio=5,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH4,
    )
    left, right = (cv2.copyMakeBorder(p, 0, 0, _N_DISPARITIES, 0, cv2.BORDER_REPLICATE) for p in pictures)
    disparity: np.ndarray = matcher.compute(left, right)[:, _N_DISPARITIES:].astype(np.float32) / 16
    return disparity


def _depth_from_disparity(
    rectified: RectifiedPair, camera_0: Camera, hw: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Depth (h, w) in view 0, NaN where nothing is matched, and the relative noise that half a pixel makes."""
    h, w = hw
    disparity = match_disparity(rectified.pictures)
    ray = cam.rays(camera_0, _pixel_grid(h, w).to(camera_0.f))[0].double().cpu().numpy() @ rectified.R.T
    place = (ray / ray[:, 2:]) @ rectified.K.T
    u, v = (place[:, 0], place[:, 1]) if rectified.upright else (place[:, 1], place[:, 0])
    if rectified.reach < 0:
        u = disparity.shape[1] - 1 - u
    maps = (x.reshape(h, w).astype(np.float32) for x in (u, v))
    read = _CV.remap(disparity, *maps, cv2.INTER_NEAREST, borderValue=-1)
    told = read > 0
    known = np.where(told, read, 1.0)
    # a ray with z = 1 in view 0 has z = ray[2] in the rectified one
    return np.where(told, abs(rectified.reach) / (known * ray[:, 2].reshape(h, w)), np.nan), _MATCH_NOISE_PX / known


def match_optical_flow(
    reference: Frame, other: Frame, T_1_from_0: Pose, samples: Samples, *, size: int = 640
) -> Estimate:
    """``cv2.DISOpticalFlow`` (medium) there and back, triangulated in closed form under the known motion.

    Gates: NO_TRACK where the round trip misses by more than a pixel, BEHIND where rays meet behind a camera, NO_POSE.
    """
    (grey_0, camera_0), (grey_1, camera_1) = (downscale_grey(frame, size) for frame in (reference, other))
    hw = _image_hw(grey_0)
    engine = _CV.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    uv = cam.depth_pixels(reference.camera, reference.hw, None, hw, samples.uv)
    moved = torch.full_like(uv, torch.nan)
    for b in range(len(uv) if _image_hw(grey_1) == hw else 0):
        there, back = _flow_both_ways(
            engine, *((255 * g[b, 0]).to(torch.uint8).cpu().numpy() for g in (grey_0, grey_1))
        )
        step = sample_nearest(there, uv[b : b + 1].expand(2, -1, -1).cpu())[0].T.to(uv)
        lands, inside = sample_nearest(back, (uv[b] + step)[None].expand(2, -1, -1).cpu())
        trip = (step + lands.T.to(uv)).norm(dim=-1)
        fine = inside[0].to(trip.device) & (trip <= _MAX_ROUND_TRIP_PX)
        moved[b] = torch.where(fine[:, None], uv[b] + step, torch.nan)
    told = moved.isfinite().all(-1)
    known = T_1_from_0.t.isfinite().all(-1)
    R, t = (
        torch.where(known.view(-1, *[1] * (x.ndim - 1)), x, torch.zeros_like(x)) for x in (T_1_from_0.R, T_1_from_0.t)
    )
    R = torch.where(known[:, None, None], R, torch.eye(3).to(R))
    ideal_0 = cam.undistort(camera_0, uv)
    ideal_1 = cam.undistort(camera_1, torch.where(told[..., None], moved, uv))
    two = epipolar.triangulate(ideal_0, ideal_1, cam.ideal(camera_0), cam.ideal(camera_1), Pose(R, t))
    z = two.depth
    noise = _MATCH_NOISE_PX / (two.slope.norm(dim=-1) * z.abs()).clamp_min(1e-6)
    gate = torch.where((z > 0) & (two.depth_1 > 0), Gate.ANSWER, Gate.BEHIND)
    gate = torch.where(told & z.isfinite(), gate, Gate.NO_TRACK)
    return estimate_from_depth(samples, z, noise, torch.where(known[:, None], gate, Gate.NO_POSE))


def estimate_from_depth(samples: Samples, depth: Tensor, noise: Tensor, gate: Tensor) -> Estimate:
    """Depths (B, N) in m with a relative noise that orders them, silent where the gate says so; no sigma is stated."""
    keep = (gate == Gate.ANSWER) & depth.isfinite()
    silent = Estimate.silent(samples, Gate.NO_TRACK, n_views=2)
    return silent.replace(
        depth=torch.where(keep, depth, torch.nan),
        score=torch.where(keep, _HALF_SCORE_ERROR / (_HALF_SCORE_ERROR + noise), 0.0),
        gate=torch.where(keep, Gate.ANSWER, torch.where(gate == Gate.ANSWER, Gate.NO_TRACK, gate)).to(torch.int32),
    )


def _flow_both_ways(engine: Any, first: np.ndarray, second: np.ndarray) -> tuple[Tensor, Tensor]:
    """Flow there and back, (2, h, w) each."""
    there, back = (
        torch.from_numpy(engine.calc(a, b, None)).permute(2, 0, 1) for a, b in ((first, second), (second, first))
    )
    return there.contiguous(), back.contiguous()


def _opencv_camera(camera: Camera) -> tuple[np.ndarray, np.ndarray | None]:
    K = cam.to_matrix(camera)[0].double().cpu().numpy()
    bent = None if camera.distortion is None else camera.distortion[0].double().cpu().numpy()
    return K, bent


def _pixel_grid(h: int, w: int) -> Tensor:
    v, u = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    return torch.stack([u, v], -1).reshape(1, -1, 2)


def _image_hw(grey: Tensor) -> tuple[int, int]:
    return grey.shape[-2], grey.shape[-1]
