"""Frames of a walk inside the box as in Stray Scanner captures: 60 Hz, small depth maps, a camera per frame."""

from collections.abc import Callable

import torch

from dhtorch.geometry import camera as cameras
from dhtorch.records import Camera, Frame, Pose
from support.box_scene import pose, render

HW, DEPTH_HW = (72, 96), (24, 32)


def camera_of(i: int) -> Camera:
    """The camera of frame ``i``; every frame has another one."""
    return Camera(torch.tensor([[80.0 + i, 78.5 - i]]), torch.tensor([[50.25, 33.5 + 0.25 * i]]))


def walk(n: int = 4, place: Callable[[int], Pose] = pose) -> list[Frame]:
    """``n`` frames with a smaller depth map, confidence and poses; times count from a phone's start three days ago."""
    frames = []
    for i in range(n):
        camera = camera_of(i)
        shot = render(camera, place(i), HW, 258528.330141458 + i / 60)
        small = render(cameras.resize(camera, HW, DEPTH_HW), place(i), DEPTH_HW)
        conf = (torch.arange(24 * 32).view(1, *DEPTH_HW) % 3).to(torch.uint8)
        frames.append(shot.replace(depth=small.depth, conf=conf))
    return frames
