"""Frames of an RH20T scene inside the box: a fixed camera, a camera on the hand, the pose of the robot's base."""

import torch

from dhtorch.data.readers.rh20t_robot import ROBOT_ARMS
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame
from support.box_scene import pose, render

HW = (36, 64)
CAMERA = Camera(torch.tensor([[50.0, 48.0]]), torch.tensor([[33.5, 16.75]]))
FIXED, HAND = "750612070851", ROBOT_ARMS[1].in_hand[0]
BASE = se3.to_matrix(se3.exp(torch.tensor([[0.4, -0.2, 0.9, 0.7, -0.3, 0.5]]).double()))[0].numpy()


def still(n: int = 3, start: float = 1_600_000_100.0) -> list[Frame]:
    """Frames of the fixed camera at 10 Hz."""
    return [render(CAMERA, pose(2), HW, start + i / 10) for i in range(n)]


def moving(n: int = 3, start: float = 1_600_000_100.0) -> list[Frame]:
    """Frames of the camera on the hand at 10 Hz."""
    return [render(CAMERA, pose(i), HW, start + i / 10) for i in range(n)]
