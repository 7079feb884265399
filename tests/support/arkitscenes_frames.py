"""Frames of a smooth walk inside the box, with confidence, as ARKitScenes and CA-1M captures hold them."""

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame, Pose
from support.box_scene import CAMERA, HW, render

VGA_HW = (96, 128)
VGA = Camera(torch.tensor([[124.0, 115.5]]), torch.tensor([[68.25, 43.25]]))  # not quite the small camera, scaled
UPRIGHT = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)  # looks along y, the sky (z) on top


def path(time: float) -> Pose:
    """The camera pose at a time (s), of constant velocity and turn rate: interpolated poses have an exact answer."""
    s = time - 100
    turn = se3.exp(torch.tensor([[0.5 * s, -0.9 * s, 0.4 * s, 0, 0, 0]], dtype=torch.float64))
    t = torch.tensor([[0.2 + 0.6 * s, -0.3 + 0.2 * s, 0.1 - 0.5 * s]], dtype=torch.float64)
    return Pose(turn.R @ UPRIGHT, t)


def shots(times: object, camera: Camera = CAMERA, hw: tuple[int, int] = HW, turns: int = 0) -> list[Frame]:
    """Frames at these times (s) as they are stored: ``turns`` quarter turns clockwise make them upright."""
    frames = []
    for time in np.round(np.asarray(times, dtype=float), 6):
        c2w = convert.rot90_pose(se3.to_matrix(path(float(time))).numpy(), -turns)
        frame = render(camera, se3.from_matrix(torch.from_numpy(c2w)), hw, float(time))
        frames.append(frame.replace(conf=frame.image[:, 1] // 86))  # 0, 1 and 2, in patches
    return frames
