"""Poses as files of other conventions state them, from the true poses."""

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from dhtorch.data.pose_convention import PoseConvention
from dhtorch.data.units import UNIT_METRES
from dhtorch.geometry import se3
from dhtorch.records import Frame, Pose

#: Direction of a camera axis → vector in axes x right, y down, z forward.
DIRECTIONS = {
    "right": (1, 0, 0),
    "left": (-1, 0, 0),
    "down": (0, 1, 0),
    "up": (0, -1, 0),
    "forward": (0, 0, 1),
    "back": (0, 0, -1),
}


def rotation(q: Tensor) -> Tensor:
    """Unit quaternions (B, 4), x y z w → rotations (B, 3, 3)."""
    return torch.from_numpy(Rotation.from_quat(q.numpy()).as_matrix())


def state_poses(true: Pose, convention: PoseConvention) -> Pose:
    """True poses (B) → poses (B) as a reader has them from a file in a convention."""
    axes = torch.tensor([DIRECTIONS[word] for word in convention.axes.split("_")], dtype=true.R.dtype)
    stated = Pose(true.R @ axes.mT, true.t)
    stated = se3.invert(stated) if convention.inverse else stated
    R, unit = stated.R, convention.unit
    if convention.quaternion is not None:
        order = {"wxyz": [3, 0, 1, 2], "xyzw": [1, 2, 3, 0]}[convention.quaternion]
        R = rotation(torch.from_numpy(Rotation.from_matrix(R.numpy()).as_quat())[:, order])
    return Pose(R, stated.t / (UNIT_METRES[unit] if isinstance(unit, str) else unit))


def poses_of(frames: list[Frame]) -> Pose:
    """Poses (n) of frames."""
    poses = [frame.T_world_from_cam for frame in frames]
    return Pose(torch.cat([p.R for p in poses]).double(), torch.cat([p.t for p in poses]).double())


def with_poses(frames: list[Frame], poses: Pose) -> list[Frame]:
    """Frames with other poses (n)."""
    return [frame.replace(T_world_from_cam=poses[k : k + 1]) for k, frame in enumerate(frames)]
