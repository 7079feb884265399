"""Episodes of frames inside the box, as LeRobot and RLDS data sets hold them."""

from dhtorch.records import Frame
from support.box_scene import CAMERA, HW, pose, render


def two_episodes() -> list[list[Frame]]:
    """Two episodes of 2 and 4 frames at 30 Hz: no frame has the same place in both."""
    return [
        [render(CAMERA, pose(i), HW, i / 30) for i in range(2)],
        [render(CAMERA, pose(5 + i), HW, i / 30) for i in range(4)],
    ]


def three_episodes() -> list[list[Frame]]:
    """Three episodes of 2, 3 and 4 frames at 30 Hz."""
    return [[render(CAMERA, pose(5 * e + i), HW, i / 30) for i in range(2 + e)] for e in range(3)]
