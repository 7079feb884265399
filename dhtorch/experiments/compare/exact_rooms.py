"""Built-in rooms whose depth and motion are known exactly: how near a dense map comes where nothing is in its way.

Judged are pixels beyond the near limit that bear texture, whose surface the other view shows too, away from depth
steps, and not on mirrors and windows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.codes import PoseCode, Source
from dhtorch.experiments.rows import Row
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.filters import grayscale
from dhtorch.geometry.patches import sample_nearest
from dhtorch.metrics import bootstrap
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import dense
from dhtorch.pipeline.method import Method
from dhtorch.records import Frame, PoseFit
from dhtorch.synthetic import SyntheticRoom

#: The rooms: their frames' size, near limit in m, and the frames of reference view and other view.
_ROOM_HW, _NEAR_LIMIT_M, _VIEW_FRAMES = (480, 640), 2.0, (3, 11)

#: Standard deviation of grey values in a window of 9 x 9 pixels that counts as texture, and the step of depth in one of
#: 11 x 11 from which on a pixel lies at an edge.
_MIN_TEXTURE_SIGMA, _MAX_DEPTH_STEP = 0.02, 0.05

#: Relative error within which a pixel counts as right, and by which surfaces differ that do not hide each other.
_MAX_RELATIVE_ERROR, _SAME_SURFACE_RATIO = 0.01, 0.03


def share_within_1_percent(seeds: Sequence[int], method: Method, options: Mapping[str, Any]) -> Row:
    """``dense.room_within_1``: share of the answered pixels within 1 %, its mean over rooms; and the same of all asked,
    silence counted as a miss, as ``dense.room_within_1_of_all``."""
    answered, asked = [], []
    for seed in seeds:
        fine, told, wanted = _evaluate_room(seed, method, options)
        answered.append(fine / max(told, 1))
        asked.append(fine / max(wanted, 1))
    return {
        "dense.room_within_1": bootstrap.interval_over_scenes(answered, statistic="mean").entry("1"),
        "dense.room_within_1_of_all": bootstrap.interval_over_scenes(asked, statistic="mean").entry("1"),
    }


def _evaluate_room(seed: int, method: Method, options: Mapping[str, Any]) -> tuple[int, int, int]:
    """Numbers of pixels: within 1 %, answered, asked."""
    room = SyntheticRoom(
        n_frames=max(_VIEW_FRAMES) + 1, hw=_ROOM_HW, depth_hw=_ROOM_HW, lidar="exact", image_noise=0.0, seed=seed
    )
    reference, other = (room[k] for k in _VIEW_FRAMES)
    near = range_split(reference, _NEAR_LIMIT_M)
    fit = exact_pose_fit(reference, other, method.n)
    with torch.no_grad():
        found = dense.complete_depth(
            near,
            range_split(other, _NEAR_LIMIT_M),
            method=method.replace(views=1, select_views=None),
            fit=fit,
            **options,
        )
    wanted = evaluated_pixels(reference, other, _odd_surface_mask(room, _VIEW_FRAMES[0]))
    told = wanted & (found.source == Source.SWEPT)
    right = told & ((found.depth - reference.depth).abs() < _MAX_RELATIVE_ERROR * reference.depth)
    return int(right.sum()), int(told.sum()), int(wanted.sum())


def exact_pose_fit(reference: Frame, other: Frame, n: int) -> PoseFit:
    """The motion between two frames that know where they stand, as known to a tenth of a millimetre."""
    a, b = reference.T_world_from_cam, other.T_world_from_cam
    if a is None or b is None:
        raise ValueError("exact_pose_fit: found a frame without T_world_from_cam, expected two that have one")
    T = se3.compose(se3.invert(b), a).map(lambda x: x.to(reference.camera.f))
    one = torch.ones_like(T.t[:, 0])
    inlier = torch.ones(len(one), n, dtype=torch.bool, device=one.device)
    code = torch.full_like(one, PoseCode.OK, dtype=torch.int32)
    cov = 1e-8 * torch.eye(6).to(T.t).expand(len(one), 6, 6)
    return PoseFit(
        T_1_from_0=T,
        cov=cov,
        inlier=inlier,
        n_inlier=inlier.sum(-1),
        rms_px=one,
        sigma_px=0.1 * one,
        t_snr=1e3 * one,
        code=code,
    )


def evaluated_pixels(reference: Frame, other: Frame, odd: Tensor) -> Tensor:
    """Which pixels (B, h, w) are asked for.

    Args:
        reference, other: frames whose depth is exact and of their picture's size.
        odd: (B, h, w) bool, surfaces on which a picture shows something else.
    """
    depth, picture = reference.depth, grayscale(reference.image)
    mean = F.avg_pool2d(picture, 9, 1, 4)
    contrast = (F.avg_pool2d(picture.square(), 9, 1, 4) - mean.square()).clamp_min(0).sqrt()[:, 0]
    low, high = (sign * F.max_pool2d(sign * depth, 11, 1, 5) for sign in (-1, 1))
    xyz = se3.apply(
        exact_pose_fit(reference, other, 1).T_1_from_0,
        cam.unproject(reference.camera, dense.map_pixel_centres(reference, reference.hw)[None], depth.flatten(1)),
    )
    seen, inside = sample_nearest(other.depth, cam.project(other.camera, xyz))
    shown = inside & ((seen - xyz[..., 2]).abs() < _SAME_SURFACE_RATIO * xyz[..., 2])
    smooth = high < (1 + _MAX_DEPTH_STEP) * low
    beside = F.max_pool2d(odd.to(depth), 9, 1, 4) > 0
    return (
        (depth > _NEAR_LIMIT_M) & (contrast > _MIN_TEXTURE_SIGMA) & smooth & shown.unflatten(1, reference.hw) & ~beside
    )


def _odd_surface_mask(room: SyntheticRoom, k: int) -> Tensor:
    surface = room.truth(k)["surface"]
    codes = [code for code, name in room.surfaces.items() if name in room.odd_surfaces]
    return torch.isin(surface, torch.tensor(codes, dtype=surface.dtype))
