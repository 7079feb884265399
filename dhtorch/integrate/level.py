"""The upward direction of a map: from the format's gravity axis, else from the floor, the walls or the cameras."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dhtorch.data.recording import Recording
from dhtorch.records import Pose

#: Format → the direction of its world that points upwards: ARKit and the built-in room, motion capture.
_UP_BY_FORMAT = {
    "stray": (0.0, 1.0, 0.0),
    "record3d": (0.0, 1.0, 0.0),
    "synthetic": (0.0, -1.0, 0.0),
    "tum": (0.0, 0.0, 1.0),
    "arkitscenes": (0.0, 0.0, 1.0),
}

#: Formats whose world is aligned to gravity however the camera was held: the images of an upright phone are stored
#: sideways, and a phone above a table looks straight down.
_LEVEL_FORMATS = frozenset({"stray", "arkitscenes", "synthetic"})

#: Least cosine of the angle between an upward direction and its first guess: of 40°.
_MIN_GUESS_COSINE = 0.77


def estimate_up(
    recording: Recording,
    poses: Sequence[Pose],
    xyz: Tensor,
    thickness: float,
    normal: Tensor | None = None,
) -> list[float]:
    """The upward direction of a map, a unit vector in its world.

    The format's gravity axis where it has one and the map stands in the recording's own world; else the normal of the
    largest plane that cameras held upright could stand on; else the direction to which most surfaces stand upright;
    else the cameras' mean upward direction; camera axes where that cancels out.

    Args:
        recording: of the map.
        poses: T_world_from_cam (1) of its frames.
        xyz: (P, 3) m, points of the map.
        thickness: m, of the floor.
        normal: (P, 3) of the map's surfaces; NaN where unknown. None = walls are not used.
    """
    mean = mean_camera_up(poses)
    gravity_axis = _UP_BY_FORMAT.get(recording.format)
    own_world = False  # or poses chained from pairs
    if recording.poses is not None and poses:
        off = (recording.poses.R - poses[0].R.to(recording.poses.R)).abs().flatten(1).amax(1)
        own_world = bool((off < 1e-5).any())
    if gravity_axis is not None and own_world:
        axis = torch.tensor(gravity_axis, dtype=torch.float64)
        # In the other formats a trajectory may have been moved to its first camera: no axis 60° off the cameras' mean.
        if recording.format in _LEVEL_FORMATS or float(axis @ mean) > 0.5:
            return axis.tolist()
    up = _fit_floor_normal(xyz.double(), mean, thickness)
    if up is None and normal is not None:
        up = _fit_upright_direction(normal.double(), mean)
    return (mean if up is None else up).tolist()


def mean_camera_up(poses: Sequence[Pose]) -> Tensor:
    """The cameras' mean upward direction (3,) in the world; that of camera axes where they cancel out."""
    mean = torch.stack([-T.R[0, :, 1].double() for T in poses]).mean(0) if poses else torch.zeros(3).double()
    length = mean.norm()
    return mean / length if float(length) > 1e-3 else torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)


def _fit_floor_normal(xyz: Tensor, guess: Tensor, thickness: float) -> Tensor | None:
    """Unit normal (3,) of the largest plane within 40° of ``guess``; None if none contains a tenth of the points."""
    xyz = xyz[xyz.isfinite().all(-1)]
    if len(xyz) < 100:
        return None
    draw = torch.Generator().manual_seed(0)
    subset = xyz[torch.randint(len(xyz), (min(len(xyz), 5000),), generator=draw)]
    triples = subset[torch.randint(len(subset), (300, 3), generator=draw)]
    normal = torch.linalg.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    normal = torch.nn.functional.normalize(normal, dim=-1)
    normal = normal * torch.where(normal @ guess < 0, -1.0, 1.0)[:, None]
    level = normal @ guess > _MIN_GUESS_COSINE
    distance = (subset @ normal.T - (triples[:, 0] * normal).sum(-1)).abs()
    count = torch.where(level, (distance < thickness).sum(0), 0)
    largest = int(count.argmax())
    if int(count[largest]) < 0.1 * len(subset):
        return None
    inliers = subset[distance[:, largest] < thickness]
    axis = torch.linalg.eigh((inliers - inliers.mean(0)).T @ (inliers - inliers.mean(0))).eigenvectors[:, 0]
    axis = axis if float(axis @ guess) > 0 else -axis
    return axis if float(axis @ guess) > _MIN_GUESS_COSINE else None  # the fit to the inliers may have turned it away


def _fit_upright_direction(normal: Tensor, guess: Tensor) -> Tensor | None:
    """Unit direction (3,) within 40° of ``guess`` to which most surfaces are parallel or perpendicular; None = too few.

    Args:
        normal: (P, 3) of surfaces of one size each; those that are not finite are left out.
        guess: unit direction.
    """
    normal = normal[normal.isfinite().all(-1)]
    if len(normal) < 100:
        return None
    draw = torch.Generator().manual_seed(0)
    subset = torch.nn.functional.normalize(
        normal[torch.randint(len(normal), (min(len(normal), 5000),), generator=draw)]
    )
    # Unit vectors (n, 3) spread evenly over the sphere, along a spiral
    k = torch.arange(12000, dtype=torch.float64) + 0.5
    z, turn = 1 - 2 * k / 12000, k * math.pi * (3 - math.sqrt(5))
    r = (1 - z * z).sqrt()
    axes = torch.stack((r * turn.cos(), r * turn.sin(), z), -1)  # about 2° apart
    axes = axes[axes @ guess > _MIN_GUESS_COSINE]
    upright = torch.asin((subset @ axes.T).abs().clamp(max=1))  # angle from the plane at right angles to the axis
    level = torch.pi / 2 - upright
    # A surface leans by 5°; twice the score of surfaces with random normals is enough.
    score = (torch.exp(-0.5 * (upright / 0.087) ** 2) + torch.exp(-0.5 * (level / 0.087) ** 2)).mean(0)
    best = int(score.argmax())
    return axes[best] if float(score[best]) >= 0.25 else None
