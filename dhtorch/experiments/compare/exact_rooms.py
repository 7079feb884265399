"""Accuracy of dense maps in built-in rooms with exact depth and poses.

Evaluated are pixels beyond the near limit with texture, visible in the source view too, away from depth steps, and not
on mirrors and windows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.codes import PoseCode, is_estimated
from dhtorch.experiments.rows import Row
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.filters import grayscale
from dhtorch.geometry.patches import sample_nearest
from dhtorch.metrics import bootstrap
from dhtorch.metrics.holdout import range_split
from dhtorch.metrics.map_quality import step_counts
from dhtorch.pipeline import dense
from dhtorch.pipeline.completion import complete_depth
from dhtorch.pipeline.method import Method
from dhtorch.records import Frame, PoseFit
from dhtorch.synthetic import SyntheticRoom

#: Height and width of a room's frames, px.
_ROOM_HW = (480, 640)

#: Near limit of a room, m.
_NEAR_LIMIT_M = 2.0

#: Frames of the reference view and the source view.
_VIEW_FRAMES = (3, 11)

#: Least standard deviation of grey values in a window of 9 x 9 pixels that counts as texture.
_MIN_TEXTURE_SIGMA = 0.02

#: Largest relative step of depth in a window of 11 x 11 pixels; a pixel with a larger one lies at an edge.
_MAX_DEPTH_STEP = 0.05

#: Largest relative error of a right pixel.
_MAX_RELATIVE_ERROR = 0.01

#: Largest relative difference of depth between views for a pixel to count as visible in both.
_SAME_SURFACE_RATIO = 0.03


def measure_rooms(seeds: Sequence[int], method: Method, options: Mapping[str, Any]) -> Row:
    """Fraction of pixels within 1 %, mean over rooms: ``dense.room_within_1`` of answered pixels, ``…_of_all`` of all.

    Unanswered pixels count as misses in ``dense.room_within_1_of_all``. ``dense.room_step_wrong_share``: wrong answers
    over answers beside a depth step (:func:`dhtorch.metrics.map_quality.step_counts`).
    """
    of_answered, of_all, at_steps = [], [], []
    for seed in seeds:
        (n_right, n_answered, n_evaluated), (n_wrong, n_beside) = _evaluate_room(seed, method, options)
        of_answered.append(n_right / max(n_answered, 1))
        of_all.append(n_right / max(n_evaluated, 1))
        at_steps.append(n_wrong / max(n_beside, 1))
    return {
        "dense.room_step_wrong_share": bootstrap.interval_over_scenes(at_steps, statistic="mean").entry("1"),
        "dense.room_within_1": bootstrap.interval_over_scenes(of_answered, statistic="mean").entry("1"),
        "dense.room_within_1_of_all": bootstrap.interval_over_scenes(of_all, statistic="mean").entry("1"),
    }


def _evaluate_room(
    seed: int, method: Method, options: Mapping[str, Any]
) -> tuple[tuple[int, int, int], tuple[int, int]]:
    """Numbers of pixels of one room: (within 1 %, answered, evaluated), (wrong, all answered beside a depth step)."""
    room = SyntheticRoom(
        n_frames=max(_VIEW_FRAMES) + 1, hw=_ROOM_HW, depth_hw=_ROOM_HW, lidar="exact", image_noise=0.0, seed=seed
    )
    reference, other = (room[k] for k in _VIEW_FRAMES)
    near_view = range_split(reference, _NEAR_LIMIT_M)
    fit = exact_pose_fit(reference, other, method.n)
    with torch.no_grad():
        depth_map = complete_depth(
            near_view,
            range_split(other, _NEAR_LIMIT_M),
            method=method.replace(views=1, select_views=None),
            fit=fit,
            **options,
        )
    odd = _odd_surface_mask(room, _VIEW_FRAMES[0])
    evaluated = evaluated_pixels(reference, other, odd)
    answered = evaluated & is_estimated(depth_map.source)
    right = answered & ((depth_map.depth - reference.depth).abs() < _MAX_RELATIVE_ERROR * reference.depth)
    counts = int(right.sum()), int(answered.sum()), int(evaluated.sum())
    return counts, step_counts(depth_map, reference.depth, ~odd)


def exact_pose_fit(reference: Frame, other: Frame, n: int) -> PoseFit:
    """Relative pose from the frames' ``T_world_from_cam`` as a fit with standard deviations of 0.1 mm and 0.1 mrad."""
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
    """Mask (B, h, w) of the evaluated pixels.

    Args:
        reference, other: frames with exact depth of their image's size.
        odd: (B, h, w) bool, surfaces whose image is not their own (mirrors, windows).
    """
    depth, grey = reference.depth, grayscale(reference.image)
    mean = F.avg_pool2d(grey, 9, 1, 4)
    contrast = (F.avg_pool2d(grey.square(), 9, 1, 4) - mean.square()).clamp_min(0).sqrt()[:, 0]
    low, high = (sign * F.max_pool2d(sign * depth, 11, 1, 5) for sign in (-1, 1))
    xyz = se3.apply(
        exact_pose_fit(reference, other, 1).T_1_from_0,
        cam.unproject(reference.camera, dense.map_pixel_centres(reference, reference.hw)[None], depth.flatten(1)),
    )
    depth_1, inside = sample_nearest(other.depth, cam.project(other.camera, xyz))
    visible = inside & ((depth_1 - xyz[..., 2]).abs() < _SAME_SURFACE_RATIO * xyz[..., 2])
    smooth = high < (1 + _MAX_DEPTH_STEP) * low
    near_odd = F.max_pool2d(odd.to(depth), 9, 1, 4) > 0
    return (
        (depth > _NEAR_LIMIT_M)
        & (contrast > _MIN_TEXTURE_SIGMA)
        & smooth
        & visible.unflatten(1, reference.hw)
        & ~near_odd
    )


def _odd_surface_mask(room: SyntheticRoom, k: int) -> Tensor:
    surface = room.truth(k)["surface"]
    codes = [code for code, name in room.surfaces.items() if name in room.odd_surfaces]
    return torch.isin(surface, torch.tensor(codes, dtype=surface.dtype))
