"""Depth from two posed views by OpenCV: rectified semi-global matching, and triangulated dense optical flow.

Both estimate depth at the method's samples under the method's relative pose. They loop over the batch and have neither
gradient nor sigma; their score only orders answers.
"""

from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from kornia.filters import joint_bilateral_blur
from torch import Tensor

from dhtorch.codes import Gate
from dhtorch.geometry import camera as cam
from dhtorch.geometry import epipolar, se3
from dhtorch.geometry.patches import sample_nearest
from dhtorch.pipeline.dense import downscale_grey
from dhtorch.records import Camera, Estimate, Frame, Pose, Samples

# Dense depth from one view by joint bilateral filling of the sensor's returns, guided by the image.
#
# It uses no second view and no geometry: beyond the sensor's range it extrapolates nearer surfaces.

#: Longer side of the filtered images, px.
_MAX_SIDE_PX = 96

#: Side of the filter's window, px.
_FILTER_WINDOW_PX = 9

#: Standard deviation of the filter in space, px.
_SPATIAL_SIGMA_PX = 3.0

#: Standard deviation of the filter in grey value.
_GREY_SIGMA = 0.1

#: Rounds of filling; with them windows reach across the image.
_N_ROUNDS = 30

#: Least weight of returns in a window to fill its centre.
_MIN_WEIGHT = 1e-3


def fill_bilateral(reference: Frame, samples: Samples) -> Estimate:
    """Depth at the samples by joint bilateral filling (kornia's filter), round after round from the rim of a hole.

    The score decreases with the number of rounds until a pixel is filled. Gate NO_TRACK where it is not filled.
    """
    image = downscale_grey(reference, _MAX_SIDE_PX)[0]
    h, w = image.shape[-2:]
    has_return = (reference.depth > 0) & reference.depth.isfinite()
    weight = F.interpolate(has_return[:, None].to(image), (h, w), mode="area")
    depth = F.interpolate(torch.where(has_return, reference.depth, 0.0)[:, None].to(image), (h, w), mode="area")
    depth = depth / weight.clamp_min(_MIN_WEIGHT)
    filled = weight > _MIN_WEIGHT
    round_filled = torch.zeros_like(depth)
    for k in range(_N_ROUNDS):
        mass, total = (
            joint_bilateral_blur(x, image, _FILTER_WINDOW_PX, _GREY_SIGMA, (_SPATIAL_SIGMA_PX, _SPATIAL_SIGMA_PX))
            for x in (filled.to(depth), torch.where(filled, depth, 0.0))
        )
        new = ~filled & (mass > _MIN_WEIGHT)
        depth = torch.where(new, total / mass.clamp_min(_MIN_WEIGHT), depth)
        round_filled = torch.where(new, 1.0 + k, round_filled)
        filled = filled | new
    uv = cam.depth_pixels(reference.camera, reference.hw, None, (h, w), samples.uv)
    depth_at_samples = sample_nearest(torch.where(filled, depth, torch.nan)[:, 0], uv)[0]
    noise = 0.01 * (1 + sample_nearest(round_filled[:, 0], uv)[0])
    return _estimate_from_depth(
        samples, depth_at_samples, noise, torch.where(depth_at_samples > 0, Gate.ANSWER, Gate.NO_TRACK)
    )


#: Number of disparities of the rectified search.
_N_DISPARITIES = 96

#: Side of the matched block, px.
_BLOCK_PX = 5

#: Cost of a disparity step of one between neighbours: OpenCV's usual 8 per pixel of the block.
_P1 = 8 * _BLOCK_PX**2

#: Cost of a larger step: OpenCV's usual 32 per pixel of the block.
_P2 = 32 * _BLOCK_PX**2

#: Relative error of depth at which the score is one half.
_HALF_SCORE_ERROR = 0.1

#: Noise of a disparity or a flow, px.
_MATCH_NOISE_PX = 0.5

#: Maximum round trip of a flow, px.
_MAX_ROUND_TRIP_PX = 1.0


#: OpenCV without its type hints, which lack functions that exist at run time.
_CV: Any = cv2


class _RectifiedPair(NamedTuple):
    """Rectified images: a point has the same row in both, and lies further left in the second.

    They are transposed where the source camera is above or below, and mirrored where it is on the left.
    """

    pictures: tuple[np.ndarray, np.ndarray]  # uint8
    R: np.ndarray  # (3, 3) from view 0 to the rectified view
    K: np.ndarray  # (3, 3) of the rectified view, upright and not mirrored
    upright: bool
    reach: float  # px · m: disparity = reach / depth in the rectified view; negative where the images are mirrored


def is_epipole_inside(views: tuple[tuple[Camera, tuple[int, int]], ...], T_1_from_0: Pose) -> Tensor:
    """Whether the epipole lies inside either image (camera and size of view 0, then of view 1), (B,) bool.

    Such a pair cannot be rectified.
    """
    inside = []
    for (camera, hw), centre in zip(views, (se3.invert(T_1_from_0).t, T_1_from_0.t), strict=True):
        in_front = torch.where(centre[:, 2:] < 0, -centre, centre)
        uv = cam.project(cam.ideal(camera), in_front[:, None])[:, 0]
        limit = uv.new_tensor([hw[1], hw[0]])
        inside.append(((uv >= 0) & (uv < limit)).all(-1) & (in_front[:, 2] > 1e-9))
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
    """``cv2.StereoSGBM`` (96 disparities, MODE_HH4) on images rectified by the relative pose → estimate at the samples.

    Images are as large as the sweep's, and smaller where the nearest depth needs more disparities than there are.
    Gates: NO_TRACK without a match, NO_POSE without a relative pose, NO_BASELINE where an epipole lies inside an image.
    """
    (grey_0, camera_0), (grey_1, camera_1) = (downscale_grey(frame, size) for frame in (reference, other))
    hw = _image_hw(grey_0)
    has_epipole = is_epipole_inside(((camera_0, hw), (camera_1, _image_hw(grey_1))), T_1_from_0)
    depth = torch.full_like(samples.depth, torch.nan)
    noise = torch.ones_like(depth)
    uv = cam.depth_pixels(reference.camera, reference.hw, None, hw, samples.uv)
    has_pose = T_1_from_0.t.isfinite().all(-1)
    for b in (has_pose & ~has_epipole).nonzero()[:, 0].tolist():
        item = slice(b, b + 1)
        images = [(255 * g[b, 0]).round().clamp(0, 255).to(torch.uint8).cpu().numpy() for g in (grey_0, grey_1)]
        views = (images[0], camera_0[item]), (images[1], camera_1[item])
        rectified = rectify_pair(*views, T_1_from_0[item], nearest_m=float(nearest_m[b]))
        depth_map, noise_map = _depth_from_disparity(rectified, camera_0[item], hw)
        item_uv = uv[item].cpu().double()
        depth[b] = sample_nearest(torch.from_numpy(depth_map)[None], item_uv)[0][0].to(depth)
        noise[b] = sample_nearest(torch.from_numpy(noise_map)[None], item_uv)[0][0].to(depth)
    gate = torch.where(depth.isfinite() & (depth > 0), Gate.ANSWER, Gate.NO_TRACK)
    gate = torch.where((has_pose & has_epipole)[:, None], Gate.NO_BASELINE, gate)
    return _estimate_from_depth(samples, depth, noise, torch.where(has_pose[:, None], gate, Gate.NO_POSE))


def rectify_pair(
    view_0: tuple[np.ndarray, Camera], view_1: tuple[np.ndarray, Camera], T_1_from_0: Pose, *, nearest_m: float
) -> _RectifiedPair:
    """Two grey images and their cameras (B = 1), rectified by ``cv2.stereoRectify``.

    Images are mirrored where needed, so that disparities are positive.
    """
    (image_0, camera_0), (image_1, camera_1) = view_0, view_1
    h, w = image_0.shape
    K_0, d_0 = _opencv_camera(camera_0)
    K_1, d_1 = _opencv_camera(camera_1)
    R, t = (x[0].double().cpu().numpy() for x in (T_1_from_0.R, T_1_from_0.t))
    R_0, R_1, N_0, N_1 = _CV.stereoRectify(K_0, d_0, K_1, d_1, imageSize=(w, h), R=R, T=t.reshape(3, 1))[:4]
    upright = abs(N_1[0, 3]) >= abs(N_1[1, 3])
    reach = float(-N_1[0, 3] if upright else -N_1[1, 3])
    shrink = min(1.0, _N_DISPARITIES / max(abs(reach) / nearest_m, 1e-9))
    S = np.array([[shrink, 0, (shrink - 1) / 2], [0, shrink, (shrink - 1) / 2], [0, 0, 1]])
    size = max(16, round(w * shrink)), max(16, round(h * shrink))
    rectified = []
    for image, K, d, R_k, N in ((image_0, K_0, d_0, R_0, N_0), (image_1, K_1, d_1, R_1, N_1)):
        maps = cv2.initUndistortRectifyMap(K, d, R_k, S @ N[:, :3], size, cv2.CV_32FC1)
        warped = _CV.remap(image, *maps, cv2.INTER_AREA if shrink < 1 else cv2.INTER_LINEAR)
        warped = warped if upright else warped.T
        rectified.append(np.ascontiguousarray(warped if reach > 0 else warped[:, ::-1]))
    return _RectifiedPair((rectified[0], rectified[1]), R_0, S @ N_0[:, :3], upright, reach * shrink)


def match_disparity(pictures: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Disparity (h, w) px of the first of two rectified images; not positive where there is no match."""
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
    rectified: _RectifiedPair, camera_0: Camera, hw: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """(depth in view 0, NaN without a match; its relative noise for half a pixel of disparity), (h, w) each."""
    h, w = hw
    disparity = match_disparity(rectified.pictures)
    rows, columns = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    pixels = torch.stack([columns, rows], -1).reshape(1, -1, 2).to(camera_0.f)
    ray = cam.rays(camera_0, pixels)[0].double().cpu().numpy() @ rectified.R.T
    rectified_uv = (ray / ray[:, 2:]) @ rectified.K.T
    u, v = (rectified_uv[:, 0], rectified_uv[:, 1]) if rectified.upright else (rectified_uv[:, 1], rectified_uv[:, 0])
    if rectified.reach < 0:
        u = disparity.shape[1] - 1 - u
    maps = (x.reshape(h, w).astype(np.float32) for x in (u, v))
    disparity_0 = _CV.remap(disparity, *maps, cv2.INTER_NEAREST, borderValue=-1)
    matched = disparity_0 > 0
    positive = np.where(matched, disparity_0, 1.0)
    # a ray with z = 1 in view 0 has z = ray[2] in the rectified one
    return np.where(
        matched, abs(rectified.reach) / (positive * ray[:, 2].reshape(h, w)), np.nan
    ), _MATCH_NOISE_PX / positive


def match_optical_flow(
    reference: Frame, other: Frame, T_1_from_0: Pose, samples: Samples, *, size: int = 640
) -> Estimate:
    """``cv2.DISOpticalFlow`` (medium), forward and backward, triangulated in closed form under the relative pose.

    Gates: NO_TRACK where the round trip exceeds a pixel, BEHIND where rays meet behind a camera, NO_POSE.
    """
    (grey_0, camera_0), (grey_1, camera_1) = (downscale_grey(frame, size) for frame in (reference, other))
    hw = _image_hw(grey_0)
    engine = _CV.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    uv = cam.depth_pixels(reference.camera, reference.hw, None, hw, samples.uv)
    uv_1 = torch.full_like(uv, torch.nan)
    for b in range(len(uv) if _image_hw(grey_1) == hw else 0):
        images = [(255 * g[b, 0]).to(torch.uint8).cpu().numpy() for g in (grey_0, grey_1)]
        forward, backward = (  # (2, h, w) px each
            torch.from_numpy(engine.calc(*pair, None)).permute(2, 0, 1).contiguous() for pair in (images, images[::-1])
        )
        step = sample_nearest(forward, uv[b : b + 1].expand(2, -1, -1).cpu())[0].T.to(uv)
        return_step, inside = sample_nearest(backward, (uv[b] + step)[None].expand(2, -1, -1).cpu())
        round_trip = (step + return_step.T.to(uv)).norm(dim=-1)
        consistent = inside[0].to(round_trip.device) & (round_trip <= _MAX_ROUND_TRIP_PX)
        uv_1[b] = torch.where(consistent[:, None], uv[b] + step, torch.nan)
    tracked = uv_1.isfinite().all(-1)
    has_pose = T_1_from_0.t.isfinite().all(-1)
    R, t = (
        torch.where(has_pose.view(-1, *[1] * (x.ndim - 1)), x, torch.zeros_like(x))
        for x in (T_1_from_0.R, T_1_from_0.t)
    )
    R = torch.where(has_pose[:, None, None], R, torch.eye(3).to(R))
    ideal_0 = cam.undistort(camera_0, uv)
    ideal_1 = cam.undistort(camera_1, torch.where(tracked[..., None], uv_1, uv))
    triangulated = epipolar.triangulate(ideal_0, ideal_1, cam.ideal(camera_0), cam.ideal(camera_1), Pose(R, t))
    z = triangulated.depth
    noise = _MATCH_NOISE_PX / (triangulated.slope.norm(dim=-1) * z.abs()).clamp_min(1e-6)
    gate = torch.where((z > 0) & (triangulated.depth_1 > 0), Gate.ANSWER, Gate.BEHIND)
    gate = torch.where(tracked & z.isfinite(), gate, Gate.NO_TRACK)
    return _estimate_from_depth(samples, z, noise, torch.where(has_pose[:, None], gate, Gate.NO_POSE))


def _estimate_from_depth(samples: Samples, depth: Tensor, noise: Tensor, gate: Tensor) -> Estimate:
    """Depths (B, N) in m, relative noise and gates → estimate without sigma; the score decreases with the noise."""
    keep = (gate == Gate.ANSWER) & depth.isfinite()
    unanswered = Estimate.unanswered(samples, Gate.NO_TRACK, n_views=2)
    return unanswered.replace(
        depth=torch.where(keep, depth, torch.nan),
        score=torch.where(keep, _HALF_SCORE_ERROR / (_HALF_SCORE_ERROR + noise), 0.0),
        gate=torch.where(keep, Gate.ANSWER, torch.where(gate == Gate.ANSWER, Gate.NO_TRACK, gate)).to(torch.int32),
    )


def _opencv_camera(camera: Camera) -> tuple[np.ndarray, np.ndarray | None]:
    K = cam.to_matrix(camera)[0].double().cpu().numpy()
    distortion = None if camera.distortion is None else camera.distortion[0].double().cpu().numpy()
    return K, distortion


def _image_hw(grey: Tensor) -> tuple[int, int]:
    return grey.shape[-2], grey.shape[-1]
