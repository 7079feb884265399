"""A device's own trajectory as it reports it: the true one with a turned frame, late, drifting and noisy."""

from __future__ import annotations

import math

import torch
from torch import Generator, Tensor

from dhtorch.geometry import se3
from dhtorch.records import Pose

#: Axis of the drift, world coordinates: up, since gravity corrects the other two. Source: derived, the rooms' axes.
_DRIFT_AXIS = (0.0, -1.0, 0.0)


def reported_poses(
    poses: Pose,
    times: Tensor,
    *,
    offset_deg: float = 0.0,
    lag_s: float = 0.0,
    drift_deg_per_s: float = 0.0,
    rotation_noise_deg: float = 0.0,
    seed: int = 0,
) -> Pose:
    """True poses (n,) of a camera -> those that its device reports for the same frames.

    Args:
        poses: T_world_from_cam, float64.
        times: (n,) s, increasing.
        offset_deg: constant angle between the device's axes and the camera's, about their diagonal.
        lag_s: the pose reported for a frame is the one of this time before it; before the first frame it is the first.
        drift_deg_per_s: turn about the vertical that the reported rotation gains.
        rotation_noise_deg: standard deviation of an independent turn of every frame, per axis.
        seed: of the noise.

    Returns:
        Poses (n,), float64; equal to ``poses`` with all options 0.
    """
    late = _earlier(poses, times, lag_s) if lag_s else poses
    centre = late.t
    turns = {
        "offset": torch.full((1, 3), math.radians(offset_deg) / 3**0.5, dtype=centre.dtype),
        "drift": (times - times[0])[:, None].to(centre)
        * math.radians(drift_deg_per_s)
        * centre.new_tensor(_DRIFT_AXIS),
        "noise": math.radians(rotation_noise_deg)
        * torch.randn(len(times), 3, generator=Generator().manual_seed(seed), dtype=centre.dtype),
    }
    R = {name: se3.exp(torch.cat((turn, torch.zeros_like(turn)), -1)).R for name, turn in turns.items()}
    return Pose(R["drift"] @ late.R @ R["offset"] @ R["noise"], centre)


def _earlier(poses: Pose, times: Tensor, lag_s: float) -> Pose:
    """Poses at ``times - lag_s``: position linear, rotation at constant speed between neighbouring frames."""
    at = (times - lag_s).clamp_min(times[0])
    after = torch.searchsorted(times, at).clamp(1, max(len(times) - 1, 1)).clamp(max=len(times) - 1)
    before = (after - 1).clamp_min(0)
    span = (times[after] - times[before]).clamp_min(1e-12)
    weight = ((at - times[before]) / span).to(poses.t)[:, None]
    step = se3.log(se3.relative(poses[after], poses[before]))  # pose of `after` in the frame of `before`
    turn = torch.cat((weight * step[:, :3], torch.zeros_like(step[:, 3:])), -1)
    centre = (1 - weight) * poses.t[before] + weight * poses.t[after]
    return Pose(poses.R[before] @ se3.exp(turn).R, centre)
