"""Record3D captures of a walk inside the box: its frames, an ``.r3d`` archive and an RGBD video."""

import math
from pathlib import Path
from typing import Any

import torch

from dhtorch.geometry import camera as cameras
from dhtorch.records import Camera, Frame
from support import writers
from support.box_scene import pose, render

HW, DEPTH_HW = (48, 64), (24, 32)


def camera_of(i: int, hw: tuple[int, int] = HW) -> Camera:
    """The camera of frame ``i``: autofocus changes it from frame to frame."""
    c = [[33.5 + 0.25 * i, 21.75] if hw == HW else [21.75 + 0.25 * i, 33.5]]
    return Camera(torch.tensor([[61.5 + i, 58.25 - i]]), torch.tensor(c))


def walk(n: int = 3, hw: tuple[int, int] = HW, depth_hw: tuple[int, int] = DEPTH_HW) -> list[Frame]:
    """``n`` frames at 60 Hz with a smaller depth map, confidence and poses, as of a phone with LiDAR."""
    frames = []
    for i in range(n):
        camera = camera_of(i, hw)
        shot = render(camera, pose(i), hw, 100 + i / 60)
        small = render(cameras.resize(camera, hw, depth_hw), pose(i), depth_hw)
        conf = (torch.arange(math.prod(depth_hw)).view(1, *depth_hw) % 3).to(torch.uint8)
        frames.append(shot.replace(depth=small.depth, conf=conf))
    return frames


def r3d_archive(tmp_path: Path, frames: list[Frame] | None = None, **options: Any) -> Path:
    """An ``.r3d`` archive written in this folder, of three frames unless given."""
    writers.write_r3d(tmp_path / "a.r3d", frames or walk(), **options)
    return tmp_path / "a.r3d"


def rgbd_video(tmp_path: Path, n: int = 3, **options: Any) -> tuple[Path, list[Frame]]:
    """(an RGBD video written in this folder, its frames); depth of 0.2 to 2.7 m avoids the ends of the colour range."""
    hw = (96, 128)
    camera = cameras.resize(camera_of(0), HW, hw)
    frames = [render(camera, pose(i), hw, i / 30) for i in range(n)]
    frames = [f.replace(depth=(f.depth * 0.6).clamp(0.2, 2.7)) for f in frames]
    writers.write_record3d_mp4(tmp_path / "a.mp4", frames, **options)
    return tmp_path / "a.mp4", frames
