"""A two-camera rig in the built-in room, with exact relative pose and depth."""

import math

import torch

from dhtorch.data.rig import join_cameras
from dhtorch.data.scene import Scene
from dhtorch.geometry import se3
from dhtorch.records import Pose
from dhtorch.synthetic.paths import hand_held_path
from dhtorch.synthetic.recording import SyntheticRoom


def open_two_cameras(
    *,
    seed: int = 2,
    n_frames: int = 6,
    hw: tuple[int, int] = (240, 320),
    depth_hw: tuple[int, int] = (96, 128),
    range_limit: float = 2.5,
    baseline: float = 0.15,
    toe_in_deg: float = 3.0,
    zoom: float = 0.9,
    step_m: float = 0.02,
    supersample: int = 2,
    near: float | None = 2.0,
) -> list[Scene]:
    """Open the two-camera rig as one scene with the frames of ``left`` and ``right``, which move together.

    Args:
        seed, n_frames, hw, depth_hw, range_limit, step_m, supersample: as :class:`SyntheticRoom`.
        baseline: m, from the left camera to the right one.
        toe_in_deg: yaw of the right camera to the left.
        zoom: focal length of the right camera over that of the left.
        near: the cutoff to use for a range split.

    Raises:
        ValueError: a baseline or zoom that is not positive, or an option that :class:`SyntheticRoom` rejects.
    """
    if not (baseline > 0 and zoom > 0):
        raise ValueError(f"two cameras: baseline is {baseline} and zoom {zoom}, expected positive numbers")
    left_poses = hand_held_path("walk", n_frames, step_m=step_m, rate_hz=30.0, seed=seed)
    T = _two_camera_pose(baseline, toe_in_deg)
    right_poses = se3.compose(left_poses, T.map(lambda x: x.expand(n_frames, *x.shape[1:])))
    cameras = []
    for name, poses, scale in (("left", left_poses, 1.0), ("right", right_poses, zoom)):
        room = SyntheticRoom(
            seed=seed,
            n_frames=n_frames,
            hw=hw,
            depth_hw=depth_hw,
            range_limit=range_limit,
            step_m=step_m,
            supersample=supersample,
            name=f"two_cameras/{name}",
            true_poses=poses,
        )
        room.camera = room.camera.replace(f=room.camera.f * scale)
        cameras.append(room)
    return [Scene(join_cameras(cameras), near=near)]


def _two_camera_pose(baseline: float, toe_in_deg: float) -> Pose:
    """``T_left_from_right`` (1), float64."""
    a = math.radians(toe_in_deg)
    turn = se3.exp(torch.tensor([[0.0, -a, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64))
    return Pose(turn.R, torch.tensor([[baseline, 0.0, 0.0]], dtype=torch.float64))
